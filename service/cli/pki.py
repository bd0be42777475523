"""`gridsec pki` and `gridsec zenoh-config`: certificates, and configurations of zenoh that use them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table

from service.cli import console
from service.cli.console import FAILED
from service.cli.study_planning import as_usage_error

app = typer.Typer(no_args_is_help=True, help="Certificates of meters, routers and services, with expiry.")

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the authority.")]
Expires = Annotated[str, typer.Option(help="Duration: 12h, 90d, 2w or 1y.")]
KindName = Literal["router", "service", "concentrator", "meter", "subscriber"]


@app.command()
def init(folder: Folder, *, expires: Expires = "10y") -> None:
    """Create a certificate authority. Keep `authority.key` offline; it issues every certificate."""
    from service.access import pki

    with as_usage_error():
        made = pki.create_authority(folder, time.time(), lasts_s=pki.duration_s(expires))
    console.out.print(f"{made.path}: expires {_day(made.expires)}", soft_wrap=True)


@app.command()
def issue(
    folder: Folder,
    name: Annotated[str, typer.Argument(help="Common name, e.g. c1, or FEEDER.METER for a meter.")],
    *,
    kind: Annotated[KindName, typer.Option(help="Purpose of the certificate.")],
    expires: Expires = "1y",
    host: Annotated[
        list[str] | None,
        typer.Option(help="Name or address of a router, beside those of loopback; may be repeated."),
    ] = None,
    renew: Annotated[bool, typer.Option("--renew", help="Replace the certificate of this name.")] = False,
) -> None:
    """Issue a certificate with a private key (mode 0600)."""
    from service.access import pki

    with as_usage_error():
        made = pki.issue(
            folder,
            name,
            pki.Kind(kind),
            time.time(),
            lasts_s=pki.duration_s(expires),
            hosts=tuple(host or ()),
            renew=renew,
        )
    console.out.print(f"{made.path}: {made.kind}, expires {_day(made.expires)}", soft_wrap=True)


@app.command("list")
def list_(folder: Folder) -> None:
    """List certificates with the days left; exit code 1 if one has expired."""
    from service.access import pki

    now = time.time()
    with as_usage_error():
        found = pki.certificates(folder)
    table = Table("name", "kind", "expires", "days left", "serial")
    for one in found:
        days = f"{one.days_left(now):.1f}" if one.expires > now else "expired"
        table.add_row(one.name, one.kind, _day(one.expires), days, f"{one.serial:x}"[:16])
    console.out.print(table)
    if pki.expired(found, now):
        raise typer.Exit(FAILED)


def zenoh_config(
    folder: Folder,
    *,
    out: Annotated[Path, typer.Option(help="Folder of the configurations.")],
    feeder: Annotated[list[str], typer.Option(help="Folder or name of a feeder; may be repeated.")],
    meters: Annotated[
        Path | None,
        typer.Option(
            help="Table (csv) certificate,feeder,meter of the meters of each concentrator; the busbar meter "
            "is substation. Meter certificates named FEEDER.METER need no row."
        ),
    ] = None,
    endpoint: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint of the router, may be repeated. [default: tls/127.0.0.1:7447]"),
    ] = None,
    prefix: Annotated[str, typer.Option(help="First chunks of all keys.")] = "gridsec",
    installed: Annotated[
        Path | None,
        typer.Option(help="Folder of the certificates on the machines that use them. [default: DIR]"),
    ] = None,
    report_forgeries: Annotated[
        bool,
        typer.Option(
            "--report-forgeries",
            help="Pass all readings on the keys of meters that sign; `serve --meter-keys` refuses forged "
            "ones with an incident, the router without one.",
        ),
    ] = False,
) -> None:
    """Write zenoh configurations with mutual TLS, and access rules by certificate.

    Each concentrator and meter publishes its own keys only, the service alone estimates and alarms. Rows of
    meters that sign stay in `meter-keys.csv`.
    """
    from feeders.model.site import load
    from service.access import pki, zenoh_rules

    known = {site.feeder.name: frozenset(site.meter_ids) for site in map(load, feeder)}
    with as_usage_error():
        plan = zenoh_rules.Plan(
            pki.certificates(folder),
            known,
            zenoh_rules.read_assignments(meters),
            endpoints=tuple(endpoint or (zenoh_rules.ENDPOINT,)),
            prefix=prefix,
            installed=(installed or folder).absolute(),
            keys=zenoh_rules.kept_keys(out),
            report_forgeries=report_forgeries,
        )
        files = zenoh_rules.files(plan)
    out.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        pki.write_private(out / name, content.encode())
    console.out.print(
        f"{out}: {', '.join(files) if len(files) <= 12 else f'{len(files)} files'}", soft_wrap=True
    )


def _day(t: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(t))

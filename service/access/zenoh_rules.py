"""zenoh configurations with mutual TLS, and access rules by the common name of a certificate.

The router refuses by default, and silently. One rule per certificate lets it publish the keys of its own
meters. The service alone publishes estimates, alarms and incidents. Every certificate may subscribe to these
and query them.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridsec.errors import InputInvalid, Problem
from service.access.pki import AUTHORITY, Issued, Kind
from service.access.signing import BUSBAR, COLUMNS, Scheme, table_rows

ENDPOINT = "tls/127.0.0.1:7447"
KEYS_FILE = "meter-keys.csv"
_COLUMNS = ("certificate", "feeder", "meter")
_ENDPOINT = re.compile(r"tls/\S+:[0-9]{1,5}")
_SESSIONS = 1000
"""Sessions of a router beside those of the certificates."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """A meter (`substation`: that of the busbar) of a feeder, and the certificate that publishes it."""

    certificate: str
    feeder: str
    meter: str


@dataclass(frozen=True, slots=True)
class Plan:
    """Certificates, feeders with their meters, assignments, endpoints of the router, prefix of all keys.

    `installed` is the folder of the certificates on the machines that use them. `keys` are rows of meters
    that sign: feeder, meter, scheme, key. With `report_forgeries` every concentrator and meter may publish on
    the keys of these: the router refuses silently, the service refuses a wrong signature with an incident.
    """

    certificates: tuple[Issued, ...]
    feeders: Mapping[str, frozenset[str]]
    assignments: tuple[Assignment, ...]
    endpoints: tuple[str, ...]
    prefix: str
    installed: Path
    keys: tuple[tuple[str, ...], ...] = ()
    report_forgeries: bool = False


def read_assignments(path: Path | None) -> tuple[Assignment, ...]:
    """Read a table with the columns certificate, feeder, meter; nothing without a file.

    Raises
    ------
    InputInvalid
        If the file is absent or has other columns.
    """
    if path is None:
        return ()
    if not path.is_file():
        raise InputInvalid([Problem("no-file", f"{path} is not a file")])
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.DictReader(file)
        lacking = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
        if lacking:
            raise InputInvalid([Problem("missing", f"{path}: no column {', '.join(lacking)}")])
        return tuple(Assignment(*((row[name] or "").strip() for name in _COLUMNS)) for row in rows)


def files(plan: Plan) -> dict[str, str]:
    """Return the texts of all files by name: `CERTIFICATE.json5`, and `meter-keys.csv` for `serve`.

    Raises
    ------
    InputInvalid
        With every problem of the plan.
    """
    owners = _owners(plan)
    made = {}
    for one in plan.certificates:
        if one.kind == Kind.ROUTER:
            made[f"{one.name}.json5"] = _text(_router(plan, one, owners))
        elif one.kind != AUTHORITY:
            made[f"{one.name}.json5"] = _text(_client(plan, one))
    proofs = {place: ("certificate", name) for place, name in owners.items()}
    proofs |= {(feeder, meter): (scheme, key) for feeder, meter, scheme, key in plan.keys}
    rows = [COLUMNS, *((*place, *proofs[place]) for place in sorted(proofs))]
    made[KEYS_FILE] = "".join(f"{','.join(row)}\n" for row in rows)
    return made


def kept_keys(folder: Path) -> tuple[tuple[str, ...], ...]:
    """Read the rows of meters that sign from a folder's `meter-keys.csv`, if it exists.

    Raises
    ------
    InputInvalid
        If the file cannot be read.
    """
    path = folder / KEYS_FILE
    rows = table_rows(path) if path.exists() else []
    return tuple(row for row in rows if row[2] != Scheme.CERTIFICATE)


def _owners(plan: Plan) -> dict[tuple[str, str], str]:
    """Certificate of each feeder's meter, after a check of the plan."""
    problems = [
        Problem("wrong-endpoint", f"{end}: an endpoint with TLS looks like {ENDPOINT}")
        for end in plan.endpoints
        if not _ENDPOINT.fullmatch(end)
    ]
    kinds = {one.name: one.kind for one in plan.certificates}
    problems += [
        Problem("missing", f"no certificate of the kind {kind}")
        for kind in (Kind.ROUTER, Kind.SERVICE)
        if kind not in kinds.values()
    ]
    given = [*plan.assignments, *_by_name(plan)]
    owners: dict[tuple[str, str], str] = {}
    for one in given:
        place = f"{one.certificate}, {one.feeder}, {one.meter}"
        if kinds.get(one.certificate) not in (Kind.CONCENTRATOR, Kind.METER):
            text = f"{place}: no certificate of a concentrator or meter has this name"
            problems.append(Problem("unknown-name", text))
        if one.feeder not in plan.feeders:
            problems.append(Problem("unknown-name", f"{place}: the feeder is not given"))
        elif one.meter != BUSBAR and one.meter not in plan.feeders[one.feeder]:
            problems.append(Problem("unknown-name", f"{place}: the feeder has no such meter"))
        if owners.setdefault((one.feeder, one.meter), one.certificate) != one.certificate:
            text = f"{place}: {owners[one.feeder, one.meter]} publishes this meter already"
            problems.append(Problem("duplicate", text))
    idle = {name for name, kind in kinds.items() if kind in (Kind.CONCENTRATOR, Kind.METER)}
    idle -= {one.certificate for one in given}
    problems += [Problem("missing", f"certificate {name} has no meter") for name in sorted(idle)]
    if plan.report_forgeries and not plan.keys:
        text = f"forgeries are reported of meters that sign; {KEYS_FILE} has none"
        problems.append(Problem("missing", text))
    if problems:
        raise InputInvalid(problems)
    return owners


def _by_name(plan: Plan) -> list[Assignment]:
    """Assignments of the meter certificates named FEEDER.METER without a row of their own."""
    listed = {one.certificate for one in plan.assignments}
    single = (one.name for one in plan.certificates if one.kind == Kind.METER and one.name not in listed)
    return [
        Assignment(name, feeder, meter)
        for name, (feeder, dot, meter) in ((name, name.partition(".")) for name in single)
        if dot
    ]


def _router(plan: Plan, own: Issued, owners: Mapping[tuple[str, str], str]) -> dict[str, Any]:
    made = _common(plan, own)
    made["mode"] = "router"
    made["listen"] = {"endpoints": list(plan.endpoints)}
    sessions = _SESSIONS + 2 * len(plan.certificates)
    made["transport"]["unicast"] = {"max_sessions": sessions, "accept_pending": sessions}
    tls = made["transport"]["link"]["tls"]
    tls |= {
        "listen_certificate": tls["connect_certificate"],
        "listen_private_key": tls["connect_private_key"],
    }
    tls |= {"enable_mtls": True, "close_link_on_expiration": True}
    made["access_control"] = access_control(plan, owners)
    return made


def _client(plan: Plan, own: Issued) -> dict[str, Any]:
    made = _common(plan, own)
    made["mode"] = "client"
    made["connect"] = {"endpoints": list(plan.endpoints)}
    return made


def _common(plan: Plan, own: Issued) -> dict[str, Any]:
    tls: dict[str, Any] = {
        "root_ca_certificate": str(plan.installed / f"{AUTHORITY}.crt"),
        "connect_certificate": str(plan.installed / f"{own.name}.crt"),
        "connect_private_key": str(plan.installed / f"{own.name}.key"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "link": {"protocols": ["tls"], "tls": tls},
            "shared_memory": {"enabled": False},
        },
    }


def access_control(plan: Plan, owners: Mapping[tuple[str, str], str]) -> dict[str, Any]:
    """Return the access rules of a router."""
    names = [one.name for one in plan.certificates if one.kind not in (AUTHORITY, Kind.ROUTER)]
    services = [one.name for one in plan.certificates if one.kind == Kind.SERVICE]
    published: dict[str, list[str]] = {}
    for (feeder, meter), name in sorted(owners.items()):
        published.setdefault(name, []).append(_reading_key(plan.prefix, feeder, meter))
    kinds = {one.name: one.kind for one in plan.certificates}
    for feeder, name in sorted({(feeder, name) for (feeder, _), name in owners.items()}):
        if kinds[name] == Kind.CONCENTRATOR:
            published[name].append(f"{plan.prefix}/{feeder}/concentrator/{name}/readings")
    rules = _shared_rules(plan)
    subjects = [
        {"id": "subject every certificate", "cert_common_names": names},
        {"id": "subject every service", "cert_common_names": services},
    ]
    policies = [
        {
            "rules": [rule["id"] for rule in rules if rule["id"].startswith("read ")],
            "subjects": ["subject every certificate"],
        },
        {
            "rules": [rule["id"] for rule in rules if rule["id"].startswith("service ")],
            "subjects": ["subject every service"],
        },
    ]
    if plan.report_forgeries:
        signed = sorted(_reading_key(plan.prefix, feeder, meter) for feeder, meter, *_ in plan.keys)
        publishers = [name for name, kind in kinds.items() if kind in (Kind.CONCENTRATOR, Kind.METER)]
        rules.append(_rule("publish signed", "ingress", ["put"], signed))
        subjects.append({"id": "subject every publisher", "cert_common_names": publishers})
        policies.append({"rules": ["publish signed"], "subjects": ["subject every publisher"]})
    for name, keys in published.items():
        rules.append(_rule(f"publish {name}", "ingress", ["put"], keys))
        subjects.append({"id": f"subject {name}", "cert_common_names": [name]})
        policies.append({"rules": [f"publish {name}"], "subjects": [f"subject {name}"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


_CLUSTER = ("query", "reply", "declare_queryable")
"""Calls between front and workers, and their answers."""


def _shared_rules(plan: Plan) -> list[dict[str, Any]]:
    # The service also receives what is published on a wrong key: it keeps it as a bad reading.
    prefix, everything = plan.prefix, f"{plan.prefix}/**"
    kinds = ("estimate", "alarm/*", "incident/*")
    results = [f"{prefix}/*/{kind}" for kind in kinds]
    own = [f"{prefix}/{feeder}/{kind}" for feeder in sorted(plan.feeders) for kind in kinds]
    alive = [f"{prefix}/service/*"]
    # Between front and workers; `**` above does not match them.
    workers = [f"{prefix}/@worker/**"]
    asks = ["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"]
    tells = ["put", "delete", "reply", "declare_queryable", "liveliness_token"]
    return [
        _rule("read in", "ingress", asks, [*results, *alive]),
        _rule("read out", "egress", tells, [*results, *alive]),
        # A declared publisher sends only while the router reports a matching subscriber.
        _rule("read out subscribers", "egress", ["declare_subscriber"], [everything]),
        _rule("service in", "ingress", ["put", "delete", "reply"], own),
        _rule("service in declarations", "ingress", ["declare_queryable"], results),
        _rule("service in readings", "ingress", ["declare_subscriber"], [everything]),
        _rule("service in token", "ingress", ["liveliness_token"], alive),
        _rule("service out", "egress", ["put", "delete", "query"], [everything]),
        _rule("service in workers", "ingress", _CLUSTER, workers),
        _rule("service out workers", "egress", _CLUSTER, workers),
    ]


def _rule(name: str, flow: str, messages: Iterable[str], keys: Iterable[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def _reading_key(prefix: str, feeder: str, meter: str) -> str:
    source = BUSBAR if meter == BUSBAR else f"meter/{meter}"
    return f"{prefix}/{feeder}/{source}/reading"


def _text(made: dict[str, Any]) -> str:
    return f"// Written by `gridsec zenoh-config`.\n{json.dumps(made, indent=1)}\n"

"""`gridsec key` and `gridsec audit`: API keys and the audit log, while the service runs or not."""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.markup import escape
from rich.table import Table

from gridsec.errors import InputInvalid
from service.cli import console

if TYPE_CHECKING:
    from service.store.access import AccessStore

DATABASE: Final = "sqlite:///gridsec.db"

Database = Annotated[str, typer.Option(envvar="GRIDSEC_DATABASE", help="Database of the service.")]

key_app = typer.Typer(no_args_is_help=True, help="API keys of operators, planners and programs.")
audit_app = typer.Typer(no_args_is_help=True, help="Audit log of logins, keys and changes.")


@key_app.command()
def add(
    name: Annotated[str, typer.Argument(help="Name of the identity, in alarms and in the audit log.")],
    *,
    role: Annotated[str, typer.Option(help="viewer, operator, engineer or admin.")] = "viewer",
    feeder: Annotated[
        list[str] | None, typer.Option(help="Only this feeder; may be repeated. [default: all]")
    ] = None,
    expires: Annotated[str, typer.Option(help="Life of the key: 12h, 90d, 8w, 1y, or never.")] = "1y",
    database: Database = DATABASE,
) -> None:
    """Create an API key and print it once; only its SHA-256 is stored."""
    from service.access.identity import Role, is_name
    from service.access.keys import create
    from service.access.pki import duration_s
    from service.store.access import AccessStore

    problems = []
    if role not in set(Role):
        problems.append(f"--role is {role!r}; expected one of {', '.join(Role)}")
    if not is_name(name.strip()):
        problems.append("the name must have 1 to 64 printable characters")
    life = None
    if expires != "never":
        try:
            life = duration_s(expires)
        except InputInvalid as error:
            problems.append(f"--expires: {'; '.join(error.problems)}, or never")
    if problems:
        raise typer.BadParameter("; ".join(problems))
    now = time.time()
    scope = frozenset(feeder) if feeder else None
    text, record = create(name.strip(), Role(role), scope, now, None if life is None else now + life)
    with AccessStore(database) as store:
        what = f"{record.name}, {record.role}, {_scope(record.feeders)}, {_end(record.expires)}"
        # The entry comes first: no change is without one.
        _audit(store, now, "key add", record.id, what)
        store.add_key(record)
    console.err.print(f"Key {record.id}: {what}. It is shown only now:")
    print(text)


@key_app.command("list")
def list_keys(*, database: Database = DATABASE) -> None:
    """List all keys without their secrets."""
    from service.store.access import AccessStore

    with AccessStore(database) as store:
        records = store.keys()
    table = Table("id", "name", "role", "feeders", "created", "state")
    now = time.time()
    for each in records:
        state = each.ended(now) or _end(each.expires)
        table.add_row(
            *map(escape, (each.id, each.name, each.role, _scope(each.feeders), _day(each.created), state))
        )
    console.out.print(table)


@key_app.command()
def revoke(
    key: Annotated[str, typer.Argument(help="Id of the key, as in `gridsec key list`.")],
    *,
    database: Database = DATABASE,
) -> None:
    """Revoke a key and its sessions; a running service refuses it within 2 s."""
    from service.store.access import AccessStore

    now = time.time()
    with AccessStore(database) as store:
        found = store.key(key)
        if found is None or found.revoked is not None:
            raise typer.BadParameter(f"there is no valid key {key!r}")
        _audit(store, now, "key revoke", key, "")
        store.revoke(key, now)
    console.out.print(f"Key {key} is revoked.")


@audit_app.command()
def verify(
    *,
    expect: Annotated[
        str, typer.Option(help="Number and hash of an entry kept elsewhere, e.g. 120:9f86d0...")
    ] = "",
    database: Database = DATABASE,
) -> None:
    """Verify the chain of the audit log; exit code 1 if it is broken."""
    from service.access.audit import broken
    from service.store.access import AccessStore

    number, _, digest = expect.partition(":")
    if expect and not (number.isdigit() and re.fullmatch(r"[0-9a-f]{64}", digest)):
        raise typer.BadParameter(f"--expect is {expect!r}; expected NUMBER:HASH")
    with AccessStore(database) as store:
        entries = store.audit()
    reason = broken(entries, (int(number), digest) if expect else None)
    if reason is not None:
        console.print_error(f"The audit log is not intact: {reason}.")
        raise typer.Exit(console.FAILED)
    last = entries[-1] if entries else None
    end = "It is empty." if last is None else f"Last entry: {last.seq}:{last.hash}"
    console.out.print(f"The audit log is intact, {len(entries)} entries. {end}", soft_wrap=True)


@audit_app.command()
def show(
    *,
    limit: Annotated[int, typer.Option(min=1, help="Number of entries, the newest ones.")] = 50,
    database: Database = DATABASE,
) -> None:
    """Print the newest entries of the audit log."""
    from service.store.access import AccessStore

    with AccessStore(database) as store:
        entries = store.audit()[-limit:]
    table = Table("entry", "time (UTC)", "identity", "credential", "action", "target")
    for each in entries:
        when = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(each.t))
        table.add_row(
            *map(escape, (str(each.seq), when, each.identity, each.credential, each.action, each.target))
        )
    console.out.print(table)


def audit_command(database: str, action: str, target: str, detail: str) -> None:
    """Append an entry of a command to the audit log, if the service has one."""
    from service.store.access import AccessStore

    with AccessStore(database) as store:
        if store.any_key():
            _audit(store, time.time(), action, target, detail)


def _audit(store: AccessStore, now: float, action: str, target: str, detail: str) -> None:
    import getpass
    import os

    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user id without a name, as in containers
        user = f"uid {os.getuid()}"
    store.append(now, user, "command line", action, target, detail)


def _scope(feeders: frozenset[str] | None) -> str:
    return "all feeders" if feeders is None else ", ".join(sorted(feeders))


def _end(expires: float | None) -> str:
    return "does not expire" if expires is None else f"expires {_day(expires)}"


def _day(t: float) -> str:
    return time.strftime("%Y-%m-%d", time.gmtime(t))

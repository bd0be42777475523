"""`gridsec notify`: targets of notifications and dead letters, while the service runs or not."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape
from rich.table import Table

from gridsec.errors import InputInvalid
from service.cli import console
from service.cli.access import DATABASE, Database, audit_command

if TYPE_CHECKING:
    from service.notify.targets import Targets

app = typer.Typer(no_args_is_help=True, help="Webhooks and Alertmanager: targets and dead letters.")

TargetsFile = Annotated[Path, typer.Argument(help="File (TOML) of `gridsec serve --notify`.")]
Letters = Annotated[list[int] | None, typer.Argument(help="Numbers of dead letters.")]
OfTarget = Annotated[str | None, typer.Option("--target", help="Only those of this target.")]
Everything = Annotated[bool, typer.Option("--all", help="All dead letters.")]


@app.command()
def secret() -> None:
    """Print a new secret of a webhook."""
    from service.notify.webhook import new_secret

    print(new_secret())


@app.command()
def check(file: TargetsFile) -> None:
    """Check a file of targets, and print its targets; no request is made."""
    from service.notify.targets import Webhook

    table = Table("target", "kind", "address", "severities", "kinds", "feeders", "changes")
    for each in _targets(file).all:
        changes = each.changes if isinstance(each, Webhook) else ()
        chosen = (each.severities, each.kinds, each.feeders, changes)
        filters = [", ".join(map(str, values)) or "all" for values in chosen]
        table.add_row(*map(escape, (each.name, each.kind, each.host, *filters)))
    console.out.print(table)


@app.command()
def test(
    file: TargetsFile, target: Annotated[str, typer.Argument(help="Name of one of its targets.")]
) -> None:
    """Send a test message to a target and print the result; exit code 1 if it is not taken."""
    from service.notify.delivery import channel_of
    from service.notify.notices import trial_notice

    targets = _targets(file)
    found = next((each for each in targets.all if each.name == target), None)
    if found is None:
        names = ", ".join(each.name for each in targets.all)
        raise typer.BadParameter(f"{file} has no target {target!r}; expected one of {names}")
    now = time.time()
    channel, notice = channel_of(found, targets.external_url), trial_notice(now)
    response = channel.send(notice.message_id, channel.body([notice], now), now)
    if not response.accepted:
        console.print_error(f"{target}: {response.problem}")
        raise typer.Exit(console.FAILED)
    console.say(f"{target} has taken the message {notice.message_id}: status {response.status}")


@app.command("targets")
def list_targets(*, database: Database = DATABASE) -> None:
    """Print the positions of all targets that the service has served."""
    from service.store.deliveries import DeliveryStore

    with DeliveryStore(database) as store:
        positions, counts = store.positions(), store.counts()
    table = Table(
        "target", "position", "last success (UTC)", "failing since (UTC)", "problem", "dead letters"
    )
    for name, each in positions.items():
        row = (name, str(each.position), _when(each.delivered), _when(each.failing_since))
        table.add_row(*map(escape, (*row, each.problem or "", str(counts.get(name, 0)))))
    console.out.print(table)


@app.command("dead-letters")
def dead_letters(
    *,
    target: OfTarget = None,
    show: Annotated[int | None, typer.Option(help="Print the message of this dead letter.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="Number of letters, the oldest ones.")] = 50,
    database: Database = DATABASE,
) -> None:
    """Print the messages that were given up."""
    from service.store.deliveries import DeliveryStore

    with DeliveryStore(database) as store:
        letters = store.letters(target=target, limit=limit if show is None else None)
    if show is not None:
        found = next((each for each in letters if each.id == show), None)
        if found is None:
            raise typer.BadParameter(f"there is no dead letter {show}")
        print(found.body)
        return
    table = Table("letter", "target", "type", "event", "time (UTC)", "given up (UTC)", "attempts", "problem")
    for each in letters:
        problem = each.problem + (" (sent again soon)" if each.resend else "")
        row = (str(each.id), each.target, each.type, str(each.number), _when(each.t), _when(each.died))
        table.add_row(*map(escape, (*row, str(each.attempts), problem)))
    console.out.print(table)


@app.command()
def resend(
    letters: Letters = None,
    *,
    target: OfTarget = None,
    everything: Everything = False,
    database: Database = DATABASE,
) -> None:
    """Send dead letters again, with the same message ids: by the running service, or after its next start."""
    ids = _chosen(letters, target, everything=everything)
    console.say(f"{_change('resend', ids, target, database)} dead letters are sent again by the service.")


@app.command()
def discard(
    letters: Letters = None,
    *,
    target: OfTarget = None,
    everything: Everything = False,
    database: Database = DATABASE,
) -> None:
    """Delete dead letters."""
    ids = _chosen(letters, target, everything=everything)
    console.say(f"{_change('discard', ids, target, database)} dead letters are deleted.")


def _change(
    action: Literal["resend", "discard"], ids: list[int] | None, target: str | None, database: str
) -> int:
    """Change dead letters after an entry of the audit log; return their number."""
    from service.store.deliveries import DeliveryStore

    with DeliveryStore(database) as store:
        numbers = "" if ids is None else ", ".join(map(str, ids))
        audit_command(database, f"notify {action}", target or "all", numbers)
        change = store.resend if action == "resend" else store.discard
        return change(target=target, ids=ids)


def _targets(file: Path) -> Targets:
    from service.notify.targets import read_targets

    try:
        return read_targets(file)
    except InputInvalid as error:
        raise typer.BadParameter("; ".join(error.problems)) from error


def _chosen(letters: list[int] | None, target: str | None, *, everything: bool) -> list[int] | None:
    """Numbers of letters; None for all of the target or of all targets."""
    given = sum((bool(letters), target is not None and not letters, everything))
    if given != 1:
        raise typer.BadParameter("expected numbers of dead letters, --target, or --all")
    return letters or None


def _when(t: float | None) -> str:
    return "" if t is None else time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(t))

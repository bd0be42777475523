"""`gridsec backup` and `gridsec restore`: a database to a file, and back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.console import say
from service.cli.paths import check_paths

if TYPE_CHECKING:
    from collections.abc import Iterable

    from service.store.backup import Copy

Database = Annotated[
    str | None,
    typer.Option(
        help="sqlite:///file or postgresql+psycopg://... [default: GRIDSEC_DATABASE or sqlite:///gridsec.db]"
    ),
]


def backup(
    file: Annotated[Path, typer.Argument(help="File to write.")], *, database: Database = None
) -> None:
    """Write a database to a file, also while a service runs.

    SQLite: `<database>.access` (keys, audit log) goes to FILE.access, `<database>.notify` to FILE.notify.
    PostgreSQL needs `pg_dump`.
    """
    from service.settings import settings
    from service.store.backup import backup as run

    check_paths(replaced={"FILE": file})
    file.parent.mkdir(parents=True, exist_ok=True)
    _print(run(settings({"database": database}).database, file))


def restore(
    file: Annotated[Path, typer.Argument(help="File of `gridsec backup`.")], *, database: Database = None
) -> None:
    """Restore a backup into a database that is empty or does not exist; no service may write it.

    An SQLite file is restored to an SQLite file. PostgreSQL needs `pg_restore` and an existing database.
    """
    from service.settings import settings
    from service.store.backup import restore as run

    check_paths(read={"FILE": file})
    _print(run(settings({"database": database}).database, file))


def _print(copies: Iterable[Copy]) -> None:
    for copy in copies:
        schema = "" if copy.version is None else f", schema version {copy.version}"
        say(f"{copy.name}: {copy.size} bytes{schema}")

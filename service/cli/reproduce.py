"""`gridsec reproduce`: the examples of the papers, printed and computed numbers, and figures as PNG."""

from __future__ import annotations

import time
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from service.cli import console
from service.cli.console import FAILED, print_error
from service.cli.paths import check_paths

if TYPE_CHECKING:
    from collections.abc import Iterator

    from gridsec.papers.claims import Claim, Reproduction

# Short names of the papers: modules of gridsec.papers.
PAPERS: Final = ("chong2020", "kim2018", "lee2018", "yang2019", "yang2021")


def reproduce(
    paper: Annotated[str, typer.Argument(help=f"{', '.join(PAPERS)}, or all.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for the figures.")] = Path("figures"),
) -> None:
    r"""Compute a paper's examples, print its numbers and the computed ones, and draw its figures.

    Exit code 1 if a number of a paper differs without a known reason. The figures need
    matplotlib, in a checkout: pip install -e '.\[plot]'.
    """
    from gridsec.papers import draw

    papers = _chosen(paper)
    drawing = draw.available()
    if drawing:
        check_paths(over={"--out": out})
        out.mkdir(parents=True, exist_ok=True)
    failed: list[Claim] = []
    count = met = 0
    for made, seconds in _computed(papers):
        _show(made, seconds)
        failed += made.unexplained
        count += len(made.claims)
        met += len(made.claims) - len(made.unmet)
        for figure in made.figures if drawing else ():
            path = out / f"{figure.name}.png"
            path.write_bytes(draw.png(figure))
            console.out.print(f"{escape(str(path))}: {escape(figure.caption)}")
    if not drawing:
        print_error("figures are not drawn: they need matplotlib, in a checkout: pip install -e '.[plot]'")
    for claim in failed:
        print_error(f"not met: {claim.what} ({claim.where}): {_printed(claim)}, ours {_text(claim.ours)}")
    if failed:
        raise typer.Exit(FAILED)
    console.out.print(
        f"[green]{count} claims: {met} met, {count - met} differ, each for a reason printed above.[/]"
    )


def _chosen(paper: str) -> tuple[str, ...]:
    if paper == "all":
        return PAPERS
    if paper not in PAPERS:
        raise typer.BadParameter(f"{paper!r}: expected {', '.join(PAPERS)} or all", param_hint="PAPER")
    return (paper,)


def _computed(papers: tuple[str, ...]) -> Iterator[tuple[Reproduction, float]]:
    """Reproduce the papers one by one, with a line of progress on standard error."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    for number, paper in enumerate(papers, start=1):
        started = time.monotonic()
        with Progress(
            *columns, console=console.err, transient=True, disable=not console.err.is_terminal
        ) as bar:
            bar.add_task(f"{paper} ({number} of {len(papers)})", total=None)
            made: Reproduction = import_module(f"gridsec.papers.{paper}").reproduce()
        yield made, time.monotonic() - started


def _show(made: Reproduction, seconds: float) -> None:
    """Print a table of claims, and below it the reasons of differences."""
    reasons: list[str] = []
    table = Table("", "what", "where", "paper", "ours", title_justify="left")
    table.title = f"[bold]{escape(made.paper)}[/], computed in {seconds:.1f} s"
    for claim in made.claims:
        mark = "[green]met[/]" if claim.met else "[bold red]not met[/]"
        if claim.why:
            if claim.why not in reasons:
                reasons.append(claim.why)
            mark = (
                f"{'[green]met[/]' if claim.met else '[yellow]differs[/]'} ({reasons.index(claim.why) + 1})"
            )
        cells = (claim.what, claim.where, _printed(claim), _text(claim.ours))
        table.add_row(mark, *map(escape, cells))
    console.out.print(table, soft_wrap=False)
    for number, reason in enumerate(reasons, start=1):
        console.out.print(f"({number}) {escape(reason)}")


def _printed(claim: Claim) -> str:
    return _text(claim.printed) if claim.relation == "=" else f"at most {_text(claim.printed)}"


def _text(value: float | str) -> str:
    """Format a value: a text unchanged, a number with six digits."""
    return value if isinstance(value, str) else f"{value:.6g}"

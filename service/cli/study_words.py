"""Terminal output of all studies: tables with a legend, the conclusion, and the figure of `--plot`."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.markup import escape
from rich.table import Table

from feeders.util import extra, replace_file
from service.cli import console

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site

_FRAME: Final = 3
"""Characters of a column beside its text."""
_WORDS: Final = 12
"""Least width of a column with longer words, characters."""
FORMS: Final = (".svg", ".png", ".pdf")


def _drawable(path: Path | None) -> Path | None:
    """Refuse a figure of an unknown form, or one that needs matplotlib where it is not installed.

    Raises
    ------
    typer.BadParameter
        For such a figure.
    """
    from gridsec.papers.draw import available

    if path is not None and path.suffix.lower() not in FORMS:
        raise typer.BadParameter(f"{path}: expected a name that ends in {', '.join(FORMS)}")
    if path is not None and path.suffix.lower() != ".svg" and not available():
        raise typer.BadParameter(
            f"{path}: matplotlib is not installed, which is {extra('plot')}; .svg needs no extra"
        )
    return path


Plot = Annotated[
    Path | None,
    typer.Option(
        help="Write the study's main figure to this file: .svg, or .png and .pdf (extra `plot`).",
        callback=_drawable,
    ),
]


class Output:
    """Terminal output of one study; each column is explained once, below its first table."""

    def __init__(self, study: str) -> None:
        self.study = study
        self._explained = set[str]()

    def table(self, title: str, frame: pd.DataFrame) -> None:
        """Print a table without its empty columns, and the meanings of its columns."""
        kept = [name for name in frame.columns if not all(isinstance(c, str) and not c for c in frame[name])]
        texts = {name: [cell_text(cell) for cell in frame[name]] for name in kept}
        words = {name for name in kept if any(isinstance(cell, str) for cell in frame[name])}
        for part in tables(title, texts, words, console.out.width):
            console.out.print(part, soft_wrap=False)
        unknown = any("-" in cells for cells in texts.values())
        self.explain([*kept, *(["-"] * unknown)])

    def explain(self, columns: list[str]) -> None:
        """Print one line for each column that is not explained yet."""
        from feeders.report.html import UNKNOWN
        from feeders.report.text import legend

        new = [name for name in columns if name not in self._explained]
        self._explained |= {*new}
        meanings = legend(self.study, new) | ({"-": UNKNOWN} if "-" in new else {})
        for name, meaning in meanings.items():
            console.out.print(f"  [bold]{escape(name.replace('_', ' '))}[/]: {escape(meaning)}")

    def end(self, site: Site, found: Any, plot: Path | None = None) -> None:
        """Print the conclusion, and write the figure to `plot`."""
        from feeders.report.conclusions import conclusion, figure
        from feeders.report.drawing import WIDE, pdf, png, svg
        from feeders.report.text import said

        if plot is not None:
            drawn = figure(site, self.study, found)
            if drawn is None:
                _no_figure(plot)
            else:
                sheet, about = drawn.draw(WIDE), {"title": drawn.title, "text": drawn.text}
                form = plot.suffix.lower()
                data = (
                    svg(sheet, key=drawn.name, alone=True, **about).encode()
                    if form == ".svg"
                    else (png if form == ".png" else pdf)(sheet, **about)
                )
                plot.parent.mkdir(parents=True, exist_ok=True)
                replace_file(plot, lambda new: new.write_bytes(data))
                console.say(f"{plot}: {drawn.title}")
        console.say(said(conclusion(site, self.study, found)))

    def nothing(self, site: Site, why: str, plot: Path | None) -> None:
        """Print the conclusion of a study that does not apply to the feeder."""
        if plot is not None:
            _no_figure(plot)
        console.say(f"Conclusion for {site.feeder.name} (not studied): none, {why}.")


def _no_figure(plot: Path) -> None:
    console.say(f"{plot}: not written, this result has no figure")


def tables(title: str, texts: Mapping[str, Sequence[str]], words: Collection[str], width: int) -> list[Table]:
    """Divide a table by columns into tables that fit the width, characters; numbers are never cut.

    texts: cells of each column. words: columns of words, which take several lines where room is short.
    Each table begins with the columns up to `meter`, otherwise with the first one.
    """
    names = [*texts]
    keys = names[: names.index("meter") + 1] if "meter" in names else names[:1]
    whole = {name: max(map(len, (name, *texts[name]))) for name in names}
    fits = sum(whole.values()) + _FRAME * len(names) < width
    least = {
        name: max(
            *map(len, name.split("_")), min(_WORDS if name in words else width, max(map(len, texts[name])))
        )
        for name in names
    }
    parts, room = [[*keys]], width - 1 - sum(least[name] + _FRAME for name in keys)
    left = room
    for name in names[len(keys) :]:
        left -= 0 if fits else least[name] + _FRAME
        if left < 0 and len(parts[-1]) > len(keys):
            parts.append([*keys])
            left = room - least[name] - _FRAME
        parts[-1].append(name)
    out = []
    for k, part in enumerate(parts, start=1):
        of = f" ({k} of {len(parts)})" if len(parts) > 1 else ""
        table = Table(title=f"{title}{of}", title_justify="left")
        for name in part:
            header = escape(name.replace("_", " " if fits else "\n"))
            table.add_column(header, no_wrap=name not in words, overflow="fold")
        for row in zip(*(texts[name] for name in part), strict=True):
            table.add_row(*map(escape, row))
        out.append(table)
    return out


def cell_text(cell: Any) -> str:
    """Text of a table's cell; a dash for an unknown number."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return ("∞" if cell > 0.0 else "−∞") if math.isinf(cell) else f"{cell + 0.0:.4g}"  # no −0
    return str(cell)

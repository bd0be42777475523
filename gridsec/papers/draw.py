"""Drawing of a figure's data with matplotlib, which is imported only on use.

No state of pyplot is used, the caller's settings are neither read nor changed, and no file is written: the
result is a matplotlib figure, or the bytes of a PNG. Both need the extra `plot`.
"""

from __future__ import annotations

import io
import re
import textwrap
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

    from gridsec.papers.claims import FigureCurve, Panel, PaperFigure

DPI: Final = 150
WIDTH: Final = 7.4  # inches, with room for legends beside the axes
# Okabe and Ito's colours, distinguishable with any colour vision; a dark red in place of their yellow, which
# is too pale on white.
PALETTE: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#882255")
FAINT: Final = "#9A9A9A"  # curves without a label, beside labelled ones
INK: Final = "#262626"
DASHES: Final[dict[str, str]] = {
    "solid": "-",
    "dashed": "--",
    "dotted": ":",
    "dashdot": "-.",
    "points": "none",
    "steps": "-",
}
ROUNDS: Final = ("-", "--", ":")  # the palette's second and third use
GREEK: Final = {
    "alpha": "α",
    "beta": "β",
    "gamma": "γ",
    "delta": "δ",
    "Delta": "Δ",
    "epsilon": "ε",
    "eta": "η",
    "theta": "θ",
    "kappa": "κ",
    "lambda": "λ",
    "Lambda": "Λ",
    "mu": "μ",
    "pi": "π",
    "rho": "ρ",
    "sigma": "σ",
    "tau": "τ",
    "phi": "φ",
    "Phi": "Φ",
    "omega": "ω",
}
SETTINGS: Final[dict[str, Any]] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same picture everywhere
    "font.size": 9.0,
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.edgecolor": "#8C8C8C",
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "text.color": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "xtick.color": "#8C8C8C",
    "ytick.color": "#8C8C8C",
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "legend.handlelength": 1.9,
    "legend.borderaxespad": 0.0,
    "legend.labelspacing": 0.35,
    "lines.linewidth": 1.4,
    "lines.markersize": 3.5,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.dpi": DPI,
    "agg.path.chunksize": 20000,
}


def available() -> bool:
    """True if figures can be drawn: matplotlib is installed."""
    return find_spec("matplotlib") is not None


def draw(figure: PaperFigure) -> Canvas:
    """Draw a figure: its caption, then its panels one below the other, legends beside the axes.

    A label has the same colour in every panel. Neighbouring panels over the same abscissa share it.

    Returns a matplotlib figure on an Agg canvas, of 150 dots per inch.
    Raises ModuleNotFoundError without matplotlib; see `available`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    caption = _typeset(textwrap.fill(figure.caption, 106))
    heights = [_height(panel, len(figure.panels)) for panel in figure.panels]
    extra = 0.3 + 0.17 * caption.count("\n")
    with _settings():
        layout = ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.08)
        canvas = Canvas(figsize=(WIDTH, sum(heights) + extra), layout=layout)
        FigureCanvasAgg(canvas)
        canvas.suptitle(caption, x=0.012, ha="left", fontsize=9.0, linespacing=1.3)
        rows = canvas.subplots(len(heights), 1, squeeze=False, gridspec_kw={"height_ratios": heights})
        parts = zip(rows[:, 0], figure.panels, _looks(figure.panels), heights, strict=True)
        for axes, panel, looks, height in parts:
            _panel(axes, panel, looks)
            axes.set_ylabel(_typeset(textwrap.fill(panel.y_label, int(14.0 * (height - 0.3)))))
        _share(list(rows[:, 0]), figure.panels)
        canvas.align_ylabels(list(rows[:, 0]))
    return canvas


def png(figure: PaperFigure) -> bytes:
    """Draw a figure as a PNG; the same data give the same bytes.

    Raises ModuleNotFoundError without matplotlib; see `available`.
    """
    canvas = draw(figure)
    buffer = io.BytesIO()
    about = {"Title": figure.name, "Description": figure.caption, "Software": None}
    with _settings():
        canvas.savefig(buffer, format="png", dpi=DPI, metadata=about)
    return buffer.getvalue()


def sheet(
    width: float,
    height: float,
    marks: Callable[[Axes], None],
    *,
    scale: float,
    about: Mapping[str, str | None],
    form: str = "png",
) -> bytes:
    """Draw on an empty sheet as a PNG or PDF; the same marks give the same bytes.

    width, height: size of the sheet, px; a px is a hundredth of an inch in `marks`.
    marks: draws on axes that cover the sheet, in px from its upper left corner.
    scale: dots per px.
    about: metadata of the file.
    form: png or pdf.
    Raises ModuleNotFoundError without matplotlib; see `available`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    buffer = io.BytesIO()
    with _settings():
        canvas = Canvas(figsize=(width / 100.0, height / 100.0))
        FigureCanvasAgg(canvas)
        axes = canvas.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        marks(axes)
        axes.set_xlim(0.0, width)
        axes.set_ylim(height, 0.0)
        canvas.savefig(buffer, format=form, dpi=100.0 * scale, metadata=cast("Any", dict(about)))
    return buffer.getvalue()


@contextmanager
def _settings() -> Iterator[None]:
    """Own settings on top of matplotlib's defaults, independent of the user's; undone afterwards."""
    from matplotlib import rc_context, rcdefaults, rcParams

    with rc_context():
        rcdefaults()
        rcParams.update(cast("Any", SETTINGS))
        yield


def _height(panel: Panel, count: int) -> float:
    """Height of a panel, inches: larger for a single panel and for a long legend."""
    labelled = sum(bool(line.label) for line in panel.lines)
    return float(max({1: 3.4, 2: 2.4}.get(count, 1.85), 0.6 + 0.19 * labelled))


def _typeset(text: str) -> str:
    """Greek letters, subscripts and signs of a plain text in print."""
    if "$" in text:
        return text
    text = re.sub(rf"(?<![A-Za-z])({'|'.join(GREEK)})(?![A-Za-z])", lambda name: GREEK[name[1]], text)
    text = re.sub(r"([α-ωΑ-Ω]) (\d)", r"\1_\2", text)
    text = re.sub(r"\b([auxyz])(\d+)\b", r"\1_\2", text)
    text = re.sub(r"\bxhat\b|\bx_hat\b", r"$\\mathregular{\\hat{x}}$", text)
    text = re.sub(r"(?<![\w$])([A-Za-zα-ωΑ-Ω])_(\w+)", r"$\\mathregular{\1_{\2}}$", text)
    return text.replace(" - ", " − ").replace("<=", "≤").replace(">=", "≥").replace("->", "→")


def _looks(panels: tuple[Panel, ...]) -> list[dict[str, tuple[Any, str]]]:
    """Colour and dashes of each label, per panel.

    Panels with a common label have a common assignment while the palette suffices; others start afresh.
    """
    families: list[dict[str, None]] = []
    for panel in panels:
        labels = {line.label: None for line in panel.lines if line.label}
        kin = [family for family in families if family.keys() & labels.keys()]
        merged = {label: None for family in (*kin, labels) for label in family}
        if len(merged) <= len(PALETTE):
            families = [family for family in families if family not in kin]
        families.append(merged if len(merged) <= len(PALETTE) else labels)
    looks = []
    for panel in panels:
        labels = {line.label: None for line in panel.lines if line.label}
        family = next((family for family in families if labels.keys() <= family.keys()), labels)
        looks.append(_shades(list(family)))
    return looks


def _shades(labels: list[str]) -> dict[str, tuple[Any, str]]:
    """Colour and dashes of each label of a family, by order of appearance."""
    count, most = len(labels), len(PALETTE)
    if count <= most * len(ROUNDS):
        return {label: (PALETTE[k % most], ROUNDS[k // most]) for k, label in enumerate(labels)}
    from matplotlib import colormaps

    # cividis without its palest end: ordered, and the same with any colour vision.
    return {
        label: (colour, "-")
        for label, colour in zip(labels, colormaps["cividis"](np.linspace(0.0, 0.85, count)), strict=True)
    }


def _panel(axes: Axes, panel: Panel, looks: dict[str, tuple[Any, str]]) -> None:
    from matplotlib.ticker import MaxNLocator

    alone = len(panel.lines) == 1
    for k, (line, width) in enumerate(zip(panel.lines, _widths(panel), strict=True)):
        # Without a label: the only curve, a group behind the others, or a dashed partner in front of them.
        crowd = line.style in {"solid", "steps"}
        colour, dashes = looks.get(line.label, (PALETTE[0] if alone else FAINT if crowd else INK, "-"))
        points = line.style == "points"
        axes.plot(
            line.x,
            line.y,
            color=colour,
            linestyle=dashes if DASHES[line.style] == "-" else DASHES[line.style],
            linewidth=width,
            marker="o" if points else "",
            markersize=4.0 + 3.0 * min(len(panel.lines) - 1 - k, 3),
            markeredgecolor="white" if points else colour,
            markeredgewidth=0.5,
            drawstyle="steps-post" if line.style == "steps" else "default",
            label=_typeset(line.label) or "_",
            zorder=2.0 if line.label or alone else 1.8 if crowd else 2.2,
            clip_on=not points,
        )
    axes.set_title(_typeset(panel.title) if panel.title != panel.y_label else "")
    axes.set_xlabel(_typeset(panel.x_label))
    axes.margins(x=0.02 if any(line.style == "points" for line in panel.lines) else 0.0, y=0.08)
    axes.set_xlim(*_ends(*_span(panel.lines), *axes.get_xlim()))
    said = alone and panel.y_label.startswith(panel.lines[0].label)
    if any(line.label for line in panel.lines) and not said:
        axes.legend(loc="upper left", bbox_to_anchor=(1.015, 1.0))
    for axis, values in ((axes.xaxis, [n.x for n in panel.lines]), (axes.yaxis, [n.y for n in panel.lines])):
        if _counts(values):
            axis.set_major_locator(MaxNLocator(nbins="auto", integer=True, steps=[1, 2, 5, 10]))
    low, high = axes.get_ylim()
    if _counts([line.y for line in panel.lines]) and high - low < 1.0:
        axes.set_ylim(low, low + 1.1)


def _share(rows: list[Axes], panels: tuple[Panel, ...]) -> None:
    """Give neighbours over the same abscissa the same limits, and tick labels to the lowest of them."""
    first = 0
    for k in range(1, len(rows) + 1):
        if k < len(rows) and _same_abscissa(panels[k - 1], panels[k]):
            rows[k - 1].set_xlabel("")
            rows[k - 1].tick_params(labelbottom=False)
            continue
        ends = [end for axes in rows[first:k] for end in axes.get_xlim()]
        for axes in rows[first:k]:
            axes.set_xlim(min(ends), max(ends))
        first = k


def _ends(low: float, high: float, left: float, right: float) -> tuple[float, float]:
    """Limits of an abscissa: those of the axes, or the round number just beyond the data."""
    span = high - low
    if span > 0.0:
        step = 10.0 ** np.floor(np.log10(span)) / 2.0
        if 0.0 <= (up := step * np.ceil(high / step)) - high < 0.02 * span:
            right = max(right, float(up))
        if 0.0 <= low - (down := step * np.floor(low / step)) < 0.02 * span:
            left = min(left, float(down))
    return left, right


def _widths(panel: Panel) -> list[float]:
    """Line widths in descending order, so that a curve under another one stays visible."""
    count = sum(bool(line.label) for line in panel.lines)
    if len(panel.lines) == 1:
        return [1.4]
    widths = iter(np.linspace(min(0.7 + 0.4 * count, 2.5) if count <= 8 else 1.2, 1.1, count))
    return [float(next(widths)) if line.label else 0.9 for line in panel.lines]


def _counts(values: list[Any]) -> bool:
    """True for an axis of few whole numbers, with ticks at whole numbers only."""
    every = np.concatenate([v[np.isfinite(v)] for v in values]) if values else np.empty(0)
    return bool(every.size and np.all(every == np.round(every)) and np.ptp(every) <= 25.0)


def _same_abscissa(upper: Panel, lower: Panel) -> bool:
    """True if two panels have the same abscissa, so that one set of tick labels suffices."""
    if upper.x_label != lower.x_label:
        return False
    a, b = _span(upper.lines), _span(lower.lines)
    return bool(np.allclose(a, b, rtol=0.0, atol=0.01 * max(a[1] - a[0], b[1] - b[0])))


def _span(lines: tuple[FigureCurve, ...]) -> tuple[float, float]:
    every = np.concatenate([line.x for line in lines]) if lines else np.empty(0)
    return (float(np.nanmin(every)), float(np.nanmax(every))) if every.size else (0.0, 0.0)

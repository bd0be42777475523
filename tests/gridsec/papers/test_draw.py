"""Figures: every point is drawn, no text is cut or lies on data, every eye tells the colours apart."""

from __future__ import annotations

import subprocess
import sys
import zlib
from itertools import combinations, pairwise

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure as Canvas
from matplotlib.transforms import Bbox

from gridsec.arrays import Floats
from gridsec.papers.claims import FigureCurve, Panel, PaperFigure, Style
from gridsec.papers.draw import DPI, FAINT, INK, PALETTE, WIDTH, draw, png

T = np.linspace(0.0, 10.0, 101)
DOTS = FigureCurve("", np.arange(11.0), np.ones(11), "points")
STYLES: tuple[Style, ...] = ("solid", "dashed", "dotted", "dashdot", "points", "steps")


def figure(*panels: Panel, caption: str = "What it shows") -> PaperFigure:
    return PaperFigure("name-1", caption, panels)


def panel(*lines: FigureCurve, x_label: str = "t in s") -> Panel:
    return Panel("Voltage", x_label, "v in V", lines)


def rich() -> PaperFigure:
    """Return a figure that asks for everything: all styles, gaps, many curves, long labels and caption."""
    gap = np.where((T > 3.0) & (T < 4.0), np.nan, np.sin(T))
    return figure(
        panel(
            *(
                FigureCurve(f"curve number {k} of six, {style}", T, gap + k, style)
                for k, style in enumerate(STYLES)
            )
        ),
        panel(FigureCurve("", T, np.round(T / 4.0), "steps"), x_label="k"),
        panel(*(FigureCurve(f"m{k:02d}", T, 1e-6 * np.cos(T + k)) for k in range(13))),
        panel(FigureCurve("", T, 1.5 * T), FigureCurve("", T, 2.5 * T), FigureCurve("mean", T, 2.0 * T)),
        Panel("Points", "t in s", "part of all windows in which a manipulated meter was named", (DOTS,)),
        caption="A caption of more than one line says in one sentence what there is to see in the picture. "
        * 2,
    )


def test_every_point_is_drawn_in_its_style() -> None:
    asked = rich()
    canvas = draw(asked)
    assert len(canvas.axes) == len(asked.panels)
    for axes, wanted in zip(canvas.axes, asked.panels, strict=True):
        assert axes.get_title(loc="left") == wanted.title
        assert axes.get_ylabel().replace("\n", " ") == wanted.y_label
        for drawn, line in zip(axes.lines, wanted.lines, strict=True):
            np.testing.assert_array_equal(np.asarray(drawn.get_xdata()), line.x)
            np.testing.assert_array_equal(np.asarray(drawn.get_ydata()), line.y)
            low, high = axes.get_ylim()
            assert low < np.nanmin(line.y)
            assert np.nanmax(line.y) < high
            assert (drawn.get_marker() == "o") == (line.style == "points")
            assert (drawn.get_linestyle() == "None") == (line.style == "points")
            assert (drawn.get_drawstyle() == "steps-post") == (line.style == "steps")
    legends = [axes.get_legend() for axes in canvas.axes]
    assert [None if each is None else [text.get_text() for text in each.get_texts()] for each in legends] == [
        [line.label for line in asked.panels[0].lines],
        None,
        [line.label for line in asked.panels[2].lines],
        ["mean"],
        None,
    ]


def touch(one: Bbox, other: Bbox) -> bool:
    """Whether two boxes overlap by more than the empty rim of their letters."""
    width = min(one.x1, other.x1) - max(one.x0, other.x0)
    height = min(one.y1, other.y1) - max(one.y0, other.y0)
    return width > 1.0 and height > 2.0


def test_no_text_is_cut_and_none_lies_on_data() -> None:
    canvas = draw(rich())
    canvas.canvas.draw()
    renderer = canvas.canvas.get_renderer()  # type: ignore[attr-defined]  # an Agg canvas has one
    paper = canvas.bbox
    beyond = {
        label
        for axes in canvas.axes
        for axis, ends in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim()))
        for tick in axis.get_major_ticks()
        if not ends[0] <= tick.get_loc() <= ends[1]
        for label in (tick.label1, tick.label2)
    }
    texts = [
        text
        for text in canvas.findobj(mpl.text.Text)
        if text.get_visible() and text.get_text() and text not in beyond
    ]
    assert len(texts) > 40
    for text in texts:
        box = text.get_window_extent(renderer)
        assert paper.x0 <= box.x0, text
        assert box.x1 <= paper.x1, text
        assert paper.y0 <= box.y0, text
        assert box.y1 <= paper.y1, text
    boxes = [text.get_window_extent(renderer) for text in texts]
    assert not [pair for pair in combinations(boxes, 2) if touch(*pair)]
    for axes in canvas.axes:
        assert axes.bbox.width > 0.5 * paper.width
        legend = axes.get_legend()
        if legend is not None:
            assert legend.get_window_extent(renderer).x0 > axes.bbox.x1
            assert legend.get_window_extent(renderer).height <= axes.get_tightbbox(renderer).height + 1.0


def test_neighbours_over_one_abscissa_share_it() -> None:
    one, other = panel(FigureCurve("", T, T)), panel(FigureCurve("", T + 5.0, T))
    labels = [axes.get_xlabel() for axes in draw(figure(one, one, other)).axes]
    assert labels == ["", "t in s", "t in s"]
    labels = [axes.get_xlabel() for axes in draw(figure(one, panel(FigureCurve("", T, T), x_label="k"))).axes]
    assert labels == ["t in s", "k"]
    upper, lower = draw(figure(one, panel(FigureCurve("", T, T, "points")))).axes
    assert upper.get_xlim() == lower.get_xlim()


def test_whole_numbers_have_ticks_at_whole_numbers() -> None:
    axes = draw(figure(panel(FigureCurve("", T, np.where(T < 5.0, 1.0, 2.0), "steps")))).axes[0]
    assert np.all(axes.get_yticks() == np.round(axes.get_yticks()))
    axes = draw(figure(panel(FigureCurve("", T, np.zeros(T.size), "points")))).axes[0]
    assert [y for y in axes.get_yticks() if axes.get_ylim()[0] <= y <= axes.get_ylim()[1]] == [0.0, 1.0]
    axes = draw(figure(panel(FigureCurve("", T, np.where(T < 5.0, 1.0, 1.5), "steps")))).axes[0]
    assert np.any(axes.get_yticks() != np.round(axes.get_yticks()))


def test_a_title_that_repeats_the_ordinate_is_left_out() -> None:
    titles = [axes.get_title(loc="left") for axes in draw(figure(Panel("x1", "k", "x1", (DOTS,)))).axes]
    assert titles == [""]


def colours(canvas: Canvas) -> list[list[str]]:
    return [[to_hex(line.get_color()).upper() for line in axes.lines] for axes in canvas.axes]


def test_a_label_keeps_its_colour() -> None:
    a, b, c, d = (FigureCurve(label, T, T) for label in "abcd")
    first, second, third, fourth = colours(
        draw(figure(panel(a, b), panel(b, c), panel(d), panel(d, FigureCurve("", T, T))))
    )
    assert [*first, second[1]] == list(PALETTE[:3])
    assert second[0] == first[1]
    assert third == [PALETTE[0]]
    assert fourth == [PALETTE[0], FAINT]


def test_large_families_have_colours_of_their_own_in_each_panel() -> None:
    first, second = ([FigureCurve(str(k), T, T) for k in range(*ends)] for ends in ((0, 5), (4, 10)))
    upper, lower = colours(draw(figure(panel(*first), panel(*second))))
    assert upper == list(PALETTE[:5])
    assert lower == list(PALETTE[:6])


@pytest.mark.parametrize("count", [13, 30])
def test_of_many_curves_each_looks_different(count: int) -> None:
    (axes,) = draw(figure(panel(*(FigureCurve(str(k), T, T + k) for k in range(count))))).axes
    assert len({(to_hex(line.get_color()), line.get_linestyle()) for line in axes.lines}) == count


def test_a_curve_under_another_still_shows() -> None:
    same = [
        FigureCurve(label, T, T, style) for label, style in (("a", "solid"), ("b", "steps"), ("c", "dashed"))
    ]
    points = [FigureCurve(label, T, T, "points") for label in "abc"]
    solid, dots = draw(figure(panel(*same), panel(*points))).axes
    widths = [line.get_linewidth() for line in solid.lines]
    sizes = [line.get_markersize() for line in dots.lines]
    assert all(under > over + 0.3 for under, over in pairwise(widths))
    assert all(under > over + 2.0 for under, over in pairwise(sizes))


def test_partners_without_a_label_lie_in_front() -> None:
    lines = (FigureCurve("true", T, T), FigureCurve("", T, T, "dashed"), FigureCurve("", T, -T))
    truth, partner, crowd = draw(figure(panel(*lines))).axes[0].lines
    assert partner.get_zorder() > truth.get_zorder() > crowd.get_zorder()
    assert [partner.get_color(), crowd.get_color()] == [INK, FAINT]


def test_letters_are_typeset() -> None:
    lines = (
        FigureCurve("pi_J, J without 3", T, T),
        FigureCurve("a2", T, T),
        FigureCurve("m02 -> c_in", T, T),
    )
    axes = draw(
        PaperFigure("n", "c", (Panel("sigma(t) of theta 1", "t in s", "xhat - x <= 1", lines),))
    ).axes[0]
    assert axes.get_title(loc="left") == r"σ(t) of $\mathregular{θ_{1}}$"
    assert axes.get_ylabel() == r"$\mathregular{\hat{x}}$ − x ≤ 1"
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        r"$\mathregular{π_{J}}$, J without 3",
        r"$\mathregular{a_{2}}$",
        r"m02 → $\mathregular{c_{in}}$",
    ]


# Machado, Oliveira, Fernandes: A physiologically-based model for simulation of color vision deficiency, 2009,
# at full severity, for linear RGB.
SIGHT = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def lab(colour: str, sight: Floats) -> Floats:
    """Return CIE 1976 L*a*b* of a colour as somebody sees it."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(sight @ linear, 0.0, 1.0)
    matrix = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = matrix @ seen / np.array([0.9505, 1.0, 1.089])
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("sight", SIGHT.values(), ids=SIGHT)
def test_every_eye_tells_the_colours_apart(sight: Floats) -> None:
    seen = [lab(colour, sight) for colour in (*PALETTE, "#FFFFFF")]
    apart = [np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i]]
    assert min(apart) > 12.0  # 2.3 is just noticeable


def chunks(data: bytes) -> dict[bytes, list[bytes]]:
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    found: dict[bytes, list[bytes]] = {}
    at = 8
    while at < len(data):
        size = int.from_bytes(data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        assert zlib.crc32(kind + body) == int.from_bytes(data[at + 8 + size : at + 12 + size])
        found.setdefault(kind, []).append(body)
        at += 12 + size
    return found


def test_a_png_is_sharp_named_and_always_the_same() -> None:
    asked = figure(panel(FigureCurve("", T, T)))
    data = png(asked)
    assert data == png(asked)
    parts = chunks(data)
    assert int.from_bytes(parts[b"IHDR"][0][:4]) == round(WIDTH * DPI)
    per_metre = int.from_bytes(parts[b"pHYs"][0][:4])
    assert per_metre * 0.0254 == pytest.approx(150.0, abs=0.5)
    assert sorted(parts[b"tEXt"]) == [b"Description\0What it shows", b"Title\0name-1"]


def test_settings_of_the_caller_are_neither_changed_nor_used() -> None:
    asked = figure(panel(FigureCurve("a", T, T), FigureCurve("b", T, -T)))
    expected = png(asked)
    with mpl.rc_context({"font.size": 30.0, "axes.facecolor": "black", "lines.linewidth": 9.0}):
        before = dict(mpl.rcParams)
        assert png(asked) == expected
        assert dict(mpl.rcParams) == before


def python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_nothing_is_imported_before_something_is_drawn() -> None:
    code = "import sys\nimport gridsec.papers.draw as d\nprint('matplotlib' in sys.modules, d.available())"
    assert python(code) == "False True"
    code = (
        "import sys\nimport numpy as np\nfrom gridsec.papers.draw import png\n"
        "from gridsec.papers.claims import PaperFigure, FigureCurve, Panel\n"
        "x = np.arange(3.0)\npng(PaperFigure('n', 'c', (Panel('t', 'x', 'y', (FigureCurve('', x, x),)),)))\n"
        "print('matplotlib.pyplot' in sys.modules)"
    )
    assert python(code) == "False"


def test_without_matplotlib_the_module_says_so() -> None:
    code = (
        "import sys\nsys.modules['matplotlib'] = None\nimport gridsec.papers.draw as d\nprint(d.available())"
    )
    assert python(code) == "False"

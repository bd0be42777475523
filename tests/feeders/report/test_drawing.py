"""Drawings: well formed whatever texts say, and legible in light and dark."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from feeders.report.drawing import (
    DARK,
    LIGHT,
    LOOKS,
    STEPS,
    Area,
    Disc,
    Drawing,
    Polyline,
    Text,
    svg,
    width_of,
)

SVG = "{http://www.w3.org/2000/svg}"


@given(st.text(), st.text())
def test_any_text_stays_text(name: str, tip: str) -> None:
    marks = (
        Text(1.0, 2.0, name),
        Disc(1.0, 2.0, 3.0, "solid", tip),
        Polyline(((0.0, 0.0), (1.0, 1.0)), "wire"),
    )
    root = ElementTree.fromstring(svg(Drawing(10.0, 10.0, marks), title=name, text=tip, key="k", alone=True))
    assert [each.tag for each in root] == [
        SVG + tag for tag in ("title", "desc", "style", "rect", "text", "circle", "path")
    ]
    kept = "".join(c if c >= " " and c not in "\ufffe\uffff" else "\ufffd" for c in name)
    assert root.findtext(f"{SVG}text") == kept


def test_neighbours_of_one_look_share_a_path() -> None:
    line = Polyline(((0.0, 0.0), (1.0, 0.5)), "wire")
    area = Area(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)), "solid")
    root = ElementTree.fromstring(
        svg(Drawing(5.0, 5.0, (line, line, area, line)), title="", text="", key="k")
    )
    assert [each.attrib["d"] for each in root.iter(f"{SVG}path")] == [
        "M0 0 1 0.5M0 0 1 0.5",
        "M0 0 1 0 1 1Z",
        "M0 0 1 0.5",
    ]


def luminance(colour: str) -> float:
    """Relative luminance as WCAG 2 defines it."""
    channels = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("palette", [LIGHT, DARK])
def test_colours_can_be_told_from_what_they_are_on(palette: dict[str, str]) -> None:
    for name in ("ink", "quiet"):
        assert contrast(palette[name], palette["card"]) >= 4.5
    for name in ("a", "b", "c", "d", "bad", "wire"):
        assert contrast(palette[name], palette["card"]) >= 3.0
    for name in ("a", "c", "bad"):
        assert contrast(palette["on"], palette[name]) >= 4.5


@pytest.mark.parametrize("palette", [LIGHT, DARK])
def test_a_scale_is_one_for_those_who_see_no_colours(palette: dict[str, str]) -> None:
    steps = [luminance(palette[f"s{k}"]) for k in range(STEPS)]
    assert steps == sorted(steps, reverse=palette is LIGHT)
    assert all(contrast(palette[f"s{k}"], palette[f"s{k + 1}"]) > 1.25 for k in range(STEPS - 1))


def test_every_look_has_its_colours() -> None:
    assert LIGHT.keys() == DARK.keys()
    for look in LOOKS.values():
        assert {look.fill, look.stroke} - {""} <= LIGHT.keys()


def test_widths_are_rather_too_wide() -> None:
    fonts = pytest.importorskip("matplotlib.textpath")
    from matplotlib.font_manager import FontProperties

    for text in ("m001", "LV1.101 Load 13", "noticed, another may be named", "0.11 V"):
        path = fonts.TextPath((0.0, 0.0), text, size=100.0, prop=FontProperties(family="DejaVu Sans"))
        wide = path.get_extents().width / 100.0
        assert 0.8 * wide < width_of(text, 1.0) < 1.25 * wide

"""Maps and layouts: everybody on the sheet, nobody on top of another; scales that hold what they show."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.mesh import baran_wu, european, landnetz, rural3
from feeders.model.site import Site, load, names
from feeders.report.drawing import NARROW, STEPS, WIDE, Disc, Polyline, Text, width_of
from feeders.report.maps import Shape, Spot, _crossed, draw_map, has_places, place, steps_of


@pytest.fixture(scope="module", params=names())
def feeder(request: pytest.FixtureRequest) -> Site:
    return load(request.param)


@pytest.mark.parametrize("width", [WIDE, NARROW])
@pytest.mark.parametrize("real", [True, False])
def test_everybody_is_on_the_sheet_and_on_a_line(feeder: Site, width: float, *, real: bool) -> None:
    site = feeder if real else replace(feeder, xy=None)
    at = place(site, width)
    assert at.real == (real and has_places(site))
    points = [*at.customers, *(point for wire in (*at.wires, *at.drops) for point in wire)]
    assert all(0.0 <= x <= at.width and 0.0 <= y <= at.height for x, y in points)
    assert len({(round(x, 2), round(y, 2)) for x, y in at.customers}) == site.feeder.bus.size
    if at.real:
        assert len(at.wires) == site.feeder.parent.size
        return
    apart = min(math.dist(a, b) for k, a in enumerate(at.customers) for b in at.customers[k + 1 :])
    assert apart > 7.0
    ends = {end for drop in at.drops for end in drop[1:]}
    assert set(at.customers) == ends


@pytest.mark.parametrize("width", [WIDE, NARROW])
@pytest.mark.parametrize("make", [baran_wu, rural3, landnetz, european])
def test_ties_end_on_the_lines_they_join(make: Callable[[], Site], width: float) -> None:
    site = make()
    for shown in (site, replace(site, xy=None)):
        at = place(shown, width)
        assert len(at.ties) == len(site.ties) > 0
        assert all(0.0 <= x <= at.width and 0.0 <= y <= at.height for tie in at.ties for x, y in tie)
        lit = [pair for wire in (at.busbar, *at.wires) for pair in pairwise(wire)]
        for tie in at.ties:
            assert _touches(tie[0], lit)
            assert _touches(tie[-1], lit)
            assert tie[0] != tie[-1]
    drawn = draw_map(site, [Spot(Shape.METER)] * site.feeder.bus.size, width, legend={})
    assert len(
        [mark for mark in drawn.marks if isinstance(mark, Polyline) and mark.look == "line-wire"]
    ) == len(site.ties)


def test_streets_of_a_tree_do_not_share_a_place(feeder: Site) -> None:
    at = place(replace(feeder, xy=None), WIDE)
    streets = [wire for wire in at.wires if len(wire) == 2 and wire[0][1] == wire[1][1]]
    spans = sorted((a[1], a[0], b[0]) for a, b in streets if b[0] > a[0])
    for (row, _, end), (other, start, _) in pairwise(spans):
        assert row != other or start >= end - 1e-9


def test_the_tree_has_every_street_of_its_feeder(feeder: Site) -> None:
    """Whoever walks along the lines of the picture from the busbar reaches everybody."""
    at = place(replace(feeder, xy=None), WIDE)
    lit = [(at.busbar[0], at.busbar[1])]
    todo = [*at.wires, *at.drops]
    changed = True
    while changed:
        near = [wire for wire in todo if _touches(wire[0], lit)]
        lit += [pair for wire in near for pair in pairwise(wire)]
        todo = [wire for wire in todo if wire not in near]
        changed = bool(near)
    assert not todo


def _touches(point: tuple[float, float], lit: list[tuple[tuple[float, float], tuple[float, float]]]) -> bool:
    x, y = point
    return any(
        min(a[0], b[0]) - 0.01 <= x <= max(a[0], b[0]) + 0.01
        and min(a[1], b[1]) - 0.01 <= y <= max(a[1], b[1]) + 0.01
        for a, b in lit
    )


def test_labels_do_not_cover_each_other(feeder: Site) -> None:
    ids = dict(zip(feeder.meters.tolist(), feeder.meter_ids, strict=True))
    spots = [Spot(Shape.METER, ids.get(k, "")) for k in range(feeder.feeder.bus.size)]
    drawing = draw_map(feeder, spots, WIDE, legend={"meter": Spot(Shape.METER)})
    boxes = []
    for mark in drawing.marks:
        if isinstance(mark, Text) and mark.look == "label":
            long = width_of(mark.text, mark.size)
            left = mark.x - {"start": 0.0, "middle": 0.5, "end": 1.0}[mark.anchor] * long
            boxes.append((left, mark.y - 9.0, left + long, mark.y + 2.0))
    assert boxes
    for k, a in enumerate(boxes):
        assert a[0] >= 0.0
        assert a[2] <= WIDE
        assert not any(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3] for b in boxes[k + 1 :])


@given(*[st.floats(-20.0, 20.0)] * 4)
def test_a_line_crosses_a_box_if_a_point_of_it_is_inside(x0: float, y0: float, x1: float, y1: float) -> None:
    box = (-5.0, -3.0, 5.0, 3.0)
    along = np.linspace(0.0, 1.0, 2001)
    x, y = x0 + along * (x1 - x0), y0 + along * (y1 - y0)
    depth = float(np.max(np.minimum(np.minimum(x + 5.0, 5.0 - x), np.minimum(y + 3.0, 3.0 - y))))
    assume(abs(depth) > 0.1)  # not where points 0.03 apart cannot tell
    assert _crossed(box, np.array([[x0, y0, x1, y1]])) == (depth > 0.0)


def test_labels_keep_off_the_lines_where_there_is_room() -> None:
    site = load("cigre-lv")
    names_ = [Spot(Shape.METER, f"{name}: 2.19") for name in site.meter_ids]
    drawing = draw_map(site, names_, WIDE, legend={})
    lines = np.array([(*a, *b) for wire in place(site, WIDE).wires for a, b in pairwise(wire)])
    labels = [mark for mark in drawing.marks if isinstance(mark, Text) and mark.look == "label"]
    assert len(labels) == len(names_)
    for mark in labels:
        long = width_of(mark.text, mark.size)
        left = mark.x - {"start": 0.0, "middle": 0.5, "end": 1.0}[mark.anchor] * long
        assert not _crossed((left, mark.y - 9.0, left + long, mark.y + 2.0), lines)


@given(st.lists(st.floats(0.0, 1e6), min_size=1, max_size=20))
def test_a_scale_holds_all_values(values: list[float]) -> None:
    assume(all(v == 0.0 or v > 1e-6 for v in values))
    scale = steps_of(values, "V")
    assert len(scale.limits) == STEPS + 1
    for value in values:
        step = scale.step(value)
        slack = 1e-9 * max(scale.limits)
        assert scale.limits[step] - slack <= value <= scale.limits[step + 1] + slack
    assert len(scale.names()) == STEPS


def test_what_is_all_but_the_same_looks_the_same() -> None:
    scale = steps_of([3.9999, 4.0, 4.08], "V")
    assert len({scale.step(v) for v in (3.9999, 4.0, 4.08)}) == 1


def test_larger_is_larger() -> None:
    site = load("cigre-lv")
    spots = [Spot(Shape.STEP, step=k % STEPS) for k in range(site.feeder.bus.size)]
    drawing = draw_map(site, spots, WIDE, legend={})
    radii = {mark.look: mark.r for mark in drawing.marks if isinstance(mark, Disc)}
    assert [radii[f"step{k}"] for k in range(STEPS)] == sorted(radii[f"step{k}"] for k in range(STEPS))

"""A report of a feeder in three phases: everybody's phase is in the maps and in the tables."""

from __future__ import annotations

import re
from collections import Counter

import pytest

from feeders.model.site import Site, from_tables
from feeders.report.build import Report, report
from feeders.report.drawing import NARROW, WIDE, Polyline
from feeders.report.html import StudyOutcome
from feeders.report.maps import LEGS, Shape, Spot, draw_map
from feeders.studies.droop.study import DroopOptions, droop
from feeders.studies.redundancy import redundancy
from tests.feeders.report.about import ABOUT
from tests.feeders.studies.three_phases import mixed


@pytest.fixture(scope="module")
def phased() -> Site:
    return from_tables(mixed("simbench-lv-rural1", coupled=True))


@pytest.fixture(scope="module")
def whole(phased: Site) -> Report:
    options = DroopOptions(presets=("ieee1547-b",), tau_factors=(1.0,))
    outcomes = [
        StudyOutcome("redundancy", redundancy(phased, silent=["m02"])),
        StudyOutcome("droop", droop(phased, options)),
    ]
    return report(phased, outcomes, ABOUT)


def test_a_feeder_in_phases_says_how_many_are_on_which(phased: Site, whole: Report) -> None:
    each = Counter(row.phases for row in phased.tables.customers)
    assert f"{each['a']} on a, {each['b']} on b, {each['c']} on c" in whole.html
    assert "Three-phase power flow." in whole.html
    assert "No answer" not in whole.html
    phase = {row.customer: row.phases for row in phased.tables.customers}
    table = whole.tables["droop-customers"]
    assert table["phase"].tolist() == [phase[name] for name in table["customer"]]
    meters = whole.tables["redundancy-meters"]
    assert [bus[-2:] for bus in meters["bus"]] == [f".{phase[name]}" for name in meters["customer"]]
    assert all(re.search(f"{name}, {letter}<", whole.html) for name, letter in phase.items())


@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_everybody_has_the_leg_of_its_phase(phased: Site, width: float) -> None:
    spots = [Spot(Shape.METER, tip=name) for name in phased.feeder.customers]
    drawn = draw_map(phased, spots, width, legend={"meter": Spot(Shape.METER)})
    legs = [mark for mark in drawn.marks if isinstance(mark, Polyline) and mark.look == "line-ink"]
    assert len(legs) == len(spots) + len(LEGS)
    # Right of its place and above, below, left and above.
    ends = [(b[0] > a[0] + 1e-6) - (b[0] < a[0] - 1e-6) for a, b in (leg.points for leg in legs)]
    each = Counter(row.phases for row in phased.tables.customers)
    assert Counter(ends) == {1: each["a"] + 1, 0: each["b"] + 1, -1: each["c"] + 1}
    tips = {mark.tip for mark in drawn.marks if getattr(mark, "tip", "")}
    for row in phased.tables.customers:
        assert f"{row.customer}, phase {row.phases}" in tips

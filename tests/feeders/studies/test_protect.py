"""The protection study on a real feeder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from feeders.model.site import from_tables, load, unread
from feeders.simulation.powerflow import PowerFlow
from feeders.studies.operating import box, false_powers, squared, volts_of_lie
from feeders.studies.protect import Goal, protect
from feeders.studies.unobservable import Attack, CurvePositions
from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.planning.stealthy_attacks import largest_lie, largest_story
from tests.codes import refused
from tests.feeders import stations
from tests.journals import rows

RURAL = load("simbench-lv-rural1")
UNKNOWN = ("LV1.101 Load 4", "LV1.101 Load 8")


def test_unknown_loads_ask_for_one_meter_of_each_street() -> None:
    found = protect(RURAL, max_attacked=2, unknown=UNKNOWN)
    # Load 8 has a street of its own, and Load 4 one with two other meters.
    assert (found.before, found.after) == (1.0, np.inf)
    assert len(found.meters) == 2
    assert found.gap == 0
    assert "m08" in found.meters["meter"].tolist()
    assert set(found.meters["meter"]) & {"m04", "m05", "m12"}


def test_to_notice_asks_for_no_more_than_to_identify() -> None:
    seen = [
        protect(RURAL, max_attacked=1, unknown=UNKNOWN, goal=goal) for goal in (Goal.NOTICE, Goal.IDENTIFY)
    ]
    assert [len(each.meters) for each in seen] == [1, 1]
    # Two liars of Load 4's street cannot imitate it: it moves three meters.
    assert seen[1].after == 3.0


def test_who_moves_only_his_own_meter_is_protected_or_nobody_notices() -> None:
    site = load("cigre-lv")
    asked = {"max_attacked": 1, "unknown": ["Load R15"], "goal": Goal.NOTICE}
    found = protect(site, **asked)
    assert found.meters["meter"].tolist() == ["m03"]
    assert (found.before, found.least) == (1.0, 1)
    assert found.after > 1.0
    with refused(DesignInfeasible, "unprotectable") as caught:
        protect(site, **asked, never=["m03"])
    assert "m03 alone" in str(caught.value)


def test_lies_stay_below_the_bound_in_volts() -> None:
    found = protect(RURAL, max_attacked=2, goal=Goal.BOUND, lie_volt=4.5)
    assert found.before > 4.5 >= found.after > 0.0
    # The two at the ends of the longest street.
    assert found.meters["meter"].tolist() == ["m06", "m13"]
    assert volts_of_lie(230.9, squared(230.9, 4.5)) == pytest.approx(4.5)
    given = box(RURAL)
    sizes = [volts_of_lie(RURAL.feeder.base_volt, largest_lie(given, j, 2).size) for j in range(13)]
    assert sorted(np.argsort(sizes)[-2:].tolist()) == [5, 12]


def test_a_bound_is_the_same_part_of_every_level() -> None:
    """250 V of 11 547 V are 5 V of 230.94 V: a lie as large as a street's voltage is no small one."""
    site = from_tables(stations.tables())
    given, part = box(site), 250.0 / stations.MV
    sizes = np.array([largest_lie(given, j, 1).bound for j in range(site.meters.size)])
    lies = volts_of_lie(site.customer_volt, sizes) / site.customer_nominal
    np.testing.assert_array_equal(lies > part, site.customer_nominal == stations.LV)
    found = protect(site, max_attacked=1, goal=Goal.BOUND, lie_volt=250.0)
    assert set(found.meters["customer"]) == {site.feeder.customers[k] for k in np.flatnonzero(lies > part)}
    assert found.before == pytest.approx(lies.max() * stations.MV)
    assert found.after <= 250.0


def test_what_cannot_be_done_is_told_with_names() -> None:
    with refused(DesignInfeasible, "unprotectable") as caught:
        protect(RURAL, max_attacked=2, unknown=UNKNOWN, never=["m08"])
    assert "m08 alone" in str(caught.value)
    with refused(InputInvalid, "not-positive"):
        protect(RURAL, max_attacked=2, goal=Goal.BOUND)
    with refused(InputInvalid, "not-positive"):
        protect(RURAL, max_attacked=0)


def test_attacks_are_kept_in_the_journal(tmp_path: Path) -> None:
    class Interrupted(Exception):
        pass

    def interrupt(attacks: int, protected: int) -> None:
        if attacks == 3:
            raise Interrupted(protected)

    journal = tmp_path / "journal"
    arguments = {"max_attacked": 1, "attack": Attack.ANY, "unknown": RURAL.feeder.customers[:5]}
    with pytest.raises(Interrupted):
        protect(RURAL, **arguments, journal=journal, progress=interrupt)
    kept = rows(journal)
    assert kept
    again = protect(RURAL, **arguments, journal=journal)
    assert kept.items() <= rows(journal).items()
    whole = protect(RURAL, **arguments)
    assert again.meters.equals(whole.meters)
    assert again.attacks.equals(whole.attacks)


@pytest.mark.parametrize(
    ("asked", "codes"),
    [
        ({"goal": "all"}, ["unknown-name"]),
        ({"goal": Goal.BOUND, "lie_volt": 6.0, "busbar_known": False}, ["inconsistent"]),
        ({"goal": Goal.BOUND, "lie_volt": 6.0, "unknown": UNKNOWN}, ["inconsistent"]),
        ({"goal": Goal.IDENTIFY, "lie_volt": 8.0}, ["inconsistent"]),
        ({"lie_volt": 8.0, "busbar_known": False}, ["inconsistent"]),
        ({"lie_volt": 8.0, "attack": Attack.ANY}, ["inconsistent"]),
        ({"goal": Goal.NOTICE, "share": 0.2}, ["inconsistent"]),
        (
            {"goal": "bound", "max_attacked": 0, "curves": "x"},
            ["unknown-name", "not-positive", "not-positive"],
        ),
    ],
)
def test_nothing_that_was_asked_is_left_out_of_account(asked: dict[str, Any], codes: list[str]) -> None:
    with refused(InputInvalid, *codes):
        protect(RURAL, **({"max_attacked": 1} | asked))


def test_the_text_of_a_goal_is_the_goal() -> None:
    site = load("cigre-lv")
    given: dict[str, Any] = {"max_attacked": 1, "lie_volt": 8.0}
    text = protect(site, goal="bound", curves="steepest", attack="persistent", **given)
    assert text.goal is Goal.BOUND
    assert text.before == protect(site, goal=Goal.BOUND, curves=CurvePositions.STEEPEST, **given).before
    assert text.before != protect(site, goal=Goal.BOUND, curves=CurvePositions.DEADBAND, **given).before


# ------------------------------------------------------------------------------------ false powers


def test_the_usual_goal_is_what_says_something_of_the_feeder() -> None:
    """Who cannot stay invisible may lie within honest errors; who can is to be identified."""
    assert protect(RURAL, max_attacked=2, unknown=UNKNOWN).goal is Goal.IDENTIFY
    assert protect(RURAL, max_attacked=1, busbar_known=False).goal is Goal.IDENTIFY
    found = protect(RURAL, max_attacked=2)
    assert found.goal is Goal.CONTAIN
    assert not found.no_answer
    # Half of what company and false powers add is gone.
    assert found.alone < found.after <= found.lie_volt < found.before
    assert found.lie_volt == pytest.approx(0.5 * (found.alone + found.before), abs=0.01)
    assert protect(RURAL, max_attacked=2, lie_volt=6.0).lie_volt == 6.0
    for goal in (Goal.IDENTIFY, Goal.NOTICE):
        nothing = protect(RURAL, max_attacked=2, goal=goal)
        assert nothing.no_answer
        assert (len(nothing.meters), nothing.before) == (0, np.inf)
    with refused(InputInvalid, "inconsistent"):
        protect(RURAL, max_attacked=1, goal=Goal.CONTAIN, busbar_known=False)
    with refused(InputInvalid, "not-positive"):
        protect(RURAL, max_attacked=1, lie_volt=-1.0)


@pytest.mark.acceptance
def test_containment_is_the_fewest_by_trying_all_on_a_small_feeder() -> None:
    """Oracle: all 64 protections of six meters; false powers only make lies larger."""
    site = load("cigre-lv")
    given = false_powers(site)
    found = protect(site, max_attacked=2)
    enough = []
    for bits in range(64):
        honest = (bits >> np.arange(6)) % 2 == 1
        sizes = [largest_story(given, j, 2, honest=honest).bound for j in range(6)]
        if volts_of_lie(site.customer_volt, np.array(sizes)).max() <= found.lie_volt:
            enough.append(int(honest.sum()))
    assert len(found.meters) == found.least == min(enough)
    true = protect(site, max_attacked=2, goal=Goal.BOUND, lie_volt=found.lie_volt)
    assert true.before < found.before
    assert true.before == pytest.approx(found.alone, rel=1e-5)


def test_a_lie_with_false_powers_is_told_by_an_honest_feeder() -> None:
    """Two AC power flows at both ends of the unknowns: all meters but the liar read the same within errors.

    One is the truth, the other what is told. The linear model is off by some percent of what loads do.
    """
    site = load("cigre-lv")
    given, middle, flow = false_powers(site), unread(site), PowerFlow(site)
    j, base, count = site.meter_ids.index("m03"), site.feeder.base_kva, site.feeder.bus.size
    found = largest_story(given, j, 1)
    assert found.liars.tolist() == [j]
    off = found.unknowns * np.where(given.owner == j, 1.0, given.honest)
    ends = []
    for sign in (1.0, -1.0):
        p = middle.p + sign * off[:count] * middle.p_error
        q = middle.q + sign * off[count : 2 * count] * middle.q_error
        v0 = np.sqrt(1.0 + sign * off[-1] * given.box.effect[0, -1])
        ends.append(flow.solve(-base * p, -base * q, site.feeder.base_volt * v0)[0])
    apart = np.abs(ends[0] - ends[1]) / site.customer_volt
    # Squares are twice as far apart; what the meter's own error adds to the lie is not in the voltages.
    assert apart[j] == pytest.approx(0.5 * found.size - given.box.reading[j], rel=0.1)
    assert (np.delete(apart - 1.1 * given.box.reading, j) <= 0.0).all()
    assert apart[j] > 3.0 * given.box.reading[j]

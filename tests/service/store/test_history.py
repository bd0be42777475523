from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gridsec.interface import Cause, Decision
from service.report.report import FeederReport, HistoryRow, MeterState
from service.store.series import HistoryRules, mark, pack, unpack, worth_keeping

numbers = st.none() | st.floats(allow_nan=False, allow_infinity=False, width=32)
meters = st.builds(
    MeterState,
    meter=st.text(max_size=5),
    bus=st.just("b"),
    seen=st.booleans(),
    suspect=st.booleans(),
    score=numbers,
    threshold=numbers,
    v_volt_reported=numbers,
    v_volt_estimated=numbers,
    v_volt_std=st.none(),
    v2_pu_estimated=st.none(),
    attack_volt_estimated=st.none(),
)


def near(kept: float | None, true: float | None) -> bool:
    """Seven digits, but nothing smaller than what single precision can tell from zero."""
    if kept is None or true is None:
        return kept is true
    return abs(kept - true) <= 1e-6 * abs(true) + 1e-44


def row_of(made: list[MeterState]) -> HistoryRow:
    """Row of a report with these meters; the busbar meter is the last one."""
    report = FeederReport(
        "village", 0.0, Decision.CLEAN, "", Cause.AGREEMENT, 2, tuple(made), (), (), None, None
    )
    return report.row


@given(st.lists(meters, max_size=12, unique_by=lambda m: m.meter))
def test_what_was_packed_comes_out(made: list[MeterState]) -> None:
    row = row_of(made)
    data, ids = pack(row), row.meters
    whole = unpack(data, ids)
    assert whole["meter"] is None
    assert whole["seen"] == sum(m.seen for m in made)
    assert whole["suspects"] == [m.meter for m in made if m.suspect]
    volts = [m.v_volt_estimated for m in made if m.v_volt_estimated is not None]
    assert near(whole["v_volt_lowest"], min(volts, default=None))
    assert near(whole["v_volt_highest"], max(volts, default=None))
    for m in made:
        one = unpack(data, ids, m.meter)["meter"]
        assert (one["meter"], one["seen"], one["suspect"]) == (m.meter, m.seen, m.suspect)
        for name in ("v_volt_reported", "v_volt_estimated", "score", "threshold"):
            assert near(one[name], getattr(m, name))
    assert unpack(data, ids, "nobody's meter")["meter"] is None


def test_a_row_of_146_meters_is_small() -> None:
    draw = np.random.default_rng(1)
    made = [
        MeterState(
            f"m{k}",
            "b",
            True,
            False,
            draw.random(),
            0.01,
            230 + draw.random(),
            230 + draw.random(),
            *[None] * 3,
        )
        for k in range(146)
    ]
    assert len(pack(row_of(made))) < 2200


def a_report(t: float, *, cause: Cause = Cause.AGREEMENT) -> FeederReport:
    verdict = Decision.CLEAN if cause is Cause.AGREEMENT else Decision.UNDECIDED
    return FeederReport("village", t, verdict, "", cause, 2, (), (), (), 207.0, 253.0)


def test_the_grid_and_every_change_are_kept() -> None:
    rules = HistoryRules(step_s=10.0)
    now = mark(a_report(1000.0))
    assert worth_keeping(None, now, rules)
    assert not worth_keeping(now, mark(a_report(1009.9)), rules)
    assert worth_keeping(now, mark(a_report(1010.0)), rules)
    assert worth_keeping(now, mark(a_report(1001.0, cause=Cause.AMBIGUOUS)), rules)
    assert worth_keeping(now, mark(a_report(999.0)), rules)
    assert worth_keeping(now, mark(a_report(1000.5)), HistoryRules(step_s=0.0))
    # Ticks that miss the grid's points are kept all the same: one per step.
    assert worth_keeping(mark(a_report(1009.0)), mark(a_report(1011.0)), rules)

"""Studies in three phases: those that do not touch are three balanced feeders; the monitor keeps promises."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from feeders.model.site import from_tables
from feeders.studies.campaign.guarantees import Rehearsal, rehearse
from feeders.studies.detectable import detectable
from feeders.studies.operating import box
from feeders.studies.protect import Goal, protect
from feeders.studies.redundancy import SILENT, Redundancy, redundancy
from gridsec.planning.stealthy_attacks import largest_lie, worst_error
from tests.feeders.studies.three_phases import apart, mixed

WHOLE, ALONE = apart("simbench-lv-rural1")


def of_meters(found: list[Redundancy]) -> pd.DataFrame:
    columns = ["case", "meter", "index_persistent", "critical", "index_any"]
    return pd.concat([each.meters[columns] for each in found]).sort_values(["case", "meter"])


def blind(found: Redundancy) -> set[str]:
    names = found.summary.loc[found.summary["case"] == SILENT, "blind"]
    return {name for row in names for name in row.split(", ")} - {""}


@pytest.mark.parametrize("busbar_known", [True, False])
def test_redundancy_without_coupling_is_that_of_each_phase(busbar_known: bool) -> None:
    silent = ["m04", "m08", "m09"]
    assert [sum(m in site.meter_ids for m in silent) for site in ALONE] == [1, 1, 1]
    whole = redundancy(WHOLE, silent=silent, busbar_known=busbar_known)
    alone = [
        redundancy(site, silent=[m for m in silent if m in site.meter_ids], busbar_known=busbar_known)
        for site in ALONE
    ]
    pd.testing.assert_frame_equal(
        of_meters([whole]).reset_index(drop=True), of_meters(alone).reset_index(drop=True)
    )
    # A part has all phases of its buses: its weakest phase decides.
    parts = whole.parts[whole.parts["case"] == SILENT].set_index("bus")
    of_each = [each.parts[each.parts["case"] == SILENT].set_index("bus") for each in alone]
    everywhere = parts.index.intersection(of_each[0].index.intersection(of_each[1].index))
    everywhere = everywhere.intersection(of_each[2].index)
    assert everywhere.size
    weakest = np.min([each.loc[everywhere, "index_persistent"] for each in of_each], axis=0)
    assert parts.loc[everywhere, "index_persistent"].tolist() == weakest.tolist()
    assert blind(whole) == set.union(*map(blind, alone))


def test_protection_without_coupling_is_that_of_each_phase_together() -> None:
    unknown = [site.feeder.customers[1] for site in ALONE]
    whole = protect(WHOLE, max_attacked=1, unknown=unknown)
    alone = [protect(site, max_attacked=1, unknown=[site.feeder.customers[1]]) for site in ALONE]
    assert len(whole.meters) == sum(len(each.meters) for each in alone) > 0
    assert whole.before == min(each.before for each in alone)
    for volt in (12.0, 14.0):
        bounds = [
            protect(site, max_attacked=1, goal=Goal.BOUND, lie_volt=volt, share=0.2)
            for site in (WHOLE, *ALONE)
        ]
        assert len(bounds[0].meters) == sum(len(each.meters) for each in bounds[1:])
        assert bounds[0].before == pytest.approx(max(each.before for each in bounds[1:]), rel=1e-6)


def test_lies_that_fit_are_those_of_each_phase() -> None:
    given, alone = box(WHOLE), [box(site) for site in ALONE]
    names = [site.meter_ids for site in ALONE]
    for j, name in enumerate(WHOLE.meter_ids):
        k = next(k for k in range(3) if name in names[k])
        same = largest_lie(alone[k], names[k].index(name), 2).size
        # A second liar in another phase would not help.
        assert largest_lie(given, j, 2).size == pytest.approx(same, rel=1e-6)
    errors = [worst_error(given, i, 1).size for i in range(len(WHOLE.feeder.customers))]
    for site, each in zip(ALONE, alone, strict=True):
        for i, name in enumerate(site.feeder.customers):
            k = WHOLE.feeder.customers.index(name)
            assert errors[k] == pytest.approx(worst_error(each, i, 1).size, rel=1e-6)


@pytest.mark.acceptance
def test_the_monitor_keeps_what_is_promised_in_three_phases() -> None:
    site = from_tables(mixed("cigre-lv", coupled=True))
    found = detectable(site, max_attacked=2)
    table = found.meters
    assert set(table["bus"].str[-1]) == set("abc")
    for suffix in ("_alone", ""):
        assert (table[f"hidden{suffix}"] > 0.0).all()
        assert (table[f"hidden{suffix}"] < table[f"noticed{suffix}"]).all()
        assert (table[f"noticed{suffix}"] <= table[f"named{suffix}"]).all()
    assert rehearse(site, found, trials=30, seed=3) == Rehearsal(30, 0, 0, 0)
    # It can fail: of lies a third as large as those that are surely noticed, most are not named.
    small = 0.3 * table["noticed_alone"]
    smaller = table.assign(named=small, named_alone=small)
    wrong = type(found)(found.feeder, found.digest, 1, found.risk, smaller, found.customers)
    assert rehearse(site, wrong, trials=8, seed=3).large_missed > 4
    assert np.isfinite(found.customers[["error", "error_fits"]].to_numpy()).all()

"""Sizes of lies on real feeders, and the monitor itself watching lies of these sizes."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from feeders.model.site import load
from feeders.studies.campaign.guarantees import Rehearsal, rehearse
from feeders.studies.detectable import Detectable, detectable, workers
from feeders.studies.running import Here, Processes
from gridsec.errors import InputInvalid
from tests.codes import refused
from tests.feeders.studies.rural import RURAL, rural_sizes

CIGRE = load("cigre-lv")


@pytest.fixture(scope="module")
def cigre() -> Detectable:
    return detectable(CIGRE, max_attacked=2)


def test_sizes_are_in_order(cigre: Detectable) -> None:
    table = cigre.meters
    assert len(table) == 6
    for suffix in ("_alone", ""):
        assert (table[f"hidden{suffix}"] > 0.0).all()
        assert (table[f"hidden{suffix}"] < table[f"noticed{suffix}"]).all()
        assert (table[f"noticed{suffix}"] <= table[f"named{suffix}"]).all()
        assert (table[f"fits{suffix}"] <= table[f"identified{suffix}"] + 1e-6).all()
    for name in ("hidden", "noticed", "named", "fits", "identified"):
        assert (table[f"{name}_alone"] <= table[name] * (1 + 1e-4)).all()
    assert (cigre.customers[["error", "error_fits"]] > 0.0).all(axis=None)


def test_the_monitor_keeps_what_is_promised_on_a_small_feeder(cigre: Detectable) -> None:
    assert rehearse(CIGRE, cigre, trials=40, seed=3) == Rehearsal(40, 0, 0, 0)


@pytest.mark.acceptance
def test_the_monitor_keeps_what_is_promised() -> None:
    assert rehearse(RURAL, rural_sizes(), trials=120, seed=1) == Rehearsal(120, 0, 0, 0)


def test_lies_half_as_large_as_the_noticed_are_mostly_not_named(cigre: Detectable) -> None:
    """The rehearsal can fail: with sizes that are too small, lies are missed."""
    table = cigre.meters.copy()
    table["named"] = table["named_alone"] = 0.5 * table["noticed_alone"]
    wrong = Detectable(cigre.feeder, cigre.digest, 1, cigre.risk, table, cigre.customers)
    assert rehearse(CIGRE, wrong, trials=10, seed=3).large_missed > 5


def test_an_interrupted_study_goes_on(cigre: Detectable, tmp_path: Path) -> None:
    class Interrupted(Exception):
        pass

    def interrupt(done: int, total: int) -> None:
        if done > total // 2:
            raise Interrupted

    journal = tmp_path / "journal"
    with pytest.raises(Interrupted):
        detectable(CIGRE, max_attacked=2, journal=journal, progress=interrupt)
    again = detectable(CIGRE, max_attacked=2, journal=journal)
    pd.testing.assert_frame_equal(again.meters, cigre.meters)
    pd.testing.assert_frame_equal(again.customers, cigre.customers)


def test_processes_find_the_same_to_the_last_bit(cigre: Detectable) -> None:
    found = detectable(CIGRE, max_attacked=2, runner=Processes(2))
    pd.testing.assert_frame_equal(found.meters, cigre.meters, check_exact=True)
    pd.testing.assert_frame_equal(found.customers, cigre.customers, check_exact=True)


def test_no_solver_writes_into_the_output(capfd: pytest.CaptureFixture[str]) -> None:
    """HiGHS does, whatever its options, where large constants spoil a solution that is taken back."""
    detectable(load("kerber-landnetz"), max_attacked=2)
    assert capfd.readouterr() == ("", "")


def test_few_meters_are_no_work_for_processes() -> None:
    assert workers(CIGRE, None) == Here()
    assert workers(CIGRE, 3) == Processes(3)


def test_arguments_are_checked() -> None:
    with refused(InputInvalid, "out-of-range"):
        detectable(CIGRE, max_attacked=0)
    with refused(InputInvalid, "out-of-range"):
        detectable(CIGRE, max_attacked=1, risk=1.0)

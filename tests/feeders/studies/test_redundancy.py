"""The redundancy study on a real feeder: meters missing, work interrupted, wrong names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from feeders.model.site import load
from feeders.studies.redundancy import ALL, SILENT, redundancy
from feeders.studies.running import Journal, OtherStudy
from feeders.studies.unobservable import Attack, CurvePositions
from gridsec.errors import InputInvalid
from tests.codes import refused
from tests.journals import edit, head_of, rows

RURAL = load("simbench-lv-rural1")


def test_known_loads_let_no_lie_stay_and_a_missing_meter_does() -> None:
    found = redundancy(RURAL, silent=["m04"])
    table = found.summary.set_index(["case", "attack"])
    assert table.loc[(ALL, Attack.PERSISTENT), "index"] == np.inf
    # The load of m04's customer moves the two other meters of its street, and nobody else.
    assert table.loc[(SILENT, Attack.PERSISTENT), "liars"] == "m05 m12"
    assert found.unknown_silent == ("LV1.101 Load 4",)
    assert found.changes["bus"].tolist() == ["LV1.101 Bus 2"]
    assert found.changes["identified_silent"].tolist() == [0.0]
    assert len(found.meters) == 13 + 12


def test_a_customer_that_no_meter_sees_is_named() -> None:
    silent = ["m04", "m05", "m12"]
    found = redundancy(RURAL, silent=silent).summary.set_index(["case", "attack"])
    blind = found.loc[(SILENT, Attack.PERSISTENT), "blind"]
    assert blind == "LV1.101 Load 4, LV1.101 Load 5, LV1.101 Load 12"


def test_an_interrupted_study_goes_on_and_does_nothing_twice(tmp_path: Path) -> None:
    class Interrupted(Exception):
        pass

    def interrupt(done: int, total: int) -> None:
        if done > total // 2:
            raise Interrupted

    journal = tmp_path / "journal"
    with pytest.raises(Interrupted):
        redundancy(RURAL, silent=["m04"], journal=journal, progress=interrupt)
    kept = rows(journal)
    assert kept
    again = redundancy(RURAL, silent=["m04"], journal=journal)
    assert kept.items() <= rows(journal).items()
    whole = redundancy(RURAL, silent=["m04"])
    for name in ("summary", "meters", "parts"):
        pd.testing.assert_frame_equal(getattr(again, name), getattr(whole, name))
    complete = journal.read_bytes()
    redundancy(RURAL, silent=["m04"], journal=journal)
    assert journal.read_bytes() == complete


def test_the_journal_of_another_study_is_refused(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    Journal(journal, {"study": "another"}).close()
    before = journal.read_bytes()
    with refused(OtherStudy, "other-origin"):
        redundancy(RURAL, journal=journal)
    assert journal.read_bytes() == before


def test_the_journal_of_another_version_is_refused(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    Journal(journal, {"study": "any"}).close()
    head = head_of(journal)
    for changed, code, named in (
        ({"versions": head["versions"] | {"numpy": "1.0"}}, "other-version", "numpy 1.0"),
        ({"versions": {}}, "other-version", ""),
        ({"study": "another", "versions": {}}, "other-origin", "another"),
    ):
        edit(journal, head=head | changed)
        with refused(OtherStudy, code) as caught:
            Journal(journal, {"study": "any"})
        assert named in str(caught.value)
    for first in ("[1]", "no journal", '{"study": "any"}'):
        journal.write_text(first + "\n", encoding="utf-8")
        with pytest.raises(OtherStudy):
            Journal(journal, {"study": "any"})


def test_unknown_names_are_refused() -> None:
    with refused(InputInvalid, "unknown-name"):
        redundancy(RURAL, silent=["m99"])
    with refused(InputInvalid, "unknown-name"):
        redundancy(RURAL, unknown=["nobody"])


def test_the_text_of_a_choice_is_the_choice_and_another_text_is_refused(tmp_path: Path) -> None:
    site, journal = load("cigre-lv"), str(tmp_path / "journal")
    both = ("steepest", CurvePositions.STEEPEST)
    said = [redundancy(site, curves=curves, journal=journal) for curves in both]
    assert said[0].summary.equals(said[1].summary)
    assert said[0].summary.equals(redundancy(site).summary)
    assert not said[0].summary.equals(redundancy(site, curves=CurvePositions.DEADBAND).summary)
    with refused(InputInvalid, "unknown-name"):
        redundancy(site, curves="flat")

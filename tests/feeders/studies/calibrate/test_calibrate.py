"""Calibration by recordings of full AC power flow: planted errors are found, nothing else is proposed."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from feeders.format.tables import read, write
from feeders.model.site import find, load
from feeders.model.three_phase import three_phase
from feeders.simulation.recording import RecordingInvalid
from feeders.simulation.scenario import START
from feeders.studies.calibrate.readings import frames
from feeders.studies.calibrate.search import FileErrorKind
from feeders.studies.calibrate.study import OtherFeeder, calibrate
from feeders.studies.running import OtherStudy
from gridsec.attack import Attack, Bias, Drift, Replay, Stuck
from gridsec.errors import InputInvalid
from tests.codes import refused
from tests.feeders.studies.calibrate.calibrate_cases import (
    CIGRE,
    biases,
    moved,
    recorded,
    scenario,
    shortened,
    site,
    swapped,
    three_phase_readings,
)
from tests.journals import edit

TABLES = CIGRE.tables


@pytest.mark.acceptance
def test_clean_recordings_lead_to_no_proposal_and_intervals_cover(tmp_path: Path) -> None:
    z, powers, proposals = [], [], 0
    for seed in range(12):
        given = scenario(seed, hidden_kw=1.0)
        found = calibrate(CIGRE, recorded(tmp_path, given))
        proposals += not found.proposals.empty
        z.append((found.meters["bias_percent"] - biases(given)) / found.meters["std_percent"])
        lines = found.lines[found.lines["verdict"] != "cannot be told"]
        z.append((lines["factor"] - 1.0) / lines["std"])
        error = found.errors.set_index("quantity").loc["error of p"]
        powers.append(error["low"] < 1.0 < error["high"])
    # At a risk of 5 % more than two of twelve recordings are accused by chance in 2 % of all cases.
    assert proposals <= 2
    each = np.concatenate(z)
    assert 0.6 < np.sqrt(np.mean(each**2)) < 1.4
    assert np.mean(np.abs(each) < 1.96) > 0.85
    assert np.mean(powers) > 0.7


@pytest.mark.acceptance
def test_three_planted_errors_are_found_and_nothing_else(tmp_path: Path) -> None:
    wrong = moved(swapped(TABLES, "Load R11", "Load R16"), "Load R15", "Bus R17")
    wrong = shortened(wrong, "Line R6-R16", 1.3)
    found = calibrate(site(wrong), recorded(tmp_path, scenario(1)))
    rows = found.proposals.set_index("kind")
    assert sorted(rows.index) == ["bus", "length", "swap"]
    assert rows.loc["bus", ["what", "now", "proposed"]].tolist() == ["Load R15", "Bus R17", "Bus R15"]
    assert rows.loc["swap", "what"] == "Load R11 and Load R16"
    assert rows.loc["length", "what"] == "Line R6-R16"
    assert rows.loc["length", "low"] < 1.3 < rows.loc["length", "high"]
    assert (rows["verdict"] == "proposed").all()
    assert (rows["confidence"] > 0.95).all()
    assert (rows["log_factor"] > np.log(20.0)).all()

    folder, out = tmp_path / "wrong", tmp_path / "right"
    write(wrong, folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    found.corrected(folder, out)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    after = read(out)
    assert after.customers == TABLES.customers
    truth = {row.line: row.r_ohm for row in TABLES.lines}
    for row in after.lines:
        assert row.r_ohm == pytest.approx(truth[row.line], rel=0.15)
    with pytest.raises(FileExistsError):
        found.corrected(folder, out)
    with refused(OtherFeeder, "other-origin"):
        found.corrected(out, tmp_path / "again")


def test_biases_of_the_size_of_the_class_are_found(tmp_path: Path) -> None:
    given = scenario(3)
    half = (
        Bias(np.array([1]), START, np.inf, np.array([0.005])),
        Bias(np.array([4]), START, np.inf, np.array([-0.005])),
    )
    exact = replace(given, errors=replace(given.errors, bias=0.0), attacks=half)
    found = calibrate(CIGRE, recorded(tmp_path, exact))
    assert found.proposals.empty
    rows = found.meters.set_index("meter")
    for meter, bias in (("m02", 0.5), ("m05", -0.5)):
        assert rows.loc[meter, "verdict"] == "biased"
        assert rows.loc[meter, "low_percent"] < bias < rows.loc[meter, "high_percent"]
    assert (rows.drop(["m02", "m05"])["verdict"] == "within error").all()


@pytest.mark.canary("0.0049-biased")
@pytest.mark.parametrize(("bias", "verdict"), [(0.0049, "biased"), (0.0075, "outside its class")])
def test_the_class_of_the_busbars_meter_counts(bias: float, verdict: str, tmp_path: Path) -> None:
    """Classes 0.5 and 0.1; the busbar's meter is off by nearly its class the other way."""
    given = scenario(3)
    lie = Bias(np.array([1]), START, np.inf, np.array([bias]))
    exact = replace(given, errors=replace(given.errors, bias=0.0), attacks=(lie,))
    readings = recorded(tmp_path, exact).frame()
    readings.loc[readings["meter"] == "", "v_volt"] *= 1.0 - 0.0009
    rows = calibrate(CIGRE, readings, kinds=[FileErrorKind.METER]).meters.set_index("meter")
    assert rows.loc["m02", "bias_percent"] == pytest.approx(100.0 * bias + 0.09, abs=0.06)
    assert rows.loc["m02", "verdict"] == verdict
    assert "outside its class" not in set(rows.drop("m02")["verdict"])


def test_the_error_of_a_coarse_busbars_meter_excludes_nobody(tmp_path: Path) -> None:
    """Meters of class 0.2, and a busbar's of class 1 that is off by 0.9 %: all are apart from it."""
    meta = replace(
        TABLES.meta, busbar_class_percent=1.0, meters=replace(TABLES.meta.meters, class_percent=0.2)
    )
    given = scenario(3)
    exact = replace(given, errors=replace(given.errors, bias=0.0))
    readings = recorded(tmp_path, exact).frame()
    readings.loc[readings["meter"] == "", "v_volt"] *= 1.0 + 0.009
    found = calibrate(site(replace(TABLES, meta=meta)), readings)
    assert found.proposals.empty
    assert set(found.meters["verdict"]) == {"biased"}


def test_lines_in_series_cannot_be_told_apart_and_are_not_corrected(tmp_path: Path) -> None:
    found = calibrate(site(shortened(TABLES, "Line R1-R2", 1.4)), recorded(tmp_path, scenario(1)))
    assert found.proposals["verdict"].tolist() == ["cannot be told"]
    either = found.proposals["what"][0] + found.proposals["alternatives"][0]
    assert "Line R1-R2" in either
    assert "Line R2-R3" in either
    assert found.corrections == ()
    assert "Line R2-R3" in found.lines.set_index("lines").loc["Line R1-R2", "same"]


@pytest.mark.canary("bias")
@pytest.mark.parametrize(
    "lie",
    [
        Bias(np.array([2]), START + 150 * 900.0, np.inf, np.array([0.006])),
        Drift(np.array([2]), START + 150 * 900.0, np.inf, np.array([1e-7]), np.array([0.02])),
    ],
    ids=["bias", "drift"],
)
def test_a_meter_whose_error_changes_is_excluded_and_leads_to_no_correction(
    lie: Bias | Drift, tmp_path: Path
) -> None:
    found = calibrate(CIGRE, recorded(tmp_path, scenario(2, attacks=(lie,))))
    assert found.proposals["kind"].tolist() == ["meter"]
    assert found.proposals["what"].tolist() == ["m03"]
    assert found.corrections == ()
    assert found.meters.set_index("meter").loc["m03", "verdict"] == "excluded"
    assert found.customers.set_index("meter").loc["m03", "verdict"] == "excluded"


@pytest.mark.canary("stuck-1")
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("meter", "lie"),
    [
        (4, Bias(np.array([4]), START, np.inf, np.array([-0.03]))),
        (2, Bias(np.array([2]), START, np.inf, np.array([0.08]))),
        (2, Stuck(np.array([2]), START + 5 * 900.0, np.inf)),
        (2, Replay(np.array([2]), START + 86400.0, np.inf, 43200.0)),
    ],
    ids=["low", "high", "stuck", "replay"],
)
def test_no_lie_becomes_a_correction(meter: int, lie: Attack, seed: int, tmp_path: Path) -> None:
    found = calibrate(CIGRE, recorded(tmp_path, scenario(seed, attacks=(lie,))))
    assert found.proposals["kind"].tolist() == ["meter"]
    assert found.proposals["what"].tolist() == [CIGRE.meter_ids[meter]]
    assert found.corrections == ()


@pytest.mark.acceptance
def test_an_error_of_the_files_is_found_beside_a_lie(tmp_path: Path) -> None:
    lie = Stuck(np.array([2]), START + 5 * 900.0, np.inf)
    wrong = site(shortened(TABLES, "Line R6-R16", 1.4))
    journal = tmp_path / "journal"
    readings = recorded(tmp_path, scenario(1, attacks=(lie,)))
    found = calibrate(wrong, readings, journal=journal)
    assert sorted(found.proposals["kind"]) == ["length", "meter"]
    assert [each.names for each in found.corrections] == [("Line R6-R16",)]
    again = calibrate(wrong, readings, journal=journal)
    pd.testing.assert_frame_equal(again.proposals, found.proposals)


@pytest.mark.canary("1080-20.0")
@pytest.mark.parametrize(("ticks", "dt_s"), [(3600, 2.0), (1080, 20.0)])
def test_short_intervals(ticks: int, dt_s: float, tmp_path: Path) -> None:
    wrong = site(swapped(TABLES, "Load R11", "Load R16"))
    found = calibrate(wrong, recorded(tmp_path, scenario(5, ticks=ticks, dt_s=dt_s)))
    assert found.proposals["kind"].tolist() == ["swap"]


@pytest.mark.acceptance
def test_a_wrong_phase_is_found(tmp_path: Path) -> None:
    tables = find("ieee-european-lv")
    readings = three_phase_readings(three_phase(tables), seed=1, ticks=64, dt_s=900.0, hidden_kw=0.1)
    rows = list(tables.customers)
    was = rows[4].phases
    rows[4] = replace(rows[4], phases="abc"[("abc".index(was) + 1) % 3])
    wrong = three_phase(replace(tables, customers=tuple(rows)))
    path = tmp_path / "readings.csv"
    readings.to_csv(path, index=False)
    found = calibrate(wrong, path, kinds=[FileErrorKind.PHASE])
    assert found.proposals[["kind", "what", "proposed"]].to_numpy().tolist() == [["phase", "LOAD5", was]]
    assert found.corrections[0].phases == was
    assert "as in the files; bus not looked for" in set(found.customers["verdict"])
    assert "as in the files" not in {*found.customers["verdict"], *found.lines["verdict"]}


def test_what_was_not_looked_for_is_not_as_in_the_files(tmp_path: Path) -> None:
    readings = recorded(tmp_path, scenario(1))
    found = calibrate(CIGRE, readings, kinds=[FileErrorKind.METER])
    assert set(found.lines["verdict"]) <= {"not looked for", "cannot be told"}
    assert "not looked for" in set(found.lines["verdict"])
    assert set(found.customers["verdict"]) == {"not looked for"}
    found = calibrate(CIGRE, readings, kinds=[FileErrorKind.LENGTH, FileErrorKind.BUS])
    assert "as in the files" in set(found.lines["verdict"])
    assert set(found.customers["verdict"]) <= {"as in the files", "cannot be told"}


@pytest.mark.acceptance
def test_phases_of_the_busbar_that_are_apart_are_no_errors_of_meters(tmp_path: Path) -> None:
    """0.6 % above and below: with readings of each phase nothing is wrong, without them nothing is said."""
    given = three_phase(find("ieee-european-lv"))
    readings = three_phase_readings(given, seed=1, ticks=64, dt_s=900.0, hidden_kw=0.1, apart=0.006)
    path = tmp_path / "readings.csv"
    readings.to_csv(path, index=False)
    assert "outside its class" not in set(
        calibrate(given, path, kinds=[FileErrorKind.METER]).meters["verdict"]
    )
    for without in (readings.drop(columns="v_phases"), readings.assign(v_phases="[null, null, null]")):
        with refused(RecordingInvalid, "missing") as caught:
            calibrate(given, without)
        assert "phase a and b and c," in str(caught.value)
    readings["v_phases"] = "230"
    with refused(RecordingInvalid, "shape"):
        calibrate(given, readings)


def test_where_there_is_nothing_to_look_for_nothing_is_found(tmp_path: Path) -> None:
    readings = recorded(tmp_path, scenario(1, ticks=96))
    assert calibrate(CIGRE, readings, kinds=[FileErrorKind.PHASE]).proposals.empty
    for kinds in (tuple(FileErrorKind), [FileErrorKind.METER], [FileErrorKind.BUS]):
        found = calibrate(CIGRE, readings, exclude=CIGRE.meter_ids, kinds=kinds)
        assert found.proposals.empty
        assert set(found.meters["verdict"]) == {"excluded"}


@pytest.mark.acceptance
def test_an_interrupted_study_goes_on_and_another_ones_journal_is_refused(tmp_path: Path) -> None:
    readings = recorded(tmp_path, scenario(1))
    wrong = site(moved(TABLES, "Load R15", "Bus R17"))
    journal = tmp_path / "journal"
    whole = calibrate(wrong, readings, journal=journal)
    edit(journal, keep=1)
    again = calibrate(wrong, readings, journal=journal)
    for name, table in whole.tables.items():
        pd.testing.assert_frame_equal(table, again.tables[name])
    with pytest.raises(OtherStudy):
        calibrate(wrong, readings, risk=0.01, journal=journal)


def test_clear_errors(tmp_path: Path) -> None:
    few = recorded(tmp_path, scenario(1, ticks=20))
    with refused(RecordingInvalid, "too-little-data") as caught:
        calibrate(CIGRE, few)
    assert "at least 48 frames over 12 h" in str(caught.value)
    with refused(RecordingInvalid, "other-origin"):
        calibrate(load("kerber-landnetz"), few)
    table = few.frame()
    with refused(RecordingInvalid, "unknown-name"):
        calibrate(CIGRE, table.assign(meter=table["meter"].astype(str).replace("m03", "m99")))
    with refused(RecordingInvalid, "missing"):
        calibrate(CIGRE, table[table["meter"] != ""])
    with refused(RecordingInvalid, "missing"):
        calibrate(CIGRE, table.drop(columns="v_volt"))
    with refused(RecordingInvalid, "too-little-data"):
        calibrate(CIGRE, table.groupby("meter", observed=True).head(1))
    with refused(RecordingInvalid, "unreadable"):
        calibrate(CIGRE, tmp_path / "none.csv")
    with refused(InputInvalid, "unknown-name"):
        calibrate(CIGRE, table, exclude=["m99"])
    for name, value in (("risk", 0.0), ("tolerance", 0.5)):
        with refused(InputInvalid, "out-of-range"):
            calibrate(CIGRE, table, **{name: value})


def test_times_that_are_none_are_named_before_memory_is_taken_for_them(tmp_path: Path) -> None:
    table = recorded(tmp_path, scenario(1, ticks=20)).frame()
    t, fourth = table["t"], table.index == 3
    moments = pd.to_datetime(t, unit="s")
    for change, codes, row in (
        ({"t": moments}, ["wrong-type"], "t"),
        ({"t": moments.astype(str)}, ["wrong-type"], "t of row 1"),
        ({"t": 1000.0 * t}, ["out-of-range"], "t of row 1"),
        ({"t": t.mask(fourth)}, ["not-finite"], "t of row 4"),
        ({"t": t.mask(fourth, 0.0)}, ["out-of-range"], "t of row 4"),
        ({"t": t.mask(fourth, 1e300)}, ["out-of-range"], "t of row 4"),
        ({"v_volt": "x", "p_kw": True}, ["wrong-type", "wrong-type"], "v_volt of row 1"),
        ({"t": -1.0, "meter": "m99"}, ["out-of-range", "unknown-name", "missing"], "t of row 1"),
    ):
        with refused(RecordingInvalid, *codes) as caught:
            frames(CIGRE, table.assign(**change))
        assert re.split(" is | and ", caught.value.problems[0])[0] == row


def test_readings_in_another_unit_are_refused_all_at_once(tmp_path: Path) -> None:
    table = recorded(tmp_path, scenario(1)).frame()
    v, p, q, busbar = table["v_volt"], table["p_kw"], table["q_kvar"], table["meter"] == ""
    third = table["meter"] == "m03"
    to_phase, in_w = "a phase-to-phase voltage?", "in W?"
    for change, said in (
        ({"v_volt": 3.0**0.5 * v}, {"v_volt of m01 and 6 more": to_phase}),
        ({"v_volt": v.mask(busbar, 3.0**0.5 * v)}, {"v_volt of the busbar": to_phase}),
        ({"v_volt": v / 1000.0}, {"v_volt of m01 and 6 more": "in kV?"}),
        ({"v_volt": v.mask(third, 0.0)}, {"v_volt of m03": "expected V from phase to neutral"}),
        (
            {"p_kw": 1000.0 * p, "q_kvar": 1000.0 * q},
            {"p_kw of m01 and 5 more": in_w, "q_kvar of m01 and 5 more": "in var?"},
        ),
        (
            {"v_volt": 3.0**0.5 * v, "p_kw": 1000.0 * p},
            {"v_volt of m01 and 6 more": to_phase, "p_kw of m01 and 5 more": in_w},
        ),
    ):
        with refused(RecordingInvalid, *["doubtful"] * len(said)) as caught:
            frames(CIGRE, table.assign(**change))
        parts = (problem.split(" is usually ") for problem in caught.value.problems)
        assert {place: rest.split("; ")[1] for place, rest in parts} == said
    # A dead meter that is excluded keeps nobody from the study, and neither do a few absurd readings.
    frames(CIGRE, table.assign(v_volt=v.mask(third, 0.0)), exclude=["m03"])
    frames(CIGRE, table.assign(v_volt=v.mask(v.index < 200, 1e6)))


def test_a_reading_years_later_changes_no_frame(tmp_path: Path) -> None:
    table = recorded(tmp_path, scenario(1)).frame()
    late = pd.concat([table, table[:1].assign(t=table["t"].max() + 3e7)])
    one, other = frames(CIGRE, table), frames(CIGRE, late)
    for name in ("t", "v_volt", "p_kw", "v0_volt", "count"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_meter_with_a_name_like_nothing_is_not_the_busbars(tmp_path: Path) -> None:
    table = recorded(tmp_path, scenario(1)).frame()
    for name in ("NA", "null", "nan", "None", "0012"):
        renamed = site(
            replace(
                TABLES,
                customers=tuple(
                    replace(row, meter=name) if row.meter == "m01" else row for row in TABLES.customers
                ),
            )
        )
        table.assign(meter=table["meter"].astype(str).replace("m01", name)).to_csv(tmp_path / "a.csv")
        found, expected = frames(renamed, tmp_path / "a.csv"), frames(CIGRE, table)
        np.testing.assert_array_equal(found.v_volt, expected.v_volt)
        np.testing.assert_array_equal(found.v0_volt, expected.v0_volt)

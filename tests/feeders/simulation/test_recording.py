"""Recordings: what is written comes back, foreign files are read, broken ones are named."""

from __future__ import annotations

import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from feeders.simulation.attacks import RANDOM_KINDS, busbar_attack, random_attacks
from feeders.simulation.demand import Variation
from feeders.simulation.plant import BUSBAR, Channel, MeterErrors, MeterOutage
from feeders.simulation.powerflow import PowerFlowDiverged
from feeders.simulation.recording import (
    FORMAT,
    RecordingInvalid,
    read_recording,
    record,
    scenario_from_json,
    scenario_to_json,
    truth_path,
)
from feeders.simulation.scenario import START, Scenario, Season, by_arrival, simulate
from gridsec.errors import InputInvalid, Problem
from tests.codes import refused
from tests.feeders.villages import village, village_without_inverters


def busy() -> Scenario:
    """Every feature at once."""
    site = village()
    attacks = tuple(
        attack
        for seed, kind in enumerate(RANDOM_KINDS)
        for attack in random_attacks(site, seed, kind, 2, 0.02, t_on=START + 20.0, t_off=START + 60.0)
    )
    return Scenario(
        seed=3,
        duration_s=90.0,
        substep_s=0.5,
        variation=Variation(busbar_pu=1.03),
        errors=MeterErrors(report_q=True),
        channel=Channel(
            loss=0.05,
            delay_mean_s=0.7,
            late=0.05,
            late_s=20.0,
            duplicate=0.1,
            clock_s=0.5,
            silences=(MeterOutage("m-c1", START + 5.0, np.inf), MeterOutage(BUSBAR, START, START + 3.0)),
        ),
        attacks=attacks,
        busbar_attacks=(busbar_attack(site, "scaling", 0.02, t_on=START + 30.0, t_off=START + 70.0),),
    )


def test_readings_and_truth_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("feeders.simulation.recording.CHUNK_TICKS", 16)  # late readings cross many chunks
    site, scenario = village(), busy()
    recording = record(site, scenario, tmp_path / "day.parquet")
    samples = list(simulate(site, scenario))
    expected = list(by_arrival(samples))
    got = list(recording.readings())
    assert len(got) == recording.count == len(expected) > 400
    assert sorted(map(repr, got)) == sorted(map(repr, expected))
    assert [r.arrival for r in got] == sorted(r.arrival for r in got)
    assert {r.meter for r in got} == {*site.meter_ids, BUSBAR}

    truth = recording.truth()
    np.testing.assert_array_equal(truth.t, [s.t for s in samples])
    for name in ("v_volt", "p_kw", "q_kvar", "v_bus_volt", "x_kvar", "manipulated", "shift_volt"):
        np.testing.assert_array_equal(getattr(truth, name), np.array([getattr(s, name) for s in samples]))
    assert truth.manipulated.any()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["day.parquet", "day.truth.parquet"]


@pytest.mark.acceptance
def test_the_same_scenario_gives_the_same_bytes(tmp_path: Path) -> None:
    site = village()
    one = record(site, busy(), tmp_path / "one.parquet").path
    two = record(site, busy(), tmp_path / "two.parquet").path
    assert one.read_bytes() == two.read_bytes()
    assert truth_path(one).read_bytes() == truth_path(two).read_bytes()


def test_metadata_tells_how_it_was_made(tmp_path: Path) -> None:
    site, scenario = village(), busy()
    recording = read_recording(record(site, scenario, tmp_path / "a.parquet").path)
    assert (recording.feeder, recording.digest) == ("village", site.digest)
    assert recording.versions["numpy"] == np.__version__
    assert recording.scenario is not None
    # Played again from the file alone, it is the same.
    again = record(site, recording.scenario, tmp_path / "b.parquet")
    assert again.path.read_bytes() == recording.path.read_bytes()


def test_scenarios_survive_json() -> None:
    scenario = busy()
    text = json.dumps(scenario_to_json(scenario), allow_nan=False)
    back = scenario_from_json(json.loads(text))
    assert json.dumps(scenario_to_json(back), allow_nan=False) == text
    assert back.variation == scenario.variation
    assert back.channel == scenario.channel
    assert [type(a) for a in back.attacks] == [type(a) for a in scenario.attacks]
    endless = scenario_from_json(json.loads(json.dumps(scenario_to_json(Scenario(duration_s=np.inf)))))
    assert endless.duration_s == np.inf
    winter = scenario_to_json(Scenario(season=Season.WINTER))
    assert scenario_from_json(json.loads(json.dumps(winter))).season is Season.WINTER
    older = {name: value for name, value in winter.items() if name not in {"season", "busbar_attacks"}}
    assert scenario_from_json(older).season is Season.SUMMER  # all there was
    assert scenario_from_json(older).busbar_attacks == ()


def test_numbers_of_numpy_and_infinite_ones_are_written_and_read(tmp_path: Path) -> None:
    given = Scenario(
        seed=np.int64(3),
        start=np.float64(START),
        duration_s=np.int32(3),
        dt_s=np.float32(1.0),
        substep_s=np.inf,
        variation=Variation(busbar_pu=np.float32(1.0), tap_interval_s=np.inf),
        channel=Channel(silences=(MeterOutage("inf", np.float32(0.0), np.inf),)),
    )
    expected = replace(given, seed=3, duration_s=3.0, dt_s=1.0)
    assert scenario_from_json(json.loads(json.dumps(scenario_to_json(given)))) == expected
    made = record(village(), replace(given, channel=Channel()), tmp_path / "a.parquet")
    assert made.truth().t.tolist() == [START, START + 1.0, START + 2.0]


def test_new_readings_never_stand_beside_an_old_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, path = village(), tmp_path / "a.parquet"
    record(site, Scenario(seed=1, duration_s=3.0), path)
    kept = truth_path(path).read_bytes()
    whole, calls = os.replace, []

    def interrupted(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == 2:
            raise KeyboardInterrupt
        whole(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record(site, Scenario(seed=2, duration_s=3.0), path)
    assert read_recording(path).scenario == Scenario(seed=2, duration_s=3.0)
    with refused(RecordingInvalid, "missing"):
        read_recording(path).truth()
    truth_path(path).write_bytes(kept)
    with refused(RecordingInvalid, "other-origin"):
        read_recording(path).truth()


def test_pandas_reads_it(tmp_path: Path) -> None:
    recording = record(village(), Scenario(duration_s=5.0), tmp_path / "a.parquet")
    frame = recording.frame()
    assert list(frame.columns) == ["meter", "t", "seq", "arrival", "v_volt", "p_kw", "q_kvar"]
    assert len(frame) == 5 * 8
    busbar = frame[frame.meter == BUSBAR]
    assert len(busbar) == 5
    assert busbar.p_kw.isna().all()
    pd.testing.assert_frame_equal(frame, pd.read_parquet(recording.path))


def test_foreign_files_need_three_columns_only(tmp_path: Path) -> None:
    path = tmp_path / "foreign.parquet"
    frame = pd.DataFrame({"meter": ["m1", "m2"], "t": [1.0, 2.0], "v_volt": [230.0, 231.0], "extra": [1, 2]})
    frame.to_parquet(path)
    recording = read_recording(path)
    assert (recording.feeder, recording.digest, recording.scenario) == (None, None, None)
    first, second = recording.readings()
    assert (first.meter, first.t, first.arrival, first.v_volt) == ("m1", 1.0, 1.0, 230.0)
    assert (second.seq, second.p_kw, second.q_kvar) == (None, None, None)
    with refused(RecordingInvalid, "missing"):
        recording.truth()


def test_what_is_no_recording_is_said_to_be_none(tmp_path: Path) -> None:
    with refused(RecordingInvalid, "unreadable"):
        read_recording(tmp_path / "nowhere.parquet")
    text = tmp_path / "text.parquet"
    text.write_text("meter,t,v_volt\n")
    with refused(RecordingInvalid, "unreadable"):
        read_recording(text)
    short = tmp_path / "short.parquet"
    pd.DataFrame({"meter": ["m1"]}).to_parquet(short)
    with refused(RecordingInvalid, "missing") as caught:
        read_recording(short)
    assert "t, v_volt" in str(caught.value)
    day = pd.to_datetime(["2026-06-01"])
    frame = pd.DataFrame({"meter": [1], "t": day, "p_kw": [True], "v_phases": [[1.0]], "seq": [None]})
    frame.to_parquet(short)
    with refused(RecordingInvalid, "missing", "wrong-type", "wrong-type", "wrong-type"):
        read_recording(short)


@pytest.mark.parametrize(
    "about",
    [
        json.dumps({"format": FORMAT + 1}),
        "{",
        json.dumps({"format": FORMAT}),
        json.dumps({"format": FORMAT, "scenario": {"seed": 1}}),
        json.dumps([]),
    ],
)
def test_broken_metadata_is_named(tmp_path: Path, about: str) -> None:
    path = tmp_path / "broken.parquet"
    table = pa.table({"meter": ["m1"], "t": [1.0], "v_volt": [230.0]})
    pq.write_table(table.replace_schema_metadata({"gridsec": about}), path)
    with refused(RecordingInvalid, "unreadable"):
        read_recording(path)


def test_an_endless_scenario_cannot_be_recorded(tmp_path: Path) -> None:
    with refused(InputInvalid, "not-finite"):
        record(village(), Scenario(duration_s=np.inf), tmp_path / "a.parquet")
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_no_half_file(tmp_path: Path) -> None:
    beyond = Scenario(duration_s=5.0, variation=Variation(busbar_pu=0.02))
    with refused(PowerFlowDiverged, "not-converged"):
        record(village(), beyond, tmp_path / "a.parquet")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match="nowhere"):
        record(village(), Scenario(), tmp_path / "nowhere" / "a.parquet")


def test_a_feeder_without_inverters_has_no_column_of_them(tmp_path: Path) -> None:
    site = village_without_inverters()
    made = record(site, Scenario(seed=1, duration_s=3.0), tmp_path / "plain.parquet")
    truth = made.truth()
    assert truth.x_kvar.shape == (truth.t.size, 0)
    assert truth.v_volt.shape == (truth.t.size, len(site.feeder.customers))


def test_a_scenario_in_which_nothing_arrives(tmp_path: Path) -> None:
    recording = record(village(), Scenario(duration_s=3.0, channel=Channel(loss=1.0)), tmp_path / "a.parquet")
    assert recording.count == 0
    assert list(recording.readings()) == []
    assert recording.truth().t.size == 3


def foreign(path: Path, **columns: list[float | None]) -> Path:
    """A file of two readings with more columns, NaN and null as they are given."""
    about = {"meter": ["m1", "m2"], "t": [1.0, 2.0], "v_volt": [230.0, 231.0]}
    pq.write_table(pa.table({**about, **columns}), path)
    return path


def test_numbers_of_readings_may_be_floats_and_nan_is_nothing(tmp_path: Path) -> None:
    columns = {"seq": [7.0, np.nan], "p_kw": [np.nan, 1.5], "q_kvar": [None, np.nan]}
    first, second = read_recording(foreign(tmp_path / "a.parquet", **columns)).readings()
    assert (first.seq, type(first.seq), first.p_kw, first.q_kvar) == (7, int, None, None)
    assert (second.seq, second.p_kw, second.q_kvar) == (None, 1.5, None)
    # As pandas writes a column of whole numbers in which one is missing.
    frame = pd.DataFrame({"meter": ["m1", "m2"], "t": [1, 2], "v_volt": [230, 231], "seq": [None, 2**40]})
    frame.to_parquet(tmp_path / "b.parquet")
    assert [r.seq for r in read_recording(tmp_path / "b.parquet").readings()] == [None, 2**40]


def test_numbers_of_readings_that_are_not_whole_are_named_with_everything_else(tmp_path: Path) -> None:
    for seq in (1.5, np.inf, 1e30):
        with refused(RecordingInvalid, "wrong-type", "not-integer"):
            read_recording(foreign(tmp_path / "a.parquet", seq=[1.0, seq], p_kw=[True, False]))


def test_an_error_names_its_place_once_and_survives_pickling() -> None:
    error = RecordingInvalid(
        Problem("missing", "no t"), Problem("wrong-type", "no number"), where="a.parquet: "
    )
    again = pickle.loads(pickle.dumps(error))
    for each in (error, again):
        assert str(each) == "a.parquet: no t; no number"
        assert each.codes == ("missing", "wrong-type")

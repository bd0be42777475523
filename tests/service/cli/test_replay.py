"""`gridsec replay`: a recording without an answer says so, and what was live is replayed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from feeders.model.site import load
from feeders.simulation.attacks import random_attacks
from feeders.simulation.plant import Channel
from feeders.simulation.recording import record
from feeders.simulation.scenario import Scenario
from tests.service.commands import command, plain

FEEDER = "simbench-lv-rural1"
START = 1_795_212_000.0
Replay = Callable[..., tuple[int, str, str]]


@pytest.fixture
def replay(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Replay:
    return lambda *arguments: command("replay")(monkeypatch, capsys, *map(str, arguments))


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 40 s in which two meters lie for 20 of them."""
    path, site = tmp_path_factory.mktemp("recorded") / "day.parquet", load(FEEDER)
    attacks = random_attacks(site, 2, "bias", 2, 0.03, t_on=START + 10, t_off=START + 30)
    return record(site, Scenario(seed=5, start=START, duration_s=40.0, attacks=attacks), path).path


def changed(day: Path, path: Path, name: str, column: pa.ChunkedArray | None) -> Path:
    """The recording as another program would have written it: one column is another, or is not there."""
    table = pq.read_table(day).replace_schema_metadata(None)
    k = table.schema.get_field_index(name)
    pq.write_table(table.remove_column(k) if column is None else table.set_column(k, name, column), path)
    return path


def test_numbers_of_readings_as_floats_change_nothing(day: Path, tmp_path: Path, replay: Replay) -> None:
    seq = pq.read_table(day, columns=["seq"]).column("seq")
    floats = changed(day, tmp_path / "floats.parquet", "seq", pc.cast(seq, pa.float64()))
    code, told, tally = replay(day, "--json")
    assert (code, [json.loads(line)["change"] for line in told.splitlines()].count("raised")) == (0, 2)
    assert "ticks: attacked" in plain(tally)
    assert replay(floats, "--feeder", FEEDER, "--json") == (code, told, tally)


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_no_answer_does_not_look_like_no_attack(
    day: Path, tmp_path: Path, replay: Replay, options: tuple[str, ...]
) -> None:
    absurd = changed(
        day, tmp_path / "absurd.parquet", "v_volt", pa.chunked_array([[1e6] * pq.read_table(day).num_rows])
    )
    code, told, said = replay(absurd, "--feeder", FEEDER, *options)
    assert code == 1
    assert "no tick has a verdict" in plain(said)
    assert "readings: value 560" in plain(said if options else told)


def test_the_clock_of_arrival_needs_its_column(day: Path, tmp_path: Path, replay: Replay) -> None:
    assert replay(day, "--clock", "wall")[0] == 0
    code, told, said = replay(changed(day, tmp_path / "bare.parquet", "arrival", None), "--clock", "wall")
    assert (code, told) == (6, "")
    assert "no column arrival" in plain(said)


def test_what_the_service_was_told_a_replay_can_be_told(day: Path, tmp_path: Path, replay: Replay) -> None:
    """Grace, the largest skew of a clock, and the estimator."""
    slow = Scenario(seed=5, start=START, duration_s=10.0, channel=Channel(delay_mean_s=0.02))
    path = record(load(FEEDER), slow, tmp_path / "slow.parquet").path
    for reason, option in (("late", "--grace"), ("clock-off", "--max-skew")):
        count = re.compile(rf"\b{reason} (\d+)")
        told = [plain(replay(path, "--clock", "wall", *more)[1]) for more in ((), (option, "0.001"))]
        usual, strict = (int(found[1]) if (found := count.search(one)) else 0 for one in told)
        assert usual < 20
        assert strict > 100
    who, limits = zip(
        *(raised(replay(day, "--json", *one)) for one in ((), ("--estimator", "exact-bank"))), strict=True
    )
    assert who[0] == who[1]
    assert not limits[0] & limits[1]


def raised(told: tuple[int, str, str]) -> tuple[set[str], set[float]]:
    """Whom the alarms of a replay name, and the thresholds they were judged by."""
    alarms = [json.loads(line)["alarm"] for line in told[1].splitlines()]
    return {alarm["meter"] for alarm in alarms}, {alarm["evidence"]["threshold"] for alarm in alarms}


def test_all_wrong_options_of_a_replay_are_told_at_once(day: Path, replay: Replay) -> None:
    wrong = ("--clock", "sun", "--estimator", "oracle", "--max-skew", "0", "--grace", "-1")
    code, told, said = replay(day, *wrong)
    assert (code, told) == (2, "")
    for option in wrong[::2]:
        assert option in plain(said)

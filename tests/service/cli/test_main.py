"""The command line as a user has it: processes, exit codes, one clear message instead of a traceback."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

import httpx
import pandas as pd
import pytest
import structlog

from feeders.format.tables import write
from feeders.model.site import load
from feeders.simulation.recording import read_recording
from feeders.simulation.scenario import Scenario, random_attacks
from gridsec.errors import GridsecError
from service.cli.demo import DemoResult, verdict
from service.cli.main import BLAS_THREADS, EXIT_CODES, exit_code
from service.cli.simulate import Pace, play
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient
from service.store.schema import LeaseLost
from tests.service.commands import command, plain
from tests.service.running import FEEDER, free_port, until

ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("GRIDSEC_")}
CASES = Path(__file__).parents[2] / "cases"
COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]


@dataclass
class Done:
    returncode: int
    stdout: str
    stderr: str


Run = Callable[..., Done]


@pytest.fixture
def gridsec(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Run a command in this process, from `main` to its exit code."""
    for name in [name for name in os.environ if name.startswith("GRIDSEC_")]:
        monkeypatch.delenv(name)
    # `serve` sets up the log of the whole process: no logger may keep what this test captures beyond its end.
    configure = structlog.configure
    monkeypatch.setattr(
        structlog, "configure", lambda **given: configure(**given | {"cache_logger_on_first_use": False})
    )

    def run(*arguments: str) -> Done:
        return Done(*command()(monkeypatch, capsys, *arguments))

    yield run
    structlog.reset_defaults()


def process(*arguments: str, env: dict[str, str] | None = None) -> Done:
    """Run a command as a process of its own."""
    done = subprocess.run(
        [*COMMAND, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=ENVIRONMENT | (env or {}),
    )
    return Done(done.returncode, done.stdout, done.stderr)


def refused(code: int, done: Done) -> str:
    """Check that something failed with a code, one message and no traceback; return the message."""
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("gridsec:") == 1
    return done.stderr


@contextmanager
def serving(
    folder: Path, *options: str, log: TextIO | None = None
) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """Run `gridsec serve`; yields the process, its URL and its zenoh endpoint."""
    zenoh = f"tcp/127.0.0.1:{free_port()}"
    log = log or (folder / "log").open("w")
    child = subprocess.Popen(
        [*COMMAND, "serve", "--feeder", FEEDER, "--zenoh-listen", zenoh, "--http", "127.0.0.1:0",
         "--database", f"sqlite:///{folder / 'gridsec.db'}", *options],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True,
        env=ENVIRONMENT,
    )  # fmt: skip
    try:
        assert child.stdout is not None
        url = child.stdout.readline().strip()
        assert url.startswith("http://"), (folder / "log").read_text()
        until(lambda: httpx.get(f"{url}/readyz").status_code == 200)
        yield child, url, zenoh
    finally:
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout, log):
            if pipe is not None:
                pipe.close()


# An open stream would keep a service that waits for it forever; a busy machine takes some seconds.
SOON_S = 15.0


def ended(child: subprocess.Popen[str]) -> float:
    """Wait for the end; return how long it took, s."""
    begin = time.monotonic()
    child.wait(timeout=30.0)
    return time.monotonic() - begin


# --- errors -----------------------------------------------------------------------------------------


@pytest.mark.acceptance
def test_an_http_port_in_use(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        message = refused(
            5, process("serve", "--feeder", FEEDER, "--http", address,
            "--zenoh-listen", f"tcp/127.0.0.1:{free_port()}", "--database", f"sqlite:///{tmp_path / 'a.db'}",
            env={"GRIDSEC_MAX_SKEW": "3"}),
        )  # fmt: skip
    assert f"HTTP cannot listen on {address}: Address already in use" in message
    # Said once the log is set up, before anything else can go wrong.
    assert re.search("variable_ignored.*GRIDSEC_MAX_SKEW_S.*GRIDSEC_MAX_SKEW", message)


@pytest.mark.acceptance
def test_a_zenoh_port_in_use(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        end = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        message = refused(
            5, process("serve", "--feeder", FEEDER, "--http", "127.0.0.1:0", "--zenoh-listen", end,
            "--database", f"sqlite:///{tmp_path / 'a.db'}"),
        )  # fmt: skip
    assert end in message
    assert "Address already in use" in message


def test_a_database_that_cannot_be_written(gridsec: Run, tmp_path: Path) -> None:
    (tmp_path / "folder.db").mkdir()
    for url in ("sqlite:////proc/gridsec.db", f"sqlite:///{tmp_path}/folder.db", "mysql://x", "what"):
        assert url in refused(4, gridsec("serve", "--feeder", FEEDER, "--database", url))


@pytest.mark.acceptance
def test_a_database_that_another_service_writes(tmp_path: Path) -> None:
    with serving(tmp_path):
        database = f"sqlite:///{tmp_path / 'gridsec.db'}"
        assert "gridsec.db" in refused(4, process("serve", "--feeder", FEEDER, "--database", database))


def test_a_feeder_with_five_mistakes(gridsec: Run) -> None:
    folder = CASES / "broken" / "five-mistakes"
    expected = (folder / "problems.txt").read_text().splitlines()
    assert len(expected) == 5
    for done in (gridsec("serve", "--feeder", str(folder)), gridsec("feeders", "validate", str(folder))):
        message = refused(3, done)
        assert "5 problems" in message
        for problem in expected:
            assert problem in message


def test_unknown_feeders_are_all_named() -> None:
    message = refused(3, process("serve", "--feeder", "atlantis", "--feeder", "utopia", "--feeder", FEEDER))
    assert "2 problems" in message
    assert "atlantis" in message
    assert "utopia" in message


def test_exit_codes_are_those_of_existing_errors() -> None:
    for name in EXIT_CODES:
        module, _, kind = name.rpartition(".")
        assert issubclass(getattr(importlib.import_module(module), kind), GridsecError)
    assert exit_code(LeaseLost("w1", ["village"])) == EXIT_CODES["service.store.schema.LeaseLost"]
    assert exit_code(GridsecError("")) == 1


def test_wrong_settings_are_all_named(gridsec: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRIDSEC_CLOCK", "sundial")
    message = refused(2, gridsec("serve", "--http", "nowhere"))
    assert "--http or GRIDSEC_HTTP" in message
    assert "--clock or GRIDSEC_CLOCK" in message


@pytest.mark.acceptance
def test_nobody_to_connect_to(gridsec: Run) -> None:
    end = f"tcp/127.0.0.1:{free_port()}"
    assert end in refused(5, gridsec("simulate", FEEDER, "--connect", end, "--duration", "1"))


def test_no_recording(gridsec: Run, tmp_path: Path) -> None:
    file = tmp_path / "notes.parquet"
    file.write_text("no parquet")
    assert "notes.parquet" in refused(6, gridsec("replay", str(file)))
    assert "missing.parquet" in refused(6, gridsec("replay", str(tmp_path / "missing.parquet")))
    out = str(file / "x.parquet")
    assert "notes.parquet" in refused(6, gridsec("simulate", FEEDER, "--duration", "2", "--out", out))


def test_brackets_in_help_texts_are_shown(gridsec: Run) -> None:
    assert "[default: as in feeder.toml]" in plain(gridsec("serve", "--help").stdout)
    assert "A setting of [monitor]" in plain(gridsec("study", "campaign", "--help").stdout)


def test_wrong_usage(gridsec: Run) -> None:
    done = gridsec("simulate", FEEDER, "--season", "monsoon", "--out", "x")
    assert done.returncode == 2
    assert all(season in done.stderr for season in ("winter", "spring", "summer", "autumn"))
    done = gridsec("simulate", FEEDER, "--attack", "bias:2", "--out", "x")
    assert done.returncode == 2
    assert "kind:count:size:from:to" in done.stderr
    for text in ("load-6:-4:20", "nobody:-4:20:55", "LV1.101 Load 2:-4:a:20"):
        done = gridsec("simulate", FEEDER, "--inverter-attack", text, "--out", "x")
        assert done.returncode == 2
        assert "customer:kvar:from:to" in done.stderr
    assert gridsec("demo", "--duration", "1").returncode == 2
    for size, why in (("3", "3 is 300 % of nominal; 0.03 is 3 %"), ("0", "a positive part"), ("nan", "nan")):
        done = gridsec("demo", "--size", size)
        assert done.returncode == 2
        assert why in plain(done.stderr)


def test_a_feeder_without_inverters_says_so(gridsec: Run, tmp_path: Path) -> None:
    tables = load("cigre-lv").tables
    plain_rows = tuple(replace(row, inverter_kva=0.0, droop="") for row in tables.customers)
    write(replace(tables, customers=plain_rows), tmp_path / "bare")
    done = gridsec("simulate", str(tmp_path / "bare"), "--inverter-attack", "x:1:0:1", "--out", "x")
    assert done.returncode == 2
    assert "with an inverter, and cigre-lv has none" in plain(done.stderr)


def test_all_that_is_wrong_with_a_scenario_is_told_at_once(gridsec: Run, tmp_path: Path) -> None:
    out = tmp_path / "x.parquet"
    lies = ["bias:2:0.03:4:2", "bias:2:0.03:nan:55", "bias:-1:0.03:4:5", "bias:2:-1:4:5", "drift:1:0.1:4:inf"]
    lies += ["bias:substation:nan:4:5", "bias:1:3:4:5", "scaling:substation:-3:4:5"]
    wrong = ["LV1.101 Load 2:nan:4:5", "LV1.101 Load 2:4:5:5"]
    given = {"--season": "dry", "--dt": "0", "--start": "-5", "--lockstep": "3", "--speed": "2"}
    given["--prefix"] = "test"
    words = [f"{name}={value}" for name, value in given.items()]
    words += [f"--attack={lie}" for lie in lies] + [f"--inverter-attack={each}" for each in wrong]
    done = gridsec("simulate", FEEDER, "--duration", "inf", *words, "--out", str(out))
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    said = plain(done.stderr)
    others = ("--dt is 0", "--start is -5", "--season is 'dry'", "a recording needs an end")
    for text in (*lies, *wrong, *others):
        assert text in said
    assert "3 is 300 % of nominal; 0.03 is 3 %" in said
    assert "-3 is -300 % of nominal; -0.03 is -3 %" in said
    for text in ("--speed", "--lockstep", "--prefix"):
        assert f"{text} goes with publishing, not with --out" in said
    assert not out.exists()
    done = gridsec("simulate", FEEDER, "--attack=stuck:1:0:-1e9:5", "--out", str(out))
    assert done.returncode == 2
    assert "more than the simulation supports" in plain(done.stderr)
    late = ("--attack=bias:1:0.03:500:600", "--attack=bias:substation:0.03:60:inf")
    late += ("--inverter-attack=LV1.101 Load 2:4:70:90",)
    done = gridsec("simulate", FEEDER, "--duration", "60", *late, "--out", str(out))
    assert done.returncode == 2
    for begin in (500, 60, 70):
        assert f"begins {begin} s after the start, when the scenario of 60 s is over" in plain(done.stderr)
    done = gridsec("simulate", FEEDER, "--duration", "60", "--attack=bias:1:0.03:-20:-5", "--out", str(out))
    assert done.returncode == 2
    assert "end after the start, not -20 and -5" in plain(done.stderr)
    assert not out.exists()


def test_a_simulation_replaces_simulations_only(gridsec: Run, tmp_path: Path) -> None:
    field, notes = tmp_path / "field.parquet", tmp_path / "notes.parquet"
    table = pd.DataFrame({"meter": ["m01"], "t": [1795212000.0], "v_volt": [230.0]})
    table.to_parquet(field)
    table.to_parquet(tmp_path / "own.truth.parquet")
    notes.write_text("no parquet")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    some = ("simulate", FEEDER, "--duration", "2", "--start", "1795212000", "--out")
    for out in (field, notes, tmp_path / "own.parquet"):
        assert "exists and is not from a simulation" in plain(refused(6, gridsec(*some, str(out))))
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    for _ in range(2):
        assert gridsec(*some, str(tmp_path / "new.parquet")).returncode == 0


def test_conversion_of_nothing(gridsec: Run, tmp_path: Path) -> None:
    assert "nonsense" in refused(6, gridsec("convert", "pandapower:nonsense", str(tmp_path / "x")))


# --- work ---------------------------------------------------------------------------------------------


def test_feeders(gridsec: Run) -> None:
    listed = gridsec("feeders", "list").stdout
    assert all(name in listed for name in ("simbench-lv-rural1", "kerber-dorfnetz", "case33bw"))
    assert "single-phase" in listed
    assert "ieee-european-lv" in listed
    shown = gridsec("feeders", "show", FEEDER).stdout
    assert "13 customers, 13 meters" in shown
    valid = gridsec("feeders", "validate", str(CASES.parents[1] / "data/feeders" / FEEDER))
    assert (valid.returncode, "valid" in valid.stdout) == (0, True)


def test_a_feeder_converted_is_a_feeder(gridsec: Run, tmp_path: Path) -> None:
    pytest.importorskip("pandapower")
    folder = tmp_path / "landnetz"
    done = gridsec("convert", "kerber-landnetz", str(folder))
    assert done.returncode == 0, done.stderr
    assert gridsec("feeders", "validate", str(folder)).returncode == 0
    assert load(folder).feeder.name == "kerber-landnetz"


def test_a_recording_replayed_names_the_liars(gridsec: Run, tmp_path: Path) -> None:
    file = tmp_path / "day.parquet"
    made = gridsec(
        "simulate", FEEDER, "--out", str(file), "--duration", "60", "--seed", "3", "--loss", "0.02",
        "--attack", "bias:2:0.03:20:40", "--start", "1795212000",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    told = gridsec("replay", str(file), "--json")
    assert told.returncode == 0, told.stderr
    transitions = [json.loads(line) for line in told.stdout.splitlines()]
    truth = read_recording(file).truth()
    lying = {load(FEEDER).meter_ids[k] for k in truth.manipulated.any(axis=0).nonzero()[0]}
    assert len(lying) == 2
    for change in ("raised", "cleared"):
        assert {t["alarm"]["meter"] for t in transitions if t["change"] == change} == lying
    summary = gridsec("replay", str(file)).stdout
    assert "never arrived" in summary
    assert "attacked" in summary


def test_a_recording_knows_its_season(gridsec: Run, tmp_path: Path) -> None:
    file = tmp_path / "noon.parquet"
    made = gridsec("simulate", FEEDER, "--out", str(file), "--duration", "3", "--season", "winter")
    assert made.returncode == 0, made.stderr
    scenario = read_recording(file).scenario
    assert scenario is not None
    assert scenario.season == "winter"


def test_a_recording_of_a_folder_asks_where_that_is(gridsec: Run, tmp_path: Path) -> None:
    folder, file = tmp_path / "mine", tmp_path / "day.parquet"
    shutil.copytree(CASES.parents[1] / "data/feeders" / FEEDER, folder)
    meta = folder / "feeder.toml"
    meta.write_text(meta.read_text().replace(f'name = "{FEEDER}"', 'name = "mine-alone"'))
    made = gridsec("simulate", str(folder), "--out", str(file), "--duration", "2", "--start", "1795212000")
    assert made.returncode == 0, made.stderr
    told = gridsec("replay", str(file))
    words = " ".join(refused(told.returncode, told).split())
    assert "recorded on 'mine-alone': give its folder with --feeder" in words
    assert told.returncode == gridsec("replay", str(file), "--feeder", str(tmp_path / "no")).returncode > 0


def test_a_recording_of_another_feeder_is_not_replayed(gridsec: Run, tmp_path: Path) -> None:
    file = tmp_path / "day.parquet"
    made = gridsec("simulate", FEEDER, "--out", str(file), "--duration", "2", "--start", "1795212000")
    assert made.returncode == 0, made.stderr
    told = gridsec("replay", str(file), "--feeder", "cigre-lv")
    assert f"recorded on {FEEDER}, not on cigre-lv" in plain(refused(6, told))
    assert not told.stdout


def test_a_wrong_inverter_is_recorded_and_raises_its_alarm(gridsec: Run, tmp_path: Path) -> None:
    """Both named through files alone: a feeder's file that chooses the estimator, and a recording."""
    folder, file = tmp_path / FEEDER, tmp_path / "day.parquet"
    shutil.copytree(CASES.parents[1] / "data/feeders" / FEEDER, folder)
    meta = folder / "feeder.toml"
    text = meta.read_text().replace('estimator = "modal"', 'estimator = "unknown-input"')
    meta.write_text(text.replace("max_attacked = 2", "max_attacked = 1"))
    made = gridsec(
        "simulate", str(folder), "--out", str(file), "--duration", "40", "--seed", "4", "--report-q",
        "--attack", "bias:1:0.05:15:30", "--inverter-attack", "LV1.101 Load 2:-10:15:30",
        "--start", "1795212000",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    told = gridsec("replay", str(file), "--feeder", str(folder), "--json")
    assert told.returncode == 0, told.stderr
    alarms = [t["alarm"] for t in map(json.loads, told.stdout.splitlines()) if t["change"] == "raised"]
    (inverter,) = [a for a in alarms if a["kind"] == "inverter-manipulated"]
    assert (inverter["customer"], inverter["meter"]) == ("LV1.101 Load 2", "m02")
    assert inverter["evidence"]["attack_kvar_estimated"] == pytest.approx(-10.0, abs=1.9)
    truth = read_recording(file).truth()
    lying = {load(FEEDER).meter_ids[k] for k in truth.manipulated.any(axis=0).nonzero()[0]}
    assert {a["meter"] for a in alarms if a["kind"] == "meter-manipulated"} == lying


@pytest.mark.canary("15")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_service_in_time_even_with_a_stream_open(number: int, tmp_path: Path) -> None:
    with serving(tmp_path) as (child, url, zenoh):
        with (
            MeterClient(BusConfig("client", connect=(zenoh,)), "gridsec"),
            httpx.stream("GET", f"{url}/api/v1/alarms/stream", timeout=10.0) as stream,
        ):
            assert stream.status_code == 200
            child.send_signal(number)
            assert ended(child) < SOON_S
        assert child.returncode == 0
        assert "Traceback" not in (tmp_path / "log").read_text()


@pytest.mark.acceptance
def test_the_service_of_a_starter_that_has_gone_ends(tmp_path: Path) -> None:
    with serving(tmp_path, "--until-eof") as (child, _url, _zenoh):
        assert child.stdin is not None
        child.stdin.close()
        assert ended(child) < SOON_S
        assert child.returncode == 0


@pytest.mark.acceptance
def test_an_acknowledged_alarm_survives_kill_9(tmp_path: Path) -> None:
    site = load(FEEDER)
    start = 1_795_212_000.0
    attacks = random_attacks(site, 2, "bias", 1, 0.03, t_on=start + 10, t_off=start + 1e6)
    scenario = Scenario(seed=1, start=start, duration_s=30.0, attacks=attacks)
    with serving(tmp_path, "--clock", "events") as (child, url, zenoh):
        with MeterClient(BusConfig("client", connect=(zenoh,)), "gridsec") as meters:
            for _ in play(site, scenario, meters, Pace(float("inf"), ahead=3)):
                pass
            (alarm,) = until(lambda: httpx.get(f"{url}/api/v1/alarms").json()["alarms"])
            answer = httpx.post(f"{url}/api/v1/alarms/{alarm['id']}/ack", json={"who": "Ada"})
            child.kill()
            child.wait()
        assert answer.status_code == 200
        assert answer.json()["state"] == "acknowledged"
    with serving(tmp_path, "--clock", "events") as (_child, url, zenoh):
        (after,) = httpx.get(f"{url}/api/v1/alarms").json()["alarms"]
        # The list adds the incident, shelves and planned work.
        assert {name: after[name] for name in answer.json()} == answer.json()
        events = httpx.get(f"{url}/api/v1/alarms/{alarm['id']}/events").json()["events"]
        assert [e["change"] for e in events] == ["raised", "acknowledged"]
        # Still lying: the same alarm stands, no second one is raised.
        with MeterClient(BusConfig("client", connect=(zenoh,)), "gridsec") as meters:
            later = Scenario(seed=1, start=start + 30.0, duration_s=20.0, attacks=attacks)
            for _ in play(site, later, meters, Pace(float("inf"), ahead=3)):
                pass
        assert [a["id"] for a in httpx.get(f"{url}/api/v1/alarms").json()["alarms"]] == [alarm["id"]]


@pytest.mark.canary("False")
@pytest.mark.parametrize("disk", [True, False])
def test_a_log_that_cannot_be_written_stops_nothing(tmp_path: Path, disk: bool) -> None:
    """A full disk, or a pipe whose reader has gone."""
    if disk:
        log = Path("/dev/full").open("w")  # noqa: SIM115 - `serving` closes it
    else:
        reader, writer = os.pipe()
        os.close(reader)
        log = os.fdopen(writer, "w")
    site, start = load(FEEDER), 1_795_212_000.0
    attacks = random_attacks(site, 2, "bias", 1, 0.03, t_on=start + 10, t_off=start + 20)
    scenario = Scenario(seed=1, start=start, duration_s=40.0, attacks=attacks)
    with serving(tmp_path, "--clock", "events", log=log) as (child, url, zenoh):
        with MeterClient(BusConfig("client", connect=(zenoh,)), "gridsec") as meters:
            for _ in play(site, scenario, meters, Pace(float("inf"), ahead=3)):
                pass
            until(
                lambda: (
                    [a["state"] for a in httpx.get(f"{url}/api/v1/alarms").json()["alarms"]] == ["cleared"]
                )
            )
        assert child.poll() is None
        assert httpx.get(f"{url}/readyz").status_code == 200
        lines = httpx.get(f"{url}/metrics").text.splitlines()
        assert (
            next(float(line.split()[1]) for line in lines if line.startswith("gridsec_log_lines_lost")) >= 3
        )


@pytest.mark.acceptance
def test_simulate_onto_zenoh_in_step_with_a_service(gridsec: Run, tmp_path: Path) -> None:
    with serving(tmp_path, "--clock", "events") as (_child, url, zenoh):
        done = gridsec(
            "simulate", FEEDER, "--connect", zenoh, "--duration", "120", "--speed", "0", "--lockstep", "3",
            "--start", "1795212000",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "120 ticks" in done.stdout
        until(lambda: httpx.get(f"{url}/api/v1/feeders/{FEEDER}/state").json()["t"] >= 1_795_212_000.0 + 118)
        assert 'outcome="accepted"} 1680.0' in httpx.get(f"{url}/metrics").text


@pytest.mark.acceptance
def test_demo_shows_and_checks(gridsec: Run) -> None:
    """A short demo; the port of the web page is taken, so it has to find another."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        done = gridsec("demo", "--duration", "36", "--check", "--http", address, "--seed", "4")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "attack starts" in done.stdout
    assert "alarm: meter-manipulated" in done.stdout
    assert f"http://{address}/" not in done.stdout


def test_demo_fails_for_every_kind_of_mistake() -> None:
    assert verdict(DemoResult({"a", "b"}, {"a", "b"})) == ()
    assert verdict(DemoResult({"a", "b"}, {"a", "c"}, ["alarms still active: undecided x"])) == (
        "alarms still active: undecided x",
        "manipulated and not named: b",
        "named and not manipulated: c",
    )
    assert verdict(DemoResult()) == ("no meter was manipulated",)


def test_demo_does_not_check_what_need_not_show(gridsec: Run) -> None:
    for kind in ("stuck", "replay"):
        done = gridsec("demo", "--kind", kind, "--check", "--duration", "30")
        assert done.returncode == 2
        assert "--check" in done.stderr
    done = gridsec("demo", "--kind", "nonsense")
    assert done.returncode == 2
    assert "coordinated-power" in done.stderr


def test_demo_of_a_feeder_that_is_none(gridsec: Run) -> None:
    assert "atlantis" in refused(3, gridsec("demo", "--feeder", "atlantis", "--duration", "30"))


@pytest.mark.parametrize(("stated", "expected"), [(None, {1}), ("2", {2})])
def test_blas_has_one_thread_unless_stated(stated: str | None, expected: set[int]) -> None:
    """The libraries of the command line's own imports and later ones."""
    environment = {k: v for k, v in os.environ.items() if k not in BLAS_THREADS}
    if stated is not None:
        environment["OPENBLAS_NUM_THREADS"] = stated
    script = """
import contextlib, sys
from service.cli.main import main
sys.argv = ["gridsec", "--help"]
with contextlib.suppress(SystemExit):
    main()
import numpy, scipy.linalg, threadpoolctl
print(*(one["num_threads"] for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"))
"""
    command = [sys.executable, "-c", script]
    made = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found = [int(word) for word in made.stdout.splitlines()[-1].split()]
    assert len(found) >= 2
    assert set(found) == expected

"""The busbar's own meter, from its reading to alarms, states and what is kept of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from feeders.model.site import Site, load
from feeders.simulation.attacks import NoSuchAttack, busbar_attack
from feeders.simulation.recording import read_recording
from feeders.simulation.scenario import Scenario, by_arrival, simulate
from feeders.simulation.scenario import SimulatedReading as Said
from gridsec.attack import Bias
from gridsec.estimators.front import SuspicionRecord
from gridsec.interface import Cause, Decision, Estimate, Explanation, Verdict
from service.alarms.conditions import AlarmKind, Condition, Severity, conditions
from service.alarms.state_machine import AlarmBook, Change
from service.api.models import State
from service.cli.simulate import key_of, payload_of
from service.engine.feeder_monitor import FeederMonitor, align_rules, design
from service.ingest.align import Clock, Tick
from service.ingest.reading import Reading
from service.report.report import BUSBAR, BusbarMeterState, FeederReport, blind, build, busbar_report, to_json
from service.store.series import pack, unpack
from service.store.state_codec import KeptInvalid, decode_distrust, encode_distrust
from tests.codes import refused
from tests.service.commands import command, plain
from tests.service.played import ingest
from tests.service.reports import meter, report
from tests.service.running import FEEDER, InProcess, service, until
from tests.service.ticks import tick_of

START = 1_795_212_000.0
EUROPEAN = "ieee-european-lv"


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


@pytest.fixture(scope="module")
def european() -> Site:
    return load(EUROPEAN)


def tick(site: Site, v_volt: float | None, v_phases: tuple[float, ...] | None = None) -> Tick:
    """All meters read nominal, the busbar's something else."""
    readings = tuple(Reading(site.feeder.name, one, START, site.feeder.base_volt) for one in site.meter_ids)
    busbar = None if v_volt is None else Reading(site.feeder.name, None, START, v_volt, v_phases=v_phases)
    return tick_of(START, readings, busbar, ())


def said(
    site: Site, named: Sequence[bool], off: Sequence[float], lying: Sequence[int] = ()
) -> tuple[Estimate, Verdict]:
    """Nominal voltage everywhere; the busbar's meter is off by so many volts where it is named."""
    p, base = len(site.meter_ids), site.feeder.base_volt
    nominal = (site.nominal_volt / site.base_volt) ** 2
    suspects, which = np.isin(np.arange(p), lying), np.array(named)
    attack = np.where(which, (1.0 + np.array(off) / base) ** 2 - 1.0, 0.0)
    none = np.zeros(p)
    estimate = Estimate(
        START, nominal[site.feeder.bus], none, nominal, ~suspects, np.zeros(site.droop.tau.size)
    )
    verdict = Verdict(
        Decision.ATTACKED, Cause.RESIDUALS, "", suspects, none, none, none, busbar=which, busbar_attack=attack
    )
    return estimate, verdict


def alarm(now: FeederReport) -> Condition | None:
    found = [c for c in conditions(now) if c.kind is AlarmKind.METER_MANIPULATED and c.meter == BUSBAR]
    assert len(found) <= 1
    return found[0] if found else None


# ----------------------------------------------------------------------------------------- what is said of it


def test_it_is_reported_in_volts_and_named_in_words(site: Site) -> None:
    base = site.feeder.base_volt
    found = build(site, tick(site, base + 6.9), 2, *said(site, [True], [6.9]))
    assert found.busbar == BusbarMeterState(
        True, True, True, (), None, base + 6.9, pytest.approx(base), pytest.approx(6.9)
    )
    assert found.suspects == (BUSBAR,)
    off = "reads 6.9 V (3.0 %) more than the meters of the feeder imply."
    assert found.reason == f"Manipulated: the substation's meter; it {off}"
    beside = build(site, tick(site, base - 2.3), 2, *said(site, [True], [-2.3], lying=(1, 2)))
    assert beside.suspects == ("m02", "m03", BUSBAR)
    assert beside.reason == (
        "Manipulated: m02 · LV1.101 Load 2, m03 · LV1.101 Load 3 and the substation's meter; further off "
        "than meter accuracy and load uncertainty allow. The substation's meter reads 2.3 V (1.0 %) less "
        "than the meters of the feeder imply."
    )
    silent = build(site, tick(site, None), 2, *said(site, [True], [6.9]))
    assert silent.reason == "Manipulated: the substation's meter; it has no reading at present."
    assert (silent.busbar.seen, silent.busbar.suspect) == (False, True)
    assert silent.busbar.v_volt_reported is silent.busbar.attack_volt_estimated is None


def test_in_three_phases_the_one_furthest_off_is_shown(european: Site) -> None:
    base = european.feeder.base_volt
    now = tick(european, base, (base + 1.0, base - 7.0, base + 9.0))
    found = build(european, now, 2, *said(european, [True, True, False], [1.0, -7.0, 0.0]))
    busbar = found.busbar
    assert (busbar.phases, busbar.phase) == (("a", "b"), "b")
    assert busbar.v_volt_reported == pytest.approx(base - 7.0)
    assert busbar.attack_volt_estimated == pytest.approx(-7.0)
    assert "the substation's meter (phases a, b); it reads 7.0 V (2.9 %) less" in found.reason
    known = alarm(found)
    assert known is not None
    assert (
        known.reason
        == f"reports {base - 7.0:.1f} V in phase b, but the meters of the feeder imply {base:.1f} V"
    )
    # A phase in question that is not heard leaves the other; where nobody is named, all are in question.
    half = tick(european, base, (base + 1.0, np.nan, base))
    estimate, verdict = said(european, [True, True, False], [1.0, -7.0, 0.0])
    assert busbar_report(european, half, estimate, verdict).phase == "a"
    honest = said(european, [False] * 3, [0.0] * 3)
    shown = busbar_report(european, now, *honest)
    assert (shown.phases, shown.phase, shown.attack_volt_estimated) == ((), "c", 0.0)
    # One voltage for all phases is shown as it is.
    assert busbar_report(european, tick(european, base + 1.0), *honest).v_volt_reported == base + 1.0


def test_explanations_and_the_monitor_s_own_sentence_name_it_too(site: Site) -> None:
    p, m = len(site.meter_ids), site.droop.tau.size
    which = np.arange(p) == 4
    nothing, none = np.zeros(p, dtype=np.bool_), np.zeros(m, dtype=np.bool_)
    here = np.array([True])
    ways = (Explanation(nothing, none, 0.7, busbar=here), Explanation(which, none, 0.3, busbar=~here))
    estimate, verdict = said(site, [False], [0.0])
    doubt = replace(verdict, decision=Decision.UNDECIDED, cause=Cause.AMBIGUOUS, explanations=ways)
    found = build(site, tick(site, 231.0), 2, estimate, doubt)
    assert found.reason == (
        "Several explanations fit: the substation's meter (70%) or else m05 · LV1.101 Load 5 (30%)."
    )
    assert [one["meters"] for one in to_json(found)["explanations"]] == [[BUSBAR], ["m05"]]
    told = "The meter of the busbar (phase b) reads 3.0 % more than the meters of the feeder say, and so on."
    for cause in (Cause.AMBIGUOUS, Cause.TOO_FEW_METERS):
        now = replace(doubt, explanations=(), reason=told, cause=cause)
        found = build(site, tick(site, 231.0), 2, estimate, now)
        assert found.reason == told.replace("The meter of the busbar", "The substation's meter")


def test_the_state_says_it_and_older_ones_can_be_read(site: Site) -> None:
    base = site.feeder.base_volt
    state = to_json(build(site, tick(site, base + 6.9), 2, *said(site, [True], [6.9]))) | {"age_s": 0.0}
    read = TypeAdapter(State).validate_python(json.loads(json.dumps(state, allow_nan=False))).busbar
    assert (read.meter, read.judged, read.seen, read.suspect) == (BUSBAR, True, True, True)
    assert (read.phases, read.phase, read.attack_volt_estimated) == ((), None, pytest.approx(6.9))
    del state["busbar"]
    assert not TypeAdapter(State).validate_python(state).busbar.judged


def test_who_does_not_judge_it_says_so(site: Site) -> None:
    estimate, verdict = said(site, [True], [6.9])
    empty = np.zeros(0)
    found = build(
        site, tick(site, 231.0), 2, estimate, replace(verdict, busbar=empty.astype(bool), busbar_attack=empty)
    )
    assert (found.busbar.judged, found.busbar.suspect, found.busbar.v_volt_reported) == (False, False, 231.0)
    assert found.busbar.attack_volt_estimated is None
    unknown = alarm(found)
    assert unknown is not None
    assert not unknown.known
    early = blind(site, tick(site, 231.0), 2, Cause.SETTLING, "not yet")
    assert early.busbar == BusbarMeterState(False, True, False, v_volt_reported=231.0)


# ----------------------------------------------------------------------------------------- alarms and history


def test_its_alarm_is_known_only_if_decided_judged_and_seen() -> None:
    liar = BusbarMeterState(True, True, True, (), None, 238.0, 231.0, 7.0)
    now = replace(report(meter("m1"), cause=Cause.RESIDUALS), busbar=liar)
    found = alarm(now)
    assert found is not None
    assert (found.known, found.severity) == (True, Severity.CRITICAL)
    numbers = found.evidence
    shown = (numbers.v_volt_reported, numbers.v_volt_estimated, numbers.attack_volt_estimated)
    assert shown == (238.0, 231.0, 7.0)
    assert found.reason == "reports 238.0 V, but the meters of the feeder imply 231.0 V"
    for other in (
        replace(now, verdict=Decision.UNDECIDED),
        replace(now, busbar=replace(liar, seen=False)),
        replace(now, busbar=replace(liar, judged=False)),
    ):
        held = alarm(other)
        assert held is not None
        assert not held.known
    assert alarm(replace(now, busbar=replace(liar, suspect=False))) is None


def test_history_has_it_among_suspects_and_not_among_the_meters() -> None:
    liar = BusbarMeterState(True, True, True, (), None, 999.0, 999.0, 7.0)
    now = replace(report(meter("m1"), meter("m2", seen=False)), busbar=liar)
    names = now.row.meters
    found = unpack(pack(now.row), names, BUSBAR)
    assert (found["seen"], found["suspects"], found["v_volt_highest"]) == (1, [BUSBAR], 230.0)
    assert (found["meter"]["v_volt_reported"], found["meter"]["score"]) == (999.0, None)


# ------------------------------------------------------------------------------------- what is kept, and lies


@pytest.mark.parametrize("name", [FEEDER, EUROPEAN])
def test_what_is_kept_of_it_comes_back(name: str) -> None:
    site = load(name)
    b = 3 if name == EUROPEAN else 1
    which = np.arange(b) == b - 1
    nothing = SuspicionRecord.empty(len(site.meter_ids), site.droop.tau.size, b)
    before = replace(
        nothing,
        busbar_scale_s=np.where(which, 60.0, np.nan),
        busbar_named=which,
        busbar_off=np.where(which, 0.1 + 0.2, 0.0),
    )
    kept = encode_distrust(site, START, before)
    again = decode_distrust(site, kept)
    assert again.same(before)
    np.testing.assert_array_equal(again.busbar_off, before.busbar_off)
    whole = json.loads(kept.text)
    (phase,) = whole["busbar"]
    assert phase["phase"] == ("c" if b == 3 else None)
    # Texts from before it was judged, and a phase that the feeder does not have (any more).
    old = {key: value for key, value in whole.items() if key != "busbar"}
    gone = whole | {"busbar": [phase | {"phase": None if b == 3 else "a"}]}
    for other in (old, gone):
        assert decode_distrust(site, replace(kept, text=json.dumps(other))).same(nothing)
    for code, bad in (
        ("duplicate", [phase, phase]),
        ("damaged", [phase | {"phase": "d"}]),
        ("damaged", [phase | {"off": None}]),
        ("damaged", [phase | {"scale_s": 0.0}]),
    ):
        with refused(KeptInvalid, code):
            decode_distrust(site, replace(kept, text=json.dumps(whole | {"busbar": bad})))


def test_a_busbar_meter_lies_as_it_is_told_to(site: Site, european: Site) -> None:
    for where, phases in ((site, 1), (european, 3)):
        honest = list(simulate(where, Scenario(start=START, duration_s=6.0)))
        for kind, size, first in (("bias", -0.03, -0.03), ("scaling", 0.02, 0.02), ("drift", 0.01, 0.0)):
            lie = busbar_attack(where, kind, size, t_on=START + 2, t_off=START + 5)
            lying = simulate(where, Scenario(start=START, duration_s=6.0, busbar_attacks=(lie,)))
            pairs = list(zip(lying, honest, strict=True))
            ratio = np.array([np.ravel(one.reported.v0_volt / true.reported.v0_volt) for one, true in pairs])
            assert ratio.shape == (6, phases)
            shape = np.array([0.0, 0.0, first, size, size, 0.0])
            np.testing.assert_allclose(ratio - 1.0, np.tile(shape[:, None], phases), atol=0.002)
            np.testing.assert_array_equal(ratio[[0, 1, 5]], 1.0)
            for one, true in pairs:
                np.testing.assert_array_equal(one.reported.v_volt, true.reported.v_volt)
    with pytest.raises(NoSuchAttack, match="not by replay"):
        busbar_attack(site, "replay", 0.03, t_on=START, t_off=START + 5)
    lie = busbar_attack(european, "bias", 0.03, t_on=START, t_off=START + 5)
    with pytest.raises(ValueError, match="phases that"):
        next(iter(simulate(site, Scenario(start=START, busbar_attacks=(lie,)))))


def test_the_command_line_takes_it_where_it_takes_a_number_of_meters(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run, file = command("simulate", FEEDER, "--duration", "30", "--out"), str(tmp_path / "x.parquet")
    lies = ("--attack", "bias:substation:-0.03:20:55", "--attack", "bias:1:0.02:20:55")
    code, _, problem = run(monkeypatch, capsys, file, *lies)
    assert code == 0, problem
    scenario = read_recording(file).scenario
    assert scenario is not None
    (lie,), (other,) = scenario.busbar_attacks, scenario.attacks
    assert isinstance(lie, Bias)
    assert (lie.size.tolist(), lie.t_on - scenario.start, lie.t_off - scenario.start) == ([-0.03], 20.0, 55.0)
    assert isinstance(other, Bias)
    code, _, problem = run(monkeypatch, capsys, file, "--attack", "stuck:substation:0:20:55")
    assert code > 0
    assert "by bias, scaling or drift, not by stuck" in plain(problem)


def test_one_reading_in_between_does_not_end_its_data_loss(site: Site) -> None:
    readings = [
        r
        for r in by_arrival(simulate(site, Scenario(start=START, duration_s=120.0)))
        if r.meter or r.t - START in (0.0, 80.0)
    ]
    watch = FeederMonitor(site, align_rules(site, Clock.EVENTS), AlarmBook(FEEDER))
    watch.install(design(site))
    seen = []
    for r in readings:
        for result in ingest(watch, Reading(FEEDER, r.meter or None, r.t, r.v_volt), r.arrival):
            seen += [t.change for t in result.transitions if t.alarm.kind is AlarmKind.DATA_LOSS]
    assert seen == [Change.RAISED]


# ------------------------------------------------------------------------------------------ the whole service


def play(live: InProcess, readings: list[Said], begin: float, end: float) -> dict[str, Any]:
    """Publish some seconds of readings, and return the state that the last complete tick of them comes to."""
    for reading in readings:
        if START + begin <= reading.t < START + end:
            live.put(key_of(FEEDER, reading.meter), payload_of(reading))
    until(lambda: live.state().get("t", 0.0) >= START + end - 1.0, f"the tick at {end - 1.0:g} s")
    return live.state()


def test_a_busbar_that_lies_has_its_alarm_which_stands_over_a_restart_and_clears(
    site: Site, tmp_path: Path
) -> None:
    lie = busbar_attack(site, "scaling", 0.03, t_on=START + 10, t_off=START + 32)
    scenario = Scenario(seed=3, start=START, duration_s=62.0, busbar_attacks=(lie,))
    readings = list(by_arrival(simulate(site, scenario)))
    with service(tmp_path, clock="events") as live:
        state = play(live, readings, 0, 10)
        assert (state["verdict"], state["busbar"]["judged"]) == ("clean", True)
        assert not state["busbar"]["suspect"]
        state = play(live, readings, 10, 20)
        busbar = state["busbar"]
        assert (state["verdict"], busbar["suspect"]) == ("attacked", True)
        assert not any(one["suspect"] for one in state["meters"])
        assert busbar["attack_volt_estimated"] == pytest.approx(0.03 * busbar["v_volt_estimated"], rel=0.1)
        assert "the substation's meter; it reads" in state["reason"]
        assert live.metric("gridsec_suspects", feeder=FEEDER) == 1.0
        (raised,) = until(lambda: live.alarms(meter=BUSBAR), "the alarm")
        assert (raised["kind"], raised["severity"], raised["state"]) == (
            "meter-manipulated",
            "critical",
            "raised",
        )
        assert raised["evidence"]["v_volt_reported"] > 1.02 * raised["evidence"]["v_volt_estimated"]
        assert live.alarms() == [raised]
        points = live.get(f"/api/v1/feeders/{FEEDER}/history", meter=BUSBAR)["points"]
        assert [BUSBAR] in [point["suspects"] for point in points]
        assert points[0]["meter"]["seen"]
    with service(tmp_path, clock="events") as live:
        state = play(live, readings, 21, 30)
        assert state["verdict"] == "attacked"
        assert live.alarms() == [raised]
        verdicts = [point["verdict"] for point in live.get(f"/api/v1/feeders/{FEEDER}/history")["points"]]
        assert "clean" not in verdicts[verdicts.index("attacked") :]
        state = play(live, readings, 30, 62)
        assert state["verdict"] == "clean"
        assert not state["busbar"]["suspect"]
        (cleared,) = until(lambda: live.alarms(meter=BUSBAR, state="cleared"), "its end")
        assert cleared["id"] == raised["id"]

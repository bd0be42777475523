"""Reports say in volts and ids what the monitor says per unit and by index."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import Site, load, to_frame
from feeders.registry import choose
from feeders.simulation.plant import MeterErrors
from feeders.simulation.scenario import Scenario, random_attacks, simulate
from gridsec.attack import InverterAttack
from gridsec.interface import Cause, Decision, Estimate, Explanation, ManipulationKind, Verdict
from service.alarms.conditions import AlarmKind, conditions
from service.engine.feeder_monitor import design
from service.ingest.align import Tick
from service.ingest.reading import P_KW, T_POWER, Reading
from service.report.report import (
    BUSBAR,
    ExplanationReport,
    FeederReport,
    Silence,
    blind,
    build,
    snapshot,
    to_json,
)
from tests.service.ticks import tick_of

T = 1_795_212_000.0


@pytest.fixture(scope="module")
def site() -> Site:
    return load("simbench-lv-rural1")


def tick(site: Site, lie: dict[int, float] | None = None, unseen: tuple[int, ...] = ()) -> Tick:
    base = site.feeder.base_volt
    readings = tuple(
        None if k in unseen else Reading(site.feeder.name, meter, T, base + (lie or {}).get(k, 0.0), 1.0)
        for k, meter in enumerate(site.meter_ids)
    )
    silent = tuple((site.meter_ids[k], math.inf) for k in unseen)
    return tick_of(T, readings, Reading(site.feeder.name, None, T, 1.01 * base), (*silent, (None, 12.5)))


def judged(site: Site, lie: float, meter: int) -> tuple[Estimate, Verdict]:
    """An estimate of exactly 1 pu everywhere, half-width 0.01, and a verdict that names one meter."""
    n, p, base = len(site.feeder.customers), len(site.meter_ids), site.feeder.base_volt
    suspects = np.zeros(p, dtype=bool)
    suspects[meter] = True
    attack = np.where(suspects, (1.0 + lie / base) ** 2 - 1.0, 0.0)
    score = np.abs(attack)
    score[0] = np.nan
    return (
        Estimate(T, np.ones(n), np.full(n, 0.01), np.ones(len(site.feeder.buses)), ~suspects, np.zeros(9)),
        Verdict(Decision.ATTACKED, Cause.RESIDUALS, "why", suspects, score, np.full(p, 0.02), attack),
    )


def test_volts_and_names(site: Site) -> None:
    base = site.feeder.base_volt
    report = build(site, tick(site, {3: 6.0}, (0,)), 2, *judged(site, 6.0, 3))
    liar, absent = report.meters[3], report.meters[0]
    assert (report.feeder, report.verdict, report.max_attacked) == (site.feeder.name, Decision.ATTACKED, 2)
    assert liar.meter == site.meter_ids[3]
    assert liar.bus == site.tables.customers[3].bus
    assert liar.suspect
    assert liar.v_volt_reported == pytest.approx(base + 6.0)
    assert liar.v_volt_estimated == pytest.approx(base)
    assert liar.attack_volt_estimated == pytest.approx(6.0)
    half_width = 0.5 * base * (math.sqrt(1.01) - math.sqrt(0.99))
    assert liar.v_volt_std == pytest.approx(half_width / 3.0)
    assert (absent.seen, absent.v_volt_reported, absent.score, absent.attack_volt_estimated) == (
        False,
        None,
        None,
        0.0,
    )
    assert report.silent == (Silence(site.meter_ids[0], None), Silence(BUSBAR, 12.5))
    assert (report.buses[0].bus, report.buses[0].v_volt) == (site.feeder.buses[0], pytest.approx(base))
    assert report.v_min_volt == pytest.approx(0.9 * base)


def test_reasons_name_meters_as_alarms_do(site: Site) -> None:
    customers = [site.feeder.customers[k] for k in site.meters]
    estimate, verdict = judged(site, 6.0, 3)

    def reason(
        cause: Cause, text: str = "", suspects: tuple[int, ...] = (), unseen: tuple[int, ...] = ()
    ) -> str:
        named = np.isin(np.arange(13), suspects)
        decision = Decision.ATTACKED if cause is Cause.RESIDUALS else Decision.UNDECIDED
        said = replace(verdict, cause=cause, reason=text, suspects=named, decision=decision)
        return build(site, tick(site, {}, unseen), 2, estimate, said).reason

    assert reason(Cause.RESIDUALS, suspects=(3, 12)).startswith(
        "Manipulated: m04 · LV1.101 Load 4, m13 · LV1.101 Load 13; further off"
    )
    many = reason(Cause.TOO_MANY_SUSPECTS, suspects=tuple(range(7)))
    five = ", ".join(f"m0{k} · LV1.101 Load {k}" for k in range(1, 6))
    assert many.startswith(f"7 meters disagree with the feeder ({five} and 2 more), and at most 2")
    assert reason(Cause.SILENT_METERS, unseen=(4,)) == "No reading from m05 · LV1.101 Load 5."
    for k, customer in enumerate(customers):  # One customer's name begins another's.
        text = f"The loads are not known well enough to judge {customer}, {customers[0]}."
        names = f"{site.meter_ids[k]} · {customer}, m01 · {customers[0]}"
        assert reason(Cause.AMBIGUOUS, text).endswith(f" judge {names}.")
    assert reason(Cause.NO_BUSBAR, "as it is") == "as it is"


def test_the_monitor_s_own_sentences_name_no_customer_alone(site: Site) -> None:
    """Whatever the monitor says over a real attack with a gap in it, the operator reads meters' names."""
    attacks = random_attacks(site, 5, "bias", 3, 0.03, t_on=T + 5, t_off=T + 30)
    names = re.compile("|".join(f"(?<! · ){re.escape(name)}" for name in site.feeder.customers))
    site = choose(site, estimator="exact-bank")
    finished, said = design(site), set()
    state = finished.init(T)
    for sample in simulate(site, Scenario(seed=4, start=T, duration_s=40.0, attacks=attacks)):
        heard = {r.meter: r for r in sample.readings if not (r.meter == "m01" and 32 <= sample.t - T < 36)}
        readings = tuple(heard.get(meter) for meter in site.meter_ids)
        now = tick_of(sample.t, readings, heard[""], ())  # type: ignore[arg-type]
        state, estimate, verdict = finished.step(state, to_frame(site, snapshot(site, now)))
        report = build(site, now, 2, estimate, verdict)
        said.add(report.cause)
        assert not names.search(report.reason), report.reason
        if report.cause is Cause.TOO_MANY_SUSPECTS:
            assert all(site.meter_ids[k] in report.reason for k in np.flatnonzero(verdict.suspects))
    assert {Cause.AGREEMENT, Cause.TOO_MANY_SUSPECTS, Cause.SILENT_METERS} <= said


def test_json_is_plain_and_has_no_nan(site: Site) -> None:
    estimate, verdict = judged(site, 6.0, 3)
    blank = replace(estimate, v2=np.full_like(estimate.v2, np.nan), bound=np.full_like(estimate.v2, np.inf))
    text = json.dumps(to_json(build(site, tick(site, {}, (0,)), 2, blank, verdict)), allow_nan=False)
    found = json.loads(text)
    assert found["verdict"] == "attacked"
    assert found["meters"][5]["v_volt_estimated"] is None
    assert found["silent"][0] == {"meter": site.meter_ids[0], "seconds": None}
    assert [c["customer"] for c in found["customers"]] == list(site.feeder.customers)
    assert {i["judged"] for i in found["inverters"]} == {False}
    assert found["explanations"] == []
    wanted = {
        "clock_offset_s",
        "customer",
        "kind",
        "learning_reason",
        "learning_state",
        "model_only",
        "phase",
        "v_min_volt",
        "v_max_volt",
        "meter",
        "bus",
        "seen",
        "suspect",
        "score",
        "threshold",
        "v_volt_reported",
        "v_volt_estimated",
    }
    assert wanted | {"v_volt_std", "v2_pu_estimated", "attack_volt_estimated"} == set(found["meters"][0])


def test_blind_reports_are_undecided_and_estimate_nothing(site: Site) -> None:
    report = blind(site, tick(site), 2, Cause.DESIGN_INVALID, "because")
    assert (report.verdict, report.cause, report.reason) == (
        Decision.UNDECIDED,
        Cause.DESIGN_INVALID,
        "because",
    )
    assert all(m.seen and not m.suspect and m.v_volt_estimated is None for m in report.meters)
    json.dumps(to_json(report), allow_nan=False)


def test_snapshots_keep_the_order_of_the_meters(site: Site) -> None:
    found = snapshot(site, tick(site, {4: 3.0}, (0, 2)))
    assert np.flatnonzero(np.isnan(found.v_volt)).tolist() == [0, 2]
    assert found.v_volt[4] == pytest.approx(site.feeder.base_volt + 3.0)
    assert np.isnan(found.q_kvar).all()
    frame = to_frame(site, found)
    assert frame.seen.tolist() == [k not in (0, 2) for k in range(13)]
    assert frame.v0_squared == pytest.approx(1.01**2)


def test_snapshots_have_the_age_of_powers_with_a_time_of_their_own(site: Site) -> None:
    now = tick(site, unseen=(2,))
    assert snapshot(site, now).p_age_s is None
    values = now.values.copy()
    values[T_POWER, 0] = T - 60.0
    age = snapshot(site, replace(now, values=values)).p_age_s
    assert age is not None
    assert age[0] == 60.0
    assert np.isnan(age[1:]).all()


def test_a_withheld_power_is_a_reason_with_the_ids_of_meters(site: Site) -> None:
    """Readings of voltages alone: undecided, and the sentence names the setting."""
    watcher = design(site)
    state, whole = watcher.init(T - 1.0), tick(site)
    values = whole.values.copy()
    values[P_KW, :-1] = np.nan
    bare = replace(whole, values=values, silent=())
    _, estimate, verdict = watcher.step(state, to_frame(site, snapshot(site, bare)))
    verdict = replace(verdict, decision=Decision.UNDECIDED, cause=Cause.MISSING_POWERS)
    if "unread_std_percent" not in verdict.reason:
        names = ", ".join(site.feeder.customers[c] for c in site.meters[:2])
        verdict = replace(
            verdict, reason=f"No active power of the same moment from {names}: unread_std_percent."
        )
    report = build(site, bare, 2, estimate, verdict)
    assert "m01" in report.reason
    assert "unread_std_percent" in report.reason
    owners = dict(zip(site.meter_ids, (site.feeder.customers[c] for c in site.meters), strict=True))
    assert f"m01 · {owners['m01']}" in report.reason


def test_kinds_inverters_and_a_standard_deviation_of_its_own(site: Site) -> None:
    estimate, verdict = judged(site, 6.0, 3)
    m, base = site.droop.tau.size, site.feeder.base_volt
    named = np.arange(m) == 2
    estimate = replace(estimate, std=np.full(estimate.v2.size, 0.002), x=np.linspace(0.0, 0.08, m))
    verdict = replace(
        verdict,
        kinds=tuple(ManipulationKind.DRIFT if k == 3 else None for k in range(13)),
        inverters=named,
        inverter_attack=np.where(named, -0.1, 0.0),
    )
    report = build(site, tick(site, {3: 6.0}), 2, estimate, verdict)
    assert [meter.kind for meter in report.meters] == ["drift" if k == 3 else None for k in range(13)]
    wide = base * (math.sqrt(1.002) - math.sqrt(0.998)) / 2
    assert [c.v_volt_std for c in report.customers] == pytest.approx([wide] * len(report.customers))
    assert report.meters[0].v_volt_std == pytest.approx(wide)
    (wrong,) = [i for i in report.inverters if i.suspect]
    owner = site.feeder.customers[site.droop.customer[2]]
    assert (wrong.customer, wrong.judged, wrong.meter) == (owner, True, "m04")
    assert wrong.attack_kvar_estimated == pytest.approx(-0.1 * site.feeder.base_kva)
    assert wrong.q_kvar_estimated == pytest.approx(0.02 * site.feeder.base_kva)
    assert report.reason.startswith(
        f"Manipulated: m04 · LV1.101 Load 4 and the inverter of {owner}; further off"
    )


def test_ambiguity_is_one_sentence_and_a_list(site: Site) -> None:
    estimate, verdict = judged(site, 6.0, 3)
    p, m = len(site.meter_ids), site.droop.tau.size
    empty, none = np.zeros(p, dtype=bool), np.zeros(m, dtype=bool)
    customers = np.arange(len(site.feeder.customers))
    verdict = replace(
        verdict,
        decision=Decision.UNDECIDED,
        cause=Cause.AMBIGUOUS,
        suspects=empty,
        explanations=(
            Explanation(np.arange(p) == 1, none, 0.7, customers == 2),
            Explanation(empty, np.arange(m) == 1, 0.2),
            Explanation(empty, none, 0.1, customers < 2),
        ),
    )
    report = build(site, tick(site), 2, estimate, verdict)
    owner = site.feeder.customers[site.droop.customer[1]]
    a, b, c = site.feeder.customers[:3]
    assert report.reason == (
        f"Several explanations fit: m02 · {b} and the reported power of {c} (70%) or else the inverter of "
        f"{owner} (20%) or else the reported powers of {a}, {b} (10%)."
    )
    assert report.explanations == (
        ExplanationReport(("m02",), (), 0.7, (c,)),
        ExplanationReport((), (owner,), 0.2),
        ExplanationReport((), (), 0.1, (a, b)),
    )
    (found,) = [c for c in conditions(report) if c.kind is AlarmKind.UNDECIDED]
    assert found.evidence.explanations == report.explanations


def test_a_wrong_inverter_and_a_lying_meter_of_a_real_feeder(site: Site) -> None:
    """AC truth, the real estimator, and what the operator is told in the end."""
    site = choose(site, estimator="unknown-input", max_attacked=1)
    wrong = InverterAttack(np.array([1]), np.array([-0.1]), T + 10, T + 99)
    lies = random_attacks(site, 5, "bias", 1, 0.05, t_on=T + 10, t_off=T + 99)
    scenario = Scenario(
        seed=4,
        start=T,
        duration_s=16.0,
        attacks=lies,
        inverter_attacks=(wrong,),
        errors=MeterErrors(report_q=True),
    )
    finished = design(site)
    state, report = finished.init(T), None
    for sample in simulate(site, scenario):
        heard = {r.meter: r for r in sample.readings}
        now = tick_of(sample.t, tuple(heard[m] for m in site.meter_ids), heard[""], ())  # type: ignore[arg-type]
        state, estimate, verdict = finished.step(state, to_frame(site, snapshot(site, now)))
        report = build(site, now, 1, estimate, verdict)
    assert isinstance(report, FeederReport)
    found = {c.kind: c for c in conditions(report) if c.known}
    assert set(found) == {AlarmKind.METER_MANIPULATED, AlarmKind.INVERTER_MANIPULATED}
    assert found[AlarmKind.METER_MANIPULATED].meter == site.meter_ids[int(lies[0].meters[0])]
    inverter = found[AlarmKind.INVERTER_MANIPULATED]
    assert (inverter.customer, inverter.meter) == ("LV1.101 Load 2", "m02")
    assert inverter.evidence.attack_kvar_estimated == pytest.approx(-10.0, abs=1.9)
    assert inverter.reason.startswith("the inverter of LV1.101 Load 2 injects -9.")
    json.dumps(to_json(report), allow_nan=False)

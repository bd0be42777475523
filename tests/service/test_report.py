"""Reports say in volts and ids what the monitor says per unit and by index."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from feeders.load import Site, load, to_frame
from feeders.scenario import Scenario, random_attacks, simulate
from gridsec.online import Cause, Decision, Estimate, Verdict
from service.align import Tick
from service.reading import Reading
from service.report import BUSBAR, blind, build, snapshot, to_json
from service.watch import design

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
    return Tick(T, readings, Reading(site.feeder.name, None, T, 1.01 * base), (*silent, (None, 12.5)))


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
    assert report.silent == ((site.meter_ids[0], math.inf), (BUSBAR, 12.5))
    assert report.bus_v_volt[0] == (site.feeder.buses[0], pytest.approx(base))
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

    assert reason(Cause.RESIDUALS, suspects=(3, 12)).startswith("Manipulated: m04, m13; further off")
    many = reason(Cause.TOO_MANY_SUSPECTS, suspects=tuple(range(7)))
    assert many.startswith(
        "7 meters disagree with the feeder (m01, m02, m03, m04, m05 and 2 more), and at most 2"
    )
    assert reason(Cause.SILENT_METERS, unseen=(4,)) == "No reading from m05."
    for k, customer in enumerate(customers):  # One customer's name begins another's.
        text = f"The loads are not known well enough to judge {customer}, {customers[0]}."
        assert reason(Cause.AMBIGUOUS, text).endswith(f" judge {site.meter_ids[k]}, m01.")
    assert reason(Cause.NO_BUSBAR, "as it is") == "as it is"


def test_the_monitor_s_own_sentences_name_no_customer(site: Site) -> None:
    """Whatever the monitor says over a real attack with a gap in it, the operator reads meters' ids."""
    attacks = random_attacks(site, 5, "bias", 3, 0.03, t_on=T + 5, t_off=T + 30)
    names = re.compile("|".join(re.escape(name) for name in site.feeder.customers))
    finished, said = design(site), set()
    state = finished.init(T)
    for sample in simulate(site, Scenario(seed=4, start=T, duration_s=40.0, attacks=attacks)):
        heard = {r.meter: r for r in sample.readings if not (r.meter == "m01" and 32 <= sample.t - T < 36)}
        readings = tuple(heard.get(meter) for meter in site.meter_ids)
        now = Tick(sample.t, readings, heard[""], ())  # type: ignore[arg-type]
        state, estimate, verdict = finished.step(state, to_frame(site, snapshot(now)))
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
    wanted = {"meter", "bus", "seen", "suspect", "score", "threshold", "v_volt_reported", "v_volt_estimated"}
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
    found = snapshot(tick(site, {4: 3.0}, (0, 2)))
    assert np.flatnonzero(np.isnan(found.v_volt)).tolist() == [0, 2]
    assert found.v_volt[4] == pytest.approx(site.feeder.base_volt + 3.0)
    assert np.isnan(found.q_kvar).all()
    frame = to_frame(site, found)
    assert frame.seen.tolist() == [k not in (0, 2) for k in range(13)]
    assert frame.v0_squared == pytest.approx(1.01**2)

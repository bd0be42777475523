"""From a voltage reading on zenoh to the right alarm over REST, on a real feeder.

SimBench LV rural 1: 13 customers, watched by `modal`, seven seeds with one liar or two of every kind, and
by the exact bank of 78 + 715 observers (M = 2), the two seeds with two liars who scale their
readings or lie in agreement. Customers' meters of class 0.5 with 0.1 V resolution and 0.05 % jitter, a busbar
meter of class 0.1, p metered within 1 %, q not reported. The truth is full AC power flow with the droop
inverters in closed loop, at 1 Hz for five minutes; clean time at length is in test_clean_days.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from feeders.model.site import Site, load
from feeders.simulation.scenario import START, Scenario, random_attacks, simulate
from tests.acceptance.live import Fleet, serve

FEEDER = "simbench-lv-rural1"
KINDS = ("bias", "scaling", "coordinated")
DURATION_S = 300.0  # an attack ends after 210 s at the latest
RUNS = [
    ("modal", 101, 120.0),  # the attack ends after 95 s
    *(("modal", seed, DURATION_S) for seed in range(6)),
    *(("exact-bank", seed, DURATION_S) for seed in (4, 5)),
]
LIE_PU = 0.03
NAMED_WITHIN_S = 5.0
SETTLED_S = 5.0
VOLTAGE_ERROR_PU = 0.003


def scenario_of(site: Site, seed: int, duration_s: float) -> Scenario:
    """One seed's minutes: any time of the fourteen days, any onset, one or two liars anywhere."""
    random = np.random.default_rng([2020, seed])
    quiet = Scenario(
        seed=seed, duration_s=duration_s, profile_s=float(random.uniform(0.0, 13.9 * 86_400.0)), dt_s=1.0
    )
    t_on = START + float(random.integers(30, 90))
    attacks = random_attacks(
        site,
        seed,
        KINDS[seed % len(KINDS)],
        1 + seed // len(KINDS) % 2,
        LIE_PU,
        t_on=t_on,
        t_off=t_on + float(random.integers(60, 120)),
        scenario=quiet,
    )
    return Scenario(seed=seed, duration_s=duration_s, profile_s=quiet.profile_s, dt_s=1.0, attacks=attacks)


@pytest.mark.canary("modal-101-120.0")
@pytest.mark.parametrize(("estimator", "seed", "duration_s"), RUNS)
def test_exactly_the_manipulated_meters_are_named(
    estimator: str, seed: int, duration_s: float, tmp_path: Path
) -> None:
    site = load(FEEDER)
    nominal = site.feeder.base_volt
    limits = site.tables.meta.limits
    scenario = scenario_of(site, seed, duration_s)
    (attack,) = scenario.attacks
    liars = {site.meter_ids[j] for j in attack.meters}
    customer_of = dict(zip(site.meter_ids, site.meters, strict=True))
    worst = 0.0
    named_in_state: dict[str, float] = {}

    with serve(FEEDER, tmp_path, "--estimator", estimator) as live:
        with Fleet(live) as fleet:
            for sample, state in fleet.play(simulate(site, scenario)):
                lying = {site.meter_ids[j] for j in np.flatnonzero(sample.manipulated)}
                assert np.all(np.abs(sample.shift_volt[sample.manipulated]) >= (LIE_PU - 1e-3) * nominal)
                assert sample.v_volt.min() > limits.v_min_pu * nominal, "the scenario itself breaks a limit"
                assert sample.v_volt.max() < limits.v_max_pu * nominal, "the scenario itself breaks a limit"
                suspects = {meter["meter"] for meter in state["meters"] if meter["suspect"]}
                assert suspects <= liars, f"healthy meters named at {sample.t - START} s"
                for meter in suspects & lying:
                    named_in_state.setdefault(meter, sample.t)
                if sample.t < START + SETTLED_S:
                    continue
                for meter in state["meters"]:
                    if meter["meter"] in liars:
                        true = sample.v_volt[customer_of[meter["meter"]]]
                        worst = max(worst, abs(meter["v_volt_estimated"] - true) / nominal)
        alarms = live.alarms()
        counted = live.http.get("/metrics").text

    assert worst <= VOLTAGE_ERROR_PU
    assert {alarm["kind"] for alarm in alarms} == {"meter-manipulated"}
    assert sorted(alarm["meter"] for alarm in alarms) == sorted(liars)
    for alarm in alarms:
        assert attack.t_on <= named_in_state[alarm["meter"]] <= alarm["t_raised"]
        assert alarm["t_raised"] - attack.t_on <= NAMED_WITHIN_S
        assert alarm["state"] == "cleared"
        assert alarm["t_cleared"] > attack.t_off
    assert "gridsec_" in counted

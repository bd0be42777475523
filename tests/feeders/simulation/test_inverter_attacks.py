"""Inverters under attack in scenarios: the AC truth contains what they inject, and files keep it."""

from __future__ import annotations

import json

import numpy as np

from feeders.model.site import load
from feeders.simulation.plant import MeterErrors
from feeders.simulation.powerflow import PowerFlow
from feeders.simulation.recording import scenario_from_json, scenario_to_json
from feeders.simulation.scenario import START, Scenario, SimulatedTick, simulate
from gridsec.attack import InverterAttack
from gridsec.errors import InputInvalid
from tests.codes import refused

ON, OFF, KVAR = 4.0, 8.0, -12.0
SITE = load("simbench-lv-rural1")
ATTACK = InverterAttack(np.array([2]), np.array([KVAR / SITE.feeder.base_kva]), START + ON, START + OFF)
EXACT = MeterErrors(bias=0.0, jitter=0.0, resolution=0.0, power=0.0, report_q=True)


def play(*attacks: InverterAttack) -> list[SimulatedTick]:
    scenario = Scenario(seed=3, duration_s=12.0, errors=EXACT, inverter_attacks=attacks)
    return list(simulate(SITE, scenario))


def test_the_truth_is_the_power_flow_with_what_they_inject() -> None:
    """Oracle: an AC power flow of the powers that samples show, and the same scenario without the attack."""
    flow, owner = PowerFlow(SITE), int(SITE.droop.customer[2])
    for k, (with_it, without) in enumerate(zip(play(ATTACK), play(), strict=True)):
        on = ON <= k < OFF
        # Its own and all other droop curves answer to the voltage that it moved.
        answer = np.zeros(len(SITE.feeder.customers))
        np.add.at(answer, SITE.droop.customer, with_it.x_kvar - without.x_kvar)
        injected = np.where(np.arange(answer.size) == owner, KVAR if on else 0.0, 0.0)
        np.testing.assert_allclose(without.q_kvar - with_it.q_kvar, injected + answer, atol=1e-9)
        v_volt, _ = flow.solve(with_it.p_kw, with_it.q_kvar, with_it.v_bus_volt[0])
        np.testing.assert_allclose(with_it.v_volt, v_volt, rtol=1e-9)
        moved = with_it.v_volt[owner] - without.v_volt[owner]
        assert (moved < -0.1) == on
        # Nobody lies: meters report what is there.
        assert not with_it.manipulated.any()
        at = SITE.meters
        np.testing.assert_allclose(with_it.reported.q_kvar[0], with_it.q_kvar[at], atol=1e-9)
        np.testing.assert_allclose(with_it.reported.v_volt[0], with_it.v_volt[at], atol=1e-9)


def test_several_attacks_add_up() -> None:
    again = InverterAttack(np.array([2, 0]), np.array([0.02, -0.01]), START + ON, START + OFF)
    one, both = play(ATTACK)[5], play(ATTACK, again)[5]
    more = (one.q_kvar - both.q_kvar)[SITE.droop.customer]
    answer = both.x_kvar - one.x_kvar
    expected = np.zeros(more.size)
    expected[[2, 0]] = np.array([0.02, -0.01]) * SITE.feeder.base_kva
    np.testing.assert_allclose(more, expected + answer, atol=1e-9)


def test_a_scenario_keeps_them_in_its_file_form() -> None:
    scenario = Scenario(inverter_attacks=(ATTACK,))
    (found,) = scenario_from_json(json.loads(json.dumps(scenario_to_json(scenario)))).inverter_attacks
    assert found.inverters.tolist() == [2]
    assert found.q.tolist() == ATTACK.q.tolist()
    assert (found.t_on, found.t_off) == (START + ON, START + OFF)
    older = scenario_to_json(scenario)
    del older["inverter_attacks"]
    assert scenario_from_json(older).inverter_attacks == ()


def test_mistakes_are_refused() -> None:
    with refused(InputInvalid, "unknown-index"):
        play(InverterAttack(np.array([9]), np.array([0.1]), START, START + 1.0))
    with refused(InputInvalid, "shape"):
        InverterAttack(np.array([1, 2]), np.array([0.1]), START, START + 1.0)
    with refused(InputInvalid, "order"):
        InverterAttack(np.array([1]), np.array([0.1]), START, START)

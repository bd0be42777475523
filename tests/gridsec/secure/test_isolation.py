"""Banks of unknown-input observers: sets by brute force, theorems in trajectories, feeders."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from feeders.model.site import load
from feeders.simulation.powerflow import PowerFlow
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.estimators.detection import curve_mismatch
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.interface import Cause, Decision
from gridsec.observers.lmi.sampled import DiscreteLure, advance
from gridsec.observers.lure import close_loop, known_input
from gridsec.observers.unknown_input import UnknownInputPlant, exact, inverters, obstruction
from gridsec.papers import yang2021, yang2021_feeder
from gridsec.secure import isolation
from gridsec.secure.isolation import (
    IsolationDesign,
    IsolationStep,
    Measure,
    disagreement,
    init,
    members,
    step,
    support,
)
from tests.codes import refused

STEPS = 500
ALL4 = np.ones(4, dtype=np.bool_)


@cache
def complete() -> IsolationDesign:
    """Example 1, corrected, judged by bounds."""
    return isolation.design(yang2021.plant(1, corrected=True), max_inputs=2, max_sensors=1)


@cache
def partial() -> IsolationDesign:
    """Example 2 with two entries of C changed, which leaves every zero below 0.981."""
    plant = yang2021.plant(2)
    C = plant.system.C.copy()
    C[0, 0], C[1, 1] = 2.0, 4.0
    system = type(plant.system)(
        *(getattr(plant.system, name) for name in "AGHFB"), C, plant.system.D, plant.system.lower,
        plant.system.upper, plant.system.phi,
    )  # fmt: skip
    return isolation.design(
        UnknownInputPlant(system, plant.inputs, plant.noise, plant.drift, plant.span),
        max_inputs=1,
        max_sensors=1,
        rates=(0.8, 0.95, 0.985),
    )


def drive(
    made: IsolationDesign, a_u: Floats, a_y: Floats, seed: int = 0
) -> tuple[list[IsolationStep], Floats]:
    """Answers and true states for given attacks."""
    rng = np.random.default_rng(seed)
    plant = made.family.plant
    n, r = len(plant.system.A), plant.inputs.shape[1]
    x, state, answers, truth = rng.standard_normal(n), init(made, 0.0, radius=np.full(n, 6.0)), [], []
    for k in range(len(a_u)):
        u = rng.uniform(-5, 5, r)
        state, answer = step(made, state, plant.system.C @ x + a_y[k], u, ALL4)
        answers.append(answer)
        truth.append(x)
        x = advance(plant.system, x, u) + plant.inputs @ a_u[k]
    return answers, np.array(truth)


# Sets.


@pytest.mark.parametrize(("r", "p", "q1", "q2"), [(3, 4, 1, 1), (5, 5, 2, 2), (4, 6, 0, 1), (3, 5, 3, 2)])
def test_both_banks_hold_every_set_once(r: int, p: int, q1: int, q2: int) -> None:
    large, small = members(r, p, q1, q2)
    double = r if q1 == r else 2 * q1
    assert len(set(large)) == len(large) == comb(r, q1) * comb(p, q2)
    assert len(set(small)) == len(small) == comb(r, double) * comb(p, 2 * q2)
    assert {len(s) for _, s in small} == {p - 2 * q2}


@pytest.mark.parametrize(("r", "p", "q1", "q2"), [(2, 5, 2, 2), (3, 5, 1, 2), (5, 3, 2, 1)])
def test_lemmas_1_to_3_by_brute_force(r: int, p: int, q1: int, q2: int) -> None:
    """Whoever is attacked, each large set has a small one within it that is free of attacks."""
    large, small = members(r, p, q1, q2)
    for attacked_inputs in itertools.combinations(range(r), q1):
        for attacked_sensors in itertools.combinations(range(p), q2):
            clean = [
                (u, s)
                for u, s in small
                if set(attacked_inputs) <= set(u) and not set(attacked_sensors) & set(s)
            ]
            for big in large:
                assert any(set(u) >= set(big[0]) and set(s) <= set(big[1]) for u, s in clean)


def test_company_and_disagreement_are_those_of_the_definition() -> None:
    made = yang2021.bank(2)  # with missing members
    rng = np.random.default_rng(1)
    state = init(made, 0.0).family
    state = replace(state, x=rng.standard_normal(state.x.shape))
    place = {pair: i for i, pair in enumerate(made.family.pairs)}
    large, small = members(3, 4, 1, 1)
    by_hand = []
    for u, s in large:
        gaps = [
            np.linalg.norm(state.x[place[(u, s)]] - state.x[place[(v, t)]])
            for v, t in small
            if set(v) >= set(u) and set(t) <= set(s) and (v, t) in place
        ]
        by_hand.append(max(gaps))
    np.testing.assert_allclose(disagreement(made, state), by_hand, rtol=1e-12)


def test_too_few_sensors_or_inputs() -> None:
    with refused(NotObservable, "too-few-meters"):
        members(3, 4, 1, 2)
    with refused(NotObservable, "too-few-meters"):
        members(3, 4, 2, 1)


# Theorems 1 and 2, (42) to (47).


@pytest.mark.parametrize("sensor", range(4))
@pytest.mark.parametrize("inputs", [(), (0,), (1,), (0, 1)])
def test_theorem_1_whoever_lies(inputs: tuple[int, ...], sensor: int) -> None:
    rng = np.random.default_rng(sensor)
    a_u = np.zeros((15, 2))
    a_u[:, list(inputs)] = rng.uniform(-10, 10, (15, len(inputs)))
    a_y = np.outer(rng.uniform(-10, 10, 15), np.arange(4) == sensor)
    answers, x = drive(complete(), a_u, a_y)
    last = answers[-1]
    assert (tuple(np.flatnonzero(last.inputs)), tuple(np.flatnonzero(last.sensors))) == (inputs, (sensor,))
    assert last.decision is Decision.ATTACKED
    for k, answer in enumerate(answers):
        assert np.all(np.abs(answer.x - x[k]) <= answer.bound)
    np.testing.assert_allclose(last.x, x[-1], atol=1e-9)
    np.testing.assert_allclose(last.input_attack, a_u[-2], atol=1e-8)
    np.testing.assert_allclose(last.sensor_attack, a_y[-1], atol=1e-8)


@pytest.mark.canary("0-0", "2-3")
@pytest.mark.parametrize(("actuator", "sensor"), list(itertools.product(range(3), range(4))))
def test_theorem_2_whoever_lies(actuator: int, sensor: int) -> None:
    """Named as soon as the certified bounds are small enough, which takes longer than the estimate does."""
    rng = np.random.default_rng(10 * actuator + sensor)
    a_u = np.outer(rng.uniform(-10, 10, STEPS), np.arange(3) == actuator)
    a_y = np.outer(rng.uniform(-10, 10, STEPS), np.arange(4) == sensor)
    answers, x = drive(partial(), a_u, a_y)
    last = answers[-1]
    assert (list(np.flatnonzero(last.inputs)), list(np.flatnonzero(last.sensors))) == ([actuator], [sensor])
    for k, answer in enumerate(answers):
        assert np.all(np.abs(answer.x - x[k]) <= answer.bound)
    np.testing.assert_allclose(last.x, x[-1], atol=1e-6)
    np.testing.assert_allclose(last.input_attack, a_u[-2], atol=1e-6)
    np.testing.assert_allclose(last.sensor_attack, a_y[-1], atol=1e-6)


@pytest.mark.canary("1")
@pytest.mark.parametrize("example", [1, 2])
def test_the_printed_selection_errs_at_most_three_times_as_much_as_the_honest_members(example: int) -> None:
    """Theorems 1 and 2 with the selection of (5) to (7), (22) to (24): (15) and (32) at every step."""
    made = yang2021.bank(example, corrected=True)
    plant, r = made.family.plant, 2 if example == 1 else 3
    assert made.measure == "distance"
    assert made.guaranteed
    attacked = [(), (0,), (1,), (0, 1)] if example == 1 else [(0,), (1,), (2,)]
    for inputs, sensor in itertools.product(attacked, range(4)):
        rng = np.random.default_rng([example, sensor, *inputs])
        honest = np.array([set(inputs) <= set(u) and sensor not in s for u, s in made.family.pairs])
        x, state, worst = rng.standard_normal(r), init(made, 0.0), 0.0
        for k in range(15):
            u, lie = rng.uniform(-5, 5, r), rng.uniform(-10, 10) * (np.arange(4) == sensor)
            state, answer = step(made, state, plant.system.C @ x + lie, u, ALL4)
            error = np.linalg.norm(state.family.x - x, axis=1)
            assert np.linalg.norm(answer.x - x) <= 3.0 * error[honest].max() + 1e-9
            worst = max(worst, float(error.max())) if k > 2 else worst
            a_u = np.where(np.isin(np.arange(r), inputs), rng.uniform(-10, 10, r), 0.0)
            x = advance(plant.system, x, u) + plant.inputs @ a_u
        assert worst > 1.0, "others are deceived, and would be chosen by a wrong rule"


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), size=st.floats(1e-3, 1e6), start=st.integers(0, 10))
def test_no_attack_of_any_size_or_course_gets_an_honest_one_named(seed: int, size: float, start: int) -> None:
    rng = np.random.default_rng(seed)
    actuator, sensor = rng.integers(3), rng.integers(4)
    on = np.arange(25) >= start
    a_u = np.outer(size * on * rng.standard_normal(25), np.arange(3) == actuator)
    a_y = np.outer(size * on * rng.standard_normal(25), np.arange(4) == sensor)
    answers, x = drive(partial(), a_u, a_y, seed)
    for k, answer in enumerate(answers):
        # Rounding of readings as large as the attack is not in the bounds.
        assert np.all(np.abs(answer.x - x[k]) <= answer.bound + 1e-11 * size)
    named = answers[-1]
    assert not np.any(named.inputs & (np.arange(3) != actuator))
    assert not np.any(named.sensors & (np.arange(4) != sensor))


def test_no_attack_is_clean_and_first_answers_are_not() -> None:
    answers, _ = drive(partial(), np.zeros((80, 3)), np.zeros((80, 4)))
    assert answers[-1].decision is Decision.CLEAN
    assert not answers[-1].inputs.any()
    assert np.all(np.isnan(answers[0].input_attack))
    assert np.all(np.isinf(answers[0].input_threshold))
    assert (answers[0].decision, answers[0].cause) == (Decision.UNDECIDED, Cause.SETTLING)


@pytest.mark.parametrize("heard", [[], [0], [0, 1]])
@pytest.mark.parametrize("radius", [1e-3, 6.0])
def test_a_narrow_start_is_no_evidence(heard: list[int], radius: float) -> None:
    """Who hears nobody, or fewer than can contradict each other, calls nothing clean at any tick."""
    system = DiscreteLure.of(
        [[0.2, 0.5], [0.2, 0.3]], [[1, 1], [1, 2], [3, 2], [4, 1]], G=np.eye(2), H=np.eye(2), B=np.eye(2),
        phi=lambda z: 0.5 * np.sin(z), lower=-0.5, upper=0.5,
    )  # fmt: skip
    made = isolation.design(exact(system, inputs=np.eye(2)), max_inputs=2, max_sensors=1)
    start = init(made, 0.0, radius=np.full(2, radius))
    for seen, last in ((np.isin(np.arange(4), heard), Decision.UNDECIDED), (ALL4, Decision.CLEAN)):
        state = start
        for k in range(3):
            state, answer = step(made, state, np.zeros(4), np.zeros(2), seen)
            assert answer.decision is (last if k else Decision.UNDECIDED)


def test_more_attacks_than_assumed_are_noticed() -> None:
    rng = np.random.default_rng(2)
    answers, _ = drive(complete(), np.zeros((10, 2)), rng.uniform(-10, 10, (10, 4)) * [1, 1, 0, 0])
    assert answers[-1].decision is Decision.UNDECIDED
    assert answers[-1].cause is Cause.TOO_MANY_SUSPECTS


def test_missing_members_withdraw_the_verdict_but_not_the_estimate() -> None:
    run = yang2021.simulate(2, 10.0)
    last = run.answers[-1]
    assert (last.decision, last.cause) == (Decision.UNDECIDED, Cause.DESIGN_INVALID)
    assert "6 members" in last.reason
    np.testing.assert_allclose(run.x_hat[-1], run.x[-1], atol=1e-6)


def test_a_bank_without_any_large_member_is_refused() -> None:
    plant = yang2021_feeder.plant((3, 6), (0, 1, 2), 1e-6)
    with refused(DesignInfeasible, "no-solution"):
        isolation.design(plant, max_inputs=2, max_sensors=1)


def test_support_wants_a_threshold() -> None:
    attack = np.array([np.nan, 1e-12, -2.0, 0.5])
    np.testing.assert_array_equal(support(attack, 0.5), [False, False, True, False])
    np.testing.assert_array_equal(support(attack, np.array([0, 0, 3.0, 0.1])), [False, True, False, True])


# Feeders.


@pytest.mark.acceptance
def test_both_are_named_on_a_line_for_every_inverter_and_meter() -> None:
    made = yang2021_feeder.bank()
    assert made.guaranteed
    assert len(made.family.pairs) == 3 * 8 + 3 * 28
    for inverter, meter in itertools.product(range(3), range(8)):
        run = yang2021_feeder.simulate(made, inverter=inverter, meter=meter, ticks=50)
        onset = int(yang2021_feeder.ONSET_S)
        before, at, after = run.answers[onset - 1], run.answers[onset], run.answers[onset + 1]
        assert before.decision is Decision.CLEAN
        assert list(np.flatnonzero(at.sensors)) == [meter]
        last = run.answers[-1]
        assert (list(np.flatnonzero(after.inputs)), list(np.flatnonzero(last.inputs))) == ([inverter],) * 2
        assert list(np.flatnonzero(last.sensors)) == [meter]
        for k, answer in enumerate(run.answers):
            assert np.all(np.abs(answer.x - run.x[k]) <= answer.bound)
        assert last.input_attack[inverter] == pytest.approx(-0.06, abs=0.003)
        assert last.sensor_attack[meter] == pytest.approx(-0.01, abs=3e-5)


def test_one_silent_meter_is_borne_and_two_are_not() -> None:
    """Without one meter the banks that never trusted it still prove the bound; without two nobody does."""
    made = yang2021_feeder.bank()
    state, x, plant = init(made, 0.0), np.zeros(3), made.family.plant
    u, answers = np.full(13, 0.07), []
    for k in range(60):
        y = plant.system.C @ x + plant.system.D @ u
        y[4] = np.nan if 20 <= k < 50 else y[4]
        y[1] = np.nan if 30 <= k < 40 else y[1]
        state, answer = step(made, state, y, u, np.ones(8, dtype=np.bool_))
        answers.append(answer)
        assert np.all(np.abs(answer.x - x) <= answer.bound)
        assert not answer.inputs.any()
        assert not answer.sensors.any()
        x = advance(plant.system, x, u)
    decided = [answer.decision is Decision.CLEAN for answer in answers]
    assert all(decided[5:30])
    assert not any(decided[30:40])
    assert {answer.cause for answer in answers[30:40]} == {Cause.SETTLING}
    assert all(decided[45:])
    assert np.isnan(answers[25].sensor_attack[4])


@pytest.mark.parametrize("measure", ["bounds", "distance"])
def test_a_lie_that_nobody_can_be_blamed_for_is_undecided(measure: Measure) -> None:
    """One meter is silent: the only large observer left is contradicted by its company, and names nobody."""
    made = replace(complete(), measure=measure)
    rng, plant = np.random.default_rng(0), made.family.plant
    for lie, decision, cause in (
        (50.0, Decision.UNDECIDED, Cause.AMBIGUOUS),
        (0.0, Decision.CLEAN, Cause.AGREEMENT),
    ):
        x, state = rng.standard_normal(2), init(made, 0.0, radius=np.full(2, 6.0))
        for k in range(60):
            u = rng.uniform(-5, 5, 2)
            y = plant.system.C @ x + np.array([lie * (k > 40), 0.0, 0.0, 0.0])
            state, answer = step(made, state, y, u, ALL4 & ((np.arange(4) != 1) | (k < 20)))
            x = advance(plant.system, x, u)
        assert (answer.decision, answer.cause) == (decision, cause)
        assert not answer.sensors.any()
        assert "sensors [1] are silent" in answer.reason
        assert "every input and sensor" not in answer.reason


def test_the_continuous_loop_is_inside_the_sampled_plants_bounds() -> None:
    """Truth: scipy's integrator. What z moves within a step is the curve error, measured on the run."""
    feeder = yang2021_feeder
    lure = feeder.loop(feeder.AT, feeder.METERS)
    u, attack = np.full(13, 0.075), np.array([0.0, -0.06, 0.0])
    limit = 0.044
    # |z(t) - z(0)| <= |H| |x(t) - x(0)|, and x moves by at most 1 - exp(-h / tau) of its span in a step.
    moved = np.abs(lure.H) @ np.full(3, 0.37 * 3 * limit)
    plant = inverters(
        lure,
        1.0,
        np.arange(3),
        reading_error=np.full(8, 1e-7),
        u_error=np.zeros(13),
        curve_error=lure.slope * moved,
        span=np.full(3, 2 * limit),
    )
    made = isolation.design(plant, max_inputs=1, max_sensors=1)
    state, x = init(made, 0.0), np.zeros(3)
    for k in range(30):
        on = k >= 15
        y = lure.C @ x + lure.D @ u
        y[6] += 0.01 * on
        state, answer = step(made, state, y, u, np.ones(8, dtype=np.bool_))
        assert np.all(np.abs(answer.x - x) <= answer.bound)
        if not on:
            assert not answer.inputs.any()
            assert not answer.sensors.any()

        def course(_: float, at: Floats, on: bool = on) -> Floats:
            return np.asarray(lure.A @ at + lure.G @ (lure.phi(lure.H @ at + lure.F @ u) + on * attack))

        x = solve_ivp(course, (0.0, 1.0), x, rtol=1e-10, atol=1e-12).y[:, -1]
    assert list(np.flatnonzero(answer.inputs)) == [1]
    assert list(np.flatnonzero(answer.sensors)) == [6]


def test_both_are_named_under_ac_power_flow() -> None:
    """CIGRE's feeder, three inverters; AC truth, curves in v, exact meters, loads and busbar known."""
    site = load("cigre-lv")
    keep = [2, 3, 5]
    full = site.droop
    droop = Droop(full.customer[keep], full.v[keep], full.q[keep], full.tau[keep], full.vbar)
    lure, model, flow = close_loop(site.feeder, droop, site.meters), site.feeder.linear(), PowerFlow(site)
    base, volt = site.feeder.base_kva, site.feeder.base_volt
    plant = inverters(
        lure,
        1.0,
        np.arange(3),
        reading_error=np.full(6, 2e-6),
        u_error=np.full(6, 3e-6),
        curve_error=curve_mismatch(droop),
        span=2 * droop.limit,
    )
    made = isolation.design(plant, max_inputs=1, max_sensors=1)
    assert made.guaranteed
    state, x = init(made, 0.0), np.zeros(3)
    peak = np.array([row.load_kw for row in site.tables.customers]) / base
    rng = np.random.default_rng(0)
    answers = []
    for k in range(60):
        p = -peak * (0.6 + 0.1 * np.sin(k / 15 + np.arange(6)))
        q = 0.3 * p
        with_inverters = q.copy()
        with_inverters[droop.customer] += x
        v = flow.solve(-p * base, -with_inverters * base, volt)[0] / volt
        y = droop.vbar**2 - v[site.meters] ** 2 + 1e-6 * rng.uniform(-1, 1, 6)
        y[2] -= 0.02 * (k >= 40)
        guess, known = (answers[-1].x if answers else np.zeros(3)), q.copy()
        # The losses depend on what the inverters inject: once with the last estimate, again with the new one.
        for _ in range(3):
            known = q.copy()
            known[droop.customer] += guess
            losses = site.feeder.loss_correction(p, known, 1.0, steps=5)[site.feeder.bus]
            u = known_input(model, droop.vbar, p, q, 1.0, losses)
            after, answer = step(made, state, y, u, np.ones(6, dtype=np.bool_))
            guess = answer.x
        state = after
        answers.append(answer)
        off = droop.vbar**2 - v**2 - (u - 2 * model.X[:, droop.customer] @ x)
        assert np.max(np.abs(off)) < 3e-6
        assert np.all(np.abs(answer.x - x) <= answer.bound)
        a = np.where(np.arange(3) == 1, -1.2 * droop.limit * (k >= 40), 0.0)
        x = plant.system.A @ x + plant.system.G @ (voltage_curve(droop, v[droop.customer]) + a)
    assert answers[39].decision is Decision.CLEAN
    assert list(np.flatnonzero(answers[40].sensors)) == [2]
    assert list(np.flatnonzero(answers[41].inputs)) == [1]
    assert list(np.flatnonzero(answers[-1].inputs)) == [1]
    assert list(np.flatnonzero(answers[-1].sensors)) == [2]
    assert answers[-1].input_attack[1] == pytest.approx(-1.2 * droop.limit[1], rel=0.05)


def test_what_is_missing_on_cigre_as_shipped() -> None:
    """One inverter at the busbar is seen by no meter; two pairs look alike without their own meters."""
    site = load("cigre-lv")
    lure = close_loop(site.feeder, site.droop, site.meters)
    plant = inverters(
        lure,
        1.0,
        np.arange(6),
        reading_error=np.full(6, 1e-6),
        u_error=np.zeros(6),
        curve_error=np.zeros(6),
        span=2 * site.droop.limit,
    )
    small = members(6, 6, 1, 1)[1]
    missing = [pair for pair in small if obstruction(plant, pair, tolerance=1e-9) is not None]
    assert (len(small), len(missing)) == (225, 77)
    assert np.all(lure.C[:, 0] == 0.0)
    assert [pair for pair in missing if 0 not in pair[0]] == [
        ((1, 2), (0, 3, 4, 5)),
        ((4, 5), (0, 1, 2, 3)),
    ]


def test_meters_of_an_accuracy_class_are_not_exact_enough() -> None:
    """Half a percent of the voltage hides any inverter of this line: no verdict."""
    made = isolation.design(
        yang2021_feeder.plant(yang2021_feeder.AT, yang2021_feeder.METERS, 0.01), max_inputs=1, max_sensors=1
    )
    run = yang2021_feeder.simulate(made, inverter=1, meter=5, ticks=60)
    assert Decision.CLEAN not in {answer.decision for answer in run.answers}
    assert set(np.flatnonzero(run.answers[-1].sensors)) <= {5}
    assert not any(answer.inputs.any() for answer in run.answers)
    assert all(np.all(np.abs(a.x - x) <= a.bound) for a, x in zip(run.answers, run.x, strict=True))


@pytest.mark.acceptance
def test_reports_of_the_inverters_are_sensors_too() -> None:
    """With their own reactive power reported, the inverters can be told apart by worse meters."""
    feeder = yang2021_feeder
    lure = feeder.loop(feeder.AT, feeder.METERS)
    span, error = np.full(3, 0.088), np.full(8, 2e-5)
    bounds = []
    for reports in (np.zeros(0, dtype=np.intp), np.arange(3)):
        plant = inverters(
            lure, 1.0, np.arange(3), reading_error=error, u_error=np.zeros(13), curve_error=np.zeros(3),
            span=span, reports=reports, report_error=np.full(reports.size, 1e-4),
        )  # fmt: skip
        made = isolation.design(plant, max_inputs=1, max_sensors=1)
        assert made.guaranteed
        assert len(plant.noise) == 8 + reports.size
        state, x, u = init(made, 0.0), np.zeros(3), np.full(13, 0.07)
        for _ in range(40):
            y = plant.system.C @ x + plant.system.D @ u
            state, answer = step(made, state, y, u, np.ones(len(y), dtype=np.bool_))
            x = advance(plant.system, x, u)
        bounds.append(answer.bound)
    assert np.all(bounds[1] < 0.7 * bounds[0])
    with refused(InputInvalid, "shape"):
        inverters(
            lure, 1.0, np.arange(3), reading_error=error, u_error=np.zeros(13), curve_error=np.zeros(3),
            span=span, reports=np.arange(3), report_error=np.zeros(2),
        )  # fmt: skip

"""Proofs about droop fleets: bounds against another AC power flow, certificates against closed forms."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.grid.radial import Feeder
from gridsec.planning.droop.ac_sensitivity import InjectionBox, currents, network, region, sensitivity, solve
from gridsec.planning.droop.equilibrium import always, at_rest, injected, rest, shares, shares_of_gain
from gridsec.planning.droop.stability import (
    Loop,
    Update,
    factor,
    growth,
    loop,
    proof,
    reach,
    slopes,
    steepened,
    verified,
)
from tests.codes import refused
from tests.gridsec.radial import random_feeder, random_loop, sweep

FEW = settings(max_examples=25)


def random_box(feeder: Feeder, rng: np.random.Generator, size: float) -> InjectionBox:
    count = len(feeder.customers)
    p, q = rng.uniform(-0.08, 0.08, (2, count))
    dp, dq = size * rng.uniform(0.0, 0.05, (2, count))
    return InjectionBox(p - dp, p + dp, q - dq, q + dq, 0.99, 1.03)


def corners(box: InjectionBox, rng: np.random.Generator) -> tuple[Floats, Floats, float]:
    """A point of the box, often on its edges."""
    u = np.clip(rng.uniform(-0.5, 1.5, (2, box.p_low.size)), 0.0, 1.0)
    p = box.p_low + u[0] * (box.p_high - box.p_low)
    q = box.q_low + u[1] * (box.q_high - box.q_low)
    return p, q, float(rng.choice([box.v0_low, box.v0_high]))


@FEW
@given(seed=st.integers(0, 200), charging=st.sampled_from([0.0, 0.01]))
def test_power_flow_against_sweeps(seed: int, charging: float) -> None:
    feeder = random_feeder(seed, charging=charging)
    rng = np.random.default_rng(seed)
    net = network(feeder)
    p, q = rng.uniform(-0.08, 0.08, (2, len(feeder.customers)))
    V = solve(net, p + 1j * q, 1.02)
    v2 = sweep(feeder, p, q, 1.02**2)
    np.testing.assert_allclose(np.abs(V) ** 2, v2[feeder.bus], atol=1e-11)
    # Currents: what they dissipate is what goes in and does not come out.
    amps = currents(feeder, net, p + 1j * q, V, 1.02)[:, 0]
    if not charging:
        at = 1.02 * net.E_bus + net.Z_bus @ np.conj((p + 1j * q) / V)
        out = at[feeder.parent[feeder.parent == 0]] * 0.0
        feeds = feeder.parent == 0
        into = np.sum(
            at[0] * np.conj((at[0] - at[1:][feeds]) / (feeder.r[feeds] + 1j * feeder.x[feeds]))
        ).real
        own = np.sum(p[feeder.bus == 0])
        assert out.size == feeds.sum()
        assert np.sum(feeder.r * amps**2) == pytest.approx(into + np.sum(p) - own, abs=1e-11)


def test_no_solution_is_nan_and_an_error_of_what_needs_one() -> None:
    feeder = random_feeder(3)
    net = network(feeder)
    s = np.full(len(feeder.customers), -50.0 + 0j)
    V = solve(net, np.stack([s, 0.0 * s]), 1.0)
    far = feeder.bus > 0
    assert np.isnan(V[0, far]).any()
    assert np.isfinite(V[1]).all()
    with refused(DesignInfeasible, "no-solution"):
        sensitivity(net, s, V[0])


@FEW
@given(seed=st.integers(0, 300))
def test_sensitivities_against_differences_of_the_sweeps(seed: int) -> None:
    feeder = random_feeder(seed)
    rng = np.random.default_rng(seed)
    count = len(feeder.customers)
    p, q = rng.uniform(-0.08, 0.08, (2, count))
    net = network(feeder)
    found = sensitivity(net, p + 1j * q, solve(net, p + 1j * q, 1.0))
    j, h = int(rng.integers(count)), 1e-5

    def v(dp: float, dq: float, v0: float) -> Floats:
        at = np.arange(count) == j
        return np.sqrt(sweep(feeder, p + dp * at, q + dq * at, v0**2)[feeder.bus])

    dq = (v(0.0, h, 1.0) - v(0.0, -h, 1.0)) / (2 * h)
    np.testing.assert_allclose(found.dv_dq[:, j], dq, atol=1e-7)
    dp = (v(h, 0.0, 1.0) - v(-h, 0.0, 1.0)) / (2 * h)
    np.testing.assert_allclose(found.v * found.p[:, j].real, dp, atol=1e-7)
    d0 = (v(0.0, 0.0, 1.0 + h) - v(0.0, 0.0, 1.0 - h)) / (2 * h)
    np.testing.assert_allclose(found.v * found.busbar[:, 0].real, d0, atol=1e-7)


@FEW
@given(seed=st.integers(0, 300), size=st.sampled_from([0.1, 1.0]))
def test_nothing_in_a_box_is_outside_of_its_bounds(seed: int, size: float) -> None:
    feeder = random_feeder(seed)
    rng = np.random.default_rng([seed, 1])
    net, box = network(feeder), random_box(feeder, rng, size)
    found = region(net, box)
    before: tuple[Floats, Floats, Floats] | None = None
    for _ in range(6):
        p, q, v0 = corners(box, rng)
        v = np.sqrt(sweep(feeder, p, q, v0**2)[feeder.bus])
        assert np.all(v >= found.low)
        assert np.all(v <= found.high)
        here = sensitivity(net, p + 1j * q, solve(net, p + 1j * q, v0))
        assert np.all(np.abs(here.dv_dq - found.dv_dq) <= found.q_error + 1e-12)
        assert np.all(np.abs(here.v[:, None] * here.p.real - found.dv_dp) <= found.p_error + 1e-12)
        if before is not None:  # chords
            off = v - before[2] - found.dv_dp @ (p - before[0]) - found.dv_dq @ (q - before[1])
            most = found.p_error @ np.abs(p - before[0]) + found.q_error @ np.abs(q - before[1])
            swing = 1.3 * (box.v0_high - box.v0_low)  # dv/dv0 times a change of the busbar
            assert np.all(np.abs(off) <= most + swing)
        before = p, q, v


def test_a_box_that_holds_collapse_is_refused() -> None:
    feeder = random_feeder(3)
    count = len(feeder.customers)
    none = np.zeros(count)
    with refused(DesignInfeasible, "no-solution"):
        region(network(feeder), InjectionBox(np.full(count, -20.0), none, none, none, 1.0, 1.0))


# --- certificates -----------------------------------------------------------------------------------------


def random_given(seed: int, update: Update, *, spread: float = 1.0, lopsided: bool = False) -> Loop:
    """A loop of reactances in common; or of three phases, with any signs and no symmetry."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(1, 7))
    root = rng.normal(size=(m, m))
    S = root @ root.T
    if lopsided:
        turn = rng.normal(size=(m, m))
        S = S + np.linalg.norm(S, 2) * (turn - turn.T)
    S *= rng.uniform(0.1, 3.0) / np.linalg.norm(S, 2)
    tau = 2.0 * spread ** rng.uniform(-0.5, 0.5, m)
    return Loop(S, np.zeros((m, m)), tau, update, np.arange(m))


@FEW
@given(seed=st.integers(0, 200), interval=st.sampled_from([0.2, 1.0, 4.0, 100.0]))
def test_one_time_constant_and_no_dead_time_the_criterion_is_exact(seed: int, interval: float) -> None:
    """`alpha (1 + g) < 2` is where the linear loop with all slopes at their bounds becomes unstable."""
    made = random_given(seed, Update(interval))
    alpha = -np.expm1(-interval / made.tau[0])
    exact = (2.0 / alpha - 1.0) / np.linalg.norm(made.S, 2)
    assert factor(made) == pytest.approx(exact, rel=1e-9)
    assert verified(made, 0.99 * exact)
    assert not verified(made, 1.001 * exact)
    assert growth(0.999 * exact * made.S, np.ones(made.tau.size), made.tau, made.update) < 1.0
    assert growth(1.001 * exact * made.S, np.ones(made.tau.size), made.tau, made.update) > 1.0


@FEW
@given(
    seed=st.integers(0, 200),
    dead=st.integers(0, 3),
    spread=st.sampled_from([1.0, 4.0]),
    lopsided=st.booleans(),
)
def test_what_is_verified_contracts_for_any_slopes_that_change_at_any_time(
    seed: int, dead: int, spread: float, lopsided: bool
) -> None:
    made = random_given(seed, Update(1.0, dead), spread=spread, lopsided=lopsided)
    rng = np.random.default_rng(seed)
    m = made.tau.size
    made = replace(made, error=0.05 * rng.uniform(size=(m, m)))
    times = 0.98 * factor(made)
    assert times * np.linalg.norm(made.error, 2) < 2.0
    assert verified(made, times)
    alpha = made.update.share(made.tau)
    e, way = np.ones(m), [np.zeros(m)] * dead
    for k in range(600):
        slope = times * np.clip(rng.uniform(-1.0, 2.0, m), 0.0, 1.0)
        if k % 2:  # the slopes that a resonance at half the sampling rate would like
            slope = times * np.ones(m)
        S = made.S + made.error * rng.choice([-1.0, 1.0], (m, m))
        way = [*way, -slope * (S @ e)]
        e = (1.0 - alpha) * e + alpha * way.pop(0)
    assert np.abs(e).max() < 1e-2


@FEW
@given(seed=st.integers(0, 100), dead=st.integers(0, 2), spread=st.sampled_from([1.0, 4.0]))
def test_certificates_of_inverters_that_jump_cover_shorter_intervals(
    seed: int, dead: int, spread: float
) -> None:
    made = random_given(seed, Update(1e3, dead), spread=spread, lopsided=True)
    made = replace(made, S=0.95 * min(factor(made), 1e3) * made.S)
    if not (verified(made) and made.covers_shorter):
        return
    for interval in (10.0, 2.0, 0.5, 0.05):
        assert verified(replace(made, update=Update(interval, dead)))


def test_shorter_intervals_are_covered_by_like_time_constants_or_a_small_loop() -> None:
    S = np.array([[0.0, 1.8], [0.0, 0.0]])
    apart = Loop(S, 0.0 * S, np.array([1.0, 30.0]), Update(), np.arange(2))
    assert not replace(apart, S=0.75 * (S - S.T)).covers_shorter
    assert replace(apart, tau=np.ones(2)).covers_shorter
    assert replace(apart, S=0.5 * S).covers_shorter


@FEW
@given(seed=st.integers(0, 100))
def test_continuous_filters_of_one_time_constant_are_always_proven(seed: int) -> None:
    made = random_given(seed, Update(0.0))
    assert verified(made)
    assert verified(made, 30.0)


def test_small_gain_needs_no_interval_and_no_dead_time() -> None:
    made = random_given(5, Update(7.0, 4))
    made = replace(made, S=0.9 * made.S / max(abs(np.linalg.eigvals(np.abs(made.S)))))
    assert proof(made).kind == "small-gain"
    assert proof(made).gain == pytest.approx(0.9)
    nothing = Loop(np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0), Update(), np.zeros(0, dtype=np.intp))
    assert proof(nothing).kind == "deadband"
    assert factor(nothing) == np.inf
    assert growth(nothing.S, nothing.tau, nothing.tau, Update()) == 0.0


@FEW
@given(seed=st.integers(0, 100))
def test_every_trajectory_ends_within_reach(seed: int) -> None:
    feeder, droop, _ = random_loop(seed, gain=0.4)
    net, rng = network(feeder), np.random.default_rng(seed)
    loads = random_box(feeder, rng, 0.2)
    within = reach(net, droop, loads)
    assert np.all(within.x_low >= droop.q[:, 3] - 1e-15)
    x = rng.uniform(droop.q[:, 3], droop.q[:, 0])
    p, q, v0 = corners(loads, rng)
    for k in range(60):
        if k % 7 == 0:
            p, q, v0 = corners(loads, rng)
        net_q = q.copy()
        np.add.at(net_q, droop.customer, x)
        v = np.abs(solve(net, p + 1j * net_q, v0))
        x += 0.6 * (voltage_curve(droop, v[droop.customer]) - x)
    room = 1e-5 * (droop.q[:, 0] - droop.q[:, 3])
    assert np.all(x >= within.x_low - room)
    assert np.all(x <= within.x_high + room)


@FEW
@given(seed=st.integers(0, 100), times=st.floats(0.7, 20.0))
def test_steeper_curves_have_the_same_limits_and_deadband(seed: int, times: float) -> None:
    rng = np.random.default_rng(seed)
    gap = 0.02 * float(rng.integers(0, 2))
    v = np.array([[0.9, 1.0 - gap, 1.0 + gap, 1.1], [0.9, 0.99, 1.01, 1.1]])
    q = np.array([[0.3, 0.0, 0.0, -0.3], [0.3, 0.1, -0.1, -0.3]])
    droop = Droop(np.arange(2), v, q, np.ones(2))
    steep = steepened(droop, times)
    everywhere = np.full(2, 0.5), np.full(2, 1.5)
    np.testing.assert_allclose(slopes(steep, *everywhere), times * slopes(droop, *everywhere))
    np.testing.assert_array_equal(steep.q, q)
    np.testing.assert_allclose(steep.v[0, 1:3], v[0, 1:3])
    grid = np.linspace(0.85, 1.15, 500)[:, None] * np.ones(2)
    numeric = np.max(-np.diff(voltage_curve(steep, grid), axis=0) / (grid[1, 0] - grid[0, 0]), axis=0)
    assert np.all(numeric <= slopes(steep, *everywhere) * (1 + 1e-9))
    assert slopes(droop, np.full(2, 0.995), np.full(2, 1.005))[0] == (0.0 if gap else pytest.approx(3.0))


def test_updates_that_cannot_be() -> None:
    for interval, dead, code in ((-1.0, 0, "negative"), (1.0, -1, "negative"), (0.0, 1, "inconsistent")):
        with refused(InputInvalid, code):
            Update(interval, dead)


def test_loop_leaves_out_inverters_that_do_not_react() -> None:
    feeder, droop, _ = random_loop(11, gain=0.3)
    count = len(feeder.customers)
    still = np.zeros(count)
    quiet = reach(network(feeder), droop, InjectionBox(still, still, still, still, 1.0, 1.0))
    made = loop(droop, quiet, Update())
    assert made.tau.size == 0
    assert proof(made).kind == "deadband"


# --- rest, and the band of voltages -----------------------------------------------------------------------


@FEW
@given(seed=st.integers(0, 200), gain=st.sampled_from([0.3, 3.0, 30.0]))
def test_at_rest_every_inverter_gives_what_its_curve_asks_for(seed: int, gain: float) -> None:
    feeder, droop, _ = random_loop(seed, gain=gain)
    rng = np.random.default_rng(seed)
    p, q = rng.uniform(-0.05, 0.05, (2, 3, len(feeder.customers)))
    x, V = rest(network(feeder), droop, p + 1j * q, np.array([0.99, 1.0, 1.04]))
    assert np.isfinite(V).all()
    for row, v0 in enumerate((0.99, 1.0, 1.04)):
        s = injected(droop, p[row] + 1j * q[row], x[row])
        v = np.sqrt(sweep(feeder, s.real, s.imag, v0**2)[feeder.bus])
        np.testing.assert_allclose(np.abs(V[row]), v, atol=1e-10)
        np.testing.assert_allclose(voltage_curve(droop, v[droop.customer]), x[row], atol=1e-9)


def test_where_there_is_no_power_flow_there_is_no_rest() -> None:
    feeder, droop, _ = random_loop(3, gain=0.5)
    x, V = rest(network(feeder), droop, np.full(len(feeder.customers), -50.0 + 0j), 1.0)
    assert np.isnan(x).all()
    assert np.isnan(V).all()


def test_no_voltage_leaves_its_proven_band() -> None:
    told: Counter[str] = Counter()

    @FEW
    @given(seed=st.integers(0, 300))
    def holds(seed: int) -> None:
        feeder, droop, _ = random_loop(seed, gain=0.6)
        net, rng = network(feeder), np.random.default_rng(seed)
        loads = random_box(feeder, rng, 1.0)
        told["drawn"] += 1
        try:
            ever = always(net, droop, loads)
        except DesignInfeasible:
            return
        told["ever"] += 1
        drawn = [corners(loads, rng) for _ in range(8)]
        s, v0 = np.array([p + 1j * q for p, q, _ in drawn]), np.array([v for *_, v in drawn])
        x, V = rest(net, droop, s, v0)
        assert np.all(np.abs(V) >= ever.low)
        assert np.all(np.abs(V) <= ever.high)
        jumped = np.abs(solve(net, injected(droop, s, np.roll(x, 1, axis=0)), v0))
        assert np.all(jumped >= ever.low)
        assert np.all(jumped <= ever.high)
        try:
            still = at_rest(net, droop, loads)
        except DesignInfeasible:
            return
        told["at rest"] += 1
        assert np.all(np.abs(V) >= still.low)
        assert np.all(np.abs(V) <= still.high)
        assert np.all(still.low >= ever.low)

    holds()
    # Few boxes reach too near to collapse, few fleets are too steep: of the seeds 1 % and 8 %.
    assert told["ever"] >= 0.9 * told["drawn"]
    assert told["at rest"] >= 0.7 * told["drawn"]


def test_the_band_at_rest_is_reached_where_all_sensitivities_are_positive() -> None:
    """A line of one cable: the corners of the box are the extreme loads."""
    feeder, droop, _ = random_loop(4, gain=0.2)
    count = len(feeder.customers)
    full, none = np.full(count, 0.01), np.zeros(count)
    line = replace(feeder, parent=np.arange(feeder.parent.size), x=0.5 * feeder.r)
    loads = InjectionBox(-full, full, none, none, 1.0, 1.0)
    net = network(line)
    band = at_rest(net, droop, loads)
    V = np.abs(rest(net, droop, np.stack([-full, full]) + 0j, 1.0)[1])
    np.testing.assert_allclose(band.low, V[0], atol=2e-4)
    np.testing.assert_allclose(band.high, V[1], atol=2e-4)


@FEW
@given(seed=st.integers(0, 100))
def test_shares_of_a_gain_without_symmetry_against_eigenvalues(seed: int) -> None:
    made = random_given(seed, Update(), lopsided=True)
    m = made.tau.size
    made = replace(made, error=0.05 * np.random.default_rng(seed).uniform(size=(m, m)))
    M = np.abs(made.S) + made.error
    size = 0.7 / float(np.max(np.abs(np.linalg.eigvals(M))))
    made, M = replace(made, S=size * made.S, error=size * made.error), size * M
    found = shares_of_gain(made)
    assert found.part.sum() == pytest.approx(1.0)
    for k in range(m):
        times = np.where(np.arange(m) == k, min(found.factor[k], 1e9), 1.0)
        assert np.max(np.abs(np.linalg.eigvals(M * times))) == pytest.approx(1.0, rel=1e-6)
        grown = np.max(np.abs(np.linalg.eigvals(M * np.where(np.arange(m) == k, 1.0 + 1e-6, 1.0))))
        assert (grown / 0.7 - 1.0) / 1e-6 == pytest.approx(found.part[k], abs=1e-4)
    beyond = shares_of_gain(replace(made, S=2.0 * made.S, error=2.0 * made.error))
    assert np.isnan(beyond.factor).all()


@FEW
@given(seed=st.integers(0, 100))
def test_shares_of_the_gain_against_eigenvalues(seed: int) -> None:
    made = random_given(seed, Update())
    gain = float(np.linalg.norm(made.S, 2))
    found = shares(made, 1.5 * gain)
    assert found.part.sum() == pytest.approx(1.0)
    for i in np.flatnonzero(found.factor < 1e6):
        root = np.ones(made.tau.size)
        root[i] = np.sqrt(found.factor[i])
        assert np.linalg.norm(root[:, None] * made.S * root, 2) == pytest.approx(1.5 * gain, rel=1e-6)
    for i in np.flatnonzero(np.isinf(found.factor)):
        root = np.ones(made.tau.size)
        root[i] = 1e3
        assert (
            made.S[i, i] == pytest.approx(0.0)
            or np.linalg.norm(root[:, None] * made.S * root, 2) < 1.5 * gain
        )
    assert np.all(shares(made, 0.5 * gain).factor == 1.0)

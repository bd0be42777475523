"""The exact bank against one plain observer per subset, and chong2020's guarantees."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gridsec import bank as banks
from gridsec import lure as lures
from gridsec.droop import Droop, fleet
from gridsec.errors import DesignInfeasible, NotObservable
from gridsec.feeder import Feeder, lindistflow
from gridsec.lure import Lure, StepPolicy, close_loop, equilibrium

PRESETS = ("ieee1547-a", "ieee1547-b", "vde4105")


def tree(customers: int, rng: np.random.Generator, *, impedance: float = 0.01) -> Feeder:
    """A random radial feeder with one customer at every bus but the busbar."""
    parent = np.array([rng.integers(max(0, k - 3), k + 1) for k in range(customers)])
    return Feeder(
        name="random",
        parent=parent,
        r=rng.uniform(0.5, 2.0, customers) * impedance,
        x=rng.uniform(0.5, 2.0, customers) * impedance,
        bus=np.arange(1, customers + 1),
        customers=tuple(f"c{i}" for i in range(customers)),
        buses=tuple(f"b{i}" for i in range(customers + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(customers),
    )


def mixed_fleet(customer: np.ndarray, rng: np.random.Generator) -> Droop:
    names = [PRESETS[i % 3] for i in range(customer.size)]
    return fleet(customer, names, rng.uniform(3.0, 10.0, customer.size), 100.0)


def plant(
    rng: np.random.Generator, *, customers: int = 6, inverters: object = None, meters: object = None
) -> Lure:
    every = np.arange(customers)
    own = every if inverters is None else np.asarray(inverters)
    where = every if meters is None else np.asarray(meters)
    return close_loop(tree(customers, rng), mixed_fleet(own, rng), where)


def one_observer(lure: Lure, trusted: np.ndarray) -> Lure:
    """The observer of one subset, written as a plant of its own with the input (u, y)."""
    n, p = lure.A.shape[0], lure.C.shape[0]
    H, F, from_meter = lure.H.copy(), lure.F.copy(), np.zeros((n, p))
    for i in range(n):
        for j in range(p):
            same = np.array_equal(lure.H[i], lure.C[j]) and np.array_equal(lure.F[i], lure.D[j])
            if same and trusted[j]:
                H[i], F[i] = 0.0, 0.0
                from_meter[i, j] = 1.0
                break
    wide = np.hstack([F, from_meter])
    return Lure(
        A=lure.A,
        G=lure.G,
        H=H,
        F=wide,
        B=np.hstack([lure.B, np.zeros((n, p))]),
        C=lure.C,
        D=np.hstack([lure.D, np.zeros((p, p))]),
        slope=lure.slope,
        phi=lure.phi,
    )


def loop_step(
    bank: banks.Bank, x: np.ndarray, y: np.ndarray, u: np.ndarray, *, seen: np.ndarray, h: float
) -> np.ndarray:
    """What `bank.step` computes, one observer after the other."""
    if not x.shape[1]:
        return x
    prepared = lures.transition(bank.lure, h, bank.policy)
    known = np.concatenate([u, np.where(seen, y, 0.0)])
    return np.stack(
        [
            lures.step(prepared, one_observer(bank.lure, mask & seen), state, known)
            for mask, state in zip(bank.masks, x, strict=True)
        ]
    )


def loop_consistency(bank: banks.Bank, x: np.ndarray) -> np.ndarray:
    """Equation (6) read aloud."""
    p, M = bank.masks.shape[1], bank.sets.max_attacked
    number = {tuple(np.flatnonzero(mask)): i for i, mask in enumerate(bank.masks)}
    if M == 0:
        return np.zeros(1)
    return np.array(
        [
            max(np.abs(x[number[S]] - x[number[P]]).max(initial=0.0) for P in combinations(S, p - 2 * M))
            for S in combinations(range(p), p - M)
        ]
    )


def large_order(bank: banks.Bank) -> list[tuple[int, ...]]:
    return [tuple(np.flatnonzero(mask)) for mask in bank.masks[: bank.sets.count_large]]


def states(bank: banks.Bank, state: banks.BankState) -> np.ndarray:
    return np.stack([banks.estimate(bank, state, i) for i in range(bank.masks.shape[0])])


def readings(lure: Lure, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    u = rng.uniform(-0.05, 0.15, lure.F.shape[1])
    x = rng.uniform(-1.0, 1.0, lure.A.shape[0]) * 0.03
    return lure.C @ x + lure.D @ u + rng.normal(0.0, 0.01, lure.C.shape[0]), u


CASES = {
    "all customers have inverter and meter": {},
    "some customers have no inverter": {"inverters": [0, 2, 5]},
    "some inverters have no meter": {"meters": [0, 1, 3, 4, 5]},
    "two inverters at one customer": {"inverters": [0, 1, 1, 4]},
    "no inverters": {"inverters": []},
}


class TestSubsets:
    @pytest.mark.parametrize(("p", "M"), [(1, 0), (3, 1), (5, 2), (7, 2), (9, 4)])
    def test_sets_and_comparisons(self, p: int, M: int) -> None:
        sets = banks.subsets(p, M, most=10**6)
        masks = sets.masks()
        large, small = masks[: sets.count_large], masks[sets.count_large :]
        assert {tuple(np.flatnonzero(m)) for m in large} == set(combinations(range(p), p - M))
        assert {tuple(np.flatnonzero(m)) for m in small} == set(combinations(range(p), p - 2 * M))
        for s, where in enumerate(sets.pairs):
            choice, member = np.divmod(where, sets.count_small)
            assert (sets.parent[choice, member] == s).all()
            inside = {tuple(np.flatnonzero(small[i])) for i in member}
            assert inside == set(combinations(np.flatnonzero(large[s]), p - 2 * M))
            assert len(inside) == where.size == comb(p - M, M)

    @pytest.mark.parametrize(("p", "M"), [(2, 1), (4, 2), (0, 0)])
    def test_too_few_meters(self, p: int, M: int) -> None:
        with pytest.raises(NotObservable, match="Theorem 1") as caught:
            banks.subsets(p, M, most=10**6)
        assert caught.value.rank == p

    def test_too_many_observers(self) -> None:
        with pytest.raises(DesignInfeasible, match=f"{comb(146, 2) + comb(146, 4)} observers"):
            banks.subsets(146, 2, most=200_000)

    def test_negative(self) -> None:
        with pytest.raises(ValueError, match="negative"):
            banks.subsets(3, -1, most=10)


class TestAgainstLoop:
    @pytest.mark.parametrize("name", CASES)
    @pytest.mark.parametrize("h", [0.2, 1.0, 7.0, 900.0])
    def test_step_and_consistency(self, name: str, h: float) -> None:
        rng = np.random.default_rng(3)
        lure = plant(rng, **CASES[name])
        M = (lure.C.shape[0] - 1) // 2
        bank = banks.design(lure, M)
        general = banks.design(lure, M, gains=banks.direct_gains(lure, bank.masks))
        seen = np.ones(lure.C.shape[0], dtype=bool)
        y, u = readings(lure, rng)
        fast, wide = banks.init(bank, y, u, seen), banks.init(general, y, u, seen)
        slow = loop_step(bank, np.zeros((bank.masks.shape[0], lure.A.shape[0])), y, u, seen=seen, h=1e6)
        for _ in range(4):
            for state, owner in ((fast, bank), (wide, general)):
                np.testing.assert_allclose(states(owner, state), slow, rtol=0.0, atol=1e-9)
                pi = banks.consistency(owner, state)
                np.testing.assert_allclose(pi, _ordered(bank, slow), rtol=0.0, atol=1e-9)
                for s in range(pi.size):
                    worst = banks.spread(owner, state, s).max(initial=0.0)
                    assert worst == pytest.approx(pi[s], abs=1e-15)
            y, u = readings(lure, rng)
            fast = banks.step(bank, fast, y, u, seen, h)
            wide = banks.step(general, wide, y, u, seen, h)
            slow = loop_step(bank, slow, y, u, seen=seen, h=h)

    def test_equal_numbers_when_no_equation_is_solved(self) -> None:
        rng = np.random.default_rng(4)
        lure = plant(rng, customers=7)
        bank = banks.design(lure, 2)
        seen = np.ones(7, dtype=bool)
        y, u = readings(lure, rng)
        fast = banks.init(bank, y, u, seen)
        slow = states(bank, fast)
        for _ in range(20):
            y, u = readings(lure, rng)
            fast = banks.step(bank, fast, y, u, seen, 1.0)
            slow = loop_step(bank, slow, y, u, seen=seen, h=1.0)
        np.testing.assert_allclose(states(bank, fast), slow, rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(banks.consistency(bank, fast), _ordered(bank, slow), rtol=0, atol=1e-15)

    def test_dense_product_gives_the_same(self, monkeypatch: pytest.MonkeyPatch) -> None:
        rng = np.random.default_rng(5)
        lure = plant(rng, customers=8, meters=[0, 1, 3, 4, 5, 7])
        kept = banks.design(lure, 2)
        monkeypatch.setattr("gridsec.slots._BLOCK_BYTES", 0)
        monkeypatch.setattr("gridsec.slot_steps._NEWTON_ENTRIES", 64)
        dense = banks.design(lure, 2)
        assert dense.base is not None
        assert dense.base.small.H is None
        seen = np.ones(6, dtype=bool)
        y, u = readings(lure, rng)
        a, b = banks.init(kept, y, u, seen), banks.init(dense, y, u, seen)
        for h in (1.0, 3.0, 900.0, 1.0):
            y, u = readings(lure, rng)
            a, b = banks.step(kept, a, y, u, seen, h), banks.step(dense, b, y, u, seen, h)
            np.testing.assert_allclose(states(kept, a), states(dense, b), rtol=0.0, atol=1e-12)

    @pytest.mark.parametrize("impedance", [0.01, 0.1])
    def test_equilibria_without_newton(self, impedance: float) -> None:
        """An online step may not fail: where Newton gives up, relaxation gets there, above gain 1 too."""
        rng = np.random.default_rng(16)
        lure = close_loop(tree(6, rng, impedance=impedance), mixed_fleet(np.arange(6), rng), np.arange(6))
        seen = np.ones(6, dtype=bool)
        y, u = readings(lure, rng)
        slow = banks.design(lure, 2, policy=StepPolicy(substep=1.0, settled=1e-6, tol=1e-10, max_iter=0))
        fast = banks.design(lure, 2)
        a, b = banks.init(slow, y, u, seen), banks.init(fast, y, u, seen)
        np.testing.assert_allclose(states(slow, a), states(fast, b), rtol=0.0, atol=1e-6)
        a, b = banks.step(slow, a, y, u, seen, 1.0), banks.step(fast, b, y, u, seen, 1.0)
        np.testing.assert_allclose(states(slow, a), states(fast, b), rtol=0.0, atol=1e-6)

    @pytest.mark.parametrize("base_kva", [1e2, 1e7, 1e12])
    @pytest.mark.parametrize("general", [False, True])
    def test_equilibria_do_not_depend_on_the_base_power(self, base_kva: float, general: bool) -> None:
        rng = np.random.default_rng(17)
        feeder, droop = tree(6, rng, impedance=0.05), mixed_fleet(np.arange(6), rng)
        scale = 100.0 / base_kva
        y, u = readings(close_loop(feeder, droop, np.arange(6)), rng)
        found = []
        for factor in (1.0, scale):
            branch = {"r": feeder.r / factor, "x": feeder.x / factor}
            own = Droop(droop.customer, droop.v, droop.q * factor, droop.tau, droop.vbar)
            lure = close_loop(replace(feeder, **branch), own, np.arange(6))
            gains = banks.direct_gains(lure, banks.subsets(6, 2, most=100).masks()) if general else "direct"
            bank = banks.design(lure, 2, gains=gains)
            state = banks.init(bank, y, u, np.ones(6, dtype=bool))
            state = banks.step(bank, state, y + 0.02, u, np.ones(6, dtype=bool), 900.0)
            found.append(np.array([banks.estimate(bank, state, i) for i in range(len(bank.masks))]) / factor)
        np.testing.assert_allclose(found[1], found[0], rtol=0.0, atol=1e-8 * np.max(droop.limit))

    def test_differential_equation(self) -> None:
        """With fine substeps every observer follows its differential equation."""
        rng = np.random.default_rng(6)
        lure = plant(rng, customers=5)
        bank = banks.design(lure, 1, policy=StepPolicy(substep=0.02, settled=1e-9, tol=1e-12, max_iter=50))
        seen = np.ones(5, dtype=bool)
        y, u = readings(lure, rng)
        state = banks.init(bank, y, u, seen)
        before = states(bank, state)
        y, u = readings(lure, rng)
        after = states(bank, banks.step(bank, state, y, u, seen, 2.0))
        for mask, x0, x1 in zip(bank.masks, before, after, strict=True):

            def rate(_t: float, x: np.ndarray, mask: np.ndarray = mask) -> np.ndarray:
                zeta = np.where(mask, y, lure.H @ x + lure.F @ u)
                return (lure.phi(zeta) - x) / bank.layout.droop.tau  # type: ignore[union-attr]

            exact = solve_ivp(rate, (0.0, 2.0), x0, rtol=1e-10, atol=1e-13, max_step=0.02).y[:, -1]
            np.testing.assert_allclose(x1, exact, rtol=0.0, atol=2e-7)


def _ordered(bank: banks.Bank, x: np.ndarray) -> np.ndarray:
    """`loop_consistency` in the bank's own order of sets."""
    p, M = bank.masks.shape[1], bank.sets.max_attacked
    by_set = dict(zip(combinations(range(p), p - M), loop_consistency(bank, x), strict=True))
    return np.array([by_set[S] for S in large_order(bank)])


class TestSilence:
    def test_silent_meters_are_trusted_by_nobody(self) -> None:
        """Any pattern of silence, in any order: as if each observer had dropped the meter by itself."""
        rng = np.random.default_rng(7)
        lure = plant(rng, customers=8, meters=[0, 1, 2, 4, 5, 6, 7])
        bank = banks.design(lure, 2)
        everyone = np.ones(7, dtype=bool)
        y, u = readings(lure, rng)
        fast = banks.init(bank, y, u, everyone)
        slow = states(bank, fast)
        for silent in ([], [3], [3, 5], [5], [], [0], [0, 6]):
            seen = everyone.copy()
            seen[silent] = False
            returned = seen & ~fast.seen
            if returned.any():
                # Observers agree on a returning meter's inverter; the loop has to be told the value.
                driven = banks.estimate(bank, fast, -1)
                own = bank.layout.driver  # type: ignore[union-attr]
                back = bank.layout.metered & returned[own]  # type: ignore[union-attr]
                trusts = bank.masks[:, own] & back
                slow = np.where(trusts, driven, slow)
            for _ in range(3):
                y, u = readings(lure, rng)
                y[silent] = np.nan
                fast = banks.step(bank, fast, y, u, seen, 1.0)
                slow = loop_step(bank, slow, y, u, seen=seen, h=1.0)
                got = states(bank, fast)
                assert np.isfinite(got).all()
                np.testing.assert_allclose(got, slow, rtol=0.0, atol=1e-14)
                pi = banks.consistency(bank, fast)
                np.testing.assert_allclose(pi, _ordered(bank, slow), rtol=0.0, atol=1e-14)

    def test_adopted_value(self) -> None:
        rng = np.random.default_rng(8)
        lure = plant(rng, customers=5)
        bank = banks.design(lure, 1)
        seen = np.ones(5, dtype=bool)
        y, u = readings(lure, rng)
        state = banks.init(bank, y, u, seen & (np.arange(5) != 2))
        wish = np.full(5, 0.0123)
        state = banks.step(bank, state, y, u, seen, 0.0, adopt=wish)
        for mask, x in zip(bank.masks, states(bank, state), strict=True):
            if mask[2]:
                assert x[2] == 0.0123

    def test_too_few_live_meters(self) -> None:
        rng = np.random.default_rng(9)
        lure = plant(rng, customers=6)
        bank = banks.design(lure, 2)
        seen = np.ones(6, dtype=bool)
        y, u = readings(lure, rng)
        state = banks.init(bank, y, u, seen)
        assert banks.decided(bank, state)
        few = np.array([True, True, True, True, False, False])
        y = np.where(few, y, np.nan)
        for _ in range(60):
            state = banks.step(bank, state, y, u, few, 1.0)
        assert not banks.decided(bank, state)
        assert banks.consistency(bank, state).size == 0
        # On the model alone, whatever the few meters say.
        rest = equilibrium(lure, u, tol=1e-12, max_iter=100)
        np.testing.assert_allclose(banks.estimate(bank, state, -1), rest, atol=1e-6)
        y, u = readings(lure, rng)
        state = banks.step(bank, state, y, u, seen, 1.0)
        assert banks.consistency(bank, state).shape == (15,)
        assert np.isfinite(states(bank, state)).all()

    def test_starting_with_no_meter_at_all(self) -> None:
        rng = np.random.default_rng(10)
        lure = plant(rng, customers=4)
        bank = banks.design(lure, 1)
        u = rng.uniform(-0.05, 0.1, 4)
        state = banks.init(bank, np.full(4, np.nan), u, np.zeros(4, dtype=bool))
        rest = equilibrium(lure, u, tol=1e-12, max_iter=100)
        np.testing.assert_allclose(banks.estimate(bank, state, -1), rest, atol=1e-9)


class TestNetReactivePower:
    @pytest.mark.parametrize(
        "name", ["all customers have inverter and meter", "some customers have no inverter"]
    )
    @pytest.mark.parametrize("h", [1.0, 900.0])
    def test_used_exactly_while_the_meter_is_trusted(self, name: str, h: float) -> None:
        rng = np.random.default_rng(11)
        feeder = tree(6, rng)
        own = np.asarray(CASES[name].get("inverters", np.arange(6)))
        droop = mixed_fleet(own, rng)
        lure = close_loop(feeder, droop, np.arange(6))
        column = -2.0 * lindistflow(feeder).X
        bank = banks.design(lure, 2, reactive=column)
        seen = np.ones(6, dtype=bool)
        net = np.array([0.01, np.nan, 0.02, -0.01, np.nan, 0.03])
        y, u = readings(lure, rng)
        state = banks.init(bank, y, u, seen, net=net)
        slow = states(bank, state)
        for _ in range(3):
            y, u = readings(lure, rng)
            state = banks.step(bank, state, y, u, seen, h, net=net)
            slow = np.stack(
                [
                    _with_net(bank, lure, column, own, mask, x, y, u, net, h)
                    for mask, x in zip(bank.masks, slow, strict=True)
                ]
            )
            np.testing.assert_allclose(states(bank, state), slow, rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(banks.consistency(bank, state), _ordered(bank, slow), atol=1e-9)


def _with_net(  # noqa: PLR0917
    bank: banks.Bank,
    lure: Lure,
    column: np.ndarray,
    own: np.ndarray,
    mask: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    u: np.ndarray,
    net: np.ndarray,
    h: float,
) -> np.ndarray:
    """One observer that takes the metered net injection in place of its own inverter's."""
    single = one_observer(lure, mask)
    used = mask & np.isfinite(net)
    H = single.H.copy()
    H[:, used[own]] = 0.0
    extra = u + column[:, used] @ net[used]
    changed = Lure(
        A=single.A,
        G=single.G,
        H=H,
        F=single.F,
        B=single.B,
        C=single.C,
        D=single.D,
        slope=single.slope,
        phi=single.phi,
    )
    prepared = lures.transition(lure, h, bank.policy)
    return lures.step(prepared, changed, x, np.concatenate([extra, y]))


class TestGuarantees:
    @settings(max_examples=25)
    @given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.02, 1e6), M=st.integers(1, 2))
    def test_theorem_2(self, seed: int, size: float, M: int) -> None:
        """Up to M meters say anything: the selected estimate converges to the truth all the same."""
        rng = np.random.default_rng(seed)
        lure = plant(rng, customers=7)
        bank = banks.design(lure, M)
        liars = rng.choice(7, size=M, replace=False)
        seen = np.ones(7, dtype=bool)
        u = rng.uniform(-0.05, 0.15, 7)
        truth = rng.uniform(-1.0, 1.0, 7) * 0.04
        state = banks.init(bank, rng.uniform(-0.1, 0.1, 7), u, seen)
        far = np.abs(truth).max() + 0.1
        for k in range(120):
            # Readings of the interval's end would see the truth after the step; hold both together.
            y = lure.C @ truth + lure.D @ u
            y[liars] += size * rng.uniform(-1.0, 1.0, M)
            state = banks.step(bank, state, y, u, seen, 0.5)
            truth = lures.advance(lure, truth, u, 0.5)
            error = np.abs(banks.estimate(bank, state, banks.select(banks.consistency(bank, state))) - truth)
            assert error.max() <= far
            if k > 100:
                assert error.max() < 1e-4

    @settings(max_examples=25)
    @given(seed=st.integers(0, 2**32 - 1), lie=st.floats(-1e9, 1e9))
    def test_masked_meter_has_exactly_no_influence(self, seed: int, lie: float) -> None:
        rng = np.random.default_rng(seed)
        lure = plant(rng, customers=6)
        bank = banks.design(lure, 2)
        seen = np.ones(6, dtype=bool)
        y, u = readings(lure, rng)
        honest = banks.init(bank, y, u, seen)
        lied = y.copy()
        lied[3] += lie
        attacked = banks.init(bank, lied, u, seen)
        for _ in range(3):
            honest = banks.step(bank, honest, y, u, seen, 1.0)
            attacked = banks.step(bank, attacked, lied, u, seen, 1.0)
        without = ~bank.masks[:, 3]
        # Common sums are shared, so a lie may move the last bit; it saturates, so it moves no other.
        moved = np.abs(states(bank, honest) - states(bank, attacked))
        assert moved[without].max() <= 1e-13
        general = banks.design(lure, 2, gains=banks.direct_gains(lure, bank.masks))
        both = [banks.init(general, readings_, u, seen) for readings_ in (y, lied)]
        both = [banks.step(general, s, r, u, seen, 1.0) for s, r in zip(both, (y, lied), strict=True)]
        assert np.array_equal(states(general, both[0])[without], states(general, both[1])[without])

    @settings(max_examples=25)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_attacks_are_visible(self, seed: int) -> None:
        """A lie that moves a droop curve makes every set with the liar disagree, and only those."""
        rng = np.random.default_rng(seed)
        lure = plant(rng, customers=6)
        bank = banks.design(lure, 2)
        seen = np.ones(6, dtype=bool)
        u = rng.uniform(0.045, 0.06, 6)  # on the ramps, away from the deadband
        x = equilibrium(lure, u, tol=1e-13, max_iter=100)
        y = lure.C @ x + lure.D @ u
        liar = rng.integers(6)
        y[liar] += 0.06
        state = banks.init(bank, y, u, seen)
        pi = banks.consistency(bank, state)
        large = bank.masks[: pi.size]
        assert pi[~large[:, liar]].max() < 1e-9
        assert pi[large[:, liar]].min() > 1e-4
        assert not large[banks.select(pi), liar]

    def test_degenerate_gains_are_refused(self) -> None:
        lure = plant(np.random.default_rng(12), customers=3)
        gains = banks.direct_gains(lure, banks.subsets(3, 1, most=100).masks())
        with pytest.raises(DesignInfeasible, match="detect nothing"):
            banks.design(lure, 1, gains=banks.Gains(gains.L * 0.0, gains.K * 0.0))

    def test_gains_must_fit_their_sets(self) -> None:
        lure = plant(np.random.default_rng(13), customers=3)
        gains = banks.direct_gains(lure, banks.subsets(3, 1, most=100).masks())
        with pytest.raises(ValueError, match="outside its set"):
            banks.design(lure, 1, gains=banks.Gains(gains.L, np.ones_like(gains.K)))
        with pytest.raises(ValueError, match="shapes"):
            banks.design(lure, 1, gains=banks.Gains(gains.L[:2], gains.K[:2]))
        with pytest.raises(ValueError, match="finite"):
            banks.design(lure, 1, gains=banks.Gains(gains.L, gains.K * np.nan))

    def test_output_injection(self) -> None:
        """Gains L are followed too: every observer rests where its equation says."""
        rng = np.random.default_rng(14)
        lure = plant(rng, customers=4)
        masks = banks.subsets(4, 1, most=100).masks()
        gains = banks.direct_gains(lure, masks)
        L = 0.02 * rng.uniform(-1.0, 1.0, gains.L.shape) * masks[:, None, :]
        bank = banks.design(lure, 1, gains=banks.Gains(L, 0.7 * gains.K))
        seen = np.array([True, True, True, False])
        y, u = readings(lure, rng)
        y[3] = np.nan
        state = banks.init(bank, y, u, seen)
        moved = banks.step(bank, state, y, u, seen, 3.0)
        np.testing.assert_allclose(states(bank, moved), states(bank, state), atol=1e-8)
        for mask, x, gain in zip(masks, states(bank, state), L, strict=True):
            inside = mask & seen
            gap = np.where(inside, np.nan_to_num(y) - lure.C @ x - lure.D @ u, 0.0)
            zeta = lure.H @ x + lure.F @ u + 0.7 * gap
            np.testing.assert_allclose(lure.A @ x + lure.G @ lure.phi(zeta) + gain @ gap, 0.0, atol=1e-9)

    def test_direct_needs_a_feeder(self) -> None:
        lure = plant(np.random.default_rng(15), customers=3)
        other = Lure(
            A=2 * lure.A,
            G=lure.G,
            H=lure.H,
            F=lure.F,
            B=lure.B,
            C=lure.C,
            D=lure.D,
            slope=lure.slope,
            phi=lure.phi,
        )
        with pytest.raises(ValueError, match="T\\^-1"):
            banks.design(other, 1)
        strange = Lure(
            A=lure.A,
            G=lure.G,
            H=lure.H,
            F=lure.F,
            B=lure.B,
            C=lure.C,
            D=lure.D,
            slope=lure.slope,
            phi=np.tanh,
        )
        with pytest.raises(TypeError, match="Droop"):
            banks.design(strange, 1)


class TestSelection:
    def test_smallest_wins_and_ties_go_to_the_penalty(self) -> None:
        pi = np.array([0.3, 0.1, 0.1, 0.2])
        assert banks.select(pi) == 1
        assert banks.select(pi, penalty=np.array([0.0, 5.0, 4.0, 0.0])) == 2
        assert banks.select(pi, penalty=np.array([0.0, 5.0, 4.0, 3.0]), tie=0.15) == 3
        assert banks.select(pi, allowed=np.array([True, False, False, True])) == 3
        assert banks.select(pi, allowed=np.zeros(4, dtype=bool)) == -1
        assert banks.select(np.zeros(0)) == -1

"""The exact bank against one plain observer per subset, and chong2020's guarantees."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import comb

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.estimators.exact_bank import bank as banks
from gridsec.grid.devices import Droop
from gridsec.observers.lure import StepPolicy, close_loop
from gridsec.secure.index import dynamic_index
from gridsec.secure.subsets import most_attacked
from tests.codes import refused
from tests.gridsec.small_banks import CASES, loop_step, mixed_fleet, ordered, plant, readings, states, tree


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
        with refused(NotObservable, "too-few-meters") as caught:
            banks.subsets(p, M, most=10**6)
        assert caught.value.rank == p

    @pytest.mark.parametrize("seed", range(8))
    def test_the_most_liars_that_a_plant_withstands(self, seed: int) -> None:
        """Oracles: the definition, set by set, and the security index of linear plants."""
        rng = np.random.default_rng(seed)
        A = np.diag([0.5, 0.5, -0.3]) + np.diag([float(rng.integers(2)), 0.0], 1)
        C = rng.integers(-1, 2, (6, 3)).astype(float)

        def seen(J: tuple[int, ...]) -> bool:
            rows = C[list(J)]
            return bool(np.linalg.matrix_rank(np.vstack([rows, rows @ A, rows @ A @ A])) == 3)

        def holds(M: int) -> bool:
            return all(seen(J) for size in range(6 - 2 * M, 7) for J in combinations(range(6), size))

        found = most_attacked(6, lambda J: seen(tuple(J)))
        assert found == max((M for M in range(3) if holds(M)), default=-1)
        assert found == min(dynamic_index(A, C, tol=1e-9).correctable, 2)

    def test_all_but_the_last_meter_may_be_lost_and_none(self) -> None:
        assert [most_attacked(p, lambda J: J.size > 0) for p in (0, 1, 2, 3, 7)] == [-1, 0, 0, 1, 3]
        assert most_attacked(5, lambda J: J.size > 5) == -1
        assert most_attacked(5, lambda J: 4 in J) == 0

    def test_too_many_observers(self) -> None:
        with refused(DesignInfeasible, "too-many"):
            banks.subsets(146, 2, most=200_000)

    def test_negative(self) -> None:
        with refused(InputInvalid, "negative"):
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
                np.testing.assert_allclose(pi, ordered(bank, slow), rtol=0.0, atol=1e-9)
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
        np.testing.assert_allclose(banks.consistency(bank, fast), ordered(bank, slow), rtol=0, atol=1e-15)

    def test_dense_product_gives_the_same(self, monkeypatch: pytest.MonkeyPatch) -> None:
        rng = np.random.default_rng(5)
        lure = plant(rng, customers=8, meters=[0, 1, 3, 4, 5, 7])
        kept = banks.design(lure, 2)
        monkeypatch.setattr("gridsec.estimators.exact_bank.direct._BLOCK_BYTES", 0)
        monkeypatch.setattr("gridsec.estimators.exact_bank.direct._NEWTON_ENTRIES", 64)
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


class TestSelection:
    def test_smallest_wins_and_ties_go_to_the_penalty(self) -> None:
        pi = np.array([0.3, 0.1, 0.1, 0.2])
        assert banks.select(pi) == 1
        assert banks.select(pi, penalty=np.array([0.0, 5.0, 4.0, 0.0])) == 2
        assert banks.select(pi, penalty=np.array([0.0, 5.0, 4.0, 3.0]), tie=0.15) == 3
        assert banks.select(pi, allowed=np.array([True, False, False, True])) == 3
        assert banks.select(pi, allowed=np.zeros(4, dtype=bool)) == -1
        assert banks.select(np.zeros(0)) == -1

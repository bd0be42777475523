"""What chong2020 guarantees of the exact bank: silence, lies, metered reactive power."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.estimators.exact_bank import bank as banks
from gridsec.observers import lure as lures
from gridsec.observers.lure import Lure, close_loop, equilibrium
from tests.codes import refused
from tests.gridsec.small_banks import (
    CASES,
    loop_step,
    mixed_fleet,
    one_observer,
    ordered,
    plant,
    readings,
    states,
    tree,
)


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
                np.testing.assert_allclose(pi, ordered(bank, slow), rtol=0.0, atol=1e-14)

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
        column = -2.0 * feeder.linear().X
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
            np.testing.assert_allclose(banks.consistency(bank, state), ordered(bank, slow), atol=1e-9)


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
        with refused(DesignInfeasible, "degenerate"):
            banks.design(lure, 1, gains=banks.Gains(gains.L * 0.0, gains.K * 0.0))

    def test_gains_must_fit_their_sets(self) -> None:
        lure = plant(np.random.default_rng(13), customers=3)
        gains = banks.direct_gains(lure, banks.subsets(3, 1, most=100).masks())
        with refused(InputInvalid, "wrong-design"):
            banks.design(lure, 1, gains=banks.Gains(gains.L, np.ones_like(gains.K)))
        with refused(InputInvalid, "shape"):
            banks.design(lure, 1, gains=banks.Gains(gains.L[:2], gains.K[:2]))
        with refused(InputInvalid, "not-finite"):
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
        with refused(InputInvalid, "wrong-form"):
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

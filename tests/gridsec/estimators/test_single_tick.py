"""Decoders of single ticks: weighted least squares, l0, basis pursuit, matching pursuit.

The oracles are dense: the readings are stacked on the pseudo-measurements "this load draws what its meter
says", as lee2018 writes it, and solved anew for every set of meters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.stats import chi2, norm

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible, NotObservable
from gridsec.estimators import single_tick
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.front.posterior import condition, leave_one_out, voltage_prior
from gridsec.estimators.plant import Plant
from gridsec.estimators.single_tick import (
    Decoder,
    SingleTickDesign,
    SingleTickState,
    fewest,
    least_squares,
    match,
    pursue,
)
from gridsec.estimators.single_tick.decoders import DecoderInput, Limits
from gridsec.interface import Cause, Decision, Estimate, Frame, Verdict
from gridsec.secure.decode.gaussian import design_test, detect
from gridsec.secure.decode.stacks import Stack
from tests.codes import refused
from tests.gridsec.street import BASE_KVA, Street, make_plant, random_tree

ALL = pytest.mark.parametrize("decoder", [least_squares, fewest, pursue, match])
P_STD, Q_STD, BUSBAR, NOISE = 0.006, 0.002, 4e-4, 0.002


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """A random tree with a meter at every customer, stacked: m = A c + e, c and e of known covariance."""

    A: Floats
    stack: Stack
    P: Floats
    evidence: Callable[..., DecoderInput]

    @property
    def covariance(self) -> Floats:
        """Of the readings."""
        return np.asarray(self.A @ self.A.T + NOISE**2 * np.eye(len(self.A)))

    def draw(self, rng: np.random.Generator) -> Floats:
        p, loads = self.A.shape
        return np.asarray(self.A @ rng.normal(size=loads) + NOISE * rng.normal(size=p))

    def loo(self, m: Floats, kept: list[int]) -> tuple[Floats, Floats, float]:
        """Leave-one-out residuals of some meters and their standard deviations, and the misfit."""
        inverse = np.linalg.inv(self.covariance[np.ix_(kept, kept)])
        weights = inverse @ m[kept]
        return weights / np.diag(inverse), 1.0 / np.sqrt(np.diag(inverse)), float(m[kept] @ weights)


def bench(rng: np.random.Generator, p: int = 8, sigmas: float = 3.5, most: int = 3) -> Bench:
    tree = random_tree(p, rng, drop=0.04)
    model = tree.linear()
    R, X = model.R_bus[1:], model.X_bus[1:]
    A = np.hstack([2.0 * R * P_STD, 2.0 * X * Q_STD, np.full((p, 1), BUSBAR)])
    doubt = LoadDoubt(np.full(p, P_STD), np.full(p, Q_STD), 600.0)
    before = voltage_prior(tree, np.arange(1, p + 1), doubt, busbar=BUSBAR)
    zeros = np.zeros(p)

    def evidence(m: Floats, live: Bools | None = None) -> DecoderInput:
        seen = np.ones(p, dtype=bool) if live is None else live
        return DecoderInput(
            whole=condition(before, np.full(p, NOISE**2), seen),
            m=m,
            available=seen,
            limits=Limits(sigmas, zeros, zeros, zeros),
            max_attacked=most,
        )

    loads = A.shape[1]
    stack = Stack.of_rows(np.vstack([A, np.eye(loads)]))
    noise = np.diag(np.concatenate([np.full(p, NOISE**2), np.ones(loads)]))
    return Bench(A, stack, noise, evidence)


def lies(rng: np.random.Generator, p: int, most: int, sizes: list[float]) -> Floats:
    out = np.zeros(p)
    who = rng.choice(p, rng.integers(0, most + 1), replace=False)
    out[who] = rng.choice(sizes, who.size) * rng.choice([-1.0, 1.0], who.size)
    return out


def who(accused: Bools) -> tuple[int, ...]:
    return tuple(np.flatnonzero(accused).tolist())


class TestLeastSquares:
    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_it_is_the_chi_square_test_and_the_largest_normalised_residual(self, seed: int) -> None:
        """Oracle: Algorithm 2.2 on the stack, refitted for every set of meters that is left."""
        rng = np.random.default_rng(seed)
        made, p = bench(rng), 8
        m = made.draw(rng) + lies(rng, p, 4, [0.008, 0.02, 0.06])
        z = np.concatenate([m, np.zeros(made.A.shape[1])])
        alarm = 2.0 * norm.sf(3.5) * p
        kept = list(range(p))
        for _ in range(3):
            test = design_test(made.stack, made.P, np.array(kept + list(range(p, z.size))))
            assert test.freedom == len(kept)
            tested = detect(test, z, false_alarm=alarm)
            rows = made.stack.matrix[kept]
            residual = z[kept] - rows @ tested.x
            std = np.sqrt(NOISE**2 - np.einsum("ij,jk,ik->i", rows, test.covariance, rows))
            normalised = np.abs(residual) / std
            if not tested.alarm and normalised.max() <= 3.5:
                break
            kept.pop(int(np.argmax(normalised)))
        (answer,) = least_squares(made.evidence(m))
        assert who(answer.meters) == tuple(sorted(set(range(p)) - set(kept)))

    def test_false_alarms_are_as_many_as_asked_for(self) -> None:
        """Two tests of rate alpha: alpha by the chi-square test, at most 2 alpha together."""
        rng = np.random.default_rng(5)
        made, draws, sigmas = bench(rng, p=10, sigmas=2.8), 12_000, 2.8
        alpha = 2.0 * norm.sf(sigmas) * 10
        now = made.evidence(np.zeros(10))
        readings = np.array([made.draw(rng) for _ in range(draws)])
        misfit = np.array([leave_one_out(now.whole, m).chi_square for m in readings])
        assert np.mean(misfit > chi2.isf(alpha, 10)) == pytest.approx(alpha, rel=0.12)
        # With as many degrees of freedom as rows, which the paper prints, there would be none.
        assert np.mean(misfit > chi2.isf(alpha, len(made.stack.matrix))) < 0.02 * alpha
        raised = np.mean([least_squares(replace(now, m=m))[0].meters.any() for m in readings])
        assert 0.88 * alpha < raised < 2.0 * alpha


class TestFewest:
    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_no_smaller_set_explains_the_readings_and_none_as_small_does_better(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        made, p, most = bench(rng), 8, 3
        m = made.draw(rng) + lies(rng, p, most, [0.008, 0.02, 0.06])
        answers = fewest(made.evidence(m))
        for size in range(most + 1):
            fine = []
            for out in combinations(range(p), size):
                offset, std, misfit = made.loo(m, [j for j in range(p) if j not in out])
                if (np.abs(offset) <= 3.5 * std).all():
                    fine.append((misfit, out))
            if fine:
                break
        if not fine:
            # Nothing of the size allowed explains the readings: the best of that size, and no rival.
            assert len(answers) == 1
            assert answers[0].meters.sum() == most
            return
        fine.sort()
        near = [
            (out, misfit - fine[0][0]) for misfit, out in fine if misfit - fine[0][0] <= 2.0 * np.log(100)
        ]
        assert [who(each.meters) for each in answers] == [out for out, _ in near]
        np.testing.assert_allclose([each.worse for each in answers], [worse for _, worse in near], atol=1e-6)

    def test_two_meters_that_can_only_contradict_each_other_are_rivals(self) -> None:
        """Behind one long branch there are two meters: who of them lies, nobody can say."""
        rng = np.random.default_rng(3)
        made = bench(rng, p=8)
        m = np.zeros(8)
        live = np.zeros(8, dtype=bool)
        live[[6, 7]] = True
        m[[6, 7]] = 0.05, -0.05
        answers = fewest(made.evidence(m, live))
        assert {who(each.meters) for each in answers} <= {(6,), (7,), (6, 7)}
        assert len(answers) > 1 or who(answers[0].meters) == (6, 7)


class TestPursuit:
    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_basis_pursuit_is_the_linear_program(self, seed: int) -> None:
        """Oracle: the program in epigraph form, by an interior point method."""
        rng = np.random.default_rng(seed)
        made, p = bench(rng), 8
        m = made.draw(rng) + lies(rng, p, 3, [0.02, 0.06])
        values, vectors = np.linalg.eigh(made.A @ made.A.T)
        F = np.hstack([NOISE * np.eye(p), vectors * np.sqrt(np.maximum(values, 0.0))])
        k, eye, scale = 2 * p, np.eye(2 * p), float(np.abs(m).max())
        found = linprog(
            np.concatenate([np.zeros(k), np.ones(k)]),
            A_ub=np.block([[eye, -eye], [-eye, -eye]]),
            b_ub=np.zeros(2 * k),
            A_eq=np.hstack([F, np.zeros((p, k))]),
            b_eq=m / scale,
            bounds=[(None, None)] * k + [(0, None)] * k,
            method="highs-ipm",
        )
        assert found.success
        attack = np.abs(NOISE * scale * found.x[:p])
        limit = 3.5 * made.loo(m, list(range(p)))[1]
        (answer,) = pursue(made.evidence(m))
        clear = np.abs(attack - limit) > 1e-6 * limit
        np.testing.assert_array_equal(answer.meters[clear], (attack > limit)[clear])

    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_matching_pursuit_takes_the_best_column_of_what_is_left(self, seed: int) -> None:
        """Oracle: generalised least squares, the column of largest cosine in the metric of the covariance."""
        rng = np.random.default_rng(seed)
        made, p = bench(rng), 8
        m = made.draw(rng) + lies(rng, p, 3, [0.02, 0.06])
        Q = np.linalg.inv(made.covariance)
        chosen: list[int] = []
        attack, rest = np.zeros(p), m
        for _ in range(3):
            cosine = np.abs(Q @ rest) / np.sqrt(np.diag(Q))
            cosine[chosen] = -1.0
            chosen.append(int(np.argmax(cosine)))
            amounts = np.linalg.solve(Q[np.ix_(chosen, chosen)], (Q @ m)[chosen])
            attack = np.zeros(p)
            attack[chosen] = amounts
            rest = m - attack
        limit = 3.5 * made.loo(m, list(range(p)))[1]
        (answer,) = match(made.evidence(m))
        np.testing.assert_array_equal(answer.meters, np.abs(attack) > limit)


@ALL
@pytest.mark.parametrize("seed", range(5))
def test_a_single_gross_lie_is_found_by_all(decoder: Decoder, seed: int) -> None:
    rng = np.random.default_rng([9, seed])
    made = bench(rng, p=10)
    m, liar = made.draw(rng), int(rng.integers(10))
    m[liar] += 0.1
    assert who(decoder(made.evidence(m))[0].meters) == (liar,)


@ALL
def test_a_meter_without_a_reading_has_no_influence_and_is_not_accused(decoder: Decoder) -> None:
    rng = np.random.default_rng(8)
    made = bench(rng)
    m, live = made.draw(rng), np.ones(8, dtype=bool)
    m[5] += 0.08
    live[[1, 6]] = False
    other = m.copy()
    other[[1, 6]] = 1e3, -7.0
    for first, second in zip(
        decoder(made.evidence(m, live)), decoder(made.evidence(other, live)), strict=True
    ):
        np.testing.assert_array_equal(first.meters, second.meters)
        assert not first.meters[[1, 6]].any()
    empty = decoder(made.evidence(np.where(live, 0.0, m), np.zeros(8, dtype=bool)))
    assert not empty[0].meters.any()


def prepare(plant: Plant, decoder: Decoder, *, step_s: float = 1.0, most: int = 2) -> SingleTickDesign:
    """For the street's loads: p metered within 1 %, power factors known within limits."""
    n = len(plant.feeder.customers)
    doubt = LoadDoubt(np.full(n, 0.03 / BASE_KVA), np.full(n, 0.6 / BASE_KVA), 600.0, common_q=0.5)
    return single_tick.design(plant, decoder, doubt=doubt, step_s=step_s, max_attacked=most)


def watch(
    street: Street,
    design: SingleTickDesign,
    frames: int,
    *,
    h: float = 1.0,
    state: SingleTickState | None = None,
    lies: dict[int, float] | None = None,
    silent: tuple[int, ...] = (),
    change: Callable[[Frame], Frame] = lambda frame: frame,
) -> tuple[SingleTickState, list[tuple[Estimate, Verdict]]]:
    """Run a street; check on every frame what must always hold."""
    state = single_tick.init(design, street.t) if state is None else state
    answers = []
    for _ in range(frames):
        street.advance(h)
        frame = change(street.frame(lies, silent))
        state, estimate, verdict = single_tick.step(design, state, frame)
        for values in (estimate.v2, estimate.bound, estimate.std, verdict.threshold, verdict.attack):
            assert np.isfinite(values).all()
        assert (estimate.std > 0).all()
        assert (estimate.bound > 0).all()
        assert not (estimate.trusted & (verdict.suspects | ~frame.seen)).any()
        assert (verdict.attack[~verdict.suspects] == 0).all()
        answers.append((estimate, verdict))
    return state, answers


@ALL
class TestOnStreets:
    """AC power flow, droop inverters, meters with fixed errors, resolution and jitter."""

    @pytest.mark.canary("1.0-least_squares", "1.0-match")
    @pytest.mark.parametrize("h", [1.0, 60.0, 900.0])
    def test_nobody_is_named_where_nobody_lies(self, decoder: Decoder, h: float) -> None:
        for seed in range(3):
            rng = np.random.default_rng([1, seed])
            plant = make_plant(rng, drop=0.04)
            street = Street(plant, rng)
            _, answers = watch(street, prepare(plant, decoder, step_s=h), 40, h=h)
            assert not any(verdict.suspects.any() for _, verdict in answers)
            assert answers[-1][1].decision is Decision.CLEAN
            assert (np.abs(answers[-1][0].v2 - street.truth()) <= answers[-1][0].bound).all()

    @pytest.mark.canary("0-least_squares")
    @pytest.mark.parametrize("seed", range(3))
    def test_exactly_the_liars_are_named_until_they_stop(self, decoder: Decoder, seed: int) -> None:
        rng = np.random.default_rng([2, seed])
        plant = make_plant(rng, customers=12, drop=0.04)
        design, street = prepare(plant, decoder), Street(plant, rng)
        state, _ = watch(street, design, 40)
        liars = np.sort(rng.choice(12, 2, replace=False))
        told = {int(j): float(rng.choice([-1.0, 1.0])) * 0.04 for j in liars}
        state, answers = watch(street, design, 20, state=state, lies=told)
        for _, verdict in answers[3:]:
            assert verdict.decision is Decision.ATTACKED
            assert who(verdict.suspects) == tuple(liars.tolist())
        estimate, verdict = answers[-1]
        truth = street.truth()
        assert (np.abs(estimate.v2 - truth) <= estimate.bound).all()
        lie = truth[liars] * ((1.0 + np.array([told[int(j)] for j in liars])) ** 2 - 1.0)
        np.testing.assert_allclose(verdict.attack[liars], lie, atol=0.02)
        _, after = watch(street, design, 20, state=state)
        assert after[-1][1].decision is Decision.CLEAN

    @pytest.mark.canary("0-least_squares", "2-match")
    @pytest.mark.parametrize("seed", range(3))
    def test_more_liars_than_allowed_are_undecided(self, decoder: Decoder, seed: int) -> None:
        """Three of twelve lie and two can be told apart: what is left contradicts every answer."""
        rng = np.random.default_rng([3, seed])
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant, decoder), Street(plant, rng)
        state, _ = watch(street, design, 30)
        liars = rng.choice(12, 3, replace=False)
        told = {int(j): float(rng.choice([-1.0, 1.0])) * 0.06 for j in liars}
        _, answers = watch(street, design, 12, state=state, lies=told)
        for _, verdict in answers[3:]:
            assert verdict.decision is Decision.UNDECIDED
            assert verdict.cause is Cause.TOO_MANY_SUSPECTS
            assert set(who(verdict.suspects)) <= set(liars.tolist())

    @pytest.mark.canary("match")
    def test_silent_meters_are_undecided_and_liars_still_named(self, decoder: Decoder) -> None:
        rng = np.random.default_rng(4)
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant, decoder), Street(plant, rng)
        silent = (1, 4, 7, 10)
        state, answers = watch(street, design, 40, silent=silent)
        assert answers[-1][1].cause is Cause.SILENT_METERS
        state, answers = watch(street, design, 8, state=state, silent=silent, lies={5: 0.05})
        assert who(answers[-1][1].suspects) == (5,)
        _, answers = watch(street, design, 3, state=state, silent=tuple(range(2, 12)))
        assert answers[-1][1].decision is Decision.UNDECIDED
        assert answers[-1][1].cause is Cause.TOO_FEW_METERS

    def test_what_is_no_reading_counts_as_none(self, decoder: Decoder) -> None:
        """NaN in a frame that claims to have seen the meter: the same as not seen, bit for bit."""
        rng = np.random.default_rng(5)
        plant = make_plant(rng)
        design = prepare(plant, decoder)
        start = single_tick.init(design, 1000.0)
        street = Street(plant, rng)
        street.advance(1.0)
        frame = street.frame(silent=(3,))
        _, estimate, verdict = single_tick.step(design, start, frame)
        for junk in (np.nan, np.inf):
            y = np.where(np.arange(9) == 3, junk, frame.y)
            broken = replace(frame, y=y, seen=np.ones(9, dtype=bool))
            _, again, said = single_tick.step(design, start, broken)
            np.testing.assert_array_equal(again.v2, estimate.v2)
            assert (said.decision, said.cause) == (verdict.decision, verdict.cause)
        hidden = replace(frame, y=np.where(frame.seen, frame.y, 1.3))
        np.testing.assert_array_equal(single_tick.step(design, start, hidden)[1].v2, estimate.v2)

    def test_a_frame_that_is_not_later_changes_nothing(self, decoder: Decoder) -> None:
        rng = np.random.default_rng(6)
        plant = make_plant(rng)
        design, street = prepare(plant, decoder), Street(plant, rng)
        state, answers = watch(street, design, 20)
        for t in (street.t, street.t - 5.0, np.nan):
            again, estimate, verdict = single_tick.step(design, state, replace(street.frame(), t=t))
            assert again is state
            assert verdict.decision is Decision.UNDECIDED
            np.testing.assert_array_equal(estimate.v2, answers[-1][0].v2)

    def test_without_the_busbar_the_others_still_tell(self, decoder: Decoder) -> None:
        rng = np.random.default_rng(7)
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant, decoder), Street(plant, rng)
        blind: Callable[[Frame], Frame] = lambda frame: replace(frame, v0_squared=np.nan)  # noqa: E731
        state, answers = watch(street, design, 30, change=blind)
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert (np.abs(answers[-1][0].v2 - street.truth()) <= answers[-1][0].bound).all()
        _, answers = watch(street, design, 8, state=state, lies={8: 0.05}, change=blind)
        assert who(answers[-1][1].suspects) == (8,)

    @pytest.mark.canary("least_squares")
    @settings(max_examples=10, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_absurd_frames_raise_nothing(self, decoder: Decoder, seed: int) -> None:
        rng = np.random.default_rng(seed)
        plant = make_plant(rng)

        def spoil(frame: Frame) -> Frame:
            y, p = frame.y.copy(), frame.p.copy()
            y[rng.integers(9)] = rng.choice([np.nan, -1.0, 1e6, 0.0, 1e-300])
            p[rng.integers(9)] = rng.choice([1e3, -1e3, 0.0])
            return replace(frame, y=y, p=p)

        watch(Street(plant, rng), prepare(plant, decoder), 6, change=spoil)

    @pytest.mark.canary("least_squares")
    def test_the_standard_deviation_is_about_right(self, decoder: Decoder) -> None:
        ratio = []
        for seed in range(12):
            rng = np.random.default_rng([7, seed])
            plant = make_plant(rng, customers=12, drop=0.04)
            street = Street(plant, rng)
            _, answers = watch(street, prepare(plant, decoder), 20)
            ratio.append((answers[-1][0].v2 - street.truth()) / answers[-1][0].std)
        assert 0.3 < float(np.sqrt(np.mean(np.square(ratio)))) < 1.3


class TestDesign:
    def test_too_many_sets_are_refused(self) -> None:
        plant = make_plant(np.random.default_rng(1), customers=60)
        with refused(DesignInfeasible, "too-many"):
            prepare(plant, fewest, most=3)
        assert prepare(plant, match, most=3).max_attacked == 3

    @ALL
    def test_too_few_meters_are_refused(self, decoder: Decoder) -> None:
        plant = make_plant(np.random.default_rng(1), meters=np.array([0, 5]))
        with refused(NotObservable, "too-few-meters"):
            prepare(plant, decoder, most=1)

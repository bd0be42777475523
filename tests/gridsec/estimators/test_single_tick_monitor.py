"""Monitor of the decoders of single ticks: estimate, confirmation, and every cause of UNDECIDED.

The oracle is dense: covariances by matrices R and X, one inverse for each set of meters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible
from gridsec.estimators import single_tick
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.plant import Plant
from gridsec.estimators.single_tick import Decoder, SingleTickDesign, fewest, least_squares, match, pursue
from gridsec.estimators.single_tick.decoders import DecoderAnswer, DecoderInput
from gridsec.grid.radial import Feeder
from gridsec.interface import Cause, Decision, Estimate, Frame, PowerOrigin, Verdict
from tests.gridsec.estimators.test_single_tick import ALL, prepare, watch, who
from tests.gridsec.street import BASE_KVA, BASE_VOLT, Street, accuracy, make_plant
from tests.gridsec.streets import PhasedStreet, coupled

YEAR_S = 365.25 * 86400.0
DECODERS: tuple[Decoder, ...] = (least_squares, fewest, pursue, match)


def no_accusation(evidence: DecoderInput) -> tuple[DecoderAnswer, ...]:
    return (DecoderAnswer(np.zeros_like(evidence.available)),)


def no_solution(_: DecoderInput) -> tuple[DecoderAnswer, ...]:
    raise DesignInfeasible("basis pursuit", "linear program: no solution", code="no-solution")


# --------------------------------------------------------------------------------------------- dense oracle


@dataclass(frozen=True, slots=True, eq=False)
class Dense:
    """One frame by matrices. n buses, p meters, one at every customer."""

    v2: Floats
    S: Floats
    m: Floats
    noise: Floats
    model: Floats
    allowed: Floats
    fixed: Floats
    sigmas: float

    @staticmethod
    def of(design: SingleTickDesign, plant: Plant, frame: Frame) -> Dense:
        model, front, at = plant.feeder.linear(), design.front, plant.feeder.bus
        p, doubt = at.size, front.doubt
        common = np.full((p, p), doubt.common_q) + (1.0 - doubt.common_q) * np.eye(p)
        R, X = model.R_bus, model.X_bus
        S = 4.0 * R @ np.diag(doubt.p**2) @ R.T + 4.0 * X @ (common * np.outer(doubt.q, doubt.q)) @ X.T
        S += front.busbar**2
        v2 = plant.feeder.bus_voltages(frame.p, frame.q, frame.v0_squared, steps=1)
        error = plant.feeder.model_error_bound(frame.p, frame.q, frame.v0_squared)
        return Dense(
            v2=v2,
            S=S,
            m=frame.y - v2[at],
            noise=front.white + front.fixed,
            model=error,
            allowed=front.allowed,
            fixed=front.fixed,
            sigmas=float(norm.isf(0.5 / (YEAR_S * 2 * p))),
        )

    def without(self, out: tuple[int, ...]) -> tuple[Floats, Floats, Floats, float]:
        """Correction and variance of all buses, residuals relative to their limits, and misfit."""
        p = self.m.size
        kept = [j for j in range(p) if j not in out]
        at = np.arange(1, p + 1)
        Q = np.linalg.inv(self.S[np.ix_(at, at)][np.ix_(kept, kept)] + np.diag(self.noise[kept]))
        K = self.S[:, at][:, kept]
        w, M = K @ Q @ self.m[kept], self.S - K @ Q @ K.T
        residual, variance = self.m - w[at], np.diag(M)[at] + self.noise
        residual[kept] = (Q @ self.m[kept]) / np.diag(Q)
        variance[kept] = 1.0 / np.diag(Q)
        rest = np.sqrt(np.maximum(variance - self.fixed, 0.0))
        chance = np.minimum(self.sigmas * np.sqrt(variance), self.allowed + self.sigmas * rest)
        return w, np.diag(M), residual / (self.model + chance), float(self.m[kept] @ Q @ self.m[kept])

    def inside(self, out: tuple[int, ...]) -> Floats:
        return np.delete(np.abs(self.without(out)[2]), out)

    def smallest(self, most: int) -> list[tuple[int, ...]]:
        """Every set of the least size with all others within their limits, the likeliest first."""
        for size in range(most + 1):
            fine = [out for out in combinations(range(self.m.size), size) if (self.inside(out) <= 1.0).all()]
            if fine:
                misfits = [self.without(out)[3] for out in fine]
                near = min(misfits) + 2.0 * np.log(100.0)
                return [out for misfit, out in sorted(zip(misfits, fine, strict=True)) if misfit <= near]
        raise AssertionError("no set explains the readings")

    def greedy(self, most: int) -> tuple[int, ...]:
        """Algorithm 2.2: the chi-square test, then the largest residual."""
        p, out = self.m.size, ()
        alarm = 2.0 * norm.sf(self.sigmas) * p
        for _ in range(most):
            _, _, ratio, misfit = self.without(out)
            kept = [j for j in range(p) if j not in out]
            worst = max(kept, key=lambda j: abs(ratio[j]))
            if misfit <= chi2.isf(alarm, len(kept)) and abs(ratio[worst]) <= 1.0:
                break
            out = (*out, worst)
        return tuple(sorted(out))


@pytest.mark.parametrize("decoder", [least_squares, fewest])
@pytest.mark.parametrize("seed", range(4))
def test_the_answer_is_that_of_dense_algebra(decoder: Decoder, seed: int) -> None:
    """Sets, residuals, voltages and standard deviations, without inverters and with 0 to 2 lies."""
    rng = np.random.default_rng([21, seed])
    plant = make_plant(rng, customers=7, drop=0.04, inverters=np.zeros(0, dtype=np.intp))
    design, street = prepare(plant, decoder), Street(plant, rng)
    some = rng.choice(7, seed % 3, replace=False)
    lies = {int(j): float(rng.choice([-0.04, 0.04])) for j in some}
    state = single_tick.init(design, street.t)
    for _ in range(5):
        street.advance(1.0)
        frame = street.frame(lies)
        state, estimate, verdict = single_tick.step(design, state, frame)
        dense = Dense.of(design, plant, frame)
        sets = dense.smallest(2) if decoder is fewest else [dense.greedy(2)]
        rivals = [who(each.meters) for each in verdict.explanations]
        assert rivals == (sets if len(sets) > 1 else [])
        out = tuple(sorted(set().union(*sets)))
        w, variance, ratio, _ = dense.without(out)
        assert who(~estimate.trusted) == out
        np.testing.assert_allclose(estimate.v2, (dense.v2 + w)[1:], atol=1e-9)
        np.testing.assert_allclose(estimate.std, np.sqrt(variance[1:]), rtol=1e-6)
        np.testing.assert_allclose(verdict.score / verdict.threshold, np.abs(ratio), rtol=1e-6, atol=1e-9)
    assert who(verdict.suspects) == tuple(sorted(some.tolist()))


@ALL
def test_the_rate_of_alarms_is_shared_by_all_limits_and_the_test_of_chi_square(decoder: Decoder) -> None:
    plant = make_plant(np.random.default_rng(1))
    n = len(plant.feeder.customers)
    doubt = LoadDoubt(np.full(n, 1e-3), np.full(n, 1e-3), 600.0)
    for rate, step_s in ((1.0, 1.0), (12.0, 60.0)):
        made = single_tick.design(
            plant, decoder, doubt=doubt, step_s=step_s, max_attacked=2, alarms_per_year=rate
        )
        each = 2.0 * norm.sf(made.options.sigmas)
        assert 2 * 9 * each * YEAR_S / step_s == pytest.approx(rate)


# ------------------------------------------------------------------------------------------- honest readings


HONEST_TICKS, SETTLED = 500, 40


@cache
def honest(seed: int) -> tuple[Plant, tuple[tuple[Frame, Floats], ...]]:
    """Frames and true voltages of one street."""
    rng = np.random.default_rng([22, seed])
    plant = make_plant(rng, customers=10, drop=0.04)
    street, out = Street(plant, rng), []
    for _ in range(HONEST_TICKS):
        street.advance(1.0)
        out.append((street.frame(), street.truth()))
    return plant, tuple(out)


@pytest.mark.canary("0-least_squares", "1-fewest", "2-pursue", "3-match")
@ALL
@pytest.mark.parametrize("seed", range(4))
def test_two_thousand_honest_ticks_are_clean(decoder: Decoder, seed: int) -> None:
    """Once the observer has settled; each bound contains the truth."""
    plant, frames = honest(seed)
    design = prepare(plant, decoder)
    state = single_tick.init(design, frames[0][0].t - 1.0)
    for k, (frame, truth) in enumerate(frames):
        state, estimate, verdict = single_tick.step(design, state, frame)
        assert not verdict.suspects.any()
        assert verdict.decision is Decision.CLEAN or (k < SETTLED and verdict.cause is Cause.SETTLING)
        assert (np.abs(estimate.v2 - truth) <= estimate.bound).all()


# --------------------------------------------------------------------------------------------- confirmation


def settled(
    decoder: Decoder, seed: int, *, customers: int = 12, h: float = 1.0, most: int = 2
) -> tuple[Street, SingleTickDesign, single_tick.SingleTickState]:
    """A street after 40 honest ticks of h seconds."""
    rng = np.random.default_rng([23, seed])
    plant = make_plant(rng, customers=customers, drop=0.03)
    design, street = prepare(plant, decoder, step_s=h, most=most), Street(plant, rng)
    state, answers = watch(street, design, 40, h=h)
    assert answers[-1][1].decision is Decision.CLEAN
    return street, design, state


@ALL
class TestConfirmation:
    def test_an_accusation_with_a_rival_leaves_the_verdict_open_as_long(self, decoder: Decoder) -> None:
        street, design, state = settled(decoder, 0)

        def answers(_: DecoderInput) -> tuple[DecoderAnswer, ...]:
            return tuple(DecoderAnswer(np.arange(12) == k) for k in (3, 4))

        state, first = watch(street, replace(design, decoder=answers), 1, state=state)
        _, later = watch(street, design, 8, state=state)
        release = design.options.release
        decisions = [verdict.decision for _, verdict in first + later]
        assert decisions == [Decision.UNDECIDED] * release + [Decision.CLEAN] * (9 - release)

    def test_one_false_reading_names_no_meter_and_leaves_the_verdict_open(self, decoder: Decoder) -> None:
        street, design, state = settled(decoder, 0)
        state, answers = watch(street, design, 1, state=state, lies={3: 0.05})
        state, later = watch(street, design, 8, state=state)
        decisions = [verdict.decision for _, verdict in answers + later]
        assert decisions[: design.options.release] == [Decision.UNDECIDED] * design.options.release
        assert set(decisions[design.options.release :]) == {Decision.CLEAN}
        assert not any(verdict.suspects.any() for _, verdict in answers + later)
        assert not any(estimate.trusted[3] for estimate, _ in (answers + later)[: design.options.release])

    def test_every_second_false_reading_is_enough(self, decoder: Decoder) -> None:
        street, design, state = settled(decoder, 1)
        decisions = []
        for k in range(12):
            lies = {3: 0.05} if k % 2 == 0 else None
            state, ((_, verdict),) = watch(street, design, 1, state=state, lies=lies)
            decisions.append(verdict.decision)
            assert who(verdict.suspects) == ((3,) if k >= 2 else ())
        assert decisions == [Decision.UNDECIDED] * 2 + [Decision.ATTACKED] * 10

    def test_silence_clears_no_meter(self, decoder: Decoder) -> None:
        street, design, state = settled(decoder, 2)
        state, _ = watch(street, design, 3, state=state, lies={5: -0.05})
        state, answers = watch(street, design, 20, state=state, silent=(5,))
        assert all(who(verdict.suspects) == (5,) for _, verdict in answers)
        assert all(verdict.decision is Decision.ATTACKED for _, verdict in answers)
        _, answers = watch(street, design, design.options.release + 1, state=state)
        assert answers[-1][1].decision is Decision.CLEAN

    def test_a_restart_names_the_meter_again(self, decoder: Decoder) -> None:
        street, design, state = settled(decoder, 3)
        state, _ = watch(street, design, 4, state=state, lies={7: 0.05})
        _, answers = watch(street, design, 40, lies={7: 0.05})
        assert Decision.CLEAN not in {verdict.decision for _, verdict in answers}
        assert (answers[-1][1].decision, who(answers[-1][1].suspects)) == (Decision.ATTACKED, (7,))

    @pytest.mark.canary("0-match", "0-least_squares", "2-fewest", "1-pursue")
    @pytest.mark.parametrize("seed", range(3))
    def test_a_false_reading_does_not_move_the_model_of_long_ticks(self, decoder: Decoder, seed: int) -> None:
        """A quarter of an hour between readings: the inverter of the false meter would follow it at once."""
        street, design, state = settled(decoder, seed, h=900.0)
        liar = int(np.random.default_rng(seed).integers(12))
        _, answers = watch(street, design, 6, h=900.0, state=state, lies={liar: 0.05})
        for k, (estimate, verdict) in enumerate(answers):
            assert who(verdict.suspects) == ((liar,) if k > 0 else ())
            assert who(~estimate.trusted) == (liar,)
        estimate = answers[-1][0]
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()


@ALL
def test_meters_without_any_error_are_used_as_such(decoder: Decoder) -> None:
    """Without fixed error, jitter and rounding the errors of the model alone are in the limits."""
    rng = np.random.default_rng(26)
    plant = make_plant(rng, customers=8, drop=0.04)
    none = np.zeros(8)
    exact = replace(plant.accuracy, class_fraction=none, resolution=none, jitter=none)
    street = Street(plant, rng)
    design = prepare(replace(plant, accuracy=exact), decoder)

    def read(factor: Floats) -> Callable[[Frame], Frame]:
        return lambda frame: replace(frame, y=street.truth() * factor, v0_squared=street.v0**2)

    state, answers = watch(street, design, 40, change=read(np.ones(8)))
    assert answers[-1][1].decision is Decision.CLEAN
    lie = np.where(np.arange(8) == 5, 1.1, 1.0)
    _, answers = watch(street, design, 4, state=state, change=read(lie))
    # Basis pursuit weighs an attack by the deviation of the meter: false loads cost less than a false meter.
    found = (Decision.UNDECIDED, ()) if decoder is pursue else (Decision.ATTACKED, (5,))
    assert (answers[-1][1].decision, who(answers[-1][1].suspects)) == found
    assert (np.abs(answers[-1][0].v2 - street.truth()) <= answers[-1][0].bound).all()


# ------------------------------------------------------------------------------------------------ undecided


def twins() -> tuple[Plant, LoadDoubt]:
    """Eight customers; the last two share a long branch with loads that are hardly known."""
    count, long, short = 8, 0.3, 1e-3
    feeder = Feeder(
        name="twins",
        parent=np.array([0, 0, 0, 0, 0, 0, 0, 7]),
        r=np.array([*[0.02] * 6, long, short]),
        x=np.array([*[0.01] * 6, 0.4 * long, short]),
        bus=np.arange(1, count + 1),
        customers=tuple(f"c{i}" for i in range(count)),
        buses=tuple(f"b{i}" for i in range(count + 1)),
        base_volt=BASE_VOLT,
        base_kva=BASE_KVA,
        charging=np.zeros(count),
    )
    plant = replace(
        make_plant(np.random.default_rng(1), customers=count, inverters=np.zeros(0, dtype=np.intp)),
        feeder=feeder,
        accuracy=accuracy(count),
    )
    p = np.array([*[1e-3] * 6, 0.1, 0.1])
    return plant, LoadDoubt(p, 0.1 * p, 600.0)


def test_two_meters_that_only_contradict_each_other_are_explanations() -> None:
    plant, doubt = twins()
    design = single_tick.design(plant, fewest, doubt=doubt, step_s=1.0, max_attacked=2)
    street = Street(plant, np.random.default_rng(24), load_kw=0.5)
    state, answers = watch(street, design, 10)
    assert answers[-1][1].decision is Decision.CLEAN
    _, answers = watch(street, design, 20, state=state, lies={7: 0.05})
    for estimate, verdict in answers:
        assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.AMBIGUOUS)
        assert not verdict.suspects.any()
        assert sorted(who(each.meters) for each in verdict.explanations) == [(6,), (7,)]
        chances = [each.probability for each in verdict.explanations]
        assert chances == sorted(chances, reverse=True)
        assert sum(chances) == pytest.approx(1.0)
        # The estimate holds whichever of them is true.
        assert who(~estimate.trusted) == (6, 7)
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()


@ALL
class TestUndecided:
    def test_the_observer_has_not_settled_at_first(self, decoder: Decoder) -> None:
        rng = np.random.default_rng([25, 0])
        plant = make_plant(rng, customers=12, drop=0.04)
        _, answers = watch(Street(plant, rng), prepare(plant, decoder), 2)
        assert [verdict.cause for _, verdict in answers] == [Cause.SETTLING] * 2

    def test_a_frame_without_a_time_comes_first(self, decoder: Decoder) -> None:
        rng = np.random.default_rng([25, 1])
        plant = make_plant(rng)
        design, street = prepare(plant, decoder), Street(plant, rng)
        start = single_tick.init(design, street.t)
        state, estimate, verdict = single_tick.step(design, start, replace(street.frame(), t=np.nan))
        assert state is start
        assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.SETTLING)
        assert np.isfinite([estimate.v2, estimate.std, estimate.bound]).all()

    def test_no_reading_at_all(self, decoder: Decoder) -> None:
        street, design, state = settled(decoder, 4)
        state, answers = watch(street, design, 3, state=state, silent=tuple(range(12)))
        for estimate, verdict in answers:
            assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.TOO_FEW_METERS)
            assert not estimate.trusted.any()
            assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
        _, answers = watch(street, design, 12, state=state)
        assert answers[-1][1].decision is Decision.CLEAN

    @pytest.mark.canary("-0.01-least_squares", "0.01-fewest", "0.03-match", "-0.03-pursue")
    @pytest.mark.parametrize("part", [-0.03, -0.01, 0.01, 0.03])
    def test_a_false_busbar_reading_names_no_meter(self, decoder: Decoder, part: float) -> None:
        street, design, state = settled(decoder, 5)

        def false(frame: Frame) -> Frame:
            return replace(frame, v0_squared=frame.v0_squared * (1.0 + part) ** 2)

        _, answers = watch(street, design, 12, state=state, change=false)
        for _, verdict in answers:
            assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.AMBIGUOUS)
            assert not verdict.suspects.any()
            assert verdict.busbar.tolist() == [False]
        told = [verdict.explanations for _, verdict in answers if verdict.explanations]
        assert len(told) >= 8
        assert all(any(each.busbar.all() and not each.meters.any() for each in some) for some in told)
        estimate = answers[-1][0]
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
        # A silent meter is no evidence against it.
        _, answers = watch(street, design, 4, state=state, silent=(6,), change=false)
        assert not any(verdict.suspects.any() for _, verdict in answers)

    def test_a_clock_beyond_a_quarter_of_a_tick_is_silence(self, decoder: Decoder) -> None:
        street, design, state = settled(decoder, 6)

        def ahead(offset_s: float) -> Callable[[Frame], Frame]:
            offsets = np.where(np.arange(12) == 3, offset_s, 0.0)
            return lambda frame: replace(frame, clock_offset=offsets)

        state, answers = watch(street, design, 4, state=state, change=ahead(0.2))
        assert {verdict.decision for _, verdict in answers} == {Decision.CLEAN}
        state, answers = watch(street, design, 4, state=state, change=ahead(0.5))
        assert {verdict.cause for _, verdict in answers} == {Cause.CLOCK_OFFSET}
        state, answers = watch(street, design, 2, state=state, silent=(8,), change=ahead(0.5))
        assert {verdict.cause for _, verdict in answers} == {Cause.SILENT_METERS}
        _, answers = watch(street, design, 4, state=state, change=ahead(0.0))
        assert answers[-1][1].decision is Decision.CLEAN

    def test_a_voltage_beside_an_unread_power_is_uncertain(self, decoder: Decoder) -> None:
        street, made, state = settled(decoder, 7)
        design = single_tick.design(
            street.plant,
            decoder,
            doubt=made.front.doubt,
            step_s=1.0,
            max_attacked=2,
            unread_std_percent=0.1,
        )
        origin = np.where(np.arange(12) == 4, PowerOrigin.UNREAD, PowerOrigin.READ).astype(np.intp)

        def unread(kw: float) -> Callable[[Frame], Frame]:
            error = kw / BASE_KVA * (origin == PowerOrigin.UNREAD)
            return lambda frame: replace(frame, p_origin=origin, p_error=np.maximum(frame.p_error, error))

        _, answers = watch(street, design, 4, state=state, change=unread(60.0))
        assert {verdict.cause for _, verdict in answers} == {Cause.MISSING_POWERS}
        _, known = watch(street, design, 4, state=state)
        assert known[-1][1].decision is Decision.CLEAN
        assert answers[-1][0].std[4] > 1.3 * known[-1][0].std[4]
        state, permitted = watch(street, made, 4, state=state, change=unread(60.0))
        assert permitted[-1][1].decision is Decision.CLEAN
        # A false reading beside it has no check, and is no ground for a name.
        _, answers = watch(street, design, 6, state=state, lies={4: 0.03}, change=unread(60.0))
        assert not any(verdict.decision is Decision.CLEAN for _, verdict in answers)
        assert not any(np.delete(verdict.suspects, 4).any() for _, verdict in answers)

    def test_a_missing_phase_of_the_busbar_needs_its_meters(self, decoder: Decoder) -> None:
        """Nine meters on three phases, of which two may be manipulated: three on a phase are too few."""
        plant = coupled(3, customers=9)
        street = PhasedStreet(plant, np.random.default_rng(8))
        doubt = LoadDoubt(np.full(9, 0.03 / BASE_KVA), np.full(9, 0.6 / BASE_KVA), 600.0)
        design = single_tick.design(plant, decoder, doubt=doubt, step_s=1.0, max_attacked=2)

        def answers(state: single_tick.SingleTickState, *, blind: bool) -> tuple[object, list[Verdict]]:
            out = []
            for _ in range(40):
                street.advance(1.0)
                frame = street.frame()
                if blind:
                    assert frame.v0_phases is not None
                    frame = replace(frame, v0_phases=np.where(np.arange(3) == 1, np.nan, frame.v0_phases))
                state, _, verdict = single_tick.step(design, state, frame)
                out.append(verdict)
            return state, out

        state, known = answers(single_tick.init(design, street.t), blind=False)
        assert known[-1].decision is Decision.CLEAN
        assert isinstance(state, single_tick.SingleTickState)
        _, missing = answers(state, blind=True)
        assert {verdict.cause for verdict in missing} == {Cause.TOO_FEW_METERS}


def test_readings_within_their_limits_may_be_a_misfit_together() -> None:
    """Offsets of 0.95 % in both directions at all meters: no limit is exceeded, and the sum of squares is."""
    street, design, state = settled(no_accusation, 8)
    lies = {j: 0.0095 * (-1.0) ** j for j in range(12)}
    _, answers = watch(street, design, 4, state=state, lies=lies)
    for estimate, verdict in answers:
        assert (verdict.score <= verdict.threshold).all()
        assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.MISFIT)
        # No reading bounds a voltage then.
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()


def test_a_name_beside_a_misfit_says_so() -> None:
    street, design, state = settled(no_accusation, 8)

    def second(_: DecoderInput) -> tuple[DecoderAnswer, ...]:
        return (DecoderAnswer(np.arange(12) == 2),)

    lies = {j: 0.01 * (-1.0) ** j for j in range(12)} | {2: 0.05}
    _, answers = watch(street, replace(design, decoder=second), 4, state=state, lies=lies)
    for _, verdict in answers[1:]:
        assert (verdict.decision, who(verdict.suspects)) == (Decision.ATTACKED, (2,))
        assert "The other meters, taken together, still disagree" in verdict.reason


def test_what_a_decoder_overlooks_is_not_clean() -> None:
    street, design, state = settled(no_accusation, 9)
    _, answers = watch(street, design, 6, state=state, lies={2: 0.05})
    assert {verdict.cause for _, verdict in answers} == {Cause.AMBIGUOUS}
    assert not any(verdict.suspects.any() for _, verdict in answers)


def test_no_solution_is_no_answer_and_keeps_the_names() -> None:
    street, design, state = settled(least_squares, 10)
    failing = replace(design, decoder=no_solution)
    _, answers = watch(street, failing, 3, state=state)
    assert {verdict.cause for _, verdict in answers} == {Cause.AMBIGUOUS}
    state, _ = watch(street, design, 3, state=state, lies={2: 0.05})
    _, answers = watch(street, failing, 20, state=state, lies={2: 0.05})
    assert all(who(verdict.suspects) == (2,) for _, verdict in answers)


def test_a_rival_neither_names_nor_clears() -> None:
    """A decoder that knows two answers: a name needs both, and lasts while one has it."""
    street, design, state = settled(least_squares, 11)

    def answer(*sets: tuple[int, ...]) -> SingleTickDesign:
        def several(_: DecoderInput) -> tuple[DecoderAnswer, ...]:
            return tuple(DecoderAnswer(np.isin(np.arange(12), out), float(k)) for k, out in enumerate(sets))

        return replace(design, decoder=several)

    def run(one: SingleTickDesign, ticks: int) -> list[tuple[Estimate, Verdict]]:
        nonlocal state
        state, answers = watch(street, one, ticks, state=state, lies={2: 0.05})
        return answers

    answers = run(answer((2,), (3,)), 10)
    assert {verdict.cause for _, verdict in answers} == {Cause.AMBIGUOUS}
    assert not any(verdict.suspects.any() for _, verdict in answers)
    answers = run(answer((2, 3), (2, 4)), 3)
    assert who(answers[-1][1].suspects) == (2,)
    answers = run(answer((2,), (3,)), 10)
    assert {verdict.decision for _, verdict in answers} == {Decision.ATTACKED}
    named: Bools = answers[-1][1].suspects
    assert who(named) == (2,)

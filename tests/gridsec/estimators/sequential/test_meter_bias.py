"""Commissioning meter by meter, against dense posteriors, integrals, and streets with replaced meters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import dblquad

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import InputInvalid
from gridsec.estimators import sequential
from gridsec.estimators.sequential import Commission, SequentialDesign, SequentialOptions
from gridsec.estimators.sequential.measurements import nominal_uncertainty as no_doubts
from gridsec.estimators.sequential.meter_bias import (
    Learned,
    Learning,
    _mean_covariance,
    class_only,
    from_arrays,
    gather,
    initial,
    learn,
    no_readings,
    ready_meters,
    renew,
    to_arrays,
)
from gridsec.estimators.sequential.posterior import LoadDoubt, condition, leave_one_out
from gridsec.estimators.sequential.time_scales import Scales, empty, scale_test
from gridsec.interface import Frame
from tests.codes import refused
from tests.gridsec.estimators.sequential.test_monitor import prepare, watch
from tests.gridsec.street import BASE_VOLT, JITTER, Street, make_plant

P = 6


def prepared(commission_s: float = 3600.0, seed: int = 3) -> SequentialDesign:
    plant = make_plant(np.random.default_rng(seed), customers=P)
    doubt = LoadDoubt(np.full(P, 0.006), np.full(P, 0.002), 600.0)
    options = SequentialOptions(commission_s=commission_s, stability=0.0)
    return sequential.design(plant, doubt=doubt, step_s=1.0, options=options)


def one(k: int) -> Bools:
    which = np.zeros(P, dtype=np.bool_)
    which[k] = True
    return which


def summed(total: Floats, count: Ints, time_s: Floats, since: Floats) -> Learning:
    """Sums over ticks that all counted."""
    start = no_readings(np.ones(P, dtype=np.bool_), 0.0)
    return replace(start, total=total, count=count, time_s=time_s, since=since, watched_s=time_s)


def learned(design: SequentialDesign, rng: np.random.Generator) -> Commission:
    every = np.ones(P, dtype=np.bool_)
    count = np.full(P, 3600)
    gathered = summed(rng.normal(size=P) * 0.002 * count, count, np.full(P, 3600.0), np.zeros(P))
    known = learn(design, class_only(design), gathered, every, 3600.0)
    assert known.learning is None
    return known


@given(short=st.floats(0.05, 20.0), longer=st.floats(1.0, 5.0))
def test_means_that_end_together_covary_as_the_double_integral_says(short: float, longer: float) -> None:
    long = short * longer
    exact = dblquad(lambda s, u: np.exp(-abs(s - u)), 0.0, short, 0.0, lambda u: u)[0]
    exact += dblquad(lambda s, u: np.exp(-abs(s - u)), 0.0, short, lambda u: u, long)[0]
    times = np.array([short, long])
    found = _mean_covariance(times, times)
    assert found[0, 1] == found[1, 0] == pytest.approx(exact / (short * long), rel=1e-6)
    assert np.linalg.eigvalsh(found).min() > -1e-12


def test_a_replaced_meter_is_learned_by_what_the_others_say_of_the_loads() -> None:
    """Against the dense posterior with the others' errors known to within what was learned."""
    design, rng = prepared(), np.random.default_rng(5)
    before = learned(design, rng)
    known = renew(design, before, one(2), 5000.0)
    assert known.learning is not None
    assert known.learning.open.tolist() == one(2).tolist()
    assert (known.learned.bias[2], known.learned.variance[2]) == (0.0, design.fixed[2])
    use, mean = np.ones(P, dtype=np.bool_), rng.normal(size=P) * 1e-3
    learning = known.learning
    for _ in range(40):
        learning = gather(learning, mean, use, 100.0)
    assert ready_meters(design, learning).tolist() == one(2).tolist()
    after = learn(design, known.learned, learning, ready_meters(design, learning), 9000.0)
    assert after.learning is None
    B = np.diag(known.learned.variance)
    rho = 600.0 / 4000.0
    share = 2 * rho * (1 - rho * (1 - np.exp(-1 / rho)))
    S, fixed = design.prior.between, design.busbar**2
    gain = B @ np.linalg.inv(share * S + (1.0 - share) * fixed + B + np.diag(design.white / 40))
    assert after.learned.bias[2] == pytest.approx((gain @ mean)[2], rel=1e-9)
    assert after.learned.variance[2] == pytest.approx((B - gain @ B)[2, 2], rel=1e-6)
    others = ~one(2)
    for name in ("bias", "variance", "allowed", "at", "hidden"):
        found, was = getattr(after.learned, name), getattr(before.learned, name)
        np.testing.assert_array_equal(found[others], was[others])
    assert after.learned.at[2] == 9000.0


@pytest.mark.parametrize("lasting", [0.0, 0.4, 1.0])
def test_what_is_left_of_lasting_errors_is_in_the_standard_deviation(lasting: float) -> None:
    """A Gaussian feeder: loads' errors of which a part lasts, a busbar meter with a fixed error, own errors.

    The posterior is dense and exact; its claims are held against draws.
    """
    design, rng, every, draws = prepared(), np.random.default_rng(17), np.ones(P, dtype=np.bool_), 4000
    design = replace(design, doubt=replace(design.doubt, lasting=lasting))
    S, count = design.prior.between, 3600
    L = lasting * S + (1.0 - lasting) * design.busbar**2
    share = float(_mean_covariance(np.array([6.0]), np.array([6.0]))[0, 0])
    noise = share * (S - L) + np.diag(design.white / count)
    inverse = np.linalg.inv(L + noise + np.diag(design.fixed))
    root, rest = np.linalg.cholesky(L + 1e-15 * np.eye(P)), np.linalg.cholesky(noise)
    errors = []
    for _ in range(draws):
        own, lasts = np.sqrt(design.fixed) * rng.normal(size=P), root @ rng.normal(size=P)
        errors.append(lasts - L @ inverse @ (own + lasts + rest @ rng.normal(size=P)))
    gathered = summed(np.zeros(P), np.full(P, count), np.full(P, 3600.0), np.zeros(P))
    found = learn(design, class_only(design), gathered, every, 3600.0).learned
    np.testing.assert_allclose(found.hidden, np.diag(L - L @ inverse @ L), rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(found.hidden, np.var(errors, axis=0), rtol=0.1, atol=1e-14)
    assert (class_only(design).hidden == 0.0).all()


def lasting_errors() -> tuple[SequentialDesign, Learned, Floats]:
    """A feeder where meter 2 was not heard while the others were learned, all errors of loads lasting.

    With what was learned from means of zero, and the map from lasting errors (P), own ones (P) and noise (P)
    to the residuals of all meters afterwards, all in standard deviations: biases are linear in the means.
    """
    plant = make_plant(np.random.default_rng(3), customers=P, inverters=np.zeros(0, dtype=np.intp))
    doubt = LoadDoubt(np.full(P, 0.006), np.full(P, 0.002), 600.0, lasting=1.0)
    options = SequentialOptions(commission_s=3600.0, scales_s=(0.0, 60.0))
    design = sequential.design(plant, doubt=doubt, step_s=1.0, options=options)
    others, count = np.flatnonzero(~one(2)), np.where(one(2), 0, 3600)
    gathered = summed(np.zeros(P), count, count.astype(np.float64), np.zeros(P))
    known = learn(design, class_only(design), gathered, ~one(2), 3600.0).learned
    S, B = design.prior.between, np.diag(design.fixed)
    means = np.hstack([np.linalg.cholesky(S), np.sqrt(B), np.zeros((P, P))])
    part, bias = np.ix_(others, others), np.zeros_like(means)
    bias[others] = B[part] @ np.linalg.solve((S + B + np.diag(design.white / 3600))[part], means[others])
    residuals = means - bias
    residuals[:, 2 * P :] = np.diag(np.sqrt(design.white))
    return design, known, residuals


def test_a_meter_not_learned_among_learned_ones_is_known_as_well_as_is_said() -> None:
    """What the monitor says of a voltage whose meter is silent, against draws of all errors."""
    design, known, residuals = lasting_errors()
    rng, none, root = np.random.default_rng(8), np.zeros(P), np.linalg.cholesky(design.prior.between)
    seen, state = ~one(2), sequential.init(design, 0.0, known, None)
    off = []
    for _ in range(300):
        drawn = rng.normal(size=3 * P)
        y = np.where(seen, 1.0 + residuals @ drawn, np.nan)
        frame = Frame(1.0, y, seen, 1.0, none, none, none, none, np.full(P, np.nan), none)
        estimate = sequential.step(design, state, frame)[1]
        off.append((estimate.v2 - 1.0 - root @ drawn[:P]) / estimate.std)
    size = np.sqrt(np.mean(np.square(off), axis=0))
    assert (size < 1.1).all()


def test_an_honest_meter_not_learned_is_within_its_limit_as_seldom_as_is_said() -> None:
    """Judged by learned ones, whose remaining errors are not independent: against the dense covariance."""
    design, known, residuals = lasting_errors()
    window = empty(design.lengths, P)
    scale = Scales(design, no_doubts(design), window, known, np.zeros(P))[-1]
    all_meters = condition(scale.prior, scale.noise, np.ones(P, dtype=np.bool_))
    view = scale_test(design, scale, leave_one_out(all_meters, scale.m))
    Q = np.linalg.inv(scale.prior.between + np.diag(scale.noise))
    offset = Q[2] @ np.hstack([residuals[:, : 2 * P], np.diag(np.sqrt(design.white / 60))]) / Q[2, 2]
    own = np.arange(3 * P) == P + 2
    chance, rest = (design.sigmas[-1] * np.linalg.norm(part) for part in (offset, offset[~own]))
    assert view.limit[2] >= min(chance, known.allowed[2] + rest)


def test_where_nobody_or_everybody_is_learned_limits_are_as_they_were() -> None:
    design, rng = prepared(), np.random.default_rng(5)
    assert class_only(design).late is None
    assert learned(design, rng).learned.late is None
    late = renew(design, learned(design, rng), one(2), 9.0).learned.late
    assert late is not None
    assert (late > 0.0).tolist() == one(2).tolist()


def test_honest_meters_with_coarse_registers_are_not_suspected_once_learned() -> None:
    """Of 2 V: while voltages stand still rounding is off by about the same all the time, up or down."""
    plant = make_plant(np.random.default_rng(3), customers=P, inverters=np.zeros(0, dtype=np.intp))
    plant = replace(plant, accuracy=replace(plant.accuracy, resolution=np.full(P, 2.0 / BASE_VOLT)))
    options = SequentialOptions(commission_s=3600.0)
    doubt = LoadDoubt(np.full(P, 1e-4), np.full(P, 1e-4), 600.0)
    design = sequential.design(plant, doubt=doubt, step_s=1.0, options=options)
    every, none, rng = np.ones(P, dtype=np.bool_), np.zeros(P), np.random.default_rng(6)
    gathered = summed(none, np.full(P, 3600), np.full(P, 3600.0), none)
    known = learn(design, class_only(design), gathered, every, 0.0).learned
    state = sequential.init(design, 0.0, known, None)
    # The truth is 230 V everywhere, and by their own errors one meter is rounded up and the others are down.
    off = np.where(one(4), 0.8, -0.8) / BASE_VOLT
    for t in range(1, 65):
        shown = 1.0 + off + JITTER * rng.normal(size=P)
        frame = Frame(float(t), shown**2, every, 1.0, none, none, none, none, np.full(P, np.nan), none)
        state, _, verdict = sequential.step(design, state, frame)
        assert not verdict.suspects.any()
        assert state.trust.trusted.all()


def test_a_silent_meter_is_waited_for_and_holds_up_nobody() -> None:
    design = prepared()
    use = ~one(4)
    learning = no_readings(np.ones(P, dtype=np.bool_), 0.0)
    for _ in range(35):
        learning = gather(learning, np.full(P, 1e-4), use, 100.0)
    assert not ready_meters(design, learning).any()
    learning = gather(learning, np.full(P, 1e-4), use, 100.0)
    assert ready_meters(design, learning).tolist() == use.tolist()
    first = learn(design, class_only(design), learning, ready_meters(design, learning), 3600.0)
    assert first.learning is not None
    assert first.learning.open.tolist() == one(4).tolist()
    assert np.isnan(first.learned.at[4])
    assert first.learned.variance[4] == design.fixed[4]


def test_nothing_beyond_the_class_is_learned() -> None:
    """Whoever lies by more than the class all the while is no honest meter with that error."""
    design = prepared()
    every, count = np.ones(P, dtype=np.bool_), np.full(P, 10**6)
    gathered = summed(one(1) * 1.0 * count, count, np.full(P, 1e7), np.zeros(P))
    known = learn(design, class_only(design), gathered, every, 1e7)
    assert known.learned.bias[1] == design.allowed[1]
    assert (np.abs(known.learned.bias) <= design.allowed).all()


def test_two_replaced_at_different_times_keep_their_own_time() -> None:
    design = prepared()
    use = np.ones(P, dtype=np.bool_)
    known = renew(design, learned(design, np.random.default_rng(6)), one(0), 4000.0)
    assert known.learning is not None
    half = gather(known.learning, np.zeros(P), use, 1800.0)
    both = renew(design, Commission(known.learned, half), one(3), 5800.0)
    assert both.learning is not None
    np.testing.assert_array_equal(both.learning.time_s[[0, 1, 3]], [1800.0, 1800.0, 0.0])
    np.testing.assert_array_equal(both.learning.since[[0, 1, 3]], [4000.0, np.nan, 5800.0])
    later = gather(both.learning, np.zeros(P), use, 1800.0)
    assert ready_meters(design, later).tolist() == one(0).tolist()


def test_where_nothing_is_learned_nothing_is_begun_anew() -> None:
    design = prepared(0.0)
    known = initial(design, 0.0)
    assert known.learning is None
    assert renew(design, known, one(1), 1.0) is known


class TestArrays:
    def test_there_and_back(self) -> None:
        design = prepared()
        for known in (
            initial(design, 7.0),
            learned(design, np.random.default_rng(1)),
            renew(design, learned(design, np.random.default_rng(2)), one(1), 9.0),
        ):
            found = from_arrays(design, to_arrays(known))
            assert (found.learning is None) == (known.learning is None)
            for name, value in to_arrays(known).items():
                np.testing.assert_array_equal(to_arrays(found)[name], value)

    @pytest.mark.parametrize(
        ("name", "value", "codes"),
        [
            ("bias", np.inf, ("out-of-range",)),
            ("bias", 0.5, ("out-of-range",)),
            ("variance", np.nan, ("out-of-range",)),
            ("variance", -1.0, ("out-of-range",)),
            ("allowed", 1.0, ("out-of-range",)),
            ("hidden", np.nan, ("negative",)),
            ("hidden", -1.0, ("negative",)),
            ("at", np.inf, ("not-finite", "inconsistent")),
            ("since", 5.0, ("inconsistent",)),
            ("total", np.nan, ("not-finite",)),
            ("count", 1.5, ("not-integer",)),
            ("time_s", -1.0, ("negative",)),
        ],
    )
    def test_what_cannot_be_is_refused(self, name: str, value: float, codes: tuple[str, ...]) -> None:
        design = prepared()
        arrays = to_arrays(learned(design, np.random.default_rng(1)))
        arrays[name] = np.where(one(3), value, arrays[name])
        with refused(InputInvalid, *codes) as caught:
            from_arrays(design, arrays)
        assert all(problem.endswith("(meters 3)") for problem in caught.value.problems)

    def test_all_problems_at_once(self) -> None:
        design = prepared()
        arrays = to_arrays(initial(design, 0.0))
        del arrays["bias"]
        arrays |= {"more": np.zeros(P), "count": np.zeros(P + 1)}
        with refused(InputInvalid, "missing", "unknown-name", "shape"):
            from_arrays(design, arrays)


@pytest.mark.no_cover  # long runs of what other tests cover
class TestStreets:
    def test_a_restart_in_the_middle_goes_on(self) -> None:
        rng = np.random.default_rng(12)
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant, commission_s=3000.0), Street(plant, rng)
        state, _ = watch(street, design, 200, h=10.0)
        known = from_arrays(design, to_arrays(state.commission))
        assert known.learning is not None
        street.advance(5000.0)  # the time without a service counts for nothing
        again = sequential.init(design, street.t, known.learned, known.learning)
        again, _ = watch(street, design, 102, h=10.0, state=again)
        assert again.learning is None
        assert (np.isfinite(again.learned.at)).all()

    @pytest.mark.acceptance
    def test_a_replaced_meter_is_named_until_it_is_learned_anew(self) -> None:
        """The new meter is within its class, but not where the old one was."""
        rng = np.random.default_rng(12)
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant, commission_s=3000.0), Street(plant, rng)
        state, _ = watch(street, design, 320, h=10.0)
        assert state.learning is None
        old = state.learned.bias[4]
        change = 0.006 if old < 0 else -0.006
        other = {4: change}
        state, answers = watch(street, design, 90, state=state, lies=other)
        assert list(np.flatnonzero(answers[-1][1].suspects)) == [4]
        which = np.arange(design.plant.meters.size) == 4
        state = sequential.renew(design, state, which)
        state, answers = watch(street, design, 320, h=10.0, state=state, lies=other)
        assert not any(verdict.suspects.any() for _, verdict in answers[20:])
        assert state.learning is None
        found = state.learned.bias[4] - old
        assert found == pytest.approx(2.0 * change, abs=3.0 * np.sqrt(2.0 * state.learned.variance[4]))
        # The others were not touched, and the new meter is watched as closely as the old one was.
        _, answers = watch(street, design, 90, state=state, lies={4: change + np.copysign(0.006, -change)})
        assert list(np.flatnonzero(answers[-1][1].suspects)) == [4]

    def test_nothing_of_a_replaced_meter_counts_any_more(self) -> None:
        """A meter lied and was named; the new one is trusted at once, and nobody else changes."""
        rng = np.random.default_rng(4)
        plant = make_plant(rng, customers=8, drop=0.03)
        design, street = prepare(plant, commission_s=3000.0), Street(plant, rng)
        state, answers = watch(street, design, 40, lies={2: 0.05})
        assert list(np.flatnonzero(answers[-1][1].suspects)) == [2]
        which = np.arange(8) == 2
        after = sequential.renew(design, state, which)
        assert after.trust.trusted.all()
        assert not after.trust.named.any()
        assert (after.window.counts[:, 2] == 0).all()
        np.testing.assert_array_equal(after.window.sums[:, ~which], state.window.sums[:, ~which])
        for name in ("count", "run", "longest", "lag"):
            now, was = getattr(after.attack_kinds.history, name), getattr(state.attack_kinds.history, name)
            assert now[2] == 0
            np.testing.assert_array_equal(now[~which], was[~which])
        _, answers = watch(street, design, 60, state=after)
        assert not any(verdict.suspects.any() for _, verdict in answers)
        # Who goes on lying is named again.
        _, answers = watch(street, design, 60, state=after, lies={2: 0.05})
        assert list(np.flatnonzero(answers[-1][1].suspects)) == [2]

    def test_a_pause_of_the_frames_is_not_heard(self) -> None:
        rng = np.random.default_rng(1)
        plant = make_plant(rng, customers=6, drop=0.03)
        design, street = prepare(plant, commission_s=3000.0), Street(plant, rng)
        state, _ = watch(street, design, 10)
        state, _ = watch(street, design, 1, h=50_000.0, state=state)
        assert state.learning is not None
        assert state.learning.time_s.max() == pytest.approx(10.0)

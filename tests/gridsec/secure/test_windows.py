"""Algorithms 1 and 2 of yang2019: against loops, Propositions 1 to 4 as properties, silence, feeders."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from feeders.model.site import load as load_site
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.interface import Decision
from gridsec.observers.lmi.discrete import discrete_contraction, discrete_options
from gridsec.observers.lmi.sampled import advance, drift_error, measure, sample
from gridsec.observers.lure import close_loop
from gridsec.papers import yang2019
from gridsec.papers import yang2019 as sampled_feeder
from gridsec.secure import windows
from gridsec.secure.windows import WindowDesign
from tests.codes import refused

SETS = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
SEEDS = st.integers(0, 2**32 - 1)


def example(**more: object) -> WindowDesign:
    """Example 1 with proven thresholds, started in the true state."""
    return windows.design(yang2019.bank(), 1, noise=1.0, length=50, **more)  # type: ignore[arg-type]


def five() -> WindowDesign:
    """Five sensors of one decaying state, two liars, observers that forget in one step."""
    return windows.design(yang2019.deadbeat_bank(), 2, noise=1.0, length=20)


def masks(design: WindowDesign) -> np.ndarray:
    return design.large


def within(rng: np.random.Generator, shape: tuple[int, ...], size: float) -> np.ndarray:
    """Signals whose Euclidean norm over the last axis is at most `size`, often equal to it."""
    raw = rng.standard_normal(shape)
    scale = size * np.minimum(1.0, rng.uniform(0.3, 2.0, (*shape[:-1], 1)))
    return raw / np.linalg.norm(raw, axis=-1, keepdims=True) * scale


class TestThresholds:
    def test_by_hand(self) -> None:
        """(10) and (19), set by set."""
        d = example(epsilon=0.01, start=1e-4)
        bank = {tuple(np.flatnonzero(one.trusted)): one for one in yang2019.bank()}
        level = {J: 0.01 + one.noise_gain for J, one in bank.items()}
        assert d.detect_above == pytest.approx(2.0 * max(level[J] for J in [(0, 1, 2, 3), *SETS]))
        for J, got in zip(SETS, d.isolate_above[::1], strict=True):
            index = [tuple(np.flatnonzero(m)) for m in masks(d)].index(J)
            expected = 2.0 * max(level[S] for S in [J, *combinations(J, 2)])
            assert d.isolate_above[index] == pytest.approx(expected)
            assert got > 0.0

    def test_settling_is_the_slowest_observer(self) -> None:
        d = example(epsilon=0.01, start=3.0)
        for one in yang2019.bank():
            assert one.growth * one.decay**d.settling * 3.0 <= 0.01 * (1.0 + 1e-12)
        assert example().settling == 0

    def test_everything_unknown_is_part_of_the_level(self) -> None:
        site = load_site("kerber-landnetz")
        lure = close_loop(site.feeder, site.droop, site.droop.customer[:3])
        plant = sample(lure, 1.0)
        bank = windows.bank(plant, 1, proof=discrete_contraction(plant, decays=0.8))
        quiet = windows.design(bank, 1, noise=1e-3, length=10)
        wide = windows.design(bank, 1, noise=1e-3, length=10, unknown=5e-3)
        more = 2.0 * 5e-3 * bank[0].unknown_gain
        assert wide.detect_above - quiet.detect_above == pytest.approx(more)

    def test_wrong_calls(self) -> None:
        bank, plant = yang2019.bank(), yang2019.system()
        want = discrete_options(plant, decays=0.9, noise=1.0)
        with refused(InputInvalid, "wrong-design"):
            windows.design(bank[:-1], 1, noise=1.0, length=50)
        with refused(InputInvalid, "wrong-design"):
            windows.design((*bank[:1], *bank[:0:-1]), 1, noise=1.0, length=50)
        with refused(InputInvalid, "out-of-range"):
            windows.design(bank, 1, noise=1.0, length=0)
        for wrong in (np.nan, -1.0, np.inf):
            gains = np.full(len(bank), wrong)
            with refused(
                InputInvalid, "negative", "negative", "negative", "negative", "negative", "out-of-range"
            ):
                windows.design(
                    bank, 1, noise=wrong, start=wrong, epsilon=wrong, unknown=wrong, gains=gains, length=0
                )
        with refused(InputInvalid, "shape"):
            windows.design(bank, 1, noise=1.0, length=5, gains=np.ones(2))
        endless = [replace(bank[0], unknown_gain=np.inf), *bank[1:]]
        with refused(InputInvalid, "not-finite"):
            windows.design(endless, 1, noise=1.0, length=5, unknown=0.1)
        with refused(NotObservable, "too-few-meters"):
            windows.bank(plant, 2, options=want)
        with refused(InputInvalid, "out-of-range"):
            windows.bank(plant, 0, options=want)
        with refused(InputInvalid, "inconsistent"):
            windows.bank(plant, 1)
        with refused(DesignInfeasible, "too-many"):
            windows.bank(plant, 1, options=want, most=5)


class TestMeasures:
    def test_against_definitions(self) -> None:
        """(8) and (17) read aloud, for several runs at once."""
        rng = np.random.default_rng(0)
        for d, p, q in ((example(), 4, 1), (five(), 5, 2)):
            o, n = d.observers.L.shape[:2]
            x = rng.standard_normal((3, o, n))
            number = {tuple(np.flatnonzero(m)): i for i, m in enumerate(d.observers.masks)}
            pi, pi_sets = windows.consistency(d, x)
            for run in range(3):
                large = list(combinations(range(p), p - q))
                gap = [np.linalg.norm(x[run, 0] - x[run, number[J]]) for J in large]
                assert pi[run] == pytest.approx(max(gap))
                for J, got in zip((tuple(np.flatnonzero(m)) for m in masks(d)), pi_sets[run], strict=True):
                    inside = [x[run, number[J]] - x[run, number[S]] for S in combinations(J, p - 2 * q)]
                    assert got == pytest.approx(max(np.linalg.norm(v) for v in inside))


def algorithm_2(
    pi_sets: np.ndarray, thresholds: np.ndarray, sets: np.ndarray, N: int
) -> list[set[int] | None]:
    """Algorithm 2 as printed, with dictionaries."""
    named: list[set[int] | None] = []
    p = sets.shape[1]
    for i in range(len(pi_sets) // N):
        votes: dict[frozenset[int], int] = {}
        for row in pi_sets[i * N : (i + 1) * N]:
            union: set[int] = set()
            for value, bound, mask in zip(row, thresholds, sets, strict=True):
                if value <= bound:
                    union |= set(np.flatnonzero(mask).tolist())
            if union:
                votes[frozenset(union)] = votes.get(frozenset(union), 0) + 1
        if not votes:
            named.append(None)
            continue
        # Dictionaries keep the order of insertion, so max takes the set that was seen first.
        named.append(set(range(p)) - max(votes, key=lambda kind: votes[kind]))
    return named


class TestRules:
    @given(seed=SEEDS, N=st.integers(1, 9), T=st.integers(0, 40))
    def test_detection_against_a_loop(self, seed: int, N: int, T: int) -> None:
        pi = np.random.default_rng(seed).uniform(0.0, 1.2, T)
        expected = [any(v > 1.0 for v in pi[i * N : (i + 1) * N]) for i in range(T // N)]
        assert windows.detection(pi, 1.0, N).tolist() == expected

    @given(seed=SEEDS, N=st.integers(1, 9), T=st.integers(0, 40), hard=st.floats(0.2, 3.0))
    def test_isolation_against_a_loop(self, seed: int, N: int, T: int, hard: float) -> None:
        rng = np.random.default_rng(seed)
        sets = masks(example())
        thresholds = rng.uniform(0.5, 1.0, 4)
        pi_sets = rng.uniform(0.0, hard, (T, 4))
        found = windows.isolation(pi_sets, thresholds, sets, N, "majority")
        for i, named in enumerate(algorithm_2(pi_sets, thresholds, sets, N)):
            assert found.decided[i] == (named is not None)
            assert set(np.flatnonzero(found.suspects[i]).tolist()) == (named or set())
        survivors = windows.isolation(pi_sets, thresholds, sets, N, "survivors")
        for i in range(T // N):
            window = pi_sets[i * N : (i + 1) * N]
            alive = [
                mask for mask, column in zip(sets, (window <= thresholds).all(axis=0), strict=True) if column
            ]
            assert survivors.decided[i] == bool(alive)
            expected = ~np.any(alive, axis=0) if alive else np.zeros(4, dtype=bool)
            assert np.array_equal(survivors.suspects[i], expected)
            assert survivors.share[i] == len(alive) / 4

    def test_many_runs_at_once(self) -> None:
        rng = np.random.default_rng(1)
        pi_sets, sets, at = rng.uniform(0.0, 1.5, (3, 40, 4)), masks(example()), np.full(4, 0.7)
        for rule in ("majority", "survivors"):
            many = windows.isolation(pi_sets, at, sets, 10, rule)
            for run in range(3):
                one = windows.isolation(pi_sets[run], at, sets, 10, rule)
                assert np.array_equal(many.suspects[run], one.suspects)
                assert np.array_equal(many.share[run], one.share)

    def test_a_window_in_which_nothing_passes_is_undecided(self) -> None:
        found = windows.isolation(np.full((10, 4), 2.0), np.ones(4), masks(example()), 5, "majority")
        assert not found.decided.any()
        assert not found.suspects.any()

    def test_what_could_not_be_judged_is_no_evidence(self) -> None:
        """NaN neither votes nor fails; a window of nothing else is undecided."""
        sets, at = masks(example()), np.ones(4)
        unknown = np.full((6, 4), np.nan)
        for rule in ("majority", "survivors"):
            assert not windows.isolation(unknown, at, sets, 6, rule).decided.any()
        some = np.zeros((6, 4))
        some[:3] = np.nan
        some[3:, 1:] = 2.0
        only = sets[0]
        for rule in ("majority", "survivors"):
            found = windows.isolation(some, at, sets, 6, rule)
            assert found.decided.all()
            assert np.array_equal(found.suspects[0], ~only)
        part = np.zeros((6, 4))
        part[:, 2] = np.nan
        assert not windows.isolation(part, at, sets, 6, "survivors").decided.any()


@pytest.mark.no_cover  # long runs of what other tests cover
class TestPropositions:
    """Example 1 with proven gains. e(0) = 0, hence epsilon = 0 and k* = 0, as in the paper."""

    @pytest.mark.acceptance
    @settings(max_examples=25, deadline=None)
    @given(seed=SEEDS, tau=st.floats(0.05, 1.0), liars=st.sampled_from([1, 2]))
    def test_1_and_3_small_attacks_stay_unseen(self, seed: int, tau: float, liars: int) -> None:
        """|a| <= (1 - tau) m with |n| <= tau m: neither detected nor isolated, by either rule."""
        rng = np.random.default_rng(seed)
        d, u = (example(), np.zeros((150, 1))) if liars == 1 else (five(), np.zeros((60, 1)))
        p = d.sets.meters
        a = np.zeros((len(u), p))
        who = rng.choice(p, size=liars, replace=False)
        a[:, who] = within(rng, (len(u), liars), 1.0 - tau)
        if rng.random() < 0.5:
            a[:] = a[0]
        trace = windows.simulate(
            d, rng.standard_normal(d.observers.L.shape[1]), u, within(rng, (len(u), p), tau) + a
        )
        assert np.all(trace.pi <= d.detect_above * (1.0 + 1e-12))
        assert np.all(trace.pi_sets <= d.isolate_above * (1.0 + 1e-12))
        for rule in ("majority", "survivors"):
            found = windows.isolation(
                trace.pi_sets, d.isolate_above * (1.0 + 1e-12), masks(d), d.length, rule
            )
            assert found.decided.all()
            assert not found.suspects.any()

    @pytest.mark.acceptance
    @settings(max_examples=25, deadline=None)
    @given(seed=SEEDS, size=st.floats(1.0, 1e4), liars=st.sampled_from([1, 2]))
    def test_2_large_errors_are_detected(self, seed: int, size: float, liars: int) -> None:
        rng = np.random.default_rng(seed)
        d, T = (example(), 100) if liars == 1 else (five(), 60)
        p = d.sets.meters
        a = np.zeros((T, p))
        a[:, rng.choice(p, size=liars, replace=False)] = size * rng.uniform(-1.0, 1.0, (T, liars))
        trace = windows.simulate(
            d, rng.standard_normal(d.observers.L.shape[1]), np.zeros((T, 1)), within(rng, (T, p), 1.0) + a
        )
        large = trace.error[:, 0] > 1.5 * d.detect_above
        assume(large.any())
        assert np.all(trace.pi[large] > d.detect_above)
        found = windows.detection(trace.pi, d.detect_above, d.length)
        in_window = large[: found.size * d.length].reshape(found.size, -1).any(axis=1)
        assert np.all(found[in_window])

    @pytest.mark.acceptance
    @settings(max_examples=25, deadline=None)
    @given(
        seed=SEEDS,
        size=st.floats(0.1, 1e4),
        liars=st.sampled_from([1, 2]),
        shape=st.sampled_from(["random", "turns"]),
    )
    def test_4_corrected_and_the_soundness_of_both_rules(
        self, seed: int, size: float, liars: int, shape: str
    ) -> None:
        rng = np.random.default_rng(seed)
        d, T = (example(), 100) if liars == 1 else (five(), 60)
        p, s = d.sets.meters, d.sets.count_large
        who = rng.choice(p, size=rng.integers(1, liars + 1), replace=False)
        a = np.zeros((T, p))
        a[:, who] = size * rng.uniform(-1.0, 1.0, (T, len(who)))
        if shape == "turns" and len(who) == 2:
            a[::2, who[0]] = a[1::2, who[1]] = 0.0
        trace = windows.simulate(
            d, rng.standard_normal(d.observers.L.shape[1]), np.zeros((T, 1)), within(rng, (T, p), 1.0) + a
        )
        truth = np.isin(np.arange(p), who)
        touched = (masks(d) & truth).any(axis=1)
        count = T // d.length
        # (23) with the thresholds' own 2 (eps + gamma' m), for the attacked sets.
        exceeds = trace.error[:, 1 : 1 + s] > 1.5 * d.isolate_above
        assert np.all(
            trace.pi_sets[:, touched][exceeds[:, touched]]
            > np.broadcast_to(d.isolate_above[touched], (T, touched.sum()))[exceeds[:, touched]]
        )
        # Honest sets never fail: whoever is left out at any step is a liar.
        assert np.all(trace.pi_sets[:, ~touched] <= d.isolate_above[~touched] * (1.0 + 1e-12))
        exceeds = exceeds[: count * d.length, touched].reshape(count, d.length, -1)
        together = exceeds.all(axis=-1).sum(axis=-1) > d.length / 2
        ever = exceeds.any(axis=1).all(axis=-1)
        for rule, enough in (("majority", together), ("survivors", ever)):
            found = windows.isolation(
                trace.pi_sets, d.isolate_above * (1.0 + 1e-12), masks(d), d.length, rule
            )
            assert found.decided.all()
            assert not found.suspects[:, ~truth].any()
            assert np.all(found.suspects[enough] == truth)

    def test_4_as_printed_is_wrong(self) -> None:
        """Erratum: every attacked set fulfils (23) in half of the window; Algorithm 2 misses a liar."""
        d, trace = yang2019.alternating_attack()
        truth = np.array([True, True, False, False, False])
        touched = (masks(d) & truth).any(axis=1)
        error, pi_sets = trace.error[1:, 1 : 1 + d.sets.count_large], trace.pi_sets[1:]
        assert len(error) == d.length
        exceeds = error[:, touched] > 1.5 * d.isolate_above[touched]
        assert np.all(exceeds.sum(axis=0) >= d.length / 2)
        assert not exceeds.all(axis=1).any()
        found = windows.isolation(pi_sets, d.isolate_above, masks(d), d.length, "majority")
        assert found.suspects[0].tolist() == [True, False, False, False, False]
        assert found.share[0] == 0.5
        repaired = windows.isolation(pi_sets, d.isolate_above, masks(d), d.length, "survivors")
        assert np.array_equal(repaired.suspects[0], truth)

    def test_half_of_the_steps_is_a_tie(self) -> None:
        """Erratum: at exactly N / 2 steps, even the same ones for all sets, the vote may be lost."""
        sets = masks(example())
        hit = 2.0 * sets[:, 2]
        pi_sets = np.vstack([np.zeros((5, 4)), np.tile(hit, (5, 1))])
        found = windows.isolation(pi_sets, np.ones(4), sets, 10, "majority")
        assert not found.suspects.any()
        one_more = windows.isolation(np.vstack([pi_sets[1:], hit]), np.ones(4), sets, 10, "majority")
        assert np.flatnonzero(one_more.suspects[0]).tolist() == [2]

    def test_remark_2_is_wrong(self) -> None:
        """Erratum: with independent steps of which 40 % isolate, longer windows isolate less and less."""
        rng, sets = np.random.default_rng(3), masks(example())
        hit = rng.random((200, 1000, 1)) < 0.4
        pi_sets = np.where(hit & sets[:, 2], 2.0, 0.0)
        exact = np.arange(4) == 2
        rate = {}
        for rule in ("majority", "survivors"):
            found = [windows.isolation(pi_sets, np.ones(4), sets, N, rule).suspects for N in (1, 11, 51, 201)]
            rate[rule] = [float((s == exact).all(axis=-1).mean()) for s in found]
        assert rate["majority"][0] == pytest.approx(0.4, abs=0.01)
        assert np.all(np.diff(rate["majority"]) < 0.0)
        assert rate["majority"][-1] < 0.01
        assert np.all(np.diff(rate["survivors"]) >= 0.0)
        assert rate["survivors"][-1] == 1.0


class TestOnline:
    @pytest.mark.parametrize("rule", ["majority", "survivors"])
    @pytest.mark.parametrize("start", [0.0, 0.3])
    def test_steps_are_the_offline_algorithms(self, rule: str, start: float) -> None:
        """A run with noise and an attack from step 80 on, fed step by step."""
        d = replace(example(epsilon=0.01 if start else 0.0, start=start), rule=rule)
        d = replace(d, detect_above=0.15, isolate_above=np.full(4, 0.25))
        rng = np.random.default_rng(4)
        T, plant = d.settling + 260, yang2019.system()
        bad = rng.uniform(-0.5, 0.5, (T, 4))
        bad[d.settling + 80 :, 2] += 8.0
        x, u = rng.standard_normal(2), rng.uniform(-1.0, 1.0, (T, 1))
        apart = np.array([start / 2.0, 0.0])
        trace = windows.simulate(d, x, u, bad, apart)
        state, verdicts, truth = windows.init(d, 7.0, x + apart), [], x
        for k in range(T):
            y = measure(plant, truth, u[k]) + bad[k]
            state, verdict = windows.step(d, state, y, u[k], np.ones(4, dtype=bool))
            truth = advance(plant, truth, u[k])
            verdicts += [verdict] if verdict is not None else []
        first = d.settling
        count = (T - first) // d.length
        assert len(verdicts) == count > 0
        pi, pi_sets = trace.pi[first:], trace.pi_sets[first:]
        detected = windows.detection(pi, d.detect_above, d.length)
        found = windows.isolation(pi_sets, d.isolate_above, masks(d), d.length, d.rule)
        for i, verdict in enumerate(verdicts):
            assert (verdict.detection is Decision.ATTACKED) == detected[i]
            assert np.array_equal(verdict.suspects, found.suspects[i])
            last = first + (i + 1) * d.length - 1
            assert verdict.t == pytest.approx(7.0 + 0.1 * last)
            assert verdict.score[0] == pytest.approx(pi[i * d.length : (i + 1) * d.length].max())
        assert {v.isolation for v in verdicts} == {Decision.CLEAN, Decision.ATTACKED}

    def test_silence_is_undecided_and_never_clean(self) -> None:
        d = example(epsilon=0.05, start=0.5)
        plant, truth, u = yang2019.system(), np.array([0.2, -0.1]), np.zeros(1)
        state, verdicts = windows.init(d, 0.0, truth), []
        silent_from = d.settling + d.length + 5
        for k in range(d.settling + 6 * d.length):
            seen = np.ones(4, dtype=bool)
            seen[1] = not silent_from <= k < silent_from + 3
            state, verdict = windows.step(d, state, measure(plant, truth, u), u, seen)
            truth = advance(plant, truth, u)
            verdicts += [verdict] if verdict is not None else []
        assert verdicts[0].detection is verdicts[0].isolation is Decision.CLEAN
        assert verdicts[1].detection is Decision.UNDECIDED
        # Until k* steps after the return nothing that uses sensor 2 is judged.
        back = (silent_from + 3 + d.settling - d.settling) // d.length
        assert all(v.detection is Decision.UNDECIDED for v in verdicts[1 : back + 1])
        assert verdicts[-1].detection is verdicts[-1].isolation is Decision.CLEAN

    def test_without_a_bound_on_the_error_a_silence_is_for_good(self) -> None:
        d = example()
        state, plant, u = windows.init(d, 0.0, np.zeros(2)), yang2019.system(), np.zeros(1)
        verdicts = []
        for k in range(200):
            seen = np.ones(4, dtype=bool)
            y = np.zeros(4)
            if k == 60:
                y[0] = np.nan
            state, verdict = windows.step(d, state, y, u, seen)
            verdicts += [verdict] if verdict is not None else []
        assert verdicts[0].detection is Decision.CLEAN
        assert [v.detection for v in verdicts[1:]] == [Decision.UNDECIDED] * 3
        assert [v.isolation for v in verdicts[2:]] == [Decision.UNDECIDED] * 2
        # Sets without the sensor that failed are still judged.
        last = verdicts[-1].score[1:]
        assert np.array_equal(np.isfinite(last), ~masks(d)[:, 0])
        assert measure(plant, np.zeros(2), u).shape == (4,)

    @pytest.mark.parametrize("rule", ["majority", "survivors"])
    def test_a_window_of_which_one_step_is_judged_clears_nobody(self, rule: str) -> None:
        """All meters are heard at the first step of a window alone."""
        d = replace(example(), rule=rule)
        state, verdicts = windows.init(d, 0.0, np.zeros(2)), []
        for k in range(d.length):
            seen = np.full(4, k != 0)
            state, verdict = windows.step(d, state, np.zeros(4), np.zeros(1), seen)
            verdicts += [verdict] if verdict is not None else []
        assert np.all(np.isfinite(verdicts[0].score))
        assert verdicts[0].detection is verdicts[0].isolation is Decision.UNDECIDED

    @pytest.mark.parametrize("rule", ["majority", "survivors"])
    def test_a_threshold_that_is_no_number_is_never_clean(self, rule: str) -> None:
        nothing = np.full(4, np.nan)
        d = replace(example(), rule=rule, detect_above=np.nan, isolate_above=nothing, length=3)
        state = windows.init(d, 0.0, np.zeros(2))
        for _ in range(3):
            state, verdict = windows.step(d, state, np.zeros(4), np.zeros(1), np.ones(4, dtype=bool))
        assert verdict is not None
        assert verdict.detection is Decision.ATTACKED
        assert verdict.isolation is Decision.UNDECIDED
        assert windows.detection(np.array([0.1, np.nan]), np.nan, 1).tolist() == [True, False]

    def test_an_attack_during_silence_is_still_evidence(self) -> None:
        d = example()
        state, verdicts = windows.init(d, 0.0, np.zeros(2)), []
        for k in range(50):
            y = np.array([0.0, 0.0, 80.0, 0.0])
            if k == 40:
                y[0] = np.nan
            state, verdict = windows.step(d, state, y, np.zeros(1), np.ones(4, dtype=bool))
            verdicts += [verdict] if verdict is not None else []
        assert verdicts[0].detection is Decision.ATTACKED


class TestCalibration:
    @pytest.mark.acceptance
    def test_largest_of_honest_runs(self) -> None:
        at = yang2019.levels()
        honest = yang2019.trial(at.proven, sensor=None, size=0.0, runs=40, seed=77)
        again = windows.calibrate(at.proven, honest)
        assert again.detect_above == honest.pi.max()
        assert np.array_equal(again.isolate_above, honest.pi_sets.max(axis=(0, 1)))
        assert again.detect_above < at.simulated.detect_above < at.proven.detect_above
        # Of 40 fresh runs each exceeds the 500 calibrating ones with at most 0.0092 (99 %).
        assert np.count_nonzero(honest.pi.max(axis=1) > at.calibrated.detect_above) <= 3

    def test_a_trace_that_is_not_finite_or_too_short_calibrates_nothing(self) -> None:
        d = example()
        trace = windows.simulate(d, np.zeros(2), np.zeros((5, 1)), np.full((5, 4), 0.1))
        broken = replace(
            trace,
            pi=np.where(np.arange(5) == 2, np.nan, trace.pi),
            pi_sets=np.full_like(trace.pi_sets, np.inf),
        )
        with refused(InputInvalid, "not-finite", "not-finite"):
            windows.calibrate(d, broken)
        with refused(InputInvalid, "not-finite", "not-finite"):
            windows.calibrate(replace(d, settling=9), trace)

    @pytest.mark.acceptance
    def test_calibrated_thresholds_are_no_bounds(self) -> None:
        """Constant noise of the same size raises a false alarm at once, not so above the proven threshold."""
        at = yang2019.levels()
        bias = np.tile(np.array([0.5, 0.5, -0.5, -0.5]), (200, 1))
        trace = windows.simulate(at.proven, np.zeros(2), np.zeros((200, 1)), bias)
        assert windows.detection(trace.pi, at.calibrated.detect_above, 200).all()
        assert not windows.detection(trace.pi, at.proven.detect_above, 200).any()


@pytest.fixture(scope="module")
def village() -> tuple[object, np.ndarray, np.ndarray]:
    site = load_site("kerber-landnetz")
    meters = site.meters[np.isin(site.meters, site.droop.customer)]
    rng = np.random.default_rng(8)
    lure = close_loop(site.feeder, site.droop, meters)
    drift = np.cumsum(rng.uniform(-3e-4, 3e-4, (240, 1)), axis=0)
    return lure, np.full((240, lure.F.shape[1]), 1.0 - 0.955**2) + drift, site.droop.limit


class TestFeeder:
    @pytest.mark.canary("0.03-1")
    @pytest.mark.parametrize(("size", "q"), [(0.0, 1), (0.03, 1), (-0.03, 2), (1e3, 2)])
    def test_proven_thresholds_on_sampled_readings(
        self, village: tuple[object, np.ndarray, np.ndarray], size: float, q: int
    ) -> None:
        """The continuous feeder, read once a second with noise: liars named and nobody else."""
        lure, u, limit = village
        lie = np.zeros((len(u), 7))
        who = [2, 5][:q]
        lie[120:, who] = size
        study = sampled_feeder.on_feeder(
            lure,  # type: ignore[arg-type]
            h=1.0,
            u=u,
            noise=1e-3,
            held=drift_error(lure, 1.0, np.full(7, 3e-4)),  # type: ignore[arg-type]
            limit=limit,
            lie=lie,
            max_attacked=q,
            length=20,
            seed=6,
            rule="survivors",
        )
        honest = (
            ~study.design.observers.masks[:, who].any(axis=1)
            if size
            else np.ones(len(study.bound), dtype=bool)
        )
        assert np.all(study.error[study.design.settling :, honest] <= study.bound[honest])
        for verdict in study.verdicts:
            before = verdict.t < 120.0
            settled = verdict.t > 150.0
            if before or not size:
                assert verdict.detection is verdict.isolation is Decision.CLEAN
            elif settled:
                assert verdict.detection is verdict.isolation is Decision.ATTACKED
                assert np.flatnonzero(verdict.suspects).tolist() == who

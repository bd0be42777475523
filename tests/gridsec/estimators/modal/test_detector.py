"""Scores, likelihood ratios and the detector against dense filters and by Monte Carlo."""

from __future__ import annotations

from dataclasses import replace
from math import inf, log, sqrt

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks._residuals import Dense, Source, model_of, power_columns, tree
from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import detector, full, signatures, static
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.model import Modes, ResidualModel, modes
from gridsec.estimators.modal.signatures import Columns, Onsets, Scores
from gridsec.estimators.modal.static import Static
from tests.gridsec.estimators.modal.test_filter import masks, mixed, proportional

FEEDER = tree(12, np.random.default_rng(3))


def busbar() -> ResidualModel:
    """One class of meters, and a busbar with a class of its own."""
    return model_of(FEEDER)


def density(nu: Floats, V: Floats) -> float:
    """Logarithm of the Gaussian density without its constant."""
    return -0.5 * float(nu @ np.linalg.solve(V, nu)) - 0.5 * float(np.linalg.slogdet(V)[1])


def follow(
    made: Modes, readings: Floats, begins: dict[int, int], onsets: Onsets, seen: Bools | None = None
) -> tuple[Onsets, Static]:
    """Rows begun at some ticks, after all readings at intervals of 1 s."""
    state, more = modal.start(made, 0.0), static.start(made)
    for k, m in enumerate(readings):
        begun = [row for row, tick in begins.items() if tick == k]
        state, more, update = full.step(made, state, more, float(k), m, None if seen is None else seen[k])
        onsets = signatures.follow(made, onsets, update, more, 1.0 if k else 0.0, begun=begun)
    return onsets, more


def played(
    made: Modes, readings: Floats, begins: dict[int, int], onsets: Onsets, seen: Bools | None = None
) -> tuple[Onsets, Scores]:
    """Rows begun at some ticks, and their scores after all readings."""
    onsets, more = follow(made, readings, begins, onsets, seen)
    return onsets, signatures.scores(made, onsets, more)


def exact_ratio(  # noqa: PLR0917  # everything that moves the readings
    model: ResidualModel, readings: Floats, G: Floats, std: float, onset: int, ramp: bool
) -> float:
    """Log likelihood ratio of amounts N(0, std^2) of faults G against none, by two dense filters."""
    with_, without, out = Dense(model, G, std), Dense(model), 0.0
    for k, m in enumerate(readings):
        age = max(0, k - onset + 1)
        level = age / signatures.RAMP_S if ramp else float(age > 0)
        h = 1.0 if k else 0.0
        out += density(*with_.step(h, m, level=level)) - density(*without.step(h, m))
    return out


@pytest.mark.parametrize("make", [proportional, busbar, mixed])
@pytest.mark.parametrize("ramp", [False, True])
def test_likelihood_ratios_equal_those_of_dense_filters(make: object, ramp: bool) -> None:
    """Members, a false power and the busbar, at an onset between; theta integrated out."""
    assert callable(make)
    model = make()
    made, onset, std = modes(model), 25, 0.7 if ramp else 0.01
    readings = Source(model, np.random.default_rng(5)).ticks(60)
    readings[onset:, 4] += 0.004
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), std)
    row = 1 if ramp else 0
    onsets, more = follow(made, readings, {row: onset}, signatures.empty(made, 1, 1))
    now, together = signatures.scores(made, onsets, more), signatures.joint(made, onsets, more, row)
    y, F = now.of(of.W, of.W**2)
    each = ((y[:, [q]], F[:, [q]], np.square(of.std[[q]])) for q in range(of.std.size))
    found = np.array([detector.log_mean(*one)[row] for one in each])
    at_members = of.of(signatures.scored(made, onsets, more, row))
    assert all(np.allclose(one, other) for one, other in zip(at_members, together.of(of.W), strict=True))
    if made.sign.size <= static.FEW:
        matrix = together.of(of.W)
        assert np.allclose(matrix[0], y[row])
        assert np.allclose(np.diag(matrix[1]), F[row])
    H = model.phases(made.at)
    faults = np.hstack([np.eye(12), power_columns(FEEDER), H])
    for q in (0, 4, 11, 15, 30, 36):
        exact = exact_ratio(model, readings, faults[:, [q]], float(of.std[q]), onset, ramp)
        if made.sign.size <= static.FEW:
            assert abs(found[q] - exact) <= 1e-8 * max(1.0, abs(exact))
        else:
            # The information is then that without the classes: the ratio is smaller, never larger by much.
            assert found[q] <= exact + 0.05 * abs(exact) + 0.5


@pytest.mark.parametrize("make", [proportional, busbar])
def test_the_omnibus_equals_that_of_dense_filters(make: object) -> None:
    """f ~ N(0, s^2 D) in all members."""
    assert callable(make)
    model = make()
    made, onset, s2 = modes(model), 25, 20.0
    readings = Source(model, np.random.default_rng(6)).ticks(50)
    readings[onset:] += 0.002
    _, now = played(made, readings, {0: onset}, signatures.empty(made, 1))
    G = np.linalg.cholesky(model.noise(made.at))
    exact = exact_ratio(model, readings, G, sqrt(s2), onset, False)
    assert abs(detector.omnibus(now, s2)[0] - exact) <= 1e-8 * abs(exact)


@pytest.mark.canary("random-busbar-60")
@pytest.mark.parametrize("runs", [60, 300])
@pytest.mark.parametrize("make", [proportional, busbar, mixed])
@pytest.mark.parametrize("kind", ["outage", "half", "random", "alternating"])
def test_ratios_with_missing_readings_have_means_of_at_most_1(make: object, kind: str, runs: int) -> None:
    """Honest readings: spread of the scores over their information, and mean Lambda, at several ages."""
    assert callable(make)
    model = make()
    made, random = modes(model), np.random.default_rng(7)
    seen = masks(kind, made.size, 60)
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    begins = {0: 59, 1: 56, 2: 45, 3: 25, 4: 22, 5: 0}
    z, whole, single = [], [], []
    for _ in range(runs):
        _, now = played(made, Source(model, random).ticks(60), begins, signatures.empty(made, 6), seen)
        members, others = now.of_members(made), now.of(*of.others)
        y, F = (np.hstack(each) for each in zip(members, others, strict=True))
        z.append(y * y / np.maximum(F, 1e-3 * F.max(axis=1, keepdims=True)))
        # Small prior variances, for which Lambda has a finite variance.
        s2 = 0.3 / now.information.max(axis=1)
        whole.append(np.exp([detector.omnibus(now, each)[k] for k, each in enumerate(s2)]))
        single.append(np.exp(detector.log_mean(y, F, 0.3 / F.max(axis=1, keepdims=True))))
    spread = np.mean(z, axis=0)
    # One of a thousand cases exceeds this in any entry by chance.
    assert (spread < chi2.ppf(1.0 - 1e-3 / spread.size, runs) / runs).all()
    assert spread[1:].max() > 0.6
    for each in (np.array(whole), np.array(single)):
        assert (each.mean(axis=0) - 3.0 * each.std(axis=0) / sqrt(runs) <= 1.0).all()


def test_rows_that_are_not_in_use_stay_zero() -> None:
    made = modes(busbar())
    readings = Source(busbar(), np.random.default_rng(8)).ticks(10)
    onsets, _ = played(made, readings, {0: 3}, signatures.empty(made, 2))
    assert onsets.age.tolist() == [7, 0]
    assert not onsets.score[1].any()
    assert not onsets.signature[:, 1].any()


def test_rows_are_given_back_and_used_again() -> None:
    """A row after its end is zero, and a new onset in it is as one in a fresh row."""
    model = busbar()
    made = modes(model)
    state, more, rows = modal.start(made, 0.0), static.start(made), signatures.empty(made, 2, 1)
    readings = Source(model, np.random.default_rng(8)).ticks(20)
    begun, ended = {0: [0], 9: [0, 1]}, {5: [0]}
    for k, m in enumerate(readings):
        state, more, update = full.step(made, state, more, float(k), m)
        rows = signatures.follow(
            made, rows, update, more, 1.0, begun=begun.get(k, []), ended=ended.get(k, [])
        )
        if k == 5:
            assert not rows.used.any()
            assert not (rows.score.any())
            assert not (rows.information.any())
            assert not (rows.signature.any())
            assert rows.age.tolist() == [0, 0, 0]
    assert rows.age.tolist() == [11, 11, 0]
    assert (rows.score[0] == rows.score[1]).all()
    assert (rows.information[0] == rows.information[1]).all()


def watch(made: Modes, of: Columns, readings: Floats) -> tuple[Floats, detector.Detector]:
    """Log M of every tick, and the detector after the last."""
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    out = np.empty(len(readings))
    for k, m in enumerate(readings):
        state, more, update = full.step(made, state, more, float(k), m)
        test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=-inf)
        out[k] = evidence.log_m
    return out, test


def test_dropping_onsets_leaves_m_and_covers_all_ages() -> None:
    """M after thinning equals M before; ages grow by less than 2.5 from row to row."""
    made = modes(busbar())
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    source = Source(busbar(), np.random.default_rng(9))
    for k in range(1600):
        state, more, update = full.step(made, state, more, float(k), source.tick())
        test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=-inf)
    assert test.ticks % detector.EVERY == 0
    assert test.ratio is not None
    capital, onsets = test.capital.copy(), test.onsets
    gone = detector._thin(onsets, test.pinned, capital, test.ratio)
    used = onsets.used & ~np.isin(np.arange(onsets.used.size), gone)
    now = signatures.scores(made, onsets, more)
    ratio = detector.log_ratios(of, made, now, powers=True)
    by_row = capital + np.log(np.array(detector.WEIGHTS))[:, None] + ratio
    ripe = used & ~(onsets.ramp & (onsets.age < detector.RAMP_EVERY))
    assert np.isclose(np.logaddexp.reduce(by_row[:, ripe], axis=None), evidence.log_m, atol=1e-9)
    age = np.sort(onsets.age[used & ~onsets.ramp])[::-1]
    assert age.size == detector.STEP_ROWS
    assert age[0] == 1600
    assert (age[:-1] <= np.maximum(2.5 * age[1:], age[1:] + 4)).all()
    # Capital: one a tick and kind, moved at the ratio of likelihoods.
    assert np.isfinite(evidence.log_m)


@pytest.mark.parametrize("ramps", [False, True])
def test_pinned_onsets_stay_in_their_rows(ramps: bool) -> None:
    """All `PINS` of one kind; new onsets never find all rows in use, and the pinned ones age by each tick."""
    made = modes(busbar())
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    source, begun, rows = Source(busbar(), np.random.default_rng(9)), np.zeros(0, dtype=np.intp), np.zeros(0)
    for k in range(900):
        state, more, update = full.step(made, state, more, float(k), source.tick())
        test, _ = detector.step(made, of, test, update, more, h=1.0, alert=-inf)
        kind = test.onsets.used & (test.onsets.ramp == ramps)
        if k == 600:
            begun = np.flatnonzero(kind)[: detector.PINS]
            test, rows = detector.pin(test, begun), test.onsets.age[begun]
        if k >= 600:
            assert (test.onsets.age[begun] == rows + k - 600).all()
            assert not (test.onsets.used | (test.onsets.ramp != ramps)).all()


def test_onsets_beyond_the_oldest_age_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detector, "OLDEST", 100)
    made = modes(busbar())
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    _, test = watch(made, of, Source(busbar(), np.random.default_rng(10)).ticks(400))
    assert test.onsets.age.max() <= 100 + 2 * detector.EVERY


def test_a_fault_is_found() -> None:
    """A step of one meter, a small one of all, a false power: log M rises beyond one false alarm a year."""
    made, limit = modes(busbar()), log(3.2e7)
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    alternating = np.where(np.arange(12) % 2 == 0, 0.003, -0.003)
    power = power_columns(FEEDER)[:, 3] * 0.08
    for fault in (0.01 * np.eye(12)[5], alternating, power):
        readings = Source(busbar(), np.random.default_rng(11)).ticks(160)
        readings[100:] += fault
        log_m, _ = watch(made, of, readings)
        assert (log_m[:100] < limit).all()
        assert log_m[100:].max() >= limit


def run_lengths(model: ResidualModel, gamma: float, runs: int, seed: int) -> Floats:
    """Ticks to the first alarm; at most 8 gamma, at which a run is cut."""
    made = modes(model)
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    random, out = np.random.default_rng(seed), np.empty(runs)
    for run in range(runs):
        source, longest = Source(model, random), int(8 * gamma)
        state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
        for k in range(longest):
            state, more, update = full.step(made, state, more, float(k), source.tick())
            test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=log(gamma) / 2.0)
            if evidence.log_m >= log(gamma):
                break
        out[run] = k + 1
    return out


@pytest.mark.canary("mixed-30.0-40")
@pytest.mark.parametrize(("gamma", "runs"), [(30.0, 40), (100.0, 40), (1000.0, 12)])
@pytest.mark.parametrize("make", [busbar, mixed])
def test_average_run_length_is_at_least_gamma(make: object, gamma: float, runs: int) -> None:
    """The mean of run lengths cut at 8 gamma, less 2.33 standard errors (99 %), is at least gamma."""
    assert callable(make)
    lengths = run_lengths(make(), gamma, runs, 12)
    lower = lengths.mean() - 2.33 * lengths.std(ddof=1) / sqrt(runs)
    assert lower >= gamma


def test_no_onset_no_evidence() -> None:
    """Rows that are not in use add nothing to M."""
    made = modes(busbar())
    now = signatures.scores(made, signatures.empty(made, 2), static.start(made))
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    ratio = detector.log_ratios(of, made, now, powers=False)
    assert np.allclose(ratio[:2], 0.0)
    # The busbar alone is one of 25 columns of its kind.
    assert np.allclose(ratio[2], -log(25.0))


@pytest.mark.parametrize("make", [busbar, mixed])
def test_the_information_about_the_busbar_is_exact(make: object) -> None:
    """With missing readings and unknown directions it is the variance of the score, by dense matrices."""
    assert callable(make)
    model: ResidualModel = replace(make(), fixed_s=inf)
    made, p, ticks = modes(model), 12, 8
    random = np.random.default_rng(14)
    seen = random.random((ticks, p)) >= 0.3
    seen[:2] = True
    unknown = 0.01 * random.random((ticks, p, 2)) + 0.01

    def after(readings: Floats) -> tuple[float, float]:
        state, more, onsets = modal.start(made, 0.0), static.start(made), signatures.empty(made, 1)
        for k, m in enumerate(readings):
            open_ = unknown[k] if k > 1 else None
            state, more, update = full.step(made, state, more, float(k), m, seen[k], unknown=open_)
            onsets = signatures.follow(made, onsets, update, more, 1.0, begun=[0] if k == 1 else [])
        assert onsets.busbar is not None
        return float(signatures.scores(made, onsets, more).score[0] @ made.U.T @ made.phases[:, 0]), float(
            onsets.busbar[0, 0]
        )

    response = np.array([after(one)[0] for one in np.eye(ticks * p).reshape(-1, ticks, p)]).reshape(ticks, p)
    at, apart = np.arange(p), np.abs(np.subtract.outer(np.arange(ticks), np.arange(ticks)))
    rho = np.exp(-apart / model.time_s)
    w = model.loads(at)
    variance = float(
        np.sum(rho * (response @ w @ response.T)) + np.sum(response @ model.static(at) @ response.T)
    )
    for k in range(ticks):
        A = unknown[k] if k > 1 else np.zeros((p, 0))
        variance += float(response[k] @ (model.noise(at) + A @ A.T) @ response[k])
    # Eigenvalues of the loads below 1e-9 of the largest one are zero in the modes.
    assert np.isclose(after(np.zeros((ticks, p)))[1], variance, rtol=1e-6)


def test_a_shift_of_all_meters_along_an_unknown_direction_is_found() -> None:
    """An unread power at the head of a feeder moves all meters alike: 2 % is beyond it at once."""
    made, limit = modes(busbar()), log(3.2e7)
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    readings = Source(busbar(), np.random.default_rng(15)).ticks(40)
    readings[30:] += 0.04
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    out = []
    for k, m in enumerate(readings):
        state, more, update = full.step(made, state, more, float(k), m, unknown=np.full((12, 1), 0.006))
        test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=limit / 2.0)
        out.append(evidence.log_m)
    assert max(out[:30]) < limit
    assert max(out[30:33]) >= limit


@pytest.mark.parametrize("make", [busbar, mixed])
def test_the_precision_of_members_is_bounded_from_below(make: object) -> None:
    """Exact by the dense covariance of the innovation; the bound holds at irregular intervals, too."""
    assert callable(make)
    made, random = modes(make()), np.random.default_rng(16)
    seen = np.ones((60, 12), dtype=np.bool_)
    seen[40:, 3] = False
    state, more, least, t = modal.start(made, 0.0), static.start(made), None, 0.0
    for k in range(60):
        state, more, update = full.step(made, state, more, t, np.zeros(12), seen[k])
        least = detector.precision(made, least, update)
        exact = least.exact(made, update)
        if update.exact is None:
            assert np.allclose(exact, ((made.U / update.variance) @ made.U.T).diagonal())
        else:
            assert exact[3] == 0.0
        assert (least.least <= exact * (1.0 + 1e-12)).all()
        t += float(random.uniform(0.5, 100.0))


@pytest.mark.parametrize("silent", [3, None])
def test_m_is_evaluated_at_every_tick_without_all_readings(silent: int | None) -> None:
    """Calm readings: at the first `EVERY` ticks and at every `EVERY`-th. With a silent meter at every one."""
    made = modes(busbar())
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    seen = np.arange(12) != silent
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    for k in range(1, 21):
        state, more, update = full.step(made, state, more, float(k), np.zeros(12), seen)
        test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=inf)
        assert (evidence.log_m > -inf) == (
            silent is not None or k <= detector.EVERY or k % detector.EVERY == 0
        )


def test_onsets_are_evaluated_at_intervals_of_a_sixth_of_their_age() -> None:
    """Up to 24 ticks at every 4th, up to 48 at every 8th, all at every 16th and at the first 4; no ramps."""
    made = modes(busbar())
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    for k in range(1, 161):
        state, more, update = full.step(made, state, more, float(k), np.zeros(12))
        test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=inf)
        age, step = test.onsets.age, test.onsets.used & ~test.onsets.ramp
        most = inf if k <= 4 or k % 16 == 0 else 48 if k % 8 == 0 else 24 if k % 4 == 0 else -inf
        if k % 4 == 0:
            assert (np.isfinite(evidence.by_row).all(axis=0)[step] == (age <= most)[step]).all()
        else:
            assert k <= 4 or not np.isfinite(evidence.by_row).any()


def test_all_onsets_are_evaluated_while_m_is_near_the_limit() -> None:
    """Also at ticks at which none is due; the capital of ramps counts from 16 ticks on."""
    made = modes(busbar())
    of = signatures.columns(made, power_columns(FEEDER), np.full(24, 0.05), 0.01)
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    for k in range(1, 80):
        state, more, update = full.step(made, state, more, float(k), np.zeros(12))
        test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=-inf)
        used, ripe = test.onsets.used, ~test.onsets.ramp | (test.onsets.age >= 16)
        now = signatures.scores(made, test.onsets, more)
        ratio = detector.log_ratios(of, made, now, powers=True)
        by_row = test.capital + np.log([[0.5], [0.35], [0.15]]) + ratio
        assert np.allclose(evidence.by_row[:, used & ripe], by_row[:, used & ripe], atol=1e-9)
        assert np.isclose(np.logaddexp.reduce(by_row[:, used & ripe], axis=None), evidence.log_m, atol=1e-9)

"""Bounded noise: no bound is violated in ten thousand trials, and the constants are what they claim."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid, NotObservable
from gridsec.secure.decode import Stack, design, sensors_in_error
from gridsec.secure.decode.noise import (
    CorrectionConstants,
    DetectionConstants,
    correct,
    correction_constants,
    detect,
    detection_constants,
)
from tests.codes import refused

TOL = 1e-9
BATCH = 100
# (p, n, height, q), ten codes of each; q-detectable for the first four numbers, 2q also for all here.
SHAPES = [
    (5, 2, 1, 1),
    (7, 3, 1, 2),
    (6, 4, 2, 1),
    (8, 3, 3, 3),
    (7, 2, 2, 2),
    (5, 3, 3, 2),
    (9, 2, 1, 3),
    (6, 5, 3, 1),
    (4, 2, 2, 1),
    (6, 3, 4, 2),
]


@dataclass(frozen=True)
class Trials:
    """Measurements z = Phi x + v + e with |v_i| <= v_max and e in at most q blocks."""

    x: Floats
    e: Floats
    v: Floats
    v_max: float
    z: Floats


def trials(stack: Stack, q: int, rng: np.random.Generator, *, quiet: bool = False) -> Trials:
    """Noise on its bound in every block; attacks of all sizes, some of them in harmony, some hiding.

    `quiet`: attacks of the size of the noise only, which detection misses.
    """
    p, n, N = stack.count, stack.unknowns, stack.matrix.shape[0]
    v_max = float(10.0 ** rng.uniform(-3, 1))
    x = rng.standard_normal((BATCH, n))
    v = rng.standard_normal((BATCH, N))
    # A third of the noises push in the direction to which least squares is most sensitive.
    worst = np.linalg.svd(stack.matrix, full_matrices=False)[0][:, -1]
    v[::3] = worst + 0.1 * v[::3]
    v *= v_max * (stack.membership @ (1.0 / stack.norms(v)).T).T
    bad = np.argsort(rng.random((BATCH, p)), axis=1)[:, :q]
    where = np.zeros((BATCH, p))
    np.put_along_axis(where, bad, 1.0, axis=1)
    size = 10.0 ** (rng.uniform(-1, 0.7, (BATCH, 1)) if quiet else rng.uniform(-2, 4, (BATCH, 1)))
    other = size * v_max * rng.standard_normal((BATCH, n))
    harmony = rng.random((BATCH, 1)) < 0.5
    e = np.where(harmony, other @ stack.matrix.T, size * v_max * rng.standard_normal((BATCH, N)))
    e *= where @ stack.membership.T
    return Trials(x, e, v, v_max, x @ stack.matrix.T + v + e)


def codes() -> list[tuple[int, Stack, int]]:
    out = []
    for index, (p, n, height, q) in enumerate(SHAPES):
        for k in range(10):
            rng = np.random.default_rng(100 * index + k)
            blocks = rng.standard_normal((p, height, n)) * 10.0 ** rng.uniform(-1, 1, (p, 1, 1))
            out.append((100 * index + k, Stack.of(blocks), q))
    return out


def test_kappa_c_is_never_violated_in_ten_thousand_trials() -> None:
    """lee2018, Theorem 2.2.11, for a random r in q … 2 q per code."""
    closest, count = 0.0, 0
    for seed, stack, q in codes():
        rng = np.random.default_rng(seed)
        r = int(rng.integers(q, 2 * q + 1))
        constants = correction_constants(stack, q, tol=TOL, left_out=r)
        decoder = design(stack, q, tol=TOL, left_out=r)
        t = trials(stack, q, rng)
        got = correct(decoder, constants, t.z, v_max=t.v_max)
        error = np.linalg.norm(got.x - t.x, axis=1)
        assert np.all(got.credible), "the minimum never exceeds q (proof of Theorem 2.2.11)"
        assert np.all(error <= constants.kappa_c * t.v_max * (1.0 + 1e-9))
        closest, count = max(closest, float(np.max(error)) / constants.kappa_c / t.v_max), count + BATCH
    assert count == 10_000
    assert closest > 0.4, "the trials must come near the bound, or they would not notice a wrong one"


def test_kappa_d_and_kappa_e_are_never_violated_in_ten_thousand_silent_trials() -> None:
    """lee2018, Theorem 2.2.9: no false alarm; silence bounds the errors and the estimate."""
    silent = loud = 0
    for seed, stack, q in codes():
        rng = np.random.default_rng(seed + 1)
        constants = detection_constants(stack, q, tol=TOL)
        for quiet in (False, True):
            t = trials(stack, q, rng, quiet=quiet)
            honest = detect(stack, t.z - t.e, v_max=t.v_max)
            assert not honest.alarm.any()
            got = detect(stack, t.z, v_max=t.v_max)
            calm = ~got.alarm
            silent, loud = silent + int(calm.sum()), loud + int(got.alarm.sum())
            assert np.all(stack.norms(t.e)[calm] <= constants.kappa_e * t.v_max * (1.0 + 1e-9))
            off = np.linalg.norm(got.x - t.x, axis=1)[calm]
            assert np.all(off <= constants.kappa_d * t.v_max * (1.0 + 1e-9))
    assert silent + loud == 20_000
    assert silent > 10_000
    assert loud > 1_000


def test_both_directions_of_theorem_2_2_12() -> None:
    """At most q unexplained blocks: close. More than q: far, by kappa^c'."""
    near = far = 0
    for seed, stack, q in codes():
        rng = np.random.default_rng(seed + 2)
        constants = correction_constants(stack, q, tol=TOL)
        t = trials(stack, q, rng)
        reach = constants.kappa_c * t.v_max * 10.0 ** rng.uniform(-4, 1, (BATCH, 1))
        guess = t.x + reach * rng.standard_normal((BATCH, stack.unknowns))
        unexplained = sensors_in_error(stack, t.z, guess, constants.theta * t.v_max)
        error = np.linalg.norm(guess - t.x, axis=1)
        accepted = unexplained <= q
        assert np.all(error[accepted] <= constants.kappa_c * t.v_max * (1.0 + 1e-9))
        assert np.all(error[~accepted] > constants.kappa_far * t.v_max * (1.0 - 1e-9))
        near, far = near + int(accepted.sum()), far + int((~accepted).sum())
    assert near > 1_000
    assert far > 1_000


def plain_detection(stack: Stack, q: int) -> DetectionConstants:
    """The definitions, written out with loops and dense pseudo-inverses."""
    p, rho, eta = stack.count, np.inf, 0.0
    for kept in itertools.combinations(range(p), p - q):
        part = stack.matrix[stack.rows(kept)]
        rho = min(rho, np.linalg.svd(part, compute_uv=False)[-1])
        for i in set(range(p)) - set(kept):
            eta = max(eta, np.linalg.norm(stack.matrix[stack.rows([i])] @ np.linalg.pinv(part), 2))
    root = np.sqrt(p)
    return DetectionConstants(
        rho, eta, root, (root + 1) * np.sqrt(p - q) / rho, (eta * np.sqrt(p - q) + 1) * (root + 1)
    )


def plain_correction(stack: Stack, q: int, r: int) -> CorrectionConstants:
    p, rho, worst = stack.count, np.inf, -np.inf
    for kept in itertools.combinations(range(p), p - 2 * q):
        rho = min(rho, np.linalg.svd(stack.matrix[stack.rows(kept)], compute_uv=False)[-1])
    for kept in itertools.combinations(range(p), p - q):
        best = np.inf
        for inner in itertools.combinations(kept, p - r):
            inverse = np.linalg.pinv(stack.matrix[stack.rows(inner)])
            rest = set(kept) - set(inner)
            best = min(
                best,
                max((np.linalg.norm(stack.matrix[stack.rows([i])] @ inverse, 2) for i in rest), default=0.0),
            )
        worst = max(worst, best)
    theta = max(worst * np.sqrt(p - r) + 1, np.sqrt(p - r))
    largest = max(np.linalg.norm(stack.matrix[stack.rows([i])], 2) for i in range(p))
    return CorrectionConstants(
        rho, worst, theta, (theta + 1) * np.sqrt(p - 2 * q) / rho, (theta - 1) / largest
    )


@pytest.mark.parametrize("seed", range(6))
def test_constants_equal_their_definitions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    heights = rng.integers(2, 4, 6)
    stack = Stack.of([rng.standard_normal((int(h), 2)) for h in heights])
    for q in (0, 1, 2):
        got, want = detection_constants(stack, q, tol=TOL), plain_detection(stack, q)
        for name in DetectionConstants.__slots__:
            assert getattr(got, name) == pytest.approx(getattr(want, name), rel=1e-10), name
        for r in range(q, 2 * q + 1):
            got_c = correction_constants(stack, q, tol=TOL, left_out=r)
            want_c = plain_correction(stack, q, r)
            for name in CorrectionConstants.__slots__:
                assert getattr(got_c, name) == pytest.approx(getattr(want_c, name), rel=1e-10), (name, q, r)


def test_erratum_the_step_of_the_proof_of_theorem_2_2_9() -> None:
    """`Phi_i d = Phi_i Phi_Lambda^+ Phi_Lambda d`; without the last factor, as printed, it does not fit."""
    rng = np.random.default_rng(3)
    stack = Stack.of(rng.standard_normal((5, 2, 3)))
    rows, d = stack.rows([0, 1, 3, 4]), rng.standard_normal(3)
    part = stack.matrix[rows]
    own = stack.matrix[stack.rows([2])]
    assert np.allclose(own @ np.linalg.pinv(part) @ (part @ d), own @ d)
    assert (own @ np.linalg.pinv(part)).shape[1] != d.size
    # Hence |Phi_i (x - x_hat)| <= eta |Phi_Lambda (x - x_hat)|, which kappa^e rests on.
    eta = detection_constants(stack, 1, tol=TOL).eta
    assert np.linalg.norm(own @ d) <= eta * np.linalg.norm(part @ d)


def test_a_bound_of_the_noise_for_every_measurement() -> None:
    """v_max may differ between the members of a batch, as with observers that settle over time."""
    rng = np.random.default_rng(0)
    stack = Stack.of(rng.standard_normal((6, 2, 3)))
    constants = correction_constants(stack, 1, tol=TOL)
    decoder = design(stack, 1, tol=TOL)
    z = rng.standard_normal((4, 12))
    sizes = np.array([1e-3, 0.1, 1.0, 10.0])
    together = correct(decoder, constants, z, v_max=sizes)
    watched = detect(stack, z, v_max=sizes)
    for i, size in enumerate(sizes):
        alone = correct(decoder, constants, z[i], v_max=float(size))
        assert np.allclose(alone.x, together.x[i])
        assert np.array_equal(alone.in_error, together.in_error[i])
        assert detect(stack, z[i], v_max=float(size)).alarm == watched.alarm[i]


def test_refusals() -> None:
    stack = Stack.of_rows(np.random.default_rng(0).standard_normal((5, 3)))
    assert detection_constants(stack, 2, tol=TOL).rho > 0
    with refused(NotObservable, "not-observable"):
        detection_constants(stack, 3, tol=TOL)
    with refused(NotObservable, "not-observable"):
        correction_constants(stack, 2, tol=TOL)
    with refused(InputInvalid, "out-of-range"):
        correction_constants(stack, 1, tol=TOL, left_out=0)
    decoder, constants = design(stack, 1, tol=TOL), correction_constants(stack, 1, tol=TOL)
    for bad in (np.nan, -1.0, np.array([0.1, np.nan])):
        with refused(InputInvalid, "negative"):
            detect(stack, np.zeros((2, 5)), v_max=bad)
        with refused(InputInvalid, "negative"):
            correct(decoder, constants, np.zeros((2, 5)), v_max=bad)


def test_a_reading_that_is_no_number_alarms_and_decodes_to_nothing_credible() -> None:
    stack = Stack.of_rows(np.ones((3, 1)))
    z = np.array([[np.nan, 1.0, 1.0], [1.0, 1.0, 1.0]])
    assert detect(stack, z, v_max=0.1).alarm.tolist() == [True, False]
    found = correct(design(stack, 1, tol=TOL), correction_constants(stack, 1, tol=TOL), z, v_max=0.1)
    assert found.credible.tolist() == [False, True]
    assert found.in_error.tolist() == [[True] * 3, [False] * 3]
    assert sensors_in_error(stack, z, np.ones((2, 1)), 0.1).tolist() == [3, 0]

"""All fits without q blocks, against dense least squares, corners of the box, and brute force over liars."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.errors import DesignInfeasible
from gridsec.secure.decode.search import Fits, fits
from tests.codes import refused

SEEDS = st.integers(0, 2**32 - 1)


class Problem:
    """Blocks of one to three rows; what every set's fit is, by a pseudo-inverse of the whole stack."""

    def __init__(self, rng: np.random.Generator, blocks: int = 6, n: int = 5) -> None:
        self.n, self.blocks = n, blocks
        self.block = np.repeat(np.arange(blocks), rng.integers(1, 4, blocks))
        self.B = rng.normal(size=(self.block.size, n)) * rng.uniform(0.1, 5.0, (self.block.size, 1))
        self.f = rng.normal(size=(3, n))

    def honest(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A state and its readings, at corners of their boxes as often as inside."""
        size = self.n + self.block.size
        box = rng.choice([-1.0, 1.0], size) if rng.random() < 0.5 else rng.uniform(-1.0, 1.0, size)
        return box[: self.n], self.B @ box[: self.n] + box[self.n :]

    def fit(self, s: np.ndarray, q: int) -> Fits:
        return fits(self.B, s, self.block, self.blocks, q, self.f)

    def dense(self, left_out: np.ndarray) -> np.ndarray:
        """The matrix K of xi_hat = K s."""
        keep = ~left_out[self.block]
        inverse = np.linalg.pinv(np.vstack([np.eye(self.n), self.B[keep]]))
        K = np.zeros((self.n, keep.size))
        K[:, keep] = inverse[:, self.n :]
        return K


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, q=st.integers(0, 2))
def test_every_fit_is_least_squares_and_every_limit_is_attained(seed: int, q: int) -> None:
    rng = np.random.default_rng(seed)
    case = Problem(rng)
    s = rng.normal(size=case.block.size) * 3.0
    found = case.fit(s, q)
    for c, out in enumerate(found.left_out):
        K = case.dense(out)
        np.testing.assert_allclose(found.xi[c], K @ s, atol=1e-9)
        np.testing.assert_allclose(found.residual[c], s - case.B @ K @ s, atol=1e-9)
        by = np.hstack([case.B - case.B @ K @ case.B, np.eye(s.size) - case.B @ K])
        corners = np.sign(by)
        np.testing.assert_allclose(found.limit[c], np.einsum("ij,ij->i", by, corners), atol=1e-9)
        error = np.hstack([case.f - case.f @ K @ case.B, -case.f @ K])
        np.testing.assert_allclose(found.error[c], np.abs(error).sum(axis=1), atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, q=st.integers(0, 2))
def test_honest_blocks_are_never_contradicted(seed: int, q: int) -> None:
    rng = np.random.default_rng(seed)
    case = Problem(rng)
    xi, s = case.honest(rng)
    found = case.fit(s, q)
    assert found.credible.all()
    assert not found.contradicted.any()
    assert not found.certain.any()
    assert (np.abs((found.xi - xi) @ case.f.T) <= found.error * (1.0 + 1e-9)).all()


@settings(max_examples=100, deadline=None)
@given(seed=SEEDS, liars=st.integers(0, 2), size=st.sampled_from([0.5, 3.0, 100.0]))
def test_who_is_certain_lies_and_the_truth_is_among_the_credible(seed: int, liars: int, size: float) -> None:
    """Whatever up to q blocks say, also together."""
    rng = np.random.default_rng(seed)
    case = Problem(rng)
    xi, s = case.honest(rng)
    lying = np.zeros(case.blocks, dtype=bool)
    lying[rng.choice(case.blocks, liars, replace=False)] = True
    s = s + np.where(lying[case.block], size * rng.normal(size=s.size), 0.0)
    found = case.fit(s, 2)
    assert not (found.certain & ~lying).any()
    assert found.credible.any()
    near = np.abs((found.xi[found.credible] - xi) @ case.f.T) <= found.error[found.credible] * (1.0 + 1e-9)
    assert near.all(axis=1).any()


def test_a_large_lie_is_certain_and_more_liars_than_allowed_leave_no_credible_fit() -> None:
    rng = np.random.default_rng(3)
    case = Problem(rng)
    _, s = case.honest(rng)
    one, three = s.copy(), s.copy()
    one[case.block == 2] += 1e3
    assert np.flatnonzero(case.fit(one, 2).certain).tolist() == [2]
    for j in (0, 2, 5):
        three[case.block == j] += 1e3 * (j + 1)
    found = case.fit(three, 2)
    assert not found.credible.any()
    assert not found.certain.any()
    assert found.contradicted[[0, 2, 5]].all()


def test_blocks_without_rows_and_nothing_at_all() -> None:
    B, s = np.array([[1.0], [2.0]]), np.array([0.2, 0.1])
    found = fits(B, s, np.array([1, 3]), 5, 1, np.eye(1))
    assert found.left_out.shape == (2, 5)
    assert not found.left_out[:, [0, 2, 4]].any()
    nothing = fits(np.zeros((0, 1)), np.zeros(0), np.zeros(0, dtype=np.intp), 5, 1, np.eye(1))
    assert nothing.xi.tolist() == [[0.0]]
    assert nothing.error.tolist() == [[1.0]]
    assert nothing.credible.all()


def test_too_many_sets_are_refused() -> None:
    B = np.ones((20, 1))
    with refused(DesignInfeasible, "too-many"):
        fits(B, np.zeros(20), np.arange(20), 20, 5, np.eye(1), most=100)

"""Gaussian noise: minimum-variance estimates, chi-square test, choice among hypotheses.

    z = Phi x + v + e,    v ~ N(0, P)

The residual of the minimum-variance estimate has the *singular* covariance
`P - Phi (Phi^T P^-1 Phi)^-1 Phi^T`, of rank N - n. Its standardised square sum g is therefore chi-square with
N - n degrees of freedom. lee2018 prints N, which gives far fewer false alarms than specified and misses
attacks: docs/errata/lee2018-chapter-2.md.

Source: lee2018, section 2.2.3.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtr, chdtrc, chdtri, gammaln, xlogy

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable, no_choice, raise_if_any
from gridsec.secure.decode.stacks import MOST_SUBSETS, Stack, subsets

# Terms of the continued fraction; for arguments beyond the largest double's logarithm two would suffice.
_TERMS = 20
# Upper limit of the argument.
_MOST = 1e300


def log_density(g: Floats, k: Floats) -> Floats:
    """Logarithm of the density of a chi-square variable at g >= 0 with k degrees of freedom.

    ``(k / 2 - 1) ln g - g / 2 - (k / 2) ln 2 - ln Gamma(k / 2)``
    """
    g, half = np.minimum(g, _MOST), 0.5 * k
    return np.asarray(xlogy(half - 1.0, g) - 0.5 * g - half * np.log(2.0) - gammaln(half))


def log_tail(g: Floats, k: Floats) -> Floats:
    """Logarithm of the probability that a chi-square variable with k degrees of freedom exceeds g >= 0.

    Where the probability itself underflows, by the continued fraction of the incomplete gamma function.

    Source: NIST Digital Library of Mathematical Functions, 8.9.2.
    """
    g = np.minimum(g, _MOST)
    above, below = chdtrc(k, g), chdtr(k, g)
    with np.errstate(divide="ignore"):
        likely = np.where(below < 0.5, np.log1p(-below), np.log(above))
    return np.where(above > np.finfo(np.float64).tiny, likely, _far(0.5 * g, 0.5 * k))


def _far(x: Floats, a: Floats) -> Floats:
    """``ln(Gamma(a, x) / Gamma(a))`` for x far beyond a."""
    x = np.maximum(x, a + 2.0 * _TERMS)
    fraction = np.zeros(np.broadcast(x, a).shape)
    for j in range(_TERMS, 0, -1):
        fraction = j * (j - a) / (x + 2.0 * j + 1.0 - a - fraction)
    return np.asarray(xlogy(a, x) - x - gammaln(a) - np.log(x + 1.0 - a - fraction))


Rule = Literal["density", "tail"]


@dataclass(frozen=True, slots=True, eq=False)
class Test:
    """Least squares and chi-square test on one set of sensors."""

    __test__ = False

    estimator: Floats  # (n, N) Psi: the estimate is `Psi z`; zero in the columns of sensors left out
    covariance: Floats  # (n, n) covariance of the estimate's error
    # (N_kept - n, N) `W z` are independent standard normal numbers if there is no error; `g = |W z|^2`
    standardise: Floats

    @property
    def freedom(self) -> int:
        """Degrees of freedom of g: rows minus unknowns."""
        return int(self.standardise.shape[0])

    def threshold(self, false_alarm: float) -> float:
        """Delta_TH: the value that g exceeds with this probability without an error.

        false_alarm: delta, strictly between 0 and 1.
        Raises ValueError if `false_alarm` is outside (0, 1).
        """
        if not 0.0 < false_alarm < 1.0:
            raise InputInvalid.of("out-of-range", f"false_alarm is {false_alarm}; it must lie in (0, 1)")
        return float(chdtri(self.freedom, false_alarm))


@dataclass(frozen=True, slots=True, eq=False)
class Verdicts:
    """Result of the chi-square test for a batch of measurements."""

    x: Floats  # (…, n) estimates
    g: Floats  # (…) square sums of the standardised residuals
    alarm: Bools  # (…) True if g exceeds the threshold or is NaN


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """The C(p, q) tests of Algorithm 2.3; hypothesis i: only the sensors in `kept[i]` are free of error."""

    kept: Ints  # (S, p - q) sensors trusted in each hypothesis
    estimators: Floats  # (S, n, N)
    standardise: Floats  # (S, largest freedom, N) as in `Test`, filled up with zero rows
    freedom: Ints  # (S,) degrees of freedom of each hypothesis


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """Chosen hypothesis for each of a batch of measurements."""

    x: Floats  # (…, n) its estimate
    hypothesis: Ints  # (…) its index
    g: Floats  # (…, S) square sums of all hypotheses


def design_test(stack: Stack, P: Floats, kept: Ints | None = None) -> Test:
    """Prepare the minimum-variance estimate and the chi-square test.

        Psi = (Phi^T P^-1 Phi)^-1 Phi^T P^-1,   W = U^T L^-1,   P = L L^T,   U^T L^-1 Phi = 0,  U^T U = I

    so that `g = |W z|^2 = r^T P^-1 r = r^T Sigma^+ r` for the residual r and its covariance Sigma.

    P (N, N): covariance of the noise, positive definite.
    kept: sensors to use; all by default.
    Raises NotObservable if these sensors do not determine x, or determine it without redundancy, so that no
        reading could contradict it. DesignInfeasible if P is not positive definite.
    Source: lee2018 (2.2.16) to (2.2.20), Algorithm 2.2 with N - n degrees of freedom.
    """
    test = _least_squares(stack, P, kept)
    if test.freedom == 0:
        alone = list(range(stack.count)) if kept is None else np.asarray(kept).tolist()
        raise NotObservable(
            alone,
            stack.unknowns,
            f"sensors {alone} determine the state without redundancy: nothing could contradict them",
            code="no-redundancy",
        )
    return test


def _least_squares(stack: Stack, P: Floats, kept: Ints | None = None) -> Test:
    """`design_test` for any sensors that determine x, with or without redundancy."""
    use = np.arange(stack.count) if kept is None else np.asarray(kept)
    rows = stack.rows(use)
    n, N = stack.unknowns, stack.matrix.shape[0]
    try:
        L = np.linalg.cholesky(P[np.ix_(rows, rows)])
    except np.linalg.LinAlgError as failure:
        raise DesignInfeasible(
            "chi-square test", "the covariance P is not positive definite", code="not-definite"
        ) from failure
    white = solve_triangular(L, np.eye(rows.size), lower=True)
    Q, R = np.linalg.qr(white @ stack.matrix[rows], mode="complete")
    R = R[:n]
    rank = int(np.linalg.matrix_rank(R)) if R.size else 0
    if rank < n:
        raise NotObservable(
            use.tolist(),
            rank,
            f"sensors {use.tolist()} determine only {rank} of {n} unknowns",
            code="not-observable",
        )
    estimator, standardise = np.zeros((n, N)), np.zeros((rows.size - n, N))
    root = solve_triangular(R, np.eye(n))
    estimator[:, rows] = root @ Q[:, :n].T @ white
    standardise[:, rows] = Q[:, n:].T @ white
    return Test(frozen(estimator), frozen(root @ root.T), frozen(standardise))


def residual_covariance(stack: Stack, P: Floats) -> Floats:
    """Covariance of the residual, `P - Phi (Phi^T P^-1 Phi)^-1 Phi^T`, of rank N - n, so not invertible.

    stack, P: as in `design_test`.
    Source: lee2018 (2.2.20).
    """
    return np.asarray(P - stack.matrix @ _least_squares(stack, P).covariance @ stack.matrix.T)


def detect(test: Test, z: Floats, *, false_alarm: float) -> Verdicts:
    """Chi-square test for the presence of an error.

    z (…, N). false_alarm: delta, probability of an alarm without an error, strictly between 0 and 1.
    Measurements that are not finite alarm.
    Source: lee2018, Algorithm 2.2, with the degrees of freedom corrected.
    """
    g = np.square(z @ test.standardise.T).sum(axis=-1)
    return Verdicts(np.asarray(z @ test.estimator.T), g, np.asarray(~(g <= test.threshold(false_alarm))))


def design_hypotheses(stack: Stack, P: Floats, q: int, *, most: int = MOST_SUBSETS) -> Hypotheses:
    """Prepare Algorithm 2.3: a test for every set of p - q sensors.

    stack, P: as in `design_test`.
    q: largest number of sensors in error.
    Raises NotObservable if a set of p - q sensors does not determine x, or determines it without redundancy,
        so that no reading could contradict it. DesignInfeasible if there are more than `most` sets, or P is
        not positive definite.
    """
    kept = subsets(stack.count, stack.count - q, most)
    tests = [design_test(stack, P, k) for k in kept]
    freedom = np.array([t.freedom for t in tests], dtype=np.intp)
    wide = np.zeros((len(tests), int(freedom.max()), stack.matrix.shape[0]))
    for i, t in enumerate(tests):
        wide[i, : t.freedom] = t.standardise
    estimators = np.stack([t.estimator for t in tests])
    return Hypotheses(frozen_ints(kept), frozen(estimators), frozen(wide), frozen_ints(freedom))


def choose(hypotheses: Hypotheses, z: Floats, *, rule: Rule, freedom: Ints | None = None) -> Chosen:
    """Choose the set of sensors assumed free of error, and its estimate.

    z (…, N).
    rule: "density": the paper's, the largest chi-square density at g; it penalises residuals that are too
        small (its Remark 2.2.3). "tail": the largest probability of a g at least this large; for equal
        degrees of freedom the smallest g, the maximum likelihood of z itself over x, e and the hypothesis.
    freedom (S,): degrees of freedom in place of the correct ones; for comparisons with the paper's.
    Raises ValueError if `rule` is unknown.
    Source: lee2018, Algorithm 2.3 and (2.2.21), with the degrees of freedom corrected.
    """
    raise_if_any(no_choice("rule", get_args(Rule), rule))
    S, width, N = hypotheses.standardise.shape
    flat = np.asarray(z, dtype=np.float64) @ hypotheses.standardise.reshape(S * width, N).T
    g = np.square(flat).reshape(*flat.shape[:-1], S, width).sum(axis=-1)
    k = (hypotheses.freedom if freedom is None else freedom).astype(np.float64)
    # Logarithms, because under a real attack every wrong hypothesis underflows.
    score = log_density(g, k) if rule == "density" else log_tail(g, k)
    best = np.argmax(score, axis=-1)
    x = np.einsum("...nj,...j->...n", hypotheses.estimators[best], z)
    return Chosen(x, np.asarray(best), g)

"""Rise of J by each accusation, for all meters at once.

J, K, Q and g are those of `gridsec.estimators.snapshot.identification`. An accusation changes K by a matrix
of rank one, false powers by one of rank two: by the determinant lemma and Woodbury's formula every rise of J
follows from Q and g without a system larger than two by two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import log

import numpy as np
from scipy.special import chdtri, ndtri

from gridsec import errors
from gridsec.arrays import Bools, Floats, Ints, frozen, submatrix

# Determinants are positive; rounding may make them less.
_TINY = float(np.finfo(np.float64).tiny)
MOST = 8
"""Largest set of errors that are alike: larger ones are too many and gain little."""
Curved = Callable[[Floats, Bools], Floats]
_PASSES, _LITTLE = 2, 1.0
"""Largest number of linearisations, and change of J that ends them."""
_SUSPICIOUS = 3.0
"""Standard deviations from which a meter is suspicious in the hypothesis without accusations."""
_OF_PAIRS = 0.2
"""Share of the false alarms for false powers where no single meter is suspicious enough."""


@dataclass(frozen=True, slots=True)
class ErrorPrior:
    """Prior of the manipulations."""

    size: float = 0.2  # standard deviation A of an error, squared pu: 0.2 is 10 % of the voltage
    each: float = 2.3  # cost of every accusation beside its freedom and the price of the set
    seen: tuple[float, float] = (4.0, 6.0)  # pseudo-counts of manipulated and honest meters, a and b
    false: float = 3.0  # cost of false powers beside their freedom, as minus twice a logarithm
    rate: float = 0.0095  # largest part of clean snapshots with an accusation, for errors as in the model
    like: float = 20.0  # largest likelihood ratio of the best to a reported hypothesis
    amplitude: float = 0.06  # standard deviation of a common error, squared pu
    differ: float = 0.15  # part of it by which each differs
    apart: float = 4.0  # additional cost of each error after the first if independent
    pair: float = 5.0  # additional cost of the second equal error
    more: float = 2.0  # additional cost of each further equal error
    load: float = 5.5  # cost of a load that does not exist, beside the choice of the customer

    def __post_init__(self) -> None:
        if min(self.size, self.amplitude, self.differ) <= 0.0:
            raise errors.InputInvalid(
                [errors.Problem("not-positive", "size, amplitude and differ must be positive")]
            )


@dataclass(frozen=True, slots=True, eq=False)
class FalsePowers:
    """Effects of customers' false powers on squared voltages. p meters, each at its customer's bus.

    A ValueError is raised if these are not all of the same p meters.
    """

    R: Floats  # (p, p) squared voltages by active powers, 2R of the feeder
    X: Floats  # (p, p) squared voltages by reactive powers, 2X of the feeder
    p: Floats  # (p,) standard deviation of each false active power, pu
    q: Floats  # (p,) standard deviation of each false reactive power, pu
    felt: Floats | None = None  # (MOST, p) largest entries of each column of R, sorted

    def __post_init__(self) -> None:
        count = self.p.size
        square = self.R.shape == self.X.shape == (count, count)
        felt = self.felt is None or self.felt.shape == (min(MOST, count), count)
        if not (square and self.q.shape == self.p.shape and felt):
            raise errors.InputInvalid(
                [errors.Problem("shape", "R, X, p, q and felt must be of the same meters")]
            )

    def claimed(self, p: Floats, q: Floats) -> FalsePowers:
        """Other powers (p,) of the same meters; values that depend on the feeder alone are reused."""
        return FalsePowers(self.R, self.X, p, q, largest_effects(self.R) if self.felt is None else self.felt)

    def of(self, available: Ints) -> FalsePowers:
        """For some of the meters."""
        R, X = (submatrix(each, available, available) for each in (self.R, self.X))
        return FalsePowers(R, X, self.p[available], self.q[available])


@dataclass(slots=True, eq=False)
class SnapshotHypothesis:
    """Hypothesis under way: accused meters L, false powers F, and what follows. p meters.

    Q itself is never needed: every change subtracts a matrix of rank one,

        Q = W^T W - V^T U

    so that a change costs O(p) beside one product with Q, and a copy almost nothing.
    """

    meters: Bools  # (p,) L
    powers: Bools  # (p,) F
    m: Floats  # (p,) readings minus the model
    W: Floats  # (p, p) whitens the readings without manipulations
    g: Floats  # (p,) ``Q m``
    diagonal: Floats  # (p,) diagonal of Q
    logdet: float  # ``ln det K`` less that without accusations
    fit: float  # ``m^T Q m``
    U: Floats  # (r, p) subtracted
    V: Floats  # (r, p) rows of U times numbers
    counts: tuple[int, int] = (0, 0)  # |L| and |F|
    rises: Floats | None = None  # (p,) `meter_rises`; None until computed

    @classmethod
    def without_accusations(cls, m: Floats, W: Floats) -> SnapshotHypothesis:
        """Hypothesis without accusations."""
        none, white = np.zeros(m.size, dtype=np.bool_), W @ m
        diagonal, nothing = np.einsum("ij,ij->j", W, W), np.empty((0, m.size))
        fit = float(white @ white)
        return cls(none, none.copy(), m, W, white @ W, diagonal, 0.0, fit, nothing, nothing)

    def copy(self) -> SnapshotHypothesis:
        """Copy that can be changed alone."""
        return replace(self, meters=self.meters.copy(), powers=self.powers.copy())

    @property
    def key(self) -> bytes:
        """L and F as a key of dictionaries."""
        return self.meters.tobytes() + self.powers.tobytes()

    def times(self, x: Floats) -> Floats:
        """Q x, (p,)."""
        return np.asarray((self.W @ x) @ self.W - (self.V @ x) @ self.U)

    def column(self, j: int) -> Floats:
        """Q e_j, (p,)."""
        return np.asarray(self.W[:, j] @ self.W - self.V[:, j] @ self.U)

    def rows(self, which: Ints) -> Floats:
        """Rows of Q of some meters, (k, p)."""
        return np.asarray(self.W[:, which].T @ self.W - self.V[:, which].T @ self.U)

    def change(self, q: Floats, delta: float, u_q: float, u_g: float) -> None:
        """Add ``delta u u^T`` to K, by q = Q u, ``u^T q`` and ``u^T g``."""
        pivot = max(1.0 + delta * u_q, _TINY)
        by = q * (delta / pivot)
        self.fit -= delta * u_g**2 / pivot
        self.logdet += log(pivot)
        self.g = self.g - u_g * by
        self.diagonal = self.diagonal - by * q
        self.U, self.V = np.concatenate((self.U, q[None])), np.concatenate((self.V, by[None]))
        self.rises = None


class LikelihoodProblem:
    """Readings, and possible manipulations."""

    def __init__(
        self,
        error_prior: ErrorPrior,
        start: SnapshotHypothesis,
        false: FalsePowers | None,
        curved: Curved | None,
    ) -> None:
        self.prior, self.false, self.curved = error_prior, false, curved
        diagonal, self.W = start.diagonal, start.W
        self.size, self.a2 = diagonal.size, error_prior.size**2
        # Of examined customers: B, and its products in the hypothesis without accusations.
        self.directions: dict[int, tuple[Floats, Floats, Floats]] = {}
        prices, least, self.rare = _charges(error_prior, self.size)
        # The meter with the least precise prediction is accused for the least freedom.
        first = max(0.0, least - float(prices[1]) - float(np.log1p(self.a2 * diagonal.min())))
        self.prices = prices + first
        self.prices[0] = 0.0

    @cached_property
    def felt(self) -> Floats:
        """Largest effects of each customer's load; see `FalsePowers`. ValueError without false powers."""
        if self.false is None:
            raise errors.InputInvalid([errors.Problem("missing", "there are no false powers")])
        return largest_effects(self.false.R) if self.false.felt is None else self.false.felt

    def quiet(self, g: Floats, diagonal: Floats) -> bool:
        """True if no meter would be accused and no power doubted."""
        pivot = 1.0 + self.a2 * diagonal
        accused = self.a2 * g**2 / pivot > np.log(pivot) + self.prices[1]
        return not (accused.any() or (self.false is not None and suspicious(g, diagonal).any()))

    def charge(self, count: int, false: int) -> float:
        """Cost of manipulated meters and false powers beside their freedom."""
        return float(self.prices[count]) + self.prior.false * false

    def cost(self, at: SnapshotHypothesis) -> float:
        """J."""
        return at.fit + at.logdet + self.charge(*at.counts)

    def meter_rises(self, at: SnapshotHypothesis) -> Floats:
        """Rise of J by accusing each meter, or by trusting it again, (p,); to be read only."""
        if at.rises is not None:
            return at.rises
        k, _ = at.counts
        now = self.prices[k]
        pivot = 1.0 + self.a2 * at.diagonal
        rise: Floats = np.log(pivot) - self.a2 * at.g**2 / pivot + (self.prices[min(k + 1, self.size)] - now)
        if k:
            on = at.meters.nonzero()[0]
            pivot = np.maximum(1.0 - self.a2 * at.diagonal[on], _TINY)
            less = np.log(pivot) + self.a2 * at.g[on] ** 2 / pivot + (self.prices[k - 1] - now)
            # Powers are false only where the meter lies.
            rise[on] = less
            if at.counts[1]:
                rise[at.powers] = np.inf
        at.rises = rise
        return rise

    def power_rises(self, at: SnapshotHypothesis, which: Ints) -> tuple[Floats, Floats]:
        """Rise of J by false powers of some customers, and the chi-square these explain, (k,) each.

        Their meters are accused with them where they are trusted.
        """
        k, _ = at.counts
        accused = float(self.prices[min(k + 1, self.size)] - self.prices[k])
        out = np.empty((2, which.size))
        # Few are examined: numbers are faster than short arrays.
        for n, c in enumerate(which.tolist()):
            (a, b, d), (s, t), (h, i) = self._against(at, c)
            pivot, rise, gain = 1.0, self.prior.false, 0.0
            if not at.meters[c]:
                # First the meter, which changes Q and g by rank one; then its customer's powers.
                g, pivot = float(at.g[c]), 1.0 + self.a2 * float(at.diagonal[c])
                by = self.a2 / pivot
                a, b, d = a - by * s * s, b - by * s * t, d - by * t * t
                h, i = h - by * g * s, i - by * g * t
                rise, gain = rise + accused, by * g * g
            det, more = _by_two(a + 1.0, b, d + 1.0, h, i)
            gain += more
            out[:, n] = np.inf if at.powers[c] else log(pivot * det) - gain + rise, gain
        return out[0], out[1]

    def trust_rises(self, at: SnapshotHypothesis, which: Ints) -> Floats:
        """Rise of J by trusting the powers of some customers again, (k,)."""
        out = np.empty(which.size)
        for n, c in enumerate(which.tolist()):
            (a, b, d), _, (h, i) = self._against(at, c)
            det, gain = _by_two(a - 1.0, b, d - 1.0, h, i)
            out[n] = log(det) - gain - self.prior.false
        return out

    def _against(self, at: SnapshotHypothesis, c: int) -> tuple[list[float], list[float], list[float]]:
        """``B^T Q B``, its three numbers, ``e^T Q B`` of the customer's own meter, and ``B^T g``."""
        if c not in self.directions:
            B = self.columns(c)
            white = np.array([self.W @ u for u in B])
            self.directions[c] = B, white @ white.T, white @ self.W[:, c]
        B, M, own = self.directions[c]
        if len(at.U):
            off, by = at.U @ B.T, B @ at.V.T
            M, own = M - by @ off, own - by @ at.U[:, c]
        (a, b), (_, d) = M.tolist()
        return [a, b, d], own.tolist(), (B @ at.g).tolist()

    def columns(self, c: int) -> Floats:
        """B of a customer, a row for each power, (2, p)."""
        if self.false is None:
            raise errors.InputInvalid([errors.Problem("missing", "there are no false powers")])
        return np.stack([self.false.R[:, c] * self.false.p[c], self.false.X[:, c] * self.false.q[c]])

    def linearise(self, at: SnapshotHypothesis) -> None:
        """Linearise about this hypothesis's powers, and once more where that changed much."""
        if self.curved is None:
            return
        for _ in range(_PASSES):
            before = at.fit
            at.m = self.curved(at.g, at.powers)
            at.g = at.times(at.m)
            at.fit, at.rises = float(at.m @ at.g), None
            if abs(at.fit - before) <= _LITTLE:
                return

    def toggle(self, at: SnapshotHypothesis, j: int) -> None:
        """Accuse a meter, or trust it again."""
        at.change(at.column(j), -self.a2 if at.meters[j] else self.a2, float(at.diagonal[j]), float(at.g[j]))
        at.meters[j] = not at.meters[j]
        at.counts = at.counts[0] + (1 if at.meters[j] else -1), at.counts[1]

    def doubt_powers(self, at: SnapshotHypothesis, c: int, sign: float = 1.0) -> None:
        """Doubt a customer's powers, or with `sign` -1 trust them again."""
        for u in self.directions[c][0] if c in self.directions else self.columns(c):
            q = at.times(u)
            at.change(q, sign, float(u @ q), float(u @ at.g))
        at.powers[c] = sign > 0
        at.counts = at.counts[0], at.counts[1] + int(sign)


@cache
def _charges(error_prior: ErrorPrior, meters: int) -> tuple[Floats, float, float]:
    """Costs of 0, 1, 2, … accusations, and the rare evidence of one meter and of a pair."""
    prices = frozen(_prices(meters, *error_prior.seen) + error_prior.each * np.arange(meters + 1))
    least = float(ndtri(error_prior.rate * (1.0 - _OF_PAIRS) / (2.0 * meters)) ** 2)
    return prices, least, float(chdtri(3, error_prior.rate * _OF_PAIRS / meters))


def _prices(meters: int, suspects: float, honest: float) -> Floats:
    """Costs by the prior over sets alone, but always rising."""
    k = np.arange(meters)
    each = np.maximum(2.0 * np.log((meters - 1 - k + honest) / (k + suspects)), 0.0)
    return frozen(np.concatenate([[0.0], np.cumsum(each)]))


def suspicious(g: Floats, diagonal: Floats) -> Bools:
    """Meters with leave-one-out residuals large enough to doubt their customers' powers."""
    return np.asarray(g**2 > _SUSPICIOUS**2 * diagonal)


def largest_effects(R: Floats) -> Floats:
    """Largest entries of each column of R, the largest first, (MOST, p) or all of fewer."""
    return frozen(-np.sort(-R, axis=0)[:MOST])


def _by_two(a: float, b: float, d: float, h: float, i: float) -> tuple[float, float]:
    """Determinant of ``[[a, b], [b, d]]``, and ``[h, i]`` times its inverse times ``[h, i]``."""
    det = max(a * d - b * b, _TINY)
    return det, (d * h * h - 2.0 * b * h * i + a * i * i) / det

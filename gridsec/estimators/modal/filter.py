"""Kalman filter of the residuals: independent filters of two states, one for each mode.

With ``z = U' m`` of `gridsec.estimators.modal.model`, each mode has the states (w, b) and the reading ``z = w
+ b + e``:

    predict   (w, b) <- R (w, b),  P <- R P R + (1 - R^2) diag(q, s),  R = diag(rho, rho_b)
    update    nu = z - w - b,  v = Pww + 2 Pwb + Pbb + 1,  k = (Pww + Pwb, Pwb + Pbb) / v
              (w, b) += k nu,  P -= v k k'

where q and s are the variances of w and b, ``rho = exp(-h / T)``, ``rho_b = exp(-h / T_b)`` for an interval
of h seconds. Where reported powers jump, the variance of w gains ``j lam`` besides (`doubts`). The cost is
O(t) and the product ``U' m``. The filter is exact for ``B = kappa D``, and with
`gridsec.estimators.modal.static` for every B.

**Missing readings** couple the modes: `gridsec.estimators.modal.full` follows the exact filter then. The
covariance here stays that of complete readings. It is a lower bound of the exact one: ``diag(1 / v)`` is
an upper bound of the information of every innovation. Its gains are used as signatures of faults.

References
----------
Anderson and Moore, Optimal Filtering, 1979, chapter 3.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import exp

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of
from gridsec.errors import InputInvalid, Problem
from gridsec.estimators.modal.model import Modes


@dataclass(frozen=True, slots=True)
class Interval:
    """Interval between two ticks.

    Attributes
    ----------
    h
        Its length, s.
    jump
        Variance of a jump of the loads' errors within it, in that of the loads, 1.
    """

    h: float
    jump: float = 0.0

    def decay(self, modes: Modes) -> tuple[float, float]:
        """Factors rho and rho_b."""
        return exp(-self.h / modes.model.time_s), exp(-self.h / modes.model.fixed_s)

    def varied(self, modes: Modes, before: float, rest: float = 1.0) -> float:
        """Variance of w after the interval by that before it and that at rest, in that of the loads, 1."""
        rho2 = self.decay(modes)[0] ** 2
        return rho2 * before + (1.0 - rho2) * rest + self.jump


@dataclass(frozen=True, slots=True, eq=False)
class Full:
    """Posterior of w and b at the t members, after the last reading.

    Attributes
    ----------
    mean : (2, t)
        Means of w and b.
    blocks : (t, t) each
        Covariance of w, of w with b, and of b. Apart, they fit the cache, and no tick allocates the whole.
    seen : (t,)
        Members with a reading at the last tick.
    kept : (3, t)
        As ``cov`` of `FilterState`, of the readings that were there, with its diagonal kept at every tick.
    complete
        Ticks with all readings since the last one without.
    share : (t,) or None
        Part of each mode's information that was read; None where all readings are there.
    since
        Ticks since ``share`` was computed.
    unknown : (t, k) or None
        Directions of the residuals that were unknown at the last tick, times their standard deviations.
    m : (t,) or None
        Residuals of that tick; None before the first.
    """

    mean: Floats
    blocks: tuple[Floats, Floats, Floats] = field(repr=False)
    seen: Bools
    kept: Floats
    complete: int
    share: Floats | None = field(default=None, repr=False)
    since: int = 0
    unknown: Floats | None = field(default=None, repr=False)
    m: Floats | None = field(default=None, repr=False)

    @property
    def rest(self) -> Floats | None:
        """Residuals of the last tick less the means of w and b, (t,); None without unknown directions."""
        return None if self.unknown is None or self.m is None else self.m - self.mean[0] - self.mean[1]

    @property
    def cov(self) -> Floats:
        """Covariance of (w, b), (2 t, 2 t)."""
        w, both, b = self.blocks
        return np.block([[w, both], [both.T, b]])

    @property
    def whole(self) -> Floats:
        """Covariance of w + b, (t, t)."""
        w, both, b = self.blocks
        return np.asarray(w + both + both.T + b)

    @property
    def variance(self) -> Floats:
        """Variance of w + b, (t,)."""
        w, both, b = (each.diagonal() for each in self.blocks)
        return np.asarray(w + 2.0 * both + b)

    def changed(self, mean: Floats, cov: Floats) -> Full:
        """The same with other means (2, t) and another covariance (2 t, 2 t)."""
        return replace(self, mean=mean, blocks=blocks(cov))


def blocks(cov: Floats) -> tuple[Floats, Floats, Floats]:
    """Blocks (t, t) of a covariance of (w, b), (2 t, 2 t)."""
    t = len(cov) // 2
    return cov[:t, :t].copy(), cov[:t, t:].copy(), cov[t:, t:].copy()


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """Posterior of w and b in the modes, after the last reading. t modes.

    Attributes
    ----------
    t
        Time of the last reading, s.
    mean : (2, t)
        Means of w and b.
    cov : (3, t)
        Variance of w, covariance of w and b, variance of b.
    full
        Exact posterior where a reading has been missing; ``mean`` has no meaning then. Else None.
    """

    t: float
    mean: Floats
    cov: Floats
    full: Full | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Exact innovation nu of the n members with a reading.

    Attributes
    ----------
    rows : (n,)
        The members.
    half : (n, n)
        Lower Cholesky factor L of the covariance of nu.
    gain : (2 t, n)
        ``P H' L'^-1``; the means of (w, b) move by ``gain white``.
    white : (n,)
        ``L^-1 nu``.
    precision : (t,)
        Diagonal of ``V^-1``; 0 without a reading.
    score : (n,)
        ``V^-1 nu``.
    """

    rows: Ints
    half: Floats = field(repr=False)
    gain: Floats = field(repr=False)
    white: Floats = field(repr=False)
    precision: Floats = field(repr=False)
    score: Floats = field(repr=False)


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """One step of the filter. t modes.

    Attributes
    ----------
    decay : (2,)
        Factors rho and rho_b of the interval.
    gap
        The interval.
    innovation, variance : (t,)
        nu, zero without a meaning where ``score`` is given, and v.
    gain : (2, t)
        k of w and of b.
    slower : (2, t) or None
        Gain for the signatures of faults, where readings are or were missing.
    exact
        The exact innovation, where the filter is not that of the modes.
    score : (t,) or None
        Its score in the modes.
    seen : (t,) or None
        Members with a reading; None: all.
    """

    decay: tuple[float, float]
    gap: Interval
    innovation: Floats
    variance: Floats
    gain: Floats
    slower: Floats | None = None
    exact: Innovation | None = None
    score: Floats | None = None
    seen: Bools | None = None


def start(modes: Modes, t: float) -> FilterState:
    """State before the first reading: the prior.

    Parameters
    ----------
    modes
        The modes.
    t
        Time of the first reading, s.
    """
    zero = np.zeros(modes.size)
    return FilterState(t, np.zeros((2, modes.size)), np.stack([modes.varying, zero, modes.lasting]))


def step(  # noqa: PLR0917  # the state, and one tick
    modes: Modes, state: FilterState, t: float, m: Floats, seen: Bools | None = None, jump: float = 0.0
) -> tuple[FilterState, Update]:
    """Take in the residuals of one tick.

    Parameters
    ----------
    modes, state
        The modes, and the state after the last tick.
    t
        Time, s; not before ``state.t``. The interval may change from tick to tick.
    m : (t,)
        Residuals of the members, squared pu; any finite value where not seen.
    seen : (t,)
        Members with a reading; None: all.
    jump
        As in `Interval`.

    Raises
    ------
    ValueError
        If t is before the last reading or not a number.
    """
    h = t - state.t
    if not h >= 0.0:
        raise InputInvalid([Problem("order", f"t is {t}; it must not be before {state.t}")])
    gap = Interval(h, jump)
    rho, rho_b = gap.decay(modes)
    cov, shared, v = predicted(modes, state.cov, rho, rho_b, jump)
    whole = seen is None or all_of(seen)
    gain, mean = shared / v, state.mean
    if state.full is None:
        if not whole:
            raise InputInvalid([Problem("missing", "missing readings need the full covariance")])
        mean = mean * np.array((rho, rho_b))[:, None]
        nu = m @ modes.U
        nu -= mean[0]
        nu -= mean[1]
        mean += gain * nu
    else:
        nu = np.zeros(v.size)
    cov[:2] -= gain * shared[0]
    cov[2] -= gain[1] * shared[1]
    seen = None if whole else seen
    return FilterState(t, mean, cov), Update((rho, rho_b), gap, nu, v, gain, seen=seen)


def predicted(
    modes: Modes, cov: Floats, rho: float, rho_b: float, jump: float = 0.0
) -> tuple[Floats, Floats, Floats]:
    """Covariance (3, t) before a tick, that of (w, b) with the innovation (2, t), and v (t,).

    Parameters
    ----------
    modes
        The modes.
    cov : (3, t)
        Covariance after the last tick.
    rho, rho_b, jump
        Factors and jump of the interval.
    """
    cov = cov * np.array((rho * rho, rho * rho_b, rho_b * rho_b))[:, None]
    cov[0] += (1.0 - rho * rho) * modes.varying
    if jump:
        cov[0] += jump * modes.loads
    cov[2] += (1.0 - rho_b * rho_b) * modes.lasting
    shared = cov[:2] + cov[1:]
    v = shared[0] + shared[1]
    v += 1.0
    return cov, shared, v

"""Manipulations that no meter's own test of the sequential monitor notices: linear programs.

A constant lie a of the meters J, squared pu, moves the leave-one-out residual of meter j on scale s by
``(Q_s a)_j / Q_s,jj`` and the reconstruction of bus b by ``S_b: Q_s a``. With the limits l of `Limits.limit`

    maximise  S_b: Q_s a   subject to   |(Q_s a)_j| <= share l_s,j Q_s,jj   for all j and s,   a = 0 outside J

and ``|d' Q_s a| <= share sigmas sqrt(d' Q_s d)`` for every phase d of the busbar. The remaining share of each
limit is the room of honest residuals.

References
----------
docs/theory-sequential.md, section 3; `gridsec.planning.detectability` has the same inequalities for small
numbers of meters, with the smallest set as an unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.special import ndtr
from scipy.stats import chi2

from gridsec.arrays import Floats, Ints
from gridsec.estimators.sequential import SequentialDesign, SequentialState
from gridsec.estimators.sequential.posterior import Posterior, condition
from gridsec.estimators.sequential.time_scales import Scales

SHARE = 0.7
"""Part of every limit that a lie uses."""
LARGEST = 0.2
"""Largest lie, squared pu: beyond about 10 % of the voltage no reading is plausible."""
TARGETS = 4
"""Buses whose reconstruction is tried, those that other meters know least."""
_ROUNDS = 6
"""Rounds in which a greedy set grows."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearTests:
    """Linear tests of the monitor at one moment, all meters trusted. p meters, s scales, b phases.

    Attributes
    ----------
    rows : (r, p)
        Tests, each divided by its limit: ``|rows a| <= 1`` is unnoticed.
    gain : (n, p)
        Shift of every bus's reconstruction per lie, on the longest scale.
    fits : (s,)
        All meters, on each scale.
    buses : (p,)
        Bus of each meter.
    """

    rows: Floats
    gain: Floats
    fits: tuple[Posterior, ...]
    buses: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Stealthy:
    """The largest unnoticed lie of a set of meters.

    Attributes
    ----------
    meters : (k,)
        The set J.
    lie : (p,)
        a, squared pu.
    error
        Shift of the reconstruction at the target, squared pu.
    """

    meters: Ints
    lie: Floats
    error: float


def linear_tests(design: SequentialDesign, state: SequentialState, *, busbar: bool = True) -> LinearTests:
    """Tests of the present moment.

    Parameters
    ----------
    design, state
        The monitor, calm.
    busbar
        Whether the busbar's test is one of them.
    """
    scales = Scales(design, state.uncertainty, state.window, state.learned, state.model_error)
    every = np.ones(design.plant.meters.size, dtype=np.bool_)
    rows, fits = [], []
    for s in range(len(design.lengths)):
        here = scales[s]
        now = condition(here.prior, here.noise, every)
        Q, std = now.Q, np.sqrt(1.0 / now.diagonal())
        fits.append(now)
        rows.append(Q * (std**2 / here.limits.limit(std))[:, None])
        if busbar:
            together = design.busbar_incidence.T @ Q
            form = np.sqrt(np.einsum("bp,pb->b", together, design.busbar_incidence))
            rows.append(together[form > 0.0] / (design.sigmas[s] * form[form > 0.0])[:, None])
    last = fits[-1]
    return LinearTests(np.vstack(rows), last.prior.covariance @ last.Q, tuple(fits), design.prior.meters)


def largest(
    given: LinearTests, meters: Ints, *, share: float = SHARE, targets: Ints | None = None
) -> Stealthy:
    """The largest error of a reconstruction by unnoticed lies of some meters.

    Parameters
    ----------
    given
        The tests.
    meters : (k,)
        J.
    share
        Part of the limits.
    targets : (t,)
        Buses; by default those of J that the prior knows least.
    """
    best = Stealthy(meters, np.zeros(given.buses.size), 0.0)
    for bus in _targets(given, meters) if targets is None else targets:
        a, error, _ = _program(given, meters, int(bus), share)
        if error > best.error:
            best = Stealthy(meters, a, error)
    return best


def greedy(given: LinearTests, count: int, *, start: int, share: float = SHARE) -> Stealthy:
    """A set grown towards one meter's bus: columns of largest reduced cost join until `count` lie.

    Parameters
    ----------
    given
        The tests.
    count
        Number of manipulated meters.
    start
        The meter whose bus is the target.
    share
        Part of the limits.
    """
    bus, chosen = int(given.buses[start]), np.array([start], dtype=np.intp)
    for k in range(_ROUNDS):
        a, error, left = _program(given, chosen, bus, share)
        size = count if k == _ROUNDS - 1 else 1 + (count - 1) * (k + 1) // _ROUNDS
        left[chosen] = np.inf  # only others join
        more = np.argsort(-left, kind="stable")[: max(size, chosen.size)]
        chosen = np.sort(more).astype(np.intp)
    a, error, _ = _program(given, chosen, bus, share)
    return Stealthy(chosen, a, error)


def within_misfit(given: LinearTests, meters: Ints, budget: float, *, share: float = SHARE) -> Stealthy:
    """The largest error of a reconstruction by lies that the misfit of all meters does not show either.

    ``a_J = sqrt(budget / g' Q_JJ^-1 g) Q_JJ^-1 g`` maximises ``g a`` within ``a' Q a <= budget``, Q of the
    longest scale; it is shrunk until every linear test is within its share.

    Parameters
    ----------
    given, meters, share
        As in `largest`.
    budget
        Addition to the misfit that stays unnoticed, 1.
    """
    Q, best = given.fits[-1].Q[np.ix_(meters, meters)], Stealthy(meters, np.zeros(given.buses.size), 0.0)
    for bus in given.buses[meters]:
        gain = given.gain[bus, meters]
        part = np.linalg.solve(Q, gain)
        part *= np.sqrt(budget / (gain @ part))
        part *= min(1.0, share / np.abs(given.rows[:, meters] @ part).max())
        if gain @ part > best.error:
            a = np.zeros(given.buses.size)
            a[meters] = part
            best = Stealthy(meters, a, float(gain @ part))
    return best


def _targets(given: LinearTests, meters: Ints) -> Ints:
    variance = given.fits[-1].prior.variance[given.buses[meters]]
    return given.buses[meters[np.argsort(-variance, kind="stable")[:TARGETS]]]


def _program(given: LinearTests, meters: Ints, bus: int, share: float) -> tuple[Floats, float, Floats]:
    """Lies (p,), the error of the reconstruction, and the size of every meter's reduced cost, (p,)."""
    rows, gain = given.rows[:, meters], given.gain[bus]
    found = linprog(
        -gain[meters],
        A_ub=np.vstack([rows, -rows]),
        b_ub=np.full(2 * len(rows), share),
        bounds=(-LARGEST, LARGEST),
        method="highs",
    )
    if found.x is None:
        raise RuntimeError(f"linear program: {found.message}")
    y = -found.ineqlin.marginals
    reduced = gain - (y[: len(rows)] - y[len(rows) :]) @ given.rows
    a = np.zeros(gain.size)
    a[meters] = found.x
    return a, float(gain @ a), np.abs(reduced)


def misfit(given: LinearTests, state: SequentialState) -> float:
    """``m' Q m`` of all meters on the longest scale, 1.

    Parameters
    ----------
    given
        The tests of a calm moment.
    state
        The state with the window in question.
    """
    m = state.window.sums[-1] / np.maximum(state.window.counts[-1], 1)
    return float(m @ given.fits[-1].weights(m))


def misfit_limit(design: SequentialDesign) -> float:
    """Quantile of the misfit of all meters, with the probability of the longest scale's own limit.

    Parameters
    ----------
    design
        The monitor.
    """
    return float(chi2.isf(2.0 * ndtr(-design.sigmas[-1]), design.plant.meters.size))

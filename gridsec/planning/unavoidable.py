"""Largest errors of a reconstruction that faults hide: from given tests, and from every test.

Faults theta of a coalition move the residuals by ``C theta`` and the model by ``E theta``. The reconstruction
is the model plus ``G`` times the residuals, so that it moves at place x by ``g_x theta``, g = E + G C.

**Every test.** Honest residuals are m ~ N(0, V). By the lemma of Neyman and Pearson no test with the
probability alpha of a false alarm detects a known displacement a with more than

    Phi(sqrt(a' V^-1 a) - z),   z = -Phi^-1(alpha).

So each fault with ``theta' F theta <= z^2``, F = C' V^-1 C, stays undetected at least every second time, and
the largest error that any test leaves at place x is ``z sqrt(g_x F^-1 g_x')``.

**Tests that do not know the coalition.** A test with power beyond one half against every displacement of the
norm rho in d dimensions has at least the rho of chi-square: the median of noncentral chi-square with d
degrees of freedom and noncentrality rho^2 equals its limit at alpha.

**Given tests**: linear ones, ``|R a| <= 1``, and quadratic ones, ``|L_i a| <= 1``. The largest hidden error
is the second-order cone program

    maximise g_x theta   subject to   |R C theta| <= share, |L_i C theta| <= share, least <= theta <= most.

References
----------
Lehmann and Romano, Testing Statistical Hypotheses, 2005, theorem 3.2.1 and section 8.2.
docs/theory-studies.md, section 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.sparse import csc_array
from scipy.special import chdtri, chndtr, ndtr, ndtri

from gridsec.arrays import Floats, Ints
from gridsec.errors import DesignInfeasible, InputInvalid, Problem
from gridsec.estimators.front.design import YEAR_S

__all__ = [
    "AcceptanceRegion",
    "ConeProgram",
    "Faults",
    "Hidden",
    "blind_norm",
    "deviations",
    "every_test",
    "unavoidable",
]

_INVISIBLE = 1e-9
"""Relative norm below which a combination of faults does not move the residuals."""
_EXACT = 1e-9
"""Relative tolerance of the cone program: hidden errors are compared to 0.1 %."""


@dataclass(frozen=True, slots=True, eq=False)
class Faults:
    """Faults of a coalition. n places, p meters, q faults.

    Attributes
    ----------
    signature : (p, q)
        C: change of the residuals by each fault, squared pu per unit.
    effect : (n, q)
        E: change of the model at each place, squared pu per unit; 0 for false voltages.
    least, most : (q,)
        Range of each fault, unit of the fault.
    """

    signature: Floats
    effect: Floats
    least: Floats
    most: Floats

    @staticmethod
    def voltages(meters: Ints, shape: tuple[int, int], most: float) -> Faults:
        """False voltages of some meters.

        Parameters
        ----------
        meters : (q,)
            The meters.
        shape
            Numbers n of places and p of meters.
        most
            Largest displacement, squared pu.
        """
        places, count = shape
        ends = np.full(meters.size, most)
        return Faults(np.eye(count)[:, meters], np.zeros((places, meters.size)), -ends, ends)

    def joined(self, other: Faults) -> Faults:
        """These faults and others."""
        names = ("signature", "effect", "least", "most")
        return Faults(*(np.concatenate([getattr(self, k), getattr(other, k)], axis=-1) for k in names))

    def gain(self, weights: Floats) -> Floats:
        """Change of the reconstruction by each fault, (n, q), for weights G (n, p) of the residuals."""
        return np.asarray(self.effect + weights @ self.signature)


@dataclass(frozen=True, slots=True, eq=False)
class AcceptanceRegion:
    """Residuals that linear and quadratic tests accept at one moment. n places, p meters.

    Attributes
    ----------
    rows : (r, p)
        R, in units of the limits.
    forms
        L_i, (k_i, p) each, in units of the limits.
    weights : (n, p)
        G of the reconstruction.
    """

    rows: Floats
    forms: tuple[Floats, ...]
    weights: Floats = field(repr=False)

    def statistic(self, displacement: Floats) -> float:
        """Largest statistic of a displacement (p,) of the residuals, in units of its limit."""
        linear = float(np.abs(self.rows @ displacement).max(initial=0.0))
        return max([linear, *(float(np.linalg.norm(form @ displacement)) for form in self.forms)])


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """Largest hidden effect. q faults.

    Attributes
    ----------
    amounts : (q,)
        theta.
    size
        ``g theta``.
    """

    amounts: Floats
    size: float


def deviations(alarms_per_year: float, seconds: float) -> float:
    """Limit z of a test that looks once in a period, one-sided, with a rate of false alarms.

    Parameters
    ----------
    alarms_per_year
        False alarms in a year.
    seconds
        The period, s.

    Raises
    ------
    InputInvalid
        If one of them is not positive.
    """
    if not (alarms_per_year > 0.0 and seconds > 0.0):
        raise InputInvalid([Problem("not-positive", "a rate and a period must be positive")])
    return -float(ndtri(min(alarms_per_year * seconds / YEAR_S, 0.5)))


def blind_norm(dimensions: int, z: float) -> float:
    """Norm rho at which chi-square detects every second displacement.

    Parameters
    ----------
    dimensions
        d, at least 1.
    z
        The limit in standard deviations of one dimension, one-sided.
    """
    limit = float(chdtri(dimensions, ndtr(-z)))

    def beyond(rho: float) -> float:
        return float(chndtr(limit, dimensions, rho * rho)) - 0.5

    return float(brentq(beyond, 0.0, 2.0 * np.sqrt(limit) + 2.0)) if beyond(0.0) > 0.0 else 0.0


def unavoidable(covariance: Floats, prior: Floats, faults: Faults, z: float) -> Floats:
    """Largest error that every test leaves, at each place, squared pu, (n,).

    Ranges of the faults are not used; `every_test` uses them.

    Parameters
    ----------
    covariance : (p, p)
        V of the honest residuals.
    prior : (n, p)
        Covariance of the places' voltages with the residuals; G = prior V^-1.
    faults
        The coalition's faults. An invisible combination counts as no fault.
    z
        Standard deviations of `deviations`.
    """
    region = every_test(covariance, prior, z)
    seen = region.forms[0] @ faults.signature
    unit = np.linalg.norm(seen, axis=0)
    unit = 1.0 / np.where(unit > 0.0, unit, 1.0)
    gain = faults.gain(region.weights) * unit
    return np.asarray(np.linalg.norm(gain @ np.linalg.pinv(seen * unit, rcond=_INVISIBLE), axis=1))


def every_test(covariance: Floats, prior: Floats, z: float) -> AcceptanceRegion:
    """Displacements that every test leaves undetected at least every second time.

    Parameters
    ----------
    covariance, prior, z
        As in `unavoidable`.
    """
    half = np.linalg.cholesky(covariance)
    white = solve_triangular(half, np.eye(len(half)), lower=True)
    return AcceptanceRegion(np.zeros((0, len(half))), (white / z,), prior @ white.T @ white)


class ConeProgram:
    """Largest effect of a coalition's faults that all tests leave hidden.

    Parameters
    ----------
    tests, faults
        The tests, and the coalition's faults.
    """

    def __init__(self, tests: AcceptanceRegion, faults: Faults) -> None:
        self.faults = faults
        rows, forms = tests.rows @ faults.signature, [form @ faults.signature for form in tests.forms]
        # A form counts by its triangular factor: q rows in place of p.
        forms = [
            np.asarray(np.linalg.qr(form, mode="r")) if len(form) > form.shape[1] else form for form in forms
        ]
        largest = np.abs(rows).max(axis=0, initial=0.0)
        for form in forms:
            largest = np.maximum(largest, np.linalg.norm(form, axis=0))
        self.unit = 1.0 / np.maximum(largest, _INVISIBLE)
        self.rows, self.forms = rows * self.unit, [form * self.unit for form in forms]

    def __call__(self, effect: Floats, share: float = 1.0) -> Hidden:
        """Faults with the largest effect.

        Parameters
        ----------
        effect : (q,)
            g: a row of `Faults.gain`, or a unit vector for the size of one fault.
        share
            Part of every limit that the displacement uses; the rest is the room of honest residuals.

        Raises
        ------
        DesignInfeasible
            If the solver fails.
        """
        import clarabel

        g, least, most = effect * self.unit, self.faults.least / self.unit, self.faults.most / self.unit
        scale = float(np.abs(g).max(initial=0.0))
        if scale == 0.0:
            return Hidden(np.zeros(g.size), 0.0)
        eye, r = np.eye(g.size), len(self.rows)
        A, b = [self.rows, -self.rows, eye, -eye], [np.full(2 * r, share), most, -least]
        cones = [clarabel.NonnegativeConeT(2 * r + 2 * g.size)]
        for form in self.forms:
            A += [np.zeros((1, g.size)), -form]
            b += [np.array([share]), np.zeros(len(form))]
            cones.append(clarabel.SecondOrderConeT(1 + len(form)))
        settings = clarabel.DefaultSettings()
        settings.verbose, settings.tol_gap_rel, settings.tol_feas = False, _EXACT, _EXACT
        whole = csc_array(np.vstack(A)), np.concatenate(b), cones, settings
        found = clarabel.DefaultSolver(csc_array((g.size, g.size)), -g / scale, *whole).solve()
        x = np.array(found.x)
        if "Solved" not in str(found.status) or not np.isfinite(x).all():
            raise DesignInfeasible("largest hidden error", str(found.status), code="no-solution")
        x = np.clip(x, least, most)
        x /= max(self._statistic(x) / share, 1.0)
        return Hidden(x * self.unit, float(g @ x))

    def _statistic(self, x: Floats) -> float:
        """Largest statistic, in units of its limit: the solver's rounding may exceed one."""
        linear = float(np.abs(self.rows @ x).max(initial=0.0))
        return max([linear, *(float(np.linalg.norm(form @ x)) for form in self.forms)])

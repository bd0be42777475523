"""Redundant observability of nonlinear systems: observability by every group of sensors.

A coding function Phi = (Phi_1, …, Phi_p) is *q-error detectable* if no two states differ in at most q
blocks, *infinitesimally* so if the same holds for its Jacobians, *strongly* so if both; *correctable* is
detectable for 2q. Strong detectability is q-redundant observability.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.errors import NotObservable
from gridsec.observers.high_gain.form import System
from gridsec.observers.high_gain.inverse import corners_and_interior
from gridsec.observers.high_gain.lipschitz import lower_sampled


def block_distance(codes: Floats, mask: Bools | None = None, *, tolerance: float = 0.0) -> Floats:
    """Number of blocks in which codes differ, pairwise: `d_{0^n}(z, z')`.

    Parameters
    ----------
    codes : (k, p, n)
        k codes of p blocks.
    mask : (p, n)
        Entries that count; by default all.
    tolerance
        Largest difference that counts as zero.

    Returns
    -------
    Floats
        (k, k), symmetric, zero on the diagonal.

    References
    ----------
    kim2018, section III.A; lee2018, Proposition 5.1.2 (iii).
    """
    apart = np.abs(codes[:, None] - codes[None, :])
    if mask is not None:
        apart = np.where(mask, apart, 0.0)
    return np.asarray((apart.max(axis=-1) > tolerance).sum(axis=-1), dtype=np.float64)


def detectable(codes: Floats, errors: int, *, tolerance: float = 0.0) -> bool:
    """True if any two of finitely many codes differ in more than `errors` blocks.

    Parameters
    ----------
    codes : (k, p, n)
        Codes of different states.
    errors
        q, largest number of wrong blocks.
    tolerance
        Largest difference that counts as zero.

    References
    ----------
    lee2018, Definition 5.1.1 and Proposition 5.1.2.
    """
    far = block_distance(codes, tolerance=tolerance)
    return bool(np.all(far[~np.eye(len(codes), dtype=np.bool_)] > errors))


def correctable(codes: Floats, errors: int, *, tolerance: float = 0.0) -> bool:
    """True if `errors` wrong blocks are always correctable: detectable for twice as many.

    References
    ----------
    lee2018, Definition 5.1.2 and Proposition 5.1.5.
    """
    return detectable(codes, 2 * errors, tolerance=tolerance)


@dataclass(frozen=True, slots=True)
class Redundancy:
    """Redundancy without k sensors, at the sampled points.

    Attributes
    ----------
    missing
        k.
    weakest
        The group of p - k sensors with the smallest `singular`.
    singular
        Smallest singular value of the Jacobian of any group at any point; zero for no immersion.
    injective
        Smallest `|Phi_I(x) - Phi_I(x')| / |x - x'|` of any group and any pair; zero if not injective.
    """

    missing: int
    weakest: tuple[int, ...]
    singular: float
    injective: float


def redundancy(system: System, missing: int, *, samples: int = 2000, seed: int = 0) -> Redundancy:
    """Search for counterexamples of k-redundant observability by sampling.

    A value of zero disproves it. Positive values are evidence, and a proof with a bound of
    `lipschitz.lower_proven` or a left inverse for each group.

    Parameters
    ----------
    missing
        k.
    samples, seed
        Points and pairs for each group.

    Raises
    ------
    NotObservable
        If a group has too few entries to determine the state at all.

    References
    ----------
    kim2018, Definition 1; lee2018, Definition 5.3.1 and Proposition 5.1.4.
    """
    p = len(system.partials)
    points = corners_and_interior(system, samples=samples, seed=seed)
    best: tuple[float, tuple[int, ...]] = (np.inf, ())
    injective = np.inf
    for group in combinations(range(p), max(p - missing, 0)):
        entries = sum(system.partials[i].size for i in group)
        if entries < system.n:
            raise NotObservable(
                group, entries, f"{entries} entries cannot determine {system.n} states", code="too-few-meters"
            )
        smallest = np.linalg.svd(system.jacobian(points, group), compute_uv=False)[:, -1].min()
        best = min(best, (float(smallest), group))
        quotient = lower_sampled(
            partial(system.phi, sensors=group),
            -system.x_bound,
            system.x_bound,
            samples=samples,
            seed=seed,
        )
        injective = min(injective, quotient.upper)
    return Redundancy(missing, best[1], best[0], injective)


def groups(sensors: int, attacked: int) -> list[tuple[int, ...]]:
    """All sets of p - q sensors in the order of the papers' tables: the first leaves out sensor 0.

    References
    ----------
    kim2018, Theorem 2: the bijection Lambda.
    """
    everyone = range(sensors)
    return [tuple(i for i in everyone if i not in out) for out in combinations(everyone, attacked)]

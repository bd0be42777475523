"""Pairs of suspected meters and inverters, and intervals of the injections of honest inverters.

An inverter follows ``tau x' = -x + K(z)`` with K non-decreasing, so that an interval for z over a step gives
one for x after it:

    x in [keep low + (1 - keep) K(z_low), keep high + (1 - keep) K(z_high)],    keep = exp(-h / tau)

for any h, without an integrator, a gain or a certificate. Every inverter has two such intervals: `driven` by
the customer's own meter, valid while that meter is unmanipulated, and `free` of it, from the feeder model,
always valid.

One tick is one linear relation,

    r = C a + E d,      |d_k| <= h_k,

where r are the readings (voltages, and net reactive powers where reported) minus the model with unmanipulated
inverters in the middle of their intervals, a the wrong injections, and d all errors of unmanipulated
readings: meters, loads, the busbar, the model, the inverters' intervals. A pair drops the rows of its meters
and takes the injections of its inverters as unknown inputs. Their columns U of C are removed by

    Q = S^-1 - S^-1 U (U^T S^-1 U)^-1 U^T S^-1,       S = E diag(h^2 / 3) E^T,

since Q U = 0. Every row f of Q, and of C^T Q, is a test that the rest passes if unmanipulated:
|f r| <= |f E| h.

Source: yang2021 (2), (17) with zero innovation under direct injection; (5), (22): consistency of an observer
that distrusts (J_u, J_s) with those within it; (35), (36): decoupling; (42), (43): reconstruction.
Derivation: docs/theory-unknown-input.md, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, combinations
from math import comb

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.estimators.detection import ErrorModel, largest


@dataclass(frozen=True, slots=True, eq=False)
class Tube:
    """Intervals [low, high] of m inverters, (m,) each."""

    low: Floats
    high: Floats

    @property
    def middle(self) -> Floats:
        """Centres; (m,)."""
        return np.asarray(0.5 * (self.low + self.high))

    @property
    def half(self) -> Floats:
        """Half-widths; (m,)."""
        return np.asarray(0.5 * (self.high - self.low))

    def hull(self, other: Tube) -> Tube:
        """Hull of these and the other intervals."""
        return Tube(np.minimum(self.low, other.low), np.maximum(self.high, other.high))

    def where(self, this: Bools, other: Tube) -> Tube:
        """These intervals where `this` (m,) is True, the others elsewhere."""
        return Tube(np.where(this, self.low, other.low), np.where(this, self.high, other.high))


@dataclass(frozen=True, slots=True, eq=False)
class Tubes:
    """Intervals of unmanipulated inverters at one tick."""

    # driven, free Tube: their injections if their own meter is unmanipulated, and in any case, pu
    driven: Tube
    free: Tube
    # z_driven, z_free Tube: the same of `vbar^2 - v^2` at their customers, squared pu
    z_driven: Tube
    z_free: Tube
    metered: Bools  # (m,) inverters with a reading of their own meter; elsewhere `driven` is `free`


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One tick at the places of inverters. m inverters, p meters."""

    z: Floats  # (m,) by the own meters; arbitrary where not metered
    z_error: Floats  # (m,) error of an unmanipulated meter
    metered: Bools  # (m,) inverters with a reading of their own meter
    # rest, rest_error (m,): `vbar^2 - v^2` without any inverter, and its error
    rest: Floats
    rest_error: Floats


@dataclass(frozen=True, slots=True, eq=False)
class AttackAssumption:
    """Assumed number and size of attacks."""

    # meters, inverters: largest numbers of simultaneous attacks
    meters: int
    inverters: int
    reach: Floats  # (m,) largest injection of an attacked inverter: its rating, pu
    coupling: Floats  # (m, m) 2X between the inverters' customers


def saturated(errors: ErrorModel) -> Tube:
    """Intervals between the ends of the curves, valid for all unmanipulated inverters."""
    return Tube(errors.droop.q[:, 3].copy(), errors.droop.q[:, 0].copy())


def spread(errors: ErrorModel, doubt: AttackAssumption, known: Tube, free: Tube, gain: Floats) -> Floats:
    """Largest distance of voltages from those with the middle injections, under any attack; (r,).

    Unmanipulated inverters are in `known`; those of the worst M meters in `free`; the worst of all inverters
    inject up to their rating.

    known, free: intervals of all inverters if their own meters are unmanipulated, and in any case.
    gain (r, m): |2X| from inverters to the r voltages.
    """
    swing = np.maximum(free.high - known.middle, known.middle - free.low) - known.half
    far = doubt.reach + np.abs(known.middle) - known.half
    p = errors.meters.size
    group = np.zeros((gain.shape[1], p))
    driven = errors.meter_of >= 0
    group[np.flatnonzero(driven), errors.meter_of[driven]] = 1.0
    by_meter = (gain * np.maximum(swing, 0.0)) @ group
    return np.asarray(
        gain @ known.half
        + largest(by_meter, doubt.meters)
        + largest(gain * np.maximum(far, 0.0), doubt.inverters)
    )


# Every round gives a valid interval; more rounds only narrow it.
_ROUNDS = 4


def advance(errors: ErrorModel, doubt: AttackAssumption, before: Tubes | None, seen: Seen, h: float) -> Tubes:
    """Intervals after a step.

    Voltages between two ticks are assumed within the extremes of their intervals at both.

    before: intervals of the last tick; None at the first one, with inverters anywhere on their curves.
    """
    z_own = Tube(seen.z - seen.z_error, seen.z + seen.z_error)
    driven = free = saturated(errors)
    if before is None:
        known = _z_free(errors, doubt, seen, free, free)
        return Tubes(driven, free, z_own.where(seen.metered, known), known, seen.metered)
    # An inverter without a reading at either end of the step is not driven over it.
    both = seen.metered & before.metered
    z_free = before.z_free
    for _ in range(_ROUNDS):
        known = driven.where(seen.metered, free)
        z_free = _z_free(errors, doubt, seen, known, free)
        free = _follow(errors, before.free, before.z_free.hull(z_free), h)
        held = before.z_driven.hull(z_own).where(both, before.z_free.hull(z_free))
        driven = _follow(errors, before.driven, held, h)
    return Tubes(driven, free, z_own.where(seen.metered, z_free), z_free, seen.metered)


def _z_free(errors: ErrorModel, doubt: AttackAssumption, seen: Seen, known: Tube, free: Tube) -> Tube:
    """`z = rest - 2X x` at the inverters' customers, without their own meters."""
    z = seen.rest - doubt.coupling @ known.middle
    wide = seen.rest_error + spread(errors, doubt, known, free, errors.inverters_own)
    return Tube(z - wide, z + wide)


def _follow(errors: ErrorModel, x: Tube, z: Tube, h: float) -> Tube:
    droop = errors.droop
    keep, (low, high) = np.exp(-h / droop.tau), droop(np.stack([z.low, z.high]))
    low = np.maximum(low - errors.mismatch, droop.q[:, 3])
    high = np.minimum(high + errors.mismatch, droop.q[:, 0])
    return Tube(keep * x.low + (1.0 - keep) * low, keep * x.high + (1.0 - keep) * high)


MOST_WORK = 2_000_000
"""Limit of pairs times squared meters; beyond it a tick would take seconds."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Candidates: the empty pair first, then in the order of their size. c pairs, p meters, m inverters."""

    # meters, inverters (c, p), (c, m): suspected meters and inverters
    meters: Bools
    inverters: Bools

    def within(self) -> Bools:
        """True where the suspects of the first of two pairs are a subset of those of the second; (c, c)."""
        both = np.hstack([self.meters, self.inverters]).astype(np.float64)
        return np.asarray(both @ (1.0 - both.T) == 0.0)


@dataclass(frozen=True, slots=True)
class Unseen:
    """A pair without an unknown-input observer by voltages alone."""

    # meters, inverters: suspected meters and inverters
    meters: tuple[int, ...]
    inverters: tuple[int, ...]
    rank: int  # rank of `C_Js b_Ju`, less than the number of inverters


def pairs(gain: Floats, most_meters: int, most_inverters: int) -> tuple[Pairs, tuple[Unseen, ...]]:
    """All pairs, and those with inverters that voltages alone do not distinguish.

    These are tried like all others: reported reactive powers may distinguish them, and two inverters together
    have a larger range than either.

    gain (p, m): 2X from inverters to meters, in units of the meters' errors.
    Raises DesignInfeasible if the pairs cannot be tried within a tick.
    """
    p, m = gain.shape
    count = sum(comb(p, k) for k in range(most_meters + 1))
    count *= sum(comb(m, k) for k in range(most_inverters + 1))
    if count * p**2 > MOST_WORK:
        raise DesignInfeasible(
            "bank of unknown-input observers",
            f"{count} pairs of up to {most_meters} of {p} meters and {most_inverters} of {m} inverters "
            "cannot be tried within a tick",
            None,
            code="too-many",
        )
    found, missing = [], []
    for meters in _subsets(p, most_meters):
        rest = np.delete(gain, list(meters), axis=0)
        for inverters in _subsets(m, most_inverters):
            found.append((meters, inverters))
            rank = _rank(rest[:, list(inverters)], float(np.abs(gain).max(initial=0.0)))
            if rank < len(inverters):
                missing.append(Unseen(meters, inverters, rank))
    found.sort(key=lambda pair: len(pair[0]) + len(pair[1]))
    marks = np.zeros((len(found), p + m), dtype=np.bool_)
    for row, (meters, inverters) in zip(marks, found, strict=True):
        row[list(meters)] = True
        row[[p + i for i in inverters]] = True
    return Pairs(marks[:, :p], marks[:, p:]), tuple(missing)


def _subsets(count: int, most: int) -> list[tuple[int, ...]]:
    return list(chain.from_iterable(combinations(range(count), k) for k in range(most + 1)))


# Singular values below this fraction of the largest entry are rounding.
_RANK = 1e-9


def _rank(columns: Floats, size: float) -> int:
    if not columns.size:
        return 0
    return int(np.count_nonzero(np.linalg.svd(columns, compute_uv=False) > _RANK * size))


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """One tick as `r = C a + E d`. R rows, K errors, m inverters."""

    r: Floats  # (R,) residuals, squared pu and pu
    C: Floats  # (R, m) sensitivity to wrong injections
    E: Floats  # (R, K) sensitivity to errors
    h: Floats  # (K,) largest magnitudes of the errors
    meter: Ints  # (R,) meter of each row
    voltage: Bools  # (R,) True for rows of voltages


@dataclass(frozen=True, slots=True, eq=False)
class PairResult:
    """Result of one pair for a tick. p meters, m inverters."""

    fits: bool  # True if all meters and inverters outside the pair may be unmanipulated
    misfit: float  # `r^T Q r`
    # score, threshold (p,): distance of each voltage from its value by all others, and its largest value
    # without manipulation, squared pu; NaN and infinite for suspected or unavailable meters
    score: Floats
    threshold: Floats
    # attack, attack_error (m,): wrong injection of each inverter by the rows, with the suspected inverters
    # unknown as well, and its error, pu; infinite error where not determined
    attack: Floats
    attack_error: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Believed:
    """A relation without the rows of suspected meters, for any set of inverters. k rows, m inverters."""

    size: int  # p, number of meters
    # meter, voltage (k,): of the remaining rows
    meter: Ints
    voltage: Bools
    C: Floats  # (k, m) of the remaining rows
    tests: Floats  # (k + m, k) P = S^-1 and C^T P: the tests if only these meters are suspected
    # r, E, C_ (k + m,), (k + m, K), (k + m, m): those tests of r, E and C
    r: Floats
    E: Floats
    C_: Floats
    plain: Floats  # (k,) r itself
    h: Floats  # (K,) as in `Relation`


def believe(relation: Relation, meters: Bools) -> Believed:
    """Drop the rows of the meters in the mask (p,)."""
    keep = ~meters[relation.meter]
    r, C, E, h = relation.r[keep], relation.C[keep], relation.E[keep], relation.h
    P = np.linalg.inv((E * h) @ (E * h).T / 3.0)
    tests = np.asarray(np.vstack([P, C.T @ P]), dtype=np.float64)
    return Believed(
        size=meters.size,
        meter=relation.meter[keep],
        voltage=relation.voltage[keep],
        C=C,
        tests=tests,
        r=tests @ r,
        E=tests @ E,
        C_=tests @ C,
        plain=r,
        h=h,
    )


def try_pair(believed: Believed, inverters: Bools, room: Floats) -> PairResult:
    """Test if a pair explains a tick.

    With `G = U^T P U` its tests are those of its meters alone minus `T U G^-1 U^T P`, a matrix of rank |J_u|.

    room (m,): largest possible wrong injection, pu.
    """
    k, h = believed.plain.size, believed.h
    chosen = np.flatnonzero(inverters)
    own = k + chosen  # the rows U^T P
    TU = believed.C_[:, chosen]
    G = believed.C_[np.ix_(own, chosen)]
    inverse = _pseudo_inverse(G)
    left_r, left_E = inverse @ believed.r[own], inverse @ believed.E[own]
    left_C = inverse @ believed.C_[own]
    size, error = believed.r - TU @ left_r, np.abs(believed.E - TU @ left_E) @ h
    before = np.concatenate([np.diagonal(believed.tests), np.diagonal(believed.C_[k:])])
    taken = np.vstack([(inverse @ believed.tests[own]).T, left_C.T])
    norm = before - np.einsum("tw,tw->t", TU, taken)
    # Rows removed entirely by the unknown inputs are rounding, and no test.
    known = norm > _ROUNDING * before
    real = known.copy()
    real[own] = False
    fits = bool(np.all((np.abs(size) <= error)[real]))
    safe = np.where(known, norm, 1.0)
    offset, most = size / safe, np.where(known, error / safe, np.inf)
    score, threshold = np.full(believed.size, np.nan), np.full(believed.size, np.inf)
    rows = np.flatnonzero(believed.voltage & known[:k])
    at = believed.meter[rows]
    score[at], threshold[at] = np.abs(offset[rows]), most[rows]
    attack, attack_error = np.where(known[k:], offset[k:], 0.0), most[k:]
    # An inverter may be unobservable without the meters that are unavailable now.
    seen = np.abs(np.diagonal(left_C[:, chosen]) - 1.0) < _ROUNDING
    attack[chosen], attack_error[chosen] = left_r, np.where(seen, np.abs(left_E) @ h, np.inf)
    beyond = np.any((np.abs(attack) - attack_error > room)[chosen])
    misfit = float(believed.plain @ size[:k])
    return PairResult(fits and not beyond, misfit, score, threshold, attack, attack_error)


# Relative level of rounding.
_ROUNDING = 1e-6


# Columns that differ by less, relative to their squared lengths, count as equal.
_ALIKE = 1e-10


def _pseudo_inverse(G: Floats) -> Floats:
    """F with G F G = G, any of which decouples; G is positive semidefinite, most often of one entry."""
    size = np.sqrt(np.diagonal(G))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    # Reactive powers may determine one inverter orders of magnitude better than voltages another.
    scale = np.multiply.outer(unit, unit)
    if size.size <= 1:
        return scale
    return np.asarray(scale * np.linalg.pinv(scale * G, rcond=_ALIKE, hermitian=True))

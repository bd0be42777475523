"""What a meter's own fixed error is, learned while nothing speaks against it.

A meter of class 0.5 may be off by 0.5 %, always by the same amount; a lie of that size is no evidence. But
the amount can be learned: over a long time the load errors cancel, and what is left of a meter's residual
is its own. With B the prior variance of the fixed errors and M the long-run means,

    cov M = B + c * S + D / n,      b_hat = B (cov M)^-1 M,      P = B - B (cov M)^-1 B

where ``c_ij`` says what the loads' errors, of correlation time tau, still contribute to two means over the
last a and b >= a seconds (in units of tau):

    c = (2 a + e^-a + e^-b - e^-(b - a) - 1) / (a b)

and a share `lasting` of the variances stays whole (c = 1), since it is the same all the time. After that a
meter counts as manipulated when it *changes*, even inside its class. A meter that is replaced is learned anew
while the others stay; they then say what the loads did meanwhile, with B their P.

References
----------
docs/theory-sequential.md, section 6.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, submatrix
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators.sequential.conditional import invert
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.search import Recent


class LearningReason(StrEnum):
    """Reason why a tick adds nothing to the learning of a meter; the order is that of `Learning.lost_s`."""

    SILENT = "silent"
    SUSPECTED = "suspected"
    OTHERS_SUSPECTED = "others-suspected"
    NO_BUSBAR = "no-busbar"
    UNREAD_POWERS = "unread-powers"
    LOAD_BEYOND_DECLARED = "load-beyond-declared"
    ACTIVE_UNCERTAINTY = "active-uncertainty"
    REACTIVE_UNCERTAINTY = "reactive-uncertainty"


REASONS = tuple(LearningReason)
COUNTED = -1
"""In place of an index of `REASONS`: the tick counts."""


@dataclass(frozen=True, eq=False)
class Learned:
    """What is known of the meters' fixed errors. p meters.

    Attributes
    ----------
    bias : (p,)
        Expected fixed error, squared pu.
    variance : (p,)
        Its variance.
    allowed : (p,)
        Largest honest change from it, squared pu.
    at : (p,)
        When it was learned, Unix s; NaN where only the class is known.
    hidden : (p,)
        What lasting errors of the loads leave open of the voltage at each learned meter, squared pu^2: these
        errors and the meters' own are known as a sum only, and no averaging over meters takes them apart.
    """

    bias: Floats
    variance: Floats
    allowed: Floats
    at: Floats
    hidden: Floats

    @cached_property
    def late(self) -> Floats | None:
        """Variance that `hidden` of the others adds to what they say of each meter not learned, squared pu^2.

        (p,), the largest of them, and zero at learned meters; None where nobody or everybody is learned.
        """
        unknown = np.isnan(self.at)
        if all_of(unknown) or not any_of(unknown):
            return None
        return np.where(unknown, self.hidden.max(), 0.0)

    @cached_property
    def recent(self) -> defaultdict[int, Recent]:
        """What was answered last of the largest honest offsets, by scale."""
        return defaultdict(Recent)

    def __getstate__(self) -> dict[str, Any]:
        # What was answered can be worked out again.
        return {name: each for name, each in vars(self).items() if name != "recent"}


@dataclass(frozen=True, slots=True, eq=False)
class Learning:
    """Sums and times of a commissioning. p meters, r reasons.

    Attributes
    ----------
    total : (p,)
        Sum of each meter's residuals while it was trusted, squared pu.
    count : (p,)
        Number of these residuals.
    time_s : (p,)
        Time over which they were gathered, s.
    since : (p,)
        Start of the meter's learning, Unix s; NaN for meters that only witness the loads.
    watched_s : (p,)
        Time of all ticks since then, s. Pauses of the frames are not in it.
    lost_s : (r, p)
        Time of the ticks that brought learning no further, s, by reason in the order of `REASONS`.
    """

    total: Floats
    count: Ints
    time_s: Floats
    since: Floats
    watched_s: Floats
    lost_s: Floats

    @property
    def open(self) -> Bools:
        """Which meters are being learned, (p,)."""
        return np.isfinite(self.since)


@dataclass(frozen=True, slots=True, eq=False)
class Commission:
    """All that commissioning has brought so far.

    Attributes
    ----------
    learned
        What is known.
    learning
        What was gathered; None where there is nothing left to learn.
    """

    learned: Learned
    learning: Learning | None


def nothing(design: SequentialDesign) -> Learned:
    """What the accuracy class alone says.

    Parameters
    ----------
    design
        The design.
    """
    p = design.allowed.size
    return Learned(np.zeros(p), design.fixed, design.allowed, np.full(p, np.nan), np.zeros(p))


def begin(which: Bools, t: float) -> Learning:
    """Nothing gathered yet.

    Parameters
    ----------
    which : (p,)
        Meters to learn.
    t
        Unix time, s.
    """
    p = which.size
    return Learning(
        total=np.zeros(p),
        count=np.zeros(p, dtype=np.intp),
        time_s=np.zeros(p),
        since=np.where(which, t, np.nan),
        watched_s=np.zeros(p),
        lost_s=np.zeros((len(REASONS), p)),
    )


def fresh(design: SequentialDesign, t: float) -> Commission:
    """A feeder that has just been built: only the classes are known, and all meters are to be learned.

    Parameters
    ----------
    design
        The design; with ``commission_s = 0`` nothing is ever learned.
    t
        Unix time, s.
    """
    learns = design.options.commission_s > 0
    every = np.ones(design.allowed.size, dtype=np.bool_)
    return Commission(nothing(design), begin(every, t) if learns else None)


def renew(design: SequentialDesign, before: Commission, which: Bools, t: float) -> Commission:
    """Forget what is known of some meters and learn them anew; all others stay.

    Parameters
    ----------
    design
        The design.
    before
        What is known.
    which : (p,)
        The meters.
    t
        Unix time, s.
    """
    if not any_of(which) or not design.options.commission_s > 0:
        return before
    known, blank = before.learned, nothing(design)
    learned = Learned(
        *(np.where(which, getattr(blank, f.name), getattr(known, f.name)) for f in fields(Learned))
    )
    start = begin(which, t)
    if before.learning is None:
        return Commission(learned, start)
    so_far = before.learning
    learning = Learning(
        *(np.where(which, getattr(start, f.name), getattr(so_far, f.name)) for f in fields(Learning))
    )
    return Commission(learned, learning)


def gather(before: Learning, residual: Floats, use: Bools, h: float, why: Ints | None = None) -> Learning:
    """Take one tick in.

    Parameters
    ----------
    before
        So far.
    residual : (p,)
        Readings minus what the model and the errors learned before explain.
    use : (p,)
        Meters that are trusted and have a reading.
    h
        Time since the last tick, s.
    why : (p,)
        Index of `REASONS` where the tick brings learning no further, else `COUNTED`; None: all `COUNTED`.
    """
    lost_s = before.lost_s
    if why is not None and any_of(why != COUNTED):
        lost_s = lost_s + h * np.equal.outer(np.arange(len(REASONS)), why)
    return Learning(
        total=before.total + np.where(use, residual, 0.0),
        count=before.count + use,
        time_s=before.time_s + h * use,
        since=before.since,
        watched_s=before.watched_s + h,
        lost_s=lost_s,
    )


def ripe(design: SequentialDesign, gathered: Learning) -> Bools:
    """Which meters have been heard for long enough, (p,).

    Once one of those being learned was heard for `commission_s`, so are all that have `enough` of it: they
    are learned together, since together they tell errors of loads from their own.

    Parameters
    ----------
    design, gathered
        The design, and what was gathered.
    """
    needed = design.options.commission_s
    if not gathered.time_s.max(initial=0.0) >= needed > 0:
        return np.zeros(gathered.since.size, dtype=np.bool_)
    heard = np.where(gathered.open, gathered.time_s, 0.0)
    if not heard.max(initial=0.0) >= needed > 0:
        return np.zeros_like(gathered.open)
    return np.asarray(heard >= design.options.enough * needed)


def conclude(
    design: SequentialDesign, known: Learned, gathered: Learning, which: Bools, t: float
) -> Commission:
    """The fixed errors of some meters; meters with no reading at all keep their class.

    Parameters
    ----------
    design
        The design.
    known
        What is known of all meters.
    gathered
        What was gathered relative to that.
    which : (p,)
        Meters to conclude about.
    t
        Unix time, s.
    """
    heard = np.flatnonzero(gathered.count * gathered.time_s > 0)
    done = which & (gathered.count > 0) & (gathered.time_s > 0)
    if not any_of(done):
        return Commission(known, gathered)
    B, n = known.variance[heard], gathered.count[heard]
    # One matrix of this size, inverted where it is.
    K = design.prior.among(heard)
    time = gathered.time_s[heard] / design.doubt.time_s
    for first in range(0, heard.size, _COLUMNS):
        some = slice(first, first + _COLUMNS)
        share = _share(time, time[some])
        K[:, some] = share * K[:, some] + (1.0 - share) * _lasting(design, heard, some)
    K[np.diag_indices_from(K)] += B + design.white[heard] / n
    invert(K)
    bias, variance, allowed = known.bias.copy(), known.variance.copy(), known.allowed.copy()
    hidden = np.zeros(known.at.size)
    hidden[heard] = _hidden(design, heard, K)
    bias[heard] += B * (K @ (gathered.total[heard] / n))
    left = np.maximum(B - B * B * K.diagonal(), 0.0)
    rounded = design.rounded[heard]
    aging = design.options.stability * (design.allowed[heard] - rounded)
    # A uniform error of half-width a has the variance a^2 / 3; what rounding adds goes with the voltage.
    variance[heard] = np.minimum(left + aging**2 / 3.0 + 0.5 * rounded**2, B)
    allowed[heard] = np.minimum(aging + 3.0 * np.sqrt(left) + rounded, design.allowed[heard])
    learned = Learned(
        # No honest meter leaves its class, so nothing beyond it is learned as an error.
        bias=np.where(done, np.clip(bias, -design.allowed, design.allowed), known.bias),
        variance=np.where(done, variance, known.variance),
        allowed=np.where(done, allowed, known.allowed),
        at=np.where(done, t, known.at),
        hidden=np.where(done, hidden, known.hidden),
    )
    rest = gathered.open & ~done
    if not any_of(rest):
        return Commission(learned, None)
    # What the others gathered is in what is known now; they begin anew as witnesses of the loads.
    start = begin(rest, t)
    left_open = Learning(
        *(np.where(rest, getattr(gathered, f.name), getattr(start, f.name)) for f in fields(Learning))
    )
    return Commission(learned, left_open)


def _lasting(design: SequentialDesign, heard: Ints, some: slice) -> Floats:
    """Covariance at the meters of errors that no mean takes away, some columns, (h, k).

    The fixed error of the busbar's meter is one of them, whatever is known of the loads; phases have their
    own.
    """
    of_loads = submatrix(design.prior.of_meters, design.prior.meters[heard], heard[some])
    lasting = design.doubt.lasting
    places, feeder = design.prior.meters, design.plant.feeder
    same = feeder.same_busbar_phase(places[heard], places[heard[some]])
    return lasting * of_loads + (1.0 - lasting) * design.busbar**2 * same


def _hidden(design: SequentialDesign, heard: Ints, inverse: Floats) -> Floats:
    """``diag(L - L K^-1 L)``: what is left open of errors L that last, (h,)."""
    out = np.empty(heard.size)
    for first in range(0, heard.size, _COLUMNS):
        some = slice(first, first + _COLUMNS)
        L = _lasting(design, heard, some)
        own = L[np.arange(heard.size)[some], np.arange(L.shape[1])]
        out[some] = own - np.einsum("ij,ij->j", L, inverse @ L)
    return np.maximum(out, 0.0)


# Columns that are worked on together.
_COLUMNS = 128


def _share(one: Floats, other: Floats) -> Floats:
    """Covariance of two means of an Ornstein-Uhlenbeck process of variance 1 that end together, (j, k).

    The times are in units of its correlation time.
    """
    a, b = np.minimum.outer(one, other), np.maximum.outer(one, other)
    total = 2.0 * a + np.expm1(-a) + np.expm1(-b) - np.expm1(a - b)
    return np.asarray(np.clip(total / (a * b), 0.0, 1.0))


_KNOWN = tuple(f.name for f in fields(Learned))
_GATHERED = ("total", "count", "time_s", "since")
# Texts of earlier versions lack these.
_WATCHED = "watched_s"
_LOST = tuple(f"lost_s.{reason}" for reason in REASONS)


def to_arrays(commission: Commission) -> dict[str, Floats]:
    """Persistent form of a commissioning: arrays of p numbers by name.

    Parameters
    ----------
    commission
        What is known.
    """
    learned = commission.learned
    none = np.zeros(learned.at.size, dtype=np.bool_)
    learning = commission.learning or begin(none, 0.0)
    known = {name: getattr(learned, name) for name in _KNOWN}
    gathered = {
        name: np.asarray(getattr(learning, name), dtype=np.float64) for name in (*_GATHERED, _WATCHED)
    }
    return known | gathered | dict(zip(_LOST, learning.lost_s, strict=True))


def from_arrays(design: SequentialDesign, arrays: Mapping[str, Floats]) -> Commission:
    """What `to_arrays` gave, for a design that it fits.

    Parameters
    ----------
    design
        The design.
    arrays
        By name.

    Raises
    ------
    ValueError
        If it does not fit; the message names every problem.
    """
    problems = _problems(design, arrays)
    raise_if_any(problems)
    learned = Learned(*(arrays[name] for name in _KNOWN))
    if not any_of(np.isfinite(arrays["since"])):
        return Commission(learned, None)
    time_s = arrays["time_s"]
    learning = Learning(
        total=arrays["total"],
        count=arrays["count"].astype(np.intp),
        time_s=time_s,
        since=arrays["since"],
        watched_s=arrays.get(_WATCHED, time_s),
        lost_s=np.stack([arrays.get(name, np.zeros_like(time_s)) for name in _LOST]),
    )
    return Commission(learned, learning)


# Numbers may have been rounded on their way.
_ROUNDED = 1.0 + 1e-9


def _problems(design: SequentialDesign, arrays: Mapping[str, Floats]) -> list[Problem]:
    """Everything that is wrong with arrays."""
    p, needed, times = design.allowed.size, {*_KNOWN, *_GATHERED}, {_WATCHED, *_LOST}
    problems = [Problem("missing", f"{name} is missing") for name in sorted(needed - arrays.keys())]
    problems += [
        Problem("unknown-name", f"{name} is not known") for name in sorted(arrays.keys() - needed - times)
    ]
    shapes = {name: arrays[name].shape for name in sorted((needed | times) & arrays.keys())}
    problems += [
        Problem("shape", f"{name} has the shape {shape}, not ({p},)")
        for name, shape in shapes.items()
        if shape != (p,)
    ]
    if problems:
        return problems
    widest, at, since = design.allowed * _ROUNDED, arrays["at"], arrays["since"]
    count, time_s = arrays["count"], arrays["time_s"]
    idle = np.isnan(since) & (not design.options.commission_s > 0)
    # Comparisons with NaN are false: NaN breaks every rule.
    rules = {
        **{
            Problem("negative", f"{name} is not a time"): np.isfinite(arrays[name]) & (arrays[name] >= 0)
            for name in sorted(times & arrays.keys())
        },
        Problem("out-of-range", "bias is beyond the class"): np.abs(arrays["bias"]) <= widest,
        Problem("out-of-range", "variance is not within that of the class"): (arrays["variance"] >= 0)
        & (arrays["variance"] <= design.fixed * _ROUNDED),
        Problem("out-of-range", "allowed is not within the class"): (arrays["allowed"] >= 0)
        & (arrays["allowed"] <= widest),
        Problem("negative", "hidden is no variance"): (arrays["hidden"] >= 0) & np.isfinite(arrays["hidden"]),
        Problem("not-finite", "at is no time"): np.isnan(at) | np.isfinite(at),
        Problem("not-finite", "since is no time"): np.isnan(since) | np.isfinite(since),
        Problem("inconsistent", "neither learned nor being learned"): (np.isfinite(at) ^ np.isfinite(since))
        | (idle & np.isnan(at)),
        Problem("not-finite", "total is no number"): np.isfinite(arrays["total"]),
        Problem("not-integer", "count is no number of readings"): np.isfinite(count)
        & (count >= 0)
        & (count == np.floor(count)),
        Problem("negative", "time_s is no time"): np.isfinite(time_s) & (time_s >= 0),
    }
    return [
        Problem(what.code, f"{what} (meters {', '.join(map(str, np.flatnonzero(~good)))})")
        for what, good in rules.items()
        if not all_of(good)
    ]

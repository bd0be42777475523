"""All sets of a few accusations at once: what each would explain, by one small solve each.

An accusation takes the readings' word away in some directions: a lying meter in its own, a lying inverter in
a column of 2X, and a lying meter that also drives its inverter in both. With ``Q = (S + D)^-1`` the inverse
covariance of the readings m if nobody lies, and U the directions of a set,

    misfit(set) = m^T Q m - b^T G^-1 b,      b = U^T Q m,    G = U^T Q U + diag(1 / std^2)

(1 / std^2 = 0 for meters, whose lies may be of any size). The normalised residuals of the meters that are
left follow from the same solve.

References
----------
lee2018 (2.2.8'), Remark 2.2.1: least squares over all meters but those of a set.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.sequential.decoder import Evidence

MOST_SETS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Atoms:
    """What can be accused. p meters, a accusations, d directions.

    Attributes
    ----------
    directions : (p, d)
        All directions.
    precision : (d,)
        1 / std^2 of the amount in each; 0 for any amount.
    of : (a, w)
        Directions of each accusation; -1 where it has fewer than w.
    meter : (a,)
        Meter that is accused; -1 for none.
    other : (a,)
        Index into the book of what else is accused; -1 for nothing.
    """

    directions: Floats
    precision: Floats
    of: Ints
    meter: Ints
    other: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Every set of one size. c sets of k accusations, p meters.

    Attributes
    ----------
    members : (c, k)
        Accusations of each set.
    misfit : (c,)
        What each leaves unexplained.
    excess : (c,)
        Largest offset of a meter that is left, in parts of what is honest.
    """

    members: Ints
    misfit: Floats
    excess: Floats


def check(candidates: int, most: int) -> None:
    """Refuse a search that would take too long.

    Parameters
    ----------
    candidates, most
        How many accusations there are, and how many of them a set may hold.

    Raises
    ------
    DesignInfeasible
        If there would be more than `MOST_SETS` sets.
    """
    count = sum(comb(candidates, k) for k in range(most + 1))
    if count > MOST_SETS:
        raise DesignInfeasible(
            "search over all sets", f"{count} sets of up to {most} of {candidates}; at most {MOST_SETS}", None
        )


def meters_only(live: Bools) -> Atoms:
    """One accusation for every meter with a reading.

    Parameters
    ----------
    live : (p,)
        Which.
    """
    at = np.flatnonzero(live)
    return Atoms(
        directions=np.eye(live.size)[:, at],
        precision=np.zeros(at.size),
        of=np.arange(at.size)[:, None],
        meter=at,
        other=np.full(at.size, -1),
    )


def meters_and_inverters(evidence: Evidence) -> Atoms:
    """One accusation for every meter with a reading, and one for every inverter.

    Parameters
    ----------
    evidence
        What a decoder gets; the last m columns of its book are those of the inverters.
    """
    live, book, m = evidence.live, evidence.book, evidence.meter_of.size
    single = meters_only(live)
    first = book.std.size - m
    count = single.meter.size
    return Atoms(
        directions=np.hstack([single.directions, np.where(live[:, None], book.at_meters[:, first:], 0.0)]),
        precision=np.concatenate([single.precision, 1.0 / book.std[first:] ** 2]),
        of=np.arange(count + m)[:, None],
        meter=np.concatenate([single.meter, np.full(m, -1)]),
        other=np.concatenate([single.other, first + np.arange(m)]),
    )


def meters_with_their_inverters(evidence: Evidence) -> Atoms:
    """One accusation for every meter with a reading; it takes the inverter that the meter drives along.

    Parameters
    ----------
    evidence
        As in `meters_and_inverters`.
    """
    both = meters_and_inverters(evidence)
    at = np.flatnonzero(evidence.live)
    drives = np.full(evidence.live.size, -1)
    driven = evidence.meter_of >= 0
    drives[evidence.meter_of[driven]] = np.flatnonzero(driven)
    own = drives[at]
    first = evidence.book.std.size - evidence.meter_of.size
    return Atoms(
        directions=both.directions,
        precision=both.precision,
        of=np.column_stack([np.arange(at.size), np.where(own >= 0, at.size + own, -1)]),
        meter=at,
        other=np.where(own >= 0, first + own, -1),
    )


def outcomes(evidence: Evidence, atoms: Atoms, size: int) -> Outcome:
    """Try every set of one size.

    Parameters
    ----------
    evidence
        What a decoder gets.
    atoms
        What can be accused.
    size
        k.
    """
    Q, m = evidence.whole.Q, evidence.m
    weights = Q @ m
    chosen = list(combinations(range(len(atoms.of)), size))
    members = np.array(chosen, dtype=np.intp).reshape(len(chosen), size)
    of = atoms.of[members].reshape(len(members), -1)
    used = of >= 0
    U = atoms.directions
    QU = Q @ U
    b = np.where(used, (weights @ U)[of], 0.0)
    G = (U.T @ QU)[of[:, :, None], of[:, None, :]] * (used[:, :, None] & used[:, None, :])
    diagonal = np.where(used, atoms.precision[of], 1.0)
    index = np.arange(of.shape[1])
    G[:, index, index] += diagonal
    columns = np.where(used[:, None, :], QU[:, of].transpose(1, 0, 2), 0.0)
    solved = np.linalg.solve(G, np.concatenate([b[:, :, None], columns.transpose(0, 2, 1)], axis=2))
    left = weights - np.einsum("cpr,cr->cp", columns, solved[:, :, 0])
    precision = Q.diagonal() - np.einsum("cpr,crp->cp", columns, solved[:, :, 1:])
    gone = np.zeros((len(members), m.size), dtype=np.bool_)
    accused = atoms.meter[members]
    rows, places = np.nonzero(accused >= 0)
    gone[rows, accused[rows, places]] = True
    judged = evidence.live & ~gone & (precision > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset, std = np.abs(left / precision), 1.0 / np.sqrt(precision)
        excess = np.where(judged, offset / evidence.limits.of(std), 0.0)
    misfit = float(m @ weights) - np.einsum("cr,cr->c", b, solved[:, :, 0])
    return Outcome(members, misfit, excess.max(axis=1, initial=0.0))

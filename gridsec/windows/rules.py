"""Algorithms 1 and 2 of yang2019 as pure functions of a window's consistency measures.

References
----------
yang2019, Algorithms 1 and 2; docs/theory-discrete.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.choices import no_choice
from gridsec.errors import refuse

Rule = Literal["majority", "survivors"]


def exceeds(measure: Floats, threshold: Floats | float) -> Bools:
    """True where measures are above their thresholds.

    Parameters
    ----------
    measure : (…)
        pi or pi_J; NaN, a measure that was not judged, exceeds no threshold.
    threshold : (…) or scalar
        A threshold of NaN is exceeded by every judged measure.
    """
    return np.asarray(~np.isnan(measure) & ~(measure <= threshold))


def detection(pi: Floats, threshold: float, length: int) -> Bools:
    """Algorithm 1: True for windows in which pi exceeds its threshold anywhere.

    Parameters
    ----------
    pi : (…, T)
        From step k* on; an incomplete last window is left out.
    threshold
        (10).
    length
        N.

    Returns
    -------
    (…, T // N)
        detection(i) as booleans.
    """
    count = pi.shape[-1] // length
    above = exceeds(pi[..., : count * length], threshold)
    return np.asarray(above.reshape(*pi.shape[:-1], count, length).any(axis=-1))


def believed(passing: Bools, masks: Bools) -> Bools:
    """W-bar(k): the union of all large sets that pass.

    Parameters
    ----------
    passing : (…, s)
        True where pi_J is within its threshold.
    masks : (s, p)
        The large sets.

    Returns
    -------
    (…, p)
        Meters regarded as unmanipulated.

    References
    ----------
    yang2019 (21).
    """
    return np.asarray((passing[..., :, None] & masks).any(axis=-2))


@dataclass(frozen=True, slots=True, eq=False)
class Isolation:
    """Result of windows. w windows, p meters.

    Attributes
    ----------
    suspects : (…, w, p)
        Meters regarded as attacked; none where `decided` is False.
    decided : (…, w)
        True if the window has an answer.
    share : (…, w)
        Fraction of the window's steps with this answer (majority), or of the large sets that survived
        (survivors).
    """

    suspects: Bools
    decided: Bools
    share: Floats


def isolation(pi_sets: Floats, thresholds: Floats, masks: Bools, length: int, rule: Rule) -> Isolation:
    """Algorithm 2, or its sound variant, over consecutive windows.

    "majority" takes the set that equals W-bar(k) most often in the window. Steps without a passing set do not
    vote, the earlier set wins a tie, and a window without votes is undecided. "survivors" drops a large set
    at its first failure and trusts the union of the others; without any, the assumptions are wrong and the
    window is undecided.

    Parameters
    ----------
    pi_sets : (…, T, s)
        pi_J from step k* on; NaN where J cannot be judged, neither passed nor failed.
    thresholds : (s,)
        (19).
    masks : (s, p)
        The large sets.
    length
        N. An incomplete last window is left out.
    rule
        "majority" or "survivors".

    Raises
    ------
    ValueError
        If `rule` is unknown.

    References
    ----------
    yang2019, Algorithm 2; docs/errata/yang2019.md on the two rules.
    """
    refuse(no_choice("rule", get_args(Rule), rule))
    count = pi_sets.shape[-2] // length
    shape = (*pi_sets.shape[:-2], count, length, pi_sets.shape[-1])
    windowed = np.asarray(pi_sets[..., : count * length, :].reshape(shape))
    if rule == "survivors":
        failed = np.asarray(exceeds(windowed, thresholds).any(axis=-2))
        judged = np.asarray(np.isfinite(windowed).any(axis=-2))
        alive = np.asarray(~failed & judged)
        decided = np.asarray(alive.any(axis=-1) & judged.all(axis=-1))
        suspects = ~believed(alive, masks) & decided[..., None]
        return Isolation(suspects, decided, alive.mean(axis=-1))
    trusted = believed(np.asarray(windowed <= thresholds), masks)
    return _majority(trusted, np.asarray(np.isfinite(windowed).all(axis=-1) & trusted.any(axis=-1)))


def _majority(trusted: Bools, votes: Bools) -> Isolation:
    """The most frequent set (…, w, N, p) among the steps that vote (…, w, N); the earlier one at a tie."""
    lead, (length, p) = trusted.shape[:-2], trusted.shape[-2:]
    rows = trusted.reshape(-1, p)
    if not rows.size:
        return Isolation(np.zeros((*lead, p), np.bool_), np.zeros(lead, np.bool_), np.zeros(lead))
    _, first, kind = np.unique(np.packbits(rows, axis=1), axis=0, return_index=True, return_inverse=True)
    count = len(rows) // length
    window, voting = np.repeat(np.arange(count), length), votes.reshape(-1)
    code = window * len(first) + kind.reshape(-1)
    tally = np.bincount(code[voting], minlength=count * len(first)).reshape(count, -1)
    seen = np.full(count * len(first), length)
    np.minimum.at(seen, code[voting], np.tile(np.arange(length), count)[voting])
    # Most votes first; `seen` is at most N and decides ties only.
    winner = np.argmax(tally * (length + 1) - seen.reshape(tally.shape), axis=1)
    share = tally[np.arange(count), winner] / length
    suspects = ~rows[first[winner]] & (share > 0.0)[:, None]
    return Isolation(suspects.reshape(*lead, p), (share > 0.0).reshape(lead), share.reshape(lead))

"""Where another method's decision takes the place of the search: same feeder, same inverters, same limits.

A decoder gets one tick's readings minus what the model explains, with what is known about both, and says
whom it accuses. Everything around it, from the cleaning of frames to naming and reconstruction, is shared,
so that methods differ by nothing but themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential.conditional import Fit
from gridsec.estimators.sequential.search import Limits


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a decoder decides from. p meters.

    Attributes
    ----------
    whole
        Fit of all meters that have a reading; its Q is the inverse covariance of `m` if nobody lies. Not to
        be changed.
    m : (p,)
        Readings minus what the model explains, squared pu; any finite value where there is none.
    live : (p,)
        Which meters have a reading.
    limits
        What is evidence.
    believed, over : (p,)
        Who was trusted before; whose offset is too large as judged by these.
    most
        How many accusations are allowed.
    like
        Explanations no more than this factor less likely than the best are rivals.
    """

    whole: Fit
    m: Floats
    live: Bools
    limits: Limits
    believed: Bools
    over: Bools
    most: int
    like: float


@dataclass(frozen=True, slots=True, eq=False)
class Accused:
    """A decoder's answer.

    Attributes
    ----------
    meters : (p,)
        Who lies.
    worse
        By how much its cost exceeds that of the best answer.
    """

    meters: Bools
    worse: float = 0.0


Decoder = Callable[[Evidence], tuple[Accused, ...]]
"""The best answer first, then those that are about as good."""

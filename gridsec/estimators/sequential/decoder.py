"""Interface of decoders that replace the search: same feeder, inverters and limits.

A decoder gets the mean residuals of one tick with their covariance, and returns accused meters. Everything
else, from the measurements to confirmation and reconstruction, is shared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential.conditional import Posterior
from gridsec.estimators.sequential.search import Limits


@dataclass(frozen=True, slots=True, eq=False)
class DecoderInput:
    """Input of a decoder. p meters."""

    whole: Posterior  # posterior of all meters with a reading, not to be changed
    m: Floats  # (p,) readings minus the model, squared pu; any finite value without a reading
    available: Bools  # (p,) meters with a reading
    limits: Limits  # rule of the limits
    trusted: Bools  # (p,) meters trusted before
    above_limit: Bools  # (p,) residual above the limit with these
    max_attacked: int  # largest number of accusations
    like: float  # least likelihood ratio that decides against a rival


@dataclass(frozen=True, slots=True, eq=False)
class DecoderAnswer:
    """Answer of a decoder."""

    meters: Bools  # (p,) accused meters
    worse: float = 0.0  # cost above that of the best answer


Decoder = Callable[[DecoderInput], tuple[DecoderAnswer, ...]]
"""The best answer first, then those about as good."""

"""Error correction over the reals for stacked vectors (lee2018, chapters 2 and 4).

Modules: `stacks` (detectable and correctable errors), `search` (l0 decoding, basis pursuit, orthogonal
matching pursuit), `noise` (bounded noise, all constants), `gaussian` (minimum variance, chi-square,
hypotheses), `partial_bounded` and `partial_gaussian` (decoders on top of partial observers).
"""

from gridsec.secure.decode import gaussian, noise, partial_bounded, partial_gaussian, search
from gridsec.secure.decode.search import Decoder, DecodeResult, design, exact
from gridsec.secure.decode.stacks import (
    Stack,
    annihilator,
    clean,
    cospark,
    error_correctable,
    error_detectable,
    residual,
    sensors_in_error,
    spark,
)

__all__ = [
    "DecodeResult",
    "Decoder",
    "Stack",
    "annihilator",
    "clean",
    "cospark",
    "design",
    "error_correctable",
    "error_detectable",
    "exact",
    "gaussian",
    "noise",
    "partial_bounded",
    "partial_gaussian",
    "residual",
    "search",
    "sensors_in_error",
    "spark",
]

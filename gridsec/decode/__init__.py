"""Error correction over the reals for stacked vectors (lee2018, chapter 2).

Modules: `stacks` (detectability and correctability), `search` (l0 decoding over a finite set),
`noise` (bounded noise, all constants), `gaussian` (minimum variance, chi-square, hypotheses), `probability`
(from Gaussian to bounded), `sparse` (basis pursuit, orthogonal matching pursuit).
"""

from gridsec.decode import gaussian, noise, probability, search, sparse
from gridsec.decode.search import Decoded, Decoder, design, exact
from gridsec.decode.stacks import (
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
    "Decoded",
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
    "probability",
    "residual",
    "search",
    "sensors_in_error",
    "spark",
    "sparse",
]

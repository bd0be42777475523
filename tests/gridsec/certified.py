"""What tests of certificates share."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np

from gridsec.observers.certificates import Certificate

seeds = st.integers(0, 100_000)


def norm(certificate: Certificate, e: np.ndarray) -> np.ndarray:
    """The certificate's norm of errors in the last axis."""
    if certificate.kind == "small-gain":
        return np.max(np.abs(e) / certificate.P, axis=-1)
    return np.sqrt(np.einsum("...i,ij,...j->...", e, certificate.P, e))

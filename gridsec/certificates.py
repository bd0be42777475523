"""Closed-form proofs that the direct-injection observer forgets its errors, for all meter sets at once."""

from __future__ import annotations

from dataclasses import dataclass

from gridsec.arrays import Floats, frozen


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """Why an observer's error decays, and how much disturbances can hold it up.

    Attributes
    ----------
    kind
        `reactance`, `small-gain` or `lmi`.
    P : (n, n) or (n,)
        Matrix of the norm `sqrt(e^T P e)`, or weights of the norm `max |e_i| / P_i`.
    rate
        The error in that norm decays at least like `exp(-rate t)`, 1/s.
    noise, load, attack
        Steady error in that norm for each pu of meter noise, load error, attack (largest entry).
    margin
        Slack of the condition, recomputed in NumPy; positive: it holds.
    status
        One sentence about how the certificate came about.
    """

    kind: str
    P: Floats
    rate: float
    noise: float
    load: float
    attack: float
    margin: float
    status: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "P", frozen(self.P))

"""What every method answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.peers.scene import Reading
from gridsec.arrays import Bools, Floats


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Named meters. N customers.

    Attributes
    ----------
    named : (N,)
        Customers with a manipulated voltage meter.
    others
        Other explanations with their likelihood, the best first; `named` has the rest of it.
    v : (N,)
        Estimated voltages, pu; None where the method has no answer.
    failed
        The method says that it has no result.
    """

    named: Bools
    others: tuple[tuple[Bools, float], ...] = ()
    v: Floats | None = None
    failed: bool = False


Method = Callable[[Reading], Answer]
"""One reading in, one answer out."""

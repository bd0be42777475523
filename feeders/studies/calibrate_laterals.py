"""Parts of a feeder on one phase, laterals and single customers: the files may have the wrong phase.

References
----------
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Ints
from gridsec.phases import PHASES, ThreePhaseFeeder

__all__ = ["Lateral", "alone", "laterals"]


@dataclass(frozen=True, slots=True, eq=False)
class Lateral:
    """Part of a feeder behind a line of one phase that begins at a bus of several; or a customer there.

    Attributes
    ----------
    customers
        All on it, by index.
    lines
        All its lines, indices into the tables, the first line first; none of a customer.
    phase
        Its phase.
    place
        The place that feeds it.
    others
        Places of the other phases at the same bus, by phase.
    """

    customers: Ints
    lines: tuple[int, ...]
    phase: str
    place: int
    others: Mapping[str, int]

    def to(self, phase: str) -> tuple[Ints, int, int]:
        """Its customers, the place that feeds it, and the place of another phase there."""
        return self.customers, self.place, self.others[phase]


def laterals(feeder: ThreePhaseFeeder, lines: Sequence[tuple[int, ...]], place: Ints) -> tuple[Lateral, ...]:
    """Single-phase laterals of a tree.

    Parameters
    ----------
    feeder
        The tree.
    lines
        The lines of each branch, indices into the tables.
    place : (Q, 2)
        Bus and phase of each place.
    """
    at = {(bus, PHASES[phase]): q for q, (bus, phase) in enumerate(place.tolist())}
    above, own = feeder.phases[feeder.parent], feeder.phases[1:]
    buses = np.arange(len(feeder.buses))
    out = []
    for k in np.flatnonzero((own.sum(axis=1) == 1) & (above.sum(axis=1) > 1)).tolist():
        fed, was = int(feeder.parent[k]), PHASES[int(own[k].argmax())]
        below = [bus - 1 for bus in np.flatnonzero(_below(feeder, buses, k + 1)).tolist() if bus != k + 1]
        out.append(
            Lateral(
                customers=np.flatnonzero(_below(feeder, feeder.bus, k + 1)),
                lines=tuple(row for branch in (k, *below) for row in lines[branch]),
                phase=was,
                place=at[fed, was],
                others={phase: at[fed, phase] for phase in PHASES if phase != was and (fed, phase) in at},
            )
        )
    return tuple(out)


def alone(feeder: ThreePhaseFeeder, phases: Sequence[str], place: Ints) -> tuple[Lateral, ...]:
    """Single-phase customers at buses of several phases.

    Parameters
    ----------
    feeder
        The tree.
    phases
        Phases of each customer.
    place : (Q, 2)
        Bus and phase of each place.
    """
    at = {(bus, PHASES[phase]): q for q, (bus, phase) in enumerate(place.tolist())}
    out = []
    for k, (bus, own) in enumerate(zip(feeder.bus.tolist(), phases, strict=True)):
        others = {phase: at[bus, phase] for phase in PHASES if phase != own and (bus, phase) in at}
        if len(own) == 1 and others:
            out.append(Lateral(np.array([k]), (), own, at[bus, own], others))
    return tuple(out)


def _below(feeder: ThreePhaseFeeder, buses: Ints, first: int) -> Bools:
    """Whether buses are this one or behind it."""
    start = feeder.start[buses]
    return np.asarray((feeder.start[first] <= start) & (start < feeder.stop[first]))

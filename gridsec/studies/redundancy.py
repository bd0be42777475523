"""How many lying meters a feeder withstands, meter by meter and part by part.

References
----------
lee2018, Definitions 3.1.1 and 3.1.3, Propositions 3.1.2, 3.1.9 and 3.2.2; docs/theory-studies.md, section 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gridsec.arrays import Bools, Ints
from gridsec.feeder import Feeder
from gridsec.index import Index
from gridsec.network import InPhases, Network
from gridsec.phases import ThreePhaseFeeder
from gridsec.studies.patterns import Patterns, fewest_meters

__all__ = ["Meter", "Part", "meter_redundancy", "part_redundancy", "parts", "tree_bus"]


@dataclass(frozen=True, slots=True, eq=False)
class Meter:
    """What one meter means for all.

    Attributes
    ----------
    own
        The fewest liars, this meter among them, that imitate a pattern: its security index.
    without
        The index of all other meters, this one silent.
    critical
        Without it some pattern is invisible to all others: its own index is 1, its lies cannot be detected.
    """

    own: Index
    without: Index
    critical: bool


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A part of a feeder: what is fed through one bus, and by no way around it.

    Attributes
    ----------
    bus
        The bus.
    branch
        Whether a line leads from it to the busbar.
    meters : (k,)
        The meters there.
    """

    bus: int
    branch: bool
    meters: Ints


def meter_redundancy(given: Patterns, meter: int, silent: Bools) -> Meter:
    """Security index of one meter, and the index of the others without it.

    Parameters
    ----------
    given
        The patterns.
    meter
        The meter; not a silent one.
    silent : (p,)
        Meters that are not there.
    """
    own = fewest_meters(given, silent=silent, must=meter)
    gone = silent.copy()
    gone[meter] = True
    return Meter(own, fewest_meters(given, silent=gone), own.count == 1.0)


def part_redundancy(given: Patterns, part: Part, silent: Bools) -> Index:
    """The fewest liars inside one part that imitate a pattern, all meters outside being honest.

    Up to `Index.correctable` liars, all of them in the part, are identified, and no more in general.

    Parameters
    ----------
    given
        The patterns.
    part
        From `parts`.
    silent : (p,)
        Meters that are not there.
    """
    honest = np.ones(silent.size, dtype=np.bool_)
    honest[part.meters] = False
    return fewest_meters(given, honest=honest, silent=silent)


def tree_bus(feeder: Network) -> Ints:
    """Bus of each customer in the feeder's tree, whatever its phase, (N,).

    Parameters
    ----------
    feeder
        The feeder.
    """
    return feeder.tree.at if isinstance(feeder, InPhases) else feeder.bus


def parts(feeder: Feeder | ThreePhaseFeeder, buses: Ints, ties: Ints) -> Sequence[Part]:
    """All parts of a feeder that differ in their meters, those nearest the busbar first.

    A part has all phases of its buses.

    Parameters
    ----------
    feeder
        The feeder's tree.
    buses : (p,)
        Bus of each meter.
    ties : (t, 2)
        Buses at both ends of the lines that close loops in it.
    """
    found: dict[tuple[int, ...], Part] = {}
    lines = np.vstack([np.column_stack([feeder.parent, np.arange(1, len(feeder.buses))]), ties])
    beside = lines[(lines == 0).any(axis=1)].max(axis=1)
    for bus in range(1, len(feeder.buses)):
        inside = np.flatnonzero(_fed_through(feeder, lines, bus)[buses])
        if inside.size:
            found.setdefault(tuple(inside.tolist()), Part(bus, bool((beside == bus).any()), inside))
    return tuple(found.values())


def _fed_through(feeder: Feeder | ThreePhaseFeeder, lines: Ints, bus: int) -> Bools:
    """Buses that lose the busbar with one, itself among them; on a tree all that are behind it."""
    if len(lines) < len(feeder.buses):
        return np.asarray((feeder.start >= feeder.start[bus]) & (feeder.start < feeder.stop[bus]))
    left = lines[(lines != bus).all(axis=1)]
    graph = coo_array((np.ones(len(left)), left.T), shape=(len(feeder.buses),) * 2)
    _, piece = connected_components(graph, directed=False)
    return np.asarray(piece != piece[0])

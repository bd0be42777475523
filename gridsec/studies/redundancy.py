"""Number of manipulated meters that a feeder withstands, meter by meter and part by part.

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
    """Redundancy with and without one meter.

    Attributes
    ----------
    own
        Smallest set of manipulated meters, this one among them, that imitates a pattern: its security index.
    without
        Index of all other meters, with this one unavailable.
    critical
        True if a pattern is invisible to all others: the own index is 1, and attacks on it are undetectable.
    """

    own: Index
    without: Index
    critical: bool


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Part of a feeder: everything fed through one bus alone.

    Attributes
    ----------
    branch
        True if a line leads from `bus` to the busbar.
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
    meter
        An available meter.
    silent : (p,)
        Unavailable meters.
    """
    own = fewest_meters(given, silent=silent, must=meter)
    gone = silent.copy()
    gone[meter] = True
    return Meter(own, fewest_meters(given, silent=gone), own.count == 1.0)


def part_redundancy(given: Patterns, part: Part, silent: Bools) -> Index:
    """Smallest set of manipulated meters inside one part that imitates a pattern.

    All meters outside are unmanipulated. Up to `Index.correctable` manipulated meters, all of them in the
    part, are identified, and no more in general.

    Parameters
    ----------
    part
        From `parts`.
    silent : (p,)
        Unavailable meters.
    """
    honest = np.ones(silent.size, dtype=np.bool_)
    honest[part.meters] = False
    return fewest_meters(given, honest=honest, silent=silent)


def tree_bus(feeder: Network) -> Ints:
    """Bus of each customer in the feeder's tree, for any phase, (N,)."""
    return feeder.tree.at if isinstance(feeder, InPhases) else feeder.bus


def parts(feeder: Feeder | ThreePhaseFeeder, buses: Ints, ties: Ints) -> Sequence[Part]:
    """All parts of a feeder with different sets of meters, those nearest the busbar first.

    A part has all phases of its buses.

    Parameters
    ----------
    feeder
        The feeder's tree.
    buses : (p,)
        Bus of each meter.
    ties : (t, 2)
        Buses at both ends of the lines that close loops.
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
    """Buses that lose the busbar if one is removed, that bus included; on a tree all behind it."""
    if len(lines) < len(feeder.buses):
        return np.asarray((feeder.start >= feeder.start[bus]) & (feeder.start < feeder.stop[bus]))
    left = lines[(lines != bus).all(axis=1)]
    graph = coo_array((np.ones(len(left)), left.T), shape=(len(feeder.buses),) * 2)
    _, piece = connected_components(graph, directed=False)
    return np.asarray(piece != piece[0])

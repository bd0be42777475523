"""Number of manipulated meters that a feeder withstands, and patterns that hide manipulations.

Unknown powers change all squared voltages by ``W c``, with c constant during the analysis. The inverters
react. About a trajectory with slopes d of the droop curves,

    x' = A x + G diag(d) (H x - W_inverters c),   c' = 0,   y = C x - W_meters c

is a pair. Its eigenvalue 0 belongs to *persistent patterns*, its other eigenvalues to decaying transients of
the inverters. Attacks are hidden while they equal such a pattern.

Source: lee2018, chapter 3, Definitions 3.1.1 and 3.1.3, Propositions 3.1.2, 3.1.9 and 3.2.2;
docs/theory-studies.md, sections 1 and 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gridsec.arrays import Bools, Floats, Ints, unit_rows
from gridsec.errors import InputInvalid, Problem
from gridsec.grid.network import Network, Power
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import ThreePhaseFeeder
from gridsec.observers.lure import Lure
from gridsec.secure.index import (
    MOST_NODES,
    Index,
    Matrix,
    Sparsest,
    eigenspaces,
    fewest,
    fewest_rows,
    kernel,
    linearise,
)

__all__ = [
    "FeederSection",
    "Meter",
    "Patterns",
    "fewest_meters",
    "from_busbar",
    "meter_redundancy",
    "part_redundancy",
    "parts",
    "patterns",
    "unknown_pair",
    "unknown_voltages",
]


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """Directions of hidden attacks: eigenspaces of a pair. n states, p meters."""

    spaces: tuple[Matrix, ...]  # (n, g) each: orthonormal bases of the eigenspaces to search
    # (p, g) each: their images at the meters, each meter's row of C scaled to length one, or zero
    seen: tuple[Matrix, ...]
    tol: float  # products of unit vectors up to this count as zero

    @property
    def dimension(self) -> int:
        """Dimension of all spaces together."""
        return sum(space.shape[1] for space in self.spaces)

    def blind(self, live: Bools) -> Floats:
        """Basis of the part invisible to all available meters, real and imaginary columns, (n, k)."""
        lost = [
            space @ kernel(seen[live], self.tol) for space, seen in zip(self.spaces, self.seen, strict=True)
        ]
        whole = np.hstack(lost) if lost else np.zeros((0, 0))
        return np.hstack([whole.real, whole.imag]) if np.iscomplexobj(whole) else np.asarray(whole)


def unknown_voltages(feeder: Network, unknown: Ints, *, busbar: bool, tol: float) -> Floats:
    """Orthonormal basis W of the effects of unknown powers on the customers' squared voltages, (N, d).

    The range of ``[2 R_U, 2 X_U]``, and where the busbar's voltage is unknown too, of a column of ones; in
    three phases of a column for each, ones where its customers are. Powers without effect on any customer's
    voltage are not counted.

    unknown (k,): customers with unknown active and reactive powers.
    tol: columns up to this fraction of the longest have no effect. Singular values up to this fraction of the
        largest, of columns of unit length, are zero.
    """
    powers = np.hstack([feeder.between(power)[:, unknown] for power in Power])
    columns = unit_rows(powers.T, tol=tol).T
    if busbar:
        columns = np.hstack([columns, unit_rows(from_busbar(feeder).T, tol=tol).T])
    if not columns.any():
        return np.zeros((feeder.bus.size, 0))
    _, s, vh = np.linalg.svd(columns, full_matrices=False)
    some = s > tol * s[0]
    # The left singular vectors, with every row as exact as that of its customer. Those of the decomposition
    # are only as exact as the longest row; a row beside the busbar would be rounding.
    return np.asarray(columns @ (vh[some].T / s[some]))


def from_busbar(feeder: Network) -> Floats:
    """Effect of each busbar voltage on the customers' squared voltages, (N, 1), or (N, 3) in phases."""
    first = feeder.busbar_places()
    of_each = feeder.same_busbar_phase(feeder.bus, np.arange(first.stop))
    return np.array(np.broadcast_to(of_each, (feeder.bus.size, first.stop)))


def unknown_pair(lure: Lure, slope: Floats, W: Floats) -> tuple[Floats, Floats]:
    """The pair (A, C) of the module's head, with states scaled to similar size.

    slope (m,): slope of each droop curve.
    W (N, d): from `unknown_voltages`.
    """
    A, C = linearise(lure, slope)
    # Injections in units of the voltages that they cause: subspaces stay, and ranks become decidable. Effects
    # of inverters on each other are included, since meters may see none of the inverters.
    unit = float(np.linalg.norm(np.vstack([lure.C, lure.H]), 2)) or 1.0
    d = W.shape[1]
    whole = np.block([[A, -unit * (lure.G * slope) @ lure.F @ W], [np.zeros((d, A.shape[0] + d))]])
    return whole, np.hstack([C / unit, -lure.D @ W])


def patterns(A: Floats, C: Floats, *, persistent: bool, tol: float) -> Patterns:
    """Eigenspaces in which an attack can stay invisible for ever.

    A, C (n, n), (p, n): a pair in continuous time.
    persistent: only those of eigenvalues that do not decay: decaying attacks are left out, and observability
        becomes detectability.
    tol: as in `gridsec.secure.index.dynamic_index`; rows of C up to this fraction of the longest count as
        zero, too.
    """
    found = eigenspaces(A, tol=tol) if A.size else ()
    if persistent:
        found = tuple(each for each in found if each.unstable(discrete=False, tol=tol))
    rows = unit_rows(C, tol=tol)
    spaces: list[Matrix] = []
    for each in found:
        # A real eigenvalue has real eigenvectors, and real arithmetic is four times as fast.
        real = abs(each.value.imag) <= tol and float(np.abs(each.vectors.imag).max(initial=0.0)) <= tol
        spaces.append(each.vectors.real if real else each.vectors)
    return Patterns(tuple(spaces), tuple(np.asarray(rows @ space) for space in spaces), tol)


def fewest_meters(
    given: Patterns,
    *,
    honest: Bools | None = None,
    silent: Bools | None = None,
    must: int | None = None,
    below: float = 0.0,
    most: int = MOST_NODES,
) -> Index:
    """Smallest number of manipulated meters that imitate a pattern visible to an available meter.

    Patterns invisible to all meters (`Patterns.blind`) need no attack and are left out.

    honest (p,): meters that cannot be manipulated: only patterns invisible to them remain.
    silent (p,): unavailable meters.
    below, most: as in `gridsec.secure.index.fewest`.
    Returns Index: infinite without a pattern to imitate.
    Raises DesignInfeasible after `most` nodes; ValueError if `must` is protected or unavailable.
    """
    p = given.seen[0].shape[0] if given.seen else 0
    none = np.zeros(p, dtype=np.bool_)
    silent = none if silent is None else silent[:p]
    bound = none if honest is None else honest[:p] & ~silent
    free = np.flatnonzero(~bound & ~silent)
    if must is not None and p and must not in free:
        raise InputInvalid(
            [Problem("inconsistent", f"meter {must} must be manipulated, but is protected or unavailable")]
        )
    at = None if must is None else int(np.searchsorted(free, must))
    best = Index(np.inf, np.zeros(0, dtype=np.intp), np.zeros(0))
    for space, seen in zip(given.spaces, given.seen, strict=True):
        left = kernel(seen[bound], given.tol) if bound.any() else np.eye(space.shape[1])
        for part in _components(seen[free] @ left, given.tol):
            found = _fewest(seen[free] @ (left @ part), at, given.tol, below=below, most=most)
            if found.count < best.count:
                best = Index(found.count, free[found.blocks], space @ (left @ part @ found.direction))
    return best


def _fewest(seen: Matrix, must: int | None, tol: float, *, below: float, most: int) -> Sparsest:
    if seen.shape[1] == 1:
        # One direction leaves no choice.
        who = np.flatnonzero(np.abs(seen[:, 0]) > tol)
        if must is None or must in who:
            return Sparsest(float(who.size), who, np.ones(1))
        return Sparsest(np.inf, who[:0], np.zeros(0))
    found = None if below > 0.0 else fewest_rows(seen, tol=tol, must=must)
    if found is not None:
        return found
    return fewest(list(seen[:, None, :]), np.eye(seen.shape[1]), tol=tol, must=must, below=below, most=most)


def _components(seen: Matrix, tol: float) -> list[Matrix]:
    """Split the images into subspaces without common meters: a sparsest direction lies in one of them.

    In a basis that is the identity at as many meters as it has directions, these are the connected components
    of the bipartite graph of its entries: those of the matroid of the rows.

    seen (p, g): image of a basis at each meter.
    Returns (g, k) each: orthonormal bases; directions invisible to all meters are left out.
    """
    # Counts do not depend on invisible directions, so their complement suffices.
    _, sizes, vh = np.linalg.svd(seen, full_matrices=False)
    basis = np.asarray(vh[: int(np.count_nonzero(sizes > tol))].conj().T)
    if basis.shape[1] <= 1:
        return [basis] if basis.size else []
    seen = seen @ basis
    _, _, pivots = qr(seen.conj().T, mode="economic", pivoting=True)
    change = np.linalg.inv(seen[pivots[: basis.shape[1]]])
    linked = (np.abs(seen @ change) > tol).astype(np.intp)
    count, label = connected_components(linked.T @ linked, directed=False)
    basis = basis @ change
    return [np.asarray(np.linalg.qr(basis[:, label == k])[0]) for k in range(count)]


@dataclass(frozen=True, slots=True, eq=False)
class Meter:
    """Redundancy with and without one meter."""

    # smallest set of manipulated meters, this one among them, that imitates a pattern: its security index
    own: Index
    without: Index  # index of all other meters, with this one unavailable
    # True if a pattern is invisible to all others: the own index is 1, and attacks on it are undetectable
    critical: bool


@dataclass(frozen=True, slots=True, eq=False)
class FeederSection:
    """Part of a feeder: everything fed through one bus alone."""

    bus: int
    branch: bool  # True if a line leads from `bus` to the busbar
    meters: Ints  # (k,) the meters there


def meter_redundancy(given: Patterns, meter: int, silent: Bools) -> Meter:
    """Security index of one meter, and the index of the others without it."""
    own = fewest_meters(given, silent=silent, must=meter)
    gone = silent.copy()
    gone[meter] = True
    return Meter(own, fewest_meters(given, silent=gone), own.count == 1.0)


def part_redundancy(given: Patterns, part: FeederSection, silent: Bools) -> Index:
    """Smallest set of manipulated meters inside one part that imitates a pattern.

    All meters outside are unmanipulated. Up to `Index.correctable` manipulated meters, all of them in the
    part, are identified, and no more in general.

    silent (p,): unavailable meters.
    """
    honest = np.ones(silent.size, dtype=np.bool_)
    honest[part.meters] = False
    return fewest_meters(given, honest=honest, silent=silent)


def parts(feeder: Feeder | ThreePhaseFeeder, buses: Ints, ties: Ints) -> Sequence[FeederSection]:
    """All parts of a feeder with different sets of meters, those nearest the busbar first.

    A part has all phases of its buses.

    buses (p,): bus of each meter.
    ties (t, 2): buses at both ends of the lines that close loops.
    """
    found: dict[tuple[int, ...], FeederSection] = {}
    lines = np.vstack([np.column_stack([feeder.parent, np.arange(1, len(feeder.buses))]), ties])
    beside = lines[(lines == 0).any(axis=1)].max(axis=1)
    for bus in range(1, len(feeder.buses)):
        inside = np.flatnonzero(_fed_through(feeder, lines, bus)[buses])
        if inside.size:
            found.setdefault(tuple(inside.tolist()), FeederSection(bus, bool((beside == bus).any()), inside))
    return tuple(found.values())


def _fed_through(feeder: Feeder | ThreePhaseFeeder, lines: Ints, bus: int) -> Bools:
    """Buses that lose the busbar if one is removed, that bus included; on a tree all behind it."""
    if len(lines) < len(feeder.buses):
        start, stop = feeder.walk.start, feeder.walk.stop
        return np.asarray((start >= start[bus]) & (start < stop[bus]))
    left = lines[(lines != bus).all(axis=1)]
    graph = coo_array((np.ones(len(left)), left.T), shape=(len(feeder.buses),) * 2)
    _, piece = connected_components(graph, directed=False)
    return np.asarray(piece != piece[0])

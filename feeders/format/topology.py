"""Graph of the feeder: fused buses, a tree below the busbar, loops, islands.

The checks and the loader use the same graph.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from feeders.format.columns import LineRow

LOOPS_SHOWN = 20


@dataclass(frozen=True, slots=True)
class Edge:
    """Closed line: id, buses, impedance zero or not, nominal voltage at its end, number of phases."""

    line: str
    from_bus: str
    to_bus: str
    zero: bool
    to_volt: float | None = None
    phases: int = 3


@dataclass(frozen=True, slots=True)
class Tree:
    """Part of the feeder that is connected to the busbar, in topological order."""

    group: dict[str, int]  # Fused bus index of every connected bus; 0 is the busbar
    buses: tuple[str, ...]  # One id per fused bus: the first of its members in the order of the input
    parent: tuple[int, ...]  # Fused bus that feeds bus k + 1; always at most k
    branch: tuple[int, ...]  # Index (into the edges given) of the line that feeds bus k + 1
    # Indices of the edges that close loops: each joins two buses that are connected without it
    ties: tuple[int, ...]
    # Indices of the edges of each loop: of every tie that joins a bus to itself, and of at most LOOPS_SHOWN
    # others. A radial feeder has none
    loops: tuple[tuple[int, ...], ...]
    islands: tuple[tuple[str, ...], ...]  # Unconnected buses, one tuple for each connected piece


class _Sets:
    """Disjoint sets of buses; the representative is the first member in the order of the input."""

    def __init__(self, order: Iterable[str]) -> None:
        self.rank = {bus: k for k, bus in enumerate(dict.fromkeys(order))}
        self.above = {bus: bus for bus in self.rank}

    def find(self, bus: str) -> str:
        root = bus
        while self.above[root] != root:
            root = self.above[root]
        while self.above[bus] != root:
            self.above[bus], bus = root, self.above[bus]
        return root

    def join(self, one: str, other: str) -> bool:
        """Unite the sets of two buses; False if both are in one set already."""
        a, b = self.find(one), self.find(other)
        if a == b:
            return False
        first, second = (a, b) if self.rank[a] < self.rank[b] else (b, a)
        self.above[second] = first
        return True


def closed_tree(busbar: str, lines: Iterable[LineRow]) -> tuple[list[LineRow], Tree]:
    """Closed lines of a feeder, and their tree."""
    closed = [row for row in lines if row.closed]
    edges = [Edge(row.line, row.from_bus, row.to_bus, row.fuses, phases=len(row.phases)) for row in closed]
    return closed, tree(busbar, edges)


def tree(busbar: str, edges: Sequence[Edge], others: Iterable[str] = ()) -> Tree:
    """Fuse the buses at both ends of closed lines without impedance and walk the others from the busbar.

    `others` are further buses that need a connection, such as ends of open lines.
    """
    order = [busbar, *(bus for edge in edges for bus in (edge.from_bus, edge.to_bus)), *others]
    fused, connected = _Sets(order), _Sets(order)
    for edge in edges:
        if edge.zero:
            fused.join(edge.from_bus, edge.to_bus)
            connected.join(edge.from_bus, edge.to_bus)
    neighbours: dict[str, list[tuple[int, str]]] = {bus: [] for bus in fused.rank}
    closing = _closing(edges, connected)
    for k, edge in enumerate(edges):
        if not edge.zero and k not in closing:
            a, b = fused.find(edge.from_bus), fused.find(edge.to_bus)
            neighbours[a].append((k, b))
            neighbours[b].append((k, a))
    index, parent, branch = _walk(fused.find(busbar), neighbours)
    short = [k for k in closing if fused.find(edges[k].from_bus) == fused.find(edges[k].to_bus)]
    shown = sorted([*short, *[k for k in closing if k not in short][:LOOPS_SHOWN]])
    loops = tuple(_loop(k, edges[k], fused, neighbours) for k in shown)
    pieces: dict[str, list[str]] = {}
    for bus in fused.rank:
        if fused.find(bus) not in index:
            pieces.setdefault(connected.find(bus), []).append(bus)
    return Tree(
        {bus: index[fused.find(bus)] for bus in fused.rank if fused.find(bus) in index},
        tuple(index),
        parent,
        branch,
        tuple(closing),
        loops,
        tuple(map(tuple, pieces.values())),
    )


def _closing(edges: Sequence[Edge], connected: _Sets) -> list[int]:
    """Edges that close loops, preferably those of fewer phases and the later ones (Kruskal).

    The tree of the other edges has the largest possible sum of phases. If any tree brings every phase of each
    bus, this one does: such a tree has that sum, the number of buses with the phase less one, over the
    phases.
    """
    order = sorted((k for k, edge in enumerate(edges) if not edge.zero), key=lambda k: -edges[k].phases)
    return sorted(k for k in order if not connected.join(edges[k].from_bus, edges[k].to_bus))


def _walk(
    root: str, neighbours: dict[str, list[tuple[int, str]]]
) -> tuple[dict[str, int], tuple[int, ...], tuple[int, ...]]:
    """Number the buses depth first, branch by branch, as in an operator's diagram."""
    index: dict[str, int] = {}
    parent: list[int] = []
    branch: list[int] = []
    stack = [(root, -1, -1)]
    while stack:
        bus, above, line = stack.pop()
        index[bus] = len(index)
        if above >= 0:
            parent.append(above)
            branch.append(line)
        stack.extend((b, index[bus], k) for k, b in reversed(neighbours[bus]) if b not in index)
    return index, tuple(parent), tuple(branch)


def _loop(
    closing: int, edge: Edge, fused: _Sets, neighbours: dict[str, list[tuple[int, str]]]
) -> tuple[int, ...]:
    """Edges of the loop that one more edge closes: that edge and the path between its ends."""
    start, goal = fused.find(edge.from_bus), fused.find(edge.to_bus)
    came: dict[str, tuple[int, str] | None] = {start: None}
    stack = [start]
    while stack and goal not in came:
        bus = stack.pop()
        for k, other in neighbours[bus]:
            if other not in came:
                came[other] = (k, bus)
                stack.append(other)
    path = [closing]
    step = came.get(goal)
    while step is not None:
        path.append(step[0])
        step = came[step[1]]
    return tuple(path)

"""Nominal voltages of a feeder's buses: that of the busbar, until a transformer leads to another.

`to_volt` of a line is the nominal voltage of its `to_bus` where that of its `from_bus` is another one. It is
stated on the way from the busbar; a line that closes a loop must find it at both its ends.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from gridsec.errors import Problem

if TYPE_CHECKING:
    from feeders.schema import LineRow
    from feeders.topology import Edge, Tree
    from gridsec.arrays import Floats

SAME_LEVEL: Final = 1e-6
"""Part by which two nominal voltages may differ and still be one: 230.94 and 400 / sqrt(3)."""


def same_level(one: float, other: float) -> bool:
    """Return whether two nominal voltages are one."""
    return abs(one - other) <= SAME_LEVEL * max(one, other)


def told(nominal_volt: Floats, form: str = ".1f") -> str:
    """Return a feeder's nominal voltages in words: "11547.0 V and 230.9 V".

    Parameters
    ----------
    nominal_volt : (n,)
        Of its places, V, the busbar first.
    form
        How numbers are written.
    """
    several = dict.fromkeys(f"{volt:{form}} V" for volt in nominal_volt.tolist())
    return " and ".join(several)


def nominal_volts(found: Tree, edges: Sequence[Edge | LineRow], volt: float) -> list[float]:
    """Return the nominal voltage of every bus, V, phase to neutral.

    Parameters
    ----------
    found, edges
        The tree, and the closed lines that it was made of.
    volt
        That of the busbar, V.
    """
    nominal = _found(found, edges, volt)
    for k, above in enumerate(found.parent):  # only what `problems` tells is not known by now
        nominal.setdefault(k + 1, nominal[above])
    return [nominal[k] for k in range(len(found.buses))]


def _found(found: Tree, edges: Sequence[Edge | LineRow], volt: float) -> dict[int, float]:
    """Return the nominal voltages that a way from the busbar leads to, which passes transformers forwards."""
    near: dict[int, list[tuple[int, float | None]]] = defaultdict(list)
    for line in edges:
        if line.from_bus in found.group:
            here, there = found.group[line.from_bus], found.group[line.to_bus]
            near[here].append((there, line.to_volt))
            if line.to_volt is None:
                near[there].append((here, None))
    nominal, order = {0: volt}, [0]
    for bus in order:
        for other, changed in near[bus]:
            if other not in nominal:
                nominal[other] = nominal[bus] if changed is None else changed
                order.append(other)
    return nominal


def problems(found: Tree, edges: Sequence[Edge | LineRow], volt: float) -> Iterator[tuple[int, Problem]]:
    """Yield every line whose `to_volt` cannot be, with what is wrong; arguments as of `nominal_volts`."""
    nominal, known = nominal_volts(found, edges, volt), _found(found, edges, volt).keys()
    above = dict(zip(found.branch, found.parent, strict=True))
    for k, line in enumerate(edges):
        if line.from_bus not in found.group:
            continue
        here, there = found.group[line.from_bus], found.group[line.to_bus]
        told = nominal[here] if line.to_volt is None else line.to_volt
        backwards = line.to_volt is not None and above.get(k) == there
        if here == there and not same_level(told, nominal[here]):
            yield (
                k,
                Problem(
                    "zero-impedance",
                    f"{told:g} on a line without impedance; expected the transformer's r_ohm and x_ohm",
                ),
            )
        elif backwards and (here not in known or not same_level(told, nominal[there])):
            yield (
                k,
                Problem("backwards", f"{told:g}, but {line.to_bus!r} is on the side of the busbar; {_TURN}"),
            )
        elif not same_level(told, nominal[there]):
            yield (
                k,
                Problem(
                    "inconsistent",
                    f"{told:g} V at {line.to_bus!r}, {nominal[there]:g} V around the loop; expected the same",
                ),
            )


_TURN: Final = (
    "expected from_bus and to_bus exchanged, with the impedances of the other side: a transformer leads away "
    "from the busbar"
)

"""Radial feeder of three phases in per unit.

1 pu of voltage is the nominal phase-to-neutral voltage V; 1 pu of power is a *third* of the three-phase
base power S, because powers are those of single phases here; 1 pu of impedance is ``3 V^2 / S`` as on a
balanced feeder, so that its per-unit voltages, impedances and flows are the same. Neutral and earth return
are in the 3x3 blocks (Kron's reduction): voltages are phase to neutral, with a well grounded neutral.

References
----------
.. [1] W. H. Kersting, "Distribution System Modeling and Analysis", 3rd ed., CRC Press 2012, chapter 4.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, Phasors, frozen, frozen_ints
from gridsec.errors import FeederInvalid, Problem
from gridsec.trees import walk

PHASES = "abc"

ROTATION: Phasors = np.exp(-2j * np.pi / 3.0 * np.arange(3))
"""Phasors of a balanced system: phase b lags a by a third of a turn, and c lags b."""
ROTATION.flags.writeable = False

# Rounding of impedance tables, within which reciprocity and passivity hold.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ThreePhaseFeeder:
    """Radial feeder of up to three phases: b branches, b + 1 buses, rooted at the metered busbar (bus 0).

    Attributes
    ----------
    name
        Name of the feeder.
    parent : (b,)
        Bus that feeds bus k + 1; `parent[k] <= k`, so buses are in topological order.
    z : (b, 3, 3)
        Series impedance Z of the branch into bus k + 1, pu: the voltages along the three conductors drop by
        ``Z i``. Symmetric; rows and columns of absent phases are 0.
    phases : (b + 1, 3)
        Phases a, b, c present at each bus.
    bus : (N,)
        Bus of each customer. Several customers may share one; bus 0 is allowed.
    connected : (N, 3)
        Connected phases of each customer, between phase and neutral.
    customers : (N,)
        Identifiers of the customers.
    buses : (b + 1,)
        Identifiers of the buses, the busbar first.
    base_volt
        Nominal phase-to-neutral voltage (1 pu), V.
    base_kva
        Three-phase base power S, kVA; 1 pu of the power of a phase is a third of it.
    charging : (b, 3, 3)
        Total shunt susceptance of the branch into bus k + 1, pu; half of it at each end.
    of, at, phase : (C,)
        Derived. The connections, customer by customer, phase by phase: customer, bus, and phase 0, 1, 2.
    share : (C,)
        Derived. Share of the customer's power in each connection: 1 on a single phase, 1/3 on all three.
    start, stop, order, depth, enter, leave : (b + 1,); inside : (b + 1, b + 1) or None
        Derived. The walk around the tree, see `gridsec.trees.Walk`.
    half : (b + 1, 3, 3)
        Derived. Shunt susceptance at the buses, pu.

    Raises
    ------
    FeederInvalid
        With every problem found.
    """

    name: str
    parent: Ints
    z: Phasors
    phases: Bools
    bus: Ints
    connected: Bools
    customers: tuple[str, ...]
    buses: tuple[str, ...]
    base_volt: float
    base_kva: float
    charging: Floats
    of: Ints = field(init=False, repr=False)
    at: Ints = field(init=False, repr=False)
    phase: Ints = field(init=False, repr=False)
    share: Floats = field(init=False, repr=False)
    start: Ints = field(init=False, repr=False)
    stop: Ints = field(init=False, repr=False)
    order: Ints = field(init=False, repr=False)
    depth: Ints = field(init=False, repr=False)
    enter: Ints = field(init=False, repr=False)
    leave: Ints = field(init=False, repr=False)
    inside: Floats | None = field(init=False, repr=False)
    half: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        for name, kind in (("z", np.complex128), ("phases", np.bool_), ("connected", np.bool_)):
            own = np.array(getattr(self, name), dtype=kind, order="C")
            own.flags.writeable = False
            put(name, own)
        put("charging", frozen(self.charging))
        for name in ("parent", "bus"):
            put(name, frozen_ints(getattr(self, name)))
        problems = _shape_problems(self) or [*_branch_problems(self), *_customer_problems(self)]
        if problems:
            raise FeederInvalid(problems)
        found = walk(self.parent)
        for name in ("start", "stop", "order", "depth", "enter", "leave", "inside"):
            put(name, getattr(found, name))
        of, phase = np.nonzero(self.connected)
        put("of", frozen_ints(of))
        put("at", frozen_ints(self.bus[of]))
        put("phase", frozen_ints(phase))
        put("share", frozen(1.0 / self.connected.sum(axis=1)[of]))
        half = np.zeros((found.start.size, 3, 3))
        np.add.at(half, self.parent, 0.5 * self.charging)
        half[1:] += 0.5 * self.charging
        put("half", frozen(half))

    def connections(self, powers: Floats) -> Floats:
        """Split the customers' powers (…, N) over their connections (…, C), evenly over the phases."""
        return np.asarray(powers[..., self.of] * self.share)


def sequence_matrix(positive: Phasors | Floats, zero: Phasors | Floats) -> Phasors:
    """3x3 matrix of an element with interchangeable phases, from its sequence values.

    ``Z_self = (Z_0 + 2 Z_1) / 3`` on the diagonal and ``Z_mutual = (Z_0 - Z_1) / 3`` off the diagonal.

    Parameters
    ----------
    positive, zero : (…)
        Positive- and zero-sequence impedance (or admittance), any unit.

    Returns
    -------
    (…, 3, 3)
        The matrix in phases, same unit.

    References
    ----------
    Kersting 2012, chapter 4: the sequence impedances of a transposed line, solved for those of the phases.
    """
    one, none = (np.asarray(value, dtype=np.complex128)[..., None, None] for value in (positive, zero))
    return np.asarray(one * np.eye(3) + (none - one) / 3.0)


def _shape_problems(feeder: ThreePhaseFeeder) -> list[Problem]:
    """Problems of array lengths; all other checks require that there are none."""
    branches, customers = feeder.parent.size, len(feeder.customers)
    expected = (
        ("parent", feeder.parent.shape, (branches,)),
        ("z", feeder.z.shape, (branches, 3, 3)),
        ("charging", feeder.charging.shape, (branches, 3, 3)),
        ("phases", feeder.phases.shape, (branches + 1, 3)),
        ("buses", (len(feeder.buses),), (branches + 1,)),
        ("bus", feeder.bus.shape, (customers,)),
        ("connected", feeder.connected.shape, (customers, 3)),
    )
    return [
        Problem("shape", f"{what} has shape {has}; expected {wants}")
        for what, has, wants in expected
        if has != wants
    ]


def _branch_problems(feeder: ThreePhaseFeeder) -> list[Problem]:
    out = []
    for what in ("base_volt", "base_kva"):
        value = getattr(feeder, what)
        if not (np.isfinite(value) and value > 0):
            out.append(Problem("not-positive", f"{what} is {value}; it must be a positive number"))
    for k, above in enumerate(feeder.parent.tolist()):
        where = f"branch {k} into bus {feeder.buses[k + 1]!r}"
        if not 0 <= above <= k:
            out.append(
                Problem("not-radial", f"{where}: parent {above} does not precede it; expected 0 to {k}")
            )
            continue
        here, there = feeder.phases[k + 1], feeder.phases[above]
        if not here.any():
            out.append(Problem("no-phase", f"{where}: it has no phase; expected one, two or three"))
        elif (here & ~there).any():
            out.append(
                Problem(
                    "absent-phase",
                    f"{where}: phases {named(here)!r} but only {named(there)!r} "
                    f"arrive at {feeder.buses[above]!r}",
                )
            )
        lines = line_problems(feeder.z[k], feeder.charging[k], here)
        out.extend(Problem(problem.code, f"{where}: {problem}") for problem in lines)
    return out


def line_problems(z: Phasors, charging: Floats, present: Bools) -> list[Problem]:
    """Problems of the impedances and susceptances of a line.

    Parameters
    ----------
    z, charging : (3, 3)
        Series impedance and total shunt susceptance, pu.
    present : (3,)
        Phases of the line.
    """
    blocks = (("z", z), ("charging", charging))
    out = [
        Problem(problem.code, f"{what} {problem}")
        for what, block in blocks
        for problem in _block_problems(block, present)
    ]
    return out + _impedance_problems(z, present)


def _block_problems(block: Phasors | Floats, here: Bools) -> list[Problem]:
    """Problems of a 3x3 block, of impedances or of susceptances."""
    if not np.isfinite(block).all():
        return [Problem("not-finite", "is not finite")]
    out = []
    if block[~here].any() or block[:, ~here].any():
        out.append(Problem("absent-phase", "is not 0 on a phase that is absent"))
    if np.abs(block - block.T).max() > _ROUNDING * np.abs(block).max():
        out.append(Problem("not-symmetric", "is not symmetric; lines and cables are reciprocal"))
    return out


def _impedance_problems(z: Phasors, here: Bools) -> list[Problem]:
    if not np.isfinite(z).all():
        return []
    own = z[np.ix_(here, here)]
    if (np.diagonal(own) == 0).any():
        return [Problem("zero-impedance", "a phase without self-impedance; fuse the two buses")]
    # Only the losses of a passive line are never negative: only the matrix of resistances is semidefinite.
    if own.size and np.linalg.eigvalsh(0.5 * (own.real + own.real.T))[0] < -_ROUNDING * np.abs(own).max():
        return [
            Problem(
                "not-definite", "its resistances generate power; the matrix must be positive semidefinite"
            )
        ]
    return []


def _customer_problems(feeder: ThreePhaseFeeder) -> list[Problem]:
    out = []
    last = feeder.parent.size
    for name, bus, wanted in zip(feeder.customers, feeder.bus.tolist(), feeder.connected, strict=True):
        if not 0 <= bus <= last:
            out.append(
                Problem("unknown-index", f"customer {name!r}: bus {bus} does not exist; expected 0 to {last}")
            )
        elif not wanted.any():
            out.append(Problem("no-phase", f"customer {name!r}: is connected to no phase"))
        elif (wanted & ~feeder.phases[bus]).any():
            out.append(
                Problem(
                    "absent-phase",
                    f"customer {name!r}: phases {named(wanted)!r} but bus {feeder.buses[bus]!r} has only "
                    f"{named(feeder.phases[bus])!r}",
                )
            )
    for what, names in (("customer", feeder.customers), ("bus", feeder.buses)):
        counted = Counter(names)
        out.extend(
            Problem("duplicate", f"{what} {name!r} is named {times} times")
            for name, times in counted.items()
            if times > 1
        )
    return out


def named(present: Bools) -> str:
    """Letters of the phases that are present, (3,)."""
    return "".join(phase for phase, there in zip(PHASES, present, strict=True) if there)

"""Radial feeders in three phases: impedances in per unit, LinDist3Flow and its correction.

`ThreePhaseFeeder` is the radial tree of 3x3 blocks in per unit, `lindist3flow` its linear power flow of
squared phase voltages, `bus_voltages` the corrected one, and `PhasedFeeder` the form for estimators.

1 pu of voltage is the nominal phase-to-neutral voltage V; 1 pu of power is a *third* of the three-phase
base power S, because powers are those of single phases here; 1 pu of impedance is ``3 V^2 / S`` as on a
balanced feeder, so that its per-unit voltages, impedances and flows are the same. Neutral and earth return
are in the 3x3 blocks (Kron's reduction): voltages are phase to neutral, with a well grounded neutral.

Along a branch with impedance Z, ``V_parent = V + Z i`` and ``i_psi = conj(S_psi / V_psi)``. The squared
moduli, with the ratios of the phases' voltages taken as those of a balanced system, ``V_phi / V_psi = a_phi /
a_psi`` (a = 1, e^{-j 2 pi / 3}, e^{j 2 pi / 3}), and without the ``|Z i|^2`` of second order, give

    v_phi^2 = v_parent,phi^2 - 2 sum_psi Re( W_phi,psi conj(S_psi) ),    W_phi,psi = Z_phi,psi a_psi / a_phi

with ``S_psi = P_psi + j Q_psi`` the power that arrives in phase psi: per branch the matrices Re W and Im W
take the place of r and x on a balanced feeder. They are not symmetric, though Z is: through a mutual
reactance, active power injected in phase b raises phase a, and in phase a lowers phase b.

Powers, voltages and their axes: connections (…, C) of the feeder; buses (…, 3, b + 1), phase before bus.
The voltage of a phase absent at a bus is that at the end of the phase.

Source: kersting2012, chapter 4; ganlow2014; arnold2016; docs/theory-three-phase.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, Phasors, frozen, frozen_ints, put
from gridsec.errors import FeederInvalid, InputInvalid, Problem, wrong_shapes
from gridsec.grid.intervals import Sweeps, bounds
from gridsec.grid.network import (
    Walk,
    at_ends,
    base_problems,
    below,
    duplicates,
    from_root,
    meetings,
    shrinking,
    walk,
)

PHASES = "abc"

ROTATION: Phasors = np.exp(-2j * np.pi / 3.0 * np.arange(3))
"""Phasors of a balanced system: phase b lags a by a third of a turn, and c lags b."""
ROTATION.flags.writeable = False

# Rounding of impedance tables, within which reciprocity and passivity hold.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ThreePhaseFeeder:
    """Radial feeder of up to three phases: b branches, b + 1 buses, rooted at the metered busbar (bus 0).

    Raises FeederInvalid with every problem found.
    """

    name: str  # name of the feeder
    parent: Ints  # (b,) bus that feeds bus k + 1; `parent[k] <= k`, so buses are in topological order
    # (b, 3, 3) Series impedance Z of the branch into bus k + 1, pu: the voltages along the three conductors
    # drop by ``Z i``. Symmetric; rows and columns of absent phases are 0.
    z: Phasors
    phases: Bools  # (b + 1, 3) phases a, b, c present at each bus
    bus: Ints  # (N,) Bus of each customer. Several customers may share one; bus 0 is allowed.
    connected: Bools  # (N, 3) connected phases of each customer, between phase and neutral
    customers: tuple[str, ...]  # (N,) identifiers of the customers
    buses: tuple[str, ...]  # (b + 1,) identifiers of the buses, the busbar first
    base_volt: float  # nominal phase-to-neutral voltage (1 pu), V
    base_kva: float  # three-phase base power S, kVA; 1 pu of the power of a phase is a third of it
    # (b, 3, 3) total shunt susceptance of the branch into bus k + 1, pu; half of it at each end
    charging: Floats
    # of, at, phase (C,): the connections, customer by customer, phase by phase: customer, bus, and phase 0,
    # 1, 2
    of: Ints = field(init=False, repr=False)
    at: Ints = field(init=False, repr=False)
    phase: Ints = field(init=False, repr=False)
    # (C,) share of the customer's power in each connection: 1 on a single phase, 1/3 on all three
    share: Floats = field(init=False, repr=False)
    walk: Walk = field(init=False, repr=False)  # around the tree
    half: Floats = field(init=False, repr=False)  # (b + 1, 3, 3) shunt susceptance at the buses, pu

    def __post_init__(self) -> None:
        for name, kind in (("z", np.complex128), ("phases", np.bool_), ("connected", np.bool_)):
            put(self, **{name: np.array(getattr(self, name), dtype=kind, order="C")})
        put(self, charging=frozen(self.charging))
        put(self, parent=frozen_ints(self.parent), bus=frozen_ints(self.bus))
        problems = _shape_problems(self) or [*_branch_problems(self), *_customer_problems(self)]
        if problems:
            raise FeederInvalid(problems)
        of, phase = np.nonzero(self.connected)
        put(self, of=frozen_ints(of), at=frozen_ints(self.bus[of]), phase=frozen_ints(phase))
        put(self, share=frozen(1.0 / self.connected.sum(axis=1)[of]))
        put(self, walk=walk(self.parent), half=at_ends(self.parent, self.charging))

    def connections(self, powers: Floats) -> Floats:
        """Split the customers' powers (…, N) over their connections (…, C), evenly over the phases."""
        return np.asarray(powers[..., self.of] * self.share)


def sequence_matrix(positive: Phasors | Floats, zero: Phasors | Floats) -> Phasors:
    """3x3 matrix of an element with interchangeable phases, from its sequence values.

    ``Z_self = (Z_0 + 2 Z_1) / 3`` on the diagonal and ``Z_mutual = (Z_0 - Z_1) / 3`` off the diagonal.

    positive, zero (…): positive- and zero-sequence impedance (or admittance), any unit.
    Source: Kersting 2012, chapter 4: the sequence impedances of a transposed line, solved for those of the
        phases.
    """
    one, none = (np.asarray(value, dtype=np.complex128)[..., None, None] for value in (positive, zero))
    return np.asarray(one * np.eye(3) + (none - one) / 3.0)


def _shape_problems(feeder: ThreePhaseFeeder) -> list[Problem]:
    """Problems of array lengths; all other checks require that there are none."""
    branches, customers = feeder.parent.size, len(feeder.customers)
    return wrong_shapes(
        ("parent", feeder.parent.shape, (branches,)),
        ("z", feeder.z.shape, (branches, 3, 3)),
        ("charging", feeder.charging.shape, (branches, 3, 3)),
        ("phases", feeder.phases.shape, (branches + 1, 3)),
        ("buses", (len(feeder.buses),), (branches + 1,)),
        ("bus", feeder.bus.shape, (customers,)),
        ("connected", feeder.connected.shape, (customers, 3)),
    )


def _branch_problems(feeder: ThreePhaseFeeder) -> list[Problem]:
    out = base_problems(feeder)
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

    z, charging (3, 3): series impedance and total shunt susceptance, pu.
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
    return out + duplicates(feeder)


def named(present: Bools) -> str:
    """Letters of the phases that are present, (3,)."""
    return "".join(phase for phase, there in zip(PHASES, present, strict=True) if there)


def customers_at(feeder: ThreePhaseFeeder, places: Ints) -> ThreePhaseFeeder:
    """The feeder with one single-phase customer at each of these places (k,): phase j mod 3 of bus j // 3."""
    connected = np.equal.outer(places % 3, np.arange(3))
    names = tuple(map(str, range(places.size)))
    return replace(feeder, bus=places // 3, connected=connected, customers=names)


@dataclass(frozen=True, slots=True, eq=False)
class LinDist3Flow:
    """Linear power flow `v^2 = v0^2 + 2 R p + 2 X q` of squared phase voltages.

    R and X are neither symmetric nor nonnegative: phases on a common path couple with signs.
    """

    # R, X (C, C): from the powers of a connection to the voltage at a connection, pu
    R: Floats
    X: Floats
    # R_bus, X_bus (3, b + 1, C): the same to every phase of every bus
    R_bus: Floats
    X_bus: Floats


def lindist3flow(feeder: ThreePhaseFeeder) -> LinDist3Flow:
    """Matrices of the linear power flow of an unbalanced feeder.

    Entry (phi at bus k, connection to psi at bus l): ``W_phi,psi`` summed over the common branches of the
    paths of k and l to the busbar, its real part in R and its imaginary part in X. O(b C).

    Source: Gan and Low 2014; Arnold et al. 2016. Derivation: docs/theory-three-phase.md.
    """
    W_bus = common_paths(feeder, _rotated(feeder), feeder.at, feeder.phase)
    W = W_bus[feeder.phase, feeder.at]
    return LinDist3Flow(*(frozen(part) for part in (W.real, W.imag, W_bus.real, W_bus.imag)))


def common_paths(feeder: ThreePhaseFeeder, blocks: Phasors, at: Ints, phase: Ints) -> Phasors:
    """Entries of the branches' blocks, summed over the common path of every bus with each of some others.

    blocks (b, 3, 3): summed blocks; for the series impedances ``z``, the sums are voltages per current.
    at, phase (k,): buses, and the columns of the blocks.
    Returns (3, b + 1, k): the sums, a row for each phase of every bus.
    """
    whole = np.zeros((len(feeder.buses), 3, 3), dtype=np.complex128)
    for k, above in enumerate(feeder.parent.tolist()):
        whole[k + 1] = whole[above] + blocks[k]
    shared = meetings(feeder.parent, feeder.walk, at)
    return np.stack([whole[shared, phi, phase] for phi in range(3)])


def sensitivities(
    feeder: ThreePhaseFeeder, p: Floats, q: Floats, v0_squared: Floats, *, steps: int = 2
) -> LinDist3Flow:
    """Derivatives of squared voltages at an operating point, halved: `lindist3flow` under load.

    A change ds of the power at one connection changes all currents, because powers are constant:

        dv_k = -(sum of Z di over the path of k),   di = -conj(ds / v) + conj(s dv / v^2) + j B dv

    Sweeps solve that by iteration, `steps` times after the first, which is the term in ds alone: every step
    gains one order in the load. Re(conj(v) dv) is then half the derivative of v^2. Without load and charging
    only the first term remains, which is `lindist3flow`. O(b C) for each step.

    p, q (C,): net active and reactive injection of each connection at the operating point, pu.
    v0_squared (3,): squared busbar voltage of each phase, pu.
    steps: number of sweeps, at least 1: for the operating point as for the derivatives.
    Returns LinDist3Flow: the matrices; ``v^2`` then changes by ``2 R dp + 2 X dq``.
    """
    if steps < 1:
        raise InputInvalid([Problem("out-of-range", f"steps is {steps}; it must be at least 1")])
    start = _Start.of(feeder, p, q, v0_squared)
    v = start.phasors
    for _ in range(steps):
        v = _sweep(feeder, start, v)
    load = np.conj(start.s / v**2)
    count, buses = feeder.of.size, len(feeder.buses)
    found = np.empty((2, count, 3, buses))
    together = max(1, _TOGETHER // (3 * buses))
    for first in range(0, count, together):
        some = slice(first, min(first + together, count))
        phase, at = feeder.phase[some], feeder.at[some]
        own = np.zeros((2, at.size, 3, buses), dtype=np.complex128)
        for part, unit in enumerate((1.0, 1j)):
            own[part, np.arange(at.size), phase, at] = -np.conj(unit / v[phase, at])
        change = _forward(feeder, _NOTHING, own)
        for _ in range(steps):
            drawn = own + load * np.conj(change) + _charged(feeder, change)
            change = _forward(feeder, _NOTHING, drawn)
        found[:, some] = (np.conj(v) * change).real
    R_bus, X_bus = np.moveaxis(found, 1, -1)
    here = (feeder.phase, feeder.at)
    return LinDist3Flow(*(frozen(part) for part in (R_bus[here], X_bus[here], R_bus, X_bus)))


# Entries per block, chosen for the processor's cache over several sweeps.
_TOGETHER = 65536

_NOTHING: Phasors = np.zeros((3, 1), dtype=np.complex128)


@dataclass(frozen=True, slots=True, eq=False)
class CustomerFlow:
    """Linear power flow customer by customer, in the per unit of balanced feeders."""

    # R, X (N, N): from a customer's power in units of the three-phase base S to a customer's squared voltage,
    # pu
    R: Floats
    X: Floats


def per_customer(feeder: ThreePhaseFeeder, model: LinDist3Flow) -> CustomerFlow:
    """Matrices between customers in place of connections.

    A customer's power is split evenly over the phases, and the voltage is the mean of their squares. Powers
    are in kW / S as on a balanced feeder, so that droop curves and meters of `base_kva` apply. On a cable
    without mutual impedance, a single-phase customer has three times the impedance of one on all phases.
    """
    first = np.searchsorted(feeder.of, np.arange(len(feeder.customers)))

    def joined(matrix: Floats) -> Floats:
        columns = np.add.reduceat(matrix * feeder.share, first, axis=1) if first.size else matrix
        both = np.add.reduceat(columns * feeder.share[:, None], first, axis=0) if first.size else columns
        return frozen(3.0 * both)

    return CustomerFlow(joined(model.R), joined(model.X))


def bus_voltages(
    feeder: ThreePhaseFeeder, p: Floats, q: Floats, v0_squared: Floats, *, steps: int = 1
) -> Floats:
    """Squared voltage of every phase of every bus, corrected for losses, charging and unequal phases.

    LinDist3Flow is the squared voltage after one backward and forward sweep from the flat start, linearised:
    ``v_k = v_parent - Z i_k`` with i_k the sum of ``conj(-s / v)`` over the buses fed by bus k. One step is
    one more sweep, with the currents at these voltages; its error is of third order in the powers. `steps`
    repeats it, and its limit is the AC power flow. Unlike on a balanced feeder the angles matter, since they
    turn the voltages induced by currents of other phases: hence phasors in place of squares. O(b) for each
    operating point, without the matrices.

    p, q (…, C): net active and reactive injection of each connection (generation positive), pu.
    v0_squared (…, 3): squared busbar voltage of each phase, pu, with balanced angles.
    steps: number of sweeps; 0 gives LinDist3Flow.
    Returns (…, 3, b + 1): squared voltages, pu. Source: docs/theory-three-phase.md, with measured errors.
    """
    start = _Start.of(feeder, p, q, v0_squared)
    if not steps:
        return start.linear
    phasors = start.phasors
    for _ in range(steps):
        phasors = _sweep(feeder, start, phasors)
    return np.asarray(phasors.real**2 + phasors.imag**2)


def model_error_bound(feeder: ThreePhaseFeeder, p: Floats, q: Floats, v0_squared: Floats) -> Floats:
    """Bound of the error of `v^2` after one correction against the AC power flow, for every connection.

    The next sweep changes the voltages by at most ``e``: the changed currents times the impedances on the
    path, with magnitudes summed. The sweeps shrink geometrically, and ``2 e`` bounds the sum of all later
    ones while each is at most half its predecessor (in practice a few hundredths); on the squares that is ``2
    e (2 |v| + 2 e)``. Heavy loads make the quotients grow, so if this sweep is *not* below a fifth of the one
    before, towards voltage collapse, the bound is infinite. It does not cover unbalanced busbar angles.

    feeder, p, q, v0_squared: as in `bus_voltages`.
    Returns (…, C): bound on the remaining error of `v^2`, pu.
    """
    start = _Start.of(feeder, p, q, v0_squared)
    once = _sweep(feeder, start, start.phasors)
    with np.errstate(all="ignore"):
        before = _drawn(feeder, start.s, start.phasors)
        first = _reach(feeder, before - start.flat)
        second = _reach(feeder, _drawn(feeder, start.s, once) - before)
        shrinks = shrinking(first, second, (-2, -1))
        bound = np.where(shrinks, 2.0 * second * (2.0 * np.abs(once) + 2.0 * second), np.inf)
    return np.asarray(bound[..., feeder.phase, feeder.at])


def interval_bounds(
    feeder: ThreePhaseFeeder, p: Floats, q: Floats, v0_squared: Floats, *, p_error: Floats, q_error: Floats
) -> tuple[Floats, Floats]:
    """Change of the correction, and error of its first step, for all powers within intervals.

    feeder, p, q: as in `bus_voltages`, one operating point.
    p_error, q_error (C,): largest errors of the powers, pu.
    Returns (C,), (C,): as `gridsec.grid.intervals.bounds`; with unequal phases of the busbar, wider by the
        error of LinDist3Flow for them.
    """
    start = _Start.of(feeder, p, q, v0_squared)
    error = np.asarray(_at_buses(feeder, np.hypot(p_error, q_error) + 0j).real)
    flat = np.broadcast_to(start.v0, start.s.shape)
    half = np.abs(feeder.half)

    def charge(change: Floats) -> Floats:
        return np.asarray(np.einsum("kij,jk->ik", half, change)) if half.any() else np.zeros(change.shape)

    sweeps = Sweeps(
        flat,
        start.phasors,
        _sweep(feeder, start, start.phasors),
        np.abs(start.s),
        lambda current: _reach(feeder, current),
        charge,
    )
    moved, rest = bounds(sweeps, error)
    v0 = np.sqrt(np.asarray(v0_squared, dtype=np.float64))
    # `linear` assumes equal phases of the busbar.
    apart = np.abs(feeder.z) * np.abs(v0[:, None] / v0 - 1.0)
    moved = moved + 2.0 * from_root(
        feeder.walk, np.einsum("bij,jb->ib", apart, below(feeder.walk, error)[..., 1:])
    )
    here = (feeder.phase, feeder.at)
    return np.asarray(moved[here]), np.asarray(rest[here])


def _rotated(feeder: ThreePhaseFeeder) -> Phasors:
    """W of every branch, (b, 3, 3)."""
    return np.asarray(feeder.z * (ROTATION / ROTATION[:, None]))


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """One operating point before any correction; buses as (…, 3, b + 1).

    s: powers injected at the buses. v0: busbar phasors (…, 3, 1). flat: currents drawn at the flat start.
    phasors: voltages after the first sweep. linear: LinDist3Flow's squared voltages.
    """

    s: Phasors
    v0: Phasors
    flat: Phasors
    phasors: Phasors
    linear: Floats

    @classmethod
    def of(cls, feeder: ThreePhaseFeeder, p: Floats, q: Floats, v0_squared: Floats) -> _Start:
        with np.errstate(all="ignore"):  # NaN gets an infinite bound without a warning
            s = _at_buses(feeder, p + 1j * np.asarray(q))
            squared = np.asarray(v0_squared, dtype=np.float64)[..., None]
            v0 = np.sqrt(squared) * ROTATION[:, None]
            flow = below(feeder.walk, s)[..., 1:]
            gain = np.einsum("bij,...jb->...ib", _rotated(feeder), np.conj(flow)).real
            linear = squared + 2.0 * from_root(feeder.walk, gain)
            flat = _drawn(feeder, s, np.broadcast_to(v0, s.shape))
            return cls(s, v0, flat, _forward(feeder, v0, flat), linear)


def _sweep(feeder: ThreePhaseFeeder, start: _Start, phasors: Phasors) -> Phasors:
    with np.errstate(all="ignore"):
        return _forward(feeder, start.v0, _drawn(feeder, start.s, phasors))


def _drawn(feeder: ThreePhaseFeeder, s: Phasors, phasors: Phasors) -> Phasors:
    """Currents drawn from the buses by customers and charging, (…, 3, b + 1)."""
    return np.asarray(_charged(feeder, phasors) - np.conj(s / phasors))


def _charged(feeder: ThreePhaseFeeder, phasors: Phasors) -> Phasors | float:
    """Currents drawn from the buses by the charging."""
    return 1j * np.einsum("kij,...jk->...ik", feeder.half, phasors) if feeder.half.any() else 0.0


def _forward(feeder: ThreePhaseFeeder, v0: Phasors, drawn: Phasors) -> Phasors:
    """Voltages of the buses from the currents drawn there."""
    current = below(feeder.walk, drawn)[..., 1:]
    return np.asarray(v0 - from_root(feeder.walk, np.einsum("bij,...jb->...ib", feeder.z, current)))


def _reach(feeder: ThreePhaseFeeder, change: Phasors | Floats) -> Floats:
    """Largest change of the voltages by changed currents at the buses."""
    current = below(feeder.walk, np.abs(change))[..., 1:]
    return np.asarray(from_root(feeder.walk, np.einsum("bij,...jb->...ib", np.abs(feeder.z), current)))


def _at_buses(feeder: ThreePhaseFeeder, powers: Phasors) -> Phasors:
    """Sum of the connections' powers (…, C) at every phase of every bus, (…, 3, b + 1)."""
    count = len(feeder.buses)
    out = np.zeros((3 * count, *powers.shape[:-1]), dtype=np.complex128)
    np.add.at(out, feeder.phase * count + feeder.at, np.moveaxis(powers, -1, 0))
    return np.asarray(np.moveaxis(out, 0, -1).reshape(*powers.shape[:-1], 3, count))

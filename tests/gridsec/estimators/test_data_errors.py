"""Errors of a feeder's files beside accusations, against AC power flow of the true feeder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gridsec.arrays import Bools, Floats
from gridsec.estimators.data_errors import (
    BLOCK_S,
    FEWEST_BLOCKS,
    MOST_BLOCKS,
    AccusationWindow,
    DataErrorDesign,
    DataErrorKind,
    begin,
    design,
    follow,
)
from gridsec.estimators.plant import Plant
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.grid.network import Network
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import ThreePhaseFeeder, sequence_matrix
from gridsec.interface import Frame
from tests.gridsec.street import ac_voltages
from tests.gridsec.unbalanced import ac_places

BUSES = 8
STEP_S = 10.0
CLASS, JITTER = 0.002, 2e-4
P_ERROR, Q_ERROR = 2e-4, 4e-4
R, X = 0.02, 0.01
"""Impedance of each line, pu: the ends of the feeder have drops of about 5 %."""


def in_phases(bus: Sequence[int], phase: Sequence[int]) -> PhasedFeeder:
    z = np.tile(sequence_matrix(np.array(R + 1j * X), np.array(3.0 * R + 3j * X)), (BUSES, 1, 1))
    tree = ThreePhaseFeeder(
        name="street",
        parent=np.arange(BUSES),
        z=z,
        phases=np.ones((BUSES + 1, 3), dtype=bool),
        bus=np.array(bus),
        connected=np.equal.outer(phase, np.arange(3)),
        customers=tuple(f"c{i}" for i in range(len(bus))),
        buses=tuple(f"b{k}" for k in range(BUSES + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros((BUSES, 3, 3)),
    )
    return PhasedFeeder(tree)


def balanced(bus: Sequence[int]) -> Feeder:
    return Feeder(
        name="street",
        parent=np.arange(BUSES),
        r=np.full(BUSES, R),
        x=np.full(BUSES, X),
        bus=np.array(bus),
        customers=tuple(f"c{i}" for i in range(len(bus))),
        buses=tuple(f"b{k}" for k in range(BUSES + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(BUSES),
    )


HOUR = 360
"""Frames of an hour."""

BUS, PHASE = list(range(1, BUSES + 1)), [k % 3 for k in range(BUSES)]


def other(values: list[int], **changed: int) -> list[int]:
    """The values with those of some customers changed."""
    out = list(values)
    for name, value in changed.items():
        out[int(name[1:])] = value
    return out


def plant_of(feeder: Network) -> Plant:
    p = feeder.bus.size
    accuracy = MeterAccuracy(np.full(p, CLASS), np.full(p, 4e-4), np.full(p, JITTER), 0.001, 4e-4, 1e-4)
    return Plant(feeder, fleet(np.zeros(0, dtype=int), [], np.zeros(0), 100.0), np.arange(p), accuracy)


@cache
def street(*, phased: bool = True, c6: int = BUS[6]) -> Network:
    """The true feeder; with customer c6 at another bus."""
    bus = other(BUS, c6=c6)
    return in_phases(bus, PHASE) if phased else balanced(bus)


@cache
def honest(
    feeder: Network, seed: int = 1, count: int = HOUR, *, steady: bool = False, t0: float = 0.0
) -> tuple[Frame, ...]:
    """Frames of the true feeder: voltages of its AC power flow, registers with errors within their limits."""
    rng, n = np.random.default_rng(seed), feeder.bus.size
    bias, p_error = CLASS * rng.uniform(-1, 1, n), P_ERROR * rng.uniform(-1, 1, n)
    level, out = rng.uniform(0.005, 0.02, n), []
    drawn = level.copy()
    for k in range(count):
        if not steady:
            drawn += 0.1 * (level - drawn) + 0.15 * level * rng.standard_normal(n)
        p, q = -drawn, -0.3 * drawn
        v0 = 1.0 + 0.002 * np.sin(np.arange(3) + (0.0 if steady else k / 40.0))
        if isinstance(feeder, Feeder):
            v = ac_voltages(feeder, p + 1j * q, float(v0[0]))[feeder.bus]
        else:
            assert isinstance(feeder, PhasedFeeder)
            v = np.sqrt(ac_places(feeder, p, q, v0**2)[feeder.bus])
        v = v * (1.0 + bias) + JITTER * rng.standard_normal(n)
        out.append(
            Frame(
                t=t0 + k * STEP_S,
                y=v**2,
                seen=np.ones(n, dtype=bool),
                v0_squared=float(v0[0] ** 2),
                p=p + p_error,
                p_error=np.full(n, P_ERROR),
                q=q,
                q_error=np.full(n, Q_ERROR),
                q_net=q + Q_ERROR * rng.uniform(-1, 1, n),
                q_net_error=np.full(n, Q_ERROR),
                v0_phases=None if isinstance(feeder, Feeder) else v0**2,
            )
        )
    return tuple(out)


def prepared(files: Network) -> DataErrorDesign:
    found = design(plant_of(files), np.full(len(files.buses), 230.0), STEP_S)
    assert found is not None
    return found


def watched(
    files: Network, frames: Sequence[Frame], accused: list[int], window: AccusationWindow | None = None
) -> AccusationWindow:
    made, window = prepared(files), begin() if window is None else window
    for frame in frames:
        window = follow(made, window, frame, np.zeros(0), np.isin(np.arange(frame.y.size), accused))
    return window


@pytest.mark.canary("bus0-phase0-phase-moved0-0", "bus3-phase3-bus-moved3-0")
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("bus", "phase", "kind", "moved"),
    [
        (BUS, other(PHASE, c5=0), DataErrorKind.PHASE, {5}),
        (BUS, other(PHASE, c5=PHASE[6], c6=PHASE[5]), DataErrorKind.EXCHANGED_PHASES, {5, 6}),
        (
            other(BUS, c2=BUS[7], c7=BUS[2]),
            other(PHASE, c2=PHASE[7], c7=PHASE[2]),
            DataErrorKind.EXCHANGED_METERS,
            {2, 7},
        ),
        (other(BUS, c6=2), PHASE, DataErrorKind.BUS, {6}),
    ],
)
def test_an_error_of_the_files_is_found(
    seed: int, bus: list[int], phase: list[int], kind: DataErrorKind, moved: set[int]
) -> None:
    """The places of the truth are restored: each is compared with AC power flow, not with the model."""
    truth, files = street(), in_phases(bus, phase)
    window = watched(files, honest(truth, seed), sorted(moved))
    error = window.error
    assert error is not None
    assert (error.kind, set(error.customers)) == (kind, moved)
    assert dict(zip(error.customers, error.places, strict=True)) == {i: int(truth.bus[i]) for i in moved}
    assert set(error.meters) == moved


def test_exchanged_meters_of_a_balanced_feeder_are_found() -> None:
    files = balanced(other(BUS, c1=BUS[7], c7=BUS[1]))
    window = watched(files, honest(street(phased=False)), [1])
    assert window.error is not None
    assert window.error.kind is DataErrorKind.EXCHANGED_METERS
    assert set(window.error.customers) == {1, 7}
    assert window.error.meters == (1,)


def lies(kind: str, size: float) -> Floats:
    """A manipulation of the squared voltage over an hour, pu."""
    k, rng = np.arange(HOUR), np.random.default_rng(5)
    return {
        "offset": np.full(HOUR, size),
        "ramp": size * k / HOUR,
        "random": size * rng.standard_normal(HOUR),
        "slow random": size * np.repeat(rng.standard_normal(HOUR // 30), 30),
    }[kind]


@pytest.mark.canary("meters0-0.03-ramp")
@pytest.mark.parametrize("kind", ["offset", "ramp", "random", "slow random", "scale"])
@pytest.mark.parametrize("size", [-0.05, 0.03])
@pytest.mark.parametrize("meters", [[6], [1, 4, 7]])
def test_a_manipulation_has_no_hint(kind: str, size: float, meters: list[int]) -> None:
    frames = []
    for k, frame in enumerate(honest(street())):
        y = frame.y.copy()
        y[meters] += size * y[meters] if kind == "scale" else lies(kind, size)[k]
        frames.append(replace(frame, y=y))
    assert watched(street(), frames, meters).error is None


def test_an_offset_as_large_as_that_of_another_bus_has_no_hint() -> None:
    """Its mean is that of an error of the files; its changes are not."""
    frames, moved = honest(street()), honest(street(c6=2))
    apart = np.mean([there.y[6] - here.y[6] for here, there in zip(frames, moved, strict=True)])
    changed = [replace(f, y=np.where(np.arange(BUSES) == 6, f.y + apart, f.y)) for f in frames]
    assert watched(street(), changed, [6]).error is None


def test_steady_loads_decide_nothing() -> None:
    files = in_phases(BUS, other(PHASE, c5=0))
    assert watched(files, honest(street(), steady=True), [5]).error is None


def test_the_window_is_bounded_and_empty_while_no_meter_is_accused() -> None:
    files, frames = street(), honest(street(), count=2 * HOUR)
    assert watched(files, frames[:50], []).t is None
    window = watched(files, frames[:HOUR], [3])
    assert window.rows is not None
    window = watched(files, frames[HOUR : HOUR + 60], [], window)
    assert window.rows is not None
    assert len(window.rows.t) == MOST_BLOCKS
    assert watched(files, (*frames[HOUR + 60 :], *honest(files, t0=2e4)), [], window).t is None


def test_the_window_begins_anew_when_the_clock_is_set_back_and_after_a_gap() -> None:
    files = in_phases(BUS, other(PHASE, c5=0))
    frames = honest(street(), t0=1e5)
    window = watched(files, frames, [5])
    assert window.error is not None
    for t in (5e4, 1e5 + (HOUR * STEP_S) + (MOST_BLOCKS + 1) * BLOCK_S):
        again = watched(files, [replace(frames[-1], t=t)], [5], window)
        assert (again.error, again.rows) == (None, None)


def test_nothing_is_said_before_ten_blocks() -> None:
    files = in_phases(BUS, other(PHASE, c5=PHASE[6], c6=PHASE[5]))
    frames = honest(street())
    before = int((FEWEST_BLOCKS - 1) * BLOCK_S / STEP_S) + 1
    assert watched(files, frames[:before], [5, 6]).error is None


def test_lost_readings_and_powers_are_no_changes() -> None:
    """A lost reading has the middle of its range as power; its block has the mean of the others."""
    files = in_phases(BUS, other(PHASE, c5=PHASE[6], c6=PHASE[5]))
    rng, frames = np.random.default_rng(2), list(honest(street()))
    for k, frame in enumerate(frames):
        lost: Bools = rng.random(BUSES) < 0.05
        frames[k] = replace(
            frame,
            y=np.where(lost, np.nan, frame.y),
            seen=~lost,
            p=np.where(lost, 0.05, frame.p),
            p_error=np.where(lost, 0.1, frame.p_error),
            q_net=np.where(lost, np.nan, frame.q_net),
            p_origin=lost.astype(np.intp),
        )
    window = watched(files, frames, [5, 6])
    assert window.error is not None
    assert set(window.error.customers) == {5, 6}
    without_busbar = [replace(frame, v0_phases=None, v0_squared=np.nan) for frame in frames]
    assert watched(files, without_busbar, [5, 6]).error is None


def test_a_feeder_of_too_many_places_is_not_compared() -> None:
    files = balanced(BUS)
    many = Feeder(
        name="large",
        parent=np.zeros(800, dtype=int),
        r=np.full(800, R),
        x=np.full(800, X),
        bus=np.arange(1, 801),
        customers=tuple(f"c{i}" for i in range(800)),
        buses=tuple(f"b{k}" for k in range(801)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(800),
    )
    assert design(replace(plant_of(files), feeder=many), np.full(801, 230.0), STEP_S) is None

"""yang2021 on a feeder: simultaneous attacks on an inverter's reactive power and on a meter.

The feeder is the overhead line of Kerber's rural network, 13 customers at equal distances; three
inverters with a droop curve, eight meters. docs/papers/yang2021.md states for which inverters the bank
exists, and the required accuracy of readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gridsec.arrays import Floats
from gridsec.grid.devices import Droop, fleet
from gridsec.grid.radial import Feeder
from gridsec.observers.lmi.sampled import advance, measure
from gridsec.observers.lure import Lure, close_loop
from gridsec.observers.unknown_input import UnknownInputPlant, inverters
from gridsec.papers.claims import FigureCurve, Panel, PaperFigure
from gridsec.secure.isolation import IsolationDesign, IsolationStep, design, init, step

CUSTOMERS = 13
STEP_S = 1.0
ONSET_S = 40.0


def feeder() -> Feeder:
    """Kerber's rural overhead line: 13 sections of 9.303 mohm + j 1.449 mohm at 400 V, base 100 kVA.

    Source: G. Kerber, dissertation, TU Muenchen 2011, as distributed with pandapower.
    """
    ohm = 400.0**2 / 100e3
    return Feeder(
        name="kerber-line",
        parent=np.arange(CUSTOMERS),
        r=np.full(CUSTOMERS, 9.303e-3 / ohm),
        x=np.full(CUSTOMERS, 1.449e-3 / ohm),
        bus=np.arange(1, CUSTOMERS + 1),
        customers=tuple(f"c{i:02d}" for i in range(1, CUSTOMERS + 1)),
        buses=tuple(f"b{i:02d}" for i in range(CUSTOMERS + 1)),
        base_volt=400.0 / np.sqrt(3.0),
        base_kva=100.0,
        charging=np.zeros(CUSTOMERS),
    )


def _droop(at: tuple[int, ...]) -> Droop:
    return fleet(np.array(at), ["ieee1547-b"] * len(at), np.full(len(at), 10.0), 100.0)


def loop(at: tuple[int, ...], meters: tuple[int, ...]) -> Lure:
    """Closed loop with inverters of 10 kVA and the curve of IEEE 1547, category B; customers count from 0."""
    return close_loop(feeder(), _droop(at), np.array(meters))


def plant(at: tuple[int, ...], meters: tuple[int, ...], reading_error: float) -> UnknownInputPlant:
    """The sampled loop with attacks possible on every inverter; `reading_error` in squared pu."""
    return inverters(
        loop(at, meters),
        STEP_S,
        np.arange(len(at)),
        reading_error=np.full(len(meters), reading_error),
        u_error=np.zeros(CUSTOMERS),
        curve_error=np.zeros(len(at)),
        # An attacked inverter may inject beyond its droop, up to twice its limit.
        span=2.0 * _droop(at).limit,
    )


AT = (3, 6, 9)
METERS = (0, 2, 4, 6, 8, 10, 11, 12)


@lru_cache(maxsize=1)
def bank(reading_error: float = 1e-6) -> IsolationDesign:
    """Bank for one attacked inverter of three and one attacked meter of eight: all 108 members exist."""
    return design(plant(AT, METERS, reading_error), max_inputs=1, max_sensors=1)


@dataclass(frozen=True, slots=True, eq=False)
class Yang2021FeederRun:
    """One simulation. T ticks, m inverters, p meters."""

    x: Floats  # (T, m) reactive injections, pu
    a_u: Floats  # (T, m) wrong parts of their set points, pu
    a_y: Floats  # (T, p) attacks on the meters, squared pu
    answers: tuple[IsolationStep, ...]  # results of the bank


def simulate(
    made: IsolationDesign, *, inverter: int, meter: int, ticks: int = 80, seed: int = 1
) -> Yang2021FeederRun:
    """Simulate the loop under attack from `ONSET_S` on: the inverter absorbs, the meter is biased.

    inverter, meter: attacked inverter and meter, from 0.
    seed: seed of the meters' errors, which are uniform inside their bounds.
    """
    model = made.family.plant
    m, p = model.inputs.shape[1], len(model.noise)
    rng = np.random.default_rng(seed)
    state, x = init(made, 0.0), np.zeros(m)
    xs, au, ay, answers = np.empty((ticks, m)), np.zeros((ticks, m)), np.zeros((ticks, p)), []
    for k in range(ticks):
        # Evening load: low voltage along the line, slowly moving.
        u = 0.055 + 0.035 * np.arange(1, CUSTOMERS + 1) / CUSTOMERS * (1.0 + 0.2 * np.sin(k / 9.0))
        if k * STEP_S >= ONSET_S:
            au[k, inverter], ay[k, meter] = -0.06, -0.01
        xs[k] = x
        y = measure(model.system, x, u) + ay[k] + model.noise * rng.uniform(-1.0, 1.0, p)
        state, answer = step(made, state, y, u, np.ones(p, dtype=np.bool_))
        answers.append(answer)
        x = advance(model.system, x, u) + model.inputs @ au[k]
    return Yang2021FeederRun(xs, au, ay, tuple(answers))


def figure() -> PaperFigure:
    """Injections, reconstructed attacks on inverters and on meters."""
    run = simulate(bank(), inverter=1, meter=5)
    t = np.arange(0.0, len(run.x) * STEP_S, STEP_S)
    found = np.array([a.x for a in run.answers])
    late = np.array([a.input_attack for a in run.answers])
    lies = np.array([a.sensor_attack for a in run.answers])
    # Before the bounds have settled, the reconstruction is meaningless.
    known = np.array([[np.all(a.bound < _droop(AT).limit)] for a in run.answers])
    late, lies = np.where(known, late, np.nan), np.where(known, lies, np.nan)
    ahead = np.vstack([late[1:], np.full((1, late.shape[1]), np.nan)])
    panels = (
        _panel("Reactive injection", "pu", t, (run.x, found), [f"inverter at c{i + 1:02d}" for i in AT]),
        _panel("Wrong part of the set point", "pu", t, (run.a_u, ahead), [f"c{i + 1:02d}" for i in AT]),
        _panel("Attack on the meter", "squared pu", t, (run.a_y, lies), [f"c{i + 1:02d}" for i in METERS]),
    )
    return PaperFigure(
        "yang2021-feeder",
        "One inverter and one meter are attacked from 40 s on; both are named, and no others",
        panels,
    )


def _panel(what: str, unit: str, t: Floats, pair: tuple[Floats, Floats], names: list[str]) -> Panel:
    lines = []
    for i, name in enumerate(names):
        lines += [FigureCurve(name, t, pair[0][:, i], "solid"), FigureCurve("", t, pair[1][:, i], "dashed")]
    return Panel(f"{what}: truth, and estimate (dashed)", "t in s", unit, tuple(lines))

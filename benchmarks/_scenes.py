"""Scenes of the benchmarks about stealthy lies and false accusations: feeders, honest errors, learned meters.

The truth is AC power flow with the droop inverters in closed loop. Loads, generation and the busbar vary as
in `feeders.simulation.demand` without tap steps; meters have the errors that the feeder's files state.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache, partial
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, depth_first_order, dijkstra

from feeders.format.tables import CustomerRow, FeederMeta, FeederTables, LineRow
from feeders.model.site import Site, Snapshot, from_tables, load, unread
from feeders.registry import MODAL, DesignedEstimator, design
from feeders.simulation.demand import Variation
from feeders.simulation.scenario import START, Scenario
from feeders.simulation.trial import FrameTruth, LoadError, Trial, TrialMeterErrors, frames
from gridsec.arrays import Bools, Floats, Ints
from gridsec.attack import Attack
from gridsec.estimators.front import Commission
from gridsec.interface import Frame, PowerOrigin

ONSET_S = 20.0
"""Honest seconds before a manipulation."""
WATCHED_S = 90.0
"""Seconds of a manipulation."""
LEARN_S = 6.0 * 3600.0
"""Time over which fixed errors are learned, s."""
LEARN_STEP_S = 300.0
"""Tick of the learning run, s: 72 readings leave 0.006 % of a meter's jitter."""
UNREAD, SILENT = 0.05, 0.3
"""Shares of the customers without a power reading, at least one customer."""
LATE_S, CLOCK_S = 60, 3
"""Age of late powers, and largest offset of a clock, s; both are whole ticks."""
PROFILE_S = 13.9 * 86_400.0
"""Length of the summer's profiles, s."""
_LEAST_OHM = 1e-6
"""Resistance of a fused line in distances, ohm: a graph has no edge of weight zero."""


class Model(StrEnum):
    """Knowledge of the powers."""

    MATCHED = "matched"
    """Registers and power factors err as the files say; the monitor knows these limits."""
    LOADS = "loads"
    """Errors of 0.6 kW and 0.2 kvar, correlation time 600 s, known as such."""
    UNREAD = "unread"
    """As MATCHED, but `UNREAD` of the customers report a voltage and no power."""
    SILENT = "silent"
    """As MATCHED, but `SILENT` of them."""
    LATE = "late"
    """As MATCHED, but every power is `LATE_S` old, and stated so. Errors are learned with fresh powers."""
    CLOCKS = "clocks"
    """As MATCHED, but clocks are off by up to `CLOCK_S`, unknown. Errors are learned with exact clocks."""


USUAL = (Model.MATCHED, Model.LOADS, Model.UNREAD)
"""Models that runs take in turn."""
_SILENT = {Model.UNREAD: UNREAD, Model.SILENT: SILENT}


@dataclass(frozen=True, slots=True)
class Setting:
    """One honest world.

    Attributes
    ----------
    feeder
        A feeder of the project, or "street-N-K" and "phases-N-K": random number K of N customers.
    model
        Knowledge of the powers.
    learned
        Whether fixed errors of the meters are learned.
    seed
        Chooses everything random.
    """

    feeder: str
    model: Model
    learned: bool
    seed: int


@lru_cache(maxsize=32)
def site(feeder: str) -> Site:
    """The feeder of a setting."""
    if feeder.startswith(("street-", "phases-")):
        kind, customers, number = feeder.split("-")
        return from_tables(random_tables(int(customers), int(number), phases=kind == "phases"))
    return load(feeder)


@lru_cache(maxsize=32)
def _trial(feeder: str, model: Model, step_s: float) -> tuple[Trial, Site]:
    """A trial of a feeder, and its stated site."""
    errors = LoadError() if model is Model.LOADS else None
    variation = Variation(tap_step_pu=0.0)
    trial = Trial(
        site(feeder), step_s=step_s, load_error=errors, meters=TrialMeterErrors.SITE, variation=variation
    )
    return trial, trial.stated


@lru_cache(maxsize=32)
def watcher(
    feeder: str,
    model: Model,
    *,
    step_s: float = 1.0,
    commission_s: float = 0.0,
    estimator: str = MODAL,
) -> DesignedEstimator:
    """The monitor of a feeder, by default the default one."""
    _, stated = _trial(feeder, model, step_s)
    meta = stated.tables.meta
    settings = replace(meta.monitor, estimator=estimator, commission_s=commission_s)
    return design(from_tables(replace(stated.tables, meta=replace(meta, monitor=settings))))


def without_powers(setting: Setting) -> Bools:
    """Customers without a power reading, (N,)."""
    count = len(site(setting.feeder).tables.customers)
    out = np.zeros(count, dtype=np.bool_)
    if setting.model in _SILENT:
        random = np.random.default_rng([setting.seed, 5])
        out[random.choice(count, max(1, round(_SILENT[setting.model] * count)), replace=False)] = True
    return out


def received(setting: Setting, ticks: Sequence[Snapshot]) -> Iterator[Snapshot]:
    """Readings of every tick as they are received, with late powers or by clocks that are off.

    Parameters
    ----------
    setting
        The honest world.
    ticks
        Readings of the moment, one tick per second.
    """
    every, late = np.arange(ticks[0].v_volt.size), setting.model is Model.LATE
    behind = np.full(every.size, LATE_S)
    if not late:
        # A clock that is ahead tells the reading of an earlier moment.
        behind = np.random.default_rng([setting.seed, 7]).integers(-CLOCK_S, CLOCK_S + 1, every.size)
    v, p, q = (np.array([getattr(one, k) for one in ticks]) for k in ("v_volt", "p_kw", "q_kvar"))
    for k, one in enumerate(ticks):
        of = np.clip(k - behind, 0, len(ticks) - 1)
        other = {"p_age_s": behind.astype(np.float64)} if late else {"v_volt": v[of, every]}
        yield replace(one, p_kw=p[of, every], q_kvar=q[of, every], **other)


def play(
    setting: Setting,
    duration_s: float,
    *,
    attacks: tuple[Attack, ...] = (),
    busbar: tuple[Attack, ...] = (),
    step_s: float = 1.0,
    start: float = START,
) -> Iterator[tuple[Frame, FrameTruth]]:
    """Frames and truth of a setting.

    Parameters
    ----------
    setting
        The honest world.
    duration_s, step_s, start
        Length and tick, s, and the first tick, Unix s.
    attacks, busbar
        Manipulations of the meters and of the busbar's meter.
    """
    trial, stated = _trial(setting.feeder, setting.model, step_s)
    # Readings of other moments are played, too.
    beside = {Model.LATE: LATE_S, Model.CLOCKS: CLOCK_S}.get(setting.model, 0) if step_s == 1.0 else 0
    trial = replace(trial, seed=setting.seed, duration_s=duration_s + 2.0 * beside)
    scenario: Scenario = replace(
        trial.scenario,
        start=start - beside,
        profile_s=moment(setting) + start - beside - START,
        attacks=attacks,
        busbar_attacks=busbar,
    )
    silent, nothing = without_powers(setting), unread(stated)
    change = partial(received, setting) if beside else iter
    for frame, truth in frames(trial, scenario, stated=stated, received=change):
        if start <= frame.t < start + duration_s or not beside:
            yield (without(frame, nothing, silent) if silent.any() else frame), truth


def without(frame: Frame, nothing: Frame, silent: Bools) -> Frame:
    """The frame without power readings of some customers.

    Parameters
    ----------
    frame, nothing
        The frame, and one without any power reading.
    silent : (N,)
        The customers.
    """
    names = ("p", "p_error", "q", "q_error")
    origin = np.where(
        silent, PowerOrigin.UNREAD, PowerOrigin.READ if frame.p_origin is None else frame.p_origin
    )
    return replace(
        frame,
        p_origin=origin.astype(np.intp),
        **{k: np.where(silent, getattr(nothing, k), getattr(frame, k)) for k in names},
    )


def moment(setting: Setting) -> float:
    """Position of START within the profiles, s."""
    return float(np.random.default_rng([setting.seed, 146]).uniform(0.0, PROFILE_S))


def begin(setting: Setting, estimator: str = MODAL) -> tuple[DesignedEstimator, Any]:
    """An estimator, and its state before the first frame, with learned errors if it learns."""
    made = watcher(setting.feeder, setting.model, estimator=estimator)
    learning = made.family.bias_learning
    if not setting.learned or learning is None:
        return made, made.init(START)
    return made, learning.init(made.design, START, learned(setting, estimator))


@lru_cache(maxsize=64)
def learned(setting: Setting, estimator: str = MODAL) -> Commission:
    """Fixed errors learned over the six honest hours before START, tick `LEARN_STEP_S`.

    Raises
    ------
    RuntimeError
        If the estimator names a meter in these hours, or does not learn.
    """
    made = watcher(
        setting.feeder, setting.model, step_s=LEARN_STEP_S, commission_s=LEARN_S, estimator=estimator
    )
    first = START - LEARN_S - 2.0 * LEARN_STEP_S
    state = made.init(first)
    for frame, _ in play(setting, START - first, step_s=LEARN_STEP_S, start=first):
        state, _, verdict = made.step(state, frame)
        if verdict.suspects.any():
            raise RuntimeError(f"{setting}: a meter is named while errors are learned")
    learning = made.family.bias_learning
    if learning is None:
        raise RuntimeError(f"{estimator} does not learn")
    known = learning.commission(state)
    return replace(known, learning=None)


# --- places -------------------------------------------------------------------------------------


def neighbours(where: Site, first: int) -> Ints:
    """Meters in the order of their electrical distance from one, (p,).

    Parameters
    ----------
    where
        The feeder.
    first
        Index of a meter.
    """
    graph, at = _graph(where)
    distance = dijkstra(graph, directed=False, indices=at[first])
    return np.argsort(distance[at], kind="stable").astype(np.intp)


def street(where: Site) -> Ints:
    """Meters in depth-first order from the busbar, (p,): connected runs are streets and laterals."""
    graph, at = _graph(where)
    order, _ = depth_first_order(graph, 0, directed=False)
    rank = np.empty(graph.shape[0])
    rank[order] = np.arange(order.size)
    return np.argsort(rank[at], kind="stable").astype(np.intp)


def beyond(where: Site) -> list[Ints]:
    """Meters behind every bus, the largest sets first; the busbar's own is left out."""
    graph, at = _graph(where)
    order, before = breadth_first_order(graph, 0, directed=False)
    below: list[set[int]] = [set() for _ in range(graph.shape[0])]
    for j, bus in enumerate(at):
        below[bus].add(j)
    for bus in order[:0:-1]:
        below[before[bus]] |= below[bus]
    found = {tuple(sorted(below[bus])) for bus in order[1:]}
    some = sorted((one for one in found if one), key=lambda one: (-len(one), one))
    return [np.array(one, dtype=np.intp) for one in some]


def _graph(where: Site) -> tuple[csr_array, Ints]:
    """Resistances between buses, the busbar first, and the bus of each meter."""
    tables = where.tables
    closed = [line for line in tables.lines if line.closed]
    names = dict.fromkeys([tables.meta.busbar])
    for line in closed:
        names |= dict.fromkeys([line.from_bus, line.to_bus])
    number = {name: k for k, name in enumerate(names)}
    ends = np.array([(number[line.from_bus], number[line.to_bus]) for line in closed])
    ohm = np.array([max(line.r_ohm, _LEAST_OHM) for line in closed])
    graph = csr_array((ohm, (ends[:, 0], ends[:, 1])), shape=(len(number),) * 2)
    at = np.array([number[tables.customers[c].bus] for c in where.meters], dtype=np.intp)
    return graph, at


def phase_of(where: Site) -> Ints:
    """Phase of each meter, (p,); 0 for all on a balanced feeder."""
    if where.feeder.busbar_phases == 1:
        return np.zeros(where.meters.size, dtype=np.intp)
    rows = where.tables.customers
    return np.array(["abc".index(rows[c].phases) for c in where.meters], dtype=np.intp)


# --- random feeders -----------------------------------------------------------------------------


def random_tables(customers: int, number: int, *, phases: bool) -> FeederTables:
    """A random tree: forked mains, services, an inverter at every third customer.

    In three phases every customer has one of them, drawn with unequal odds, behind a service of that phase;
    mains have return paths of four times their resistance.

    Parameters
    ----------
    customers
        Their number.
    number
        Chooses the feeder.
    phases
        Whether it is one in three phases.
    """
    random = np.random.default_rng([number, customers, 42])
    mains = max(2, customers // 3 if phases else 2 * customers // 3)
    lines, names = [], ["bb"]
    # About 4 % at 4 kW for each customer over half of the mains.
    scale = _DROP * _VOLT**2 / (_KW * 1e3 * customers * mains / 4.0) * (1.0 if phases else 3.0)
    for k in range(mains):
        above = names[int(random.integers(max(0, len(names) - 3), len(names)))]
        r = float(scale * random.uniform(0.5, 1.5))
        x = float(r * random.uniform(0.25, 0.5))
        zero = {"r0_ohm": 4.0 * r, "x0_ohm": 3.0 * x} if phases else {}
        lines.append(LineRow(f"l{k}", above, f"n{k}", r, x, **zero))
        names.append(f"n{k}")
    odds, rows = random.dirichlet([4.0, 4.0, 4.0]), []
    for c in range(customers):
        phase = "abc"[int(random.choice(3, p=odds))] if phases else "abc"
        at = names[int(random.integers(0 if c == 0 else 1, len(names)))]
        r = float(random.uniform(0.005, 0.03))
        lines.append(LineRow(f"s{c}", at, f"c{c}", r, 0.15 * r, phases=phase))
        solar = c % 3 == 0
        peak = float(random.uniform(3.0, 8.0))
        rows.append(
            CustomerRow(
                f"load-{c}",
                f"c{c}",
                load_kw=peak,
                phases=phase,
                meter=f"m{c}",
                pv_kw=4.14 if solar else 0.0,
                inverter_kva=4.6 if solar else 0.0,
                droop="ieee1547-b" if solar else "",
            )
        )
    meta = FeederMeta(format=1, name="random", voltage_volt=_VOLT, busbar="bb")
    return FeederTables(meta, tuple(lines), tuple(rows))


_VOLT, _DROP, _KW = 230.0, 0.04, 4.0


def squared_to_shift(where: Site, y: Floats, lie: Floats) -> Floats:
    """Displacement of readings, pu of nominal, that moves squared readings y, pu, by a lie, (p,)."""
    of_nominal = (where.customer_volt / where.customer_nominal)[where.meters]
    return np.asarray(of_nominal * (np.sqrt(np.maximum(y + lie, 0.0)) - np.sqrt(y)))

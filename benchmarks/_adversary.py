"""Worlds, monitors and acceptance regions of `benchmarks.adversary`.

The acceptance region is that of the statistical core of `modal` for a step of one age,
`gridsec.planning.detectability.acceptance_region`. Other estimators of the registry are played with the
attacks made for `modal`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from benchmarks._scenes import LEARN_S, LEARN_STEP_S, Model, Setting, play, site, watcher
from feeders.model.site import Site, Snapshot, from_tables, late
from feeders.registry import DesignedEstimator, design
from feeders.simulation.scenario import START
from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.front import FrontDesign
from gridsec.estimators.front.meter_bias import Learned
from gridsec.estimators.modal import detector
from gridsec.estimators.modal.monitor import ModalDesign, ModalState
from gridsec.grid.network import Power
from gridsec.interface import Decision, Frame
from gridsec.planning.detectability import acceptance_region
from gridsec.planning.unavoidable import AcceptanceRegion, Faults

LATE_S = 60.0
"""Age of late powers, s."""
LARGEST = 0.2
"""Largest false voltage, squared pu: beyond about 10 % of the voltage no reading is plausible."""


# --- worlds -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class World:
    """One honest world.

    Attributes
    ----------
    setting
        Feeder, seed, and whether fixed errors are learned; all powers are read.
    aged
        Powers are `LATE_S` old, and the feeder's files state it.
    """

    setting: Setting
    aged: bool = False

    @property
    def site(self) -> Site:
        """The feeder as its files state it."""
        return _aged(self.setting.feeder) if self.aged else site(self.setting.feeder)

    def estimator(self, name: str, step_s: float = 1.0, commission_s: float = 0.0) -> DesignedEstimator:
        """An estimator for the feeder as its files state it."""
        of = _aged_watcher if self.aged else partial(watcher, model=Model.MATCHED)
        return of(self.setting.feeder, step_s=step_s, commission_s=commission_s, estimator=name)

    def frames(self, duration_s: float) -> Iterator[tuple[Frame, Floats]]:
        """Honest frames and true squared voltages, (N,), from `START` on."""
        if not self.aged:
            yield from ((frame, truth.v2) for frame, truth in play(self.setting, duration_s))
            return
        past: list[Frame] = []
        begin = START - LATE_S
        for frame, truth in play(self.setting, duration_s + LATE_S, start=begin):
            past.append(frame)
            if frame.t >= START:
                yield _with_late_powers(self.site, frame, past.pop(0)), truth.v2


@lru_cache(maxsize=8)
def _aged(feeder: str) -> Site:
    tables = site(feeder).tables
    meters = replace(tables.meta.meters, p_interval_s=LATE_S)
    return from_tables(replace(tables, meta=replace(tables.meta, meters=meters)))


@lru_cache(maxsize=8)
def _aged_watcher(feeder: str, *, step_s: float, commission_s: float, estimator: str) -> DesignedEstimator:
    """As `watcher`, where powers are late."""
    tables = _aged(feeder).tables
    settings = replace(tables.meta.monitor, estimator=estimator, commission_s=commission_s, tick_s=step_s)
    return design(from_tables(replace(tables, meta=replace(tables.meta, monitor=settings))))


def _with_late_powers(where: Site, frame: Frame, old: Frame) -> Frame:
    """Frame with the powers of an older one, widened as the files state."""
    names = ("p", "p_error", "q", "q_error")
    frame = replace(frame, **{name: getattr(old, name) for name in names})
    p_kw = -old.p[where.meters] * where.feeder.base_kva
    told = Snapshot(frame.t, np.zeros(p_kw.size), p_kw, np.full(p_kw.size, np.nan), 0.0)
    aged = late(where, told)
    return frame if aged is None else aged.widen(where, frame)


# --- monitors -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Answer of a monitor to one frame. N customers, p meters."""

    v2: Floats  # (N,) squared voltages, pu
    decision: Decision
    named: Bools  # (p,)


class Registered:
    """An estimator of the registry.

    Parameters
    ----------
    name
        Its name.
    world
        The world.
    """

    def __init__(self, name: str, world: World) -> None:
        self.name, self.world = name, world
        self.design = world.estimator(name)

    def start(self, learning: Iterable[Frame]) -> Any:
        """State before the first frame, with the errors learned by the frames of the learning run, if any."""
        frames, by = list(learning), self.design.family.bias_learning
        if not frames or by is None:
            return self.design.init(START)
        made = self.world.estimator(self.name, LEARN_STEP_S, LEARN_S)
        state = made.init(START - LEARN_S - 2.0 * LEARN_STEP_S)
        for frame in frames:
            state, _, _ = made.step(state, frame)
        return by.init(self.design.design, START, replace(by.commission(state), learning=None))

    def step(self, state: Any, frame: Frame) -> tuple[Any, Answer]:
        """Process one frame."""
        state, estimate_, verdict = self.design.step(state, frame)
        return state, Answer(estimate_.v2, verdict.decision, verdict.suspects)


def learning(setting: Setting) -> Iterator[Frame]:
    """Honest frames of the six hours before `START`."""
    begin = START - LEARN_S - 2.0 * LEARN_STEP_S
    yield from (frame for frame, _ in play(setting, START - begin, step_s=LEARN_STEP_S, start=begin))


# --- acceptance regions -------------------------------------------------------------------------


def honest_covariance(front: FrontDesign, learned: Learned, ticks: int) -> tuple[Floats, Floats]:
    """Covariance of a mean of honest residuals, (p, p), and that of the places' voltages with it, (n, p).

    front, learned: the front end, and the known fixed errors.
    ticks: length of the mean, with all readings.
    """
    prior = front.prior
    V = prior.covariance[prior.meters] + np.diag(learned.variance + front.white / ticks)
    return V, prior.covariance


def region(design: ModalDesign, state: ModalState, age: int) -> AcceptanceRegion:
    """Steps of a given age that the core accepts, all readings complete.

    Parameters
    ----------
    design, state
        The monitor, and its state after honest ticks.
    age
        Ticks since the onset, its own included.
    """
    kernel = design.core
    onsets = detector.followed(kernel.modes, state.core.detector).onsets
    rows = np.flatnonzero(onsets.used & ~onsets.ramp)
    return acceptance_region(kernel, state.core, int(rows[np.argmin(np.abs(onsets.age[rows] - age))]))


# --- faults -------------------------------------------------------------------------------------


def faults(
    where: Site, made: FrontDesign, frame: Frame, meters: Ints, *, powers: bool, busbar: bool
) -> Faults:
    """Faults of a coalition at one frame.

    Parameters
    ----------
    where, made, frame
        The feeder, the front end, and the last honest frame.
    meters
        Meters with false voltages.
    powers
        Their customers' active powers may be false, within the declared range.
    busbar
        The busbar's meter may be false.
    """
    places, at = made.prior.variance.size, made.prior.meters
    found = Faults.voltages(meters, (places, at.size), LARGEST)
    if powers:
        customers = made.plant.meters[meters]
        columns = made.sensitivities.columns(Power.ACTIVE, customers)
        p = frame.p[customers]
        least, most = -where.loads.load_peak[customers] - p, where.loads.pv_peak[customers] - p
        found = found.joined(Faults(-columns[at], columns, np.minimum(least, 0.0), np.maximum(most, 0.0)))
    if busbar:
        ones = np.ones((places, 1))
        found = found.joined(Faults(-ones[at], ones, np.array([-LARGEST]), np.array([LARGEST])))
    return found


def falsified(
    frame: Frame, made: FrontDesign, meters: Ints, amounts: Floats, *, powers: bool, busbar: bool
) -> Frame:
    """Frame with the faults of `faults`, in these amounts, (q,)."""
    y, p, v0 = frame.y.copy(), frame.p, frame.v0_squared
    y[meters] = np.maximum(y[meters] + amounts[: meters.size], 0.0)
    if powers:
        p = p.copy()
        p[made.plant.meters[meters]] += amounts[meters.size : 2 * meters.size]
    if busbar:
        v0 = v0 + float(amounts[-1])
    return replace(frame, y=y, p=p, v0_squared=v0)

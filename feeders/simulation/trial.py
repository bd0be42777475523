"""Trials: short scenarios with a known attack, for the comparison of estimators.

A trial is a `feeders.simulation.scenario.Scenario` with one load situation that varies slowly. Its frames
have the profiles' powers of all customers with an available meter. The true loads differ from these by an
Ornstein-Uhlenbeck process. The powers of all other customers are as in the service: the range, or a forecast.
The truth is full AC power flow with the droop inverters in closed loop.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.model.site import Site, Snapshot, from_tables, to_frame
from feeders.simulation.attacks import AttackKind, AttackSpec, manipulations
from feeders.simulation.demand import Customers, Variation
from feeders.simulation.plant import MeterErrors
from feeders.simulation.scenario import START, SUNNY_NOON_S, Scenario, SimulatedTick, simulate, snapshots
from feeders.util import own_numbers
from gridsec.arrays import Bools, Floats, Ints
from gridsec.attack import Coordinated, active
from gridsec.errors import choice
from gridsec.interface import Decision, Frame, Verdict

if TYPE_CHECKING:
    from feeders.registry import DesignedEstimator

__all__ = [
    "STEADY",
    "AttackKind",
    "AttackSpec",
    "FrameTruth",
    "LoadError",
    "Trial",
    "TrialMeterErrors",
    "TrialResult",
    "frames",
    "judge",
]

NO_CLASS_PERCENT: Final = 1e-4
"""Accuracy class of meters without a fixed error, %: the format has no class of zero."""

STEADY: Final = Variation(load_spread=0.0, cloud_spread=0.0, tap_step_pu=0.0)
"""Loads and generation follow their profiles, the busbar changes slowly."""

SETTLING_S: Final = 10.0
"""Settling time after the start and after the onset of an attack, without reconstruction errors, s."""


class TrialMeterErrors(StrEnum):
    """Errors of the meters of a trial, in truth and in the design."""

    WHITE = "white"
    """White noise of 0.2 % (busbar 0.02 %), no fixed error, no resolution."""
    REAL = "real"
    """Fixed error within 0.5 % (busbar 0.1 %), resolution 0.1 V, jitter 0.05 % (busbar 0.02 %)."""
    SITE = "site"
    """Errors of the feeder's files."""


@dataclass(frozen=True, slots=True)
class LoadError:
    """Differences between true powers and those of the frames."""

    # Standard deviations at every customer with a meter, kW and kvar.
    p_kw: float = 0.6
    q_kvar: float = 0.2
    correlation_s: float = 600.0  # correlation time, s
    # Half-width of the frames' intervals, in standard deviations. The default is that of a uniform
    # distribution.
    half_width: float = float(np.sqrt(3.0))


@dataclass(frozen=True, slots=True)
class Trial:
    """Short scenario on a feeder, with stated errors of loads and meters."""

    site: Site  # The feeder. Designs are for `stated`, with the errors of meters and loads.
    seed: int = 0  # seed of all random numbers
    # Length and interval of the frames, s.
    duration_s: float = 120.0
    step_s: float = 1.0
    # Load errors, and errors of the meters. Without `load_error`, registers, power factors and hidden powers
    # have the errors of the feeder's files, and frames are those of `to_frame`.
    load_error: LoadError | None = field(default_factory=LoadError)
    meters: TrialMeterErrors = TrialMeterErrors.WHITE
    lie: AttackSpec | None = None  # the attack; None without one
    profile_s: float = SUNNY_NOON_S  # position within the 14 days of the summer profiles, s
    # Known variation of loads and busbar; its `hidden_*` are those of `load_error`.
    variation: Variation = STEADY
    report_q: bool = False  # True: meters report the net reactive power

    def __post_init__(self) -> None:
        own_numbers(self)
        object.__setattr__(self, "meters", choice("meters", TrialMeterErrors, self.meters))

    @property
    def stated(self) -> Site:
        """Feeder with the errors of meters and loads, and the interval, of the trial."""
        meta, rows, error = self.site.tables.meta, self.site.tables.customers, self.load_error
        load, registers = meta.load, meta.meters
        if error is not None:
            rows = tuple(
                replace(row, p_std_kw=error.p_kw, q_std_kvar=error.q_kvar, p_error_percent=None)
                if row.meter
                else row
                for row in rows
            )
            load = replace(load, correlation_s=error.correlation_s)
            registers = replace(registers, p_error_percent=0.0, p_resolution_kw=0.0)
        monitor = replace(meta.monitor, tick_s=self.step_s)
        meta = replace(meta, load=load, monitor=monitor, meters=registers)
        if self.meters is not TrialMeterErrors.SITE:
            rows = tuple(
                replace(row, class_percent=None, resolution_volt=None, jitter_percent=None) for row in rows
            )
            white = self.meters is TrialMeterErrors.WHITE
            step = 0.0 if white else 0.1
            meta = replace(
                meta,
                accept=(*meta.accept, "class"),
                busbar_class_percent=NO_CLASS_PERCENT if white else 0.1,
                busbar_resolution_volt=step,
                busbar_jitter_percent=0.02,
                meters=replace(
                    registers,
                    class_percent=NO_CLASS_PERCENT if white else 0.5,
                    resolution_volt=step,
                    jitter_percent=0.2 if white else 0.05,
                ),
            )
        return from_tables(replace(self.site.tables, meta=meta, customers=rows))

    @property
    def scenario(self) -> Scenario:
        """Scenario of the trial, on `stated`."""
        error, told = self.load_error, self.site.tables.meta.load.correlation_s
        honest = Scenario(
            seed=self.seed,
            duration_s=self.duration_s,
            dt_s=self.step_s,
            profile_s=self.profile_s,
            errors=MeterErrors(power=1.0 if error is None else 0.0, report_q=self.report_q),
            variation=replace(
                self.variation,
                hidden_kw=None if error is None else error.p_kw,
                hidden_kvar=None if error is None else error.q_kvar,
                hidden_correlation_s=told if error is None else error.correlation_s,
            ),
        )
        attacks, inverter_attacks = manipulations(self.site, self.lie, honest)
        return replace(honest, attacks=attacks, inverter_attacks=inverter_attacks)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """The truth of one frame. N customers, p meters, m inverters."""

    v2: Floats  # (N,): squared voltages, pu
    liars: Bools  # (p,): mask of the manipulated meters
    attack: Floats  # (p,): reported minus honest squared voltage, pu
    inverters: Bools  # (m,): mask of the manipulated inverters


def frames(
    trial: Trial,
    scenario: Scenario | None = None,
    *,
    stated: Site | None = None,
    received: Callable[[Sequence[Snapshot]], Iterable[Snapshot]] = iter,
) -> Iterator[tuple[Frame, FrameTruth]]:
    """Simulate a trial, or another scenario on its feeder: frame and truth of each tick.

    Customers with an available meter have the powers of the profiles, falsified by the attack, and intervals
    of `LoadError.half_width`. The others, and all without `load_error`, have those of `to_frame`. `stated` is
    `trial.stated`, if known already. `received` turns the readings of all ticks into those that are received.

    Raises NoSuchAttack, PowerFlowDiverged, NoEquilibrium if the attack does not exist on this feeder, or the
        feeder has no solution.
    """
    site = trial.stated if stated is None else stated
    scenario = trial.scenario if scenario is None else scenario
    known = Customers.of(site, scenario)
    if site.forecast is not None:
        origin = scenario.start - scenario.profile_s
        site = replace(site, forecast=site.forecast.played(origin, scenario.season))
    samples = list(simulate(site, scenario))
    t = np.array([sample.t for sample in samples])
    demand = known.at(t)
    fake_kw, fake_kvar = _fake_load(site, scenario, t)
    told = zip(demand.p_kw + fake_kw, demand.q_kvar + fake_kvar, strict=True)
    for sample, snapshot, (p_kw, q_kvar) in zip(
        samples, received(list(snapshots(samples))), told, strict=True
    ):
        frame = to_frame(site, snapshot)
        if trial.load_error is not None:
            read = np.isfinite(snapshot.p_kw)
            frame = _powers(trial.load_error, site, frame, (p_kw, q_kvar), read)
        yield frame, _truth(site, scenario, sample)


def _powers(error: LoadError, site: Site, frame: Frame, powers: tuple[Floats, Floats], read: Bools) -> Frame:
    """Frame with the reported powers; unread and implausible ones stay as they are."""
    (p_kw, q_kvar), base = powers, site.feeder.base_kva
    believed = np.zeros(frame.p.size, dtype=np.bool_)
    believed[site.meters] = read & (np.abs(p_kw) <= site.loads.credible * base)[site.meters]
    p_error = np.full(frame.p.size, error.half_width * error.p_kw / base)
    # Registers are exact here: the error of the frame beyond it is the excess over the connection's limit.
    p_error[site.meters] = np.maximum(p_error[site.meters], frame.p_error[site.meters])
    forecast = (
        None if std is None else np.where(believed, np.nan, std) for std in (frame.p_std, frame.q_std)
    )
    p_std, q_std = forecast
    return replace(
        frame,
        p=np.where(believed, -p_kw / base, frame.p),
        p_error=np.where(believed, p_error, frame.p_error),
        q=np.where(believed, -q_kvar / base, frame.q),
        q_error=np.where(believed, error.half_width * error.q_kvar / base, frame.q_error),
        p_std=p_std,
        q_std=q_std,
    )


def _fake_load(site: Site, scenario: Scenario, t: Floats) -> tuple[Floats, Floats]:
    """Reported powers of false loads, kW and kvar, (T, N) each."""
    p_kw, q_kvar = np.zeros((2, t.size, len(site.tables.customers)))
    for attack in scenario.attacks:
        if isinstance(attack, Coordinated):
            cells = np.ix_(active(attack, t), site.meters[attack.meters])
            p_kw[cells] += attack.p_shift
            q_kvar[cells] += attack.q_shift
    return p_kw, q_kvar


def _truth(site: Site, scenario: Scenario, sample: SimulatedTick) -> FrameTruth:
    base = site.customer_volt
    reported = sample.reported.v_volt[0]
    inverters = np.zeros(site.droop.tau.size, dtype=np.bool_)
    for attack in scenario.inverter_attacks:
        inverters[attack.inverters] |= attack.t_on <= sample.t < attack.t_off
    return FrameTruth(
        v2=(sample.v_volt / base) ** 2,
        liars=sample.manipulated,
        attack=(reported**2 - (reported - sample.shift_volt) ** 2) / base[site.meters] ** 2,
        inverters=inverters,
    )


@dataclass(frozen=True, slots=True, eq=False)
class TrialResult:
    """Result of an estimator in one trial. T ticks, p meters, k, l manipulated meters and inverters."""

    liars: Ints  # (k,): meters manipulated at some time
    # (k,): time from the onset of each attack to the first naming of the meter during it, s; infinite without
    # one.
    delay_s: Floats
    # (l,): the same for inverters.
    inverters: Ints
    inverter_delay_s: Floats
    accused: Bools  # (p,): meters named before their manipulation, or without one
    accused_inverters: Bools  # (m,): the same for inverters
    false_names: Ints  # (T,): number of falsely named meters at each tick
    # Reconstruction errors of the voltage at manipulated meters and at all customers, % of nominal, one per
    # tick and place after settling; infinite if the estimate is not finite.
    error_liars: Floats
    error_all: Floats
    step_ms: Floats  # (T,): processor time of each step, ms
    clean_while_lying: Bools  # (T,): ticks with an attack and the verdict CLEAN without named devices
    lying: Bools  # (T,): ticks with an attack
    undecided: Bools  # (T,): ticks with the verdict UNDECIDED

    @property
    def missed(self) -> int:
        """Number of manipulated devices, inverters included, that were never named."""
        return int(np.isinf(self.delay_s).sum() + np.isinf(self.inverter_delay_s).sum())

    @property
    def false_clean(self) -> float:
        """Share of the ticks with an attack at which the verdict was CLEAN; NaN without an attack."""
        return float(self.clean_while_lying.sum() / self.lying.sum()) if self.lying.any() else np.nan


def judge(
    watcher: DesignedEstimator,
    trial: Trial,
    *,
    settling_s: float = SETTLING_S,
    played: Iterable[tuple[Frame, FrameTruth]] | None = None,
) -> TrialResult:
    """Run a design for `trial.stated` on a trial, or on its frames if known already (`played`).

    Reconstruction errors count from `settling_s` after the start and after each onset.
    """
    state = watcher.init(START)
    ticks: list[tuple[float, Verdict, FrameTruth]] = []
    all_errors: list[Floats] = []
    liar_errors: list[Floats] = []
    of_nominal = trial.site.customer_volt / trial.site.customer_nominal
    step_ms: list[float] = []
    settled, lied = START + settling_s, False
    for frame, truth in frames(trial) if played is None else played:
        begun = time.process_time()  # processor time: other programs have no effect
        state, estimate, verdict = watcher.step(state, frame)
        step_ms.append(1e3 * (time.process_time() - begun))
        ticks.append((frame.t, verdict, truth))
        lies = bool(truth.liars.any() or truth.inverters.any())
        if lies and not lied:
            settled = max(settled, frame.t + settling_s)
        lied = lies
        if frame.t >= settled:
            error = of_nominal * _error_percent(estimate.v2, truth.v2)
            all_errors.append(error)
            liar_errors.append(error[trial.site.meters[truth.liars]])
    t = np.array([t for t, _, _ in ticks])
    named = np.array([verdict.suspects for _, verdict, _ in ticks])
    liars = np.array([truth.liars for _, _, truth in ticks])
    wrong = np.array([truth.inverters for _, _, truth in ticks])
    blamed = np.array([_inverters(verdict, truth) for _, verdict, truth in ticks])
    decisions = [verdict.decision for _, verdict, _ in ticks]
    lying: Bools = np.any(liars, axis=1) | np.any(wrong, axis=1)
    clean = np.array([decision is Decision.CLEAN for decision in decisions])
    false = named & ~_since(liars)
    return TrialResult(
        liars=np.flatnonzero(liars.any(axis=0)),
        delay_s=_delays(t, named, liars),
        inverters=np.flatnonzero(wrong.any(axis=0)),
        inverter_delay_s=_delays(t, blamed, wrong),
        accused=np.any(false, axis=0),
        accused_inverters=np.any(blamed & ~_since(wrong), axis=0),
        false_names=false.sum(axis=1),
        error_liars=np.concatenate(liar_errors) if liar_errors else np.zeros(0),
        error_all=np.concatenate(all_errors) if all_errors else np.zeros(0),
        step_ms=np.array(step_ms),
        clean_while_lying=lying & clean & ~named.any(axis=1) & ~blamed.any(axis=1),
        lying=lying,
        undecided=np.array([decision is Decision.UNDECIDED for decision in decisions]),
    )


def _error_percent(v2: Floats, truth: Floats) -> Floats:
    with np.errstate(invalid="ignore"):
        error = 100.0 * np.abs(np.sqrt(v2) - np.sqrt(truth))
    return np.where(np.isfinite(error), error, np.inf)


def _inverters(verdict: Verdict, truth: FrameTruth) -> Bools:
    """Mask of the named inverters; none for estimators without inverter tests."""
    return verdict.inverters if verdict.inverters.size else np.zeros_like(truth.inverters)


def _since(lies: Bools) -> Bools:
    """True from the begin of each attack on, (T, k): a name just after an attack is not false."""
    return np.logical_or.accumulate(lies, axis=0)


def _delays(t: Floats, named: Bools, lies: Bools) -> Floats:
    """Time from each device's first manipulation to its first naming during one, s."""
    out = []
    for j in np.flatnonzero(lies.any(axis=0)):
        caught = np.flatnonzero(named[:, j] & lies[:, j])
        out.append(t[caught[0]] - t[np.argmax(lies[:, j])] if caught.size else np.inf)
    return np.array(out)

"""Estimator `modal` and its core against the limits of detection and estimation, as tables in Markdown.

    python -m benchmarks.limits [runs] [feeder ...]

Matched world: residuals are drawn from the model of `gridsec.estimators.modal`, white noise of 0.2 %, loads
known to 0.6 kW and 0.2 kvar with a correlation time of 600 s, no inverters, one reading per second, one false
alarm a year. The first 180 ticks are honest but where stated.

Delays: one random meter is off by a constant part of the voltage; also with meters of class 0.5 % after 10
and 3 600 honest ticks. Ticks from the onset, its own included, to the first answer that is not CLEAN and to
the first tick at which exactly this meter is named, means of the runs. Lorden: the least n with
``F_n f^2 / 2 >= log gamma``, F_n: the information after n ticks. CUSUM: the largest likelihood ratio over all
onsets for the true meter and size, against ``log gamma``. GLR: that over all onsets and the p meters for the
true size, against ``log (p gamma)``: the run lengths of
both to a false alarm are at least gamma, as that of `modal`. Ratio: named by `modal` over GLR.

Liars: a third of the meters, random, with random signs or alike, or contiguous and alike, 60 ticks long.
Named of the liars and honest meters named in the last tick; error at the liars over the Cramer-Rao bound,
the standard deviation of a Kalman filter that knows the liars and the onset, root mean squares of the
second half.

Missing readings: patterns of `benchmarks._residuals.present`. Largest log M of `GAPS` honest ticks, share of
the voltages at all places within 1.96 stated standard deviations, and mean time of a step of the core; then
delays of a step of 0.5 % as above, the CUSUM by a dense filter with the same readings. Mixture: this filter
with the weights and the prior size of the core, steps of the true meter only. It pays for not
knowing the meter and the size; the core's alarm also pays for its approximations.

Honest: AC power flow, meters of class 0.5 % with 0.1 V and 0.05 %. Root mean square error of all customers'
voltages, and of the error over its stated standard deviation; the largest log M of the core, and the mean of
a calm step, ms.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from math import exp, log

import numpy as np

from benchmarks._arguments import arguments
from benchmarks._residuals import PATTERNS, KnownStep, present
from benchmarks._table import head, row
from feeders.model.site import Site, from_tables, load
from feeders.registry import DesignedEstimator, design
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, frames
from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.front import FrontDesign
from gridsec.estimators.modal import core, detector, estimate, full, signatures, static
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.core import Core
from gridsec.estimators.modal.costs import SearchProblem
from gridsec.estimators.modal.estimate import Estimated
from gridsec.estimators.modal.search import Identification
from gridsec.interface import Decision, Frame

QUIET, WATCHED = 180, 120
"""Honest ticks before an onset, and ticks after it."""
SHORT = 60
"""Ticks of a manipulation by a third of the meters."""
LOOK = 5
"""Ticks from one identification to the next while a manipulation goes on."""
GAPS = 3000
"""Honest ticks with missing readings."""
STEPS = (0.003, 0.005, 0.01, 0.02)
"""Sizes of the steps, parts of the voltage."""
SCENES = (
    ("white", TrialMeterErrors.WHITE, QUIET),
    ("class 0.5 %", TrialMeterErrors.REAL, 10),
    ("class 0.5 %, learned", TrialMeterErrors.REAL, 3600),
)
"""Meters of the delays, and honest ticks before the onset."""
LIES = (("random signs", 0.005), ("alike", 0.005), ("contiguous", 0.005), ("contiguous", 0.01))
VOLT = 230.0


@lru_cache(maxsize=8)
def site(feeder: str) -> Site:
    """A feeder without inverters: the model of the residuals is exact."""
    tables = load(feeder).tables
    rows = tuple(replace(row, inverter_kva=0.0, droop="") for row in tables.customers)
    return from_tables(replace(tables, customers=rows))


@lru_cache(maxsize=8)
def watcher(feeder: str, meters: TrialMeterErrors) -> DesignedEstimator:
    """The monitor of a feeder."""
    return unlearned(Trial(site(feeder), meters=meters).stated)


def unlearned(stated: Site) -> DesignedEstimator:
    """The monitor of a feeder without commissioning."""
    meta = stated.tables.meta
    settings = replace(meta.monitor, commission_s=0.0)
    return design(from_tables(replace(stated.tables, meta=replace(meta, monitor=settings))))


@lru_cache(maxsize=8)
def kernel_of(feeder: str, meters: TrialMeterErrors) -> Core:
    """The core of `watcher`."""
    kernel: Core = watcher(feeder, meters).design.core
    return kernel


class World:
    """Frames of the linear model with matched errors.

    Parameters
    ----------
    front
        Design of the front end.
    seed
        Chooses everything random.
    """

    def __init__(self, front: FrontDesign, seed: int) -> None:
        self.front, self.random, self.k = front, np.random.default_rng([seed, 9]), 0
        count = front.customers
        self.effects = front.sensitivities.numbered(np.arange(2 * count))
        self.std = np.concatenate([front.doubt.p, front.doubt.q])
        self.rho = exp(-front.step_s / front.doubt.time_s)
        self.powers = self.std * self.random.standard_normal(2 * count)
        self.fixed = np.sqrt(front.fixed) * self.random.standard_normal(front.fixed.size)
        self.busbar = front.busbar * float(self.random.standard_normal())
        self.p, self.zero = np.full(count, -0.01), np.zeros(count)
        self.model = front.plant.feeder.bus_voltages(self.p, self.zero, 1.0, steps=1)
        self.seen = np.ones(front.fixed.size, dtype=np.bool_)

    def tick(self, lie: Floats | float = 0.0) -> tuple[Frame, Floats, Floats]:
        """Next frame, residuals of the meters, and true errors of the model at all places.

        Parameters
        ----------
        lie : (p,)
            Manipulation, squared pu.
        """
        front, random = self.front, self.random
        flick = np.sqrt(front.busbar_noise) * float(random.standard_normal())
        truth = self.effects @ self.powers + self.busbar + flick
        white = np.sqrt(front.white) * random.standard_normal(front.white.size)
        residual = truth[front.prior.meters] + self.fixed + white + lie
        y = self.model[front.prior.meters] + residual
        none = np.full(self.p.size, np.nan)
        doubt, t = front.doubt, float(self.k)
        frame = Frame(t, y, self.seen, 1.0, self.p, doubt.even_p, self.zero, doubt.even_q, none, none)
        fresh = np.sqrt(1.0 - self.rho**2) * self.std * random.standard_normal(self.std.size)
        self.powers = self.rho * self.powers + fresh
        self.k += 1
        return frame, residual, truth


def squared(part: float) -> float:
    """Squared lie of a part of the voltage near nominal, pu."""
    return (1.0 + part) ** 2 - 1.0


@dataclass
class Delays:
    """Ticks from the onset; NaN where an answer did not come."""

    cusum: float
    glr: float
    clean: float
    named: float


def delay(made: DesignedEstimator, part: float, seed: int, quiet: int) -> Delays:
    """One step of one meter after `quiet` honest ticks."""
    world, f, kernel = World(made.design.front, seed), squared(part), made.design.core
    p = kernel.modes.size
    liar = int(np.random.default_rng([seed, 1]).integers(p))
    state = made.init(0.0)
    sized, out = KnownSize(kernel, f), dict.fromkeys(Delays.__annotations__, np.nan)
    lie = np.where(np.arange(p) == liar, f, 0.0)

    def first(name: str, there: bool, k: int) -> None:
        if there and np.isnan(out[name]):
            out[name] = k - quiet + 1

    for k in range(quiet + WATCHED):
        on = k >= quiet
        frame, m, _ = world.tick(lie if on else 0.0)
        state, _, verdict = made.step(state, frame)
        levels = sized.tick(float(k), m) if k >= quiet - 10 else sized.wait(float(k), m)
        if not on:
            continue
        first("cusum", levels[liar] >= kernel.limit, k)
        first("glr", levels.max() >= kernel.limit + log(p), k)
        first("clean", verdict.decision is not Decision.CLEAN, k)
        first("named", bool(verdict.suspects[liar]) and int(verdict.suspects.sum()) == 1, k)
        if not np.isnan(list(out.values())).any():
            break
    return Delays(**out)


class KnownSize:
    """Log likelihood ratio of a step of known size at each meter, the largest over onsets, (p,).

    Parameters
    ----------
    kernel
        The core.
    f
        Size, squared pu.
    """

    def __init__(self, kernel: Core, f: float) -> None:
        self.made, self.f = kernel.modes, f
        self.state, self.more = modal.start(self.made, 0.0), static.start(self.made)
        self.rows, self.next = signatures.empty(self.made, WATCHED + 16), 0

    def wait(self, t: float, m: Floats) -> Floats:
        """Take in a tick without an onset."""
        return self._tick(t, m, [])

    def tick(self, t: float, m: Floats) -> Floats:
        """Take in a tick and its onset."""
        self.next += 1
        return self._tick(t, m, [self.next - 1])

    def _tick(self, t: float, m: Floats, begun: list[int]) -> Floats:
        self.state, self.more, update = full.step(self.made, self.state, self.more, t, m)
        self.rows = signatures.follow(self.made, self.rows, update, self.more, 1.0, begun=begun)
        W = self.made.U.T
        y, F = signatures.scores(self.made, self.rows, self.more).of(W, W**2)
        largest: Floats = (self.f * y - 0.5 * self.f**2 * F).max(axis=0)
        return largest


def lorden(kernel: Core, part: float, quiet: int) -> float:
    """Least number of ticks with the information of one false alarm a year, mean over meters."""
    made, f = kernel.modes, squared(part)
    state, more, rows = modal.start(made, 0.0), static.start(made), signatures.empty(made, 1)
    done = np.full(made.size, np.nan)
    for k in range(quiet + WATCHED):
        state, more, update = full.step(made, state, more, float(k), np.zeros(made.size))
        rows = signatures.follow(made, rows, update, more, 1.0, begun=[0] if k == quiet else [])
        if k >= quiet:
            F = signatures.scores(made, rows, more).of(made.U.T, made.U.T**2)[1][0]
            done = np.where(np.isnan(done) & (0.5 * f * f * F >= kernel.limit), k - quiet + 1, done)
    return float(np.mean(done))


def third(kernel: Core, kind: str, part: float, seed: int) -> Floats:
    """Manipulation by a third of the meters, squared pu, (p,)."""
    random, p = np.random.default_rng([seed, 2]), kernel.modes.size
    which = random.choice(p, p // 3, replace=False)
    if kind == "contiguous":
        S = kernel.model.loads(np.arange(p))
        distance = S.diagonal()[:, None] + S.diagonal() - 2.0 * S
        which = np.argsort(distance[int(random.integers(p))])[: p // 3]
    sign = random.choice([-1.0, 1.0], which.size) if kind == "random signs" else 1.0
    out = np.zeros(p)
    out[which] = squared(part) * sign
    return out


@dataclass
class Third:
    """Result of one run with a third of the meters manipulated."""

    named: int
    honest: int
    named_core: int
    honest_core: int
    error: float
    error_core: float
    error_known: float
    bound: float


def attacked(made: DesignedEstimator, kernel: Core, kind: str, part: float, seed: int) -> Third:
    """One run."""
    world, lie = World(made.design.front, seed), third(kernel, kind, part, seed)
    state, mine, liars = made.init(0.0), core.init(kernel, 0.0), lie != 0.0
    at, known = kernel.model.meters[liars], Support(kernel, liars)
    found, named = None, np.zeros(liars.size, dtype=np.bool_)
    squares: list[Floats] = []
    for k in range(QUIET + SHORT):
        frame, m, truth = world.tick(lie if k >= QUIET else 0.0)
        state, answer, verdict = made.step(state, frame)
        mine, evidence = core.step(kernel, mine, frame.t, m)
        bound = known.tick(float(k), m, k == QUIET)
        if k >= QUIET + SHORT // 2 and (k - QUIET) % LOOK == LOOK - 1:
            found = core.identify(kernel, mine, evidence) if core.alarmed(kernel, evidence) else None
            named = np.zeros_like(named) if found is None else found.found.named
            now = core.estimate(kernel, mine, found).mean
            exact = world.model + truth
            old = answer.v2[made.design.plant.meters][liars]
            squares.append(
                np.array(
                    [
                        np.mean((old - exact[at]) ** 2),
                        np.mean((now - truth)[at] ** 2),
                        np.mean((bound.mean - truth)[at] ** 2),
                        np.mean(bound.variance[at]),
                    ]
                )
            )
    errors = np.sqrt(np.mean(squares, axis=0)) * 0.5 * VOLT
    suspects = verdict.suspects
    return Third(
        int((suspects & liars).sum()),
        int((suspects & ~liars).sum()),
        int((named & liars).sum()),
        int((named & ~liars).sum()),
        *errors.tolist(),
    )


class Support:
    """Kalman filter that knows the manipulated meters and the onset: the Cramer-Rao bound.

    Parameters
    ----------
    kernel
        The core.
    liars : (p,)
        The manipulated meters.
    """

    def __init__(self, kernel: Core, liars: Bools) -> None:
        self.kernel, self.made = kernel, kernel.modes
        self.liars: Ints = np.flatnonzero(liars)
        self.state, self.more = modal.start(self.made, 0.0), static.start(self.made)
        self.rows = signatures.empty(self.made, 1)

    def tick(self, t: float, m: Floats, onset: bool) -> Estimated:
        """Take in a tick; errors of the model at all places and their variance."""
        made, kernel, k = self.made, self.kernel, self.liars.size
        self.state, self.more, update = full.step(made, self.state, self.more, t, m)
        self.rows = signatures.follow(
            self.made, self.rows, update, self.more, 1.0, begun=[0] if onset else []
        )
        plain = estimate.honest(made, kernel.estimator, self.state, self.more)
        if not self.rows.used[0]:
            return plain
        W = made.U.T[:, self.liars]
        now = signatures.joint(made, self.rows, self.more, 0)
        y, F = now.of(W)
        problem = SearchProblem(y, F, np.full(k, 1.0), k, np.zeros(k), np.full(k, np.inf))
        every = np.ones((1, k), dtype=np.bool_)
        one = Identification(every, np.zeros(1, np.intp), np.ones(1), every[0], (problem,))
        zero = np.zeros((plain.mean.size, k))
        T = estimate.moves(made, kernel.estimator, self.state, now, W, zero)
        return estimate.corrected([plain], [T], one)


@dataclass
class Gaps:
    """Result of one run with missing readings."""

    log_m: float
    covered: float
    step: float
    cusum: float
    mixture: float
    alarm: float
    named: float


def gaps(made: DesignedEstimator, kernel: Core, pattern: str, seed: int) -> Gaps:
    """One honest run, and one with a step of 0.5 % at one meter that reports."""
    p, random = kernel.modes.size, np.random.default_rng([seed, 77])
    seen, world = present(pattern, p, GAPS, random), World(made.design.front, seed)
    mine = core.init(kernel, 0.0)
    most, took, within = -np.inf, 0.0, list[float]()
    there = kernel.model.variance > 1e-3 * kernel.model.variance.max()
    for k in range(GAPS):
        frame, m, truth = world.tick()
        begun = time.thread_time()
        mine, evidence = core.step(kernel, mine, frame.t, m, seen[k])
        took += time.thread_time() - begun
        most = max(most, evidence.log_m)
        if k % 97 == 96:
            now = core.estimate(kernel, mine)
            z2 = (now.mean - truth)[there] ** 2 / now.variance[there]
            within.append(float((z2 < 1.96**2).mean()))
    seen = present(pattern, p, QUIET + WATCHED, random)
    return Gaps(most, float(np.mean(within)), 1e3 * took / GAPS, *_gap_delays(made, kernel, seen, seed))


def _gap_delays(made: DesignedEstimator, kernel: Core, seen: Bools, seed: int) -> list[float]:
    """Ticks to the limit by the CUSUM and by the mixture, to the alarm and to the name; NaN for never."""
    world, mine, out = World(made.design.front, seed + 1000), core.init(kernel, 0.0), [np.nan] * 4
    liar, f = (
        int(np.random.default_rng(seed).choice(np.flatnonzero(seen[QUIET:].any(axis=0)))),
        squared(0.005),
    )
    cusum = KnownStep(kernel.model, liar, f, WATCHED + 16)
    for k in range(QUIET + WATCHED):
        on = k >= QUIET
        frame, m, _ = world.tick(f * (np.arange(kernel.modes.size) == liar) if on else 0.0)
        mine, evidence = core.step(kernel, mine, frame.t, m, seen[k])
        level = cusum.step(float(k > 0), m, seen[k], k >= QUIET - 10)
        begun = slice(max(1, cusum.count))
        own = cusum.y[begun, None], cusum.F[begun, None], np.array([detector.SIZE**2])
        each = detector.log_mean(*own)
        weight = detector.WEIGHTS[0] * (1.0 - detector.RAMPS) / kernel.modes.size
        mixture = float(np.logaddexp.reduce(each)) + log(weight)
        there = [level >= kernel.limit, mixture >= kernel.limit, core.alarmed(kernel, evidence), False]
        if on and there[2]:
            named = core.identify(kernel, mine, evidence).found.named
            there[3] = bool(named[liar]) and int(named.sum()) == 1
        out = [
            k - QUIET + 1 if on and now and np.isnan(had) else had
            for had, now in zip(out, there, strict=True)
        ]
        if not np.isnan(out).any():
            break
    return out


@dataclass
class Honest:
    """Result of one honest run: error in mV, ratio to the stated deviation, mean step in ms, log M."""

    error: float
    ratio: float
    step: float
    most: float


def honest(feeder: str, seed: int, ticks: int = 240) -> Honest:
    """AC power flow as the truth."""
    trial = Trial(
        site(feeder), seed=seed, duration_s=float(ticks), meters=TrialMeterErrors.REAL, load_error=LoadError()
    )
    made = watcher(feeder, TrialMeterErrors.REAL)
    state, most, took = None, -np.inf, list[float]()
    squares: list[tuple[float, float]] = []
    for k, (frame, truth) in enumerate(_played(trial)):
        state = made.init(frame.t) if state is None else state
        begun = time.thread_time()
        state, answer, _ = made.step(state, frame)
        took.append(time.thread_time() - begun)
        if k < ticks // 4:
            continue
        most = max(most, state.core.detector.log_m)
        error = answer.v2 - truth.v2
        squares.append((float(np.mean(error**2)), float(np.mean((error / answer.std) ** 2))))
    root = np.sqrt(np.mean(squares, axis=0))
    return Honest(root[0] * 0.5 * VOLT * 1e3, root[1], 1e3 * float(np.mean(took[ticks // 4 :])), most)


def _played(trial: Trial) -> Iterator[tuple[Frame, object]]:
    yield from list(frames(trial))


def mean(values: list[float]) -> str:
    """Mean of the answers that came, and how many did not."""
    there = [each for each in values if not np.isnan(each)]
    never = f" ({len(values) - len(there)} never)" if len(there) < len(values) else ""
    return f"{np.mean(there):.1f}{never}" if there else "never"


def delays(runs: int, names: tuple[str, ...]) -> None:
    """Table of delays."""
    answers = ("not CLEAN", "named", "ratio")
    head("feeder, meters", "errors", "step, %", "Lorden", "CUSUM", "GLR", *answers)
    for feeder, (words, meters, quiet) in product(names, SCENES):
        made = watcher(feeder, meters)
        kernel = made.design.core
        for part in STEPS:
            each = [delay(made, part, seed, quiet) for seed in range(runs)]
            cells = [mean([getattr(one, name) for one in each]) for name in Delays.__annotations__]
            least = f"{lorden(kernel, part, quiet):.1f}"
            both = [(one.named, one.glr) for one in each if not np.isnan(one.named + one.glr)]
            ratio = np.divide(*np.sum(both, axis=0)) if both else np.nan
            row(f"{feeder}, {kernel.modes.size}", words, f"{100 * part:g}", least, *cells, f"{ratio:.2f}")


def main(runs: int, names: tuple[str, ...]) -> None:
    """All tables."""
    delays(runs, names)
    head(
        "feeder, liars",
        "lie",
        "named",
        "honest named",
        "core named",
        "honest",
        "error, V",
        "core",
        "support known",
        "bound",
    )
    for feeder in names:
        made = watcher(feeder, TrialMeterErrors.WHITE)
        kernel = kernel_of(feeder, TrialMeterErrors.WHITE)
        for kind, part in LIES:
            each_ = [attacked(made, kernel, kind, part, seed) for seed in range(max(1, runs // 4))]
            liars = kernel.modes.size // 3 * len(each_)
            counts = [sum(getattr(one, name) for one in each_) for name in list(Third.__annotations__)[:4]]
            volts = [
                np.mean([getattr(one, name) for one in each_]) for name in list(Third.__annotations__)[4:]
            ]
            texts = [f"{volt:.3f}" for volt in volts]
            row(f"{feeder}, {liars}", f"{kind} {100 * part:g} %", *counts, *texts)
    head(
        "feeder", "readings", "log M", "covered", "step, ms", "CUSUM", "mixture", "core alarms", "core names"
    )
    for feeder in names:
        made = watcher(feeder, TrialMeterErrors.WHITE)
        kernel = kernel_of(feeder, TrialMeterErrors.WHITE)
        names_ = ("cusum", "mixture", "alarm", "named")
        for pattern in PATTERNS:
            runs_ = [gaps(made, kernel, pattern, seed) for seed in range(max(1, runs // 4))]
            worst = max(one.log_m for one in runs_)
            cells = [f"{np.mean([getattr(one, name) for one in runs_]):.3f}" for name in ("covered", "step")]
            cells += [mean([getattr(one, name) for one in runs_]) for name in names_]
            row(feeder, pattern, f"{worst:.1f} < {kernel.limit:.1f}", *cells)
    head("feeder", "error, mV", "over std", "step, ms", "log M")
    for feeder in names:
        found = [honest(feeder, seed) for seed in range(max(1, runs // 4))]
        means = [
            f"{np.mean([getattr(one, name) for one in found]):.2f}" for name in ("error", "ratio", "step")
        ]
        row(feeder, *means, f"{max(one.most for one in found):.1f} < {log(3.16e7):.1f}")


if __name__ == "__main__":
    asked = arguments(__doc__, runs=20, feeders=("kerber-dorfnetz", "kerber-vorstadtnetz"))
    main(asked.runs, tuple(asked.feeders))

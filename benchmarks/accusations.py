"""Honest meters accused by the estimator `modal`: situations, feeders, learned errors or not, powers unread.

    python -m benchmarks.accusations [--runs 20] [--processes 1] [--situation NAME ...] [--seed0 0]
        [--feeder NAME] [--model NAME] [--learned yes|no] [--size S] [--trace]

Every run has 20 honest seconds and 90 seconds of a manipulation, one frame per second, AC power flow as the
truth. Situation and seed determine the run: feeder, learned errors (six hours, a tick of 300 s) or accuracy
classes alone, knowledge of the powers, and size. `matched`: registers and power factors err as the files say.
`unread`: 5 % of the customers report no power. `loads`: errors of 0.6 kW and 0.2 kvar, known as such. Filters
skip seeds and do not change the others; `--feeder` also takes a feeder that is none of the situation's, for
checks beside those. Further models take the place of all: `silent`, 30 % report no power; `late`, powers are
60 s old, and stated so, false ones as well; `clocks`, clocks are off by up to 3 s, unknown.
`stealthy`: a third within 50 or 70 % of every limit of the core for a step, by a cone program
(`gridsec.planning.unavoidable`).

Per situation: runs; runs with an honest meter accused; most honest meters accused in a run; runs with an
honest busbar meter or inverter accused; ticks CLEAN, UNDECIDED and ATTACKED after the onset, %; manipulated
meters named, %; seconds from the onset until all of a run are named, where all are; largest error over the
stated standard deviation and over the stated bound; largest error at CLEAN, V. Exits 1 when an honest meter
is accused. With `--trace` every tick of every run is printed.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from math import inf

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._adversary import LARGEST, region
from benchmarks._arguments import count
from benchmarks._scenes import (
    CLOCK_S,
    ONSET_S,
    USUAL,
    WATCHED_S,
    Model,
    Setting,
    begin,
    beyond,
    neighbours,
    phase_of,
    play,
    site,
    squared_to_shift,
    street,
)
from feeders.model.site import Site
from feeders.simulation.scenario import START
from feeders.simulation.trial import FrameTruth
from gridsec.arrays import Floats, Ints
from gridsec.attack import Attack, Coordinated, Drift, Scaling
from gridsec.attack import Bias as Shift
from gridsec.estimators.modal.monitor import ModalDesign, ModalState
from gridsec.interface import Decision, Estimate, Frame, Verdict
from gridsec.planning.unavoidable import ConeProgram, Faults

T_ON = START + ONSET_S
T_OFF = START + ONSET_S + WATCHED_S
BALANCED = ("kerber-dorfnetz", "simbench-lv-rural1", "kerber-landnetz", "simbench-lv-rural3")
SMALL = ("cigre-lv", *(f"street-6-{k}" for k in range(5)))
PHASES = ("ieee-european-lv", *(f"phases-42-{k}" for k in range(7)))
SIZES = (0.5, 0.75, 1.0, 1.5, 3.0)
AGE = 60
"""Age of the step that a stealthy manipulation is made for, ticks."""
POWERS_KW = (-8.0, -4.0, -2.0, 2.0, 4.0, 8.0, 15.0)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """The moment of the onset. p meters.

    Attributes
    ----------
    where
        The feeder.
    design, state, frame
        The monitor, its state after the honest seconds, and the last honest frame.
    random
        Random numbers of the run.
    size
        Size of the manipulation, in the unit of its situation.
    """

    where: Site
    design: ModalDesign
    state: ModalState
    frame: Frame
    random: np.random.Generator
    size: float

    @property
    def third(self) -> int:
        """A third of the meters."""
        return self.where.meters.size // 3


Manipulation = tuple[tuple[Attack, ...], tuple[Attack, ...]]
"""Attacks on meters and on the busbar's meter."""


@dataclass(frozen=True, slots=True)
class Situation:
    """One kind of manipulation.

    Attributes
    ----------
    make
        The manipulation of a run.
    feeders, sizes
        Values that runs take in turn.
    """

    make: Callable[[Stage], Manipulation]
    feeders: tuple[str, ...]
    sizes: tuple[float, ...]


def _contiguous(stage: Stage, size: int) -> Ints:
    """A connected run of meters: nearest neighbours of a random one, or part of a street."""
    where, random, p = stage.where, stage.random, stage.where.meters.size
    if random.random() < 0.5:
        return np.sort(neighbours(where, int(random.integers(p)))[:size])
    first = int(random.integers(p - size + 1))
    return np.sort(street(where)[first : first + size])


def _any(stage: Stage, size: int) -> Ints:
    return np.sort(stage.random.choice(stage.where.meters.size, size, replace=False)).astype(np.intp)


def _either(stage: Stage, size: int) -> Ints:
    """A contiguous run or random meters."""
    return _contiguous(stage, size) if stage.random.random() < 0.5 else _any(stage, size)


def _scaled(meters: Ints, percent: Floats | float) -> Manipulation:
    factor = np.broadcast_to(np.asarray(percent) / 100.0, meters.shape).astype(np.float64)
    return (Scaling(meters, T_ON, T_OFF, factor=factor),), ()


def contiguous(stage: Stage, sign: float) -> Manipulation:
    """A contiguous third reads low or high by `size` %."""
    return _scaled(_contiguous(stage, stage.third), sign * stage.size)


def scattered(stage: Stage) -> Manipulation:
    """A random third reads low, high or both by `size` %."""
    meters = _any(stage, stage.third)
    signs = stage.random.choice([-1.0, 1.0], meters.size)
    one = float(stage.random.choice([-1.0, 1.0]))
    return _scaled(meters, stage.size * (signs if stage.random.random() < 0.5 else one))


def drifting(stage: Stage) -> Manipulation:
    """A contiguous third drifts to `size` % within the watched time, all in one direction."""
    meters, sign = _contiguous(stage, stage.third), float(stage.random.choice([-1.0, 1.0]))
    limit = np.full(meters.size, stage.size / 100.0)
    return (Drift(meters, T_ON, T_OFF, rate=sign * limit / WATCHED_S, limit=limit),), ()


def false_power(stage: Stage) -> Manipulation:
    """One meter reports `size` kW too much, and a third of that in kvar where it reports them."""
    told = np.isfinite(stage.frame.p_error[stage.where.meters])
    meter = np.array([stage.random.choice(np.flatnonzero(told))], dtype=np.intp)
    kw = np.array([stage.size])
    attack = Coordinated(meter, T_ON, T_OFF, shift=np.zeros(1), p_shift=kw, q_shift=kw / 3.0)
    return (attack,), ()


def majority(stage: Stage) -> Manipulation:
    """Two thirds of the meters, a contiguous run or random ones, are off by `size` % alike."""
    return _scaled(_either(stage, 2 * stage.where.meters.size // 3), stage.size)


def stealthy(stage: Stage) -> Manipulation:
    """A random or contiguous third lies as far as the core's tests of a step allow, at `size` of each limit.

    The displacement maximises the error of the reconstruction at the meter that the prior knows least.
    """
    meters, prior = _either(stage, stage.third), stage.design.front.prior
    accepted = region(stage.design, stage.state, AGE)
    lies = Faults.voltages(meters, (prior.variance.size, prior.meters.size), LARGEST)
    least_known = prior.meters[meters[int(np.argmax(prior.variance[prior.meters[meters]]))]]
    found = ConeProgram(accepted, lies)(lies.gain(accepted.weights)[least_known], stage.size)
    lie = lies.signature @ found.amounts
    shift = squared_to_shift(stage.where, stage.frame.y, lie)[meters]
    return (Shift(meters, T_ON, T_OFF, size=shift),), ()


def busbar(stage: Stage) -> Manipulation:
    """One phase of the busbar's meter is off by `size` %."""
    phases = stage.where.feeder.busbar_phases
    which = np.array([stage.random.integers(phases)], dtype=np.intp)
    return (), (Scaling(which, T_ON, T_OFF, factor=np.array([stage.size / 100.0])),)


def lateral(stage: Stage) -> Manipulation:
    """All meters of one phase behind a bus, at most a third of all, are off by `size` %."""
    phase = phase_of(stage.where)
    sets = [one[phase[one] == k] for one in beyond(stage.where) for k in range(3)]
    some = [one for one in sets if 1 < one.size <= stage.third] or [sets[0][: stage.third]]
    # Large ones first: small laterals are many.
    largest = some[: max(3, len(some) // 4)]
    return _scaled(largest[int(stage.random.integers(len(largest)))], stage.size)


BOTH = tuple(sign * size for size in SIZES for sign in (-1.0, 1.0))
SITUATIONS = {
    "contiguous-low": Situation(partial(contiguous, sign=-1.0), BALANCED, SIZES),
    "contiguous-high": Situation(partial(contiguous, sign=1.0), BALANCED, SIZES),
    "random-third": Situation(scattered, BALANCED, SIZES),
    "drift": Situation(drifting, BALANCED, (0.5, 1.0, 1.5)),
    "false-power": Situation(false_power, (*BALANCED, "cigre-lv"), POWERS_KW),
    "majority": Situation(majority, SMALL, BOTH),
    "stealthy": Situation(stealthy, BALANCED, (0.5, 0.7)),
    "busbar-balanced": Situation(busbar, BALANCED, (-2.0, 2.0)),
    "phases-busbar": Situation(busbar, PHASES, (-2.0, 2.0)),
    "phases-lateral": Situation(lateral, PHASES, (-1.0, 1.0)),
    "phases-contiguous": Situation(partial(contiguous, sign=-1.0), PHASES, SIZES),
}


@cache
def cells(
    name: str, feeder: str | None = None, model: Model | None = None
) -> tuple[tuple[str, Model, bool, float], ...]:
    """Feeder, model, learned and size of the runs of a situation, in a fixed mixed order.

    A feeder that is none of the situation's takes the place of all of them, and so does a model.
    """
    one = SITUATIONS[name]
    feeders = one.feeders if feeder is None or feeder in one.feeders else (feeder,)
    models = USUAL if model is None or model in USUAL else (model,)
    every = list(itertools.product(feeders, models, (False, True), one.sizes))
    order = np.random.default_rng(len(every)).permutation(len(every))
    return tuple(every[k] for k in order)


def cell(
    name: str, seed: int, feeder: str | None = None, model: Model | None = None
) -> tuple[Setting, float]:
    """Setting and size of one run; feeder and model as in `cells`."""
    every = cells(name, feeder, model)
    where, known, learned, size = every[seed % len(every)]
    return Setting(where, known, learned, seed), size


@dataclass(slots=True, eq=False)
class Run:
    """One run. Errors are largest ones over customers and ticks.

    Attributes
    ----------
    decisions
        Ticks after the onset, by decision.
    accused, manipulated, named
        Ids of honest meters ever named, manipulated meters, and those of them that were named.
    others
        Ticks with an honest busbar meter or an honest inverter named.
    settled
        Time from the onset until all manipulated meters have been named, s; infinite where one is not.
    ratio, bound, volt, clean_volt, lie_volt
        Error over standard deviation, over bound; error, error at CLEAN, and lie, V.
    trace
        Lines for each tick, where asked for.
    """

    situation: str
    seed: int
    cell: str
    decisions: dict[Decision, int] = field(default_factory=lambda: dict.fromkeys(Decision, 0))
    accused: tuple[str, ...] = ()
    manipulated: tuple[str, ...] = ()
    named: tuple[str, ...] = ()
    others: int = 0
    settled: float = inf
    ratio: float = 0.0
    bound: float = 0.0
    volt: float = 0.0
    clean_volt: float = 0.0
    lie_volt: float = 0.0
    seconds: float = 0.0
    trace: list[str] = field(default_factory=list)


def run(
    name: str,
    seed: int,
    *,
    trace: bool = False,
    feeder: str | None = None,
    model: Model | None = None,
) -> Run:
    """Play and watch one run.

    Parameters
    ----------
    name, seed
        Situation and seed.
    trace
        Whether to keep a line for every tick.
    feeder, model
        As in `cells`.
    """
    begun = time.perf_counter()
    setting, size = cell(name, seed, feeder, model)
    where = site(setting.feeder)
    known = "learned" if setting.learned else "classes"
    out = Run(name, seed, f"{setting.feeder} {setting.model} {known} {size:g}")
    made, state = begin(setting)
    frame = None
    p = where.meters.size
    manipulated, named = np.zeros((2, p), dtype=np.bool_)
    # Clocks that are off show a manipulation before and after its onset.
    early = CLOCK_S if setting.model is Model.CLOCKS else 0
    for frame, _ in play(setting, ONSET_S - early):
        state, _, verdict = made.step(state, frame)
        named |= verdict.suspects
    assert frame is not None
    random = np.random.default_rng([seed, sum(map(ord, name))])
    attacks, off = SITUATIONS[name].make(Stage(where, made.design, state, frame, random, size))
    for frame, truth in play(setting, ONSET_S + WATCHED_S, attacks=attacks, busbar=off):
        if frame.t < T_ON - early:
            continue
        state, estimate, verdict = made.step(state, frame)
        manipulated |= truth.liars
        named |= verdict.suspects
        if frame.t < T_ON:
            continue
        if out.settled == inf and (named >= manipulated).all():
            out.settled = frame.t - T_ON
        _tick(out, where, estimate, verdict, truth, honest_busbar=not off)
        if trace:
            out.trace.append(_line(where, frame, estimate, verdict, truth))
    accused, named = named & ~manipulated, named & manipulated
    ids = np.array(where.meter_ids)
    out.accused, out.manipulated, out.named = (tuple(ids[w].tolist()) for w in (accused, manipulated, named))
    out.seconds = time.perf_counter() - begun
    return out


def _tick(
    out: Run, where: Site, estimate: Estimate, verdict: Verdict, truth: FrameTruth, *, honest_busbar: bool
) -> None:
    error = np.abs(estimate.v2 - truth.v2)
    out.decisions[verdict.decision] += 1
    volt = _volts(where, estimate, truth)
    out.volt = max(out.volt, volt)
    if verdict.decision is Decision.CLEAN:
        out.clean_volt = max(out.clean_volt, volt)
    out.ratio = max(out.ratio, float((error / estimate.std).max()))
    out.bound = max(out.bound, float((error / estimate.bound).max()))
    lie = np.sqrt(np.maximum(truth.v2[where.meters] + truth.attack, 0.0)) - np.sqrt(truth.v2[where.meters])
    out.lie_volt = max(out.lie_volt, float((np.abs(lie) * where.customer_volt[where.meters]).max()))
    out.others += bool(verdict.inverters.any() or (honest_busbar and verdict.busbar.any()))


def _volts(where: Site, estimate: Estimate, truth: FrameTruth) -> float:
    apart = np.sqrt(np.maximum(estimate.v2, 0.0)) - np.sqrt(truth.v2)
    return float((where.customer_volt * np.abs(apart)).max())


def _line(where: Site, frame: Frame, estimate: Estimate, verdict: Verdict, truth: FrameTruth) -> str:
    """One tick: seconds since the onset, decision, error in V and in std, names; honest ones with "!"."""
    ids, liars = where.meter_ids, truth.liars
    named = [f"{'' if liars[j] else '!'}{ids[j]}" for j in np.flatnonzero(verdict.suspects)]
    ratio = float((np.abs(estimate.v2 - truth.v2) / estimate.std).max())
    head = (
        f"{frame.t - T_ON:4.0f} s {verdict.decision:9} {_volts(where, estimate, truth):6.2f} V {ratio:5.1f}"
    )
    phases = f" busbar {np.flatnonzero(verdict.busbar).tolist()}" if verdict.busbar.any() else ""
    wrong = f" inverters {np.flatnonzero(verdict.inverters).tolist()}" if verdict.inverters.any() else ""
    return f"{head}{phases}{wrong} named {' '.join(named) or '-'} | {verdict.reason}"


def table(runs: list[Run]) -> str:
    """One line of the table."""
    bad, ticks = sum(bool(one.accused) for one in runs), sum(sum(one.decisions.values()) for one in runs)
    share = [100.0 * sum(one.decisions[each] for one in runs) / ticks for each in Decision]
    liars = sum(len(one.manipulated) for one in runs)
    named = f"{100.0 * sum(len(one.named) for one in runs) / liars:.0f}" if liars else ""
    most = max(len(one.accused) for one in runs)
    by = dict(zip(Decision, share, strict=True))
    shares = " | ".join(f"{by[k]:.1f}" for k in (Decision.CLEAN, Decision.UNDECIDED, Decision.ATTACKED))
    worst = [max(getattr(one, name) for one in runs) for name in ("ratio", "bound", "clean_volt")]
    seconds = float(np.mean([one.seconds for one in runs]))
    cells_ = [runs[0].situation, len(runs), bad, most, sum(bool(one.others) for one in runs), shares, named]
    settled = max(one.settled for one in runs)
    cells_ += [f"{settled:.0f}" if settled < inf else "-"]
    cells_ += [f"{worst[0]:.1f}", f"{worst[1]:.2f}", f"{worst[2]:.2f}", f"{seconds:.2f}"]
    return f"| {' | '.join(map(str, cells_))} |"


def seeds(name: str, asked: argparse.Namespace) -> Iterator[int]:
    """Seeds of the runs that pass the filters."""
    model = None if asked.model is None else Model(asked.model)
    every = range(asked.seed0, asked.seed0 + asked.runs * len(cells(name, asked.feeder, model)))
    passing = (seed for seed in every if _passes(*cell(name, seed, asked.feeder, model), asked))
    return itertools.islice(passing, asked.runs)


def _passes(setting: Setting, size: float, asked: argparse.Namespace) -> bool:
    return (
        asked.size in (None, size)
        and asked.feeder in (None, setting.feeder)
        and asked.model in (None, setting.model)
        and asked.learned in (None, "yes" if setting.learned else "no")
    )


def main(asked: argparse.Namespace) -> int:
    """Print the table and the runs with an honest meter accused; 1 if there is one."""
    print(
        "| situation | runs | accusing runs | most accused | busbar, inverter | clean % | undecided % |",
        end="",
    )
    print(" attacked % | named % | all after s | error / std | error / bound | V at clean | s per run |")
    print("|" + "---|" * 14, flush=True)
    failed: list[Run] = []
    names = asked.situation or list(SITUATIONS)
    model = None if asked.model is None else Model(asked.model)
    watched = partial(run, trace=asked.trace, feeder=asked.feeder, model=model)
    with ProcessPoolExecutor(asked.processes) as pool:
        go = pool.map if asked.processes > 1 else map
        for name in names:
            chosen = list(seeds(name, asked))
            runs = list(go(partial(watched, name), chosen))
            if not runs:
                print(f"| {name} | 0 |" + " |" * 12)
                continue
            print(table(runs), flush=True)
            wrong = [one for one in runs if one.accused]
            failed += wrong
            for one in wrong:  # apart from the table, and before the next situation
                told = f"{len(one.accused)} honest: {' '.join(one.accused)}"
                head = f"{one.situation} seed {one.seed} ({one.cell}; lie {one.lie_volt:.1f} V)"
                print(f"{head}: {told}", file=sys.stderr, flush=True)
            for one in runs if asked.trace else ():
                print(f"{name} seed {one.seed}: {one.cell}; manipulated {' '.join(one.manipulated) or '-'}")
                print("\n".join(one.trace))
    return int(bool(failed))


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw, allow_abbrev=False)
    parser.add_argument("--runs", type=count, default=20)
    parser.add_argument("--processes", type=count, default=1)
    parser.add_argument("--situation", action="append", choices=list(SITUATIONS))
    parser.add_argument("--seed0", type=int, default=0)
    parser.add_argument("--feeder")
    parser.add_argument("--model", choices=[str(each) for each in Model])
    parser.add_argument("--learned", choices=["yes", "no"])
    parser.add_argument("--size", type=float)
    parser.add_argument("--trace", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main(_parser().parse_args()))

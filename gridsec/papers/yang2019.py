"""Example 1 of yang2019: observers for every set of sensors, detection and isolation over windows.

The paper's figures are not numbers; what it states in words is compared in `reproduce`. The gains of its
observers are not printed either: ours are the ones with the smallest proven noise gain.

References
----------
yang2019, Example 1, equations (25), (26), Figures 1 to 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np

from gridsec import windows
from gridsec.arrays import Bools, Floats
from gridsec.lmi.discrete import discrete_circles, discrete_options, discrete_prove
from gridsec.lmi.discrete_bounds import DiscreteGains
from gridsec.lmi.sampled import DiscreteLure
from gridsec.observers import circle_discrete
from gridsec.observers.circle_discrete import DiscreteDesign
from gridsec.papers import sampled_feeder
from gridsec.papers.claims import Claim, Figure, Line, Panel, Reproduction, number, statement
from gridsec.windows import Rule, WindowDesign

DECAYS = (0.6, 0.8, 0.9, 0.95, 0.995)
"""Candidates for the observers' decay per step; sensor 4 alone needs the last one."""
LENGTHS = (50, 100, 200)
STEPS = 1000
HALF_WIDTH = 0.5
NOISE = 1.0
"""Largest Euclidean norm of four sensors' noise of at most 0.5 each."""
RUNS = 500
DETECTION = (0.7, 1.0)
ISOLATION = (2.0, 5.0)


def system() -> DiscreteLure:
    """The plant (25), (26) with delta = 0.1, alpha = 1; the sine's slopes lie in [-1, 1]."""
    delta, alpha = 0.1, 1.0
    return DiscreteLure(
        A=np.array([[1.0, delta], [0.0, 1.0]]),
        G=delta * alpha * np.array([[0.5], [1.0]]),
        H=np.ones((1, 2)),
        F=np.zeros((1, 1)),
        B=np.full((2, 1), delta),
        C=np.array([[3.0, 0.3], [3.0, 0.6], [6.0, 0.9], [1.2, 12.0]]),
        D=np.zeros((4, 1)),
        lower=-np.ones(1),
        upper=np.ones(1),
        phi=np.sin,
        h=delta,
    )


def every_observer() -> tuple[DiscreteGains, ...]:
    """A circle-criterion observer for each of the 15 non-empty sets of sensors, largest sets first."""
    sets = [J for size in (4, 3, 2, 1) for J in combinations(range(4), size)]
    return discrete_circles(system(), sets, discrete_options(system(), decays=DECAYS, noise=1.0))


@cache
def bank(decays: tuple[float, ...] = DECAYS) -> tuple[DiscreteDesign, ...]:
    """The eleven observers for one attacked sensor: of all four, of three and of two sensors.

    Parameters
    ----------
    decays
        Candidates for the decay.
    """
    plant = system()
    return windows.bank(plant, 1, options=discrete_options(plant, decays=decays, noise=1.0))


def simulated_gains(
    observers: Sequence[DiscreteDesign], *, runs: int, seed: int
) -> circle_discrete.MonteCarlo:
    """Gains by simulation, as the paper obtains them: normal initial states, uniform noise, u = 0.

    Parameters
    ----------
    observers
        The bank.
    runs, seed
        Number of runs of 1000 steps, and where the random numbers begin.
    """
    start = np.random.default_rng(seed).standard_normal((runs, 2))
    return circle_discrete.monte_carlo(
        circle_discrete.stack(observers), half_width=HALF_WIDTH, start=start, u=_still(), seed=seed + 1
    )


def _still() -> Floats:
    """The input; the paper leaves it open, and it cancels in the linear part of every error."""
    return np.zeros((STEPS, 1))


def trial(design: WindowDesign, *, sensor: int | None, size: float, runs: int, seed: int) -> windows.Trace:
    """Runs of 1000 steps: uniform noise, one sensor attacked by uniform values in plus and minus `size`.

    Parameters
    ----------
    design
        The bank.
    sensor
        Which one, from 0; None: nobody.
    size
        Size of the attack.
    runs, seed
        How many, and where the random numbers begin.
    """
    rng = np.random.default_rng(seed)
    start = rng.standard_normal((runs, 2))
    disturbance = rng.uniform(-HALF_WIDTH, HALF_WIDTH, (runs, STEPS, 4))
    if sensor is not None:
        disturbance[..., sensor] += rng.uniform(-size, size, (runs, STEPS))
    return windows.simulate(design, start, _still(), disturbance)


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """The three kinds of thresholds, for one bank.

    Attributes
    ----------
    proven
        (10) and (19) with the gains from the inequality: bounds.
    simulated
        (10) and (19) with simulated gains, as in the paper.
    calibrated
        The largest pi and pi_J of simulated honest runs.
    exceedance
        Probability with which, at 99 % confidence, one more honest run of this kind exceeds a given
        simulated gain or calibrated threshold.
    """

    proven: WindowDesign
    simulated: WindowDesign
    calibrated: WindowDesign
    exceedance: float


@cache
def levels(decays: tuple[float, ...] = DECAYS, runs: int = RUNS) -> Levels:
    """Thresholds for Example 1.

    Parameters
    ----------
    decays
        Candidates for the observers' decay.
    runs
        Simulated runs.
    """
    observers = bank(decays)
    proven = windows.design(observers, 1, noise=NOISE, length=LENGTHS[0])
    found = simulated_gains(observers, runs=runs, seed=2019)
    simulated = windows.design(observers, 1, noise=NOISE, length=LENGTHS[0], gains=found.gains)
    honest = trial(proven, sensor=None, size=0.0, runs=runs, seed=1)
    return Levels(proven, simulated, windows.calibrate(proven, honest), found.exceedance)


def large_sets(design: WindowDesign) -> Bools:
    """Masks (s, p) of the sets of p - q sensors, in the order of pi_J.

    Parameters
    ----------
    design
        The bank.
    """
    return design.observers.masks[1 : 1 + design.sets.count_large]


def detection_rates(design: WindowDesign, trace: windows.Trace) -> Floats:
    """Part of the windows that Algorithm 1 finds attacked, for N = 50, 100, 200.

    Parameters
    ----------
    design
        Thresholds.
    trace
        Simulated runs.
    """
    return np.array([windows.detection(trace.pi, design.detect_above, N).mean() for N in LENGTHS])


def isolation_rates(design: WindowDesign, trace: windows.Trace, sensor: int, rule: Rule) -> Floats:
    """Part of the windows that name exactly the attacked sensor, for N = 50, 100, 200.

    Parameters
    ----------
    design
        Thresholds.
    trace
        Simulated runs.
    sensor
        The attacked sensor, from 0.
    rule
        "majority" (Algorithm 2) or "survivors".
    """
    exact, rates = np.arange(4) == sensor, []
    for N in LENGTHS:
        found = windows.isolation(trace.pi_sets, design.isolate_above, large_sets(design), N, rule)
        rates.append((found.suspects == exact).all(axis=-1).mean())
    return np.array(rates)


def figure_detection(index: int) -> Figure:
    """Data of Figure 1 or 2: detection(i) of one run, for the three window lengths.

    Parameters
    ----------
    index
        1 or 2.
    """
    size, at = DETECTION[index - 1], levels()
    trace = trial(at.proven, sensor=1, size=size, runs=1, seed=10 + index)
    panels = []
    for N in LENGTHS:
        lines = []
        for label, design in (("(10), simulated gains", at.simulated), ("calibrated", at.calibrated)):
            found = windows.detection(trace.pi[0], design.detect_above, N).astype(np.float64)
            lines.append(Line(label, np.arange(1.0, found.size + 1), found, "points"))
        panels.append(Panel(f"N = {N}", "window i", "detection(i)", tuple(lines)))
    caption = (
        f"Attack detection, a_2 uniform in ±{size:g}: whether each window of 1000 steps is found attacked."
    )
    return Figure(f"yang2019-figure-{index}", caption, tuple(panels))


def figure_isolation(index: int) -> Figure:
    """Data of Figure 3 or 4: the sensors named in each window of one run (0: none).

    Parameters
    ----------
    index
        3 or 4.
    """
    size, at = ISOLATION[index - 3], levels()
    trace = trial(at.proven, sensor=2, size=size, runs=1, seed=10 + index)
    kinds: tuple[tuple[str, WindowDesign, Rule], ...] = (
        ("Algorithm 2, (19), simulated gains", at.simulated, "majority"),
        ("Algorithm 2, calibrated", at.calibrated, "majority"),
        ("survivors, calibrated", at.calibrated, "survivors"),
    )
    panels = []
    for N in LENGTHS:
        lines = []
        for label, design, rule in kinds:
            found = windows.isolation(trace.pi_sets[0], design.isolate_above, large_sets(design), N, rule)
            x, y = sampled_feeder.points(found.suspects)
            lines.append(Line(label, x, y, "points"))
        panels.append(Panel(f"N = {N}", "window i", "sensor named", tuple(lines)))
    caption = f"Attack isolation, a_3 uniform in ±{size:g}: sensors named in each window of 1000 steps."
    return Figure(f"yang2019-figure-{index}", caption, tuple(panels))


def deadbeat_bank() -> tuple[DiscreteDesign, ...]:
    """A bank for x+ = x / 2, five sensors y_i = x, two of them attacked: every observer forgets in a step.

    `L_J` has the entries `1 / (2 |J|)`, so that `e_J(k+1) = -sum over J of (n_i + a_i) / (2 |J|)`.
    """
    plant = DiscreteLure(
        A=np.array([[0.5]]),
        G=np.zeros((1, 1)),
        H=np.zeros((1, 1)),
        F=np.zeros((1, 1)),
        B=np.zeros((1, 1)),
        C=np.ones((5, 1)),
        D=np.zeros((5, 1)),
        lower=np.zeros(1),
        upper=np.zeros(1),
        phi=np.zeros_like,
    )
    options = discrete_options(plant, decays=0.01, noise=1.0)
    made = []
    for mask in windows.bank_masks(5, 2):
        J = np.flatnonzero(mask)
        L = np.full((1, len(J)), 0.5 / len(J))
        proof = discrete_prove(plant, J, L, np.zeros((1, len(J))), options)
        made.append(circle_discrete.design(plant, mask, gains=proof))
    return tuple(made)


def alternating_attack() -> tuple[WindowDesign, windows.Trace]:
    """Counterexample to Proposition 4: two attackers who take turns, one window of 100 steps.

    Every attacked set of three sensors exceeds its threshold in at least half of the steps, as (23)
    asks, but never all of them at once. Neither attack is ever zero.
    """
    design = windows.design(deadbeat_bank(), 2, noise=0.1, length=100)
    attack = np.zeros((101, 5))
    attack[:50, 0], attack[50:, 0] = 40.0, 1e-3
    attack[:50, 1], attack[50:, 1] = 1e-3, 40.0
    return design, windows.simulate(design, np.ones(1), np.zeros((101, 1)), attack)


def reproduce() -> Reproduction:
    """Everything that the paper's example states, beside ours."""
    at = levels()
    made, bank_size = every_observer(), at.proven.observers.masks.sum(axis=1)
    detect = [trial(at.proven, sensor=1, size=c, runs=60, seed=30 + i) for i, c in enumerate(DETECTION)]
    isolate = [trial(at.proven, sensor=2, size=d, runs=60, seed=40 + i) for i, d in enumerate(ISOLATION)]
    claims = [
        number(
            "non-empty sets of sensors with a circle-criterion observer", "Example 1", 15, len(made), unit=1
        ),
        number("observers in total", "Example 1", 11, bank_size.size, unit=1),
        number("observers of Algorithm 1", "Example 1", 5, int((bank_size >= 3).sum()), unit=1),
        number("observers of Algorithm 2", "Example 1", 10, int((bank_size <= 3).sum()), unit=1),
        _no_false_alarm(at),
        *(_grows(at, trace, size) for trace, size in zip(detect, DETECTION, strict=True)),
        *(_larger_is_easier(at, detect, isolate)),
        _remark_2(),
        _proposition_4(),
    ]
    figures = (
        figure_detection(1),
        figure_detection(2),
        figure_isolation(3),
        figure_isolation(4),
        _figure_rates(at, detect, isolate),
        sampled_feeder.figure(),
    )
    return Reproduction("yang2019", tuple(claims), figures)


def _no_false_alarm(at: Levels) -> Claim:
    honest = trial(at.proven, sensor=None, size=0.0, runs=60, seed=50)
    fired = int(np.count_nonzero(honest.pi > at.proven.detect_above))
    return number("steps with pi above (10) in 60 000 honest ones", "(9)", 0, fired, unit=1)


def _grows(at: Levels, trace: windows.Trace, size: float) -> Claim:
    rates = detection_rates(at.calibrated, trace)
    ours = "improves" if bool(np.all(np.diff(rates) > 0.0)) else "does not improve"
    shown = ", ".join(f"{rate:.2f}" for rate in rates)
    what = f"detection with longer windows, a_2 in ±{size:g} (rates {shown} for N = 50, 100, 200)"
    return statement(what, "Conclusion", "improves", ours)


def _larger_is_easier(
    at: Levels, detect: list[windows.Trace], isolate: list[windows.Trace]
) -> tuple[Claim, Claim]:
    found = [detection_rates(at.calibrated, trace) for trace in detect]
    named = [isolation_rates(at.calibrated, trace, 2, "majority") for trace in isolate]
    both = [bool(np.all(large > small)) for small, large in (found, named)]
    texts = ["easier" if yes else "not easier" for yes in both]
    return (
        statement("detecting the larger attack", "Figures 1, 2", "easier", texts[0]),
        statement("isolating the larger attack", "Figures 3, 4", "easier", texts[1]),
    )


def fast_levels() -> Levels:
    """Thresholds for observers with decay 0.6 throughout: faster and noisier than need be."""
    return levels((0.6,), 100)


def _remark_2() -> Claim:
    """Longer windows make Algorithm 2 worse where most steps believe everybody."""
    at = fast_levels()
    rates = isolation_rates(
        at.calibrated, trial(at.proven, sensor=2, size=5.0, runs=60, seed=60), 2, "majority"
    )
    shown = ", ".join(f"{rate:.2f}" for rate in rates)
    ours = "improves" if bool(np.all(np.diff(rates) >= 0.0)) else "gets worse"
    what = f"isolation with longer windows, decay 0.6, a_3 in ±5 (rates {shown} for N = 50, 100, 200)"
    why = "the vote goes to the set seen most often, and that may be the wrong one: docs/errata/yang2019.md"
    return replace(statement(what, "Remark 2 (erratum)", "improves", ours), why=why)


def _proposition_4() -> Claim:
    design, trace = alternating_attack()
    found = windows.isolation(
        trace.pi_sets[1:], design.isolate_above, large_sets(design), design.length, "majority"
    )
    named = ", ".join(str(i + 1) for i in np.flatnonzero(found.suspects[0]))
    what = "sensors isolated when every attacked set fails in half of the window, attackers 1 and 2 in turns"
    why = "the sets must fail at the same steps, and in more than half of them: docs/errata/yang2019.md"
    return replace(statement(what, "Proposition 4 (erratum)", "1, 2", named), why=why)


def _figure_rates(at: Levels, detect: list[windows.Trace], isolate: list[windows.Trace]) -> Figure:
    """What the four figures show for one run, as rates over many."""
    N = np.array(LENGTHS, dtype=np.float64)
    first = [
        Line(f"a_2 in ±{size:g}, {label}", N, detection_rates(design, trace))
        for trace, size in zip(detect, DETECTION, strict=True)
        for label, design in (("(10), simulated gains", at.simulated), ("calibrated", at.calibrated))
    ]
    rules: tuple[Rule, ...] = ("majority", "survivors")
    second = [
        Line(f"a_3 in ±{size:g}, {rule}", N, isolation_rates(at.calibrated, trace, 2, rule))
        for trace, size in zip(isolate, ISOLATION, strict=True)
        for rule in rules
    ]
    panels = (
        Panel("Detection", "window length N", "part of windows found attacked", tuple(first)),
        Panel(
            "Isolation, calibrated", "window length N", "part of windows naming sensor 3 alone", tuple(second)
        ),
    )
    return Figure("yang2019-rates", "Detection and isolation rates over 60 runs of 1000 steps.", panels)

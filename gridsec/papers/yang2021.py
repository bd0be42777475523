"""yang2021, Examples 1 to 4: existence of the observers, Figures 1 to 12, as printed and corrected.

As printed, neither bank is complete: Assumptions 2 and 3 do not hold, and Theorems 1 and 2 do not cover the
examples. The figures are reproduced nevertheless, because their attacks spare the missing members. The
corrections are the smallest that make every member exist: fewest entries of C, then least change
(docs/errata/yang2021.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import comb

import numpy as np

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
from gridsec.observers.lmi.sampled import DiscreteLure, advance
from gridsec.observers.unknown_input import Missing, UnknownInputPlant, exact, obstruction, pairs_text
from gridsec.papers import yang2021_feeder
from gridsec.papers.claims import Claim, FigureCurve, Panel, PaperFigure, Reproduction, number, statement
from gridsec.secure.isolation import IsolationDesign, IsolationStep, design, init, members, step, support

TOLERANCE = 1e-3
"""Tolerance of zero in (46), (47) after the steps of the figures."""
STEPS = 20
"""k = 0 … 19, "19 time-steps"."""
CORRECTION_1 = (1, 1, 2.0)
"""Example 1: sensor 2 reads `x_1 + 2 x_2` in place of `x_1 + x_2`, the reading of sensor 1."""
CORRECTION_2 = (1, 2, 0.4)
"""Example 2: sensor 2 reads `x_1 + x_2 + 0.4 x_3` in place of `x_1 + x_2 + x_3`."""


def plant(example: int, *, corrected: bool = False) -> UnknownInputPlant:
    """The plants (37) and (38).

    example: 1 (also of Example 3) or 2 (also of Example 4).
    corrected: change the one entry of C that makes all members of the bank exist.
    Raises ValueError if `example` is not 1 or 2.
    """
    if example == 1:
        A, B = np.array([[0.2, 0.5], [0.2, 0.7]]), np.eye(2)
        C = np.array([[1.0, 1.0, 3.0, 4.0], [1.0, 1.0, 2.0, 1.0]]).T
    elif example == 2:
        A = np.array([[0.5, 0.0, 0.1], [0.2, 0.7, 0.0], [1.0, 0.0, 0.3]])
        B = np.array([[1.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
        C = np.array([[1.0, 1.0, 3.0, 4.0], [3.0, 1.0, 2.0, 1.0], [1.0, 1.0, 1.0, 1.0]]).T
    else:
        raise InputInvalid.of("out-of-range", f"example {example}: only 1 and 2 have plants")
    if corrected:
        row, column, value = CORRECTION_1 if example == 1 else CORRECTION_2
        C = C.copy()
        C[row, column] = value
    one = np.eye(len(A))
    system = DiscreteLure.of(
        A, C, G=one, H=one, B=B, phi=lambda z: np.asarray(0.5 * np.sin(z)), lower=-0.5, upper=0.5
    )
    return exact(system, B)


@lru_cache(maxsize=4)
def bank(example: int, *, corrected: bool = False) -> IsolationDesign:
    """The bank of an example: complete with q = 1, or partial with q_1 = q_2 = 1."""
    max_inputs = 2 if example == 1 else 1
    made = plant(example, corrected=corrected)
    return design(made, max_inputs=max_inputs, max_sensors=1, measure="distance")


def missing_complete() -> tuple[Missing, ...]:
    """Example 2: the complete observers of two sensors that cannot exist."""
    made = plant(2)
    found = (obstruction(made, pair, tolerance=1e-9) for pair in members(3, 4, 3, 1)[1])
    return tuple(one for one in found if one is not None)


@dataclass(frozen=True, slots=True, eq=False)
class Yang2021Run:
    """One simulation. T steps, n states, r inputs, p sensors."""

    x: Floats  # (T, n) state
    x_hat: Floats  # (T, n) estimate
    a_u: Floats  # (T, r) attack on the inputs
    a_u_hat: Floats  # (T, r) (42) of the next step; NaN at the last step
    a_y: Floats  # (T, p) attack on the sensors
    a_y_hat: Floats  # (T, p) (43)
    bound: Floats  # (T, n) bound of the estimate's error; proven only where no member is missing
    answers: tuple[IsolationStep, ...]  # results of the bank

    def named(self, last: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Inputs and sensors (from 1) with a reconstructed attack above `TOLERANCE` in the `last` steps."""
        inputs = support(self.a_u_hat[-last - 1 : -1], TOLERANCE).any(axis=0)
        sensors = support(self.a_y_hat[-last:], TOLERANCE).any(axis=0)
        return tuple(int(i) + 1 for i in np.flatnonzero(inputs)), tuple(
            int(j) + 1 for j in np.flatnonzero(sensors)
        )


def simulate(
    example: int,
    amplitude: float,
    *,
    corrected: bool = False,
    inputs: tuple[int, ...] | None = None,
    sensors: tuple[int, ...] = (1,),
    steps: int = STEPS,
    seed: int = 2021,
) -> Yang2021Run:
    """Run an example: known inputs and attacks uniform and white, `x(0)` standard normal.

    example, corrected: as in `plant`.
    amplitude: attacks are uniform in (-amplitude, amplitude).
    inputs, sensors: attacked inputs and sensors, from 0. By default both inputs (Example 1) or the third
        (Example 4's text).
    seed: seed of the random numbers; the paper does not state its own.
    """
    made = bank(example, corrected=corrected)
    model = made.family.plant
    n, r, p = len(model.system.A), model.inputs.shape[1], len(model.system.C)
    rng = np.random.default_rng(seed)
    x, state = rng.standard_normal(n), init(made, 0.0, radius=np.full(n, 6.0))
    lie_u, lie_y = np.zeros(r), np.zeros(p)
    lie_u[list(inputs if inputs is not None else ((0, 1) if example == 1 else (2,)))] = amplitude
    lie_y[list(sensors)] = amplitude
    u = rng.uniform(-5.0, 5.0, (steps, r))
    a_u, a_y = lie_u * rng.uniform(-1.0, 1.0, (steps, r)), lie_y * rng.uniform(-1.0, 1.0, (steps, p))
    truth, answers = np.empty((steps, n)), []
    for k in range(steps):
        truth[k] = x
        state, answer = step(made, state, model.system.C @ x + a_y[k], u[k], np.ones(p, dtype=np.bool_))
        answers.append(answer)
        x = advance(model.system, x, u[k]) + model.inputs @ a_u[k]
    late = np.array([answer.input_attack for answer in answers])
    return Yang2021Run(
        x=truth,
        x_hat=np.array([answer.x for answer in answers]),
        a_u=a_u,
        a_u_hat=np.vstack([late[1:], np.full((1, r), np.nan)]),
        a_y=a_y,
        a_y_hat=np.array([answer.sensor_attack for answer in answers]),
        bound=np.array([answer.bound for answer in answers]),
        answers=tuple(answers),
    )


@dataclass(frozen=True, slots=True, eq=False)
class IndistinguishableHistories:
    """Two histories with the same readings, each with no more attacks than assumed. T steps."""

    y: Floats  # (T, p) reports of the sensors in both
    u: Floats  # (T, r) known input of both
    x: Floats  # (2, T, n) the two states
    # inputs and sensors attacked in each, from 0
    attacked: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]


def doubt(example: int, size: float, steps: int = STEPS) -> IndistinguishableHistories:
    """Two indistinguishable histories of a printed example, with q = 1 or q_1 = q_2 = 1.

    Example 1: sensors 1 and 2 read the same, so that states that differ along (1, -1) differ in sensors 3 and
    4 only. In one history sensor 3 is attacked, in the other sensor 4; both inputs are attacked in either.
    Example 2: `b_1 - b_2` moves neither sensor 1 nor sensor 2. Input 1 and sensor 3 are attacked in one
    history, input 2 and sensor 4 in the other, and the states differ by `size (b_1 - b_2)` at the end.

    example: 1 or 2, as printed.
    size: distance of the states, in multiples of (1, -1) or b_1 - b_2.
    steps: length of the histories.
    """
    model = plant(example)
    n, r = len(model.system.A), model.inputs.shape[1]
    u = np.zeros((steps, r))
    x = np.zeros((2, steps, n))
    if example == 1:
        x[1] = size * np.array([1.0, -1.0])
        attacked: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = (((0, 1), (2,)), ((0, 1), (3,)))
    else:
        # One history attacks input 1 by size, the other input 2, one step before the end.
        x[0, -1], x[1, -1] = size * model.inputs[:, 0], size * model.inputs[:, 1]
        attacked = (((0,), (2,)), ((1,), (3,)))
    honest = x @ model.system.C.T
    # Sensor 3 reports its reading of the second history, sensor 4 that of the first.
    y = honest[0].copy()
    y[:, 2] = honest[1][:, 2]
    return IndistinguishableHistories(y, u, x, attacked)


def reproduce() -> Reproduction:
    """Existence of all members, convergence, reconstruction and isolation; Figures 1 to 12; a feeder."""
    claims = [*_existence_claims(), *_simulation_claims()]
    figures = []
    for amplitude, numbers in ((1.0, (1, 3, 5, 6, 9, 10)), (10.0, (2, 4, 7, 8, 11, 12))):
        figures += _figures(amplitude, numbers)
    figures.sort(key=lambda figure: int(figure.name.rsplit("-", 1)[1]))
    return Reproduction("yang2021", tuple(claims), (*figures, yang2021_feeder.figure()))


def _existence_claims() -> list[Claim]:
    one, two = bank(1), bank(2)
    rank = pairs_text([m.pair for m in two.missing if m.reason == "rank"])
    zero = pairs_text([m.pair for m in two.missing if m.reason == "zero"])
    why_one = f"no complete observer for {pairs_text([m.pair for m in one.missing])}: C_J B has rank 1"
    why_two = f"rank 1 for {rank}; a zero outside the unit circle for {zero}"
    count = comb(4, 3) + comb(4, 2)
    return [
        number("complete observers of the bank", "Example 1", 10.0, float(count), unit=1.0),
        replace(number("… that exist", "Example 1", 10.0, _existing(one), unit=1.0), why=why_one),
        statement(
            "… with sensor 2 reading x_1 + 2 x_2",
            "Example 1",
            "10 exist",
            f"{_existing(bank(1, corrected=True)):.0f} exist",
        ),
        number(
            "complete observers of two sensors", "Example 2", 0.0, 6.0 - len(missing_complete()), unit=1.0
        ),
        replace(
            number("partial observers that exist", "Example 2", 30.0, _existing(two), unit=1.0), why=why_two
        ),
        statement(
            "… with sensor 2 reading x_1 + x_2 + 0.4 x_3",
            "Example 2",
            "30 exist",
            f"{_existing(bank(2, corrected=True)):.0f} exist",
        ),
    ]


def _existing(made: IsolationDesign) -> float:
    return float(len(made.family.pairs))


def _simulation_claims() -> list[Claim]:
    out = []
    for example, place, expected in ((1, "3", ((1, 2), (2,))), (2, "4", ((3,), (2,)))):
        for corrected in (False, True):
            how = "corrected" if corrected else "as printed"
            for amplitude in (1.0, 10.0):
                run = simulate(example, amplitude, corrected=corrected)
                error = float(np.max(np.abs(run.x_hat[-1] - run.x[-1])))
                what = f"estimate converges, attacks in ±{amplitude:g}, {how}"
                out.append(
                    Claim(what, f"Example {example}", "yes", f"error {error:.1e} at k = 19", error < 1e-6)
                )
                found = run.named(5)
                what = f"(inputs, sensors) named, attacks in ±{amplitude:g}, {how}"
                out.append(statement(what, f"Example {place}", str(expected), str(found)))
    worst = doubt_error(1)
    why = (
        "attacks on sensors 3 and 4 cannot be told apart while 1 and 2 read the same: docs/errata/yang2021.md"
    )
    claim = Claim(
        "attack on any one sensor", "Example 1, q = 1", "error -> 0", f"error {worst:.3g}", worst < 1e-6
    )
    out.append(replace(claim, why=why))
    worst = doubt_error(2)
    why = "b_1 - b_2 is invisible to sensors 1 and 2: docs/errata/yang2021.md"
    claim = Claim(
        "attack on any one input and sensor", "Example 2", "error -> 0", f"error {worst:.3g}", worst < 1e-6
    )
    out.append(replace(claim, why=why))
    return out


def doubt_error(example: int, size: float = 2.0) -> float:
    """Error of the printed bank in the worse of the two histories of `doubt`, at the end."""
    story, made = doubt(example, size), bank(example)
    state = init(made, 0.0)
    for y, u in zip(story.y, story.u, strict=True):
        state, answer = step(made, state, y, u, np.ones(len(y), dtype=np.bool_))
    return float(np.max(np.linalg.norm(story.x[:, -1] - answer.x, axis=1)))


def _figures(amplitude: float, numbers: tuple[int, ...]) -> list[PaperFigure]:
    # The captions of Figures 3 and 4 attack input 1, those of Figures 9 to 12 input 3.
    one, two, other = (simulate(1, amplitude), simulate(2, amplitude), simulate(2, amplitude, inputs=(0,)))
    size = f"uniform in ±{amplitude:g}"
    states = f"estimate (dashed) and state, attacks {size}"
    sensors = f"attacks on the sensors, {size}, reconstructed by (43)"
    inputs = f"attacks on the inputs, {size}, reconstructed by (42)"
    parts = (
        (f"Example 1: {states}", one.x, one.x_hat, "x"),
        (f"Example 2: {states}", other.x, other.x_hat, "x"),
        (f"Example 3: {sensors}", one.a_y, one.a_y_hat, "a_y"),
        (f"Example 3: {inputs}", one.a_u, one.a_u_hat, "a_u"),
        (f"Example 4: {sensors}", two.a_y, two.a_y_hat, "a_y"),
        (f"Example 4: {inputs}", two.a_u, two.a_u_hat, "a_u"),
    )
    return [_figure(place, *part) for place, part in zip(numbers, parts, strict=True)]


def _figure(place: int, caption: str, truth: Floats, found: Floats, letter: str) -> PaperFigure:
    k = np.arange(len(truth), dtype=np.float64)
    panels = tuple(
        Panel(
            title=f"{letter}{i + 1}",
            x_label="k",
            y_label=f"{letter}{i + 1}",
            lines=(
                FigureCurve("truth", k, truth[:, i], "solid"),
                FigureCurve("estimate", k, found[:, i], "dashed"),
            ),
        )
        for i in range(truth.shape[1])
    )
    return PaperFigure(f"yang2021-figure-{place}", caption, panels)

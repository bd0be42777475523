"""lee2018: the three-inertia system under attack (section 4.5, Figures 4.9 to 4.12), and chapter 5's example.

Values that the dissertation does not print are chosen here and marked: the attack's course, the reference,
the initial state, the gains of the observers.

Chapters 2 and 3 print no example.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from gridsec.arrays import Floats, spectral_radius
from gridsec.observers import kalman, luenberger
from gridsec.observers.luenberger import Bounds
from gridsec.papers import lee2018_chapter5
from gridsec.papers.claims import (
    Claim,
    FigureCurve,
    Panel,
    PaperFigure,
    Reproduction,
    at_most,
    number,
    statement,
)
from gridsec.secure.decode import partial_bounded, partial_gaussian
from gridsec.secure.decode.partial_bounded import BoundedDesign
from gridsec.secure.decode.partial_gaussian import GaussianDesign
from gridsec.secure.index import asymptotic_index, dynamic_index, redundant_detectable

INERTIA, FRICTION, STIFFNESS = 0.01, 0.007, 1.37
"""J in kg m^2, b in N m/(rad/s), k in N m/rad; the same for all wheels and springs."""

PERIOD = 1e-3
"""T_s, s."""

D_MAX = N_MAX = 1e-3
"""Bounds of disturbance and noise."""

FEEDBACK = -np.array([[2.32, 0.25, -2.47, 0.04, 1.70, 0.12]])
"""K of u = K x + K_I sum(reference - theta_3)."""

INTEGRAL = 0.002
"""K_I."""

ATTACK_START = 2.0
"""s."""

ROWS_PRINTED = np.array(
    [
        [1.0, 0, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 0],
        [0, 0, 1, 0, 0, 0],
        [0, 0, 0, 0, 1, 0],
        [1, 0, -1, 0, 0, 0],
        [0, 0, 1, 0, -1, 0],
    ]
)
"""C_c as printed: six rows for five outputs. The third repeats the second; y has no such entry."""

# Chosen here; not printed in the dissertation.
REFERENCE, REFERENCE_START = 1.0, 0.5
X_START = np.array([0.02, 0.0, -0.01, 0.0, 0.02, 0.0])
START_ERROR = 0.05
RATE, SLOWEST, TOL = 0.998, 1.0 - 1e-6, 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class SampledPlant:
    """A sampled plant and its continuous origin."""

    A_c: Floats  # (6, 6) continuous time
    B_c: Floats  # (6, 1) continuous time
    A: Floats  # (6, 6) sampled with zero-order hold
    B: Floats  # (6, 1) sampled
    C: Floats  # (5, 6) outputs
    E: Floats  # (6, 6) input matrix of a disturbance w that is constant over a step: d = E w


def plant(disturbance: Literal["continuous", "sampled"] = "continuous") -> SampledPlant:
    """The three-inertia system; states theta_1, its speed, theta_2, its speed, theta_3, its speed.

    disturbance: quantity bounded by d_max. "continuous": d(t) of (4.5.1), constant over each step. "sampled":
        d(k) of (4.1.1), a thousand times as large.
    Source: lee2018 (4.5.1), (4.5.2).
    """
    k, b = STIFFNESS / INERTIA, FRICTION / INERTIA
    A_c = np.zeros((6, 6))
    A_c[[0, 2, 4], [1, 3, 5]] = 1.0
    A_c[1, :3] = [-k, -b, k]
    A_c[3, [0, 2, 3, 4]] = [k, -2.0 * k, -b, k]
    A_c[5, [2, 4, 5]] = [k, -k, -b]
    B_c = np.zeros((6, 1))
    B_c[1] = 1.0 / INERTIA
    both = np.zeros((12, 12))
    both[:6, :6], both[:6, 6:] = A_c, np.eye(6)
    sampled = expm(both * PERIOD)
    A, held = sampled[:6, :6], sampled[:6, 6:]
    C = np.delete(ROWS_PRINTED, 2, axis=0)
    return SampledPlant(A_c, B_c, A, held @ B_c, C, held if disturbance == "continuous" else np.eye(6))


def estimator(model: SampledPlant, *, slowest: float = SLOWEST) -> BoundedDesign:
    """Partial Luenberger observers and Algorithm 4.1 for one attacked sensor.

    slowest: 0 for the observability decomposition; the detectability decomposition by default.
    """
    bounds = Bounds(D_MAX, np.full(len(model.C), N_MAX), model.E)
    observers = luenberger.design(
        model.A, model.B, model.C, bounds, slowest=slowest, tol=TOL, rate=RATE, period=PERIOD
    )
    return partial_bounded.design(observers, 1, tol=TOL)


def gaussian_estimator(model: SampledPlant, *, false_alarm: float = 1e-4) -> GaussianDesign:
    """Partial Kalman filters and Algorithm 4.2, with the variances of the bounded signals.

    A vector uniform in the ball of radius r in R^6 has the covariance `r^2 / 8 I`; a number uniform in
    [-r, r] has the variance `r^2 / 3`.
    """
    Q = model.E @ model.E.T * D_MAX**2 / 8.0
    R = np.eye(len(model.C)) * N_MAX**2 / 3.0
    filters = kalman.design(model.A, model.B, model.C, Q, R, slowest=SLOWEST, tol=TOL, period=PERIOD)
    return partial_gaussian.design(filters, 1, false_alarm=false_alarm, tol=1e-10, refresh=0.02)


def conventional_gain(model: SampledPlant) -> Floats:
    """L (6, 5) of one observer (4.2.1) on all sensors, the stationary Kalman predictor."""
    Q, R = model.E @ model.E.T * D_MAX**2, np.eye(len(model.C)) * N_MAX**2
    P = solve_discrete_are(model.A.T, model.C.T, Q, R)
    return np.asarray(model.A @ P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + R))


def attack(t: Floats) -> Floats:
    """a_1(t), rad: from 2 s on, half a radian with a swing of 2 Hz on top. The course is chosen here."""
    lie = 0.5 + 0.3 * np.sin(4.0 * np.pi * (t - ATTACK_START))
    return np.where(t >= ATTACK_START - 0.5 * PERIOD, lie, 0.0)


def reference(t: Floats) -> Floats:
    """theta_3,ref(t), rad: one radian from 0.5 s on. Amplitude and time are chosen here."""
    return np.where(t >= REFERENCE_START - 0.5 * PERIOD, REFERENCE, 0.0)


def closed_loop(model: SampledPlant) -> Floats:
    """Motion of (x, sum of reference - theta_3) under u = K x + K_I sum, for a known state; (7, 7)."""
    return np.block([[model.A + model.B @ FEEDBACK, model.B * INTEGRAL], [-model.C[[2]], np.eye(1)]])


@dataclass(frozen=True, slots=True, eq=False)
class Lee2018Run:
    """One simulation of T steps."""

    t: Floats  # (T,) time, s
    x: Floats  # (T, 6) state
    x_hat: Floats  # (T, 6) estimate of the secure estimator
    x_conventional: Floats  # (T, 6) estimate of the conventional observer
    bound: Floats  # (T,) bound of |x_hat - x|; infinite for Gaussian noise
    disagree: Floats  # (T, 5) sensors that the estimate does not use (Gaussian) or explain (bounded)
    searched: Floats  # (T,) steps with a search (bounded) or an alarm (Gaussian)
    attack: Floats  # (T,) a_1, rad
    reference: Floats  # (T,) theta_3,ref, rad
    u: Floats  # (T,) torque, N m


def _signals(
    model: SampledPlant, t: Floats, seed: int, *, attacked: bool, normal: bool
) -> tuple[Floats, Floats, Floats]:
    """Disturbance, noise and attack, drawn before the loop."""
    rng = np.random.default_rng(seed)
    steps, p = t.size, len(model.C)
    w = rng.standard_normal((steps, 6))
    if normal:
        w *= D_MAX / np.sqrt(8.0)
        n = rng.standard_normal((steps, p)) * N_MAX / np.sqrt(3.0)
    else:
        w *= D_MAX * rng.uniform(0.0, 1.0, (steps, 1)) ** (1 / 6) / np.linalg.norm(w, axis=1, keepdims=True)
        n = rng.uniform(-N_MAX, N_MAX, (steps, p))
    lie = np.zeros((steps, p))
    if attacked:
        lie[:, 0] = attack(t)
    return w @ model.E.T, n, lie


def simulate(
    model: SampledPlant,
    design: BoundedDesign | GaussianDesign,
    *,
    seconds: float,
    seed: int = 1,
    attacked: bool = True,
    feedback: Literal["resilient", "conventional"] = "resilient",
) -> Lee2018Run:
    """The closed loop of Figures 4.1 and 4.8, with an estimator in it and a conventional observer beside it.

    design: from `estimator` or `gaussian_estimator`.
    seed: seed of disturbance and noise: uniform within their bounds, or Gaussian of the same variance.
    attacked: attack sensor 1 from 2 s on.
    feedback: estimate used by the controller.
    """
    t: Floats = np.arange(round(seconds / PERIOD), dtype=np.float64) * PERIOD
    normal, wanted = isinstance(design, GaussianDesign), reference(t)
    d, n, lie = _signals(model, t, seed, attacked=attacked, normal=normal)
    gain = conventional_gain(model)
    steps = t.size
    x, total, plain = X_START.copy(), 0.0, np.zeros(6)
    xs, hats, plains = np.empty((steps, 6)), np.empty((steps, 6)), np.empty((steps, 6))
    bounds, us = np.full(steps, np.inf), np.empty(steps)
    disagree, searched = np.zeros((steps, len(model.C))), np.zeros(steps)
    y = model.C @ x + n[0] + lie[0]
    if isinstance(design, BoundedDesign):
        one, out = partial_bounded.init(design, 0.0, np.zeros(6), START_ERROR)
    else:
        two, seen = partial_gaussian.init(design, 0.0, np.zeros(6), np.eye(6) * START_ERROR**2 / 6.0, y)
    for k in range(steps):
        if isinstance(design, BoundedDesign):
            hats[k], bounds[k], disagree[k], searched[k] = out.x, out.bound, out.disagree, out.searched
        else:
            hats[k], disagree[k], searched[k] = seen.x, ~seen.trusted, seen.alarm
        xs[k], plains[k] = x, plain
        used = hats[k] if feedback == "resilient" else plain
        u = FEEDBACK @ used + INTEGRAL * total
        us[k] = u[0]
        # The controller has estimates only and integrates the estimated theta_3.
        total += wanted[k] - used[4]
        plain = model.A @ plain + model.B @ u + gain @ (y - model.C @ plain)
        x = model.A @ x + model.B @ u + d[k]
        if isinstance(design, BoundedDesign):
            one, out = partial_bounded.step(design, one, y, u)
        if k + 1 < steps:
            y = model.C @ x + n[k + 1] + lie[k + 1]
            if isinstance(design, GaussianDesign):
                two, seen = partial_gaussian.step(design, two, y, u)
    return Lee2018Run(t, xs, hats, plains, bounds, disagree, searched, lie[:, 0], wanted, us)


SECONDS = 6.0
SETTLED = 4.5
"""s; four seconds after the step of the reference, 12 times the slowest time constant of the loop."""


def reproduce() -> Reproduction:
    """Both examples of the dissertation: `chapter4` and `lee2018_chapter5.reproduce`."""
    four, five = chapter4(), lee2018_chapter5.reproduce()
    return Reproduction("lee2018", (*four.claims, *five.claims), (*four.figures, *five.figures))


def chapter4() -> Reproduction:
    """Redundancy, security index, Theorem 4.3.2 along a run, tracking, Figures 4.9 to 4.12."""
    model = plant()
    made = estimator(model)
    run = simulate(model, made, seconds=SECONDS)
    gauss = simulate(model, gaussian_estimator(model), seconds=SECONDS)
    claims = [*_index_claims(model), *_memory_claims(made), *_run_claims(model, made, run)]
    claims += _gauss_claims(gauss)
    return Reproduction("lee2018-4", tuple(claims), (_figure(run), _errors(run, gauss)))


def _index_claims(model: SampledPlant) -> list[Claim]:
    place = "section 4.5"
    asymptotic = asymptotic_index(model.A, model.C, discrete=True, tol=TOL)
    lost = [q for q in (2, 3) if redundant_detectable(model.A, model.C, q, discrete=True, tol=TOL)]
    redundancy = f"{max(lost)}-redundant detectable" if lost else "not 2-redundant detectable"
    printed = asymptotic_index(model.A, ROWS_PRINTED, discrete=True, tol=TOL)
    return [
        statement("redundancy of (A, C)", place, "2-redundant detectable", redundancy),
        number("attacked sensors that can be corrected", place, 1.0, asymptotic.correctable, unit=1.0),
        number(
            "dynamic security index", place, 3.0, dynamic_index(model.A, model.C, tol=TOL).count, unit=1.0
        ),
        number("asymptotic security index", place, 3.0, asymptotic.count, unit=1.0),
        Claim(
            "security index with C_c as printed",
            "(4.5.1)",
            3.0,
            printed.count,
            bool(printed.count == 3.0),
            "the printed C_c has six rows for five outputs: the one of theta_2 is there twice",
        ),
    ]


def _memory_claims(made: BoundedDesign) -> list[Claim]:
    sizes = np.diff(made.observers.stack.first)
    n, p = made.decoder.stack.unknowns, sizes.size
    return [
        at_most(
            "states of all partial observers, at most n p", "Remark 4.4.2", float(n * p), float(sizes.sum())
        ),
        Claim(
            "that is dramatically fewer than the n C(p, q) of a bank over subsets",
            "Remark 4.4.2",
            float(n * p),
            float(sizes.sum()),
            bool(sizes.sum() <= 0.5 * n * p),
            "only for q >= 2: with q = 1 there are as many subsets as sensors",
        ),
    ]


def _run_claims(model: SampledPlant, made: BoundedDesign, run: Lee2018Run) -> list[Claim]:
    error = np.linalg.norm(run.x_hat - run.x, axis=1)
    late = run.t >= SETTLED
    on = run.t >= ATTACK_START + 0.1
    named = np.flatnonzero(run.disagree[on].any(axis=0)) + 1
    limit = made.constants.kappa_c * max(e.limit for e in made.observers.envelopes)
    return [
        at_most(
            "spectral radius of the loop under K and K_I with the state known: stable",
            "section 4.5",
            1.0,
            spectral_radius(closed_loop(model)),
        ),
        at_most(
            "|x_hat - x| over kappa^c v_max(k), largest over all k",
            "Theorem 4.3.2",
            1.0,
            np.max(error / run.bound),
        ),
        at_most("|x_hat - x| after 4.5 s, at most kappa^c w_max", "Theorem 4.3.2", limit, error[late].max()),
        statement("sensor attacked from 2 s on", "section 4.5", "1", ", ".join(map(str, named))),
        Claim(
            "estimates resilient to the attack",
            "Figures 4.10 and 4.11",
            "yes",
            f"error after 4.5 s {error[late].max():.1e}, of an observer on all sensors "
            f"{np.linalg.norm(run.x_conventional - run.x, axis=1)[late].max():.1e}",
            bool(error[late].max() < 0.01),
        ),
        Claim(
            "theta_3 follows its reference",
            "Figure 4.12",
            "good tracking",
            f"within {np.abs(run.x[late, 4] - REFERENCE).max():.1e} rad after 4.5 s",
            bool(np.abs(run.x[late, 4] - REFERENCE).max() < 0.01),
        ),
    ]


def _gauss_claims(run: Lee2018Run) -> list[Claim]:
    error = np.linalg.norm(run.x_hat - run.x, axis=1)
    on = run.t >= ATTACK_START - 0.5 * PERIOD
    delay = float(run.t[on][np.argmax(run.searched[on])] - ATTACK_START)
    dropped = np.flatnonzero(run.disagree[-1]) + 1
    return [
        statement(
            "Gaussian variant: sensor left out at the end",
            "Algorithm 4.2",
            "1",
            ", ".join(map(str, dropped)),
        ),
        Claim(
            "Gaussian variant: attack noticed and estimate kept",
            "Algorithm 4.2",
            "yes",
            f"after {delay * 1e3:.0f} ms; error under attack {error[on].max():.1e}",
            bool(run.searched[on].any() and error[on].max() < 0.01),
        ),
    ]


def _figure(run: Lee2018Run) -> PaperFigure:
    def states(k: int, number: int, name: str, unit: str) -> Panel:
        lines = (
            FigureCurve("observer on all sensors", run.t, run.x_conventional[:, k], "dotted"),
            FigureCurve("state", run.t, run.x[:, k]),
            FigureCurve("estimate", run.t, run.x_hat[:, k], "dashed"),
        )
        return Panel(f"Figure 4.{number}: {name}", "t in s", f"{name} in {unit}", lines)

    panels = (
        Panel("Figure 4.9: attack", "t in s", "a1 in rad", (FigureCurve("", run.t, run.attack),)),
        states(0, 10, "theta 1", "rad"),
        states(3, 11, "speed of theta 2", "rad/s"),
        Panel(
            "Figure 4.12: tracking",
            "t in s",
            "rad",
            (
                FigureCurve("reference", run.t, run.reference, "steps"),
                FigureCurve("theta 3", run.t, run.x[:, 4]),
            ),
        ),
    )
    return PaperFigure(
        "lee2018-figures-4-9-to-4-12",
        f"Three inertias: sensor 1 is manipulated from {ATTACK_START:g} s on, the reference steps at "
        f"{REFERENCE_START:g} s; the resilient estimate stays with the state, one on all sensors does not",
        panels,
    )


def _errors(run: Lee2018Run, gauss: Lee2018Run) -> PaperFigure:
    def size(hat: Floats, x: Floats) -> Floats:
        return np.asarray(np.log10(np.maximum(np.linalg.norm(hat - x, axis=1), 1e-12)), dtype=np.float64)

    lines = (
        FigureCurve("bound of Theorem 4.3.2", run.t, np.log10(run.bound), "dotted"),
        FigureCurve("observer on all sensors", run.t, size(run.x_conventional, run.x), "dashdot"),
        FigureCurve("Algorithm 4.1", run.t, size(run.x_hat, run.x)),
        FigureCurve("Algorithm 4.2", gauss.t, size(gauss.x_hat, gauss.x), "dashed"),
    )
    return PaperFigure(
        "lee2018-errors-4",
        "Estimation errors of both decoders on the three-inertia system, with the guaranteed bound",
        (Panel("Estimation error", "t in s", "log10 of the error", lines),),
    )

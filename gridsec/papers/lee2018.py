"""lee2018: the three-inertia system under attack (section 4.5, Figures 4.9 to 4.12), and chapter 5's example.

Chapters 2 and 3 print no example.
"""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Floats, spectral_radius
from gridsec.decode.partial.bounded import BoundedDesign
from gridsec.index import asymptotic_index, dynamic_index, redundant_detectable
from gridsec.papers import lee2018_chapter5
from gridsec.papers.claims import Claim, Figure, Line, Panel, Reproduction, at_most, number, statement
from gridsec.papers.three_inertia import (
    ATTACK_START,
    PERIOD,
    REFERENCE,
    REFERENCE_START,
    ROWS_PRINTED,
    TOL,
    Plant,
    Run,
    closed_loop,
    estimator,
    gaussian_estimator,
    plant,
    simulate,
)

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
    claims = (
        *_index_claims(model),
        *_memory_claims(made),
        *_run_claims(model, made, run),
        *_gauss_claims(gauss),
    )
    return Reproduction("lee2018-4", claims, (_figure(run), _errors(run, gauss)))


def _index_claims(model: Plant) -> list[Claim]:
    place = "section 4.5"
    asymptotic = asymptotic_index(model.A, model.C, discrete=True, tol=TOL)
    enough = redundant_detectable(model.A, model.C, 2, discrete=True, tol=TOL)
    more = redundant_detectable(model.A, model.C, 3, discrete=True, tol=TOL)
    printed = asymptotic_index(model.A, ROWS_PRINTED, discrete=True, tol=TOL)
    return [
        statement(
            "redundancy of (A, C)", place, "2-redundant detectable", _redundancy(enough=enough, more=more)
        ),
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


def _redundancy(*, enough: bool, more: bool) -> str:
    if more:
        return "3-redundant detectable"
    return "2-redundant detectable" if enough else "not 2-redundant detectable"


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


def _run_claims(model: Plant, made: BoundedDesign, run: Run) -> list[Claim]:
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


def _gauss_claims(run: Run) -> list[Claim]:
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


def _figure(run: Run) -> Figure:
    def states(k: int, number: int, name: str, unit: str) -> Panel:
        lines = (
            Line("observer on all sensors", run.t, run.x_conventional[:, k], "dotted"),
            Line("state", run.t, run.x[:, k]),
            Line("estimate", run.t, run.x_hat[:, k], "dashed"),
        )
        return Panel(f"Figure 4.{number}: {name}", "t in s", f"{name} in {unit}", lines)

    panels = (
        Panel("Figure 4.9: attack", "t in s", "a1 in rad", (Line("", run.t, run.attack),)),
        states(0, 10, "theta 1", "rad"),
        states(3, 11, "speed of theta 2", "rad/s"),
        Panel(
            "Figure 4.12: tracking",
            "t in s",
            "rad",
            (Line("reference", run.t, run.reference, "steps"), Line("theta 3", run.t, run.x[:, 4])),
        ),
    )
    return Figure(
        "lee2018-figures-4-9-to-4-12",
        f"Three inertias: sensor 1 is manipulated from {ATTACK_START:g} s on, the reference steps at "
        f"{REFERENCE_START:g} s; the resilient estimate stays with the state, one on all sensors does not",
        panels,
    )


def _errors(run: Run, gauss: Run) -> Figure:
    def size(hat: Floats, x: Floats) -> Floats:
        return np.asarray(np.log10(np.maximum(np.linalg.norm(hat - x, axis=1), 1e-12)), dtype=np.float64)

    lines = (
        Line("bound of Theorem 4.3.2", run.t, np.log10(run.bound), "dotted"),
        Line("observer on all sensors", run.t, size(run.x_conventional, run.x), "dashdot"),
        Line("Algorithm 4.1", run.t, size(run.x_hat, run.x)),
        Line("Algorithm 4.2", gauss.t, size(gauss.x_hat, gauss.x), "dashed"),
    )
    return Figure(
        "lee2018-errors-4",
        "Estimation errors of both decoders on the three-inertia system, with the guaranteed bound",
        (Panel("Estimation error", "t in s", "log10 of the error", lines),),
    )

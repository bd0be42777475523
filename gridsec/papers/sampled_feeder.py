"""Algorithms 1 and 2 of yang2019 on a feeder with readings at regular times.

References
----------
yang2019, Algorithms 1 and 2; docs/theory-discrete.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec import windows
from gridsec.arrays import Bools, Floats, spectral_radius
from gridsec.lmi.discrete import discrete_contraction
from gridsec.lmi.sampled import drift_error, sample
from gridsec.lure import Lure, equilibrium
from gridsec.lure import advance as advance_continuous
from gridsec.papers import chong2020
from gridsec.papers.claims import Figure, Line, Panel
from gridsec.windows import Rule, WindowDesign

PARTS = (0.95, 0.8, 0.6, 0.4)
"""Candidates for the decay, as powers of the slowest inverter's own."""
JUMP = 3e-4


def points(suspects: Bools) -> tuple[Floats, Floats]:
    """Points (window, meter), both from 1; meter 0 for a window without named meters.

    Parameters
    ----------
    suspects : (w, p)
        Named meters of each window.
    """
    with_nobody = np.hstack([~suspects.any(axis=1, keepdims=True), suspects])
    window, meter = np.nonzero(with_nobody)
    return (window + 1).astype(np.float64), meter.astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class FeederStudy:
    """Results of the two algorithms on a sampled feeder.

    Attributes
    ----------
    design
        Bank and proven thresholds.
    error, bound : (T, o), (o,)
        Error of every observer, and its proven bound, pu of reactive power.
    verdicts
        One for each window.
    """

    design: WindowDesign
    error: Floats
    bound: Floats
    verdicts: tuple[windows.WindowVerdict, ...]


def on_feeder(
    lure: Lure,
    *,
    h: float,
    u: Floats,
    noise: float,
    held: Floats,
    limit: Floats,
    lie: Floats,
    max_attacked: int,
    length: int,
    seed: int,
    rule: Rule = "majority",
) -> FeederStudy:
    """Bank by direct injection on a feeder sampled every h seconds, with the continuous model as plant.

    The observers run on the exponential Euler step. The deviation of the continuous plant within a step is an
    error of the arguments of at most `held` and part of the thresholds, which thus cover the discretisation.

    Parameters
    ----------
    lure
        Closed loop from `close_loop`.
    h
        Time between readings, s.
    u : (T, l)
        Known input, constant between readings.
    noise
        Half-width of the meters' uniform noise, squared pu.
    held : (m,)
        Bound on the motion of each inverter's argument within a step, squared pu: `sampled.held_error`
        or `sampled.drift_error`.
    limit : (m,)
        Largest injection of each inverter, pu.
    lie : (T, p)
        Attack, squared pu (in z).
    max_attacked, length, rule
        q, N, and the isolation rule of windows.
    """
    plant = sample(lure, h)
    slowest = spectral_radius(plant.A)
    proof = discrete_contraction(plant, decays=tuple(slowest**part for part in PARTS))
    observers = windows.bank(plant, max_attacked, proof=proof)
    p, size = len(plant.C), float(np.linalg.norm(held))
    start = float(np.linalg.norm(limit))
    design = windows.design(
        observers,
        max_attacked,
        noise=noise * np.sqrt(p),
        length=length,
        start=2.0 * start,
        epsilon=1e-3 * start,
        unknown=size,
        rule=rule,
    )
    rng = np.random.default_rng(seed)
    truth = equilibrium(lure, u[0], tol=1e-12, max_iter=200)
    state = windows.init(design, 0.0, np.zeros(len(plant.A)))
    verdicts, error = [], np.zeros((len(u), len(observers)))
    everyone = np.ones(p, dtype=np.bool_)
    for k, now in enumerate(u):
        error[k] = np.linalg.norm(state.x - truth, axis=1)
        y = lure.C @ truth + lure.D @ now + rng.uniform(-noise, noise, p) + lie[k]
        state, verdict = windows.step(design, state, y, now, everyone)
        truth = advance_continuous(lure, truth, now, h)
        if verdict is not None:
            verdicts.append(verdict)
    settled = design.epsilon + design.gains * design.noise
    bound = settled + np.array([one.unknown_gain for one in observers]) * size
    return FeederStudy(design, error, bound, tuple(verdicts))


def figure() -> Figure:
    """Algorithms 1 and 2 on a sampled feeder: the line of chong2020, section VII, read once a second.

    Meter 3 has a bias of 0.04 squared pu (2.1 % of the voltage) from 150 s on; windows have 20 steps.
    """
    of, T = chong2020.setting(), 300
    rng = np.random.default_rng(4)
    # Loads drift: no argument jumps by more than JUMP from one reading to the next.
    u = of.w + np.cumsum(rng.uniform(-JUMP, JUMP, (T, 1)), axis=0)
    lie = np.zeros((T, chong2020.CUSTOMERS))
    lie[150:, 2] = 0.04
    study = on_feeder(
        of.lure,
        h=1.0,
        u=u,
        noise=1e-3,
        held=drift_error(of.lure, 1.0, np.full(chong2020.CUSTOMERS, JUMP)),
        limit=of.droop.limit,
        lie=lie,
        max_attacked=1,
        length=20,
        seed=5,
    )
    t = np.array([verdict.t for verdict in study.verdicts])
    score = np.stack([verdict.score for verdict in study.verdicts])
    named = np.stack([verdict.suspects for verdict in study.verdicts])
    window, meter = points(named)
    masks = study.design.observers.masks[1 : 1 + study.design.sets.count_large]
    labels = ["pi"] + ["pi_J, J without meter " + str(int(np.argmin(J)) + 1) for J in masks]
    lines = [Line(label, t, column) for label, column in zip(labels, score.T, strict=True)]
    lines.append(Line("threshold", t, np.full(t.size, study.design.detect_above), "dashed"))
    panels = (
        Panel("Largest value in each window", "t in s", "pu of reactive power", tuple(lines)),
        Panel(
            "Named", "t in s", "meter (0: none)", (Line("", t[window.astype(np.intp) - 1], meter, "points"),)
        ),
    )
    caption = "Sampled line feeder, five meters with noise, one manipulated from 150 s on; proven thresholds."
    return Figure("yang2019-feeder", caption, panels)

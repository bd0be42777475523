"""Simulated runs of plant and bank, and thresholds from runs without attack.

References
----------
yang2019, Example 1; docs/theory-discrete.md, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Floats, frozen
from gridsec.errors import Problem, refuse
from gridsec.lmi.sampled import advance as advance_plant
from gridsec.lmi.sampled import measure
from gridsec.observers.circle_discrete import advance
from gridsec.windows.design import WindowDesign, consistency


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """One simulated run or several. T steps, R runs on a leading axis if there are several.

    Attributes
    ----------
    pi : (…, T)
    pi_sets : (…, T, s)
        The consistency measures.
    error : (…, T, o)
        `|x_hat - x|` of every observer.
    """

    pi: Floats
    pi_sets: Floats
    error: Floats


def simulate(
    design: WindowDesign, x: Floats, u: Floats, disturbance: Floats, apart: Floats | float = 0.0
) -> Trace:
    """Simulate plant and bank together under given noise and attacks.

    Parameters
    ----------
    x : (…, n)
        Initial states of the plant.
    u : (T, l)
        Known input.
    disturbance : (…, T, p)
        Noise plus attack of every meter.
    apart : (…, n) or scalar
        Initial error of every observer.
    """
    system, observers = design.observers.system, design.observers
    truth = np.asarray(x, dtype=np.float64)
    everyone = np.ones(len(system.C), dtype=np.bool_)
    lead, steps = truth.shape[:-1], len(u)
    many = np.repeat((truth + apart)[..., None, :], len(observers.masks), axis=-2)
    pi, pi_sets = np.zeros((*lead, steps)), np.zeros((*lead, steps, design.sets.count_large))
    error = np.zeros((*lead, steps, len(observers.masks)))
    for k in range(steps):
        pi[..., k], pi_sets[..., k, :] = consistency(design, many)
        error[..., k, :] = np.linalg.norm(many - truth[..., None, :], axis=-1)
        y = measure(system, truth, u[k]) + disturbance[..., k, :]
        many = advance(observers, many, y, u[k], everyone)
        truth = advance_plant(system, truth, u[k])
    return Trace(pi, pi_sets, error)


def calibrate(design: WindowDesign, honest: Trace) -> WindowDesign:
    """Thresholds from runs without attack: the largest observed pi and pi_J.

    With R independent runs, one more run of the same kind exceeds a given threshold with at most the
    probability `1 - (1 - confidence)^(1/R)`, with that confidence. Noise of another kind may exceed them:
    these thresholds are statistics, not bounds.

    Parameters
    ----------
    honest
        From `simulate` without attack.

    Raises
    ------
    ValueError
        If the measures are not finite, or all runs end before windows begin.
    """
    first = design.settling
    measures = {"pi": honest.pi[..., first:], "pi_sets": honest.pi_sets[..., first:, :]}
    refuse(
        Problem("not-finite", f"{name} has no finite numbers alone from step {first} on")
        for name, found in measures.items()
        if not (found.size and np.isfinite(found).all())
    )
    top = measures["pi_sets"].reshape(-1, design.sets.count_large).max(axis=0)
    return replace(design, detect_above=float(measures["pi"].max()), isolate_above=frozen(top))

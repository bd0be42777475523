"""Test of the busbar's meter by all others.

The busbar's error b is in every residual of its phase as -b. With d one at the meters of the phase and zero
elsewhere, an unknown busbar error lowers the chi-square by

    z^2 = (d^T Q m)^2 / (d^T Q d),

and z is its leave-one-out residual in standard deviations: Q contains its honest error. Where z is beyond
chance, and, without suspects, beyond honest errors of one direction at their ends, the likeliest hypothesis
with a manipulated busbar meter is compared with those without (`gridsec.estimators.sequential.examine`). If
it wins, the tick starts again without that reading, from the last trusted voltage. The meters then determine
the busbar, and its reading is compared with them until both agree again.

References
----------
docs/theory-sequential.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.inputs import busbar_errors
from gridsec.estimators.sequential.bounds import Powers
from gridsec.estimators.sequential.conditional import Fit, Judged
from gridsec.estimators.sequential.design import SequentialDesign


@dataclass(frozen=True, slots=True, eq=False)
class Busbar:
    """Trust of the busbar's meter. b phases, 1 on a balanced feeder."""

    believed: Bools  # (b,) its voltage is used
    scale: Ints  # (b,) scale of the detection
    age: Ints  # (b,) ticks without trust
    quiet: Ints  # (b,) successive ticks of agreement; negative after a restart: ticks owed
    off: Floats  # (b,) excess of its reading, mean over the scale, squared pu
    named: Bools  # (b,) named as manipulated

    def caught(self, phase: int, scale: int) -> Busbar:
        """Trust without one phase, detected on a scale."""
        here = np.arange(self.believed.size) == phase
        return replace(self, believed=self.believed & ~here, scale=np.where(here, scale, self.scale))


def believed(phases: int) -> Busbar:
    """All phases trusted."""
    zero, no = np.zeros(phases, dtype=np.intp), np.zeros(phases, dtype=np.bool_)
    return Busbar(~no, zero, zero, zero, np.zeros(phases), no)


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """Limits of the test. p meters, b phases."""

    sigmas: float  # standard deviations within chance
    model: Floats  # (p,) largest model error, squared pu
    metered: Bools  # (b,) busbar voltage is metered and trusted


def opposed(design: SequentialDesign, doubt: Doubt, now: Fit, judged: Judged) -> list[int]:
    """Phases of the busbar with a meter that the trusted ones contradict beyond chance."""
    # Weights are zero where no meter is trusted.
    along, form = np.abs(judged.weights @ design.hangs_on), weight(design, now)
    chance = doubt.sigmas * np.sqrt(form)
    if all_of(along <= chance):
        return []
    # The model may err at all meters in the worst direction: more than `form` where weights differ in sign.
    at, Q = now.trusting()
    reach = np.abs(Q @ design.hangs_on[at]).sum(axis=0)
    return np.flatnonzero(doubt.metered & (along > chance + doubt.model.max() * reach)).tolist()


def weight(design: SequentialDesign, now: Fit) -> Floats:
    """d^T Q d of every phase of the busbar, (b,); cached in the posterior."""
    if now.together is None:
        at, Q = now.trusting()
        hangs = design.hangs_on[at]
        now.together = np.einsum("ij,ij->j", hangs, Q @ hangs)
    return now.together


@dataclass(frozen=True, slots=True, eq=False)
class Honest:
    """Bounds of honest errors other than the meters'. m inverters."""

    powers: Powers  # power errors of the frame
    injected: Floats  # (m,) largest errors of the observed injections, pu


def aligned(design: SequentialDesign, now: Fit, m: Floats, fixed: Floats, honest: Honest) -> Bools:
    """Phases where honest errors at their ends, all in one direction, explain the test, (b,).

    The trusted meters give ``v^T m`` of the busbar, with ``v = Q d / (d^T Q d)``. Honest errors change it by
    at most

        |2 v^T R| dp + 2 |v^T X| dq + |v|^T (fixed + jitter) + error of the busbar's meter.

    fixed: (p,) largest honest fixed error of each meter and of the model, squared pu.
    """
    at, Q = now.trusting()
    v = Q @ design.hangs_on[at] / np.maximum(weight(design, now), np.finfo(np.float64).tiny)
    error = busbar_errors(design.plant, honest.powers.v0_squared, design.sigmas[0])
    return np.abs(m[at] @ v) <= room(design, at, v, fixed, honest) + error


def room(design: SequentialDesign, at: Ints, v: Floats, fixed: Floats, honest: Honest) -> Floats:
    """Largest sums ``v^T m`` over honest errors at their ends, (k,), squared pu.

        |2 v^T R| dp + 2 |v^T X| dq + |v|^T (fixed + jitter)

    at: (t,) meters. v: (t, k) weights. fixed: (p,) as in `aligned_errors`.
    """
    plant = design.plant
    injected = plant.droop.per_customer(honest.injected, design.customers)
    errors = np.concatenate(honest.powers.errors(plant, injected))
    out = np.abs(v).T @ (fixed + design.sigmas[0] * np.sqrt(design.white))[at]
    for k, one in enumerate(v.T):
        out[k] += np.abs(design.effects.along(plant.meters[at], one)) @ errors
    return np.asarray(out)


def follow(  # noqa: PLR0917
    design: SequentialDesign,
    before: Busbar,
    reported: Floats,
    heard: Bools,
    v0_squared: Floats,
    variance: Floats,
    allowed: float,
) -> Busbar:
    """Compare the reading of a suspect busbar meter with the other meters.

    It is named if it differs for the confirmation time by more than an honest offset of all meters. It is
    trusted again once the mean over its scale stays within the release limit for that scale, and for the
    release time of any meter. reported, heard: (b,) its squared voltages, pu, and available ones. v0_squared,
    variance: (b,) by the other meters. allowed: largest honest fixed error, squared pu.
    """
    out = ~before.believed
    if not any_of(out):
        return before
    length = np.array(design.lengths)[before.scale]
    age = before.age + out
    off = np.where(heard, reported - v0_squared, before.off)
    off = before.off + (off - before.off) / np.clip(age, 1, length)
    std = np.sqrt(variance + design.busbar**2 + design.flicker)
    limit = design.options.lower * np.array(design.sigmas)[before.scale] * std
    agrees = out & heard & (np.abs(off) <= limit)
    quiet = np.where(heard, (before.quiet + 1) * agrees, before.quiet)
    lasts = out & heard & (age >= design.confirmed[before.scale]) & (np.abs(off) > allowed + limit)
    still = out & (quiet < np.maximum(design.options.release, length))
    return Busbar(
        believed=~still,
        scale=before.scale,
        age=np.where(still, age, 0),
        quiet=np.where(still, quiet, 0),
        off=np.where(still, off, 0.0),
        named=still & (before.named | lasts),
    )

"""The busbar's own meter, judged by all others.

What it reads is in every residual: if it is off by b, all residuals of its phase are off by -b, and whoever
takes its word suspects everybody else. It is a meter like any other, only with more weight. With d one at the
meters of its phase and zero elsewhere, letting the busbar differ by any amount lowers the misfit by

    z^2 = (d^T Q m)^2 / (d^T Q d),

and z is its leave-one-out residual in standard deviations: Q already contains its honest error. Where that is
beyond chance, and, while no meter is suspected, beyond what honest errors explain that are all at their ends
and in one direction, the likeliest explanation in which the busbar's meter lies is compared with that in
which only others do (`gridsec.estimators.sequential.examine`). If it wins, the tick begins anew as one at
which nobody reads the busbar, from the last voltage that was believed. The meters then say where the busbar
is, and what its own meter says is compared with that until both agree again.

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
    """What is thought of the busbar's meter. b phases, one on a balanced feeder.

    Attributes
    ----------
    believed : (b,)
        Whether its voltage is used.
    scale : (b,)
        Scale on which it was caught.
    age : (b,)
        For how many ticks it has not been believed.
    quiet : (b,)
        Ticks in a row, of these, in which it agreed with the meters; negative after a restart, while so many
        more are owed.
    off : (b,)
        What it reads too much, the mean over its scale, squared pu.
    named : (b,)
        Whether it is called manipulated.
    """

    believed: Bools
    scale: Ints
    age: Ints
    quiet: Ints
    off: Floats
    named: Bools

    def caught(self, phase: int, scale: int) -> Busbar:
        """A phase is believed no more.

        Parameters
        ----------
        phase, scale
            Which, and the scale that found it.
        """
        here = np.arange(self.believed.size) == phase
        return replace(self, believed=self.believed & ~here, scale=np.where(here, scale, self.scale))


def believed(phases: int) -> Busbar:
    """Nothing speaks against the busbar's meter.

    Parameters
    ----------
    phases
        b.
    """
    zero, no = np.zeros(phases, dtype=np.intp), np.zeros(phases, dtype=np.bool_)
    return Busbar(~no, zero, zero, zero, np.zeros(phases), no)


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """What speaks against the busbar's meter. p meters, b phases.

    Attributes
    ----------
    sigmas
        Standard deviations beyond which an offset is none of chance.
    model : (p,)
        What the model may be off, squared pu.
    metered : (b,)
        Whether there is a busbar voltage that is believed.
    """

    sigmas: float
    model: Floats
    metered: Bools


def opposed(design: SequentialDesign, doubt: Doubt, now: Fit, judged: Judged) -> list[int]:
    """The phases of the busbar whose meter the trusted ones contradict beyond chance.

    Parameters
    ----------
    design, doubt
        The design, and what is beyond chance.
    now, judged
        The trusted meters, and what they say.
    """
    # Weights are zero where nobody is trusted.
    along, form = np.abs(judged.weights @ design.hangs_on), weight(design, now)
    chance = doubt.sigmas * np.sqrt(form)
    if all_of(along <= chance):
        return []
    # The model may be off by that at all meters, in the direction that says most: more than form where
    # weights differ in sign.
    at, Q = now.trusting()
    reach = np.abs(Q @ design.hangs_on[at]).sum(axis=0)
    return np.flatnonzero(doubt.metered & (along > chance + doubt.model.max() * reach)).tolist()


def weight(design: SequentialDesign, now: Fit) -> Floats:
    """d^T Q d of every phase of the busbar, (b,); kept with the fit.

    Parameters
    ----------
    design, now
        The design, and the trusted meters.
    """
    if now.together is None:
        at, Q = now.trusting()
        hangs = design.hangs_on[at]
        now.together = np.einsum("ij,ij->j", hangs, Q @ hangs)
    return now.together


@dataclass(frozen=True, slots=True, eq=False)
class Honest:
    """What honest errors are bounded by at one tick, besides those of the meters. m inverters.

    Attributes
    ----------
    powers
        The frame's, and how far they may be off.
    injected : (m,)
        How far the observed injections may be off, pu.
    """

    powers: Powers
    injected: Floats


def aligned(  # who says what, and how far that may be off
    design: SequentialDesign, now: Fit, m: Floats, fixed: Floats, honest: Honest
) -> Bools:
    """Where honest errors at their ends, all in one direction, explain what meters say of the busbar, (b,).

    The trusted meters say ``v^T m`` of it, with ``v = Q d / (d^T Q d)``, and that is off by no more than

        |2 v^T R| dp + 2 |v^T X| dq + |v|^T (fixed + jitter) + error of the busbar's meter,

    were jitter as large as it ever is at all meters at once, and lasting.

    Parameters
    ----------
    design, now
        The design, and the trusted meters.
    m : (p,)
        Readings minus what the model explains, squared pu.
    fixed : (p,)
        Largest honest fixed error of each meter, with that of the model, squared pu.
    honest
        How far all else may be off.
    """
    at, Q = now.trusting()
    v = Q @ design.hangs_on[at] / np.maximum(weight(design, now), np.finfo(np.float64).tiny)
    error = busbar_errors(design.plant, honest.powers.v0_squared, design.sigmas[0])
    return np.abs(m[at] @ v) <= room(design, at, v, fixed, honest) + error


def room(design: SequentialDesign, at: Ints, v: Floats, fixed: Floats, honest: Honest) -> Floats:
    """Largest sums ``v^T m`` over honest errors at their ends, without the busbar's meter, (k,), squared pu.

        |2 v^T R| dp + 2 |v^T X| dq + |v|^T (fixed + jitter)

    Parameters
    ----------
    design
        The design.
    at : (t,)
        Some meters.
    v : (t, k)
        Their weights.
    fixed : (p,)
        Largest honest fixed error of each meter, with that of the model, squared pu.
    honest
        How far all else may be off.
    """
    plant = design.plant
    injected = plant.droop.per_customer(honest.injected, design.customers)
    errors = np.concatenate(honest.powers.errors(plant, injected))
    out = np.abs(v).T @ (fixed + design.sigmas[0] * np.sqrt(design.white))[at]
    for k, one in enumerate(v.T):
        out[k] += np.abs(design.effects.along(plant.meters[at], one)) @ errors
    return np.asarray(out)


def follow(  # noqa: PLR0917  # what was thought, what it says, and what the others say
    design: SequentialDesign,
    before: Busbar,
    reported: Floats,
    heard: Bools,
    v0_squared: Floats,
    variance: Floats,
    allowed: float,
) -> Busbar:
    """Compare what a meter that is not believed reports with what the meters say.

    It is named when it still differs from them after as many ticks as evidence has to last, by more than all
    of them could honestly be off alike. It is believed again once the mean over the scale on which it was
    caught has been within what is expected of an honest one for as long as that scale, and for as long as any
    meter has to.

    Parameters
    ----------
    design, before
        The design, and what was thought of it.
    reported, heard : (b,)
        Its squared voltages, and where there are any, pu.
    v0_squared, variance : (b,)
        What the meters say, and the variance of that on the scale on which it was caught.
    allowed
        Largest honest fixed error of a meter, squared pu.
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

"""Test of the busbar's meter by all others.

The busbar's error b is in every residual of its phase as -b. With d one at the meters of the phase and zero
elsewhere, an unknown busbar error lowers the chi-square by

    z^2 = (d^T Q m)^2 / (d^T Q d),

and z is its leave-one-out residual in standard deviations: Q contains its honest error. Where z is beyond
chance, and, without suspects, beyond honest errors of one direction at their ends, the likeliest hypothesis
with a manipulated busbar meter is compared with those without (`gridsec.estimators.sequential.identify`). If
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
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.error_bounds import PowerErrors
from gridsec.estimators.sequential.posterior import LeaveOneOut, Posterior


@dataclass(frozen=True, slots=True, eq=False)
class BusbarTrust:
    """Trust of the busbar's meter. b phases, 1 on a balanced feeder."""

    trusted: Bools  # (b,) its voltage is used
    scale: Ints  # (b,) scale of the detection
    ticks_suspect: Ints  # (b,) ticks without trust
    ticks_agreeing: Ints  # (b,) successive ticks of agreement; negative after a restart: ticks owed
    off: Floats  # (b,) excess of its reading, mean over the scale, squared pu
    named: Bools  # (b,) named as manipulated

    def suspect(self, phase: int, scale: int) -> BusbarTrust:
        """Trust without one phase, detected on a scale."""
        here = np.arange(self.trusted.size) == phase
        return replace(self, trusted=self.trusted & ~here, scale=np.where(here, scale, self.scale))


def trusted_busbar(phases: int) -> BusbarTrust:
    """All phases trusted."""
    zero, no = np.zeros(phases, dtype=np.intp), np.zeros(phases, dtype=np.bool_)
    return BusbarTrust(~no, zero, zero, zero, np.zeros(phases), no)


@dataclass(frozen=True, slots=True, eq=False)
class BusbarTest:
    """Limits of the test. p meters, b phases."""

    sigmas: float  # standard deviations within chance
    model: Floats  # (p,) largest model error, squared pu
    metered: Bools  # (b,) busbar voltage is metered and trusted


def contradicted_phases(
    design: SequentialDesign, doubt: BusbarTest, now: Posterior, loo: LeaveOneOut
) -> list[int]:
    """Phases of the busbar with a meter that the trusted ones contradict beyond chance."""
    # Weights are zero where no meter is trusted.
    along, form = np.abs(loo.weights @ design.busbar_incidence), busbar_weights(design, now)
    chance = doubt.sigmas * np.sqrt(form)
    if all_of(along <= chance):
        return []
    # The model may err at all meters in the worst direction: more than `form` where weights differ in sign.
    at, Q = now.precision()
    reach = np.abs(Q @ design.busbar_incidence[at]).sum(axis=0)
    return np.flatnonzero(doubt.metered & (along > chance + doubt.model.max() * reach)).tolist()


def busbar_weights(design: SequentialDesign, now: Posterior) -> Floats:
    """d^T Q d of every phase of the busbar, (b,); cached in the posterior."""
    if now.busbar_weights is None:
        at, Q = now.precision()
        hangs = design.busbar_incidence[at]
        now.busbar_weights = np.einsum("ij,ij->j", hangs, Q @ hangs)
    return now.busbar_weights


@dataclass(frozen=True, slots=True, eq=False)
class HonestErrors:
    """Bounds of honest errors other than the meters'. m inverters."""

    powers: PowerErrors  # power errors of the frame
    injected: Floats  # (m,) largest errors of the observed injections, pu


def explained_phases(
    design: SequentialDesign, now: Posterior, m: Floats, fixed: Floats, honest: HonestErrors
) -> Bools:
    """Phases where honest errors at their ends, all in one direction, explain the test, (b,).

    The trusted meters give ``v^T m`` of the busbar, with ``v = Q d / (d^T Q d)``. Honest errors change it by
    at most

        |2 v^T R| dp + 2 |v^T X| dq + |v|^T (fixed + jitter) + error of the busbar's meter.

    fixed: (p,) largest honest fixed error of each meter and of the model, squared pu.
    """
    at, Q = now.precision()
    v = Q @ design.busbar_incidence[at] / np.maximum(busbar_weights(design, now), np.finfo(np.float64).tiny)
    error = busbar_errors(design.plant, honest.powers.v0_squared, design.sigmas[0])
    return np.abs(m[at] @ v) <= largest_sums(design, at, v, fixed, honest) + error


def largest_sums(
    design: SequentialDesign, at: Ints, v: Floats, fixed: Floats, honest: HonestErrors
) -> Floats:
    """Largest sums ``v^T m`` over honest errors at their ends, (k,), squared pu.

        |2 v^T R| dp + 2 |v^T X| dq + |v|^T (fixed + jitter)

    at: (t,) meters. v: (t, k) weights. fixed: (p,) as in `explained_phases`.
    """
    plant = design.plant
    injected = plant.droop.per_customer(honest.injected, design.customers)
    errors = np.concatenate(honest.powers.errors(plant, injected))
    out = np.abs(v).T @ (fixed + design.sigmas[0] * np.sqrt(design.white))[at]
    for k, one in enumerate(v.T):
        out[k] += np.abs(design.sensitivities.weighted(plant.meters[at], one)) @ errors
    return np.asarray(out)


def track_busbar(  # noqa: PLR0917
    design: SequentialDesign,
    before: BusbarTrust,
    reported: Floats,
    available: Bools,
    v0_squared: Floats,
    variance: Floats,
    allowed: float,
) -> BusbarTrust:
    """Compare the reading of a suspect busbar meter with the other meters.

    It is named if it differs for the confirmation time by more than an honest offset of all meters. It is
    trusted again once the mean over its scale stays within the release limit for that scale, and for the
    release time of any meter. reported, available: (b,) its squared voltages, pu, and where it has one.
    v0_squared, variance: (b,) by the other meters. allowed: largest honest fixed error, squared pu.
    """
    out = ~before.trusted
    if not any_of(out):
        return before
    length = np.array(design.lengths)[before.scale]
    age = before.ticks_suspect + out
    off = np.where(available, reported - v0_squared, before.off)
    off = before.off + (off - before.off) / np.clip(age, 1, length)
    std = np.sqrt(variance + design.busbar**2 + design.busbar_noise)
    limit = design.options.lower * np.array(design.sigmas)[before.scale] * std
    agrees = out & available & (np.abs(off) <= limit)
    quiet = np.where(available, (before.ticks_agreeing + 1) * agrees, before.ticks_agreeing)
    lasts = out & available & (age >= design.confirmed[before.scale]) & (np.abs(off) > allowed + limit)
    still = out & (quiet < np.maximum(design.options.release, length))
    return BusbarTrust(
        trusted=~still,
        scale=before.scale,
        ticks_suspect=np.where(still, age, 0),
        ticks_agreeing=np.where(still, quiet, 0),
        off=np.where(still, off, 0.0),
        named=still & (before.named | lasts),
    )

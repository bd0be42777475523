"""Uncertainty of the frames beyond that of the design, and the resulting prior of each scale.

A mean over several ticks contains residuals of all of them. On each scale a power is therefore as uncertain
as at the worst of its ticks, and the busbar is known only if it is metered at all of them
(docs/theory-sequential.md, section 1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.inputs import usual
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.load_uncertainty import EXACT, UNMETERED, prior
from gridsec.estimators.sequential.posterior import Prior
from gridsec.interface import Frame, PowerOrigin


@dataclass(frozen=True, slots=True, eq=False)
class FrameUncertainty:
    """Uncertainty of the frames beyond that of the design. N customers, p meters, s scales, b busbar phases.

    A `_ticks` field counts the consecutive ticks for which the better state of its field would hold.
    """

    p: Floats  # (s, N) factors on the design's standard deviations: exact where withheld, else powers of 2
    q: Floats  # (s, N) likewise
    p_ticks: Ints  # (s, N)
    q_ticks: Ints  # (s, N)
    p_next: Floats  # (s, N) largest factor needed within these ticks
    q_next: Floats  # (s, N)
    busbar: Bools  # (s, b) a busbar voltage at all ticks of the scale
    busbar_ticks: Ints  # (s, b)
    priors: tuple[Prior, ...]  # (s,) resulting priors
    sizes: Floats  # (k,) standard deviation of each fault, pu: false powers as large as the claims
    vouched: Bools  # (s, p) no residual of the mean lacks a usable active power of the meter's customer
    vouched_ticks: Ints  # (s, p)
    read: Bools  # (s, p) as `vouched`, with late powers as readings
    read_ticks: Ints  # (s, p)
    before_silence: FrameUncertainty | None = (
        None  # while no meter reports: the uncertainty at the last report
    )


def nominal(design: SequentialDesign) -> FrameUncertainty:
    """Uncertainty of the design."""
    scales, phases = len(design.lengths), design.busbar_incidence.shape[1]
    one, never = np.ones((scales, design.customers)), np.zeros((scales, design.customers), dtype=np.intp)
    known, unbroken = np.ones((scales, phases), dtype=np.bool_), np.zeros((scales, phases), dtype=np.intp)
    priors, meters = (design.prior,) * scales, design.plant.meters.size
    vouched, calm = np.ones((scales, meters), dtype=np.bool_), np.zeros((scales, meters), dtype=np.intp)
    sizes = design.faults.std
    return FrameUncertainty(
        one, one, never, never, one, one, known, unbroken, priors, sizes, vouched, calm, vouched, calm
    )


_WIDER = 4.0
"""Ratio of a frame's uncertainty to the design's beyond which it is used, unless a power is withheld."""
_SAME_RATIO = 1.0 + 1e-9
"""Ratio up to which two uncertainties differ by rounding only."""
_LEAST_EFFECT = 0.5
"""Part of the accuracy class by which late or excessive powers must be able to move a voltage to count."""
_COMMON_SHARE = 0.5
"""Common share of the variance of unread powers."""


def update_uncertainty(
    design: SequentialDesign, before: FrameUncertainty, frame: Frame, available: Bools, busbar: Bools | bool
) -> FrameUncertainty:
    """Uncertainty of this frame and of the residuals in the means.

    Without any reading, (p,) `available`, no residual is made: at the next reading the uncertainty before
    counts again. busbar: a trusted busbar voltage; (3,) in three phases.
    """
    last = before if before.before_silence is None else before.before_silence
    if any_of(available):
        return _updated(design, last, frame, available, busbar)
    found = _updated(design, before, frame, available, busbar)
    return found if found.before_silence is last else replace(found, before_silence=last)


def checked(design: SequentialDesign, frame: Frame) -> Bools:
    """Meters with an active power known about as well as the design supposes, (p,)."""
    meters = design.plant.meters
    if frame.p_origin is None:
        return np.ones(meters.size, dtype=np.bool_)
    origins = frame.p_origin[meters]
    if not any_of(origins):
        return np.ones(meters.size, dtype=np.bool_)
    least = np.where(origins == PowerOrigin.UNREAD, _SAME_RATIO, _WIDER)
    wide = frame.p_error[meters] > least * design.doubt.even_p[meters]
    return np.asarray((origins == PowerOrigin.READ) | ~wide)


def _withheld(design: SequentialDesign, frame: Frame, available: Bools) -> tuple[Bools | None, Bools | None]:
    """Meters with a voltage and no usable active power of its moment; those without a late one; (p,) or None.

    A late power, or one beyond the declared range, counts if all of these together can move the voltage at
    its meter by `_LEAST_EFFECT` of the accuracy class.
    """
    meters = design.plant.meters
    if frame.p_origin is None or not any_of(frame.p_origin[meters]):
        return None, None
    origins, out = frame.p_origin[meters], available & ~checked(design, frame)
    doubted = out & (origins != PowerOrigin.UNREAD)
    if any_of(doubted):
        power = np.where(_customers(design, doubted), frame.p_error, 0.0)
        moved = design.plant.feeder.reach(power, np.zeros_like(power))[design.prior.meters]
        out = out & ~(doubted & (moved <= _LEAST_EFFECT * design.allowed))
    unread = out & (origins != PowerOrigin.LATE)
    return out if any_of(out) else None, unread if any_of(unread) else None


def _updated(
    design: SequentialDesign, before: FrameUncertainty, frame: Frame, available: Bools, busbar: Bools | bool
) -> FrameUncertainty:
    """Uncertainty with this frame; new priors only where factors changed."""
    # Intervals in units of the design's standard deviations.
    frame, lengths = usual(frame), design.lengths
    withheld, unread = _withheld(design, frame, available)
    exact = None if unread is None else _customers(design, unread)
    p, p_calm, p_rest = _factors(
        frame.p_error, design.doubt.even_p, (before.p, before.p_ticks, before.p_next), lengths, exact
    )
    q, q_calm, q_rest = _factors(
        frame.q_error, design.doubt.even_q, (before.q, before.q_ticks, before.q_next), lengths, exact
    )
    sizes = _claim_sizes(np.abs(frame.p), design.options.hidden_power, before.sizes)
    metered, calm = _known_scales(busbar, before.busbar, before.busbar_ticks, lengths)
    before = _update_checks(before, withheld, unread, lengths)
    if metered is before.busbar and p is before.p and q is before.q:
        return before if sizes is before.sizes else replace(before, sizes=sizes)
    same = np.ones(len(lengths), dtype=np.bool_)
    for new, old in ((p, before.p), (q, before.q), (metered, before.busbar)):
        if new is not old:
            same &= (new == old).all(axis=1)
    if all_of(same):
        return replace(
            before,
            sizes=sizes,
            p_ticks=p_calm,
            q_ticks=q_calm,
            p_next=p_rest,
            q_next=q_rest,
            busbar_ticks=calm,
        )
    priors: list[Prior] = []
    for s, known in enumerate(before.priors):
        if same[s]:
            priors.append(known)
            continue
        # Scales with equal factors share a prior.
        parts = (p, q, metered, before.read)
        shared = (k for k in range(s) if all(np.array_equal(of[k], of[s]) for of in parts))
        k = next(shared, None)
        priors.append(_prior(design, p[s], q[s], metered[s], before.read[s]) if k is None else priors[k])
    return replace(
        before,
        p=p,
        q=q,
        p_ticks=p_calm,
        q_ticks=q_calm,
        p_next=p_rest,
        q_next=q_rest,
        busbar=metered,
        busbar_ticks=calm,
        priors=tuple(priors),
        sizes=sizes,
        before_silence=None,
    )


def _update_checks(
    before: FrameUncertainty, withheld: Bools | None, unread: Bools | None, lengths: tuple[int, ...]
) -> FrameUncertainty:
    """Uncertainty with `vouched` and `read` of this tick."""
    if withheld is None and all_of(before.vouched):
        return before
    vouched, vouched_calm = _known_scales(
        True if withheld is None else ~withheld, before.vouched, before.vouched_ticks, lengths
    )
    read, read_calm = _known_scales(
        True if unread is None else ~unread, before.read, before.read_ticks, lengths
    )
    return replace(before, vouched=vouched, vouched_ticks=vouched_calm, read=read, read_ticks=read_calm)


def _customers(design: SequentialDesign, meters: Bools) -> Bools:
    """Customers of some meters, (N,)."""
    out = np.zeros(design.customers, dtype=np.bool_)
    out[design.plant.meters] = meters
    return out


def _prior(design: SequentialDesign, p: Floats, q: Floats, busbar: Bools, read: Bools) -> Prior:
    if all_of(busbar) and all_of(p == 1.0) and all_of(q == 1.0):
        return design.prior
    unknown = np.where(busbar, design.busbar, UNMETERED)
    together = design.doubt.together
    if not all_of(read):
        # Unread powers are low together by night, with a meter as without.
        unread = (p > 1.0) & _customers(design, ~read)
        together = np.where(unread, np.maximum(together, _COMMON_SHARE), together)
    doubt = replace(
        design.doubt,
        together=together,
        p=np.where(p > 1.0, np.maximum(design.doubt.p, EXACT) * p, design.doubt.p),
        q=np.where(q > 1.0, np.maximum(design.doubt.q, EXACT) * q, design.doubt.q),
    )
    return prior(
        design.plant.feeder,
        design.prior.meters,
        doubt,
        busbar=unknown if unknown.size > 1 else float(unknown[0]),
        inverters=design.injections,
    )


def _claim_sizes(power: Floats, least: float, before: Floats) -> Floats:
    """Standard deviations of false powers: the claims in powers of two, with hysteresis."""
    old = before[: power.size]
    fine = (power <= old) & ((old <= least) | (4.0 * power >= old))
    if all_of(fine):
        return before
    new = np.where(fine, old, np.exp2(np.ceil(np.log2(np.maximum(power, least)))))
    return np.concatenate([new, before[power.size :]])


def _known_scales(
    busbar: Bools | bool, old: Bools, calm: Ints, lengths: tuple[int, ...]
) -> tuple[Bools, Ints]:
    """Scales without a residual made while the busbar was unknown, and the ticks since."""
    now = np.asarray(busbar)
    if all_of(now) and all_of(old):
        return old, calm
    known = now & (old | (calm + 1 >= np.array(lengths)[:, None]))
    return known, np.where(now & ~known, calm + 1, 0)


def _factors(
    error: Floats,
    known: Floats,
    before: tuple[Floats, Ints, Floats],
    lengths: tuple[int, ...],
    exact: Bools | None,
) -> tuple[Floats, Ints, Floats]:
    """Factors held while the means contain residuals made with larger ones, then the largest since."""
    old, calm, rest = before
    new = _factor(error, known, old, exact)
    if new is old:
        return before
    lower = new < old
    rest = np.where(lower, np.maximum(rest, new), 1.0)
    falls = lower & (calm + 1 >= np.array(lengths)[:, None])
    held = lower & ~falls
    after = np.where(held, old, np.where(falls, rest, new))
    return after, np.where(held, calm + 1, 0), np.where(held, rest, 1.0)


def _factor(error: Floats, known: Floats, old: Floats, exact: Bools | None) -> Floats:
    """Factor by which a frame knows a power less well than the design assumes, with hysteresis.

    The ratio itself where `exact`, else a power of two.
    """
    if exact is None and all_of(error <= _WIDER * known) and all_of(old <= 1.0):
        return old
    ratio = error / known
    keep = (ratio <= old * _WIDER) & (ratio * _WIDER >= old) & (old > _WIDER)
    raised = np.exp2(np.ceil(np.log2(np.maximum(ratio, 1.0))))
    new = np.where(keep, old, np.where(ratio > _WIDER, raised, 1.0))
    if exact is None:
        return new
    # A forecast states its own standard deviation; rounding it up would widen more than is stated.
    near = (ratio <= _SAME_RATIO * old) & (ratio * _WIDER >= old) & (old > 1.0)
    return np.where(exact, np.where(near, old, np.where(ratio > _SAME_RATIO, ratio, 1.0)), new)

"""One switched observer that searches for another set of meters when its own test fails.

kim2018 and lee2018, chapter 5, do not run an observer for every set. They trust one set of meters while
all of its readings agree with its estimate, and search for another one only if they do not:

1. *One observer.* Inverters with a trusted meter are driven by that meter's reading, all others by the
   model; the set may change at any moment (`gridsec.certificates`).
2. *Test.* `|y_j - yhat_j| <= threshold_j(t)` for every trusted meter j. The threshold is the worst case of
   `gridsec.detect` for exactly this set. After a switch it starts from the saturation bound and falls as the
   transient of the observer decays.
3. *Search.* If the test fails, every set D of at most M dropped meters is tried, the smallest first, and
   among equals the one with the smallest residuals. D passes if all other meters are within `threshold_j(D)`,
   which uses only their own readings: an inverter with a meter in D, or without one, may be anywhere within
   saturation. Named meters stay dropped as long as possible.
4. *Dwell.* A dropped meter is trusted again once it was within its limit for a time Delta, and for `release`
   consecutive readings.

If at most M meters are manipulated, they are one of the sets that pass. So a meter in *every* passing set is
manipulated, and only such meters are named. If several smallest sets pass, all of them are given as
explanations, and no meter outside one of them is named.

The papers' sets have partial observers of their own, with estimates that can be compared at once. Here a
candidate is judged by the injections that its members' readings alone imply, which needs no observer.
Metered net reactive power is not used: that of a dropped meter would have to be removed, too.

References
----------
kim2018, section III.D, Theorem 2; lee2018, section 5.4, Theorem 5.4.3; docs/theory-high-gain.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec import detect
from gridsec.arrays import Bools, Floats
from gridsec.detect import ErrorBound
from gridsec.families.switched import (
    SetSearchDesign,
    SetSearchState,
    View,
    advance,
    design,
    driven_by,
    init,
    lost,
    threshold_of,
)
from gridsec.frames import Inputs, Past, clean, known, nothing_new
from gridsec.judge import Situation, Tally, count, decide
from gridsec.online import Cause, Decision, Estimate, Explanation, Frame, Verdict

__all__ = ["SetSearchDesign", "SetSearchState", "design", "init", "step"]


def step(
    design: SetSearchDesign, state: SetSearchState, frame: Frame
) -> tuple[SetSearchState, Estimate, Verdict]:
    """Process one frame.

    Parameters
    ----------
    frame
        Data of one tick. A frame that is not later than the last one changes nothing: it returns the last
        estimate and UNDECIDED.

    Returns
    -------
    SetSearchState, Estimate, Verdict
        As every estimator's step; see `gridsec.online`.
    """
    if not np.isfinite(frame.t) or (state.bank is not None and not frame.t > state.t):
        plant = design.setting.plant
        return state, *nothing_new(plant, frame, state.t, state.last, state.v0_squared, state.x)
    frame = known(frame)
    inputs = clean(design.setting, Past(state.x, state.v0_squared, state.tally.named), frame)
    view = advance(design, state, frame, inputs)
    found = _Found(state.dropped, view.over & ~state.dropped, (), False)
    unsure = view.over & state.dropped & ~state.tally.named
    if (view.over & ~state.dropped).any() or unsure.any():
        found = _search(design, inputs, view, state)
    return _conclude(design, state, frame, inputs, view, found)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Result of a search. p meters."""

    dropped: Bools  # (p,) meters not to trust
    accused: Bools  # (p,) meters that are certainly manipulated
    rivals: tuple[Bools, ...]  # several smallest sets
    torn: bool  # no set passes


def _search(design: SetSearchDesign, inputs: Inputs, view: View, state: SetSearchState) -> _Found:
    """Test all sets of at most M dropped meters by the injections that their own readings imply."""
    errors, at, live = design.errors, design.setting.plant.meters, inputs.live
    sets = design.dropped[~(design.dropped & ~live).any(axis=1)]
    error = (view.base + errors.inverters @ view.sure)[at] + sets @ lost(errors, view.sure)[at].T
    limit = threshold_of(design, view.v2[at], error)
    excess = np.where(live & ~sets, np.nan_to_num(view.score) / limit, 0.0).max(axis=1, initial=0.0)
    fine = np.flatnonzero(excess <= 1.0)
    if not fine.size:
        return _Found(state.dropped, np.zeros_like(live), (), True)
    accused = np.asarray(sets[fine].all(axis=0))
    known = fine[(sets[fine] >= (state.tally.named & live)).all(axis=1)]
    pool = known if known.size else fine
    sizes = sets[pool].sum(axis=1)
    smallest = pool[sizes == sizes[0]]
    best = sets[smallest[np.argmin(excess[smallest])]]
    rivals = tuple(sets[smallest]) if smallest.size > 1 else ()
    # A missing reading does not clear a meter: dropped and unavailable meters stay dropped.
    return _Found(best | (state.dropped & ~live), accused, rivals, False)


def _conclude(  # noqa: PLR0917  # design, state and frame, then the results of this step
    design: SetSearchDesign, state: SetSearchState, frame: Frame, inputs: Inputs, view: View, found: _Found
) -> tuple[SetSearchState, Estimate, Verdict]:
    options, live = design.setting.options, inputs.live
    held = state.tally.named & view.over & found.dropped
    accused = found.accused | held
    tally = count(state.tally, accused, live, confirm=options.confirm, release=options.release)
    quiet = found.dropped & live & ~view.over
    innocent = np.where(quiet, np.minimum(state.innocent, frame.t), np.where(live, np.inf, state.innocent))
    readings = np.where(quiet, state.readings + 1, np.where(live, 0, state.readings))
    back = quiet & (frame.t - innocent >= design.dwell_s) & (readings >= options.release)
    dropped = found.dropped & ~back
    tally = replace(tally, named=tally.named & dropped, above=np.where(back, 0, tally.above))
    switched = bool((dropped & ~state.dropped).any())
    # Effect of an attack on the meter's own inverter and, through the model, on those without a trusted
    # meter.
    driven = driven_by(design, live & ~dropped)
    free = np.where(driven, view.bound.free, design.errors.span)
    estimate = Estimate(
        frame.t, view.v2, _error(design, view, found.torn), view.v2_bus, live & ~dropped, view.x
    )
    verdict = _verdict(design, inputs, view, found, tally, dropped, switched)
    after = SetSearchState(
        t=frame.t,
        bank=view.bank,
        x=view.x,
        z=view.z,
        y=np.where(live, inputs.z, np.nan),
        bound=ErrorBound(view.sure, free) if switched else view.bound,
        level=detect.widest(design.errors) if switched else view.level,
        sure=view.sure,
        settled=view.settled and not switched,
        dropped=dropped,
        innocent=np.where(dropped, innocent, np.inf),
        readings=np.where(dropped, readings, 0),
        tally=tally,
        v0_squared=inputs.v0_squared,
        last=(estimate, verdict),
    )
    return after, estimate, verdict


def _error(design: SetSearchDesign, view: View, torn: bool) -> Floats:
    """Half-width of the estimate for any M manipulated meters, detected or not; (N,)."""
    errors = design.errors
    if torn:
        return np.asarray(view.base + errors.inverters @ errors.span)
    most = detect.largest(lost(errors, view.sure), design.setting.max_attacked)
    return np.asarray(view.base + errors.inverters @ view.sure + most)


def _verdict(  # noqa: PLR0917  # all results of one tick
    design: SetSearchDesign,
    inputs: Inputs,
    view: View,
    found: _Found,
    tally: Tally,
    dropped: Bools,
    switched: bool,
) -> Verdict:
    plant, live = design.setting.plant, inputs.live
    decision, cause, reason = decide(
        Situation(
            names=tuple(plant.feeder.customers[c] for c in plant.meters),
            max_attacked=design.setting.max_attacked,
            live=live,
            suspected=(tally.above > 0) | dropped,
            named=tally.named,
            wide=live & ~(view.threshold <= design.setting.options.widest),
            valid=True,
            settled=view.settled and not switched,
            busbar=inputs.busbar,
        )
    )
    if found.torn and cause not in {Cause.TOO_FEW_METERS, Cause.NO_BUSBAR}:
        decision, cause = Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS
        reason = (
            f"Without any {design.setting.max_attacked} meters, the others contradict each other: "
            "more are manipulated, or the busbar reading, a switch or a line in the model is wrong."
        )
    attack = np.where(tally.named & live, inputs.y - view.v2[plant.meters], 0.0)
    none = np.zeros(plant.droop.tau.size, dtype=np.bool_)
    share = 1.0 / max(len(found.rivals), 1)
    return Verdict(
        decision,
        cause,
        reason,
        tally.named,
        view.score,
        view.threshold,
        attack,
        explanations=tuple(Explanation(meters, none, share) for meters in found.rivals),
    )

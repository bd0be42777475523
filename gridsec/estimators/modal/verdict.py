"""Answer of one tick: evidence of each meter, verdict with its reason, explanations.

**Score and threshold.** The detector sums over onsets and faults. The part of one meter at the likeliest
onset alone reaches the limit at

    s^2 y^2 / (2 (1 + s^2 F)) - log(1 + s^2 F) / 2 >= log gamma - log(weight capital / p),

y and F being its score and its information. The score shown is the amount ``|y| / F``, the threshold the
amount at equality. The sum may reach the limit before any of its parts does. For a masked meter the score is
the distance of its reading from the filter without it, the threshold that of the release. Both are evaluated
where they are asked for.

**Decision.** ATTACKED: a meter is named, an inverter, or the busbar's meter. UNDECIDED: log M was beyond the
limit since the suspected onset, and nothing is named; a metered reactive power leaves its curve; too few
meters; unread powers that leave a voltage too uncertain. CLEAN: none of these.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf, log, sqrt
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack

from gridsec.arrays import PENDING, Bools, Floats, all_of, any_of, deferred, indices, submatrix
from gridsec.estimators.detection import AGREEMENT, DecisionInputs, decide
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.device_checks import probability
from gridsec.estimators.front.measurements import ClockSkew
from gridsec.estimators.front.output import (
    Finding,
    busbar_deviation,
    busbar_meter,
    explanations_sentence,
    fault_sentence,
    imprecise,
    unvouched,
    with_clock_offsets,
)
from gridsec.estimators.modal import detector, full, masking, signatures
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.core import Core, CoreState, Suspicion
from gridsec.estimators.modal.costs import amounts
from gridsec.estimators.modal.detector import SIZE, WEIGHTS, Evidence, Tick
from gridsec.estimators.modal.doubts import Unknown, skewed
from gridsec.estimators.modal.filter import Interval
from gridsec.estimators.modal.signatures import Onsets
from gridsec.estimators.modal.static import Static
from gridsec.estimators.plant import NO_VOLTAGE
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, Verdict

LIKELY = 0.01
"""Weight from which on an explanation is reported, 1."""
SHOWN = 20
"""Largest number of reported explanations."""


@dataclass(frozen=True, slots=True, eq=False)
class MeterEvidence:
    """Evidence of the meters. p meters.

    Attributes
    ----------
    tested : (p,)
        Meters that a single reading would show within the widest threshold.
    amounts
        Score and threshold, (p,) each, as in `gridsec.interface.Verdict`, evaluated where asked for.
    """

    tested: Bools
    amounts: Callable[[], tuple[Floats, Floats]] = field(repr=False)


def meter_evidence(  # noqa: PLR0917  # the core, one tick, and one limit
    core: Core,
    state: CoreState,
    evidence: Evidence,
    now: tuple[Floats, Bools],
    widest: float,
    suspicion: Suspicion | None,
) -> MeterEvidence:
    """Evidence of every meter at the likeliest onset.

    Parameters
    ----------
    core, state, evidence
        The core, the state after a tick, and the answer of that tick.
    now : (p,), (p,)
        Residuals and meters with a reading.
    widest
        Widest threshold, squared pu.
    suspicion
        The explanations, if there are any.
    """
    made, test, (m, seen), update = core.modes, state.detector, now, state.update
    row = _row(state, evidence, suspicion)
    tested, enough = np.zeros(seen.size, dtype=np.bool_), 2.0 * core.limit / widest**2
    if update is not None:
        least = detector.precision(made, None, update) if test.precision is None else test.precision
        tested = seen & (least.least >= enough)
        if np.count_nonzero(tested) < np.count_nonzero(seen):
            tested = seen & (least.exact(made, update) >= enough)
    if update is not None and update.seen is not None:
        # A meter released at this tick was not read.
        tested = tested | (seen & ~update.seen)
    masked = None
    if any_of(state.masked.meters) and state.filter.full is not None and update is not None:
        at, std, unknown = indices(state.masked.meters), np.zeros(seen.size), state.history.unknown
        off, P = masking.deviations(state.filter.full, update.exact, m, at, unknown)
        std[at] = np.sqrt(P.diagonal() + made.noise.diagonal()[at])
        masked = state.masked.meters, off, std
        tested = tested | (state.masked.meters & seen)
    one, capital = signatures.single(test.onsets, row), float(test.capital[0, row])
    return MeterEvidence(tested, _Amounts(core, one, test.waiting, state.static, capital, seen, masked))


@dataclass(frozen=True, slots=True, eq=False)
class _Amounts:
    """Score and threshold of every meter at one onset."""

    core: Core
    one: Onsets  # the onset by itself
    waiting: tuple[Tick, ...]  # ticks that it does not contain yet
    static: Static  # information about the directions
    capital: float  # its logarithm
    seen: Bools  # (p,) meters with a reading
    # masked meters, with the deviations of their readings from the filter, as their release has them
    masked: tuple[Bools, Floats, Floats] | None

    def __call__(self) -> tuple[Floats, Floats]:
        made, one = self.core.modes, self.one
        for tick in self.waiting:
            one = signatures.follow(made, one, tick.update, tick.static, tick.h)
        now = signatures.scores(made, one, self.static)
        y, F = (each[0] for each in now.of_members(made))
        F = np.maximum(F, _TINY)
        part = log(WEIGHTS[0] / made.size) + self.capital
        gain = 2.0 * (self.core.limit - part) + np.log1p(SIZE**2 * F)
        least = np.sqrt(np.maximum(gain, 0.0) * (1.0 + SIZE**2 * F)) / (SIZE * F)
        score, threshold = np.where(self.seen, np.abs(y) / F, np.nan), np.minimum(least, NO_VOLTAGE)
        if self.masked is None:
            return score, threshold
        out, off, std = self.masked
        return np.where(out & self.seen, np.abs(off), score), np.where(out, masking.OUTLIER * std, threshold)


class Answer(Verdict):
    """Verdict with score and threshold computed on first access."""

    __slots__ = ("_amounts",)
    _amounts: Callable[[], tuple[Floats, Floats]]

    @classmethod
    def later(
        cls,
        finding: Finding,
        suspects: Bools,
        amounts: Callable[[], tuple[Floats, Floats]],
        attack: Floats,
        **rest: Any,
    ) -> Answer:
        """Verdict with the function `amounts` of score and threshold, (p,) each; `rest` as in `Verdict`."""
        made = cls(*finding, suspects, PENDING, PENDING, attack, **rest)
        object.__setattr__(made, "_amounts", amounts)
        return made

    @deferred(Verdict)
    def score(self) -> Floats:
        """Residual of each meter, squared pu, (p,); NaN without a reading."""
        score, threshold = self._amounts()
        object.__setattr__(self, "threshold", threshold)
        return score

    @deferred(Verdict)
    def threshold(self) -> Floats:
        """Largest score of an honest meter, squared pu, (p,)."""
        score, threshold = self._amounts()
        object.__setattr__(self, "score", score)
        return threshold


NOW = Interval(0.0)
"""No time between the last tick and the readings."""


def deviations(core: Core, state: CoreState, m: Floats, gap: Interval = NOW) -> tuple[Floats, Floats]:
    """Deviation of every reading from the filter, and its standard deviation for a meter that is not read.

    With the interval to the next tick they are the innovations of that.

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    m : (p,)
        Residuals.
    gap
        Interval from that tick to the readings.
    """
    full, made, (rho, rho_b) = state.filter.full, core.modes, gap.decay(core.modes)
    if full is None:
        variance = (made.back * made.back) @ modal.predicted(made, state.filter.cov, rho, rho_b)[2]
        spread = made.back @ (_unlearned(state, rho, rho_b)[:, None] * made.directions)
        variance += np.einsum("jr,rs,js->j", spread, state.static.cov, spread)
    else:
        w, both, b = (each.diagonal() for each in full.blocks)
        variance = rho * rho * w + 2.0 * rho * rho_b * both + rho_b * rho_b * b + made.noise.diagonal()
        variance += (1.0 - rho * rho) * made.covariance_w.diagonal()
        variance += (1.0 - rho_b * rho_b) * made.covariance_b.diagonal()
    return offsets(core, state, m, gap), np.sqrt(variance)


def offsets(core: Core, state: CoreState, m: Floats, gap: Interval = NOW) -> Floats:
    """Deviation of every reading from the filter, (p,).

    Parameters
    ----------
    core, state, m, gap
        As in `deviations`.
    """
    full, made, (rho, rho_b) = state.filter.full, core.modes, gap.decay(core.modes)
    if full is not None:
        return np.asarray(m - rho * full.mean[0] - rho_b * full.mean[1])
    w, b = state.filter.mean
    mean = rho * w + rho_b * b
    if made.sign.size:
        mean += _unlearned(state, rho, rho_b) * state.static.constant
    return np.asarray(m - made.back @ mean)


def _unlearned(state: CoreState, rho: float, rho_b: float) -> Floats:
    """Part of the constant amounts that the filter has not learned, (t,)."""
    g_w, g_b = state.static.signature
    return np.asarray(1.0 - rho * g_w - rho_b * g_b)


def _row(state: CoreState, evidence: Evidence, suspicion: Suspicion | None) -> int:
    """Row of the onset that is shown: the suspected one, the likeliest one, else the oldest one."""
    onsets = state.detector.onsets
    if suspicion is not None and onsets.used[suspicion.row]:
        return suspicion.row
    if evidence.log_m > -inf:
        of_meters = np.where(onsets.used, evidence.by_row[0], -inf)
        if of_meters.max() > -inf:
            return int(of_meters.argmax())
    return int((onsets.age * ~onsets.ramp).argmax())


# --- Explanations ---


def explanations(
    design: FrontDesign, core: Core, suspicion: Suspicion | None, uses_q: Bools
) -> tuple[Explanation, ...]:
    """Reported explanations, the likeliest first; sets that differ in the loads only are one.

    None where the best one does not explain the misfit.

    Parameters
    ----------
    design, core
        The front end, and the core.
    suspicion
        The explanations.
    uses_q : (N,)
        Customers with a metered reactive power in the model: there the report is wrong, not the inverter.
    """
    if suspicion is None or not suspicion.fits:
        return ()
    found, p = suspicion.found, core.modes.size
    owner, last = design.plant.droop.customer, design.customers
    powers, phases = core.faults.powers, design.busbar_incidence.shape[1]
    used = core.model.phases(core.modes.at).any(axis=0)
    # Inverters with a metered reactive power, and their customers' reports.
    metered = uses_q[owner]
    inverters, wrong = found.chosen[:, p + last : p + powers], found.chosen[:, p : p + last].copy()
    for inverter in np.flatnonzero(metered):
        # A customer may have several inverters.
        wrong[:, owner[inverter]] |= inverters[:, inverter]
    busbar = np.zeros((len(wrong), phases), dtype=np.bool_)
    busbar[:, used] = found.chosen[:, p + powers :]
    every = np.hstack([found.chosen[:, :p], inverters & ~metered, wrong, busbar])
    _, first, which = np.unique(np.packbits(every, axis=1), axis=0, return_index=True, return_inverse=True)
    total = np.bincount(which.ravel(), found.weight)
    likely = sorted(np.flatnonzero(total >= LIKELY).tolist(), key=lambda k: (-total[k], first[k]))
    parts = np.cumsum([p, owner.size, last])
    out = []
    for k in likely[:SHOWN]:
        meters, inverters, wrong, busbar = np.split(every[first[k]], parts)
        out.append(Explanation(meters, inverters, float(total[k]), wrong, busbar))
    return tuple(out)


def combined(
    rivals: tuple[Explanation, ...], cases: tuple[Explanation, ...], inverters: Bools
) -> tuple[Explanation, ...]:
    """Explanations of the voltages and of metered reactive powers together, the likeliest first.

    Both are taken for independent, though of the same residuals: probabilities multiply. Equal sets are one.

    Parameters
    ----------
    rivals, cases
        Explanations by the search, and open cases of metered reactive powers.
    inverters : (m,)
        Inverters that are named in any case.
    """
    none = np.zeros_like(inverters)
    if rivals and (cases or any_of(inverters)):
        together: dict[bytes, Explanation] = {}
        for one in rivals:
            for case in cases or (Explanation(one.meters, none, 1.0, one.powers),):
                meters, powers = one.meters | case.meters, one.powers | case.powers
                also = one.inverters | case.inverters | inverters
                key = meters.tobytes() + powers.tobytes() + also.tobytes() + one.busbar.tobytes()
                share = one.probability * case.probability
                share += together[key].probability if key in together else 0.0
                together[key] = replace(one, meters=meters, powers=powers, inverters=also, probability=share)
        return tuple(sorted(together.values(), key=lambda each: -each.probability))
    return rivals if len(rivals) > 1 else cases


def certain_inverters(design: FrontDesign, core: Core, suspicion: Suspicion, uses_q: Bools) -> Bools:
    """Inverters without which nothing explains the readings, (m,).

    Parameters
    ----------
    design, core, suspicion, uses_q
        As in `explanations`.
    """
    found, first = suspicion.found, core.modes.size + design.customers
    certain = found.certain[first : core.modes.size + core.faults.powers]
    return np.asarray(certain & ~uses_q[design.plant.droop.customer])


def inverter_amounts(design: FrontDesign, core: Core, suspicion: Suspicion | None) -> Floats:
    """Injections beyond the curves in the likeliest explanation, (m,), pu."""
    out = np.zeros(design.plant.droop.tau.size)
    if suspicion is not None and suspicion.found.chosen[0].any():
        found, first = suspicion.found, core.modes.size + design.customers
        at = np.flatnonzero(found.chosen[0])
        mean, _ = amounts(found.problems[int(found.model[0])], found.chosen[0])
        inside = (at >= first) & (at < core.modes.size + core.faults.powers)
        out[at[inside] - first] = mean[inside]
    return out


def accused(core: Core, suspicion: Suspicion) -> Bools:
    """Meters that a likely explanation accuses, (p,)."""
    found = suspicion.found
    return np.asarray(found.chosen[found.weight >= LIKELY, : core.modes.size].any(axis=0))


def bounding(
    core: Core, state: CoreState, suspicion: Suspicion | None, metered: Bools | bool
) -> Bools | bool:
    """Phases of the busbar with a reading that bounds the voltages, (b,): none that may be manipulated.

    While an onset is pinned and no explanation is there, none bounds them.

    Parameters
    ----------
    core, state, suspicion
        The core, the state after a tick, and the explanations, if there are any.
    metered : (b,)
        Phases with a reading in use.
    """
    if suspicion is None:
        return np.zeros_like(metered) if any_of(state.detector.pinned) else metered
    found, first = suspicion.found, core.modes.size + core.faults.powers
    some = core.modes.model.phases(core.modes.at).any(axis=0)
    out = np.zeros(some.size, dtype=np.bool_)
    out[some] = found.weight @ found.chosen[:, first:] >= LIKELY
    return np.asarray(metered & ~out)


def certain_phases(core: Core, suspicion: Suspicion) -> Bools:
    """Phases of the busbar that nothing replaces in explanations, (b,); b counts those with a meter.

    Parameters
    ----------
    core, suspicion
        The core, and the explanations.
    """
    found, first = suspicion.found, core.modes.size + core.faults.powers
    return np.asarray(found.certain[first:] & ~suspicion.contested[first:])


def share(  # noqa: PLR0917  # the core, and one report
    design: FrontDesign, core: Core, state: CoreState, j: int, a: float, uses_q: bool
) -> tuple[float, float]:
    """Evidence of the voltages on meter j with a reactive power `a` beyond the curve, pu, as `Share`.

    With the report in the model, a false one is a fault of -a along the inverter's column, since any onset.
    Without it, a true report is a fault of a. The onset that suits the fault best decides. Where readings are
    missing, the information counts with the share of it that was read at this tick.
    """
    W, onsets = _column(design, core, j), detector.followed(core.modes, state.detector).onsets
    rows = np.flatnonzero(onsets.used & ~onsets.ramp)
    now = signatures.scores(core.modes, onsets, state.static, rows)
    y, F = now.of(W, W * W)
    update = state.update
    if update is not None and update.exact is not None:
        read, n = 0.0, update.exact.rows
        if n.size:
            felt, _ = lapack.dtrtrs(update.exact.half, core.modes.back[n] @ W, lower=True)
            read = float((felt * felt).sum())
        F = F * min(1.0, read / max(float(W[:, 0] ** 2 @ (1.0 / update.variance)), _TINY))
    fault = -a if uses_q else a
    gain = 2.0 * fault * y[:, 0] - fault * fault * F[:, 0]
    best = int(gain.argmax())
    # Deviation of the voltages if the inverter is right: with its own injection in the model.
    rest = y[best, 0] - fault * F[best, 0] if uses_q else y[best, 0]
    sigmas = float(abs(rest) / np.sqrt(max(F[best, 0], _TINY)))
    return probability(float(-gain[best] if uses_q else gain[best])), sigmas


def unreported(  # noqa: PLR0917  # the core, and one inverter
    design: FrontDesign,
    core: Core,
    state: CoreState,
    m: Floats,
    others: Callable[[], Unknown | None],
    sure: Bools,
    j: int,
    a: float,
) -> tuple[float, float]:
    """Evidence of the voltages of one tick on the inverter of meter j, `a` beyond its curve, pu, as `Share`.

    The filter does not learn the injection of a named inverter. Let u be the residuals less their means after
    the tick, V about their covariance without that injection, and c its column. Twice the logarithm of the
    ratio of likelihoods is ``2 a c' V^-1 u - a^2 c' V^-1 c``. The filter learns the injection of another
    inverter: while an onset is suspected, its voltages say nothing.

    Parameters
    ----------
    m : (p,)
        Residuals.
    others
        Directions that the frame leaves unknown where the named inverters follow their curves.
    sure : (p,)
        Meters of named inverters.
    """
    whole = state.filter.full or full.expanded(core.modes, state.filter, state.static)
    n = indices(whole.seen)
    if not n.size or (any_of(state.detector.pinned) and not sure[j]):
        return 0.5, 0.0
    u, c = (m - whole.mean[0] - whole.mean[1])[n], core.modes.back[n] @ _column(design, core, j)[:, 0]
    V, unknown = submatrix(core.modes.noise + whole.whole, n, n), others()
    if unknown is not None:
        V = V + unknown.wide[n] @ unknown.wide[n].T
    felt = cho_solve(cho_factor(V), c)
    y, F = float(felt @ u), max(float(felt @ c), _TINY)
    return probability(2.0 * a * y - a * a * F), abs(y) / sqrt(F)


def _column(design: FrontDesign, core: Core, j: int) -> Floats:
    """Column of the inverter of meter j in the modes, (t, 1)."""
    inverter = int(np.argmax(design.meter_of == j))
    return core.faults.W[:, [core.modes.size + design.customers + inverter]]


_TINY = float(np.finfo(np.float64).tiny)


# --- Verdict ---


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Inputs of a verdict. p meters, b phases of the busbar.

    Attributes
    ----------
    frame, skew
        The frame, and the changes of the voltages within clock offsets.
    seen, named, unread : (p,)
        Meters with a reading, named ones, and those with a reading that no known power checks.
    jumps, beyond : (p,)
        Readings that jump, and therefore drive no inverter, or did so a few ticks ago. Meters with an own
        error beyond their accuracy class.
    evidence
        Evidence of the meters.
    suspected
        log M was beyond its limit since the suspected onset.
    explanations, suspicion
        What explains it.
    settled
        The observer of the inverters has settled.
    inverters : (m,)
        Inverters named as manipulated.
    busbar, metered : (b,)
        Phases with a meter named as manipulated, and with a busbar voltage in use.
    busbar_off : (b,)
        Excess of the reading of a named phase, squared pu.
    """

    frame: Frame
    skew: ClockSkew | None = field(repr=False)
    seen: Bools
    named: Bools
    unread: Bools
    jumps: Bools
    beyond: Bools
    evidence: MeterEvidence
    suspected: bool
    explanations: tuple[Explanation, ...]
    suspicion: Suspicion | None = field(repr=False)
    settled: bool
    inverters: Bools
    busbar: Bools
    metered: Bools
    busbar_off: Floats

    @property
    def calm(self) -> bool:
        """True where all meters are read and tested, and nothing speaks against one."""
        if self.suspected or not self.settled or self.frame.clock_offset is not None:
            return False
        every = self.seen, self.evidence.tested, self.metered
        against = self.named, self.unread, self.jumps, self.beyond, self.inverters, self.busbar
        return all(map(all_of, every)) and not any(map(any_of, against))


def verdict(design: FrontDesign, now: Inputs, estimate: Estimate) -> Finding:
    """Decision, cause and sentence.

    Parameters
    ----------
    design
        The front end.
    now
        Inputs.
    estimate
        The estimate of the tick.
    """
    if now.calm:
        return AGREEMENT
    tested, narrow = now.seen, now.evidence.tested | now.unread
    if now.skew is not None and now.skew.single:
        # One reading after a sudden change: the next one tests the meter.
        narrow = narrow | skewed(design, now.skew)
    live = int(np.count_nonzero(tested))
    finding = decide(
        DecisionInputs(
            names=design.names,
            max_attacked=design.most_among(live),
            live=tested,
            suspected=np.zeros(tested.size, dtype=np.bool_),
            named=now.named,
            wide=tested & ~narrow,
            valid=True,
            settled=now.settled,
            busbar=True,
        )
    )
    if finding[0] is Decision.CLEAN:
        finding = unvouched(design, np.atleast_1d(now.metered), tested) or finding
    finding = _busbar(design, now, estimate, finding)
    if now.suspected:
        finding = _suspected(design, now, finding)
    finding = _doubted(design, now, finding)
    finding = _inverters(design, now, finding)
    if finding[1] in (Cause.AGREEMENT, Cause.SILENT_METERS):
        finding = imprecise(design, now.frame, now.unread & now.seen, estimate) or finding
    return with_clock_offsets(design, now.frame, tested, now.skew, finding)


def _busbar(design: FrontDesign, now: Inputs, estimate: Estimate, finding: Finding) -> Finding:
    """ATTACKED where the busbar's meter is named."""
    decision, cause, reason = finding
    if not any_of(now.busbar) or cause not in (
        Cause.AGREEMENT,
        Cause.RESIDUALS,
        Cause.SILENT_METERS,
        Cause.TOO_FEW_METERS,
    ):
        return finding
    v0 = estimate.v2_bus[design.plant.feeder.busbar_places()]
    off = busbar_deviation(now.busbar_off, v0, now.busbar)
    if cause is Cause.RESIDUALS:
        return decision, cause, f"{reason[:-1]}; and {busbar_meter(now.busbar)}."
    return Decision.ATTACKED, Cause.RESIDUALS, f"Manipulated: {busbar_meter(now.busbar)}; it {off}."


def with_open_cases(design: FrontDesign, finding: Finding, cases: tuple[Explanation, ...]) -> Finding:
    """UNDECIDED where a metered reactive power leaves its curve, and the voltages do not tell why."""
    decision, cause, reason = finding
    if not cases or cause not in (Cause.AGREEMENT, Cause.SILENT_METERS, Cause.RESIDUALS):
        return finding
    sentence = explanations_sentence(design, cases)
    if cause is Cause.RESIDUALS:
        return decision, cause, f"{reason} {sentence}"
    return Decision.UNDECIDED, Cause.AMBIGUOUS, sentence


def _inverters(design: FrontDesign, now: Inputs, finding: Finding) -> Finding:
    """ATTACKED where an inverter is named."""
    decision, cause, reason = finding
    if not any_of(now.inverters) or cause in (Cause.SETTLING, Cause.DESIGN_INVALID):
        return finding
    plant = design.plant
    owners = ", ".join(plant.feeder.customers[c] for c in plant.droop.customer[now.inverters])
    if decision is Decision.ATTACKED:
        return decision, cause, f"{reason} Manipulated, too: the inverters of {owners}."
    sentence = f"Manipulated: the inverters of {owners}; their reactive power is not that of their curves."
    return Decision.ATTACKED, Cause.RESIDUALS, sentence


def _suspected(design: FrontDesign, now: Inputs, finding: Finding) -> Finding:
    """UNDECIDED where the readings disagree and no meter is named; a sentence more where one is."""
    decision, cause, reason = finding
    if decision is Decision.ATTACKED:
        return decision, cause, f"{reason} The other meters, taken together, still disagree with the feeder."
    if cause not in (Cause.AGREEMENT, Cause.SILENT_METERS, Cause.SETTLING):
        return finding
    some = tuple(each for each in now.explanations if _accuses(each))
    if not some:
        sentence = "The meters, taken together, disagree with the feeder by more than chance."
        return Decision.UNDECIDED, Cause.MISFIT, sentence
    if (
        len(some) == 1
        and not some[0].meters.any()
        and some[0].powers.sum() + some[0].inverters.sum() == 1
        and now.suspicion is not None
    ):
        sentence = _one_power(design, now.suspicion, some[0])
        if sentence:
            return Decision.UNDECIDED, Cause.AMBIGUOUS, sentence
    if len(some) == 1:
        parts = explanations_sentence(design, some).removesuffix("; nothing else explains the readings.")
        return Decision.UNDECIDED, Cause.AMBIGUOUS, f"{parts}, or loads that no reading shows."
    return Decision.UNDECIDED, Cause.AMBIGUOUS, explanations_sentence(design, some)


def _doubted(design: FrontDesign, now: Inputs, finding: Finding) -> Finding:
    """UNDECIDED where meters exceed their class, and where readings that jump drive no inverter.

    The unknown injections of such inverters may hide a manipulation.
    """
    if finding[1] not in (Cause.AGREEMENT, Cause.SILENT_METERS):
        return finding
    for which, sentence in (
        (now.beyond, "Constant errors exceed the accuracy class, or the feeder is not as in its files"),
        (now.jumps, "Readings jump and drive no inverter until they agree with the feeder again"),
    ):
        if any_of(which):
            meters = ", ".join(design.names[j] for j in np.flatnonzero(which))
            return Decision.UNDECIDED, Cause.MISFIT, f"{sentence}: {meters}."
    return finding


def _accuses(explanation: Explanation) -> bool:
    return any(
        map(any_of, (explanation.meters, explanation.inverters, explanation.powers, explanation.busbar))
    )


def _one_power(design: FrontDesign, suspicion: Suspicion, one: Explanation) -> str:
    """Sentence about a single wrong power or inverter; empty where its amount is unknown."""
    found, p = suspicion.found, one.meters.size
    # Inverters follow the customers.
    power = int(np.flatnonzero(np.concatenate([one.powers, one.inverters]))[0])
    for chosen, model in zip(found.chosen, found.model, strict=True):
        at = np.flatnonzero(chosen)
        if at.size == 1 and at[0] == p + power:
            mean, _ = amounts(found.problems[int(model)], chosen)
            # A missing injection lowers the voltages: the residual is that of the true power.
            return fault_sentence(design, power, float(mean[0]))
    return ""

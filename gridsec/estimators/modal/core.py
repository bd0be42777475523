"""Statistical core of one feeder: filter, test, search and estimate on the residuals of a front end.

    design(front) -> Core
    init(core, t) -> CoreState
    step(core, state, t, m, seen) -> (CoreState, Evidence)      every tick, releases masked meters
    identify(core, state, evidence) -> Suspicion                where `alarmed`
    transition(core, state, suspicion) -> CoreState             where the misfit is not settled
    passed(core, state, suspicion) -> (CoreState, Evidence)     where a transition leaves nothing, or None
    mask(core, state, suspicion) -> (CoreState, Evidence)       where meters are named
    adopt(core, state, suspicion) -> CoreState                  where loads alone explain the readings
    estimate(core, state, suspicion) -> Estimated               where asked for

The front end is that of `gridsec.estimators.front`: cleaning of frames, observer of the inverters,
loss-corrected power flow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, log

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of, indices
from gridsec.errors import InputInvalid, Problem
from gridsec.estimators.front.design import YEAR_S, FrontDesign
from gridsec.estimators.modal import (
    classes,
    collusion,
    detector,
    doubts,
    full,
    masking,
    mirrors,
    replay,
    rivals,
    signatures,
    static,
)
from gridsec.estimators.modal import estimate as estimates
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.classes import Classes
from gridsec.estimators.modal.costs import SearchProblem, cost, mean_amounts
from gridsec.estimators.modal.detector import SIZE, Detector, Evidence
from gridsec.estimators.modal.estimate import Estimated, Estimator
from gridsec.estimators.modal.filter import FilterState, Update
from gridsec.estimators.modal.laterals import groups
from gridsec.estimators.modal.masking import Masked
from gridsec.estimators.modal.mirrors import Neighbourhoods
from gridsec.estimators.modal.model import Modes, ResidualModel, modes, residual_model
from gridsec.estimators.modal.replay import History, Parts, Suspected
from gridsec.estimators.modal.rivals import Rival
from gridsec.estimators.modal.search import DOUBT, Identification, search
from gridsec.estimators.modal.signatures import Columns, Joint, Onsets, Scored
from gridsec.estimators.modal.static import Static
from gridsec.grid.network import Power

ACCUSATIONS = 1.0
"""Charge of a false power, in accusations of a meter: powers are promised to be within their limits."""
FALSE_POWER = 0.05
"""Prior standard deviation of a false power, pu of the feeder's base: 5 kW at 100 kVA, a large appliance."""
MOST_POWER = 3.0
"""Largest false power, in those that the customer can have, 1. False reports stay near the possible."""
PRIOR = 0.5
"""Prior probability that the loads' errors are as stated, 1; the rivals share the rest alike."""
CONNECTION = 0.1
"""Power of a customer where the files are not asked, pu of the feeder's base: 10 kW at 100 kVA."""
FARTHER = 5.0
"""Log M of an onset above that of all pinned ones from which on it replaces them, 1; a replay takes time."""
EXPLAINED = 0.25
"""Share of the misfit since the onset from which on the best explanation counts as one, 1.

A lasting fault explains all of it, one that grows since the onset three quarters, and alternating ones none.
"""
ADOPTED = 0.05
"""Largest weight of sets that need a meter where loads are adopted, 1: a meter may hide its own load."""
PASSED = 16
"""Ticks after a transition from which on its readings may be given up, 1."""
WAITS = 2 * PASSED
"""Ticks of a suspicion in which the misfit before another onset speaks against that, 1."""
TRIALS = 4
"""Trials of a transition while the age of an onset doubles, about, 1: the replay takes a second or so."""
UNREAD = 0.25
"""Unknown directions for each meter from which on many powers are unread, 1: two for each unread power."""
RECALLED = 24
"""Largest number of explanations that the next search knows, 1."""
CALM = 0.5
"""Part of the limit of log M below which suspected onsets are given up, 1."""
LAST_THIRD = 3
"""Age of a ramp over that of the step that fits it best, 1."""
EARLY = 64
"""Ticks that are all compared with the classes, and later those from one comparison to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class Core:
    """Everything prepared offline. n places, p meters, N customers, q faults.

    Attributes
    ----------
    model
        The model of the residuals.
    modes
        Modes of all meters.
    effect : (n, q)
        Change of the model at every place by each fault: meters (none), powers and inverters, busbar.
    faults
        Columns of all faults; injections of inverters beyond their curves count among the powers, after those
        of the customers. False reactive powers are left out: they move voltages nearly as active ones.
    groups, near
        Groups of neighbours, for the search, and neighbourhoods, for mirror images of explanations.
    estimator
        Regression of all places on the modes.
    bound : (q,)
        Largest amount of each fault that is possible.
    limit
        Log gamma: the alarm is at log M >= limit.
    rivals
        Modes under other models of the loads.
    classes
        Own errors of the meters and their accuracy classes.
    """

    model: ResidualModel
    modes: Modes
    effect: Floats = field(repr=False)
    faults: Columns = field(repr=False)
    groups: tuple[Ints, ...] = field(repr=False)
    near: Neighbourhoods = field(repr=False)
    estimator: Estimator = field(repr=False)
    bound: Floats = field(repr=False)
    limit: float
    rivals: tuple[Modes, ...] = field(repr=False)
    classes: Classes = field(repr=False)


@dataclass(frozen=True, slots=True, eq=False)
class CoreState:
    """State of the core.

    Attributes
    ----------
    filter, static, detector
        The states of the parts.
    update
        The filter's last step; None before the first.
    history
        Last readings.
    suspected
        Exact scores of the pinned onsets, where the filter has a full covariance.
    masked
        Masked meters.
    rivals
        The model and its rivals since the start of the kept readings, with the likeliest pinned onset.
    beyond : (p,)
        Meters with an own error beyond their accuracy class when they were compared last.
    loads
        Variance of the loads' errors, in that of the model, 1: more after a jump.
    spell
        Ticks in turn with a pinned onset.
    began
        Time of the first reading of the earliest onset that was the likeliest when it was pinned; infinite
        for none. Without a pinned onset it is given up with that reading.
    """

    filter: FilterState
    static: Static
    detector: Detector
    update: Update | None
    history: History
    suspected: tuple[Suspected, ...]
    masked: Masked
    rivals: tuple[Rival, ...] = ()
    beyond: Bools | None = None
    loads: float = 1.0
    spell: int = 0
    began: float = inf

    @property
    def first(self) -> int:
        """Number of the first kept reading since `began`."""
        return sum(each[0] < self.began for each in self.history.readings)

    @property
    def exceeding(self) -> Bools:
        """Meters in use with an own error beyond their accuracy class, (p,)."""
        return np.zeros_like(self.masked.meters) if self.beyond is None else self.beyond & ~self.masked.meters


def assemble(
    model: ResidualModel,
    powers: Floats,
    most: Floats,
    *,
    gamma: float,
    attacked: int | None = None,
    inverters: tuple[Floats, Floats] | None = None,
    allowed: Floats | None = None,
    customers: Ints | None = None,
) -> Core:
    """Prepare a core.

    Parameters
    ----------
    model
        The model of the residuals.
    powers : (n, N)
        Effect of false active powers on all places, squared pu per pu.
    most : (N,)
        Largest active powers that the customers can have, pu.
    gamma
        Least average number of ticks from one false alarm to the next, at least 1.
    attacked
        Largest number of manipulated meters that is promised; None: a third.
    inverters : (n, m), (m,)
        Effect of their injections on all places, squared pu per pu, and their ranges, pu; None: none.
    allowed : (p,)
        Largest fixed error within the class of each meter, squared pu; None: no bound.
    customers : (p,)
        Customer of each meter; None: the first p in their order.

    Raises
    ------
    ValueError
        If gamma is below 1.
    """
    if not 1.0 <= gamma < inf:
        raise InputInvalid([Problem("out-of-range", f"gamma is {gamma}; it must be at least 1 and finite")])
    made, at = modes(model), model.meters
    most = MOST_POWER * most
    if inverters is not None:
        # An inverter that leaves its curve stays within its range.
        powers, most = np.hstack([powers, inverters[0]]), np.concatenate([most, inverters[1]])
    std = np.full(powers.shape[1], FALSE_POWER)
    used = model.phases(made.at).any(axis=0)
    return Core(
        model=model,
        modes=made,
        effect=np.hstack([np.zeros((len(powers), at.size)), powers, model.busbar_of[:, used]]),
        faults=signatures.columns(made, powers[at], std, SIZE),
        groups=groups(made),
        near=mirrors.neighbourhoods(made, max(1, at.size // 3) if attacked is None else attacked, customers),
        estimator=estimates.estimator(made),
        bound=np.concatenate([np.full(at.size, inf), most, np.full(int(used.sum()), inf)]),
        limit=log(gamma),
        rivals=rivals.rivals(made),
        classes=classes.classes(made, np.full(at.size, inf) if allowed is None else allowed),
    )


def design(front: FrontDesign, most: Floats | None = None) -> Core:
    """Core of a feeder with a front end.

    Parameters
    ----------
    front
        Design of the front end, with the rate of false alarms.
    most : (N,)
        Largest active powers that the customers can have, pu; None: `CONNECTION` for each.
    """
    every = np.arange(front.customers)
    most = np.full(every.size, CONNECTION) if most is None else most
    powers = front.sensitivities.columns(Power.ACTIVE, every)
    gamma = max(1.0, YEAR_S / (front.step_s * front.options.alarms_per_year))
    droop = front.plant.droop
    inverters = front.sensitivities.columns(Power.REACTIVE, droop.customer), np.asarray(droop.span)
    return assemble(
        residual_model(front),
        powers,
        most,
        gamma=gamma,
        attacked=front.max_attacked,
        inverters=inverters if droop.customer.size else None,
        allowed=front.allowed,
        customers=front.plant.meters,
    )


def init(core: Core, t: float) -> CoreState:
    """State before the first reading.

    Parameters
    ----------
    core
        The core.
    t
        Time of the first reading, s.
    """
    made = core.modes
    parts = modal.start(made, t), static.start(made), detector.start(made)
    return CoreState(*parts, None, History((*parts, ())), (), masking.none(made))


def step(  # noqa: PLR0917  # the state, and one tick
    core: Core,
    state: CoreState,
    t: float,
    m: Floats,
    seen: Bools | None = None,
    unknown: Floats | None = None,
    jump: float = 0.0,
) -> tuple[CoreState, Evidence]:
    """Take in the residuals of one tick.

    Parameters
    ----------
    core, state
        The core, and the state after the last tick.
    t
        Time, s; not before that of the last tick.
    m : (p,)
        Residuals, squared pu; any finite value where not seen.
    seen : (p,)
        Meters with a reading; None: all.
    unknown : (p, k)
        Directions of the residuals that are unknown at this tick, times their standard deviations; None for
        none. The tick says nothing about them where the standard deviations are large.
    jump
        Variance of a jump of the loads' errors, in that of the loads, 1.

    Raises
    ------
    ValueError
        If t is before the last reading or not a number.
    """
    made, h, masked, read = core.modes, t - state.filter.t, state.masked, seen
    if any_of(masked.meters):
        seen = ~masked.meters if read is None else read & ~masked.meters
    pinned = indices(state.detector.pinned).tolist()
    after, known, update = full.step(
        made, state.filter, state.static, t, m, seen, stay=bool(pinned), unknown=unknown, jump=jump
    )
    test, evidence = detector.step(
        made, core.faults, state.detector, update, known, h=h, alert=CALM * core.limit
    )
    if any_of(masked.meters) and after.full is not None:
        masked = masking.follow(made, masked, after.full, update.exact, m, read, unknown)
    beyond = state.beyond
    if test.ticks <= EARLY or test.ticks % EARLY == 0:
        beyond = classes.exceeding(core.classes, made, after, known, ~masked.meters, core.limit)
    suspected = state.suspected
    if update.exact is not None:
        if pinned and not suspected:
            suspected = replay.carried(made, state.detector.onsets, state.static, pinned)
        suspected = tuple(replay.follow(made, each, update.exact, update.gap) for each in suspected)
    others, began = tuple(rivals.followed(state.rivals, t, m, seen, unknown, jump)), state.began
    if evidence.log_m >= core.limit and (not pinned or _elsewhere(state, evidence, test, others)):
        likeliest, age = int(evidence.rows[0]), len(state.history.readings) + 1 - state.first
        test = detector.pin(test, _pins(test.onsets, evidence.rows, age))
        last = replay.record(state.history, (after, known, test, ()), m, seen, unknown, jump)
        began = min(began, last.readings[-int(test.onsets.age[likeliest]) :][0][0])
        others = rivals.replayed(made, core.rivals, last, test.onsets, likeliest)
        if update.exact is not None:
            rows = np.flatnonzero(test.pinned).tolist()
            suspected = replay.replayed(made, last, test.onsets, rows)
    elif pinned and evidence.log_m < CALM * core.limit:
        test, suspected, others = detector.pin(test, evidence.rows[:0]), (), ()
    history = replay.record(state.history, (after, known, test, suspected), m, seen, unknown, jump)
    loads = update.gap.varied(made, state.loads)
    spell = state.spell + 1 if pinned else 0
    if began < history.readings[0][0] and not any_of(test.pinned):
        began = inf
    parts = after, known, test, update, history, suspected, masked, others, beyond, loads, spell, began
    return CoreState(*parts), evidence


def _pins(onsets: Onsets, rows: Ints, age: int) -> Ints:
    """Rows to pin: the likeliest ones, and the ramp with about the age of the earliest suspected onset.

    The step that fits a ramp best begins after two thirds of it.
    """
    ramps, first = np.flatnonzero(onsets.used & onsets.ramp), rows[0]
    age = max(age, int(onsets.age[first]) * (1 if onsets.ramp[first] else LAST_THIRD))
    if not ramps.size or onsets.ramp[rows].any():
        return rows
    oldest = ramps[np.abs(np.log(onsets.age[ramps] / age)).argmin()]
    return np.append(rows[:-1], oldest)


def mask(core: Core, state: CoreState, suspicion: Suspicion) -> tuple[CoreState, Evidence]:
    """Mask the named meters since `CoreState.began`, by replaying the kept readings without theirs.

    The onset that explains a drift best is late. False readings before it, which the filter has learned as
    errors of loads, speak against honest meters and for those that are not named yet. Meters that are masked
    already are unread from there on, too. Evidence against others stays: it is collected anew. Where the
    onset of the explanations is older than the kept readings, the filter before them is freed of the faults,
    and all onsets begin with them.

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    suspicion
        The explanations after the same tick.
    """
    named, history = suspicion.found.named, state.history
    used = ~(named | state.masked.meters)
    first, begun = len(history.readings) - int(state.detector.onsets.age[suspicion.row]), None
    if first >= 0:
        first = min(first, state.first)
    else:
        before, known, *_ = history.start
        joint = _joint(core, history.start, suspicion.row)
        whole = before.full or full.expanded(core.modes, before, known)
        W = core.faults.W[:, : named.size][:, named]
        begun = replace(before, full=replay.freed(core.modes, whole, joint, W, np.ones(W.shape[1])))

    def masked(k: int, seen: Bools | None, unknown: Floats | None) -> tuple[Bools | None, Floats | None]:
        return seen if k < first else used if seen is None else seen & used, unknown

    now, evidence = again(core, state, first, masked, begun)
    amount = amounts(core, state, suspicion)[: named.size]
    return replace(now, masked=masking.added(state.masked, named, amount)), evidence


def amounts(core: Core, state: CoreState, suspicion: Suspicion) -> Floats:
    """Amounts of the faults of the best explanation, (q,).

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    suspicion
        The explanations after the same tick.
    """
    found, out = suspicion.found, np.zeros(core.effect.shape[1])
    model, chosen = int(found.model[0]), found.chosen[0]
    # The amounts of a ramp are those of its unit of time.
    level = state.rivals[model].level if model else _level(core, state, suspicion.row)
    out[chosen] = level * mean_amounts(found.problems[model], chosen)
    return out


Change = Callable[[int, Bools | None, Floats | None], tuple[Bools | None, Floats | None]]
"""Meters with a reading and unknown directions of a replayed tick, by its number and those that are kept."""


def again(
    core: Core,
    state: CoreState,
    first: int,
    change: Change,
    begun: FilterState | None = None,
) -> tuple[CoreState, Evidence]:
    """Replay of kept readings with others in place of some, without a pinned onset; no meter is masked.

    Parameters
    ----------
    core, state
        The core, and the state with the readings.
    first
        Number of the first reading that changes; negative: before all that are kept. The detector then starts
        anew.
    change
        Meters with a reading and unknown directions of a tick, by its number and those that are kept.
    begun
        Filter before the first kept reading; None: as it was.
    """
    history = state.history
    kept, (before, known, test, _) = history.until(max(0, first))
    if first < 0:
        before, test = begun or before, detector.start(core.modes)
        kept = History((before, known, test, ()))
    test = detector.pin(test, np.zeros(0, np.intp))
    parts, none = (before, known, test, None, kept, ()), masking.none(core.modes)
    now = CoreState(*parts, none, beyond=state.beyond, loads=state.loads, began=state.began)
    evidence = Evidence(-inf, np.full(test.capital.shape, -inf))
    for k in range(len(kept.readings), len(history.readings)):
        t, m, seen, unknown, jump = history.readings[k]
        now, evidence = step(core, now, t, m, *change(k, seen, unknown), jump)
    # The loads have varied once.
    return replace(now, loads=state.loads), evidence


def beside_unknown(
    core: Core, state: CoreState, first: int, columns: Sequence[Floats]
) -> tuple[CoreState, Evidence]:
    """Replay of kept readings with more unknown directions; the masked meters stay masked.

    Parameters
    ----------
    core, state, first
        As in `again`.
    columns : (p, k) each
        Directions of the readings from `first` on, times their standard deviations.
    """

    def change(k: int, seen: Bools | None, unknown: Floats | None) -> tuple[Bools | None, Floats | None]:
        inside = 0 <= k - first < len(columns)
        return seen, replay.beside(unknown, columns[k - first]) if inside else unknown

    now, evidence = again(core, state, first, change)
    return replace(now, masked=state.masked), evidence


def widened(core: Core, state: CoreState, std: Floats) -> CoreState:
    """State with wider errors of the last readings, by replaying them; no onset is pinned that they explain.

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    std : (k, p)
        Standard deviations that the readings of the last k ticks gain, the newest last, squared pu.
    """
    count = len(state.history.readings)
    if not count:
        return state
    columns = [doubts.singly(each) for each in std[-count:]]
    return beside_unknown(core, state, count - len(columns), columns)[0]


def adopt(core: Core, state: CoreState, suspicion: Suspicion) -> CoreState:
    """Go on with the likeliest model of the loads, where no explanation of weight needs a meter.

    The filter becomes that of the rival. The powers of the best explanation, unknown since the onset, become
    errors of the loads. The detector starts anew. The state is unchanged where meters are doubted.

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    suspicion
        The explanations after the same tick.
    """
    found, p = suspicion.found, core.modes.size
    if not suspicion.fits or found.chosen[0, :p].any() or doubted(found, p) >= ADOPTED or not state.rivals:
        return state
    rival = state.rivals[int(found.model[0])]
    if rival.transition:
        return state
    after, chosen = rival.filter, found.chosen[0]
    if chosen.any():
        whole = after.full or full.expanded(rival.modes, after, rival.static)
        W, std = core.faults.W[:, chosen], found.problems[int(found.model[0])].std[chosen]
        joint = rival.joint()
        after = replace(after, full=replay.freed(rival.modes, whole, joint, W, std, loads=True))
    parts = after, rival.static, detector.start(core.modes)
    return CoreState(*parts, rival.update, History((*parts, ())), (), state.masked, beyond=state.beyond)


def doubted(found: Identification, meters: int) -> float:
    """Weight of the explanations that need a meter: without their meters they weigh less.

    A meter that is off by less than can be seen is part of many explanations, and no reason to doubt.

    Parameters
    ----------
    found
        The explanations.
    meters
        Number of meters.
    """
    every = zip(found.model.tolist(), found.chosen, found.weight.tolist(), strict=True)
    weight = {(model, chosen.tobytes()): each for model, chosen, each in every}
    out = 0.0
    for (model, key), each in weight.items():
        chosen = np.frombuffer(key, dtype=np.bool_).copy()
        if chosen[:meters].any():
            chosen[:meters] = False
            if weight.get((model, chosen.tobytes()), 0.0) < each:
                out += each
    return out


def _elsewhere(state: CoreState, evidence: Evidence, test: Detector, others: tuple[Rival, ...]) -> bool:
    """Another onset is far likelier than the pinned ones, and leaves no misfit before it open.

    That misfit counts for `WAITS` ticks, in which a short manipulation passes. Later it would hide others.
    """
    by_row, row = evidence.by_row.max(axis=0), int(evidence.rows[0])
    likelier = by_row[row] > by_row[state.detector.pinned].max() + FARTHER
    if not likelier or not others or state.spell > WAITS:
        return bool(likelier)
    return others[0].before(int(test.onsets.age[row])) <= 0.0


def alarmed(core: Core, evidence: Evidence) -> bool:
    """Decision of the detector at one tick.

    Parameters
    ----------
    core, evidence
        The core, and the answer of the tick.
    """
    return evidence.log_m >= core.limit


@dataclass(frozen=True, slots=True, eq=False)
class Suspicion:
    """Explanations since one onset.

    Attributes
    ----------
    row
        Row of the onset.
    found
        The explanations.
    contested : (q,)
        Meters and phases of the busbar that colluding meters may replace.
    fits
        The best one explains the misfit since then, and better than errors alike within the classes.
    settled
        It explains nearly all of it.
    beyond
        Mean square of the whitened innovations that it leaves, at least 1.
    replacing : (q,) each
        Sets with colluding meters that have kept names, the latest ones first.
    """

    row: int
    found: Identification
    contested: Bools
    fits: bool = True
    settled: bool = True
    beyond: float = 1.0
    replacing: tuple[Bools, ...] = field(default=(), repr=False)

    @property
    def accused(self) -> Bools:
        """Faults of the likeliest explanation that no colluding meters replace, (q,)."""
        return np.asarray(self.found.chosen[0] & ~self.contested)

    def earlier(self, before: Suspicion | None) -> Identification | None:
        """Explanations of an earlier search, if it was made at the same onset."""
        return before.found if before is not None and before.row == self.row else None


def identify(core: Core, state: CoreState, evidence: Evidence, before: Suspicion | None = None) -> Suspicion:
    """Sets of faults that explain the readings, since the onset that suits them best.

    The search is made at the onset that suits faults of all members best, under the model of the loads and
    its rivals. The costs of what it finds are then compared at the other onsets, and where another one is
    cheaper, the search is made there. Where readings are missing, only the pinned onsets are searched, with
    exact scores. Meters that colluding others may replace are not named.

    Parameters
    ----------
    core, state, evidence
        The core, the state after a tick, and the answer of that tick.
    before
        What an earlier search found: its likely sets count in this one, too. None: none.
    """
    test, known = state.detector, None if before is None else _keeping(before)
    rows = [] if state.suspected else [int(evidence.rows[0])]
    rows = list(dict.fromkeys(rows + np.flatnonzero(test.pinned & test.onsets.used).tolist()))
    scored = {row: _scored(core, state, row) for row in rows}
    rows = sorted(rows, key=lambda row: _misfit(core, scored[row]))
    best, unknown = 0, state.history.unknown
    found = _searched(core, state, _problem(core, scored[rows[0]], unknown), known)
    if len(rows) > 1:
        used, std = found.chosen[0], found.problems[0].std
        few = [_problem(core, scored[row], unknown, used) for row in rows]
        every = np.ones(int(np.count_nonzero(used)), dtype=np.bool_)
        costs = [cost(replace(one, std=std[used]), every) - 2.0 * gain for one, gain in few]
        best = int(np.argmin(costs))
    if best:
        found = _searched(core, state, _problem(core, scored[rows[best]], unknown), known)
    age = int(test.onsets.age[rows[best]])
    found = mirrors.reflected(found, core.near, state.masked.meters, known)
    replacing = () if before is None else before.replacing
    left = rivals.left(state.rivals, found)
    unread = unknown is not None and unknown.shape[1] >= UNREAD * core.modes.size
    weighed = collusion.weighed(found, state.masked.meters, core.near, left, replacing, unread=unread)
    sets = {each.tobytes(): each for each in (*weighed.replacing, *replacing)}
    found, replacing = weighed.found, tuple(sets.values())[:RECALLED]
    share = rivals.explained(state.rivals, found)
    fits = share >= EXPLAINED and not (age >= test.ticks and _aligned(core, found))
    found = found if fits else replace(found, named=np.zeros_like(found.named))
    settled, beyond = fits and share >= rivals.SETTLED, rivals.beyond(state.rivals, found)
    return Suspicion(rows[best], found, weighed.contested, fits, settled, beyond, replacing)


def _aligned(core: Core, found: Identification) -> bool:
    """All meters at one end of their classes explain the readings since the start nearly as well.

    A class bounds an error, and does not say that errors are independent. The limit is that of
    `classes.exceeding`.
    """
    problem, chosen = found.problems[int(found.model[0])], found.chosen[0]
    first = core.modes.size + core.faults.powers
    # The error that all meters of a phase may have.
    most = np.where(core.modes.phases > 0.0, core.classes.allowed[:, None], inf).min(axis=0)
    alike = classes.common(problem.y[first:], problem.F[first:, first:], most)
    gain = float(problem.y[chosen] @ mean_amounts(problem, chosen))
    return gain - alike < 2.0 * (core.limit + log(core.modes.size))


def transition(core: Core, state: CoreState, suspicion: Suspicion) -> CoreState:
    """Add a rival with a transition, where the misfit is not settled and it is the likeliest.

    It begins with the onset at which suspicion began. An earlier one is replaced. The state is the same where
    another model is likelier. Older onsets are tried at about every fifth part of their age.

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    suspicion
        The explanations after the same tick.
    """
    age = state.rivals[0].ticks if state.rivals else 0
    if suspicion.settled or not age or age % max(1, age // TRIALS):
        return state

    def cost_of(rival: Rival) -> float:
        return _misfit(core, rival.scored()) - 2.0 * rival.evidence

    ramp = bool(state.detector.onsets.ramp[suspicion.row])
    found = rivals.transitions(core.modes, state.history, age, ramp=ramp)
    best = min((*state.rivals, *found), key=cost_of)
    if not any(best is each for each in found):
        return state
    return replace(state, rivals=(*(each for each in state.rivals if not each.transition), best))


def passed(core: Core, state: CoreState, suspicion: Suspicion) -> tuple[CoreState, Evidence] | None:
    """State without the readings of a transition that has ended; None where it leaves an explanation to find.

    The likeliest model has a transition, and may need no fault beside it. The kept readings are replayed with
    those of the transition unknown. Nothing is left where log M then is below `CALM` of the limit.

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    suspicion
        The explanations after the same tick.
    """
    found, readings = suspicion.found, state.history.readings
    if not state.rivals:
        return None
    model = int(found.model[0])
    length, age = state.rivals[model].transition, state.rivals[model].ticks
    without = found.weight[(found.model == model) & ~found.chosen.any(axis=1)].sum()
    if not length or not length + PASSED <= age <= len(readings) or without < DOUBT:
        return None
    first, apart = len(readings) - age, rivals.APART * np.eye(core.modes.size)
    now, evidence = beside_unknown(core, state, first, length * [apart])
    if now.detector.log_m >= CALM * core.limit:
        return None
    return now, evidence


def _keeping(before: Suspicion) -> Bools:
    """The best set, likely ones that keep its meters from names, and sets of colluding meters, (k, q)."""
    found, p = before.found, before.found.named.size
    best = found.chosen[0]
    lacks = (best[:p] & ~found.chosen[:, :p]).any(axis=1) & (found.weight >= DOUBT)
    # One set may be likely under several models.
    return np.unique(np.vstack([best, *found.chosen[lacks][:RECALLED], *before.replacing]), axis=0)


def _misfit(core: Core, scored: Scored) -> float:
    """Cost of faults of all members at one onset, without the penalty, up to a constant; O(t^3).

    The amounts have the prior of `detector.omnibus`. The likeliest onset then seldom changes after a search.
    """
    return scored.misfit(core.modes.precision * (core.modes.white / SIZE**2))


def _parts(state: CoreState) -> Parts:
    return state.filter, state.static, state.detector, state.suspected


def _joint(core: Core, parts: Parts, row: int) -> Joint:
    """Joint scores of one onset."""
    _, known, test, suspected = parts
    for each in suspected:
        if each.row == row:
            return each.joint(core.modes)
    return signatures.joint(core.modes, detector.followed(core.modes, test).onsets, known, row)


def _scored(core: Core, state: CoreState, row: int) -> Scored:
    """Scores and information of the members at one onset."""
    for each in state.suspected:
        if each.row == row:
            return each.scored
    test = detector.followed(core.modes, state.detector)
    return signatures.scored(core.modes, test.onsets, state.static, row)


def _level(core: Core, state: CoreState, row: int) -> float:
    """Level u of one onset at the last tick."""
    exact = (each.level for each in state.suspected if each.row == row)
    return next(exact, float(detector.followed(core.modes, state.detector).onsets.level[row]))


def _moves(core: Core, state: CoreState, row: int, model: int, used: Bools) -> Floats:
    """Change of the estimate per amount of each used fault, as `estimate.moves`, under a model by its number.

    The onset is a row of the model, 0, or that of a rival.
    """
    p, rival = core.modes.size, state.rivals[model] if model else None
    filtered = rival.filter if rival else state.filter
    opened = filtered.full is not None and filtered.full.unknown is not None
    out = np.zeros((len(core.effect) + p * opened, used.size))
    if not any_of(used):
        return out
    since: Suspected | Joint | None
    if rival is None:
        since = next((each for each in state.suspected if each.row == row), None)
        since = since or _joint(core, _parts(state), row)
    else:
        since = rival.suspected or rival.joint()
    x = np.hstack([np.eye(p)[:, used[:p]], core.faults.beside[:, used[p:]]])
    out[:, used] = estimates.moves(core.modes, core.estimator, filtered, since, x, core.effect[:, used])
    return out


def _searched(
    core: Core, state: CoreState, of_onset: tuple[SearchProblem, float], known: Bools | None
) -> Identification:
    """Explanations by `_problem` of one onset, under the model and under its rivals."""
    open_, (model, gain) = state.history.unknown, of_onset
    if not state.rivals:
        return search(model, core.groups, (), core.near.laterals, known)
    plain, others = state.rivals[0], state.rivals[1:]
    less = 2.0 * log(PRIOR * len(others) / (1.0 - PRIOR))
    found = []
    for each in others:
        problem, more = _problem(core, each.scored(), open_)
        found.append((problem, 2.0 * (plain.evidence + gain - each.evidence - more) + less))
    return search(model, core.groups, found, core.near.laterals, known)


def _problem(
    core: Core, scored: Scored, unknown: Floats | None, used: Bools | None = None
) -> tuple[SearchProblem, float]:
    """Scores, information and charges of faults at one onset, and the gain of evidence by unknown errors.

    The filter takes the error along an unknown direction as white. One that lasts since the onset would count
    against a set of faults at every tick. Its amount, N(0, LASTS^2) of the direction as in `masking`, is
    integrated out.

    Parameters
    ----------
    core, scored, unknown
        The core, the scores of the members, and the unknown directions (p, k).
    used : (q,)
        The faults; None: all.
    """
    faults, p, q, gain = core.faults, core.modes.size, core.faults.std.size, 0.0
    if unknown is not None:
        scored, gain = scored.beside(masking.LASTS * unknown)
    y, F = faults.of(scored, used)
    accusation = 2.0 * log(p)
    charge = np.zeros(q)
    charge[p:] = accusation
    charge[p : p + faults.powers] = ACCUSATIONS * accusation
    if used is None:
        return SearchProblem(y, F, faults.std, p, charge, core.bound), gain
    meters = int(np.count_nonzero(used[:p]))
    return SearchProblem(y, F, faults.std[used], meters, charge[used], core.bound[used]), gain


def estimate(core: Core, state: CoreState, suspicion: Suspicion | None = None) -> Estimated:
    """Errors of the front end's model at all places.

    Parameters
    ----------
    core, state
        The core, and the state after a tick.
    suspicion
        The explanations after the same tick; None: no fault.

    Raises
    ------
    ValueError
        Before the first tick.
    """
    if state.update is None:
        raise InputInvalid([Problem("missing", "no reading is available yet")])
    made, by = core.modes, core.estimator
    plain = estimates.honest(made, by, state.filter, state.static, loads=state.loads)
    if suspicion is None:
        return replace(plain, beyond=rivals.beyond(state.rivals))
    others = (
        estimates.honest(each.modes, by, each.filter, each.static, loads=each.loads)
        for each in state.rivals[1:]
    )
    before = [plain, *others]
    found, row = suspicion.found, suspicion.row
    counted = found.weight >= estimates.COUNTED
    used = [found.chosen[counted & (found.model == model)].any(axis=0) for model in range(len(before))]
    T = [_moves(core, state, row, model, each) for model, each in enumerate(used)]
    return replace(estimates.corrected(before, T, found), beyond=suspicion.beyond)

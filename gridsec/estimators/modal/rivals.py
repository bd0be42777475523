"""Rival models of the loads: changes that no report shows, as jumps at some ticks and as unrest.

The filter of `gridsec.estimators.modal.filter` takes the loads' errors as a stationary AR(1). Kettles and
cars that no report shows, powers that are old and powers that are unread make them jump. A rival is the same
filter since the start of the kept readings, with other errors of the loads:

    w_t = rho w_(t-1) + u_t,   cov u_t = (1 - rho^2) UNREST S + j_t S

with a jump j_t of 0 or of one of `JUMPS`, times `WITHIN_S` over T, at each tick. The jumps are hypotheses
with the prior `RATE` per tick. At each tick the likelier one is taken, given the ticks before and theta at
its mean. For these jumps the filter is exact. With

    evidence = log prior of the jumps + sum_t log N(nu_t; 0, V_t)

two models of the loads are compared, for each set of faults: a set has the weight of its cost under the model
times the evidence. Under a rival a fault counts only as far as no loads imitate it.

With constant amounts theta of the directions, ``nu_t`` and ``V_t`` of a mode are those without theta, and the
evidence has the term ``(theta' N^-1 theta - log det N^-1) / 2``, that at the start subtracted.

**Transition.** Manipulations may begin one after another, as by clocks that are off, or grow over some ticks.
No explanation since one onset fits that. A further rival is the model itself with an own unknown amount of
every reading, N(0, `APART`^2), at each of the first ticks since the onset. Its evidence, with faults of all
members since, decides on their number, and on the rival as such.

References
----------
Ghahramani and Hinton, Variational learning for switching state-space models, Neural Computation 12, 2000.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf, log, sqrt
from typing import Any

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, all_of, any_of, indices, submatrix
from gridsec.estimators.modal import detector, replay, signatures
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal import full as exact
from gridsec.estimators.modal.costs import mean_amounts
from gridsec.estimators.modal.filter import FilterState, Interval, Update
from gridsec.estimators.modal.model import REPORTED_S, Modes
from gridsec.estimators.modal.replay import History, Reading, Suspected
from gridsec.estimators.modal.search import Identification
from gridsec.estimators.modal.signatures import Joint, Onsets, Scored
from gridsec.estimators.modal.static import Static

UNREST = (1.0, 30.0)
"""Variances of the loads' changes of the rivals, in those of the model, 1."""
JUMPS = (10.0, 100.0)
"""Variances of a jump of all loads, in those of the loads, 1: 2 and 6 kW where 0.6 kW is stated."""
WITHIN_S = 600.0
"""Correlation time of the loads to which `JUMPS` refers, s: slower errors, of registers, jump by less.

The variances are those times `WITHIN_S` over the correlation time, between its share of `REPORTED_S` and 1.
"""
RECENT = 8.0
"""Memory of the share of ticks with a jump, ticks."""
BY_CHANCE = 3.0
"""Misfit that needs no explanation, in standard deviations of n honest innovations, ``sqrt(2 n)``, 1."""
SETTLED = 0.9
"""Share of the misfit from which on an explanation leaves no transition to look for, 1.

Below it, sets beside a transition name nothing.
"""
OFTEN = 0.3
"""Share of the last ticks with a jump of the loads from which on jumps explain everything, and so nothing, 1.

Three ticks in turn have it. With kettles in 57 households, and no report of any, it is 0.2.
"""
APART = 0.05
"""Standard deviation of a reading within a transition, squared pu: manipulations of several percent."""
RATE = 1.0 / 60.0
"""Prior probability of a jump of each size, per tick: kettles and cars of a street."""
FORGOTTEN = 1e-9
"""Least share of the loads' variance that a pause leaves, 1: of a jump within a longer one less is left."""


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """One model of the loads since the start of the kept readings, and the scores of one onset under it.

    Attributes
    ----------
    modes
        The modes, with the variance of the loads' changes.
    filter, static
        States of the parts.
    sum
        Logarithm of the prior of the jumps and of the likelihood of the readings, without a fault and, while
        the filter is modal, without theta.
    known
        Part of theta in the evidence that is subtracted: that before the first reading.
    onsets, suspected
        The onset, in row 0, in the modes, and its exact scores where readings have been missing.
    jumps
        Number of jumps; None where the loads never jump.
    unsteady
        Share of the last ticks with a jump, 1: a mean with the memory of `RECENT` ticks.
    misfit, count, ticks
        Squares of the whitened innovations since the onset, less their number; that number, and their ticks.
        Those before the kept readings do not count.
    excess
        The first two of each tick since the onset, at most of ``2 HALF`` ticks.
    update
        The filter's last step.
    loads
        Variance of the loads' errors that vary, without any reading, in those of the model, 1.
    transition
        First ticks since the onset at which every reading is unknown.
    older
        Ticks of the onset before the kept readings.
    """

    modes: Modes
    filter: FilterState
    static: Static
    sum: float
    known: float
    onsets: Onsets
    suspected: Suspected | None
    jumps: int | None
    unsteady: float = 0.0
    misfit: float = 0.0
    count: int = 0
    ticks: int = 0
    excess: tuple[tuple[float, int], ...] = ()
    update: Update | None = None
    loads: float = 1.0
    transition: int = 0
    older: int = 0

    @property
    def chance(self) -> float:
        """Misfit that needs no explanation."""
        return by_chance(self.count)

    def before(self, age: int) -> float:
        """Misfit beyond chance that precedes the last `age` ticks: no onset since then explains it."""
        earlier = self.excess[: max(0, len(self.excess) - age)]
        return sum(one for one, _ in earlier) - by_chance(sum(count for _, count in earlier))

    @property
    def unrest(self) -> float:
        """Variance of the loads' changes, in those of the model."""
        at = int(self.modes.loads.argmax())
        return float(self.modes.varying[at] / self.modes.loads[at])

    @property
    def evidence(self) -> float:
        """Logarithm of the prior of the jumps and of the likelihood of the readings, without a fault."""
        if self.filter.full is not None:
            return self.sum
        return self.sum + _of_theta(self.modes, self.static) - self.known

    @property
    def level(self) -> float:
        """Level u of the onset at the last tick."""
        return float(self.onsets.level[0]) if self.suspected is None else self.suspected.level

    def scored(self) -> Scored:
        """Scores and information of the members at the onset."""
        if self.suspected is not None:
            return self.suspected.scored
        return signatures.scored(self.modes, self.onsets, self.static, 0)

    def joint(self) -> Joint:
        """Joint scores of the onset."""
        if self.suspected is not None:
            return self.suspected.joint(self.modes)
        return signatures.joint(self.modes, self.onsets, self.static, 0)


def by_chance(count: int) -> float:
    """Misfit of `count` innovations that needs no explanation."""
    return BY_CHANCE * sqrt(2.0 * count)


def rivals(modes: Modes) -> tuple[Modes, ...]:
    """The modes under each of `UNREST`.

    Parameters
    ----------
    modes
        The modes of the model.
    """
    return tuple(modes if scale == 1.0 else replace(modes, varying=scale * modes.varying) for scale in UNREST)


def jumps(modes: Modes) -> tuple[float, ...]:
    """Variances of a jump of the loads, in those of the loads, 1.

    Parameters
    ----------
    modes
        The modes, with the correlation time.
    """
    scale = min(1.0, WITHIN_S / min(modes.model.time_s, REPORTED_S))
    return tuple(scale * each for each in JUMPS)


def first(modes: Modes, others: Sequence[Modes], history: History) -> list[Rival]:
    """The model itself, without jumps, and all rivals, before the first kept reading and without an onset.

    Parameters
    ----------
    modes, others
        The modes, and those of the rivals.
    history
        The readings.
    """
    state, known, *_ = history.start
    none = signatures.empty(modes, 1)
    return [
        Rival(each, state, known, 0.0, _of_theta(each, known), none, None, 0 if k else None)
        for k, each in enumerate((modes, *others))
    ]


def replayed(
    modes: Modes, others: Sequence[Modes], history: History, onsets: Onsets, row: int
) -> tuple[Rival, ...]:
    """The model itself, without jumps, and all rivals, after the last reading.

    Parameters
    ----------
    modes, others
        The modes, and those of the rivals.
    history
        The readings.
    onsets, row
        The onsets of the detector after the last reading, and the row of the onset.
    """
    state, _, test, suspected = history.start
    count, age, had = len(history.readings), int(onsets.age[row]), detector.followed(modes, test).onsets
    older = bool(had.used[row]) and int(had.age[row]) == age - count
    exactly = next((each for each in suspected if older and each.row == row), None)
    begin = max(0, count - age)
    one = signatures.empty(modes, int(not onsets.ramp[row]), int(onsets.ramp[row]))
    if older and (state.full is None or exactly is not None):
        begin, one = -1, signatures.single(had, row)
    start = first(modes, others, history)
    out = [replace(each, onsets=one, suspected=exactly, older=max(0, age - count)) for each in start]
    for k, reading in enumerate(history.readings):
        out = followed(out, *reading, begun=k == begin)
    return tuple(out)


def transitions(modes: Modes, history: History, age: int, *, ramp: bool = False) -> tuple[Rival, ...]:
    """The model itself with transitions of 1, 2, 4, ... ticks, shorter than the age of an onset.

    The misfit begins with the transition's end. None for an onset before the kept readings.

    Parameters
    ----------
    modes, history
        As in `replayed`.
    age, ramp
        Ticks since the onset, its own included, and its shape.
    """
    count, out = len(history.readings), list[Rival]()
    if age > count:
        return ()
    (within,) = first(modes, (), history)
    one = signatures.empty(modes, int(not ramp), int(ramp))
    within, apart = replace(within, onsets=one), APART * np.eye(modes.size)
    for k, (t, m, seen, unknown, jump) in enumerate(history.readings, age - count):
        out = followed(out, t, m, seen, unknown, jump)
        if k < 0:
            within = follow(within, t, m, seen, unknown, jump)
        elif k < age - 1:
            within = follow(within, t, m, seen, replay.beside(unknown, apart), jump, begun=k == 0)
            if (k + 1) & k == 0:
                out.append(replace(within, transition=k + 1, misfit=0.0, count=0))
    return tuple(out)


def followed(before: Sequence[Rival], *tick: *Reading, begun: bool = False) -> list[Rival]:
    """Take in the residuals of one tick under some models; as `follow`.

    A rival without unrest has the states of the model until its first jump. Such steps are made once.
    """
    done: _Done = {}
    return [follow(each, *tick, begun=begun, done=done) for each in before]


_Done = dict[tuple[int, ...], tuple[Any, ...]]
"""Results of one tick, with the objects that they follow from, by the identities of these."""


def _once(done: _Done, make: Callable[..., Any], *of: object) -> Any:
    """Result of `make` for some objects, or that of an earlier call with the same ones."""
    key = tuple(map(id, of))
    if key not in done:
        done[key] = make(*of), of
    return done[key][0]


def follow(  # noqa: PLR0917  # the state, and one tick
    before: Rival,
    t: float,
    m: Floats,
    seen: Bools | None,
    unknown: Floats | None = None,
    jump: float = 0.0,
    *,
    begun: bool = False,
    done: _Done | None = None,
) -> Rival:
    """Take in the residuals of one tick.

    Parameters
    ----------
    before
        The rival so far.
    t
        Time, s.
    m, seen : (p,)
        Residuals, and members with a reading; None: all.
    unknown : (p, k)
        Unknown directions, as in `gridsec.estimators.modal.full.step`.
    jump
        As in `gridsec.estimators.modal.filter.Interval`.
    begun
        The onset is at this tick.
    done
        Results of this tick for other models, with the same other arguments; it is changed.
    """
    done = {} if done is None else done
    modes, state, known, gap = before.modes, before.filter, before.static, Interval(t - before.filter.t, jump)
    total, onsets, suspected, jumps = before.sum, before.onsets, before.suspected, before.jumps
    if state.full is None and not ((seen is None or all_of(seen)) and unknown is None):
        total += _of_theta(modes, known) - before.known
        state, suspected = _once(done, _expanded, modes, state, known, onsets)
    size = 0.0
    if jumps is not None:
        size, prior = _jump(modes, state, known, gap, m, seen, unknown)
        total, jumps = total + prior, jumps + (size > 0.0)
        state = _jumped(modes, state, gap, size)
    tick = t, m, seen, unknown, jump, begun
    state, known, update, onsets, suspected = _once(
        done, partial(_advanced, tick), modes, state, known, onsets, suspected
    )
    if update.exact is None:
        count = modes.size
        total -= 0.5 * float((update.innovation**2 / update.variance + np.log(update.variance)).sum())
        # Likelihoods are those of the readings, as with a full covariance.
        total += modes.volume
    else:
        count = update.exact.white.size
        total -= 0.5 * known.square + float(np.log(update.exact.half.diagonal()).sum())
    loads = gap.varied(modes, before.loads, before.unrest) + size
    return replace(
        before,
        filter=state,
        static=known,
        sum=total,
        onsets=onsets,
        suspected=suspected,
        jumps=jumps,
        unsteady=before.unsteady + (float(size > 0.0) - before.unsteady) / RECENT,
        misfit=known.square - count + (0.0 if begun else before.misfit),
        count=count + (0 if begun else before.count),
        ticks=1 + (0 if begun else before.ticks),
        excess=(*(() if begun else before.excess[1 - 2 * replay.HALF :]), (known.square - count, count)),
        update=update,
        loads=loads,
    )


def _expanded(
    modes: Modes, state: FilterState, known: Static, onsets: Onsets
) -> tuple[FilterState, Suspected | None]:
    """State with a full covariance, and the exact scores of the onset so far."""
    suspected = replay.carried(modes, onsets, known, [0])[0] if onsets.used[0] else None
    return replace(state, full=exact.expanded(modes, state, known)), suspected


def _advanced(  # noqa: PLR0917  # the states, and one tick
    tick: tuple[float, Floats, Bools | None, Floats | None, float, bool],
    modes: Modes,
    state: FilterState,
    known: Static,
    onsets: Onsets,
    suspected: Suspected | None,
) -> tuple[FilterState, Static, Update, Onsets, Suspected | None]:
    """The states after one tick, its jump included."""
    t, m, seen, unknown, jump, begun = tick
    state, known, update = exact.step(modes, state, known, t, m, seen, stay=True, unknown=unknown, jump=jump)
    if update.exact is None:
        if begun or onsets.used[0]:
            onsets = signatures.follow(modes, onsets, update, known, update.gap.h, begun=[0] if begun else [])
    else:
        if begun:
            suspected = replay.begun(modes, 0, bool(onsets.ramp[0]))
        if suspected is not None:
            suspected = replay.follow(modes, suspected, update.exact, update.gap)
    return state, known, update, onsets, suspected


def _of_theta(modes: Modes, known: Static) -> float:
    """``(theta' N^-1 theta - log |det N^-1|) / 2``."""
    if not modes.sign.size:
        return 0.0
    G = modes.directions
    precision = np.diag(modes.sign) + (G.T * known.information) @ G
    return 0.5 * float(known.pull @ np.linalg.solve(precision, known.pull) - np.linalg.slogdet(precision)[1])


def _jump(  # noqa: PLR0917  # the states of both parts, and one tick
    modes: Modes,
    state: FilterState,
    known: Static,
    gap: Interval,
    m: Floats,
    seen: Bools | None,
    unknown: Floats | None,
) -> tuple[float, float]:
    """The likeliest jump of a tick, in the variances of the loads, and the logarithm of its prior."""
    rho, rho_b = gap.decay(modes)
    sizes, priors = (
        (0.0, *jumps(modes)),
        [log(1.0 - len(JUMPS) * RATE), *[log(RATE)] * len(JUMPS)],
    )
    if state.full is None:
        _, _, v = modal.predicted(modes, state.cov, rho, rho_b, gap.jump)
        g = known.signature
        nu = m @ modes.U - rho * state.mean[0] - rho_b * state.mean[1]
        if modes.sign.size:
            nu -= (1.0 - rho * g[0] - rho_b * g[1]) * (modes.directions @ known.theta)
        w = v + np.multiply.outer(sizes, modes.loads)
        each = (priors - 0.5 * (nu * nu / w + np.log(w)).sum(axis=1)).tolist()
    else:
        n = np.arange(modes.size) if seen is None else indices(seen)
        if not n.size:
            return 0.0, priors[0]
        nu = (m - rho * state.full.mean[0] - rho_b * state.full.mean[1])[n]
        V, S = exact.expected(modes, state.full, gap, n), submatrix(modes.jumps, n, n)
        if unknown is not None:
            V = V + unknown[n] @ unknown[n].T
        each = []
        for prior, size in zip(priors, sizes, strict=True):
            half, _ = lapack.dpotrf(V + size * S, lower=True, clean=True)
            white, _ = lapack.dtrtrs(half, nu, lower=True)
            each.append(prior - 0.5 * float(white @ white) - float(np.log(half.diagonal()).sum()))
    best = int(np.argmax(each))
    return sizes[best], priors[best]


def _jumped(modes: Modes, state: FilterState, gap: Interval, size: float) -> FilterState:
    """State before a tick at which the loads jump."""
    if not size:
        return state
    more = size / max(gap.decay(modes)[0] ** 2, FORGOTTEN)
    cov, full = state.cov.copy(), state.full
    cov[0] += more * modes.loads
    if full is not None:
        w, both, b = full.blocks
        full = replace(full, blocks=(w + more * modes.jumps, both, b))
    return replace(state, cov=cov, full=full)


# --- Explanations ---


def explained(models: Sequence[Rival], found: Identification) -> float:
    """Share of the misfit beyond chance that the best explanation takes away, 1.

    The model is that of the loads, a steady rival, or from `SETTLED` on a transition.

    Parameters
    ----------
    models
        The model and its rivals; none: all of it.
    found
        The explanations.
    """
    best = 0.0 if models else 1.0
    for at in dict.fromkeys((0, int((found.model == 0).argmax()))) if models else ():
        model = models[int(found.model[at])]
        if model.transition and not any_of(found.chosen[at]):
            continue
        beyond = model.misfit - model.chance
        share = _gain(found, at, model) / beyond if beyond > 0.0 else 1.0
        if model.transition and share < SETTLED:
            # The names are those of its sets.
            return 0.0
        if not found.model[at] or model.unsteady < OFTEN:
            best = max(best, share)
    return best


def left(models: Sequence[Rival], found: Identification) -> float:
    """Largest share of the misfit that the best explanation may leave: that which it leaves, and chance.

    Parameters
    ----------
    models, found
        As in `explained`.
    """
    if not models:
        return inf
    model = models[int(found.model[0])]
    rest = model.misfit + model.chance - _gain(found, 0, model)
    return max(rest, 0.0) / model.misfit if model.misfit > 0.0 else inf


def beyond(models: Sequence[Rival], found: Identification | None = None) -> float:
    """Mean square of the whitened innovations that the best explanation and chance leave, at least 1.

    It is that since the onset, under the model of the explanation: 1 where the stated variances are right.

    Parameters
    ----------
    models
        As in `explained`.
    found
        The explanations; None for none.
    """
    if not models:
        return 1.0
    model = models[0 if found is None else int(found.model[0])]
    rest = model.misfit - model.chance - (0.0 if found is None else _gain(found, 0, model))
    return 1.0 + max(rest, 0.0) / max(model.count, 1)


def _gain(found: Identification, at: int, model: Rival) -> float:
    """Twice the logarithm of the likelihood's gain by an explanation, at its mean amounts.

    Of an onset before the kept readings, a gain in proportion to the ticks of the misfit. An explanation
    since an onset before that of the misfit gains little in between.
    """
    problem, chosen = found.problems[int(found.model[at])], found.chosen[at]
    share = model.ticks / max(1, model.ticks + model.older)
    return float(problem.y[chosen] @ mean_amounts(problem, chosen)) * share

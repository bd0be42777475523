"""Detection and isolation over windows by a bank of discrete-time observers.

One observer for all p meters, one for every set of p - q, one for every set of p - 2q. Without manipulated
meters all of them stay within a known distance of the true state, hence of each other:

    pi(k)   = max over J of |x_hat - x_hat_J|                 <= 2 (epsilon + gamma m),
    pi_J(k) = max over S within J of |x_hat_J - x_hat_S|      <= 2 (epsilon + gamma_J m)

the latter for every J without a manipulated meter. A value above its bound is evidence; a window of N steps
collects it.

Source: yang2019 (8), (10), (17), (19), Algorithms 1 and 2, Example 1; docs/theory-discrete.md, sections 3, 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen
from gridsec.errors import InputInvalid, Problem, no_choice, raise_if_any
from gridsec.interface import Decision
from gridsec.observers import circle_discrete
from gridsec.observers.circle_discrete import DiscreteDesign, StackedObservers, advance, settling_steps, stack
from gridsec.observers.lmi.discrete import DiscreteGains, DiscreteOptions, discrete_circles
from gridsec.observers.lmi.sampled import DiscreteLure, measure
from gridsec.observers.lmi.sampled import advance as advance_plant
from gridsec.secure.subsets import Subsets, subsets

Rule = Literal["majority", "survivors"]


def exceeds(measure: Floats, threshold: Floats | float) -> Bools:
    """True where measures are above their thresholds.

    measure (…): pi or pi_J; NaN, a measure that was not judged, exceeds no threshold.
    threshold (…) or scalar: a threshold of NaN is exceeded by every judged measure.
    """
    return np.asarray(~np.isnan(measure) & ~(measure <= threshold))


def detection(pi: Floats, threshold: float, length: int) -> Bools:
    """Algorithm 1: True for windows (…, T // N) in which pi (…, T), from step k* on, exceeds (10)."""
    count = pi.shape[-1] // length
    above = exceeds(pi[..., : count * length], threshold)
    return np.asarray(above.reshape(*pi.shape[:-1], count, length).any(axis=-1))


def believed(passing: Bools, masks: Bools) -> Bools:
    """W-bar(k): the union of all large sets that pass, the meters (…, p) regarded as unmanipulated.

    passing (…, s): True where pi_J is within its threshold.
    masks (s, p).
    Source: yang2019 (21).
    """
    return np.asarray((passing[..., :, None] & masks).any(axis=-2))


@dataclass(frozen=True, slots=True, eq=False)
class WindowIsolation:
    """Result of windows. w windows, p meters."""

    suspects: Bools  # (…, w, p) meters regarded as attacked; none where `decided` is False
    decided: Bools  # (…, w) True if the window has an answer
    # (…, w) fraction of the window's steps with this answer (majority), or of the large sets that survived
    # (survivors)
    share: Floats


def isolation(pi_sets: Floats, thresholds: Floats, masks: Bools, length: int, rule: Rule) -> WindowIsolation:
    """Algorithm 2, or its sound variant, over consecutive windows.

    "majority" takes the set that equals W-bar(k) most often in the window. Steps without a passing set do not
    vote, the earlier set wins a tie, and a window without votes is undecided. "survivors" drops a large set
    at its first failure and trusts the union of the others; without any, the assumptions are wrong and the
    window is undecided.

    pi_sets (…, T, s): pi_J from step k* on; NaN where J cannot be judged, neither passed nor failed.
    thresholds (s,), masks (s, p).
    length: N. An incomplete last window is left out.
    rule: "majority" or "survivors".
    Raises ValueError if `rule` is unknown.
    Source: yang2019, Algorithm 2; docs/errata/yang2019.md on the two rules.
    """
    raise_if_any(no_choice("rule", get_args(Rule), rule))
    count = pi_sets.shape[-2] // length
    shape = (*pi_sets.shape[:-2], count, length, pi_sets.shape[-1])
    windowed = np.asarray(pi_sets[..., : count * length, :].reshape(shape))
    if rule == "survivors":
        failed = np.asarray(exceeds(windowed, thresholds).any(axis=-2))
        judged = np.asarray(np.isfinite(windowed).any(axis=-2))
        alive = np.asarray(~failed & judged)
        decided = np.asarray(alive.any(axis=-1) & judged.all(axis=-1))
        suspects = ~believed(alive, masks) & decided[..., None]
        return WindowIsolation(suspects, decided, alive.mean(axis=-1))
    trusted = believed(np.asarray(windowed <= thresholds), masks)
    return _majority(trusted, np.asarray(np.isfinite(windowed).all(axis=-1) & trusted.any(axis=-1)))


def _majority(trusted: Bools, votes: Bools) -> WindowIsolation:
    """The most frequent set (…, w, N, p) among the steps that vote (…, w, N); the earlier one at a tie."""
    lead, (length, p) = trusted.shape[:-2], trusted.shape[-2:]
    rows = trusted.reshape(-1, p)
    if not rows.size:
        return WindowIsolation(np.zeros((*lead, p), np.bool_), np.zeros(lead, np.bool_), np.zeros(lead))
    _, first, kind = np.unique(np.packbits(rows, axis=1), axis=0, return_index=True, return_inverse=True)
    count = len(rows) // length
    window, voting = np.repeat(np.arange(count), length), votes.reshape(-1)
    code = window * len(first) + kind.reshape(-1)
    tally = np.bincount(code[voting], minlength=count * len(first)).reshape(count, -1)
    seen = np.full(count * len(first), length)
    np.minimum.at(seen, code[voting], np.tile(np.arange(length), count)[voting])
    # Most votes first; `seen` is at most N and decides ties only.
    winner = np.argmax(tally * (length + 1) - seen.reshape(tally.shape), axis=1)
    share = tally[np.arange(count), winner] / length
    suspects = ~rows[first[winner]] & (share > 0.0)[:, None]
    return WindowIsolation(suspects.reshape(*lead, p), (share > 0.0).reshape(lead), share.reshape(lead))


MOST_OBSERVERS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class WindowDesign:
    """Bank with its thresholds. p meters, at most q manipulated, s = C(p, q) large sets, o observers."""

    # all o = 1 + C(p, q) + C(p, 2q) observers: of all meters, of the large sets J, of the small sets S
    observers: StackedObservers
    sets: Subsets  # J and S, and the compared pairs
    gains: Floats  # (o,) gamma of each observer
    noise: float  # m, supremum over time of the Euclidean norm of all meters' noise
    epsilon: float  # largest remainder of the initial error when windows begin
    settling: int  # k*, first step of the first window
    detect_above: float  # threshold of pi
    isolate_above: Floats  # (s,) thresholds of pi_J
    length: int  # N, steps in a window
    # isolation rule of a window: "majority" is Algorithm 2; "survivors" keeps the J that never failed
    rule: Rule

    @property
    def large(self) -> Bools:
        """Masks (s, p) of the large sets, in the order of pi_J."""
        return self.observers.masks[1 : 1 + self.sets.count_large]


def bank_masks(meters: int, max_attacked: int, *, most: int = MOST_OBSERVERS) -> Bools:
    """Sets of meters of all observers of a bank as masks (o, p): all meters, then J, then S."""
    sets = subsets(meters, max_attacked, most=most)
    return np.vstack([np.ones((1, meters), dtype=np.bool_), sets.masks()])


def bank(
    system: DiscreteLure,
    max_attacked: int,
    *,
    options: DiscreteOptions | None = None,
    proof: DiscreteGains | None = None,
    most: int = MOST_OBSERVERS,
) -> tuple[DiscreteDesign, ...]:
    """Design all observers: of all meters, of every p - q and of every p - 2q of them.

    system: plant with p meters.
    max_attacked: q, at least 1.
    options: for gains by matrix inequality. Either `options` or `proof` is required.
    proof: for direct injection.
    Raises NotObservable unless p > 2q. DesignInfeasible if there are more than `most` observers, or an
        observer cannot be designed. ValueError if `max_attacked` is below 1, or not exactly one of `options`
        and `proof` is given.
    """
    if max_attacked < 1:
        raise InputInvalid.of(
            "out-of-range", "max_attacked must be at least 1: otherwise there is nothing to isolate"
        )
    if (options is None) == (proof is None):
        raise InputInvalid.of(
            "inconsistent", "give options for gains by matrix inequality, or a proof for direct injection"
        )
    masks = bank_masks(len(system.C), max_attacked, most=most)
    if proof is not None:
        return tuple(circle_discrete.design(system, mask, gains=proof) for mask in masks)
    assert options is not None  # noqa: S101  # exactly one of the two, checked above
    made = discrete_circles(system, [np.flatnonzero(mask) for mask in masks], options)
    return tuple(
        circle_discrete.design(system, mask, gains=one) for mask, one in zip(masks, made, strict=True)
    )


def design(
    observers: Sequence[DiscreteDesign],
    max_attacked: int,
    *,
    noise: float,
    length: int,
    start: float = 0.0,
    epsilon: float = 0.0,
    gains: Floats | None = None,
    unknown: float = 0.0,
    rule: Rule = "majority",
) -> WindowDesign:
    """Thresholds of a bank, `2 (epsilon + gamma m)`.

    noise: m, supremum of the Euclidean norm of all meters' noise.
    start: bound on every observer's initial error; 0 for starts in the true state.
    epsilon: its largest remainder when windows begin.
    gains (o,): gamma of each observer; by default the proven ones. Simulated ones give smaller thresholds
        that are not bounds.
    unknown: supremum of the norm of further unknowns; its share `gamma_delta unknown` is part of epsilon in
        (10) and (19), observer by observer.
    rule: isolation rule of a window.
    Raises ValueError with every number that is not finite or is negative, if the rule is unknown, or if the
        observers are not those of a bank.
    Source: yang2019 (10), (19).
    """
    p = len(observers[0].system.C)
    sets = subsets(p, max_attacked, most=MOST_OBSERVERS)
    wanted = bank_masks(p, max_attacked)
    if not np.array_equal(np.stack([one.trusted for one in observers]), wanted):
        raise InputInvalid.of(
            "wrong-design",
            f"no bank for {p} meters and max_attacked {max_attacked}, in the order of `bank_masks`",
        )
    gamma = np.array([one.noise_gain for one in observers]) if gains is None else np.asarray(gains)
    sizes = {"noise": noise, "start": start, "epsilon": epsilon, "unknown": unknown}
    problems = _problems(sizes, gamma, len(observers), length)
    raise_if_any((*problems, *no_choice("rule", get_args(Rule), rule)))
    level = epsilon + gamma * noise
    if unknown > 0.0:
        level = level + np.array([one.unknown_gain for one in observers]) * unknown
    if not np.all(np.isfinite(level)):
        raise InputInvalid.of(
            "not-finite", "an observer has no finite bound of its error: no value would ever exceed it"
        )
    large, small = level[1 : 1 + sets.count_large], level[1 + sets.count_large :]
    spread = np.broadcast_to(small, sets.parent.shape).ravel()[sets.pairs].max(axis=1)
    return WindowDesign(
        observers=stack(observers),
        sets=sets,
        gains=frozen(gamma),
        noise=float(noise),
        epsilon=float(epsilon),
        settling=max(settling_steps(one, start=start, epsilon=epsilon) for one in observers),
        detect_above=float(2.0 * max(level[0], large.max())),
        isolate_above=frozen(2.0 * np.maximum(large, spread)),
        length=int(length),
        rule=rule,
    )


def _problems(sizes: dict[str, float], gains: Floats, observers: int, length: int) -> list[Problem]:
    """Problems of the numbers behind the thresholds."""
    numbers = {**{name: np.array(size) for name, size in sizes.items()}, "gains": gains}
    problems = [
        Problem("negative", f"{name} must be finite and not negative, got {value.tolist()}")
        for name, value in numbers.items()
        if not np.all(np.isfinite(value) & (value >= 0.0))
    ]
    if gains.shape != (observers,):
        problems.append(
            Problem("shape", f"gains have the shape {gains.shape}; one for each of {observers} observers")
        )
    if length < 1:
        problems.append(Problem("out-of-range", "a window has at least one step"))
    return problems


def consistency(design: WindowDesign, x: Floats) -> tuple[Floats, Floats]:
    """Both measures, pi and pi_J, of a set of estimates.

    x (…, o, n): all estimates.
    Returns pi (…), pi_J (…, s): Euclidean distances.
    Source: yang2019 (8), (17).
    """
    sets, first = design.sets, 1 + design.sets.count_large
    whole, large, small = x[..., :1, :], x[..., 1:first, :], x[..., first:, :]
    pi = np.linalg.norm(large - whole, axis=-1).max(axis=-1)
    gaps = np.stack(
        [np.linalg.norm(small - large[..., parent, :], axis=-1) for parent in sets.parent], axis=-2
    )
    flat = gaps.reshape(*gaps.shape[:-2], -1)
    return pi, np.asarray(flat[..., sets.pairs].max(axis=-1))


# Value for observers that are never judged again, since their error after a gap has no bound.
_NEVER = np.iinfo(np.intp).max


@dataclass(frozen=True, slots=True, eq=False)
class WindowState:
    """State of the bank within its window."""

    t: float  # time, s
    x: Floats  # (o, n) all estimates
    k: int  # steps since the start
    stale: Ints  # (o,) steps until each observer has settled
    pi: Floats  # (i,) pi of the window's steps so far; NaN where not judged
    pi_sets: Floats  # (i, s) likewise pi_J


@dataclass(frozen=True, slots=True, eq=False)
class WindowVerdict:
    """Result of one window."""

    t: float  # time of its last step, s
    # Algorithm 1: CLEAN, ATTACKED, or UNDECIDED if a step was not judged and none exceeded
    detection: Decision
    # Algorithm 2: ATTACKED, CLEAN if no meter is suspect and every set was judged at every step, or UNDECIDED
    isolation: Decision
    suspects: Bools  # (p,) meters named by Algorithm 2
    score: Floats  # (1 + s,) largest pi and pi_J of the window
    threshold: Floats  # (1 + s,) their thresholds


def init(design: WindowDesign, t: float, x: Floats) -> WindowState:
    """Initial state of the bank at t, s; every observer starts at x (n,)."""
    count = len(design.observers.masks)
    start = np.repeat(np.asarray(x, dtype=np.float64)[None, :], count, axis=0)
    stale = np.full(count, design.settling, dtype=np.intp)
    return WindowState(float(t), start, 0, stale, np.zeros(0), np.zeros((0, design.sets.count_large)))


def step(
    design: WindowDesign, state: WindowState, y: Floats, u: Floats, seen: Bools
) -> tuple[WindowState, WindowVerdict | None]:
    """Judge the estimates of this step, then advance them with its readings.

    y (p,): readings; ignored where unseen or not finite.
    u (l,).
    seen (p,): True for existing readings. An observer with an unavailable meter continues without it and is
        not judged until k* steps after the meter is back, provided that its error is then within `start` of
        `design`. Without such a bound (`start` = 0) it is not judged again at all.
    Returns a verdict at the last step of every window, otherwise None.
    """
    here = np.asarray(seen, dtype=np.bool_) & np.isfinite(y)
    pi, pi_sets = state.pi, state.pi_sets
    if state.k >= design.settling:
        now, now_sets = _judged(design, state)
        pi, pi_sets = np.append(pi, now), np.vstack([pi_sets, now_sets])
    silent = (design.observers.masks & ~here).any(axis=1)
    # Steps until the next estimate is judged.
    stale = np.maximum(state.stale - (state.stale < _NEVER), 0)
    stale = np.where(silent, design.settling if design.settling else _NEVER, stale)
    x = advance(design.observers, state.x, y, u, here)
    after = replace(
        state,
        t=state.t + design.observers.system.h,
        x=x,
        k=state.k + 1,
        stale=stale,
        pi=pi,
        pi_sets=pi_sets,
    )
    if len(pi) < design.length:
        return after, None
    verdict = _verdict(design, state.t, pi, pi_sets)
    return replace(after, pi=np.zeros(0), pi_sets=np.zeros((0, design.sets.count_large))), verdict


def _judged(design: WindowDesign, state: WindowState) -> tuple[float, Floats]:
    """Both measures of the present estimates; NaN if an observer involved has not settled."""
    pi, pi_sets = consistency(design, state.x)
    sets, settled = design.sets, state.stale == 0
    large, small = settled[1 : 1 + sets.count_large], settled[1 + sets.count_large :]
    within = np.broadcast_to(small, sets.parent.shape).ravel()[sets.pairs].all(axis=1)
    whole = bool(settled[0] and large.all())
    return (float(pi) if whole else np.nan), np.where(large & within, pi_sets, np.nan)


def _verdict(design: WindowDesign, t: float, pi: Floats, pi_sets: Floats) -> WindowVerdict:
    found = isolation(pi_sets, design.isolate_above, design.large, design.length, design.rule)
    seen = bool(np.isfinite(pi).all())
    exceeded = bool(exceeds(pi, design.detect_above).any())
    quiet = Decision.CLEAN if seen else Decision.UNDECIDED
    suspects = np.asarray(found.suspects[0])
    # Steps that were not judged clear no meter.
    whole = bool(found.decided[0] and np.isfinite(pi_sets).all())
    cleared = Decision.CLEAN if whole else Decision.UNDECIDED
    largest = np.concatenate([[_top(pi)], [_top(column) for column in pi_sets.T]])
    return WindowVerdict(
        t=t,
        detection=Decision.ATTACKED if exceeded else quiet,
        isolation=Decision.ATTACKED if suspects.any() else cleared,
        suspects=suspects,
        score=largest,
        threshold=np.concatenate([[design.detect_above], design.isolate_above]),
    )


def _top(values: Floats) -> float:
    """Largest finite entry, NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """One simulated run or several. T steps, R runs on a leading axis if there are several."""

    pi: Floats  # (…, T) consistency measure of all large sets
    pi_sets: Floats  # (…, T, s) consistency measure of each
    error: Floats  # (…, T, o) `|x_hat - x|` of every observer


def simulate(
    design: WindowDesign, x: Floats, u: Floats, disturbance: Floats, apart: Floats | float = 0.0
) -> Trace:
    """Simulate plant and bank together under given noise and attacks.

    x (…, n): initial states of the plant.
    u (T, l). disturbance (…, T, p): noise plus attack of every meter.
    apart (…, n) or scalar: initial error of every observer.
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

    honest: from `simulate` without attack.
    Raises ValueError if the measures are not finite, or all runs end before windows begin.
    """
    first = design.settling
    measures = {"pi": honest.pi[..., first:], "pi_sets": honest.pi_sets[..., first:, :]}
    raise_if_any(
        Problem("not-finite", f"{name} has no finite numbers alone from step {first} on")
        for name, found in measures.items()
        if not (found.size and np.isfinite(found).all())
    )
    top = measures["pi_sets"].reshape(-1, design.sets.count_large).max(axis=0)
    return replace(design, detect_above=float(measures["pi"].max()), isolate_above=frozen(top))

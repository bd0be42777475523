"""Bank of discrete-time observers, its thresholds, and its consistency measures.

References
----------
yang2019 (8), (10), (17), (19).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from gridsec.arrays import Bools, Floats, frozen
from gridsec.choices import no_choice
from gridsec.errors import InputInvalid, Problem, refuse
from gridsec.lmi.discrete import DiscreteOptions, discrete_circles
from gridsec.lmi.discrete_bounds import DirectProof
from gridsec.lmi.sampled import DiscreteLure
from gridsec.observers import circle_discrete
from gridsec.observers.circle_discrete import DiscreteDesign, Stack, settling_steps, stack
from gridsec.subsets import Subsets, subsets
from gridsec.windows.rules import Rule

MOST_OBSERVERS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class WindowDesign:
    """Bank with its thresholds. p meters, at most q manipulated, s = C(p, q) large sets, o observers.

    Attributes
    ----------
    observers
        All o = 1 + C(p, q) + C(p, 2q) observers: of all meters, of the large sets J, of the small sets S.
    sets
        J and S, and the compared pairs.
    gains : (o,)
        gamma of each observer.
    noise
        m, supremum over time of the Euclidean norm of all meters' noise.
    epsilon
        Largest remainder of the initial error when windows begin.
    settling
        k*, first step of the first window.
    detect_above
        Threshold of pi.
    isolate_above : (s,)
        Thresholds of pi_J.
    length
        N, steps in a window.
    rule
        Isolation rule of a window: "majority" is Algorithm 2; "survivors" keeps the J that never failed.
    """

    observers: Stack
    sets: Subsets
    gains: Floats
    noise: float
    epsilon: float
    settling: int
    detect_above: float
    isolate_above: Floats
    length: int
    rule: Rule


def bank_masks(meters: int, max_attacked: int, *, most: int = MOST_OBSERVERS) -> Bools:
    """Sets of meters of all observers of a bank, in their order: all meters, then J, then S.

    Parameters
    ----------
    meters
        p.
    max_attacked
        q.
    most
        Largest acceptable number of observers.

    Returns
    -------
    (o, p)
        Masks.
    """
    sets = subsets(meters, max_attacked, most=most)
    return np.vstack([np.ones((1, meters), dtype=np.bool_), sets.masks()])


def bank(
    system: DiscreteLure,
    max_attacked: int,
    *,
    options: DiscreteOptions | None = None,
    proof: DirectProof | None = None,
    most: int = MOST_OBSERVERS,
) -> tuple[DiscreteDesign, ...]:
    """Design all observers: of all meters, of every p - q and of every p - 2q of them.

    Parameters
    ----------
    system
        Plant with p meters.
    max_attacked
        q, at least 1.
    options
        For gains by matrix inequality. Either `options` or `proof` is required.
    proof
        For direct injection.
    most
        Largest acceptable number of observers.

    Raises
    ------
    NotObservable
        Unless p > 2q.
    DesignInfeasible
        If there are more than `most` observers, or an observer cannot be designed.
    ValueError
        If `max_attacked` is below 1, or not exactly one of `options` and `proof` is given.
    """
    if max_attacked < 1:
        raise InputInvalid(
            [
                Problem(
                    "out-of-range",
                    "max_attacked must be at least 1: otherwise there is nothing to isolate",
                )
            ]
        )
    if (options is None) == (proof is None):
        raise InputInvalid(
            [
                Problem(
                    "inconsistent",
                    "give options for gains by matrix inequality, or a proof for direct injection",
                )
            ]
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

    Parameters
    ----------
    observers
        From `bank`.
    max_attacked
        q, as there.
    noise
        m, supremum of the Euclidean norm of all meters' noise.
    length
        N.
    start
        Bound on every observer's initial error; 0 for starts in the true state.
    epsilon
        Its largest remainder when windows begin.
    gains : (o,)
        gamma of each observer; by default the proven ones. Simulated ones give smaller thresholds that are
        not bounds.
    unknown
        Supremum of the norm of further unknowns; its share `gamma_delta unknown` is part of epsilon
        in (10) and (19), observer by observer.
    rule
        Isolation rule of a window.

    Raises
    ------
    ValueError
        With every number that is not finite or is negative, if the rule is unknown, or if the observers are
        not those of a bank.

    References
    ----------
    yang2019 (10), (19).
    """
    p = len(observers[0].system.C)
    sets = subsets(p, max_attacked, most=MOST_OBSERVERS)
    wanted = bank_masks(p, max_attacked)
    if not np.array_equal(np.stack([one.trusted for one in observers]), wanted):
        raise InputInvalid(
            [
                Problem(
                    "wrong-design",
                    f"no bank for {p} meters and max_attacked {max_attacked}, in the order of `bank_masks`",
                )
            ]
        )
    gamma = np.array([one.noise_gain for one in observers]) if gains is None else np.asarray(gains)
    sizes = {"noise": noise, "start": start, "epsilon": epsilon, "unknown": unknown}
    problems = _problems(sizes, gamma, len(observers), length)
    refuse((*problems, *no_choice("rule", get_args(Rule), rule)))
    level = epsilon + gamma * noise
    if unknown > 0.0:
        level = level + np.array([one.unknown_gain for one in observers]) * unknown
    if not np.all(np.isfinite(level)):
        raise InputInvalid(
            [
                Problem(
                    "not-finite",
                    "an observer has no finite bound of its error: no value would ever exceed it",
                )
            ]
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

    Parameters
    ----------
    x : (…, o, n)
        All estimates.

    Returns
    -------
    pi, pi_J : (…), (…, s)
        Euclidean distances.

    References
    ----------
    yang2019 (8), (17).
    """
    sets, first = design.sets, 1 + design.sets.count_large
    whole, large, small = x[..., :1, :], x[..., 1:first, :], x[..., first:, :]
    pi = np.linalg.norm(large - whole, axis=-1).max(axis=-1)
    gaps = np.stack(
        [np.linalg.norm(small - large[..., parent, :], axis=-1) for parent in sets.parent], axis=-2
    )
    flat = gaps.reshape(*gaps.shape[:-2], -1)
    return pi, np.asarray(flat[..., sets.pairs].max(axis=-1))

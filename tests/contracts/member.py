"""What the contracts know about a family of observers: its border, and plants that fit it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gridsec.arrays import Bools, Floats


@dataclass(frozen=True)
class Run:
    """A plant's course and its readings. R readings, n states, p sensors, l inputs.

    `step` is called with `r[k]`, `u[k]`; afterwards the observers estimate `x[k]`, and `outputs` is to be
    compared with `r[k + ahead]`, knowing `u[k + ahead]`. There are R - ahead calls.
    """

    # State of the plant when the observers start, and what they take it for.
    first: Floats
    guess: Floats
    # (R, p), (R, l), (R - ahead, n)
    r: Floats
    u: Floats
    x: Floats
    # Length of a step, s.
    h: float
    ahead: int = 0
    # Whatever else the family wants to know before its first step.
    prior: Any = None

    @property
    def calls(self) -> int:
        return len(self.r) - self.ahead

    def lied(self, liar: int, lie: float, onset: int) -> Run:
        """The same with one sensor off by `lie` from the reading `onset` on."""
        r = self.r.copy()
        r[onset:, liar] += lie
        return replace(self, r=r)


@dataclass(frozen=True)
class Member:
    """One observer, or several that a family can only run together. c observers, p sensors."""

    # (c, p): which sensors each observer may listen to, and which ones it predicts.
    listens: Bools
    predicts: Bools
    # (c, p): part of a sudden lie that an observer's residual shows. Below 1 only where an observer must
    # take part of it for an input that it does not know.
    share: Floats
    # Run -> state, at the run's guess.
    start: Callable[[Run], Any]
    # (state, y, u, seen, h) -> state
    step: Callable[[Any, Floats, Floats, Bools, float], Any]
    # state -> c estimates, and x -> c vectors that these should be.
    estimates: Callable[[Any], list[Floats]]
    code: Callable[[Floats], list[Floats]]
    # c errors -> (c,), norms in which errors decay.
    norms: Callable[[list[Floats]], Floats]
    # Number of calls -> (c,): part of the first error that may be left without disturbances.
    decay: Callable[[int], Floats]
    # Added to `decay`: what reading a moving plant at instants costs; rounding where a step is exact.
    slack: float
    # (state, u) -> (c, p); state -> (c, p), bound of the difference to honest readings.
    outputs: Callable[[Any, Floats], Floats]
    bound: Callable[[Any], Floats]
    # (liar, lie, x) -> (c,): movement, in the norm, that the design claims; 0: it claims none.
    claims: Callable[[int, float, Floats], Floats]
    # rng -> exact readings, wrong guess; (rng, extreme) -> all errors that are allowed; () -> neither.
    free: Callable[[np.random.Generator], Run]
    honest: Callable[[np.random.Generator, bool], Run]
    calm: Callable[[], Run]
    # Lengths of steps that must work, s.
    lengths: tuple[float, ...]


@dataclass(frozen=True)
class Batch:
    """Many observers at once, and the same ones each on its own."""

    sensors: int
    inputs: int
    # Size of the readings and inputs to try.
    size: float
    # (y, u) -> state of all, states of the single ones, all starting alike.
    start: Callable[[Floats, Floats], tuple[Any, list[Any]]]
    step: Callable[[Any, Floats, Floats, Bools, float], Any]
    # Index -> step of that single observer.
    single: Callable[[int], Callable[[Any, Floats, Floats, Bools, float], Any]]
    estimates: Callable[[Any], list[Floats]]
    alone: Callable[[int, Any], Floats]
    # (length, silent sensors), in turn.
    steps: tuple[tuple[float, tuple[int, ...]], ...]


@dataclass(frozen=True)
class Family:
    """All members of a family that the contracts look at, made when first needed."""

    members: Mapping[str, Callable[[], Member]]
    batches: Mapping[str, Callable[[], Batch]]
    # Why steps have one length only; empty: they may be of any length, up to a day.
    one_length: str


def signs_or_anything(rng: np.random.Generator, size: Floats, extreme: bool) -> Floats:
    """Errors up to `size`: all as large as they may be, or anything between."""
    draw = rng.choice([-1.0, 1.0], size.shape) if extreme else rng.uniform(-1.0, 1.0, size.shape)
    return np.asarray(size * draw)


def started_away(rng: np.random.Generator, size: float, n: int) -> Floats:
    """Error of a first guess; in half of the cases none, so that nothing but later errors fills a bound."""
    return np.asarray(size * rng.integers(2) * rng.uniform(-1.0, 1.0, n))

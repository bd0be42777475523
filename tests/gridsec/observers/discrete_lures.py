"""Discrete-time plants that tests share."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from gridsec.observers.lmi.discrete import DiscreteGains, DiscreteOptions, discrete_circles, discrete_options
from gridsec.observers.lmi.sampled import DiscreteLure
from gridsec.papers import yang2019

EVERY = [J for size in (1, 2, 3, 4) for J in combinations(range(4), size)]


def sine(**changes: object) -> DiscreteLure:
    return replace(yang2019.system(), **changes)  # type: ignore[arg-type]


def options(decays: object = yang2019.DECAYS) -> DiscreteOptions:
    return discrete_options(sine(), decays=decays, noise=1.0)  # type: ignore[arg-type]


def mask(J: tuple[int, ...], p: int = 4) -> np.ndarray:
    return np.isin(np.arange(p), J)


CACHE: dict[tuple[int, ...], DiscreteGains] = {}


def gains_of(J: tuple[int, ...]) -> DiscreteGains:
    if not CACHE:
        CACHE.update(zip(EVERY, discrete_circles(sine(), EVERY, options()), strict=True))
    return CACHE[J]

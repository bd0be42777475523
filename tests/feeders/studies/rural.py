"""A study of SimBench LV rural 1 that more than one file looks at."""

from __future__ import annotations

from functools import cache

from feeders.model.site import load
from feeders.studies.detectable import Detectable, detectable

RURAL = load("simbench-lv-rural1")


@cache
def rural_sizes() -> Detectable:
    """Sizes of lies of up to two meters."""
    return detectable(RURAL, max_attacked=2)

"""Library of load and generation profiles: some weeks of every season at 15 min, relative to the peak."""

from __future__ import annotations

import csv
import gzip
import io
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Final

import numpy as np

from gridsec.errors import choice
from gridsec.interface import Floats

ENVELOPES = "envelopes.csv"
TIME = "t_s"

PROFILE_STEP_S: Final = 900.0
"""Interval between two samples, s."""


class Season(StrEnum):
    """Season of a profile."""

    WINTER = "winter"
    SPRING = "spring"
    SUMMER = "summer"
    AUTUMN = "autumn"

    @property
    def file(self) -> str:
        """Name of the season's file in data/profiles."""
        return f"{self}.csv.gz"


def data_root() -> Traversable:
    """Folder of the data: beside the packages in a checkout, inside them in a wheel."""
    packaged = resources.files("feeders") / "data"
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[1] / "data"


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Profiles over time, for linear interpolation between samples."""

    t_s: Floats  # (T,), time since the first sample, s; the first sample is at 00:00 of a Monday
    # name -> (T,), active and reactive power of a load, as a fraction of its peak `load_kw` and of the
    # reactive power of `load_kw` at its expected power factor
    load_p: dict[str, Floats]
    load_q: dict[str, Floats]
    pv: dict[str, Floats]  # name -> (T,), generation, fraction of its peak `pv_kw`


@dataclass(frozen=True, slots=True)
class ReactiveEnvelope:
    """Limits of a load profile's reactive power, known from its history.

    With p and q as fractions of `load_kw` and of the reactive power of `load_kw` at the expected power
    factor: ``low p - floor <= q <= high p + floor``.
    """

    low: float
    high: float
    floor: float


@cache
def envelopes() -> dict[str, ReactiveEnvelope]:
    """Envelope of every load profile; see data/profiles/SOURCE.md."""
    text = (data_root() / "profiles" / ENVELOPES).read_text(encoding="ascii")
    rows = csv.DictReader(io.StringIO(text))
    return {
        row["load_profile"]: ReactiveEnvelope(
            float(row["q_low"]), float(row["q_high"]), float(row["q_floor"])
        )
        for row in rows
    }


def library(season: Season = Season.SUMMER) -> Profiles:
    """One season of the bundled library, see data/profiles/SOURCE.md; summer has two weeks, the others one.

    Raises ValueError for an unknown season.
    """
    return _read(choice("season", Season, season))


def _text(season: Season) -> str:
    return gzip.decompress((data_root() / "profiles" / season.file).read_bytes()).decode("ascii")


@cache
def _header() -> tuple[str, ...]:
    return tuple(next(csv.reader(io.StringIO(_text(Season.SUMMER)))))


@cache
def _read(season: Season) -> Profiles:
    table = np.loadtxt(io.StringIO(_text(season)), delimiter=",", skiprows=1, dtype=np.float64)
    table.setflags(write=False)
    columns = dict(zip(_header(), table.T, strict=True))
    return Profiles(
        columns[TIME],
        {name: columns[f"{name}_p"] for name in load_names()},
        {name: columns[f"{name}_q"] for name in load_names()},
        {name: columns[name] for name in pv_names()},
    )


def profile(curves: dict[str, Floats], name: str) -> Floats:
    """One profile of `Profiles.load_p`, `load_q` or `pv`; without a name the mean of all."""
    return curves[name] if name else np.asarray(np.mean(list(curves.values()), axis=0))


def load_names() -> tuple[str, ...]:
    """Valid names of `load_profile`."""
    return tuple(name.removesuffix("_p") for name in _header() if name.endswith("_p"))


def pv_names() -> tuple[str, ...]:
    """Valid names of `pv_profile`."""
    return tuple(name for name in _header() if name.startswith("PV"))

"""SimBench data: grids with the profile of each load, and the slices of the profile library.

Needs the optional extra `convert`; the monitor does not use it.
"""

from __future__ import annotations

import csv
import gzip
import io
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from math import ceil, floor
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from feeders.convert.provenance import SourceUnreadable
from feeders.profiles import ReactiveEnvelope, Season
from feeders.util import extra
from gridsec.arrays import Floats
from gridsec.errors import GridsecError

# SimBench counts voltage levels from extra-high (1) to low voltage.
LOW_VOLTAGE = 7
STEP_S = 900
STEPS_PER_DAY = 96
DIGITS = 4

NEW_YEAR = date(2016, 1, 1)
SUMMER_TIME = (date(2016, 3, 27), date(2016, 10, 30))
"""Daylight saving time of the year in local time: the clock goes forward on the first day, back on the other.
"""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive days of the year."""

    monday: date  # First day, from 00:00 local time
    days: int  # Number of days

    @property
    def rows(self) -> slice:
        """Samples of the stretch within the year's."""
        forward, back = SUMMER_TIME
        first = (self.monday - NEW_YEAR).days * STEPS_PER_DAY - 4 * (forward < self.monday <= back)
        return slice(first, first + self.days * STEPS_PER_DAY)


# Weeks without public holidays in Germany, the country of SimBench's loads.
STRETCHES = {
    Season.WINTER: Stretch(date(2016, 1, 11), 7),
    Season.SPRING: Stretch(date(2016, 4, 18), 7),
    Season.SUMMER: Stretch(date(2016, 6, 6), 14),
    Season.AUTUMN: Stretch(date(2016, 10, 17), 7),
}


def grid(code: str) -> Any:
    """SimBench grid as a pandapower net, with its profiles in `net.profiles`.

    Raises SourceUnreadable for an unknown code; GridsecError if simbench is not installed.
    """
    simbench = _simbench()
    if code not in simbench.collect_all_simbench_codes():
        raise SourceUnreadable(
            f"SimBench has no grid {code!r}; a code looks like 1-LV-rural1--0-sw", code="unknown-name"
        )
    return simbench.get_simbench_net(code)


def year() -> dict[str, Floats]:
    """Every low-voltage profile of the year: load profiles as `_pload`, `_qload`, and PV.

    Raises GridsecError if simbench is not installed.
    """
    simbench = _simbench()
    folder = simbench.complete_data_path(0)
    columns: dict[str, Floats] = {}
    for kind, parts in (("Load", ("_pload", "_qload")), ("RES", ("",))):
        units = simbench.read_csv_data(folder, ";", kind)
        profiles = simbench.read_csv_data(folder, ";", f"{kind}Profile")
        for name in units.profile[units.voltLvl == LOW_VOLTAGE].dropna().unique():
            for part in parts:
                columns[name + part] = profiles[name + part].to_numpy(dtype=np.float64)
    return columns


def _simbench() -> Any:
    try:
        import simbench
    except ImportError as error:
        raise GridsecError(f"SimBench grids need {extra('convert')}", code="not-installed") from error
    return simbench


def library_csv(columns: Mapping[str, Floats], season: Season) -> bytes:
    """Season of the library as gzipped CSV: t_s, then `<load>_p`, `<load>_q`, `<pv>`."""
    rows = STRETCHES[season].rows
    names: list[tuple[str, str]] = []
    for load in load_profiles(columns):
        names += [(f"{load}_p", f"{load}_pload"), (f"{load}_q", f"{load}_qload")]
    names += [(name, name) for name in sorted(columns) if name.startswith("PV")]
    table = [columns[source][rows] for _, source in names]
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["t_s", *(name for name, _ in names)])
    for k, values in enumerate(zip(*table, strict=True)):
        writer.writerow([k * STEP_S, *(f"{value:.{DIGITS}g}" for value in values)])
    return gzip.compress(out.getvalue().encode("ascii"), compresslevel=9, mtime=0)


def load_profiles(columns: Mapping[str, Floats]) -> list[str]:
    """Names of the load profiles."""
    return sorted(name.removesuffix("_pload") for name in columns if name.endswith("_pload"))


def envelope(p: Floats, q: Floats) -> ReactiveEnvelope:
    """Smallest wedge with a floor that contains every point (T,) of a load profile.

    Minimises the mean width ``(high - low) w + 2 floor`` subject to ``low p - floor <= q <= high p + floor``
    for all points, ``0 <= low <= 1 <= high``, at ``w = max(mean p, 0.3)``: at a weight as small as a
    household's mean, the upper slope would be several times the nominal one, and useless for an unknown load.
    Powers are fractions of their nominal values.

    Raises GridsecError without a solution.
    """
    points = np.column_stack([p, q])
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:  # all points on one line: nothing to thin out
        points = np.unique(points, axis=0)
    weight = max(float(p.mean()), 0.3)
    one, none = np.ones(len(points)), np.zeros(len(points))
    sides = np.vstack(
        [
            np.column_stack([points[:, 0], none, -one]),
            np.column_stack([none, -points[:, 0], -one]),
        ]
    )
    found = linprog(
        [-weight, weight, 2.0],
        A_ub=sides,
        b_ub=np.concatenate([points[:, 1], -points[:, 1]]),
        bounds=[(0.0, 1.0), (1.0, None), (0.0, None)],
    )
    if not found.success or found.x is None:
        raise GridsecError(f"no envelope of the load profile: {found.message}", code="no-solution")
    low, high, bottom = map(float, found.x)
    # Rounded outwards, and wide enough for the rounded samples of the slices.
    return ReactiveEnvelope(floor(low * 1e3) / 1e3, ceil(high * 1e3) / 1e3, ceil((bottom + 1e-3) * 1e3) / 1e3)


def envelopes_csv(columns: Mapping[str, Floats]) -> str:
    """Envelope of every load profile, from the whole year, as CSV."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["load_profile", "q_low", "q_high", "q_floor"])
    for load in load_profiles(columns):
        found = envelope(columns[f"{load}_pload"], columns[f"{load}_qload"])
        writer.writerow([load, found.low, found.high, found.floor])
    return out.getvalue()

"""Readings of a recording or a table as frames of all meters, for the comparison with a feeder."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from pandas.api.types import (
    is_bool_dtype,
    is_complex_dtype,
    is_numeric_dtype,
    is_object_dtype,
    is_string_dtype,
)

from feeders.model.site import Site, one_phase_each
from feeders.model.three_phase import ThreePhaseSite
from feeders.simulation.plant import BUSBAR
from feeders.simulation.recording import REQUIRED, Recording, RecordingInvalid, read_recording
from feeders.simulation.scenario import LATEST_S
from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import Problem
from gridsec.grid.three_phase import PHASES

__all__ = ["Frames", "blind", "frames"]

MOST_FRAMES: Final = 720  # number of frames from which on frames are averaged
FEWEST_FRAMES: Final = 48  # smallest number of frames that determines the varying errors
FARTHEST_S: Final = 10.0 * 365.25 * 86400.0  # of times from their median; beyond it a clock was not set
NUMBERS: Final = ("t", "v_volt", "p_kw", "q_kvar")  # columns of numbers
USUAL: Final = (0.5, 1.5)  # range of a meter's median voltage, relative to nominal, from phase to neutral

_PAIR: Final = (0.9 * 3.0**0.5, 1.1 * 3.0**0.5)
_KILOVOLT: Final = (0.5e-3, 2e-3)

_EXPECTED: Final = {"t": "expected Unix time in seconds"}

OFTEN: Final = 0.5  # smallest share of frames with voltages of a phase of the busbar that counts as read
FEWEST_SPANS: Final = 6.0  # smallest length of a recording in correlation times of the load errors


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Readings of T frames in SI, net import positive. p meters; NaN for missing values."""

    meter_ids: tuple[str, ...]
    t: Floats  # (T,) middle of each frame, Unix s
    v_volt: Floats  # (T, p) means of the readings, as p_kw and q_kvar
    p_kw: Floats
    q_kvar: Floats
    v0_volt: Floats  # (T,) busbar voltage
    v0_phases: Floats  # (T, 3) NaN in all frames for an unread phase
    count: Floats  # (T, p + 1) readings of each mean, the busbar's last; effective number for three channels
    step_s: float  # interval between readings

    @property
    def unread(self) -> str:
        """Phases without a voltage of the busbar."""
        missing = ~np.isfinite(self.v0_phases).all(axis=0)
        return "".join(PHASES[k] for k in np.flatnonzero(missing))


def open_readings(path: Path | str) -> pd.DataFrame | Recording:
    """Open a recording (Parquet, simulated or external) or a CSV table with the same columns.

    Raises RecordingInvalid for any other file.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        return read_recording(path)
    try:
        # The converter keeps ids as text: "NA" and "null" are valid names.
        return pd.read_csv(path, converters={"meter": str})
    except (OSError, ValueError) as error:
        raise RecordingInvalid(Problem("unreadable", f"{path}: not a table of readings: {error}")) from error


def frames(
    site: Site | ThreePhaseSite,
    readings: pd.DataFrame | Recording | Path | str,
    *,
    exclude: Collection[str] = (),
) -> Frames:
    """Average readings to frames; the values of the meters in `exclude` are not checked.

    A meter of a three-phase customer may be read as a whole, or as its three channels
    (`feeders.model.site.one_phase_each`). Its voltage is then their mean and its powers are their sums, where
    all three exist.

    Raises RecordingInvalid for missing columns, columns without numbers, times other than Unix seconds,
        voltages and powers not in V from phase to neutral, kW and kvar, unknown meters, meters read both as a
        whole and by channels, a recording of another feeder, a busbar without readings (in three phases of
        the phases of any meter), or too few frames.
    """
    given = open_readings(readings) if isinstance(readings, (Path, str)) else readings
    if not isinstance(given, pd.DataFrame):
        if given.feeder is not None and given.feeder != site.feeder.name:
            text = f"{given.path}: recorded on {given.feeder}, not on {site.feeder.name}"
            raise RecordingInvalid(Problem("other-origin", text))
        given = given.frame()
    missing = [name for name in REQUIRED if name not in given.columns]
    problems = [Problem("missing", f"columns {', '.join(missing)} are missing")] if missing else []
    told = {name: _numbers(given[name], problems) for name in NUMBERS if name in given}
    numbers = {name: values for name, values in told.items() if values is not None}
    if "t" in numbers:
        problems += _wrong_times(numbers["t"])
    meter = given["meter"].astype("string").fillna(BUSBAR) if "meter" in given else pd.Series(dtype="string")
    channels = _channels(site)
    known = {name: k for k, name in enumerate((*site.meter_ids, BUSBAR, *channels))}
    column = meter.map(known)
    unknown = sorted(set(meter[column.isna()]))
    if unknown:
        shown = ", ".join(unknown[:10]) + (f" and {len(unknown) - 10} more" if len(unknown) > 10 else "")
        text = f"there are meters that {site.feeder.name} does not have: {shown}"
        problems.append(Problem("unknown-name", text))
    if "meter" in given and not (column == len(site.meter_ids)).any():
        text = "no reading of the busbar (empty meter id); it is the reference of all others"
        problems.append(Problem("missing", text))
    if "meter" in given:
        problems += _twice(meter, channels)
        whole_meter = meter.mask(meter.isin(channels), meter.map(channels))
        problems += _wrong_units(site, numbers, whole_meter, exclude)
    if problems:
        raise RecordingInvalid(*problems, where="readings: ")
    whole = [site.meter_ids.index(name) for name in dict.fromkeys(channels.values())]
    found = _binned(site, given, numbers, np.asarray(column, dtype=np.intp), whole)
    if site.tables.in_phases and len(blind(site, found.unread)) == len(site.meter_ids):
        text = (
            f"readings: the busbar has no voltages of phase {' and '.join(found.unread)}, and without them "
            "no meter can be compared; expected v_phases, as [230.1, 230.4, 229.9]"
        )
        raise RecordingInvalid(Problem("missing", text))
    return found


def blind(site: Site | ThreePhaseSite, unread: str) -> tuple[str, ...]:
    """Meters on unread phases of the busbar; their errors cannot be determined."""
    rows = [site.tables.customers[k] for k in site.meters]
    return tuple(row.meter for row in rows if set(row.phases) & set(unread))


def _channels(site: Site | ThreePhaseSite) -> dict[str, str]:
    """Meter of each channel, for meters of three-phase customers in a feeder of three phases."""
    if not site.tables.in_phases:
        return {}
    rows = [site.tables.customers[k] for k in site.meters]
    return {
        part.meter: row.meter
        for row in rows
        if row.phases == "abc"
        for part in one_phase_each(replace(site.tables, customers=(row,))).customers
    }


def _twice(meter: pd.Series, channels: Mapping[str, str]) -> list[Problem]:
    """Problems of meters that are read both as a whole and by channels."""
    names = set(meter)
    both = sorted(names & {whole for channel, whole in channels.items() if channel in names})
    return [
        Problem("duplicate", f"there are both {one} and channels of it, as {one}-a; expected one of both")
        for one in both
    ]


def _numbers(column: pd.Series, problems: list[Problem]) -> Floats | None:
    """Column as numbers, NaN for missing ones; None, with a problem, for other content."""
    expected = _EXPECTED.get(str(column.name), "expected numbers")
    if is_numeric_dtype(column) and not is_bool_dtype(column) and not is_complex_dtype(column):
        return column.to_numpy(dtype=np.float64, na_value=np.nan)
    if not (is_object_dtype(column) or is_string_dtype(column)):
        problems.append(Problem("wrong-type", f"{column.name} is of type {column.dtype}; {expected}"))
        return None
    text = column.astype("string")
    values = pd.to_numeric(text, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    # An empty cell is not a wrong number.
    nothing = text.fillna("").str.strip().str.lower().isin(["", "nan"]).to_numpy()
    wrong = np.flatnonzero(np.isnan(values) & ~nothing)
    if wrong.size:
        told = f"{column.name} of {_rows(wrong)} is {text.iloc[wrong[0]]!r}; {expected}"
        problems.append(Problem("wrong-type", told))
        return None
    return values


def _wrong_times(t: Floats) -> list[Problem]:
    """Problems of times: not finite, in another unit, or far from all others."""
    finite = np.isfinite(t)
    plain = finite & (t >= 0.0) & (t < LATEST_S)
    middle = float(np.median(t[plain])) if plain.any() else 0.0
    problems = []
    far = plain & (np.abs(t - middle) > FARTHEST_S)
    for wrong, code, what in (
        (~finite, "not-finite", "expected a time"),
        (finite & ~plain, "out-of-range", "expected Unix time in seconds"),
        (far, "out-of-range", f"more than ten years from the usual {middle:.15g}"),
    ):
        rows = np.flatnonzero(wrong)
        if rows.size:
            problems.append(Problem(code, f"t of {_rows(rows)} is {t[rows[0]]:.15g}; {what}"))
    return problems


def _wrong_units(
    site: Site | ThreePhaseSite, numbers: dict[str, Floats], meter: pd.Series, exclude: Collection[str]
) -> list[Problem]:
    """Columns that are probably in another unit, by medians of meters, which short faults do not move."""
    nominal = dict(zip(site.meter_ids, site.customer_nominal[site.meters].tolist(), strict=True))
    nominal[BUSBAR] = site.tables.meta.voltage_volt
    most = site.loads.credible[site.meters] * site.tables.meta.base_kva
    credible = dict(zip(site.meter_ids, most.tolist(), strict=True))
    found: dict[tuple[str, str], list[tuple[str, float, float]]] = {}
    for name, limits in (("v_volt", nominal), ("p_kw", credible), ("q_kvar", credible)):
        values = np.abs(numbers.get(name, np.full(len(meter), np.nan)))
        there = np.isfinite(values)
        middles = pd.Series(values[there]).groupby(meter.to_numpy()[there]).median()
        for one, limit in limits.items():
            if one not in middles.index or one in exclude:
                continue
            middle = float(middles[one])
            doubt = _doubt(name, middle / limit)
            if doubt:
                found.setdefault((name, doubt), []).append((one, middle, limit))
    problems = []
    for (name, doubt), meters in found.items():
        one, middle, limit = meters[0]
        sources = (one or "the busbar") + (f" and {len(meters) - 1} more" if len(meters) > 1 else "")
        than = (
            f"where {limit:.4g} is nominal"
            if name == "v_volt"
            else f"where {limit:.4g} is the largest plausible value"
        )
        problems.append(Problem("doubtful", f"{name} of {sources} is usually {middle:.4g} {than}; {doubt}"))
    return problems


def _doubt(name: str, part: float) -> str:
    """Probable unit of a median, by its ratio to the nominal voltage or the largest power."""
    if name != "v_volt":
        return "" if part <= 1.0 else "in W?" if name == "p_kw" else "in var?"
    if USUAL[0] <= part <= USUAL[1]:
        return ""
    if _PAIR[0] <= part <= _PAIR[1]:
        return "a phase-to-phase voltage?"
    return "in kV?" if _KILOVOLT[0] <= part <= _KILOVOLT[1] else "expected V from phase to neutral"


def _rows(which: Ints) -> str:
    """First of some rows, counted from 1, and the number of others."""
    return f"row {which[0] + 1}" + (f" and {which.size - 1} more" if which.size > 1 else "")


def _binned(
    site: Site | ThreePhaseSite,
    given: pd.DataFrame,
    numbers: dict[str, Floats],
    column: Ints,
    whole: list[int],
) -> Frames:
    t = numbers["t"]
    width, step = len(site.meter_ids) + 1 + 3 * len(whole), _step(t, column)
    first = float(t.min())
    # Clocks have small offsets: frames are centred on the first tick.
    number = np.floor((t - first) / step + 0.5).astype(np.intp)
    together = max(1, int(np.ceil(np.unique(number).size / MOST_FRAMES)))
    tau = site.tables.meta.load.correlation_s
    together = max(1, min(together, int(tau / 3.0 / step))) if together > 1 else 1
    # Frames with readings only: between the first and the last there may be years without any.
    used, number = np.unique(number // together, return_inverse=True)
    size = (used.size, width)
    cell = number * width + column
    values = {}
    for name in ("v_volt", "p_kw", "q_kvar"):
        means = _means(cell, numbers.get(name, np.full(t.size, np.nan)), size)
        values[name] = _joined(*means, whole, 1.0 / 3.0 if name == "v_volt" else 1.0)
    v, count = values["v_volt"]
    phases = _phases(given, number, size[0])
    there = (np.isfinite(v[:, :-1]).mean(axis=1) >= 0.3) & np.isfinite(v[:, -1])
    there &= _complete(phases, there) | (not site.tables.in_phases)
    T = int(there.sum())
    span, wanted = T * step * together, max(FEWEST_FRAMES * step * together, FEWEST_SPANS * tau)
    if T < FEWEST_FRAMES or span < wanted:
        text = (
            f"too little data: {T} frames over {span / 3600:.3g} h; at least {FEWEST_FRAMES} frames over "
            f"{wanted / 3600:.3g} h are required; days give more information than hours"
        )
        raise RecordingInvalid(Problem("too-little-data", text))
    middle = first + (used * together + 0.5 * (together - 1)) * step
    return Frames(
        meter_ids=site.meter_ids,
        t=middle[there],
        v_volt=v[there, :-1],
        p_kw=values["p_kw"][0][there, :-1],
        q_kvar=values["q_kvar"][0][there, :-1],
        v0_volt=v[there, -1],
        v0_phases=phases[there],
        count=np.maximum(count[there], 1.0),
        step_s=step * together,
    )


def _phases(given: pd.DataFrame, number: Ints, ticks: int) -> Floats:
    """Means of the busbar's phase voltages, (T, 3); NaN for missing ones."""
    if "v_phases" not in given:
        return np.full((ticks, 3), np.nan)
    there = given["v_phases"].notna().to_numpy()
    try:
        rows = [
            json.loads(each) if isinstance(each, str) else list(each) for each in given["v_phases"][there]
        ]
        told = np.array(rows, dtype=np.float64).reshape(len(rows), 3)
    except (TypeError, ValueError) as error:
        text = "readings: v_phases are three voltages, as [230.1, 230.4, 229.9]"
        raise RecordingInvalid(Problem("shape", text)) from error
    cell = (number[there, None] * 3 + np.arange(3)).ravel()
    return _means(cell, told.ravel(), (ticks, 3))[0]


def _joined(mean: Floats, count: Floats, whole: list[int], share: float) -> tuple[Floats, Floats]:
    """Means and counts (T, p + 1) with those of the channels: `share` of the channels' sum.

    With n_f readings of independent channels the variance of their mean is that of ``9 / sum(1 / n_f)``
    readings of one channel.
    """
    width = mean.shape[1] - 3 * len(whole)
    three, n = (x[:, width:].reshape(len(x), -1, 3) for x in (mean, count))
    mean, count = mean[:, :width].copy(), count[:, :width].copy()
    together = share * three.sum(axis=2)
    by_channel = np.isfinite(together)
    mean[:, whole] = np.where(by_channel, together, mean[:, whole])
    with np.errstate(divide="ignore"):
        count[:, whole] = np.where(by_channel, 9.0 / (1.0 / n).sum(axis=2), count[:, whole])
    return mean, count


def _complete(phases: Floats, there: Bools) -> Bools:
    """Frames (T,) with voltages of all read phases; voltages of the others become NaN.

    In a frame without one of these phases its meters would be compared with the voltage of another phase.
    """
    read = np.isfinite(phases[there]).sum(axis=0) >= max(1.0, OFTEN * there.sum())
    phases[:, ~read] = np.nan
    return np.asarray(np.isfinite(phases[:, read]).all(axis=1))


def _step(t: Floats, column: Ints) -> float:
    """Interval between readings of the same meter: the median."""
    order = np.lexsort((t, column))
    gap = np.diff(t[order])[np.diff(column[order]) == 0]
    gap = gap[gap > 0.0]
    if not gap.size:
        text = "too little data: no meter has two readings at different times"
        raise RecordingInvalid(Problem("too-little-data", text))
    return float(np.median(gap))


def _means(cell: Ints, x: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Mean of the finite values of each cell, NaN without any; and their number."""
    good = np.isfinite(x)
    count = np.bincount(cell[good], minlength=size[0] * size[1]).astype(np.float64)
    total = np.bincount(cell[good], weights=x[good], minlength=size[0] * size[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        return (total / count).reshape(size), count.reshape(size)

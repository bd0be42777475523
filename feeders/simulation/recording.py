"""Recordings of scenarios and of real feeders as Parquet files.

One row is one arrived reading, in the order of arrival: a replay is a loop over the rows. The truth of a
simulation is in ``<name>.truth.parquet``, with one row per tick. Scenario and package versions are in the
metadata of both files under the key ``gridsec``. docs/simulation.md lists the columns.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from feeders.simulation.demand import Variation
from feeders.simulation.plant import BUSBAR, Channel, MeterErrors, MeterOutage
from feeders.simulation.scenario import Scenario, Season, SimulatedReading, SimulatedTick, simulate
from feeders.util import plain
from gridsec import attack as attacks
from gridsec.arrays import Bools, Floats
from gridsec.errors import GridsecError, InputInvalid, Problem, Problems

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site


_LISTS: Final = ("attacks", "busbar_attacks")
_KINDS: Final = {kind.__name__: kind for kind in get_args(attacks.Attack)}


def scenario_to_json(scenario: Scenario) -> dict[str, Any]:
    """Convert a scenario to JSON types; infinite times become the text "inf"."""
    told = asdict(scenario)
    for name in _LISTS:
        for entry, attack in zip(told[name], getattr(scenario, name), strict=True):
            entry["kind"] = type(attack).__name__
    out: dict[str, Any] = _told(plain(told))
    return out


def scenario_from_json(obj: dict[str, Any]) -> Scenario:
    """Inverse of `scenario_to_json`; KeyError, TypeError or ValueError for any other content."""
    given = {"busbar_attacks": (), "inverter_attacks": (), "season": Season.SUMMER} | _heard(obj)
    silences = tuple(MeterOutage(**silence) for silence in given["channel"]["silences"])
    given["channel"] = Channel(**given["channel"] | {"silences": silences})
    given["variation"] = Variation(**given["variation"])
    given["errors"] = MeterErrors(**given["errors"])
    for name in _LISTS:
        given[name] = tuple(_attack(_KINDS[entry.pop("kind")], entry) for entry in given[name])
    wrong = (_attack(attacks.InverterAttack, entry) for entry in given["inverter_attacks"])
    given["inverter_attacks"] = tuple(wrong)
    return Scenario(**given)


def _attack(kind: Any, entry: dict[str, Any]) -> Any:
    """Attack of a kind, with lists as arrays; lists of indices are integers."""
    types = {"meters": np.intp, "inverters": np.intp}
    return kind(
        **{
            name: np.array(value, dtype=types.get(name, np.float64)) if isinstance(value, list) else value
            for name, value in entry.items()
        }
    )


_INFINITE: Final = ("inf", "-inf")


def _told(value: Any) -> Any:
    """Convert infinities to text, recursively."""
    if isinstance(value, dict):
        return {name: _told(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_told(item) for item in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _heard(value: Any, name: str = "") -> Any:
    """Inverse of `_told`; a meter may have any name."""
    if isinstance(value, dict):
        return {key: _heard(item, key) for key, item in value.items()}
    if isinstance(value, list):
        return [_heard(item) for item in value]
    return float(value) if isinstance(value, str) and value in _INFINITE and name != "meter" else value


FORMAT: Final = 1
KEY: Final = b"gridsec"
CHUNK_TICKS: Final = 1024
PACKAGES: Final = ("gridsec", "numpy", "scipy", "power-grid-model", "pyarrow")

READINGS: Final = pa.schema(
    [
        ("meter", pa.dictionary(pa.int32(), pa.string())),
        ("t", pa.float64()),
        ("seq", pa.int64()),
        ("arrival", pa.float64()),
        ("v_volt", pa.float64()),
        ("p_kw", pa.float64()),
        ("q_kvar", pa.float64()),
    ]
)
PHASES: Final = pa.field("v_phases", pa.list_(pa.float64()))
"""Voltages of the busbar's phases, a column of recordings of feeders in three phases."""

REQUIRED: Final = ("meter", "t", "v_volt")
T_POWER: Final = pa.field("t_power", pa.float64())
"""Time of the powers, a column of external recordings with powers older than their voltages."""
COLUMNS: Final = tuple(field.name for field in fields(SimulatedReading))
REGISTERS: Final = ("seq", "p_kw", "q_kvar", "t_power")
"""Columns in which NaN means null, not reported: tables of floats have no null."""


class RecordingInvalid(Problems, GridsecError):
    """A file is not a recording, or has no truth; `where` begins the sentence of all problems."""

    def __init__(self, *problems: str, where: str = "") -> None:
        self.problems = problems
        self.where = where
        super().__init__(where + "; ".join(problems))


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTruth:
    """Truth of a recording at its T ticks; columns as in `feeders.simulation.scenario.SimulatedTick`."""

    t: Floats  # (T,): Unix time, s
    # (T, N): voltage and net import of each customer, V, kW, kvar.
    v_volt: Floats
    p_kw: Floats
    q_kvar: Floats
    v_bus_volt: Floats  # (T, b + 1): voltage of each bus, V
    x_kvar: Floats  # (T, m): injection of each inverter, kvar
    manipulated: Bools  # (T, p): mask of the meters under attack
    shift_volt: Floats  # (T, p): reported minus honest reading, V


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Recorded file, read lazily: only the metadata is in memory."""

    path: Path  # the file with the readings
    count: int  # number of readings
    # Name and content digest of its feeder; None for an external file.
    feeder: str | None
    digest: str | None
    scenario: Scenario | None  # the simulated scenario; None for an external file
    versions: dict[str, str]  # versions of the packages at its writing
    timed: bool = False  # true with arrival times of the readings

    def readings(self) -> Iterator[SimulatedReading]:
        """All readings in the order of the file, that of arrival."""
        with pq.ParquetFile(self.path) as file:
            for batch in file.iter_batches():
                yield from _readings(batch)

    def frame(self) -> pd.DataFrame:
        """All readings as a pandas table, one row each, columns as in `SimulatedReading`."""
        table: pd.DataFrame = pq.read_table(self.path).to_pandas()
        return table

    def truth(self) -> RecordedTruth:
        """Truth of a simulated recording; RecordingInvalid without one, or with that of another recording."""
        path = truth_path(self.path)
        try:
            table, own = pq.read_table(path), pq.read_schema(self.path)
        except (OSError, pa.ArrowException) as error:
            raise RecordingInvalid(
                Problem("missing", f"{path}: no truth for this recording: {error}")
            ) from error
        if (table.schema.metadata or {}).get(KEY) != (own.metadata or {}).get(KEY):
            raise RecordingInvalid(Problem("other-origin", f"{path}: the truth of another recording"))
        there = {name: _matrix(table.column(name)) for name in table.column_names}
        # Parquet has no lists without entries: without inverters, or without meters, the column is absent.
        none = np.empty((table.num_rows, 0))
        return RecordedTruth(**{field.name: there.get(field.name, none) for field in fields(RecordedTruth)})


def truth_path(path: Path) -> Path:
    """Path of the truth of a recording: day.parquet -> day.truth.parquet."""
    return path.with_name(f"{path.stem}.truth.parquet")


def record(site: Site, scenario: Scenario, path: Path | str) -> Recording:
    """Write the readings of a finite scenario to a file .parquet, and its truth to a second one beside it.

    Both have temporary names first, so that a file with the final name is complete. An old truth is removed
    first: it never accompanies new readings.
    """
    if not math.isfinite(scenario.duration_s):
        raise InputInvalid([Problem("not-finite", "a scenario without an end cannot be recorded")])
    path = Path(path)
    about = {
        "format": FORMAT,
        "feeder": site.feeder.name,
        "digest": site.digest,
        "scenario": scenario_to_json(scenario),
        "versions": {name: metadata.version(name) for name in PACKAGES},
    }
    extra = {KEY: json.dumps(about, sort_keys=True).encode()}
    targets = (path, truth_path(path))
    partial = tuple(target.with_name(target.name + ".partial") for target in targets)
    try:
        with (
            pq.ParquetWriter(partial[0], _readings_schema(site).with_metadata(extra)) as readings,
            pq.ParquetWriter(partial[1], _truth_schema(site).with_metadata(extra)) as truth,
        ):
            _write(simulate(site, scenario), scenario.dt_s, readings, truth)
        targets[1].unlink(missing_ok=True)
        for source, target in zip(partial, targets, strict=True):
            os.replace(source, target)
    finally:
        for source in partial:
            with contextlib.suppress(FileNotFoundError):
                source.unlink()
    return read_recording(path)


def read_recording(path: Path | str) -> Recording:
    """Open a simulated or an external recording.

    An external file needs the columns `meter`, `t` and `v_volt`. Without `arrival` readings arrive at their
    own time. `seq`, `p_kw`, `q_kvar` and `t_power` may be absent, and null or NaN if not reported.
    RecordingInvalid states wrong columns, fractional numbers of readings, and other formats.
    """
    path = Path(path)
    try:
        with pq.ParquetFile(path) as file:
            schema, count = file.schema_arrow, file.metadata.num_rows
            problems = [*_wrong_columns(schema), *_wrong_numbers(file)]
    except (OSError, pa.ArrowException) as error:
        raise RecordingInvalid(Problem("unreadable", f"{path}: not a recording: {error}")) from error
    if problems:
        raise RecordingInvalid(*problems, where=f"{path}: ")
    timed = "arrival" in schema.names and not pa.types.is_null(schema.field("arrival").type)
    if KEY not in (schema.metadata or {}):
        return Recording(path, count, None, None, None, {}, timed)
    try:
        about = json.loads(schema.metadata[KEY])
        if about["format"] != FORMAT:
            raise RecordingInvalid(
                Problem("unreadable", f"{path}: format {about['format']}; this program reads format {FORMAT}")
            )
        scenario = scenario_from_json(about["scenario"])
        return Recording(path, count, about["feeder"], about["digest"], scenario, about["versions"], timed)
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingInvalid(
            Problem("unreadable", f"{path}: its metadata cannot be read: {error!r}")
        ) from error


def is_simulated(path: Path) -> bool:
    """True for a file of `record`, readings or truth; OSError if it cannot be read."""
    try:
        return KEY in (pq.read_schema(path).metadata or {})
    except pa.ArrowException:
        return False


def _wrong_columns(schema: Any) -> list[Problem]:
    """All problems of a file's columns."""
    missing = [name for name in REQUIRED if name not in schema.names]
    problems = [Problem("missing", f"columns {', '.join(missing)} are missing")] if missing else []
    for name in COLUMNS:
        if name not in schema.names:
            continue
        given = schema.field(name).type
        kind = given.value_type if pa.types.is_dictionary(given) else given
        if name == "meter":
            fits, expected = _is_text(kind), "names of meters"
        elif name == PHASES.name:
            fits, expected = _is_list(kind) and _is_number(kind.value_type), "lists of numbers"
        else:
            fits, expected = _is_number(kind), "Unix time in seconds" if name in _TIMES else "numbers"
        # A column without any value has no type.
        if not fits and not (pa.types.is_null(kind) and name not in REQUIRED):
            problems.append(Problem("wrong-type", f"column {name} is of type {given}; expected {expected}"))
    return problems


_TIMES: Final = ("t", "arrival", "t_power")


def _wrong_numbers(file: Any) -> list[Problem]:
    """Problems of the numbers of readings, which tables with gaps write as floats."""
    if "seq" not in file.schema_arrow.names or not _is_floating(file.schema_arrow.field("seq").type):
        return []
    for batch in file.iter_batches(columns=["seq"]):
        try:
            _column(batch, "seq")
        except pa.ArrowInvalid as error:
            return [Problem("not-integer", f"column seq has fractional numbers: {error}")]
    return []


def _is_floating(kind: Any) -> bool:
    return bool(pa.types.is_floating(kind.value_type if pa.types.is_dictionary(kind) else kind))


def _is_number(kind: Any) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _is_text(kind: Any) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))


def _is_list(kind: Any) -> bool:
    is_any = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    return any(is_this(kind) for is_this in is_any)


def _write(samples: Iterator[SimulatedTick], dt_s: float, readings: Any, truth: Any) -> None:
    """Write all samples; readings with a late arrival wait for their turn."""
    waiting: dict[str, Any] | None = None
    ids: list[str] = []
    while chunk := list(islice(samples, CHUNK_TICKS)):
        ids = [*chunk[0].meter_ids, BUSBAR]
        rows = _sorted(_join(waiting, _rows(chunk)))
        # Readings of the next tick or a later one arrive no earlier than the next tick.
        ready = rows["arrival"] < chunk[-1].t + dt_s
        readings.write_table(_table(ids, {name: column[ready] for name, column in rows.items()}))
        waiting = {name: column[~ready] for name, column in rows.items()}
        truth.write_table(_truth_table(chunk, truth.schema))
    if waiting is not None:
        readings.write_table(_table(ids, waiting))


def _rows(chunk: list[SimulatedTick]) -> dict[str, Any]:
    """Every arriving reading of some ticks, copies included, as columns; `meter` is a number."""
    width = len(chunk[0].meter_ids) + 1
    seq = np.repeat(np.array([sample.seq for sample in chunk], dtype=np.int64)[:, None], width, axis=1)
    v0 = _registers(chunk, "v0_volt").reshape(len(chunk), -1)
    stack = {
        "meter": np.broadcast_to(np.arange(width, dtype=np.int32), seq.shape),
        "t": np.concatenate([sample.delivery.stamp for sample in chunk]),
        "seq": seq,
        "v_volt": np.column_stack([_registers(chunk, "v_volt"), v0.mean(axis=1)]),
        "p_kw": np.column_stack([_registers(chunk, "p_kw"), np.full(len(chunk), np.nan)]),
        "q_kvar": np.column_stack([_registers(chunk, "q_kvar"), np.full(len(chunk), np.nan)]),
    }
    if v0.shape[1] > 1:
        stack["v_phases"] = np.full((*seq.shape, v0.shape[1]), np.nan)
        stack["v_phases"][:, -1] = v0
    parts = []
    for name in ("arrival", "copy"):
        arrival = np.concatenate([getattr(sample.delivery, name) for sample in chunk])
        there = np.isfinite(arrival)
        parts.append({"arrival": arrival[there]} | {key: column[there] for key, column in stack.items()})
    return _join(parts[0], parts[1])


def _registers(chunk: list[SimulatedTick], name: str) -> Floats:
    return np.concatenate([getattr(sample.reported, name) for sample in chunk])


def _join(first: dict[str, Any] | None, second: dict[str, Any]) -> dict[str, Any]:
    if first is None:
        return second
    return {name: np.concatenate([first[name], second[name]]) for name in second}


def _sorted(rows: dict[str, Any]) -> dict[str, Any]:
    order = np.lexsort((rows["meter"], rows["seq"], rows["arrival"]))
    return {name: column[order] for name, column in rows.items()}


def _table(ids: list[str], rows: dict[str, Any]) -> Any:
    columns = {
        "meter": pa.DictionaryArray.from_arrays(pa.array(rows["meter"]), pa.array(ids)),
        **{name: pa.array(rows[name]) for name in ("t", "seq", "arrival", "v_volt")},
        # NaN in a register: not reported.
        **{name: pa.array(rows[name], from_pandas=True) for name in ("p_kw", "q_kvar")},
    }
    if "v_phases" not in rows:
        return pa.table(columns, schema=READINGS)
    phases = [row.tolist() if np.isfinite(row).all() else None for row in rows["v_phases"]]
    return pa.table({**columns, PHASES.name: pa.array(phases, PHASES.type)}, schema=READINGS.append(PHASES))


def _readings_schema(site: Site) -> Any:
    return READINGS.append(PHASES) if site.feeder.busbar_phases == 3 else READINGS


def _truth_schema(site: Site) -> Any:
    customers, meters = len(site.feeder.customers), site.meters.size
    widths = {
        "v_volt": customers,
        "p_kw": customers,
        "q_kvar": customers,
        "v_bus_volt": len(site.feeder.buses),
        "x_kvar": site.droop.tau.size,
        "shift_volt": meters,
    }
    columns = [("t", pa.float64())]
    columns += [(name, pa.list_(pa.float64(), width)) for name, width in widths.items() if width]
    columns += [("manipulated", pa.list_(pa.bool_(), meters))] if meters else []
    return pa.schema(columns)


def _truth_table(chunk: list[SimulatedTick], schema: Any) -> Any:
    columns = {"t": pa.array([sample.t for sample in chunk])}
    for field in schema:
        if field.name != "t":
            values = np.array([getattr(sample, field.name) for sample in chunk])
            flat = pa.array(values.ravel(), type=field.type.value_type)
            columns[field.name] = pa.FixedSizeListArray.from_arrays(flat, type=field.type)
    return pa.table(columns, schema=schema)


def _matrix(column: Any) -> Any:
    """Column of the truth as an array: (T,) for numbers, (T, width) for lists."""
    joined = column.combine_chunks()
    if not pa.types.is_fixed_size_list(joined.type):
        return joined.to_numpy(zero_copy_only=False)
    flat = joined.flatten().to_numpy(zero_copy_only=False)
    return flat.reshape(len(joined), joined.type.list_size)


def _readings(batch: Any) -> Iterator[SimulatedReading]:
    there = {name: _column(batch, name).to_pylist() for name in batch.schema.names if name in COLUMNS}
    there.setdefault("arrival", there["t"])
    phases = there.get(PHASES.name, ())
    there[PHASES.name] = [volts and tuple(volts) for volts in phases] or [None] * batch.num_rows
    nothing = [None] * batch.num_rows
    yield from map(SimulatedReading, *(there.get(name, nothing) for name in COLUMNS))


def _column(batch: Any, name: str) -> Any:
    """Column with null in place of NaN in `REGISTERS`, and integers for `seq`."""
    column = batch.column(name)
    if name not in REGISTERS or not _is_floating(column.type):
        return column
    numbers = pc.cast(column, pa.float64())
    known = pc.if_else(pc.is_nan(numbers), pa.scalar(None, pa.float64()), numbers)
    return pc.cast(known, pa.int64()) if name == "seq" else known

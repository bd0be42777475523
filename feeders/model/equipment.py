"""Equipment of a feeder: accuracies, loads, taps and transformers.

Powers are in units of the three-phase base.

Behind a tap t, ``V_from = t V``, every voltage has another base: ``a_k V_k``. V_k is the nominal voltage of
bus k, which a transformer may change. a_k is the product of ``1 / t`` over the taps between the busbar and
bus k. With impedances in the base of their own side, ``3 (a V)^2 / (1000 S)``, the per-unit model has no
ideal transformer. Each phase may have a tap of its own. A mutual impedance is then in ``3 a_φ a_ψ V^2 / (1000
S)``, so that matrices stay symmetric. The conversion between volts and per unit needs a_k V_k, customer by
customer. Values that are standardised in parts of the nominal voltage need V_k.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from feeders.format.columns import CUSTOMERS_FILE, LINES_FILE, META_FILE, PHASE_NAMES, advice
from feeders.format.tables import CustomerRow, FeederTables, LineRow, read, to_json
from feeders.format.validation import Tree, closed_tree, nominal_volts
from feeders.profiles import data_root
from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints
from gridsec.errors import FeederInvalid, Problem
from gridsec.grid.devices import Droop, MeterAccuracy, fleet

# Reported active powers beyond this factor of the customer's range, and this power, are implausible.
CREDIBLE_FACTOR = 10.0
CREDIBLE_KW = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class LoadModel:
    """Limits of the customers' powers without and with a reading, pu. N customers."""

    # (N,), largest load and largest generation
    load_peak: Floats
    pv_peak: Floats
    # (N,), limits of the load's q / p (lagging)
    tan_min: Floats
    tan_max: Floats
    q_floor: Floats  # (N,), reactive power of the load that does not follow p
    # (N,), error limit of a metered p: ``p_fraction |reading| + p_floor``
    p_fraction: Floats
    p_floor: Floats
    q_error: Floats  # (N,), error limit of a metered q: a fraction of the customer's range
    q_fraction: Floats  # (N,), the same fraction, for readings beyond that range
    credible: Floats  # (N,), largest plausible |p| of a reading
    # (N,), Half-width of p without a reading, and upper limit of that of q: the range, or the standard
    # deviation of the files for a customer without a meter
    p_unread: Floats
    q_unread: Floats


def names(*, balanced: bool = True) -> list[str]:
    """Names of the bundled feeders; `balanced`: without feeders in three phases."""
    folder = data_root() / "feeders"
    found = (entry for entry in folder.iterdir() if (entry / META_FILE).is_file())
    return sorted(entry.name for entry in found if not (balanced and _names_phases(entry)))


def _names_phases(folder: Traversable) -> bool:
    """True if a bundled feeder has columns of three phases; the writer leaves out default columns."""
    tables = ((folder / name).read_text(encoding="utf-8") for name in (LINES_FILE, CUSTOMERS_FILE))
    columns = {column for table in tables for column in table.partition("\n")[0].split(",")}
    return not columns.isdisjoint({"phases", *PHASE_NAMES})


def folder_of(path_or_name: Path | str) -> Path | None:
    """Folder of a feeder, given by its path or by the name of a bundled feeder; None without a match."""
    path = Path(path_or_name)
    if path.is_dir():
        return path
    bundled = data_root() / "feeders" / str(path_or_name)
    if len(path.parts) == 1 and path.name not in (".", "..") and bundled.is_dir():
        return Path(str(bundled))
    return None


def find(path_or_name: Path | str) -> FeederTables:
    """Read the tables of a feeder's folder, or of a bundled feeder; `FeederInvalid` as `load`."""
    folder = folder_of(path_or_name)
    if folder is not None:
        return read(folder)
    why = "there is neither such a folder nor such a feeder"
    if Path(path_or_name).is_file():
        why = "a file; expected a feeder's folder, or the name of a feeder"
    there, advised = ", ".join(names(balanced=False)), advice(path_or_name)
    raise FeederInvalid([Problem("unknown-name", f"{path_or_name}: {why}; there are {there}{advised}")])


def indices(values: Sequence[int]) -> Ints:
    """Indices as a frozen array."""
    return frozen_ints(np.array(values, dtype=np.intp))


def _either(rows: list[CustomerRow], column: str, default: float) -> Floats:
    """One column of customers.csv; empty cells have the default of feeder.toml."""
    cells = (getattr(row, column) for row in rows)
    return np.array([default if cell is None else cell for cell in cells], dtype=np.float64)


def digest(tables: FeederTables) -> str:
    """SHA-256 of a feeder's content, see `Site`."""
    text = json.dumps(to_json(tables), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def metered_customers(tables: FeederTables) -> Ints:
    """Indices of the customers with a meter, ascending."""
    return indices([k for k, row in enumerate(tables.customers) if row.meter])


def inverters(tables: FeederTables, ratio: Floats) -> Droop:
    """Inverters with a droop curve, in the order of the customers.

    `ratio` (N,) is the voltage base by the nominal voltage of each customer; curves are standardised in the
    latter.
    """
    own = [k for k, row in enumerate(tables.customers) if row.inverter_kva > 0]
    rows = [tables.customers[k] for k in own]
    made = fleet(
        indices(own),
        [row.droop for row in rows],
        np.array([row.inverter_kva for row in rows], dtype=np.float64),
        tables.meta.base_kva,
        tau=np.array([np.nan if row.tau_s is None else row.tau_s for row in rows], dtype=np.float64),
    )
    base = ratio[own]
    return made if (base == 1.0).all() else replace(made, v=made.v / base[:, None])


def accuracy(tables: FeederTables, base_volt: Floats, nominal_volt: Floats) -> MeterAccuracy:
    """Accuracies of the meters, from 1 pu and the nominal voltage at each customer (N,), V."""
    meta = tables.meta
    metered = metered_customers(tables)
    rows, base = [tables.customers[k] for k in metered], base_volt[metered]
    return MeterAccuracy(
        class_fraction=frozen(_either(rows, "class_percent", meta.meters.class_percent) / 100.0),
        resolution=frozen(_either(rows, "resolution_volt", meta.meters.resolution_volt) / base),
        jitter=frozen(
            _either(rows, "jitter_percent", meta.meters.jitter_percent)
            / 100.0
            / (base / nominal_volt[metered])
        ),
        busbar_class=meta.busbar_class_percent / 100.0,
        busbar_resolution=meta.busbar_resolution_volt / meta.voltage_volt,
        busbar_jitter=meta.busbar_jitter_percent / 100.0,
    )


def load_model(tables: FeederTables) -> LoadModel:
    """Limits of the customers' powers, in units of `base_kva`."""
    meta, rows = tables.meta, list(tables.customers)
    base = meta.base_kva
    load = _either(rows, "load_kw", 0.0)
    pv = _either(rows, "pv_kw", 0.0)
    inverter = _either(rows, "inverter_kva", 0.0)
    tan = {
        name: np.tan(np.arccos(_either(rows, name, getattr(meta.load, name))))
        for name in ("power_factor_min", "power_factor_max")
    }
    given = _either(rows, "q_floor_kvar", np.nan)
    floor = np.where(np.isnan(given), meta.load.q_floor_percent / 100.0 * load, given)
    q_fraction = _either(rows, "q_error_percent", meta.meters.q_error_percent) / 100.0
    # A register within f |p| + h of the truth p shows r: |p| <= (|r| + h) / (1 - f), so the error is at
    # most (f |r| + h) / (1 - f).
    p_fraction = _either(rows, "p_error_percent", meta.meters.p_error_percent) / 100.0
    # Range of the reactive register: the largest apparent power at the connection point.
    span = np.maximum.reduce([load * np.hypot(1.0, tan["power_factor_min"]), pv, inverter])
    fields = {
        "load_peak": load / base,
        "pv_peak": pv / base,
        "tan_min": tan["power_factor_max"],
        "tan_max": tan["power_factor_min"],
        "q_floor": floor / base,
        "p_fraction": p_fraction / (1.0 - p_fraction),
        "p_floor": 0.5 * meta.meters.p_resolution_kw / base / (1.0 - p_fraction),
        "q_error": q_fraction * span / base,
        "q_fraction": q_fraction,
        "p_unread": _unread(rows, "p_std_kw", 0.5 * (load + pv)) / base,
        "q_unread": _unread(rows, "q_std_kvar", load * tan["power_factor_min"] + floor) / base,
        "credible": np.maximum(CREDIBLE_FACTOR * (load + pv + inverter), CREDIBLE_KW) / base,
    }
    return LoadModel(**{name: frozen(values) for name, values in fields.items()})


def _unread(rows: list[CustomerRow], column: str, most: Floats) -> Floats:
    """Half-width of a uniform error with the standard deviation of the files, for unmetered customers."""
    told = [None if row.meter else getattr(row, column) for row in rows]
    width = [np.inf if std is None else np.sqrt(3.0) * std for std in told]
    return np.minimum(most, np.array(width, dtype=np.float64))


def positions(tables: FeederTables, found: Tree) -> Floats | None:
    """Positions of the buses (b + 1, 2), None unless the files have all of them."""
    xy = np.full((len(found.buses), 2), np.nan)
    for line in tables.lines:
        if line.to_x is not None and line.to_y is not None:
            xy[found.group[line.to_bus]] = line.to_x, line.to_y
    if tables.meta.busbar_xy is not None:
        xy[0] = tables.meta.busbar_xy
    return frozen(xy) if np.isfinite(xy).all() else None


@dataclass(frozen=True, slots=True, eq=False)
class Referred:
    """Tree of a feeder with its voltage bases. N customers, b + 1 buses."""

    lines: list[LineRow]  # Lines; line k feeds bus k + 1
    ties: list[LineRow]  # The t lines that close loops
    nominal: Floats  # (b + 1,), nominal voltage of every bus, V
    bus: Floats  # (b + 1, 3), voltage base of every phase of every bus, V
    # (b, 3), voltage base of each line's impedance and charging, which are behind its tap as seen from
    # `from_bus`
    branch: Floats
    tie: Floats  # (t, 3), the same of each tie
    # (N,), voltage base of every customer, the mean of its phases, and its nominal voltage, V
    customer: Floats
    customer_nominal: Floats


def refer(tables: FeederTables) -> tuple[Referred, Tree]:
    """Refer voltages and impedances of a feeder to its busbar; with the tree of its closed lines.

    Raises FeederInvalid for a tap on a line without impedance, or taps around a loop with a product other
        than 1.
    """
    closed, found = closed_tree(tables.meta.busbar, tables.lines)
    lines, ties = [closed[k] for k in found.branch], [closed[k] for k in found.ties]
    nominal = np.array(nominal_volts(found, closed, tables.meta.voltage_volt))
    bus, branch = _factors(lines, found)
    tie = np.array([bus[found.group[line.from_bus]] / line.taps for line in ties]).reshape(-1, 3)
    there = np.array([bus[found.group[line.to_bus]] for line in ties]).reshape(-1, 3)
    problems = [*_problems(closed), *_around(ties, tie / there)]
    if problems:
        raise FeederInvalid(problems)
    at = np.array([found.group[row.bus] for row in tables.customers], dtype=np.intp)
    own_phases = [[phase in row.phases for phase in "abc"] for row in tables.customers]

    def own(rows: Sequence[LineRow]) -> Floats:
        return nominal[[found.group[line.to_bus] for line in rows], None]

    base = bus * nominal[:, None]
    customer = of_customers(base[at], np.array(own_phases, dtype=np.bool_).reshape(-1, 3))
    referred = Referred(
        lines, ties, nominal, base, branch * own(lines), tie * own(ties), customer, nominal[at]
    )
    return referred, found


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Equipment:
    """Fields of a site that do not depend on the kind of its model. N customers, p meters, b + 1 buses."""

    tables: FeederTables  # Content of the files in SI
    droop: Droop  # The inverters with a droop curve, in the order of the customers
    meters: Ints  # (p,), index of each meter's customer, ascending
    meter_ids: tuple[str, ...]  # (p,), ids of the meters
    accuracy: MeterAccuracy  # Accuracies of the meters, pu
    bus_of_file: Mapping[str, int]  # Fused bus index of every bus id of the files
    xy: Floats | None  # (b + 1, 2), positions of the buses, None unless the files have all of them
    loads: LoadModel  # Limits of the customers' powers, in units of `base_kva`
    # SHA-256 of the content: key of design caches. It changes with every value and with the order of the rows
    # (which is the order of all arrays), not with layout, comments or unknown columns
    digest: str


def equipment(tables: FeederTables, base: Referred, found: Tree) -> dict[str, Any]:
    """Values of the fields of `Equipment`."""
    metered = metered_customers(tables)
    return {
        "tables": tables,
        "droop": inverters(tables, base.customer / base.customer_nominal),
        "meters": metered,
        "meter_ids": tuple(tables.customers[k].meter for k in metered),
        "accuracy": accuracy(tables, base.customer, base.customer_nominal),
        "bus_of_file": found.group,
        "xy": positions(tables, found),
        "loads": load_model(tables),
        "digest": digest(tables),
    }


def without_impedance(tables: FeederTables) -> list[Problem]:
    """Problem of a feeder that its switches join to one bus."""
    if not all(row.fuses for row in tables.lines if row.closed):
        return []
    text = "lines: no closed line has an impedance; there is nothing to monitor below the busbar"
    return [Problem("nothing-to-design", text)]


def not_radial() -> FeederInvalid:
    """Error of a method for radial feeders."""
    text = "lines: closed lines form loops; a radial feeder is required"
    return FeederInvalid([Problem("not-radial", text)])


def of_customers(base: Floats, connected: Bools) -> Floats:
    """Voltage base of each customer, V, (N,): the mean of its phases, as its meter reads.

    `base` (N, 3) has the voltage bases of the phases of their buses, V; `connected` (N, 3) is their mask.
    """
    first = np.take_along_axis(base, connected.argmax(axis=1)[:, None], axis=1)
    # For equal bases this form of the mean is exact to the last bit.
    apart = np.where(connected, base - first, 0.0).sum(axis=1) / connected.sum(axis=1)
    return np.asarray(first[:, 0] + apart)


def _factors(lines: Sequence[LineRow], found: Tree) -> tuple[Floats, Floats]:
    """Products of taps, ``a`` of every bus and of every line's impedance, in each phase."""
    bus, branch = np.ones((len(found.buses), 3)), np.ones((len(lines), 3))
    for k, (line, above) in enumerate(zip(lines, found.parent, strict=True)):
        if found.group[line.from_bus] == above:
            bus[k + 1] = branch[k] = bus[above] / line.taps
        else:
            branch[k] = bus[above]
            bus[k + 1] = bus[above] * line.taps
    return bus, branch


def _problems(closed: Sequence[LineRow]) -> list[Problem]:
    return [
        Problem(
            "zero-impedance",
            f"lines, line {line.line!r}, column tap: {' '.join(f'{tap:g}' for tap in sorted({*line.taps}))} "
            "on a line without impedance; expected the transformer's r_ohm and x_ohm",
        )
        for line in closed
        if set(line.taps) != {1.0} and line.fuses
    ]


def _around(ties: Sequence[LineRow], ratio: Floats) -> list[Problem]:
    """Loops with taps that drive a current around without any load; the model excludes them."""
    return [
        Problem(
            "inconsistent",
            f"lines, line {line.line!r} closes a loop around which the taps multiply to {far:.6g}; "
            "expected 1",
        )
        for line, own in zip(ties, ratio, strict=True)
        if abs((far := _farthest(own[["abc".index(phase) for phase in line.phases]])) - 1.0) > _ROUNDING
    ]


def _farthest(ratio: Floats) -> float:
    """Ratio with the largest distance from 1."""
    return float(ratio[np.abs(ratio - 1.0).argmax()])


# Rounding: ratios around a loop are products of a few numbers of the files.
_ROUNDING = 1e-9

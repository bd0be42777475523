"""From a feeder's tables to the per-unit model, and from readings in SI to frames.

The only place where SI and per unit meet, and where the wire's sign (net import positive) turns into
the model's (injection positive).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np

from feeders.profiles import data_root
from feeders.raw import CUSTOMERS_FILE, LINES_FILE, META_FILE, advice
from feeders.schema import CustomerRow, FeederTables, LineRow, read, to_json, validate
from feeders.topology import Edge, Tree, tree
from gridsec.arrays import Floats, Ints, frozen, frozen_ints
from gridsec.detect import MeterAccuracy
from gridsec.droop import Droop, fleet
from gridsec.errors import FeederInvalid
from gridsec.feeder import Feeder
from gridsec.monitor import Plant
from gridsec.online import Frame

# A reading is evidence even when it is absurd, but its square must stay a number.
ABSURD_PU = 100.0
# An active power this far beyond what a customer can draw or feed in is no measurement of it.
CREDIBLE_FACTOR = 10.0
CREDIBLE_KW = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class LoadModel:
    """What is known of the customers' powers without and with a reading, pu. N customers.

    Attributes
    ----------
    load_peak, pv_peak : (N,)
        Largest load and largest generation.
    tan_min, tan_max : (N,)
        Limits of the load's q / p (lagging).
    q_floor : (N,)
        Reactive power of the load that does not follow p.
    p_fraction, p_floor : (N,)
        A metered p is within ``p_fraction |reading| + p_floor`` of the truth.
    q_error : (N,)
        Half-width of a metered q: a fraction of the customer's range.
    q_fraction : (N,)
        The same fraction, for readings beyond that range.
    credible : (N,)
        Largest |p| that is taken for a measurement.
    """

    load_peak: Floats
    pv_peak: Floats
    tan_min: Floats
    tan_max: Floats
    q_floor: Floats
    p_fraction: Floats
    p_floor: Floats
    q_error: Floats
    q_fraction: Floats
    credible: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """A feeder ready to be watched or simulated. N customers, p meters, b + 1 buses.

    Attributes
    ----------
    tables
        The feeder in SI, as its files say it.
    feeder
        The radial tree, pu.
    droop
        The inverters with a droop curve, in the order of the customers.
    meters : (p,)
        Index of each meter's customer, ascending.
    meter_ids : (p,)
        Ids of the meters.
    accuracy
        What the meters promise, pu.
    bus_of_file
        Fused bus index of every bus id of the files.
    xy : (b + 1, 2)
        Positions of the buses, or None unless the files place every one of them.
    loads
        What is known of the customers' powers.
    digest
        SHA-256 of the content: key of design caches. It changes with every value and with the order of
        the rows (which is the order of all arrays), not with layout, comments or unknown columns.
    """

    tables: FeederTables
    feeder: Feeder
    droop: Droop
    meters: Ints
    meter_ids: tuple[str, ...]
    accuracy: MeterAccuracy
    bus_of_file: Mapping[str, int]
    xy: Floats | None
    loads: LoadModel
    digest: str


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Readings of one tick in SI, as on the wire: net import positive. p meters.

    Attributes
    ----------
    t
        Unix time, s.
    v_volt : (p,)
        Phase-to-neutral voltages, V; NaN where missing.
    p_kw : (p,)
        Net active import of all phases together, kW; NaN where missing.
    q_kvar : (p,)
        Net reactive import, the inverter included, kvar; NaN where not reported.
    v0_volt
        Busbar voltage, V; NaN where missing.
    """

    t: float
    v_volt: Floats
    p_kw: Floats
    q_kvar: Floats
    v0_volt: float


def names(*, balanced: bool = True) -> list[str]:
    """Return the feeders that come with the project.

    Parameters
    ----------
    balanced
        Only those that `load` takes; the others need `feeders.load_phases`.
    """
    folder = data_root() / "feeders"
    found = (entry for entry in folder.iterdir() if (entry / META_FILE).is_file())
    return sorted(entry.name for entry in found if not (balanced and _names_phases(entry)))


def _names_phases(folder: Traversable) -> bool:
    """Whether a folder of ours has single-phase lines or customers: the writer leaves out default columns."""
    tables = (folder / name for name in (LINES_FILE, CUSTOMERS_FILE))
    return any(
        "phases" in table.read_text(encoding="utf-8").partition("\n")[0].split(",") for table in tables
    )


def load(path_or_name: Path | str) -> Site:
    """Load a feeder.

    Parameters
    ----------
    path_or_name
        A folder, or the name of a feeder that comes with the project (`names()`).

    Raises
    ------
    FeederInvalid
        With every problem of the files, or if there is no such feeder.
    """
    return from_tables(find(path_or_name))


def find(path_or_name: Path | str) -> FeederTables:
    """Read the tables of a feeder's folder, or of a feeder that comes with the project; raises as `load`."""
    path = Path(path_or_name)
    if path.is_dir():
        return read(path)
    bundled = data_root() / "feeders" / str(path_or_name)
    if len(path.parts) == 1 and path.name not in (".", "..") and bundled.is_dir():
        return read(Path(str(bundled)))
    raise FeederInvalid(
        [
            f"{path_or_name}: there is neither such a folder nor such a feeder; "
            f"there are {', '.join(names())}{advice(path_or_name)}"
        ]
    )


def from_tables(tables: FeederTables) -> Site:
    """Turn a feeder's tables into the per-unit model.

    With ``z_base = 3 V^2 / (1000 S)`` ohm for V volts phase to neutral and S kVA of all three phases:
    ``r = r_ohm / z_base``, ``b = 1e-6 b_us z_base``, and powers in kW divide by S.

    Raises
    ------
    FeederInvalid
        If the tables are not valid, or need what the balanced model cannot do yet.
    """
    problems = validate(tables) or _unsupported(tables)
    if problems:
        raise FeederInvalid(problems)
    meta = tables.meta
    closed = [line for line in tables.lines if line.closed]
    found = tree(
        meta.busbar,
        [Edge(row.line, row.from_bus, row.to_bus, row.r_ohm == row.x_ohm == 0.0) for row in closed],
    )
    feeder = _feeder(tables, closed, found)
    metered = metered_customers(tables)
    return Site(
        tables=tables,
        feeder=feeder,
        droop=inverters(tables),
        meters=metered,
        meter_ids=tuple(tables.customers[k].meter for k in metered),
        accuracy=accuracy(tables),
        bus_of_file=found.group,
        xy=positions(tables, found),
        loads=load_model(tables),
        digest=digest(tables),
    )


def plant(site: Site) -> Plant:
    """Return the site as the monitor's design takes it."""
    return Plant(site.feeder, site.droop, site.meters, site.accuracy, 1)


def volts(site: Site, v2_pu: Floats) -> Floats:
    """Return voltages from squared voltages: ``v = base_volt sqrt(v2)``.

    Parameters
    ----------
    site
        The feeder.
    v2_pu
        Squared voltages, pu, any shape; a negative one (no voltage has it) gives 0.
    """
    return np.asarray(site.feeder.base_volt * np.sqrt(np.maximum(v2_pu, 0.0)), dtype=np.float64)


def to_frame(site: Site, snapshot: Snapshot) -> Frame:
    """Turn one tick's readings into what an estimator takes; total on any readings, absurd ones too.

    Voltages: ``y = v |v|`` in pu, so that a negative reading stays a bad one.

    Active power: a register of f = `p_error_percent` and steps of 2 h shows r; the truth is within
    ``(f |r| + h) / (1 - f)`` of it. Beyond the customer's largest load or generation it is believed less and
    less, and at twice of that not at all: a load that is not there is the cover of colluding voltage meters,
    and a connection limits what it can pretend. Where there is no reading, or one that is not finite or
    beyond anything the customer could draw, all that is known is the interval from full generation without
    load to full load without generation.

    Reactive power of the load (the inverter's is the observer's business): with net import P, the load
    alone lies in ``[max(P, 0), max(P, min(P + pv, load_kw))]``, each end widened by the error of P;
    its reactive power in ``[load_low tan_min - floor, load_high tan_max + floor]``. Without generation
    the load is P itself. Centre and half-width of that interval go into the frame.

    Parameters
    ----------
    site
        The feeder.
    snapshot
        The readings.
    """
    base_volt, base_kva, model = site.feeder.base_volt, site.feeder.base_kva, site.loads
    seen = np.isfinite(snapshot.v_volt)
    v = np.clip(snapshot.v_volt / base_volt, -ABSURD_PU, ABSURD_PU)
    y = np.where(seen, v * np.abs(v), np.nan)
    v0 = min(max(snapshot.v0_volt / base_volt, 0.0), ABSURD_PU) if np.isfinite(snapshot.v0_volt) else np.nan

    metered = np.full(model.load_peak.size, np.nan)
    metered[site.meters] = snapshot.p_kw / base_kva
    known = np.abs(metered) <= model.credible  # False for NaN
    p = np.where(known, metered, 0.5 * (model.load_peak - model.pv_peak))
    beyond = np.maximum(p - model.load_peak, 0.0) + np.maximum(-p - model.pv_peak, 0.0)
    doubt = np.minimum(2.0 * beyond, np.abs(p))
    p_error = np.where(
        known, model.p_fraction * np.abs(p) + model.p_floor + doubt, 0.5 * (model.load_peak + model.pv_peak)
    )
    low = np.maximum(p - p_error, 0.0)
    most = np.minimum(p + p_error + model.pv_peak, model.load_peak)
    high = np.maximum(np.maximum(most, p + p_error), 0.0)
    q_low = low * model.tan_min - model.q_floor
    q_high = high * model.tan_max + model.q_floor

    q_net = np.full(model.load_peak.size, np.nan)
    q_net[site.meters] = -snapshot.q_kvar / base_kva
    q_net[~(np.abs(q_net) <= model.credible)] = np.nan
    size = np.where(np.isnan(q_net), 0.0, np.abs(q_net))
    return Frame(
        t=snapshot.t,
        y=y,
        seen=seen,
        v0_squared=float(v0 * v0),
        p=-p,
        p_error=p_error,
        q=-0.5 * (q_low + q_high),
        q_error=0.5 * (q_high - q_low),
        q_net=q_net,
        q_net_error=np.maximum(model.q_error, model.q_fraction * size),
    )


# --- building -----------------------------------------------------------------------------------


def _unsupported(tables: FeederTables) -> tuple[str, ...]:
    """What the format can say and the balanced single-phase equivalent cannot do yet."""
    problems = []
    closed = [line for line in tables.lines if line.closed]
    for line in closed:
        where = f"lines, line {line.line!r}"
        if line.phases != "abc":
            problems.append(
                f"{where}: phases {line.phases!r}: the model is balanced yet and takes only 'abc'"
            )
        if line.tap != 1.0:
            problems.append(
                f"{where}: tap {line.tap:g}: the model takes no transformer in mid-feeder yet, only 1"
            )
    problems.extend(
        f"customers, customer {row.customer!r}: phases {row.phases!r}: the model is balanced yet "
        "and takes only 'abc'"
        for row in tables.customers
        if row.phases != "abc"
    )
    if all(line.r_ohm == line.x_ohm == 0.0 for line in closed):
        problems.append("lines: no closed line has an impedance; there is nothing to watch below the busbar")
    return tuple(problems)


def _feeder(tables: FeederTables, closed: list[LineRow], found: Tree) -> Feeder:
    meta = tables.meta
    z_base = 3.0 * meta.voltage_volt**2 / (1000.0 * meta.base_kva)
    lines = [closed[k] for k in found.branch]
    return Feeder(
        name=meta.name,
        parent=_indices(found.parent),
        r=np.array([line.r_ohm for line in lines]) / z_base,
        x=np.array([line.x_ohm for line in lines]) / z_base,
        bus=_indices([found.group[row.bus] for row in tables.customers]),
        customers=tuple(row.customer for row in tables.customers),
        buses=found.buses,
        base_volt=meta.voltage_volt,
        base_kva=meta.base_kva,
        charging=np.array([line.b_us for line in lines]) * (1e-6 * z_base),
    )


def _indices(values: Sequence[int]) -> Ints:
    return frozen_ints(np.array(values, dtype=np.intp))


def _either(rows: list[CustomerRow], column: str, default: float) -> Floats:
    """One column of customers.csv, with the default of feeder.toml where it is empty."""
    cells = (getattr(row, column) for row in rows)
    return np.array([default if cell is None else cell for cell in cells], dtype=np.float64)


def digest(tables: FeederTables) -> str:
    """Return the SHA-256 of a feeder's content, see `Site`."""
    text = json.dumps(to_json(tables), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def metered_customers(tables: FeederTables) -> Ints:
    """Return the indices of the customers with a meter, ascending."""
    return _indices([k for k, row in enumerate(tables.customers) if row.meter])


def inverters(tables: FeederTables) -> Droop:
    """Return the inverters with a droop curve, in the order of the customers."""
    own = [k for k, row in enumerate(tables.customers) if row.inverter_kva > 0]
    rows = [tables.customers[k] for k in own]
    return fleet(
        _indices(own),
        [row.droop for row in rows],
        np.array([row.inverter_kva for row in rows], dtype=np.float64),
        tables.meta.base_kva,
        tau=np.array([np.nan if row.tau_s is None else row.tau_s for row in rows], dtype=np.float64),
    )


def accuracy(tables: FeederTables) -> MeterAccuracy:
    """Return what the meters promise, pu."""
    meta = tables.meta
    rows = [tables.customers[k] for k in metered_customers(tables)]
    return MeterAccuracy(
        class_fraction=frozen(_either(rows, "class_percent", meta.meters.class_percent) / 100.0),
        resolution=frozen(_either(rows, "resolution_volt", meta.meters.resolution_volt) / meta.voltage_volt),
        jitter=frozen(_either(rows, "jitter_percent", meta.meters.jitter_percent) / 100.0),
        busbar_class=meta.busbar_class_percent / 100.0,
        busbar_resolution=meta.busbar_resolution_volt / meta.voltage_volt,
        busbar_jitter=meta.busbar_jitter_percent / 100.0,
    )


def load_model(tables: FeederTables) -> LoadModel:
    """Return what is known of the customers' powers, in units of `base_kva`."""
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
    # The range of the reactive register: the largest apparent power at the connection point.
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
        "credible": np.maximum(CREDIBLE_FACTOR * (load + pv + inverter), CREDIBLE_KW) / base,
    }
    return LoadModel(**{name: frozen(values) for name, values in fields.items()})


def positions(tables: FeederTables, found: Tree) -> Floats | None:
    """Return where the buses are (b + 1, 2), or None unless the files place every one of them."""
    xy = np.full((len(found.buses), 2), np.nan)
    for line in tables.lines:
        if line.to_x is not None and line.to_y is not None:
            xy[found.group[line.to_bus]] = line.to_x, line.to_y
    if tables.meta.busbar_xy is not None:
        xy[0] = tables.meta.busbar_xy
    return frozen(xy) if np.isfinite(xy).all() else None

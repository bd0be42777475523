"""A pandapower net as a feeder's tables.

Nothing is dropped in silence: whatever a feeder's format cannot hold is named in the notes.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from feeders.profiles import envelopes
from feeders.schema import CustomerRow, FeederMeta, FeederTables, LineRow, LoadDefaults, MonitorDefaults
from gridsec.errors import GridsecError

# Tables of a net that are carried over; every other table with rows below the busbar earns a note.
CARRIED = {"bus", "line", "load", "asymmetric_load", "sgen", "switch"}
SURROUNDINGS = {"trafo", "trafo3w", "ext_grid"}  # upstream of the busbar
UNLIMITED_KA = 1000.0
HOUSEHOLDS = ("H0-A", "H0-B", "H0-C", "H0-G", "H0-L")
# Trade and agriculture whose reactive power follows the active power closely, as that of large loads does.
TRADE = ("G1-A", "G2-A", "G6-A", "L1-A", "L2-A")
HOUSEHOLD_KW = 30.0
USUAL_POWER_FACTOR = 0.93
SMALL_KVA = 4.6


@dataclass(frozen=True, slots=True)
class Fleet:
    """Synthetic PV inverters for a source that has none.

    Attributes
    ----------
    every
        Every how many-th of the customers without generation gets one, starting with the first.
    kva
        Rating, kVA; 0: half of the customer's load_kw.
    droop
        Preset.
    """

    every: int
    kva: float
    droop: str = "ieee1547-b"


@dataclass(slots=True)
class _Source:
    """A net, its busbar, and the part of it that hangs below the busbar."""

    net: Any
    root: int
    names: dict[int, str]
    order: list[int] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def from_pandapower(
    net: Any,
    name: str,
    *,
    title: str = "",
    root: str | None = None,
    droop: str | None = None,
    fleet: Fleet | None = None,
    max_attacked: int = 1,
) -> tuple[FeederTables, tuple[str, ...]]:
    """Return a net's feeder as tables, and notes on what was left out, added or changed.

    Parameters
    ----------
    net
        A pandapower net.
    name, title
        Of the feeder.
    root
        Name or index of the bus that becomes the metered busbar; None: the low-voltage side of the only
        transformer, or without transformers the bus of the external grid.
    droop
        Preset of the inverters in the source (static generators); None: vde4105 or vde4105-small by size.
    fleet
        Synthetic inverters to add.
    max_attacked
        For the monitor.

    Raises
    ------
    GridsecError
        If there is no such bus, or more than one that could be meant.
    """
    source = _Source(net, _root(net, root), _ids(net.bus, "bus"))
    lines = _lines(source)
    customers = _customers(source, droop)
    if fleet is not None:
        customers = _with_fleet(customers, fleet, source.notes)
    volt = float(net.bus.at[source.root, "vn_kv"]) * 1000.0 / math.sqrt(3.0)
    load = sum(row.load_kw for row in customers)
    meta = FeederMeta(
        format=1,
        name=name,
        title=title or name,
        voltage_volt=round(volt, 6),
        base_kva=100.0 if volt < 1000.0 else 10.0 ** max(2, math.ceil(math.log10(max(load, 1.0)))),
        busbar=source.names[source.root],
        busbar_xy=_place(net, source.root),
        load=LoadDefaults(power_factor=USUAL_POWER_FACTOR, power_factor_min=0.85),
        monitor=MonitorDefaults(max_attacked=max_attacked),
    )
    _leftovers(source)
    return FeederTables(meta, tuple(lines), tuple(customers)), tuple(source.notes)


def _root(net: Any, wanted: str | None) -> int:
    if wanted is not None:
        named = [int(i) for i in net.bus.index if str(net.bus.at[i, "name"]) == wanted]
        hits = named or [int(i) for i in net.bus.index if str(i) == wanted]
        if len(hits) != 1:
            raise GridsecError(f"{len(hits)} buses are called {wanted!r}; give the index of one")
        return hits[0]
    trafos = net.trafo[net.trafo.in_service]
    sides = sorted({int(bus) for bus in trafos.lv_bus})
    if not sides:
        sides = sorted({int(bus) for bus in net.ext_grid.bus[net.ext_grid.in_service]})
    if len(sides) != 1:
        names = ", ".join(str(net.bus.at[bus, "name"]) for bus in sides) or "none"
        raise GridsecError(f"the busbar is not clear, candidates: {names}; name it with root")
    return sides[0]


def _ids(table: Any, noun: str, taken: Iterable[str] = ()) -> dict[int, str]:
    """Return an id per row: the source's name where there is a unique one, otherwise with its index."""
    given = {int(i): _clean(table.at[i, "name"]) for i in table.index}
    count = Counter([*given.values(), *taken])
    ids: dict[int, str] = {}
    for i, name in given.items():
        own = name if name and count[name] == 1 else f"{name or noun}-{i}"
        while own != name and count[own]:
            own += "'"
        ids[i] = own
        count[own] += own != name
    return ids


def _clean(name: object) -> str:
    text = "" if name is None or name != name else str(name)  # noqa: PLR0124  # NaN is the table's None
    return "".join(c if c.isprintable() else " " for c in text).strip()[:100]


# --- lines and switches -------------------------------------------------------------------------


def _lines(source: _Source) -> list[LineRow]:
    """Lines and bus-to-bus switches below the busbar, each pointing away from it."""
    rows = [*_line_rows(source), *_switch_rows(source)]
    by_name = {name: i for i, name in source.names.items()}
    closed: dict[int, list[tuple[int, LineRow]]] = defaultdict(list)
    for row in rows:
        if row.closed:
            a, b = by_name[row.from_bus], by_name[row.to_bus]
            closed[a].append((b, row))
            closed[b].append((a, row))
    level = {source.root: 0}
    source.order = [source.root]
    for bus in source.order:
        for other, _ in closed[bus]:
            if other not in level:
                level[other] = level[bus] + 1
                source.order.append(other)
    kept = []
    for row in rows:
        a, b = by_name[row.from_bus], by_name[row.to_bus]
        if a in level and b in level:
            turned = level[b] < level[a]
            place = _place(source.net, a if turned else b)
            away = replace(row, from_bus=row.to_bus, to_bus=row.from_bus) if turned else row
            kept.append(replace(away, to_x=place[0], to_y=place[1]) if place else away)
        elif a in level or b in level:
            source.notes.append(f"left out: {row.line}, open towards a part that the busbar does not feed")
    outside = len(source.net.bus) - len(level)
    if outside:
        source.notes.append(
            f"left out: {outside} bus(es) that the busbar does not feed, with what is connected there"
        )
    return kept


def _line_rows(source: _Source) -> Iterable[LineRow]:
    net = source.net
    names = _ids(net.line, "line")
    switches = net.switch
    opened = {
        int(e)
        for e, et, c in zip(switches.element, switches.et, switches.closed, strict=True)
        if et == "l" and not c
    }
    dead = {int(bus) for bus in net.bus.index[~net.bus.in_service.astype(bool)]}
    omega = 2.0 * math.pi * float(net.f_hz)
    if len(net.line) and (net.line.g_us_per_km > 0).any():
        source.notes.append("left out: shunt conductance of lines")
    for i in map(int, net.line.index):
        row = net.line.loc[i]
        length, parallel = float(row.length_km), float(row.parallel)
        limit = float(row.max_i_ka) * float(row.df) * parallel
        yield LineRow(
            line=names[i],
            from_bus=source.names[int(row.from_bus)],
            to_bus=source.names[int(row.to_bus)],
            r_ohm=_round(float(row.r_ohm_per_km) * length / parallel),
            x_ohm=_round(float(row.x_ohm_per_km) * length / parallel),
            r0_ohm=_zero_sequence(row, "r0_ohm_per_km", length / parallel),
            x0_ohm=_zero_sequence(row, "x0_ohm_per_km", length / parallel),
            b_us=_round(omega * float(row.c_nf_per_km) * length * parallel * 1e-3),
            closed=bool(row.in_service)
            and i not in opened
            and not dead & {int(row.from_bus), int(row.to_bus)},
            rating_a=_round(limit * 1000.0) if 0.0 < limit < UNLIMITED_KA else None,
        )


def _zero_sequence(row: Any, column: str, factor: float) -> float | None:
    value = float(row.get(column, math.nan))
    return _round(value * factor) if math.isfinite(value) else None


def _switch_rows(source: _Source) -> Iterable[LineRow]:
    net = source.net
    names = _ids(net.switch, "switch", _ids(net.line, "line").values())
    for i in map(int, net.switch.index):
        row = net.switch.loc[i]
        if row.et != "b":
            continue
        ohm = float(row.z_ohm) if "z_ohm" in row and row.z_ohm > 0 else 0.0
        yield LineRow(
            line=names[i],
            from_bus=source.names[int(row.bus)],
            to_bus=source.names[int(row.element)],
            r_ohm=_round(ohm),
            x_ohm=0.0,
            closed=bool(row.closed),
        )


def _place(net: Any, bus: int) -> tuple[float, float] | None:
    geo = net.bus.at[bus, "geo"] if "geo" in net.bus.columns else None
    if not isinstance(geo, str):
        return None
    x, y = json.loads(geo)["coordinates"][:2]
    return round(float(x), 6), round(float(y), 6)


def _round(value: float) -> float:
    """Nine significant digits: enough for any cable, and free of the noise of the unit's conversion."""
    return float(f"{value:.9g}")


# --- loads and generators -----------------------------------------------------------------------


def _customers(source: _Source, droop: str | None) -> list[CustomerRow]:
    net = source.net
    inside = set(source.order)
    names = _ids(net.load, "load")
    loads = [int(i) for i in net.load.index if int(net.load.at[i, "bus"]) in inside]
    rows = [_load_row(source, i, names[i], k) for k, i in enumerate(loads)]
    rows.extend(_phase_rows(source, inside, len(rows)))
    at_bus: dict[str, list[int]] = defaultdict(list)
    for k, customer in enumerate(rows):
        at_bus[customer.bus].append(k)
    _generators(source, rows, at_bus, droop)
    digits = max(2, len(str(len(rows))))
    return [replace(row, meter=f"m{k:0{digits}d}") for k, row in enumerate(rows, start=1)]


def _phase_rows(source: _Source, inside: set[int], number: int) -> Iterable[CustomerRow]:
    """Loads of single phases: one customer for each phase that draws power."""
    net = source.net
    names = _ids(net.asymmetric_load, "phase load", _ids(net.load, "load").values())
    for i in map(int, net.asymmetric_load.index):
        row = net.asymmetric_load.loc[i]
        if int(row.bus) not in inside:
            continue
        scale = float(row.scaling) * float(row.in_service) * 1000.0
        drawn = {phase: (float(row[f"p_{phase}_mw"]), float(row[f"q_{phase}_mvar"])) for phase in "abc"}
        used = [phase for phase, (p, _) in drawn.items() if p > 0]
        if any(p < 0 or q < 0 for p, q in drawn.values()):
            source.notes.append(f"left out: negative powers of {names[i]}")
        for phase in used:
            p, q = drawn[phase]
            customer = CustomerRow(
                customer=names[i] if len(used) == 1 else f"{names[i]}-{phase}",
                bus=source.names[int(row.bus)],
                load_kw=_round(p * scale),
                phases=phase,
                load_profile=HOUSEHOLDS[number % len(HOUSEHOLDS)],
            )
            number += 1
            yield _reactive(customer, p / math.hypot(p, q) if q > 0 else None)


def _load_row(source: _Source, index: int, name: str, number: int) -> CustomerRow:
    row = source.net.load.loc[index]
    scale = float(row.scaling) * float(row.in_service) * 1000.0
    p, q = float(row.p_mw) * scale, float(row.q_mvar) * scale
    if p < 0:
        source.notes.append(f"changed: {name} feeds in {-p:g} kW as a negative load; taken as a load of 0")
        p = 0.0
    if q < 0:
        source.notes.append(f"changed: {name} has a leading power factor; taken as 1")
    for column in ("const_z_percent", "const_i_percent", "const_z_p_percent", "const_i_p_percent"):
        if column in row and float(row[column]) > 0:
            source.notes.append(f"changed: {name} depends on the voltage ({column}); taken as constant power")
    low_voltage = float(source.net.bus.at[int(row.bus), "vn_kv"]) < 1.0
    profile = str(row["profile"]) if "profile" in row and isinstance(row["profile"], str) else ""
    if profile not in envelopes():
        kinds = HOUSEHOLDS if low_voltage and p <= HOUSEHOLD_KW else TRADE
        wanted, profile = profile, kinds[number % len(kinds)]
        if wanted:
            source.notes.append(
                f"changed: profile {wanted!r} of {name} is not in the library; {profile} instead"
            )
    customer = CustomerRow(
        customer=name, bus=source.names[int(row.bus)], load_kw=_round(p), load_profile=profile
    )
    return _reactive(customer, p / math.hypot(p, q) if p > 0 and q > 0 else None)


def _reactive(customer: CustomerRow, power_factor: float | None) -> CustomerRow:
    """Fill in what the load's profile is known to do to the reactive power."""
    factor = USUAL_POWER_FACTOR if power_factor is None else round(power_factor, 4)
    tan = math.tan(math.acos(factor))
    history = envelopes()[customer.load_profile]
    # Rounded outwards, so that the interval still holds the history.
    return replace(
        customer,
        power_factor=factor,
        power_factor_min=min(factor, math.floor(1e4 * math.cos(math.atan(history.high * tan))) / 1e4),
        power_factor_max=max(factor, math.ceil(1e4 * math.cos(math.atan(history.low * tan))) / 1e4),
        q_floor_kvar=math.ceil(1e4 * history.floor * tan * customer.load_kw) / 1e4,
    )


def _generators(
    source: _Source, rows: list[CustomerRow], at_bus: dict[str, list[int]], droop: str | None
) -> None:
    """Give each static generator to the first customer of its bus, or make it a customer of its own."""
    net = source.net
    names = _ids(net.sgen, "generator", _ids(net.load, "load").values())
    inside = set(source.order)
    for i in map(int, net.sgen.index):
        generator = net.sgen.loc[i]
        if int(generator.bus) not in inside:
            continue
        bus = source.names[int(generator.bus)]
        kw = _round(float(generator.p_mw) * float(generator.scaling) * float(generator.in_service) * 1000.0)
        kva = float(generator.sn_mva) * 1000.0
        kva = _round(kva) if math.isfinite(kva) and kva > 0 else kw
        if not at_bus[bus]:
            at_bus[bus].append(len(rows))
            rows.append(CustomerRow(customer=names[i], bus=bus, load_kw=0.0))
            source.notes.append(
                f"changed: {names[i]} has no load at its bus and became a customer of its own"
            )
        k = at_bus[bus][0]
        if float(generator.q_mvar) != 0.0:
            source.notes.append(f"left out: fixed reactive power of {names[i]}; its droop curve decides")
        profile = generator.get("profile")
        rows[k] = replace(
            rows[k],
            pv_kw=_round(rows[k].pv_kw + kw),
            pv_profile=profile if isinstance(profile, str) and profile.startswith("PV") else f"PV{k % 8 + 1}",
            inverter_kva=_round(rows[k].inverter_kva + kva),
            droop=droop or ("vde4105" if rows[k].inverter_kva + kva > SMALL_KVA else "vde4105-small"),
        )
        source.notes.append(
            f"added: droop curve {rows[k].droop} for {names[i]}, at customer {rows[k].customer}"
        )


def _with_fleet(customers: list[CustomerRow], fleet: Fleet, notes: list[str]) -> list[CustomerRow]:
    rows = list(customers)
    bare = [k for k, row in enumerate(rows) if row.inverter_kva == 0.0]
    for k in bare[:: fleet.every]:
        kva = fleet.kva or _round(0.5 * rows[k].load_kw)
        if kva > 0:
            rows[k] = replace(
                rows[k],
                pv_kw=_round(0.9 * kva),
                pv_profile=f"PV{k % 8 + 1}",
                inverter_kva=kva,
                droop=fleet.droop,
            )
    added = [f"{rows[k].customer} ({rows[k].inverter_kva:g} kVA)" for k in bare if rows[k].inverter_kva > 0.0]
    notes.append(
        f"added, not in the source: {len(added)} synthetic PV inverters with droop curve {fleet.droop}, at "
        + ", ".join(added)
    )
    return rows


def _leftovers(source: _Source) -> None:
    """Name every other table with rows: what is there has no place in the format."""
    net = source.net
    inside = set(source.order)
    for table in sorted(net.keys()):
        content = net[table]
        if (
            table in CARRIED
            or table in SURROUNDINGS
            or not hasattr(content, "columns")
            or table.startswith("res_")
        ):
            continue
        ends = [
            column
            for column in ("bus", "from_bus", "to_bus", "hv_bus", "lv_bus")
            if column in content.columns
        ]
        here = (
            sum(any(content.at[i, column] in inside for column in ends) for i in content.index) if ends else 0
        )
        if here:
            source.notes.append(f"left out: {here} row(s) of the table {table}")
    lower = sum(int(bus) in inside for bus in net.trafo.hv_bus) + sum(
        int(bus) in inside for bus in net.trafo3w.hv_bus
    )
    if lower:
        source.notes.append(
            f"left out: {lower} transformer(s) that the feeder's buses supply, with all behind them"
        )
    second = sum(int(bus) in inside and int(bus) != source.root for bus in net.ext_grid.bus)
    if second:
        source.notes.append(
            f"left out: {second} more infeed(s) of an external grid; the feeder has one busbar"
        )

"""Feeder's tables from a pandapower net.

Nothing is dropped silently: everything that the feeder format lacks is in the changes.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from feeders.convert.customers import (
    HOUSEHOLD_KW,
    HOUSEHOLDS,
    ONLY_REACTIVE,
    SWITCHED_OFF,
    USUAL_POWER_FACTOR,
    base_kva,
    customers_of,
    droop_preset,
    idle_customers,
    reactive,
    rounded,
    usual_profile,
    with_meters,
)
from feeders.convert.lines import as_rows, balanced_charging, reached
from feeders.convert.network import (
    Converted,
    SourceNetwork,
    below,
    below_source,
    chosen,
    finished,
    one_busbar,
)
from feeders.convert.pandapower_net import between_phases, ids, network_of, phase_powers, with_truths
from feeders.convert.provenance import WHOLE, BusbarUnclear, ConversionChange
from feeders.convert.transformers import EVERYTHING, Extent
from feeders.format.tables import CustomerRow, FeederMeta, FeederTables, LoadDefaults, MonitorDefaults
from feeders.profiles import envelopes, pv_names
from gridsec.arrays import Phasors
from gridsec.errors import GridsecError

SOLAR: Final = {"pv", "wye", "delta"}
"""Types of static generators that are compatible with a solar profile."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """Synthetic PV inverters for a source without any.

    Attributes
    ----------
    every
        Interval among the customers without generation, from the first one on.
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
    """Net, and the part of it below the busbar.

    Attributes
    ----------
    net
        The net.
    names
        Ids of its buses.
    inside
        Its buses in the feeder.
    changes
        Receives inexact conversions.
    volts
        Voltages of the buses by pandapower's power flow, V.
    power
        Power of each customer, kVA.
    """

    net: Any
    names: dict[int, str]
    inside: set[int]
    changes: list[ConversionChange]
    volts: Mapping[str, Phasors]
    power: dict[str, complex] = field(default_factory=dict)


def from_pandapower(
    net: Any,
    name: str,
    *,
    title: str = "",
    root: str | None = None,
    opened: Sequence[str] = (),
    droop: str | None = None,
    extent: Extent = EVERYTHING,
    fleet: Fleet | None = None,
    max_attacked: int = 1,
) -> Converted:
    """Convert a net to a feeder's tables, with all omissions, additions and changes.

    Parameters
    ----------
    net
        A pandapower net.
    name, title
        Name and title of the feeder.
    root
        Name or index of the bus that becomes the metered busbar; None: the low-voltage side of the only
        transformer, or without transformers the bus of the external grid.
    opened
        Lines to open, so that the feeder is radial.
    droop
        Preset of the inverters in the source (static generators); None: vde4105 or vde4105-small by size.
    extent
        Extent of the feeder.
    fleet
        Synthetic inverters to add.
    max_attacked
        `max_attacked` of the monitor.

    Raises
    ------
    GridsecError
        For an unknown or ambiguous bus.
    FeederInvalid
        With every problem of the feeder below it.
    """
    net = with_truths(net)
    network = network_of(net)
    names = ids(net.bus, "bus")
    busbar = chosen(network, lambda: _root(net, network, names, root), opened, droop)
    part = below(network, busbar, opened, extent)
    inside = {i for i, bus in names.items() if bus in part.inside}
    source = _Source(net, names, inside, part.changes, network.volts)
    customers = _customers(source, droop)
    volt = network.nominal[part.busbar]
    more, drawn = customers_of(part.draws, network.nominal, droop, part.changes, set(source.power))
    customers = with_meters([*customers, *more])
    if fleet is not None:
        customers = _with_fleet(customers, fleet, part.changes)
    idle, taken = idle_customers(part.draws, {row.customer for row in customers})
    customers += idle
    lines = part.lines
    if all(row.phases == "abc" for row in customers):
        lines = balanced_charging(lines, part.changes)
    load = sum(row.load_kw for row in customers)
    meta = FeederMeta(
        format=1,
        name=name,
        title=title or name,
        voltage_volt=round(volt, 6),
        base_kva=base_kva(volt, load),
        busbar=part.busbar,
        busbar_xy=network.xy.get(part.busbar),
        meshed=extent.meshed,
        load=LoadDefaults(power_factor=USUAL_POWER_FACTOR, power_factor_min=0.85),
        monitor=MonitorDefaults(max_attacked=max_attacked),
    )
    tables = FeederTables(meta, tuple(lines), tuple(customers))
    return finished(network, part, tables, source.power | drawn | taken)


def _root(net: Any, network: SourceNetwork, names: dict[int, str], wanted: str | None) -> str:
    if wanted is not None:
        named = [i for i in names if str(net.bus.at[i, "name"]) == wanted]
        hits = named or [i for i in names if str(i) == wanted] or [i for i in names if names[i] == wanted]
        if len(hits) != 1:
            raise GridsecError(
                f"{len(hits)} buses are called {wanted!r}; give the index of one", code="unknown-name"
            )
        return names[hits[0]]
    if not network.sources:
        raise BusbarUnclear("there is no voltage source in service; name the busbar with --root")
    trafos = net.trafo[net.trafo.in_service.astype(bool)]
    sides = sorted({int(bus) for bus in trafos.lv_bus})
    if not sides:
        sides = sorted({int(bus) for bus in net.ext_grid.bus[net.ext_grid.in_service.astype(bool)]})
    if one_busbar([names[bus] for bus in sides], network.lines):
        return names[sides[0]]
    found = below_source(network)
    if found is None:
        # Stations further down are part of the feeder.
        everything = [*network.lines, *as_rows(network.couplings)]
        lower = {names[bus] for bus in sides}
        first = {bus for source in network.sources for bus in reached(source, everything, without=lower)}
        sides = [bus for bus in sides if names[bus] in first] or sides
        if one_busbar([names[bus] for bus in sides], network.lines):
            return names[sides[0]]
        candidates = ", ".join(str(net.bus.at[bus, "name"]) for bus in sides) or "none"
        raise BusbarUnclear(f"the busbar is not clear, candidates: {candidates}; name it with root")
    return found


# --- loads and generators -----------------------------------------------------------------------


def _customers(source: _Source, droop: str | None) -> list[CustomerRow]:
    net = source.net
    names = ids(net.load, "load")
    loads = [
        int(i)
        for i, row in net.load.iterrows()
        if int(row.bus) in source.inside and not between_phases(net, row)
    ]
    rows = [_load_row(source, i, names[i], k) for k, i in enumerate(loads)]
    rows.extend(_phase_rows(source, len(rows)))
    at_bus: dict[str, list[int]] = defaultdict(list)
    for k, customer in enumerate(rows):
        at_bus[customer.bus].append(k)
    _generators(source, rows, at_bus, droop)
    return rows


def _phase_rows(source: _Source, number: int) -> Iterable[CustomerRow]:
    """Loads of single phases and between phases: one customer for each phase with power."""
    net = source.net
    taken = ids(net.load, "load")
    names = ids(net.asymmetric_load, "phase load", taken.values())
    each = [(names[i], row) for i, row in net.asymmetric_load.iterrows()]
    each += [(taken[i], row) for i, row in net.load.iterrows() if between_phases(net, row)]
    for name, row in each:
        if int(row.bus) not in source.inside:
            continue
        bus = source.names[int(row.bus)]
        at_work = row.copy()
        at_work["scaling"], at_work["in_service"] = 1.0, True
        whole, _ = phase_powers(net, at_work, name, None)
        power, told = phase_powers(net, row, f"load {name}", source.volts.get(bus))
        used = [phase for phase, s in zip("abc", whole, strict=True) if s != 0]
        if not used:
            effect = "draws nothing on any phase in the source"
            source.changes.append(ConversionChange(f"load {name}", WHOLE, "left out", effect))
        elif not row.in_service:
            source.changes.append(ConversionChange(f"load {name}", *SWITCHED_OFF))
        source.changes.extend(told)
        for phase, s in zip("abc", power, strict=True):
            if phase not in used:
                continue
            customer = CustomerRow(
                customer=name if len(used) == 1 else f"{name}-{phase}",
                bus=bus,
                load_kw=rounded(max(s.real, 0.0)),
                phases=phase,
                load_profile=HOUSEHOLDS[number % len(HOUSEHOLDS)],
            )
            number += 1
            yield _known(source, customer, complex(s))


def _known(source: _Source, customer: CustomerRow, s: complex) -> CustomerRow:
    """Store a load's power, kVA, and report parts of it that the format lacks."""
    source.power[customer.customer] = s
    label = f"load {customer.customer}"
    if s.real < 0:
        effect = "feeds in; its expected load is taken as 0"
        source.changes.append(ConversionChange(label, "p_mw", "changed", effect))
    if s.real <= 0.0 and s.imag > 0.0:
        source.changes.append(ConversionChange(label, *ONLY_REACTIVE))
    if s.imag < 0:
        source.changes.append(
            ConversionChange(label, "power factor", "approximated", "leading; expected to be 1")
        )
    return reactive(customer, s.real / abs(s) if s.real > 0 and s.imag > 0 else None)


def _load_row(source: _Source, index: int, name: str, number: int) -> CustomerRow:
    row = source.net.load.loc[index]
    scale = float(row.scaling) * float(row.in_service) * 1000.0
    s = complex(row.p_mw, row.q_mvar) * scale
    source.changes.extend(
        ConversionChange(
            f"load {name}",
            column,
            "approximated",
            "depends on the voltage in the source; taken as constant power",
        )
        for column in row.index
        if str(column).startswith("const_") and float(row[column]) > 0
    )
    if not row.in_service:
        source.changes.append(ConversionChange(f"load {name}", *SWITCHED_OFF))
    low_voltage = float(source.net.bus.at[int(row.bus), "vn_kv"]) < 1.0
    profile = str(row["profile"]) if "profile" in row and isinstance(row["profile"], str) else ""
    if profile not in envelopes():
        wanted = profile
        profile = usual_profile(number, household=low_voltage and s.real <= HOUSEHOLD_KW)
        if wanted:
            effect = f"is not in the library; {profile} instead"
            source.changes.append(ConversionChange(f"load {name}", f"profile {wanted}", "changed", effect))
    customer = CustomerRow(
        customer=name,
        bus=source.names[int(row.bus)],
        load_kw=rounded(max(s.real, 0.0)),
        load_profile=profile,
    )
    return _known(source, customer, s)


def _generators(
    source: _Source, rows: list[CustomerRow], at_bus: dict[str, list[int]], droop: str | None
) -> None:
    """Add each static generator to the first customer of its bus, or make it a customer of its own."""
    net = source.net
    names = ids(net.sgen, "generator", ids(net.load, "load").values())
    for i in map(int, net.sgen.index):
        generator = net.sgen.loc[i]
        if int(generator.bus) not in source.inside or between_phases(net, generator):
            continue
        bus, label = source.names[int(generator.bus)], f"generator {names[i]}"
        if not generator.in_service:
            source.changes.append(ConversionChange(label, WHOLE, "left out", "switched off in the source"))
            continue
        s = complex(generator.p_mw, generator.q_mvar) * float(generator.scaling)
        kw = rounded(max(s.real * 1000.0, 0.0))
        if s.real < 0.0:
            effect = "draws; its expected generation is taken as 0"
            source.changes.append(ConversionChange(label, "p_mw", "changed", effect))
        kva = float(generator.sn_mva) * 1000.0
        kva = rounded(kva) if math.isfinite(kva) and kva > 0 else kw
        alone = [k for k in at_bus[bus] if rows[k].phases == "abc"]
        if not alone:
            alone = [len(rows)]
            at_bus[bus].append(len(rows))
            rows.append(CustomerRow(customer=names[i], bus=bus, load_kw=0.0))
            effect = "has no load at its bus and became a customer of its own"
            source.changes.append(ConversionChange(label, "customer", "changed", effect))
        k = alone[0]
        source.power[rows[k].customer] = source.power.get(rows[k].customer, 0j) - 1000.0 * s
        if s.imag != 0.0:
            source.changes.append(ConversionChange(label, "q_mvar", "left out", "its droop curve decides"))
        rows[k] = replace(
            rows[k],
            pv_kw=rounded(rows[k].pv_kw + kw),
            pv_profile=_sun(source, generator, label, f"PV{k % 8 + 1}"),
            inverter_kva=rounded(rows[k].inverter_kva + kva),
            droop=droop or droop_preset(rows[k].inverter_kva + kva),
        )
        effect = f"{rows[k].droop}, not in the source; at the first customer of its bus"
        source.changes.append(ConversionChange(label, "droop curve", "added", effect))


def _sun(source: _Source, generator: Any, label: str, usual: str) -> str:
    """Profile of a static generator: its own if the library has it; otherwise the usual one, and a change."""
    given = {column: generator.get(column) for column in ("profile", "type")}
    named = {column: text for column, text in given.items() if isinstance(text, str) and text}
    profile = named.get("profile", "")
    if profile in pv_names():
        return profile
    source.changes.extend(
        ConversionChange(
            label, f"{column} {text}", "changed", f"in simulations generation by the sun, {usual}"
        )
        for column, text in named.items()
        if column == "profile" or text.lower() not in SOLAR
    )
    return usual


def _with_fleet(
    customers: list[CustomerRow], fleet: Fleet, changes: list[ConversionChange]
) -> list[CustomerRow]:
    rows = list(customers)
    bare = [k for k, row in enumerate(rows) if row.inverter_kva == 0.0]
    for k in bare[:: fleet.every]:
        kva = fleet.kva or rounded(0.5 * rows[k].load_kw)
        if kva > 0:
            rows[k] = replace(
                rows[k],
                pv_kw=rounded(0.9 * kva),
                pv_profile=f"PV{k % 8 + 1}",
                inverter_kva=kva,
                droop=fleet.droop,
            )
            effect = f"synthetic, with droop curve {fleet.droop}; not in the source"
            changes.append(ConversionChange(rows[k].customer, f"PV inverter of {kva:g} kVA", "added", effect))
    return rows

"""Feeder's tables from a pandapower net.

Nothing is dropped silently: everything that the feeder format lacks is in the changes.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Final

from feeders.convert.customers import (
    HOUSEHOLD_KW,
    HOUSEHOLDS,
    SWITCHED_OFF,
    droop_preset,
    expected_load,
    rounded,
    usual_profile,
)
from feeders.convert.lines import as_rows, reached
from feeders.convert.network import below_source, one_busbar
from feeders.convert.pandapower_net import between_phases, ids, phase_powers, read_net, with_truths
from feeders.convert.provenance import WHOLE, BusbarUnclear, Changes
from feeders.convert.source import CONSTANT, OFF, SourceNetwork
from feeders.format.tables import CustomerRow
from feeders.profiles import envelopes, pv_names
from gridsec.errors import GridsecError

SOLAR: Final = {"pv", "wye", "delta"}
"""Types of static generators that are compatible with a solar profile."""


def read_pandapower(net: Any) -> PandapowerNetwork:
    """Read and solve a pandapower net; `FeederInvalid` has all problems of its tables."""
    network = PandapowerNetwork("", [], {}, net=with_truths(net))
    read_net(network.net, network)
    return network


@dataclass(slots=True)
class PandapowerNetwork(SourceNetwork):
    """Network of a net; its loads and static generators become customers one by one."""

    net: Any = None

    def busbar(self, root: str | None) -> str:
        """Bus of this name or index; None: the low-voltage side of the only transformer.

        Without transformers it is the bus of the external grid.

        Raises GridsecError for an unknown or ambiguous bus.
        """
        return _root(self.net, self, ids(self.net.bus, "bus"), root)

    def customers(
        self, inside: Collection[str], droop: str | None, changes: Changes
    ) -> tuple[list[CustomerRow], dict[str, complex]]:
        """Customers of the loads and static generators inside, and their powers, kVA."""
        names = {i: bus for i, bus in ids(self.net.bus, "bus").items() if bus in inside}
        source = _Source(self, names, changes)
        return _customers(source, droop), source.power


@dataclass(slots=True)
class _Source:
    """Part of a network below the busbar."""

    network: PandapowerNetwork  # The network
    names: dict[int, str]  # Ids of its buses in the feeder
    changes: Changes  # Receives inexact conversions
    power: dict[str, complex] = field(default_factory=dict)  # Power of each customer, kVA

    @property
    def net(self) -> Any:
        """The net."""
        return self.network.net


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
        if int(row.bus) in source.names and not between_phases(net, row)
    ]
    rows = [_load_row(source, i, names[i], k) for k, i in enumerate(loads)]
    rows.extend(_phase_rows(source, len(rows)))
    at_bus: dict[str, list[int]] = defaultdict(list)
    for k, customer in enumerate(rows):
        at_bus[customer.bus].append(k)
    _generators(source, rows, at_bus, droop)
    return rows


def _phase_rows(source: _Source, number: int) -> Iterator[CustomerRow]:
    """Loads of single phases and between phases: one customer for each phase with power."""
    net = source.net
    taken = ids(net.load, "load")
    names = ids(net.asymmetric_load, "phase load", taken.values())
    each = [(names[i], row) for i, row in net.asymmetric_load.iterrows()]
    each += [(taken[i], row) for i, row in net.load.iterrows() if between_phases(net, row)]
    for name, row in each:
        if int(row.bus) not in source.names:
            continue
        bus = source.names[int(row.bus)]
        at_work = row.copy()
        at_work["scaling"], at_work["in_service"] = 1.0, True
        whole, _ = phase_powers(net, at_work, name, None)
        power, told = phase_powers(net, row, f"load {name}", source.network.volts.get(bus))
        used = [phase for phase, s in zip("abc", whole, strict=True) if s != 0]
        if not used:
            source.changes.note(f"load {name}", WHOLE, "left out", "draws nothing on any phase in the source")
        elif not row.in_service:
            source.changes.note(f"load {name}", *SWITCHED_OFF)
        source.changes.extend(told)
        for phase, s in zip("abc", power, strict=True):
            if phase in used:
                own = name if len(used) == 1 else f"{name}-{phase}"
                profile = HOUSEHOLDS[number % len(HOUSEHOLDS)]
                number += 1
                yield _known(source, own, bus, complex(s), profile=profile, phases=phase)


def _known(
    source: _Source, name: str, bus: str, s: complex, *, profile: str, phases: str = "abc"
) -> CustomerRow:
    """Customer with a load of this power, kVA."""
    source.power[name] = s
    load = rounded(max(s.real, 0.0))
    row = CustomerRow(name, bus, phases=phases, load_kw=load, load_profile=profile)
    return expected_load(row, s, f"load {name}", "p_mw", source.changes)


def _load_row(source: _Source, index: int, name: str, number: int) -> CustomerRow:
    row = source.net.load.loc[index]
    scale = float(row.scaling) * float(row.in_service) * 1000.0
    s = complex(row.p_mw, row.q_mvar) * scale
    for column in row.index:
        if str(column).startswith("const_") and float(row[column]) > 0:
            source.changes.note(f"load {name}", column, "approximated", CONSTANT)
    if not row.in_service:
        source.changes.note(f"load {name}", *SWITCHED_OFF)
    low_voltage = float(source.net.bus.at[int(row.bus), "vn_kv"]) < 1.0
    profile = str(row["profile"]) if "profile" in row and isinstance(row["profile"], str) else ""
    if profile not in envelopes():
        wanted = profile
        profile = usual_profile(number, household=low_voltage and s.real <= HOUSEHOLD_KW)
        if wanted:
            effect = f"is not in the library; {profile} instead"
            source.changes.note(f"load {name}", f"profile {wanted}", "changed", effect)
    return _known(source, name, source.names[int(row.bus)], s, profile=profile)


def _generators(
    source: _Source, rows: list[CustomerRow], at_bus: dict[str, list[int]], droop: str | None
) -> None:
    """Add each static generator to the first customer of its bus, or make it a customer of its own."""
    net = source.net
    names = ids(net.sgen, "generator", ids(net.load, "load").values())
    for i in map(int, net.sgen.index):
        generator = net.sgen.loc[i]
        if int(generator.bus) not in source.names or between_phases(net, generator):
            continue
        bus, label = source.names[int(generator.bus)], f"generator {names[i]}"
        if not generator.in_service:
            source.changes.note(label, WHOLE, "left out", OFF)
            continue
        s = complex(generator.p_mw, generator.q_mvar) * float(generator.scaling)
        kw = rounded(max(s.real * 1000.0, 0.0))
        if s.real < 0.0:
            source.changes.note(label, "p_mw", "changed", "draws; its expected generation is taken as 0")
        kva = float(generator.sn_mva) * 1000.0
        kva = rounded(kva) if math.isfinite(kva) and kva > 0 else kw
        alone = [k for k in at_bus[bus] if rows[k].phases == "abc"]
        if not alone:
            alone = [len(rows)]
            at_bus[bus].append(len(rows))
            rows.append(CustomerRow(customer=names[i], bus=bus, load_kw=0.0))
            effect = "has no load at its bus and became a customer of its own"
            source.changes.note(label, "customer", "changed", effect)
        k = alone[0]
        source.power[rows[k].customer] = source.power.get(rows[k].customer, 0j) - 1000.0 * s
        if s.imag != 0.0:
            source.changes.note(label, "q_mvar", "left out", "its droop curve decides")
        rows[k] = replace(
            rows[k],
            pv_kw=rounded(rows[k].pv_kw + kw),
            pv_profile=_sun(source, generator, label, f"PV{k % 8 + 1}"),
            inverter_kva=rounded(rows[k].inverter_kva + kva),
            droop=droop or droop_preset(rows[k].inverter_kva + kva),
        )
        effect = f"{rows[k].droop}, not in the source; at the first customer of its bus"
        source.changes.note(label, "droop curve", "added", effect)


def _sun(source: _Source, generator: Any, label: str, usual: str) -> str:
    """Profile of a static generator: its own if the library has it; otherwise the usual one, and a change."""
    given = {column: generator.get(column) for column in ("profile", "type")}
    named = {column: text for column, text in given.items() if isinstance(text, str) and text}
    profile = named.get("profile", "")
    if profile in pv_names():
        return profile
    for column, text in named.items():
        if column == "profile" or text.lower() not in SOLAR:
            effect = f"in simulations generation by the sun, {usual}"
            source.changes.note(label, f"{column} {text}", "changed", effect)
    return usual

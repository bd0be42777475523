"""Network of any tool, and the feeder below one of its buses.

The readers of other tools' files build a `SourceNetwork` in SI, which is converted to a feeder's tables. The
steps: find the busbar, cut off the rest of the network, merge parallel lines, and replace transformers below
the busbar by customers with their power.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from feeders.convert.customers import (
    USUAL_POWER_FACTOR,
    Draw,
    Fleet,
    base_kva,
    customers_of,
    idle_customers,
    is_even,
    with_fleet,
    with_meters,
)
from feeders.convert.lines import (
    above_busbar,
    as_rows,
    balanced_charging,
    fused_with,
    merged,
    reached,
    turned,
)
from feeders.convert.provenance import WHOLE, BusbarUnclear, Changes, ConversionChange
from feeders.convert.round_trip import SourceState
from feeders.convert.source import SourceNetwork, named_bus
from feeders.convert.transformers import EVERYTHING, Extent, levels_of, transformed
from feeders.format.columns import SUSPICIONS
from feeders.format.tables import FeederMeta, FeederTables, LineRow, LoadDefaults, MonitorDefaults, validate
from feeders.format.validation import loops
from gridsec.arrays import Phasors
from gridsec.errors import FeederInvalid, GridsecError, Problem
from gridsec.grid.devices import preset
from gridsec.grid.three_phase import ROTATION

TURNED: Final = 1.0
"""Largest deviation of the angles between a busbar's phases from those of a feeder, degrees."""


def chosen(network: SourceNetwork, root: str | None, opened: Sequence[str], droop: str | None) -> str | None:
    """Busbar of the conversion; reports all other unknown choices together with an unknown busbar.

    Raises FeederInvalid with all unknown names; GridsecError for the busbar, without further problems.
    """
    problems = _unknown(network.lines, opened)
    try:
        if droop is not None:
            preset(droop)
    except FeederInvalid as error:
        problems += error.problems
    try:
        busbar = network.busbar(root)
    except GridsecError as error:
        if not problems:
            raise
        raise FeederInvalid([Problem(error.code, str(error)), *problems]) from error
    if problems:
        raise FeederInvalid(problems)
    return busbar


def opened_rows(lines: Iterable[LineRow], opened: Sequence[str], changes: Changes) -> list[LineRow]:
    """Open the requested lines; `FeederInvalid` names every unknown one."""
    rows = list(lines)
    if unknown := _unknown(rows, opened):
        raise FeederInvalid(unknown)
    effect = "open, as requested; the check shows the effect"
    changes.extend(ConversionChange(f"line {line}", "closed", "changed", effect) for line in opened)
    return [replace(row, closed=False) if row.line in opened else row for row in rows]


def busbar_of(network: SourceNetwork, rows: list[LineRow], root: str | None) -> str:
    """Requested bus, or the first bus with lines below the source; `rows` are the lines after opening.

    Raises GridsecError for an unknown bus; BusbarUnclear without a request, if several buses are possible.
    """
    if root is not None:
        return named_bus(network.nominal, root)
    if len(network.sources) != 1:
        names = ", ".join(network.sources) or "none"
        raise BusbarUnclear(f"the busbar is not clear, voltage sources at: {names}; name it with root")
    way = _way_down(network, rows)
    if not _has_lines(way[-1], rows):
        beyond = ", ".join(sorted(_beyond(network, way))) or "none"
        raise BusbarUnclear(f"the busbar is not clear, candidates: {beyond}; name it with root")
    return way[-1]


def _unknown(lines: Iterable[LineRow], opened: Sequence[str]) -> list[str]:
    return [
        Problem("unknown-name", f"line {line!r} to open does not exist")
        for line in sorted(set(opened) - {row.line for row in lines})
    ]


def below_source(network: SourceNetwork) -> str | None:
    """Bus behind the only transformer of the only source; None without such a bus."""
    way = _way_down(network, network.lines) if len(network.sources) == 1 else []
    return way[-1] if len(way) > 1 and _has_lines(way[-1], network.lines) else None


def angles_of(volts: Phasors, busbar: str, changes: Changes) -> Phasors:
    """Busbar voltages with the angles of a feeder.

    The busbar meter reads magnitudes; simulations and monitors assume angles of 0, -120 and 120 degrees.
    `volts` (3,) are those of the source, NaN where a phase is absent; `changes` receives other angles.
    """
    there = np.isfinite(volts)
    if not there.any():
        return volts
    first = volts[there][0]
    of_feeder = ROTATION / ROTATION[there][0]
    if np.ptp(np.angle((volts / first / of_feeder)[there], deg=True)) <= TURNED:
        return volts
    theirs, ours = (_degrees(each[there]) for each in (volts / first, of_feeder))
    effect = f"{ours} degrees, in the source {theirs}; the check shows the effect"
    changes.note(f"bus {busbar}", "angles between its phases", "approximated", effect)
    return np.asarray(np.abs(volts) * of_feeder)


def _degrees(phasors: Phasors) -> str:
    angles = np.round(np.angle(phasors, deg=True), 1) + 0.0
    return " and ".join(", ".join(f"{angle:g}" for angle in angles).rsplit(", ", 1))


def one_busbar(buses: Collection[str], rows: Iterable[LineRow]) -> bool:
    """True if closed switches join the buses to one."""
    return bool(buses) and fused_with(min(buses), rows).keys() >= set(buses)


def _way_down(network: SourceNetwork, rows: list[LineRow]) -> list[str]:
    """Follow transformers from the source to the first bus with lines or with several transformers."""
    way = [network.sources[0]]
    while not _has_lines(way[-1], rows):
        beyond = _beyond(network, way)
        if not one_busbar(beyond, rows):
            break
        way.append(min(beyond))
    return way


def _has_lines(bus: str, rows: list[LineRow]) -> bool:
    return any(row.closed and bus in (row.from_bus, row.to_bus) for row in rows)


def _beyond(network: SourceNetwork, way: list[str]) -> set[str]:
    return {bus for each in network.couplings if way[-1] in each.buses for bus in each.buses} - set(way)


UNFED: Final = "not supplied in the source"
BEYOND: Final = "supplied in the source, but not through the feeder: see the elements left out or opened"
"""Reasons for loads below the busbar that are not customers."""


@dataclass(frozen=True, slots=True, eq=False)
class Converted:
    """Feeder from another tool's network."""

    tables: FeederTables  # The feeder
    changes: tuple[ConversionChange, ...]  # Inexact conversions
    state: SourceState | None  # State by the source's tool at its own loads
    unchecked: str = ""  # Reason for a missing state


@dataclass(frozen=True, slots=True, eq=False)
class SuppliedArea:
    """Part of a network below a busbar."""

    busbar: str  # Bus of the busbar
    inside: dict[str, int]  # The buses, nearest first, with their distances in lines
    lines: list[LineRow]  # Rows of lines.csv, pointing away from the busbar
    draws: list[Draw]  # Loads and generators, and powers into transformers
    changes: Changes  # Inexact conversions


def feeder_of(
    network: SourceNetwork,
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
    """Convert the part of a network below a bus to a feeder.

    root: bus that becomes the metered busbar; None: that of `SourceNetwork.busbar`.
    opened: lines to open, so that the feeder is radial.
    droop: preset of the generators' inverters; None: by their size.
    fleet: synthetic inverters to add.
    max_attacked: `max_attacked` of the monitor.
    Raises FeederInvalid with every problem of the feeder; GridsecError for an unknown or ambiguous bus.
    """
    busbar = chosen(network, root, opened, droop)
    part = below(network, busbar, opened, extent)
    volt = network.nominal[part.busbar]
    own, power = network.customers(part.inside, droop, part.changes)
    more, drawn = customers_of(part.draws, network.nominal, droop, part.changes, set(power))
    rows = with_meters([*own, *more])
    if fleet is not None:
        rows = with_fleet(rows, fleet, part.changes)
    idle, taken = idle_customers(part.draws, {row.customer for row in rows})
    rows += idle
    lines = part.lines
    if all(row.phases == "abc" for row in rows):
        lines = balanced_charging(lines, part.changes)
    meta = FeederMeta(
        format=1,
        name=name,
        title=title or name,
        voltage_volt=round(volt, 6),
        base_kva=base_kva(volt, sum(row.load_kw for row in rows)),
        busbar=part.busbar,
        busbar_xy=network.xy.get(part.busbar),
        meshed=extent.meshed,
        load=LoadDefaults(power_factor=USUAL_POWER_FACTOR, power_factor_min=0.85),
        monitor=MonitorDefaults(max_attacked=max_attacked),
    )
    tables = FeederTables(meta, tuple(lines), tuple(rows))
    return finished(network, part, tables, power | drawn | taken)


def below(
    network: SourceNetwork, root: str | None, opened: Sequence[str], extent: Extent = EVERYTHING
) -> SuppliedArea:
    """Cut the part below a bus out of a network; arguments as of `feeder_of`.

    Raises FeederInvalid for a second infeed, or lines between buses of different nominal voltages;
        GridsecError for an unknown or ambiguous bus.
    """
    changes = Changes(network.changes)
    rows = opened_rows(network.lines, opened, changes)
    busbar = busbar_of(network, rows, root)
    network, rows = transformed(network, rows, busbar, extent, changes)
    inside = reached(busbar, rows)
    problems = _infeeds(network, rows, busbar, inside)
    kept = _kept(network, rows, inside, changes)
    problems += levels_of(kept, network.nominal)
    if problems:
        lines = merged(kept, busbar, Changes(), network.nominal)
        raise FeederInvalid([*problems, *(() if extent.meshed else loops(busbar, lines))])
    draws = [draw for draw in network.draws if draw.bus in inside]
    sums, summed = _behind(network, rows, inside, changes)
    draws += sums
    elsewhere = above_busbar(busbar, network.sources, rows, network.couplings) | summed | inside.keys()
    changes.extend(_not_fed(network, elsewhere))
    changes.extend(change for bus, change in network.of_bus if bus in inside)
    return SuppliedArea(busbar, inside, merged(kept, busbar, changes, network.nominal), draws, changes)


def finished(
    network: SourceNetwork, part: SuppliedArea, tables: FeederTables, power: Mapping[str, complex]
) -> Converted:
    """Assemble the result of a conversion; `power` is that of each customer in the source, kVA.

    Raises FeederInvalid for doubtful values without a power flow of the source.
    """
    unchecked = "" if network.volts else network.unsolved
    given = network.volts.get(part.busbar, np.full(3, np.nan + 0j))
    of_rows = (*(row.phases for row in tables.customers), *(row.phases for row in tables.lines))
    if (
        network.volts
        and not np.isfinite(given[["abc".index(phase) for phase in set("".join(of_rows))]]).all()
    ):
        unchecked = f"the source's power flow has no voltage at the busbar {part.busbar!r}"
    given = angles_of(given, part.busbar, part.changes)
    accepted = accepting(tables, part.changes, unchecked)
    changes = tuple(dict.fromkeys(part.changes))
    if unchecked:
        return Converted(accepted, changes, None, unchecked)
    state = SourceState(
        tool=network.tool,
        power_kva=power,
        busbar_volt=given,
        volts={bus: np.abs(network.volts[bus]) for bus in part.inside if bus in network.volts},
        as_found={bus: np.abs(network.as_found[bus]) for bus in part.inside if bus in network.as_found},
    )
    return Converted(accepted, changes, state)


def accepting(tables: FeederTables, changes: Changes, unchecked: str) -> FeederTables:
    """Accept values that are doubtful only for their unit: the source's tool knows its units.

    `changes` receives every doubtful value. `unchecked` is the reason for a missing power flow of the source,
    empty with one; without one, the source itself may have a wrong unit.

    Raises FeederInvalid for doubts without a power flow, with all other problems.
    """
    doubts: set[str] = set()
    problems = []
    for problem in validate(tables):
        sentence, found, doubt = problem.partition(' (if it is right: accept = ["')
        problems.append(Problem(problem.code, sentence))
        if found:
            doubts.add(doubt.partition('"')[0])
            changes.note("feeder", sentence, "accepted", "as in the source")
    if doubts and unchecked:
        raise FeederInvalid(
            [*problems, Problem("doubtful", f"{unchecked}; doubtful values cannot be confirmed")]
        )
    accept = tuple(name for name in SUSPICIONS if name in doubts)
    return replace(tables, meta=replace(tables.meta, accept=accept)) if accept else tables


def _infeeds(
    network: SourceNetwork, rows: list[LineRow], busbar: str, inside: Mapping[str, int]
) -> list[Problem]:
    """Further infeeds besides the busbar."""
    problems = []
    everything = [*rows, *as_rows(network.couplings)]
    fused = fused_with(busbar, rows)
    for source in network.sources:
        if source in inside and source != busbar:
            expected = f"expected the busbar {busbar!r} as the only one"
            text = f"bus {source!r} has another voltage source; {expected}"
            problems.append(Problem("several-sources", text))
        elif source != busbar:
            above = reached(source, everything, without=fused)
            ways = [bus for bus in inside if bus not in fused and bus in above]
            if ways:
                text = (
                    f"{len(ways)} of the feeder's buses can be reached from the source {source!r} "
                    f"not only through the busbar {busbar!r}, among them {', '.join(ways[:5])}: a mesh; "
                    "open a line of it, or name another busbar with root"
                )
                problems.append(Problem("several-sources", text))
    return problems


def _kept(
    network: SourceNetwork, rows: list[LineRow], inside: Mapping[str, int], changes: Changes
) -> list[LineRow]:
    """Lines of the feeder, each pointing away from the busbar, with positions."""
    kept = []
    for row in rows:
        a, b = row.from_bus in inside, row.to_bus in inside
        if a and b:
            back = inside[row.to_bus] < inside[row.from_bus]
            away = turned(row, network.nominal) if back else row
            place = network.xy.get(away.to_bus)
            kept.append(replace(away, to_x=place[0], to_y=place[1]) if place else away)
        elif a or b:
            effect = "open, towards buses that the busbar does not feed"
            changes.note(f"line {row.line}", WHOLE, "left out", effect)
    outside = len(network.nominal.keys() - inside.keys())
    if outside:
        effect = "above the busbar, behind a transformer or without supply"
        changes.note(_buses(outside), WHOLE, "left out", effect)
    return kept


def _not_fed(network: SourceNetwork, elsewhere: Collection[str]) -> Iterator[ConversionChange]:
    """Loads and generators that are connected neither to the feeder nor, as far as known, `elsewhere`."""
    everybody = [(draw.bus, draw.label) for draw in network.draws if not draw.idle]
    for bus, label in dict.fromkeys([*network.connected, *everybody]):
        if bus not in elsewhere:
            fed = bool(np.isfinite(network.volts.get(bus, np.nan)).any())
            yield ConversionChange(label, WHOLE, "left out", BEYOND if fed else UNFED)


def _buses(count: int) -> str:
    return f"{count} bus{'es' if count != 1 else ''}"


def _behind(
    network: SourceNetwork, rows: list[LineRow], inside: Mapping[str, int], changes: Changes
) -> tuple[list[Draw], set[str]]:
    """Couplings below the busbar as powers into them, and the buses behind them."""
    everything = [*rows, *as_rows(network.couplings)]
    above = above_busbar(next(iter(inside)), network.sources, rows, network.couplings)
    draws: list[Draw] = []
    summed: set[str] = set()
    for each in network.couplings:
        ends = [k for k, bus in enumerate(each.buses) if bus in inside]
        if not ends or any(bus in above and bus not in inside for bus in each.buses):
            continue
        far = {
            bus
            for end in each.buses
            if end not in inside
            for bus in reached(
                end, [row for row in everything if not {row.from_bus, row.to_bus} & inside.keys()]
            )
        }
        if not np.isfinite(np.array([each.power_kva[k] for k in ends])).all():
            effect = f"{_buses(len(far))}; the power into it is not known"
            changes.note(each.name, "load side", "left out", effect)
            continue
        summed |= far
        for k in ends:
            power = each.power_kva[k]
            name = each.name if len(ends) == 1 else f"{each.name} {each.buses[k]}"
            draws.append(Draw(name, each.buses[k], power, even=is_even(power)))
        total = sum((each.power_kva[k].sum() for k in ends), start=0j)
        what = f"{_buses(len(far))} became a customer with" if far else "in a loop; customers with"
        effect = f"{total.real:.4g} kW and {total.imag:.4g} kvar; exact at these loads only"
        effect = f"{what} the power into it, {effect}"
        changes.note(each.name, "load side", "changed", effect)
    return draws, summed

"""The power flow of a pandapower net: solved by pandapower, read bus by bus and element by element."""

from __future__ import annotations

import copy
import math
import warnings
from typing import Any, Final

import numpy as np

from feeders.convert_changes import Change
from feeders.convert_draws import in_star
from feeders.convert_network import Network
from gridsec.arrays import Phasors

CONNECTED: Final = ("load", "sgen", "asymmetric_load", "asymmetric_sgen")
CONNECTIONS: Final = ("wye", "delta")
"""Tables of what pandapower connects in star or between phases, and how their types say so."""

BASE_MVA: Final = 0.1
"""Base of power flows of three phases: pandapower ends them at a mismatch of 3e-8 pu of it."""

TURN: Final = np.exp(-2j * np.pi / 3.0 * np.arange(3))


def unbalanced(net: Any) -> bool:
    """Return whether a net has loads or generators of single phases.

    Parameters
    ----------
    net
        The net.
    """
    return any(
        len(net[table]) and net[table].in_service.any() for table in ("asymmetric_load", "asymmetric_sgen")
    )


def solve(net: Any, buses: dict[int, str], network: Network) -> Any:
    """Run the net's own power flow; return the solved copy, or None with the reason in the network.

    Parameters
    ----------
    net
        The net; stays as it is.
    buses
        Ids of its buses.
    network
        Takes the voltages.
    """
    import pandapower

    solved = copy.deepcopy(net)
    dependent = [
        column for column in net.load.columns if column.startswith("const_") and (net.load[column] > 0).any()
    ]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if unbalanced(net):
                _named_connections(solved, network)
                _three_phases(solved)
            else:
                if dependent:
                    pandapower.runpp(solved, numba=False, tolerance_mva=1e-10)
                    network.as_found = _volts(solved, buses)
                pandapower.runpp(solved, numba=False, tolerance_mva=1e-10, voltage_depend_loads=False)
        volts = _volts(solved, buses)
    except Exception as error:  # noqa: BLE001  # whatever the foreign solver raises on a foreign net
        text = " ".join(str(error).split()) or type(error).__name__
        network.unsolved = f"pandapower's own power flow fails: {text[:200]}"
        return None
    if not any(np.isfinite(v).all() for v in volts.values()):
        network.as_found, network.unsolved = {}, "pandapower's own power flow gives no voltages, NaN only"
        return None
    network.volts = volts
    return solved


def _three_phases(solved: Any) -> None:
    """Solve in three phases; where lines to buses out of service leave nothing but NaN, without them."""
    import pandapower

    solved.sn_mva = BASE_MVA
    pandapower.runpp_3ph(solved, numba=False, tolerance_mva=1e-11)
    dead = solved.bus.index[~solved.bus.in_service.astype(bool)]
    ending = solved.line.from_bus.isin(dead) | solved.line.to_bus.isin(dead)
    if ending.any() and solved.res_bus_3ph.vm_a_pu.isna().all():
        solved.line.loc[ending, "in_service"] = False
        pandapower.runpp_3ph(solved, numba=False, tolerance_mva=1e-11)


def _named_connections(solved: Any, network: Network) -> None:
    """Say which connections are in star: what is of another type, pandapower takes for nothing."""
    for table in CONNECTED:
        others = ~solved[table].type.isin(CONNECTIONS)
        if others.any():
            solved[table].loc[others, "type"] = "wye"
            effect = "in star; pandapower's own power flow of three phases leaves them out unless told so"
            network.changes.append(Change(f"{others.sum()} {table}(s)", "type", "changed", effect))


def _volts(net: Any, buses: dict[int, str]) -> dict[str, Phasors]:
    base = net.bus.vn_kv.to_numpy()[:, None] * 1000.0 / math.sqrt(3.0)
    if unbalanced(net):
        found = net.res_bus_3ph.loc[net.bus.index]
        size = found[[f"vm_{phase}_pu" for phase in "abc"]].to_numpy()
        angle = found[[f"va_{phase}_degree" for phase in "abc"]].to_numpy()
        v = base * size * np.exp(1j * np.deg2rad(angle))
    else:
        found = net.res_bus.loc[net.bus.index]
        one = found.vm_pu.to_numpy() * np.exp(1j * np.deg2rad(found.va_degree.to_numpy()))
        v = base * one[:, None] * TURN
    return {buses[int(i)]: row for i, row in zip(net.bus.index, v, strict=True)}


def _flow(solved: Any, table: str, index: int, side: str) -> Phasors:
    """What flows into an element, by phase, kVA."""
    tail = f"_{side}" if side else ""
    if unbalanced(solved):
        row = solved[f"res_{table}_3ph"].loc[index]
        s = [complex(row[f"p_{phase}{tail}_mw"], row[f"q_{phase}{tail}_mvar"]) for phase in "abc"]
        return np.asarray(np.array(s) * 1e3, dtype=np.complex128)
    row = solved[f"res_{table}"].loc[index]
    return np.full(3, complex(row[f"p{tail}_mw"], row[f"q{tail}_mvar"]) * 1e3 / 3.0)


def flow_into(solved: Any, table: str, index: int, side: str) -> Phasors:
    """Return what flows into an element, by phase, kVA; NaN where that is not known.

    Parameters
    ----------
    solved
        The solved net, or None.
    table, index
        The element.
    side
        Its end, as the results' columns have it; empty if it has only one.
    """
    unknown: Phasors = np.full(3, np.nan, dtype=np.complex128)
    if solved is None:
        return unknown
    try:
        return _flow(solved, table, index, side)
    except KeyError:  # not every table has results in three phases
        return unknown


def between_phases(net: Any, row: Any) -> bool:
    """Return whether a load or generator is connected between phases, and that matters.

    Parameters
    ----------
    net
        Its net.
    row
        Its row.
    """
    return row.get("type") == "delta" and unbalanced(net)


def phase_powers(net: Any, row: Any, label: str, volts: Phasors | None) -> tuple[Phasors, list[Change]]:
    """Return what a load draws from each phase, or a generator gives, kVA; and what is approximated in it.

    Parameters
    ----------
    net
        Its net.
    row
        Its row; if it is one of all three phases, each has a third.
    label
        What it is called where it is told about.
    volts : (3,)
        Voltages at its bus as pandapower solved them, V; None: it did not.
    """
    scale = 1e3 * float(row.scaling) * float(row.in_service)
    if "p_mw" in row:
        given = [complex(row.p_mw, row.q_mvar) / 3.0] * 3
    else:
        given = [complex(row[f"p_{phase}_mw"], row[f"q_{phase}_mvar"]) for phase in "abc"]
    power: Phasors = scale * np.array(given, dtype=np.complex128)
    if not between_phases(net, row):
        return power, []
    effect = "in star, its phases' powers as the source's power flow has them; exact at these loads only"
    known = volts is not None and bool(np.isfinite(volts).all())
    return in_star(power, volts if known and volts is not None else TURN), [
        Change(label, "delta", "approximated", effect)
    ]

"""Round trip of a conversion: AC power flow of the source's tool and of the feeder.

Both have the same loads, of constant power, and the same voltage at the busbar. The difference is the effect
of the conversion on the network.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from feeders.format.tables import FeederTables
from feeders.model.site import from_tables
from feeders.model.three_phase import spanned
from feeders.simulation.powerflow import PowerFlow, UnbalancedPowerFlow
from gridsec.arrays import Floats, Phasors
from gridsec.errors import GridsecError

BALANCED_PU: Final = 1e-6
UNBALANCED_PU: Final = 1e-5
"""Limits of the differences of a conversion without omissions, pu."""

UNIFORM: Final = 1e-8
"""Relative spread of the phases' voltages up to which a state is balanced."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceState:
    """Power flow by the source's tool at the source's own loads."""

    tool: str  # Name and version
    power_kva: Mapping[str, complex]  # Net import P + jQ of each customer, kVA; 0 for the others
    busbar_volt: Phasors  # (3,), voltages of the busbar, phase to neutral, V; NaN where a phase is absent
    # Voltage magnitudes (3,) of each bus, V, all loads of constant power; NaN where a phase is absent
    volts: Mapping[str, Floats]
    as_found: Mapping[str, Floats]  # The same with the loads' dependence on the voltage; empty without one


@dataclass(frozen=True, slots=True)
class SourceCheck:
    """Differences between a feeder's AC voltages and those of its source."""

    tool: str  # The source's tool and its version
    buses: int  # Number of compared buses
    three_phase: bool  # True for a comparison phase by phase
    largest_pu: float  # Largest difference of a voltage's magnitude, all loads of constant power, pu
    at: str  # Bus of the largest difference
    # Largest difference from the source with its loads' dependence on the voltage, pu; None without one
    as_found_pu: float | None
    # Buses at which, in at least one phase, only one of the two has a voltage
    unmatched: tuple[str, ...] = ()

    @property
    def exact(self) -> bool:
        """True if the difference is within the solvers' accuracy, and every voltage has its counterpart."""
        limit = UNBALANCED_PU if self.three_phase else BALANCED_PU
        return not self.unmatched and self.largest_pu <= limit

    @property
    def sentence(self) -> str:
        """Result as a sentence; the difference is rounded up to a power of ten, the same on every machine."""
        text = (
            f"AC power flow of {self.tool} and of this folder at the source's loads, {self.buses} buses"
            f"{', phase by phase' if self.three_phase else ''}: |v| differs by less than "
            f"{_above(self.largest_pu)} pu"
        )
        if not self.exact:
            text += f" (bus {self.at})"
        if self.as_found_pu is not None:
            text += f"; with the loads' dependence on the voltage by less than {_above(self.as_found_pu)} pu"
        if self.unmatched:
            more = f" and {len(self.unmatched) - 1} more" if len(self.unmatched) > 1 else ""
            text += f"; only one of them has a voltage at bus {self.unmatched[0]}{more}"
        return text


def _above(value: float) -> str:
    return f"{10.0 ** math.ceil(math.log10(max(value, 1e-8)) - 1e-9):.0e}"


def compare(state: SourceState, tables: FeederTables) -> SourceCheck:
    """Solve a converted feeder at its source's loads and compare the voltages of all buses.

    Raises PowerFlowDiverged if the feeder has no solution at these loads; FeederInvalid if neither the
        balanced nor the three-phase model supports the feeder; GridsecError if there is no bus at which both
        have a voltage.
    """
    power = np.array([state.power_kva.get(row.customer, 0.0) for row in tables.customers])
    v0 = np.nan_to_num(np.asarray(state.busbar_volt, dtype=np.complex128))
    size = np.abs(v0)
    phases = tables.in_phases or bool(np.ptp(size) > UNIFORM * size[0]) or not _uniform(state)
    if phases:
        unbalanced, _ = spanned(tables)
        _, volts = UnbalancedPowerFlow(unbalanced).solve(power.real, power.imag, v0)
        index, level = unbalanced.bus_of_file, unbalanced.nominal_volt
        volts[index[tables.meta.busbar], size == 0] = np.nan
    else:
        site = from_tables(tables)
        _, single_phase = PowerFlow(site).solve(power.real, power.imag, float(size[0]))
        volts, index = np.repeat(single_phase[:, None], 3, axis=1), site.bus_of_file
        level = site.nominal_volt
    common = [bus for bus in state.volts if bus in index]
    ours = volts[[index[bus] for bus in common]].reshape(-1, 3)
    theirs = np.array([state.volts[bus] for bus in common]).reshape(-1, 3)
    one_sided = (np.isnan(ours) != np.isnan(theirs)).any(axis=1)
    unmatched = tuple(bus for bus, alone in zip(common, one_sided, strict=True) if alone)
    both = np.isfinite(ours - theirs).any(axis=1)
    common, ours = [bus for bus, compared in zip(common, both, strict=True) if compared], ours[both]
    if not common:
        raise GridsecError(
            "there is no bus at which the source's power flow and the feeder both have a voltage",
            code="missing",
        )
    nominal = level[[index[bus] for bus in common]]
    apart = _apart(ours, [state.volts[bus] for bus in common]) / nominal
    found = None
    if state.as_found:
        found = float((_apart(ours, [state.as_found[bus] for bus in common]) / nominal).max())
    worst = int(apart.argmax())
    return SourceCheck(state.tool, len(common), phases, float(apart[worst]), common[worst], found, unmatched)


def _apart(ours: Floats, theirs: list[Floats]) -> Floats:
    """Largest difference at each bus over the phases in which both have a voltage."""
    return np.asarray(np.nan_to_num(np.abs(ours - np.array(theirs))).max(axis=1))


def _uniform(state: SourceState) -> bool:
    """True if all phases are equal at every bus with a voltage."""
    volts = np.array(list(state.volts.values())).reshape(-1, 3)
    volts = volts[np.isfinite(volts).any(axis=1)]
    return bool((np.ptp(volts, axis=1) <= UNIFORM * volts.max(axis=1)).all())

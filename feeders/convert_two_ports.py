"""A transformer of another tool as a line with an ideal ratio, from what that tool's power flow does to it.

However a tool describes a transformer (short-circuit tests, tables of taps, equivalent circuits), balanced it
is a linear two-port. Two power flows of it alone say everything: one with nothing behind it, one with an
impedance. The same two-port is a shunt at its first end, an ideal transformer of complex ratio t and a series
impedance behind that::

    V_1 = t (V_2 + z I_2),    I_1 = y V_1 + I_2 / t

so that nothing is left out: t makes the line's tap and the turn of its phases, z its impedance, and what y
takes is a customer. The angle of t that comes from y rather than from the vector group has no lossless
transformer; at a known operating point the customer takes what balances the powers.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.convert_customers import rounded
from feeders.convert_draws import Draw, is_even
from feeders.convert_graph import Coupling
from feeders.schema import LineRow
from gridsec.arrays import Phasors

if TYPE_CHECKING:
    from feeders.convert_network import Network

TAP_DIGITS: Final = 9
"""Decimals of a ratio: the same for transformers that are the same."""

TURN_DIGITS: Final = 6
"""The same of the degrees by which phases are turned."""

NO_LOAD_KVA: Final = 1e-6
"""Power below which a transformer takes nothing without load."""


@dataclass(frozen=True, slots=True)
class TwoPort:
    """A transformer, balanced.

    Attributes
    ----------
    ratio
        Complex ratio t of the voltage at its first end to that behind it, without load.
    series
        z behind it, ohm.
    """

    ratio: complex
    series: complex

    @classmethod
    def measured(cls, idle: tuple[complex, complex], loaded: tuple[complex, complex, complex]) -> TwoPort:
        """Identify it by two power flows.

        Parameters
        ----------
        idle
            Voltages at both ends, V, with nothing behind.
        loaded
            Voltages at both ends, V, and current out of the second one, A.
        """
        ratio = idle[0] / idle[1]
        return cls(ratio, (loaded[0] / ratio - loaded[1]) / loaded[2])

    @property
    def turn(self) -> float:
        """Degrees by which it turns the phases."""
        return round(math.degrees(cmath.phase(self.ratio)), TURN_DIGITS)

    def line(self, name: str, ends: tuple[str, str], nominal: tuple[float, float]) -> LineRow | None:
        """Return it as a line, its tap relative to the nominal voltages of its ends; None if it is none.

        Parameters
        ----------
        name, ends
            Of the transformer.
        nominal
            Nominal voltages at its ends, V.
        """
        r, x = rounded(self.series.real), rounded(self.series.imag)
        if not (math.isfinite(r) and math.isfinite(x)) or min(r, x) < 0 or r == x == 0:
            return None
        tap = round(abs(self.ratio) * nominal[1] / nominal[0], TAP_DIGITS)
        return LineRow(name, *ends, r, x, tap=tap)

    def idle(self, name: str, bus: str, flows: tuple[Phasors, Phasors], volts: Phasors) -> Draw | None:
        """Return what it takes beside the losses in z as a draw at its first end; None if that is nothing.

        Parameters
        ----------
        name, bus
            Of the transformer, and its first end.
        flows : (3,)
            What flows into it from each end, by phase, kVA.
        volts : (3,)
            Voltages behind it, V.
        """
        into, back = flows
        power: Phasors = into + back - np.abs(back) ** 2 / np.abs(volts) ** 2 * self.series * 1e3
        if not np.isfinite(power).all() or np.abs(power).sum() < NO_LOAD_KVA:
            return None
        return Draw(f"{name} no-load", bus, power, even=is_even(power), idle=True)


def coupling_of(
    name: str,
    buses: tuple[str, ...],
    power_kva: tuple[Phasors, ...],
    *,
    port: TwoPort | None,
    rating_a: float,
    network: Network,
) -> Coupling:
    """Return a transformer, and the line that it may be.

    Parameters
    ----------
    name, buses, power_kva
        As in `Coupling`.
    port
        What it does to its first two buses; None: not known.
    rating_a
        Rated current at the second, A.
    network
        Has nominal voltages, and voltages if there are any.
    """
    if port is None:
        return Coupling(name, buses, power_kva)
    here, there = network.nominal[buses[0]], network.nominal[buses[1]]
    line = port.line(name, (buses[0], buses[1]), (here, there))
    if line is None:
        return Coupling(name, buses, power_kva)
    limit = rounded(rating_a) if math.isfinite(rating_a) and rating_a > 0 else None
    behind = network.volts.get(buses[1])
    idle = None if behind is None else port.idle(name, buses[0], (power_kva[0], power_kva[1]), behind)
    return Coupling(name, buses, power_kva, replace(line, rating_a=limit), idle, port.turn)

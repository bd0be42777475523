"""Rows of customers.csv from what other tools know of a load: its power, and perhaps its profile."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from feeders.profiles import envelopes
from feeders.schema import CustomerRow

HOUSEHOLDS: Final = ("H0-A", "H0-B", "H0-C", "H0-G", "H0-L")
# Trade and agriculture whose reactive power follows the active power closely, as that of large loads does.
TRADE: Final = ("G1-A", "G2-A", "G6-A", "L1-A", "L2-A")
HOUSEHOLD_KW: Final = 30.0
USUAL_POWER_FACTOR: Final = 0.93
LEAST_POWER_FACTOR: Final = 0.01
"""The least that customers.csv can say."""

SMALL_KVA: Final = 4.6


def rounded(value: float) -> float:
    """Nine significant digits: enough for any cable, and free of the noise of the unit's conversion."""
    return float(f"{value:.9g}")


def usual_profile(number: int, *, household: bool) -> str:
    """Profile of the load of this number, dealt out in the order of the loads."""
    kinds = HOUSEHOLDS if household else TRADE
    return kinds[number % len(kinds)]


def reactive(customer: CustomerRow, power_factor: float | None) -> CustomerRow:
    """Fill in what the load's profile is known to do to the reactive power.

    Parameters
    ----------
    customer
        With its load and its profile.
    power_factor
        At the peak, lagging; None: the usual one.
    """
    factor = USUAL_POWER_FACTOR if power_factor is None else max(round(power_factor, 4), LEAST_POWER_FACTOR)
    tan = math.tan(math.acos(factor))
    history = envelopes()[customer.load_profile]
    # Rounded outwards, so that the interval still holds the history.
    return replace(
        customer,
        power_factor=factor,
        power_factor_min=min(
            factor,
            max(math.floor(1e4 * math.cos(math.atan(history.high * tan))) / 1e4, LEAST_POWER_FACTOR),
        ),
        power_factor_max=max(factor, math.ceil(1e4 * math.cos(math.atan(history.low * tan))) / 1e4),
        q_floor_kvar=math.ceil(1e4 * history.floor * tan * customer.load_kw) / 1e4,
    )


def droop_preset(kva: float) -> str:
    """Droop curve of an inverter of this size whose own is not known."""
    return "vde4105" if kva > SMALL_KVA else "vde4105-small"


def with_meters(rows: list[CustomerRow]) -> list[CustomerRow]:
    """Give every customer a meter: m01, m02, ... in their order."""
    digits = max(2, len(str(len(rows))))
    return [replace(row, meter=f"m{k:0{digits}d}") for k, row in enumerate(rows, start=1)]


def base_kva(volt: float, load_kw: float) -> float:
    """Base power of the per-unit system that suits a feeder of this voltage and load."""
    return 100.0 if volt < 1000.0 else 10.0 ** max(2, math.ceil(math.log10(max(load_kw, 1.0))))

"""Recordings of known feeders, and feeders whose files have known errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from feeders.format.tables import FeederTables
from feeders.model.site import Site, from_tables, load
from feeders.model.three_phase import ThreePhaseSite
from feeders.simulation.demand import Customers, Variation
from feeders.simulation.plant import Channel, MeterErrors, SimulatedMeters
from feeders.simulation.powerflow import UnbalancedPowerFlow
from feeders.simulation.recording import Recording, record
from feeders.simulation.scenario import START, Scenario
from feeders.studies.calibrate.search import longer
from gridsec.arrays import Floats
from gridsec.attack import Attack

CIGRE = load("cigre-lv")


def scenario(
    seed: int,
    *,
    ticks: int = 384,
    dt_s: float = 900.0,
    hidden_kw: float = 0.2,
    attacks: tuple[Attack, ...] = (),
) -> Scenario:
    """Days of readings with the errors that meters may have, hidden loads and 2 % of losses."""
    return Scenario(
        seed=seed,
        duration_s=ticks * dt_s,
        dt_s=dt_s,
        profile_s=0.0,
        variation=Variation(hidden_kw=hidden_kw, hidden_kvar=0.5 * hidden_kw),
        errors=MeterErrors(report_q=seed % 2 == 1),
        channel=Channel(loss=0.02),
        attacks=attacks,
    )


def recorded(folder: Path, given: Scenario) -> Recording:
    """The readings of the feeder as it really is."""
    return record(CIGRE, given, folder / "readings.parquet")


def biases(given: Scenario) -> Floats:
    """True biases relative to the busbar's meter, percent."""
    meters = SimulatedMeters(CIGRE, given.errors, given.channel, given.seed)
    return np.asarray(100.0 * (meters.bias - meters.busbar_bias))


def moved(tables: FeederTables, customer: str, bus: str) -> FeederTables:
    """Files in which a customer is at another bus."""
    rows = (replace(row, bus=bus) if row.customer == customer else row for row in tables.customers)
    return replace(tables, customers=tuple(rows))


def swapped(tables: FeederTables, one: str, other: str) -> FeederTables:
    """Files in which two customers have each other's meters."""
    names = {one: other, other: one}
    meter = {row.customer: row.meter for row in tables.customers}
    rows = (replace(row, meter=meter[names.get(row.customer, row.customer)]) for row in tables.customers)
    return replace(tables, customers=tuple(rows))


def shortened(tables: FeederTables, line: str, factor: float) -> FeederTables:
    """Files in which a line is shorter than it is, by the factor."""
    rows = (longer(row, 1.0 / factor) if row.line == line else row for row in tables.lines)
    return replace(tables, lines=tuple(rows))


def site(tables: FeederTables) -> Site:
    """The feeder that the files say."""
    return from_tables(tables)


def three_phase_readings(
    given: ThreePhaseSite, seed: int, ticks: int, dt_s: float, *, hidden_kw: float, apart: float = 0.0
) -> pd.DataFrame:
    """Readings of a feeder of three phases by asymmetric AC power flow, as a table.

    With `apart` the busbar's phases a and c are so much above and below b, as a part.
    """
    variation = Variation(hidden_kw=hidden_kw, hidden_kvar=0.5 * hidden_kw)
    t = START + dt_s * np.arange(ticks)
    customers = Customers(given, variation, seed, START, 0.0)  # type: ignore[arg-type]
    demand, (p, q) = customers.at(t), customers.hidden(t)
    flow = UnbalancedPowerFlow(given)
    v0 = demand.v0_volt[:, None] * (1.0 + apart * np.array([1.0, 0.0, -1.0]))
    connections, _ = flow.solve_batch(demand.p_kw + p, demand.q_kvar + q, v0)
    feeder = given.feeder
    first = np.searchsorted(feeder.of, np.arange(len(feeder.customers)))
    v = np.sqrt(np.add.reduceat(connections**2 * feeder.share, first, axis=1))
    meters = SimulatedMeters(given, MeterErrors(report_q=True), Channel(), seed)  # type: ignore[arg-type]
    read = meters.read(np.arange(ticks), v, demand.p_kw, demand.q_kvar, demand.v0_volt)
    none = np.full(ticks, np.nan)
    return pd.DataFrame(
        {
            "meter": np.tile(np.array([*given.meter_ids, ""]), ticks),
            "t": np.repeat(t, len(given.meter_ids) + 1),
            "v_volt": np.column_stack([read.v_volt, read.v0_volt]).ravel(),
            "p_kw": np.column_stack([read.p_kw, none]).ravel(),
            "q_kvar": np.column_stack([read.q_kvar, none]).ravel(),
            "v_phases": [each for row in v0.tolist() for each in (*[None] * len(given.meter_ids), row)],
        }
    )

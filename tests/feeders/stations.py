"""A feeder of 20 kV with two stations to 0.4 kV, customers on both levels; made by hand."""

from __future__ import annotations

from dataclasses import replace

from feeders.format.tables import CustomerRow, FeederMeta, FeederTables, LineRow

MV, LV = 20_000.0 / 3**0.5, 400.0 / 3**0.5

LINES = (
    LineRow("M1", "works", "m1", 0.4, 0.25, b_us=60.0),
    LineRow("M2", "m1", "m2", 0.9, 0.6, b_us=120.0),
    LineRow("M3", "m2", "m3", 0.5, 0.3, b_us=80.0),
    # 630 kVA and 400 kVA of 4 %, the second one step up.
    LineRow("T1", "m2", "s1", 0.0035, 0.0096, to_volt=LV),
    LineRow("T2", "m3", "s2", 0.0050, 0.0152, tap=0.975, to_volt=LV),
    LineRow("A1", "s1", "a1", 0.020, 0.008),
    LineRow("A2", "a1", "a2", 0.030, 0.010),
    LineRow("B1", "b1", "s2", 0.025, 0.009),  # given from its far end
    LineRow("B2", "b1", "b2", 0.020, 0.006),
)

LOADS = {
    "sawmill": ("m1", 250.0, 0.0),
    "dairy": ("m2", 180.0, 0.0),
    "quarry": ("m3", 220.0, 0.0),
    "a1-east": ("a1", 25.0, 20.0),
    "a1-west": ("a1", 18.0, 0.0),
    "a2-east": ("a2", 22.0, 15.0),
    "a2-west": ("a2", 15.0, 0.0),
    "b1-east": ("b1", 20.0, 25.0),
    "b1-west": ("b1", 12.0, 0.0),
    "b2-east": ("b2", 16.0, 10.0),
    "b2-west": ("b2", 14.0, 0.0),
}


def tables() -> FeederTables:
    """The feeder, balanced."""
    meta = FeederMeta(
        format=1,
        name="two-levels",
        voltage_volt=MV,
        busbar="works",
        base_kva=1000.0,
        busbar_resolution_volt=1.0,
    )
    customers = tuple(
        CustomerRow(
            customer=name,
            bus=bus,
            load_kw=kw,
            meter=name,
            resolution_volt=1.0 if bus.startswith("m") else None,
            pv_kw=kva,
            inverter_kva=kva,
            droop="vde4105" if kva else "",
        )
        for name, (bus, kw, kva) in LOADS.items()
    )
    return FeederTables(meta, LINES, customers)


def in_phases() -> FeederTables:
    """The same in three phases: the stations' customers have one phase each, those of 20 kV all of them."""
    made = tables()
    lines = tuple(replace(row, r0_ohm=2 * row.r_ohm, x0_ohm=3 * row.x_ohm) for row in made.lines)
    phases = dict(zip([name for name in LOADS if "-" in name], "abcabcab", strict=True))
    customers = tuple(
        replace(
            row,
            phases=phases.get(row.customer, "abc"),
            load_kw=row.load_kw / (3 if row.customer in phases else 1),
            pv_kw=row.pv_kw / 3,
            inverter_kva=row.inverter_kva / 3,
        )
        for row in made.customers
    )
    return replace(made, lines=lines, customers=customers)

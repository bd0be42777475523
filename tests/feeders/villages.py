"""A small made-up feeder for tests of the simulation: forks, a fused bus, a shared bus, inverters."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

from feeders.format.tables import CustomerRow, FeederMeta, FeederTables, LineRow, write
from feeders.model.site import Site, from_tables, load


def tables() -> FeederTables:
    """Eight customers on seven buses; c3 and c4 share one, c6 has no meter, c7 sits on the busbar."""
    meta = FeederMeta(format=1, name="village", voltage_volt=230.0, busbar="bb", base_kva=100.0)
    line = LineRow
    lines = (
        line("l1", "bb", "n1", 0.030, 0.012, b_us=5.0),
        line("l2", "n1", "n2", 0.040, 0.016),
        line("link", "n2", "n2b", 0.0, 0.0),
        line("l3", "n2b", "n3", 0.050, 0.015),
        line("l4", "n5", "n1", 0.060, 0.020),  # given from the far end
        line("l5", "n5", "n6", 0.045, 0.018, b_us=2.0),
        line("tie", "n3", "n6", 0.02, 0.01, closed=False),
    )

    def customer(
        name: str, bus: str, load: float, pv: float = 0.0, *, kva: float = 0.0, droop: str = ""
    ) -> CustomerRow:
        return CustomerRow(
            name, bus, load_kw=load, meter=f"m-{name}", pv_kw=pv, inverter_kva=kva, droop=droop
        )

    customers = (
        customer("c1", "n1", 8.0),
        customer("c2", "n2", 12.0, 15.0, kva=18.0, droop="ieee1547-b"),
        customer("c3", "n3", 9.0, 10.0, kva=12.0, droop="vde4105"),
        customer("c4", "n3", 6.0),
        customer("c5", "n5", 10.0, 20.0, kva=22.0, droop="asnzs4777-a"),
        replace(customer("c6", "n6", 7.0), meter=""),
        customer("c7", "bb", 20.0),
        customer("c8", "n6", 11.0, 25.0, kva=30.0, droop="ieee1547-b"),
    )
    return FeederTables(meta, lines, customers)


@cache
def village() -> Site:
    return from_tables(tables())


@cache
def village_without_inverters() -> Site:
    plain = tables()
    rows = tuple(replace(row, inverter_kva=0.0, droop="") for row in plain.customers)
    return from_tables(replace(plain, customers=rows))


def with_long_ids(like: str, folder: Path) -> Path:
    """Write a feeder with the longest ids of customers and meters, 64 characters, and return its folder."""

    def long(text: str) -> str:
        return text and f"{re.sub('[^A-Za-z0-9]', '-', text)}-{'x' * 64}"[:64]

    found = load(like).tables
    customers = tuple(
        replace(row, customer=long(row.customer), meter=long(row.meter)) for row in found.customers
    )
    write(replace(found, meta=replace(found.meta, name="long-" + "i" * 59), customers=customers), folder)
    return folder

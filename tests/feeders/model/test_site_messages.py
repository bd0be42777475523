"""What is said of feeders in three phases that cannot be loaded, and what makes a feeder one of those."""

from __future__ import annotations

from dataclasses import replace

import pytest

from feeders.format.tables import CustomerRow, FeederMeta, FeederTables, LineRow, validate
from feeders.model.site import from_tables
from gridsec.errors import FeederInvalid
from gridsec.grid.radial import Feeder

META = FeederMeta(format=1, name="x", voltage_volt=230.0, busbar="bb")
LINE = LineRow("t1", "bb", "n1", 0.03, 0.012, r0_ohm=0.09, x0_ohm=0.04)
X = CustomerRow("X", "n1", load_kw=6.0, meter="m1")
Y = CustomerRow("Y", "n1", load_kw=6.0, meter="m2")


def said(*rows: CustomerRow, lines: tuple[LineRow, ...] = (LINE,)) -> tuple[str, ...]:
    tables = FeederTables(META, lines, rows)
    with pytest.raises(FeederInvalid) as error:
        from_tables(tables)
    return error.value.problems


def test_rows_are_counted_as_in_the_files() -> None:
    more = "every id must be unique, as those of the phases of three-phase customers"
    assert said(X, Y, CustomerRow("X-a", "n1", load_kw=3.0, phases="a", meter="m3")) == (
        "customers, row 3 (X-a), column customer: 'X-a' is already the id of customers, row 1 (X); " + more,
    )
    assert said(CustomerRow("Z", "n1", load_kw=3.0, phases="b", meter="m2-c"), X, Y) == (
        "customers, row 3 (Y), column meter: 'm2-c' is already the id of customers, row 1 (Z); " + more,
    )
    (long,) = said(X, replace(Y, meter="m" * 63), CustomerRow("Z", "n1", load_kw=3.0, phases="b"))
    assert long.startswith("customers, row 2 (Y), column meter: 'mmm")
    assert "1 to 64" in long
    wrong = (X, Y, CustomerRow("Z", "nowhere", load_kw=3.0, phases="a"))
    assert said(*wrong) == validate(FeederTables(META, (LINE,), wrong))
    assert "customers, row 3 (Z)" in said(*wrong)[0]


def test_a_missing_zero_sequence_is_asked_for_with_the_reason() -> None:
    bare = replace(LINE, r0_ohm=None, x0_ohm=None)
    single = CustomerRow("Z", "n1", load_kw=3.0, phases="b", meter="m3")
    assert said(X, single, lines=(bare,)) == (
        "lines, line 't1', column r0_ohm: is missing; several phases need the zero sequence or a matrix "
        "(customer 'Z' makes the feeder one in three phases)",
    )
    spur = LineRow("spur", "n1", "n2", 0.03, 0.012, phases="b")
    assert said(X, lines=(bare, spur))[0].endswith("(line 'spur' makes the feeder one in three phases)")


def test_an_open_line_of_one_phase_leaves_a_feeder_balanced() -> None:
    bare = replace(LINE, r0_ohm=None, x0_ohm=None)
    spare = LineRow("spare", "bb", "n1", 0.03, 0.012, phases="b", closed=False)
    site = from_tables(FeederTables(META, (bare, spare), (X, Y)))
    assert isinstance(site.feeder, Feeder)
    assert site.meter_ids == ("m1", "m2")

"""The tables of a pandapower net: what is needed of them, and everything that keeps them from being read."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from numbers import Real
from typing import Any, Final

import numpy as np

from gridsec.errors import Problem

__all__ = ["CARRIED", "COLUMNS", "ids", "number", "problems_of", "with_truths"]

# Tables that are carried over, or told about one by one; every other row in the feeder earns a note.
CARRIED: Final = {
    "bus", "line", "load", "asymmetric_load", "asymmetric_sgen", "sgen", "switch", "trafo", "trafo3w",
    "ext_grid", "gen", "storage", "motor", "ward", "xward", "shunt", "impedance",
}  # fmt: skip

COLUMNS: Final = {
    "bus": "name vn_kv in_service",
    "line": "name from_bus to_bus length_km r_ohm_per_km x_ohm_per_km c_nf_per_km g_us_per_km max_i_ka df "
    "parallel in_service",
    "switch": "name bus element et closed",
    "load": "name bus p_mw q_mvar scaling in_service",
    "asymmetric_load": "name bus p_a_mw p_b_mw p_c_mw q_a_mvar q_b_mvar q_c_mvar scaling in_service",
    "sgen": "name bus p_mw q_mvar sn_mva scaling in_service",
    "asymmetric_sgen": "name bus p_a_mw p_b_mw p_c_mw q_a_mvar q_b_mvar q_c_mvar scaling in_service",
    "ext_grid": "bus in_service",
    "trafo": "name hv_bus lv_bus in_service",
    "trafo3w": "name hv_bus mv_bus lv_bus in_service",
    "shunt": "name bus p_mw q_mvar vn_kv step in_service",
}
"""What is needed of a net's tables."""

LEAST: Final = {"a number": -math.inf, "at least 0": 0.0, "at least 1": 1.0, "above 0": math.ulp(0.0)}
"""The least that a number can be, by what is said of it."""

POWERS: Final = dict.fromkeys(("p_mw", "q_mvar", "scaling"), "a number")
PHASE_POWERS: Final = dict.fromkeys(
    (
        "scaling",
        *(f"{part}_{phase}_{unit}" for part, unit in (("p", "mw"), ("q", "mvar")) for phase in "abc"),
    ),
    "a number",
)

NUMBERS: Final = {
    "bus": {"vn_kv": "above 0"},
    "line": {
        **dict.fromkeys(("length_km", "r_ohm_per_km", "x_ohm_per_km", "c_nf_per_km"), "at least 0"),
        "parallel": "at least 1",
    },
    "load": POWERS,
    "sgen": POWERS,
    "asymmetric_load": PHASE_POWERS,
    "asymmetric_sgen": PHASE_POWERS,
    "shunt": {**dict.fromkeys(("p_mw", "q_mvar", "step"), "a number"), "vn_kv": "above 0"},
}
"""Numbers without which a row says nothing, and what they can be."""

TRUTHS: Final = ("in_service", "closed")
"""Columns that are true or false in every table."""


def ids(table: Any, noun: str, taken: Iterable[str] = ()) -> dict[int, str]:
    """Return an id per row: the source's name where there is a unique one, otherwise with its index.

    Parameters
    ----------
    table
        A table of a net.
    noun
        What a row is called that has no name.
    taken
        Names that others have.
    """
    given = {int(i): _clean(name) for i, name in zip(table.index, table["name"], strict=True)}
    count = Counter([*given.values(), *taken])
    found: dict[int, str] = {}
    for i, name in given.items():
        own = name if name and count[name] == 1 else f"{name or noun}-{i}"
        while own != name and count[own]:
            own += "'"
        found[i] = own
        count[own] += own != name
    return found


def _clean(name: object) -> str:
    text = "" if name is None or name != name else str(name)  # noqa: PLR0124  # NaN is the table's None
    return "".join(c if c.isprintable() else " " for c in text).strip()[:100]


def problems_of(net: Any) -> list[Problem]:
    """Return everything that keeps a net's tables from being read.

    Parameters
    ----------
    net
        What a file held.
    """
    missing = [
        Problem("missing", f"the table {table!r} is missing")
        for table in COLUMNS
        if not hasattr(net.get(table), "columns")
    ]
    if missing:
        return missing
    problems = [
        Problem("missing", f"{table}: the column {column!r} is missing")
        for table, columns in COLUMNS.items()
        for column in columns.split()
        if column not in net[table].columns
    ]
    if problems:
        return problems
    for table, columns in COLUMNS.items():
        ends = [name for name in columns.split() if name == "bus" or name.endswith("_bus")]
        for column in ends:
            strange = net[table].index[~net[table][column].isin(net.bus.index)]
            problems += [
                Problem("unknown-index", f"{table} {i}: {column} {net[table].at[i, column]} is no bus")
                for i in strange
            ]
    for kind, table in (("b", "bus"), ("l", "line")):
        given = net.switch[net.switch.et == kind]
        strange = given.index[~given.element.isin(net[table].index)]
        problems += [
            Problem("unknown-index", f"switch {i}: element {net.switch.at[i, 'element']} is no {table}")
            for i in strange
        ]
    return [*problems, *_numbers(net)]


def _numbers(net: Any) -> Iterator[Problem]:
    """Whatever is not a number or a truth, or not one that it can be."""
    if not isinstance(net.get("f_hz"), Real) or not 0.0 < net.f_hz < math.inf:
        yield Problem("not-positive", f"f_hz is {net.get('f_hz')}; expected a frequency")
    for table, columns in NUMBERS.items():
        for column, wanted in columns.items():
            values = np.asarray([number(cell) for cell in net[table][column]], dtype=np.float64)
            bad = net[table].index[~((values >= LEAST[wanted]) & np.isfinite(values))]
            for i in bad:
                yield Problem(
                    "out-of-range", f"{table} {i}: {column} is {net[table].at[i, column]}; expected {wanted}"
                )
    for table, column in _truths(net):
        for i, cell in net[table][column].items():
            if not _is_truth(cell):
                yield Problem("wrong-type", f"{table} {i}: {column} is {cell}; expected true or false")


def with_truths(net: Any) -> Any:
    """Return a net whose columns of 0 and 1 are of truths, as pandapower itself takes them.

    Parameters
    ----------
    net
        A pandapower net; stays as it is.
    """
    numeric = [
        (table, column)
        for table, column in _truths(net)
        if net[table][column].dtype != bool and all(map(_is_truth, net[table][column]))
    ]
    if numeric:
        net = copy.deepcopy(net)
    for table, column in numeric:
        net[table][column] = net[table][column].astype(bool)
    return net


def _truths(net: Any) -> Iterator[tuple[str, str]]:
    for table in sorted(CARRIED):
        for column in TRUTHS:
            if column in getattr(net.get(table), "columns", ()):
                yield table, column


def _is_truth(cell: object) -> bool:
    return number(cell) in (0.0, 1.0)


def number(cell: object) -> float:
    """Return a cell's number; NaN if it has none.

    Parameters
    ----------
    cell
        Of a table.
    """
    return float(cell) if isinstance(cell, Real | np.bool_) else math.nan

"""The feeder format: every problem at once, and what goes in comes out."""

from __future__ import annotations

import json
import math
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from feeders.format import tables as tables_of
from feeders.format import validation
from feeders.format.columns import (
    CUSTOMER_COLUMNS,
    LINE_COLUMNS,
    META_COLUMNS,
    REQUIRED,
    SUSPICIONS,
    Column,
    Id,
    Name,
    Names,
    Number,
    Pair,
    Text,
    Truth,
    Whole,
)
from feeders.format.tables import (
    CustomerRow,
    FeederMeta,
    FeederTables,
    Limits,
    LineRow,
    LoadDefaults,
    MeterDefaults,
    MonitorDefaults,
    examine,
    from_json,
    read,
    to_json,
    validate,
    write,
)
from feeders.format.validation import Edge, tree
from feeders.model.site import find, load
from feeders.profiles import load_names, pv_names
from gridsec.errors import FeederInvalid
from gridsec.grid.devices import PRESETS
from tests.codes import codes_of

CASES = Path(__file__).parents[2] / "cases"
GOOD = sorted(path for path in (CASES / "good").iterdir())
BROKEN = sorted(path for path in (CASES / "broken").iterdir())


def name_of(path: Path) -> str:
    return path.name


# --- tables for properties ----------------------------------------------------------------------

positive = st.floats(1e-6, 10.0, allow_nan=False)
ids = st.text(
    st.characters(codec="utf-8", exclude_categories=("C", "Z")) | st.just(" "), min_size=1, max_size=20
).filter(lambda text: text == text.strip() and text.isprintable())


def maybe(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.none() | strategy


@st.composite
def metas(draw: st.DrawFn, busbar: str) -> FeederMeta:
    low = draw(st.floats(0.5, 0.9))
    return FeederMeta(
        format=1,
        name=draw(st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)),
        title=draw(st.just("") | ids),
        voltage_volt=draw(st.floats(100.0, 379.0)),
        base_kva=draw(st.floats(1.0, 1e4)),
        busbar=busbar,
        busbar_xy=draw(maybe(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)))),
        meshed=draw(st.booleans()),
        busbar_class_percent=draw(st.floats(0.02, 2.0)),
        accept=tuple(draw(st.lists(st.sampled_from(SUSPICIONS), unique=True))),
        limits=Limits(low, draw(st.floats(0.95, 1.5))),
        meters=MeterDefaults(
            class_percent=draw(st.floats(0.02, 10.0)), p_resolution_kw=draw(st.floats(0, 1))
        ),
        load=LoadDefaults(0.9, 0.8, draw(st.floats(0.95, 1.0)), draw(st.floats(0.0, 50.0))),
        monitor=MonitorDefaults(max_attacked=draw(st.integers(0, 9)), tick_s=draw(st.floats(0.1, 900.0))),
    )


@st.composite
def feeders(draw: st.DrawFn) -> FeederTables:
    """Any valid feeder: random trees, fused buses, open ties, every optional cell there or not."""
    buses = draw(st.lists(ids, min_size=2, max_size=8, unique=True))
    lines = []
    names = draw(st.lists(ids, min_size=2 * len(buses), max_size=2 * len(buses), unique=True))
    for k in range(1, len(buses)):
        ends = [buses[draw(st.integers(0, k - 1))], buses[k]]
        r = draw(st.just(0.0) | st.floats(1e-4, 0.01))
        lines.append(
            LineRow(
                line=names[k],
                from_bus=ends[0],
                to_bus=ends[1],
                phases=draw(st.sampled_from(["abc", "a", "b", "c"])),
                r_ohm=r,
                x_ohm=0.4 * r,
                r0_ohm=draw(maybe(positive)),
                b_us=draw(st.floats(0.0, 100.0)),
                tap=draw(st.floats(0.9, 1.1)),
                rating_a=draw(maybe(st.floats(1.0, 500.0))),
                to_x=1.0 if k % 2 else None,
                to_y=-2.5 if k % 2 else None,
            )
        )
    if draw(st.booleans()):
        lines.append(LineRow(names[0], buses[0], buses[-1], 0.01, 0.01, closed=False))
    customers = []
    for k, customer in enumerate(draw(st.lists(ids, min_size=1, max_size=6, unique=True))):
        kva = draw(st.just(0.0) | st.floats(0.1, 50.0))
        customers.append(
            CustomerRow(
                customer=customer,
                bus=draw(st.sampled_from(buses)),
                load_kw=draw(st.floats(0.0, 20.0)),
                phases=draw(st.sampled_from(["abc", "a", "b", "c"])),
                meter=draw(st.just("") | st.just(f"m{k}")),
                class_percent=draw(maybe(st.floats(0.02, 10.0))),
                q_floor_kvar=draw(maybe(st.floats(0.0, 10.0))),
                load_profile=draw(st.sampled_from(["", *load_names()])),
                pv_profile=draw(st.sampled_from(["", *pv_names()])),
                pv_kw=draw(st.floats(0.0, 50.0)),
                inverter_kva=kva,
                droop=draw(st.sampled_from(PRESETS)) if kva else "",
                tau_s=draw(maybe(st.floats(0.01, 100.0))),
            )
        )
    return FeederTables(draw(metas(busbar=buses[0])), tuple(lines), tuple(customers))


# --- good input ---------------------------------------------------------------------------------


@pytest.mark.parametrize("case", GOOD, ids=name_of)
def test_good_case_survives_every_form(case: Path, tmp_path: Path) -> None:
    tables = read(case)
    write(tables, tmp_path / "again")
    assert read(tmp_path / "again") == tables
    assert from_json(json.loads(json.dumps(to_json(tables)))) == tables
    assert validate(tables) == ()
    columns = to_json(tables)
    for table in ("lines", "customers"):
        columns[table] = {key: [row[key] for row in columns[table]] for key in columns[table][0]}
    assert from_json(columns) == tables


def test_cells_arrive_as_written() -> None:
    tables = read(CASES / "good" / "three-customers")
    assert tables.meta.voltage_volt == 230.0
    assert tables.meta.busbar_xy == (0.0, 0.0)
    assert tables.meta.meters == MeterDefaults(class_percent=1.0)
    assert tables.lines[0] == LineRow("L1", "station", "corner", 0.1, 0.02, b_us=100.0, to_x=1.0, to_y=0.0)
    assert tables.customers[1] == CustomerRow(
        "smith", "east", load_kw=3.0, meter="m-smith", load_profile="H0-A", pv_kw=5.0, pv_profile="PV1",
        inverter_kva=6.0, droop="ieee1547-b",
    )  # fmt: skip
    assert tables.customers[2].tau_s == 2.5


def test_notes_say_what_was_ignored_and_fused() -> None:
    notes = examine(CASES / "good" / "fused").notes
    assert any("'note for the fitter'" in note for note in notes)
    assert any("bus bar A, bus bar B are one" in note for note in notes)
    unmetered = examine(CASES / "good" / "three-customers").notes
    assert any("without a meter: miller" in note for note in unmetered)


@pytest.mark.acceptance
@given(feeders())
def test_valid_tables_round_trip(tables: FeederTables) -> None:
    assert validate(tables) == ()
    assert from_json(json.loads(json.dumps(to_json(tables)))) == tables


@pytest.mark.acceptance
@given(tables=feeders())
def test_valid_tables_round_trip_through_files(
    tables: FeederTables, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("feeder")
    write(tables, folder)
    assert examine(folder).problems == ()
    assert read(folder) == tables


def test_numbers_of_numpy_are_written_as_numbers(tmp_path: Path) -> None:
    """As tables have them that a program makes."""
    tables = read(next(path for path in GOOD if path.is_dir()))
    first = tables.lines[0]
    line = replace(first, x_ohm=np.float64(first.x_ohm), closed=np.bool_(first.closed))
    made = replace(
        tables,
        meta=replace(
            tables.meta, voltage_volt=np.float64(230.5), busbar_xy=(np.float64(1.0), np.float64(2.5))
        ),
        lines=(line, *tables.lines[1:]),
    )
    write(made, tmp_path)
    again = read(tmp_path)
    assert again == made
    assert type(again.lines[0].x_ohm) is float


def test_every_field_of_a_row_declares_its_column() -> None:
    for made, columns in [
        (LineRow, LINE_COLUMNS),
        (CustomerRow, CUSTOMER_COLUMNS),
        (FeederMeta, META_COLUMNS[""]),
    ]:
        declared = [each.name for each in fields(made) if each.name not in META_COLUMNS]
        assert declared == [column.name for column in columns]


@pytest.mark.parametrize("name", ["kerber-landnetz", "ieee-european-lv"])
def test_a_feeder_is_parsed_and_checked_once_per_load(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables from files are valid; a copy with other rows is not known to be valid."""
    counts = Counter[str]()

    def counted(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            counts[what] += 1
            return function(*args)

        return call

    monkeypatch.setattr(tables_of, "_parse_table", counted("parsed", tables_of._parse_table))
    monkeypatch.setattr(validation, "check", counted("checked", validation.check))
    site = load(name)
    assert counts == {"parsed": 2, "checked": 1}  # lines.csv and customers.csv
    copied = replace(find(name), customers=site.tables.customers)
    assert not copied.valid
    counts.clear()
    assert validate(copied) == validate(copied) == ()
    assert copied.valid
    assert counts == {"parsed": 2, "checked": 1}


# --- broken input -------------------------------------------------------------------------------


@pytest.mark.parametrize("case", BROKEN, ids=name_of)
def test_broken_case_names_every_problem(case: Path) -> None:
    expected = tuple((case / "problems.txt").read_text(encoding="utf-8").splitlines())
    assert validate(case) == expected
    with pytest.raises(FeederInvalid) as caught:
        read(case)
    assert caught.value.problems == expected
    assert "" not in caught.value.codes


def test_five_mistakes_are_five_problems() -> None:
    assert len(validate(CASES / "broken" / "five-mistakes")) == 5


@pytest.mark.parametrize(
    ("path", "code"), [("does-not-exist", "missing"), ("good/fused/lines.csv", "wrong-type")]
)
def test_path_that_is_no_folder(path: str, code: str) -> None:
    assert codes_of(validate(CASES / path)) == [code]


def test_the_busbar_meter_s_name_is_taken() -> None:
    obj = to_json(read(CASES / "good" / "three-customers"))
    obj["customers"][1]["meter"] = "substation"
    (problem,) = examine(obj).problems
    assert problem.startswith("customers, row 2 ")
    assert (problem.code, "column meter: 'substation'" in problem) == ("duplicate", True)
    obj["customers"][1]["meter"] = "substation-2"
    assert examine(obj).problems == ()


def test_titles_have_an_end() -> None:
    obj = to_json(read(CASES / "good" / "three-customers"))
    obj["feeder"]["title"] = "x" * 200
    assert examine(obj).problems == ()
    obj["feeder"]["title"] = "x" * 201
    (problem,) = examine(obj).problems
    assert (problem.code, "key title: " in problem) == ("wrong-text", True)


def test_accepted_doubts_become_notes(tmp_path: Path) -> None:
    tables = read(CASES / "good" / "three-customers")
    doubtful = replace(tables, meta=replace(tables.meta, voltage_volt=400.0))
    (problem,) = validate(doubtful)
    assert (problem.code, "230.94" in problem) == ("doubtful", True)
    accepted = replace(doubtful, meta=replace(doubtful.meta, accept=("voltage",)))
    assert validate(accepted) == ()
    assert any(note.startswith("accepted: ") and "400" in note for note in examine(accepted).notes)
    write(accepted, tmp_path)
    assert read(tmp_path) == accepted


GARBAGE: dict[type[Column], tuple[Any, ...]] = {
    Number: (
        "nan",
        "inf",
        "-1e400",
        "1_000",
        "0x1",
        "12 kV",
        True,
        [],
        {},
        math.nan,
        math.inf,
        10**400,
        "٣,٥",
    ),
    Whole: ("1.5", 2.5, "x", False, math.nan),
    Truth: ("yes", 2, 1.0, "TRUEE", []),
    Text: (1, 2.5, True, [], "\x00", "x" * 201),
    Id: (7, "a\nb", "\ud800", "\u200b", "x" * 129, ["1"]),
    Name: ("a b", "ä", "x" * 65, 5, "a/b", "*", "a\n"),
    Pair: (1, [1], [1, "x"], "1,2", [1, math.nan]),
    Names: ("voltage", [1], ["nonsense"]),
}


@given(st.data())
def test_every_corrupted_cell_is_named(data: st.DataObject) -> None:
    """Whatever single cell is spoilt, the report names its table, row and column."""
    obj = to_json(read(CASES / "good" / "three-customers"))
    place = data.draw(st.sampled_from(["feeder", "lines", "customers", *(s for s in META_COLUMNS if s)]))
    if place in ("lines", "customers"):
        row = data.draw(st.integers(0, 2))
        columns = LINE_COLUMNS if place == "lines" else CUSTOMER_COLUMNS
        cells, where = obj[place][row], f"{place}, row {row + 1}"
    elif place == "feeder":
        columns, cells, where = META_COLUMNS[""], obj["feeder"], "feeder"
    else:
        columns, cells, where = META_COLUMNS[place], obj["feeder"][place], f"feeder, [{place}]"
    column = data.draw(st.sampled_from(columns))
    garbage = GARBAGE[type(column)] + ((None, "", "  ") if column.default is REQUIRED else ())
    if isinstance(column, Number) and (
        column.above is not None or (column.low is not None and column.low >= 0)
    ):
        garbage += (-3, "-0.5")
    cells[column.name] = data.draw(st.sampled_from(garbage))
    problems = examine(obj).problems
    spoilt = [p for p in problems if p.startswith(where) and column.name in p]
    assert spoilt, problems
    assert all("expected" in p and p.code for p in spoilt)
    with pytest.raises(FeederInvalid):
        from_json(obj)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(
                [
                    "feeder",
                    "lines",
                    "customers",
                    "line",
                    "customer",
                    "bus",
                    "from_bus",
                    "to_bus",
                    "name",
                    "limits",
                    "x",
                ]
            ),
            inner,
            max_size=5,
        )
    ),
    max_leaves=25,
)


@given(json_values)
def test_any_json_is_reported_never_a_traceback(obj: Any) -> None:
    assert examine(obj if isinstance(obj, dict) else {"feeder": obj}).problems
    with pytest.raises(FeederInvalid):
        from_json(obj)


def test_deeply_nested_json_is_reported() -> None:
    deep: Any = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(FeederInvalid):
        from_json({"feeder": deep, "lines": [deep], "customers": {"customer": [deep]}})


@given(st.binary(max_size=300), st.binary(max_size=300), st.binary(max_size=300))
def test_any_bytes_are_reported_never_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, meta: bytes, lines: bytes, customers: bytes
) -> None:
    folder = tmp_path_factory.mktemp("garbage")
    for name, content in (("feeder.toml", meta), ("lines.csv", lines), ("customers.csv", customers)):
        (folder / name).write_bytes(content)
    assert validate(folder)


@given(st.data())
def test_any_flipped_byte_of_a_file_is_reported_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("flipped")
    case = CASES / "good" / "three-customers"
    contents = {path.name: bytearray(path.read_bytes()) for path in case.iterdir()}
    name = data.draw(st.sampled_from(sorted(contents)))
    content = contents[name]
    content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    for path, other in contents.items():
        (folder / path).write_bytes(other)
    outcome = examine(folder)
    assert (outcome.tables is None) == bool(outcome.problems)


def test_oversized_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(read(CASES / "good" / "three-customers"), tmp_path)
    monkeypatch.setattr("feeders.format.columns.MAX_BYTES", 100)
    problems = validate(tmp_path)
    assert any((each.code, each.partition(": ")[0]) == ("too-many", "feeder.toml") for each in problems)


def test_huge_input_is_answered_quickly_and_briefly() -> None:
    """A megabyte of mistakes: no quadratic search, no endless report."""
    count = 6000
    lines = [
        {"line": "x", "from_bus": str(k), "to_bus": str((k * 7919) % count), "r_ohm": -1, "x_ohm": 1}
        for k in range(count)
    ]
    customers = [{"customer": "x", "bus": f"b{k}", "load_kw": "many"} for k in range(count)]
    start = time.thread_time()
    problems = examine({"feeder": {"busbar": "0"}, "lines": lines, "customers": customers}).problems
    assert time.thread_time() - start < 5.0
    assert len(problems) == 1001
    assert codes_of(problems).index("more") == 1000


def test_file_with_a_byte_order_mark_and_crlf(tmp_path: Path) -> None:
    tables = read(CASES / "good" / "fused")
    write(tables, tmp_path)
    for path in tmp_path.iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert read(tmp_path) == tables


# --- the graph, against networkx ----------------------------------------------------------------

small_buses = st.integers(0, 9).map(str)
edges = st.lists(
    st.tuples(small_buses, small_buses, st.booleans()).filter(lambda edge: edge[0] != edge[1]), max_size=14
)


@given(edges)
def test_graph_against_networkx(ends: list[tuple[str, str, bool]]) -> None:
    lines = [Edge(str(k), a, b, zero) for k, (a, b, zero) in enumerate(ends)]
    found = tree("0", lines, ["9"])
    whole: nx.MultiGraph[str] = nx.MultiGraph()
    fused: nx.Graph[str] = nx.Graph()
    for graph in (whole, fused):
        graph.add_nodes_from(["0", "9", *(bus for edge in ends for bus in edge[:2])])
    whole.add_edges_from((edge.from_bus, edge.to_bus) for edge in lines)
    fused.add_edges_from((edge.from_bus, edge.to_bus) for edge in lines if edge.zero)

    reached = nx.node_connected_component(whole, "0")
    assert set(found.group) == reached
    assert {frozenset(island) for island in found.islands} == {
        frozenset(piece) for piece in nx.connected_components(whole) if "0" not in piece
    }
    groups = [piece for piece in nx.connected_components(fused) if piece & reached]
    assert len(found.buses) == len(groups)
    assert all(len({found.group[bus] for bus in piece}) == 1 for piece in groups)

    real = [edge for edge in lines if not edge.zero]
    joints = [next(iter(p)) for p in nx.connected_components(fused)]
    cycles = len(real) - len(joints) + nx.number_connected_components(whole)
    assert len(found.loops) == cycles
    assert all(found.parent[k] <= k for k in range(len(found.parent)))
    for k, line in enumerate(found.branch):
        edge = lines[line]
        assert {found.group[edge.from_bus], found.group[edge.to_bus]} == {found.parent[k], k + 1}
    for loop in found.loops:  # every fused bus on a loop has exactly two of its ends
        ring: nx.MultiGraph[frozenset[str]] = nx.MultiGraph()
        of = {bus: frozenset(piece) for piece in nx.connected_components(fused) for bus in piece}
        ring.add_edges_from((of[lines[k].from_bus], of[lines[k].to_bus]) for k in loop)
        assert nx.is_connected(ring)
        assert all(degree == 2 for _, degree in ring.degree())


# --- the document -------------------------------------------------------------------------------


def test_document_names_every_column_and_its_meaning() -> None:
    text = (Path(__file__).parents[3] / "docs" / "feeder-format.md").read_text(encoding="utf-8")
    for columns in (LINE_COLUMNS, CUSTOMER_COLUMNS, *META_COLUMNS.values()):
        for column in columns:
            assert f"| `{column.name}` | {column.meaning} |" in text, column.name
    assert all(f"| `{suspicion}` |" in text for suspicion in SUSPICIONS)


def test_document_states_the_default_estimator() -> None:
    text = (Path(__file__).parents[3] / "docs" / "feeder-format.md").read_text(encoding="utf-8")
    (row,) = (line for line in text.splitlines() if line.startswith("| `estimator` |"))
    assert row.endswith(f"| `{MonitorDefaults().estimator}` |")


def test_examples_of_the_document_are_valid(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "feeder-format.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(toml|csv|json)\n(.*?)```", text, flags=re.DOTALL)
    for name, (_, block) in zip(("feeder.toml", "lines.csv", "customers.csv"), blocks[:3], strict=True):
        (tmp_path / name).write_text(block, encoding="utf-8")
    assert validate(tmp_path) == ()
    assert from_json(json.loads(blocks[3][1])).meta == read(tmp_path).meta

"""power-grid-model's JSON: against its own power flow, and nothing dropped in silence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from feeders.convert.convert import convert
from feeders.convert.round_trip import BALANCED_PU, UNBALANCED_PU
from feeders.format.tables import read
from gridsec.errors import FeederInvalid, GridsecError
from tests.codes import refused
from tests.feeders.foreign import pgm

Rows = list[dict[str, Any]]


def line(number: int, one: int, other: int, **changed: Any) -> dict[str, Any]:
    row = {
        "id": number, "from_node": one, "to_node": other, "from_status": 1, "to_status": 1, "r1": 0.05,
        "x1": 0.02, "c1": 3e-7, "tan1": 0.0, "r0": 0.2, "x0": 0.06, "c0": 3e-7, "tan0": 0.0, "i_n": 200.0,
    }  # fmt: skip
    return row | changed


def load(number: int, node: int, p: Any, q: Any, kind: int = 0) -> dict[str, Any]:
    return {"id": number, "node": node, "status": 1, "type": kind, "p_specified": p, "q_specified": q}


def transformer(number: int, one: int, other: int, volts: tuple[float, float]) -> dict[str, Any]:
    return {
        "id": number, "from_node": one, "to_node": other, "from_status": 1, "to_status": 1, "u1": volts[0],
        "u2": volts[1], "sn": 4e5, "uk": 0.04, "pk": 4e3, "i0": 0.01, "p0": 500.0, "winding_from": 2,
        "winding_to": 1, "clock": 11, "tap_side": 0, "tap_pos": 0, "tap_min": -2, "tap_max": 2,
        "tap_size": 50.0,
    }  # fmt: skip


def street() -> dict[str, Rows]:
    return {
        "node": [{"id": 1, "u_rated": 10e3}, *({"id": k, "u_rated": 400.0} for k in range(2, 8))],
        "transformer": [transformer(10, 1, 2, (10e3, 400.0))],
        "line": [line(20, 2, 3), line(21, 4, 3), line(22, 4, 6)],
        "source": [{"id": 40, "node": 1, "status": 1, "u_ref": 1.01, "sk": 1e9}],
        "sym_load": [load(50, 3, 1e4, 3e3), load(51, 6, 5e3, 1e3)],
    }


def written(folder: Path, tables: dict[str, Rows], **header: Any) -> str:
    path = folder / "grid.json"
    head = {"version": "1.0", "type": "input", "is_batch": False, "attributes": {}} | header
    path.write_text(json.dumps(head | {"data": tables}))
    return str(path)


@pytest.mark.parametrize(("nodes", "balanced"), [(50, True), (50, False)])
def test_voltages_are_power_grid_models_own(nodes: int, balanced: bool, tmp_path: Path) -> None:
    done = convert(str(pgm(tmp_path / "town.json", nodes, balanced=balanced)), tmp_path / "town")
    assert done.check is not None
    assert (done.check.buses, done.check.three_phase) == (nodes, not balanced)
    assert done.check.largest_pu < (BALANCED_PU if balanced else UNBALANCED_PU)
    assert [each.done for each in done.changes] == ["left out"]


@pytest.mark.acceptance
def test_large_network(tmp_path: Path) -> None:
    done = convert(str(pgm(tmp_path / "city.json", 1000, balanced=True)), tmp_path / "city")
    assert done.check is not None
    assert done.check.buses == 1000
    assert done.check.largest_pu < BALANCED_PU


def test_everything_is_carried_over_or_named(tmp_path: Path) -> None:
    tables = street()
    tables["line"] += [line(23, 3, 2), line(24, 6, 2, to_status=0), line(25, 7, 6, c1=5e-7, tan1=1e-4)]
    tables["link"] = [{"id": 30, "from_node": 4, "to_node": 5, "from_status": 1, "to_status": 1}]
    tables["shunt"] = [
        {"id": 60, "node": 4, "status": 1, "g1": 0.0, "b1": 0.05, "g0": 0.0, "b0": 0.05},
        {"id": 61, "node": 4, "status": 1, "g1": 1e-6, "b1": -1e-6, "g0": 0.0, "b0": 0.0},
        {"id": 62, "node": 4, "status": 0, "g1": 1.0, "b1": 0.0, "g0": 0.0, "b0": 0.0},
    ]
    tables["sym_load"].append(load(52, 5, 1e4, 3e3, kind=2))
    tables["asym_load"] = [load(53, 5, [5e3, 0.0, 2e3], [1e3, 0.0, 0.0])]
    tables["sym_gen"] = [load(54, 3, 1.5e4, 0.0)]
    tables["sym_load"].append(load(56, 5, 6e3, 1e3) | {"status": 0})
    tables["node"].append({"id": 8, "u_rated": 230.0})
    tables["transformer"].append(transformer(11, 7, 8, (400.0, 230.0)))
    tables["sym_load"].append(load(55, 8, 8e3, 2e3))
    tables["sym_voltage_sensor"] = [{"id": 70, "measured_object": 3, "u_sigma": 1.0, "u_measured": 400.0}]
    done = convert(written(tmp_path, tables), tmp_path / "x")
    assert done.check is not None
    assert done.check.largest_pu < UNBALANCED_PU
    assert done.check.as_found_pu is not None
    assert done.check.as_found_pu > UNBALANCED_PU
    feeder = read(tmp_path / "x")
    lines = {row.line: row for row in feeder.lines}
    both = lines["line 20"]  # and 23 beside it
    np.testing.assert_allclose(
        [both.r_ohm, both.x_ohm, both.r0_ohm, both.x0_ohm, both.rating_a], [0.025, 0.01, 0.1, 0.03, 400.0]
    )
    assert both.b_us == pytest.approx(2 * 2 * np.pi * 50 * 0.3)
    assert (lines["link 30"].r_ohm, lines["link 30"].closed) == (0.0, True)
    assert lines["line 24"].closed is False
    assert lines["line 25"].b_ab_us == pytest.approx(2e6 * np.pi * 50 * (3e-7 - 5e-7) / 3)
    customers = {row.customer: row for row in feeder.customers}
    assert customers["asym_load 53-a"].load_kw == pytest.approx(5.0)
    assert customers["sym_gen 54"].pv_kw == pytest.approx(15.0)
    said = "\n".join(done.notes)
    for part in (
        "constant current of sym_load 52",
        "in service of sym_load 56; switched off",
        "shunt conductance of line 25",
        "connection of shunt 60",
        "inductance of shunt 61",
        "conductance of shunt 61",
        "left out: shunt 62; switched off",
        "load side of transformer 11; 1 bus became a customer",
        "left out: 1 sym_voltage_sensor(s)",
        "line 20 + line 23; in parallel",
    ):
        assert part in said, part


def test_lines_given_by_matrices(tmp_path: Path) -> None:
    """A grounded neutral is eliminated by hand here: z - z_n^2 / z_nn."""
    tables = street()
    tables["line"].pop()
    matrix = {f"r_{a}{b}": 0.1 for a, b in ("ba", "ca", "cb", "na", "nb", "nc")}
    matrix |= {f"x_{a}{b}": 0.04 for a, b in ("ba", "ca", "cb", "na", "nb", "nc")}
    matrix |= {f"{part}_{a}{a}": value for part, value in (("r", 0.3), ("x", 0.1)) for a in "abcn"}
    tables["asym_line"] = [
        {"id": 26, "from_node": 4, "to_node": 6, "from_status": 1, "to_status": 1, "c0": 1e-7, "c1": 1e-7}
        | matrix
    ]
    done = convert(written(tmp_path, tables), tmp_path / "x")
    assert done.check is not None
    assert done.check.largest_pu < UNBALANCED_PU
    row = {row.line: row for row in read(tmp_path / "x").lines}["asym_line 26"]
    assert row.r0_ohm is not None
    assert row.x0_ohm is not None
    own, mutual, neutral = 0.3 + 0.1j, 0.1 + 0.04j, 0.3 + 0.1j
    reduced = own + 2 * mutual - 3 * mutual**2 / neutral
    assert complex(row.r_ohm, row.x_ohm) == pytest.approx(own - mutual)
    assert complex(row.r0_ohm, row.x0_ohm) == pytest.approx(reduced)


def test_lines_that_are_not_transposed(tmp_path: Path) -> None:
    tables = street()
    tables["line"].pop()
    entries = {"aa": 0.3, "ba": 0.1, "bb": 0.35, "ca": 0.12, "cb": 0.09, "cc": 0.28}
    matrix = {f"r_{pair}": value for pair, value in entries.items()}
    matrix |= {f"x_{pair}": 0.7 * value for pair, value in entries.items()}
    matrix |= {f"c_{pair}": (1e-6 if pair[0] == pair[1] else 4e-7) * value for pair, value in entries.items()}
    ends = {"id": 26, "from_node": 4, "to_node": 6, "from_status": 1, "to_status": 1}
    tables["asym_line"] = [ends | matrix, ends | matrix | {"id": 27}]
    done = convert(written(tmp_path, tables), tmp_path / "x")
    assert done.check is not None
    assert done.check.three_phase
    assert done.check.largest_pu < UNBALANCED_PU
    assert {each.done for each in done.changes} == {"left out", "changed"}  # above, and two as one
    row = {row.line: row for row in read(tmp_path / "x").lines}["asym_line 26"]
    assert (row.r_ab_ohm, row.x_cc_ohm) == (pytest.approx(0.05), pytest.approx(0.098))
    assert row.b_bc_us == pytest.approx(2 * 2e6 * np.pi * 50 * 4e-7 * 0.09)
    assert row.r_ohm == pytest.approx(0.5 * (0.31 - 0.31 / 3))


def test_zero_sequence_charging_of_a_balanced_network_is_left_out(tmp_path: Path) -> None:
    tables = street()
    tables["line"][1]["c0"] = 1e-7
    done = convert(written(tmp_path, tables), tmp_path / "x")
    assert done.check is not None
    assert not done.check.three_phase
    assert done.check.largest_pu < BALANCED_PU
    assert any("charging between phases of line line 21" in note for note in done.notes)
    assert not read(tmp_path / "x").in_phases


def test_half_open_line_at_medium_voltage_keeps_its_charging(tmp_path: Path) -> None:
    tables = {
        "node": [{"id": k, "u_rated": 20e3} for k in (1, 2, 3)],
        "line": [
            line(20, 1, 2, r1=2.0, x1=2.0),
            line(21, 1, 3, r1=2.0, x1=2.0),
            line(22, 2, 3, r1=4.0, x1=4.0, c1=2e-6, to_status=0),
        ],
        "source": [{"id": 40, "node": 1, "status": 1, "u_ref": 1.0, "sk": 1e9}],
        "sym_load": [load(50, 2, 2e6, 1e6), load(51, 3, 2e6, 1e6)],
    }
    done = convert(written(tmp_path, tables), tmp_path / "x")
    assert done.check is not None
    assert done.check.largest_pu < 1e-8
    rows = {row.line: row for row in read(tmp_path / "x").lines}
    assert rows["line 22"].closed is False
    assert rows["line 22 open end"].from_bus == "2"


def test_all_problems_at_once(tmp_path: Path) -> None:
    tables = street()
    tables["line"][1]["from_node"] = 77
    tables["sym_load"][0]["id"] = 51
    with refused(FeederInvalid, "source-invalid", "source-invalid") as caught:
        convert(written(tmp_path, tables), tmp_path / "x")
    said = str(caught.value)
    assert "valid node id" in said
    assert "unique" in said
    assert not (tmp_path / "x").exists()


def test_what_is_no_feeder_is_told(tmp_path: Path) -> None:
    looped = street()
    looped["line"].append(line(23, 6, 2))
    with refused(FeederInvalid, "not-radial"):
        convert(written(tmp_path, looped), tmp_path / "x")
    opened = convert(written(tmp_path, looped), tmp_path / "x", opened=["line 23"])
    assert opened.check is not None
    assert not opened.check.exact
    fed = street()
    fed["source"].append({"id": 41, "node": 6, "status": 1, "u_ref": 1.0})
    with refused(GridsecError, "busbar-unclear") as caught:
        convert(written(tmp_path, fed), tmp_path / "y")
    assert "1, 6" in str(caught.value)
    with refused(FeederInvalid, "several-sources"):
        convert(written(tmp_path, fed), tmp_path / "y", root="2")
    with refused(GridsecError, "unknown-name"):
        convert(written(tmp_path, street()), tmp_path / "y", root="nowhere")
    mixed = street()
    mixed["node"][5]["u_rated"] = 230.0
    with refused(GridsecError, "not-converged") as caught:
        convert(written(tmp_path, mixed), tmp_path / "y")
    assert "line 22" in str(caught.value)
    heavy = street()
    heavy["sym_load"][0]["p_specified"] = 1e9
    with refused(GridsecError, "not-converged"):
        convert(written(tmp_path, heavy), tmp_path / "y")
    with refused(GridsecError, "wrong-type"):
        convert(written(tmp_path, street(), type="update"), tmp_path / "y")
    with refused(FeederInvalid, "missing", "missing"):
        convert(written(tmp_path, {"sym_load": []}), tmp_path / "y")
    assert not (tmp_path / "y").exists()


def test_branches_with_a_ratio_are_lines_with_a_tap(tmp_path: Path) -> None:
    tables = street()
    tables["node"] += [{"id": k, "u_rated": 400.0} for k in (8, 9)]
    branch = {"from_status": 1, "to_status": 1, "x1": 0.02, "r1": 0.01, "g1": 0.0, "theta": 0.0, "sn": 1e5}
    tables["generic_branch"] = [
        {"id": 27, "from_node": 6, "to_node": 8, "b1": 3e-4, "k": 0.96} | branch,
        {"id": 28, "from_node": 9, "to_node": 6, "b1": 0.0, "k": 0.98} | branch,
    ]
    tables["sym_load"] += [load(57, 8, 8e3, 2e3), load(58, 9, 8e3, 2e3)]
    done = convert(written(tmp_path, tables), tmp_path / "x")
    assert done.check is not None
    assert not done.check.three_phase
    assert done.check.largest_pu < BALANCED_PU
    rows = {row.line: row for row in read(tmp_path / "x").lines}
    assert rows["generic_branch 27"].tap == 0.96
    back = rows["generic_branch 28"]  # from the busbar's side now
    assert (back.from_bus, back.tap, back.r_ohm) == (
        "6",
        pytest.approx(1 / 0.98),
        pytest.approx(0.01 * 0.98**2),
    )

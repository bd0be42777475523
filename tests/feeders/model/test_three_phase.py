"""The three-phase loader: what it makes of the files, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from feeders.format.columns import PAIRS
from feeders.format.tables import FeederTables, LineRow, examine, from_json, read, to_json
from feeders.model.site import find, from_tables, load
from feeders.model.three_phase import ThreePhaseSite, load_three_phase, three_phase, three_phase_names
from feeders.simulation.powerflow import UnbalancedPowerFlow
from feeders.studies.calibrate.search import longer
from gridsec.arrays import Floats, Phasors
from gridsec.errors import FeederInvalid
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.three_phase import bus_voltages, lindist3flow, per_customer, sensitivities, sequence_matrix
from tests.codes import refused

CASE = Path(__file__).parents[2] / "cases" / "good" / "single-phase"
EUROPEAN = "ieee-european-lv"


def single_phase() -> FeederTables:
    tables = read(CASE)
    return replace(tables, lines=tuple(replace(line, tap=1.0) for line in tables.lines))


def test_per_unit_of_a_small_feeder() -> None:
    site = three_phase(single_phase())
    feeder = site.feeder
    base = 3 * 230.0**2 / (1000.0 * 100.0)
    assert feeder.buses == ("0", "1", "2", "3")
    own, mutual = (0.2 + 0.04j + 2 * (0.05 + 0.01j)) / 3, (0.15 + 0.03j) / 3
    three = np.where(np.eye(3, dtype=bool), own, mutual)
    np.testing.assert_allclose(feeder.z[:2] * base, [three, three], rtol=1e-14)
    lateral = np.zeros((3, 3), dtype=complex)
    lateral[1, 1] = 0.05 + 0.01j  # without zero sequence: conductor and return
    np.testing.assert_allclose(feeder.z[2] * base, lateral, rtol=1e-14)
    np.testing.assert_array_equal(feeder.phases[3], [False, True, False])
    np.testing.assert_array_equal(feeder.connected, [[1, 0, 0], [1, 1, 1], [0, 1, 0]])
    assert site.meter_ids == ("1", "2", "3")
    assert site.bus_of_file == {"0": 0, "1": 1, "2": 2, "3": 3}


def test_a_lateral_with_zero_sequence_has_its_self_impedance() -> None:
    tables = single_phase()
    lines = (*tables.lines[:2], replace(tables.lines[2], r0_ohm=0.2, x0_ohm=0.07))
    feeder = three_phase(replace(tables, lines=lines)).feeder
    base = 3 * 230.0**2 / (1000.0 * 100.0)
    assert feeder.z[2, 1, 1] * base == pytest.approx((0.2 + 0.07j + 2 * (0.05 + 0.01j)) / 3)


def bare(matrix: Phasors, line: LineRow, **changes: object) -> LineRow:
    """A line with this matrix of impedances instead of its sequences."""
    pairs = {f"{'abc'[i]}{'abc'[j]}": (i, j) for i in range(3) for j in range(i, 3)}
    cells = {f"{symbol}_{pair}_ohm": part[at] for symbol, part in (("r", matrix.real), ("x", matrix.imag))
             for pair, at in pairs.items()}  # fmt: skip
    one = matrix.diagonal().mean() - matrix[np.triu_indices(3, 1)].mean()
    given = {"r_ohm": one.real, "x_ohm": one.imag, "r0_ohm": None, "x0_ohm": None}
    return replace(line, **(cells | given | changes))


Z = np.array([[0.3 + 0.2j, 0.1 + 0.09j, 0.08 + 0.06j], [0, 0.34 + 0.21j, 0.11 + 0.1j], [0, 0, 0.28 + 0.22j]])
Z = Z + np.triu(Z, 1).T


def test_a_line_that_is_not_transposed_has_its_own_matrices() -> None:
    tables = single_phase()
    charging = {
        "b_aa_us": 5.0,
        "b_ab_us": -1.0,
        "b_ac_us": -1.5,
        "b_bb_us": 4.0,
        "b_bc_us": -0.5,
        "b_cc_us": 6.0,
    }
    one = bare(Z, tables.lines[0], b_us=6.0, **charging)
    tables = replace(tables, lines=(one, *tables.lines[1:]))
    site = three_phase(tables)
    base = 3 * 230.0**2 / (1000.0 * 100.0)
    np.testing.assert_allclose(site.feeder.z[0] * base, Z, rtol=1e-14)
    B = np.array([[5.0, -1.0, -1.5], [-1.0, 4.0, -0.5], [-1.5, -0.5, 6.0]])
    np.testing.assert_allclose(site.feeder.charging[0] / base, 1e-6 * B, rtol=1e-14)
    grid = UnbalancedPowerFlow(site).grid
    np.testing.assert_array_equal(grid.z_ohm[0], Z)
    np.testing.assert_allclose(grid.b_siemens[0], 1e-6 * B, rtol=1e-15)
    p, q, v0 = np.array([2.0, 9.0, 1.5]), np.array([0.3, 2.0, 0.2]), np.full(3, 1.02**2)
    truth = UnbalancedPowerFlow(site).solve(p, q, 1.02 * 230.0)[1] / 230.0
    drawn = [site.feeder.connections(-3 * power / 100) for power in (p, q)]
    model = np.sqrt(bus_voltages(site.feeder, *drawn, v0, steps=20)).T
    model[~site.feeder.phases] = np.nan
    np.testing.assert_allclose(model, truth, rtol=0, atol=1e-9)
    # In files and in JSON, nothing of it is lost.
    assert from_json(to_json(tables)) == tables


def test_a_line_of_another_length_has_another_matrix() -> None:
    tables = single_phase()
    one = bare(Z, tables.lines[0], b_us=3.0, **{f"b_{pair}_us": 3.0 * (pair[0] == pair[1]) for pair in PAIRS})
    found = three_phase(replace(tables, lines=(longer(one, 1.3), *tables.lines[1:]))).feeder
    base = 3 * 230.0**2 / (1000.0 * 100.0)
    np.testing.assert_allclose(found.z[0] * base, 1.3 * Z, rtol=1e-14)
    np.testing.assert_allclose(found.charging[0] / base, 3.9e-6 * np.eye(3), rtol=1e-14)


@pytest.mark.parametrize("phases", ["ab", "bc", "ca"])
def test_a_line_of_two_phases(phases: str) -> None:
    tables = single_phase()
    here = [k for k, phase in enumerate("abc") if phase in phases]
    block = Z[np.ix_(here, here)]
    one = block.diagonal().mean() - block[0, 1]
    cells = {f"r_{pair}_ohm": None for pair in PAIRS} | {f"x_{pair}_ohm": None for pair in PAIRS}
    for i in here:
        for j in (j for j in here if j >= i):
            pair = "abc"[i] + "abc"[j]
            cells |= {f"r_{pair}_ohm": Z[i, j].real, f"x_{pair}_ohm": Z[i, j].imag}
    lateral = replace(tables.lines[2], phases=phases, r_ohm=one.real, x_ohm=one.imag, **cells)
    customer = replace(tables.customers[2], phases=phases[1])
    tables = replace(tables, lines=(*tables.lines[:2], lateral), customers=(*tables.customers[:2], customer))
    site = three_phase(tables)
    base = 3 * 230.0**2 / (1000.0 * 100.0)
    np.testing.assert_allclose(site.feeder.z[2][np.ix_(here, here)] * base, block, rtol=1e-14)
    np.testing.assert_array_equal(site.feeder.phases[3], [phase in phases for phase in "abc"])
    # With its sequences instead, of those that transposed it would have.
    twin = replace(lateral, r0_ohm=0.2, x0_ohm=0.4, **dict.fromkeys(cells))
    expected = sequence_matrix(one, np.array(0.2 + 0.4j))
    found = three_phase(replace(tables, lines=(*tables.lines[:2], twin))).feeder.z[2]
    np.testing.assert_allclose(found[np.ix_(here, here)] * base, expected[np.ix_(here, here)], rtol=1e-14)
    assert np.isfinite(from_tables(tables).feeder.R).all()


@pytest.mark.parametrize(
    ("changes", "code", "place"),
    [
        ({"x_bc_ohm": None}, "missing", "columns x_bc_ohm"),
        ({"phases": "a"}, "inconsistent", "column r_aa_ohm"),
        (
            {"phases": "ab"},
            "absent-phase",
            "columns r_ac_ohm, r_bc_ohm, r_cc_ohm, x_ac_ohm, x_bc_ohm, x_cc_ohm",
        ),
        (
            {"r_ohm": 0.5},
            "inconsistent",
            "column r_ohm: 0.5 is not the positive sequence of the line's matrix; expected 0.21",
        ),
        ({"r0_ohm": 0.5, "x0_ohm": 0.5}, "inconsistent", "columns r0_ohm and x0_ohm"),
        ({"r_ab_ohm": 0.4, "r_ohm": 0.11}, "not-definite", "columns r_aa_ohm to r_cc_ohm"),
        ({"b_aa_us": 1.0}, "missing", "columns b_ab_us, b_ac_us, b_bb_us, b_bc_us, b_cc_us"),
        (
            {"b_us": 4.0 / 3} | {f"b_{pair}_us": float(pair[0] != pair[1]) * -2.0 for pair in PAIRS},
            "not-definite",
            "columns b_aa_us to b_cc_us",
        ),
        (
            {f"r_{pair}_ohm": 0.3 for pair in PAIRS}
            | {f"x_{pair}_ohm": 0.2 for pair in PAIRS}
            | {"r_ohm": 0.0, "x_ohm": 0.0},
            "singular",
            "columns r_aa_ohm to x_cc_ohm",
        ),
    ],
)
def test_what_is_no_matrix_of_a_line(changes: dict[str, object], code: str, place: str) -> None:
    tables = single_phase()
    lines = (bare(Z, tables.lines[0], **changes), *tables.lines[1:])
    problems = examine(to_json(replace(tables, lines=lines))).problems
    where = f"lines, row 1 (1), {place}"
    assert any(problem.code == code and problem.startswith(where) for problem in problems), problems
    assert all("expected" in problem for problem in problems)


def test_a_balanced_feeder_has_the_matrices_of_the_balanced_loader() -> None:
    tables = find("kerber-dorfnetz")
    lines = tuple(replace(line, r0_ohm=4 * line.r_ohm, x0_ohm=3 * line.x_ohm) for line in tables.lines)
    tables = replace(tables, lines=lines)
    one, three = from_tables(tables).feeder.linear(), lindist3flow(three_phase(tables).feeder)
    # The voltage of phase a by equal powers in the three phases of a customer.
    count = one.R.shape[0]
    for matrix, expected in ((three.R, one.R), (three.X, one.X)):
        summed = matrix[::3].reshape(count, count, 3).sum(axis=2)
        np.testing.assert_allclose(summed, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("line", "changes", "code", "place"),
    [
        (0, {"r0_ohm": None}, "missing", "line '1', column r0_ohm: "),
        (1, {"r0_ohm": None, "x0_ohm": None}, "missing", "line '2', column r0_ohm: "),
        (2, {"r0_ohm": 0.1}, "missing", "line '3', column x0_ohm: "),
        (2, {"r_ohm": 0.0, "x_ohm": 0.0}, "absent-phase", "line '3': "),
        (0, {"r_ohm": 0.0, "x_ohm": 0.0}, "inconsistent", "line '1': "),
        (0, {"r0_ohm": 0.0, "x0_ohm": 0.0}, "zero-impedance", "line '1': "),
    ],
)
def test_what_three_phases_need(line: int, changes: dict[str, float | None], code: str, place: str) -> None:
    tables = single_phase()
    lines = list(tables.lines)
    lines[line] = replace(lines[line], **changes)
    with refused(FeederInvalid, code) as caught:
        three_phase(replace(tables, lines=tuple(lines)))
    assert caught.value.problems[0].startswith(f"lines, {place}")


def test_a_customer_needs_his_phases_at_his_bus() -> None:
    tables = single_phase()
    customers = (*tables.customers[:2], replace(tables.customers[2], phases="c"))
    with refused(FeederInvalid, "absent-phase") as caught:
        three_phase(replace(tables, customers=customers))
    assert "bus '3'" in str(caught.value)


def test_a_switch_fuses_its_buses() -> None:
    tables = single_phase()
    switch = replace(tables.lines[1], r_ohm=0.0, x_ohm=0.0, r0_ohm=None, x0_ohm=None)
    site = three_phase(replace(tables, lines=(tables.lines[0], switch, tables.lines[2])))
    assert site.bus_of_file["2"] == site.bus_of_file["1"] == 1
    assert len(site.feeder.buses) == 3


def test_nothing_to_watch() -> None:
    tables = single_phase()
    lines = tuple(
        replace(line, r_ohm=0.0, x_ohm=0.0, r0_ohm=None, x0_ohm=None, phases="abc") for line in tables.lines
    )
    with refused(FeederInvalid, "nothing-to-design"):
        three_phase(replace(tables, lines=lines))


def test_the_european_feeder() -> None:
    assert three_phase_names() == [EUROPEAN]
    site = load_three_phase(EUROPEAN)
    feeder = site.feeder
    assert (len(feeder.buses), len(feeder.customers), len(site.meter_ids)) == (906, 55, 55)
    assert feeder.of.size == 55
    assert site.droop.customer.size == 19
    assert site.xy is not None
    assert site.xy.shape == (906, 2)
    np.testing.assert_array_equal(np.bincount(feeder.phase), [21, 19, 15])
    assert all(row.power_factor == 0.95 for row in site.tables.customers)
    model = lindist3flow(feeder)
    # Mutual impedance makes the matrices neither symmetric nor nonnegative.
    assert np.abs(model.X - model.X.T).max() > 0.5 * np.abs(model.X).max()
    assert 0.2 < (model.X < 0).mean() < 0.5
    assert np.linalg.eigvalsh(model.X + model.X.T)[0] > 0.0


def test_equipment_is_that_of_the_balanced_loader() -> None:
    tables = find("kerber-dorfnetz")
    lines = tuple(replace(line, r0_ohm=4 * line.r_ohm, x0_ohm=3 * line.x_ohm) for line in tables.lines)
    tables = replace(tables, lines=lines)
    one, three = from_tables(tables), three_phase(tables)
    assert three.meter_ids == one.meter_ids
    assert three.digest == one.digest != load("kerber-dorfnetz").digest
    parts = {"droop": ("customer", "q", "tau", "slope"), "accuracy": ("class_fraction", "busbar_jitter")}
    for part, fields in (parts | {"loads": ("load_peak", "pv_peak", "q_error")}).items():
        for name in fields:
            mine, theirs = (getattr(getattr(site, part), name) for site in (three, one))
            np.testing.assert_array_equal(mine, theirs)
    flow = per_customer(three.feeder, lindist3flow(three.feeder))
    model = one.feeder.linear()
    np.testing.assert_allclose(flow.R, model.R, rtol=0, atol=1e-13)
    np.testing.assert_allclose(flow.X, model.X, rtol=0, atol=1e-13)


def test_a_site_has_a_customer_and_a_meter_for_each_phase() -> None:
    site = from_tables(single_phase())
    assert isinstance(site.feeder, PhasedFeeder)
    assert site.feeder.customers == ("1", "2-a", "2-b", "2-c", "3")
    assert site.meter_ids == ("1", "2-a", "2-b", "2-c", "3")
    assert [site.feeder.buses[place] for place in site.feeder.bus] == ["2.a", "2.a", "2.b", "2.c", "3.b"]
    whole, parts = single_phase().customers[1], site.tables.customers[1:4]
    assert sum(row.load_kw for row in parts) == pytest.approx(whole.load_kw)
    assert [row.phases for row in parts] == ["a", "b", "c"]
    # The phases together are the customer that the three-phase model has whole.
    whole_site = three_phase(single_phase())
    one, three = per_customer(whole_site.feeder, lindist3flow(whole_site.feeder)), site.feeder
    sums = np.array([[1, 0, 0, 0, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 1]]) / np.array([[1], [3], [1]])
    for place, customer in ((three.R, one.R), (three.X, one.X)):
        np.testing.assert_allclose(sums @ place[three.bus] @ sums.T, customer, rtol=0, atol=1e-15)
    # And again nothing is left to part.
    assert from_tables(site.tables).digest == site.digest


@pytest.mark.parametrize("phases", ["ab", "cba"])
def test_phases_that_the_format_does_not_have_are_refused(phases: str) -> None:
    tables = find("ieee-european-lv")
    first, *others = tables.customers
    with refused(FeederInvalid, "unknown-name") as caught:
        from_tables(replace(tables, customers=(replace(first, phases=phases), *others)))
    assert "column phases" in str(caught.value)
    assert len(caught.value.problems) == 1


def test_uncertain_powers_are_parted_as_those_of_independent_phases() -> None:
    tables = single_phase()
    rows = tuple(replace(row, p_std_kw=0.6, q_std_kvar=0.3) for row in tables.customers)
    parts = from_tables(replace(tables, customers=rows)).tables.customers[1:4]
    assert np.hypot.reduce([row.p_std_kw for row in parts]) == pytest.approx(0.6)
    assert np.hypot.reduce([row.q_std_kvar for row in parts]) == pytest.approx(0.3)


def test_there_is_no_such_feeder() -> None:
    with refused(FeederInvalid, "unknown-name"):
        load_three_phase("no-such-feeder")


# --- the models against the asymmetric AC power flow ----------------------------------------------


def errors(site: ThreePhaseSite, p_kw: Floats, q_kvar: Floats) -> tuple[float, float, float]:
    """Largest error of |v| of LinDist3Flow, with its correction, and of the single-phase equivalent, pu."""
    feeder = site.feeder
    truth = UnbalancedPowerFlow(site).solve(p_kw, q_kvar, 1.05 * feeder.base_volt)[1] / feeder.base_volt
    third, v0 = feeder.base_kva / 3, np.full(3, 1.05**2)
    plain, once = (
        np.sqrt(bus_voltages(feeder, -p_kw / third, -q_kvar / third, v0, steps=n)).T for n in (0, 1)
    )
    everywhere = tuple(replace(row, phases="abc") for row in site.tables.customers)
    single = from_tables(replace(site.tables, customers=everywhere)).feeder
    one = np.sqrt(single.bus_voltages(-p_kw / 100, -q_kvar / 100, 1.05**2))
    apart = np.abs(one[feeder.at] - truth[feeder.at, feeder.phase])
    return float(np.abs(plain - truth).max()), float(np.abs(once - truth).max()), float(apart.max())


def test_voltages_of_the_european_feeder_are_within_a_tenth_of_a_percent() -> None:
    site = load_three_phase(EUROPEAN)
    peak = np.array([row.load_kw for row in site.tables.customers])
    tan = np.tan(np.arccos(0.95))
    plain, once, single = errors(site, np.ones(55), np.full(55, tan))  # the source's nominal load
    assert plain < 3e-4
    assert once < 2e-5
    assert single > 5e-3
    plain, once, single = errors(site, peak, peak * tan)  # its fullest minute
    assert plain < 1.5e-3
    assert once < 2e-4
    assert single > 0.03


def test_sensitivities_of_the_european_feeder_are_within_two_percent() -> None:
    site = load_three_phase(EUROPEAN)
    feeder, flow = site.feeder, UnbalancedPowerFlow(site)
    p = np.array([row.load_kw for row in site.tables.customers])
    q, third = p * np.tan(np.arccos(0.95)), feeder.base_kva / 3
    model = sensitivities(feeder, -p / third, -q / third, np.full(3, 1.05**2))
    bump = 0.05 * np.vstack([np.eye(55), -np.eye(55)])
    v0 = np.full(110, 1.05 * feeder.base_volt)
    for matrix, at in ((model.R, (p + bump, q + 0 * bump)), (model.X, (p + 0 * bump, q + bump))):
        squared = (flow.solve_batch(*at, v0)[0] / feeder.base_volt) ** 2
        slope = (squared[55:] - squared[:55]).T / (0.2 / third)
        largest = np.abs(slope).max(axis=1, keepdims=True)
        assert (np.abs(matrix - slope) <= 0.02 * largest).all()

"""Meshes of three phases: from the files, against AC power flows, watched by every estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from benchmarks.mesh import closed, european, landnetz, sensitivity
from feeders.format.tables import FeederTables, LineRow, examine, read, validate, write
from feeders.model.site import Site, from_tables, load
from feeders.model.three_phase import three_phase
from feeders.registry import MODAL, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.powerflow import PlacesFlow, power_flow
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, TrialResult, judge
from feeders.studies.calibrate.feeder import network
from feeders.studies.detectable import detectable
from feeders.studies.protect import protect
from feeders.studies.redundancy import redundancy
from gridsec.errors import FeederInvalid
from gridsec.grid.meshed import MeshedFeeder, PhasedMesh
from gridsec.grid.phased import PhasedFeeder
from tests.codes import refused
from tests.feeders import asymmetric, villages
from tests.feeders.watched import names_the_liar_alone


def zero(rows: tuple[LineRow, ...], ratio: float = 3.0) -> tuple[LineRow, ...]:
    """The same lines with a zero sequence."""
    return tuple(replace(row, r0_ohm=ratio * row.r_ohm, x0_ohm=ratio * row.x_ohm) for row in rows)


def dealt() -> FeederTables:
    """The village with its tie closed, a third of each load in one phase, some customers in all."""
    tables = closed(villages.tables())
    rows = tuple(
        replace(row, phases=("a", "b", "c", "abc")[k % 4], load_kw=row.load_kw / 3, pv_kw=row.pv_kw / 3)
        for k, row in enumerate(tables.customers)
    )
    return replace(tables, lines=zero(tables.lines), customers=rows)


@cache
def village() -> Site:
    return from_tables(dealt())


@cache
def ring() -> Site:
    """The ring of thirteen houses, one phase each, a third of the power."""
    tables = landnetz().tables
    rows = tuple(
        replace(
            row,
            phases="abc"[k % 3],
            load_kw=row.load_kw / 3,
            pv_kw=row.pv_kw / 3,
            inverter_kva=row.inverter_kva / 3,
        )
        for k, row in enumerate(tables.customers)
    )
    return from_tables(replace(tables, lines=zero(tables.lines), customers=rows))


def mesh(site: Site) -> PhasedMesh:
    assert isinstance(site.feeder, PhasedMesh)
    return site.feeder


# --- files --------------------------------------------------------------------------------------


def test_without_the_option_a_loop_is_an_error() -> None:
    tables = european().tables
    radial = replace(tables, meta=replace(tables.meta, meshed=False))
    (problem,) = validate(radial)
    assert problem.startswith("lines: ring, ")
    assert problem.code == "not-radial"
    with refused(FeederInvalid, "not-radial"):
        from_tables(radial)


def test_the_folder_is_read_as_written(tmp_path: object) -> None:
    tables = dealt()
    write(tables, tmp_path)  # type: ignore[arg-type]
    assert read(tmp_path) == tables  # type: ignore[arg-type]
    found = examine(tables)
    assert found.problems == ()
    assert any("form a loop; 'tie' is drawn as a tie" in note for note in found.notes)


def test_the_site_has_its_ties_and_a_tree() -> None:
    site = village()
    feeder, radial = mesh(site), villages.village().balanced
    assert [[feeder.tree.buses[k] for k in pair] for pair in site.ties] == [["n3", "n6"]]
    assert site.spanning is feeder.tree
    np.testing.assert_array_equal(feeder.tree.parent, radial.parent)
    z_base = 3.0 * 230.0**2 / (100.0 * 1000.0)
    np.testing.assert_allclose(feeder.z[0].diagonal(), (0.02 + 0.01j) * 5 / 3 / z_base, rtol=1e-12)
    np.testing.assert_allclose(feeder.z[0, 0, 1], (0.02 + 0.01j) * 2 / 3 / z_base, rtol=1e-12)
    assert feeder.phases.all()
    assert len(feeder.customers) == len(villages.tables().customers) + 2 * 2


def test_the_tree_is_of_the_lines_with_the_most_phases() -> None:
    """A line of one phase that comes first in the file is the tie all the same."""
    tables = dealt()
    first = LineRow("thin", "n1", "n6", 0.2, 0.1, phases="b")
    rows = (first, *(row for row in tables.lines if row.line != "tie"))
    site = from_tables(replace(tables, lines=rows))
    assert [[site.spanning.buses[k] for k in pair] for pair in site.ties] == [["n1", "n6"]]
    np.testing.assert_array_equal(mesh(site).phases, [[False, True, False]])
    assert site.spanning.phases.all()  # type: ignore[union-attr]
    assert any("'thin' is drawn as a tie" in note for note in examine(site.tables).notes)


def test_phases_that_only_a_tie_brings_are_refused() -> None:
    tables = dealt()
    parts = tuple(LineRow(f"far {phase}", "n6", "n7", 0.1, 0.05, phases=phase) for phase in "ab")
    with refused(FeederInvalid, "absent-phase") as caught:
        from_tables(replace(tables, lines=(*tables.lines, *parts)))
    assert "line 'far b' closes a loop and brings phase 'b' to 'n7'" in str(caught.value)
    matrix = {f"{s}_{p}_ohm": v for p in ("aa", "bb") for s, v in (("r", 0.1), ("x", 0.05))}
    one = LineRow("far", "n6", "n7", 0.1, 0.05, phases="ab", **matrix, r_ab_ohm=0.0, x_ab_ohm=0.0)
    assert from_tables(replace(tables, lines=(*tables.lines, one))).ties.shape == (1, 2)


def test_the_model_of_customers_in_several_phases_is_radial() -> None:
    with refused(FeederInvalid, "not-radial"):
        three_phase(dealt())


def test_a_tie_that_hardly_conducts_is_none() -> None:
    tables = dealt()
    tables = replace(tables, meta=replace(tables.meta, accept=("impedance",)))
    far = tuple(
        replace(row, r_ohm=3e5, x_ohm=3e5, r0_ohm=9e5, x0_ohm=9e5) if row.line == "tie" else row
        for row in tables.lines
    )
    open_ = tuple(replace(row, closed=row.line != "tie") for row in tables.lines)
    one, other = (from_tables(replace(tables, lines=lines)) for lines in (far, open_))
    assert isinstance(other.feeder, PhasedFeeder)
    for name in ("R", "X"):
        there = getattr(mesh(one), name), getattr(other.feeder, name)
        np.testing.assert_allclose(*there, rtol=0, atol=2e-6)
    p = -one.loads.load_peak
    voltages = [site.feeder.bus_voltages(p, 0.3 * p, 1.0, steps=40) for site in (one, other)]
    np.testing.assert_allclose(*voltages, rtol=0, atol=1e-6)


def test_customers_of_three_phases_alone_are_the_balanced_mesh() -> None:
    """All of them, and one of a single phase that draws nothing, which makes it one of three phases."""
    tables = closed(villages.tables())
    extra = replace(tables.customers[0], customer="idle", meter="", phases="a", load_kw=0.1)
    rows = tuple(replace(row, phases="abc") for row in tables.customers)
    three = from_tables(replace(tables, lines=zero(tables.lines), customers=(*rows, extra)))
    balanced = from_tables(tables)
    assert isinstance(balanced.feeder, MeshedFeeder)
    p, q = np.random.default_rng(3).uniform(-0.2, 0.1, (2, len(rows)))
    split = [np.append(np.repeat(each / 3.0, 3), 0.0) for each in (p, q)]
    for steps in (0, 1, 3):
        one = balanced.feeder.bus_voltages(p, q, 1.02, steps=steps)
        found = three.feeder.bus_voltages(*split, 1.02, steps=steps)
        np.testing.assert_allclose(found, np.repeat(one, 3), rtol=0, atol=1e-12)
    base = balanced.feeder.base_kva
    flows = [power_flow(site) for site in (balanced, three)]
    (_, truth), (_, phased) = (
        flow.solve(-base * each[0], -base * each[1], 230.0)
        for flow, each in zip(flows, ((p, q), split), strict=True)
    )
    np.testing.assert_allclose(phased, np.repeat(truth, 3), rtol=0, atol=1e-6)


# --- the model against the power flow -----------------------------------------------------------


@pytest.mark.canary("village")
@pytest.mark.parametrize("make", [european, ring, village])
@given(seed=st.integers(0, 1000), load=st.sampled_from([0.1, 0.5, 1.0]))
@settings(max_examples=6, deadline=None)
def test_the_power_flow_is_within_the_bound(make: Callable[[], Site], seed: int, load: float) -> None:
    site = make()
    feeder, rng, flow = mesh(site), np.random.default_rng(seed), power_flow(site)
    assert isinstance(flow, PlacesFlow)
    p_kw = load * site.loads.load_peak * feeder.base_kva * rng.uniform(-0.5, 1.0, feeder.bus.size)
    q_kvar = 0.4 * p_kw * rng.uniform(-1.0, 1.0, feeder.bus.size)
    v0 = rng.uniform(0.97, 1.03, 3)
    customers, places = flow.solve(p_kw, q_kvar, v0 * feeder.base_volt)
    exact = (places / feeder.base_volt) ** 2
    p, q = -p_kw / feeder.base_kva, -q_kvar / feeder.base_kva
    found, bound = feeder.bus_voltages(p, q, v0**2), feeder.model_error_bound(p, q, v0**2)
    np.testing.assert_array_equal(places[feeder.bus], customers)
    assert (np.abs(found - exact)[feeder.bus] <= bound + 1e-9).all()
    assert bound.max() < 2e-3
    np.testing.assert_allclose(feeder.bus_voltages(p, q, v0**2, steps=40), exact, rtol=0, atol=1e-9)


@pytest.mark.acceptance
def test_the_european_feeder_with_a_ring() -> None:
    """At full load |v| is within 0.1 %; the matrices are the derivatives of the AC power flow."""
    site = european()
    feeder, peak = mesh(site), site.loads.load_peak
    base = feeder.base_kva
    truth, _ = power_flow(site).solve(peak * base, 0.33 * peak * base, feeder.base_volt)
    v = np.sqrt(feeder.bus_voltages(-peak, -0.33 * peak, 1.0)[feeder.bus])
    assert np.abs(v - truth / feeder.base_volt).max() < 1e-3
    radial = load("ieee-european-lv").feeder
    alone = np.sqrt(radial.bus_voltages(-peak, -0.33 * peak, 1.0)[feeder.bus])
    assert np.abs(alone - truth / feeder.base_volt).max() > 5e-3
    for part, most in ((0.0, 1e-6), (0.25, 0.02), (1.0, 0.1)):
        *linear, r, x = (float(cell.strip(" %")) / 100.0 for cell in sensitivity(site, part).split("|")[3:])
        assert max(linear) < most
        assert max(r, x) < 1e-4


@pytest.mark.parametrize("make", [european, ring])
def test_against_power_grid_model(make: Callable[[], Site]) -> None:
    site = make()
    rng, peak = np.random.default_rng(5), site.loads.load_peak * site.feeder.base_kva
    p, q = peak * rng.uniform(0.0, 1.0, (2, peak.size)) * [[1.0], [0.3]]
    base = site.feeder.base_volt
    _, places = power_flow(site).solve(p, q, 1.02 * base)
    expected = asymmetric.solve(site.tables, p, q, 1.02)
    for bus, k in site.bus_of_file.items():
        np.testing.assert_allclose(places.reshape(-1, 3)[k] / base, expected[bus], rtol=0, atol=1e-8)
    exact = site.feeder.bus_voltages(-p / site.feeder.base_kva, -q / site.feeder.base_kva, 1.02**2, steps=60)
    np.testing.assert_allclose((places / base) ** 2, exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("taps", [{"l1": 0.95}, {"l4": 1.04, "tie": 1 / 1.04}])
def test_taps_that_cancel_around_every_loop(taps: dict[str, float]) -> None:
    tables = dealt()
    lines = [replace(row, tap=taps.get(row.line, 1.0)) for row in tables.lines]
    site = from_tables(replace(tables, lines=tuple(lines)))
    assert np.unique(site.base_volt).size == 2
    base, feeder = site.feeder.base_kva, site.feeder
    p = -site.loads.load_peak
    _, places = power_flow(site).solve(-p * base, -0.3 * p * base, 233.0)
    found = feeder.bus_voltages(p, 0.3 * p, (233.0 / 230.0) ** 2, steps=40)
    np.testing.assert_allclose(found, (places / site.base_volt) ** 2, rtol=0, atol=1e-9)
    wrong = [replace(row, tap=1.05 if row.line == "l5" else 1.0) for row in tables.lines]
    with refused(FeederInvalid, "inconsistent") as caught:
        from_tables(replace(tables, lines=tuple(wrong)))
    assert "'tie'" in str(caught.value)


def test_a_tie_of_one_phase_asks_for_the_taps_of_that_phase_alone() -> None:
    tables = dealt()
    own = {
        "l5": {"tap_a": 1.0, "tap_b": 1.03, "tap_c": 1.01},
        "tie": {"phases": "a"},
    }
    lines = tuple(replace(row, **own.get(row.line, {})) for row in tables.lines)  # type: ignore[arg-type]
    site = from_tables(replace(tables, lines=lines))
    p = -site.loads.load_peak
    base = site.feeder.base_kva
    _, places = power_flow(site).solve(-p * base, -0.3 * p * base, 230.0)
    found = site.feeder.bus_voltages(p, 0.3 * p, 1.0, steps=40)
    np.testing.assert_allclose(found, (places / site.base_volt) ** 2, rtol=0, atol=1e-9)
    other = tuple(replace(row, phases="b") if row.line == "tie" else row for row in lines)
    with pytest.raises(FeederInvalid, match=r"'tie' closes a loop around which the taps multiply to 1\.03;"):
        from_tables(replace(tables, lines=other))


# --- watching -----------------------------------------------------------------------------------


def outcome(
    site: Site,
    lie: AttackSpec | None,
    seconds: float,
    meters: TrialMeterErrors = TrialMeterErrors.WHITE,
    estimator: str | None = None,
) -> TrialResult:
    kw = 0.6 if site is european() else 0.1
    trial = Trial(
        choose(site, estimator=estimator),
        2,
        10.0 + seconds,
        load_error=LoadError(kw, kw / 3.0),
        meters=meters,
        lie=lie,
    )
    return judge(design(trial.stated), trial, settling_s=3.0)


LIES = pytest.mark.parametrize(
    ("make", "count", "trick", "percent"),
    [
        (european, 6, AttackKind.BIAS, 3.0),
        (european, 6, AttackKind.TOGETHER, -2.0),
        (ring, 3, AttackKind.BIAS, 3.0),
    ],
)


@pytest.mark.canary("ring-3-bias-3.0")
@LIES
def test_the_default_names_a_liar_and_nobody_else(
    make: Callable[[], Site], count: int, trick: AttackKind, percent: float
) -> None:
    """One at least, of all in the first case: false busbar voltages with other meters explain the others.

    All meters of a phase together have no other reference than the busbar's meter.
    """
    found = outcome(make(), AttackSpec(trick, count, percent, onset_s=10.0), 6.0, estimator=MODAL)
    assert found.liars.size == count
    assert found.delay_s.min() <= 3.0
    assert not found.clean_while_lying.any()
    assert not found.accused.any()
    assert not found.accused_inverters.any()
    assert np.percentile(found.error_all, 95) < 0.3


@pytest.mark.canary("real")
@pytest.mark.parametrize("meters", [TrialMeterErrors.WHITE, TrialMeterErrors.REAL])
def test_clean_is_clean(meters: TrialMeterErrors) -> None:
    found = outcome(european(), None, 10.0, meters)
    assert not found.accused.any()
    assert not found.accused_inverters.any()
    assert not found.undecided[15:].any()


@pytest.mark.canary("partial-observers")
@pytest.mark.parametrize(
    "name", ["exact-bank", "windowed-bank", "set-search", "partial-observers", "unknown-input"]
)
def test_the_methods_of_the_papers_name_the_liar_alone(name: str) -> None:
    names_the_liar_alone(choose(ring(), estimator=name, max_attacked=1))


def test_studies_take_lines_in_parallel_as_one() -> None:
    """Every line twice is one of half the impedance."""
    tables = dealt()
    radial = tuple(replace(row, closed=row.line != "tie") for row in tables.lines)
    again = tuple(replace(row, line=f"{row.line} again") for row in radial)
    half = tuple(
        replace(
            row,
            r_ohm=0.5 * row.r_ohm,
            x_ohm=0.5 * row.x_ohm,
            r0_ohm=1.5 * row.r_ohm,
            x0_ohm=1.5 * row.x_ohm,
            b_us=2.0 * row.b_us,
        )
        for row in radial
    )
    sites = [from_tables(replace(tables, lines=lines)) for lines in ((*radial, *again), half)]
    assert [len(site.ties) for site in sites] == [5, 0]
    found = [detectable(site, max_attacked=1).tables["meters"].select_dtypes("number") for site in sites]
    np.testing.assert_allclose(*found, rtol=1e-3)
    twice, once = (redundancy(site).tables for site in sites)
    for table in ("summary", "meters"):
        assert twice[table].select_dtypes("number").equals(once[table].select_dtypes("number"))
    chosen = [protect(site, max_attacked=5, exact=False).tables for site in sites]
    assert chosen[0]["meters"]["meter"].size > 0
    for table in ("summary", "meters"):
        assert chosen[0][table].equals(chosen[1][table])


@pytest.mark.parametrize(
    "study",
    [lambda site: network(site.tables), lambda site: site.tree, lambda site: site.balanced],
    ids=["calibrate", "tree", "balanced"],
)
def test_what_takes_radial_feeders_says_so(study: Callable[[Site], object]) -> None:
    with refused(FeederInvalid, "not-radial"):
        study(ring())

"""Feeders with closed ties: from the files, against the AC power flow, watched by the default estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from benchmarks.mesh import baran_wu, closed, landnetz, rural3
from feeders.format.tables import LineRow, examine, read, validate, write
from feeders.model.site import Site, from_tables, load
from feeders.registry import MODAL, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.powerflow import PowerFlow, power_flow
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, TrialResult, judge
from feeders.studies.detectable import detectable
from feeders.studies.redundancy import redundancy
from gridsec.errors import FeederInvalid
from gridsec.grid.meshed import MeshedFeeder
from tests.codes import refused
from tests.feeders import villages
from tests.feeders.watched import names_the_liar_alone

SITES = [landnetz, rural3, baran_wu]


def ties(site: Site) -> MeshedFeeder:
    assert isinstance(site.feeder, MeshedFeeder)
    return site.feeder


# --- files --------------------------------------------------------------------------------------


def test_a_loop_is_an_error_that_says_which_option_takes_it() -> None:
    tables = closed(villages.tables())
    (problem,) = validate(replace(tables, meta=replace(tables.meta, meshed=False)))
    assert "tie, " in problem
    assert problem.code == "not-radial"


def test_with_the_option_a_loop_is_a_note(tmp_path: Path) -> None:
    tables = closed(villages.tables())
    found = examine(tables)
    assert found.problems == ()
    assert any("form a loop; 'tie' is drawn as a tie" in note for note in found.notes)
    write(tables, tmp_path)
    assert "meshed = true" in (tmp_path / "feeder.toml").read_text()
    assert read(tmp_path) == tables
    write(villages.tables(), tmp_path)
    assert "meshed" not in (tmp_path / "feeder.toml").read_text()


def test_the_option_changes_nothing_where_there_is_no_loop() -> None:
    tables = villages.tables()
    one, other = (from_tables(replace(tables, meta=replace(tables.meta, meshed=m))) for m in (False, True))
    assert type(other.feeder) is type(one.feeder)
    np.testing.assert_array_equal(one.balanced.r, other.balanced.r)


def test_the_last_line_of_a_loop_is_its_tie() -> None:
    tables = closed(villages.tables())
    site = from_tables(tables)
    feeder, radial = ties(site), villages.village().balanced
    assert [[feeder.buses[k] for k in pair] for pair in feeder.ends] == [["n3", "n6"]]
    np.testing.assert_array_equal(feeder.tree.parent, radial.parent)
    np.testing.assert_array_equal(feeder.tree.r, radial.r)
    assert feeder.r[0] == pytest.approx(0.02 * 100.0 * 1000.0 / (3.0 * 230.0**2))
    assert site.spanning is feeder.tree
    turned = from_tables(replace(tables, lines=tables.lines[::-1]))
    assert ties(turned).ends.tolist() != feeder.ends.tolist()
    here, there = feeder.X[feeder.bus], ties(turned).X[turned.feeder.bus]
    np.testing.assert_allclose(here, there, rtol=0, atol=1e-15)


def test_a_line_between_two_names_of_one_bus_stays_an_error() -> None:
    tables = villages.tables()
    shorted = closed(tables, LineRow("short", "n2", "n2b", 0.1, 0.1))
    (problem,) = validate(shorted)
    assert (problem.code, problem.startswith("lines: short is ")) == ("self-loop", True)


# --- the model against the power flow -----------------------------------------------------------


@pytest.mark.parametrize("taps", [{"l1": 0.95}, {"l2": 0.95, "tie": 1 / 0.95}, {"l4": 1.04, "tie": 1 / 1.04}])
def test_taps_that_cancel_around_every_loop(taps: dict[str, float]) -> None:
    """A regulator before the loop, one in each of two branches that meet again, and one given from afar."""
    tables = closed(villages.tables())
    lines = [replace(row, tap=taps.get(row.line, 1.0)) for row in tables.lines]
    site = from_tables(replace(tables, lines=tuple(lines)))
    assert np.unique(site.base_volt).size == 2
    rng, base, feeder = np.random.default_rng(1), site.feeder.base_kva, site.feeder
    p_kw, q_kvar = site.loads.load_peak * base * rng.uniform(-0.5, 1.0, (2, feeder.bus.size))
    _, buses = power_flow(site).solve(p_kw, q_kvar, 233.0)
    p, q, v0 = -p_kw / base, -q_kvar / base, (233.0 / 230.0) ** 2
    exact = (buses / site.base_volt) ** 2
    found, bound = feeder.bus_voltages(p, q, v0), feeder.model_error_bound(p, q, v0)
    assert (np.abs(found - exact)[feeder.bus] <= bound + 1e-9).all()
    np.testing.assert_allclose(feeder.bus_voltages(p, q, v0, steps=30), exact, rtol=0, atol=1e-8)


@pytest.mark.parametrize("make", [*SITES, lambda: from_tables(closed(villages.tables()))])
@given(seed=st.integers(0, 1000), load=st.sampled_from([0.1, 0.5, 1.0]))
@settings(max_examples=6, deadline=None)
def test_the_power_flow_is_within_the_bound(make: Callable[[], Site], seed: int, load: float) -> None:
    site = make()
    feeder, rng, flow = site.feeder, np.random.default_rng(seed), power_flow(site)
    assert isinstance(flow, PowerFlow)
    p_kw = load * site.loads.load_peak * feeder.base_kva * rng.uniform(-0.5, 1.0, feeder.bus.size)
    q_kvar = 0.4 * p_kw * rng.uniform(-1.0, 1.0, feeder.bus.size)
    v0 = rng.uniform(0.95, 1.05)
    customers, buses = flow.solve(p_kw, q_kvar, v0 * feeder.base_volt)
    exact = (buses / feeder.base_volt) ** 2
    p, q = -p_kw / feeder.base_kva, -q_kvar / feeder.base_kva
    found, bound = feeder.bus_voltages(p, q, v0**2), feeder.model_error_bound(p, q, v0**2)
    np.testing.assert_array_equal(buses[feeder.bus], customers)
    assert (np.abs(found - exact)[feeder.bus] <= bound + 1e-9).all()
    assert bound.max() < 1e-3
    linear = feeder.bus_voltages(p, q, v0**2, steps=0)
    assert np.abs(linear - exact).max() < 3e-3


def test_a_tie_that_the_model_does_not_know_makes_honest_meters_look_wrong() -> None:
    """What the option is for: closed in the street and open in the files is 5 % of the voltage here."""
    site, radial = baran_wu(), load("case33bw")
    p_kw = site.loads.load_peak * site.feeder.base_kva
    truth, _ = power_flow(site).solve(p_kw, 0.4 * p_kw, site.feeder.base_volt)
    p = -p_kw / site.feeder.base_kva
    off = {}
    for name, feeder in (("meshed", site.feeder), ("radial", radial.feeder)):
        v = np.sqrt(feeder.bus_voltages(p, 0.4 * p, 1.0)[feeder.bus])
        off[name] = np.abs(v - truth / site.feeder.base_volt).max()
    assert off["meshed"] < 1e-4
    assert off["radial"] > 0.02


# --- watching -----------------------------------------------------------------------------------


def outcome(
    site: Site, lie: AttackSpec | None, seconds: float, meters: TrialMeterErrors = TrialMeterErrors.WHITE
) -> TrialResult:
    kw = 2.0 if site.feeder.name == "case33bw" else 0.3
    trial = Trial(site, 2, 10.0 + seconds, load_error=LoadError(kw, kw / 3.0), meters=meters, lie=lie)
    return judge(design(trial.stated), trial, settling_s=3.0)


@pytest.mark.canary("landnetz-together--2.0")
@pytest.mark.parametrize(
    ("make", "trick", "percent"),
    [
        (landnetz, AttackKind.BIAS, 3.0),
        (landnetz, AttackKind.TOGETHER, -2.0),
        (rural3, AttackKind.TOGETHER, -2.0),
        (baran_wu, AttackKind.BIAS, 3.0),
        (baran_wu, AttackKind.TOGETHER, -2.0),
    ],
)
def test_a_third_of_the_meters_lies_and_nobody_else_is_named(
    make: Callable[[], Site], trick: AttackKind, percent: float
) -> None:
    site = make()
    found = outcome(site, AttackSpec(trick, site.meters.size // 3, percent, onset_s=10.0), 6.0)
    assert found.liars.size == site.meters.size // 3
    assert found.delay_s.max() <= 3.0
    assert not found.accused.any()
    assert not found.accused_inverters.any()
    assert np.percentile(found.error_all, 95) < 0.1


def test_the_transient_of_the_observer_counts_by_the_noise_of_the_meters() -> None:
    """White meters have nearly no accuracy class: `modal` settles where a reading would stand out."""
    found = outcome(choose(landnetz(), estimator=MODAL), None, 15.0, TrialMeterErrors.WHITE)
    assert not found.undecided[15:].any()
    assert not found.accused.any()


@pytest.mark.canary("landnetz-white")
@pytest.mark.parametrize(
    ("make", "meters"),
    [
        (landnetz, TrialMeterErrors.WHITE),
        (landnetz, TrialMeterErrors.REAL),
        (rural3, TrialMeterErrors.REAL),
        (baran_wu, TrialMeterErrors.REAL),
    ],
)
def test_clean_is_clean(make: Callable[[], Site], meters: TrialMeterErrors) -> None:
    found = outcome(make(), None, 15.0, meters)
    assert not found.accused.any()
    assert not found.accused_inverters.any()
    assert not found.undecided[15:].any()


def test_two_lines_in_parallel_are_watched_and_studied_as_one_of_half_the_impedance() -> None:
    radial = villages.tables()
    again = tuple(replace(row, line=f"{row.line} again") for row in radial.lines)
    half = tuple(
        replace(row, r_ohm=0.5 * row.r_ohm, x_ohm=0.5 * row.x_ohm, b_us=2.0 * row.b_us)
        for row in radial.lines
    )
    meshed = replace(radial, lines=(*radial.lines, *again), meta=replace(radial.meta, meshed=True))
    twice, once = from_tables(meshed), from_tables(replace(radial, lines=half))
    assert len(twice.ties) == 5
    lie = AttackSpec(AttackKind.BIAS, 2, 1.5, onset_s=10.0)
    runs = [outcome(site, lie, 20.0) for site in (twice, once)]
    np.testing.assert_array_equal(runs[0].delay_s, runs[1].delay_s)
    np.testing.assert_allclose(runs[0].error_all, runs[1].error_all, rtol=0, atol=1e-3)
    studies = [
        detectable(site, max_attacked=1).tables["meters"].select_dtypes("number") for site in (twice, once)
    ]
    np.testing.assert_allclose(*studies, rtol=1e-3)
    found, other = (redundancy(site, silent=["m-c3", "m-c8"]).tables for site in (twice, once))
    for name in ("summary", "meters", "parts", "changes"):
        assert (
            found[name]
            .drop(columns="note", errors="ignore")
            .equals(other[name].drop(columns="note", errors="ignore"))
        )


@pytest.mark.canary("partial-observers")
@pytest.mark.parametrize(
    "name", ["exact-bank", "windowed-bank", "set-search", "partial-observers", "unknown-input"]
)
def test_the_methods_of_the_papers_name_the_liar_alone(name: str) -> None:
    names_the_liar_alone(choose(landnetz(), estimator=name, max_attacked=1))


@pytest.mark.parametrize("part", [lambda site: site.tree, lambda site: site.balanced])
def test_what_takes_radial_feeders_says_so(part: Callable[[Site], object]) -> None:
    with refused(FeederInvalid, "not-radial"):
        part(landnetz())

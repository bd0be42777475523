"""OpenDSS master files: against OpenDSS's own power flow, and nothing dropped in silence."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from feeders.convert.convert import check_against_source, convert
from feeders.convert.provenance import BusbarUnclear, SourceUnreadable
from feeders.convert.round_trip import BALANCED_PU, UNBALANCED_PU
from feeders.format.tables import examine, read, write
from feeders.model.site import from_tables, load
from feeders.registry import design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.trial import LoadError, Trial, judge
from feeders.simulation.trial import TrialMeterErrors as Quality
from gridsec.errors import FeederInvalid, GridsecError
from tests.codes import refused
from tests.feeders.foreign import opendss
from tests.feeders.thirteen import thirteen

pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")

HEAD = """
clear
new circuit.x basekv=11 pu=1.02 mvasc3=100 mvasc1=100 bus1=Grid
new transformer.t windings=2 buses=(Grid,Board) conns=(delta,wye) kvs=(11,0.4) kvas=(800,800) xhl=4
new linecode.lc nphases=3 r1=0.4 x1=0.1 r0=1.6 x0=0.4 c1=250 c0=250 units=km
new line.main bus1=Board bus2=B1 linecode=lc length=200 units=m normamps=150
new load.shop bus1=B1 phases=3 kv=0.4 kw=15 pf=0.95
"""
TAIL = """
set voltagebases=[11,0.4,0.2]
calcvoltagebases
solve
"""


def master(folder: Path, body: str, *, tail: str = TAIL) -> str:
    path = folder / "master.dss"
    path.write_text(HEAD + body + tail)
    return str(path)


@pytest.mark.parametrize(("buses", "balanced"), [(40, True), (40, False)])
def test_voltages_are_opendss_own(buses: int, balanced: bool, tmp_path: Path) -> None:
    source = opendss(tmp_path / "town.dss", buses, balanced=balanced)
    done = convert(str(source), tmp_path / "town")
    assert done.check is not None
    assert done.check.buses == buses
    assert done.check.three_phase is not balanced
    assert done.check.largest_pu < (BALANCED_PU if balanced else UNBALANCED_PU)
    assert {each.done for each in done.changes} == {"left out"}


@pytest.mark.canary("True-False")
@pytest.mark.parametrize(("balanced", "poles"), [(True, False), (False, False), (False, True)])
def test_large_networks(balanced: bool, poles: bool, tmp_path: Path) -> None:
    source = opendss(tmp_path / "city.dss", 600, balanced=balanced, poles=poles)
    done = convert(str(source), tmp_path / "city")
    assert done.check is not None
    assert done.check.buses == 600
    assert done.check.largest_pu < (BALANCED_PU if balanced else UNBALANCED_PU)
    bare = sum(row.r_aa_ohm is not None for row in read(tmp_path / "city").lines)
    assert (bare > 50) == poles


def test_everything_is_carried_over_or_named(tmp_path: Path) -> None:
    source = master(
        tmp_path,
        """
new line.twin bus1=Board bus2=B1 linecode=lc length=300 units=m
new line.spur bus1=B1.2 bus2=B2.2 phases=1 r1=0.5 x1=0.1 r0=0.5 x0=0.1 c1=0 c0=0 length=0.1
new line.pair bus1=B1.3.1 bus2=B3.3.1 phases=2 rmatrix=(.3|.1 .3) xmatrix=(.4|.2 .4) cmatrix=(0|0 0) length=.1
new line.coupler bus1=B1 bus2=B4 switch=yes c1=0 c0=0
new line.tie bus1=B4 bus2=B3 phases=3 r1=0.1 x1=0.1 r0=0.1 x0=0.1 c1=0 c0=0 length=1
open line.tie 1
open line.tie 2
new line.gone bus1=B4 bus2=B1 r1=0.1 x1=0.1 length=1 enabled=no
new loadshape.evening npts=3 interval=8 mult=(0.2 0.4 1.0)
new load.home bus1=B2.2 phases=1 kv=0.231 kw=5 pf=0.95 daily=evening
new load.lamp bus1=B3.3 phases=1 kv=0.231 kw=4 pf=0.95 model=2
new load.welder bus1=B3.1.3 phases=1 kv=0.4 kw=6 pf=0.95
new capacitor.bank bus1=B1 phases=3 kv=0.4 kvar=20
new capacitor.small bus1=B3.1 phases=1 kv=0.231 kvar=3
new reactor.coil bus1=B4 phases=3 kv=0.4 kvar=0.001
new pvsystem.roof bus1=B4 phases=3 kv=0.4 kva=8 pmpp=6 irradiance=0.9
new transformer.low windings=2 buses=(B4,C1) conns=(delta,wye) kvs=(0.4,0.208) kvas=(80,80) xhl=4
new load.hut bus1=C1 phases=3 kv=0.208 kw=9 pf=0.9
new capcontrol.auto element=line.main capacitor=bank type=voltage onsetting=1 offsetting=500 ptratio=1
new energymeter.m element=line.main
""",
    )
    done = convert(source, tmp_path / "x")
    assert done.check is not None
    # All that is approximated is exact at the source's own loads but the coil of 1 var.
    assert done.check.largest_pu < UNBALANCED_PU
    assert done.check.as_found_pu is not None
    assert done.check.as_found_pu > UNBALANCED_PU
    tables = read(tmp_path / "x")
    lines = {line.line: line for line in tables.lines}
    main = lines["main"]
    # 200 m beside 300 m: 120 m of each.
    found = [main.r_ohm, main.x_ohm, main.r0_ohm, main.x0_ohm]
    np.testing.assert_allclose(found, [0.048, 0.012, 0.192, 0.048])
    assert main.b_us == pytest.approx(2e-3 * np.pi * 60.0 * 250 * 0.5)
    assert (lines["spur"].phases, lines["spur"].r_ohm) == ("b", pytest.approx(0.05))
    assert (lines["pair"].r_ohm, lines["pair"].x0_ohm) == (pytest.approx(0.02), pytest.approx(0.08))
    assert lines["pair"].phases == "ca"
    assert lines["tie"].closed is False
    assert lines["tie"].r_ohm == pytest.approx(0.1)
    assert "gone" not in lines
    customers = {row.customer: row for row in tables.customers}
    assert (customers["home"].phases, customers["home"].load_kw) == ("b", pytest.approx(5.0))
    assert (customers["roof"].pv_kw, customers["roof"].inverter_kva) == (6.0, 8.0)
    # Its delta draws unevenly from uneven voltages.
    behind = sum(customers[f"transformer low-{phase}"].load_kw for phase in "abc")
    assert behind == pytest.approx(9.0, rel=0.05)
    assert {"welder-a", "welder-c"} <= set(customers)
    said = "\n".join(done.notes)
    for part in (
        "left out: line gone; disabled in the source",
        "model 2 of load lamp; depends on the voltage",
        "delta of load welder",
        "load shape evening of load home",
        "capacitor bank",
        "capacitor small",
        "left out: reactor coil",
        "lines main + twin; in parallel",
        "load side of transformer low; 1 bus became a customer",
        "droop curve of generator roof",
        "irradiance 0.9 of pvsystem roof; feeds in 5.4 kW at this moment",
        "energymeter m; every customer has a meter",
        "left out: capcontrol auto; switched as",
        "left out: 2 buses",
    ):
        assert part in said, part
    table = (tmp_path / "x" / "conversion.csv").read_text().splitlines()
    assert table[0] == "element,property,done,effect"
    assert len(table) == len(done.changes) + 1
    source_md = " ".join((tmp_path / "x" / "SOURCE.md").read_text().split())
    assert all(note in source_md for note in done.notes)
    assert done.check.sentence in source_md


def test_lines_that_are_not_transposed(tmp_path: Path) -> None:
    """Poles, matrices, two phases, charging from phase to phase: nothing of it is approximated."""
    source = master(
        tmp_path,
        """
new wiredata.al rac=0.3 runits=km gmrac=6 gmrunits=mm radius=8 radunits=mm
new linegeometry.pole nconds=4 nphases=3 reduce=yes
~ cond=1 wire=al x=-0.6 h=8.5 units=m
~ cond=2 wire=al x=-0.1 h=8.5 units=m
~ cond=3 wire=al x=0.6 h=8.5 units=m
~ cond=4 wire=al x=0.0 h=7.3 units=m
new line.poles bus1=B1 bus2=B2 geometry=pole length=400 units=m
new line.turned bus1=B2.2.3.1 bus2=B3.2.3.1 geometry=pole length=200 units=m
new line.bare bus1=B2 bus2=B4 phases=3 rmatrix=(.4|.1 .5|.1 .2 .4) xmatrix=(.6|.2 .7|.3 .2 .6)
~ cmatrix=(300|-20 300|-60 -20 250) length=0.2
new line.two bus1=B4.3.2 bus2=B5.3.2 phases=2 rmatrix=(.4|.1 .5) xmatrix=(.6|.2 .7) cmatrix=(9|-1 8) length=.2
new line.one bus1=B4.1 bus2=B5.1 phases=1 r1=0.5 x1=0.1 r0=0.5 x0=0.1 c1=0 c0=0 length=0.1
new line.lower bus1=B3 bus2=B6 phases=3 r1=0.5 x1=0.2 r0=1 x0=0.5 c1=40 c0=15 length=0.3
new capacitor.star bus1=B3.2.1 phases=2 kv=0.231 kvar=4
new capacitor.delta bus1=B4 phases=3 kv=0.4 kvar=10 conn=delta
new capacitor.across bus1=B5.3.2 phases=1 kv=0.4 kvar=3 conn=delta
new capacitor.ends bus1=B5.3 bus2=B5.2 phases=1 kv=0.4 kvar=1
new capacitor.round bus1=B4.1.2.3 bus2=B4.2.3.1 phases=3 kv=0.6928203 kvar=3
new load.mill bus1=B6 phases=3 kv=0.4 kw=8 pf=0.95 vminpu=0.5
new load.home bus1=B5.3 phases=1 kv=0.231 kw=6 pf=0.95 vminpu=0.5
new load.hut bus1=B5.1 phases=1 kv=0.231 kw=3 pf=0.9
new load.shed bus1=B3.2 phases=1 kv=0.231 kw=5 pf=1
""",
    )
    done = convert(source, tmp_path / "x")
    assert done.check is not None
    assert done.check.largest_pu < 1e-8
    assert [each for each in done.changes if each.done == "approximated"] == []
    rows = {row.line: row for row in read(tmp_path / "x").lines}
    assert (rows["bare"].r_bb_ohm, rows["bare"].x_ac_ohm) == (pytest.approx(0.1), pytest.approx(0.06))
    assert rows["bare"].r_ohm == pytest.approx(0.2 * (1.3 - 0.4) / 3)
    assert rows["bare"].b_ac_us == pytest.approx(-2e-3 * np.pi * 60 * 60 * 0.2)
    # One row for the two sides of the street, of all phases.
    assert (rows["two"].phases, rows["two"].r_ab_ohm) == ("abc", 0.0)
    assert (rows["two"].r_bc_ohm, rows["two"].r_cc_ohm) == (pytest.approx(0.02), pytest.approx(0.08))
    assert rows["lower"].r0_ohm == pytest.approx(0.3)
    assert rows["lower"].b_ab_us == pytest.approx(-2e-3 * np.pi * 60 * 25 * 0.3 / 3)
    assert (rows["capacitor.star"].phases, rows["capacitor.star"].b_ab_us) == ("ab", None)
    for across, kvar in ((rows["capacitor.across"], 3), (rows["capacitor.ends"], 1)):
        assert (across.phases, across.b_bc_us) == ("bc", pytest.approx(-1e9 * kvar / 400.0**2))
    assert rows["capacitor.round"].b_ab_us == pytest.approx(-1e9 / 400.0**2)
    assert examine(tmp_path / "x").problems == ()


def test_regulators_are_lines_with_the_taps_they_stand_at(tmp_path: Path) -> None:
    """One of three phases, one given from its far end, three of single phases under control."""
    source = master(
        tmp_path,
        """
new transformer.gang windings=2 phases=3 buses=(B1,B2) conns=(wye,wye) kvs=(.4,.4) kvas=(100,100)
~ xhl=1 %rs=(.2,.2) taps=(1,1.05)
new line.l2 bus1=B2 bus2=B3 linecode=lc length=150 units=m
new transformer.back windings=2 phases=3 buses=(B4,B3) conns=(wye,wye) kvs=(.4,.4) kvas=(100,100)
~ xhl=2 %rs=(.3,.3) taps=(0.975,1)
new line.l4 bus1=B4 bus2=B5 linecode=lc length=90 units=m
new transformer.ra windings=2 phases=1 buses=(B5.1,B6.1) kvs=(.231,.231) kvas=(50,50)
~ xhl=.1 %loadloss=.01
new transformer.rb windings=2 phases=1 buses=(B5.2,B6.2) kvs=(.231,.231) kvas=(50,50)
~ xhl=.1 %loadloss=.01
new transformer.rc windings=2 phases=1 buses=(B6.3,B5.3) kvs=(.231,.231) kvas=(50,50)
~ xhl=.1 %loadloss=.01 taps=(1.01,1)
new regcontrol.ca transformer=ra winding=2 vreg=118 band=1 ptratio=2
new regcontrol.cb transformer=rb winding=2 vreg=114 band=1 ptratio=2
new line.l6 bus1=B6 bus2=B7 phases=3 rmatrix=(.4|.1 .5|.1 .2 .4) xmatrix=(.6|.2 .7|.3 .2 .6)
~ cmatrix=(9|0 9|0 0 9) length=0.1
new load.mill bus1=B3 phases=3 kv=0.4 kw=20 pf=0.95 vminpu=0.5
new load.home bus1=B7.1 phases=1 kv=0.231 kw=6 pf=0.95 vminpu=0.5
new load.hut bus1=B7.2 phases=1 kv=0.231 kw=3 pf=0.9 vminpu=0.5
new load.shed bus1=B7.3 phases=1 kv=0.231 kw=1 pf=0.9 vminpu=0.5
""",
    )
    done = convert(source, tmp_path / "x")
    assert done.check is not None
    assert done.check.largest_pu < 1e-6
    assert [each for each in done.changes if each.done == "approximated"] == []
    tables = read(tmp_path / "x")
    rows = {row.line: row for row in tables.lines}
    gang, back, bank = rows["transformer.gang"], rows["transformer.back"], rows["transformer.ra"]
    assert (gang.from_bus, gang.tap) == ("b1", pytest.approx(1 / 1.05, rel=1e-6))
    assert gang.x_ohm == pytest.approx(0.01 * 0.4**2 * 1e3 / 100 * 1.05**2, rel=1e-5)
    assert (back.from_bus, back.tap) == ("b3", pytest.approx(1 / 0.975, rel=1e-6))
    assert bank.tap == 1.0
    assert bank.tap_a is not None
    assert bank.tap_b is not None
    assert len({bank.tap_a, bank.tap_b, bank.tap_c}) == 3
    assert bank.tap_a < 0.99  # its control has raised the voltage
    assert bank.tap_c == pytest.approx(1 / 1.01, rel=1e-6)
    said = "\n".join(done.notes)
    assert ("transformer gang", "tap", "changed") in {
        (each.element, each.prop, each.done) for each in done.changes
    }
    assert "left out: regcontrol ca, regcontrol cb" in said
    # Nothing of it is a customer, and the loader takes it.
    assert {row.customer for row in tables.customers} == {"shop", "mill", "home", "hut", "shed"}
    site = from_tables(tables)
    assert site.base_volt.max() / site.base_volt.min() > 1.05


@pytest.mark.parametrize("root", [None, "650"], ids=["behind-its-regulator", "with-its-regulator"])
def test_the_ieee_13_node_feeder(root: str | None, tmp_path: Path) -> None:
    (tmp_path / "thirteen.dss").write_text(thirteen())
    done = convert(str(tmp_path / "thirteen.dss"), tmp_path / "x", root=root)
    assert done.check is not None
    assert done.check.largest_pu < 1e-7
    approximated = {(each.element, each.prop) for each in done.changes if each.done == "approximated"}
    assert approximated == {(f"load l{k}", "delta") for k in (0, 5, 6)}  # exact at these loads
    tables = read(tmp_path / "x")
    assert sum(row.r_aa_ohm is not None or row.r_bb_ohm is not None for row in tables.lines) >= 7
    assert {row.phases for row in tables.lines} >= {"abc", "bc", "ca", "a", "c"}
    site = from_tables(tables)
    tapped = site.base_volt[3:6] / site.base_volt[:3]
    assert (tapped.min() > 1.02) == (root == "650")


@pytest.mark.parametrize(
    "lie", [None, AttackSpec(AttackKind.BIAS, 5, 3.0, onset_s=10.0)], ids=["nobody", "five"]
)
def test_the_ieee_13_node_feeder_is_watched(lie: AttackSpec | None, tmp_path: Path) -> None:
    """Five of sixteen meters lie, before and behind three different taps; nobody else is named."""
    (tmp_path / "thirteen.dss").write_text(thirteen())
    convert(str(tmp_path / "thirteen.dss"), tmp_path / "x", root="650")
    trial = Trial(
        load(tmp_path / "x"), 2, 22.0, load_error=LoadError(20.0, 7.0), meters=Quality.WHITE, lie=lie
    )
    found = judge(design(trial.stated), trial, settling_s=3.0)
    assert found.liars.size == (5 if lie else 0)
    assert (found.delay_s <= 3.0).all()
    assert not found.accused.any()
    assert np.percentile(found.error_all, 95) < 0.2


@pytest.mark.parametrize("percent", [0.0, 0.5])
def test_a_balanced_feeder_with_a_regulator_stays_balanced(percent: float, tmp_path: Path) -> None:
    source = master(
        tmp_path,
        f"""
new transformer.gang windings=2 phases=3 buses=(B1,B2) conns=(wye,wye) kvs=(.4,.4) kvas=(100,100)
~ xhl=1 %rs=(.2,.2) taps=(1,1.05)
new transformer.twin windings=2 phases=3 buses=(B2,B1) conns=(wye,wye) kvs=(.4,.4) kvas=(100,100)
~ xhl=1 %rs=(.2,.2) taps=(1.05,1) %noloadloss={percent}
new line.l2 bus1=B2 bus2=B3 linecode=lc length=150 units=m
new load.mill bus1=B3 phases=3 kv=0.4 kw=20 pf=0.95
""",
    )
    done = convert(source, tmp_path / "x")
    assert done.check is not None
    assert not done.check.three_phase
    assert done.check.largest_pu < BALANCED_PU
    said = "\n".join(done.notes)
    idle = {row.customer: row for row in read(tmp_path / "x").customers if not row.meter}
    assert list(idle) == (["transformer twin no-load"] if percent else [])
    assert all(row.load_kw == pytest.approx(0.5, rel=0.2) for row in idle.values())
    assert "side by side; one line transformer.gang" in said
    site = from_tables(read(tmp_path / "x"))
    assert site.base_volt[-1] == pytest.approx(site.base_volt[0] * 1.05, rel=1e-6)


def test_a_matrix_that_no_line_has_is_taken_as_transposed(tmp_path: Path) -> None:
    source = master(
        tmp_path,
        """
new line.odd bus1=B1 bus2=B2 phases=3 rmatrix=(.1|.2 .1|.2 .2 .5) xmatrix=(.6|.2 .7|.3 .2 .6)
~ cmatrix=(0|0 0|0 0 0) length=0.1
new load.home bus1=B2.1 phases=1 kv=0.231 kw=8 pf=0.95
""",
    )
    done = convert(source, tmp_path / "x")
    assert any(each.prop == "impedance matrix" and each.done == "approximated" for each in done.changes)
    assert done.check is not None
    assert not done.check.exact
    assert done.check.at == "b2"
    assert "(bus b2)" in done.check.sentence


def test_a_wrong_impedance_shows_in_the_check(tmp_path: Path) -> None:
    """A check that a wrong feeder passed would be none: 1 % of one line's resistance is seen."""
    source = master(tmp_path, "")
    done = convert(source, tmp_path / "x")
    assert done.check is not None
    assert done.check.exact
    tables = read(tmp_path / "x")
    (line,) = tables.lines
    write(replace(tables, lines=(replace(line, r_ohm=1.01 * line.r_ohm),)), tmp_path / "x")
    assert not check_against_source(source, tmp_path / "x").exact


def test_mesh_is_named_and_opened_when_asked(tmp_path: Path) -> None:
    body = """
new line.east bus1=B1 bus2=B2 linecode=lc length=100 units=m
new line.west bus1=B1 bus2=B3 linecode=lc length=100 units=m
new line.south bus1=B2 bus2=B3 linecode=lc length=100 units=m
new load.home bus1=B3 phases=3 kv=0.4 kw=8 pf=0.95
"""
    source = master(tmp_path, body)
    with refused(FeederInvalid, "not-radial") as caught:
        convert(source, tmp_path / "x")
    assert all(name in str(caught.value) for name in ("east", "west", "south"))
    assert not (tmp_path / "x").exists()
    done = convert(source, tmp_path / "x", opened=["south"])
    assert done.check is not None
    assert not done.check.exact  # the source still has it closed
    assert "line south" in "\n".join(done.notes)
    radial = master(tmp_path, body + "open line.south 1\nopen line.south 2\n")
    assert check_against_source(radial, tmp_path / "x").exact
    with refused(FeederInvalid, "unknown-name"):
        convert(source, tmp_path / "y", opened=["north"])


@pytest.mark.parametrize(
    ("body", "tail", "kind", "code"),
    [
        ("new nonsense.a b=1\n", TAIL, SourceUnreadable, "unreadable"),
        ("new line.l bus1=B1.1.2.3.4 bus2=B2.1.2.3.4 phases=4 r1=1\n", TAIL, FeederInvalid, "unsupported"),
        ("new line.l bus1=B1.1.2.3 bus2=B2.2.3.1 linecode=lc\n", TAIL, FeederInvalid, "unsupported"),
        ("new vsource.second bus1=B1 basekv=0.4\n", TAIL, BusbarUnclear, "busbar-unclear"),
        ("", "solve\n", FeederInvalid, "missing"),
    ],
)
def test_what_is_no_feeder_is_told(
    body: str, tail: str, kind: type[GridsecError], code: str, tmp_path: Path
) -> None:
    with refused(kind, code):
        convert(master(tmp_path, body, tail=tail), tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_without_a_solution_of_the_source_nothing_is_checked(tmp_path: Path) -> None:
    """OpenDSS lets a load beyond the line's capacity become an impedance; constant power has no solution."""
    done = convert(master(tmp_path, "new load.big bus1=B1 kv=0.4 kw=900 pf=1\n"), tmp_path / "x")
    assert done.check is None
    assert "does not converge" in done.unchecked
    assert "Not checked" in (tmp_path / "x" / "SOURCE.md").read_text()


def test_all_problems_at_once(tmp_path: Path) -> None:
    source = master(
        tmp_path,
        """
new line.turned bus1=B1.1.2.3 bus2=B2.2.3.1 linecode=lc length=1
new line.four bus1=B1.1.2.3.4 bus2=B3.1.2.3.4 phases=4 r1=1
new capacitor.series bus1=B1 bus2=B5 phases=3 kv=0.4 kvar=100
""",
    )
    with refused(FeederInvalid, *["unsupported"] * 3) as caught:
        convert(source, tmp_path / "x")
    said = str(caught.value)
    assert all(name in said for name in ("line turned", "line four", "capacitor series"))


def test_no_circuit_and_no_file(tmp_path: Path) -> None:
    (tmp_path / "empty.dss").write_text("clear\n")
    with refused(GridsecError, "unreadable"):
        convert(str(tmp_path / "empty.dss"), tmp_path / "x")
    with refused(GridsecError, "missing"):
        convert(str(tmp_path / "absent.dss"), tmp_path / "x")


def test_a_circuit_as_opendss_saves_it(tmp_path: Path) -> None:
    """It names its voltage bases there, and takes them only when it is told so."""
    from opendssdirect import dss

    engine = dss.NewContext()
    engine.Text.Command(f'redirect "{master(tmp_path, "")}"')
    engine.Text.Command(f'save circuit dir="{tmp_path / "saved"}"')
    engine.Basic.ClearAll()
    done = convert(str(tmp_path / "saved" / "Master.dss"), tmp_path / "x")
    assert done.check is not None
    assert done.check.exact
    assert read(tmp_path / "x").customers[0].load_kw == 15.0


def test_another_engine_and_the_folder_are_left_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenDSS is one global state: whoever uses it beside the conversion notices nothing."""
    from opendssdirect import dss

    dss.Text.Command("clear")
    dss.Text.Command("new circuit.mine basekv=1")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net").mkdir()
    source = master(tmp_path / "net", "", tail=TAIL + "export voltages\nshow voltages\n")
    before = set(os.listdir(tmp_path / "net"))
    capfd.readouterr()
    convert(source, tmp_path / "x")
    assert dss.Circuit.Name() == "mine"
    dss.Text.Command("clear")
    assert set(os.listdir(tmp_path / "net")) == before
    assert set(os.listdir(tmp_path)) == {"net", "x"}
    assert Path.cwd() == tmp_path
    assert capfd.readouterr() == ("", "")


def test_loads_beyond_their_limits_of_voltage_and_without_power_are_named(tmp_path: Path) -> None:
    source = master(
        tmp_path,
        """
new line.long bus1=B1 bus2=Far linecode=lc length=900 units=m
new load.mill bus1=Far phases=3 kv=0.4 kw=40 pf=0.95
new load.steady bus1=Far phases=3 kv=0.4 kw=5 pf=0.95 vminpu=0.5
new load.empty bus1=B1.2 phases=1 kv=0.231 kw=0 kvar=0
new pvsystem.dark bus1=B1.3 phases=1 kv=0.231 kva=5 pmpp=5 irradiance=0
""",
    )
    done = convert(source, tmp_path / "x")
    assert done.check is not None
    assert done.check.largest_pu < UNBALANCED_PU
    # The mill is an impedance below 95 % of its voltage: OpenDSS has higher voltages than the feeder.
    assert done.check.as_found_pu is not None
    assert done.check.as_found_pu > 1e-3
    said = [(each.element, each.prop, each.done) for each in done.changes]
    assert ("load mill", "vminpu, vmaxpu", "approximated") in said
    assert ("load empty", "all of it", "left out") in said
    assert ("pvsystem dark", "irradiance 0", "changed") in said
    assert not [each for each in said if "steady" in each[0] or "shop" in each[0]]
    customers = {row.customer: row for row in read(tmp_path / "x").customers}
    assert customers.keys() == {"shop", "mill", "steady", "dark"}
    # A plant is one by night too.
    assert (customers["dark"].phases, customers["dark"].pv_kw, customers["dark"].inverter_kva) == ("c", 5, 5)

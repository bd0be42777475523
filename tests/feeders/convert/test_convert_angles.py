"""Busbars whose phases are turned against each other otherwise than a feeder's, or that lack one."""

from __future__ import annotations

from pathlib import Path

import pytest

from feeders.convert.convert import Conversion, convert
from feeders.convert.provenance import CHANGES_FILE, ConversionChange

pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")

TOWN = """
clear
new circuit.x basekv=11 pu=1.02 mvasc3=100 mvasc1=100 bus1=Grid {sequence}
new transformer.t windings=2 buses=(Grid{order},Board) conns=(delta,wye) kvs=(11,0.4) kvas=(800,800) xhl=4
new linecode.lc nphases=3 r1=0.4 x1=0.1 r0=1.6 x0=0.4 c1=0 c0=0 units=km
new line.main bus1=Board bus2=B1 linecode=lc length=400 units=m
new line.pair bus1=B1.1.2 bus2=B2.1.2 phases=2 rmatrix=(.3|.1 .3) xmatrix=(.4|.2 .4) cmatrix=(0|0 0) length=.2
{loads}
set voltagebases=[11,0.4]
calcvoltagebases
solve
"""
SINGLE = """
new load.shop bus1=B2.1 phases=1 kv=0.231 kw=8 pf=0.95 vminpu=0.5
new load.inn bus1=B2.2 phases=1 kv=0.231 kw=3 pf=0.95 vminpu=0.5
"""
EVEN = "new load.mill bus1=B1 phases=3 kv=0.4 kw=20 pf=0.95 vminpu=0.5"
TWO = """
clear
new circuit.x basekv=12.47 pu=1.0 mvasc3=100 mvasc1=100 bus1=Grid
{station}
new linecode.tri nphases=2 rmatrix=(.5|.1 .5) xmatrix=(.3|.2 .3) cmatrix=(0|0 0) units=km
new line.tri bus1=Sec.1.2 bus2=House.1.2 linecode=tri length=.1 units=km
new load.h1 bus1=House.1 phases=1 kv=.12 kw=4 pf=.95 vminpu=.5
new load.h2 bus1=House.2 phases=1 kv=.12 kw=1 pf=.95 vminpu=.5
set voltagebases=[12.47,.208]
calcvoltagebases
solve
"""


SPLIT = """
new transformer.ct phases=1 windings=3 buses=(Grid.1.0, Sec.1.0, Sec.0.2) kvs=(7.2,.12,.12) kvas=(50,50,50)
~ xhl=2 xht=2 xlt=1 conns=(wye,wye,wye)
"""
APART = """
new transformer.one phases=1 windings=2 buses=(Grid.1, Sec.1) kvs=(7.2,.12) kvas=(50,50) xhl=2
new transformer.two phases=1 windings=2 buses=(Grid.2, Sec.2) kvs=(7.2,.12) kvas=(50,50) xhl=2
"""


def converted(
    folder: Path, text: str, *, root: str | None = None, loads: str = SINGLE, **ways: str
) -> Conversion:
    path = folder / "master.dss"
    path.write_text(text.format(loads=loads, **{"sequence": "", "order": "", **ways}))
    return convert(str(path), folder / "out", root=root)


def angles(done: Conversion) -> list[ConversionChange]:
    return [change for change in done.changes if change.prop == "angles between its phases"]


@pytest.mark.parametrize("ways", [{"sequence": "sequence=neg"}, {"order": ".1.3.2"}])
def test_phases_that_follow_each_other_the_other_way_round_are_told_and_checked_as_they_are_watched(
    ways: dict[str, str], tmp_path: Path
) -> None:
    done = converted(tmp_path, TOWN, **ways)
    effect = "0, -120 and 120 degrees, in the source 0, 120 and -119.9; the check shows the effect"
    assert angles(done) == [
        ConversionChange("bus board", "angles between its phases", "approximated", effect)
    ]
    assert effect in (tmp_path / "out" / CHANGES_FILE).read_text()
    assert done.check is not None
    # Mutual impedances act with the other sign of sin 120 degrees: percents of a drop of some percent.
    assert not done.check.exact
    assert done.check.largest_pu > 1e-3


def test_three_phases_that_draw_alike_do_not_mind(tmp_path: Path) -> None:
    done = converted(tmp_path, TOWN, loads=EVEN, sequence="sequence=neg")
    assert len(angles(done)) == 1
    assert done.check is not None
    assert done.check.exact


def test_usual_angles_are_the_check_s_own(tmp_path: Path) -> None:
    done = converted(tmp_path, TOWN)
    assert not angles(done)
    assert done.check is not None
    assert done.check.exact


@pytest.mark.parametrize(
    ("station", "said"), [(SPLIT, "0 and -120 degrees, in the source 0 and"), (APART, "")]
)
def test_a_busbar_of_two_phases_has_its_check_and_a_centre_tapped_one_its_row(
    station: str, said: str, tmp_path: Path
) -> None:
    done = converted(tmp_path, TWO, station=station, root="sec")
    assert [row.effect[: len(said)] for row in angles(done)] == [said] * bool(said)
    assert done.check is not None
    assert done.check.buses == 2
    assert done.check.exact is not bool(said)

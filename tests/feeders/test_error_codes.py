"""A sentence for each code and each class of error of feeders, in golden/errors.txt."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import feeders
from feeders import registry
from feeders.convert.convert import convert
from feeders.convert.from_simbench import envelope
from feeders.convert.network import below, busbar_of
from feeders.convert.source import SourceNetwork
from feeders.format.tables import CustomerRow, FeederTables, LineRow, from_json, read, to_json, write
from feeders.model.site import from_history, from_tables, load
from feeders.model.three_phase import three_phase
from feeders.registry import Estimator, choose
from feeders.simulation.attacks import AttackKind, random_attacks
from feeders.simulation.demand import Variation
from feeders.simulation.plant import Channel, ClosedLoop, Loads
from feeders.simulation.powerflow import PowerFlow
from feeders.simulation.recording import read_recording
from feeders.simulation.scenario import Scenario, simulate
from feeders.simulation.trial import LoadError
from feeders.studies.calibrate.readings import frames
from feeders.studies.calibrate.study import Calibrate
from feeders.studies.campaign.study import campaign
from feeders.studies.droop.study import droop
from feeders.studies.protect import Goal, protect
from feeders.studies.running import Dask, Journal, Processes, agree
from gridsec.attack import Bias
from tests.feeders import stations, villages
from tests.feeders.studies.campaign.campaigns import PLAN, SITE
from tests.feeders.villages import village, village_without_inverters
from tests.journals import edit, head_of
from tests.sentences import golden, sentences, used

PACKAGE = Path(feeders.__file__).parent
GOLDEN = Path(__file__).parent / "golden" / "errors.txt"
HOUSE = CustomerRow("house", "end", load_kw=5.0, meter="m1")
MAIN = LineRow("main", "bb", "end", 0.1, 0.04)
START = 1.75e9


def street(*lines: LineRow, customers: tuple[CustomerRow, ...] = (HOUSE,), **meta: Any) -> FeederTables:
    """One line to one house, or other lines and customers."""
    made = villages.tables()
    return FeederTables(replace(made.meta, **meta), lines or (MAIN,), customers)


def cells(table: str, **changed: Any) -> Any:
    """The street as JSON with other cells in its first row."""
    made = to_json(street())
    (made[table] if table == "feeder" else made[table][0]).update(changed)
    return from_json(made)


def matrix(**changed: Any) -> Any:
    """A line with a matrix in phases a and b."""
    block = {"r_aa_ohm": 0.3, "r_ab_ohm": 0.1, "r_bb_ohm": 0.3, "x_aa_ohm": 0.2, "x_ab_ohm": 0.1}
    line = replace(MAIN, phases="ab", r_ohm=0.2, x_ohm=0.1, **(block | {"x_bb_ohm": 0.2} | changed))
    return three_phase(street(line, customers=(replace(HOUSE, phases="a"),)))


def ring() -> tuple[LineRow, ...]:
    return MAIN, replace(MAIN, line="other"), LineRow("far", "beyond", "farther", 0.1, 0.04)


def backwards() -> Any:
    made = stations.tables()
    lines = [
        replace(row, from_bus="s1", to_bus="m2", to_volt=stations.MV, r_ohm=8.75, x_ohm=24.0)
        if row.line == "T1"
        else row
        for row in made.lines
    ]
    return from_tables(replace(made, lines=tuple(lines)))


def limited() -> Any:
    with patch("feeders.format.tables.MAX_PROBLEMS", 1):
        return cells("lines", r_ohm=-1, x_ohm="much", closed="maybe")


def large() -> Any:
    write(street(), "street")
    with patch("feeders.format.columns.MAX_BYTES", 0):
        return read("street")


def unreadable() -> Any:
    write(street(), "street")
    Path("street/lines.csv").write_bytes(b"line,from_bus\nl\xff,bb\n")
    return read("street")


def opened() -> Any:
    write(street(), "street")
    return convert("street", "out", opened=["main"])


def network(*lines: LineRow, sources: tuple[str, ...] = ("bb",), **more: Any) -> SourceNetwork:
    return SourceNetwork("a tool", list(sources), {"bb": 230.0, "end": 230.0}, list(lines or (MAIN,)), **more)


def without(module: str, made: Callable[[], Any]) -> Any:
    with patch.dict(sys.modules, {module: None}):
        return made()


def bare() -> Any:
    pd.DataFrame({"meter": ["m1"], "t": [True]}).to_parquet("a.parquet")
    return read_recording("a.parquet")


def newer() -> Any:
    table = pa.table({"meter": ["m1"], "t": [1.0], "v_volt": [230.0]})
    pq.write_table(table.replace_schema_metadata({"gridsec": '{"format": 9}'}), "a.parquet")
    return read_recording("a.parquet")


def readings(**columns: Any) -> Any:
    """Readings of the busbar and of a meter at two moments."""
    site = from_tables(street())
    table = {"meter": ["", "m1"] * 2, "t": np.repeat([START, START + 900.0], 2), "v_volt": 230.0}
    return frames(site, pd.DataFrame(table | columns))


def pgm(**changed: Any) -> Any:
    """A file of power-grid-model with one node, and a source at another one."""
    source = {"id": 2, "node": 7, "status": 1, "u_ref": 1.0}
    content = {"version": "1.0", "type": "input", "is_batch": False, "attributes": {}}
    data = {"node": [{"id": 1, "u_rated": 400.0}], "source": [source]}
    Path("grid.json").write_text(json.dumps(content | {"data": data} | changed), "utf-8")
    return convert("grid.json", "out")


def opendss() -> Any:
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    Path("town.dss").write_text(
        "clear\nnew circuit.x basekv=0.4 bus1=a\nnew line.l bus1=a bus2=b r1=1 x1=1\n"
        "new capacitor.series bus1=b bus2=c phases=3 kv=0.4 kvar=100\n"
        "set voltagebases=[0.4]\ncalcvoltagebases\nsolve\n"
    )
    return convert("town.dss", "out")


def foreign_worker() -> Any:
    with patch("feeders.studies.running.versions", lambda: {"numpy": "2.0"}):
        return agree("tcp://a:1", {"numpy": "1.0"})


def held() -> Any:
    with Journal("journal", {"study": "any"}):
        return Journal("journal", {"study": "any"})


def journal(**changed: Any) -> Any:
    with Journal("journal", {"study": "any"}):
        pass
    edit(Path("journal"), head=head_of(Path("journal")) | changed)
    return Journal("journal", {"study": "any"})


def no_journal() -> Any:
    Path("journal").write_text("[1]\n", "utf-8")
    return Journal("journal", {"study": "any"})


def other_feeder() -> Any:
    studied: Any = SimpleNamespace(digest="of another feeder")
    return Calibrate.corrected(studied, "cigre-lv", "out")


def unplayed() -> Any:
    wild = replace(PLAN, scenes=1, together=1, kinds=(), liars=(), variation=Variation(load_scale=1e3))
    return campaign(SITE, replace(wild, load_error=LoadError(1e4, 1e4)))


def not_settled() -> Any:
    site = village()
    loop = ClosedLoop(PowerFlow(site), site.droop, site.feeder.base_kva, site.feeder.base_volt)
    nothing = np.zeros(len(site.feeder.customers))
    with patch("feeders.simulation.plant.MAX_ITERATIONS", 0):
        return loop.equilibrium(Loads(nothing, nothing, 300.0))


def unsolved() -> Any:
    failed = SimpleNamespace(success=False, x=None, message="infeasible")
    with patch("feeders.convert.from_simbench.linprog", lambda *_, **__: failed):
        return envelope(np.array([0.1, 0.9, 0.5]), np.array([0.2, 0.3, 0.9]))


def elsewhere() -> Any:
    ghost = Bias(np.array([7]), START, START + 1.0, size=np.array([0.1]))
    return next(simulate(village(), Scenario(start=START, attacks=(ghost,))))


CALLS: dict[str, Callable[[], Any]] = {
    "cells of a line": lambda: cells("lines", r_ohm=-1, x_ohm="much", closed="maybe", b_us="nan", line=""),
    "cells of feeder.toml": lambda: cells(
        "feeder", name="a b", voltage_volt=1e9, monitor={"max_attacked": 1.5}
    ),
    "a preset of no standard": lambda: cells("customers", droop="x", inverter_kva=5.0),
    "limits in the wrong order": lambda: cells("feeder", limits={"v_min_pu": 1.1, "v_max_pu": 0.9}),
    "an id twice": lambda: from_tables(street(customers=(HOUSE, HOUSE))),
    "columns of different length": lambda: from_json(
        to_json(street()) | {"lines": {"line": ["a"], "x_ohm": []}}
    ),
    "a voltage between phases": lambda: from_tables(street(voltage_volt=400.0)),
    "a problem beyond the limit": limited,
    "a file beyond the limit": large,
    "a file that is not UTF-8": unreadable,
    "a ring, and an island": lambda: from_tables(street(*ring())),
    "a line from a bus to itself": lambda: from_tables(street(MAIN, replace(MAIN, line="l", from_bus="end"))),
    "a transformer from its far end": backwards,
    "a tap on a switch": lambda: from_tables(street(MAIN, LineRow("s", "end", "b", 0.0, 0.0, tap=1.1))),
    "no line with an impedance": lambda: from_tables(street(replace(MAIN, r_ohm=0.0, x_ohm=0.0))),
    "a matrix without an entry": lambda: matrix(r_ab_ohm=None),
    "a matrix of an absent phase": lambda: matrix(r_cc_ohm=0.3),
    "a matrix of another line": lambda: matrix(r_ab_ohm=0.2),
    "a matrix that generates": lambda: matrix(r_aa_ohm=0.0, r_bb_ohm=0.0, r_ab_ohm=-0.2),
    "a matrix without an inverse": lambda: matrix(
        **dict.fromkeys(("r_aa_ohm", "r_ab_ohm", "r_bb_ohm"), 0.1),
        **dict.fromkeys(("x_aa_ohm", "x_ab_ohm", "x_bb_ohm"), 0.1),
    ),
    "three phases as a balanced feeder": lambda: load("ieee-european-lv").balanced,
    "no such estimator": lambda: choose(village(), estimator="oracle", max_attacked=-1),
    "an estimator that no package offers": lambda: registry.load_foreign("nobody", Estimator),
    "two sources": lambda: busbar_of(network(sources=("bb", "end")), [MAIN], None),
    "a second source": lambda: below(network(sources=("bb", "end")), "bb", ()),
    "no such bus": lambda: busbar_of(network(), [MAIN], "nowhere"),
    "no source": lambda: convert("nonsense", "out"),
    "the only line opened": opened,
    "no such file": lambda: convert("absent.json", "out"),
    "no converter": lambda: without("pandapower", lambda: convert("kerber-landnetz", "out")),
    "another type of file": lambda: pgm(type="sym_output", data={}),
    "data that its tool rejects": pgm,
    "a capacitor in series": opendss,
    "no envelope": unsolved,
    "a recording without columns": bare,
    "a recording of another format": newer,
    "readings without a time": lambda: readings(t=np.nan),
    "readings of another feeder": lambda: readings(meter=["", "m9"] * 2),
    "readings in kV": lambda: readings(v_volt=0.23),
    "too few readings": readings,
    "another feeder": other_feeder,
    "a history of two shapes": lambda: from_history(np.zeros((9, 3)), np.zeros((9, 2)), 1.0),
    "a channel that loses more than all": lambda: Channel(loss=1.5),
    "a scenario without length": lambda: Scenario(duration_s=0.0),
    "an attack of a meter that is not there": elsewhere,
    "more attacked meters than there are": lambda: random_attacks(
        village(), 0, AttackKind.BIAS, 8, 0.02, t_on=START, t_off=START + 1.0
    ),
    "a fake load at all meters": lambda: random_attacks(
        village(), 0, AttackKind.COORDINATED, 7, 0.02, t_on=START, t_off=START + 1.0
    ),
    "a load beyond the feeder": lambda: PowerFlow(village()).solve(np.full(8, 1e5), np.zeros(8), 230.0),
    "inverters that do not settle": not_settled,
    "no inverters": lambda: droop(village_without_inverters()),
    "a meter that cannot be protected": lambda: protect(
        load("cigre-lv"), max_attacked=1, unknown=["Load R15"], goal=Goal.NOTICE, never=["m03"]
    ),
    "a journal in use": held,
    "a journal of an older program": lambda: journal(versions={"numpy": "1.0"}),
    "no journal": no_journal,
    "a worker that dies": lambda: list(Processes(1, retries=0).run(os._exit, [7])),
    "a worker of another version": foreign_worker,
    "no cluster": lambda: without("distributed", lambda: list(Dask("tcp://a:1").run(abs, [0]))),
    "no scene that can be played": unplayed,
}


@pytest.mark.parametrize("call", CALLS)
def test_sentences(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert sentences(CALLS[call]) == golden(GOLDEN)[call]


def test_the_golden_file_has_a_sentence_for_each_code_and_class() -> None:
    there = golden(GOLDEN)
    assert there.keys() == CALLS.keys()
    found = [each.split(" | ") for rest in there.values() for each in rest]
    assert {code for _, code, _ in found} >= used(PACKAGE)
    text = "".join(path.read_text("utf-8") for path in PACKAGE.rglob("*.py"))
    classes = set(
        re.findall(r"^class (\w+)\((?:.*, )?(?:GridsecError|FeederInvalid|InputInvalid)\):", text, re.M)
    )
    assert {name for name, _, _ in found} >= classes
    assert len(classes) == 14

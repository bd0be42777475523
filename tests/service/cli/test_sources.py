"""`gridsec study` given another tool's network: it becomes a feeder's folder, and the study goes on."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

from feeders.model.site import load
from feeders.studies.redundancy import redundancy
from tests.feeders.foreign import opendss, pgm
from tests.service.commands import Run, command, plain, text_of

run = command("study")


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where converted feeders are left that nobody asked to keep."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def written(source: str, folder: Path) -> Path:
    """A real file of each tool."""
    if source == "my-net.json":
        import pandapower
        from pandapower.networks import create_kerber_landnetz_freileitung_2

        net = create_kerber_landnetz_freileitung_2()
        pandapower.create_shunt(net, bus=net.bus.index[-1], q_mvar=0.0, p_mw=0.001)
        pandapower.to_json(net, str(folder / source))
        return folder / source
    return (
        opendss(folder / source, 9, balanced=True)
        if source[-3:] == "dss"
        else pgm(folder / source, 9, balanced=True)
    )


@pytest.mark.canary("town.dss", "grid.json")
@pytest.mark.parametrize("source", ["my-net.json", "town.dss", "grid.json"])
def test_a_study_of_another_tools_file(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip({"my-net.json": "pandapower", "town.dss": "opendssdirect"}.get(source, "numpy"))
    file, out = written(source, tmp_path), tmp_path / "out"
    code, told, complaint = run(monkeypatch, capsys, "redundancy", str(file), "--out", str(out))
    assert code == 0, complaint
    changes = pd.read_csv(out / "feeder" / "conversion.csv")
    left_out = int((changes["done"] == "left out").sum())
    assert left_out >= 1
    assert f"{left_out} left out" in told
    assert f"the list: {out / 'feeder' / 'conversion.csv'}" in told
    assert "|v| differs by less than" in told
    site = load(out / "feeder")
    assert site.feeder.name == file.stem
    expected = redundancy(site).tables
    written_meters = pd.read_csv(out / "redundancy-meters.csv")[["meter"]]
    pd.testing.assert_frame_equal(written_meters, expected["meters"][["meter"]])

    # Again, into the same folder: the results are the same, and nobody asks.
    before = {path.name: path.read_bytes() for path in out.rglob("*.csv")}
    assert run(monkeypatch, capsys, "redundancy", str(file), "--out", str(out))[0] == 0
    assert {path.name: path.read_bytes() for path in out.rglob("*.csv")} == before


def test_without_a_folder_the_list_stays_where_it_is_said_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = pgm(tmp_path / "grid.json", 9, balanced=True)
    code, told, complaint = run(monkeypatch, capsys, "redundancy", str(file))
    assert code == 0, complaint
    said = re.search(r"the list: (\S+)", told)
    assert said is not None
    assert Path(said[1]).is_relative_to(tmp_path / "temporary")
    assert Path(said[1]).read_text(encoding="utf-8").startswith("element,property,done,effect\n")


def test_a_folder_of_somebody_else_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = pgm(tmp_path / "grid.json", 9, balanced=True)
    own = tmp_path / "out" / "feeder"
    own.mkdir(parents=True)
    (own / "feeder.toml").write_text("mine", encoding="utf-8")
    code, _, told = run(monkeypatch, capsys, "redundancy", str(file), "--out", str(tmp_path / "out"))
    assert code == 6
    assert "exists and is not a converted feeder" in plain(told)
    assert (own / "feeder.toml").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in own.iterdir()] == ["feeder.toml"]


def test_what_was_edited_since_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = pgm(tmp_path / "grid.json", 9, balanced=True), tmp_path / "out"
    again = ("redundancy", str(file), "--out", str(out))
    assert run(monkeypatch, capsys, *again)[0] == 0
    assert run(monkeypatch, capsys, *again)[0] == 0
    assert sorted(path.name for path in out.glob("feeder*")) == ["feeder"]
    customers = out / "feeder" / "customers.csv"
    original = customers.read_bytes()
    customers.write_bytes(original + b"# mine\n")
    code, told, complaint = run(monkeypatch, capsys, *again)
    assert code == 0, complaint
    assert f"it is now in {out / 'feeder-1'}" in plain(told)
    assert (out / "feeder-1" / "customers.csv").read_bytes() == original + b"# mine\n"
    assert customers.read_bytes() == original
    # A source that is none any more takes nothing away either.
    file.write_text("{}", encoding="utf-8")
    assert run(monkeypatch, capsys, *again)[0] == 6
    assert customers.read_bytes() == original
    assert sorted(path.name for path in out.glob("feeder*")) == ["feeder", "feeder-1"]


def looped(folder: Path) -> Path:
    """An OpenDSS file with two loops."""
    source = opendss(folder / "town.dss", 9, balanced=True)
    ring = "new line.ring1 bus1=n8 bus2=n1 length=1\nnew line.ring2 bus1=n7 bus2=n2 length=1\n"
    source.write_text(source.read_text().replace("set voltagebases", ring + "set voltagebases"))
    return source


def test_what_keeps_it_from_being_a_feeder_is_told_with_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    source = looped(tmp_path)
    code, _, told = run(monkeypatch, capsys, "redundancy", str(source))
    assert code == 3
    assert plain(told).count("form a loop") == 2
    assert f"gridsec feeders convert {source} FOLDER, with --root BUS" in plain(told)
    assert "--open LINE" in told
    assert not list((tmp_path / "temporary").iterdir())


def test_a_busbar_that_is_not_clear(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pandapower = pytest.importorskip("pandapower", reason="the extra `convert` is not installed")
    net = pandapower.networks.create_cigre_network_lv()
    pandapower.to_json(net, str(tmp_path / "net.json"))
    words = ("detectable", str(tmp_path / "net.json"), "--out", str(tmp_path / "out"))
    code, _, told = run(monkeypatch, capsys, *words)
    assert code == 3
    assert "the busbar is not clear, candidates:" in plain(told)
    assert "--root BUS" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "content", "code", "why"),
    [
        ("nowhere.json", None, 6, "nowhere.json: there is no such file"),
        ("nowhere.dss", None, 6, "nowhere.dss: there is no such file"),
        ("empty.json", "", 6, "empty.json: invalid JSON"),
        ("half.json", '{"_module": "pandapower.auxiliary", "_cl', 6, "half.json: invalid JSON"),
        ("net.json", '{"_class": "pandapowerNet"}', 6, "net.json: "),
        ("empty.dss", "", 6, "finds no circuit in it"),
        ("simbench:7-LV--0-sw", None, 6, "SimBench has no grid '7-LV--0-sw'"),
        ("pandapower:nothing", None, 6, "pandapower has no network 'nothing'"),
        ("lines.csv", "line,from_bus", 3, "lines.csv: a file; expected a feeder's folder"),
        ("nowhere", None, 3, "nowhere: there is neither such a folder nor such a feeder"),
    ],
)
def test_what_is_no_feeder(
    *,
    name: str,
    content: str | None,
    code: int,
    why: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("simbench", reason="the extra `convert` is not installed")
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / name).write_text(content, encoding="utf-8")
    found, _, told = run(monkeypatch, capsys, "redundancy", name, "--no-journal")
    assert (found, why in plain(told)) == (code, True), told
    assert "profiles" not in told


def test_a_report_tells_what_was_not_carried_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, page = pgm(tmp_path / "grid.json", 9, balanced=True), tmp_path / "report.html"
    words = ("report", str(file), "--studies", "redundancy", "--out", str(page))
    assert run(monkeypatch, capsys, *words)[0] == 0
    folder = tmp_path / "report-files"
    changes = pd.read_csv(folder / "feeder" / "conversion.csv")
    pd.testing.assert_frame_equal(pd.read_csv(folder / "tables" / "feeder-conversion.csv"), changes)
    html = page.read_text(encoding="utf-8")
    assert "Changes of the conversion" in html
    for cell in changes["element"]:
        assert f"<td>{cell}</td>" in html
    source = (folder / "feeder" / "SOURCE.md").read_text(encoding="utf-8")
    check = " ".join(source.partition("## Checked\n\n")[2].partition("\n\n")[0].split())
    assert check.startswith("AC power flow of power-grid-model")
    assert check.replace("'", "&#39;") in html
    assert f"gridsec study report {file}" in text_of(html)


@pytest.mark.canary("protect", "campaign", "compare")
@pytest.mark.parametrize(
    ("more", "study"),
    [
        (("--max-attacked", "1"), command("study", "protect")),
        (("--scenarios", "2", "--duration", "30", "--workers", "1"), command("study", "campaign")),
        (("--compare", "vde4105", "--preset", "vde4105", "--who", "all"),
         command("study", "droop")),
        (("--case", "clean", "--family", "modal", "--seeds", "1", "--duration", "70"),
         command("study", "compare")),
    ],
    ids=["protect", "campaign", "droop", "compare"],
)  # fmt: skip
def test_every_study_takes_it(
    more: tuple[str, ...],
    study: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, told, complaint = study(monkeypatch, capsys, str(pgm(tmp_path / "g.json", 6, balanced=True)), *more)
    assert code == 0, complaint
    assert "left out" in told

"""`gridsec feeders convert`: the table of changes, the finding of the check, and errors."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandapower
import pytest
from typer.testing import CliRunner

from feeders.model.equipment import folder_of
from feeders.model.site import load
from service.cli.main import app
from tests.feeders.convert.test_convert_unsupplied import street
from tests.feeders.foreign import opendss, pgm
from tests.service.commands import command

run = CliRunner(env={"COLUMNS": "160"}).invoke


@pytest.mark.parametrize("names", [["feeders", "convert"], ["convert"]])
def test_a_network_becomes_a_feeder(names: list[str], tmp_path: Path) -> None:
    source = pgm(tmp_path / "grid.json", 12, balanced=True)
    done = run(app, [*names, str(source), str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    for part in ("left out", "above the busbar", "out written", "12 buses", "largest difference"):
        assert part in done.output.replace("\n", " "), part
    valid = run(app, ["feeders", "validate", str(tmp_path / "out")])
    assert valid.exit_code == 0, valid.output


def test_an_opendss_file_with_a_loop(tmp_path: Path) -> None:
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    source = opendss(tmp_path / "town.dss", 12, balanced=True)
    text = source.read_text().replace(
        "set voltagebases", "new line.ring bus1=n11 bus2=n1 length=1\nset voltagebases"
    )
    source.write_text(text)
    done = run(app, ["feeders", "convert", str(source), str(tmp_path / "out")])
    assert done.exit_code != 0
    assert "form a loop" in str(done.exception)
    done = run(app, ["feeders", "convert", str(source), str(tmp_path / "ring"), "--meshed"])
    assert done.exit_code == 0, done.output
    assert "less than 1e-08 pu" in " ".join(done.output.split())
    assert "meshed = true" in (tmp_path / "ring" / "feeder.toml").read_text()
    done = run(
        app, ["feeders", "convert", str(source), str(tmp_path / "out"), "--open", "ring", "--name", "town"]
    )
    assert done.exit_code == 0, done.output
    assert "as requested" in done.output
    assert 'name = "town"' in (tmp_path / "out" / "feeder.toml").read_text()


def test_a_feeder_written_by_hand_is_never_replaced(tmp_path: Path) -> None:
    source, own = pgm(tmp_path / "grid.json", 12, balanced=True), tmp_path / "mine"
    bundled = folder_of("simbench-lv-rural1")
    assert bundled is not None
    shutil.copytree(bundled, own)
    (own / "conversion.csv").unlink()
    before = {path.name: path.read_bytes() for path in own.iterdir()}
    for given in (source, own):
        done = run(app, ["feeders", "convert", str(given), str(own)])
        assert isinstance(done.exception, FileExistsError)
        assert "that is not from a conversion" in str(done.exception)
        assert {path.name: path.read_bytes() for path in own.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["grid.json", "mine"]


def test_an_edited_conversion_is_kept_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, folder = pgm(tmp_path / "grid.json", 12, balanced=True), tmp_path / "out"
    again = ["feeders", "convert", str(source), str(folder)]
    for _ in range(2):
        assert run(app, again).exit_code == 0
    assert not (tmp_path / "out-1").exists()
    customers = folder / "customers.csv"
    original = customers.read_bytes()
    customers.write_bytes(original + b"# mine\n")
    done = run(app, again)
    assert done.exit_code == 0, done.output
    assert "it is now in" in done.output
    assert (tmp_path / "out-1" / "customers.csv").read_bytes() == original + b"# mine\n"
    assert customers.read_bytes() == original
    # The folder as its own source, from within; and a source that is none takes nothing away.
    monkeypatch.chdir(folder)
    done = run(app, ["feeders", "convert", ".", ".", "--name", "other"])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "out-2" / "customers.csv").read_bytes() == original
    assert load(folder).feeder.name == "other"
    assert run(app, ["feeders", "convert", "nowhere.json", "."]).exit_code != 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["grid.json", "out", "out-1", "out-2"]


def test_a_network_without_a_clear_busbar_is_refused_until_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    net = street(3)
    net.ext_grid["in_service"] = False
    source, folder = tmp_path / "net.json", tmp_path / "out"
    pandapower.to_json(net, str(source))
    convert = command("feeders", "convert")
    code, _, told = convert(monkeypatch, capsys, str(source), str(folder))
    assert (code, folder.exists()) == (3, False)
    assert "name the busbar with --root" in told
    assert convert(monkeypatch, capsys, str(source), str(folder), "--root", "b0")[0] == 0
    assert load(str(folder)).tables.meta.busbar == "b0"

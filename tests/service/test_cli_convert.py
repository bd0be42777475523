"""`gridsec feeders convert`: the table of changes, the finding of the check, and errors."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli import app
from tests.feeders.foreign import opendss, pgm

run = CliRunner(env={"COLUMNS": "160"}).invoke


@pytest.mark.parametrize("command", [["feeders", "convert"], ["convert"]])
def test_a_network_becomes_a_feeder(command: list[str], tmp_path: Path) -> None:
    source = pgm(tmp_path / "grid.json", 12, balanced=True)
    done = run(app, [*command, str(source), str(tmp_path / "out")])
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
    assert "as asked for" in done.output
    assert 'name = "town"' in (tmp_path / "out" / "feeder.toml").read_text()

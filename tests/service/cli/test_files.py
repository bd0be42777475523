"""Campaigns and reports as the feeder's files say, where no option says otherwise."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from feeders.format.tables import write
from feeders.model.site import load
from feeders.profiles import Season
from feeders.simulation.attacks import AttackKind
from feeders.simulation.trial import LoadError
from feeders.studies.campaign.plan import AttackClass, CampaignPlan, Place
from feeders.studies.campaign.study import campaign
from feeders.studies.droop.study import DroopOptions, droop
from tests.feeders.villages import village, village_without_inverters
from tests.service.commands import command, plain, text_of

FEW = ("--scenarios", "3", "--workers", "1", "--no-journal", "--kind", "bias:3", "--liars", "1")
KNOWN = ("--load-error-kw", "0.1", "--load-error-kvar", "0.05")

run = command("study")


@pytest.fixture
def rare(tmp_path: Path) -> Path:
    """CIGRE with a reading in a quarter of an hour, monitored by another estimator."""
    tables = load("cigre-lv").tables
    monitor = replace(
        tables.meta.monitor,
        tick_s=900.0,
        silence_s=9000.0,
        estimator="weighted-least-squares",
        alarms_per_year=2.0,
    )
    write(replace(tables, meta=replace(tables.meta, name="rare", monitor=monitor)), tmp_path / "rare")
    return tmp_path / "rare"


def test_a_campaign_follows_the_files(
    rare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("campaign", str(rare), *FEW, "--out", str(tmp_path / "out"))
    code, told, _ = run(monkeypatch, capsys, *words, "--duration", "18000")
    assert code == 0
    assert (
        "rare: 3 scenarios of 20 readings, one every 900 s (feeder's files), monitored by "
        "weighted-least-squares (feeder's files); allowed false alarms a year: 2 (feeder's files); powers of "
        "metered customers within 0.14 kW and 3.4 kvar, medians of 1 sigma (feeder's files)"
    ) in plain(told)
    found = pd.read_csv(tmp_path / "out" / "campaign-scenarios.csv")
    assert set(found["alarms_per_year"]) == {2.0}
    onset = found["onset_s"].dropna()
    assert len(onset) == 2
    assert (onset % 900.0 == 0.0).all()
    assert onset.between(0.1 * 18_000.0, 0.3 * 18_000.0).all()


def test_a_scenario_that_is_too_short_for_the_files_is_refused(
    rare: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(monkeypatch, capsys, "campaign", str(rare), *FEW, "--duration", "600")
    assert code == 2
    assert (
        "--duration: 600 s are too short for one reading every 900 s (feeder's files): at least 9000 s"
        in (plain(error))
    )


def test_options_are_stronger_than_the_files(
    rare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (
        "campaign",
        str(rare),
        *FEW,
        "--place",
        "random",
        "--season",
        "summer",
        "--out",
        str(tmp_path / "out"),
    )
    chosen = (
        "--step",
        "1",
        "--estimator",
        "modal",
        "--alarms-per-year",
        "1",
        *KNOWN,
        "--duration",
        "30",
    )
    code, told, _ = run(monkeypatch, capsys, *words, *chosen)
    assert code == 0
    for said in (
        "one every 1 s (--step)",
        "monitored by modal (--estimator)",
        "a year: 1 (--alarms-per-year)",
        "within 0.1 kW and 0.05 kvar, medians of 1 sigma (--load-error-kw, --load-error-kvar)",
    ):
        assert said in plain(told)
    plan = CampaignPlan(
        scenes=1,
        together=3,
        kinds=(AttackClass("bias", AttackKind.BIAS, (3.0,)),),
        liars=(1,),
        places=(Place.RANDOM,),
        seasons=(Season.SUMMER,),
        duration_s=30.0,
        onset_s=(3.0, 9.0),
        lying_s=15.0,
        load_error=LoadError(0.1, 0.05),
    )
    expected = campaign(load(rare), plan).scenarios
    written = pd.read_parquet(tmp_path / "out" / "campaign-scenarios.parquet")
    np.testing.assert_array_equal(written["error_others"], expected["error_others"])
    np.testing.assert_array_equal(written["onset_s"], expected["onset_s"])


@pytest.mark.acceptance
def test_a_report_takes_limits_of_the_busbar_and_a_preset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(village().tables, tmp_path / "village")
    page = tmp_path / "page.html"
    chosen = ("--busbar", "0.99", "1.01", "--band", "0.95", "1.05", "--preset", "vde4105")
    words = (str(tmp_path / "village"), "--out", str(page), "--studies", "droop", *chosen)
    code, _, _ = run(monkeypatch, capsys, "report", *words)
    assert code == 0
    options = DroopOptions(preset="vde4105", v0_low=0.99, v0_high=1.01, v_min=0.95, v_max=1.05)
    # Another study, of other options, would refuse the journal.
    (journal,) = (tmp_path / "page-files" / "journals").iterdir()
    expected = droop(load(tmp_path / "village"), options, journal=journal).tables["band"]
    written = pd.read_parquet(tmp_path / "page-files" / "tables" / "droop-band.parquet")
    pd.testing.assert_frame_equal(written, expected)
    html = text_of(page.read_text(encoding="utf-8"))
    assert "--preset vde4105 --busbar 0.99 1.01 --band 0.95 1.05" in html
    for option, values in (("--busbar", ("1.02", "0.98")), ("--band", ("0.9", "0.9"))):
        code, _, error = run(monkeypatch, capsys, "report", str(tmp_path / "village"), option, *values)
        assert code == 2
        assert f"{option}: expected two ascending" in plain(error)


@pytest.mark.acceptance
def test_a_report_tells_what_its_attacks_take_from_the_files(
    rare: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = rare.parent / "page.html"
    words = (
        "report",
        str(rare),
        "--studies",
        "campaign",
        "--scenarios",
        "2",
        "--workers",
        "1",
        "--out",
        str(page),
    )
    code, told, _ = run(monkeypatch, capsys, *words, "--step", "5", *KNOWN)
    assert code == 0
    assert (
        "600 readings, one every 5 s (--step), monitored by weighted-least-squares (feeder's files)"
        in plain(told)
    )
    html = text_of(page.read_text(encoding="utf-8"))
    assert "2 scenarios of 3000 s at 5 s" in html
    assert "powers known within 0.1 kW and 0.05 kvar" in html
    assert shlex.join(("--step", "5", *KNOWN)) in html


def test_without_inverters_nothing_could_be_unstable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, page = tmp_path / "plain", tmp_path / "page.html"
    write(village_without_inverters().tables, folder)
    code, told, _ = run(monkeypatch, capsys, "droop", str(folder), "--no-journal")
    assert code == 0
    assert "no inverters: stability does not apply" in told
    code, told, error = run(
        monkeypatch, capsys, "report", str(folder), "--studies", "droop", "--out", str(page)
    )
    assert (code, error) == (0, "")
    assert "droop: no inverters: stability does not apply" in told
    assert "No inverters: stability does not apply." in page.read_text(encoding="utf-8")
    # Who asks for hosting asks for more than there is.
    code, _, error = run(monkeypatch, capsys, "droop", str(folder), "--no-journal", "--hosting")
    assert code != 0
    assert "--preset" in plain(error)

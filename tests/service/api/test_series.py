"""Time series over REST, and the displayed verdict beside the raw one."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from gridsec.interface import Cause, Decision
from service.api import models
from service.api.tables import ARROW, CSV, PARQUET
from service.report.report import DisplayedVerdict
from tests.service.asking import T0, Setup, is_problem

SERIES = "/feeders/village/series"


def test_series_of_several_meters_with_alarms(setup: Setup) -> None:
    setup.calm(T0, 31)
    setup.attack(T0 + 31, 10)
    found = models.Series.model_validate(
        setup.get(SERIES, params={"meter": ["H3", "H5", "H3"], "since": T0, "until": T0 + 60}).json()
    )
    assert (found.feeder, found.bucket_s, found.step_s, found.complete) == ("village", 1.0, 10.0, True)
    assert [t - T0 for t in found.t] == [0, 10, 20, 30, 31, 40]
    assert found.ticks == [1] * 6
    assert [found.clean_s[0], found.attacked_s[-1]] == [1.0, 1.0]
    liar, honest = found.meters
    assert (liar.meter, honest.meter) == ("H3", "H5")
    points = setup.get("/feeders/village/history?meter=H3").json()["points"]
    rows = [point["meter"] for point in points]
    for j, row in enumerate(rows):
        reported, v = row["v_volt_reported"], row["v_volt_estimated"]
        assert row["v_volt_std"] == pytest.approx(0.15)
        assert [liar.v_volt_reported_min[j], liar.v_volt_reported_max[j]] == pytest.approx(
            [reported] * 2, abs=1e-3
        )
        assert [liar.v_volt_estimated_min[j], liar.v_volt_estimated_max[j]] == pytest.approx(
            [v] * 2, abs=1e-3
        )
        band = [liar.v_volt_band_min[j], liar.v_volt_band_max[j]]
        assert band == pytest.approx([v - 0.45, v + 0.45], abs=1e-3)
    assert liar.suspect == [False] * 4 + [True] * 2
    assert not any(honest.suspect)
    (alarm,) = found.alarms
    assert (alarm.kind, alarm.meter, alarm.t_raised, alarm.t_cleared) == (
        "meter-manipulated",
        "H3",
        T0 + 33,
        None,
    )
    assert not found.more_alarms
    # By default the last hour, and at most the wanted number of buckets.
    latest = setup.get(SERIES, params={"meter": "substation", "buckets": 10}).json()
    assert (latest["bucket_s"], latest["ticks"]) == (360.0, [6])
    assert latest["until"] >= T0 + 41


@pytest.mark.parametrize("media", [CSV, PARQUET, ARROW])
def test_series_as_a_table(setup: Setup, media: str) -> None:
    setup.calm(T0, 21)
    params = {"meter": ["H3", "H5"], "since": T0, "until": T0 + 60}
    wanted = setup.get(SERIES, params=params).json()
    response = setup.get(SERIES, params=params, headers={"Accept": media})
    if media == CSV:
        rows = list(csv.DictReader(io.StringIO(response.text)))
    elif media == PARQUET:
        rows = pq.read_table(io.BytesIO(response.content)).to_pylist()
    else:
        rows = pa.ipc.open_stream(response.content).read_all().to_pylist()
    assert [(float(row["t"]), row["meter"]) for row in rows] == [
        (t, meter) for t in wanted["t"] for meter in ("H3", "H5")
    ]
    for row, value in zip(rows[1::2], wanted["meters"][1]["v_volt_band_max"], strict=True):
        assert float(row["v_volt_band_max"]) == value
    assert set(rows[0]) >= {"t_utc", "bucket_s", "ticks", "clean_s", "meter_seen", "v_volt_reported_min"}


def test_wrong_series_are_refused(setup: Setup) -> None:
    setup.calm(T0, 1)
    assert "no meter 'zzz'" in is_problem(setup.get(f"{SERIES}?meter=H3&meter=zzz"), 404)["detail"]
    is_problem(setup.get(f"{SERIES}?meter=%3Cb%3E"), 422)
    is_problem(setup.get(f"{SERIES}?" + "&".join(f"meter=m{k}" for k in range(13))), 422)
    for since, until in ((T0, T0), (T0 + 1, T0), (T0 - 16 * 86400, T0)):
        problem = is_problem(setup.get(f"{SERIES}?meter=H3&since={since}&until={until}"), 422)
        assert "query.since: must be before until" in problem["detail"]
    is_problem(setup.get(f"{SERIES}?meter=H3&buckets=2001"), 422)
    is_problem(setup.get("/feeders/nowhere/series?meter=H3"), 404)
    # Without meters: verdicts and alarms.
    alone = models.Series.model_validate(setup.get(SERIES).json())
    assert (alone.meters, alone.ticks) == ([], [1])
    # A feeder without a tick has an empty series.
    empty = models.Series.model_validate(setup.get("/feeders/town/series?meter=H1").json())
    assert (empty.t, empty.meters[0].seen) == ([], [])


def test_the_displayed_verdict_stands_beside_the_raw_one(setup: Setup) -> None:
    report = setup.village.report(T0, cause=Cause.SILENT_METERS)
    shown = DisplayedVerdict(Decision.ATTACKED, T0 - 60, T0 - 1, Cause.RESIDUALS, "H3 is off", ("H3",))
    setup.service.tick(replace(report, displayed=shown))
    state = setup.get("/feeders/village/state").json()
    assert (state["verdict"], state["displayed"]["verdict"]) == ("undecided", "attacked")
    assert (state["displayed"]["since"], state["displayed"]["suspects"]) == (T0 - 60, ["H3"])
    one = next(f for f in setup.get("/feeders").json()["feeders"] if f["name"] == "village")
    assert (one["displayed_verdict"], one["displayed_since"]) == ("attacked", T0 - 60)

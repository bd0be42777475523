"""Powers that nobody reads, from the library's profiles: by hand, and by AC power flow."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from feeders.format.tables import read, to_json, write
from feeders.model.forecast import season_of
from feeders.model.site import (
    Site,
    Snapshot,
    forecast_errors,
    from_history,
    from_tables,
    load,
    load_doubt,
    tell,
    to_frame,
    unread,
)
from feeders.profiles import Season, library
from feeders.registry import MODAL, DesignedEstimator, choose, design
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from feeders.simulation.trial import Trial, frames
from feeders.studies.campaign.guarantees import Rehearsal, rehearse
from feeders.studies.detectable import detectable
from feeders.studies.operating import box
from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
from gridsec.estimators.front.measurements import frame_prior
from gridsec.estimators.modal.monitor import ModalDesign, ModalState
from gridsec.estimators.plant import usual
from tests.codes import refused
from tests.feeders.unmetered import CIGRE, unmetered, without
from tests.gridsec.street import ac_voltages

MONDAYS = {
    season: datetime(*day, tzinfo=UTC).timestamp()
    for season, day in {
        Season.WINTER: (2026, 1, 12),
        Season.SPRING: (2026, 4, 13),
        Season.SUMMER: (2026, 6, 1),
        Season.AUTUMN: (2026, 10, 12),
    }.items()
}
NOBODY = unmetered(CIGRE)
METERED = load("cigre-lv")
RURAL = without("simbench-lv-rural1", "LV1.101 Load 3", "LV1.101 Load 7", "LV1.101 Load 11")


def forecasting(site: Site, *, offset_h: float = 0.0, tick_s: float = 1.0, std: float | None = None) -> Site:
    """The same feeder with forecasts; what files may say of them, kW and kvar."""
    meta = site.tables.meta
    meta = replace(
        meta,
        load=replace(meta.load, forecast="profiles", utc_offset_h=offset_h),
        monitor=replace(meta.monitor, tick_s=tick_s),
    )
    rows = site.tables.customers
    if std is not None:
        rows = tuple(r if r.meter else replace(r, p_std_kw=std, q_std_kvar=0.3 * std) for r in rows)
    return from_tables(replace(site.tables, meta=meta, customers=rows))


FORECAST = forecasting(CIGRE)


def silent(site: Site, t: float) -> Snapshot:
    none = np.full(site.meters.size, np.nan)
    return Snapshot(t, none, none, none, np.nan)


# ------------------------------------------------------------------------------------------------- by hand


def mean_of(curve: Floats, kind: str, quarter: int) -> float:
    """Mean over the days of one kind, counted one by one from the Monday the library begins on."""
    kinds = ["work"] * 5 + ["saturday", "sunday"]
    return float(np.mean([curve[96 * d + quarter] for d in range(curve.size // 96) if kinds[d % 7] == kind]))


@pytest.mark.parametrize("offset_h", [0.0, 5.5])
@pytest.mark.parametrize(
    ("local", "season", "kind", "next_kind"),
    [
        (datetime(2027, 7, 15, 12, 5), Season.SUMMER, "work", "work"),
        (datetime(2024, 2, 29, 23, 50), Season.WINTER, "work", "work"),
        (datetime(2025, 10, 4, 23, 55), Season.AUTUMN, "saturday", "sunday"),
        (datetime(2025, 3, 2, 7, 0), Season.SPRING, "sunday", "sunday"),
    ],
)
def test_it_is_the_profile_of_that_season_day_and_time(
    offset_h: float, local: datetime, season: Season, kind: str, next_kind: str
) -> None:
    """Times of day, weekdays and seasons by the calendar; a customer's name is in its row."""
    site = forecasting(CIGRE, offset_h=offset_h)
    t = (local - timedelta(hours=offset_h)).replace(tzinfo=UTC).timestamp()
    frame, profiles, base = to_frame(site, silent(site, t)), library(season), site.feeder.base_kva
    minutes = 60 * local.hour + local.minute
    now, share = minutes // 15, (minutes % 15) / 15.0

    def at(curve: Floats) -> float:
        here, there = mean_of(curve, kind, now), mean_of(curve, next_kind, (now + 1) % 96)
        return (1.0 - share) * here + share * there

    for k, row in enumerate(site.tables.customers):
        pv = row.pv_kw * at(profiles.pv[row.pv_profile]) if row.pv_profile else 0.0
        p = row.load_kw * at(profiles.load_p[row.load_profile]) - pv
        factor = site.tables.meta.load.power_factor if row.power_factor is None else row.power_factor
        q = row.load_kw * np.tan(np.arccos(factor)) * at(profiles.load_q[row.load_profile])
        assert -frame.p[k] * base == pytest.approx(p, abs=1e-9)
        assert -frame.q[k] * base == pytest.approx(q, abs=1e-9)


@given(st.floats(-6e10, 2.5e11))
def test_seasons_are_those_of_the_calendar(t: float) -> None:
    month = (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=int(t))).month
    assert season_of(float(int(t))) is tuple(Season)[month % 12 // 3]


@given(st.one_of(st.floats(), st.floats(0.0, 4e9)))
def test_intervals_hold_all_that_is_possible_at_any_time(t: float) -> None:
    site, plain = FORECAST, to_frame(CIGRE, silent(CIGRE, t))
    frame, bounds, model = to_frame(site, silent(site, t)), unread(site), site.loads
    for error in (frame.p_error, bounds.p_error):
        assert (error >= frame.p_error - 1e-12).all()
    assert (bounds.q_error >= frame.q_error - 1e-12).all()
    assert (frame.p - frame.p_error <= -model.load_peak + 1e-12).all()
    assert (frame.p + frame.p_error >= model.pv_peak - 1e-12).all()
    assert (frame.q - frame.q_error <= plain.q - plain.q_error + 1e-12).all()
    assert (frame.q + frame.q_error >= plain.q + plain.q_error - 1e-12).all()


def test_readings_come_before_forecasts() -> None:
    """One meter is silent, one does not report p but q, one reports all; three customers have none."""
    v, base = CIGRE.customer_volt[CIGRE.meters], CIGRE.feeder.base_kva
    readings = Snapshot(START, v, np.array([np.nan, np.nan, 20.0]), np.array([np.nan, 4.0, 3.0]), 230.0)
    plain, frame = to_frame(CIGRE, readings), to_frame(FORECAST, readings)
    expected, read_ = to_frame(FORECAST, silent(FORECAST, START)), CIGRE.meters[2]
    for name in ("p", "p_error", "q", "q_error"):
        own = getattr(frame, name)
        assert own[read_] == getattr(plain, name)[read_]
        others = np.arange(own.size) != read_
        np.testing.assert_array_equal(own[others], getattr(expected, name)[others])
    assert frame.p_std is not None
    assert frame.q_std is not None
    assert np.flatnonzero(np.isnan(frame.p_std)).tolist() == [read_]
    assert plain.p_std is None
    assert plain.q_std is None
    assert usual(plain) is plain
    taken, reporting = usual(frame), CIGRE.meters[1]
    np.testing.assert_allclose(taken.p_error[NOBODY], np.sqrt(3.0) * frame.p_std[NOBODY])
    assert taken.q_error[reporting] == frame.q_error[reporting]
    assert frame.q_net[reporting] == -4.0 / base


def test_what_forecasts_are_off_by_is_the_files_or_the_librarys() -> None:
    """By hand: all profiles of the class on all days about the mean of one of them; the worst season."""
    base, told = CIGRE.feeder.base_kva, load_doubt(forecasting(CIGRE, std=2.0))
    np.testing.assert_allclose(told.p[NOBODY] * base, 2.0)
    np.testing.assert_allclose(told.q[NOBODY] * base, 0.6)
    found, plain = load_doubt(FORECAST), load_doubt(CIGRE)
    np.testing.assert_array_equal(found.p[~NOBODY], plain.p[~NOBODY])
    for k in np.flatnonzero(NOBODY):
        row, worst = CIGRE.tables.customers[k], {"load": 0.0, "pv": 0.0}
        for season in Season:
            profiles = library(season)
            for kind, curves, name in (
                ("load", profiles.load_p, row.load_profile),
                ("pv", profiles.pv, "PV1"),
            ):
                name = row.pv_profile if kind == "pv" and row.pv_profile else name  # noqa: PLW2901
                days = np.array(["work"] * 5 + ["saturday", "sunday"])
                mean = [mean_of(curves[name], days[d % 7], q) for d in range(7) for q in range(96)]
                off = [
                    (curve[i] - mean[i % 672]) ** 2
                    for other, curve in curves.items()
                    if other[0] == name[0]
                    for i in range(curve.size)
                    if kind == "load" or mean[i % 672] > 0.0
                ]
                worst[kind] = max(worst[kind], float(np.sqrt(np.mean(off))))
        std = np.hypot(worst["load"] * row.load_kw, worst["pv"] * row.pv_kw)
        assert found.p[k] * base == pytest.approx(std)


def test_files_say_so_only_where_they_do(tmp_path: Path) -> None:
    site = forecasting(CIGRE, offset_h=2.0)
    write(site.tables, tmp_path / "with")
    write(CIGRE.tables, tmp_path / "without")
    assert read(tmp_path / "with") == site.tables
    assert read(tmp_path / "without") == CIGRE.tables
    assert "forecast" not in (tmp_path / "without" / "feeder.toml").read_text()
    assert "forecast" not in to_json(CIGRE.tables)["feeder"]["load"]
    assert site.digest != CIGRE.digest
    assert CIGRE.forecast is None


# -------------------------------------------------------------------------------------- by AC power flow


def watched(watcher: DesignedEstimator, site: Site, scenario: Scenario) -> tuple[Floats, Floats, bool]:
    """Errors of the voltages where nobody meters, pu; over their standard deviations; and who is named."""
    state, some, named = watcher.init(scenario.start), unmetered(site), False
    samples, off, ratio = list(simulate(site, scenario)), list[Floats](), list[Floats]()
    for sample, snapshot in zip(samples, snapshots(samples), strict=True):
        state, estimate, verdict = watcher.step(state, to_frame(site, snapshot))
        assert estimate.std is not None
        error = (estimate.v2 - (sample.v_volt / site.customer_volt) ** 2)[some]
        off.append(0.5 * error)
        ratio.append(error / estimate.std[some])
        named |= bool(verdict.suspects.any())
    return np.array(off), np.array(ratio), named


def rms(values: list[Floats]) -> float:
    return float(np.sqrt(np.mean(np.square(np.concatenate(values)))))


def moment(seed: int, rng: np.random.Generator, **how: float) -> Scenario:
    """Some moment of some season, at which the calendar and the profiles that are played agree."""
    season, into = tuple(Season)[seed % 4], 7.0 * 86400.0 * rng.random()
    return Scenario(seed=seed, start=MONDAYS[season] + into, profile_s=into, season=season, **how)


@pytest.mark.canary("12-rural1")
@pytest.mark.parametrize(("site", "gain"), [(CIGRE, 0.95), (RURAL, 0.75)], ids=["cigre", "rural1"])
@pytest.mark.parametrize("count", [12, 40])
def test_forecasts_make_reconstructions_better_and_say_how_good_they_are(
    site: Site, gain: float, count: int
) -> None:
    """Three meters removed, moments of four seasons, each with meters and loads of its own.

    Ten seconds: before the observer has settled, injections are unknown, and the verdict is `settling`.
    """
    wise, rng = forecasting(site), np.random.default_rng(1)
    watchers = [(design(each), each) for each in (site, wise)]
    off, ratios = list[Floats](), list[Floats]()
    for scenario in [moment(seed, rng, duration_s=10.0) for seed in range(count)]:
        for watcher, each in watchers:
            error, ratio, named = watched(watcher, each, scenario)
            assert not named
            off.append(error[-1])
        ratios.append(ratio[-1])
    assert rms(off[1::2]) < gain * rms(off[::2])
    assert 0.5 < rms(ratios) < 1.5


@pytest.mark.canary("900.0-7200.0-cigre")
@pytest.mark.parametrize("site", [CIGRE, RURAL], ids=["cigre", "rural1"])
@pytest.mark.parametrize(("tick_s", "duration_s"), [(1.0, 60.0), (900.0, 7200.0)])
def test_nobody_honest_is_named(site: Site, tick_s: float, duration_s: float) -> None:
    """Clean minutes, and two hours of a reading every quarter of an hour."""
    wise, rng = forecasting(site, tick_s=tick_s), np.random.default_rng(2)
    watcher = design(wise)
    for seed in range(3):
        assert not watched(watcher, wise, moment(seed, rng, dt_s=tick_s, duration_s=duration_s))[2]


def test_meters_that_fall_silent_are_forecast() -> None:
    """The meters at two customers' loads stop after three readings; the doubt then is the forecast's."""
    gone, some = np.array([False, False, True, False, True, False]), np.array([2, 4])
    off: list[list[Floats]] = []
    for site in (METERED, forecasting(METERED)):
        watcher, rng, errors = design(site), np.random.default_rng(5), list[Floats]()
        for scenario in [moment(seed, rng, duration_s=6.0) for seed in range(12)]:
            state, samples = watcher.init(scenario.start), list(simulate(site, scenario))
            for sample, said in zip(samples, snapshots(samples), strict=True):
                missing = gone & (sample.t > scenario.start + 2.5)
                v, p, q = (np.where(missing, np.nan, each) for each in (said.v_volt, said.p_kw, said.q_kvar))
                state, estimate, verdict = watcher.step(
                    state, to_frame(site, replace(said, v_volt=v, p_kw=p, q_kvar=q))
                )
                assert not verdict.suspects.any()
            errors.append((estimate.v2 - (sample.v_volt / site.customer_volt) ** 2)[some])
        off.append(errors)
    # The other meters tell most of it, with the errors of their own.
    assert rms(off[1]) < min(rms(off[0]), 0.01)


def test_a_told_deviation_is_believed_although_the_interval_is_wide() -> None:
    """0.5 kW of 60: the interval of the frame is seventy times as wide, and the prior is the design's own."""
    site = forecasting(CIGRE, std=0.5)
    frame = to_frame(site, silent(site, START))
    assert (frame.p_error[NOBODY] / np.sqrt(3.0) > 4.0 * load_doubt(site).p[NOBODY]).all()
    watcher, state = design(site), None
    assert isinstance(watcher.design, ModalDesign)
    for snapshot in snapshots(simulate(site, Scenario(start=START + 216_000.0, duration_s=3.0))):
        state = watcher.init(snapshot.t) if state is None else state
        state, _, _ = watcher.step(state, to_frame(site, snapshot))
        assert isinstance(state, ModalState)
        front = watcher.design.front
        assert frame_prior(front, state.front.uncertainty) is front.prior


def test_the_bound_holds_whatever_is_forecast() -> None:
    """At 3 o'clock those whom nobody reads draw all that they may: within the frame's interval."""
    watcher = design(FORECAST)
    at, base = CIGRE.meters, CIGRE.feeder.base_volt
    start, none = START + 10_800.0, np.full(at.size, np.nan)
    state = watcher.init(start)
    for t in start + 60.0 * np.arange(6):
        p = to_frame(FORECAST, Snapshot(t, none, none, none, np.nan)).p
        p[at] = -0.2 * CIGRE.loads.load_peak[at]
        p[NOBODY] = -CIGRE.loads.load_peak[NOBODY]
        net = 0.4 * p
        x = state.front.x
        if x is not None:
            net += CIGRE.droop.per_customer(x, p.size)
        v = ac_voltages(CIGRE.feeder, p + 1j * net, 1.0)[CIGRE.feeder.bus]
        said = Snapshot(t, (v * CIGRE.customer_volt)[at], -p[at] * CIGRE.feeder.base_kva, none, base)
        frame = to_frame(FORECAST, said)
        assert (np.abs(p - frame.p) <= frame.p_error + 1e-9).all()
        assert (np.abs(0.4 * p - frame.q) <= frame.q_error + 1e-9).all()
        state, estimate, _ = watcher.step(state, frame)
        assert (np.abs(estimate.v2 - v**2) <= estimate.bound).all()


@pytest.mark.parametrize("estimator", [MODAL, "weighted-least-squares", "exact-bank"])
def test_every_estimator_takes_them(estimator: str) -> None:
    """A clean noon of June: nobody is named, no number is missing."""
    site = choose(FORECAST, estimator=estimator)
    watcher, state = design(site), None
    for snapshot in snapshots(simulate(site, Scenario(start=START + 216_000.0, duration_s=3.0))):
        state = watcher.init(snapshot.t) if state is None else state
        state, estimate, verdict = watcher.step(state, to_frame(site, snapshot))
        assert np.isfinite(estimate.v2).all()
        assert not verdict.suspects.any()


def test_in_three_phases_every_phase_has_its_part() -> None:
    site = forecasting(load("ieee-european-lv"))
    frame = to_frame(site, silent(site, START))
    kw, base = np.array([row.load_kw for row in site.tables.customers]), site.feeder.base_kva
    share = -frame.p * base / kw
    assert site.feeder.bus.size == kw.size
    for name in {row.load_profile for row in site.tables.customers}:
        same = share[[row.load_profile == name for row in site.tables.customers]]
        np.testing.assert_allclose(same, same[0])
    assert ((share > 0.0) & (share < 1.0)).all()


# --------------------------------------------------------------------------------- trials, campaigns, studies


def test_trials_have_the_forecasts_of_their_own_season() -> None:
    """Their clock is June, their profiles are a winter's evening: frames say what winter evenings are."""
    trial = Trial(FORECAST, duration_s=2.0)
    evening = 18.5 * 3600.0
    scenario = replace(trial.scenario, season=Season.WINTER, profile_s=evening)
    frame = next(iter(frames(trial, scenario)))[0]
    asked = to_frame(FORECAST, silent(FORECAST, MONDAYS[Season.WINTER] + evening))
    np.testing.assert_allclose(frame.p[NOBODY], asked.p[NOBODY])
    assert frame.p_std is not None
    assert np.isnan(frame.p_std[~NOBODY]).all()
    assert (np.abs(frame.p - unread(CIGRE).p)[NOBODY] > 0.0).all()


def test_promises_of_studies_hold_whatever_is_forecast() -> None:
    """Worst cases are those of the farthest forecast, so never less than without any."""
    half = load("cigre-lv").loads
    wide, plain = box(FORECAST), box(CIGRE)
    assert (np.abs(wide.effect) >= np.abs(plain.effect) - 1e-12).all()
    assert (unread(FORECAST).p_error <= half.load_peak + half.pv_peak).all()


@pytest.mark.canary("3")
@pytest.mark.parametrize("trials", [3, 12])
def test_smaller_lies_are_found_and_the_monitor_keeps_what_is_promised(trials: int) -> None:
    """Before errors are learned, injections of inverters without a meter decide in place of forecasts."""
    wise, plain = (detectable(site, max_attacked=1) for site in (FORECAST, CIGRE))
    # The first meter is near the busbar, and no load is known to move it.
    assert (wise.meters["found"] < plain.meters["found"])[1:].all()
    assert (wise.meters["found"] < plain.meters["found"] * (1 + 1e-3)).all()
    assert (wise.customers["error"] < plain.customers["error"]).all()
    assert rehearse(FORECAST, wise, trials=trials, seed=2) == Rehearsal(trials, 0, 0, 0)


# -------------------------------------------------------------------------------------------- from history


def test_a_first_order_process_is_recovered() -> None:
    """Oracle: an autoregressive process of known deviations, correlation time 600 s, and 0.3 in common."""
    rng, samples, count, step_s, time_s, common = np.random.default_rng(3), 20_000, 8, 60.0, 600.0, 0.3
    std_p, std_q = rng.uniform(0.5, 2.0, count), rng.uniform(0.1, 0.4, count)
    decay = np.exp(-step_s / time_s)

    def errors(std: Floats) -> Floats:
        out = np.empty((samples, count + 1))
        out[0] = rng.standard_normal(count + 1)
        for k in range(1, samples):
            out[k] = decay * out[k - 1] + np.sqrt(1.0 - decay**2) * rng.standard_normal(count + 1)
        return std * (np.sqrt(1.0 - common) * out[:, 1:] + np.sqrt(common) * out[:, :1])

    found = from_history(errors(std_p), errors(std_q), step_s)
    np.testing.assert_allclose(found.p, std_p, rtol=0.1)
    np.testing.assert_allclose(found.q, std_q, rtol=0.1)
    assert found.time_s == pytest.approx(time_s, rel=0.1)
    assert found.common_p == pytest.approx(common, abs=0.06)
    assert found.common_q == pytest.approx(common, abs=0.06)
    for wrong, code in (
        ((np.zeros((2, 3)),) * 2, "shape"),
        ((np.zeros((9, 3)), np.zeros((9, 2))), "shape"),
        ((np.full((9, 3), np.nan),) * 2, "not-finite"),
    ):
        with refused(InputInvalid, code):
            from_history(*wrong, step_s)


def test_history_becomes_the_files_and_the_design() -> None:
    """Errors about the forecasts that are put in come out, and the monitor is designed for them."""
    rng, base = np.random.default_rng(8), FORECAST.feeder.base_kva
    t = START + 900.0 * np.arange(400)
    given_p, given_q = rng.normal(0.0, 3.0, (400, 6)), rng.normal(0.0, 1.0, (400, 6))
    said = [to_frame(FORECAST, silent(FORECAST, now)) for now in t]
    drawn = [base * -np.array([getattr(frame, name) for frame in said]) for name in ("p", "q")]
    errors = forecast_errors(FORECAST, t, drawn[0] + given_p, drawn[1] + given_q)
    np.testing.assert_allclose(errors[0] * base, given_p, atol=1e-9)
    np.testing.assert_allclose(errors[1] * base, given_q, atol=1e-9)
    learned = from_history(*errors, 900.0)
    site = from_tables(tell(FORECAST.tables, learned, base))
    found = load_doubt(site)
    np.testing.assert_allclose(found.p[NOBODY], learned.p[NOBODY])
    np.testing.assert_allclose(found.q[NOBODY], learned.q[NOBODY])
    np.testing.assert_allclose(found.p[NOBODY] * base, 3.0, rtol=0.1)
    assert found.time_s == learned.time_s
    assert not np.any(found.together)
    assert [row.p_std_kw is None for row in site.tables.customers] == (~NOBODY).tolist()

"""Powers that are older than the voltage beside them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from benchmarks.late_powers import run, unchanged
from feeders.model.site import (
    SWITCHED,
    PowerAges,
    Site,
    Snapshot,
    from_tables,
    late,
    load,
    load_doubt,
    to_frame,
)
from feeders.registry import design
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.measurements import measurements, update_uncertainty
from gridsec.estimators.front.observer import predict
from gridsec.estimators.modal import doubts
from gridsec.estimators.modal.doubts import Unknown, unknown
from gridsec.estimators.modal.monitor import ModalDesign, init
from gridsec.interface import PowerOrigin
from tests.feeders.model.test_forecast import forecasting

T = 1_795_212_000.0


@pytest.fixture(scope="module")
def site() -> Site:
    return load("kerber-dorfnetz")


def stating(site: Site, interval_s: float) -> Site:
    meta = site.tables.meta
    return from_tables(
        replace(site.tables, meta=replace(meta, meters=replace(meta.meters, p_interval_s=interval_s)))
    )


def said(site: Site, kw: float = 1.0, age: float | None = None) -> Snapshot:
    p, v = np.full(site.meters.size, kw), np.full(site.meters.size, site.feeder.base_volt)
    return Snapshot(
        T, v, p, np.full(p.size, 0.1), site.feeder.base_volt, None if age is None else np.full(p.size, age)
    )


def test_the_deviation_is_that_of_a_first_order_process_and_of_a_switch(site: Site) -> None:
    """Against 400 000 draws of such a process, and of a switch between the reading and the far end."""
    row, age, kw = site.tables.customers[0], 60.0, 1.0
    sigma = (row.load_kw + row.pv_kw) / np.sqrt(12.0)
    rng = np.random.default_rng(1)
    now = rng.normal(0.0, sigma, 400_000)
    decay = np.exp(-age / site.tables.meta.load.correlation_s)
    then = decay * now + sigma * np.sqrt(1.0 - decay**2) * rng.standard_normal(now.size)
    far = max(row.load_kw - kw, kw + row.pv_kw)
    expected = np.hypot((then - now).std(), far / SWITCHED) / site.feeder.base_kva
    found = late(site, said(site, kw, age))
    assert found is not None
    assert found.std[site.meters[0]] == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("kw", [-3.0, 0.0, 1.0, 6.0])
@pytest.mark.parametrize("age", [0.5, 60.0, 200.0])
def test_intervals_hold_every_load_that_there_may_be_by_now(site: Site, kw: float, age: float) -> None:
    frame, fresh = to_frame(site, said(site, kw, age)), to_frame(site, said(site, kw))
    loads = site.loads
    inside = (-kw / site.feeder.base_kva <= loads.pv_peak) & (kw / site.feeder.base_kva <= loads.load_peak)
    for p in (loads.load_peak, -loads.pv_peak):
        assert (np.abs(-p - frame.p) <= frame.p_error + 1e-12)[inside].all()
    for q in (loads.load_peak * loads.tan_max + loads.q_floor, -loads.q_floor):
        assert (np.abs(-q - frame.q) <= frame.q_error + 1e-12)[inside].all()
    assert frame.p_std is not None
    assert fresh.p_std is None
    assert (frame.p_error >= fresh.p_error)[inside].all()
    known = inside & (frame.p_origin == PowerOrigin.LATE)
    np.testing.assert_array_equal(frame.p[known], fresh.p[known])
    assert np.isnan(frame.q_net[known]).all()


def test_age_zero_and_a_power_from_the_future_change_nothing(site: Site) -> None:
    for age in (0.0, -5.0):
        frame, fresh = to_frame(site, said(site, age=age)), to_frame(site, said(site))
        assert frame.p_std is None
        for name in ("p", "p_error", "q", "q_error", "q_net", "p_origin"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(fresh, name))


def test_a_power_older_than_it_is_worth_is_unread_and_forecast(site: Site) -> None:
    """Beyond the deviation of the range, or of the forecast, the reading is not used."""
    for where in (site, forecasting(site)):
        frame, none = to_frame(where, said(where, age=1e5)), to_frame(where, said(where, kw=np.nan))
        assert frame.p_origin is not None
        assert (frame.p_origin == PowerOrigin.UNREAD).all()
        np.testing.assert_array_equal(frame.p, none.p)
        np.testing.assert_array_equal(frame.p_error, none.p_error)
        assert np.isnan(frame.q_net).all()
        assert not np.isnan(to_frame(where, said(where)).q_net[where.meters]).any()
        if where.forecast is not None:
            assert frame.p_std is not None
            np.testing.assert_array_equal(frame.p_std, where.forecast.p_std)


@pytest.mark.parametrize("offset", [60.0, -60.0])
@pytest.mark.parametrize("age", [None, 20.0])
def test_a_power_beside_a_clock_that_is_far_off_is_of_another_moment(
    site: Site, offset: float, age: float | None
) -> None:
    """Its age is that of the offset and its own; offsets of usable readings change nothing."""
    where = np.arange(site.meters.size) == 2
    plain = said(site, age=age)
    off = replace(plain, clock_offset_s=np.where(where, offset, 15.0))
    older = np.where(where, 60.0, 0.0) + (age or 0.0)
    frame, aged, fresh = (to_frame(site, each) for each in (off, replace(plain, p_age_s=older), plain))
    for name in ("p", "p_error", "q", "q_error", "q_net", "p_std", "p_origin"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(aged, name))
    assert frame.p_error[site.meters[2]] > fresh.p_error[site.meters[2]] or age is not None
    assert frame.p_origin is not None
    assert frame.p_origin[site.meters[2]] == PowerOrigin.LATE


def test_a_stated_interval_is_in_design_and_frames_alike(site: Site) -> None:
    """No frame knows less than the design supposes, whatever the reading."""
    where = stating(site, 60.0)
    doubt = load_doubt(where)
    assert (doubt.p[where.meters] > load_doubt(site).p[where.meters]).all()
    for kw in (-3.0, 0.0, 1.0, 6.0):
        frame = to_frame(where, said(where, kw))
        assert frame.p_std is not None
        assert frame.p_origin is not None
        assert (frame.p_origin != PowerOrigin.LATE).all()
        read = frame.p_origin == PowerOrigin.READ
        # The design has a register's error at half of the peak.
        assert (frame.p_std <= 1.01 * doubt.p)[read].all()
    older = to_frame(where, said(where, age=90.0))
    assert older.p_origin is not None
    assert (older.p_origin == PowerOrigin.LATE).all()
    one, other = load_doubt(where).smooth, load_doubt(site)
    np.testing.assert_allclose(one.p, other.p)
    np.testing.assert_allclose(one.q, other.q)
    assert one.smooth is one
    assert other.sudden_p is one.sudden_p is None


def directions(site: Site, age: float) -> tuple[ModalDesign, Unknown]:
    """Unknown directions of a first frame with powers of 1 kW of an age, s."""
    made = design(site).design
    assert isinstance(made, ModalDesign)
    front, state, frame = made.front, init(made, T).front, to_frame(site, said(site, 1.0, age))
    measured = measurements(front, frame, state.trust.trusted, state.busbar.trusted, state.v0_squared)
    uncertainty = update_uncertainty(front, state.uncertainty, frame, measured.available, True)
    injected = predict(front, state, measured, uncertainty.sizes).injection_error.error
    found = unknown(front, measured, uncertainty, injected, np.zeros(injected.size, dtype=np.bool_), None)
    assert found is not None
    return made, found


def test_powers_of_a_stated_age_are_unknown_directions_of_every_frame(site: Site) -> None:
    """Each has the standard deviation of the frame beyond that of fresh powers."""
    where = stating(site, 60.0)
    (made, late), (_, fresh) = (directions(where, age) for age in (np.nan, 0.0))
    front, told = made.front, to_frame(where, said(where, 1.0, np.nan)).p_std
    assert told is not None
    at, first = front.prior.meters[0], np.array([0])
    beyond = np.sqrt(told[0] ** 2 - front.doubt.smooth.p[0] ** 2)
    assert late.places[at, 0] == pytest.approx(front.sensitivities.numbered(first)[at, 0] * beyond)
    assert late.places.shape[1] == 2 * site.meters.size
    # Fresh reactive powers are a little less certain than in the design.
    assert np.abs(fresh.places).max() < 0.2 * np.abs(late.places).max()


@pytest.mark.acceptance
def test_kettles_and_cars_accuse_no_meter_once_the_age_is_stated() -> None:
    """Powers 60 s old: without the age most ticks of these runs are open, with it none is."""
    unstated = run(0, 600, "late", "")[0]
    assert unstated["clean"] < 0.1 * unstated["ticks"]
    for stated, seed in product(("t_power", "p_interval_s"), (0, 1)):
        seen, _, of_bound = run(seed, 600, "late", stated)
        assert seen["honest"] == 0
        assert of_bound <= 1.0
        if stated == "p_interval_s":
            assert seen["named"] == seen["liars"]
            assert seen["clean"] == seen["ticks"]


@pytest.mark.canary("0")
@pytest.mark.parametrize("seed", [0, 1])
def test_kettles_and_cars_are_no_evidence_once_the_age_is_stated(seed: int) -> None:
    """Loads that change by up to 11 kW within a tick; then a third of the meters is off by 3 %."""
    seen, _, of_bound = run(seed, 300, "late", "p_interval_s")
    assert (seen["clean"], seen["honest"]) == (seen["ticks"], 0)
    assert seen["named"] == seen["liars"]
    assert of_bound <= 1.0


@pytest.mark.canary("1-rising")
@pytest.mark.parametrize("how", ["fresh", "rising"])
@pytest.mark.parametrize("seed", [0, 1])
def test_loads_that_jump_are_no_evidence(seed: int, how: str) -> None:
    """Powers of the moment: a car of 11 kW takes less reactive power than the model adds for it."""
    seen, _, of_bound = run(seed, 240, how, "")
    assert (seen["clean"], seen["honest"], seen["named"]) == (seen["ticks"], 0, seen["liars"])
    assert of_bound <= 1.0


def test_loads_jump_with_their_reported_powers(site: Site) -> None:
    """By the largest ratio of variances of a power since its last reading; not where it is metered."""
    made = design(site).design
    assert isinstance(made, ModalDesign)
    front, state = made.front, init(made, T).front
    j, root = int(made.reach[site.meters + front.customers].argmax()), np.sqrt(3.0)
    silent, gap = np.full(site.meters.size, np.nan), np.nan

    def reading(kw: float, reported: float = np.nan) -> Snapshot:
        p, q = np.ones(silent.size), silent.copy()
        p[j], q[j] = kw, reported
        return replace(said(site), p_kw=p, q_kvar=q)

    def jumps(
        *given: float | Snapshot, h: float = 1.0, factor: float = 10.0, of: FrontDesign = front
    ) -> list[float]:
        """Variances of the jumps to all snapshots, or active powers in kW, but the first."""
        out, moved = list[float](), None
        for one in given:
            frame = to_frame(site, one if isinstance(one, Snapshot) else reading(one))
            known = measurements(front, frame, state.trust.trusted, state.busbar.trusted, state.v0_squared)
            ratio, moved = doubts.jump(of, factor * made.reach, moved, known, h)
            out.append(ratio)
        assert out[0] == 0.0
        return out[1:]

    one, other, at = to_frame(site, reading(1.0)), to_frame(site, reading(4.0)), site.meters[j]
    c = abs(one.q[at] - other.q[at]) + abs(one.q_error[at] - other.q_error[at])
    share = (c / root / front.doubt.q[at]) ** 2 / (1.0 - front.doubt.common_q)
    assert 0.0 < share < 1.0
    assert jumps(1.0, 4.0, 1.0) == pytest.approx([share, share])
    # A load that rises and falls within some ticks: the parts of its error are not independent.
    rising, shift = jumps(1.0, 2.0, 3.0, 4.0, 2.5, 1.0, h=1e-6), np.array([1.0, 3.0, 5.0, 2.25, 6.75])
    assert rising == pytest.approx(share * shift / 9.0, rel=1e-5)
    # Movements a minute apart are independent.
    assert jumps(1.0, 2.5, 4.0, h=60.0) == pytest.approx([share / 4.0, share / 4.0], rel=0.01)
    # No meter would see it.
    assert jumps(1.0, 4.0, factor=1.0) == [0.0]
    sure = replace(front.doubt, q=front.doubt.q / 100.0)
    assert jumps(1.0, 4.0, of=replace(front, doubt=sure)) == [doubts.FARTHEST]
    # A power that comes back is compared with its last reading, and its first one with none.
    assert jumps(1.0, gap, gap, 4.0) == pytest.approx([0.0, 0.0, share])
    assert jumps(gap, 4.0, 4.0) == [0.0, 0.0]
    # A dip within a rise costs its own size only: parts of two watts beside those of kilowatts.
    dipped = jumps(1.0, 2.0, 3.0, 2.998, 4.0, h=1e-6)
    assert sum(dipped) == pytest.approx(share, rel=0.01)
    # Steps that no meter would see count once their sum is seen.
    slow = jumps(*np.linspace(1.0, 4.0, 31).tolist(), h=1e-6, factor=4.0)
    assert slow[0] == 0.0
    assert sum(slow) == pytest.approx(share, rel=1e-4)
    # A metered reactive power is not compared with one of the model, and has its own error.
    metered = reading(1.0, reported=0.3)
    assert jumps(1.0, metered, 1.0, metered, factor=100.0) == [0.0, 0.0, 0.0]
    assert jumps(metered, reading(1.0, reported=0.302), factor=100.0)[0] < 1e-6
    assert jumps(1.0, 4.0, of=replace(front, step_s=doubts.SUDDEN_S + 1.0)) == [0.0]
    # Powers of a stated age are unknown directions of every frame already.
    stale = replace(front.doubt, sudden_p=0.5 * front.doubt.p, sudden_q=0.5 * front.doubt.q)
    assert jumps(1.0, 4.0, of=replace(front, doubt=stale)) == [0.0]


def test_an_unchanged_power_has_the_age_of_its_first_reading(site: Site) -> None:
    """Beyond the interval and 2.5 ticks; new digits end it, a stated time or no interval avoid it."""
    ages = PowerAges(stating(site, 60.0))
    for k in range(100):
        seen = replace(said(site), t=T + k)
        seen.p_kw[1] = 1.0 + 0.01 * (k // 60)
        seen.p_kw[2] = np.nan if k % 2 else 1.0
        seen.q_kvar[3] = 0.1 + 0.01 * (k // 60)
        seen = replace(seen, p_age_s=np.where(np.arange(seen.p_kw.size) == 4, 5.0, np.nan))
        age = ages.apply(seen).p_age_s
        assert age is not None
        assert age[4] == 5.0
        assert np.isnan(age[[1, 3]]).all()
        old = k > 62
        assert age[0] == k if old else np.isnan(age[0])
        assert age[2] == k if old and k % 2 == 0 else np.isnan(age[2])
    untold = PowerAges(site)
    assert all(untold.apply(replace(said(site), t=T + k)).p_age_s is None for k in range(100))


@pytest.mark.acceptance
def test_stuck_registers_are_never_clean_for_long_and_empty_houses_cost_nothing() -> None:
    """All registers stuck from the third minute on: no voltage beside them is a check of its own."""
    seen, _, of_bound = unchanged(0, 600, "stuck", 57)
    assert seen["honest"] == 0
    assert seen["undecided"] > 60
    assert of_bound <= 1.0
    seen, _, of_bound = unchanged(0, 600, "empty", 6)
    assert seen["clean"] == 600
    assert of_bound <= 1.0

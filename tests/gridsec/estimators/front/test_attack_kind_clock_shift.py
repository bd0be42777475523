"""Readings of another time: loops, made voltages, and days of AC power flow read every quarter of an hour."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.slow_kinds import Days, Seen, lied, played, read_every, watch
from feeders.model.site import Site, load
from feeders.registry import DesignedEstimator, design
from gridsec.arrays import Floats
from gridsec.estimators.front import attack_kind
from gridsec.interface import ManipulationKind

SEEDS = st.integers(0, 2**32 - 1)
NOISE = 1e-3
MOST = 4.0 * NOISE**2
ROOM = 0.01


def walk(rng: np.random.Generator, ticks: int, size: float) -> Floats:
    """A voltage that goes where it likes."""
    return np.asarray(1.0 + np.cumsum(size * rng.standard_normal(ticks)))


def restless(rng: np.random.Generator, ticks: int) -> Floats:
    """One that is another at every tick, as in quarters of an hour."""
    return np.asarray(1.0 + 0.02 * rng.standard_normal(ticks))


def noise(rng: np.random.Generator, ticks: int) -> Floats:
    return np.asarray(NOISE * rng.standard_normal(ticks))


def found(y: Floats, model: Floats, own: Floats | None = None, heard: int = 128) -> int:
    return attack_kind.clock_shift(y, model, np.zeros_like(y) if own is None else own, heard, ROOM, MOST)


class TestLags:
    @given(seed=SEEDS, n=st.integers(2, 12), more=st.integers(1, 20), room=st.floats(0.0, 2.0))
    @settings(max_examples=50, deadline=None)
    def test_misfits_at_lags_are_those_of_a_loop(self, seed: int, n: int, more: int, room: float) -> None:
        rng = np.random.default_rng(seed)
        short, long = rng.standard_normal(n), 1.0 + rng.standard_normal(n + more)
        expected = []
        for lag in range(1, more + 1):
            stop = long.size - lag
            difference = short - long[stop - n : stop]
            level = np.clip(difference.mean(), -room, room)
            expected.append(np.mean((difference - level) ** 2))
        np.testing.assert_allclose(attack_kind._lags(short, long, room), expected, rtol=1e-9, atol=1e-12)

    @given(seed=SEEDS, n=st.integers(6, 40))
    @settings(max_examples=10, deadline=None)
    def test_the_misfit_within_a_tick_is_that_of_a_search(self, seed: int, n: int) -> None:
        """Oracle: least squares about level and slope, for many parts of a tick between -1/2 and 1/2."""
        rng = np.random.default_rng(seed)
        lie, later = rng.standard_normal(n), rng.standard_normal((2, n - 1))
        got = attack_kind._in_time(lie, later)

        def left(lie: Floats) -> float:
            basis = np.vander(np.arange(lie.size), 2)
            return float(np.mean((lie - basis @ np.linalg.lstsq(basis, lie, rcond=None)[0]) ** 2))

        parts = np.linspace(0.0, 0.5, 101)
        late = [left(lie[1:] + part * way) for part in parts for way in later]
        early = [left(lie[:-1] - part * way) for part in parts for way in later]
        best = min(left(lie), *late, *early)
        assert best * (1.0 - 1e-3) - 1e-9 <= got <= best * (1.0 + 1e-9) + 1e-12


class TestShifted:
    @pytest.mark.parametrize("lag", [-200, -40, 40, 200, 1500])
    def test_a_clock_that_is_off_is_read_from_a_slow_voltage(self, lag: int) -> None:
        for seed in range(5):
            rng = np.random.default_rng(seed)
            truth = walk(rng, 6000, 5e-4)
            model, y = (truth[k : k + 2500] + noise(rng, 2500) for k in (2000, 2000 - lag))
            assert abs(found(y, model, heard=400) - lag) <= 2
            honest = truth[2000:4500] + noise(rng, 2500)
            for lie in (0.0, 0.1, np.linspace(0.0, 0.1, 2500)):
                assert found(honest + lie, model, heard=400) == 0

    @pytest.mark.parametrize("lag", [-4, -1, 1, 4])
    @pytest.mark.parametrize("heard", attack_kind.WINDOWS)
    def test_single_ticks_from_a_restless_one(self, lag: int, heard: int) -> None:
        for seed in range(5):
            rng = np.random.default_rng(seed)
            truth = restless(rng, 1100)
            model = truth[40:1064] + noise(rng, 1024)
            assert found(truth[40 - lag : 1064 - lag] + noise(rng, 1024), model, heard=heard) == lag

    @pytest.mark.parametrize("lag", [-4, -1, 1, 4])
    def test_a_meter_whose_powers_are_as_late_as_its_voltage(self, lag: int) -> None:
        """What the others say of it rests on its power of another time."""
        for seed in range(5):
            rng = np.random.default_rng(seed)
            others, power = restless(rng, 1100), 0.03 * rng.standard_normal(1100)
            told = slice(40 - lag, 1064 - lag)
            model = others[40:1064] + power[told] + noise(rng, 1024)
            y = (others + power)[told] + noise(rng, 1024)
            assert found(y, model, power[told]) == lag
            assert found(y, model) == 0, "as a voltage alone it fits nowhere"

    def test_readings_up_to_half_a_tick_off_are_of_their_tick(self) -> None:
        for seed in range(10):
            rng = np.random.default_rng(seed)
            truth, lie = restless(rng, 601), rng.choice([-0.05, 0.05])
            model = truth[1:] + noise(rng, 600)
            for part in (0.1, 0.3, 0.5):
                late = (1.0 - part) * truth[1:] + part * truth[:-1] + noise(rng, 600)
                early = (1.0 - part) * truth[:-1] + part * truth[1:] + noise(rng, 600)
                assert found(late + lie, model) == 0
                assert found(early + lie, truth[:-1] + noise(rng, 600)) == 0

    def test_neither_steps_nor_ramps_nor_silence_nor_a_stuck_meter_are_of_another_time(self) -> None:
        for seed in range(20):
            rng = np.random.default_rng(seed)
            daily = 0.03 * np.sin(np.arange(1024) * 2.0 * np.pi / 96.0)
            truth = restless(rng, 1024) + daily
            model, honest = truth + noise(rng, 1024), truth + noise(rng, 1024)
            at, size = int(rng.integers(500, 1024)), rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.2)
            step = np.where(np.arange(1024) >= at, size, 0.0)
            ramp = size * np.clip((np.arange(1024) - 300) / (at - 300), 0.0, 1.0)
            stuck = np.where(np.arange(1024) >= 600, honest[600], honest)
            for y in (honest, honest + step, honest + ramp, honest * (1.0 + size), stuck):
                for heard in attack_kind.WINDOWS:
                    assert found(y, model, heard=heard) == 0

    def test_what_was_read_before_a_lie_began_is_not_early(self) -> None:
        """In a calm the reconstruction of now agrees with honest readings of before."""
        for seed in range(10):
            rng = np.random.default_rng(seed)
            truth = 1.0 + 0.003 * np.sin(np.arange(1100) / 300.0)
            lie = np.where(np.arange(1100) >= 1050, 0.06, 0.0)
            for now in (1055, 1070, 1100):
                y, model = ((truth + one + noise(rng, 1100))[:now] for one in (lie, 0.0))
                for heard in attack_kind.WINDOWS:
                    assert found(y, model, heard=heard) == 0

    def test_some_readings_may_be_missing_and_not_most(self) -> None:
        rng = np.random.default_rng(1)
        truth = walk(rng, 700, 0.01)
        model, y = truth[10:610] + noise(rng, 600), truth[:600] + noise(rng, 600)
        y[rng.random(600) < 0.03] = np.nan
        assert attack_kind.clock_shift(y, model, np.zeros(600), 128, ROOM, 1e-3) == 10
        y[-128::3] = np.nan
        assert attack_kind.clock_shift(y, model, np.zeros(600), 128, ROOM, 1e-3) == 0


def by_definition(y: Floats, model: Floats, own: Floats, heard: int) -> int:
    """The lag as `shifted` promises it, lag by lag, straight lines by `polyfit`."""
    n, best = y.size, (np.inf, 0)
    ways = ((y, model), (y - own, model - own))
    for says, other in ways:
        for sign, new, old in ((1, says, other), (-1, other, says)):
            for ago in range(1, n - heard + 1):
                apart = new[n - heard :] - old[n - heard - ago : n - ago]
                level = np.clip(apart.mean(), -ROOM, ROOM)
                best = min(best, (float(np.mean((apart - level) ** 2)), sign * ago), key=lambda one: one[0])
    left, lag = best
    if left > MOST:
        return 0
    last = slice(n + min(lag, 0) - heard, n + min(lag, 0))

    def rest(x: Floats) -> Floats:
        at = np.arange(x.size)
        return np.asarray(x - np.polyval(np.polyfit(at, x, 1), at))

    lie = (y - model)[last]
    least = [float(y[last].var()), float(np.mean(rest(lie) ** 2))]
    for says, other in ways:
        assert np.allclose((says - other)[last], lie)
        steps = np.diff(other[last])
        for part, way in ((lie[1:], -steps), (lie[:-1], steps)):
            a, b = rest(part), rest(way)
            theta = np.clip(a @ b / (b @ b), 0.0, 0.5)
            least.append(float(np.mean((a - theta * b) ** 2)))
    surprise = heard / 8.0 * np.log(min(least) / left)
    return lag if surprise > np.log(4 * (n - heard)) + 5.0 else 0


def test_the_lag_is_that_of_the_definition() -> None:
    """Clocks and voltages late or early, alone or with powers, of all sizes around what is just believed."""
    hits = [0, 0]
    for seed in range(400):
        rng = np.random.default_rng([9, seed])
        n, heard, lag = int(rng.integers(50, 120)), 32, int(rng.integers(-8, 9))
        others = 1.0 + np.cumsum(10.0 ** rng.uniform(-3.5, -1.5) * rng.standard_normal(n + 40))
        power = rng.choice([0.0, 1e-3, 1e-2]) * rng.standard_normal(n + 40)
        here, there = slice(20, 20 + n), slice(20 - lag, 20 - lag + n)
        whole = bool(rng.integers(2))
        own = power[there] if whole else power[here]
        model = others[here] + own + noise(rng, n)
        y = (others + power)[there] + noise(rng, n) + rng.choice([0.0, 0.0, 0.004, 0.05])
        got = attack_kind.clock_shift(y, model, own, heard, ROOM, MOST)
        assert got == by_definition(y, model, own, heard)
        hits[whole] += got != 0
    assert min(hits) > 20
    assert sum(hits) < 350


@pytest.mark.parametrize(("beyond", "expected"), [(0.0, 5), (0.9, 5), (1.1, 0)])
def test_a_level_beyond_the_room_is_left_as_far_as_an_honest_meter_leaves_it(
    beyond: float, expected: int
) -> None:
    sign = np.random.default_rng(3).choice([-1.0, 1.0], 153)
    truth = 1.0 + 0.02 * np.stack([sign, -sign], axis=1).ravel()[:305]  # whose level is the same at all times
    level = ROOM + np.sqrt(beyond * MOST)
    assert found(truth[:300] + level, truth[5:]) == expected


@pytest.fixture(scope="module")
def quarters() -> tuple[Site, DesignedEstimator, Days]:
    """Three days of a street that is read every quarter of an hour."""
    site = read_every(load("cigre-lv"), 900.0)
    return site, design(site), played(site, 4, 3.0)


class TestQuartersOfAnHour:
    """AC power flow as the truth; the measured rates are in docs/theory-front.md."""

    @pytest.mark.canary("voltage 1 tick early-clock-shift")
    @pytest.mark.parametrize(
        ("lie", "kind"),
        [
            ("clock 1 tick behind", ManipulationKind.CLOCK_SHIFT),
            ("voltage 1 tick early", ManipulationKind.CLOCK_SHIFT),
            ("the last 24 h again and again", ManipulationKind.REPLAY),
            ("stuck", ManipulationKind.STUCK),
        ],
    )
    def test_lies_over_days_are_called_what_they_are(
        self, quarters: tuple[Site, DesignedEstimator, Days], lie: str, kind: ManipulationKind
    ) -> None:
        site, watcher, days = quarters
        told, which, on = lied(site, days, lie, 4)
        seen: Seen = watch(site, watcher, told, which, on)
        assert seen.last == {int(j): str(kind) for j in which}
        assert not seen.honest
        wrong = {
            str(other)
            for other in (ManipulationKind.CLOCK_SHIFT, ManipulationKind.REPLAY, ManipulationKind.STUCK)
        } - {str(kind)}
        assert not wrong & set(seen.ticks)

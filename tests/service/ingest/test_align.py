"""Frames on the tick: late, duplicate, out of order, missing, wild clocks; replay equals live."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.ingest.align import BACKLOG_TICKS, HELD_PER_SOURCE, Aligner, Clock, ReadingOutcome, Tick, rules
from service.ingest.reading import Reading
from tests.service.ticks import plain, readings_of

T0 = 1_795_212_000.0
METERS = ("a", "b", "c", "d")
ALL = (*METERS, None)


def reading(meter: str | None, t: float, v: float = 230.0, seq: int | None = None) -> Reading:
    return Reading("village", meter, t, v, seq=seq)


def aligner(clock: Clock = Clock.WALL, tick_s: float = 1.0, **options: float) -> Aligner:
    return Aligner(METERS, rules(tick_s, options.pop("silence_s", 10.0), clock=clock, **options))


class Wall:
    """A service at wall time: readings arrive, ticks come out."""

    def __init__(self, a: Aligner, start: float = T0) -> None:
        self.a = a
        self.ticks: list[Tick] = list(a.due(start))

    def at(self, now: float, *readings: Reading) -> list[ReadingOutcome]:
        outcomes = []
        self.ticks += self.a.due(now)
        for one in readings:
            outcome, ticks = self.a.take(one, now)
            outcomes.append(outcome)
            self.ticks += ticks
        return outcomes

    def all_at(self, t: float, delay: float = 0.01, skip: tuple[str | None, ...] = ()) -> None:
        self.at(t + delay, *(reading(m, t, t - T0) for m in ALL if m not in skip))


def seen(tick: Tick) -> str:
    return "".join(m if r else "-" for m, r in zip((*METERS, "0"), readings_of(tick), strict=True))


def test_a_tick_goes_as_soon_as_all_have_reported() -> None:
    w = Wall(aligner(), T0 - 0.5)
    for meter in ALL[:-1]:
        w.at(T0 + 0.1, reading(meter, T0))
    assert not w.ticks
    w.at(T0 + 0.2, reading(None, T0, 233.0))
    (tick,) = w.ticks
    assert (tick.t, seen(tick), tick.silent) == (T0, "abcd0", ())
    assert tick.busbar_volt == 233.0


def test_never_before_its_time() -> None:
    w = Wall(aligner(), T0 - 0.9)
    w.at(T0 - 0.5, *(reading(m, T0 - 0.5) for m in ALL))
    assert not w.ticks
    w.at(T0)
    assert [seen(t) for t in w.ticks] == ["abcd0"]


def test_grace_bounds_the_wait_and_wake_says_when() -> None:
    a = aligner()
    w = Wall(a, T0 - 0.5)
    w.at(T0 + 0.1, *(reading(m, T0) for m in "abc"))
    assert a.wake() == T0 + 0.5
    w.at(T0 + 0.499)
    assert not w.ticks
    w.at(T0 + 0.5)
    assert [seen(t) for t in w.ticks] == ["abc--"]


def test_a_single_loss_is_bridged_a_second_and_third_are_not() -> None:
    w = Wall(aligner(), T0 - 0.5)
    for k in range(6):
        w.all_at(T0 + k, skip=("b",) if k in {1, 3, 4, 5} else ())
    w.at(T0 + 5.6)
    assert [seen(t) for t in w.ticks] == ["abcd0"] * 5 + ["a-cd0"]
    bridged = readings_of(w.ticks[1])[1]
    assert bridged is not None
    assert bridged.t == T0
    assert w.ticks[5].silent == ()


def test_a_quarter_of_an_hour_ago_says_nothing() -> None:
    w = Wall(aligner(tick_s=900.0), T0 - 1.0)
    w.all_at(T0, delay=5.0)
    w.all_at(T0 + 900.0, delay=5.0, skip=("b",))
    w.at(T0 + 960.0)
    assert [(t.t, seen(t)) for t in w.ticks] == [(T0, "abcd0"), (T0 + 900.0, "a-cd0")]
    assert w.ticks[1].silent == ()
    w.all_at(T0 + 1800.0, delay=5.0, skip=("b",))
    w.at(T0 + 1860.0)
    assert (seen(w.ticks[2]), w.ticks[2].silent) == ("a-cd0", (("b", 1800.0),))


def test_meters_that_miss_the_tick_a_little_in_both_directions() -> None:
    w = Wall(aligner(), T0 - 0.5)
    for k in range(5):
        at = T0 + k
        w.at(at + 0.2, *(reading(m, at + (0.04 if (i + k) % 2 else -0.04), k) for i, m in enumerate(ALL)))
    assert [[r.v_volt for r in readings_of(t)[:-1] if r] for t in w.ticks] == [[k] * 4 for k in range(5)]


def test_late_duplicate_and_out_of_order() -> None:
    a = aligner()
    w = Wall(a, T0 - 0.5)
    w.at(T0 + 0.1, *(reading(m, T0) for m in ALL if m != "d"))
    w.at(T0 + 0.6)
    assert w.at(T0 + 0.7, reading("d", T0, 1.0)) == [ReadingOutcome.LATE]
    assert w.at(T0 + 0.8, reading("d", T0, 2.0)) == [ReadingOutcome.DUPLICATE]
    assert w.at(T0 + 0.8, reading("a", T0 + 0.9), reading("a", T0 + 0.5)) == [
        ReadingOutcome.ACCEPTED,
        ReadingOutcome.OUT_OF_ORDER,
    ]
    w.at(T0 + 1.1, *(reading(m, T0 + 1) for m in ALL if m != "d"))
    w.at(T0 + 1.6)
    late = readings_of(w.ticks[1])[3]
    assert late is not None
    assert (late.t, late.v_volt) == (T0, 1.0)
    assert w.at(T0 + 1.7, reading("a", T0 + 0.5)) == [ReadingOutcome.LATE]
    assert a.counts == {
        ReadingOutcome.ACCEPTED: 9,
        ReadingOutcome.LATE: 2,
        ReadingOutcome.DUPLICATE: 1,
        ReadingOutcome.OUT_OF_ORDER: 1,
    }


def test_a_clock_that_is_off_is_refused_and_its_meter_is_silent() -> None:
    a = aligner()
    w = Wall(a, T0 - 0.5)
    outcomes = set()
    for k in range(15):
        w.all_at(T0 + k, skip=("c",))
        outcomes |= set(w.at(T0 + k + 0.02, reading("c", T0 + k + (3600.0 if k % 2 else -3600.0))))
    assert outcomes == {ReadingOutcome.CLOCK_OFF}
    w.at(T0 + 14.6)
    assert {seen(t) for t in w.ticks} == {"ab-d0"}
    assert w.ticks[-1].silent == (("c", math.inf),)


def test_silence_yields_ticks_and_names_the_silent() -> None:
    w = Wall(aligner(), T0 - 0.5)
    for k in range(30):
        w.all_at(T0 + k, skip=("b", None) if k >= 5 else ())
    w.at(T0 + 29.6)
    assert [t.t for t in w.ticks] == [T0 + k for k in range(30)]
    assert seen(w.ticks[-1]) == "a-cd-"
    assert next(t.silent for t in w.ticks if t.silent) == (("b", 11.0), (None, 11.0))
    assert w.ticks[-1].silent == (("b", 25.0), (None, 25.0))


@pytest.mark.parametrize("lag_s", [2.6, 5.0, 30.0])
@pytest.mark.parametrize("who", ["b", None])
def test_whose_readings_are_all_too_old_is_silent(lag_s: float, who: str | None) -> None:
    """A clock that is slow, though not slow enough to be refused."""
    w = Wall(aligner(), T0 - 0.5)
    for k in range(10):
        w.all_at(T0 + k)
    for k in range(10, 40):
        w.all_at(T0 + k, skip=(who,))
        assert w.at(T0 + k + 0.02, reading(who, T0 + k - lag_s))[0] is not ReadingOutcome.CLOCK_OFF
    w.at(T0 + 39.6)
    # Its last usable one is that of second 9: those of before the change are newer for as long as the lag.
    assert next((t.t - T0, t.silent) for t in w.ticks if t.silent) == (20.0, ((who, 11.0),))
    assert w.ticks[-1].silent == ((who, 30.0),)
    never = Wall(aligner(), T0 - 0.5)
    for k in range(15):
        never.all_at(T0 + k, skip=(who,))
        never.at(T0 + k + 0.02, reading(who, T0 + k - lag_s))
    never.at(T0 + 14.6)
    assert never.ticks[-1].silent == ((who, math.inf),)


def test_whoever_comes_after_all_others_is_not_silent_for_ever() -> None:
    """At long ticks a late reading is of no use for the next tick: it has to be waited for."""
    w = Wall(aligner(tick_s=900.0), T0 - 1.0)
    for k in range(8):
        at = T0 + 900.0 * k
        w.all_at(at, delay=5.0, skip=("b",))
        if k >= 4:
            w.at(at + 6.0, reading("b", at))
        w.at(at + 60.0)
    assert "".join(seen(tick)[1] for tick in w.ticks) == "-----bbb"
    assert [tick.silent for tick in w.ticks[4:]] == [(("b", math.inf),), (), (), ()]


def test_every_second_reading_lost_is_no_silence() -> None:
    w = Wall(aligner(tick_s=900.0), T0 - 1.0)
    for k in range(40):
        w.all_at(T0 + 900.0 * k, delay=5.0, skip=("b",) if k % 2 else ())
        w.at(T0 + 900.0 * k + 60.0)
    assert [seen(tick)[1] for tick in w.ticks] == ["b", "-"] * 20
    assert not any(tick.silent for tick in w.ticks)


def test_the_silent_are_not_waited_for() -> None:
    w = Wall(aligner(), T0 - 0.5)
    for k in range(20):
        w.all_at(T0 + k, skip=("b",))
    # Not silent for long yet: each tick has to wait out its grace. Silent: it goes at once.
    assert len(w.ticks) == 20


def test_no_reading_at_all() -> None:
    w = Wall(aligner(), T0)
    w.at(T0 + 20.6)
    assert {seen(t) for t in w.ticks} == {"-----"}
    assert len(w.ticks[-1].silent) == 5
    assert w.ticks[0].silent == ()


def test_a_long_gap_is_skipped_and_counted() -> None:
    a = aligner()
    w = Wall(a, T0 - 0.5)
    w.all_at(T0)
    w.at(T0 + 10 * BACKLOG_TICKS + 0.6)
    assert len(w.ticks) <= BACKLOG_TICKS + 2
    assert sum(tick.skipped for tick in w.ticks) == 10 * BACKLOG_TICKS - BACKLOG_TICKS - 1
    assert w.ticks[-1].t == T0 + 10 * BACKLOG_TICKS
    assert all(b.t > a_.t for a_, b in zip(w.ticks, w.ticks[1:], strict=False))


def test_silence_by_the_clock_of_the_readings_counts_from_the_end_of_the_skip() -> None:
    a = aligner(Clock.EVENTS)
    rows = [reading(m, T0 + k) for k in range(20) for m in ALL]
    rows += [reading(m, T0 + 2 * BACKLOG_TICKS + k) for k in range(5) for m in ALL]
    ticks = events(a, rows)
    assert sum(tick.skipped for tick in ticks) > BACKLOG_TICKS / 2
    assert sum(bool(tick.silent) for tick in ticks) > BACKLOG_TICKS - 30


def test_skipped_ticks_are_no_evidence_of_silence() -> None:
    w = Wall(Aligner(METERS, rules(1.0, 10.0, live=True)), T0 - 0.5)
    for k in range(20):
        w.all_at(T0 + k)
    leap = T0 + 7200.0
    for k in range(9):
        w.all_at(leap + k, skip=("d",))
    assert not any(tick.silent for tick in w.ticks)
    for k in range(9, 20):
        w.all_at(leap + k, skip=("d",))
    ((meter, seconds),) = w.ticks[-1].silent
    assert (meter, seconds) == ("d", w.ticks[-1].t - (T0 + 19.0))


@pytest.mark.parametrize("ahead_s", [0.0, 7200.0])
def test_silence_counts_again_after_a_leap_and_back(ahead_s: float) -> None:
    w = Wall(Aligner(METERS, rules(1.0, 10.0, live=True)), T0 - 0.5)
    w.all_at(T0)
    w.all_at(T0 + ahead_s + 1.0)
    for k in range(20):
        w.all_at(T0 + 2.0 + k, skip=("d",))
    assert [meter for meter, _ in w.ticks[-1].silent] == ["d"]


@pytest.mark.parametrize("back_s", [30.0, 3600.0, 1e6])
def test_a_clock_that_is_set_back_does_not_stop_the_ticks(back_s: float) -> None:
    w = Wall(aligner(), T0 - 0.5)
    for k in range(20):
        w.all_at(T0 + k)
    w.ticks.clear()
    start = T0 - back_s
    for k in range(20):
        w.all_at(start + k)
    assert w.a.restarts == 1
    assert [t.t for t in w.ticks] == [start + k for k in range(1, 20)]
    assert {seen(t) for t in w.ticks} == {"abcd0"}
    assert all(not t.silent for t in w.ticks)


@pytest.mark.parametrize("waited_s", [0.5, 5.0, 20.0, 100.0])
@pytest.mark.parametrize("told", [True, False])
def test_readings_that_waited_are_no_clock_set_back(waited_s: float, told: bool) -> None:
    """Rounds of three seconds' readings that lag behind the clock, and it is told what still waits or not."""
    a = aligner()
    ticks = list(a.due(T0 - 0.5))
    arrivals = [(T0 + k + 0.01, reading(m, T0 + k, 230.0, k)) for k in range(60) for m in ALL]
    size = 3 * len(ALL)
    for first in range(0, len(arrivals), size):
        for arrival, one in arrivals[first : first + size]:
            ticks += a.take(one, arrival)[1]
        wall, waiting = arrivals[first][0] + waited_s, arrivals[first + size : first + size + 1]
        ticks += a.due(min([wall, *(arrival for arrival, _ in waiting if told)]))
    ticks += a.due(T0 + 59.0 + waited_s)
    assert a.restarts == 0
    assert [t.t for t in ticks[:60]] == [T0 + k for k in range(60)]
    assert len({t.t for t in ticks}) == len(ticks)
    if told:
        assert {seen(t) for t in ticks[:60]} == {"abcd0"}
        assert a.counts == {ReadingOutcome.ACCEPTED: len(arrivals)}


def test_many_readings_between_two_ticks_are_no_overflow() -> None:
    """A reading each second where ticks are a quarter of an hour apart: each tick has the newest."""
    a, start = aligner(tick_s=900.0), 900.0 * math.ceil(T0 / 900.0)
    ticks = list(a.due(start - 0.5))
    for k in range(3601):
        for meter in ALL:
            ticks += a.take(reading(meter, start + k, 230.0, k), start + k + 0.01)[1]
    assert [t.t for t in ticks] == [start + 900.0 * k for k in range(5)]
    ages = [tick.t - one.t for tick in ticks[1:] for one in readings_of(tick, METERS) if one]
    assert ages == [1.0] * (4 * len(ALL))
    assert not a.counts[ReadingOutcome.OVERFLOW]


def test_a_reading_that_was_overtaken_is_not_lost_twice() -> None:
    w = Wall(aligner(), T0 - 0.5)
    w.at(T0 + 0.4, *(reading("a", T0 + 0.1 * k, 230.0, k) for k in (1, 3, 2, 4)))
    assert w.a.lost == 1


def test_a_small_step_back_is_waited_for() -> None:
    w = Wall(aligner(), T0 - 0.5)
    for k in (*range(20), *range(17, 30)):
        w.all_at(T0 + k)
    assert w.a.restarts == 0
    assert [t.t for t in w.ticks] == [T0 + k for k in range(30)]


def test_a_reading_from_the_future_does_not_hide_silence() -> None:
    w = Wall(aligner(), T0 - 0.5)
    w.all_at(T0)
    w.at(T0 + 0.5, reading("b", T0 + 50.0))
    for k in range(1, 20):
        w.all_at(T0 + k, skip=("b",))
    assert next(t.t - T0 for t in w.ticks if t.silent) == 11.0
    assert [meter for meter, _ in w.ticks[-1].silent] == ["b"]


def test_a_running_number_that_leaps_is_no_loss() -> None:
    w = Wall(aligner(), T0 - 0.5)
    for k, seq in enumerate((5, 2**63 - 1, 6, 7, 10)):
        w.at(T0 + k, reading("a", T0 + k, seq=seq))
    assert w.a.lost == 2


def test_gaps_in_the_running_numbers() -> None:
    a = aligner()
    w = Wall(a, T0 - 0.5)
    for k, seq in enumerate([1, 2, 5, 6, 3, 0, 1, 10]):
        w.at(T0 + 0.1, reading("a", T0 + 0.01 * k, seq=seq))
    assert a.lost == 2 + 8


def test_a_source_far_ahead_of_the_ticks_is_bounded() -> None:
    a = aligner(tick_s=0.1)
    w = Wall(a, T0 - 0.5)
    outcomes = w.at(T0 - 0.4, *(reading("a", T0 + 0.1 * k) for k in range(HELD_PER_SOURCE + 5)))
    assert outcomes.count(ReadingOutcome.OVERFLOW) == 5


# --- time told by the readings ------------------------------------------------------------------------


def events(a: Aligner, readings: list[Reading]) -> list[Tick]:
    ticks = []
    for one in readings:
        ticks += a.take(one, math.nan)[1]
    return ticks + list(a.flush())


def test_events_every_tick_once_with_everything() -> None:
    a = aligner(Clock.EVENTS)
    ticks = events(a, [reading(m, T0 + k, k) for k in range(50) for m in ALL])
    assert [t.t for t in ticks] == [T0 + k for k in range(50)]
    assert {seen(t) for t in ticks} == {"abcd0"}
    assert [[r.v_volt for r in readings_of(t)[:-1] if r] for t in ticks] == [[k] * 4 for k in range(50)]
    assert a.wake() is None


@pytest.mark.parametrize("off", [1e6, -1e6, 3600.0])
@pytest.mark.parametrize("place", [0, 2, 4])
def test_events_one_wild_clock_moves_nothing(off: float, place: int) -> None:
    wild = ALL[place]
    a = aligner(Clock.EVENTS)
    ticks = events(a, [reading(m, T0 + k + (off if m == wild else 0.0)) for k in range(30) for m in ALL])
    assert [t.t for t in ticks] == [T0 + k for k in range(30)]
    expected = "".join("-" if m == wild else (m or "0") for m in ALL)
    assert {seen(t) for t in ticks} == {expected}
    assert a.counts[ReadingOutcome.CLOCK_OFF] == 30
    swept = a.refused()
    assert all(r.meter == wild for r in swept)


def test_events_one_wild_clock_that_never_stops_talking_moves_nothing() -> None:
    a = aligner(Clock.EVENTS)
    ticks: list[Tick] = []
    for k in range(30):
        for meter in ALL:
            ticks += a.take(reading(meter, T0 + k), 0.0)[1]
        for j in range(200 if k == 10 else 0):
            assert a.take(reading("c", T0 + 86_400.0 + j), 0.0)[0] is ReadingOutcome.CLOCK_OFF
    assert not any(tick.skipped for tick in ticks)
    assert [t.t for t in ticks] == [T0 + k for k in range(30)][-len(ticks) :]
    assert len(ticks) >= 28
    assert {seen(t) for t in ticks} == {"abcd0"}


def test_events_go_on_when_most_meters_fall_silent() -> None:
    a = aligner(Clock.EVENTS)
    rows = [reading(m, T0 + k) for k in range(200) for m in (ALL if k < 20 else ("a", None))]
    ticks = events(a, rows)
    assert [t.t for t in ticks] == [T0 + k for k in range(200)]
    assert {m for m, _ in ticks[-1].silent} == {"b", "c", "d"}


def test_events_a_lost_reading_waits_for_the_next_tick_only() -> None:
    a = aligner(Clock.EVENTS)
    rows = [reading(m, T0 + k) for k in range(10) for m in ALL if (m, k) != ("c", 4)]
    got: list[tuple[float, float]] = []
    for one in rows:
        got += [(one.t, t.t) for t in a.take(one, 0.0)[1]]
    assert [t for _, t in got] == [T0 + k for k in range(10)]
    assert max(now - t for now, t in got) <= 1.0


# --- replay equals live -------------------------------------------------------------------------------


def arrivals(seed: int) -> list[tuple[float, Reading]]:
    """A rough stretch of a minute: jitter, delays, losses, duplicates, a wild clock, a silence."""
    r = random.Random(seed)
    out = []
    for k in range(60):
        for m in ALL:
            if r.random() < 0.05 or (m == "d" and 20 <= k < 40):
                continue
            t = T0 + k + r.gauss(0.0, 0.02) + (7200.0 if m == "b" and k % 17 == 3 else 0.0)
            for _ in range(2 if r.random() < 0.05 else 1):
                delay = r.expovariate(5.0) + (1.5 if r.random() < 0.05 else 0.0)
                out.append((T0 + k + delay, reading(m, t, r.random(), seq=k)))
    return sorted(out, key=lambda pair: pair[0])


@pytest.mark.parametrize("clock", list(Clock))
@pytest.mark.parametrize("seed", range(5))
def test_replay_equals_live(clock: Clock, seed: int) -> None:
    """Live, `due` is called at moments that depend on timers and batches; the ticks do not."""
    stream = arrivals(seed)
    live, replayed = aligner(clock), aligner(clock)
    r = random.Random(seed + 100)
    live_ticks, replayed_ticks = list(live.due(T0 - 0.5)), list(replayed.due(T0 - 0.5))
    now = T0 - 0.5
    for arrival, one in stream:
        while r.random() < 0.7 and now < arrival:
            now = min(arrival, now + r.expovariate(4.0))
            live_ticks += live.due(now)
        now = arrival
        live_ticks += live.take(one, arrival)[1]
        replayed_ticks += replayed.take(one, arrival)[1]
    live_ticks += live.flush() if clock is Clock.EVENTS else live.due(now + 5.0)
    replayed_ticks += replayed.flush() if clock is Clock.EVENTS else replayed.due(now + 5.0)
    assert plain(live_ticks) == plain(replayed_ticks)
    assert live.counts == replayed.counts
    assert len(live_ticks) > 55


@given(st.lists(st.tuples(st.sampled_from(ALL), st.floats(-5.0, 70.0), st.floats(0.0, 0.5)), max_size=80))
def test_whatever_arrives(stream: list[tuple[str | None, float, float]]) -> None:
    """Ticks are consecutive, use only what has arrived, and nothing older than allowed or from after."""
    a = aligner()
    now, ticks, offered = T0, list(a.due(T0)), set()
    for meter, t, pause in stream:
        now += pause
        one = reading(meter, T0 + t, t)
        outcome, more = a.take(one, now)
        if outcome is not ReadingOutcome.CLOCK_OFF:
            offered.add((meter, one.t))
        ticks += more
    ticks += a.due(now + 2.0)
    assert [t.t for t in ticks] == [T0 + k for k in range(len(ticks))]
    assert sum(a.counts.values()) == len(stream)
    for tick in ticks:
        for meter, one in zip(ALL, readings_of(tick, METERS), strict=True):
            if one is not None:
                assert one.meter == meter
                assert (meter, one.t) in offered
                assert -0.1 - 1e-6 <= tick.t - one.t < a.rules.max_age_s


# --- before the time is known -------------------------------------------------------------------------


def test_events_a_first_reading_from_the_far_future_is_forgotten() -> None:
    a = aligner(Clock.EVENTS)
    others = tuple(meter for meter in ALL if meter != "d")

    def said(*readings: Reading) -> list[tuple[ReadingOutcome, list[Tick]]]:
        return [a.take(one, math.nan) for one in readings]

    accepted = (ReadingOutcome.ACCEPTED, [])
    assert said(reading("d", T0 + 7200.0)) == [accepted]
    assert said(*(reading(meter, T0 - 0.5) for meter in others)) == [accepted] * 4
    assert [one.t for one in a.refused()] == [T0 + 7200.0]
    assert a.counts == {ReadingOutcome.ACCEPTED: 4, ReadingOutcome.CLOCK_OFF: 1}
    # The tick waits for this meter as for any other, and takes what it says now.
    assert said(*(reading(meter, T0) for meter in others)) == [accepted] * 4
    ((outcome, (tick,)),) = said(reading("d", T0, 231.0))
    assert outcome is ReadingOutcome.ACCEPTED
    assert (tick.t, seen(tick), tick.silent) == (T0, "abcd0", ())


# --- a reading in a quarter of an hour ----------------------------------------------------------------


def test_long_ticks_take_what_is_read_up_to_a_second_later() -> None:
    w = Wall(aligner(tick_s=900.0), T0 - 1.0)
    w.at(T0 + 3.0, reading("a", T0 + 0.9), reading("b", T0 + 2.0))
    w.at(T0 + 60.0)
    assert [seen(tick) for tick in w.ticks] == ["a----"]
    w.at(T0 + 960.0)
    # That of a is of the tick before; that of b is younger than a tick.
    assert [seen(tick) for tick in w.ticks[1:]] == ["-b---"]


@pytest.mark.parametrize(("off_s", "refused"), [(1700.0, False), (1900.0, True)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_clocks_of_long_ticks_may_be_off_by_two_of_them(off_s: float, sign: float, refused: bool) -> None:
    w = Wall(aligner(tick_s=900.0), T0 - 1.0)
    (outcome,) = w.at(T0, reading("a", T0 + sign * off_s))
    assert (outcome is ReadingOutcome.CLOCK_OFF) == refused

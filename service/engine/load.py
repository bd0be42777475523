"""Load of the service, and selection of the feeders that it does not monitor under lasting overload.

The demand of a feeder is ``factor (c_s n + c_t / tick_s) / capacity``: seconds of a round for each second.
n: samples offered per second. c_s: processor time of a sample. c_t: processor time of a tick. factor: that of
everything else in a round. capacity: part of the time in which no round waits for the processor, which other
threads and processes have. Samples of a feeder that is not monitored are counted: its demand stays known. The
time of its ticks is no part of c_s, c_t and factor: that of hundreds would make the others look expensive.

The measured demand of a window is the part of it that its rounds last, beyond `WAIT_S` each; the part for
decoding and alignment times the ratio of needed to processed samples. A feeder needs the offered ones, but
no more than `FLOOD` of each meter and tick: dropped ones beyond it change no verdict. It may be above the sum
of the model: threads that compete for the interpreter's lock take more time than the model has of them. The
ratio scales all demands. It falls slowly, so that feeders do not return to the same overload.

Under lasting overload whole feeders are shed until the demand of the others and of the ticks of the shed ones
is `KEPT`. They return in parts while the demand fits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from service.ingest.queues import Counts

WINDOW_S = 1.0
"""Time between two decisions, s."""
OVERLOADED = 0.9
"""Demand from which a window with losses or late rounds is one of overload."""
KEPT = 0.7
"""Demand of the monitored feeders under overload: the rest is for the receiving thread and HTTP."""
LASTING, LASTING_S = 2, 3.0
"""Consecutive windows of overload, and their time, s, before feeders are shed."""
WAIT_S = 0.01
"""Time of a round that is no demand, s: two intervals in which threads hand over the interpreter's lock."""
LONG_ROUND_S = 0.5
"""Duration of a round, s, that is a sign of overload: ticks of 1 s are late by half a tick."""
HOLD_S, HOLD_MAX_S = 1.0, 3.0
"""First and longest time from an overload to the return of feeders, s; it doubles at each new overload."""
CALM_S = 60.0
"""Time without overload after which the first hold applies again, s."""
FLOOD = 2.0
"""Samples of each meter and tick beyond which they are not needed, and a feeder is shed before all others."""
RETURNING, RETURNING_MIN = 0.25, 8
"""Largest number of feeders that return in a window: a part of the monitored ones, and at least a number.

The first ticks after a return take longer, and the cost of a tick is that of few feeders.
"""
MISSED_MAX = 3.0
"""Largest ratio of needed to processed samples: one window with few of them decides about no more feeders."""
CAPACITY_MIN = 0.1
"""Smallest capacity: a process that gets less cannot be helped by fewer feeders."""
_SMOOTH, _FALL, _SLOW = 0.3, 0.7, 0.2
"""Weights of a new window: in mean costs, in that of a tick that costs less than before, in a falling scale.

The start of many feeders at once must not make their cost look large for long.
"""


@dataclass(slots=True)
class FeederLoad:
    """Load of one feeder."""

    tick_s: float  # interval of its ticks, s
    sources: int  # number of its meters, the busbar meter included
    spent_s: float = 0.0  # processor time of its ticks in this window, s
    ticks: int = 0  # its ticks in this window
    tick_cost_s: float = 0.0  # mean time of a tick, s
    begun: bool = False  # its first tick since a start or a return, of another cost, is over
    offered: int = 0  # number of samples until this window
    dropped: int = 0  # those of them that the queues have dropped
    rate: float = 0.0  # samples offered per second
    needed: float = 0.0  # samples of this window that its ticks need
    missing: float = 0.0  # those of them that are dropped


@dataclass(slots=True)
class Window:
    """Sums of the present window."""

    begun: float
    lasted_s: float = 0.0  # duration of all rounds, s
    busy_s: float = 0.0  # that beyond `WAIT_S` of each, s
    rounds_s: float = 0.0  # processor time of all rounds, s
    placed_s: float = 0.0  # that of decoding and alignment, s
    judged_s: float = 0.0  # that of ticks of monitored feeders, s
    shed_s: float = 0.0  # that of ticks of the others, s
    samples: int = 0  # processed samples
    late: int = 0  # skipped ticks and long rounds


@dataclass
class LoadControl:
    """Selection of the feeders that are not monitored.

    clock: monotonic time, s.
    standing: True for a feeder with active alarms.
    feeders: load of each feeder, by its name.
    shed: feeders that are not monitored, in the order of the decisions.
    """

    clock: Callable[[], float]
    standing: Callable[[str], bool]
    feeders: dict[str, FeederLoad] = field(default_factory=dict)
    shed: dict[str, float] = field(default_factory=dict)
    _window: Window | None = None
    _sample_cost_s: float = 0.0
    _factor: float = 1.0
    _capacity: float = 1.0
    _shed_cost: float = 0.0  # processor time of the ticks of shed feeders, s for each second
    _scale: float = 1.0  # mean ratio of the measured to the modelled demand, at least 1
    _measured: float = 0.0  # demand of the last window
    _overloaded: int = 0  # number of consecutive windows of overload
    _since: float = 0.0  # beginning of the first of them, s
    _hold_s: float = HOLD_S
    _last: float | None = None
    _returned: bool = False  # feeders have returned since the last overload
    _first: bool = False  # feeders have returned at the last decision

    def count_round(self, lasted_s: float, rounds_s: float, placed_s: float, samples: int) -> None:
        """Add the times of a round as in `Window`, s, and the number of its samples."""
        window = self._now()
        window.lasted_s += lasted_s
        window.busy_s += max(0.0, lasted_s - WAIT_S)
        window.rounds_s += rounds_s
        window.placed_s += placed_s
        window.samples += samples
        window.late += lasted_s > LONG_ROUND_S

    def count_tick(self, feeder: str, spent_s: float, *, judged: bool = True) -> None:
        """Add the processor time of a tick, s; the first one that is judged does not count in its cost."""
        load = self.feeders[feeder]
        self.count_forming(feeder, spent_s)
        load.ticks += load.begun
        load.begun = judged and feeder not in self.shed

    def count_forming(self, feeder: str, spent_s: float) -> None:
        """Add the processor time of a part of a tick, s."""
        load, window = self.feeders[feeder], self._now()
        if feeder in self.shed:
            window.shed_s += spent_s
        else:
            window.judged_s += spent_s
        if load.begun:
            load.spent_s += spent_s

    def count_skipped(self, number: int) -> None:
        """Add skipped ticks."""
        self._now().late += number

    def _now(self) -> Window:
        if self._window is None:
            self._window = Window(self.clock())
        return self._window

    def demand(self, feeder: str) -> float:
        """Return the demand of a feeder."""
        load = self.feeders[feeder]
        cost = self._sample_cost_s * load.rate + load.tick_cost_s / load.tick_s
        return self._factor * cost / self._capacity

    def _kept(self) -> float:
        """Demand of the monitored feeders, and of the ticks of the others."""
        own = sum(self.demand(name) for name in self.feeders if name not in self.shed)
        return own + self._shed_cost / self._capacity

    def figures(self) -> dict[str, float]:
        """Return the modelled demand, that with all feeders monitored, the measured one, and their parts."""
        figures = {
            "demand": self._kept(),
            "demand_of_all": sum(self.demand(name) for name in self.feeders),
            "measured": self._measured,
            "factor": self._factor,
            "capacity": self._capacity,
        }
        return {name: round(value, 2) for name, value in figures.items()}

    def update(self, counts: Callable[[], Mapping[str, Counts]]) -> bool:
        """Decide at the end of a window; return True if `shed` has changed.

        `counts` returns the numbers of samples of each feeder so far.
        """
        window, now = self._now(), self.clock()
        elapsed = now - window.begun
        if elapsed < WINDOW_S:
            return False
        self._measure(window, elapsed, counts())
        self._window = Window(now)
        before = set(self.shed)
        for name in before - self.feeders.keys():
            del self.shed[name]
        missed, model = self._missed(), self._kept()
        placed = window.placed_s / window.rounds_s if window.rounds_s > 0.0 else 0.0
        self._measured = window.busy_s / elapsed * (1.0 + placed * (missed - 1.0))
        kept = max(model, self._measured)
        scale = kept / model if model > 0.0 else 1.0
        # The first ticks after a return last longer than later ones.
        first, self._first = self._first, False
        if (missed > 1.0 or (window.late and not first)) and kept > OVERLOADED:
            self._scale = scale
            self._overload(kept, window.begun, now)
        else:
            self._overloaded = 0
            if not first:
                self._scale += (_SMOOTH if scale > self._scale else _SLOW) * (scale - self._scale)
            if self.shed and self._last is not None and now - self._last >= self._hold_s:
                self._take_back(self._scale * model)
        if self._last is not None and now - self._last > CALM_S:
            self._hold_s = HOLD_S
        return set(self.shed) != before

    def _overload(self, kept: float, begun: float, now: float) -> None:
        """Count a window of overload; shed feeders if it lasts."""
        if not self._overloaded:
            self._since = begun
        self._overloaded += 1
        if self._last is not None and now - self._last < CALM_S and self._returned:
            self._hold_s = min(HOLD_MAX_S, 2.0 * self._hold_s)
        self._last, self._returned = now, False
        if self._overloaded >= LASTING and now - self._since >= LASTING_S:
            self._shed_more(kept, now)
            # The next windows measure the others.
            self._overloaded = 0

    def _missed(self) -> float:
        """Ratio of the needed to the processed samples of monitored feeders; from 1 to `MISSED_MAX`."""
        monitored = [load for name, load in self.feeders.items() if name not in self.shed]
        needed, missing = sum(load.needed for load in monitored), sum(load.missing for load in monitored)
        if missing <= 0.0:
            return 1.0
        return min(MISSED_MAX, needed / (needed - missing)) if missing < needed else MISSED_MAX

    def _measure(self, window: Window, elapsed: float, counts: Mapping[str, Counts]) -> None:
        if window.samples:
            cost = window.placed_s / window.samples
            self._sample_cost_s += (_SMOOTH if self._sample_cost_s else 1.0) * (cost - self._sample_cost_s)
        # Short rounds mostly wait for other threads, and yet the time between them is free.
        waited = max(0.0, window.lasted_s - window.rounds_s) / elapsed
        self._capacity += _SMOOTH * (max(CAPACITY_MIN, 1.0 - waited) - self._capacity)
        spent = window.placed_s + window.judged_s
        if spent > 0.0:
            self._factor = min(2.0, max(1.0, (window.rounds_s - window.shed_s) / spent))
        cost = window.shed_s / elapsed
        self._shed_cost = self._shed_cost + _SMOOTH * (cost - self._shed_cost) if self.shed else 0.0
        for name, load in self.feeders.items():
            number = counts.get(name, Counts(load.offered, load.dropped))
            offered, dropped = max(0, number.offered - load.offered), max(0, number.dropped - load.dropped)
            load.rate, load.offered, load.dropped = offered / elapsed, number.offered, number.dropped
            # All meters may send in the same part of a long tick.
            load.needed = min(offered, FLOOD * load.sources * max(1.0, elapsed / load.tick_s))
            load.missing = max(0.0, load.needed - max(0, offered - dropped))
            if load.ticks and name not in self.shed:
                cost = load.spent_s / load.ticks
                weight = _SMOOTH if cost > load.tick_cost_s else _FALL
                load.tick_cost_s += (weight if load.tick_cost_s else 1.0) * (cost - load.tick_cost_s)
            load.spent_s, load.ticks = 0.0, 0
        self._forget_costs()

    def _forget_costs(self) -> None:
        """Let the cost of shed feeders fall to the mean of the monitored ones, by their sources.

        It is not measured while they are shed: one that was large for a short time would keep them out.
        """
        known = [one for name, one in self.feeders.items() if name not in self.shed and one.tick_cost_s > 0.0]
        if not known:
            return
        each = sum(one.tick_cost_s for one in known) / sum(one.sources for one in known)
        for name in self.shed:
            load = self.feeders.get(name)
            if load is not None:
                load.tick_cost_s += _SMOOTH * min(0.0, each * load.sources - load.tick_cost_s)

    def _shed_more(self, kept: float, now: float) -> None:
        """Shed feeders: floods first, feeders with active alarms last. At least one stays."""

        def order(name: str) -> tuple[bool, bool, str]:
            load = self.feeders[name]
            flood = load.rate * load.tick_s > FLOOD * load.sources
            return not flood, self.standing(name), name

        monitored = sorted((name for name in self.feeders if name not in self.shed), key=order)
        for name in monitored[:-1]:
            if kept <= KEPT:
                return
            kept -= self._scale * self.demand(name)
            self.shed[name] = now

    def _take_back(self, kept: float) -> None:
        """Monitor feeders again while their demand fits, in place of their rare ticks."""
        each = self._shed_cost / self._capacity / len(self.shed)
        most = max(RETURNING_MIN, int(RETURNING * (len(self.feeders) - len(self.shed))))
        for name in list(self.shed)[:most]:
            kept += self._scale * (self.demand(name) - each)
            if kept > KEPT:
                return
            del self.shed[name]
            self._returned = self._first = True

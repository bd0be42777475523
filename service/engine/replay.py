"""Replay of a recording through the chain of the live service, by its time stamps or by its arrivals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from feeders.model.site import Site
from feeders.simulation.plant import BUSBAR
from feeders.simulation.scenario import SimulatedReading as Recorded
from gridsec.interface import Decision
from service.alarms.state_machine import AlarmBook
from service.engine.feeder_monitor import FeederMonitor, TickResult, align_rules, design, known_of
from service.ingest.align import Clock, ReadingOutcome
from service.ingest.reading import T_MAX, T_MIN, BadReason, Findings, Known, Reading, judge, to_reading
from service.store.state_codec import MonitorState


@dataclass(slots=True)
class ReplayCounts:
    """Counts of a replay: readings by outcome or reason, ticks by verdict, skipped ticks."""

    readings: Counter[str] = field(default_factory=Counter)
    ticks: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    skipped: int = 0

    @property
    def judged(self) -> int:
        """Number of ticks with a verdict other than undecided."""
        return self.ticks.total() - self.ticks[Decision.UNDECIDED]


def replay(
    site: Site,
    recorded: Iterable[Recorded],
    tally: ReplayCounts,
    *,
    clock: Clock = Clock.EVENTS,
    max_skew_s: float | None = None,
    grace_s: float | None = None,
    past: MonitorState | None = None,
    skipped: Sequence[tuple[float, float]] = (),
) -> Iterator[TickResult]:
    """Yield the service's results for recorded readings.

    recorded: readings in the order of their arrival.
    tally: filled by the replay.
    clock: source of the present time: the readings, or, as in live operation, the wall clock of their
        arrival.
    max_skew_s, grace_s: as in `align.rules`.
    past: stored state of the monitor at the start of the recording; None for none.
    skipped: first and last Unix time of ticks that the live service skipped, s; the replay skips them, too.
    Raises NotObservable, DesignInfeasible if the feeder cannot be monitored.
    """
    rules = align_rules(site, clock, max_skew_s=max_skew_s, grace_s=grace_s)
    book = AlarmBook(site.feeder.name)
    monitor = FeederMonitor(site, rules, book, past)
    monitor.install(design(site))
    known = known_of(site)
    for one in recorded:
        reading = _checked(monitor.name, known, one, tally, clock)
        if reading is not None:
            # With `Clock.EVENTS` the arrival has no effect, and a file need not contain it.
            now = one.arrival if clock is Clock.WALL else 0.0
            outcome = monitor.place(reading, now)
            tally.readings[outcome] += 1
            monitor.reach(now)
            yield from _counted(monitor, _judged(monitor, skipped), tally)
            refused = len(monitor.aligner.refused())
            tally.readings[ReadingOutcome.ACCEPTED] -= refused
            tally.readings[ReadingOutcome.CLOCK_OFF] += refused
    monitor.finish()
    yield from _counted(monitor, _judged(monitor, skipped), tally)
    tally.lost, tally.skipped = monitor.aligner.lost, monitor.skipped


def _judged(monitor: FeederMonitor, skipped: Sequence[tuple[float, float]]) -> Iterator[TickResult]:
    """Evaluate the pending ticks; a skipped one stays until the next one counts it."""
    while monitor.pending:
        t = monitor.pending[0].t
        if not any(first <= t <= last for first, last in skipped):
            yield monitor.judge()
        elif len(monitor.pending) > 1:
            monitor.skip(1)
        else:
            return


def _counted(monitor: FeederMonitor, results: Iterator[TickResult], tally: ReplayCounts) -> list[TickResult]:
    found = list(results)
    if monitor.defect is not None:
        raise monitor.defect
    tally.ticks.update(str(result.state.verdict) for result in found)
    return found


def _checked(
    feeder: str, known: Known, recorded: Recorded, tally: ReplayCounts, clock: Clock
) -> Reading | None:
    """Return a recorded reading as if received from zenoh, or None (counted) for a bad one."""
    if clock is Clock.WALL and not _is_time(recorded.arrival):
        tally.readings[BadReason.VALUE] += 1
        return None
    if recorded.meter != BUSBAR and recorded.meter not in known.meters:
        tally.readings["unknown-meter"] += 1
        return None
    fields = {
        "t": recorded.t,
        "v_volt": recorded.v_volt,
        "p_kw": recorded.p_kw,
        "q_kvar": recorded.q_kvar,
        "seq": recorded.seq,
        "v_phases": recorded.v_phases and list(recorded.v_phases),
        "t_power": recorded.t_power,
    }
    found = judge(fields, known, recorded.meter, in_batch=False)
    if isinstance(found, Findings):
        tally.readings[found.reason] += 1
        return None
    return to_reading(feeder, None if recorded.meter == BUSBAR else recorded.meter, found)


def _is_time(t: float | None) -> bool:
    return t is not None and T_MIN <= t <= T_MAX

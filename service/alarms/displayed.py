"""Displayed verdict of a feeder: the verdict after the delays of its alarms.

The raw verdict may change at every tick, as with lost readings. The displayed verdict changes with the rules
and the clocks of the alarms (`state_machine`), so that the page and the alarm list agree:

- ATTACKED after `on_delay_s` of it, CLEAN after `off_delay_s` of it. An undecided tick stops these clocks: it
  neither confirms nor refutes. CLEAN starts again after a time without an answer that displays UNDECIDED.
- UNDECIDED after `on_delay_s` without another verdict; where readings are missing, after `silence_s`.

Time is an argument. The first tick, and a tick that is not after the last one, are displayed at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from gridsec.interface import Cause, Decision
from service.alarms.state_machine import AlarmKind, AlarmRules
from service.report.report import DisplayedVerdict, FeederReport

_UNHEARD = frozenset({Cause.SILENT_METERS, Cause.NO_BUSBAR})
"""Causes of missing readings; the meters may not be silent yet."""


@dataclass(frozen=True, slots=True)
class Display:
    """State of the displayed verdict of one feeder. A value: `advance` returns a new one."""

    shown: DisplayedVerdict
    t: float  # time of the last tick, Unix s
    answer: Decision | None = None  # other verdict than the displayed one, CLEAN or ATTACKED, that waits
    onset: float = 0.0  # its first tick, Unix s
    lasted_s: float = 0.0  # its time without undecided ticks, s
    held: bool = False  # its clock stands still since an undecided tick
    undecided_since: float | None = None  # first of the undecided ticks up to the last one, Unix s


def advance(display: Display | None, rules: AlarmRules, report: FeederReport) -> Display:
    """Update the displayed verdict by one tick; None before the first one."""
    if display is None or report.t <= display.t:
        return Display(_shown(report, report.t), report.t, undecided_since=_no_answer(report, report.t))
    if report.verdict is Decision.UNDECIDED:
        after = _undecided(display, rules, report)
    else:
        after = _decided(display, rules, report)
    return replace(after, t=report.t)


def _decided(display: Display, rules: AlarmRules, report: FeederReport) -> Display:
    """The display after a tick with an answer."""
    display = replace(display, undecided_since=None)
    if report.verdict is display.shown.verdict:
        return replace(display, shown=_shown(report, display.shown.since), answer=None, held=False)
    if display.answer is not report.verdict:
        display = replace(display, answer=report.verdict, onset=report.t, lasted_s=0.0)
    else:
        display = _ticked(display, report)
    display = replace(display, held=False)
    kind = AlarmKind.METER_MANIPULATED
    delay = rules.on(kind) if report.verdict is Decision.ATTACKED else rules.off(kind)
    return _change(display, report, display.onset) if display.lasted_s >= delay else display


def _undecided(display: Display, rules: AlarmRules, report: FeederReport) -> Display:
    """The display after a tick without an answer."""
    since = report.t if display.undecided_since is None else display.undecided_since
    # The answer of a tick counts until the next one.
    display = replace(_ticked(display, report), held=True, undecided_since=since)
    lasted = report.t - since
    due = lasted >= rules.on(AlarmKind.UNDECIDED) and (
        report.cause not in _UNHEARD or lasted > rules.silence_s
    )
    if display.shown.verdict is not Decision.UNDECIDED:
        return _change(display, report, since) if due else display
    starts_again = due and display.answer is Decision.CLEAN
    return replace(
        display,
        shown=_shown(report, display.shown.since),
        answer=None if starts_again else display.answer,
    )


def _ticked(display: Display, report: FeederReport) -> Display:
    """The display with the clock of the waiting answer moved to this tick, unless it stands still."""
    if display.answer is None or display.held or report.skipped:
        return display
    return replace(display, lasted_s=display.lasted_s + report.t - display.t)


def _change(display: Display, report: FeederReport, since: float) -> Display:
    """The display of another verdict."""
    return replace(display, shown=_shown(report, since), answer=None)


def _no_answer(report: FeederReport, t: float) -> float | None:
    return t if report.verdict is Decision.UNDECIDED else None


def _shown(report: FeederReport, since: float) -> DisplayedVerdict:
    """The verdict of a report as displayed."""
    return DisplayedVerdict(
        verdict=report.verdict,
        since=since,
        t=report.t,
        cause=report.cause,
        reason=report.reason,
        suspects=report.suspects,
        inverters=tuple(inverter.customer for inverter in report.inverters if inverter.suspect),
    )

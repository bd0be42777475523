"""Displayed verdict of a feeder: the verdict after the delays of its alarms.

The raw verdict may change at every tick, as with lost readings. The displayed verdict changes with the rules
and the clocks of the alarms (`state_machine`), so that the page and the alarm list agree:

- ATTACKED after `on_delay_s` of it, CLEAN after `off_delay_s` of it. An undecided tick stops these clocks: it
  neither confirms nor refutes. CLEAN starts again after a time without an answer that displays UNDECIDED.
- UNDECIDED after `on_delay_s` without another verdict; where readings are missing, after `silence_s`.

The alarm of a manipulation may clear while CLEAN has started again: UNDECIDED is displayed then.

Time is an argument. The first tick, and a tick that is not after the last one, are displayed at once. The
clock of the verdict begins there, as that of the alarm does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from gridsec.arrays import changed
from gridsec.interface import Cause, Decision
from service.alarms.state_machine import AlarmKind, AlarmRules
from service.report.report import Judged

_UNHEARD = frozenset({Cause.SILENT_METERS, Cause.NO_BUSBAR})
"""Causes of missing readings; the meters may not be silent yet."""


class Followed(Judged, Protocol):
    """Tick with a verdict that the display follows, such as `TickState`."""

    @property
    def skipped(self) -> int:
        """Number of skipped ticks directly before."""


T = TypeVar("T", bound=Followed)


@dataclass(frozen=True, slots=True)
class Display(Generic[T]):
    """State of the displayed verdict of one feeder. A value: `advance` returns a new one."""

    newest: T  # newest tick with the displayed verdict
    since: float  # first tick of the time that led to it, Unix s
    t: float  # time of the last tick, Unix s
    answer: Decision | None = None  # CLEAN or ATTACKED during its delay; at the start it is displayed, too
    onset: float = 0.0  # its first tick, Unix s
    lasted_s: float = 0.0  # its time without undecided ticks, s
    held: bool = False  # its clock stands still since an undecided tick
    undecided_since: float | None = None  # first of the undecided ticks up to the last one, Unix s
    confirmed: bool = False  # the delay of the displayed verdict is over

    @property
    def verdict(self) -> Decision:
        """Displayed verdict."""
        return self.newest.verdict


def advance(display: Display[T] | None, rules: AlarmRules, tick: T) -> Display[T]:
    """Update the displayed verdict by one tick; None before the first one."""
    if display is None or tick.t <= display.t:
        if tick.verdict is Decision.UNDECIDED:
            return Display(tick, tick.t, tick.t, undecided_since=tick.t)
        return _decided(Display(tick, tick.t, tick.t), rules, tick)
    if tick.verdict is Decision.UNDECIDED:
        after = _undecided(display, rules, tick)
    else:
        after = _decided(display, rules, tick)
    return changed(after, t=tick.t)


def _decided(display: Display[T], rules: AlarmRules, tick: T) -> Display[T]:
    """The display after a tick with an answer."""
    display = changed(display, undecided_since=None)
    if tick.verdict is display.verdict:
        display = changed(display, newest=tick)
        if display.confirmed:
            return changed(display, answer=None, held=False)
    if display.answer is not tick.verdict:
        display = changed(display, answer=tick.verdict, onset=tick.t, lasted_s=0.0)
    else:
        display = _ticked(display, tick)
    display = changed(display, held=False)
    kind = AlarmKind.METER_MANIPULATED
    delay = rules.on(kind) if tick.verdict is Decision.ATTACKED else rules.off(kind)
    if display.lasted_s < delay:
        return display
    since = display.since if tick.verdict is display.verdict else display.onset
    return changed(display, newest=tick, since=since, answer=None, confirmed=True)


def _undecided(display: Display[T], rules: AlarmRules, tick: T) -> Display[T]:
    """The display after a tick without an answer."""
    since = tick.t if display.undecided_since is None else display.undecided_since
    # The answer of a tick counts until the next one.
    display = changed(_ticked(display, tick), held=True, undecided_since=since)
    lasted = tick.t - since
    due = lasted >= rules.on(AlarmKind.UNDECIDED) and (tick.cause not in _UNHEARD or lasted > rules.silence_s)
    if display.verdict is not Decision.UNDECIDED:
        if not due:
            return display
        # A waiting ATTACKED lasts, as the pending alarm does.
        answer = None if display.answer is Decision.CLEAN else display.answer
        return changed(display, newest=tick, since=since, answer=answer)
    starts_again = due and display.answer is Decision.CLEAN
    return changed(display, newest=tick, answer=None if starts_again else display.answer)


def _ticked(display: Display[T], tick: T) -> Display[T]:
    """The display with the clock of the waiting answer moved to this tick, unless it stands still."""
    if display.answer is None or display.held or tick.skipped:
        return display
    return changed(display, lasted_s=display.lasted_s + tick.t - display.t)

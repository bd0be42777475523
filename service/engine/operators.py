"""Actions of operators on alarms and incidents: executed between two rounds, stored as a whole or not at all.

Each method returns the result as a future, after the commit. Its errors, at once or as the result, leave
everything unchanged, except `OutcomeUnknown`: it is not known to be stored.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from gridsec.errors import GridsecError
from service.alarms.conditions import AlarmKind, Severity
from service.alarms.incidents import (
    Action,
    Assign,
    Comment,
    EndWork,
    Incident,
    IncidentChanged,
    IncidentUnknown,
    PlannedWork,
    Shelf,
    ShelfUnknown,
    Unshelve,
    WorkUnknown,
    WrongTime,
    higher,
)
from service.alarms.state_machine import (
    Alarm,
    AlarmTransition,
    AlarmUnknown,
    acknowledged,
    commented,
    ulid,
    unacknowledged,
)
from service.engine.feeder_monitor import FeederMonitor
from service.errors import IdUnknown
from service.store import OutcomeUnknown, Store
from service.store.committer import Committer, Wish

SHELVE_MOST_S = 86_400.0
"""Default of the longest time of a shelf, s: one day."""
WORK_MOST_S = 31 * 86_400.0
"""Longest planned work, s."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ShelfRequest:
    """Request of a shelf: of an alarm, of an incident, or of a feeder with a meter, a kind, or both.

    feeder: None if the alarm or the incident states it.
    severity: highest severity that is shelved; None for that of the present alarms.
    duration_s: time until its end, s.
    """

    feeder: str | None
    alarm: str | None
    incident: str | None
    meter: str | None
    kind: AlarmKind | None
    severity: Severity | None
    duration_s: float
    reason: str


class Rounds(Protocol):
    """Part of the engine that actions of operators use."""

    store: Store
    committer: Committer
    monitors: dict[str, FeederMonitor]

    def carry_over(self, alarm: Alarm) -> None:
        """Copy a stored acknowledgement, or its withdrawal, to the book and to later results."""


class Operators:
    """Actions of operators.

    engine: the state of the service.
    wall: wall clock, Unix s.
    shelve_most_s: longest time of a shelf, s.
    """

    def __init__(self, engine: Rounds, wall: Callable[[], float], shelve_most_s: float) -> None:
        self._engine, self._wall, self.shelve_most_s = engine, wall, shelve_most_s

    # ---------------------------------------------------------------------- alarms

    def acknowledge(self, alarms: Sequence[str], who: str, comment: str) -> Future[list[Alarm]]:
        """Acknowledge alarms; those that are acknowledged already stay. Raises AlarmUnknown."""
        return self._change(alarms, self._acknowledging(who, comment))

    def unacknowledge(self, alarm: str, who: str, comment: str) -> Future[list[Alarm]]:
        """Withdraw the acknowledgement of an alarm. Raises AlarmUnknown, NotAcknowledged."""
        t = self._wall()
        return self._change([alarm], lambda one: unacknowledged(one, who, comment, t))

    def comment(self, alarm: str, who: str, comment: str) -> Future[list[Alarm]]:
        """Add a comment to an alarm. Raises AlarmUnknown."""
        t = self._wall()
        return self._change([alarm], lambda one: commented(one, who, comment, t))

    def _acknowledging(self, who: str, comment: str) -> Callable[[Alarm], AlarmTransition | None]:
        t = self._wall()
        return lambda one: acknowledged(one, who, comment, t) if one.acknowledged_by is None else None

    def _change(
        self, alarms: Sequence[str], change: Callable[[Alarm], AlarmTransition | None]
    ) -> Future[list[Alarm]]:
        answer: Future[list[Alarm]] = Future()

        def store(found: Mapping[str, Alarm]) -> None:
            missing = [name for name in alarms if name not in found]
            if missing:
                raise AlarmUnknown(missing[0])
            self._store([found[name] for name in alarms], change, answer, lambda _, changed: changed)

        self._look(partial(_alarms, ids=alarms), store, answer)
        return answer

    def _store(
        self,
        alarms: Iterable[Alarm],
        change: Callable[[Alarm], AlarmTransition | None],
        answer: Future[T],
        read: Callable[[Store, list[Alarm]], T],
    ) -> None:
        """Store changes of alarms, and read the result; books in memory are newer than the database."""
        held = {one.id: one for monitor in self._engine.monitors.values() for one in monitor.book.alarms}
        present = [held.get(alarm.id, alarm) for alarm in alarms]
        changed = [(alarm, change(alarm)) for alarm in present]
        transitions = [transition for _, transition in changed if transition is not None]
        after = [alarm if transition is None else transition.alarm for alarm, transition in changed]

        def landed(found: T | None) -> None:
            for transition in transitions:
                self._engine.carry_over(transition.alarm)
            _give(answer, found)

        self._engine.committer.store_and_read(
            Wish(tuple(transitions)), lambda db: read(db, after), landed, partial(_refuse, answer)
        )

    # ------------------------------------------------------------------- incidents

    def acknowledge_incident(
        self, incident: str, who: str, comment: str, *, count: int | None = None
    ) -> Future[Incident]:
        """Acknowledge all active alarms of an incident.

        `count` is the number of raisings that the operator has seen; None: all. Raises IncidentUnknown,
        IncidentChanged.
        """
        return self._answer_incident(incident, self._acknowledging(who, comment), count)

    def unacknowledge_incident(self, incident: str, who: str, comment: str) -> Future[Incident]:
        """Withdraw the acknowledgements of all active alarms of an incident. Raises IncidentUnknown."""
        t = self._wall()

        def change(one: Alarm) -> AlarmTransition | None:
            return None if one.acknowledged_by is None else unacknowledged(one, who, comment, t)

        return self._answer_incident(incident, change, None)

    def _answer_incident(
        self, incident: str, change: Callable[[Alarm], AlarmTransition | None], count: int | None
    ) -> Future[Incident]:
        answer: Future[Incident] = Future()

        def store(found: tuple[Incident, list[Alarm]]) -> None:
            seen, alarms = found
            if count is not None and count != seen.count:
                raise IncidentChanged(seen, count)
            active = [one for one in alarms if one.active]
            self._store(active, change, answer, lambda db, _: db.incident(incident) or seen)

        self._look(partial(_incident_with_alarms, number=incident), store, answer)
        return answer

    def assign(self, incident: str, to: str | None, who: str, comment: str) -> Future[Incident]:
        """Assign an incident; `to` None withdraws it. Raises IncidentUnknown."""
        return self._act_on(incident, lambda one: Assign(one.feeder, incident, to, who, comment))

    def comment_incident(self, incident: str, who: str, comment: str) -> Future[Incident]:
        """Add a comment to an incident. Raises IncidentUnknown."""
        return self._act_on(incident, lambda one: Comment(one.feeder, incident, who, comment))

    def _act_on(self, incident: str, action: Callable[[Incident], Action]) -> Future[Incident]:
        return self._act(lambda db: action(_incident(db, incident)), lambda db, _: _incident(db, incident))

    # ---------------------------------------------------------- shelves, planned work

    def shelve(self, request: ShelfRequest, who: str) -> Future[Shelf]:
        """Shelve alarms. Raises AlarmUnknown, IncidentUnknown, WrongTime."""
        t = self._wall()
        if not 0.0 < request.duration_s <= self.shelve_most_s:
            text = f"duration_s: expected more than 0 and at most {self.shelve_most_s:g} s"
            raise WrongTime(text)

        def action(db: Store) -> Shelf:
            feeder, alarms = _shelved_alarms(db, request)
            return Shelf(
                id=ulid(t, "shelf", secrets.token_hex(8)),
                feeder=feeder,
                alarm=request.alarm,
                incident=request.incident,
                meter=request.meter,
                kind=request.kind,
                severity=request.severity or _highest(alarms),
                who=who,
                reason=request.reason,
                t=t,
                until=t + request.duration_s,
            )

        return self._act(action, lambda db, made: _known(db.shelf(made.id), ShelfUnknown(made.id)))

    def unshelve(self, shelf: str, who: str, comment: str) -> Future[Shelf]:
        """End a shelf. Raises ShelfUnknown: it does not exist, or has ended."""

        def action(db: Store) -> Unshelve:
            found = db.shelf(shelf)
            if found is None or found.t_ended is not None:
                raise ShelfUnknown(shelf)
            return Unshelve(found.feeder, shelf, who, comment)

        return self._act(action, lambda db, _: _known(db.shelf(shelf), ShelfUnknown(shelf)))

    def plan_work(
        self, feeder: str, t_from: float | None, t_until: float, who: str, reason: str
    ) -> Future[PlannedWork]:
        """Enter planned work on a feeder; `t_from` None: from now on. Raises WrongTime."""
        t = self._wall()
        t_from = t if t_from is None else t_from
        if not max(t, t_from) < t_until <= max(t, t_from) + WORK_MOST_S:
            text = f"t_until: expected a time after t_from and now, within {WORK_MOST_S / 86_400.0:g} days"
            raise WrongTime(text)
        work = PlannedWork(ulid(t, "work", secrets.token_hex(8)), feeder, t_from, t_until, who, reason, t)
        return self._act(lambda _: work, lambda db, _: _known(db.work(work.id), WorkUnknown(work.id)))

    def end_work(self, work: str, who: str, comment: str) -> Future[PlannedWork]:
        """End planned work, or cancel it. Raises WorkUnknown: it does not exist, or has ended."""

        def action(db: Store) -> EndWork:
            found = db.work(work)
            if found is None or found.t_ended is not None:
                raise WorkUnknown(work)
            return EndWork(found.feeder, work, who, comment)

        return self._act(action, lambda db, _: _known(db.work(work), WorkUnknown(work)))

    # ------------------------------------------------------------------------ steps

    def _act(self, action: Callable[[Store], Any], read: Callable[[Store, Any], T]) -> Future[T]:
        """Make an action from the stored state, store it, and read its result after the commit."""
        answer: Future[T] = Future()

        def look(db: Store) -> Any:
            try:
                return action(db)
            except GridsecError as error:
                return error

        def store(made: Any) -> None:
            if isinstance(made, GridsecError):
                raise made

            self._engine.committer.store_and_read(
                Wish(actions=(made,)),
                lambda db: read(db, made),
                lambda found: _give(answer, found),
                partial(_refuse, answer),
            )

        self._look(look, store, answer)
        return answer

    def _look(self, read: Callable[[Store], T], then: Callable[[T], None], answer: Future[Any]) -> None:
        """Read, then continue; errors become the result."""

        def run(found: Any) -> None:
            try:
                if isinstance(found, GridsecError):
                    raise found
                then(found)
            except GridsecError as error:
                _refuse(answer, error)

        def guarded(db: Store) -> Any:
            try:
                return read(db)
            except IdUnknown as error:
                return error

        self._engine.committer.look(guarded, run, partial(_refuse, answer))


def _alarms(db: Store, ids: Iterable[str]) -> dict[str, Alarm]:
    found = ((name, db.alarm(name)) for name in ids)
    return {name: alarm for name, alarm in found if alarm is not None}


def _incident(db: Store, number: str) -> Incident:
    return _known(db.incident(number), IncidentUnknown(number))


def _incident_with_alarms(db: Store, number: str) -> tuple[Incident, list[Alarm]]:
    return _incident(db, number), db.alarms_of(number)


def _known(found: T | None, error: GridsecError) -> T:
    if found is None:
        raise error
    return found


def _shelved_alarms(db: Store, request: ShelfRequest) -> tuple[str, list[Alarm]]:
    """The feeder of a shelf, and its alarms: the active ones, else the newest one."""
    if request.alarm is not None:
        alarm = _known(db.alarm(request.alarm), AlarmUnknown(request.alarm))
        return alarm.feeder, [alarm]
    if request.incident is not None:
        return _incident(db, request.incident).feeder, db.alarms_of(request.incident)
    feeder = request.feeder or ""
    kind = () if request.kind is None else (request.kind,)
    wanted: dict[str, Any] = {"feeder": feeder, "meter": request.meter, "kind": kind}
    active = db.alarms(**wanted, state=("raised", "acknowledged"), limit=1000)[0]
    return feeder, active or db.alarms(**wanted, limit=1)[0]


def _highest(alarms: Iterable[Alarm]) -> Severity:
    """The highest severity of alarms; `minor` without any."""
    found = Severity.MINOR
    for alarm in alarms:
        found = alarm.severity if higher(alarm.severity, found) else found
    return found


def _give(answer: Future[T], found: T | None) -> None:
    """Set the result of a stored action; None if it could not be read after the commit."""
    if found is None:
        _refuse(answer, OutcomeUnknown("the change is stored; its result cannot be read"))
    elif not answer.done():
        answer.set_result(found)


def _refuse(answer: Future[Any], error: GridsecError) -> None:
    if not answer.done():
        answer.set_exception(error)

"""Deliveries: order, back-off, dead letters, positions, kill -9; with a real store and a real server."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.alarms.state_machine import AlarmKind, AlarmState, AlarmTransition, Change, Severity
from service.metrics import Metrics
from service.notify.delivery import (
    BACKOFF_MOST_S,
    BACKOFF_S,
    POLL_S,
    REFUSALS,
    Delivery,
    Notifier,
    WebhookChannel,
    backoff_s,
    channel_of,
)
from service.notify.notices import IncidentSource
from service.notify.post import Cancel
from service.notify.targets import Targets, Webhook
from service.notify.webhook import secret_bytes, signature
from service.store import Store, StoreUnavailable
from service.store.deliveries import DeliveryStore, Position
from tests.service.databases import Cluster
from tests.service.receiver import Receiver, receiving
from tests.service.running import until
from tests.service.stored import T0, an_alarm, raised

SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
KEY = secret_bytes(SECRET) or b""


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with receiving() as made:
        yield made


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(f"sqlite:///{tmp_path}/grid.db") as made:
        yield made


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[DeliveryStore]:
    with DeliveryStore(f"sqlite:///{tmp_path}/grid.db") as made:
        yield made


def hook(receiver: Receiver, **changes: Any) -> Webhook:
    fields = {
        "name": "hook",
        "url": receiver.url,
        "secret": SECRET,
        "private_addresses": True,
        "timeout_s": 5.0,
    }
    return Webhook.model_validate(fields | changes)


class Course:
    """Deliveries to one target by a clock of the test."""

    def __init__(self, target: Webhook, store: Store, kept: DeliveryStore) -> None:
        self.target, self.store, self.kept, self.now = target, store, kept, T0
        self.counted: dict[str, int] = {}
        self.restart()

    def restart(self) -> None:
        """Begin anew from the stored position, as after kill -9."""
        stored = self.kept.positions().get(self.target.name)
        self.delivery = Delivery(
            channel_of(self.target, ""),
            IncidentSource(self.store),
            self.kept,
            stored,
            random=lambda: 0.5,
            count=self.count,
        )

    def count(self, outcome: str, number: int) -> None:
        self.counted[outcome] = self.counted.get(outcome, 0) + number

    def run(self, seconds: float) -> None:
        """Make all steps that are due within a time."""
        end = self.now + seconds
        while self.now <= end:
            self.now = max(self.delivery.step(self.now), self.now + 1e-3)
        self.now = end


@pytest.fixture
def course(receiver: Receiver, store: Store, kept: DeliveryStore) -> Course:
    store.commit([raised(an_alarm(0))])  # before the target exists
    made = Course(hook(receiver), store, kept)
    made.run(0.0)
    return made


def numbers(receiver: Receiver) -> list[int]:
    return [json.loads(each.body)["data"]["seq"] for each in receiver.got]


def raise_some(store: Store, *which: int) -> None:
    """Raise alarms, each of a feeder of its own: each opens an incident."""
    for number in which:
        store.commit([raised(an_alarm(number, feeder=f"feeder-{number}"))])


# ------------------------------------------------------------------------------------------------- messages


def test_a_message_is_signed_and_has_the_event(course: Course, receiver: Receiver) -> None:
    raise_some(course.store, 1)
    course.run(1.0)
    (got,) = receiver.got
    message = json.loads(got.body)
    assert (message["type"], message["timestamp"]) == ("incident.opened", "2026-11-20T22:00:01.000Z")
    event, (incident,) = message["data"], course.store.incidents(feeder="feeder-1")[0]
    assert (event["seq"], event["change"], event["incident"]["id"]) == (2, "opened", incident.id)
    assert (event["incident"]["meters"], event["incident"]["reason"]) == (["m1"], an_alarm(1).reason)
    name, when = got.headers["webhook-id"], got.headers["webhook-timestamp"]
    assert name == f"msg_{incident.id}_2"
    assert T0 <= float(when) <= T0 + 1.0
    assert got.headers["webhook-signature"] == f"v1,{signature(KEY, name, when, got.body)}"


def test_a_new_target_begins_after_the_newest_event(course: Course, receiver: Receiver) -> None:
    assert receiver.got == []
    assert course.kept.positions()["hook"].position == 1
    assert course.delivery.waiting == 0


def test_filters_select_and_move_the_position(receiver: Receiver, store: Store, kept: DeliveryStore) -> None:
    target = hook(receiver, severities=["major"], kinds=["data-loss"], feeders=["town"], changes=["opened"])
    course = Course(target, store, kept)
    wanted = an_alarm(1, kind=AlarmKind.DATA_LOSS, severity=Severity.MAJOR, feeder="town")
    wrong: tuple[dict[str, Any], ...] = (
        {"kind": AlarmKind.UNDECIDED},
        {"severity": Severity.MINOR},
        {"feeder": "village"},
    )
    for k, changes in enumerate(wrong):
        # Hours before: no common incident.
        early = {"t_event": T0 - 7200.0 * (k + 1), "t_raised": T0 - 7200.0 * (k + 1)}
        store.commit([raised(replace(wanted, id=f"{k + 2:026d}", **early, **changes))])
    store.commit([raised(wanted)])
    cleared = replace(wanted, state=AlarmState.CLEARED, t_cleared=T0 + 9.0)
    store.commit([AlarmTransition(cleared, Change.CLEARED, T0 + 9.0)])
    course.run(20.0)
    assert numbers(receiver) == [4]
    assert kept.positions()["hook"].position == 5


# ------------------------------------------------------------------------------------------ order and waits


@settings(max_examples=25)
@given(st.integers(1, 60), st.floats(0.0, 1.0, exclude_max=True))
def test_the_back_off_doubles_with_jitter(failures: int, u: float) -> None:
    wait = backoff_s(failures, u)
    most = min(BACKOFF_MOST_S, BACKOFF_S * 2.0 ** (failures - 1))
    assert 0.5 * most <= wait <= most
    assert backoff_s(failures, 0.0) <= wait


def test_failures_keep_the_order_and_the_message_id(course: Course, receiver: Receiver) -> None:
    receiver.answers.extend([503, 500, 429])
    raise_some(course.store, 1, 2, 3)
    course.run(60.0)
    assert numbers(receiver) == [2, 2, 2, 2, 3, 4]
    assert len({each.headers["webhook-id"] for each in receiver.got[:4]}) == 1
    times = [float(each.headers["webhook-timestamp"]) for each in receiver.got]
    # Waits of 0.75, 1.5 and 3 s for a random number of 0.5, in whole seconds.
    waits = [b - a for a, b in pairwise(times[:4])]
    assert waits == pytest.approx([0.75, 1.5, 3.0], abs=1.0)
    assert course.counted == {"delivered": 3, "failed": 3}
    now = course.kept.positions()["hook"]
    assert (now.position, now.failing_since, now.attempts, now.problem) == (4, None, 0, None)


def test_retry_after_is_followed(course: Course, receiver: Receiver) -> None:
    receiver.answers.append((429, {"Retry-After": "40"}))
    raise_some(course.store, 1)
    course.run(39.0)
    assert numbers(receiver) == [2]
    course.run(2.0)
    assert numbers(receiver) == [2, 2]


def test_a_refused_message_becomes_a_dead_letter_and_the_next_one_follows(
    course: Course, receiver: Receiver
) -> None:
    receiver.answers.extend([400] * REFUSALS)
    raise_some(course.store, 1, 2)
    course.run(30.0)
    assert numbers(receiver) == [2] * REFUSALS + [3]
    (letter,) = course.kept.letters()
    assert (letter.target, letter.number, letter.attempts, letter.resend) == ("hook", 2, REFUSALS, False)
    assert letter.problem == "status 400 Bad Request: no"
    assert letter.body == receiver.got[0].body.decode()
    assert course.counted == {"failed": REFUSALS, "dead": 1, "delivered": 1}
    assert course.delivery.dead == 1


def test_a_dead_letter_is_sent_again_with_its_id_and_then_deleted(course: Course, receiver: Receiver) -> None:
    receiver.answers.extend([400] * REFUSALS)
    raise_some(course.store, 1)
    course.run(30.0)
    assert course.kept.resend(target="other") == 0
    assert course.kept.resend(ids=[1]) == 1
    receiver.answers.append(410)
    course.run(2.0 * POLL_S)
    (letter,) = course.kept.letters()
    assert (letter.resend, letter.attempts, letter.problem) == (False, REFUSALS + 1, "status 410 Gone: no")
    assert course.kept.resend() == 1
    course.run(2.0 * POLL_S)
    assert course.kept.letters() == []
    assert numbers(receiver) == [2] * (REFUSALS + 2)
    assert len({each.headers["webhook-id"] for each in receiver.got}) == 1
    assert course.counted["resent"] == 1


@pytest.fixture
def rare_polls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.notify.delivery.POLL_S", 100.0)


@pytest.mark.acceptance
@pytest.mark.usefixtures("rare_polls")
def test_a_target_that_is_down_gets_everything_after_it_is_back(course: Course, receiver: Receiver) -> None:
    receiver.always = 503
    raise_some(course.store, *range(1, 21))
    course.run(3000.0)
    assert set(numbers(receiver)) == {2}
    assert course.kept.letters() == []
    assert course.kept.positions()["hook"].failing_since == pytest.approx(T0, abs=1.0)
    receiver.always = None
    course.run(2.0 * BACKOFF_MOST_S)
    assert numbers(receiver)[-20:] == list(range(2, 22))


@pytest.mark.usefixtures("rare_polls")
def test_messages_to_a_target_that_stays_down_are_given_up_by_age(course: Course, receiver: Receiver) -> None:
    receiver.always = 503
    raise_some(course.store, 1, 2)
    course.run(course.target.give_up_s + 2.0 * BACKOFF_MOST_S)
    young = an_alarm(3, t_event=course.now, t_raised=course.now, feeder="feeder-3")
    course.store.commit([raised(young)])
    course.run(10.0 * BACKOFF_MOST_S)
    letters = course.kept.letters()
    assert [each.number for each in letters] == [2, 3]
    assert all(each.attempts >= 1 for each in letters)
    receiver.always = None
    course.run(2.0 * BACKOFF_MOST_S)
    assert numbers(receiver)[-1] == 4


# -------------------------------------------------------------------------------------- restarts and faults


def test_a_killed_process_repeats_at_most_one_message(course: Course, receiver: Receiver) -> None:
    raise_some(course.store, 1, 2, 3, 4)
    for _ in range(2):
        course.delivery.step(course.now)
    course.restart()
    course.run(5.0)
    assert numbers(receiver) == [2, 3, 4, 5]
    receiver.answers.append(503)
    raise_some(course.store, 5)
    course.delivery.step(course.now)
    assert course.kept.positions()["hook"].attempts == 1
    course.restart()
    course.run(5.0)
    assert numbers(receiver)[4:] == [6, 6]


def test_a_position_beyond_the_newest_event_is_set_back(
    receiver: Receiver, store: Store, kept: DeliveryStore
) -> None:
    """The events were restored from an older backup."""
    kept.keep("hook", Position(99))
    course = Course(hook(receiver), store, kept)
    raise_some(store, 1)
    course.run(1.0)
    assert numbers(receiver) == [1]


def test_a_position_that_cannot_be_stored_stops_no_message(
    course: Course, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise StoreUnavailable("disk full", code="write-failed")

    receiver.answers.extend([400] * REFUSALS)
    with monkeypatch.context() as patch:
        patch.setattr(course.kept, "keep", fail)
        raise_some(course.store, 1, 2)
        course.run(20.0)
        assert numbers(receiver) == [2] * REFUSALS + [3]
        assert course.kept.positions()["hook"].position == 1
    course.run(3.0)
    assert course.kept.positions()["hook"].position == 3
    assert len(course.kept.letters()) == 1


@pytest.mark.acceptance
def test_kill_minus_9_loses_no_message(tmp_path: Path, receiver: Receiver) -> None:
    """A process that delivers is killed at random moments; every event arrives, in order."""
    program = """
import sys, time
from service.store import Store
from service.notify.delivery import Notifier
from service.notify.notices import IncidentSource
from service.notify.targets import Targets
from service.metrics import Metrics
from service.store.deliveries import DeliveryStore
from tests.service.stored import an_alarm, raised
url, hook, first = sys.argv[1], sys.argv[2], int(sys.argv[3])
with Store(url) as store, DeliveryStore(url) as kept:
    target = {"name": "hook", "url": hook, "secret": "SECRET", "private_addresses": True}
    notifier = Notifier(Targets.model_validate({"webhook": [target]}), IncidentSource(store), kept, Metrics())
    notifier.start()
    for k in range(first, first + 1000):
        store.commit([raised(an_alarm(k, feeder=f"feeder-{k}"))])
        print(store.last_incident_event, flush=True)
        notifier.wake()
        time.sleep(0.01)
""".replace("SECRET", SECRET)
    stored = 0
    for life in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", program, f"sqlite:///{tmp_path}/g.db", receiver.url, str(1000 * life)],
            stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(Path.cwd())},
        ) as child:  # fmt: skip
            assert child.stdout is not None
            for _ in range(20 + 13 * life):
                stored = int(child.stdout.readline())
            child.send_signal(signal.SIGKILL)
            # Lines that were written before the end.
            stored = max([stored, *map(int, child.stdout.read().split())])
    with Store(f"sqlite:///{tmp_path}/g.db") as store, DeliveryStore(f"sqlite:///{tmp_path}/g.db") as kept:
        last = store.last_incident_event
        course = Course(hook(receiver), store, kept)
        course.run(30.0)
    assert last >= stored
    got = numbers(receiver)
    assert sorted(set(got)) == list(range(1, last + 1))
    assert len(got) <= last + 3  # at most one repetition per kill
    assert all(b - a in {0, 1} for a, b in pairwise(got))


# -------------------------------------------------------------------------------------------------- threads


def test_a_target_that_does_not_answer_delays_no_other(
    receiver: Receiver, store: Store, kept: DeliveryStore
) -> None:
    release = threading.Event()
    with receiving() as stuck:
        stuck.answers.append(lambda _: release.wait(20.0) and None)
        targets = Targets(webhook=(hook(stuck, name="stuck"), hook(receiver, name="good")))
        metrics = Metrics()
        notifier = Notifier(targets, IncidentSource(store), kept, metrics)
        notifier.start()
        try:
            raise_some(store, 1, 2)
            notifier.wake()
            until(lambda: len(receiver.got) == 2, patience_s=10.0)
            status = {each.name: each for each in notifier.status()}
            until(lambda: notifier.status()[1].position == 2, patience_s=10.0)
            assert (status["stuck"].position, status["stuck"].waiting) == (0, 2)
            assert status["stuck"].host == "127.0.0.1"
            text = metrics.exposition().decode()
            assert 'gridsec_notifications_total{outcome="delivered",target="good"} 2.0' in text
        finally:
            begun = time.monotonic()
            notifier.close()
            release.set()
        assert time.monotonic() - begun < 0.5
        # The end of the service is no failure of the target.
        time.sleep(0.2)
        assert notifier.status()[0].failing_since is None


def test_an_unexpected_error_ends_no_thread(
    receiver: Receiver, store: Store, kept: DeliveryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = iter([ValueError("defect"), StoreUnavailable("gone", code="read-failed")])
    step = Delivery.step

    def fail(self: Delivery, now: float) -> float:
        for error in failures:
            raise error
        return step(self, now)

    monkeypatch.setattr(Delivery, "step", fail)
    monkeypatch.setattr("service.notify.delivery.DEFECT_S", 0.01)
    monkeypatch.setattr("service.notify.delivery.POLL_S", 0.01)
    notifier = Notifier(Targets(webhook=(hook(receiver),)), IncidentSource(store), kept, Metrics())
    notifier.start()
    try:
        raise_some(store, 1)
        until(lambda: receiver.got, patience_s=10.0)
    finally:
        notifier.close()


def test_a_rotated_secret_file_takes_effect_at_the_next_start(tmp_path: Path, receiver: Receiver) -> None:
    file = tmp_path / "secret"
    file.write_text(SECRET)
    target = hook(receiver, secret=None, secret_file=str(file))
    WebhookChannel(target, Cancel()).send("msg_1", "{}", T0)
    (got,) = receiver.got
    assert got.headers["webhook-signature"] == f"v1,{signature(KEY, 'msg_1', str(int(T0)), b'{}')}"


def senders() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "gridsec-notify"]


@pytest.mark.postgresql
def test_one_of_several_processes_sends(receiver: Receiver, cluster: Cluster) -> None:
    url = cluster.database()
    targets = Targets(webhook=(hook(receiver),))
    with Store(url) as store, ExitStack() as stack:
        until(lambda: not senders(), "the end of earlier threads")
        notifiers = []
        for _ in range(2):
            kept = stack.enter_context(DeliveryStore(url, shared=True))
            notifiers.append(Notifier(targets, IncidentSource(store), kept, Metrics()))
        for notifier in notifiers:
            stack.callback(notifier.close)
            notifier.start()
            until(notifiers[0].store.sends, "the sender")
        for number in range(3):
            store.commit([raised(an_alarm(number, feeder=f"f{number}"))])
            for notifier in notifiers:
                notifier.wake()
        until(lambda: notifiers[0].status()[0].waiting == 0, "the messages")
        assert (len(receiver.got), notifiers[1].store.sends()) == (3, False)
        # The next one continues after the last message.
        notifiers[0].close()
        until(lambda: len(senders()) == 1, "the end of its thread")
        notifiers[0].store.close()
        until(notifiers[1].store.sends, "the next sender")
        notifiers[1].look()
        store.commit([raised(an_alarm(4, feeder="f4"))])
        notifiers[1].wake()
        until(lambda: len(receiver.got) >= 4, "the message")
        until(lambda: notifiers[1].status()[0].waiting == 0, "the position")
        assert len(receiver.got) == 4
        notifiers[1].close()
        until(lambda: not senders(), "the end of its thread")

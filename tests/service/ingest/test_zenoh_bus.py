"""zenoh between real sessions over TCP on this machine."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from service.alarms.state_machine import AlarmState, AlarmTransition, Change, to_json
from service.ingest import queues, zenoh_bus
from service.ingest.queues import BusConfig, BusUnavailable, Sample
from service.ingest.zenoh_bus import BATCH, NEWEST, RING, Bus, MeterClient
from service.store import Store
from service.store.committer import alarm_key, missed
from tests.codes import refused
from tests.service.running import free_port, until
from tests.service.stored import T0, an_alarm, raised


class Sink:
    """Collects batches."""

    def __init__(self) -> None:
        self.batches: list[list[Sample]] = []

    def __call__(self, batch: list[Sample]) -> None:
        self.batches.append(batch)

    @property
    def samples(self) -> list[Sample]:
        return [sample for batch in self.batches for sample in batch]


@contextmanager
def pair(
    sink: Sink,
    *,
    lossless: bool = False,
    max_payload: int = 10_000,
    slow: threading.Event | None = None,
    **options: Any,
) -> Iterator[tuple[Bus, MeterClient, str]]:
    """A bus and its meters; nothing is taken before the event `slow`."""

    def take(batch: list[Sample]) -> None:
        if slow is not None:
            slow.wait(20.0)
        sink(batch)

    end = f"tcp/127.0.0.1:{free_port()}"
    with (
        Bus(
            BusConfig(listen=(end,)), "gridsec", take, max_payload=max_payload, lossless=lossless, **options
        ) as bus,
        MeterClient(BusConfig("client", connect=(end,)), "gridsec") as meters,
    ):
        yield bus, meters, end


def add(counts: Counter[str], feeder: str, offered: int, dropped: int) -> None:
    """Add numbers of samples that are not delivered."""
    counts[feeder] += offered
    if dropped:
        counts[f"{feeder} dropped"] += dropped


def client(end: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{end}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def test_samples_arrive_in_order_with_key_bytes_and_encoding() -> None:
    sink = Sink()
    with pair(sink, lossless=True) as (_, meters, _end):
        for k in range(3 * BATCH):
            meters.put(f"f/meter/m{k % 7}/reading", str(k).encode())
            if k % 100 == 0:
                meters.put("f/substation/reading", f"busbar {k}".encode(), "text/plain")
        meters.put("f/concentrator/k1/readings", b"last", "application/cbor")
        until(lambda: sink.samples and sink.samples[-1].payload == b"last")
    numbers = [int(s.payload) for s in sink.samples if "/meter/" in s.key]
    assert numbers == list(range(3 * BATCH))
    assert sink.samples[0].key == "gridsec/f/meter/m0/reading"
    assert sink.samples[0].encoding == "application/json"
    assert sink.samples[1].payload == b"busbar 0"
    assert sink.samples[-1].encoding == "application/cbor"
    assert all(len(batch) <= BATCH for batch in sink.batches)
    assert not [t for t in threading.enumerate() if t.name.startswith("zenoh ")]


def test_patterns_and_wrong_keys_are_handed_over_and_deletions_are_counted() -> None:
    sink = Sink()
    with pair(sink) as (bus, _, end), client(end) as foreign:
        foreign.put("gridsec/f/meter/*/reading", b"pattern")
        foreign.put("gridsec/f/meters/a/reading", b"typo")
        foreign.put("elsewhere/f/meter/a/reading", b"foreign")
        foreign.put("gridsec/f/meter/a", b"unfinished")
        foreign.put("gridsec/f/estimate", b"of another service")
        foreign.put("gridsec/f/alarm/1", b"of another service")
        bus.telemetry("f/estimate", b"own")
        foreign.delete("gridsec/f/meter/a/reading")
        foreign.put("gridsec/f/meter/a/reading", b"plain")
        until(lambda: len(sink.samples) == 4)
        assert bus.counts.deleted == 1
    assert [s.payload for s in sink.samples] == [b"pattern", b"typo", b"unfinished", b"plain"]
    assert "*" in sink.samples[0].key
    assert sink.samples[3].encoding == "zenoh/bytes"


def test_of_long_payloads_only_the_beginning_is_kept() -> None:
    sink = Sink()
    with pair(sink) as (_, meters, _end):
        meters.put("f/meter/a/reading", b"x" * (1 << 20))
        meters.put("f/meter/a/reading", b"x" * 10_000)
        until(lambda: len(sink.samples) == 2)
    assert [(len(s.payload), s.size) for s in sink.samples] == [(1024, 1 << 20), (10_000, 10_000)]


def test_of_absurd_keys_only_the_beginning_is_kept() -> None:
    sink = Sink()
    with pair(sink) as (_, meters, _end):
        meters.put(f"f/meter/{'a' * 50_000}/reading", b"{}")
        until(lambda: sink.samples)
    (found,) = sink.samples
    assert found.key == "gridsec/f/meter/" + "a" * (len(found.key) - 16)
    assert len(found.key) == len("gridsec") + 1024


def test_a_slow_service_keeps_the_newest_and_does_not_hold_up_the_sender() -> None:
    sink = Sink()
    hold = threading.Event()

    def slow(batch: list[Sample]) -> None:
        hold.wait(20.0)
        sink(batch)

    end = f"tcp/127.0.0.1:{free_port()}"
    with (
        Bus(BusConfig(listen=(end,)), "gridsec", slow, max_payload=1000, lossless=False),
        MeterClient(BusConfig("client", connect=(end,)), "gridsec") as meters,
    ):
        for k in range(RING + 2_000):
            meters.put("f/meter/a/reading", str(k).encode())
        meters.put("f/meter/a/reading", b"-1")
        threading.Timer(0.5, hold.set).start()
        until(lambda: sink.samples and sink.samples[-1].payload == b"-1")
    numbers = [int(s.payload) for s in sink.samples[:-1]]
    assert numbers == sorted(numbers)
    assert numbers[-1] == RING + 1_999
    assert len(numbers) < RING + 2_000


def test_a_flood_on_other_keys_displaces_no_sample_of_a_followed_feeder() -> None:
    sink, slow = Sink(), threading.Event()
    with pair(sink, slow=slow) as (bus, meters, _):
        bus.follow("calm")
        bus.follow("calm")
        for k in range(3 * RING):
            meters.put("stranger/meter/a/reading", b"")
            if k % 100 == 0:
                meters.put("calm/meter/a/reading", str(k).encode())
        meters.put("stranger/meter/b/reading", b"last")
        slow.set()
        until(lambda: sink.samples and sink.samples[-1].payload == b"last")
        calm = [int(one.payload) for one in sink.samples if one.key.startswith("gridsec/calm/")]
        assert calm == list(range(0, 3 * RING, 100))
        assert len(sink.samples) < 3 * RING
        assert max(map(len, sink.batches)) <= 2 * BATCH
        # After it the keys are those of a stranger. A pattern of keys counts once.
        bus.unfollow("calm")
        meters.put("calm/meter/a/reading", b"other")
        meters.put("*/meter/a/reading", b"pattern")
        until(lambda: sink.samples[-1].payload == b"pattern")
        assert [one.payload for one in sink.samples[-2:]] == [b"other", b"pattern"]


def test_a_flood_on_a_pattern_of_keys_delays_no_sample_of_a_followed_feeder() -> None:
    sink, slow = Sink(), threading.Event()
    with pair(sink, slow=slow) as (bus, meters, _):
        bus.follow("calm")
        meters.put("calm/meter/a/reading", b"first")
        # The ring holds all of them; the reply to the query comes after them.
        for k in range(RING - BATCH):
            meters.put("*/meter/a/reading", b"pattern")
            if k % 100 == 0:
                meters.put("calm/meter/a/reading", b"own")
        meters.query("calm/estimate", 5.0)
        slow.set()
        until(lambda: sum(one.payload == b"own" for one in sink.samples) == (RING - BATCH + 99) // 100)
    # One look takes them from behind all patterns; the first sample may be in a look of its own.
    looks = [batch for batch in sink.batches if any(one.payload == b"own" for one in batch)]
    assert len(looks) <= 2


def test_samples_of_discarded_feeders_are_counted_and_not_delivered() -> None:
    sink, counts = Sink(), Counter[str]()
    with pair(sink, count=lambda feeder, *numbers: add(counts, feeder, *numbers)) as (bus, meters, _):
        for feeder in ("calm", "shed"):
            bus.follow(feeder)
        bus.discard(frozenset({"shed"}))
        for k in range(500):
            for feeder in ("shed", "calm"):
                meters.put(f"{feeder}/meter/a/reading", str(k).encode())
        until(lambda: counts["shed"] == 500 and len(sink.samples) == 500)
        assert {one.key for one in sink.samples} == {"gridsec/calm/meter/a/reading"}
        bus.discard(frozenset())
        meters.put("shed/meter/a/reading", b"again")
        until(lambda: sink.samples[-1].payload == b"again")
    assert counts == {"shed": 500}  # none is dropped


def test_of_a_long_queue_the_newest_samples_of_each_key_are_delivered() -> None:
    sink, counts, slow = Sink(), Counter[str](), threading.Event()
    with pair(sink, slow=slow, count=lambda feeder, *numbers: add(counts, feeder, *numbers)) as found:
        bus, meters, _ = found
        for feeder in ("first", "long"):
            bus.follow(feeder)
        # The receiving thread waits with the first sample, and the others in their queue.
        meters.put("first/meter/a/reading", b"")
        time.sleep(0.2)
        for k in range(300):
            for meter in range(5):
                meters.put(f"long/meter/m{meter}/reading", str(k).encode())
        for k in range(2):
            meters.put("long/meter/rare/reading", str(k).encode())
        time.sleep(0.2)
        slow.set()
        until(lambda: sink.samples and sink.samples[-1].key.endswith("/rare/reading"))
    kept = [one for one in sink.samples if one.key.startswith("gridsec/long/")]
    for meter, numbers in {"m0": range(296, 300), "m4": range(296, 300), "rare": range(2)}.items():
        mine = [int(one.payload) for one in kept if one.key == f"gridsec/long/meter/{meter}/reading"]
        assert mine == list(numbers)
    assert len(kept) == 5 * NEWEST + 2
    assert counts == {"long": 5 * (300 - NEWEST), "long dropped": 5 * (300 - NEWEST)}


def test_keys_of_known_meters_are_declared_until_their_feeder_leaves() -> None:
    sink = Sink()
    with pair(sink, expects=lambda key: "/meter/m" in key) as (bus, meters, _):
        bus.follow("f")
        keys = {f"f/meter/{meter}/reading" for meter in ("m1", "m2", "junk")}
        for _ in range(3):
            for key in keys:
                meters.put(key, b"{}")
        until(lambda: len(sink.samples) == 9)
        declared = bus._followed["f"].keys
        until(lambda: all(key is not None for key in declared.values()))
        assert {str(key) for key in declared.values()} == {
            "gridsec/f/meter/m1/reading",
            "gridsec/f/meter/m2/reading",
        }
        bus.unfollow("f")
        bus.follow("f")
        # The keys are received as before, and declared again.
        for key in keys:
            meters.put(key, b"again")
        until(lambda: len(sink.samples) == 12)
        until(lambda: len(bus._followed["f"].keys) == 2)


@pytest.mark.parametrize("side", ["listen", "connect"])
def test_small_socket_buffers_bound_the_data_under_way(side: str) -> None:
    """A receiver that takes nothing stops the sender after the buffers: 64 KiB each, and those of zenoh."""
    end = "tcp/127.0.0.1:7447"
    built = zenoh_bus._config(BusConfig("client", **{side: (end,)}))  # type: ignore[arg-type]
    ends = json.loads(built.get_json(f"{side}/endpoints"))
    assert ends == [f"{end}#so_rcvbuf=65536;so_sndbuf=65536"]


def test_a_look_at_many_full_queues_is_delivered_in_parts() -> None:
    sink, feeders, slow = Sink(), [f"f{k}" for k in range(5)], threading.Event()
    with pair(sink, slow=slow) as (bus, meters, _):
        for feeder in feeders:
            bus.follow(feeder)
        # The first look waits with a few of them.
        for k in range(BATCH):
            for feeder in feeders:
                meters.put(f"{feeder}/meter/a/reading", str(k).encode())
        meters.put("*/meter/a/reading", b"pattern")
        slow.set()
        until(lambda: len(sink.samples) > 5 * BATCH)
        until(lambda: sink.samples[-1].payload == b"pattern")
    for feeder in feeders:
        own = [int(one.payload) for one in sink.samples if one.key.startswith(f"gridsec/{feeder}/")]
        assert own == list(range(BATCH))
    assert [one.key for one in sink.samples].count("gridsec/*/meter/a/reading") == 1
    assert max(map(len, sink.batches)) < 3 * BATCH


def test_changes_of_the_followed_feeders_end_no_reception() -> None:
    sink, ended = Sink(), threading.Event()
    with pair(sink) as (bus, meters, _):

        def put() -> None:
            while not ended.is_set():
                for feeder in ("a", "b"):
                    meters.put(f"{feeder}/meter/a/reading", b"")

        flood = threading.Thread(target=put)
        flood.start()
        for _ in range(300):
            for feeder in ("a", "b"):
                bus.follow(feeder)
            time.sleep(0.001)
            for feeder in ("b", "a"):
                bus.unfollow(feeder)
        ended.set()
        flood.join()
        meters.put("last/meter/a/reading", b"last")
        until(lambda: sink.samples and sink.samples[-1].payload == b"last")


def test_values_are_built_only_for_a_subscriber() -> None:
    """The service's own subscription of readings matches the keys of estimates, and is no receiver."""
    built: list[int] = []

    def value(k: int) -> bytes:
        built.append(k)
        return b"%d" % k

    sink = Sink()
    with pair(sink) as (bus, meters, end), client(end) as watcher:
        meters.put("f/meter/a/reading", b"{}")
        until(lambda: sink.samples)
        bus.telemetry("f/estimate", partial(value, 0))
        done: list[str] = []
        # Values and events leave in one thread.
        assert bus.event("f/alarm/A", b"raised", last=False, done=lambda: done.append("raised"))
        until(lambda: done)
        bus.telemetry("f/estimate", partial(value, 1))
        time.sleep(0.2)
        assert built == []
        estimates = watcher.declare_subscriber("gridsec/*/estimate", zenoh.handlers.FifoChannel(100))

        def received() -> bool:
            bus.telemetry("f/estimate", partial(value, 2))
            return estimates.handler.try_recv() is not None

        until(received)
    assert set(built) == {2}


def test_estimates_and_alarms_are_published_and_answer_queries() -> None:
    done: list[str] = []
    with pair(Sink()) as (bus, meters, end), client(end) as watcher:
        events = watcher.declare_subscriber("gridsec/f/alarm/*", zenoh.handlers.FifoChannel(100))
        meters.watch("f")
        until(lambda: meters.query("f/estimate", 0.2) == {})
        for k in range(5):
            bus.telemetry("f/estimate", b"%d" % k)
        found: list[bytes] = []
        until(lambda: found.extend(meters.estimates()) or len(found) == 5)
        assert found == [b"0", b"1", b"2", b"3", b"4"]
        assert bus.event("f/alarm/A", b"raised", last=False, done=lambda: done.append("raised"))
        until(lambda: done)
        bus.answer("f/alarm/B", b"old")
        assert meters.query("**", 2.0) == {
            "gridsec/f/estimate": b"4",
            "gridsec/f/alarm/A": b"raised",
            "gridsec/f/alarm/B": b"old",
        }
        assert bus.event("f/alarm/A", b"cleared", last=True, done=lambda: done.append("cleared"))
        until(lambda: len(done) == 2)
        assert set(meters.query("f/alarm/*", 2.0)) == {"gridsec/f/alarm/B"}
        bus.answer("f/incident/C", b"open")
        bus.answer("f2/incident/D", b"open")
        bus.withdraw("f")
        assert set(meters.query("**", 2.0)) == {"gridsec/f2/incident/D"}
        heard = [events.handler.recv() for _ in range(3)]
        assert [(h.kind, h.payload.to_bytes()) for h in heard] == [
            (zenoh.SampleKind.PUT, b"raised"),
            (zenoh.SampleKind.PUT, b"cleared"),
            (zenoh.SampleKind.DELETE, b""),
        ]
        assert heard[0].priority == zenoh.Priority.INTERACTIVE_HIGH
        assert str(heard[0].encoding) == "application/json"
        tokens = [
            str(r.ok.key_expr) for r in watcher.liveliness().get("gridsec/service/*", timeout=2.0) if r.ok
        ]
        assert len(tokens) == 1
        events.undeclare()


def test_what_waits_is_published_before_closing() -> None:
    done: list[int] = []
    with pair(Sink()) as (bus, _, _end):
        for k in range(200):
            bus.event(f"f/alarm/{k}", b"x", last=False, done=lambda k=k: done.append(k))
    assert done == list(range(200))


def test_a_port_in_use_is_named() -> None:
    sink = Sink()
    with (
        pair(sink) as (_, _meters, end),
        refused(BusUnavailable, "bus-endpoint") as caught,
        Bus(BusConfig(listen=(end,)), "gridsec", sink, max_payload=1, lossless=False),
    ):
        pass
    assert end in str(caught.value)
    assert "address already in use" in str(caught.value).lower()


def test_nobody_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_bus, "_OPEN_TIMEOUT_MS", 500)
    end = f"tcp/127.0.0.1:{free_port()}"
    config = BusConfig("client", connect=(end,))
    with refused(BusUnavailable, "bus-endpoint") as caught, MeterClient(config, "gridsec"):
        pass
    assert end in str(caught.value)


def test_a_user_s_own_configuration(tmp_path: Path) -> None:
    end = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "zenoh.json5"
    file.write_text(
        f"""{{ mode: "router", listen: {{ endpoints: ["{end}"] }}, // a comment
             scouting: {{ multicast: {{ enabled: false }} }} }}"""
    )
    sink = Sink()
    with (
        Bus(BusConfig(file=file), "gridsec", sink, max_payload=1000, lossless=False),
        MeterClient(BusConfig("client", connect=(end,)), "gridsec") as meters,
    ):
        meters.put("f/meter/a/reading", b"1")
        until(lambda: sink.samples)
    file.write_text("{ mode: ")
    with refused(BusUnavailable, "bus-configuration"), MeterClient(BusConfig(file=file), "gridsec"):
        pass


def test_a_closed_session_says_so() -> None:
    with pair(Sink()) as (_, meters, _end):
        pass
    with refused(BusUnavailable, "bus-closed"):
        meters.put("f/meter/a/reading", b"1")


def test_what_cannot_be_published_is_said_until_something_is_again() -> None:
    with pair(Sink()) as (bus, _, _end):
        bus.telemetry("f//state", b"no key of zenoh")
        until(lambda: bus.failure)
        assert bus.counts.publish_failed == 1
        bus.telemetry("f/state", b"a key")
        until(lambda: bus.failure is None)
        assert bus.counts.published == 1


class Refusing:
    """Lets zenoh refuse puts and deletes on keys that hold a word, until told otherwise."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, word: str) -> None:
        self.word: str | None = word
        self.tries = 0
        put_event = zenoh_bus._put_event

        def put(live: zenoh.Session, item: queues.Publication) -> None:
            if self.word is not None and self.word in item.key:
                self.tries += 1
                raise zenoh.ZError("no way out")
            put_event(live, item)

        monkeypatch.setattr(zenoh_bus, "_put_event", put)


def test_an_event_that_zenoh_refused_is_tried_again_in_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queues, "RETRY_S", 0.1)
    refusing, done = Refusing(monkeypatch, "alarm/A"), list[str]()
    with pair(Sink()) as (bus, _, end), client(end) as watcher:
        events = watcher.declare_subscriber("gridsec/f/alarm/*", zenoh.handlers.FifoChannel(100))
        for name in ("A", "B"):
            bus.event(f"f/alarm/{name}", b"x", last=name == "A", done=lambda name=name: done.append(name))
        until(lambda: refusing.tries >= 3)
        bus.telemetry("f/estimate", b"goes out meanwhile")
        until(lambda: bus.counts.published == 1)
        assert bus.failure == "no way out"
        assert done == []
        refusing.word = None
        until(lambda: len(done) == 2)
        assert done == ["A", "B"]
        assert bus.failure is None
        heard = [events.handler.recv() for _ in range(3)]
        assert [(str(h.key_expr)[-1], h.kind) for h in heard] == [
            ("A", zenoh.SampleKind.PUT),
            ("A", zenoh.SampleKind.DELETE),
            ("B", zenoh.SampleKind.PUT),
        ]
        assert bus.counts.publish_failed == refusing.tries
        events.undeclare()


def test_closing_waits_for_no_event_that_zenoh_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queues, "RETRY_S", 60.0)
    refusing, done = Refusing(monkeypatch, "alarm/A"), list[str]()
    with pair(Sink()) as (bus, _, _end):
        for name in ("A", "B"):
            bus.event(f"f/alarm/{name}", b"x", last=False, done=lambda name=name: done.append(name))
        until(lambda: refusing.tries)
        begin = time.monotonic()
    assert time.monotonic() - begin < 1.5
    assert refusing.tries == 2
    assert done == []


def test_an_event_without_a_possible_key_holds_up_no_other() -> None:
    done: list[str] = []
    with pair(Sink()) as (bus, _, _end):
        bus.event("f//alarm", b"no key of zenoh", last=True, done=lambda: done.append("none"))
        bus.event("f/alarm/A", b"a key", last=False, done=lambda: done.append("A"))
        until(lambda: done)
        assert (done, bus.failure, bus.counts.publish_failed) == (["A"], None, 2)


def test_a_subscriber_asks_for_what_it_missed(tmp_path: Path) -> None:
    """It knows the number of the last event, is away for some alarms, and comes back."""
    end = f"tcp/127.0.0.1:{free_port()}"
    alarms = [an_alarm(k, feeder=f"town-{k % 2}") for k in range(6)]
    ended = replace(alarms[4], state=AlarmState.CLEARED, t_cleared=T0 + 60.0)
    with (
        Store(f"sqlite:///{tmp_path}/g.db") as store,
        Bus(
            BusConfig(listen=(end,)), "gridsec", Sink(), max_payload=1000, lossless=False,
            missed=partial(missed, store),
        ) as bus,
    ):  # fmt: skip
        with client(end) as first:
            heard = first.declare_subscriber("gridsec/*/alarm/*", zenoh.handlers.FifoChannel(100))
            (number,) = store.commit([raised(alarms[0])])
            time.sleep(0.1)  # the subscription reaches the bus
            bus.event(alarm_key(alarms[0]), b"alarm", last=False, number=number)
            sample = heard.handler.recv()
            last = int(sample.attachment.to_bytes())
        assert last == number
        store.commit([raised(each) for each in alarms[1:]])
        store.commit([AlarmTransition(ended, Change.CLEARED, T0 + 60.0)])
        with client(end) as second:

            def asked(selector: str) -> list[tuple[int, str, dict[str, Any]]]:
                replies = [reply.ok for reply in second.get(f"gridsec/{selector}", timeout=10.0)]
                return sorted(
                    (int(one.attachment.to_bytes()), str(one.key_expr), json.loads(one.payload.to_bytes()))
                    for one in replies
                    if one is not None and one.attachment is not None
                )

            found = asked(f"*/alarm/*?after={last}")
            # The newest event of each alarm; number 6 of the fifth one is replaced by its end.
            assert [each[0] for each in found] == [2, 3, 4, 6, 7]
            assert found[-1][1] == f"gridsec/town-0/alarm/{ended.id}"
            assert (found[-1][2]["state"], found[0][2]) == ("cleared", to_json(alarms[1]))
            assert [each[0] for each in asked(f"town-1/alarm/*?after={last}")] == [2, 4, 6]
            assert asked("*/alarm/*?after=7") == []
            incidents = asked("*/incident/*?after=0")
            assert {each[2]["incident"]["feeder"] for each in incidents} == {"town-0", "town-1"}
            assert all(each[0] == each[2]["seq"] for each in incidents)
            for wrong in ("-1", "x", "9" * 30):
                (refusal,) = second.get(f"gridsec/*/alarm/*?after={wrong}", timeout=10.0)
                assert refusal.err is not None
                assert "expected the number" in json.loads(refusal.err.payload.to_bytes())["detail"]
            (tmp_path / "g.db").rename(tmp_path / "gone.db")
            (refusal,) = second.get("gridsec/*/alarm/*?after=0", timeout=10.0)
            assert refusal.err is not None
            assert "(file-removed)" in refusal.err.payload.to_string()

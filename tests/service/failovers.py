"""Faults of a served cluster under attack: times until its feeders are judged again, and its alarms.

The oracle is the list of manipulated meters: each has one alarm, raised once and never cleared; no other
meter has an alarm of this kind.
"""

from __future__ import annotations

import random
import signal
import time
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import httpx
import psycopg

from service.cli.console import LEASE_LOST
from tests.service.clusters import JUDGING, LIE_VOLT, Process, ServedCluster, Writes
from tests.service.databases import Cluster
from tests.service.running import until

OUTAGE_S = 30.0
"""Time for which PostgreSQL is stopped, s."""
START_S = 180.0
"""Time limit until a started worker has feeders, s: for a busy machine."""
KIND = "meter-manipulated"


class Fault(StrEnum):
    """Kinds of faults."""

    STOP = "stop"  # SIGTERM of a worker
    KILL = "kill"  # SIGKILL of a worker
    FREEZE = "freeze"  # SIGSTOP of a worker, then SIGCONT
    SECOND = "second"  # SIGKILL of a second zenoh router, and its start
    ROUTER = "router"  # SIGKILL of the front, which is the zenoh router, and its start
    TERMINATE = "terminate"  # pg_terminate_backend of all sessions
    OUTAGE = "outage"  # PostgreSQL stopped for `OUTAGE_S`


@dataclass
class Trial:
    """A cluster under attack, and what was measured.

    seconds: times from each fault until all affected feeders are judged, s. For a router and an outage they
        begin with the end of the fault.
    decided: the same until the verdict of each is CLEAN or ATTACKED: observers settle before, s.
    """

    live: ServedCluster
    server: Cluster
    rng: random.Random
    seconds: dict[Fault, list[float]] = field(default_factory=dict)
    decided: dict[Fault, list[float]] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.writes = Writes(self.live.database)

    def begin(self) -> None:
        """Wait until every feeder is judged, and manipulate a meter in every second one."""
        until(lambda: None not in self.live.owners().values(), "the distribution")
        self.live.judged_within(self.live.names, time.time() - 1.0, 60.0)
        for name in self.live.names[::2]:
            self.live.fleet.lies[name, self.live.site.meter_ids[0]] = LIE_VOLT
        until(lambda: len(self.raised()) == len(self.live.fleet.lies), "the alarms", 60.0)

    def raised(self) -> list[dict[str, Any]]:
        return [one for one in self.live.alarms(limit=1000) if one["kind"] == KIND]

    def strike(self, fault: Fault) -> tuple[float, float]:
        """Cause a fault at a random moment of a tick; times until the feeders are judged, and decided, s."""
        time.sleep(self.rng.uniform(0.0, 2.0))
        lasted, decided = {
            Fault.STOP: self.stop,
            Fault.KILL: self.kill,
            Fault.FREEZE: self.freeze,
            Fault.SECOND: self.second,
            Fault.ROUTER: self.router,
            Fault.TERMINATE: self.terminate,
            Fault.OUTAGE: self.outage,
        }[fault]()
        self.seconds.setdefault(fault, []).append(lasted)
        self.decided.setdefault(fault, []).append(decided)
        self.restart_workers()
        self.live.judged_within(self.live.names, time.time(), 60.0)
        self.check(fault)
        return lasted, decided

    def victim(self) -> tuple[str, list[str]]:
        """A worker with feeders, and these."""
        owners = self.live.owners()
        name = self.rng.choice(sorted({owner for owner in owners.values() if owner is not None}))
        return name, [feeder for feeder, owner in owners.items() if owner == name]

    def stop(self) -> tuple[float, float]:
        name, feeders = self.victim()
        began = time.time()
        self.live.workers[name].send(signal.SIGTERM)
        lasted = self.judged(feeders, began)
        if (code := self.live.workers[name].popen.wait(timeout=10.0)) != 0:
            self.violations.append(f"stop: exit code {code}")
        return lasted

    def kill(self) -> tuple[float, float]:
        name, feeders = self.victim()
        began = time.time()
        self.live.workers[name].send(signal.SIGKILL)
        return self.judged(feeders, began)

    def freeze(self) -> tuple[float, float]:
        name, feeders = self.victim()
        began = time.time()
        self.live.workers[name].send(signal.SIGSTOP)
        lasted = self.judged(feeders, began)
        continued = time.time()
        self.live.workers[name].send(signal.SIGCONT)
        code, written = self.live.workers[name].popen.wait(timeout=20.0), self.writes.of(name, continued)
        if (code, written) != (LEASE_LOST, 0):
            self.violations.append(f"freeze: exit code {code}, {written} writes afterwards")
        return lasted

    def second(self) -> tuple[float, float]:
        router = self.live.router
        assert router is not None
        began = time.time()
        router.send(signal.SIGKILL)
        lasted = self.judged(self.live.names, began)
        router.end()
        self.live.start_router()
        return lasted

    def router(self) -> tuple[float, float]:
        front = self.live.front
        assert isinstance(front, Process)
        front.send(signal.SIGKILL)
        front.popen.wait()
        front.end()
        self.live.http.close()
        time.sleep(self.rng.uniform(0.0, 5.0))
        self.live.start_front()
        return self.judged(self.live.names, time.time())

    def terminate(self) -> tuple[float, float]:
        began = time.time()
        others = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"
        address = self.live.database.replace("+psycopg", "")
        with psycopg.connect(address, autocommit=True) as admin:
            admin.execute(f"{others} AND datname = current_database()")
        return self.judged(self.live.names, began)

    def outage(self) -> tuple[float, float]:
        self.server.stop()
        time.sleep(OUTAGE_S)
        self.server.start()
        return self.judged(self.live.names, time.time())

    def judged(self, feeders: list[str], since: float) -> tuple[float, float]:
        """Times until all feeders are judged, and decided, at a later tick, s; compare the verdicts."""
        attacked = {name for name, _ in self.live.fleet.lies}
        left, waiting = set(feeders), set(feeders)
        first_s = 0.0

        def done() -> bool:
            nonlocal first_s
            for name in sorted(left):
                try:
                    state = self.live.state(name)
                except httpx.HTTPError:
                    continue
                if not state or state["t"] <= since or state["cause"] not in JUDGING:
                    continue
                waiting.discard(name)
                if not waiting and not first_s:
                    first_s = time.time() - since
                if state["verdict"] == "undecided":
                    continue
                left.discard(name)
                if (state["verdict"] == "attacked") != (name in attacked):
                    self.violations.append(f"{name}: {state['verdict']} at {state['t'] - since:.1f} s")
            return not left

        until(done, f"ticks of {sorted(left)}", 60.0)
        return first_s, time.time() - since

    def restart_workers(self) -> None:
        """Start ended workers again, as a supervisor does, and wait until all have feeders."""
        for name, process in list(self.live.workers.items()):
            if process.popen.poll() is not None:
                process.end()
                self.live.start_worker(name)
        wanted = set(self.live.workers)
        until(lambda: set(self.live.owners().values()) == wanted, "the distribution", START_S)

    def check(self, fault: Fault) -> None:
        """Compare the alarms with the manipulated meters."""
        alarms = self.raised()
        found = sorted((one["feeder"], one["meter"]) for one in alarms)
        if found != sorted(self.live.fleet.lies):
            self.violations.append(f"{fault}: alarms of {found}")
        for one in alarms:
            events = self.live.get(f"/alarms/{one['id']}/events")["events"]
            changes = [event["change"] for event in events if event["change"] in {"raised", "cleared"}]
            if changes != ["raised"]:
                self.violations.append(f"{fault}: {one['feeder']} {changes}")

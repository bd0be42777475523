"""Cost of many feeders in one process: time by stage, rates of decoding, meters held at one reading a second.

    python -m benchmarks.fleet [SECONDS] [MOST] [FIRST] [OTHER_TREE] [--costs] [--workers] [--json] [--arrow]

Feeders are copies of the Kerber suburban network, 146 meters and the busbar each. All ratios are of one run.

1. Stages: an engine without zenoh takes calm ticks of four feeders, as single JSON readings and as batches in
   Arrow, CBOR and JSON. Processor time of each stage, as a multiple of the estimator's step.
2. Rates: single messages per second of a raw zenoh subscriber in Python, and of one with decoding and
   alignment; readings per second of decoding and alignment of batches.
3. Fleet: the service is a process of its own, or with --workers a front with two workers on PostgreSQL. This
   process publishes each meter once a second. A fleet is held when no tick is missing but for two seconds at
   the ends, 98 % of the ticks are CLEAN, nothing is lost, the mean delay is less than 1 s, and at the end no
   feeder is shed. The number of feeders grows by half from FIRST to MOST, for 20 s each, until it is not
   held. The last number is then watched for SECONDS, and a tenth fewer until it is held. With --costs this
   part is left out; with --json or --arrow all but it, and the other format. With another source tree only
   the processor time of a reading is compared, with 8 feeders.

The processor time of a reading is that of the service and its workers, without the database and the sender.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries; the service limits them itself.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import json
import math
import multiprocessing
import re
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any, Final, NamedTuple

import cbor2
import pyarrow as pa
import zenoh
from pyarrow import ipc

from benchmarks._arguments import arguments
from benchmarks.overload import START_S, Service, free_ports, metrics, renamed, running, ticks
from feeders.format.tables import to_json, write
from feeders.model.site import Site, from_tables, load
from feeders.registry import DesignedEstimator
from feeders.simulation.plant import BUSBAR
from feeders.simulation.scenario import Scenario, SimulatedReading, simulate
from service.cli.simulate import key_of
from service.engine import feeder_monitor
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design, known_of
from service.ingest.align import Aligner, rules
from service.ingest.decode import Wire
from service.ingest.queues import BusConfig, BusCounts, Sample, Value
from service.ingest.reading import Known
from service.ingest.zenoh_bus import DECLARED, Bus, MeterClient, session
from service.report.tick_state import TickState
from service.store import Store
from service.store.committer import Committer
from tests.service.databases import Cluster as Server
from tests.service.databases import installed_postgresql
from tests.service.databases import running as running_server

FEEDER = "kerber-vorstadtnetz"
FORMATS = {
    "json": "application/json",
    "arrow": "application/vnd.apache.arrow.stream",
    "cbor": "application/cbor",
    "json-batch": "application/json",
}
"""Encoding by name; `json` stands for single readings."""
COPIES = 4
WARM, TICKS = 20, 100
"""Ticks before the measurement, and measured ones."""
SENT = 60_000
"""Messages of the rates of zenoh."""
SPREAD = 60
"""Feeders that these messages belong to."""
APART = 0.3
"""Part of a tick over which the feeders report, below the grace of a late reading of half a tick."""
LATE_S = 1.0
"""Age of a tick's result, s, from which it is late."""
FIRST, GROWTH, RETREAT = 8, 1.5, 0.9
"""First number of feeders, and its factors while it is held and afterwards."""
RAMP_S = 20.0
"""Duration of a number during growth, s."""
CLEAN_SHARE = 0.98
"""Share of ticks that are CLEAN where a fleet is held."""
EDGE_S = 2.0
"""Largest time by which the ticks of a measurement are fewer than its seconds, s: both ends cut one."""
START_EACH_S = 0.5
"""Further time limit of the start for each feeder, s."""
LOOK_S = 5.0
"""Interval at which the shed feeders are counted, s."""
SETTLED_S, SETTLING_S = 10.0, 300.0
"""Time in which nearly all ticks are CLEAN after the start, and limit of the start, s."""
WORKERS = 2

Put = tuple[str, bytes, str]


class Nowhere:
    """Publisher without a receiver."""

    failure: str | None = None

    def __init__(self) -> None:
        self.counts = BusCounts()

    def telemetry(self, key: str, payload: Value) -> None:
        """Build nothing."""

    def event(self, *_: object, done: Callable[[], None] | None = None, **__: object) -> bool:
        """Confirm at once."""
        self.counts.published += 1
        if done is not None:
            done()
        return True

    def answer(self, key: str, payload: bytes) -> None:
        """Keep nothing."""

    def withdraw(self, feeder: str) -> None:
        """Change nothing."""


def single(reading: SimulatedReading, t: float) -> bytes:
    """Return a reading as JSON."""
    fields = {"t": t, "v_volt": reading.v_volt}
    return json.dumps(fields if reading.p_kw is None else fields | {"p_kw": reading.p_kw}).encode()


def batch(readings: Sequence[SimulatedReading], t: Sequence[float], form: str) -> bytes:
    """Return readings of meters as one payload."""
    columns = {
        "meter": [one.meter for one in readings],
        "t": list(t),
        "v_volt": [one.v_volt for one in readings],
        "p_kw": [one.p_kw for one in readings],
    }
    if form == "cbor":
        return cbor2.dumps(columns)
    if form == "json-batch":
        return json.dumps(
            [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        ).encode()
    table = pa.record_batch(columns)
    sink = pa.BufferOutputStream()
    with ipc.new_stream(sink, table.schema) as writer:
        writer.write_batch(table)
    return bytes(sink.getvalue().to_pybytes())


def puts(readings: Sequence[SimulatedReading], t: float, form: str) -> list[Put]:
    """Return all puts of a feeder at one second; the keys have no name of a feeder."""
    if form == "json":
        return [(key_of("", one.meter), single(one, t), FORMATS[form]) for one in readings]
    meters = [one for one in readings if one.meter != BUSBAR]
    busbar = next(one for one in readings if one.meter == BUSBAR)
    payload = batch(meters, [t] * len(meters), form)
    return [
        ("/concentrator/c1/readings", payload, FORMATS[form]),
        (key_of("", BUSBAR), single(busbar, t), FORMATS["json"]),
    ]


def copies(site: Site, names: Sequence[str]) -> list[Site]:
    """Return copies of a feeder with other names."""
    return [from_tables(renamed(site.tables, name)) for name in names]


# --- Stages ---


STAGES: dict[str, tuple[Any, str]] = {
    "step": (DesignedEstimator, "step"),
    "frame": (feeder_monitor, "to_frame"),
    "decode": (Wire, "gather"),
    "align": (Aligner, "take_all"),
    "due": (Engine, "_reach"),
    "conditions": (TickState, "notable"),
    "history": (Engine, "_history"),
    "keep_states": (Engine, "keep_states"),
    "commit": (Committer, "commit"),
    "cycle": (Engine, "cycle"),
}
"""Function of each stage; `cycle` contains all of them."""


@contextmanager
def timed() -> Iterator[Counter[str]]:
    """Add up the processor time of each stage, s."""
    spent: Counter[str] = Counter()

    def watch(name: str, run: Callable[..., Any]) -> Callable[..., Any]:
        def measured(*given: Any, **named: Any) -> Any:
            begun = time.thread_time()
            try:
                return run(*given, **named)
            finally:
                spent[name] += time.thread_time() - begun  # type: ignore[assignment]

        return measured

    kept = {name: getattr(owner, function) for name, (owner, function) in STAGES.items()}
    for name, (owner, function) in STAGES.items():
        setattr(owner, function, watch(name, kept[name]))
    try:
        yield spent
    finally:
        for name, (owner, function) in STAGES.items():
            setattr(owner, function, kept[name])


def stages(site: Site, form: str) -> dict[str, float]:
    """Return the time of each stage for one calm tick of one feeder, s."""
    names = [f"f{k}" for k in range(COPIES)]
    seconds = list(simulate(site, Scenario(seed=1, duration_s=float(WARM + TICKS), dt_s=1.0)))
    now = seconds[0].t
    with (
        tempfile.TemporaryDirectory() as folder,
        Store(f"sqlite:///{folder}/f.db") as store,
        timed() as spent,
    ):
        engine = Engine(RuntimeConfig(), store, copies(site, names), wall=lambda: now, stored=lambda: None)
        engine.committer.publisher = Nowhere()
        for monitor in engine.monitors.values():
            monitor.install(design(monitor.site))
        engine.begin()
        for number, second in enumerate(seconds):
            if number == WARM:
                spent.clear()
            now = second.t + 0.05
            sent = puts(second.readings, second.t, form)
            engine.cycle(
                [
                    Sample(f"gridsec/{name}{key}", payload, kind, now, len(payload))
                    for name in names
                    for key, payload, kind in sent
                ]
            )
    return {name: total / (TICKS * COPIES) for name, total in spent.items()}


def print_stages(site: Site) -> float:
    """Print the stages of all formats; return the largest cost of a tick in steps."""
    found = {form: stages(site, form) for form in FORMATS}
    print("Processor time of a calm tick of 146 meters, in steps of the estimator")
    print(f"{'':12}" + "".join(f"{form:>12}" for form in found))
    for name in STAGES:
        print(f"{name:12}" + "".join(f"{one[name] / one['step']:12.3f}" for one in found.values()))
    for form, one in found.items():
        each, step = (1e6 * one[name] / (len(site.meter_ids) + 1) for name in ("cycle", "step"))
        print(f"{form}: {each:.1f} us per reading, the step {step:.1f} us")
    return max(one["cycle"] / one["step"] for one in found.values())


# --- Rates ---


def batch_rate(site: Site, meters: int, form: str, scans: int) -> float:
    """Readings per second of processor time: decoding and alignment of batches of `scans` seconds.

    The readings of a site's meters are repeated for a number of meters.
    """
    name, ids = site.feeder.name, tuple(f"m{k:04d}" for k in range(meters))
    known = known_of(site)
    wire = Wire({name: Known(ids, known.nominal_volt, known.power_max_kw)}, max_bytes=1 << 24)
    first = next(iter(simulate(site, Scenario(seed=1, duration_s=2.0, dt_s=1.0))))
    some = cycle([one for one in first.readings if one.meter != BUSBAR])
    readings = [replace(one, meter=meter) for meter, one in zip(ids, some, strict=False)]
    aligner = Aligner(ids, rules(1.0, 10.0, grace_s=float(scans)))
    number = 0
    rounds: list[list[Sample]] = []
    for k in range(40):
        t = [first.t + scans * k + scan for scan in range(scans) for _ in readings]
        payload = batch(readings * scans, t, form)
        key = f"gridsec/{name}/concentrator/c1/readings"
        rounds.append([Sample(key, payload, FORMATS[form], t[-1] + 0.05, len(payload))])
    started = time.thread_time()
    for samples in rounds:
        for columns in wire.gather(samples).readings.values():
            aligner.take_all(columns)
            number += len(columns)
    return number / (time.thread_time() - started)


def zenoh_rates(site: Site) -> tuple[float, float]:
    """Messages per second of a raw subscriber, and of the bus with decoding and alignment."""
    names = [f"f{k}" for k in range(SPREAD)]
    wire = Wire(dict.fromkeys(names, known_of(site)))
    aligners = {name: Aligner(site.meter_ids, rules(1.0, 10.0)) for name in names}
    context = multiprocessing.get_context("spawn")

    def rate(receive: Callable[[str], Callable[[], int]]) -> float:
        endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        count = receive(endpoint)
        sender = context.Process(target=send, args=(endpoint, names))
        sender.start()
        while not count():
            time.sleep(0.001)
        begun, end = time.monotonic(), time.monotonic() + 60.0
        while count() < SENT and time.monotonic() < end:
            time.sleep(0.01)
        lasted = time.monotonic() - begun
        sender.join()
        return count() / lasted

    return _raw_rate(rate), _bus_rate(rate, wire, aligners)


def send(endpoint: str, names: Sequence[str]) -> None:
    """Publish `SENT` single readings of the meters of feeders in turn, as fast as the receiver takes them."""
    site = load(FEEDER)
    (second,) = simulate(site, Scenario(seed=1, duration_s=1.0, dt_s=1.0))
    sources = [(key_of(name, one.meter), one) for name in names for one in second.readings]
    begun = time.time()
    with MeterClient(BusConfig("client", connect=(endpoint,)), "gridsec") as meters:
        for k in range(SENT):
            key, one = sources[k % len(sources)]
            meters.put(key, single(one, begun + 0.001 * (k // len(sources))))


def _raw_rate(rate: Callable[[Callable[[str], Callable[[], int]]], float]) -> float:
    ended, received = threading.Event(), [0]

    def receive(endpoint: str) -> Callable[[], int]:
        up = threading.Event()

        def run() -> None:
            config = BusConfig("router", listen=(endpoint,))
            with session(config) as live:
                subscriber = live.declare_subscriber("gridsec/**", zenoh.handlers.FifoChannel(8192))
                up.set()
                while not ended.is_set():
                    raw = subscriber.handler.try_recv()
                    if raw is None:
                        time.sleep(0.0005)
                        continue
                    raw.payload.to_bytes()
                    received[0] += 1

        threading.Thread(target=run, daemon=True).start()
        up.wait(10.0)
        return lambda: received[0]

    try:
        return rate(receive)
    finally:
        ended.set()


def _bus_rate(
    rate: Callable[[Callable[[str], Callable[[], int]]], float], wire: Wire, aligners: Mapping[str, Aligner]
) -> float:
    received = [0]

    def deliver(samples: list[Sample]) -> None:
        gathered = wire.gather(samples)
        for name, columns in gathered.readings.items():
            aligners[name].take_all(columns)
        received[0] += len(samples)

    buses: list[Bus] = []

    def receive(endpoint: str) -> Callable[[], int]:
        config = BusConfig("router", listen=(endpoint,))
        bus = Bus(config, "gridsec", deliver, max_payload=1 << 18, lossless=True)
        bus.__enter__()
        buses.append(bus)
        return lambda: received[0]

    try:
        return rate(receive)
    finally:
        for bus in buses:
            bus.__exit__()


def print_rates(site: Site) -> tuple[float, float]:
    """Print the rates; return that of single messages over the raw one, and the largest of batches."""
    raw, used = zenoh_rates(site)
    print(f"single messages: {used / raw:.2f} of a raw subscriber ({used:.0f} and {raw:.0f} messages/s)")
    best = 0.0
    for form in ("arrow", "cbor", "json-batch"):
        for meters, scans in ((146, 1), (146, 7), (1022, 1), (1022, 7)):
            found = max(batch_rate(site, meters, form, scans) for _ in range(3))
            best = max(best, found)
            print(f"{form}, {meters} meters, batches of {scans} s: {found / 1e6:.2f} M readings/s")
    return used / raw, best


# --- Fleet ---


class Fleet(threading.Thread):
    """Publishes every meter of all feeders once in `tick_s`; feeders follow each other within a part of it.

    All feeders have the readings of one simulation, which never repeats: a repeated error of a meter is a
    systematic one, and would be found. A session declares all its keys; real meters have one each.
    """

    def __init__(
        self, site: Site, names: Sequence[str], form: str, endpoint: str, *, tick_s: float = 1.0
    ) -> None:
        super().__init__(daemon=True)
        self.seconds = simulate(site, Scenario(seed=1, duration_s=math.inf, dt_s=tick_s))
        self.names, self.form, self.endpoint, self.tick_s = names, form, endpoint, tick_s
        # Of a feeder: its meters, or one concentrator, and the busbar.
        self.keys = 1 + (len(site.meter_ids) if form == "json" else 1)
        self.behind_s, self.sent = 0.0, 0
        self.ended = threading.Event()

    def run(self) -> None:
        """Publish."""
        with ExitStack() as stack:
            meters = self._sessions(stack)
            begun = math.floor(time.time() / self.tick_s) + 1
            for number, second in enumerate(self.seconds, begun):
                t = number * self.tick_s
                sent = puts(second.readings, t, self.form)
                # A feeder's meters report at once.
                for k, name in enumerate(self.names):
                    if self.ended.wait(max(0.0, t + APART * self.tick_s * k / len(self.names) - time.time())):
                        return
                    for key, payload, kind in sent:
                        meters[name].put(name + key, payload, kind)
                        self.sent += len("gridsec/") + len(name) + len(key) + len(payload)
                self.behind_s = max(self.behind_s, time.time() - t - self.tick_s)

    def _sessions(self, stack: ExitStack) -> dict[str, MeterClient]:
        """Open the sessions; the one of each feeder."""
        together = max(1, DECLARED // self.keys)
        found: dict[str, MeterClient] = {}
        for start in range(0, len(self.names), together):
            one = MeterClient(BusConfig("client", connect=(self.endpoint,)), "gridsec")
            found |= dict.fromkeys(self.names[start : start + together], stack.enter_context(one))
        return found


OWN = Path(__file__).parents[1]


class Spent(NamedTuple):
    """Processor time of a process, its threads and its living children, s."""

    zenoh: float  # threads of zenoh
    others: float


def spent_s(process: int) -> float:
    """Processor time of a process, all its threads and its living children, s."""
    return sum(spent_by(process))


def spent_by(process: int) -> Spent:
    """The same by threads."""
    home = Path(f"/proc/{process}")
    zenoh = 0.0
    for task in home.glob("task/*/stat"):
        name, _, fields = task.read_text().partition("(")[2].rpartition(")")
        zenoh += _time_s(fields) if ZENOH.match(name) else 0.0
    # Ended threads count with the others.
    others = _time_s((home / "stat").read_text().rpartition(")")[2]) - zenoh
    for child in (home / "task" / str(process) / "children").read_text().split():
        more = spent_by(int(child))
        zenoh, others = zenoh + more.zenoh, others + more.others
    return Spent(zenoh, others)


def _time_s(fields: str) -> float:
    """Processor time by the fields behind the name in a file `stat`, s."""
    user, system = fields.split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


ZENOH: Final = re.compile(r"(rx|tx|net|acc|app)-\d")
"""Names of the threads of zenoh's runtimes."""


def _most_shed(service: Service, end: float) -> int:
    """Wait until a monotonic time, s; the largest number of shed feeders at any look."""
    most = 0
    while (left := end - time.monotonic()) > 0.0:
        time.sleep(min(LOOK_S, left))
        most = max(most, int(metrics(service)["gridsec_feeders_shed"]))
    return most


def _settle(service: Service, number: int) -> None:
    """Wait until nearly all ticks of a few seconds are CLEAN, or `SETTLING_S` are over."""
    end, before, begun = time.monotonic() + SETTLING_S, metrics(service), time.monotonic()
    while time.monotonic() < end:
        time.sleep(SETTLED_S)
        after, lasted = metrics(service), time.monotonic() - begun
        more = after - before
        complete = ticks(more) > number * (lasted - EDGE_S)
        if complete and more["gridsec_ticks_total clean"] > CLEAN_SHARE * ticks(more):
            return
        before, begun = after, time.monotonic()


class Held(NamedTuple):
    """A fleet during a time."""

    held: bool
    cost_s: float  # processor time for a reading, s
    zenoh_s: float  # part of it in the threads of zenoh, s
    text: str  # a line of figures


def holds(
    site: Site,
    folder: Path,
    number: int,
    form: str,
    *,
    seconds: float,
    tree: Path = OWN,
    server: Server | None = None,
) -> Held:
    """Start a service with a number of feeders, and watch them for a time, s."""
    names = [f"feeder-{k:04d}" for k in range(number)]
    place = Path(tempfile.mkdtemp(prefix=f"{tree.name}-{form}-{number}-", dir=folder))
    tables = {name: renamed(site.tables, name) for name in names}
    workers, database, given = 0, None, names
    if server is None:
        for name, one in tables.items():
            write(one, place / name)
    else:
        workers, database, given = WORKERS, server.database(), []
        with Store(database) as store:
            for name, one in tables.items():
                store.commit(put=(name, to_json(one)))
    start_s = START_S + START_EACH_S * number
    with running(tree, place, given, workers=workers, database=database, start_s=start_s) as service:
        fleet = Fleet(site, names, form, service.zenoh)
        fleet.start()
        try:
            _settle(service, number)
            fleet.behind_s = 0.0
            before, begun, spent = metrics(service), time.monotonic(), spent_by(service.process.pid)
            most = _most_shed(service, begun + seconds)
            after_s = spent_by(service.process.pid)
            after, lasted = metrics(service), time.monotonic() - begun
        finally:
            fleet.ended.set()
            fleet.join(10.0)
    more = after - before
    clean, judged = more["gridsec_ticks_total clean"], ticks(more)
    lost = more["gridsec_samples_dropped_total"] + more["gridsec_ticks_skipped_total"]
    delay = more["gridsec_report_delay_seconds_sum"] / max(1, more["gridsec_report_delay_seconds_count"])
    shed = after["gridsec_feeders_shed"]
    complete = judged > number * (lasted - EDGE_S)
    held = complete and clean > CLEAN_SHARE * judged and lost == 0 and delay < LATE_S and shed == 0
    rate, share = judged / number / lasted, clean / max(1.0, judged)
    text = f"{form} {number} feeders, {number * 147} sources: {rate:.3f} ticks per second and feeder"
    text += (
        f", {share:.3f} of them clean, {lost:.0f} lost, at most {most} shed at a look, {shed:.0f} at the end"
    )
    text += f", mean delay {delay:.2f} s, sender behind by {max(0.0, fleet.behind_s):.2f} s"
    readings = max(1.0, more["gridsec_readings_total"])
    zenoh_s, others_s = ((now - then) / readings for now, then in zip(after_s, spent, strict=True))
    cost_s = zenoh_s + others_s
    return Held(held, cost_s, zenoh_s, f"{text}, {1e6 * cost_s:.1f} us for a reading")


def print_against(site: Site, seconds: float, tree: Path) -> None:
    """Print the ratio of the processor time for a reading to that of another source tree."""
    with tempfile.TemporaryDirectory() as folder:
        for form in ("json", "arrow"):
            costs = []
            for one in (tree, OWN):
                found = holds(site, Path(folder), FIRST, form, seconds=seconds, tree=one)
                costs.append(found.cost_s)
                print(f"{one}: {found.text}", flush=True)
            print(
                f"{form}: processor time for a reading, ratio to {tree}: {costs[1] / costs[0]:.2f}",
                flush=True,
            )


def print_fleet(
    site: Site, seconds: float, numbers: range, forms: Sequence[str], server: Server | None = None
) -> None:
    """Print the number of meters that one process, or two workers, hold."""
    with tempfile.TemporaryDirectory() as folder:

        def held(form: str, number: int, lasting_s: float) -> bool:
            found = holds(site, Path(folder), number, form, seconds=lasting_s, server=server)
            print(f"{lasting_s:.0f} s, {'held' if found.held else 'not held'}: {found.text}", flush=True)
            return found.held

        for form in forms:
            best = number = numbers.start
            while number in numbers and held(form, number, min(RAMP_S, seconds)):
                best, number = number, max(number + 1, int(number * GROWTH))
            while seconds > RAMP_S and best > 1 and not held(form, best, seconds):
                best = int(best * RETREAT)
            print(f"{form}: {best * len(site.meter_ids)} meters", flush=True)


TICK_MAX, SINGLES_MIN, BATCHES_MIN = 3.0, 0.2, 1e5
"""Limits: a calm tick in steps, single messages over the raw rate, readings per second of batches."""


def main() -> int:
    """Measure."""
    options = dict.fromkeys(("costs", "workers", "json", "arrow"), False)
    asked = arguments(__doc__, seconds=20.0, most=200, first=FIRST, against="", **options)
    site = load(FEEDER)
    if asked.against:
        print_against(site, asked.seconds, Path(asked.against).resolve())
        return 0
    both = ("json", "arrow")
    forms = tuple(form for form in both if getattr(asked, form)) or both
    if asked.workers:
        with running_server(installed_postgresql()) as server:
            print_fleet(site, asked.seconds, range(asked.first, asked.most + 1), forms, server)
        return 0
    if asked.json or asked.arrow:
        print_fleet(site, asked.seconds, range(asked.first, asked.most + 1), forms)
        return 0
    tick = print_stages(site)
    singles, batches = print_rates(site)
    if not asked.costs:
        print_fleet(site, asked.seconds, range(asked.first, asked.most + 1), forms)
    return int(not (tick <= TICK_MAX and singles >= SINGLES_MIN and batches >= BATCHES_MIN))


if __name__ == "__main__":
    sys.exit(main())

"""Distributed estimation between concentrators against one estimator with all readings.

    python -m benchmarks.concentrators [FEEDER] [SEEDS] [CUSTOMERS]

AC power flow is the truth; loads, inverters and meters are simulated. The feeder is cut into areas of at
least CUSTOMERS customers. Rows: nothing wrong, manipulated meters, lost links, and one manipulated
concentrator, at an end or at the busbar. Columns: verdicts, manipulated meters named, honest meters named,
largest error of a concentrator that is not manipulated in volts and in its standard deviations, and largest
distance to the estimate of one estimator with the same trusted meters, in volts.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import Site, load, load_doubt, plant, to_frame
from feeders.simulation.scenario import Scenario, simulate, snapshots
from gridsec.arrays import Bools, Floats
from gridsec.estimators import distributed, front
from gridsec.estimators.distributed import (
    Area,
    AreaEstimate,
    Carry,
    Concentrator,
    Message,
    exchange,
    laterals,
    verdict,
)
from gridsec.estimators.front.posterior import voltage_prior
from gridsec.grid.radial import Feeder
from gridsec.interface import Frame

ROUNDS = 120
"""Rounds of the concentrators per tick that is judged: more than the longest search needs."""
SIZE_PU = 0.06
"""Manipulation of a squared voltage, pu: 6.9 V."""


@dataclass
class Row:
    """Results of one situation."""

    decisions: Counter[str] = field(default_factory=Counter)
    named: int = 0
    manipulated: int = 0
    honest: int = 0
    error_v: float = 0.0
    error_std: float = 0.0
    distance_v: float = 0.0

    def take(self, setting: Setting, found: AreaEstimate, area: Area, truth: Floats, whole: Floats) -> None:
        """Add the estimate of one concentrator."""
        at = [setting.bus[name] for name in area.feeder.buses]
        volt = 0.5 * setting.feeder.base_volt
        self.error_v = max(self.error_v, volt * float(np.abs(found.v2 - truth[at]).max()))
        self.error_std = max(self.error_std, float((np.abs(found.v2 - truth[at]) / found.std).max()))
        self.distance_v = max(self.distance_v, volt * float(np.abs(found.v2 - whole[at]).max()))

    def text(self, name: str) -> str:
        """Return the row of the table."""
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(self.decisions.items()))
        return (
            f"| {name} | {told} | {self.named} of {self.manipulated} | {self.honest} "
            f"| {self.error_v:.2f} | {self.error_std:.1f} | {self.distance_v:.1e} |"
        )


class Setting:
    """A feeder, cut into areas, and its central estimator."""

    def __init__(self, name: str, customers: int) -> None:
        self.site: Site = load(name)
        if not isinstance(self.site.feeder, Feeder):
            sys.exit(f"{name} is not a balanced radial feeder")
        self.feeder, self.doubt = self.site.feeder, load_doubt(self.site)
        whole = front.design(plant(self.site), doubt=self.doubt, step_s=1.0)
        self.noise: Floats = whole.white + whole.fixed
        accuracy = self.site.accuracy
        self.busbar = 2.0 * float(np.hypot(accuracy.busbar_class / np.sqrt(3.0), accuracy.busbar_jitter))
        tops = laterals(self.feeder, customers)
        self.areas: tuple[Area, ...] = distributed.design(
            self.feeder, self.site.meters, self.noise, self.doubt, tops=tops, busbar=self.busbar
        )
        buses = np.arange(len(self.feeder.buses))
        self.covariance = voltage_prior(self.feeder, buses, self.doubt, busbar=self.busbar).covariance
        self.at = self.feeder.bus[self.site.meters]
        self.bus = {name: k for k, name in enumerate(self.feeder.buses)}

    def tick(self, seed: int) -> tuple[Frame, Floats, Floats]:
        """Frame of a tick, reactive powers with those of the inverters, and true squared voltages."""
        sample = list(simulate(self.site, Scenario(seed=seed, duration_s=2.0, dt_s=1.0)))[-1]
        frame = to_frame(self.site, next(snapshots([sample])))
        v2, droop = np.ones(self.feeder.bus.size), self.site.droop
        v2[self.site.meters] = np.where(np.isnan(frame.y), 1.0, frame.y)
        x = droop.per_customer(droop(droop.vbar**2 - v2[droop.customer]), v2.size)
        q = np.where(np.isnan(frame.q_net), frame.q + x, frame.q_net)
        return frame, q, (sample.v_bus_volt / self.feeder.base_volt) ** 2

    def central(self, frame: Frame, q: Floats, y: Floats, trusted: Bools) -> Floats:
        """Squared voltages of all buses by one dense estimator."""
        model = self.feeder.bus_voltages(frame.p, q, frame.v0_squared)
        use = np.flatnonzero(trusted & np.isfinite(y))
        at = self.at[use]
        between = self.covariance[np.ix_(at, at)] + np.diag(self.noise[use])
        return np.asarray(model + self.covariance[:, at] @ np.linalg.solve(between, y[use] - model[at]))

    def run(self, row: Row, seed: int, liars: int, carry: Carry, false: frozenset[int]) -> None:
        """One tick with manipulated meters and links; `false` are the manipulated concentrators."""
        frame, q, truth = self.tick(seed)
        rng = np.random.default_rng([seed, liars])
        which = np.zeros(self.at.size, dtype=np.bool_)
        which[rng.choice(self.at.size, liars, replace=False)] = True
        y = frame.y + np.where(which, SIZE_PU * rng.choice([-1.0, 1.0], self.at.size), 0.0)
        posts = [Concentrator(area, self.noise[area.meters]) for area in self.areas]
        for post in posts:
            mine = post.area.customers
            post.observe(y[post.area.meters], frame.p[mine], q[mine], frame.v0_squared)
        exchange(posts, ROUNDS, carry=carry)
        estimates = {post.area.number: post.estimate() for post in posts}
        told = verdict(estimates, self.areas)
        named = np.zeros_like(which)
        named[list(told.meters)] = True
        row.decisions[told.decision.value] += 1
        row.named += int((named & which).sum())
        row.manipulated += liars
        row.honest += int((named & ~which).sum())
        trusted = np.ones_like(which)
        for post in posts:
            trusted[post.area.meters] = post.trusted
        whole = self.central(frame, q, y, trusted)
        for post in posts:
            if post.area.number not in false:
                row.take(self, estimates[post.area.number], post.area, truth, whole)


def lying(area: int, pu: float) -> Carry:
    """Links of a concentrator that moves the voltage of all its boundaries."""

    def carry(sender: int, _: int, message: Message) -> Message:
        if sender != area:
            return message
        return replace(message, vector=message.vector + pu * message.information[:, 0])

    return carry


def losing(part: float, seed: int) -> Carry:
    """Links that lose a part of the messages."""
    rng = np.random.default_rng(seed)
    return lambda _, __, message: None if rng.random() < part else message


def cut_off(area: int) -> Carry:
    """Links of a concentrator without a connection."""
    return lambda sender, to, message: None if area in {sender, to} else message


def main() -> int:
    """Print the table."""
    wanted = arguments(__doc__, feeder="kerber-vorstadtnetz", seeds=5, customers=12)
    setting = Setting(wanted.feeder, wanted.customers)
    ends = [area.number for area in setting.areas if not area.under]
    nothing: frozenset[int] = frozenset()
    third = setting.at.size // 3
    print(
        f"{wanted.feeder}: {setting.at.size} meters, {len(setting.areas)} areas, messages of "
        f"{setting.areas[0].size} variables, {wanted.seeds} seeds"
    )
    print("| situation | verdicts | manipulated named | honest named | error V | error / std | distance V |")
    print("|---|---|---|---|---|---|---|")
    rows: list[tuple[str, int, Callable[[int], Carry], frozenset[int]]] = [
        ("nothing wrong", 0, lambda _: lambda *args: args[2], nothing),
        ("1 meter", 1, lambda _: lambda *args: args[2], nothing),
        (f"{third} meters", third, lambda _: lambda *args: args[2], nothing),
        ("10 % of the messages lost", third, lambda seed: losing(0.1, seed), nothing),
        ("50 % of the messages lost", third, lambda seed: losing(0.5, seed), nothing),
        ("an end cut off", 0, lambda _: cut_off(ends[-1]), nothing),
        ("an end lies by 4.5 V", 0, lambda _: lying(ends[-1], 0.04), frozenset({ends[-1]})),
        ("an end lies by 0.2 V", 0, lambda _: lying(ends[-1], 0.002), frozenset({ends[-1]})),
        ("the busbar's lies by 4.5 V", 0, lambda _: lying(0, 0.04), frozenset({0})),
        ("the busbar's lies by 0.2 V", 0, lambda _: lying(0, 0.002), frozenset({0})),
    ]
    for name, liars, carry, false in rows:
        row = Row()
        for seed in range(wanted.seeds):
            setting.run(row, seed, liars, carry(seed), false)
        print(row.text(name), flush=True)
    _cost(setting)
    return 0


def _cost(setting: Setting) -> None:
    """Print the cost of one round and the size of a message."""
    frame, q, _ = setting.tick(0)
    posts = [Concentrator(area, setting.noise[area.meters]) for area in setting.areas]
    for post in posts:
        mine = post.area.customers
        post.observe(frame.y[post.area.meters], frame.p[mine], q[mine], frame.v0_squared)
    exchange(posts, ROUNDS)
    start = time.perf_counter()
    exchange(posts, ROUNDS)
    each = (time.perf_counter() - start) / ROUNDS / len(posts)
    trusted = np.ones(setting.at.size, dtype=np.bool_)
    start = time.perf_counter()
    for _ in range(ROUNDS):
        setting.central(frame, q, frame.y, trusted)
    whole = (time.perf_counter() - start) / ROUNDS
    size = max(len(message.to_json()) for post in posts for message in post.send().values())
    print(f"\nround of one concentrator / central estimate: {each / whole:.2f}; message: {size} bytes")


if __name__ == "__main__":
    sys.exit(main())

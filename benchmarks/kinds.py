"""Kinds that the default estimator gives to manipulations, counted. Run `python -m benchmarks.kinds`.

Every line is one kind of attack on one feeder, AC power flow with the droop inverters as the truth, one
reading per second, the meters' promised errors: how many lying meters were named, how long that took, and
what they were called at the end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from time import process_time

import numpy as np

from feeders.model.site import Site, load, to_frame
from feeders.registry import DesignedEstimator, design
from feeders.simulation.attacks import NoSuchAttack
from feeders.simulation.plant import MeterErrors
from feeders.simulation.scenario import START, Scenario, random_attacks, simulate, snapshots
from gridsec.attack import Attack, Replay
from gridsec.estimators.front import attack_kind

# Attack, number of liars, size in pu, begin and end in s. A clock's error is a replay since ever.
ATTACKS: tuple[tuple[str, int, float, float, float], ...] = (
    ("bias", 2, 0.06, 400.0, 700.0),
    ("scaling", 2, 0.06, 400.0, 700.0),
    ("drift", 2, 0.06, 400.0, 1000.0),
    ("stuck", 2, 0.06, 400.0, 700.0),
    ("replay", 2, 0.06, 600.0, 1000.0),
    ("random", 2, 0.06, 400.0, 700.0),
    ("coordinated", 4, 0.05, 400.0, 500.0),
    ("clock", 1, 0.0, 0.0, 7200.0),
)
DELAY_S = 500.0
CLOCK_S = 600.0


@dataclass
class Seen:
    """What became of the meters: when each was named first, s after the attack began, and its last kind."""

    named: dict[int, float] = field(default_factory=dict)
    kind: dict[int, str] = field(default_factory=dict)
    honest: set[int] = field(default_factory=set)
    alone: bool = False


def attacks(site: Site, kind: str, seed: int) -> tuple[tuple[Attack, ...], float]:
    """One attack of a kind, by the campaign's own draw of meters, and when all is over, s."""
    count, size, on, off = next(rest for first, *rest in ATTACKS if first == kind)
    t_on, t_off = START + on, START + off
    if kind == "clock":
        meter = np.array([seed % site.meters.size])
        return (Replay(meter, t_on, t_off, delay_s=CLOCK_S),), off
    drawn = random_attacks(site, seed, kind, int(count), size, t_on=t_on, t_off=t_off)
    return tuple(replace(one, delay_s=DELAY_S) if isinstance(one, Replay) else one for one in drawn), off


def watch(site: Site, watcher: DesignedEstimator, scenario: Scenario) -> Seen:
    """Play a scenario and keep the kinds given to each meter."""
    liars = {int(j) for attack in scenario.attacks for j in attack.meters}
    on = min((attack.t_on for attack in scenario.attacks), default=START)
    state, seen = watcher.init(START), Seen()
    for snapshot in snapshots(simulate(site, scenario)):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        seen.alone |= bool(attack_kind.repeat_lags(state.attack_kinds).any())
        for j in np.flatnonzero(verdict.suspects).tolist():
            if j not in liars:
                seen.honest.add(j)
                continue
            seen.named.setdefault(j, snapshot.t - on)
            seen.kind[j] = str(verdict.kinds[j])
    return seen


def told(name: str, kind: str, seeds: Iterable[int]) -> str:
    """One line of the table."""
    site = load(name)
    watcher = design(site)
    liars, called, honest = 0, Counter[str](), 0
    delays: list[float] = []
    for seed in seeds:
        try:
            drawn, off = attacks(site, kind, seed)
        except NoSuchAttack:
            continue
        liars += sum(attack.meters.size for attack in drawn)
        seen = watch(site, watcher, Scenario(seed=seed, duration_s=off, attacks=drawn))
        delays += seen.named.values()
        called.update(seen.kind.values())
        honest += len(seen.honest)
    text = ", ".join(f"{n} {what}" for what, n in called.most_common())
    middle = f"{np.median(delays):.0f} s" if delays else "-"
    return (
        f"{name:14} {kind:12} {len(delays):3} of {liars:3} named, median after {middle:>6}: {text}"
        f"; honest {honest}"
    )


def clean(name: str, hours: float, seeds: Iterable[int], errors: MeterErrors, profile_s: float) -> str:
    """Honest meters: how many were ever named, or repeated themselves beyond chance."""
    site = load(name)
    watcher = design(site)
    runs = [
        watch(
            site, watcher, Scenario(seed=seed, duration_s=3600.0 * hours, errors=errors, profile_s=profile_s)
        )
        for seed in seeds
    ]
    honest, alone = sum(len(seen.honest) for seen in runs), sum(seen.alone for seen in runs)
    hour = profile_s / 3600.0 % 24.0
    return (
        f"{name:14} clean, jitter {errors.jitter:g} of the promised, from hour {hour:g}: "
        f"{honest} named, {alone} of {len(runs)} runs of {hours:g} h with repetition as evidence"
    )


def cost(name: str, ticks: int = 4200) -> str:
    """What listening and describing cost per tick once the memory is full."""
    watcher = design(load(name))
    shapes, random = watcher.design.front.references, np.random.default_rng(0)
    p = shapes.limits.step.size
    live, none, state, times = np.ones(p, np.bool_), np.zeros(p, np.bool_), attack_kind.no_kinds(p), []
    for k in range(ticks):
        v = 1.0 + 0.01 * np.sin(k / 500.0) + 5e-4 * random.standard_normal(p)
        y = (np.rint(v / shapes.limits.step) * shapes.limits.step) ** 2
        begin = process_time()
        heard = attack_kind.ingest(shapes, state, y, live)
        attack_kind.repeat_lags(heard)
        state = attack_kind.classify(shapes, heard, y, y, none, y)
        times.append(process_time() - begin)
    kept = state.history.blocks
    size = sum(b.code.nbytes + b.hash.nbytes + b.model.nbytes + b.own.nbytes for b in kept) / 1e6
    last = np.array(times[-256:]) * 1e6
    return f"{name:20} {p} meters: {last.mean():.0f} us per tick, {size:.1f} MB"


def main() -> None:
    """Print the table."""
    for name, seeds in (("cigre-lv", range(10)), ("kerber-dorfnetz", range(10))):
        for kind, *_ in ATTACKS:
            if not (kind == "clock" and name != "cigre-lv"):
                print(told(name, kind, seeds), flush=True)
    for jitter in (1.0, 0.2, 0.0):
        for hour in (12.0, 1.0):
            print(
                clean("cigre-lv", 4.0, range(3), MeterErrors(jitter=jitter), 172_800.0 + 3600.0 * hour),
                flush=True,
            )
    print(cost("kerber-vorstadtnetz"))


if __name__ == "__main__":
    main()

"""Kinds of manipulations where meters are read every minute or quarter hour.

    python -m benchmarks.slow_kinds [interval in s] [seeds] [days] [feeder ...]

Days of AC power flow with the droop inverters as the truth and the meters' promised errors; every seed begins
on another weekday. The same honest days are lied about in all ways. Clocks are off since ever; two meters
begin with all other lies after 40 % of the days. Counted are lying meters that were named at all, the median
time until then, what they were called last and at all ticks while they were named, and honest meters that
were ever named, with what they were called last.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import Site, Snapshot, from_tables, load, to_frame
from feeders.registry import DesignedEstimator, design
from feeders.simulation.scenario import Scenario, simulate, snapshots
from gridsec.arrays import Floats, Ints

FEEDERS = ("cigre-lv", "kerber-dorfnetz")
DAY_S, MARGIN_S = 86_400.0, 3600.0
# Part of the days after which lies begin, and part of the rest that a drift takes.
BEGIN, GROWS = 0.4, 0.4

LIES: dict[str, tuple[str, float]] = {
    "nobody": ("nobody", 0.0),
    "bias of 6 %": ("bias", 0.06),
    "bias of 2 %": ("bias", 0.02),
    "scaling by 6 %": ("scaling", 0.06),
    "drift to 6 %": ("drift", 0.06),
    "drift to 3 %": ("drift", 0.03),
    "stuck": ("stuck", 0.0),
    "the last 24 h again and again": ("replay", 24.0),
    "the last 6 h again and again": ("replay", 6.0),
    "voltage 1 tick late": ("voltage", 1.0),
    "voltage 1 tick early": ("voltage", -1.0),
    "clock 1 tick behind": ("clock", 1.0),
    "clock 1 tick ahead": ("clock", -1.0),
    "clock 1 h behind": ("hours", 1.0),
    "clock 1 h ahead": ("hours", -1.0),
}
"""Kinds of lies and how much: pu, h, or ticks and hours by which the voltage or all readings are late."""


@dataclass(frozen=True, slots=True, eq=False)
class Days:
    """Readings of p meters at T ticks.

    Attributes
    ----------
    t : (T,)
        Unix times, s.
    v, p, q : (T, p)
        What meters say, V, kW and kvar.
    v0 : (T, ...)
        Voltage of the busbar, V.
    """

    t: Floats
    v: Floats
    p: Floats
    q: Floats
    v0: Floats

    @property
    def snapshots(self) -> Iterator[Snapshot]:
        """Tick by tick."""
        return (
            Snapshot(float(row[0]), *row[1:])
            for row in zip(self.t, self.v, self.p, self.q, self.v0, strict=True)
        )


@dataclass
class Seen:
    """When liars were named first, ticks after the lie began; last kinds, of honest ones named as well."""

    named: dict[int, int] = field(default_factory=dict)
    last: dict[int, str] = field(default_factory=dict)
    ticks: Counter[str] = field(default_factory=Counter)
    honest: dict[int, str] = field(default_factory=dict)


def read_every(site: Site, step_s: float) -> Site:
    """The same feeder, read once in a time, s."""
    meta = site.tables.meta
    meta = replace(meta, monitor=replace(meta.monitor, tick_s=step_s))
    return from_tables(replace(site.tables, meta=meta))


def played(site: Site, seed: int, days: float) -> Days:
    """What meters say that do not lie, an hour longer at both ends."""
    step_s, length = site.tables.meta.monitor.tick_s, days * DAY_S + 2.0 * MARGIN_S
    scenario = Scenario(seed=seed, duration_s=length, dt_s=step_s, profile_s=DAY_S * (seed % 7))
    rows = list(snapshots(simulate(site, scenario)))
    return Days(
        *(
            np.array([getattr(row, name) for row in rows])
            for name in ("t", "v_volt", "p_kw", "q_kvar", "v0_volt")
        )
    )


def lied(site: Site, days: Days, lie: str, seed: int) -> tuple[Days, Ints, int]:
    """The days with liars and without the hours at the ends; who lies, and from which tick on."""
    what, amount = LIES[lie]
    random, step_s = np.random.default_rng([9, seed]), site.tables.meta.monitor.tick_s
    margin = round(MARGIN_S / step_s)
    stop = len(days.t) - margin
    late = what in {"voltage", "clock", "hours"}
    on = margin if late else margin + round(BEGIN * (stop - margin))
    who = np.sort(random.choice(site.meters.size, {"nobody": 0}.get(what, 1 if late else 2), replace=False))
    at, told = np.arange(on, stop), {"v": days.v.copy(), "p": days.p.copy(), "q": days.q.copy()}
    cells = np.ix_(at, who)
    if late:
        lag = round(amount * (3600.0 / step_s if what == "hours" else 1.0))
        for name in "v" if what == "voltage" else "vpq":
            told[name][cells] = getattr(days, name)[np.ix_(at - lag, who)]
    else:
        size = amount * random.uniform(1.0, 1.5, who.size) * random.choice([-1.0, 1.0], who.size)
        told["v"][cells] = _voltages(what, days.v[:, who], at, size, max(1, round(amount * 3600.0 / step_s)))
    v, p, q = (told[name][margin:stop] for name in "vpq")
    return Days(days.t[margin:stop], v, p, q, days.v0[margin:stop]), who, on - margin


def _voltages(what: str, v: Floats, at: Ints, size: Floats, period: int) -> Floats:
    """What liars say their voltages are from `at[0]` on, V, (n, k)."""
    on = int(at[0])
    nominal = v[:on].mean(axis=0)
    match what:
        case "bias":
            return np.asarray(v[at] + size * nominal)
        case "scaling":
            return np.asarray(v[at] * (1.0 + size))
        case "drift":
            grown = np.minimum((at - on) / (GROWS * at.size), 1.0)
            return np.asarray(v[at] + grown[:, None] * size * nominal)
        case "stuck":
            return np.asarray(np.broadcast_to(v[on], (at.size, size.size)))
        case "replay":
            if period > on:
                raise ValueError(f"{on} ticks are too few to play {period} of them again")
            return np.asarray(v[on - period + (at - on) % period])
        case _:
            return v[at]


def watch(site: Site, watcher: DesignedEstimator, days: Days, who: Ints, on: int) -> Seen:
    """Let the monitor hear some days."""
    liars, seen = set(who.tolist()), Seen()
    state = watcher.init(float(days.t[0]) - site.tables.meta.monitor.tick_s)
    for tick, snapshot in enumerate(days.snapshots):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        for j in np.flatnonzero(verdict.suspects).tolist():
            if j not in liars:
                seen.honest[j] = str(verdict.kinds[j])
                continue
            seen.named.setdefault(j, tick - on)
            seen.last[j] = str(verdict.kinds[j])
            seen.ticks[seen.last[j]] += 1
    return seen


def line(site: Site, lie: str, runs: list[tuple[int, Seen]]) -> str:
    """One line of the table."""
    step_s = site.tables.meta.monitor.tick_s
    named = [ticks for _, seen in runs for ticks in seen.named.values()]
    last, ticks = (
        sum((Counter(part) for part in parts), Counter[str]())
        for parts in ((seen.last.values() for _, seen in runs), (seen.ticks for _, seen in runs))
    )
    middle = f"{np.median(named) * step_s / 3600.0:.1f} h" if named else ""
    whole = max(sum(ticks.values()), 1)
    shares = ", ".join(f"{100.0 * n / whole:.1f} % {what}" for what, n in ticks.most_common())
    honest = Counter(what for _, seen in runs for what in seen.honest.values())
    liars = sum(n for n, _ in runs)
    cells = site.feeder.name, lie, f"{len(named)} of {liars}", middle, _told(last), shares, _told(honest)
    return f"| {' | '.join(cells)} |"


def _told(counts: Counter[str]) -> str:
    return ", ".join(f"{n} {what}" for what, n in counts.most_common())


def main(step_s: float, seeds: int, days: float, feeders: Sequence[str] = FEEDERS) -> None:
    """Print the table."""
    print(f"every {step_s:g} s, {days:g} days, {seeds} seeds")
    print("| feeder | lie | named | median after | called | of all ticks | honest |")
    print("|---|---|---|---|---|---|---|")
    for name in feeders:
        site = read_every(load(name), step_s)
        watcher = design(site)
        honest = [played(site, seed, days) for seed in range(seeds)]
        for lie in LIES:
            runs = []
            for seed, one in enumerate(honest):
                told, who, on = lied(site, one, lie, seed)
                runs.append((who.size, watch(site, watcher, told, who, on)))
            print(line(site, lie, runs), flush=True)


if __name__ == "__main__":
    asked = arguments(__doc__, step_s=900.0, seeds=3, days=8.0, feeders=FEEDERS)
    main(asked.step_s, asked.seeds, asked.days, asked.feeders)

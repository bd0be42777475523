"""Loads, generation and busbar voltage as functions of time.

Every quantity is a pure function of the seed and of Unix time: any stretch, in any order and any chunks, has
the same numbers. The integrator may therefore take substeps of any length, and a scenario
with an attack has exactly the loads of that without it.

Profiles of 15 min are interpolated. A faster variation is added, an Ornstein-Uhlenbeck process for every
customer, so that readings at intervals of 1 s change from one to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from scipy.signal import lfilter

from feeders.profiles import Season, library, profile
from gridsec.arrays import Floats
from gridsec.grid.phased import InPhases

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.simulation.scenario import Scenario

GRID_S: Final = 1.0
"""Spacing of the random processes, s; linear in between."""

CHUNK_CORRELATIONS: Final = 16
"""Length of a chunk of a random process, in correlation times; its ends are independent (e^-16)."""

FARTHEST_INDEX: Final = 2**63
"""Bound of the absolute index of random streams."""

STAGGER_S: Final = 1800.0
"""Largest time shift between customers with the same profile, s, both ways."""


class Stream(IntEnum):
    """Independent random streams of a seed."""

    LOAD = 0
    CLOUD = 1
    COMMON_CLOUD = 2
    BUSBAR = 3
    TAP = 4
    CUSTOMER = 5
    METER = 6
    JITTER = 7
    CHANNEL = 8
    ATTACK = 9
    HIDDEN_P = 10
    HIDDEN_Q = 11
    UNBALANCE = 12


def generator(seed: int, stream: Stream, index: int = 0) -> np.random.Generator:
    """Random generator of one stream, at one index; negative indices have numbers of their own."""
    place = index if index >= 0 else FARTHEST_INDEX - index
    sequence = np.random.SeedSequence(entropy=seed, spawn_key=(int(stream), place))
    return np.random.Generator(np.random.Philox(sequence))


@dataclass(frozen=True, slots=True)
class Variation:
    """Variation of loads, generation and the busbar."""

    # Factors on the profiles, 1.
    load_scale: float = 1.0
    pv_scale: float = 1.0
    load_spread: float = 0.3  # standard deviation of the logarithm of each customer's fast variation, 1
    load_correlation_s: float = 600.0  # its correlation time, s
    # The same for generation. Half of its variance is common to the feeder, half is each roof's own.
    cloud_spread: float = 0.2
    cloud_correlation_s: float = 300.0
    busbar_pu: float = 1.0  # mean voltage of the busbar, pu of nominal
    # Standard deviation and correlation time of its slow variation, pu and s.
    busbar_spread_pu: float = 0.003
    busbar_correlation_s: float = 1800.0
    # In three phases: standard deviation of an equally slow variation of each phase, pu.
    busbar_unbalance_pu: float = 0.002
    tap_step_pu: float = 0.0125  # height of one step of the transformer's tap changer upstream, pu; 0: none
    tap_interval_s: float = 7200.0  # length of the intervals with one tap event each, at a random time, s
    # Standard deviations and correlation time, s, of the power of every metered customer beyond its readings,
    # for readings that are forecasts. None: those of the feeder's files (`p_std_kw`, `q_std_kvar`), 0 for
    # empty cells.
    hidden_kw: float | None = 0.0
    hidden_kvar: float | None = 0.0
    hidden_correlation_s: float = 600.0


class Fluctuation:
    """Stationary Ornstein-Uhlenbeck process of unit variance, in `count` independent copies.

    Sampled exactly every GRID_S, autocorrelation exp(-abs(dt) / correlation_s). It consists of chunks that
    are joined as bridges: the values at the chunks' ends are independent, and the path between them is
    conditioned on both.
    """

    def __init__(self, seed: int, stream: Stream, count: int, correlation_s: float) -> None:
        self._seed = seed
        self._stream = stream
        self._count = count
        self._steps = max(round(CHUNK_CORRELATIONS * correlation_s / GRID_S), 1)
        self._decay = float(np.exp(-GRID_S / correlation_s))
        self._chunks: dict[int, Floats] = {}

    def at(self, t: Floats) -> Floats:
        """Process at times t (T,), Unix s, not necessarily sorted: (T, count)."""
        place = t / GRID_S
        below = np.floor(place)
        share = (place - below)[:, None]
        chunk, step = np.divmod(below.astype(np.int64), self._steps)
        out = np.empty((t.size, self._count))
        for number in np.unique(chunk):
            rows = chunk == number
            path = self._chunk(int(number))
            low, high = path[step[rows]], path[step[rows] + 1]
            out[rows] = low + share[rows] * (high - low)
        return out

    def _chunk(self, number: int) -> Floats:
        """Path of one chunk including both ends, (steps + 1, count)."""
        if number not in self._chunks:
            if len(self._chunks) >= 4:
                self._chunks.pop(next(iter(self._chunks)))
            self._chunks[number] = self._path(number)
        return self._chunks[number]

    def _path(self, number: int) -> Floats:
        start, end = self._end(number), self._end(number + 1)
        random = generator(self._seed, self._stream, 2 * number + 1)
        noise = np.sqrt(1.0 - self._decay**2) * random.standard_normal((self._steps, self._count))
        path = np.empty((self._steps + 1, self._count))
        path[0] = start
        path[1:], _ = lfilter([1.0], [1.0, -self._decay], noise, axis=0, zi=(self._decay * start)[None, :])
        # Gaussian path conditioned on its last value: add covariance(k, n) / variance(n) times the
        # difference.
        k = np.arange(self._steps + 1)
        n = self._steps
        weight = (self._decay ** (n - k) - self._decay ** (n + k)) / (1.0 - self._decay ** (2 * n))
        path += weight[:, None] * (end - path[-1])
        return path

    def _end(self, number: int) -> Floats:
        return generator(self._seed, self._stream, 2 * number).standard_normal(self._count)


@dataclass(frozen=True, slots=True, eq=False)
class Demand:
    """Powers of all customers at T times, without the droop inverters' reactive power."""

    p_kw: Floats  # (T, N): net active import: load minus generation, kW
    q_kvar: Floats  # (T, N): reactive import of the loads, kvar
    v0_volt: Floats  # (T,) or (T, 3): busbar voltage, V; in three phases that of each


class Customers:
    """Loads, generation and busbar of a feeder over time.

    Loads are between 0 and `load_kw`, generation between 0 and `pv_kw`. Each customer has a constant ratio q
    / p inside the interval of power factors of the feeder's files. It also has a constant reactive power
    within plus or minus the floor of the files. The monitor knows neither. At Unix time `start` the season's
    profiles, which repeat, are at `profile_s`, s.
    """

    def __init__(
        self,
        site: Site,
        variation: Variation,
        seed: int,
        start: float,
        profile_s: float,
        *,
        season: Season = Season.SUMMER,
    ) -> None:
        count, base = len(site.tables.customers), site.feeder.base_kva
        self._variation = variation
        self._nominal = site.tables.meta.voltage_volt
        self._seed = seed
        self._origin = start - profile_s
        self._load_kw = np.array([row.load_kw for row in site.tables.customers])
        self._pv_kw = np.array([row.pv_kw for row in site.tables.customers])
        random = generator(seed, Stream.CUSTOMER)
        self._stagger = random.uniform(-STAGGER_S, STAGGER_S, count)
        self._tan = random.uniform(site.loads.tan_min, site.loads.tan_max)
        self._q_floor_kvar = random.uniform(-1.0, 1.0, count) * site.loads.q_floor * base
        profiles = library(season)
        self._profile_t = np.append(profiles.t_s, 2.0 * profiles.t_s[-1] - profiles.t_s[-2])
        self._load = [_curve(profiles.load_p, row.load_profile) for row in site.tables.customers]
        self._pv = [_curve(profiles.pv, row.pv_profile) for row in site.tables.customers]
        self._load_noise = Fluctuation(seed, Stream.LOAD, count, variation.load_correlation_s)
        self._cloud = Fluctuation(seed, Stream.CLOUD, count, variation.cloud_correlation_s)
        self._sky = Fluctuation(seed, Stream.COMMON_CLOUD, 1, variation.cloud_correlation_s)
        self._busbar = Fluctuation(seed, Stream.BUSBAR, 1, variation.busbar_correlation_s)
        self._unbalance = None
        if isinstance(site.feeder, InPhases):
            self._unbalance = Fluctuation(seed, Stream.UNBALANCE, 3, variation.busbar_correlation_s)
        rows, metered = site.tables.customers, np.array([bool(row.meter) for row in site.tables.customers])
        self._hidden_kw = metered * _told(variation.hidden_kw, [row.p_std_kw for row in rows])
        self._hidden_kvar = metered * _told(variation.hidden_kvar, [row.q_std_kvar for row in rows])
        self._hidden_p = Fluctuation(seed, Stream.HIDDEN_P, count, variation.hidden_correlation_s)
        self._hidden_q = Fluctuation(seed, Stream.HIDDEN_Q, count, variation.hidden_correlation_s)

    @classmethod
    def of(cls, site: Site, scenario: Scenario) -> Self:
        """Customers of a scenario."""
        start, season = scenario.start, scenario.season
        return cls(site, scenario.variation, scenario.seed, start, scenario.profile_s, season=season)

    def at(self, t: Floats) -> Demand:
        """Powers and busbar voltage at times t (T,), Unix s."""
        load = self._loads(t)
        return Demand(
            p_kw=load - self._generation(t),
            q_kvar=self._tan * load + self._q_floor_kvar,
            v0_volt=self._busbar_volt(t),
        )

    def hidden(self, t: Floats) -> tuple[Floats | float, Floats | float]:
        """Powers at times t (T,) beyond `at`, kW and kvar, (T, N) each; 0.0 without any."""
        kw, kvar = self._hidden_kw, self._hidden_kvar
        return (
            kw * self._hidden_p.at(t) if kw.any() else 0.0,
            kvar * self._hidden_q.at(t) if kvar.any() else 0.0,
        )

    def _loads(self, t: Floats) -> Floats:
        spread = self._variation.load_spread
        shape = self._follow(self._load, t, self._stagger)
        # exp of a Gaussian with this mean has mean 1.
        fast = np.exp(spread * self._load_noise.at(t) - 0.5 * spread**2)
        load: Floats = self._load_kw * (self._variation.load_scale * shape * fast)
        return np.clip(load, 0.0, self._load_kw)

    def _generation(self, t: Floats) -> Floats:
        spread = self._variation.cloud_spread
        if not self._pv_kw.any():
            return np.zeros((t.size, self._pv_kw.size))
        shape = self._follow(self._pv, t, np.zeros(self._pv_kw.size))
        fast = np.exp(spread * np.sqrt(0.5) * (self._cloud.at(t) + self._sky.at(t)) - 0.5 * spread**2)
        generation: Floats = self._pv_kw * (self._variation.pv_scale * shape * fast)
        return np.clip(generation, 0.0, self._pv_kw)

    def _follow(self, curves: list[Floats], t: Floats, shift: Floats) -> Floats:
        """Profiles at times t, one per customer, each with its own shift: (T, N)."""
        period = self._profile_t[-1]
        out = np.empty((t.size, len(curves)))
        for i, curve in enumerate(curves):
            out[:, i] = np.interp((t - self._origin + shift[i]) % period, self._profile_t, curve)
        return out

    def _busbar_volt(self, t: Floats) -> Floats:
        slow = self._variation.busbar_spread_pu * self._busbar.at(t)[:, 0]
        volt: Floats = self._nominal * (self._variation.busbar_pu + slow + self._tap(t))
        if self._unbalance is None:
            return volt
        spread = self._nominal * self._variation.busbar_unbalance_pu
        return np.asarray(volt[:, None] + spread * self._unbalance.at(t))

    def _tap(self, t: Floats) -> Floats:
        """Contribution of the tap changer, pu: each event moves it to one of the positions -1, 0, 1."""
        step, interval = self._variation.tap_step_pu, self._variation.tap_interval_s
        out = np.zeros(t.size)
        if step == 0.0:
            return out
        number = np.floor_divide(t, interval).astype(np.int64)
        for event in np.unique(number):
            rows = number == event
            when, after = self._event(int(event))
            _, before = self._event(int(event) - 1)
            out[rows] = step * np.where(t[rows] < (event + when) * interval, before, after)
        return out

    def _event(self, number: int) -> tuple[float, int]:
        """Relative time of an event in its interval (0 to 1), and the tap position after it."""
        random = generator(self._seed, Stream.TAP, number)
        return float(random.random()), int(random.integers(-1, 2))


def _told(size: float | None, files: list[float | None]) -> Floats:
    """One standard deviation for all, or those of the files."""
    return np.array([0.0 if told is None else told for told in files] if size is None else [size])


def _curve(library: dict[str, Floats], name: str) -> Floats:
    """One profile with its first sample repeated at its end."""
    values = profile(library, name)
    return np.append(values, values[0])

"""Residuals drawn from the model of `estimators.modal`, and the dense Kalman filter of all states as its
oracle."""

from __future__ import annotations

from math import exp

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.modal import core
from gridsec.estimators.modal.core import Core
from gridsec.estimators.modal.model import ResidualModel
from gridsec.grid.network import Power
from gridsec.grid.radial import Feeder

BASE_KVA = 100.0
"""Base of random feeders, kVA."""


def tree(customers: int, random: np.random.Generator, drop: float = 0.03) -> Feeder:
    """Random radial feeder with one customer at each bus.

    Parameters
    ----------
    customers
        N.
    random
        Chooses everything random.
    drop
        Largest voltage drop at 5 kW per customer, pu.
    """
    parent = np.array([random.integers(max(0, k - 3), k + 1) for k in range(customers)])
    r = random.uniform(0.5, 1.5, customers)
    below, depth = np.ones(customers + 1), np.zeros(customers + 1)
    for k in range(customers, 0, -1):
        below[parent[k - 1]] += below[k]
    for k in range(1, customers + 1):
        depth[k] = depth[parent[k - 1]] + r[k - 1] * below[k] * 5.0 / BASE_KVA
    r *= drop / depth.max()
    return Feeder(
        name="tree",
        parent=parent,
        r=r,
        x=0.4 * r,
        bus=np.arange(1, customers + 1),
        customers=tuple(f"c{k}" for k in range(customers)),
        buses=tuple(f"b{k}" for k in range(customers + 1)),
        base_volt=230.0,
        base_kva=BASE_KVA,
        charging=np.zeros(customers),
    )


def model_of(
    feeder: Feeder,
    *,
    p_std: float = 0.006,
    q_std: float = 0.002,
    jitter: Floats | float = 5e-4,
    classes: Floats | float = 0.005,
    busbar: float = 1e-3,
    flicker: float = 2e-4,
    time_s: float = 600.0,
    fixed_s: float = np.inf,
) -> ResidualModel:
    """Model of a balanced radial feeder, all errors as parts of the nominal voltage.

    Parameters
    ----------
    feeder
        The feeder; all customers have meters.
    p_std, q_std
        Standard deviations of the errors of powers, pu.
    jitter, classes
        White standard deviation and accuracy class of the meters, one or (p,).
    busbar, flicker
        Standard deviations of the fixed and of the white error of the busbar's meter.
    time_s, fixed_s
        As in `ResidualModel`.
    """
    at, n = feeder.bus, len(feeder.buses)
    sizes = ((Power.ACTIVE, np.full(at.size, p_std**2)), (Power.REACTIVE, np.full(at.size, q_std**2)))
    return ResidualModel(
        of_meters=np.sum([feeder.covariance(power, at, of) for power, of in sizes], axis=0),
        variance=np.sum([feeder.variances(power, of) for power, of in sizes], axis=0),
        meters=at,
        white=np.broadcast_to(4.0 * np.square(jitter), at.shape).astype(np.float64),
        fixed=np.broadcast_to(4.0 * np.square(classes) / 3.0, at.shape).astype(np.float64),
        busbar=4.0 * busbar**2,
        flicker=4.0 * flicker**2,
        busbar_of=np.ones((n, 1)),
        time_s=time_s,
        fixed_s=fixed_s,
    )


def tree_core(number: int, salt: int, sizes: tuple[int, int]) -> tuple[Core, Feeder]:
    """Core of a random tree with unread powers as faults, and the tree.

    number, salt: seed; even and odd numbers differ in the errors of their meters. sizes: least number of
    customers, and one more than the largest.
    """
    random = np.random.default_rng([number, salt])
    feeder = tree(int(random.integers(*sizes)), random)
    model = model_of(feeder, jitter=(5e-4, 2e-3)[number % 2])
    powers = feeder.columns(Power.ACTIVE, np.arange(feeder.bus.size))
    return core.assemble(model, powers, np.full(feeder.bus.size, 0.14), gamma=1e6), feeder


def power_columns(feeder: Feeder) -> Floats:
    """Effect of every customer's active power, then of the reactive ones, on the meters, (p, 2 N)."""
    every = np.arange(feeder.bus.size)
    return np.hstack([feeder.columns(power, every)[feeder.bus] for power in Power])


def root(matrix: Floats) -> Floats:
    """Square root of a positive semidefinite matrix, ``root root' = matrix``, (k, k)."""
    lam, Q = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray(Q * np.sqrt(np.maximum(lam, 0.0)))


class Source:
    """Honest residuals of a model, tick by tick.

    Parameters
    ----------
    model
        The model.
    random
        Chooses everything random.
    step_s
        Interval, s.
    """

    def __init__(self, model: ResidualModel, random: np.random.Generator, step_s: float = 1.0) -> None:
        at = np.arange(model.meters.size)
        self.random, self.size = random, at.size
        self.rho, self.rho_b = exp(-step_s / model.time_s), exp(-step_s / model.fixed_s)
        self.noise = root(model.noise(at))
        self.loads = root(model.loads(at))
        self.ages = root(model.aging(at))
        # What has aged since the start is added to errors of the first tick: exact for times far below T_b.
        self.w, self.b = self.loads @ self._white(), root(model.static(at)) @ self._white()
        self.aged = np.zeros(self.size)

    def _white(self) -> Floats:
        return self.random.standard_normal(self.size)

    def tick(self) -> Floats:
        """Residuals of the next tick, (p,)."""
        out = self.w + self.b + self.aged + self.noise @ self._white()
        self.w = self.rho * self.w + np.sqrt(1.0 - self.rho**2) * (self.loads @ self._white())
        self.aged = self.rho_b * self.aged + np.sqrt(1.0 - self.rho_b**2) * (self.ages @ self._white())
        return np.asarray(out)

    def ticks(self, count: int) -> Floats:
        """Residuals of the next ticks, (count, p)."""
        return np.stack([self.tick() for _ in range(count)])


class Dense:
    """Kalman filter of the 3 p states (w, aging b, constant b) and of k constant faults, by dense matrices.

    Parameters
    ----------
    model
        The model.
    faults : (p, k)
        Directions of the faults.
    std
        Prior standard deviation of their amounts.
    at : (t,)
        Meters in use; None: all.
    """

    def __init__(
        self, model: ResidualModel, faults: Floats | None = None, std: float = 1.0, at: Ints | None = None
    ) -> None:
        at = np.arange(model.meters.size) if at is None else at
        p = at.size
        G = np.zeros((p, 0)) if faults is None else faults[at]
        self.model, self.p, self.k = model, p, G.shape[1]
        self.prior = np.zeros((3 * p + self.k, 3 * p + self.k))
        self.prior[:p, :p] = model.loads(at)
        self.prior[p : 2 * p, p : 2 * p] = model.aging(at)
        self.prior[2 * p : 3 * p, 2 * p : 3 * p] = model.static(at) - model.aging(at)
        self.prior[3 * p :, 3 * p :] = std**2 * np.eye(self.k)
        self.H, self.D = np.hstack([np.eye(p), np.eye(p), np.eye(p), G]), model.noise(at)
        self.mean, self.cov = np.zeros(len(self.prior)), self.prior.copy()

    @property
    def varies(self) -> Floats:
        """Mean of w, (p,)."""
        return self.mean[: self.p]

    @property
    def lasts(self) -> Floats:
        """Mean of b, (p,)."""
        return self.mean[self.p : 2 * self.p] + self.mean[2 * self.p : 3 * self.p]

    def step(
        self, h: float, m: Floats, seen: Bools | None = None, level: float = 1.0, jump: float = 0.0
    ) -> tuple[Floats, Floats]:
        """One tick: innovations of the meters with a reading, and their covariance.

        Parameters
        ----------
        h
            Interval, s.
        m : (t,)
            Residuals.
        seen : (t,)
            Meters with a reading; None: all.
        level
            Level of the faults at this tick: 0 before their onset.
        jump
            Variance of a jump of w, in that of w, 1.
        """
        p, k = self.p, self.k
        rho, rho_b = exp(-h / self.model.time_s), exp(-h / self.model.fixed_s)
        F = np.concatenate([np.full(p, rho), np.full(p, rho_b), np.ones(p + k)])
        self.mean = F * self.mean
        both = np.outer(F, F)
        self.cov = both * self.cov + (1.0 - both) * np.where(np.arange(F.size) < 2 * p, self.prior, 0.0)
        self.cov[:p, :p] += jump * self.prior[:p, :p]
        rows = np.arange(p) if seen is None else np.flatnonzero(seen)
        H = self.H[rows] * np.where(np.arange(F.size) < 3 * p, 1.0, level)
        V = H @ self.cov @ H.T + self.D[np.ix_(rows, rows)]
        nu = m[rows] - H @ self.mean
        K = np.linalg.solve(V, H @ self.cov).T
        self.mean = self.mean + K @ nu
        self.cov = self.cov - K @ V @ K.T
        self.cov = 0.5 * (self.cov + self.cov.T)
        return nu, V


PATTERNS = ("complete", "in turn", "twice", "half", "10 %", "50 %", "alternating")
"""Patterns of missing readings; see `present`."""


def present(pattern: str, meters: int, ticks: int, random: np.random.Generator) -> Bools:
    """Meters with a reading at each tick, (ticks, p).

    Parameters
    ----------
    pattern
        "in turn": 30 % are silent for 60 ticks each; "twice": 30 % for 600 ticks, from tick 60 and from the
        middle on; "half": half are always silent; "10 %" and "50 %": missing at random; "alternating": each
        meter reports at every fourth tick.
    meters, ticks
        Numbers of meters and ticks.
    random
        Chooses everything random.
    """
    seen, some = np.ones((ticks, meters), dtype=np.bool_), round(0.3 * meters)
    if pattern == "in turn":
        order = random.permutation(meters)
        for k in range(0, ticks, 60):
            seen[k : k + 60, order[(k // 60 * some + np.arange(some)) % meters]] = False
    elif pattern == "twice":
        for k in (60, ticks // 2):
            seen[k : k + 600, random.permutation(meters)[:some]] = False
    elif pattern == "half":
        seen[:, random.permutation(meters)[: meters // 2]] = False
    elif pattern in {"10 %", "50 %"}:
        seen = random.random((ticks, meters)) >= float(pattern[:-2]) / 100.0
    elif pattern == "alternating":
        seen = (np.arange(ticks)[:, None] + random.integers(0, 4, meters)) % 4 == 0
    return seen


class KnownStep:
    """Likelihood ratio of a step of known size at a known meter, by the dense filter, for every onset.

    Parameters
    ----------
    model
        The model; errors that last are constant.
    meter, size
        The meter, and the step, squared pu.
    onsets
        Largest number of onsets.
    """

    def __init__(self, model: ResidualModel, meter: int, size: float, onsets: int) -> None:
        at = np.arange(model.meters.size)
        self.p, self.model, self.meter, self.size, self.count = at.size, model, meter, size, 0
        self.w, self.D = model.loads(at), model.noise(at)
        self.P = np.zeros((2 * self.p, 2 * self.p))
        self.P[: self.p, : self.p], self.P[self.p :, self.p :] = self.w, model.static(at)
        self.x, self.X = np.zeros(2 * self.p), np.zeros((2 * self.p, onsets))
        self.y, self.F = np.zeros(onsets), np.zeros(onsets)

    def step(self, h: float, m: Floats, seen: Bools, begin: bool) -> float:
        """One tick; the largest log likelihood ratio.

        Parameters
        ----------
        h
            Interval, s.
        m, seen : (p,)
            Residuals, and meters with a reading.
        begin
            An onset begins at this tick.
        """
        p, rho = self.p, exp(-h / self.model.time_s)
        self.count += begin
        k, R = self.count, np.repeat([rho, 1.0], p)
        self.x, self.P = R * self.x, self.P * np.outer(R, R)
        self.X *= R[:, None]
        self.P[:p, :p] += (1.0 - rho * rho) * self.w
        n = np.flatnonzero(seen)
        HP = self.P[n] + self.P[p + n]
        V = HP[:, n] + HP[:, p + n] + self.D[np.ix_(n, n)]
        nu = (m - self.x[:p] - self.x[p:])[n]
        gamma = (np.equal.outer(np.arange(p), np.full(k, self.meter)) - self.X[:p, :k] - self.X[p:, :k])[n]
        solved = np.linalg.solve(V, np.column_stack([nu, gamma, HP]))
        self.y[:k] += gamma.T @ solved[:, 0]
        self.F[:k] += (gamma * solved[:, 1 : k + 1]).sum(axis=0)
        self.x += HP.T @ solved[:, 0]
        self.X[:, :k] += HP.T @ solved[:, 1 : k + 1]
        self.P -= HP.T @ solved[:, k + 1 :]
        return float((self.size * self.y - 0.5 * self.size**2 * self.F)[: max(k, 1)].max())

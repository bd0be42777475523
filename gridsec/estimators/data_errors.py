"""Errors of a feeder's files that explain the readings as well as a manipulation does.

The readings of a window are compared under two hypotheses. H_a: each accused meter has an offset, a slope and
a gain of its own. H_b: customers and their meters are at other places than stated in the files. With e the
squared voltages read minus those of the files, T blocks by p meters, and d the change by other places,

    H_a: e_j = c_j + s_j t + g_j m_j + n for accused j,    H_b: e = d + n,

where m_j is the voltage of the model and n has the covariance of loads and meters. The slopes and the gains
of H_a are used if they improve the fit by more than their price, ln T each. H_b has no free number: it must
explain the size of the deviation as well as its changes with the loads. A window with constant loads decides
nothing.

Source: docs/theory-front.md, section 9.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints
from gridsec.estimators.plant import Plant
from gridsec.grid.meshed import PhasedMesh
from gridsec.grid.network import Network
from gridsec.grid.phased import PhasedFeeder
from gridsec.interface import Frame, PowerOrigin, Verdict

__all__ = [
    "AccusationWindow",
    "DataError",
    "DataErrorDesign",
    "DataErrorKind",
    "accused",
    "begin",
    "design",
    "follow",
]

BLOCK_S: Final = 60.0
"""Smallest duration of a block, s: the mean of a minute removes jitter and keeps the changes of the loads."""

FEWEST_BLOCKS: Final = 10
"""Blocks before the first comparison: ten minutes of one-second readings."""

MOST_BLOCKS: Final = 60
"""Blocks of the window: one hour of one-second readings, 15 hours of quarter-hours."""

MOST_PLACES: Final = 400
"""Largest number of places for the comparison, which then takes 0.4 s per block.

With more places, those of the customers' buses are the candidates.
"""

MOST_ACCUSED: Final = 12
"""Accused meters with candidate places of their own, largest deviation first; it bounds the time of a block.
"""

COMPARED: Final = 32
"""Changes of places compared on all meters, the most promising ones first."""

SOLVED: Final = 4
"""Changes of places with a power flow with losses, the most likely of the linear model first."""

RISK: Final = 1e-4
"""Probability of a hint by chance, and of a misfit beyond its limit for a correct hint."""

COMMON: Final = 0.5
"""Share of the variance of unknown powers that is common to all customers, as in `model.load_uncertainty`."""

MODEL_STD: Final = 2e-4
"""Error of the power flow independent of the loads, squared pu: the remainder of the loss correction."""

PLAUSIBLE_V2: Final = (0.25, 2.25)
"""Squared voltages of half and of one and a half of nominal, pu.

Beyond them a reported power is absurd, and the block decides nothing.
"""

KEPT_FACTORS: Final = 4
"""Pairs of Cholesky factors in memory: 10 MB at `MOST_PLACES`."""

FAR_SIGMAS: Final = 4.0
"""Deviation in standard deviations beyond which a change of places does not explain an accused meter."""


class DataErrorKind(StrEnum):
    """Kind of an error of the files."""

    PHASE = "phase"
    EXCHANGED_PHASES = "exchanged-phases"
    EXCHANGED_METERS = "exchanged-meters"
    BUS = "bus"


@dataclass(frozen=True, slots=True)
class DataError:
    """An error of the files that explains accused meters. p meters, N customers, n places."""

    kind: DataErrorKind  # kind
    customers: tuple[int, ...]  # indices of the one or two customers at other places than in the files
    places: tuple[int, ...]  # place of each of them that explains the readings, as in `gridsec.grid.network`
    meters: tuple[int, ...]  # indices of the accused meters that it explains


@dataclass(frozen=True, slots=True, eq=False)
class DataErrorDesign:
    """Sensitivities between all places that customers may have. N customers, C places."""

    plant: Plant  # feeder, inverters and meters
    anywhere: Network  # the same feeder with one customer at each of the places
    places: Ints  # (C,) places, ascending
    at: Ints  # (N,) index of each customer's place in `places`
    unit: Floats  # (C,) 1 pu of each place, V; customers are exchanged only between equal ones
    # active, reactive (C, C): from a power at one place to the squared voltage at another, pu
    active: Floats
    reactive: Floats
    block_s: float  # duration of a block, s


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Means of blocks. T blocks, p meters, N customers, C places."""

    t: Floats  # (T,) time of each block, s
    y: Floats  # (T, p) squared voltages read, pu; NaN without a reading
    # p, q (T, N): injections, pu
    p: Floats
    q: Floats
    # p_var, q_var (T, N): variances of their errors, squared pu
    p_var: Floats
    q_var: Floats
    read: Bools  # (T, N) active power is a reading
    v0: Floats  # (T, b) squared busbar voltage, pu; one, or those of three phases
    model: Floats  # (T, C) squared voltages of the files' model, pu
    count: Floats  # (T,) number of frames
    accused: Bools  # (T, p) meters accused within the block

    def joined(self, later: Rows) -> Rows:
        """These and later blocks, at most `MOST_BLOCKS` of them."""
        both = ((getattr(self, each.name), getattr(later, each.name)) for each in fields(self))
        return Rows(*(np.concatenate(pair)[-MOST_BLOCKS:] for pair in both))

    def where(self, which: Bools) -> Rows:
        """The blocks of a mask (T,)."""
        return Rows(*(getattr(self, each.name)[which] for each in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class _Mean:
    """Sums of a power and of the variance of its error, (2, N) each: of readings, and of all frames."""

    told: Floats
    told_count: Floats  # (N,)
    every: Floats

    @staticmethod
    def of(power: Floats, variance: Floats, told: Bools) -> _Mean:
        both = np.array([power, variance])
        return _Mean(np.where(told, both, 0.0), told.astype(np.float64), both)

    def __add__(self, other: _Mean) -> _Mean:
        return _Mean(self.told + other.told, self.told_count + other.told_count, self.every + other.every)

    def value(self, count: int) -> Floats:
        """Power and variance (2, N): of the readings if there are any, since a lost reading is no change."""
        some = self.told_count > 0.0
        return np.where(some, self.told / np.where(some, self.told_count, 1.0), self.every / count)


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Sums over the frames of the incomplete block."""

    block: int
    count: int
    y: Floats
    heard: Floats
    p: _Mean
    q: _Mean
    v0: Floats
    accused: Bools


@dataclass(frozen=True, slots=True, eq=False)
class AccusationWindow:
    """Readings since the first accusation, and their result. Empty while no meter is accused."""

    rows: Rows | None = None  # complete blocks, at most `MOST_BLOCKS`; None before the first one
    error: DataError | None = None  # error of the files that explains accused meters; None if there is none
    t: float | None = None  # time of the last frame, s; None without one
    sums: _Sums | None = field(default=None, repr=False)
    since_accused: int = 0


def begin() -> AccusationWindow:
    """Return the empty window."""
    return AccusationWindow()


def design(plant: Plant, base_volt: Floats, step_s: float) -> DataErrorDesign | None:
    """Prepare the comparison; None if the customers' buses have more than `MOST_PLACES` places.

    base_volt (n,): 1 pu of every place, V.
    step_s: interval between frames, s.
    """
    feeder = plant.feeder
    places = feeder.places(np.arange(len(feeder.buses) // feeder.busbar_phases))
    if places.size > MOST_PLACES:
        places = feeder.places(np.unique(feeder.bus // feeder.busbar_phases))
    if places.size > MOST_PLACES:
        return None
    anywhere = feeder.with_customers_at(places)
    model = anywhere.linear()
    return DataErrorDesign(
        plant=plant,
        anywhere=anywhere,
        places=frozen_ints(places),
        at=frozen_ints(np.searchsorted(places, feeder.bus)),
        unit=frozen(base_volt[places]),
        active=frozen(2.0 * model.R),
        reactive=frozen(2.0 * model.X),
        block_s=max(BLOCK_S, step_s),
    )


def accused(verdict: Verdict) -> Bools:
    """Return the meters (p,) accused by a verdict: named, or part of one of several explanations."""
    out = verdict.suspects.copy()
    for explanation in verdict.explanations:
        out |= explanation.meters
    return out


def follow(
    design: DataErrorDesign, window: AccusationWindow, frame: Frame, x: Floats, accused: Bools
) -> AccusationWindow:
    """Add one frame to the window; compare at the end of each block.

    frame: data of one tick. A frame that is not later than the last, or later by more than a window, restarts
        the window.
    x (m,): estimated injections of the inverters, pu.
    """
    if window.t is not None and not window.t < frame.t <= window.t + MOST_BLOCKS * design.block_s:
        window = AccusationWindow()
    if window.t is None and not accused.any():
        return window
    block = math.floor(frame.t / design.block_s)
    if window.sums is not None and window.sums.block != block:
        window = _closed(design, window, window.sums)
        if window.since_accused > MOST_BLOCKS:
            return AccusationWindow()
    v0 = frame.v0_phases if design.plant.feeder.busbar_phases == 3 else np.array([frame.v0_squared])
    if v0 is None or not np.isfinite(v0).all():
        return replace(window, t=frame.t)
    return replace(
        window, t=frame.t, sums=_added(design, window.sums, frame, block, x=x, v0=v0, accused=accused)
    )


def _added(
    design: DataErrorDesign,
    sums: _Sums | None,
    frame: Frame,
    block: int,
    *,
    x: Floats,
    v0: Floats,
    accused: Bools,
) -> _Sums:
    heard = frame.seen & np.isfinite(frame.y)
    reports = np.isfinite(frame.q_net)
    q = np.where(reports, frame.q_net, frame.q + design.plant.droop.per_customer(x, frame.q.size))
    q_error = np.where(reports, frame.q_net_error, frame.q_error)
    read = np.ones(q.size, dtype=np.bool_) if frame.p_origin is None else frame.p_origin == PowerOrigin.READ
    now = _Sums(
        block,
        1,
        np.where(heard, frame.y, 0.0),
        heard.astype(np.float64),
        _Mean.of(frame.p, _variance(frame.p_error, frame.p_std), read),
        _Mean.of(q, _variance(q_error, frame.q_std), reports),
        v0,
        accused,
    )
    if sums is None:
        return now
    total = {name: getattr(sums, name) + getattr(now, name) for name in _SUMMED}
    return replace(now, **total, accused=sums.accused | accused)


# Fields of `_Sums` that are added up.
_SUMMED: Final = ("count", "y", "heard", "p", "q", "v0")


def _variance(half_width: Floats, std: Floats | None) -> Floats:
    """Variance of a uniform error, or the stated one."""
    uniform = half_width**2 / 3.0
    return uniform if std is None else np.where(np.isnan(std), uniform, std**2)


def _closed(design: DataErrorDesign, window: AccusationWindow, sums: _Sums) -> AccusationWindow:
    """The window with one more complete block."""
    (p, p_var), (q, q_var), v0 = sums.p.value(sums.count), sums.q.value(sums.count), sums.v0 / sums.count
    model = _solved(design, design.at, p[None], q[None], v0=v0[None])[0]
    with np.errstate(all="ignore"):
        y = sums.y / sums.heard  # NaN without a reading
    t = (sums.block + 0.5) * design.block_s
    read, count = sums.p.told_count > 0.0, float(sums.count)
    row = (t, y, p, q, p_var, q_var, read, v0, model, count, sums.accused)
    now = Rows(*(np.asarray(each)[None] for each in row))
    rows = now if window.rows is None else window.rows.joined(now)
    since = 0 if sums.accused.any() else window.since_accused + 1
    return AccusationWindow(rows, compare(design, rows, window.error), window.t, None, since)


def _solved(design: DataErrorDesign, at: Ints, p: Floats, q: Floats, *, v0: Floats) -> Floats:
    """Squared voltages (T, C) with losses, by the place of each customer; not finite for absurd powers."""
    feeder, shape = design.anywhere, (len(p), design.places.size)
    P, Q = np.zeros(shape), np.zeros(shape)
    for there, power in ((P, p), (Q, q)):
        np.add.at(there.T, at, power.T)
    with np.errstate(all="ignore"):
        if isinstance(feeder, PhasedMesh):  # one operating point at a time
            each = zip(P, Q, v0, strict=True)
            v2 = np.array([feeder.bus_voltages(*one, steps=_LOSS_STEPS) for one in each])
        else:
            busbar = v0 if isinstance(feeder, PhasedFeeder) else v0[:, 0]
            v2 = feeder.bus_voltages(P, Q, busbar, steps=_LOSS_STEPS)
    return np.asarray(v2[:, design.places])


_LOSS_STEPS: Final = 3
"""Corrections of the linear power flow: the third changes less than the resolution of a meter."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A window prepared for comparison. T blocks, k meters with readings in all of them."""

    design: DataErrorDesign
    rows: Rows
    meters: Ints  # (k,)
    at: Ints  # (k,) their places
    e: Floats  # (T, k)
    accused: Bools  # (k,)
    fixed: Floats  # (k, k) covariance of the means
    varying: Floats  # (k, k) covariance of the changes
    attacked: dict[bytes, float] = field(default_factory=dict)  # misfit of H_a, by the compared meters
    factors: dict[bytes, tuple[Floats, Floats]] = field(default_factory=dict)  # of both covariances, likewise

    def factored(self, use: Ints) -> tuple[Floats, Floats]:
        """Lower Cholesky factors of `fixed` and `varying` for `use`; most changes compare the same meters."""
        key = use.tobytes()
        if key not in self.factors:
            if len(self.factors) == KEPT_FACTORS:
                self.factors.clear()
            self.factors[key] = (
                _factor(self.fixed[np.ix_(use, use)]),
                _factor(self.varying[np.ix_(use, use)]),
            )
        return self.factors[key]


def compare(design: DataErrorDesign, rows: Rows, held: DataError | None = None) -> DataError | None:
    """Return the error of the files that explains accused meters at least as well as a manipulation does.

    held: error found before; it stays unless another one is likelier by more than `_STAYS`.
    """
    scene = _scene(design, rows)
    if scene is None or not scene.accused.any():
        return None
    moves = list(_moves(scene))
    limit = 2.0 * math.log(max(len(moves), 1) / RISK)
    best, found = 0.0, None
    for move in _promising(scene, moves, held):
        gain, meters = _gain(scene, move.shifted(scene), move.customers, limit)
        stays = _STAYS * move.same(design, held)
        if meters and gain > 0.0 and gain + stays > best:
            best, found = gain + stays, DataError(move.kind, move.customers, move.places(design), meters)
    return found


_STAYS: Final = -2.0 * math.log(RISK)
"""Twice the log-likelihood by which another error must be likelier than the previous one."""


def _scene(design: DataErrorDesign, rows: Rows) -> _Scene | None:
    """Blocks and meters without gaps; None if they are too few."""
    plant = design.plant
    heard = np.isfinite(rows.y)
    k = np.flatnonzero(heard.mean(axis=0) >= _HEARD)
    read = rows.read.mean(axis=0) >= _HEARD
    low, high = PLAUSIBLE_V2
    possible = ((rows.model >= low) & (rows.model <= high)).all(axis=1)
    whole = heard[:, k].all(axis=1) & rows.read[:, read].all(axis=1) & possible
    if np.count_nonzero(whole) < FEWEST_BLOCKS:
        return None
    rows = rows.where(np.asarray(whole))
    at = design.at[plant.meters[k]]
    e = rows.y[:, k] - rows.model[:, at]
    loads = _load_covariance(design, rows, at)
    accuracy = plant.accuracy
    v2 = rows.model[:, at].mean(axis=0)
    jitter = (
        4.0 * v2 * (accuracy.jitter[k] ** 2 + accuracy.resolution[k] ** 2 / 12.0) * (1.0 / rows.count).mean()
    )
    busbar = (
        4.0 * (accuracy.busbar_jitter**2 + accuracy.busbar_resolution**2 / 12.0) * (1.0 / rows.count).mean()
    )
    together = plant.feeder.same_busbar_phase(design.places[at], design.places[at])
    varying = loads + np.diag(jitter + MODEL_STD**2) + busbar * together
    fixed = varying + np.diag(4.0 / 3.0 * v2**2 * accuracy.class_fraction[k] ** 2)
    fixed += 4.0 / 3.0 * accuracy.busbar_class**2 * together
    return _Scene(design, rows, k, at, e, np.asarray(rows.accused[:, k].any(axis=0)), fixed, varying)


_HEARD: Final = 0.8
"""Share of blocks with a reading below which a meter is left out, and a power counts as unread."""


def _load_covariance(design: DataErrorDesign, rows: Rows, at: Ints) -> Floats:
    """Covariance (k, k) of the voltage errors at some places by errors of the powers, squared pu^2."""
    out = np.zeros((at.size, at.size))
    for matrix, variance in ((design.active, rows.p_var), (design.reactive, rows.q_var)):
        effect = matrix[np.ix_(at, design.at)] * np.sqrt(variance.mean(axis=0))
        total = effect.sum(axis=1)
        out += (1.0 - COMMON) * effect @ effect.T + COMMON * np.multiply.outer(total, total)
    return out


@dataclass(frozen=True, slots=True)
class _Move:
    """Customers at other places, indices into `DataErrorDesign.places`."""

    kind: DataErrorKind
    customers: tuple[int, ...]
    to: tuple[int, ...]

    def places(self, design: DataErrorDesign) -> tuple[int, ...]:
        """Places of the customers, as in `DataError`."""
        return tuple(int(design.places[k]) for k in self.to)

    def same(self, design: DataErrorDesign, error: DataError | None) -> bool:
        """True if the change of places is that of an error."""
        now = (self.kind, self.customers, self.places(design))
        return error is not None and now == (error.kind, error.customers, error.places)

    def shifted(self, scene: _Scene) -> Floats:
        """d: effect of the change on the voltages of all meters, losses included, (T, k)."""
        design, rows = scene.design, scene.rows
        at = design.at.copy()
        at[list(self.customers)] = self.to
        there = at[design.plant.meters[scene.meters]]
        v2 = _solved(design, at, rows.p, rows.q, v0=rows.v0)
        return np.asarray(v2[:, there] - rows.model[:, scene.at])


def _moves(scene: _Scene) -> Iterator[_Move]:
    """All single errors of the files at the accused meters with the largest deviations."""
    design, seen = scene.design, set[tuple[tuple[int, int], ...]]()
    off = np.abs(scene.e.mean(axis=0)) / np.sqrt(np.diagonal(scene.fixed))
    far = sorted(np.flatnonzero(scene.accused).tolist(), key=lambda j: -off[j])[:MOST_ACCUSED]
    for customer in design.plant.meters[scene.meters[far]].tolist():
        for move in _of_customer(design, customer):
            key = tuple(sorted(zip(move.customers, move.to, strict=True)))
            if key not in seen:
                seen.add(key)
                yield move


def _of_customer(design: DataErrorDesign, i: int) -> Iterator[_Move]:
    here, feeder = int(design.at[i]), design.plant.feeder
    place = int(design.places[here])
    index = {int(q): k for k, q in enumerate(design.places)}
    level = np.flatnonzero(design.unit == design.unit[here]).tolist()
    phases = feeder.busbar_phases
    for k in level:
        other = int(design.places[k])
        if other == place:
            continue
        if other // phases == place // phases:
            yield _Move(DataErrorKind.PHASE, (i,), (k,))
        elif other % phases == place % phases:
            yield _Move(DataErrorKind.BUS, (i,), (k,))
    metered = set(design.plant.meters.tolist())
    for j, k in enumerate(design.at.tolist()):
        other = int(design.places[k])
        if k == here or design.unit[k] != design.unit[here]:
            continue
        if other % phases != place % phases:
            mine = index.get(place - place % phases + other % phases)
            its = index.get(other - other % phases + place % phases)
            if mine is not None and its is not None:
                yield _Move(DataErrorKind.EXCHANGED_PHASES, (i, j), (mine, its))
        if j in metered:
            yield _Move(DataErrorKind.EXCHANGED_METERS, (i, j), (k, here))


def _shift(scene: _Scene, move: _Move, which: Ints) -> Floats:
    """d: effect of a change of places on the voltages of the model at some of the meters, (T, w)."""
    design, rows = scene.design, scene.rows
    customer = design.plant.meters[scene.meters[which]]
    now = scene.at[which].copy()
    for i, k in zip(move.customers, move.to, strict=True):
        now[customer == i] = k
    out = rows.model[:, now] - rows.model[:, scene.at[which]]
    for i, k in zip(move.customers, move.to, strict=True):
        for matrix, power in ((design.active, rows.p), (design.reactive, rows.q)):
            out += np.multiply.outer(power[:, i], matrix[now, k] - matrix[now, design.at[i]])
    return np.asarray(out)


def _promising(scene: _Scene, moves: list[_Move], held: DataError | None) -> list[_Move]:
    """The most likely changes of places by the linear model, and the one found before."""
    customer = scene.design.plant.meters[scene.meters]
    row = {int(i): k for k, i in enumerate(customer)}

    def at_moved(move: _Move) -> float:
        which = np.array([row[i] for i in move.customers if i in row], dtype=np.intp)
        e = scene.e[:, which]
        fixed, varying = np.diagonal(scene.fixed)[which], np.diagonal(scene.varying)[which]
        rest = e - _shift(scene, move, which)
        return _alone(rest, fixed, varying) - _alone(e, fixed, varying)

    def everywhere(move: _Move) -> float:
        shift = _shift(scene, move, np.arange(scene.meters.size))
        return -_gain(scene, shift, move.customers, 0.0, sure=False)[0]

    first = sorted(moves, key=at_moved)[:COMPARED]
    solved = sorted(first, key=everywhere)[:SOLVED]
    return solved + [move for move in moves if move not in solved and move.same(scene.design, held)]


def _alone(rest: Floats, fixed: Floats, varying: Floats) -> float:
    """Misfit of independent meters: of their means, and of the changes."""
    mean = rest.mean(axis=0)
    return float((mean**2 / fixed).sum() + ((rest - mean) ** 2 / varying).sum())


def _gain(
    scene: _Scene, shift: Floats, customers: tuple[int, ...], limit: float, *, sure: bool = True
) -> tuple[float, tuple[int, ...]]:
    """Misfit that a change of places saves against a manipulation, and the accused meters explained.

    With `sure` a change with a misfit beyond its limit explains none. Errors of the loads may last for the
    whole window: a block's misfit is compared with the limit of one block.
    """
    rest = scene.e - shift
    mean = rest.mean(axis=0)
    far = np.abs(mean) > FAR_SIGMAS * np.sqrt(np.diagonal(scene.fixed))
    moved = np.isin(scene.design.plant.meters[scene.meters], customers)
    use = np.flatnonzero(~(far & scene.accused & ~moved))
    explained = scene.accused[use]
    fixed, varying = scene.factored(use)
    most = float(chdtri(use.size, RISK))
    of_mean, left = _squared(fixed, mean[None, use]), _squared(varying, (rest - mean)[:, use])
    if sure and (of_mean > most or left > most * len(rest)):
        return 0.0, ()
    of_attack = scene.attacked.get(use.tobytes())
    if of_attack is None:
        of_attack = scene.attacked[use.tobytes()] = _manipulated(scene, use)
    gain = of_attack - left - limit
    return gain if sure else gain - of_mean, tuple(scene.meters[use[explained]].tolist())


def _factor(covariance: Floats) -> Floats:
    """Lower Cholesky factor."""
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def _squared(factor: Floats, rest: Floats) -> float:
    return float((solve_triangular(factor, rest.T, lower=True) ** 2).sum())


def _manipulated(scene: _Scene, use: Ints) -> float:
    """Least misfit of the changes with slopes, gains, both or neither at accused meters; price ln T each.

    With weights W, regressors r_a(t) at meters j_a and changes e, the normal equations have the entries
    ``W[j_a, j_b] sum_t r_a r_b`` and ``sum_t r_a (W e)_a``.
    """
    at = np.flatnonzero(scene.accused[use])
    weights = np.linalg.inv(scene.varying[np.ix_(use, use)])
    e = scene.e[:, use] - scene.e[:, use].mean(axis=0)
    weighted = e @ weights
    whole = float((weighted * e).sum())
    slope, model = scene.rows.t[:, None] + np.zeros(at.size), scene.rows.model[:, scene.at[use[at]]]
    least = whole
    for columns in ((slope,), (model,), (slope, model)):
        r, j = np.hstack(columns), np.tile(at, len(columns))
        r = r - r.mean(axis=0)
        size = np.abs(r).max(axis=0)
        r /= np.where(size > 0.0, size, 1.0)
        normal, right = weights[np.ix_(j, j)] * (r.T @ r), (r * weighted[:, j]).sum(axis=0)
        fitted, *_ = np.linalg.lstsq(normal, right, rcond=None)
        least = min(least, whole - float(right @ fitted) + r.shape[1] * math.log(len(e)))
    return least

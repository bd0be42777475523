"""Changes of the readings by errors of meters, loads, lines and customers' places in the files.

Squared voltages at Q places (a bus, or a phase of a bus), from power flow with the losses, and linear
sensitivities from powers at one place to the voltage at another. One class serves balanced feeders and those
of three phases: a customer is connected to places with weights that add up to 1.

With U the squared voltages by the files and the metered powers, the readings less U are to first order

    2 y_j b_j                       bias b_j of meter j, relative to the busbar's
    -(drop of U along branch l)     per unit of its length, at the places behind it
    A_ji p_i, B_ji q_i              errors of the gain of power registers
    -B_ji load_i                    error of tan(phi) where q is not metered; -B_ji: q at p = 0
    -B_ji roof_i (1, cos, sin, ...) load hidden by generation, with its daily course

and for customers at other places, exactly in the linear flow, ``W'(U + dU) - W U`` with W, W' the weights.
On closed loops a place has a complex share of a line's drop, rather than being behind the line or not.
Behind transformers places have bases of their own. A meter's readings are in the base of its place in the
files: a customer at another place reads the volts of that place. Means of phases weigh each by its base.

References
----------
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, Phasors

__all__ = ["Doubts", "Places", "Regressors", "Series", "regressors", "steps"]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Model of a feeder for readings. Q places, N customers, p meters, L branches, F phases (1 or 3).

    Attributes
    ----------
    active, reactive : (Q, Q)
        Change of the squared voltage at a place per power injected at another, pu, the factor 2 included.
    phase : (Q,)
        Phase of each place, 0 to F - 1.
    share : (Q, L)
        Share of a line's drop at a place: 1 behind a branch of a tree and 0 elsewhere, complex in loops.
    weight : (N, Q)
        Connections of each customer; rows add up to 1.
    meters : (p,)
        Customer of each meter.
    volt : (Q,)
        1 pu of each place, V.
    unit : (p,)
        1 pu of each meter's readings, V.
    """

    active: Floats
    reactive: Floats
    phase: Ints
    share: Floats | Phasors
    weight: Floats
    meters: Ints
    volt: Floats
    unit: Floats

    def read(self, weight: Floats) -> Floats:
        """Matrix from the places' squared voltages to the readings of meters with these weights, (p, Q) both.

        ``(mean of a v)^2 / unit^2`` with a the bases, linear in v^2 near 1 pu.
        """
        own = weight * self.volt
        return np.asarray(own * (own.sum(axis=1) / self.unit**2)[:, None])

    @property
    def of_phases(self) -> Floats:
        """Effect of a squared voltage of each phase, common to all places, at the meters, (p, F)."""
        W = self.read(self.weight[self.meters])
        return np.stack([W[:, self.phase == f].sum(axis=1) for f in range(self.phase.max() + 1)], axis=1)

    @property
    def at_meters(self) -> tuple[Floats, Floats]:
        """Sensitivities of the meters to the customers' powers, (p, N) each."""
        W = self.read(self.weight[self.meters])
        return W @ self.active @ self.weight.T, W @ self.reactive @ self.weight.T

    def moved(self, series: Series, change: Mapping[int, Floats]) -> Floats:
        """Change of the meters' squared voltages for customers at other places, (T, p).

        Parameters
        ----------
        change
            New weights (Q,) of each moved customer.
        """
        weight = self.weight[self.meters]
        before = self.read(weight)
        for j, customer in enumerate(self.meters.tolist()):
            if customer in change:
                weight[j] = change[customer]
        W = self.read(weight)
        away: Floats = np.zeros((series.t.size, W.shape[0]))
        moves = np.flatnonzero(np.isin(self.meters, list(change)))
        away[:, moves] = series.places @ (W - before)[moves].T
        used = np.flatnonzero(W.any(axis=0))
        for customer, new in change.items():
            shift = new - self.weight[customer]
            some = np.flatnonzero(shift)
            for matrix, power in ((self.active, series.p), (self.reactive, series.q)):
                gain = W[:, used] @ (matrix[np.ix_(used, some)] @ shift[some])
                away += np.outer(power[:, customer], gain)
        return away

    def rephased(self, series: Series, parts: Sequence[tuple[Ints, int, int]]) -> Floats:
        """Change of the meters' squared voltages for parts of one phase that are on another phase, (T, p).

        The customers' powers move from the place that feeds a part to another phase of its bus. The drop
        along the part stays, and so do the ratios of its bases. Several parts change together.

        Parameters
        ----------
        parts
            For each part: its customers, the place that feeds it, and the place on the other phase.
        """
        W = self.read(self.weight[self.meters])
        shift: Floats = np.zeros_like(series.places)
        for customers, one, other in parts:
            for matrix, power in ((self.active, series.p), (self.reactive, series.q)):
                shift += np.outer(power[:, customers].sum(axis=1), matrix[:, other] - matrix[:, one])
        away = shift @ W.T
        for customers, one, other in parts:
            on = np.flatnonzero(np.isin(self.meters, customers))
            was = series.places @ W[on].T
            rise = series.places[:, other] + shift[:, other] - series.places[:, one]
            base = (self.volt[other] / self.volt[one]) ** 2
            away[:, on] = base * (was + np.outer(rise, W[on].sum(axis=1))) - was
        return np.asarray(away)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Readings and the files' model of them. T frames.

    Attributes
    ----------
    t : (T,)
        Times, s.
    y : (T, p)
        Squared voltages read, pu; arbitrary where not seen.
    seen : (T, p)
        True where there is a reading.
    p, q : (T, N)
        Net injections, pu.
    load : (T, N)
        Loads with reactive power by a power factor, pu.
    roof : (T, N)
        Reactive power of the load that generation may hide, where only the difference is metered, pu.
    steep : (T, N)
        Derivative of the inverter's q in the squared voltage read; 0 without one, or with q metered.
    places : (T, Q)
        Squared voltages by power flow, pu.
    drop : (T, F, L)
        Their drop along each line, pu; in loops ``2 conj(V) (V_one - V_other)`` with V in its middle.
    """

    t: Floats
    y: Floats
    seen: Bools
    p: Floats
    q: Floats
    load: Floats
    roof: Floats
    steep: Floats
    places: Floats
    drop: Floats | Phasors

    def residual(self, places: Places) -> Floats:
        """Readings less power flow, (T, p); 0 without a reading."""
        model = self.places @ places.read(places.weight[places.meters]).T
        return np.where(self.seen, self.y - model, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Doubts:
    """Prior standard deviations of uncertain quantities; 0 for known ones.

    Attributes
    ----------
    bias : (p,)
        Fixed error of each meter, relative to the busbar's, 1.
    p_gain, q_gain : (N,)
        Relative error of the power registers, 1.
    tan : (N,)
        Error of tan(phi) where q is not metered, 1.
    roof : (N,)
        Actual share of `Series.roof`, its mean and its daily course, 1.
    p_level, q_level : (N,)
        Constant error of the powers, pu.
    length : (L,)
        Relative tolerance of a branch's length, 1.
    """

    bias: Floats
    p_gain: Floats
    q_gain: Floats
    tan: Floats
    roof: Floats
    p_level: Floats
    q_level: Floats
    length: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Regressors:
    """Regressors by kind, one after the other.

    Attributes
    ----------
    columns : (T, p, K)
        Effect of a unit of each coefficient, squared pu.
    spread : (K,)
        Prior standard deviations.
    where : kind -> (k,)
        Indices of columns by the names of `Doubts`; k depends on the kind.
    """

    columns: Floats
    spread: Floats
    where: dict[str, Ints]


def regressors(places: Places, series: Series, doubts: Doubts) -> Regressors:
    """All regressors of a feeder with correct files."""
    A, B = places.at_meters
    seen = series.seen[:, :, None]

    def spatial(matrix: Floats, power: Floats) -> Floats:
        return np.asarray(matrix[None] * power[:, None, :])

    p, T = series.y.shape[1], series.t.size
    bias = np.zeros((T, p, p))
    twice = np.where(series.seen, 2.0 * series.y, 0.0)
    bias[:, np.arange(p), np.arange(p)] = twice
    # The assumed reactive power of an inverter follows its own meter's reading.
    bias -= spatial(B[:, places.meters], twice * series.steep[:, places.meters])
    parts = {
        "bias": bias,
        "p_gain": spatial(A, series.p),
        "q_gain": spatial(B, series.q),
        "tan": spatial(B, -series.load),
        "roof": np.concatenate([spatial(B, -shape * series.roof) for shape in _day(series.t)], axis=2),
        "p_level": spatial(A, np.ones_like(series.p)),
        "q_level": spatial(B, np.ones_like(series.p)),
        "length": lengthened(places, series),
    }
    count = np.cumsum([0, *(part.shape[2] for part in parts.values())])
    return Regressors(
        columns=np.where(seen, np.concatenate(list(parts.values()), axis=2), 0.0),
        spread=np.concatenate([np.tile(getattr(doubts, name), 5 if name == "roof" else 1) for name in parts]),
        where={name: np.arange(a, b) for name, a, b in zip(parts, count[:-1], count[1:], strict=True)},
    )


def _day(t: Floats) -> list[Floats]:
    """Mean and daily course in two harmonics, (T, 1) each: sufficient for the course of solar generation."""
    turn = 2.0 * np.pi / 86400.0 * t[:, None]
    return [np.ones_like(turn), *(wave(k * turn) for k in (1.0, 2.0) for wave in (np.cos, np.sin))]


def lengthened(places: Places, series: Series) -> Floats:
    """Change of the meters' squared voltages if a line's length doubles, negative, (T, p, L)."""
    W = places.read(places.weight[places.meters])
    phases = series.drop.shape[1]
    by_phase = [W[:, places.phase == f] @ places.share[places.phase == f] for f in range(phases)]
    return -sum(
        ((part[None] * series.drop[:, f, None, :]).real for f, part in enumerate(by_phase)),
        np.zeros((1, 1, 1)),
    )


def steps(series: Series, meter: int, pieces: int) -> tuple[Floats, list[tuple[float, float]]]:
    """Intervals in which one meter's error may differ from its usual: parts of the recording, and rests.

    Parameters
    ----------
    pieces
        Number of intervals with equally many frames.

    Returns
    -------
    (T, p, H), [H pairs]
        Effect of a relative error in each interval, and its begin and end, s.
    """
    T, p = series.y.shape
    cuts = np.linspace(0, T, pieces + 1).astype(np.intp)
    spans = [(cuts[a], cuts[a + 1]) for a in range(pieces)] + [(cuts[a], T) for a in range(1, pieces - 1)]
    spans += [(cuts[a], cuts[a + 2]) for a in range(pieces - 2)]
    out = np.zeros((T, p, len(spans)))
    twice = np.where(series.seen[:, meter], 2.0 * series.y[:, meter], 0.0)
    for h, (first, end) in enumerate(spans):
        out[first:end, meter, h] = twice[first:end]
    times = [(float(series.t[first]), float(series.t[end - 1])) for first, end in spans]
    return out, times

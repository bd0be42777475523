"""Signatures of faults: effect of a fault begun at an onset on the innovations, and the information about it.

A fault ``f`` of the members begun at onset k adds ``u_t f`` to the residuals, ``u_t = 1`` for a step and
``u_t = (t - k) / T_r`` for a ramp. Every mode answers by itself, so one number per mode stands for all
faults:

    gamma = u - rho g_w - rho_b g_b,   g <- (rho g_w, rho_b g_b) + k phi gamma
    a += gamma nu / v,   i += gamma^2 phi / v,   c += gamma gamma_0 phi / v

with the update (nu, v, k, phi) of `gridsec.estimators.modal.filter` and gamma_0 of
`gridsec.estimators.modal.static`. For a column W of faults in the modes, ``W = U' F``, and theta integrated
out, score and information of its amount are

    y = W' (a - c * Gamma theta),   I = W' (diag(i) - diag(c) Gamma N Gamma' diag(c)) W

and ``exp(y' f - f' I f / 2)`` is the likelihood ratio of the fault against none, given all readings so far.

With many directions (more than `static.FEW`) I takes only those of the busbar into account. It is then too
large by a positive semidefinite matrix, and mixtures of likelihood ratios are too small: their expectation
without a fault is at most 1.

References
----------
Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems, IEEE Trans. Automatic Control 21, 1976.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.modal.filter import Update
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.static import FEW, Static, current

RAMP_S = 600.0
"""Time in which a unit ramp reaches 1, s: the time scale of the loads."""


_ALL = slice(None)


@dataclass(frozen=True, slots=True, eq=False)
class Onsets:
    """Rows of onsets, each a step or a ramp. k rows, t modes. A row that is not in use is zero.

    Attributes
    ----------
    age : (k,)
        Ticks since the onset, its own included; 0 where not in use.
    used, ramp : (k,)
        Rows in use, and rows of ramps.
    level : (k,)
        u of the last tick.
    signature : (2, k, t)
        g of w and of b, after the last update.
    score, information, cross : (k, t)
        Score of the exact innovation, i and c.
    read : (k, t) or None
        Part of i at each member that was read; None where nothing is missing since the filter is modal.
    """

    age: Ints
    used: Bools
    ramp: Bools
    level: Floats
    signature: Floats = field(repr=False)
    score: Floats = field(repr=False)
    information: Floats = field(repr=False)
    cross: Floats = field(repr=False)
    read: Floats | None = field(default=None, repr=False)


def empty(modes: Modes, steps: int, ramps: int = 0) -> Onsets:
    """Rows without onsets.

    Parameters
    ----------
    modes
        The modes.
    steps, ramps
        Numbers of rows.
    """
    k, t = steps + ramps, modes.size
    none = np.zeros(k, dtype=np.bool_)
    zero = np.zeros((k, t))
    return Onsets(
        age=np.zeros(k, dtype=np.intp),
        used=none,
        ramp=np.arange(k) >= steps,
        level=np.zeros(k),
        signature=np.zeros((2, k, t)),
        score=zero,
        information=zero,
        cross=zero,
    )


def follow(
    modes: Modes,
    onsets: Onsets,
    update: Update,
    static: Static,
    h: float,
    *,
    begun: Sequence[int] = (),
    ended: Sequence[int] = (),
) -> Onsets:
    """Take in one step of the filter; O(k t), and O(k t^2) where readings are missing.

    Parameters
    ----------
    modes, onsets
        The modes, and the onsets so far.
    update
        The filter's step.
    static
        Information about the directions, this step included.
    h
        Interval, s.
    begun, ended
        Rows, not in use so far, for onsets at this tick, and other rows that are given back.
    """
    rho, rho_b = update.decay
    age, used, level = onsets.age, onsets.used, onsets.level
    if begun or ended:
        age, used, level = age.copy(), used.copy(), level.copy()
        for row in begun:
            used[row], level[row] = True, not onsets.ramp[row]
        for row in ended:
            used[row], level[row], age[row] = False, 0.0, 0
    level = level + h / RAMP_S * (onsets.ramp & used)
    g = onsets.signature * np.array([rho, rho_b])[:, None, None]
    gamma = level[:, None] - g[0]
    gamma -= g[1]
    weighed = gamma / update.variance
    score = gamma * static.score
    score -= onsets.cross * static.moved
    score += onsets.score
    told = weighed if update.kept is None else weighed * update.kept
    information = weighed * gamma
    read = _read(modes, onsets, update, gamma)
    information += onsets.information
    cross = told * static.gamma
    cross += onsets.cross
    g += update.gain[:, None, :] * (gamma if update.kept is None else gamma * update.kept)
    for row in ended:
        g[:, row] = score[row] = information[row] = cross[row] = 0.0
        if read is not None:
            read[row] = 0.0
    return Onsets(age + used, used, onsets.ramp, level, g, score, information, cross, read)


def _read(modes: Modes, onsets: Onsets, update: Update, gamma: Floats) -> Floats | None:
    """Part of the information at each member that was read, with that of one tick, (k, t).

    Only the effect of a member's fault on its own reading is lost with that reading.
    """
    if update.score is None:
        return None
    felt = gamma / np.sqrt(update.variance)
    out = (felt * felt) @ modes.squares.T
    if update.seen is not None:
        white = modes.model.white[modes.at]
        own = (felt @ modes.squares.T) ** 2 * white
        out -= np.where(update.seen, 0.0, np.minimum(own, out))
    out += onsets.information @ modes.squares.T if onsets.read is None else onsets.read
    return np.asarray(out)


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Scores and information of all modes with theta integrated out. k rows, t modes, r directions in use.

    Attributes
    ----------
    score, information : (k, t)
        ``a - c * Gamma theta`` and i.
    side : (k, r, t)
        ``diag(c) Gamma`` of the directions that count.
    cov : (r, r)
        Their N.
    share : (k, t) or None
        Share of the information that was read at each member; None for 1.
    """

    score: Floats
    information: Floats
    side: Floats
    cov: Floats
    share: Floats | None = None

    def of(self, W: Floats, squares: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
        """Scores and information of single columns, (k, q) each.

        Parameters
        ----------
        W, squares : (t, q)
            The columns in the modes, and their squares.
        weights : (t, q)
            Share of each member in the effect of each column; None: the columns are the members.
        """
        F = self.information @ squares
        if self.cov.size == 1:
            F -= self.cov[0, 0] * (self.side[:, 0] @ W) ** 2
        elif self.cov.size:
            side = self.side @ W
            F -= np.einsum("krq,rs,ksq->kq", side, self.cov, side)
        if self.share is not None:
            F *= self.share if weights is None else self.share @ weights
        return self.score @ W, F

    def matrix(self, modes: Modes, row: int, W: Floats) -> tuple[Floats, Floats]:
        """Scores (q,) and information (q, q) of columns together, at one row.

        Parameters
        ----------
        modes
            The modes.
        row
            The row.
        W : (t, q)
            The columns in the modes.
        """
        y = self.score[row] @ W
        if self.share is not None:
            W = modes.U.T @ (np.sqrt(self.share[row])[:, None] * (modes.back @ W))
        F = (W.T * self.information[row]) @ W
        if self.cov.size:
            side = self.side[row] @ W
            F -= side.T @ self.cov @ side
        return y, F


def scores(
    modes: Modes, onsets: Onsets, static: Static, rows: Ints | slice = _ALL, *, every: bool = False
) -> Scores:
    """Integrate the directions out.

    Parameters
    ----------
    modes, onsets, static
        The modes, and the information so far.
    rows : (k,)
        Rows to work on; all by default.
    every
        Take all directions into account, however many there are; O(t r^2).
    """
    r = modes.sign.size
    score, information = onsets.score[rows], onsets.information[rows]
    share = None if onsets.read is None else _share(modes, information, onsets.read[rows])
    if not r:
        return Scores(score, information, np.zeros((len(score), 0, modes.size)), np.zeros((0, 0)), share)
    cross, G, cov = onsets.cross[rows], modes.directions, static.cov
    if r > FEW and every:
        cov = current(modes, static).cov
    elif r > FEW:
        G = G[:, : modes.busbar]
        cov = np.asarray(
            np.linalg.inv(np.diag(modes.sign[: modes.busbar]) + (G.T * static.information) @ G), np.float64
        )
    return Scores(score, information, cross[:, None, :] * G.T, cov, share)


def _share(modes: Modes, information: Floats, read: Floats) -> Floats:
    """Share of the information that was read at each member, (k, t); 1 where there is none."""
    whole = information @ modes.squares.T
    return np.asarray(np.where(whole > 0.0, read / np.where(whole > 0.0, whole, 1.0), 1.0))


def shocked(modes: Modes, now: Scores, size: float) -> tuple[Scores, float]:
    """Scores of one row with a change of all loads ``N(0, size S)`` at the onset integrated out.

    Also the logarithm of the likelihood ratio of such a change against none. With ``s = size lam``, ``X =
    diag(c) Gamma`` and ``N' = (N^-1 - X' diag(s / (1 + s i)) X)^-1``, N, i and X go over into N', i and X
    divided by ``1 + s i``, and the scores y into ``(y + X N' X' diag(s / (1 + s i)) y) / (1 + s i)``.

    Parameters
    ----------
    modes, now
        The modes, and the scores of one row.
    size
        Variance of the change, in those of the loads.
    """
    y, X = now.score[0], now.side[0].T
    s = size * modes.loads
    more = 1.0 + s * now.information[0]
    inner = np.eye(X.shape[1]) - now.cov @ ((X.T * (s / more)) @ X)
    cov = np.linalg.solve(inner, now.cov)
    after = (y + X @ (cov @ (X.T @ (s / more * y)))) / more
    ratio = 0.5 * float((s * after) @ y - np.log(more).sum() - np.linalg.slogdet(inner)[1])
    return Scores(after[None], now.information / more, now.side / more, cov, now.share), ratio


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of faults in the modes: members, powers, busbar. t modes, q columns.

    Attributes
    ----------
    W : (t, q)
        ``U' [1, powers, H]``.
    std : (q,)
        Prior standard deviation of each amount.
    weights : (t, q)
        Share of each member in the squared effect, in units of the white variances.
    members, powers
        Numbers of columns of members and of powers; the rest are phases of the busbar.
    """

    W: Floats
    std: Floats
    weights: Floats
    members: int
    powers: int

    @cached_property
    def squares(self) -> Floats:
        """Squares of W, (t, q)."""
        return np.asarray(self.W * self.W)

    @cached_property
    def variance(self) -> Floats:
        """Squares of std, (q,)."""
        return np.asarray(self.std * self.std)


def columns(modes: Modes, powers: Floats, power_std: Floats, std: float) -> Columns:
    """Columns of a set of members.

    Parameters
    ----------
    modes
        The modes.
    powers : (p, m)
        Effect of false powers on all meters, squared pu per pu.
    power_std : (m,)
        Prior standard deviation of false powers, pu.
    std
        Prior standard deviation of faults of meters and of the busbar, squared pu.
    """
    H = modes.model.phases(modes.at)
    H = H[:, H.any(axis=0)]
    effect = np.hstack([np.eye(modes.size), powers[modes.at], H])
    squares = effect**2 / modes.model.white[modes.at][:, None]
    return Columns(
        W=modes.U.T @ effect,
        weights=squares / np.maximum(squares.sum(axis=0), np.finfo(float).tiny),
        std=np.concatenate([np.full(modes.size, std), power_std, np.full(H.shape[1], std)]),
        members=modes.size,
        powers=power_std.size,
    )

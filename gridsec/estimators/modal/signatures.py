"""Signatures of faults: effect of a fault begun at an onset on the innovations, and the information about it.

A fault ``f`` of the members begun at onset k adds ``u_t f`` to the residuals, ``u_t = 1`` for a step and
``u_t = (t - k) / T_r`` for a ramp. Every mode answers by itself, so one number per mode stands for all
faults:

    gamma = u - rho g_w - rho_b g_b,   g <- (rho g_w, rho_b g_b) + k gamma
    i += gamma^2 / v,   c += gamma gamma_0 / v

with the gain and variance (k, v) of `gridsec.estimators.modal.filter` and gamma_0 of
`gridsec.estimators.modal.static`. For columns W of faults in the modes, ``W = U' F``, the filter with theta
has the signature ``(gamma - gamma_0 Gamma N Gamma' c) W``, N and c those before the tick. With s, the score
of the exact innovation,

    a += gamma (s + gamma_0 Gamma theta / v),   Y = a - c * Gamma theta,   y = W' Y
    I = W' (diag(i) - diag(c) Gamma N Gamma' diag(c)) W

and ``exp(y' f - f' I f / 2)`` is the likelihood ratio of the fault against none, given all readings so far.
With complete readings a grows by ``gamma nu / v``.

With many directions (more than `static.FEW`) I takes only those of the busbar into account. It is then too
large by a positive semidefinite matrix, and mixtures of likelihood ratios are too small: their expectation
without a fault is at most 1.

**Missing readings.** s is exact (`gridsec.estimators.modal.full`), and the signature does not depend on
readings; k is the gain ``slower``. So y of a column x_t is a martingale with the variance ``sum x_t' E V^-1
E' x_t``, E selecting the readings. v is that of complete readings, ``E V^-1 E' <= diag(1 / v)``. So I is an
upper bound, and the mean of ``exp(y f - I f^2 / 2)`` is at most 1. For single members the bound is lowered,
``lost``: the part of a fault that the member itself feels counts with the exact ``(V^-1)_jj`` in place of
``(U diag(1 / v) U')_jj``, 0 without a reading. That is exact for white errors. The information about the
phases of the busbar is exact, ``busbar``. An unknown direction near a common shift, as an unread power at the
head of a feeder, takes nearly all of it: by the bound, such a shift would leave no evidence.

References
----------
Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems, IEEE Trans. Automatic Control 21, 1976.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack

from gridsec.arrays import Bools, Floats, Ints, submatrix
from gridsec.estimators.modal.filter import Update
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.static import FEW, Static, current, of_busbar

RAMP_S = 600.0
"""Time in which a unit ramp reaches 1, s: the time scale of the loads."""


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
        a, i and c.
    lost : (k, t) or None
        Part of i at each member that was not read; None where nothing is missing since the filter is modal.
    busbar : (k, b) or None
        Exact information about the phases of the busbar, likewise.
    """

    age: Ints
    used: Bools
    ramp: Bools
    level: Floats
    signature: Floats = field(repr=False)
    score: Floats = field(repr=False)
    information: Floats = field(repr=False)
    cross: Floats = field(repr=False)
    lost: Floats | None = field(default=None, repr=False)
    busbar: Floats | None = field(default=None, repr=False)


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


def single(onsets: Onsets, row: int) -> Onsets:
    """One row by itself, its sums as copies: it does not keep those of the others in memory.

    Parameters
    ----------
    onsets, row
        The onsets, and the row.
    """
    at, lost, busbar = slice(row, row + 1), onsets.lost, onsets.busbar
    return Onsets(
        onsets.age[at],
        onsets.used[at],
        onsets.ramp[at],
        onsets.level[at],
        onsets.signature[:, at].copy(),
        onsets.score[at].copy(),
        onsets.information[at].copy(),
        onsets.cross[at].copy(),
        None if lost is None else lost[at].copy(),
        None if busbar is None else busbar[at].copy(),
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
    own: bool = False,
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
    own
        Change the sums in place: nothing else uses those of `onsets`.
    """
    rho, rho_b = update.decay
    age, used, level = onsets.age, onsets.used, onsets.level
    if begun or ended:
        age, used, level = age.copy(), used.copy(), level.copy()
        for row in begun:
            used[row], level[row] = True, not onsets.ramp[row]
        for row in ended:
            used[row], level[row], age[row] = False, 0.0, 0
    level = level + (h / RAMP_S) * (onsets.ramp & used)
    sums = onsets.signature, onsets.score, onsets.information, onsets.cross
    g, score, information, cross = sums if own else (each.copy() for each in sums)
    g[0] *= rho
    g[1] *= rho_b
    gamma = level[:, None] - g[0]
    gamma -= g[1]
    lost, busbar = _lost(modes, onsets, update, gamma), _busbar(modes, onsets, update, static, gamma)
    inverse, gain = 1.0 / update.variance, update.gain if update.slower is None else update.slower
    # One array takes all products: new ones do not stay in the cache.
    part = gamma * (static.score + static.gamma * static.constant * inverse)
    score += part
    cross += np.multiply(gamma, static.gamma * inverse, out=part)
    g[0] += np.multiply(gamma, gain[0], out=part)
    g[1] += np.multiply(gamma, gain[1], out=part)
    gamma *= gamma
    information += np.multiply(gamma, inverse, out=part)
    for row in ended:
        g[:, row] = score[row] = information[row] = cross[row] = 0.0
        if lost is not None:
            lost[row] = 0.0
        if busbar is not None:
            busbar[row] = 0.0
    return Onsets(age + used, used, onsets.ramp, level, g, score, information, cross, lost, busbar)


def _lost(modes: Modes, onsets: Onsets, update: Update, gamma: Floats) -> Floats | None:
    """Part of the information at each member that was not read, with that of one tick, (k, t).

    Only the effect of a member's fault on its own reading is lost with that reading. The part is at most the
    information, by Cauchy's inequality, since ``diag(white) <= D``.
    """
    if update.exact is None:
        return None
    own = (gamma / np.sqrt(update.variance)) @ modes.squares.T
    own *= own
    whole = modes.squares @ (1.0 / update.variance)
    own *= modes.model.white[modes.at] * (1.0 - np.minimum(update.exact.precision / whole, 1.0))
    return own if onsets.lost is None else own + onsets.lost


def _busbar(modes: Modes, onsets: Onsets, update: Update, static: Static, gamma: Floats) -> Floats | None:
    """Exact information about the phases of the busbar, that of one tick included, (k, b).

    The score of a phase moves by ``x' s``, ``x = gamma W - gamma_0 Gamma N Gamma' c W`` in the modes. Its
    information is ``x_n' V^-1 x_n``, with V of the readings n and the unknown directions of the tick.
    """
    if update.exact is None:
        return None
    W, rows, G = modes.phases_in_modes, update.exact.rows, modes.directions
    shape = (len(gamma), modes.sign.size, W.shape[1])
    turn, before = (onsets.cross @ modes.crossed).reshape(shape), onsets.busbar
    if before is None:
        # The first tick without the modes: what is known of theta is that before it.
        earlier = replace(static, information=static.information - static.gamma**2 / update.variance)
        known = np.einsum("krb,rs,ksb->kb", turn, current(modes, earlier).cov, turn, optimize=True)
        before = np.asarray(onsets.information @ (W * W) - known)
    if not rows.size:
        return before.copy()
    x = gamma[:, :, None] * W
    if modes.sign.size:
        few = modes.sign.size <= FEW
        cov = static.cov if few else of_busbar(modes, static)
        x -= (static.gamma[:, None] * G[:, : len(cov)]) @ (cov @ turn[:, : len(cov)])
    felt = x.transpose(0, 2, 1).reshape(-1, modes.size) @ modes.back[rows].T
    # ``L^-1 felt'``, without a copy to another order.
    white = blas.dtrsm(1.0, update.exact.half, felt.T, lower=1, overwrite_b=1)
    white *= white
    return np.asarray(before + white.sum(axis=0).reshape(before.shape))


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
        Share of the members' information that was read at each; None for 1.
    busbar : (k, b) or None
        Exact information about the phases of the busbar; None where ``information`` is exact.
    """

    score: Floats
    information: Floats
    side: Floats
    cov: Floats
    share: Floats | None = None
    busbar: Floats | None = None

    def of(self, W: Floats, squares: Floats) -> tuple[Floats, Floats]:
        """Scores and information of single columns, (k, q) each.

        Parameters
        ----------
        W, squares : (t, q)
            The columns in the modes, and their squares.
        """
        (k, t), F = self.score.shape, self.information @ squares
        # One product in place of two: the columns are read once.
        every = np.concatenate([self.score, self.side.reshape(-1, t)]) @ W
        y, side = every[:k], every[k:]
        if self.cov.size == 1:
            side *= side
            side *= self.cov[0, 0]
            F -= side
        elif self.cov.size:
            side = side.reshape(k, len(self.cov), -1)
            F -= np.einsum("krq,rs,ksq->kq", side, self.cov, side)
        return y, F

    def of_members(self, modes: Modes) -> tuple[Floats, Floats]:
        """Scores and information of the members, (k, t) each; the share of the information that was read."""
        y, F = self.of(modes.U.T, modes.squares.T)
        if self.share is not None:
            F *= self.share
        return y, F


def scores(modes: Modes, onsets: Onsets, static: Static, rows: Ints | None = None) -> Scores:
    """Integrate the directions out.

    Parameters
    ----------
    modes, onsets, static
        The modes, and the information so far.
    rows : (k,)
        Rows to work on; None: all.
    """
    r, rows = modes.sign.size, np.arange(onsets.age.size) if rows is None else rows
    score, information = onsets.score.take(rows, axis=0), onsets.information.take(rows, axis=0)
    share = None if onsets.lost is None else _share(modes, information, onsets.lost[rows])
    busbar = None if onsets.busbar is None else onsets.busbar[rows]
    if not r:
        none = np.zeros((len(score), 0, modes.size)), np.zeros((0, 0))
        return Scores(score, information, *none, share, busbar)
    cross, G, cov = onsets.cross.take(rows, axis=0), modes.directions, static.cov
    score -= cross * static.constant
    if r > FEW:
        G, cov = G[:, : modes.busbar], of_busbar(modes, static)
    return Scores(score, information, cross[:, None, :] * G.T, cov, share, busbar)


def _share(modes: Modes, information: Floats, lost: Floats) -> Floats:
    """Share of the information that was read at each member, (k, t); 1 where there is none."""
    whole = information @ modes.squares.T
    return np.asarray(1.0 - lost / np.where(whole > 0.0, whole, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Scores and information of all faults of members together, at one onset. t modes.

    Attributes
    ----------
    score, information : (t,), (t, t)
        Of columns W: ``y = W' score`` and ``I = W' information W``.
    shift : (2, t, t)
        Change of the means of w and b per unit fault in each mode.
    level
        u of the last tick.
    """

    score: Floats
    information: Floats = field(repr=False)
    shift: Floats = field(repr=False)
    level: float

    def of(self, W: Floats) -> tuple[Floats, Floats]:
        """Scores (q,) and information (q, q) of columns W (t, q)."""
        return self.score @ W, W.T @ self.information @ W

    def moved(self, modes: Modes, x: Floats) -> Floats:
        """Change of the means of w and b in the modes by faults x (t, k) at the members, (2, t, k)."""
        return np.asarray(self.shift @ (modes.U.T @ x))


@dataclass(frozen=True, slots=True, eq=False)
class InModes:
    """Scores and information of one onset in the modes, ``diag(own) - side cov side'``.

    Attributes
    ----------
    U : (t, t)
        As in `Modes`.
    score, own : (t,), (t,)
        y, and the information without the directions.
    side, cov : (t, r), (r, r)
        Regression on the directions, and the covariance of these.
    """

    U: Floats = field(repr=False)
    score: Floats
    own: Floats
    side: Floats
    cov: Floats

    def times(self, W: Floats) -> Floats:
        """Product of the information with columns in the modes, (t, k)."""
        return np.asarray(self.own[:, None] * W - self.side @ (self.cov @ (self.side.T @ W)))


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """Scores and information of faults of the t members together, at one onset: `Joint` at the members.

    Attributes
    ----------
    score, information : (t,), (t, t)
        y and F of the members.
    in_modes
        The same in the modes, where no reading is missing: columns of many members cancel there less.
    """

    score: Floats
    information: Floats = field(repr=False)
    in_modes: InModes | None = field(default=None, repr=False)

    def of(self, columns: Floats, W: Floats) -> tuple[Floats, Floats, Floats]:
        """Scores (k,) of columns, their information with the members (t, k), and with each other (k, k).

        Parameters
        ----------
        columns, W : (t, k)
            The columns at the members, and in the modes.
        """
        if self.in_modes is None:
            side = self.information @ columns
            return self.score @ columns, side, columns.T @ side
        side = self.in_modes.times(W)
        return self.in_modes.score @ W, self.in_modes.U @ side, W.T @ side

    def misfit(self, precision: Floats) -> float:
        """Cost of faults of all members, up to a constant; O(t^3).

        Parameters
        ----------
        precision : (t, t)
            Inverse of the prior covariance of their amounts.
        """
        half = np.linalg.cholesky(self.information + precision)
        white, _ = lapack.dtrtrs(half, self.score, lower=True)
        return 2.0 * float(np.log(half.diagonal()).sum()) - float(white @ white)

    def beside(self, unknown: Floats) -> tuple[Scored, float]:
        """The same with unknown errors integrated out, and the gain of evidence by these.

        With scores y_n and information F_n of the directions n with amounts N(0, 1),

            M = F_nn + 1,  y - F_n M^-1 y_n,  F - F_n M^-1 F_n',  gain = (y_n' M^-1 y_n - log det M) / 2

        Parameters
        ----------
        unknown : (t, k)
            Directions of the residuals, times the standard deviations of their amounts.
        """
        side = self.information @ unknown
        half = np.linalg.cholesky(unknown.T @ side + np.eye(unknown.shape[1]))
        rows = np.column_stack([side.T, self.score @ unknown])
        white, _ = lapack.dtrtrs(half, rows, lower=True)
        F, y = white[:, :-1], white[:, -1]
        gain = 0.5 * float(y @ y) - float(np.log(half.diagonal()).sum())
        return Scored(self.score - y @ F, self.information - F.T @ F), gain


def _in_modes(modes: Modes, onsets: Onsets, static: Static, row: int) -> InModes:
    """Scores and information of one row in the modes, all directions integrated out."""
    score, own = onsets.score[row], onsets.information[row]
    side, cov = np.zeros((own.size, 0)), np.zeros((0, 0))
    if modes.sign.size:
        score = score - onsets.cross[row] * static.constant
        side, cov = onsets.cross[row][:, None] * modes.directions, current(modes, static).cov
    return InModes(modes.U, score, own, side, cov)


def scored(modes: Modes, onsets: Onsets, static: Static, row: int) -> Scored:
    """Scores and information at the members of one row; as `joint`."""
    now, U = _in_modes(modes, onsets, static, row), modes.U
    of_members = U @ now.side
    information = (U * now.own) @ U.T - of_members @ now.cov @ of_members.T
    return Scored(U @ now.score, information, now)


def joint(modes: Modes, onsets: Onsets, static: Static, row: int) -> Joint:
    """Joint scores of one row, all directions integrated out; exact where no reading is missing; O(t^2 r).

    Parameters
    ----------
    modes, onsets, static
        The modes, and the information so far.
    row
        The row.
    """
    now = _in_modes(modes, onsets, static, row)
    turn, shift = now.cov @ now.side.T, np.stack([np.diag(each) for each in onsets.signature[:, row]])
    if modes.sign.size:
        g_w, g_b = static.signature[:, :, None] * modes.directions
        shift[0] -= g_w @ turn
        shift[1] += (modes.directions - g_b) @ turn
    return Joint(now.score, np.diag(now.own) - now.side @ turn, shift, float(onsets.level[row]))


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of faults in the modes: members, powers, busbar. t modes, q columns.

    Attributes
    ----------
    W : (t, q)
        ``U' [1, powers, H]``.
    std : (q,)
        Prior standard deviation of each amount.
    members, powers
        Numbers of columns of members and of powers; the rest are phases of the busbar.
    beside : (t, q - members)
        Columns of powers and busbar at the members.
    """

    W: Floats
    std: Floats
    members: int
    powers: int
    beside: Floats

    def of(self, scored: Scored, used: Bools | None = None) -> tuple[Floats, Floats]:
        """Scores (k,) and information (k, k) of some faults (q,); None: of all.

        Parameters
        ----------
        scored
            Those of the members.
        used : (q,)
            The faults.
        """
        p = self.members
        some: slice | Bools = slice(None) if used is None else used[p:]
        y, F = scored.score, scored.information
        of_others, side, inner = scored.of(self.beside[:, some], self.W[:, p:][:, some])
        if used is not None:
            own = np.flatnonzero(used[:p])
            y, F, side = y[own], submatrix(F, own, own), side[own]
        return np.append(y, of_others), np.block([[F, side], [side.T, inner]])

    @cached_property
    def others(self) -> tuple[Floats, Floats]:
        """Columns of powers and busbar, (t, q - members), and their squares."""
        W = self.W[:, self.members :]
        return W, W * W

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
    H = modes.phases
    beside = np.hstack([powers[modes.at], H])
    return Columns(
        W=np.hstack([modes.U.T, modes.U.T @ beside]),
        std=np.concatenate([np.full(modes.size, std), power_std, np.full(H.shape[1], std)]),
        members=modes.size,
        powers=power_std.size,
        beside=beside,
    )

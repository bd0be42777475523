"""Exact filter with missing readings: a full covariance of w and b from the first missing reading on.

With complete readings the filter of `gridsec.estimators.modal.filter` with
`gridsec.estimators.modal.static` is exact and diagonal. A missing reading couples the modes. From then on
the state x = (w, b) of all members has a full covariance P, in the coordinates of the meters:

    predict   x <- (rho w, rho_b b),  P <- R P R + blockdiag((1 - rho^2) S, (1 - rho_b^2) B)
    update    V = (H P H' + D)_nn,  sigma = V^-1 (m - H x)_n,  x += P H_n' sigma,  P -= P H_n' V^-1 H_n P

with the readings n of the tick and ``H = [1, 1]``. The start is the posterior of the modal filter:

    x = mean + T theta,   P = blockdiag of the modes + T N T',   T = (-g_w, 1 - g_b) Gamma

B ages as a whole here, in `filter` without the directions: a difference of h / T_b per tick.

**Scores.** ``s = back' sigma``, the score of the innovation in the modes, is all that the detector takes
from the readings. For every signature x that does not depend on the readings, ``y = sum x' s`` is a
martingale without a fault. ``exp(y f - I f^2 / 2)`` has the mean 1 for ``I = sum x_n' V^-1 x_n``, and at most
1 for any larger I. So signatures that are diagonal in the modes stay in use. Their gain is that of a
covariance of which the diagonal is kept at every tick; its error costs evidence, and causes no false alarm.

**Return.** After ticks with all readings the filter returns to the modes. The condition: their diagonal
covariance C, enlarged by e, is an upper bound, ``(1 + e) C + T N T' >= P``, with N of the information in the
directions divided by ``(1 + e)^2``. It is tried at every `COMPLETE`-th complete tick, and later at every
`LONGEST`-th. e grows to `MARGIN` over `LONGEST` ticks: returns enlarge the covariance by no more per tick,
however often readings are lost.
The readings then have at most the covariance of the model in use. With scores y and information I of that
model, ``var y <= I`` without a fault, and ``E exp(y f - I f^2 / 2) <= 1`` at each fixed tick.

The cost is O(n t^2) per tick: 0.1 ms for 57 meters, 1 ms for 146.

References
----------
Anderson and Moore, Optimal Filtering, 1979, chapter 3.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import blas, lapack

from gridsec.arrays import Bools, Floats, Ints, all_of, changed, indices, submatrix
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal import static
from gridsec.estimators.modal.filter import FilterState, Full, Innovation, Interval, Update
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.static import Static

COMPLETE, LONGEST = 16, 64
"""Complete ticks from one attempt to return to the modes to the next: at first, and from the largest e on."""
SHARED = 16
"""Ticks for which the gain of the signatures is scaled alike while the same members report."""
MARGIN = 0.1
"""Largest enlargement of the variance at a return, 1: standard deviations are too large by 5 % at first."""


def step(  # noqa: PLR0917  # the states of both parts, and one tick
    modes: Modes,
    state: FilterState,
    known: Static,
    t: float,
    m: Floats,
    seen: Bools | None = None,
    *,
    stay: bool = False,
    unknown: Floats | None = None,
    jump: float = 0.0,
) -> tuple[FilterState, Static, Update]:
    """Take in the residuals of one tick by the exact filter.

    Parameters
    ----------
    modes, state, known
        The modes, the filter and the information about the directions after the last tick.
    t
        Time, s; not before ``state.t``. The interval may change from tick to tick.
    m : (t,)
        Residuals of the members, squared pu; any finite value where not seen.
    seen : (t,)
        Members with a reading; None: all.
    stay
        Keep the full covariance, if there is one.
    unknown : (t, k)
        Directions of the residuals that are unknown at this tick, times their standard deviations; None for
        none.
    jump
        Variance of a jump of the loads' errors, in that of the loads, 1.

    Raises
    ------
    ValueError
        If t is before the last reading or not a number.
    """
    whole = (seen is None or all_of(seen)) and unknown is None
    if state.full is not None and whole and not stay and _due(state.full.complete):
        state, known = _returned(modes, state, state.full, known)
    if state.full is None and not whole:
        state = replace(state, full=expanded(modes, state, known))
    after, update = modal.step(modes, state, t, m, seen, jump)
    if state.full is not None:
        full, innovation = updated(modes, state.full, update.gap, m, None if whole else seen, unknown)
        score = innovation.score @ modes.back[innovation.rows]
        share, since = _share(modes, state.full, update)
        kept, slower = _kept(modes, full.kept, update, share)
        after = changed(after, full=changed(full, kept=kept, share=share, since=since))
        update = changed(update, slower=slower, exact=innovation, score=score)
    return after, static.follow(modes, known, update), update


def expanded(modes: Modes, state: FilterState, known: Static) -> Full:
    """Means and full covariance of the modal filter.

    Parameters
    ----------
    modes, state, known
        The modes, the filter and the information about the directions after the last tick.
    """
    back = modes.back
    w, both, b = ((back * c) @ back.T for c in state.cov)
    mean = state.mean @ back.T
    if modes.sign.size:
        T, N = _turned(modes, known), static.current(modes, known).cov
        T_w, T_b = T[: modes.size], T[modes.size :]
        w, both, b = w + T_w @ N @ T_w.T, both + T_w @ N @ T_b.T, b + T_b @ N @ T_b.T
        mean = mean + (T @ known.theta).reshape(2, -1)
    return Full(mean, (w, both, b), np.ones(modes.size, dtype=np.bool_), state.cov, 0)


def _turned(modes: Modes, known: Static) -> Floats:
    """Change T of the means of w and b at the meters per amount of each direction, (2 t, r)."""
    g_w, g_b = known.signature[:, :, None] * modes.directions
    return np.vstack([modes.back @ -g_w, modes.back @ (modes.directions - g_b)])


def updated(  # noqa: PLR0917  # the filter, and one tick
    modes: Modes,
    before: Full,
    gap: Interval,
    m: Floats,
    seen: Bools | None,
    unknown: Floats | None = None,
) -> tuple[Full, Innovation]:
    """The exact filter after one tick; O(n t^2).

    Parameters
    ----------
    modes, before
        The modes, and the filter after the last tick.
    gap
        The interval.
    m, seen : (t,)
        Residuals, and members with a reading; None: all.
    unknown : (t, k)
        As in `step`: ``unknown unknown'`` is added to the covariance of the white errors of this tick.
    """
    t, rows = modes.size, np.arange(modes.size) if seen is None else indices(seen)
    rho, rho_b = gap.decay(modes)
    mean = before.mean * np.array([[rho], [rho_b]])
    w, both, b = before.blocks
    w, both, b = w * rho**2, both * (rho * rho_b), b * rho_b**2
    w += (1.0 - rho * rho) * modes.covariance_w
    if gap.jump:
        w += gap.jump * modes.jumps
    b += (1.0 - rho_b * rho_b) * modes.covariance_b
    if not rows.size:
        none = np.zeros((2 * t, 0))
        nothing = Innovation(rows, none[:0], none, none[0], np.zeros(t), none[0])
        return Full(mean, (w, both, b), np.zeros(t, np.bool_), before.kept, 0, unknown=unknown, m=m), nothing
    complete, nu = before.complete + 1 if seen is None else 0, (m - mean[0] - mean[1])[rows]
    HP = np.empty((rows.size, 2 * t))
    np.add(w.take(rows, axis=0), both.take(rows, axis=1).T, out=HP[:, :t])
    np.add(both.take(rows, axis=0), b.take(rows, axis=0), out=HP[:, t:])
    V = (HP[:, :t] + HP[:, t:]).take(rows, axis=1) + submatrix(modes.noise, rows, rows)
    if unknown is not None:
        V, complete = V + unknown[rows] @ unknown[rows].T, 0
    half, failed = lapack.dpotrf(V.T, lower=True, overwrite_a=True, clean=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the innovation is not positive definite")
    gain = blas.dtrsm(1.0, half, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1)
    white, _ = lapack.dtrtrs(half, nu, lower=True)
    score, _ = lapack.dtrtrs(half, white, lower=True, trans=1)
    mean += (gain @ white).reshape(2, t)
    of_w, of_b = gain[:t], gain[t:]
    w -= of_w @ of_w.T
    both -= of_w @ of_b.T
    b -= of_b @ of_b.T
    inverse, _ = lapack.dtrtri(half, lower=True)
    precision = np.zeros(t)
    precision[rows] = (inverse * inverse).sum(axis=0)
    seen = np.ones(t, dtype=np.bool_) if seen is None else seen
    return Full(mean, (w, both, b), seen, before.kept, complete, unknown=unknown, m=m), Innovation(
        rows, half, gain, white, precision, score
    )


def expected(modes: Modes, before: Full, gap: Interval, rows: Ints) -> Floats:
    """Covariance of the innovation of the next tick, (n, n).

    Parameters
    ----------
    modes, before
        The modes, and the filter after the last tick.
    gap
        The interval.
    rows : (n,)
        Members with a reading.
    """
    rho, rho_b = gap.decay(modes)
    w, both, b = (submatrix(each, rows, rows) for each in before.blocks)
    V = rho * rho * w + rho_b * rho_b * b
    V += rho * rho_b * (both + both.T) + submatrix(modes.noise, rows, rows)
    V += (1.0 - rho * rho) * submatrix(modes.covariance_w, rows, rows)
    if gap.jump:
        V += gap.jump * submatrix(modes.jumps, rows, rows)
    V += (1.0 - rho_b * rho_b) * submatrix(modes.covariance_b, rows, rows)
    return V


def _kept(modes: Modes, kept: Floats, update: Update, share: Floats | None) -> tuple[Floats, Floats]:
    """Diagonal covariance after one tick, (3, t), and its gain, (2, t), times the share that was read."""
    cov, shared, v = modal.predicted(modes, kept, *update.decay, update.gap.jump)
    gain = shared / v
    if share is not None:
        gain *= share
    cov[:2] -= gain * shared[0]
    cov[2] -= gain[1] * shared[1]
    return cov, gain


def _share(modes: Modes, before: Full, update: Update) -> tuple[Floats | None, int]:
    """Part of each mode's information that was read, (t,), and its age, ticks.

    It is ``1 - diag(U_g' (A_gg)^-1 U_g) / v``, ``A = U diag(1 / v) U'``, g the members without a reading.
    While the same members report it changes slowly, and is taken over for `SHARED` ticks.
    """
    if update.seen is None:
        return None, 0
    if before.share is not None and before.since < SHARED and np.array_equal(before.seen, update.seen):
        return before.share, before.since + 1
    g, v = indices(~update.seen), modal.predicted(modes, before.kept, *update.decay, update.gap.jump)[2]
    if g.size == modes.size:
        return np.zeros(modes.size), 0
    half, _ = lapack.dpotrf((modes.U[g] / v) @ modes.U[g].T, lower=True, clean=True)
    spread, _ = lapack.dtrtrs(half, modes.U[g], lower=True)
    return np.clip(1.0 - (spread * spread).sum(axis=0) / v, 0.0, 1.0), 0


def _due(complete: int) -> bool:
    """An attempt to return is due after a number of complete ticks."""
    return complete > 0 and complete % (COMPLETE if complete < LONGEST else LONGEST) == 0


def _returned(modes: Modes, state: FilterState, full: Full, known: Static) -> tuple[FilterState, Static]:
    """State of the modal filter, if its covariance is an upper bound; else the same."""
    t, U, known = modes.size, modes.U, static.current(modes, known)
    larger = 1.0 + MARGIN * min(1.0, full.complete / LONGEST)
    T = _turned(modes, known).reshape(2, t, -1)
    T = np.vstack([U.T @ T[0], U.T @ T[1]])
    of_w, both, of_b = (U.T @ each @ U for each in full.blocks)
    P = np.block([[of_w, both], [both.T, of_b]])
    # The information of complete readings is more than that of theta.
    now = static.current(modes, replace(known, information=known.information / larger**2))
    rest, bound = P - T @ known.cov @ T.T, T @ now.cov @ T.T - P
    w, b = np.arange(t), np.arange(t, 2 * t)
    cov = larger * np.stack([rest[w, w], rest[w, b], rest[b, b]])
    bound[w, w] += cov[0]
    bound[w, b] += cov[1]
    bound[b, w] += cov[1]
    bound[b, b] += cov[2]
    _, failed = lapack.dpotrf(bound, lower=True)
    if failed or not (cov[0] > 0.0).all() or not (cov[0] * cov[2] > cov[1] ** 2).all():
        return state, known
    mean = full.mean @ U - (T @ now.theta).reshape(2, t)
    return FilterState(state.t, mean, cov), static.restored(modes, now)

"""Exact scores of suspected onsets where readings are missing, by replaying the last readings.

The detector follows onsets by signatures that are diagonal in the modes. That suffices for an alarm, but not
for a search among sets of meters: it needs the information of all members together, and missing readings
make it full. For a suspected onset, with X the change of the means per unit fault of each member,

    gamma = u 1 - H X,   X <- R X + K gamma_n,   Y += gamma_n' V^-1 nu,   F += gamma_n' V^-1 gamma_n

with nu, V and the gain K of `gridsec.estimators.modal.full`. A fault f of the members has the score f'Y and
the information f'F f, exactly. The cost is that of the filter, so the last `HALF` to 2 `HALF` readings
are kept, and replayed at an alarm. An onset before them counts from the first of them on: the filter has
learned part of such a fault, which costs evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import blas

from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import full as exact
from gridsec.estimators.modal import signatures
from gridsec.estimators.modal.detector import Detector
from gridsec.estimators.modal.filter import FilterState, Full, Innovation, Interval
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.signatures import RAMP_S, Joint, Onsets, Scored
from gridsec.estimators.modal.static import Static

HALF = 64
"""Ticks from one kept state of the filter to the next; two of them cover the readings that are kept."""

NEAR = 16
"""Ticks from one to the next of the two youngest kept states: most onsets are named within so many ticks."""

Reading = tuple[float, Floats, Bools | None, Floats | None, float]
"""Time, residuals (t,), members with a reading (t,), unknown directions (t, k), and jump of the loads."""


@dataclass(frozen=True, slots=True, eq=False)
class Suspected:
    """Exact scores of one onset. t members.

    Attributes
    ----------
    row, ramp, level
        Row of the onset in the detector, its shape, and u of the last tick.
    shift : (2 t, t)
        X.
    score, information : (t,), (t, t)
        Y and F.
    """

    row: int
    ramp: bool
    level: float
    shift: Floats = field(repr=False)
    score: Floats = field(repr=False)
    information: Floats = field(repr=False)

    @property
    def scored(self) -> Scored:
        """Scores and information of the members."""
        return Scored(self.score, self.information)

    def joint(self, modes: Modes) -> Joint:
        """The same in the modes."""
        t, U, back = modes.size, modes.U, modes.back
        shift = np.stack([U.T @ self.shift[:t] @ back, U.T @ self.shift[t:] @ back])
        return Joint(self.score @ back, back.T @ self.information @ back, shift, self.level)

    def moved(self, modes: Modes, x: Floats) -> Floats:
        """As `Joint.moved`, in a third of the products."""
        return np.asarray(modes.U.T @ (self.shift @ x).reshape(2, modes.size, -1))


def beside(unknown: Floats | None, columns: Floats) -> Floats:
    """Unknown directions of a tick with more of them, (t, k)."""
    return columns if unknown is None else np.hstack([unknown, columns])


Parts = tuple[FilterState, Static, Detector, tuple[Suspected, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """Last readings, and the filter before them.

    Attributes
    ----------
    start
        Filter, directions, detector and suspected onsets before the first reading.
    readings
        The ticks, at most ``2 HALF``.
    middle
        As ``start``, after the first `HALF` readings; None before.
    recent
        Numbers of readings, and the states after them, as ``start``: the two youngest multiples of `NEAR`.
    """

    start: Parts = field(repr=False)
    readings: tuple[Reading, ...] = field(default=(), repr=False)
    middle: Parts | None = field(default=None, repr=False)
    recent: tuple[tuple[int, Parts], ...] = field(default=(), repr=False)

    @property
    def unknown(self) -> Floats | None:
        """Unknown directions of the last tick, (p, k)."""
        return self.readings[-1][3] if self.readings else None

    def until(self, count: int) -> tuple[History, Parts]:
        """The history up to a kept state, the latest one after at most `count` readings, and this state."""
        states = [(0, self.start), *self.recent]
        if self.middle is not None:
            states.append((HALF, self.middle))
        at, parts = max((each for each in states if each[0] <= count), key=lambda each: each[0])
        recent = tuple(each for each in self.recent if each[0] <= at)
        middle = self.middle if at >= HALF else None
        return History(self.start, self.readings[:at], middle, recent), parts


def record(  # noqa: PLR0917  # the state, and one tick
    history: History,
    after: Parts,
    m: Floats,
    seen: Bools | None,
    unknown: Floats | None = None,
    jump: float = 0.0,
) -> History:
    """Keep the readings of one tick.

    Parameters
    ----------
    history
        So far.
    after
        Filter, directions, detector and suspected onsets after the tick.
    m, seen : (t,)
        Residuals, and members with a reading.
    unknown : (t, k)
        Unknown directions.
    jump
        As in `gridsec.estimators.modal.filter.Interval`.
    """
    readings, recent = (*history.readings, (after[0].t, m, seen, unknown, jump)), history.recent
    count, middle = len(readings), history.middle
    if count % NEAR == 0:
        recent = (*recent[-1:], (count, after))
    if count == HALF:
        middle = after
    if count == 2 * HALF and middle is not None:
        recent = tuple((at - HALF, parts) for at, parts in recent)
        return History(middle, readings[HALF:], after, recent)
    return History(history.start, readings, middle, recent)


def replayed(modes: Modes, history: History, onsets: Onsets, rows: Sequence[int]) -> tuple[Suspected, ...]:
    """Exact scores of some rows after the last reading.

    Parameters
    ----------
    modes, history
        The modes, and the readings.
    onsets, rows
        The onsets of the detector after the last reading, and the rows.
    """
    count, oldest = len(history.readings), max(int(onsets.age[row]) for row in rows)
    kept, (state, known, *_) = history.until(max(0, count - oldest))
    out, first = {row: begun(modes, row, bool(onsets.ramp[row])) for row in rows}, len(kept.readings)
    for k, (t, m, seen, unknown, jump) in enumerate(history.readings[first:], first):
        if state.full is None and oldest >= count - k:
            state = replace(state, full=exact.expanded(modes, state, known))
        state, known, update = exact.step(
            modes, state, known, t, m, seen, stay=True, unknown=unknown, jump=jump
        )
        for row in rows:
            if update.exact is not None and onsets.age[row] >= count - k:
                out[row] = follow(modes, out[row], update.exact, update.gap)
    return tuple(out.values())


def begun(modes: Modes, row: int, ramp: bool) -> Suspected:
    """Scores before the onset.

    Parameters
    ----------
    modes, row, ramp
        The modes, the row of the onset and its shape.
    """
    t = modes.size
    return Suspected(row, ramp, float(not ramp), np.zeros((2 * t, t)), np.zeros(t), np.zeros((t, t)))


def carried(modes: Modes, onsets: Onsets, known: Static, rows: Sequence[int]) -> tuple[Suspected, ...]:
    """Exact scores of some rows while no reading is missing yet.

    Parameters
    ----------
    modes, onsets, known
        The modes, the onsets of the detector, and the information about the directions.
    rows
        The rows.
    """
    out, U, back = [], modes.U, modes.back
    for row in rows:
        now = signatures.joint(modes, onsets, known, row)
        shift = np.vstack([back @ now.shift[0] @ U.T, back @ now.shift[1] @ U.T])
        score, information = U @ now.score, U @ now.information @ U.T
        out.append(Suspected(row, bool(onsets.ramp[row]), now.level, shift, score, information))
    return tuple(out)


def follow(modes: Modes, before: Suspected, innovation: Innovation, gap: Interval) -> Suspected:
    """Take in one tick; O(n t^2).

    Parameters
    ----------
    modes, before
        The modes, and the scores so far.
    innovation
        The exact innovation of the tick.
    gap
        The interval.
    """
    t, n = modes.size, innovation.rows
    level = before.level + (gap.h / RAMP_S if before.ramp else 0.0)
    shift, (rho, rho_b) = before.shift.copy(), gap.decay(modes)
    shift[:t] *= rho
    shift[t:] *= rho_b
    if not n.size:
        return replace(before, level=level, shift=shift)
    gamma = -(shift[n] + shift[t + n])
    gamma[np.arange(n.size), n] += level
    weighed = blas.dtrsm(1.0, innovation.half, gamma.T, side=1, lower=1, trans_a=1)
    shift += innovation.gain @ weighed.T
    score = before.score + weighed @ innovation.white
    return replace(
        before,
        level=level,
        shift=shift,
        score=score,
        information=before.information + weighed @ weighed.T,
    )


def freed(  # the filter, and the faults
    modes: Modes, full: Full, joint: Joint, W: Floats, std: Floats, *, loads: bool = False
) -> Full:
    """The exact filter with the amounts of some faults unknown since the onset; O(t^2 f).

    With y, F and X of these faults and ``G = X (F + 1 / s^2)^-1``, the means lose ``G y``, and P gains
    ``G X'``.

    Parameters
    ----------
    modes, full
        The modes, and the exact filter.
    joint
        Joint scores of the onset after the same tick.
    W : (t, f)
        Columns of the faults in the modes.
    std : (f,)
        Prior standard deviations of their amounts.
    loads
        The faults are errors of the loads: from now on they are part of w, ``X_w - W`` in place of ``X_w``.
    """
    y, F = joint.of(W)
    X = np.vstack([modes.back @ joint.shift[0] @ W, modes.back @ joint.shift[1] @ W])
    if loads:
        X[: modes.size] -= joint.level * (modes.back @ W)
    gain = np.linalg.solve(F + np.diag(std**-2.0), X.T).T
    return full.changed(full.mean - (gain @ y).reshape(2, -1), full.cov + gain @ X.T)

"""Largest displacement by a few manipulated meters while linear tests stay within their bounds.

    maximise  g a   subject to  |R a| <= 1,  a of at most M entries.

For given manipulated meters J this is a linear program in |J| unknowns. Every set B of |J| rows with
independent columns of J bounds it: ``y`` with ``R_BJ' y = g_J`` gives ``g a <= |y|_1``, since rows are
bounded from both sides alike. So any basis is dual feasible, and dual simplex steps lead to the optimum, for
thousands of sets at once. Further meters are bounded by the remainder of g under the same multipliers:

    g a <= |y|_1 + sum of the M - |J| largest |g_k - (R_B' y)_k| reach_k,

``reach_k`` being the largest attack on meter k in any collusion. Branch and bound over J with this bound is
exact, and prunes most pairs.

Source: docs/theory-studies.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Ints

__all__ = ["GAP", "WORK", "Corridor", "Shift", "corridor", "furthest"]

GAP = 1e-6
"""Smallest relative improvement for which a set of meters is examined."""

WORK = 2e8
"""Largest number of entries of tests in a search; beyond it the bound is the one proven so far."""

# A test counts as within its bound up to this excess.
_WITHIN = 1e-9
# _TOGETHER: sets of meters per batch. _STEPS: largest number of simplex steps per unknown.
_TOGETHER, _STEPS = 512, 50


@dataclass(frozen=True, slots=True, eq=False)
class Corridor:
    """Tests with bounds, all of which must hold. r tests, p meters."""

    # (r, p) R, and ``1 / reach`` of each meter; tests that M meters then cannot bring to their bounds are
    # left out
    rows: Floats
    reach: Floats  # (p,) largest attack on each meter in any collusion; 0 for protected meters
    liars: int  # M, largest number of manipulated meters


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Attack with the largest displacement while all tests stay within their bounds. p meters."""

    size: float  # displacement, reached by `lies`
    # upper bound of the displacement; above `size` by more than GAP only after an incomplete search
    bound: float
    lies: Floats  # (p,) a


def corridor(rows: Floats, liars: int, *, reach: Floats) -> Corridor:
    """Tighten the largest attack on each meter, and leave out tests without effect.

    liars: M, at least 1.
    reach (p,): a bound of the attack on each meter in any collusion; 0 for protected meters.
    """
    size, liars = np.abs(rows), min(liars, reach.size)
    for _ in range(_ROUNDS):
        load = size * reach
        # Largest contribution of the M - 1 strongest other meters to each test.
        top = -np.sort(-load, axis=1)[:, :liars]
        few = top[:, : liars - 1].sum(axis=1)[:, None]
        last = top[:, [liars - 2]] if liars > 1 else np.inf
        others = np.where(load >= last, np.maximum(top.sum(axis=1)[:, None] - load, 0.0), few)
        with np.errstate(divide="ignore"):
            new = np.minimum(reach, np.min((1.0 + others) / size, axis=0, initial=np.inf))
        new = np.where(reach > 0.0, new, 0.0)
        done, reach = bool((new > (1.0 - _WORTH) * reach).all()), new
        if done:
            break
    most = -np.sort(-size * reach, axis=1)[:, :liars]
    able = np.flatnonzero(reach > 0.0)
    own = np.eye(reach.size)[able] / reach[able, None]
    return Corridor(np.vstack([rows[most.sum(axis=1) > 1.0 + _WITHIN], own]), reach, liars)


# _ROUNDS: rounds of tightening. _WORTH: smallest relative gain for another round.
_ROUNDS, _WORTH = 50, 1e-3


def furthest(given: Corridor, along: Floats, *, must: int | None = None, work: float = WORK) -> Shift:
    """Search all sets of at most M manipulated meters.

    along (p,) or (d, p): g; of several rows, the one with the largest displacement.
    must: a meter that is manipulated in any case.
    """
    search = _Search(given, np.zeros(given.reach.size), work)
    for row in np.atleast_2d(along):
        search.along(row, must)
    return Shift(search.size, max(search.size * (1.0 + GAP), search.open), search.lies)


@dataclass(slots=True)
class _Search:
    """Branch and bound, depth first, in batches; the best value so far is common to all directions."""

    given: Corridor
    lies: Floats
    work: float
    size: float = 0.0
    open: float = 0.0

    def along(self, g: Floats, must: int | None) -> None:
        p = g.size
        if must is None:
            self._below(g, np.zeros((1, 0), dtype=np.intp), np.zeros(1), g[None, :], np.arange(p))
        elif self.given.reach[must] > 0.0:
            alone = np.array([[must]], dtype=np.intp)
            value, left = self._solve(g, alone)
            self._below(g, alone, value, left, np.delete(np.arange(p), must))

    def _below(self, g: Floats, sets: Ints, value: Floats, left: Floats, free: Ints) -> None:
        """Expand the first sets by further meters, ordered by their bounds."""
        if sets.shape[1] >= self.given.liars:
            return
        promise = np.abs(left[0, free]) * self.given.reach[free]
        free = free[np.argsort(-promise, kind="stable")]
        free = free[self.given.reach[free] > 0.0]
        self._expand(g, sets, value, left, free, np.zeros(len(sets), dtype=np.intp))

    def _expand(  # noqa: PLR0917  # a batch of nodes: sets, their values, and further meters
        self, g: Floats, sets: Ints, value: Floats, left: Floats, free: Ints, begin: Ints
    ) -> None:
        """Expand sets by one meter each; `begin`: first candidate of each set, as a place in `free`."""
        more = self.given.liars - sets.shape[1] - 1
        gain = np.abs(left[:, free]) * self.given.reach[free]
        gain[np.arange(free.size) < begin[:, None]] = -np.inf
        after = np.full_like(gain, 0.0)
        after[:, :-1] = np.maximum.accumulate(gain[:, ::-1], axis=1)[:, -2::-1]
        bound = value[:, None] + gain + more * np.maximum(after, 0.0)
        node, place = np.nonzero(bound > self.size * (1.0 + GAP))
        order = np.argsort(-bound[node, place], kind="stable")
        for k in range(0, order.size, _TOGETHER):
            some = order[k : k + _TOGETHER]
            best = bound[node[some], place[some]]
            some = some[best > self.size * (1.0 + GAP)]
            if not some.size:
                return
            if self.work <= 0.0:
                self.open = max(self.open, float(best[0]))
                return
            grown = np.hstack([sets[node[some]], free[place[some]][:, None]])
            found, rest = self._solve(g, grown)
            if more:
                self._expand(g, grown, found, rest, free, place[some] + 1)

    def _solve(self, g: Floats, sets: Ints) -> tuple[Floats, Floats]:
        """Optimum for each set alone, and remainders of g, (n, p); updates the best of all sets."""
        n, m = sets.shape
        rows = self.given.rows
        part = np.moveaxis(rows[:, sets], 0, 1)
        want = g[sets]
        basis = _independent(part)
        value, left = np.full(n, np.inf), np.zeros((n, g.size))
        todo = np.arange(n)
        for _ in range(_STEPS * m):
            tests, goal, at = part[todo], want[todo], basis[todo]
            square = np.take_along_axis(tests, at[:, :, None], axis=1)
            inverse = np.linalg.inv(square)
            y = np.einsum("nij,ni->nj", inverse, goal)
            sign = np.where(y < 0.0, -1.0, 1.0)
            a = np.einsum("nij,nj->ni", inverse, sign)
            shown = np.einsum("nrm,nm->nr", tests, a)
            self.work -= tests.size
            worst = np.argmax(np.abs(shown), axis=1)
            over = np.take_along_axis(shown, worst[:, None], axis=1)[:, 0]
            most = np.maximum(np.abs(over), 1.0)
            value[todo] = np.abs(y).sum(axis=1)
            left[todo] = g - np.einsum("nm,nmp->np", y, rows[at])
            self._keep(sets[todo], value[todo] / most, a / most[:, None])
            # The entering test goes to its bound; the test with the first multiplier at zero leaves.
            enter = np.take_along_axis(tests, worst[:, None, None], axis=1)[:, 0]
            slope = sign * np.sign(over)[:, None] * np.einsum("nij,ni->nj", inverse, enter)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where(slope > _WITHIN, np.abs(y) / slope, np.inf)
            leave = np.argmin(ratio, axis=1)
            go = (most > 1.0 + _WITHIN) & np.isfinite(ratio.min(axis=1))
            # At the last level, sets that cannot become the best are dropped.
            if m == self.given.liars:
                go &= value[todo] > self.size * (1.0 + GAP)
            basis[todo[go], leave[go]] = worst[go]
            todo = todo[go]
            if not todo.size:
                break
        if m == self.given.liars and todo.size:
            self.open = max(self.open, float(value[todo].max()))
        return value, left

    def _keep(self, sets: Ints, reached: Floats, a: Floats) -> None:
        best = int(np.argmax(reached))
        if reached[best] > self.size:
            self.size = float(reached[best])
            self.lies = np.zeros_like(self.lies)
            self.lies[sets[best]] = a[best]


def _independent(part: Floats) -> Ints:
    """Rows of m independent tests for m unknowns, (n, m), by elimination with pivots; `part` is (n, r, m)."""
    n, _, m = part.shape
    work, every = part.copy(), np.arange(n)
    chosen = np.zeros((n, m), dtype=np.intp)
    for k in range(m):
        chosen[:, k] = np.argmax(np.abs(work[:, :, k]), axis=1)
        pivot = work[every, chosen[:, k]]
        # Columns that are done are not read again.
        work[:, :, k + 1 :] -= (work[:, :, k] / pivot[:, [k]])[:, :, None] * pivot[:, None, k + 1 :]
    return chosen

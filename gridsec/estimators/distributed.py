"""Distributed resilient estimation: concentrators of a radial feeder that exchange boundary messages.

The feeder is cut at buses into areas, one concentrator each. An area hangs on a *boundary* bus of the area
above. The tree of areas has the conditional independence

    readings below  _||_  readings elsewhere   |   s = (u, P, Q, z)

with u the squared voltage of the boundary bus, P + jQ the power into the area, and z the load errors common
to all customers. A concentrator therefore condenses everything on its side of a boundary into one likelihood
of s of dimension d = 3 + k,

    -2 ln p(Y | s) = s^T Lam s - 2 eta^T s + c,     Lam = H^T V^-1 H,  eta = H^T V^-1 Y,  c = Y^T V^-1 Y,
    H = Cov(Y, s) Cov(s)^+,   V = Cov(Y) - H Cov(s, Y),

where Y are its readings and what its other neighbours sent. With ``Lam = L L^T`` a message is a set of at
most d *pseudo-readings* ``L^+ eta`` of ``L^T s`` with unit noise. One message per direction and boundary
gives every concentrator the posterior, the leave-one-out residuals and the chi-square of a central estimator
with all readings. No reading and no load leaves its area.

Powers and voltages of the model travel the same way: flows and losses towards the busbar, voltages away from
it, in two passes that equal `gridsec.grid.radial.Feeder.bus_voltages` with one correction for losses.

**Manipulated concentrators.** The pseudo-readings of a message are tested like meters. With ``e`` their
difference from the prediction by everything else and C its covariance, ``e^T C^-1 e`` is chi-square of their
rank for an honest one. A concentrator with a neighbour beyond the limit disputes it, and goes on without its
messages and with an unknown power or voltage at that boundary. A message within the limit l moves a boundary
by at most l standard deviations of that prediction, whatever information it claims. `verdict` names the
fewest concentrators that explain all disputes.

Assumptions: balanced radial feeder, Gaussian load errors as in `LoadDoubt`, one tick or means over a window.

Source: lee2018 section 6.2 states distributed resilient estimation as future work; Pearl 1988 for exact
inference on trees; docs/theory-distributed.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, TypeAlias

import numpy as np
from scipy.special import gammainccinv

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import InputInvalid, Problem, raise_if_any
from gridsec.estimators.front.posterior import EXACT, UNMETERED, LoadDoubt
from gridsec.grid.network import below, from_root
from gridsec.grid.radial import Feeder
from gridsec.interface import Decision

FALSE_ALARM: Final = 1e-6
"""Probability that an honest meter or message exceeds its limit in one round, 1."""
ROOM: Final = 1e-6
"""Relative room of the least eigenvalue of an information matrix at 0, 1: rounding."""
_NOTHING: Final = 1e-10
"""Information about a boundary that is none, in units of its prior precision, 1: rounding."""
UNKNOWN_POWER: Final = 0.5
"""Standard deviation of the power into a disputed area, pu: half the base power, above any connection."""
OPEN: Final = np.array([UNMETERED, UNKNOWN_POWER, UNKNOWN_POWER])
"""`Message.doubt` of a boundary without messages."""
PATIENCE: Final = 3
"""Rounds until a lost message, a dispute, or for each area a claimed residual, takes effect."""
SAVED: Final = 3
"""Meters that one manipulated concentrator outweighs: priors 1 / 10 and 1 / 1000 are as likely."""
BOUNDARY: Final = 3
"""Boundary variables beside the common errors: u, P, Q."""
_MODEL: Final = 5
"""Numbers of the model in a message."""
_SINGULAR: Final = 1e-12
"""Relative eigenvalue of a boundary's covariance that is 0: an area without customers has no power."""


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """Everything on the sender's side of a boundary. d = 3 + k.

    Attributes
    ----------
    information, vector : (d, d), (d,)
        Lam and eta for the deviation of s from `reference`.
    chi_square
        c for that deviation.
    readings
        Number of readings behind it.
    reference : (3,)
        Squared voltage and power of the boundary to which the deviations refer, pu.
    model : (5,)
        Towards the busbar: linear power P, Q, losses P, Q and charging of the area, pu. Away from it: linear
        and corrected squared voltage of the boundary, and zeros.
    doubt : (3,)
        Standard deviations that the disputes and lost links on the sender's side add to the prior of u, P, Q,
        pu.
    worst
        Largest normalised residual on the sender's side among meters that it trusts, 1.
    """

    information: Floats
    vector: Floats
    chi_square: float
    readings: int
    reference: Floats
    model: Floats
    doubt: Floats
    worst: float = 0.0

    def to_json(self) -> str:
        """JSON of the message; numbers restore the same float64."""
        arrays = {name: getattr(self, name).tolist() for name in _ARRAYS}
        numbers = {name: getattr(self, name) for name in ("chi_square", "readings", "worst")}
        return json.dumps(arrays | numbers)

    @staticmethod
    def from_json(text: str | bytes, size: int) -> Message:
        """Message of dimension `size`.

        Raises
        ------
        InputInvalid
            If the text is not such a message; names every problem.
        """
        try:
            read = json.loads(text)
            given = {name: np.array(read[name], dtype=np.float64) for name in _ARRAYS}
            chi, readings, worst = float(read["chi_square"]), int(read["readings"]), float(read["worst"])
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise InputInvalid([Problem("not-readable", f"not a boundary message: {error}")]) from None
        message = Message(chi_square=chi, readings=readings, worst=worst, **given)
        raise_if_any(message.problems(size))
        return message

    def problems(self, size: int) -> list[Problem]:
        """Every reason for which the message is not a likelihood of dimension `size`."""
        shapes = {
            "information": (size, size),
            "vector": (size,),
            "reference": (3,),
            "model": (_MODEL,),
            "doubt": (BOUNDARY,),
        }
        out = [
            Problem("shape", f"{name} has the shape {getattr(self, name).shape}, not {wanted}")
            for name, wanted in shapes.items()
            if getattr(self, name).shape != wanted
        ]
        numbers = [np.ravel(getattr(self, name)) for name in (*_ARRAYS, "chi_square", "worst")]
        if not np.isfinite(np.concatenate(numbers)).all():
            return [*out, Problem("not-finite", "every number must be finite")]
        if min(self.readings, self.chi_square, self.worst, *self.doubt.tolist()) < 0:
            out.append(Problem("negative", "readings, chi_square, worst and doubt must not be negative"))
        if not out:
            least = np.linalg.eigvalsh(0.5 * (self.information + self.information.T))[0]
            if least < -ROOM * max(1.0, float(np.trace(self.information))):
                out.append(Problem("negative", "information must be positive semidefinite"))
        return out


_ARRAYS = ("information", "vector", "reference", "model", "doubt")


@dataclass(frozen=True, slots=True, eq=False)
class Area:
    """Part of a feeder with its concentrator. c customers, m meters, a areas below, L latent variables.

    All rows are sensitivities to independent standard normal variables: the customers' own power errors, the
    powers into the areas below, the voltage above, and the common errors.
    """

    number: int
    name: str
    above: int | None  # area above; None for the area of the busbar
    under: tuple[int, ...]  # (a,) areas below
    feeder: Feeder  # bus 0 is the boundary to the area above; the last `a` customers are the areas below
    customers: Ints  # (c,) customers of the whole feeder
    meters: Ints  # (m,) meters of the whole feeder
    meter_customers: Ints  # (m,) customer of each meter within the area
    rows: Floats  # (m, L) sensitivities of the meters' squared voltages
    bus_rows: Floats  # (n, L) those of all buses, the boundary first
    boundaries: Mapping[int, Floats]  # (d, L) sensitivities of s at the boundary to each neighbour
    opened: Mapping[int, Opened]  # unknowns in place of each neighbour's messages

    reach: int  # number of areas of the feeder

    @property
    def neighbours(self) -> tuple[int, ...]:
        """Areas with a common boundary."""
        return self.under if self.above is None else (self.above, *self.under)

    @property
    def size(self) -> int:
        """Dimension d of the messages."""
        return next(iter(self.boundaries.values())).shape[0] if self.boundaries else BOUNDARY


@dataclass(frozen=True, slots=True, eq=False)
class Opened:
    """Sensitivities to r errors at a boundary: of u above the area, or of P and Q into an area below."""

    buses: Floats  # (n, r) of the squared voltages
    into: Floats  # (2, r) of the power into the area
    which: slice  # these errors among u, P, Q


@dataclass(frozen=True, slots=True, eq=False)
class AreaEstimate:
    """Estimate of one concentrator. n buses, m meters."""

    v2: Floats  # (n,) squared voltages, the boundary first, pu
    std: Floats  # (n,) their standard deviations, pu
    residual: Floats  # (m,) leave-one-out residuals, squared pu; NaN without a reading
    residual_std: Floats  # (m,) their standard deviations
    suspects: Bools  # (m,) meters that are not trusted
    disputed: frozenset[int]  # neighbours with a message beyond its limit
    silent: frozenset[int]  # neighbours without a message
    chi_square: float  # of all trusted readings of the feeder
    readings: int  # number of these


def partition(feeder: Feeder, tops: Sequence[int]) -> Ints:
    """Area of each bus, (b + 1,): area i > 0 is the subtree of bus ``tops[i - 1]`` without deeper areas.

    Raises
    ------
    InputInvalid
        If a top is not a bus below the busbar, or appears twice.
    """
    buses = len(feeder.buses)
    problems = [
        Problem("out-of-range", f"top {top} is not a bus from 1 to {buses - 1}")
        for top in tops
        if not 1 <= top < buses
    ]
    if len(set(tops)) < len(tops):
        problems.append(Problem("duplicate", "a bus is the top of one area only"))
    raise_if_any(problems)
    out, of = np.zeros(buses, dtype=np.intp), {top: k for k, top in enumerate(sorted(tops), start=1)}
    for bus in range(1, buses):
        out[bus] = of.get(bus, out[feeder.parent[bus - 1]])
    return out


def laterals(feeder: Feeder, customers: int) -> tuple[int, ...]:
    """Tops of areas with at least this number of customers each, from the ends towards the busbar."""
    count = np.bincount(feeder.bus, minlength=len(feeder.buses))
    out = []
    for bus in range(len(feeder.buses) - 1, 0, -1):
        if count[bus] >= customers:
            out.append(bus)
        else:
            count[feeder.parent[bus - 1]] += count[bus]
    return tuple(sorted(out))


def design(
    feeder: Feeder, meters: Ints, noise: Floats, doubt: LoadDoubt, *, tops: Sequence[int], busbar: float
) -> tuple[Area, ...]:
    """Areas of a feeder, the busbar's first.

    meters: (p,) customer of each meter. noise: (p,) variance of its squared reading, squared pu^2.
    doubt: errors of the customers' powers. tops: (a,) first bus of each area beside the busbar's.
    busbar: standard deviation of the squared busbar voltage, pu; NaN for an unmetered one.

    Raises
    ------
    InputInvalid
        If `tops` are no partition, or a variance is not positive.
    """
    if not bool((noise > 0.0).all()):
        raise InputInvalid([Problem("negative", "every variance of a reading must be positive")])
    return _Design(feeder, meters, noise, doubt, partition(feeder, tops), busbar).areas()


class _Design:
    """Construction of the areas. The k common errors are those of p, of q, and of both together."""

    def __init__(  # noqa: PLR0917
        self, feeder: Feeder, meters: Ints, noise: Floats, doubt: LoadDoubt, area: Ints, busbar: float
    ) -> None:
        self.feeder, self.meters, self.noise, self.area = feeder, meters, noise, area
        self.busbar = UNMETERED if math.isnan(busbar) else busbar
        count = int(area.max()) + 1
        tops = [int(np.flatnonzero(area == k)[0]) for k in range(count)]
        self.attach = [0] + [int(feeder.parent[top - 1]) for top in tops[1:]]
        self.above = [None] + [int(area[bus]) for bus in self.attach[1:]]
        alone, together = np.sqrt(1.0 - doubt.together), np.sqrt(doubt.together)
        p, q = np.maximum(doubt.p, EXACT), np.maximum(doubt.q, EXACT)
        self.own = doubt.own
        none = np.zeros_like(p)
        common = np.stack(
            [
                np.stack([np.sqrt(doubt.common_p) * alone * p, none, together * p]),
                np.stack([none, np.sqrt(doubt.common_q) * alone * q, together * q]),
            ]
        )
        self.common = common[:, np.abs(common).max(axis=(0, 2)) > 0.0]  # (2, k, N)
        # Of all customers at or below the boundary of each area.
        self.inside = [self._inside(top) for top in tops]
        self.linear = feeder.linear()

    def _inside(self, top: int) -> Bools:
        walk = self.feeder.walk
        at = walk.start[self.feeder.bus]
        return np.asarray((walk.start[top] <= at) & (at < walk.stop[top]))

    def _area(self, k: int) -> Area:
        feeder, k_common = self.feeder, self.common.shape[1]
        buses = np.flatnonzero(self.area == k)
        under = tuple(j for j, above in enumerate(self.above) if above == k and j != k)
        part = self._part(k, buses, under)
        mine = np.flatnonzero(self.area[feeder.bus] == k)
        c, a = mine.size, len(under)
        latent = 2 * c + 2 * a + 1 + k_common
        common = slice(latent - k_common, latent)
        # (2, c + a, L): errors of the powers of the customers and into the areas below.
        powers = np.zeros((2, c + a, latent))
        for kind in range(2):
            powers[kind, np.arange(c), kind * c + np.arange(c)] = self.own[kind, mine]
            powers[kind, :c, common] = self.common[kind][:, mine].T
            for n, j in enumerate(under):
                powers[kind, c + n, 2 * c + 2 * n + kind] = np.sqrt(
                    (self.own[kind, self.inside[j]] ** 2).sum()
                )
                powers[kind, c + n, common] = self.common[kind][:, self.inside[j]].sum(axis=1)
        into = powers.sum(axis=1)  # (2, L): power into the area
        top = self._above_row(k, into, latent, common)
        model = part.linear()
        bus_rows = top + 2.0 * (model.R_bus @ powers[0] + model.X_bus @ powers[1])
        which = np.flatnonzero(self.area[feeder.bus[self.meters]] == k)
        local = np.searchsorted(mine, self.meters[which])
        shared = np.zeros((k_common, latent))
        shared[:, common] = np.eye(k_common)
        boundaries = {
            j: np.vstack([bus_rows[part.bus[c + n]], powers[:, c + n], shared]) for n, j in enumerate(under)
        }
        path = self._path(k)
        opened = {
            j: Opened(
                path + 2.0 * np.stack([model.R_bus[:, c + n], model.X_bus[:, c + n]], axis=1),
                np.eye(2),
                slice(1, BOUNDARY),
            )
            for n, j in enumerate(under)
        }
        above = self.above[k]
        if above is not None:
            boundaries[above] = np.vstack([top, into, shared])
            opened[above] = Opened(np.ones((bus_rows.shape[0], 1)), np.zeros((2, 1)), slice(0, 1))
        return Area(
            number=k,
            name=feeder.buses[0] if k == 0 else feeder.buses[int(buses[0])],
            above=self.above[k],
            under=under,
            feeder=part,
            customers=mine,
            meters=which,
            meter_customers=local,
            rows=bus_rows[part.bus[local]],
            bus_rows=bus_rows,
            boundaries=boundaries,
            opened=opened,
            reach=len(self.inside),
        )

    def _above_row(self, k: int, into: Floats, latent: int, common: slice) -> Floats:
        """Squared voltage of the boundary to the area above, (L,)."""
        row = np.zeros(latent)
        free = common.start - 1
        if k == 0:
            row[free] = self.busbar
            return row
        bus, outside = self.attach[k], ~self.inside[k]
        R, X = self.linear.R_bus[bus], self.linear.X_bus[bus]
        row += self._path(k) @ into
        row[common] += 2.0 * (
            self.common[0][:, outside] @ R[outside] + self.common[1][:, outside] @ X[outside]
        )
        alone = (R * self.own[0])[outside] ** 2 + (X * self.own[1])[outside] ** 2
        row[free] = np.sqrt(4.0 * alone.sum() + self.busbar**2)
        return row

    def _path(self, k: int) -> Floats:
        """Sensitivity of the boundary's squared voltage to the power into the area, (2,)."""
        feeder, bus, out = self.feeder, self.attach[k], np.zeros(2)
        while bus:
            out += 2.0 * feeder.r[bus - 1], 2.0 * feeder.x[bus - 1]
            bus = int(feeder.parent[bus - 1])
        return out

    def areas(self) -> tuple[Area, ...]:
        """All areas, the busbar's first."""
        return tuple(self._area(k) for k in range(len(self.inside)))

    def _part(self, k: int, buses: Ints, under: tuple[int, ...]) -> Feeder:
        """Feeder of an area: its boundary, its buses, its customers, and the areas below as customers."""
        feeder = self.feeder
        inner = buses[1:] if k == 0 else buses
        ends = np.concatenate([[self.attach[k]], inner])
        local = {int(bus): n for n, bus in enumerate(ends)}
        mine = np.flatnonzero(self.area[feeder.bus] == k)
        at = [local[int(bus)] for bus in feeder.bus[mine]] + [local[self.attach[j]] for j in under]
        names = [feeder.customers[i] for i in mine] + [f"area {j}" for j in under]
        return Feeder(
            name=f"{feeder.name} {k}",
            parent=np.array([local[int(feeder.parent[bus - 1])] for bus in inner], dtype=np.intp),
            r=feeder.r[inner - 1],
            x=feeder.x[inner - 1],
            bus=np.array(at, dtype=np.intp),
            customers=tuple(names),
            buses=tuple(feeder.buses[int(bus)] for bus in ends),
            base_volt=feeder.base_volt,
            base_kva=feeder.base_kva,
            charging=feeder.charging[inner - 1],
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Sweep:
    """Model of an area at the reported powers. n buses."""

    linear: Floats  # (n,) squared voltages without losses, pu
    v2: Floats  # (n,) with one correction for losses, pu
    into: Floats  # (5,) linear power P, Q into the area, its losses P, Q, its charging, pu


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Rows ``y = B omega + e`` with omega ~ N(0, 1) and independent e. r rows."""

    y: Floats  # (r,) readings less the model, and pseudo-readings
    of_latents: Floats  # (r, L) B
    noise: Floats  # (r,) variances of e
    part: Mapping[int, slice]  # rows of each neighbour's message
    spare: float  # chi-square of the messages beyond their pseudo-readings
    behind: int  # number of readings

    def without(self, rows: slice) -> _Rows:
        """Rows without a range."""
        keep = np.ones(self.y.size, dtype=np.bool_)
        keep[rows] = False
        return _Rows(self.y[keep], self.of_latents[keep], self.noise[keep], {}, self.spare, self.behind)

    def solve(self) -> tuple[Floats, Floats]:
        """Precision Q of the rows, (r, r), and Q y."""
        precision = np.asarray(np.linalg.inv(self.of_latents @ self.of_latents.T + np.diag(self.noise)))
        return precision, np.asarray(precision @ self.y)


class Concentrator:
    """Concentrator of one area: readings and messages in, messages and an estimate out. No clock.

    A round is `receive` for the neighbours' messages, `decide`, and `send`. Without a message for `PATIENCE`
    rounds a link is lost: its boundary opens like that to a disputed neighbour.
    """

    def __init__(self, area: Area, noise: Floats) -> None:
        """noise: (m,) variance of each meter's squared reading, squared pu^2."""
        self.area, self.noise = area, noise
        self.trusted = np.ones(area.meters.size, dtype=np.bool_)
        self.disputed: frozenset[int] = frozenset()
        self.refused: dict[int, tuple[Problem, ...]] = {}
        self._inbox: dict[int, Message] = {}
        self._age = dict.fromkeys(area.neighbours, PATIENCE)
        self._beyond = dict.fromkeys(area.neighbours, 0)
        self._claims = dict.fromkeys(area.neighbours, (0.0, 0))
        self._tried = self.trusted
        self._y = np.full(area.meters.size, np.nan)
        self._power = np.zeros((2, area.customers.size))
        self._v0 = 1.0
        self._swept = self._sweep()

    def observe(self, v2: Floats, p: Floats, q: Floats, v0_squared: float = 1.0) -> None:
        """Take the readings of a tick.

        v2: (m,) squared voltages, NaN for a missing one. p, q: (c,) injected powers, pu, those of inverters
        included. v0_squared: squared busbar voltage, of the area of the busbar only.
        """
        self._y, self._power, self._v0 = v2, np.stack([p, q]), v0_squared
        self._swept = self._sweep()

    def receive(self, sender: int, message: Message) -> None:
        """Take a neighbour's message; an impossible one is refused and counts as missing."""
        problems = tuple(message.problems(self.area.size))
        if problems:
            self.refused[sender] = problems
            return
        self.refused.pop(sender, None)
        self._inbox[sender], self._age[sender] = message, 0
        self._swept = self._sweep()

    def send(self) -> dict[int, Message]:
        """Messages to all neighbours."""
        loo, std = self._leave_one_out(self.trusted, self._closed())
        own = float(np.max(np.abs(loo / std), where=self.trusted & self._available(), initial=0.0))
        out = {j: self._message(j, own) for j in self.area.neighbours}
        for j in self._age:
            self._age[j] += 1
        return out

    def decide(self) -> None:
        """Trust or distrust one meter, and test the neighbours' messages.

        The largest normalised residual of the feeder is removed first, as by a central estimator: a meter is
        distrusted while no neighbour claims a larger one. A claim that stands for `PATIENCE` rounds per area
        expires. A neighbour is disputed instead where that exonerates `SAVED` meters or more.
        """
        limit, shut = _limit(1), self._closed()
        before, suspects = self.trusted, int(np.count_nonzero(~self.trusted))
        self.trusted = self._moved(before, shut, max(limit, self._claimed()), limit)
        if (
            suspects >= SAVED
            and np.array_equal(before, self.trusted)
            and not np.array_equal(before, self._tried)
        ):
            self._tried = before
            trials = {j: self._descent(shut - {j}, limit) for j in sorted(shut)}
            blamed = min(trials, key=lambda j: int(np.count_nonzero(~trials[j])), default=-1)
            if blamed in trials and suspects - np.count_nonzero(~trials[blamed]) >= SAVED:
                self.trusted, self.disputed = trials[blamed], self.disputed | {blamed}
                self._beyond[blamed] = 0
        self._test_messages(limit)

    def _moved(self, trusted: Bools, shut: frozenset[int], remove: float, limit: float) -> Bools:
        """Trust after one move: a consistent meter returns, or the worst residual above `remove` goes."""
        loo, std = self._leave_one_out(trusted, shut)
        score = np.nan_to_num(np.abs(loo) / std)
        out = trusted.copy()
        back = ~trusted & self._available() & (score <= limit)
        if back.any():
            out[np.argmin(np.where(back, score, np.inf))] = True
        elif np.any(trusted & (score > limit) & (score >= remove)):
            out[np.argmax(np.where(trusted, score, 0.0))] = False
        return out

    def _descent(self, shut: frozenset[int], limit: float) -> Bools:
        """Trusted meters of this area by the messages of `shut` neighbours."""
        now = np.ones_like(self.trusted)
        for _ in range(2 * now.size):
            before, now = now, self._moved(now, shut, limit, limit)
            if np.array_equal(now, before):
                break
        return now

    def estimate(self) -> AreaEstimate:
        """Estimate with the present readings, messages and trust."""
        shut = self._closed()
        latents = self._latents(shut)
        rows = self._rows(latents, self.trusted, shut)
        precision, weights = rows.solve()
        gain = latents.buses @ rows.of_latents.T
        variance = (latents.buses**2).sum(axis=1) - np.einsum("ij,jk,ik->i", gain, precision, gain)
        loo, std = self._leave_one_out(self.trusted, shut)
        return AreaEstimate(
            v2=self._swept.v2 + gain @ weights,
            std=np.sqrt(np.maximum(variance, 0.0)),
            residual=loo,
            residual_std=std,
            suspects=~self.trusted,
            disputed=self.disputed,
            silent=frozenset(j for j, age in self._age.items() if age >= PATIENCE),
            chi_square=float(rows.y @ weights) + rows.spare,
            readings=rows.behind,
        )

    def _closed(self) -> frozenset[int]:
        """Neighbours with messages in use."""
        return frozenset(j for j, age in self._age.items() if age < PATIENCE) - self.disputed

    def _claimed(self) -> float:
        """Largest residual that a neighbour claims and has not claimed for too long."""
        out = 0.0
        for j in self._closed():
            worst, rounds = self._inbox[j].worst, 0
            if worst == self._claims[j][0]:
                rounds = self._claims[j][1] + 1
            self._claims[j] = worst, rounds
            out = max(out, worst if rounds < PATIENCE * self.area.reach else 0.0)
        return out

    def _test_messages(self, limit: float) -> None:
        """Dispute neighbours beyond their limit for `PATIENCE` rounds, and end disputes likewise."""
        disputed = set(self.disputed)
        for j in self.area.neighbours:
            if self._age[j] >= PATIENCE:
                continue
            beyond = self._beyond_limit(j)
            pending = self._inbox[j].worst > limit and self._claims[j][1] < PATIENCE * self.area.reach
            change = beyond is not (j in disputed) and not (beyond and pending)
            self._beyond[j] = self._beyond[j] + 1 if change else 0
            if self._beyond[j] >= PATIENCE:
                disputed ^= {j}
                self._beyond[j] = 0
        self.disputed = frozenset(disputed)

    def _beyond_limit(self, j: int) -> bool:
        """True if a neighbour's message and everything else here exclude each other."""
        shut = self._closed() | {j}
        latents = self._latents(shut)
        rows = self._rows(latents, self.trusted, shut)
        part = rows.part[j]
        if part.stop == part.start:
            return False
        rest, other = rows.without(part), rows.of_latents[part]
        precision, weights = rest.solve()
        gain = other @ rest.of_latents.T
        e = rows.y[part] - gain @ weights
        covariance = other @ other.T + np.diag(rows.noise[part]) - gain @ precision @ gain.T
        return bool(e @ np.linalg.solve(covariance, e) > _limit(e.size) ** 2)

    def _sweep(self) -> _Sweep:
        """Model at the reported powers: `Feeder.bus_voltages` with one correction, cut at the boundaries."""
        area, feeder, walk = self.area, self.area.feeder, self.area.feeder.walk
        told = [self._inbox[j].model if j in self._inbox else np.zeros(_MODEL) for j in area.under]
        under = np.reshape(told, (len(area.under), _MODEL)).T
        linear = corrected = self._v0
        if area.above is not None and area.above in self._inbox:
            linear, corrected = self._inbox[area.above].model[:2].tolist()
        power, lost, charging = (np.zeros((rows, len(feeder.buses))) for rows in (2, 2, 1))
        for at, values in (
            (power, np.concatenate([self._power, under[:2]], axis=1)),
            (lost, under[2:4]),
            (charging, under[4:]),
        ):
            np.add.at(at.T, feeder.bus[feeder.bus.size - values.shape[1] :], values.T)
        P, Q = -below(walk, power)[:, 1:]
        rise = from_root(walk, -2.0 * (feeder.r * P + feeder.x * Q))
        charging += feeder.half * (linear + rise)
        charged = below(walk, charging)[0]
        current = (P**2 + (Q - charged[1:]) ** 2) / (linear + rise)[1:]
        own = np.zeros_like(lost)
        own[:, 1:] = feeder.r * current, feeder.x * current
        total = below(walk, own + lost)
        behind = (total - own)[:, 1:]
        drop = 2.0 * (feeder.r * behind[0] + feeder.x * (behind[1] - charged[1:])) + feeder.squared * current
        into = np.concatenate([power.sum(axis=1), total[:, 0], charged[:1]])
        return _Sweep(linear + rise, corrected + rise - from_root(walk, drop), into)

    def _latents(self, shut: frozenset[int], to: int | None = None) -> _Latents:
        """Sensitivities for the messages of `shut` neighbours; a message `to` one is without its doubts."""
        area = self.area
        more, into = [], []
        for j in area.neighbours:
            opened = area.opened[j]
            doubt = (self._inbox[j].doubt if j in shut else OPEN)[opened.which]
            if j != to and doubt.any():
                more.append(opened.buses * doubt)
                into.append(opened.into * doubt)
        buses = np.hstack([area.bus_rows, *more])
        latent, boundaries = area.bus_rows.shape[1], {}
        for j in area.neighbours:
            rows = np.zeros((area.size, buses.shape[1]))
            rows[:, :latent] = area.boundaries[j]
            if j == area.above and into:
                rows[1:BOUNDARY, latent:] = np.hstack(into)
            rows[0] = buses[self._bus(j)]
            boundaries[j] = rows
        return _Latents(buses, boundaries)

    def _bus(self, j: int) -> int:
        """Bus of the boundary to a neighbour."""
        area = self.area
        return 0 if j == area.above else int(area.feeder.bus[area.customers.size + area.under.index(j)])

    def _rows(self, latents: _Latents, trusted: Bools, shut: frozenset[int]) -> _Rows:
        """Rows of trusted meters with a reading, then those of the messages of `shut` neighbours."""
        area, at = self.area, self._available() & trusted
        bus = area.feeder.bus[area.meter_customers[at]]
        y, rows, noise = [self._y[at] - self._swept.v2[bus]], [latents.buses[bus]], [self.noise[at]]
        part, count, spare, behind = {}, int(at.sum()), 0.0, int(at.sum())
        for j in sorted(shut):
            message = self._inbox[j]
            of_boundary, scale = latents.boundaries[j], _scale(latents.boundaries[j])
            far = self._reference(j) - message.reference
            moved = message.information[:, :BOUNDARY] @ far
            vector = (message.vector - moved) * scale
            constant = message.chi_square - 2.0 * message.vector[:BOUNDARY] @ far + far @ moved[:BOUNDARY]
            size, axes = np.linalg.eigh(message.information * np.multiply.outer(scale, scale))
            keep = size > _NOTHING
            root = np.sqrt(size[keep])
            pseudo = axes[:, keep].T @ vector / root
            y.append(pseudo)
            rows.append((root[:, None] * axes[:, keep].T / scale) @ of_boundary)
            noise.append(np.ones(root.size))
            part[j] = slice(count, count + root.size)
            count, behind = count + root.size, behind + message.readings
            spare += constant - pseudo @ pseudo
        return _Rows(np.concatenate(y), np.concatenate(rows), np.concatenate(noise), part, spare, behind)

    def _available(self) -> Bools:
        return np.asarray(np.isfinite(self._y))

    def _reference(self, j: int) -> Floats:
        """Squared voltage and power of a boundary by the model, (3,)."""
        if j == self.area.above:
            return np.array([self._swept.v2[0], *_net(self._swept.into)])
        told = self._inbox[j].model if j in self._inbox else np.zeros(_MODEL)
        return np.array([self._swept.v2[self._bus(j)], *_net(told)])

    def _leave_one_out(self, trusted: Bools, shut: frozenset[int]) -> tuple[Floats, Floats]:
        """Residual of each meter against all other rows and its standard deviation, (m,); NaN if missing."""
        latents = self._latents(shut)
        rows = self._rows(latents, trusted, shut)
        precision, weights = rows.solve()
        area, available = self.area, self._available()
        loo, std = np.full((2, area.meters.size), np.nan)
        at = np.flatnonzero(available & trusted)
        own = np.diagonal(precision)[: at.size]
        loo[at], std[at] = weights[: at.size] / own, 1.0 / np.sqrt(own)
        out = np.flatnonzero(available & ~trusted)
        bus = area.feeder.bus[area.meter_customers[out]]
        other = latents.buses[bus]
        gain = other @ rows.of_latents.T
        loo[out] = self._y[out] - self._swept.v2[bus] - gain @ weights
        variance = (other**2).sum(axis=1) - np.einsum("ij,jk,ik->i", gain, precision, gain)
        std[out] = np.sqrt(np.maximum(variance, 0.0) + self.noise[out])
        return loo, std

    def _message(self, j: int, worst: float) -> Message:
        """Likelihood of everything on this side of the boundary to a neighbour."""
        area, shut = self.area, self._closed()
        latents = self._latents(shut, to=j)
        rows = self._rows(latents, self.trusted, shut - {j})
        extra = latents.boundaries[j][:BOUNDARY, area.bus_rows.shape[1] :]
        added = np.sqrt((extra**2).sum(axis=1))
        s, scale = latents.boundaries[j], _scale(latents.boundaries[j])
        s = s / scale[:, None]
        cross = rows.of_latents @ s.T
        gain = cross @ np.linalg.pinv(s @ s.T, rcond=_SINGULAR, hermitian=True)
        covariance = rows.of_latents @ rows.of_latents.T - gain @ cross.T + np.diag(rows.noise)
        both = np.linalg.solve(covariance, np.column_stack([gain, rows.y]))
        information = gain.T @ both[:, :-1] / np.multiply.outer(scale, scale)
        up, bus = j == area.above, self._bus(j)
        down = np.array([self._swept.linear[bus], self._swept.v2[bus], 0.0, 0.0, 0.0])
        others = [0.0, *(self._inbox[i].worst for i in shut - {j})]
        return Message(
            information=0.5 * (information + information.T),
            vector=gain.T @ both[:, -1] / scale,
            chi_square=max(float(rows.y @ both[:, -1]) + rows.spare, 0.0),
            readings=rows.behind,
            reference=self._reference(j),
            model=self._swept.into if up else down,
            doubt=np.where(np.arange(BOUNDARY) > 0, added, 0.0) if up else added * [1.0, 0.0, 0.0],
            worst=max(worst, *others),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Latents:
    """Sensitivities to the latent variables, open boundaries included."""

    buses: Floats  # (n, L)
    boundaries: Mapping[int, Floats]  # (d, L) of each neighbour


def _scale(rows: Floats) -> Floats:
    """Prior standard deviations of the boundary variables, 1 for constants, (d,)."""
    std = np.sqrt((rows**2).sum(axis=1))
    return np.where(std > 0.0, std, 1.0)


def _net(into: Floats) -> Floats:
    """Power into an area, losses deducted and charging added, (2,)."""
    return np.array([into[0] - into[2], into[1] - into[3] + into[4]])


def _limit(rank: int) -> float:
    """Root of the chi-square quantile at `FALSE_ALARM`, standard deviations."""
    return float(np.sqrt(2.0 * gammainccinv(0.5 * rank, FALSE_ALARM)))


Carry: TypeAlias = Callable[[int, int, Message], Message | None]
"""Link from a sender to a receiver; None for a lost message."""


def exchange(
    posts: Sequence[Concentrator],
    rounds: int,
    *,
    carry: Carry = lambda _from, _to, message: message,
    decide: bool = True,
) -> None:
    """Run rounds of all concentrators of a feeder in one process.

    carry: the links. decide: trust is decided, too.
    """
    for _ in range(rounds):
        sent = [(post.area.number, j, message) for post in posts for j, message in post.send().items()]
        for sender, receiver, message in sent:
            arrived = carry(sender, receiver, message)
            if arrived is not None:
                posts[receiver].receive(sender, arrived)
        if decide:
            for post in posts:
                post.decide()


@dataclass(frozen=True, slots=True)
class DistributedVerdict:
    """Verdict of all concentrators together."""

    decision: Decision
    meters: tuple[int, ...]  # manipulated meters by the concentrators that are not named
    concentrators: tuple[frozenset[int], ...]  # smallest sets that explain all disputes; several: either


def verdict(estimates: Mapping[int, AreaEstimate], areas: Sequence[Area]) -> DistributedVerdict:
    """Verdict on meters and concentrators.

    A dispute is explained by a manipulated concentrator at one of its two ends. The fewest concentrators that
    explain all disputes are named. Of several smallest sets each is an explanation: UNDECIDED.
    Suspects within a named area count for nothing. A lost link leaves the verdict UNDECIDED.
    """
    edges = {frozenset((k, j)) for k, each in estimates.items() for j in each.disputed}
    covers: tuple[frozenset[int], ...] = (frozenset(),)
    ends = sorted(set().union(*edges)) if edges else []
    for size in range(len(ends) + 1):
        covers = tuple(c for c in map(frozenset, combinations(ends, size)) if all(c & edge for edge in edges))
        if covers:
            break
    about = frozenset.union(*covers)
    meters = tuple(
        sorted(
            int(j) for k, each in estimates.items() if k not in about for j in areas[k].meters[each.suspects]
        )
    )
    lost = len(estimates) < len(areas) or any(each.silent for each in estimates.values())
    if meters or (len(covers) == 1 and covers[0]):
        decision = Decision.ATTACKED
    else:
        decision = Decision.UNDECIDED if edges or lost else Decision.CLEAN
    return DistributedVerdict(decision, meters, covers if edges else ())

"""Detectability under the sequential monitor's decision rule, as inequalities: hidden, noticed, named.

Attacks a on trusted meters move the leave-one-out residual of meter j by ``(Q a)_j / Q_jj``. Residuals
without attack are sub-Gaussian with variance ``1 / Q_jj`` (Gaussian and uniform parts alike). So at one
moment, on s scales and at p meters together, all are within ``H_j`` with probability at least 1 - risk. Hence

- hidden:  ``|(Q a)_j| <= (limit_j - H_j) Q_jj`` on all scales: no meter is beyond its limit;
- noticed: an attack without ``|(Q a)_j| <= (limit_j + H_j) Q_jj`` everywhere: some meter is beyond it;
- named:   every explanation that trusts meter k has a misfit of at least ``m_k^2 / (S_kk + d_k)``,
  for any readings of all other meters; if that exceeds the cost of the true one by 2 ln(like), there is no
  rival.

The first two are linear in a but for the number of manipulated meters: `gridsec.planning.collusion` searches
them.

Source: D. Hsu, S. Kakade, T. Zhang, "A tail inequality for quadratic forms of subgaussian random vectors",
2012; docs/theory-studies.md, section 5; docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.measurements import nominal_uncertainty
from gridsec.estimators.sequential.meter_bias import Learning, class_only, learn, no_readings
from gridsec.estimators.sequential.posterior import condition
from gridsec.estimators.sequential.search import Limits, false_power_charge, set_cost
from gridsec.estimators.sequential.time_scales import (
    Scales,
    chi_square_limit,
    empty,
    score_limit,
    score_rows,
    scored,
)
from gridsec.planning.collusion import Corridor, Shift, corridor, furthest
from gridsec.planning.unavoidable import AcceptanceRegion, ConeProgram, Faults, deviations

__all__ = [
    "ROOM",
    "MonitorTests",
    "Rule",
    "Shift",
    "Threshold",
    "acceptance_region",
    "honest_covariance",
    "largest_shift",
    "learned_scales",
    "named_size",
    "rule",
    "within",
]


@dataclass(frozen=True, slots=True, eq=False)
class Rule:
    """The monitor's rule before biases are learned, with all meters trusted. s scales, p meters, n buses."""

    design: SequentialDesign
    risk: float  # probability that residuals without attack are beyond `honest` somewhere, at one moment
    # the corresponding standard deviations of a sub-Gaussian variable: ``sqrt(2 ln(2 s p / risk))``
    deviations: float
    inverse: Floats  # (s, p, p) Q on each scale
    # limit, honest (s, p): largest offset without evidence, and H, squared pu
    limit: Floats
    honest: Floats
    noise: Floats  # (s, p) variance d of each meter's mean
    model: Floats  # (p,) error of the model, squared pu

    def weights(self, bus: int) -> Floats:
        """Effect of each meter's attack on the reconstruction of a bus, on each scale, (s, p)."""
        return np.asarray(self.inverse @ self.design.prior.covariance[bus])

    def spread(self, bus: int) -> float:
        """Uncertainty of a bus without attack, with the same probability on any scale, squared pu."""
        prior = self.design.prior
        row = prior.covariance[bus]
        left = prior.variance[bus] - np.einsum("p,spq,q->s", row, self.inverse, row)
        return self.deviations * float(np.sqrt(np.maximum(left, 0.0).max())) + float(self.model.max())


def rule(design: SequentialDesign, *, risk: float, model: Floats) -> Rule:
    """Compute the rule of a monitor.

    risk: as in `Rule`.
    model: as in `Rule`.
    """
    between, prior = design.prior.between, design.prior
    need = [max(1, int(np.ceil(design.options.enough * length))) for length in design.lengths]
    noise = np.array([design.white / n + design.fixed for n in need])
    inverse = np.array([np.linalg.inv(between + np.diag(d)) for d in noise])
    std = 1.0 / np.sqrt(np.einsum("sjj->sj", inverse))
    t = float(np.sqrt(2.0 * np.log(2.0 * std.size / risk)))
    limit = np.array(
        [
            Limits(sigmas, np.zeros_like(model), design.allowed, design.fixed).limit(row)
            for sigmas, row in zip(design.sigmas, std, strict=True)
        ]
    )
    # A meter's own fixed error is fully in its residual, and within the class.
    rest = np.sqrt(np.maximum(std**2 - design.fixed, 0.0))
    honest = np.minimum(t * std, design.allowed + t * rest)
    assert prior.meters.size == model.size  # noqa: S101  # both are of the meters
    return Rule(design, risk, t, inverse, limit, honest, noise, model)


def within(given: Rule, liars: int, *, seen: bool, honest: Bools | None = None) -> Corridor:
    """Constraints on attacks of at most M meters with all residuals within their bounds.

    liars: M.
    seen: the bound: False for limit - H (certainly within the limit: hidden), True for limit + H + the model
        error on both sides (beyond it, some meter certainly exceeds its limit).
    honest (p,): meters that cannot be manipulated.
    """
    s, p = given.limit.shape
    width = given.limit + given.honest + 2.0 * given.model if seen else given.limit - given.honest
    if liars < 1 or (width <= 0.0).any():
        return Corridor(np.zeros((0, p)), np.zeros(p), 1)
    size = np.einsum("sjj->sj", given.inverse)
    rows = (given.inverse / (width * size)[:, :, None]).reshape(s * p, p)
    # |a| <= |Q^-1| |Q a|
    most = np.min(
        [np.abs(np.linalg.inv(Q)) @ (w * d) for Q, w, d in zip(given.inverse, width, size, strict=True)], 0
    )
    return corridor(rows, liars, reach=most if honest is None else np.where(honest, 0.0, most))


def largest_shift(
    given: Rule,
    along: Floats,
    liars: int,
    *,
    seen: bool,
    must: int | None = None,
    honest: Bools | None = None,
) -> Shift:
    """Largest displacement by attacks on at most M meters with all residuals within their bounds.

    along (p,) or (d, p): displacement per attack on each meter; a unit vector for the attack on one meter
        itself. Of several rows, the one with the largest displacement.
    must: a meter that is manipulated in any case.
    """
    return furthest(within(given, liars, seen=seen, honest=honest), along, must=must)


def named_size(given: Rule, meter: int, liars: int, *, claims: Floats) -> float:
    """Smallest attack on a meter above which no explanation that trusts it is a rival, squared pu.

    It holds for any attacks on other meters. The true explanation, with at most M manipulated meters, costs
    at most ``p + 2 sqrt(p t) + 2 t + 2 ln binom(p, M)``, t = -ln risk, except with probability risk (Hsu,
    Kakade and Zhang 2012, for sub-Gaussian residuals). Trusting k, accusing n others and freeing directions D
    costs at least ``m_k^2 / (S_kk + d_k + sum_D s^2 b_k^2) + 2 ln binom(p, n)`` plus the charges of D. The
    best D is bounded by a fractional knapsack, for every n from which charges are lower. Without k, its
    offset is evidence.

    meter: k.
    liars: M.
    claims (N,): size of each customer's possibly false powers, as in the monitor's dictionary, pu.
    """
    design, (_, p) = given.design, given.limit.shape
    bus = np.array([design.prior.meters[meter]])
    book = design.faults
    std = np.concatenate([claims, book.std[design.customers :]])
    at = book.columns(np.arange(std.size))[bus[0]]
    loose = (std * at) ** 2
    # The charge of a power is lowest while its customer's meter is not trusted, and falls with the number of
    # accused meters: use the next number with a lower charge.
    numbers = [0, *(k for k in range(1, p) if false_power_charge(k) < false_power_charge(k - 1))]
    of_customers = np.arange(std.size) < design.customers
    ways = [
        (np.where(of_customers, np.minimum(book.charge, false_power_charge(k)), book.charge), set_cost(p, k))
        for k in numbers
    ]
    t = -float(np.log(given.risk))
    truth = p + 2.0 * np.sqrt(p * t) + 2.0 * t + set_cost(p, liars) + 2.0 * np.log(design.options.like)
    sizes = []
    for d, sigmas in zip(given.noise[:, meter], design.sigmas, strict=True):
        own = float(design.prior.variance[bus[0]] + d)
        honest = given.deviations * np.sqrt(own) + float(given.model[meter])
        evidence = sigmas * np.sqrt(own) + float(given.model[meter])
        rivals = (_worst(own, loose, each * set_cost(p, 1), truth - others) for each, others in ways)
        sizes.append(max(np.sqrt(max(rivals)), evidence) + honest)
    return float(min(sizes))


def _worst(own: float, gain: Floats, cost: Floats, budget: float) -> float:
    """Maximum of ``(own + G(C)) (budget - C)`` over C >= 0, G the fractional knapsack of gains for costs."""
    order = np.argsort(-gain / cost)
    total, spent, best = own, 0.0, own * budget
    for k in order:
        if spent >= budget or gain[k] <= 0.0:
            break
        slope = gain[k] / cost[k]
        # Along this piece: (total + slope u) (budget - spent - u), a parabola in u.
        u = float(np.clip(0.5 * (budget - spent - total / slope), 0.0, cost[k]))
        best = max(best, (total + slope * u) * (budget - spent - u))
        total, spent = total + gain[k], spent + cost[k]
    return best


# --- All tests of the monitor together ---


def learned_scales(design: SequentialDesign, *, learned: bool, model: Floats) -> Scales:
    """Scales of the monitor with all meters trusted and powers as the design expects them.

    design: the monitor.
    learned: fixed errors are known as well as after `commission_s` without a pause; else by their class.
    model (p,): error of the model, squared pu.
    """
    known, duration_s = class_only(design), design.options.commission_s
    if learned and duration_s > 0.0:
        every = np.ones(model.size, dtype=np.bool_)
        known = learn(design, known, _gathered(design, every, duration_s), every, duration_s).learned
    window = empty(design.lengths, model.size)
    return Scales(design, nominal_uncertainty(design), window, known, model)


def _gathered(design: SequentialDesign, every: Bools, duration_s: float) -> Learning:
    """Sums of a commissioning of residuals zero: variances do not depend on the residuals."""
    count = np.full(every.size, max(1, round(duration_s / design.step_s)))
    return replace(no_readings(every, 0.0), count=count, time_s=np.full(every.size, duration_s))


def acceptance_region(
    scales: Scales, *, misfit: bool = True, busbar: bool = True, levels: Sequence[float] | None = None
) -> AcceptanceRegion:
    """Displacements of all residuals that no test of the monitor rejects, all meters trusted.

    The limit of the misfit is that of ``sqrt(m' Q m)``: with the honest part of m it is at most the sum of
    both roots.

    scales: the scales at one moment.
    misfit, busbar: use the tests of the misfit and of the busbar's meter.
    levels (s,): largest mean of the displacement on each scale, as a part of its largest value; None for a
        constant displacement. A scale of level 0 does not test.
    """
    design, model = scales.design, scales.model
    every = np.ones(model.size, dtype=np.bool_)
    rows, forms = [], []
    for s, level in enumerate([1.0] * len(design.lengths) if levels is None else levels):
        if level <= 0.0:
            continue
        here = scales[s]
        now = condition(here.prior, here.noise, every)
        Q, std = now.Q, np.sqrt(1.0 / now.diagonal())
        rows.append(level * Q * (std**2 / here.limits.limit(std))[:, None])
        if misfit:
            error, tail = np.sqrt(model @ np.abs(Q) @ model), design.tails[s]
            if scored(design):
                tail = 0.5 * tail
                rows.append(
                    level * (score_rows(design, Q) @ Q) / (score_limit(design.customers, tail) + error)
                )
            root = np.sqrt(chi_square_limit(model.size, tail)) + error
            forms.append(level * np.linalg.cholesky(Q).T / root)
        if busbar:
            incidence = design.busbar_incidence
            together = incidence.T @ Q
            form = np.sqrt(np.einsum("bp,pb->b", together, incidence))
            some = form > 0.0
            rows.append(level * together[some] / (design.sigmas[s] * form[some])[:, None])
    last = scales[len(design.lengths) - 1]
    gain = condition(last.prior, last.noise, every)
    return AcceptanceRegion(np.vstack(rows), tuple(forms), last.prior.covariance @ gain.Q)


def honest_covariance(scales: Scales, ticks: int) -> tuple[Floats, Floats]:
    """Covariance of a mean of honest residuals, (p, p), and that of the places' voltages with it, (n, p).

    scales: the scales at one moment.
    ticks: length of the mean, with all readings.
    """
    design, prior = scales.design, scales[len(scales.design.lengths) - 1].prior
    V = prior.between + np.diag(scales.learned.variance + design.white / ticks)
    return V, prior.covariance


ROOM = 0.2
"""Part of every limit for honest residuals: 1.2 standard deviations of a Gaussian one; measured, 0.15."""


@dataclass(frozen=True, slots=True, eq=False)
class Threshold:
    """Size of an attack at which the monitor stops being CLEAN. All sizes squared pu.

    undetected: reached by `lies`; every statistic is at most ``1 - ROOM`` of its limit.
    found: every larger attack by as many meters has a statistic beyond ``1 + ROOM`` of its limit.
    unavoidable: an attack of this size by the meters of `lies` is missed at least every second time by every
        test with the same rate of false alarms.
    """

    undetected: float
    found: float
    unavoidable: float
    lies: Floats  # (p,)


@dataclass(frozen=True, slots=True, eq=False)
class MonitorTests:
    """All tests of the monitor at one moment. n places, p meters."""

    region: AcceptanceRegion
    reach: Floats  # (p,) largest attack on each meter in any collusion, squared pu
    covariance: Floats  # (p, p) V of honest residuals over the longest scale
    prior: Floats  # (n, p) covariance of the places' voltages with the residuals
    z: float  # standard deviations of one test of the longest scale, with the monitor's rate of false alarms

    @staticmethod
    def of(scales: Scales) -> MonitorTests:
        """Tests of a moment, with all meters trusted."""
        design = scales.design
        region = acceptance_region(scales)
        p, last = scales.model.size, design.lengths[-1]
        covariance, prior = honest_covariance(scales, last)
        # |a| <= |R_s^-1| |R_s a| on each scale, and a' Q a <= 1 bounds a_j by the root of (Q^-1)_jj.
        step = len(region.rows) // len(design.lengths)
        blocks = [region.rows[k * step : k * step + p] for k in range(len(design.lengths))]
        linear = [np.abs(np.linalg.inv(block)).sum(axis=1) for block in blocks]
        norms = [np.linalg.norm(np.linalg.inv(form), axis=1) for form in region.forms]
        z = deviations(design.options.alarms_per_year, last * design.step_s)
        return MonitorTests(region, np.min([*linear, *norms], axis=0), covariance, prior, z)

    def corridor(self, liars: int) -> Corridor:
        """Linear tests for at most M manipulated meters, for `threshold`."""
        return corridor(self.region.rows, liars, reach=self.reach)

    def threshold(self, within_: Corridor, along: Floats, *, must: int | None = None) -> Threshold:
        """Threshold of attacks along a direction.

        within_: of `corridor`.
        along (p,): a unit vector for the attack on one meter, or the weights of a reconstruction.
        must: a meter that is manipulated in any case.
        """
        linear = furthest(within_, along, must=must)
        meters = np.flatnonzero(linear.lies)
        if not meters.size:
            return Threshold(0.0, (1.0 + ROOM) * linear.bound, 0.0, np.zeros(along.size))
        faults = Faults.voltages(meters, self.prior.shape, np.inf)
        # Finite ranges: no lie is beyond the reach.
        faults = replace(faults, least=-self.reach[meters], most=self.reach[meters])
        hidden = ConeProgram(self.region, faults)(along[meters], 1.0 - ROOM)
        lies = np.zeros(along.size)
        lies[meters] = hidden.amounts
        least = _largest_effect(self.covariance, faults, along[meters], self.z)
        return Threshold(hidden.size, (1.0 + ROOM) * linear.bound, least, lies)


def _largest_effect(covariance: Floats, faults: Faults, along: Floats, z: float) -> float:
    """``z sqrt(g F^-1 g')`` of `gridsec.planning.unavoidable` for one effect g (q,)."""
    F = faults.signature.T @ np.linalg.solve(covariance, faults.signature)
    return z * float(np.sqrt(along @ np.linalg.solve(F, along)))

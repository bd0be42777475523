"""What the sequential monitor cannot see, must see, and must name: its decision rule as inequalities.

Lies a of trusted meters move the leave-one-out residual of meter j by ``(Q a)_j / Q_jj``. Honest residuals
are sub-Gaussian with variance ``1 / Q_jj`` (Gaussian and uniform parts alike), so that at one moment, on s
scales and at p meters together, all are within ``H_j`` with probability at least 1 - risk. Hence

- hidden:  ``|(Q a)_j| <= (limit_j - H_j) Q_jj`` on all scales: nobody is beyond the limit;
- noticed: a lie for which no ``|(Q a)_j| <= (limit_j + H_j) Q_jj`` holds everywhere: somebody is;
- named:   every explanation that believes meter k leaves a misfit of at least ``m_k^2 / (S_kk + d_k)``,
  whatever all other meters say; where that exceeds what the truth costs by 2 ln(like), none is a rival.

The first two are linear in a but for the number of liars: `gridsec.studies.collusion` searches them.

References
----------
D. Hsu, S. Kakade, T. Zhang, "A tail inequality for quadratic forms of subgaussian random vectors", 2012;
docs/theory-studies.md, section 5; docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.sequential.design import SequentialDesign
from gridsec.sequential.dictionary import of_a_liar
from gridsec.sequential.search import Limits, price
from gridsec.studies.collusion import Corridor, Shift, corridor, furthest

__all__ = ["Rule", "Shift", "largest_shift", "named_size", "rule", "within"]


@dataclass(frozen=True, slots=True, eq=False)
class Rule:
    """The monitor's rule before fixed errors are learned, everybody trusted. s scales, p meters, n buses.

    Attributes
    ----------
    design
        The monitor.
    risk
        Probability that honest residuals are beyond `honest` somewhere, at one moment.
    deviations
        What that is in standard deviations of a sub-Gaussian variable: ``sqrt(2 ln(2 s p / risk))``.
    inverse : (s, p, p)
        Q on each scale.
    limit, honest : (s, p)
        Largest offset that is no evidence, and H, squared pu.
    noise : (s, p)
        Variance d of each meter's mean.
    model : (p,)
        What the model may be off, squared pu.
    """

    design: SequentialDesign
    risk: float
    deviations: float
    inverse: Floats
    limit: Floats
    honest: Floats
    noise: Floats
    model: Floats

    def weights(self, bus: int) -> Floats:
        """What each meter's lie moves the reconstruction of a bus by, on each scale, (s, p)."""
        return np.asarray(self.inverse @ self.design.prior.of_meters[bus])

    def spread(self, bus: int) -> float:
        """What honest readings leave open at a bus, with the same probability on any scale, squared pu."""
        prior = self.design.prior
        row = prior.of_meters[bus]
        left = prior.variance[bus] - np.einsum("p,spq,q->s", row, self.inverse, row)
        return self.deviations * float(np.sqrt(np.maximum(left, 0.0).max())) + float(self.model.max())


def rule(design: SequentialDesign, *, risk: float, model: Floats) -> Rule:
    """Write a monitor's rule down.

    Parameters
    ----------
    design
        The monitor, with its own search.
    risk
        As in `Rule`.
    model : (p,)
        As in `Rule`.
    """
    between, prior = design.prior.between, design.prior
    need = [max(1, int(np.ceil(design.options.enough * length))) for length in design.lengths]
    noise = np.array([design.white / n + design.fixed for n in need])
    inverse = np.array([np.linalg.inv(between + np.diag(d)) for d in noise])
    std = 1.0 / np.sqrt(np.einsum("sjj->sj", inverse))
    t = float(np.sqrt(2.0 * np.log(2.0 * std.size / risk)))
    limit = np.array(
        [
            Limits(sigmas, np.zeros_like(model), design.allowed, design.fixed).of(row)
            for sigmas, row in zip(design.sigmas, std, strict=True)
        ]
    )
    # One's own fixed error is in its residual as it is, and within the class.
    rest = np.sqrt(np.maximum(std**2 - design.fixed, 0.0))
    honest = np.minimum(t * std, design.allowed + t * rest)
    assert prior.meters.size == model.size  # noqa: S101  # both are of the meters
    return Rule(design, risk, t, inverse, limit, honest, noise, model)


def within(given: Rule, liars: int, *, seen: bool, honest: Bools | None = None) -> Corridor:
    """What lies of at most M meters must keep to, so that no residual is beyond its bound.

    Parameters
    ----------
    given
        The rule.
    liars
        M.
    seen
        The bound: False for limit - H (certainly within the limit: hidden), True for limit + H + what the
        model may be off on both sides (beyond which somebody is certainly over the limit).
    honest : (p,), optional
        Meters that cannot lie.
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
    """The furthest that lies of at most M meters move something, while no residual is beyond its bound.

    Parameters
    ----------
    given, liars, seen, honest
        As in `within`.
    along : (p,) or (d, p)
        What is moved by each lie; a unit vector for the lie of one meter itself. Of several rows, whichever
        is moved furthest.
    must
        A meter that lies in any case.
    """
    return furthest(within(given, liars, seen=seen, honest=honest), along, must=must)


def named_size(given: Rule, meter: int, liars: int, *, claims: Floats) -> float:
    """From which lie on no explanation that believes a meter is a rival, whatever other liars do, squared pu.

    The truth, with at most M liars, costs at most ``p + 2 sqrt(p t) + 2 t + 2 ln binom(p, M)``, t = -ln risk,
    but for the risk (Hsu, Kakade and Zhang 2012, for sub-Gaussian residuals). Believing k, accusing n others
    and loosening directions D costs at least ``m_k^2 / (S_kk + d_k + sum_D s^2 b_k^2) + 2 ln binom(p, n)``
    and what D is charged then; the best D is bounded by a knapsack whose items may be cut, for every n from
    which on charges are lower. Without k, its offset is evidence.

    Parameters
    ----------
    given
        The rule.
    meter
        k.
    liars
        M.
    claims : (N,)
        Size of each customer's powers that may be false, as in the monitor's dictionary, pu.
    """
    design, (_, p) = given.design, given.limit.shape
    bus = np.array([design.prior.meters[meter]])
    book = design.book
    std = np.concatenate([claims, book.std[design.customers :]])
    at = book.columns(np.arange(std.size))[bus[0]]
    loose = (std * at) ** 2
    # A power is charged least while its customer's meter is not believed, and the less the more are accused:
    # with the next such number of them.
    numbers = [0, *(k for k in range(1, p) if of_a_liar(k) < of_a_liar(k - 1))]
    of_customers = np.arange(std.size) < design.customers
    ways = [
        (np.where(of_customers, np.minimum(book.charge, of_a_liar(k)), book.charge), price(p, k))
        for k in numbers
    ]
    t = -float(np.log(given.risk))
    truth = p + 2.0 * np.sqrt(p * t) + 2.0 * t + price(p, liars) + 2.0 * np.log(design.options.like)
    sizes = []
    for d, sigmas in zip(given.noise[:, meter], design.sigmas, strict=True):
        own = float(design.prior.variance[bus[0]] + d)
        honest = given.deviations * np.sqrt(own) + float(given.model[meter])
        evidence = sigmas * np.sqrt(own) + float(given.model[meter])
        rivals = (_worst(own, loose, each * price(p, 1), truth - others) for each, others in ways)
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

"""Exact observer bank of chong2020, with direct injection or with arbitrary stacked gains.

    x_J' = A x_J + G phi(zeta_J) + B u + L_J e_J,   zeta_J = H x_J + F u + K_J e_J,   e_J = y - C x_J - D u

with the columns of L_J and K_J outside J equal to zero. Direct injection is the special case L = 0 and
K_J = 1 from a meter to the inverters at its customer; `gridsec.estimators.exact_bank.direct` computes it
faster.

If at most M of p > 2M meters are manipulated, one large set S contains none of them, and every large set
contains a small set without manipulated meters. The estimate of the S that agrees best with its small
subsets is therefore close to the true state under any attack (Theorem 2). `step` advances all observers at
once; there is no loop over observers.

Source: chong2020, equations (5) to (8), (11), Theorem 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible, InputInvalid, Problem, no_choice, raise_if_any
from gridsec.estimators.exact_bank import direct as direct_bank
from gridsec.estimators.exact_bank.direct import SlotState
from gridsec.observers.certificates import feeds
from gridsec.observers.gains import CircleOptions
from gridsec.observers.gains import stacked as in_one
from gridsec.observers.lmi.circle_criterion import solve_many
from gridsec.observers.lure import Lure, LureTransition, StepPolicy, transition, unit
from gridsec.secure.subsets import Subsets, subsets

__all__ = [
    "POLICY",
    "Bank",
    "BankState",
    "Gains",
    "StackedState",
    "advance",
    "believe",
    "consistency",
    "design",
    "direct_gains",
    "estimate",
    "init",
    "lmi_gains",
    "select",
    "settle",
    "spread",
    "start",
    "step",
    "subsets",
]


_QUOTIENT = 1e-7
_HALVINGS = 30
# Entries of the Jacobians that are solved together.
_NEWTON_ENTRIES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Stacked observer gains. o observers, n states, m nonlinearities, p meters."""

    L: Floats  # (o, n, p) output injection into the states; zero columns for meters outside an observer's set
    K: Floats  # (o, m, p) output injection into the nonlinearities' arguments; likewise


def direct_gains(lure: Lure, masks: Bools) -> Gains:
    """Direct injection as explicit gains for subsets (o, p): L = 0, K = 1 to the inverters of a meter."""
    same = feeds(lure)
    # One meter drives an inverter, even if there are two.
    first = same & (np.cumsum(same, axis=1) == 1)
    return Gains(
        L=np.zeros((masks.shape[0], lure.A.shape[0], masks.shape[1])),
        K=first[None] * masks[:, None, :].astype(np.float64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class StackedState:
    """State of all observers at one time."""

    x: Floats  # (o, n) estimates
    seen: Bools  # (p,) available meters of the last step
    prepared: LureTransition  # coefficients of the last step's length


def start(lure: Lure, gains: Gains, policy: StepPolicy) -> StackedState:
    """All observers at zero, with all meters available."""
    o, n, p = gains.L.shape
    return StackedState(np.zeros((o, n)), np.ones(p, dtype=np.bool_), transition(lure, 0.0, policy))


@dataclass(frozen=True, slots=True, eq=False)
class _Inputs:
    """Inputs of one step. Unseen meters have zero weight in every observer and a finite reading."""

    zeta: Floats  # (o, m) F u + K (y - D u)
    push: Floats  # (o, n) B u + L (y - D u)
    seen: Floats  # (p,) 1.0 or 0.0


def _inputs(lure: Lure, gains: Gains, y: Floats, u: Floats, seen: Bools) -> _Inputs:
    given = np.where(seen, y - lure.D @ u, 0.0)
    return _Inputs(lure.F @ u + gains.K @ given, lure.B @ u + gains.L @ given, seen.astype(np.float64))


def advance(
    lure: Lure,
    gains: Gains,
    state: StackedState,
    *,
    y: Floats,
    u: Floats,
    seen: Bools,
    h: float,
    policy: StepPolicy,
) -> StackedState:
    """All observers a time h later, under constant inputs.

    y (p,): readings; arbitrary where not seen.
    u (l,): known input.
    """
    inputs = _inputs(lure, gains, y, u, seen)
    prepared = state.prepared if state.prepared.h == h else transition(lure, h, policy)
    state = replace(state, seen=seen.copy(), prepared=prepared)
    if prepared.substeps == 0:
        return settle(lure, gains, state, y=y, u=u, seen=seen, policy=policy)

    def feedback(x: Floats) -> Floats:
        heard = (x @ lure.C.T) * inputs.seen
        zeta = x @ lure.H.T + inputs.zeta - _times(gains.K, heard)
        return np.asarray(lure.phi(zeta) @ lure.G.T + inputs.push - _times(gains.L, heard))

    x = state.x
    for _ in range(prepared.substeps):
        here = feedback(x)
        ahead = _linear(prepared.decay, x) + _linear(prepared.first, here)
        x = ahead + _linear(prepared.second, feedback(ahead) - here)
    return replace(state, x=x)


def settle(
    lure: Lure,
    gains: Gains,
    state: StackedState,
    *,
    y: Floats,
    u: Floats,
    seen: Bools,
    policy: StepPolicy,
) -> StackedState:
    """All observers in their equilibria, by a damped semismooth Newton method.

    Observers that do not converge keep their last iterate.
    """
    inputs = _inputs(lure, gains, y, u, seen)
    x = state.x.copy()
    n = x.shape[1]
    size = max(1, _NEWTON_ENTRIES // max(1, n * n))
    for i in range(0, x.shape[0], size):
        part = slice(i, i + size)
        C = lure.C * inputs.seen[:, None]
        H = lure.H - gains.K[part] @ C
        A = lure.A - gains.L[part] @ C
        x[part] = _newton(
            lure, x[part], A=A, H=H, zeta=inputs.zeta[part], push=inputs.push[part], policy=policy
        )
    return replace(state, x=x, seen=seen.copy())


def _newton(
    lure: Lure, x: Floats, *, A: Floats, H: Floats, zeta: Floats, push: Floats, policy: StepPolicy
) -> Floats:
    """Solve `A x + G phi(H x + zeta) + push = 0` for a batch of observers."""
    # In units of the state: divided by the open loop, as in `lure.equilibrium`.
    scale = np.abs(np.diagonal(lure.A))
    scale = np.where(scale > 0, scale, 1.0)
    tol = policy.tol * unit(lure.phi)

    def residual(now: Floats) -> Floats:
        phi = lure.phi(_times(H, now) + zeta)
        return np.asarray((_times(A, now) + phi @ lure.G.T + push) / scale)

    for _ in range(policy.max_iter):
        rest = residual(x)
        rough = np.abs(rest).max(axis=1, initial=0.0) > tol
        if not rough.any():
            break
        z = _times(H, x) + zeta
        width = _QUOTIENT * np.maximum(1.0, np.abs(z))
        slope = (lure.phi(z + width) - lure.phi(z - width)) / (2.0 * width)
        jacobian = (A + (lure.G * slope[:, None, :]) @ H) / scale[:, None]
        step = -_solve(jacobian, rest)
        length = rough.astype(np.float64)
        norm = np.linalg.norm(rest, axis=1)
        for _ in range(_HALVINGS):
            trial = np.linalg.norm(residual(x + length[:, None] * step), axis=1)
            worse = rough & (trial > (1.0 - 1e-4 * length) * norm)
            if not worse.any():
                break
            length = np.where(worse, 0.5 * length, length)
        x = x + length[:, None] * step
    return x


def _solve(matrices: Floats, rest: Floats) -> Floats:
    """`matrices[o]^-1 rest[o]` for every observer o, by least squares if a matrix is singular."""
    try:
        return np.asarray(np.linalg.solve(matrices, rest[..., None])[..., 0])
    except np.linalg.LinAlgError:
        # An observer with too little information about an integrator may have many equilibria or none.
        return _times(np.asarray(np.linalg.pinv(matrices), dtype=np.float64), rest)


def _times(matrices: Floats, x: Floats) -> Floats:
    """`matrices[o] @ x[o]` for every observer o."""
    return np.asarray((matrices @ x[..., None])[..., 0])


def _linear(matrix: Floats, x: Floats) -> Floats:
    """`matrix @ x`; a vector stands for a diagonal matrix."""
    return np.asarray(x * matrix if matrix.ndim == 1 else x @ matrix.T)


BankState = SlotState | StackedState

MOST_OBSERVERS = 200_000
POLICY = StepPolicy(substep=1.0, settled=1e-6, tol=1e-10, max_iter=60)
"""Time steps of the bank: coarser than those of the simulation, see docs/theory-detection.md."""


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """Both banks of observers for one plant. p meters, at most M manipulated, o observers."""

    lure: Lure  # the plant
    sets: Subsets  # sensor subsets and the pairs that are compared
    masks: Bools  # (o, p) meters used by each observer; the C(p, M) large sets first
    gains: Gains | None  # stacked gains; None for direct injection
    # layout, base: the structured form of direct injection; None otherwise
    layout: direct_bank.SlotLayout | None
    base: direct_bank.AvailabilityIndex | None
    policy: StepPolicy  # accuracy of the time steps


def design(
    lure: Lure,
    max_attacked: int,
    *,
    gains: Literal["direct"] | Gains = "direct",
    reactive: Floats | None = None,
    policy: StepPolicy = POLICY,
    most: int = MOST_OBSERVERS,
) -> Bank:
    """Build both banks.

    max_attacked: M, largest number of simultaneously manipulated meters.
    gains: `direct`, or gains of all observers in the order of `subsets(p, M).masks()`.
    reactive (l, p): change of u per pu of reactive injection at each meter's customer; direct injection only.
        Needed where net reactive power is metered at customers without an inverter.
    most: largest acceptable number of observers.
    Raises NotObservable unless p > 2M; DesignInfeasible if there are more than `most` observers, or an
        observer uses none of its meters: the degenerate gains L = K = 0 satisfy every convergence condition
        here and detect nothing; ValueError if M is negative, or `gains` is another text; `lmi_gains` computes
        gains by matrix inequality; TypeError, ValueError with `direct`, if the plant is not the loop of a
        feeder, from `close_loop`.
    Source: chong2020, Theorem 1 and equation (5).
    """
    p = lure.C.shape[0]
    sets = subsets(p, max_attacked, most=most)
    masks = sets.masks()
    if isinstance(gains, str):
        raise_if_any(no_choice("gains", ("direct",), gains))
        lay = direct_bank.layout(lure, reactive)
        base = direct_bank.make_plan(lay, sets, np.ones(p, dtype=np.bool_))
        return Bank(lure, sets, masks, None, lay, base, policy)
    _check_gains(lure, masks, gains)
    return Bank(lure, sets, masks, gains, None, None, policy)


def lmi_gains(
    lure: Lure, max_attacked: int, options: CircleOptions, *, workers: int = 1, most: int = MOST_OBSERVERS
) -> Gains:
    """Gains of all observers of a bank by the corrected matrix inequality (12), for `design`.

    lure, max_attacked, most: as in `design`.
    workers: processes, as in `gridsec.observers.lmi.solve_many`.
    Raises NotObservable, DesignInfeasible as in `design`, or if an observer cannot be designed.
    Source: chong2020 (12); docs/theory-observers.md.
    """
    masks = subsets(len(lure.C), max_attacked, most=most).masks()
    made = solve_many(lure, [np.flatnonzero(mask).tolist() for mask in masks], options, workers=workers)
    return Gains(*in_one(made, len(lure.C)))


def _check_gains(lure: Lure, masks: Bools, gains: Gains) -> None:
    """Refuse gains of the wrong shape, gains from meters outside the set, and gains without effect."""
    o, p = masks.shape
    n, m = lure.A.shape[0], lure.slope.size
    if gains.L.shape != (o, n, p) or gains.K.shape != (o, m, p):
        raise InputInvalid(
            [
                Problem(
                    "shape",
                    f"gains have shapes {gains.L.shape}, {gains.K.shape}; expected {(o, n, p)}, {(o, m, p)}",
                )
            ]
        )
    if not (np.isfinite(gains.L).all() and np.isfinite(gains.K).all()):
        raise InputInvalid([Problem("not-finite", "gains must be finite")])
    outside = ~masks[:, None, :]
    if (gains.L * outside).any() or (gains.K * outside).any():
        raise InputInvalid([Problem("wrong-design", "an observer has gains from a meter outside its set")])
    deaf = ~(gains.L.any(axis=(1, 2)) | gains.K.any(axis=(1, 2)))
    # A set with meters at no inverter has no injection; zero gains are no degeneracy there.
    reach = (direct_gains(lure, masks).K != 0).any(axis=(1, 2))
    if (deaf & reach).any() and n:
        raise DesignInfeasible(
            "observer bank",
            f"{np.count_nonzero(deaf & reach)} of {o} observers have L = K = 0: they converge because the "
            "plant does, use no meter, agree with each other under any attack, and so detect nothing",
            code="degenerate",
        )


def init(bank: Bank, y: Floats, u: Floats, seen: Bools, *, net: Floats | None = None) -> BankState:
    """All observers at the equilibrium of the first readings.

    y (p,): readings as `z = vbar^2 - v^2`, pu; arbitrary where not seen. A reading that is not finite is not
        seen.
    u (l,): known input w, pu.
    """
    seen = np.asarray(seen & np.isfinite(y))
    if bank.gains is not None:
        state = start(bank.lure, bank.gains, bank.policy)
        return settle(bank.lure, bank.gains, state, y=y, u=u, seen=seen, policy=bank.policy)
    lay, base = _structure(bank)
    first = direct_bank.follow(
        lay, bank.sets, direct_bank.start(lay, bank.sets, base, bank.policy), seen, None
    )
    return direct_bank.settle(lay, first, direct_bank.drive(lay, y, u, seen, net), bank.policy)


def step(  # noqa: PLR0917  # design and state, then the four inputs that every observer's step has
    bank: Bank,
    state: BankState,
    y: Floats,
    u: Floats,
    seen: Bools,
    h: float,
    *,
    net: Floats | None = None,
    adopt: Floats | None = None,
) -> BankState:
    """All observers a time h later, under constant inputs.

    y (p,): readings as `z = vbar^2 - v^2`, pu; arbitrary where not seen. A reading that is not finite is not
        seen.
    u (l,): known input w, pu.
    seen (p,): available meters. No observer trusts an unavailable meter; the observers continue. With 2M or
        fewer available meters the banks rest, and only an observer without meters continues.
    h: length of the step, s, not negative.
    net (p,): metered net reactive injection of each meter's customer minus the load assumed in u, pu; NaN
        where not reported. An observer uses it exactly if it trusts the meter. Direct injection only.
    adopt (n,): initial injections of inverters with a meter that has just returned. Direct injection only.
    """
    # Rounded, so that equal steps share their coefficients.
    h = round(h, 6)
    seen = np.asarray(seen & np.isfinite(y))
    if isinstance(state, StackedState):
        gains = _gains(bank)
        return advance(bank.lure, gains, state, y=y, u=u, seen=seen, h=h, policy=bank.policy)
    lay, _ = _structure(bank)
    state = direct_bank.follow(lay, bank.sets, state, seen, adopt)
    live = seen if state.plan is not None else np.zeros_like(seen)
    return direct_bank.advance(lay, state, direct_bank.drive(lay, y, u, live, net), h, bank.policy)


def _structure(bank: Bank) -> tuple[direct_bank.SlotLayout, direct_bank.AvailabilityIndex]:
    if bank.layout is None or bank.base is None:
        raise InputInvalid([Problem("wrong-design", "this state belongs to a bank with direct injection")])
    return bank.layout, bank.base


def _gains(bank: Bank) -> Gains:
    if bank.gains is None:
        raise InputInvalid([Problem("wrong-design", "this state belongs to a bank with stacked gains")])
    return bank.gains


def decided(bank: Bank, state: BankState) -> bool:
    """True while more than 2M meters are available, which the bank's guarantee needs."""
    return int(np.count_nonzero(state.seen)) > 2 * bank.sets.max_attacked


def consistency(bank: Bank, state: BankState) -> Floats:
    """Disagreement of each large set with its small subsets.

    `pi_S = max over P within S of max_i |x_S,i - x_P,i|`

    Returns (C(p, M),): pi, pu of reactive power. Empty while 2M or fewer meters are available.
    Source: chong2020, equation (6).
    """
    if isinstance(state, SlotState):
        return direct_bank.consistency(_structure(bank)[0], bank.sets, state)
    if not decided(bank, state):
        return np.zeros(0)
    sets = bank.sets
    large, small = state.x[: sets.count_large], state.x[sets.count_large :]
    gaps = np.stack([np.abs(small - large[parent]).max(axis=1, initial=0.0) for parent in sets.parent])
    return np.asarray(gaps.ravel()[sets.pairs].max(axis=1))


def select(
    pi: Floats, *, allowed: Bools | None = None, penalty: Floats | None = None, tie: float = 0.0
) -> int:
    """The large set to trust: smallest pi, ties by smallest penalty, then by number.

    allowed (s,): sets that may be chosen; all by default.
    penalty (s,): criterion for ties. Inside deadbands all observers coincide and every pi is zero.
    tie: sets with a pi up to the smallest pi plus this are ties, pu.
    Returns int: number of the set; -1 if no set is allowed.
    Source: chong2020, equation (7).
    """
    value = pi if allowed is None else np.where(allowed, pi, np.inf)
    if not value.size or not np.isfinite(value).any():
        return -1
    best = int(np.argmin(value))
    if penalty is None:
        return best
    equal = value <= value[best] + tie
    return int(np.argmin(np.where(equal, penalty, np.inf)))


def believe(bank: Bank, state: BankState) -> tuple[Floats, Bools]:
    """Estimate and meters of the large set that agrees best with its small subsets.

    Returns x, trusted (n,), (p,): NaN and no meters while 2M or fewer meters are available.
    Source: chong2020 (7), (8).
    """
    best = select(consistency(bank, state))
    if best < 0:
        n, p = len(bank.lure.A), len(bank.lure.C)
        return np.full(n, np.nan), np.zeros(p, dtype=np.bool_)
    return estimate(bank, state, best), bank.masks[best]


def spread(bank: Bank, state: BankState, index: int) -> Floats:
    """`max over P within S of |x_S,i - x_P,i|` for one large set S, inverter by inverter.

    Returns (n,): deviations, pu; their maximum is `pi_S`.
    """
    if isinstance(state, SlotState):
        return direct_bank.spread(_structure(bank)[0], bank.sets, state, index)
    members = bank.sets.count_large + bank.sets.pairs[index] % bank.sets.count_small
    return np.asarray(np.abs(state.x[members] - state.x[index]).max(axis=0))


def estimate(bank: Bank, state: BankState, index: int) -> Floats:
    """Reactive injections (n,) estimated by one observer.

    index: number of the observer as in `Bank.masks`. -1: with direct injection, the observer that trusts
        every available meter, or no meter while 2M or fewer are available; with other gains, the median of
        all observers.
    """
    if isinstance(state, SlotState):
        return direct_bank.estimate(_structure(bank)[0], bank.sets, state, index)
    return np.asarray(state.x[index] if index >= 0 else np.median(state.x, axis=0))

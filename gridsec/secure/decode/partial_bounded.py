"""Partial Luenberger observers with a decoder for bounded noise: lee2018, Algorithm 4.1.

At every step an estimate is made from the trusted sensors and then tested against all of them. It
is kept while at most q sensors disagree; otherwise a new one is searched for. In both cases the result
has passed the test, so its error is at most `kappa_c v_max(k)` under any attack on q sensors.

The printed algorithm tests the estimate of the step before and returns another one, computed
afterwards, to which the bound does not apply: docs/errata/lee2018-chapter-4.md.

Source: lee2018, section 4.3.1, Theorem 4.3.2; docs/theory-partial-observers.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, frozen
from gridsec.errors import InputInvalid
from gridsec.observers import luenberger
from gridsec.observers.luenberger import LuenbergerDesign, LuenbergerState
from gridsec.secure.decode import search
from gridsec.secure.decode.noise import CorrectionConstants, correct, correction_constants
from gridsec.secure.decode.search import Decoder
from gridsec.secure.decode.stacks import Stack


@dataclass(frozen=True, slots=True, eq=False)
class BoundedDesign:
    """Observers and decoder."""

    observers: LuenbergerDesign  # the partial observers
    decoder: Decoder  # l0 decoder for the stacked estimates, each block divided by its `scale`
    constants: CorrectionConstants  # theta, kappa_c and the others, of the scaled blocks
    scale: Floats  # (p,) unit of each observer's error


@dataclass(frozen=True, slots=True, eq=False)
class BoundedState:
    """State of observers and decoder."""

    observers: LuenbergerState  # the observers' state
    trusted: Bools  # (p,) Lambda: sensors in agreement with the last estimate


@dataclass(frozen=True, slots=True, eq=False)
class BoundedOutcome:
    """Result of one step."""

    t: float  # time of the estimated state, s
    x: Floats  # (n,) estimate
    bound: float  # `kappa_c v_max(k)`: bound of |estimate - state|_2 if at most q sensors are attacked
    # (p,) sensors with observers that the estimate does not explain; all of them are attacked, or the bounds
    # on disturbance and noise do not hold
    disagree: Bools
    searched: bool  # True if the estimate was searched for
    # True if at most q sensors disagree. Otherwise an assumption is violated and the bound is void
    credible: bool
    residuals: Floats  # (p,) |z_hat_i - Z_i^T x_hat|_2
    limits: Floats  # (p,) their limits, theta v_max(k), in the same unit

    @property
    def faults(self) -> int:
        """f, the number of sensors that disagree."""
        return int(np.count_nonzero(self.disagree))


def design(
    observers: LuenbergerDesign,
    max_attacked: int,
    *,
    tol: float,
    left_out: int | None = None,
    scale: Floats | None = None,
) -> BoundedDesign:
    """Prepare Algorithm 4.1.

    tol: tolerance of the test that the state is determined without any 2q sensors.
    left_out: r, between q and 2q; the cheapest by default.
    scale (p,): positive; errors of observer i are measured in `scale[i]`, which gives accurate sensors more
        weight. One for all by default, as in the paper; the limits of the envelopes suit sensors of different
        accuracy.
    Raises NotObservable unless the pair is 2q-redundant detectable (lee2018, Proposition 4.3.1) by the parts
        of the observers. ValueError if `scale` is not one positive number for each sensor, or r is not from q
        to 2 q.
    """
    blocks = observers.stack.blocks
    size = np.ones(len(blocks)) if scale is None else np.asarray(scale, dtype=np.float64)
    if size.shape != (len(blocks),) or not np.all(np.isfinite(size) & (size > 0.0)):
        raise InputInvalid.of("not-positive", "scale must have one positive number for each sensor")
    stacked = Stack.of([block / s for block, s in zip(blocks, size, strict=True)])
    decoder = search.design(stacked, max_attacked, tol=tol, left_out=left_out)
    constants = correction_constants(stacked, max_attacked, tol=tol, left_out=decoder.left_out)
    return BoundedDesign(observers, decoder, constants, frozen(size))


def init(design: BoundedDesign, t: float, x: Floats, error: float) -> tuple[BoundedState, BoundedOutcome]:
    """Initial state from a guess of the state, with all sensors trusted.

    t: time, s.
    x (n,): guess.
    error: bound of |guess - state|_2.
    """
    observers = luenberger.init(design.observers, t, x, error)
    return decode(design, BoundedState(observers, np.ones(design.scale.size, dtype=np.bool_)))


def step(
    design: BoundedDesign, state: BoundedState, y: Floats, u: Floats, seen: Bools | None = None
) -> tuple[BoundedState, BoundedOutcome]:
    """Step from the readings y(k) and the input u(k) to the estimate of x(k+1), as `luenberger.step`."""
    return decode(
        design, replace(state, observers=luenberger.step(design.observers, state.observers, y, u, seen))
    )


def decode(design: BoundedDesign, state: BoundedState) -> tuple[BoundedState, BoundedOutcome]:
    """Estimate from the present state of the observers.

        x_hat = Phi_Lambda^+ z_hat_Lambda;  f = |{i : |z_hat_i - Z_i^T x_hat| > theta v_max(k)}|
        f <= q: keep x_hat.   f > q: x_hat = argmin f over F_(p,r)(z_hat).

    Source: lee2018, Algorithm 4.1 with the estimate made before the test; Theorems 2.2.11, 2.2.12 and 4.3.2.
    """
    stacked = design.decoder.stack
    z = state.observers.z / (stacked.membership @ design.scale)
    v_max = float(np.max(luenberger.bound(design.observers, state.observers) / design.scale))
    limit = design.constants.theta * v_max
    x = _fit(stacked, z, state.trusted)
    sizes = stacked.norms(z - stacked.matrix @ x)
    # Negated comparison: a residual of NaN disagrees.
    disagree = ~(sizes <= limit)
    searched = np.count_nonzero(disagree) > design.decoder.max_attacked
    credible = True
    if searched:
        found = correct(design.decoder, design.constants, z, v_max=v_max)
        x, disagree, sizes, credible = found.x, found.in_error, found.residuals, bool(found.credible)
    # Without enough agreement no subset is trusted: restart with all sensors.
    trusted = ~disagree if credible else np.ones_like(disagree)
    outcome = BoundedOutcome(
        state.observers.t,
        x,
        design.constants.kappa_c * v_max,
        disagree,
        bool(searched),
        credible,
        sizes * design.scale,
        limit * design.scale,
    )
    return replace(state, trusted=trusted), outcome


def _fit(stacked: Stack, z: Floats, trusted: Bools) -> Floats:
    """Least squares on the trusted blocks; at least p - q of them, hence of full column rank."""
    weight = stacked.membership @ trusted
    return np.asarray(np.linalg.lstsq(stacked.matrix * weight[:, None], z * weight, rcond=None)[0])

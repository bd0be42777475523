"""Windows of consistency, yang2019, on a feeder that is read at regular times.

The bank of discrete-time observers with direct injection estimates the inverters' injections once with all
meters, once without every q of them, once without every 2 q. A window of N readings without a contradiction
is CLEAN; Algorithm 2 names the meters without which the estimates agree. Everything around it (cleaning,
reconstruction, residuals beside their limits) is that of `gridsec.sequential`; who is named is decided by
the windows alone.

The thresholds are worst cases over all meters at once: fixed errors inside the accuracy class count as
noise that never averages out. And a lie inside the dead band of a droop curve moves no injection, so that no
window can see it.

References
----------
yang2019, Algorithms 1 and 2; docs/theory-discrete.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec import sequential, windows
from gridsec.arrays import Bools, spectral_radius
from gridsec.errors import DesignInfeasible
from gridsec.lmi.discrete import discrete_contraction
from gridsec.lmi.sampled import drift_error, sample
from gridsec.lure import known_input
from gridsec.online import Cause, Decision, Estimate, Frame, Verdict
from gridsec.plant import Plant
from gridsec.sequential import LoadDoubt, SequentialDesign, SequentialOptions, SequentialState
from gridsec.sequential.decoder import Accused, Evidence
from gridsec.windows import WindowDesign, WindowState, WindowVerdict

LENGTH = 50
"""Readings in a window: the shortest of the paper's, since an alarm waits for a window's end."""

PARTS = (0.95, 0.8, 0.6, 0.4)
"""Candidates for the decay that is proven, as powers of the slowest inverter's own."""

SIGMAS = 4.0
"""Standard deviations of jitter and of what is not known of the loads inside the thresholds."""

IRREGULAR = 0.05
"""Readings further from their regular time than this part of the interval begin a new window."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowedDesign:
    """Everything that is prepared offline.

    Attributes
    ----------
    chain
        What frames are cleaned and voltages are reconstructed with.
    windows
        The bank and its thresholds.
    step_s
        Interval between frames, s.
    """

    chain: SequentialDesign
    windows: WindowDesign
    step_s: float

    @property
    def observers(self) -> int:
        """How many observers run."""
        return len(self.windows.observers.masks)


@dataclass(frozen=True, slots=True, eq=False)
class WindowedState:
    """What is carried from frame to frame.

    Attributes
    ----------
    chain
        Of the chain.
    windows
        Of the bank; None before the first frame.
    verdict
        Of the last full window.
    """

    chain: SequentialState
    windows: WindowState | None
    verdict: WindowVerdict | None


def design(
    plant: Plant, *, doubt: LoadDoubt, step_s: float, max_attacked: int, length: int = LENGTH
) -> WindowedDesign:
    """Prepare to watch a feeder.

    Parameters
    ----------
    plant
        What is watched.
    doubt
        How wrong the powers of the frames may be.
    step_s
        Interval between frames, s.
    max_attacked
        q, at least 1.
    length
        N, readings in a window.

    Raises
    ------
    NotObservable
        Unless there are more than 2 q meters.
    DesignInfeasible
        If there are no droop inverters, no contraction is proven, or the bank would be too large.
    """
    if not plant.droop.tau.size:
        raise DesignInfeasible(
            "windows of consistency", "no droop inverter whose injection could be estimated"
        )
    if max_attacked < 1:
        raise DesignInfeasible(
            "windows of consistency", "without a possible liar there is nothing to isolate"
        )
    options = SequentialOptions(scales_s=(0.0,), commission_s=0.0)
    chain = sequential.design(plant, doubt=doubt, step_s=step_s, options=options, max_attacked=max_attacked)
    sampled = sample(chain.lure, step_s)
    slowest = spectral_radius(sampled.A)
    proof = discrete_contraction(sampled, decays=tuple(slowest**part for part in PARTS))
    own = plant.feeder.bus[plant.droop.customer]
    unknown = SIGMAS * np.sqrt(chain.prior.variance[own])
    start = float(np.linalg.norm(plant.droop.limit))
    made = windows.design(
        windows.bank(sampled, max_attacked, proof=proof),
        max_attacked,
        noise=float(np.linalg.norm(chain.allowed + SIGMAS * np.sqrt(chain.white))),
        length=length,
        start=2.0 * start,
        epsilon=1e-3 * start,
        unknown=float(np.linalg.norm(unknown + drift_error(chain.lure, step_s, unknown))),
        rule="survivors",
    )
    return WindowedDesign(chain, made, step_s)


def init(design: WindowedDesign, t: float) -> WindowedState:
    """Begin to watch; the observers start with the first frame.

    Parameters
    ----------
    design
        From `design`.
    t
        Unix time, s.
    """
    return WindowedState(sequential.init(design.chain, t), None, None)


def step(
    design: WindowedDesign, state: WindowedState, frame: Frame
) -> tuple[WindowedState, Estimate, Verdict]:
    """Take one frame in.

    Parameters
    ----------
    design, state
        From `design`, and from `init` or the last step.
    frame
        Everything known at one tick.

    Returns
    -------
    WindowedState, Estimate, Verdict
        As every estimator's step. What a window says holds until the next one is full.
    """
    before = state.chain
    bank, said = state.windows, state.verdict
    suspects = np.zeros(frame.y.size, dtype=np.bool_) if said is None else said.suspects

    def known(evidence: Evidence) -> tuple[Accused, ...]:
        return (Accused(suspects & evidence.live),)

    chain, estimate, verdict = sequential.step(replace(design.chain, decoder=known), before, frame)
    if chain is before:
        return state, estimate, verdict
    plant = design.chain.plant
    off = abs(frame.t - before.t - design.step_s) > IRREGULAR * design.step_s
    if bank is None or off:
        x = np.zeros(plant.droop.tau.size) if before.x is None else before.x
        bank = windows.init(design.windows, frame.t, x)
    v0 = chain.v0_squared
    u = known_input(
        design.chain.model, plant.droop.vbar, frame.p, frame.q, v0, _losses(design, frame, estimate)
    )
    seen = frame.seen & np.isfinite(frame.y) & bool(np.isfinite(frame.v0_squared))
    z = plant.droop.vbar**2 - np.where(seen, frame.y, 0.0)
    bank, window = windows.step(design.windows, bank, z, u, seen)
    said = said if window is None else window
    after = WindowedState(chain, bank, said)
    return after, estimate, _verdict(design, frame, verdict, said, seen, estimate)


def _losses(design: WindowedDesign, frame: Frame, estimate: Estimate) -> np.ndarray:
    """What the chain's loss correction adds to the linear model at every customer, squared pu."""
    plant, model = design.chain.plant, design.chain.model
    q = frame.q + np.bincount(plant.droop.customer, weights=estimate.x, minlength=frame.q.size)
    v0 = estimate.v2_bus[0] if not np.isfinite(frame.v0_squared) else frame.v0_squared
    linear = v0 + 2.0 * (model.R @ frame.p + model.X @ q)
    return np.asarray(np.clip(estimate.v2 - linear, -1.0, 1.0))


def _verdict(  # noqa: PLR0917  # what the answer is put together from
    design: WindowedDesign,
    frame: Frame,
    verdict: Verdict,
    said: WindowVerdict | None,
    seen: Bools,
    estimate: Estimate,
) -> Verdict:
    """The windows' answer, with the chain's residuals beside it."""
    chain = design.chain
    suspects = np.zeros_like(seen) if said is None else said.suspects
    y = np.where(seen, frame.y, 0.0)
    attack = np.where(suspects & seen, y - estimate.v2[chain.plant.meters], 0.0)
    names = ", ".join(name for name, bad in zip(chain.names, suspects, strict=True) if bad)
    over = seen & (np.nan_to_num(verdict.score) > verdict.threshold)
    answer: tuple[Decision, Cause, str]
    if said is None:
        answer = Decision.UNDECIDED, Cause.SETTLING, "The first window of readings is not full yet."
    elif suspects.any():
        answer = (
            Decision.ATTACKED,
            Cause.RESIDUALS,
            f"Manipulated: {names}; the other meters agree over a window.",
        )
    elif not seen.all():
        answer = Decision.UNDECIDED, Cause.SILENT_METERS, "Windows with missing readings are not judged."
    elif over.any():
        off = ", ".join(name for name, bad in zip(chain.names, over, strict=True) if bad)
        reason = f"{off}: further off than allowed, but no window contradicts itself."
        answer = Decision.UNDECIDED, Cause.AMBIGUOUS, reason
    elif said.isolation is Decision.UNDECIDED or said.detection is not Decision.CLEAN:
        answer = (
            Decision.UNDECIDED,
            Cause.AMBIGUOUS,
            "The readings of a window contradict each other, and no set of meters explains it alone.",
        )
    else:
        answer = Decision.CLEAN, Cause.AGREEMENT, "All meters agree over a window of readings."
    return replace(
        verdict,
        decision=answer[0],
        cause=answer[1],
        reason=answer[2],
        suspects=suspects,
        attack=attack,
        explanations=(),
    )

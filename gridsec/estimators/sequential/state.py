"""State of the sequential monitor between frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.sequential.attack_kind import AttackKinds
from gridsec.estimators.sequential.attack_kind import empty as no_kinds
from gridsec.estimators.sequential.busbar_meter import BusbarTrust
from gridsec.estimators.sequential.busbar_meter import trusted_busbar as believed_busbar
from gridsec.estimators.sequential.clock_offsets import BusbarHistory, ClockSkew
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.error_bounds import InjectionError
from gridsec.estimators.sequential.error_bounds import unknown_injections as no_lag
from gridsec.estimators.sequential.frame_uncertainty import FrameUncertainty
from gridsec.estimators.sequential.frame_uncertainty import nominal as no_doubts
from gridsec.estimators.sequential.inverter_check import InverterChecks
from gridsec.estimators.sequential.inverter_check import no_checks as no_curves
from gridsec.estimators.sequential.meter_bias import Commission, Learned, Learning, initial
from gridsec.estimators.sequential.meter_bias import renew as learn_anew
from gridsec.estimators.sequential.posterior import Posterior
from gridsec.estimators.sequential.replay import forget as forget_calm
from gridsec.estimators.sequential.suspect_powers import DoubtedPowers, VouchedPosterior
from gridsec.estimators.sequential.time_scales import Window, empty, forget
from gridsec.estimators.sequential.trust import TrustState
from gridsec.interface import Estimate, Frame, Verdict
from gridsec.observers.lure import Lure, LureTransition


@dataclass(frozen=True, slots=True, eq=False)
class ModelDriven:
    """Prepared loop of the model-driven inverters, reused for the same inverters and step."""

    rows: Ints  # (k,) inverters
    loop: Lure  # their mutual loop; its input is the effect of all other injections and loads
    transition: LureTransition  # of the loop, for the last step's length


@dataclass(frozen=True, slots=True, eq=False)
class SequentialState:
    """State between frames. N customers, m inverters, p meters, s scales."""

    t: float  # time of the last frame used, s
    frame: Frame | None  # last frame used; None before the first
    since: float  # time of the first frame used, s
    ticks: int  # frames used
    x: Floats | None  # (m,) injections, pu; None before the first frame
    model_driven: ModelDriven | None  # prepared loop of the inverters without a trusted meter
    injection_error: InjectionError  # errors of the injections
    v0_squared: Floats | float  # last trusted squared busbar voltage, pu; (3,) in three phases
    busbar: BusbarTrust  # trust of the busbar's meter
    window: Window  # residuals of the last ticks
    trust: TrustState  # trust of the meters
    posteriors: tuple[Posterior | None, ...]  # (s,) of the trusted meters; None without a test
    full_posteriors: tuple[Posterior | None, ...]  # (s,) kept, of all meters that reported
    vouched_posteriors: tuple[VouchedPosterior | None, ...]  # (s,) without meters that withhold a power
    inconsistent: tuple[bool, ...]  # (s,) trusted meters inconsistent at the last look, after the search
    doubted_powers: (
        DoubtedPowers | None
    )  # posterior with doubted powers of the suspects; None without suspects
    uncertainty: FrameUncertainty  # uncertainty of the frames
    clock_skew: ClockSkew | None  # voltage changes within clock offsets; None while no offset is measured
    busbar_history: (
        BusbarHistory | None
    )  # readings for the busbar's clock offset; None while it is not measured
    learning: Learning | None  # sums of the commissioning; None once complete
    learned: Learned  # fixed errors of the meters
    model_error: Floats  # (p,) largest error of the model, squared pu
    voltage_swing: float  # largest change of a squared voltage by powers when `model_error` was computed, pu
    inverter_checks: InverterChecks  # comparison of metered reactive powers with the droop curves
    attack_kinds: AttackKinds  # reading history and kinds of the manipulations
    last: tuple[Estimate, Verdict] | None  # last output

    @property
    def commission(self) -> Commission:
        """Fixed errors of the meters, known and being learned."""
        return Commission(self.learned, self.learning)


def init(
    design: SequentialDesign, t: float, learned: Learned | None = None, learning: Learning | None = None
) -> SequentialState:
    """Initial state at Unix time t, s, with errors learned before; the observer starts at the first frame."""
    known = initial(design, t) if learned is None else Commission(learned, learning)
    p, s = design.plant.meters.size, len(design.lengths)
    m = design.plant.droop.tau.size
    return SequentialState(
        t=t,
        frame=None,
        since=t,
        ticks=0,
        x=None,
        model_driven=None,
        injection_error=no_lag(design.plant, np.zeros(m)),
        v0_squared=design.plant.droop.vbar**2,
        busbar=believed_busbar(design.busbar_incidence.shape[1]),
        window=empty(design.lengths, p),
        trust=TrustState.initial(p, m, s),
        posteriors=(None,) * s,
        full_posteriors=(None,) * s,
        vouched_posteriors=(None,) * s,
        inconsistent=(False,) * s,
        doubted_powers=None,
        uncertainty=no_doubts(design),
        clock_skew=None,
        busbar_history=None,
        learning=known.learning,
        learned=known.learned,
        model_error=np.zeros(p),
        voltage_swing=0.0,
        inverter_checks=no_curves(p, m),
        attack_kinds=no_kinds(p),
        last=None,
    )


def renew(design: SequentialDesign, state: SequentialState, which: Bools) -> SequentialState:
    """State after meters `which` (p,) were replaced: trusted again, with their errors to be learned."""
    known = learn_anew(design, state.commission, which, state.t)
    return replace(
        state,
        learned=known.learned,
        learning=known.learning,
        window=forget(state.window, which),
        posteriors=(None,) * len(state.posteriors),
        inverter_checks=state.inverter_checks.without_meters(which),
        attack_kinds=replace(state.attack_kinds, history=forget_calm(state.attack_kinds.history, which)),
        trust=state.trust.replaced(which),
    )

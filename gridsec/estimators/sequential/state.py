"""State of the sequential monitor between frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.sequential.apart import VouchedPosterior
from gridsec.estimators.sequential.bounds import InjectionError
from gridsec.estimators.sequential.bounds import unknown_injections as no_lag
from gridsec.estimators.sequential.busbar import BusbarTrust
from gridsec.estimators.sequential.busbar import trusted_busbar as believed_busbar
from gridsec.estimators.sequential.commission import Commission, Learned, Learning, initial
from gridsec.estimators.sequential.commission import renew as learn_anew
from gridsec.estimators.sequential.conditional import Posterior
from gridsec.estimators.sequential.curves import InverterChecks
from gridsec.estimators.sequential.curves import no_checks as no_curves
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.doubts import FrameUncertainty
from gridsec.estimators.sequential.doubts import nominal as no_doubts
from gridsec.estimators.sequential.drive import ModelDriven
from gridsec.estimators.sequential.kinds import AttackKinds
from gridsec.estimators.sequential.kinds import empty as no_kinds
from gridsec.estimators.sequential.moment import BusbarHistory
from gridsec.estimators.sequential.release import DoubtedPowers
from gridsec.estimators.sequential.repeats import forget as forget_calm
from gridsec.estimators.sequential.skew import ClockSkew
from gridsec.estimators.sequential.windows import Window, empty, forget
from gridsec.interface import Estimate, Frame, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class TrustState:
    """Trust of meters and inverters. p meters, m inverters, s scales."""

    trusted: Bools  # (p,) meters used by the estimate
    scale: Ints  # (p,) scale of the detection of each suspect
    ticks_suspect: Ints  # (p,) ticks as a suspect; reset after the longest scale without evidence
    ticks_clear: Ints  # (p,) readings without evidence
    above_limit: Bools  # (s, p) residual above the limit at the last look
    above_release_limit: Bools  # (s, p) residual above the release limit at the last look
    readings_owed: Ints  # (p,) readings a suspect of an earlier run owes before its scale can release it
    repeat_lag: Ints  # (p,) ticks after which a suspect repeats its readings, 1 if stuck, 0 if none
    named: Bools  # (p,) meters named as manipulated
    accused: tuple[tuple[int, int], ...]  # other suspicions: index of the fault dictionary, scale
    inverter_ticks: Ints  # (m,) ticks that accuse each inverter, less those that do not
    inverters: Bools  # (m,) inverters named as manipulated
    clear: bool = field(init=False)  # derived: no suspicion, now or within the longest scale

    def __post_init__(self) -> None:
        # Later in-place writes concern meters that are not trusted: the state is not calm then either.
        against = (
            any_of(self.above_limit)
            or any_of(self.above_release_limit)
            or any_of(self.named)
            or any_of(self.inverters)
        )
        lately = bool(self.accused) or any_of(self.ticks_suspect) or any_of(self.inverter_ticks)
        calm = all_of(self.trusted) and not against and not lately
        object.__setattr__(self, "calm", calm)


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
    zeros = np.zeros(p, dtype=np.intp)
    no = np.zeros(p, dtype=np.bool_)
    none = np.zeros((s, p), dtype=np.bool_)
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
        trust=TrustState(
            ~no,
            zeros,
            zeros,
            zeros,
            none,
            none,
            zeros,
            zeros,
            no,
            (),
            np.zeros(m, dtype=np.intp),
            np.zeros(m, dtype=np.bool_),
        ),
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
    known, trust = learn_anew(design, state.commission, which, state.t), state.trust
    return replace(
        state,
        learned=known.learned,
        learning=known.learning,
        window=forget(state.window, which),
        posteriors=(None,) * len(state.posteriors),
        inverter_checks=state.inverter_checks.without_meters(which),
        attack_kinds=replace(state.attack_kinds, history=forget_calm(state.attack_kinds.history, which)),
        trust=replace(
            trust,
            trusted=trust.trusted | which,
            ticks_suspect=np.where(which, 0, trust.ticks_suspect),
            ticks_clear=np.where(which, 0, trust.ticks_clear),
            above_limit=trust.above_limit & ~which,
            above_release_limit=trust.above_release_limit & ~which,
            readings_owed=np.where(which, 0, trust.readings_owed),
            repeat_lag=np.where(which, 0, trust.repeat_lag),
            named=trust.named & ~which,
        ),
    )

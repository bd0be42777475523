"""State of the sequential monitor between frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.sequential.apart import Apart
from gridsec.estimators.sequential.bounds import Lag
from gridsec.estimators.sequential.bounds import start as no_lag
from gridsec.estimators.sequential.busbar import Busbar
from gridsec.estimators.sequential.busbar import believed as believed_busbar
from gridsec.estimators.sequential.commission import Commission, Learned, Learning, fresh
from gridsec.estimators.sequential.commission import renew as learn_anew
from gridsec.estimators.sequential.conditional import Fit
from gridsec.estimators.sequential.curves import Curves
from gridsec.estimators.sequential.curves import empty as no_curves
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.doubts import Doubts
from gridsec.estimators.sequential.doubts import none as no_doubts
from gridsec.estimators.sequential.drive import Free
from gridsec.estimators.sequential.kinds import Kinds
from gridsec.estimators.sequential.kinds import empty as no_kinds
from gridsec.estimators.sequential.moment import Moment
from gridsec.estimators.sequential.release import Released
from gridsec.estimators.sequential.repeats import forget as forget_calm
from gridsec.estimators.sequential.skew import Skew
from gridsec.estimators.sequential.windows import Window, empty, forget
from gridsec.interface import Estimate, Frame, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """Trust of meters and inverters. p meters, m inverters, s scales."""

    trusted: Bools  # (p,) meters used by the estimate
    scale: Ints  # (p,) scale of the detection of each suspect
    age: Ints  # (p,) ticks as a suspect; reset after the longest scale without evidence
    quiet: Ints  # (p,) readings without evidence
    bad: Bools  # (s, p) residual above the limit at the last look
    still: Bools  # (s, p) residual above the release limit at the last look
    owed: Ints  # (p,) readings a suspect of an earlier run owes before its scale can release it
    lag: Ints  # (p,) ticks after which a suspect repeats its readings, 1 if stuck, 0 if none
    named: Bools  # (p,) meters named as manipulated
    accused: tuple[tuple[int, int], ...]  # other suspicions: index of the fault dictionary, scale
    counted: Ints  # (m,) ticks that accuse each inverter, less those that do not
    inverters: Bools  # (m,) inverters named as manipulated
    calm: bool = field(init=False)  # derived: no suspicion, now or within the longest scale

    def __post_init__(self) -> None:
        # Later in-place writes concern meters that are not trusted: the state is not calm then either.
        against = any_of(self.bad) or any_of(self.still) or any_of(self.named) or any_of(self.inverters)
        lately = bool(self.accused) or any_of(self.age) or any_of(self.counted)
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
    free: Free | None  # prepared loop of the inverters without a trusted meter
    lag: Lag  # errors of the injections
    v0_squared: Floats | float  # last trusted squared busbar voltage, pu; (3,) in three phases
    busbar: Busbar  # trust of the busbar's meter
    window: Window  # residuals of the last ticks
    trust: Trust  # trust of the meters
    fits: tuple[Fit | None, ...]  # (s,) of the trusted meters; None without a test
    wholes: tuple[Fit | None, ...]  # (s,) kept, of all meters that reported
    apart: tuple[Apart | None, ...]  # (s,) without meters that withhold a power
    misfit: tuple[bool, ...]  # (s,) trusted meters inconsistent at the last look, after the search
    released: Released | None  # posterior with doubted powers of the suspects; None without suspects
    doubts: Doubts  # uncertainty of the frames
    skew: Skew | None  # voltage changes within clock offsets; None while no offset is measured
    moment: Moment | None  # readings for the busbar's clock offset; None while it is not measured
    learning: Learning | None  # sums of the commissioning; None once complete
    learned: Learned  # fixed errors of the meters
    model_error: Floats  # (p,) largest error of the model, squared pu
    swing: float  # largest change of a squared voltage by powers when `model_error` was computed, pu
    curves: Curves  # comparison of metered reactive powers with the droop curves
    kinds: Kinds  # reading history and kinds of the manipulations
    last: tuple[Estimate, Verdict] | None  # last output

    @property
    def commission(self) -> Commission:
        """Fixed errors of the meters, known and being learned."""
        return Commission(self.learned, self.learning)


def init(
    design: SequentialDesign, t: float, learned: Learned | None = None, learning: Learning | None = None
) -> SequentialState:
    """Initial state at Unix time t, s, with errors learned before; the observer starts at the first frame."""
    known = fresh(design, t) if learned is None else Commission(learned, learning)
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
        free=None,
        lag=no_lag(design.plant, np.zeros(m)),
        v0_squared=design.plant.droop.vbar**2,
        busbar=believed_busbar(design.hangs_on.shape[1]),
        window=empty(design.lengths, p),
        trust=Trust(
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
        fits=(None,) * s,
        wholes=(None,) * s,
        apart=(None,) * s,
        misfit=(False,) * s,
        released=None,
        doubts=no_doubts(design),
        skew=None,
        moment=None,
        learning=known.learning,
        learned=known.learned,
        model_error=np.zeros(p),
        swing=0.0,
        curves=no_curves(p, m),
        kinds=no_kinds(p),
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
        fits=(None,) * len(state.fits),
        curves=state.curves.renewed(which),
        kinds=replace(state.kinds, memory=forget_calm(state.kinds.memory, which)),
        trust=replace(
            trust,
            trusted=trust.trusted | which,
            age=np.where(which, 0, trust.age),
            quiet=np.where(which, 0, trust.quiet),
            bad=trust.bad & ~which,
            still=trust.still & ~which,
            owed=np.where(which, 0, trust.owed),
            lag=np.where(which, 0, trust.lag),
            named=trust.named & ~which,
        ),
    )

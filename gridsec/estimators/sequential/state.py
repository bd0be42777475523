"""What the sequential monitor carries from frame to frame."""

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
    """Who is believed, and since when not. p meters, s scales.

    Attributes
    ----------
    trusted : (p,)
        Meters that the estimate rests on.
    scale : (p,)
        Scale on which each distrusted meter was caught.
    age : (p,)
        Ticks under suspicion; forgotten after the longest scale without evidence.
    quiet : (p,)
        Readings without evidence against a meter.
    bad : (s, p)
        Evidence at the last look on each scale.
    still : (s, p)
        Evidence enough to go on distrusting a meter.
    owed : (p,)
        Readings that a meter distrusted from before still has to give until its scale can speak for it.
    lag : (p,)
        Ticks after which a distrusted meter repeats its readings, 1 for a stuck one; 0 for all others.
    named : (p,)
        Meters named as manipulated.
    accused : tuple of (k, s)
        What else is suspected, indices of `design.book`, each with the scale that found it.
    counted : (m,)
        Ticks that accused each inverter, less those that did not.
    inverters : (m,)
        Inverters named as manipulated.
    calm
        Derived. Nobody is suspected, nor was lately.
    """

    trusted: Bools
    scale: Ints
    age: Ints
    quiet: Ints
    bad: Bools
    still: Bools
    owed: Ints
    lag: Ints
    named: Bools
    accused: tuple[tuple[int, int], ...]
    counted: Ints
    inverters: Bools
    calm: bool = field(init=False)

    def __post_init__(self) -> None:
        # Evidence is written in place afterwards, but only against those who are not trusted.
        against = any_of(self.bad) or any_of(self.still) or any_of(self.named) or any_of(self.inverters)
        lately = bool(self.accused) or any_of(self.age) or any_of(self.counted)
        calm = all_of(self.trusted) and not against and not lately
        object.__setattr__(self, "calm", calm)


@dataclass(frozen=True, slots=True, eq=False)
class SequentialState:
    """What is carried from frame to frame. N customers, m inverters, p meters, s scales.

    Attributes
    ----------
    t, since
        Time of the last frame used, and of the first one, s.
    frame
        The last one used; None before the first.
    ticks
        Frames used.
    x : (m,) or None
        Injections, pu; None before the first frame.
    free
        What was prepared for inverters without a trusted meter; None while there were none.
    lag
        How far the injections may be from the true ones.
    v0_squared
        Last squared busbar voltage that was believed, pu; in three phases (3,).
    busbar
        What is thought of its meter.
    window
        The last residuals.
    trust
        Who is believed.
    fits : (s,)
        What the trusted meters say on each scale; None where no meter can be judged yet.
    wholes : (s,)
        Fits of all that reported, or of more, from when they were trusted; None where none is kept.
    apart : (s,)
        Fits without the meters that withhold their customer's power; None where there is no such meter.
    misfit : (s,)
        Scales whose trusted meters were inconsistent at the last look, after the search.
    released
        What they say where the powers of the others are not believed; None where all are.
    doubts
        What the frames do not know.
    skew
        Changes of the voltages within clock offsets; None while no offset is measured.
    moment
        Last readings of all meters; None while the clock offset of the busbar's is not measured.
    learning
        What was gathered of the meters' fixed errors; None once they are known.
    learned
        What is known of them.
    model_error : (p,)
        What the model may be off at each meter, squared pu.
    swing
        By how much powers changed a squared voltage at most when that was bounded, pu.
    curves
        What metered reactive powers say of the inverters.
    kinds
        The past, and what the named meters' manipulations look like.
    last
        The last answer.
    """

    t: float
    frame: Frame | None
    since: float
    ticks: int
    x: Floats | None
    free: Free | None
    lag: Lag
    v0_squared: Floats | float
    busbar: Busbar
    window: Window
    trust: Trust
    fits: tuple[Fit | None, ...]
    wholes: tuple[Fit | None, ...]
    apart: tuple[Apart | None, ...]
    misfit: tuple[bool, ...]
    released: Released | None
    doubts: Doubts
    skew: Skew | None
    moment: Moment | None
    learning: Learning | None
    learned: Learned
    model_error: Floats
    swing: float
    curves: Curves
    kinds: Kinds
    last: tuple[Estimate, Verdict] | None

    @property
    def commission(self) -> Commission:
        """All that is known of the meters' fixed errors."""
        return Commission(self.learned, self.learning)


def init(
    design: SequentialDesign, t: float, learned: Learned | None = None, learning: Learning | None = None
) -> SequentialState:
    """Begin to watch; the observer starts with the first frame.

    Parameters
    ----------
    design
        From `design`.
    t
        Unix time, s.
    learned, learning
        What is known of the meters' fixed errors and what was gathered, if there is anything from before.
    """
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
    """Learn some meters anew, because they were replaced: nothing of the old ones counts any more.

    Parameters
    ----------
    design, state
        The design, and the state.
    which : (p,)
        The meters. What spoke against the old ones does not speak against the new ones: they are trusted
        until something does.
    """
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

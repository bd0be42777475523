"""Sentences for the operator."""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.grid.three_phase import PHASES
from gridsec.interface import Explanation, PowerOrigin


def fault_sentence(design: SequentialDesign, k: int, amount: float) -> str:
    """Sentence about accused fault k of the dictionary with its amount, pu."""
    plant = design.plant
    power = f"{abs(amount) * plant.feeder.base_kva:.1f}"
    if k < design.customers:
        way = "feeds in" if amount > 0 else "draws"
        return f"It looks as if {plant.feeder.customers[k]} {way} {power} kW more than its readings say."
    owner = plant.feeder.customers[plant.droop.customer[k - design.customers]]
    return f"The inverter of {owner} may inject {power} kvar that its curve does not ask for."


def busbar_meter(which: Bools) -> str:
    """Name of the busbar's meter, with the phases `which` (b,) in three phases."""
    if which.size == 1:
        return "the meter of the busbar"
    names = [phase for phase, one in zip(PHASES, which, strict=True) if one]
    return f"the meter of the busbar (phase{'s' * (len(names) > 1)} {', '.join(names)})"


def busbar_deviation(off: Floats, v0_squared: Floats, which: Bools) -> str:
    """Largest deviation of the busbar's meter from the others, (b,) `off` beside `v0_squared`, squared pu."""
    parts = 100.0 * (np.sqrt(np.maximum(1.0 + off / v0_squared, 0.0)) - 1.0)[which]
    worst = float(parts[np.abs(parts).argmax()])
    return f"reads {abs(worst):.1f} % {'more' if worst > 0 else 'less'} than the meters of the feeder say"


def unread_sentence(
    names: tuple[str, ...], which: Bools, origins: Ints, percent: Floats, limit: float
) -> str:
    """Customers without a usable active power, and the precision of the voltage there.

    which, origins, percent: (p,) meters in question, `PowerOrigin`, and standard deviation of the voltage in
    % of nominal. limit: largest permitted one.
    """
    parts = []
    for origin, sentence in _ORIGINS.items():
        here = [name for name, one in zip(names, which & (origins == origin), strict=True) if one]
        if here:
            parts.append(sentence.format(_list(here)))
    return (
        f"{' '.join(parts)} The standard deviation of the voltage there is {percent[which].max():.2g} %; "
        f"`[monitor] unread_std_percent` permits {limit:g} %."
    )


_ORIGINS = {
    PowerOrigin.UNREAD: "No active power from {}.",
    PowerOrigin.LATE: "The active power of {} is older than the voltage.",
    PowerOrigin.BEYOND: "The active power of {} is beyond the declared range.",
    PowerOrigin.READ: "The running mean contains earlier ticks without a usable active power of {}.",
}
"""Sentence per origin. `READ`: the power is usable again, and the mean still contains ticks without it."""


def clock_sentence(names: tuple[str, ...], which: Bools, limit_s: float) -> str:
    """Meters `which` (p,) with readings of another moment."""
    found = _list([name for name, one in zip(names, which, strict=True) if one])
    return (
        f"The clock offset of {found} is above {limit_s:g} s: no scale compares the readings with the feeder."
    )


_SHOWN = 5
"""Largest number of explanations in a sentence, and of names in each."""


def explanations_sentence(design: SequentialDesign, explanations: tuple[Explanation, ...]) -> str:
    """Possible explanations in one sentence."""
    shown = [_explanation(design, each) for each in explanations[:_SHOWN]]
    if len(explanations) == 1:
        return f"Wrong is {shown[0]}; nothing else explains the readings."
    more, text = len(explanations) - len(shown), " or else ".join(shown)
    each = "both explain" if len(explanations) == 2 else "each of these explains"
    return f"Wrong are either {text}{f' or {more} more' if more else ''}; {each} the readings."


def _explanation(design: SequentialDesign, explanation: Explanation) -> str:
    customers, owner = design.plant.feeder.customers, design.plant.droop.customer
    accused = (
        ("meter", [name for name, bad in zip(design.names, explanation.meters, strict=True) if bad]),
        ("inverter", [customers[c] for c in owner[explanation.inverters]]),
        ("reported power", [customers[c] for c in np.flatnonzero(explanation.powers)]),
    )
    parts = [f"the {what}{'s' * (len(some) > 1)} of {_list(some)}" for what, some in accused if some]
    if explanation.busbar.any():
        parts.append(busbar_meter(explanation.busbar))
    return " and ".join(parts) if parts else "none of them"


def _list(names: list[str]) -> str:
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest

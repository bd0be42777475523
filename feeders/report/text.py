"""Texts of the report: sentences with sourced numbers, sections of studies, legends of their tables.

A number in a sentence names its table, for readers and for a test. A legend has one line for each column, for
the report and the terminal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import TYPE_CHECKING, Any, Final

from feeders.report.drawing import Figure

if TYPE_CHECKING:
    import pandas as pd


MANY: Final = 12
"""Largest number of names in a sentence."""


class Standing(Enum):
    """Certainty of an answer."""

    PROVED = "proved"
    MEASURED = "measured"
    PART = "partly proved"
    OPEN = "not proved"
    FAILED = "no answer"
    ABSENT = "not studied"


@dataclass(frozen=True, slots=True)
class Value:
    """Number in a sentence."""

    value: float  # the number
    shown: str  # text of the number, with its unit
    source: str  # table, column, and operation: `detectable-meters:noticed:max`


Sentence = tuple[str | Value, ...]


@dataclass(frozen=True, slots=True)
class Finding:
    """Answer of a study."""

    standing: Standing  # certainty of the answer
    sentences: tuple[Sentence, ...]  # the answer, the most important first


def sentence(text: str, **parts: str | Value | Sentence) -> Sentence:
    """Sentence with texts and numbers in place of `{name}`."""
    out: list[str | Value] = []
    for words, name, _, _ in Formatter().parse(text):
        part = parts[name] if name else ()
        out += [words, *(part if isinstance(part, tuple) else [part])]
    return tuple(each for each in out if each)


def said(sentence: Sentence) -> str:
    """Sentence as plain text."""
    return "".join(part if isinstance(part, str) else part.shown for part in sentence)


class Side(Enum):
    """Direction of rounding: a proved upper limit of safety is rounded down, and so on."""

    NEAR = "near"
    BELOW = "below"
    ABOVE = "above"


def number(value: Any, digits: int = 2, side: Side = Side.NEAR) -> str:
    """Write a number: ∞ for an infinite one, a question mark for an unknown one."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "?"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if float(value).is_integer():
        return f"{value + 0.0:.0f}".replace("-", "−")  # no −0
    scale, slack = 10.0**digits, 1e-9 * max(1.0, abs(value))
    if side is Side.BELOW:
        value = math.floor((value + slack) * scale) / scale
    elif side is Side.ABOVE:
        value = math.ceil((value - slack) * scale) / scale
    text = f"{value:.{digits}f}"
    if digits and side is Side.NEAR and float(text) == 0.0:
        text = f"{value:.2g}"
    return text.replace("-", "−")


def plural(size: float, one: str, several: str = "") -> str:
    """Noun of a number: one meter, two meters."""
    return one if size == 1 else several or f"{one}s"


def listed(names: Sequence[str]) -> str:
    """Names in a sentence; beyond MANY, the first ones and the number of the others."""
    some = list(names)
    if len(some) > MANY:
        return f"{', '.join(some[: MANY - 2])} and {len(some) - MANY + 2} more"
    return " and ".join([", ".join(some[:-1]), some[-1]] if len(some) > 1 else some)


def counted(count: int, source: str) -> Value:
    """Number of things."""
    return Value(count, str(count), source)


def rows(table: pd.DataFrame, name: str) -> Value:
    """Number of rows of a table."""
    return counted(len(table), f"{name}:rows")


def quantity(value: float, unit: str, source: str, *, digits: int = 2, side: Side = Side.NEAR) -> Value:
    """Rounded number with its unit."""
    return Value(value, f"{number(value, digits, side)} {unit}".strip(), source)


def most(
    table: pd.DataFrame, name: str, column: str, unit: str = "", *, digits: int = 2, side: Side = Side.NEAR
) -> Value:
    """Largest value of a column."""
    return quantity(float(table[column].max()), unit, f"{name}:{column}:max", digits=digits, side=side)


def least(
    table: pd.DataFrame, name: str, column: str, unit: str = "", *, digits: int = 2, side: Side = Side.NEAR
) -> Value:
    """Smallest value of a column."""
    return quantity(float(table[column].min()), unit, f"{name}:{column}:min", digits=digits, side=side)


class Question(Enum):
    """Questions of a committee, in the order of the summary."""

    LIES = "Which meters can be manipulated without notice, and by how much?"
    PROTECT = "Which meters should be protected?"
    PICTURE = "How large an error of the shown voltages can an attack cause?"
    FLEET = "Are the inverters stable, and do they keep the voltage band?"
    MONITOR = "How did the monitor behave in simulated attacks?"
    INVISIBLE = "Can attacks stay invisible for ever, even with exact knowledge of everything else?"
    RECORDS = "Which errors of the files do the recorded readings show?"
    OTHER = "Which other studies were run?"


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Section of the report."""

    answers: Mapping[Question, Finding]  # answers by question
    figures: tuple[Figure, ...] = ()  # figures; their names begin with the study's
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)  # tables by name
    # Columns of a table on the page, if not the first ones; files have all.
    shown: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    assumptions: tuple[str, ...] = ()  # assumptions, as sentences


# --- Legends ---


COMMON: Final = {
    "meter": "id of the meter",
    "customer": "name of the customer",
    "bus": "name of the bus",
    "phase": "phase of the customer",
    "feeder": "name of the feeder",
    "meters": "number of meters",
}
"""Columns with one meaning in every study."""

_VOLTS: Final = {
    "v_low_volt": "lowest voltage, V",
    "v_high_volt": "highest voltage, V",
    "low_volt": "proved lower limit of the voltage for arbitrary load changes, V",
    "high_volt": "proved upper limit for arbitrary load changes, V; ∞: no limit proved",
    "low_rest_volt": "proved lower limit for slow load changes, V; −∞: no limit proved",
    "high_rest_volt": "proved upper limit for slow load changes, V; ∞: no limit proved",
}

COLUMNS: Final[Mapping[str, Mapping[str, str]]] = {
    "redundancy": {
        "case": "all live: with every meter; silent: without the meters of --silent",
        "attack": "persistent: with a lasting effect; any: also those that the inverters forget",
        "patterns": "dimension of hidden attacks",
        "blind": "customers with a voltage that no meter determines, even without an attack",
        "index": "fewest manipulated meters that stay invisible; ∞: no set of meters does",
        "index_persistent": "index with this meter, or inside this part, for persistent attacks; ∞: none",
        "index_any": "the same as index persistent, for any attacks; ∞: none",
        "detected": "most manipulated meters that cannot hide; ∞: any number of them",
        "identified": "most manipulated meters that are identified; ∞: any number of them",
        "liars": "a smallest set of meters that stays invisible",
        "critical": "yes: without this meter some pattern is invisible to all others",
        "identified_without": "most manipulated meters that are identified without this one; ∞: any number",
        "with": "meters together with which it can stay invisible, for persistent attacks",
        "branch": "yes: the part begins at the busbar",
        "meters_silent": "number of meters without the silent ones",
        "identified_silent": "identified, without the silent meters; ∞: any number",
        "note": "reason of a stopped search",
    },
    "protect": {
        "goal": "identify, notice, bound or contain",
        "attack": "attacks that count; persistent: with a lasting effect; any: also decaying ones",
        "max_attacked": "largest number of manipulated meters among the others",
        "lie_volt": "required limit of hidden attacks, V of the busbar's level",
        "alone": "largest attack that one unprotected meter hides by itself, with true powers, V",
        "protected": "number of protected meters",
        "least": "proved: no fewer protected meters suffice",
        "before": "without protection: largest hidden attack, V of the busbar's level, or fewest manipulated "
        "meters that stay invisible; ∞: no set of meters does",
        "after": "the same with protection; ∞: no set of the other meters stays invisible",
        "attacks": "number of the listed attacks with this meter",
        "liars": "meters of an attack that excludes any smaller set",
    },
    "detectable": {
        "hidden": "up to this, V, no meter is named, with the stated probability at any one moment",
        "noticed": "beyond this, V, the monitor detects it before errors are learned; ∞: no size is proved",
        "named": "beyond this, V, the search names it, before errors are learned; ∞: no size is",
        "fits": "up to this, V, the readings are those of some honest feeder; ∞: no limit",
        "identified": "beyond this, V, every explanation by at most M meters accuses it; ∞: no size does",
        "error": "largest unnoticed error of the reconstructed voltage, V; ∞: no limit is proved",
        "undetected": "an attack of this size, V, that the monitor does not detect, once errors are learned",
        "undetected_initial": "the same for an attack that begins with the first reading, V",
        "found_initial": "beyond this, V, an attack that begins with the first reading is detected",
        "found": "beyond this, V, a test of the monitor detects it, once errors are learned",
        "unavoidable": "up to this, V, every test misses it at least every second time",
        "error_fits": "largest distance of two voltages that fit the same readings, V; ∞: no limit",
        "error_undetected": "error, V, by attacks that the monitor does not detect, once errors are learned",
        "error_found": "attacks with a larger error, V, are detected by the monitor, once errors are learned",
        "error_undetected_initial": "error, V, by undetected attacks that begin with the first reading",
        "error_found_initial": "attacks from the first reading with a larger error, V, are detected",
        "error_unavoidable": "error, V, that every test leaves, by the meters of `error_undetected`",
    },
    "droop": {
        **_VOLTS,
        "point": "evening: full loads, no generation; noon: 0.2 and 1 of the peaks; half: 0.5 of both",
        "verdict": "stable: proved to converge to one equilibrium from every state; unstable: leaves its "
        "equilibrium, proved and simulated; undecided: neither is proved",
        "proof": "deadband: no reaction; small-gain: any interval and dead time; circle: this interval",
        "gain": "gain of the loop in equilibrium, 1",
        "growth": "factor of a small deviation in one update",
        "outcome": "of the simulation: settles, oscillates, collapses or open",
        "margin": "all curves stay proved stable up to this factor on their slopes; ∞: no limit",
        "slope_certified": "proved stable up to this factor on the slopes of these curves; search up to 1024",
        "slope_unstable": "unstable from this factor on the slopes on; ∞: no limit within 1024",
        "size_certified": "proved stable up to this factor on the inverters' sizes; search up to 1024",
        "size_unstable": "unstable from this factor on the sizes on; ∞: no limit within 1024",
        "longest_interval_s": "longest sampling interval with a proof of stability, s; ∞: every one",
        "tau_factor": "factor on all time constants; of stability: the smallest proved one",
        "why": "reason of an undecided verdict",
        "limit_kvar": "largest reactive power of the inverter, kvar",
        "part": "share of the loop gain",
        "alone": "admissible factor on this inverter's slope alone; ∞: no limit",
        "step": "load: 20 to 80 % of its peak; cloud: generation to 20 %; tap: busbar up by 0.025 pu",
        "settling_s": "time until 2 % of the change remain, s; not known if it does not settle",
        "overshoot_percent": "overshoot, % of the change",
        "change_volt": "change of the voltage by the inverters after the step, V",
        "end_low_volt": "lowest voltage after the step, V",
        "end_high_volt": "highest voltage after the step, V",
        "worst_customer": "customer with the worst final voltage",
        "t_s": "time after the step, s",
        "v_volt": "voltage, V",
        "case": "with the fleet, or without its reactive power",
        "rest": "voltage band for slow load changes: kept, violated or undecided",
        "always": "voltage band for arbitrary load changes: kept, violated or undecided",
        "kept": "yes: band proved to be kept for arbitrary load changes",
        "kept_rest": "yes: band proved to be kept for slow load changes",
        "p_kw": "active power drawn, kW",
        "q_kvar": "reactive power drawn, kvar",
        "when": "at rest, or after a jump of all loads",
        "inverter_kvar": "reactive power of the inverters, kvar",
        "busbar_volt": "voltage of the busbar, V",
        "beyond": "yes: voltage outside the band",
        "preset": "curve of the inverters; none: without reactive power",
        "inverters": "number of inverters",
        "tau_s": "largest time constant of the filters, s",
        "band_rest": "voltage band for slow load changes",
        "band_always": "voltage band for arbitrary load changes",
        "capacity_kw": "largest total generation without a violation, kW",
        "limit": "first violated limit; empty: no limit within the search",
        "line_percent": "largest load of a line, % of its rating",
        "confirmed_volt": "difference from a second power flow there, V; ∞: it has no solution",
        "pv_kw": "total generation, kW",
        "broken": "violated limit",
        "draw": "number of the random order",
        "units": "number of units of generation",
        "probability": "share of random orders in which this generation violates a limit",
        "count": "number of random orders",
        "mean": "mean of the capacities, kW",
        "std": "standard deviation, kW",
        "min": "smallest capacity, kW",
        "10%": "exceeded in 90 % of the orders, kW",
        "50%": "median, kW",
        "90%": "exceeded in 10 % of the orders, kW",
        "max": "largest capacity, kW",
    },
    "campaign": {
        "alarms_per_year": "allowed false alarms per year",
        "kind": "kind of attack; clean: without an attack",
        "size": "% of nominal; drift: % of nominal per minute; replay, clock-shift: age of the reports, s; "
        "inverter: % of its rating; guarantees: factor on their size; stuck: none",
        "place": "choice of the manipulated meters",
        "liars": "number of manipulated devices",
        "scenarios": "number of simulated scenarios",
        "exact": "share of scenarios with all manipulated devices named, and no others",
        "liars_told": "number of manipulated devices, sum over scenarios",
        "named": "share of the manipulated devices that were named; of one scenario: their number",
        "false": "share of scenarios with an honest device named",
        "delay_median_s": "median time from the onset to the naming, of those named, s",
        "delay_95_s": "95th percentile of these times, s",
        "delay_s": "time from the onset to the naming of the last device, s; ∞: never named",
        "clear_median_s": "median of clear s; ∞: not within the scenario",
        "clear_s": "time from the end of the attack until no device is named, s; ∞: not within the scenario",
        "error_liars": "largest error of the voltage at manipulated meters, % of nominal; ∞: unbounded",
        "error_others": "largest error of the voltage elsewhere, % of nominal; ∞: unbounded",
        "error_liars_95": "95th percentile of the error at manipulated meters, % of nominal; ∞: unbounded",
        "error_others_95": "95th percentile of the error elsewhere, % of nominal; ∞: unbounded",
        "error_liars_worst": "largest error at manipulated meters, % of nominal; ∞: unbounded",
        "error_others_worst": "largest error elsewhere, % of nominal; ∞: unbounded",
        "undecided": "share of the time with the verdict UNDECIDED",
        "within_s": "time since the onset, s",
        "hours": "time without an attack, h",
        "false_names": "number of times that an honest device was named in that time",
        "per_year": "the same per year",
        "scenario": "number of the scenario",
        "scene": "number of the scene",
        "season": "season of the profiles",
        "hour": "begin, h",
        "weekday": "0: Monday",
        "onset_s": "begin of the attack, s",
        "reason": "reason for a missing simulation",
        "missed": "manipulated devices that were not named",
        "falsely_named": "honest devices that were named",
        "because": "devices named because of the attack",
        "false_events": "number of times that an honest device was named",
        "most_named": "most devices named at once",
        "watched_s": "monitored time, s",
        "undecided_s": "time with the verdict UNDECIDED, s",
        "clean_lying_s": "time with the verdict CLEAN during an attack, s",
        "who": "manipulated device",
        "inverter": "yes: an inverter",
        "lie_volt": "largest displacement, V",
        "anyway": "yes: named without the attack too",
        "promise": "guarantee of `study detectable`",
        "lies": "number of attacks with this guarantee",
        "broken": "number of them with a broken guarantee",
        "by_chance": "number of attacks with a device that is named without the attack too",
        "honest_named": "number of scenarios with an honest device named",
        "scenes": "number of independent scenes",
        "scenes_broken": "number of them with a broken guarantee",
        "probability_high": "upper limit of the probability of a broken guarantee, 95 % confidence",
    },
    "calibrate": {
        "kind": "kind of error: bus, phase, swap, length or meter",
        "what": "customers, meters or lines of the error",
        "now": "as in the files",
        "proposed": "as the readings show",
        "estimate": "estimated size; 1: as proposed",
        "std": "standard error of the estimate",
        "low": "lower end of the 95 % interval",
        "high": "upper end of the 95 % interval; ∞: no limit by these readings",
        "log_factor": "gain of the log-likelihood",
        "confidence": "probability of this correction among all others",
        "verdict": "'cannot be told' is neither right nor wrong: the readings do not determine it",
        "alternatives": "corrections that explain the readings as well; then none is decided",
        "frames": "number of moments with a reading of the meter",
        "bias_percent": "error of the voltage relative to the busbar's meter, %",
        "std_percent": "standard error of it, %",
        "low_percent": "lower end of the 95 % interval, %",
        "high_percent": "upper end of the 95 % interval, %",
        "lines": "line, or lines in series with one effect",
        "from_bus": "bus at the begin",
        "to_bus": "bus at the end",
        "factor": "factor on the length in the files",
        "same": "lines that cannot be distinguished from it",
        "phases": "phases of the customer",
        "alternative": "best other place",
        "open": "other places that are not excluded",
        "power_factor": "power factor of the load",
        "p_gain_percent": "error of the register of active power, %",
        "p_gain_std_percent": "standard error of it, %",
        "quantity": "error of powers or meters",
        "unit": "unit of the estimate and its interval",
    },
    "compare": {
        "family": "name of the estimator",
        "named": "manipulated devices named during the attack, of all",
        "missed": "number of manipulated devices that were not named",
        "falsely named": "number of honest devices ever named",
        "delay, s": "median time from the onset to the naming, of those named, s; empty: none named",
        "error at liars, %": "95th percentile of the error at manipulated meters, % of nominal; ∞: unbounded",
        "error at all, %": "the same at all customers; ∞: unbounded",
        "ms per step": "median processor time of a step, ms, and its 95th percentile",
        "observers": "number of observers, or candidate sets",
        "false clean, %": "share of the ticks with an attack and the verdict CLEAN, %",
        "undecided, %": "share of all ticks with the verdict UNDECIDED, %",
    },
}
"""Meaning of each column, by study."""

_ENDS: Final = {"_low": "lower", "_high": "upper"}


def legend(study: str, columns: Iterable[str]) -> dict[str, str]:
    """Meanings of columns of a study's tables; limits and sizes alone follow their quantity."""
    known = {**COMMON, **COLUMNS.get(study, {})}
    out = {}
    for name in map(str, columns):
        base, alone = name.removesuffix("_alone"), name.endswith("_alone")
        ends = [end for end in _ENDS if name.endswith(end) and name.removesuffix(end) in known]
        if name in known:
            out[name] = known[name]
        elif alone and base in known:
            out[name] = f"{base} for a single manipulated meter, V{_unlimited(known[base])}"
        elif ends:
            base = name.removesuffix(ends[0]).replace("_", " ")
            out[name] = f"{_ENDS[ends[0]]} limit of {base} with 95 % confidence"
    return out


def _unlimited(meaning: str) -> str:
    _, sign, rest = meaning.partition("; ∞")
    return sign + rest

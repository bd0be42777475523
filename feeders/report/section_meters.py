"""Sections of the studies redundancy, detectable and protect."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

from feeders.format.validation import told
from feeders.report.charts import Bar, ChartRow, rows
from feeders.report.drawing import Drawing, Figure
from feeders.report.maps import Shape, Spot, comparable, draw_map, legend_of, names_of, single_phase, size_map
from feeders.report.text import (
    Finding,
    Question,
    Section,
    Sentence,
    Side,
    Standing,
    Value,
    counted,
    least,
    listed,
    most,
    number,
    plural,
    sentence,
)
from feeders.report.text import rows as how_many
from feeders.studies.protect import Goal
from gridsec.planning.detectability import QUIET, ROOM, SINCE

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site
    from feeders.studies.detectable import Detectable
    from feeders.studies.protect import Protect
    from feeders.studies.redundancy import Redundancy


def redundancy(site: Site, found: Redundancy) -> Section:
    """Section of the study redundancy."""
    first = found.meters[found.meters["case"] == "all live"]
    return Section(
        answers={Question.INVISIBLE: _invisible(found)},
        figures=(
            Figure(
                "redundancy-map",
                "Fewest manipulated meters of an invisible attack",
                "At each meter: size of the smallest set of manipulated meters with it that can stay "
                "invisible, for any attack (∞: no set; ?: the search was stopped).",
                partial(_index_map, site, first),
            ),
        ),
        tables=found.tables,
        assumptions=(
            f"Customers with unknown powers: {listed(found.unknown) or 'none'}.",
            f"Inverters on their {'steepest slopes' if str(found.curves) == 'steepest' else 'deadbands'}.",
            "Feeder, all other loads and all meters' errors are assumed to be known exactly: the limit of "
            "any method. The size from which an attack exceeds honest errors is not part of this study.",
        ),
    )


def _invisible(found: Redundancy) -> Finding:
    sentences: list[Sentence] = []
    open_ = False
    for k, row in enumerate(found.summary.to_dict("records")):
        index, case = float(row["index"]), str(row["case"])
        value = Value(index, number(index), f"redundancy-summary:index:row {k}")
        kind = (
            "by attacks with a lasting effect"
            if row["attack"] == "persistent"
            else "by any attack, those included that the inverters forget within seconds"
        )
        by = f"B{kind[1:]}"
        prefix = "" if case == "all live" else f"Without {listed(found.silent)}: "
        if math.isnan(index):
            open_ = True
            gave_up = "the fewest invisible meters are not proved: the search was stopped. There may be some"
            sentences.append((f"{prefix}{by}, {gave_up}.",))
        elif math.isinf(index):
            sentences.append((f"{prefix}{by}, no number of manipulated meters can stay invisible.",))
        else:
            meters = f": {listed(str(row['liars']).split(' '))}" if row["liars"] else ""
            verb = "manipulated meter can" if index == 1 else "manipulated meters together can"
            end = "" if index == 1 else "; fewer cannot"
            sentences.append((prefix, value, f" {verb} stay invisible {kind}{meters}{end}."))
        if row["blind"]:
            sentences.append((f"{prefix}No meter determines the voltage of {row['blind']}.",))
    return Finding(Standing.OPEN if open_ else Standing.PROVED, tuple(dict.fromkeys(sentences)))


def _index_map(site: Site, meters: pd.DataFrame, width: float) -> Drawing:
    by_meter = dict(zip(meters["meter"].astype(str), meters["index_any"].astype(float), strict=True))
    spots = []
    for name in names_of(site, "meter"):
        value = by_meter.get(name, math.nan)
        shown = number(value)
        if name not in by_meter:
            spots.append(Spot(Shape.NONE, tip=name))
        elif math.isnan(value):
            spots.append(Spot(Shape.OPEN, f"{name}: ?", f"{name}: not known", weight=2.0))
        elif math.isfinite(value):
            spots.append(Spot(Shape.ALARM, f"{name}: {shown}", f"{name}: {shown}", weight=1.0 / value))
        else:
            spots.append(Spot(Shape.METER, f"{name}: {shown}", f"{name}: {shown}"))
    meanings = {
        "can stay invisible, in a set of this size": Shape.ALARM,
        "cannot": Shape.METER,
        "not known": Shape.OPEN,
        "no meter": Shape.NONE,
    }
    return draw_map(site, spots, width, legend=legend_of(meanings, spots))


ROWS = 30
"""Largest number of rows in a chart; the largest values are shown."""


# --- detectable ---------------------------------------------------------------------------------


def detectable(site: Site, found: Detectable) -> Section:
    """Section of the study detectable."""
    once, twice = _sure(found.risk), _sure(2.0 * found.risk)
    return Section(
        answers={
            Question.LIES: _sizes(site, found.meters, found.max_attacked, once),
            Question.PICTURE: _picture(site, found.customers, found.max_attacked, twice),
        },
        figures=_size_figures(site, found, once, twice),
        tables=found.tables,
        assumptions=_assumed(site, found, once),
    )


def _size_figures(site: Site, found: Detectable, once: str, twice: str) -> tuple[Figure, ...]:
    liars = found.max_attacked
    (meters, unit), (customers, _) = (comparable(site, each) for each in (found.meters, found.customers))
    together = "alone" if liars == 1 else f"together with at most {liars - 1} more"
    return (
        Figure(
            "detectable-sizes",
            "Outcome of an attack, by its size",
            f"Each meter manipulated {together}. Before fixed errors are learned. Left: no meter is named. "
            "Middle: depends on the honest errors of the moment. Right: noticed, but not named for sure. "
            f"Beyond the number the meter is named.{_largest_only(meters)}",
            partial(_sizes_chart, meters, unit=unit),
        ),
        Figure(
            "detectable-map",
            "Attacks that may stay unnoticed",
            f"Size from which an attack is noticed with {once}, {unit}, {liars} "
            f"{plural(liars, 'manipulated meter')}"
            f"{' together' * (liars > 1)}. Larger discs, larger attacks. "
            f"Largest at {_extreme(meters, 'meter', 'noticed')}.",
            partial(size_map, site, meters, who="meter", column="noticed", unit=unit),
        ),
        Figure(
            "detectable-picture",
            "Errors of the shown voltages",
            f"Largest error of each customer's reconstructed voltage, with {twice}, under {liars} unnoticed "
            f"{plural(liars, 'manipulated meter')}, before fixed errors are learned, {unit}. "
            f"Largest at {_extreme(customers, 'customer', 'error')}.",
            partial(size_map, site, customers, who="customer", column="error", unit=unit),
        ),
    )


def _assumed(site: Site, found: Detectable, once: str) -> tuple[str, ...]:
    liars = found.max_attacked
    return (
        f"At most {liars} manipulated {plural(liars, 'meter', 'meters together')}; attackers know "
        "the feeder, but not the honest errors of the moment.",
        f"Estimator modal. Hidden, noticed and named: fixed errors not learned, {QUIET} honest readings, "
        f"at reading {SINCE} of the attack; "
        f"{'balanced' if single_phase(site) else 'three-phase'} model; "
        "inverters in their deadbands; nominal voltage.",
        f"Sizes for the monitor hold with {once} at any one moment: honest errors Gaussian or uniform "
        f"with the deviations of the files, and every load draws {100.0 * found.share:g} % of its peak. "
        "Powers of unmetered customers are unknown within their range.",
        "Proofs are for the linear effect of load errors; AC power flow was only simulated.",
        "Identification of the manipulated meter by the monitor's search, at this and later moments, is not "
        "proved but was checked by simulation (gridsec study detectable --trials, and campaigns).",
        f"Undetected and found, with errors learned: {100.0 * ROOM:g} % of every limit is left to honest "
        "residuals. Measured, not proved.",
        "After a stopped search for the worst collusion, sizes are the limits proved until then: on the "
        "safe side.",
    )


def _sure(risk: float) -> str:
    return f"{100.0 * (1.0 - risk):.6g} %"


def _span(
    table: pd.DataFrame, name: str, column: str, who: str = "", *, digits: int = 2, side: Side = Side.ABOVE
) -> Sentence:
    """Smallest and largest value of a column, V, with the ids of both."""
    low, high = (end(table, name, column, "V", digits=digits, side=side) for end in (least, most))
    if not who:
        return (low, " to ", high)
    at = "at " if who == "customer" else ""
    first, last = _extreme(table, who, column, smallest=True), _extreme(table, who, column)
    return (low, f" ({at}{first}) to ", high, f" ({at}{last})")


def _sizes(site: Site, meters: pd.DataFrame, liars: int, sure: str) -> Finding:
    name = "detectable-meters"
    levels = f" Volts are those of each meter's own level{_percent(site)}." if _percent(site) else ""
    lead = sentence(
        "All {meters} meters, {together}, can hide a small attack: up to {span} no meter is named, with "
        "{sure} at any one moment.{levels}",
        meters=how_many(meters, name),
        together="alone" if liars == 1 else f"with up to {liars} manipulated together",
        span=_span(meters, name, "hidden", "meter", digits=3, side=Side.BELOW),
        sure=sure,
        levels=levels,
    )
    never = meters[[math.isinf(v) or math.isnan(v) for v in meters["noticed"]]]
    if len(never):
        unnoticed: Sentence = (
            f"For {listed(never['meter'].tolist())} no size is proved to be noticed. "
            "This is no proof that attacks there are harmless.",
        )
        return Finding(Standing.PART, (lead, unnoticed))
    noticed = sentence(
        "Larger attacks may stay unnoticed too, depending on the honest errors of the moment. Before fixed "
        "errors are learned, the monitor detects them, with the same probability, from {span} on.",
        span=_span(meters, name, "noticed", "meter"),
    )
    named: Sentence = ("Not every manipulated meter is named, for any size of the attack.",)
    if all(math.isfinite(v) for v in meters["named"]):
        named = sentence(
            "The monitor's search names the manipulated meter from {span} on. This is not proved, but was "
            "checked by simulation.",
            span=_span(meters, name, "named"),
        )
    learned = sentence(
        "Once fixed errors are learned, attacks of {least} may stay undetected, and larger ones than {most} "
        "are found.",
        least=_span(meters, name, "undetected", digits=3, side=Side.BELOW),
        most=_span(meters, name, "found", digits=3),
    )
    return Finding(Standing.PART, (lead, noticed, named, learned))


def _picture(site: Site, customers: pd.DataFrame, liars: int, sure: str) -> Finding:
    if not all(math.isfinite(v) for v in customers["error"]):
        return Finding(Standing.OPEN, (("No bound of the error is proved for every customer.",),))
    name = "detectable-customers"
    lead = sentence(
        "Largest error of the shown voltage by {attacked} without notice: {span}, honest errors included, "
        "with {sure} for each customer at any one moment. Nominal voltage is {nominal}{percent}.",
        attacked="a single manipulated meter" if liars == 1 else f"{liars} meters manipulated together",
        span=_span(customers, name, "error", "customer"),
        sure=sure,
        nominal=told(site.nominal_volt),
        percent=_percent(site),
    )
    arbitrary = sentence(
        "For any method, two voltages up to {apart} apart can fit the same readings.",
        apart=most(customers, name, "error_fits", "V", side=Side.ABOVE),
    )
    how: Sentence = ("Proved for the linear effect of load errors, and checked by AC power flow.",)
    return Finding(Standing.PART, (lead, arbitrary, how))


def _percent(site: Site) -> str:
    """With several nominal voltages, 1 % of each in volts: volts of different levels are not comparable."""
    levels = dict.fromkeys(site.nominal_volt.tolist())
    return f"; 1 % is {' and '.join(f'{0.01 * volt:.1f} V' for volt in levels)}" if len(levels) > 1 else ""


def _extreme(table: pd.DataFrame, who: str, column: str, *, smallest: bool = False) -> str:
    order = table[column]
    return str(table[who].iloc[int(order.argmin() if smallest else order.argmax())])


def _largest_only(table: pd.DataFrame) -> str:
    return f" The {ROWS} largest of {len(table)} are shown." if len(table) > ROWS else ""


def _sizes_chart(meters: pd.DataFrame, width: float, *, unit: str) -> Drawing:
    shown = meters.sort_values(["named", "meter"], ascending=[False, True]).head(ROWS)
    finite = [v for v in shown[["hidden", "noticed", "named"]].to_numpy().ravel() if math.isfinite(v)]
    end = 1.15 * max(finite, default=1.0)
    data = []
    for _, row in shown.iterrows():
        a, b, c = (float(row[k]) if math.isfinite(row[k]) else end for k in ("hidden", "noticed", "named"))
        bars = (
            Bar(
                0.0,
                a,
                "fill-bad",
                "no meter is named",
                f"to {number(row['hidden'], 3, Side.BELOW)} {unit} no meter is named",
            ),
            Bar(
                a,
                b,
                "band0",
                "depends on honest errors",
                f"noticed from {number(row['noticed'], 2, Side.ABOVE)} {unit} on",
            ),
            Bar(
                b,
                max(b, c),
                "band2",
                "noticed, another may be named",
                f"named from {number(row['named'], 2, Side.ABOVE)} {unit} on",
            ),
        )
        data.append(ChartRow(str(row["meter"]), bars, f"{number(row['named'], 2, Side.ABOVE)} {unit[0]}"))
    axis = "size of the attack, V at nominal voltage" if unit == "V" else f"size of the attack, {unit}"
    return rows(data, width, axis=axis)


# --- protect ------------------------------------------------------------------------------------


def protect(site: Site, found: Protect) -> Section:
    """Section of the study protect."""
    chosen = set(found.meters["meter"]) if len(found.meters) else set()
    return Section(
        answers={Question.PROTECT: _protection(site, found)},
        figures=(
            Figure(
                "protect-map",
                "Meters to protect",
                f"Shields: {listed(sorted(chosen))}."
                if chosen
                else "The goal does not apply to this feeder."
                if found.no_answer
                else "No meter needs protection for this goal.",
                partial(_protect_map, site, chosen),
            ),
        ),
        tables=found.tables,
        assumptions=(
            f"At most {found.max_attacked} of the other meters are manipulated; a protected meter cannot be.",
            *(
                (
                    f"All errors at their worst, every load at {100.0 * found.share:g} % of its peak, "
                    "inverters in their deadbands, linear model at nominal voltage.",
                )
                if found.goal.in_volts
                else (f"Attacks that count: {found.attack}. Loads of metered customers are known.",)
            ),
        ),
    )


def _no_protection(found: Protect) -> Finding:
    """Finding for a goal that requires no protection on this feeder."""
    what = "identified" if found.goal is Goal.IDENTIFY else "noticed"
    lead: Sentence = (
        f"No answer by this criterion, and no safety: attacks to be {what} are those that fit exactly known "
        "powers exactly, and there are none, of any size and by any number of meters.",
    )
    instead: Sentence = (
        "Attacks within honest errors are not part of this goal; to bound these, --goal contain. Attacks "
        "behind an unknown load: --unknown CUSTOMER. Attacks that inverters forget within seconds: "
        "--attack any.",
    )
    return Finding(Standing.OPEN, (lead, instead))


def _protection(site: Site, found: Protect) -> Finding:
    if found.no_answer:
        return _no_protection(found)
    count, liars = len(found.meters), found.max_attacked
    others = f"any {liars} manipulated meters" if liars > 1 else "any single manipulated meter"
    among = " among the other meters" if count else ""
    several = bool((site.nominal_volt != site.nominal_volt[0]).any())
    there = f" where {site.nominal_volt[0]:.1f} V are nominal, or the same part elsewhere," if several else ""
    purpose = {
        Goal.IDENTIFY: f"{others}{among} would be identified",
        Goal.NOTICE: f"attacks on {others}{among} would be noticed",
        Goal.BOUND: f"no attack above {number(found.lie_volt)} V{there} on {others}{among} fits an honest "
        "feeder, with true powers",
        Goal.CONTAIN: f"no attack above {number(found.lie_volt)} V{there} on {others}{among} fits an honest "
        "feeder, with any reported powers",
    }[found.goal]
    scope = "" if found.goal.in_volts else ", given exact knowledge of all other loads and errors"
    if not count:
        lead: Sentence = (f"None for this purpose: even without protection, {purpose}{scope}.",)
    else:
        names = listed(found.meters["meter"].tolist())
        lead = (
            "Protect ",
            how_many(found.meters, "protect-meters"),
            f" of {site.meters.size} meters: {names}. Then {purpose}{scope}.",
        )
    effect = _effect(found)
    proof: Sentence = ("No fewer suffice; other sets of this size may be as good.",)
    # Results in volts are proved for the linear effect of errors.
    sure = Standing.PART if found.gap or found.goal.in_volts else Standing.PROVED
    if not count and not math.isnan(found.before):
        return Finding(sure, (lead, effect))
    if found.gap:
        proof = sentence(
            "These suffice; their number is not proved to be the smallest; at least {needed} are needed.",
            needed=counted(found.least, "protect-summary:least:row 0"),
        )
    return Finding(sure, (lead, effect, proof))


def _effect(found: Protect) -> Sentence:
    """Effect of protection."""
    before, after, alone = (
        Value(value, _cell(value, found.goal), f"protect-summary:{name}:row 0")
        for name, value in (("before", found.before), ("after", found.after), ("alone", found.alone))
    )
    if not found.goal.in_volts:
        words = "Fewest manipulated meters that stay invisible: {before} without protection, {after} with it"
        words += ", for any number of meters." if math.isinf(found.after) else "."
    else:
        words = "Largest hidden attack: {before} without protection, {after} with it."
        if not math.isnan(found.alone):
            words += " Unprotected, one meter hides up to {alone} by itself, with true powers."
    return sentence(words, before=before, after=after, alone=alone)


def _cell(value: float, goal: Goal) -> str:
    if math.isnan(value):
        return "not known"
    if goal.in_volts:
        return f"{number(value, 2, Side.ABOVE)} V"
    return "none" if math.isinf(value) else number(value)


def _protect_map(site: Site, chosen: set[Any], width: float) -> Drawing:
    ids = names_of(site, "meter")
    crowd = len(ids) > 60
    spots = [
        Spot(Shape.PROTECTED, name, f"{name}: protect", weight=1.0)
        if name in chosen
        else Spot(Shape.METER, "" if crowd else name, f"{name}")
        if name
        else Spot(Shape.NONE, tip=site.feeder.customers[k])
        for k, name in enumerate(ids)
    ]
    legend = {"protect": Spot(Shape.PROTECTED)} if chosen else {}
    legend |= {"meter": Spot(Shape.METER)}
    if "" in ids:
        legend["customer without a meter"] = Spot(Shape.NONE)
    return draw_map(site, spots, width, legend=legend)

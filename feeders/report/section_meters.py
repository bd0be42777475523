"""Sections of the studies redundancy, detectable and protect."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

from feeders.format.validation import told
from feeders.report.charts import Bar, Row, rows
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
    least,
    listed,
    most,
    number,
    plural,
)
from feeders.report.text import rows as how_many
from feeders.studies.protect import Goal

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site
    from feeders.studies.detectable import Detectable
    from feeders.studies.protect import Protect
    from feeders.studies.redundancy import Redundancy

__all__ = ["detectable", "protect", "redundancy"]


def redundancy(site: Site, found: Redundancy) -> Section:
    """Who can lie without ever being noticed.

    Parameters
    ----------
    site, found
        The feeder, and what was found.
    """
    first = found.meters[found.meters["case"] == "all live"]
    return Section(
        title="Who can lie without ever being noticed",
        answers={Question.INVISIBLE: _invisible(found)},
        figures=(
            Figure(
                "redundancy-map",
                "How many must lie together to stay invisible",
                "At each meter: the fewest liars, itself among them, whose lies stay invisible, by any "
                "attack (∞: no set of liars; ?: the search gave up).",
                partial(_index_map, site, first),
            ),
        ),
        tables=found.tables,
        columns={
            "index": "fewest liars that stay invisible; ∞: there are none",
            "attack": "persistent: its effect stays; any: those too that the inverters forget by themselves",
            "patterns": "dimensions in which a lie can hide",
            "detected, identified": "most liars that cannot hide, and that can be told who they are",
            "critical": "without this meter nobody else sees some pattern",
            "identified without": "most liars that are identified by the others once this meter is silent",
            "with": "meters that it can stay invisible together with, by an attack whose effect stays",
            "branch": "whether the part begins at the busbar",
            "blind": "customers whose voltage no meter tells, whoever lies",
        },
        assumptions=(
            f"Nobody knows the powers of: {listed(found.unknown) or 'nobody; all are known'}.",
            f"Inverters on their {'steepest slopes' if str(found.curves) == 'steepest' else 'deadbands'}.",
            "Whoever looks knows the feeder, all other loads and all meters' errors exactly: the best that "
            "any method could do. How large a lie must be to stand out of honest errors is another question.",
        ),
    )


def _invisible(found: Redundancy) -> Finding:
    sentences: list[Sentence] = []
    open_ = False
    for k, row in enumerate(found.summary.to_dict("records")):
        index, case = float(row["index"]), str(row["case"])
        value = Value(index, number(index), f"redundancy-summary:index:row {k}")
        kind = (
            "by attacks whose effect stays"
            if row["attack"] == "persistent"
            else "by any attack, those included that the inverters forget within seconds"
        )
        by = f"B{kind[1:]}"
        prefix = "" if case == "all live" else f"Without {listed(found.silent)}: "
        if math.isnan(index):
            open_ = True
            gave_up = "how many liars it takes is not proved: the search gave up. Some may well be able to"
            sentences.append((f"{prefix}{by}, {gave_up}.",))
        elif math.isinf(index):
            sentences.append((f"{prefix}{by}, no number of liars can stay invisible.",))
        else:
            who = f": {listed(str(row['liars']).split(' '))}" if row["liars"] else ""
            verb = "liar can" if index == 1 else "liars together can"
            sentences.append(
                (
                    prefix,
                    value,
                    f" {verb} stay invisible {kind}{who}{'' if index == 1 else '; fewer cannot'}.",
                )
            )
        if row["blind"]:
            sentences.append((f"{prefix}No meter tells the voltage of {row['blind']}.",))
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
        "can stay invisible, with so many": Shape.ALARM,
        "cannot": Shape.METER,
        "not known": Shape.OPEN,
        "no meter": Shape.NONE,
    }
    return draw_map(site, spots, width, legend=legend_of(meanings, spots))


ROWS = 30
"""So many rows a chart has at most; the largest are shown."""


# --- detectable ---------------------------------------------------------------------------------


def detectable(site: Site, found: Detectable) -> Section:
    """Which lies stay unnoticed, in volts; and what they do to the picture.

    Parameters
    ----------
    site, found
        The feeder, and what was found.
    """
    once, twice = _sure(found.risk), _sure(2.0 * found.risk)
    return Section(
        title="How large a lie must be",
        answers={
            Question.LIES: _sizes(site, found.meters, found.max_attacked, (once, twice)),
            Question.PICTURE: _picture(site, found.customers, found.max_attacked, twice),
        },
        figures=_size_figures(site, found, once, twice),
        tables=found.tables,
        columns={
            "hidden": f"up to this, V, with probability {once} at any one moment, nobody is named",
            "noticed": "beyond this somebody is beyond a limit of the monitor, with that probability",
            "named": "beyond this no other explanation is a rival, whoever else lies, with probability "
            f"{twice} at any one moment",
            "fits": "up to this the readings are those of some honest feeder, all errors at their worst: "
            "no test without false alarms can object",
            "identified": "beyond this every explanation by so few liars accuses the meter",
            "… alone": "the same without accomplices",
            "error": f"largest error of the monitor's reconstructed voltage, V, with probability {twice} for "
            "each customer at any one moment",
            "error fits": "how far apart two voltages can be that fit to the same readings, V",
        },
        assumptions=_assumed(site, found, once),
    )


def _size_figures(site: Site, found: Detectable, once: str, twice: str) -> tuple[Figure, ...]:
    liars = found.max_attacked
    (meters, unit), (customers, _) = (comparable(site, each) for each in (found.meters, found.customers))
    together = "alone" if liars == 1 else f"together with at most {liars - 1} more"
    return (
        Figure(
            "detectable-sizes",
            "What becomes of a lie, by its size",
            f"Each meter lying {together}. Left: nobody is named. Middle: it depends on the honest errors of "
            "the moment. Right: noticed, but another meter may be blamed. Beyond the number no explanation "
            f"without the lying meter is left.{_largest_only(meters)}",
            partial(_sizes_chart, meters, unit=unit),
        ),
        Figure(
            "detectable-map",
            "Where lies may stay unnoticed",
            f"Size from which a lie is noticed with {once}, {unit}, {liars} {plural(liars, 'liar')}"
            f"{' together' * (liars > 1)}. Larger discs, larger lies. "
            f"Largest at {_extreme(meters, 'meter', 'noticed')}.",
            partial(size_map, site, meters, who="meter", column="noticed", unit=unit),
        ),
        Figure(
            "detectable-picture",
            "How wrong the picture of the voltage can be",
            f"Largest error of each customer's reconstructed voltage, with {twice}, under {liars} unnoticed "
            f"{plural(liars, 'liar')}, {unit}. Largest at {_extreme(customers, 'customer', 'error')}.",
            partial(size_map, site, customers, who="customer", column="error", unit=unit),
        ),
    )


def _assumed(site: Site, found: Detectable, once: str) -> tuple[str, ...]:
    liars = found.max_attacked
    return (
        f"At most {liars} {plural(liars, 'meter lies', 'meters lie together')}; liars know the feeder, but "
        "not the honest errors of the moment.",
        "Sequential monitor, before it has learned the fixed errors of its meters; "
        f"{'balanced' if single_phase(site) else 'three-phase'} model; "
        "inverters in their deadbands; nominal voltage.",
        f"Sizes for the monitor hold with {once} at any one moment: honest errors Gaussian or uniform "
        f"with the deviations of the files, and every load draws {100.0 * found.share:g} % of its peak. "
        "Powers of customers without a meter are unknown within what they can draw and feed in.",
        "Proofs are for the linear effect of errors of loads; AC power flow was only simulated.",
        "That the monitor, once it looks, finds the liar, and that it goes on to, is not proved but was "
        "checked by simulation (gridsec study detectable --trials, and campaigns).",
        "Where the search for the worst collusion was cut short, sizes are what was proved until there: "
        "on the safe side.",
    )


def _sure(risk: float) -> str:
    return f"{100.0 * (1.0 - risk):.6g} %"


def _sizes(site: Site, meters: pd.DataFrame, liars: int, sure: tuple[str, str]) -> Finding:
    name = "detectable-meters"
    levels = f" Volts are those of each meter's own level{_percent(site)}." if _percent(site) else ""
    together = "alone" if liars == 1 else f"with up to {liars} lying together"
    never = meters[[math.isinf(v) or math.isnan(v) for v in meters["noticed"]]]
    lead: Sentence = (
        "All ",
        how_many(meters, name),
        f" meters, {together}, can be lied about by a little: for lies up to ",
        least(meters, name, "hidden", "V", digits=3, side=Side.BELOW),
        f" ({_extreme(meters, 'meter', 'hidden', smallest=True)}) to ",
        most(meters, name, "hidden", "V", digits=3, side=Side.BELOW),
        f" ({_extreme(meters, 'meter', 'hidden')}) nobody is named, with {sure[0]} at any one moment.",
        levels,
    )
    if len(never):
        noticed: Sentence = (
            f"For {listed(never['meter'].tolist())} no size is proved to be noticed. "
            "That is no proof that lies there are harmless.",
        )
        return Finding(Standing.PART, (lead, noticed))
    noticed = (
        "Larger lies may go unnoticed too, depending on the honest errors of the moment. Somebody is beyond "
        "a limit of the monitor, as surely, from ",
        least(meters, name, "noticed", "V", side=Side.ABOVE),
        f" ({_extreme(meters, 'meter', 'noticed', smallest=True)}) to ",
        most(meters, name, "noticed", "V", side=Side.ABOVE),
        f" ({_extreme(meters, 'meter', 'noticed')}) on.",
    )
    if not all(math.isfinite(v) for v in meters["named"]):
        named: Sentence = ("Not every liar is proved to be named, however large the lie.",)
        return Finding(Standing.PART, (lead, noticed, named))
    named = (
        "No explanation without the lying meter is left from ",
        least(meters, name, "named", "V", side=Side.ABOVE),
        " to ",
        most(meters, name, "named", "V", side=Side.ABOVE),
        f" on, with {sure[1]}. That much is proved; that the monitor's search then finds and names it is "
        "not, but was checked by simulation.",
    )
    return Finding(Standing.PART, (lead, noticed, named))


def _picture(site: Site, customers: pd.DataFrame, liars: int, sure: str) -> Finding:
    name = "detectable-customers"
    who = "a single lying meter" if liars == 1 else f"{liars} meters that lie together"
    lead: Sentence = (
        f"Unnoticed, {who} can make the voltage that the monitor shows wrong by at most ",
        least(customers, name, "error", "V", side=Side.ABOVE),
        f" (at {_extreme(customers, 'customer', 'error', smallest=True)}) to ",
        most(customers, name, "error", "V", side=Side.ABOVE),
        f" (at {_extreme(customers, 'customer', 'error')}), honest errors included, with {sure} for each "
        "customer at any one moment. "
        f"Nominal voltage is {told(site.nominal_volt)}{_percent(site)}.",
    )
    if not all(math.isfinite(v) for v in customers["error"]):
        return Finding(Standing.OPEN, (("No bound of the error is proved for every customer.",),))
    whoever: Sentence = (
        "Whatever the method, two voltages up to ",
        most(customers, name, "error_fits", "V", side=Side.ABOVE),
        " apart can fit to the same readings.",
    )
    how: Sentence = ("Proved for the linear effect of errors of loads, and checked by AC power flow.",)
    return Finding(Standing.PART, (lead, whoever, how))


def _percent(site: Site) -> str:
    """Where there are several, what 1 % of each is: volts of different levels do not compare."""
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
                "nobody is named",
                f"to {number(row['hidden'], 3, Side.BELOW)} {unit} nobody is named",
            ),
            Bar(
                a,
                b,
                "band0",
                "it depends on honest errors",
                f"noticed from {number(row['noticed'], 2, Side.ABOVE)} {unit} on",
            ),
            Bar(
                b,
                max(b, c),
                "band2",
                "noticed, another may be blamed",
                f"no explanation without it from {number(row['named'], 2, Side.ABOVE)} {unit} on",
            ),
        )
        data.append(Row(str(row["meter"]), bars, f"{number(row['named'], 2, Side.ABOVE)} {unit[0]}"))
    axis = "size of the lie, V at nominal voltage" if unit == "V" else f"size of the lie, {unit}"
    return rows(data, width, axis=axis)


# --- protect ------------------------------------------------------------------------------------


def protect(site: Site, found: Protect) -> Section:
    """Which meters to protect.

    Parameters
    ----------
    site, found
        The feeder, and what was found.
    """
    chosen = set(found.meters["meter"]) if len(found.meters) else set()
    return Section(
        title="Which meters to protect",
        answers={Question.PROTECT: _protection(site, found)},
        figures=(
            Figure(
                "protect-map",
                "Meters to protect",
                f"Shields: {listed(sorted(chosen))}."
                if chosen
                else "What was asked says nothing of this feeder."
                if found.no_answer
                else "None needs protection for what was asked.",
                partial(_protect_map, site, chosen),
            ),
        ),
        tables=found.tables,
        columns={
            "before, after": "largest hidden lie, V of the busbar's level, without and with protection"
            if found.goal.in_volts
            else "fewest liars that stay invisible, without and with protection; ∞: none can, however many",
            **({"alone": ALONE, "lie volt": "what was asked, V"} if found.goal.in_volts else {}),
            "least": "no fewer protected meters suffice",
            "attacks": "in how many of the listed attacks the meter takes part",
            "liars": "meters whose attack rules out anything cheaper",
        },
        assumptions=(
            f"At most {found.max_attacked} of the other meters lie; a protected meter cannot.",
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


ALONE = (
    "largest lie, V, that one unprotected meter hides by itself within honest errors, its powers being true"
)


def _no_protection(found: Protect) -> Finding:
    """A goal that asks nothing of this feeder."""
    what = "identified" if found.goal is Goal.IDENTIFY else "noticed"
    lead: Sentence = (
        f"No answer by this criterion, and no safety: that liars be {what} is asked of lies that fit exactly "
        "to powers that are known exactly, and none does, however small and however many lie.",
    )
    instead: Sentence = (
        "Lies that fit within honest errors were not looked at; to bound these, --goal contain. What hides "
        "behind a load that nobody knows: --unknown CUSTOMER. Lies that inverters forget within seconds: "
        "--attack any.",
    )
    return Finding(Standing.OPEN, (lead, instead))


def _protection(site: Site, found: Protect) -> Finding:
    if found.no_answer:
        return _no_protection(found)
    count, liars = len(found.meters), found.max_attacked
    others = f"any {liars} liars" if liars > 1 else "any single liar"
    among = " among the other meters" if count else ""
    several = bool((site.nominal_volt != site.nominal_volt[0]).any())
    there = f" where {site.nominal_volt[0]:.1f} V are nominal, or the same part elsewhere," if several else ""
    purpose = {
        Goal.IDENTIFY: f"{others}{among} would be identified",
        Goal.NOTICE: f"the lies of {others}{among} would be noticed",
        Goal.BOUND: f"no lie above {number(found.lie_volt)} V{there} of {others}{among} fits to an honest "
        "feeder, if all powers are reported truly",
        Goal.CONTAIN: f"no lie above {number(found.lie_volt)} V{there} of {others}{among} fits to an honest "
        "feeder, whatever powers they report",
    }[found.goal]
    scope = "" if found.goal.in_volts else " by someone who knows all other loads and errors exactly"
    if not count:
        lead: Sentence = (f"None for this purpose: even without protection, {purpose}{scope}.",)
    else:
        who = how_many(found.meters, "protect-meters")
        lead = (
            "Protect ",
            who,
            f" of {site.meters.size} meters: {listed(found.meters['meter'].tolist())}. "
            f"Then {purpose}{scope}.",
        )
    effect = _effect(found)
    proof: Sentence = ("No fewer suffice; other choices of as many may be as good.",)
    # What is proved in volts is proved for the linear effect of errors.
    sure = Standing.PART if found.gap or found.goal.in_volts else Standing.PROVED
    if not count and not math.isnan(found.before):
        return Finding(sure, (lead, effect))
    if found.gap:
        needed = Value(found.least, str(found.least), "protect-summary:least:row 0")
        proof = (
            "These suffice, but that they are the fewest is not proved; at least ",
            needed,
            " are needed.",
        )
    return Finding(sure, (lead, effect, proof))


def _effect(found: Protect) -> Sentence:
    """What protection changes."""
    before, after, alone = (
        Value(value, _cell(value, found.goal), f"protect-summary:{name}:row 0")
        for name, value in (("before", found.before), ("after", found.after), ("alone", found.alone))
    )
    if found.goal.in_volts:
        lead: Sentence = ("Largest lie that can hide: ", before, " without protection, ", after, " with it.")
        if math.isnan(found.alone):
            return lead
        return (*lead, " Unprotected, one meter hides up to ", alone, " by itself with its powers true.")
    lead = ("Fewest liars that stay invisible: ", before, " without protection, ", after, " with it")
    return (*lead, ", however many lie." if math.isinf(found.after) else ".")


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

"""Conclusion of each study in one sentence with sourced numbers, and its main figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd

from feeders.report.charts import Bar, ChartRow, rows
from feeders.report.drawing import Drawing, Figure
from feeders.report.html import StudyOutcome, section
from feeders.report.section_calibrate import proposals
from feeders.report.section_droop import proved_limits
from feeders.report.text import (
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
    quantity,
    sentence,
)
from feeders.studies.comparison import ComparisonRow

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.studies.calibrate.study import Calibrate
    from feeders.studies.campaign.study import Campaign
    from feeders.studies.detectable import Detectable
    from feeders.studies.droop.study import DroopStudy
    from feeders.studies.protect import Protect
    from feeders.studies.redundancy import Redundancy


def conclusion(site: Site, study: str, found: Any) -> Sentence:
    """Conclusion of a study on a feeder, in one sentence with its certainty; `found` is its result.

    An open question is UNDECIDED, and an unlimited quantity is stated in words.
    """
    standing = Standing.MEASURED
    if study != "compare":
        standing = next(iter(section(site, StudyOutcome(study, found)).answers.values())).standing
    return sentence(
        "Conclusion for {feeder} ({certainty}): {told}.",
        feeder=site.feeder.name,
        certainty=standing.value,
        told=_CONCLUSIONS[study](site, found),
    )


def figure(site: Site, study: str, found: Any) -> Figure | None:
    """Main figure of a study, if its result has one."""
    if study == "compare":
        return _compare_figure(found)
    return next(iter(section(site, StudyOutcome(study, found)).figures), None)


def _redundancy(_: Site, found: Redundancy) -> Sentence:
    parts: list[Sentence] = []
    for k, row in enumerate(found.summary.to_dict("records")):
        index, source = float(row["index"]), f"redundancy-summary:index:row {k}"
        kind = "for lasting attacks" if row["attack"] == "persistent" else "for any attack"
        live = row["case"] == "all live"
        case = "with all meters live:" if live else f"without {listed(found.silent)}:"
        lead = f"{'; ' * (k > 0)}{case} " if row["attack"] == "persistent" else " and "
        liars = f" ({listed(row['liars'].split())})" if row["liars"] else ""
        size: Sentence = (Value(index, number(index), source), f" {kind}{liars}")
        if math.isnan(index):
            size = (f"UNDECIDED {kind} (the search was stopped)",)
        elif math.isinf(index):
            size = (f"no set {kind}",)
        parts.append((lead, *size))
    return ("fewest manipulated meters that stay invisible, ", *(each for part in parts for each in part))


def _protect(site: Site, found: Protect) -> Sentence:
    if found.no_answer:
        return (
            f"none by the goal {found.goal}, as no attack fits exactly known powers; this proves no safety "
            "from attacks within honest errors",
        )
    name, count = "protect-summary", len(found.meters)

    def limit(column: str, value: float) -> str | Value:
        if math.isnan(value):
            return "UNDECIDED"
        if math.isinf(value):
            return "no set of meters"
        side = Side.ABOVE if found.goal.in_volts else Side.NEAR
        unit = "V" if found.goal.in_volts else plural(value, "meter")
        return quantity(value, unit, f"{name}:{column}:row 0", side=side)

    proof: Sentence = (" (no fewer suffice)",) if count else ()
    if found.gap:
        proof = (" (at least ", counted(found.least, f"{name}:least:row 0"), " are needed)")
    wanted = f"; required: at most {number(found.lie_volt)} V" if found.goal.in_volts else ""
    return sentence(
        "{lead}{count} of {of} meters{names}{proof}; {measure}: {before} without, {after} with "
        "protection{more}",
        lead="protect " if count else "no protection is needed: ",
        count=counted(count, f"{name}:protected:row 0"),
        of=str(site.meters.size),
        names=f", {listed(found.meters['meter'].tolist())}" if count else "",
        proof=proof,
        measure="largest hidden attack" if found.goal.in_volts else "smallest invisible set",
        before=limit("before", found.before),
        after=limit("after", found.after),
        more=wanted + _levels(site, "the busbar") * found.goal.in_volts,
    )


def _levels(site: Site, of: str) -> str:
    """Level of the volts of a sentence, if a feeder has several."""
    several = bool((site.nominal_volt != site.nominal_volt[0]).any())
    return f"; volts are those of {of}'s level" if several else ""


def _largest(table: pd.DataFrame, name: str, column: str, where: str) -> Sentence:
    """Largest value of a column with its place, or the number of places without a proved value."""
    open_ = int((~np.isfinite(table[column])).sum())
    if open_:
        return (f"UNDECIDED at {open_} of {len(table)} {where}s (no size is proved)",)
    place = str(table[where].iloc[int(table[column].argmax())])
    return (most(table, name, column, "V", side=Side.ABOVE), f" ({place})")


def _detectable(site: Site, found: Detectable) -> Sentence:
    meters, liars = found.meters, found.max_attacked
    return sentence(
        "with {liars}, every attack is noticed from {noticed} on and its meter named from {named} on before "
        "fixed errors are learned; once they are, every attack is found from {found} on; an unnoticed one "
        "shifts a shown voltage by at most {error}{levels}",
        liars=f"up to {liars} manipulated {plural(liars, 'meter')}",
        noticed=_largest(meters, "detectable-meters", "noticed", "meter"),
        named=_largest(meters, "detectable-meters", "named", "meter"),
        found=_largest(meters, "detectable-meters", "found", "meter"),
        error=_largest(found.customers, "detectable-customers", "error", "customer"),
        levels=_levels(site, "each place"),
    )


def _droop(site: Site, found: DroopStudy) -> Sentence:
    stability, band = found.tables["stability"], found.tables["band"].to_dict("records")[0]
    margin: Sentence = ()
    if found.verdict == "stable":
        margin = (" with slopes of any factor (no limit)",)
        if math.isfinite(float(stability["margin"].min())):
            times = least(stability, "droop-stability", "margin", side=Side.BELOW)
            margin = (" with slopes up to ", times, " times as steep")
    rest, always = (_shouted(str(each)) for each in (found.rest, found.always))
    kept = f"{rest} for slow load changes, {always} for arbitrary ones"
    limits = proved_limits(site, {str(name): value for name, value in band.items()}, str(found.always))
    hosting: list[str | Value] = []
    for k, row in enumerate(found.tables.get("hosting", pd.DataFrame()).to_dict("records")):
        source, kw = f"droop-hosting:capacity_kw:row {k}", float(row["capacity_kw"])
        hosting += [
            ", " if k else "; hosting capacity ",
            quantity(kw, "kW", source, digits=1, side=Side.BELOW),
            f" ({row['preset']}: {row['limit'] or 'no limit within the search'})",
        ]
    return (
        f"the fleet is {_shouted(str(found.verdict))}",
        *margin,
        f"; the voltage band is {kept}",
        *(limits or ("; no voltage limits are proved",)),
        *hosting,
    )


def _shouted(verdict: str) -> str:
    return verdict.upper() if verdict == "undecided" else verdict


def _campaign(_: Site, found: Campaign) -> Sentence:
    rate = min(found.plan.alarms_per_year)
    scenarios, liars = (
        table[table["alarms_per_year"] == rate] if len(table) else table
        for table in (found.scenarios, found.liars)
    )
    played = scenarios[scenarios["reason"] == ""]
    parts: list[str | Value] = ["no attack was simulated, so none is decided"]
    if len(liars):
        delays = liars["delay_s"][np.isfinite(liars["delay_s"])]
        low = float(found.false_names.loc[found.false_names["alarms_per_year"] == rate, "named_low"].iloc[0])
        sure = number(100.0 * low, 1, Side.BELOW)
        median = f", median delay {number(float(delays.median()), 1)} s" if len(delays) else ""
        parts = [
            f"{found.plan.estimator} named ",
            counted(len(delays), "campaign-liars:delay_s:finite"),
            " of ",
            counted(len(liars), "campaign-liars:rows"),
            f" manipulated devices (95 % confidence: at least {sure} %{median})",
        ]
    wronged = counted(int((played["falsely_named"] != "").sum()), "campaign-scenarios:falsely_named:filled")
    parts += ["; false accusations in ", wronged, f" of {len(played)} {plural(len(played), 'scenario')}"]
    undecided = played["undecided_s"].sum() / played["watched_s"].sum()
    parts.append(f"; UNDECIDED for {100.0 * undecided:.1f} % of the time")
    if len(played) < len(scenarios):
        parts.append(
            f"; {len(scenarios) - len(played)} scenarios could not be simulated, no result for these"
        )
    if not found.promises.empty:
        broken, lies = (int(found.promises[name].sum()) for name in ("broken", "lies"))
        parts.append(f"; guarantees broken by {broken} of {lies} attacks")
    return tuple(parts)


def _calibrate(_: Site, found: Calibrate) -> Sentence:
    def having(table: str, verdict: str) -> Value:
        count = int((found.tables[table]["verdict"] == verdict).sum())
        return counted(count, f"calibrate-{table}:verdict:count {verdict}")

    untold, frame = "cannot be told", found.tables
    sure, excluded = having("proposals", "proposed"), having("proposals", "excluded")
    decided = frame["proposals"][frame["proposals"]["verdict"] == "proposed"]
    return sentence(
        "{sure} {corrections} proposed{which} (if the files are right, at most {risk} for any proposal), "
        "{vague} found errors are UNDECIDED, {excluded}{outside} of {meters} meters are outside their class; "
        "not determined by the readings: {places} of {customers} customers and {lengths} of {lines} lines",
        sure=sure,
        corrections=plural(sure.value, "correction of the files is", "corrections of the files are"),
        which=f", {proposals(decided)}" if sure.value else "",
        risk=f"{100.0 * found.risk:g} %",
        vague=having("proposals", untold),
        excluded=(excluded, " meters with a changing error are excluded, ") if excluded.value else "",
        outside=having("meters", "outside its class"),
        meters=str(len(frame["meters"])),
        places=having("customers", untold),
        customers=str(len(frame["customers"])),
        lengths=having("lines", untold),
        lines=str(len(frame["lines"])),
    )


# --- compare ------------------------------------------------------------------------------------


def _totals(found: Sequence[ComparisonRow]) -> pd.DataFrame:
    """Sums over the cases, by estimator with numbers; best first: most named, fewest honest ones named."""
    table = pd.DataFrame([asdict(row) for row in found], columns=[f.name for f in fields(ComparisonRow)])
    sums = table[table["reason"] == ""].groupby("family", sort=False)
    return (
        sums[["named", "liars", "falsely_named"]]
        .sum()
        .sort_values(["named", "falsely_named"], ascending=[False, True], kind="stable")
    )


def _compare(_: Site, found: Sequence[ComparisonRow]) -> Sentence:
    totals, every = _totals(found), {row.family for row in found}
    if totals.empty:
        return ("none, as no estimator has numbers; the reasons are above",)
    words = ["no attack was simulated; "] * (not totals["liars"].any())
    for k, (family, row) in enumerate(totals.iterrows()):
        words.append(
            f"{'; ' * (k > 0)}{family} named {row['named']} of {row['liars']} manipulated devices and "
            f"{row['falsely_named']} honest ones"
        )
    silent = sorted(every.difference(map(str, totals.index)))
    words += [f"; no numbers for {listed(silent)}"] * bool(silent)
    return tuple(words)


def _compare_figure(found: Sequence[ComparisonRow]) -> Figure | None:
    if not (totals := _totals(found))["liars"].any():
        return None
    return Figure(
        "compare-named",
        "Manipulated devices named, by estimator",
        "Share of the manipulated devices that were named, over all cases; on the right the numbers, and in "
        "brackets the number of honest devices ever named.",
        partial(_compare_chart, totals),
    )


def _compare_chart(totals: pd.DataFrame, width: float) -> Drawing:
    data = [
        ChartRow(
            str(family),
            (Bar(0.0, 100.0 * row["named"] / max(row["liars"], 1), "fill-a", "named"),),
            f"{row['named']} of {row['liars']} ({row['falsely_named']})",
        )
        for family, row in totals.iterrows()
    ]
    return rows(data, width, axis="manipulated devices named, %")


_CONCLUSIONS: Final[Mapping[str, Callable[[Site, Any], Sentence]]] = {
    "redundancy": _redundancy,
    "protect": _protect,
    "detectable": _detectable,
    "droop": _droop,
    "campaign": _campaign,
    "calibrate": _calibrate,
    "compare": _compare,
}

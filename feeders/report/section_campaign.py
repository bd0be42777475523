"""Section of the campaign: the monitor in simulated attacks."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from feeders.report.charts import LINES, Bar, ChartRow, Curve, curves, rows
from feeders.report.drawing import Drawing, Figure
from feeders.report.text import (
    Finding,
    Question,
    Section,
    Sentence,
    Standing,
    Value,
    counted,
    listed,
    number,
    plural,
    quantity,
    sentence,
)
from feeders.simulation.attacks import AttackKind
from feeders.simulation.trial import TrialMeterErrors

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site
    from feeders.simulation.trial import LoadError
    from feeders.studies.campaign.plan import CampaignPlan
    from feeders.studies.campaign.study import Campaign


# Columns on the page; the files have all.
_BY = {"by_kind": "kind", "by_size": "size", "by_place": "place", "by_liars": "liars"}
_UNITS = {AttackKind.DRIFT: " %/min", AttackKind.REPLAY: " s", AttackKind.CLOCK_SHIFT: " s"}
_ERRORS = {
    TrialMeterErrors.SITE: "those of the feeder's files",
    TrialMeterErrors.WHITE: "white noise of 0.2 %, no fixed error",
    TrialMeterErrors.REAL: "fixed within 0.5 %, and jitter of 0.05 %",
}
_SHOWN = (
    *("scenarios", "exact", "named", "named_low", "named_high", "false", "delay_median_s"),
    *("error_liars_worst", "error_others_worst", "undecided"),
)
_SCENARIOS = (
    *("scenario", "kind", "size", "liars", "named", "missed", "falsely_named", "delay_s"),
    *("undecided_s", "clean_lying_s", "error_liars", "error_others", "reason"),
)


def campaign(_: Site, found: Campaign) -> Section:
    """Section of the campaign."""
    plan = found.plan
    rate = min(plan.alarms_per_year)
    return Section(
        answers={Question.MONITOR: _behaved(found, rate)},
        figures=_figures(found, rate) if len(found.liars) else (),
        tables=found.tables,
        shown={name: (by, *_SHOWN) if by == "kind" else ("kind", by, *_SHOWN) for name, by in _BY.items()}
        | {"scenarios": _SCENARIOS},
        assumptions=(
            f"{plan.scenarios} scenarios of {plan.duration_s:g} s at {plan.step_s:g} s on days of profiles, "
            f"seed {plan.seed}; the truth is full AC power flow with the inverters in closed loop.",
            f"Monitor: {plan.estimator}, set for {rate:g} {plural(rate, 'false alarm')} per "
            f"year; powers known {_known(plan.load_error)}; errors of meters: {_ERRORS[plan.meters]}.",
            "Simulated attacks are examples: the outcome of others may differ.",
        ),
    )


def _known(error: LoadError | None) -> str:
    if error is None:
        return "as stated in the feeder's files for registers, power factors and unmetered customers"
    return f"within {error.p_kw:g} kW and {error.q_kvar:g} kvar (1 sigma)"


def _figures(found: Campaign, rate: float) -> tuple[Figure, ...]:
    return (
        Figure(
            "campaign-named",
            "Manipulated devices named, by kind and size",
            "Share of the manipulated devices that were named, with the 95 % interval of the true share; "
            "on the right the numbers. Percentages on the left are of nominal voltage.",
            partial(_named_chart, found.plan, _at(found.by_size, rate)),
        ),
        Figure(
            "campaign-delay",
            "Delay",
            "Share of the manipulated devices named within some time of the onset, by kind. A curve "
            "that stays below 100 % has devices that were never named.",
            partial(_delay_chart, _at(found.liars, rate)),
        ),
        Figure(
            "campaign-error",
            "Error of the shown voltage",
            "Largest error of the reconstructed voltage, % of nominal, by kind; at manipulated meters / at "
            "the others.",
            partial(_error_chart, _at(found.by_kind, rate)),
        ),
    )


def _at(table: pd.DataFrame, rate: float) -> pd.DataFrame:
    return table[table["alarms_per_year"] == rate] if len(table) else table


def _behaved(found: Campaign, rate: float) -> Finding:
    seen, liars = _at(found.scenarios, rate), _at(found.liars, rate)
    played = seen[seen["reason"] == ""]
    impossible = len(seen) - len(played)
    row = _at(found.false_names, rate)
    sentences: list[Sentence] = []
    if len(liars):
        share, low, high = (float(row[name].iloc[0]) for name in ("named", "named_low", "named_high"))
        sentences.append(
            sentence(
                "Of {liars} manipulated devices in {played} simulated scenarios, the monitor named {share} "
                "(true share with 95 % confidence: {low} to {high}).",
                liars=counted(len(liars), "campaign-liars:rows"),
                played=counted(len(played), "campaign-scenarios:reason:empty"),
                share=Value(share, _percent(share), "campaign-false_names:named:row 0"),
                low=_percent(low),
                high=_percent(high),
            )
        )
        sentences += _missed(found, rate)
    else:
        sentences.append(("No scenario has an attack: no result on attacks.",))
    wronged = int((played["falsely_named"] != "").sum())
    sentences.append(
        (
            "False accusations: ",
            counted(wronged, "campaign-scenarios:falsely_named:filled"),
            f" of {len(played)} {plural(len(played), 'scenario')}.",
            *_worst(played),
        )
    )
    sentences += _open(played, impossible)
    return Finding(Standing.MEASURED if len(liars) else Standing.OPEN, tuple(sentences))


def _missed(found: Campaign, rate: float) -> list[Sentence]:
    """Missed devices, and delays of the others."""
    liars = _at(found.liars, rate)
    never = liars[~np.isfinite(liars["delay_s"].to_numpy())]
    delay = liars["delay_s"][np.isfinite(liars["delay_s"].to_numpy())]
    soon = f" Median delay of the others: {number(float(delay.median()), 1)} s." if len(delay) else ""
    if never.empty:
        return [(f"None was missed.{soon.replace('Median delay of the others', 'Median delay')}",)]
    total = liars.groupby("kind").size()
    kinds = [f"{kind} ({count} of {total[kind]})" for kind, count in never.groupby("kind").size().items()]
    missed = counted(len(never), "campaign-liars:delay_s:infinite")
    return [(missed, f" {plural(len(never), 'was', 'were')} missed: {listed(kinds)}.{soon}")]


def _worst(played: pd.DataFrame) -> Sentence:
    lied = played[
        np.isfinite(played["error_others"].to_numpy()) | np.isfinite(played["error_liars"].to_numpy())
    ]
    if lied.empty or not (played["error_liars"].notna()).any():
        return ()
    worst = played["error_liars"].max()
    shown = f"{number(float(worst))} %" if math.isfinite(worst) else "unbounded,"
    return (
        " Largest error of the shown voltage at manipulated meters: ",
        Value(float(worst), shown, "campaign-scenarios:error_liars:max"),
        " of nominal.",
    )


def _open(played: pd.DataFrame, impossible: int) -> list[Sentence]:
    """Undecided time, undetected time, and scenarios without a simulation."""
    watched, undecided, clean = (
        quantity(float(played[name].sum()), "s", f"campaign-scenarios:{name}:sum", digits=0)
        for name in ("watched_s", "undecided_s", "clean_lying_s")
    )
    times = sentence(
        "Of {watched} monitored, the verdict was UNDECIDED for {undecided}, and CLEAN for {clean} with an "
        "attack that was not noticed yet, or never.",
        watched=watched,
        undecided=undecided,
        clean=clean,
    )
    if not impossible:
        return [times]
    count = counted(impossible, "campaign-scenarios:reason:filled")
    noun = plural(impossible, "scenario")
    return [times, (count, f" {noun} could not be simulated: no result for these.")]


def _percent(share: float) -> str:
    if math.isnan(share):
        return "?"
    text = f"{100.0 * share:.1f}".removesuffix(".0")
    if text == "100" and share < 1.0:
        text = "99.9"
    return f"{text} %"


def _named_chart(plan: CampaignPlan, table: pd.DataFrame, width: float) -> Drawing:
    tricks = {kind.name: kind for kind in plan.kinds}
    data = []
    for row in table[table["liars_told"] > 0].to_dict("records"):
        share, low, high = (100.0 * float(row[name]) for name in ("named", "named_low", "named_high"))
        bars = (
            Bar(0.0, share, "fill-a", "named"),
            Bar(low, high, "fill-ink", "95 % interval", f"{low:.0f} to {high:.0f} %", inset=8.4),
        )
        told = int(row["liars_told"])
        kind = tricks.get(row["kind"])
        # Sizes of kinds in volts are factors.
        unit = "" if kind is None or kind.volts or kind.together else _UNITS.get(kind.trick, " %")
        size = "" if kind is not None and kind.trick is AttackKind.STUCK else f" {row['size']:g}{unit}"
        data.append(ChartRow(f"{row['kind']}{size}", bars, f"{round(share * told / 100.0)} of {told}"))
    return rows(data, width, axis="manipulated devices named, %")


def _delay_chart(liars: pd.DataFrame, width: float) -> Drawing:
    finite = liars["delay_s"][np.isfinite(liars["delay_s"].to_numpy())]
    last = max(float(finite.max()) if len(finite) else 1.0, 10.0)
    drawn = []
    for k, (kind, group) in enumerate(liars.groupby("kind", sort=True)):
        delays = np.sort(np.maximum(group["delay_s"].to_numpy(dtype=np.float64), 1.0))
        x, y = [0.0], [0.0]
        for j, delay in enumerate(delays[np.isfinite(delays)]):
            x += [math.log10(delay)] * 2
            y += [100.0 * j / delays.size, 100.0 * (j + 1) / delays.size]
        x.append(math.log10(last))
        y.append(y[-1])
        drawn.append(Curve(tuple(x), tuple(y), LINES[k % len(LINES)], str(kind)))
    return curves(
        drawn, width, x="s after the onset", y="manipulated devices named, %", high=100.0, decades=True
    )


def _error_chart(table: pd.DataFrame, width: float) -> Drawing:
    data = []
    for row in table.to_dict("records"):
        liars, others = (float(row[f"error_{place}_worst"]) for place in ("liars", "others"))
        bars = [
            Bar(0.0, value, look, meaning, f"{number(value)} %", inset)
            for value, look, meaning, inset in (
                (liars, "fill-b", "manipulated meters", 3.0),
                (others, "fill-a", "others", 6.5),
            )
            if math.isfinite(value)
        ]
        shown = " / ".join(number(v) for v in (liars, others) if not math.isnan(v))
        data.append(ChartRow(str(row["kind"]), tuple(bars), shown))
    return rows(data, width, axis="largest error of the shown voltage, % of nominal")

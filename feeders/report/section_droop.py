"""Section of the droop fleet: stability, voltage band, hosting capacity."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

from feeders.format.validation import told
from feeders.report.charts import LINES, Bar, ChartRow, Curve, curves, rows
from feeders.report.drawing import Drawing, Figure
from feeders.report.maps import comparable, single_phase
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
    number,
    quantity,
)

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site
    from feeders.studies.droop.study import DroopOptions, DroopStudy


ROWS = 30
"""Largest number of customers in a chart: those with the widest voltage limits."""

STABLE, UNSTABLE, KEPT, VIOLATED, UNDECIDED = "stable", "unstable", "kept", "violated", "undecided"


def droop(site: Site, found: DroopStudy) -> Section:
    """Section of the droop fleet."""
    given, own = found.options, site.tables.meta.limits
    low, high = (
        mine if asked is None else asked
        for asked, mine in ((given.v_min, own.v_min_pu), (given.v_max, own.v_max_pu))
    )
    volt = site.feeder.base_volt
    one = bool((site.nominal_volt == volt).all())
    band = f"{number(low * volt, 1)} to {number(high * volt, 1)} V" if one else f"{low:g} to {high:g} pu"
    ends = given.v0_low, given.v0_high
    busbar = f"at {ends[0]:g} pu" if ends[0] == ends[1] else f"from {ends[0]:g} to {ends[1]:g} pu"
    alone = "" if ends[0] == ends[1] or single_phase(site) else ", each phase independently"
    every = "continuously" if not given.interval_s else f"every {given.interval_s:g} s"
    delay = f", with a dead time of {given.dead} intervals" if given.dead else ""
    hosts = "hosting" in found.tables
    return Section(
        answers={Question.FLEET: _fleet(site, found, band, busbar)},
        figures=_figures(site, found, (low, high), band),
        tables=found.tables,
        assumptions=(
            f"Inverters: {given.preset or 'as in the files'}; sampled {every}{delay}. "
            f"{'Balanced' if single_phase(site) else 'Three-phase'} power flow.",
            f"Any loads up to {100.0 * given.load_high:g} % and generation up to {100.0 * given.pv_high:g} % "
            f"of their peaks; busbar {busbar}{alone}; band {band}.",
            *((_conditions(given),) if hosts else ()),
        ),
    )


def _conditions(given: DroopOptions) -> str:
    """Conditions of hosting, as a sentence."""
    return (
        f"Hosting: loads at {100.0 * given.hosting_load:g} % of their peaks, the busbar at "
        f"{given.v0_high:g} pu, all generation at its peak and with new inverters. In random orders, one "
        f"customer after the other gets a unit of {given.unit_kw:g} kW."
    )


# --- sentences ----------------------------------------------------------------------------------


def _fleet(site: Site, found: DroopStudy, band: str, busbar: str) -> Finding:
    stability, kept = found.tables["stability"], found.tables["band"].to_dict("records")
    fleet = {str(name): value for name, value in kept[0].items()}
    verdict, rest, always = str(found.verdict), str(fleet["rest"]), str(fleet["always"])
    limits, broken = proved_limits(site, fleet, always), _witness(site, found.tables.get("witness"))
    kept_or_not = _band((rest, always), band, busbar, limits=limits, broken=broken)
    sentences = [_stability(stability, verdict, busbar), kept_or_not]
    without = [row for row in kept if row["case"] == "without"]
    if without and (rest, always) != (str(without[0]["rest"]), str(without[0]["always"])):
        bare = str(without[0]["always"])
        word = "neither proved to be kept nor violated" if bare == UNDECIDED else bare
        sentences.append((f"Without the inverters' reactive power the band is {word}.",))
    sentences += _hosting(found)
    open_ = [verdict == UNDECIDED, UNDECIDED in (rest, always)]
    standing = Standing.OPEN if all(open_) else Standing.PART if any(open_) else Standing.PROVED
    return Finding(standing, tuple(sentences))


def _stability(stability: pd.DataFrame, verdict: str, busbar: str) -> Sentence:
    name = "droop-stability"
    if verdict == STABLE:
        margin: Sentence = ()
        if math.isfinite(float(stability["margin"].min())):
            times = least(stability, name, "margin", digits=1, side=Side.BELOW)
            margin = (" Proved margin: all slopes may be ", times, " times as large.")
        lead = f"Stable: proved for constant loads anywhere within their limits, the busbar {busbar}."
        return (lead, *margin)
    which = [str(p) for p, v in zip(stability["point"], stability["verdict"], strict=True) if v == verdict]
    count = counted(len(which), f"{name}:verdict:count {verdict}")
    where: Sentence = (" (", count, f" of {len(stability)} cases: {listed(which)})")
    if verdict == UNSTABLE:
        return ("Unstable: the fleet leaves its equilibrium, in the proof and in AC simulation", *where, ".")
    why = listed(list(dict.fromkeys(str(w) for w in stability["why"].dropna() if w)))
    reason = f": {why}" if why else ""
    return ("Stability of the fleet: not proved", *where, f"{reason}. It may oscillate.")


def _band(kept: tuple[str, str], band: str, busbar: str, *, limits: Sentence, broken: Sentence) -> Sentence:
    rest, always = kept
    if always == KEPT:
        lead = f"Voltage band from {band}: kept for arbitrary changes of loads within limits, busbar {busbar}"
        return (lead, *limits, ".")
    if rest == KEPT:
        sudden = "sudden changes can violate it" if always == VIOLATED else "not proved for sudden changes"
        lead = f"Voltage band from {band}: kept for slow load changes, busbar {busbar}; {sudden}"
        return (lead, *limits, *broken, ".")
    if VIOLATED in (rest, always):
        when = "in equilibrium" if rest == VIOLATED else "during load changes"
        return (
            f"Voltage band from {band}: violations are possible {when}, busbar {busbar}",
            *broken,
            ".",
        )
    return (f"Voltage band from {band}: not proved, and no loads that violate it were found.",)


def _witness(site: Site, table: pd.DataFrame | None) -> Sentence:
    """Largest violation of the band by a witness, as the end of a sentence."""
    if table is None or not table["beyond"].any():
        return ()
    nominal = dict(zip(site.feeder.customers, site.customer_nominal, strict=True))
    away = (table["v_volt"] / table["customer"].map(nominal) - 1.0).abs()
    k = int(away.where(table["beyond"]).fillna(-1.0).to_numpy().argmax())
    row = table.iloc[k]
    volt = quantity(float(row["v_volt"]), "V", f"droop-witness:v_volt:row {k}", digits=1)
    return ("; the loads of table witness give ", volt, f" at {row['customer']}, by AC power flow")


def proved_limits(site: Site, fleet: dict[str, object], always: str) -> Sentence:
    """Proved limits: at all times if that keeps the band, in equilibrium otherwise."""
    which = "" if always == KEPT else "_rest"
    low, high = (float(str(fleet[f"{end}{which}_volt"])) for end in ("low", "high"))
    if not (math.isfinite(low) and math.isfinite(high)):
        return ()
    several = bool((site.nominal_volt != site.nominal_volt[0]).any())
    there = f" at the places nearest to the band's ends (nominal: {told(site.nominal_volt)}):"
    return (
        f"; proved limits{there if several else ''} ",
        quantity(low, "V", f"droop-band:low{which}_volt:row 0", digits=1, side=Side.BELOW),
        " and ",
        quantity(high, "V", f"droop-band:high{which}_volt:row 0", digits=1, side=Side.ABOVE),
    )


def _hosting(found: DroopStudy) -> list[Sentence]:
    table = found.tables.get("hosting")
    if table is None:
        return []
    words: list[str | Value] = [
        "Hosting capacity, with generation distributed as in the files, up to the first violated limit: "
    ]
    for k, row in enumerate(table.to_dict("records")):
        name = "without reactive power" if row["preset"] == "none" else f"with {row['preset']}"
        source = f"droop-hosting:capacity_kw:row {k}"
        size = quantity(float(row["capacity_kw"]), "kW", source, digits=0, side=Side.BELOW)
        words += ["; " if k else "", size]
        unsure = {UNDECIDED: "; stability of the fleet there not proved", UNSTABLE: "; unstable there"}
        limit = row["limit"] or "no limit found"
        words.append(f" {name} ({limit}{unsure.get(str(row.get('verdict')), '')})")
    return [(*words, ".")]


# --- figures ------------------------------------------------------------------------------------


def _figures(site: Site, found: DroopStudy, limits: tuple[float, float], band: str) -> tuple[Figure, ...]:
    (customers, unit), tables = comparable(site, found.tables["customers"]), found.tables
    whole = site.feeder.base_volt if unit == "V" else 100.0
    ends = limits[0] * whole, limits[1] * whole
    out = []
    known = customers[[math.isfinite(v) for v in customers["low_volt"] + customers["high_volt"]]]
    if len(known):
        some = f" The {ROWS} widest of {len(known)}." if len(known) > ROWS else ""
        out.append(
            Figure(
                "droop-band",
                "Proved limits of every customer's voltage",
                f"With any loads and generation within their limits. The band is {band}.{some}",
                partial(_band_chart, known, unit, ends),
            )
        )
    if {"steps", "trajectories"} <= tables.keys() and len(tables["trajectories"]):
        steps = [f"{row['step']}: {row['outcome']}" for row in tables["steps"].to_dict("records")]
        out.append(
            Figure(
                "droop-steps",
                "Step responses of the inverters",
                "AC simulation from just after the step on, at the customer with the worst final voltage. "
                "Load: from 20 to 80 % of its peak; cloud: generation from its peak to 20 %; tap: the "
                f"busbar up by 0.025 pu. {'; '.join(steps)}.",
                partial(_steps_chart, tables["steps"], *comparable(site, tables["trajectories"])),
            )
        )
    if "hosting_probability" in tables:
        out.append(
            Figure(
                "droop-hosting",
                "Hosting capacity",
                "Share of random orders of units in which this generation violates a limit, by preset.",
                partial(_hosting_chart, tables["hosting_probability"]),
            )
        )
    return tuple(out)


def _band_chart(customers: pd.DataFrame, unit: str, ends: tuple[float, float], width: float) -> Drawing:
    wide = (customers["high_volt"] - customers["low_volt"]).sort_values(ascending=False, kind="stable")
    data = []
    for row in customers.loc[wide.index[:ROWS]].to_dict("records"):
        low, high, low_rest, high_rest = (
            float(row[k]) for k in ("low_volt", "high_volt", "low_rest_volt", "high_rest_volt")
        )
        bars = [Bar(low, high, "band1", "at all times")]
        if math.isfinite(low_rest + high_rest):
            bars.append(Bar(low_rest, high_rest, "fill-a", "for slow load changes", inset=6.0))
        data.append(
            ChartRow(
                f"{row['customer']}, {row['phase']}" if "phase" in row else str(row["customer"]),
                tuple(bars),
                f"{number(low, 1, Side.BELOW)} to {number(high, 1, Side.ABOVE)} {unit[0]}",
            )
        )
    span = float(customers["high_volt"].max() - customers["low_volt"].min())
    start = float(customers["low_volt"].min()) - 0.05 * span
    return rows(data, width, axis=f"voltage, {unit}", start=start, limits={"limit of the band": ends})


def _steps_chart(steps: pd.DataFrame, runs: pd.DataFrame, unit: str, width: float) -> Drawing:
    drawn = []
    for k, row in enumerate(steps.to_dict("records")):
        own = runs[(runs["step"] == row["step"]) & (runs["customer"] == row["worst_customer"])]
        x, y = (tuple(float(v) for v in own[name]) for name in ("t_s", "v_volt"))
        meaning = f"{row['step']}: {row['outcome']}"
        drawn.append(Curve(x, y, LINES[k % len(LINES)], meaning))
    return curves(drawn, width, x="s after the step", y=f"voltage, {unit}")


def _hosting_chart(table: pd.DataFrame, width: float) -> Drawing:
    drawn = []
    for k, (preset, some) in enumerate(table.groupby("preset", sort=False)):
        x, y = [0.0], [0.0]
        for kw, share in zip(some["capacity_kw"], some["probability"], strict=True):
            x += [float(kw)] * 2
            y += [y[-1], 100.0 * float(share)]
        name = "without reactive power" if preset == "none" else str(preset)
        drawn.append(Curve(tuple(x), tuple(y), LINES[k % len(LINES)], name))
    return curves(drawn, width, x="generation, kW", y="orders with a violated limit, %", high=100.0)

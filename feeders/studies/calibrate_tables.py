"""The tables of the study `calibrate`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd
from scipy.stats import norm

from feeders.studies.calibrate_corrections import PLACES, Correction, Kind
from feeders.studies.calibrate_readings import blind
from feeders.studies.calibrate_search import LENGTH_SPREAD, SHORTEST, concerned
from gridsec.studies.calibrate import explain
from gridsec.studies.calibrate_model import lengthened

if TYPE_CHECKING:
    from feeders.schema import FeederTables
    from feeders.studies.calibrate_search import Round, Verdict
    from gridsec.arrays import Floats

__all__ = ["customers", "errors", "final", "lines", "loads", "meters", "present", "told"]

AS_FILED, PROPOSED, UNTOLD, EXCLUDED = "as in the files", "proposed", "cannot be told", "excluded"
UNASKED: Final = "not looked for"
UNREAD: Final = "phase not read"

WIDE: Final = 1.96
"""Half-width of intervals, in standard errors: 95 %."""

VAGUE: Final = 0.7
"""What the readings leave of a prior standard deviation if they say nothing: more than this."""

ALIKE: Final = 0.98
"""Correlation of the effects of two lines that are the same."""

UNSURE_LENGTH: Final = 0.25
"""A length less certain than this is not known."""

_SHOWN: Final = 5

_COLUMNS: Final = (
    *("kind", "what", "now", "proposed", "estimate", "std", "low", "high"),
    *("log_factor", "confidence", "verdict", "alternatives"),
)


def meters(now: Round, risk: float) -> pd.DataFrame:
    """Bias of every meter."""
    at, site = now.given.where["bias"], now.net.site
    bias, std, prior = 100.0 * now.fit.estimate[at], 100.0 * now.fit.std[at], 100.0 * now.given.spread[at]
    count = now.series.seen.sum(axis=0)
    # A bias is told relative to the busbar's meter, which may be off the other way.
    limit = 100.0 * (site.accuracy.class_fraction + site.accuracy.busbar_class)
    sure = norm.isf(risk / (2.0 * max(at.size, 1)))

    unread = blind(site, now.state.unread)

    def verdict(j: int) -> str:
        if site.meter_ids[j] in unread:
            return UNREAD
        if site.meter_ids[j] in now.state.excluded:
            return EXCLUDED
        if not count[j] or std[j] > VAGUE * prior[j]:
            return UNTOLD
        if abs(bias[j]) > limit[j] + sure * std[j]:
            return "outside its class"
        return "biased" if abs(bias[j]) > sure * std[j] else "within error"

    return pd.DataFrame(
        {
            "meter": site.meter_ids,
            "customer": [site.feeder.customers[k] for k in site.meters],
            "frames": count,
            "bias_percent": bias,
            "std_percent": std,
            "low_percent": bias - WIDE * std,
            "high_percent": bias + WIDE * std,
            "verdict": [verdict(j) for j in range(at.size)],
        }
    )


def lines(
    now: Round, tolerance: float, kinds: Collection[Kind]
) -> tuple[pd.DataFrame, list[tuple[str, ...]]]:
    """Length of every line, or lines in series, alone; and the ids of the lines of each row."""
    net, rows = now.net, now.state.tables.lines
    names = [tuple(rows[k].line for k in chain) for chain in net.lines]
    free = np.array([any(name in now.state.lengths for name in chain) for chain in names])
    effect = np.where(now.series.seen[:, :, None], lengthened(net.places, now.series), 0.0)
    z = now.whiten(effect).reshape(-1, len(names))
    own = np.where(free, LENGTH_SPREAD, tolerance)
    shift, std, same = explain(now.fit, z, own, ALIKE)
    base = np.array([now.state.lengths.get(chain[0], 1.0) for chain in names])
    factor, std = base * (1.0 + shift), base * std
    unknown = ~(std < UNSURE_LENGTH)
    right = AS_FILED if Kind.LENGTH in kinds else UNASKED
    shown = [" ".join(chain[:1] if len(chain) == 1 else (chain[0], "to", chain[-1])) for chain in names]
    frame = pd.DataFrame(
        {
            "lines": shown,
            "from_bus": [net.feeder.buses[k] for k in net.ends[:, 0]],
            "to_bus": [net.feeder.buses[k] for k in net.ends[:, 1]],
            "factor": np.where(unknown, np.nan, factor),
            "std": np.where(unknown, np.nan, std),
            "low": np.where(unknown, 0.0, factor - WIDE * std),
            "high": np.where(unknown, np.inf, factor + WIDE * std),
            "same": [
                _some([shown[k] for k in np.flatnonzero(row) if k != own_row])
                for own_row, row in enumerate(same)
            ],
            "verdict": np.where(unknown, UNTOLD, np.where(free, PROPOSED, right)),
        }
    )
    return frame, names


def final(
    found: Sequence[dict[str, Any]],
    wrongs: Sequence[Correction],
    length: pd.DataFrame,
    ids: Sequence[tuple[str, ...]],
) -> tuple[pd.DataFrame, tuple[Correction, ...]]:
    """Proposals, lengths as they were estimated last, and those corrections that are sure."""
    rows = zip(length.to_dict("records"), ids, strict=True)
    by_line = {name: row for row, chain in rows for name in chain}
    vague = {
        name
        for row, wrong in zip(found, wrongs, strict=True)
        if row["alternatives"] and wrong.kind in PLACES
        for name in wrong.names
    }
    out, sure, told_of = [], [], set[tuple[str, ...]]()
    for row, first in zip(found, wrongs, strict=True):
        wrong = first
        if wrong.kind is Kind.LENGTH:
            if wrong.names in told_of:
                continue
            told_of.add(wrong.names)
            last = by_line[wrong.names[0]]
            known = last["verdict"] != UNTOLD
            factor = float(last["factor"]) if known else wrong.factor
            wrong = Correction(wrong.kind, wrong.names, factor=factor)
            numbers = {name: float(last[name]) for name in ("std", "low", "high")} | {"estimate": factor}
        else:
            estimate, std = row["estimate"], row["std"]
            numbers = {
                "estimate": estimate,
                "std": std,
                "low": estimate - WIDE * std,
                "high": estimate + WIDE * std,
            }
        decided = not row["alternatives"] and wrong.factor >= SHORTEST
        # A customer's bus and phases belong together: one is not written without the other.
        decided &= wrong.kind not in PLACES or vague.isdisjoint(wrong.names)
        verdict = EXCLUDED if wrong.kind is Kind.METER else PROPOSED if decided else UNTOLD
        if decided and wrong.kind is not Kind.METER:
            sure.append(wrong)
        out.append(
            {
                "kind": str(wrong.kind),
                "what": _who(wrong) if wrong.kind is not Kind.LENGTH else " ".join(wrong.names),
                "now": row["now"],
                "proposed": _proposed(wrong, row),
                **{name: numbers[name] for name in ("estimate", "std", "low", "high")},
                "log_factor": row["log_factor"],
                "confidence": row["confidence"],
                "verdict": verdict,
                "alternatives": _some(row["alternatives"]),
            }
        )
    return pd.DataFrame(out, columns=list(_COLUMNS)), tuple(sure)


def _proposed(wrong: Correction, row: dict[str, Any]) -> str:
    if wrong.kind is Kind.METER:
        when = pd.to_datetime([row["since"], row["until"]], unit="s", utc=True).strftime("%Y-%m-%d %H:%M")
        return f"its error is another from {when[0]} to {when[1]} UTC"
    if wrong.kind is Kind.LENGTH:
        return f"{wrong.factor:.3g} times as long"
    if wrong.exchange:
        return "phases exchanged"
    return {Kind.BUS: wrong.bus, Kind.PHASE: wrong.phases}.get(wrong.kind, "meters exchanged")


def _who(wrong: Correction) -> str:
    """Subject of an error; of a lateral its first line and its customers."""
    if wrong.exchange:
        on, lines_on = wrong.on
        parts = []
        for phase in dict.fromkeys(on.values()):
            names = _some([name for name, own in on.items() if own == phase])
            first = next((line for line, own in lines_on.items() if own == phase), "")
            parts.append(f"{first} with {names}" if first else names)
        return " and ".join(parts)
    if wrong.lines:
        return f"{wrong.lines[0]} with {_some(wrong.names)}"
    return " and ".join(wrong.names[:2])


def present(tables: FeederTables, wrong: Correction) -> str:
    """What files say about it."""
    rows = {row.customer: row for row in tables.customers}
    if wrong.kind is Kind.BUS:
        return rows[wrong.names[0]].bus
    if wrong.exchange:
        first = {phases: name for name, phases in reversed(wrong.on[0].items())}
        return " and ".join(rows[first[phases]].phases for phases in dict.fromkeys(wrong.on[0].values()))
    if wrong.lines:
        return next(row.phases for row in tables.lines if row.line == wrong.lines[0])
    if wrong.kind is Kind.PHASE:
        return rows[wrong.names[0]].phases
    if wrong.kind is Kind.SWAP:
        return " and ".join(rows[name].meter for name in wrong.names)
    return ""


def told(wrong: Correction) -> str:
    """An alternative in a few words."""
    who = _who(wrong)
    if wrong.kind is Kind.BUS:
        return f"{who} at {wrong.bus}"
    if wrong.exchange:
        return f"{who} with exchanged phases"
    if wrong.kind is Kind.PHASE:
        return f"{who} on {wrong.phases}"
    return {Kind.SWAP: f"{who} swapped", Kind.LENGTH: f"length of {who}"}.get(
        wrong.kind, f"error of {who} changes"
    )


def customers(
    now: Round, said: Verdict, wrongs: Sequence[Correction], risk: float, kinds: Collection[Kind]
) -> pd.DataFrame:
    """Place of every customer, and which others the readings do not rule out."""
    net, right = now.net, _as_filed(now.state.tables, kinds)
    moved = {name for wrong in wrongs if wrong.kind in (*PLACES, Kind.SWAP) for name in wrong.names}
    excluded = {*now.state.excluded}.difference(blind(net.site, now.state.unread))
    open_from = -float(np.log(1.0 / risk))
    others: dict[int, list[tuple[float, str]]] = {}
    for guess, factor in zip(said.guesses, said.found.log_factor, strict=True):
        for customer in concerned(now, guess) if guess.kind in PLACES else ():
            stays = guess.lateral or guess.exchange
            bus = net.feeder.buses[net.feeder.bus[customer] if stays else guess.other]
            on = guess.phases
            if guess.exchange:
                on = guess.phases[customer not in net.parts[guess.subject].customers]
            place = f"{bus} {on}" if guess.kind is Kind.PHASE else bus
            others.setdefault(customer, []).append((float(factor), place))
    out = []
    for k, row in enumerate(now.state.tables.customers):
        ranked = sorted(others.get(k, []), reverse=True)
        possible = [place for factor, place in ranked if factor > open_from]
        untold = possible or (not ranked and right != UNASKED)
        verdict = UNTOLD if untold else PROPOSED if row.customer in moved else right
        out.append(
            {
                "customer": row.customer,
                "meter": row.meter,
                "bus": row.bus,
                "phases": row.phases,
                "alternative": ranked[0][1] if ranked else "",
                "log_factor": ranked[0][0] if ranked else np.nan,
                "open": _some(possible),
                "verdict": EXCLUDED if row.meter in excluded else verdict,
            }
        )
    return pd.DataFrame(out)


def _as_filed(tables: FeederTables, kinds: Collection[Kind]) -> str:
    """The verdict on a place against which nothing speaks: of what was not looked for, nothing is known."""
    possible = PLACES if tables.in_phases else (Kind.BUS,)
    missing = [kind for kind in possible if kind not in kinds]
    if len(missing) == len(possible):
        return UNASKED
    return f"{AS_FILED}; {missing[0]} {UNASKED}" if missing else AS_FILED


def loads(now: Round) -> pd.DataFrame:
    """Power factor of every load whose q is not metered, and the gain of its register of p."""
    model, given, found = now.net.site.loads, now.given, now.fit
    at, gain = given.where["tan"], given.where["p_gain"]
    middle = 0.5 * (model.tan_min + model.tan_max)
    tan, std, prior = middle + found.estimate[at], found.std[at], given.spread[at]

    def factor(value: Floats) -> Floats:
        return np.asarray(np.cos(np.arctan(np.maximum(value, 0.0))))

    metered = prior == 0.0
    learned = np.where(metered, "q is metered", np.where(std > VAGUE * prior, UNTOLD, "learned"))
    hide = np.where(metered, np.nan, 1.0)
    return pd.DataFrame(
        {
            "customer": now.net.site.feeder.customers,
            "power_factor": factor(tan) * hide,
            "low": factor(tan + WIDE * std) * hide,
            "high": factor(tan - WIDE * std) * hide,
            "p_gain_percent": 100.0 * found.estimate[gain],
            "p_gain_std_percent": 100.0 * found.std[gain],
            "verdict": learned,
        }
    )


def errors(now: Round) -> pd.DataFrame:
    """Sizes and correlation time of the errors of the customers' powers."""
    noise, base = now.noise, now.net.site.feeder.base_kva
    named = (
        ("error of p", noise.p * base, "kW"),
        ("error of q", noise.q * base, "kvar"),
        ("correlation time", noise.time_s, "s"),
        ("noise of meters", noise.white, "of what they promise"),
    )
    return pd.DataFrame(
        [
            {
                "quantity": name,
                "estimate": value,
                "low": value * np.exp(-WIDE * std),
                "high": value * np.exp(WIDE * std),
                "unit": unit,
                "verdict": "learned" if std < VAGUE else UNTOLD,
            }
            for (name, value, unit), std in zip(named, noise.std.tolist(), strict=True)
        ]
    )


def _some(items: Sequence[str]) -> str:
    tail = f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""
    return ", ".join(items[:_SHOWN]) + tail

"""What a campaign's scenarios come to: shares with their confidence intervals, and operating curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.stats import binomtest, chi2

from feeders.studies.campaign_plan import CLEAN, Promise

__all__ = ["CONFIDENCE", "WITHIN_S", "delays", "false_names", "grouped", "promises", "scenarios"]

CONFIDENCE: Final = 0.95
"""Of every interval."""

WITHIN_S: Final = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0)
"""Times of the operating curve, s after the onset."""

YEAR_S: Final = 365.25 * 86_400.0


def scenarios(rows: Sequence[dict[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Tables of all scenarios, and of all their liars.

    Parameters
    ----------
    rows
        As `campaign_watch.watch` gives them.
    """
    kept = ("scenario", "alarms_per_year", "kind", "size", "liars", "place")
    each = [{name: row[name] for name in kept} | one for row in rows for one in row.get("each", ())]
    frame = pd.DataFrame([{name: cell for name, cell in row.items() if name != "each"} for row in rows])
    liars = pd.DataFrame(each, columns=[*kept, "who", "inverter", "lie_volt", "delay_s", "anyway"])
    return frame, liars.astype({"alarms_per_year": float, "delay_s": float})


def grouped(found: pd.DataFrame, liars: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """One row for each group of scenarios.

    Parameters
    ----------
    found, liars
        From `scenarios`.
    by
        Columns that tell the groups apart, besides the false-alarm rate.
    """
    keys = ["alarms_per_year", *by]
    tried = found[found["reason"] == ""]
    lied = dict(list(liars.groupby(keys, sort=True)))
    rows = []
    for key, group in tried.groupby(keys, sort=True):
        some = lied.get(key)
        delay = np.zeros(0) if some is None else some["delay_s"].to_numpy()
        named = np.isfinite(delay)
        lying = group["kind"] != CLEAN
        rows.append(
            dict(zip(keys, key, strict=True))
            | {"scenarios": len(group)}
            | _share("exact", int(group["exact"].sum()), len(group))
            | {"liars_told": delay.size}
            | _share("named", int(named.sum()), delay.size)
            | _share("false", int((group["falsely_named"] != "").sum()), len(group))
            | {
                "delay_median_s": float(np.median(delay[named])) if named.any() else np.nan,
                "delay_95_s": _most(delay[named]),
                "clear_median_s": _median(group["clear_s"][lying].to_numpy()),
                "error_liars_95": _median(group["error_liars_95"].to_numpy()),
                "error_liars_worst": _largest(group["error_liars"].to_numpy()),
                "error_others_95": _median(group["error_others_95"].to_numpy()),
                "error_others_worst": _largest(group["error_others"].to_numpy()),
                "undecided": float(group["undecided_s"].sum() / group["watched_s"].sum()),
            }
        )
    return pd.DataFrame(rows)


def delays(liars: pd.DataFrame) -> pd.DataFrame:
    """Share of the liars that are named within some time of their onset, by kind and size.

    Parameters
    ----------
    liars
        From `scenarios`.
    """
    rows = []
    for key, group in liars.groupby(["alarms_per_year", "kind", "size"], sort=True):
        for within in WITHIN_S:
            named = int((group["delay_s"] <= within).sum())
            rows.append(
                dict(zip(("alarms_per_year", "kind", "size"), key, strict=True))
                | {"within_s": within}
                | _share("named", named, len(group))
            )
    return pd.DataFrame(rows)


def false_names(found: pd.DataFrame, liars: pd.DataFrame) -> pd.DataFrame:
    """What a false-alarm rate costs and gains: false names per year while nobody lies, and liars named.

    Parameters
    ----------
    found, liars
        From `scenarios`.

    Notes
    -----
    With k events in a time T, the limits of the rate are those of a Poisson process,
    ``chi2(a / 2; 2 k) / (2 T)`` and ``chi2(1 - a / 2; 2 k + 2) / (2 T)`` with a = 1 - CONFIDENCE.

    References
    ----------
    F. Garwood: Fiducial limits for the Poisson distribution. Biometrika 28, 1936.
    """
    rows = []
    for rate, group in found.groupby("alarms_per_year", sort=True):
        clean = group[(group["kind"] == CLEAN) & (group["reason"] == "")]
        years, events = clean["watched_s"].sum() / YEAR_S, int(clean["false_events"].sum())
        tail = 0.5 * (1.0 - CONFIDENCE)
        low = chi2.ppf(tail, 2 * events) / (2.0 * years) if events else 0.0
        lied = liars[liars["alarms_per_year"] == rate]
        rows.append(
            {
                "alarms_per_year": rate,
                "hours": years * YEAR_S / 3600.0,
                "false_names": events,
                "per_year": events / years,
                "per_year_low": float(low),
                "per_year_high": float(chi2.ppf(1.0 - tail, 2 * events + 2) / (2.0 * years)),
                "liars_told": len(lied),
            }
            | _share("named", int(np.isfinite(lied["delay_s"]).sum()), len(lied))
        )
    return pd.DataFrame(rows)


def promises(found: pd.DataFrame, liars: pd.DataFrame, promised: Mapping[str, Promise]) -> pd.DataFrame:
    """What became of lies of which something is promised; columns as in `campaign.Campaign`.

    Parameters
    ----------
    found, liars
        From `scenarios`.
    promised
        By kind.

    Notes
    -----
    Lies of a scene have their loads and the errors of their meters in common; scenes have nothing in common.
    So the limit is that of the scenes with a broken promise, each of which counts once: it holds for the
    probability that a lie breaks it, however alike the lies of a scene fare.
    """
    rows = []
    tried = found[(found["reason"] == "") & found["kind"].isin(list(promised))]
    columns = ["alarms_per_year", "scenario"]
    anyway = liars.loc[liars["anyway"].astype(bool), columns].drop_duplicates()
    by_chance = pd.MultiIndex.from_frame(tried[columns]).isin(pd.MultiIndex.from_frame(anyway))
    tried = tried.assign(promise=tried["kind"].map(promised), by_chance=by_chance)
    for (rate, promise), group in tried.groupby(["alarms_per_year", "promise"], sort=True):
        if promise is Promise.HIDDEN:
            lies, broken = group, group["because"] != ""
        else:
            lies = group[~group["by_chance"]]
            broken = lies["missed"] != ""
        scenes = broken.groupby(lies["scene"]).any()
        limits = _share("broken", int(scenes.sum()), len(scenes))
        rows.append(
            {
                "alarms_per_year": rate,
                "promise": str(promise),
                "lies": len(lies),
                "broken": int(broken.sum()),
                "by_chance": int(group["by_chance"].sum()),
                "honest_named": int((group["falsely_named"] != "").sum()),
                "scenes": len(scenes),
                "scenes_broken": int(scenes.sum()),
                "probability_high": limits["broken_high"],
            }
        )
    return pd.DataFrame(rows)


def _share(name: str, count: int, of: int) -> dict[str, float]:
    """A share, and its interval by Clopper and Pearson; NaN of nothing."""
    if not of:
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"), np.nan)
    limits = binomtest(count, of).proportion_ci(CONFIDENCE, method="exact")
    return {name: count / of, f"{name}_low": float(limits.low), f"{name}_high": float(limits.high)}


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    # One of the values, so that infinite ones stay what they are.
    return float(np.percentile(known, 50.0, method="lower")) if known.size else np.nan


def _most(values: np.ndarray) -> float:
    return float(np.percentile(values, 95.0, method="higher")) if values.size else np.nan


def _largest(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else np.nan

"""Campaign of simulated attacks on a feeder: identification, delay, shown voltages, tables.

The truth is full AC power flow with the droop inverters in closed loop, over days of profiles.

References: docs/studies.md; docs/theory-studies.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.stats import binomtest, chi2

from feeders.format.tables import FeederTables
from feeders.model.site import Site, from_tables
from feeders.studies.campaign.plan import CLEAN, CampaignPlan, Promise
from feeders.studies.campaign.scene import Prepared, prepare, watch
from feeders.studies.journal import Progress, Runner, Where, run_pieces, versions
from feeders.studies.workers import Here
from gridsec.errors import GridsecError

__all__ = ["Campaign", "NothingPlayed", "campaign", "false_names", "grouped", "scenarios"]


CONFIDENCE: Final = 0.95  # confidence level of every interval, 1
WITHIN_S: Final = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0)  # after the onset

YEAR_S: Final = 365.25 * 86_400.0


def scenarios(rows: Sequence[dict[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Tables of all scenarios, and of all manipulated devices, from the rows of `scene.watch`."""
    kept = ("scenario", "alarms_per_year", "kind", "size", "liars", "place")
    each = [{name: row[name] for name in kept} | one for row in rows for one in row.get("each", ())]
    frame = pd.DataFrame([{name: cell for name, cell in row.items() if name != "each"} for row in rows])
    liars = pd.DataFrame(each, columns=[*kept, "who", "inverter", "lie_volt", "delay_s", "anyway"])
    return frame, liars.astype({"alarms_per_year": float, "delay_s": float})


def grouped(found: pd.DataFrame, liars: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """One row for each group of scenarios by false-alarm rate and columns; from the tables of `scenarios`."""
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
                "error_liars_worst": float(group["error_liars"].max()),
                "error_others_95": _median(group["error_others_95"].to_numpy()),
                "error_others_worst": float(group["error_others"].max()),
                "undecided": float(group["undecided_s"].sum() / group["watched_s"].sum()),
            }
        )
    return pd.DataFrame(rows)


def delays(liars: pd.DataFrame) -> pd.DataFrame:
    """Share of the manipulated devices named within some time of their onset, by kind and size."""
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
    """Operating curve: false names per year without an attack, and share of manipulated devices named.

    Source: F. Garwood: Fiducial limits for the Poisson distribution. Biometrika 28, 1936.
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
    """Outcome of attacks with a guarantee by their kind; columns as in `Campaign`.

    Attacks of a scene have loads and errors of meters in common; scenes are independent. So the limit is that
    of the scenes with a broken guarantee, each of which counts once. It is valid for the probability that an
    attack breaks it, for any dependence within a scene.
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
    """Share, and its interval by Clopper and Pearson; NaN of nothing."""
    if not of:
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"), np.nan)
    limits = binomtest(count, of).proportion_ci(CONFIDENCE, method="exact")
    return {name: count / of, f"{name}_low": float(limits.low), f"{name}_high": float(limits.high)}


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    # One of the values, so that infinite ones remain.
    return float(np.percentile(known, 50.0, method="lower")) if known.size else np.nan


def _most(values: np.ndarray) -> float:
    return float(np.percentile(values, 95.0, method="higher")) if values.size else np.nan


ROWS: Final = 2  # version of the rows in journals


class NothingPlayed(GridsecError):
    """No scenario of a campaign could be simulated."""

    code = "nothing-played"


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """Results of all scenarios. Shares have limits `_low` and `_high`, Clopper and Pearson's at 95 %."""

    feeder: str
    digest: str
    plan: CampaignPlan
    versions: dict[str, str]  # of all libraries that numbers depend on
    # One row for each scenario and false-alarm rate: `scenario`, `scene`, `season`, `weekday` (0 is Monday),
    # `hour` of its begin; `alarms_per_year`; `kind`, `size`, `liars`, `place`, `onset_s`; `reason` for a
    # missing simulation, or empty; `exact`: all manipulated devices and no others were named; `named`, number
    # of manipulated devices named, `missed` and `falsely_named`, their names; `because`, devices named from
    # the onset on, and not in the same scene without the attack; `false_events`, number of times that an
    # honest meter or inverter became named; `delay_s` from the onset to the naming of the last manipulated
    # device; `clear_s` from the end of the attack until no device was named; `most_named` at once;
    # `watched_s`, `undecided_s`, and `clean_lying_s`, CLEAN during an attack; `error_liars` and
    # `error_others` of the reconstructed voltage at manipulated meters and elsewhere, the largest and (`_95`)
    # the 95th percentile, % of nominal, from `settling_s` after the onset on. Times of events that did not
    # occur are infinite; values without data are NaN.
    scenarios: pd.DataFrame
    # one row for each manipulated device: `who`, its id; `inverter`, true for inverters; `lie_volt`, the
    # largest displacement; `delay_s`; `anyway`, true if it is named without the attack too
    liars: pd.DataFrame
    # by_kind, by_size, by_place, by_liars: groups of scenarios: shares `exact` and `false` (an honest device
    # was named) of the scenarios, `named` of the manipulated devices; median and 95th percentile of the
    # delays of those named; median `_95` and `_worst` of the errors; share of the `undecided` time
    by_kind: pd.DataFrame
    by_size: pd.DataFrame
    by_place: pd.DataFrame
    by_liars: pd.DataFrame
    # operating curve: share of manipulated devices `named` within `within_s`, by kind and size
    delays: pd.DataFrame
    # operating curve: false names `per_year` without an attack, with Poisson limits at 95 %, and the share of
    # manipulated devices named, by `alarms_per_year`
    false_names: pd.DataFrame
    # attacks with a guarantee, one row for each `promise`: `lies`, the number of attacks; `broken`, attacks
    # to stay hidden with a device named because of them, or attacks to be named with a missed device;
    # `by_chance`, attacks with a device that is named without the attack too, which prove nothing and do not
    # count among those to be named; `honest_named`, scenarios with a false name; `scenes`, the number of
    # independent scenes, `scenes_broken` with a broken guarantee, and the upper limit of its probability,
    # Clopper and Pearson's at 95 %
    promises: pd.DataFrame

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""
        return self.plan.seed

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name."""
        names = ("by_kind", "by_size", "by_place", "by_liars", "delays", "false_names", "scenarios", "liars")
        tables: dict[str, pd.DataFrame] = {name: getattr(self, name) for name in names}
        return tables if self.promises.empty else {"promises": self.promises, **tables}


def campaign(
    site: Site,
    plan: CampaignPlan | None = None,
    *,
    seed: int | None = None,
    runner: Runner | None = None,
    journal: Where = None,
    progress: Progress | None = None,
) -> Campaign:
    """Run a campaign on a feeder; the result is the same for every runner.

    `seed` replaces the plan's. `progress` is called with (done, total) scenarios.

    Raises NotObservable, DesignInfeasible, EstimatorUnusable, FeederInvalid, ValueError if the estimator
        cannot monitor this feeder with these settings, or for an invalid plan; NothingPlayed if the power
        flow has no solution at any scene; OtherStudy, InUse, ClusterUnusable, WorkerLost as
        `feeders.studies.journal.run_pieces`.
    """
    plan = CampaignPlan() if plan is None else plan
    plan = plan if seed is None else replace(plan, seed=seed)
    prepare(site, plan)  # errors of the plan occur here, not in a worker
    subject = {"study": "campaign", "rows": ROWS, "digest": site.digest, "plan": plan.subject}
    scenes = run_pieces(
        journal,
        subject,
        [f"scene|{scene}" for scene in range(plan.scenes)],
        partial(_scene, site.tables, plan),
        runner=runner or Here(),
        progress=None if progress is None else lambda done, _: progress(done * plan.together, plan.scenarios),
    )
    return _campaign(site, plan, [row for rows in scenes for row in rows])


@lru_cache(maxsize=1)
def _prepared(tables: FeederTables, plan: CampaignPlan) -> Prepared:
    """Designs of a campaign, made once in each process."""
    return prepare(from_tables(tables), plan)


def _scene(tables: FeederTables, plan: CampaignPlan, scene: int) -> list[dict[str, Any]]:
    """Simulate a scene in any process."""
    return watch(_prepared(tables, plan), scene)


def _campaign(site: Site, plan: CampaignPlan, rows: list[dict[str, Any]]) -> Campaign:
    if all(row["reason"] for row in rows):
        raise NothingPlayed(
            f"{site.feeder.name}: no scenario can be simulated; the first: {rows[0]['reason']}"
        )
    found, liars = scenarios(rows)
    by = {
        name: grouped(found, liars, columns)
        for name, columns in (
            ("by_kind", ["kind"]),
            ("by_size", ["kind", "size"]),
            ("by_place", ["kind", "place"]),
            ("by_liars", ["kind", "liars"]),
        )
    }
    return Campaign(
        feeder=site.feeder.name,
        digest=site.digest,
        plan=plan,
        versions=versions(),
        scenarios=found,
        liars=liars,
        **by,
        delays=delays(liars),
        false_names=false_names(found, liars),
        promises=promises(
            found, liars, {kind.name: kind.promise for kind in plan.kinds if kind.promise is not None}
        ),
    )

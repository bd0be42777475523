"""Thousands of simulated attacks on a feeder: who is named or missed, how soon, and what voltages are shown.

The truth is full AC power flow with the droop inverters in closed loop, over days of profiles.

References
----------
docs/studies.md; docs/theory-studies.md.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import pandas as pd

from feeders.load import from_tables
from feeders.schema import FeederTables
from feeders.studies import campaign_tables
from feeders.studies.campaign_plan import Plan
from feeders.studies.campaign_run import Here, Runner, versions
from feeders.studies.campaign_watch import Prepared, prepare, watch
from feeders.studies.journal import Journal, Progress, Where
from gridsec.errors import GridsecError

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["Campaign", "NothingPlayed", "campaign"]


ROWS: Final = 2
"""Edition of the rows that journals hold."""


class NothingPlayed(GridsecError):
    """Not one scenario of a campaign could be played."""

    code = "nothing-played"


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """What became of all scenarios. Shares have limits `_low` and `_high`, Clopper and Pearson's at 95 %.

    Attributes
    ----------
    feeder, digest
        The feeder's name, and its content.
    plan
        What was played.
    versions
        Of everything that numbers depend on.
    scenarios
        One row for each scenario and false-alarm rate: `scenario`, `scene`, `season`, `weekday` (0 is
        Monday), `hour` of its beginning; `alarms_per_year`; `kind`, `size`, `liars`, `place`, `onset_s`;
        `reason` why it could not be played, or empty;
        `exact`: all liars and nobody else were named; `named`, how many liars, `missed` and `falsely_named`,
        who; `because`, who was named from the onset on, and not in the same scene without the lie;
        `false_events`, how often an honest meter or inverter became named; `delay_s` from the onset
        until the last liar had been named; `clear_s` from the end of the lies until nobody was named;
        `most_named` at once; `watched_s`, `undecided_s`, and `clean_lying_s`, CLEAN during a lie;
        `error_liars` and `error_others` of the reconstructed voltage, the largest and (`_95`) the 95th
        percentile, % of nominal, from `settling_s` after the onset on. What never came is infinite, what
        there was nothing of is NaN.
    liars
        One row for each liar: `who`, whether an `inverter`, `lie_volt`, the largest displacement, and
        `delay_s`; `anyway`, whether it is named without the lie too.
    by_kind, by_size, by_place, by_liars
        The same together: shares `exact` and `false` (somebody honest was named) of the scenarios, `named`
        of the liars; median and 95th percentile of the delays of those that were named; median `_95` and
        `_worst` of the errors; the share of the time that was `undecided`.
    delays
        Operating curve: share of liars `named` within `within_s`, by kind and size.
    false_names
        Operating curve: false names `per_year` while nobody lies, with Poisson limits at 95 %, and the
        share of liars named, by `alarms_per_year`.
    promises
        Lies of which something is promised, one row for each `promise`: how many `lies`, how many that were
        to stay hidden somebody was named because of, or that were to be named left a liar unnamed (`broken`);
        `by_chance`, a liar was named without the lie too, which proves nothing: not among the lies that were
        to be named; `honest_named`, scenarios with a false name; of how many independent `scenes` how many
        have a broken promise, and the upper limit of its probability, Clopper and Pearson's at 95 %.
    """

    feeder: str
    digest: str
    plan: Plan
    versions: dict[str, str]
    scenarios: pd.DataFrame
    liars: pd.DataFrame
    by_kind: pd.DataFrame
    by_size: pd.DataFrame
    by_place: pd.DataFrame
    by_liars: pd.DataFrame
    delays: pd.DataFrame
    false_names: pd.DataFrame
    promises: pd.DataFrame

    @property
    def seed(self) -> int:
        """What chose everything random."""
        return self.plan.seed

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name."""
        names = ("by_kind", "by_size", "by_place", "by_liars", "delays", "false_names", "scenarios", "liars")
        tables: dict[str, pd.DataFrame] = {name: getattr(self, name) for name in names}
        return tables if self.promises.empty else {"promises": self.promises, **tables}


def campaign(
    site: Site,
    plan: Plan | None = None,
    *,
    seed: int | None = None,
    runner: Runner | None = None,
    journal: Where = None,
    progress: Progress | None = None,
) -> Campaign:
    """Play a campaign on a feeder.

    Parameters
    ----------
    site
        The feeder.
    plan
        What is played.
    seed
        In place of the plan's.
    runner
        Where: `campaign_run.Here`, `Processes` or `Dask`; the results are the same.
    journal
        File in which finished scenes are kept; an interrupted campaign goes on from it.
    progress
        Told how many scenarios are done.

    Raises
    ------
    NotObservable, DesignInfeasible, EstimatorUnusable, FeederInvalid, ValueError
        If the estimator cannot watch this feeder with these settings, or the plan is none.
    NothingPlayed
        If the feeder can carry its loads at no moment that was drawn.
    OtherStudy
        If the journal is another study's.
    InUse
        If another process is writing it.
    ClusterUnusable, WorkerLost
        From the runner; what is finished is in the journal.
    """
    plan = Plan() if plan is None else plan
    plan = plan if seed is None else replace(plan, seed=seed)
    prepare(site, plan)  # whatever is wrong with it is told here, and not by a worker
    used = versions()
    subject = {
        "study": "campaign",
        "rows": ROWS,
        "digest": site.digest,
        "plan": plan.subject,
    }
    with Journal(journal, subject, of=plan.scenes) as kept:
        rows = _played(site, plan, runner or Here(), kept, progress)
    return _campaign(site, plan, used, rows)


def _played(
    site: Site, plan: Plan, runner: Runner, kept: Journal, progress: Progress | None
) -> list[dict[str, Any]]:
    """The rows of all scenes; those that the journal does not have are played."""
    keys = [f"scene|{scene}" for scene in range(plan.scenes)]
    todo = [scene for scene, key in enumerate(keys) if key not in kept]
    done = plan.scenes - len(todo)
    if progress is not None:
        progress(done * plan.together, plan.scenarios)
    with closing(runner.run(partial(_scene, site.tables, plan), todo)) as results:
        for scene, rows in results:
            kept.put(keys[scene], rows)
            done += 1
            if progress is not None:
                progress(done * plan.together, plan.scenarios)
    return [row for key in keys for row in kept[key]]


# What the worker of this process prepared last, and for what.
_prepared: list[tuple[str, Prepared]] = []


def _scene(tables: FeederTables, plan: Plan, scene: int) -> list[dict[str, Any]]:
    """Work on a scene, wherever this is: designs are made once in each process."""
    asked = repr((tables, plan))
    given = next((made for what, made in _prepared if what == asked), None)
    if given is None:
        given = prepare(from_tables(tables), plan)
        _prepared[:] = [(asked, given)]
    return watch(given, scene)


def _campaign(site: Site, plan: Plan, used: dict[str, str], rows: list[dict[str, Any]]) -> Campaign:
    if all(row["reason"] for row in rows):
        raise NothingPlayed(f"{site.feeder.name}: no scenario can be played; the first: {rows[0]['reason']}")
    found, liars = campaign_tables.scenarios(rows)
    by = {
        name: campaign_tables.grouped(found, liars, columns)
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
        versions=used,
        scenarios=found,
        liars=liars,
        **by,
        delays=campaign_tables.delays(liars),
        false_names=campaign_tables.false_names(found, liars),
        promises=campaign_tables.promises(
            found, liars, {kind.name: kind.promise for kind in plan.kinds if kind.promise is not None}
        ),
    )

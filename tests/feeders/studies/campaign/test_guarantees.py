"""Promises of `detectable`, kept and broken in campaigns: counted against the same scene without the lie."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta

from feeders.model.site import Site
from feeders.registry import DesignedEstimator, design
from feeders.simulation.attacks import AttackKind
from feeders.simulation.scenario import Scenario
from feeders.simulation.trial import Trial, frames
from feeders.studies.campaign.guarantees import promised
from feeders.studies.campaign.plan import AttackClass, Place, Promise
from feeders.studies.campaign.study import attacks, campaign
from feeders.studies.detectable import detectable
from gridsec.interface import Estimate, Frame, Verdict
from tests.feeders.studies.campaign.campaigns import PLAN, SITE


@pytest.mark.acceptance
def test_promised_sizes_are_kept() -> None:
    """Nobody is named because of a hidden lie, no large one is missed, under full AC power flow: 200 lies."""
    plan = replace(
        PLAN,
        scenes=25,
        together=9,
        duration_s=24.0,
        onset_s=(12.0, 14.0),
        lying_s=9.0,
        places=(Place.RANDOM,),
        alarms_per_year=(1.0,),
    )
    stated = plan.trial(SITE, plan.moment(0)).stated
    found = detectable(stated, max_attacked=2)
    kinds = promised(stated, found)
    told = campaign(SITE, replace(plan, kinds=kinds))
    volts = found.meters.set_index("meter")
    assert [kind.name for kind in kinds] == ["hidden_alone", "named_alone", "hidden", "named"]
    for lie in told.liars.to_dict("records"):
        size = volts.loc[lie["who"], lie["kind"]]
        if lie["kind"] == "hidden":  # others of a collusion lie by less
            assert 0.0 < lie["lie_volt"] <= 1.001 * lie["size"] * size
        else:
            assert lie["lie_volt"] == pytest.approx(lie["size"] * size)
        assert math.isinf(lie["delay_s"]) == lie["kind"].startswith("hidden")
    worst = told.liars[told.liars["kind"] == "hidden"]
    sizes = volts.loc[worst["who"], "hidden"].to_numpy() * worst["size"]
    reached = (worst["lie_volt"] > 0.999 * sizes).groupby(worst["scenario"]).any()
    assert reached.all()
    assert worst.groupby("scenario").size().max() == 2
    table = told.promises.set_index("promise")
    assert told.tables["promises"] is told.promises
    assert table["lies"].to_dict() == {"hidden": 100, "named": 100}
    assert not table[["broken", "by_chance", "honest_named", "scenes_broken"]].to_numpy().any()
    assert table["probability_high"].to_numpy() == pytest.approx(beta.ppf(0.975, 1, 25))


def test_for_one_liar_or_where_nothing_hides_there_are_fewer_kinds() -> None:
    found = detectable(SITE, max_attacked=1)
    assert [kind.name for kind in promised(SITE, found)] == ["hidden_alone", "named_alone"]
    nothing = replace(found, meters=found.meters.assign(hidden_alone=0.0))
    assert [kind.name for kind in promised(SITE, nothing)] == ["named_alone"]


def crying_wolf(site: Site) -> DesignedEstimator:
    """What the site's file asks for, which also names the first meter every seven seconds."""
    watcher = design(site)

    def step(given: Any, state: Any, frame: Frame) -> tuple[Any, Estimate, Verdict]:
        state, estimate, verdict = watcher.family.step(given, state, frame)
        wolf = np.zeros_like(verdict.suspects)
        wolf[0] = round(frame.t) % 7 == 0
        return state, estimate, replace(verdict, suspects=verdict.suspects | wolf)

    return replace(watcher, family=replace(watcher.family, step=step))


@pytest.mark.acceptance
def test_broken_promises_are_counted_against_the_same_scene_without_the_lie(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Promises of which nothing is true, and an estimator that cries wolf; the oracle plays all in full."""
    monkeypatch.setattr("feeders.studies.campaign.study.design", crying_wolf)
    kinds = (
        AttackClass("loud", AttackKind.BIAS, (1.0, 3.0), promise=Promise.HIDDEN),
        AttackClass("small", AttackKind.BIAS, (0.2, 3.0), promise=Promise.NAMED),
    )
    plan = replace(PLAN, scenes=6, together=5, kinds=kinds, alarms_per_year=(1.0,), places=(Place.RANDOM,))
    told = campaign(SITE, plan)
    count = {promise: dict.fromkeys(("lies", "broken", "by_chance"), 0) for promise in Promise}
    broken: dict[Promise, set[int]] = {promise: set() for promise in Promise}
    for scene in range(plan.scenes):
        trial = plan.trial(SITE, plan.moment(scene))
        honest = replace(trial.scenario, season=plan.moment(scene).season)
        watcher = crying_wolf(plan.watched(trial.stated, 1.0))
        control = _named(watcher, trial, honest)
        for case in plan.cases(scene)[1:]:
            lies, _ = attacks(trial.stated, plan, case, honest)
            named, onset = _named(watcher, trial, replace(honest, attacks=lies)), round(case.onset_s)
            liars_, until = lies[0].meters, onset + round(plan.lying_s)
            anyway = control[onset:].any(axis=0)
            promise = next(kind.promise for kind in kinds if kind.name == case.kind)
            assert promise is not None
            if promise is Promise.HIDDEN:
                wrong = bool((named[onset:].any(axis=0) & ~anyway).any())
            else:
                wrong = not named[onset:until, liars_].any(axis=0).all()
            chance = bool(anyway[liars_].any())
            count[promise]["by_chance"] += chance
            if promise is Promise.HIDDEN or not chance:
                count[promise]["lies"] += 1
                count[promise]["broken"] += wrong
                broken[promise] |= {scene} if wrong else set()
    table = told.promises.set_index("promise")
    for promise in Promise:
        assert table.loc[promise, ["lies", "broken", "by_chance"]].to_dict() == count[promise]
        assert table.loc[promise, "scenes_broken"] == len(broken[promise])
        assert 0 < count[promise]["broken"] < count[promise]["lies"]
        assert count[promise]["by_chance"]


def _named(watcher: DesignedEstimator, trial: Trial, scenario: Scenario) -> np.ndarray:
    """Who is named in each frame."""
    state, rows = watcher.init(scenario.start), []
    for frame, _ in frames(trial, scenario):
        state, _, verdict = watcher.step(state, frame)
        rows.append(verdict.suspects)
    return np.array(rows)

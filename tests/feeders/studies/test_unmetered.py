"""Sizes of lies, errors and campaigns where some customers have no meter; errors under worst collusions.

Oracle: AC power flow over the profiles' days, and the monitor on frames as the service makes them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import Site, load, unread
from feeders.profiles import Season
from feeders.registry import DesignedEstimator, design
from feeders.simulation.scenario import START
from feeders.simulation.trial import AttackKind, Trial, TrialMeterErrors, frames
from feeders.studies.campaign.guarantees import Rehearsal, rehearse
from feeders.studies.campaign.plan import AttackClass, CampaignPlan, Place
from feeders.studies.campaign.study import campaign
from feeders.studies.detectable import Detectable, detectable
from feeders.studies.detectable import watched as monitored
from feeders.studies.operating import squared
from gridsec.arrays import Floats
from gridsec.interface import Decision
from gridsec.planning.collusion import furthest
from gridsec.planning.detectability import QUIET, SINCE, noticed
from tests.feeders.unmetered import CIGRE, played, unmetered

HONEST, LYING = monitored(CIGRE).settling + QUIET, SINCE


@pytest.fixture(scope="module")
def found() -> Detectable:
    return detectable(CIGRE, max_attacked=1)


def watched(watcher: DesignedEstimator, site: Site, seed: int, lies: Floats) -> tuple[bool, Floats]:
    """Whether a lie, squared pu, is noticed; and the largest errors, V, while it is not."""
    state, seen, worst = watcher.init(START), False, np.zeros(site.feeder.bus.size)
    for tick, (sample, frame) in enumerate(played(site, seed, float(HONEST + LYING))):
        lying = tick >= HONEST
        told = replace(frame, y=frame.y + lies) if lying else frame
        state, estimate, verdict = watcher.step(state, told)
        seen |= lying and verdict.decision is not Decision.CLEAN
        if lying and not seen:
            error = np.abs(np.sqrt(estimate.v2) * site.customer_volt - sample.v_volt)
            worst = np.maximum(worst, error)
    return seen, worst


def test_whoever_has_no_meter_hides_lies_of_others(found: Detectable) -> None:
    """The same meters with all customers metered: neighbours' lies are as large as loads may be unknown."""
    metered = detectable(load("cigre-lv"), max_attacked=1)
    full = metered.meters.set_index("meter").loc[found.meters["meter"]]
    assert (found.meters["noticed"].to_numpy() > full["noticed"].to_numpy()).all()
    last = found.meters.set_index("meter").loc["m06"]
    assert last["noticed"] > 2.0 * full.loc["m06", "noticed"]
    assert last["noticed"] <= last["fits"]
    error = (metered.customers["error"].to_numpy(), found.customers["error"].to_numpy())
    assert (error[1] > 4.0 * error[0])[unmetered(CIGRE)].all()


@pytest.mark.acceptance
def test_lies_of_the_noticed_size_are_noticed_and_hidden_ones_are_not(found: Detectable) -> None:
    """60 lies: none slips through although nobody knows half of the loads."""
    watcher, base = design(CIGRE), CIGRE.customer_volt[CIGRE.meters]
    size, hidden = (squared(base, found.meters[name].to_numpy()) for name in ("noticed", "hidden"))
    for seed in range(60):
        j, sign = seed % base.size, (-1.0) ** (seed // base.size)
        unit = sign * np.eye(base.size)[j]
        assert watched(watcher, CIGRE, seed, size[j] * unit)[0]
        if seed < 30:
            assert not watched(watcher, CIGRE, seed, hidden[j] * unit)[0]


@pytest.mark.acceptance
def test_errors_are_covered_where_nobody_meters(found: Detectable) -> None:
    """Lies from nothing to the noticed size, as long as they are not noticed."""
    watcher, base = design(CIGRE), CIGRE.customer_volt[CIGRE.meters]
    size, worst, unseen = squared(base, found.meters["noticed"].to_numpy()), np.zeros(6), 0
    for seed in range(90):
        j = seed % base.size
        lies = np.eye(base.size)[j] * size[j] * (-1.0) ** (seed // base.size) * (seed % 10) / 10.0
        noticed, error = watched(watcher, CIGRE, seed, lies)
        worst, unseen = np.maximum(worst, error), unseen + (not noticed)
    assert unseen > 40
    assert (worst <= found.customers["error"].to_numpy()).all()
    assert worst[unmetered(CIGRE)].min() > 2.0


@pytest.mark.canary("3")
@pytest.mark.parametrize("trials", [3, 12])
def test_the_monitor_keeps_what_is_promised_where_nobody_meters(found: Detectable, trials: int) -> None:
    assert rehearse(CIGRE, found, trials=trials, seed=2) == Rehearsal(trials, 0, 0, 0)


@pytest.mark.acceptance
def test_errors_under_the_worst_collusions_are_covered_on_a_metered_feeder() -> None:
    """Two liars push each customer's voltage as far as the program finds, with all and parts of its lies."""
    site = load("cigre-lv")
    found, watcher, given = detectable(site, max_attacked=2), design(site), monitored(site)
    steps = given.steps(given.known(QUIET), (1, SINCE))
    unnoticed = noticed(steps[-1], 2, risk=found.risk, error=given.model[site.meters])
    worst, unseen = np.zeros(6), 0
    for i in range(6):
        lies = [furthest(unnoticed, each.weights[site.feeder.bus[i]]).lies for each in steps]
        for k, part in enumerate((1.0, -1.0, 0.8, -0.8, 0.6, -0.6, 0.4, -0.4)):
            seen, error = watched(watcher, site, 8 * i + k, part * lies[k % len(lies)])
            worst, unseen = np.maximum(worst, error), unseen + (not seen)
    bound = found.customers["error"].to_numpy()
    assert unseen > 10
    assert (worst <= bound).all()
    assert (worst > 0.3 * bound).any()


# --------------------------------------------------------------------------------- trials and campaigns


def powers(site: Site, hour: float) -> tuple[Floats, Floats, Floats]:
    """Active powers and their errors in the frames of a trial, and the true squared voltages, (T, N) each."""
    trial = Trial(site, seed=5, duration_s=5.0, meters=TrialMeterErrors.REAL, profile_s=3600.0 * hour)
    pairs = list(frames(trial))
    p = np.array([frame.p for frame, _ in pairs])
    error = np.array([frame.p_error for frame, _ in pairs])
    return p, error, np.array([truth.v2 for _, truth in pairs])


def test_watchers_of_trials_are_not_told_what_nobody_meters() -> None:
    """Whatever unmetered customers draw, frames say the same of them; and they do draw something else."""
    some, silent = unmetered(CIGRE), unread(CIGRE)
    hours = [powers(CIGRE, hour) for hour in (3.0, 12.0, 19.0)]
    for p, error, _ in hours:
        np.testing.assert_array_equal(p[:, some], np.broadcast_to(silent.p[some], (5, 3)))
        np.testing.assert_array_equal(error[:, some], np.broadcast_to(silent.p_error[some], (5, 3)))
        assert (error[:, ~some] < 0.2 * silent.p_error[~some]).all()
    assert np.abs(hours[0][0] - hours[2][0])[:, ~some].min() > 0.0
    assert np.abs(hours[0][2] - hours[2][2])[:, some].min() > 1e-3
    stated = Trial(CIGRE).stated.tables.customers
    assert [row.p_std_kw is None for row in stated] == some.tolist()


@pytest.mark.acceptance
def test_campaigns_do_not_tell_either() -> None:
    """Voltages at customers without meters are off by volts, and no honest meter is named for it."""
    plan = CampaignPlan(
        scenes=4,
        together=3,
        seed=2,
        duration_s=24.0,
        onset_s=(8.0, 10.0),
        lying_s=10.0,
        settling_s=2.0,
        seasons=(Season.SUMMER,),
        kinds=(AttackClass("bias", AttackKind.BIAS, (1.0,)),),
        liars=(1,),
        places=(Place.RANDOM,),
    )
    rows = campaign(CIGRE, plan).scenarios
    assert rows["error_others"].max() > 0.4
    assert not rows["falsely_named"].any()
    assert campaign(load("cigre-lv"), plan).scenarios["error_others"].max() < 0.3

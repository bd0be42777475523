"""Campaigns: what a row says is what a full play of the case shows; the same anywhere; nothing is lost."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import threadpoolctl
from scipy.stats import beta

from feeders.model.site import Site, from_tables, load
from feeders.profiles import Season
from feeders.registry import design
from feeders.simulation.attacks import AttackKind
from feeders.simulation.demand import Variation
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, frames, judge
from feeders.studies.campaign.plan import CLEAN, AttackClass, CampaignCase, CampaignPlan, Design, Place
from feeders.studies.campaign.study import (
    Campaign,
    NothingPlayed,
    attacks,
    campaign,
    false_names,
    grouped,
    liars,
    risings,
    scenarios,
)
from feeders.studies.running import (
    ClusterUnusable,
    Dask,
    Here,
    OtherStudy,
    Processes,
    WorkerLost,
    agree,
    versions,
)
from gridsec.attack import Coordinated, Random
from gridsec.errors import InputInvalid
from tests.codes import refused
from tests.feeders import stations
from tests.feeders.model.test_taps import village
from tests.feeders.studies.campaign.campaigns import PLAN, SITE
from tests.journals import rows


@pytest.fixture(scope="module")
def here() -> Campaign:
    return campaign(SITE, PLAN)


def same(one: Campaign, other: Campaign) -> None:
    """To the last bit."""
    for name, table in one.tables.items():
        pd.testing.assert_frame_equal(table, other.tables[name], check_exact=True, obj=name)


# ------------------------------------------------------------------------------------------------ truth


def test_a_plan_of_the_files_counts_in_readings() -> None:
    assert replace(CampaignPlan.of(SITE), load_error=CampaignPlan().load_error) == CampaignPlan()
    meta = SITE.tables.meta
    monitor = replace(
        meta.monitor, tick_s=900.0, silence_s=9000.0, estimator="set-search", alarms_per_year=3.0
    )
    rare = from_tables(replace(SITE.tables, meta=replace(meta, monitor=monitor)))
    plan = CampaignPlan.of(rare, seed=5, learn_s=3600.0)
    assert (plan.step_s, plan.duration_s, plan.estimator, plan.alarms_per_year, plan.seed) == (
        *(900.0, 540_000.0, "set-search", (3.0,), 5),
    )
    assert plan.learn_step_s == 900.0
    assert plan.load_error is None
    sizes = {kind.name: kind.sizes for kind in plan.kinds}
    assert sizes["replay"] == (54_000.0,)
    # Ten readings later a drift is as large as it is after ten seconds.
    np.testing.assert_allclose(np.array(sizes["drift"]) * 900.0, [1.0, 3.0])
    assert sizes["bias"] == (1.0, 2.0, 3.0, 5.0)
    assert CampaignPlan.of(rare, duration_s=9000.0).onset_s == (900.0, 2700.0)


@pytest.mark.acceptance
def test_rows_are_what_full_plays_show_where_powers_are_those_of_the_files() -> None:
    plan = replace(PLAN, scenes=2, load_error=None, alarms_per_year=(1.0,))
    assert full_plays_show_every_row(campaign(SITE, plan)) > {CLEAN, "coordinated-power"}


def full_plays_show_every_row(found: Campaign) -> set[str]:
    """Nothing is shared in the oracle: each case is simulated and watched from its first frame on."""
    plan, seen = found.plan, set()
    for scene in range(plan.scenes):
        moment = plan.moment(scene)
        trial = plan.trial(SITE, moment)
        honest = replace(trial.scenario, season=moment.season)
        for case in plan.cases(scene):
            told, wrong = attacks(trial.stated, plan, case, honest) if case.kind != CLEAN else ((), ())
            played = list(frames(trial, replace(honest, attacks=told, inverter_attacks=wrong)))
            for rate in plan.alarms_per_year:
                watcher = design(plan.watched(trial.stated, rate))
                full = judge(watcher, trial, played=played, settling_s=plan.settling_s)
                rows = found.scenarios
                (row,) = rows[(rows["scenario"] == case.number) & (rows["alarms_per_year"] == rate)].to_dict(
                    "records"
                )
                each = found.liars[
                    (found.liars["scenario"] == case.number) & (found.liars["alarms_per_year"] == rate)
                ]
                delays = np.concatenate([full.delay_s, full.inverter_delay_s])
                assert each["delay_s"].tolist() == delays.tolist()
                assert row["named"] == np.isfinite(delays).sum()
                # Honest frames before the onset are those of the clean case.
                before = round(case.onset_s / plan.step_s) if case.kind != CLEAN else 0
                assert row["undecided_s"] == full.undecided[before:].sum()
                assert row["clean_lying_s"] == full.clean_while_lying.sum()
                if case.kind not in (CLEAN, "inverter"):
                    assert row["error_liars"] == full.error_liars.max()
                    assert math.isfinite(row["error_liars"])
                blamed = full.accused.any() or full.accused_inverters.any()
                assert row["exact"] == (full.missed == 0 and not blamed)
                seen.add(case.kind)
    return seen


@pytest.mark.acceptance
def test_every_row_is_what_the_full_play_of_its_case_shows(here: Campaign) -> None:
    assert full_plays_show_every_row(here) == {CLEAN, *(kind.name for kind in PLAN.kinds)}


def test_lies_are_as_large_as_they_are_said_to_be(here: Campaign) -> None:
    told = here.liars.set_index("kind")
    assert told.loc[["bias"], "lie_volt"].to_numpy() == pytest.approx(0.03 * SITE.feeder.base_volt)
    assert told.loc[["inverter"], "lie_volt"].isna().all()


@pytest.mark.canary("stations")
@pytest.mark.parametrize("site", [village(), from_tables(stations.tables())], ids=["taps", "stations"])
def test_lies_behind_taps_are_those_of_the_full_play(site: Site) -> None:
    """In volts, whether a lie is put upon the scene or the scene is played anew with it."""
    p, nominal = site.meters.size, site.customer_nominal[site.meters]
    kinds = (
        AttackClass("bias", AttackKind.BIAS, (4.0,)),
        AttackClass("told", AttackKind.BIAS, (1.0,), (7.0,) * p),
        AttackClass("story", AttackKind.COORDINATED, (3.0,)),
    )
    plan = replace(PLAN, scenes=1, together=12, kinds=kinds, places=(Place.RANDOM,), alarms_per_year=(1.0,))
    rows = campaign(site, plan).liars
    trial = plan.trial(site, plan.moment(0))
    honest = replace(trial.scenario, season=plan.moment(0).season)
    base, behind = site.customer_volt[site.meters], set()
    for case in (case for case in plan.cases(0) if case.kind != CLEAN):
        told, _ = attacks(trial.stated, plan, case, honest)
        shift = np.zeros(p)
        for frame, truth in frames(trial, replace(honest, attacks=told)):
            shift = np.maximum(shift, base * np.abs(np.sqrt(frame.y) - np.sqrt(frame.y - truth.attack)))
        each = rows[rows["scenario"] == case.number].set_index("who")["lie_volt"]
        expected = {site.meter_ids[k]: shift[k] for k in np.flatnonzero(shift)}
        assert each.to_dict() == pytest.approx(expected, rel=1e-9)
        if case.kind != "story":
            some = [site.meter_ids.index(who) for who in each.index]
            sizes = {"bias": 0.04 * nominal[some], "told": np.full(len(some), 7.0)}
            assert each.to_numpy() == pytest.approx(sizes[case.kind])
        behind |= {case.kind for k in np.flatnonzero(shift) if base[k] != nominal[k]}
    assert behind == {"bias", "told", "story"}


def test_kinds_of_a_campaign_are_those_of_the_simulation() -> None:
    kinds = (AttackClass("power", AttackKind.POWER, (2.0,)), AttackClass("random", AttackKind.RANDOM, (2.0,)))
    plan = replace(PLAN, scenes=1, together=6, kinds=kinds, liars=(2,), places=(Place.RANDOM,))
    plan = replace(plan, alarms_per_year=(1.0,))
    honest = plan.trial(SITE, plan.moment(0)).scenario
    seen = set()
    for case in (case for case in plan.cases(0) if case.kind != CLEAN):
        (attack,), _ = attacks(SITE, plan, case, honest)
        seen.add(case.kind)
        if case.kind == "power":
            assert isinstance(attack, Coordinated)
            assert np.all(attack.shift == 0.0)
            assert np.count_nonzero(attack.p_shift) == attack.meters.size == 1
        else:
            assert isinstance(attack, Random)
            assert np.all(attack.low == 0.02)
            assert np.all(attack.high == 0.03)
    assert seen == {"power", "random"}
    found = campaign(SITE, plan)
    assert (found.scenarios["reason"] == "").all()


def test_cases_follow_from_their_numbers_alone() -> None:
    longer = replace(PLAN, scenes=9)
    assert longer.cases(2) == PLAN.cases(2)
    assert longer.moment(2) == PLAN.moment(2)
    combined = [(case.kind, case.place) for k in range(9) for case in longer.cases(k) if case.kind != CLEAN]
    # 27 attacks: eight combinations come up three times, and three of them once more.
    counts = pd.Series(combined).value_counts()
    assert len(counts) == 8
    assert set(counts) == {3, 4}
    moments = [replace(PLAN, seasons=(Season.WINTER,), seed=seed).moment(0) for seed in range(50)]
    assert {moment.season for moment in moments} == {Season.WINTER}
    assert len({int(moment.profile_s // 86_400.0) for moment in moments}) == 7


def test_places() -> None:
    site = load("kerber-dorfnetz")
    model = site.feeder.linear()
    own = np.diagonal(model.R)
    random = np.random.default_rng(1)

    def chosen(place: Place) -> tuple[np.ndarray, np.ndarray]:
        return liars(site, CampaignCase(1, "bias", 1.0, 4, str(place), 0.0, (1,)), random)

    apart = (own[:, None] + own - 2.0 * model.R)[np.ix_(site.meters, site.meters)]
    for _ in range(20):
        street, signs = chosen(Place.STREET)
        assert set(np.abs(signs)) == {1.0}
        within = apart[np.ix_(street, street)].max(axis=1)
        outside = np.delete(apart[street], street, axis=1).min(axis=1)
        # Seen from one of them, nobody outside is nearer than any of them.
        assert (within <= outside).any()
    far, _ = chosen(Place.SENSITIVE)
    felt = np.sqrt((model.R**2).sum(axis=1) + (model.X**2).sum(axis=1))[site.meters]
    assert felt[far].min() >= np.delete(felt, far).max()
    together, signs = chosen(Place.COLLUDING)
    assert len(together) == 4
    assert len(set(signs)) == 1
    anywhere = {tuple(chosen(Place.RANDOM)[0]) for _ in range(20)}
    assert len(anywhere) > 15


def test_what_cannot_be_played_says_why() -> None:
    plan = replace(PLAN, scenes=1, kinds=(AttackClass("bias", AttackKind.BIAS, (1.0,)),), liars=(99,))
    found = campaign(SITE, plan)
    reasons = found.scenarios.loc[found.scenarios["kind"] == "bias", "reason"]
    assert reasons.str.contains("6 meters; cannot attack 99").all()
    assert found.by_kind["kind"].tolist() == [CLEAN, CLEAN]
    assert found.scenarios["exact"].dtype == np.bool_
    with refused(NothingPlayed, "nothing-played"):
        campaign(SITE, replace(plan, variation=Variation(load_scale=1e3), load_error=LoadError(1e4, 1e4)))


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"scenes": 0}, "not-positive"),
        ({"liars": (0,)}, "not-positive"),
        ({"onset_s": (10.0, 24.0)}, "out-of-range"),
        ({"estimator": "oracle"}, "unknown-name"),
        ({"alarms_per_year": ()}, "not-positive"),
        ({"kinds": ()}, "missing"),
        ({"learn_s": 5.0}, "out-of-range"),
    ],
)
def test_wrong_plans_are_told(wrong: dict[str, object], code: str) -> None:
    with refused(InputInvalid, code):
        replace(PLAN, **wrong)  # type: ignore[arg-type]


def test_settings_reach_the_estimator() -> None:
    plan = replace(PLAN, estimator="exact-bank", settings=(("max_attacked", 2.0),))
    assert design(plan.watched(plan.trial(SITE, plan.moment(0)).stated, 1.0)).max_attacked == 2
    with refused(InputInvalid, "unknown-name"):
        campaign(SITE, replace(PLAN, settings=(("colour", 1.0),)))
    for wrong in (1.9, np.nan, np.inf):
        with refused(InputInvalid, "not-integer"):
            campaign(SITE, replace(PLAN, settings=(("max_attacked", wrong),)))


@pytest.mark.acceptance
def test_lies_inside_the_class_are_named_once_meters_are_learned() -> None:
    """A change of class 0.5 by 0.7 %: the fixed error of the meter is learned from the first reading on."""
    kinds = (AttackClass("bias", AttackKind.BIAS, (0.7,)),)
    plan = replace(
        PLAN, scenes=2, together=3, kinds=kinds, lying_s=12.0, duration_s=23.0, alarms_per_year=(1.0,)
    )
    assert (campaign(SITE, plan).liars["delay_s"] <= 2.0).all()
    unknown = campaign(SITE, plan).liars
    learned = campaign(SITE, replace(plan, learn_s=3600.0)).liars
    assert learned[["scenario", "who", "lie_volt"]].equals(unknown[["scenario", "who", "lie_volt"]])
    assert np.isfinite(learned["delay_s"]).all()
    with refused(InputInvalid, "inconsistent"):
        campaign(SITE, replace(plan, learn_s=3600.0, estimator="exact-bank"))


# ----------------------------------------------------------------------------------------------- tables


def test_false_names_are_counted_when_they_appear() -> None:
    flags = np.array([[1, 0], [1, 0], [0, 1], [1, 1], [0, 0]], dtype=np.bool_)
    assert risings(flags) == 3
    assert risings(flags[:0]) == 0


def row(**values: object) -> dict[str, object]:
    plain = {
        "scenario": 0,
        "alarms_per_year": 1.0,
        "kind": "bias",
        "size": 3.0,
        "liars": 2,
        "place": "random",
        "reason": "",
        "exact": True,
        "falsely_named": "",
        "false_events": 0,
        "delay_s": 1.0,
        "clear_s": 5.0,
        "watched_s": 100.0,
        "undecided_s": 10.0,
        "error_liars": 0.2,
        "error_liars_95": 0.1,
        "error_others": 0.2,
        "error_others_95": 0.1,
    }
    return plain | values


def test_shares_and_their_limits() -> None:
    named = {"who": "a", "inverter": False, "lie_volt": 1.0, "delay_s": 2.0}
    missed = {**named, "who": "b", "delay_s": math.inf}
    rows = [row(scenario=k, exact=k > 0, each=[named, missed if k == 0 else named]) for k in range(5)]
    (group,) = grouped(*scenarios(rows), ["kind"]).to_dict("records")
    assert (group["scenarios"], group["liars_told"]) == (5, 10)
    assert (group["exact"], group["named"], group["false"]) == (0.8, 0.9, 0.0)
    # Clopper and Pearson by the quantiles of the beta distribution.
    assert group["exact_low"] == pytest.approx(beta.ppf(0.025, 4, 2))
    assert group["exact_high"] == pytest.approx(beta.ppf(0.975, 5, 1))
    assert group["false_high"] == pytest.approx(1.0 - 0.025 ** (1 / 5))
    assert group["undecided"] == pytest.approx(0.1)
    assert group["delay_median_s"] == 2.0


def test_false_names_per_year() -> None:
    year = 365.25 * 86_400.0
    clean = {"kind": CLEAN, "size": 0.0, "liars": 0, "place": "", "each": []}
    rows = [row(scenario=k, watched_s=year, false_events=0, **clean) for k in range(3)]
    (none,) = false_names(*scenarios(rows)).to_dict("records")
    # Nothing in three years: e^(-3 rate) = 0.025.
    assert (none["per_year"], none["per_year_low"]) == (0.0, 0.0)
    assert none["per_year_high"] == pytest.approx(-math.log(0.025) / 3.0)
    rows[0]["false_events"] = 1
    (one,) = false_names(*scenarios(rows)).to_dict("records")
    assert one["per_year"] == pytest.approx(1 / 3)
    assert one["per_year_low"] == pytest.approx(-math.log(0.975) / 3.0)


# ---------------------------------------------------------------------------------------------- runners


@pytest.mark.acceptance
def test_a_killed_process_loses_nothing(here: Campaign, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill(done: int, total: int) -> None:
        if not killed and total - done == PLAN.together:
            victim = multiprocessing.active_children()[0]
            victim.kill()
            killed.append(done)

    found = campaign(SITE, PLAN, runner=Processes(2), journal=tmp_path / "journal", progress=kill)
    assert killed
    same(here, found)
    assert not multiprocessing.active_children()


def test_a_piece_that_always_kills_its_process_is_given_up() -> None:
    with refused(WorkerLost, "worker-lost") as caught:
        list(Processes(1, retries=1).run(os._exit, [7]))
    assert "piece 7 died 2 times" in str(caught.value)


def threads(_: int) -> list[int]:
    return [library["num_threads"] for library in threadpoolctl.threadpool_info()]


@pytest.mark.acceptance
def test_processes_compute_with_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the environment says: sums of several threads have other last bits."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.setenv(name, "2")
    ((_, found),) = Processes(1).run(threads, [0])
    assert found
    assert set(found) == {1}


def kills_whoever_waits(first: Path, piece: int) -> int:
    """The first piece is done at once; with the second, the process that did the first is killed."""
    if not piece:
        first.write_text(str(os.getpid()), encoding="ascii")
        return piece
    time.sleep(1.0)
    pid = int(first.read_text(encoding="ascii"))
    if pid != os.getpid():
        os.kill(pid, signal.SIGKILL)
    return piece


@pytest.mark.acceptance
def test_who_dies_with_nothing_in_hand_keeps_nobody_waiting(tmp_path: Path) -> None:
    work = partial(kills_whoever_waits, tmp_path / "pid")
    assert sorted(Processes(2).run(work, [0, 1])) == [(0, 0), (1, 1)]
    assert not multiprocessing.active_children()


def test_whoever_stops_listening_stops_the_processes() -> None:
    made = Processes(2).run(time.sleep, [0, 100, 100])
    assert next(made) == (0, None)
    begun = time.monotonic()
    made.close()
    # The pool's own thread waits for them too, and knows a little later that they have ended.
    while multiprocessing.active_children() and time.monotonic() - begun < 60.0:
        time.sleep(0.01)
    assert not multiprocessing.active_children()


@pytest.mark.acceptance
def test_a_dask_cluster_gives_the_same_also_when_a_worker_is_killed(here: Campaign) -> None:
    distributed = pytest.importorskip("distributed")
    killed: list[int] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1", silence_logs=50
    ) as cluster:

        def kill(done: int, total: int) -> None:
            if not killed and 0 < done < total:
                pid = cluster.workers[0].pid
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        same(here, campaign(SITE, PLAN, runner=Dask(cluster.scheduler_address), progress=kill))
    assert killed


def test_no_cluster_is_told() -> None:
    pytest.importorskip("distributed")
    with refused(ClusterUnusable, "cluster-unusable"):
        list(Dask("tcp://127.0.0.1:1", timeout_s=0.2).run(abs, [0]))


@pytest.mark.parametrize("theirs", [versions() | {"numpy": "1.0"}, ModuleNotFoundError("no gridsec")])
def test_a_worker_that_computes_otherwise_is_refused(theirs: object) -> None:
    agree("tcp://a:1", versions())
    with refused(ClusterUnusable, "cluster-unusable") as caught:
        agree("tcp://a:1", theirs)
    assert "tcp://a:1" in str(caught.value)


KILLED = """
import multiprocessing, time
from feeders.studies.running import Processes
if __name__ == "__main__":
    made = Processes(2).run(time.sleep, [0, 1000, 1000])
    next(made)
    print("working", flush=True)
    time.sleep(1000)
"""


def test_processes_end_with_the_one_that_began_them_even_if_it_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "working\n"
        first.kill()
        # Its processes have the same output: it ends when the last of them does.
        first.communicate(timeout=60.0)


# ----------------------------------------------------------------------------------------- interruptions


def test_an_interruption_loses_what_was_in_hand_only(here: Campaign, tmp_path: Path) -> None:
    journal = tmp_path / "journal"

    def interrupt(done: int, _: int) -> None:
        if done == PLAN.together:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        campaign(SITE, PLAN, runner=Here(), journal=journal, progress=interrupt)
    assert list(rows(journal)) == ["scene|0"]
    told: list[int] = []
    same(here, campaign(SITE, PLAN, journal=journal, progress=lambda done, _: told.append(done)))
    assert told[0] == PLAN.together
    with pytest.raises(OtherStudy):
        campaign(SITE, PLAN, seed=8, journal=journal)


PROGRAM = """
import sys
from pathlib import Path
from feeders.studies.campaign.study import campaign
sys.path.insert(0, {here!r})
from test_campaign import PLAN, SITE
campaign(SITE, PLAN, journal=Path({journal!r}))
"""


@pytest.mark.acceptance
def test_a_killed_campaign_goes_on(here: Campaign, tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    program = PROGRAM.format(here=str(Path(__file__).parent), journal=str(journal))
    child = subprocess.Popen([sys.executable, "-c", program])
    deadline = time.monotonic() + 120.0
    while not rows(journal):
        assert child.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    child.kill()
    child.wait()
    same(here, campaign(SITE, PLAN, journal=journal))


def test_texts_and_numbers_of_numpy_make_the_same_plan() -> None:
    asked = replace(
        PLAN, seed=np.int64(7), duration_s=np.float32(120.0), design="random", seasons=("winter",)
    )
    same = replace(PLAN, seed=7, duration_s=120.0, design=Design.RANDOM, seasons=(Season.WINTER,))
    assert asked == same
    assert asked.cases(1) == same.cases(1)
    assert asked.subject == same.subject
    assert AttackClass("b", "bias", (1.0,), volts=(2.0,)) == AttackClass(
        "b", AttackKind.BIAS, (1.0,), volts=(2.0,)
    )
    assert Trial(SITE, meters="site").stated.tables == Trial(SITE, meters=TrialMeterErrors.SITE).stated.tables
    wrong = {"alarms_per_year": (np.inf,), "lying_s": np.nan, "seed": -1}
    with refused(InputInvalid, "negative", "not-positive", "not-finite"):
        replace(PLAN, **wrong)
    with refused(InputInvalid, "not-finite"):
        replace(PLAN, duration_s=np.inf)
    with refused(InputInvalid, "unknown-name"):
        replace(PLAN, design="none")

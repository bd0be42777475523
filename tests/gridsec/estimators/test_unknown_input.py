"""Unknown inputs on feeders: honest rests never refute the truth, and both liars are named, on AC truth.

Oracles: AC power flow and `np.interp` curves for what honest inverters do, a linear program for what a pair
can explain, and real feeders' scenarios for who is named.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng
from scipy.optimize import linprog

from feeders.model.site import Site, from_tables, load, plant, to_frame
from feeders.registry import choose
from feeders.registry import design as watcher
from feeders.simulation.plant import Channel, MeterErrors, MeterOutage
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.attack import Bias, InverterAttack
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.estimators import unknown_input
from gridsec.estimators.unknown_input.pairs import Relation, believe, pairs, try_pair
from gridsec.estimators.unknown_input.step import observe
from gridsec.interface import Cause, Decision, Estimate, Verdict
from tests.codes import refused
from tests.gridsec.street import Street, make_plant

ON, END = 15.0, 40.0
REPORTING = MeterErrors(report_q=True)


@lru_cache
def village(name: str = "simbench-lv-rural1") -> Site:
    return choose(load(name), estimator="unknown-input", max_attacked=1)


def watch(
    site: Site,
    *,
    meter: tuple[int, float] | None = None,
    inverter: tuple[int, float] | None = None,
    errors: MeterErrors = REPORTING,
    channel: Channel | None = None,
    seconds: float = END,
    dt_s: float = 1.0,
) -> list[tuple[Estimate, Verdict]]:
    """What the family says, tick by tick; meters lie by pu, inverters by kvar."""
    one = np.ones(1)
    lies = (Bias(np.array([meter[0]]), START + ON, START + 9e9, meter[1] * one),) if meter else ()
    wrong = ()
    if inverter is not None:
        q = inverter[1] / site.feeder.base_kva * one
        wrong = (InverterAttack(np.array([inverter[0]]), q, START + ON, START + 9e9),)
    scenario = Scenario(
        seed=5,
        duration_s=seconds,
        dt_s=dt_s,
        errors=errors,
        channel=Channel() if channel is None else channel,
        attacks=lies,
        inverter_attacks=wrong,
    )
    made = watcher(site)
    state, out = made.init(START), []
    for sample in simulate(site, scenario):
        (snapshot,) = snapshots([sample])
        state, estimate, verdict = made.step(state, to_frame(site, snapshot))
        true = (sample.v_volt / site.feeder.base_volt) ** 2
        assert (np.abs(true - estimate.v2) <= estimate.bound).all()
        out.append((estimate, verdict))
    return out


def named(verdict: Verdict) -> tuple[list[int], list[int]]:
    return np.flatnonzero(verdict.suspects).tolist(), np.flatnonzero(verdict.inverters).tolist()


@pytest.mark.canary("0.05")
@pytest.mark.parametrize("lie", [0.05, -0.03])
def test_a_lying_meter_and_a_wrong_inverter_are_both_named_exactly(lie: float) -> None:
    site = village()
    answers = watch(site, meter=(4, lie), inverter=(1, -10.0))
    for k, (_, verdict) in enumerate(answers):
        assert named(verdict) == (([4], [1]) if k > ON else ([], []))
    last = answers[-1][1]
    assert (last.decision, last.cause) == (Decision.ATTACKED, Cause.RESIDUALS)
    assert "LV1.101 Load 5 and the inverter of LV1.101 Load 2;" in last.reason
    assert last.inverter_attack[1] * site.feeder.base_kva == pytest.approx(-10.0, abs=1.9)
    assert np.count_nonzero(last.inverter_attack) == 1
    # (1 + lie)^2 - 1 of about 1 pu
    assert last.attack[4] == pytest.approx(2.0 * lie + lie**2, abs=0.012)


def test_a_clean_hour_names_nobody() -> None:
    answers = watch(village(), seconds=3600.0, dt_s=10.0)
    assert all(named(verdict) == ([], []) for _, verdict in answers)
    assert {v.decision for _, v in answers[3:]} == {Decision.CLEAN}
    assert re.search(
        r"up to \d+ kvar of the inverter of LV1.101 Load \d+ could go unseen", answers[-1][1].reason
    )


def test_without_reported_reactive_power_nothing_is_called_clean() -> None:
    """Class 0.5 is too coarse for these inverters, and what is not known must not sound like an answer."""
    answers = watch(village(), errors=MeterErrors(), seconds=20.0)
    assert {v.decision for _, v in answers} == {Decision.UNDECIDED}
    assert "too coarse to judge the inverter of" in answers[-1][1].reason
    lying = watch(village(), meter=(4, 0.05), errors=MeterErrors())[-1][1]
    assert (lying.decision, named(lying)) == (Decision.ATTACKED, ([4], []))


def test_only_a_meter() -> None:
    answers = watch(village(), meter=(7, -0.04))
    assert [named(v) for _, v in answers] == [([7], []) if k > ON else ([], []) for k in range(len(answers))]


def test_only_an_inverter_whose_meter_might_as_well_lie_is_ambiguous() -> None:
    """Its voltage hardly moves: a meter that invents the reactive power, or an inverter that injects it."""
    site = village()
    last = watch(site, inverter=(1, -10.0))[-1][1]
    assert (last.decision, last.cause, named(last)) == (Decision.UNDECIDED, Cause.AMBIGUOUS, ([], []))
    own = int(np.flatnonzero(site.meters == site.droop.customer[1])[0])
    found = {(tuple(np.flatnonzero(e.meters)), tuple(np.flatnonzero(e.inverters))) for e in last.explanations}
    assert found == {((own,), ()), ((), (1,))}
    assert sum(e.probability for e in last.explanations) == pytest.approx(1.0)


@pytest.mark.canary("cigre-lv-0--95.0")
@pytest.mark.parametrize(
    ("name", "inverter", "kvar"),
    [
        ("simbench-lv-rural1", 2, -23.0),
        ("simbench-lv-rural1", 2, 23.0),
        ("cigre-lv", 0, 95.0),  # at the busbar: no voltage shows it
        ("cigre-lv", 0, -95.0),
    ],
)
def test_an_inverter_may_inject_all_that_it_is_rated_for(name: str, inverter: int, kvar: float) -> None:
    """Its curve asks for 0.44 of it at most; the rest is no proof that its meter lies."""
    site = village(name)
    rating = site.droop.rating[inverter]
    assert rating * site.feeder.base_kva == pytest.approx(abs(kvar))
    assert site.droop.limit[inverter] <= 0.44 * rating
    answers = watch(site, inverter=(inverter, kvar), seconds=ON + 10.0)
    assert all(named(verdict) == ([], []) for _, verdict in answers)
    last = answers[-1][1]
    assert (last.decision, last.cause) == (Decision.UNDECIDED, Cause.AMBIGUOUS)
    assert any(e.inverters[inverter] and not e.meters.any() for e in last.explanations)


def test_only_an_inverter_is_named_where_no_meter_can_be_the_explanation() -> None:
    """M = 0: meters are beyond doubt, and what its own one reports is proof."""
    site = village()
    made = unknown_input.design(plant(site), max_attacked=0, step_s=1.0)
    scenario = Scenario(
        seed=5,
        duration_s=30.0,
        errors=REPORTING,
        inverter_attacks=(InverterAttack(np.array([1]), np.array([-0.1]), START + ON, START + 99.0),),
    )
    state = unknown_input.init(made, START)
    for k, snapshot in enumerate(snapshots(simulate(site, scenario))):
        state, _, verdict = unknown_input.step(made, state, to_frame(site, snapshot))
        assert named(verdict) == ([], [1] if k > ON else [])


def test_more_liars_than_assumed_are_undecided() -> None:
    site = village()
    scenario = Scenario(
        seed=5,
        duration_s=30.0,
        errors=REPORTING,
        attacks=(Bias(np.array([2, 7]), START + ON, START + 99.0, np.array([0.05, -0.05])),),
    )
    made = watcher(site)
    state = made.init(START)
    for snapshot in snapshots(simulate(site, scenario)):
        state, _, verdict = made.step(state, to_frame(site, snapshot))
        assert named(verdict) == ([], [])
    assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS)


def test_a_silent_meter_is_undecided_and_a_silent_liar_stays_named() -> None:
    site = village()
    silence = Channel(silences=(MeterOutage(site.meter_ids[3], START + 20.0, START + 99.0),))
    answers = watch(site, channel=silence)
    assert (answers[-1][1].decision, answers[-1][1].cause) == (Decision.UNDECIDED, Cause.SILENT_METERS)
    silence = Channel(silences=(MeterOutage(site.meter_ids[4], START + 20.0, START + 99.0),))
    assert named(watch(site, meter=(4, 0.05), channel=silence)[-1][1]) == ([4], [])


def test_an_inverter_that_cannot_be_judged_any_more_stays_named() -> None:
    site = village()
    made = watcher(site)
    scenario = Scenario(
        seed=5,
        duration_s=END,
        errors=REPORTING,
        attacks=(Bias(np.array([4]), START + ON, START + 99.0, np.array([0.05])),),
        inverter_attacks=(InverterAttack(np.array([1]), np.array([-0.1]), START + ON, START + 99.0),),
    )
    state = made.init(START)
    for k, snapshot in enumerate(snapshots(simulate(site, scenario))):
        frame = to_frame(site, snapshot)
        if k >= 20:
            frame = replace(frame, q_net=np.full_like(frame.q_net, np.nan))
        state, _, verdict = made.step(state, frame)
        assert named(verdict) == (([4], [1]) if k > ON else ([], []))


def test_too_few_meters_and_no_busbar_are_undecided() -> None:
    site = village()
    rest = tuple(MeterOutage(meter, START, START + 99.0) for meter in site.meter_ids[2:])
    last = watch(site, channel=Channel(silences=rest), seconds=5.0)[-1][1]
    assert (last.decision, last.cause) == (Decision.UNDECIDED, Cause.TOO_FEW_METERS)
    lost = Channel(silences=(MeterOutage("", START + 18.0, START + 99.0),))
    last = watch(site, meter=(4, 0.05), channel=lost)[-1][1]
    assert (last.decision, last.cause, named(last)[0]) == (Decision.UNDECIDED, Cause.NO_BUSBAR, [4])


def test_a_late_frame_changes_nothing() -> None:
    site = village()
    made = watcher(site)
    frames = [
        to_frame(site, s) for s in snapshots(simulate(site, Scenario(duration_s=8.0, errors=REPORTING)))
    ]
    state = made.init(START)
    early = made.step(state, frames[0])
    for bad in (frames[0], frames[3]):
        state = early[0]
        for frame in frames[1:7]:
            state, estimate, _ = made.step(state, frame)
        after, again, verdict = made.step(state, bad)
        assert after is state
        np.testing.assert_array_equal(again.v2, estimate.v2)
        assert verdict.decision is Decision.UNDECIDED
    first = unknown_input.init(made.design, START)
    _, estimate, verdict = made.step(first, replace(frames[0], t=np.nan))
    assert verdict.decision is Decision.UNDECIDED
    assert estimate.bound.min() > 1.0


def test_a_quarter_of_an_hour_is_an_interval_like_any_other() -> None:
    made = village()
    answers = watch(made, meter=(4, 0.05), seconds=7200.0, dt_s=900.0)
    assert all(named(v) == ([4], []) for _, v in answers[2:])


def test_members_that_voltages_do_not_show_are_known_by_rank_and_tried_all_the_same() -> None:
    """CIGRE's first inverter sits at the busbar: no voltage shows it, whoever is trusted."""
    made = watcher(village("cigre-lv")).design
    assert len(made.missing) == 7  # with nobody and with each of six meters suspected
    assert {out.inverters for out in made.missing} == {(0,)}
    assert made.observers == 7 * 7
    assert made.pairs.inverters[:, 0].sum() == 7
    gain = made.gain[made.setting.plant.meters]
    for out in made.missing:
        kept = np.delete(gain, out.meters, axis=0)[:, out.inverters]
        assert np.linalg.matrix_rank(kept) == out.rank == 0


def test_two_inverters_at_one_bus_are_named_by_what_their_meters_report() -> None:
    """All voltages see the sum of both alone."""
    tables = load("simbench-lv-rural1").tables
    rows = list(tables.customers)
    rows[4] = replace(rows[4], bus=rows[1].bus)
    site = from_tables(replace(tables, customers=tuple(rows)))
    made = unknown_input.design(plant(site), max_attacked=0, max_inverters=2, step_s=1.0)
    assert [(out.meters, out.inverters) for out in made.missing] == [((), (1, 3))]
    wrong = InverterAttack(np.array([1, 3]), np.array([-0.04, -0.04]), START + 5.0, START + 99.0)
    scenario = Scenario(seed=5, duration_s=12.0, errors=REPORTING, inverter_attacks=(wrong,))
    state = unknown_input.init(made, START)
    for snapshot in snapshots(simulate(site, scenario)):
        state, _, verdict = unknown_input.step(made, state, to_frame(site, snapshot))
    assert (verdict.decision, named(verdict)) == (Decision.ATTACKED, ([], [1, 3]))
    assert verdict.inverter_attack[[1, 3]] == pytest.approx([-0.04, -0.04], abs=0.02)


def test_designs_that_cannot_be() -> None:
    street = make_plant(default_rng(0))
    with refused(NotObservable, "too-few-meters"):
        unknown_input.design(street, max_attacked=5, step_s=1.0)
    with refused(InputInvalid, "not-positive"):
        unknown_input.design(street, max_attacked=1, step_s=0.0)
    untold = replace(street, droop=replace(street.droop, rating=np.array(np.inf)))
    with refused(InputInvalid, "missing"):
        unknown_input.design(untold, max_attacked=1, step_s=1.0)
    with refused(DesignInfeasible, "too-many"):
        watcher(village("kerber-vorstadtnetz"))


def _street(seed: int, *, told: bool) -> tuple[Street, Generator]:
    rng = default_rng(seed)
    meters = np.sort(rng.choice(7, size=5, replace=False))
    own = np.sort(rng.choice(7, size=4, replace=False))
    made = make_plant(rng, customers=7, inverters=own, meters=meters)
    street = Street(made, rng, extreme=bool(rng.random() < 0.7), metered_q=meters if told else None)
    return street, rng


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), told=st.booleans(), h=st.sampled_from([1.0, 5.0, 900.0]))
def test_the_true_pair_is_never_refuted(seed: int, told: bool, h: float) -> None:
    """Liars of any size, errors at their extremes: honest inverters in their tubes, the true pair open."""
    street, rng = _street(seed, told=told)
    design = unknown_input.design(street.plant, max_attacked=1, step_s=h)
    state = unknown_input.init(design, street.t)
    liar, lie = int(rng.integers(5)), float(rng.choice([0.0, 0.004, 0.02, -0.1]))
    droop = street.plant.droop
    true = int(np.flatnonzero(design.pairs.meters[:, liar] & ~design.pairs.inverters.any(axis=1))[0])
    for _ in range(10):
        street.advance(h)
        frame = street.frame({liar: lie} if lie else {})
        tick = observe(design, state, frame)
        free, driven = tick.tubes.free, tick.tubes.driven
        honest = design.setting.errors.meter_of != liar
        assert ((free.low <= street.x + 1e-9) & (street.x <= free.high + 1e-9)).all()
        assert ((driven.low <= street.x + 1e-9) & (street.x <= driven.high + 1e-9))[honest].all()
        assert (free.half <= 0.5 * (droop.q[:, 0] - droop.q[:, 3]) + 1e-12).all()
        state, estimate, verdict = unknown_input.step(design, state, frame)
        assert state.contradicted.above[true] == 0
        assert np.flatnonzero(verdict.suspects).tolist() in ([], [liar] if lie else [])
        assert not verdict.inverters.any()
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6))
def test_no_test_refutes_what_a_linear_program_can_explain(seed: int) -> None:
    """Oracle: `r = C a + E d` with d in the box and a in its room, by linear programming."""
    rng = default_rng(seed)
    R, m, p = 7, 3, 5
    C, E = rng.normal(size=(R, m)), np.hstack([rng.normal(size=(R, 4)), np.eye(R)])
    # Inverters that all rows see alike, that none sees, or that differ in the last rows or by rounding alone.
    alike = int(rng.integers(5))
    if alike:
        C[:, 1] = (0.0, 2.0, 1.0 / 3.0, -1.0)[alike - 1] * C[:, 0]
        C[p:, 1] += (alike == 2) * rng.normal(size=R - p)
        C[:, 1] *= 1.0 + (alike == 3) * 1e-15 * rng.normal(size=R)
    h = rng.uniform(0.05, 0.3, E.shape[1])
    meter = np.array([0, 1, 2, 3, 4, 1, 3])
    wrong = np.zeros(m)
    wrong[:2] = rng.choice([0.0, 1.0, 5.0]), rng.choice([0.0, 0.0, 2.0])
    r = C @ wrong + E @ (h * rng.uniform(-1.0, 1.0, h.size))
    r[meter == 2] += rng.choice([0.0, 2.0])
    relation = Relation(r, C, E, h, meter, np.arange(R) < p)
    room = np.full(m, 3.0)
    for suspect in (None, 0, 2):
        for some in ([], [0], [1], [0, 1]):
            meters, inverters = np.arange(p) == suspect, np.isin(np.arange(m), some)
            keep = ~meters[meter]
            box = [(-3.0, 3.0) if on else (0.0, 0.0) for on in inverters] + [(-1.0, 1.0)] * h.size
            possible = linprog(
                np.zeros(m + h.size), A_eq=np.hstack([C, E * h])[keep], b_eq=r[keep], bounds=box
            ).success
            trial = try_pair(believe(relation, meters), inverters, room)
            assert trial.fits or not possible
            if suspect == 2 and inverters[0] and (inverters[1] or not wrong[1]):
                off = np.abs(trial.attack - wrong)[inverters]
                assert (off <= trial.attack_error[inverters] * (1.0 + 1e-9)).all()


def test_pairs_begin_with_nobody_and_know_who_is_within_whom() -> None:
    found, missing = pairs(default_rng(1).normal(size=(5, 3)), 2, 1)
    assert len(found.meters) == (1 + 5 + 10) * (1 + 3)
    assert not missing
    both = np.hstack([found.meters, found.inverters])
    assert not both[0].any()
    assert (np.diff(both.sum(axis=1)) >= 0).all()
    brute = [[not (a & ~b).any() for b in both] for a in both]
    np.testing.assert_array_equal(found.within(), brute)

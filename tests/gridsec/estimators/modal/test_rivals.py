"""Rival models of the loads against dense filters, and loads that jump without a report."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks._residuals import Dense, Source, power_columns, tree
from gridsec.arrays import Floats
from gridsec.estimators.modal import core, full, rivals, signatures
from gridsec.estimators.modal.detector import Evidence
from gridsec.estimators.modal.rivals import RATE, UNREST
from tests.gridsec.estimators.modal.test_core import LIAR, MODEL
from tests.gridsec.estimators.modal.test_detector import busbar
from tests.gridsec.estimators.modal.test_filter import masks, mixed, proportional

STEPS = power_columns(tree(12, np.random.default_rng(3)))[:, :12]
"""Effect of active powers on the residuals of `MODEL`."""


@pytest.mark.parametrize("make", [proportional, busbar, mixed])
@pytest.mark.parametrize("kind", ["complete", "random"])
@pytest.mark.parametrize("unrest", range(len(UNREST)))
def test_evidence_and_scores_equal_those_of_the_dense_filter(make: object, kind: str, unrest: int) -> None:
    """Jumps as the rival found them: likelihood of all readings, and posterior of faults in all members."""
    assert callable(make)
    model, onset, ticks, p = make(), 22, 40, 12
    kernel = core.assemble(model, np.zeros((13, 12)), np.ones(12), gamma=1e6)
    made = kernel.rivals[unrest]
    seen = np.ones((ticks, p), dtype=np.bool_)
    if kind == "random":
        seen[15:] = masks(kind, p, ticks)[15:]
    readings = Source(model, np.random.default_rng(5)).ticks(ticks)
    readings[onset:] += 8.0 * np.sqrt(model.loads(np.arange(p)).diagonal())
    mine = rivals.first(kernel.modes, kernel.rivals, core.init(kernel, 0.0).history)[1 + unrest]
    dense, without = Dense(model, np.eye(p), 1.0), Dense(model)
    for each in (dense, without):
        each.prior[:p, :p] *= UNREST[unrest]
    rho = np.exp(-1.0 / model.time_s)
    exact = 0.0
    for k in range(ticks):
        before = mine
        mine = rivals.follow(mine, float(k), readings[k], seen[k], begun=k == onset)
        rho2 = rho**2 if k else 1.0
        size = mine.loads - rho2 * before.loads - (1.0 - rho2) * UNREST[unrest]
        for each in (dense, without):
            each.cov[:p, :p] += size / rho2 * model.loads(np.arange(p))
            nu, V = each.step(1.0 if k else 0.0, readings[k], seen[k], level=float(k >= onset))
        jumped = mine.jumps != before.jumps
        exact += np.log(RATE if jumped else 1.0 - 2.0 * RATE)
        exact -= 0.5 * float(nu @ np.linalg.solve(V, nu) + np.linalg.slogdet(V)[1])
    assert mine.jumps
    first = rivals.first(kernel.modes, kernel.rivals, core.init(kernel, 0.0).history)[1 + unrest]
    start = 0.5 * float(np.linalg.slogdet(np.diag(made.sign))[1]) if made.sign.size else 0.0
    assert first.evidence == 0.0
    assert mine.evidence == pytest.approx(exact + start, abs=1e-5)
    cov, now = dense.cov[3 * p :, 3 * p :], mine.joint()
    information, score = made.U @ now.information @ made.U.T, made.U @ now.score
    assert np.allclose(np.linalg.inv(cov), np.eye(p) + information, rtol=1e-5, atol=1e-3)
    assert np.allclose(cov @ score, dense.mean[3 * p :], atol=1e-7 * np.abs(dense.mean[3 * p :]).max())


def test_the_first_of_the_rivals_is_the_model() -> None:
    """Its scores are those of the detector, also for an onset before the kept readings."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    for k in range(500):
        lie = 0.001 * (k >= 200) * np.eye(12)[LIAR]
        state, evidence = core.step(kernel, state, float(k), source.tick() + lie)
    row = int(evidence.rows[0])
    mine = rivals.replayed(kernel.modes, kernel.rivals, state.history, state.detector.onsets, row)[0]
    other = signatures.joint(kernel.modes, state.detector.onsets, state.static, row)
    now = mine.joint()
    assert np.allclose(now.score, other.score, atol=1e-8 * np.abs(other.score).max())
    assert np.allclose(now.information, other.information, atol=1e-8 * np.abs(other.information).max())


@pytest.mark.parametrize("missing", [False, True])
def test_transitions_equal_the_dense_filter(missing: bool) -> None:
    """Every reading has an own unknown amount at the first 1, 2 and 4 ticks since an onset 7 ticks ago."""
    kernel, p, ticks, age = core.assemble(MODEL, np.zeros((13, 12)), np.ones(12), gamma=1e6), 12, 40, 7
    seen = np.arange(p) < p - missing
    readings, state = Source(MODEL, np.random.default_rng(5)).ticks(ticks), core.init(kernel, 0.0)
    for k, m in enumerate(readings):
        state, _ = core.step(kernel, state, float(k), m, seen)
    found = rivals.transitions(kernel.modes, state.history, age)
    assert [each.transition for each in found] == [1, 2, 4]
    for mine in found:
        dense, without, exact = Dense(MODEL, np.eye(p), 1.0), Dense(MODEL), 0.0
        for k, m in enumerate(readings):
            since = k - (ticks - age)
            for each in (dense, without):
                each.D = MODEL.noise(np.arange(p))
                if 0 <= since < mine.transition:
                    each.D = each.D + rivals.APART**2 * np.eye(p)
                nu, V = each.step(1.0 if k else 0.0, m, seen, level=float(since >= 0))
            exact -= 0.5 * float(nu @ np.linalg.solve(V, nu) + np.linalg.slogdet(V)[1])
        sign = kernel.modes.sign
        start = 0.5 * float(np.linalg.slogdet(np.diag(sign))[1]) if sign.size else 0.0
        assert mine.evidence == pytest.approx(exact + start, abs=1e-5)
        now = mine.joint()
        information = kernel.modes.U @ now.information @ kernel.modes.U.T
        inverse = np.linalg.inv(dense.cov[3 * p :, 3 * p :])
        assert np.allclose(inverse, np.eye(p) + information, rtol=1e-5, atol=1e-3)
    # An onset before the kept readings has none.
    assert not rivals.transitions(kernel.modes, core.init(kernel, 0.0).history, age)


def test_manipulations_that_begin_one_after_another() -> None:
    """Four meters, one more at each tick: one onset explains nothing, and with a transition all are found."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, state, liars = (
        Source(MODEL, np.random.default_rng(1)),
        core.init(kernel, 0.0),
        np.arange(12) % 3 == 1,
    )
    alone = []
    for k in range(212):
        begun = np.cumsum(liars) <= k - 199
        m = source.tick() + 0.06 * (liars & begun)
        state, evidence = core.step(kernel, state, float(k), m)
        if k >= 206:
            suspicion = core.identify(kernel, state, evidence)
            alone.append(suspicion.fits)
            if k == 206:
                # The misfit that steps since one onset leave is variance; without them it is all of it.
                open_, model = core.estimate(kernel, state), state.rivals[0]
                squares = sum(each for each, _ in model.excess) - rivals.by_chance(model.count)
                assert open_.beyond == pytest.approx(1.0 + squares / model.count)
                assert open_.beyond > suspicion.beyond > 2.0
                assert core.estimate(kernel, state, suspicion).beyond == suspicion.beyond
            after = core.transition(kernel, state, suspicion)
            if after is not state:
                state, suspicion = after, core.identify(kernel, after, evidence)
            assert suspicion.fits
            assert suspicion.beyond == 1.0
            assert (suspicion.found.named == liars).all()
    assert not alone[0]
    # The rival with the transition is followed.
    assert all(alone[1:])
    assert sum(each.transition > 0 for each in state.rivals) == 1
    assert core.adopt(kernel, state, suspicion) is state


@pytest.mark.canary("1")
@pytest.mark.parametrize("seed", range(3))
def test_a_transition_that_ends_too_early_names_nothing(seed: int) -> None:
    """Four meters, one more at every other tick. The last one begins after a transition of four ticks."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(seed)), core.init(kernel, 0.0)
    liars, named, settled = np.arange(12) % 3 == 1, list[int](), list[bool]()
    for k in range(213):
        m = source.tick() + 0.06 * (liars & (2 * np.cumsum(liars) <= k - 198))
        state, evidence = core.step(kernel, state, float(k), m)
        if k >= 205:
            suspicion = core.identify(kernel, state, evidence)
            after = core.transition(kernel, state, suspicion)
            if after is not state:
                state, suspicion = after, core.identify(kernel, after, evidence)
            assert suspicion.fits or not suspicion.found.named.any()
            assert not (suspicion.found.named & ~liars).any()
            named.append(int(suspicion.found.named.sum()))
            settled.append(suspicion.settled)
    assert named == [3, 0, 0, 0, 4, 4, 4, 4]
    assert settled == [True, False, False, False, True, True, True, True]


def until_passed(
    kernel: core.Core, manipulated: Floats, seed: int
) -> tuple[int, core.CoreState, tuple[core.CoreState, Evidence] | None]:
    """Last tick and state of a manipulation from tick 200 on, and the state without it, if it passes."""
    source, state = Source(MODEL, np.random.default_rng(seed)), core.init(kernel, 0.0)
    suspicion, over, k = None, None, 0
    for k in range(200 + len(manipulated)):
        m = source.tick() + (manipulated[k - 200] if k >= 200 else 0.0)
        state, evidence = core.step(kernel, state, float(k), m)
        if k < 200 or (k > 205 and k % 4):
            continue
        assert core.alarmed(kernel, evidence)
        suspicion = core.identify(kernel, state, evidence, suspicion)
        after = core.transition(kernel, state, suspicion)
        if after is not state:
            state, suspicion = after, core.identify(kernel, after, evidence, suspicion)
        over = core.passed(kernel, state, suspicion)
        if over is not None:
            break
    return k, state, over


@pytest.mark.canary("0-1")
@pytest.mark.parametrize(("seed", "length"), [(0, 1), (1, 4)])
def test_readings_of_a_transition_that_has_passed_are_given_up(seed: int, length: int) -> None:
    """The filter is then the dense one with these readings as good as unknown, and nothing is suspected."""
    kernel, p = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6), 12
    manipulated = np.zeros((40, p))
    manipulated[:length] = np.random.default_rng(seed).normal(0.0, 0.08, (length, p)) * (
        np.arange(p) % 3 == 1
    )
    k, _, over = until_passed(kernel, manipulated, seed)
    assert over is not None
    assert core.PASSED <= k - 199 - length <= core.PASSED + 8
    after, _ = over
    assert after.detector.log_m < core.CALM * kernel.limit
    assert not after.detector.pinned.any()
    again, dense = Source(MODEL, np.random.default_rng(seed)), Dense(MODEL)
    for tick in range(k + 1):
        inside = 200 <= tick < 200 + length
        m = again.tick() + (manipulated[tick - 200] if inside else 0.0)
        dense.D = MODEL.noise(np.arange(p)) + inside * rivals.APART**2 * np.eye(p)
        dense.step(float(tick > 0), m)
    mine = full.expanded(kernel.modes, after.filter, after.static).mean[0]
    std = np.sqrt(dense.cov[:p, :p].diagonal())
    # The return to the modes enlarges the covariance.
    assert (np.abs(mine - dense.varies) < 0.3 * std).all()


def test_a_manipulation_that_lasts_does_not_pass() -> None:
    """Four meters, one more at each tick."""
    kernel, liars = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6), np.arange(12) % 3 == 1
    manipulated = 0.06 * (liars & (np.cumsum(liars) <= np.arange(32)[:, None] + 1))
    _, state, over = until_passed(kernel, manipulated, 1)
    assert over is None
    assert any(each.transition for each in state.rivals)


def test_no_onset_after_a_misfit_explains_it() -> None:
    """Readings of tick 20 to 23 are off at all meters, and the onset is that of tick 20."""
    kernel, source = (
        core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6),
        Source(MODEL, np.random.default_rng(2)),
    )
    (one,) = rivals.first(kernel.modes, (), core.init(kernel, 0.0).history)
    for k in range(60):
        off = 0.02 * np.random.default_rng(k).normal(size=12) * (20 <= k < 24)
        one = rivals.follow(one, float(k), source.tick() + off, None, begun=k == 20)
    assert len(one.excess) == one.ticks == 40
    assert sum(each for each, _ in one.excess) == pytest.approx(one.misfit)
    assert sum(count for _, count in one.excess) == one.count
    assert [age for age in range(1, 50) if one.before(age) > 0.0] == list(range(1, 40))
    assert one.before(36) == pytest.approx(sum(each for each, _ in one.excess[:4]) - rivals.by_chance(48))


def test_a_ramp_since_an_onset_before_that_of_the_misfit_explains_it() -> None:
    """Two meters drift; the misfit of the models begins with a later step."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(0)), core.init(kernel, 0.0)
    liars, older = np.isin(np.arange(12), (4, 9)), 0
    for k in range(240):
        m = source.tick() + 0.001 * max(0, k - 199) * liars
        state, evidence = core.step(kernel, state, float(k), m)
        if k < 215 or not core.alarmed(kernel, evidence):
            continue
        suspicion = core.identify(kernel, state, evidence)
        age = int(state.detector.onsets.age[suspicion.row])
        if suspicion.found.model[0] == 0 and age > state.rivals[0].ticks + 4:
            older += 1
            assert (suspicion.found.chosen[0, :12] == liars).all()
            assert suspicion.settled
            assert suspicion.beyond < 3.0
    assert older >= 2


STEPS_OF_PLACES = np.vstack([np.zeros((1, 12)), STEPS])


@pytest.mark.canary("complete-False")
@pytest.mark.parametrize(
    ("kind", "liar"), [("complete", False), ("random", True), ("complete", True), ("random", False)]
)
def test_loads_that_jump_accuse_no_honest_meter(kind: str, liar: bool) -> None:
    """Five cars of 11 kW, each for a minute: none is named but a meter that is off by 2 %."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, random = Source(MODEL, np.random.default_rng(1)), np.random.default_rng(2)
    state, jumps, named = core.init(kernel, 0.0), np.zeros((260, 12)), np.zeros(12, dtype=np.bool_)
    for j in random.permutation(12)[:5]:
        begin = int(random.integers(150, 200))
        jumps[begin : begin + 60, j] = -0.11
    seen = np.ones((260, 12), dtype=np.bool_)
    if kind == "random":
        seen[100:] = random.random((160, 12)) > 0.2
    alarms = 0
    for k in range(260):
        m = source.tick() + STEPS @ jumps[k] + 0.04 * (liar and k >= 130) * np.eye(12)[LIAR]
        state, evidence = core.step(kernel, state, float(k), m, seen[k])
        if core.alarmed(kernel, evidence) and k % 8 == 7:
            alarms += 1
            suspicion = core.identify(kernel, state, evidence)
            named, state = suspicion.found.named, core.adopt(kernel, state, suspicion)
            assert not named[np.arange(12) != LIAR].any()
    assert alarms
    assert named[LIAR] == liar


@pytest.mark.parametrize(("missing", "open_"), [(False, False), (True, False), (False, True)])
def test_a_load_that_no_report_shows_is_adopted(missing: bool, open_: bool) -> None:
    """11 kW for good at the root: the alarm ends, and the voltages at all meters are those with the load."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    seen = np.arange(12) != 11 if missing else None
    unknown = 0.002 * STEPS[:, 5:6] if open_ else None
    alarms = adopted = 0
    for k in range(130):
        m = source.tick() + STEPS[:, 0] * (-0.11 if k >= 60 else 0.0)
        state, evidence = core.step(kernel, state, float(k), m, seen, unknown)
        if core.alarmed(kernel, evidence):
            alarms += 1
            suspicion = core.identify(kernel, state, evidence)
            assert not suspicion.found.named.any()
            after = core.adopt(kernel, state, suspicion)
            adopted += after is not state
            state = after
            # The voltages are those of the tick that is adopted.
            now = core.estimate(kernel, state)
            assert np.isfinite(now.mean).all()
            assert now.rest is None or np.allclose(now.rest, m - state.filter.full.mean.sum(axis=0))
            assert (now.rest is None) == (unknown is None)
    assert alarms
    assert 1 <= adopted <= 3
    assert not core.alarmed(kernel, evidence)
    found, at = core.estimate(kernel, state), MODEL.meters
    off = found.mean[at] - source.w - STEPS[:, 0] * -0.11
    # The fixed error of the busbar's meter is common to all.
    assert (np.abs(off) < 4.0 * np.sqrt(found.variance[at] + MODEL.busbar + MODEL.fixed)).all()


def test_no_load_is_adopted_while_a_meter_is_doubted() -> None:
    """A meter that is off by 5 %: the state stays."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    for k in range(100):
        m = source.tick() + 0.1 * (k >= 80) * np.eye(12)[LIAR]
        state, evidence = core.step(kernel, state, float(k), m)
    suspicion = core.identify(kernel, state, evidence)
    assert core.adopt(kernel, state, suspicion) is state


@pytest.mark.parametrize("onset", [10, 20])
def test_steps_that_rivals_share_are_those_of_each(onset: int) -> None:
    """The model and its rivals with a jump, an onset and missing readings, together and one by one."""
    kernel = core.assemble(MODEL, STEPS_OF_PLACES, np.full(12, 0.1), gamma=1e6)
    source, jump = Source(MODEL, np.random.default_rng(3)), 0.02 * np.ones(12)
    each = rivals.first(kernel.modes, kernel.rivals, core.init(kernel, 0.0).history)
    together, shared = list(each), 0
    for k in range(30):
        seen = np.arange(12) != 5 if k >= 15 else None
        tick = float(k), source.tick() + jump * (k >= 25), seen
        each = [rivals.follow(one, *tick, begun=k == onset) for one in each]
        together = rivals.followed(together, *tick, begun=k == onset)
        shared += together[0].filter is together[1].filter
        for one, other in zip(each, together, strict=True):
            assert (one.evidence, one.misfit, one.jumps) == (other.evidence, other.misfit, other.jumps)
            assert (one.filter.mean == other.filter.mean).all()
            if k >= onset:
                assert (one.scored().information == other.scored().information).all()
    assert 15 <= shared < 30

"""Metered reactive power against the droop curves: no honest error looks wrong, nothing wrong looks clean."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import Site, load, names, to_frame
from feeders.registry import design
from feeders.simulation.scenario import START
from feeders.simulation.trial import AttackKind, AttackSpec, LoadError, Trial, TrialMeterErrors, frames
from gridsec.attack import Bias
from gridsec.estimators.modal import monitor
from gridsec.interface import Cause, Decision, Frame, Verdict
from tests.feeders.registry.test_adversarial import HIGH, LOW, Ends, World, default

WITH_INVERTERS = [name for name in names() if load(name).droop.tau.size]


class Reporting(World):
    """A feeder whose meters report the net reactive power too, as wrong as they may."""

    def snapshot(self, lies: dict[int, float], wrong: float = 1.0) -> object:
        base, at, model = self.site.feeder.base_kva, self.site.meters, self.site.loads
        injected = np.bincount(self.site.droop.customer, self.now.x, self.q.size) * base
        net = (self.q - injected)[at]
        floor = np.broadcast_to(model.q_error, self.q.size)[at] * base
        error = np.maximum(floor, model.q_fraction / (1.0 + model.q_fraction) * np.abs(net))
        return replace(super().snapshot(lies), q_kvar=net + wrong * error)


@pytest.mark.canary("1.0-cigre-lv", "900.0-cigre-lv")
@pytest.mark.parametrize("name", WITH_INVERTERS)
@pytest.mark.parametrize("step_s", [1.0, 900.0])
def test_honest_errors_at_their_ends_never_accuse_an_inverter(name: str, step_s: float) -> None:
    made = default(name, step_s)
    for ends in (HIGH, LOW, Ends(1, 1, 1, 1)):
        for v0, load_, sun in ((0.95, 1.0, 0.0), (1.05, 0.1, 1.0)):
            for wrong in (-1.0, 1.0):
                world = Reporting(name, ends, v0=v0, load=load_, sun=sun)
                state = made.init(world.t)
                for _ in range(9 if step_s == 1.0 else 7):
                    world.run(step_s)
                    frame = to_frame(world.site, world.snapshot({}, wrong))  # type: ignore[arg-type]
                    assert np.isfinite(frame.q_net[world.site.meters]).all()
                    state, estimate, verdict = made.step(state, frame)
                    # Honest errors are taken for independent: all at their ends, they are a misfit.
                    assert verdict.cause in {Cause.AGREEMENT, Cause.SETTLING, Cause.MISFIT}
                    true = (world.now.v_volt / world.volt) ** 2
                    assert (np.abs(estimate.v2 - true) <= estimate.bound).all()


def off_their_curves(count: int, liar: int | None) -> tuple[Site, set[int], Verdict]:
    """A minute of inverters off their curves and of a false meter: the last verdict, and the owners."""
    site = load("cigre-lv")
    lie = AttackSpec(AttackKind.INVERTER, count, 100.0)
    trial = Trial(site, 0, duration_s=60.0, load_error=LoadError(0.1, 0.05), lie=lie, report_q=True)
    honest = trial.scenario
    owners = set(site.droop.customer[honest.inverter_attacks[0].inverters].tolist())
    attacks = () if liar is None else (Bias(np.array([liar]), START + 30.0, START + 90.0, np.array([0.03])),)
    watcher = design(trial.stated)
    state = watcher.init(0.0)
    for frame, _ in frames(trial, replace(honest, attacks=attacks)):
        state, _, verdict = watcher.step(state, frame)
    return site, owners, verdict


@pytest.mark.canary("2-None", "2-2")
@pytest.mark.parametrize(("count", "liar"), [(1, 2), (2, None), (2, 2)])
def test_the_default_names_an_inverter_and_tells_of_the_other(count: int, liar: int | None) -> None:
    """The voltages decide for one of two inverters."""
    site, owners, verdict = off_their_curves(count, liar)
    assert verdict.decision is Decision.ATTACKED
    assert np.flatnonzero(verdict.suspects).tolist() == ([] if liar is None else [liar])
    named = set(site.droop.customer[verdict.inverters].tolist())
    assert len(named) == 1
    assert named <= owners
    assert all(site.feeder.customers[owner] in verdict.reason for owner in owners)


def watched(
    name: str,
    *,
    seed: int = 0,
    meters: TrialMeterErrors = TrialMeterErrors.SITE,
    error: LoadError | None = None,
) -> Iterator[tuple[Frame, Verdict, int]]:
    """A minute in which one inverter leaves its curve by its rating after 30 s: frames, verdicts, whose."""
    trial = Trial(
        load(name),
        seed,
        duration_s=60.0,
        load_error=LoadError(0.1, 0.05) if error is None else error,
        meters=meters,
        lie=AttackSpec(AttackKind.INVERTER, 1, 100.0),
        report_q=True,
    )
    watcher = design(trial.stated)
    state = watcher.init(0.0)
    for frame, truth in frames(trial):
        state, _, verdict = watcher.step(state, frame)
        yield frame, verdict, int(np.argmax(truth.inverters)) if truth.inverters.any() else -1


@pytest.mark.canary(
    "0-cigre-lv",
    "1-simbench-lv-rural1",
)
@pytest.mark.parametrize("name", [name for name in WITH_INVERTERS if name != "kerber-vorstadtnetz"])
@pytest.mark.parametrize("seed", [0, 1])
def test_an_inverter_off_its_curve_is_never_clean_and_nobody_else_is_accused(name: str, seed: int) -> None:
    site, since = load(name), 0
    for _, verdict, which in watched(name, seed=seed):
        assert not verdict.suspects.any()
        assert not np.delete(verdict.inverters, max(which, 0)).any()
        since += which >= 0
        if since <= 6:
            continue
        assert verdict.decision is not Decision.CLEAN
        owner = int(site.droop.customer[which])
        assert not verdict.unjudged[which]
        for k, way in enumerate(verdict.explanations):
            assert not way.meters.any()
            accused = set(site.droop.customer[way.inverters].tolist()) | set(
                np.flatnonzero(way.powers).tolist()
            )
            # False powers elsewhere that the voltages do not exclude are stated, too, at 1 % each.
            assert accused == {owner} or (k and owner in accused)
    assert since > 20


def test_the_voltages_say_that_it_is_the_inverter_where_they_can() -> None:
    answers = list(watched("cigre-lv", meters=TrialMeterErrors.WHITE, error=LoadError(0.01, 0.01)))
    _, verdict, which = answers[-1]
    assert verdict.decision is Decision.ATTACKED
    assert np.flatnonzero(verdict.inverters).tolist() == [which]
    droop, site = load("cigre-lv").droop, load("cigre-lv")
    rating = site.tables.customers[int(droop.customer[which])].inverter_kva / site.feeder.base_kva
    assert abs(verdict.inverter_attack[which]) == pytest.approx(rating, rel=0.3)


@pytest.mark.parametrize("meters", [TrialMeterErrors.SITE, TrialMeterErrors.WHITE])
def test_a_false_report_is_never_clean_and_names_no_inverter(meters: TrialMeterErrors) -> None:
    """The inverter does as it should; what the meter says of the reactive power is off by its rating."""
    site = load("cigre-lv")
    error = LoadError(0.01, 0.01) if meters is TrialMeterErrors.WHITE else LoadError(0.1, 0.05)
    trial = Trial(site, 3, duration_s=60.0, load_error=error, meters=meters, report_q=True)
    c = int(site.droop.customer[0])
    false = site.tables.customers[c].inverter_kva / site.feeder.base_kva
    watcher, late = design(trial.stated), []
    state = watcher.init(0.0)
    for k, (frame, _) in enumerate(frames(trial)):
        q_net = frame.q_net.copy()
        q_net[c] += false * (k >= 20)
        state, _, verdict = watcher.step(state, replace(frame, q_net=q_net))
        assert not verdict.inverters.any()
        assert not verdict.suspects.any()
        late += [verdict] * (k >= 26)
    assert all(verdict.decision is Decision.UNDECIDED for verdict in late)
    assert all(verdict.cause is Cause.AMBIGUOUS for verdict in late)
    assert all(np.flatnonzero(way.powers).tolist() in ([], [c]) for v in late for way in v.explanations)


def test_inverters_that_nobody_hears_and_that_move_nothing_are_not_judged() -> None:
    trial = Trial(load("simbench-lv-rural1"), 0, duration_s=40.0)  # what they inject is forgotten by then
    for heard, error in (
        (False, LoadError(0.1, 0.05)),
        (True, LoadError(0.1, 0.05)),
        (True, LoadError(2.0, 2.0)),
    ):
        told = replace(trial, report_q=heard, load_error=error)
        watcher = design(told.stated)
        state = watcher.init(0.0)
        for frame, _ in frames(told):
            state, _, verdict = watcher.step(state, frame)
        # Nor where loads are known less well than what an inverter can inject.
        assert verdict.unjudged.any() != (heard and error.q_kvar < 1.0)


def test_who_pauses_is_not_forgotten() -> None:
    """A report that is false for four seconds and true for four, again and again, is not CLEAN for long."""
    site = load("cigre-lv")
    trial = Trial(site, 3, duration_s=90.0, load_error=LoadError(0.1, 0.05), report_q=True)
    c = int(site.droop.customer[1])
    false = site.tables.customers[c].inverter_kva / site.feeder.base_kva
    watcher, late = design(trial.stated), []
    state = watcher.init(0.0)
    for k, (frame, _) in enumerate(frames(trial)):
        q_net = frame.q_net.copy()
        q_net[c] += false * (k >= 20 and k % 8 < 4)
        state, _, verdict = watcher.step(state, replace(frame, q_net=q_net))
        assert not verdict.inverters.any()
        late += [verdict.decision] * (k >= 40)
    assert Decision.CLEAN not in late


def test_nothing_of_a_replaced_meter_counts() -> None:
    site = load("cigre-lv")
    trial = Trial(site, 3, duration_s=30.0, load_error=LoadError(0.1, 0.05), report_q=True)
    c = int(site.droop.customer[1])
    made, which = design(trial.stated).design, site.meters == c
    state = monitor.init(made, 0.0)
    for k, (frame, _) in enumerate(frames(trial)):
        q_net = frame.q_net.copy()
        q_net[c] += 0.5 * (10 <= k < 20)
        q_net[:] = np.nan if k >= 20 else q_net
        state = monitor.renew(made, state, which) if k == 22 else state
        state, _, verdict = monitor.step(made, state, replace(frame, q_net=q_net))
        # Silence clears nobody; a new meter does.
        assert k != 21 or verdict.cause is Cause.AMBIGUOUS
    assert verdict.decision is Decision.CLEAN

"""Trials: their frames against an independent power flow, their lies, and judgement with known answers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pandapower as pp
import pytest

from feeders.model.site import Site, Snapshot, from_tables, load, load_doubt, to_frame
from feeders.registry import FAMILIES, DesignedEstimator, Estimator, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec, NoSuchAttack, manipulations
from feeders.simulation.demand import Customers
from feeders.simulation.plant import Channel, MeterOutage
from feeders.simulation.scenario import START, simulate
from feeders.simulation.trial import FrameTruth, LoadError, Trial, TrialMeterErrors, frames, judge
from gridsec.arrays import Floats
from gridsec.attack import Coordinated
from gridsec.interface import Cause, Decision, Estimate, Frame, Verdict
from tests.codes import refused

SMALL = "simbench-lv-rural1"


@cache
def small() -> Site:
    return load(SMALL)


def trial(trick: AttackKind | None = None, **changes: Any) -> Trial:
    lie = (
        None
        if trick is None
        else AttackSpec(trick, 2, 60.0 if trick in {AttackKind.REPLAY, AttackKind.CLOCK_SHIFT} else 3.0)
    )
    return replace(Trial(small(), seed=3, duration_s=60.0, lie=lie), **changes)


def played(trick: AttackKind | None = None, **changes: Any) -> list[tuple[Frame, FrameTruth]]:
    return list(frames(trial(trick, **changes)))


def reported(trick: AttackKind | None = None, **changes: Any) -> Floats:
    """Voltages as told, in pu, (T, p)."""
    y: Floats = np.array([frame.y for frame, _ in played(trick, **changes)])
    return np.sqrt(y)


# --------------------------------------------------------------------------------------- truth and frames


def pandapower_net(site: Site) -> Any:
    """The feeder in pandapower, straight from its tables; shares no code with the project's power flow."""
    meta = site.tables.meta
    net = pp.create_empty_network(f_hz=50.0)
    kilovolt = meta.voltage_volt * np.sqrt(3.0) / 1e3
    bus: dict[str, int] = {}
    for name in {end for row in site.tables.lines for end in (row.from_bus, row.to_bus)}:
        bus[name] = pp.create_bus(net, vn_kv=kilovolt)
    pp.create_ext_grid(net, bus[meta.busbar])
    for row in site.tables.lines:
        if row.closed and row.r_ohm == row.x_ohm == 0.0:
            pp.create_switch(net, bus[row.from_bus], bus[row.to_bus], et="b")
        elif row.closed:
            pp.create_line_from_parameters(
                net, bus[row.from_bus], bus[row.to_bus], 1.0, row.r_ohm, row.x_ohm,
                c_nf_per_km=row.b_us * 1e3 / (2 * np.pi * 50.0), max_i_ka=1.0,
            )  # fmt: skip
    for customer in site.tables.customers:
        pp.create_load(net, bus[customer.bus], p_mw=0.0, q_mvar=0.0)
    return net


def test_the_truth_is_ac_power_flow_of_the_true_loads_with_their_droop_inverters() -> None:
    """Oracle: pandapower, and the loop's equation x = K(v) held where everything has settled."""
    made = trial(variation=replace(trial().variation, hidden_correlation_s=600.0))
    site, net = made.stated, pandapower_net(small())
    samples = list(simulate(site, made.scenario))
    pairs = played()
    for k in (0, 17, 59):
        sample, (frame, truth) = samples[k], pairs[k]
        net.load["p_mw"], net.load["q_mvar"] = sample.p_kw / 1e3, sample.q_kvar / 1e3
        known = Customers(site, made.scenario.variation, 3, START, made.profile_s).at(np.array([sample.t]))
        net.ext_grid["vm_pu"] = known.v0_volt[0] / site.tables.meta.voltage_volt
        pp.runpp(net, init="dc", tolerance_mva=1e-12)
        np.testing.assert_allclose(truth.v2, net.res_bus.vm_pu[net.load.bus].to_numpy() ** 2, atol=1e-7)
        # The frame tells what the profiles say, and the truth is something else.
        np.testing.assert_allclose(-frame.p * site.feeder.base_kva, known.p_kw[0], atol=1e-9)
        np.testing.assert_allclose(-frame.q * site.feeder.base_kva, known.q_kvar[0], atol=1e-9)
        own_q = np.zeros(frame.q.size)
        own_q[site.droop.customer] = sample.x_kvar
        hidden_q = sample.q_kvar + own_q - known.q_kvar[0]
        assert 0.1 < np.std(sample.p_kw - known.p_kw[0]) < 1.2
        assert 0.03 < np.std(hidden_q) < 0.4


def test_load_errors_are_an_ornstein_uhlenbeck_process() -> None:
    """Standard deviation, and correlation over a third and over all of the correlation time."""
    made = trial(duration_s=30_000.0, step_s=20.0, load_error=LoadError(0.6, 0.2, 60.0))
    scenario, site = made.scenario, made.stated
    t = START + 20.0 * np.arange(1500.0)
    p, q = Customers(site, scenario.variation, 3, START, made.profile_s).hidden(t)
    for values, std in ((np.asarray(p), 0.6), (np.asarray(q), 0.2)):
        assert values.shape == (1500, 13)
        assert np.std(values) == pytest.approx(std, rel=0.04)
        for lag in (1, 3):
            found = np.mean(values[:-lag] * values[lag:]) / np.mean(values**2)
            assert found == pytest.approx(np.exp(-20.0 * lag / 60.0), abs=0.04)
    np.testing.assert_allclose(np.corrcoef(np.asarray(p).T) - np.eye(13), 0.0, atol=0.2)


def test_intervals_give_the_standard_deviation_back_and_the_files_state_it() -> None:
    frame, _ = played(load_error=LoadError(0.5, 0.1))[0]
    made = trial(load_error=LoadError(0.5, 0.1, 300.0))
    base = small().feeder.base_kva
    np.testing.assert_allclose(frame.p_error / np.sqrt(3.0) * base, 0.5)
    np.testing.assert_allclose(frame.q_error / np.sqrt(3.0) * base, 0.1)
    doubt = load_doubt(made.stated)
    np.testing.assert_allclose((doubt.p * base)[0], 0.5)
    np.testing.assert_allclose((doubt.q * base)[0], 0.1)
    assert (doubt.time_s, doubt.common_q) == (300.0, 0.0)
    wide, _ = played(load_error=LoadError(0.5, 0.1, half_width=3.0))[0]
    np.testing.assert_allclose(wide.p_error * base, 1.5)


def test_without_load_errors_frames_are_those_of_service_and_hold_the_truth() -> None:
    """Registers and power factors err as the files say, by as much as the intervals have, all the time."""
    made = trial(load_error=None, meters=TrialMeterErrors.SITE)
    assert made.stated.tables.customers == small().tables.customers
    assert made.stated.tables.meta == small().tables.meta
    samples, base = list(simulate(small(), made.scenario)), small().feeder.base_kva
    off = []
    for sample, (frame, _) in zip(samples, frames(made), strict=True):
        p, q = np.zeros((2, frame.p.size))
        p[:], q[:] = -sample.p_kw / base, -sample.q_kvar / base
        q[small().droop.customer] -= sample.x_kvar / base
        assert (np.abs(p - frame.p) <= frame.p_error + 1e-12).all()
        assert (np.abs(q - frame.q) <= frame.q_error + 1e-12).all()
        off.append((q - frame.q) / frame.q_error)
    # They last: what a power factor is wrong by stays, customer by customer, and is no small part.
    mean = np.mean(off, axis=0)
    assert np.std(np.array(off) - mean) < 0.2 * np.std(mean)
    assert 0.2 < np.std(mean) < 1.0


def test_what_the_files_say_to_come_and_go_does() -> None:
    tables = small().tables
    told = tuple(replace(row, p_std_kw=0.5, q_std_kvar=0.25) for row in tables.customers[:4])
    site = from_tables(replace(tables, customers=(*told, *tables.customers[4:])))
    made = Trial(
        site, seed=3, duration_s=20_000.0, step_s=20.0, load_error=None, meters=TrialMeterErrors.SITE
    )
    p, q = Customers(site, made.scenario.variation, 3, START, made.profile_s).hidden(
        START + 20.0 * np.arange(1000.0)
    )
    metered = np.array([bool(row.meter) for row in tables.customers])
    std = np.where(metered & (np.arange(metered.size) < 4), 0.5, 0.0)
    np.testing.assert_allclose(np.std(p, axis=0), std, rtol=0.5)
    np.testing.assert_allclose(np.std(q, axis=0), 0.5 * std, rtol=0.5)


@pytest.mark.parametrize(("meters", "fixed", "jitter"), [("white", 0.0, 0.2), ("real", 0.5, 0.05)])
def test_meters_err_as_stated(meters: str, fixed: float, jitter: float) -> None:
    pairs = played(meters=TrialMeterErrors(meters), duration_s=400.0)
    at = small().meters
    error = 100.0 * np.array([np.sqrt(frame.y) - np.sqrt(truth.v2[at]) for frame, truth in pairs])
    mean = error.mean(axis=0)
    assert np.std(error - mean) == pytest.approx(
        np.hypot(jitter, 0.1 / 2.309 / 12**0.5 if fixed else 0), rel=0.05
    )
    assert np.max(np.abs(mean)) <= fixed + 0.05
    assert (np.std(mean) > 0.15) == (fixed > 0)
    volts = np.sqrt(np.array([frame.y for frame, _ in pairs])) * small().feeder.base_volt
    tenths = np.abs(volts * 10 - np.round(volts * 10)).max() < 1e-6
    assert tenths == (meters == "real")
    accuracy = trial(meters=TrialMeterErrors(meters)).stated.accuracy
    np.testing.assert_allclose(accuracy.jitter, jitter / 100.0)
    np.testing.assert_allclose(accuracy.class_fraction, fixed / 100.0, atol=2e-6)


def test_the_site_may_speak_for_its_meters() -> None:
    stated = trial(meters=TrialMeterErrors.SITE).stated
    np.testing.assert_array_equal(stated.accuracy.class_fraction, small().accuracy.class_fraction)
    np.testing.assert_array_equal(stated.accuracy.jitter, small().accuracy.jitter)


def test_meters_may_report_what_inverters_do() -> None:
    made = trial(report_q=True)
    base = small().feeder.base_kva
    assert np.isnan(played()[5][0].q_net).all()
    for sample, (frame, _) in zip(simulate(made.stated, made.scenario), frames(made), strict=True):
        np.testing.assert_allclose(-frame.q_net * base, sample.q_kvar, atol=1e-9)
        assert (frame.q_net_error > 0.0).all()


def test_a_trial_is_the_same_every_time_and_another_one_is_not() -> None:
    np.testing.assert_array_equal(reported(AttackKind.BIAS), reported(AttackKind.BIAS))
    assert np.abs(reported() - reported(seed=4)).min() > 0.0
    assert [frame.t for frame, _ in played(step_s=10.0)] == [START + 10.0 * k for k in range(6)]


# ------------------------------------------------------------------------------------------------- lies


def shift(trick: AttackKind, **changes: Any) -> tuple[Floats, Floats]:
    """What the lie does to the reports, pu, and who lies at each tick; both (T, p)."""
    pairs = played(trick, **changes)
    change = reported(trick, **changes) - reported(**(changes | {"lie": None}))
    liars = np.array([truth.liars for _, truth in pairs])
    assert np.array_equal(change != 0.0, liars & (change != 0.0))
    assert not liars[:30].any()
    y = np.array([frame.y for frame, _ in pairs])
    honest = reported(**(changes | {"lie": None})) ** 2
    np.testing.assert_allclose(np.array([truth.attack for _, truth in pairs]), y - honest, atol=1e-12)
    return change, liars


def test_bias_together_and_scaling() -> None:
    change, liars = shift(AttackKind.BIAS)
    np.testing.assert_allclose(np.abs(change[liars]), 0.03, atol=1e-12)
    assert liars[30:].sum() == 60
    low = AttackSpec(AttackKind.TOGETHER, 5, -2.0, 10.0, 20.0)
    change = reported(AttackKind.BIAS, lie=low) - reported()
    rows, columns = np.nonzero(change)
    assert (rows.min(), rows.max(), np.unique(columns).size) == (10, 19, 5)
    np.testing.assert_allclose(change[10:20][:, np.unique(columns)], -0.02, atol=1e-12)
    change, liars = shift(AttackKind.SCALING)
    np.testing.assert_allclose(np.abs(change / reported())[liars], 0.03, atol=1e-12)


def test_drift_leaves_at_its_rate() -> None:
    change, liars = shift(AttackKind.DRIFT)
    (who,) = np.nonzero(liars[-1])
    np.testing.assert_allclose(
        np.abs(change[30:, who]), np.outer(0.03 / 60.0 * np.arange(30), np.ones(2)), atol=1e-12
    )


def test_stuck_replayed_and_late_meters_repeat_themselves() -> None:
    honest, told = reported(), reported(AttackKind.STUCK)
    _, liars = shift(AttackKind.STUCK)
    (who,) = np.nonzero(liars[-1])
    np.testing.assert_array_equal(told[30:, who], np.broadcast_to(honest[30, who], (30, 2)))
    # An honest run that began 60 s earlier would be needed to look further back than the start.
    early = AttackSpec(AttackKind.CLOCK_SHIFT, 2, 20.0, 30.0)
    np.testing.assert_array_equal(reported(lie=early)[30:, who], honest[10:40, who])
    longer = AttackSpec(AttackKind.REPLAY, 2, 100.0, 150.0)
    honest = reported(duration_s=200.0)
    np.testing.assert_array_equal(reported(duration_s=200.0, lie=longer)[150:, who], honest[50:100, who])


def test_coordinated_meters_show_the_trace_of_a_load() -> None:
    """Oracle: the column of LinDistFlow of that load, restricted to the liars, up to curvature."""
    change, liars = shift(AttackKind.COORDINATED)
    (who,) = np.nonzero(liars[-1])
    (attack,) = trial(AttackKind.COORDINATED_POWER).scenario.attacks
    assert isinstance(attack, Coordinated)
    assert attack.meters.tolist() == who.tolist()
    (k,) = np.nonzero(attack.p_shift)[0]
    customer = small().meters[who[k]]
    model = small().feeder.linear()
    ratio = attack.q_shift[k] / attack.p_shift[k]
    trace = -(model.R[:, customer] + ratio * model.X[:, customer])[small().meters[who]]
    found = change[-1, who]
    np.testing.assert_allclose(found / found[k], trace / trace[k], rtol=0.1)
    assert np.abs(found).min() == pytest.approx(0.03, rel=1e-6)
    # Voltages alone, and the load itself.
    plain = [frame.p for frame, _ in played(AttackKind.COORDINATED)]
    loads = [(frame.p, frame.q) for frame, _ in played(AttackKind.COORDINATED_POWER)]
    honest = [(frame.p, frame.q) for frame, _ in played()]
    np.testing.assert_array_equal(plain, [p for p, _ in honest])
    for which, size in ((0, attack.p_shift[k]), (1, attack.q_shift[k])):
        more = np.array([load_[which] - true[which] for load_, true in zip(loads, honest, strict=True)])
        assert not more[:30].any()
        np.testing.assert_allclose(-more[30:, customer] * small().feeder.base_kva, size, rtol=1e-6)
        assert not np.delete(more, customer, axis=1).any()


def test_a_false_power_moves_no_voltage() -> None:
    """The same load as in the coordinated story, but nobody shows its trace."""
    change, liars = shift(AttackKind.POWER)
    assert not change.any()
    assert liars[-1].sum() == 1
    (attack,) = trial(AttackKind.COORDINATED_POWER).scenario.attacks
    assert isinstance(attack, Coordinated)
    (k,) = np.nonzero(attack.p_shift)[0]
    for (told, _), (other, _) in zip(
        played(AttackKind.POWER), played(AttackKind.COORDINATED_POWER), strict=True
    ):
        np.testing.assert_array_equal(told.p, other.p)
        np.testing.assert_array_equal(told.q, other.q)
    (who,) = np.nonzero(liars[-1])
    assert who.tolist() == [attack.meters[k]]


def test_a_load_that_nobody_would_believe_is_no_measurement() -> None:
    """A load of 1.5 MW: the frame falls back on what the customer could draw, and says how wide that is."""
    pairs = played(AttackKind.COORDINATED_POWER, lie=AttackSpec(AttackKind.COORDINATED_POWER, 2, 12.0))
    (attack,) = trial(lie=AttackSpec(AttackKind.COORDINATED_POWER, 2, 12.0)).scenario.attacks
    assert isinstance(attack, Coordinated)
    site = small()
    customer = site.meters[attack.meters[np.argmax(attack.p_shift)]]
    assert attack.p_shift.max() / site.feeder.base_kva > site.loads.credible[customer]
    before, after = pairs[29][0], pairs[30][0]
    peak = site.loads.load_peak[customer] + site.loads.pv_peak[customer]
    assert after.p_error[customer] == pytest.approx(0.5 * peak)
    assert before.p_error[customer] < 0.1 * after.p_error[customer]


@pytest.mark.parametrize("ask", ["none", "profiles"])
def test_a_silent_meter_tells_no_powers(ask: str) -> None:
    """Oracle: the frame of a feeder that nobody reads. All others are those of the run without silence."""
    tables = small().tables
    meta = replace(tables.meta, load=replace(tables.meta.load, forecast=ask))
    made = trial(site=from_tables(replace(tables, meta=meta)), duration_s=4.0, profile_s=0.0)
    mute = MeterOutage(small().meter_ids[5], START + 2.0, START + 3.0)
    scenario = replace(made.scenario, channel=Channel(silences=(mute,)))
    none = np.full(13, np.nan)
    lost = to_frame(made.stated, Snapshot(START + 2.0, none, none, none, np.nan))
    customer = small().meters[5]
    names = ("p", "p_error", "q", "q_error", *(("p_std", "q_std") if ask == "profiles" else ()))
    for tick, ((frame, _), (plain, _)) in enumerate(zip(frames(made, scenario), frames(made), strict=True)):
        silent = np.arange(frame.p.size) == customer if tick == 2 else np.zeros(frame.p.size, np.bool_)
        np.testing.assert_array_equal(~frame.seen, silent[small().meters])
        for name in names:
            found, told, unread = (getattr(each, name) for each in (frame, plain, lost))
            np.testing.assert_array_equal(found, np.where(silent, unread, told))
    assert lost.p_error[customer] > plain.p_error[customer]


def test_inverters_move_the_truth_and_no_report() -> None:
    wrong = played(lie=AttackSpec(AttackKind.INVERTER, 1, 100.0))
    honest = played()
    assert not any(truth.liars.any() or truth.attack.any() for _, truth in wrong)
    assert [int(truth.inverters.sum()) for _, truth in wrong] == [0] * 30 + [1] * 30
    moved = np.array([one.v2 - other.v2 for (_, one), (_, other) in zip(wrong, honest, strict=True)])
    assert not moved[:30].any()
    assert np.abs(moved[30:]).max() > 5e-5


@pytest.mark.parametrize(
    "lie",
    [
        AttackSpec(AttackKind.BIAS, 14),
        AttackSpec(AttackKind.INVERTER, 10),
        AttackSpec(AttackKind.COORDINATED, 99),
    ],
)
def test_more_liars_than_there_are_is_refused(lie: AttackSpec) -> None:
    with refused(NoSuchAttack, "too-few-meters"):
        list(frames(trial(lie=lie)))
    assert manipulations(small(), None, trial().scenario) == ((), ())


# ---------------------------------------------------------------------------------------------- judging


@dataclass(frozen=True)
class Script:
    """A watcher that reads its answers off a list."""

    pairs: list[tuple[Frame, FrameTruth]]
    named: dict[int, list[int]]
    undecided: tuple[int, ...] = ()
    off: float = 0.0

    def step(self, _: Script, tick: int, frame: Frame) -> tuple[int, Estimate, Verdict]:
        assert frame is self.pairs[tick][0]
        suspects = np.zeros(13, dtype=np.bool_)
        suspects[self.named.get(tick, [])] = True
        decision = Decision.ATTACKED if suspects.any() else Decision.CLEAN
        if tick in self.undecided:
            decision = Decision.UNDECIDED
        nothing = np.zeros(13)
        v2 = (np.sqrt(self.pairs[tick][1].v2) + self.off) ** 2
        estimate = Estimate(frame.t, v2, nothing, v2, ~suspects, np.zeros(9))
        return tick + 1, estimate, Verdict(decision, Cause.AGREEMENT, "", suspects, nothing, nothing, nothing)

    def watcher(self) -> DesignedEstimator:
        family = Estimator("script", "", lambda *_: self, lambda *_: 0, self.step, lambda _: 1, lambda _: "")
        return DesignedEstimator(family, self, 2)


def test_a_watcher_that_names_nobody_misses_all() -> None:
    pairs = played(AttackKind.BIAS)
    out = judge(Script(pairs, {}, off=0.001).watcher(), trial(AttackKind.BIAS), played=pairs)
    assert (out.missed, out.false_clean, out.accused.sum(), out.undecided.sum()) == (2, 1.0, 0, 0)
    assert np.isinf(out.delay_s).all()
    np.testing.assert_allclose(out.error_all, 0.1)
    np.testing.assert_allclose(out.error_liars, 0.1)
    # Ticks 10 to 29 before the lie, 40 to 59 during it.
    assert (out.error_all.size, out.error_liars.size) == (40 * 13, 20 * 2)
    assert out.step_ms.shape == (60,)
    assert (out.step_ms > 0.0).all()


def test_names_are_timed_and_false_ones_counted() -> None:
    pairs = played(AttackKind.BIAS)
    first, second = np.flatnonzero(pairs[-1][1].liars).tolist()
    honest = next(j for j in range(13) if j not in {first, second})
    named = {5: [honest], 20: [first]} | {k: [first] for k in range(34, 60)} | {50: [first, second, honest]}
    script = Script(pairs, named, undecided=(0, 31))
    out = judge(script.watcher(), trial(AttackKind.BIAS), played=pairs)
    assert out.liars.tolist() == [first, second]
    assert out.delay_s.tolist() == [4.0, 20.0]
    assert np.flatnonzero(out.accused).tolist() == sorted([first, honest])
    assert np.flatnonzero(out.false_names).tolist() == [5, 20, 50]
    assert (out.missed, int(out.undecided.sum()), int(out.lying.sum())) == (0, 2, 30)
    assert np.flatnonzero(out.clean_while_lying).tolist() == [30, 32, 33]
    assert out.false_clean == pytest.approx(0.1)


def test_a_name_that_outlives_its_lie_is_not_false() -> None:
    short = AttackSpec(AttackKind.BIAS, 1, 3.0, 20.0, 40.0)
    pairs = played(lie=short)
    (liar,) = np.flatnonzero(pairs[30][1].liars)
    out = judge(
        Script(pairs, {k: [int(liar)] for k in range(22, 60)}).watcher(), trial(lie=short), played=pairs
    )
    assert (out.delay_s.tolist(), int(out.accused.sum()), int(out.lying.sum())) == ([2.0], 0, 20)


def test_nothing_to_be_said_is_not_a_number() -> None:
    pairs = played()
    out = judge(Script(pairs, {}, off=np.nan).watcher(), trial(), played=pairs)
    assert np.isnan(out.false_clean)
    assert np.isinf(out.error_all).all()
    assert (out.missed, out.error_liars.size) == (0, 0)


def test_a_real_family_names_exactly_the_liars() -> None:
    made = trial(AttackKind.BIAS, meters=TrialMeterErrors.REAL, load_error=LoadError(0.1, 0.05))
    for name in ("exact-bank", "modal"):
        watcher = design(choose(made.stated, estimator=name, max_attacked=2))
        assert watcher.family is FAMILIES[name]
        out = judge(watcher, made)
        assert (out.missed, out.accused.sum(), out.false_clean) == (0, 0, 0.0)
        assert out.error_liars.max() < 0.2

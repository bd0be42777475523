"""The monitor in three phases, against the balanced one where phases do not touch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.equipment import find
from feeders.model.site import Site, from_tables, load, load_doubt, one_phase_each
from feeders.registry import design
from feeders.simulation.powerflow import power_flow
from feeders.simulation.trial import AttackKind, AttackSpec, LoadError, Trial, TrialMeterErrors, frames
from gridsec.estimators.front import FrontOptions, LoadDoubt
from gridsec.estimators.front.posterior import Prior, voltage_prior
from gridsec.estimators.modal import monitor
from gridsec.estimators.modal.monitor import ModalDesign
from gridsec.estimators.plant import Plant
from gridsec.grid.devices import Droop, MeterAccuracy
from gridsec.grid.meshed import MeshedFeeder, PhasedMesh
from gridsec.grid.phased import InPhases, PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import ThreePhaseFeeder
from gridsec.interface import Cause, Decision, Estimate, Frame, Verdict
from tests.gridsec.around import MeshedStreet
from tests.gridsec.street import BASE_KVA, Street, make_plant

CUSTOMERS = 9


def between(prior: Prior) -> np.ndarray:
    """Covariance between the meters' places, (p, p)."""
    return prior.covariance[prior.meters]


def apart(one: Plant) -> Plant:
    """Three phases without mutual impedance, each of them the same street with customers of its own."""
    net, droop, count = one.feeder, one.droop, CUSTOMERS
    tree = net.tree if isinstance(net, MeshedFeeder) else net
    assert isinstance(tree, Feeder)
    branches, phase = tree.r.size, np.repeat(np.arange(3), count)
    whole = ThreePhaseFeeder(
        name="street",
        parent=tree.parent,
        # A kW in one phase does what three of them spread over all phases do.
        z=((tree.r + 1j * tree.x) / 3.0)[:, None, None] * np.eye(3),
        phases=np.ones((branches + 1, 3), dtype=np.bool_),
        bus=np.tile(tree.bus, 3),
        connected=np.equal.outer(phase, np.arange(3)),
        customers=tuple(f"{name}-{each}" for each in "abc" for name in tree.customers),
        buses=tree.buses,
        base_volt=tree.base_volt,
        base_kva=tree.base_kva,
        charging=np.zeros((branches, 3, 3)),
    )

    def three(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values] * 3)

    def shifted(index: np.ndarray) -> np.ndarray:
        return np.concatenate([index + k * count for k in range(3)])

    fleet = Droop(
        customer=shifted(droop.customer),
        v=three(droop.v),
        q=three(droop.q),
        tau=three(droop.tau),
        vbar=droop.vbar,
    )
    parts = ("class_fraction", "resolution", "jitter")
    accuracy = replace(one.accuracy, **{name: three(getattr(one.accuracy, name)) for name in parts})
    assert isinstance(accuracy, MeterAccuracy)
    feeder: InPhases = PhasedFeeder(whole)
    if isinstance(net, MeshedFeeder):
        z = ((net.r + 1j * net.x) / 3.0)[:, None, None] * np.eye(3)
        feeder = PhasedMesh(whole, net.ends, np.ones((len(z), 3), dtype=np.bool_), z, 0.0 * z.real)
    return Plant(feeder, fleet, shifted(one.meters), accuracy, one.loss_correction)


def together(heard: list[Frame]) -> Frame:
    """What three streets say, as one feeder."""
    names = ("y", "seen", "p", "p_error", "q", "q_error", "q_net", "q_net_error")
    v0 = np.array([frame.v0_squared for frame in heard])
    arrays = {name: np.concatenate([getattr(frame, name) for frame in heard]) for name in names}
    return Frame(t=heard[0].t, v0_squared=float(v0.mean()), v0_phases=v0, **arrays)


def prepare(plant: Plant, phases: int, commission_s: float = 0.0) -> ModalDesign:
    n = plant.feeder.bus.size
    doubt = LoadDoubt(np.full(n, 0.03 / BASE_KVA), np.full(n, 0.6 / BASE_KVA), 600.0)
    # As many false alarms and suspicions per meter, however many meters there are.
    options = FrontOptions(alarms_per_year=float(phases), suspect=0.05 * phases, commission_s=commission_s)
    return monitor.design(plant, doubt=doubt, step_s=1.0, options=options, max_attacked=3)


def side_by_side(
    lies: tuple[dict[int, float], ...],
    silent: tuple[tuple[int, ...], ...] = ((), (), ()),
    count: int = 30,
    *,
    onset: int = 10,
    meshed: bool = False,
) -> tuple[list[tuple[Estimate, Verdict]], tuple[Estimate, Verdict], ModalDesign]:
    """The last answers of a balanced monitor for each phase, and of one for all three."""
    one = make_plant(np.random.default_rng(5), customers=CUSTOMERS, drop=0.03, loss_correction=0)
    if meshed:
        ends, z = np.array([[0, CUSTOMERS], [2, 5]]), np.array([0.01, 0.02])
        assert isinstance(one.feeder, Feeder)
        one = replace(one, feeder=MeshedFeeder(one.feeder, ends, z, 0.5 * z, np.zeros(2)))
    alone, whole = prepare(one, 1), prepare(apart(one), 3)
    kind = MeshedStreet if meshed else Street
    streets = [kind(one, np.random.default_rng([5, k])) for k in range(3)]
    states = [monitor.init(alone, 1000.0) for _ in streets]
    answers: list[tuple[Estimate, Verdict]] = []
    state = monitor.init(whole, 1000.0)
    for tick in range(count):
        told, lost = (lies, silent) if tick >= onset else (({},) * 3, ((),) * 3)
        for street in streets:
            street.advance(1.0)
        heard = [street.frame(told[k], lost[k]) for k, street in enumerate(streets)]
        stepped = [monitor.step(alone, before, frame) for before, frame in zip(states, heard, strict=True)]
        states, answers = [each[0] for each in stepped], [each[1:] for each in stepped]
        state, estimate, verdict = monitor.step(whole, state, together(heard))
    return answers, (estimate, verdict), whole


class TestPhasesThatDoNotTouch:
    def test_the_prior_is_that_of_each_phase(self) -> None:
        one = make_plant(np.random.default_rng(5), customers=CUSTOMERS, drop=0.03)
        alone, whole = prepare(one, 1), prepare(apart(one), 3)
        blocks = between(whole.front.prior).reshape(3, CUSTOMERS, 3, CUSTOMERS)
        for k in range(3):
            for j in range(3):
                expected = between(alone.front.prior) if j == k else np.zeros((CUSTOMERS, CUSTOMERS))
                np.testing.assert_allclose(blocks[k, :, j], expected, rtol=0, atol=1e-18)
        np.testing.assert_allclose(
            whole.front.prior.variance.reshape(-1, 3).T, [alone.front.prior.variance] * 3, rtol=1e-12
        )
        for name in ("max_p", "max_q", "inverter_reach", "white", "fixed"):
            np.testing.assert_allclose(
                getattr(whole.front, name), np.tile(getattr(alone.front, name), 3), rtol=1e-12
            )

    @pytest.mark.canary("lies0-True")
    @pytest.mark.parametrize("meshed", [False, True])
    @pytest.mark.parametrize(
        "lies",
        [
            ({}, {}, {}),
            ({2: 0.04}, {}, {}),
            ({2: 0.04}, {5: -0.03}, {}),
            ({0: 0.05}, {1: 0.05}, {8: -0.05}),
        ],
    )
    def test_each_phase_gets_the_answers_of_a_balanced_monitor(
        self, lies: tuple[dict[int, float], ...], *, meshed: bool
    ) -> None:
        alone, (estimate, verdict), _ = side_by_side(lies, meshed=meshed)
        names = ("v2", "std", "trusted")
        expected = {name: np.concatenate([getattr(each, name) for each, _ in alone]) for name in names}
        assert verdict.suspects.sum() == sum(map(len, lies))
        np.testing.assert_array_equal(verdict.suspects, np.concatenate([each.suspects for _, each in alone]))
        np.testing.assert_array_equal(estimate.trusted, expected["trusted"])
        # With masked meters the filters of the phases have different covariances.
        exact = 2e-9 if not any(lies) else 0.05 * float(expected["std"].max())
        np.testing.assert_allclose(estimate.v2, expected["v2"], rtol=0, atol=exact)
        if not any(lies):
            np.testing.assert_allclose(estimate.std, expected["std"], rtol=0, atol=exact)
            for name in ("score", "attack"):
                each = np.concatenate([getattr(one, name) for _, one in alone])
                np.testing.assert_allclose(getattr(verdict, name), each, rtol=0, atol=exact)
        assert verdict.kinds == tuple(kind for _, each in alone for kind in each.kinds)
        wanted = Decision.ATTACKED if verdict.suspects.any() else Decision.CLEAN
        assert verdict.decision is wanted

    def test_a_silent_meter_is_missed_in_its_phase_only(self) -> None:
        # The observers settle after 11 ticks.
        alone, (estimate, _), _ = side_by_side(({}, {}, {}), ((), (4,), ()), onset=20)
        expected = np.concatenate([each.std for each, _ in alone])
        np.testing.assert_allclose(estimate.std, expected, rtol=0, atol=2e-9)

    def test_a_meter_that_is_silent_while_the_observers_settle_takes_nothing_from_other_phases(self) -> None:
        """Monitors with complete readings give the ticks of settling up; that of all phases keeps them."""
        alone, (estimate, _), _ = side_by_side(({}, {}, {}), ((), (4,), ()), onset=10)
        expected, std = np.array([each.std for each, _ in alone]), estimate.std.reshape(3, CUSTOMERS)
        np.testing.assert_allclose(std[1], expected[1], rtol=0, atol=2e-9)
        assert (std <= expected + 2e-9).all()
        assert (std >= 0.8 * expected).all()


def spread_evenly(name: str, kw: float) -> tuple[Site, Site]:
    """A balanced feeder, and the same with a customer and a meter for each phase."""
    tables = find(name)
    rows = tuple(replace(row, p_std_kw=kw, q_std_kvar=kw / 3.0) for row in tables.customers)
    lines = tuple(replace(line, r0_ohm=4.0 * line.r_ohm, x0_ohm=3.0 * line.x_ohm) for line in tables.lines)
    tables = replace(tables, customers=rows, lines=lines)
    return from_tables(tables), from_tables(one_phase_each(tables))


def test_balanced_phases_are_the_single_phase_equivalent() -> None:
    one, three = spread_evenly("kerber-landnetz", 0.6)
    assert isinstance(one.feeder, Feeder)
    assert isinstance(three.feeder, PhasedFeeder)
    count = one.feeder.bus.size
    mean = np.kron(np.eye(count), np.full((1, 3), 1.0 / 3.0))  # of the phases of each customer
    rng = np.random.default_rng(1)
    p, q = rng.normal(-0.02, 0.01, (2, count))
    thirds = [np.repeat(each, 3) / 3.0 for each in (p, q)]
    for steps, tolerance in ((0, 1e-13), (1, 1e-5)):
        expected = one.feeder.bus_voltages(p, q, 1.02, steps=steps)[one.feeder.bus]
        found = three.feeder.bus_voltages(*thirds, 1.02, steps=steps)[three.feeder.bus]
        np.testing.assert_allclose(found, np.repeat(expected, 3), rtol=0, atol=tolerance)
    # Errors of the loads as well: the mean over a customer's phases is as uncertain as its balanced voltage.
    made = [design(site).design.front for site in (one, three)]
    priors = [between(voltage_prior(d.plant.feeder, d.prior.meters, d.doubt, busbar=0.0)) for d in made]
    np.testing.assert_allclose(mean @ priors[1] @ mean.T, priors[0], rtol=0, atol=1e-15)
    assert made[1].customers == 3 * made[0].customers


class TestTheEuropeanFeeder:
    """55 single-phase customers, 19 inverters; the truth is asymmetric AC power flow."""

    @staticmethod
    def trial(lie: AttackSpec | None, seconds: float = 40.0, kw: float = 0.6) -> Trial:
        return Trial(
            load("ieee-european-lv"),
            seed=4,
            duration_s=seconds,
            meters=TrialMeterErrors.WHITE,
            load_error=LoadError(kw, kw / 3.0),
            lie=lie,
            profile_s=300_000.0,
        )

    @pytest.mark.acceptance
    def test_the_prior_is_the_covariance_of_the_power_flow(self) -> None:
        site = self.trial(None).stated
        assert isinstance(site.feeder, PhasedFeeder)
        rng, draws, count = np.random.default_rng(2), 2000, site.feeder.bus.size
        known, unknown = np.full(count, 0.3), 0.6 * rng.normal(size=(draws, count))
        other = 0.2 * rng.normal(size=(draws, count))
        v0 = np.full((draws, 3), site.feeder.base_volt)
        v, _ = power_flow(site).solve_batch(known + unknown, 0.2 * known + other, v0)
        expected = between(voltage_prior(site.feeder, site.feeder.bus, load_doubt(site), busbar=0.0))
        found = np.cov((v / site.feeder.base_volt) ** 2, rowvar=False)
        assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected)
        # Phases that share a cable err against each other: that is no neglected rounding.
        phase = np.array([row.phases for row in site.tables.customers])
        apart = phase[:, None] != phase
        assert np.linalg.norm(expected[apart]) > 0.1 * np.linalg.norm(expected)
        assert np.linalg.norm((found - expected)[apart]) < 0.2 * np.linalg.norm(expected[apart])

    @pytest.mark.acceptance
    def test_eighteen_liars_are_named_and_nobody_else(self) -> None:
        this = self.trial(AttackSpec(AttackKind.BIAS, 18, 3.0, onset_s=20.0))
        watcher = design(this.stated)
        state, inside = watcher.init(0.0), []
        for frame, truth in frames(this):
            state, estimate, verdict = watcher.step(state, frame)
            inside.append(np.abs(estimate.v2 - truth.v2) <= estimate.bound)
        np.testing.assert_array_equal(verdict.suspects, truth.liars)
        assert truth.liars.sum() == 18
        assert verdict.decision is Decision.ATTACKED
        assert np.mean(inside) > 0.999

    @pytest.mark.acceptance
    def test_without_a_phase_of_the_busbar_that_phase_is_known_less_well(self) -> None:
        this = self.trial(None, 20.0)
        watcher = design(this.stated)
        phase = np.array(["abc".index(row.phases) for row in this.stated.tables.customers])
        stds, played = [], list(frames(this))
        for lost in (None, 1):
            state = watcher.init(0.0)
            for frame, truth in played:  # noqa: B007  # the last one is looked at
                heard = frame
                if lost is not None:
                    assert frame.v0_phases is not None
                    v0 = np.where(np.arange(3) == lost, np.nan, frame.v0_phases)
                    heard = replace(frame, v0_phases=v0, v0_squared=float("nan"))
                state, estimate, verdict = watcher.step(state, heard)
            assert not verdict.suspects.any()
            assert (np.abs(estimate.v2 - truth.v2) <= estimate.bound).all()
            stds.append(estimate.std)
        ratio = stds[1] / stds[0]
        # Mutual impedance lets the others feel a little of what is not known of it.
        assert (ratio > 1.0).all()
        assert ratio[phase == 1].max() > 2.0
        assert ratio[phase != 1].max() < 1.5

    def test_one_voltage_for_three_phases_accuses_nobody(self) -> None:
        this = self.trial(None, 20.0)
        watcher = design(this.stated)
        state = watcher.init(0.0)
        for frame, _ in frames(this):
            assert frame.v0_phases is not None
            assert np.ptp(frame.v0_phases) > 1e-3
            state, _, verdict = watcher.step(state, replace(frame, v0_phases=None))
            assert not verdict.suspects.any()
            # 15 meters of a phase could all lie without anybody to contradict them.
            assert verdict.decision is Decision.UNDECIDED
        assert verdict.cause is Cause.TOO_FEW_METERS
        assert "15 meters report from there; at least 37" in verdict.reason

    @pytest.mark.canary("0.0")
    @pytest.mark.parametrize("said", [None, np.nan, 0.0])
    def test_a_whole_phase_that_lies_is_never_clean_without_its_busbar_voltage(
        self, said: float | None
    ) -> None:
        this = self.trial(None, 20.0)
        watcher = design(this.stated)
        phase = np.array(["abc".index(row.phases) for row in this.stated.tables.customers])
        state = watcher.init(0.0)
        for frame, _ in frames(this):
            assert frame.v0_phases is not None
            v0 = None if said is None else np.where(np.arange(3) == 2, said, frame.v0_phases)
            told = np.where(phase == 2, 1.2 * frame.y, frame.y)
            state, _, verdict = watcher.step(state, replace(frame, y=told, v0_phases=v0))
            assert verdict.decision is not Decision.CLEAN

    @pytest.mark.acceptance
    def test_absurd_frames_get_an_answer(self) -> None:
        this = self.trial(None, 32.0)
        watcher = design(this.stated)
        rng, absurd = np.random.default_rng(8), np.array([np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, 1.0])
        state, answers, false = watcher.init(0.0), [], np.zeros(55, dtype=np.bool_)
        for tick, (frame, _) in enumerate(frames(this)):
            broken = {
                name: np.where(
                    rng.random(getattr(frame, name).shape) < 0.2, rng.choice(absurd), getattr(frame, name)
                )
                for name in ("y", "p", "q", "p_error", "q_error", "v0_phases")
            }
            heard = replace(frame, **broken) if tick >= 20 else frame
            state, estimate, verdict = watcher.step(state, heard)
            assert np.isfinite(estimate.v2).all()
            assert np.isfinite(estimate.std).all()
            answers.append(verdict.decision)
            false |= np.isfinite(heard.y) & (heard.y != frame.y)
            assert not verdict.suspects[~false].any()
        # Other meters are false at every tick, and more than promised in all: no verdict is CLEAN.
        assert answers[19] is Decision.CLEAN
        assert Decision.CLEAN not in answers[20:]
        # The same frame again is not used.
        _, _, verdict = watcher.step(state, frame)
        assert verdict.decision is Decision.UNDECIDED


@pytest.mark.canary("kerber-landnetz")
@pytest.mark.parametrize("name", ["ieee-european-lv", "kerber-landnetz"])
def test_a_busbar_that_moved_while_it_was_silent_accuses_nobody(name: str) -> None:
    """A tap changer moves all voltages by 1.25 %, and the busbar's meter tells of it only later."""
    this = Trial(
        load(name),
        seed=4,
        duration_s=70.0,
        meters=TrialMeterErrors.WHITE,
        load_error=LoadError(0.6, 0.2),
        profile_s=300_000.0,
    )
    watcher = design(this.stated)
    state = watcher.init(0.0)
    for tick, (frame, _) in enumerate(frames(this)):
        moved = 0.025 * (tick >= 30)
        v0 = np.array([frame.v0_squared]) if frame.v0_phases is None else frame.v0_phases
        v0 = np.where(20 <= tick < 50, np.nan, v0 + moved)
        heard = replace(
            frame,
            y=frame.y + moved,
            v0_squared=float(v0.mean()),
            v0_phases=None if frame.v0_phases is None else v0,
        )
        state, _, verdict = watcher.step(state, heard)
        assert not verdict.suspects.any()
    assert verdict.decision is Decision.CLEAN

"""The monitor against impossible data, and against manipulations that come and go."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.estimators.front.measurements import frame_variance
from gridsec.estimators.modal import monitor
from gridsec.estimators.modal.monitor import ModalState
from gridsec.interface import Decision, Frame, Verdict
from tests.gridsec.estimators.modal.streets import doubt, prepare, watch
from tests.gridsec.street import Street, make_plant

Change = Callable[[Frame], Frame]


def run(
    change: Change, *, frames: int, before: int = 30, after: int = 0, seed: int = 0, inverters: int = 12
) -> tuple[list[Verdict], ModalState]:
    """Verdicts from the first changed frame on, of a street that was calm before."""
    rng = np.random.default_rng(seed)
    plant = make_plant(rng, customers=12, drop=0.03, inverters=np.arange(inverters))
    design, street = prepare(plant), Street(plant, rng)
    state, _ = watch(street, design, before)
    state, answers = watch(street, design, frames, state=state, change=change)
    if after:
        state, more = watch(street, design, after, state=state)
        answers += more
    return [verdict for _, verdict in answers], state


def put(name: str, value: float) -> Change:
    """One number of every frame replaced."""

    def change(frame: Frame) -> Frame:
        old = getattr(frame, name)
        if np.ndim(old) == 0:
            return replace(frame, **{name: value})
        new = old.copy()
        new[2] = value
        return replace(frame, **{name: new})

    return change


class TestNumbersThatAreNone:
    @pytest.mark.canary("q-1e+308")
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e20, -1e200, 1e308])
    @pytest.mark.parametrize("name", ["p", "q", "p_error", "q_error"])
    def test_a_power_that_is_none_is_not_known(self, name: str, value: float) -> None:
        """Nobody is named for it, and nothing of it is left afterwards."""
        verdicts, state = run(put(name, value), frames=6, after=70)
        assert not any(verdict.suspects.any() for verdict in verdicts)
        assert verdicts[-1].decision is Decision.CLEAN
        assert state.front.uncertainty.usual

    @pytest.mark.canary("100000000.0")
    @pytest.mark.parametrize("value", [-1e308, 0.0, 1e8, 1e15, 1e200, 1e308])
    def test_a_reading_that_is_none_is_a_lie_of_one_meter(self, value: float) -> None:
        verdicts, _ = run(put("y", value), frames=4, after=70)
        assert list(np.flatnonzero(verdicts[3].suspects)) == [2]
        assert not any(np.delete(verdict.suspects, 2).any() for verdict in verdicts)
        assert verdicts[-1].decision is Decision.CLEAN

    @pytest.mark.canary("1e+300")
    @pytest.mark.parametrize("value", [2.5, 1e300])
    def test_meters_that_read_more_than_a_voltage_are_named_at_once(self, value: float) -> None:
        """Of more than the promised number none is named: the readings count as missing."""
        for meters in ([2, 5, 7], [0, 2, 5, 7, 8]):

            def change(frame: Frame, meters: list[int] = meters) -> Frame:
                y = frame.y.copy()
                y[meters] = value
                return replace(frame, y=y)

            verdicts, _ = run(change, frames=1, after=70)
            few = len(meters) == 3
            assert list(np.flatnonzero(verdicts[0].suspects)) == (meters if few else [])
            assert verdicts[0].decision is (Decision.ATTACKED if few else Decision.UNDECIDED)
            assert not any(np.delete(verdict.suspects, meters).any() for verdict in verdicts)
            assert verdicts[-1].decision is Decision.CLEAN

    def test_an_outage_of_the_busbar_names_no_meter(self) -> None:
        """Four meters with batteries read 0 V, the others are silent; later all read the voltage again."""

        def change(frame: Frame) -> Frame:
            few = np.arange(12) < 4
            return replace(frame, y=np.where(few, 0.0, frame.y), seen=frame.seen & few, v0_squared=0.0)

        verdicts, _ = run(change, frames=20, after=40)
        assert not any(verdict.suspects.any() for verdict in verdicts)
        assert all(verdict.decision is Decision.UNDECIDED for verdict in verdicts[:20])
        assert verdicts[-1].decision is Decision.CLEAN

    @pytest.mark.canary("0")
    @pytest.mark.parametrize("inverters", [0, 5])
    def test_everything_at_once(self, inverters: int) -> None:
        """Half of the meters silent, another half at every tick; powers and the busbar come and go."""
        rng = np.random.default_rng(1)

        def change(frame: Frame) -> Frame:
            seen = rng.random(12) < 0.5
            wild = rng.random() < 0.2
            return replace(
                frame,
                seen=seen,
                y=np.where(seen, frame.y, np.nan),
                v0_squared=np.nan if rng.random() < 0.5 else frame.v0_squared,
                p=np.full(12, 1e3) if wild else frame.p,
                q_net=np.where(rng.random(12) < 0.2, 1e300, np.nan),
                q_net_error=np.full(12, np.inf),
            )

        verdicts, _ = run(change, frames=80, after=90, inverters=inverters)
        assert all(verdict.decision is Decision.UNDECIDED for verdict in verdicts[:80])
        assert not any(verdict.suspects.any() for verdict in verdicts)
        assert verdicts[-1].decision is Decision.CLEAN

    @pytest.mark.parametrize("error", [0.05, 50.0, np.inf])
    def test_errors_count_where_the_design_knows_of_none(self, error: float) -> None:
        rng = np.random.default_rng(2)
        plant = make_plant(rng, customers=12, drop=0.03)
        exact = replace(doubt(plant), p=np.zeros(12))
        made = monitor.design(plant, doubt=exact, step_s=1.0)
        frame = Street(plant, rng).frame()
        given = replace(frame, p_error=np.full(12, error))
        state, _, _ = monitor.step(made, monitor.init(made, frame.t - 1.0), given)
        variance = frame_variance(made.front, state.front.uncertainty)
        assert (variance[1:] > made.front.prior.variance[1:]).all()


class TestLiarsWhoComeAndGo:
    """Nobody else is ever named, and who lies is not better off for being silent or honest in between."""

    def watched(self, lies: Callable[[int], bool], heard: Callable[[int], bool], frames: int) -> Bools:
        """Whether meter 4 is named at each frame."""
        rng = np.random.default_rng(1)
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant), Street(plant, rng)
        state, _ = watch(street, design, 40)
        named = []
        for k in range(frames):
            lie, silent = {4: 0.05} if lies(k) else {}, () if heard(k) else (4,)
            state, ((_, verdict),) = watch(street, design, 1, state=state, lies=lie, silent=silent)
            assert not np.delete(verdict.suspects, 4).any()
            named.append(bool(verdict.suspects[4]))
        return np.array(named)

    def test_silence_clears_nobody(self) -> None:
        named = self.watched(lambda k: k < 5, lambda k: not 5 <= k < 100, 130)
        # Six to twelve readings release a meter.
        assert named[2:105].all()
        assert not named[120:].any()

    def test_who_is_silent_but_for_lies_is_named(self) -> None:
        named = self.watched(lambda _: True, lambda k: k % 8 == 0, 80)
        assert named[8:].all()

    def test_who_is_honest_for_as_long_as_it_takes_to_be_believed_is_named(self) -> None:
        named = self.watched(lambda k: k % 7 == 0, lambda _: True, 140)
        assert np.mean(named[7:]) > 0.3


class TestWhatIsLearnedUnderDifficulties:
    LEARN_S = 400

    def learned(self, change: Change, lies: dict[int, float], seed: int) -> tuple[ModalState, Street]:
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant, commission_s=self.LEARN_S), Street(plant, rng)
        state, _ = watch(street, design, self.LEARN_S, lies=lies, change=change)
        state, answers = watch(street, design, self.LEARN_S + 90, state=state, lies=lies)
        honest = np.setdiff1d(np.arange(12), list(lies))
        assert not any(verdict.suspects[honest].any() for _, verdict in answers)
        return state, street

    @pytest.mark.canary("0-v0_squared")
    @pytest.mark.parametrize("name", ["v0_squared", "p"])
    @pytest.mark.parametrize("seed", range(3))
    def test_time_in_which_little_is_known_does_not_count(self, name: str, seed: int) -> None:
        """A busbar that is silent, or loads that are guessed, would all be learned as the meters' errors."""

        def change(frame: Frame) -> Frame:
            if name == "p":
                return replace(frame, p=np.full(12, frame.p.mean()), p_error=np.full(12, 0.2))
            return replace(frame, v0_squared=np.nan)

        state, street = self.learned(change, {}, seed)
        assert np.isfinite(state.front.learned.at).all()
        off = np.abs(state.front.learned.bias - 2.0 * street.bias)
        assert (off < 3.0 * np.sqrt(state.front.learned.variance)).all()

    @pytest.mark.acceptance
    def test_a_broken_meter_does_not_keep_the_others_from_being_learned(self) -> None:
        state, street = self.learned(lambda frame: frame, {3: 0.05}, 0)
        honest = np.arange(12) != 3
        np.testing.assert_array_equal(np.isfinite(state.front.learned.at), honest)
        off = np.abs(state.front.learned.bias - 2.0 * street.bias)
        assert (off < 3.0 * np.sqrt(state.front.learned.variance))[honest].all()


@pytest.mark.canary("0")
@pytest.mark.parametrize("inverters", [0, 12])
def test_states_are_values(inverters: int) -> None:
    """A step leaves the state that it begins from as it was, and one that was kept goes on just the same."""
    rng = np.random.default_rng(3)
    plant = make_plant(rng, customers=12, drop=0.03, inverters=np.arange(inverters))
    design, street = prepare(plant), Street(plant, rng)
    state, _ = watch(street, design, 30)
    for k in range(60):
        street.advance(1.0)
        frame = street.frame({2: 0.03, 7: -0.02, 8: 0.01} if 5 <= k < 40 else {}, (4,) if k % 3 == 0 else ())
        frame = replace(frame, v0_squared=np.nan) if k % 20 > 14 else frame
        kept = pickle.dumps(state)
        after, estimate, verdict = monitor.step(design, state, frame)
        assert pickle.dumps(state) == kept
        again, once_more = monitor.step(design, pickle.loads(kept), frame)[1:]
        np.testing.assert_allclose(again.v2_bus, estimate.v2_bus, rtol=1e-9)
        np.testing.assert_allclose(once_more.score, verdict.score, rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(once_more.suspects, verdict.suspects)
        assert once_more.reason == verdict.reason
        state = after

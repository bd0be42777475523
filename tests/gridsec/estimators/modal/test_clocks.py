"""Clocks that are ahead: steps that other meters show first, and manipulations behind an offset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import core, monitor
from gridsec.estimators.modal.core import Core, CoreState
from gridsec.grid.network import Power
from gridsec.interface import Decision, Verdict
from tests.gridsec.estimators.modal.streets import prepare
from tests.gridsec.street import BASE_KVA, Street, make_plant

LEAD_S = 15
"""Offset of the clocks that are ahead, s."""
ONSET = 80
"""First tick of a manipulation."""
FIELDS = ("y", "p", "q", "p_error", "q_error", "q_net")


class Scene:
    """A street of which some meters report the measurements of `lead_s` before."""

    def __init__(self, customers: int, seed: int, ahead: Bools, lead_s: int = LEAD_S) -> None:
        none = np.zeros(0, dtype=np.intp)
        plant = make_plant(np.random.default_rng(seed), customers=customers, drop=0.05, inverters=none)
        every = np.arange(customers)
        self.street = Street(plant, np.random.default_rng(4), wobble=0.005, metered_q=every)
        self.made, self.ahead, self.lead_s = prepare(plant), ahead, lead_s
        self.effect = 2.0 * plant.feeder.self_impedance(Power.ACTIVE)

    def watch(
        self, ticks: int, change: Callable[[int], None], lie: Callable[[int], Floats | float] = lambda _: 0.0
    ) -> list[Verdict]:
        """Verdicts; `change` alters the street before a tick, `lie` the readings from `ONSET` on."""
        offset = np.where(self.ahead, float(self.lead_s), np.nan)
        state, past, out = monitor.init(self.made, self.street.t), [], []
        for k in range(ticks):
            self.street.advance(1.0)
            change(k)
            past.append(self.street.frame())
            now, old = past[-1], past[max(0, k - self.lead_s)]
            values = {name: np.where(self.ahead, getattr(old, name), getattr(now, name)) for name in FIELDS}
            values["y"] = values["y"] * (1.0 + (lie(k - ONSET) if k >= ONSET else 0.0)) ** 2
            frame = replace(now, **values, clock_offset=offset)
            state, _, verdict = monitor.step(self.made, state, frame)
            out.append(verdict)
        return out


def calm(_: int) -> None:
    """Nothing changes but the loads' own variations."""


@pytest.mark.canary("4-8-2.0-90")
@pytest.mark.parametrize(
    ("seed", "count", "power_kw", "ticks"),
    [(4, 8, 2.0, 90), (3, 4, 3.0, 200), (4, 4, 3.0, 200), (4, 8, 2.0, 200)],
)
def test_boilers_that_are_switched_together_name_no_meter(
    seed: int, count: int, power_kw: float, ticks: int
) -> None:
    """The meters of these customers are 10 s ahead, and show the common step after all others."""
    switched = np.random.default_rng(seed + 100).permutation(24)[:count]
    scene = Scene(24, seed, np.isin(np.arange(24), switched), 10)

    def boilers(k: int) -> None:
        scene.street.p[switched] -= power_kw / BASE_KVA * (k // 60 % 2)

    assert not np.any([each.suspects for each in scene.watch(ticks, boilers)])


@pytest.mark.canary("0-1-0.02", "1--1-0.02")
@pytest.mark.parametrize(("shift", "step"), [(-1, 0.005), (-1, 0.02), (1, 0.005), (1, 0.02)])
@pytest.mark.parametrize("seed", range(4))
def test_a_meter_with_a_clock_within_half_a_tick_is_not_named(shift: int, step: float, seed: int) -> None:
    """One meter shows a step of the busbar a tick before all others, or after them; no offset is measured."""
    random = np.random.default_rng(seed)
    none = np.zeros(0, dtype=np.intp)
    street = Street(make_plant(random, customers=12, drop=0.03, inverters=none), random)
    made, meter = prepare(street.plant), int(random.integers(12))
    state, last = monitor.init(made, street.t), np.zeros(12)
    for k in range(110):
        street.v0 += step * (k == ONSET)
        street.advance(1.0)
        frame = street.frame()
        y = frame.y.copy()
        if shift < 0 and k == ONSET - 1:
            y[meter] = (np.sqrt(y[meter]) + step) ** 2
        if shift > 0 and k == ONSET:
            y[meter] = last[meter]
        state, _, verdict = monitor.step(made, state, replace(frame, y=y))
        last = frame.y
        assert not verdict.suspects.any()


@pytest.mark.canary("customers0-100")
@pytest.mark.parametrize(("customers", "ticks"), [((6,), 100), ((6,), 200), ((6, 8), 200)])
def test_metered_reactive_powers_of_another_moment_name_no_meter(
    customers: tuple[int, ...], ticks: int
) -> None:
    """12 kW with a power factor that changes each minute, at customers with clocks that are ahead."""
    at = np.array(customers)
    scene = Scene(12, 3, np.isin(np.arange(12), at), 10)
    scene.street.usual[at] = -12.0 / BASE_KVA

    def factors(k: int) -> None:
        scene.street.tan[at] = 0.5 * (k // 60 % 2)

    assert not np.any([each.suspects for each in scene.watch(ticks, factors)])


@pytest.mark.canary("0.015")
@pytest.mark.parametrize("size", [0.015, 0.02])
def test_a_load_that_cycles_behind_an_offset_hides_no_lasting_manipulation(size: float) -> None:
    """0.6 kW for 2 s of 4 s at meter 3, with a clock that is ahead; meter 10 is off by `size`."""
    scene = Scene(12, 3, np.arange(12) == 3)

    def cycles(k: int) -> None:
        scene.street.p[3] -= 0.0012 / scene.effect[scene.made.plant.meters[3]] * (k // 2 % 2)

    out = scene.watch(ONSET + 60, cycles, lambda _: size * (np.arange(12) == 10))
    after = out[ONSET:]
    assert all(each.suspects[10] for each in after[25:])
    assert sum(each.decision is Decision.CLEAN for each in after) <= 3
    assert not np.any([np.delete(each.suspects, 10) for each in out])


@pytest.mark.canary("2")
@pytest.mark.parametrize("period", [1, 2, 4, 8])
def test_an_offset_of_another_meter_delays_no_name_beyond_its_loads(period: int) -> None:
    """Meter 9 is off by 3 % with signs that alternate; no load of meter 3 explains as much."""
    scene = Scene(12, 3, np.arange(12) == 3)
    out = scene.watch(ONSET + 40, calm, lambda k: 0.03 * (1 - 2 * (k // period % 2)) * (np.arange(12) == 9))
    assert all(each.suspects[9] for each in out[ONSET + 1 :])
    assert not np.any([np.delete(each.suspects, 9) for each in out])


def test_powers_that_jump_at_every_tick_are_replayed_once_in_an_offset(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A third of the meters, with clocks that are ahead, reports random powers."""
    scene, random, replays = Scene(12, 3, np.arange(12) < 4), np.random.default_rng(7), []
    widened = core.widened

    def counted(kernel: Core, state: CoreState, std: Floats) -> CoreState:
        replays.append(1)
        return widened(kernel, state, std)

    monkeypatch.setattr(core, "widened", counted)

    def jumps(k: int) -> None:
        scene.street.p[:4] += random.uniform(-10.0, 10.0, 4) / BASE_KVA * (k >= 20)

    scene.watch(120, jumps)
    assert 2 <= len(replays) <= 100 / (LEAD_S + 1) + 1

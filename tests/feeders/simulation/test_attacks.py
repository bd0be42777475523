"""Attacks made for a feeder: their sizes, and that a coordinated one is what a real load would do."""

from __future__ import annotations

import numpy as np
import pytest

from feeders.simulation.attacks import (
    LARGEST,
    RANDOM_KINDS,
    AttackKind,
    NoSuchAttack,
    coordinated,
    fake_load,
    random_attacks,
)
from feeders.simulation.demand import Customers
from feeders.simulation.plant import ClosedLoop, Loads
from feeders.simulation.powerflow import PowerFlow
from feeders.simulation.scenario import START, Scenario, simulate
from gridsec.attack import Coordinated
from gridsec.errors import InputInvalid
from tests.codes import refused
from tests.feeders.villages import village, village_without_inverters

ON, OFF = START + 20.0, START + 80.0
SIZE = 0.03
CONSTANT = (
    AttackKind.BIAS,
    AttackKind.SCALING,
    AttackKind.RANDOM,
    AttackKind.COORDINATED,
    AttackKind.COORDINATED_POWER,
)


@pytest.mark.canary(
    "1-bias", "1-coordinated", "2-scaling", "2-coordinated", "3-scaling", "3-coordinated-power"
)
@pytest.mark.parametrize("kind", CONSTANT)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_manipulated_meter_is_moved_by_at_least_the_size(kind: AttackKind, count: int) -> None:
    site = village()
    for seed in range(4):
        attacks = random_attacks(site, seed, kind, count, SIZE, t_on=ON, t_off=OFF)
        moved = np.zeros(0)
        for sample in simulate(site, Scenario(seed=seed, duration_s=90.0, attacks=attacks)):
            lying = ON <= sample.t < OFF
            assert sample.manipulated.sum() == (count if lying else 0)
            assert np.all(sample.shift_volt[~sample.manipulated] == 0.0)
            shift = np.abs(sample.shift_volt[sample.manipulated]) / 230.0
            assert np.all(shift >= SIZE * (1 - 1e-9))
            moved = np.append(moved, shift)
        assert moved.size == 60 * count


def test_displacements_are_not_larger_than_stated() -> None:
    site = village()
    signs = set()
    for seed in range(20):
        (attack,) = random_attacks(site, seed, "bias", 2, SIZE, t_on=ON, t_off=OFF)
        assert np.all(np.abs(attack.size) <= LARGEST * SIZE)
        signs |= set(np.sign(attack.size))
    assert signs == {-1.0, 1.0}


def test_a_drift_arrives_after_a_third_of_the_attack() -> None:
    site = village()
    attacks = random_attacks(site, 1, AttackKind.DRIFT, 2, SIZE, t_on=ON, t_off=OFF)
    for sample in simulate(site, Scenario(duration_s=90.0, attacks=attacks)):
        shift = np.abs(sample.shift_volt[sample.manipulated]) / 230.0
        if sample.t >= ON + 20.0 and sample.manipulated.any():
            assert np.all(shift >= SIZE * (1 - 1e-9))
        if sample.t == ON:
            assert np.all(shift < 0.1 * SIZE)


def test_every_kind_can_be_made_for_any_number_of_meters() -> None:
    site = village()
    for kind in RANDOM_KINDS:
        for count in (1, 4):
            (attack,) = random_attacks(site, 3, kind, count, 0.01, t_on=ON, t_off=OFF)
            assert attack.meters.size == count
            assert (attack.t_on, attack.t_off) == (ON, OFF)


def test_a_seed_fixes_the_attack_and_another_changes_it() -> None:
    site = village()
    chosen = set()
    for seed in range(10):
        (first,) = random_attacks(site, seed, AttackKind.COORDINATED, 2, SIZE, t_on=ON, t_off=OFF)
        (second,) = random_attacks(site, seed, AttackKind.COORDINATED, 2, SIZE, t_on=ON, t_off=OFF)
        np.testing.assert_array_equal(first.meters, second.meters)
        assert isinstance(first, Coordinated)
        assert isinstance(second, Coordinated)
        np.testing.assert_array_equal(first.shift, second.shift)
        chosen.add(tuple(first.meters))
    assert len(chosen) > 2


@pytest.mark.parametrize("with_inverters", [True, False])
def test_the_lie_is_what_a_real_load_would_do(with_inverters: bool) -> None:
    site = village() if with_inverters else village_without_inverters()
    scenario = Scenario(seed=5)
    (attack,) = random_attacks(
        site, 5, AttackKind.COORDINATED_POWER, 3, SIZE, t_on=ON, t_off=OFF, scenario=scenario
    )
    assert isinstance(attack, Coordinated)
    (own,) = np.flatnonzero(attack.p_shift)  # just one meter lies about power: the load's own
    customer = site.meters[attack.meters[own]]

    # The load becomes real, at the moment the attack was made for.
    customers = Customers(site, scenario.variation, scenario.seed, scenario.start, scenario.profile_s)
    demand = customers.at(np.array([ON]))
    loop = ClosedLoop(PowerFlow(site), site.droop, site.feeder.base_kva, site.feeder.base_volt)
    loads = Loads(demand.p_kw[0], demand.q_kvar[0], float(demand.v0_volt[0]))
    more = Loads(loads.p_kw.copy(), loads.q_kvar.copy(), loads.v0_volt)
    more.p_kw[customer] += attack.p_shift[own]
    more.q_kvar[customer] += attack.q_shift[own]
    drop = (loop.equilibrium(more).v_volt - loop.equilibrium(loads).v_volt)[site.meters] / 230.0
    np.testing.assert_allclose(attack.shift, drop[attack.meters], rtol=2e-4)
    # The meters that stay honest would have felt it less than those that lie.
    assert np.abs(np.delete(drop, attack.meters)).max() <= np.abs(drop[attack.meters]).min() * (1 + 1e-6)


def test_chosen_meters_far_away_need_a_larger_load() -> None:
    site = village_without_inverters()
    customer = 2  # c3, at the end of its branch
    near, small = fake_load(site, customer, np.array([2]), 0.01)
    far, large = fake_load(site, customer, np.array([0, 2]), 0.01)  # c1 is upstream
    assert large.p_kw > 2 * small.p_kw
    assert np.abs(large.shift[far]).min() == pytest.approx(0.01, rel=1e-12)
    assert np.abs(small.shift[near]).min() == pytest.approx(0.01, rel=1e-12)
    lie = coordinated(site, far, large, t_on=0.0, t_off=1.0, kind=AttackKind.COORDINATED)
    assert np.all(lie.p_shift == 0.0)


def test_what_cannot_be_made_is_refused_with_its_reason() -> None:
    site = village()
    with refused(NoSuchAttack, "too-few-meters"):
        random_attacks(site, 0, AttackKind.BIAS, 8, SIZE, t_on=ON, t_off=OFF)
    with refused(NoSuchAttack, "no-effect"):
        fake_load(site, 2, np.array([5]), SIZE)  # c7 sits on the busbar
    with refused(NoSuchAttack, "no-such-attack"):
        fake_load(site, 2, np.array([0, 2]), 0.18)
    with refused(NoSuchAttack, "no-such-attack"):
        random_attacks(site, 0, AttackKind.COORDINATED, 7, SIZE, t_on=ON, t_off=OFF)
    with refused(InputInvalid, "unknown-name"):
        random_attacks(site, 0, "nonsense", 1, SIZE, t_on=ON, t_off=OFF)
    with refused(NoSuchAttack, "unknown-name"):
        random_attacks(site, 0, "inverter", 1, SIZE, t_on=ON, t_off=OFF)

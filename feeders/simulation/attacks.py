"""Attacks on a given feeder: random and coordinated campaigns, and attacks stated in one line.

The attacks depend on the feeder and on no estimator. The trace of a coordinated attack is that of an extra
load in the AC power flow of the simulation, droop inverters included. It is the strongest attack, as it has
the shape of a real event.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.simulation.demand import Customers, Stream, generator
from feeders.simulation.plant import ClosedLoop, Loads
from feeders.simulation.powerflow import PowerFlowDiverged
from feeders.simulation.powerflow_three_phase import power_flow
from gridsec.arrays import Floats, Ints
from gridsec.attack import (
    Attack,
    Bias,
    Coordinated,
    Drift,
    InverterAttack,
    Random,
    Replay,
    Scaling,
    Stuck,
    coordinate,
    load_pattern,
    most_affected,
)
from gridsec.errors import GridsecError, InputInvalid, Problem, choice
from gridsec.grid.network import Power

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.simulation.scenario import Scenario


LARGEST: Final = 1.5
"""Largest random displacement relative to `size`, 1."""

LARGEST_SIZE_PU: Final = 0.5
"""Largest plausible size, pu; larger ones are taken for per cent."""

LARGEST_SHIFT_PU: Final = 0.2
"""Largest voltage change by a fake load, pu; beyond it the trace is obviously false."""

TYPICAL_LOAD: Final = 0.3
"""Load relative to `load_kw` without a scenario, 1."""

SIZING_TOLERANCE: Final = 1e-4
SIZING_ROUNDS: Final = 30


class RandomAttackKind(StrEnum):
    """Kinds of attack of `random_attacks`."""

    BIAS = "bias"
    SCALING = "scaling"
    DRIFT = "drift"
    STUCK = "stuck"
    REPLAY = "replay"
    RANDOM = "random"
    COORDINATED = "coordinated"
    COORDINATED_POWER = "coordinated-power"


def no_size(size: float) -> list[Problem]:
    """Problem of a size that is probably given in per cent.

    Parameters
    ----------
    size
        Size relative to nominal, 1.
    """
    if abs(size) <= LARGEST_SIZE_PU:
        return []
    return [
        Problem("out-of-range", f"{size:g} is {100.0 * size:g} % of nominal; {size / 100.0:g} is {size:g} %")
    ]


class NoSuchAttack(GridsecError):
    """An attack of the requested size does not exist on this feeder."""

    code = "no-such-attack"


@dataclass(frozen=True, slots=True, eq=False)
class FakeLoad:
    """A load that does not exist, and its trace. p meters.

    Attributes
    ----------
    customer
        Index of the customer with the load.
    p_kw, q_kvar
        The load.
    shift : (p,)
        Change of the voltage at each meter, pu.
    """

    customer: int
    p_kw: float
    q_kvar: float
    shift: Floats


def random_attacks(
    site: Site,
    seed: int,
    kind: RandomAttackKind | str,
    count: int,
    size: float,
    *,
    t_on: float,
    t_off: float,
    scenario: Scenario | None = None,
) -> tuple[Attack, ...]:
    """Choose random meters of a feeder and their attack.

    Parameters
    ----------
    site
        The feeder.
    seed
        Chooses the meters, their displacements and the place of a fake load.
    kind
        Kind of the attack. Bias, scaling and random displacements have random signs and sizes between `size`
        and 1.5 `size`. A drift reaches such a size after a third of the attack. A replay repeats the hour
        before. A fake load moves the least affected of its meters by `size`. Scaling moves a meter by at
        least `size` while its voltage is within the feeder's limits. The displacement of stuck and replayed
        meters is the change of the voltage since, independent of `size`.
    count
        Number of manipulated meters.
    size
        Smallest displacement of a manipulated meter, pu of nominal, > 0.
    t_on, t_off
        Begin and end, Unix s.
    scenario
        Source of the true loads at `t_on` under a fake load; typical loads by default.

    Raises
    ------
    NoSuchAttack
        For fewer meters than `count`, or without a place for a fake load of this size.
    """
    kind = RandomAttackKind(kind)
    if not 0 < count <= site.meters.size:
        raise NoSuchAttack(
            f"{site.feeder.name} has {site.meters.size} meters; cannot attack {count}", code="too-few-meters"
        )
    random = generator(seed, Stream.ATTACK)
    if kind in (RandomAttackKind.COORDINATED, RandomAttackKind.COORDINATED_POWER):
        loads = _typical(site) if scenario is None else present_loads(site, scenario, t_on)
        meters, fake = _somewhere(site, random, count, size, loads)
        power = kind is RandomAttackKind.COORDINATED_POWER
        return (coordinated(site, meters, fake, t_on=t_on, t_off=t_off, power=power),)
    meters = np.sort(random.choice(site.meters.size, count, replace=False)).astype(np.intp)
    amount = size * random.uniform(1.0, LARGEST, count)
    signed = amount * random.choice([-1.0, 1.0], count)
    return (_plain(kind, meters, signed, site, t_on=t_on, t_off=t_off, seed=seed),)


def busbar_attack(
    site: Site, kind: RandomAttackKind | str, size: float, *, t_on: float, t_off: float
) -> Attack:
    """Attack the busbar meter, in all of its phases.

    Parameters
    ----------
    site
        The feeder.
    kind
        Bias, scaling or drift: the reading is too high by `size`, or by this part of itself, or by `size`
        from a third of the attack on.
    size
        Displacement, pu of nominal; negative for a low reading.
    t_on, t_off
        Begin and end, Unix s.

    Raises
    ------
    NoSuchAttack
        For another kind.
    """
    phases = np.arange(site.feeder.busbar_places().stop)
    signed = np.full(phases.size, size)
    match RandomAttackKind(kind):
        case RandomAttackKind.SCALING:
            return Scaling(phases, t_on, t_off, factor=signed)
        case RandomAttackKind.BIAS | RandomAttackKind.DRIFT as plain:
            return _plain(plain, phases, signed, site, t_on=t_on, t_off=t_off, seed=0)
        case other:
            raise NoSuchAttack(
                f"the busbar meter is manipulated by bias, scaling or drift, not by {other}",
                code="unknown-name",
            )


def fake_load(
    site: Site, customer: int, meters: Ints | int, size: float, *, loads: Loads | None = None
) -> tuple[Ints, FakeLoad]:
    """Size a load at one customer with a trace of at least `size` at every manipulated meter.

    Parameters
    ----------
    site
        The feeder.
    customer
        Index of the customer.
    meters : (k,) or k
        The meters to manipulate, or their number. A number selects those that the load affects most, with the
        customer's own meter if there is one.
    size
        Smallest displacement, pu, > 0.
    loads
        True loads at the time; typical loads by default.

    Returns
    -------
    meters : (k,)
        The manipulated meters.
    fake
        The load, and its trace at all meters: the difference of two AC power flows in equilibrium with the
        droop inverters. A final scaling by less than SIZING_TOLERANCE makes its size exact.

    Raises
    ------
    NoSuchAttack
        If no load moves the meters that far, or only one beyond LARGEST_SHIFT_PU.
    """
    loads = _typical(site) if loads is None else loads
    loop = ClosedLoop(power_flow(site), site.droop, site.feeder.base_kva, site.customer_volt)
    without = loop.equilibrium(loads)
    ratio = 0.5 * float(site.loads.tan_min[customer] + site.loads.tan_max[customer])
    one = np.array([customer])
    R, X = (0.5 * site.feeder.columns(power, one)[site.feeder.bus] for power in Power)
    v = without.v_volt / site.customer_volt
    nominal = site.customer_nominal
    pattern = (load_pattern(R, X, 0, ratio, v) * (site.customer_volt / nominal))[site.meters]
    chosen = _affected(site, customer, pattern, meters) if isinstance(meters, int) else meters
    try:
        power = coordinate(pattern, chosen, size)  # pu, to first order; AC power flow corrects it below
    except InputInvalid as error:
        raise NoSuchAttack(
            f"{site.feeder.name}, load at {site.feeder.customers[customer]}: {error}", code=error.codes[0]
        ) from error
    for _ in range(SIZING_ROUNDS):
        p_kw, q_kvar = loads.p_kw.copy(), loads.q_kvar.copy()
        p_kw[customer] += power * site.feeder.base_kva
        q_kvar[customer] += ratio * power * site.feeder.base_kva
        try:
            with_it = loop.equilibrium(Loads(p_kw, q_kvar, loads.v0_volt), without.x)
        except PowerFlowDiverged as error:
            raise NoSuchAttack(
                f"{site.feeder.name} cannot carry a load of {power * site.feeder.base_kva:.0f} kW at "
                f"{site.feeder.customers[customer]}, not even a fake one"
            ) from error
        shift = ((with_it.v_volt - without.v_volt) / nominal)[site.meters]
        missing = coordinate(shift, chosen, size)
        if abs(missing - 1.0) < SIZING_TOLERANCE:
            shift = shift * missing
            if np.max(np.abs(shift)) > LARGEST_SHIFT_PU:
                break
            kw = power * site.feeder.base_kva
            return chosen, FakeLoad(customer, kw, ratio * kw, shift)
        power *= missing
    raise NoSuchAttack(
        f"{site.feeder.name}: no plausible load at {site.feeder.customers[customer]} moves {chosen.size} "
        f"meters by {size:g} pu"
    )


def coordinated(
    site: Site, meters: Ints, fake: FakeLoad, *, t_on: float, t_off: float, power: bool
) -> Coordinated:
    """Build the attack with the trace of a fake load.

    Parameters
    ----------
    site
        The feeder.
    meters : (k,)
        The manipulated meters.
    fake
        The load; see `fake_load`.
    t_on, t_off
        Begin and end, Unix s.
    power
        True: the customer's own meter, if manipulated, also reports the load's p and q.
    """
    own = (site.meters[meters] == fake.customer) & power
    return Coordinated(
        meters=meters,
        t_on=t_on,
        t_off=t_off,
        shift=fake.shift[meters],
        p_shift=np.where(own, fake.p_kw, 0.0),
        q_shift=np.where(own, fake.q_kvar, 0.0),
    )


def _somewhere(
    site: Site,
    random: np.random.Generator,
    count: int,
    size: float,
    loads: Loads,
) -> tuple[Ints, FakeLoad]:
    """Fake load at the first possible customer, in random order."""
    why: NoSuchAttack | None = None
    for customer in random.permutation(site.meters):
        try:
            return fake_load(site, int(customer), count, size, loads=loads)
        except NoSuchAttack as error:
            why = error
    raise NoSuchAttack(f"{site.feeder.name} has no place for a fake load of this size; the last try: {why}")


def _affected(site: Site, customer: int, pattern: Floats, count: int) -> Ints:
    """The customer's own meter, and the meters with the strongest effect of its load."""
    return most_affected(np.where(site.meters == customer, np.inf, pattern), count)


def _plain(
    kind: RandomAttackKind, meters: Ints, signed: Floats, site: Site, *, t_on: float, t_off: float, seed: int
) -> Attack:
    """One attack with independent manipulations of the meters."""
    attack: Attack
    match kind:
        case RandomAttackKind.BIAS:
            attack = Bias(meters, t_on, t_off, size=signed)
        case RandomAttackKind.SCALING:
            attack = Scaling(meters, t_on, t_off, factor=signed / site.tables.meta.limits.v_min_pu)
        case RandomAttackKind.DRIFT:
            rate = 3.0 * signed / (t_off - t_on)
            attack = Drift(meters, t_on, t_off, rate=rate, limit=np.abs(signed))
        case RandomAttackKind.STUCK:
            attack = Stuck(meters, t_on, t_off)
        case RandomAttackKind.REPLAY:
            attack = Replay(meters, t_on, t_off, delay_s=3600.0)
        case RandomAttackKind.RANDOM:
            low = np.abs(signed)
            attack = Random(meters, t_on, t_off, low=low, high=LARGEST * low, hold_s=1.0, seed=seed)
        case _:
            raise NoSuchAttack(f"{kind} is not an attack of single meters", code="unknown-name")
    return attack


def _typical(site: Site) -> Loads:
    p_kw = TYPICAL_LOAD * np.array([row.load_kw for row in site.tables.customers])
    q_kvar = 0.5 * (site.loads.tan_min + site.loads.tan_max) * p_kw
    return Loads(p_kw, q_kvar, site.tables.meta.voltage_volt)


def present_loads(site: Site, scenario: Scenario, t: float) -> Loads:
    """Loads at time t, Unix s, without hidden powers."""
    customers = Customers(
        site, scenario.variation, scenario.seed, scenario.start, scenario.profile_s, season=scenario.season
    )
    demand = customers.at(np.array([t]))
    return Loads(demand.p_kw[0], demand.q_kvar[0], demand.v0_volt[0])


class AttackKind(StrEnum):
    """Manipulation of the devices."""

    BIAS = "bias"
    TOGETHER = "together"
    SCALING = "scaling"
    DRIFT = "drift"
    STUCK = "stuck"
    REPLAY = "replay"
    CLOCK_SHIFT = "clock-shift"
    COORDINATED = "coordinated"
    COORDINATED_POWER = "coordinated-power"
    POWER = "power"
    INVERTER = "inverter"


@dataclass(frozen=True, slots=True)
class AttackSpec:
    """Attack stated in one line: manipulation, count, size and time; the run's seed chooses the devices.

    Attributes
    ----------
    trick
        The manipulation.
    count
        Number of meters, or inverters.
    size
        Size. Bias (random signs), together (the sign of `size` for all) and scaling: % of nominal. Drift: %
        of nominal per minute, random signs. Coordinated: displacement of the least affected manipulated meter
        by the trace of a false load, % of nominal. The load is at a customer with a plausible reading of it,
        if there is one. Power: the same load, with only the power of that meter falsified. Replay and clock
        shift: age of the reports, s. Inverter: % of its rating, random signs. Stuck: unused.
    onset_s, end_s
        Seconds after the start of the run.
    """

    trick: AttackKind
    count: int = 1
    size: float = 3.0
    onset_s: float = 30.0
    end_s: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "trick", choice("trick", AttackKind, self.trick))


def manipulations(
    site: Site, lie: AttackSpec | None, scenario: Scenario
) -> tuple[tuple[Attack, ...], tuple[InverterAttack, ...]]:
    """Build the attacks of one statement.

    Parameters
    ----------
    site
        The feeder.
    lie
        The attack; None without one.
    scenario
        The run without attacks: its seed chooses the devices, and a false load adds to its loads.

    Raises
    ------
    NoSuchAttack
        For too few meters or inverters, or without a place for such a load.
    """
    if lie is None:
        return (), ()
    t_on, t_off = scenario.start + lie.onset_s, scenario.start + min(lie.end_s, scenario.duration_s)
    if lie.trick in (AttackKind.COORDINATED, AttackKind.COORDINATED_POWER, AttackKind.POWER):
        return (_coordinated(site, lie, scenario, t_on, t_off),), ()
    random = generator(scenario.seed, Stream.ATTACK)
    there = site.droop.tau.size if lie.trick is AttackKind.INVERTER else site.meters.size
    if not 0 < lie.count <= there:
        raise NoSuchAttack(
            f"{site.feeder.name} has {there} of these devices; cannot manipulate {lie.count}",
            code="too-few-meters",
        )
    liars = np.sort(random.choice(there, lie.count, replace=False)).astype(np.intp)
    signs = random.choice([-1.0, 1.0], lie.count)
    if lie.trick is AttackKind.INVERTER:
        rating = np.array([row.inverter_kva for row in site.tables.customers])[site.droop.customer]
        q = lie.size / 100.0 * signs * rating[liars] / site.feeder.base_kva
        return (), (InverterAttack(liars, q, t_on, t_off),)
    return (each_alone(lie, liars, signs, t_on, t_off),), ()


def _coordinated(site: Site, lie: AttackSpec, scenario: Scenario, t_on: float, t_off: float) -> Attack:
    """Attack with the trace of a load at a random customer."""
    if not 0 < lie.count <= site.meters.size:
        raise NoSuchAttack(
            f"{site.feeder.name} has {site.meters.size} meters; cannot manipulate {lie.count}",
            code="too-few-meters",
        )
    loads = present_loads(site, scenario, t_on)
    told: list[Attack] = []
    for customer in generator(scenario.seed, Stream.ATTACK).permutation(site.meters):
        try:
            meters, fake = fake_load(site, int(customer), lie.count, lie.size / 100.0, loads=loads)
        except NoSuchAttack:
            continue
        power = lie.trick is not AttackKind.COORDINATED
        attack = coordinated(site, meters, fake, t_on=t_on, t_off=t_off, power=power)
        if lie.trick is AttackKind.POWER:
            attack = _powers_of(attack)
        read_kw = loads.p_kw[customer] + fake.p_kw
        if abs(read_kw) <= site.loads.credible[customer] * site.feeder.base_kva:
            return attack
        told.append(attack)
    if not told:
        raise NoSuchAttack(f"{site.feeder.name} has no place for the trace of a load of {lie.size:g} %")
    return told[0]


def _powers_of(told: Coordinated) -> Coordinated:
    """Part of an attack that manipulates powers."""
    own = (told.p_shift != 0.0) | (told.q_shift != 0.0)
    return replace(
        told,
        meters=told.meters[own],
        shift=np.zeros(np.count_nonzero(own)),
        p_shift=told.p_shift[own],
        q_shift=told.q_shift[own],
    )


def each_alone(lie: AttackSpec, liars: Ints, signs: Floats, t_on: float, t_off: float) -> Attack:
    """Attack with independent manipulations of the meters.

    Parameters
    ----------
    lie
        Manipulation and size; neither of inverters nor coordinated.
    liars, signs : (k,)
        The meters, and the multiple of the size for each, usually a sign.
    t_on, t_off
        Begin and end, Unix s.
    """
    share = lie.size / 100.0
    attack: Attack
    match lie.trick:
        case AttackKind.BIAS:
            attack = Bias(liars, t_on, t_off, share * signs)
        case AttackKind.TOGETHER:
            attack = Bias(liars, t_on, t_off, share * np.abs(signs))
        case AttackKind.SCALING:
            attack = Scaling(liars, t_on, t_off, share * signs)
        case AttackKind.DRIFT:
            rate = share / 60.0 * signs
            attack = Drift(liars, t_on, t_off, rate, np.abs(rate) * (t_off - t_on))
        case AttackKind.STUCK:
            attack = Stuck(liars, t_on, t_off)
        case _:  # Replay and a late clock differ only in the age of the reports.
            attack = Replay(liars, t_on, t_off, lie.size)
    return attack

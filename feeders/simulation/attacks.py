"""Attacks on a given feeder, independent of any estimator.

The trace of a coordinated attack is that of an extra load in the AC power flow of the simulation, droop
inverters included. It is the strongest attack, as it has the shape of a real event.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from feeders.simulation.demand import Customers, Stream, generator
from feeders.simulation.plant import ClosedLoop, Loads
from feeders.simulation.powerflow import PowerFlowDiverged, power_flow
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

REPLAY_S: Final = 3600.0
"""Age of the reports of a random replay, s."""

SIZING_TOLERANCE: Final = 1e-4
SIZING_ROUNDS: Final = 30


class AttackKind(StrEnum):
    """Manipulation of the devices; `AttackSpec.size` states the size of each."""

    BIAS = "bias"
    TOGETHER = "together"
    SCALING = "scaling"
    DRIFT = "drift"
    STUCK = "stuck"
    REPLAY = "replay"
    CLOCK_SHIFT = "clock-shift"
    RANDOM = "random"
    COORDINATED = "coordinated"
    COORDINATED_POWER = "coordinated-power"
    POWER = "power"
    INVERTER = "inverter"


LOAD_TRACES: Final = (AttackKind.COORDINATED, AttackKind.COORDINATED_POWER, AttackKind.POWER)
"""Kinds with the trace of a fake load, or with the power of one."""

_NOT_RANDOM = (AttackKind.TOGETHER, AttackKind.CLOCK_SHIFT, AttackKind.POWER, AttackKind.INVERTER)
RANDOM_KINDS: Final = tuple(kind for kind in AttackKind if kind not in _NOT_RANDOM)
"""Kinds of `random_attacks`."""

Attacks: TypeAlias = tuple[tuple[Attack, ...], tuple[InverterAttack, ...]]


@dataclass(frozen=True, slots=True)
class AttackSpec:
    """Attack stated in one line: manipulation, count, size and time; the seed chooses the devices."""

    trick: AttackKind  # the manipulation
    count: int = 1  # number of meters, or inverters
    # Size. Bias (random signs), together (the sign of `size` for all) and scaling: % of nominal. Drift: % of
    # nominal per minute, random signs. Random: smallest displacement, % of nominal, redrawn each second.
    # Coordinated: displacement of the least affected manipulated meter by the trace of a false load, % of
    # nominal. The load is at a customer with a plausible reading of it, if there is one. Power: the same
    # load, with only the power of that meter falsified. Replay and clock shift: age of the reports, s.
    # Inverter: % of its rating, random signs. Stuck: unused.
    size: float = 3.0
    # Seconds after the start of the scenario.
    onset_s: float = 30.0
    end_s: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "trick", choice("trick", AttackKind, self.trick))


class NoSuchAttack(GridsecError):
    """An attack of the requested size does not exist on this feeder."""

    code = "no-such-attack"


@dataclass(frozen=True, slots=True, eq=False)
class FakeLoad:
    """A load that does not exist, and its change of the voltage at p meters: `shift` (p,), pu."""

    customer: int
    p_kw: float
    q_kvar: float
    shift: Floats


def no_size(size: float) -> list[Problem]:
    """Problem of a size relative to nominal that is probably given in per cent."""
    if abs(size) <= LARGEST_SIZE_PU:
        return []
    return [
        Problem("out-of-range", f"{size:g} is {100.0 * size:g} % of nominal; {size / 100.0:g} is {size:g} %")
    ]


def random_attacks(
    site: Site,
    seed: int,
    kind: AttackKind | str,
    count: int,
    size: float,
    *,
    t_on: float,
    t_off: float,
    scenario: Scenario | None = None,
) -> tuple[Attack, ...]:
    """Choose random meters of a feeder and their attack; the seed determines both.

    kind: one of RANDOM_KINDS. Bias, scaling and random displacements have random signs and sizes between
        `size` and 1.5 `size`. A drift reaches such a size after a third of the attack. A replay repeats the
        hour before. A fake load moves the least affected of its meters by `size`. Scaling moves a meter by at
        least `size` while its voltage is within the feeder's limits. Stuck meters have no size.
    size: smallest displacement of a manipulated meter, pu of nominal, > 0.
    t_on, t_off: begin and end, Unix s.
    scenario: source of the true loads at `t_on` under a fake load; typical loads by default.
    Raises NoSuchAttack for fewer meters than `count`, another kind, or without a place for a fake load of
        this size.
    """
    kind = choice("kind", AttackKind, kind)
    if kind not in RANDOM_KINDS:
        raise NoSuchAttack(f"{kind} is not a kind of random attacks", code="unknown-name")
    check_count(site, kind, count)
    random = generator(seed, Stream.ATTACK)
    if kind in LOAD_TRACES:
        loads = None if scenario is None else present_loads(site, scenario, t_on)
        return (load_trace(site, kind, count, size, random, loads=loads, t_on=t_on, t_off=t_off),)
    meters = np.sort(random.choice(site.meters.size, count, replace=False)).astype(np.intp)
    amount = size * random.uniform(1.0, LARGEST, count)
    signed = amount * random.choice([-1.0, 1.0], count)
    if kind is AttackKind.SCALING:
        signed /= site.tables.meta.limits.v_min_pu
    return (_displaced(kind, meters, signed, t_on, t_off, seed=seed),)


def busbar_attack(site: Site, kind: AttackKind | str, size: float, *, t_on: float, t_off: float) -> Attack:
    """Attack the busbar meter, in all of its phases, by bias, scaling or drift; times are Unix s.

    By bias the reading is too high by `size`, pu; by scaling by this part of itself; by drift by `size` from
    a third of the attack on. A negative size gives low readings. Raises NoSuchAttack for another kind.
    """
    kind = choice("kind", AttackKind, kind)
    if kind not in (AttackKind.BIAS, AttackKind.SCALING, AttackKind.DRIFT):
        raise NoSuchAttack(
            f"the busbar meter is manipulated by bias, scaling or drift, not by {kind}", code="unknown-name"
        )
    phases = np.arange(site.feeder.busbar_places().stop)
    return _displaced(kind, phases, np.full(phases.size, size), t_on, t_off)


def manipulations(site: Site, lie: AttackSpec | None, scenario: Scenario) -> Attacks:
    """Build the attacks of one statement; none for None.

    The seed of `scenario` (without attacks) chooses the devices; a false load adds to its loads. Raises
    NoSuchAttack for too few devices, or without a place for such a load.
    """
    if lie is None:
        return (), ()
    t_on, t_off = scenario.start + lie.onset_s, scenario.start + min(lie.end_s, scenario.duration_s)
    there = check_count(site, lie.trick, lie.count)
    random = generator(scenario.seed, Stream.ATTACK)
    if lie.trick in LOAD_TRACES:
        loads = present_loads(site, scenario, t_on)
        share = lie.size / 100.0
        attack = load_trace(
            site, lie.trick, lie.count, share, random, loads=loads, t_on=t_on, t_off=t_off, plausible=True
        )
        return (attack,), ()
    devices = np.sort(random.choice(there, lie.count, replace=False)).astype(np.intp)
    signs = random.choice([-1.0, 1.0], lie.count)
    return on_devices(site, lie, devices, signs, t_on=t_on, t_off=t_off, seed=scenario.seed)


def check_count(site: Site, kind: AttackKind, count: int) -> int:
    """Number of meters, or inverters, of a feeder; NoSuchAttack if `count` of them do not exist."""
    inverters = kind is AttackKind.INVERTER
    there = site.droop.tau.size if inverters else site.meters.size
    if not 0 < count <= there:
        devices = "inverters" if inverters else "meters"
        raise NoSuchAttack(
            f"{site.feeder.name} has {there} {devices}; cannot attack {count}", code="too-few-meters"
        )
    return int(there)


def on_devices(
    site: Site, lie: AttackSpec, devices: Ints, signs: Floats, *, t_on: float, t_off: float, seed: int = 0
) -> Attacks:
    """Attack given meters or inverters (k,) independently, each by its sign (k,) of the size."""
    amount = lie.size / 100.0 * (np.abs(signs) if lie.trick is AttackKind.TOGETHER else signs)
    if lie.trick is AttackKind.INVERTER:
        rating = np.array([row.inverter_kva for row in site.tables.customers])[site.droop.customer]
        return (), (InverterAttack(devices, amount * rating[devices] / site.feeder.base_kva, t_on, t_off),)
    if lie.trick is AttackKind.DRIFT:
        amount /= 60.0
    limit = np.abs(amount) * (t_off - t_on)
    return (_on_meters(lie.trick, devices, t_on, t_off, amount, limit, delay_s=lie.size, seed=seed),), ()


def _displaced(
    kind: AttackKind, meters: Ints, signed: Floats, t_on: float, t_off: float, *, seed: int = 0
) -> Attack:
    """Attack with given displacements, pu; a drift reaches them after a third of the attack."""
    amount = 3.0 * signed / (t_off - t_on) if kind is AttackKind.DRIFT else signed
    return _on_meters(kind, meters, t_on, t_off, amount, np.abs(signed), delay_s=REPLAY_S, seed=seed)


def _on_meters(  # noqa: PLR0917  # the fields of an attack
    kind: AttackKind,
    meters: Ints,
    t_on: float,
    t_off: float,
    amount: Floats,
    limit: Floats,
    *,
    delay_s: float,
    seed: int,
) -> Attack:
    """Attack on each meter by its `amount`, pu; of a drift in pu/s, up to `limit` pu."""
    match kind:
        case AttackKind.SCALING:
            return Scaling(meters, t_on, t_off, amount)
        case AttackKind.DRIFT:
            return Drift(meters, t_on, t_off, amount, limit)
        case AttackKind.STUCK:
            return Stuck(meters, t_on, t_off)
        case AttackKind.REPLAY | AttackKind.CLOCK_SHIFT:  # they differ only in the age of the reports
            return Replay(meters, t_on, t_off, delay_s)
        case AttackKind.RANDOM:
            low = np.abs(amount)
            return Random(meters, t_on, t_off, low=low, high=LARGEST * low, hold_s=1.0, seed=seed)
        case AttackKind.BIAS | AttackKind.TOGETHER:
            return Bias(meters, t_on, t_off, amount)
        case _:
            raise NoSuchAttack(f"{kind} is not a manipulation of single meters", code="unknown-name")


def fake_load(
    site: Site, customer: int, meters: Ints | int, size: float, *, loads: Loads | None = None
) -> tuple[Ints, FakeLoad]:
    """Size a load at one customer with a trace of at least `size` pu at every manipulated meter.

    `meters` are the manipulated ones, (k,), or their number. A number selects those that the load affects
    most, with the customer's own meter if there is one. Without `loads` the true loads are typical ones.

    Returns meters (k,): the manipulated meters.
    Returns fake: the load, and its trace at all meters: the difference of two AC power flows in equilibrium
        with the droop inverters. A final scaling by less than SIZING_TOLERANCE makes its size exact.
    Raises NoSuchAttack if no load moves the meters that far, or only one beyond LARGEST_SHIFT_PU.
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
    # The customer's own meter counts as affected most.
    strength = np.where(site.meters == customer, np.inf, pattern)
    chosen = most_affected(strength, meters) if isinstance(meters, int) else meters
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
    site: Site, meters: Ints, fake: FakeLoad, *, t_on: float, t_off: float, kind: AttackKind
) -> Coordinated:
    """Build the attack on given meters (k,) with the trace of a fake load.

    With COORDINATED_POWER the customer's own meter, if manipulated, also reports the load's p and q. With
    POWER it reports these only, and the other meters are not manipulated.
    """
    own = (site.meters[meters] == fake.customer) & (kind is not AttackKind.COORDINATED)
    shift = fake.shift[meters]
    p_shift, q_shift = np.where(own, fake.p_kw, 0.0), np.where(own, fake.q_kvar, 0.0)
    if kind is not AttackKind.POWER:
        return Coordinated(meters, t_on, t_off, shift, p_shift, q_shift)
    own &= (p_shift != 0.0) | (q_shift != 0.0)
    return Coordinated(meters[own], t_on, t_off, np.zeros_like(shift[own]), p_shift[own], q_shift[own])


def load_trace(
    site: Site,
    kind: AttackKind,
    count: int,
    size: float,
    random: np.random.Generator,
    *,
    loads: Loads | None,
    t_on: float,
    t_off: float,
    plausible: bool = False,
) -> Coordinated:
    """Attack with the trace of a load at the first possible customer, in random order.

    The trace displaces `count` meters by at least `size` pu. `plausible` prefers a customer with a plausible
    reading of its power with the load. Raises NoSuchAttack without such a customer.
    """
    loads = _typical(site) if loads is None else loads
    first: Coordinated | None = None
    why: NoSuchAttack | None = None
    for customer in random.permutation(site.meters):
        try:
            meters, fake = fake_load(site, int(customer), count, size, loads=loads)
        except NoSuchAttack as error:
            why = error
            continue
        attack = coordinated(site, meters, fake, t_on=t_on, t_off=t_off, kind=kind)
        read_kw = loads.p_kw[customer] + fake.p_kw
        if not plausible or abs(read_kw) <= site.loads.credible[customer] * site.feeder.base_kva:
            return attack
        first = first or attack
    if first is None:
        raise NoSuchAttack(
            f"{site.feeder.name} has no place for a fake load of this size; the last try: {why}"
        )
    return first


def _typical(site: Site) -> Loads:
    p_kw = TYPICAL_LOAD * np.array([row.load_kw for row in site.tables.customers])
    q_kvar = 0.5 * (site.loads.tan_min + site.loads.tan_max) * p_kw
    return Loads(p_kw, q_kvar, site.tables.meta.voltage_volt)


def present_loads(site: Site, scenario: Scenario, t: float) -> Loads:
    """Loads at time t, Unix s, without hidden powers."""
    demand = Customers.of(site, scenario).at(np.array([t]))
    return Loads(demand.p_kw[0], demand.q_kvar[0], demand.v0_volt[0])

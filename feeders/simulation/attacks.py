"""Attacks on a given feeder: random and coordinated campaigns, and attacks stated in one line.

Everything here knows the feeder and no estimator. The coordinated attack asks the same AC power flow that the
truth comes from what an extra load would look like, droop inverters included: the strongest lie that leaves
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
"""Random displacements lie between `size` and this times `size`."""

LARGEST_SIZE_PU: Final = 0.5
"""A size beyond this is hardly meant: it was said in per cent."""

LARGEST_SHIFT_PU: Final = 0.2
"""A fake load that drops any voltage by more than this would be absurd at first sight."""

TYPICAL_LOAD: Final = 0.3
"""Share of `load_kw` that customers draw where no scenario says more."""

SIZING_TOLERANCE: Final = 1e-4
SIZING_ROUNDS: Final = 30


class Kind(StrEnum):
    """Kinds of attack that `random_attacks` makes."""

    BIAS = "bias"
    SCALING = "scaling"
    DRIFT = "drift"
    STUCK = "stuck"
    REPLAY = "replay"
    RANDOM = "random"
    COORDINATED = "coordinated"
    COORDINATED_POWER = "coordinated-power"


def no_size(size: float) -> list[Problem]:
    """Return what is wrong with a size that somebody asks for: one that was said in per cent.

    Parameters
    ----------
    size
        A part of nominal.
    """
    if abs(size) <= LARGEST_SIZE_PU:
        return []
    return [
        Problem("out-of-range", f"{size:g} is {100.0 * size:g} % of nominal; {size / 100.0:g} is {size:g} %")
    ]


class NoSuchAttack(GridsecError):
    """An attack of the size asked for cannot be made on this feeder."""

    code = "no-such-attack"


@dataclass(frozen=True, slots=True, eq=False)
class FakeLoad:
    """A load that does not exist, and the trace that it would leave. p meters.

    Attributes
    ----------
    customer
        Index of the customer who would draw it.
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
    kind: Kind | str,
    count: int,
    size: float,
    *,
    t_on: float,
    t_off: float,
    scenario: Scenario | None = None,
) -> tuple[Attack, ...]:
    """Attack random meters of a feeder.

    Parameters
    ----------
    site
        The feeder.
    seed
        Chooses the meters, their displacements and the place of a fake load.
    kind
        What the attack does. Bias, scaling and random displacements have random signs and sizes between
        `size` and 1.5 `size`; a drift arrives at such a size after a third of the attack; a replay plays
        the hour before; a fake load moves the least affected of its meters by just `size`. Scaling moves
        a meter by at least `size` while its voltage is within the feeder's limits. Stuck and replayed
        meters are displaced by what has changed since, whatever `size` says.
    count
        How many meters lie.
    size
        Smallest displacement of a manipulated meter, pu of nominal, > 0.
    t_on, t_off
        When they lie, Unix s.
    scenario
        Where the loads beneath a fake load are taken from, at `t_on`; typical ones by default.

    Raises
    ------
    NoSuchAttack
        When there are fewer meters than `count`, or no place for a fake load of this size.
    """
    kind = Kind(kind)
    if not 0 < count <= site.meters.size:
        raise NoSuchAttack(
            f"{site.feeder.name} has {site.meters.size} meters; cannot attack {count}", code="too-few-meters"
        )
    random = generator(seed, Stream.ATTACK)
    if kind in (Kind.COORDINATED, Kind.COORDINATED_POWER):
        loads = _typical(site) if scenario is None else present_loads(site, scenario, t_on)
        meters, fake = _somewhere(site, random, count, size, loads)
        power = kind is Kind.COORDINATED_POWER
        return (coordinated(site, meters, fake, t_on=t_on, t_off=t_off, power=power),)
    meters = np.sort(random.choice(site.meters.size, count, replace=False)).astype(np.intp)
    amount = size * random.uniform(1.0, LARGEST, count)
    signed = amount * random.choice([-1.0, 1.0], count)
    return (_plain(kind, meters, signed, site, t_on=t_on, t_off=t_off, seed=seed),)


def busbar_attack(site: Site, kind: Kind | str, size: float, *, t_on: float, t_off: float) -> Attack:
    """Attack the busbar's own meter, in all of its phases.

    Parameters
    ----------
    site
        The feeder.
    kind
        Bias, scaling or drift: what it reads is too high by `size`, by this part of it, or comes to be so
        by `size` after a third of the attack.
    size
        Displacement, pu of nominal; negative if it reads too little.
    t_on, t_off
        When it lies, Unix s.

    Raises
    ------
    NoSuchAttack
        When it is of another kind.
    """
    phases = np.arange(site.feeder.busbar_places().stop)
    signed = np.full(phases.size, size)
    match Kind(kind):
        case Kind.SCALING:
            return Scaling(phases, t_on, t_off, factor=signed)
        case Kind.BIAS | Kind.DRIFT as plain:
            return _plain(plain, phases, signed, site, t_on=t_on, t_off=t_off, seed=0)
        case other:
            raise NoSuchAttack(
                f"the busbar's meter is manipulated by bias, scaling or drift, not by {other}",
                code="unknown-name",
            )


def fake_load(
    site: Site, customer: int, meters: Ints | int, size: float, *, loads: Loads | None = None
) -> tuple[Ints, FakeLoad]:
    """Size a load at one customer whose trace moves every lying meter by at least `size`.

    Parameters
    ----------
    site
        The feeder.
    customer
        Index of the customer.
    meters : (k,) or k
        The meters that will lie, or how many: then those that the load affects most, the customer's own
        among them if it has one.
    size
        Smallest displacement, pu, > 0.
    loads
        What customers draw at the time; typical loads by default.

    Returns
    -------
    meters : (k,)
        Those that lie.
    fake
        The load, and its trace at all meters: the difference of two AC power flows in equilibrium with the
        droop inverters, scaled at the very end (by less than SIZING_TOLERANCE) to `size`.

    Raises
    ------
    NoSuchAttack
        When no load moves the meters that far, or only one that is absurd at first sight.
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
        power = coordinate(pattern, chosen, size)  # pu, to first order; AC has the last word below
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
    """Let meters tell the story of a fake load.

    Parameters
    ----------
    site
        The feeder.
    meters : (k,)
        Those that lie.
    fake
        The story; see `fake_load`.
    t_on, t_off
        When they lie, Unix s.
    power
        Whether the customer's own meter, if it is among them, also reports the load's p and q.
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
    """A fake load at the first customer, in random order, at whom it can be made."""
    why: NoSuchAttack | None = None
    for customer in random.permutation(site.meters):
        try:
            return fake_load(site, int(customer), count, size, loads=loads)
        except NoSuchAttack as error:
            why = error
    raise NoSuchAttack(f"{site.feeder.name} has no place for a fake load of this size; the last try: {why}")


def _affected(site: Site, customer: int, pattern: Floats, count: int) -> Ints:
    """The customer's own meter, and those that feel its load most: all lines to it are theirs too."""
    return most_affected(np.where(site.meters == customer, np.inf, pattern), count)


def _plain(
    kind: Kind, meters: Ints, signed: Floats, site: Site, *, t_on: float, t_off: float, seed: int
) -> Attack:
    """One attack in which every meter lies for itself."""
    attack: Attack
    match kind:
        case Kind.BIAS:
            attack = Bias(meters, t_on, t_off, size=signed)
        case Kind.SCALING:
            attack = Scaling(meters, t_on, t_off, factor=signed / site.tables.meta.limits.v_min_pu)
        case Kind.DRIFT:
            rate = 3.0 * signed / (t_off - t_on)
            attack = Drift(meters, t_on, t_off, rate=rate, limit=np.abs(signed))
        case Kind.STUCK:
            attack = Stuck(meters, t_on, t_off)
        case Kind.REPLAY:
            attack = Replay(meters, t_on, t_off, delay_s=3600.0)
        case Kind.RANDOM:
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
    """What customers draw at time t, Unix s, without what readings do not show."""
    customers = Customers(
        site, scenario.variation, scenario.seed, scenario.start, scenario.profile_s, season=scenario.season
    )
    demand = customers.at(np.array([t]))
    return Loads(demand.p_kw[0], demand.q_kvar[0], demand.v0_volt[0])


class Trick(StrEnum):
    """How meters lie."""

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
class Lie:
    """Who lies, how and when; the seed of the run chooses the liars.

    Attributes
    ----------
    trick
        What they do.
    count
        How many meters, or inverters, do it.
    size
        How much. Bias (random signs), together (the sign of `size` for all) and scaling: % of nominal.
        Drift: % of nominal per minute, random signs. Coordinated: % of nominal by which the trace of a load
        that does not exist moves the least affected liar; it is at a customer whose meter would be believed
        to read it, if there is one. Power: the same load, but only that meter lies, and only about the power.
        Replay and clock shift: how old the reports are,
        s. Inverter: % of its rating, random signs. Stuck: nothing.
    onset_s, end_s
        Seconds after the start of the run.
    """

    trick: Trick
    count: int = 1
    size: float = 3.0
    onset_s: float = 30.0
    end_s: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "trick", choice("trick", Trick, self.trick))


def manipulations(
    site: Site, lie: Lie | None, scenario: Scenario
) -> tuple[tuple[Attack, ...], tuple[InverterAttack, ...]]:
    """Turn a lie into attacks.

    Parameters
    ----------
    site
        The feeder.
    lie
        Who lies; None: nobody.
    scenario
        The run without attacks: its seed chooses the liars, its loads lie beneath one that does not exist.

    Raises
    ------
    NoSuchAttack
        When the feeder has too few meters or inverters, or no place for such a load.
    """
    if lie is None:
        return (), ()
    t_on, t_off = scenario.start + lie.onset_s, scenario.start + min(lie.end_s, scenario.duration_s)
    if lie.trick in (Trick.COORDINATED, Trick.COORDINATED_POWER, Trick.POWER):
        return (_coordinated(site, lie, scenario, t_on, t_off),), ()
    random = generator(scenario.seed, Stream.ATTACK)
    there = site.droop.tau.size if lie.trick is Trick.INVERTER else site.meters.size
    if not 0 < lie.count <= there:
        raise NoSuchAttack(
            f"{site.feeder.name} has {there} of what {lie.count} should lie", code="too-few-meters"
        )
    liars = np.sort(random.choice(there, lie.count, replace=False)).astype(np.intp)
    signs = random.choice([-1.0, 1.0], lie.count)
    if lie.trick is Trick.INVERTER:
        rating = np.array([row.inverter_kva for row in site.tables.customers])[site.droop.customer]
        q = lie.size / 100.0 * signs * rating[liars] / site.feeder.base_kva
        return (), (InverterAttack(liars, q, t_on, t_off),)
    return (each_alone(lie, liars, signs, t_on, t_off),), ()


def _coordinated(site: Site, lie: Lie, scenario: Scenario, t_on: float, t_off: float) -> Attack:
    """All liars tell one story, the trace of a load at a random customer."""
    if not 0 < lie.count <= site.meters.size:
        raise NoSuchAttack(
            f"{site.feeder.name} has {site.meters.size} meters; {lie.count} cannot lie", code="too-few-meters"
        )
    loads = present_loads(site, scenario, t_on)
    told: list[Attack] = []
    for customer in generator(scenario.seed, Stream.ATTACK).permutation(site.meters):
        try:
            meters, fake = fake_load(site, int(customer), lie.count, lie.size / 100.0, loads=loads)
        except NoSuchAttack:
            continue
        power = lie.trick is not Trick.COORDINATED
        attack = coordinated(site, meters, fake, t_on=t_on, t_off=t_off, power=power)
        if lie.trick is Trick.POWER:
            attack = _powers_of(attack)
        read_kw = loads.p_kw[customer] + fake.p_kw
        if abs(read_kw) <= site.loads.credible[customer] * site.feeder.base_kva:
            return attack
        told.append(attack)
    if not told:
        raise NoSuchAttack(f"{site.feeder.name} has no place for the trace of a load of {lie.size:g} %")
    return told[0]


def _powers_of(told: Coordinated) -> Coordinated:
    """What of a story is about powers."""
    own = (told.p_shift != 0.0) | (told.q_shift != 0.0)
    return replace(
        told,
        meters=told.meters[own],
        shift=np.zeros(np.count_nonzero(own)),
        p_shift=told.p_shift[own],
        q_shift=told.q_shift[own],
    )


def each_alone(lie: Lie, liars: Ints, signs: Floats, t_on: float, t_off: float) -> Attack:
    """A lie that every meter tells for itself.

    Parameters
    ----------
    lie
        The trick, neither of inverters nor coordinated, and its size.
    liars, signs : (k,)
        Which meters, and by which multiple of the size each; signs for most.
    t_on, t_off
        When, Unix s.
    """
    share = lie.size / 100.0
    attack: Attack
    match lie.trick:
        case Trick.BIAS:
            attack = Bias(liars, t_on, t_off, share * signs)
        case Trick.TOGETHER:
            attack = Bias(liars, t_on, t_off, share * np.abs(signs))
        case Trick.SCALING:
            attack = Scaling(liars, t_on, t_off, share * signs)
        case Trick.DRIFT:
            rate = share / 60.0 * signs
            attack = Drift(liars, t_on, t_off, rate, np.abs(rate) * (t_off - t_on))
        case Trick.STUCK:
            attack = Stuck(liars, t_on, t_off)
        case _:  # Replay and a clock that is late differ only in how far back they look.
            attack = Replay(liars, t_on, t_off, lie.size)
    return attack

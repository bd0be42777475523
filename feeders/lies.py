"""Lies: who of a feeder's meters or inverters misbehaves in a simulated run, in one line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from feeders.campaign import NoSuchAttack, coordinated, fake_load, present_loads
from feeders.variation import Stream, generator
from gridsec.arrays import Floats, Ints
from gridsec.attack import Attack, Bias, Coordinated, Drift, InverterAttack, Replay, Scaling, Stuck
from gridsec.choices import choice

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.scenario import Scenario


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

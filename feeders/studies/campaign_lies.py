"""Who lies in one case of a campaign, and how."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from feeders.campaign import NoSuchAttack, coordinated, fake_load, present_loads
from feeders.inverters import Loads
from feeders.lies import Lie, Trick, each_alone
from feeders.studies.campaign_plan import Case, Place, Plan
from gridsec.arrays import Floats, Ints
from gridsec.attack import Attack, Bias, InverterAttack, load_pattern, most_affected
from gridsec.network import Power, between

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.scenario import Scenario

__all__ = ["attacks", "liars"]


def attacks(
    site: Site, plan: Plan, case: Case, honest: Scenario
) -> tuple[tuple[Attack, ...], tuple[InverterAttack, ...]]:
    """Turn a case into attacks.

    Parameters
    ----------
    site, plan, case
        The feeder, and what is to happen; somebody lies.
    honest
        The scene without it.

    Raises
    ------
    NoSuchAttack
        When the feeder has too few meters or inverters, or no place for a load that does not exist.
    """
    kind, random = plan.kind(case.kind), np.random.default_rng(case.seed)
    there = site.droop.tau.size if kind.trick is Trick.INVERTER else site.meters.size
    if case.liars > there:
        raise NoSuchAttack(
            f"{site.feeder.name} has {there} of what {case.liars} should lie", code="too-few-meters"
        )
    t_on = honest.start + case.onset_s
    t_off = honest.start + min(case.onset_s + plan.lying_s, plan.duration_s)
    if kind.trick in (Trick.COORDINATED, Trick.COORDINATED_POWER):
        power = kind.trick is Trick.COORDINATED_POWER
        loads = present_loads(site, honest, t_on)
        return (_story(site, case, loads, random, t_on=t_on, t_off=t_off, power=power),), ()
    if kind.trick is Trick.INVERTER:
        some = np.sort(random.choice(there, case.liars, replace=False))
        rating = np.array([row.inverter_kva for row in site.tables.customers])[site.droop.customer[some]]
        q = case.size / 100.0 * random.choice([-1.0, 1.0], some.size) * rating / site.feeder.base_kva
        return (), (InverterAttack(some.astype(np.intp), q, t_on, t_off),)
    for sizes in (kind.volts, *kind.together):
        if sizes and len(sizes) != there:
            raise NoSuchAttack(
                f"kind {kind.name!r} has sizes for {len(sizes)} meters of {there}", code="shape"
            )
    if kind.together:
        told = np.array(kind.together[int(random.integers(len(kind.together)))])
        some, signs = np.flatnonzero(told), random.choice([-1.0, 1.0], 1)
    else:
        told = np.array(kind.volts)
        some, signs = liars(site, case, random)
    if told.size:
        nominal = site.customer_nominal[site.meters[some]]
        return (Bias(some, t_on, t_off, case.size * signs * told[some] / nominal),), ()
    lie = Lie(kind.trick, case.liars, case.size)
    return (each_alone(lie, some, signs, t_on, t_off),), ()


def liars(site: Site, case: Case, random: np.random.Generator) -> tuple[Ints, Floats]:
    """Choose who lies by a case's rule.

    Parameters
    ----------
    site, case
        The feeder, and what is to happen.
    random
        Chooses.

    Returns
    -------
    meters : (k,)
        Who lies, ascending.
    signs : (k,)
        In which direction.

    Raises
    ------
    NoSuchAttack
        When no load is felt by so many meters.
    """
    p, count = site.meters.size, case.liars
    signs: Floats = random.choice([-1.0, 1.0], count)
    if case.place == Place.RANDOM:
        return np.sort(random.choice(p, count, replace=False)).astype(np.intp), signs
    R, X = (between(site.feeder, power) for power in Power)
    if case.place == Place.SENSITIVE:
        # What loads of equal and independent uncertainty do to each voltage.
        felt = np.sqrt((R**2).sum(axis=1) + (X**2).sum(axis=1))
        return most_affected(felt[site.meters], count), signs
    if case.place == Place.STREET:
        return _nearest(R, site.meters, int(random.integers(p)), count), signs
    v = np.ones(len(R))
    for customer in random.permutation(site.meters):
        ratio = 0.5 * float(site.loads.tan_min[customer] + site.loads.tan_max[customer])
        pattern = np.abs(load_pattern(R, X, int(customer), ratio, v)[site.meters])
        some = most_affected(pattern, count)
        if pattern[some].min() > 0.0:
            return some, np.full(count, signs[0])
    raise NoSuchAttack(f"{site.feeder.name} has no load that {count} meters feel")


def _nearest(R: Floats, meters: Ints, one: int, count: int) -> Ints:
    """A meter and those with the least resistance between them and it."""
    own = np.diagonal(R)[meters]
    apart = own[one] + own - 2.0 * R[meters[one], meters]
    apart[one] = -1.0
    return np.sort(np.argsort(apart, kind="stable")[:count]).astype(np.intp)


def _story(
    site: Site,
    case: Case,
    loads: Loads,
    random: np.random.Generator,
    *,
    t_on: float,
    t_off: float,
    power: bool,
) -> Attack:
    """The trace of a load at the first customer, in random order, who could draw it."""
    why: NoSuchAttack | None = None
    for customer in random.permutation(site.meters):
        try:
            some, fake = fake_load(site, int(customer), case.liars, case.size / 100.0, loads=loads)
        except NoSuchAttack as error:
            why = error
            continue
        return coordinated(site, some, fake, t_on=t_on, t_off=t_off, power=power)
    raise NoSuchAttack(f"{site.feeder.name} has no place for the trace of a load of {case.size:g} %: {why}")

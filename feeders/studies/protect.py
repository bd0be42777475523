"""Fewest meters to protect such that attacks are identified, are noticed, or have a bounded size.

References: docs/theory-studies.md, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np
import pandas as pd

from feeders.model.site import Site
from feeders.studies.operating import SHARE, box, false_powers, squared, volts_of_lie
from feeders.studies.running import Journal, Where
from feeders.studies.unobservable import Attack, CurvePositions, knowledge, meter_mask, see_names
from gridsec.arrays import Bools, Ints
from gridsec.errors import DesignInfeasible, Problem, choice, no_choice, raise_if_any
from gridsec.planning.protection import Attacker, Unprotectable, fewest_protected, hides, lies_beyond
from gridsec.planning.redundancy import Patterns, fewest_meters
from gridsec.planning.stealthy_attacks import ErrorBox, PowerErrorModel, largest_lie, largest_of

__all__ = ["Goal", "Protect", "check", "protect"]


class Goal(StrEnum):
    """Goal of protection."""

    IDENTIFY = "identify"
    NOTICE = "notice"
    BOUND = "bound"
    CONTAIN = "contain"

    @property
    def in_volts(self) -> bool:
        """True for goals about sizes of attacks, not about their detectability."""
        return self in {Goal.BOUND, Goal.CONTAIN}


@dataclass(frozen=True, slots=True, eq=False)
class Protect:
    """Result of `protect`."""

    feeder: str
    digest: str
    # goal, max_attacked, attack, lie_volt: requested or default question: M, the attacks that count, and the
    # bound of attacks (NaN for goals without one)
    goal: Goal
    max_attacked: int
    attack: Attack
    lie_volt: float
    # With a bound: the largest attack that one meter hides by itself, with true powers, V. No protection of
    # other meters lowers it.
    alone: float
    # before, after: without and with protection: the fewest manipulated meters that stay invisible, or the
    # largest hidden attack, V, referred to the busbar's level
    before: float
    after: float
    least: int  # proven lower bound of the number of meters; equal to their number if they are the fewest
    # one row for each meter to protect: `meter`, `customer`, `bus`, `attacks` (number of the attacks below
    # with this meter)
    meters: pd.DataFrame
    attacks: pd.DataFrame  # attacks that exclude any smaller set: `liars`
    share: float = SHARE  # load relative to its peak, the same for all, 1

    @property
    def gap(self) -> int:
        """Largest possible number of superfluous meters; 0: these are the fewest."""
        return len(self.meters) - self.least

    @property
    def no_answer(self) -> bool:
        """True if the goal requires no protection on this feeder, which is no safety.

        With all powers known no attack is exactly consistent, however small. Sizes of attacks within honest
        errors are not part of the goals `IDENTIFY` and `NOTICE`.
        """
        return not self.goal.in_volts and math.isinf(self.before)

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name; `summary` is one row: question, number of meters, and effect."""
        asked = {"goal": str(self.goal), "max_attacked": self.max_attacked}
        asked |= (
            {"lie_volt": self.lie_volt, "alone": self.alone}
            if self.goal.in_volts
            else {"attack": str(self.attack)}
        )
        found = {
            "protected": len(self.meters),
            "least": self.least,
            "before": self.before,
            "after": self.after,
        }
        return {
            "summary": pd.DataFrame([asked | found]),
            "meters": self.meters,
            "attacks": self.attacks,
        }


def protect(
    site: Site,
    *,
    max_attacked: int,
    goal: Goal | None = None,
    lie_volt: float = math.nan,
    attack: Attack = Attack.PERSISTENT,
    unknown: Sequence[str] | None = None,
    busbar_known: bool = True,
    curves: CurvePositions | None = None,
    share: float = SHARE,
    never: Sequence[str] = (),
    exact: bool = True,
    journal: Where = None,
    progress: Callable[[int, int], None] | None = None,
) -> Protect:
    """Find the fewest meters to protect; a protected meter cannot be manipulated.

    `progress` is called with the number of known attacks, and of meters protected against them.

    max_attacked: M: largest number of manipulated meters among the others.
    goal: `IDENTIFY`: the readings determine the manipulated meters. `NOTICE`: every attack is detected. Both
        as in `feeders.studies.redundancy`. `BOUND`: no attack larger than `lie_volt` is consistent with an
        honest feeder, with true powers. `CONTAIN`: the same with any reported powers within the customers'
        range. By default `IDENTIFY` if attacks can stay invisible at all and there is no bound, otherwise
        `CONTAIN`.
    lie_volt: bound of the attack, V, at nominal voltage of the busbar; behind a transformer to another level,
        the same part of the nominal voltage there. Default for `CONTAIN`: halfway between `alone` and
        `before`.
    attack, unknown, busbar_known: for `IDENTIFY` and `NOTICE`: the attacks that count, and the unknowns.
        `CONTAIN` also has the unknown powers; `BOUND` has none. Both, and every `lie_volt`, need the busbar
        voltage.
    curves: operating region of the inverters. By default the steepest part for the first two goals, the
        deadband for the others.
    share: for `BOUND` and `CONTAIN`: load relative to its peak, the same for all, 1.
    never: meters that cannot be protected.
    exact: True: prove the smallest number; otherwise greedy, with `gap`.
    Raises DesignInfeasible if no protection of the other meters suffices; ValueError for an unknown customer
        or meter, or as `check`; OtherStudy, InUse as `feeders.studies.running.Journal`.
    """
    check(
        max_attacked=max_attacked,
        goal=goal,
        lie_volt=lie_volt,
        attack=attack,
        unknown=unknown,
        busbar_known=busbar_known,
        curves=curves,
        share=share,
    )
    see_names(site, unknown=unknown, meters=never)
    attack, goal = Attack(attack), None if goal is None else Goal(goal)
    know = partial(knowledge, site, unknown=unknown, silent=(), busbar_known=busbar_known)
    if goal is None:
        bounded = busbar_known and (
            lie_volt > 0.0 or _nobody_hides(know(curves=curves or CurvePositions.STEEPEST).found[attack])
        )
        goal = Goal.CONTAIN if bounded else Goal.IDENTIFY
    usual = CurvePositions.DEADBAND if goal.in_volts else CurvePositions.STEEPEST
    where = usual if curves is None else choice("curves", CurvePositions, curves)
    if goal.in_volts:
        asked = _in_volts(site, goal, max_attacked, lie_volt, unknown=unknown, share=share, curves=where)
    else:
        asked = _hidden(know(curves=where).found[attack], max_attacked, goal)
    subject = {
        "study": "protect",
        "digest": site.digest,
        "goal": str(goal),
        "max_attacked": max_attacked,
        "lie_part": asked.lie_volt / site.tables.meta.voltage_volt if goal.in_volts else None,
        "attack": str(attack),
        "unknown": None if unknown is None else sorted(unknown),
        "busbar_known": busbar_known,
        "curves": str(where),
        "share": share,
    }
    fixed = meter_mask(site, never)
    try:
        with Journal(journal, subject) as kept:
            attacker = _kept(asked.attacker, kept)
            found = fewest_protected(attacker, fixed.size, never=fixed, exact=exact, progress=progress)
    except Unprotectable as error:
        what = f"protection of {site.feeder.name} ({goal}, M = {max_attacked})"
        why = _unmet([site.meter_ids[j] for j in error.liars])
        raise DesignInfeasible(what, why, code="unprotectable") from error
    protected = np.zeros(fixed.size, dtype=np.bool_)
    protected[found.meters] = True
    return Protect(
        feeder=site.feeder.name,
        digest=site.digest,
        goal=goal,
        max_attacked=max_attacked,
        attack=attack,
        lie_volt=asked.lie_volt,
        alone=asked.alone,
        before=asked.before,
        after=asked.measure(protected) if protected.any() else asked.before,
        least=found.least,
        meters=_meters(site, found.meters, found.attacks),
        attacks=pd.DataFrame({"liars": [" ".join(site.meter_ids[j] for j in a) for a in found.attacks]}),
        share=share,
    )


def check(
    *,
    max_attacked: int,
    goal: Goal | str | None = None,
    lie_volt: float = math.nan,
    attack: Attack | str = Attack.PERSISTENT,
    unknown: Sequence[str] | None = None,
    busbar_known: bool = True,
    curves: CurvePositions | str | None = None,
    share: float = SHARE,
) -> None:
    """Check the arguments of `protect`: contradictions, and arguments without effect for the goal.

    Raises ValueError with all problems.
    """
    problems = [
        *no_choice("goal", Goal, *([] if goal is None else [goal])),
        *no_choice("attack", Attack, attack),
        *no_choice("curves", CurvePositions, *([] if curves is None else [curves])),
    ]
    bounded = not math.isnan(lie_volt)
    hiding = goal in (Goal.IDENTIFY, Goal.NOTICE)
    in_volts = goal in (Goal.BOUND, Goal.CONTAIN) or (goal is None and bounded)
    checks = (
        (max_attacked < 1, "not-positive", f"max_attacked is {max_attacked}; it must be at least 1"),
        (
            not 0.0 < lie_volt < math.inf and (bounded or goal == Goal.BOUND),
            "not-positive",
            f"lie_volt is {lie_volt}; a bound of attacks must be a positive number of volts",
        ),
        (not 0.0 <= share < math.inf, "negative", f"share is {share}; it must be finite and not negative"),
        (in_volts and not busbar_known, "inconsistent", "a bound of attacks requires a known busbar voltage"),
        (bounded and hiding, "inconsistent", f"lie_volt goes with goals in volts, not with {goal}"),
        (share != SHARE and hiding, "inconsistent", f"share goes with goals in volts, not with {goal}"),
        (
            in_volts and attack == Attack.ANY,
            "inconsistent",
            "attack goes with goals identify and notice, not with bounds of attacks",
        ),
        (
            goal == Goal.BOUND and bool(unknown),
            "inconsistent",
            "unknown powers do not go with bound, which assumes true powers",
        ),
    )
    raise_if_any([*problems, *(Problem(code, text) for wrong, code, text in checks if wrong)])


def _unmet(liars: Sequence[str]) -> str:
    """Attack that succeeds in spite of all protection, as a sentence."""
    if len(liars) == 1:
        return f"{liars[0]} alone succeeds whatever else is protected, and it cannot be"
    return f"{', '.join(liars)} succeed together whatever else is protected, and none of them can be"


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """Question of a protection: the attacks that succeed in spite of it, and its value. See `Protect`."""

    attacker: Attacker
    measure: Callable[[Bools], float]
    before: float
    lie_volt: float = math.nan
    alone: float = math.nan


def _nobody_hides(given: Patterns) -> bool:
    try:
        return math.isinf(fewest_meters(given).count)
    except DesignInfeasible:  # the search was stopped
        return False


def _hidden(given: Patterns, max_attacked: int, goal: Goal) -> _Asked:
    """Question of hidden patterns: the meters that imitate one, and their fewest number."""

    def fewest(protected: Bools) -> float:
        return fewest_meters(given, honest=protected).count

    liars = 2 * max_attacked if goal is Goal.IDENTIFY else max_attacked
    return _Asked(hides(given, liars), fewest, fewest_meters(given).count)


def _in_volts(  # question and its options
    site: Site,
    goal: Goal,
    max_attacked: int,
    lie_volt: float,
    *,
    unknown: Sequence[str] | None,
    share: float,
    curves: CurvePositions,
) -> _Asked:
    """Question in volts: attacks beyond the bound, and the largest one, V, in volts of the busbar's level."""
    count, no_meters = site.meters.size, np.zeros(site.meters.size, dtype=np.bool_)
    # Base of a customer in volts at the busbar's level, behind taps and transformers.
    base = (site.customer_volt / site.customer_nominal)[site.meters] * site.tables.meta.voltage_volt
    told = false_powers(site, unknown=unknown, share=share, curves=curves)
    given: ErrorBox | PowerErrorModel = (
        told if goal is Goal.CONTAIN else box(site, share=share, curves=curves)
    )

    def largest(protected: Bools) -> float:
        sizes = [largest_of(given, j, max_attacked, honest=protected).bound for j in range(count)]
        return float(volts_of_lie(base, np.array(sizes)).max())

    sizes = np.array([largest_lie(told.told(no_meters), j, 1).bound for j in range(count)])
    alone, before = float(volts_of_lie(base, sizes).max()), largest(no_meters)
    if math.isnan(lie_volt):
        lie_volt = math.ceil(50.0 * (alone + before)) / 100.0
    return _Asked(lies_beyond(given, max_attacked, squared(base, lie_volt)), largest, before, lie_volt, alone)


def _kept(attacker: Attacker, journal: Journal) -> Attacker:
    """Look up attacks in the journal first."""

    def attack(protected: Bools) -> Ints | None:
        def work() -> list[int] | None:
            liars = attacker(protected)
            return None if liars is None else liars.tolist()

        key = " ".join(map(str, np.flatnonzero(protected)))
        known = journal.get(key, work)
        return None if known is None else np.array(known, dtype=np.intp)

    return attack


def _meters(site: Site, chosen: Ints, attacks: Sequence[Ints]) -> pd.DataFrame:
    customer = site.meters[chosen]
    return pd.DataFrame(
        {
            "meter": [site.meter_ids[j] for j in chosen],
            "customer": [site.feeder.customers[k] for k in customer],
            "bus": [site.feeder.buses[k] for k in site.feeder.bus[customer]],
            "attacks": [sum(int(j in attack) for attack in attacks) for j in chosen],
        }
    )

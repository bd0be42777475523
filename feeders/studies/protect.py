"""Which meters to protect: the fewest such that liars are identified, are noticed, or can only lie a little.

References
----------
docs/theory-studies.md, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from feeders.studies.journal import Journal, Where
from feeders.studies.operating import SHARE, box, false_powers, squared, volts_of_lie
from feeders.studies.unobservable import Attack, Curves, knowledge, meter_mask, see_names
from gridsec.arrays import Bools, Ints
from gridsec.errors import DesignInfeasible, Problem, choice, no_choice, refuse
from gridsec.planning.protection import Attacker, Unprotectable, fewest_protected, hides, lies_beyond
from gridsec.planning.redundancy import Patterns, fewest_meters
from gridsec.planning.stealthy_attacks import Box, FalsePowers, largest_lie, largest_of

if TYPE_CHECKING:
    from feeders.model.site import Site

__all__ = ["Goal", "Protect", "check", "protect"]


class Goal(StrEnum):
    """What protection is for."""

    IDENTIFY = "identify"
    NOTICE = "notice"
    BOUND = "bound"
    CONTAIN = "contain"

    @property
    def in_volts(self) -> bool:
        """Whether it is about sizes of lies, and not about whether they can be seen at all."""
        return self in {Goal.BOUND, Goal.CONTAIN}


@dataclass(frozen=True, slots=True, eq=False)
class Protect:
    """What `protect` found.

    Attributes
    ----------
    feeder, digest
        The feeder's name, and its content.
    goal, max_attacked, attack, lie_volt
        What was asked, or chosen where nothing was: M, which attacks count, and the bound of lies (NaN where
        the goal is none).
    alone
        Where lies are bounded: the largest that one meter hides by itself, with its powers true, V. No
        protection of others lowers it.
    before, after
        Without and with protection: the fewest liars that stay invisible, or the largest hidden lie, V; it
        too as the busbar's level has it.
    least
        No fewer meters suffice. Equal to the number of meters where they are proven the fewest.
    meters
        One row for each meter to protect: `meter`, `customer`, `bus`, `attacks` (in how many of the attacks
        below it takes part).
    attacks
        Attacks that rule out anything cheaper: `liars`.
    share
        Share of its peak that every load draws.
    """

    feeder: str
    digest: str
    goal: Goal
    max_attacked: int
    attack: Attack
    lie_volt: float
    alone: float
    before: float
    after: float
    least: int
    meters: pd.DataFrame
    attacks: pd.DataFrame
    share: float = SHARE

    @property
    def gap(self) -> int:
        """How many more than necessary there can be; 0: these are the fewest."""
        return len(self.meters) - self.least

    @property
    def no_answer(self) -> bool:
        """Whether the goal asks nothing of this feeder, which is no safety.

        Liars who are to be identified or noticed hide behind powers that nobody knows. Where all are known,
        no lie fits exactly, however small; how large lies are that fit within honest errors is not asked.
        """
        return not self.goal.in_volts and math.isinf(self.before)

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name; `summary` is one row: what was asked, how many, what that does."""
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
    curves: Curves | None = None,
    share: float = SHARE,
    never: Sequence[str] = (),
    exact: bool = True,
    journal: Where = None,
    progress: Callable[[int, int], None] | None = None,
) -> Protect:
    """Find the fewest meters to protect; a protected meter cannot lie.

    Parameters
    ----------
    site
        The feeder.
    max_attacked
        M: how many of the other meters lie at most.
    goal
        `IDENTIFY`: the liars follow from the readings. `NOTICE`: some lie is noticed. Both as in
        `feeders.studies.redundancy`. `BOUND`: no lie larger than `lie_volt` fits to an honest feeder while
        all report their powers truly. `CONTAIN`: nor does one while liars report any powers that their
        customers could have. By default `IDENTIFY` if liars can stay invisible at all and there is no bound,
        otherwise `CONTAIN`.
    lie_volt
        Bound of the lie, V, at nominal voltage; behind a transformer to another level, where volts do not
        compare with the busbar's, the same part of the nominal voltage there. For `CONTAIN` by default such
        that half of what company and false powers add to the lie of a meter is gone.
    attack, unknown, busbar_known
        For `IDENTIFY` and `NOTICE`: which attacks count, and what nobody knows. `CONTAIN` takes the unknown
        powers too; `BOUND` has none. Both, and every `lie_volt`, need the busbar's voltage.
    curves
        Where inverters work. By default on the steepest part for the first two, in the deadband in volts.
    share
        For `BOUND` and `CONTAIN`: share of its peak that every load draws.
    never
        Meters that cannot be protected.
    exact
        Prove that there are no fewer; otherwise greedy, with `gap`.
    journal
        File in which attacks are kept; an interrupted study goes on from it.
    progress
        Told how many attacks are known, and how many meters are protected against them.

    Raises
    ------
    DesignInfeasible
        If no protection of the other meters is enough.
    ValueError
        If there is no such customer or meter, or as `check`.
    OtherStudy
        If the journal is another study's.
    InUse
        If another process is writing it.
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
            lie_volt > 0.0 or _nobody_hides(know(curves=curves or Curves.STEEPEST).found[attack])
        )
        goal = Goal.CONTAIN if bounded else Goal.IDENTIFY
    usual = Curves.DEADBAND if goal.in_volts else Curves.STEEPEST
    where = usual if curves is None else choice("curves", Curves, curves)
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
    curves: Curves | str | None = None,
    share: float = SHARE,
) -> None:
    """Refuse a question that has no answer, or says things that the goal would leave out of account.

    Parameters
    ----------
    max_attacked, goal, lie_volt, attack, unknown, busbar_known, curves, share
        As in `protect`.

    Raises
    ------
    ValueError
        With everything that is wrong.
    """
    problems = [
        *no_choice("goal", Goal, *([] if goal is None else [goal])),
        *no_choice("attack", Attack, attack),
        *no_choice("curves", Curves, *([] if curves is None else [curves])),
    ]
    bounded = not math.isnan(lie_volt)
    hiding = goal in (Goal.IDENTIFY, Goal.NOTICE)
    in_volts = goal in (Goal.BOUND, Goal.CONTAIN) or (goal is None and bounded)
    for problem, wrong in (
        (Problem("not-positive", f"max_attacked is {max_attacked}; it must be at least 1"), max_attacked < 1),
        (
            Problem(
                "not-positive", f"lie_volt is {lie_volt}; to bound lies it must be a positive number of volts"
            ),
            not 0.0 < lie_volt < math.inf and (bounded or goal == Goal.BOUND),
        ),
        (
            Problem("negative", f"share is {share}; it must be finite and not negative"),
            not 0.0 <= share < math.inf,
        ),
        (
            Problem("inconsistent", "to bound lies the busbar's voltage must be known"),
            in_volts and not busbar_known,
        ),
        (Problem("inconsistent", f"lie_volt goes with goals in volts, not with {goal}"), bounded and hiding),
        (
            Problem("inconsistent", f"share goes with goals in volts, not with {goal}"),
            share != SHARE and hiding,
        ),
        (
            Problem("inconsistent", "attack goes with goals identify and notice, not with bounds of lies"),
            in_volts and attack == Attack.ANY,
        ),
        (
            Problem("inconsistent", "unknown powers do not go with bound, for which all are reported truly"),
            goal == Goal.BOUND and unknown,
        ),
    ):
        if wrong:
            problems.append(problem)
    refuse(problems)


def _unmet(liars: Sequence[str]) -> str:
    """Who succeeds in spite of all protection."""
    if len(liars) == 1:
        return f"{liars[0]} alone succeeds whatever else is protected, and it cannot be"
    return f"{', '.join(liars)} succeed together whatever else is protected, and none of them can be"


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """What is asked of a protection: who succeeds in spite of it, and what it is worth. See `Protect`."""

    attacker: Attacker
    measure: Callable[[Bools], float]
    before: float
    lie_volt: float = math.nan
    alone: float = math.nan


def _nobody_hides(given: Patterns) -> bool:
    try:
        return math.isinf(fewest_meters(given).count)
    except DesignInfeasible:  # the search gave up
        return False


def _hidden(given: Patterns, max_attacked: int, goal: Goal) -> _Asked:
    """Who imitates a pattern, and the fewest who do."""

    def fewest(protected: Bools) -> float:
        return fewest_meters(given, honest=protected).count

    liars = 2 * max_attacked if goal is Goal.IDENTIFY else max_attacked
    return _Asked(hides(given, liars), fewest, fewest_meters(given).count)


def _in_volts(  # what is asked, and of what
    site: Site,
    goal: Goal,
    max_attacked: int,
    lie_volt: float,
    *,
    unknown: Sequence[str] | None,
    share: float,
    curves: Curves,
) -> _Asked:
    """Whose lie is too large, and the largest there is, V; every level counted in volts of the busbar's."""
    count, nobody = site.meters.size, np.zeros(site.meters.size, dtype=np.bool_)
    # Around a tap or a transformer, 1 pu of a customer is so many volts where the busbar's level is nominal.
    base = (site.customer_volt / site.customer_nominal)[site.meters] * site.tables.meta.voltage_volt
    told = false_powers(site, unknown=unknown, share=share, curves=curves)
    given: Box | FalsePowers = told if goal is Goal.CONTAIN else box(site, share=share, curves=curves)

    def largest(protected: Bools) -> float:
        sizes = [largest_of(given, j, max_attacked, honest=protected).bound for j in range(count)]
        return float(volts_of_lie(base, np.array(sizes)).max())

    sizes = np.array([largest_lie(told.told(nobody), j, 1).bound for j in range(count)])
    alone, before = float(volts_of_lie(base, sizes).max()), largest(nobody)
    if math.isnan(lie_volt):
        lie_volt = math.ceil(50.0 * (alone + before)) / 100.0
    return _Asked(lies_beyond(given, max_attacked, squared(base, lie_volt)), largest, before, lie_volt, alone)


def _kept(attacker: Attacker, journal: Journal) -> Attacker:
    """Ask the journal first."""

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

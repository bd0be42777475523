"""What a campaign of simulated attacks consists of: scenes, and the cases that are played in each of them.

A scene is a moment of the profiles with errors of loads and meters of its own. All its cases begin alike, and
differ from their onsets on. Everything random follows from the plan's seed and the numbers of scene and case.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from feeders.format.columns import ESTIMATORS
from feeders.model.profiles import Season, library
from feeders.model.site import from_tables
from feeders.simulation.attacks import Trick
from feeders.simulation.demand import Variation
from feeders.simulation.trial import LoadError, Meters, Trial
from feeders.util import own_numbers, plain
from gridsec.arrays import Ints
from gridsec.errors import InputInvalid, Problem, choice, each_choice, refuse

if TYPE_CHECKING:
    from feeders.model.site import Site

__all__ = ["CLEAN", "KINDS", "LEARN_STEP_S", "Case", "Design", "Kind", "Moment", "Place", "Plan", "Promise"]

CLEAN: Final = "clean"
"""Name of the kind of case in which nobody lies."""


LEARN_STEP_S: Final = 10.0
"""Interval of the readings from which meters' fixed errors are learned, s, unless readings are rarer."""


class Place(StrEnum):
    """Which meters lie."""

    RANDOM = "random"
    """Any."""
    STREET = "street"
    """A random one and those that are electrically nearest to it."""
    SENSITIVE = "sensitive"
    """Those that loads move most: at the far ends."""
    COLLUDING = "colluding"
    """Those that a load at a random customer moves most, all in the same direction."""


class Design(StrEnum):
    """How cases are chosen from all combinations of kind, size, number of liars and place."""

    FACTORIAL = "factorial"
    """All combinations in random order, then all of them again."""
    RANDOM = "random"
    """Any, independently."""


class Promise(StrEnum):
    """What `detectable` says of lies of a size."""

    HIDDEN = "hidden"
    """Nobody is named because of it."""
    NAMED = "named"
    """Each liar is named."""


@dataclass(frozen=True, slots=True)
class Kind:
    """One way to lie.

    Attributes
    ----------
    name
        In the tables.
    trick
        What liars do.
    sizes
        As `feeders.simulation.attacks.Lie.size`; with `volts`, as factors on these.
    volts
        A bias of each meter, V; empty: sizes are the same for all meters.
    together
        Biases of all meters, V, of which one tuple is drawn, and a sign; who lies, it says itself.
    liars
        How many lie; empty: as the plan says.
    promise
        What is to become of such lies, if anything is promised.

    Raises
    ------
    ValueError
        If there is no such trick or no size, the name is taken, or volts are given for no bias.
    """

    name: str
    trick: Trick
    sizes: tuple[float, ...]
    volts: tuple[float, ...] = ()
    together: tuple[tuple[float, ...], ...] = ()
    liars: tuple[int, ...] = ()
    promise: Promise | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "trick", choice("trick", Trick, self.trick))
        if not self.sizes or self.name == CLEAN:
            raise InputInvalid(
                [Problem("missing", f"kind {self.name!r} needs a size, and a name other than {CLEAN!r}")]
            )
        if (self.volts or self.together) and self.trick is not Trick.BIAS:
            raise InputInvalid(
                [
                    Problem(
                        "inconsistent",
                        f"kind {self.name!r}: sizes in volts of each meter are for {Trick.BIAS}",
                    )
                ]
            )

    def every(self, step_s: float) -> Kind:
        """The same where readings come every so many seconds: ages and rates are counted in readings.

        Parameters
        ----------
        step_s
            Interval of the readings, s.
        """
        factor = {Trick.REPLAY: step_s, Trick.CLOCK_SHIFT: step_s, Trick.DRIFT: 1.0 / step_s}
        return replace(self, sizes=tuple(size * factor.get(self.trick, 1.0) for size in self.sizes))


KINDS: Final = (
    Kind("bias", Trick.BIAS, (1.0, 2.0, 3.0, 5.0)),
    Kind("scaling", Trick.SCALING, (3.0,)),
    Kind("drift", Trick.DRIFT, (1.0, 3.0)),
    Kind("stuck", Trick.STUCK, (0.0,)),
    Kind("replay", Trick.REPLAY, (60.0,)),
    Kind("coordinated", Trick.COORDINATED, (1.0, 3.0)),
)
"""What a campaign consists of where nothing else is said."""


@dataclass(frozen=True, slots=True)
class Moment:
    """When a scene is, and what its random numbers are.

    Attributes
    ----------
    season, profile_s
        Which profiles, and the position within them, s.
    seed
        Of loads, busbar and meters.
    """

    season: Season
    profile_s: float
    seed: int


@dataclass(frozen=True, slots=True)
class Case:
    """One scenario.

    Attributes
    ----------
    number
        From 0.
    kind, size, liars, place
        The combination; kind CLEAN: nobody lies.
    onset_s
        When lies begin, s after the beginning of the scene.
    seed
        Chooses the liars and their signs.
    """

    number: int
    kind: str
    size: float
    liars: int
    place: str
    onset_s: float
    seed: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Plan:
    """A campaign. The defaults are 160 scenarios of ten minutes; `Plan.of` takes what it can from the files.

    Attributes
    ----------
    scenes, together
        How many scenes, and how many scenarios in each, of which the first is without a lie.
    seed
        Chooses everything random.
    kinds, liars, places, design
        What is combined, and how.
    duration_s, step_s
        Length of a scenario and interval of its frames, s.
    onset_s
        Between which times lies begin, s.
    lying_s
        How long they last at most, s.
    settling_s
        How long after an onset errors of the voltage do not count yet, s.
    seasons
        Whose profiles are drawn from.
    estimator
        Name of an estimator family.
    alarms_per_year
        False alarms that the estimator may raise in a year; every case is watched once for each.
    learn_s
        How long the estimator has learned its meters' fixed errors before each scene, from honest readings
        every `learn_step_s`; 0: not at all.
    settings
        Other settings of the feeder's `[monitor]`, by name.
    meters, load_error, variation, report_q
        As in `feeders.simulation.trial.Trial`; no `load_error`: as the feeder's files say.

    Raises
    ------
    ValueError
        If there is no such place, season, design or kind of meters, or numbers cannot be meant; these are
        named at once.
    """

    scenes: int = 10
    together: int = 16
    seed: int = 0
    kinds: tuple[Kind, ...] = KINDS
    liars: tuple[int, ...] = (1, 3)
    places: tuple[Place, ...] = tuple(Place)
    design: Design = Design.FACTORIAL
    duration_s: float = 600.0
    step_s: float = 1.0
    onset_s: tuple[float, float] = (60.0, 180.0)
    lying_s: float = 300.0
    settling_s: float = 10.0
    seasons: tuple[Season, ...] = tuple(Season)
    estimator: str = "sequential"
    alarms_per_year: tuple[float, ...] = (1.0,)
    learn_s: float = 0.0
    settings: tuple[tuple[str, float], ...] = ()
    meters: Meters = Meters.SITE
    load_error: LoadError | None = field(default_factory=lambda: LoadError(0.1, 0.05))
    variation: Variation = field(default_factory=Variation)
    report_q: bool = False

    def __post_init__(self) -> None:
        own_numbers(self)
        set_ = partial(object.__setattr__, self)
        set_("places", each_choice("place", Place, self.places))
        set_("seasons", each_choice("season", Season, self.seasons))
        set_("design", choice("design", Design, self.design))
        set_("meters", choice("meters", Meters, self.meters))
        times = (self.duration_s, self.step_s, *self.onset_s, self.lying_s, self.settling_s, self.learn_s)
        checks = (
            (
                Problem("not-positive", "a campaign needs scenes, and a scene scenarios"),
                min(self.scenes, self.together) < 1,
            ),
            (Problem("negative", "the seed must not be negative"), self.seed < 0),
            (
                Problem("missing", "there are no kinds of lies, numbers of liars or places"),
                not self._combined and self.together > 1,
            ),
            (Problem("not-positive", "numbers of liars must be positive"), min((*self.liars, 1)) < 1),
            (Problem("missing", "there are no seasons"), not self.seasons),
            (
                Problem("duplicate", "kinds of lies need different names"),
                len({k.name for k in self.kinds}) < len(self.kinds),
            ),
            (
                Problem("not-positive", "a false-alarm rate is missing, or not positive and finite"),
                not self.alarms_per_year or not all(0.0 < rate < math.inf for rate in self.alarms_per_year),
            ),
            (Problem("not-finite", "times must be finite numbers"), not all(map(math.isfinite, times))),
            (
                Problem("not-positive", "step_s and lying_s must be positive"),
                min(self.step_s, self.lying_s) <= 0.0,
            ),
            (
                Problem("out-of-range", f"learn_s must be 0 or from {self.learn_step_s:g} s on"),
                0.0 != self.learn_s < self.learn_step_s,
            ),
            (
                Problem("out-of-range", "lies must begin after the first frame and before the last"),
                not self.step_s <= self.onset_s[0] <= self.onset_s[1] <= self.duration_s - self.step_s,
            ),
            (
                Problem(
                    "unknown-name",
                    f"estimator {self.estimator!r} does not exist; there are {', '.join(ESTIMATORS)}",
                ),
                self.estimator not in ESTIMATORS,
            ),
        )
        problems = [problem for problem, wrong in checks if wrong]
        refuse(problems)

    @classmethod
    def of(cls, site: Site, **chosen: Any) -> Plan:
        """A campaign as the feeder's files say, but for what is chosen.

        Estimator, interval of readings and false alarms are those of `[monitor]`, and powers are known as in
        service. Times are counted in readings: where these come every second, those of `Plan()`.

        Parameters
        ----------
        site
            The feeder.
        chosen
            Attributes by name. With a `duration_s`, lies begin after 0.1 to 0.3 of it and last for half.
        """
        monitor, usual = site.tables.meta.monitor, cls()
        step_s = float(chosen.get("step_s", monitor.tick_s))
        duration_s = float(chosen.get("duration_s", usual.duration_s * step_s))
        files: dict[str, Any] = {
            "step_s": step_s,
            "duration_s": duration_s,
            "onset_s": (0.1 * duration_s, 0.3 * duration_s),
            "lying_s": 0.5 * duration_s,
            "settling_s": usual.settling_s * step_s,
            "kinds": tuple(kind.every(step_s) for kind in usual.kinds),
            "estimator": monitor.estimator,
            "alarms_per_year": (monitor.alarms_per_year,),
            "load_error": None,
        }
        return cls(**(files | chosen))

    @property
    def scenarios(self) -> int:
        """How many scenarios there are."""
        return self.scenes * self.together

    @property
    def learn_step_s(self) -> float:
        """Interval of the readings from which fixed errors are learned, s."""
        return max(LEARN_STEP_S, self.step_s)

    @property
    def _combined(self) -> list[tuple[Kind, float, int, Place]]:
        """Every combination of kind, size, number of liars and place, which for some kinds is given."""
        return [
            (kind, size, count, place)
            for kind in self.kinds
            for size, count, place in product(
                kind.sizes, kind.liars or self.liars, _places(kind, self.places)
            )
        ]

    def moment(self, scene: int) -> Moment:
        """When a scene is.

        Parameters
        ----------
        scene
            Its number.
        """
        random = np.random.default_rng([self.seed, _MOMENT, scene])
        season = self.seasons[int(random.integers(len(self.seasons)))]
        t = library(season).t_s
        return Moment(season, float(random.uniform(0.0, t[-1])), int(random.integers(2**31)))

    def cases(self, scene: int) -> list[Case]:
        """What is played in a scene; first that nobody lies.

        Parameters
        ----------
        scene
            Its number.
        """
        first = scene * self.together
        found = [Case(first, CLEAN, 0.0, 0, "", self.duration_s, (self.seed, first))]
        combined = self._combined
        low, high = (round(t / self.step_s) for t in self.onset_s)
        for number in range(first + 1, first + self.together):
            random = np.random.default_rng([self.seed, _CASE, number])
            attack = number - scene - 1  # of the attacks only
            kind, size, count, place = combined[self._chosen(attack, len(combined), random)]
            onset_s = self.step_s * int(random.integers(low, high, endpoint=True))
            seed = (self.seed, _LIARS, number)
            found.append(Case(number, kind.name, size, count, place, onset_s, seed))
        return found

    def _chosen(self, attack: int, count: int, random: np.random.Generator) -> int:
        if self.design is Design.RANDOM:
            return int(random.integers(count))
        turn, place = divmod(attack, count)
        order: Ints = np.random.default_rng([self.seed, _ORDER, turn]).permutation(count)
        return int(order[place])

    def kind(self, name: str) -> Kind:
        """The kind of this name."""
        return next(kind for kind in self.kinds if kind.name == name)

    def trial(self, site: Site, moment: Moment) -> Trial:
        """A scene in which nobody lies, but for its season.

        Parameters
        ----------
        site
            The feeder.
        moment
            When it is.
        """
        return Trial(
            site,
            seed=moment.seed,
            duration_s=self.duration_s,
            step_s=self.step_s,
            load_error=self.load_error,
            meters=self.meters,
            profile_s=moment.profile_s,
            variation=self.variation,
            report_q=self.report_q,
        )

    def watched(self, stated: Site, alarms_per_year: float) -> Site:
        """The feeder as the estimator is designed for it.

        Parameters
        ----------
        stated
            The feeder whose files say what a scene does.
        alarms_per_year
            One of the plan's.

        Raises
        ------
        ValueError
            If there is no such setting, or it is a whole number and not given one.
        FeederInvalid
            If a setting has a value that it cannot have.
        """
        meta = stated.tables.meta
        refuse(wrong_settings(stated, self.settings))
        known = asdict(meta.monitor)
        # A whole number stays one, whatever the setting was written as.
        chosen = {name: type(known[name])(value) for name, value in self.settings}
        if self.learn_s:
            chosen["commission_s"] = self.learn_s
        monitor = replace(meta.monitor, estimator=self.estimator, alarms_per_year=alarms_per_year, **chosen)
        return from_tables(replace(stated.tables, meta=replace(meta, monitor=monitor)))

    @property
    def subject(self) -> dict[str, Any]:
        """The plan as JSON has it."""
        told: dict[str, Any] = json.loads(json.dumps(plain(asdict(self))))
        return told


def wrong_settings(site: Site, settings: Iterable[tuple[str, float]]) -> list[Problem]:
    """Return what is wrong with settings of `[monitor]`, one sentence each.

    Parameters
    ----------
    site, settings
        The feeder, and settings by name.
    """
    known = asdict(site.tables.meta.monitor)
    problems = []
    for name, value in settings:
        if name not in known or name in ("estimator", "tick_s", "alarms_per_year"):
            problems.append(Problem("unknown-name", f"{name!r} is no setting of an estimator"))
        elif isinstance(known[name], int) and not float(value).is_integer():
            problems.append(Problem("not-integer", f"{name} is {value}; expected a whole number"))
    return problems


# Streams of random numbers.
_MOMENT, _CASE, _ORDER, _LIARS = range(4)

# The trace of a load that is not there says itself who lies, and inverters have no such places.
_PLACED = (Trick.COORDINATED, Trick.COORDINATED_POWER, Trick.INVERTER)


def _places(kind: Kind, places: Iterable[Place]) -> tuple[Place, ...]:
    if kind.trick is Trick.INVERTER or kind.together:
        return (Place.RANDOM,)
    return (Place.COLLUDING,) if kind.trick in _PLACED else tuple(places)

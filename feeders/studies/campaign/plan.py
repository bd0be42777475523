"""Plan of a campaign of simulated attacks: scenes, and their scenarios.

A scene is a moment of the profiles with errors of loads and meters of its own. All its scenarios begin equal,
and differ from their onsets on. Everything random follows from the plan's seed and the numbers of scene and
scenario.
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
from feeders.model.site import from_tables
from feeders.profiles import Season, library
from feeders.simulation.attacks import LOAD_TRACES, AttackKind
from feeders.simulation.demand import Variation
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors
from feeders.util import own_numbers, plain
from gridsec.arrays import Ints
from gridsec.errors import InputInvalid, Problem, choice, each_choice, raise_if_any

if TYPE_CHECKING:
    from feeders.model.site import Site

__all__ = [
    "CLEAN",
    "KINDS",
    "LEARN_STEP_S",
    "AttackClass",
    "CampaignCase",
    "CampaignPlan",
    "Design",
    "Place",
    "Promise",
    "SceneTime",
]

CLEAN: Final = "clean"
"""Kind of the scenario without an attack."""


LEARN_STEP_S: Final = 10.0
"""Interval of the readings for learning of fixed errors, s, unless readings are rarer."""


class Place(StrEnum):
    """Choice of the manipulated meters."""

    RANDOM = "random"
    """Any meters."""
    STREET = "street"
    """A random meter and those electrically nearest to it."""
    SENSITIVE = "sensitive"
    """Meters with the largest sensitivity to loads: at the far ends."""
    COLLUDING = "colluding"
    """Meters with the largest sensitivity to a load at a random customer, all in the same direction."""


class Design(StrEnum):
    """Choice of scenarios from all combinations of kind, size, number of manipulated devices and place."""

    FACTORIAL = "factorial"
    """All combinations in random order, then all of them again."""
    RANDOM = "random"
    """Independent random combinations."""


class Promise(StrEnum):
    """Guarantees of `detectable` for attacks of a size."""

    HIDDEN = "hidden"
    """No device is named because of the attack."""
    NAMED = "named"
    """Each manipulated meter is named."""


@dataclass(frozen=True, slots=True)
class AttackClass:
    """Kind of attack.

    Attributes
    ----------
    name
        Name in the tables.
    trick
        Manipulation of the devices.
    sizes
        As `feeders.simulation.attacks.AttackSpec.size`; with `volts`, factors on these.
    volts
        Bias of each meter, V; empty: the same size for all meters.
    together
        Tuples with a bias of each meter, V. One tuple and a sign are drawn; its nonzero entries are the
        manipulated meters.
    liars
        Numbers of manipulated devices; empty: those of the plan.
    promise
        Guaranteed outcome of such attacks, or None.

    Raises
    ------
    ValueError
        For an unknown manipulation, no size, a reserved name, or volts for other than a bias.
    """

    name: str
    trick: AttackKind
    sizes: tuple[float, ...]
    volts: tuple[float, ...] = ()
    together: tuple[tuple[float, ...], ...] = ()
    liars: tuple[int, ...] = ()
    promise: Promise | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "trick", choice("trick", AttackKind, self.trick))
        if not self.sizes or self.name == CLEAN:
            raise InputInvalid(
                [Problem("missing", f"kind {self.name!r} needs a size, and a name other than {CLEAN!r}")]
            )
        if (self.volts or self.together) and self.trick is not AttackKind.BIAS:
            raise InputInvalid(
                [
                    Problem(
                        "inconsistent",
                        f"kind {self.name!r}: sizes in volts of each meter are for {AttackKind.BIAS}",
                    )
                ]
            )

    def every(self, step_s: float) -> AttackClass:
        """Kind for another interval of the readings: ages and rates are counted in readings.

        Parameters
        ----------
        step_s
            Interval of the readings, s.
        """
        factor = {AttackKind.REPLAY: step_s, AttackKind.CLOCK_SHIFT: step_s, AttackKind.DRIFT: 1.0 / step_s}
        return replace(self, sizes=tuple(size * factor.get(self.trick, 1.0) for size in self.sizes))


KINDS: Final = (
    AttackClass("bias", AttackKind.BIAS, (1.0, 2.0, 3.0, 5.0)),
    AttackClass("scaling", AttackKind.SCALING, (3.0,)),
    AttackClass("drift", AttackKind.DRIFT, (1.0, 3.0)),
    AttackClass("stuck", AttackKind.STUCK, (0.0,)),
    AttackClass("replay", AttackKind.REPLAY, (60.0,)),
    AttackClass("coordinated", AttackKind.COORDINATED, (1.0, 3.0)),
)
"""Default kinds of a campaign."""


@dataclass(frozen=True, slots=True)
class SceneTime:
    """Time and random numbers of a scene.

    Attributes
    ----------
    season, profile_s
        Season of the profiles, and position within them, s.
    seed
        Seed of loads, busbar and meters.
    """

    season: Season
    profile_s: float
    seed: int


@dataclass(frozen=True, slots=True)
class CampaignCase:
    """One scenario.

    Attributes
    ----------
    number
        Number, from 0.
    kind, size, liars, place
        The combination; kind CLEAN: no attack.
    onset_s
        Onset of the attack, s after the begin of the scene.
    seed
        Seed of the manipulated devices and their signs.
    """

    number: int
    kind: str
    size: float
    liars: int
    place: str
    onset_s: float
    seed: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """Campaign. The defaults are 160 scenarios of ten minutes; `of` uses the settings of the files.

    Attributes
    ----------
    scenes, together
        Number of scenes, and number of scenarios in each; the first scenario has no attack.
    seed
        Seed of all random numbers.
    kinds, liars, places, design
        Kinds, numbers of manipulated devices and places to combine, and the choice of combinations.
    duration_s, step_s
        Length of a scenario and interval of its frames, s.
    onset_s
        Earliest and latest onset of attacks, s.
    lying_s
        Largest duration of attacks, s.
    settling_s
        Settling time after an onset, without errors of the voltage, s.
    seasons
        Seasons of the profiles.
    estimator
        Name of an estimator.
    alarms_per_year
        False-alarm rates of the estimator, 1/year; every scenario is monitored once for each.
    learn_s
        Learning time of the meters' fixed errors before each scene, s, from honest readings every
        `learn_step_s`; 0: no learning.
    settings
        Other settings of the feeder's `[monitor]`, by name.
    meters, load_error, variation, report_q
        As in `feeders.simulation.trial.Trial`; without `load_error`, the errors of the feeder's files.

    Raises
    ------
    ValueError
        For an unknown place, season, design or kind of meters, or invalid numbers, all of which are reported.
    """

    scenes: int = 10
    together: int = 16
    seed: int = 0
    kinds: tuple[AttackClass, ...] = KINDS
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
    meters: TrialMeterErrors = TrialMeterErrors.SITE
    load_error: LoadError | None = field(default_factory=lambda: LoadError(0.1, 0.05))
    variation: Variation = field(default_factory=Variation)
    report_q: bool = False

    def __post_init__(self) -> None:
        own_numbers(self)
        set_ = partial(object.__setattr__, self)
        set_("places", each_choice("place", Place, self.places))
        set_("seasons", each_choice("season", Season, self.seasons))
        set_("design", choice("design", Design, self.design))
        set_("meters", choice("meters", TrialMeterErrors, self.meters))
        times = (self.duration_s, self.step_s, *self.onset_s, self.lying_s, self.settling_s, self.learn_s)
        checks = (
            (
                Problem("not-positive", "a campaign needs scenes, and a scene scenarios"),
                min(self.scenes, self.together) < 1,
            ),
            (Problem("negative", "the seed must not be negative"), self.seed < 0),
            (
                Problem("missing", "there are no kinds of attack, numbers of manipulated devices or places"),
                not self._combined and self.together > 1,
            ),
            (
                Problem("not-positive", "numbers of manipulated devices must be positive"),
                min((*self.liars, 1)) < 1,
            ),
            (Problem("missing", "there are no seasons"), not self.seasons),
            (
                Problem("duplicate", "kinds of attack need different names"),
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
                Problem("out-of-range", "attacks must begin after the first frame and before the last"),
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
        raise_if_any(problems)

    @classmethod
    def of(cls, site: Site, **chosen: Any) -> CampaignPlan:
        """Campaign with the settings of the feeder's files, except for the given attributes.

        Estimator, interval of readings and false alarms are those of `[monitor]`, and powers have the
        uncertainty of the service. Times are counted in readings: with one reading per second they are those
        of `CampaignPlan()`.

        Parameters
        ----------
        site
            The feeder.
        chosen
            Attributes by name. With a `duration_s`, attacks begin after 0.1 to 0.3 of it and last for half of
            it.
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
        """Number of scenarios."""
        return self.scenes * self.together

    @property
    def learn_step_s(self) -> float:
        """Interval of the readings for learning of fixed errors, s."""
        return max(LEARN_STEP_S, self.step_s)

    @property
    def _combined(self) -> list[tuple[AttackClass, float, int, Place]]:
        """Every combination of kind, size, number of devices and place; some kinds determine their places."""
        return [
            (kind, size, count, place)
            for kind in self.kinds
            for size, count, place in product(
                kind.sizes, kind.liars or self.liars, _places(kind, self.places)
            )
        ]

    def moment(self, scene: int) -> SceneTime:
        """Time of a scene.

        Parameters
        ----------
        scene
            Number of the scene.
        """
        random = np.random.default_rng([self.seed, _MOMENT, scene])
        season = self.seasons[int(random.integers(len(self.seasons)))]
        t = library(season).t_s
        return SceneTime(season, float(random.uniform(0.0, t[-1])), int(random.integers(2**31)))

    def cases(self, scene: int) -> list[CampaignCase]:
        """Scenarios of a scene, the first without an attack.

        Parameters
        ----------
        scene
            Number of the scene.
        """
        first = scene * self.together
        found = [CampaignCase(first, CLEAN, 0.0, 0, "", self.duration_s, (self.seed, first))]
        combined = self._combined
        low, high = (round(t / self.step_s) for t in self.onset_s)
        for number in range(first + 1, first + self.together):
            random = np.random.default_rng([self.seed, _CASE, number])
            attack = number - scene - 1  # number among the attacks
            kind, size, count, place = combined[self._chosen(attack, len(combined), random)]
            onset_s = self.step_s * int(random.integers(low, high, endpoint=True))
            seed = (self.seed, _LIARS, number)
            found.append(CampaignCase(number, kind.name, size, count, place, onset_s, seed))
        return found

    def _chosen(self, attack: int, count: int, random: np.random.Generator) -> int:
        if self.design is Design.RANDOM:
            return int(random.integers(count))
        turn, place = divmod(attack, count)
        order: Ints = np.random.default_rng([self.seed, _ORDER, turn]).permutation(count)
        return int(order[place])

    def kind(self, name: str) -> AttackClass:
        """Kind of this name."""
        return next(kind for kind in self.kinds if kind.name == name)

    def trial(self, site: Site, moment: SceneTime) -> Trial:
        """Scene without an attack, without its season.

        Parameters
        ----------
        site
            The feeder.
        moment
            Time of the scene.
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
        """Feeder with the settings of the estimator's design.

        Parameters
        ----------
        stated
            The feeder with the scene's errors of loads and meters.
        alarms_per_year
            One of the plan's rates.

        Raises
        ------
        ValueError
            For an unknown setting, or a fraction for an integer.
        FeederInvalid
            For a setting out of range.
        """
        meta = stated.tables.meta
        raise_if_any(wrong_settings(stated, self.settings))
        known = asdict(meta.monitor)
        # An integer setting stays one, in any spelling.
        chosen = {name: type(known[name])(value) for name, value in self.settings}
        if self.learn_s:
            chosen["commission_s"] = self.learn_s
        monitor = replace(meta.monitor, estimator=self.estimator, alarms_per_year=alarms_per_year, **chosen)
        return from_tables(replace(stated.tables, meta=replace(meta, monitor=monitor)))

    @property
    def subject(self) -> dict[str, Any]:
        """Plan in plain JSON types."""
        told: dict[str, Any] = json.loads(json.dumps(plain(asdict(self))))
        return told


def wrong_settings(site: Site, settings: Iterable[tuple[str, float]]) -> list[Problem]:
    """Problems of settings of `[monitor]`, one sentence each."""
    known = asdict(site.tables.meta.monitor)
    problems = []
    for name, value in settings:
        if name not in known or name in ("estimator", "tick_s", "alarms_per_year"):
            problems.append(Problem("unknown-name", f"{name!r} is not a setting of an estimator"))
        elif isinstance(known[name], int) and not float(value).is_integer():
            problems.append(Problem("not-integer", f"{name} is {value}; expected a whole number"))
    return problems


# Streams of random numbers.
_MOMENT, _CASE, _ORDER, _LIARS = range(4)

# The trace of a false load determines its meters, and inverters have no such places.
_PLACED = (*LOAD_TRACES, AttackKind.INVERTER)


def _places(kind: AttackClass, places: Iterable[Place]) -> tuple[Place, ...]:
    if kind.trick is AttackKind.INVERTER or kind.together:
        return (Place.RANDOM,)
    return (Place.COLLUDING,) if kind.trick in _PLACED else tuple(places)

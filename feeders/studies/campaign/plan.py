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
from typing import Any, Final

import numpy as np

from feeders.format.columns import ESTIMATORS
from feeders.model.site import Site, from_tables
from feeders.profiles import Season, library
from feeders.simulation.attacks import LOAD_TRACES, AttackKind
from feeders.simulation.demand import Variation
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors
from feeders.util import own_numbers, plain
from gridsec.arrays import Ints
from gridsec.errors import InputInvalid, Problem, choice, each_choice, raise_if_any

__all__ = ["CLEAN", "KINDS", "AttackClass", "CampaignCase", "CampaignPlan", "Design", "Place", "Promise"]

CLEAN: Final = "clean"  # kind of the scenario without an attack


LEARN_STEP_S: Final = 10.0  # interval of the readings for learning, unless readings are rarer


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

    Raises ValueError for an unknown manipulation, no size, a reserved name, or volts for other than a bias.
    """

    name: str
    trick: AttackKind
    # as `feeders.simulation.attacks.AttackSpec.size`; with `volts`, factors on these
    sizes: tuple[float, ...]
    volts: tuple[float, ...] = ()  # bias of each meter, V; empty: the same size for all meters
    # Tuples with a bias of each meter, V. One tuple and a sign are drawn; its nonzero entries are the
    # manipulated meters.
    together: tuple[tuple[float, ...], ...] = ()
    liars: tuple[int, ...] = ()  # numbers of manipulated devices; empty: those of the plan
    promise: Promise | None = None  # guaranteed outcome of such attacks, or None

    def __post_init__(self) -> None:
        object.__setattr__(self, "trick", choice("trick", AttackKind, self.trick))
        if not self.sizes or self.name == CLEAN:
            text = f"kind {self.name!r} needs a size, and a name other than {CLEAN!r}"
            raise InputInvalid([Problem("missing", text)])
        if (self.volts or self.together) and self.trick is not AttackKind.BIAS:
            text = f"kind {self.name!r}: sizes in volts of each meter are for {AttackKind.BIAS}"
            raise InputInvalid([Problem("inconsistent", text)])

    def every(self, step_s: float) -> AttackClass:
        """Kind for readings every `step_s`: ages and rates are counted in readings."""
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
    """Time and random numbers of a scene."""

    season: Season
    profile_s: float  # position within the season's profiles
    seed: int  # of loads, busbar and meters


@dataclass(frozen=True, slots=True)
class CampaignCase:
    """One scenario."""

    number: int  # from 0
    kind: str  # CLEAN: no attack
    size: float
    liars: int
    place: str
    onset_s: float  # after the begin of the scene
    seed: tuple[int, ...]  # of the manipulated devices and their signs


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """Campaign. The defaults are 160 scenarios of ten minutes; `of` uses the settings of the files.

    `meters`, `load_error`, `variation` and `report_q` are as in `feeders.simulation.trial.Trial`; without
    `load_error`, the errors of the feeder's files.

    Raises ValueError for an unknown place, season, design or kind of meters, or invalid numbers, all of which
        are reported.
    """

    scenes: int = 10
    together: int = 16  # scenarios of each scene, the first without an attack
    seed: int = 0
    kinds: tuple[AttackClass, ...] = KINDS  # combined with numbers of manipulated devices and places
    liars: tuple[int, ...] = (1, 3)
    places: tuple[Place, ...] = tuple(Place)
    design: Design = Design.FACTORIAL  # choice of combinations
    duration_s: float = 600.0  # of a scenario
    step_s: float = 1.0  # interval of its frames
    onset_s: tuple[float, float] = (60.0, 180.0)  # earliest and latest onset of attacks
    lying_s: float = 300.0  # largest duration of attacks
    settling_s: float = 10.0  # time after an onset without errors of the voltage
    seasons: tuple[Season, ...] = tuple(Season)
    estimator: str = "modal"
    alarms_per_year: tuple[float, ...] = (1.0,)  # every scenario is monitored once for each
    learn_s: float = 0.0  # honest time before each scene with readings every `learn_step_s`; 0: no learning
    settings: tuple[tuple[str, float], ...] = ()  # other settings of the feeder's `[monitor]`
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
        rates = self.alarms_per_year
        checks = (
            (
                min(self.scenes, self.together) < 1,
                "not-positive",
                "a campaign needs scenes, and a scene scenarios",
            ),
            (self.seed < 0, "negative", "the seed must not be negative"),
            (
                not self._combined and self.together > 1,
                "missing",
                "there are no kinds of attack, numbers of manipulated devices or places",
            ),
            (min((*self.liars, 1)) < 1, "not-positive", "numbers of manipulated devices must be positive"),
            (not self.seasons, "missing", "there are no seasons"),
            (
                len({k.name for k in self.kinds}) < len(self.kinds),
                "duplicate",
                "kinds of attack need different names",
            ),
            (
                not rates or not all(0.0 < rate < math.inf for rate in rates),
                "not-positive",
                "a false-alarm rate is missing, or not positive and finite",
            ),
            (not all(map(math.isfinite, times)), "not-finite", "times must be finite numbers"),
            (min(self.step_s, self.lying_s) <= 0.0, "not-positive", "step_s and lying_s must be positive"),
            (
                0.0 != self.learn_s < self.learn_step_s,
                "out-of-range",
                f"learn_s must be 0 or from {self.learn_step_s:g} s on",
            ),
            (
                not self.step_s <= self.onset_s[0] <= self.onset_s[1] <= self.duration_s - self.step_s,
                "out-of-range",
                "attacks must begin after the first frame and before the last",
            ),
            (
                self.estimator not in ESTIMATORS,
                "unknown-name",
                f"estimator {self.estimator!r} does not exist; there are {', '.join(ESTIMATORS)}",
            ),
        )
        raise_if_any(Problem(code, text) for wrong, code, text in checks if wrong)

    @classmethod
    def of(cls, site: Site, **chosen: Any) -> CampaignPlan:
        """Campaign with the settings of the feeder's files, except for the given attributes.

        Estimator, interval of readings and false alarms are those of `[monitor]`, and powers have the
        uncertainty of the service. Times are counted in readings: with one reading per second they are those
        of `CampaignPlan()`. With a `duration_s`, attacks begin after 0.1 to 0.3 of it and last for half of
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
        """Time of a scene, by its number."""
        random = np.random.default_rng([self.seed, _MOMENT, scene])
        season = self.seasons[int(random.integers(len(self.seasons)))]
        t = library(season).t_s
        return SceneTime(season, float(random.uniform(0.0, t[-1])), int(random.integers(2**31)))

    def cases(self, scene: int) -> list[CampaignCase]:
        """Scenarios of a scene, the first without an attack."""
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
        """Scene without an attack, without its season."""
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
        """Feeder of a scene with the settings of the estimator's design for one of the plan's rates.

        Raises ValueError for an unknown setting, or a fraction for an integer; FeederInvalid for a setting
            out of range.
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

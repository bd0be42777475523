"""An adversary that knows the algorithm: largest voltage error at CLEAN, beside the unavoidable minimum.

    python -m benchmarks.adversary [seeds] [attack ...] [--feeder NAME] [--estimator NAME]

The truth is AC power flow with the droop inverters in closed loop; meters have the errors of the feeder's
files, and fixed errors are learned over six hours unless stated otherwise. A coalition chooses false voltages
(and powers, and the busbar's reading) that maximise the error of one reconstructed voltage within a share of
every limit of the estimator: a second-order cone program (`gridsec.planning.unavoidable`) against the tests
of `modal`. Other estimators of the registry are attacked with the programs made for `modal`.

Attacks, of a contiguous third of the meters unless stated otherwise:

step             a step within all limits
ramp             the same over ten minutes
commissioning    a step before fixed errors are learned, held for all of the six hours and after them
restart          a step at the first tick after a restart
dither           signs alternate, with periods of 2, 10, 60 and 120 ticks
spike            one reading of one meter is 10 % off, every 5, 30, 70 and 120 ticks
scattered        a step of a random third
lateral          a step of two thirds of the meters of one lateral
busbar           a step of a third and of the busbar's meter
false            a step of a third that also reports false powers, within the declared range
withheld         a step of a third that reports no powers
late             a step; powers are 60 s old, and the files state it

Each is played with several shares of the limits. A row is the play with the largest ratio. Columns: largest
false voltage and largest error by the attack at a CLEAN tick, V; CLEAN ticks, %; the unavoidable minimum at
that tick, V, and that of tests that know the coalition, but not the direction; both ratios; manipulated and
honest meters named, of all plays. The error by the attack is the difference of the reconstruction to that of
the honest run with the same seed. Exits 1 when an honest meter is named.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._adversary import (
    Answer,
    Registered,
    World,
    falsified,
    faults,
    honest_covariance,
    learning,
    region,
)
from benchmarks._arguments import count
from benchmarks._scenes import (
    Model,
    Setting,
    beyond,
    neighbours,
    without,
)
from feeders.model.site import Site, unread
from feeders.registry import MODAL
from gridsec.arrays import Floats, Ints
from gridsec.interface import Decision, Frame
from gridsec.planning.unavoidable import (
    ConeProgram,
    blind_norm,
    deviations,
    every_test,
    unavoidable,
)

FEEDERS = ("simbench-lv-rural1", "kerber-dorfnetz", "kerber-vorstadtnetz")
SHARES = (0.1, 0.3, 0.6, 0.8, 1.0, 1.3, 2.0)
"""Parts of every limit: at 1, honest residuals decide; beyond, the first ticks after the onset."""
CALM, TICKS = 20, 120
"""Honest ticks before an attack and ticks of an attack."""
RAMP = 600
"""Ticks of a ramp: the correlation time of the loads."""
WITHHELD = 75
"""Ticks without powers before their voltages are false."""
SPIKE = 0.1
"""Size of a spike, part of the voltage."""
TARGETS = 2
"""Places whose error is maximised, those with the largest unavoidable errors."""
AGES = (1, 2, 4, 8, 15, 30, 60, 120, 240, 480, 960)
"""Ages at which the minimum is computed; a tick counts with the next larger one."""

Pattern = Callable[[int], float]


def step(age: int) -> float:  # noqa: ARG001  # a pattern
    """1 from the onset on."""
    return 1.0


def ramp(age: int) -> float:
    """Growth to 1."""
    return min((age + 1) / RAMP, 1.0)


def dither(period: int, age: int) -> float:
    """Alternating sign."""
    return 1.0 if age % period < period // 2 else -1.0


def spike(period: int, age: int) -> float:
    """One tick of each period."""
    return float(age % period == 0)


def third(where: Site, first: int, seed: int) -> Ints:  # noqa: ARG001  # a place
    """A contiguous third around the meter that the prior knows least."""
    return np.sort(neighbours(where, first)[: where.meters.size // 3]).astype(np.intp)


def scattered(where: Site, first: int, seed: int) -> Ints:  # noqa: ARG001  # a place
    """A random third."""
    random = np.random.default_rng([seed, 3])
    return np.sort(random.permutation(where.meters.size)[: where.meters.size // 3]).astype(np.intp)


def lateral(where: Site, first: int, seed: int) -> Ints:
    """Two thirds of the meters of one lateral, the farthest ones."""
    most = where.meters.size // 3
    sets = [one for one in beyond(where) if one.size >= 3 and 2 * one.size // 3 <= most]
    ours = [one for one in sets if first in one] or sets
    chosen = ours[0] if ours else third(where, first, seed)
    order = neighbours(where, first)
    inside = order[np.isin(order, chosen)]
    return np.sort(inside[: max(2, 2 * chosen.size // 3)]).astype(np.intp)


def single(where: Site, first: int, seed: int) -> Ints:  # noqa: ARG001  # a place
    """One random meter."""
    return np.random.default_rng([seed, 4]).integers(where.meters.size, size=1).astype(np.intp)


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of attack.

    Attributes
    ----------
    patterns
        Patterns over time, by name.
    place
        Coalition: of the feeder, the meter that the prior knows least, and the seed.
    ticks
        Length.
    powers, busbar, withheld, aged
        False powers, false busbar, withheld powers, late powers.
    learned, calm
        Whether fixed errors are known, and honest ticks before the attack.
    """

    patterns: tuple[tuple[str, Pattern], ...] = (("step", step),)
    place: Callable[[Site, int, int], Ints] = third
    ticks: int = TICKS
    powers: bool = False
    busbar: bool = False
    withheld: bool = False
    aged: bool = False
    learned: bool = True
    calm: int = CALM


KINDS = {
    "step": Kind(),
    "ramp": Kind((("600 s", ramp),), ticks=RAMP + TICKS),
    "commissioning": Kind(learned=False, calm=0),
    "restart": Kind(calm=0),
    "dither": Kind(tuple((f"period {n}", partial(dither, n)) for n in (2, 10, 60, 120))),
    "spike": Kind(
        tuple((f"period {n}", partial(spike, n)) for n in (5, 30, 70, 120)), place=single, ticks=5 * TICKS
    ),
    "scattered": Kind(place=scattered),
    "lateral": Kind(place=lateral),
    "busbar": Kind(busbar=True),
    "false": Kind(powers=True),
    "withheld": Kind(withheld=True, calm=CALM + WITHHELD),
    "late": Kind(aged=True, calm=CALM + WITHHELD),
}


@dataclass(frozen=True, slots=True)
class Played:
    """One play. Voltages in V, `clean` in %, `age` in ticks."""

    share: float
    lie: float
    error: float
    clean: float
    minimum: float
    blind: float
    age: int
    named: int
    honest: int

    @property
    def ratio(self) -> float:
        """Error over minimum."""
        return self.error / self.minimum if self.minimum > 0.0 else 0.0


class Scene:
    """One honest run, the coalition's faults, and the minimum.

    Parameters
    ----------
    kind
        The attack.
    feeder, seed
        Where, and what is random.
    estimator
        A name of the registry.
    """

    def __init__(self, kind: Kind, feeder: str, seed: int, estimator: str) -> None:
        self.kind = kind
        self.world = World(Setting(feeder, Model.MATCHED, learned=True, seed=seed), kind.aged)
        self.site, self.monitor = self.world.site, Registered(estimator, self.world)
        known = list(learning(self.world.setting)) if kind.learned else []
        self.before = self.monitor.start(known)
        # Its tests are those that the attack stays within.
        self.modal = Registered(MODAL, self.world)
        self.tests = self.modal.start(known)
        self.made = self.modal.design.design.front
        first = int(np.argmax(self.made.prior.variance[self.made.prior.meters]))
        self.meters = kind.place(self.site, first, seed)
        self.frames = [
            (self._withheld(frame, k), v2)
            for k, (frame, v2) in enumerate(self.world.frames(float(kind.calm + kind.ticks)))
        ]
        for frame, _ in self.frames[: kind.calm]:
            self.before, _ = self.monitor.step(self.before, frame)
        for frame, _ in self.frames:
            self.tests, _ = self.modal.step(self.tests, frame)
        self.honest = [answer.v2 for answer in self._play(None)]
        self.faults = faults(
            self.site,
            self.made,
            self.frames[max(kind.calm - 1, 0)][0],
            self.meters,
            powers=kind.powers,
            busbar=kind.busbar,
        )
        self.minima = [self._minimum(age) for age in AGES]

    def _withheld(self, frame: Frame, k: int) -> Frame:
        if not self.kind.withheld or k < CALM:
            return frame
        silent = np.zeros(frame.p.size, dtype=np.bool_)
        silent[self.site.meters[self.meters]] = True
        return without(frame, unread(self.site), silent)

    def _minimum(self, age: int) -> tuple[Floats, float]:
        """Unavoidable errors at all places, and the factor of tests that do not know the direction."""
        V, prior = honest_covariance(self.made, self.tests.front.learned, age)
        z = deviations(self.made.options.alarms_per_year, age * self.made.step_s)
        errors = unavoidable(V, prior, self.faults, z)
        if self.kind.powers:
            # Some combinations are nearly invisible: ranges of the powers limit them.
            tests, errors = every_test(V, prior, z), np.zeros_like(errors)
            program, gain = ConeProgram(tests, self.faults), self.faults.gain(tests.weights)
            for x in np.unique(self.made.prior.meters[self.meters]):
                errors[x] = program(gain[x]).size
        return errors, blind_norm(self.faults.signature.shape[1], z) / z

    def attacks(self) -> Iterator[tuple[float, Floats]]:
        """Shares of the limits and amounts of the faults."""
        if self.kind.place is single:
            at = self.frames[self.kind.calm][0].y[self.meters]
            yield 1.0, at * ((1.0 - SPIKE) ** 2 - 1.0)
            return
        size = np.max([errors for errors, _ in self.minima], axis=0)
        accepted = region(self.modal.design.design, self.tests, min(self.kind.ticks, TICKS))
        program, gain = ConeProgram(accepted, self.faults), self.faults.gain(accepted.weights)
        for share in SHARES:
            found = [program(gain[x], share) for x in np.argsort(-size)[:TARGETS]]
            yield share, max(found, key=lambda one: one.size).amounts

    def play(self, pattern: Pattern, share: float, amounts: Floats) -> Played:
        """Play one attack."""
        kind, volt = self.kind, self.site.customer_volt
        errors, blind = self.minima[-1]
        minimum = float(errors.max()) * _volt(volt)
        worst = Played(share, 0.0, 0.0, 0.0, minimum, blind * minimum, 0, 0, 0)
        named, clean, top = np.zeros(self.site.meters.size, dtype=np.bool_), 0, 0.0
        frames = self.frames[kind.calm :]
        for age, answer in enumerate(self._play(lambda k: pattern(k) * amounts)):
            named |= answer.named
            if answer.decision is not Decision.CLEAN:
                continue
            clean += 1
            level = pattern(age)
            top = max(top, self._lie_volt(frames[age][0], level * amounts))
            moved = np.abs(_root(answer.v2) - _root(self.honest[age])) * volt
            errors, blind = self.minima[min(int(np.searchsorted(AGES, age + 1)), len(AGES) - 1)]
            minimum = float(errors.max()) * _volt(volt)
            if moved.max() / minimum > worst.ratio:
                factors = minimum, blind * minimum
                worst = replace(
                    worst, error=float(moved.max()), minimum=factors[0], blind=factors[1], age=age
                )
        liars = np.isin(np.arange(named.size), self.meters)
        counts = int((named & liars).sum()), int((named & ~liars).sum())
        part = 100.0 * clean / kind.ticks
        return replace(worst, lie=top, clean=part, named=counts[0], honest=counts[1])

    def _lie_volt(self, frame: Frame, amounts: Floats) -> float:
        """Largest false voltage, V."""
        y, volt = frame.y[self.meters], self.site.customer_volt[self.site.meters[self.meters]]
        return float((np.abs(_root(y + amounts[: self.meters.size]) - _root(y)) * volt).max())

    def _play(self, amounts: Callable[[int], Floats] | None) -> Iterator[Answer]:
        """Answers from the onset on, with the faults of each age."""
        kind, state = self.kind, self.before
        if not kind.learned:
            state = self._learned(amounts)
        for age, (frame, _) in enumerate(self.frames[kind.calm :]):
            seen = frame if amounts is None else self._false(frame, amounts(age))
            state, answer = self.monitor.step(state, seen)
            yield answer

    def _false(self, frame: Frame, amounts: Floats) -> Frame:
        kind = self.kind
        return falsified(frame, self.made, self.meters, amounts, powers=kind.powers, busbar=kind.busbar)

    def _learned(self, amounts: Callable[[int], Floats] | None) -> object:
        """State of the monitor after six hours of learning under the attack."""
        frames = learning(self.world.setting)
        return self.monitor.start(
            frame if amounts is None else self._false(frame, amounts(0)) for frame in frames
        )


def _root(v2: Floats) -> Floats:
    return np.sqrt(np.maximum(v2, 0.0))


def _volt(customer_volt: Floats) -> float:
    """Volts of a small change of the squared voltage at nominal."""
    return 0.5 * float(customer_volt.max())


def rows(name: str, feeder: str, seeds: int, estimator: str) -> Iterator[tuple[str, str, list[Played]]]:
    """Variant, size of the coalition, and plays."""
    kind = KINDS[name]
    scenes = [Scene(kind, feeder, seed, estimator) for seed in range(seeds)]
    for variant, pattern in kind.patterns:
        plays = [scene.play(pattern, *one) for scene in scenes for one in scene.attacks()]
        yield variant, f"{scenes[0].meters.size} of {scenes[0].site.meters.size}", plays


def line(row: tuple[str, ...], plays: list[Played]) -> str:
    """One line of the table."""
    worst = max(plays, key=lambda one: (one.ratio, one.clean))
    cells = [*row, f"{worst.share:g}", f"{worst.lie:.2f}", f"{worst.error:.2f}", f"{worst.clean:.0f}"]
    cells += [f"{worst.minimum:.2f}", f"{worst.blind:.2f}", f"{worst.ratio:.2f}"]
    cells += [f"{worst.error / worst.blind:.2f}", f"{sum(one.named > 0 for one in plays)} of {len(plays)}"]
    cells += [f"{max(one.honest for one in plays)}"]
    return f"| {' | '.join(cells)} |"


HEAD = (
    *("feeder", "attack", "pattern", "meters", "share", "false V", "error V", "CLEAN %", "minimum V"),
    *("direction unknown V", "ratio", "ratio", "plays with names", "honest named"),
)


def main(asked: argparse.Namespace) -> int:
    """Print the table; 1 if an honest meter is named."""
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    good = True
    for feeder in asked.feeder or FEEDERS:
        for name in asked.attacks or KINDS:
            for variant, size, plays in rows(name, feeder, asked.seeds, asked.estimator):
                print(line((feeder, name, variant, size), plays), flush=True)
                good &= all(one.honest == 0 for one in plays)
    return 0 if good else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("seeds", nargs="?", type=count, default=1)
    parser.add_argument("attacks", nargs="*", metavar="attack")
    parser.add_argument("--feeder", action="append", help="a feeder of the project; may be repeated")
    parser.add_argument("--estimator", default=MODAL, help="of the registry")
    return parser


if __name__ == "__main__":
    given = _parser().parse_intermixed_args()
    unknown = sorted(set(given.attacks) - set(KINDS))
    if unknown:
        _parser().error(f"no attack {', '.join(unknown)}; there are {', '.join(KINDS)}")
    sys.exit(main(given))

"""Limits of the decoders of single ticks.

AC power flow, one reading a second for 30 s; from 10 s on k of 13 meters at random lie: each in its own
direction (bias), all in the same (together), or like a load that is not there (coordinated). Every decoder
may accuse k meters. Two scenes:

- stiff: SimBench rural1, meters as its files say, loads known within 0.6 kW and 0.2 kvar. The meters' fixed
  errors are far larger than what loads do, so readings are almost uncorrelated and decoders cannot differ.
- soft: Kerber Landnetz, white meters of 0.2 %, loads known within 2 kW and 0.7 kvar, as from forecasts.
  Neighbours move together, and the decoders differ in what they make of that.

Exits 1 if the answer is CLEAN at any tick with a bias of 4 %, in own or the same direction.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from feeders.model.site import load
from feeders.registry import DesignedEstimator, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, TrialResult, frames, judge
from gridsec.estimators.single_tick import SingleTickDesign

DECODERS = ("weighted-least-squares", "l0-decoder", "basis-pursuit", "matching-pursuit")
TRICKS = (AttackKind.BIAS, AttackKind.TOGETHER, AttackKind.COORDINATED)
SEEDS, DURATION_S, ONSET_S, GROSS = 8, 30.0, 10.0, 4.0


@dataclass(frozen=True, slots=True)
class Scene:
    """What is played, and which lies."""

    name: str
    feeder: str
    meters: TrialMeterErrors
    loads: LoadError
    sizes: tuple[float, ...]
    counts: tuple[int, ...]

    def trial(self, lie: AttackSpec | None = None, seed: int = 0) -> Trial:
        """One run."""
        site = load(self.feeder)
        return Trial(
            site, seed=seed, duration_s=DURATION_S, load_error=self.loads, meters=self.meters, lie=lie
        )

    def lies(self, count: int) -> Iterator[AttackSpec | None]:
        """No manipulation, then all manipulations of each number of meters."""
        yield None
        for trick, size in product(TRICKS[: None if count > 1 else 1], self.sizes):
            yield AttackSpec(trick, count, size, ONSET_S)


SCENES = (
    Scene("stiff", "simbench-lv-rural1", TrialMeterErrors.SITE, LoadError(0.6, 0.2), (1.0, 1.5, 4.0), (2,)),
    Scene(
        "soft", "kerber-landnetz", TrialMeterErrors.WHITE, LoadError(2.0, 0.7), (1.0, 1.5, 2.0, 4.0), (2, 4)
    ),
)


def correlation(made: SingleTickDesign) -> float:
    """Largest correlation between the readings of two honest meters, 1."""
    S = made.front.prior.between
    std = np.sqrt(np.diag(S) + made.noise)
    return float((S / np.multiply.outer(std, std) - np.diag(np.diag(S) / std**2)).max())


def run(
    scene: Scene, lie: AttackSpec | None, watchers: dict[str, DesignedEstimator]
) -> dict[str, list[TrialResult]]:
    """All seeds, by decoder."""
    found: dict[str, list[TrialResult]] = {name: [] for name in watchers}
    for seed in range(SEEDS):
        trial = scene.trial(lie, seed)
        played = list(frames(trial))
        for name, watcher in watchers.items():
            found[name].append(judge(watcher, trial, played=played))
    return found


def cell(outcomes: list[TrialResult]) -> str:
    """Liars named, honest meters ever named, and ticks with a lie that were CLEAN."""
    liars = sum(one.liars.size for one in outcomes)
    named = sum(int(np.isfinite(one.delay_s).sum()) for one in outcomes)
    false = sum(int(one.accused.sum()) for one in outcomes)
    clean = 100.0 * sum(int(one.clean_while_lying.sum()) for one in outcomes)
    lying = sum(int(one.lying.sum()) for one in outcomes)
    return f"{named}/{liars} ({false}) {f'{clean / lying:.0f} %' if lying else '-'}"


def main() -> int:
    """Print the table."""
    bad, times = 0, {name: list[float]() for name in DECODERS}
    print("named of the liars (honest meters named) ticks with a lie that were CLEAN")
    for scene in SCENES:
        for count in scene.counts:
            stated = scene.trial().stated
            watchers = {name: design(choose(stated, estimator=name, max_attacked=count)) for name in DECODERS}
            most = correlation(watchers[DECODERS[0]].design)
            print(f"\n{scene.name}, k = {count}, largest correlation of readings {most:.2f}")
            print(" " * 18 + "".join(f"{name:>24}" for name in DECODERS))
            for lie in scene.lies(count):
                found = run(scene, lie, watchers)
                label = f"{lie.size} % {lie.trick}" if lie else "nobody"
                print(f"{label:<18}" + "".join(f"{cell(found[name]):>24}" for name in DECODERS), flush=True)
                for name, outcomes in found.items():
                    times[name] += [float(np.median(one.step_ms)) for one in outcomes]
                    gross = lie is not None and lie.size >= GROSS and lie.trick is not AttackKind.COORDINATED
                    bad += gross * sum(int(one.clean_while_lying.sum()) for one in outcomes)
    print()
    for name in DECODERS:
        print(f"{name}: {np.median(times[name]):.2f} ms per step")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())

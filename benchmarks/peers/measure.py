"""Run every method on the same snapshots and count."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.special import betaincinv

from benchmarks.peers import served
from benchmarks.peers.answer import Answer, Method
from benchmarks.peers.grid_model import Greedy, GreedyChi
from benchmarks.peers.ours import Ours
from benchmarks.peers.panda import Panda
from benchmarks.peers.scene import ATTACKS, Cell, Scene, Snapshot, mean, reading, scene, snapshot

NOISES = ((0.001, 0.1), (0.005, 0.3))
OURS, SERVED, PANDA = "ours", "served", "pandapower"
# Of clean snapshots, at most this part may name a meter.
FALSE = 0.01
_CONFIDENCE = 0.95
# No parameter of any method was chosen on these random numbers.
_SEED = 2026
PEERS = (PANDA, "pgm 3.0", "pgm 3.5", "pgm chi2")


@dataclass(slots=True)
class Score:
    """What one method did in one cell, in numbers of snapshots.

    Attributes
    ----------
    trials, exact, missed, false, failed
        Snapshots; those where the named meters are exactly the liars; where a liar was not named; where
        another meter was; where the method had no result.
    among
        Those where the liars are exactly one of the explanations.
    ms
        Median time of a snapshot.
    seen
        Snapshots in which a chi-square test alone says that something is wrong; -1 where there is none.
    hits
        Whether the named meters are exactly the liars, snapshot by snapshot.
    """

    trials: int = 0
    exact: int = 0
    among: int = 0
    missed: int = 0
    false: int = 0
    failed: int = 0
    ms: float = 0.0
    seen: int = -1
    hits: list[bool] = field(default_factory=list)


def cells(feeders: tuple[str, ...]) -> Iterator[Cell]:
    """All cells of the table."""
    for feeder in feeders:
        for std_v, std_pq in NOISES:
            yield Cell(feeder, std_v, std_pq)
            for attack in ATTACKS:
                for liars in (1, 2, 3):
                    yield Cell(feeder, std_v, std_pq, attack, liars)


def methods(here: Scene) -> dict[str, Method]:
    """All methods, prepared for a feeder."""
    return {
        PANDA: Panda(here),
        "pgm 3.0": Greedy(here, 3.0),
        "pgm 3.5": Greedy(here, 3.5),
        "pgm chi2": GreedyChi(here),
        OURS: Ours(here),
    }


def measure(
    cell: Cell, here: Scene, every: dict[str, Method], *, trials: int, panda: int, seconds: int = 1
) -> dict[str, Score]:
    """One cell: every method sees the same snapshots, one after the other.

    With `seconds`, every method gets the mean of the readings, with its smaller standard deviation.
    """
    scores = {name: Score() for name in every}
    if PANDA in scores:
        scores[PANDA].seen = 0
    times: dict[str, list[float]] = {name: [] for name in every}
    for trial in range(trials):
        told = snapshot(here, cell, np.random.default_rng([_SEED, trial, cell.liars]), seconds)
        given = mean(told)
        for name, method in every.items():
            if name == PANDA and trial >= panda:
                continue
            start = time.perf_counter()
            answer = method(given)
            times[name].append(time.perf_counter() - start)
            _count(scores[name], answer, told)
            if isinstance(method, Panda):
                scores[name].seen += method.chi2(given) is True
    for name, score in scores.items():
        score.ms = float(np.median(times[name])) * 1e3 if times[name] else float("nan")
    return scores


def votes(cell: Cell, here: Scene, method: Method, *, trials: int, seconds: int) -> Score:
    """Another way to use time: judge every second alone; a meter named in most of them is named."""
    score, times = Score(), []
    for trial in range(trials):
        told = snapshot(here, cell, np.random.default_rng([_SEED, trial, cell.liars]), seconds)
        start = time.perf_counter()
        each = [method(reading(told, t)) for t in range(seconds)]
        times.append(time.perf_counter() - start)
        named = np.mean([answer.named for answer in each], axis=0) > 0.5
        _count(score, Answer(named), told)
    score.ms = float(np.median(times)) * 1e3
    return score


def watched(cell: Cell, here: Scene, *, trials: int, seconds: int) -> Score:
    """The served monitor, fed with the same readings one after the other; `Score.ms` is a second's time."""
    score, times = Score(), []
    for trial in range(trials):
        told = snapshot(here, cell, np.random.default_rng([_SEED, trial, cell.liars]), seconds)
        start = time.perf_counter()
        named = served.suspects(here, told)
        times.append((time.perf_counter() - start) / seconds)
        _count(score, Answer(named), told)
    score.ms = float(np.median(times)) * 1e3
    return score


def limits(count: int, trials: int) -> tuple[float, float]:
    """What part it may be where `count` of so many were seen, each end at 95 % (Clopper and Pearson)."""
    low = betaincinv(count, trials - count + 1, 1.0 - _CONFIDENCE) if count else 0.0
    high = betaincinv(count + 1, trials - count, _CONFIDENCE) if count < trials else 1.0
    return float(low), float(high)


def rival(here: dict[str, Score]) -> tuple[int, int, int] | None:
    """Beside the best peer: snapshots in which only ours was exact, only the peer, and all that both saw."""
    pairs = [
        (sum(ours and not its for ours, its in both), sum(its and not ours for ours, its in both), len(both))
        for name, peer in here.items()
        if name not in {OURS, SERVED} and (both := list(zip(here[OURS].hits, peer.hits, strict=False)))
    ]
    return min(pairs, key=lambda each: ((each[0] - each[1]) / each[2], -each[2])) if pairs else None


def beaten(scores: dict[Cell, dict[str, Score]]) -> list[Cell]:
    """Attacked cells in which a peer is exact more often than ours, by more than two standard deviations."""
    attacked = [(cell, rival(here)) for cell, here in scores.items() if cell.attack != "clean"]
    return [cell for cell, best in attacked if best and best[1] - best[0] > 2.0 * np.sqrt(best[0] + best[1])]


def too_many(scores: dict[Cell, dict[str, Score]]) -> list[Cell]:
    """Clean cells in which ours names a meter in more snapshots than allowed, and not by chance."""
    clean = ((cell, here[OURS]) for cell, here in scores.items() if cell.attack == "clean" and OURS in here)
    return [cell for cell, ours in clean if limits(ours.false, ours.trials)[0] > FALSE]


def _count(score: Score, answer: Answer, told: Snapshot) -> None:
    exact = bool(np.array_equal(answer.named, told.liars)) and not answer.failed
    score.trials += 1
    score.exact += exact
    score.hits.append(exact)
    score.among += exact or any(np.array_equal(other, told.liars) for other, _ in answer.others)
    score.missed += bool((told.liars & ~answer.named).any())
    score.false += bool((answer.named & ~told.liars).any())
    score.failed += answer.failed


def prepared(feeder: str) -> tuple[Scene, dict[str, Method]]:
    """A feeder with all methods, each run once on a clean snapshot, so that caches are warm."""
    here = scene(feeder)
    every = methods(here)
    told = snapshot(here, Cell(feeder, *NOISES[0]), np.random.default_rng(0))
    for method in every.values():
        method(mean(told))
    return here, every

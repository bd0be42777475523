"""Partial observers on feeders: what single meters know, what the paper's constants promise, named meters.

Two feeders, AC power flow, one reading a second for 60 s; from 30 s on one meter at random is off. The exact
bank sees the same readings. Exits 1 if an honest meter is named.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from feeders.model.site import Site, load, plant, to_frame
from feeders.simulation.attacks import random_attacks
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.errors import NotObservable
from gridsec.estimators import exact_bank, partial
from gridsec.estimators import partial as partial_observers
from gridsec.estimators.partial import CodeWord, Parts
from gridsec.estimators.plant import PreviousStep, clean
from gridsec.interface import Frame
from gridsec.secure.decode import cospark
from gridsec.secure.decode.noise import correction_constants
from gridsec.secure.decode.stacks import Stack

FEEDERS = ("cigre-lv", "simbench-lv-rural1")
SEEDS = 8
ONSET, END = 30, 60
SIZES = (0.0, 0.01, 0.015, 0.02, 0.03, 0.06)
TOL = 1e-6


def frames(site: Site, size: float, seed: int) -> tuple[int, list[Frame]]:
    """The liar, and what is known at every tick."""
    attacks = (
        random_attacks(site, seed, "bias", 1, size, t_on=START + ONSET, t_off=START + END) if size else ()
    )
    liar = int(attacks[0].meters[0]) if attacks else -1
    seen = snapshots(simulate(site, Scenario(seed=seed, duration_s=END, attacks=attacks)))
    return liar, [to_frame(site, snapshot) for snapshot in seen]


def last_word(made: partial.PartialDesign, seen: list[Frame]) -> tuple[CodeWord, Parts, np.ndarray, float]:
    """Code word and observers at the last frame, what readings may be off (p,), and the largest bound."""
    state = partial.init(made, START)
    for frame in seen[:-1]:
        state, _, _ = partial.step(made, state, frame)
    inputs = clean(made.setting, PreviousStep(state.parts.x, state.v0_squared, state.tally.named), seen[-1])
    h = seen[-1].t - state.t
    alone, model, parts, _ = partial_observers.observe(
        made.setting, made.model, state.parts, seen[-1], inputs, h
    )
    word = partial_observers.code_word(made.setting, parts, seen[-1], inputs, alone, model)
    _, estimate, _ = partial.step(made, state, seen[-1])
    return word, parts, alone.reading, float(estimate.bound.max())


def knowledge(site: Site, made: partial.PartialDesign) -> None:
    """What one meter knows of its inverter, and what the constants promise."""
    word, parts, reading, bound = last_word(made, frames(site, 0.0, 0)[1])
    errors, p, n = made.setting.errors, reading.size, word.scale.size
    of = errors.meter_of >= 0
    better = np.count_nonzero(parts.bound.driven[of] < parts.bound.free[of])
    print(f"  own reading beats the model at {better} of {np.count_nonzero(of)} inverters")
    free, driven = parts.bound.free.max(), parts.bound.driven.max()
    print(f"  error of an injection, pu: model {free:.2g}, own reading {driven:.2g}")
    seen = errors.reach_own[np.flatnonzero(of), errors.meter_of[of]] * parts.bound.free[of]
    weight = seen**2 / (seen**2 + reading[errors.meter_of[of]] ** 2)
    print(f"  weight of a reading in its own inverter's Kalman filter: at most {weight.max():.1g}")
    m = parts.x.size
    blocks = [word.B[word.block == j][:, :m] for j in range(p)]
    observed = Stack.of(blocks)
    print(f"  fewest meters that see some change of the injections: {cospark(observed, tol=TOL).count:g}")
    try:
        found = correction_constants(observed, 1, tol=TOL)
        print(f"  kappa_c of what is seen: {found.kappa_c:.3g}")
    except NotObservable as problem:
        print(f"  kappa_c of what is seen: none; {problem}")
    found = partial.constants(word, p, 1, tol=TOL)
    promise = found.kappa_c * np.sqrt(n + np.bincount(word.block).max())
    print(f"  with what fades: rho {found.rho:.3g}, theta {found.theta:.3g}, kappa_c {found.kappa_c:.3g}")
    print(
        f"  |x - x_hat| in units of the box: promised {promise:.3g}, known without any meter {np.sqrt(n):.3g}"
    )
    volts = np.linalg.norm(word.voltage, axis=1).max()
    known = (np.abs(word.voltage).sum(axis=1) + word.rest).max()
    said = f"promised {promise * volts:.3g}, known without any meter {known:.3g}, given {bound:.3g}"
    print(f"  v^2, squared pu: {said}")


def named(
    step: Callable[..., Any], made: Any, state: Any, seen: list[Frame]
) -> tuple[np.ndarray, Any, float]:
    """Named meters at every tick, the last answers, and the median time of a step, ms."""
    suspects, spent = [], []
    for frame in seen:
        begun = time.perf_counter()
        state, estimate, verdict = step(made, state, frame)
        spent.append(time.perf_counter() - begun)
        suspects.append(verdict.suspects)
    return np.array(suspects), (estimate, verdict), 1e3 * float(np.median(spent))


def main() -> int:
    """Print what is known, then the table."""
    wrong = 0
    for name in FEEDERS:
        site = load(name)
        watched = plant(site)
        ours = partial.design(watched, max_attacked=1, step_s=1.0)
        bank = exact_bank.design(watched, max_attacked=1, step_s=1.0)
        print(f"{name}: {watched.meters.size} meters, {watched.droop.tau.size} inverters")
        knowledge(site, ours)
        head = f"{'named':>7} {'falsely':>8} {'threshold':>10} {'bound':>7} {'ms':>6}"
        print(f"  {'lie':>6} {'estimator':>18} {head}")
        for size in SIZES:
            runs = [frames(site, size, seed) for seed in range(SEEDS)]
            for what, module, made in (
                ("partial-observers", partial, ours),
                ("exact-bank", exact_bank, bank),
            ):
                hits, false, top, bound, spent = 0, 0, [], [], []
                for liar, seen in runs:
                    suspects, (estimate, verdict), ms = named(
                        module.step, made, module.init(made, START), seen
                    )
                    hits += bool(liar >= 0 and suspects[-1, liar])
                    false += (
                        int(np.delete(suspects, liar, axis=1).any()) if liar >= 0 else int(suspects.any())
                    )
                    top.append(float(np.median(verdict.threshold)))
                    bound.append(float(estimate.bound.max()))
                    spent.append(ms)
                wrong += false
                print(
                    f"  {size:6.1%} {what:>18} {hits:5d}/{SEEDS} {false:8d} {np.mean(top):10.4f}"
                    f" {np.mean(bound):7.4f} {np.median(spent):6.1f}"
                )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())

"""Meters that withhold active powers: verdict, error over stated uncertainty, accusations.

    python -m benchmarks.missing_powers [seeds] [feeder ...]

Some meters report voltages without powers from the twentieth second on. Their voltages are true, or off by
the largest step within 70 % of every limit of the core (`gridsec.planning.unavoidable`), from the
ninety-fifth second on, for sixty seconds. All other readings are true; the truth is AC power flow.

`unread`: the frame states the missing powers (`Frame.p_origin`). `interval only`: the frame states the same
intervals and no origin, as before `Cause.MISSING_POWERS`.

Columns: meters without powers and their places; largest lie and error of a reconstructed voltage, V; ticks
CLEAN, %; largest error over the stated standard deviation and over the stated bound, and both at CLEAN;
manipulated and honest meters named. Medians over seeds for lie and CLEAN, else the largest. Exits 1 when,
with stated powers, an error beyond the bound is CLEAN or an honest meter is named.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields, replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._adversary import LARGEST, region
from benchmarks._arguments import arguments
from benchmarks._scenes import Model, Setting, begin, neighbours, play, site, without
from feeders.model.site import unread
from feeders.simulation.scenario import START
from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.modal.monitor import ModalDesign, ModalState
from gridsec.interface import Decision
from gridsec.planning.unavoidable import ConeProgram, Faults

FEEDERS = ("kerber-dorfnetz",)
WITHHELD_S, LIE_S, END_S = 20.0, 95.0, 155.0
"""Times from which powers are withheld and voltages false, and the end, s."""
SHARE = 0.7
"""Part of every limit that the lie uses."""
CASES = (
    ("one", "honest", 1.0),
    ("random", "honest", 3.0),
    ("contiguous", "honest", 3.0),
    ("one", "lie", 1.0),
    ("contiguous", "lie", 6.0),
    ("random", "lie", 3.0),
    ("contiguous", "lie", 3.0),
)
"""Places, voltages, and the number of meters by one of them: 1, a third or a sixth of all."""


@dataclass(frozen=True, slots=True)
class Played:
    """One run. Voltages in V, all else without unit."""

    lie: float
    error: float
    clean: float
    of_std: float
    of_bound: float
    clean_std: float
    clean_bound: float
    named: int
    honest: int


def places(setting: Setting, where: str, part: float) -> Ints:
    """Meters without powers."""
    meters = site(setting.feeder).meters.size
    count = 1 if where == "one" else round(meters / part)
    random = np.random.default_rng([setting.seed, 7])
    if where == "random":
        return np.sort(random.choice(meters, count, replace=False)).astype(np.intp)
    return np.sort(neighbours(site(setting.feeder), int(random.integers(meters)))[:count])


def stealthy(design: ModalDesign, state: ModalState, meters: Ints) -> Floats:
    """False voltages of some meters, (p,), squared pu, with the largest error of one reconstruction."""
    accepted, prior = region(design, state, round(END_S - LIE_S)), design.front.prior
    lies = Faults.voltages(meters, (prior.variance.size, prior.meters.size), LARGEST)
    program, gain = ConeProgram(accepted, lies), lies.gain(accepted.weights)
    found = [program(gain[x], SHARE) for x in prior.meters[meters]]
    return np.asarray(lies.signature @ max(found, key=lambda one: one.size).amounts)


def run(setting: Setting, meters: Ints, *, lying: bool, stated: bool) -> Played:
    """Play and watch one run.

    Parameters
    ----------
    setting
        The honest world.
    meters
        Those without powers.
    lying
        Whether their voltages are false.
    stated
        Whether frames state the origin of the powers.
    """
    (made, state), where = begin(setting), site(setting.feeder)
    silent: Bools = np.zeros(len(where.tables.customers), dtype=np.bool_)
    silent[where.meters[meters]] = True
    gone, nothing, lie = np.isin(np.arange(where.meters.size), meters), unread(where), np.zeros(1)
    named, ticks = np.zeros(where.meters.size, dtype=np.bool_), []
    for frame, truth in play(setting, END_S):
        age = frame.t - START
        if lying and age == LIE_S:
            lie = stealthy(made.design, state, meters)
        seen = without(frame, nothing, silent) if age >= WITHHELD_S else frame
        seen = replace(seen, y=seen.y + lie, p_origin=seen.p_origin if stated else None)
        state, estimate, verdict = made.step(state, seen)
        named |= verdict.suspects
        if age >= (LIE_S if lying else WITHHELD_S):
            error = np.abs(estimate.v2 - truth.v2)
            volt = np.abs(np.sqrt(np.maximum(estimate.v2, 0.0)) - np.sqrt(truth.v2)) * where.customer_volt
            ratios = (error / estimate.std).max(), (error / estimate.bound).max()
            ticks.append((verdict.decision is Decision.CLEAN, volt.max(), *ratios))
    clean, volt, of_std, of_bound = np.array(ticks, dtype=np.float64).T
    return Played(
        lie=float(np.abs(lie).max() / 2.0 * where.tables.meta.voltage_volt),
        error=float(volt.max()),
        clean=100.0 * float(clean.mean()),
        of_std=float(of_std.max()),
        of_bound=float(of_bound.max()),
        clean_std=float((clean * of_std).max()),
        clean_bound=float((clean * of_bound).max()),
        named=int((named & gone).sum()) if lying else 0,
        honest=int((named & ~gone).sum()) if lying else int(named.sum()),
    )


def main(seeds: int, feeders: tuple[str, ...]) -> int:
    """Print a table; 1 if a limit is missed."""
    print(
        "| feeder | withheld | voltages | powers | lie V | error V | clean % | in std | in bounds |", end=""
    )
    print(" in std at clean | in bounds at clean | named | honest named |\n|" + "---|" * 13)
    good = True
    for feeder in feeders:
        for where, kind, part in CASES:
            for stated in (False, True):
                settings = [Setting(feeder, Model.MATCHED, learned=False, seed=seed) for seed in range(seeds)]
                sets = [places(one, where, part) for one in settings]
                pairs = zip(settings, sets, strict=True)
                runs = [run(one, chosen, lying=kind == "lie", stated=stated) for one, chosen in pairs]
                top = {f.name: max(getattr(one, f.name) for one in runs) for f in fields(Played)}
                mid = {
                    name: float(np.median([getattr(one, name) for one in runs])) for name in ("lie", "clean")
                }
                cells = [feeder, f"{sets[0].size} {where}", kind, "unread" if stated else "interval only"]
                cells += [f"{mid['lie']:.1f}", f"{top['error']:.1f}", f"{mid['clean']:.0f}"]
                names = ("of_std", "of_bound", "clean_std", "clean_bound")
                cells += [f"{top[name]:.1f}" for name in names]
                cells += (
                    [f"{sum(one.named for one in runs)} of {sets[0].size * seeds}"]
                    if kind == "lie"
                    else ["-"]
                )
                cells += [f"{sum(one.honest for one in runs)}"]
                print(f"| {' | '.join(cells)} |", flush=True)
                good &= not stated or (top["clean_bound"] <= 1.0 and top["honest"] == 0)
    return 0 if good else 1


if __name__ == "__main__":
    asked = arguments(__doc__, seeds=5, feeders=FEEDERS)
    sys.exit(main(asked.seeds, tuple(asked.feeders)))

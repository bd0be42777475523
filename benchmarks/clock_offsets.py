"""Meters with clocks that are off, with kettles, charging cars and tap steps, and no manipulation.

    python -m benchmarks.clock_offsets [runs] [minutes]

The scene of `benchmarks.late_powers`, all powers of the moment of their voltages. Every meter's clock is off
by a constant within 3 s, 15 s or 60 s, or a fifth of them within 60 s and the others within 3 s: at each tick
it reports voltage and power of another moment. Offsets from half a second on are measured, or none is. With
steps the transformer changes its tap by 1.25 % once in two minutes.

Columns: largest offset, s; runs; runs with an honest meter named; honest meters named; ticks CLEAN, UNDECIDED
and ATTACKED, %; largest error of a voltage over its standard deviation; named of a third of the meters that
reads 3 % wrong, with random signs, in the last two minutes. Exits 1 when an honest meter is named and offsets
are measured.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from dataclasses import replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from benchmarks.late_powers import LIE, LIES_S, site, watcher, world
from feeders.model.site import Snapshot, to_frame
from feeders.simulation.scenario import START
from gridsec.arrays import Floats
from gridsec.interface import Decision

LEAST_S = 0.5
"""Smallest offset that is measured, s."""
NEAR_S, MIDDLE_S, FAR_S = 3.0, 15.0, 60.0
"""Largest offsets, s; the last is `--max-skew` of the service."""
FEW = 0.2
"""Part of the meters with offsets within `FAR_S` where the others are within `NEAR_S`."""
CASES = (
    ("3", NEAR_S, 1.0, False),
    ("3", NEAR_S, 1.0, True),
    ("15", MIDDLE_S, 1.0, True),
    ("60 (a fifth), 3", FAR_S, FEW, True),
    ("60", FAR_S, 1.0, True),
)
"""Name, largest offset, s, part of the meters with it, and whether offsets are measured."""
TAP_PU = 0.0125


def shifted(values: Floats, offset: Floats, k: int, first: int) -> Floats:
    """Each meter's value at tick k by its own clock, linear between the seconds from tick -first on, (p,)."""
    place = np.clip(k + first - offset, 0.0, len(values) - 1.0)
    low, share = np.floor(place).astype(np.intp), place % 1.0
    high, at = np.minimum(low + 1, len(values) - 1), np.arange(offset.size)
    return np.asarray((1.0 - share) * values[low, at] + share * values[high, at])


def run(
    seed: int, duration_s: int, tap_pu: float, largest_s: float = NEAR_S, part: float = 1.0, *, measured: bool
) -> tuple[Counter[str], float]:
    """Counts of one run, and its largest error over the standard deviation.

    Parameters
    ----------
    seed, duration_s
        As in `late_powers.world`.
    tap_pu
        Height of a tap step, pu.
    largest_s, part
        Largest offset, s, and the part of the meters with it; the others are within `NEAR_S`.
    measured
        Whether frames have the offsets.
    """
    where, made, truth = site(0.0), watcher(0.0), world(seed, duration_s, tap_pu)
    random, count = np.random.default_rng([seed, 63]), truth.v.shape[1]
    offset = random.uniform(-largest_s, largest_s, count)
    few = np.random.default_rng([seed, 64]).random(count) < part
    offset = np.where(few, offset, offset * (NEAR_S / largest_s))
    told = np.where(np.abs(offset) >= LEAST_S, offset, np.nan) if measured else None
    liars, sign = random.permutation(count) < count // 3, random.choice([-1.0, 1.0], count)
    state, seen, named = made.init(START), Counter[str](), np.zeros((2, count), dtype=np.bool_)
    before, of_std = len(truth.p_kw) - truth.t.size, 0.0
    for k, t in enumerate(truth.t):
        lies = k >= duration_s - LIES_S
        v = shifted(truth.read, offset, k, 0) * np.where(liars & lies, 1.0 + LIE * sign, 1.0)
        p = truth.register * shifted(truth.p_kw, offset, k, before)
        said = Snapshot(t, v, p, np.full(count, np.nan), truth.v0[k])
        state, estimate, verdict = made.step(state, to_frame(where, replace(said, clock_offset_s=told)))
        if lies:
            named[1] |= verdict.suspects & liars
            named[0] |= verdict.suspects & ~liars
            continue
        named[0] |= verdict.suspects
        seen[verdict.decision] += 1
        error = np.abs(estimate.v2 - (truth.v[k] / where.customer_volt) ** 2)
        of_std = max(of_std, float((error / estimate.std).max()))
    seen["ticks"] = truth.t.size - round(LIES_S)
    seen["honest"], seen["named"] = int(named[0].sum()), int(named[1].sum())
    seen["liars"], seen["false"] = int(liars.sum()), int(named[0].any())
    return seen, of_std


def main(runs: int, minutes: int) -> int:
    """Print a table; 1 if a limit is missed."""
    print(
        "| tap steps | largest, s | offsets | runs | with honest named | honest named | CLEAN % |",
        end="",
    )
    print(" UNDECIDED % | ATTACKED % | in std | liars named |\n|" + "---|" * 11)
    good = True
    for tap_pu in (0.0, TAP_PU):
        for name, largest_s, part, measured in CASES:
            all_, of_std = Counter[str](), 0.0
            for seed in range(runs):
                seen, std = run(seed, 60 * minutes, tap_pu, largest_s, part, measured=measured)
                all_ += seen
                of_std = max(of_std, std)
            share = [f"{100.0 * all_[each] / all_['ticks']:.1f}" for each in Decision]
            cells = ["yes" if tap_pu else "no", name, "measured" if measured else "unknown", f"{runs}"]
            cells += [f"{all_['false']}", f"{all_['honest']}", share[0], share[2], share[1], f"{of_std:.1f}"]
            cells += [f"{all_['named']} of {all_['liars']}"]
            print(f"| {' | '.join(cells)} |", flush=True)
            good &= not measured or not all_["honest"]
    return 0 if good else 1


if __name__ == "__main__":
    asked = arguments(__doc__, runs=10, minutes=10)
    sys.exit(main(asked.runs, asked.minutes))

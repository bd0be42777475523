"""A third of 146 meters in collusion, loads known only roughly, full AC power flow as truth.

    python -m benchmarks.uncertain_loads [seeds]

Kerber Vorstadtnetz, one reading per second, errors of the loads 0.6 kW and 0.2 kvar with a correlation time
of 600 s. 48 random meters lie: with white meters (0.2 %, busbar 0.02 %); with real ones (a fixed error within
0.5 %, steps of 0.1 V, jitter 0.05 %), before and after their fixed errors were learned for six hours.
For each kind of lie: how many are named within the limit, how many honest meters are ever named, the largest
delay, and the 95th percentile of the error of reconstructed voltages at lying meters after the limit.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from feeders.estimators import Watcher, design
from feeders.load import Site, from_tables, load
from feeders.scenario import START
from feeders.trials import Lie, Meters, Outcome, Trial, Trick, frames, judge
from gridsec import sequential
from gridsec.sequential.commission import Learned

FEEDER = "kerber-vorstadtnetz"
LIARS = 48
ONSET_S = 90.0
LEARN_S = 6.0 * 3600.0
LEARN_STEP_S = 10.0
LARGEST_ERROR_PERCENT = 0.1


@dataclass(frozen=True, slots=True)
class Cell:
    """One kind of lie.

    Attributes
    ----------
    name
        For people.
    trick, percent
        What the liars do, and by how much, % of nominal.
    limit_s
        Within what time all have to be named, s.
    meters
        What meters make of the truth.
    learned
        Whether their fixed errors are known.
    """

    name: str
    trick: Trick
    percent: float
    limit_s: float
    meters: Meters = Meters.WHITE
    learned: bool = False


CELLS = (
    Cell("white, +-3 %", Trick.BIAS, 3.0, 3.0),
    Cell("white, -2 % all", Trick.TOGETHER, -2.0, 3.0),
    Cell("white, +-1 %", Trick.BIAS, 1.0, 10.0),
    Cell("white, +-0.5 %", Trick.BIAS, 0.5, 60.0),
    Cell("white, -0.5 % all", Trick.TOGETHER, -0.5, 60.0),
    Cell("real, +-1.5 %", Trick.BIAS, 1.5, 60.0, Meters.REAL),
    Cell("real, -1.5 % all", Trick.TOGETHER, -1.5, 60.0, Meters.REAL),
    Cell("learned, +-0.5 %", Trick.BIAS, 0.5, 60.0, Meters.REAL, learned=True),
    Cell("learned, -0.5 % all", Trick.TOGETHER, -0.5, 60.0, Meters.REAL, learned=True),
)


def trial(cell: Cell, seed: int) -> Trial:
    """One seed of a cell: any moment of the profiles' fourteen days.

    Parameters
    ----------
    cell, seed
        Which.
    """
    moment = float(np.random.default_rng([146, seed]).uniform(0.0, 13.9 * 86_400.0))
    lie = Lie(cell.trick, LIARS, cell.percent, onset_s=ONSET_S)
    return Trial(
        load(FEEDER),
        seed=seed,
        duration_s=ONSET_S + cell.limit_s + 30.0,
        meters=cell.meters,
        lie=lie,
        profile_s=moment,
    )


def learn(cell: Cell, seed: int) -> Learned:
    """Learn the meters' fixed errors from six honest hours, a reading every ten seconds.

    Parameters
    ----------
    cell, seed
        Which.
    """
    quiet = replace(trial(cell, seed), duration_s=LEARN_S + 60.0, step_s=LEARN_STEP_S, lie=None)
    made = _commissioned(quiet.stated, LEARN_S)
    state = made.init(START)
    for frame, _ in frames(quiet):
        state, _, verdict = made.step(state, frame)
        if verdict.suspects.any():
            raise RuntimeError(f"seed {seed}: an honest meter was named while meters were learned")
    if state.learning is not None:
        raise RuntimeError(f"seed {seed}: nothing was learned")
    learned: Learned = state.learned
    return learned


def _commissioned(site: Site, commission_s: float) -> Watcher:
    tables = site.tables
    settings = replace(tables.meta.monitor, estimator="sequential", commission_s=commission_s)
    return design(from_tables(replace(tables, meta=replace(tables.meta, monitor=settings))))


def run(cell: Cell, seed: int) -> Outcome:
    """Watch one seed of a cell.

    Parameters
    ----------
    cell, seed
        Which.
    """
    this = trial(cell, seed)
    watcher = _commissioned(this.stated, 0.0)
    if cell.learned:
        known = learn(cell, seed)
        family = replace(watcher.family, init=lambda made, t: sequential.init(made, t, known))
        watcher = replace(watcher, family=family)
    return judge(watcher, this, settling_s=cell.limit_s)


def main(seeds: int) -> int:
    """Run everything and print a table; 1 if a limit was missed."""
    print(f"{'':22}{'named in time':>15}{'falsely':>9}{'delay s':>9}{'error %':>9}{'ms per step':>13}")
    good = True
    for cell in CELLS:
        outcomes = [run(cell, seed) for seed in range(seeds)]
        delay = np.concatenate([each.delay_s for each in outcomes])
        error = [float(np.percentile(each.error_liars, 95)) for each in outcomes]
        named, false = int((delay <= cell.limit_s).sum()), sum(int(each.accused.sum()) for each in outcomes)
        lying = np.concatenate([each.step_ms[each.lying] for each in outcomes])
        print(
            f"{cell.name:22}{f'{named}/{delay.size}':>15}{false:>9}{delay.max():>9.0f}{max(error):>9.3f}"
            f"{np.median(lying):>8.2f}{np.percentile(lying, 95):>5.1f}",
            flush=True,
        )
        good &= named == delay.size and not false
        good &= cell.meters is not Meters.WHITE or max(error) <= LARGEST_ERROR_PERCENT
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 20))

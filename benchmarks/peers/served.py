"""The monitor that `gridsec serve` runs, fed with the same readings one after the other.

It watches: its false alarms are counted per year, not per snapshot, and it accuses powers only as a last
resort. What one snapshot alone says is asked of `gridsec.estimators.snapshot`, which the service
does not run.
"""

from __future__ import annotations

import numpy as np

from benchmarks.peers.scene import Scene, Snapshot
from gridsec.arrays import Bools
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.modal import monitor
from gridsec.estimators.modal.monitor import ModalDesign
from gridsec.estimators.plant import Plant
from gridsec.grid.devices import Droop, MeterAccuracy
from gridsec.interface import Decision, Frame

# The powers' error is the same in all readings: it lasts much longer than they do.
_LASTS_S = 3600.0


def watch(here: Scene, told: Snapshot) -> ModalDesign:
    """Prepare to watch, with the standard deviations that all methods are told and default options."""
    n = told.liars.size
    noise, none = np.full(n, told.std_v), np.zeros(n)
    accuracy = MeterAccuracy(none, none, noise, 0.0, 0.0, told.std_v)
    fleet = Droop(np.zeros(0, dtype=np.intp), np.zeros((0, 4)), np.zeros((0, 4)), np.zeros(0))
    doubt = LoadDoubt(told.std_p, told.std_q, _LASTS_S)
    return monitor.design(Plant(here.feeder, fleet, np.arange(n), accuracy), doubt=doubt, step_s=1.0)


def frame(told: Snapshot, t: int) -> Frame:
    """One of the readings, a second after the one before."""
    wide = np.sqrt(3.0)
    return Frame(
        t=float(t),
        y=told.v[t] ** 2,
        seen=np.ones(told.liars.size, dtype=np.bool_),
        v0_squared=float(told.v0[t]) ** 2,
        p=-told.p[t],
        p_error=wide * told.std_p,
        q=-told.q[t],
        q_error=wide * told.std_q,
        q_net=np.full(told.liars.size, np.nan),
        q_net_error=np.zeros(told.liars.size),
    )


def suspects(here: Scene, told: Snapshot) -> Bools:
    """Meters named after the last of the readings; none while the monitor is undecided."""
    design = watch(here, told)
    state = monitor.init(design, 0.0)
    named = np.zeros(told.liars.size, dtype=np.bool_)
    for t in range(len(told.v)):
        state, _, verdict = monitor.step(design, state, frame(told, t))
        named = verdict.suspects & (verdict.decision is Decision.ATTACKED)
    return named

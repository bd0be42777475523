"""Test of the sizes that `detectable` guarantees by simulated attacks and in campaigns.

Every trial draws errors of loads, meters and busbar: Gaussian in even trials, uniform with the same standard
deviations in odd ones. The feeder is solved with its inverters in equilibrium. The monitor `modal`, without
learned errors, processes some honest frames and then the attack.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache

import numpy as np
import pandas as pd

from feeders.model.site import Site
from feeders.simulation.attacks import AttackKind
from feeders.studies.campaign.plan import AttackClass, Promise
from feeders.studies.detectable import Detectable, Watched, hidden_attack, watched
from feeders.studies.operating import SHARE, squared, volts_of_lie
from feeders.studies.running import Progress, Where, run_pieces
from gridsec.arrays import Bools, Floats
from gridsec.estimators.front.posterior import LoadDoubt
from gridsec.estimators.modal import monitor
from gridsec.interface import Frame
from gridsec.planning.detectability import QUIET

__all__ = ["Rehearsal", "earliest_s", "promised", "rehearse"]


_LYING = 16  # frames from the onset of an attack on
_SETTLING = 25  # iterations to the inverters' equilibrium; their loop gain is below one


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """Outcome of attacks of the guaranteed sizes."""

    trials: int  # number of trials of each kind
    hidden_named: int  # trials of at most the hidden size with a named meter
    large_missed: int  # trials of at least the named size with its meter not named
    honest_named: int  # of the latter, those with an honest meter named

    @property
    def table(self) -> pd.DataFrame:
        """Result as a table of one row."""
        return pd.DataFrame([asdict(self)])


def rehearse(
    site: Site,
    found: Detectable,
    *,
    trials: int,
    seed: int = 0,
    share: float = SHARE,
    journal: Where = None,
    progress: Progress | None = None,
) -> Rehearsal:
    """Simulate the monitor under attacks at the limits found, by M meters and by one.

    Attacks begin when the observer of the inverters has settled, after `QUIET` further honest frames. Hidden
    attacks are the worst of their size. Large ones are on one meter, beyond its size. In every second trial
    M - 1 other meters are attacked as well, by up to twice their size.
    `share` is that of `found`. An interrupted run resumes from its journal, also with more trials.

    Raises OtherStudy, InUse as `feeders.studies.running.Journal`.
    """
    sizes = [float(size) for name in ("hidden", "named", "named_alone") for size in found.meters[name]]
    told = {"max_attacked": found.max_attacked, "risk": found.risk, "sizes": sizes}
    subject = {"study": "trials", "digest": site.digest, "found": told, "seed": seed, "share": share}
    given, p = watched(site, share=share), site.meters.size
    tests = given.tests(given.learned)

    @cache
    def worst(j: int) -> Floats:
        return hidden_attack(tests, given, j, found.max_attacked, found.risk)

    def trial(k: int) -> list[int]:
        rng = np.random.default_rng([seed, k])
        sign, j = rng.choice([-1.0, 1.0]), int(rng.integers(p))
        caught = _named(given, site, share, rng, sign * rng.uniform(0.5, 1.0) * worst(j)).any()
        lies = _large(site, found, rng, j, together=k % 2 == 0)
        if not lies.any():
            return [int(caught), 0, 0]
        named = _named(given, site, share, rng, sign * lies)
        return [int(caught), int(not named[j]), int((named & (lies == 0.0)).any())]

    counts = run_pieces(journal, subject, [str(k) for k in range(trials)], trial, progress=progress)
    return Rehearsal(trials, *(sum(each[i] for each in counts) for i in range(3)))


def _large(site: Site, found: Detectable, rng: np.random.Generator, j: int, *, together: bool) -> Floats:
    """Attack on meter j beyond its named size, and on others in collusion; squared pu; 0 without a size.

    Others without a named size are attacked by up to twice the size at which they are noticed.
    """
    column = "named" if together else "named_alone"
    volts = found.meters[column].to_numpy()
    lies = np.zeros(volts.size)
    if not np.isfinite(volts[j]):
        return lies
    volts = np.where(np.isfinite(volts), volts, found.meters["noticed_alone"].to_numpy())
    sizes = squared(site.customer_volt[site.meters], volts)
    if together and found.max_attacked > 1:
        others = rng.choice(np.delete(np.arange(sizes.size), j), found.max_attacked - 1, replace=False)
        lies[others] = rng.uniform(-2.0, 2.0, others.size) * sizes[others]
    lies[j] = rng.uniform(1.0, 1.2) * sizes[j]
    return lies


def _named(given: Watched, site: Site, share: float, rng: np.random.Generator, lies: Floats) -> Bools:
    """Mask of the meters named in one trial."""
    design = given.design
    frame = _world(given, site, share, rng)
    state, onset = monitor.init(design, 0.0), given.settling + QUIET
    named = np.zeros(lies.size, dtype=np.bool_)
    for tick in range(onset + _LYING):
        state, _, verdict = monitor.step(design, state, frame(tick, lies if tick >= onset else 0.0 * lies))
        named |= verdict.suspects
    return named


def _world(
    given: Watched, site: Site, share: float, rng: np.random.Generator
) -> Callable[[int, Floats], Frame]:
    """Frames of a feeder in equilibrium, with fixed errors of true powers, busbar and meters."""
    front, loads = given.design.front, site.loads
    doubt = front.doubt
    accuracy, own = site.accuracy, site.droop.customer
    draw = _uniform if rng.integers(2) else np.random.Generator.standard_normal
    p = -share * loads.load_peak
    q = 0.5 * (loads.tan_min + loads.tan_max) * p
    off_p, off_q = _errors(doubt, draw, rng)
    x = np.zeros(own.size)
    for _ in range(_SETTLING):
        injected = q + off_q + np.bincount(own, weights=x, minlength=q.size)
        v2 = site.feeder.bus_voltages(p + off_p, injected, 1.0, steps=3)[site.feeder.bus]
        x = 0.5 * x + 0.5 * site.droop(site.droop.vbar**2 - v2[own])
    v = np.sqrt(v2[site.meters]) * (1.0 + accuracy.class_fraction * rng.uniform(-1.0, 1.0, site.meters.size))
    busbar = (1.0 + front.busbar / 2.0 * draw(rng, site.feeder.busbar_places().stop)) ** 2
    root3 = np.sqrt(3.0)

    def frame(tick: int, lies: Floats) -> Frame:
        reading = v + accuracy.jitter * rng.standard_normal(v.size)
        step = np.maximum(accuracy.resolution, 1e-9)
        reading = np.round(reading / step) * step
        return Frame(
            t=(tick + 1) * front.step_s,
            y=reading**2 + lies,
            seen=np.ones(v.size, dtype=np.bool_),
            v0_squared=float(busbar.mean()),
            p=p,
            p_error=root3 * doubt.p,
            q=q,
            q_error=root3 * doubt.q,
            q_net=np.full(q.size, np.nan),
            q_net_error=np.zeros(q.size),
            v0_phases=busbar if busbar.size > 1 else None,
        )

    return frame


def _errors(
    doubt: LoadDoubt, draw: Callable[[np.random.Generator, int], Floats], rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Errors of the powers, pu, (N,) each."""
    own = [
        np.sqrt(1.0 - common) * draw(rng, std.size) + np.sqrt(common) * draw(rng, 1)
        for std, common in ((doubt.p, doubt.common_p), (doubt.q, doubt.common_q))
    ]
    if np.any(doubt.together):
        level = np.sqrt(doubt.together) * draw(rng, 1)
        own = [np.sqrt(1.0 - doubt.together) * each + level for each in own]
    return doubt.p * own[0], doubt.q * own[1]


def _uniform(rng: np.random.Generator, size: int) -> Floats:
    return np.asarray(np.sqrt(3.0) * rng.uniform(-1.0, 1.0, size))


HIDDEN, NAMED = (0.5, 1.0), (1.0, 1.2)  # factors on the sizes of attacks of each kind
NOTHING = 1e-6  # numerical error of a solver for zero, V


def promised(site: Site, found: Detectable, *, share: float = SHARE) -> tuple[AttackClass, ...]:
    """Attacks of the sizes of `detectable`, for a campaign.

    The feeder has the campaign's errors of loads and meters. For M = 1 there are only attacks on one meter.
    Kinds without an attack of guaranteed outcome are left out, and kinds where a meter has no size.

    Returns hidden_alone, hidden: one meter, and M meters in the worst collusion of this size; no device is to
        be named.
    Returns named_alone, named: one meter, and any M meters, each by its size; all are to be named.
    """
    most, alone = found.max_attacked, (1,)
    kinds = [
        AttackClass(
            "hidden_alone", AttackKind.BIAS, HIDDEN, _volts(found, "hidden_alone"), (), alone, Promise.HIDDEN
        ),
        AttackClass(
            "named_alone", AttackKind.BIAS, NAMED, _volts(found, "named_alone"), (), alone, Promise.NAMED
        ),
    ]
    if most > 1:
        worst = _collusions(site, found, share)
        kinds += [
            AttackClass("hidden", AttackKind.BIAS, HIDDEN, (), worst, (most,), Promise.HIDDEN),
            AttackClass("named", AttackKind.BIAS, NAMED, _volts(found, "named"), (), (most,), Promise.NAMED),
        ]
    return tuple(
        kind for kind in kinds if (any(kind.volts) or kind.together) and np.isfinite(kind.volts).all()
    )


def earliest_s(site: Site, *, share: float = SHARE) -> float:
    """Time after the start of the monitor from which on attacks are those of the study, s.

    The observer of the inverters has settled, and `QUIET` further readings are honest.
    """
    given = watched(site, share=share)
    return (given.settling + QUIET) * given.step_s


def _volts(found: Detectable, column: str) -> tuple[float, ...]:
    return tuple(float(volt) for volt in found.meters[column])


def _collusions(site: Site, found: Detectable, share: float) -> tuple[tuple[float, ...], ...]:
    """Attacks on all meters, V: for each meter the worst hidden one with this meter in it."""
    given, p = watched(site, share=share), site.meters.size
    tests = given.tests(given.learned)
    worst = [hidden_attack(tests, given, j, found.max_attacked, found.risk) for j in range(p)]
    base = site.customer_volt[site.meters]
    volts = [np.sign(lies) * volts_of_lie(base, np.abs(lies)) for lies in worst]
    volts = [np.where(np.abs(row) > NOTHING, row, 0.0) for row in volts]
    return tuple(tuple(row.tolist()) for row in volts if row.any())

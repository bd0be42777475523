"""Sizes of attacks that stay undetected, are found and are named, in volts; resulting estimation errors.

The sizes are those of the statistical core, the estimator `modal`. References: docs/theory-studies.md,
sections 3, 5 and 7.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import count, islice
from typing import Any

import numpy as np
import pandas as pd

from feeders.format.tables import FeederTables
from feeders.model.site import Site, from_tables
from feeders.registry import MODAL, design
from feeders.studies.operating import SHARE, box, operating_frame, volts_of_lie
from feeders.studies.running import Here, Progress, Runner, Where, cores, run_pieces
from feeders.studies.unobservable import CurvePositions
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, Problem, raise_if_any
from gridsec.estimators.front.state import settling_s
from gridsec.estimators.modal import monitor, rivals
from gridsec.estimators.modal.doubts import Unknown
from gridsec.estimators.modal.monitor import ModalDesign
from gridsec.interface import Frame
from gridsec.planning.collusion import Corridor, furthest
from gridsec.planning.detectability import (
    AGES,
    HONEST,
    INITIAL,
    LONGEST_S,
    QUIET,
    SINCE,
    Known,
    MonitorTests,
    NamedSizes,
    StepTests,
    Threshold,
    hidden_norm,
    hidden_step,
    known,
    noticed,
    step_tests,
)
from gridsec.planning.stealthy_attacks import ErrorBox, largest_lie, worst_error

__all__ = ["Detectable", "Watched", "detectable", "hidden_attack", "watched", "workers"]

RISK = 1e-3  # probability at one moment that honest errors decide otherwise
HOURS = 3  # frames, an hour apart, after which the observer of the inverters has settled
SLOWEST = 600  # largest number of readings in which the observer settles
MANY = 50  # number of meters from which on several processes are faster than one


@dataclass(frozen=True, slots=True, eq=False)
class Detectable:
    """Result of `detectable`. All sizes are voltages at nominal voltage, V."""

    feeder: str
    digest: str
    max_attacked: int
    risk: float
    # One row for each meter, `alone` or in collusion with M - 1 others of the attacker's choice.
    # Before fixed errors are learned, for an attack that begins after `QUIET` honest readings:
    # - `hidden_alone`, `hidden`: up to this size no meter is suspected or named at a moment, with probability
    #   `1 - risk`; also once errors are learned;
    # - `noticed_alone`, `noticed`: beyond this size the attack is detected at its reading number `SINCE`,
    #   with probability `1 - risk`;
    # - `named_alone`, `named`: beyond this size the search names the meter then; simulated, not proved;
    # - `undetected_initial`, `found_initial` and both `_alone`: as `undetected` and `found`, for an attack
    #   that begins with the first reading: fixed errors are known by their class only.
    # In worst cases:
    # - `fits_alone`, `fits`: the largest attack that is consistent with an honest feeder: no test without
    #   false alarms is sure to detect it; every larger one is inconsistent;
    # - `identified_alone`, `identified`: for every larger attack, all explanations by at most M meters accuse
    #   this meter.
    # Once fixed errors are learned:
    # - `undetected_alone`, `undetected`: the largest attack that stays CLEAN, with the part `ROOM` of every
    #   limit left to honest residuals;
    # - `found_alone`, `found`: every larger attack exceeds a limit by this part;
    # - `unavoidable_alone`, `unavoidable`: no test with the same rate of false alarms detects this size, by
    #   the meters of `undetected`, more often than every second time.
    meters: pd.DataFrame
    # One row for each customer: `error`, the largest error of the estimate under M manipulated meters that
    # are not noticed before errors are learned; `error_fits`, the largest distance of two voltages that are
    # consistent with the same readings; `error_undetected`, `error_found` and `error_unavoidable`: errors by
    # attacks of these sizes once errors are learned; `error_undetected_initial`, `error_found_initial`: by
    # attacks that begin with the first reading.
    customers: pd.DataFrame
    share: float = SHARE

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name."""
        return {"meters": self.meters, "customers": self.customers}


def detectable(
    site: Site,
    *,
    max_attacked: int,
    share: float = SHARE,
    risk: float = RISK,
    runner: Runner | None = None,
    journal: Where = None,
    progress: Progress | None = None,
) -> Detectable:
    """Find the smallest attacks that are named for sure, and the largest that stay unnoticed.

    Inverters are in their deadbands. The result is the same for every runner.

    max_attacked: M: largest number of manipulated meters.
    share: load relative to its peak, the same for all, 1.
    risk: probability that honest errors exceed the monitor's limits.
    Raises NotObservable, DesignInfeasible if the feeder cannot be monitored; ValueError if `max_attacked`,
        `share` or `risk` is out of range; OtherStudy if the journal is that of another study; InUse if
        another process writes the journal.
    """
    p = site.meters.size
    checks = (
        (1 <= max_attacked <= p, "out-of-range", f"max_attacked is {max_attacked}; it must be from 1 to {p}"),
        (0.0 < risk < 1.0, "out-of-range", f"risk is {risk}; it must be between 0 and 1"),
        (0.0 <= share < math.inf, "negative", f"share is {share}; it must be finite and not negative"),
    )
    raise_if_any(Problem(code, text) for right, code, text in checks if not right)
    subject = {
        "study": "detectable",
        "digest": site.digest,
        "max_attacked": max_attacked,
        "share": share,
        "risk": risk,
    }
    asked = site.tables, max_attacked, share, risk
    given = _Given.of(site, *asked[1:])  # errors of the arguments occur here, not in a worker
    here = runner is None or isinstance(runner, Here)
    rows = run_pieces(
        journal,
        subject,
        [*(f"meter|{j}" for j in range(p)), *(f"customer|{i}" for i in range(site.feeder.bus.size))],
        partial(_row, given) if here else partial(_worked, *asked),
        runner=runner or Here(),
        progress=progress,
    )
    meters, customers = pd.DataFrame(rows[:p]), pd.DataFrame(rows[p:])
    return Detectable(site.feeder.name, site.digest, max_attacked, risk, meters, customers, share)


def workers(site: Site, count: int | None) -> Runner:
    """Fastest runner for a feeder's study: `count` processes; by default all cores, from MANY meters on."""
    return Here() if count is None and site.meters.size < MANY else cores(count)


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """Monitor `modal` of a feeder at the operating point of a study. n places, p meters."""

    design: ModalDesign
    unknown: Unknown | None  # directions that each frame leaves unknown; None for none
    model: Floats  # (N,) error of the model at each customer, squared pu
    settling: int  # readings after a start until no frame leaves more unknown: inverters have settled

    @property
    def step_s(self) -> float:
        """Interval of the readings, s."""
        return self.design.front.step_s

    @property
    def alarms_per_year(self) -> float:
        """Permitted false alarms in a year."""
        return self.design.options.alarms_per_year

    def known(self, ticks: int, *, learned: bool = False) -> Known:
        """Filter after some honest readings, and after the time of commissioning before them."""
        learned_s = self.design.options.commission_s if learned else 0.0
        return known(self.design.core, ticks, self.step_s, learned_s=learned_s, unknown=self.unknown)

    def steps(self, before: Known, ages: tuple[int, ...], *, jump: float = 0.0) -> tuple[StepTests, ...]:
        """Tests of a step at some ages, within an hour."""
        last = max(1, int(LONGEST_S / self.step_s))
        some = sorted({min(age, last) for age in ages})
        return step_tests(self.design.core, before, some, self.step_s, jump=jump)

    def tests(self, steps: tuple[StepTests, ...]) -> MonitorTests:
        """Tests of all ages together."""
        return MonitorTests.of(steps, self.alarms_per_year, self.step_s)

    @property
    def learned(self) -> tuple[StepTests, ...]:
        """Tests of a step once fixed errors are learned."""
        return self.steps(self.known(HONEST, learned=True), AGES)

    @property
    def initial(self) -> tuple[StepTests, ...]:
        """Tests of a step from the first reading on."""
        return self.steps(self.known(0), INITIAL)


def watched(site: Site, *, share: float = SHARE) -> Watched:
    """Monitor of a feeder with the settings of its files, and what its frames leave unknown.

    Raises NotObservable, DesignInfeasible if the feeder cannot be monitored.
    """
    tables = site.tables
    settings = replace(tables.meta.monitor, estimator=MODAL)
    made = design(from_tables(replace(tables, meta=replace(tables.meta, monitor=settings)))).design
    p = -share * site.loads.load_peak
    q = 0.5 * (site.loads.tan_min + site.loads.tan_max) * p
    model = site.feeder.model_error_bound(p, q, 1.0)
    if not np.isfinite(model[site.meters]).all():
        raise DesignInfeasible(
            f"sizes of {site.feeder.name}'s monitor",
            f"no power flow at {share:g} of the peak",
            code="not-converged",
        )
    frame, phases = operating_frame(site, share), site.feeder.busbar_places().stop
    if phases > 1:
        frame = replace(frame, v0_phases=np.ones(phases))
    *_, unknown = islice(_unknown(made, frame, LONGEST_S), HOURS)
    least, each = _directions(unknown), _unknown(made, frame, settings.tick_s)
    settled = (k for k, more in enumerate(islice(each, SLOWEST)) if _directions(more) <= least)
    settling = max(next(settled, SLOWEST), round(settling_s(made.front) / settings.tick_s))
    return Watched(made, unknown, model, settling)


def _unknown(made: ModalDesign, frame: Frame, step_s: float) -> Iterator[Unknown | None]:
    """Directions that equal frames leave unknown, one after another from the start of the monitor on."""
    state = monitor.init(made, 0.0)
    for k in count():
        state, _, _ = monitor.step(made, state, replace(frame, t=k * step_s))
        yield state.unknown


def _directions(unknown: Unknown | None) -> int:
    return 0 if unknown is None else unknown.factor.size


def hidden_attack(tests: MonitorTests, watch: Watched, meter: int, liars: int, risk: float) -> Floats:
    """Largest attack on a meter that stays hidden, with M - 1 others, (p,), squared pu."""
    norm = hidden_norm(watch.alarms_per_year, watch.step_s, risk)
    return hidden_step(tests.information, meter, liars, norm)


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """Common data of all rows. Corridors are by the number of manipulated meters."""

    site: Site
    watch: Watched
    max_attacked: int
    risk: float
    worst: ErrorBox
    named: NamedSizes
    unnoticed: Mapping[int, Corridor]
    weights: Floats  # (ages, n, p) change of the estimate per step, before errors are learned
    spread: Floats  # (n,) honest error of the estimate then, squared pu
    learned: tuple[MonitorTests, Mapping[int, Corridor]]
    initial: tuple[MonitorTests, Mapping[int, Corridor]]

    @classmethod
    def of(cls, site: Site, max_attacked: int, share: float, risk: float) -> _Given:
        watch, numbers = watched(site, share=share), (1, max_attacked)
        core, few = watch.design.core, watch.known(QUIET)
        steps = watch.steps(few, (1, SINCE))
        (jumped,) = watch.steps(few, (SINCE,), jump=max(rivals.jumps(core.modes)))
        spread = np.sqrt(watch.known(QUIET + SINCE).variance(core))

        def both(steps: tuple[StepTests, ...]) -> tuple[MonitorTests, Mapping[int, Corridor]]:
            tests = watch.tests(steps)
            return tests, {count: tests.corridor(count) for count in numbers}

        return cls(
            site,
            watch,
            max_attacked,
            risk,
            box(site, share=share, curves=CurvePositions.DEADBAND),
            NamedSizes(core, steps[-1], jumped, risk),
            {
                count: noticed(steps[-1], count, risk=risk, error=watch.model[site.meters])
                for count in numbers
            },
            np.stack([each.weights for each in steps]),
            math.sqrt(2.0 * math.log(2.0 / risk)) * spread + float(watch.model.max()),
            both(watch.learned),
            both(watch.initial),
        )


@lru_cache(maxsize=1)
def _prepared(tables: FeederTables, max_attacked: int, share: float, risk: float) -> _Given:
    """Common data of all rows, computed once in each process."""
    return _Given.of(from_tables(tables), max_attacked, share, risk)


def _worked(tables: FeederTables, max_attacked: int, share: float, risk: float, piece: int) -> dict[str, Any]:
    """One row in any process."""
    return _row(_prepared(tables, max_attacked, share, risk), piece)


def _row(given: _Given, piece: int) -> dict[str, Any]:
    """Row of a piece: the meters first, then the customers."""
    p = given.site.meters.size
    return _meter(given, piece) if piece < p else _customer(given, piece - p)


def _meter(given: _Given, j: int) -> dict[str, Any]:
    site = given.site
    unit = (np.arange(site.meters.size) == j).astype(np.float64)
    customer = int(site.meters[j])
    base = site.customer_volt[customer]
    row: dict[str, Any] = {
        "meter": site.meter_ids[j],
        "customer": site.feeder.customers[customer],
        "bus": site.feeder.buses[int(site.feeder.bus[customer])],
    }
    both = ("_alone", 1), ("", given.max_attacked)
    fits = {
        count: largest_lie(given.worst, j, count).bound
        for count in sorted({times * each for times in (1, 2) for _, each in both})
    }
    (learned, late), (initial, early) = given.learned, given.initial
    for suffix, liars in both:
        unnoticed = furthest(given.unnoticed[liars], unit, must=j).bound
        first = initial.threshold(early[liars], unit, must=j)
        sizes = {
            "hidden": float(hidden_attack(learned, given.watch, j, liars, given.risk)[j]),
            "noticed": unnoticed,
            "named": given.named(j, liars, unnoticed),
            "fits": fits[liars],
            "identified": fits[2 * liars],
            **_sizes(learned.threshold(late[liars], unit, must=j)),
            "undetected_initial": first.undetected,
            "found_initial": first.found,
        }
        row |= {f"{name}{suffix}": _volts(base, size) for name, size in sizes.items()}
    return row


def _customer(given: _Given, i: int) -> dict[str, Any]:
    site, liars = given.site, given.max_attacked
    bus, base = int(site.feeder.bus[i]), site.customer_volt[i]
    # At the busbar the monitor shows the reading of its meter.
    own = float(bus >= site.feeder.busbar_places().stop)
    moved = furthest(given.unnoticed[liars], own * given.weights[:, bus]).bound
    (learned, late), (initial, early) = given.learned, given.initial
    sizes = _sizes(learned.threshold(late[liars], own * learned.quiet.weights[bus]))
    first = initial.threshold(early[liars], own * initial.quiet.weights[bus])
    sizes |= {"undetected_initial": first.undetected, "found_initial": first.found}
    return {
        "customer": site.feeder.customers[i],
        "bus": site.feeder.buses[bus],
        "error": _volts(base, moved + given.spread[bus]),
        "error_fits": _volts(base, worst_error(given.worst, i, liars).bound),
        **{f"error_{name}": _volts(base, size) for name, size in sizes.items()},
    }


def _volts(base: float, size: float) -> float:
    """A size in volts at nominal voltage; infinite where there is none."""
    return float(volts_of_lie(base, size)) if math.isfinite(size) else math.inf


def _sizes(threshold: Threshold) -> dict[str, float]:
    """Sizes of a threshold by column, squared pu."""
    return {name: getattr(threshold, name) for name in ("undetected", "found", "unavoidable")}

"""Plant, options and checks that estimators share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Ints
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators.thresholds import ErrorModel, error_model
from gridsec.grid.droop import Droop
from gridsec.grid.meter import MeterAccuracy
from gridsec.grid.network import LinDistFlow, Network


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """Physical feeder of an estimator. N customers, m inverters, p meters.

    Raises ValueError with every problem found; `check_plant` checks that meters, feeder and accuracy are
        consistent.
    """

    feeder: Network  # the feeder with its customers: radial, meshed or in three phases
    droop: Droop  # the customers' inverters and their curves
    meters: Ints  # (p,) customer of each voltage meter; at most one meter per customer
    accuracy: MeterAccuracy  # accuracy of the meters by their data sheets
    # DistFlow fixed-point steps that correct LinDistFlow for branch losses; 0 leaves it linear
    loss_correction: int = 1

    @property
    def meter_names(self) -> tuple[str, ...]:
        """Customer of each meter by name, (p,)."""
        return tuple(self.feeder.customers[c] for c in self.meters)

    def __post_init__(self) -> None:
        meters, problems = np.asarray(self.meters), []
        if meters.ndim != 1 or (meters.size and meters.dtype.kind not in "iu"):
            problems.append(Problem("not-integer", "meters must be whole numbers, one for each meter"))
        if not _whole(self.loss_correction, 0):
            problems.append(
                Problem(
                    "not-integer",
                    f"loss_correction is {self.loss_correction}; it must be a whole number from 0 on",
                )
            )
        raise_if_any(problems)


@dataclass(frozen=True, slots=True)
class Options:
    """Tuning parameters.

    Raises ValueError with every problem found.
    """

    # Jitter allowance of an unmanipulated reading in standard deviations. At 4, one reading in 16 000 exceeds
    # it, which matters only for a meter at the limit of its class.
    sigmas: float = 4.0
    confirm: int = 2  # readings above the threshold until a meter is named
    # Consecutive readings below it until a meter is neither named nor suspect. An attack on at least every
    # `release`-th reading is named; docs/theory-detection.md, section 5.
    release: int = 6
    # the verdict is SETTLING until the remaining effect of the unknown initial state is below this fraction
    # of every threshold
    settled: float = 0.1
    # sets count as equal if their disagreements pi differ by at most this fraction of the largest saturation
    # limit; residuals decide between them
    tie: float = 1e-6
    widest: float = 0.1  # largest threshold of a meter that is judged, squared pu: 0.1 is 5 % of the voltage
    # range of valid squared busbar voltages, pu; a reading outside it is not used
    v2_limits: tuple[float, float] = (0.25, 2.25)

    def __post_init__(self) -> None:
        raise_if_any(
            [
                *(
                    Problem(
                        "negative",
                        f"{name} is {getattr(self, name)}; it must be a finite number that is not negative",
                    )
                    for name in ("sigmas", "tie")
                    if not 0.0 <= getattr(self, name) < np.inf
                ),
                *(
                    Problem(
                        "not-integer", f"{name} is {getattr(self, name)}; it must be a whole number from 1 on"
                    )
                    for name in ("confirm", "release")
                    if not _whole(getattr(self, name), 1)
                ),
                *judging_problems(self.settled, self.widest, self.v2_limits),
            ]
        )


def usual_options(step_s: float) -> Options:
    """Default options for an interval between frames, s: above 30 s, four readings clear a meter, not six."""
    return Options() if step_s <= 30.0 else Options(release=4)


def judging_problems(settled: float, widest: float, v2_limits: tuple[float, float]) -> list[Problem]:
    """Problems of the options `settled`, `widest` and `v2_limits`, see `Options`."""
    problems = []
    if not 0.0 < settled <= 1.0:
        problems.append(
            Problem(
                "out-of-range", f"settled is {settled}; it must be a part of a threshold, above 0 and up to 1"
            )
        )
    if not widest > 0.0:
        problems.append(Problem("not-positive", f"widest is {widest}; it must be a positive number"))
    if not 0.0 <= v2_limits[0] < v2_limits[1]:
        problems.append(
            Problem(
                "order", f"v2_limits is {v2_limits}; it must be two ascending numbers that are not negative"
            )
        )
    return problems


def _whole(value: object, least: int) -> bool:
    """True for a whole number that is not below `least`."""
    return isinstance(value, int | np.integer) and int(value) >= least


def check_plant(plant: Plant, *, max_attacked: int, step_s: float, more: Iterable[Problem] = ()) -> None:
    """Refuse a plant that no estimator supports, before anything is computed.

    max_attacked: M, largest number of simultaneously manipulated meters.
    step_s: expected interval between frames, s.
    Raises ValueError with every problem: meters at no customer, two at one, accuracy of other meters, numbers
        out of range.
    """
    meters, customers, problems = np.asarray(plant.meters), plant.feeder.bus.size, []
    nowhere = meters[(meters < 0) | (meters >= customers)]
    if nowhere.size:
        problems.append(
            Problem("unknown-index", f"meters {nowhere.tolist()} are at no customer: there are {customers}")
        )
    if np.unique(meters).size != meters.size:
        problems.append(Problem("duplicate", "two meters at one customer: combine them before"))
    if plant.accuracy.class_fraction.shape != meters.shape:
        given = plant.accuracy.class_fraction.size
        problems.append(Problem("shape", f"accuracy is given for {given} meters of {meters.size}"))
    if not _whole(max_attacked, 0):
        problems.append(
            Problem(
                "not-integer",
                f"max_attacked is {max_attacked}; it must be a whole number that is not negative",
            )
        )
    if not (np.isfinite(step_s) and step_s > 0):
        problems.append(
            Problem("not-positive", f"step_s is {step_s}; it must be a positive number of seconds")
        )
    raise_if_any([*problems, *more])


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorContext:
    """Plant with its derived models, common to all estimators of a feeder."""

    plant: Plant
    model: LinDistFlow  # linear power flow of the plant
    errors: ErrorModel  # propagation of errors
    options: Options
    max_attacked: int  # M
    uses_reported_q: bool  # True if metered net reactive power replaces that of load and inverter


def estimator_context(
    plant: Plant, *, max_attacked: int, options: Options | None = None, uses_reported_q: bool = False
) -> EstimatorContext:
    """Compute the setting of a plant; `options` are the defaults if None."""
    model = plant.feeder.linear()
    errors = error_model(plant.droop, model, plant.meters, max_attacked)
    return EstimatorContext(
        plant, model, errors, Options() if options is None else options, max_attacked, uses_reported_q
    )

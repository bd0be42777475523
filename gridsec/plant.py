"""What is watched, what was prepared for it, and what is carried from frame to frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gridsec import bank as banks
from gridsec.accuracy import MeterAccuracy
from gridsec.arrays import Floats, Ints
from gridsec.certificates import Certificate
from gridsec.detect import ErrorBound, ErrorModel, error_model
from gridsec.droop import Droop
from gridsec.errors import Problem, refuse
from gridsec.feeder import LinDistFlow
from gridsec.judge import Tally
from gridsec.lure import Lure
from gridsec.network import Network, linear
from gridsec.online import Estimate, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """The feeder as it stands in the street. N customers, m inverters, p meters.

    Attributes
    ----------
    feeder
        The feeder with its customers: radial, meshed or in three phases.
    droop
        The customers' inverters and their curves.
    meters : (p,)
        Index of the customer at which each voltage meter sits; at most one meter per customer.
    accuracy
        What the meters promise.
    loss_correction
        DistFlow fixed-point steps that correct LinDistFlow for branch losses; 0 leaves it linear.

    Raises
    ------
    ValueError
        With every problem found; whether meters, feeder and accuracy fit is for `check_plant`.
    """

    feeder: Network
    droop: Droop
    meters: Ints
    accuracy: MeterAccuracy
    loss_correction: int = 1

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
        refuse(problems)


@dataclass(frozen=True, slots=True)
class Options:
    """Numbers that decide; none is hidden.

    Attributes
    ----------
    sigmas
        Standard deviations of jitter that an honest reading may be off. One reading in 16 000 is
        further off at 4, and then only matters for a meter at the very limit of its class.
    confirm
        Readings above the threshold before a meter is named.
    release
        Readings in a row below it before a meter is neither named nor suspected any more. A lie on at
        least every `release`-th reading is named; docs/theory-detection.md, section 5.
    settled
        The verdict is SETTLING until what is left of the unknown initial state is less than this part
        of every threshold.
    tie
        Sets whose disagreement pi differs by no more than this part of the largest saturation limit
        count as equal; residuals decide between them.
    widest
        A meter whose threshold is above this cannot be judged, squared pu: 0.1 is 5 % of the voltage.
    v2_limits
        Squared voltages outside these are no supply: a busbar reading there is not used, pu.

    Raises
    ------
    ValueError
        With every problem found.
    """

    sigmas: float = 4.0
    confirm: int = 2
    release: int = 6
    settled: float = 0.1
    tie: float = 1e-6
    widest: float = 0.1
    v2_limits: tuple[float, float] = (0.25, 2.25)

    def __post_init__(self) -> None:
        refuse(
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


def judging_problems(settled: float, widest: float, v2_limits: tuple[float, float]) -> list[Problem]:
    """What is wrong with the numbers that say when a verdict can be given at all.

    Parameters
    ----------
    settled, widest, v2_limits
        As in `Options`.
    """
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
    """Whether a value is a whole number, and not below the least."""
    return isinstance(value, int | np.integer) and int(value) >= least


def check_plant(plant: Plant, *, max_attacked: int, step_s: float, more: Iterable[Problem] = ()) -> None:
    """Refuse what no estimator can watch, before anything is computed.

    Parameters
    ----------
    plant
        What is to be watched.
    max_attacked
        M, how many meters may be manipulated at the same time.
    step_s
        Expected interval between frames, s.
    more
        Further problems that the caller has found.

    Raises
    ------
    ValueError
        With every problem: meters at no customer, two at one, accuracy of other meters, numbers out of range.
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
    refuse([*problems, *more])


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What every estimator of a feeder needs to make sense of a frame.

    Attributes
    ----------
    plant
        What is watched.
    model
        Its linear power flow.
    errors
        How errors travel.
    options
        The numbers that decide.
    max_attacked
        M.
    believes_q
        Whether metered net reactive power replaces the load's and the inverter's.
    """

    plant: Plant
    model: LinDistFlow
    errors: ErrorModel
    options: Options
    max_attacked: int
    believes_q: bool


def setting(
    plant: Plant, *, max_attacked: int, options: Options | None = None, believes_q: bool = False
) -> Setting:
    """Put a plant's setting together.

    Parameters
    ----------
    plant, max_attacked, options, believes_q
        As in `Setting`; the options' defaults by default.
    """
    model = linear(plant.feeder)
    errors = error_model(plant.droop, model, plant.meters, max_attacked)
    return Setting(plant, model, errors, Options() if options is None else options, max_attacked, believes_q)


@dataclass(frozen=True, slots=True, eq=False)
class MonitorDesign:
    """Everything that is prepared offline.

    Attributes
    ----------
    plant
        What is watched.
    model
        Its linear power flow.
    bank
        The observers.
    errors
        How errors travel.
    certificate
        Why the observers converge, for all sensor sets at once.
    proven
        The system the certificate is about: the closed loop, or one that majorises all observers.
    step_s
        Expected interval between frames, s.
    options
        The numbers that decide.
    """

    plant: Plant
    model: LinDistFlow
    bank: banks.Bank
    errors: ErrorModel
    certificate: Certificate
    proven: Lure
    step_s: float
    options: Options

    @property
    def setting(self) -> Setting:
        """What a frame is cleaned with."""
        return Setting(
            self.plant,
            self.model,
            self.errors,
            self.options,
            self.bank.sets.max_attacked,
            self.bank.direct,
        )

    @property
    def observers(self) -> int:
        """How many observers run."""
        return len(self.bank.masks)


@dataclass(frozen=True, slots=True, eq=False)
class MonitorState:
    """What is carried from frame to frame.

    Attributes
    ----------
    t
        Time of the last frame that was used, s; of `init` before the first one.
    valid
        Whether the certificate survived its verification.
    bank
        The observers; None before the first frame.
    x : (m,)
        Last selected estimate of the injections, pu.
    z : (m,)
        Its z at the inverters, pu.
    spread : (m,)
        How far it may be from that of a liar-free observer, pu.
    bound, level
        Bounds on the observers' error, and the level they stayed below during the last step.
    settled
        Whether the unknown initial state is forgotten.
    tally
        Who was above the threshold for how long, and who is named.
    v0_squared
        Last squared busbar voltage, pu; in three phases (3,).
    last
        The last estimate and verdict, for frames that cannot be used; None before the first one.
    """

    t: float
    valid: bool
    bank: banks.BankState | None
    x: Floats
    z: Floats
    spread: Floats
    bound: ErrorBound
    level: ErrorBound
    settled: bool
    tally: Tally
    v0_squared: Floats | float
    last: tuple[Estimate, Verdict] | None

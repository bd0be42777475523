"""What is watched, what was prepared for it, and what is carried from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

from gridsec import bank as banks
from gridsec.accuracy import MeterAccuracy
from gridsec.arrays import Floats, Ints
from gridsec.certificates import Certificate
from gridsec.detect import ErrorBound, ErrorModel, error_model
from gridsec.droop import Droop
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
    """

    feeder: Network
    droop: Droop
    meters: Ints
    accuracy: MeterAccuracy
    loss_correction: int = 1


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
    """

    sigmas: float = 4.0
    confirm: int = 2
    release: int = 6
    settled: float = 0.1
    tie: float = 1e-6
    widest: float = 0.1
    v2_limits: tuple[float, float] = (0.25, 2.25)


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

"""Offline design of the front end.

References
----------
docs/theory-front.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack
from scipy.special import ndtri

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible, NotObservable, Problem, raise_if_any
from gridsec.estimators.detection import curve_mismatch
from gridsec.estimators.front.attack_kind import KindReferences, LoadTraces, look_interval
from gridsec.estimators.front.posterior import UNMETERED, LoadDoubt, Prior, injection_doubt, voltage_prior
from gridsec.estimators.front.reading_history import repeat_limits
from gridsec.estimators.plant import Plant, check_plant, judging_problems
from gridsec.grid.devices import ToldError, busbar_error, steady_rounding
from gridsec.grid.network import Network, Power, Sensitivities
from gridsec.interface import USABLE_OFFSET_S
from gridsec.observers.certificates import Certificate, certify, verify
from gridsec.observers.lmi import contraction
from gridsec.observers.lure import Lure, close_loop

YEAR_S = 365.25 * 86400.0
"""Julian year, s."""


@dataclass(frozen=True, slots=True)
class FrontOptions:
    """Tuning parameters.

    Attributes
    ----------
    alarms_per_year
        False alarms that the feeder may raise by chance in a year.
    enough
        Least part of `commission_s` with which a meter is learned once another one is ready.
    release
        Successive ticks of agreement after which the busbar's meter is trusted again.
    suspect
        Probability that one search suspects any honest meter; it limits the observable inverters.
    lower
        Factor on `sigmas` below which the busbar's meter agrees with the others.
    like
        Largest likelihood ratio of the best explanation to a reported one.
    hidden_power
        Least standard deviation of a false power, pu; a larger claim counts as its own deviation.
    commission_s
        Time over which the meters' fixed errors are learned, s; 0 for never.
    stability
        Part of its accuracy class by which an honest meter may change after that.
    unread_std_percent
        Largest standard deviation of the voltage at a metered customer without a power reading for which the
        verdict can be CLEAN, % of nominal.
    largest_offset_s
        Largest clock offset of a usable reading, s; a quarter of a tick where that is longer.
    widest, v2_limits, settled
        As in `gridsec.estimators.plant.Options`; `v2_limits` bound readings (`measurements.impossible`).

    Raises
    ------
    ValueError
        With every problem found.
    """

    alarms_per_year: float = 1.0
    enough: float = 0.8
    release: int = 6
    suspect: float = 0.05
    lower: float = 0.6
    like: float = 100.0
    hidden_power: float = 0.05
    commission_s: float = 86400.0
    stability: float = 0.1
    unread_std_percent: float = 0.5
    largest_offset_s: float = USABLE_OFFSET_S
    widest: float = 0.1
    v2_limits: tuple[float, float] = (0.25, 2.25)
    settled: float = 0.1

    def __post_init__(self) -> None:
        positive, zero = (
            Problem("not-positive", "must be a positive number"),
            Problem("negative", "must be a finite number that is not negative"),
        )
        wanted = [
            ("alarms_per_year", 0.0 < self.alarms_per_year < np.inf, positive),
            ("enough", 0.0 < self.enough <= 1.0, Problem("out-of-range", "must be above 0 and up to 1")),
            ("release", self.release >= 1, Problem("out-of-range", "must be at least 1")),
            ("suspect", 0.0 < self.suspect < 1.0, Problem("out-of-range", "must be between 0 and 1")),
            ("lower", 0.0 < self.lower <= 1.0, Problem("out-of-range", "must be above 0 and up to 1")),
            ("hidden_power", 0.0 < self.hidden_power < np.inf, positive),
            ("like", 1.0 <= self.like < np.inf, Problem("out-of-range", "must be at least 1 and finite")),
            *(
                (name, 0.0 <= getattr(self, name) < np.inf, zero)
                for name in ("commission_s", "stability", "unread_std_percent", "largest_offset_s")
            ),
        ]
        raise_if_any(
            [
                *(
                    Problem(what.code, f"{name} is {getattr(self, name)}; it {what}")
                    for name, sound, what in wanted
                    if not sound
                ),
                *judging_problems(self.settled, self.widest, self.v2_limits),
            ]
        )


@dataclass(frozen=True, slots=True, eq=False)
class FrontDesign:
    """Offline design. N customers, n buses, p meters, m inverters, b busbar phases."""

    plant: Plant  # feeder and inverters
    names: tuple[str, ...]  # (p,) the meters' customers
    loop: Floats  # (m, m) effect of the injections on the inverters' voltages: H of the closed loop
    certificate: Certificate  # convergence of the observer for every trusted set and every switching
    doubt: LoadDoubt  # uncertainty of the powers
    prior: Prior  # resulting prior of the voltages
    injections: Floats  # (N,) standard deviation of the observed injections, pu
    busbar: float  # standard deviation of the squared busbar voltage, squared pu
    busbar_noise: float  # variance of the busbar's reading from tick to tick, squared pu^2
    busbar_ticks: int  # ticks of the mean deviation of a suspect busbar meter
    sigmas: float  # standard deviations within chance, by the rate of false alarms
    white: Floats  # (p,) variance of a squared reading from tick to tick, squared pu^2
    fixed: Floats  # (p,) variance of its fixed error, squared pu^2
    allowed: Floats  # (p,) largest fixed error by the accuracy class, `rounded` included, squared pu
    rounded: Floats  # (p,) largest lasting rounding error, which cannot be learned, squared pu
    busbar_incidence: Floats  # (p, b) 1 where a busbar phase supplies the meter, else 0
    inverter_reach: Floats  # (p,) effect of all inverters between their limits at each meter, squared pu
    meter_of: Ints  # (m,) meter that drives each inverter; -1 for none
    reading_errors: ToldError  # (m,) errors of the readings of the inverters' meters
    mismatch: Floats  # (m,) difference of a real curve, linear in v, from the model's, linear in z, pu
    inverter_undetectable: Bools  # (m,) inverters with a range too small to be detected by the voltages
    references: KindReferences = field(
        repr=False
    )  # references of the kinds of manipulations, and limits of repetition
    max_attacked: int  # largest number of manipulated meters told apart
    max_p: Floats  # (N,) largest possible active power, pu: more would move the voltage beyond all limits
    max_q: Floats  # (N,) largest possible reactive power, pu
    step_s: float  # expected interval between frames, s
    options: FrontOptions = field(repr=False)  # tuning parameters

    @property
    def customers(self) -> int:
        """N."""
        return self.plant.feeder.bus.size

    @property
    def sensitivities(self) -> Sensitivities:
        """Sensitivities of the voltages to every customer's powers."""
        return self.references.traces.sensitivities

    @property
    def observers(self) -> int:
        """One observer for every trusted set."""
        return 1

    @property
    def drives(self) -> Bools:
        """Meters with a reading that drives an inverter, (p,)."""
        out = np.zeros(self.plant.meters.size, dtype=np.bool_)
        out[self.meter_of[self.meter_of >= 0]] = True
        return out

    def most_among(self, meters: int) -> int:
        """Largest number of manipulated meters told apart among those with a reading, at least 1."""
        return max(1, min(self.max_attacked, meters // 3))

    def inverters_of(self, meters: Bools) -> Bools:
        """Inverters with a meter that is one of `meters` (p,), (m,)."""
        return np.asarray((self.meter_of >= 0) & meters[self.meter_of])


def design(
    plant: Plant,
    *,
    doubt: LoadDoubt,
    step_s: float,
    options: FrontOptions | None = None,
    max_attacked: int | None = None,
) -> FrontDesign:
    """Design the front end of a feeder.

    step_s: expected interval between frames, s. max_attacked: largest number of manipulated meters told
    apart; by default a third of the meters.

    Raises NotObservable for fewer than three meters; DesignInfeasible if no certificate holds for the droop
        loop; ValueError as `plant.check_plant`, or if `doubt` is that of other customers.
    """
    options = FrontOptions() if options is None else options
    meters, sensitivities = plant.meters, Sensitivities(plant.feeder)
    _check(plant, doubt, step_s, max_attacked)
    lure, meter_of = close_loop(plant.feeder, plant.droop, meters), _meter_of(plant)
    white, fixed, allowed, rounded = _noise(plant)
    injections = injection_doubt(plant.droop, plant.accuracy, meters, plant.feeder.bus.size)
    busbar = min(busbar_error(plant.accuracy, plant.droop.vbar**2, 2.0) / 2.0, UNMETERED)
    known = voltage_prior(plant.feeder, plant.feeder.bus[meters], doubt, busbar=busbar, inverters=injections)
    sigmas = _sigmas(options.alarms_per_year, plant, step_s)
    return FrontDesign(
        plant=plant,
        names=tuple(plant.feeder.customers[c] for c in meters),
        loop=lure.H,
        certificate=_certificate(lure),
        doubt=doubt,
        prior=known,
        injections=injections,
        busbar=busbar,
        busbar_noise=_busbar_noise(plant),
        busbar_ticks=_ticks(_BUSBAR_MEAN_S, step_s),
        sigmas=sigmas,
        white=white,
        fixed=fixed,
        allowed=allowed,
        rounded=rounded,
        busbar_incidence=plant.feeder.busbar_incidence()[meters],
        inverter_reach=np.abs(lure.C) @ (2.0 * plant.droop.limit),
        meter_of=meter_of,
        mismatch=curve_mismatch(plant.droop),
        reading_errors=ToldError.over(plant.accuracy, meter_of, sigmas),
        inverter_undetectable=_undetectable(
            plant, sensitivities, known, fixed + white / _ticks(_AVERAGED_S, step_s), options.suspect
        ),
        references=_references(plant, sensitivities, options.alarms_per_year, step_s),
        max_attacked=meters.size // 3 if max_attacked is None else max_attacked,
        max_p=_max_power(plant.feeder, Power.ACTIVE),
        max_q=_max_power(plant.feeder, Power.REACTIVE),
        step_s=step_s,
        options=options,
    )


_BUSBAR_MEAN_S = 5.0
"""Time of the mean deviation of a suspect busbar meter, s."""


_AVERAGED_S = 60.0
"""Time over which the voltages must show an inverter's whole range, s."""


def _ticks(time_s: float, step_s: float) -> int:
    """Ticks of a time, at least one."""
    return max(1, round(time_s / step_s))


def _slope(plant: Plant) -> float:
    """Factor from relative voltage errors to squared ones, pu."""
    return 2.0 * _CONVERSION_VOLTAGE * plant.droop.vbar


def _noise(plant: Plant) -> tuple[Floats, Floats, Floats, Floats]:
    """`white`, `fixed`, `allowed` and `rounded` of the design, (p,) each."""
    accuracy, slope = plant.accuracy, _slope(plant)
    rounded = slope * steady_rounding(accuracy)
    white = np.maximum(slope**2 * (accuracy.jitter**2 + accuracy.resolution**2 / 12.0), _LEAST_NOISE)
    fixed = slope**2 * accuracy.class_fraction**2 / 3.0 + 0.5 * rounded**2
    return white, fixed, slope * accuracy.class_fraction + rounded, rounded


def _busbar_noise(plant: Plant) -> float:
    """Variance of the busbar's squared reading from tick to tick, squared pu^2."""
    accuracy = plant.accuracy
    return _slope(plant) ** 2 * (accuracy.busbar_jitter**2 + accuracy.busbar_resolution**2 / 12.0)


_HIDDEN_SIGMAS = 2.0
"""Standard deviations by which chance may hide an effect."""


def _undetectable(
    plant: Plant, sensitivities: Sensitivities, known: Prior, noise: Floats, suspect: float
) -> Bools:
    """Inverters with a range within the limits of the evidence: ``span sqrt(c^T Q c)``."""
    whole: Floats = known.among(np.arange(noise.size))
    whole[np.diag_indices_from(whole)] += noise
    moved = sensitivities.columns(Power.REACTIVE, plant.droop.customer)[known.meters]
    failed = lapack.dpotrf(whole, lower=True, clean=False, overwrite_a=True)[1]
    half, _ = lapack.dtrtrs(whole, moved, lower=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    limit = _HIDDEN_SIGMAS - float(ndtri(0.5 * suspect / noise.size))
    return np.asarray(plant.droop.span * np.sqrt((half * half).sum(axis=0)) <= limit)


_COLLAPSE, _MAX_POWER = 1.0, 1e4
"""Injections that alone change v^2 by more than 1 pu, or exceed 1e4 pu, are impossible."""


def _max_power(feeder: Network, power: Power) -> Floats:
    return np.asarray(_COLLAPSE / np.maximum(2.0 * feeder.self_impedance(power), _COLLAPSE / _MAX_POWER))


_LEAST_NOISE = 1e-12
"""Least variance of a reading, squared pu^2: two perfect meters at one bus make a singular matrix."""


_CONVERSION_VOLTAGE = 1.03
"""Voltage that converts relative meter errors into squared ones, in parts of nominal."""


def _check(plant: Plant, doubt: LoadDoubt, step_s: float, most: int | None) -> None:
    meters, customers = plant.meters, plant.feeder.bus.size
    if meters.size < _FEWEST:
        why = f"{meters.size} meters; at least {_FEWEST} are needed to outvote one"
        raise NotObservable(meters.tolist(), meters.size, why, code="too-few-meters")
    more = []
    if doubt.p.shape != (customers,) or doubt.q.shape != (customers,):
        more.append(
            Problem("shape", f"doubt is given for {doubt.p.size} and {doubt.q.size} customers of {customers}")
        )
    check_plant(plant, max_attacked=0 if most is None else most, step_s=step_s, more=more)


_FEWEST = 3
"""Fewest meters: two contradicting ones cannot be told apart."""


_DECAY_PART = 0.1
"""Decay rate asked of the solver, as a part of the slowest inverter's."""


def _certificate(lure: Lure) -> Certificate:
    """Best closed form of the certificate, or the solver's where none applies; verified."""
    try:
        found = certify(lure)
    except DesignInfeasible:
        found = contraction(lure, rate=_DECAY_PART * float(np.min(-np.diagonal(lure.A))))
    margin = verify(found, lure)
    if not margin > 0:
        raise DesignInfeasible(
            f"{found.kind} certificate", "it fails its verification", margin, code="not-verified"
        )
    return found


_SHARE = 1.0 / 6.0
"""Share of the false alarms of each test of repetition, stuck meters and replays, and of `sigmas`."""


def _sigmas(rate: float, plant: Plant, step_s: float) -> float:
    """Standard deviations that the checks of one tick exceed by chance at `_SHARE` of the rate.

    Each tick tests each meter, each phase of the busbar, and all together.
    """
    tests = plant.meters.size + plant.feeder.busbar_incidence().shape[1] + 1
    tail = min(float(_SHARE * rate * step_s / (YEAR_S * tests)), 0.5)
    return -float(ndtri(tail / 2.0))


def _references(plant: Plant, sensitivities: Sensitivities, rate: float, step_s: float) -> KindReferences:
    """References of the kinds at this feeder's meters."""
    accuracy, slope = plant.accuracy, _slope(plant)
    chance = min(_SHARE * rate * step_s / (plant.meters.size * YEAR_S), 0.5)
    active, reactive = (2.0 * plant.feeder.self_impedance(power)[plant.meters] for power in Power)
    return KindReferences(
        limits=repeat_limits(accuracy.resolution, accuracy.jitter, chance, step_s),
        traces=LoadTraces(sensitivities, plant.feeder.bus[plant.meters]),
        noise=slope**2 * (accuracy.jitter**2 + accuracy.resolution**2 / 12.0),
        active=active,
        reactive=reactive,
        interval=look_interval(step_s),
    )


def _meter_of(plant: Plant) -> Ints:
    """Meter of each inverter's customer, (m,); -1 for none."""
    at = np.full(plant.feeder.bus.size, -1, dtype=np.intp)
    at[plant.meters] = np.arange(plant.meters.size)
    return np.asarray(at[plant.droop.customer])

"""Offline design of the sequential monitor.

References
----------
docs/theory-sequential.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack
from scipy.special import ndtri

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible, NotObservable, Problem, raise_if_any
from gridsec.estimators.detection import curve_mismatch
from gridsec.estimators.front.posterior import LoadDoubt
from gridsec.estimators.plant import Plant, check_plant, judging_problems
from gridsec.estimators.sequential.attack_kind import KindReferences, LoadTraces, look_interval
from gridsec.estimators.sequential.posterior import (
    UNMETERED,
    Prior,
    injection_doubt,
    voltage_prior,
)
from gridsec.estimators.sequential.reading_history import repeat_limits
from gridsec.estimators.sequential.search import Decoder, FaultDictionary
from gridsec.grid.devices import ToldError, busbar_error, steady_rounding
from gridsec.grid.network import Network, Power, Sensitivities
from gridsec.observers.certificates import Certificate, certify, verify
from gridsec.observers.lmi import contraction
from gridsec.observers.lure import Lure, close_loop

YEAR_S = 365.25 * 86400.0
"""Julian year, s."""


_SCALES = Problem("out-of-range", "must be at least one number of seconds, none of them negative")


@dataclass(frozen=True, slots=True)
class SequentialOptions:
    """Tuning parameters.

    Attributes
    ----------
    alarms_per_year
        False alarms that the feeder may raise by chance in a year.
    scales_s
        Time scales of the running means, s; those shorter than a tick are one tick.
    enough
        Least part of a scale's readings with which it tests a meter.
    focus
        Standard deviations within which a new search starts to trust.
    several
        Number of suspects above which a new search starts independently of the trusted set.
    release
        Successive ticks without evidence after which a meter is trusted again.
    suspect
        Probability that one search, once something is beyond chance, suspects any honest meter. Names follow
        the false-alarm rate.
    lower
        Factor on `sigmas` below which a suspect is released.
    like
        Largest likelihood ratio of the best explanation to a reported one.
    hidden_power
        Standard deviation of a power hidden beside the claimed one, pu: prior of accusing a customer's
        powers.
    hidden_charge
        Cost of accusing a customer's powers, in accusations of a meter; a higher one trusts `LoadDoubt` more.
    commission_s
        Time over which the meters' fixed errors are learned, s; 0 for never.
    stability
        Part of its accuracy class by which an honest meter may change after that.
    unread_std_percent
        Largest standard deviation of the voltage at a metered customer without a power reading for which the
        verdict can be CLEAN, % of nominal.
    widest, v2_limits, settled
        As in `gridsec.estimators.plant.Options`.

    Raises
    ------
    ValueError
        With every problem found.
    """

    alarms_per_year: float = 1.0
    scales_s: tuple[float, ...] = (0.0, 5.0, 15.0, 60.0)
    enough: float = 0.8
    focus: float = 2.0
    several: int = 3
    release: int = 6
    suspect: float = 0.05
    lower: float = 0.6
    like: float = 100.0
    hidden_power: float = 0.05
    hidden_charge: float = 5.0
    commission_s: float = 86400.0
    stability: float = 0.1
    unread_std_percent: float = 0.5
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
            ("scales_s", bool(self.scales_s) and all(0.0 <= s < np.inf for s in self.scales_s), _SCALES),
            ("enough", 0.0 < self.enough <= 1.0, Problem("out-of-range", "must be above 0 and up to 1")),
            ("focus", 0.0 < self.focus < np.inf, positive),
            ("several", self.several >= 0, zero),
            ("release", self.release >= 1, Problem("out-of-range", "must be at least 1")),
            ("suspect", 0.0 < self.suspect < 1.0, Problem("out-of-range", "must be between 0 and 1")),
            ("lower", 0.0 < self.lower <= 1.0, Problem("out-of-range", "must be above 0 and up to 1")),
            ("hidden_power", 0.0 < self.hidden_power < np.inf, positive),
            ("like", 1.0 <= self.like < np.inf, Problem("out-of-range", "must be at least 1 and finite")),
            *(
                (name, 0.0 <= getattr(self, name) < np.inf, zero)
                for name in ("hidden_charge", "commission_s", "stability", "unread_std_percent")
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
class SequentialDesign:
    """Offline design. N customers, n buses, p meters, m inverters, s scales, b busbar phases."""

    plant: Plant  # feeder and inverters
    names: tuple[str, ...]  # (p,) the meters' customers
    loop: Floats  # (m, m) effect of the injections on the inverters' voltages: H of the closed loop
    certificate: Certificate  # convergence of the observer for every trusted set and every switching
    doubt: LoadDoubt  # uncertainty of the powers
    prior: Prior  # resulting prior of the voltages
    injections: Floats  # (N,) standard deviation of the observed injections, pu
    busbar: float  # standard deviation of the squared busbar voltage, squared pu
    busbar_noise: float  # variance of the busbar's reading from tick to tick, squared pu^2
    lengths: tuple[int, ...]  # (s,) ticks of each scale
    look_every: tuple[int, ...]  # (s,) ticks from one look at each scale to the next
    confirmed: Ints  # (s,) ticks that evidence on each scale must last before a meter is named
    tails: tuple[float, ...]  # (s,) probability that one test of one look exceeds its limit by chance
    sigmas: tuple[float, ...]  # (s,) standard deviations of evidence: two-sided Gaussian quantiles of `tails`
    suspect: float  # standard deviations of a suspicion; an accusation costs their square
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
    faults: FaultDictionary = field(repr=False)  # faults: customers' active powers, then inverters
    references: KindReferences = field(
        repr=False
    )  # references of the kinds of manipulations, and limits of repetition
    max_attacked: int  # largest number of manipulated meters told apart
    max_p: Floats  # (N,) largest possible active power, pu: more would move the voltage beyond all limits
    max_q: Floats  # (N,) largest possible reactive power, pu
    step_s: float  # expected interval between frames, s
    options: SequentialOptions = field(repr=False)  # tuning parameters
    decoder: Decoder | None = None  # decoder in place of the search; None for the search

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

    def inverters_of(self, meters: Bools) -> Bools:
        """Inverters with a meter that is one of `meters` (p,), (m,)."""
        return np.asarray((self.meter_of >= 0) & meters[self.meter_of])


def design(
    plant: Plant,
    *,
    doubt: LoadDoubt,
    step_s: float,
    options: SequentialOptions | None = None,
    max_attacked: int | None = None,
) -> SequentialDesign:
    """Design the monitor of a feeder.

    step_s: expected interval between frames, s. max_attacked: number of suspects above which the verdict is
    UNDECIDED; by default a third of the meters.

    Raises
    ------
    NotObservable
        With fewer than three meters.
    DesignInfeasible
        If no certificate holds for the droop loop.
    ValueError
        As `plant.check_plant`, or if `doubt` is that of other customers.
    """
    options = SequentialOptions() if options is None else options
    meters, sensitivities = plant.meters, Sensitivities(plant.feeder)
    _check(plant, doubt, step_s, max_attacked)
    lure = close_loop(plant.feeder, plant.droop, meters)
    white, fixed, allowed, rounded = _noise(plant)
    injections = injection_doubt(plant.droop, plant.accuracy, meters, plant.feeder.bus.size)
    busbar = min(busbar_error(plant.accuracy, plant.droop.vbar**2, 2.0) / 2.0, UNMETERED)
    known = voltage_prior(plant.feeder, plant.feeder.bus[meters], doubt, busbar=busbar, inverters=injections)
    lengths = _lengths(options.scales_s, step_s)
    every = _look_intervals(lengths)
    tails = tuple(_tail(options.alarms_per_year, plant, n * step_s, len(lengths)) for n in every)
    sigmas = tuple(-float(ndtri(tail / 2.0)) for tail in tails)
    suspect = -float(ndtri(0.5 * options.suspect / meters.size))
    return SequentialDesign(
        plant=plant,
        names=tuple(plant.feeder.customers[c] for c in meters),
        loop=lure.H,
        certificate=_certificate(lure),
        doubt=doubt,
        prior=known,
        injections=injections,
        busbar=busbar,
        busbar_noise=_busbar_noise(plant),
        lengths=lengths,
        look_every=every,
        confirmed=2 + np.array(lengths) // 6,
        tails=tails,
        sigmas=sigmas,
        suspect=suspect,
        white=white,
        fixed=fixed,
        allowed=allowed,
        rounded=rounded,
        busbar_incidence=plant.feeder.busbar_incidence()[meters],
        inverter_reach=np.abs(lure.C) @ (2.0 * plant.droop.limit),
        meter_of=_meter_of(plant),
        mismatch=curve_mismatch(plant.droop),
        reading_errors=ToldError.over(plant.accuracy, _meter_of(plant), sigmas[0]),
        inverter_undetectable=_undetectable(
            plant, sensitivities, known, fixed + white / lengths[-1], suspect
        ),
        faults=_fault_dictionary(plant, sensitivities, options),
        references=_references(plant, sensitivities, options.alarms_per_year, step_s, lengths),
        max_attacked=meters.size // 3 if max_attacked is None else max_attacked,
        max_p=_max_power(plant.feeder, Power.ACTIVE),
        max_q=_max_power(plant.feeder, Power.REACTIVE),
        step_s=step_s,
        options=options,
    )


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
    return np.asarray(plant.droop.span * np.sqrt((half * half).sum(axis=0)) <= suspect + _HIDDEN_SIGMAS)


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


def _lengths(scales_s: tuple[float, ...], step_s: float) -> tuple[int, ...]:
    """Ticks of the scales, each once."""
    return tuple(sorted({max(1, round(scale / step_s)) for scale in scales_s}))


_LOOKS = 8
"""Looks per length of every scale but the shortest: a long mean hardly changes from tick to tick."""


def _look_intervals(lengths: tuple[int, ...]) -> tuple[int, ...]:
    """Ticks from one look at each scale to the next; the shortest scale answers at every tick."""
    return (1, *(max(1, round(length / _LOOKS)) for length in lengths[1:]))


_REPEAT_TESTS = 2
"""Tests of repetition, with the share of the false alarms of a scale each: stuck meters and replays."""


def _tail(rate: float, plant: Plant, look_s: float, scales: int) -> float:
    """Probability of one test such that the union bound over all tests of a year is `rate`.

    A look at a scale every `look_s` seconds tests each meter, each phase of the busbar, and the misfit of all
    trusted meters. Each of the scales and of the two tests of repetition has an equal share of the rate.
    """
    tests = plant.meters.size + plant.feeder.busbar_incidence().shape[1] + 1
    return min(float(rate * look_s / (YEAR_S * tests * (scales + _REPEAT_TESTS))), 0.5)


def _references(
    plant: Plant, sensitivities: Sensitivities, rate: float, step_s: float, lengths: tuple[int, ...]
) -> KindReferences:
    """References of the kinds at this feeder's meters."""
    accuracy, slope = plant.accuracy, _slope(plant)
    tests = plant.meters.size * (len(lengths) + _REPEAT_TESTS) * YEAR_S / step_s
    active, reactive = (2.0 * plant.feeder.self_impedance(power)[plant.meters] for power in Power)
    return KindReferences(
        limits=repeat_limits(accuracy.resolution, accuracy.jitter, min(rate / tests, 0.5), step_s),
        traces=LoadTraces(sensitivities, plant.feeder.bus[plant.meters]),
        noise=slope**2 * (accuracy.jitter**2 + accuracy.resolution**2 / 12.0),
        active=active,
        reactive=reactive,
        interval=look_interval(step_s),
    )


def _fault_dictionary(
    plant: Plant, sensitivities: Sensitivities, options: SequentialOptions
) -> FaultDictionary:
    """Columns of 2R for the customers' active powers, and of 2X for the inverters."""
    feeder, meters, owner = plant.feeder, plant.meters, plant.droop.customer
    customers = feeder.bus.size
    of = np.concatenate([np.arange(customers), customers + owner])

    def changes(which: Ints) -> Floats:
        return sensitivities.numbered(of[which])

    def towards(weights: Floats) -> Floats:
        return np.asarray(sensitivities.weighted(meters, weights)[of])

    load, injection = (feeder.squared_sensitivity(power, meters) for power in Power)
    return FaultDictionary(
        std=np.concatenate([np.full(customers, options.hidden_power), 2.0 * plant.droop.limit]),
        charge=np.repeat([options.hidden_charge, 1.0], [customers, owner.size]),
        size=np.concatenate([load, injection[owner]]),
        meter=np.concatenate([_meter_at(plant), np.full(owner.size, -1)]),
        columns=changes,
        weighted=towards,
    )


def _meter_of(plant: Plant) -> Ints:
    return np.asarray(_meter_at(plant)[plant.droop.customer])


def _meter_at(plant: Plant) -> Ints:
    """Meter of each customer; -1 for none."""
    at = np.full(plant.feeder.bus.size, -1, dtype=np.intp)
    at[plant.meters] = np.arange(plant.meters.size)
    return at

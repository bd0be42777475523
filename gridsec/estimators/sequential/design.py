"""What is prepared offline for the sequential monitor.

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
from gridsec.estimators.plant import Plant, check_plant, judging_problems
from gridsec.estimators.sequential.conditional import Prior
from gridsec.estimators.sequential.decoder import Decoder
from gridsec.estimators.sequential.dictionary import Dictionary
from gridsec.estimators.sequential.effects import Effects
from gridsec.estimators.sequential.kinds import Shapes, Traces, pace
from gridsec.estimators.sequential.loads import UNMETERED, LoadDoubt, injection_doubt, prior
from gridsec.estimators.sequential.repeats import rules
from gridsec.estimators.thresholds import curve_mismatch
from gridsec.grid.meter import ToldError, busbar_error, steady_rounding
from gridsec.grid.network import Network, Power
from gridsec.observers.certificates import Certificate, certify, verify
from gridsec.observers.lmi import contraction
from gridsec.observers.lure import Lure, close_loop

YEAR_S = 365.25 * 86400.0


_SCALES = Problem("out-of-range", "must be at least one number of seconds, none of them negative")


@dataclass(frozen=True, slots=True)
class SequentialOptions:
    """Numbers that decide; none is hidden.

    Attributes
    ----------
    alarms_per_year
        False alarms that the feeder may raise by chance in a year.
    scales_s
        Time scales of the running means, s; those shorter than a tick are one tick.
    enough
        A scale judges a meter of which it has at least this part of the readings.
    focus
        Standard deviations within which a search begins to trust, where it begins anew.
    several
        With more suspects than this at once a search begins anew as well.
    release
        Ticks in a row without evidence after which a meter is trusted again.
    suspect
        Once something is beyond chance, smaller offsets are suspected too: so that one search suspects
        any honest meter with this probability. To be named takes what the false-alarm rate asks for.
    lower
        A distrusted meter must come below this part of `sigmas` to be trusted again.
    like
        Explanations no more than this factor less likely than the best are given with it.
    hidden_power
        Power that a customer's readings may hide besides what they claim, standard deviation, pu: prior of
        accusing a customer's powers.
    hidden_charge
        What accusing a customer's powers costs, in accusations of a meter. Loads are promised to be
        within `LoadDoubt`; the higher, the more meters' word is against that of one promise.
    commission_s
        The meters' fixed errors are learned over this time, s; 0 for never.
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
    """Everything that is prepared offline. N customers, n buses, p meters, m inverters, s scales.

    Attributes
    ----------
    plant
        What is watched.
    names : (p,)
        The meters' customers, for sentences.
    loop : (m, m)
        What the injections do to the voltages that the inverters see: H of the closed loop.
    certificate
        Why the observer converges, for every trusted set and every switching between them.
    doubt
        How wrong powers may be.
    prior
        What follows for the voltages.
    injections : (N,)
        Standard deviation of the observed injections, pu.
    busbar
        Standard deviation of the squared busbar voltage, squared pu.
    flicker
        Variance of what its meter says from tick to tick, squared pu^2.
    lengths : (s,)
        Ticks of each scale.
    every : (s,)
        Ticks from one look at each scale to the next.
    confirmed : (s,)
        Ticks that evidence on each scale must last before anybody is named.
    tails : (s,)
        Probability that one test of one look exceeds its limit by chance, for the false-alarm rate asked for.
    sigmas : (s,)
        Standard deviations beyond which an offset is evidence: the two-sided Gaussian quantiles of `tails`.
    suspect
        Standard deviations beyond which a search suspects; an accusation costs the square of it.
    white, fixed : (p,)
        Variance of a squared reading from tick to tick, and of its unknown fixed part, squared pu^2.
    allowed : (p,)
        Largest fixed part by the accuracy class, `rounded` included, squared pu.
    rounded : (p,)
        Largest error of rounding that stays as long as the voltage does, squared pu; nobody can learn it.
    hangs_on : (p, b)
        1 where a meter hangs on a phase of the busbar, else 0; b is 1 on a balanced feeder.
    reach : (p,)
        What all inverters between their limits can do to the voltage at each meter, squared pu.
    meter_of : (m,)
        Meter that drives each inverter; -1 for none.
    heard : (m,)
        How far the truth may be from what each inverter's meter reads.
    mismatch : (m,)
        How far a real curve, linear in v, can be from the model's, linear in z, pu.
    unseen : (m,)
        Inverters whose whole range does not move the voltages enough to be noticed there.
    book
        What else but meters can be wrong: every customer's active power, then every inverter.
    shapes
        What manipulations are compared with, and when repetition is evidence.
    most
        How many liars it claims to tell apart: a third of the meters.
    most_p, most_q : (N,)
        Largest power of each customer that is believed, pu: more would alone move the voltage beyond all
        limits.
    step_s
        Expected interval between frames, s.
    options
        The numbers that decide.
    decoder
        What decides in place of the search; None: the search.
    """

    plant: Plant
    names: tuple[str, ...]
    loop: Floats
    certificate: Certificate
    doubt: LoadDoubt
    prior: Prior
    injections: Floats
    busbar: float
    flicker: float
    lengths: tuple[int, ...]
    every: tuple[int, ...]
    confirmed: Ints
    tails: tuple[float, ...]
    sigmas: tuple[float, ...]
    suspect: float
    white: Floats
    fixed: Floats
    allowed: Floats
    rounded: Floats
    hangs_on: Floats
    reach: Floats
    meter_of: Ints
    heard: ToldError
    mismatch: Floats
    unseen: Bools
    book: Dictionary = field(repr=False)
    shapes: Shapes = field(repr=False)
    most: int
    most_p: Floats
    most_q: Floats
    step_s: float
    options: SequentialOptions = field(repr=False)
    decoder: Decoder | None = None

    @property
    def customers(self) -> int:
        """N."""
        return self.plant.feeder.bus.size

    @property
    def effects(self) -> Effects:
        """What every customer's powers do to the voltages."""
        return self.shapes.traces.effects

    @property
    def observers(self) -> int:
        """One observer, whatever is trusted."""
        return 1


def design(
    plant: Plant,
    *,
    doubt: LoadDoubt,
    step_s: float,
    options: SequentialOptions | None = None,
    max_attacked: int | None = None,
) -> SequentialDesign:
    """Prepare to watch a feeder.

    Parameters
    ----------
    plant
        What is watched.
    doubt
        How wrong the powers of the frames may be.
    step_s
        Expected interval between frames, s.
    options
        The numbers that decide.
    max_attacked
        With more liars than this the verdict is UNDECIDED; by default a third of the meters.

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
    meters = plant.meters
    _check(plant, doubt, step_s, max_attacked)
    lure = close_loop(plant.feeder, plant.droop, meters)
    effects = Effects(plant.feeder)
    injections = injection_doubt(plant.droop, plant.accuracy, meters, plant.feeder.bus.size)
    busbar = min(busbar_error(plant.accuracy, plant.droop.vbar**2, 2.0) / 2.0, UNMETERED)
    lengths = _lengths(options.scales_s, step_s)
    accuracy, slope = plant.accuracy, 2.0 * _HIGH * plant.droop.vbar
    white = np.maximum(slope**2 * (accuracy.jitter**2 + accuracy.resolution**2 / 12.0), _WHITE)
    rounded = slope * steady_rounding(accuracy)
    fixed = slope**2 * accuracy.class_fraction**2 / 3.0 + 0.5 * rounded**2
    known = prior(plant.feeder, plant.feeder.bus[meters], doubt, busbar=busbar, inverters=injections)
    suspect = -float(ndtri(0.5 * options.suspect / meters.size))
    every = _every(lengths)
    tails = tuple(_tail(options.alarms_per_year, plant, n * step_s, len(lengths)) for n in every)
    sigmas = tuple(-float(ndtri(tail / 2.0)) for tail in tails)
    return SequentialDesign(
        plant=plant,
        names=tuple(plant.feeder.customers[c] for c in meters),
        loop=lure.H,
        certificate=_proof(lure),
        doubt=doubt,
        prior=known,
        injections=injections,
        busbar=busbar,
        flicker=slope**2 * (accuracy.busbar_jitter**2 + accuracy.busbar_resolution**2 / 12.0),
        lengths=lengths,
        every=every,
        confirmed=2 + np.array(lengths) // 6,
        tails=tails,
        sigmas=sigmas,
        suspect=suspect,
        white=white,
        fixed=fixed,
        allowed=slope * accuracy.class_fraction + rounded,
        rounded=rounded,
        hangs_on=plant.feeder.busbar_incidence()[meters],
        reach=np.abs(lure.C) @ (2.0 * plant.droop.limit),
        meter_of=_meter_of(plant),
        mismatch=curve_mismatch(plant.droop),
        heard=ToldError.over(plant.accuracy, _meter_of(plant), sigmas[0]),
        unseen=_unseen(plant, effects, known, fixed + white / lengths[-1], suspect),
        book=_suspicions(plant, effects, options),
        shapes=_shapes(plant, effects, options.alarms_per_year, step_s, lengths),
        most=meters.size // 3 if max_attacked is None else max_attacked,
        most_p=_most_power(plant.feeder, Power.ACTIVE),
        most_q=_most_power(plant.feeder, Power.REACTIVE),
        step_s=step_s,
        options=options,
    )


# Standard deviations that chance may take off what shows.
_CHANCE = 2.0


def _unseen(plant: Plant, effects: Effects, known: Prior, noise: Floats, suspect: float) -> Bools:
    """Inverters whose whole range is no evidence against them: ``span sqrt(c^T Q c)`` within the limits."""
    whole: Floats = known.among(np.arange(noise.size))
    whole[np.diag_indices_from(whole)] += noise
    moved = effects.columns(Power.REACTIVE, plant.droop.customer)[known.meters]
    failed = lapack.dpotrf(whole, lower=True, clean=False, overwrite_a=True)[1]
    half, _ = lapack.dtrtrs(whole, moved, lower=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray(plant.droop.span * np.sqrt((half * half).sum(axis=0)) <= suspect + _CHANCE)


# Powers that alone would move a squared voltage by this, pu, are none; nor are any beyond so many pu.
_COLLAPSE, _NO_POWER = 1.0, 1e4


def _most_power(feeder: Network, power: Power) -> Floats:
    return np.asarray(_COLLAPSE / np.maximum(2.0 * feeder.self_impedance(power), _COLLAPSE / _NO_POWER))


# Least variance of a reading, squared pu^2: two perfect meters at one bus are equal, and such a matrix has no
# inverse.
_WHITE = 1e-12
# Voltage at which a meter's relative errors are turned into squared ones, in parts of the nominal.
_HIGH = 1.03


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
# Decay rate asked of the solver, as a part of the slowest inverter's.
_RATE = 0.1


def _proof(lure: Lure) -> Certificate:
    """The best closed form, or the solver's certificate where none applies; verified."""
    try:
        found = certify(lure)
    except DesignInfeasible:
        found = contraction(lure, rate=_RATE * float(np.min(-np.diagonal(lure.A))))
    margin = verify(found, lure)
    if not margin > 0:
        raise DesignInfeasible(
            f"{found.kind} certificate", "it fails its verification", margin, code="not-verified"
        )
    return found


def _lengths(scales_s: tuple[float, ...], step_s: float) -> tuple[int, ...]:
    """Ticks of the scales, each once."""
    return tuple(sorted({max(1, round(scale / step_s)) for scale in scales_s}))


# A long mean hardly changes from tick to tick: every scale but the shortest has this many looks per length.
_LOOKS = 8


def _every(lengths: tuple[int, ...]) -> tuple[int, ...]:
    """Ticks from one look at each scale to the next; the shortest scale answers at every tick."""
    return (1, *(max(1, round(length / _LOOKS)) for length in lengths[1:]))


# Stuck meters and replays have a share of the false alarms each, as every scale has.
_REPEATS = 2


def _tail(rate: float, plant: Plant, look_s: float, scales: int) -> float:
    """Probability of one test such that the union bound over all tests of a year is `rate`.

    A look at a scale every `look_s` seconds tests each meter, each phase of the busbar, and the misfit of all
    trusted meters. Each of the scales and of the two tests of repetition has an equal share of the rate.
    """
    tests = plant.meters.size + plant.feeder.busbar_incidence().shape[1] + 1
    return min(float(rate * look_s / (YEAR_S * tests * (scales + _REPEATS))), 0.5)


def _shapes(plant: Plant, effects: Effects, rate: float, step_s: float, lengths: tuple[int, ...]) -> Shapes:
    """What manipulations look like at this feeder's meters."""
    accuracy, slope = plant.accuracy, 2.0 * _HIGH * plant.droop.vbar
    tests = plant.meters.size * (len(lengths) + _REPEATS) * YEAR_S / step_s
    active, reactive = (2.0 * plant.feeder.self_impedance(power)[plant.meters] for power in Power)
    return Shapes(
        rules=rules(accuracy.resolution, accuracy.jitter, min(rate / tests, 0.5), step_s),
        traces=Traces(effects, plant.feeder.bus[plant.meters]),
        noise=slope**2 * (accuracy.jitter**2 + accuracy.resolution**2 / 12.0),
        active=active,
        reactive=reactive,
        every=pace(step_s),
    )


def _suspicions(plant: Plant, effects: Effects, options: SequentialOptions) -> Dictionary:
    """Columns of 2R for the customers' active powers, and of 2X for the inverters."""
    feeder, meters, owner = plant.feeder, plant.meters, plant.droop.customer
    customers = feeder.bus.size
    of = np.concatenate([np.arange(customers), customers + owner])

    def changes(which: Ints) -> Floats:
        return effects.of(of[which])

    def towards(weights: Floats) -> Floats:
        return np.asarray(effects.along(meters, weights)[of])

    load, injection = (feeder.squared_sensitivity(power, meters) for power in Power)
    return Dictionary(
        std=np.concatenate([np.full(customers, options.hidden_power), 2.0 * plant.droop.limit]),
        charge=np.repeat([options.hidden_charge, 1.0], [customers, owner.size]),
        size=np.concatenate([load, injection[owner]]),
        meter=np.concatenate([_meter_at(plant), np.full(owner.size, -1)]),
        columns=changes,
        along=towards,
    )


def _meter_of(plant: Plant) -> Ints:
    return np.asarray(_meter_at(plant)[plant.droop.customer])


def _meter_at(plant: Plant) -> Ints:
    """Meter of each customer; -1 for none."""
    at = np.full(plant.feeder.bus.size, -1, dtype=np.intp)
    at[plant.meters] = np.arange(plant.meters.size)
    return at

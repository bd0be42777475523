"""Uncertainty of the customers' powers, and the resulting prior of the voltages.

Errors dp, dq of all customers move all voltages by ``2 R dp + 2 X dq``, neighbours nearly alike. This
correlation makes a manipulated meter visible among its neighbours (docs/theory-sequential.md, section 1).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gridsec.arrays import Floats, Ints
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators.sequential.posterior import Prior
from gridsec.grid.droop import Droop
from gridsec.grid.meter import MeterAccuracy
from gridsec.grid.network import Network, Power

EXACT = 1e-6
"""Least standard deviation of a power, pu."""
UNMETERED = 0.1
"""Standard deviation of an unmetered squared busbar voltage, squared pu."""
LONGEST_S = 1e12
"""Longest correlation time of power errors, s: longer ones leave nothing to learn."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadDoubt:
    """Uncertainty of the powers in the frames. N customers.

    Attributes
    ----------
    p, q : (N,)
        Standard deviations of the errors of active and reactive power, pu. Larger `p_error`, `q_error` of a
        frame take precedence.
    time_s
        Correlation time of these errors, s; means over much less time contain all of them.
    common_p, common_q
        Shares of the variances common to all customers (weather, time of day), 0 to 1.
    lasting
        Share of the variances that no mean reduces, 0 to 1: a wrong power factor lasts for years.
    together : (N,) or one for all
        Share of both variances in phase with that of all others, 0 to 1: unmetered loads are low together by
        night, active and reactive.
    even_p, even_q : (N,)
        Derived: half-widths of uniform errors with standard deviations p and q, pu.

    Raises
    ------
    ValueError
        If a number is not finite, negative, or a share outside [0, 1]; names every problem.
    """

    p: Floats
    q: Floats
    time_s: float
    common_p: float = 0.0
    common_q: float = 0.0
    lasting: float = 0.0
    together: Floats | float = 0.0
    even_p: Floats = field(init=False, repr=False)
    even_q: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        problems = [
            Problem("negative", f"{name} must be finite and not negative")
            for name in ("p", "q")
            if not (np.isfinite(getattr(self, name)).all() and (getattr(self, name) >= 0).all())
        ]
        if not 0 < self.time_s <= LONGEST_S:
            most = f"at most {LONGEST_S:g}; what never changes is `lasting`"
            problems.append(
                Problem("out-of-range", f"time_s is {self.time_s}; it must be positive and {most}")
            )
        problems += [
            Problem("out-of-range", f"{name} is {getattr(self, name)}; it must be from 0 to 1")
            for name in ("common_p", "common_q", "lasting", "together")
            if not (np.greater_equal(getattr(self, name), 0) & np.less_equal(getattr(self, name), 1)).all()
        ]
        raise_if_any(problems)
        for name, std in (("even_p", self.p), ("even_q", self.q)):
            object.__setattr__(self, name, np.sqrt(3.0) * np.maximum(std, EXACT))


def prior(
    feeder: Network, at: Ints, doubt: LoadDoubt, *, busbar: Floats | float, inverters: Floats | None = None
) -> Prior:
    """Covariance of the buses' squared voltages without any meter.

    ``S = 4 R V_p R^T + 4 X V_q X^T + u u^T + busbar^2 1 1^T`` with ``u = 2 R g s_p + 2 X g s_q``,
    ``g^2 = together``, and for the rest, s being ``sqrt(1 - together) s``,
    ``V = (1 - common) diag(s^2) + common s s^T``. In three phases places stand for buses, and only those of
    one phase share the busbar's error.

    at: (p,) bus of each meter. busbar: standard deviation of its squared voltage, squared pu; one or (3,).
    inverters: (N,) standard deviation of the observed injections, pu.
    """
    alone, together = (np.sqrt(part) for part in (1.0 - doubt.together, doubt.together))
    p, q = alone * doubt.p, alone * doubt.q
    q = q if inverters is None else np.hypot(q, inverters)
    variance = feeder.broadcast_busbar(busbar**2)
    of_meters: Floats = np.repeat(variance[:, None], at.size, axis=1)
    of_meters *= feeder.same_busbar_phase(np.arange(variance.size), at)
    none = np.zeros_like(q)
    for power, std, common, shared in (
        (Power.ACTIVE, p, doubt.common_p, feeder.bus_voltages(p, none, 0.0, steps=0)),
        (Power.REACTIVE, q, doubt.common_q, feeder.bus_voltages(none, q, 0.0, steps=0)),
    ):
        of_meters += feeder.covariance(power, at, (1.0 - common) * std**2)
        variance += feeder.variances(power, (1.0 - common) * std**2)
        if common:
            of_meters += np.multiply.outer(common * shared, shared[at])
            variance += common * shared**2
    if np.any(together):
        shared = feeder.bus_voltages(together * doubt.p, together * doubt.q, 0.0, steps=0)
        of_meters += np.multiply.outer(shared, shared[at])
        variance += shared**2
    return Prior(of_meters, at, variance)


def injection_doubt(droop: Droop, accuracy: MeterAccuracy, meters: Ints, customers: int) -> Floats:
    """Standard deviation of the observed injections by the meters' own errors, (N,) in pu.

    An inverter driven by its meter follows the fixed error of the reading through the steepest part of its
    curve, at most up to saturation.
    """
    error = np.zeros(customers)
    error[meters] = 2.0 * np.sqrt(
        accuracy.class_fraction**2 / 3.0 + accuracy.resolution**2 / 12.0 + accuracy.jitter**2
    )
    own = np.minimum(droop.slope * error[droop.customer], droop.limit)
    return np.asarray(np.sqrt(droop.per_customer(own**2, customers)))

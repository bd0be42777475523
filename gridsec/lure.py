"""The closed loop of feeder and droop as a Lur'e system, its time step and its equilibrium.

    x' = A x + G phi(H x + F u) + B u,     y = C x + D u

phi acts entry by entry, and its slopes lie in `[0, slope]`. For a feeder, x is the reactive injection of
the inverters, `z = H x + F u` and y are `vbar^2 - v^2` at inverters and meters, and u = w collects what
the rest of the feeder does to z (`known_input`).

References
----------
.. [1] chong2020, equations (9), (15) to (19).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.droop import Droop
from gridsec.errors import FeederInvalid
from gridsec.feeder import Feeder, LinDistFlow, lindistflow

Nonlinearity = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True, eq=False)
class Lure:
    """`x' = A x + G phi(H x + F u) + B u`, `y = C x + D u`.

    Attributes
    ----------
    A : (n, n)
    G : (n, m)
    H : (m, n)
    F : (m, l)
    B : (n, l)
    C : (p, n)
    D : (p, l)
        The matrices of the system.
    slope : (m,)
        Upper bound of the slope of each entry of phi; the lower bound is 0.
    phi
        The nonlinearity, (…, m) -> (…, m), entry by entry. For a feeder: its `Droop`.
    """

    A: Floats
    G: Floats
    H: Floats
    F: Floats
    B: Floats
    C: Floats
    D: Floats
    slope: Floats
    phi: Nonlinearity

    def __post_init__(self) -> None:
        for name in ("A", "G", "H", "F", "B", "C", "D", "slope"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        n, m, inputs, p = self.A.shape[0], self.slope.size, self.F.shape[-1], self.C.shape[0]
        wanted: dict[str, tuple[int, ...]] = {"A": (n, n), "G": (n, m), "H": (m, n), "F": (m, inputs)}
        wanted |= {"B": (n, inputs), "C": (p, n), "D": (p, inputs), "slope": (m,)}
        wrong = [
            f"{name} has shape {getattr(self, name).shape}; expected {shape}"
            for name, shape in wanted.items()
            if getattr(self, name).shape != shape
        ]
        if wrong:
            raise ValueError("; ".join(wrong))


def close_loop(feeder: Feeder, droop: Droop, meters: Ints) -> Lure:
    """The Lur'e system of a feeder with droop inverters and voltage meters.

    With `z = vbar^2 - v^2` as the output everywhere and `u = w` from `known_input`:
    `A = -T^-1`, `G = T^-1`, `H = -2 X[inverters, inverters]`, `C = -2 X[meters, inverters]`, `F` and `D`
    pick the inverters' and the meters' customers, `B = 0`. The slopes are those of K (G carries 1/tau).

    Parameters
    ----------
    feeder
        The feeder.
    droop
        The inverters.
    meters : (p,)
        Customer of each meter.

    Raises
    ------
    FeederInvalid
        If an inverter or a meter belongs to a customer that does not exist.

    References
    ----------
    chong2020, section VII.
    """
    count = len(feeder.customers)
    problems = [
        f"{what} {i}: customer {j} does not exist; expected 0 to {count - 1}"
        for what, where in (("inverter", droop.customer), ("meter", meters))
        for i, j in enumerate(where)
        if not 0 <= j < count
    ]
    if problems:
        raise FeederInvalid(problems)
    model = lindistflow(feeder)
    pick = np.eye(count)
    own = droop.customer
    return Lure(
        A=-np.diag(1.0 / droop.tau),
        G=np.diag(1.0 / droop.tau),
        H=-2.0 * model.X[np.ix_(own, own)],
        F=pick[own],
        B=np.zeros((own.size, count)),
        C=-2.0 * model.X[np.ix_(meters, own)],
        D=pick[meters],
        slope=droop.slope,
        phi=droop,
    )


def known_input(  # noqa: PLR0917  # every argument is a term of chong2020 (19), in its order
    model: LinDistFlow,
    vbar: float,
    p: Floats,
    q: Floats,
    v0_squared: Floats | float,
    correction: Floats | float = 0.0,
) -> Floats:
    """The input w of the Lur'e system: z with all droop inverters at zero.

    `w = vbar^2 - v0^2 - 2 R p - 2 X q - correction`, chong2020 before (19), where q is the reactive
    injection without the inverters (`q = -q_c`).

    Parameters
    ----------
    model
        From `lindistflow`.
    vbar
        Reference voltage of the droop, pu.
    p, q : (…, N)
        Active injection and reactive injection without the droop inverters, pu.
    v0_squared : (…) or scalar
        Squared busbar voltage, pu.
    correction : (…, N) or scalar
        What to add to the squared voltages of the linear model: `loss_correction` at the customers.

    Returns
    -------
    (…, N)
        w, pu.
    """
    base = vbar**2 - np.asarray(v0_squared, dtype=np.float64)[..., None]
    return np.asarray(base - 2.0 * (p @ model.R.T + q @ model.X.T) - correction)

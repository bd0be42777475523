"""Security indices of a feeder: its closed loop of droop inverters, linearised.

References
----------
lee2018, chapter 3; chong2020 (9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats
from gridsec.index.pairs import Index, asymptotic_index, dynamic_index, static_index
from gridsec.lure import Lure


@dataclass(frozen=True, slots=True, eq=False)
class FeederIndex:
    """Smallest numbers of meters in an invisible coordinated attack, for exactly known loads.

    Attributes
    ----------
    static
        From one snapshot of readings alone.
    dynamic
        From the readings of all time.
    asymptotic
        As `dynamic`, for attacks that do not decay; infinite for a stable closed loop.
    A, C : (n, n), (p, n)
        The linearisation.
    """

    static: Index
    dynamic: Index
    asymptotic: Index
    A: Floats
    C: Floats


def slopes(lure: Lure, z: Floats, *, step: float) -> Floats:
    """Slopes of the nonlinearities at a point, by symmetric differences; (m,).

    Parameters
    ----------
    z : (m,)
        Arguments of the nonlinearities.
    step
        Half the width of the difference, in the unit of z. Near a kink closer than this, the result is a
        mixture of the slopes on both sides.
    """
    return np.asarray((lure.phi(z + step) - lure.phi(z - step)) / (2.0 * step))


def linearise(lure: Lure, slope: Floats) -> tuple[Floats, Floats]:
    """The pair `(A + G diag(slope) H, C)` of a Lur'e system about a trajectory with these slopes.

    Parameters
    ----------
    slope : (m,)
        Slope of each nonlinearity, from `slopes`; `lure.slope` for the steepest; 0 in deadband.
    """
    return lure.A + (lure.G * slope) @ lure.H, np.asarray(lure.C)


def feeder_index(lure: Lure, slope: Floats, *, tol: float) -> FeederIndex:
    """Static, dynamic and asymptotic security index of a feeder's linearised closed loop.

    States and meters are scaled to order one first, which changes no index. Inverters of slope zero decay
    independently; those with equal time constants share one eigenspace, on which the dynamic index falls to
    the static one of their columns.

    Parameters
    ----------
    lure
        Closed loop, from `close_loop`.
    slope : (m,)
        As in `linearise`.
    tol
        As in `dynamic_index`.
    """
    A, C = linearise(lure, slope)
    return FeederIndex(
        static_index(C, tol=tol),
        dynamic_index(A, C, tol=tol),
        asymptotic_index(A, C, discrete=False, tol=tol),
        A,
        C,
    )

"""Decoders on top of partial observers (lee2018, chapter 4).

`bounded`: partial Luenberger observers and Algorithm 4.1, for bounded disturbance and noise.
`gaussian`: partial Kalman filters and Algorithm 4.2, for Gaussian disturbance and noise.
`fusion`: estimates and tests from correlated filters.
"""

from gridsec.decode.partial import bounded, fusion, gaussian

__all__ = ["bounded", "fusion", "gaussian"]

"""Exceedances of the limits by running means, against the share of the false-alarm rate of each scale.

    python -m benchmarks.running_means [paths]

Residual of one meter: white noise of variance 1, and a load error of variance S with correlation time
600 s, one reading per second. The limit of a mean over L ticks is that of
`gridsec.estimators.sequential.design._sigmas`: its two-sided probability at one tick is p = L q, with q the
share per tick, as if the mean were new once in L ticks. Printed per scale, all in units of the share:

- ticks: expected ticks beyond the limit, L P / p, exact by linearity, with P from the mean's true variance;
- runs: separate runs of such ticks;
- episodes: such ticks without another one within the L ticks before.

Runs and episodes are ticks times the probability, given a mean beyond the limit now, that the one before,
or all L before, were not. Paths are conditioned on the mean now: rare limits cost no more than others.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.signal import lfilter
from scipy.special import erfc, erfcinv

YEAR_S = 365.25 * 86400.0
CORRELATION_S = 600.0
METERS, SHARES = 14, 6  # 13 meters and the busbar; four scales, stuck meters and replays
SCALES = (1, 5, 10, 15, 60, 600)


def paths(length: int, load: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Running means over `length` ticks, at `length` + 1 consecutive ticks, (count, length + 1)."""
    keep, ticks = np.exp(-1.0 / CORRELATION_S), 2 * length
    noise = rng.normal(size=(count, ticks))
    if load > 0:
        drive = rng.normal(size=(count, ticks)) * np.sqrt(load * (1.0 - keep**2))
        drive[:, 0] = rng.normal(size=count) * np.sqrt(load)
        noise += lfilter([1.0], [1.0, -keep], drive, axis=1)
    total = np.cumsum(np.pad(noise, ((0, 0), (1, 0))), axis=1)
    return (total[:, length:] - total[:, :-length]) / length


def variance(length: int, load: float, lag: np.ndarray) -> np.ndarray:
    """Autocovariance of the running mean at lags in ticks."""
    keep = np.exp(-1.0 / CORRELATION_S)
    d = np.arange(-length + 1, length)
    weight = (length - np.abs(d)) / length**2
    of_load = load * (weight * keep ** np.abs(lag[:, None] + d)).sum(axis=1)
    return np.maximum(length - lag, 0) / length**2 + of_load


def line(length: int, load: float, rate: float, count: int, rng: np.random.Generator) -> str:
    """One row."""
    p = min(rate * length / (METERS * SHARES * YEAR_S), 0.5)
    z = np.sqrt(2.0) * erfcinv(p)
    lag = np.arange(length + 1)
    cov = variance(length, load, lag)
    stated, true = load + 1.0 / length, cov[0]
    edge = z * np.sqrt(stated)
    P = erfc(edge / np.sqrt(2.0 * true))
    # One-sided tail beyond the edge, and the mean now drawn from it.
    tail = np.sqrt(2.0) * erfcinv(P * rng.uniform(size=count)) * np.sqrt(true)
    runs, episodes, done = 0, 0, 0
    while done < count:
        n = min(max(1, 4_000_000 // (2 * length)), count - done)
        x = paths(length, load, n, rng)[:, ::-1]
        x = x + (cov / true) * (tail[done : done + n, None] - x[:, :1])
        before = np.abs(x[:, 1:]) > edge
        runs, episodes, done = runs + np.sum(~before[:, 0]), episodes + np.sum(~before.any(axis=1)), done + n
    ticks = length * P / p
    return (
        f"{rate:9g} {load:5g} {length:5d} {z:5.2f} {true / stated:8.4f} {P / p:8.3f} {ticks:9.2f} "
        f"{ticks * runs / count:7.2f} {ticks * episodes / count:8.2f}"
    )


def main() -> None:
    """Print the table."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    rng = np.random.default_rng(1)
    print("alarms/a     S     L     z  var/std.  P/p     ticks    runs  episodes")
    for rate in (1.0, 2000.0, 200000.0):
        for load in (0.0, 0.01, 0.1, 1.0):
            for length in SCALES:
                print(line(length, load, rate, count, rng), flush=True)


if __name__ == "__main__":
    main()

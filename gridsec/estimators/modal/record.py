"""Learned fixed errors of the core: their record over a restart, as arrays of one number per meter.

The posterior of (w, b) with complete readings has three numbers per mode, and one amount per direction of
`gridsec.estimators.modal.static`. The order of the modes is that of the eigenvalues; equal eigenvalues have
equal variances, and signs of eigenvectors cancel. Means are kept at the meters. So a record means the same on
every machine, while the model of the residuals is the same.

With missing readings the covariance P is full. The record is then diagonal with a variance large enough for
an upper bound: with C the diagonal of P without theta, and C0 that of the prior,

    (1 + x) C + y C0 + T N T' >= P      N of the information times (1 - y) / (1 + x)^2

for the first (x, y) of `ENLARGEMENTS`. The last one is the prior, which is a bound always. The record is made
at calm moments, and kept where it knows the fixed errors better than the earlier one.

A record is older than the last reading, by seconds up to `EVERY` ticks. That is a valid posterior with fewer
readings. While meters are suspect no record is made: it contains nothing of a manipulation that was found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal import static
from gridsec.estimators.modal.filter import FilterState, Full
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.static import Static

EVERY = 600
"""Ticks from one record with missing readings to the next: it costs O(t^3)."""
ENLARGEMENTS = ((0.1, 0.0), (0.3, 0.0), (1.0, 0.0), (1.0, 0.01), (1.0, 0.05), (1.0, 0.2), (0.0, 1.0))
"""Enlargements (x, y) of the variance that are tried, 1."""
WIDEST = 2.5
"""Largest stored variance, in those of the prior, 1: more than the largest enlargement."""
TOLERANCE = 1.0 + 1e-9
"""Factor for rounding, 1."""
_PREFIX = "filter."
_ROWS = (
    *("w", "b", "var_w", "cov_wb", "var_b", "felt_w", "felt_b"),
    *("information", "busbar", "meters", "t", "time_s"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Posterior of the errors that last, and of the loads, at one time.

    Attributes
    ----------
    filter, known
        The filter in the modes, and the information about the directions.
    """

    filter: FilterState = field(repr=False)
    known: Static = field(repr=False)

    def loss(self) -> float:
        """Sum of the variances of b in the modes: less is better."""
        return float(self.filter.cov[2].sum())


def made(modes: Modes, state: FilterState, known: Static) -> Record:
    """Record of a filter; O(t^3) with a full covariance.

    Parameters
    ----------
    modes, state, known
        The modes, the filter, and the information about the directions.
    """
    if state.full is None:
        return Record(state, known)
    known = static.current(modes, known)
    each = (_bounded(modes, state, state.full, known, *more) for more in ENLARGEMENTS)
    found = next((one for one in each if one is not None), None)
    # The prior is a bound up to rounding.
    return Record(modal.start(modes, state.t), static.start(modes)) if found is None else found


def _bounded(  # noqa: PLR0917  # the filter, and the two enlargements
    modes: Modes, state: FilterState, whole: Full, known: Static, more: float, prior: float
) -> Record | None:
    """Record with enlarged variances; None where it is no upper bound."""
    t, U = modes.size, modes.U
    w, b = np.arange(t), np.arange(t, 2 * t)
    of_w, both, of_b = (U.T @ each @ U for each in whole.blocks)
    P = np.block([[of_w, both], [both.T, of_b]])
    now = static.current(
        modes, replace(known, information=known.information * (1.0 - prior) / (1.0 + more) ** 2)
    )
    g_w, g_b = known.signature[:, :, None] * modes.directions
    T = np.vstack([-g_w, modes.directions - g_b])
    rest, bound = P - T @ known.cov @ T.T, T @ now.cov @ T.T - P
    cov = (1.0 + more) * np.stack([rest[w, w], rest[w, b], rest[b, b]])
    cov[0] += prior * modes.varying
    cov[2] += prior * modes.lasting
    if prior == 1.0:
        cov = np.stack([modes.varying, np.zeros(t), modes.lasting])
    bound[w, w] += cov[0]
    bound[w, b] += cov[1]
    bound[b, w] += cov[1]
    bound[b, b] += cov[2]
    # A mode of two meters at one bus has no loads: its variance of w is 0.
    bound[np.diag_indices(2 * t)] += np.finfo(np.float64).eps * (1.0 + cov[2].max())
    _, failed = lapack.dpotrf(bound, lower=True)
    if failed or (cov[0] < 0.0).any() or (cov[2] <= 0.0).any():
        return None
    mean = whole.mean @ U - (T @ now.theta).reshape(2, t)
    return Record(FilterState(state.t, mean, cov), static.restored(modes, now))


def kept(modes: Modes, before: Record | None, state: FilterState, known: Static, ticks: int) -> Record | None:
    """Record after one calm tick: the present one, or the earlier one where that knows more.

    Parameters
    ----------
    modes, before
        The modes, and the record so far.
    state, known
        The filter, and the information about the directions.
    ticks
        Number of the tick.
    """
    if state.full is None:
        return Record(state, known)
    if ticks % EVERY:
        return before
    found = made(modes, state, known)
    return before if before is not None and before.loss() < found.loss() else found


def to_arrays(modes: Modes, record: Record | None) -> dict[str, Floats]:
    """Persistent form: arrays of p numbers by name; none without a record.

    Parameters
    ----------
    modes, record
        The modes of all meters, and the record.
    """
    if record is None:
        return {}
    state, known, p = record.filter, record.known, modes.size
    T = np.stack([-known.signature[0][:, None] * modes.directions, _felt(modes, known)])
    means = state.mean + T @ known.theta
    rows = (
        *(modes.back @ mean for mean in means),
        *state.cov,
        *known.signature,
        known.information,
        _padded(known.theta[: modes.busbar], p),
        _padded(known.theta[modes.busbar :], p),
        np.full(p, state.t),
        np.full(p, modes.model.time_s),
    )
    return dict(zip((_PREFIX + name for name in _ROWS), rows, strict=True))


def _felt(modes: Modes, known: Static) -> Floats:
    """Change of b in the modes per amount of each direction, (t, r)."""
    return np.asarray(modes.directions * (1.0 - known.signature[1])[:, None])


def _padded(amounts: Floats, p: int) -> Floats:
    """Amounts of at most p directions as p numbers."""
    out = np.zeros(p)
    out[: amounts.size] = amounts
    return out


def is_own(name: str) -> bool:
    """True for the names of `to_arrays`."""
    return name.startswith(_PREFIX)


def from_arrays(modes: Modes, arrays: Mapping[str, Floats]) -> Record | None:
    """Record from the arrays of `to_arrays`; None without any of them, and of another model of the loads.

    With another correlation time T of the loads, the variances have another meaning.

    Raises
    ------
    ValueError
        If the arrays do not fit the modes; names every problem.
    """
    names = [_PREFIX + name for name in _ROWS]
    time_s = arrays.get(_PREFIX + "time_s")
    if time_s is None or (time_s != modes.model.time_s).any():
        return None
    raise_if_any(_problems(modes, arrays, names))
    w, b, var_w, cov_wb, var_b, felt_w, felt_b, information, busbar, meters, t, _ = (
        arrays[name] for name in names
    )
    blank = static.start(modes)
    known = static.current(
        modes,
        replace(
            blank,
            signature=np.stack([felt_w, felt_b]),
            information=information,
            theta=np.concatenate([busbar[: modes.busbar], meters[: modes.sign.size - modes.busbar]]),
        ),
    )
    known = static.restored(modes, known)
    T = np.stack([-felt_w[:, None] * modes.directions, _felt(modes, known)])
    mean = np.stack([w @ modes.U, b @ modes.U]) - T @ known.theta
    return Record(FilterState(float(t[0]), mean, np.stack([var_w, cov_wb, var_b])), known)


def _problems(modes: Modes, arrays: Mapping[str, Floats], names: list[str]) -> list[Problem]:
    """All problems of stored arrays."""
    problems = [Problem("missing", f"{name} is missing") for name in names if name not in arrays]
    if problems:
        return problems
    shape = (modes.size,)
    problems = [
        Problem("shape", f"{name} has the shape {arrays[name].shape}, not {shape}")
        for name in names
        if arrays[name].shape != shape
    ]
    if problems:
        return problems
    finite = [name for name in names if not np.isfinite(arrays[name]).all()]
    if finite:
        return [Problem("not-finite", f"{name} is no number") for name in finite]
    var_w, cov_wb, var_b = (arrays[_PREFIX + name] for name in ("var_w", "cov_wb", "var_b"))
    rules: tuple[tuple[str, Bools], ...] = (
        ("var_w", (var_w >= 0.0) & (var_w <= WIDEST * modes.varying)),
        ("var_b", (var_b > 0.0) & (var_b <= WIDEST * modes.lasting)),
        ("cov_wb", cov_wb * cov_wb <= TOLERANCE * var_w * var_b),
        ("information", arrays[_PREFIX + "information"] >= 0.0),
        ("t", arrays[_PREFIX + "t"] == arrays[_PREFIX + "t"][0]),
    )
    return [
        Problem("out-of-range", f"{_PREFIX}{name} does not fit the feeder")
        for name, good in rules
        if not good.all()
    ]

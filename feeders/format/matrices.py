"""Matrices of lines that are not transposed: from columns, to columns, and their checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from feeders.format.columns import MATRIX_NAMES, PAIRS, SERIES_NAMES, SHUNT_NAMES, LineRow
from feeders.format.reader import CheckReport, Parsed, rows
from gridsec.arrays import Bools, Floats, Phasors

PHASES: Final = "abc"

ROUNDING: Final = 1e-6
"""Tolerance of passivity and singularity, relative to the largest entry of a matrix."""

AGREEMENT: Final = 1e-3
"""Tolerance of r_ohm, x_ohm and b_us against the positive sequence, relative to the largest entry."""

UPPER: Final = np.triu_indices(3)


def cells_of(line: LineRow) -> dict[str, float | None]:
    """Matrix cells of a row by column name."""
    return {name: getattr(line, name) for name in MATRIX_NAMES}


def series_ohm(cells: Mapping[str, Any]) -> Phasors | None:
    """Impedance matrix of a row in phases, ohm, with 0 in absent ones; None without a matrix."""
    r, x = _symmetric(cells, "r", "ohm"), _symmetric(cells, "x", "ohm")
    return None if r is None or x is None else r + 1j * x


def shunt_us(cells: Mapping[str, Any]) -> Floats | None:
    """Matrix of the total shunt susceptances of a row in phases, microsiemens; as `series_ohm`."""
    return _symmetric(cells, "b", "us")


def _symmetric(cells: Mapping[str, Any], symbol: str, unit: str) -> Floats | None:
    upper = [cells.get(f"{symbol}_{pair}_{unit}") for pair in PAIRS]
    if all(value is None for value in upper):
        return None
    matrix = np.zeros((3, 3))
    matrix[UPPER] = [0.0 if value is None else value for value in upper]
    return np.triu(matrix) + np.triu(matrix, 1).T


def columns_of(symbol: str, unit: str, matrix: Floats, present: Bools) -> dict[str, float]:
    """Cells of a symmetric matrix (3, 3) by column name, without those of absent phases.

    `symbol` and `unit` are "r" and "ohm", "x" and "ohm", or "b" and "us"; `present` (3,) is a mask.
    """
    return {
        f"{symbol}_{pair}_{unit}": float(matrix[i, j])
        for pair, i, j in zip(PAIRS, *UPPER, strict=True)
        if present[i] and present[j]
    }


def positive_sequence(matrix: Phasors | Floats) -> complex:
    """Mean of the diagonal less the mean of the other entries: the value for balanced currents."""
    count = len(matrix)
    own = complex(np.trace(matrix))
    return own / count - (complex(matrix.sum()) - own) / max(count * (count - 1), 1)


def passive(matrix: Floats) -> bool:
    """True for a positive semidefinite matrix, real and symmetric, up to rounding."""
    return bool(np.linalg.eigvalsh(matrix)[0] >= -ROUNDING * np.abs(matrix).max())


def check(parsed: Parsed, report: CheckReport) -> None:
    """Report every matrix that is incomplete, inconsistent or physically impossible."""
    needed = ("phases", "r_ohm", "x_ohm", "r0_ohm", "x0_ohm", "b_us", *MATRIX_NAMES)
    for where, cells in rows(parsed.lines, *needed):
        for names, matrix in ((SERIES_NAMES, series_ohm(cells)), (SHUNT_NAMES, shunt_us(cells))):
            given = [name for name in names if cells[name] is not None]
            if given and _complete(where, cells, names, given, report) and matrix is not None:
                _content(where, cells, matrix, report)


def _complete(
    where: str, cells: Mapping[str, Any], names: tuple[str, ...], given: list[str], report: CheckReport
) -> bool:
    """True for a matrix without missing and surplus cells."""
    phases = cells["phases"]
    if len(phases) == 1:
        text = f"{where}, column {given[0]}: a matrix, but phases is {phases!r}; expected none"
        report.problem("inconsistent", text)
        return False
    wanted = [name for name in names if set(name.split("_")[1]) <= set(phases)]
    missing = [name for name in wanted if name not in given]
    extra = [name for name in given if name not in wanted]
    if missing:
        expected = "expected the whole matrix or nothing of it"
        report.problem("missing", f"{where}, columns {', '.join(missing)}: missing; {expected}")
    if extra:
        text = f"of a conductor that is not in phases {phases!r}; expected none"
        report.problem("absent-phase", f"{where}, columns {', '.join(extra)}: {text}")
    return not missing and not extra


def _content(where: str, cells: Mapping[str, Any], whole: Phasors | Floats, report: CheckReport) -> None:
    """Report entries that no passive line has, and contradictions to the row's other cells."""
    here = [PHASES.index(phase) for phase in sorted(cells["phases"])]
    matrix = whole[np.ix_(here, here)]
    one, largest = positive_sequence(matrix), float(np.abs(matrix).max())
    series = np.iscomplexobj(matrix)
    parts = [("r_ohm", one.real), ("x_ohm", one.imag)] if series else [("b_us", one.real)]
    for name, value in parts:
        if abs(cells[name] - value) > AGREEMENT * largest:
            report.problem(
                "inconsistent",
                f"{where}, column {name}: {cells[name]:g} is not the positive sequence of the line's matrix; "
                f"expected {value:.6g}, the mean of its diagonal less that of the rest",
            )
    if not passive(matrix.real):
        fault = "r_aa_ohm to r_cc_ohm: generate power" if series else "b_aa_us to b_cc_us: no capacitances"
        report.problem("not-definite", f"{where}, columns {fault}; expected a positive semidefinite matrix")
    if series and (cells["r0_ohm"] is not None or cells["x0_ohm"] is not None):
        report.problem(
            "inconsistent", f"{where}, columns r0_ohm and x0_ohm: beside a matrix; expected one of the two"
        )
    if series and min(np.linalg.svd(matrix, compute_uv=False)[-1], abs(one)) <= ROUNDING * largest:
        expected = "expected conductors with impedances of their own"
        report.problem("singular", f"{where}, columns r_aa_ohm to x_cc_ohm: are singular; {expected}")

"""Matrices of lines that are not transposed: from columns, to columns, and their checks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from feeders.format.columns import PAIRS, SERIES_COLUMNS, SHUNT_COLUMNS, Column
from feeders.format.reader import CheckReport, Parsed, rows
from gridsec.arrays import Bools, Floats, Phasors
from gridsec.errors import Problem

if TYPE_CHECKING:
    from feeders.format.tables import LineRow

PHASES: Final = "abc"

ROUNDING: Final = 1e-6
"""Tolerance of passivity and singularity, relative to the largest entry of a matrix."""

AGREEMENT: Final = 1e-3
"""Tolerance of r_ohm, x_ohm and b_us against the positive sequence, relative to the largest entry."""

UPPER: Final = np.triu_indices(3)

NAMES: Final = tuple(column.name for column in (*SERIES_COLUMNS, *SHUNT_COLUMNS))
SERIES_NAMES: Final = tuple(column.name for column in SERIES_COLUMNS)
SHUNT_NAMES: Final = tuple(column.name for column in SHUNT_COLUMNS)
_cells = attrgetter(*NAMES)


def cells_of(line: LineRow) -> dict[str, float | None]:
    """Matrix cells of a row by column name."""
    return dict(zip(NAMES, _cells(line), strict=True))


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
    """Cells of a symmetric matrix by column name, without those of absent phases.

    Parameters
    ----------
    symbol, unit
        "r" and "ohm", "x" and "ohm", or "b" and "us".
    matrix : (3, 3)
        Matrix in this unit.
    present : (3,)
        Mask of the phases.
    """
    return {
        f"{symbol}_{pair}_{unit}": float(matrix[i, j])
        for pair, i, j in zip(PAIRS, *UPPER, strict=True)
        if present[i] and present[j]
    }


def positive_sequence(matrix: Phasors | Floats) -> complex:
    """Mean of the diagonal less the mean of the other entries: the value for balanced currents.

    Parameters
    ----------
    matrix : (k, k)
        Matrix of the present phases.
    """
    count = len(matrix)
    own = complex(np.trace(matrix))
    return own / count - (complex(matrix.sum()) - own) / max(count * (count - 1), 1)


def passive(matrix: Floats) -> bool:
    """True for a positive semidefinite matrix, real and symmetric, up to rounding."""
    return bool(np.linalg.eigvalsh(matrix)[0] >= -ROUNDING * np.abs(matrix).max())


def check(parsed: Parsed, report: CheckReport) -> None:
    """Report every matrix that is incomplete, inconsistent or physically impossible."""
    needed = ("phases", "r_ohm", "x_ohm", "r0_ohm", "x0_ohm", "b_us", *NAMES)
    for where, cells in rows(parsed.lines, *needed):
        for columns, matrix in ((SERIES_COLUMNS, series_ohm(cells)), (SHUNT_COLUMNS, shunt_us(cells))):
            if any(cells[column.name] is not None for column in columns):
                wrong = [*_layout(cells, columns)] or [*_content(cells, matrix)]
                report.problems.extend(Problem(problem.code, f"{where}{problem}") for problem in wrong)


def _layout(cells: Mapping[str, Any], columns: tuple[Column, ...]) -> Iterator[Problem]:
    """Missing and surplus cells of a matrix."""
    phases = cells["phases"]
    if len(phases) == 1:
        first = next(column.name for column in columns if cells[column.name] is not None)
        yield Problem("inconsistent", f", column {first}: a matrix, but phases is {phases!r}; expected none")
        return
    wanted = {column.name for column in columns if set(column.name.split("_")[1]) <= set(phases)}
    missing = [column.name for column in columns if column.name in wanted and cells[column.name] is None]
    extra = [
        column.name for column in columns if column.name not in wanted and cells[column.name] is not None
    ]
    if missing:
        yield Problem(
            "missing", f", columns {', '.join(missing)}: missing; expected the whole matrix or nothing of it"
        )
    if extra:
        yield Problem(
            "absent-phase",
            f", columns {', '.join(extra)}: of a conductor that is not in phases {phases!r}; expected none",
        )


def _content(cells: Mapping[str, Any], whole: Phasors | Floats | None) -> Iterator[Problem]:
    """Entries that no passive line has, and contradictions to the row's other cells."""
    if whole is None:
        return
    here = [PHASES.index(phase) for phase in sorted(cells["phases"])]
    matrix = whole[np.ix_(here, here)]
    one, largest = positive_sequence(matrix), float(np.abs(matrix).max())
    series = np.iscomplexobj(matrix)
    parts = [("r_ohm", one.real), ("x_ohm", one.imag)] if series else [("b_us", one.real)]
    for name, value in parts:
        if abs(cells[name] - value) > AGREEMENT * largest:
            yield (
                Problem(
                    "inconsistent",
                    f", column {name}: {cells[name]:g} is not the positive sequence of the line's matrix; "
                    f"expected {value:.6g}, the mean of its diagonal less that of the rest",
                )
            )
    if not series and not passive(matrix.real):
        yield Problem(
            "not-definite",
            ", columns b_aa_us to b_cc_us: no capacitances; expected a positive semidefinite matrix",
        )
    if series and not passive(matrix.real):
        yield Problem(
            "not-definite",
            ", columns r_aa_ohm to r_cc_ohm: generate power; expected a positive semidefinite matrix",
        )
    if series and (cells["r0_ohm"] is not None or cells["x0_ohm"] is not None):
        yield Problem(
            "inconsistent",
            ", columns r0_ohm and x0_ohm: beside a matrix; expected one of the two",
        )
    if series and min(np.linalg.svd(matrix, compute_uv=False)[-1], abs(one)) <= ROUNDING * largest:
        yield Problem(
            "singular",
            ", columns r_aa_ohm to x_cc_ohm: are singular; expected conductors with impedances of their own",
        )

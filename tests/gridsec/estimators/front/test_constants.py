"""Table of constants of the front end and of snapshots against the modules."""

from __future__ import annotations

import ast
import importlib
import re
from collections import Counter
from collections.abc import Iterator
from numbers import Real
from pathlib import Path

import pytest

FOLDERS = ("gridsec.estimators.front", "gridsec.estimators.snapshot")
PAGE = Path(__file__).resolve().parents[4] / "docs" / "constants.md"
ROW = re.compile(r"^\| `(\w+)\.(\w+)` \|(.*)\|$", re.MULTILINE)
CELLS = 3


def rows(text: str) -> list[tuple[str, list[str]]]:
    """Name, and value, unit and reason of each row."""
    return [(f"{m[1]}.{m[2]}", [cell.strip() for cell in m[3].split(" |")]) for m in ROW.finditer(text)]


def assigned(source: str) -> Iterator[str]:
    """Names that a module assigns at its top level."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for part in (part for target in targets for part in ast.walk(target)):
                if isinstance(part, ast.Name):
                    yield part.id


def numeric(value: object) -> bool:
    """Real numbers and tuples of these; truth values are not numbers."""
    if isinstance(value, tuple):
        return bool(value) and all(numeric(each) for each in value)
    return isinstance(value, Real) and not isinstance(value, bool)


def constants(name: str, source: str, values: dict[str, object]) -> dict[str, object]:
    """Numeric constants of a module by qualified name."""
    return {f"{name}.{each}": values[each] for each in assigned(source) if numeric(values[each])}


def problems(text: str, expected: dict[str, object]) -> list[str]:
    """Differences between a page and the constants of the code."""
    found, out = rows(text), []
    counts = Counter(name for name, _ in found)
    out += [f"{name} has {count} rows" for name, count in counts.items() if count > 1]
    out += [f"{name} has no row" for name in expected if name not in counts]
    for name, cells in found:
        if name not in expected:
            out.append(f"{name} is not a constant of the code")
        elif len(cells) != CELLS or not all(cells):
            out.append(f"{name} lacks a value, a unit or a reason")
        elif ast.literal_eval(cells[0]) != expected[name]:
            out.append(f"{name} is {expected[name]!r}, not {cells[0]}")
    return out


def every() -> dict[str, object]:
    """Numeric constants of all modules of the folders."""
    out: dict[str, object] = {}
    for package in FOLDERS:
        for path in sorted(Path(next(iter(importlib.import_module(package).__path__))).glob("*.py")):
            name = package if path.stem == "__init__" else f"{package}.{path.stem}"
            out |= constants(path.stem, path.read_text(), vars(importlib.import_module(name)))
    return out


def test_the_page_lists_every_constant_with_its_value_unit_and_reason() -> None:
    assert problems(PAGE.read_text(), every()) == []


def test_assignments_of_numbers_tuples_and_expressions_are_constants() -> None:
    source = 'A, _B = 1, (2.0, -3)\n_C: int = 1 << 4\nD = "text"\nE = True\nF = ()\ndef f():\n    G = 1\n'
    values: dict[str, object] = {}
    exec(compile(source, "module", "exec"), values)
    assert constants("m", source, values) == {"m.A": 1, "m._B": (2.0, -3), "m._C": 16}


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("| `m.A` | 1 | s | A reason. |", []),
        ("", ["m.A has no row"]),
        ("| `m.A` | 2 | s | A reason. |", ["m.A is 1, not 2"]),
        ("| `m.A` | 1 |  | A reason. |", ["m.A lacks a value, a unit or a reason"]),
        ("| `m.A` | 1 | s |  |", ["m.A lacks a value, a unit or a reason"]),
        ("| `m.A` | 1 | s |", ["m.A lacks a value, a unit or a reason"]),
        ("| `m.A` | 1 | s | R. |\n| `m.A` | 1 | s | R. |", ["m.A has 2 rows"]),
        ("| `m.A` | 1 | s | R. |\n| `m.B` | 1 | s | R. |", ["m.B is not a constant of the code"]),
    ],
)
def test_a_faulty_page_is_reported(text: str, wrong: list[str]) -> None:
    assert problems(text, {"m.A": 1}) == wrong

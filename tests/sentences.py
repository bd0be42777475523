"""Codes that a source states, and golden files of the sentences of errors."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gridsec.errors import GridsecError, InputInvalid, Problems

LISTING = {"FeederInvalid", "InputInvalid", "RecordingInvalid", "NoInverters", "OtherFeeder"}
"""Errors that list problems: each problem has its own code."""


def _name(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def _texts(node: ast.expr) -> Iterator[str]:
    """Strings that an expression states: a constant, or both values of a choice."""
    if isinstance(node, ast.IfExp):
        yield from _texts(node.body)
        yield from _texts(node.orelse)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value


def codes_in(source: str) -> set[str]:
    """Literal codes of a module.

    `Problem(...)`, `InputInvalid.of(...)`, `report.problem(...)`, arguments `code=...` and their defaults,
    class attributes.
    """
    out: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            named = _name(node) in {"Problem", "problem"} or ast.unparse(node.func) == "InputInvalid.of"
            if named and node.args:
                out.update(_texts(node.args[0]))
            for each in node.keywords:
                if each.arg == "code":
                    out.update(_texts(each.value))
        elif isinstance(node, ast.arguments):
            for argument, default in zip(node.kwonlyargs, node.kw_defaults, strict=True):
                if argument.arg == "code" and default is not None:
                    out.update(_texts(default))
        elif isinstance(node, ast.ClassDef):
            for statement in node.body:
                if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "code":
                    out.update(_texts(statement.value))
    return out


def _plain(node: ast.expr) -> bool:
    """A sentence without a code, or a collection with one."""
    if isinstance(node, ast.List | ast.Tuple):
        return any(map(_plain, node.elts))
    if isinstance(node, ast.Starred):
        return _plain(node.value)
    if isinstance(node, ast.GeneratorExp | ast.ListComp):
        return _plain(node.elt)
    return isinstance(node, ast.JoinedStr | ast.Constant)


def uncoded(source: str) -> list[int]:
    """Lines of a module that raise a ValueError, or an error of the project, without a code."""
    out = []
    for node in ast.walk(ast.parse(source)):
        if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)):
            continue
        call, name = node.exc, _name(node.exc)
        coded = any(each.arg == "code" for each in call.keywords)
        if (
            name == "ValueError"
            or (name == "GridsecError" and not coded)
            or (name in LISTING and any(map(_plain, call.args)))
        ):
            out.append(node.lineno)
    return sorted(out)


def used(package: Path) -> set[str]:
    """Codes of a package."""
    return set().union(*(codes_in(path.read_text("utf-8")) for path in package.rglob("*.py")))


def golden(path: Path) -> dict[str, list[str]]:
    """Lines of a golden file by call, without the call."""
    out: dict[str, list[str]] = {}
    for each in path.read_text("utf-8").splitlines():
        call, rest = each.split(" | ", 1)
        out.setdefault(call, []).append(rest)
    return out


def sentences(made: Callable[[], Any]) -> list[str]:
    """Class, code and sentence of each problem that a call raises."""
    try:
        made()
    except (InputInvalid, GridsecError) as caught:
        error = caught
    else:
        pytest.fail("the call is not refused")
    texts = error.problems if isinstance(error, Problems) else (str(error),)
    found = zip(error.codes, texts, strict=True)
    return [f"{type(error).__name__} | {code} | {text}" for code, text in found]

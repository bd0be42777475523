"""Three-phase feeders: what they derive, and every problem of a wrong one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from gridsec.errors import FeederInvalid
from gridsec.grid.three_phase import ThreePhaseFeeder, sequence_matrix
from tests.codes import refused
from tests.gridsec.unbalanced import random_three_phase


def street(**changes: Any) -> ThreePhaseFeeder:
    """Busbar - b1 - b2, and a lateral of phase b from b1 to b3."""
    z = np.repeat(sequence_matrix(np.array(0.01 + 0.005j), np.array(0.03 + 0.01j))[None], 3, axis=0)
    z[2] = np.diag([0.0, 0.02 + 0.01j, 0.0])
    fields: dict[str, Any] = {
        "name": "street",
        "parent": np.array([0, 1, 1]),
        "z": z,
        "phases": np.array([[1, 1, 1], [1, 1, 1], [1, 1, 1], [0, 1, 0]], dtype=bool),
        "bus": np.array([2, 3, 1]),
        "connected": np.array([[1, 1, 1], [0, 1, 0], [0, 0, 1]], dtype=bool),
        "customers": ("farm", "house", "shop"),
        "buses": ("busbar", "b1", "b2", "b3"),
        "base_volt": 230.0,
        "base_kva": 90.0,
        "charging": np.zeros((3, 3, 3)),
    }
    return ThreePhaseFeeder(**{**fields, **changes})


def test_connections_of_customers() -> None:
    feeder = street()
    np.testing.assert_array_equal(feeder.of, [0, 0, 0, 1, 2])
    np.testing.assert_array_equal(feeder.at, [2, 2, 2, 3, 1])
    np.testing.assert_array_equal(feeder.phase, [0, 1, 2, 1, 2])
    powers = np.array([[3.0, 1.0, 2.0], [6.0, 0.0, 0.0]])
    np.testing.assert_allclose(feeder.connections(powers), [[1, 1, 1, 1, 2], [2, 2, 2, 0, 0]])


@given(st.complex_numbers(max_magnitude=10), st.complex_numbers(max_magnitude=10))
def test_sequences_are_the_eigenvalues(positive: complex, zero: complex) -> None:
    """Fortescue's matrix makes the phase matrix diagonal: zero, positive and negative sequence."""
    a = np.exp(2j * np.pi / 3)
    A = np.array([[1, 1, 1], [1, a**2, a], [1, a, a**2]])
    found = np.linalg.inv(A) @ sequence_matrix(np.array(positive), np.array(zero)) @ A
    np.testing.assert_allclose(found, np.diag([zero, positive, positive]), rtol=0, atol=1e-13 * 10)


@given(st.integers(0, 100_000))
def test_fields_cannot_be_written(seed: int) -> None:
    feeder = random_three_phase(seed)
    for name in ("parent", "z", "phases", "bus", "connected", "charging", "of", "at", "share", "half"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(feeder, name)[...] = 0


def changed(block: int, place: tuple[int, int], value: complex) -> Any:
    z = street().z.copy()
    z[block][place] = value
    return z


@pytest.mark.parametrize(
    ("changes", "codes"),
    [
        ({"z": np.zeros((2, 3, 3))}, ("shape",)),
        ({"base_volt": 0.0}, ("not-positive",)),
        ({"base_kva": np.nan}, ("not-positive",)),
        ({"parent": np.array([0, 2, 1])}, ("not-radial",)),
        ({"z": changed(0, (0, 1), 1.0)}, ("not-symmetric", "not-definite")),
        ({"z": changed(0, (0, 1), np.nan)}, ("not-finite",)),
        ({"z": changed(2, (0, 0), 0.1)}, ("absent-phase",)),
        ({"z": changed(2, (1, 1), 0.0)}, ("zero-impedance",)),
        ({"z": changed(2, (1, 1), -0.1)}, ("not-definite",)),
        ({"charging": np.full((3, 3, 3), np.inf)}, ("not-finite",) * 3),
        ({"phases": np.array([[1, 0, 1], [1, 0, 1], [1, 0, 1], [0, 1, 0]])}, ("absent-phase",) * 4),
        (
            {"phases": np.array([[1, 1, 1], [1, 1, 1], [1, 1, 1], [0, 0, 0]])},
            ("no-phase", "absent-phase", "absent-phase"),
        ),
        ({"bus": np.array([2, 4, 1])}, ("unknown-index",)),
        ({"bus": np.array([3, 3, 1])}, ("absent-phase",)),
        ({"connected": np.zeros((3, 3), dtype=bool)}, ("no-phase",) * 3),
        ({"customers": ("x", "x", "y")}, ("duplicate",)),
    ],
)
def test_problems_are_named(changes: dict[str, Any], codes: tuple[str, ...]) -> None:
    with refused(FeederInvalid, *codes):
        street(**changes)


def test_all_problems_at_once() -> None:
    with refused(
        FeederInvalid, "not-positive", "zero-impedance", "unknown-index", "unknown-index", "unknown-index"
    ):
        replace(street(), base_volt=-1.0, bus=np.array([9, 9, 9]), z=changed(2, (1, 1), 0.0))

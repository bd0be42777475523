"""Choices and numbers of designs: what means nothing is refused, and never means something else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gridsec.errors import InputInvalid
from gridsec.estimators.exact_bank import bank
from gridsec.observers import circle, circle_discrete, high_gain, luenberger
from gridsec.observers.lmi.discrete import discrete_options
from gridsec.observers.lmi.sampled import DiscreteLure
from gridsec.observers.unknown_input import exact
from gridsec.secure import isolation, windows
from gridsec.secure.decode import Stack, gaussian
from gridsec.secure.index import asymptotic_index, dynamic_index, redundant_detectable, redundant_observable
from tests.codes import refused
from tests.gridsec.observers.bent import estimator
from tests.gridsec.plants import street

C = np.array([[1.0, 0], [0, 1], [1, 1], [1, -1], [1, 2]])
A = np.array([[1.0, 0.1], [0, 0.9]])
ALL = np.ones(3, dtype=np.bool_)


def feeder() -> Any:
    return street([0, 1, 2], [1, 2, 3], [0, 1, 2], [0, 1, 2]).lure


def discrete() -> DiscreteLure:
    return DiscreteLure.of(
        [[0.2, 0.5], [0.2, 0.3]], [[1, 1], [1, 2], [3, 2]], G=np.eye(2), H=np.eye(2), B=np.eye(2),
        phi=lambda z: 0.5 * np.sin(z), lower=-0.5, upper=0.5,
    )  # fmt: skip


def isolating(**more: Any) -> Any:
    given = {"max_inputs": 2, "max_sensors": 1} | more
    return isolation.design(exact(discrete(), inputs=np.eye(2)), **given)


def partial(**more: Any) -> Any:
    bounds = luenberger.Bounds(process=1e-3, noise=np.full(5, 0.01), E=np.eye(2))
    return luenberger.design(A, np.zeros((2, 1)), C, bounds, slowest=0.0, tol=1e-9, **more)


def chosen(rule: Any) -> Any:
    prepared = gaussian.design_hypotheses(Stack.of_rows(C), np.eye(5), q=1)
    return gaussian.choose(prepared, np.arange(5.0), rule=rule)


def windowed(rule: Any) -> Any:
    return windows.isolation(np.ones((4, 3)), np.ones(3), ~np.eye(3, dtype=bool), 4, rule)


WRONG: dict[str, tuple[tuple[str, ...], Callable[[], Any]]] = {
    "bank": (("unknown-name",), lambda: bank.design(feeder(), 1, gains="lmi")),  # type: ignore[arg-type]
    "circle": (("unknown-name",), lambda: circle.design(feeder(), ALL, gains="riccati")),  # type: ignore[arg-type]
    "circle_discrete": (
        ("unknown-name",),
        lambda: circle_discrete.design(discrete(), ALL, gains="direct"),  # type: ignore[arg-type]
    ),
    "windows": (("unknown-name",), lambda: windowed("survivor")),
    "gaussian": (("unknown-name",), lambda: chosen("desity")),
    "luenberger": (("unknown-name",), lambda: partial(gains="kalman")),
    "discrete": (
        ("out-of-range", "not-positive"),
        lambda: discrete_options(discrete(), decays=(1.5, -1), noise=-1.0),
    ),
    "measure": (("unknown-name",), lambda: isolating(measure="distances")),
    "multiplier": (("unknown-name",), lambda: isolating(multiplier="diag")),
    "rates": (("missing",), lambda: isolating(rates=())),
    "sensors": (("negative",), lambda: isolating(max_sensors=-1)),
    "both counts": (("negative", "negative"), lambda: isolating(max_inputs=-1, max_sensors=-2)),
    "search": (("unknown-name",), lambda: estimator(search="single")),
    "decay": (("unknown-name",), lambda: estimator(decay="kim")),
    "lowest": (("negative",), lambda: estimator(lowest=-1.0)),
    "noise": (("negative",), lambda: estimator(noise=-1e-3)),
    "noise that is no number": (("negative",), lambda: estimator(noise=np.nan)),
    "dynamic": (("unknown-name",), lambda: dynamic_index(A, C, tol=1e-9, by="ranks")),  # type: ignore[arg-type]
    "asymptotic": (
        ("unknown-name",),
        lambda: asymptotic_index(A, C, discrete=True, tol=1e-9, by="ranks"),  # type: ignore[arg-type]
    ),
    "observable": (
        ("unknown-name",),
        lambda: redundant_observable(A, C, 1, tol=1e-9, by="ranks"),  # type: ignore[arg-type]
    ),
    "detectable": (
        ("unknown-name",),
        lambda: redundant_detectable(A, C, 1, discrete=True, tol=1e-9, by="ranks"),  # type: ignore[arg-type]
    ),
}


@pytest.mark.parametrize(("codes", "made"), WRONG.values(), ids=WRONG)
def test_what_means_nothing_is_refused(codes: tuple[str, ...], made: Callable[[], Any]) -> None:
    with refused(InputInvalid, *codes):
        made()


def test_what_means_something_is_taken() -> None:
    assert isolating(measure="distance", multiplier="scalar").measure == "distance"
    assert chosen("density").hypothesis == chosen("tail").hypothesis
    assert windowed("survivors").decided.all()
    assert windowed("majority").decided.all()
    assert len(partial(gains="riccati").envelopes) == 5
    asked = discrete_options(discrete(), decays=np.float32(0.5), noise=0.1)  # type: ignore[arg-type]
    assert asked.decays == (0.5,)


def test_without_a_lower_bound_of_the_gains_no_bound_of_the_error_is_claimed() -> None:
    """A gain of 0 bounds nothing: the same answers as with a positive one, without the certificate."""
    for lowest in (0.0, 1.0):
        design = estimator(lowest=lowest)
        state = high_gain.init(design, 0.0)
        for _ in range(300):
            state, answer = high_gain.step(design, state, np.zeros(3), np.zeros(1), ALL, 0.02)
        assert (answer.bound == np.inf) == (lowest == 0.0)
        assert not answer.suspects.any()
        assert answer.decision == "clean"

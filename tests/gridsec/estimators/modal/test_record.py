"""Record of the learned errors: the same filter after a restart, upper bounds, refused arrays."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Source
from gridsec.arrays import Floats
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal import full, record, static
from gridsec.estimators.modal.filter import FilterState
from gridsec.estimators.modal.model import Modes, ResidualModel, modes
from gridsec.estimators.modal.static import Static
from tests.gridsec.estimators.modal.test_detector import busbar
from tests.gridsec.estimators.modal.test_filter import masks, mixed, proportional

TICKS = 60


def run(model: ResidualModel, seen: object = None) -> tuple[Modes, FilterState, Static]:
    """A filter after some ticks."""
    made, readings = modes(model), Source(model, np.random.default_rng(2)).ticks(TICKS)
    state, known = modal.start(made, 0.0), static.start(made)
    for k, m in enumerate(readings):
        read = None if seen is None else np.asarray(seen)[k]
        state, known, _ = full.step(made, state, known, float(k), m, read)
    return made, state, known


def stored(made: Modes, kept: record.Record | None) -> dict[str, Floats]:
    """The arrays after a way through JSON."""
    arrays = record.to_arrays(made, kept)
    text = json.dumps({name: values.tolist() for name, values in arrays.items()})
    return {name: np.array(values) for name, values in json.loads(text).items()}


@pytest.mark.parametrize("make", [proportional, busbar, mixed])
def test_the_filter_goes_on_as_before(make: object) -> None:
    """Innovations after the restart equal those without one, also with eigenvectors of other signs."""
    assert callable(make)
    made, state, known = run(make())
    signs = np.where(np.arange(made.size) % 2, -1.0, 1.0)
    other = replace(
        made, U=made.U * signs, back=made.back * signs, directions=made.directions * signs[:, None]
    )
    read = record.from_arrays(other, stored(made, record.made(made, state, known)))
    assert read is not None
    assert read.filter.t == state.t
    new, more, scale = read.filter, read.known, np.sqrt(np.diag(made.noise))
    for k, m in enumerate(Source(made.model, np.random.default_rng(7)).ticks(5)):
        t = TICKS + 100.0 * k
        state, known, _ = full.step(made, state, known, t, m)
        new, more, _ = full.step(other, new, more, t, m)
        one, two = made.U @ known.score, other.U @ more.score
        assert np.allclose(one * scale, two * scale, atol=1e-6)
        whole = [full.expanded(made, state, known), full.expanded(other, new, more)]
        assert np.allclose(whole[0].mean, whole[1].mean, atol=1e-9)
        assert np.allclose(whole[0].cov, whole[1].cov, atol=1e-6 * np.abs(whole[0].cov).max())


@pytest.mark.parametrize("make", [proportional, busbar, mixed])
@pytest.mark.parametrize("kind", ["outage", "half", "random"])
def test_a_record_with_missing_readings_is_an_upper_bound(make: object, kind: str) -> None:
    """``P of the record - P`` has no eigenvalue below 0, and the means are the same."""
    assert callable(make)
    made, state, known = run(make(), masks(kind, 12, TICKS))
    kept = record.made(made, state, known)
    assert state.full is not None
    read = record.from_arrays(made, stored(made, kept))
    assert read is not None
    whole = full.expanded(made, read.filter, read.known)
    size = np.abs(whole.cov).max()
    assert np.linalg.eigvalsh(whole.cov - state.full.cov).min() > -1e-8 * size
    if kind != "half":
        # It knows more than the prior; where half of the meters never report, it need not.
        assert np.allclose(whole.mean, state.full.mean, atol=1e-9)
        assert np.diag(whole.cov)[made.size :].sum() < 0.5 * np.trace(made.covariance_b)


def test_a_record_is_kept_until_a_better_one_is_made() -> None:
    """Complete readings give one at every tick; missing ones at every `EVERY`-th, if it knows more."""
    made, state, known = run(proportional())
    first = record.kept(made, None, state, known, 1)
    assert first is not None
    _, silent, more = run(proportional(), masks("random", 12, TICKS))
    assert record.kept(made, first, silent, more, 1) is first
    assert record.kept(made, first, silent, more, record.EVERY) is first
    assert record.kept(made, None, silent, more, record.EVERY) is not None


def test_no_record_no_arrays() -> None:
    """Neither direction invents anything."""
    made = modes(proportional())
    assert record.to_arrays(made, None) == {}
    assert record.from_arrays(made, {"bias": np.zeros(12)}) is None


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("filter.var_b", np.full(12, 1e6), "filter.var_b does not fit"),
        ("filter.var_w", np.full(12, -1.0), "filter.var_w does not fit"),
        ("filter.cov_wb", np.full(12, 1e3), "filter.cov_wb does not fit"),
        ("filter.information", np.full(12, -1.0), "filter.information does not fit"),
        ("filter.t", np.arange(12.0), "filter.t does not fit"),
        ("filter.w", np.full(12, np.nan), "filter.w is no number"),
        ("filter.b", np.zeros(3), "filter.b has the shape"),
        ("filter.b", None, "filter.b is missing"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(name: str, value: Floats | None, what: str) -> None:
    """The message names the array."""
    made, state, known = run(proportional())
    arrays = record.to_arrays(made, record.made(made, state, known))
    if value is None:
        del arrays[name]
    else:
        arrays[name] = value
    with pytest.raises(ValueError, match=what):
        record.from_arrays(made, arrays)


def test_a_record_of_another_model_of_the_loads_is_left_out() -> None:
    """Another correlation time, and arrays without one, as stored by earlier versions."""
    made, state, known = run(proportional())
    arrays = record.to_arrays(made, record.made(made, state, known))
    other = modes(replace(made.model, time_s=2.0 * made.model.time_s))
    assert record.from_arrays(made, arrays) is not None
    assert record.from_arrays(other, arrays) is None
    del arrays["filter.time_s"]
    assert record.from_arrays(made, arrays) is None

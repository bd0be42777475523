"""Errors of the observed injections against curves that are integrated in short steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Floats
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.observer import injection_range, relaxed
from gridsec.estimators.front.state import InjectionError
from tests.gridsec.estimators.modal.streets import prepare
from tests.gridsec.street import make_plant

STEPS = 200
"""Short steps of an interval."""


def made(seed: int) -> FrontDesign:
    return prepare(make_plant(np.random.default_rng(seed), customers=12, drop=0.08)).front


def begun(design: FrontDesign, y: Floats, width: Floats) -> InjectionError:
    """Known injections, with the squared voltages at the inputs and their largest errors, (m,)."""
    return InjectionError(np.zeros(y.size), y, width, design.plant.droop.span)


def within(random: np.random.Generator, low: Floats, high: Floats) -> Floats:
    """A path of `STEPS` inputs between two limits, (STEPS, m); a part of it on the limits."""
    share = np.clip(random.normal(0.5, 0.7, (STEPS // 20, low.size)), 0.0, 1.0).repeat(20, axis=0)
    return np.asarray(low + share * (high - low))


@pytest.mark.parametrize("seed", range(20))
def test_no_injection_is_farther_off_than_its_error(seed: int) -> None:
    """Any true input within the width of the range of two frames, and any observed one in this range."""
    random, design = np.random.default_rng(seed), made(seed)
    droop, h = design.plant.droop, float(random.uniform(0.2, 6.0))
    size = droop.tau.size
    told = random.uniform(0.85, 1.17, (2, size))
    width = random.uniform(0.0, 0.03, (2, size))
    before = InjectionError(np.zeros(size), told[0], width[0], droop.span)
    low, high, wider = told.min(axis=0), told.max(axis=0), width.max(axis=0)
    true, seen = within(random, low - wider, high + wider), within(random, low, high)
    x = observed = droop(droop.vbar**2 - told[0])
    decay = np.exp(-h / STEPS / droop.tau)
    for own, other in zip(true, seen, strict=True):
        x = droop(droop.vbar**2 - own) + decay * (x - droop(droop.vbar**2 - own))
        observed = droop(droop.vbar**2 - other) + decay * (observed - droop(droop.vbar**2 - other))
    target = injection_range(design, before, told[1], width[1])
    after = relaxed(design, before, told[1], width[1], target, h)
    assert (np.abs(x - observed) <= after.error + 1e-12).all()
    steep = droop.slope * (wider + high - low) + design.mismatch
    assert (target <= np.minimum(steep, droop.span) + 1e-12).all()


def test_an_input_on_a_flat_part_of_the_curve_does_not_matter() -> None:
    design = made(0)
    droop = design.plant.droop
    flat = 0.5 * (droop.v[:, 1] ** 2 + droop.v[:, 2] ** 2)
    has_one = droop.v[:, 2] > droop.v[:, 1]
    before = begun(design, flat, 0.9 * (droop.v[:, 2] ** 2 - flat))
    found = injection_range(design, before, before.input, before.width)
    assert np.allclose(found, design.mismatch, rtol=0.0, atol=1e-15)
    wider = injection_range(design, before, before.input, 1.5 * before.width)
    assert has_one.any()
    assert (wider > design.mismatch + 1e-6)[has_one].all()


def test_an_input_on_a_ramp_counts_by_the_slope() -> None:
    """And beyond the end of the curve by the saturation."""
    design = made(0)
    droop = design.plant.droop
    y = (0.5 * (droop.v[:, 2] + droop.v[:, 3])) ** 2
    before = begun(design, y, np.full(y.size, 1e-4))
    slope = (droop.q[:, 2] - droop.q[:, 3]) / (droop.v[:, 3] ** 2 - droop.v[:, 2] ** 2)
    moved = replace(before, input=y - 2e-4)
    target = injection_range(design, moved, y, before.width)
    assert np.allclose(target, slope * 3e-4 + design.mismatch, rtol=1e-9)
    far = injection_range(design, before, y, np.ones(y.size))
    whole = droop(droop.vbar**2 - y + 1.0) - droop(droop.vbar**2 - y) + design.mismatch
    assert np.allclose(far, np.minimum(droop.span, whole))

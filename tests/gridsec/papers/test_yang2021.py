"""yang2021: what comes out as printed, what does not, and why it cannot."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gridsec.errors import InputInvalid
from gridsec.observers.lmi.sampled import advance
from gridsec.observers.unknown_input import obstruction
from gridsec.papers import yang2021, yang2021_feeder
from gridsec.secure.isolation import design
from tests.codes import refused
from tests.gridsec.papers.made import made


@pytest.mark.acceptance
def test_every_claim_that_is_not_met_has_a_reason() -> None:
    found = made("yang2021")
    assert found.paper == "yang2021"
    assert len(found.claims) == 24
    assert [claim.what for claim in found.unmet] == [
        "… that exist",
        "partial observers that exist",
        "attack on any one sensor",
        "attack on any one input and sensor",
    ]
    assert all(claim.why for claim in found.unmet)
    names = [figure.name for figure in found.figures]
    assert names == [f"yang2021-figure-{i}" for i in range(1, 13)] + ["yang2021-feeder"]
    for figure in found.figures[:12]:
        for panel in figure.panels:
            assert [line.label for line in panel.lines] == ["truth", "estimate"]


@pytest.mark.canary("10.0-False")
@pytest.mark.parametrize("corrected", [False, True])
@pytest.mark.parametrize("amplitude", [1.0, 10.0])
def test_the_figures_come_out_for_ten_seeds(amplitude: float, corrected: bool) -> None:
    for seed in range(10):
        one = yang2021.simulate(1, amplitude, corrected=corrected, seed=seed)
        two = yang2021.simulate(2, amplitude, corrected=corrected, seed=seed)
        np.testing.assert_allclose(one.x_hat[-1], one.x[-1], atol=1e-9)
        np.testing.assert_allclose(two.x_hat[-1], two.x[-1], atol=1e-4)
        np.testing.assert_allclose(one.a_u_hat[-2], one.a_u[-2], atol=1e-9)
        np.testing.assert_allclose(two.a_y_hat[-1], two.a_y[-1], atol=1e-3)
        assert one.named(5) == ((1, 2), (2,))
        assert two.named(5) == ((3,), (2,))


def test_corrections_are_the_smallest_of_one_entry() -> None:
    """Example 2: no integer in any one entry will do; 0.4 is the nearest value, to a tenth, that does."""

    def complete(value: float, row: int, column: int) -> bool:
        plant = yang2021.plant(2)
        C = plant.system.C.copy()
        C[row, column] = value
        system = type(plant.system)(
            *(getattr(plant.system, name) for name in "AGHFB"), C, plant.system.D, plant.system.lower,
            plant.system.upper, plant.system.phi,
        )  # fmt: skip
        changed = type(plant)(system, plant.inputs, plant.noise, plant.drift, plant.span)
        pairs = itertools.product(itertools.combinations(range(3), 2), itertools.combinations(range(4), 2))
        return all(obstruction(changed, pair, tolerance=1e-9) is None for pair in pairs)

    printed = yang2021.plant(2).system.C
    works = []
    for row, column in itertools.product(range(4), range(3)):
        for tenths in range(-60, 61):
            value = printed[row, column] + tenths / 10
            if complete(value, row, column):
                works.append((abs(tenths), row, column, round(value, 1)))
    assert min(works)[1:] == yang2021.CORRECTION_2
    assert not [w for w in works if w[3] == int(w[3])]


@pytest.mark.parametrize("example", [1, 2])
def test_two_histories_fit_the_same_readings(example: int) -> None:
    """Both obey (1) with no more attacks than assumed, and end as far apart as one likes."""
    plant = yang2021.plant(example)
    for size in (2.0, 2e3):
        story = yang2021.doubt(example, size)
        assert np.linalg.norm(story.x[0, -1] - story.x[1, -1]) > size
        for x, (inputs, sensors) in zip(story.x, story.attacked, strict=True):
            a_y = story.y - x @ plant.system.C.T
            assert set(np.flatnonzero(np.abs(a_y).max(axis=0) > 1e-9 * size)) <= set(sensors)
            free = np.array([advance(plant.system, x[k], story.u[k]) for k in range(len(x) - 1)])
            a_u = (x[1:] - free) @ np.linalg.pinv(plant.inputs).T
            np.testing.assert_allclose(a_u @ plant.inputs.T, x[1:] - free, atol=1e-9 * size)
            assert set(np.flatnonzero(np.abs(a_u).max(axis=0) > 1e-9 * size)) <= set(inputs)
        # Whoever estimates from these readings is wrong by half the distance in one of them; so is the bank.
        gap = np.linalg.norm(story.x[0, -1] - story.x[1, -1])
        assert yang2021.doubt_error(example, size) >= 0.5 * gap * (1 - 1e-9)


def test_printed_injection_of_35_is_zero() -> None:
    """Gbar B = 0 in a complete observer: (35) as printed would not use y+, and does not fit."""
    plant = yang2021.plant(1)
    C = plant.system.C[[0, 2, 3]]
    left = np.linalg.pinv(C @ plant.inputs)
    blind = np.eye(2) - plant.inputs @ left @ C
    np.testing.assert_allclose(blind @ plant.inputs, 0.0, atol=1e-12)
    assert (blind @ plant.inputs).shape != (2, len(C))
    assert (plant.inputs @ left).shape == (2, len(C))


def test_printed_sign_in_39_is_wrong() -> None:
    """`a_u = B^+ (x_hat+ - A x_hat - f(x_hat - e)) - u - B^+ (e+ - A e)`; the paper has + A e."""
    plant, rng = yang2021.plant(2), np.random.default_rng(0)
    A, B, phi = plant.system.A, plant.inputs, plant.system.phi
    x, e, after, u, a = (rng.standard_normal(3) for _ in range(5))
    forward = A @ x + phi(x) + B @ (u + a)
    left = np.linalg.pinv(B)
    seen = left @ (forward + after - A @ (x + e) - phi(x)) - u
    np.testing.assert_allclose(seen - left @ (after - A @ e), a, atol=1e-12)
    assert np.max(np.abs(seen - left @ (after + A @ e) - a)) > 0.1


def test_support_of_a_finite_reconstruction_is_everything() -> None:
    """(46), (47) without a threshold name honest inputs and sensors for ever."""
    run = yang2021.simulate(2, 10.0)
    assert np.count_nonzero(run.a_y_hat[-1]) == 4
    assert np.count_nonzero(run.a_u_hat[-2]) == 3
    assert run.named(5) == ((3,), (2,))


def test_certified_names_come_late_on_the_smallest_correction() -> None:
    """Zeros up to 0.9917 leave bounds that need a thousand steps; the names are right all the same."""
    run = yang2021.simulate(2, 10.0, corrected=True, steps=2500)
    last = run.answers[-1]
    assert (list(np.flatnonzero(last.inputs)), list(np.flatnonzero(last.sensors))) == ([2], [1])
    assert np.all(np.abs(run.x_hat - run.x) <= run.bound)
    first = next(k for k, answer in enumerate(run.answers) if answer.inputs.any() and answer.sensors.any())
    assert 50 < first < 2000


def test_the_line_is_that_of_the_files() -> None:
    from feeders.model.site import load

    theirs, ours = load("kerber-landnetz").feeder, yang2021_feeder.feeder()
    np.testing.assert_array_equal(theirs.parent, ours.parent)
    np.testing.assert_allclose(theirs.r, ours.r, rtol=1e-5)
    np.testing.assert_allclose(theirs.x, ours.x, rtol=1e-5)
    with refused(InputInvalid, "out-of-range"):
        yang2021.plant(3)


def test_what_does_hold_as_printed() -> None:
    """Example 1: q = 0. Example 2: one attacked input and no attacked sensor."""
    assert design(yang2021.plant(1), max_inputs=2, max_sensors=0).guaranteed
    assert design(yang2021.plant(2), max_inputs=1, max_sensors=0).guaranteed
    assert [one.pair for one in design(yang2021.plant(2), max_inputs=0, max_sensors=1).missing] == [
        ((), (1, 2))
    ]

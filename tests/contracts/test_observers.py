"""What every family of observers owes, checked on every family and every small plant alike.

A new family is one more entry of FAMILIES. Nothing below knows which family it is looking at.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec import observers
from gridsec.arrays import Floats
from tests.contracts import circles, discrete, high_gain, partial, unknown_input
from tests.contracts.member import Family, Member, Run

FAMILIES: dict[str, Family] = {
    "circle-direct": circles.family("direct"),
    "circle-lmi": circles.family("lmi"),
    "circle-discrete": discrete.family(),
    "luenberger": partial.luenberger_family(),
    "kalman": partial.kalman_family(),
    "high-gain": high_gain.family(),
    "unknown-input": unknown_input.family(),
}
# Long courses of what their own tests cover: coverage would take half as much time again.
UNTRACED = {"high-gain"}
EVERY = [
    pytest.param(name, which, marks=[pytest.mark.no_cover] if name in UNTRACED else [])
    for name, family in FAMILIES.items()
    for which in family.members
]
BATCHES = [(name, which) for name, family in FAMILIES.items() for which in family.batches]


@functools.cache
def member(family: str, which: str) -> Member:
    """Designs take time, so each is made once."""
    return FAMILIES[family].members[which]()


def follow(one: Member, run: Run) -> list[object]:
    """The states after each call, all sensors seen."""
    state, out = one.start(run), []
    everyone = np.ones(run.r.shape[1], dtype=bool)
    for k in range(run.calls):
        state = one.step(state, run.r[k], run.u[k], everyone, run.h)
        out.append(state)
    return out


def apart(one: Member, a: list[Floats], b: list[Floats]) -> Floats:
    return one.norms([x - y for x, y in zip(a, b, strict=True)])


def residuals(one: Member, run: Run, states: list[object]) -> list[Floats]:
    """(c, p) after each call."""
    pairs = enumerate(states)
    return [np.abs(run.r[k + run.ahead] - one.outputs(state, run.u[k + run.ahead])) for k, state in pairs]


@pytest.mark.canary("circle-direct-line-most", "unknown-input-feeder")
@pytest.mark.parametrize(("family", "which"), EVERY)
def test_decays_at_the_certified_rate(family: str, which: str) -> None:
    one = member(family, which)

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=4, deadline=None)
    def check(seed: int) -> None:
        run = one.free(np.random.default_rng(seed))
        first = apart(one, one.estimates(one.start(run)), one.code(run.first))
        assert np.all(first > 0.0)
        for k, state in enumerate(follow(one, run)):
            now = apart(one, one.estimates(state), one.code(run.x[k]))
            assert np.all(now <= first * (one.decay(k + 1) + one.slack))
        # The claim is worth something: it is about errors that have become small.
        assert np.all(one.decay(run.calls) < 0.5)

    check()


@pytest.mark.canary("circle-direct-line-most", "unknown-input-feeder")
@pytest.mark.parametrize(("family", "which"), EVERY)
def test_an_honest_residual_stays_inside_its_bound(family: str, which: str) -> None:
    one = member(family, which)
    # Every sensor is watched by somebody.
    assert one.predicts.any(axis=0).all()

    @given(st.integers(0, 2**32 - 1), st.booleans())
    @settings(max_examples=8, deadline=None)
    def check(seed: int, extreme: bool) -> None:
        run = one.honest(np.random.default_rng(seed), extreme)
        states = follow(one, run)
        for state, residual in zip(states, residuals(one, run, states), strict=True):
            bound = one.bound(state)[one.predicts]
            assert np.isfinite(bound).all()
            assert np.all(residual[one.predicts] <= bound + 1e-12)

    check()


@pytest.mark.canary(
    "circle-direct-line-most",
    "circle-lmi-line-few",
    "circle-discrete-tree-direct-most",
    "circle-discrete-sine-one",
    "unknown-input-feeder",
)
@pytest.mark.parametrize(("family", "which"), EVERY)
def test_attacks_are_visible(family: str, which: str) -> None:
    """A lie of three honest bounds breaks the bound at the liar, trusted or not; where an observer claims
    to listen, its estimate moves too, and where it does not listen, it does not move at all."""
    one = member(family, which)
    run = one.calm()
    quiet = follow(one, run)
    onset = run.calls // 2
    bounds = [one.bound(state) for state in quiet]
    need = np.max(np.where(one.predicts, bounds[onset] / one.share, 0.0), axis=0)
    listened = np.zeros(len(one.listens), dtype=bool)
    for liar in range(run.r.shape[1]):
        watching = one.predicts[:, liar]
        for sign in (-1.0, 1.0):
            lie = sign * 3.0 * float(need[liar])
            lied = run.lied(liar, lie, onset)
            states = follow(one, lied)
            found = residuals(one, lied, states)
            broken = np.array(
                [found[k][:, liar] > bounds[k][:, liar] for k in range(run.calls) if k + run.ahead >= onset]
            )
            assert np.all(broken.any(axis=0)[watching])
            moved = np.array(
                [apart(one, one.estimates(a), one.estimates(b)) for a, b in zip(states, quiet, strict=True)]
            )
            claimed = one.claims(liar, abs(lie), run.x[-1])
            listened |= claimed > 0.0
            assert np.all((moved.max(axis=0) > 1e-3 * claimed)[claimed > 0.0])
            assert np.all(moved[:, ~one.listens[:, liar]] == 0.0)
    assert listened.all(), "every member must listen to somebody"


@pytest.mark.canary(
    "circle-direct-line-most",
    "circle-direct-tree-one",
    "circle-lmi-line-few",
    "circle-lmi-shared-few",
    "circle-discrete-tree-direct-most",
    "circle-discrete-shared-direct-one",
    "circle-discrete-sine-one",
    "kalman-modal-4",
    "unknown-input-feeder",
)
@pytest.mark.parametrize(("family", "which"), EVERY)
def test_a_masked_meter_has_exactly_no_influence(family: str, which: str) -> None:
    """Neither while it is silent nor in the step after it has come back."""
    one = member(family, which)
    run = one.free(np.random.default_rng(1))
    p = run.r.shape[1]
    everyone = np.ones(p, dtype=bool)
    start = one.step(one.start(run), run.r[0], run.u[0], everyone, run.h)
    for silent in range(p):
        seen = everyone.copy()
        seen[silent] = False

        def told(value: float, h: float, silent: int = silent, seen: object = seen) -> list[Floats]:
            y = run.r[1].copy()
            y[silent] = value
            during = one.step(start, y, run.u[1], seen, h)  # type: ignore[arg-type]
            after = one.step(during, run.r[2], run.u[2], everyone, h)
            return one.estimates(during) + one.estimates(after)

        for h in one.lengths:
            base = told(run.r[1, silent], h)
            assert all(np.isfinite(x).all() for x in base)
            for value in (np.nan, np.inf, 0.0, -7.0, 1e300):
                for found, expected in zip(told(value, h), base, strict=True):
                    np.testing.assert_array_equal(found, expected)
            heard = one.step(start, run.r[1], run.u[1], everyone, h)
            for deaf in np.flatnonzero(~one.listens[:, silent]):
                np.testing.assert_allclose(base[deaf], one.estimates(heard)[deaf], rtol=1e-12, atol=1e-12)


@pytest.mark.canary(
    "circle-direct-line-most",
    "circle-direct-tree-few",
    "circle-direct-shared-one",
    "circle-lmi-tree-few",
    "circle-lmi-shared-one",
)
@pytest.mark.parametrize(
    ("family", "which"), [one for one in EVERY if not FAMILIES[one.values[0]].one_length]
)
def test_long_steps_end_where_short_ones_lead(family: str, which: str) -> None:
    one = member(family, which)
    run = one.free(np.random.default_rng(2))
    everyone = np.ones(run.r.shape[1], dtype=bool)
    start = short = one.start(run)
    y, u = np.random.default_rng(2).uniform(-0.1, 0.1, run.r.shape[1]), run.u[0]
    for _ in range(100):
        short = one.step(short, y, u, everyone, 1.0)
    for h in (300.0, 900.0, 86_400.0):
        long = one.step(start, y, u, everyone, h)
        for found, expected in zip(one.estimates(long), one.estimates(short), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.canary("circle-direct-line", "circle-discrete-sine", "unknown-input-feeder")
@pytest.mark.parametrize(("family", "which"), BATCHES)
def test_many_at_once_are_the_same_as_one_by_one(family: str, which: str) -> None:
    """Steps of all lengths there are, sensors that fall silent and return."""
    made = FAMILIES[family].batches[which]()
    rng = np.random.default_rng(3)
    y = rng.uniform(-made.size, made.size, made.sensors)
    u = rng.uniform(-made.size, made.size, made.inputs)
    together, singles = made.start(y, u)
    for h, silent in made.steps:
        seen = np.ones(made.sensors, dtype=bool)
        seen[list(silent)] = False
        y = y + 0.2 * rng.uniform(-made.size, made.size, made.sensors)
        u = u + 0.2 * rng.uniform(-made.size, made.size, made.inputs)
        together = made.step(together, y, u, seen, h)
        estimates = made.estimates(together)
        assert len(estimates) == len(singles)
        for index, found in enumerate(estimates):
            singles[index] = made.single(index)(singles[index], y, u, seen, h)
            expected = made.alone(index, singles[index])
            assert found.shape == expected.shape
            np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_every_family_is_here_and_says_what_it_lacks() -> None:
    """A module or package of observers without an entry would escape every contract above."""
    there = {path.stem for path in Path(observers.__path__[0]).iterdir() if not path.stem.startswith("_")}
    # What kinds of observers share is left out; circle has two kinds of gains.
    named = {"circle", *(name.replace("-", "_") for name in FAMILIES)} - {"circle_direct", "circle_lmi"}
    assert there - {"parts", "lure", "gains", "certificates", "lmi", "design_archive"} == named
    assert all(family.batches for family in FAMILIES.values())
    any_length = {name for name, family in FAMILIES.items() if not family.one_length}
    assert any_length == {"circle-direct", "circle-lmi"}

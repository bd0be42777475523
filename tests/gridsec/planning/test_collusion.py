"""The furthest that colluding liars move something, against enumeration and integer programs."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from gridsec.arrays import Floats
from gridsec.planning.collusion import GAP, Corridor, corridor, furthest


def made(seed: int, p: int, tests: int) -> tuple[Floats, Floats]:
    """Tests that bound everybody, and a bound of each lie that is far from tight."""
    rng = np.random.default_rng(seed)
    rows = np.vstack([np.eye(p) + 0.3 * rng.standard_normal((p, p)), rng.standard_normal((tests, p))])
    reach = np.array([_program(rows, one) for one in np.eye(p)])
    return rows, 3.0 * reach


def _program(rows: Floats, g: Floats) -> float:
    found = linprog(
        -g, A_ub=np.vstack([rows, -rows]), b_ub=np.ones(2 * len(rows)), bounds=(None, None), method="highs"
    )
    return float(-found.fun)


def tried(rows: Floats, g: Floats, liars: int, must: int | None) -> float:
    """Every set of liars."""
    sets = combinations(range(g.size), min(liars, g.size))
    return max(_program(rows[:, some], g[list(some)]) for some in sets if must is None or must in some)


@settings(max_examples=25, deadline=None)
@drawn(seed=st.integers(0, 10_000), p=st.integers(1, 6), liars=st.integers(1, 7), tests=st.integers(0, 6))
def test_it_equals_enumeration(seed: int, p: int, liars: int, tests: int) -> None:
    rows, reach = made(seed, p, tests)
    rng = np.random.default_rng([seed, 1])
    must = None if rng.random() < 0.5 else int(rng.integers(p))
    along = rng.standard_normal((int(rng.integers(1, 4)), p))
    found = furthest(corridor(rows, liars, reach=reach), along, must=must)
    best = max(tried(rows, g, liars, must) for g in along)
    assert found.size == pytest.approx(best, rel=2 * GAP)
    assert best <= found.bound <= found.size * (1.0 + 2 * GAP)
    assert np.abs(rows @ found.lies).max() <= 1.0 + 1e-8
    assert np.count_nonzero(found.lies) <= liars
    assert float((along @ found.lies).max()) == pytest.approx(found.size, rel=1e-9)


def test_no_collusion_lies_further_than_its_reach_and_no_test_is_left_out_in_vain() -> None:
    rows, start = made(3, 6, 8)
    for liars in (1, 2, 3):
        tight = corridor(rows, liars, reach=start)
        furthest_each = [tried(rows, one, liars, None) for one in np.eye(6)]
        assert (tight.reach >= np.array(furthest_each) * (1 - 1e-9)).all()
        assert (tight.reach < start).any()
        # Tests that are left out: M liars within their reach never come to their bounds.
        kept = {row.tobytes() for row in tight.rows}
        for row in rows:
            if row.tobytes() not in kept:
                assert np.sort(np.abs(row) * tight.reach)[-liars:].sum() <= 1.0 + 1e-8


def test_alone_it_is_a_division() -> None:
    rows, reach = made(5, 8, 20)
    tight = corridor(rows, 1, reach=reach)
    np.testing.assert_allclose(tight.reach, 1.0 / np.abs(rows).max(axis=0), rtol=1e-12)
    g = np.random.default_rng(0).standard_normal(8)
    assert furthest(tight, g).size == pytest.approx(np.max(np.abs(g) / np.abs(rows).max(axis=0)), rel=1e-12)


@pytest.mark.acceptance
def test_a_street_equals_an_integer_program() -> None:
    rng = np.random.default_rng(11)
    far = np.abs(np.subtract.outer(np.arange(20), np.arange(20)))
    rows = -0.3 * np.exp(-far / 3.0) * rng.uniform(0.3, 1.0, (20, 20)) + 1.3 * np.eye(20)
    g, reach = rng.uniform(0.5, 1.0, 20), np.full(20, 3.0)
    for liars in (2, 4):
        found = furthest(corridor(rows, liars, reach=reach), g)
        assert found.size == pytest.approx(_integer(rows, g, liars, reach), rel=1e-4)


def _integer(rows: Floats, g: Floats, liars: int, reach: Floats) -> float:
    p = g.size
    one, none = np.eye(p), np.zeros_like(rows)
    found = milp(
        np.concatenate([-g, np.zeros(p)]),
        constraints=[
            LinearConstraint(np.hstack([rows, none]), lb=-1.0, ub=1.0),
            LinearConstraint(np.hstack([one, -np.diag(reach)]), ub=0.0),
            LinearConstraint(np.hstack([-one, -np.diag(reach)]), ub=0.0),
            LinearConstraint(np.concatenate([np.zeros(p), np.ones(p)])[None, :], ub=float(liars)),
        ],
        bounds=Bounds(np.concatenate([-reach, np.zeros(p)]), np.concatenate([reach, np.ones(p)])),
        integrality=np.repeat(np.arange(2), p),
        options={"mip_rel_gap": 1e-6},
    )
    return float(-found.fun)


def test_a_search_that_is_cut_short_says_what_is_left_open() -> None:
    rows, reach = made(8, 7, 10)
    g = np.random.default_rng(8).standard_normal(7)
    whole = furthest(corridor(rows, 3, reach=reach), g)
    cut = furthest(corridor(rows, 3, reach=reach), g, work=1.0)
    assert cut.bound > whole.bound
    assert cut.size <= whole.size * (1.0 + GAP)


def test_nobody_lies_where_nobody_can() -> None:
    empty = Corridor(np.zeros((0, 3)), np.zeros(3), 1)
    for must in (None, 1):
        found = furthest(empty, np.ones(3), must=must)
        assert found.size == found.bound == 0.0
        assert not found.lies.any()

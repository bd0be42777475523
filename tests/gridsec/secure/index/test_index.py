"""Security indices against brute force in exact integer arithmetic, and against the geometric theory."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.linalg import orth as scipy_orth

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible
from gridsec.observers.lure import equilibrium
from gridsec.observers.parts import decompose
from gridsec.secure.decode.stacks import Stack, cospark
from gridsec.secure.index import (
    asymptotic_index,
    dynamic_index,
    eigenspaces,
    feeder_index,
    fewest,
    hidden,
    linearise,
    observability,
    observable_rows,
    redundant_detectable,
    redundant_observable,
    row_space,
    slopes,
    stable_subspace,
    static_index,
    under_attack,
    undetectable_subspace,
    unobservable_subspace,
    unstable_subspace,
)
from tests.codes import refused
from tests.gridsec.exact_pairs import Exact, cases, exact_rank, power
from tests.gridsec.plants import line, tree

TOL = 1e-9


def test_the_random_pairs_are_worth_testing() -> None:
    pairs = [pair for pair, _, _ in cases()]
    assert sum(pair.repeated for pair in pairs) > 100
    assert sum(pair.defective for pair in pairs) > 60
    assert {dynamic for _, dynamic, _ in cases()} >= {0, 1, 2, 3}
    assert {asymptotic for _, _, asymptotic in cases()} >= {0, 1, 2, 3, np.inf}


def test_indices_equal_exact_brute_force() -> None:
    """lee2018, Propositions 3.2.2 and 3.2.4: 200 pairs, both ways of computing."""
    for pair, dynamic, asymptotic in cases():
        by_vectors = dynamic_index(pair.a, pair.c, tol=TOL)
        by_rank = dynamic_index(pair.a, pair.c, tol=TOL, by="rank")
        assert by_vectors.count == by_rank.count == dynamic
        late_vectors = asymptotic_index(pair.a, pair.c, discrete=True, tol=TOL)
        late_rank = asymptotic_index(pair.a, pair.c, discrete=True, tol=TOL, by="rank")
        assert late_vectors.count == late_rank.count == asymptotic


def test_the_attack_named_with_an_index_is_one() -> None:
    """The direction is seen by exactly the named sensors, at all times (lee2018, Definition 3.2.1)."""
    for pair, _, _ in cases():
        for found in (
            dynamic_index(pair.a, pair.c, tol=TOL),
            dynamic_index(pair.a, pair.c, tol=TOL, by="rank"),
            asymptotic_index(pair.a, pair.c, discrete=True, tol=TOL),
        ):
            if not np.isfinite(found.count):
                assert found.sensors.size == found.direction.size == 0
                continue
            assert found.sensors.size == found.count
            assert np.linalg.norm(found.direction) == pytest.approx(1.0)
            seen = np.linalg.norm(observability(pair.a, pair.c) @ found.direction, axis=1)
            assert set(np.flatnonzero(seen > 1e-6)) == set(found.sensors)
            # What an attacker can do is real: the real part alone is as good.
            assert np.linalg.norm(found.direction.real) >= np.sqrt(0.5) - 1e-9
            seen = np.linalg.norm(observability(pair.a, pair.c) @ found.direction.real, axis=1)
            assert set(np.flatnonzero(seen > 1e-6)) == set(found.sensors)


def test_attacks_on_the_asymptotic_index_last_and_others_die_away() -> None:
    """lee2018, Definitions 3.2.3 and 3.2.4, by the difference of the two stories, A^k x_a (errata)."""
    lasting = fading = 0
    for pair, dynamic, asymptotic in cases():
        later = np.linalg.matrix_power(pair.a, 60)
        if np.isfinite(asymptotic):
            found = asymptotic_index(pair.a, pair.c, discrete=True, tol=TOL)
            assert np.linalg.norm(later @ found.direction) > 0.5
            lasting += 1
        if dynamic < asymptotic:
            # Fewer sensors suffice only for differences that vanish: 2^-60 times a polynomial of the step.
            found = dynamic_index(pair.a, pair.c, tol=TOL)
            assert np.linalg.norm(later @ found.direction) < 1e-6
            fading += 1
    assert min(lasting, fading) > 20


def test_erratum_the_limits_of_definition_3_2_3_need_not_exist() -> None:
    """The states alternate for ever, but what the attack makes them differ by dies away."""
    A, C = np.diag([-1.0, 0.5]), np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    x, other = np.array([1.0, 0.0]), np.array([1.0, 1.0])
    steps = [np.linalg.matrix_power(A, k) for k in range(60, 64)]
    assert np.ptp([P @ x for P in steps], axis=0)[0] == np.ptp([P @ other for P in steps], axis=0)[0] == 2.0
    assert all(np.linalg.norm(P @ (other - x)) < 1e-15 for P in steps)
    # One sensor can tell this story, and by the difference it is no lasting one: that takes all three.
    assert dynamic_index(A, C, tol=TOL).count == 1
    assert asymptotic_index(A, C, discrete=True, tol=TOL).count == 3


def test_one_eigenvector_per_eigenvalue_is_not_enough() -> None:
    """What a search over `numpy.linalg.eig`'s vectors says where an eigenvalue repeats: too much."""
    A = np.eye(3)
    C = np.array([[1.0, 1, 0], [0, 1, 1], [1, 0, 1], [1, 1, 1]])
    vectors = np.linalg.eig(A)[1]
    assert np.count_nonzero(np.abs(C @ vectors) > 1e-9, axis=0).min() == 3
    found = dynamic_index(A, C, tol=TOL)
    assert found.count == 2 == static_index(C, tol=TOL).count
    assert np.count_nonzero(np.abs(C @ found.direction) > 1e-9) == 2


def test_redundancy_by_eigenvectors_and_by_rank_agree_with_the_index() -> None:
    """lee2018, Propositions 3.1.1, 3.1.2, 3.1.8, 3.1.9, 3.2.1 and 3.2.3, for every q."""
    for pair, dynamic, asymptotic in cases()[:60]:
        for q in range(5):
            for by in ("eigenvectors", "rank"):
                assert redundant_observable(pair.a, pair.c, q, tol=TOL, by=by) == (dynamic > q)
                got = redundant_detectable(pair.a, pair.c, q, discrete=True, tol=TOL, by=by)
                assert got == (asymptotic > q)


def test_how_many_lies_can_be_detected_and_undone() -> None:
    """lee2018, Propositions 3.3.1 and 3.3.2: q can be undone if and only if the index exceeds 2q."""
    for count, undone in ((0, -1), (1, 0), (2, 0), (3, 1), (4, 1), (5, 2), (np.inf, np.inf)):
        index = dynamic_index(np.eye(1), np.ones((1, 1)), tol=TOL)
        index = type(index)(count, index.sensors, index.direction)
        assert index.correctable == undone
        assert index.detectable == count - 1
        if np.isfinite(count) and count > 0:
            assert count > 2 * undone
            assert not count > 2 * (undone + 1)


def test_two_stories_fit_the_same_readings_where_the_index_is_at_most_2q() -> None:
    """lee2018, Propositions 3.3.1 and 3.3.2, (i) => (ii): q liars in each story, equal readings."""
    told = 0
    for pair, dynamic, asymptotic in cases()[:60]:
        for count, found in (
            (dynamic, dynamic_index(pair.a, pair.c, tol=TOL)),
            (asymptotic, asymptotic_index(pair.a, pair.c, discrete=True, tol=TOL)),
        ):
            if not 0 < count < np.inf:
                continue
            half = found.sensors[: int(count) // 2]
            x, other = np.zeros(4), found.direction.real
            for _ in range(8):
                # In the first story one half reports what the second story's sensors would, and vice versa.
                first, second = pair.c @ x, pair.c @ other
                first[half] = (pair.c @ other)[half]
                rest = np.setdiff1d(found.sensors, half)
                second[rest] = (pair.c @ x)[rest]
                scale = 1.0 + float(np.abs(second).max())
                assert np.allclose(first, second, atol=1e-6 * scale)
                x, other = pair.a @ x, pair.a @ other
            assert max(len(half), len(rest)) == found.correctable + 1
            told += 1
    assert told > 40


def same_space(one: Floats, other: Floats) -> bool:
    return one.shape[1] == other.shape[1] and np.allclose(one @ one.T, other @ other.T, atol=1e-6)


def test_redundant_subspaces_by_definition() -> None:
    """lee2018, Propositions 3.1.4 to 3.1.7 and 3.1.11 to 3.1.13."""
    for pair, dynamic, asymptotic in cases()[:40]:
        A, C = pair.a, pair.c
        unstable = unstable_subspace(A, discrete=True, tol=TOL)
        assert unobservable_subspace(A, C, 5, tol=TOL).shape[1] == 4, "no sensor left"
        for q in (0, 1, 2):
            space = unobservable_subspace(A, C, q, tol=TOL)
            late = undetectable_subspace(A, C, q, discrete=True, tol=TOL)
            assert (space.shape[1] == 0) == (dynamic > q), "Corollary 3.1.5"
            assert (late.shape[1] == 0) == (asymptotic > q), "Corollary 3.1.12"
            for basis in (space, late):
                assert np.allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-9)
                assert np.allclose(A @ basis, basis @ (basis.T @ A @ basis), atol=1e-6), "A-invariant"
            # Proposition 3.1.11: the unstable part of the sum is the sum of the unstable parts.
            meet = 4 - np.linalg.matrix_rank(np.vstack([complement(space).T, complement(unstable).T]), 1e-6)
            assert late.shape[1] == meet
            if late.shape[1]:
                assert np.allclose(space @ (space.T @ late), late, atol=1e-6)
                assert np.allclose(unstable @ (unstable.T @ late), late, atol=1e-6)
            # Propositions 3.1.6 and 3.1.13: the orthogonal complements, from row spaces.
            G = observability(A, C)
            parts = [
                np.asarray(scipy_orth(np.vstack(G[list(kept)]).T, rcond=1e-8))
                for kept in itertools.combinations(range(5), 5 - q)
            ]
            outside = sum(np.eye(4) - part @ part.T for part in parts)
            values, vectors = np.linalg.eigh(outside)
            observable = vectors[:, values < 1e-8]
            assert same_space(observable, complement(space))
            both = scipy_orth(np.hstack([observable, complement(unstable)]), rcond=1e-8)
            assert same_space(both, complement(late))
            # Proposition 3.1.7.
            stable = stable_subspace(A, discrete=True, tol=TOL)
            inside = np.allclose(stable @ (stable.T @ space), space, atol=1e-6)
            assert inside == (asymptotic > q)


def complement(basis: Floats) -> Floats:
    u, _, _ = np.linalg.svd(np.hstack([basis, np.zeros((basis.shape[0], 1))]), full_matrices=True)
    return u[:, basis.shape[1] :]


def test_stable_and_unstable_subspaces_are_exact() -> None:
    for pair, _, _ in cases()[:60]:
        stable = stable_subspace(pair.a, discrete=True, tol=TOL)
        unstable = unstable_subspace(pair.a, discrete=True, tol=TOL)
        rank = exact_rank([list(r) for r in pair.unstable_part])
        assert (stable.shape[1], unstable.shape[1]) == (4 - rank, rank)
        size = float(np.abs(pair.unstable_part.astype(float)).max())
        assert np.abs(pair.unstable_part.astype(float) @ stable).max(initial=0.0) <= 1e-8 * size


def manipulated_sets(p: int, q: int) -> Iterator[tuple[int, ...]]:
    return itertools.combinations(range(p), q)


def test_equivalence_with_strong_observability() -> None:
    """lee2018, Proposition 3.1.3: (i) to (iii), and (iv) with F = -C, which hides the most, and others."""
    for pair, dynamic, _ in cases()[:40]:
        A, C = pair.a, pair.c
        for q in (1, 2):
            systems = [under_attack(A, C, bad, tol=TOL) for bad in manipulated_sets(5, q)]
            assert all(s.strongly_observable for s in systems) == (dynamic > q)
            for bad, system in zip(manipulated_sets(5, q), systems, strict=True):
                good = np.delete(C, bad, axis=0)
                assert same_space(system.weakly_unobservable, unobservable_subspace(A, good, tol=TOL))
                F = -C[list(bad)]
                fed = C.copy()
                fed[list(bad)] += F
                observable = dynamic_index(A, fed, tol=TOL).count > 0
                assert observable == system.strongly_observable
                fed[list(bad)] += np.random.default_rng(q).standard_normal(F.shape)
                if system.strongly_observable:
                    assert dynamic_index(A, fed, tol=TOL).count > 0, "no F breaks it"


def test_equivalence_with_strong_detectability() -> None:
    """lee2018, Proposition 3.1.10, with the controllable subspace counted from rest (errata)."""
    for pair, _, asymptotic in cases()[:40]:
        for q in (1, 2):
            systems = [under_attack(pair.a, pair.c, bad, tol=TOL) for bad in manipulated_sets(5, q)]
            assert all(s.controllable.shape[1] == 0 for s in systems)
            # A defective zero is computed to the root of the rounding error, hence the wide border.
            verdict = all(s.strongly_detectable(discrete=True, tol=1e-3) for s in systems)
            assert verdict == (asymptotic > q)
            # (iv) with F = -C on the manipulated sensors, which hides the most.
            fed = [
                np.where(np.isin(np.arange(5), bad)[:, None], 0.0, pair.c) for bad in manipulated_sets(5, q)
            ]
            counts = [asymptotic_index(pair.a, C, discrete=True, tol=TOL).count for C in fed]
            assert all(count > 0 for count in counts) == (asymptotic > q)


def test_erratum_the_controllable_subspace_as_printed_breaks_proposition_3_1_10() -> None:
    """A state that dies in one step satisfies the printed definition although nothing is wrong with it."""
    A, C = np.zeros((1, 1)), np.zeros((1, 1))
    assert redundant_detectable(A, C, 0, discrete=True, tol=TOL)
    # Printed: all x(0) for which an input makes y = 0 and x(k) = 0 for some finite k. Here x(1) = 0 always.
    x, input_that_hides_it = np.ones(1), np.zeros(1)
    assert not np.any(A @ x)
    assert not np.any(C @ x + input_that_hides_it)
    assert hidden(A, np.zeros((1, 0)), C, np.zeros((1, 0)), tol=TOL).controllable.shape[1] == 0
    assert under_attack(A, C, (), tol=TOL).strongly_detectable(discrete=True, tol=TOL)


def test_hidden_subspaces_of_systems_with_inputs() -> None:
    """Textbook cases: a double integrator seen in its position, and one with an unstable zero."""
    A, B = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]])
    position = hidden(A, B, np.array([[1.0, 0]]), np.zeros((1, 1)), tol=TOL)
    assert position.strongly_observable
    zero = hidden(A, B, np.array([[-1.0, 1]]), np.zeros((1, 1)), tol=TOL)
    assert zero.weakly_unobservable.shape[1] == 1
    assert zero.controllable.shape[1] == 0
    assert zero.zeros == pytest.approx([1.0])
    assert not zero.strongly_detectable(discrete=False, tol=TOL)
    speed = hidden(A, B, np.array([[1.0, 1]]), np.zeros((1, 1)), tol=TOL)
    assert speed.zeros == pytest.approx([-1.0])
    assert speed.strongly_detectable(discrete=False, tol=TOL)
    assert not speed.strongly_detectable(discrete=True, tol=TOL)
    blind = hidden(A, B, np.zeros((1, 2)), np.zeros((1, 1)), tol=TOL)
    assert blind.controllable.shape[1] == 2
    assert blind.zeros.size == 0
    assert not blind.strongly_detectable(discrete=False, tol=TOL)


@pytest.mark.parametrize("seed", range(6))
def test_eigenspaces_of_matrices_with_known_jordan_form(seed: int) -> None:
    rng = np.random.default_rng(seed)
    jordan = {
        2.0: (3, 1),
        0.5: (1, 1, 1),
        -1.0: (2,),
        0.5001: (1,),
    }
    J = block_diag(*(v * np.eye(k) + np.eye(k, k=1) for v, sizes in jordan.items() for k in sizes))
    S = np.linalg.qr(rng.standard_normal((10, 10)))[0] @ np.diag(rng.uniform(0.5, 2.0, 10))
    A = S @ J @ np.linalg.inv(S)
    spaces = eigenspaces(A, tol=TOL)
    assert len(spaces) == len(jordan)
    for space in spaces:
        value = min(jordan, key=lambda v: abs(v - space.value))
        assert space.value == pytest.approx(value, abs=1e-8)
        assert space.vectors.shape[1] == len(jordan[value])
        assert space.invariant.shape[1] == sum(jordan[value])
        assert np.abs(A @ space.vectors - value * space.vectors).max() < 1e-7


def test_eigenvalues_in_even_spacing_are_told_apart() -> None:
    """Gaps of equal width, one of them centred: distances and the mean alone would merge them."""
    values = np.array([0.9, 0.901, 0.902, 0.903])
    spaces = eigenspaces(np.diag(values), tol=TOL)
    assert sorted(s.value.real for s in spaces) == pytest.approx(values)
    ring = np.array([[0.0, -1], [1, 0]])
    spaces = eigenspaces(block_diag(ring, ring, 1.0), tol=TOL)
    assert sorted(s.vectors.shape[1] for s in spaces) == [1, 2, 2]
    assert eigenspaces(np.zeros((0, 0)), tol=TOL) == ()


@pytest.mark.parametrize("seed", range(30))
def test_fewest_equals_a_search_over_all_subsets(seed: int) -> None:
    """Blocks of unequal height, dependent ones, empty ones; integer entries and exact ranks."""
    rng = np.random.default_rng(seed)
    n, p = 3, 6
    blocks = [rng.integers(-1, 2, (int(rng.integers(0, 3)), n)) for _ in range(p)]
    found = fewest([row_space(b.astype(float), TOL) for b in blocks], np.eye(n), tol=TOL)
    best = next(
        size
        for size in range(p + 1)
        for lost in itertools.combinations(range(p), size)
        if exact_rank([list(map(int, r)) for i in range(p) if i not in lost for r in blocks[i]]) < n
    )
    assert found.count == best
    seen = [i for i in range(p) if np.abs(blocks[i] @ found.direction).max(initial=0.0) > 1e-9]
    assert list(found.blocks) == seen


def test_fewest_stops_early_and_gives_up_loudly() -> None:
    rng = np.random.default_rng(0)
    rows = [row_space(r[None, :], TOL) for r in rng.standard_normal((14, 7))]
    assert fewest(rows, np.eye(7), tol=TOL).count == 14 - 6
    assert fewest(rows, np.eye(7), tol=TOL, below=13).count <= 12
    with refused(DesignInfeasible, "too-many"):
        fewest(rows, np.eye(7), tol=TOL, most=50)
    assert fewest(rows, np.zeros((7, 0)), tol=TOL).count == np.inf
    many = [row_space(r[None, :], TOL) for r in rng.standard_normal((30, 10))]
    # The minimum, 21, would take millions of nodes; that it is not below 5 takes at most C(15, 10).
    assert fewest(many, np.eye(10), tol=TOL, below=5, most=3003).count >= 5
    assert fewest([*many[:3], *[r[:0] for r in many]], np.eye(10), tol=TOL, below=1).count == 0


def test_observable_rows_where_powers_of_a_overflow_all_scales() -> None:
    """The rank of G_i is decided although its rows differ by twelve orders of magnitude."""
    A = np.diag([1e-3, 1.0, 30.0, 1000.0]) + np.eye(4, k=1)
    C = np.vstack([np.eye(4)[0], np.eye(4)[3]])
    first, last = observable_rows(A, C, tol=1e-12)
    assert len(first) == 4
    assert len(last) == 1
    assert np.allclose(first @ first.T, np.eye(4))


def test_feeder_in_its_deadband_falls_back_to_the_static_index() -> None:
    """Equal time constants, all slopes zero: one eigenspace, in which the attacker may choose."""
    lure = line(6).lure
    quiet = feeder_index(lure, np.zeros(6), tol=1e-9)
    assert quiet.static.count == quiet.dynamic.count == 1
    assert quiet.asymptotic.count == np.inf
    steep = feeder_index(lure, lure.slope, tol=1e-9)
    assert steep.dynamic.count == 6, "a mode of the closed loop is seen by every meter of the street"
    assert steep.asymptotic.count == np.inf


def test_linearisation_is_the_derivative_of_the_closed_loop() -> None:
    lure = tree().lure
    rng = np.random.default_rng(1)
    u = rng.normal(0.0, 0.03, lure.F.shape[1])
    x = equilibrium(lure, u, tol=1e-12, max_iter=200)
    z = lure.H @ x + lure.F @ u
    A, C = linearise(lure, slopes(lure, z, step=1e-7))

    def motion(state: Floats) -> Floats:
        return lure.A @ state + lure.G @ lure.phi(lure.H @ state + lure.F @ u)

    h = 1e-6
    numeric = np.stack([(motion(x + h * e) - motion(x - h * e)) / (2 * h) for e in np.eye(x.size)], axis=1)
    assert np.allclose(A, numeric, atol=1e-6)
    assert np.array_equal(C, lure.C)


@pytest.mark.parametrize("steep", [False, True])
def test_indices_of_feeders_equal_a_search_over_all_meters(steep: bool) -> None:
    """Two feeders, in deadband and at the steepest slope; ranks exact, of the very floating-point numbers."""
    for lure in (tree().lure, line(5).lure):
        slope = lure.slope if steep else np.zeros(lure.slope.size)
        found = feeder_index(lure, slope, tol=TOL)
        p, n = found.C.shape
        A, C = (np.vectorize(Fraction, otypes=[object])(m) for m in (found.A, found.C))
        G = np.stack([C @ power(A, k) for k in range(n)], axis=1)
        for index, rows in ((found.static, G[:, :1]), (found.dynamic, G)):
            best = next(
                k
                for k in range(p + 1)
                for kept in itertools.combinations(range(p), p - k)
                if exact_rank([whole(r) for i in kept for r in rows[i]]) < n
            )
            assert index.count == best


def whole(row: Exact) -> list[int]:
    """A row of fractions as integers, up to a factor."""
    factor = math.lcm(*(f.denominator for f in row))
    return [int(f * factor) for f in row]


@pytest.mark.parametrize("seed", range(5))
def test_a_sensor_that_is_rounding_measures_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4))
    A = (A + A.T) / np.linalg.norm(A, 2)
    C = np.vstack([rng.standard_normal((3, 4)), np.zeros(4)])
    noisy = C + np.outer([0.0, 0.0, 0.0, 1e-16], rng.standard_normal(4))
    for ways in ("eigenvectors", "rank"):
        for index in (dynamic_index, partial(asymptotic_index, discrete=False)):
            assert index(A, noisy, tol=TOL, by=ways).count == index(A, C, tol=TOL, by=ways).count == 3
    assert static_index(noisy, tol=TOL).count == static_index(C, tol=TOL).count
    assert observable_rows(A, noisy, tol=TOL)[3].shape == (0, 4)
    assert decompose(A, noisy, slowest=0.0, tol=TOL)[3].observable.shape == (4, 0)
    assert cospark(Stack.of_rows(noisy), tol=TOL).count == cospark(Stack.of_rows(C), tol=TOL).count
    # Without the three others nothing is left to see with.
    assert under_attack(A, noisy, (0, 1, 2), tol=TOL).weakly_unobservable.shape[1] == 4

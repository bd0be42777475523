"""Example 1 of yang2019, its claims and figures; the counterexamples behind its errata."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np
import pytest

from gridsec.papers import yang2019
from gridsec.papers import yang2019 as sampled_feeder
from gridsec.papers.claims import Reproduction
from gridsec.secure import windows
from tests.gridsec.papers.made import made


@pytest.fixture(scope="module")
def result() -> Reproduction:
    return made("yang2019")


@pytest.mark.acceptance
def test_every_claim_is_met_or_explained(result: Reproduction) -> None:
    assert result.paper == "yang2019"
    assert not result.unexplained
    figures = {f"Figure {k}, Conclusion" for k in (1, 2, 3, 4)} | {"Figures 1 to 4"}
    errata = {"Remark 2 (erratum)", "Proposition 4 (erratum)"}
    assert {claim.where for claim in result.unmet} == figures | errata


@pytest.mark.acceptance
def test_the_rows_of_the_four_figures_say_that_the_recipe_gives_zero(result: Reproduction) -> None:
    rows = [claim for claim in result.claims if claim.where.startswith("Figure ")]
    assert len(rows) == 4
    for claim in rows:
        assert str(claim.ours).startswith("0.00, 0.00, 0.00 (not the paper's recipe: calibrated ")
        assert not claim.met
        assert claim.why.startswith("not reproduced")
    (others,) = (claim for claim in result.claims if claim.where == "Figures 1 to 4")
    assert others.ours == 0.0


def by_the_book(
    sensor: int | None, size: float, runs: int, seed: int
) -> tuple[list[tuple[int, ...]], np.ndarray, np.ndarray]:
    """Integrate (25), (26) and (4) set by set: sets of sensors, estimates, and gains by (5).

    Returns the sets, the estimates (steps, sets, runs, 2) and the largest |e_J| over |m_J| so far.
    """
    rng = np.random.default_rng(seed)
    bank = yang2019.bank()
    C = np.array([[3.0, 0.3], [3.0, 0.6], [6.0, 0.9], [1.2, 12.0]])
    sets = [tuple(np.flatnonzero(one.trusted).tolist()) for one in bank]

    def ahead(x: np.ndarray, s: np.ndarray) -> np.ndarray:
        return np.stack([x[:, 0] + 0.1 * x[:, 1] + 0.05 * s, x[:, 1] + 0.1 * s], axis=1)

    x = rng.standard_normal((runs, 2))
    hats, gains = [x.copy() for _ in sets], np.zeros(len(sets))
    loudest, kept = np.zeros((len(sets), runs)), []
    for _ in range(1000):
        m = rng.uniform(-0.5, 0.5, (runs, 4))
        y = x @ C.T + m
        if sensor is not None:
            y[:, sensor] += rng.uniform(-size, size, runs)
        for k, (one, J) in enumerate(zip(bank, sets, strict=True)):
            loudest[k] = np.maximum(loudest[k], np.sqrt((m[:, list(J)] ** 2).sum(axis=1)))
            miss = y - hats[k] @ C.T  # columns of L and K outside J are zero
            hats[k] = ahead(hats[k], np.sin(hats[k].sum(axis=1) + miss @ one.K[0])) + miss @ one.L.T
        x = ahead(x, np.sin(x.sum(axis=1)))
        for k in range(len(sets)):
            gains[k] = max(gains[k], float((np.linalg.norm(hats[k] - x, axis=1) / loudest[k]).max()))
        kept.append(np.stack(hats))
    return sets, np.stack(kept), gains


@pytest.mark.canary("1-1.0")
@pytest.mark.parametrize(("sensor", "size"), [(1, 0.7), (1, 1.0), (2, 2.0), (2, 5.0)])
def test_the_recipe_of_the_paper_finds_nothing_in_its_own_settings(sensor: int, size: float) -> None:
    """Algorithms 1 and 2, (8), (10), (17), (19) and (21) written out; gains by simulation, epsilon = 0."""
    sets, _, gamma = by_the_book(None, 0.0, 40, 1)
    _, hats, _ = by_the_book(sensor, size, 12, 2)
    at, m_bar = {J: k for k, J in enumerate(sets)}, 1.0  # |m| for four sensors within 0.5
    large = list(combinations(range(4), 3))
    apart = {
        (J, S): np.linalg.norm(hats[:, at[J]] - hats[:, at[S]], axis=-1)
        for J in [*large, (0, 1, 2, 3)]
        for S in sets
    }
    pi = np.max([apart[(0, 1, 2, 3), J] for J in large], axis=0)
    z_bar = 2.0 * max(gamma[at[J]] for J in [*large, (0, 1, 2, 3)]) * m_bar
    passed, named = {}, 0
    for J in large:
        inside = list(combinations(J, 2))
        pi_J = np.max([apart[J, S] for S in inside], axis=0)
        passed[J] = pi_J <= 2.0 * max(gamma[at[S]] for S in [J, *inside]) * m_bar
    for N in (50, 100, 200):
        for run in range(12):
            for first in range(0, 1000, N):
                window = range(first, first + N)
                if sensor == 1:
                    named += int(any(pi[k, run] > z_bar for k in window))
                    continue
                votes: Counter[frozenset[int]] = Counter()
                for k in window:
                    votes[frozenset().union(*(J for J in large if passed[J][k, run]))] += 1
                votes.pop(frozenset(), None)
                named += int(bool(votes) and votes.most_common(1)[0][0] == {0, 1, 3})
    assert named == 0
    # The thresholds agree with the module's, whose gains come from other random numbers.
    simulated = yang2019.levels().simulated
    assert simulated.detect_above == pytest.approx(z_bar, rel=0.15)


def test_how_large_an_attack_the_recipe_needs() -> None:
    """Algorithm 1 finds most windows from ±6 on, Algorithm 2 names sensor 3 from ±30 on."""
    at = yang2019.levels()

    def found(size: float) -> np.ndarray:
        trace = yang2019.trial(at.proven, sensor=1, size=size, runs=10, seed=30)
        return yang2019.detection_rates(at.simulated, trace)

    def isolated(size: float) -> np.ndarray:
        trace = yang2019.trial(at.proven, sensor=2, size=size, runs=10, seed=40)
        return yang2019.isolation_rates(at.simulated, trace, 2, "majority")

    assert np.all(found(3.0) == 0.0)
    assert np.all(found(6.0) > 0.9)
    assert np.all(isolated(12.0) == 0.0)
    assert np.all(isolated(30.0) > 0.9)


def test_the_plant_is_the_printed_one() -> None:
    """(25), (26) evaluated as printed."""
    plant, rng = yang2019.system(), np.random.default_rng(0)
    x, u = rng.standard_normal(2), rng.standard_normal(1)
    s = 0.1 * np.sin(x[0] + x[1])
    expected = [x[0] + 0.1 * x[1] + 0.5 * s + 0.1 * u[0], x[1] + s + 0.1 * u[0]]
    z = x @ plant.H.T + u @ plant.F.T
    np.testing.assert_allclose(plant.A @ x + plant.G @ plant.phi(z) + plant.B @ u, expected, atol=1e-15)
    y = [3 * x[0] + 0.3 * x[1], 3 * x[0] + 0.6 * x[1], 6 * x[0] + 0.9 * x[1], 1.2 * x[0] + 12 * x[1]]
    np.testing.assert_allclose(plant.C @ x, y, atol=1e-14)


def test_thresholds_stand_in_their_order() -> None:
    """Calibrated below simulated below proven: a statistic, a lower bound of a gain, a bound."""
    at = yang2019.levels()
    assert at.calibrated.detect_above < at.simulated.detect_above < at.proven.detect_above
    assert np.all(at.calibrated.isolate_above < at.simulated.isolate_above)
    assert np.all(at.simulated.isolate_above < at.proven.isolate_above)
    assert at.exceedance == pytest.approx(1.0 - 0.01 ** (1.0 / yang2019.RUNS))
    assert at.exceedance < 0.01


def test_the_printed_threshold_misses_the_printed_attacks() -> None:
    """With least proven noise gains, (10) sees neither attack of Figures 1 and 2; calibrated ones do."""
    at = yang2019.levels()
    for size in yang2019.DETECTION:
        trace = yang2019.trial(at.proven, sensor=1, size=size, runs=40, seed=3)
        assert np.all(yang2019.detection_rates(at.proven, trace) == 0.0)
        assert np.all(yang2019.detection_rates(at.simulated, trace) == 0.0)
        assert yang2019.detection_rates(at.calibrated, trace)[-1] > 0.2
    # Attacks that are large enough need no calibration.
    for rates in (
        yang2019.detection_rates(at.proven, yang2019.trial(at.proven, sensor=1, size=40.0, runs=5, seed=4)),
        yang2019.isolation_rates(
            at.proven, yang2019.trial(at.proven, sensor=2, size=80.0, runs=5, seed=4), 2, "majority"
        ),
    ):
        assert np.all(rates == 1.0)


def test_survivors_isolate_what_the_majority_misses() -> None:
    at = yang2019.levels()
    for size in yang2019.ISOLATION:
        trace = yang2019.trial(at.proven, sensor=2, size=size, runs=40, seed=5)
        vote = yang2019.isolation_rates(at.calibrated, trace, 2, "majority")
        kept = yang2019.isolation_rates(at.calibrated, trace, 2, "survivors")
        assert np.all(kept > vote)
        assert kept[-1] > 0.95


@pytest.mark.acceptance
def test_figures(result: Reproduction) -> None:
    figures = {figure.name: figure for figure in result.figures}
    for index in (1, 2, 3, 4):
        panels = figures[f"yang2019-figure-{index}"].panels
        assert [panel.title for panel in panels] == ["N = 50", "N = 100", "N = 200"]
        for panel, count in zip(panels, (20, 10, 5), strict=True):
            for line in panel.lines:
                assert set(np.unique(line.x)) == set(range(1, count + 1))
                assert set(np.unique(line.y)) <= ({0.0, 1.0} if index < 3 else {0.0, 1.0, 2.0, 3.0, 4.0})
    # The attacked sensor, and no other, is what the sound rule names.
    survivors = figures["yang2019-figure-4"].panels[2].lines[2]
    assert survivors.y.tolist() == [3.0] * 5
    rates = figures["yang2019-rates"]
    assert all(np.all((line.y >= 0.0) & (line.y <= 1.0)) for panel in rates.panels for line in panel.lines)
    scores, named = figures["yang2019-feeder"].panels
    bound, without_3 = scores.lines[-1].y[0], scores.lines[3]
    assert without_3.label == "pi_J, J without meter 3"
    assert np.all(without_3.y < bound)
    late = scores.lines[0].x > 160.0
    assert np.all(scores.lines[0].y[late] > bound)
    assert set(named.lines[0].y[named.lines[0].x > 160.0]) == {3.0}
    assert set(named.lines[0].y[named.lines[0].x < 150.0]) == {0.0}


def test_points_of_windows() -> None:
    suspects = np.array([[False, False], [True, True], [False, True]])
    x, y = sampled_feeder.points(suspects)
    assert list(zip(x, y, strict=True)) == [(1.0, 0.0), (2.0, 1.0), (2.0, 2.0), (3.0, 2.0)]


def test_windows_that_overlap_as_in_the_text_count_one_step_twice() -> None:
    """The text writes [k* + (i-1)N, k* + iN], Algorithm 1 ends at k* + iN - 1; the algorithm counts."""
    pi = np.zeros(20)
    pi[10] = 2.0
    assert windows.detection(pi, 1.0, 10).tolist() == [False, True]
    text = [bool((pi[i * 10 : i * 10 + 11] > 1.0).any()) for i in range(2)]
    assert text == [True, True]

"""Example 1 of yang2019, its claims and figures; the counterexamples behind its errata."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec import windows
from gridsec.papers import sampled_feeder, yang2019
from gridsec.papers.claims import Reproduction
from tests.gridsec.papers.made import made


@pytest.fixture(scope="module")
def result() -> Reproduction:
    return made("yang2019")


def test_every_claim_is_met_or_explained(result: Reproduction) -> None:
    assert result.paper == "yang2019"
    assert not result.unexplained
    assert {claim.where for claim in result.unmet} == {"Remark 2 (erratum)", "Proposition 4 (erratum)"}


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

"""How wrong powers may be: in the design, in the frames, and in the end at the customers' voltages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from feeders.format.tables import write
from feeders.model.site import ALIKE, Site, from_history, from_tables, load, load_doubt, names, tell, unread
from feeders.registry import design
from feeders.simulation.scenario import START
from gridsec.errors import InputInvalid
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.front.measurements import frame_prior
from gridsec.estimators.front.posterior import voltage_prior
from gridsec.estimators.modal.monitor import ModalDesign, ModalState
from tests.codes import refused
from tests.feeders.unmetered import CIGRE, played, unmetered


@pytest.mark.parametrize("name", names(balanced=False))
def test_customers_with_meters_are_as_wrong_as_registers_and_power_factors_allow(name: str) -> None:
    """Written out for the feeders that come with the project, whose customers all have one."""
    site = load(name)
    model, found = site.loads, load_doubt(site)
    p = model.p_fraction * np.maximum(0.5 * model.load_peak, model.pv_peak) + model.p_floor
    q = 0.5 * (model.tan_max - model.tan_min) * (0.5 * model.load_peak) + model.q_floor
    np.testing.assert_array_equal(found.p, p / np.sqrt(3.0))
    np.testing.assert_array_equal(found.q, q / np.sqrt(3.0))
    assert (found.common_p, found.common_q, found.lasting, found.together) == (0.0, ALIKE, 1.0, 0.0)


def test_without_a_meter_powers_are_uniform_in_their_range() -> None:
    """By hand, from the rows of the files."""
    found, base, plain = load_doubt(CIGRE), CIGRE.feeder.base_kva, load_doubt(load("cigre-lv"))
    meta = CIGRE.tables.meta.load
    for k, row in enumerate(CIGRE.tables.customers):
        if row.meter:
            assert (found.p[k], found.q[k]) == (plain.p[k], plain.q[k])
            continue
        factor = meta.power_factor_min if row.power_factor_min is None else row.power_factor_min
        floor = meta.q_floor_percent / 100.0 * row.load_kw if row.q_floor_kvar is None else row.q_floor_kvar
        most = row.load_kw * np.tan(np.arccos(factor)) + 2.0 * floor
        assert found.p[k] * base == pytest.approx((row.load_kw + row.pv_kw) / np.sqrt(12.0))
        assert found.q[k] * base == pytest.approx(most / np.sqrt(12.0))
    np.testing.assert_array_equal(found.together, np.where(unmetered(CIGRE), ALIKE, 0.0))


def told(p_std: float | None, q_std: float | None) -> Site:
    rows = CIGRE.tables.customers
    rows = tuple(row if row.meter else replace(row, p_std_kw=p_std, q_std_kvar=q_std) for row in rows)
    return from_tables(replace(CIGRE.tables, customers=rows))


def test_frames_and_design_believe_alike_what_files_say_of_powers_that_nobody_meters() -> None:
    """1.5 kW and 0.4 kvar about the middle of the range; more than the range is no more than the range."""
    some, wide = unmetered(CIGRE), unread(CIGRE)
    for site in (told(1.5, 0.4), told(1.5, None)):
        frame, found, base = unread(site), load_doubt(site), site.feeder.base_kva
        np.testing.assert_allclose(frame.p_error[some] * base, 1.5 * np.sqrt(3.0))
        np.testing.assert_allclose(found.p[some], frame.p_error[some] / np.sqrt(3.0))
        np.testing.assert_allclose(found.q[some], frame.q_error[some] / np.sqrt(3.0))
        np.testing.assert_array_equal(frame.p, wide.p)
        assert (frame.q_error[some] < wide.q_error[some]).all()
        np.testing.assert_array_equal(frame.p_error[~some], wide.p_error[~some])
        assert not np.any(found.together)
    np.testing.assert_array_equal(unread(told(1e6, 1e6)).p_error, wide.p_error)
    np.testing.assert_array_equal(unread(told(1e6, 1e6)).q_error, wide.q_error)


def test_what_goes_up_and_down_together_moves_voltages_together() -> None:
    """Oracle: covariance of ``2 R dp + 2 X dq`` from a square root of that of all powers, dense."""
    feeder = load("simbench-lv-rural1").feeder
    rng, n = np.random.default_rng(4), feeder.bus.size
    together = np.where(np.arange(n) < 5, 0.4, 0.0)
    doubt = LoadDoubt(rng.random(n), rng.random(n), 1.0, common_q=0.5, together=together)
    model = feeder.linear()
    own = np.sqrt(1.0 - together)
    zero = np.zeros((n, n))
    roots = np.vstack(
        [
            np.hstack([np.diag(own * doubt.p), zero]),
            np.hstack([zero, np.sqrt(0.5) * np.diag(own * doubt.q)]),
            np.sqrt(0.5) * np.concatenate([np.zeros(n), own * doubt.q])[None, :],
            np.concatenate([np.sqrt(together) * doubt.p, np.sqrt(together) * doubt.q])[None, :],
        ]
    )
    w = roots @ np.hstack([2.0 * model.R_bus, 2.0 * model.X_bus]).T
    found = voltage_prior(feeder, feeder.bus, doubt, busbar=0.0)
    np.testing.assert_allclose(found.covariance, (w.T @ w)[:, feeder.bus], atol=1e-12)
    np.testing.assert_allclose(found.variance, np.diag(w.T @ w), atol=1e-12)
    with refused(InputInvalid, "out-of-range"):
        LoadDoubt(doubt.p, doubt.q, 1.0, together=together + 1.0)


def test_a_step_counts_what_is_not_metered_once_and_errs_by_what_it_says() -> None:
    """Oracle: AC power flow at 25 moments, after the observer has settled; the prior is the design's own."""
    site, some, ratios = CIGRE, unmetered(CIGRE), []
    watcher = design(site)
    for seed in range(25):
        state = watcher.init(START)
        for sample, frame in played(site, seed, 10.0):
            state, estimate, verdict = watcher.step(state, frame)
            truth = (sample.v_volt / CIGRE.customer_volt) ** 2
        assert isinstance(watcher.design, ModalDesign)
        assert isinstance(state, ModalState)
        front = watcher.design.front
        assert frame_prior(front, state.front.uncertainty) is front.prior
        assert not verdict.suspects.any()
        assert estimate.std is not None
        ratios.append(((estimate.v2 - truth) / estimate.std)[some])
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.2
    assert np.abs(ratios).max() < 3.0


def test_what_was_learned_of_a_slow_history_can_be_loaded_again(tmp_path: Path) -> None:
    """Errors that hardly change: no history shows that they last longer than it does itself."""
    slow = np.linspace(1.0, 1.0001, 20_000)[:, None] * np.ones(len(CIGRE.feeder.customers))
    found = from_history(slow, slow, 900.0)
    assert found.time_s == 900.0 * 20_000
    assert from_history(slow[:50], slow[:50], 900.0).time_s == 900.0 * 50
    write(tell(CIGRE.tables, found, CIGRE.feeder.base_kva), tmp_path / "learned")
    assert load(tmp_path / "learned").tables.meta.load.correlation_s == 1e7

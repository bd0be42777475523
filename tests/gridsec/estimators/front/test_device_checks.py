"""A named busbar meter against the estimate of the others."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec.estimators.front.device_checks import BusbarTrust, track_busbar, trusted_busbar
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.street import make_plant


def played(readings: np.ndarray, *, read: bool = True) -> list[BusbarTrust]:
    """Trust after each reading of a meter that was named before; the others see 1 pu."""
    design = front_end(make_plant(np.random.default_rng(1), customers=12, drop=0.03))
    named = np.ones(1, dtype=np.bool_)
    now, out = BusbarTrust(~named, np.zeros(1, np.intp), np.zeros(1, np.intp), np.zeros(1)), []
    for v0_squared in readings:
        there = np.array([read])
        now = track_busbar(design, now, np.array([v0_squared]), there, np.ones(1), np.full(1, 1e-6))
        out.append(now)
    return out


def test_trust_returns_after_the_ticks_of_release() -> None:
    """A mean of five ticks, and six ticks of agreement."""
    out = played(np.full(20, 1.0001))
    assert [one.trusted.all() for one in out].index(True) == 5
    assert not out[6].off.any()


def test_earlier_readings_leave_the_mean_within_its_time() -> None:
    out = played(np.concatenate([np.full(30, 1.06), np.ones(60)]))
    assert out[29].off[0] == pytest.approx(0.06)
    assert not out[30 + 5].trusted.all()
    assert out[-1].trusted.all()


def test_silence_is_neither_agreement_nor_deviation() -> None:
    assert not any(one.trusted.any() for one in played(np.ones(200), read=False))


def test_a_trusted_meter_stays_as_it_is() -> None:
    design = front_end(make_plant(np.random.default_rng(1), customers=12, drop=0.03))
    now, one = trusted_busbar(3), np.ones(3)
    assert track_busbar(design, now, 1.1 * one, one > 0.0, one, 1e-6 * one) is now
    assert not now.named.any()

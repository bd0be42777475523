"""Records of suspects and of the observer: what a restart keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.estimators.front import FrontDesign, SuspicionRecord, init, settling_s
from gridsec.estimators.front.device_checks import BusbarTrust
from gridsec.estimators.front.state import TrustState, distrusted, observed, resume, warm_start
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.street import make_plant

P, M = 12, 5
SUSPECTS = np.isin(np.arange(P), (2, 7))


@pytest.fixture(scope="module")
def design() -> FrontDesign:
    plant = make_plant(np.random.default_rng(4), customers=P, drop=0.03, inverters=np.arange(M))
    return front_end(plant)


def record(scale_s: float = 60.0, *, named: bool = True) -> SuspicionRecord:
    """Two suspect meters."""
    return replace(
        SuspicionRecord.empty(P, M), scale_s=np.where(SUSPECTS, scale_s, np.nan), named=SUSPECTS & named
    )


@pytest.mark.parametrize("named", [False, True])
def test_suspects_are_those_of_the_record(design: FrontDesign, *, named: bool) -> None:
    state = warm_start(design, init(design, 1000.0), record(named=named))
    assert state.trust.trusted.tolist() == (~SUSPECTS).tolist()
    assert state.trust.named.tolist() == (SUSPECTS & named).tolist()
    assert not state.trust.clear
    assert distrusted(design, state).same(record(named=named))
    after = replace(state, trust=state.trust.replaced(np.arange(P) == 2))
    assert distrusted(design, after).same(record(named=named).without(np.arange(P) == 2))


def test_without_suspects_the_record_is_empty(design: FrontDesign) -> None:
    state = init(design, 1000.0)
    assert state.trust.clear
    assert distrusted(design, state).is_empty
    assert distrusted(design, state) is SuspicionRecord.empty(P, M, 1)
    assert not TrustState(~SUSPECTS, SUSPECTS & False).clear


def test_a_named_phase_owes_the_settling_time_and_keeps_its_mean(design: FrontDesign) -> None:
    """A suspect phase that is not named is trusted: no estimator makes such a record any more."""
    before = replace(
        SuspicionRecord.empty(P, M),
        busbar_scale_s=np.array([15.0]),
        busbar_named=np.array([True]),
        busbar_off=np.array([0.03]),
    )
    state = warm_start(design, init(design, 1000.0), before)
    assert isinstance(state.busbar, BusbarTrust)
    assert state.busbar.named.all()
    assert -state.busbar.ticks_agreeing[0] == max(design.busbar_ticks, settling_s(design))
    found = distrusted(design, state)
    assert (found.busbar_scale_s[0], found.busbar_off[0]) == (5.0, 0.03)
    suspect = replace(before, busbar_named=np.array([False]))
    assert warm_start(design, init(design, 1000.0), suspect).busbar.trusted.all()


def test_a_record_of_the_observer_is_used_while_the_inverters_remember_it(design: FrontDesign) -> None:
    assert observed(design, init(design, 1000.0)) is None
    begun = replace(init(design, 1000.0), x=np.full(M, 1e-3))
    kept, limit = observed(design, begun), settling_s(design)
    assert kept is not None
    left = design.inverter_reach * np.exp(-design.certificate.rate * limit)
    assert (left <= design.options.settled * design.allowed).all()
    for age, used in ((limit, True), (limit + 1.0, False), (0.0, False), (-5.0, False)):
        start = init(design, kept.t + age)
        assert (resume(design, start, kept) is not start) == used

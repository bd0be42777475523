"""Sentences for the operator."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec.estimators.front import FrontDesign
from gridsec.estimators.front.output import (
    busbar_meter,
    explanations_sentence,
    fault_sentence,
    unread_sentence,
)
from gridsec.interface import Explanation, PowerOrigin
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.street import make_plant


@pytest.fixture(scope="module")
def design() -> FrontDesign:
    return front_end(make_plant(np.random.default_rng(1), customers=12, drop=0.03))


def way(
    meters: tuple[int, ...] = (), inverters: tuple[int, ...] = (), powers: tuple[int, ...] = ()
) -> Explanation:
    every = np.arange(12)
    return Explanation(np.isin(every, meters), np.isin(every, inverters), 0.5, np.isin(every, powers))


def test_every_explanation_is_told_as_what_it_is(design: FrontDesign) -> None:
    assert explanations_sentence(design, (way((1,)), way())) == (
        "Wrong are either the meter of c1 or else none of them; both explain the readings."
    )
    three = explanations_sentence(design, (way((1, 2)), way((3,), (4,)), way(powers=(5,))))
    assert three == (
        "Wrong are either the meters of c1, c2 or else the meter of c3 and the inverter of c4 or else the "
        "reported power of c5; each of these explains the readings."
    )
    assert "c11" not in explanations_sentence(design, (way(tuple(range(12))), way()))
    assert "or 3 more; each of these" in explanations_sentence(design, (way((1,)),) * 8)


def test_explanations_name_the_busbar(design: FrontDesign) -> None:
    no_meters, none = (
        np.zeros(12, dtype=np.bool_),
        np.zeros(design.plant.droop.tau.size, dtype=np.bool_),
    )
    one = Explanation(no_meters, none, 0.7, busbar=np.ones(1, dtype=np.bool_))
    other = Explanation(np.arange(12) == 2, none, 0.3, busbar=np.zeros(1, dtype=np.bool_))
    assert explanations_sentence(design, (one, other)) == (
        "Wrong are either the meter of the busbar or else the meter of c2; both explain the readings."
    )


def test_a_false_power_has_its_direction_and_amount(design: FrontDesign) -> None:
    """0.05 pu of 100 kVA; the inverters follow the customers."""
    assert fault_sentence(design, 2, 0.05) == (
        "It looks as if c2 feeds in 5.0 kW more than its readings say."
    )
    assert fault_sentence(design, 2, -0.05) == "It looks as if c2 draws 5.0 kW more than its readings say."
    owner = design.plant.feeder.customers[design.plant.droop.customer[1]]
    assert fault_sentence(design, 12 + 1, 0.02) == (
        f"The inverter of {owner} may inject 2.0 kvar that its curve does not ask for."
    )


def test_phases_of_the_busbar_are_listed() -> None:
    assert busbar_meter(np.array([True])) == "the meter of the busbar"
    assert busbar_meter(np.array([True, False, True])) == "the meter of the busbar (phases a, c)"


def test_unread_powers_are_listed_by_their_origin() -> None:
    origins = np.array([PowerOrigin.UNREAD, PowerOrigin.LATE, PowerOrigin.READ])
    sentence = unread_sentence(("a", "b", "c"), origins > 0, origins, np.array([0.6, 0.7, 0.1]), 0.5)
    assert sentence.startswith("No active power from a. The active power of b is older than the voltage. ")
    assert "0.7 %" in sentence

"""Redundancy against ranks in exact arithmetic: meters that see nothing, customers nobody meters."""

from __future__ import annotations

import numpy as np
import pytest

from feeders.model.site import Site, load
from feeders.studies.redundancy import ALL, SILENT, redundancy
from feeders.studies.unobservable import Attack
from tests.feeders.studies.exact_ranks import Exact, two_streets

CIGRE = load("cigre-lv")


def agrees(site: Site, unknown: list[str] | None, silent: list[str]) -> None:
    found = redundancy(site, unknown=unknown, silent=silent)
    gone, case = [site.meter_ids.index(name) for name in silent], SILENT if silent else ALL
    who = [site.feeder.customers.index(name) for name in found.unknown_silent]
    exact = Exact(site, who, gone)
    (row,) = found.summary[
        found.summary["case"].eq(case) & found.summary["attack"].eq(Attack.PERSISTENT)
    ].iloc
    assert row["index"] == exact.index()
    assert row["blind"] == ", ".join(site.feeder.customers[k] for k in exact.blind())
    meters = found.meters[found.meters["case"].eq(case)].set_index("meter")
    for j in exact.live:
        own = exact.index(must=j)
        assert meters.loc[site.meter_ids[j], "index_persistent"] == own
        assert meters.loc[site.meter_ids[j], "critical"] == (own == 1)


@pytest.mark.canary("0", "3", "6", "10", "13", "16", "19")
@pytest.mark.parametrize("seed", range(20))
def test_streets_without_some_meters_equal_exact_ranks(seed: int) -> None:
    site = two_streets(seed)
    assert site.meter_ids[0] == "m-root"
    agrees(site, None, [])
    if seed % 3 == 0:
        agrees(site, None, ["m-b0"])


@pytest.mark.parametrize("customer", CIGRE.feeder.customers)
def test_one_unknown_load_equals_exact_ranks(customer: str) -> None:
    agrees(CIGRE, [customer], [])


@pytest.mark.parametrize("silent", ["m01", "m02", "m04"])
def test_two_unknown_loads_and_a_silent_meter_equal_exact_ranks(silent: str) -> None:
    agrees(CIGRE, ["Load R15", "Load R18"], [silent])


def test_a_load_that_moves_only_its_own_meter_makes_it_critical() -> None:
    """The trunk has one x / r: (p, q) along (X, -R) of it moves nothing but what is behind its end."""
    found = redundancy(CIGRE, unknown=["Load R15"])
    assert found.summary["index"].tolist() == [1.0, 1.0]
    assert found.summary["liars"].tolist() == ["m03", "m03"]
    assert found.summary["detected"].tolist() == [0.0, 0.0]
    meters = found.meters.set_index("meter")
    assert meters.index[meters["critical"]].tolist() == ["m03"]
    # At the busbar nothing moves: nobody needs this meter to lie, and it can tell nobody anything.
    assert meters.loc["m01", ["index_persistent", "index_any"]].tolist() == [np.inf, np.inf]

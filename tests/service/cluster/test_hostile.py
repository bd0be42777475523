"""Hostile clients and wrong clocks: the same attacks on a single service and on a front with two workers."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from feeders.model.site import Site, load
from tests.service import hostile
from tests.service.clusters import ServedCluster, served_cluster
from tests.service.databases import Cluster
from tests.service.running import until

pytestmark = pytest.mark.postgresql

LOG_LINES, MEMORY_MB = 200, 150.0
"""Lines of the log and private memory that an attack may cost, at most; the queues hold 64 MiB."""


@pytest.fixture(scope="module")
def site() -> Site:
    return load("cigre-lv")


@pytest.fixture(scope="module", params=hostile.KINDS)
def live(
    request: pytest.FixtureRequest, cluster: Cluster, tmp_path_factory: pytest.TempPathFactory, site: Site
) -> Iterator[ServedCluster]:
    """Four feeders of a single service, or of a front with two workers."""
    folder, options = tmp_path_factory.mktemp("hostile"), hostile.KINDS[request.param]
    with served_cluster(folder, cluster.database(), site, 4, 0, options=options) as made:
        hostile.decided(made)
        yield made


@pytest.fixture
def apart(cluster: Cluster, tmp_path: Path, site: Site) -> Iterator[ServedCluster]:
    """Four feeders of a front and two workers, each with a clock of its own."""
    with served_cluster(tmp_path, cluster.database(), site, 4, 2) as made:
        until(lambda: set(made.owners().values()) == {"w0", "w1"}, "the distribution")
        hostile.decided(made)
        yield made


def unharmed(found: hostile.Watch, names: list[str]) -> None:
    """The list was answered, and the feeders kept their verdicts with recent ticks."""
    assert found.failed == []
    assert found.polls > 1
    assert found.late(names) == []
    assert {name: found.verdicts[name] for name in names} == {name: {"clean"} for name in names}


def endured(live: ServedCluster, name: str, seconds: float) -> None:
    """Feeders keep their verdicts during an attack, memory and log are bounded, and it leaves nothing."""
    attack, names = hostile.attacks(live)[name]
    cost = hostile.attacked(live, attack(), seconds)
    unharmed(cost.watch, names)
    assert cost.memory_mb < MEMORY_MB
    assert cost.lines <= LOG_LINES
    live.judged_within(live.names, time.time(), hostile.RECOVERY_S)
    hostile.decided(live)


@pytest.mark.canary("single")
def test_1100_idle_connections(live: ServedCluster) -> None:
    endured(live, "connections", 3.0)


@pytest.mark.acceptance
def test_200_stalled_streams(live: ServedCluster) -> None:
    endured(live, "streams", 30.0)


@pytest.mark.acceptance
@pytest.mark.parametrize("form", hostile.FORMS)
def test_a_flood_of_one_peer(live: ServedCluster, form: str) -> None:
    endured(live, form, 10.0)


@pytest.mark.acceptance
@pytest.mark.parametrize("live", ["workers"], indirect=True)
@pytest.mark.parametrize("form", hostile.FORGERIES)
def test_a_flood_between_front_and_workers(live: ServedCluster, form: str) -> None:
    endured(live, form, 10.0)


@pytest.mark.acceptance
@pytest.mark.parametrize("leap_s", [hostile.HOUR_S, -hostile.HOUR_S])
def test_a_leap_of_the_front_changes_no_verdict(apart: ServedCluster, leap_s: float) -> None:
    wrong, after = hostile.front_leaps(apart, leap_s)
    unharmed(wrong, apart.names)
    assert any(reason.startswith("front: clock") for reason in wrong.reasons)
    unharmed(after, apart.names)


@pytest.mark.acceptance
@pytest.mark.parametrize("leap_s", [hostile.HOUR_S, -hostile.HOUR_S])
def test_a_leap_of_one_worker_is_that_of_its_feeders(apart: ServedCluster, leap_s: float) -> None:
    its, others = apart.owned("w0"), apart.owned("w1")
    wrong, _ = hostile.worker_leaps(apart, "w0", leap_s)
    unharmed(wrong, others)
    assert [name for name in its if "clean" in wrong.verdicts[name]] == []
    assert any(reason.startswith("w0: clock") for reason in wrong.reasons)


@pytest.mark.acceptance
@pytest.mark.parametrize("leap_s", [hostile.HOUR_S, -hostile.HOUR_S])
def test_a_leap_of_all_clocks_is_over_within_ten_seconds(apart: ServedCluster, leap_s: float) -> None:
    standing = apart.alarms(state="raised")
    assert hostile.all_leap(apart, leap_s) <= hostile.RECOVERY_S
    assert apart.alarms(state="raised") == standing

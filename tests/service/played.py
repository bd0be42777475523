"""Scenarios played through the service: live over zenoh, or as a recording that is replayed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from feeders.format.tables import write
from feeders.model.site import Site
from feeders.simulation.recording import read_recording, record
from feeders.simulation.scenario import Scenario, SimulatedTick
from service.cli.simulate import Pace, play
from service.engine.feeder_monitor import FeederMonitor, TickResult
from service.engine.replay import ReplayCounts, replay
from service.ingest.reading import Reading
from service.report.report import FeederReport
from tests.service.running import service, until


def served(
    site: Site, scenario: Scenario, folder: Path, name: str
) -> tuple[list[SimulatedTick], dict[str, Any]]:
    """Play a scenario into a running service; what was played, and the feeder's state at its end.

    Parameters
    ----------
    site, scenario
        The feeder, and what happens.
    folder, name
        Where its files are written, and as what.
    """
    write(site.tables, folder / name)
    with service(folder, (str(folder / name),), clock="events") as live:
        samples = list(play(site, scenario, live.meters, Pace(float("inf"), ahead=3)))
        until(lambda: live.state(name).get("t", 0.0) >= samples[-1].t - 2.0, "the end")
        return samples, live.state(name)


def ingest(monitor: FeederMonitor, reading: Reading, now: float) -> list[TickResult]:
    """Align one reading and judge the ticks that become due."""
    monitor.place(reading, now)
    return [monitor.judge() for _ in range(len(monitor.pending))]


def replayed(site: Site, scenario: Scenario, folder: Path) -> list[FeederReport]:
    """Record a scenario into a folder and replay it; one report a tick."""
    recording = record(site, scenario, folder / "day.parquet")
    return [one.report for one in replay(site, read_recording(recording.path).readings(), ReplayCounts())]

"""What recorded readings say against a feeder's files: proposals with confidence, never applied unasked.

References
----------
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from feeders.equipment import digest, find
from feeders.schema import write
from feeders.studies import calibrate_tables
from feeders.studies.calibrate_corrections import Correction, Kind, apply
from feeders.studies.calibrate_readings import Frames, blind, frames
from feeders.studies.calibrate_search import LENGTH_SPREAD, Round, State, Verdict, compare, prepare
from feeders.studies.calibrate_steps import Search, read
from feeders.studies.journal import Journal, Progress, Where
from gridsec.errors import InputInvalid, Problem, refuse

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.load_phases import ThreePhaseSite
    from feeders.recording import Recording

__all__ = ["Calibrate", "OtherFeeder", "calibrate", "wrong_numbers"]


class OtherFeeder(InputInvalid):
    """A folder holds another feeder than the one that was studied."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibrate:
    """What `calibrate` found.

    Attributes
    ----------
    feeder, digest
        The feeder's name, and its content.
    frames, span_h
        How many moments were compared, and over what time, h.
    risk
        Probability of any proposal if the files are right.
    meters
        One row for each meter: `meter`, `customer`, `frames` (readings used), `bias_percent`, `std_percent`,
        `low_percent`, `high_percent` (95 %; of the voltage, relative to the busbar's meter: an error that all
        have in common cannot be told), `verdict`.
    lines
        One row for each line, or lines in series: `lines`, `from_bus`, `to_bus`, `factor`, `std`, `low`,
        `high` (of the length in the files, if all others are right), `same` (lines whose effect is the same),
        `verdict`.
    customers
        One row for each customer: `customer`, `meter`, `bus`, `phases` (as corrected), `alternative` (the
        best other place), `log_factor` (of it against this one), `open` (places that are not ruled out),
        `verdict`.
    loads
        One row for each customer: `customer`, `power_factor`, `low`, `high`, `p_gain_percent`,
        `p_gain_std_percent`, `verdict`.
    errors
        `quantity`, `estimate`, `low`, `high`, `unit`, `verdict`: standard deviations and correlation time of
        the errors of the customers' powers, and the meters' noise relative to what they promise.
    proposals
        What to correct, in the order it was found: `kind`, `what` (of a lateral its first line and its
        customers), `now`, `proposed`, `estimate`, `std` (of a length, the factor; otherwise how much of the
        proposed change the readings show: 1 is all), `low`, `high`, `log_factor` (gain of the
        log-likelihood), `confidence`, `verdict`, `alternatives`.
    corrections
        The proposals that are sure, in the words of the files.
    unread
        Phases of which the busbar has no voltage: the meters on them are left out.
    """

    feeder: str
    digest: str
    frames: int
    span_h: float
    risk: float
    meters: pd.DataFrame
    lines: pd.DataFrame
    customers: pd.DataFrame
    loads: pd.DataFrame
    errors: pd.DataFrame
    proposals: pd.DataFrame
    corrections: tuple[Correction, ...]
    unread: str = ""

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name."""
        names = ("proposals", "meters", "lines", "customers", "loads", "errors")
        return {name: getattr(self, name) for name in names}

    def corrected(self, site_folder: Path | str, out: Path | str) -> None:
        """Write a corrected copy of a feeder's folder; only what is sure is corrected.

        Parameters
        ----------
        site_folder
            The feeder that was studied: its folder, or its name.
        out
            A new or empty folder.

        Raises
        ------
        OtherFeeder
            If it is not the feeder that was studied.
        FileExistsError
            If there is something in the folder.
        FeederInvalid, OSError
            If it cannot be read or written.
        """
        tables, target = find(site_folder), Path(out)
        if digest(tables) != self.digest:
            raise OtherFeeder(
                [Problem("other-origin", f"{site_folder}: not the feeder that was studied, or changed since")]
            )
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise FileExistsError(f"{target}: already there; a corrected copy goes into a new folder")
        for wrong in self.corrections:
            tables = apply(tables, wrong)
        write(tables, target)


def calibrate(
    site: Site | ThreePhaseSite,
    readings: pd.DataFrame | Recording | Path | str,
    *,
    risk: float = 0.05,
    tolerance: float = 0.02,
    exclude: Sequence[str] = (),
    kinds: Sequence[Kind] = tuple(Kind),
    journal: Where = None,
    progress: Progress | None = None,
) -> Calibrate:
    """Compare recorded readings with a feeder's files.

    Parameters
    ----------
    site
        The feeder, balanced (with loops or without) or of three phases.
    readings
        A recording, a table with its columns, or a Parquet or CSV file.
    risk
        Probability of any proposal if the files are right, 0 to 1.
    tolerance
        Relative error (1 sigma) of lines' lengths that is no mistake.
    exclude
        Meters that are not trusted. Their powers are still believed.
    kinds
        Which errors to look for; fewer take less time, and what is not looked for may pass for another.
    journal
        File in which each error that is found is kept; an interrupted study goes on from it.
    progress
        Told how much of the present comparison is done.

    Raises
    ------
    RecordingInvalid
        If the readings are another feeder's, name unknown meters, lack the busbar, are hardly in V, kW and
        kvar, or are too few.
    ValueError
        If there is no such meter, or a number is out of range.
    FeederInvalid
        If closed lines form loops in three phases.
    OtherStudy
        If the journal is another study's.
    InUse
        If another process is writing it.
    """
    problems = wrong_numbers(risk, tolerance)
    if unknown := sorted(set(exclude) - set(site.meter_ids)):
        problems.append(Problem("unknown-name", f"{site.feeder.name} has no meter {', '.join(unknown)}"))
    refuse(problems)
    given = frames(site, readings, exclude=exclude)
    subject = _subject(site, given, risk, tolerance) | {"exclude": sorted(exclude), "kinds": sorted(kinds)}

    def weighed(now: Round) -> Verdict:
        return compare(now, given, risk, progress or _quiet, kinds)

    def fitted(state: State) -> Round:
        return prepare(state, given, tolerance=tolerance, errors=True)

    unread = given.unread if site.tables.in_phases else ""
    files = State(site.tables, (*exclude, *blind(site, unread)), unread=unread)
    with Journal(journal, subject) as kept:
        found = Search(files, fitted, weighed, risk, kept).run()
    now = found.now
    lines, ids = calibrate_tables.lines(now, tolerance, kinds)
    wrongs = [read(row["correction"]) for row in found.rows]
    rows, sure = calibrate_tables.final(found.rows, wrongs, lines, ids)
    return Calibrate(
        feeder=site.feeder.name,
        digest=site.digest,
        frames=given.t.size,
        span_h=float(given.t[-1] - given.t[0]) / 3600.0,
        risk=risk,
        meters=calibrate_tables.meters(now, risk),
        lines=lines,
        customers=calibrate_tables.customers(now, found.said, wrongs, risk, kinds),
        loads=calibrate_tables.loads(now),
        errors=calibrate_tables.errors(now),
        proposals=rows,
        corrections=sure,
        unread=unread,
    )


def wrong_numbers(risk: float, tolerance: float) -> list[Problem]:
    """Return what is wrong with numbers of a calibration.

    Parameters
    ----------
    risk, tolerance
        As `calibrate` takes them.
    """
    problems = []
    if not 0.0 < risk < 1.0:
        problems.append(Problem("out-of-range", f"risk is {risk}; it must be between 0 and 1"))
    if not 0.0 < tolerance < LENGTH_SPREAD:
        problems.append(
            Problem("out-of-range", f"tolerance is {tolerance}; it must be between 0 and {LENGTH_SPREAD}")
        )
    return problems


def _quiet(done: int, total: int) -> None:
    """Tell nobody."""


def _subject(site: Site | ThreePhaseSite, given: Frames, risk: float, tolerance: float) -> dict[str, Any]:
    content = hashlib.sha256()
    busbar = given.v0_volt, given.v0_phases
    for values in (given.t, given.v_volt, given.p_kw, given.q_kvar, *busbar, given.count):
        content.update(np.ascontiguousarray(values).tobytes())
    return {
        "study": "calibrate",
        "digest": site.digest,
        "readings": content.hexdigest(),
        "risk": risk,
        "tolerance": tolerance,
    }

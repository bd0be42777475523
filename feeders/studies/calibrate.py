"""What recorded readings say against a feeder's files: proposals with confidence, never applied unasked.

References
----------
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd

from feeders.equipment import digest, find
from feeders.schema import write
from feeders.studies import calibrate_tables
from feeders.studies.calibrate_corrections import Correction, Kind, apply, as_filed, left
from feeders.studies.calibrate_readings import Frames, blind, frames
from feeders.studies.calibrate_search import (
    LENGTH_SPREAD,
    SHORTEST,
    Round,
    State,
    Verdict,
    compare,
    correction,
    prepare,
)
from feeders.studies.journal import Journal, Progress, Where
from gridsec.errors import refuse

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.load_phases import ThreePhaseSite
    from feeders.recording import Recording
    from feeders.schema import FeederTables

__all__ = ["Calibrate", "OtherFeeder", "calibrate", "wrong_numbers"]

MOST_ERRORS: Final = 24
"""After so many errors the files are another feeder's."""


class OtherFeeder(ValueError):
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
            raise OtherFeeder(f"{site_folder}: not the feeder that was studied, or changed since")
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
        problems.append(f"{site.feeder.name} has no meter {', '.join(unknown)}")
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
        now, verdict, found = _searched(files, fitted, weighed, risk, kept)
    lines, ids = calibrate_tables.lines(now, tolerance, kinds)
    wrongs = [_read(row["correction"]) for row in found]
    rows, sure = calibrate_tables.final(found, wrongs, lines, ids)
    return Calibrate(
        feeder=site.feeder.name,
        digest=site.digest,
        frames=given.t.size,
        span_h=float(given.t[-1] - given.t[0]) / 3600.0,
        risk=risk,
        meters=calibrate_tables.meters(now, risk),
        lines=lines,
        customers=calibrate_tables.customers(now, verdict, wrongs, risk, kinds),
        loads=calibrate_tables.loads(now),
        errors=calibrate_tables.errors(now),
        proposals=rows,
        corrections=sure,
        unread=unread,
    )


def wrong_numbers(risk: float, tolerance: float) -> list[str]:
    """Return what is wrong with numbers of a calibration.

    Parameters
    ----------
    risk, tolerance
        As `calibrate` takes them.
    """
    problems = []
    if not 0.0 < risk < 1.0:
        problems.append(f"risk is {risk}; it must be between 0 and 1")
    if not 0.0 < tolerance < LENGTH_SPREAD:
        problems.append(f"tolerance is {tolerance}; it must be between 0 and {LENGTH_SPREAD}")
    return problems


def _searched(
    files: State,
    fitted: Callable[[State], Round],
    weighed: Callable[[Round], Verdict],
    risk: float,
    kept: Journal,
) -> tuple[Round, Verdict, list[dict[str, Any]]]:
    """One error after the other, until the readings speak for none; with the last round and what it said."""
    state, found = files, list[dict[str, Any]]()
    been = [files]
    for step in range(MOST_ERRORS + 1):
        now = fitted(state)
        said: list[Verdict] = []

        def work(now: Round = now, said: list[Verdict] = said) -> dict[str, Any] | None:
            said.append(weighed(now))
            return _best(now, said[0], risk, files.tables)

        row = kept.get(f"error {step}", work)
        if row is None or step == MOST_ERRORS:
            break
        wrong = _read(row["correction"])
        if wrong.kind is Kind.METER:
            # What its readings may have been taken for until now is forgotten: all begins again without it.
            state = replace(files, excluded=(*state.excluded, *wrong.names))
            found = [*(each for each in found if each["correction"]["kind"] == Kind.METER), row]
        elif any(state.after(wrong).same(before) for before in been):
            # The readings speak for each of two places once the other one is taken for right.
            found = [_doubted(each, wrong) for each in found]
            break
        else:
            state = state.after(wrong)
            found = _together(found, row, files.tables, now.net.site.bus_of_file)
        been.append(state)
    return now, said[0] if said else weighed(now), found


def _together(
    found: list[dict[str, Any]], row: dict[str, Any], files: FeederTables, bus_of_file: Mapping[str, int]
) -> list[dict[str, Any]]:
    """Errors that do not contradict each other: of a customer's place the last one holds.

    Its gain includes that of those it replaces. One that leads back to what the files say is none.
    """
    wrong, gain, rest = _read(row["correction"]), row["log_factor"], []
    for each in found:
        earlier = _read(each["correction"])
        kept = left(earlier, wrong)
        if kept is None:
            gain += each["log_factor"]
        else:
            rest.append(each if kept == earlier else each | {"correction": asdict(kept)})
    return rest if as_filed(files, wrong, bus_of_file) else [*rest, row | {"log_factor": gain}]


def _doubted(row: dict[str, Any], wrong: Correction) -> dict[str, Any]:
    """An error that cannot be told from another one, if it is about the same customers."""
    told = _read(row["correction"])
    if (told.kind, told.names) != (wrong.kind, wrong.names):
        return row
    return row | {"alternatives": [*row["alternatives"], calibrate_tables.told(wrong)]}


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


def _best(now: Round, said: Verdict, risk: float, files: FeederTables) -> dict[str, Any] | None:
    """The error that the readings speak for most; None where they speak for none."""
    if said.any < math.log(1.0 / risk):
        return None
    best = int(said.kept[0])
    guess, g, h = said.guesses[best], float(said.found.g[best]), float(said.found.h[best])
    shift = g / (h + LENGTH_SPREAD**-2) if guess.kind is Kind.LENGTH else 0.0
    wrong = correction(now, guess, max(1.0 + shift, SHORTEST))
    others = [correction(now, said.guesses[k]) for k in said.kept[1:]]
    if wrong.kind is Kind.PHASE:
        # It may as well be on one of which there is no voltage to compare with.
        others += [replace(wrong, phases=phase) for phase in now.state.unread]
    return {
        "correction": asdict(wrong),
        "estimate": g / h if h > 0.0 else 0.0,
        "std": h**-0.5 if h > 0.0 else math.inf,
        "log_factor": float(said.found.log_factor[best]),
        "confidence": float(said.confidence[best]),
        # Swaps build on each other; a place is compared with that in the files.
        "now": calibrate_tables.present(now.state.tables if wrong.kind is Kind.SWAP else files, wrong),
        "since": guess.since,
        "until": guess.until,
        "alternatives": [calibrate_tables.told(other) for other in others],
    }


def _read(row: dict[str, Any]) -> Correction:
    return Correction(
        Kind(row["kind"]),
        tuple(row["names"]),
        row["bus"],
        row["phases"],
        row["factor"],
        tuple(row["lines"]),
    )

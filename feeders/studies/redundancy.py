"""Number of manipulated meters that a feeder withstands: in total, by meter, by part, with silent meters.

References: lee2018, chapter 3; docs/theory-studies.md, section 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd

from feeders.model.site import Site
from feeders.studies.running import Progress, Where, worked
from feeders.studies.unobservable import Attack, CurvePositions, Knowledge, knowledge, see_names
from gridsec.errors import DesignInfeasible
from gridsec.planning.redundancy import (
    FeederSection,
    fewest_meters,
    meter_redundancy,
    part_redundancy,
    parts,
)
from gridsec.secure.index import Index

__all__ = ["ALL", "SILENT", "Redundancy", "redundancy"]

ALL: Final = "all live"
SILENT: Final = "silent"


@dataclass(frozen=True, slots=True, eq=False)
class Redundancy:
    """Result of `redundancy`.

    Every table has a column `case`: "all live", or "silent" without the given meters. `index_persistent` and
    `index_any`: the fewest manipulated meters that stay invisible with some measured voltage falsified, for
    attacks with a lasting effect and for any; infinity without such an attack, NaN if the search was stopped
    (`note` has the reason).
    """

    feeder: str
    digest: str
    # unknown, unknown_silent: customers with unknown powers, in the two cases
    unknown: tuple[str, ...]
    unknown_silent: tuple[str, ...]
    silent: tuple[str, ...]
    curves: CurvePositions
    # one row for each case and kind of attack: `patterns` (dimension of hidden attacks), `blind` (customers
    # with a voltage that no meter determines, even without an attack), `index`, `detected` (largest number of
    # manipulated meters that cannot hide; without blind customers, the pair is still detectable, or
    # observable, after the loss of any `detected` meters), `identified` (largest number of manipulated meters
    # that are identified), `liars`
    summary: pd.DataFrame
    # one row for each case and meter: its own indices, `critical`, `identified_without` (number that the
    # others identify, for persistent attacks, without it)
    meters: pd.DataFrame
    # one row for each case and part: the same for manipulated meters inside it, all meters outside honest
    parts: pd.DataFrame

    @property
    def changes(self) -> pd.DataFrame:
        """Parts that identify fewer manipulated meters without the silent ones: before and after."""
        columns = ["bus", "meters", "identified"]
        before = self.parts[self.parts["case"] == ALL][columns]
        after = self.parts[self.parts["case"] == SILENT][["bus", "meters", "identified"]]
        both = before.merge(after, on="bus", suffixes=("", "_silent"))
        return both[both["identified_silent"] < both["identified"]].reset_index(drop=True)

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name; `changes` with silent meters only."""
        found = {"summary": self.summary, "meters": self.meters, "parts": self.parts}
        return found | ({"changes": self.changes} if self.silent else {})


def redundancy(
    site: Site,
    *,
    unknown: Sequence[str] | None = None,
    silent: Sequence[str] = (),
    busbar_known: bool = True,
    curves: CurvePositions | str = CurvePositions.STEEPEST,
    journal: Where = None,
    progress: Progress | None = None,
) -> Redundancy:
    """Count manipulated meters that stay invisible even with exact knowledge of feeder and honest loads.

    The arguments are those of `feeders.studies.unobservable.knowledge`.

    Raises ValueError for an unknown customer, meter or region of the curves; OtherStudy, InUse as
        `feeders.studies.running.Journal`.
    """
    see_names(site, unknown=unknown, meters=silent, curves=curves)
    curves = CurvePositions(curves)
    subject = {
        "study": "redundancy",
        "digest": site.digest,
        "unknown": None if unknown is None else sorted(unknown),
        "silent": sorted(silent),
        "busbar_known": busbar_known,
        "curves": str(curves),
    }
    known = partial(knowledge, site, unknown=unknown, busbar_known=busbar_known, curves=curves)
    cases = {ALL: known(silent=())}
    if silent:
        cases[SILENT] = known(silent=silent)
    pieces = parts(site.spanning, site.feeder.customer_bus[site.meters], site.ties)
    tasks = [task for case, what in cases.items() for task in _tasks(site, case, what, pieces)]
    done = worked(journal, subject, tasks, progress)
    return Redundancy(
        feeder=site.feeder.name,
        digest=site.digest,
        unknown=cases[ALL].unknown,
        unknown_silent=cases[SILENT].unknown if silent else cases[ALL].unknown,
        silent=tuple(silent),
        curves=curves,
        summary=_table(done, "summary", site),
        meters=_table(done, "meter", site),
        parts=_table(done, "part", site),
    )


Task = tuple[str, Callable[[], Any]]


def _tasks(site: Site, case: str, what: Knowledge, pieces: Sequence[FeederSection]) -> list[Task]:
    out: list[Task] = [
        (f"summary|{case}|{attack}", partial(_summary, site, case, what, attack)) for attack in Attack
    ]
    live = np.flatnonzero(~what.silent).tolist()
    out += [(f"meter|{case}|{j}", partial(_meter, site, case, what, j)) for j in live]
    out += [(f"part|{case}|{piece.bus}", partial(_part, site, case, what, piece)) for piece in pieces]
    return out


def _summary(site: Site, case: str, what: Knowledge, attack: Attack) -> dict[str, Any]:
    given = what.found[attack]
    row = {"case": case, "attack": str(attack), "meters": int(np.count_nonzero(~what.silent))}
    row["patterns"] = given.dimension
    row["blind"] = [site.feeder.customers[k] for k in np.flatnonzero(what.blind(attack))]
    found, note = _or_note(lambda: fewest_meters(given, silent=what.silent))
    return row | {
        "index": found.count,
        "detected": found.detectable,
        "identified": found.correctable,
        "liars": found.sensors.tolist(),
        "note": note,
    }


def _meter(site: Site, case: str, what: Knowledge, j: int) -> dict[str, Any]:
    customer = int(site.meters[j])
    row: dict[str, Any] = {
        "case": case,
        "meter": site.meter_ids[j],
        "customer": site.feeder.customers[customer],
        "bus": site.feeder.buses[int(site.feeder.bus[customer])],
    }
    notes = set()
    for attack, given in what.found.items():
        try:
            found = meter_redundancy(given, j, what.silent)
        except DesignInfeasible as error:
            notes.add(str(error))
            row |= {f"index_{attack}": math.nan}
            continue
        row[f"index_{attack}"] = found.own.count
        if attack is Attack.PERSISTENT:
            row["critical"], row["identified_without"] = found.critical, found.without.correctable
            row["with"] = [k for k in found.own.sensors.tolist() if k != j]
    row.setdefault("critical", None)
    row.setdefault("identified_without", math.nan)
    row.setdefault("with", [])
    return row | {"note": "; ".join(sorted(notes))}


def _part(site: Site, case: str, what: Knowledge, piece: FeederSection) -> dict[str, Any]:
    row: dict[str, Any] = {
        "case": case,
        "bus": site.spanning.buses[piece.bus],
        "branch": piece.branch,
        "meters": int(np.count_nonzero(~what.silent[piece.meters])),
    }
    notes = set()
    for attack, given in what.found.items():
        found, note = _or_note(partial(part_redundancy, given, piece, what.silent))
        row[f"index_{attack}"] = found.count
        notes.add(note)
        if attack is Attack.PERSISTENT:
            row |= {"detected": found.detectable, "identified": found.correctable}
    return row | {"note": "; ".join(sorted(notes - {""}))}


def _or_note(search: Callable[[], Index]) -> tuple[Index, str]:
    """Answer of a search, or the reason for its stop."""
    try:
        return search(), ""
    except DesignInfeasible as error:
        return Index(math.nan, np.zeros(0, dtype=np.intp), np.zeros(0)), str(error)


def _table(done: dict[str, Any], kind: str, site: Site) -> pd.DataFrame:
    frame = pd.DataFrame([row for key, row in done.items() if key.startswith(f"{kind}|")])
    for column in ("liars", "with"):
        if column in frame:
            frame[column] = [" ".join(site.meter_ids[j] for j in row) for row in frame[column]]
    if "blind" in frame:
        frame["blind"] = [", ".join(row) for row in frame["blind"]]
    return frame

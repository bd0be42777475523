"""Stepwise selection of the errors of a feeder's files: forward steps, then each error re-examined.

A forward step corrects the error that the readings support most. An early step is compared while later
errors are still in the files, so that it may stand in for them. Re-examination therefore withdraws each
error alone, with all others corrected, and compares all hypotheses again: the error stays, another one takes
its place, or none is needed.

References
----------
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from feeders.studies import calibrate_tables
from feeders.studies.calibrate_corrections import Correction, Kind, as_filed, left
from feeders.studies.calibrate_search import LENGTH_SPREAD, SHORTEST, Guess, Round, State, Verdict, correction
from gridsec.errors import FeederInvalid

if TYPE_CHECKING:
    from feeders.schema import FeederTables
    from feeders.studies.journal import Journal

__all__ = ["Found", "Search", "read"]

MOST_ERRORS: Final = 24
"""Largest number of errors; with more the files are another feeder's."""

MOST_REVISIONS: Final = 3
"""Largest number of re-examinations of all errors; most searches need one."""

Row = dict[str, Any]
"""One error in plain JSON types, as the journal holds it."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of a search.

    Attributes
    ----------
    now
        The files with all errors corrected, fitted.
    said
        Comparison of all further hypotheses there.
    rows
        The errors, in the order of their corrections.
    """

    now: Round
    said: Verdict
    rows: list[Row]


class Search:
    """Search for the errors of a feeder's files.

    Parameters
    ----------
    files
        The files.
    fitted
        Fits files that are taken for right.
    weighed
        Compares all hypotheses at such a fit.
    risk
        Probability of any proposal if the files are right.
    kept
        Journal of the steps; an interrupted search resumes from it.
    """

    def __init__(
        self,
        files: State,
        fitted: Callable[[State], Round],
        weighed: Callable[[Round], Verdict],
        risk: float,
        kept: Journal,
    ) -> None:
        self._files = files
        self._fitted = fitted
        self._weighed = weighed
        self._risk = risk
        self._kept = kept
        self._steps = 0

    def run(self) -> Found:
        """Forward steps and re-examinations until both change nothing."""
        found, settled = self._forward(self._files, [])
        for _ in range(MOST_REVISIONS if settled else 0):
            rows = self._revised(found.rows)
            same = [row["correction"] for row in rows] == [row["correction"] for row in found.rows]
            if same:
                return replace(found, rows=rows)
            found, settled = self._forward(self._after(rows), rows)
            if not settled:
                break
        return found

    def _after(self, rows: Sequence[Row]) -> State:
        """The files with these errors corrected."""
        state = self._files
        for row in rows:
            state = state.after(read(row["correction"]))
        return state

    def _step(self, state: State) -> tuple[Round, Callable[[], Verdict], Row | None]:
        """Fit, comparison, and the error that the readings support most; None without one."""
        now = self._fitted(state)
        said: list[Verdict] = []

        def verdict() -> Verdict:
            if not said:
                said.append(self._weighed(now))
            return said[0]

        row = self._kept.get(
            f"error {self._steps}", lambda: _best(now, verdict(), self._risk, self._files.tables)
        )
        self._steps += 1
        return now, verdict, row

    def _forward(self, state: State, rows: list[Row]) -> tuple[Found, bool]:
        """One error after the other; False where the search comes back to files that it has seen."""
        been, settled = [self._files, state], True
        for step in range(MOST_ERRORS + 1):
            now, verdict, row = self._step(state)
            if row is None or step == MOST_ERRORS:
                break
            wrong = read(row["correction"])
            if wrong.kind is Kind.METER:
                # All that was found may rest on this meter's readings: the search restarts without it.
                meters = [each for each in rows if each["correction"]["kind"] == Kind.METER]
                rows = [*meters, row]
                state = self._after(rows)
            elif any(state.after(wrong).same(before) for before in been):
                # The readings support each of two places once the other one is taken for right.
                rows, settled = [_doubted(each, wrong) for each in rows], False
                break
            else:
                state = state.after(wrong)
                rows = _together(rows, row, self._files.tables, now.net.site.bus_of_file)
            been.append(state)
        return Found(now, verdict(), rows), settled

    def _revised(self, rows: list[Row]) -> list[Row]:
        """The errors, each compared again with all others corrected."""
        for row in rows:
            wrong = read(row["correction"])
            alone = [each for each in rows if _same_subject(read(each["correction"]), wrong)]
            rest = [each for each in rows if each not in alone]
            if row not in rows or wrong.kind is Kind.METER or not _files_of(rest) or _chained(wrong, rest):
                continue
            try:
                now, _, again = self._step(self._after(rest))
            except FeederInvalid:
                continue  # A bus and a phase that need each other cannot be withdrawn alone.
            if again is None:
                rows = rest
            elif again["correction"]["kind"] != Kind.METER:
                rows = _together(rest, again, self._files.tables, now.net.site.bus_of_file)
        return rows


def _files_of(rows: Sequence[Row]) -> bool:
    """Any of the errors is one of the files: otherwise nothing has changed since the first comparison."""
    return any(row["correction"]["kind"] != Kind.METER for row in rows)


def _same_subject(one: Correction, other: Correction) -> bool:
    """Equal errors, or lengths of the same lines, which are found in several steps."""
    return one == other or (one.kind is other.kind is Kind.LENGTH and one.names == other.names)


def _chained(wrong: Correction, rest: Sequence[Row]) -> bool:
    """An exchange of meters is relative to others of the same customers: it cannot be withdrawn alone."""
    others = [read(row["correction"]) for row in rest]
    return wrong.kind is Kind.SWAP and any(
        other.kind is Kind.SWAP and set(other.names) & set(wrong.names) for other in others
    )


def _together(found: list[Row], row: Row, files: FeederTables, bus_of_file: Mapping[str, int]) -> list[Row]:
    """Errors that do not contradict each other: of a customer's place the last one holds.

    Its gain includes that of those it replaces. One that leads back to what the files say is none.
    """
    wrong, gain, rest = read(row["correction"]), row["log_factor"], []
    for each in found:
        earlier = read(each["correction"])
        kept = left(earlier, wrong)
        if kept is None:
            gain += each["log_factor"]
        else:
            changed = {"correction": asdict(kept), "now": calibrate_tables.present(files, kept)}
            rest.append(each if kept == earlier else each | changed)
    return rest if as_filed(files, wrong, bus_of_file) else [*rest, row | {"log_factor": gain}]


def _doubted(row: Row, wrong: Correction) -> Row:
    """An error that cannot be told from another one, if it is about the same customers."""
    told = read(row["correction"])
    if (told.kind, told.names) != (wrong.kind, wrong.names):
        return row
    return row | {"alternatives": [*row["alternatives"], calibrate_tables.told(wrong)]}


def _best(now: Round, said: Verdict, risk: float, files: FeederTables) -> Row | None:
    """The error that the readings support most; None where they support none."""
    if said.any < math.log(1.0 / risk):
        return None
    best = int(said.kept[0])
    guess, g, h = said.guesses[best], float(said.found.g[best]), float(said.found.h[best])
    shift = g / (h + LENGTH_SPREAD**-2) if guess.kind is Kind.LENGTH else 0.0
    wrong = correction(now, guess, max(1.0 + shift, SHORTEST))
    others = [correction(now, said.guesses[k]) for k in said.kept[1:]]
    if wrong.kind is Kind.PHASE:
        others += _unread(wrong, guess, now.state.unread)
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


def _unread(wrong: Correction, guess: Guess, unread: str) -> list[Correction]:
    """Phases without a voltage of the busbar to compare with: a single part may be on one of them."""
    return [] if guess.exchange else [replace(wrong, phases=phase) for phase in unread]


def read(row: Row) -> Correction:
    """A correction from the plain types of the journal."""
    return Correction(
        Kind(row["kind"]),
        tuple(row["names"]),
        row["bus"],
        row["phases"],
        row["factor"],
        tuple(row["lines"]),
    )

"""Calibration of a feeder's files by recorded readings: stepwise selection, proposals, tables.

A forward step corrects the error that the readings support most. At an early step later errors are still in
the files, and it may stand in for them. Re-examination therefore withdraws each error alone, with all others
corrected, and compares all hypotheses again: the error stays, is replaced, or is dropped.

References: docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.stats import norm

from feeders.format.tables import FeederTables, write
from feeders.model.equipment import digest, find
from feeders.model.site import Site
from feeders.model.three_phase import ThreePhaseSite
from feeders.simulation.recording import Recording
from feeders.studies.calibrate.readings import Frames, blind, frames
from feeders.studies.calibrate.search import (
    LENGTH_SPREAD,
    PLACES,
    SHORTEST,
    Correction,
    CorrectionState,
    FileErrorKind,
    HypothesisComparison,
    Round,
    apply,
    as_filed,
    compare,
    concerned,
    correction,
    left,
    prepare,
)
from feeders.studies.running import Journal, Progress, Where
from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid, InputInvalid, Problem, raise_if_any
from gridsec.planning.calibration import explain, lengthened

__all__ = ["Calibrate", "OtherFeeder", "calibrate", "wrong_numbers"]


AS_FILED, PROPOSED, UNTOLD, EXCLUDED = "as in the files", "proposed", "cannot be told", "excluded"
UNASKED: Final = "not looked for"
UNREAD: Final = "phase not read"

WIDE: Final = 1.96  # half-width of intervals, in standard errors: 95 %
VAGUE: Final = 0.7  # ratio of posterior to prior std above which the readings give no information
ALIKE: Final = 0.98  # correlation from which on the effects of two lines count as equal
UNSURE_LENGTH: Final = 0.25  # standard error from which on a length is unknown

_SHOWN: Final = 5

_COLUMNS: Final = (
    *("kind", "what", "now", "proposed", "estimate", "std", "low", "high"),
    *("log_factor", "confidence", "verdict", "alternatives"),
)


def meters(now: Round, risk: float) -> pd.DataFrame:
    """Table of meters: bias of every meter."""
    at, site = now.given.where["bias"], now.net.site
    bias, std, prior = 100.0 * now.fit.estimate[at], 100.0 * now.fit.std[at], 100.0 * now.given.spread[at]
    count = now.series.seen.sum(axis=0)
    # A bias is relative to the busbar meter, which may have an error of the opposite sign.
    limit = 100.0 * (site.accuracy.class_fraction + site.accuracy.busbar_class)
    sure = norm.isf(risk / (2.0 * max(at.size, 1)))

    unread = blind(site, now.state.unread)

    def verdict(j: int) -> str:
        if site.meter_ids[j] in unread:
            return UNREAD
        if site.meter_ids[j] in now.state.excluded:
            return EXCLUDED
        if not count[j] or std[j] > VAGUE * prior[j]:
            return UNTOLD
        if abs(bias[j]) > limit[j] + sure * std[j]:
            return "outside its class"
        return "biased" if abs(bias[j]) > sure * std[j] else "within error"

    return pd.DataFrame(
        {
            "meter": site.meter_ids,
            "customer": [site.feeder.customers[k] for k in site.meters],
            "frames": count,
            "bias_percent": bias,
            "std_percent": std,
            "low_percent": bias - WIDE * std,
            "high_percent": bias + WIDE * std,
            "verdict": [verdict(j) for j in range(at.size)],
        }
    )


def line_table(
    now: Round, tolerance: float, kinds: Collection[FileErrorKind]
) -> tuple[pd.DataFrame, list[tuple[str, ...]]]:
    """Table of lines: length of each line, or lines in series, alone; and the ids of each row's lines."""
    net, rows = now.net, now.state.tables.lines
    names = [tuple(rows[k].line for k in chain) for chain in net.lines]
    free = np.array([any(name in now.state.lengths for name in chain) for chain in names])
    effect = np.where(now.series.seen[:, :, None], lengthened(net.places, now.series), 0.0)
    z = now.whiten(effect).reshape(-1, len(names))
    own = np.where(free, LENGTH_SPREAD, tolerance)
    shift, std, same = explain(now.fit, z, own, ALIKE)
    base = np.array([now.state.lengths.get(chain[0], 1.0) for chain in names])
    factor, std = base * (1.0 + shift), base * std
    unknown = ~(std < UNSURE_LENGTH)
    right = AS_FILED if FileErrorKind.LENGTH in kinds else UNASKED
    shown = [" ".join(chain[:1] if len(chain) == 1 else (chain[0], "to", chain[-1])) for chain in names]
    frame = pd.DataFrame(
        {
            "lines": shown,
            "from_bus": [net.feeder.buses[k] for k in net.ends[:, 0]],
            "to_bus": [net.feeder.buses[k] for k in net.ends[:, 1]],
            "factor": np.where(unknown, np.nan, factor),
            "std": np.where(unknown, np.nan, std),
            "low": np.where(unknown, 0.0, factor - WIDE * std),
            "high": np.where(unknown, np.inf, factor + WIDE * std),
            "same": [
                _some([shown[k] for k in np.flatnonzero(row) if k != own_row])
                for own_row, row in enumerate(same)
            ],
            "verdict": np.where(unknown, UNTOLD, np.where(free, PROPOSED, right)),
        }
    )
    return frame, names


def final(
    found: Sequence[dict[str, Any]],
    wrongs: Sequence[Correction],
    length: pd.DataFrame,
    ids: Sequence[tuple[str, ...]],
) -> tuple[pd.DataFrame, tuple[Correction, ...]]:
    """Table of proposals, with the last estimates of lengths, and the decided corrections."""
    rows = zip(length.to_dict("records"), ids, strict=True)
    by_line = {name: row for row, chain in rows for name in chain}
    vague = {
        name
        for row, wrong in zip(found, wrongs, strict=True)
        if row["alternatives"] and wrong.kind in PLACES
        for name in wrong.names
    }
    out, sure, told_of = [], [], set[tuple[str, ...]]()
    for row, first in zip(found, wrongs, strict=True):
        wrong = first
        if wrong.kind is FileErrorKind.LENGTH:
            if wrong.names in told_of:
                continue
            told_of.add(wrong.names)
            last = by_line[wrong.names[0]]
            known = last["verdict"] != UNTOLD
            factor = float(last["factor"]) if known else wrong.factor
            wrong = Correction(wrong.kind, wrong.names, factor=factor)
            numbers = {name: float(last[name]) for name in ("std", "low", "high")} | {"estimate": factor}
        else:
            estimate, std = row["estimate"], row["std"]
            numbers = {
                "estimate": estimate,
                "std": std,
                "low": estimate - WIDE * std,
                "high": estimate + WIDE * std,
            }
        decided = not row["alternatives"] and wrong.factor >= SHORTEST
        # A customer's bus and phases belong together: neither is written without the other.
        decided &= wrong.kind not in PLACES or vague.isdisjoint(wrong.names)
        verdict = EXCLUDED if wrong.kind is FileErrorKind.METER else PROPOSED if decided else UNTOLD
        if decided and wrong.kind is not FileErrorKind.METER:
            sure.append(wrong)
        out.append(
            {
                "kind": str(wrong.kind),
                "what": _who(wrong) if wrong.kind is not FileErrorKind.LENGTH else " ".join(wrong.names),
                "now": row["now"],
                "proposed": _proposed(wrong, row),
                **{name: numbers[name] for name in ("estimate", "std", "low", "high")},
                "log_factor": row["log_factor"],
                "confidence": row["confidence"],
                "verdict": verdict,
                "alternatives": _some(row["alternatives"]),
            }
        )
    return pd.DataFrame(out, columns=list(_COLUMNS)), tuple(sure)


def _proposed(wrong: Correction, row: dict[str, Any]) -> str:
    if wrong.kind is FileErrorKind.METER:
        when = pd.to_datetime([row["since"], row["until"]], unit="s", utc=True).strftime("%Y-%m-%d %H:%M")
        return f"another error from {when[0]} to {when[1]} UTC"
    if wrong.kind is FileErrorKind.LENGTH:
        return f"{wrong.factor:.3g} times as long"
    if wrong.exchange:
        return "phases exchanged"
    return {FileErrorKind.BUS: wrong.bus, FileErrorKind.PHASE: wrong.phases}.get(
        wrong.kind, "meters exchanged"
    )


def _who(wrong: Correction) -> str:
    """Subject of an error; for a lateral its first line and its customers."""
    if wrong.exchange:
        on, lines_on = wrong.on
        parts = []
        for phase in dict.fromkeys(on.values()):
            names = _some([name for name, own in on.items() if own == phase])
            first = next((line for line, own in lines_on.items() if own == phase), "")
            parts.append(f"{first} with {names}" if first else names)
        return " and ".join(parts)
    if wrong.lines:
        return f"{wrong.lines[0]} with {_some(wrong.names)}"
    return " and ".join(wrong.names[:2])


def present(tables: FeederTables, wrong: Correction) -> str:
    """Present content of the files for an error."""
    rows = {row.customer: row for row in tables.customers}
    if wrong.kind is FileErrorKind.BUS:
        return rows[wrong.names[0]].bus
    if wrong.exchange:
        first = {phases: name for name, phases in reversed(wrong.on[0].items())}
        return " and ".join(rows[first[phases]].phases for phases in dict.fromkeys(wrong.on[0].values()))
    if wrong.lines:
        return next(row.phases for row in tables.lines if row.line == wrong.lines[0])
    if wrong.kind is FileErrorKind.PHASE:
        return rows[wrong.names[0]].phases
    if wrong.kind is FileErrorKind.SWAP:
        return " and ".join(rows[name].meter for name in wrong.names)
    return ""


def described(wrong: Correction) -> str:
    """Short description of an alternative."""
    subject = _who(wrong)
    if wrong.kind is FileErrorKind.BUS:
        return f"{subject} at {wrong.bus}"
    if wrong.exchange:
        return f"{subject} with exchanged phases"
    if wrong.kind is FileErrorKind.PHASE:
        return f"{subject} on {wrong.phases}"
    return {FileErrorKind.SWAP: f"{subject} swapped", FileErrorKind.LENGTH: f"length of {subject}"}.get(
        wrong.kind, f"error of {subject} changes"
    )


def customers(
    now: Round,
    said: HypothesisComparison,
    wrongs: Sequence[Correction],
    risk: float,
    kinds: Collection[FileErrorKind],
) -> pd.DataFrame:
    """Table of customers: place of every customer, and alternatives that the readings do not exclude."""
    net, right = now.net, _as_filed(now.state.tables, kinds)
    moved = {name for wrong in wrongs if wrong.kind in (*PLACES, FileErrorKind.SWAP) for name in wrong.names}
    excluded = {*now.state.excluded}.difference(blind(net.site, now.state.unread))
    open_from = -float(np.log(1.0 / risk))
    others: dict[int, list[tuple[float, str]]] = {}
    for guess, factor in zip(said.guesses, said.found.log_factor, strict=True):
        for customer in concerned(now, guess) if guess.kind in PLACES else ():
            stays = guess.lateral or guess.exchange
            bus = net.feeder.buses[net.feeder.bus[customer] if stays else guess.other]
            on = guess.phases
            if guess.exchange:
                on = guess.phases[customer not in net.parts[guess.subject].customers]
            place = f"{bus} {on}" if guess.kind is FileErrorKind.PHASE else bus
            others.setdefault(customer, []).append((float(factor), place))
    out = []
    for k, row in enumerate(now.state.tables.customers):
        ranked = sorted(others.get(k, []), reverse=True)
        possible = [place for factor, place in ranked if factor > open_from]
        untold = possible or (not ranked and right != UNASKED)
        verdict = UNTOLD if untold else PROPOSED if row.customer in moved else right
        out.append(
            {
                "customer": row.customer,
                "meter": row.meter,
                "bus": row.bus,
                "phases": row.phases,
                "alternative": ranked[0][1] if ranked else "",
                "log_factor": ranked[0][0] if ranked else np.nan,
                "open": _some(possible),
                "verdict": EXCLUDED if row.meter in excluded else verdict,
            }
        )
    return pd.DataFrame(out)


def _as_filed(tables: FeederTables, kinds: Collection[FileErrorKind]) -> str:
    """Verdict on a place without evidence against it; kinds that were not searched are named."""
    possible = PLACES if tables.in_phases else (FileErrorKind.BUS,)
    missing = [kind for kind in possible if kind not in kinds]
    if len(missing) == len(possible):
        return UNASKED
    return f"{AS_FILED}; {missing[0]} {UNASKED}" if missing else AS_FILED


def loads(now: Round) -> pd.DataFrame:
    """Table of loads: power factor of every load without metered q, and gain of its register of p."""
    model, given, found = now.net.site.loads, now.given, now.fit
    at, gain = given.where["tan"], given.where["p_gain"]
    middle = 0.5 * (model.tan_min + model.tan_max)
    tan, std, prior = middle + found.estimate[at], found.std[at], given.spread[at]

    def factor(value: Floats) -> Floats:
        return np.asarray(np.cos(np.arctan(np.maximum(value, 0.0))))

    metered = prior == 0.0
    learned = np.where(metered, "q is metered", np.where(std > VAGUE * prior, UNTOLD, "learned"))
    hide = np.where(metered, np.nan, 1.0)
    return pd.DataFrame(
        {
            "customer": now.net.site.feeder.customers,
            "power_factor": factor(tan) * hide,
            "low": factor(tan + WIDE * std) * hide,
            "high": factor(tan - WIDE * std) * hide,
            "p_gain_percent": 100.0 * found.estimate[gain],
            "p_gain_std_percent": 100.0 * found.std[gain],
            "verdict": learned,
        }
    )


def errors(now: Round) -> pd.DataFrame:
    """Table of errors: sizes and correlation time of the errors of the customers' powers."""
    noise, base = now.noise, now.net.site.feeder.base_kva
    named = (
        ("error of p", noise.p * base, "kW"),
        ("error of q", noise.q * base, "kvar"),
        ("correlation time", noise.time_s, "s"),
        ("noise of meters", noise.white, "of that of the files"),
    )
    return pd.DataFrame(
        [
            {
                "quantity": name,
                "estimate": value,
                "low": value * np.exp(-WIDE * std),
                "high": value * np.exp(WIDE * std),
                "unit": unit,
                "verdict": "learned" if std < VAGUE else UNTOLD,
            }
            for (name, value, unit), std in zip(named, noise.std.tolist(), strict=True)
        ]
    )


def _some(items: Sequence[str]) -> str:
    tail = f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""
    return ", ".join(items[:_SHOWN]) + tail


MOST_ERRORS: Final = 24  # largest number of errors; with more, the files are those of another feeder
MOST_REVISIONS: Final = 3  # largest number of re-examinations of all errors; most searches need one

Row = dict[str, Any]  # one error in plain JSON types, for the journal


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Result of a search."""

    now: Round  # the files with all errors corrected, fitted
    said: HypothesisComparison  # comparison of all further hypotheses for these files
    rows: list[Row]  # the errors, in the order of their corrections


class FileErrorSearch:
    """Search for the errors of a feeder's files; an interrupted search resumes from its journal.

    `fitted` fits files under the assumption that they are correct; `weighed` compares all hypotheses for such
    a fit. `risk` is the probability of any proposal for correct files.
    """

    def __init__(
        self,
        files: CorrectionState,
        fitted: Callable[[CorrectionState], Round],
        weighed: Callable[[Round], HypothesisComparison],
        risk: float,
        kept: Journal,
    ) -> None:
        self._files = files
        self._fitted = fitted
        self._weighed = weighed
        self._risk = risk
        self._kept = kept
        self._steps = 0

    def run(self) -> SearchResult:
        """Forward steps and re-examinations until neither changes anything."""
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

    def _after(self, rows: Sequence[Row]) -> CorrectionState:
        """Files with these errors corrected."""
        state = self._files
        for row in rows:
            state = state.after(read(row["correction"]))
        return state

    def _step(self, state: CorrectionState) -> tuple[Round, Callable[[], HypothesisComparison], Row | None]:
        """Fit, comparison, and the error that the readings support most; None without one."""
        now = self._fitted(state)
        said: list[HypothesisComparison] = []

        def verdict() -> HypothesisComparison:
            if not said:
                said.append(self._weighed(now))
            return said[0]

        row = self._kept.get(
            f"error {self._steps}", lambda: _best(now, verdict(), self._risk, self._files.tables)
        )
        self._steps += 1
        return now, verdict, row

    def _forward(self, state: CorrectionState, rows: list[Row]) -> tuple[SearchResult, bool]:
        """Forward steps; False if the search returns to earlier files."""
        been, settled = [self._files, state], True
        for step in range(MOST_ERRORS + 1):
            now, verdict, row = self._step(state)
            if row is None or step == MOST_ERRORS:
                break
            wrong = read(row["correction"])
            if wrong.kind is FileErrorKind.METER:
                # All errors so far may rest on this meter's readings: the search restarts without it.
                meters = [each for each in rows if each["correction"]["kind"] == FileErrorKind.METER]
                rows = [*meters, row]
                state = self._after(rows)
            elif any(state.after(wrong).same(before) for before in been):
                # The readings support each of two places under the assumption of the other one.
                rows, settled = [_doubted(each, wrong) for each in rows], False
                break
            else:
                state = state.after(wrong)
                rows = _together(rows, row, self._files.tables, now.net.site.bus_of_file)
            been.append(state)
        return SearchResult(now, verdict(), rows), settled

    def _revised(self, rows: list[Row]) -> list[Row]:
        """Errors after a new comparison of each, with all others corrected."""
        for row in rows:
            wrong = read(row["correction"])
            alone = [each for each in rows if _same_subject(read(each["correction"]), wrong)]
            rest = [each for each in rows if each not in alone]
            if (
                row not in rows
                or wrong.kind is FileErrorKind.METER
                or all(each["correction"]["kind"] == FileErrorKind.METER for each in rest)
                or _chained(wrong, rest)
            ):
                continue
            try:
                now, _, again = self._step(self._after(rest))
            except FeederInvalid:
                continue  # A bus and a phase that require each other cannot be withdrawn alone.
            if again is None:
                rows = rest
            elif again["correction"]["kind"] != FileErrorKind.METER:
                rows = _together(rest, again, self._files.tables, now.net.site.bus_of_file)
        return rows


def _same_subject(one: Correction, other: Correction) -> bool:
    """True for equal errors, and for lengths of the same lines, which are found in several steps."""
    return one == other or (one.kind is other.kind is FileErrorKind.LENGTH and one.names == other.names)


def _chained(wrong: Correction, rest: Sequence[Row]) -> bool:
    """True for an exchange of meters relative to another one: it cannot be withdrawn alone."""
    others = [read(row["correction"]) for row in rest]
    return wrong.kind is FileErrorKind.SWAP and any(
        other.kind is FileErrorKind.SWAP and set(other.names) & set(wrong.names) for other in others
    )


def _together(found: list[Row], row: Row, files: FeederTables, bus_of_file: Mapping[str, int]) -> list[Row]:
    """Combine errors without contradictions: for a customer's place the last one is valid.

    Its gain includes that of the replaced errors. A correction that restores the files is dropped.
    """
    wrong, gain, rest = read(row["correction"]), row["log_factor"], []
    for each in found:
        earlier = read(each["correction"])
        kept = left(earlier, wrong)
        if kept is None:
            gain += each["log_factor"]
        else:
            changed = {"correction": asdict(kept), "now": present(files, kept)}
            rest.append(each if kept == earlier else each | changed)
    return rest if as_filed(files, wrong, bus_of_file) else [*rest, row | {"log_factor": gain}]


def _doubted(row: Row, wrong: Correction) -> Row:
    """Add an alternative to an error of the same kind and names."""
    told = read(row["correction"])
    if (told.kind, told.names) != (wrong.kind, wrong.names):
        return row
    return row | {"alternatives": [*row["alternatives"], described(wrong)]}


def _best(now: Round, said: HypothesisComparison, risk: float, files: FeederTables) -> Row | None:
    """Error that the readings support most; None without sufficient evidence."""
    if said.any < math.log(1.0 / risk):
        return None
    best = int(said.kept[0])
    guess, g, h = said.guesses[best], float(said.found.g[best]), float(said.found.h[best])
    shift = g / (h + LENGTH_SPREAD**-2) if guess.kind is FileErrorKind.LENGTH else 0.0
    wrong = correction(now, guess, max(1.0 + shift, SHORTEST))
    others = [correction(now, said.guesses[k]) for k in said.kept[1:]]
    if wrong.kind is FileErrorKind.PHASE and not guess.exchange:
        # A single part may be on a phase without a voltage of the busbar.
        others += [replace(wrong, phases=phase) for phase in now.state.unread]
    return {
        "correction": asdict(wrong),
        "estimate": g / h if h > 0.0 else 0.0,
        "std": h**-0.5 if h > 0.0 else math.inf,
        "log_factor": float(said.found.log_factor[best]),
        "confidence": float(said.confidence[best]),
        # Swaps build on each other; a place is compared with that in the files.
        "now": present(now.state.tables if wrong.kind is FileErrorKind.SWAP else files, wrong),
        "since": guess.since,
        "until": guess.until,
        "alternatives": [described(other) for other in others],
    }


def read(row: Row) -> Correction:
    """Correction from the plain types of the journal."""
    tuples = {name: tuple(row[name]) for name in ("names", "lines")}
    return Correction(**row | tuples | {"kind": FileErrorKind(row["kind"])})


class OtherFeeder(InputInvalid):
    """A folder holds another feeder than the studied one."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibrate:
    """Result of `calibrate`."""

    feeder: str
    digest: str
    frames: int  # number of frames
    span_h: float
    risk: float  # probability of any proposal for correct files
    # one row for each meter: `meter`, `customer`, `frames` (readings used), `bias_percent`, `std_percent`,
    # `low_percent`, `high_percent` (95 %; of the voltage, relative to the busbar meter: a common error of all
    # meters cannot be determined), `verdict`
    meters: pd.DataFrame
    # one row for each line, or lines in series: `lines`, `from_bus`, `to_bus`, `factor`, `std`, `low`, `high`
    # (of the length in the files, if all others are correct), `same` (lines with the same effect), `verdict`
    lines: pd.DataFrame
    # one row for each customer: `customer`, `meter`, `bus`, `phases` (as corrected), `alternative` (the best
    # other place), `log_factor` (of it against this one), `open` (places that are not excluded), `verdict`
    customers: pd.DataFrame
    # one row for each customer: `customer`, `power_factor`, `low`, `high`, `p_gain_percent`,
    # `p_gain_std_percent`, `verdict`
    loads: pd.DataFrame
    # `quantity`, `estimate`, `low`, `high`, `unit`, `verdict`: standard deviations and correlation time of
    # the errors of the customers' powers, and the meters' noise relative to the files
    errors: pd.DataFrame
    # proposals in the order of the search: `kind`, `what` (for a lateral its first line and its customers),
    # `now`, `proposed`, `estimate`, `std` (of a length, the factor; otherwise the share of the proposed
    # change in the readings: 1 is all), `low`, `high`, `log_factor` (gain of the log-likelihood),
    # `confidence`, `verdict`, `alternatives`
    proposals: pd.DataFrame
    corrections: tuple[Correction, ...]  # decided proposals, as corrections of the files
    unread: str = ""  # phases without a voltage of the busbar; the meters on them are left out

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name."""
        names = ("proposals", "meters", "lines", "customers", "loads", "errors")
        return {name: getattr(self, name) for name in names}

    def corrected(self, site_folder: Path | str, out: Path | str) -> None:
        """Write a copy of the studied feeder with the decided corrections to a new or empty folder.

        Raises OtherFeeder if it is not the studied feeder; FileExistsError if the folder is not empty;
            FeederInvalid, OSError if the feeder cannot be read or written.
        """
        tables, target = find(site_folder), Path(out)
        if digest(tables) != self.digest:
            text = f"{site_folder}: not the studied feeder, or changed since"
            raise OtherFeeder([Problem("other-origin", text)])
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise FileExistsError(f"{target}: is not empty; expected a new folder")
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
    kinds: Sequence[FileErrorKind] = tuple(FileErrorKind),
    journal: Where = None,
    progress: Progress | None = None,
) -> Calibrate:
    """Compare recorded readings with a feeder's files.

    The feeder is balanced (with loops or without) or of three phases. The readings are a recording, a table
    with its columns, or a Parquet or CSV file.

    risk: probability of any proposal for correct files, 0 to 1.
    tolerance: relative error (1 sigma) of lines' lengths that counts as correct.
    exclude: meters with voltages that are not used; their powers are used.
    kinds: kinds of errors to search; fewer take less time, and an error of another kind may pass for one of
        these.
    progress: called with (done, total) of the present comparison.
    Raises RecordingInvalid for readings of another feeder or of unknown meters, without the busbar, in other
        units than V, kW and kvar, or too few; ValueError for an unknown meter, or a number out of range;
        FeederInvalid if closed lines form loops in three phases; OtherStudy, InUse as
        `feeders.studies.running.Journal`.
    """
    problems = wrong_numbers(risk, tolerance)
    if unknown := sorted(set(exclude) - set(site.meter_ids)):
        problems.append(Problem("unknown-name", f"{site.feeder.name} has no meter {', '.join(unknown)}"))
    raise_if_any(problems)
    given = frames(site, readings, exclude=exclude)
    subject = _subject(site, given, risk, tolerance) | {"exclude": sorted(exclude), "kinds": sorted(kinds)}

    def weighed(now: Round) -> HypothesisComparison:
        return compare(now, given, risk, progress or (lambda *_: None), kinds)

    def fitted(state: CorrectionState) -> Round:
        return prepare(state, given, tolerance=tolerance, errors=True)

    unread = given.unread if site.tables.in_phases else ""
    files = CorrectionState(site.tables, (*exclude, *blind(site, unread)), unread=unread)
    with Journal(journal, subject) as kept:
        found = FileErrorSearch(files, fitted, weighed, risk, kept).run()
    now = found.now
    lines, ids = line_table(now, tolerance, kinds)
    wrongs = [read(row["correction"]) for row in found.rows]
    rows, sure = final(found.rows, wrongs, lines, ids)
    return Calibrate(
        feeder=site.feeder.name,
        digest=site.digest,
        frames=given.t.size,
        span_h=float(given.t[-1] - given.t[0]) / 3600.0,
        risk=risk,
        meters=meters(now, risk),
        lines=lines,
        customers=customers(now, found.said, wrongs, risk, kinds),
        loads=loads(now),
        errors=errors(now),
        proposals=rows,
        corrections=sure,
        unread=unread,
    )


def wrong_numbers(risk: float, tolerance: float) -> list[Problem]:
    """Problems of the numbers of a calibration."""
    ranges = (("risk", risk, 1), ("tolerance", tolerance, LENGTH_SPREAD))
    return [
        Problem("out-of-range", f"{name} is {value}; it must be between 0 and {most}")
        for name, value, most in ranges
        if not 0.0 < value < most
    ]


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

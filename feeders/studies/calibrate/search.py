"""Search for single errors of a feeder's files that recorded readings support, and their corrections.

References: docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from itertools import combinations
from typing import Any, Final

import numpy as np

from feeders.format.columns import MATRIX_NAMES, PHASE_NAMES
from feeders.format.tables import FeederTables, LineRow
from feeders.studies.calibrate import feeder as model
from feeders.studies.calibrate.feeder import CustomerPowers, Lateral, MergedNetwork
from feeders.studies.calibrate.readings import Frames
from gridsec.arrays import Floats, Ints
from gridsec.grid.three_phase import PHASES, ThreePhaseFeeder
from gridsec.planning.calibration import (
    HypothesisEvidence,
    LoadErrors,
    RegressionFit,
    Regressors,
    Series,
    Whitening,
    evidence,
    fit,
    increments,
    learn,
    lengthened,
    regressors,
    steps,
    weigh,
    whitening,
)

__all__ = [
    "PLACES",
    "Correction",
    "CorrectionState",
    "FileErrorKind",
    "Guess",
    "HypothesisComparison",
    "Round",
    "apply",
    "as_filed",
    "compare",
    "concerned",
    "correction",
    "left",
    "longer",
    "prepare",
]


class FileErrorKind(StrEnum):
    """Kinds of errors of the files."""

    BUS = "bus"
    PHASE = "phase"
    SWAP = "swap"
    LENGTH = "length"
    METER = "meter"


PLACES: Final = (FileErrorKind.BUS, FileErrorKind.PHASE)  # a customer has at most one of each


@dataclass(frozen=True, slots=True)
class Correction:
    """Error of the files in terms of their ids."""

    kind: FileErrorKind
    # the customer, both customers of a swap, the meter, or the lines; all customers of a lateral
    names: tuple[str, ...]
    # bus, phases: Correct place of the customer. In an exchange `phases` has one letter for each name and
    # then for each line; otherwise the phases of all of them.
    bus: str = ""
    phases: str = ""
    factor: float = 1.0  # factor on the lines' length
    # the lines of a single-phase lateral that is on these phases with all its customers, the first line
    # first; none for a single customer
    lines: tuple[str, ...] = ()

    @property
    def exchange(self) -> bool:
        """True for an exchange of the phases of two customers or laterals: each has a letter of its own."""
        return self.kind is FileErrorKind.PHASE and len(self.phases) > 1

    @property
    def on(self) -> tuple[dict[str, str], dict[str, str]]:
        """Phases of each name and of each line, for a correction of phases."""
        n = len(self.names)
        each = self.phases if self.exchange else (self.phases,) * (n + len(self.lines))
        return dict(zip(self.names, each, strict=False)), dict(zip(self.lines, each[n:], strict=True))


def apply(tables: FeederTables, wrong: Correction) -> FeederTables:
    """Correct an error of the files; that of a meter changes no file."""
    if wrong.kind is FileErrorKind.METER:
        return tables
    if wrong.kind is FileErrorKind.LENGTH:
        rows = (longer(row, wrong.factor) if row.line in wrong.names else row for row in tables.lines)
        return replace(tables, lines=tuple(rows))
    customers = {row.customer: row for row in tables.customers}
    if wrong.kind is FileErrorKind.PHASE:
        on, lines_on = wrong.on
        customers |= {name: replace(customers[name], phases=phases) for name, phases in on.items()}
        lines = (_on(row, lines_on[row.line]) if row.line in lines_on else row for row in tables.lines)
        return replace(tables, lines=tuple(lines), customers=tuple(customers.values()))
    one = customers[wrong.names[0]]
    if wrong.kind is FileErrorKind.SWAP:
        other = customers[wrong.names[1]]
        changed = [replace(one, meter=other.meter), replace(other, meter=one.meter)]
    else:
        changed = [replace(one, bus=wrong.bus)]
    customers |= {row.customer: row for row in changed}
    return replace(tables, customers=tuple(customers.values()))


def longer(line: LineRow, factor: float) -> LineRow:
    """Line of `factor` times the length."""
    scaled: dict[str, Any] = {
        name: None if (value := getattr(line, name)) is None else value * factor
        for name in ("r_ohm", "x_ohm", "r0_ohm", "x0_ohm", "b_us", *MATRIX_NAMES)
    }
    return replace(line, **scaled)


def _on(line: LineRow, phase: str) -> LineRow:
    """Single-phase line on another phase, with its columns."""
    own = {name: name.split("_") for name in PHASE_NAMES}
    cells: dict[str, Any] = {name: None for name, parts in own.items() if set(parts[1]) == {line.phases}}
    there = {
        "_".join((symbol, phase * len(letters), *unit)): getattr(line, name)
        for name, (symbol, letters, *unit) in own.items()
        if name in cells
    }
    return replace(line, phases=phase, **(cells | there))


def left(earlier: Correction, later: Correction) -> Correction | None:
    """Part of an earlier correction that a later one leaves; None without any.

    For a customer's place the later one is valid.
    """
    if later.kind is FileErrorKind.BUS and set(earlier.names) <= set(later.names) and earlier.lines:
        # No customer remains on the lateral to confirm the phase of its lines.
        return _of_phases(earlier, earlier.on[0], {})
    if earlier.kind is not later.kind or later.kind not in PLACES:
        return earlier
    on, lines_on = earlier.on
    on = {name: phases for name, phases in on.items() if name not in later.names}
    lines_on = {name: phases for name, phases in lines_on.items() if name not in later.lines}
    return _of_phases(earlier, on, lines_on) if on else None


def _of_phases(earlier: Correction, on: dict[str, str], lines_on: dict[str, str]) -> Correction:
    """Correction of these names and lines only."""
    phases = earlier.phases
    if earlier.exchange:
        phases = "".join((*on.values(), *lines_on.values()))
        phases = phases if len(set(phases)) > 1 else phases[:1]
    return replace(earlier, names=tuple(on), lines=tuple(lines_on), phases=phases)


def as_filed(tables: FeederTables, wrong: Correction, bus_of_file: Mapping[str, int]) -> bool:
    """True if the files agree with a correction of a customer's place already.

    `bus_of_file` is the bus of the model of each bus of the files.
    """
    rows = {row.customer: row for row in tables.customers}
    if wrong.kind is FileErrorKind.BUS:
        return all(bus_of_file[rows[name].bus] == bus_of_file[wrong.bus] for name in wrong.names)
    if wrong.kind is not FileErrorKind.PHASE:
        return False
    lines = {row.line: row for row in tables.lines}
    on, lines_on = wrong.on
    here = all(rows[name].phases == phases for name, phases in on.items())
    return here and all(lines[name].phases == phases for name, phases in lines_on.items())


LENGTH_SPREAD: Final = 0.3  # prior standard deviation of the relative error of a wrong length
CHANGE_SPREAD: Final = 0.005  # prior standard deviation of a change of a meter's relative error
SHORTEST: Final = 0.05  # smallest factor on a line's length
LIE_SPREAD: Final = 0.05  # prior std of a constant relative error beyond that of the class
PIECES: Final = 8  # number of time intervals with possibly different errors of a meter

_CHUNK: Final = 128
_REFIT: Final = 3
_NOISE_ROUNDS: Final = 2


@dataclass(frozen=True, slots=True)
class Guess:
    """Hypothesis of an error of the files."""

    kind: FileErrorKind
    # Customer, first customer of a swap, meter, or branch, by index in the present network. For an exchange
    # of phases the first part, by index into `MergedNetwork.parts`.
    subject: int
    # Second customer, bus of the merged tree, or lateral; -1 for none. For an exchange the second part.
    other: int = -1
    phases: str = ""  # phases of the customer; for an exchange those of both parts, one letter each
    lateral: bool = False  # True: `other` is a lateral, which is on these phases with all its customers
    exchange: bool = False  # True: two customers or laterals have each other's phase
    # since, until: time interval of the meter's different error, Unix s
    since: float = np.nan
    until: float = np.nan


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionState:
    """Files with all corrections so far, and excluded meters."""

    tables: FeederTables
    excluded: tuple[str, ...] = ()  # meters with changing errors, or excluded by the caller
    lengths: dict[str, float] = field(default_factory=dict)  # factor on each corrected length
    unread: str = ""  # phases without a voltage of the busbar; their meters are excluded

    def same(self, other: CorrectionState) -> bool:
        """True for equal files and excluded meters."""
        mine, others = ((each.tables.lines, each.tables.customers, each.excluded) for each in (self, other))
        return mine == others

    def after(self, wrong: Correction) -> CorrectionState:
        """Correct one more error."""
        if wrong.kind is FileErrorKind.METER:
            return replace(self, excluded=(*self.excluded, *wrong.names))
        lengths = dict(self.lengths)
        if wrong.kind is FileErrorKind.LENGTH:
            lengths |= {name: lengths.get(name, 1.0) * wrong.factor for name in wrong.names}
        return replace(self, tables=apply(self.tables, wrong), lengths=lengths)


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """Model, fit and readings for the files with all corrections so far."""

    state: CorrectionState
    net: MergedNetwork
    drawn: CustomerPowers
    series: Series
    noise: LoadErrors
    whiten: Whitening
    given: Regressors
    fit: RegressionFit
    readings: Floats


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisComparison:
    """Comparison of all hypotheses."""

    guesses: list[Guess]
    found: HypothesisEvidence  # evidence of the readings for each
    confidence: Floats  # (H,) see `gridsec.planning.calibration.Weighed`
    any: float  # logarithm of the mean Bayes factor
    kept: Ints  # (k,) hypotheses that cannot be distinguished, best first


def prepare(state: CorrectionState, frames: Frames, *, tolerance: float, errors: bool = False) -> Round:
    """Fit meters, loads and lines under the assumption of correct files.

    `tolerance` is the relative error of a length that counts as correct, 1 sigma. With `errors` the load
    errors' parameters have standard errors.
    """
    net = model.network(state.tables)
    drawn = model.powers(net.site, frames)
    series = model.series(net, frames, drawn, state.excluded)
    free = [
        k
        for k, chain in enumerate(net.lines)
        if any(state.tables.lines[row].line in state.lengths for row in chain)
    ]
    priors = model.doubts(net, drawn, tolerance, free, LENGTH_SPREAD)
    given = regressors(net.places, series, priors)
    used = np.flatnonzero(given.spread > 0.0)
    white, common = model.meter_noise(net, frames)
    own, gap = model.field(net, drawn), model.gaps(net, drawn)
    rest = series.residual(net.places)
    size = 0.02 * float(np.median(net.site.loads.load_peak[net.site.meters]))  # typical
    noise = LoadErrors(size, size, net.site.tables.meta.load.correlation_s, 1.0, np.full(4, np.nan))
    shared = np.einsum("tjf,tkf->jk", common, common) / len(common)
    guess, left = noise, rest
    for turn in range(_NOISE_ROUNDS):
        last = errors and turn == _NOISE_ROUNDS - 1
        products = increments(series.t, series.seen, left)
        noise = learn(products, own, white.mean(axis=0), shared, guess, errors=last, start=noise)
        S = noise.covariance(own)
        whiten = whitening(
            series.t,
            series.seen,
            S,
            time_s=noise.time_s,
            white=noise.white**2 * white,
            common=common,
            gaps=gap,
        )
        both = whiten(np.concatenate([given.columns[:, :, used], rest[:, :, None]], axis=2))
        flat = both.reshape(-1, used.size + 1)
        found = fit(flat[:, -1], flat[:, :-1], given.spread[used], int(series.seen.sum()))
        left = np.where(series.seen, rest - given.columns[:, :, used] @ found.estimate, 0.0)
    return Round(
        state, net, drawn, series, noise, whiten, given, _spread_out(found, used, given), flat[:, -1]
    )


def _spread_out(found: RegressionFit, used: Ints, given: Regressors) -> RegressionFit:
    """Fit with all coefficients, those with a prior of zero included."""
    estimate, std = np.zeros((2, given.spread.size))
    estimate[used], std[used] = found.estimate, found.std
    return replace(found, estimate=estimate, std=std)


def compare(
    now: Round,
    frames: Frames,
    risk: float,
    report_progress: Callable[[int, int], None],
    kinds: Collection[FileErrorKind] = tuple(FileErrorKind),
) -> HypothesisComparison:
    """Compare all hypotheses of an error of the files.

    `risk` is the probability of a proposal for files without errors; `report_progress` is called with (done,
    total).
    """
    guesses: list[Guess] = []
    parts: list[HypothesisEvidence] = []
    # Some kinds may have no hypothesis: phases on a balanced feeder, meters if all are excluded.
    chunks = [chunk for chunk in _chunks(now, kinds) if chunk[0]]
    for k, (some, make, spread) in enumerate(chunks):
        report_progress(k, len(chunks))
        z = now.whiten(make())
        parts.append(evidence(now.fit, z.reshape(-1, len(some)), np.full(len(some), spread)))
        guesses.extend(some)
    report_progress(len(chunks), len(chunks))
    names = ("g", "h", "log_factor")
    g, h, factor = (np.concatenate([np.empty(0), *(getattr(part, n) for part in parts)]) for n in names)
    kind = np.array([_family(guess) for guess in guesses], dtype=np.intp)
    exact = factor.copy()
    for k in _close(now, guesses, factor):
        exact[k] = _exactly(now, frames, guesses[k])
    weighed = weigh(exact, kind, risk)
    return HypothesisComparison(
        guesses, HypothesisEvidence(g, h, exact), weighed.confidence, weighed.any, weighed.kept
    )


def _family(guess: Guess) -> int:
    """Group of hypotheses with a common prior weight; exchanges of phases are a group of their own."""
    return len(FileErrorKind) if guess.exchange else list(FileErrorKind).index(guess.kind)


_MOVES: Final = (FileErrorKind.BUS, FileErrorKind.PHASE, FileErrorKind.SWAP)


def _close(now: Round, guesses: list[Guess], factor: Floats) -> list[int]:
    """Moves that are likely by the linear flow; for an excluded meter also the likeliest of its customer."""
    if not guesses:
        return []
    order = np.argsort(-factor).tolist()
    moves = [k for k in order if guesses[k].kind in _MOVES]
    likely = [k for k in moves[:_REFIT] if factor[k] > 0.0]
    best = guesses[order[0]]
    if best.kind is FileErrorKind.METER:
        customer = int(now.net.site.meters[best.subject])
        likely += [k for k in moves if customer in concerned(now, guesses[k])][:1]
    return list(dict.fromkeys(likely))


def concerned(now: Round, guess: Guess) -> list[int]:
    """Customers of a move."""
    if guess.lateral:
        return list(map(int, now.net.laterals[guess.other].customers))
    if guess.exchange:
        return [int(customer) for part in _sides(now.net, guess) for customer in part.customers]
    return [guess.subject, guess.other] if guess.kind is FileErrorKind.SWAP else [guess.subject]


def _sides(net: MergedNetwork, guess: Guess) -> tuple[Lateral, Lateral]:
    """Both parts of an exchange."""
    return net.parts[guess.subject], net.parts[guess.other]


Chunk = tuple[list[Guess], Callable[[], Floats], float]


def _chunks(now: Round, kinds: Collection[FileErrorKind]) -> Iterator[Chunk]:
    """Hypotheses of one kind, and a function that computes their effects, (T, p, H)."""
    net, series = now.net, now.series
    trusted = np.flatnonzero(series.seen.any(axis=0)).tolist()
    read = [phase for phase in PHASES if phase not in now.state.unread]
    moves: dict[FileErrorKind, Callable[[MergedNetwork, list[int]], list[Guess]]] = {
        FileErrorKind.BUS: _buses,
        FileErrorKind.PHASE: partial(_phases, read=read),
        FileErrorKind.SWAP: _swaps,
    }
    guesses = [guess for kind, made in moves.items() if kind in kinds for guess in made(net, trusted)]
    for first in range(0, len(guesses), _CHUNK):
        some = guesses[first : first + _CHUNK]
        yield some, partial(_moves, now, some), 0.0
    if FileErrorKind.LENGTH in kinds:
        lengths = [Guess(FileErrorKind.LENGTH, k) for k in range(len(net.lines))]
        yield lengths, partial(_seen, now, lengthened(net.places, series)), LENGTH_SPREAD
    for j in trusted if FileErrorKind.METER in kinds else ():
        columns, times = steps(series, j, PIECES)
        changes = [Guess(FileErrorKind.METER, j, since=since, until=until) for since, until in times]
        yield changes, partial(_seen, now, columns), CHANGE_SPREAD
    if FileErrorKind.METER in kinds:
        span = float(series.t[0]), float(series.t[-1])
        always = [Guess(FileErrorKind.METER, j, since=span[0], until=span[1]) for j in trusted]
        columns = now.given.columns[:, :, now.given.where["bias"][trusted]]
        yield always, partial(_seen, now, columns), LIE_SPREAD


def _buses(net: MergedNetwork, trusted: list[int]) -> list[Guess]:
    out = []
    rows = net.site.tables.customers
    for j in trusted:
        customer = int(net.site.meters[j])
        phases = rows[customer].phases
        out += [
            Guess(FileErrorKind.BUS, customer, bus, phases)
            for bus in range(len(net.feeder.buses))
            if bus != net.feeder.bus[customer] and net.reaches(bus, phases)
        ]
    return out


def _phases(net: MergedNetwork, trusted: list[int], read: Collection[str]) -> list[Guess]:
    out = []
    if isinstance(net.feeder, ThreePhaseFeeder):
        for j in trusted:
            customer = int(net.site.meters[j])
            bus, phases = int(net.feeder.bus[customer]), net.site.tables.customers[customer].phases
            if len(phases) == 1:
                others = [phase for phase in read if phase != phases and net.reaches(bus, phase)]
                out += [Guess(FileErrorKind.PHASE, customer, bus, phase) for phase in others]
        for k, lateral in enumerate(net.laterals):
            seen = np.intersect1d(net.site.meters[trusted], lateral.customers).tolist()
            others = [phase for phase in lateral.others if phase in read and seen]
            out += [Guess(FileErrorKind.PHASE, seen[0], k, phase, lateral=True) for phase in others]
        out += _exchanges(net, trusted)
    return out


def _exchanges(net: MergedNetwork, trusted: list[int]) -> list[Guess]:
    """Pairs of single-phase customers, or of laterals, with each other's phase in the files."""
    read = net.site.meters[trusted]
    asked = [k for k, part in enumerate(net.parts) if np.isin(part.customers, read).any()]
    pairs = ((a, b, net.parts[a], net.parts[b]) for a, b in combinations(asked, 2))
    return [
        Guess(FileErrorKind.PHASE, a, b, other.phase + one.phase, exchange=True)
        for a, b, one, other in pairs
        if other.phase in one.others and one.phase in other.others
    ]


def _swaps(net: MergedNetwork, trusted: list[int]) -> list[Guess]:
    W = net.places.weight
    customers = [int(net.site.meters[j]) for j in trusted]
    return [Guess(FileErrorKind.SWAP, a, b) for a, b in combinations(customers, 2) if (W[a] != W[b]).any()]


def _moves(now: Round, guesses: list[Guess]) -> Floats:
    net, series = now.net, now.series
    out = np.empty((*series.y.shape, len(guesses)))
    for h, guess in enumerate(guesses):
        if guess.lateral:
            out[:, :, h] = net.places.rephased(series, [net.laterals[guess.other].to(guess.phases)])
            continue
        if guess.exchange:
            both = zip(_sides(net, guess), guess.phases, strict=True)
            out[:, :, h] = net.places.rephased(series, [part.to(phase) for part, phase in both])
            continue
        if guess.kind is FileErrorKind.SWAP:
            W = net.places.weight
            change = {guess.subject: W[guess.other], guess.other: W[guess.subject]}
        else:
            change = {guess.subject: net.weight(guess.other, guess.phases)}
        out[:, :, h] = net.places.moved(series, change)
    return _seen(now, out)


def _seen(now: Round, columns: Floats) -> Floats:
    return np.where(now.series.seen[:, :, None], columns, 0.0)


def _exactly(now: Round, frames: Frames, guess: Guess) -> float:
    """Gain of the log-likelihood with the power flow of the corrected files."""
    after = model.network(apply(now.state.tables, correction(now, guess)))
    drawn = model.powers(after.site, frames)
    series = model.series(after, frames, drawn, now.state.excluded)
    # The meters of a swap have exchanged places; their readings are compared in the old order.
    order = [after.site.meter_ids.index(name) for name in now.net.site.meter_ids]
    rest = series.residual(after.places)[:, order] * (after.places.unit[order] / now.net.places.unit) ** 2
    z = now.readings - now.whiten(rest[:, :, None]).ravel()
    return float(evidence(now.fit, z[:, None], np.zeros(1)).log_factor[0])


def correction(now: Round, guess: Guess, factor: float = 1.0) -> Correction:
    """Hypothesis as a correction of the files; `factor` is that of a length."""
    net, tables = now.net, now.state.tables
    if guess.kind is FileErrorKind.METER:
        return Correction(guess.kind, (net.site.meter_ids[guess.subject],))
    if guess.kind is FileErrorKind.LENGTH:
        return Correction(
            guess.kind, tuple(tables.lines[k].line for k in net.lines[guess.subject]), factor=factor
        )
    if guess.lateral or guess.exchange:
        parts = _sides(net, guess) if guess.exchange else (net.laterals[guess.other],)
        names = [[tables.customers[k].customer for k in part.customers.tolist()] for part in parts]
        lines = [[tables.lines[k].line for k in part.lines] for part in parts]
        on = "".join(
            phase * len(some)
            for all_ in (names, lines)
            for some, phase in zip(all_, guess.phases, strict=True)
        )
        return Correction(
            guess.kind,
            tuple(name for some in names for name in some),
            phases=on if guess.exchange else guess.phases,
            lines=tuple(name for some in lines for name in some),
        )
    name = tables.customers[guess.subject].customer
    if guess.kind is FileErrorKind.SWAP:
        return Correction(guess.kind, (name, tables.customers[guess.other].customer))
    return Correction(guess.kind, (name,), net.feeder.buses[guess.other], guess.phases)

"""All estimator families side by side, on the same trials of one feeder.

Every family of `feeders.registry.registry.FAMILIES` watches the same frames: full AC power flow as truth,
meters as accurate as the feeder's files say, loads known up to a stated error. A family that cannot be
designed for the feeder, or that fails while it watches, keeps its rows, with the reason in them.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from feeders.registry.plugins import EstimatorUnusable
from feeders.registry.registry import FAMILIES, Watcher, choose, design
from feeders.simulation.attacks import Lie, NoSuchAttack, Trick
from feeders.simulation.demand import Variation
from feeders.simulation.trial import LoadError, Meters, Outcome, Trial, frames, judge
from feeders.studies.journal import Journal, Where
from feeders.util import replace_file
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, GridsecError, NotObservable, Problem, no_choice, refuse

if TYPE_CHECKING:
    from feeders.model.site import Site

__all__ = [
    "BEGIN",
    "CASES",
    "END",
    "FEEDER",
    "Case",
    "Plan",
    "Row",
    "compare",
    "markdown",
    "splice",
    "write_csv",
]

FEEDER: Final = "simbench-lv-rural1"

ONSET_S: Final = 60.0
"""When the lies begin, s after the start: what needs to settle has settled."""

BEGIN: Final = "<!-- comparison: begin -->"
END: Final = "<!-- comparison: end -->"

LIVELY: Final = Variation(tap_interval_s=300.0)
"""Loads and clouds as in every scenario; the transformer upstream may step every five minutes, so that runs
of minutes see what meters that repeat themselves would miss in hours."""


@dataclass(frozen=True, slots=True)
class Case:
    """One way to lie, or none.

    Attributes
    ----------
    name
        Short name.
    meaning
        What happens, for people; `{meters}` stands for how many lie.
    trick, size
        As in `feeders.simulation.attacks.Lie`; no trick: nobody lies.
    one
        Whether just one lies, however many the estimators are asked to withstand.
    """

    name: str
    meaning: str
    trick: Trick | None = None
    size: float = 0.0
    one: bool = False

    def told(self, count: int) -> str:
        """What happens when `count` may lie, as a phrase."""
        return self.meaning.format(meters=f"{count} meter" if count == 1 else f"{count} meters")

    def lie(self, count: int) -> Lie | None:
        """Who lies when `count` may."""
        if self.trick is None:
            return None
        return Lie(self.trick, 1 if self.one else count, self.size, ONSET_S)


CASES: Final = (
    Case("clean", "nobody lies"),
    Case("bias", "readings of {meters} at random are 3 % too high or too low", Trick.BIAS, 3.0),
    Case(
        "coordinated",
        "readings of {meters} show the trace of a load that is not there, at least 3 % deep",
        Trick.COORDINATED,
        3.0,
    ),
    Case(
        "coordinated-power",
        "the same, and the customer's meter reports the power of that load",
        Trick.COORDINATED_POWER,
        3.0,
    ),
    Case("drift", "readings of {meters} at random leave the truth by 1 % per minute", Trick.DRIFT, 1.0),
    Case("stuck", "readings of {meters} at random stay as at the onset", Trick.STUCK),
    Case("replay", "readings of {meters} at random are those of 10 minutes earlier", Trick.REPLAY, 600.0),
    Case(
        "inverter",
        "one inverter at random injects its rating beside what its droop curve says; all meters are honest",
        Trick.INVERTER,
        100.0,
        one=True,
    ),
)
"""What families are compared on."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is compared.

    Attributes
    ----------
    max_attacked
        M that designs are asked for, and how many meters lie.
    seeds
        How many runs of each case.
    duration_s, step_s
        Length of a run and interval of its frames, s.
    load_error, meters, variation, report_q
        As in `feeders.simulation.trial.Trial`.
    families, cases
        Names; all by default.
    workers
        Processes for designs by matrix inequality.

    Raises
    ------
    ValueError
        If there is no such family or case, or no run; names every problem.
    """

    max_attacked: int = 2
    seeds: int = 3
    duration_s: float = 480.0
    step_s: float = 1.0
    load_error: LoadError = field(default_factory=lambda: LoadError(0.1, 0.05))
    meters: Meters = Meters.SITE
    variation: Variation = LIVELY
    report_q: bool = False
    families: tuple[str, ...] = tuple(FAMILIES)
    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    workers: int = 1

    def __post_init__(self) -> None:
        """Refuse what would compare nothing."""
        refuse(
            [
                *no_choice("family", FAMILIES, *self.families),
                *no_choice("case", (case.name for case in CASES), *self.cases),
                *(
                    []
                    if self.seeds >= 1
                    else [Problem("not-positive", f"seeds is {self.seeds}; at least one run is needed")]
                ),
            ]
        )

    def trial(self, site: Site, case: Case, seed: int) -> Trial:
        """One run."""
        return Trial(
            site,
            seed=seed,
            duration_s=self.duration_s,
            step_s=self.step_s,
            load_error=self.load_error,
            meters=self.meters,
            variation=self.variation,
            report_q=self.report_q,
            lie=case.lie(self.max_attacked),
        )


@dataclass(frozen=True, slots=True)
class Row:
    """How one family did in one case, all seeds together. NaN: there is nothing to tell.

    Attributes
    ----------
    family, case
        Names.
    reason
        Why there are no numbers; empty where there are.
    liars, named, missed
        How many meters or inverters lied, were named while lying, and were not, summed over seeds.
    falsely_named
        How many honest meters and inverters were ever named, summed over seeds.
    false_share
        Share of ticks at which an honest meter was named, 1.
    delay_s
        Median time from onset to name of those named, s.
    error_liars, error_all
        95th percentile of the voltage's reconstruction error at lying meters and at all customers, % of
        nominal.
    step_ms, step_ms_95
        Median and 95th percentile of the processor time per step, ms.
    observers
        How many observers, or candidate sets, ran.
    false_clean
        Share of the ticks with a lie at which the answer was CLEAN, 1.
    undecided
        Share of all ticks at which it was UNDECIDED, 1.
    """

    family: str
    case: str
    reason: str = ""
    liars: int = 0
    named: int = 0
    missed: int = 0
    falsely_named: int = 0
    false_share: float = math.nan
    delay_s: float = math.nan
    error_liars: float = math.nan
    error_all: float = math.nan
    step_ms: float = math.nan
    step_ms_95: float = math.nan
    observers: int = 0
    false_clean: float = math.nan
    undecided: float = math.nan


def compare(
    site: Site, plan: Plan, *, journal: Where = None, progress: Callable[[str], None] | None = None
) -> list[Row]:
    """Let all families watch all cases.

    Parameters
    ----------
    site
        The feeder.
    plan
        What is compared.
    journal
        File in which finished cases are kept; an interrupted comparison goes on from it.
    progress
        Called with a line for people before each design and each case.

    Returns
    -------
    list of Row
        One for each case and family, case by case.

    Raises
    ------
    OtherStudy
        If the journal is another study's.
    InUse
        If another process is writing it.
    """
    tell = progress or (lambda _: None)
    cases = [case for case in CASES if case.name in plan.cases]
    asked = {name: value for name, value in asdict(plan).items() if name != "workers"}
    subject = {"study": "compare", "digest": site.digest, "plan": asked}

    @cache
    def watchers() -> dict[str, Watcher | str]:
        # What a trial states does not depend on its seed or lie: one design serves all.
        stated = plan.trial(site, CASES[0], 0).stated
        found: dict[str, Watcher | str] = {}
        for name in plan.families:
            tell(f"design of {name}")
            found[name] = _design(stated, name, plan, tell)
        return found

    def work(case: Case) -> list[dict[str, Any]]:
        designed = watchers()
        tell(f"case {case.name}")
        return [asdict(row) for row in _case(site, case, plan, designed)]

    with Journal(journal, subject, of=len(cases)) as kept:
        return [Row(**row) for case in cases for row in kept.get(case.name, partial(work, case))]


def _design(site: Site, name: str, plan: Plan, tell: Callable[[str], None]) -> Watcher | str:
    try:
        chosen = choose(site, estimator=name, max_attacked=plan.max_attacked)
        return design(
            chosen,
            workers=plan.workers,
            progress=lambda done, total: tell(f"design of {name}: {done} of {total}"),
        )
    except (NotObservable, DesignInfeasible, EstimatorUnusable) as error:
        return str(error)


def _case(site: Site, case: Case, plan: Plan, watchers: dict[str, Watcher | str]) -> list[Row]:
    outcomes: dict[str, list[Outcome]] = {name: [] for name in watchers}
    reasons = {name: watcher for name, watcher in watchers.items() if isinstance(watcher, str)}
    try:
        for seed in range(plan.seeds):
            trial = plan.trial(site, case, seed)
            played = list(frames(trial))
            for name, watcher in watchers.items():
                if name in reasons or isinstance(watcher, str):
                    continue
                try:
                    outcomes[name].append(judge(watcher, trial, played=played))
                except Exception as failure:  # noqa: BLE001  # the code of others may do anything
                    reasons[name] = _failed(failure)
    except NoSuchAttack as error:
        return [Row(name, case.name, str(error)) for name in watchers]
    return [
        Row(name, case.name, reasons[name])
        if isinstance(watcher, str) or name in reasons
        else _row(name, case.name, watcher.observers, outcomes[name])
        for name, watcher in watchers.items()
    ]


def _failed(failure: Exception) -> str:
    return "it failed while it watched: " + " ".join(f"{type(failure).__name__}: {failure}".split())


def _row(family: str, case: str, observers: int, outcomes: Sequence[Outcome]) -> Row:
    delays = np.concatenate([each for one in outcomes for each in (one.delay_s, one.inverter_delay_s)])
    named = delays[np.isfinite(delays)]
    step_ms = np.concatenate([one.step_ms for one in outcomes])
    lying = sum(int(one.lying.sum()) for one in outcomes)
    clean = sum(int(one.clean_while_lying.sum()) for one in outcomes)
    return Row(
        family=family,
        case=case,
        liars=delays.size,
        named=named.size,
        missed=delays.size - named.size,
        falsely_named=sum(int(one.accused.sum() + one.accused_inverters.sum()) for one in outcomes),
        false_share=float(np.mean(np.concatenate([one.false_names > 0 for one in outcomes]))),
        delay_s=float(np.median(named)) if named.size else math.nan,
        error_liars=_most(np.concatenate([one.error_liars for one in outcomes])),
        error_all=_most(np.concatenate([one.error_all for one in outcomes])),
        step_ms=float(np.median(step_ms)),
        step_ms_95=_most(step_ms),
        observers=observers,
        false_clean=clean / lying if lying else math.nan,
        undecided=float(np.mean(np.concatenate([one.undecided for one in outcomes]))),
    )


def _most(values: Floats) -> float:
    """95th percentile; one of the values, so that infinite ones stay what they are."""
    return float(np.percentile(values, 95, method="higher")) if values.size else math.nan


# ---------------------------------------------------------------------------------------------- on paper


def write_csv(rows: Iterable[Row], path: Path) -> None:
    """Write all numbers as they are; a file that is there is replaced when the new one is complete.

    Parameters
    ----------
    rows
        From `compare`.
    path
        The file.
    """

    def write(new: Path) -> None:
        with new.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [each.name for each in fields(Row)])
            writer.writeheader()
            writer.writerows(asdict(row) for row in rows)

    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, write)


HEADERS: Final = (
    "family",
    "named",
    "missed",
    "falsely named",
    "delay, s",
    "error at liars, %",
    "error at all, %",
    "ms per step",
    "observers",
    "false clean, %",
    "undecided, %",
)


def cells(row: Row) -> tuple[str, ...]:
    """Turn a row into the texts under HEADERS; a row without numbers has the reason as its second and last.

    Parameters
    ----------
    row
        From `compare`.
    """
    if row.reason:
        return row.family, row.reason
    return (
        row.family,
        f"{row.named} of {row.liars}",
        str(row.missed),
        str(row.falsely_named),
        _text(row.delay_s, ".0f"),
        _text(row.error_liars, ".3f"),
        _text(row.error_all, ".3f"),
        f"{row.step_ms:.2f} ({row.step_ms_95:.1f})",
        str(row.observers),
        _text(100.0 * row.false_clean, ".0f"),
        _text(100.0 * row.undecided, ".0f"),
    )


def markdown(rows: Sequence[Row], plan: Plan) -> str:
    """One overview, and one table for each case; every family has a row, also if it did not take part.

    Parameters
    ----------
    rows
        From `compare`.
    plan
        What was compared.
    """
    names = list(dict.fromkeys(row.case for row in rows))
    found = {(family, name): Row(family, name, "not run") for family in FAMILIES for name in names}
    found |= {(row.family, row.case): row for row in rows}
    meanings = {case.name: case.told(plan.max_attacked) for case in CASES}
    lines = [
        "Named of those who lied, and in brackets how many honest ones were ever named; none: there are no",
        "numbers, the tables below say why.",
        "",
    ]
    lines += _head(("family", *names))
    for family in FAMILIES:
        lines.append(_line((family, *(_short(found[family, name]) for name in names))))
    for name in names:
        lines += ["", f"### {name}", "", f"{meanings[name][0].upper()}{meanings[name][1:]}.", ""]
        lines += _head(HEADERS)
        for family in FAMILIES:
            texts = cells(found[family, name])
            lines.append(_line((*texts, *("",) * (len(HEADERS) - len(texts)))))
    return "\n".join(lines)


def splice(text: str, table: str) -> str:
    """Replace what stands between BEGIN and END.

    Parameters
    ----------
    text
        The document.
    table
        What shall stand there.

    Raises
    ------
    GridsecError
        When the document does not have both markers, once each and in this order.
    """
    before, _, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end or text.count(BEGIN) != 1 or text.count(END) != 1:
        raise GridsecError(f"the document must hold {BEGIN} and, after it, {END}, once each", code="missing")
    return f"{before}{BEGIN}\n\n{table.strip()}\n\n{END}{after}"


def _short(row: Row) -> str:
    return "none" if row.reason else f"{row.named}/{row.liars} ({row.falsely_named})"


def _head(headers: tuple[str, ...]) -> list[str]:
    return [_line(headers), _line(("---",) * len(headers))]


def _line(texts: Iterable[str]) -> str:
    # The tables of Markdown know no line breaks, and a bar ends a cell.
    return "| " + " | ".join(" ".join(text.split()).replace("|", "\\|") for text in texts) + " |"


def _text(value: float, form: str) -> str:
    return "" if math.isnan(value) else format(value, form)

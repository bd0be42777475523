"""Comparison of all estimators on the same trials of one feeder.

Every estimator of `feeders.registry.FAMILIES` processes the same frames: full AC power flow as
truth, meters with the accuracy of the feeder's files, loads known up to a stated error. An estimator without
a design for the feeder, or with a failure in a step, keeps its rows, with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from feeders.model.site import Site
from feeders.registry import FAMILIES, DesignedEstimator, EstimatorUnusable, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec, NoSuchAttack
from feeders.simulation.demand import Variation
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, TrialResult, frames, judge
from feeders.studies.running import Journal, Where
from feeders.util import replace_file
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, GridsecError, NotObservable, Problem, no_choice, raise_if_any

__all__ = [
    "BEGIN",
    "CASES",
    "END",
    "FEEDER",
    "ComparisonCase",
    "ComparisonPlan",
    "ComparisonRow",
    "compare",
    "markdown",
    "splice",
    "write_csv",
]

FEEDER: Final = "simbench-lv-rural1"

ONSET_S: Final = 60.0  # onset of the attacks, s after the start; the estimators have settled by then

BEGIN: Final = "<!-- comparison: begin -->"
END: Final = "<!-- comparison: end -->"

LIVELY: Final = Variation(tap_interval_s=300.0)
"""Loads and clouds of the usual scenarios; the transformer upstream may step every five minutes.

Runs of minutes then include steps that make repeated readings visible.
"""


@dataclass(frozen=True, slots=True)
class ComparisonCase:
    """Case of the comparison: one kind of attack, or none."""

    name: str  # short name
    meaning: str  # `{meters}` is replaced by the number of manipulated meters
    trick: AttackKind | None = None  # None: no attack
    size: float = 0.0  # as in `feeders.simulation.attacks.AttackSpec`
    one: bool = False  # one manipulated device, for any M

    def told(self, count: int) -> str:
        """Description of the case for this number of manipulated meters."""
        return self.meaning.format(meters=f"{count} meter" if count == 1 else f"{count} meters")

    def lie(self, count: int) -> AttackSpec | None:
        """Attack for this number of manipulated meters, None without one."""
        if self.trick is None:
            return None
        return AttackSpec(self.trick, 1 if self.one else count, self.size, ONSET_S)


CASES: Final = (
    ComparisonCase("clean", "no attack"),
    ComparisonCase(
        "bias", "readings of {meters} at random are 3 % too high or too low", AttackKind.BIAS, 3.0
    ),
    ComparisonCase(
        "coordinated",
        "readings of {meters} show the trace of a load that is not there, at least 3 % deep",
        AttackKind.COORDINATED,
        3.0,
    ),
    ComparisonCase(
        "coordinated-power",
        "the same, and the customer's meter reports the power of that load",
        AttackKind.COORDINATED_POWER,
        3.0,
    ),
    ComparisonCase(
        "drift", "readings of {meters} at random leave the truth by 1 % per minute", AttackKind.DRIFT, 1.0
    ),
    ComparisonCase("stuck", "readings of {meters} at random stay as at the onset", AttackKind.STUCK),
    ComparisonCase(
        "replay", "readings of {meters} at random are those of 10 minutes earlier", AttackKind.REPLAY, 600.0
    ),
    ComparisonCase(
        "inverter",
        "one inverter at random injects its rating in addition to its droop curve; all meters are honest",
        AttackKind.INVERTER,
        100.0,
        one=True,
    ),
)
"""Cases of the comparison."""


@dataclass(frozen=True, slots=True)
class ComparisonPlan:
    """Options of a comparison; those without a comment are as in `feeders.simulation.trial.Trial`.

    Raises ValueError for an unknown estimator or case, or no run, with all problems.
    """

    max_attacked: int = 2  # M of the designs, and number of manipulated meters
    seeds: int = 3  # number of runs of each case
    duration_s: float = 480.0  # length of a run
    step_s: float = 1.0  # interval of its frames
    load_error: LoadError = field(default_factory=lambda: LoadError(0.1, 0.05))
    meters: TrialMeterErrors = TrialMeterErrors.SITE
    variation: Variation = LIVELY
    report_q: bool = False
    families: tuple[str, ...] = tuple(FAMILIES)
    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    workers: int = 1  # processes for designs by matrix inequality

    def __post_init__(self) -> None:
        """Reject an empty comparison."""
        problems = no_choice("family", FAMILIES, *self.families)
        problems += no_choice("case", (case.name for case in CASES), *self.cases)
        if self.seeds < 1:
            problems.append(Problem("not-positive", f"seeds is {self.seeds}; at least one run is needed"))
        raise_if_any(problems)

    def trial(self, site: Site, case: ComparisonCase, seed: int) -> Trial:
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
class ComparisonRow:
    """Result of one estimator in one case, over all seeds. NaN: not applicable."""

    family: str
    case: str
    reason: str = ""  # for missing numbers; empty with numbers
    liars: int = 0  # manipulated meters and inverters, sum over seeds
    named: int = 0  # those named during the attack
    missed: int = 0  # those not named
    falsely_named: int = 0  # honest meters and inverters ever named
    false_share: float = math.nan  # share of ticks with an honest meter named, 1
    delay_s: float = math.nan  # median from onset to naming of those named
    error_liars: float = math.nan  # 95th percentile of the voltage error at manipulated meters, % of nominal
    error_all: float = math.nan  # the same at all customers
    step_ms: float = math.nan  # median processor time per step
    step_ms_95: float = math.nan  # 95th percentile
    observers: int = 0  # number of observers, or candidate sets
    false_clean: float = math.nan  # share of the ticks with an attack and the verdict CLEAN, 1
    undecided: float = math.nan  # share of all ticks with the verdict UNDECIDED, 1


def compare(
    site: Site, plan: ComparisonPlan, *, journal: Where = None, progress: Callable[[str], None] | None = None
) -> list[ComparisonRow]:
    """Run all estimators on all cases; one row for each case and family, case by case.

    An interrupted comparison resumes from its journal. `progress` is called with a line of text before each
    design and each case.

    Raises OtherStudy if the journal is that of another study; InUse if another process writes the journal.
    """
    report_progress = progress or (lambda _: None)
    cases = [case for case in CASES if case.name in plan.cases]
    asked = {name: value for name, value in asdict(plan).items() if name != "workers"}
    subject = {"study": "compare", "digest": site.digest, "plan": asked}

    @cache
    def watchers() -> dict[str, DesignedEstimator | str]:
        # The stated errors are independent of seed and attack: one design serves all trials.
        stated = plan.trial(site, CASES[0], 0).stated
        found: dict[str, DesignedEstimator | str] = {}
        for name in plan.families:
            report_progress(f"design of {name}")
            found[name] = _design(stated, name, plan, report_progress)
        return found

    def work(case: ComparisonCase) -> list[dict[str, Any]]:
        designed = watchers()
        report_progress(f"case {case.name}")
        return [asdict(row) for row in _case(site, case, plan, designed)]

    with Journal(journal, subject, of=len(cases)) as kept:
        return [ComparisonRow(**row) for case in cases for row in kept.get(case.name, partial(work, case))]


def _design(
    site: Site, name: str, plan: ComparisonPlan, report_progress: Callable[[str], None]
) -> DesignedEstimator | str:
    try:
        chosen = choose(site, estimator=name, max_attacked=plan.max_attacked)
        return design(
            chosen,
            workers=plan.workers,
            progress=lambda done, total: report_progress(f"design of {name}: {done} of {total}"),
        )
    except (NotObservable, DesignInfeasible, EstimatorUnusable) as error:
        return str(error)


def _case(
    site: Site, case: ComparisonCase, plan: ComparisonPlan, watchers: dict[str, DesignedEstimator | str]
) -> list[ComparisonRow]:
    outcomes: dict[str, list[TrialResult]] = {name: [] for name in watchers}
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
                except Exception as failure:  # noqa: BLE001  # external code may raise anything
                    what = " ".join(f"{type(failure).__name__}: {failure}".split())
                    reasons[name] = f"failed in a step: {what}"
    except NoSuchAttack as error:
        return [ComparisonRow(name, case.name, str(error)) for name in watchers]
    return [
        ComparisonRow(name, case.name, reasons[name])
        if isinstance(watcher, str) or name in reasons
        else _row(name, case.name, watcher.observers, outcomes[name])
        for name, watcher in watchers.items()
    ]


def _row(family: str, case: str, observers: int, outcomes: Sequence[TrialResult]) -> ComparisonRow:
    delays = np.concatenate([each for one in outcomes for each in (one.delay_s, one.inverter_delay_s)])
    named = delays[np.isfinite(delays)]
    step_ms = np.concatenate([one.step_ms for one in outcomes])
    lying = sum(int(one.lying.sum()) for one in outcomes)
    clean = sum(int(one.clean_while_lying.sum()) for one in outcomes)
    return ComparisonRow(
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
    """95th percentile; one of the values, so that infinite ones remain."""
    return float(np.percentile(values, 95, method="higher")) if values.size else math.nan


# -------------------------------------------------------------------------------------------------- tables


def write_csv(rows: Iterable[ComparisonRow], path: Path) -> None:
    """Write all numbers; an existing file is replaced when the new one is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame([asdict(row) for row in rows], columns=[each.name for each in fields(ComparisonRow)])
    replace_file(path, partial(table.to_csv, index=False, na_rep="nan", lineterminator="\r\n"))


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


def cells(row: ComparisonRow) -> tuple[str, ...]:
    """Texts of a row under HEADERS; a row without numbers has the reason as its second and last."""
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


def markdown(rows: Sequence[ComparisonRow], plan: ComparisonPlan) -> str:
    """Overview, and one table for each case; every estimator has a row, with or without numbers."""
    names = list(dict.fromkeys(row.case for row in rows))
    found = {(family, name): ComparisonRow(family, name, "not run") for family in FAMILIES for name in names}
    found |= {(row.family, row.case): row for row in rows}
    meanings = {case.name: case.told(plan.max_attacked) for case in CASES}
    lines = [
        "Manipulated devices named, and in brackets the number of honest ones ever named; none: there are no",
        "numbers, the tables below state the reason.",
        "",
    ]
    lines += _head(("family", *names))
    for family in FAMILIES:
        rows_of = (found[family, name] for name in names)
        short = (
            "none" if row.reason else f"{row.named}/{row.liars} ({row.falsely_named})" for row in rows_of
        )
        lines.append(_line((family, *short)))
    for name in names:
        lines += ["", f"### {name}", "", f"{meanings[name][0].upper()}{meanings[name][1:]}.", ""]
        lines += _head(HEADERS)
        for family in FAMILIES:
            texts = cells(found[family, name])
            lines.append(_line((*texts, *("",) * (len(HEADERS) - len(texts)))))
    return "\n".join(lines)


def splice(text: str, table: str) -> str:
    """Replace the text of a document between BEGIN and END.

    Raises GridsecError without both markers, once each and in this order.
    """
    before, _, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end or text.count(BEGIN) != 1 or text.count(END) != 1:
        raise GridsecError(f"the document must hold {BEGIN} and, after it, {END}, once each", code="missing")
    return f"{before}{BEGIN}\n\n{table.strip()}\n\n{END}{after}"


def _head(headers: tuple[str, ...]) -> list[str]:
    return [_line(headers), _line(("---",) * len(headers))]


def _line(texts: Iterable[str]) -> str:
    # Tables of Markdown have no line breaks, and a bar ends a cell.
    return "| " + " | ".join(" ".join(text.split()).replace("|", "\\|") for text in texts) + " |"


def _text(value: float, form: str) -> str:
    return "" if math.isnan(value) else "∞" if math.isinf(value) else format(value, form)

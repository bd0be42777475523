"""List of all feeders: status, order, filters and pages.

A page is bounded, so that the answer for a fleet of thousands stays small. The web page shows the same status
in its list, its selector and the title of its tab.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from service.api import models
from service.report.feeder_info import FeederStatus, status_of
from service.report.report import BUSBAR, FeederReport
from service.store import AlarmCounts

_RANK = {status: k for k, status in enumerate(FeederStatus)}
_NONE = AlarmCounts(0, 0)


class Order(StrEnum):
    """Order of the list."""

    GIVEN = "given"
    WORST = "worst"


@dataclass(frozen=True, slots=True)
class Standing:
    """One feeder at the time of the request."""

    fields: Mapping[str, Any]  # as of `Backend.feeders`
    report: FeederReport | None
    age_s: float | None
    suspects: int
    alarms: AlarmCounts
    status: FeederStatus

    @property
    def name(self) -> str:
        """Name of the feeder."""
        return str(self.fields["name"])

    @property
    def rank(self) -> tuple[int, int, int, float, str]:
        """Sort key, the worst first: status, suspects, new alarms, earliest start of the verdict, name."""
        since = None
        if self.report is not None:
            since = self.report.since if self.report.displayed is None else self.report.displayed.since
        return _RANK[self.status], -self.suspects, -self.alarms.raised, since or 0.0, self.name

    def matches(self, words: str) -> bool:
        """True if the name or the title contains a text in lower case."""
        return words in self.name.lower() or words in str(self.fields.get("title", "")).lower()

    def summary(self) -> models.FeederSummary:
        """Return the entry of the list."""
        report, now = self.report, {"status": self.status, "alarms": self.alarms.active}
        now["raised"] = self.alarms.raised
        if report is not None:
            now |= {
                "t": report.t,
                "verdict": report.verdict,
                "age_s": self.age_s,
                "model_only": report.model_only,
                "since": report.since,
                "displayed_verdict": None if report.displayed is None else report.displayed.verdict,
                "displayed_since": None if report.displayed is None else report.displayed.since,
                "meters": len(report.meters),
                "suspects": self.suspects,
                "silent": sum(one.meter != BUSBAR for one in report.silent),
            }
        return models.FeederSummary.model_validate({**self.fields, **now})


def standing(
    fields: Mapping[str, Any], report: FeederReport | None, age_s: float | None, alarms: AlarmCounts | None
) -> Standing:
    """Return the state of a feeder from its fields, its latest report with its age, s, and its alarms."""
    suspects = 0
    if report is not None:
        suspects = len(report.suspects) + sum(inverter.suspect for inverter in report.inverters)
    status = status_of(report, age_s, fields.get("patience_s"), failed=fields.get("phase") == "failed")
    return Standing(fields, report, age_s, suspects, alarms or _NONE, status)


def page(
    found: Sequence[Standing],
    *,
    order: Order,
    text: str,
    status: Iterable[FeederStatus],
    include: str | None,
    part: tuple[int, int | None],
) -> models.Feeders:
    """Return a page of feeders.

    found: all feeders in the scope of the caller; `counts` refers to these.
    text, status: filters; empty for all.
    include: feeder that stands behind the page if it is not a part of it.
    part: offset, and largest number of feeders or None.
    """
    words, wanted, (offset, limit) = text.strip().lower(), set(status), part
    chosen = [one for one in found if (not wanted or one.status in wanted) and one.matches(words)]
    if order is Order.WORST:
        chosen.sort(key=lambda one: one.rank)
    shown = chosen[offset : None if limit is None else offset + limit]
    beside = [one for one in found if one.name == include and one not in shown] if include is not None else []
    counts = dict.fromkeys(FeederStatus, 0)
    for one in found:
        counts[one.status] += 1
    return models.Feeders(
        feeders=[one.summary() for one in (*shown, *beside)], total=len(chosen), counts=counts
    )

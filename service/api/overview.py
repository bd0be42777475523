"""List of all feeders: status, order, filters and pages.

A page is bounded, so that the answer for a fleet of thousands stays small. The web page shows the same status
in its list, its selector and the title of its tab.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from service.api import models
from service.report.feeder_info import UNWATCHED, FeederStatus, status_of
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
    now: Mapping[str, Any]  # numbers of the latest tick, as of `Backend.summary`
    alarms: AlarmCounts
    status: FeederStatus
    incidents: int = 0  # open ones

    @property
    def name(self) -> str:
        """Name of the feeder."""
        return str(self.fields["name"])

    @property
    def rank(self) -> tuple[int, int, int, float, str]:
        """Sort key, the worst first: status, suspects, new alarms, earliest start of the verdict, name."""
        since = self.now.get("displayed_since") or self.now.get("since") or 0.0
        return _RANK[self.status], -self.now.get("suspects", 0), -self.alarms.raised, since, self.name

    def matches(self, words: str) -> bool:
        """True if the name or the title contains a text in lower case."""
        return words in self.name.lower() or words in str(self.fields.get("title", "")).lower()

    def summary(self) -> models.FeederSummary:
        """Return the entry of the list."""
        counts = {"status": self.status, "alarms": self.alarms.active, "raised": self.alarms.raised}
        counts["incidents"] = self.incidents
        return models.FeederSummary.model_validate({**self.fields, **counts, **self.now})


def standing(
    fields: Mapping[str, Any], now: Mapping[str, Any], alarms: AlarmCounts | None, incidents: int = 0
) -> Standing:
    """Return the state of a feeder from its fields, its latest tick, its alarms and its open incidents."""
    status = status_of(now, fields.get("patience_s"), failed=fields.get("phase") == "failed")
    return Standing(fields, now, alarms or _NONE, status, incidents)


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
    causes = Counter(str(one.now["cause"]) for one in found if one.now.get("cause") in UNWATCHED)
    return models.Feeders(
        feeders=[one.summary() for one in (*shown, *beside)], total=len(chosen), counts=counts, causes=causes
    )

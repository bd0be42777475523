"""Which of a round's bad readings are kept, where there are too many: some of everybody's. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from typing import TypeVar

from service.store import Rejected

BAD_PER_SOURCE = 5
"""So many bad readings of one key and for one reason are kept of a round; the others become one entry."""
BAD_PER_ROUND = 50
"""So many entries are kept of a round."""

T = TypeVar("T")


def some_of_each(bad: Iterable[Rejected]) -> tuple[list[Rejected], int]:
    """Return entries for bad readings, and how many readings have none.

    Whoever sends the most leaves room for the others: entries are taken by reason and key in turn.

    Parameters
    ----------
    bad
        Bad readings of one round, in the order of arrival.

    Returns
    -------
    entries, left_out
        In the order of arrival; and how many bad readings they do not tell of.
    """
    sources: dict[str, dict[str, list[tuple[int, Rejected]]]] = {}
    for number, one in enumerate(bad):
        reason = one.reason.partition(":")[0]
        sources.setdefault(reason, {}).setdefault(one.key, []).append((number, one))
    turns = [_in_turn([_entries(found) for found in keys.values()]) for keys in sources.values()]
    entries = _in_turn(turns)
    kept = sorted(entries[:BAD_PER_ROUND], key=lambda entry: entry[0])
    return [one for _, one, _ in kept], sum(count for _, _, count in entries[BAD_PER_ROUND:])


_Entry = tuple[int, Rejected, int]


def _entries(found: Sequence[tuple[int, Rejected]]) -> list[_Entry]:
    """The entries for the bad readings of one key and reason: place, entry, how many it stands for."""
    entries = [(number, one, 1) for number, one in found[:BAD_PER_SOURCE]]
    more = len(found) - BAD_PER_SOURCE
    if more > 0:
        number, last = found[-1]
        reason = f"{last.reason.partition(':')[0]}: {more} more on this key at the same time"
        entries.append((number, Rejected(last.t, last.key, reason), more))
    return entries


def _in_turn(queues: Iterable[Sequence[T]]) -> list[T]:
    return [item for row in zip_longest(*queues) for item in row if item is not None]

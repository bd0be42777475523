"""Why a tick was judged as it was, in an operator's words: with the ids of meters, which monitors lack."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

import numpy as np

from feeders.load import Site
from gridsec.arrays import Bools
from gridsec.online import Cause, Verdict
from service.align import Tick
from service.busbar import busbar_in_words, busbar_off

_NAMING: Final = frozenset({Cause.AMBIGUOUS, Cause.SILENT_METERS, Cause.CLOCK_OFFSET, Cause.MISSING_POWERS})
"""Causes with a sentence of the monitor that names meters by their customers."""
_SHOWN: Final = 5
"""So many names are listed at most."""


def reason_of(site: Site, tick: Tick, max_attacked: int, verdict: Verdict) -> str:
    """Say why, with the meters' ids, as in alarms: the monitor knows customers only.

    Parameters
    ----------
    site, tick
        The feeder, and what was known.
    max_attacked
        The number M that the monitor was designed for.
    verdict
        What the monitor made of it.
    """
    suspects = np.flatnonzero(verdict.suspects).tolist()
    unseen = [k for k, reading in enumerate(tick.readings) if reading is None]
    named = _meters(site, suspects)
    if verdict.cause is Cause.RESIDUALS:
        sure = _named(site, tick, verdict)
        return f"{sure} {_ways(site, verdict)}" if verdict.explanations else sure
    if verdict.cause is Cause.AMBIGUOUS and verdict.explanations:
        return _ways(site, verdict)
    if verdict.cause is Cause.TOO_MANY_SUSPECTS and suspects:
        return (
            f"{len(suspects)} meters disagree with the feeder ({named}), and at most {max_attacked} can be "
            "told apart. A wrong busbar reading, switch or line in the model looks the same."
        )
    if verdict.cause is Cause.SILENT_METERS and unseen:
        return f"No reading from {_meters(site, unseen)}."
    text = re.sub(r"([Tt])he meter of the busbar\b", r"\1he substation's meter", verdict.reason)
    return _in_ids(site, text) if verdict.cause in _NAMING else text


def _named(site: Site, tick: Tick, verdict: Verdict) -> str:
    """Who is manipulated; of the busbar's meter also by how much, since everything else hangs on it."""
    who = _who(site, verdict.suspects, verdict.inverters, busbar=verdict.busbar)
    if not verdict.busbar.any():
        return f"Manipulated: {who}; further off than meter accuracy and load uncertainty allow."
    off = busbar_off(site, tick, verdict)
    if not verdict.suspects.any() and not verdict.inverters.any():
        return f"Manipulated: {who}; it {off}."
    far = "further off than meter accuracy and load uncertainty allow"
    return f"Manipulated: {who}; {far}. The substation's meter {off}."


def _ways(site: Site, verdict: Verdict) -> str:
    """What may be the case, each with its share."""
    ways = [
        f"{_who(site, e.meters, e.inverters, e.powers, busbar=e.busbar)} ({e.probability:.0%})"
        for e in verdict.explanations
    ]
    more = f" or {len(ways) - _SHOWN} more" if len(ways) > _SHOWN else ""
    begin = "Several explanations fit" if len(ways) > 1 else "Only this explains the readings"
    return f"{begin}: {' or else '.join(ways[:_SHOWN])}{more}."


def _meters(site: Site, which: Sequence[int]) -> str:
    """The ids of some meters, the first few of many."""
    rest = f" and {len(which) - _SHOWN} more" if len(which) > _SHOWN else ""
    return ", ".join(site.meter_ids[k] for k in which[:_SHOWN]) + rest


def _who(site: Site, meters: Bools, inverters: Bools, powers: Bools | None = None, *, busbar: Bools) -> str:
    """Meters by their ids, all else by its customers, as in alarms; the first few of many."""
    found = np.flatnonzero(meters).tolist()
    parts = [_meters(site, found)] if found else []
    doubted = () if powers is None else np.flatnonzero(powers)
    for what, customers in (("inverter", site.droop.customer[inverters]), ("reported power", doubted)):
        names = [site.feeder.customers[int(c)] for c in customers]
        rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        if names:
            parts.append(f"the {what}{'s' if len(names) > 1 else ''} of {', '.join(names[:_SHOWN])}{rest}")
    if busbar.any():
        parts.append(busbar_in_words(site, busbar))
    return " and ".join(parts) or "nobody"


def _in_ids(site: Site, text: str) -> str:
    """Call customers in a sentence by their meters' ids; longer names first, one may begin another.

    Inverters keep their customer's name, as in alarms.
    """
    meter_of = {
        site.feeder.customers[int(customer)]: meter
        for customer, meter in zip(site.meters, site.meter_ids, strict=True)
    }
    names = "|".join(re.escape(name) for name in sorted(meter_of, key=len, reverse=True))
    return re.sub(rf"(?<!\w)(?<!nverter of )(?:{names})(?!\w)", lambda found: meter_of[found[0]], text)

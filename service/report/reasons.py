"""Reasons of verdicts, and errors of a feeder's files that explain accusations."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import structlog
from pydantic import Field

from feeders.model.site import Site, plant
from gridsec.arrays import Bools
from gridsec.estimators import data_errors
from gridsec.estimators.data_errors import DataError, DataErrorKind
from gridsec.grid.three_phase import PHASES
from gridsec.interface import Cause, Estimate, Frame, Verdict
from service.ingest.align import Tick
from service.report.voltages import busbar_in_words, busbar_off

_log = structlog.get_logger("gridsec.data_errors")


@dataclass(frozen=True, slots=True)
class DataErrorReport:
    """An error of the feeder's files that explains accused meters as well as a manipulation does."""

    kind: DataErrorKind
    meters: Annotated[tuple[str, ...], Field(description="The accused meters that the error explains.")]
    customers: Annotated[
        tuple[str, ...], Field(description="The one customer, or the two that are exchanged.")
    ]
    proposed: Annotated[
        tuple[str, ...],
        Field(description="Bus and phase of each customer that agree with the readings."),
    ]
    study: Annotated[str, Field(description="Command that checks the error on a recording.")]
    text: Annotated[str, Field(description="One sentence for the operator.")]


class DataErrors:
    """Search for errors of a feeder's files; it runs only while a meter is accused."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._window = data_errors.begin()
        self._design: data_errors.DataErrorDesign | None = None
        self._designed = False

    def renew(self) -> None:
        """Restart the window."""
        self._window = data_errors.begin()

    def follow(self, frame: Frame, estimate: Estimate, verdict: Verdict) -> DataErrorReport | None:
        """Add one tick to the window; return the error that explains a meter accused at this tick."""
        accused = data_errors.accused(verdict)
        if not self._designed:
            if not accused.any():
                return None
            self._design, self._designed = self._prepared(), True
        if self._design is None:
            return None
        try:
            self._window = data_errors.follow(self._design, self._window, frame, estimate.x, accused)
        except Exception:  # noqa: BLE001 - a failed search costs no verdict
            _log.exception(
                "errors of the feeder's files are no longer compared", feeder=self._site.feeder.name
            )
            self._design = None
            return None
        error = self._window.error
        if error is None or not accused[list(error.meters)].any():
            return None
        return _in_words(self._site, error)

    def _prepared(self) -> data_errors.DataErrorDesign | None:
        return data_errors.design(
            plant(self._site), self._site.base_volt, self._site.tables.meta.monitor.tick_s
        )


_PHASE, _SWAP, _BUS = "phase", "swap", "bus"

_LOOK_FOR: Final = {
    DataErrorKind.PHASE: (_PHASE,),
    DataErrorKind.EXCHANGED_PHASES: (_PHASE, _SWAP),
    DataErrorKind.EXCHANGED_METERS: (_SWAP,),
    DataErrorKind.BUS: (_BUS,),
}
"""Errors that `gridsec study calibrate` compares: on short lines an exchange of phases is one of meters."""


def _in_words(site: Site, error: DataError) -> DataErrorReport:
    customers = tuple(site.feeder.customers[i] for i in error.customers)
    proposed = tuple(_place(site, q) for q in error.places)
    one = customers[0]
    match error.kind:
        case DataErrorKind.PHASE:
            what = f"customer {one} on another phase ({proposed[0]})"
        case DataErrorKind.BUS:
            what = f"customer {one} at another bus ({proposed[0]})"
        case DataErrorKind.EXCHANGED_PHASES:
            what = f"exchanged phases of customers {one} and {customers[1]}"
        case DataErrorKind.EXCHANGED_METERS:
            what = f"exchanged meters of customers {one} and {customers[1]}"
    options = " ".join(f"--look-for {name}" for name in _LOOK_FOR[error.kind])
    study = f"gridsec study calibrate {site.feeder.name} --readings FILE {options}"
    return DataErrorReport(
        kind=error.kind,
        meters=tuple(site.meter_ids[j] for j in error.meters),
        customers=customers,
        proposed=proposed,
        study=study,
        text=f"An error of the feeder's files explains this as well: {what}. Check with `{study}`.",
    )


def _place(site: Site, place: int) -> str:
    """Bus and phase of a place."""
    if site.feeder.busbar_phases == 1:
        return f"bus {site.feeder.buses[place]}"
    bus, phase = divmod(place, len(PHASES))
    return f"bus {site.spanning.buses[bus]}, phase {PHASES[phase]}"


_NAMING: Final = frozenset({Cause.AMBIGUOUS, Cause.SILENT_METERS, Cause.CLOCK_OFFSET, Cause.MISSING_POWERS})
"""Causes with a sentence of the monitor that contains customers in place of meters."""
_SHOWN: Final = 5
"""Largest number of names in a list."""


def reason_of(site: Site, tick: Tick, max_attacked: int, verdict: Verdict) -> str:
    """Return the reason of a verdict, with the meters' ids as in alarms: the monitor uses customers only."""
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
    """Devices named as manipulated, with the deviation of a busbar meter: all estimates depend on it."""
    accused = _who(site, verdict.suspects, verdict.inverters, busbar=verdict.busbar)
    if not verdict.busbar.any():
        return f"Manipulated: {accused}; further off than meter accuracy and load uncertainty allow."
    off = busbar_off(site, tick, verdict)
    if not verdict.suspects.any() and not verdict.inverters.any():
        return f"Manipulated: {accused}; it {off}."
    far = "further off than meter accuracy and load uncertainty allow"
    return f"Manipulated: {accused}; {far}. The substation's meter {off}."


def _ways(site: Site, verdict: Verdict) -> str:
    """Explanations, each with its share."""
    ways = [
        f"{_who(site, e.meters, e.inverters, e.powers, busbar=e.busbar)} ({e.probability:.0%})"
        for e in verdict.explanations
    ]
    more = f" or {len(ways) - _SHOWN} more" if len(ways) > _SHOWN else ""
    begin = "Several explanations fit" if len(ways) > 1 else "Only this explains the readings"
    return f"{begin}: {' or else '.join(ways[:_SHOWN])}{more}."


def _meters(site: Site, which: Sequence[int]) -> str:
    """Ids of meters, at most `_SHOWN`."""
    rest = f" and {len(which) - _SHOWN} more" if len(which) > _SHOWN else ""
    return ", ".join(site.meter_ids[k] for k in which[:_SHOWN]) + rest


def _who(site: Site, meters: Bools, inverters: Bools, powers: Bools | None = None, *, busbar: Bools) -> str:
    """Meters by their ids, other devices by their customers, as in alarms; at most `_SHOWN` of a kind."""
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
    return " and ".join(parts) or "no device"


def _in_ids(site: Site, text: str) -> str:
    """Replace customers in a sentence by their meters' ids.

    Longer names come first, since one name may be the beginning of another. Inverters keep their customer's
    name, as in alarms.
    """
    meter_of = {
        site.feeder.customers[int(customer)]: meter
        for customer, meter in zip(site.meters, site.meter_ids, strict=True)
    }
    names = "|".join(re.escape(name) for name in sorted(meter_of, key=len, reverse=True))
    return re.sub(rf"(?<!\w)(?<!nverter of )(?:{names})(?!\w)", lambda found: meter_of[found[0]], text)

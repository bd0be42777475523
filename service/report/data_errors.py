"""Errors of a feeder's files that explain accused meters as well as a manipulation does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

import structlog
from pydantic import Field

from feeders.model.site import Site, plant
from gridsec.estimators import data_errors
from gridsec.estimators.data_errors import DataError, DataErrorKind
from gridsec.grid.three_phase import PHASES
from gridsec.interface import Estimate, Frame, Verdict

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

"""Record of a feeder's distrusted devices, with storage across restarts.

`Suspicions` has no clock and no input or output, like the `FeederMonitor` that owns it: time comes from the
ticks, stored texts are passed as values.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from feeders.model.site import Site
from feeders.registry import DesignedEstimator, WarmStart
from gridsec.estimators.sequential import SuspicionRecord
from service.report.voltages import busbar_phases
from service.store.state_codec import KeptInvalid, StateSnapshot, decode_distrust, encode_distrust


class Suspicions:
    """Distrusted meters and inverters of one feeder, including the busbar meter.

    known: distrusted devices at the last tick, or at the end of the previous process.
    note: reason why stored state is not used; empty otherwise.
    kept: stored state.
    """

    def __init__(self, site: Site, kept: StateSnapshot | None = None) -> None:
        self.known = SuspicionRecord.empty(len(site.meter_ids), site.droop.tau.size, len(busbar_phases(site)))
        self.note = ""
        self._site = site
        self._watcher: DesignedEstimator | None = None
        self._t: float | None = None
        if kept is not None:
            try:
                self.known = decode_distrust(site, kept)
            except KeptInvalid as error:
                self.note = f"suspicions of {kept.t:.0f} are not used: {error}"
        self._stored: SuspicionRecord | None = None if self.note else self.known

    @property
    def _memory(self) -> WarmStart | None:
        return None if self._watcher is None else self._watcher.family.warm_start

    def install(self, watcher: DesignedEstimator) -> None:
        """Install a finished design."""
        self._watcher = watcher

    def restore(self, state: Any) -> Any:
        """Apply the record to a state, if the monitor supports a warm start."""
        if self._watcher is None or self._memory is None:
            return state
        return self._memory.warm_start(self._watcher.design, state, self.known)

    def follow(self, state: Any, t: float) -> None:
        """Update from the result of a tick."""
        if self._watcher is not None and self._memory is not None:
            self.known, self._t = self._memory.distrusted(self._watcher.design, state), t

    def forget(self, meters: Sequence[str], t: float) -> None:
        """Remove replaced meters from the record. `meters` is empty for all."""
        chosen = set(meters)
        which = [not chosen or meter in chosen for meter in self._site.meter_ids]
        self.known, self._t = self.known.without(np.array(which, dtype=np.bool_)), t

    def now(self) -> StateSnapshot | None:
        """Return the present state for the store; None before the first tick."""
        return None if self._t is None else encode_distrust(self._site, self._t, self.known)

    def due(self) -> tuple[StateSnapshot, ...]:
        """Return the state for the store if it has changed; it counts as stored afterwards."""
        if self._t is None or (self._stored is not None and self._stored.same(self.known)):
            return ()
        self._stored = self.known
        return (encode_distrust(self._site, self._t, self.known),)

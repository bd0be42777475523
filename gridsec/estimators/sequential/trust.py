"""Trust of meters and inverters: the state machine of a suspect.

A meter becomes a suspect by a search or by repeating its readings. It is named by confirmation, and trusted
again after `release` successive readings without evidence, once it has given the readings that it owes. Its
age falls to zero only after the longest scale without evidence (docs/theory-sequential.md, section 5).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Bools, Ints, all_of, any_of


@dataclass(frozen=True, slots=True, eq=False)
class TrustState:
    """Trust of meters and inverters. p meters, m inverters, s scales."""

    trusted: Bools  # (p,) meters used by the estimate
    scale: Ints  # (p,) scale of the detection of each suspect
    ticks_suspect: Ints  # (p,) ticks as a suspect; reset after the longest scale without evidence
    ticks_clear: Ints  # (p,) readings without evidence
    above_limit: Bools  # (s, p) residual above the limit at the last look
    above_release_limit: Bools  # (s, p) residual above the release limit at the last look
    readings_owed: Ints  # (p,) readings a suspect of an earlier run owes before its scale can release it
    repeat_lag: Ints  # (p,) ticks after which a suspect repeats its readings, 1 if stuck, 0 if none
    named: Bools  # (p,) meters named as manipulated
    accused: tuple[tuple[int, int], ...]  # other suspicions: index of the fault dictionary, scale
    inverter_ticks: Ints  # (m,) ticks that accuse each inverter, less those that do not
    inverters: Bools  # (m,) inverters named as manipulated
    clear: bool = field(init=False)  # derived: no suspicion, now or within the longest scale

    def __post_init__(self) -> None:
        # Later in-place writes concern meters that are not trusted: the state is not clear then either.
        evidence = any_of(self.above_limit) or any_of(self.above_release_limit)
        named = any_of(self.named) or any_of(self.inverters)
        lately = bool(self.accused) or any_of(self.ticks_suspect) or any_of(self.inverter_ticks)
        object.__setattr__(self, "clear", all_of(self.trusted) and not (evidence or named or lately))

    @staticmethod
    def initial(meters: int, inverters: int, scales: int) -> TrustState:
        """Every meter and inverter trusted."""
        zero, no = np.zeros(meters, dtype=np.intp), np.zeros(meters, dtype=np.bool_)
        none = np.zeros((scales, meters), dtype=np.bool_)
        ticks, named = np.zeros(inverters, dtype=np.intp), np.zeros(inverters, dtype=np.bool_)
        return TrustState(~no, zero, zero, zero, none, none, zero, zero, no, (), ticks, named)

    def writable(self) -> TrustState:
        """Copy with evidence that `record` can write."""
        return replace(
            self, above_limit=self.above_limit.copy(), above_release_limit=self.above_release_limit.copy()
        )

    def record(self, s: int, enough: Bools, above_limit: Bools, above_release_limit: Bools) -> None:
        """Write the evidence of scale s, (p,) each; with too few readings it keeps its earlier detection."""
        owed = (self.readings_owed > 0) & (self.scale == s)
        stands = np.where(enough, above_release_limit, self.above_release_limit[s]) | owed
        self.above_limit[s], self.above_release_limit[s] = above_limit & ~self.trusted, stands & ~self.trusted

    def suspected(self, trusted: Bools, s: int, accused: tuple[tuple[int, int], ...]) -> TrustState:
        """After a search on scale s: `trusted` (p,) meters, and accused faults with their scales."""
        new = self.trusted & ~trusted
        scale, ticks = np.where(new, s, self.scale), np.where(new, 0, self.ticks_clear)
        return replace(self, trusted=trusted, scale=scale, ticks_clear=ticks, accused=accused)

    def repeating(self, lags: Ints) -> TrustState:
        """With meters that repeat their readings, lags (p,) > 0, named."""
        if not any_of(lags):
            return self
        which = lags > 0
        return replace(
            self,
            trusted=self.trusted & ~which,
            ticks_clear=np.where(which, 0, self.ticks_clear),
            above_release_limit=self.above_release_limit | which,
            repeat_lag=np.where(which, lags, self.repeat_lag),
            named=self.named | which,
        )

    def without_evidence(self, meters: Bools) -> TrustState:
        """Without the evidence against some meters, (p,)."""
        return replace(
            self,
            above_limit=self.above_limit & ~meters,
            above_release_limit=self.above_release_limit & ~meters,
        )

    def counted(self, named: Bools, available: Bools, release: int, longest: int) -> TrustState:
        """With one more tick counted, and meters released after `release` readings without evidence.

        named: (p,) at the last tick. available: (p,) meters with a reading; silence releases none. longest:
        ticks of the longest scale.
        """
        clear = np.where(self.above_release_limit.any(axis=0), 0, self.ticks_clear + available)
        trusted = (self.trusted & ~named) | (clear >= release)
        # A meter detected again within the longest scale keeps its age.
        suspect = np.where(trusted & (clear > longest), 0, self.ticks_suspect + ~trusted)
        return replace(
            self,
            trusted=trusted,
            ticks_suspect=suspect,
            ticks_clear=clear,
            readings_owed=np.where(trusted, 0, np.maximum(self.readings_owed - available, 0)),
            repeat_lag=np.where(trusted, 0, self.repeat_lag),
            named=named & (clear < release),
        )

    def with_names(self, meters: Bools, inverter_ticks: Ints, inverters: Bools) -> TrustState:
        """With newly named meters, (p,), and the counts and names of the inverters, (m,)."""
        named = self.named | meters
        return replace(self, named=named, inverter_ticks=inverter_ticks, inverters=inverters)

    def without_names(self, meters: Bools) -> TrustState:
        """Without the names of some meters, (p,)."""
        return replace(self, named=self.named & ~meters) if any_of(meters) else self

    def replaced(self, meters: Bools) -> TrustState:
        """After some meters, (p,), were replaced: trusted, without evidence."""
        clear = self.without_evidence(meters)
        return replace(
            clear,
            trusted=self.trusted | meters,
            ticks_suspect=np.where(meters, 0, self.ticks_suspect),
            ticks_clear=np.where(meters, 0, self.ticks_clear),
            readings_owed=np.where(meters, 0, self.readings_owed),
            repeat_lag=np.where(meters, 0, self.repeat_lag),
            named=self.named & ~meters,
        )

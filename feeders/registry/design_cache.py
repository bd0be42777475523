"""Cache of finished designs: one design per feeder, independent of the number of starts.

The name of an entry is the digest of plant, meter sets and options
(`gridsec.observers.design_archive.design_key`). Every entry is used only after its proofs have been
recomputed: a damaged or foreign entry costs time, never correctness. If the folder cannot be written, the
design is returned with the reason.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gridsec.errors import InputInvalid, Problem
from gridsec.estimators.exact_bank.bank import MOST_OBSERVERS, Gains
from gridsec.observers.design_archive import cached
from gridsec.observers.gains import CircleGains, CircleOptions, stacked
from gridsec.observers.lure import Lure
from gridsec.secure.subsets import subsets

_SUFFIX = ".gains"
# Largest number of entries; the least recently used are removed first. A bank of 255 observers is 0.5 MB.
_KEEP = 64


@dataclass(frozen=True, slots=True, eq=False)
class BankGains:
    """Gains of a whole bank and their origin."""

    # Stacked, in the order of `gridsec.secure.subsets.Subsets.masks`, for
    # `gridsec.estimators.exact_bank.bank.design`
    gains: Gains
    designs: tuple[CircleGains, ...]  # The single designs with their proofs, in the same order
    origin: str  # "stored", "new", or "redesigned: …" with the problem of the stored ones
    problem: str  # Problem of reading or storing the designs; empty without one


def folder(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> Path:
    """Folder of the cache: `GRIDSEC_CACHE_DIR`, or the platform's place for caches."""
    if chosen := environment.get("GRIDSEC_CACHE_DIR"):
        return Path(chosen)
    home = Path(environment.get("HOME") or environment.get("USERPROFILE") or tempfile.gettempdir())
    if platform == "darwin":
        return home / "Library" / "Caches" / "gridsec"
    if platform == "win32":
        return Path(environment.get("LOCALAPPDATA") or home / "AppData" / "Local") / "gridsec" / "Cache"
    # The XDG specification ignores relative paths.
    xdg = Path(environment.get("XDG_CACHE_HOME", ""))
    return (xdg if xdg.is_absolute() else home / ".cache") / "gridsec"


class DesignCache:
    """Bytes under keys in one folder; failures go to `problems` and are not raised."""

    def __init__(self, where: Path) -> None:
        self.where = where
        self.problems: list[str] = []

    def get(self, key: str) -> bytes | None:
        """Bytes under a key of letters and digits, None if absent or unreadable."""
        path = self._path(key)
        try:
            blob = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self.problems.append(f"stored designs cannot be read: {error}")
            return None
        try:
            os.utime(path)  # a read counts as use when old entries are removed
        except OSError as error:
            self.problems.append(f"stored designs cannot be marked as used: {error}")
        return blob

    def put(self, key: str, blob: bytes) -> None:
        """Store bytes under a key atomically, and remove the least recently used entries."""
        path = self._path(key)
        try:
            self.where.mkdir(parents=True, exist_ok=True)
            # In the same folder, so that the rename stays within one file system.
            handle, draft = tempfile.mkstemp(dir=self.where, prefix=".")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(blob)
                Path(draft).replace(path)
            except OSError:
                Path(draft).unlink()
                raise
            self._prune()
        except OSError as error:
            self.problems.append(f"designs cannot be stored: {error}")

    def _path(self, key: str) -> Path:
        if not (key.isalnum() and key.isascii()):
            raise InputInvalid([Problem("wrong-text", f"{key!r} is not a key of a design")])
        return self.where / (key + _SUFFIX)

    def _prune(self) -> None:
        entries = sorted(self.where.glob(f"*{_SUFFIX}"), key=lambda path: path.stat().st_mtime_ns)
        for old in entries[:-_KEEP]:
            old.unlink(missing_ok=True)


def bank_gains(
    lure: Lure,
    max_attacked: int,
    options: CircleOptions,
    *,
    workers: int,
    where: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BankGains:
    """Gains by LMI for both banks of chong2020, from the cache `where` if a valid entry exists; p > 2M.

    `progress` is called with (done, total) during the design.

    Raises NotObservable for p <= 2M; DesignInfeasible if some observer does not exist, or their number is too
        large.
    """
    meters = len(lure.C)
    masks = subsets(meters, max_attacked, most=MOST_OBSERVERS).masks()
    sets = [np.flatnonzero(mask).tolist() for mask in masks]
    cache = DesignCache(folder() if where is None else where)
    designs, origin = cached(
        lure, sets, options, get=cache.get, put=cache.put, workers=workers, progress=progress
    )
    L, K = stacked(designs, meters)
    return BankGains(Gains(L=L, K=K), designs, origin, "; ".join(cache.problems))

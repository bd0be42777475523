"""Registry of estimators by their names in `feeder.toml`, with the cache of finished designs.

Estimators of other packages are entry points of the group `gridsec.estimators`. The name of an entry point is
the estimator's name; it refers to an `Estimator` of that name. Names are read without running external code;
an estimator is loaded on first use.

The cache has one design per feeder, independent of the number of starts. The name of an entry is the digest
of plant, meter sets and options (`gridsec.observers.design_archive.design_key`). Every entry is used only
after its proofs have been recomputed: a damaged or foreign entry costs time, never correctness. If the folder
cannot be written, the design is returned with the reason.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Final

import numpy as np

from feeders.format.columns import ESTIMATORS, GROUP, OWN_ESTIMATORS
from feeders.model.site import Site, from_tables, load_doubt, plant, unread
from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible, FeederInvalid, GridsecError, InputInvalid, NotObservable, Problem
from gridsec.estimators import (
    exact_bank,
    front,
    partial,
    set_search,
    single_tick,
    unknown_input,
    windowed,
)
from gridsec.estimators.exact_bank.bank import MOST_OBSERVERS, Gains
from gridsec.estimators.front import Commission, LearningProgress, ObserverRecord, SuspicionRecord
from gridsec.estimators.modal import monitor as modal
from gridsec.interface import Estimate, Frame, Verdict
from gridsec.observers.certificates import certify
from gridsec.observers.design_archive import cached
from gridsec.observers.gains import CircleGains, CircleOptions, options_for, stacked
from gridsec.observers.lure import Lure, close_loop
from gridsec.secure.subsets import subsets

__all__ = [
    "DIRECT",
    "FAMILIES",
    "LMI",
    "MODAL",
    "BankGains",
    "BiasLearning",
    "DesignCache",
    "DesignOptions",
    "DesignedEstimator",
    "Estimator",
    "EstimatorUnusable",
    "ObserverMemory",
    "WarmStart",
    "bank_gains",
    "cache_folder",
    "choose",
    "design",
    "design_foreign",
    "lmi_options",
    "load_foreign",
]


@dataclass(frozen=True, slots=True)
class DesignOptions:
    """Options of a design that do not change its result."""

    workers: int = 1  # processes for designs by matrix inequality
    # folder of the cache of such designs; None: that of `feeders.registry.cache_folder`
    where: Path | None = None
    progress: Callable[[int, int], None] | None = None  # called with (done, total) during such designs


@dataclass(frozen=True, slots=True)
class BiasLearning:
    """Functions of an estimator that learns the fixed errors of its meters."""

    needed_s: Callable[[Any], float]  # `needed_s(design)`: learning time, s; 0 for never
    # `init(design, t, commission)`: initial state with earlier knowledge of the fixed errors
    init: Callable[[Any, float, Commission], Any]
    commission: Callable[[Any], Commission]  # `commission(state)`: present knowledge of the fixed errors
    # `renew(design, state, which)`: state after replacement of meters; their learning restarts
    renew: Callable[[Any, Any, Bools], Any]
    # `read(design, arrays)`: inverse of `arrays`; a `ValueError` names every contradiction to the design
    read: Callable[[Any, Mapping[str, Floats]], Commission]
    # `arrays(design, commission)`: persistent form, arrays of one number per meter by name
    arrays: Callable[[Any, Commission], dict[str, Floats]]
    # `progress(design, commission)`: state and reason of each meter, and the expected time
    progress: Callable[[Any, Commission], LearningProgress]


@dataclass(frozen=True, slots=True)
class WarmStart:
    """Functions of an estimator that keeps suspects over a restart."""

    distrusted: Callable[[Any, Any], SuspicionRecord]  # `distrusted(design, state)`: present suspicion record
    # `restore(design, state, distrust)`: state from `init` with these devices distrusted
    warm_start: Callable[[Any, Any, SuspicionRecord], Any]


@dataclass(frozen=True, slots=True)
class ObserverMemory:
    """Functions of an estimator that continues its observer of the inverters after a restart."""

    settling_s: Callable[[Any], float]  # `settling_s(design)`: time of a start without a record, s
    # `observed(design, state)`: present observer; None if a start without it is as good
    observed: Callable[[Any, Any], ObserverRecord | None]
    # `resume(design, state, record)`: state from `init` at the time of the first frame, with this observer;
    # the same state if the record is too old
    resume: Callable[[Any, Any, ObserverRecord], Any]


@dataclass(frozen=True, slots=True)
class Estimator:
    """Estimator: three functions, a name, and optional abilities."""

    name: str  # as in `feeder.toml`
    summary: str  # one-line description
    # `design(site, job)`: the design; raises `NotObservable` or `DesignInfeasible`. Any other exception of an
    # external estimator becomes `EstimatorUnusable` in `feeders.registry.design`.
    design: Callable[[Site, DesignOptions], Any]
    init: Callable[[Any, float], Any]  # `init(design, t)`: initial state
    # `step(design, state, frame)`: next state, estimate and verdict; never raises on data
    step: Callable[[Any, Any, Frame], tuple[Any, Estimate, Verdict]]
    observers: Callable[[Any], int]  # number of observers, or candidate sets, of a design
    proof: Callable[[Any], str]  # one-line proof of convergence of a design's estimate; empty without one
    # number of manipulated meters that a design identifies; None: `max_attacked` of the feeder's file
    withstands: Callable[[Any], int] | None = None
    bias_learning: BiasLearning | None = None  # learning of the meters' fixed errors; None without it
    warm_start: WarmStart | None = None  # restoring of suspects after a restart; None without it
    observer_memory: ObserverMemory | None = None  # the same for the observer of the inverters


@dataclass(frozen=True, slots=True, eq=False)
class DesignedEstimator:
    """Finished design of one feeder, with its estimator."""

    family: Estimator  # The estimator
    design: Any  # Design by the estimator
    asked: int = 0  # M of the feeder's file

    @property
    def max_attacked(self) -> int:
        """Number of manipulated meters that it identifies."""
        return self.asked if self.family.withstands is None else self.family.withstands(self.design)

    @property
    def observers(self) -> int:
        """Number of observers, or candidate sets."""
        return self.family.observers(self.design)

    @property
    def proof(self) -> str:
        """One-line proof of convergence; empty without one."""
        return self.family.proof(self.design)

    @property
    def bias_learning(self) -> BiasLearning | None:
        """Learning of the meters' fixed errors; None without it."""
        learner = self.family.bias_learning
        return learner if learner is not None and learner.needed_s(self.design) > 0 else None

    def init(self, t: float, commission: Commission | None = None) -> Any:
        """Initial state at a Unix time, s, with earlier knowledge of the meters' fixed errors."""
        if self.bias_learning is None or commission is None:
            return self.family.init(self.design, t)
        return self.bias_learning.init(self.design, t, commission)

    def step(self, state: Any, frame: Frame) -> tuple[Any, Estimate, Verdict]:
        """Process one frame."""
        return self.family.step(self.design, state, frame)


# --- Estimators of other packages ---


class EstimatorUnusable(GridsecError):
    """An estimator of another package cannot be used."""

    code = "estimator-unusable"


def load_foreign(name: str, kind: type) -> Any:
    """Load the estimator of that name, of `feeders.format.columns.foreign_estimators`.

    Raises EstimatorUnusable if there is none or more than one, if its code fails, or if its type is not
        `kind` or its name wrong.
    """
    points = tuple(entry_points(group=GROUP, name=name))
    if len(points) != 1:
        raise EstimatorUnusable(f"estimator {name!r}: {len(points)} packages offer it; expected one")
    try:
        made = points[0].load()
    except Exception as failure:  # external code may raise anything
        raise EstimatorUnusable(
            f"estimator {name!r} ({_where(points[0])}) cannot be loaded: {failure}"
        ) from failure
    if not isinstance(made, kind) or getattr(made, "name", None) != name:
        raise EstimatorUnusable(
            f"estimator {name!r} ({_where(points[0])}) is no {kind.__name__} of that name"
        )
    return made


def design_foreign(
    name: str, make: Callable[[Site, DesignOptions], Any], site: Site, job: DesignOptions
) -> Any:
    """Design by the function `make` of another package.

    Raises NotObservable, DesignInfeasible if the function raises it; EstimatorUnusable if the function raises
        anything else.
    """
    try:
        return make(site, job)
    except (NotObservable, DesignInfeasible):
        raise
    except Exception as failure:  # external code may raise anything
        why = " ".join(f"{type(failure).__name__}: {failure}".split())
        raise EstimatorUnusable(
            f"estimator {name!r} cannot be designed for {site.feeder.name}: {why}"
        ) from failure


def _where(point: EntryPoint) -> str:
    package = "" if point.dist is None else f" of {point.dist.name}"
    return f"{point.value}{package}"


# --- Cache of finished designs ---


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


def cache_folder(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> Path:
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
    cache = DesignCache(cache_folder() if where is None else where)
    designs, origin = cached(
        lure, sets, options, get=cache.get, put=cache.put, workers=workers, progress=progress
    )
    L, K = stacked(designs, meters)
    return BankGains(Gains(L=L, K=K), designs, origin, "; ".join(cache.problems))


# --- Estimators by name ---


MODAL: Final = "modal"
"""One Kalman filter of loads and fixed errors, one e-detector, one search over subsets."""

DIRECT: Final = "exact-bank"
"""The two banks of chong2020 with direct injection and a closed-form certificate for all sets at once."""

LMI: Final = "exact-bank-lmi"
"""The same banks with gains from the corrected matrix inequality (12), one design for every set."""

RATE_PART: Final = 0.25
"""Decay rate required of every observer, relative to that of the feeder itself, 1."""

FLOOR: Final = 0.5
"""Smallest sensitivity of an observer to its own meter, see `observers.gains.CircleOptions`."""


def design(
    site: Site,
    *,
    workers: int = 1,
    where: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DesignedEstimator:
    """Design the estimator of the feeder's file; options as of `DesignOptions`.

    Raises NotObservable, DesignInfeasible if the feeder cannot be monitored with these settings;
        EstimatorUnusable if the code of another package's estimator fails.
    """
    settings = site.tables.meta.monitor
    family, job = FAMILIES[settings.estimator], DesignOptions(workers, where, progress)
    if family.name in OWN_ESTIMATORS:
        return DesignedEstimator(family, family.design(site, job), settings.max_attacked)
    return DesignedEstimator(
        family, design_foreign(family.name, family.design, site, job), settings.max_attacked
    )


def _modal(site: Site, _: DesignOptions) -> modal.ModalDesign:
    settings = site.tables.meta.monitor
    options = front.FrontOptions(
        alarms_per_year=settings.alarms_per_year,
        commission_s=settings.commission_s,
        unread_std_percent=settings.unread_std_percent,
    )
    most = np.maximum(site.loads.load_peak, site.loads.pv_peak)
    return modal.design(
        plant(site), doubt=load_doubt(site), step_s=settings.tick_s, options=options, most=most
    )


def _lmi_bank(site: Site, job: DesignOptions) -> exact_bank.MonitorDesign:
    settings = site.tables.meta.monitor
    lure = close_loop(site.feeder, site.droop, site.meters)
    found = bank_gains(
        lure,
        settings.max_attacked,
        lmi_options(site, lure),
        workers=job.workers,
        where=job.where,
        progress=job.progress,
    )
    return exact_bank.design(
        plant(site), max_attacked=settings.max_attacked, step_s=settings.tick_s, gains=found.gains
    )


def _certificate(
    design: exact_bank.MonitorDesign
    | modal.ModalDesign
    | set_search.SetSearchDesign
    | single_tick.SingleTickDesign,
) -> str:
    proof = design.certificate
    return f"{proof.kind} certificate, margin {proof.margin:.3g}, decay at least {proof.rate:.3g} 1/s"


def _observers(design: Any) -> int:
    return int(design.observers)


def _of(
    family: Any,
    name: str,
    summary: str,
    *,
    design: Callable[[Site, DesignOptions], Any] | None = None,
    proof: Callable[[Any], str] = _certificate,
) -> Estimator:
    """Estimator of a module with `design`, `init` and `step`."""

    def usual(site: Site, _: DesignOptions) -> Any:
        settings = site.tables.meta.monitor
        return family.design(plant(site), max_attacked=settings.max_attacked, step_s=settings.tick_s)

    return Estimator(name, summary, design or usual, family.init, family.step, _observers, proof)


def choose(site: Site, *, estimator: str | None = None, max_attacked: int | None = None) -> Site:
    """Copy a feeder with other settings of the monitor; None: as in the file.

    Raises FeederInvalid for an unknown estimator, or a negative M.
    """
    meta = site.tables.meta
    problems = []
    if estimator is not None and estimator not in ESTIMATORS:
        text = f"estimator {estimator!r} does not exist; there are {', '.join(ESTIMATORS)}"
        problems.append(Problem("unknown-name", text))
    if max_attacked is not None and max_attacked < 0:
        problems.append(Problem("negative", f"max_attacked is {max_attacked}; it must not be negative"))
    if problems:
        raise FeederInvalid(problems)
    changed = replace(
        meta.monitor,
        estimator=meta.monitor.estimator if estimator is None else estimator,
        max_attacked=meta.monitor.max_attacked if max_attacked is None else max_attacked,
    )
    if changed == meta.monitor:
        return site
    return from_tables(replace(site.tables, meta=replace(meta, monitor=changed)))


def lmi_options(site: Site, lure: Lure) -> CircleOptions:
    """Design options of a feeder's observers: the meters' noise and the load uncertainty.

    Noise is jitter and rounding, which change from reading to reading. The fixed bias inside the class is
    part of the thresholds instead. The load error has one column for every customer's p and one for its q.
    Each is the largest error of the file at the customer's peak, or that without a reading for a customer
    without a meter.

    Source: docs/theory-observers.md, on designing against the load error and the noise together.
    """
    own = certify(lure).rate
    jitter, step = site.accuracy.jitter, site.accuracy.resolution
    return options_for(
        lure,
        rate=RATE_PART * own,
        noise=2.0 * np.hypot(jitter, step / np.sqrt(12.0)),
        load=_load_columns(site),
        floor=FLOOR,
    )


def _load_columns(site: Site) -> Floats:
    """Error of w for unit errors of all powers, (N, 2N): `2 R dp` and `2 X dq`."""
    model, loads = site.feeder.linear(), site.loads
    dp = loads.p_fraction * loads.load_peak + loads.p_floor
    dq = 0.5 * (loads.tan_max - loads.tan_min) * loads.load_peak + loads.q_floor
    silent, unmetered = unread(site), np.ones(dp.size, dtype=np.bool_)
    unmetered[site.meters] = False
    dp, dq = np.where(unmetered, silent.p_error, dp), np.where(unmetered, silent.q_error, dq)
    return np.hstack([2.0 * model.R * dp, 2.0 * model.X * dq])


def _ticks(name: str, summary: str, decoder: single_tick.Decoder) -> Estimator:
    """Estimator that tests every tick by itself."""

    def make(site: Site, _: DesignOptions) -> single_tick.SingleTickDesign:
        settings = site.tables.meta.monitor
        return single_tick.design(
            plant(site),
            decoder,
            doubt=load_doubt(site),
            step_s=settings.tick_s,
            max_attacked=settings.max_attacked,
            alarms_per_year=settings.alarms_per_year,
            unread_std_percent=settings.unread_std_percent,
        )

    return _of(single_tick, name, summary, design=make)


class Families(Mapping[str, Estimator]):
    """Bundled estimators and those of other packages, which are loaded on first use."""

    def __init__(self, own: Iterable[Estimator]) -> None:
        self._known = {family.name: family for family in own}

    def __getitem__(self, name: str) -> Estimator:
        if name not in self._known and name in ESTIMATORS:
            self._known[name] = load_foreign(name, Estimator)
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(ESTIMATORS)

    def __len__(self) -> int:
        return len(ESTIMATORS)


FAMILIES: Final = Families(
    (
        replace(
            _of(
                modal,
                MODAL,
                "one filter of loads and meter errors, an e-detector, a search over subsets",
                design=_modal,
            ),
            withstands=lambda d: int(d.max_attacked),
            bias_learning=BiasLearning(
                needed_s=lambda d: float(d.options.commission_s),
                init=modal.init,
                commission=lambda state: state.commission,
                renew=modal.renew,
                read=modal.from_arrays,
                arrays=modal.to_arrays,
                progress=modal.progress,
            ),
            warm_start=WarmStart(modal.distrusted, modal.warm_start),
            observer_memory=ObserverMemory(lambda d: front.settling_s(d.front), modal.observed, modal.resume),
        ),
        _of(exact_bank, DIRECT, "banks of circle-criterion observers, direct injection (chong2020)"),
        _of(exact_bank, LMI, "the same banks, gains by matrix inequality (chong2020)", design=_lmi_bank),
        _of(
            windowed,
            "windowed-bank",
            "windows of consistency of discrete-time observers (yang2019)",
            proof=lambda d: _certificate(d.chain),
        ),
        _ticks(
            "weighted-least-squares",
            "chi-square test and largest normalised residual (lee2018, 2)",
            single_tick.least_squares,
        ),
        _ticks("l0-decoder", "the smallest set that explains a tick (lee2018, 2)", single_tick.fewest),
        _ticks("basis-pursuit", "the attack of smallest l1 norm (lee2018, 2)", single_tick.pursue),
        _ticks("matching-pursuit", "orthogonal matching pursuit (lee2018, 2)", single_tick.match),
        _of(
            partial,
            "partial-observers",
            "one observer per meter, l0 decoding of their stack (lee2018, 4)",
            proof=lambda d: _certificate(d.model),
        ),
        _of(
            set_search,
            "set-search",
            "one switched observer, a new set when its test fails (kim2018, lee2018, 5)",
        ),
        _of(
            unknown_input,
            "unknown-input",
            "meters and inverters at once; suspected injections are unknown inputs (yang2021)",
            proof=lambda d: f"intervals of honest inverters; {len(d.missing)} pairs need reported q",
        ),
    )
)
"""All estimators by name; the names of `feeders.format.columns.ESTIMATORS`."""

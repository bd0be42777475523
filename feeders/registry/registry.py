"""Registry of estimators by their names in `feeder.toml`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from feeders.format.columns import ESTIMATORS, OWN_ESTIMATORS
from feeders.model.load_uncertainty import load_doubt, unread
from feeders.model.site import Site, from_tables, plant
from feeders.registry import plugins
from feeders.registry.design_cache import bank_gains
from feeders.registry.estimator import BiasLearning, DesignedEstimator, DesignOptions, Estimator, WarmStart
from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid, Problem
from gridsec.estimators import (
    exact_bank,
    partial,
    sequential,
    set_search,
    single_tick,
    unknown_input,
    windowed,
)
from gridsec.estimators.sequential.search import Decoder
from gridsec.observers.certificates import certify
from gridsec.observers.gains import CircleOptions, options_for
from gridsec.observers.lure import Lure, close_loop

__all__ = [
    "DIRECT",
    "FAMILIES",
    "LMI",
    "SEQUENTIAL",
    "BiasLearning",
    "DesignOptions",
    "DesignedEstimator",
    "Estimator",
    "WarmStart",
    "choose",
    "design",
    "lmi_options",
]

SEQUENTIAL: Final = "sequential"
"""One observer, a decoder with correlated load errors, evidence on several time scales."""

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
        family, plugins.design(family.name, family.design, site, job), settings.max_attacked
    )


def _sequential(site: Site, _: DesignOptions) -> sequential.SequentialDesign:
    settings = site.tables.meta.monitor
    options = sequential.SequentialOptions(
        alarms_per_year=settings.alarms_per_year,
        commission_s=settings.commission_s,
        unread_std_percent=settings.unread_std_percent,
    )
    return sequential.design(plant(site), doubt=load_doubt(site), step_s=settings.tick_s, options=options)


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
    design: exact_bank.MonitorDesign | sequential.SequentialDesign | set_search.SetSearchDesign,
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


def _ticks(name: str, summary: str, decoder: Decoder) -> Estimator:
    """Estimator that tests every tick by itself."""

    def make(site: Site, _: DesignOptions) -> sequential.SequentialDesign:
        settings = site.tables.meta.monitor
        return single_tick.design(
            plant(site),
            decoder,
            doubt=load_doubt(site),
            step_s=settings.tick_s,
            max_attacked=settings.max_attacked,
            alarms_per_year=settings.alarms_per_year,
        )

    return _of(sequential, name, summary, design=make)


class Families(Mapping[str, Estimator]):
    """Bundled estimators and those of other packages, which are loaded on first use."""

    def __init__(self, own: Iterable[Estimator]) -> None:
        self._known = {family.name: family for family in own}

    def __getitem__(self, name: str) -> Estimator:
        if name not in self._known and name in ESTIMATORS:
            self._known[name] = plugins.load(name, Estimator)
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(ESTIMATORS)

    def __len__(self) -> int:
        return len(ESTIMATORS)


FAMILIES: Final = Families(
    (
        replace(
            _of(
                sequential,
                SEQUENTIAL,
                "one switched observer, correlated loads, evidence on several time scales",
                design=_sequential,
            ),
            withstands=lambda d: int(d.max_attacked),
            bias_learning=BiasLearning(
                needed_s=lambda d: float(d.options.commission_s),
                init=lambda d, t, known: sequential.init(d, t, known.learned, known.learning),
                commission=lambda state: state.commission,
                renew=sequential.renew,
                read=sequential.from_arrays,
                progress=sequential.progress,
            ),
            warm_start=WarmStart(sequential.distrusted, sequential.warm_start),
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

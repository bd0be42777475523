"""Study of the droop fleet of a feeder: stability, voltage band, hosting capacity.

References: chong2020, (13), (16) to (18); docs/theory-studies.md, section on the droop fleet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd

from feeders.model.site import Site
from feeders.studies.droop.fleets import Equipped, box, chosen_fleet, equip, points, range_problem
from feeders.studies.droop.limits import (
    BandGuarantee,
    Conditions,
    DroopPlan,
    Safety,
    capacity,
    curve,
    draw,
    safety,
    shares_of,
    without_inverters,
)
from feeders.studies.droop.verdict import (
    FleetVerdict,
    StepResponse,
    Subject,
    edge,
    inverter_rows,
    judge,
    longest_interval,
    margin,
    simulate,
    step_rows,
    steps,
    trajectories,
    worst,
)
from feeders.studies.operating import Bases
from feeders.studies.running import Progress, Where, worked
from feeders.util import word
from gridsec.errors import InputInvalid, Problem, no_choice, raise_if_any
from gridsec.grid.devices import PRESETS, Droop
from gridsec.planning.droop.ac_sensitivity import InjectionBox
from gridsec.planning.droop.equilibrium import rest
from gridsec.planning.droop.stability import Update, enlarged

__all__ = ["DroopOptions", "DroopStudy", "droop", "presets_of"]


HOSTING: Final = {
    "hosting_presets": "--hosting-preset",
    "hosting_load": "--hosting-load",
    "hosting_customers": "--at",
    "unit_kw": "--unit-kw",
    "draws": "--draws",
}
"""Options of the search for hosting capacities only, with their names on the command line."""


@dataclass(frozen=True, slots=True)
class DroopOptions:
    """Options of the study.

    Raises ValueError with every option that is out of range or has no effect.
    """

    preset: str | None = None  # of all inverters; None: the feeder's own fleet
    who: Equipped = Equipped.PV  # customers that a preset equips
    interval_s: float = 1.0  # sampling of the inverters; 0: continuous
    dead: int = 0  # dead time, whole intervals
    v0_low: float = 1.0  # limits of the busbar voltage, pu; operating points have the middle
    v0_high: float = 1.0  # hosting has this one
    v_min: float | None = None  # band relative to the nominal voltage; None: that of the files
    v_max: float | None = None
    load_high: float = 1.0  # largest shares of the peaks in the box of all loads
    pv_high: float = 1.0
    presets: tuple[str, ...] = PRESETS  # to compare, each instead of the feeder's own
    tau_factors: tuple[float, ...] = (0.01, 0.1, 0.3, 1.0, 3.0)  # on all time constants, to compare
    hosting: bool = False  # search for hosting capacities
    hosting_presets: tuple[str, ...] = ("", "ieee1547-b")  # of new generation; empty: without reactive power
    hosting_load: float = 0.1  # relative to the peaks, 1
    hosting_customers: tuple[str, ...] | None = None  # None: those of the files, in proportion
    unit_kw: float = 5.0  # of generation at a random customer
    draws: int = 30  # random orders of customers

    def __post_init__(self) -> None:
        raise_if_any([*self._fleet_problems(), *self._limit_problems(), *self._hosting_problems()])

    def _fleet_problems(self) -> Iterator[str]:
        presets = [name for name in (self.preset, *self.presets) if name is not None]
        for name in dict.fromkeys([*presets, *filter(None, self.hosting_presets)]):
            if name not in PRESETS:
                text = f"preset {name!r} does not exist; expected one of {', '.join(PRESETS)}"
                yield Problem("unknown-name", text)
        yield from no_choice("`who`", Equipped, self.who)
        try:
            Update(self.interval_s, self.dead)
        except InputInvalid as error:
            yield from error.problems
        for times in self.tau_factors:
            if not 0.0 < times < math.inf:
                text = f"a factor on time constants is {times:g}; it must be a positive number"
                yield Problem("not-positive", text)

    def _limit_problems(self) -> Iterator[Problem]:
        yield from range_problem("busbar voltage", self.v0_low, self.v0_high)
        if self.v0_low == 0.0:
            yield Problem("not-positive", "the busbar voltage must be above 0 pu")
        if self.v_min is not None and self.v_max is not None:
            yield from band_problem(self.v_min, self.v_max)
        shares = {"load": self.load_high, "generation": self.pv_high, "load while hosting": self.hosting_load}
        for what, share in shares.items():
            if not 0.0 <= share < math.inf:
                text = f"share of the {what} is {share:g}; it must be a number that is not negative"
                yield Problem("negative", text)

    def _hosting_problems(self) -> Iterator[Problem]:
        if not 0.0 < self.unit_kw < math.inf:
            text = f"a unit of generation is {self.unit_kw:g} kW; it must be a positive number"
            yield Problem("not-positive", text)
        if self.draws < 0:
            yield Problem("negative", f"{self.draws} random orders; the number must not be negative")
        if self.hosting_customers == ():
            yield Problem("missing", "new generation has no customer")
        usual = {each.name: each.default for each in fields(self)}
        given = [
            f"{name} ({option})" for name, option in HOSTING.items() if getattr(self, name) != usual[name]
        ]
        if given and not self.hosting:
            yield Problem("inconsistent", f"{', '.join(given)}: only with hosting (--hosting)")


def band_problem(low: float, high: float) -> list[Problem]:
    """Problem of a band of voltages, relative to the nominal voltage; empty without one."""
    if 0.0 < low < high < math.inf:
        return []
    text = f"the band from {low:g} to {high:g} is empty; expected two ascending voltages, pu"
    return [Problem("order", text)]


ANY = "any loads"  # row for all loads within their limits


@dataclass(frozen=True, slots=True, eq=False)
class DroopStudy:
    """Result of `droop`."""

    feeder: str
    digest: str
    seed: int
    options: DroopOptions
    verdict: FleetVerdict  # with constant loads anywhere within their limits
    rest: BandGuarantee  # for slow load changes
    always: BandGuarantee  # for arbitrary load changes
    # - `stability`: a row for each operating point, and one for any loads. `verdict`, `proof`, `gain` (of the
    # loop at rest), `growth` (of a small deviation in one update), `margin` (all curves with the same limits
    # are stable up to this factor on their slopes), `slope_certified` and `slope_unstable` (factors on the
    # slopes of this fleet's curves: proven stable up to the first, equilibrium unstable from the second),
    # `size_certified` and `size_unstable` (the same with larger inverters), `longest_interval_s`,
    # `tau_factor` (admissible factor on all time constants), `why`. - `inverters`: `part` of the loop gain,
    # and `alone`, the admissible factor on one inverter's slope. - `steps`: `settling_s`,
    # `overshoot_percent`, `change_volt`, by AC simulation. - `trajectories`: the voltages of the steps. -
    # `band`: with and without the fleet, proof status, and extremes of the proven limits, V. - `customers`:
    # the proven limits of each customer's voltage, V. - `witness`: loads that violate the band, if found. -
    # `presets`, `time_constants`: verdict, margin, settling, overshoot, voltages of the worst customers. -
    # `hosting`, `hosting_curve`, `hosting_draws`: see `feeders.studies.droop.limits`; `hosting_probability`:
    # share of random orders in which this generation violates a limit. In three phases `inverters`,
    # `customers` and `witness` have a column `phase`.
    tables: dict[str, pd.DataFrame]


@dataclass(frozen=True, slots=True, eq=False)
class _Study:
    """Fleet on a feeder, with the options of the study."""

    subject: Subject
    fleet: Droop
    options: DroopOptions
    seed: int

    @property
    def update(self) -> Update:
        return Update(self.options.interval_s, self.options.dead)

    @property
    def v0(self) -> float:
        return 0.5 * (self.options.v0_low + self.options.v0_high)

    @property
    def limits(self) -> tuple[float, float]:
        given, own = self.options, self.subject.site.tables.meta.limits
        low = own.v_min_pu if given.v_min is None else given.v_min
        return low, own.v_max_pu if given.v_max is None else given.v_max

    @property
    def box(self) -> InjectionBox:
        given = self.options
        return box(
            self.subject.site,
            load_high=given.load_high,
            pv_high=given.pv_high,
            v0_low=given.v0_low,
            v0_high=given.v0_high,
        )


def droop(
    site: Site,
    options: DroopOptions | None = None,
    *,
    seed: int = 0,
    journal: Where = None,
    progress: Progress | None = None,
) -> DroopStudy:
    """Study the droop fleet of a feeder; by default its own, sampled once a second.

    `seed` is that of small deviations from equilibrium, and of the orders of generation.

    Raises NoInverters without inverters and without a preset; ValueError for an invalid band, or new
        generation at an unknown customer; OtherStudy, InUse as `feeders.studies.running.Journal`.
    """
    given = options or DroopOptions()
    study = _Study(Subject.of(site), chosen_fleet(site, given.preset, given.who), given, seed)
    raise_if_any(band_problem(*study.limits))  # one limit may be an option, and the other the file's
    subject = {"study": "droop", "digest": site.digest, "seed": seed, "options": asdict(given)}
    done = worked(journal, subject, _tasks(study), progress)
    tables = _tables(site, done)
    band = tables["band"].iloc[0]
    return DroopStudy(
        feeder=site.feeder.name,
        digest=site.digest,
        seed=seed,
        options=given,
        verdict=worst(tables["stability"]["verdict"]),
        rest=BandGuarantee(band["rest"]),
        always=BandGuarantee(band["always"]),
        tables=tables,
    )


Task = tuple[str, Callable[[], Any]]


def _tasks(study: _Study) -> Iterator[Task]:
    given, site = study.options, study.subject.site
    for name, at in points(site, study.v0).items():
        yield f"stability|{name}", partial(_stability, study, name, at)
    yield f"stability|{ANY}", partial(_any_loads, study)
    yield "inverters", partial(inverter_rows, study.subject, study.fleet, study.update, study.box, ANY)
    yield "steps", partial(_steps, study)
    yield "band|with the fleet", partial(_band, study, study.fleet)
    yield "band|without", partial(_band, study, without_inverters(study.fleet))
    for name in given.presets:
        yield f"presets|{name}", partial(_preset, study, name)
    for times in given.tau_factors:
        yield f"time_constants|{word(times)}", partial(_time_constant, study, times)
    if given.hosting:
        yield from _hosting_tasks(study)


def _stability(study: _Study, name: str, at: InjectionBox) -> dict[str, Any]:
    parts = study.subject, study.fleet, study.update, at
    found, longest = judge(*parts, seed=study.seed), longest_interval(*parts)
    tau = study.update.interval_s / longest if longest and study.update.interval_s else math.nan
    slope, size = edge(*parts), edge(*parts, enlarged)
    return {
        "point": name,
        **{key: value for key, value in asdict(found).items() if key != "why"},
        "margin": margin(*parts),
        "slope_certified": slope[0],
        "slope_unstable": slope[1],
        "size_certified": size[0],
        "size_unstable": size[1],
        "longest_interval_s": longest,
        "tau_factor": 0.0 if math.isinf(longest) else tau,
        "why": found.why,
    }


def _any_loads(study: _Study) -> dict[str, Any]:
    parts = study.subject, study.fleet, study.update, study.box
    return {"point": ANY, **asdict(judge(*parts)), "margin": margin(*parts)}


def _runs(study: _Study, fleet: Droop) -> dict[str, StepResponse]:
    """Step responses, each from equilibrium."""
    site, net, out = study.subject.site, study.subject.net, {}
    for name, step in steps(site, study.v0).items():
        x, _ = rest(net, fleet, step.before.p_low + 1j * step.before.q_low, step.before.v0_low)
        if np.isfinite(x).all():
            plant = (site, study.subject.flow)
            gain = judge(study.subject, fleet, study.update, step.after).gain
            gain = 0.0 if math.isnan(gain) else gain
            out[name] = simulate(plant, fleet, study.update, step.after, x, gain=gain)
    return out


def _steps(study: _Study) -> dict[str, Any]:
    site, runs = study.subject.site, _runs(study, study.fleet)
    return {
        "steps": step_rows(site, runs),
        "trajectories": trajectories(site, runs).to_dict(orient="list"),
    }


def _band(study: _Study, fleet: Droop) -> dict[str, Any]:
    found = safety(study.subject, fleet, study.box, study.limits)
    return asdict(found)


def _preset(study: _Study, name: str) -> dict[str, Any]:
    fleet = equip(study.subject.site, name, study.options.who)
    return {"feeder": study.subject.site.feeder.name, "preset": name, **_compared(study, fleet)}


def _time_constant(study: _Study, times: float) -> dict[str, Any]:
    fleet = replace(study.fleet, tau=times * study.fleet.tau)
    return {"tau_factor": times, "tau_s": float(np.median(fleet.tau)), **_compared(study, fleet)}


def _compared(study: _Study, fleet: Droop) -> dict[str, Any]:
    """Figures of one fleet for a comparison."""
    site, subject = study.subject.site, study.subject
    at = points(site, study.v0)
    told = [judge(subject, fleet, study.update, each, seed=study.seed) for each in at.values()]
    parts = [*told, judge(subject, fleet, study.update, study.box)]
    rows = step_rows(site, _runs(study, fleet))
    s = np.array([each.p_low + 1j * each.q_low for each in at.values()])
    low, high = Bases.of(site).extremes(np.abs(rest(subject.net, fleet, s, study.v0)[1]))
    kept: Safety = safety(subject, fleet, study.box, study.limits)
    return {
        "inverters": int(fleet.tau.size),
        "verdict": str(worst(each.verdict for each in parts)),
        "gain": max(each.gain for each in parts),
        "growth": max(each.growth for each in told),
        "margin": margin(subject, fleet, study.update, study.box),
        "settling_s": _most(rows, "settling_s"),
        "overshoot_percent": _most(rows, "overshoot_percent"),
        "v_low_volt": low,
        "v_high_volt": high,
        "band_rest": str(kept.rest),
        "band_always": str(kept.always),
    }


def _most(rows: list[dict[str, Any]], column: str) -> float:
    """Largest number in a column; NaN if one is unknown."""
    return float(np.max([row.get(column, math.nan) for row in rows], initial=0.0)) if rows else math.nan


# --- hosting --------------------------------------------------------------------------------------------


def _hosting_tasks(study: _Study) -> Iterator[Task]:
    given, site = study.options, study.subject.site
    low, high = study.limits
    at = Conditions(given.hosting_load, given.v0_high, low, high, study.update)
    share = shares_of(site, given.hosting_customers)
    for preset in given.hosting_presets:
        plan = DroopPlan(share, preset)
        yield f"hosting|{preset}", partial(capacity, study.subject, plan, at, seed=study.seed)
        yield f"hosting_curve|{preset}", partial(_curve, study, plan, at)
    for number in range(given.draws):
        for preset in given.hosting_presets:
            task = partial(draw, study.subject, preset, given.unit_kw, at, study.seed, number)
            yield f"hosting_draws|{preset}|{number}", task


def _curve(study: _Study, plan: DroopPlan, at: Conditions) -> list[dict[str, Any]]:
    """Hosting curve of 13 amounts, up to a third beyond the capacity without reactive power."""
    most = capacity(study.subject, replace(plan, preset=""), at)["capacity_kw"]
    return curve(study.subject, plan, list(np.linspace(0.0, 4.0 / 3.0 * most or 1.0, 13)), at)


def _probability(draws: pd.DataFrame) -> pd.DataFrame:
    """For every capacity found, the share of orders in which more generation violates a limit."""
    parts = []
    for preset, some in draws.groupby("preset", sort=False):
        kw = np.sort(some["capacity_kw"].to_numpy())
        share = np.arange(1, kw.size + 1) / kw.size
        parts.append(pd.DataFrame({"preset": preset, "capacity_kw": kw, "probability": share}))
    return pd.concat(parts, ignore_index=True)


# --- tables ---------------------------------------------------------------------------------------------


def _tables(site: Site, done: dict[str, Any]) -> dict[str, pd.DataFrame]:
    def rows(kind: str) -> list[Any]:
        return [value for key, value in done.items() if key.split("|")[0] == kind]

    bands = {key.split("|")[1]: value for key, value in done.items() if key.startswith("band|")}
    short = [name for name in Safety.__dataclass_fields__ if name not in {"rows", "witness"}]
    fleet = bands["with the fleet"]
    tables = {
        "stability": pd.DataFrame(rows("stability")),
        "inverters": pd.DataFrame(done["inverters"]),
        "steps": pd.DataFrame(done["steps"]["steps"]),
        "trajectories": pd.DataFrame(done["steps"]["trajectories"]),
        "band": pd.DataFrame(
            [{"case": k, **{name: band[name] for name in short}} for k, band in bands.items()]
        ),
        "customers": pd.DataFrame(fleet["rows"]),
        "witness": pd.DataFrame(fleet["witness"]),
        "presets": pd.DataFrame(rows("presets")),
        "time_constants": pd.DataFrame(rows("time_constants")),
    }
    if rows("hosting"):
        tables["hosting"] = pd.DataFrame([{"feeder": site.feeder.name, **row} for row in rows("hosting")])
        tables["hosting_curve"] = pd.DataFrame([row for part in rows("hosting_curve") for row in part])
    if rows("hosting_draws"):
        tables["hosting_draws"] = pd.DataFrame(rows("hosting_draws"))
        tables["hosting_probability"] = _probability(tables["hosting_draws"])
    _add_phases(site, [tables[name] for name in ("customers", "inverters", "witness")])
    return {name: table for name, table in tables.items() if len(table)}


def _add_phases(site: Site, tables: Sequence[pd.DataFrame]) -> None:
    """Add a column `phase` beside the customers, for customers of single phases."""
    of = {row.customer: row.phases for row in site.tables.customers}
    for table in tables:
        if len(table) and set(of.values()) != {"abc"}:
            phase = [of[str(name)] for name in table["customer"]]
            table.insert(list(table.columns).index("customer") + 1, "phase", phase)


def presets_of(
    sites: Sequence[Site],
    options: DroopOptions | None = None,
    *,
    seed: int = 0,
    journal: Where = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Table `presets` of several feeders, one below the other; arguments and errors as in `droop`."""
    given = options or DroopOptions()
    digests = [site.digest for site in sites]
    subject = {"study": "presets", "digests": digests, "seed": seed, "options": asdict(given)}

    def row(site: Site, name: str) -> dict[str, Any]:
        return _preset(_Study(Subject.of(site), equip(site, name, given.who), given, seed), name)

    tasks = (
        (f"{k}|{name}", partial(row, site, name)) for k, site in enumerate(sites) for name in given.presets
    )
    return pd.DataFrame(list(worked(journal, subject, tasks, progress).values()))

"""Campaign of simulated attacks on a feeder: identification, delay, shown voltages, tables.

The truth is full AC power flow with the droop inverters in closed loop, over days of profiles. Until its
onset a scenario equals the scene without an attack to the last bit. That part is monitored once, and each
scenario continues from the estimator's state. The truth is computed once for each scene; attacks on inverters
and false powers are simulated in full.

References: docs/studies.md; docs/theory-studies.md.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.stats import binomtest, chi2

from feeders.format.tables import FeederTables
from feeders.model.site import Site, from_tables
from feeders.registry import DesignedEstimator, design
from feeders.simulation.attacks import (
    LOAD_TRACES,
    AttackKind,
    Attacks,
    AttackSpec,
    NoSuchAttack,
    check_count,
    load_trace,
    on_devices,
    present_loads,
)
from feeders.simulation.plant import NoEquilibrium
from feeders.simulation.powerflow import PowerFlowDiverged
from feeders.simulation.scenario import Scenario
from feeders.simulation.trial import FrameTruth, Trial, frames
from feeders.studies.campaign.plan import CLEAN, CampaignCase, CampaignPlan, Place, Promise
from feeders.studies.running import Here, Progress, Runner, Where, run_pieces, versions
from gridsec.arrays import Bools, Floats, Ints
from gridsec.attack import (
    Attack,
    Bias,
    Coordinated,
    Reports,
    apply_all,
    load_pattern,
    manipulated,
    most_affected,
    reach,
)
from gridsec.errors import GridsecError, InputInvalid, Problem
from gridsec.estimators.front import Commission
from gridsec.grid.network import Power
from gridsec.interface import Decision, Frame

__all__ = [
    "Campaign",
    "NothingPlayed",
    "Prepared",
    "attacks",
    "campaign",
    "false_names",
    "grouped",
    "liars",
    "prepare",
    "risings",
    "scenarios",
    "watch",
]


def attacks(site: Site, plan: CampaignPlan, case: CampaignCase, honest: Scenario) -> Attacks:
    """Build the attacks of a scenario; `honest` is the scene without them.

    Raises NoSuchAttack for too few meters or inverters, or without a place for a false load.
    """
    kind, random = plan.kind(case.kind), np.random.default_rng(case.seed)
    there = check_count(site, kind.trick, case.liars)
    t_on = honest.start + case.onset_s
    t_off = honest.start + min(case.onset_s + plan.lying_s, plan.duration_s)
    lie = AttackSpec(kind.trick, case.liars, case.size)
    if kind.trick in LOAD_TRACES:
        loads, share = present_loads(site, honest, t_on), case.size / 100.0
        attack = load_trace(site, kind.trick, case.liars, share, random, loads=loads, t_on=t_on, t_off=t_off)
        return (attack,), ()
    if kind.trick is AttackKind.INVERTER:
        some = np.sort(random.choice(there, case.liars, replace=False)).astype(np.intp)
        return on_devices(site, lie, some, random.choice([-1.0, 1.0], some.size), t_on=t_on, t_off=t_off)
    for sizes in (kind.volts, *kind.together):
        if sizes and len(sizes) != there:
            raise NoSuchAttack(
                f"kind {kind.name!r} has sizes for {len(sizes)} meters of {there}", code="shape"
            )
    if kind.together:
        told = np.array(kind.together[int(random.integers(len(kind.together)))])
        some, signs = np.flatnonzero(told), random.choice([-1.0, 1.0], 1)
    else:
        told = np.array(kind.volts)
        some, signs = liars(site, case, random)
    if told.size:
        nominal = site.customer_nominal[site.meters[some]]
        return (Bias(some, t_on, t_off, case.size * signs * told[some] / nominal),), ()
    return on_devices(site, lie, some, signs, t_on=t_on, t_off=t_off, seed=int(random.integers(2**63)))


def liars(site: Site, case: CampaignCase, random: np.random.Generator) -> tuple[Ints, Floats]:
    """Choose the manipulated meters by a scenario's rule: k meters, ascending, and their signs.

    Raises NoSuchAttack if no load affects that number of meters.
    """
    p, count = site.meters.size, case.liars
    signs: Floats = random.choice([-1.0, 1.0], count)
    if case.place == Place.RANDOM:
        return np.sort(random.choice(p, count, replace=False)).astype(np.intp), signs
    R, X = (site.feeder.between(power) for power in Power)
    if case.place == Place.SENSITIVE:
        # Effect of loads with equal and independent uncertainty on each voltage.
        felt = np.sqrt((R**2).sum(axis=1) + (X**2).sum(axis=1))
        return most_affected(felt[site.meters], count), signs
    if case.place == Place.STREET:
        return _nearest(R, site.meters, int(random.integers(p)), count), signs
    v = np.ones(len(R))
    for customer in random.permutation(site.meters):
        ratio = 0.5 * float(site.loads.tan_min[customer] + site.loads.tan_max[customer])
        pattern = np.abs(load_pattern(R, X, int(customer), ratio, v)[site.meters])
        some = most_affected(pattern, count)
        if pattern[some].min() > 0.0:
            return some, np.full(count, signs[0])
    raise NoSuchAttack(f"{site.feeder.name} has no load with an effect on {count} meters")


def _nearest(R: Floats, meters: Ints, one: int, count: int) -> Ints:
    """A meter and those with the smallest resistance to it."""
    own = np.diagonal(R)[meters]
    apart = own[one] + own - 2.0 * R[meters[one], meters]
    apart[one] = -1.0
    return np.sort(np.argsort(apart, kind="stable")[:count]).astype(np.intp)


ERROR_PERCENTILE = 95.0

IMPOSSIBLE = (NoSuchAttack, PowerFlowDiverged, NoEquilibrium)  # they prevent one scenario only


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Common data of all scenes of a campaign."""

    site: Site
    plan: CampaignPlan
    stated: Site  # the feeder with the errors of loads and meters
    watchers: dict[float, DesignedEstimator]  # designed estimators by false-alarm rate
    learners: dict[float, DesignedEstimator]  # the same for the readings for learning; empty without


def prepare(site: Site, plan: CampaignPlan) -> Prepared:
    """Design the estimators of a campaign.

    Raises NotObservable, DesignInfeasible, EstimatorUnusable, FeederInvalid, ValueError if the estimator
        cannot monitor this feeder with these settings.
    """
    scene = plan.trial(site, plan.moment(0))
    watchers = _designed(plan, scene.stated)
    learners = _designed(plan, replace(scene, step_s=plan.learn_step_s).stated) if plan.learn_s else {}
    if any(watcher.bias_learning is None for watcher in learners.values()):
        raise InputInvalid(
            [Problem("inconsistent", f"{plan.estimator} does not learn its meters' fixed errors")]
        )
    return Prepared(site, plan, scene.stated, watchers, learners)


def _designed(plan: CampaignPlan, stated: Site) -> dict[float, DesignedEstimator]:
    return {rate: design(plan.watched(stated, rate)) for rate in plan.alarms_per_year}


def watch(given: Prepared, scene: int) -> list[dict[str, Any]]:
    """Simulate and monitor all scenarios of one scene.

    One row for each scenario and false-alarm rate, in plain JSON types; see `study.Campaign`.
    """
    plan, moment, cases = given.plan, given.plan.moment(scene), given.plan.cases(scene)
    trial = plan.trial(given.site, moment)
    honest = replace(trial.scenario, season=moment.season)
    head = {
        "scene": scene,
        "season": str(moment.season),
        "hour": moment.profile_s % 86_400.0 / 3600.0,
        "weekday": int(moment.profile_s // 86_400.0) % 7,
    }
    try:
        played = _Played.of(list(frames(trial, honest, stated=given.stated)))
        known = _learned(given, trial, honest) if plan.learn_s else {}
    except IMPOSSIBLE as error:
        return [_row(head, case, rate) | _nothing(error) for case in cases for rate in given.watchers]
    onsets = {round(case.onset_s / plan.step_s) for case in cases[1:]}
    clean, states = {}, {}
    for rate, watcher in given.watchers.items():
        begin = watcher.init(honest.start, known.get(rate))
        clean[rate], states[rate] = _monitored(watcher, begin, played.frames, onsets)
    rows = [_told(given, head, cases[0], rate, seen, played, 0, seen) for rate, seen in clean.items()]
    for case in cases[1:]:
        onset = round(case.onset_s / plan.step_s)
        try:
            lied = _lied(given, played, honest, case)
        except IMPOSSIBLE as error:
            rows += [_row(head, case, rate) | _nothing(error) for rate in given.watchers]
            continue
        for rate, watcher in given.watchers.items():
            seen, _ = _monitored(watcher, states[rate][onset], lied.frames[onset:])
            rows.append(_told(given, head, case, rate, seen, lied, onset, clean[rate]))
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class _Played:
    """Frames of a scenario, and the truth. T frames, N customers, p meters, m inverters."""

    frames: list[Frame]
    v2: Floats  # (T, N)
    liars: Bools  # (T, p)
    shift: Floats  # (T, p) reported minus honest voltage, pu
    inverters: Bools  # (T, m)

    @classmethod
    def of(cls, played: list[tuple[Frame, FrameTruth]]) -> _Played:
        return cls(
            [frame for frame, _ in played],
            np.array([truth.v2 for _, truth in played]),
            np.array([truth.liars for _, truth in played]),
            np.array([_shift(frame.y, truth.attack) for frame, truth in played]),
            np.array([truth.inverters for _, truth in played]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Output of an estimator. T frames."""

    named: Bools  # (T, p)
    inverters: Bools  # (T, m)
    clean: Bools  # (T,)
    undecided: Bools  # (T,)
    v2: Floats  # (T, N)


def _learned(given: Prepared, trial: Trial, honest: Scenario) -> dict[float, Commission]:
    """Fixed errors that estimators learn in the honest time before a scene."""
    learn_s, step_s = given.plan.learn_s, given.plan.learn_step_s
    # One frame more than required, and quasi-static inverters: they settle between two readings.
    before = replace(
        honest,
        start=honest.start - learn_s - step_s,
        profile_s=honest.profile_s - learn_s - step_s,
        duration_s=learn_s + step_s,
        dt_s=step_s,
        substep_s=step_s,
    )
    states = {rate: watcher.init(before.start) for rate, watcher in given.learners.items()}
    for frame, _ in frames(replace(trial, step_s=step_s), before):
        for rate, watcher in given.learners.items():
            states[rate], _, _ = watcher.step(states[rate], frame)
    learning = {rate: watcher.bias_learning for rate, watcher in given.learners.items()}
    return {rate: each.commission(states[rate]) for rate, each in learning.items() if each is not None}


def _monitored(
    watcher: DesignedEstimator, state: Any, some: list[Frame], onsets: Collection[int] = ()
) -> tuple[_Seen, dict[int, Any]]:
    """Monitor frames, and keep the states before those of the onsets."""
    states, outputs = {}, []
    for k, frame in enumerate(some):
        if k in onsets:
            states[k] = state
        state, estimate, verdict = watcher.step(state, frame)
        outputs.append((verdict.suspects, verdict.inverters, verdict.decision, estimate.v2))
    named, inverters, decisions, v2 = zip(*outputs, strict=True)
    clean = np.array([each is Decision.CLEAN for each in decisions], dtype=np.bool_)
    undecided = np.array([each is Decision.UNDECIDED for each in decisions], dtype=np.bool_)
    return _Seen(np.array(named), np.array(inverters), clean, undecided, np.array(v2)), states


# ------------------------------------------------------------------------------------------ reports


def _lied(given: Prepared, played: _Played, honest: Scenario, case: CampaignCase) -> _Played:
    """Scene with the attack of a scenario."""
    some, wrong = attacks(given.stated, given.plan, case, honest)
    if wrong or not all(_simple(attack, honest.start) for attack in some):
        trial = given.plan.trial(given.site, given.plan.moment(case.number // given.plan.together))
        lying = replace(honest, attacks=some, inverter_attacks=wrong)
        return _Played.of(list(frames(trial, lying, stated=given.stated)))
    t = np.array([frame.t for frame in played.frames])
    y = np.array([frame.y for frame in played.frames])
    # Attacks have sizes relative to the nominal voltage, as in scenarios; frames are relative to each place's
    # base.
    of_nominal = (given.site.customer_volt / given.site.customer_nominal)[given.site.meters]
    # The root of a rounded square is the number itself.
    v = np.sqrt(y) * of_nominal
    nothing = np.zeros_like(v)

    def past(when: Floats) -> Floats:
        # Half a microsecond of slack, as in scenarios: the difference of two times is rarely exact.
        row = np.floor((when - honest.start + 5e-7) / honest.dt_s).astype(np.intp)
        return np.asarray(v[row])

    told = apply_all(some, t, Reports(v, nothing, nothing), past).v
    lies = manipulated(some, t, v.shape[1])
    claimed = told / of_nominal
    y, some_lie = np.where(lies, claimed * np.abs(claimed), y), np.any(lies, axis=1).tolist()
    return replace(
        played,
        frames=[
            replace(frame, y=row) if lying else frame
            for frame, row, lying in zip(played.frames, y, some_lie, strict=True)
        ],
        liars=lies,
        shift=(told - v) / of_nominal,
    )


def _shift(y: Floats, attack: Floats) -> Floats:
    """Reported minus honest voltage, pu, from squared voltages."""
    return np.asarray(np.sqrt(y) - np.sqrt(y - attack))


def _simple(attack: Attack, start: float) -> bool:
    """True if only voltages are falsified, from readings of the scene itself."""
    powers = isinstance(attack, Coordinated) and bool(attack.p_shift.any() or attack.q_shift.any())
    return not powers and reach(attack, attack.t_on) <= attack.t_on - start


# --------------------------------------------------------------------------------------- results


def _row(head: dict[str, Any], case: CampaignCase, rate: float) -> dict[str, Any]:
    return {
        "scenario": case.number,
        **head,
        "alarms_per_year": rate,
        "kind": case.kind,
        "size": case.size,
        "liars": case.liars,
        "place": str(case.place),
        "onset_s": case.onset_s if case.kind != CLEAN else float("nan"),
        "reason": "",
    }


def _nothing(error: Exception) -> dict[str, Any]:
    """Remaining columns of a row without a simulation, with the reason."""
    nothing = dict.fromkeys(("delay_s", "clear_s", *_ERRORS), float("nan"))
    times = dict.fromkeys(("watched_s", "undecided_s", "clean_lying_s"), 0.0)
    counts = dict.fromkeys(("named", "false_events", "most_named"), 0)
    none = {"exact": False, "missed": "", "falsely_named": "", "because": "", "each": []}
    return {"reason": str(error)} | none | counts | times | nothing


_ERRORS = ("error_liars", "error_liars_95", "error_others", "error_others_95")


def _told(  # noqa: PLR0917  # one row needs all that is known of the case
    given: Prepared,
    head: dict[str, Any],
    case: CampaignCase,
    rate: float,
    seen: _Seen,
    played: _Played,
    begin: int,
    control: _Seen,
) -> dict[str, Any]:
    """One row: outcome of a scenario from frame `begin` on, and of the scene without the attack."""
    plan, site, step_s = given.plan, given.site, given.plan.step_s
    names = (*site.meter_ids, *(site.feeder.customers[k] for k in site.droop.customer))
    lies = np.hstack([played.liars[begin:], played.inverters[begin:]])
    named = _everybody(seen, lies)
    anyway: Bools = np.any(_everybody(control, lies), axis=0)
    because = named.any(axis=0) & ~anyway
    told = _each(played, begin, site, lies, named, anyway, names, step_s)
    # A name just after the attack is not false.
    wrong_names = named & ~np.logical_or.accumulate(lies, axis=0)
    false = wrong_names.any(axis=0)
    delays = np.array([one["delay_s"] for one in told])
    missed = [one["who"] for one in told if np.isinf(one["delay_s"])]
    lying: Bools = np.any(lies, axis=1)
    after = np.flatnonzero(lying)[-1] + 1 if lying.any() else len(lying)
    quiet = np.flatnonzero(~named[after:].any(axis=1))
    ended = after < len(lying)
    row = _row(head, case, rate) | {
        "exact": not missed and not false.any(),
        "named": len(told) - len(missed),
        "missed": " ".join(missed),
        "falsely_named": " ".join(np.array(names)[false]),
        "because": " ".join(np.array(names)[because]),
        "false_events": risings(wrong_names),
        "delay_s": float(delays.max()) if delays.size else float("nan"),
        "clear_s": (float(quiet[0] * step_s) if quiet.size else float("inf")) if ended else float("nan"),
        "most_named": int(named.sum(axis=1).max(initial=0)),
        "watched_s": len(lying) * step_s,
        "undecided_s": float(seen.undecided.sum() * step_s),
        "clean_lying_s": float((seen.clean & lying & ~named.any(axis=1)).sum() * step_s),
    }
    return row | _errors(plan, site, seen, played, begin, lies) | {"each": told}


def _everybody(seen: _Seen, lies: Bools) -> Bools:
    """Mask (T, p + m) of the meters and inverters named in the last frames."""
    # Estimators without inverter tests name none.
    inverters = np.zeros((len(seen.named), lies.shape[1] - seen.named.shape[1]), dtype=np.bool_)
    some = np.hstack([seen.named, seen.inverters if seen.inverters.shape[1] else inverters])
    return np.asarray(some[len(some) - len(lies) :], dtype=np.bool_)


def risings(flags: Bools) -> int:
    """Number of rises of any flag (T, k); all are down before the first row."""
    before = np.vstack([np.zeros((1, flags.shape[1]), dtype=np.bool_), flags[:-1]])
    return int(np.count_nonzero(flags & ~before))


def _each(  # noqa: PLR0917  # meters and inverters alike
    played: _Played,
    begin: int,
    site: Site,
    lies: Bools,
    named: Bools,
    anyway: Bools,
    names: tuple[str, ...],
    step_s: float,
) -> list[dict[str, Any]]:
    """One row for every manipulated device."""
    rows = []
    for j in np.flatnonzero(lies.any(axis=0)):
        lying = lies[:, j]
        caught = np.flatnonzero(named[:, j] & lying)
        delay = (caught[0] - np.argmax(lying)) * step_s if caught.size else np.inf
        inverter = bool(j >= site.meters.size)
        base = np.nan if inverter else site.customer_volt[site.meters[j]]
        volt = np.nan if inverter else np.abs(played.shift[begin:, j]).max() * base
        rows.append(
            {
                "who": names[j],
                "inverter": inverter,
                "lie_volt": float(volt),
                "delay_s": float(delay),
                "anyway": bool(anyway[j]),
            }
        )
    return rows


def _errors(  # noqa: PLR0917  # the same
    plan: CampaignPlan, site: Site, seen: _Seen, played: _Played, begin: int, lies: Bools
) -> dict[str, float]:
    """Errors of the voltage, % of nominal, at manipulated meters during the attack and elsewhere."""
    with np.errstate(invalid="ignore"):
        error = 100.0 * np.abs(np.sqrt(seen.v2) - np.sqrt(played.v2[begin:]))
    error *= site.customer_volt / site.customer_nominal
    error = np.where(np.isfinite(error), error, np.inf)
    lying: Bools = np.any(lies, axis=1)
    first = int(np.argmax(lying)) if lying.any() else 0
    use = np.arange(len(lying)) >= first + round(plan.settling_s / plan.step_s)
    at_liars = np.zeros(error.shape, dtype=np.bool_)
    at_liars[:, site.meters] = played.liars[begin:]
    out = {}
    for where, some in (("liars", at_liars & use[:, None]), ("others", ~at_liars & use[:, None])):
        values = error[some]
        out[f"error_{where}"] = float(np.max(values)) if values.size else float("nan")
        out[f"error_{where}_95"] = (
            float(np.percentile(values, ERROR_PERCENTILE, method="higher")) if values.size else float("nan")
        )
    return out


# --- Campaign and its tables ---


CONFIDENCE: Final = 0.95  # confidence level of every interval, 1
WITHIN_S: Final = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0)  # after the onset

YEAR_S: Final = 365.25 * 86_400.0


def scenarios(rows: Sequence[dict[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Tables of all scenarios, and of all manipulated devices, from the rows of `watch`."""
    kept = ("scenario", "alarms_per_year", "kind", "size", "liars", "place")
    each = [{name: row[name] for name in kept} | one for row in rows for one in row.get("each", ())]
    frame = pd.DataFrame([{name: cell for name, cell in row.items() if name != "each"} for row in rows])
    liars = pd.DataFrame(each, columns=[*kept, "who", "inverter", "lie_volt", "delay_s", "anyway"])
    return frame, liars.astype({"alarms_per_year": float, "delay_s": float})


def grouped(found: pd.DataFrame, liars: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """One row for each group of scenarios by false-alarm rate and columns; from the tables of `scenarios`."""
    keys = ["alarms_per_year", *by]
    tried = found[found["reason"] == ""]
    lied = dict(list(liars.groupby(keys, sort=True)))
    rows = []
    for key, group in tried.groupby(keys, sort=True):
        some = lied.get(key)
        delay = np.zeros(0) if some is None else some["delay_s"].to_numpy()
        named = np.isfinite(delay)
        lying = group["kind"] != CLEAN
        rows.append(
            dict(zip(keys, key, strict=True))
            | {"scenarios": len(group)}
            | _share("exact", int(group["exact"].sum()), len(group))
            | {"liars_told": delay.size}
            | _share("named", int(named.sum()), delay.size)
            | _share("false", int((group["falsely_named"] != "").sum()), len(group))
            | {
                "delay_median_s": float(np.median(delay[named])) if named.any() else np.nan,
                "delay_95_s": _most(delay[named]),
                "clear_median_s": _median(group["clear_s"][lying].to_numpy()),
                "error_liars_95": _median(group["error_liars_95"].to_numpy()),
                "error_liars_worst": float(group["error_liars"].max()),
                "error_others_95": _median(group["error_others_95"].to_numpy()),
                "error_others_worst": float(group["error_others"].max()),
                "undecided": float(group["undecided_s"].sum() / group["watched_s"].sum()),
            }
        )
    return pd.DataFrame(rows)


def delays(liars: pd.DataFrame) -> pd.DataFrame:
    """Share of the manipulated devices named within some time of their onset, by kind and size."""
    rows = []
    for key, group in liars.groupby(["alarms_per_year", "kind", "size"], sort=True):
        for within in WITHIN_S:
            named = int((group["delay_s"] <= within).sum())
            rows.append(
                dict(zip(("alarms_per_year", "kind", "size"), key, strict=True))
                | {"within_s": within}
                | _share("named", named, len(group))
            )
    return pd.DataFrame(rows)


def false_names(found: pd.DataFrame, liars: pd.DataFrame) -> pd.DataFrame:
    """Operating curve: false names per year without an attack, and share of manipulated devices named.

    Source: F. Garwood: Fiducial limits for the Poisson distribution. Biometrika 28, 1936.
    """
    rows = []
    for rate, group in found.groupby("alarms_per_year", sort=True):
        clean = group[(group["kind"] == CLEAN) & (group["reason"] == "")]
        years, events = clean["watched_s"].sum() / YEAR_S, int(clean["false_events"].sum())
        tail = 0.5 * (1.0 - CONFIDENCE)
        low = chi2.ppf(tail, 2 * events) / (2.0 * years) if events else 0.0
        lied = liars[liars["alarms_per_year"] == rate]
        rows.append(
            {
                "alarms_per_year": rate,
                "hours": years * YEAR_S / 3600.0,
                "false_names": events,
                "per_year": events / years,
                "per_year_low": float(low),
                "per_year_high": float(chi2.ppf(1.0 - tail, 2 * events + 2) / (2.0 * years)),
                "liars_told": len(lied),
            }
            | _share("named", int(np.isfinite(lied["delay_s"]).sum()), len(lied))
        )
    return pd.DataFrame(rows)


def promises(found: pd.DataFrame, liars: pd.DataFrame, promised: Mapping[str, Promise]) -> pd.DataFrame:
    """Outcome of attacks with a guarantee by their kind; columns as in `Campaign`.

    Attacks of a scene have loads and errors of meters in common; scenes are independent. So the limit is that
    of the scenes with a broken guarantee, each of which counts once. It is valid for the probability that an
    attack breaks it, for any dependence within a scene.
    """
    rows = []
    tried = found[(found["reason"] == "") & found["kind"].isin(list(promised))]
    columns = ["alarms_per_year", "scenario"]
    anyway = liars.loc[liars["anyway"].astype(bool), columns].drop_duplicates()
    by_chance = pd.MultiIndex.from_frame(tried[columns]).isin(pd.MultiIndex.from_frame(anyway))
    tried = tried.assign(promise=tried["kind"].map(promised), by_chance=by_chance)
    for (rate, promise), group in tried.groupby(["alarms_per_year", "promise"], sort=True):
        if promise is Promise.HIDDEN:
            lies, broken = group, group["because"] != ""
        else:
            lies = group[~group["by_chance"]]
            broken = lies["missed"] != ""
        scenes = broken.groupby(lies["scene"]).any()
        limits = _share("broken", int(scenes.sum()), len(scenes))
        rows.append(
            {
                "alarms_per_year": rate,
                "promise": str(promise),
                "lies": len(lies),
                "broken": int(broken.sum()),
                "by_chance": int(group["by_chance"].sum()),
                "honest_named": int((group["falsely_named"] != "").sum()),
                "scenes": len(scenes),
                "scenes_broken": int(scenes.sum()),
                "probability_high": limits["broken_high"],
            }
        )
    return pd.DataFrame(rows)


def _share(name: str, count: int, of: int) -> dict[str, float]:
    """Share, and its interval by Clopper and Pearson; NaN of nothing."""
    if not of:
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"), np.nan)
    limits = binomtest(count, of).proportion_ci(CONFIDENCE, method="exact")
    return {name: count / of, f"{name}_low": float(limits.low), f"{name}_high": float(limits.high)}


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    # One of the values, so that infinite ones remain.
    return float(np.percentile(known, 50.0, method="lower")) if known.size else np.nan


def _most(values: np.ndarray) -> float:
    return float(np.percentile(values, 95.0, method="higher")) if values.size else np.nan


ROWS: Final = 2  # version of the rows in journals


class NothingPlayed(GridsecError):
    """No scenario of a campaign could be simulated."""

    code = "nothing-played"


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """Results of all scenarios. Shares have limits `_low` and `_high`, Clopper and Pearson's at 95 %."""

    feeder: str
    digest: str
    plan: CampaignPlan
    versions: dict[str, str]  # of all libraries that numbers depend on
    # One row for each scenario and false-alarm rate: `scenario`, `scene`, `season`, `weekday` (0 is Monday),
    # `hour` of its begin; `alarms_per_year`; `kind`, `size`, `liars`, `place`, `onset_s`; `reason` for a
    # missing simulation, or empty; `exact`: all manipulated devices and no others were named; `named`, number
    # of manipulated devices named, `missed` and `falsely_named`, their names; `because`, devices named from
    # the onset on, and not in the same scene without the attack; `false_events`, number of times that an
    # honest meter or inverter became named; `delay_s` from the onset to the naming of the last manipulated
    # device; `clear_s` from the end of the attack until no device was named; `most_named` at once;
    # `watched_s`, `undecided_s`, and `clean_lying_s`, CLEAN during an attack; `error_liars` and
    # `error_others` of the reconstructed voltage at manipulated meters and elsewhere, the largest and (`_95`)
    # the 95th percentile, % of nominal, from `settling_s` after the onset on. Times of events that did not
    # occur are infinite; values without data are NaN.
    scenarios: pd.DataFrame
    # one row for each manipulated device: `who`, its id; `inverter`, true for inverters; `lie_volt`, the
    # largest displacement; `delay_s`; `anyway`, true if it is named without the attack too
    liars: pd.DataFrame
    # by_kind, by_size, by_place, by_liars: groups of scenarios: shares `exact` and `false` (an honest device
    # was named) of the scenarios, `named` of the manipulated devices; median and 95th percentile of the
    # delays of those named; median `_95` and `_worst` of the errors; share of the `undecided` time
    by_kind: pd.DataFrame
    by_size: pd.DataFrame
    by_place: pd.DataFrame
    by_liars: pd.DataFrame
    # operating curve: share of manipulated devices `named` within `within_s`, by kind and size
    delays: pd.DataFrame
    # operating curve: false names `per_year` without an attack, with Poisson limits at 95 %, and the share of
    # manipulated devices named, by `alarms_per_year`
    false_names: pd.DataFrame
    # attacks with a guarantee, one row for each `promise`: `lies`, the number of attacks; `broken`, attacks
    # to stay hidden with a device named because of them, or attacks to be named with a missed device;
    # `by_chance`, attacks with a device that is named without the attack too, which prove nothing and do not
    # count among those to be named; `honest_named`, scenarios with a false name; `scenes`, the number of
    # independent scenes, `scenes_broken` with a broken guarantee, and the upper limit of its probability,
    # Clopper and Pearson's at 95 %
    promises: pd.DataFrame

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""
        return self.plan.seed

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name."""
        names = ("by_kind", "by_size", "by_place", "by_liars", "delays", "false_names", "scenarios", "liars")
        tables: dict[str, pd.DataFrame] = {name: getattr(self, name) for name in names}
        return tables if self.promises.empty else {"promises": self.promises, **tables}


def campaign(
    site: Site,
    plan: CampaignPlan | None = None,
    *,
    seed: int | None = None,
    runner: Runner | None = None,
    journal: Where = None,
    progress: Progress | None = None,
) -> Campaign:
    """Run a campaign on a feeder; the result is the same for every runner.

    `seed` replaces the plan's. `progress` is called with (done, total) scenarios.

    Raises NotObservable, DesignInfeasible, EstimatorUnusable, FeederInvalid, ValueError if the estimator
        cannot monitor this feeder with these settings, or for an invalid plan; NothingPlayed if the power
        flow has no solution at any scene; OtherStudy, InUse, ClusterUnusable, WorkerLost as
        `feeders.studies.running.run_pieces`.
    """
    plan = CampaignPlan() if plan is None else plan
    plan = plan if seed is None else replace(plan, seed=seed)
    prepare(site, plan)  # errors of the plan occur here, not in a worker
    subject = {"study": "campaign", "rows": ROWS, "digest": site.digest, "plan": plan.subject}
    scenes = run_pieces(
        journal,
        subject,
        [f"scene|{scene}" for scene in range(plan.scenes)],
        partial(_scene, site.tables, plan),
        runner=runner or Here(),
        progress=None if progress is None else lambda done, _: progress(done * plan.together, plan.scenarios),
    )
    return _campaign(site, plan, [row for rows in scenes for row in rows])


@lru_cache(maxsize=1)
def _prepared(tables: FeederTables, plan: CampaignPlan) -> Prepared:
    """Designs of a campaign, made once in each process."""
    return prepare(from_tables(tables), plan)


def _scene(tables: FeederTables, plan: CampaignPlan, scene: int) -> list[dict[str, Any]]:
    """Simulate a scene in any process."""
    return watch(_prepared(tables, plan), scene)


def _campaign(site: Site, plan: CampaignPlan, rows: list[dict[str, Any]]) -> Campaign:
    if all(row["reason"] for row in rows):
        raise NothingPlayed(
            f"{site.feeder.name}: no scenario can be simulated; the first: {rows[0]['reason']}"
        )
    found, liars = scenarios(rows)
    by = {
        name: grouped(found, liars, columns)
        for name, columns in (
            ("by_kind", ["kind"]),
            ("by_size", ["kind", "size"]),
            ("by_place", ["kind", "place"]),
            ("by_liars", ["kind", "liars"]),
        )
    }
    return Campaign(
        feeder=site.feeder.name,
        digest=site.digest,
        plan=plan,
        versions=versions(),
        scenarios=found,
        liars=liars,
        **by,
        delays=delays(liars),
        false_names=false_names(found, liars),
        promises=promises(
            found, liars, {kind.name: kind.promise for kind in plan.kinds if kind.promise is not None}
        ),
    )

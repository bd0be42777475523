"""The setting of chong2020, section VII: a line feeder under voltage monitoring with manipulated meters.

The paper prints no numbers; feeder and attack are this project's. The corrected inequality (12) is solved for
every set J of at least N - 2M meters and verified without the solver. (8) and (20), corrected, are evaluated
twice: with the gains L_J, K_J of these solutions, and with direct injection L = 0, K = E_J.

Source: chong2020, sections V to VII; docs/errata/chong2020.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.integrate import solve_ivp

from gridsec.arrays import Floats, Ints
from gridsec.errors import InputInvalid
from gridsec.estimators.exact_bank import bank as banks
from gridsec.grid.devices import Droop, fleet
from gridsec.grid.radial import Feeder
from gridsec.observers.certificates import reactance
from gridsec.observers.gains import CircleGains, margin, options_for
from gridsec.observers.gains import stacked as in_one
from gridsec.observers.lmi import solve_many
from gridsec.observers.lure import Lure, close_loop, equilibrium, known_input
from gridsec.papers.claims import Claim, FigureCurve, Panel, PaperFigure, Reproduction, at_most, number

CUSTOMERS = 5
LIARS = 2
TIMES = np.linspace(0.0, 40.0, 401)
RATE = 0.25
"""Certified decay rate requested from (12), 1/s; the inverters' own rate is 0.46 1/s."""
METER_ERROR, LOAD_ERROR = 2e-4, 2e-3
"""Meter noise and load error in the objective of (12), squared pu; without load errors it gives L = K = 0."""
SETTLED = 1e-6
"""Error after 40 s below which the selected estimate counts as converged, pu."""

Design = Literal["(12)", "direct"]
"""Gains of the corrected (12), or direct injection L = 0, K = E_J."""
DESIGNS: tuple[Design, ...] = ("(12)", "direct")
GAINS = {"(12)": "L, K of (12)", "direct": "L = 0, K = E_J"}


@dataclass(frozen=True, slots=True, eq=False)
class Chong2020Feeder:
    """Feeder of the paper's Figure 2, per unit on 100 kVA and 230 V."""

    feeder: Feeder  # main line and service drops
    droop: Droop  # one inverter at each customer, all with the same time constant
    lure: Lure  # the closed loop (9), outputs and arguments in z
    w: Floats  # (N,) known input, constant


@cache
def setting(customers: int = CUSTOMERS) -> Chong2020Feeder:
    """Line of N customers on an overhead line, busbar at 0.97 pu, 6 kW and 2 kvar drawn by each."""
    base_volt, base_kva = 230.0, 100.0
    ohm = 3.0 * base_volt**2 / (1e3 * base_kva)
    main, drop = np.full(customers, 0.03), np.full(customers, 0.01)
    feeder = Feeder(
        name="line",
        parent=np.concatenate([np.arange(customers), np.arange(1, customers + 1)]),
        r=np.concatenate([main, 2.0 * drop]) / ohm,
        x=np.concatenate([main, drop]) / ohm,
        bus=np.arange(customers + 1, 2 * customers + 1),
        customers=tuple(f"customer {i + 1}" for i in range(customers)),
        buses=tuple(f"bus {i}" for i in range(2 * customers + 1)),
        base_volt=base_volt,
        base_kva=base_kva,
        charging=np.zeros(2 * customers),
    )
    every = np.arange(customers)
    droop = fleet(every, "ieee1547-b", np.full(customers, 20.0), base_kva)
    load = np.full(customers, 1.0 / base_kva)
    w = known_input(feeder.linear(), droop.vbar, -6.0 * load, -2.0 * load, 0.97**2)
    return Chong2020Feeder(feeder, droop, close_loop(feeder, droop, every), w)


def reported(z: Floats, vbar: float, alpha: Floats) -> Floats:
    """Reports `vbar^2 - (v + alpha)^2` of meters with the attack alpha on their voltage.

    `y = z + a`, `a = -2 v alpha - alpha^2`; the paper prints `2 v alpha - alpha^2`.

    z (…, N): True `vbar^2 - v^2`, pu.
    vbar: reference voltage, pu.
    alpha (…, N): attack on the voltage, pu.
    Source: chong2020 (14), and the attack signal of section VII.
    """
    v = np.sqrt(vbar**2 - z)
    return np.asarray(vbar**2 - (v + alpha) ** 2)


def attack(t: float) -> Floats:
    """Attack at time t: meter 2 drifts without bound; meter 5 swings by 8 % of the nominal voltage."""
    alpha = np.zeros(CUSTOMERS)
    alpha[1], alpha[4] = 0.04 + 0.02 * t, 0.08 * np.sin(t)
    return alpha


@dataclass(frozen=True, slots=True, eq=False)
class Chong2020Run:
    """Plant and all observers over time. T times, N customers, o observers."""

    t: Floats  # (T,) s
    x: Floats  # (T, N) True reactive injections, pu
    estimates: Floats  # (T, o, N) those of every observer
    chosen: Ints  # (T,) sigma(t) of (7), as the number of the set
    pi: Floats  # (T, s) (6)
    v2: Floats  # (T, N) squared voltages
    v2_estimate: Floats  # (T, N) by (19) corrected
    v2_reported: Floats  # (T, N) as reported

    @property
    def error(self) -> Floats:
        """`max_i |x_i - x_hat_i|` of the chosen estimate, (T,)."""
        picked = self.estimates[np.arange(len(self.t)), self.chosen]
        return np.asarray(np.abs(self.x - picked).max(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Observers:
    """Both banks with a proof for each observer. o observers, N customers."""

    bank: banks.Bank  # sets and gains
    # (o, N, N) `e_J^T P_J e_J` decays at least like `exp(-2 rate_J t)` while no meter of J is manipulated
    P: Floats
    rate: Floats  # (o,) 1/s


@cache
def solutions(customers: int = CUSTOMERS, liars: int = LIARS) -> dict[tuple[int, ...], CircleGains]:
    """Solve the corrected (12) for every set J of at least N - 2M meters.

    The solver's status is not used: `margin` rebuilds the inequality in NumPy.

    customers, liars: N and M.
    Returns the solutions with a positive margin, by the meters of J in rising order.
    Raises DesignInfeasible as `gridsec.observers.lmi.solve_many`.
    Source: chong2020 (12), corrected: docs/errata/chong2020.md.
    """
    lure = setting(customers).lure
    sizes = range(customers - 2 * liars, customers + 1)
    sets = [J for size in sizes for J in combinations(range(customers), size)]
    options = options_for(lure, rate=RATE, noise=METER_ERROR, load=np.full(customers, LOAD_ERROR))
    made = solve_many(lure, sets, options, workers=1)
    return {J: gains for J, gains in zip(sets, made, strict=True) if margin(lure, J, gains) > 0.0}


@cache
def observers(of: Design, customers: int = CUSTOMERS, liars: int = LIARS) -> Observers:
    """Both banks of section V for the line feeder, by one of two designs.

    of: "(12)": gains and P_J of `solutions`. "direct": L = 0, K = E_J, P = -H with the reactance certificate.
    customers, liars: N and M.
    """
    lure = setting(customers).lure
    masks = banks.subsets(customers, liars, most=10_000).masks()
    if of == "direct":
        proof = reactance(lure)
        gains = banks.direct_gains(lure, masks)
        P, rate = np.repeat(proof.P[None], len(masks), axis=0), np.full(len(masks), proof.rate)
    else:
        found = solutions(customers, liars)
        made = [found[tuple(np.flatnonzero(mask).tolist())] for mask in masks]
        gains = banks.Gains(*in_one(made, customers))
        P, rate = np.stack([one.P for one in made]), np.array([one.alpha for one in made])
    return Observers(banks.design(lure, liars, gains=gains), P, rate)


def observe(
    of: Chong2020Feeder,
    made: Observers,
    alpha: Callable[[float], Floats],
    *,
    x: Floats,
    start: Floats,
    times: Floats = TIMES,
) -> Chong2020Run:
    """Integrate plant and both banks (11) together, in continuous time, and select by (6) and (7).

    alpha: attack on the voltages at time t, (N,).
    x (N,): initial state of the plant.
    start (o, N): initial states of the observers, in the order of `bank.subsets(N, M).masks()`.
    times (T,): recorded times, s, from 0.
    """
    lure, w, vbar = of.lure, of.w, of.droop.vbar
    count, bank = len(w), made.bank
    gains = bank.gains
    if gains is None:
        raise InputInvalid.of("missing", "the bank needs explicit gains")
    L, K = gains.L, gains.K

    def field(t: float, flat: Floats) -> Floats:
        every = flat.reshape(-1, count)
        z = every @ lure.H.T + w
        residual = reported(z[0], vbar, alpha(t)) - z[1:]
        zeta = np.vstack([z[:1], z[1:] + np.einsum("oij,oj->oi", K, residual)])
        drift = every @ lure.A.T + lure.phi(zeta) @ lure.G.T
        drift[1:] += np.einsum("oij,oj->oi", L, residual)
        return np.asarray(drift.ravel())

    run = solve_ivp(
        field,
        (0.0, float(times[-1])),
        np.concatenate([x[None], start]).ravel(),
        t_eval=times,
        rtol=1e-8,
        atol=1e-11,
        max_step=0.25,
    )
    every = run.y.T.reshape(len(times), -1, count)
    truth, estimates = every[:, 0], every[:, 1:]
    pi = _consistency(bank, estimates)
    chosen = np.array([banks.select(row) for row in pi], dtype=np.intp)
    z = truth @ lure.H.T + w
    picked = estimates[np.arange(len(times)), chosen]
    said = reported(z, vbar, np.stack([alpha(t) for t in times]))
    return Chong2020Run(
        t=times,
        x=truth,
        estimates=estimates,
        chosen=chosen,
        pi=pi,
        v2=vbar**2 - z,
        v2_estimate=vbar**2 - (picked @ lure.H.T + w),
        v2_reported=vbar**2 - said,
    )


def _consistency(bank: banks.Bank, estimates: Floats) -> Floats:
    """Consistency (6) for several times at once, (T, s)."""
    sets = bank.sets
    large, small = estimates[:, : sets.count_large], estimates[:, sets.count_large :]
    gaps = np.stack([np.abs(small - large[:, parent]).max(axis=-1) for parent in sets.parent], axis=1)
    return np.asarray(gaps.reshape(len(estimates), -1)[:, sets.pairs].max(axis=-1))


def envelope(made: Observers, errors: Floats, t: Floats) -> Floats:
    """Right side of (8) with constants: `3 max_J sqrt(cond P_J) exp(-rate_J t) |e_J(0)|_2`.

    An observer without manipulated meters stays within a third of it, the selected estimate within all of it:
    docs/theory-detection.md, claim 1. The maximum is over all observers; (8) as printed omits it.

    errors (o, N): initial errors of all observers.
    t (T,): s.
    """
    values = np.linalg.eigvalsh(made.P)
    first = np.sqrt(values[:, -1] / values[:, 0]) * np.linalg.norm(errors, axis=1)
    return np.asarray(3.0 * (first * np.exp(-made.rate * t[:, None])).max(axis=1))


@cache
def under_attack(of: Design = "(12)") -> tuple[Chong2020Run, Floats, Floats]:
    """Setting of the paper with two of five meters manipulated: run, and envelopes of (8) and (20).

    The plant starts near its equilibrium, every observer at random within the inverters' limits.
    """
    at, made = setting(), observers(of)
    rng = np.random.default_rng(2020)
    x = equilibrium(at.lure, at.w, tol=1e-12, max_iter=200) + rng.uniform(-0.05, 0.05, CUSTOMERS)
    start = rng.uniform(-1.0, 1.0, (len(made.rate), CUSTOMERS)) * at.droop.limit
    run = observe(at, made, attack, x=x, start=start)
    state = envelope(made, start - x, run.t)
    return run, state, np.abs(at.lure.H).sum(axis=1).max() * state


def exact_start(of: Design = "(12)") -> Chong2020Run:
    """Counterexample to (8) as printed: the selected estimate starts exact, and has an error later.

    Three meters; meter 1 is manipulated from the start. The observers of {1, 2}, {1} and {2} start in the
    true state, so that {1, 2} is selected with error zero. The others start 0.05 pu off.
    """
    at, made = setting(3), observers(of, 3, 1)
    x = equilibrium(at.lure, at.w, tol=1e-12, max_iter=200)
    exact = ~made.bank.masks[:, 2]
    start = np.where(exact[:, None], x, x - 0.05)
    return observe(
        at,
        made,
        lambda t: np.array([-0.05 if t > 0.0 else 0.0, 0.0, 0.0]),
        x=x,
        start=start,
        times=TIMES[:101],
    )


def reproduce() -> Reproduction:
    """Bounds of the paper on its setting, for both designs of the observers."""
    sets = sum(
        1
        for size in range(CUSTOMERS - 2 * LIARS, CUSTOMERS + 1)
        for _ in combinations(range(CUSTOMERS), size)
    )
    claims = [
        number("sets J for which (12), corrected, holds", "Corollary 1", sets, len(solutions()), unit=1),
        *(claim for design in DESIGNS for claim in _design_claims(design)),
    ]
    return Reproduction("chong2020", tuple(claims), (_figure(),))


def _design_claims(of: Design) -> list[Claim]:
    """Return (8), (20), Theorem 2 and the counterexample to (8) as printed, for one design."""
    run, state, voltage = under_attack(of)
    off = np.abs(run.v2 - run.v2_estimate).max(axis=1)
    # The set of all meters is not a member of the bank; the largest sets with manipulated meters represent an
    # estimate without selection.
    large = run.pi.shape[1]
    masks = observers(of).bank.masks[:large]
    deceived = masks[:, 1] & masks[:, 4]
    worst = float(np.abs(run.estimates[-50:, :large][:, deceived] - run.x[-50:, None]).max())
    tail = float(run.error[-50:].max())
    named = f"gains {GAINS[of]}"
    why = "(8) bounds it by the error of the estimate selected first; the one selected later counts"
    return [
        at_most(f"|x - x_hat| over its envelope, {named}", "(8)", 1.0, float((run.error / state).max())),
        at_most(f"|v^2 - v_hat^2| over its envelope, {named}", "(20)", 1.0, float((off / voltage).max())),
        Claim(
            f"selected error after 35 s, {named}, pu",
            "Theorem 2",
            "converges",
            f"{tail:.0e}; observers with attacked meters {worst:.3f}",
            tail < SETTLED < worst,
        ),
        Claim(
            f"later error of the selected estimate when it starts exact, {named}, pu",
            "(8) (erratum)",
            0.0,
            float(exact_start(of).error.max()),
            met=False,
            why=why,
        ),
    ]


def _figure() -> PaperFigure:
    run = under_attack()[0]
    v, said, back = np.sqrt(run.v2), np.sqrt(run.v2_reported), np.sqrt(run.v2_estimate)
    voltages = [
        line
        for i in (1, 4)
        for line in (
            FigureCurve(f"customer {i + 1}, true", run.t, v[:, i]),
            FigureCurve(
                f"customer {i + 1}, reported", run.t, np.where(said[:, i] < 1.2, said[:, i], np.nan), "dotted"
            ),
            FigureCurve(f"customer {i + 1}, reconstructed", run.t, back[:, i], "dashed"),
        )
    ]
    panels = (
        Panel("Voltages of the two manipulated meters, gains of (12)", "t in s", "v in pu", tuple(voltages)),
        Panel(
            "Error of the selected state, decimal logarithm",
            "t in s",
            "log10 |x - x_hat| in pu",
            tuple(line for of in DESIGNS for line in _decay(of, "state")),
        ),
        Panel(
            "Error of the squared voltages, decimal logarithm",
            "t in s",
            "log10 |v² - v̂²| in pu",
            tuple(line for of in DESIGNS for line in _decay(of, "voltage")),
        ),
        Panel(
            "Selected set",
            "t in s",
            "number of the set",
            tuple(
                FigureCurve(GAINS[of], run.t, under_attack(of)[0].chosen.astype(np.float64), "steps")
                for of in DESIGNS
            ),
        ),
    )
    caption = (
        "Line feeder of section VII, five customers, two meters manipulated: the selected estimate converges."
    )
    return PaperFigure("chong2020-line", caption, panels)


def _decay(of: Design, what: Literal["state", "voltage"]) -> tuple[FigureCurve, FigureCurve]:
    """Return logarithms of an error of the selected estimate and of its envelope."""
    run, state, voltage = under_attack(of)
    tiny = 1e-12  # pu, keeps an error of exactly zero on the logarithmic axis
    error, limit = run.error, state
    if what == "voltage":
        error, limit = np.abs(run.v2 - run.v2_estimate).max(axis=1), voltage
    name = "(8)" if what == "state" else "(20)"
    return (
        FigureCurve(f"selected, {GAINS[of]}", run.t, np.log10(error + tiny)),
        FigureCurve(f"envelope {name}, {GAINS[of]}", run.t, np.log10(limit + tiny), "dashed"),
    )

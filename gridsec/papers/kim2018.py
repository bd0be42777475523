"""kim2018, section IV: constants, Lipschitz bounds, Table I, the switching sequence, Figure 1.

With `a = x1 - x2^3`, `b = x2`, `c = x3 - sin x2` the example is linear: `a' = -2 a + u`, `b' = -b + u`, `c' =
-c`, and `h = (a + b + c, a - c, b - a, c - b)`. Everything here can therefore be checked by hand, and the
true state is known in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from gridsec.arrays import Floats
from gridsec.observers.high_gain import (
    HighGainDesign,
    HighGainEstimate,
    Inverse,
    Partial,
    System,
    affine,
    defects,
    design,
    given,
    groups,
    init,
    nearest,
    redundancy,
    step,
)
from gridsec.observers.high_gain.constants import (
    Decay,
    decay_componentwise,
    decay_kim,
    settling,
    smallest_theta,
)
from gridsec.observers.high_gain.form import at, largest, slopes
from gridsec.observers.high_gain.intervals import Bracket
from gridsec.observers.high_gain.redundancy import upper_proven
from gridsec.papers.claims import (
    Claim,
    FigureCurve,
    Panel,
    PaperFigure,
    Reproduction,
    at_most,
    number,
    rounded_up,
    statement,
)

X_BOUND = 0.5
Z_BOUND = 2.0
NOISE = 1e-6
THETA = 32.0
STEP = 0.02
LIP_PHI = 7.0
LIP_INVERSE = 770.0
SIZES = (2, 2, 2, 1)
# The figure of the attacks is not in the available text; these sizes are chosen here. A constant
# attack of 5 on an output of size 1 keeps the residual above 5391 * 4.74e-4 = 2.56 while it lasts.
ATTACK = 5.0
START = (0.1, 0.1, -0.1)


def f(x: Sequence[Any]) -> list[Any]:
    """Drift of the example."""
    a, b, c = x
    return [-2.0 * a - b**3, -b, -b * np.cos(b) + np.sin(b) - c]


def g(x: Sequence[Any]) -> list[list[Any]]:
    """Input vector field, as three rows of one entry."""
    return [[1.0 + 3.0 * x[1] ** 2], [1.0 + 0.0 * x[1]], [np.cos(x[1])]]


def h(x: Sequence[Any]) -> list[Any]:
    """The four outputs."""
    a, b, c = x
    s = np.sin(b)
    return [a + b - b**3 - s + c, a + s - b**3 - c, -a + b**3 + b, -b - s + c]


def u(t: Floats | float) -> Floats:
    """The input, `0.25 sin(0.2 pi t) - 0.1`."""
    return np.asarray(0.25 * np.sin(0.2 * np.pi * np.asarray(t)) - 0.1)


def phi(x: Sequence[Any]) -> list[Any]:
    """The seven entries of Phi by (3); one entry of the printed list is wrong."""
    a, b, c = x
    s, cube = np.sin(b), b**3
    first = [a + b - cube - s + c, -2.0 * a + s - b + 2.0 * cube - c]
    second = [a + s - cube - c, -2.0 * a - s + 2.0 * cube + c]
    third = [-a + cube + b, 2.0 * a - b - 2.0 * cube]
    return [*first, *second, *third, -b - s + c]


def phi_printed(x: Sequence[Any]) -> list[Any]:
    """Phi as printed: `L_f h_2` also takes the place of `h_2` (erratum)."""
    rows = phi(x)
    return [*rows[:2], rows[3], *rows[3:]]


def _jacobian(x: Sequence[Any]) -> list[list[Any]]:
    b = x[1]
    cos, square = np.cos(b), b**2
    return [
        [1.0, 1.0 - 3.0 * square - cos, 1.0],
        [-2.0, cos - 1.0 + 6.0 * square, -1.0],
        [1.0, cos - 3.0 * square, -1.0],
        [-2.0, 6.0 * square - cos, 1.0],
        [-1.0, 3.0 * square + 1.0, 0.0],
        [2.0, -1.0 - 6.0 * square, 0.0],
        [0.0, -1.0 - cos, 1.0],
    ]


def _slice(
    function: Callable[[Sequence[Any]], list[Any]], start: int, stop: int
) -> Callable[[Sequence[Any]], Any]:
    return lambda x: function(x)[start:stop]


def system() -> System:
    """The decomposition: `alpha = -2 z1 - 3 z2` for the sensors of order 2, `-z1` for the last."""
    ends = np.cumsum([0, *SIZES])
    drives = ((2.0, -3.0), (1.0, -2.0), (0.0, 1.0), (-1.0,))
    parts = []
    for start, stop, drive in zip(ends[:-1].tolist(), ends[1:].tolist(), drives, strict=True):
        size = stop - start
        alpha = affine(0.0, [-2.0, -3.0] if size == 2 else [-1.0])
        beta = tuple((affine(value, [0.0] * size),) for value in drive)
        parts.append(Partial(_slice(phi, start, stop), _slice(_jacobian, start, stop), alpha, beta, Z_BOUND))
    return System(np.full(3, X_BOUND), tuple(parts))


def table() -> tuple[Callable[[Floats], Floats], ...]:
    """The four left inverses of Table I, as printed; from (…, 5) or (…, 6) to (…, 3)."""

    def first(z: Floats) -> Floats:
        z1, z2, z3, z4, _ = np.moveaxis(z, -1, 0)
        b = 2.0 * z3 + z4
        return np.stack([z3 + z4 + b**3, b, -2.0 * z1 - z2 + np.sin(b)], axis=-1)

    def second(z: Floats) -> Floats:
        z1, z2, z3, z4, z5 = np.moveaxis(z, -1, 0)
        b = 2.0 * z3 + z4
        return np.stack([-z1 - z2 + b**3, b, 0.5 * (2.0 * z1 + z2 + z5) + np.sin(b)], axis=-1)

    def third(z: Floats) -> Floats:
        z1, z2, z3, z4, z5 = np.moveaxis(z, -1, 0)
        b = 2.0 * z3 + z4 + z5
        return np.stack([-z1 - z2 - b**3, -b, -2.0 * z3 - z4 - np.sin(b)], axis=-1)

    def fourth(z: Floats) -> Floats:
        z1, z2, z3, z4, z5, z6 = np.moveaxis(z, -1, 0)
        b = 2.0 * z5 + z6
        return np.stack([-z1 - z2 + b**3, b, -2.0 * z3 - z4 + np.sin(b)], axis=-1)

    return first, second, third, fourth


# The state in terms of z_I: (a, b, c) = rows @ z_I. Table I uses exactly these rows.
ROWS: tuple[Floats, ...] = tuple(
    np.array(rows, dtype=np.float64)
    for rows in (
        [[0, 0, 1, 1, 0], [0, 0, 2, 1, 0], [-2, -1, 0, 0, 0]],
        [[-1, -1, 0, 0, 0], [0, 0, 2, 1, 0], [1, 0.5, 0, 0, 0.5]],
        [[-1, -1, 0, 0, 0], [0, 0, -2, -1, -1], [0, 0, -2, -1, 0]],
        [[-1, -1, 0, 0, 0, 0], [0, 0, 0, 0, 2, 1], [0, 0, -2, -1, 0, 0]],
    )
)


def inverse_rows(k: int) -> Callable[[Sequence[Any]], list[list[Any]]]:
    """Jacobian of the k-th left inverse of Table I, k = 0 to 3, over components, for interval bounds."""
    a, b, c = ROWS[k].tolist()

    def rows(z: Sequence[Any]) -> list[list[Any]]:
        level: Any = affine(0.0, b)(z)
        cube, cos = 3.0 * level**2, np.cos(level)
        return [
            [p + cube * q for p, q in zip(a, b, strict=True)],
            [q + 0.0 * level for q in b],
            [r + cos * q for r, q in zip(c, b, strict=True)],
        ]

    return rows


@cache
def lip_inverses() -> tuple[Bracket, ...]:
    """Lip^ of the four left inverses on `|z| <= 2`, proven."""
    ends = [np.full(rows.shape[1], Z_BOUND) for rows in ROWS]
    return tuple(upper_proven(inverse_rows(k), -end, end, gap=1e-9) for k, end in enumerate(ends))


@cache
def lip_phi() -> Bracket:
    """Lip^(Phi) on the box of states, proven."""
    box = np.full(3, X_BOUND)
    return upper_proven(_jacobian, -box, box)


def lowest() -> float:
    """Proven lower bound on Lip_(Phi_J) of all pairs J.

    `z_J = G_J (a, b, c)` with a full-rank G_J, and `x = (a + b^3, b, c + sin b)` has the constant 2 on
    `|b| <= 1/2`. So `1 / (2 |G_J^+|)`, with the pseudo-inverse as the left inverse of G_J.
    """
    blocks = _linear_blocks()
    worst = 0.0
    for group in groups(4, 2):
        inverse = np.linalg.pinv(np.concatenate([blocks[i] for i in group]))
        worst = max(worst, float(np.max(np.sum(np.abs(inverse), axis=1))))
    return 1.0 / (2.0 * worst)


def _linear_blocks() -> list[Floats]:
    outputs = np.array([[1, 1, 1], [1, 0, -1], [-1, 1, 0], [0, -1, 1]], dtype=np.float64)
    rates = np.array([-2.0, -1.0, -1.0])
    return [np.stack([row, row * rates])[:size] for row, size in zip(outputs, SIZES, strict=True)]


def printed_inverses(model: System) -> tuple[Inverse, ...]:
    """Table I, extended by saturation, with the paper's factor `1 + 7 * 770`, for `model` = `system()`."""
    factor = 1.0 + LIP_PHI * LIP_INVERSE
    return tuple(
        given(model, group, function, factor=factor, z_bound=Z_BOUND)
        for group, function in zip(groups(4, 1), table(), strict=True)
    )


def printed_design(search: Literal["all", "one"] = "one") -> HighGainDesign:
    """The paper's estimator.

    search: "one" set per sampling time, as in its simulation, or "all" at once, as in its theorem.
    """
    model = system()
    return design(
        model,
        printed_inverses(model),
        theta=THETA,
        noise=NOISE,
        max_attacked=1,
        u_low=-0.35,
        u_high=0.15,
        step_s=STEP,
        decay="kim2018",
        search=search,
        lowest=lowest(),
    )


def sharp_design(noise: float = NOISE) -> HighGainDesign:
    """The same example with nearest-point inverses and componentwise constants.

    noise: measurement error that the thresholds allow for, interpolation between samples included.
    """
    model = system()
    # Below every threshold of this design, so that it affects time only.
    enough = decay_componentwise(2, THETA, noise).epsilon
    return design(
        model,
        [nearest(model, group, accept=enough) for group in groups(4, 1)],
        whole=nearest(model, range(4), accept=enough),
        theta=THETA,
        noise=noise,
        max_attacked=1,
        u_low=-0.35,
        u_high=0.15,
        step_s=STEP,
        lowest=lowest(),
        substeps=2,
    )


def trajectory(t: Floats, start: Sequence[float] = START) -> Floats:
    """The true state at times t (…), s, in closed form; (…, 3)."""
    w = 0.2 * np.pi
    a0, b0, c0 = start[0] - start[1] ** 3, start[1], start[2] - np.sin(start[1])

    def driven(rate: float, initial: float) -> Floats:
        forced = 0.25 * (rate * np.sin(w * t) - w * np.cos(w * t)) / (rate**2 + w**2) - 0.1 / rate
        at_zero = -0.25 * w / (rate**2 + w**2) - 0.1 / rate
        return np.asarray(forced + (initial - at_zero) * np.exp(-rate * t))

    a, b, c = driven(2.0, a0), driven(1.0, b0), c0 * np.exp(-t)
    return np.stack([a + b**3, b, c + np.sin(b)], axis=-1)


def attacks(t: Floats, size: float = ATTACK) -> Floats:
    """Scenario of Figure 1(a): attack on sensor 3 in [6, 8], then on sensor 2 in [17, 20]; (…, 4).

    t (…): times, s.
    size: height of the two pulses; the paper's is not in the text.
    """
    out = np.zeros((*t.shape, 4))
    out[..., 2] = size * ((t >= 6.0) & (t <= 8.0))
    out[..., 1] = size * ((t >= 17.0) & (t <= 20.0))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Kim2018Run:
    """A simulation. k instants, N entries of z."""

    t: Floats  # (k,) times, s
    x: Floats  # (k, 3) True states
    z: Floats  # (k, 7) estimates of the partial observers
    attack: Floats  # (k, 4) attack on the outputs
    outcomes: tuple[HighGainEstimate, ...]  # results, one for each instant

    @property
    def sigma(self) -> Floats:
        """Number of the set in use, from 1 as in the paper; (k,)."""
        return np.array([outcome.sigma + 1 for outcome in self.outcomes], dtype=np.float64)

    @property
    def estimates(self) -> Floats:
        """Estimated states, (k, 3)."""
        return np.array([outcome.x for outcome in self.outcomes])


def simulate(
    made: HighGainDesign,
    attack: Callable[[Floats], Floats] = attacks,
    *,
    seconds: float = 25.0,
    seed: int = 1,
    deviation: float | None = None,
) -> Kim2018Run:
    """The paper's simulation: 25 s in steps of 0.02 s, noise uniform within 1e-6.

    attack: attacks (k, 4) as a function of the times (k,).
    deviation: if given, the noise is Gaussian with this standard deviation (lee2018).
    """
    t = np.asarray(STEP * np.arange(round(seconds / STEP) + 1), dtype=np.float64)
    x, added = trajectory(t), attack(t)
    clean = np.stack(np.broadcast_arrays(*h(list(x.T))), axis=-1)
    rng = np.random.default_rng(seed)
    noise = (
        rng.uniform(-NOISE, NOISE, added.shape)
        if deviation is None
        else rng.normal(0.0, deviation, added.shape)
    )
    y = clean + added + noise
    seen = np.ones(4, dtype=np.bool_)
    state = init(made, 0.0, y[0], u(t[0]))
    estimates, outcomes = [], []
    for k in range(1, len(t)):
        state, outcome = step(made, state, y[k], u(t[k]), seen, STEP)
        estimates.append(state.z[made.system.mask])
        outcomes.append(outcome)
    return Kim2018Run(t[1:], x[1:], np.array(estimates), added[1:], tuple(outcomes))


def switching(run: Kim2018Run, start: float, stop: float) -> str:
    """Sets in use from `start` to `stop`, s, as in "1 -> 2 -> 3"."""
    inside = run.sigma[(run.t >= start) & (run.t < stop)].astype(int)
    kept = [inside[0], *(b for a, b in pairwise(inside.tolist()) if a != b)]
    return " -> ".join(str(value) for value in kept)


def constants() -> Decay:
    """eta, eps and rate of the sensors of order 2, by the paper's derivation."""
    return decay_kim(2, THETA, NOISE)


def reproduce() -> Reproduction:
    """Constants, Lipschitz bounds, Table I, the switching sequence and Figure 1."""
    model = system()
    made = printed_design()
    run = simulate(made)
    claims = (*_constant_claims(model, made), *_table_claims(model), *_simulation_claims(made, run))
    return Reproduction("kim2018", claims, (_figure(made, run),))


def _constant_claims(model: System, made: HighGainDesign) -> list[Claim]:
    decay, place = constants(), "section IV"
    box = np.full(3, X_BOUND)
    size = max(largest(part.phi, box) for part in model.partials)
    points = np.random.default_rng(0).uniform(-X_BOUND, X_BOUND, (500, 3))
    off = float(np.max(defects(model, f, g, h, points)))
    two = redundancy(model, 2)
    proven = f"Lip_(Phi_J) >= {lowest():.4f} for all pairs (sampled: {two.injective:.3f})"
    ranges = [slopes(part, np.array([-0.35]), np.array([0.15])) for part in model.partials]
    star = max(smallest_theta(part) for part in ranges)
    inverse = max(bracket.upper for bracket in lip_inverses())
    return [
        rounded_up(
            "2 M_z eta, transient of the threshold", place, 671.0, 2.0 * Z_BOUND * decay.eta, unit=1.0
        ),
        rounded_up("eps, rest of the threshold", place, 4.74e-4, decay.epsilon, unit=1e-6),
        number("decay rate theta / 8, 1/s", place, 4.0, decay.rate, unit=1.0),
        rounded_up("Delta > Delta_1 + Delta_2, s", place, 8.37, sum(settling(decay, Z_BOUND)), unit=0.01),
        at_most(
            "theta from which on Lemma 1 is proven here (sufficient; 32 is used)", "Lemma 1", THETA, star
        ),
        at_most("largest entry of z", place, Z_BOUND, size),
        at_most("Lip^(Phi)", place, LIP_PHI, lip_phi().upper),
        number("largest Lip^ of the left inverses", place, LIP_INVERSE, inverse, unit=1.0),
        Claim("N = (2, 2, 2, 1) decomposes the system", "(2), (3)", "yes", f"defect {off:.1e}", off < 1e-8),
        Claim("2-redundant observability", "Definition 1", "yes", proven, lowest() > 0.0),
        number("factor of the threshold", place, 5391.0, made.inverses[0].factor, unit=1.0),
    ]


def _table_claims(model: System) -> list[Claim]:
    points = np.random.default_rng(1).uniform(-X_BOUND, X_BOUND, (2000, 3))
    out = []
    for k, (group, function) in enumerate(zip(groups(4, 1), table(), strict=True)):
        off = float(np.max(np.abs(function(model.phi(points, group)) - points)))
        text = f"misses x by {off:.0e}"
        out.append(Claim(f"left inverse of Lambda({k + 1})", "Table I", "left inverse", text, off < 1e-12))
    differ = np.max(np.abs(at(phi, points) - at(phi_printed, points)), axis=0)
    rows = " ".join(str(row + 1) for row in np.flatnonzero(differ > 1e-9))
    ours = f"row {rows} is x1 + sin x2 - x2^3 - x3" if rows else "no row differs"
    printed = "row 3 is -2 x1 - sin x2 + 2 x2^3 + x3"
    why = "the row below it stands in its place; only with ours are all functions of Table I left inverses"
    what = "entries of Phi(x) (erratum: one row is printed twice)"
    out.append(Claim(what, "section IV", printed, ours, not rows, why))
    return out


def _simulation_claims(made: HighGainDesign, run: Kim2018Run) -> list[Claim]:
    place = "section IV, Figure 1"
    error = np.max(np.abs(run.estimates - run.x), axis=1)
    quiet = ((run.t > 3.0) & (run.t < 6.0)) | ((run.t > 6.5) & (run.t < 17.0)) | (run.t > 17.5)
    third = _third(made, run)
    first, second = (run.t >= 6.0) & (run.t <= 8.0), (run.t >= 17.2) & (run.t <= 20.0)
    apart = f"{third[first].max():.0e} on [6, 8], {third[second].max():.1f} on [17, 20]"
    met = bool(third[first].max() < 1e-3 and third[second].max() > 0.1)
    return [
        at_most("largest entry of x", place, X_BOUND, float(np.max(np.abs(run.x)))),
        statement("sets in use after 6 s", place, "1 -> 2 -> 3", switching(run, 5.9, 16.9)),
        statement("sets in use after 17 s", place, "3 -> 4 -> 1 -> 2", switching(run, 16.9, 25.1)),
        Claim(
            "estimate recovers after each search",
            place,
            "yes",
            f"error {error[quiet].max():.0e} outside of the searches",
            bool(error[quiet].max() < 1e-3),
        ),
        Claim("without switching (set 3): right on [6, 8], wrong on [17, 20]", place, "yes", apart, met),
    ]


def _third(made: HighGainDesign, run: Kim2018Run) -> Floats:
    """Error of the estimate by the third set alone, (k,)."""
    inverse = made.inverses[2]
    estimate = inverse(run.z[:, made.system.pick(inverse.sensors)])
    return np.asarray(np.max(np.abs(estimate - run.x), axis=1))


def _figure(made: HighGainDesign, run: Kim2018Run) -> PaperFigure:
    inverse = made.inverses[2]
    third = inverse(run.z[:, made.system.pick(inverse.sensors)]) - run.x
    error = run.estimates - run.x
    waves = tuple(FigureCurve(f"a{i + 1}", run.t, run.attack[:, i], "steps") for i in range(4))
    return PaperFigure(
        "kim2018-figure-1",
        "Sensor 3 is attacked on [6, 8] s and sensor 2 on [17, 20] s; the search leaves each out in turn",
        (
            Panel("(a) attacks", "t in s", "a(t)", waves),
            Panel("(b) set in use", "t in s", "sigma(t)", (FigureCurve("", run.t, run.sigma, "steps"),)),
            Panel("(c) error with switching", "t in s", "xhat - x", _components(run.t, error)),
            Panel("(d) error of the third set alone", "t in s", "xhat - x", _components(run.t, third)),
        ),
    )


def _components(t: Floats, values: Floats) -> tuple[FigureCurve, ...]:
    return tuple(FigureCurve(f"x{k + 1}", t, values[:, k]) for k in range(values.shape[1]))

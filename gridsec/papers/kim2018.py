"""kim2018, section IV: constants, Lipschitz bounds, Table I, the switching sequence, Figure 1."""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Floats
from gridsec.observers.high_gain import HighGainDesign, System, defects, groups, redundancy
from gridsec.observers.high_gain.constants import settling, smallest_theta
from gridsec.observers.high_gain.form import at, largest, slopes
from gridsec.papers.claims import (
    Claim,
    Figure,
    Line,
    Panel,
    Reproduction,
    at_most,
    number,
    rounded_up,
    statement,
)
from gridsec.papers.uniformly_observable import (
    LIP_INVERSE,
    LIP_PHI,
    THETA,
    X_BOUND,
    Z_BOUND,
    Run,
    constants,
    f,
    g,
    h,
    lip_inverses,
    lip_phi,
    lowest,
    phi,
    phi_printed,
    printed_design,
    simulate,
    switching,
    system,
    table,
)


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


def _simulation_claims(made: HighGainDesign, run: Run) -> list[Claim]:
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


def _third(made: HighGainDesign, run: Run) -> Floats:
    """Error of the estimate by the third set alone, (k,)."""
    inverse = made.inverses[2]
    estimate = inverse(run.z[:, made.system.pick(inverse.sensors)])
    return np.asarray(np.max(np.abs(estimate - run.x), axis=1))


def _figure(made: HighGainDesign, run: Run) -> Figure:
    inverse = made.inverses[2]
    third = inverse(run.z[:, made.system.pick(inverse.sensors)]) - run.x
    error = run.estimates - run.x
    waves = tuple(Line(f"a{i + 1}", run.t, run.attack[:, i], "steps") for i in range(4))
    return Figure(
        "kim2018-figure-1",
        "Sensor 3 is attacked on [6, 8] s and sensor 2 on [17, 20] s; the search leaves each out in turn",
        (
            Panel("(a) attacks", "t in s", "a(t)", waves),
            Panel("(b) set in use", "t in s", "sigma(t)", (Line("", run.t, run.sigma, "steps"),)),
            Panel("(c) error with switching", "t in s", "xhat - x", _components(run.t, error)),
            Panel("(d) error of the third set alone", "t in s", "xhat - x", _components(run.t, third)),
        ),
    )


def _components(t: Floats, values: Floats) -> tuple[Line, ...]:
    return tuple(Line(f"x{k + 1}", t, values[:, k]) for k in range(values.shape[1]))

"""Codes of errors: docs/error-codes.md against the source, and a sentence for each code of gridsec."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import feeders
import gridsec
from gridsec.arrays import not_negative
from gridsec.attack import Bias, Replay, Stuck, coordinate
from gridsec.estimators import exact_bank, windowed
from gridsec.estimators.distributed import Message
from gridsec.estimators.exact_bank import bank
from gridsec.estimators.front import FrontOptions, LoadDoubt
from gridsec.estimators.plant import Options
from gridsec.grid.devices import Droop, fleet, preset
from gridsec.grid.meshed import MeshedFeeder
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import ThreePhaseFeeder
from gridsec.observers import circle, luenberger
from gridsec.observers.certificates import certify
from gridsec.observers.design_archive import from_bytes
from gridsec.observers.gains import refuse_blind
from gridsec.observers.high_gain import given as given_inverse
from gridsec.observers.high_gain import linear
from gridsec.observers.high_gain.form import decompose
from gridsec.observers.high_gain.redundancy import check, corners_and_interior
from gridsec.observers.lmi import options_for
from gridsec.observers.lmi.discrete import discrete_contraction
from gridsec.observers.lmi.sampled import DiscreteLure
from gridsec.observers.lmi.solver import group_pursuit
from gridsec.observers.lure import close_loop
from gridsec.observers.unknown_input import exact
from gridsec.papers import kim2018, yang2021
from gridsec.planning.droop.stability import Update
from gridsec.planning.protection import fewest_protected
from gridsec.secure.decode import Stack, gaussian, stacks
from gridsec.secure.decode.noise import bound_for
from gridsec.secure.subsets import subsets
from tests.gridsec.plants import line
from tests.gridsec.radial import random_feeder
from tests.gridsec.street import accuracy, make_plant
from tests.gridsec.unbalanced import random_three_phase
from tests.sentences import codes_in, golden, sentences, uncoded, used

PACKAGES = [Path(package.__file__).parent for package in (gridsec, feeders)]
PAGE = PACKAGES[0].parent / "docs" / "error-codes.md"
GOLDEN = Path(__file__).parent / "golden" / "errors.txt"
ROW = re.compile(r"^\| `([a-z-]+)` \| (.+) \|$", re.MULTILINE)
CODE = re.compile(r"[a-z]+(-[a-z]+)*")
WHO = np.array([0, 1])


def listed() -> list[str]:
    """Codes of the page, row by row."""
    return [match[1] for match in ROW.finditer(PAGE.read_text("utf-8"))]


def test_literals_are_found() -> None:
    source = """
Problem("a" if x == "no" else "b", "text")
errors.Problem("c", f"{x}")
Problem(one.code, "no")
raise Other("no", code="d")
def f(x, *, code: str = "e", other: str = "no"): ...
class Other:
    code = "f"
    other = "no"
"""
    assert codes_in(source) == {"a", "b", "c", "d", "e", "f"}


def test_errors_without_codes_are_found() -> None:
    source = """
raise ValueError("no")
raise GridsecError("no") from error
raise FeederInvalid(["no", *problems])
raise RecordingInvalid(f"{path}: no")
raise FeederInvalid(f"{each}" for each in problems)
raise GridsecError("yes", code="a")
raise FeederInvalid([Problem("a", "yes"), *problems])
raise InputInvalid(problems)
raise Other("yes")
"""
    assert uncoded(source) == [2, 3, 4, 5, 6]


def test_the_page_lists_the_codes_of_the_source() -> None:
    assert listed() == sorted(set().union(*map(used, PACKAGES)))
    assert all(CODE.fullmatch(code) for code in listed())


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_every_error_has_a_code(package: Path) -> None:
    found = {str(path): uncoded(path.read_text("utf-8")) for path in package.rglob("*.py")}
    assert {path: lines for path, lines in found.items() if lines} == {}


def far_apart() -> Any:
    """Two inverters at one line with time constants of 0.2 s and 20 s."""
    feeder = Feeder(
        name="street", parent=np.array([0, 1]), r=np.full(2, 0.01), x=np.full(2, 0.02), bus=np.array([1, 2]),
        customers=("near", "far"), buses=("0", "1", "2"), base_volt=230.0, base_kva=100.0,
        charging=np.zeros(2),
    )  # fmt: skip
    droop = fleet(WHO, "ieee1547-b", np.full(2, 5000.0), 100.0, tau=np.array([0.2, 20.0]))
    return close_loop(feeder, droop, WHO)


def sampled(A: float, lower: float = 0.0) -> DiscreteLure:
    return DiscreteLure.of([[A]], [[1.0]], G=[[1.0]], H=[[1.0]], phi=np.tanh, lower=lower, upper=1.0)


def three_phases(**changes: Any) -> ThreePhaseFeeder:
    return replace(random_three_phase(1, charging=0.0), **changes)


def changed_block(row: int, column: int, value: float) -> Any:
    z = random_three_phase(1, charging=0.0).z.copy()
    z[0, row, column] += value
    return z


def broken_feeder() -> Feeder:
    good = random_feeder(7, customers=3)
    r = np.array([-1.0, *good.r[1:]])
    return replace(good, r=r, bus=np.array([0, 99, -1]), base_kva=0.0, customers=("a", "a", "b"))


def broken_fleet() -> Droop:
    v, q = np.array([[0.9, 0.98, 1.02, 1.1]] * 3), np.array([[0.1, 0.0, 0.0, -0.1]] * 3)
    v[1] = v[1, ::-1]
    q[2, 0] = np.inf
    return Droop(np.arange(3), v, q, np.array([0.0, 1.0, -1.0]))


def late_parent() -> Feeder:
    feeder = random_feeder(3)
    return replace(feeder, parent=np.array([*feeder.parent[:-1], feeder.parent.size]))


def foreign_gains() -> Any:
    """Gains from all meters for observers of two and of one."""
    lure = line(3).lure
    given = bank.direct_gains(lure, subsets(3, 1, most=1000).masks())
    return bank.design(lure, 1, gains=replace(given, K=np.ones_like(given.K)))


def absent_phase() -> Any:
    """Self-impedance of a phase that a line of a single phase lacks."""
    feeder = random_three_phase(1, charging=0.0)
    k, phase = np.argwhere(~feeder.phases[1:])[0]
    z = feeder.z.copy()
    z[k, phase, phase] = 0.1
    return replace(feeder, z=z)


def rising() -> Droop:
    v, q = np.array([[0.9, 0.98, 1.02, 1.1]]), np.array([[0.1, 0.2, 0.0, -0.1]])
    return Droop(np.array([0]), v, q, np.array([2.0]))


def symbolic(kind: str) -> Any:
    """Refusals of the symbolic decomposition; x1 depends on the input, or only where x1 is positive."""
    sympy = pytest.importorskip("sympy", reason="sympy is not installed; this sentence is not tested")
    a, b = sympy.symbols("a b")
    if kind == "hidden":
        return decompose([b, -b], [[b], [0]], [a], [a, b], x_bound=1.0)
    half = sympy.Piecewise((b * a**2, a > 0), (0, True))
    return decompose([half, -b], [0, 0], [a], [a, b], x_bound=1.0)


def no_left_inverse() -> Any:
    model = kim2018.system()
    wrong = given_inverse(model, (1, 2, 3), lambda z: 0.0 * z[..., :3], factor=1.0)
    return check(model, wrong, corners_and_interior(model), tolerance=1e-6)


def unstable() -> Any:
    bounds = luenberger.Bounds(0.1, np.array([0.1]), np.eye(2))
    A, B, C = np.diag([1.1, 0.5]), np.zeros((2, 1)), np.array([[1.0, 1.0]])
    return luenberger.design(A, B, C, bounds, slowest=0.0, tol=1e-9, gains=[np.zeros(2)])


def generating() -> Any:
    return fleet(np.array([0]), "vde4105", np.array([5.0]), 100.0, capability="circular", p_gen=np.array([1]))


def stack(rank: int) -> Stack:
    return Stack.of_rows(np.eye(3)[:rank])


def street(**changes: Any) -> Any:
    return replace(make_plant(np.random.default_rng(0), customers=5), **changes)


CALLS: dict[str, Callable[[], Any]] = {
    "power above the rating": generating,
    "blind gains": lambda: refuse_blind(np.array([0, 3]), np.zeros(2)),
    "meters twice": lambda: Stuck(np.array([1, 1]), 0.0, 1.0),
    "dead time of a continuous filter": lambda: Update(0.0, 1),
    "gains without options": lambda: circle.design(line(3).lure, np.ones(3, np.bool_), gains="lmi"),
    "negative noise": lambda: not_negative("noise", -1.0),
    "time constants too far apart": lambda: certify(far_apart()),
    "a pattern of zero": lambda: coordinate(np.array([0.0, 1.0]), WHO, 0.03),
    "as many readings as states": lambda: gaussian.design_test(stack(3), np.eye(3)),
    "unstable without meters": lambda: discrete_contraction(sampled(2.0), decays=0.9),
    "probability too near to 1": lambda: bound_for(
        Stack.of([np.eye(2)]), np.diag([1.0, 1e-6]), 1.0 - 1e-15, tol=1e-6
    ),
    "covariance of zeros": lambda: gaussian.design_test(stack(3), np.zeros((3, 3))),
    "bias of NaN": lambda: Bias(WHO, 0.0, 1.0, size=np.array([0.1, np.nan])),
    "half a loss correction": lambda: street(loss_correction=0.5),
    "rising curve": rising,
    "too few sensors kept": lambda: gaussian.design_test(stack(3), np.eye(3), np.array([0, 1])),
    "replay without delay": lambda: Replay(WHO, 0.0, 1.0, delay_s=0.0),
    "parent after its branch": late_parent,
    "unequal mutual impedances": lambda: three_phases(z=changed_block(0, 1, 0.001)),
    "states that an input hides": lambda: symbolic("hidden"),
    "wrong left inverse": no_left_inverse,
    "no attacked meter": lambda: windowed.design(street(), max_attacked=0, step_s=1.0),
    "attack that ends first": lambda: Stuck(WHO, 1.0, 0.0),
    "no step of a loss correction": lambda: random_feeder(0, customers=2).loss_correction(
        np.zeros(2), np.zeros(2), 1.0, steps=0
    ),
    "customer on no phase": lambda: three_phases(
        connected=np.zeros_like(random_three_phase(1, charging=0.0).connected)
    ),
    "customer on three phases": lambda: PhasedFeeder(random_three_phase(1, charging=0.0)),
    "impedance of an absent phase": absent_phase,
    "observable on one side": lambda: symbolic("half"),
    "tie from a bus to itself": lambda: MeshedFeeder(
        random_feeder(3), np.array([[1, 1]]), np.ones(1), np.ones(1), np.zeros(1)
    ),
    "heights of a stack": lambda: Stack(np.eye(3), np.array([2, 2])),
    "dependent inputs": lambda: exact(yang2021.plant(1).system, np.ones((2, 2))),
    "entries of 1e200": lambda: group_pursuit(np.array([[1e200, 1.0]]), np.ones(1), np.array([1, 1])),
    "two liars of three": lambda: subsets(3, 2, most=1000),
    "subsets of 20 sensors": lambda: stacks.subsets(20, 10, most=1000),
    "customers outside the feeder": lambda: close_loop(
        random_feeder(6, customers=2),
        fleet(np.array([0, 2]), "vde4105", np.full(2, 5.0), 100.0),
        np.array([5]),
    ),
    "preset": lambda: preset("ieee1547-x"),
    "attack by unprotected meters": lambda: fewest_protected(
        lambda protected: None if protected[:2].any() else WHO, 3, never=np.array([True, True, False])
    ),
    "bytes of no archive": lambda: from_bytes(bytes(64)),
    "gains of zero": unstable,
    "gains from other meters": foreign_gains,
    "slopes above zero": lambda: discrete_contraction(sampled(0.5, lower=0.5), decays=0.9),
    "line without impedance": lambda: MeshedFeeder(
        random_feeder(3), np.array([[0, 1]]), np.zeros(1), np.zeros(1), np.zeros(1)
    ),
    "plant and numbers of a monitor": lambda: exact_bank.design(
        street(meters=np.array([-1, 3, 3])), max_attacked=-1, step_s=0.0
    ),
    "options of a monitor": lambda: Options(
        np.nan, confirm=0, release=0, settled=0.0, tie=-1.0, widest=np.nan, v2_limits=(2.0, 1.0)
    ),
    "options of the front end": lambda: FrontOptions(
        alarms_per_year=0.0, enough=0.0, release=0, suspect=1.0, like=0.5
    ),
    "uncertainty of loads": lambda: LoadDoubt(
        np.array([-1.0]), np.array([np.nan]), 0.0, common_p=2.0, common_q=-1.0
    ),
    "accuracy of meters": lambda: replace(
        accuracy(2), class_fraction=np.array([np.nan, 0.0]), resolution=-np.ones(3), busbar_class=-1.0
    ),
    "radial feeder": broken_feeder,
    "fleet of three": broken_fleet,
    "options of a matrix inequality": lambda: options_for(
        line(3).lure, rate=0.0, noise=-1.0, load=np.full(3, np.inf), floor=1.0
    ),
    "row of zeros": lambda: linear(np.eye(2), np.ones((2, 1)), np.diag([1.0, 0.0]), np.ones(2)),
    "boundary message that is not JSON": lambda: Message.from_json("{", 3),
}


@pytest.mark.parametrize("call", CALLS)
def test_sentences(call: str) -> None:
    assert sentences(CALLS[call]) == golden(GOLDEN)[call]


def test_the_golden_file_has_a_sentence_for_each_code() -> None:
    there = golden(GOLDEN)
    assert there.keys() == CALLS.keys()
    found = {each.split(" | ")[1] for rest in there.values() for each in rest}
    # The default of DesignInfeasible: every call of the package states a code.
    assert found == used(PACKAGES[0]) - {"design-infeasible"}

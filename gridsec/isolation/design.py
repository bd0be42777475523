"""Observers of a bank, and their comparisons.

References
----------
yang2021 (4), (19), (20); docs/theory-unknown-input.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints
from gridsec.choices import no_choice
from gridsec.errors import DesignInfeasible, NotObservable, Problem, refuse
from gridsec.lmi.unknown_input import Multiplier
from gridsec.observers.unknown_input import Missing, Pair, UnknownInputDesign, UnknownInputPlant
from gridsec.observers.unknown_input import design as design_family

Measure = Literal["distance", "bounds"]


@dataclass(frozen=True, slots=True, eq=False)
class IsolationDesign:
    """A bank with its comparisons. n states, r inputs, p sensors.

    Attributes
    ----------
    family
        All observers that exist.
    large : (a,)
        Indices of the large ones, J of (5) or (22).
    company : (a, b)
        For each large observer the small ones within it, padded by repetition.
    alone : (a,)
        Large observers without any existing company: they cannot be confirmed.
    max_inputs, max_sensors
        q_1 and q_2. A complete bank distrusts all inputs: max_inputs = r.
    missing
        Members missing from the bank. Unless empty, the theorems do not apply.
    measure
        Measure of disagreement. "distance": the Euclidean norm of (5) and (22), with the selection (6), (23).
        "bounds": the largest difference of an entry relative to the sum of both observers' error bounds, in
        which a poorly observed state does not mask others; the observer with the best certified estimate is
        selected.
    left : (r, n)
        Left inverse of the inputs' matrix.
    from_now, from_before, from_drift : (r, n), (r, n), (r,)
        Gains from the bounds of the estimates to that of the reconstructed input attack.
    """

    family: UnknownInputDesign
    large: Ints
    company: Ints
    alone: Bools
    max_inputs: int
    max_sensors: int
    missing: tuple[Missing, ...]
    measure: Measure
    left: Floats
    from_now: Floats
    from_before: Floats
    from_drift: Floats

    @property
    def guaranteed(self) -> bool:
        """True if every member exists, as required by Assumptions 2 and 3."""
        return not self.missing


def members(inputs: int, sensors: int, max_inputs: int, max_sensors: int) -> tuple[list[Pair], list[Pair]]:
    """The pairs (J_u, J_s) of both banks.

    Parameters
    ----------
    inputs, sensors
        r and p.
    max_inputs, max_sensors
        q_1 and q_2. `max_inputs = inputs` selects the complete bank, in which both distrust all inputs.

    Returns
    -------
    large, small
        (q_1, p - q_2) and (2 q_1, p - 2 q_2) inputs and sensors.

    Raises
    ------
    NotObservable
        Unless p > 2 q_2 and (except for the complete bank) r > 2 q_1, yang2021 (4), (19), (20).
    ValueError
        If a count is negative.
    """
    counts = {"max_inputs": max_inputs, "max_sensors": max_sensors}
    refuse(
        Problem("negative", f"{name} is {count}; it cannot be negative")
        for name, count in counts.items()
        if count < 0
    )
    if sensors <= 2 * max_sensors:
        why = f"{sensors} sensors, {max_sensors} of them attacked: more than {2 * max_sensors} are needed"
        raise NotObservable(
            range(sensors), sensors, why + " (yang2021, Assumptions 2 and 3)", code="too-few-meters"
        )
    complete = max_inputs == inputs
    if not complete and inputs <= 2 * max_inputs:
        why = f"{inputs} inputs, {max_inputs} of them attacked: more than {2 * max_inputs} are needed"
        raise NotObservable(
            range(inputs),
            inputs,
            why + ", or the complete bank (yang2021, Assumption 3)",
            code="too-few-meters",
        )
    double = inputs if complete else 2 * max_inputs

    def all_pairs(distrusted: int, trusted: int) -> list[Pair]:
        sets = combinations(range(inputs), distrusted)
        return [(u, s) for u in sets for s in combinations(range(sensors), trusted)]

    return all_pairs(max_inputs, sensors - max_sensors), all_pairs(double, sensors - 2 * max_sensors)


def design(
    plant: UnknownInputPlant,
    *,
    max_inputs: int,
    max_sensors: int,
    measure: Measure = "bounds",
    rates: Sequence[float] = (0.5, 0.8, 0.95, 0.995),
    multiplier: Multiplier = "diagonal",
    tolerance: float = 1e-9,
    rounding: float = 1e-9,
) -> IsolationDesign:
    """Design a bank and list its missing members.

    Parameters
    ----------
    max_inputs, max_sensors
        Largest numbers of attacked inputs and sensors, q_1 and q_2; `max_inputs = r` is the complete
        bank.
    measure
        See `IsolationDesign`. yang2021: "distance".
    rates, multiplier, tolerance, rounding
        See `observers.unknown_input.design`.

    Raises
    ------
    NotObservable
        If there are too few sensors or inputs for the counts.
    DesignInfeasible
        If no member exists at all.
    ValueError
        If a count is negative, `rates` is empty, or `measure` or `multiplier` is unknown.
    """
    refuse(no_choice("measure", get_args(Measure), measure))
    r, p = plant.inputs.shape[1], plant.noise.size
    wide, narrow = members(r, p, max_inputs, max_sensors)
    # With zero counts both banks are the same: one observer, compared with itself.
    asked = wide + [pair for pair in narrow if pair not in set(wide)]
    family = design_family(
        plant, asked, rates=rates, multiplier=multiplier, tolerance=tolerance, rounding=rounding
    )
    place = {pair: i for i, pair in enumerate(family.pairs)}
    large = [pair for pair in wide if pair in place]
    if not large:
        raise DesignInfeasible(
            "bank of unknown-input observers",
            f"no large one exists: {family.missing[0].why}",
            code="no-solution",
        )
    inside = [[place[s] for s in narrow if s in place and _within(s, pair)] for pair in large]
    width = max((len(row) for row in inside), default=0) or 1
    company = [(row or [place[pair]]) for pair, row in zip(large, inside, strict=True)]
    padded = [row + [row[-1]] * (width - len(row)) for row in company]
    lone = np.array([not row for row in inside], dtype=np.bool_)
    lone.flags.writeable = False
    system = plant.system
    left = np.asarray(np.linalg.pinv(plant.inputs), dtype=np.float64)
    slack = np.abs(left @ (system.G * plant.half)) @ np.abs(system.H)
    middle = system.A + (system.G * plant.middle) @ system.H
    return IsolationDesign(
        family=family,
        large=frozen_ints(np.array([place[pair] for pair in large], dtype=np.intp)),
        company=frozen_ints(np.array(padded, dtype=np.intp).reshape(len(large), width)),
        alone=lone,
        max_inputs=max_inputs,
        max_sensors=max_sensors,
        missing=family.missing,
        measure=measure,
        left=frozen(left),
        from_now=frozen(np.abs(left)),
        from_before=frozen(np.abs(left @ middle) + slack),
        from_drift=frozen(np.abs(left @ plant.drift).sum(axis=1)),
    )


def _within(small: Pair, large: Pair) -> bool:
    return set(small[0]) >= set(large[0]) and set(small[1]) <= set(large[1])

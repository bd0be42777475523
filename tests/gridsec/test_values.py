"""The quick way to change a field against the standard library's."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
import pytest

from gridsec.arrays import changed
from gridsec.estimators import front
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.street import make_plant


@dataclass(frozen=True, slots=True)
class _Plain:
    first: int
    second: str = "b"
    third: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class _Longer(_Plain):
    fourth: float = 0.5


@dataclass(frozen=True, slots=True)
class _Alone:
    only: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Derived:
    first: int
    double: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "double", 2 * self.first)


@dataclass(frozen=True)
class _Open:
    first: int
    second: int = 2


def test_it_is_the_standard_librarys() -> None:
    plain, longer = _Plain(1, third=(3,)), _Longer(1, "x", (), 2.0)
    assert changed(plain, second="c") == replace(plain, second="c") == _Plain(1, "c", (3,))
    assert changed(longer, first=7, fourth=1.0) == _Longer(7, "x", (), 1.0)
    assert type(changed(longer, first=7)) is _Longer
    assert changed(_Alone((1, 2)), only=(3,)) == _Alone((3,))
    assert changed(_Open(1), second=5) == _Open(1, 5)
    assert changed(plain) == plain
    assert changed(plain) is not plain
    assert plain == _Plain(1, "b", (3,))


def test_what_is_derived_follows() -> None:
    assert changed(_Derived(2), first=5).double == 10
    with pytest.raises((TypeError, ValueError), match="double"):
        changed(_Derived(2), double=5)


def test_fields_that_are_not_there_are_refused() -> None:
    for value in (_Plain(1), _Open(1), _Derived(1)):
        with pytest.raises(TypeError, match="nobody"):
            changed(value, nobody=1)  # type: ignore[call-arg]


def test_a_state_keeps_all_else() -> None:
    design = front_end(make_plant(np.random.default_rng(1), customers=12, drop=0.03))
    state = front.init(design, 5.0)
    quick, slow = (each(state, t=7.0, ticks=25) for each in (changed, replace))
    for each in fields(state):
        assert getattr(quick, each.name) is getattr(slow, each.name) or each.name in ("t", "ticks")
    assert (quick.t, quick.ticks, state.t, state.ticks) == (7.0, 25, 5.0, 0)

"""Kept designs: exact bytes, keys by content, and proof before anything is used again."""

from __future__ import annotations

import hashlib
import io
import itertools
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.errors import DesignInfeasible
from gridsec.observers.design_archive import cached, design_key, from_bytes, to_bytes
from gridsec.observers.gains import CircleGains, CircleOptions, margin, options_for
from gridsec.observers.lmi import solve_many
from tests.codes import refused
from tests.gridsec.plants import line

STREET = line(4)
SUBSETS = [c for size in (3, 2) for c in itertools.combinations(range(4), size)]
OPTIONS = options_for(STREET.lure, rate=0.25, noise=2e-4, load=STREET.load)


@pytest.fixture(scope="module")
def designs() -> tuple[CircleGains, ...]:
    return solve_many(STREET.lure, SUBSETS, OPTIONS, workers=1)


class Shelf:
    """A store in memory that counts."""

    def __init__(self) -> None:
        self.kept: dict[str, bytes] = {}
        self.asked = 0

    def get(self, key: str) -> bytes | None:
        self.asked += 1
        return self.kept.get(key)

    def put(self, key: str, blob: bytes) -> None:
        self.kept[key] = blob


def run(shelf: Shelf, options: CircleOptions = OPTIONS) -> tuple[tuple[CircleGains, ...], str]:
    return cached(STREET.lure, SUBSETS, options, get=shelf.get, put=shelf.put, workers=1)


def test_bytes_give_back_every_number(designs: tuple[CircleGains, ...]) -> None:
    back = from_bytes(to_bytes(designs, OPTIONS))
    assert len(back) == len(designs)
    for a, b in zip(designs, back, strict=True):
        for f in fields(CircleGains):
            np.testing.assert_array_equal(getattr(a, f.name), getattr(b, f.name), err_msg=f.name)
        assert margin(STREET.lure, b.J, b) == a.margin


def test_there_are_no_pickles_inside(designs: tuple[CircleGains, ...]) -> None:
    with np.load(io.BytesIO(to_bytes(designs, OPTIONS)[32:]), allow_pickle=False) as archive:
        assert all(archive[name].dtype != object for name in archive.files)


def test_the_key_is_the_content() -> None:
    key = design_key(STREET.lure, SUBSETS, OPTIONS)
    assert design_key(line(4).lure, [list(s) for s in SUBSETS], replace(OPTIONS)) == key
    # The curve itself is not part of a design, its slope bounds are.
    assert design_key(replace(STREET.lure, phi=lambda z: z), SUBSETS, OPTIONS) == key
    others = [
        design_key(replace(STREET.lure, slope=STREET.lure.slope * (1 + 1e-15)), SUBSETS, OPTIONS),
        design_key(replace(STREET.lure, H=STREET.lure.H.T * 1.1), SUBSETS, OPTIONS),
        design_key(STREET.lure, SUBSETS[::-1], OPTIONS),
        design_key(STREET.lure, SUBSETS[1:], OPTIONS),
        *(
            design_key(STREET.lure, SUBSETS, replace(OPTIONS, **change))
            for change in (
                {"rate": 0.26},
                {"floor": 0.1},
                {"noise": OPTIONS.noise * 2},
                {"load": OPTIONS.load * 2},
                {"weight": OPTIONS.weight * 2},
            )
        ),
    ]
    assert len({key, *others}) == 1 + len(others)


def test_designs_are_made_once() -> None:
    shelf = Shelf()
    first, origin = run(shelf)
    assert (origin, shelf.asked, len(shelf.kept)) == ("new", 1, 1)
    second, origin = run(shelf)
    assert origin == "stored"
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.K, b.K)
        assert a.margin == b.margin
    _, origin = run(shelf, replace(OPTIONS, rate=0.2))
    assert (origin, len(shelf.kept)) == ("new", 2)


def spoil(designs: tuple[CircleGains, ...], **change: Any) -> list[CircleGains]:
    """The same designs with one of them changed."""
    return [designs[0], replace(designs[1], **change), *designs[2:]]


@pytest.mark.canary("<lambda>-cannot be read0", "<lambda>-another size")
@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda _: b"not an archive", "cannot be read"),
        (lambda _: b"", "cannot be read"),
        (lambda d: to_bytes(d, OPTIONS)[:-200], "cannot be read"),
        (lambda d: to_bytes(d[:-1], OPTIONS), "other sets"),
        (lambda d: to_bytes(d[::-1], OPTIONS), "other sets"),
        (lambda d: to_bytes(spoil(d, mu=0.5 * d[1].mu), OPTIONS), "does not hold"),
        (lambda d: to_bytes(spoil(d, K=-d[1].K), OPTIONS), "does not hold"),
        (lambda d: to_bytes(spoil(d, L=d[1].L * np.nan), OPTIONS), "does not hold"),
        (lambda d: to_bytes(spoil(d, alpha=0.5 * d[1].alpha), OPTIONS), "other options"),
        (lambda d: to_bytes(spoil(d, noise=2 * d[1].noise), OPTIONS), "other options"),
        (lambda d: to_bytes([blind(g) for g in d], OPTIONS), "degenerate"),
        (lambda d: to_bytes([shorter(g) for g in d], OPTIONS), "another size"),
    ],
)
def test_what_is_damaged_is_designed_again(designs: tuple[CircleGains, ...], damage: Any, why: str) -> None:
    shelf = Shelf()
    key = design_key(STREET.lure, SUBSETS, OPTIONS)
    shelf.put(key, damage(designs))
    found, origin = run(shelf)
    assert origin.startswith("redesigned: ")
    assert why in origin
    assert all(margin(STREET.lure, g.J, g) > 0.0 for g in found)
    assert run(shelf)[1] == "stored", "the damaged entry was replaced"


def blind(g: CircleGains) -> CircleGains:
    """The same inequality holds for L = K = 0 with room in mu_delta: proven, and useless."""
    return replace(g, L=0 * g.L, K=0 * g.K, mu_delta=1e6 * g.mu_delta, P=g.P)


def shorter(g: CircleGains) -> CircleGains:
    return replace(g, Lambda=g.Lambda[:-1])


_FEW = SUBSETS[:2]
_SAMPLE = to_bytes(solve_many(STREET.lure, _FEW, OPTIONS, workers=1), OPTIONS)


@given(st.integers(0, len(_SAMPLE) - 1), st.integers(0, 255))
@settings(max_examples=25)
def test_whatever_a_disk_does_to_the_bytes_what_comes_back_holds(position: int, value: int) -> None:
    blob = bytearray(_SAMPLE)
    blob[position] = value
    shelf = Shelf()
    shelf.put(design_key(STREET.lure, _FEW, OPTIONS), bytes(blob))
    found, _ = cached(STREET.lure, _FEW, OPTIONS, get=shelf.get, put=shelf.put, workers=1)
    assert [tuple(g.J) for g in found] == _FEW
    assert all(margin(STREET.lure, g.J, g) > 0.0 for g in found)


def repacked(designs: tuple[CircleGains, ...], change: Any) -> bytes:
    """Bytes with other content and a digest that fits."""
    with np.load(io.BytesIO(to_bytes(designs, OPTIONS)[32:])) as archive:
        arrays = {name: archive[name] for name in archive.files}
    change(arrays)
    out = io.BytesIO()
    np.savez(out, **arrays)
    return hashlib.sha256(out.getvalue()).digest() + out.getvalue()


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a.update(format=np.array("something else")),
        lambda a: a.pop("3/K"),
        lambda a: a.update(load=np.array("text")),
    ],
)
def test_an_archive_of_something_else_is_refused(designs: tuple[CircleGains, ...], change: Any) -> None:
    with refused(DesignInfeasible, "unreadable"):
        from_bytes(repacked(designs, change))
    plain = b"no archive at all"
    with refused(DesignInfeasible, "unreadable"):
        from_bytes(hashlib.sha256(plain).digest() + plain)

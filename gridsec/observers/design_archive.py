"""Stored designs: a key by content, an exact round trip through bytes, verification before reuse.

Building blocks of a design cache: `cached` queries a store, verifies the stored designs again, and designs
missing or damaged ones. Files belong to the store; nothing here reads or writes a file.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridsec.arrays import frozen, frozen_ints
from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers.gains import CircleGains, CircleOptions, margin, refuse_blind, sensitivity
from gridsec.observers.lmi import BACKOFF, solve_many
from gridsec.observers.lure import Lure

_FORMAT = "gridsec circle gains 1"
_DIGEST = 32
_SHARED = ("load", "weight")
_STORED = tuple(f.name for f in fields(CircleGains) if f.name not in _SHARED)

_Arrays = dict[str, NDArray[Any]]


def design_key(lure: Lure, subsets: Sequence[Sequence[int]], options: CircleOptions) -> str:
    """Key of a design by content, 64 hexadecimal digits; equal exactly for equal plant, sets and options."""
    digest = hashlib.sha256(_FORMAT.encode())
    arrays = [lure.A, lure.G, lure.H, lure.F, lure.B, lure.C, lure.D, lure.slope]
    arrays += [options.noise, options.load, options.weight, np.array([options.rate, options.floor])]
    for values in arrays:
        # The shape is part of the content: a (2, 3) and a (3, 2) matrix can have the same bytes.
        digest.update(repr(values.shape).encode())
        digest.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
    digest.update(repr([tuple(int(j) for j in subset) for subset in subsets]).encode())
    return digest.hexdigest()


def to_bytes(gains: Sequence[CircleGains], options: CircleOptions) -> bytes:
    """Write designs of one plant, all with the same options, into bytes: a digest and an NPZ archive.

    The archive keeps the order of `gains` and contains no pickled objects; `from_bytes` restores every number
    exactly.
    """
    arrays: _Arrays = {
        "format": np.array(_FORMAT),
        "load": options.load,
        "weight": options.weight,
    }
    sizes = np.array([len(one.J) for one in gains], dtype=np.intp)
    arrays["sizes"] = sizes
    for size in np.unique(sizes):
        group = [one for one in gains if len(one.J) == size]
        for name in _STORED:
            arrays[f"{size}/{name}"] = np.array([getattr(one, name) for one in group])
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **arrays)
    content = out.getvalue()
    return hashlib.sha256(content).digest() + content


def from_bytes(blob: bytes) -> tuple[CircleGains, ...]:
    """Read the bytes of `to_bytes`. The margins are the stored ones: recompute before trusting them.

    Raises DesignInfeasible if the bytes are damaged or not such an archive.
    """
    digest, content = blob[:_DIGEST], blob[_DIGEST:]
    if hashlib.sha256(content).digest() != digest:
        raise DesignInfeasible(
            "stored design", "cannot be read: damaged, the digest does not fit", code="unreadable"
        )
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        return _unpack(arrays)
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as damage:
        raise DesignInfeasible("stored design", f"cannot be read: {damage}", code="unreadable") from damage


def _unpack(arrays: _Arrays) -> tuple[CircleGains, ...]:
    if str(arrays["format"]) != _FORMAT:
        raise InputInvalid.of("unreadable", f"unknown format {arrays['format']!s}")
    load, weight = frozen(arrays["load"]), frozen(arrays["weight"])
    taken = dict.fromkeys(np.unique(arrays["sizes"]).tolist(), 0)
    out = []
    for size in arrays["sizes"].tolist():
        index = taken[size]
        taken[size] += 1
        values = {name: _restored(arrays[f"{size}/{name}"][index]) for name in _STORED}
        out.append(CircleGains(load=load, weight=weight, **values))
    return tuple(out)


def _restored(value: Any) -> Any:
    """Stored value as a read-only array, a number or a text."""
    if value.ndim:
        return frozen_ints(value) if value.dtype.kind == "i" else frozen(value)
    return value.item()


def cached(
    lure: Lure,
    subsets: Sequence[Sequence[int]],
    options: CircleOptions,
    *,
    get: Callable[[str], bytes | None],
    put: Callable[[str, bytes], None],
    workers: int,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[tuple[CircleGains, ...], str]:
    """Designs from a store if they are present and still valid, new ones otherwise.

    Stored designs are verified again: readable, the right sets, every margin recomputed and positive, no
    blind design. Otherwise the bank is redesigned and put into the store.

    lure, subsets, options, workers, progress: as in `solve_many`.
    get: returns the bytes stored under a key, or None.
    put: stores bytes under a key.
    Returns designs, origin: `origin` is "stored", "new", or "redesigned: " with the fault of the stored
        designs.
    Raises DesignInfeasible as `solve_many`.
    """
    key = design_key(lure, subsets, options)
    blob = get(key)
    origin = "new"
    if blob is not None:
        try:
            return _proven(lure, subsets, options, from_bytes(blob)), "stored"
        except DesignInfeasible as damage:
            origin = f"redesigned: {damage}"
    designs = solve_many(lure, subsets, options, workers=workers, progress=progress)
    put(key, to_bytes(designs, options))
    return designs, origin


def _proven(
    lure: Lure, subsets: Sequence[Sequence[int]], options: CircleOptions, stored: tuple[CircleGains, ...]
) -> tuple[CircleGains, ...]:
    """The stored designs with recomputed margins, or DesignInfeasible."""
    what = "stored design"
    wanted = [tuple(int(j) for j in subset) for subset in subsets]
    if [tuple(one.J.tolist()) for one in stored] != wanted:
        raise DesignInfeasible(what, "made for other sets of meters", code="wrong-design")
    out = []
    for one in stored:
        shapes = (one.L.shape, one.K.shape, one.P.shape, one.Lambda.shape, one.load.shape)
        n, m, k = len(lure.A), len(lure.slope), len(one.J)
        if shapes != ((n, k), (m, k), (n, n), (m,), options.load.shape):
            raise DesignInfeasible(what, "made for a plant of another size", code="wrong-design")
        # A relaxed rate is part of a design; a rate outside the stated back-off is damage.
        honest = (1.0 - BACKOFF[-1]) * options.rate <= one.alpha <= options.rate * (1.0 + 1e-12)
        same = np.array_equal(one.noise, options.noise[one.J]) and np.array_equal(one.load, options.load)
        if not (honest and same):
            raise DesignInfeasible(what, f"{one.J.tolist()} was made for other options", code="wrong-design")
        found = margin(lure, one.J, one)
        if not found > 0.0:
            raise DesignInfeasible(what, f"{one.J.tolist()} does not hold", found, code="not-verified")
        heard = sensitivity(lure, one.L, one.K)
        refuse_blind(one.J, heard)
        out.append(replace(one, margin=found, sensitivity=frozen(heard)))
    return tuple(out)

"""Designs as bytes: a key by content, and a round trip that is exact.

What a design cache is made of. Files are the caller's business; nothing here reads or writes one.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridsec.arrays import frozen, frozen_ints
from gridsec.errors import DesignInfeasible
from gridsec.gains import CircleGains, CircleOptions
from gridsec.lure import Lure

_FORMAT = "gridsec circle gains 1"
_SHARED = ("load", "weight")
_STORED = tuple(f.name for f in fields(CircleGains) if f.name not in _SHARED)

_Arrays = dict[str, NDArray[Any]]


def design_key(lure: Lure, subsets: Sequence[Sequence[int]], options: CircleOptions) -> str:
    """Name of a design by content: equal exactly if plant, trusted sets and options are equal.

    Parameters
    ----------
    lure, subsets, options
        What the designs are made from.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
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
    """Write designs of one plant, all with the same options, into the bytes of an NPZ archive.

    Parameters
    ----------
    gains
        The designs, in the order in which they are wanted back.
    options
        What they were designed for.

    Returns
    -------
    bytes
        No pickled objects inside; `from_bytes` gives every number back exactly.
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
    return out.getvalue()


def from_bytes(blob: bytes) -> tuple[CircleGains, ...]:
    """Read what `to_bytes` wrote. The margins are the stored ones: recompute before trusting them.

    Parameters
    ----------
    blob
        The bytes.

    Raises
    ------
    DesignInfeasible
        If the bytes are no such archive, or damaged.
    """
    try:
        with np.load(io.BytesIO(blob), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        return _unpack(arrays)
    except (
        ValueError,
        KeyError,
        OSError,
        EOFError,
        IndexError,
        NotImplementedError,
        zipfile.BadZipFile,
    ) as damage:
        raise DesignInfeasible("stored design", f"cannot be read: {damage}") from damage


def _unpack(arrays: _Arrays) -> tuple[CircleGains, ...]:
    if str(arrays["format"]) != _FORMAT:
        raise ValueError(f"unknown format {arrays['format']!s}")
    load, weight = frozen(arrays["load"]), frozen(arrays["weight"])
    taken = dict.fromkeys(np.unique(arrays["sizes"]).tolist(), 0)
    out = []
    for size in arrays["sizes"].tolist():
        index = taken[size]
        taken[size] += 1
        values = {name: arrays[f"{size}/{name}"][index] for name in _STORED}
        out.append(
            CircleGains(
                J=frozen_ints(values["J"]),
                L=frozen(values["L"]),
                K=frozen(values["K"]),
                P=frozen(values["P"]),
                Lambda=frozen(values["Lambda"]),
                nu=float(values["nu"]),
                mu=float(values["mu"]),
                mu_delta=float(values["mu_delta"]),
                alpha=float(values["alpha"]),
                noise=frozen(values["noise"]),
                load=load,
                weight=weight,
                margin=float(values["margin"]),
                sensitivity=frozen(values["sensitivity"]),
                backoff=float(values["backoff"]),
                status=str(values["status"]),
            )
        )
    return tuple(out)

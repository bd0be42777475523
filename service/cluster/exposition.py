"""Metrics of several processes as one text in Prometheus's format, with the label `worker`."""

from __future__ import annotations

import re
from collections.abc import Mapping

_SAMPLE = re.compile(rb"^([A-Za-z_:][A-Za-z0-9_:]*)(?:\{(.*)\})? (.+)$")
"""A sample: name, labels, value with an optional time."""


def merged(parts: Mapping[str, bytes]) -> bytes:
    """Return the samples of all parts, those of one metric together; its help is that of the first part.

    parts: text by worker; samples of the worker "" get no label.
    """
    heads: dict[bytes, list[bytes]] = {}
    samples: dict[bytes, list[bytes]] = {}
    for worker, text in parts.items():
        family = b""
        first: set[bytes] = set()
        for line in text.splitlines():
            if line.startswith((b"# HELP ", b"# TYPE ")):
                family = line.split(b" ")[2]
                if family not in heads:
                    first.add(family)
                if family in first:
                    heads.setdefault(family, []).append(line)
                samples.setdefault(family, [])
            elif line and not line.startswith(b"#"):
                samples.setdefault(family, []).append(_labelled(line, worker))
    lines = [line for family, own in samples.items() for line in (*heads.get(family, ()), *own)]
    return b"\n".join(lines) + b"\n" if lines else b""


def _labelled(line: bytes, worker: str) -> bytes:
    found = _SAMPLE.match(line)
    if not worker or found is None:
        return line
    name, labels, value = found.groups()
    both = b",".join(part for part in (labels, f'worker="{worker}"'.encode()) if part)
    return b"%s{%s} %s" % (name, both, value)

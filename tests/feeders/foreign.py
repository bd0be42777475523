"""Random radial networks in the formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from power_grid_model import ComponentType, DatasetType, initialize_array
from power_grid_model.utils import json_serialize_to_file


def opendss(path: Path, buses: int, *, balanced: bool, poles: bool = False, seed: int = 0) -> Path:
    """A low-voltage network below an 11 kV source: lines of three kinds of definition, single-phase spurs.

    With poles, half of the lines hang on them side by side, without transposition.
    """
    rng = np.random.default_rng(seed)
    lines = [
        "clear",
        "new circuit.town basekv=11 pu=1.03 angle=10 mvasc3=200 mvasc1=150 bus1=grid",
        "new transformer.sub windings=2 buses=(grid,board) conns=(delta,wye) kvs=(11,0.4) "
        "kvas=(630,630) xhl=4",
        "new linecode.wire nphases=3 r1=0.35 x1=0.3 r0=0.9 x0=1.1 c1=9 c0=9 units=km",
        "new linecode.cable nphases=3 rmatrix=(0.5|0.15 0.5|0.15 0.15 0.5) xmatrix=(0.4|0.3 0.4|0.3 0.3 0.4) "
        "cmatrix=(200|0 200|0 0 200) units=mi",
    ]
    if poles:
        lines += [
            "new wiredata.al rac=0.3 runits=km gmrac=6 gmrunits=mm radius=8 radunits=mm",
            "new linegeometry.pole nconds=4 nphases=3 reduce=yes",
            *(
                f"~ cond={k} wire=al x={x} h={h} units=m"
                for k, x, h in ((1, -0.6, 8.5), (2, -0.1, 8.5), (3, 0.6, 8.5), (4, 0.0, 7.3))
            ),
        ]
    phases = {"board": (1, 2, 3)}
    names = ["board"]
    for k in range(1, buses):
        above = names[rng.integers(max(0, len(names) - max(8, buses // 6)), len(names))]
        here = phases[above]
        if not balanced and len(here) == 3 and rng.random() < (0.04 if poles else 0.4):
            here = (int(rng.integers(1, 4)),)
        dots = "".join(f".{node}" for node in here)
        metres = rng.uniform(5.0, 25.0)
        shape = (
            ["geometry=pole" if poles else "linecode=wire", "linecode=cable"][k % 2] if len(here) == 3 else ""
        )
        own = "" if shape else "r1=0.6 x1=0.08 r0=0.6 x0=0.08 c1=0 c0=0 units=km "
        lines.append(
            f"new line.l{k} bus1={above}{dots} bus2=n{k}{dots} phases={len(here)} {own}{shape} "
            f"length={metres * 3.28084 if k % 3 else metres:.4f} units={'ft' if k % 3 else 'm'}"
        )
        kw, kv = rng.uniform(0.1, 120.0 / buses), 0.4 if len(here) == 3 else 0.4 / 3**0.5
        factor = rng.uniform(0.85, 1.0)
        lines.append(
            f"new load.h{k} bus1=n{k}{dots} phases={len(here)} kv={kv:.6f} kw={kw:.4f} pf={factor:.3f}"
        )
        phases[f"n{k}"] = here
        names.append(f"n{k}")
    lines += ["set voltagebases=[11,0.4]", "calcvoltagebases", "solve"]
    path.write_text("\n".join(lines))
    return path


def pgm(path: Path, nodes: int, *, balanced: bool, seed: int = 0) -> Path:
    """A low-voltage network below a 10 kV source, serialised by power-grid-model itself."""
    rng = np.random.default_rng(seed)
    tables: dict[ComponentType, Any] = {}

    def add(kind: ComponentType, count: int, first: int, **columns: Any) -> None:
        rows = initialize_array(DatasetType.input, kind, count)
        rows["id"] = first + np.arange(count)
        for name, values in columns.items():
            rows[name] = values
        tables[kind] = rows

    rated = np.full(nodes + 1, 400.0)
    rated[0] = 10e3
    add(ComponentType.node, nodes + 1, 0, u_rated=rated)
    above = np.array([rng.integers(max(1, k - max(9, nodes // 6)), k) for k in range(2, nodes + 1)])
    km = rng.uniform(0.005, 0.03, nodes - 1)
    add(
        ComponentType.line, nodes - 1, 10**4, from_node=above, to_node=np.arange(2, nodes + 1),
        from_status=1, to_status=1, r1=0.32 * km, x1=0.08 * km, c1=2.6e-7 * km, tan1=0.0,
        r0=1.28 * km, x0=0.3 * km, c0=2.6e-7 * km, tan0=0.0, i_n=250.0,
    )  # fmt: skip
    add(
        ComponentType.transformer, 1, 2 * 10**4, from_node=0, to_node=1, from_status=1, to_status=1,
        u1=10e3, u2=400.0, sn=630e3, uk=0.04, pk=6e3, i0=0.01, p0=1e3, winding_from=2, winding_to=1, clock=5,
        tap_side=0, tap_pos=1, tap_min=-2, tap_max=2, tap_nom=0, tap_size=250.0,
    )  # fmt: skip
    add(ComponentType.source, 1, 3 * 10**4, node=0, status=1, u_ref=1.02, sk=2e8)
    where = np.arange(2, nodes + 1)
    if balanced:
        kind, p = ComponentType.sym_load, rng.uniform(10.0, 1.2e5 / nodes, nodes - 1)
    else:
        kind, p = ComponentType.asym_load, np.zeros((nodes - 1, 3))
        p[np.arange(nodes - 1), rng.integers(0, 3, nodes - 1)] = rng.uniform(10.0, 8e4 / nodes, nodes - 1)
    add(kind, nodes - 1, 4 * 10**4, node=where, status=1, type=0, p_specified=p, q_specified=0.3 * p)
    json_serialize_to_file(path, {kind.value: rows for kind, rows in tables.items()}, DatasetType.input)
    return path

"""Which AC power flow to use as the truth, and how fast scenarios play.

Run with ``python -m benchmarks.powerflow``. The numbers in docs/simulation.md come from here.
"""

from __future__ import annotations

import contextlib
import io
import os
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandapower as pp
from power_grid_model import CalculationMethod

from feeders.model.site import Site, load, names
from feeders.simulation import powerflow
from feeders.simulation.demand import Variation
from feeders.simulation.powerflow import Grid, PowerFlow
from feeders.simulation.scenario import Scenario, simulate

SINGLE, BATCH, PANDAPOWER = 300, 2000, 10


def seconds(run: Callable[[], object], repeat: int) -> float:
    """Best of five, per call."""
    best = np.inf
    for _ in range(5):
        start = time.perf_counter()
        for _ in range(repeat):
            run()
        best = min(best, (time.perf_counter() - start) / repeat)
    return best


def in_pandapower(grid: Grid) -> Any:
    """The same lines and customers as a pandapower net."""
    net = pp.create_empty_network()
    volt = grid.nominal_volt * np.sqrt(3.0) / 1e3
    for _ in range(grid.bus_count):
        pp.create_bus(net, vn_kv=volt)
    pp.create_ext_grid(net, grid.busbar)
    for (a, b), r, x, c in zip(grid.ends, grid.r_ohm, grid.x_ohm, grid.b_siemens, strict=True):
        pp.create_line_from_parameters(
            net,
            int(a),
            int(b),
            length_km=1.0,
            r_ohm_per_km=r,
            x_ohm_per_km=x,
            c_nf_per_km=c / (2 * np.pi * 50.0) * 1e9,
            max_i_ka=1.0,
        )
    for bus in grid.customer_bus:
        pp.create_load(net, int(bus), p_mw=0.0)
    return net


def compare(site: Site) -> None:
    """Time per solve of each candidate, and how far they are apart."""
    flow = PowerFlow(site)
    random = np.random.default_rng(0)
    count = len(site.tables.customers)
    load_kw = np.array([row.load_kw for row in site.tables.customers])
    p = load_kw * random.uniform(0.0, 0.5, (BATCH, count))
    q = 0.3 * p
    nominal = site.tables.meta.voltage_volt
    v0 = np.full(BATCH, nominal)
    line = f"{site.feeder.name:20s} {count:9d} {flow.grid.bus_count:5d}"
    reference = flow.solve(p[0], q[0], nominal)[1]
    for method in (CalculationMethod.newton_raphson, CalculationMethod.iterative_current):
        with method_of(method):
            single = seconds(lambda: flow.solve(p[0], q[0], nominal), SINGLE)
            batch = seconds(lambda: flow.solve_batch(p, q, v0), 1) / BATCH
            apart = np.max(np.abs(flow.solve(p[0], q[0], nominal)[1] - reference)) / nominal
        line += f" {single * 1e6:9.0f} {batch * 1e6:8.1f} {apart:8.0e}"

    net = in_pandapower(flow.grid)
    net.load["p_mw"], net.load["q_mvar"] = p[0] / 1e3, q[0] / 1e3
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        each = seconds(lambda: pp.runpp(net, numba=False, tolerance_mva=1e-12), PANDAPOWER)
    apart = np.max(
        np.abs(
            net.res_bus.vm_pu.to_numpy()[flow.grid.customer_bus] * nominal
            - flow.solve(p[0], q[0], nominal)[0]
        )
    )
    print(f"{line} {each * 1e6:10.0f} {apart / nominal:8.0e}")


@contextlib.contextmanager
def method_of(method: CalculationMethod) -> Any:
    """Let the power flow use another solution method for a while."""

    class Other:
        newton_raphson = method

    before = powerflow.CalculationMethod
    powerflow.CalculationMethod = Other  # type: ignore[misc, assignment]  # only here
    try:
        yield
    finally:
        powerflow.CalculationMethod = before  # type: ignore[misc]


def play(site: Site) -> None:
    """Milliseconds per tick at 1 Hz, at two voltages of the busbar: inverters at rest, and busy."""
    out = f"{site.feeder.name:20s} {len(site.tables.customers):9d} {site.droop.tau.size:9d}"
    for busbar in (1.0, 1.04):
        scenario = Scenario(duration_s=1800.0, variation=replace(Variation(), busbar_pu=busbar))
        start = time.perf_counter()
        samples = list(islice(simulate(site, scenario), 1800))
        each = (time.perf_counter() - start) / len(samples)
        busy = np.mean([np.any(np.abs(sample.x_kvar) > 1e-3) for sample in samples])
        out += f" {each * 1e3:8.3f} {86_400 * each:7.0f} {100 * busy:6.0f}"
    print(out)


def main() -> None:
    """Print both tables."""
    print(
        f"microseconds per solve; largest difference of a voltage, pu\n{'':36s}"
        f" {'Newton':^27s} {'iterative current':^27s} {'pandapower':^19s}"
    )
    print(
        f"{'feeder':20s} customers buses {'single':>9s} {'batch':>8s} {'':8s} {'single':>9s} {'batch':>8s}"
        f" {'apart':>8s} {'single':>10s} {'apart':>8s}"
    )
    for name in names():
        compare(load(name))
    print(
        f"\nscenario at 1 Hz: ms per tick, s per day, % of ticks with busy inverters\n{'':40s}"
        f" {'busbar at 1.00 pu':^23s} {'busbar at 1.04 pu':^23s}"
    )
    for name in names():
        play(load(name))


if __name__ == "__main__":
    main()

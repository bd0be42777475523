"""pandapower's `remove_bad_data` and `chi2_analysis`, as its documentation shows them.

`remove_bad_data` removes measurements of every kind; a voltage measurement that is gone afterwards counts
as named. `chi2_analysis` says only whether something is wrong.
"""

from __future__ import annotations

import warnings

import numpy as np
import pandapower as pp
from pandapower import estimation

from benchmarks.peers.answer import Answer
from benchmarks.peers.scene import Reading, Scene

# A bus without customers injects nothing, to 0.1 kW; an exact zero makes its matrices singular.
_NOTHING_MW = 1e-4


class Panda:
    """One feeder as a pandapower net, its measurements in one table that is filled anew each time."""

    def __init__(self, here: Scene, threshold: float = 3.0) -> None:
        grid = here.flow.grid
        self.net = net = pp.create_empty_network(sn_mva=here.kw / 1e3)
        kv = grid.nominal_volt * np.sqrt(3.0) / 1e3
        pp.create_buses(net, grid.bus_count, kv)
        pp.create_lines_from_parameters(
            net,
            *grid.ends.T,
            length_km=1.0,
            r_ohm_per_km=grid.r_ohm,
            x_ohm_per_km=grid.x_ohm,
            c_nf_per_km=grid.b_siemens / (2.0 * np.pi * net.f_hz) * 1e9,
            max_i_ka=1.0,
        )
        pp.create_loads(net, grid.customer_bus, p_mw=0.0)
        pp.create_ext_grid(net, grid.busbar)
        n, idle = grid.customer_bus.size, np.setdiff1d(np.arange(grid.bus_count), grid.customer_bus)
        idle = idle[idle != grid.busbar]
        for bus in (*grid.customer_bus, grid.busbar):
            pp.create_measurement(net, "v", "bus", 1.0, 0.01, int(bus))
        for kind in "pq":
            for bus in grid.customer_bus:
                pp.create_measurement(net, kind, "bus", 0.0, 1.0, int(bus))
        for kind in "pq":
            for bus in idle:
                pp.create_measurement(net, kind, "bus", 0.0, _NOTHING_MW, int(bus))
        self.table, self.n, self.idle = net.measurement.copy(), n, idle.size
        self.threshold, self.mw = threshold, here.kw / 1e3
        self.customer_bus = grid.customer_bus

    def _tell(self, told: Reading) -> None:
        table = self.table.copy()
        nothing = np.zeros(2 * self.idle)
        table["value"] = np.concatenate([told.v, [told.v0], told.p * self.mw, told.q * self.mw, nothing])
        table["std_dev"] = np.concatenate(
            [
                np.full(self.n + 1, told.std_v),
                told.std_p * self.mw,
                told.std_q * self.mw,
                np.full(2 * self.idle, _NOTHING_MW),
            ]
        )
        self.net.measurement = table

    def __call__(self, told: Reading) -> Answer:
        """`remove_bad_data` of one snapshot."""
        self._tell(told)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                done = estimation.remove_bad_data(
                    self.net, init="flat", maximum_iterations=30, rn_max_threshold=self.threshold
                )
        # It raises whatever its parts raise, from KeyError to LinAlgError.
        except Exception:  # noqa: BLE001
            return Answer(np.zeros(self.n, dtype=np.bool_), failed=True)
        left = self.net.measurement.index
        named = ~np.isin(np.arange(self.n), left)
        estimate = self.net.res_bus_est["vm_pu"].to_numpy()[self.customer_bus]
        return Answer(named, v=estimate, failed=not done)

    def chi2(self, told: Reading) -> bool | None:
        """Whether `chi2_analysis` sees bad data; None where it fails."""
        self._tell(told)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = estimation.chi2_analysis(self.net, init="flat")
        except Exception:  # noqa: BLE001
            return None
        return None if found is None else bool(found)

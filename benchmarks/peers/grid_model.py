"""power-grid-model's state estimation, and greedy removal of the voltage sensor with the largest residual.

The library has no test for bad data; the loop around it is ours, as its users would write it. Three ways
to judge a residual and to stop are offered; the best in a cell counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from power_grid_model import (
    CalculationMethod,
    ComponentType,
    DatasetType,
    MeasuredTerminalType,
    PowerGridModel,
    initialize_array,
)
from power_grid_model.errors import PowerGridError  # type: ignore[attr-defined]  # documented, but not re-exported
from scipy.special import chdtri

from benchmarks.peers.answer import Answer
from benchmarks.peers.scene import Reading, Scene
from feeders.simulation import powerflow
from gridsec.arrays import Bools, Floats
from gridsec.estimators.front.posterior import LoadDoubt, condition, remove_meter, voltage_prior

_SQRT3 = np.sqrt(3.0)


class GridModel:
    """One feeder, prepared once; sensors are updated in place."""

    def __init__(self, here: Scene, solver: CalculationMethod) -> None:
        self.solver = solver
        grid = here.flow.grid
        n = grid.customer_bus.size
        parts = powerflow._components(grid)
        first = int(parts[ComponentType.source]["id"][0]) + 1
        volt = initialize_array(DatasetType.input, ComponentType.sym_voltage_sensor, n + 1)
        volt["id"] = first + np.arange(n + 1)
        volt["measured_object"][:n], volt["measured_object"][n] = grid.customer_bus, grid.busbar
        volt["u_sigma"], volt["u_measured"] = 1.0, grid.nominal_volt * _SQRT3
        power = initialize_array(DatasetType.input, ComponentType.sym_power_sensor, n)
        power["id"] = first + n + 1 + np.arange(n)
        power["measured_object"] = parts[ComponentType.sym_load]["id"]
        power["measured_terminal_type"] = MeasuredTerminalType.load
        power["p_measured"] = power["q_measured"] = 0.0
        power["p_sigma"] = power["q_sigma"] = power["power_sigma"] = 1.0
        parts[ComponentType.sym_voltage_sensor] = volt
        parts[ComponentType.sym_power_sensor] = power
        self.model = PowerGridModel(parts)
        self.volt = initialize_array(DatasetType.update, ComponentType.sym_voltage_sensor, n + 1)
        self.power = initialize_array(DatasetType.update, ComponentType.sym_power_sensor, n)
        self.volt["id"], self.power["id"] = volt["id"], power["id"]
        self.volt_pu, self.watt = here.volt * _SQRT3, here.kw * 1e3
        self.customer_bus, self.busbar = grid.customer_bus, grid.busbar

    def tell(self, told: Reading) -> None:
        """Hand over the readings with their standard deviations."""
        self.volt["u_measured"][:-1], self.volt["u_measured"][-1] = (
            told.v * self.volt_pu,
            told.v0 * self.volt_pu,
        )
        self.volt["u_sigma"] = told.std_v * self.volt_pu
        self.power["p_measured"], self.power["q_measured"] = told.p * self.watt, told.q * self.watt
        self.power["p_sigma"], self.power["q_sigma"] = told.std_p * self.watt, told.std_q * self.watt
        self._update(
            {ComponentType.sym_voltage_sensor: self.volt, ComponentType.sym_power_sensor: self.power}
        )

    def mute(self, j: int) -> None:
        """Use a voltage sensor no more: its standard deviation becomes infinite."""
        change = self.volt[j : j + 1].copy()
        change["u_sigma"] = np.inf
        self._update({ComponentType.sym_voltage_sensor: change})

    def _update(self, change: dict[ComponentType, Any]) -> None:
        self.model.update(update_data=change)

    def estimate(self) -> Floats:
        """Estimated voltages of the customers, pu."""
        out = self.model.calculate_state_estimation(
            symmetric=True,
            error_tolerance=1e-6,
            calculation_method=self.solver,
            output_component_types={ComponentType.node: ["u"]},
        )
        return np.asarray(out[ComponentType.node]["u"][self.customer_bus]) / self.volt_pu

    def judged(self, told: Reading, live: Bools) -> tuple[Floats, float]:
        """The same, and the sum of all squared residuals over their variances."""
        sensor = ComponentType.sym_power_sensor
        out = self.model.calculate_state_estimation(
            symmetric=True,
            error_tolerance=1e-6,
            calculation_method=self.solver,
            output_component_types={ComponentType.node: ["u"], sensor: ["p_residual", "q_residual"]},
        )
        u = np.asarray(out[ComponentType.node]["u"]) / self.volt_pu
        estimate = u[self.customer_bus]
        volts = np.where(live, (told.v - estimate) / told.std_v, 0.0)
        p = out[sensor]["p_residual"] / (told.std_p * self.watt)
        q = out[sensor]["q_residual"] / (told.std_q * self.watt)
        busbar = (told.v0 - u[self.busbar]) / told.std_v
        return estimate, float(volts @ volts + p @ p + q @ q + busbar**2)


class Greedy:
    """Removes the sensor with the largest residual over sigma until all are below a threshold."""

    def __init__(
        self, here: Scene, threshold: float, solver: CalculationMethod = CalculationMethod.newton_raphson
    ) -> None:
        self.grid, self.threshold = GridModel(here, solver), threshold

    def __call__(self, told: Reading) -> Answer:
        """One snapshot."""
        self.grid.tell(told)
        v = told.v
        named = np.zeros(v.size, dtype=np.bool_)
        try:
            for _ in range(v.size):
                estimate = self.grid.estimate()
                residual = np.where(named, 0.0, np.abs(v - estimate)) / told.std_v
                worst = int(np.argmax(residual))
                if residual[worst] <= self.threshold:
                    return Answer(named, v=estimate)
                named[worst] = True
                self.grid.mute(worst)
        except PowerGridError:
            return Answer(named, failed=True)
        return Answer(named, v=estimate)


class GreedyChi:
    """Removes the sensor with the largest normalised residual until the chi-square test passes.

    The residuals' covariance is that of the linear model, whose inverse shrinks with every removal; the
    library does not give it.
    """

    def __init__(self, here: Scene, passes: float = 0.99) -> None:
        self.grid, self.passes = GridModel(here, CalculationMethod.newton_raphson), passes
        self.feeder = here.feeder

    def __call__(self, told: Reading) -> Answer:
        """One snapshot."""
        self.grid.tell(told)
        v = told.v
        noise = (2.0 * v * told.std_v) ** 2
        known = voltage_prior(
            self.feeder,
            self.feeder.bus,
            LoadDoubt(told.std_p, told.std_q, 1.0),
            busbar=2.0 * told.v0 * told.std_v,
        )
        left = condition(known, noise, np.ones(v.size, dtype=np.bool_))
        try:
            while True:
                estimate, misfit = self.grid.judged(told, left.trusted)
                count = int(np.count_nonzero(left.trusted))
                if misfit <= chdtri(count, 1.0 - self.passes) or count == 1:
                    return Answer(~left.trusted, v=estimate)
                open_ = np.sqrt(np.maximum(left.Q.diagonal(), np.finfo(np.float64).tiny))
                size = np.where(left.trusted, np.abs(v - estimate) * 2.0 * v / noise / open_, -1.0)
                worst = int(np.argmax(size))
                remove_meter(left, worst)
                self.grid.mute(worst)
        except PowerGridError:
            return Answer(~left.trusted, failed=True)

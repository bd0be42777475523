"""Droop inverters on the AC feeder: sensitivities, equilibria, stability."""

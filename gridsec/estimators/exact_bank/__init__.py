"""Exact observer bank of chong2020 on a feeder.

design(plant, ...) -> MonitorDesign
init(design, t) -> MonitorState
step(design, state, frame) -> (MonitorState, Estimate, Verdict)
"""

from gridsec.estimators.exact_bank.step import MonitorDesign, MonitorState, design, init, step

__all__ = ["MonitorDesign", "MonitorState", "design", "init", "step"]

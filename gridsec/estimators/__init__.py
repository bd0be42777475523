"""Estimators of a feeder. Each has `design`, `init` and `step`."""

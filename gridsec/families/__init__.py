"""Estimator families of the papers on a feeder, behind the same three functions as `gridsec.monitor`."""

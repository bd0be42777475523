"""Calibration of a feeder's files by recorded readings."""

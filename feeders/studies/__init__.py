"""Offline studies of a feeder: each a function that returns a frozen result with DataFrames."""

"""The report on a feeder: what its studies found, as one page for people who decide."""

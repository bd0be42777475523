"""Reports of a feeder at one tick, in units and ids of operators."""

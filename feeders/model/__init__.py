"""Models of a feeder in per unit, made from its tables."""

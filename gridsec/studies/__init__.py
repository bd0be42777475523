"""Computations of the offline studies of a feeder: arrays in, frozen results out."""

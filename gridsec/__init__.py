"""Attack-resilient state estimation for power-distribution feeders with manipulated meters.

The mathematics of the project: arrays in, frozen dataclasses out. Nothing in this package reads a
clock, does input or output, logs, or keeps hidden state. Time is an argument everywhere, so that a
recorded day and the live service run through exactly the same code.
"""

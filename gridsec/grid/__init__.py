"""Feeders as linear and AC models: radial, meshed, in three phases."""

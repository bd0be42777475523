"""Readings from zenoh to ticks: transport, decoding, alignment."""

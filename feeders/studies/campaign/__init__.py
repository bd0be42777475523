"""Campaigns of simulated attacks on a feeder."""

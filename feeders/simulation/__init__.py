"""Simulated feeders: AC power flow, demand, meters, attacks, recordings, trials."""

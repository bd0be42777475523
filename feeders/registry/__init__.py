"""Estimators by name, plug-ins, and the cache of designs."""

"""Alarms: conditions of a feeder, and the state machine of each alarm."""

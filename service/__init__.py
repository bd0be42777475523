"""Monitoring service: readings in over zenoh, estimates and alarms out over REST and zenoh."""

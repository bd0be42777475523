"""Study of the droop fleet of a feeder: stability, voltage band, hosting capacity."""

"""Planning studies of a feeder: arrays in, frozen results out."""

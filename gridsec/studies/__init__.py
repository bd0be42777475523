"""What offline studies of a feeder compute: arrays in, frozen results out."""

"""Engine: state of the service, monitors of the feeders, and the cycle that drives them."""

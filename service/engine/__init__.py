"""Engine: state of the service, monitors of the feeders, and their cycle."""

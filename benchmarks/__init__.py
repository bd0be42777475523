"""What is fast, measured. Run `python -m benchmarks`."""

"""Report of a feeder's studies on one page."""

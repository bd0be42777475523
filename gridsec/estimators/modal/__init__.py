"""Statistical core of the default monitor: one filter, one test, one search."""

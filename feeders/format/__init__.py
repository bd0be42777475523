"""Feeder format: columns, tables, checks, and matrices of lines."""

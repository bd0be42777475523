"""Conversion of networks of other tools into feeder folders."""

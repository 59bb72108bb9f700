"""Recorded runs: their files, units, clocks and noise."""

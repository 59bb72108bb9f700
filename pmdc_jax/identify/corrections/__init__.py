"""Corrections for artefacts of sensors and recorders, which are found with the help of a fit.

A correction takes runs with the fit to them, and returns the corrected runs with the fit to those, or both
unchanged where the correction does not make the runs more likely.
"""

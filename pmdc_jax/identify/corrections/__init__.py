"""Corrections for artefacts of sensors and recorders, which are found with the help of a fit.

A correction takes the prepared runs and a fit to them, and returns the corrected runs and the fit to those, or both
unchanged where the correction does not make the runs more likely.
"""

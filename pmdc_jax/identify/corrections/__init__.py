"""What sensors and recorders put into the records that the motor never did: found by the fit, and taken out.

A correction takes the prepared runs and a fit to them, and returns the runs without what it is about and the fit to
those, or both as they are where the runs are no likelier so.
"""

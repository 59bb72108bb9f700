"""Other implementations of the same computations, tuned for speed and independent of the package.

A peer's population cost takes `candidates`, shape (P, 6) in the order R, L, Kb, Kt, J, f in SI, and
one `run`, a dictionary of canonical columns, and returns the sums of squared errors of current
(A^2) and speed (rad^2/s^2) in free run from the first measured sample, each of shape (P,).
"""

"""Least-squares fits: refinement, generalised least squares, likelihood."""

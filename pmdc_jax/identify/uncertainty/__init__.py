"""Covariance, intervals, and what the data cannot determine."""

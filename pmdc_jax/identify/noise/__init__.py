"""Noise of the sensors, and the filters that whiten residuals."""

"""The evidence that something is missing from a fitted motor."""

"""Checks of recordings before anything is fitted, and the removal of samples that are no measurements."""

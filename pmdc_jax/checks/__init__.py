"""Checks of recordings before anything is fitted."""

"""Identification of a motor from recordings."""

from .identification import Direction, Estimate, Identification, RunFit, Search
from .pipeline import identify

__all__ = ["Direction", "Estimate", "Identification", "RunFit", "Search", "identify"]

"""Identification of a motor from recordings. What one call makes, in order:

recordings
  prepare         -> Prepared: runs on an even clock, laid out on a Tape, and the Problem of least squares
  global_search   -> SearchResult: candidates
  refine, polish  -> Fit: the Optimum, its simulation (an Evaluation) and its noise
  corrections     -> FittedRuns: Prepared and Fit, for what sensors and recorders do
  last_fit        -> FittedRuns, by generalised least squares
  results_of      -> Identification: an Estimate of each parameter, a RunFit of each run, messages
"""

from .identification import Direction, Estimate, Identification, RunFit, Search
from .pipeline import identify

__all__ = ["Direction", "Estimate", "Identification", "RunFit", "Search", "identify"]

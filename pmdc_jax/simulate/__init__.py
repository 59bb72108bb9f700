"""Simulation of motors on recorded inputs."""

from .even_clock import on_even_clock
from .pipeline import simulate
from .population import squared_errors
from .reference import reference_solution
from .shooting import UNKNOWNS_PER_RUN, RunUnknowns, free_run, sensitivities
from .tape import Tape
from .timing import FIRST_ORDER_HOLD, RECORDED_EARLY, RECORDED_LATE, SMOOTH, ZERO_ORDER_HOLD, Timing

__all__ = [
    "FIRST_ORDER_HOLD",
    "RECORDED_EARLY",
    "RECORDED_LATE",
    "SMOOTH",
    "UNKNOWNS_PER_RUN",
    "ZERO_ORDER_HOLD",
    "RunUnknowns",
    "Tape",
    "Timing",
    "free_run",
    "on_even_clock",
    "reference_solution",
    "sensitivities",
    "simulate",
    "squared_errors",
]

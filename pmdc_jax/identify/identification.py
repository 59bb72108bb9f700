"""What an identification returns: plain records, read by the command line and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from attrs import field, frozen

from ..motor import Motor
from ..recording import Finding

Status = Literal["identified", "at_bound", "tied", "not_identifiable", "known"]
Role = Literal["train", "holdout"]


@frozen
class Estimate:
    """One parameter: its value (SI), standard error, 95 % interval, unit and what to make of it.

    `stderr` and `ci95` are None where the data do not determine the parameter; `value` too where no run has
    anything to do with it.
    """

    value: float | None
    stderr: float | None
    ci95: tuple[float, float] | None
    unit: str
    status: Status


@frozen
class Direction:
    """A combination of parameters that the recordings cannot see, why, and how to mend it."""

    parameters: tuple[str, ...]
    why: str
    mend: str


@frozen
class RunFit:
    """How one run is reproduced in free-run simulation from its estimated initial state.

    `*_rmse` in A and rad/s; `*_fit_percent` is 100 (1 - |y - yhat| / |y - mean y|); None where the run
    does not hold that quantity. The `current*` and `speed*` arrays have the shape of `time` (s).
    """

    role: Role
    current_rmse: float | None
    speed_rmse: float | None
    current_fit_percent: float | None
    speed_fit_percent: float | None
    load_offset: float | None  # N m, estimated constant load of a run whose load is unknown
    time: np.ndarray
    voltage: np.ndarray | None
    current: np.ndarray | None
    current_simulated: np.ndarray | None
    speed: np.ndarray | None
    speed_simulated: np.ndarray
    load: np.ndarray | None


@frozen
class Search:
    """How the search went: best and median fitness after each generation, then each refined start."""

    method: str
    evaluations: int
    best: np.ndarray  # (generations,)
    median: np.ndarray  # (generations,)
    refined: np.ndarray  # (starts,) fitness after refinement, ascending
    times_found: int  # how many of the starts ended at the best


@frozen
class Identification:
    """The motor found, how sure we are, and how well it reproduces every run."""

    motor: Motor
    parameters: Mapping[str, Estimate]
    unidentified_directions: tuple[Direction, ...]
    fit: Mapping[str, RunFit]
    noise: Mapping[str, float | None]  # current_A, speed_rad_s
    converged: bool
    seed: int
    seconds: Mapping[str, float]
    search: Search
    findings: tuple[Finding, ...]
    # of the coordinates (logarithms of positive parameters, others as they are), in the order of `covariance_names`;
    # zero rows for parameters that are fixed
    covariance: np.ndarray = field(repr=False)
    covariance_names: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()  # those messages which say that the model lacks something
    # by output (current, speed) of which far more is left than the white noise of its runs, how many times as much
    missed: Mapping[str, float] = field(factory=dict)

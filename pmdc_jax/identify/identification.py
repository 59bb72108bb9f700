"""The result of an identification: plain records, read by the command line and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from attrs import field, frozen
from jaxtyping import Float

from ..motor import Motor
from ..recordings.recording import Finding

# A refinement that ends within so many standard errors of the minimum has converged: at the kinks of dry elements,
# the linearised model predicts a reduction that no step attains
CONVERGED_DISTANCE = 0.4

Status = Literal["identified", "at_bound", "tied", "not_identifiable", "known"]
Role = Literal["train", "holdout"]


@frozen
class Estimate:
    """One parameter: its value (SI), standard error, 95 % interval, unit and status.

    `stderr` and `ci95` are None where the data do not determine the parameter or it is at a bound; `value` too
    where it affects no run.
    """

    value: float | None
    stderr: float | None
    ci95: tuple[float, float] | None
    unit: str
    status: Status


@frozen
class Direction:
    """A combination of parameters that the recordings do not determine, why, and a remedy."""

    parameters: tuple[str, ...]
    why: str
    mend: str


@frozen
class RunFit:
    """How a free-run simulation from the estimated initial state reproduces one run.

    `*_rmse` in A and rad/s; `*_fit_percent` is 100 (1 - |y - yhat| / |y - mean y|); None where the run
    does not hold that quantity.
    """

    role: Role
    current_rmse: float | None
    speed_rmse: float | None
    current_fit_percent: float | None
    speed_fit_percent: float | None
    load_offset: float | None  # N m, estimated constant load of a run whose load is unknown
    # by which share the resistance is larger at the start of a run that begins with a warm winding
    initial_rise: float | None
    time: Float[np.ndarray, " samples"]  # s
    voltage: Float[np.ndarray, " samples"] | None
    current: Float[np.ndarray, " samples"] | None
    current_simulated: Float[np.ndarray, " samples"] | None
    speed: Float[np.ndarray, " samples"] | None
    speed_simulated: Float[np.ndarray, " samples"]
    load: Float[np.ndarray, " samples"] | None

    def residual(self, channel: str) -> np.ndarray | None:
        """Measured minus simulated "speed" or "current"; None if it was not recorded."""
        measured, simulated = getattr(self, channel), getattr(self, f"{channel}_simulated")
        return None if measured is None or simulated is None else np.asarray(measured - simulated)


@frozen
class Search:
    """Record of the search: best and median fitness of the generations, those of repeated searches one after another,
    and the fitness of each refined start."""

    method: str
    evaluations: int
    best: Float[np.ndarray, " generations"]
    median: Float[np.ndarray, " generations"]
    refined: Float[np.ndarray, " starts"]  # fitness after refinement, ascending
    times_found: int  # how many of the starts ended in the best optimum
    interrupted: bool = False  # whether the keyboard ended it early


@frozen
class Identification:
    """The identified motor, the uncertainty of its parameters, and how well it reproduces every run."""

    motor: Motor
    parameters: Mapping[str, Estimate]
    unidentified_directions: tuple[Direction, ...]
    fit: Mapping[str, RunFit]
    noise: Mapping[str, float | None]  # current_A, speed_rad_s
    # predicted from the gradient: how far the best fit is from where the refinement ended, in standard errors
    distance: float
    seed: int
    seconds: Mapping[str, float]
    search: Search
    findings: tuple[Finding, ...]
    # of logarithms of positive parameters, and of others in SI, in the order of `covariance_names`;
    # zero rows for those held at a bound
    covariance: Float[np.ndarray, "coordinates coordinates"] = field(repr=False)
    covariance_names: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()  # those messages which say that the model lacks something
    # RMS of the residuals over their white noise, for outputs (current, speed) for which it is large
    missed: Mapping[str, float] = field(factory=dict)

    @property
    def converged(self) -> bool:
        """Whether the refinement ended near the best fit, by the gradient."""
        return self.distance <= CONVERGED_DISTANCE

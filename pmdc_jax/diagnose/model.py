"""A motor with some effects, fitted, and what its fit leaves of every run."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..effects import EFFECTS, CoulombFriction
from ..identify.pipeline import Prepared
from ..identify.refine import Polished
from ..motor import Motor
from ..simulate import Tape
from .noise import Series
from .response import Path, path_of


class Model(NamedTuple):
    """A motor with some effects, fitted to the recordings."""

    effects: tuple[str, ...]
    given: Prepared
    polished: Polished

    @property
    def motor(self) -> Motor:
        """The fitted motor."""
        return self.given.problem.parameters(self.polished.refined.unknowns.coordinates)

    @property
    def dry(self) -> float:
        """Coulomb friction, N m."""
        found = [e.torque_Nm for e in self.motor.effects if isinstance(e, CoulombFriction)]
        return float(found[0]) if found else 0.0

    @property
    def path(self) -> Path:
        """The free run along which it was fitted."""
        held = "speed" in {EFFECTS[name].holds for name in self.effects}
        return path_of(self.polished.evaluation.seen, self.given.problem.tape, held)

    @property
    def training(self) -> list[int]:
        """The runs that it was fitted to."""
        return [run for run, role in enumerate(self.given.roles) if role == "train"]


class Fit(NamedTuple):
    """Of one training run, in A and rad/s: what is measured less what is simulated, and the derivatives of the
    latter by the motor's parameters and by what belongs to the run alone."""

    shared: Series
    own: Series
    residual: Series


def rows_of(model: Model) -> list[Fit]:
    """The fit of every training run, in the order of time."""
    evaluation, tape = model.polished.evaluation, model.given.problem.tape
    noise = model.polished.noise[:, None]
    J = np.asarray(evaluation.jacobian) * noise[..., None]
    r = -np.asarray(evaluation.residuals) * noise
    count = model.given.problem.free.shape[0]
    parts = (J[..., :count], J[..., count:], r)
    return [Fit(*(series_of(tape, run, part) for part in parts)) for run in model.training]


def series_of(tape: Tape, run: int, signal: np.ndarray) -> Series:
    """A signal (blocks, 2, samples, ...) of one run in the order of time, of the outputs that it has."""
    mine = np.asarray(tape.run) == run
    part = np.moveaxis(signal[mine], 1, 2)
    values = part.reshape(-1, *part.shape[2:])
    weight = np.moveaxis(np.asarray(tape.weight)[mine], 1, 2).reshape(-1, 2) > 0
    outputs = tuple(int(c) for c in np.flatnonzero(weight.any(0)))
    first = np.flatnonzero(mine)[0]
    kind = (float(np.asarray(tape.sample_time)[np.asarray(tape.grid)[first]]), outputs)
    return Series(values[:, list(outputs)], np.asarray(weight[:, list(outputs)].all(1)), kind)

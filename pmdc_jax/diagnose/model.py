"""A motor with some effects, fitted, and what its fit leaves of every run."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..effects import EFFECTS, CoulombFriction
from ..identify.prepare import Prepared
from ..identify.refine import Polished, Refined, polish
from ..identify.solve import settle
from ..identify.turning import turned
from ..identify.whitening import Whitening
from ..motor import Motor
from ..simulate import Tape
from .noise import Series, Whitener
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
        return _training(self.given)


# Gauss-Newton steps from one fit to white residuals to another
SHARPENED = 8
# A fit to white residuals may leave so many times the plain squares of the fit that leaves least of them
NEAR = 1.5


def sharpened(model: Model, white: Whitener) -> tuple[Prepared, Polished]:
    """The problem of fitting a model to residuals that a filter makes white, and that fit."""
    given = whitened(model.given, white)
    return given, polish(given.problem, model.polished.refined, SHARPENED)


def settled(effects: tuple[str, ...], given: Prepared, start: Refined, white: Whitener) -> Model:
    """A model fitted from a start to residuals that a filter makes white."""
    given, ended = settle(whitened(given, white), start)
    given = given._replace(problem=replace(given.problem, whitening=None))
    # no step: what it leaves as it is
    plain = polish(given.problem, ended.refined, steps=0)
    refined = ended.refined._replace(fitness=plain.refined.fitness)
    return model_of(effects, given, plain._replace(refined=refined))


def model_of(effects: tuple[str, ...], given: Prepared, polished: Polished) -> Model:
    """A fitted model, its rotor turned as the fit says."""
    if not given.problem.angular:  # or else it was fitted so
        given = given._replace(problem=turned(given.problem, polished.evaluation.seen))
    return Model(effects, given, polished)


def ended(model: Model, white: Whitener) -> tuple[Prepared, Polished]:
    """The last fit of a model: to white residuals, unless that is far from reproducing the runs as they are, as where
    a formula is not quite nature's."""
    given, sharp = sharpened(model, white)
    as_it_is = polish(model.given.problem, sharp.refined, steps=0).refined.fitness
    plainly = settle(model.given, model.polished.refined)
    near = as_it_is < NEAR * plainly[1].refined.fitness
    return (given, sharp) if near else plainly


def squares_of(given: Prepared, polished: Polished) -> float:
    """The sum of squares that a fit leaves of the training runs."""
    residuals = np.asarray(polished.evaluation.residuals)
    return float(np.square(residuals[given.problem.counted]).sum())


def whitened(given: Prepared, white: Whitener) -> Prepared:
    """The problem of fitting to residuals that a filter makes white."""
    tape, noise = given.problem.tape, np.asarray(given.problem.noise)
    filters = [np.zeros((0, 2, 2))] * tape.runs
    # hold-outs are nothing to learn a filter from
    scales = [np.diag(1 / noise)] * tape.runs
    for run, A, S in zip(_training(given), white.filters, white.scales, strict=True):
        both = np.ix_(*2 * [_outputs(tape, run)])
        filters[run], scales[run] = np.zeros((len(A), 2, 2)), np.zeros((2, 2))
        filters[run][:, *both], scales[run][both] = A, S
    whitening = Whitening.of(filters, scales, tape.weight, tape.run)
    return given._replace(problem=replace(given.problem, whitening=whitening))


def _training(given: Prepared) -> list[int]:
    return [run for run, role in enumerate(given.roles) if role == "train"]


def _outputs(tape: Tape, run: int) -> np.ndarray:
    """The outputs that a run has."""
    weight = np.asarray(tape.weight)[np.asarray(tape.run) == run]
    return np.flatnonzero(weight.any((0, 2)))


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
    outputs = tuple(int(c) for c in _outputs(tape, run))
    first = np.flatnonzero(mine)[0]
    kind = (float(np.asarray(tape.sample_time)[np.asarray(tape.grid)[first]]), outputs)
    return Series(values[:, list(outputs)], np.asarray(weight[:, list(outputs)].all(1)), kind)

"""A motor with some effects, fitted, with its residuals and sensitivities in every run."""

from __future__ import annotations

import attrs
import numpy as np

from ..effects import AsymmetricFriction, CoulombFriction, InputDeadZone
from ..identify.fit.fitted_runs import FittedRuns
from ..identify.fit.gauss_newton import TRIAL_TOLERANCE
from ..identify.fit.generalised_least_squares import last_fit, with_whitening
from ..identify.fit.polish import Fit, fit_at, reweighted
from ..identify.fit.refine import Optimum
from ..identify.noise.noise_model import Whitener
from ..identify.prepare import Prepared
from ..identify.problem import Problem
from ..identify.rotor_angle import rotor_outputs, with_rotor_angle
from ..identify.solve import polish_with_angle
from ..identify.uncertainty.covariance import MIN_UNSEEN_STDERR
from ..motor import Motor
from .response import Trajectory, trajectory_of

# Largest number of effects in a set
MAX_EFFECTS = 3
# Least relative standard deviation of voltages that differ in size
MIN_VOLTAGE_SPREAD = 0.05
# A model is exact if its residuals are a smaller share of what was measured, as root mean squares
EXACT_MISFIT = 1e-4
# Misfit (noise variances per output) from which a first-order start, or where a rotor sticks any start, may lead a
# refit to a wrong optimum
POOR_MISFIT = 10.0
# Standard errors from the end of a fit to where the gradient leads beyond which it has found no optimum
STALLED_DISTANCE = 3.0


@attrs.frozen(eq=False)
class Model:
    """A motor with some effects, fitted to the recordings; compared and hashed by identity."""

    fitted: FittedRuns

    @property
    def prepared(self) -> Prepared:
        """The recordings as prepared for it."""
        return self.fitted.prepared

    @property
    def problem(self) -> Problem:
        """The least-squares problem that its fit solves."""
        return self.fitted.problem

    @property
    def fit(self) -> Fit:
        """Its fit to the recordings."""
        return self.fitted.fit

    @property
    def effects(self) -> tuple[str, ...]:
        """The names of its effects."""
        return tuple(effect.name for effect in self.problem.parameters.effects)

    @property
    def motor(self) -> Motor:
        """The fitted motor."""
        return self.problem.parameters(self.fit.coordinates)

    @property
    def is_possible(self) -> bool:
        """Whether it can be simulated, its effects are physical, and the runs show a periodic torque or a dead zone."""
        simulated = np.isfinite(self.fit.fitness)
        plausible = all(effect.is_possible() for effect in self.motor.effects)
        return bool(simulated) and plausible and self._completes_periods and self._shows_dead_zone

    @property
    def _completes_periods(self) -> bool:
        """Whether some run turns through a whole period of each torque that is periodic in the rotor angle.

        Over less than a period, any torque that depends on position may look like part of one.
        """
        periods = [effect.repeats_after().get("angle", 0.0) for effect in self.motor.effects]
        return not any(periods) or bool(max(periods) <= self.travel)

    @property
    def _shows_dead_zone(self) -> bool:
        """Whether the voltages beyond the dead zone, if there is one, differ in size.

        To a supply that is only switched on and off it would be another gain, and what it then explains is noise of the
        recorded voltage where that is zero.
        """
        width = sum(float(e.width_V) for e in self.motor.effects if isinstance(e, InputDeadZone))
        tape = self.problem.tape
        driven = [k for k in self.prepared.training_indices if tape.drive_of(k).voltage]
        if not width or not driven:
            return True
        voltage = np.abs(np.asarray(tape.value)[np.isin(np.asarray(tape.run), driven)])
        beyond = voltage[voltage > width]
        return bool(len(beyond) and np.std(beyond) > MIN_VOLTAGE_SPREAD * np.mean(beyond))

    @property
    def travel(self) -> float:
        """The largest range of rotor angles, in rad, of any training run."""
        angle, tape = np.asarray(self.trajectory.angle), self.problem.tape
        return float(max(np.ptp(angle[:, tape.blocks_of(run)]) for run in self.prepared.training_indices))

    @property
    def is_poor(self) -> bool:
        """Whether it leaves so much more than the noise (`POOR_MISFIT`) that it may be a wrong optimum."""
        return self.fit.fitness > POOR_MISFIT * self.problem.perfect_fitness

    @property
    def is_stalled(self) -> bool:
        """Whether its fit ended far from where a gradient leads (`STALLED_DISTANCE`), as where a rotor sticks and
        slips."""
        return self.fit.optimum.distance > STALLED_DISTANCE

    @property
    def at_bound(self) -> set[str]:
        """The parameters that are held at their bounds."""
        return {self.problem.parameters.names[k] for k in self.fit.at_bound}

    @property
    def effects_at_end(self) -> set[str]:
        """The effects with a parameter that is held at its bound or `undetermined`."""
        at_end = self.at_bound | self.undetermined
        return {name.partition(".")[0] for name in at_end} & set(self.effects)

    @property
    def undetermined(self) -> set[str]:
        """The parameters to which no run is sensitive (standard error above `MIN_UNSEEN_STDERR`), so that a refit would
        not move them."""
        problem = self.problem
        names = problem.parameters.names
        # columns of each run's own unknowns follow those of the parameters
        jacobian = np.asarray(self.fit.evaluation.jacobian)
        columns = jacobian[problem.fitted_blocks][..., : len(names)]
        information = np.square(columns).reshape(-1, len(names)).sum(axis=0)
        return {name for name, square in zip(names, information, strict=True) if square < 1 / MIN_UNSEEN_STDERR**2}

    @property
    def coulomb_torque(self) -> float:
        """Coulomb friction, N m, the mean of both directions."""
        return sum(self._friction) / 2

    @property
    def friction_asymmetry(self) -> float:
        """The constant load within asymmetric friction, N m: half the difference of forward and backward friction."""
        backward, forward = self._friction
        return (forward - backward) / 2

    @property
    def _friction(self) -> tuple[float, float]:
        """Coulomb friction backward and forward, N m."""
        for effect in self.motor.effects:
            if isinstance(effect, CoulombFriction):
                return float(effect.torque_Nm), float(effect.torque_Nm)
            if isinstance(effect, AsymmetricFriction):
                return float(effect.backward_Nm), float(effect.forward_Nm)
        return 0.0, 0.0

    @property
    def trajectory(self) -> Trajectory:
        """The free run of the fitted motor: the states of the rotor itself, before any sensor."""
        held = {effect.holds for effect in self.motor.effects}
        problem = self.problem
        start_angle = self.fit.unknowns.runs.angle
        return trajectory_of(
            rotor_outputs(problem, self.fit),
            problem.tape,
            start_angle,
            can_stick="speed" in held,
            can_coast="current" in held,
        )

    @property
    def relative_misfit(self) -> float:
        """Its residuals over what was measured, as root mean squares, for the output where that is larger."""
        sizes = self.problem.measured_rms
        measured = sizes > 0
        return float(np.max(self.fit.noise[measured] / sizes[measured], initial=0.0))

    @property
    def is_exact(self) -> bool:
        """Whether its residuals are negligible, as small as between two simulations."""
        return self.relative_misfit < EXACT_MISFIT


def refit_from(prepared: Prepared, start: Optimum, white: Whitener, give_up_above: float = np.inf) -> Model:
    """A model fitted from a start to whitened residuals; its `fit` is evaluated without the filter.

    **Arguments**: `give_up_above`, a sum of squared white residuals, as of `polish`.
    """
    prepared, whitened = polish_with_angle(
        with_whitening(prepared, white), start, TRIAL_TOLERANCE, give_up_above=give_up_above
    )
    prepared = prepared.with_problem(whitening=None)
    # no step: the unfiltered residuals at the same point
    unfiltered = fit_at(prepared.problem, whitened.optimum)
    optimum = whitened.optimum._replace(fitness=unfiltered.fitness)
    return model_of(FittedRuns(prepared, unfiltered._replace(optimum=optimum)))


def model_of(fitted: FittedRuns) -> Model:
    """A fitted model, with the rotor angle of each sample estimated from recordings and fit together."""
    if not fitted.problem.depends_on_angle:  # with an effect of the angle, the fit has done this
        prepared = fitted.prepared._replace(problem=with_rotor_angle(fitted.problem, fitted.fit))
        fitted = fitted._replace(prepared=prepared)
    return Model(fitted)


def final_fit(model: Model, white: Whitener) -> FittedRuns:
    """The last fit of a model: to whitened residuals where `last_fit` allows it, else by plain least squares."""
    at_start = reweighted(model.problem, model.fit)
    unfiltered = polish_with_angle(model.prepared, model.fit.optimum, at_start=at_start)
    return last_fit(unfiltered, model.fit, white)

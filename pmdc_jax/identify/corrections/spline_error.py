"""A speed that is the derivative of a spline through angles, where the real one bends: as voltage or load steps.

Sampled slowly beside L / R, a motor's acceleration jumps with its voltage. No spline follows: there and nearby it is
off by some per cent of what the jump does in a sample, which looks like a shaft or a delay.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import expm

from ...simulate.tape import BLOCK
from ...simulate.uniform import speed_by_spline
from ..polish import Fit, polish
from ..prepare import Prepared
from ..problem import Problem
from .speed_averaging import two_undone

# Refits at most, each with the error of the better motor
PASSES = 4
# ... and the share by which a refit must lower the misfit to be worth another
IDLE = 1e-4


def without_spline_error(given: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs with speeds less what a spline through angles puts into them, as the fitted linear motor has it, and the
    fit to them; again, as long as it helps, by the better motor. Both as they are where no speed is of angles."""
    splined = [run for run, ours in enumerate(given.differentiated) if ours or given.averaging]
    mended, better = given, fit
    for _ in range(PASSES if splined else 0):
        again = _less_error_of(given, splined, better)
        next_fit = polish(again.problem, better.optimum)
        if not next_fit.fitness < (1 - IDLE) * better.fitness:
            break
        mended, better = again, next_fit
    return mended, better


def _less_error_of(given: Prepared, splined: list[int], fit: Fit) -> Prepared:
    """The runs as they are, with speeds less what the spline makes of the motion of this fit."""
    problem, tape = given.problem, given.problem.tape
    measured = np.array(tape.measured)
    for run in splined:
        mine = tape.blocks_of(run)
        error = _spline_error(problem, fit, run, given.differentiated[run], len(given.runs[run]))
        measured[mine, 1] -= error * (np.asarray(tape.weight)[mine, 1] > 0)
    return given.with_tape(measured=jnp.asarray(measured))


def _spline_error(
    problem: Problem, fit: Fit, run: int, of_angle: bool, samples: int
) -> Float[np.ndarray, "blocks samples"]:
    """By how much, in rad/s, the spline through the angles of a run is off, or that which undoes a mean."""
    angle, speed, step = _linear_motion(problem, fit, run)
    error = np.zeros_like(speed)
    if angle is not None:
        angle, time = angle[:samples], step * np.arange(samples)
        by_angle = (
            speed_by_spline(angle, time) if of_angle else two_undone(np.gradient(angle, step))
        )
        error[:samples] = by_angle - speed[:samples]
    return error.reshape(-1, BLOCK)


def _linear_motion(
    problem: Problem, fit: Fit, run: int
) -> tuple[Float[np.ndarray, " samples"] | None, Float[np.ndarray, " samples"], float]:
    """Angle in rad and speed in rad/s of the fitted linear motor, and the sample time in s.

    No angle where what drives flows on between samples, as a current does, so that the motion does not bend.
    """
    tape, mine = problem.tape, problem.tape.blocks_of(run)
    current, speed = np.moveaxis(np.asarray(fit.evaluation.seen)[mine], 1, 0)
    drive, step = tape.drive_of(run), tape.sample_time_of(run)
    if drive.current or tape.rise is not None:
        return None, speed.ravel(), step
    motor = problem.parameters(fit.coordinates)
    rates = np.zeros((5, 5))  # of current, speed, inputs and angle
    rates[:2, :2], rates[:2, 2:4] = map(np.asarray, motor.state_space(drive))
    rates[4, 1] = 1.0
    value, load = (np.asarray(held)[mine] for held in (tape.value, tape.load))
    turned = expm(rates * step)[4, :4] @ np.stack([current, speed, value, load]).reshape(4, -1)
    return np.cumsum(turned) - turned, speed.ravel(), step

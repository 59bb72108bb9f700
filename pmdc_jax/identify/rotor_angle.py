"""The angle that the rotor turns in each sample, for torques that depend on it."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import fft, ndimage

from ..recordings.noise import NORMAL_MEDIAN
from ..simulate import free_run
from .fit.polish import Fit
from .problem import Problem

# Neighbouring frequencies over which the power of the residuals is averaged
SMOOTHING_WIDTH = 33


def rotor_outputs(problem: Problem, fit: Fit) -> Float[Array, "blocks 2 samples"]:
    """Simulated current and speed of the rotor itself, A and rad/s, at the start of each sample, without sensor effects
    and averaging."""
    effects, tape = problem.parameters.effects, problem.tape
    as_seen = tape.averaging is None and tape.reading is None
    if as_seen and all(effect.equation != "sensor" for effect in effects):
        return fit.evaluation.simulated
    unknowns = fit.unknowns
    motor = problem.parameters(unknowns.coordinates)
    bare = motor.with_effects(effect for effect in motor.effects if effect.equation != "sensor")
    return free_run(bare, replace(tape, averaging=None, span=None, later=None, reading=None), unknowns.runs)


def with_rotor_angle(problem: Problem, fit: Fit) -> Problem:
    """The problem with the rotor angle estimated from recordings and simulation together.

    The angle is the integral of the speed. Integrating the measured speed accumulates the sensor's noise, integrating
    the simulated one the effect of torque disturbances. The speed is therefore the simulated one of the rotor itself,
    plus the part of the residual that is motion, with the delay of the sensor undone.
    """
    motor = problem.parameters(fit.coordinates)
    tape, simulated = problem.tape, np.asarray(fit.evaluation.simulated)
    rotor = np.asarray(rotor_outputs(problem, fit))
    turn, run = np.array(tape.turn), np.asarray(tape.run)
    sample_time = np.asarray(tape.block_sample_time)
    for index in range(tape.runs):
        mine = (run == index) & ~np.isnan(turn).all(1)
        measured, weight = (np.asarray(x)[mine, 1].reshape(-1) for x in (tape.measured, tape.weight))
        expected = simulated[mine, 1].reshape(-1)
        known = np.flatnonzero(weight)
        if not len(known) or not np.all(np.isfinite(expected)):
            continue
        end = known[-1] + 1
        error = np.where(weight[:end] > 0, measured[:end] - expected[:end], 0.0)
        speed = rotor[mine, 1].reshape(-1).copy()
        time = np.cumsum(np.repeat(sample_time[mine], turn.shape[1]))[:end]
        unmodelled = motion_in(error)
        for effect in motor.effects:
            unmodelled = effect.speed_before_sensor(unmodelled, time)
        speed[:end] += unmodelled
        following = np.append(speed[1:], speed[-1])
        mean = ((speed + following) / 2).reshape(turn[mine].shape)
        turn[mine] = mean * sample_time[mine, None]
    return eqx.tree_at(lambda p: p.tape.turn, problem, jnp.asarray(turn))


def motion_in(error: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """The part of measured minus simulated speed that is motion instead of sensor noise.

    A Wiener smoother: every frequency is weighted by the share of its power that exceeds the white noise, whose level
    is taken from the upper half of the spectrum.

    **Source**: Wiener, "Extrapolation, Interpolation, and Smoothing of Stationary Time Series" (1949).
    """
    spectrum = np.asarray(fft.dct(error, norm="ortho"))
    power = spectrum**2
    noise = np.median(power[len(power) // 2 :]) / NORMAL_MEDIAN**2
    # two standard deviations of the average of so few powers: fluctuations of the noise are no motion
    noise *= 1 + 2 * np.sqrt(2 / SMOOTHING_WIDTH)
    around = ndimage.uniform_filter1d(power, SMOOTHING_WIDTH, mode="reflect")
    share = np.clip(1 - noise / np.maximum(around, 1e-300), 0.0, 1.0)
    return np.asarray(fft.idct(share * spectrum, norm="ortho"))

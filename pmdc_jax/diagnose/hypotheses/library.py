"""The candidates that the recordings can show, and what each changes along a trajectory, to first order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from ...effects import EFFECTS, AbstractEffect
from ...identify.noise.sensor_noise import is_coarse
from ...motor import Motor
from ...recordings.recording import Recording
from ...recordings.resolution import common_divisor, quantum
from ...runtime.compiled import quickly_compiled
from ...runtime.threads import run_ahead
from ...simulate import Tape, free_run
from ..model import Model
from ..response import Outputs, Trajectory, sensor_changes, state_increments
from .candidates import Candidate, Scales
from .change import Change, columns_at_once
from .effect_relations import unbalanced_equation
from .trials import all_candidates

# A motor counts as moving above this share of `Scales.speed`
MOVING_SHARE = 0.02
# `Scales.slow_speed` is this quantile of its speeds while it moves
SLOW_QUANTILE = 0.05
# A step of the voltage counts as the resolution of a converter below this share of the largest voltage (seven bits)
MAX_CONVERTER_STEP = 0.01


class Library:
    """The candidates that the recordings can show, and what each changes in the motor without effects."""

    def __init__(self, base: Model) -> None:
        """`base` is the motor without effects, as fitted."""
        self.bare = jax.tree.map(jnp.asarray, base.motor)
        self.scales = _scales(base)
        tape = base.problem.tape
        self.measures_current = bool(np.any(np.asarray(tape.weight)[base.problem.fitted_blocks, 0]))
        has_current = self.measures_current or bool(np.any(np.asarray(tape.drive.current) > 0))
        has_voltage = bool(np.any(np.asarray(tape.drive.voltage) > 0))
        observable = {
            name
            for name, effect in EFFECTS.items()
            if (has_current or not effect.needs_current)
            and (has_voltage or unbalanced_equation(effect.equation) != "electrical")
        }
        self.candidates = [c for c in all_candidates(self.scales) if c.effect in observable]
        # the errors of a coarse encoder last long enough to look like a voltage that changes over time
        self.has_coarse_speed = any(is_coarse(speed) for speed in _measured_speeds(base.prepared.training))
        # so may what remains of the noise that was taken out of the recorded voltage
        self.has_input_noise = bool(base.prepared.input_noise)
        # by unit: the amplitude that imperfect sensors alone may produce
        self.sensor_floors = _sensor_floors(base)
        self._simulated: dict[int, np.ndarray] = {}
        self._base = base

    def changes(self, tape: Tape, trajectory: Trajectory) -> Iterator[Change]:
        """What the candidates change along a trajectory, in their order; a `Change` has some of one effect."""
        return run_ahead(self._change_calls(tape, trajectory))

    def _change_calls(self, tape: Tape, trajectory: Trajectory) -> Iterator[Callable[[], Change]]:
        """Functions that compute the changes, each of as many columns as are simulated together."""
        for name in EFFECTS:
            shapes = [c for c in self.candidates if c.effect == name]
            if shapes and shapes[0].full_simulation:
                yield partial(self._simulated_change, shapes)
            elif shapes:
                settings = [values for c in shapes for values in c.columns]
                units = np.array([unit for c in shapes for unit in c.units])
                parts = -(-len(settings) // columns_at_once(tape))
                for part in np.array_split(np.arange(len(settings)), parts):
                    values = {f: np.array([settings[k][f] for k in part]) for f in settings[0]}
                    yield partial(_small_change, EFFECTS[name], values, units[part], self.bare, tape, trajectory)

    def _simulated_change(self, shapes: Sequence[Candidate]) -> Change:
        """What an effect at finite size changes in the records, by full simulations."""
        simulated = np.stack([self._simulated_response(c) for c in shapes], -1)
        return Change(simulated.astype(np.float32), by_sensor=True)

    def _simulated_response(self, candidate: Candidate) -> np.ndarray:
        """The response to a setting at finite size, simulated once and kept: (samples, 2, blocks)."""
        key = id(candidate)
        if key not in self._simulated:
            values = {field: jnp.asarray(x) for field, x in candidate.columns[0].items()}
            motor = self.bare.with_effects([EFFECTS[candidate.effect](**values)])
            prepared, fit = self._base.prepared, self._base.fit
            simulated = free_run(motor, prepared.problem.tape, fit.unknowns.runs)
            change = np.asarray(simulated) - np.asarray(fit.evaluation.simulated)
            self._simulated[key] = change.transpose(2, 1, 0)
        return self._simulated[key]


def _sensor_floors(base: Model) -> dict[str, float]:
    """By unit, the amplitude that imperfect sensors alone may produce: the noise taken out of the recorded voltage (V,
    standard deviation) or its resolution, if larger; half the quantum of the current (A)."""
    training = [run.recorded for run in base.prepared.training]
    currents = [run.current for run in training if run.current is not None]
    rounded = max((quantum(np.diff(current)) / 2 for current in currents), default=0.0)
    noise = max(base.prepared.input_noise.values(), default=0.0)
    volts = [run.voltage for run in training if run.voltage is not None]
    return {"V": max(noise, _converter_step(np.concatenate(volts or [np.zeros(1)]))), "A": rounded}


def _converter_step(volts: np.ndarray) -> float:
    """The step, in V, to which a converter rounds or truncates; zero for far coarser levels, set by a programme."""
    step = common_divisor(volts)
    return step if step < MAX_CONVERTER_STEP * np.max(np.abs(volts)) else 0.0


def _measured_speeds(runs: Sequence[Recording]) -> list[np.ndarray]:
    """The measured speeds, to judge their resolution; for measured angles the central differences, rad per sample."""
    speeds = [run.speed for run in runs if run.speed is not None]
    return speeds + [np.gradient(run.angle) for run in runs if run.angle is not None]


def _small_change(effect: type[AbstractEffect], *arguments: Any) -> Change:
    """What small settings of an effect change, divided by their units; `arguments` as of `_change_per_unit`."""
    values = np.asarray(_change_per_unit(effect, *arguments))
    return Change(values, by_sensor=effect.equation == "sensor")


@quickly_compiled
def _change_per_unit(
    effect: type[AbstractEffect],
    settings: Mapping[str, Array | np.ndarray],
    units: Float[Array | np.ndarray, " columns"],
    bare: Motor,
    tape: Tape,
    trajectory: Trajectory,
) -> Float32[Array, "samples 2 blocks columns"]:
    """The state increments, or changes by sensors, of settings of one effect, each divided by its unit."""
    change = sensor_changes if effect.equation == "sensor" else state_increments

    def per_unit(values: Mapping[str, Array | np.ndarray], unit: Array | np.ndarray) -> Outputs:
        return change(bare.with_effects([effect(**values)]), bare, tape, trajectory) / unit

    return jax.vmap(per_unit, out_axes=-1)(settings, units).astype(jnp.float32)


def _scales(base: Model) -> Scales:
    """The typical sizes in the fitted runs, mostly 95 % quantiles of magnitudes."""
    tape, motor = base.problem.tape, base.motor
    fitted = base.problem.fitted_blocks
    observed = np.asarray(tape.weight)[fitted].any(1)
    simulated = np.abs(np.asarray(base.fit.evaluation.simulated)[fitted])
    current, speed = (float(np.quantile(simulated[:, c][observed], 0.95)) + 1e-9 for c in range(2))
    speeds = np.append(simulated[:, 1][observed], speed)
    slow = float(np.quantile(speeds[speeds > MOVING_SHARE * speed], SLOW_QUANTILE))
    value = float(np.quantile(np.abs(np.asarray(tape.value)[fitted][observed]), 0.95)) + 1e-9
    torque_driven = bool(np.all(np.asarray(tape.drive.torque) > 0))
    return Scales(
        current=current,
        speed=speed,
        slow_speed=slow,
        voltage=value,
        torque=value if torque_driven else float(motor.Kt) * current,
        inertia=float(motor.J),
        sample_time=float(np.min(np.asarray(tape.sample_time))),
        duration=max(run.duration for run in base.prepared.training),
        travel=base.travel,
    )

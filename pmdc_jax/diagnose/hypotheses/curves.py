"""Curves: terms of unknown shape in the equations or sensors, for what is missing that no effect of the library is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from ...simulate import Tape
from ..response import Trajectory, input_gains
from .change import Change
from .library import Library

# The variables over which each equation may have an unknown curve
CURVE_VARIABLES = {"mechanical": ("speed", "current", "time"), "electrical": ("current", "speed", "voltage", "time")}
CURVE_UNITS = {"mechanical": "N m", "electrical": "V"}
# Knots of a curve over speed, current or voltage
KNOTS = 9
# Knots of a curve over the time of each run
KNOTS_IN_TIME = 7
# Periods per turn of the rotor of a torque that is periodic behind a gear; so dense that neighbours differ by half a
# period over about 500 rad
PERIODS_BEHIND_GEAR = np.arange(0.02, 0.25, 0.006)
KNOTS_IN_PERIOD = 25


class Curve(NamedTuple):
    """An unknown term: piecewise linear in one variable, or a sinusoid of the angle."""

    equation: str  # "mechanical", "electrical", or "sensor" for what a sensor misreads
    variable: str
    unit: str
    knots: np.ndarray
    per_run: bool = False  # every run has a curve of its own
    # (knots, columns): values of the columns at the knots; None where these are hat functions, one per knot
    shapes: np.ndarray | None = None
    # changes sign with the direction of motion, such as a friction that varies over time
    reverses: bool = False
    # known to show noise, and so no evidence
    is_noise: bool = False

    @property
    def width(self) -> int:
        """How many coefficients it has (in one run, with `per_run`)."""
        return len(self.knots) if self.shapes is None else self.shapes.shape[1]

    @property
    def is_angle_wave(self) -> bool:
        """Whether it is a sinusoid of the angle."""
        return self.variable == "angle"

    @property
    def is_sensor_error(self) -> bool:
        """Whether it is an error of a sensor that no effect of the library has."""
        return self.equation == "sensor"

    @property
    def is_sensor_ripple(self) -> bool:
        """Whether it is a ripple of the speed sensor over the rotor angle, as a share of the speed."""
        return self.is_sensor_error and self.is_angle_wave

    @property
    def periods(self) -> float:
        """Periods per turn of a sinusoid."""
        return float(2 * np.pi / self.knots[-1])

    def values(self, coefficients: np.ndarray) -> np.ndarray:
        """The curve at its knots."""
        return coefficients if self.shapes is None else self.shapes @ coefficients

    def errors(self, errors: np.ndarray) -> np.ndarray:
        """Standard errors of the curve at its knots, from those of its coefficients."""
        return errors if self.shapes is None else np.sqrt(self.shapes**2 @ errors**2)


def curves_along(library: Library, tape: Tape, trajectory: Trajectory) -> tuple[list[Curve], Iterator[Change]]:
    """The curves over all variables of all equations, the sinusoids of the angle, and what each changes."""
    terms = [*_equation_curves(library, tape, trajectory), *_angle_waves(library, tape, trajectory)]
    if library.measures_current:
        terms.append(_late_current(tape, trajectory))
    return [curve for curve, _ in terms], (change() for _, change in terms)


# A curve, and a function that computes what it changes
Term = tuple[Curve, Callable[[], Change]]


def _equation_curves(library: Library, tape: Tape, trajectory: Trajectory) -> Iterator[Term]:
    """The curves of each equation over its variables (`CURVE_VARIABLES`)."""
    volt, torque = (np.asarray(gain) for gain in input_gains(library.bare, tape))
    value = np.asarray(tape.value).T
    known = {"speed": np.asarray(trajectory.speed), "current": np.asarray(trajectory.current), "voltage": value}
    known["time"] = _share_of_run(tape)
    weight = np.any(np.asarray(tape.weight), axis=1).T
    voltage_driven = bool(np.any(np.asarray(tape.drive.voltage) > 0))
    for equation, variables in CURVE_VARIABLES.items():
        if equation == "electrical" and not voltage_driven:
            continue
        gain = torque if equation == "mechanical" else volt
        for variable in variables:
            in_time, x = variable == "time", known[variable]
            if in_time and library.has_coarse_speed and equation == "electrical":
                continue
            knots = np.linspace(0, 1, KNOTS_IN_TIME) if in_time else _knots(x, weight)
            hats = partial(_hats, x, knots)
            is_noise = in_time and equation == "electrical" and library.has_input_noise
            unit = CURVE_UNITS[equation]
            curve = Curve(equation, variable, unit, knots, in_time, is_noise=is_noise)
            yield curve, partial(_change_by_input, gain, hats)
            if in_time and equation == "mechanical":
                turning = partial(_hats, x, knots, _direction(known["speed"], tape))
                reversing = Curve(equation, variable, unit, knots, in_time, reverses=True)
                yield reversing, partial(_change_by_input, gain, turning)


def _angle_waves(library: Library, tape: Tape, trajectory: Trajectory) -> Iterator[Term]:
    """Sinusoids of the angle: a torque behind a gear, and a ripple of the speed sensor in proportion to the speed, such
    as of a tachometer or an eccentric encoder."""
    angle, speed = np.asarray(trajectory.angle), np.asarray(trajectory.speed)
    torque = np.asarray(input_gains(library.bare, tape)[1])
    for periods in PERIODS_BEHIND_GEAR:
        wave = partial(_wave, periods * angle)
        yield _wave_curve("mechanical", "N m", periods), partial(_change_by_input, torque, wave)
    of_rotor = [c.columns[0]["periods"] for c in library.candidates if c.effect == "cogging_torque"]
    for periods in of_rotor:
        yield _wave_curve("sensor", "", periods), partial(_sensor_ripple, speed, periods * angle)


def _late_current(tape: Tape, trajectory: Trajectory) -> Term:
    """A current that is read late, as behind a filter: an error in proportion to its rate of change."""
    current = np.asarray(trajectory.current).T
    before = np.append(current.flat[0], current.flat[:-1]).reshape(current.shape)
    before[:, 0] = np.where(tape.begins, current[:, 0], before[:, 0])
    rate = ((current - before) / np.asarray(tape.block_sample_time)[:, None]).T
    largest = float(np.quantile(np.abs(rate), 0.95)) + 1e-9
    knots = np.array([-largest, 0, largest])
    curve = Curve("sensor", "current_rate", "A", knots, shapes=knots[:, None])
    values = np.stack([rate, np.zeros_like(rate)], axis=1)[..., None].astype(np.float32)
    return curve, lambda: Change(values, by_sensor=True)


def _wave_curve(equation: str, unit: str, periods: float) -> Curve:
    """A sinusoid of the angle with its own phase in every run, over one period."""
    angle = np.linspace(0, 2 * np.pi / periods, KNOTS_IN_PERIOD)
    return Curve(equation, "angle", unit, angle, True, _wave(periods * angle))


def _change_by_input(gain: np.ndarray, shape: Callable[[], np.ndarray]) -> Change:
    """What a voltage or torque of unknown shape changes; `gain` as of `input_gains`."""
    shapes = shape().astype(np.float32)
    return Change(gain[..., None].astype(np.float32) * shapes[:, None])


def _sensor_ripple(speed: np.ndarray, phase: np.ndarray) -> Change:
    """What a ripple of the speed sensor in proportion to the speed changes."""
    ripple = (speed[..., None] * _wave(phase)).astype(np.float32)
    return Change(np.stack([np.zeros_like(ripple), ripple], axis=1), by_sensor=True)


def _direction(speed: np.ndarray, tape: Tape) -> np.ndarray:
    """The direction of motion less its mean over each run: in one direction, friction cannot be told from a torque."""
    direction, run = np.sign(speed), np.asarray(tape.run)
    mean = np.bincount(run, direction.mean(0), tape.runs) / np.bincount(run, minlength=tape.runs)
    return direction - mean[run]


def _wave(phase: np.ndarray) -> np.ndarray:
    """Cosine and sine."""
    return np.stack([np.cos(phase), np.sin(phase)], -1)


def _share_of_run(tape: Tape) -> np.ndarray:
    """The time since the run began over its duration, (samples, blocks)."""
    run, samples = np.asarray(tape.run), tape.value.shape[1]
    block = np.arange(len(run)) - np.searchsorted(run, run)
    time = block * samples + np.arange(samples)[:, None]
    return time / (np.bincount(run, minlength=tape.runs) * samples)[run]


def _knots(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Knots over the range of a variable, denser at frequent values and near zero."""
    values = x[weight]
    low, high = np.quantile(values, [0.001, 0.999])
    spread = max(high - low, 1e-9)
    inner = np.quantile(values, np.linspace(0, 1, KNOTS)[1:-1])
    about_zero = [s * spread for s in (-0.02, 0.02) if low < s * spread < high]
    knots = np.sort(np.concatenate([[low, high], inner, about_zero]))
    knots[np.abs(knots) < 1e-3 * spread] = 0.0  # a motor at rest, except for noise
    return knots[np.append(True, np.diff(knots) > 0.01 * spread)]


def _hats(x: np.ndarray, knots: np.ndarray, factor: np.ndarray | None = None) -> np.ndarray:
    """Piecewise linear functions of x, each one at its own knot and zero at all others, times a factor."""
    hats = np.stack([np.interp(x, knots, hat) for hat in np.eye(len(knots))], -1)
    return hats if factor is None else factor[..., None] * hats

"""All that may be missing: candidates and curves, and what each changes along a path, to first order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from ...effects import EFFECTS, AbstractEffect
from ...identify.noise.sensor_noise import common_divisor, is_coarse, quantum
from ...motor import Motor
from ...recordings.recording import Recording
from ...runtime.compiled import quickly_compiled
from ...runtime.threads import run_ahead
from ...simulate import Tape, free_run
from ..model import Model
from ..response import Outputs, Path, input_gains, kicks, sensor_changes
from .candidates import Candidate, Scales
from .trials import all_candidates

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
# A motor counts as moving above this share of `Scales.speed`
MOVING_SHARE = 0.02
# `Scales.slow_speed` is this quantile of its speeds while it moves
SLOW_QUANTILE = 0.05
# A step of the voltage counts as the resolution of a converter below this share of the largest voltage (seven bits)
MAX_CONVERTER_STEP = 0.01
# Most columns that are simulated together, and most numbers in all of them: they limit the memory
MAX_COLUMNS = 32
MAX_NUMBERS = 2**23


class Change(NamedTuple):
    """What a few candidates or curves change along a path, in current and speed: the state at the end of each sample,
    or, by a sensor, what is recorded."""

    values: Float32[np.ndarray, "samples 2 blocks columns"]
    by_sensor: bool = False


def columns_at_once(tape: Tape) -> int:
    """How many columns are simulated together."""
    return max(1, min(MAX_COLUMNS, MAX_NUMBERS // (2 * tape.value.size)))


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
    def order(self) -> int:
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


class Library:
    """The candidates that the recordings can show, and what each changes in the motor without effects."""

    def __init__(self, base: Model) -> None:
        """`base` is the motor without effects, as fitted."""
        self.bare = jax.tree.map(jnp.asarray, base.motor)
        self.scales = _scales(base)
        tape = base.prepared.problem.tape
        self.measures_current = bool(np.any(np.asarray(tape.weight)[base.prepared.problem.fitted_blocks, 0]))
        has_current = self.measures_current or bool(np.any(np.asarray(tape.drive.current) > 0))
        observable = {e for e, effect in EFFECTS.items() if has_current or not effect.needs_current}
        self.candidates = [c for c in all_candidates(self.scales) if c.effect in observable]
        # the errors of a coarse encoder last long enough to look like a voltage that changes over time
        self.has_coarse_speed = any(is_coarse(speed) for speed in _measured_speeds(base.prepared.training))
        # so may what remains of the noise that was taken out of the recorded voltage
        self.has_input_noise = bool(base.prepared.input_noise)
        # by unit: the amplitude that imperfect sensors alone may produce
        self.sensor_floors = _sensor_floors(base)
        self._simulated: dict[int, np.ndarray] = {}
        self._base = base

    def changes(self, tape: Tape, path: Path) -> Iterator[Change]:
        """What the candidates change along a path, in their order; a `Change` has some candidates of one effect."""
        return run_ahead(self._change_calls(tape, path))

    def _change_calls(self, tape: Tape, path: Path) -> Iterator[Callable[[], Change]]:
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
                    yield partial(_small_change, EFFECTS[name], values, units[part], self.bare, tape, path)

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
    training = base.prepared.training
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
    path: Path,
) -> Float32[Array, "samples 2 blocks columns"]:
    """The kicks, or changes by sensors, of settings of one effect; each divided by its unit, in single precision."""
    change = sensor_changes if effect.equation == "sensor" else kicks

    def per_unit(values: Mapping[str, Array | np.ndarray], unit: Array | np.ndarray) -> Outputs:
        return change(bare.with_effects([effect(**values)]), bare, tape, path) / unit

    return jax.vmap(per_unit, out_axes=-1)(settings, units).astype(jnp.float32)


def curves_along(library: Library, tape: Tape, path: Path) -> tuple[list[Curve], Iterator[Change]]:
    """The curves over all variables of all equations, the sinusoids of the angle, and what each changes."""
    terms = [*_equation_curves(library, tape, path), *_angle_waves(library, tape, path)]
    if library.measures_current:
        terms.append(_late_current(tape, path))
    return [curve for curve, _ in terms], (change() for _, change in terms)


# A curve, and a function that computes what it changes
Term = tuple[Curve, Callable[[], Change]]


def _equation_curves(library: Library, tape: Tape, path: Path) -> Iterator[Term]:
    """The curves of each equation over its variables (`CURVE_VARIABLES`)."""
    volt, torque = (np.asarray(gain) for gain in input_gains(library.bare, tape))
    value = np.asarray(tape.value).T
    known = {"speed": np.asarray(path.speed), "current": np.asarray(path.current), "voltage": value}
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


def _angle_waves(library: Library, tape: Tape, path: Path) -> Iterator[Term]:
    """Sinusoids of the angle: a torque behind a gear, and a ripple of the speed sensor in proportion to the speed, such
    as of a tachometer or an eccentric encoder."""
    angle, speed = np.asarray(path.angle), np.asarray(path.speed)
    torque = np.asarray(input_gains(library.bare, tape)[1])
    for periods in PERIODS_BEHIND_GEAR:
        wave = partial(_wave, periods * angle)
        yield _wave_curve("mechanical", "N m", periods), partial(_change_by_input, torque, wave)
    of_rotor = [c.columns[0]["periods"] for c in library.candidates if c.effect == "cogging_torque"]
    for periods in of_rotor:
        yield _wave_curve("sensor", "", periods), partial(_sensor_ripple, speed, periods * angle)


def _late_current(tape: Tape, path: Path) -> Term:
    """A current that is read late, as behind a filter: an error in proportion to its rate of change."""
    current = np.asarray(path.current).T
    before = np.append(current.flat[0], current.flat[:-1]).reshape(current.shape)
    before[:, 0] = np.where(tape.begins, current[:, 0], before[:, 0])
    rate = ((current - before) / np.asarray(tape.sample_time)[tape.grid][:, None]).T
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


def _scales(base: Model) -> Scales:
    """The typical sizes in the fitted runs, mostly 95 % quantiles of magnitudes."""
    tape, motor = base.prepared.problem.tape, base.motor
    fitted = base.prepared.problem.fitted_blocks
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
        duration=float(max(run.time[-1] - run.time[0] for run in base.prepared.training)),
        travel=base.travel,
    )

"""Everything that may be missing, candidates and unknown curves, and what each changes along a path, to first order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiled import quickly_compiled
from ..effects import EFFECTS, AbstractEffect
from ..identify.noise import common_divisor, is_coarse, quantum
from ..motor import Motor
from ..recording import Recording
from ..simulate import Tape, free_run
from ..threads import run_one_ahead
from .candidates import Candidate, Scales, candidates
from .model import Model
from .response import Outputs, Path, kicks, pushes, sensed

# The variables over which each equation may have an unknown curve
OVER = {
    "mechanical": ("speed", "current", "time"),
    "electrical": ("current", "speed", "voltage", "time"),
}
# Knots of a curve over speed, current or voltage, and over the time of each run.
KNOTS, KNOTS_IN_TIME = 9, 7
# Periods per turn of the rotor of a torque that is periodic behind a gear; so dense that neighbours differ by half a
# period in some 500 rad
BEHIND_GEAR = np.arange(0.02, 0.25, 0.006)
KNOTS_IN_PERIOD = 25
# A motor counts as moving above this share of `Scales.speed`; `Scales.slow` is this quantile of its speeds then
MOVING, SLOWEST = 0.02, 0.05
# A step of the voltage counts as a converter's below this share of the largest voltage: seven bits and more
OF_CONVERTER = 0.01
# Most columns that are simulated side by side, and most numbers in all of them, to limit the memory
TOGETHER, AT_ONCE = 32, 2**23


class Change(NamedTuple):
    """What a few candidates or curves change along a path, in current and speed: (samples, 2, blocks, columns)."""

    kicks: np.ndarray  # change of the state at the end of each sample
    seen: np.ndarray  # ... and what is added directly to the recorded outputs


def side_by_side_on(tape: Tape) -> int:
    """How many columns are simulated side by side."""
    return max(1, min(TOGETHER, AT_ONCE // (2 * tape.value.size)))


class Curve(NamedTuple):
    """An unknown term of one equation: piecewise linear in one variable, or a sinusoid of the angle."""

    equation: str  # "mechanical", "electrical", or "sensor" for the reading of the speed, as a share of it
    variable: str
    knots: np.ndarray
    own: bool = False  # every run has a curve of its own
    # (knots, columns): values of the columns at the knots; None where these are hat functions, one a knot
    shapes: np.ndarray | None = None
    # changes sign with the direction of motion, as a friction that changes over time does
    reverses: bool = False
    # known to show noise, and so no evidence
    noise: bool = False

    @property
    def order(self) -> int:
        """How many coefficients it has (in one run, with `own`)."""
        return len(self.knots) if self.shapes is None else self.shapes.shape[1]

    @property
    def is_wave(self) -> bool:
        """Whether it is a sinusoid of the angle."""
        return self.shapes is not None

    @property
    def is_misread(self) -> bool:
        """Whether it is a reading of the speed that swings with the angle."""
        return self.equation == "sensor"

    @property
    def periods(self) -> float:
        """Of a sinusoid, the periods per turn."""
        return float(2 * np.pi / self.knots[-1])

    def values(self, coefficients: np.ndarray) -> np.ndarray:
        """The curve at its knots."""
        return coefficients if self.shapes is None else self.shapes @ coefficients

    def errors(self, errors: np.ndarray) -> np.ndarray:
        """Standard errors of the curve at its knots, from those of its coefficients."""
        return errors if self.shapes is None else np.sqrt(self.shapes**2 @ errors**2)


class Library:
    """The candidates that the recordings can tell of, and what each changes in the motor without effects."""

    def __init__(self, base: Model) -> None:
        """`base` is the motor without effects, as fitted."""
        self.bare = jax.tree.map(jnp.asarray, base.motor)
        self.scales = _scales(base)
        tape = base.given.problem.tape
        measured = bool(np.any(np.asarray(tape.weight)[base.given.problem.fitted_blocks, 0]))
        known = measured or bool(np.any(np.asarray(tape.drive.current) > 0))
        told = {name for name, effect in EFFECTS.items() if known or not effect.needs_current}
        self.candidates = [c for c in candidates(self.scales) if c.effect in told]
        # a coarse encoder's errors last long enough to look like a voltage that changes over time
        self.coarse = any(is_coarse(speed) for speed in _counted(base.given.training))
        # so may the rest of noise that was taken out of the recorded voltage
        self.wavers = bool(base.given.input_noise)
        # by unit: the amplitude that imperfect sensors alone may produce
        self.traces = _traces(base)
        self._simulated: dict[int, np.ndarray] = {}
        self._base = base

    def changes(self, tape: Tape, path: Path) -> Iterator[Change]:
        """What the candidates change along a path, in their order; each `Change` is of some of one effect."""
        return run_one_ahead(self._calls(tape, path))

    def _calls(self, tape: Tape, path: Path) -> Iterator[Callable[[], Change]]:
        for name in EFFECTS:
            shapes = [c for c in self.candidates if c.effect == name]
            if shapes and shapes[0].whole:
                yield partial(self._whole, shapes, tape)
            elif shapes:
                settings = [values for c in shapes for values in c.columns]
                units = np.array([unit for c in shapes for unit in c.units])
                parts = -(-len(settings) // side_by_side_on(tape))
                for part in np.array_split(np.arange(len(settings)), parts):
                    values = {f: np.array([settings[k][f] for k in part]) for f in settings[0]}
                    case = (EFFECTS[name], values, self.bare, tape, path)
                    yield partial(_scaled_down, case, units[part])

    def _whole(self, shapes: Sequence[Candidate], tape: Tape) -> Change:
        """What settings of an effect at finite size change, by full simulations."""
        seen = np.stack([self._response(c, tape) for c in shapes], -1)
        return Change(np.zeros_like(seen), seen)

    def _response(self, candidate: Candidate, tape: Tape) -> np.ndarray:
        """The response to a setting at finite size, simulated once and kept: (samples, 2, blocks)."""
        key = id(candidate)
        if key not in self._simulated:
            values = {field: jnp.asarray(x) for field, x in candidate.columns[0].items()}
            motor = self.bare.with_effects([EFFECTS[candidate.effect](**values)])
            seen = free_run(motor, tape, self._base.fit.unknowns.runs)
            change = np.asarray(seen) - np.asarray(self._base.fit.evaluation.seen)
            self._simulated[key] = change.transpose(2, 1, 0)
        return self._simulated[key]


def _traces(base: Model) -> dict[str, float]:
    """By unit, the amplitude that imperfect sensors alone may produce: the noise taken out of the recorded voltage (V,
    standard deviation) or its resolution, if larger; half the quantum of the current (A)."""
    training = base.given.training
    currents = [run.current for run in training if run.current is not None]
    rounded = max((quantum(np.diff(current)) / 2 for current in currents), default=0.0)
    unfelt = max(base.given.input_noise.values(), default=0.0)
    volts = [run.voltage for run in training if run.voltage is not None]
    return {"V": max(unfelt, _rounded_to(np.concatenate(volts or [np.zeros(1)]))), "A": rounded}


def _rounded_to(volts: np.ndarray) -> float:
    """The step, in V, to which a converter rounds or truncates; zero for a programme's far coarser round numbers."""
    step = common_divisor(volts)
    return step if step < OF_CONVERTER * np.max(np.abs(volts)) else 0.0


def _counted(runs: Sequence[Recording]) -> list[np.ndarray]:
    """The measured speeds, to judge their resolution; of measured angles the central differences, rad a sample."""
    speeds = [run.speed for run in runs if run.speed is not None]
    return speeds + [np.gradient(run.angle) for run in runs if run.angle is not None]


def _scaled_down(case: tuple, units: np.ndarray) -> Change:
    """What small settings change, each divided by its unit."""
    return Change(*(np.asarray(x) / units for x in _small(*case)))


@quickly_compiled
def _small(
    effect: type[AbstractEffect],
    settings: Mapping[str, Array | np.ndarray],
    bare: Motor,
    tape: Tape,
    path: Path,
) -> tuple[Array, Array]:
    """Kicks, and what is added to the outputs, by small settings of one effect; the last axis is the setting."""

    def change(values: Mapping[str, Float[Array | np.ndarray, ""]]) -> tuple[Outputs, Outputs]:
        motor = bare.with_effects([effect(**values)])
        if effect.equation == "sensor":
            seen = sensed(motor, bare, tape, path)
            return jnp.zeros_like(seen), seen
        kicked = kicks(motor, bare, tape, path)
        return kicked, jnp.zeros_like(kicked)

    return jax.vmap(change, out_axes=-1)(settings)


def curves_over(library: Library, tape: Tape, path: Path) -> tuple[list[Curve], Iterator[Change]]:
    """The curves over all variables of all equations, the waves over the angle, and what each changes."""
    terms = [*_terms_of_equations(library, tape, path), *_waves(library, tape, path)]
    return [curve for curve, _ in terms], (change() for _, change in terms)


Term = tuple[Curve, Callable[[], Change]]


def _terms_of_equations(library: Library, tape: Tape, path: Path) -> Iterator[Term]:
    """The curves of each equation over its variables (`OVER`)."""
    volt, torque = (np.asarray(push) for push in pushes(library.bare, tape))
    value = np.asarray(tape.value).T
    known = {"speed": np.asarray(path.speed), "current": np.asarray(path.current), "voltage": value}
    known["time"] = _share_of_run(tape)
    weight = np.any(np.asarray(tape.weight), axis=1).T
    voltage_driven = bool(np.any(np.asarray(tape.drive.voltage) > 0))
    for equation, variables in OVER.items():
        if equation == "electrical" and not voltage_driven:
            continue
        push = torque if equation == "mechanical" else volt
        for variable in variables:
            if variable == "time" and library.coarse and equation == "electrical":
                continue
            own, x = variable == "time", known[variable]
            knots = np.linspace(0, 1, KNOTS_IN_TIME) if own else _knots(x, weight)
            hats = partial(_hats, x, knots)
            noise = own and equation == "electrical" and library.wavers
            yield Curve(equation, variable, knots, own, noise=noise), partial(_pushed, push, hats)
            if own and equation == "mechanical":
                turning = partial(_hats, x, knots, _direction(known["speed"], tape))
                reversing = Curve(equation, variable, knots, own, reverses=True)
                yield reversing, partial(_pushed, push, turning)


def _waves(library: Library, tape: Tape, path: Path) -> Iterator[Term]:
    """Sinusoids of the angle: a torque behind a gear, and a speed reading that swings in proportion to the speed, as of
    a tachometer's ripple or an encoder off its centre."""
    angle, speed = np.asarray(path.angle), np.asarray(path.speed)
    torque = np.asarray(pushes(library.bare, tape)[1])
    for periods in BEHIND_GEAR:
        wave = partial(_wave, periods * angle)
        yield _wave_curve("mechanical", periods), partial(_pushed, torque, wave)
    of_rotor = [c.columns[0]["periods"] for c in library.candidates if c.effect == "cogging_torque"]
    for periods in of_rotor:
        yield _wave_curve("sensor", periods), partial(_misread, speed, periods * angle)


def _wave_curve(equation: str, periods: float) -> Curve:
    turned = np.linspace(0, 2 * np.pi / periods, KNOTS_IN_PERIOD)
    return Curve(equation, "angle", turned, True, _wave(periods * turned))


def _pushed(push: np.ndarray, shape: Callable[[], np.ndarray]) -> Change:
    """What a voltage or torque of unknown shape changes."""
    kick = push[..., None] * shape()[:, None]
    return Change(kick, np.zeros_like(kick))


def _misread(speed: np.ndarray, phase: np.ndarray) -> Change:
    """What a speed reading that swings with a phase, by its own size, changes."""
    swing = speed[..., None] * _wave(phase)
    seen = np.stack([np.zeros_like(swing), swing], axis=1)
    return Change(np.zeros_like(seen), seen)


def _direction(speed: np.ndarray, tape: Tape) -> np.ndarray:
    """The direction of motion less its mean over each run: in one direction, friction cannot be told from a torque."""
    direction, run = np.sign(speed), np.asarray(tape.run)
    mean = np.bincount(run, direction.mean(0), tape.runs) / np.bincount(run, minlength=tape.runs)
    return direction - mean[run]


def _wave(phase: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(phase), np.sin(phase)], -1)


def _share_of_run(tape: Tape) -> np.ndarray:
    """The time since the run began over its duration, (samples, blocks)."""
    run, samples = np.asarray(tape.run), tape.value.shape[1]
    block = np.arange(len(run)) - np.searchsorted(run, run)
    time = block * samples + np.arange(samples)[:, None]
    return time / (np.bincount(run, minlength=tape.runs) * samples)[run]


def _knots(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Knots over the range of a variable, denser where it often is, and near zero."""
    values = x[weight]
    low, high = np.quantile(values, [0.001, 0.999])
    spread = max(high - low, 1e-9)
    inner = np.quantile(values, np.linspace(0, 1, KNOTS)[1:-1])
    about_zero = [s * spread for s in (-0.02, 0.02) if low < s * spread < high]
    knots = np.sort(np.concatenate([[low, high], inner, about_zero]))
    knots[np.abs(knots) < 1e-3 * spread] = 0.0  # a motor at rest, but for noise
    return knots[np.append(True, np.diff(knots) > 0.01 * spread)]


def _hats(x: np.ndarray, knots: np.ndarray, times: np.ndarray | None = None) -> np.ndarray:
    hats = np.stack([np.interp(x, knots, hat) for hat in np.eye(len(knots))], -1)
    return hats if times is None else times[..., None] * hats


def _scales(base: Model) -> Scales:
    tape, motor = base.given.problem.tape, base.motor
    seen, weight = np.asarray(base.fit.evaluation.seen), np.asarray(tape.weight)
    counted = base.given.problem.fitted_blocks
    there = weight[counted].any(1)
    current, speed = (
        float(np.quantile(np.abs(seen[counted][:, c][there]), 0.95)) + 1e-9 for c in range(2)
    )
    speeds = np.append(np.abs(seen[counted][:, 1][there]), speed)
    slow = float(np.quantile(speeds[speeds > MOVING * speed], SLOWEST))
    value = float(np.quantile(np.abs(np.asarray(tape.value)[counted][there]), 0.95)) + 1e-9
    step = float(np.min(np.asarray(tape.sample_time)))
    longest = max(run.time[-1] - run.time[0] for run in base.given.training)
    driven = bool(np.all(np.asarray(tape.drive.torque) > 0))
    torque = value if driven else float(motor.Kt) * current
    return Scales(
        current, speed, slow, value, torque, float(motor.J), step, float(longest), base.travel
    )

"""Everything that may be missing, and what it would change in the outputs, to first order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..effects import EFFECTS, AbstractEffect
from ..identify.noise import is_coarse
from ..motor import Motor
from ..simulate import Tape, free_run
from .candidates import Candidate, Scales, Values, candidates
from .evidence import Block
from .model import Model
from .response import Path, kicks, pushes, respond, sensed

OVER = {
    "mechanical": ("speed", "current", "time"),
    "electrical": ("current", "speed", "voltage", "time"),
}
# Knots of a curve over speed, current or voltage, and over the time of each run.
KNOTS, KNOTS_IN_TIME = 9, 7
# Periods a turn of a torque that comes round behind a gear; two neighbours differ by half a period in some 500 rad
BEHIND_GEAR = np.arange(0.02, 0.25, 0.006)
KNOTS_IN_PERIOD = 25


class Curve(NamedTuple):
    """An unknown term of one equation: a straight line between knots of one variable, or a sine of the angle."""

    equation: str
    variable: str
    knots: np.ndarray
    own: bool = False  # every run has a curve of its own
    # (knots, columns): the columns at the knots, where they are no hats
    shapes: np.ndarray | None = None
    # turns with the direction of motion, as a friction that changes does
    reverses: bool = False

    def values(self, coefficients: np.ndarray) -> np.ndarray:
        """The curve at its knots."""
        return coefficients if self.shapes is None else self.shapes @ coefficients

    def errors(self, errors: np.ndarray) -> np.ndarray:
        """Standard errors there of coefficients with these standard errors."""
        return errors if self.shapes is None else np.sqrt(self.shapes**2 @ errors**2)


class Library:
    """Everything that may be missing from a motor without effects, and what it would change."""

    def __init__(self, base: Model):
        """`base` is the motor without effects, as fitted."""
        self.bare = jax.tree.map(jnp.asarray, base.motor)
        self.scales = _scales(base)
        tape = base.given.problem.tape
        measured = bool(np.any(np.asarray(tape.weight)[base.given.problem.counted, 0]))
        known = measured or bool(np.any(np.asarray(tape.drive.current) > 0))
        self.candidates = [
            c for c in candidates(self.scales) if known or not EFFECTS[c.effect].needs_current
        ]
        # errors that last look like a voltage that changes in time
        speeds = [run.speed for run in base.given.training if run.speed is not None]
        self.coarse = any(is_coarse(speed) for speed in speeds)
        self._whole: dict[int, jax.Array] = {}
        self._base = base

    def columns(self, tape: Tape, path: Path) -> tuple[jax.Array, list[Block]]:
        """Responses (samples, 2, blocks, columns) along a path, and the columns of every candidate."""
        kicked, seen, blocks, count = [], [], [], 0
        for name in EFFECTS:
            shapes = [c for c in self.candidates if c.effect == name]
            if not shapes:
                continue
            if shapes[0].whole:
                parts = [self._response(c, tape) for c in shapes]
                kick, direct = jnp.zeros((*parts[0].shape, len(parts))), jnp.stack(parts, -1)
            else:
                settings = [values for c in shapes for values in c.columns]
                units = jnp.asarray([unit for c in shapes for unit in c.units])
                kick, direct = (x / units for x in self._small(name, settings, tape, path))
            kicked.append(kick)
            seen.append(direct)
            for shape in shapes:
                blocks.append(Block(tuple(range(count, count + shape.order)), shape.own_phase))
                count += shape.order
        response = respond(self.bare, tape, path, jnp.concatenate(kicked, -1))
        response = response + jnp.concatenate(seen, -1)
        # a setting that cannot be simulated says nothing
        return jnp.where(jnp.all(jnp.isfinite(response), (0, 1, 2)), response, 0.0), blocks

    def _small(self, name: str, settings: Sequence[Values], tape: Tape, path: Path):
        """Kicks and sensor errors for small settings of one effect, settings last."""
        effect = EFFECTS[name]
        stacked = {field: jnp.asarray([s[field] for s in settings]) for field in settings[0]}

        if effect.equation == "sensor":

            def look(values):
                return sensed(self._with(effect, values), tape, path)

            direct = jax.vmap(look, out_axes=-1)(stacked)
            return jnp.zeros_like(direct), direct

        def kick(values):
            return kicks(self._with(effect, values), self.bare, tape, path)

        found = jax.vmap(kick, out_axes=-1)(stacked)
        return found, jnp.zeros_like(found)

    def _with(self, effect: type[AbstractEffect], values: dict[str, Any]) -> Motor:
        return eqx.tree_at(lambda m: m.effects, self.bare, (effect(**values),))

    def _response(self, candidate: Candidate, tape: Tape) -> jax.Array:
        """The response to a whole setting, simulated once."""
        key = id(candidate)
        if key not in self._whole:
            values = {field: jnp.asarray(x) for field, x in candidate.columns[0].items()}
            local = self._base.polished.refined.unknowns.local
            motor = self._with(EFFECTS[candidate.effect], values)
            seen = free_run(motor, tape, local[:, :2], local[:, 2])
            self._whole[key] = (seen - self._base.polished.evaluation.seen).transpose(2, 1, 0)
        return self._whole[key]


def curves_over(library: Library, tape: Tape, path: Path, count: int):
    """Responses to curves over every variable in every equation, and to torques that a gear brings round."""
    volt, torque = pushes(library.bare, tape)
    value = jnp.asarray(tape.value).T
    known = {"speed": path.speed, "current": path.current, "voltage": value}
    known["time"] = _share_of_run(tape)
    weight = jnp.asarray(tape.weight).any(1).T
    terms: list[tuple[jax.Array, jax.Array, Curve]] = []
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
            hats = jnp.stack([_hat(x, knots, k) for k in range(len(knots))], -1)
            terms.append((push, hats, Curve(equation, variable, knots, own)))
            if own and equation == "mechanical":
                turning = _direction(path.speed, tape)[..., None] * hats
                terms.append((push, turning, Curve(equation, variable, knots, own, reverses=True)))
    for periods in BEHIND_GEAR:
        turned = np.linspace(0, 2 * np.pi / periods, KNOTS_IN_PERIOD)
        curve = Curve("mechanical", "angle", turned, True, np.asarray(_wave(periods * turned)))
        terms.append((torque, _wave(periods * path.angle), curve))
    blocks = []
    for _, shape, curve in terms:
        blocks.append(Block(tuple(range(count, count + shape.shape[-1])), curve.own))
        count += shape.shape[-1]
    kicked = jnp.concatenate([push[..., None] * shape[:, None] for push, shape, _ in terms], -1)
    return respond(library.bare, tape, path, kicked), [curve for *_, curve in terms], blocks


def _direction(speed, tape: Tape) -> jax.Array:
    """That of motion, less its mean over each run: where it never changes, a friction is but a torque."""
    direction = jnp.sign(speed)
    mean = jax.ops.segment_sum(direction.mean(0), tape.run, tape.runs) / jnp.bincount(
        jnp.asarray(tape.run), length=tape.runs
    )
    return direction - mean[tape.run]


def _wave(phase) -> jax.Array:
    return jnp.stack([jnp.cos(phase), jnp.sin(phase)], -1)


def _share_of_run(tape: Tape) -> jax.Array:
    """The time as a share of each run's, (samples, blocks)."""
    run, samples = np.asarray(tape.run), tape.value.shape[1]
    block = np.arange(len(run)) - np.searchsorted(run, run)
    time = block * samples + np.arange(samples)[:, None]
    return jnp.asarray(time / (np.bincount(run, minlength=tape.runs) * samples)[run])


def _knots(x, weight) -> np.ndarray:
    """Knots over the range of a variable, denser where it often is and about zero."""
    values = np.asarray(x)[np.asarray(weight)]
    low, high = np.quantile(values, [0.001, 0.999])
    spread = max(high - low, 1e-9)
    inner = np.quantile(values, np.linspace(0, 1, KNOTS)[1:-1])
    about_zero = [s * spread for s in (-0.02, 0.02) if low < s * spread < high]
    knots = np.sort(np.concatenate([[low, high], inner, about_zero]))
    knots[np.abs(knots) < 1e-3 * spread] = 0.0  # where a motor rests, whatever its noise
    return knots[np.append(True, np.diff(knots) > 0.01 * spread)]


def _hat(x, knots: np.ndarray, k: int):
    return jnp.interp(x, knots, np.eye(len(knots))[k])


def _scales(base: Model) -> Scales:
    tape, motor = base.given.problem.tape, base.motor
    seen, weight = np.asarray(base.polished.evaluation.seen), np.asarray(tape.weight)
    counted = base.given.problem.counted
    there = weight[counted].any(1)
    current, speed = (
        float(np.quantile(np.abs(seen[counted][:, c][there]), 0.95)) + 1e-9 for c in range(2)
    )
    value = float(np.quantile(np.abs(np.asarray(tape.value)[counted][there]), 0.95)) + 1e-9
    step = float(np.min(np.asarray(tape.sample_time)))
    longest = max(run.time[-1] - run.time[0] for run in base.given.training)
    driven = bool(np.all(np.asarray(tape.drive.torque) > 0))
    torque = value if driven else float(motor.Kt) * current
    return Scales(current, speed, value, torque, float(motor.J), step, float(longest))

"""Everything that may be missing, and what it would change in the outputs, to first order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..effects import EFFECTS, AbstractEffect
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


class Curve(NamedTuple):
    """An unknown term of one equation, a straight line between knots of one variable."""

    equation: str
    variable: str
    knots: np.ndarray
    own: bool = False  # every run has a curve of its own


class Library:
    """Everything that may be missing from a motor without effects, and what it would change."""

    def __init__(self, base: Model):
        """`base` is the motor without effects, as fitted."""
        self.bare = jax.tree.map(jnp.asarray, base.motor)
        self.scales = _scales(base)
        self.candidates = candidates(self.scales)
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
        return response + jnp.concatenate(seen, -1), blocks

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
    """Responses to curves over every variable in every equation."""
    volt, torque = pushes(library.bare, tape)
    value = jnp.asarray(tape.value).T
    known = {"speed": path.speed, "current": path.current, "voltage": value}
    begins = np.searchsorted(np.asarray(tape.run), np.asarray(tape.run))
    block = np.arange(len(begins)) - begins
    time = block * value.shape[0] + np.arange(value.shape[0])[:, None]
    length = np.bincount(np.asarray(tape.run), minlength=tape.runs) * value.shape[0]
    share = jnp.asarray(time / length[np.asarray(tape.run)])
    weight = jnp.asarray(tape.weight).any(1).T
    kicked, curves, blocks = [], [], []
    voltage_driven = bool(np.any(np.asarray(tape.drive.voltage) > 0))
    for equation, variables in OVER.items():
        if equation == "electrical" and not voltage_driven:
            continue
        push = torque if equation == "mechanical" else volt
        for variable in variables:
            own = variable == "time"
            x = share if own else known[variable]
            knots = np.linspace(0, 1, KNOTS_IN_TIME) if own else _knots(x, weight)
            hats = jnp.stack([_hat(x, knots, k) for k in range(len(knots))], -1)
            kicked.append(push[..., None] * hats[:, None])
            curves.append(Curve(equation, variable, knots, own))
            blocks.append(Block(tuple(range(count, count + len(knots))), own))
            count += len(knots)
    return respond(library.bare, tape, path, jnp.concatenate(kicked, -1)), curves, blocks


def _knots(x, weight) -> np.ndarray:
    """Knots over the range of a variable, denser where it often is and about zero."""
    values = np.asarray(x)[np.asarray(weight)]
    low, high = np.quantile(values, [0.001, 0.999])
    spread = max(high - low, 1e-9)
    inner = np.quantile(values, np.linspace(0, 1, KNOTS)[1:-1])
    about_zero = [s * spread for s in (-0.02, 0.02) if low < s * spread < high]
    knots = np.sort(np.concatenate([[low, high], inner, about_zero]))
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

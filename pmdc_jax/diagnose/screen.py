"""The evidence against a fitted motor: its residuals, and the response to everything that may be missing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..effects import EFFECTS, AbstractEffect, CoulombFriction
from ..identify.pipeline import Prepared
from ..identify.refine import Polished
from ..motor import Motor
from ..simulate import Tape, free_run
from .candidates import Candidate, Scales, Values, candidates
from .evidence import Block, Evidence, products
from .noise import Series, Whitener, plain, whitener
from .response import Path, kicks, path_of, pushes, respond, sensed


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


class Curve(NamedTuple):
    """An unknown term of one equation, a straight line between knots of one variable."""

    equation: str
    variable: str
    knots: np.ndarray
    own: bool = False  # every run has a curve of its own


class Screen(NamedTuple):
    """Evidence, and which of its columns belong to what."""

    evidence: Evidence
    candidates: list[Candidate]
    of_candidate: list[Block]
    curves: list[Curve]
    of_curve: list[Block]
    dry: float  # Coulomb friction in the model, N m

    def possible(self, candidate: Candidate, coefficients: np.ndarray) -> bool:
        """Whether physics allows these coefficients."""
        return candidate.own_phase or candidate.build(coefficients, self.dry) is not None


# Knots of a curve over speed, current or voltage, and over the time of each run.
KNOTS, KNOTS_IN_TIME = 9, 7


def screen(model: Model, library: Library) -> Screen:
    """Gather the evidence against a model, white by the filter of its own residuals."""
    tape, path = model.given.problem.tape, _path(model)
    shown, of_candidate = library.columns(tape, path)
    curved, curves, of_curve = _curves(library, tape, path, shown.shape[-1])
    fitted = rows_of(model)
    whiten = whitener([residual for _, residual in fitted])
    X = _white(model, jnp.concatenate([shown, curved], -1), whiten)
    evidence = _products(model, fitted, whiten, X)
    of_candidate, of_curve = (_behind(model, blocks) for blocks in (of_candidate, of_curve))
    return Screen(evidence, library.candidates, of_candidate, curves, of_curve, model.dry)


def beyond_curves(model: Model, library: Library) -> float:
    """Share of the squares of a model's residuals, as they are, that no curve over a variable takes away."""
    fitted = rows_of(model)
    as_they_are = plain([residual for _, residual in fitted])
    curved, _, of_curve = _curves(library, model.given.problem.tape, _path(model), 0)
    evidence = _products(model, fitted, as_they_are, _white(model, curved, as_they_are))
    shared = [block for block in _behind(model, of_curve) if not block.own]
    return evidence.regress(shared).squares / evidence.regress().squares


def _path(model: Model) -> Path:
    tape = model.given.problem.tape
    return path_of(model.polished.evaluation.seen, tape, "speed" in _held_by(model))


def _white(model: Model, columns: jax.Array, whiten: Whitener) -> list[np.ndarray]:
    """Responses (samples, 2, blocks, columns) as white rows of every training run."""
    tape = model.given.problem.tape
    there = np.asarray(columns).transpose(2, 1, 0, 3) * np.asarray(tape.weight)[..., None]
    return [whiten(k, _series(tape, run, there)) for k, run in enumerate(_training(model))]


def _behind(model: Model, blocks: Sequence[Block]) -> list[Block]:
    """The blocks' columns, counted on behind the motor's own parameters."""
    count = model.given.problem.free.shape[0]
    return [Block(tuple(c + count for c in block.columns), block.own) for block in blocks]


def left_over(model: Model, whiten: Whitener) -> tuple[float, int]:
    """The sum of squares that a model leaves, made white by a filter that others share, and of how many rows."""
    evidence = _products(model, rows_of(model), whiten, None)
    return evidence.regress().squares, evidence.rows


def rows_of(model: Model) -> list[tuple[Series, Series]]:
    """Of every training run the derivatives of the outputs, and measured less simulated, in A and rad/s."""
    evaluation, tape = model.polished.evaluation, model.given.problem.tape
    noise = model.polished.noise[:, None]
    J = np.asarray(evaluation.jacobian) * noise[..., None]
    r = -np.asarray(evaluation.residuals) * noise
    return [(_series(tape, run, J), _series(tape, run, r)) for run in _training(model)]


def _products(model: Model, fitted, whiten: Whitener, X) -> Evidence:
    J, r = ([whiten(k, pair[i]) for k, pair in enumerate(fitted)] for i in range(2))
    count = model.given.problem.free.shape[0]
    X = X or [np.zeros((len(x), 0)) for x in r]
    return products([j[:, :count] for j in J], [j[:, count:] for j in J], X, r)


def _training(model: Model) -> list[int]:
    return [run for run, role in enumerate(model.given.roles) if role == "train"]


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


def _curves(library: Library, tape: Tape, path: Path, count: int):
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


OVER = {
    "mechanical": ("speed", "current", "time"),
    "electrical": ("current", "speed", "voltage", "time"),
}


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


def _held_by(model: Model) -> set[str]:
    return {EFFECTS[name].holds or "" for name in model.effects}


def _series(tape: Tape, run: int, signal: np.ndarray) -> Series:
    """A signal (blocks, 2, samples, ...) of one run in the order of time, of the outputs that it has."""
    mine = np.asarray(tape.run) == run
    part = np.moveaxis(signal[mine], 1, 2)
    values = part.reshape(-1, *part.shape[2:])
    weight = np.moveaxis(np.asarray(tape.weight)[mine], 1, 2).reshape(-1, 2) > 0
    outputs = tuple(int(c) for c in np.flatnonzero(weight.any(0)))
    first = np.flatnonzero(mine)[0]
    kind = (float(np.asarray(tape.sample_time)[np.asarray(tape.grid)[first]]), outputs)
    return Series(values[:, list(outputs)], np.asarray(weight[:, list(outputs)].all(1)), kind)


def _scales(base: Model) -> Scales:
    tape, motor = base.given.problem.tape, base.motor
    seen, weight = np.asarray(base.polished.evaluation.seen), np.asarray(tape.weight)
    counted = np.asarray(base.given.problem.counts)[np.asarray(tape.run)]
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

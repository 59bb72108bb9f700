"""Where refits start: the unknowns of a fitted model, completed by start values of new effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...identify.fit.refine import Optimum
from ...identify.parameters import Parameters
from ...identify.prepare import Prepared
from ...identify.problem import Unknowns
from ..evidence.signals import Screen, Signal
from ..hypotheses.candidates import Candidate, Scales, Values
from ..hypotheses.effect_relations import CONTAINS, FULLER, with_split_friction
from ..hypotheses.trials import TRIALS
from ..model import Model

# Grid points in [-pi, pi) for the phase that all runs have in common
PHASE_GRID_POINTS = 120


class Start(NamedTuple):
    """Where a refit starts."""

    prepared: Prepared
    point: Optimum


class Starts:
    """Builds the starts of refits from fitted models, and keeps the first start values of each effect."""

    def __init__(self, scales: Scales) -> None:
        self.scales = scales
        # by effect: the values from which it was first fitted
        self.first_values: dict[str, Values] = {}

    def from_signal(self, current: Model, effects: tuple[str, ...], signal: Signal, screen: Screen) -> Start | None:
        """The start at the regression coefficients of a signal; None if physics forbids them."""
        candidate, fit = signal.candidate, screen.evidence.regress([signal.block])
        assert candidate is not None
        coefficients, angles = fit.coefficients[0], np.zeros(current.problem.tape.runs)
        if candidate.own_phase:
            coefficients, angles[current.prepared.training_indices] = _in_common_phase(current, candidate, coefficients)
        start_values = candidate.build(coefficients, current.coulomb_torque)
        if start_values is None:
            return None
        values = {candidate.effect: start_values}
        if "constant_load" in set(effects) - set(current.effects) - {candidate.effect}:
            values["constant_load"] = {"torque_Nm": current.friction_asymmetry}
        return self.from_model(current, effects, values, fit.parameter_changes, angles)

    def of_trial(self, current: Model, effects: tuple[str, ...]) -> list[Start]:
        """Additional starts for the last of some effects: those of its `Trial.starts`."""
        make_values = TRIALS[effects[-1]].starts
        alternatives = make_values(self.scales) if make_values else []
        return [self.from_model(current, effects, {effects[-1]: v}) for v in alternatives]

    def from_simple_form(self, current: Model, effect: str, effects: tuple[str, ...]) -> Start:
        """The start with the fuller form of an effect, from the fit of the simple one."""
        fuller = FULLER[effect]
        values = fuller.from_simple(current.motor.effect_named(effect), self.scales)
        return self.from_model(current, effects, {fuller.effect: values})

    def from_fuller_form(self, current: Model, simple: str, effects: tuple[str, ...]) -> Start:
        """The start with the simple form of an effect, from the fit of the fuller one."""
        fuller = FULLER[simple]
        values = fuller.to_simple(current.motor.effect_named(fuller.effect))
        return self.from_model(current, effects, {simple: values})

    def values_from_replaced(self, current: Model, old: str, new: str) -> dict[str, Values]:
        """Start values, from the fit of the old effect, of one that resembles it or of a simple form that has none from
        an earlier refit."""
        convert = TRIALS[old].alike.get(new)
        if new not in self.first_values and new in FULLER and FULLER[new].effect == old:
            convert = FULLER[new].to_simple
        if convert is None:
            return {}
        return {new: convert(current.motor.effect_named(old))}

    def from_model(
        self,
        current: Model,
        effects: tuple[str, ...],
        values: dict[str, Values],
        changes: np.ndarray | float = 0.0,
        angles: np.ndarray | float = 0.0,
    ) -> Start:
        """The start at the fit of the current model, with other effects.

        **Arguments**: `values` of new effects; `changes` of the current search coordinates, to first order; `angles`,
        in rad, added to the rotor's initial angles.
        """
        prepared = current.prepared.with_effects(current.prepared.forms_of(effects))
        for effect, new in values.items():
            self.first_values.setdefault(effect, new)
        parameters, runs = prepared.problem.parameters, current.fit.unknowns.runs
        coordinates = self._coordinates(parameters, current, values, changes)
        inside = np.clip(coordinates, parameters.lower, parameters.upper)
        turned = runs._replace(angle=runs.angle + angles)
        return Start(prepared, Optimum(Unknowns(jnp.asarray(inside), turned), np.inf, ()))

    def _coordinates(
        self, parameters: Parameters, current: Model, values: Mapping[str, Values], changes: np.ndarray | float
    ) -> list[float]:
        """Search coordinates of some parameters: those of the current model where its runs determine them or no start
        value is known, as of an effect from a global search; else start values, given or the first of the effect."""
        names, fitted = current.problem.parameters.names, current.fit.unknowns.coordinates
        # the regression may change a parameter that no run determines by any amount
        near = np.asarray(fitted) + np.clip(changes, -1.0, 1.0)
        by_name = dict(zip(names, near, strict=True))
        coordinates, undetermined = [], current.undetermined
        for k, name in enumerate(parameters.names):
            effect, _, field = name.partition(".")
            start = values.get(effect, self.first_values.get(effect, {}))
            if name in by_name and (field not in start or name not in undetermined):
                coordinates.append(by_name[name])
            else:
                coordinates.append(parameters.coordinate(k, start[field]))
        return coordinates


def effects_with(present: tuple[str, ...], effect: str) -> tuple[str, ...]:
    """A set of effects with one more in place of those that it contains: the others in order, those that
    `with_split_friction` adds, and the new one last."""
    contained, kept = CONTAINS.get(effect, set()), set(present)
    if contained & with_split_friction(kept):
        kept = with_split_friction(kept) - contained
    return (*(e for e in present if e in kept), *sorted(kept - set(present)), effect)


def _in_common_phase(
    current: Model, candidate: Candidate, coefficients: Float[np.ndarray, "runs 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of cosine and sine that all runs have in common: at the common phase, of median amplitude; and the
    angle, in rad, by which the start of each training run is turned for it."""
    assert candidate.amplitude is not None
    turns = _permitted_turns(current, candidate.effect)
    phase, angles = common_phase(coefficients, turns, candidate.columns[0]["periods"])
    amplitude = np.median(np.hypot(*coefficients.T))
    return amplitude * np.array([np.cos(phase), np.sin(phase)]), angles


def _permitted_turns(model: Model, effect: str) -> list[np.ndarray | None]:
    """The angles, in rad, by which the start of each training run may be turned to suit an effect; None: by any.

    Zero if its angle is known or defines zero; whole periods of another effect of the angle that the model has.
    """
    periodic = [e for e in model.motor.effects if "angle" in e.states and e.name != effect]
    count = round(2 * np.pi / float(periodic[0].repeats_after()["angle"])) if periodic else 0
    whole_periods = 2 * np.pi * np.arange(count) / count if count else None
    turnable = np.asarray(model.problem.angle_unknown)
    return [whole_periods if turnable[run] else np.zeros(1) for run in model.prepared.training_indices]


def common_phase(
    coefficients: Float[np.ndarray, "runs 2"], turns: Sequence[np.ndarray | None], periods: float
) -> tuple[float, np.ndarray]:
    """The phase, in rad, that all runs have in common, and the angle by which the start of each is turned for it.

    **Arguments**: `coefficients`, of cosine and sine in each run; `turns`, the angles, in rad, by which each run may be
    turned (None: by any); `periods` in one turn.
    """
    amplitudes = np.hypot(*coefficients.T)
    phases = np.arctan2(coefficients[:, 1], coefficients[:, 0])
    grid = np.linspace(-np.pi, np.pi, PHASE_GRID_POINTS, endpoint=False)
    angles, agreement = (np.zeros((len(phases), PHASE_GRID_POINTS)) for _ in range(2))
    for run, permitted in enumerate(turns):
        offsets = np.angle(np.exp(1j * (phases[run] - grid)))
        tried = offsets[None] / periods if permitted is None else permitted[:, None] + 0 * offsets
        cosines = np.cos(offsets - periods * tried)
        best = np.argmax(cosines, axis=0)[None]
        angles[run] = np.take_along_axis(tried, best, 0)[0]
        agreement[run] = np.take_along_axis(cosines, best, 0)[0]
    chosen = int(np.argmax(amplitudes**2 @ agreement))
    return float(grid[chosen]), angles[:, chosen]

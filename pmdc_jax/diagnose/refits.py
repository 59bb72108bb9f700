"""Motors with sets of effects, each fitted once in full simulation, from where the evidence points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..effects import EFFECTS
from ..identify.generalised_least_squares import residuals_of, with_whitening
from ..identify.identifiability import moved_by
from ..identify.nearby import best_nearby
from ..identify.noise_model import Whitener, whitener
from ..identify.polish import best_backlash_start, polish
from ..identify.prepare import Prepared
from ..identify.problem import Unknowns
from ..identify.refine import Optimum
from ..identify.solve import POOR_FIT, Solved, search_and_refine
from ..identify.uncertainty import information_of
from ..progress import ReportProgress
from ..threads import map_in_threads_until
from .candidates import Values
from .compare import Comparison
from .effect_relations import CONTAINS, FULLER, with_split_friction
from .library import Library
from .model import Model, model_of, refit_from
from .shortlist import effect_of
from .signals import Screen, Signal
from .trials import TRIALS

# Share of the gain promised by the evidence that a refit must realise; otherwise it is fitted in another way
KEPT = 0.5
# A new refit of a set replaces the stored one if its misfit is smaller by this share
BETTER = 1e-3
# Gauss-Newton steps of a preliminary refit, one of several from different starts
ROUGHLY = 8
# ... two of which found the same optimum if their misfits differ by less than this factor
AGREED = 1.05
# A fuller form whose short refits leave no less than this share of the simple form's misfit is searched no further
PROMISING = 0.9
# Grid points in [-pi, pi) for the phase that all runs have in common
PHASES = 120

Start = tuple[Prepared, Optimum]


class Refits:
    """Fits models and keeps one for each set of effects; `solved` is how the motor without effects was found."""

    def __init__(
        self,
        base: Model,
        solved: Solved,
        library: Library,
        comparison: Comparison,
        report: ReportProgress,
    ) -> None:
        self.library, self.solved, self.report = library, solved, report
        self.comparison = comparison
        self.models: dict[frozenset[str], Model] = {frozenset(): base}
        # pairs of a set and a model from which it has been fitted, or need not be
        self.begun_from: set[tuple[frozenset[str], Model]] = set()
        self.begun: dict[str, Values] = {}  # by effect: the values from which it was first fitted

    def with_signal(self, current: Model, signal: Signal, found: Screen) -> Model | None:
        """The current model with the effect of a signal added; None if physics forbids the coefficients found.

        A set that was fitted from another model and does not realise the promised gain is fitted again from this one.
        """
        effects = _with_another(current.effects, effect_of(signal))

        def refit() -> Model | None:
            start = self._pointed_at(current, effects, signal, found)
            if start is None:
                return None
            others = self._starts(current, effects)
            if others:
                return self._best_of(effects, [start, *others], found.white)
            return self._refitted(effects, start, current, signal, found.white)

        model, key = self._once(effects, current, refit), frozenset(effects)
        begun_here = (key, current) in self.begun_from
        if model is None or begun_here or self._keeps(model, current, signal, found.white):
            return model
        return self._better_from(key, current, refit)

    def _keeps(self, model: Model, current: Model, signal: Signal, white: Whitener) -> bool:
        """Whether a refit realises at least the share `KEPT` of the gain that the evidence promised."""
        before, after = (self.comparison.fitted(m, white).squares for m in (current, model))
        return bool(before - after > KEPT * signal.gain)

    def _better_from(
        self, key: frozenset[str], current: Model, refit: Callable[[], Model | None]
    ) -> Model:
        """The better of the stored fit of a set and a new one from the current model."""
        again = self._fitted(key, current, refit)
        if again and _fitness(again) < (1 - BETTER) * _fitness(self.models[key]):
            self.models[key] = again
        return self.models[key]

    def in_place(self, current: Model, white: Whitener, old: str, new: str) -> Model | None:
        """The current model with `new` in place of `old`: a fuller or a simpler form of it, an effect that resembles
        it, one with starts of its own, or one begun before. Others have no values to start from."""
        effects = (*(e for e in current.effects if e != old), new)

        def refit() -> Model:
            its = self._by_what_it_replaces(current, old, new)
            starts = self._starts(current, effects) or [self._start(current, effects, its)]
            to_beat = np.inf
            if old in FULLER and FULLER[old].effect == new:
                starts = [self._in_full(current, old, effects), *starts]
                to_beat = PROMISING * _fitness(current)
            return self._best_of(effects, starts, white, to_beat)

        return self._once(effects, current, refit)

    def _by_what_it_replaces(self, current: Model, old: str, new: str) -> dict[str, Values]:
        """Start values, from the fit of the old effect, of one that resembles it or of a simple form never begun."""
        begins = TRIALS[old].alike.get(new)
        if new not in self.begun and new in FULLER and FULLER[new].effect == old:
            begins = FULLER[new].to_simple
        if begins is None:
            return {}
        return {new: begins(next(e for e in current.motor.effects if e.name == old))}

    def sought(self, current: Model, effect: str) -> Model:
        """The current model with one more effect, by a new global search; or the stored fit of the set, if better."""
        effects = (*current.effects, effect)

        def search() -> Model:
            given = current.given.with_effects([EFFECTS[e] for e in effects])
            method, seed = self.solved.search.method, self.solved.seed
            given, found = search_and_refine(given, method, seed, searches=1)
            return model_of(effects, given, found.fit)

        if (key := frozenset(effects)) in self.models:
            return self._better_from(key, current, search)
        model = self._once(effects, current, search)
        assert model is not None
        return model

    def clearly_in_full(self, current: Model, white: Whitener, effect: str) -> Model:
        """The current model with a fuller form of an effect, whose extra parameters are held where they clearly act."""
        fuller = FULLER[effect]
        effects = (*(e for e in current.effects if e != effect), fuller.effect)
        given, begun = self._in_full(current, effect, effects)
        held = {f"{fuller.effect}.{field}" for field in fuller.extra}
        if "Kt" in _unseen(current):
            # all torques could scale up with Kt, until the part that is held is negligible
            held.add("Kt")
        free = jnp.asarray([name not in held for name in given.problem.parameters.names])
        given = given._replace(problem=replace(given.problem, free=free))
        return refit_from(effects, given, begun, white)

    def _in_full(self, current: Model, effect: str, effects: tuple[str, ...]) -> Start:
        """The start of a refit with the fuller form of an effect, from the fit of the simple one."""
        fuller = FULLER[effect]
        simple = next(e for e in current.motor.effects if e.name == effect)
        values = fuller.from_simple(simple, self.library.scales)
        return self._start(current, effects, {fuller.effect: values})

    def without(self, model: Model, effect: str, white: Whitener) -> Model:
        """The model without one of its effects; fitted again if the larger one's parameters beat the stored fit."""
        rest = tuple(e for e in model.effects if e != effect)
        given, begun = self._start(model, rest, {})

        def refit() -> Model:
            return refit_from(rest, given, begun, white)

        smaller = self._once(rest, model, refit)
        assert smaller is not None
        key = frozenset(rest)
        if (key, model) not in self.begun_from:
            self.begun_from.add((key, model))
            here = polish(given.problem, begun, steps=0).fitness
            if here < (1 - BETTER) * _fitness(smaller):
                return self._better_from(key, model, refit)
        return smaller

    def _once(
        self, effects: Sequence[str], current: Model, refit: Callable[[], Model | None]
    ) -> Model | None:
        key = frozenset(effects)
        if key not in self.models:
            found = self._fitted(key, current, refit)
            if found is None:
                return None
            self.models[key] = found
        return self.models[key]

    def _fitted(
        self, key: frozenset[str], current: Model, refit: Callable[[], Model | None]
    ) -> Model | None:
        self.report(f"trying {' + '.join(sorted(key))}", _fitness(current))
        self.begun_from.add((key, current))
        return refit()

    def _starts(self, current: Model, effects: tuple[str, ...]) -> list[Start]:
        """Additional starts for the last of some effects: those of its `Trial.starts`."""
        starts = TRIALS[effects[-1]].starts
        others = starts(self.library.scales) if starts else []
        return [self._start(current, effects, {effects[-1]: values}) for values in others]

    def _best_of(
        self,
        effects: tuple[str, ...],
        starts: Sequence[Start],
        white: Whitener,
        to_beat: float = np.inf,
    ) -> Model:
        """The best refit from several starts of the last effect.

        Short refits are made until the best reaches the noise (`POOR_FIT`) or two agree on it (`AGREED`); it is then
        refitted in full. With `Trial.factors`, populations search around each start first; and around the end, if the
        best short refit has a misfit below `to_beat`.
        """
        given, seed = starts[0][0], self.solved.seed
        runs = starts[0][1].unknowns.runs
        factors = {f"{effects[-1]}.{f}": times for f, times in TRIALS[effects[-1]].factors.items()}
        if factors:
            starts = [(given, _nearby(given, start, factors, seed)) for _, start in starts]

        def enough(ends: list[Optimum]) -> bool:
            least, *others = sorted(end.fitness for end in ends)
            good = least < POOR_FIT * given.problem.outputs
            return bool(good or (others and others[0] < AGREED * least))

        ends = map_in_threads_until(_roughly, starts, enough)
        best = min(ends, key=lambda end: end.fitness)
        begun = best._replace(unknowns=best_backlash_start(given.problem, best.unknowns, runs))
        if factors and best.fitness < to_beat:
            return _best_around(effects, given, begun, factors, seed)
        return refit_from(effects, given, begun, white)

    def _refitted(
        self,
        effects: tuple[str, ...],
        start: Start,
        current: Model,
        signal: Signal,
        white: Whitener,
    ) -> Model:
        """A refit from where the evidence points; if that does not realise the promised gain, plain least squares, too.

        The plain fit is returned if it leaves far less unfiltered misfit: the filter had taken the missing effect for
        noise. Otherwise a second filtered refit starts from it, and the better of the two filtered ones is returned.
        """
        given, begun = start
        model = refit_from(effects, given, begun, white)
        if self._keeps(model, current, signal, white):
            return model
        plain = polish(given.problem, begun)
        if plain.fitness < KEPT * _fitness(model):
            return model_of(effects, given, plain)
        plainly = refit_from(effects, given, plain.optimum, white)
        left = self.comparison.fitted
        return min((model, plainly), key=lambda m: left(m, white).squares)

    def _pointed_at(
        self,
        current: Model,
        effects: tuple[str, ...],
        signal: Signal,
        found: Screen,
    ) -> Start | None:
        """The start of a refit by a signal's regression coefficients; None if physics forbids them."""
        candidate, fit = signal.candidate, found.evidence.regress([signal.block])
        assert candidate is not None
        coefficients, angles = fit.coefficients[0], np.zeros(current.given.problem.tape.runs)
        if candidate.own_phase:
            assert candidate.amplitude is not None
            periods = candidate.columns[0]["periods"]
            turns = _turns(current, candidate.effect)
            phase, angles[current.training] = common_phase(coefficients, turns, periods)
            size = np.median(np.hypot(*coefficients.T))
            coefficients = size * np.array([np.cos(phase), np.sin(phase)])
        its = candidate.build(coefficients, current.dry)
        if its is None:
            return None
        values = {candidate.effect: its}
        if "constant_load" in set(effects) - set(current.effects) - {candidate.effect}:
            values["constant_load"] = {"torque_Nm": current.friction_asymmetry}
        return self._start(current, effects, values, fit.moved, angles)

    def _start(
        self,
        current: Model,
        effects: tuple[str, ...],
        values: dict[str, Values],
        moved: np.ndarray | float = 0.0,
        angles: np.ndarray | float = 0.0,
    ) -> Start:
        """The start of a refit of the current model with other effects.

        **Arguments**: `values` of new effects; `moved`, first-order changes of the current search coordinates;
        `angles`, in rad, added to the rotor's initial angles.
        """
        given = current.given.with_effects([EFFECTS[e] for e in effects])
        parameters, unknowns = given.problem.parameters, current.fit.unknowns
        names = current.given.problem.parameters.names
        # the regression may move a parameter that no run determines by any amount
        near = np.clip(moved, -1.0, 1.0)
        before = dict(zip(names, np.asarray(unknowns.coordinates) + near, strict=True))
        for effect, new in values.items():
            self.begun.setdefault(effect, new)
        coordinates, undetermined = [], current.undetermined
        for name, log in zip(parameters.names, parameters.logarithmic, strict=True):
            effect, _, field = name.partition(".")
            if name in before and not (field and name in undetermined):
                coordinates.append(before[name])
            else:
                value = values.get(effect, self.begun.get(effect, {}))[field]
                coordinates.append(np.log(max(value, 1e-300)) if log else value)
        inside = np.clip(coordinates, parameters.lower, parameters.upper)
        runs = unknowns.runs._replace(angle=unknowns.runs.angle + angles)
        start = Unknowns(jnp.asarray(inside), runs)
        return given, Optimum(start, np.inf, (), False)


def _with_another(here: tuple[str, ...], effect: str) -> tuple[str, ...]:
    """A set of effects with one more in place of those that it contains: the others in order, those that
    `with_split_friction` adds, and the new one last."""
    contains, kept = CONTAINS.get(effect, set()), set(here)
    if contains & with_split_friction(kept):
        kept = with_split_friction(kept) - contains
    return (*(e for e in here if e in kept), *sorted(kept - set(here)), effect)


def _fitness(model: Model) -> float:
    return model.fit.fitness


def _roughly(start: Start) -> Optimum:
    """A preliminary refit of a few steps; its misfit is infinite where it cannot be simulated."""
    given, begun = start
    return polish(given.problem, begun, ROUGHLY).optimum


def _best_around(
    effects: tuple[str, ...],
    given: Prepared,
    begun: Optimum,
    factors: Mapping[str, float],
    seed: int,
) -> Model:
    """The better of two refits, by the whitening filter of the residuals at the start: one from there, and one from the
    best of a population around where that ended."""
    white = whitener(residuals_of(given, polish(given.problem, begun, steps=0)))
    sharp = with_whitening(given, white).problem

    def left(model: Model) -> float:
        return polish(sharp, model.fit.optimum, steps=0).fitness

    model = refit_from(effects, given, begun, white)
    nearer = {name: np.sqrt(times) for name, times in factors.items()}
    elsewhere = _nearby(given, model.fit.optimum, nearer, seed)
    return min((model, refit_from(effects, given, elsewhere, white)), key=left)


def _nearby(given: Prepared, start: Optimum, factors: Mapping[str, float], seed: int) -> Optimum:
    """The best point of a population search around a start; `factors` as in `best_nearby`."""
    fit = polish(given.problem, start, steps=0)
    return best_nearby(given.problem, fit, factors, seed)


def _turns(model: Model, effect: str) -> list[np.ndarray | None]:
    """The angles, in rad, by which the start of each training run may be turned to suit an effect; None: by any.

    Zero if its angle is known or defines zero; whole periods of another effect of the angle that the model has.
    """
    others = [e for e in model.motor.effects if "angle" in e.states and e.name != effect]
    count = round(2 * np.pi / float(others[0].repeats_after()["angle"])) if others else 0
    whole = 2 * np.pi * np.arange(count) / count if count else None
    turnable = np.asarray(model.given.problem.angle_unknown)
    return [whole if turnable[run] else np.zeros(1) for run in model.training]


def common_phase(
    coefficients: Float[np.ndarray, "runs 2"], turns: Sequence[np.ndarray | None], periods: float
) -> tuple[float, np.ndarray]:
    """The phase, in rad, that all runs have in common, and the angle by which the start of each is turned for it.

    **Arguments**: `coefficients`, of cosine and sine in each run; `turns`, as from `_turns`; `periods` in one turn.
    """
    sizes = np.hypot(*coefficients.T)
    phases = np.arctan2(coefficients[:, 1], coefficients[:, 0])
    common = np.linspace(-np.pi, np.pi, PHASES, endpoint=False)
    angles, fits = np.zeros((len(phases), PHASES)), np.zeros((len(phases), PHASES))
    for run, allowed in enumerate(turns):
        apart = np.angle(np.exp(1j * (phases[run] - common)))
        trials = apart[None] / periods if allowed is None else allowed[:, None] + 0 * apart
        together = np.cos(apart - periods * trials)
        best = np.argmax(together, axis=0)[None]
        angles[run] = np.take_along_axis(trials, best, 0)[0]
        fits[run] = np.take_along_axis(together, best, 0)[0]
    chosen = int(np.argmax(sizes**2 @ fits))
    return float(common[chosen]), angles[:, chosen]


def _unseen(model: Model) -> set[str]:
    """The parameters with a part in any direction that the runs do not determine."""
    problem = model.given.problem
    unseen = information_of(problem, model.fit).unseen
    return {name for d in unseen for name in moved_by(d, problem.parameters)}

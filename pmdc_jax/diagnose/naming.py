"""Which effects are missing: forward from the motor without effects, each step refitted in full simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import stats

from ..effects import EFFECTS
from ..identify.pipeline import POOR, Prepared, settle
from ..identify.refine import POLISH, Refined, Unknowns, polish
from .candidates import STARTS, Candidate, Values
from .library import Library
from .model import Model, rows_of
from .noise import Whitener, whitener
from .periodic import Line, common_line, spectrum
from .screen import Screen, Signal, beyond_curves, left_over, screen, signals

# Chance that anything at all is called missing from a motor that lacks nothing
ALARM = 0.01
# At most so many effects are named, and so many candidates for one are refitted in full simulation
MOST, SHORTLIST = 3, 3
# ... those whose evidence to first order is at least this share of the best one's
COMPARABLE = 0.6
# An effect that contains another one replaces it
CONTAINS = {
    "stribeck_friction": {"coulomb_friction"},
    "asymmetric_friction": {"coulomb_friction", "constant_load"},
}
# What a named effect leaves of the squares that it explains, by a formula that is not quite nature's, asks for no other
REMAINDER = 0.02
# Effects that no column shows, with the simpler ones in whose place they are tried if those leave something
HARDER = [("shaft_compliance", "gear_backlash")]
# Steps of a refit that is one of several
ROUGHLY = 8
# ... and of which two have ended alike if their misfits differ by no more
AGREED = 1.05
# Rivals whose criterion is nearer than this are not told apart
MARGIN = 8.0


def chance_of_nothing(
    of_candidates: Sequence[Signal], of_curves: Sequence[Signal], count: int
) -> float:
    """Chance of evidence as strong as the strongest if nothing were missing: Bonferroni over `count` blocks."""
    smallest = min(s.log_p for s in (*of_candidates, *of_curves))
    return float(min(1.0, np.exp(smallest + np.log(count))))


class Seen(NamedTuple):
    """The evidence against a model, read once."""

    screen: Screen
    of_candidates: list[Signal]
    of_curves: list[Signal]
    left: float  # chance of it if nothing more were missing

    @property
    def clearest(self) -> Signal:
        """The signal with the largest gain."""
        return max((*self.of_candidates, *self.of_curves), key=lambda s: s.gain)


Start = tuple[Prepared, Refined]


class Fitted(NamedTuple):
    """A model among others fitted to the same runs, and how well it does by a common filter of the noise."""

    model: Model
    squares: float
    criterion: float  # squares and the price of every parameter; less is better


class Naming(NamedTuple):
    """The set chosen, its rivals, and what is left that no candidate explains."""

    chosen: Model
    rivals: list[Model]
    first: Screen  # evidence against the motor without effects
    last: Screen  # and against the chosen one
    nothing: float  # chance of the evidence if nothing were missing
    left: float  # chance of what is left if nothing more were missing
    explained: float  # how much of the squares the chosen set takes away
    unexplained: float  # and how much the clearest curve would still take
    # share of what the chosen one leaves that no curve takes away, as root mean square
    noise: float
    without: dict[str, float]  # by effect of the chosen: chance of the data without it
    line: Line | None  # a steady oscillation that the chosen one does not have


class Namer:
    """Refits sets of effects, each once."""

    def __init__(self, base: Model, report):
        self.base, self.report = base, report
        self.library = Library(base)
        self.models: dict[frozenset[str], Model] = {frozenset(): base}

    def name(self) -> Naming:
        """Add effects while the evidence asks for them; then see which could be spared or replaced."""
        current, first = self.base, self._see(self.base)
        found = first
        while found.left < ALARM and len(current.effects) < MOST and self._worth(current, found):
            shortlist = self._shortlist(current, found)
            tried = [self.refit(current, s, found.screen) for s in shortlist]
            tried += [
                self._in_place(current, *pair) for pair in HARDER if pair[0] in current.effects
            ]
            tried = [m for m in tried if m is not None]
            if not tried:
                break
            best = _plainest(self.compare([current, *tried]))
            if best is current:
                break
            current = self._spared(best)
            found = self._see(current)
        ranked = self.compare(list(self.models.values()))
        price = {frozenset(f.model.effects): f for f in ranked}
        mine = price[frozenset(current.effects)]
        rivals = [
            f.model
            for f in ranked
            if f.criterion < mine.criterion + MARGIN and self._is_rival(f.model, current)
        ]
        alone = price[frozenset()].squares
        return Naming(
            chosen=current,
            rivals=rivals,
            first=first.screen,
            last=found.screen,
            nothing=first.left,
            left=found.left,
            explained=alone - mine.squares,
            unexplained=found.clearest.gain,
            noise=np.sqrt(beyond_curves(found.screen)) if found.left < ALARM else 1.0,
            without=self._without(current),
            line=self._line(current),
        )

    def _worth(self, current: Model, found: Seen) -> bool:
        """Whether what is left is more than an effect that is there already may leave by its formula."""
        if not current.effects:
            return True
        base, mine = (left_over(m, self._white(current))[0] for m in (self.base, current))
        return found.clearest.gain > REMAINDER * (base - mine)

    def _see(self, model: Model) -> Seen:
        found = screen(model, self.library)
        of_candidates, of_curves = signals(found)
        count = len(found.candidates) + len(found.curves)
        left = chance_of_nothing(of_candidates, of_curves, count)
        return Seen(found, of_candidates, of_curves, left)

    def _is_rival(self, model: Model, chosen: Model) -> bool:
        """Not the same, not a part of it, not the same with something on top."""
        a, b = set(model.effects), set(chosen.effects)
        return bool(a) and not (a <= b or b <= a or _same_class(a, b) or _contains(a, b))

    def _shortlist(self, current: Model, found: Seen) -> list[Signal]:
        """The most significant shape of each of the best few effects.

        None, if that is an effect which is there already: its own formula is what is left to be desired.
        """
        best: dict[str, Signal] = {}
        for s in found.of_candidates:
            assert s.candidate is not None
            best.setdefault(s.candidate.effect, s)
        clear = np.log(ALARM / len(found.screen.candidates))
        ranked = [s for s in best.values() if s.log_p < clear]
        if not ranked or next(iter(best)) in current.effects:
            return []
        near = [s for s in ranked if s.log_p < COMPARABLE * ranked[0].log_p]
        return [s for e, s in best.items() if s in near and e not in current.effects][:SHORTLIST]

    def refit(self, current: Model, signal: Signal, found: Screen) -> Model | None:
        """The current model with one more effect, in full simulation."""
        assert signal.candidate is not None
        name = signal.candidate.effect
        kept = [e for e in current.effects if e not in CONTAINS.get(name, ())]
        key = frozenset([*kept, name])
        if key in self.models:
            return self.models[key]
        self.report(f"trying {' + '.join(sorted(key))}", current.polished.refined.fitness)
        fit = found.evidence.regress([signal.block])
        runs = len(self.base.given.roles)
        values, angles = _values(signal.candidate, fit.coefficients[0], current.dry, runs)
        if values is None:
            return None
        effects = (*kept, name)
        start = self._start(current, effects, {name: values}, fit.moved, angles)
        self.models[key] = self._best_of(effects, [start, *self._starts(current, effects)])
        return self.models[key]

    def _in_place(self, current: Model, old: str, new: str) -> Model:
        """The current model with an effect in place of a simpler one."""
        effects = (*(e for e in current.effects if e != old), new)
        key = frozenset(effects)
        if key not in self.models:
            self.report(f"trying {' + '.join(sorted(key))}", current.polished.refined.fitness)
            self.models[key] = self._best_of(effects, self._starts(current, effects))
        return self.models[key]

    def _starts(self, current: Model, effects: tuple[str, ...]) -> list[Start]:
        """Where else to begin refitting the last of some effects."""
        others = STARTS.get(effects[-1], lambda scales: [])(self.library.scales)
        return [self._start(current, effects, {effects[-1]: values}) for values in others]

    def _best_of(self, effects: tuple[str, ...], starts: Sequence[Start]) -> Model:
        """The best refit of several, begun one after another until one is as good as the noise or found twice."""
        ends = []
        for given, start in starts:
            steps = POLISH if len(starts) == 1 else ROUGHLY
            ends.append((given, polish(given.problem, start, steps).refined))
            best, *others = sorted(end.fitness for _, end in ends)
            if best < POOR * given.problem.outputs or (others and others[0] < AGREED * best):
                break
        return _settled(effects, *min(ends, key=lambda end: end[1].fitness))

    def _start(
        self,
        current: Model,
        effects: tuple[str, ...],
        values: dict[str, Values],
        moved: np.ndarray | float = 0.0,
        angles: np.ndarray | float = 0.0,
    ) -> Start:
        """Where to begin refitting the current model with other effects: their `values`, and how far by the
        evidence the motor's parameters have `moved` and each run begins turned."""
        given = current.given.with_effects([EFFECTS[e] for e in effects])
        parameters, unknowns = given.problem.parameters, current.polished.refined.unknowns
        names = current.given.problem.parameters.names
        before = dict(zip(names, np.asarray(unknowns.coordinates) + moved, strict=True))
        coordinates = []
        for name, log in zip(parameters.names, parameters.logarithmic, strict=True):
            if name in before:
                coordinates.append(before[name])
            else:
                effect, field = name.split(".")
                value = values[effect][field]
                coordinates.append(np.log(max(value, 1e-300)) if log else value)
        inside = np.clip(coordinates, parameters.lower, parameters.upper)
        local = np.array(unknowns.local)
        local[:, 3] += angles
        start = Unknowns(jnp.asarray(inside), jnp.asarray(local))
        return given, Refined(start, np.inf, (), False)

    def _spared(self, model: Model) -> Model:
        """The model without effects that it can do without."""
        for effect in model.effects[:-1]:
            rest = tuple(e for e in model.effects if e != effect)
            smaller = self.models.get(frozenset(rest)) or self._drop(model, rest)
            if self.compare([model, smaller])[0].model is smaller:
                return self._spared(smaller)
        return model

    def _drop(self, model: Model, rest: tuple[str, ...]) -> Model:
        smaller = _settled(rest, *self._start(model, rest, {}))
        self.models[frozenset(rest)] = smaller
        return smaller

    def compare(self, models: Sequence[Model]) -> list[Fitted]:
        """By the squares of what each leaves, made white by the filter of the one that leaves least."""
        least = min(models, key=lambda m: m.polished.refined.fitness)
        white = self._white(least)
        fitted = []
        for model in models:
            squares, rows = left_over(model, white)
            price = len(model.given.problem.parameters.names) * np.log(rows)
            fitted.append(Fitted(model, squares, squares + price))
        return sorted(fitted, key=lambda f: f.criterion)

    def _line(self, model: Model) -> Line | None:
        spectra = []
        for run, fit in zip(model.given.training, rows_of(model), strict=True):
            drives = (run.voltage, run.torque, run.load, run.current)
            # a current drives only where there is no voltage
            there = [x for x in drives[: 3 + (run.voltage is None)] if x is not None]
            residuals = np.where(fit.residual.known[:, None], fit.residual.values, 0.0)
            driving = np.nan_to_num(np.stack(there, axis=1))
            spectra.append(spectrum(residuals[: len(driving)], driving, fit.residual.kind[0]))
        return common_line(spectra)

    def _white(self, model: Model) -> Whitener:
        return whitener([fit.residual for fit in rows_of(model)])

    def _without(self, chosen: Model) -> dict[str, float]:
        chances = {}
        for effect in chosen.effects:
            rest = tuple(e for e in chosen.effects if e != effect)
            smaller = self.models.get(frozenset(rest)) or self._drop(chosen, rest)
            both = {f.model.effects: f.squares for f in self.compare([chosen, smaller])}
            gain = both[smaller.effects] - both[chosen.effects]
            chances[effect] = float(stats.chi2.sf(max(gain, 0.0), len(EFFECTS[effect].ranges)))
        return chances


def _settled(effects: tuple[str, ...], given: Prepared, start: Refined) -> Model:
    return Model(effects, *settle(given, start))


def _values(candidate: Candidate, coefficients: np.ndarray, dry: float, runs: int):
    """An effect's parameters by the coefficients of its columns, and how far each run starts turned."""
    angles = np.zeros(runs)
    if not candidate.own_phase:
        return candidate.build(coefficients, dry), angles
    sizes = np.hypot(*coefficients.T)
    phases = np.arctan2(coefficients[:, 1], coefficients[:, 0])
    values = candidate.build(coefficients[0], dry)
    assert values is not None and candidate.amplitude is not None
    values = {**values, candidate.amplitude: float(np.median(sizes))}
    angles[: len(phases)] = (phases - phases[0]) / values["periods"]
    return values, angles


def _same_class(a: set[str], b: set[str]) -> bool:
    """While the motor turns, asymmetric friction and Coulomb friction with a constant load are one torque."""
    return _spelt_out(a) == _spelt_out(b)


def _spelt_out(effects: set[str]) -> set[str]:
    if "asymmetric_friction" in effects:
        return (effects - {"asymmetric_friction"}) | {"coulomb_friction", "constant_load"}
    return effects


def _plainest(ranked: Sequence[Fitted]) -> Model:
    """The best model, or a simpler one that it contains and that the data do not tell from it."""
    best = ranked[0]
    for other in ranked[1:]:
        a, b = set(other.model.effects), set(best.model.effects)
        within = any(a - b and a - b <= CONTAINS.get(e, set()) and b - a == {e} for e in b)
        if within and other.criterion < best.criterion + MARGIN:
            return other.model
    return best.model


def _contains(a: set[str], b: set[str]) -> bool:
    """Whether one set is the other but for an effect that another one contains."""
    return any(_simplified(x) <= y or _simplified(x) == _simplified(y) for x, y in ((a, b), (b, a)))


def _simplified(effects: set[str]) -> set[str]:
    return {
        simple
        for e in effects
        for simple in (CONTAINS[e] - {"constant_load"} if e in CONTAINS else {e})
    }

"""Which effects are missing: forward from the motor without effects, each step refitted in full simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import stats

from ..effects import EFFECTS
from ..identify.pipeline import POOR, Prepared, settle
from ..identify.refine import Polished, Refined, Unknowns, polish
from ..identify.uncertainty import FLAT
from .candidates import STARTS, Candidate, Values
from .library import Library
from .model import Model, rows_of, settled, sharpened, squares_of
from .noise import Whitener, whitener
from .periodic import Line, common_line, spectrum
from .screen import Screen, Signal, beyond_curves, screen, signals

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
# What effects leave of the squares that they explain, by formulas that are not quite nature's: this little asks for
# no other effect; up to so much may be all due to them, and more if it is a curve over an effect's own variable
REMAINDER, FORMULA, OWN_FORMULA = 0.02, 0.1, 0.5
# An effect is added if it takes away this share of what the clearest signal would
MUCH_OF_IT = 0.3
# Effects that no column shows, with the simpler ones in whose place they are tried if those leave something
HARDER = [("shaft_compliance", "gear_backlash")]
# Share of the gain foretold by the evidence that a refit keeps, or else is tried in another way
KEPT = 0.5
# Steps of a refit that is one of several
ROUGHLY = 8
# ... and of which two have ended alike if their misfits differ by no more
AGREED = 1.05
# A fit to white residuals may leave so many times the plain squares of the fit that leaves least of them
NEAR = 1.5
# Rivals whose criterion is nearer than this, and this share of what neither explains, are not told apart
MARGIN, OF_UNEXPLAINED = 8.0, 0.1


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
    explained: (
        float  # how much of the squares the model takes away that the motor without effects leaves
    )

    @property
    def clearest(self) -> Signal:
        """The signal with the largest gain."""
        return max((*self.of_candidates, *self.of_curves), key=lambda s: s.gain)

    @property
    def unexplained(self) -> float:
        """What the clearest signal would still take away, over what the model takes away already."""
        return self.clearest.gain / self.explained if self.explained > 0 else np.inf

    def asks_for_more(self) -> bool:
        """Whether more is missing than the formulas of the model's effects leave to be desired."""
        if self.left >= ALARM or self.unexplained < REMAINDER:
            return False
        best = max((s.gain for s in self.of_candidates), default=0.0)
        return bool(best > MUCH_OF_IT * self.clearest.gain)

    def is_formula(self, model: Model) -> bool:
        """Whether what is left may well be that of the model's effects by formulas of nature's own."""
        if not model.effects or self.unexplained < FORMULA:
            return bool(model.effects)
        clearest = self.clearest.of
        if isinstance(clearest, Candidate):
            return clearest.effect in model.effects
        kinds = [EFFECTS[name] for name in model.effects]
        own = {("electrical" if k.equation == "input" else k.equation, k.variable) for k in kinds}
        return self.unexplained < OWN_FORMULA and (clearest.equation, clearest.variable) in own


Start = tuple[Prepared, Refined]


class Fitted(NamedTuple):
    """A model among others fitted to the same runs, and how well it does by a common filter of the noise."""

    model: Model
    squares: float
    criterion: float  # squares and the price of every parameter; less is better
    white: Whitener


class Naming(NamedTuple):
    """The set chosen, its rivals, and what is left that no candidate explains."""

    chosen: Model
    rivals: list[Model]
    first: Screen  # evidence against the motor without effects
    last: Screen  # and against the chosen one
    nothing: float  # chance of the evidence if nothing were missing
    left: float  # chance of what is left if nothing more were missing
    explained: bool  # whether that is no more than other formulas of the chosen effects might leave
    # share of what the chosen one leaves that no curve takes away, as root mean square
    noise: float
    without: dict[str, float]  # by effect of the chosen: chance of the data without it
    ended: tuple[Prepared, Polished]  # the last fit of the chosen one
    line: Line | None  # a steady oscillation that the chosen one does not have


class Namer:
    """Refits sets of effects, each once."""

    def __init__(self, base: Model, report):
        self.base, self.report = base, report
        self.library = Library(base)
        self.models: dict[frozenset[str], Model] = {frozenset(): base}
        self.filters: dict[frozenset[str], Whitener] = {}
        self.begun: dict[str, Values] = {}  # where each effect was first begun to be fitted
        self.compared: dict[tuple[frozenset[str], int], Fitted] = {}

    def name(self) -> Naming:
        """Add effects while the evidence asks for them; then see which could be spared or replaced."""
        current, first = self.base, self._see(self.base)
        found = first
        while found.asks_for_more() and len(current.effects) < MOST:
            shortlist = self._shortlist(current, found)
            tried = [self.refit(current, s, found.screen) for s in shortlist]
            tried += [
                self._in_place(current, found.screen.white, *pair)
                for pair in HARDER
                if pair[0] in current.effects
            ]
            tried = [m for m in tried if m is not None]
            if not tried:
                break
            best = self._best(tried, found.screen.white)
            # judged by the noise that the clearest signal leaves: a filter of what a poorer model leaves takes
            # for noise what is missing
            if _plainest(self.compare([current, best], found.screen.white)) is current:
                break
            current = self._spared(best)
            found = self._see(current)
        ranked = self.compare(list(self.models.values()), found.screen.white)
        price = {frozenset(f.model.effects): f for f in ranked}
        mine = price[frozenset(current.effects)]
        margin = MARGIN + (OF_UNEXPLAINED * found.clearest.gain if found.left < ALARM else 0.0)
        rivals = [
            f.model
            for f in ranked
            if f.criterion < mine.criterion + margin and self._is_rival(f.model, current)
        ]
        return Naming(
            chosen=current,
            rivals=rivals,
            first=first.screen,
            last=found.screen,
            nothing=first.left,
            left=found.left,
            explained=found.is_formula(current),
            noise=np.sqrt(beyond_curves(found.screen)) if found.left < ALARM else 1.0,
            without=self._without(current, found.screen.white),
            ended=self._ended(current),
            line=self._line(current),
        )

    def _see(self, model: Model) -> Seen:
        found = screen(model, self.library)
        of_candidates, of_curves = signals(found)
        count = len(found.candidates) + len(found.curves)
        left = chance_of_nothing(of_candidates, of_curves, count)
        explained = 0.0
        if model.effects:
            base, mine = (self._left(m, found.white) for m in (self.base, model))
            explained = base.squares - mine.squares
        return Seen(found, of_candidates, of_curves, left, explained)

    def _best(self, tried: Sequence[Model], white: Whitener) -> Model:
        """The best of some refits, by the filter of what the one that leaves least leaves."""
        least = self.compare(tried, white)[0].model
        return _plainest(self.compare(tried, self._white(least)))

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
        others = self._starts(current, effects)
        if others:
            self.models[key] = self._best_of(effects, [start, *others], found.white)
        else:
            self.models[key] = self._refitted(effects, start, current, signal, found.white)
        return self.models[key]

    def _in_place(self, current: Model, white: Whitener, old: str, new: str) -> Model:
        """The current model with an effect in place of a simpler one."""
        effects = (*(e for e in current.effects if e != old), new)
        key = frozenset(effects)
        if key not in self.models:
            self.report(f"trying {' + '.join(sorted(key))}", current.polished.refined.fitness)
            starts = self._starts(current, effects)
            self.models[key] = self._best_of(effects, starts, white)
        return self.models[key]

    def _starts(self, current: Model, effects: tuple[str, ...]) -> list[Start]:
        """Where else to begin refitting the last of some effects."""
        others = STARTS.get(effects[-1], lambda scales: [])(self.library.scales)
        return [self._start(current, effects, {effects[-1]: values}) for values in others]

    def _best_of(self, effects: tuple[str, ...], starts: Sequence[Start], white: Whitener) -> Model:
        """The best refit of several, begun one after another until one is as good as the noise or found twice."""
        ends = []
        for given, start in starts:
            ends.append((given, polish(given.problem, start, ROUGHLY).refined))
            best, *others = sorted(end.fitness for _, end in ends)
            if best < POOR * given.problem.outputs or (others and others[0] < AGREED * best):
                break
        given, best = min(ends, key=lambda end: end[1].fitness)
        return settled(effects, given, best, white)

    def _refitted(
        self,
        effects: tuple[str, ...],
        start: Start,
        current: Model,
        signal: Signal,
        white: Whitener,
    ) -> Model:
        """Refitted from where the evidence points; if that leads nowhere near what it promises, also by way of plain
        least squares."""
        given, begun = start
        model = settled(effects, given, begun, white)
        before, after = (squares_of(*sharpened(m, white)) for m in (current, model))
        if before - after > KEPT * signal.gain:
            return model
        plainly = settled(effects, given, polish(given.problem, begun).refined, white)
        return plainly if squares_of(*sharpened(plainly, white)) < after else model

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
        # a parameter that no run sees may seem to move by any factor
        near = np.clip(moved, -1.0, 1.0)
        before = dict(zip(names, np.asarray(unknowns.coordinates) + near, strict=True))
        for effect, new in values.items():
            self.begun.setdefault(effect, new)
        coordinates = []
        for name, log in zip(parameters.names, parameters.logarithmic, strict=True):
            effect, _, field = name.partition(".")
            if name in before and not (field and self._lost(current, name)):
                coordinates.append(before[name])
            else:
                value = values.get(effect, self.begun.get(effect, {}))[field]
                coordinates.append(np.log(max(value, 1e-300)) if log else value)
        inside = np.clip(coordinates, parameters.lower, parameters.upper)
        local = np.array(unknowns.local)
        local[:, 3] += angles
        start = Unknowns(jnp.asarray(inside), jnp.asarray(local))
        return given, Refined(start, np.inf, (), False)

    def _lost(self, model: Model, name: str) -> bool:
        """Whether an effect's parameter has gone where no run sees it, so that nothing leads it back."""
        column = model.given.problem.parameters.names.index(name)
        seen = np.asarray(model.polished.evaluation.jacobian)[
            model.given.problem.counted, ..., column
        ]
        return float(np.square(seen).sum()) < 1 / FLAT**2

    def _spared(self, model: Model) -> Model:
        """The model without effects that it can do without."""
        for effect in model.effects[:-1]:
            rest = tuple(e for e in model.effects if e != effect)
            smaller = self.models.get(frozenset(rest)) or self._drop(model, rest)
            if self.compare([model, smaller], self._white(model))[0].model is smaller:
                return self._spared(smaller)
        return model

    def _drop(self, model: Model, rest: tuple[str, ...]) -> Model:
        smaller = settled(rest, *self._start(model, rest, {}), self._white(model))
        self.models[frozenset(rest)] = smaller
        return smaller

    def compare(self, models: Sequence[Model], white: Whitener) -> list[Fitted]:
        """By the squares of what each leaves when fitted to residuals that a filter makes white, the best first."""
        return sorted((self._left(m, white) for m in models), key=lambda f: f.criterion)

    def _left(self, model: Model, white: Whitener) -> Fitted:
        key = frozenset(model.effects), id(white)
        if key not in self.compared:
            given, polished = sharpened(model, white)
            squares = squares_of(given, polished)
            samples = np.count_nonzero(given.problem.tape.weight)
            price = len(given.problem.parameters.names) * np.log(samples)
            self.compared[key] = Fitted(model, squares, squares + price, white)
        return self.compared[key]

    def _ended(self, model: Model) -> tuple[Prepared, Polished]:
        """The last fit of a model: to white residuals, unless that is far from reproducing the runs as they are, as
        where a formula is not quite nature's."""
        given, sharp = sharpened(model, self._white(model))
        as_it_is = polish(model.given.problem, sharp.refined, steps=0).refined.fitness
        plainly = settle(model.given, model.polished.refined)
        near = as_it_is < NEAR * plainly[1].refined.fitness
        return (given, sharp) if near else plainly

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
        key = frozenset(model.effects)
        if key not in self.filters:
            self.filters[key] = whitener([fit.residual for fit in rows_of(model)])
        return self.filters[key]

    def _without(self, chosen: Model, white: Whitener) -> dict[str, float]:
        chances = {}
        for effect in chosen.effects:
            rest = tuple(e for e in chosen.effects if e != effect)
            smaller = self.models.get(frozenset(rest)) or self._drop(chosen, rest)
            both = {f.model.effects: f.squares for f in self.compare([chosen, smaller], white)}
            gain = both[smaller.effects] - both[chosen.effects]
            chances[effect] = float(stats.chi2.sf(max(gain, 0.0), len(EFFECTS[effect].ranges)))
        return chances


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

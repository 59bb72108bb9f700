"""Motors with sets of effects, each fitted in full simulation and stored."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from ...effects import EFFECTS
from ...identify.fit.fitted_runs import FittedRuns
from ...identify.fit.gauss_newton import TRIAL_TOLERANCE
from ...identify.fit.generalised_least_squares import with_whitening
from ...identify.fit.polish import fit_at, polish
from ...identify.fit.refine import Optimum
from ...identify.fit.run_unknowns import best_backlash_start
from ...identify.fit.slow_torque import whitener_of
from ...identify.noise.noise_model import Whitener
from ...identify.prepare import Prepared
from ...identify.solve import POOR_FIT, Solved, search_and_refine
from ...identify.uncertainty.covariance import information_of
from ...identify.uncertainty.identifiability import moved_by
from ...progress import ReportProgress
from ...runtime.threads import map_in_threads, map_in_threads_until
from ..evidence.signals import Screen, Signal
from ..hypotheses.candidates import Scales
from ..hypotheses.effect_relations import FULLER, may_hold_rotor
from ..hypotheses.trials import TRIALS
from ..model import Model, model_of, refit_from
from .compare import Comparison
from .nearby import best_nearby
from .starts import Start, Starts, effects_with

# Share of the gain promised by the evidence that a refit must realise; otherwise it is fitted in another way
MIN_REALISED_SHARE = 0.5
# A plain fit that leaves less than this share of a filtered one's misfit replaces it
MAX_PLAIN_MISFIT = 0.5
# A new refit of a set replaces the stored one if its misfit is smaller by this share
MIN_IMPROVEMENT = 1e-3
# Gauss-Newton steps of a short refit, one of several from different starts
SHORT_REFIT_STEPS = 8
# ... two of which found the same optimum if their misfits differ by less than this factor
SAME_OPTIMUM_RATIO = 1.05
# Factor around the parameters of effects that may hold the rotor within which a population searches
STICKING_FACTOR = 2.0
# ... if a model leaves so many noise variances of each output; and what another optimum may leave of those beyond one
MIN_MISFIT_AROUND, MAX_REST_AROUND = 2.0, 0.9
# A fuller form whose short refits leave no less than this share of the simple form's misfit is searched no further
MAX_FULLER_MISFIT = 0.9

# Fits a model; None if physics forbids it
Refit = Callable[[], Model | None]


class Refits:
    """Fits models and keeps one for each set of effects."""

    def __init__(
        self, base: Model, solved: Solved, scales: Scales, comparison: Comparison, report: ReportProgress
    ) -> None:
        """`base` is the motor without effects, and `solved` how it was found; `scales` are those of the recordings."""
        self.starts, self.solved, self.report = Starts(scales), solved, report
        self.comparison = comparison
        self.models: dict[frozenset[str], Model] = {frozenset(): base}
        # pairs of a set and a model from which it has been refitted, or need not be
        self.refitted_from: set[tuple[frozenset[str], Model]] = set()

    def with_signals(self, current: Model, signals: Sequence[Signal], found: Screen) -> list[Model | None]:
        """The current model with the effect of each of some signals added, in parallel; None if physics forbids the
        coefficients found.

        A set that was fitted from another model and does not realise the promised gain is fitted again from this one.
        """
        # in this order, as the first start values of an effect are kept
        additions = [(signal, *self._addition(current, signal, found)) for signal in signals]
        self._report_trial(current, [effects for _, effects, _ in additions])

        def with_signal(addition: tuple[Signal, tuple[str, ...], Refit]) -> Model | None:
            signal, effects, refit = addition
            model, key = self._stored_or_fitted(effects, current, refit), frozenset(effects)
            if model is None or (key, current) in self.refitted_from:
                return model
            if self._realises_gain(model, current, signal, found.white):
                return model
            return self._stored_or_better(key, current, refit)

        return map_in_threads(with_signal, additions)

    def _addition(self, current: Model, signal: Signal, found: Screen) -> tuple[tuple[str, ...], Refit]:
        """The effects with that of a signal added, and what fits them."""
        effects = effects_with(current.effects, signal.effect)
        start = self.starts.from_signal(current, effects, signal, found)

        def refit() -> Model | None:
            if start is None:
                return None
            of_trial = self.starts.of_trial(current, effects)
            if of_trial:
                return self._best_of_starts(effects, [start, *of_trial], found.white)
            return self._refit_from_signal(start, current, signal, found.white)

        return effects, refit

    def with_replacements(
        self, current: Model, white: Whitener, replacements: Sequence[tuple[str, str]]
    ) -> list[Model | None]:
        """The current model with a new effect in place of an old one, for each of some pairs (old, new), in parallel.

        The new one is a fuller or a simpler form of the old one, an effect that resembles it, one with starts of its
        own, or one fitted before. Others have no values to start from.
        """
        # in this order, as the first start values of an effect are kept
        refits = [self._replacement(current, white, old, new) for old, new in replacements]
        self._report_trial(current, [effects for effects, _ in refits])
        return map_in_threads(lambda of: self._stored_or_fitted(of[0], current, of[1]), refits)

    def _replacement(self, current: Model, white: Whitener, old: str, new: str) -> tuple[tuple[str, ...], Refit]:
        """The effects with `new` in place of `old`, and what fits them if no fit is stored."""
        effects, starts, max_misfit = (*(e for e in current.effects if e != old), new), [], np.inf
        if frozenset(effects) not in self.models:
            starts = self.starts.of_trial(current, effects)
            if not starts:
                values = self.starts.values_from_replaced(current, old, new)
                starts = [self.starts.from_model(current, effects, values)]
            if old in FULLER and FULLER[old].effect == new:
                starts = [self.starts.from_simple_form(current, old, effects), *starts]
                max_misfit = MAX_FULLER_MISFIT * current.fit.fitness
        return effects, lambda: self._best_of_starts(effects, starts, white, max_misfit)

    def with_simple_form(self, current: Model, white: Whitener, effect: str, simple: str) -> Model | None:
        """The current model with a simpler form of one of its effects, fitted again from what the fuller form found if
        that beats a stored fit."""
        if simple not in FULLER or FULLER[simple].effect != effect:
            return self.with_replacements(current, white, [(effect, simple)])[0]
        effects = (*(e for e in current.effects if e != effect), simple)
        prepared, start = self.starts.from_fuller_form(current, simple, effects)
        self._report_trial(current, [effects])

        def refit() -> Model:
            return refit_from(prepared, start, white)

        simpler = self._stored_or_fitted(effects, current, refit)
        assert simpler is not None
        return self._or_again(simpler, current, start, refit)

    def with_global_search(self, current: Model, effect: str) -> Model:
        """The current model with one more effect, by a new global search; or the stored fit of the set, if better."""
        effects = (*current.effects, effect)
        self.report(f"searching with {_joined(effects)}", current.fit.fitness)

        def search() -> Model:
            prepared = current.prepared.with_effects(current.prepared.forms_of(effects))
            method, seed = self.solved.search.method, self.solved.seed
            return model_of(search_and_refine(prepared, method, seed, searches=1).fitted)

        if (key := frozenset(effects)) in self.models:
            return self._stored_or_better(key, current, search)
        model = self._stored_or_fitted(effects, current, search)
        assert model is not None
        return model

    def searched_around(self, model: Model) -> Model:
        """The model; or the same effects fitted from the best of a population around it, in their parameters that may
        hold the rotor at rest, if that leaves less: where a rotor sticks and slips, each moment at which it does is an
        optimum of its own."""
        sticking, noise = [e for e in model.effects if may_hold_rotor(e)], model.problem.perfect_fitness
        if not sticking or model.fit.fitness < MIN_MISFIT_AROUND * noise:
            return model
        factors = {f"{effect}.{field}": STICKING_FACTOR for effect in sticking for field in EFFECTS[effect].ranges}
        around = _best_around(model.prepared, model.fit.optimum, factors, self.solved.seed)
        elsewhere = FittedRuns.polished(model.prepared, around, TRIAL_TOLERANCE)
        if elsewhere.fit.fitness - noise > MAX_REST_AROUND * (model.fit.fitness - noise):
            return model
        return self.replace(model_of(elsewhere))

    def with_fuller_form_held(self, current: Model, white: Whitener, effect: str, give_up_above: float) -> Model:
        """The current model with a fuller form of an effect, whose extra parameters are held where they clearly act;
        `give_up_above`, as of `refit_from`."""
        fuller = FULLER[effect]
        effects = (*(e for e in current.effects if e != effect), fuller.effect)
        prepared, start = self.starts.from_simple_form(current, effect, effects)
        fixed = {f"{fuller.effect}.{field}" for field in fuller.extra}
        if "Kt" in _parameters_in_unseen_directions(current):
            # all torques could scale up with Kt, until the part that is held is negligible
            fixed.add("Kt")
        free = jnp.asarray([name not in fixed for name in prepared.problem.parameters.names])
        prepared = prepared.with_problem(free=free)
        return refit_from(prepared, start, white, give_up_above)

    def replace(self, model: Model) -> Model:
        """Store a model in place of the fit of its effects, and return it."""
        self.models[frozenset(model.effects)] = model
        return model

    def without(self, model: Model, effect: str, white: Whitener) -> Model:
        """The model without one of its effects."""
        return self.without_each(model, [effect], white)[0]

    def without_each(self, model: Model, effects: Sequence[str], white: Whitener) -> list[Model]:
        """The model without each of some of its effects, in parallel; fitted again if its parameters beat a stored
        fit."""
        rests = [tuple(e for e in model.effects if e != effect) for effect in effects]
        self._report_trial(model, rests)
        if any(frozenset(rest) not in self.models for rest in rests):
            self.comparison.fitted(model, white)  # once, before each thread asks for it
        return map_in_threads(lambda rest: self._reduced_to(model, rest, white), rests)

    def _reduced_to(self, model: Model, rest: tuple[str, ...], white: Whitener) -> Model:
        """The model with only a rest of its effects."""
        prepared, start = self.starts.from_model(model, rest, {})

        def refit() -> Model:
            largest = self.comparison.largest_squares(prepared, model, white)
            return refit_from(prepared, start, white, largest)

        smaller = self._stored_or_fitted(rest, model, refit)
        assert smaller is not None
        return self._or_again(smaller, model, start, refit)

    def _or_again(self, stored: Model, current: Model, start: Optimum, refit: Refit) -> Model:
        """A stored fit; or the better of it and a new one from the current model, if that starts better."""
        key = frozenset(stored.effects)
        if (key, current) in self.refitted_from:
            return stored
        self.refitted_from.add((key, current))
        at_start = fit_at(stored.problem, start).fitness
        if at_start < (1 - MIN_IMPROVEMENT) * stored.fit.fitness:
            return self._stored_or_better(key, current, refit)
        return stored

    def _stored_or_fitted(self, effects: Sequence[str], current: Model, refit: Refit) -> Model | None:
        """The stored fit of a set; if there is none, a new one from the current model, which is then stored."""
        key = frozenset(effects)
        if key not in self.models:
            model = self._fitted(key, current, refit)
            if model is None:
                return None
            self.models[key] = model
        return self.models[key]

    def _stored_or_better(self, key: frozenset[str], current: Model, refit: Refit) -> Model:
        """The better of the stored fit of a set and a new one from the current model, which is then stored."""
        again = self._fitted(key, current, refit)
        if again and again.fit.fitness < (1 - MIN_IMPROVEMENT) * self.models[key].fit.fitness:
            self.models[key] = again
        return self.models[key]

    def _fitted(self, key: frozenset[str], current: Model, refit: Refit) -> Model | None:
        """A new fit of a set from the current model, recorded in `refitted_from`."""
        self.refitted_from.add((key, current))
        return refit()

    def _report_trial(self, current: Model, sets: Sequence[tuple[str, ...]]) -> None:
        """Report which sets are fitted now; not in another thread, where nobody may expect to be called."""
        new = [_joined(effects) for effects in sets if frozenset(effects) not in self.models]
        if new:
            self.report(f"trying {', '.join(new)}", current.fit.fitness)

    def _realises_gain(self, model: Model, current: Model, signal: Signal, white: Whitener) -> bool:
        """Whether a refit realises more than `MIN_REALISED_SHARE` of the gain that the evidence promised."""
        before, after = (self.comparison.fitted(m, white).squares for m in (current, model))
        return bool(before - after > MIN_REALISED_SHARE * signal.gain)

    def _refit_from_signal(self, start: Start, current: Model, signal: Signal, white: Whitener) -> Model:
        """A refit from where the evidence points; if that does not realise the promised gain, plain least squares, too.

        The plain fit is returned if it leaves far less unfiltered misfit: the filter had taken the missing effect for
        noise. Otherwise a second filtered refit starts from it, and the better of the two filtered ones is returned.
        """
        prepared, point = start
        model = refit_from(prepared, point, white)
        if self._realises_gain(model, current, signal, white):
            return model
        plain = polish(prepared.problem, point, tolerance=TRIAL_TOLERANCE)
        if plain.fitness < MAX_PLAIN_MISFIT * model.fit.fitness:
            return model_of(FittedRuns(prepared, plain))
        from_plain = refit_from(prepared, plain.optimum, white)
        return min((model, from_plain), key=lambda m: self.comparison.fitted(m, white).squares)

    def _best_of_starts(
        self, effects: tuple[str, ...], starts: Sequence[Start], white: Whitener, max_misfit: float = np.inf
    ) -> Model:
        """The best refit from several starts of the last effect: the best of short refits, refitted in full.

        With `Trial.factors`, populations search around each start first; and around the end, if the best short refit
        has a misfit below `max_misfit`.
        """
        seed, prepared, runs = self.solved.seed, starts[0].prepared, starts[0].point.unknowns.runs
        factors = {f"{effects[-1]}.{f}": x for f, x in TRIALS[effects[-1]].factors.items()}
        if factors:
            starts = [Start(prepared, _best_around(prepared, s.point, factors, seed)) for s in starts]
        best = _best_short_refit(starts)
        start = best._replace(unknowns=best_backlash_start(prepared.problem, best.unknowns, runs))
        if factors and best.fitness < max_misfit:
            return _refit_with_population(prepared, start, factors, seed)
        return refit_from(prepared, start, white)


def _joined(effects: Sequence[str]) -> str:
    return " + ".join(sorted(effects))


def _best_short_refit(starts: Sequence[Start]) -> Optimum:
    """The best of short refits, made until the best reaches the noise (`POOR_FIT`) or another found the same optimum
    (`SAME_OPTIMUM_RATIO`)."""
    noise = POOR_FIT * starts[0].prepared.problem.perfect_fitness

    def is_enough(ends: list[Optimum]) -> bool:
        least, *others = sorted(end.fitness for end in ends)
        return bool(least < noise or (others and others[0] < SAME_OPTIMUM_RATIO * least))

    ends = map_in_threads_until(_short_refit, starts, is_enough)
    return min(ends, key=lambda end: end.fitness)


def _short_refit(start: Start) -> Optimum:
    """A refit of a few steps; its misfit is infinite where it cannot be simulated."""
    return polish(start.prepared.problem, start.point, SHORT_REFIT_STEPS).optimum


def _refit_with_population(prepared: Prepared, start: Optimum, factors: Mapping[str, float], seed: int) -> Model:
    """A refit; or a second one from the best of a population around where the first ended, if that point is better and
    so is the refit, by the whitening filter of the residuals at the start."""
    white = whitener_of(prepared, fit_at(prepared.problem, start))
    whitened = with_whitening(prepared, white).problem

    def whitened_misfit(model: Model) -> float:
        return fit_at(whitened, model.fit.optimum).fitness

    model = refit_from(prepared, start, white)
    nearer = {name: np.sqrt(factor) for name, factor in factors.items()}
    elsewhere = _best_around(prepared, model.fit.optimum, nearer, seed)
    if elsewhere.fitness >= model.fit.fitness:
        return model
    return min((model, refit_from(prepared, elsewhere, white)), key=whitened_misfit)


def _best_around(prepared: Prepared, start: Optimum, factors: Mapping[str, float], seed: int) -> Optimum:
    """The best point of a population search around a start; `factors` as in `best_nearby`."""
    fit = fit_at(prepared.problem, start)
    return best_nearby(prepared.problem, fit, factors, seed)


def _parameters_in_unseen_directions(model: Model) -> set[str]:
    """The parameters with a part in any direction that the runs do not determine."""
    problem = model.problem
    unseen = information_of(problem, model.fit).unseen
    return {name for d in unseen for name in moved_by(d, problem.parameters)}

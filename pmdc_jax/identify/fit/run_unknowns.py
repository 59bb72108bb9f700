"""Fitting what belongs to each run: its initial state, and its load where that is unknown."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...runtime.threads import map_in_threads
from ...simulate import RunUnknowns
from ..problem import Evaluation, Problem, Unknowns, evaluate, normal_matrix, scaled, select_blocks, unflatten
from .gauss_newton import TOLERANCE, gauss_newton_step, ridge_of, squares_of_runs
from .polish import Fit

# Initial twists tried for a run, as shares of the gear's backlash, from where the load presses the teeth
BACKLASH_STARTS = np.linspace(-1.0, 1.0, 9)
# Initial rotor angles tried per period of an angle-dependent torque (the shortest one), and at most
ANGLES_PER_PERIOD, MAX_ANGLES = 8, 32


def best_backlash_start(problem: Problem, unknowns: Unknowns, start: RunUnknowns) -> Unknowns:
    """Each run's own unknowns as they are, or `start` with the teeth of its gear elsewhere within the backlash,
    whichever fits the run best.

    No gradient leads there: the moment at which the teeth first meet changes all that follows, and a run that begins
    at rest may be fitted as well as possible by an initial speed that it never had.
    """
    motor = problem.parameters(unknowns.coordinates)
    play = sum(float(effect.play()) for effect in motor.effects)
    middle = jnp.zeros_like(start.twist)
    trials = [start._replace(twist=middle + share * play) for share in BACKLASH_STARTS if play]
    return _best_run_unknowns(problem, unknowns, trials)


def best_initial_angle(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Each hold-out run's own unknowns as they are, or with another initial angle of the rotor, whichever fits best.

    With several angle-dependent torques, angles within the longest period are tried first, then shifts by whole
    periods of each. From half a period away the gradient leads to another optimum, or nowhere.
    """
    waves = [e.repeats_after() for e in problem.parameters(unknowns.coordinates).effects]
    periods = [float(wave["angle"]) for wave in waves if "angle" in wave]
    turnable = np.asarray(problem.angle_unknown & ~jnp.asarray(problem.fitted_runs))
    if not periods or not turnable.any():
        return unknowns
    count = min(round(ANGLES_PER_PERIOD * max(periods) / min(periods)), MAX_ANGLES)
    turns = [np.arange(1, count) / count * max(periods)]
    if len(periods) > 1:
        turns += [np.arange(1, round(2 * np.pi / period)) * period for period in periods]
    for some in turns:
        own = unknowns.runs
        trials = [own._replace(angle=own.angle + turn * turnable) for turn in some]
        unknowns = _best_run_unknowns(problem, unknowns, trials)
    return unknowns


def _best_run_unknowns(problem: Problem, unknowns: Unknowns, trials: Sequence[RunUnknowns]) -> Unknowns:
    """Each run's own unknowns as they are, or those of the trial that fits it best."""
    if not trials:
        return unknowns
    tried = [unknowns.runs, *trials]

    def squares(runs: RunUnknowns) -> Float[np.ndarray, " runs"]:
        return squares_of_runs(problem, evaluate(problem, unknowns._replace(runs=runs)))

    best, each = np.argmin(map_in_threads(squares, tried), axis=0), np.arange(problem.tape.runs)
    runs = jax.tree.map(lambda *values: jnp.stack(values)[best, each], *tried)
    return unknowns._replace(runs=runs)


def fit_run_unknowns(problem: Problem, unknowns: Unknowns, passes: int = 4) -> tuple[Unknowns, Evaluation]:
    """Fit only what belongs to each run: its initial state, and its load where that is unknown.

    A step that makes a run worse, because the teeth of a gear meet at another time for example, is shortened for that
    run.
    """
    fixed = eqx.tree_at(lambda p: p.free, problem, jnp.zeros_like(problem.free))
    run = np.asarray(problem.tape.run)
    everyone, share = jnp.ones(problem.tape.runs, bool), np.ones(problem.tape.runs)

    unknowns = best_initial_angle(fixed, best_backlash_start(fixed, unknowns, unknowns.runs))
    best, ridge = evaluate(fixed, unknowns), ridge_of(problem)
    for _ in range(passes):
        matrix = np.asarray(normal_matrix(best, fixed.tape, everyone))
        flat, gain = gauss_newton_step(matrix, set(), ridge)
        if gain < TOLERANCE * matrix[-1, -1] / problem.most_samples:
            break
        step = unflatten(problem, jnp.asarray(flat)).runs
        changes = zip(unknowns.runs, step, strict=True)
        trial = RunUnknowns(*(x + share * change for x, change in changes))
        reached = evaluate(fixed, unknowns._replace(runs=trial))
        # false where the trial cannot be simulated
        better = squares_of_runs(problem, reached) <= squares_of_runs(problem, best)
        share = np.where(better, 1.0, share / 4)
        unknowns = unknowns._replace(runs=_select_runs(jnp.asarray(better), trial, unknowns.runs))
        best = select_blocks(jnp.asarray(better[run]), reached, best)
    return unknowns, best


def with_holdout_unknowns(problem: Problem, fit: Fit) -> Fit:
    """The fit with the own unknowns of the hold-out runs fitted too, if the load of any of them is unknown."""
    if not np.any(~np.asarray(problem.fitted_runs) & np.asarray(problem.tape.load_unknown)):
        return fit
    unknowns, evaluation = fit_run_unknowns(problem, fit.unknowns)
    runs = _select_runs(problem.fitted_runs, fit.unknowns.runs, unknowns.runs)
    optimum = fit.optimum._replace(unknowns=unknowns._replace(runs=runs))
    weighted = scaled(evaluation, np.asarray(problem.noise) / fit.noise)
    fitted = jnp.asarray(problem.fitted_blocks)
    return fit._replace(optimum=optimum, evaluation=select_blocks(fitted, fit.evaluation, weighted))


def _select_runs(chosen: Bool[Array, " runs"], one: RunUnknowns, other: RunUnknowns) -> RunUnknowns:
    """The unknowns of `one` for the chosen runs, those of `other` for the rest."""
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), one, other)

"""Results of an identification: estimates, intervals and the fit of every run."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..recordings.recording import SIMULATED_OUTPUTS
from ..words import enumerate_words
from .equivalent_fits import fits_with_visible, released_from_bounds, with_Kt_equal_Kb
from .estimates import estimates_of
from .fit.run_unknowns import fit_run_unknowns
from .identification import Direction, Identification
from .messages import messages_of
from .noise.sensor_noise import white_noise
from .prepare import Prepared
from .run_fits import large_residuals, measured_and_residuals, run_fits
from .solve import Solved
from .uncertainty.covariance import information_of
from .uncertainty.identifiability import explain_directions


def results_of(solved: Solved) -> Identification:
    """The result of a fit: estimates with uncertainty and status, and the fit of every run."""
    prepared, found = solved.fitted
    problem, training = prepared.problem, prepared.training
    released = released_from_bounds(problem, found)
    parameters = problem.parameters
    info = information_of(problem, released)
    chosen = with_Kt_equal_Kb(problem, released, info)
    others = [information_of(problem, fit) for fit in fits_with_visible(problem, chosen, info)]
    # what any fit as good does not determine is not determined
    info = max([info, *others], key=lambda i: i.unseen_share.sum())
    best = chosen.optimum
    motor = jax.tree.map(np.asarray, parameters(best.unknowns.coordinates))
    problem = eqx.tree_at(lambda p: p.noise, problem, jnp.asarray(chosen.noise))

    unknowns, ended = fit_run_unknowns(problem, best.unknowns)
    fit = run_fits(prepared.runs, prepared.roles, problem.tape, np.asarray(ended.simulated), unknowns.runs)
    names, covariance = parameters.with_tied(info.covariance)
    noise = {
        name: white_noise([residual for _, residual in measured_and_residuals(fit, name)]) for name in SIMULATED_OUTPUTS
    }
    return Identification(
        motor=motor,
        parameters=estimates_of(problem, best, info, prepared),
        unidentified_directions=(*_without_effect(prepared), *explain_directions(info.unseen, parameters, training)),
        fit=fit,
        noise={"current_A": noise["current"], "speed_rad_s": noise["speed"]},
        distance=best.distance,
        seed=solved.seed,
        seconds=solved.seconds,
        search=solved.search,
        findings=prepared.findings,
        covariance=covariance,
        covariance_names=names,
        messages=messages_of(prepared, solved.search, motor, fit, Kt_set_to_Kb=chosen is not released),
        missed=large_residuals(fit),
    )


def _without_effect(prepared: Prepared) -> list[Direction]:
    """The parameters that affect no run, as of the electrical half where only a torque is recorded."""
    names = tuple(name for name in prepared.irrelevant if name not in prepared.known)
    if not names:
        return []
    lacking = "a voltage" if {"R", "L"} & set(names) else "a turning rotor"
    why = f"No run has {lacking}, so {enumerate_words(names)} affect none of them"
    return [Direction(names, why, "Add a run with a voltage, a current and a speed")]

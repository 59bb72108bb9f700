"""Fits as good as the best one: where the runs leave a direction open, a report should not depend on where in it the
search ended."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .fit.polish import Fit, fit_at, polish
from .parameters import Parameters
from .problem import Problem, Unknowns
from .solve import FITNESS_TOLERANCE
from .uncertainty.covariance import Information, information_of
from .uncertainty.identifiability import MIN_SHARE, sees_torque_scale

# A parameter is unseen by itself if at least this share of it lies in unseen directions
MIN_UNSEEN_SHARE = 0.99
# A refit makes a parameter visible: it then changes the outputs by this share of what the most sensitive one does
VISIBLE_SHARE = 0.3


def released_from_bounds(problem: Problem, polished: Fit) -> Fit:
    """The fit with those coordinates released from their bound that an unseen direction of several parameters leaves
    arbitrary."""

    def released(fixed: Sequence[int]) -> Fit:
        return polished._replace(optimum=polished.optimum._replace(at_bound=tuple(fixed)))

    bound = polished.at_bound
    unseen = information_of(problem, released(())).unseen if bound else ()
    several = [d for d in unseen if np.max(np.abs(d)) <= MIN_UNSEEN_SHARE]
    return released([k for k in bound if all(abs(d[k]) <= MIN_SHARE for d in several)])


def with_Kt_equal_Kb(problem: Problem, polished: Fit, info: Information) -> Fit:
    """The fit with all torques scaled so that Kt = Kb, which are equal in SI, where the runs do not show that scale."""
    parameters, unknowns = problem.parameters, polished.unknowns
    if sees_torque_scale(info.unseen, parameters.names):
        return polished
    coordinates = np.asarray(polished.coordinates)
    factor = parameters.value("Kb", coordinates) / parameters.value("Kt", coordinates)
    runs = unknowns.runs
    scaled = unknowns._replace(
        coordinates=jnp.asarray(parameters.with_torques_scaled(coordinates, factor)),
        runs=runs._replace(load_offset=runs.load_offset * factor),
    )
    # with Kt fixed, as along the unseen direction no refinement ends
    Kt = parameters.names.index("Kt")
    return _as_good_with_fixed(problem, polished, Kt, scaled) or polished


def fits_with_visible(problem: Problem, polished: Fit, info: Information) -> list[Fit]:
    """Equally good fits, in each of which one parameter is visible that is not in the fit found."""
    invisible = _invisible_alone(problem.parameters, info)
    refits = [_refit_with_visible(problem, polished, k) for k in invisible]
    return [fit for fit in refits if fit is not None]


def _invisible_alone(parameters: Parameters, info: Information) -> list[int]:
    """Positive parameters that change nothing by themselves, because they are nearly zero for example."""
    return [int(k) for k in np.flatnonzero(info.unseen_share > MIN_UNSEEN_SHARE) if parameters.logarithmic[k]]


def _refit_with_visible(problem: Problem, polished: Fit, k: int) -> Fit | None:
    """An equally good fit in which parameter `k` is large enough to be visible, None if there is no such fit. Only
    there do the derivatives show which parameters it trades off against.

    Where only voltage and speed are measured, friction may be zero and Kb alone decides the speed per volt, or friction
    takes part of the voltage and Kb is smaller.
    """
    jacobian = np.asarray(polished.evaluation.jacobian)[problem.fitted_blocks]
    lengths = np.sqrt(np.square(jacobian[..., : len(problem.free)]).sum((0, 1, 2)))
    coordinates = np.array(polished.coordinates)
    coordinates[k] += np.log(VISIBLE_SHARE * lengths.max() / max(lengths[k], 1e-300))
    coordinates[k] = np.clip(coordinates[k], problem.parameters.lower[k], problem.parameters.upper[k])
    unknowns = polished.unknowns._replace(coordinates=jnp.asarray(coordinates))
    refitted = _as_good_with_fixed(problem, polished, k, unknowns)
    return fit_at(problem, refitted.optimum._replace(at_bound=())) if refitted else None


def _as_good_with_fixed(problem: Problem, polished: Fit, k: int, start: Unknowns) -> Fit | None:
    """The fit from other unknowns with coordinate `k` fixed as there; None if it is worse than the one before."""
    with_k_fixed = eqx.tree_at(lambda p: p.free, problem, problem.free.at[k].set(False))
    refitted = polish(with_k_fixed, polished.optimum._replace(unknowns=start))
    # false where the simulation failed: its fitness is infinite
    as_good = refitted.fitness <= polished.fitness * (1 + FITNESS_TOLERANCE)
    return refitted if as_good else None

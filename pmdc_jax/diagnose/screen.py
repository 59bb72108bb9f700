"""The evidence against a fitted motor: a score test of its white residuals for everything that may be missing."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from ..identify.noise_model import Series, Whitener, scaling_whitener, whitener
from ..simulate import UNKNOWNS_PER_RUN
from .evidence import Evidence, blocks_of, products
from .library import Curve, Library, curves_over
from .model import Model
from .quantisation import READINGS
from .rows import Rows, gathered
from .signals import Screen, Signal, signals


def screen(model: Model, library: Library) -> Screen:
    """Gather the evidence against a model.

    The whitening filter is fitted to what the clearest candidate or curve leaves of the residuals. One fitted to the
    residuals themselves would take what is missing for noise, a constant offset above all, and hide it.
    """
    tape, path = model.given.problem.tape, model.path
    curves, of_curves = curves_over(library, tape, path)
    parameters = model.given.problem.free.shape[0]
    orders = [(c.order, c.own_phase) for c in library.candidates]
    orders += [(c.order, c.own) for c in curves]
    blocks, count = blocks_of(orders, parameters), sum(order for order, _ in orders)
    changes = chain(library.changes(tape, path), of_curves)
    rows = gathered(model, library.bare, path, changes, count)
    as_they_are = scaling_whitener([run.fit.residual for run in rows])
    unfiltered = _evidence(rows, as_they_are)
    found = Screen(
        evidence=unfiltered,
        white=as_they_are,
        unfiltered=unfiltered,
        candidates=library.candidates,
        of_candidate=blocks[: len(library.candidates)],
        curves=curves,
        of_curve=blocks[len(library.candidates) :],
        dry=model.dry,
        traces=library.traces,
    )
    white = whitener(_without_clearest(found, rows))
    return found._replace(evidence=_evidence(rows, white), white=white)


def beyond_curves(found: Screen) -> float:
    """Share of a model's unfiltered squared residuals that remains after all curves shared by the runs."""
    shared = [block for block in found.of_curve if not block.own]
    return found.unfiltered.regress(shared).squares / found.unfiltered.regress().squares


def _evidence(rows: Sequence[Rows], whiten: Whitener) -> Evidence:
    """The evidence from all rows, whitened by one filter."""
    white = (run.white(k, whiten) for k, run in enumerate(rows))
    return products(white, rows[0].fit.shared.values.shape[-1], UNKNOWNS_PER_RUN, READINGS)


def _is_definite(curve: Signal) -> bool:
    """Whether a curve is too definite for noise to look like it: one that all runs share, or one of a sensor."""
    assert isinstance(curve.of, Curve)
    return not curve.of.own or curve.of.is_misread


def _without_clearest(found: Screen, rows: Sequence[Rows]) -> list[Series]:
    """The residuals of each run less the most significant candidate or shared curve, and all that is fitted with it."""
    of_candidates, of_curves = signals(found)
    clearest = min(
        (s for s in (*of_candidates, *of_curves) if s.candidate or _is_definite(s)),
        key=lambda s: s.log_p,
    ).block
    best = found.evidence.regress([clearest])
    columns = np.array(clearest.columns) - found.evidence.parameters
    left = []
    for k, (fit, X, _) in enumerate(rows):
        coefficients = best.coefficients[0][k] if clearest.own else best.coefficients[0]
        known = fit.residual.known
        rest = fit.residual.values - fit.shared.values @ best.moved
        rest = rest - X[..., columns] @ coefficients
        own = fit.own.values
        local = np.linalg.lstsq(own[known].reshape(-1, own.shape[-1]), rest[known].ravel())[0]
        left.append(fit.residual._replace(values=rest - own @ local))
    return left

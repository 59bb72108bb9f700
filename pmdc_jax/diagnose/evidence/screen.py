"""The evidence against a fitted motor: a score test of its white residuals for everything that may be missing."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from operator import attrgetter
from typing import NamedTuple

from ...identify.fit.run_series import RunSeries
from ...identify.fit.slow_torque import whitener_of_runs
from ...identify.noise.noise_model import Whitener, scaling_whitener
from ...simulate import UNKNOWNS_PER_RUN
from ..hypotheses.curves import Curve, curves_along
from ..hypotheses.library import Library
from ..model import Model
from .moments import log_p_of_strongest
from .quantisation import ROUNDING_DRAWS
from .regression import Block, Evidence, consecutive_blocks, gather_evidence
from .rows import TIMING_ERRORS, Rows, gather_rows
from .signals import Screen, Signal, signals

# Samples of an uneven clock are simulated only approximately: what explains a smaller share of their whitened squares
# is no evidence
UNEVEN_SHARE = 0.005


class Findings(NamedTuple):
    """The evidence against a model, and what stands out in it."""

    screen: Screen
    candidate_signals: list[Signal]  # the most significant first
    curve_signals: list[Signal]  # the most significant first
    log_p: float  # natural logarithm of the p-value of the strongest of them


def screen(model: Model, library: Library) -> Findings:
    """Gather the evidence against a model.

    The whitening filter is fitted to what the clearest candidate or curve leaves of the residuals. One fitted to the
    residuals themselves would absorb what is missing as noise, above all a constant offset, and hide it.
    """
    tape, trajectory = model.problem.tape, model.trajectory
    curves, changes_of_curves = curves_along(library, tape, trajectory)
    widths = [(c.width, c.own_phase) for c in library.candidates]
    widths += [(c.width, c.per_run) for c in curves]
    count = sum(width for width, _ in widths)
    changes = chain(library.changes(tape, trajectory), changes_of_curves)
    rows = gather_rows(model, library.bare, trajectory, changes, count)
    scaling = scaling_whitener([run.fit.residual for run in rows])
    unfiltered = _evidence(rows, scaling)
    blocks = consecutive_blocks(widths, unfiltered.first_column)
    plain = Screen(
        evidence=unfiltered,
        white=scaling,
        unfiltered=unfiltered,
        candidates=library.candidates,
        candidate_blocks=blocks[: len(library.candidates)],
        curves=curves,
        curve_blocks=blocks[len(library.candidates) :],
        coulomb_torque=model.coulomb_torque,
        sensor_floors=library.sensor_floors,
    )
    white = whitener_of_runs(model.prepared, library.bare, _without_clearest(plain, rows))
    evidence = _evidence(rows, white)
    is_uneven = not all(run.has_even_clock for run in model.prepared.training)
    least_gain = UNEVEN_SHARE * evidence.regress().squares if is_uneven else 0.0
    found = plain._replace(evidence=evidence, white=white, least_gain=least_gain)
    candidate_signals, curve_signals = signals(found)
    log_p = log_p_of_strongest([*candidate_signals, *curve_signals], rows, white, evidence)
    return Findings(found, candidate_signals, curve_signals, log_p)


def share_beyond(plain: Screen, blocks: Sequence[Block]) -> float:
    """Share of a model's unfiltered squared residuals that remains after some blocks."""
    return plain.unfiltered.regress(blocks).squares / plain.unfiltered.regress().squares


def _evidence(rows: Sequence[Rows], whiten: Whitener) -> Evidence:
    """The evidence from all rows, whitened by one filter."""
    filtered = (run.filtered(k, whiten) for k, run in enumerate(rows))
    return gather_evidence(
        filtered,
        parameters=rows[0].fit.shared.values.shape[-1],
        run_unknowns=UNKNOWNS_PER_RUN,
        timing_errors=TIMING_ERRORS,
        rounding_errors=ROUNDING_DRAWS,
        slow=0 if whiten.slow is None else whiten.slow[0].shape[-1],
    )


def _is_definite(curve: Signal) -> bool:
    """Whether noise can hardly look like a curve: one that all runs share, or an error of a sensor."""
    assert isinstance(curve.term, Curve)
    return not curve.term.per_run or curve.term.is_sensor_error


def _without_clearest(plain: Screen, rows: Sequence[Rows]) -> list[RunSeries]:
    """The fit of each run, its residuals less the most significant candidate or shared curve, and all that is fitted
    with it."""
    candidate_signals, curve_signals = signals(plain)
    clearest = min(
        (s for s in (*candidate_signals, *curve_signals) if s.candidate or _is_definite(s)), key=attrgetter("log_p")
    ).block
    best = plain.evidence.regress([clearest])
    # late readings are noise, and stay
    rests = (run.without(k, best, clearest, plain.evidence.first_column) for k, run in enumerate(rows))
    return [run.fit._replace(residual=run.fit.without_own(rest)) for run, rest in zip(rows, rests, strict=True)]

"""The evidence against a fitted motor: a score test of its white residuals for everything that may be missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from ..effects import EFFECTS
from ..identify.noise_model import Series, Whitener, scaling_whitener, whitener
from ..simulate import LOCAL
from .candidates import Candidate
from .effect_relations import unbalances
from .evidence import Block, Evidence, blocks_of, products
from .library import Curve, Library, curves_over
from .model import Model
from .quantisation import READINGS
from .rows import Rows, gathered

# Factor by which slow noise may be stronger at the slowest waves than at most of them
SLOWEST_WAVES = 1.5
# Factor by which torque noise over the few knots of a curve over time may be stronger than the whitening filter makes
# it, for a correlation time of 0.2 s in runs of some seconds
SLOWER = 4.0
# Standard errors by which a value clearly differs from zero
CLEARLY = 3.0
# Largest gain per degree of freedom of a drifting torque in white noise, at some forty degrees of freedom
BY_CHANCE = 1.25


class Screen(NamedTuple):
    """The evidence against a model, and which of its columns belong to what."""

    evidence: Evidence  # whitened
    white: Whitener
    unfiltered: Evidence  # the same, only scaled by the noise of each run
    candidates: list[Candidate]
    of_candidate: list[Block]
    curves: list[Curve]
    of_curve: list[Block]
    dry: float  # Coulomb friction in the model, N m
    traces: Mapping[str, float]  # by unit: the amplitude that imperfect sensors alone may produce

    def possible(self, candidate: Candidate, coefficients: np.ndarray) -> bool:
        """Whether physics allows these coefficients, and the amplitude is not one that sensors may produce."""
        if candidate.own_phase:
            return True
        amplitude = abs(coefficients[-1]) * candidate.unit
        physical = candidate.build(coefficients, self.dry) is not None
        return physical and bool(amplitude >= self.hidden(candidate))

    def hidden(self, candidate: Candidate) -> float:
        """The amplitude, in SI units, below which imperfect sensors alone may produce a candidate."""
        field = candidate.amplitude
        unit = EFFECTS[candidate.effect].ranges[field].unit if field else ""
        return self.traces.get(unit, 0.0)


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


class Signal(NamedTuple):
    """One block of the evidence, regressed alone: how much it improves the fit."""

    gain: float  # decrease of the squared white residuals
    log_p: float  # natural logarithm of the p-value of such a gain by noise
    of: Candidate | Curve
    block: Block

    @property
    def candidate(self) -> Candidate | None:
        """The candidate, if it is one."""
        return self.of if isinstance(self.of, Candidate) else None


def signals(found: Screen) -> tuple[list[Signal], list[Signal]]:
    """The signals of all possible candidates, and those of all curves; each list the most significant first."""
    base = found.evidence.regress().squares
    # unfiltered residuals drift everywhere: no correction for slow noise
    white = found.evidence is not found.unfiltered
    drift, waver = (_drift(found), _waver(found)) if white else (None, None)

    def signal(of: Candidate | Curve, block: Block, gain: float, common: float = 0.0) -> Signal:
        noise = found.evidence.gained_by_rounding(block)
        if drift is not None and _is_slow_torque(of):
            noise = max(noise, _beside(found, block, drift))
        if waver is not None and _is_voltage(of):
            noise = max(noise, _beside(found, block, waver))
        chance = log_chance(max(gain - common, 0.0) / noise, found.evidence.freedom(block))
        return Signal(gain, chance, of, block)

    pairs = zip(found.curves, found.of_curve, strict=True)
    gains = np.array([_gain_of_curve(found, curve, block) for curve, block in pairs])
    misread = [(c.periods, g) for c, g in zip(found.curves, gains, strict=True) if c.is_misread]
    possible = []
    for candidate, block in zip(found.candidates, found.of_candidate, strict=True):
        fit = found.evidence.regress([block])
        gain = max(base - fit.squares, 0.0)
        # a reading that swings as often, and explains more beside it, only looks like it
        imitated = any(g > gain and _swings(candidate, periods) for periods, g in misread)
        if not imitated and found.possible(candidate, fit.coefficients[0]):
            possible.append((candidate, block, gain))
    common = common_to_waves(found.evidence, possible)
    of_candidates = [signal(c, b, gain, common.get(c.effect, 0.0)) for c, b, gain in possible]
    for equation in ("mechanical", "sensor"):
        waves = [k for k, c in enumerate(found.curves) if c.is_wave and c.equation == equation]
        if waves:
            gains[waves] /= _dispersion(found, gains[waves], found.of_curve[waves[0]])
    for k, curve in enumerate(found.curves):
        if drift is not None and curve.reverses:
            # a slowly fluctuating torque is noise; a changing friction, which reverses with the motion, is not
            gains[k] = _left(found, drift) - _left(found, drift, found.of_curve[k])
        elif found.of_curve[k] is drift:
            gains[k] /= SLOWER
        elif curve.noise or _is_trace(found, curve, found.of_curve[k]):
            gains[k] = 0.0
    of_curves = [signal(*one) for one in zip(found.curves, found.of_curve, gains, strict=True)]
    return sorted(of_candidates, key=_log_p), sorted(of_curves, key=_log_p)


def _gain_of_curve(found: Screen, curve: Curve, block: Block) -> float:
    """The gain of a curve; of a swinging speed reading beside the torques that swing as often, for at an even speed
    these look like it."""
    beside = []
    if curve.is_misread:
        pairs = zip(found.candidates, found.of_candidate, strict=True)
        beside = [rival for candidate, rival in pairs if _swings(candidate, curve.periods)]
    return max(_left(found, *beside) - _left(found, *beside, block), 0.0)


def _swings(candidate: Candidate, periods: float) -> bool:
    """Whether a candidate swings with the angle, so many times a turn."""
    return candidate.own_phase and bool(np.isclose(candidate.columns[0]["periods"], periods))


def _is_trace(found: Screen, curve: Curve, block: Block) -> bool:
    """Whether a curve in volts is nowhere clearly larger than what imperfect sensors may produce."""
    trace = found.traces["V"]
    if not trace or not _is_voltage(curve):
        return False
    fit = found.evidence.regress([block], visible=1e-3)
    runs = zip(np.atleast_2d(fit.coefficients[0]), np.atleast_2d(fit.errors[0]), strict=True)
    beyond = [np.abs(curve.values(c)) - CLEARLY * curve.errors(e) for c, e in runs]
    return bool(np.max(beyond) < trace)


def _left(found: Screen, *blocks: Block) -> float:
    """The squares left by a regression on some blocks together."""
    return found.evidence.regress(blocks).squares


def _drift(found: Screen) -> Block | None:
    """The block of a torque that drifts over time, in every run in its own way; None if there is no such curve."""
    for curve, block in zip(found.curves, found.of_curve, strict=True):
        if (curve.equation, curve.variable, curve.reverses) == ("mechanical", "time", False):
            return block
    return None


def _waver(found: Screen) -> Block | None:
    """The block of a voltage that fluctuates over time, in every run in its own way; None unless known to be noise."""
    pairs = zip(found.curves, found.of_curve, strict=True)
    return next((block for curve, block in pairs if curve.noise), None)


def _is_voltage(of: Candidate | Curve) -> bool:
    """Whether something acts as a voltage: what is left of the noise of the recorded voltage may look like it."""
    equation = EFFECTS[of.effect].equation if isinstance(of, Candidate) else of.equation
    return unbalances(equation) == "electrical"


def _is_slow_torque(of: Candidate | Curve) -> bool:
    """Whether something is a torque that changes no faster than the motion: slow torque noise may look like it."""
    if isinstance(of, Candidate):
        effect = EFFECTS[of.effect]
        return effect.equation == "mechanical" and not effect.states
    return of.equation == "mechanical" and of.variable in ("speed", "current")


def _beside(found: Screen, block: Block, drift: Block) -> float:
    """Overdispersion beside a block: what a drifting torque or voltage gains when added to it, per degree of freedom
    and over what it gains by chance; at least 1.

    The whitening filter leaves weak fluctuations of some tenths of a second, hidden below the noise of the sensors, and
    the block takes its share of them.
    """
    rest = _left(found, block) - _left(found, block, drift)
    return max(rest / found.evidence.freedom(drift) / BY_CHANCE, 1.0)


def _dispersion(found: Screen, gains: np.ndarray, wave: Block) -> float:
    """Overdispersion of the waves' gains: they are slow, and the whitening filter leaves some slow noise.

    From the lower quartile of the gains, because in short runs a real wave shows in many of its neighbours.
    """
    level = float(np.quantile(gains, 0.25) / stats.chi2.ppf(0.25, found.evidence.freedom(wave)))
    return SLOWEST_WAVES * max(level, 1.0)


def common_to_waves(
    evidence: Evidence, gained: Sequence[tuple[Candidate, Block, float]]
) -> dict[str, float]:
    """By periodic effect, the gain beyond chance that most periods have alike: it is no evidence for one of them."""
    by_period: dict[str, list[float]] = {}
    for candidate, block, gain in gained:
        if candidate.own_phase:
            beyond = gain - stats.chi2.median(evidence.freedom(block))
            by_period.setdefault(candidate.effect, []).append(max(beyond, 0.0))
    return {effect: float(np.median(beyond)) for effect, beyond in by_period.items()}


def _log_p(signal: Signal) -> float:
    return signal.log_p


def log_chance(gain: float, freedom: int) -> float:
    """Natural logarithm of the chi-squared p-value of a gain; from 500 on, by the leading term of the tail."""
    if gain < 500:
        return float(stats.chi2.logsf(gain, freedom))
    half = freedom / 2
    return float(-gain / 2 + (half - 1) * np.log(gain / 2) - special.gammaln(half))


def _evidence(rows: Sequence[Rows], whiten: Whitener) -> Evidence:
    """The evidence from all rows, whitened by one filter."""
    white = (run.white(k, whiten) for k, run in enumerate(rows))
    return products(white, rows[0].fit.shared.values.shape[-1], LOCAL, READINGS)


def _is_definite(curve: Signal) -> bool:
    """Whether a curve is too definite for noise to look like it: one that all runs share, or one of a sensor."""
    assert isinstance(curve.of, Curve)
    return not curve.of.own or curve.of.is_misread


def _without_clearest(found: Screen, rows: Sequence[Rows]) -> list[Series]:
    """The residuals of each run less the most significant candidate or shared curve, and all that is fitted with it."""
    of_candidates, of_curves = signals(found)
    clearest = min(
        (s for s in (*of_candidates, *of_curves) if s.candidate or _is_definite(s)),
        key=_log_p,
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

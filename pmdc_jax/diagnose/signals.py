"""How much each candidate and each curve improves the fit of a motor, and how likely noise would do as much."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from ..effects import EFFECTS
from ..identify.noise_model import Whitener
from .candidates import Candidate
from .effect_relations import unbalances
from .evidence import Block, Evidence
from .library import Curve

# Factor by which slow noise may be stronger at the slowest waves than at most of them
SLOWEST_WAVES = 1.5
# Factor by which torque noise over the few knots of a curve over time may be stronger than the whitening filter makes
# it, for a correlation time of 0.2 s in runs of some seconds
SLOWER = 4.0
# Standard errors by which a value clearly differs from zero
CLEARLY = 3.0
# Largest gain per degree of freedom of a drifting torque in white noise, at some forty degrees of freedom
BY_CHANCE = 1.25
# Equation, variable and whether it reverses with the motion, of a torque that drifts
DRIFTING = ("mechanical", "time", False)


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

    @property
    def drift(self) -> Block | None:
        """The block of a torque that drifts over time, in every run in its own way; None if there is no such curve."""
        return self._slow(lambda c: (c.equation, c.variable, c.reverses) == DRIFTING)

    @property
    def waver(self) -> Block | None:
        """The block of a voltage that fluctuates over time, likewise; None unless it is known to be noise."""
        return self._slow(lambda c: c.noise)

    def _slow(self, is_it: Callable[[Curve], bool]) -> Block | None:
        # unfiltered residuals drift everywhere: no correction for slow noise
        if self.evidence is self.unfiltered:
            return None
        pairs = zip(self.curves, self.of_curve, strict=True)
        return next((block for curve, block in pairs if is_it(curve)), None)


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
    pairs = zip(found.curves, found.of_curve, strict=True)
    gains = np.array([_gain_of_curve(found, curve, block) for curve, block in pairs])
    misread = {c.periods: g for c, g in zip(found.curves, gains, strict=True) if c.is_misread}
    of_candidates, of_curves = _of_candidates(found, misread), _of_curves(found, gains)
    return sorted(of_candidates, key=_log_p), sorted(of_curves, key=_log_p)


def _of_candidates(found: Screen, misread: Mapping[float, float]) -> list[Signal]:
    """The signals of all possible candidates; `misread`, the gains of swinging speed readings by their periods."""
    base, possible = _squares_left(found), []
    for candidate, block in zip(found.candidates, found.of_candidate, strict=True):
        fit = found.evidence.regress([block])
        gain = max(base - fit.squares, 0.0)
        # a reading that swings as often, and explains more beside it, only looks like it
        imitated = any(g > gain and _swings(candidate, periods) for periods, g in misread.items())
        if not imitated and found.possible(candidate, fit.coefficients[0]):
            possible.append((candidate, block, gain))
    common = common_to_waves(found.evidence, possible)
    return [_signal(found, c, b, gain, common.get(c.effect, 0.0)) for c, b, gain in possible]


def _of_curves(found: Screen, gains: np.ndarray) -> list[Signal]:
    """The signals of all curves, their gains corrected for what noise and imperfect sensors explain."""
    gains, drift = gains.copy(), found.drift
    for equation in ("mechanical", "sensor"):
        waves = [k for k, c in enumerate(found.curves) if c.is_wave and c.equation == equation]
        if waves:
            gains[waves] /= _dispersion(found, gains[waves], found.of_curve[waves[0]])
    for k, (curve, block) in enumerate(zip(found.curves, found.of_curve, strict=True)):
        if drift is not None and curve.reverses:
            # a slowly fluctuating torque is noise; a changing friction, which reverses with the motion, is not
            gains[k] = _squares_left(found, drift) - _squares_left(found, drift, block)
        elif block is drift:
            gains[k] /= SLOWER
        elif curve.noise or _is_trace(found, curve, block):
            gains[k] = 0.0
    triples = zip(found.curves, found.of_curve, gains, strict=True)
    return [_signal(found, curve, block, gain) for curve, block, gain in triples]


def _signal(
    found: Screen, of: Candidate | Curve, block: Block, gain: float, common: float = 0.0
) -> Signal:
    """The signal of one block, its p-value corrected for rounding, slow noise and the gain that is `common`."""
    noise = found.evidence.gained_by_rounding(block)
    if found.drift is not None and _is_slow_torque(of):
        noise = max(noise, _beside(found, block, found.drift))
    if found.waver is not None and _is_voltage(of):
        noise = max(noise, _beside(found, block, found.waver))
    log_p = log_chance(max(gain - common, 0.0) / noise, found.evidence.freedom(block))
    return Signal(gain, log_p, of, block)


def _gain_of_curve(found: Screen, curve: Curve, block: Block) -> float:
    """The gain of a curve; of a swinging speed reading beside the torques that swing as often, for at an even speed
    these look like it."""
    beside = []
    if curve.is_misread:
        pairs = zip(found.candidates, found.of_candidate, strict=True)
        beside = [rival for candidate, rival in pairs if _swings(candidate, curve.periods)]
    return max(_squares_left(found, *beside) - _squares_left(found, *beside, block), 0.0)


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


def _squares_left(found: Screen, *blocks: Block) -> float:
    """The squares left by a regression on some blocks together."""
    return found.evidence.regress(blocks).squares


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
    rest = _squares_left(found, block) - _squares_left(found, block, drift)
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

"""How much each candidate and each curve improves the fit of a motor, and the p-value of such a gain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from ...effects import EFFECTS
from ...identify.noise.noise_model import Whitener
from ..hypotheses.candidates import Candidate
from ..hypotheses.curves import Curve
from ..hypotheses.effect_relations import unbalanced_equation
from .regression import Block, Evidence

# Factor by which slow noise may be stronger at the slowest sinusoids of the angle than at most of them
SLOW_WAVE_FACTOR = 1.5
# Factor by which torque noise over the few knots of a curve over time may be stronger than the whitening filter makes
# it, for a correlation time of 0.2 s in runs of some seconds
SLOW_CURVE_FACTOR = 4.0
# Standard errors by which a value clearly differs from zero
CLEAR_ERRORS = 3.0
# Largest gain per degree of freedom of a drifting torque in white noise, at about forty degrees of freedom
CHANCE_GAIN = 1.25
# Equation, variable and whether it reverses with the motion, of a torque that drifts
TORQUE_DRIFT = ("mechanical", "time", False)


class Screen(NamedTuple):
    """The evidence against a model, and the columns of each candidate and curve."""

    evidence: Evidence  # whitened
    white: Whitener
    unfiltered: Evidence  # the same, only scaled by the noise of each run
    candidates: list[Candidate]
    candidate_blocks: list[Block]
    curves: list[Curve]
    curve_blocks: list[Block]
    coulomb_torque: float  # Coulomb friction in the model, N m
    # by unit: the amplitude that imperfect sensors alone may produce
    sensor_floors: Mapping[str, float]
    least_gain: float = 0.0  # that counts as evidence, in whitened squares

    def is_possible(self, candidate: Candidate, coefficients: np.ndarray) -> bool:
        """Whether physics allows these coefficients, and the amplitude is not one that sensors may produce."""
        if candidate.own_phase:
            return True
        amplitude = abs(coefficients[-1]) * candidate.unit
        physical = candidate.build(coefficients, self.coulomb_torque) is not None
        return physical and bool(amplitude >= self.sensor_floor(candidate))

    def sensor_floor(self, candidate: Candidate) -> float:
        """The amplitude, in SI units, below which imperfect sensors alone may produce a candidate."""
        field = candidate.amplitude
        unit = EFFECTS[candidate.effect].ranges[field].unit if field else ""
        return self.sensor_floors.get(unit, 0.0)

    @property
    def torque_drift(self) -> Block | None:
        """The block of a torque that drifts over time, differently in every run; None if there is no such curve."""
        return self._noise_block(lambda c: (c.equation, c.variable, c.reverses) == TORQUE_DRIFT)

    @property
    def voltage_noise(self) -> Block | None:
        """The block of a voltage that fluctuates over time; None unless this is known to be noise."""
        return self._noise_block(lambda c: c.is_noise)

    def _noise_block(self, is_noise: Callable[[Curve], bool]) -> Block | None:
        """The block of the first curve that is noise, to correct others for; None without a whitening filter."""
        # unfiltered residuals drift everywhere: no correction for slow noise
        if self.evidence is self.unfiltered:
            return None
        pairs = zip(self.curves, self.curve_blocks, strict=True)
        return next((block for curve, block in pairs if is_noise(curve)), None)


class Signal(NamedTuple):
    """One block of the evidence, regressed alone: how much it improves the fit."""

    gain: float  # decrease of the squared white residuals
    log_p: float  # natural logarithm of the p-value of such a gain by noise
    term: Candidate | Curve
    block: Block
    beyond_noise: float = 0.0  # the gain less what slow noise, rounding and common waves may have of it, for `log_p`

    @property
    def candidate(self) -> Candidate | None:
        """The candidate, if it is one."""
        return self.term if isinstance(self.term, Candidate) else None

    @property
    def effect(self) -> str:
        """The name of the candidate's effect."""
        assert self.candidate is not None
        return self.candidate.effect


def signals(screen: Screen) -> tuple[list[Signal], list[Signal]]:
    """The signals of all possible candidates, and those of all curves; each list the most significant first."""
    pairs = zip(screen.curves, screen.curve_blocks, strict=True)
    gains = np.array([_gain_of_curve(screen, curve, block) for curve, block in pairs])
    ripple_gains = {c.periods: gain for c, gain in zip(screen.curves, gains, strict=True) if c.is_sensor_ripple}
    return (
        sorted(_candidate_signals(screen, ripple_gains), key=attrgetter("log_p")),
        sorted(_curve_signals(screen, gains), key=attrgetter("log_p")),
    )


def _candidate_signals(screen: Screen, ripple_gains: Mapping[float, float]) -> list[Signal]:
    """The signals of all possible candidates; `ripple_gains`, of the speed sensor's ripple by periods per turn."""
    base, possible = _residual_squares(screen), []
    for candidate, block in zip(screen.candidates, screen.candidate_blocks, strict=True):
        fit = screen.evidence.regress([block])
        gain = max(base - fit.squares, 0.0)
        # a sensor ripple of the same period that explains more beside this torque only looks like it
        is_ripple = any(g > gain and _has_period(candidate, p) for p, g in ripple_gains.items())
        if not is_ripple and screen.is_possible(candidate, fit.coefficients[0]):
            possible.append((candidate, block, gain))
    common = gain_common_to_waves(screen.evidence, possible)
    return [_signal(screen, c, b, gain, common.get(c.effect, 0.0)) for c, b, gain in possible]


def _curve_signals(screen: Screen, gains: np.ndarray) -> list[Signal]:
    """The signals of all curves, their gains corrected for what noise and imperfect sensors explain."""
    gains, drift = gains.copy(), screen.torque_drift
    for equation in ("mechanical", "sensor"):
        waves = [k for k, c in enumerate(screen.curves) if c.is_angle_wave and c.equation == equation]
        if waves:
            gains[waves] /= _dispersion_of_waves(screen, gains[waves], screen.curve_blocks[waves[0]])
    for k, (curve, block) in enumerate(zip(screen.curves, screen.curve_blocks, strict=True)):
        if drift is not None and curve.reverses:
            # a slowly fluctuating torque is noise; a changing friction, which reverses with the motion, is not
            gains[k] = _residual_squares(screen, drift) - _residual_squares(screen, drift, block)
        elif block is drift:
            gains[k] /= SLOW_CURVE_FACTOR
        elif curve.is_noise or _is_below_sensor_floor(screen, curve, block):
            gains[k] = 0.0
    triples = zip(screen.curves, screen.curve_blocks, gains, strict=True)
    return [_signal(screen, curve, block, gain) for curve, block, gain in triples]


def _signal(screen: Screen, term: Candidate | Curve, block: Block, gain: float, common: float = 0.0) -> Signal:
    """The signal of one block, its p-value corrected for rounding, slow noise and the gain that is `common`."""
    dispersion = dispersion_by_noise(screen, block, _is_slow_torque(term), _is_voltage(term))
    degrees_of_freedom = screen.evidence.degrees_of_freedom(block)
    beyond_noise = max(gain - common, 0.0) / dispersion
    return Signal(gain, log_p_value(beyond_noise, degrees_of_freedom), term, block, beyond_noise)


def _gain_of_curve(screen: Screen, curve: Curve, block: Block) -> float:
    """The gain of a curve; that of a sensor ripple beside the torques of the same period, because at a constant speed
    these look like it."""
    beside = []
    if curve.is_sensor_ripple:
        pairs = zip(screen.candidates, screen.candidate_blocks, strict=True)
        beside = [rival for candidate, rival in pairs if _has_period(candidate, curve.periods)]
    return max(_residual_squares(screen, *beside) - _residual_squares(screen, *beside, block), 0.0)


def _has_period(candidate: Candidate, periods: float) -> bool:
    """Whether a candidate is periodic in the rotor angle, with so many periods per turn."""
    return candidate.own_phase and bool(np.isclose(candidate.columns[0]["periods"], periods))


def _is_below_sensor_floor(screen: Screen, curve: Curve, block: Block) -> bool:
    """Whether a curve in volts is nowhere clearly larger than what imperfect sensors may produce."""
    floor = screen.sensor_floors["V"]
    if not floor or not _is_voltage(curve):
        return False
    fit = screen.evidence.regress([block], min_eigenvalue=1e-3)
    runs = zip(np.atleast_2d(fit.coefficients[0]), np.atleast_2d(fit.errors[0]), strict=True)
    clearly = [np.abs(curve.values(c)) - CLEAR_ERRORS * curve.errors(e) for c, e in runs]
    return bool(np.max(clearly) < floor)


def _residual_squares(screen: Screen, *blocks: Block) -> float:
    """The squares left by a regression on some blocks together."""
    return screen.evidence.regress(blocks).squares


def _is_voltage(term: Candidate | Curve) -> bool:
    """Whether a term acts as a voltage: what remains of the noise of the recorded voltage may look like it."""
    equation = EFFECTS[term.effect].equation if isinstance(term, Candidate) else term.equation
    return unbalanced_equation(equation) == "electrical"


def _is_slow_torque(term: Candidate | Curve) -> bool:
    """Whether a term is a torque that changes no faster than the motion: slow torque noise may look like it."""
    if isinstance(term, Candidate):
        effect = EFFECTS[term.effect]
        return effect.equation == "mechanical" and not effect.states
    return term.equation == "mechanical" and term.variable in ("speed", "current")


def dispersion_by_noise(screen: Screen, block: Block, slow_torque: bool = True, voltage: bool = True) -> float:
    """Overdispersion of a block by rounding and, if they may look like it, by slow torque noise and by noise of the
    recorded voltage."""
    dispersion = screen.evidence.rounding_dispersion(block)
    for noise, is_same_kind in ((screen.torque_drift, slow_torque), (screen.voltage_noise, voltage)):
        if noise is not None and is_same_kind:
            dispersion = max(dispersion, _dispersion_beside(screen, block, noise))
    return dispersion


def _dispersion_beside(screen: Screen, block: Block, noise: Block) -> float:
    """Overdispersion beside a block: what a drifting torque or voltage, `noise`, gains when added to it, per degree of
    freedom and over what it gains by chance; at least 1.

    The whitening filter leaves weak fluctuations of some tenths of a second, hidden below the noise of the sensors, and
    the block takes its share of them.
    """
    gain = _residual_squares(screen, block) - _residual_squares(screen, block, noise)
    return max(gain / screen.evidence.degrees_of_freedom(noise) / CHANCE_GAIN, 1.0)


def _dispersion_of_waves(screen: Screen, gains: np.ndarray, wave: Block) -> float:
    """Overdispersion of the gains of sinusoids of the angle: the whitening filter leaves some slow noise.

    From the lower quartile of the gains, because in short runs a real wave shows in many of its neighbours.
    """
    degrees_of_freedom = screen.evidence.degrees_of_freedom(wave)
    level = float(np.quantile(gains, 0.25) / stats.chi2.ppf(0.25, degrees_of_freedom))
    return SLOW_WAVE_FACTOR * max(level, 1.0)


def gain_common_to_waves(evidence: Evidence, gained: Sequence[tuple[Candidate, Block, float]]) -> dict[str, float]:
    """By periodic effect, the median gain beyond chance over all periods: it is no evidence for any one of them."""
    by_period: dict[str, list[float]] = {}
    for candidate, block, gain in gained:
        if candidate.own_phase:
            beyond = gain - stats.chi2.median(evidence.degrees_of_freedom(block))
            by_period.setdefault(candidate.effect, []).append(max(beyond, 0.0))
    return {effect: float(np.median(beyond)) for effect, beyond in by_period.items()}


def log_p_value(gain: float, degrees_of_freedom: int) -> float:
    """Natural logarithm of the chi-squared p-value of a gain; from 500 on, by the leading term of the tail."""
    if gain < 500:
        return float(stats.chi2.logsf(gain, degrees_of_freedom))
    half = degrees_of_freedom / 2
    return float(-gain / 2 + (half - 1) * np.log(gain / 2) - special.gammaln(half))

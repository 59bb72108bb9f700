"""When a recorded voltage acts: held from its sample to the next, which is the default, or otherwise; and whether the
currents beside it are means over the last sample.

An amplifier that follows a signal, and most simulation tools (`lsim`, interpolated tables), connect the recorded
voltages by straight lines; a loop that applies a voltage, waits and then records everything writes it a sample late; a
command computed by a controller often acts a sample after it was recorded. Treated as held from its sample on, such a
voltage is up to a sample late or early, and the inductance, then the resistance and the friction, compensate for it.
So they do for currents that a sensor or a recorder averages from sample to sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize_scalar

from ...simulate import FIRST_ORDER_HOLD, RECORDED_EARLY, RECORDED_LATE, SMOOTH, Timing
from ..fit.fitted_runs import FittedRuns, refitted
from ..fit.gauss_newton import TRIAL_TOLERANCE
from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN, leaves_only_noise, negative_log_likelihood
from ..fit.polish import Fit, fit_at
from ..prepare import Prepared
from ..problem import Problem, normal_matrix
from .electrical_equation import ElectricalEquation, TwoVoltages, electrical_equation, settling, two_voltages
from .reading_time import MARGIN, change_by_reading
from .retiming import electrical_rate, with_timing
from .speed_averaging import seems_averaged, with_averaging, without_averaging
from .uneven_sampling import with_even_clock

# Accuracy, in samples, with which a lead is searched
LEAD_TOLERANCE = 3e-3
# Least distance from a sample, in samples, of a voltage that acts between two
MIN_DISTANCE = 0.01
# Lateness of the current alone, over the apparent lateness of the voltage, from which it is the current that is late
MIN_LATE_SHARE = 0.3
# and in standard errors
MIN_LATE_ERRORS = 5.0
# Largest difference, in samples, between the lateness of a current and that of a mean for which it may be one
MAX_FROM_MEAN = 0.2
# No other timing is tried where the residuals show a shift of less than this share of half a sample
MIN_LEAD = 0.3
# ... nor, for one run, of less than so many standard errors
MIN_LEAD_ERRORS = 5.0
# ... nor a slight lead of less than so many, or if the squares are larger than so many times those of noise
MIN_SLIGHT_ERRORS, MAX_SLIGHT_SQUARES = 3.0, 3.0


def other_timings(fitted: FittedRuns) -> list[Timing]:
    """The timings of the voltages that are clearly likelier than the assumed one, the likeliest first.

    **Arguments**: the runs with the effects of their sensors corrected.
    """
    prepared = fitted.prepared
    if not all(prepared.problem.samples > 0) or not any(r.drive == "voltage" for r in prepared.runs):
        return []  # without a current, or without a speed, only a delay would show
    trials = _Trials(fitted)
    proposed = [*_at_samples(fitted), *(_by_electrical_equation(trials) or _slight_lead(trials))]
    plausible, score = _likelier(trials, proposed), trials.negative_log_likelihood
    if any(run.load is not None for run in prepared.training):
        plausible = [trials.with_load(timing) for timing in plausible]
    # where everything is a mean, voltages on straight lines are as good, and simpler
    likely = [timing for timing in plausible if not timing.current_mean]
    means = [timing for timing in plausible if timing.current_mean]
    likely += trials.likelier(means, min(map(score, likely), default=np.inf))
    return sorted(likely, key=score)


class _Trials:
    """Fits of the runs with other timings, each made once."""

    def __init__(self, assumed: FittedRuns) -> None:
        """**Arguments**: as of `other_timings`."""
        self.assumed = assumed
        self.equation = electrical_equation(*assumed)
        self.voltages = two_voltages(self.equation) if self.equation else None
        self._fitted: dict[Timing, FittedRuns] = {}

    def fitted(self, timing: Timing) -> FittedRuns:
        """The runs with this timing, and the fit to them."""
        if timing not in self._fitted:
            timed = without_averaging(with_timing(self.assumed.prepared, timing))
            refit = self._refitted(timed, self.assumed.fit)
            # only a fit with the right timing can tell a mean over the last sample from a delay
            self._fitted[timing] = with_averaging(with_even_clock(refit))
        return self._fitted[timing]

    def negative_log_likelihood(self, timing: Timing) -> float:
        """The negative log-likelihood of this timing."""
        return negative_log_likelihood_within(self.fitted(timing))

    def with_fitted_rate(self, timing: Timing) -> Timing:
        """The timing of smooth voltages with the rate R / L of the motor fitted to them."""
        for _ in range(2):  # the first fit takes it for slow
            fitted = self.fitted(timing)
            timing = timing._replace(smooth=electrical_rate(fitted.problem, fitted.fit))
        return timing

    def likelier(self, timings: Sequence[Timing], than: float) -> list[Timing]:
        """Those with a negative log-likelihood clearly below a value."""
        limit = than - MIN_LOG_LIKELIHOOD_GAIN
        return [timing for timing in timings if self.negative_log_likelihood(timing) < limit]

    def with_load(self, timing: Timing) -> Timing:
        """The timing with loads that change when the voltages do, if that is clearly likelier: those recorded beside
        them, or beside the reading."""
        moved = [timing._replace(load_ahead=ahead) for ahead in {timing.ahead, 0}]
        likelier = self.likelier(moved, self.negative_log_likelihood(timing))
        return min(likelier, key=self.negative_log_likelihood, default=timing)

    def is_right(self, timing: Timing) -> bool:
        """Whether nothing but noise is left with this timing, and not because the current alone was late."""
        fitted = self.fitted(timing)
        return leaves_only_noise(fitted) and not only_current_is_late(fitted)

    def best_lead(self, ahead: int) -> float:
        """The lead that fits best, if the voltages act between two samples, at least so many ahead."""
        nearest = self.assumed.fit

        def misfit(lead: float) -> float:
            nonlocal nearest
            nearest = self._refitted(with_timing(self.assumed.prepared, Timing(lead)), nearest).fit
            return nearest.cost

        limits, tolerance = (ahead + MARGIN, ahead + 1 - MARGIN), {"xatol": LEAD_TOLERANCE}
        best = minimize_scalar(misfit, bounds=limits, method="bounded", options=tolerance)
        return float(best.x)

    def _refitted(self, other: Prepared, start: Fit) -> FittedRuns:
        """The best fit from a start to the runs with another timing, from the inductance with which the currents depend
        on two voltages as they were seen to."""
        timing, voltages = other.timing, self.voltages
        if not (voltages and timing.reading and timing.ahead == voltages.ahead):
            return refitted(other, start, tolerance=TRIAL_TOLERANCE)
        R = float(other.problem.parameters(start.coordinates).R)
        inductance = R * voltages.time_constant(timing.reading)
        return refitted(other, start, inductance, TRIAL_TOLERANCE)


def _likelier(trials: _Trials, proposed: Sequence[Timing]) -> list[Timing]:
    """The proposed timings that are clearly likelier than the assumed one; smooth voltages only if they are likelier
    than straight ones, too."""
    assumed = negative_log_likelihood_within(trials.assumed)
    likely = trials.likelier(proposed, assumed)
    first_order = trials.negative_log_likelihood(FIRST_ORDER_HOLD) if FIRST_ORDER_HOLD in likely else np.inf
    if SMOOTH in likely and not trials.likelier([SMOOTH], first_order):
        likely.remove(SMOOTH)
    # of a slow difference the whitening filter takes most for noise: it may make smooth voltages no likelier
    if SMOOTH in proposed and not likely and not leaves_only_noise(trials.assumed):
        is_as_likely = trials.negative_log_likelihood(SMOOTH) < assumed + MIN_LOG_LIKELIHOOD_GAIN
        likely = [SMOOTH] if is_as_likely and trials.is_right(SMOOTH) else []
    return [t if t.smooth is None else trials.with_fitted_rate(t) for t in likely]


def _at_samples(fitted: FittedRuns) -> list[Timing]:
    """The timings without an instant between samples that the residuals make plausible."""
    prepared, (lead, largest) = fitted.prepared, _apparent_leads(*fitted)
    # a speed that is a mean over the last sample is half a sample late, too, and may hide the shift
    hidden = prepared.averaging is None and seems_averaged(prepared)
    likely = []
    if abs(lead) > MIN_LEAD or hidden:
        simple = (FIRST_ORDER_HOLD, RECORDED_LATE, RECORDED_EARLY)
        likely = [t for t in simple if hidden or (t.ahead < 0) == (lead < 0)]
    # voltages that step at samples in some runs and are smooth in others seem early in these alone
    even = all(run.has_even_clock for run in prepared.runs)
    if even and (FIRST_ORDER_HOLD in likely or largest > MIN_LEAD):
        likely.append(SMOOTH)
    return likely


def _by_electrical_equation(trials: _Trials) -> list[Timing]:
    """The timings that the electrical equation makes plausible."""
    if trials.equation is None:
        return []
    return _hidden(trials, trials.equation) if trials.voltages is None else _suggested_by(trials, trials.voltages)


def _suggested_by(trials: _Trials, voltages: TwoVoltages) -> list[Timing]:
    """The plausible timings where the currents depend on two voltages: only right ones, if there are any."""
    told = [] if voltages.reading is None else _between_samples(voltages.ahead + voltages.reading)
    means = [Timing(lead, current_mean=True) for lead in ((0, -1) if voltages.ahead < 0 else (1,))]
    if right := [timing for timing in told + means if trials.is_right(timing)]:
        return right
    # the equation takes the speed as straight between samples
    between = [*told, *_between_samples(trials.best_lead(voltages.ahead))]
    # a filtered current is more like a mean than like an instant
    late = any(only_current_is_late(trials.fitted(timing)) for timing in between)
    return [] if late else between + means


def _hidden(trials: _Trials, equation: ElectricalEquation) -> list[Timing]:
    """The right timings for which a wrong inductance may make up, where the current settles from one sample to the next
    or the voltages are smooth."""
    settles = settling(equation, *trials.assumed)
    hidden = _between_samples(trials.best_lead(-1)) if settles.sooner else []
    if any(settles) or _current_seems_mean(trials.assumed.problem, trials.assumed.fit):
        hidden.append(Timing(0, current_mean=True))
    return [timing for timing in hidden if trials.is_right(timing)]


def _slight_lead(trials: _Trials) -> list[Timing]:
    """The right timing with a lead of a few hundredths of a sample, as of a bridge that switches at its own instants:
    too little for the electrical equation, but the inductance would make up for it."""
    prepared, fit = trials.assumed
    if fit.fitness > MAX_SLIGHT_SQUARES * prepared.problem.perfect_fitness:
        return []
    change = _half_sample_earlier(prepared, fit)
    (lead,), (error,) = _amplitudes(prepared.problem, fit, [change])
    if abs(lead) < MIN_SLIGHT_ERRORS * error:
        return []
    late = with_timing(prepared, Timing(-MARGIN)).problem
    fit_late = fit_at(late, fit.optimum)
    (later,), _ = _amplitudes(late, fit_late, [change_by_reading(late, fit_late)])
    return [timing for timing in _between_samples(float(later) - MARGIN) if trials.is_right(timing)]


def _current_seems_mean(problem: Problem, fit: Fit) -> bool:
    """Whether the current was read half a sample late, as the mean of a slow one is."""
    late, _ = _lateness_of_current(problem, fit)
    return abs(late - 0.5) < MAX_FROM_MEAN


def _between_samples(lead: float) -> list[Timing]:
    """The timing with this lead, if the voltages then act between two samples."""
    timing = Timing(lead)
    return [timing] if MIN_DISTANCE < lead - timing.ahead < 1 - MIN_DISTANCE else []


def only_current_is_late(fitted: FittedRuns) -> bool:
    """Whether the current alone was read late, as behind a filter, rather than that the voltages act between samples as
    the timing of the runs says.

    By regression of the residuals on the change that another lead makes in both outputs, and on that of a later reading
    in the current.
    """
    timing, problem, fit = fitted.prepared.timing, fitted.problem, fitted.fit
    if timing.reading is None or timing.ahead >= 0:
        return False
    late, error = _lateness_of_current(problem, fit, change_by_reading(problem, fit))
    return late > max(MIN_LATE_SHARE * abs(timing.lead), MIN_LATE_ERRORS * error)


def _lateness_of_current(problem: Problem, fit: Fit, *changes: Float[Array, "blocks 2 samples"]) -> tuple[float, float]:
    """How much later than assumed the current was read, and the standard error of that, in samples, beside other
    `changes` of the outputs."""
    current = fit.evaluation.simulated[:, 0]
    rise = jnp.diff(current.reshape(-1), prepend=0.0).reshape(current.shape)
    rise = rise.at[jnp.asarray(problem.tape.begins), 0].set(0.0)
    later = jnp.stack([-rise, jnp.zeros_like(rise)], 1)
    amplitudes, errors = _amplitudes(problem, fit, [later, *changes])
    return float(amplitudes[0]), float(errors[0])


def negative_log_likelihood_within(fitted: FittedRuns) -> float:
    """Negative log-likelihood of the runs without their first and last samples: where a voltage acts later, the
    beginning of a run cannot be predicted."""
    return negative_log_likelihood(fitted._replace(prepared=fitted.prepared.without_ends()))


def _apparent_leads(prepared: Prepared, fit: Fit) -> tuple[float, float]:
    """How much earlier than assumed the voltages seem to act, in half samples, in all runs together and, if clearly, in
    one of them at most: regression of the residuals on the change that half a sample makes in the outputs, less the
    part that the parameters could explain.
    """
    change = _half_sample_earlier(prepared, fit)
    (lead,), _ = _amplitudes(prepared.problem, fit, [change])
    blocks = [prepared.problem.tape.blocks_of(run) for run in prepared.training_indices]
    leads, errors = _amplitudes(prepared.problem, fit, [change * b[:, None, None] for b in blocks])
    return float(lead), float(np.max(leads[leads > MIN_LEAD_ERRORS * errors], initial=0.0))


def _half_sample_earlier(prepared: Prepared, fit: Fit) -> Float[Array, "blocks 2 samples"]:
    """The change of the outputs if the voltages act half a sample earlier: as held means of those at a sample and the
    next, which reuses compiled programs."""
    means = with_timing(prepared, FIRST_ORDER_HOLD).problem
    means = replace(means, tape=replace(means.tape, rise=None))
    return fit_at(means, fit.optimum).evaluation.simulated - fit.evaluation.simulated


def _amplitudes(
    problem: Problem, fit: Fit, changes: Sequence[Float[Array, "blocks 2 samples"]]
) -> tuple[Float[np.ndarray, " changes"], Float[np.ndarray, " changes"]]:
    """Amplitudes of changes of the outputs, A and rad/s, and their standard errors, by regression of the residuals on
    what the parameters cannot explain of the changes."""
    scale = problem.tape.weight / fit.noise[:, None] * problem.fitted_blocks[:, None, None]
    scaled = [change * scale for change in changes]
    normal = [
        np.asarray(normal_matrix(fit.evaluation._replace(residuals=column), problem.tape, problem.fitted_runs))
        for column in [*scaled, fit.evaluation.residuals]
    ]
    *slopes, gradient = (matrix[:-1, -1] for matrix in normal)
    slopes = np.stack(slopes)
    inverse = np.linalg.pinv(normal[0][:-1, :-1], hermitian=True)
    products = np.array([[float(jnp.sum(a * b)) for b in scaled] for a in scaled])
    covariance = np.linalg.pinv(products - slopes @ inverse @ slopes.T, hermitian=True)
    along = np.array([float(jnp.sum(fit.evaluation.residuals * change)) for change in scaled])
    # whitened fits have a gradient here
    return covariance @ (slopes @ inverse @ gradient - along), np.sqrt(np.diag(covariance))

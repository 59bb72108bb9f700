"""Slow noise of the torque, far below that of the sensors.

No short filter shows it, and no sample does. But it decides how well the slow part of the runs tells Kt, J and f: a
load that is known, and one of a few mN m that comes and goes over a second, look alike. It is modelled as what it is, a
torque T(t) with the covariance sigma^2 exp(-|t - s| / tau), through the motor to the outputs: about that of the sum of
a constant and cosines over a run, with random amplitudes whose variances `NoiseProducts` estimates.

**Source**: the spectrum of an Ornstein-Uhlenbeck process: Rasmussen, Williams, "Gaussian Processes for Machine
Learning" (2006), section 4.2.1; as cosines over an interval: Solin, Särkkä, Statistics and Computing 30 (2020),
doi:10.1007/s11222-019-09886-w.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np
from jaxtyping import Float

from ...motor import Motor
from ..load_response import load_filter, load_response
from ..noise.noise_model import Series, Whitener, fit_filters
from ..noise.restricted_likelihood import NoiseFit, NoiseProducts
from ..noise.sensor_noise import white_noise
from ..noise.whitening import CHUNK, with_history
from ..prepare import Prepared
from .generalised_least_squares import is_sparse, series_of_samples
from .polish import Fit
from .run_series import RunSeries, series_of_runs

# A constant and cosines over a run: noise faster than the last has many periods, and a filter shows it
WAVES = 30
# Correlation times that are tried, over the longest run
CORRELATION_TIMES = np.geomspace(0.003, 1.0, 8)
# Most samples of all runs: longer ones are their own evidence of how their noise scatters, and would need gigabytes
MAX_SAMPLES = 200_000

Waves = Sequence[Float[np.ndarray, "_ _ waves"]]  # of each run: samples, outputs, waves


def whitener_of(prepared: Prepared, fit: Fit) -> Whitener:
    """The whitener of what a fit leaves of the training runs; see `whitener_of_runs`."""
    return whitener_of_runs(prepared, prepared.problem.parameters(fit.coordinates), series_of_runs(prepared, fit))


def whitener_of_runs(prepared: Prepared, motor: Motor, fits: Sequence[RunSeries]) -> Whitener:
    """The whitener of what is left of the training runs, with the slow noise of their torque.

    Its filters are those of the residuals as they are, or of the residuals less the likeliest torque: whichever are
    likelier, because a filter takes slow noise for its own where it can.

    **Arguments**: `motor`, whose linear part says what a torque makes of the outputs; `fits`, one per training run.
    """
    residuals = [fit.residual for fit in fits]
    filters = fit_filters(residuals)
    if is_sparse(prepared) or sum(len(series.values) for series in residuals) > MAX_SAMPLES:
        return filters.weighted(residuals)
    waves = [_responses(prepared, motor, run) for run in prepared.training_indices]
    durations = np.array([_duration(prepared, run) for run in prepared.training_indices])

    def noise_beside(white: Whitener) -> NoiseFit:
        return _products(fits, waves, white).most_likely(_spectra(durations))

    noise = noise_beside(filters)
    if (alone := noise_beside(_sensors_alone(residuals))).variances.any():
        others = fit_filters(_without_torque(fits, waves, alone))
        beside_others = noise_beside(others)
        if _deviance(beside_others, fits, others) < _deviance(noise, fits, filters):
            filters, noise = others, beside_others
    if noise.variances.any():
        slow = [of_run * sizes for of_run, sizes in zip(waves, noise.deviations, strict=True)]
        filters = attrs.evolve(filters, slow=slow)
    return filters.weighted(residuals)


def _sensors_alone(residuals: Sequence[Series]) -> Whitener:
    """No filters, and the scales of the white noise of the sensors."""
    scales = []
    for series in residuals:
        noise = (white_noise([signal]) for signal in series.values[series.known].T)
        scales.append(np.diag([1 / (size or 1.0) for size in noise]))
    return Whitener([np.zeros((0, *S.shape)) for S in scales], scales)


def _duration(prepared: Prepared, run: int) -> float:
    return len(prepared.runs[run]) * prepared.problem.tape.sample_time_of(run)


def _responses(prepared: Prepared, motor: Motor, run: int) -> Float[np.ndarray, "samples outputs waves"]:
    """What a constant torque of 1 N m, and cosines with 1, 2, ... half periods over a run, make of the outputs."""
    tape = prepared.problem.tape
    samples = int(tape.blocks_of(run).sum()) * tape.value.shape[1]
    phase = np.pi * np.arange(samples)[:, None] / len(prepared.runs[run])
    response = load_response(load_filter(motor, tape, run), np.cos(phase * np.arange(WAVES)))
    return series_of_samples(tape, run, response).values


def _spectra(durations: Float[np.ndarray, " runs"]) -> Iterator[Float[np.ndarray, "runs waves"]]:
    """The variances of the amplitudes of a torque of unit variance, for each correlation time."""
    frequency = np.pi * np.arange(WAVES) / durations[:, None]
    for correlation_time in CORRELATION_TIMES * durations.max():
        variances = 4 * correlation_time / durations[:, None] / (1 + np.square(frequency * correlation_time))
        variances[:, 0] /= 2
        yield variances


def _products(fits: Sequence[RunSeries], waves: Waves, white: Whitener) -> NoiseProducts:
    """The inner products of filtered rows, without the first samples of each run, which the longest filter needs."""

    def rows(run: int) -> Float[np.ndarray, "rows columns"]:
        fit = fits[run]
        columns = (fit.own.values, waves[run], fit.shared.values, fit.residual.values[..., None])
        filtered = white.filtered(run, fit.residual._replace(values=np.concatenate(columns, -1)))
        return filtered[(CHUNK - len(white.filters[run])) * fit.residual.values.shape[1] :]

    return NoiseProducts.of(map(rows, range(len(fits))), fits[0].own.values.shape[-1], WAVES)


def _deviance(noise: NoiseFit, fits: Sequence[RunSeries], white: Whitener) -> float:
    """Twice the negative log-likelihood of residuals, up to a constant that is the same for all filters."""
    samples = (int(with_history(fit.residual.known, CHUNK)[CHUNK:].sum()) for fit in fits)
    log_scales = (n * np.linalg.slogdet(S)[1] for n, S in zip(samples, white.scales, strict=True))
    return noise.deviance - 2 * float(sum(log_scales))


def _without_torque(fits: Sequence[RunSeries], waves: Waves, noise: NoiseFit) -> list[Series]:
    """The residuals less the likeliest torque, and all that is fitted with it."""
    return [
        fit.without_own(fit.residual.values - fit.shared.values @ noise.changes - of_run @ amplitudes)
        for fit, of_run, amplitudes in zip(fits, waves, noise.amplitudes, strict=True)
    ]

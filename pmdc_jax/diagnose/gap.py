"""The gap between simulation and measurement: the misfit before and after effects were added, over the noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..identify.identification import Role, RunFit
from ..identify.noise.sensor_noise import MIN_RELATIVE_NOISE, noise_of_sensor, rms
from ..recordings.recording import SIMULATED_OUTPUTS
from .diagnosis import Gap, share_left

# Least gap, in squares over those of the noise, of which a share can be closed: less is rounding
MIN_OPEN_GAP = 1e-9

# Root mean square of the noise, by channel and by run; zero where the runs tell nothing of it
Noise = Mapping[str, Mapping[str, float]]
Fits = Mapping[str, RunFit]


def gaps_of_runs(before: Fits, after: Fits, noise: Noise) -> dict[str, Gap]:
    """By run, the misfit before and after: root mean squares over both channels, each over its noise."""

    def misfit(run: str, fit: RunFit) -> float:
        ratios = [
            getattr(fit, f"{channel}_rmse") / noise[channel][run]
            for channel in SIMULATED_OUTPUTS
            if getattr(fit, f"{channel}_rmse") is not None and noise[channel][run]
        ]
        return float(np.sqrt(np.mean(np.square(ratios)))) if ratios else 1.0

    gaps = {}
    for run in after:
        one, other = misfit(run, before[run]), misfit(run, after[run])
        gaps[run] = Gap(one, other, min(1.0, other))
    return gaps


def gaps_by_role(gaps: Mapping[str, Gap], fits: Fits) -> dict[Role, Gap]:
    """The gaps of all training runs together, and of all hold-outs: root mean squares over the samples."""
    by_role: dict[Role, Gap] = {}
    for role in ("train", "holdout"):
        of_role = [(gaps[name], len(f.time)) for name, f in fits.items() if f.role == role]
        if of_role:
            weights = np.array([n for _, n in of_role], float)
            squares = np.array([[g.before, g.after, g.floor] for g, _ in of_role]) ** 2
            by_role[role] = Gap(*np.sqrt(weights @ squares / weights.sum()).tolist())
    return by_role


def closed_fraction(gaps: Mapping[Role, Gap]) -> float | None:
    """The share of the gap above its floor, in squares, that the effects close; of the hold-outs if there are any."""
    gap = gaps.get("holdout") or gaps["train"]
    if gap.before**2 - gap.floor**2 <= MIN_OPEN_GAP:
        return None
    return 1 - share_left(gap.before, gap.after, gap.floor)


def noise_of_runs(fits: Fits, share: float) -> Noise:
    """The noise of every run, by the residuals of the final model.

    Its residuals in the training runs are noise, times `share`, below 1 where part of them is not. Their white part,
    the sensor's, is not that of all runs together but each run's own, and may be larger in a hold-out. The noise is at
    least `MIN_RELATIVE_NOISE` times what was measured.
    """
    return {channel: _noise_of_runs(fits, channel, share) for channel in SIMULATED_OUTPUTS}


def _noise_of_runs(fits: Fits, channel: str, share: float) -> dict[str, float]:
    training = {name: f for name, f in fits.items() if f.role == "train"}
    white = {name: _white_noise(f, channel) for name, f in fits.items()}
    residual = {name: getattr(f, f"{channel}_rmse") for name, f in training.items()}
    signals = {name: getattr(f, channel) for name, f in training.items()}
    measured = {name: None if x is None else rms(x) for name, x in signals.items()}

    def pooled(sizes: Mapping[str, float | None]) -> float:
        known = [(x, len(f.time)) for name, f in training.items() if (x := sizes[name]) is not None]
        samples = sum(n for _, n in known)
        return float(np.sqrt(sum(x * x * n for x, n in known) / samples)) if samples else 0.0

    of_all = pooled(white)
    coloured = max((share * pooled(residual)) ** 2 - of_all**2, 0.0)
    least = MIN_RELATIVE_NOISE * pooled(measured)
    return {
        name: max(float(np.hypot(np.sqrt(coloured), of_all if own is None else own)), least)
        for name, own in white.items()
    }


def _white_noise(fit: RunFit, channel: str) -> float | None:
    """White noise in the residuals of a run's channel; None if it was not measured."""
    residual = fit.residual(channel)
    return None if residual is None else noise_of_sensor(getattr(fit, channel), residual)

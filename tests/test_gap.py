"""The gap between simulation and measurement, over the noise of each run."""

from __future__ import annotations

import numpy as np
import pytest

from pmdc_jax.diagnose.gap import closed_fraction, gaps_by_role, gaps_of_runs, noise_of_runs
from pmdc_jax.identify.identification import RunFit

TIME = np.arange(4000) * 1e-3


def run_fit(role: str, misfit: float, noise: float, seed: int) -> RunFit:
    """A run without current: a slow misfit and white noise of the speed, root mean squares in rad/s."""
    left = misfit * np.sqrt(2) * np.sin(3 * TIME)
    left = left + noise * np.random.default_rng(seed).standard_normal(len(TIME))
    return RunFit(
        role=role,
        current_rmse=None,
        speed_rmse=float(np.sqrt(np.mean(left**2))),
        current_fit_percent=None,
        speed_fit_percent=None,
        load_offset=None,
        initial_rise=None,
        time=TIME,
        voltage=None,
        current=None,
        current_simulated=None,
        speed=100 + left,
        speed_simulated=np.full(len(TIME), 100.0),
        load=None,
    )


def fits(misfit_held_out: float, misfit: float = 0.0) -> dict[str, RunFit]:
    """Two training runs, and a hold-out with five times the sensor noise of the first."""
    return {
        "quiet": run_fit("train", misfit, 0.2, 0),
        "loud": run_fit("train", misfit, 0.6, 1),
        "check": run_fit("holdout", misfit_held_out, 1.0, 2),
    }


def test_a_louder_sensor_in_one_run_is_no_misfit():
    found = fits(0.0)
    for gap in gaps_of_runs(found, found, noise_of_runs(found, 1.0)).values():
        assert gap.after == pytest.approx(1.0, abs=0.05)


def test_a_misfit_of_a_held_out_run_is_measured_in_its_own_noise():
    before, after = fits(4.0, 2.0), fits(3.0)
    gaps = gaps_of_runs(before, after, noise_of_runs(after, 1.0))
    assert gaps["check"].before == pytest.approx(np.hypot(1.0, 4.0), rel=0.05)
    assert gaps["check"].after == pytest.approx(np.hypot(1.0, 3.0), rel=0.05)
    by_role = gaps_by_role(gaps, fits(0.0))
    assert by_role["train"].after == pytest.approx(1.0, abs=0.05)
    # squares of 4 before, 3 after
    assert closed_fraction(by_role) == pytest.approx(1 - 9 / 16, abs=0.05)


def test_slow_torque_noise_counts_as_noise_in_every_run():
    found = fits(1.5, 1.5)
    gaps = gaps_of_runs(found, found, noise_of_runs(found, 1.0))
    assert gaps["check"].after == pytest.approx(1.0, abs=0.05)
    # if half of what the training runs leave is no noise, they have a gap, too
    assert gaps_of_runs(found, found, noise_of_runs(found, 0.5))["quiet"].after > 1.5

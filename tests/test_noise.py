"""The noise estimate from differences sees white noise only."""

import numpy as np
import pytest

from pmdc_jax.recordings.noise import noise_by_differences


@pytest.mark.parametrize("order", [2, 3, 4])
def test_motion_jumps_and_gaps_do_not_count_as_noise(order):
    rng, time = np.random.default_rng(5), np.linspace(-1.0, 1.0, 20_000)
    motion = 300 * time ** (order - 1) + 50 * (time > 0.3)
    with_gap, gapless = (motion + rng.normal(0.0, 0.2, len(time)) for _ in range(2))
    with_gap[100:200] = np.nan
    assert noise_by_differences(order, with_gap, gapless) == pytest.approx(0.2, rel=0.03)
    assert noise_by_differences(order, motion) < 1e-6


def test_too_few_samples_give_zero_noise():
    assert noise_by_differences(3, np.array([1.0, 5.0, 2.0])) == 0.0
    assert noise_by_differences(3) == 0.0

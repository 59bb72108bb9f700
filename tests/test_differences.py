"""Noise by differences: of what is white, and of nothing else."""

import numpy as np
import pytest

from pmdc_jax.differences import noise_by_differences


@pytest.mark.parametrize("order", [2, 3, 4])
def test_neither_motion_nor_jumps_nor_gaps_are_noise(order):
    rng, time = np.random.default_rng(5), np.linspace(-1.0, 1.0, 20_000)
    motion = 300 * time ** (order - 1) + 50 * (time > 0.3)
    one, other = (motion + rng.normal(0.0, 0.2, len(time)) for _ in range(2))
    one[100:200] = np.nan
    assert noise_by_differences(order, one, other) == pytest.approx(0.2, rel=0.03)
    assert noise_by_differences(order, motion) < 1e-6


def test_too_few_samples_have_no_noise():
    assert noise_by_differences(3, np.array([1.0, 5.0, 2.0])) == 0.0
    assert noise_by_differences(3) == 0.0

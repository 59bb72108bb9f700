"""Slow noise of the torque below that of the sensors: its likelihood, its filter, and standard errors beside it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_motor import PAPER
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from benchmarks import virtual_bench as vb
from experiments.bench import recording
from pmdc_jax import identify
from pmdc_jax.identify.noise.noise_model import Series, Whitener
from pmdc_jax.identify.noise.restricted_likelihood import NoiseProducts
from pmdc_jax.identify.noise.whitening import Whitening

OWN, SIGNALS, SHARED = 1, 3, 2


@pytest.fixture
def rows() -> list[np.ndarray]:
    """Of two runs: columns for an unknown of their own, for three signals, for two coordinates, and the residual."""
    rng = np.random.default_rng(8)
    return [rng.normal(size=(count, OWN + SIGNALS + SHARED + 1)) for count in (30, 40)]


def dense(rows: list[np.ndarray], variances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All runs in one: what is fitted (X), the covariance, and the residual."""
    total = sum(map(len, rows))
    X, covariance, residual = np.zeros((total, OWN * len(rows) + SHARED)), np.eye(total), np.zeros(total)
    first = 0
    for run, (of_run, of_signals) in enumerate(zip(rows, variances, strict=True)):
        here = slice(first, first + len(of_run))
        own, signals, shared, last = np.split(of_run, np.cumsum([OWN, SIGNALS, SHARED]), axis=1)
        X[here, OWN * run : OWN * (run + 1)], X[here, OWN * len(rows) :] = own, shared
        covariance[here, here] += signals * of_signals @ signals.T
        residual[here] = last.ravel()
        first += len(of_run)
    return X, covariance, residual


def test_the_restricted_likelihood_is_that_of_contrasts(rows):
    """Of the combinations of rows that nothing fitted changes, by scipy, at the likeliest variance of the rows."""
    products = NoiseProducts.of(rows, OWN, SIGNALS)
    deviances, logarithms = [], []
    for variances in (np.full((2, SIGNALS), 0.3), np.array([[2.0, 0.1, 0.0], [0.5, 0.0, 1.0]])):
        found = products.fit(variances)
        X, covariance, residual = dense(rows, variances)
        contrasts = null_space(X.T).T
        of_contrasts = found.variance * contrasts @ covariance @ contrasts.T
        logarithms.append(multivariate_normal(cov=of_contrasts).logpdf(contrasts @ residual))
        # the variance is estimated with all rows as its degrees of freedom
        exponent = residual @ contrasts.T @ np.linalg.solve(of_contrasts, contrasts @ residual)
        logarithms[-1] += (exponent - len(residual) - len(X.T) * np.log(found.variance)) / 2
        deviances.append(found.deviance)
        weights = np.linalg.inv(covariance)
        expected = np.linalg.solve(X.T @ weights @ X, X.T @ weights @ residual)
        np.testing.assert_allclose(found.changes, expected[-SHARED:], rtol=1e-3)
    assert deviances[1] - deviances[0] == pytest.approx(-2 * (logarithms[1] - logarithms[0]), rel=1e-3)


def test_amplitudes_of_signals_are_found():
    rng, variances = np.random.default_rng(9), np.array([[4.0, 1.0, 0.25]])
    runs = []
    for _ in range(8):
        of_run = rng.normal(size=(400, OWN + SIGNALS + SHARED + 1))
        of_run[:, -1] += of_run[:, OWN : OWN + SIGNALS] @ (rng.normal(size=SIGNALS) * np.sqrt(variances[0]))
        runs.append(of_run)
    found = NoiseProducts.of(runs, OWN, SIGNALS).most_likely([np.repeat(variances, 8, 0), np.ones((8, SIGNALS))])
    assert found.variances[0, 0] / found.variances[0, 2] == pytest.approx(16.0)
    assert 0.4 < found.variances[0, 0] / 4.0 < 2.5
    amplitudes = [np.linalg.lstsq(run[:, :-1], run[:, -1])[0][OWN : OWN + SIGNALS] for run in runs]
    np.testing.assert_allclose(found.amplitudes, amplitudes, atol=0.1)


def test_white_residuals_have_no_slow_noise(rows):
    shapes = [np.ones((2, SIGNALS))]
    assert not NoiseProducts.of(rows, OWN, SIGNALS).most_likely(shapes).variances.any()


def test_coordinates_that_the_rows_cannot_tell_apart_stay_finite(rows):
    """Such as R and L of an exact simulation in steps far above L / R, whose rows are scaled by next to nothing."""
    huge = [1e12 * of_run for of_run in rows]
    for of_run in huge:
        of_run[:, -2] = of_run[:, -3]
    found = NoiseProducts.of(huge, OWN, SIGNALS).most_likely([np.ones((2, SIGNALS))])
    assert np.isfinite(found.deviance)
    assert np.isfinite(found.changes).all()


def test_slow_noise_is_whitened_by_the_root_of_its_covariance():
    """Both by the NumPy filter and by that of a fit: (1 + Z Z')^(-1/2), with a dense square root."""
    rng, samples = np.random.default_rng(3), 64
    run = np.array([0, 0, 1])
    slow = [rng.normal(size=(2 * samples, 2, 4)), 3 * rng.normal(size=(samples, 2, 4))]
    filters, scales = 2 * [np.zeros((0, 2, 2))], [np.eye(2), np.diag([2.0, 0.5])]
    signals = [rng.normal(size=(len(of_run), 2)) for of_run in slow]
    on_tape = [
        np.moveaxis(np.concatenate(x).reshape(3, samples, 2, -1), 1, 2) for x in (slow, [s[..., None] for s in signals])
    ]
    weight = np.ones((3, 2, samples))
    with jax.enable_x64(True):
        whitening = Whitening.of(filters, scales, weight, run, on_tape[0])
        of_fit = np.moveaxis(np.asarray(whitening(jnp.asarray(on_tape[1]), run))[..., 0], 1, 2).reshape(-1, 2)
    whitener, expected = Whitener(filters, scales, slow), []
    for k, (Z, S, signal) in enumerate(zip(slow, scales, signals, strict=True)):
        Z = np.einsum("ij,njw->niw", S, Z).reshape(-1, 4)
        values, vectors = np.linalg.eigh(np.eye(len(Z)) + Z @ Z.T)
        expected.append(vectors / np.sqrt(values) @ vectors.T @ (signal @ S).ravel())
        white = whitener(k, Series(signal, np.ones(len(signal), bool), (1e-3, (0, 1))))
        np.testing.assert_allclose(white, expected[-1], atol=1e-10)
    np.testing.assert_allclose(of_fit.ravel(), np.concatenate(expected), atol=1e-10)


def test_slow_torque_noise_is_not_taken_for_a_known_load():
    """Errors of Kt and f are as large as their standard errors: with a short filter alone, 2.3 times as large."""
    noise = vb.Noise(current_A=0.5, speed_rad_s=2.0, torque_Nm=0.01, torque_correlation_s=1.0)
    motor, errors = vb.BenchMotor(**PAPER), []
    for seed in range(12, 17):
        rng = np.random.default_rng(seed)
        excitations = [vb.prbs(rng, 4.0), vb.staircase(4.0), *(vb.loaded(rng, 4.0, load=0.2) for _ in range(2))]
        runs = [recording(f"run {k}", vb.record(motor, e, rng, noise)) for k, e in enumerate(excitations)]
        estimates = identify(runs).parameters
        errors += [(estimates[name].value - PAPER[name]) / estimates[name].stderr for name in ("Kt", "f")]
    assert np.sqrt(np.mean(np.square(errors))) < 1.8

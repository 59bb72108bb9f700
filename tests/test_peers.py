"""The peers in the benchmarks compute the same costs, and the hand-written script identifies the motor."""

import numpy as np
import pytest

from benchmarks import virtual_bench as vb
from benchmarks.peers import diffrax_vmap, roofline, scipy_identify, scipy_lfilter, scipy_solve_ivp
from benchmarks.peers.held import Run, exact_step

SIX = np.array([getattr(vb.paper_motor(), n) for n in vb.SIX])


@pytest.fixture(scope="module")
def case():
    """37 candidates (not a multiple of any tile) and 300 samples that begin in motion.

    At a sample time of 0.05 ms even one explicit step per sample is accurate to the tolerances used here.
    """
    rng = np.random.default_rng(0)
    excitation = vb.loaded(rng, duration=0.015, dt=5e-5, hold=0.002)
    columns = vb.record(vb.paper_motor(), excitation, rng, start=(5.0, 60.0, 0.0))
    return SIX * np.exp(0.3 * rng.standard_normal((37, 6))), Run.of(columns)


@pytest.fixture(scope="module")
def expected(case):
    """The plainest possible loop over the exact step."""
    candidates, run = case
    steps, errors = exact_step(candidates, run.dt), np.zeros((2, len(candidates)))
    states = np.tile([run.current[0], run.speed[0]], (len(candidates), 1))
    for v, t, i, w in zip(*run[1:], strict=True):
        errors += (states.T - np.array([[i], [w]])) ** 2
        states = np.einsum("pij,pj->pi", steps[..., :2], states) + steps[..., 2:] @ [v, t]
    return errors


def _few(errors):
    """The first three candidates, for the peers that are slow."""
    return errors[:, :3]


def test_roofline_matches_the_exact_step(case, expected):
    np.testing.assert_allclose(roofline.squared_errors(*case), expected, rtol=1e-9)


def test_roofline_handles_oscillating_and_stiff_motors(case):
    _, run = case
    candidates = np.array([SIX, SIX, SIX])
    candidates[0, 1] *= 30  # oscillates
    candidates[1, 1] /= 1e4  # far stiffer than the sample time
    expected = scipy_lfilter.squared_errors(candidates, run)
    np.testing.assert_allclose(roofline.squared_errors(candidates, run), expected, rtol=1e-8)


def test_lfilter_matches_the_exact_step(case, expected):
    np.testing.assert_allclose(scipy_lfilter.squared_errors(*case), expected, rtol=1e-9)


def test_solve_ivp_matches_the_exact_step(case, expected):
    candidates, run = case
    errors = scipy_solve_ivp.squared_errors(candidates[:3], run)
    np.testing.assert_allclose(errors, _few(expected), rtol=1e-3)


@pytest.mark.parametrize("function", ["squared_errors", "squared_errors_adaptive"])
def test_diffrax_matches_the_exact_step(case, expected, function):
    candidates, run = case
    errors = getattr(diffrax_vmap, function)(candidates[:3], run)
    np.testing.assert_allclose(errors, _few(expected), rtol=1e-6)


def test_roofline_without_effects_is_the_linear_motor(case, expected):
    candidates, run = case
    absent = np.tile([0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0], (len(candidates), 1))
    errors = roofline.squared_errors_with_effects(candidates, absent, run)
    np.testing.assert_allclose(errors, expected, rtol=1e-6)


def test_roofline_with_effects_matches_numpy(case):
    """Against plain numpy RK4 with numpy's own tanh."""
    candidates, run = case
    R, L, Kb, Kt, J, f = candidates.T
    effects = np.tile([0.05, 2.0, 0.8, 1.0, 0.0039, 4.0, 0.02], (len(candidates), 1))

    def slope(x, v, t):
        i, w, temp = x
        hot = R * (1 + 0.0039 * temp)
        di = (v - hot * i - Kb * w - 0.8 * np.tanh(i)) / L
        dw = (Kt * i - f * w - t - 0.05 * np.tanh(w / 2)) / J
        return np.stack([di, dw, (4.0 * hot * i**2 - temp) / 0.02])

    x = np.zeros((3, len(candidates)))
    x[0], x[1] = run.current[0], run.speed[0]
    expected, h = np.zeros((2, len(candidates))), run.dt
    for v, t, i, w in zip(*run[1:], strict=True):
        expected += (x[:2] - np.array([[i], [w]])) ** 2
        a = slope(x, v, t)
        b = slope(x + h / 2 * a, v, t)
        c = slope(x + h / 2 * b, v, t)
        x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, v, t))
    errors = roofline.squared_errors_with_effects(candidates, effects, run)
    np.testing.assert_allclose(errors, expected, rtol=1e-8)


@pytest.mark.parametrize("identify", [scipy_identify.identify, scipy_identify.identify_by_least_squares])
def test_the_scipy_script_identifies_the_motor(identify):
    rng = np.random.default_rng(1)
    motor = vb.drawn_motor(rng)
    drives = (vb.staircase(duration=1.0), vb.prbs(rng, 1.0), vb.loaded(rng, 1.0, hold=0.1))
    found = identify([vb.record(motor, e, rng) for e in drives])
    for name, tolerance in zip(vb.SIX, (0.01, 0.02, 0.01, 0.02, 0.02, 0.2), strict=True):
        assert found[name] == pytest.approx(getattr(motor, name), rel=tolerance)


@pytest.mark.parametrize("inductance", [1.0, 5.0], ids=["real poles", "complex poles"])
def test_the_gradient_of_the_scipy_script_matches_finite_differences(inductance):
    """Products of derivatives and residual against finite differences of the squared error."""
    rng = np.random.default_rng(2)
    runs = [Run.of(vb.record(vb.paper_motor(), vb.prbs(rng, 0.2), rng))]
    case = scipy_identify.Case(runs, np.array([2.0, 3.0]))
    parameters = SIX * [1.1, inductance, 1.1, 1.1, 1.1, 1.1]
    at = np.concatenate([np.log(parameters), [1.0, 2.0]])
    _, gradient, _ = scipy_identify._normal_equations(at, case)
    for n, slope in enumerate(gradient):
        nudge = 1e-5 * np.eye(8)[n]
        up, down = (scipy_identify._normal_equations(at + s * nudge, case)[0] for s in (1, -1))
        assert (up - down) / 2e-5 == pytest.approx(slope, rel=1e-5, abs=1e-2)

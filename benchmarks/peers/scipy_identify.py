"""The strongest identification script we can write by hand for the six linear parameters.

Exact held steps in numba with forward sensitivities of the logarithms of the parameters and of each
run's initial state; 64 random starts about a regression on the integrated equations, screened by the
roofline kernel; the best four refined in parallel on two threads; the best of these polished with
the estimated noise of each channel. Loads must be known. Same interface as the others: columns in SI.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.peers import roofline
from benchmarks.peers.held import Run, exact_step

NAMES = ("R", "L", "Kb", "Kt", "J", "f")
STARTS, REFINED = 64, 4
WINDOW = 20  # samples over which the equations are integrated for the first guess
BLOCK = 128  # samples whose derivatives are multiplied at once


class Case(NamedTuple):
    """The runs, and the weight (1 / standard deviation) of the current and of the speed."""

    runs: list[Run]
    weights: NDArray[np.float64]


# ----------------------------------------------------------------------------------- first guesses


def _integrated(signal: NDArray, dt: float) -> NDArray:
    """Trapezoidal integral over each window."""
    total = np.concatenate([[0.0], np.cumsum(signal[1:] + signal[:-1])]) * dt / 2
    return total[WINDOW:] - total[:-WINDOW]


def _held_integrated(signal: NDArray, dt: float) -> NDArray:
    """Integral over each window of a signal held between samples."""
    total = np.concatenate([[0.0], np.cumsum(signal[:-1])]) * dt
    return total[WINDOW:] - total[:-WINDOW]


def _regress(columns: Sequence[list[NDArray]], target: list[NDArray]) -> NDArray:
    matrix = np.stack([np.concatenate(c) for c in columns], -1)
    return np.abs(np.linalg.lstsq(matrix, np.concatenate(target), rcond=None)[0])


def _guess(runs: Sequence[Run]) -> NDArray:
    """R, L, Kb from the integrated electrical equation; Kt = Kb, J, f from the mechanical one."""
    changes = [[s[WINDOW:] - s[:-WINDOW] for s in (r.current, r.speed)] for r in runs]
    totals = [[_integrated(s, r.dt) for s in (r.current, r.speed)] for r in runs]
    volts = [_held_integrated(r.voltage, r.dt) for r in runs]
    loads = [_held_integrated(r.load, r.dt) for r in runs]
    di, dw = ([c[n] for c in changes] for n in (0, 1))
    i, w = ([t[n] for t in totals] for n in (0, 1))
    L, R, Kb = _regress([di, i, w], volts)
    torque = [Kb * a - b for a, b in zip(i, loads, strict=True)]
    J, f = _regress([dw, w], torque)
    return np.array([R, L, Kb, Kb, J, f])


def _starts(runs: Sequence[Run], rng: np.random.Generator) -> NDArray:
    """Log-uniform within a factor of 3 (R, Kb, Kt) or 10 (L, J, f) of the guess."""
    width = np.log([3.0, 10.0, 3.0, 3.0, 10.0, 10.0])
    return _guess(runs) * np.exp(width * rng.uniform(-1.0, 1.0, (STARTS, 6)))


def _screened(case: Case, rng: np.random.Generator) -> NDArray:
    """The best few starts, as vectors of unknowns: log parameters, then initial states."""
    starts = _starts(case.runs, rng)
    errors = sum(roofline.squared_errors(starts, run) for run in case.runs)
    best = np.argsort(case.weights**2 @ errors)[:REFINED]
    first = np.concatenate([[r.current[0], r.speed[0]] for r in case.runs])
    return np.stack([np.concatenate([np.log(starts[n]), first]) for n in best])


# ----------------------------------------------------------------------------------- sensitivities


@njit(fastmath=True, cache=True, nogil=True, error_model="numpy")
def _products(step, d_step, start, voltage, load, current, speed):
    """Simulate one run and sum the products of its derivatives and residual, shape (2, 9, 9).

    For each channel: derivatives by 6 log parameters and 2 initial states; last, the residual.
    Blocks of samples stay in cache and go through BLAS. `d_step` and the derivatives live in flat
    buffers with constant offsets so that the loop over the eight columns becomes one vector.
    """
    sums, block = np.zeros((2, 9, 9)), np.empty((2, BLOCK, 9))
    s, x = np.zeros(16), d_step.ravel()
    s[6] = s[15] = 1.0
    i, w = start
    (a, b, e, g), (c, d, h, q) = step[0], step[1]
    for first in range(0, voltage.size, BLOCK):
        count = min(BLOCK, voltage.size - first)
        for n in range(count):
            k = first + n
            v, t = voltage[k], load[k]
            block[0, n, 8], block[1, n, 8] = i - current[k], w - speed[k]
            for j in range(8):
                si, sw = s[j], s[8 + j]
                block[0, n, j], block[1, n, j] = si, sw
                push_i = x[j] * i + x[8 + j] * w + (x[16 + j] * v + x[24 + j] * t)
                push_w = x[32 + j] * i + x[40 + j] * w + (x[48 + j] * v + x[56 + j] * t)
                s[j] = a * si + b * sw + push_i
                s[8 + j] = c * si + d * sw + push_w
            i, w = a * i + b * w + (e * v + g * t), c * i + d * w + (h * v + q * t)
        for j in range(16):  # effects of initial states decay to subnormal numbers, which are very slow
            if abs(s[j]) < 1e-30:
                s[j] = 0.0
        for channel in range(2):
            part = block[channel, :count]
            sums[channel] += part.T @ part
    return sums


def _run_products(unknowns: NDArray, runs: Sequence[Run]) -> list[NDArray]:
    """`_products` of every run; the derivative of the held step is a complex step."""
    parameters = np.exp(unknowns[:6])
    nudged = parameters * (1 + 1e-30j * np.eye(6))
    results = []
    for n, run in enumerate(runs):
        d_step = np.zeros((2, 4, 8))
        d_step[..., :6] = np.moveaxis(exact_step(nudged, run.dt).imag / 1e-30, 0, -1)
        start = unknowns[6 + 2 * n : 8 + 2 * n]
        results.append(_products(exact_step(parameters, run.dt), d_step, start, *run[1:]))
    return results


def _normal_matrix(unknowns: NDArray, case: Case) -> NDArray:
    """[J r]' [J r] of the weighted residual r and its Jacobian J by all unknowns."""
    size = len(unknowns)
    matrix = np.zeros((size + 1, size + 1))
    for n, sums in enumerate(_run_products(unknowns, case.runs)):
        own = [*range(6), 6 + 2 * n, 7 + 2 * n, size]
        matrix[np.ix_(own, own)] += np.tensordot(case.weights**2, sums, 1)
    return matrix


# ------------------------------------------------------------ Levenberg-Marquardt, normal equations


def _normal_equations(unknowns: NDArray, case: Case) -> tuple[float, NDArray, NDArray]:
    """Half the weighted squared error, its gradient and Gauss-Newton matrix."""
    matrix = _normal_matrix(unknowns, case)
    return matrix[-1, -1] / 2, matrix[-1, :-1], matrix[:-1, :-1]


def _refine(unknowns: NDArray, case: Case, tolerance: float) -> tuple[float, NDArray]:
    """Minimise from one start until the predicted reduction by a Gauss-Newton step is below the tolerance."""
    cost, gradient, matrix = _normal_equations(unknowns, case)
    damping = 1e-2
    for _ in range(100):
        scale = np.diag(np.diag(matrix))
        promise = gradient @ np.linalg.solve(matrix + 1e-12 * scale, gradient) / 2
        if promise < tolerance * cost or damping > 1e8:
            break
        move = -np.linalg.solve(matrix + damping * scale, gradient)
        move[:6] = np.clip(move[:6], -1.0, 1.0)
        trial = _normal_equations(unknowns + move, case)
        if trial[0] < cost:
            unknowns, damping = unknowns + move, damping / 8.0
            cost, gradient, matrix = trial
        else:
            damping *= 8.0
    return cost, unknowns


def _refine_by_scipy(unknowns: NDArray, case: Case, tolerance: float) -> tuple[float, NDArray]:
    """The same by `scipy.optimize.least_squares`.

    It needs the residual and the Jacobian only up to a rotation, so it gets a square root of their
    products: 21 rows instead of 66,000.
    """
    known: dict[bytes, NDArray] = {}

    def factor(x):
        if x.tobytes() not in known:
            known.clear()
            squares, axes = np.linalg.eigh(_normal_matrix(x, case))
            known[x.tobytes()] = np.sqrt(np.maximum(squares, 0.0))[:, None] * axes.T
        return known[x.tobytes()]

    def residual(x):
        return factor(x)[:, -1]

    def jacobian(x):
        return factor(x)[:, :-1]

    reach = np.full(len(unknowns), np.inf)
    reach[:6] = 5.0  # in logarithms, so that a long first step does not overflow
    bounds = (unknowns - reach, unknowns + reach)
    options = {"bounds": bounds, "x_scale": "jac", "ftol": tolerance, "xtol": 1e-10}
    result = least_squares(residual, unknowns, jacobian, **options)
    return result.cost, result.x


# ------------------------------------------------------------------------------ complete script


def _noise(unknowns: NDArray, runs: Sequence[Run]) -> NDArray:
    """Root mean square residual of each channel."""
    squares = sum(sums[:, 8, 8] for sums in _run_products(unknowns, runs))
    return np.sqrt(squares / sum(len(r.voltage) for r in runs))


def identify(
    records: Sequence[Mapping[str, NDArray]],
    seed: int = 0,
    refine: Callable[[NDArray, Case, float], tuple[float, NDArray]] = _refine,
) -> dict[str, float]:
    """R, L, Kb, Kt, J and f of the motor, from records of it."""
    runs = [Run.of(columns) for columns in records]
    spread = [np.std(np.concatenate(signals)) for signals in zip(*(r[3:] for r in runs), strict=True)]
    case = Case(runs, 1 / np.array(spread))
    starts = _screened(case, np.random.default_rng(seed))
    with ThreadPoolExecutor(2) as threads:
        refined = threads.map(lambda start: refine(start, case, 1e-4), starts)
    _, best = min(refined, key=lambda pair: pair[0])
    _, best = refine(best, Case(runs, 1 / _noise(best, runs)), 1e-9)
    return dict(zip(NAMES, np.exp(best[:6]).tolist(), strict=True))


def identify_by_least_squares(records: Sequence[Mapping[str, NDArray]], seed: int = 0) -> dict[str, float]:
    """The same starts and sensitivities under `scipy.optimize.least_squares`."""
    return identify(records, seed, _refine_by_scipy)

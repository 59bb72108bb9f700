"""The fastest implementation we can write: numba kernels, threads over tiles of candidates, vectors within a tile.

A tile's state lives in one flat buffer with constant offsets, which is what lets LLVM prove that
the rows do not overlap and vectorise over the candidates.
"""

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from benchmarks.peers.held import Run

TILE = 32  # candidates in a tile: among the best of 8 to 256, which differ little
RK4_TILE = 16
EFFECTS = ("coulomb_Nm", "speed_width", "drop_V", "current_width", "alpha", "Rth", "thermal_s")
FAST = {"fastmath": True, "cache": True, "error_model": "numpy"}


# ------------------------------------------------------------------------ linear motor, exact step


@njit(**FAST)
def _exact_step(p, dt, tile, j):
    """Write the eight coefficients of candidate j's held step into rows 4 to 11 of its tile."""
    R, L, Kb, Kt, J, f = p[0], p[1], p[2], p[3], p[4], p[5]
    a, b, c, d = -R / L, -Kb / L, Kt / J, -f / J
    mean, square = (a + d) / 2, (a - d) ** 2 / 4 + b * c
    gap = math.sqrt(abs(square))
    if gap * dt < 1e-7:
        even = math.exp(mean * dt)
        odd = dt * even
    elif square > 0:  # two real poles
        slow, fast = math.exp((mean + gap) * dt), math.exp((mean - gap) * dt)
        even, odd = (slow + fast) / 2, (slow - fast) / (2 * gap)
    else:
        decay = math.exp(mean * dt)
        even, odd = decay * math.cos(gap * dt), decay * math.sin(gap * dt) / gap
    ii, iw, wi, ww = even + odd * (a - mean), odd * b, odd * c, even + odd * (d - mean)
    det = a * d - b * c
    row = (ii, iw, (d * (ii - 1) - b * wi) / det / L, -(d * iw - b * (ww - 1)) / det / J)
    for n in range(4):
        tile[(4 + n) * TILE + j] = row[n]
    row = (wi, ww, (a * wi - c * (ii - 1)) / det / L, -(a * (ww - 1) - c * iw) / det / J)
    for n in range(4):
        tile[(8 + n) * TILE + j] = row[n]


@njit(**FAST)
def _linear_tile(tile, voltage, load, current, speed):
    """Simulate one tile over the record; rows: i, w, errors of i, of w, then the coefficients."""
    T = TILE
    for k in range(voltage.size):
        v, t, yi, yw = voltage[k], load[k], current[k], speed[k]
        for j in range(T):
            i, w = tile[j], tile[T + j]
            tile[2 * T + j] += (i - yi) ** 2
            tile[3 * T + j] += (w - yw) ** 2
            tile[j] = tile[4 * T + j] * i + tile[5 * T + j] * w + (tile[6 * T + j] * v + tile[7 * T + j] * t)
            tile[T + j] = tile[8 * T + j] * i + tile[9 * T + j] * w + (tile[10 * T + j] * v + tile[11 * T + j] * t)


@njit(parallel=True, **FAST)
def _linear(candidates, dt, voltage, load, current, speed):
    count = candidates.shape[0]
    errors = np.empty((2, count))
    for n in prange((count + TILE - 1) // TILE):
        tile = np.zeros(12 * TILE)
        for j in range(TILE):
            tile[j], tile[TILE + j] = current[0], speed[0]
            _exact_step(candidates[min(n * TILE + j, count - 1)], dt, tile, j)
        _linear_tile(tile, voltage, load, current, speed)
        for j in range(min(TILE, count - n * TILE)):
            errors[0, n * TILE + j] = tile[2 * TILE + j]
            errors[1, n * TILE + j] = tile[3 * TILE + j]
    return errors


def squared_errors(candidates: NDArray, run: Run) -> NDArray[np.float64]:
    """Errors of current and speed of linear motors, shape (2, P)."""
    return _linear(np.ascontiguousarray(candidates), *run)


# ----------------------------------------------------- three effects, RK4 with one step per sample


@njit(**FAST)
def _exp_twice(x):
    """exp(2x), saturating, without branches or tables so that it vectorises.

    A polynomial squared five times; its relative error grows only where tanh is flat.
    """
    y = min(max(x, -19.0), 19.0) / 16.0
    square = y * y
    low = (1.0 + y) + square * (1 / 2 + y * (1 / 6))
    high = (1 / 24 + y * (1 / 120)) + square * (1 / 720 + y * (1 / 5040))
    e = low + square * square * high
    e *= e
    e *= e
    e *= e
    e *= e
    return e * e


@njit(**FAST)
def _two_tanh(x, y):
    """tanh of both, to 2e-11, with a single division, which is the costly operation here."""
    a, b = _exp_twice(x) + 1.0, _exp_twice(y) + 1.0
    share = 2.0 / (a * b)
    return 1.0 - share * b, 1.0 - share * a


@njit(**FAST)
def _slope(i, w, temp, v, t, R, per_L, Kb, Kt, per_J, f, coulomb, per_w, drop, per_i, alpha, g, h):
    hot = R * (1.0 + alpha * temp)
    sign_i, sign_w = _two_tanh(i * per_i, w * per_w)
    return (
        (v - hot * i - Kb * w - drop * sign_i) * per_L,
        (Kt * i - f * w - t - coulomb * sign_w) * per_J,
        g * hot * i * i - h * temp,
    )


@njit(**FAST)
def _effects_tile(tile, dt, voltage, load, current, speed):
    """Rows: i, w, temperature, errors of i, of w, then the thirteen constants of `_slope`."""
    T = RK4_TILE
    half, sixth = dt / 2, dt / 6
    for k in range(voltage.size):
        v, t, yi, yw = voltage[k], load[k], current[k], speed[k]
        for j in range(T):
            i, w, temp = tile[j], tile[T + j], tile[2 * T + j]
            tile[3 * T + j] += (i - yi) ** 2
            tile[4 * T + j] += (w - yw) ** 2
            p = (
                tile[5 * T + j],
                tile[6 * T + j],
                tile[7 * T + j],
                tile[8 * T + j],
                tile[9 * T + j],
                tile[10 * T + j],
                tile[11 * T + j],
                tile[12 * T + j],
                tile[13 * T + j],
                tile[14 * T + j],
                tile[15 * T + j],
                tile[16 * T + j],
                tile[17 * T + j],
            )
            a = _slope(i, w, temp, v, t, *p)
            b = _slope(i + half * a[0], w + half * a[1], temp + half * a[2], v, t, *p)
            c = _slope(i + half * b[0], w + half * b[1], temp + half * b[2], v, t, *p)
            d = _slope(i + dt * c[0], w + dt * c[1], temp + dt * c[2], v, t, *p)
            tile[j] = i + sixth * (a[0] + 2 * (b[0] + c[0]) + d[0])
            tile[T + j] = w + sixth * (a[1] + 2 * (b[1] + c[1]) + d[1])
            tile[2 * T + j] = temp + sixth * (a[2] + 2 * (b[2] + c[2]) + d[2])


@njit(parallel=True, **FAST)
def _with_effects(constants, dt, voltage, load, current, speed):
    count = constants.shape[1]
    errors = np.empty((2, count))
    for n in prange((count + RK4_TILE - 1) // RK4_TILE):
        tile = np.zeros(18 * RK4_TILE)
        for j in range(RK4_TILE):
            tile[j], tile[RK4_TILE + j] = current[0], speed[0]
            for row in range(13):
                constant = constants[row, min(n * RK4_TILE + j, count - 1)]
                tile[(5 + row) * RK4_TILE + j] = constant
        _effects_tile(tile, dt, voltage, load, current, speed)
        for j in range(min(RK4_TILE, count - n * RK4_TILE)):
            errors[0, n * RK4_TILE + j] = tile[3 * RK4_TILE + j]
            errors[1, n * RK4_TILE + j] = tile[4 * RK4_TILE + j]
    return errors


def squared_errors_with_effects(candidates: NDArray, effects: NDArray, run: Run) -> NDArray[np.float64]:
    """Errors of motors with smoothed Coulomb friction, brush drop and heating, shape (2, P).

    `effects` has shape (P, 7), columns as in `EFFECTS`: N m, rad/s, V, A, 1/K, K/W, s.
    """
    R, L, Kb, Kt, J, f = candidates.T
    coulomb, speed_width, drop, current_width, alpha, Rth, thermal = effects.T
    linear = (R, 1 / L, Kb, Kt, 1 / J, f)
    dry = (coulomb, 1 / speed_width, drop, 1 / current_width)
    constants = np.array([*linear, *dry, alpha, Rth / thermal, 1 / thermal])
    return _with_effects(constants, *run)

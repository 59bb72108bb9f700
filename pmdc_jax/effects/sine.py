"""Sine and cosine in plain arithmetic, which XLA turns into vector instructions.

XLA on CPU calls the C library for each double-precision sine or cosine, which takes ten times longer, and simulates
everything around it one number at a time.

**Source**: the reduction of the argument in parts is that of Cody, Waite, "Software Manual for the Elementary
Functions" (1980), chapter 8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp

from .base import Scalars

# The sum of these is pi; multiples of the first two up to 2^21 are exact
PI_PARTS = (3.1415926534682512, 1.2154201012607932e-10, 4.044532497591901e-21)
# Coefficients of sin(x) / x and of cos(x) in x^2, with an error below 3e-16 for |x| up to pi / 2
SINE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(10)]
COSINE = [(-1) ** k / math.factorial(2 * k) for k in range(11)]


@jax.custom_jvp
def sine(x: Scalars) -> Scalars:
    """sin(x) for x in rad, to 5e-16 for |x| below 6e6, and to the precision of x beyond."""
    if jnp.result_type(x) != jnp.float64:
        return jnp.sin(x)
    rest, sign = _reduced(x)
    return sign * rest * _polynomial(SINE, rest)


@jax.custom_jvp
def cosine(x: Scalars) -> Scalars:
    """cos(x), as `sine`."""
    if jnp.result_type(x) != jnp.float64:
        return jnp.cos(x)
    rest, sign = _reduced(x)
    return sign * _polynomial(COSINE, rest)


@sine.defjvp
def _sine_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Scalars, Scalars]:
    (x,), (change,) = primals, tangents
    return sine(x), cosine(x) * change


@cosine.defjvp
def _cosine_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Scalars, Scalars]:
    (x,), (change,) = primals, tangents
    return cosine(x), -sine(x) * change


def _reduced(x: Scalars) -> tuple[Scalars, Scalars]:
    """x less the nearest multiple of pi, and 1 or -1 for an even or an odd one."""
    multiple = jnp.round(x / math.pi)
    for part in PI_PARTS:
        x = x - multiple * part
    return x, 1.0 - 2.0 * (multiple - 2.0 * jnp.floor(multiple / 2.0))


def _polynomial(coefficients: Sequence[float], x: Scalars) -> Scalars:
    """A polynomial in x^2."""
    square = x * x
    highest = jnp.full_like(square, coefficients[-1])
    return reduce(lambda total, c: total * square + c, coefficients[-2::-1], highest)

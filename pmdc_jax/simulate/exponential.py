"""Functions phi_k of numbers and of small matrices, for the exact step of a linear system."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

Matrix = Float[Array, "n n *#batch"]

# Taylor order and halvings: exact to rounding for |A h| up to 0.25 * 2**HALVINGS
ORDER = 10
HALVINGS = 20
# Below this size of a number a series is more accurate than a quotient
SERIES_LIMIT = 3e-3


def product(
    a: Float[Array, "n n *#batch"], b: Float[Array, "n m *#batch"]
) -> Float[Array, "n m ..."]:
    """Matrix product over the two leading axes; a sum, since XLA on CPU is slow on batches of tiny dots."""
    return (a[:, :, None] * b[None]).sum(1)


@partial(jax.jit, static_argnames="count")
def phi_functions(z: Matrix, count: int) -> tuple[list[Matrix], list[Matrix]]:
    """phi_0 to phi_count of z / 2 and of z.

    phi_0(z) = exp(z), phi_k(z) = sum_j z^j / (j + k)!. By a Taylor series of a scaled-down z, and repeated doubling,
    phi_p(2 z) = 2^-p (phi_0 phi_p + sum_{j=1..p} phi_j / (p - j)!). phi_0 - 1 is doubled instead of phi_0, so that
    slow modes lose no digits and stiff ones stay decayed.

    **Source**: Hochbruck, Ostermann, "Exponential integrators", Acta Numerica 19 (2010), section 2;
    Skaflestad, Wright, Applied Numerical Mathematics 59 (2009), equation (2.5), doi:10.1016/j.apnum.2008.03.021.
    """
    one = jnp.zeros_like(z) + jnp.eye(len(z)).reshape(len(z), len(z), *[1] * (z.ndim - 2))
    small = z / 2**HALVINGS

    def series(k: int) -> Matrix:
        term = one / float(math.factorial(ORDER + k))
        for j in reversed(range(ORDER)):
            term = one / float(math.factorial(j + k)) + product(small, term)
        return term

    def double(carry: tuple[Matrix, ...]) -> tuple[Matrix, ...]:
        decay, *half = carry
        f0 = one + decay
        doubled = [
            sum(
                (half[j - 1] / float(math.factorial(p - j)) for j in range(1, p + 1)),
                start=product(f0, half[p - 1]),
            )
            / 2**p
            for p in range(1, count + 1)
        ]
        return (2 * decay + product(decay, decay), *doubled)

    phis = [series(k) for k in range(1, count + 1)]
    start = (product(small, phis[0]), *phis)
    half = jax.lax.fori_loop(0, HALVINGS - 1, lambda _, carry: double(carry), start)
    full = double(half)
    return [one + half[0], *half[1:]], [one + full[0], *full[1:]]


def scalar_phi(z: ArrayLike, k: int) -> np.ndarray:
    """phi_k(z) = sum_j z^j / (j + k)! of each number, real or complex, for k up to 2."""
    z = np.asarray(z)
    if k == 0:
        return np.exp(z)
    small = np.abs(z) < SERIES_LIMIT
    safe = np.where(small, 1.0, z)
    first = np.where(small, 1 + z / 2 + z**2 / 6 + z**3 / 24 + z**4 / 120, np.expm1(safe) / safe)
    if k == 1:
        return first
    return np.where(small, 1 / 2 + z / 6 + z**2 / 24 + z**3 / 120, (first - 1) / safe)

"""Functions phi_k of numbers and of small matrices, for the exact step of a linear system."""

from __future__ import annotations

from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.linalg import toeplitz
from scipy.special import factorial

Matrix = Float[Array, "n n *#batch"]

# Taylor order and halvings: exact to rounding for |A h| up to 0.25 * 2**HALVINGS
ORDER = 10
HALVINGS = 20
# Below this size of a number a series is more accurate than a quotient
SERIES_LIMIT = 3e-3
SERIES_TERMS = 5


def product(a: Float[Array, "n n *#batch"], b: Float[Array, "n m *#batch"]) -> Float[Array, "n m ..."]:
    """Matrix product over the two leading axes; as sums, because XLA on CPU is slow on batches of tiny dots, and on
    reductions over a leading axis."""
    return reduce(add, (a[:, j, None] * b[j] for j in range(len(b))))


@partial(jax.jit, static_argnames="count")
def phi_functions(z: Matrix, count: int) -> tuple[list[Matrix], list[Matrix]]:
    """phi_0 to phi_count of z / 2 and of z.

    phi_0(z) = exp(z), phi_k(z) = sum_j z^j / (j + k)!. By a Taylor series of a scaled-down z, and repeated doubling,
    phi_p(2 z) = 2^-p (phi_0 phi_p + sum_{j=1..p} phi_j / (p - j)!). phi_0 - 1 is doubled instead of phi_0, so that
    slow modes lose no digits and stiff ones stay decayed.

    **Source**: Hochbruck, Ostermann, "Exponential integrators", Acta Numerica 19 (2010), section 2;
    Skaflestad, Wright, Applied Numerical Mathematics 59 (2009), equation (2.5), doi:10.1016/j.apnum.2008.03.021.
    """
    batch = [1] * (z.ndim - 2)
    one = jnp.zeros_like(z) + jnp.eye(len(z)).reshape(*z.shape[:2], *batch)
    small, reciprocals = z / 2**HALVINGS, jnp.asarray(1 / factorial(np.arange(ORDER + count + 1)))
    # phi_count by Horner's scheme, then phi_(k - 1)(z) = 1 / (k - 1)! + z phi_k
    phis = [
        jax.lax.fori_loop(
            1,
            ORDER + 1,
            lambda j, phi: reciprocals[ORDER + count - j] * one + product(small, phi),
            reciprocals[ORDER + count] * one,
        )
    ]
    for k in reversed(range(1, count)):
        phis.insert(0, reciprocals[k] * one + product(small, phis[0]))
    start = jnp.stack([product(small, phis[0]), *phis])
    scale, sums = (jnp.asarray(x).reshape(*x.shape, 1, *batch) for x in _doubling(count))

    def doubled(f: Float[Array, "functions n n *batch"]) -> Float[Array, "functions n n *batch"]:
        """phi_0 - 1 and the others of twice the matrix."""
        return scale[:, None] * jax.vmap(product, (None, 0))(f[0], f) + product(sums, f)

    half, whole = jax.lax.fori_loop(0, HALVINGS, lambda _, f: (f[1], doubled(f[1])), (start, start))
    return [one + half[0], *half[1:]], [one + whole[0], *whole[1:]]


def _doubling(count: int) -> tuple[Float[np.ndarray, " functions"], Float[np.ndarray, "functions functions"]]:
    """The doubled functions phi_0 - 1, phi_1, ... as `scale` (phi_0 - 1) f plus `sums` of the functions f."""
    scale = 0.5 ** np.arange(count + 1)
    sums = np.eye(count + 1) + np.tril(toeplitz(1 / factorial(np.arange(count + 1))))
    sums[1:, 0] = 0.0
    return scale, scale[:, None] * sums


def scalar_phi(z: ArrayLike, k: int) -> np.ndarray:
    """phi_k(z) = sum_j z^j / (j + k)! of each number, real or complex."""
    z = np.asarray(z)
    if k == 0:
        return np.exp(z)
    small = np.abs(z) < SERIES_LIMIT
    safe = np.where(small, 1.0, z)
    rise = np.expm1(safe) if k == 1 else scalar_phi(safe, k - 1) - 1 / factorial(k - 1)
    series = sum(z**j / factorial(j + k) for j in range(SERIES_TERMS))
    return np.where(small, series, rise / safe)

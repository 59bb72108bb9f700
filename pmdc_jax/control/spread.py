"""Motors as they might be: drawn from the uncertainty of an identification, or from a given spread."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..effects import EFFECTS
from ..motor import PARAMETERS, Motor


def drawn_motors(
    motor: Motor,
    count: int,
    seed: int,
    names: Sequence[str] = (),
    covariance: np.ndarray | None = None,
    spread: float | None = None,
) -> Motor:
    """`count` motors about `motor`, stacked; drawn from a normal distribution of the logarithms.

    **Arguments**: `names` and `covariance` of the coordinates, as a motor file holds them (of logarithms, except
    where an effect's table says linear); or `spread`, a standard deviation of the logarithm of each of R, L, Kb,
    Kt, J and f, alike and independent.
    """
    rng = np.random.default_rng(seed)
    if spread is not None:
        names, covariance = tuple(PARAMETERS), spread**2 * np.eye(len(PARAMETERS))
    assert covariance is not None
    deviations = _normal(rng, np.asarray(covariance, float), count)
    stacked = jax.tree.map(lambda leaf: jnp.full(count, leaf, float), motor)
    moved = {name: deviations[:, k] for k, name in enumerate(names)}
    constants = {n: getattr(stacked, n) * np.exp(moved.get(n, 0.0)) for n in PARAMETERS}
    effects = []
    for effect in stacked.effects:
        fields = {}
        for field, r in EFFECTS[effect.name].ranges.items():
            value, by = getattr(effect, field), moved.get(f"{effect.name}.{field}", 0.0)
            fields[field] = value * np.exp(by) if r.scale == "log" else value + by
        effects.append(type(effect)(**fields))
    return Motor(**constants, effects=tuple(effects))


def _normal(rng: np.random.Generator, covariance: np.ndarray, count: int) -> np.ndarray:
    """Draws in pairs of opposite sign, so that their mean is exact. Directions without variance stay put."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    half = rng.standard_normal((-(-count // 2), len(covariance))) @ root.T
    return np.stack([half, -half], axis=1).reshape(-1, len(covariance))[:count]

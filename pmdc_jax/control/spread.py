"""Motors as they might be: drawn from the uncertainty of an identification, or from an even spread."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..effects import EFFECTS
from ..motor import PARAMETERS, Motor
from ..motor_file import Uncertainty


def even_spread(spread: float) -> Uncertainty:
    """R, L, Kb, Kt, J and f alike and independent; `spread` is the standard deviation of each one's logarithm."""
    return Uncertainty(tuple(PARAMETERS), spread**2 * np.eye(len(PARAMETERS)))


def drawn_motors(motor: Motor, uncertainty: Uncertainty, count: int, seed: int) -> Motor:
    """`count` motors about `motor`, stacked; drawn from a normal distribution of the coordinates: logarithms, or
    the parameters themselves where an effect's table says linear."""
    rng = np.random.default_rng(seed)
    deviations = _normal(rng, np.asarray(uncertainty.covariance, float), count)
    stacked = jax.tree.map(lambda leaf: jnp.full(count, leaf, float), motor)
    moved = {name: deviations[:, k] for k, name in enumerate(uncertainty.names)}
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

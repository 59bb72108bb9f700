"""Random motors: drawn from the uncertainty of an identification, or from an even spread."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..effects import EFFECTS
from ..motor import PARAMETERS, Motor
from ..motor_file import Uncertainty


def even_spread(spread: float) -> Uncertainty:
    """Independent, equal uncertainty of R, L, Kb, Kt, J and f: `spread`, the standard deviation of each logarithm."""
    return Uncertainty(tuple(PARAMETERS), spread**2 * np.eye(len(PARAMETERS)))


def drawn_motors(motor: Motor, uncertainty: Uncertainty, count: int, seed: int) -> Motor:
    """Draw `count` motors around `motor`, stacked. The coordinates are normally distributed: logarithms of the
    parameters, or the parameters themselves where the `ranges` of an effect say linear."""
    rng = np.random.default_rng(seed)
    deviations = _antithetic_normal(rng, np.asarray(uncertainty.covariance, float), count)
    stacked = jax.tree.map(lambda leaf: jnp.full(count, leaf, float), motor)
    deviation = {name: deviations[:, k] for k, name in enumerate(uncertainty.names)}
    constants = {n: getattr(stacked, n) * np.exp(deviation.get(n, 0.0)) for n in PARAMETERS}
    effects = []
    for effect in stacked.effects:
        fields = {}
        for name, allowed in EFFECTS[effect.name].ranges.items():
            value, by = getattr(effect, name), deviation.get(f"{effect.name}.{name}", 0.0)
            fields[name] = value * np.exp(by) if allowed.scale == "log" else value + by
        effects.append(type(effect)(**fields))
    return Motor(**constants, effects=tuple(effects))


def _antithetic_normal(rng: np.random.Generator, covariance: np.ndarray, count: int) -> np.ndarray:
    """Normal draws in pairs of opposite sign, so that the mean of an even count is 0; `covariance` may be singular."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    half = rng.standard_normal((-(-count // 2), len(covariance))) @ root.T
    return np.stack([half, -half], axis=1).reshape(-1, len(covariance))[:count]

"""Random motors: drawn from the uncertainty of an identification, or from an even spread."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError
from ..motor import PARAMETERS, Motor
from ..motor_file import Uncertainty

# Times that impossible motors are drawn anew at most
MAX_DRAWS = 100


def even_spread(spread: float) -> Uncertainty:
    """Independent, equal uncertainty of R, L, Kb, Kt, J and f: `spread`, the standard deviation of each logarithm."""
    return Uncertainty(tuple(PARAMETERS), spread**2 * np.eye(len(PARAMETERS)))


def drawn_motors(motor: Motor, uncertainty: Uncertainty, count: int, seed: int) -> Motor:
    """Draw `count` motors around `motor`, stacked. The coordinates are normally distributed: logarithms of the
    parameters, or the parameters themselves where the `ranges` of an effect say linear.

    Physically impossible motors are drawn anew.

    **Raises**: `InputError` if hardly any motor is possible.
    """
    rng = np.random.default_rng(seed)
    covariance = np.asarray(uncertainty.covariance, float)
    deviations = _antithetic_normal(rng, covariance, count)
    for _ in range(MAX_DRAWS):
        motors = _moved(motor, uncertainty.names, deviations)
        impossible = _beyond_limits(motors)
        if not impossible.any():
            return motors
        deviations[impossible] = _antithetic_normal(rng, covariance, int(impossible.sum()))
    raise InputError(
        "uncertainty of the motor",
        "hardly any motor drawn from it is physically possible",
        "Identify the motor from more runs, or give an even --spread",
    )


def _moved(motor: Motor, names: Sequence[str], deviations: Float[np.ndarray, "motors coordinates"]) -> Motor:
    """Motors whose coordinates deviate by so much from those of `motor`, stacked."""
    stacked = jax.tree.map(lambda leaf: jnp.full(len(deviations), leaf, float), motor)
    deviation = dict(zip(names, deviations.T, strict=True))
    constants = {n: getattr(stacked, n) * np.exp(deviation.get(n, 0.0)) for n in PARAMETERS}
    effects = []
    for effect in stacked.effects:
        fields = {}
        for name, allowed in effect.ranges.items():
            value, by = getattr(effect, name), deviation.get(f"{effect.name}.{name}", 0.0)
            fields[name] = value * np.exp(by) if allowed.scale == "log" else value + by
        effects.append(type(effect)(**fields))
    return Motor(**constants, effects=tuple(effects))


def _beyond_limits(motors: Motor) -> Bool[np.ndarray, " motors"]:
    """Which motors have a parameter of an effect that is impossible."""
    beyond = np.zeros(motors.R.shape, bool)
    for effect in motors.effects:
        for name, allowed in effect.ranges.items():
            beyond |= np.asarray(getattr(effect, name)) >= allowed.limit
    return beyond


def _antithetic_normal(rng: np.random.Generator, covariance: np.ndarray, count: int) -> np.ndarray:
    """Normal draws in pairs of opposite sign, so that the mean of an even count is 0; `covariance` may be singular."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    half = rng.standard_normal((-(-count // 2), len(covariance))) @ root.T
    return np.stack([half, -half], axis=1).reshape(-1, len(covariance))[:count]

"""The parameters to identify, and the mapping from a vector of search coordinates to a motor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..effects import EFFECTS, AbstractEffect, range_of
from ..errors import InputError
from ..motor import PARAMETERS, Motor

Coordinates = Float[Array, "*population parameters"]

# What the units of the parameters begin with that are proportional to torque
TORQUE_UNITS = ("N m", "kg m^2")


class Parameters(eqx.Module):
    """The free parameters with their bounds, and those that are known or tied.

    A coordinate is the natural logarithm of its parameter, or the parameter over its `scale` where the effect's table
    says that it is linear; effects' parameters are named like coulomb_friction.torque_Nm.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    scale: Float[Array | np.ndarray, " parameters"]  # of linear coordinates, in SI; 1 for logarithms
    effects: tuple[type[AbstractEffect], ...] = eqx.field(static=True)
    ties: tuple[tuple[str, str], ...] = eqx.field(static=True)
    known: dict[str, Float[Array | np.ndarray, ""]]
    lower: Float[Array | np.ndarray, " parameters"]
    upper: Float[Array | np.ndarray, " parameters"]

    @classmethod
    def of(
        cls,
        bounds: Mapping[str, tuple[float, float]],
        effects: Sequence[type[AbstractEffect]] = (),
        known: Mapping[str, float] | None = None,
        ties: Sequence[tuple[str, str]] = (),
        magnitudes: Mapping[str, float] | None = None,
    ) -> Parameters:
        """Make every parameter free that is neither known nor tied.

        **Arguments**: `bounds` of R, L, Kb, Kt, J, f in SI, lower > 0; `effects`, whose parameters have the
        ranges of their own table unless `bounds` holds others; `known` values in SI; `ties`, pairs (a, b) for
        a = b, of which only b is free; `magnitudes`, by unit, the scales of linear coordinates: 1 for all others.
        """
        ranges = {name: (*bounds[name], True) for name in PARAMETERS}
        for effect in effects:
            for field, r in effect.ranges.items():
                name = f"{effect.name}.{field}"
                ranges[name] = (*bounds.get(name, (r.lower, r.upper)), r.scale == "log")
        fixed = dict(known or {})
        names = tuple(n for n in ranges if n not in fixed and n not in {a for a, _ in ties})
        limits = np.array([ranges[n][:2] for n in names], float).reshape(-1, 2)
        logarithmic = np.array([ranges[n][2] for n in names], bool)
        scale = np.array([1.0 if ranges[n][2] else (magnitudes or {}).get(unit_of(n), 1.0) for n in names])
        limits = np.where(logarithmic[:, None], np.log(np.where(logarithmic[:, None], limits, 1.0)), limits)
        limits /= scale[:, None]
        return cls(
            names=names,
            logarithmic=tuple(logarithmic.tolist()),
            scale=scale,
            effects=tuple(effects),
            ties=tuple(ties),
            known={name: np.asarray(float(value)) for name, value in fixed.items()},
            lower=limits[:, 0],
            upper=limits[:, 1],
        )

    @property
    def all_free(self) -> Bool[Array, " parameters"]:
        """The mask of a problem in which all of them are fitted."""
        return jnp.ones(len(self.names), bool)

    def __call__(self, coordinates: Coordinates) -> Motor:
        """The motor, or the population of motors, at these coordinates."""
        like = jnp.zeros(coordinates.shape[:-1])
        values = {name: like + value for name, value in self.known.items()}
        for k, (name, log) in enumerate(zip(self.names, self.logarithmic, strict=True)):
            values[name] = jnp.exp(coordinates[..., k]) if log else coordinates[..., k] * self.scale[k]
        for target, source in self.ties:
            values[target] = values[source]
        effects = tuple(
            effect(**{field: values[f"{effect.name}.{field}"] for field in effect.ranges}) for effect in self.effects
        )
        return Motor(**{name: values[name] for name in PARAMETERS}, effects=effects)

    def with_torques_scaled(
        self, coordinates: Float[np.ndarray, "*motors parameters"], factor: float
    ) -> Float[np.ndarray, "*motors parameters"]:
        """The coordinates with all torques, and Kt, J and f with them, multiplied by a factor: without a known load
        the motor moves the same."""
        torques = np.array([unit_of(name).startswith(TORQUE_UNITS) for name in self.names])
        logarithmic = np.array(self.logarithmic)
        scaled = np.where(torques & ~logarithmic, coordinates * factor, coordinates)
        return scaled + np.where(torques & logarithmic, np.log(factor), 0.0)

    def value(self, name: str, coordinates: np.ndarray) -> float:
        """One parameter in SI."""
        source = dict(self.ties).get(name, name)
        if source in self.known:
            return float(self.known[source])
        k = self.names.index(source)
        return self.in_SI(k, coordinates[k])

    def in_SI(self, k: int, coordinate: float) -> float:
        """The value of parameter `k` at a coordinate."""
        return float(np.exp(coordinate) if self.logarithmic[k] else coordinate * self.scale[k])

    def coordinate(self, k: int, value: float) -> float:
        """The coordinate of parameter `k` at a value in SI, at least 1e-300 if its coordinate is a logarithm."""
        return float(np.log(max(value, 1e-300)) if self.logarithmic[k] else value / self.scale[k])

    def with_tied(self, covariance: Float[np.ndarray, "n n"]) -> tuple[tuple[str, ...], Float[np.ndarray, "m m"]]:
        """Names and covariance of the free parameters, and of those that are tied to one of them: of their logarithms,
        and of those with linear coordinates in SI."""
        tied = {target: source for target, source in self.ties if source in self.names}
        rows = [self.names.index(tied.get(name, name)) for name in (*self.names, *tied)]
        in_SI = covariance * np.outer(self.scale, self.scale)
        return (*self.names, *tied), in_SI[np.ix_(rows, rows)]


def unit_of(name: str) -> str:
    """Unit of a parameter of the motor or of an effect."""
    if name in PARAMETERS:
        return PARAMETERS[name]
    effect, field = name.split(".")
    return range_of(effect, field).unit


def effects_named(names: Sequence[str]) -> tuple[type[AbstractEffect], ...]:
    """Effect classes by name; raises `InputError` on an unknown one."""
    if isinstance(names, str):
        raise InputError("effects", f"{names!r} is a text", f'Give a list, such as ["{names}"]')
    for name in names:
        if name not in EFFECTS:
            raise InputError("--effect", f"unknown effect {name}", f"Choose from {', '.join(EFFECTS)}")
    return tuple(EFFECTS[name] for name in dict.fromkeys(names))


def check_names(option: str, names: Sequence[str]) -> None:
    """Raise `InputError` for a name that is not a parameter of the motor."""
    for name in names:
        if name not in PARAMETERS:
            raise InputError(option, f"unknown parameter {name}", f"Choose from {', '.join(PARAMETERS)}")

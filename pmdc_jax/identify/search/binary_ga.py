"""The binary genetic algorithm of the wheelchair-motor paper, as an evosax algorithm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from evosax.algorithms.population_based.base import Params as BaseParams
from evosax.algorithms.population_based.base import PopulationBasedAlgorithm
from evosax.algorithms.population_based.base import State as BaseState
from flax import struct
from jaxtyping import Array, Bool, Float


@struct.dataclass
class State(BaseState):
    """Population in the unit cube and its fitness."""

    # numbers to the base class, traced arrays under jit
    best_fitness: Any
    generation_counter: Any
    population: jax.Array
    fitness: jax.Array


@struct.dataclass
class Params(BaseParams):
    """Probabilities of the paper: crossover 0.75, mutation of a bit 0.04."""

    crossover_rate: float | jax.Array = 0.75
    mutation_rate: float | jax.Array = 0.04


class BinaryGA(PopulationBasedAlgorithm):
    """Binary chromosomes, rank-based roulette selection, one-point crossover, bit-flip mutation and elitism.

    Each of the `n` coordinates of the unit cube is coded in `bits` bits: 60 in all for the paper's six
    parameters. Population 20, crossover rate 0.75 and mutation rate 0.04 are the paper's.

    **Source**: PECCON 2017, section III; Goldberg, "Genetic Algorithms in Search, Optimization and Machine
    Learning", chapters 1 and 3.
    """

    def __init__(
        self, population_size: int, solution: Float[Array, " n"], bits: int = 10, **kwargs: Callable[..., Any]
    ) -> None:
        super().__init__(population_size, solution, **kwargs)
        self.bits = bits

    @property
    def _default_params(self) -> Params:
        return Params()

    def _init(self, key: jax.Array, params: Params) -> State:
        del key, params
        return State(
            population=jnp.full((self.population_size, self.num_dims), jnp.nan),
            fitness=jnp.full(self.population_size, jnp.inf),
            best_solution=jnp.full(self.num_dims, jnp.nan),
            best_fitness=jnp.inf,
            generation_counter=0,
        )

    def _ask(self, key: jax.Array, state: State, params: Params) -> tuple[jax.Array, State]:
        select, mate, cut, flip = jax.random.split(key, 4)
        size, length = self.population_size, self.num_dims * self.bits
        rank = jnp.argsort(jnp.argsort(state.fitness))
        chance = (size - rank) / (size * (size + 1) / 2)
        parents = jax.random.choice(select, size, (2, size), p=chance)
        first, second = self._encode(state.population)[parents]
        # a cut is always inside the chromosome, so that crossover takes genes from both parents
        point = jax.random.randint(cut, (size, 1), 1, length)
        crossed = jax.random.uniform(mate, (size, 1)) < params.crossover_rate
        child = jnp.where(crossed & (jnp.arange(length) >= point), second, first)
        child ^= jax.random.uniform(flip, child.shape) < params.mutation_rate
        best = state.population[jnp.argmin(state.fitness)]
        return self._decode(child).at[0].set(best), state

    def _tell(
        self, key: jax.Array, population: Float[Array, "p n"], fitness: Float[Array, " p"], state: State, params: Params
    ) -> State:
        del key, params
        return state.replace(population=population, fitness=fitness)

    def _encode(self, population: Float[Array, "p n"]) -> Bool[Array, "p length"]:
        level = jnp.round(jnp.clip(population, 0, 1) * (2**self.bits - 1)).astype(jnp.int32)
        return ((level[:, :, None] >> jnp.arange(self.bits)) & 1).reshape(len(population), -1) > 0

    def _decode(self, chromosomes: Bool[Array, "p length"]) -> Float[Array, "p n"]:
        bits = chromosomes.reshape(len(chromosomes), self.num_dims, self.bits)
        return (bits << jnp.arange(self.bits)).sum(-1) / (2**self.bits - 1.0)

"""Global search: evolutionary algorithms over whole populations of motors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...errors import InputError
from ...progress import ReportProgress
from ...runtime.compiled import quickly_compiled, strongly_typed
from ...simulate import Tape, squared_errors
from ..parameters import Parameters

if TYPE_CHECKING:
    from evosax.algorithms.base import EvolutionaryAlgorithm, Params, State


class Method(NamedTuple):
    """A search: its evosax algorithm, and the default population and number of generations."""

    algorithm: Callable[[], type]
    population: int
    generations: int
    distribution: bool = False  # evolves a distribution that starts from a mean, not a population


def _binary_ga() -> type:
    from .binary_ga import BinaryGA

    return BinaryGA


def _evosax(name: str) -> Callable[[], type]:
    def load() -> type:
        from evosax import algorithms

        return getattr(algorithms, name)

    return load


METHODS: Mapping[str, Method] = {
    "cma_es": Method(_evosax("CMA_ES"), 32, 24, distribution=True),
    "paper_ga": Method(_binary_ga, 20, 200),
    "differential_evolution": Method(_evosax("DifferentialEvolution"), 128, 80),
    "particle_swarm": Method(_evosax("PSO"), 128, 40),
}

# A distribution starts from the best of this many candidates scattered over the bounds.
INITIAL_CANDIDATES = 256
# ... with this standard deviation in the unit cube: the best of that many is not far from the optimum.
INITIAL_SPREAD = 0.15

# The search may stop after some generations, once the best tenth of the population agree this well in every coordinate,
# most of which are natural logarithms.
MIN_GENERATIONS, AGREEMENT = 10, 0.1
# Most candidates that are kept
MAX_CANDIDATES = 2000


class SearchResult(NamedTuple):
    """The result of a search."""

    candidates: np.ndarray  # (kept, parameters) coordinates, best first
    fitness: np.ndarray  # (kept,)
    best: np.ndarray  # (generations,)
    median: np.ndarray  # (generations,)
    evaluations: int
    interrupted: bool


class _Generation(NamedTuple):
    """Evaluated points of the unit cube, and their fitness."""

    cube: np.ndarray
    fitness: np.ndarray

    def agrees(self, width: np.ndarray) -> bool:
        """Whether the best tenth agree, given the width of the bounds."""
        elite = self.cube[np.argsort(self.fitness)[: len(self.cube) // 10 + 1]]
        return bool(np.all(np.ptp(width * elite, axis=0) < AGREEMENT))


def global_search(
    parameters: Parameters,
    tape: Tape,
    noise: np.ndarray,
    method: str = "cma_es",
    seed: int = 0,
    population: int | None = None,
    generations: int | None = None,
    progress: ReportProgress | None = None,
    guess: Mapping[str, float] | None = None,
) -> SearchResult:
    """Search the bounds of `parameters` for motors that reproduce the tape.

    The fitness is the paper's equation (10), F1 + a F2 (mean square speed error plus a times mean square current
    error, both over the samples of the output that has more), divided by the noise variance of the speed. With a the
    ratio of the noise variances of speed and current, a perfect model has fitness 2, or 1 with a single output. Failed
    simulations count as infinitely bad.

    **Arguments**: `noise`, standard deviations of current (A) and speed (rad/s); `method`, a key of `METHODS`;
    `population` and `generations`, by default the method's own; `progress`, called in every generation; `guess`, values
    of some parameters in SI, with which the first candidate is tried.
    An interrupt from the keyboard ends the search with the candidates found so far.

    **Raises**: `InputError` on an unknown method, or a seed that is negative or does not fit into 63 bits.
    """
    if not 0 <= seed < 2**63:
        raise InputError("--seed", f"{seed} is negative or too large", "Give a number from 0 to 2**63 - 1")
    if method not in METHODS:
        raise InputError("--search", f"unknown search {method}", f"Choose from {', '.join(METHODS)}")
    chosen = METHODS[method]
    size, rounds = population or chosen.population, generations or chosen.generations
    low, high = np.asarray(parameters.lower), np.asarray(parameters.upper)
    fitness_of = _Fitness(parameters, tape, noise)

    start = _scattered(seed, INITIAL_CANDIDATES if chosen.distribution else size, len(low))
    if guess:
        start[0] = _cube_of(parameters, guess)
    first = _Generation(start, fitness_of.scattered(start, size))
    later = _later_generations(Kind(method, size, len(low)), seed, first, fitness_of)
    evaluated = [first]
    interrupted = False
    try:
        for number, generation in zip(range(1, rounds), later, strict=False):
            evaluated.append(generation)
            if progress:
                best = min(each.fitness.min() for each in evaluated)
                progress(f"searching, generation {number}", float(best), number / rounds)
            if number > MIN_GENERATIONS and generation.agrees(high - low):
                break
    except KeyboardInterrupt:
        interrupted = True
    return _collect(evaluated, low, high, interrupted)


def _later_generations(kind: Kind, seed: int, first: _Generation, fitness_of: _Fitness) -> Iterator[_Generation]:
    """The generations after the first one, without end."""
    seeds, best = np.asarray(seed), first.cube[np.argmin(first.fitness)]
    asked, state = _first_points(kind, seeds, *((best,) if METHODS[kind.method].distribution else first))
    for number in count(1):
        cube = np.asarray(asked)
        generation = _Generation(cube, fitness_of(cube))
        yield generation
        asked, state = _next_points(kind, seeds, np.asarray(number), *generation, state)


Value = Array | np.ndarray


class Kind(NamedTuple):
    """What the programs of a search are compiled for."""

    method: str
    population: int
    dimensions: int


# Two compiled programs, because evosax called step by step compiles dozens. They pass the state of its algorithm on as
# a tuple, so that with cached programs evosax need not even be imported.

Leaves = tuple[Array, ...]  # of evosax's state
Asked = tuple[Float[Array, "population dimensions"], Leaves]


@quickly_compiled
def _first_points(kind: Kind, seed: Value, *start: Value) -> Asked:
    """The first points of the unit cube to evaluate, (population, dimensions), and the state of the algorithm."""
    algorithm, settings = _algorithm(kind)
    state = algorithm.init(jax.random.key(seed), *start, settings)
    return _asked(*algorithm.ask(_keys(seed, 1)[0], state, settings))


@quickly_compiled
def _next_points(kind: Kind, seed: Value, generation: Value, cube: Value, fitness: Value, state: Leaves) -> Asked:
    """The next points to evaluate, given the fitness of those of the `cube`, and the state of the algorithm."""
    algorithm, settings = _algorithm(kind)
    start = (cube[0],) if METHODS[kind.method].distribution else (cube, fitness)
    like = algorithm.init(jax.random.key(0), *start, settings)
    whole = jax.tree.unflatten(jax.tree.structure(like), state)
    whole, _ = algorithm.tell(_keys(seed, generation)[1], cube, fitness, whole, settings)
    return _asked(*algorithm.ask(_keys(seed, generation + 1)[0], whole, settings))


def _asked(points: Array, state: State) -> Asked:
    return jnp.clip(points, 0.0, 1.0), tuple(jax.tree.leaves(strongly_typed(state)))


def _keys(seed: Value, generation: Value | int) -> Array:
    return jax.random.split(jax.random.fold_in(jax.random.key(seed), generation))


def _algorithm(kind: Kind) -> tuple[EvolutionaryAlgorithm, Params]:
    """evosax's algorithm and its settings; within a trace, because outside each operation is compiled by itself."""
    method = METHODS[kind.method]
    algorithm = method.algorithm()(kind.population, jnp.zeros(kind.dimensions))
    settings = algorithm.default_params
    return algorithm, settings.replace(std_init=INITIAL_SPREAD) if method.distribution else settings


class _Fitness:
    """Fitness of a population: points of the unit cube (population, parameters) to (population,)."""

    def __init__(self, parameters: Parameters, tape: Tape, noise: np.ndarray) -> None:
        self.parameters, self.noise = parameters, noise
        self.low, self.high = np.asarray(parameters.lower), np.asarray(parameters.upper)
        # transferred to the device once instead of in every generation
        self.tape: Tape = jax.tree.map(jnp.asarray, tape)
        self.most_samples = max(float(np.asarray(tape.weight).sum((0, 2)).max()), 1.0)

    def scattered(self, cube: np.ndarray, size: int) -> np.ndarray:
        """The fitness of many candidates, in populations of about `size`, for which the simulation is compiled."""
        parts = np.array_split(cube, max(1, len(cube) // size))
        return np.concatenate([self(part) for part in parts])

    def __call__(self, cube: np.ndarray) -> np.ndarray:
        motors = _motors(self.parameters, self.low + (self.high - self.low) * cube)
        errors = np.stack([np.asarray(e) for e in squared_errors(motors, self.tape)])
        mean_squares = errors / self.noise[:, None] ** 2 / self.most_samples
        return np.minimum(mean_squares.sum(0), 1e300)


_motors = eqx.filter_jit(lambda parameters, coordinates: parameters(coordinates))


def _scattered(seed: int, size: int, dimensions: int) -> np.ndarray:
    """A Latin hypercube: every parameter's range covered evenly, whatever the population."""
    rng = np.random.default_rng(seed)
    strata = np.stack([rng.permutation(size) for _ in range(dimensions)], axis=1)
    return (strata + rng.random(strata.shape)) / size


def _cube_of(parameters: Parameters, guess: Mapping[str, float]) -> np.ndarray:
    """The point of the unit cube with some values, within the bounds; all others in the middle."""
    point = np.full(len(parameters.names), 0.5)
    for k, name in enumerate(parameters.names):
        if name in guess:
            low, high = float(parameters.lower[k]), float(parameters.upper[k])
            point[k] = np.clip((parameters.coordinate(k, guess[name]) - low) / (high - low), 0.0, 1.0)
    return point


def _collect(evaluated: Sequence[_Generation], low: np.ndarray, high: np.ndarray, interrupted: bool) -> SearchResult:
    cubes = np.concatenate([each.cube for each in evaluated])
    fitness = np.concatenate([each.fitness for each in evaluated])
    order = np.argsort(fitness, kind="stable")[:MAX_CANDIDATES]
    return SearchResult(
        candidates=low + (high - low) * cubes[order],
        fitness=fitness[order],
        best=np.minimum.accumulate([each.fitness.min() for each in evaluated]),
        median=np.array([np.median(each.fitness) for each in evaluated]),
        evaluations=len(fitness),
        interrupted=interrupted,
    )

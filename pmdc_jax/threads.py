"""Work side by side on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import ParamSpec, TypeVar

import jax

A = TypeVar("A")
P = ParamSpec("P")
T = TypeVar("T")

CORES = os.cpu_count() or 1


def side_by_side(function: Callable[[A], T], items: Iterable[A]) -> list[T]:
    """What a function makes of every item, as many at a time as there are cores. Not to be nested."""
    return [future.result() for future in [beside(function, item) for item in items]]


def side_by_side_until(
    function: Callable[[A], T], items: Sequence[A], enough: Callable[[list[T]], bool]
) -> list[T]:
    """The same, until what was made so far is `enough`."""
    made: list[T] = []
    for first in range(0, len(items), CORES):
        made += side_by_side(function, items[first : first + CORES])
        if enough(made):
            break
    return made


def one_ahead(calls: Iterable[Callable[[], T]]) -> Iterator[T]:
    """What calls return, in their order, while the next one is made on another core already. Not to be nested."""
    waiting: Future[T] | None = None
    for call in calls:
        before, waiting = waiting, beside(call)
        if before is not None:
            yield before.result()
    if waiting is not None:
        yield waiting.result()


def beside(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
    """A call that goes on beside what the caller does, in the caller's precision, which JAX keeps for each thread."""
    double = jax.config.read("jax_enable_x64")

    def call() -> T:
        with jax.enable_x64(double):
            return function(*args, **kwargs)

    return _threads().submit(call)


@cache
def _threads() -> ThreadPoolExecutor:
    """Kept: in a new thread the first call takes a millisecond longer than the next."""
    return ThreadPoolExecutor(CORES)

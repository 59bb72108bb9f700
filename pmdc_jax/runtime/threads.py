"""Parallel work in threads on all cores: those here, and not those of BLAS."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from typing import Generic, ParamSpec, TypeVar

import jax
from threadpoolctl import threadpool_limits

A = TypeVar("A")
P = ParamSpec("P")
T = TypeVar("T")

CORES = os.cpu_count() or 1
# Results that may wait to be used, to limit the memory
MAX_AHEAD = 4

_this_thread = threading.local()


class Task(Generic[T]):
    """A call in another thread."""

    def __init__(self, call: Callable[[], T]) -> None:
        self._call, self._future = call, _threads().submit(call)

    def result(self) -> T:
        """The result, waited for. One of the threads makes a call itself that none of them has begun: all may be at
        work, or waiting for others."""
        if getattr(_this_thread, "is_worker", False) and self._future.cancel():
            return self._call()
        return self._future.result()


def one_blas_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Run a public function with BLAS on one thread.

    BLAS divides even small products among threads, and where other work keeps the cores busy each of them waits a time
    slice for the others: measured, a hundred times as long as on one thread.
    """

    @wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return wrapped


def map_in_threads(function: Callable[[A], T], items: Iterable[A]) -> list[T]:
    """Results of a function for every item, computed in parallel on all cores."""
    return [task.result() for task in [submit(function, item) for item in items]]


def map_in_threads_until(function: Callable[[A], T], items: Sequence[A], enough: Callable[[list[T]], bool]) -> list[T]:
    """The same, until the results of the first items are `enough`: computed in batches of one item per core, but
    counted one by one, so that the answer does not depend on the number of cores."""
    made: list[T] = []
    for first in range(0, len(items), CORES):
        for result in map_in_threads(function, items[first : first + CORES]):
            made.append(result)
            if enough(made):
                return made
    return made


def run_ahead(calls: Iterable[Callable[[], T]]) -> Iterator[T]:
    """Results of calls in their order, with some of the next ones running in other threads: one for every core, but at
    most `MAX_AHEAD`."""
    waiting: deque[Task[T]] = deque()
    for call in calls:
        waiting.append(submit(call))
        if len(waiting) > min(CORES, MAX_AHEAD):
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def submit(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Task[T]:
    """Run a call in another thread, with the caller's precision, which JAX keeps for each thread."""
    double = jax.config.read("jax_enable_x64")

    def call() -> T:
        _this_thread.is_worker = True
        with jax.enable_x64(double):
            return function(*args, **kwargs)

    return Task(call)


@cache
def _threads() -> ThreadPoolExecutor:
    """The threads, kept because the first call in a new thread takes a millisecond longer than later ones."""
    return ThreadPoolExecutor(CORES)

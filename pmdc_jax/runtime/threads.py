"""Parallel work in threads on all cores."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import ParamSpec, TypeVar

import jax

A = TypeVar("A")
P = ParamSpec("P")
T = TypeVar("T")

CORES = os.cpu_count() or 1
# Results that may wait to be used, to limit the memory
MAX_AHEAD = 4

_this_thread = threading.local()


def map_in_threads(function: Callable[[A], T], items: Iterable[A]) -> list[T]:
    """Results of a function for every item, computed in parallel on all cores."""
    return [future.result() for future in [submit(function, item) for item in items]]


def map_in_threads_until(
    function: Callable[[A], T], items: Sequence[A], enough: Callable[[list[T]], bool]
) -> list[T]:
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
    waiting: deque[Future[T]] = deque()
    for call in calls:
        waiting.append(submit(call))
        if len(waiting) > min(CORES, MAX_AHEAD):
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def submit(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
    """Run a call in another thread, with the caller's precision, which JAX keeps for each thread.

    In such a thread the call runs at once: all cores are at work, and waiting for another thread could deadlock.
    """
    if getattr(_this_thread, "is_worker", False):
        done: Future[T] = Future()
        done.set_result(function(*args, **kwargs))
        return done
    double = jax.config.read("jax_enable_x64")

    def call() -> T:
        _this_thread.is_worker = True
        with jax.enable_x64(double):
            return function(*args, **kwargs)

    return _threads().submit(call)


@cache
def _threads() -> ThreadPoolExecutor:
    """The threads, kept because the first call in a new thread takes a millisecond longer than later ones."""
    return ThreadPoolExecutor(CORES)

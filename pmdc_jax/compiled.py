"""What JAX compiles: kept by the command, in less time what runs but a few times, and room for it where much is run."""

from __future__ import annotations

import hashlib
import os
import pickle
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from functools import cache, wraps
from importlib.metadata import version
from pathlib import Path
from threading import Lock, get_ident
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import serialize_executable

from .compilation_cache import programs
from .files import replacing

P = ParamSpec("P")
T = TypeVar("T")
Leaf = jax.Array | np.ndarray

# Without its newer emitter of kernels XLA compiles in two thirds of the time. What it makes is as fast but for dry
# friction and teeth, which take a quarter longer.
QUICKLY = {"xla_cpu_use_fusion_emitters": False}
# What else decides what a function of this package is compiled to
LIBRARIES = (
    "jax",
    "jaxlib",
    "equinox",
    "diffrax",
    "lineax",
    "optimistix",
    "optax",
    "evosax",
    "numpy",
)
FLAGS = "XLA_FLAGS"
# Bytes of programs that are kept; a diagnosis of recordings of a new shape leaves a few million
MOST = 500_000_000

# Where Linux lists a process's memory maps, and says how many it may have
MAPS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Share of them that must be free before new recordings are begun with: a diagnosis takes up to a quarter
FREE = 0.5


class Program(NamedTuple):
    """A function compiled for arguments of one kind, from their arrays to those of what it returns."""

    run: jax.stages.Compiled
    structure: Any  # of the tree of arrays that it returns
    others: Any  # what it returns besides


_programs: dict[str, Program] = {}
_locks: defaultdict[str, Lock] = defaultdict(Lock)


def compiled(function: Callable[P, T], options: dict[str, Any] | None = None) -> Callable[P, T]:
    """`equinox.filter_jit` whose programs the command keeps. JAX itself keeps what XLA makes of a traced function, and
    traces it anew in every process, which takes longer than all else.

    Called from compiled code, from a library that keeps nothing, or with a function within another one, it is
    `equinox.filter_jit`.

    **Arguments**: `function` of this package, which returns arrays, in tuples perhaps, but no modules of equinox, for
    these cannot be written and read; `options` of XLA.
    """
    # within compiled code there are no options but its own
    within = eqx.filter_jit(function)

    @cache
    def alone() -> Callable[P, T]:
        known = _known(options)
        return eqx.filter_jit(function, compiler_options=known)  # pyright: ignore[reportCallIssue]

    if "<" in function.__qualname__:
        return alone()

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return within(*args, **kwargs)
        if programs() is None:
            return alone()(*args, **kwargs)
        arrays, static = eqx.partition((args, kwargs), eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        try:
            key = _key(function, options, leaves, structure, static)
        except (pickle.PicklingError, AttributeError, TypeError):
            return alone()(*args, **kwargs)

        def of_arrays(*leaves: Leaf) -> T:
            args, kwargs = eqx.combine(structure.unflatten(leaves), static)
            # not the function itself: traces within other compiled code are found again
            return cast(Callable, within)(*args, **kwargs)

        with _locks[key]:
            program = _programs.get(key) or _kept(key) or _made(key, of_arrays, leaves, options)
            _programs[key] = program
        returned = program.structure.unflatten(program.run(*leaves))
        return cast(T, eqx.combine(returned, program.others))

    return call


def quickly_compiled(function: Callable[P, T]) -> Callable[P, T]:
    """`compiled` for what takes longer to compile than it ever runs."""
    return compiled(function, QUICKLY)


def _known(options: dict[str, Any] | None) -> dict[str, Any] | None:
    """Those options that XLA has in this version: they come and go."""
    return {k: v for k, v in options.items() if _is_known(k, v)} if options else None


@cache
def _is_known(option: str, value: Any) -> bool:
    try:
        jax.jit(jnp.negative).lower(0.0).compile({option: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


def make_room() -> None:
    """Forget what was compiled for earlier recordings, if it leaves little room for more.

    Each shape of recordings is compiled for, each program takes some memory maps, and a process that has as many as
    Linux allows is killed: after some twelve diagnoses. Elsewhere nothing is done.
    """
    if not (MAPS.exists() and LIMIT.exists()):
        return
    with MAPS.open("rb") as lines:
        used = sum(1 for _ in lines)
    if used > (1 - FREE) * int(LIMIT.read_text()):
        _programs.clear()
        jax.clear_caches()


def _key(
    function: Callable,
    options: dict[str, Any] | None,
    leaves: Sequence[Leaf],
    structure: Any,  # of the tree of arrays
    static: Any,  # what there is besides
) -> str:
    """The name of a program: of all that decides what it is."""
    kinds = [(x.shape, str(x.dtype), getattr(x, "weak_type", False)) for x in leaves]
    double = jax.config.read("jax_enable_x64")
    of = (function.__module__, function.__qualname__, options, kinds, structure, static, double)
    return hashlib.sha256(pickle.dumps((_source(), of))).hexdigest()


@cache
def _source() -> str:
    """This package and what it builds on."""
    files = sorted(Path(__file__).parent.rglob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    built_on = [jax.default_backend(), os.environ.get(FLAGS, ""), *map(version, LIBRARIES)]
    return hashlib.sha256(" ".join([digest, *built_on]).encode()).hexdigest()[:16]


def _kept(key: str) -> Program | None:
    """A program that an earlier process kept, None without one that can be read."""
    path = _path(key)
    try:
        kept = zlib.decompress(path.read_bytes())
        _find_lapack()
        serialized, structure, others = pickle.loads(kept)
        program = serialize_executable.deserialize_and_load(*serialized)
        os.utime(path)
    # there is none, or it is damaged: whatever is wrong, another one is made
    except Exception:
        return None
    return Program(program, structure, others)


@cache
def _find_lapack() -> None:
    """JAX looks for it when it first lowers what calls it; a program that was kept calls it as if it had been found."""
    jax.block_until_ready(jnp.linalg.cholesky(jnp.eye(1)))


def _made(
    key: str, function: Callable, leaves: Sequence[Leaf], options: dict[str, Any] | None
) -> Program:
    """A program compiled now, and kept where it can be."""
    returned: list[Any] = []

    def flat(*leaves: Leaf) -> list[Leaf]:
        arrays, others = eqx.partition(function(*leaves), eqx.is_array)
        out, structure = jax.tree.flatten(arrays)
        returned[:] = structure, others
        return out

    # XLA's part is kept by JAX under this name, too, and found there only if the same program was not kept here
    flat.__name__ = f"program_{key}"
    lowered = jax.jit(flat).lower(*leaves)
    found = _found_by_jax()  # what it finds for the small steps of a trace does not count
    run = lowered.compile(_known(options))
    structure, others = returned
    if _found_by_jax() == found:  # what JAX had kept cannot be taken apart again
        try:
            serialized = serialize_executable.serialize(run)
            content = pickle.dumps((serialized, structure, others))
            _write(_path(key), zlib.compress(content, level=1))
        # XLA cannot write it, or the disk is full: then it is made anew the next time
        except Exception:
            pass
    return Program(run, structure, others)


def _found_by_jax() -> int:
    """How many programs JAX has found in its own cache for this thread."""
    return _hits()[get_ident()]


@cache
def _hits() -> Counter[int]:
    hits: Counter[int] = Counter()

    def count(event: str, **_: str | int) -> None:
        hits[get_ident()] += event == "/jax/compilation_cache/cache_hits"

    jax.monitoring.register_event_listener(count)
    return hits


def _path(key: str) -> Path:
    folder = programs()
    assert folder is not None
    return folder / key


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    _tidy(path.parent)
    with replacing(path) as part:
        part.write_bytes(content)


@cache
def _tidy(folder: Path) -> None:
    """Once in a process: without what was not used for longest, where there is too much."""
    files = [(path.stat().st_mtime, path.stat().st_size, path) for path in folder.iterdir()]
    spare = sum(size for _, size, _ in files) - MOST
    for _, size, path in sorted(files):
        if spare <= 0:
            break
        path.unlink(missing_ok=True)
        spare -= size

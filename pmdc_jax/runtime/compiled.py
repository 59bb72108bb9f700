"""Compilation: programs that the command keeps on disk, quick compilation of what runs rarely, and freeing of old
programs."""

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

from ..files import replacing
from .compilation_cache import programs

P = ParamSpec("P")
T = TypeVar("T")
Leaf = jax.Array | np.ndarray

# Without its newer kernel emitters XLA compiles in two thirds of the time. The programs are as fast, except with dry
# friction and teeth, where they take a quarter longer.
QUICK_OPTIONS = {"xla_cpu_use_fusion_emitters": False}
# Libraries whose versions affect what a function of this package is compiled to
LIBRARIES = ("jax", "jaxlib", "equinox", "diffrax", "lineax", "optimistix", "optax", "evosax", "numpy")
# Most bytes of programs on disk; a diagnosis of recordings of a new shape adds a few million
MAX_DISK_BYTES = 500_000_000

# Where Linux lists the memory maps of this process, and their largest number
MAPS_FILE, MAP_LIMIT_FILE = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Share of the maps that must be free before work on new recordings: a diagnosis takes up to a quarter
MIN_FREE_SHARE = 0.5


class Program(NamedTuple):
    """A function compiled for arguments of one kind: it maps their arrays to the arrays of the result."""

    run: jax.stages.Compiled
    structure: Any  # of the tree of the result's arrays
    non_arrays: Any  # the rest of the result


_programs: dict[str, Program] = {}
_locks: defaultdict[str, Lock] = defaultdict(Lock)


def compiled(function: Callable[P, T], options: dict[str, Any] | None = None) -> Callable[P, T]:
    """`equinox.filter_jit` whose programs the command keeps on disk. JAX's own cache keeps only what XLA makes of a
    traced function, which every process traces anew; that takes longer than everything else.

    It is plain `equinox.filter_jit` for calls from compiled code, for a function defined within another one, and where
    no programs are kept, as in use as a library.

    **Arguments**: `function` of this package, which returns arrays, possibly in tuples, but no Equinox modules, because
    these cannot be written and read; `options`, XLA's.
    """
    # within compiled code the options of the outer function apply
    inlined = eqx.filter_jit(function)

    @cache
    def jitted() -> Callable[P, T]:
        supported = _supported(options)
        return eqx.filter_jit(function, compiler_options=supported)  # pyright: ignore[reportCallIssue]

    if "<" in function.__qualname__:
        return jitted()

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if _is_traced(args, kwargs):
            return inlined(*args, **kwargs)
        if programs() is None:
            return jitted()(*args, **kwargs)
        arrays, static = eqx.partition((args, kwargs), eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        try:
            key = _key(function, options, leaves, structure, static)
        except (pickle.PicklingError, AttributeError, TypeError):
            return jitted()(*args, **kwargs)

        def of_arrays(*leaves: Leaf) -> T:
            args, kwargs = eqx.combine(structure.unflatten(leaves), static)
            # instead of `function`, so that its trace is shared with calls from other compiled code
            return cast(Callable, inlined)(*args, **kwargs)

        with _locks[key]:
            program = _programs.get(key) or _load(key) or _compile(key, of_arrays, leaves, options)
            _programs[key] = program
        returned = program.structure.unflatten(program.run(*leaves))
        return cast(T, eqx.combine(returned, program.non_arrays))

    return call


def strongly_typed(tree: T) -> T:
    """Arrays with strong types, as arithmetic returns them: for weak ones, as of constants, the program that takes them
    would be compiled separately."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), tree)


def _is_traced(*values: object) -> bool:
    """Whether a call with these arguments comes from code that is being compiled."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def quickly_compiled(function: Callable[P, T]) -> Callable[P, T]:
    """`compiled` for what takes longer to compile than it ever runs."""
    return compiled(function, QUICK_OPTIONS)


def _supported(options: dict[str, Any] | None) -> dict[str, Any] | None:
    """Those options that this version of XLA has: they change between versions."""
    return {k: v for k, v in options.items() if _is_supported(k, v)} if options else None


@cache
def _is_supported(option: str, value: Any) -> bool:
    try:
        jax.jit(jnp.negative).lower(0.0).compile({option: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


def free_memory_maps() -> None:
    """Drop the programs compiled for earlier recordings if few memory maps are left.

    Every new shape of recordings needs new programs, each takes some memory maps, and a process that reaches Linux's
    limit is killed: after about twelve diagnoses. Does nothing on other systems.
    """
    if not (MAPS_FILE.exists() and MAP_LIMIT_FILE.exists()):
        return
    with MAPS_FILE.open("rb") as lines:
        used = sum(1 for _ in lines)
    if used > (1 - MIN_FREE_SHARE) * int(MAP_LIMIT_FILE.read_text()):
        _programs.clear()
        jax.clear_caches()


def _key(
    function: Callable,
    options: dict[str, Any] | None,
    leaves: Sequence[Leaf],
    structure: Any,  # of the tree of arrays
    static: Any,  # the rest of the arguments
) -> str:
    """The name of a program: a hash of everything that determines it."""
    kinds = [(x.shape, str(x.dtype), getattr(x, "weak_type", False)) for x in leaves]
    double = jax.config.read("jax_enable_x64")
    identity = (function.__module__, function.__qualname__, options, kinds, structure, static, double)
    return hashlib.sha256(pickle.dumps((_environment_hash(), identity))).hexdigest()


@cache
def _environment_hash() -> str:
    """Hash of source code, backend, XLA flags and library versions."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    built_on = [jax.default_backend(), os.environ.get("XLA_FLAGS", ""), *map(version, LIBRARIES)]
    return hashlib.sha256(" ".join([digest, *built_on]).encode()).hexdigest()[:16]


def _load(key: str) -> Program | None:
    """A program that an earlier process kept; None if there is none that can be read."""
    path = _path(key)
    try:
        kept = zlib.decompress(path.read_bytes())
        _load_lapack()
        serialized, structure, non_arrays = pickle.loads(kept)
        program = serialize_executable.deserialize_and_load(*serialized)
        os.utime(path)
    # missing or damaged: whatever is wrong, it is compiled anew
    except Exception:
        return None
    return Program(program, structure, non_arrays)


@cache
def _load_lapack() -> None:
    """Have JAX load LAPACK, which it does when it first lowers a function that calls it; a program read from disk calls
    it without that."""
    jax.block_until_ready(jnp.linalg.cholesky(jnp.eye(1)))


def _compile(key: str, function: Callable, leaves: Sequence[Leaf], options: dict[str, Any] | None) -> Program:
    """A program compiled now, and kept if possible."""
    returned: list[Any] = []

    def flat(*leaves: Leaf) -> list[Leaf]:
        arrays, non_arrays = eqx.partition(function(*leaves), eqx.is_array)
        out, structure = jax.tree.flatten(arrays)
        returned[:] = structure, non_arrays
        return out

    # JAX's own cache stores the executable under this name too; it is read from there only if it was not kept here
    flat.__name__ = f"program_{key}"
    lowered = jax.jit(flat).lower(*leaves)
    hits_before = _jax_cache_hits()  # hits for small operations during the trace do not count
    run = lowered.compile(_supported(options))
    structure, non_arrays = returned
    if _jax_cache_hits() == hits_before:  # an executable from JAX's cache cannot be serialized
        try:
            serialized = serialize_executable.serialize(run)
            content = pickle.dumps((serialized, structure, non_arrays))
            _write(_path(key), zlib.compress(content, level=1))
        # XLA cannot serialize it, or the disk is full: then it is compiled anew the next time
        except Exception:
            pass
    return Program(run, structure, non_arrays)


def _jax_cache_hits() -> int:
    """Number of programs that JAX has found in its own cache for this thread."""
    return _cache_hits_by_thread()[get_ident()]


@cache
def _cache_hits_by_thread() -> Counter[int]:
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
    _delete_least_recently_used(path.parent)
    with replacing(path) as part:
        part.write_bytes(content)


@cache
def _delete_least_recently_used(folder: Path) -> None:
    """Delete the least recently used programs beyond `MAX_DISK_BYTES`, once in a process."""
    files = [(path.stat().st_mtime, path.stat().st_size, path) for path in folder.iterdir()]
    spare = sum(size for _, size, _ in files) - MAX_DISK_BYTES
    for _, size, path in sorted(files):
        if spare <= 0:
            break
        path.unlink(missing_ok=True)
        spare -= size

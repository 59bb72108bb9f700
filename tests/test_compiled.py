"""What is compiled: kept for the next run of the command, and not piled up until the process is killed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pmdc_jax import compiled
from pmdc_jax.compilation_cache import PROGRAMS


class Roots(NamedTuple):
    values: jax.Array
    times: int


def scaled_roots(matrix, times: int) -> Roots:
    """By LAPACK. Says when it is traced."""
    print("traced")
    return Roots(times * jnp.linalg.eigh(matrix).eigenvalues, times)


roots = compiled.compiled(scaled_roots)
MATRIX = np.array([[2.0, 1.0], [1.0, 2.0]])


class Keeping:
    """The programs of one process: which were made, and whether the last one found what it asked for."""

    def __init__(self, monkeypatch, folder: Path):
        self.monkeypatch, self.folder, self.made, make = monkeypatch, folder, [], compiled._compile
        monkeypatch.setenv(PROGRAMS, str(folder))
        monkeypatch.setattr(
            compiled, "_compile", lambda *args: self.made.append(args) or make(*args)
        )
        self.begin_another_process()

    def begin_another_process(self) -> None:
        self.monkeypatch.setattr(compiled, "_programs", {})

    def makes(self, matrix, times: int) -> bool:
        """Whether a call has to make a program; it is right either way."""
        before = len(self.made)
        found = roots(matrix, times)
        assert np.asarray(found.values) == pytest.approx(times * np.array([1.0, 3.0]))
        assert found.times == times
        return len(self.made) > before


@pytest.fixture
def keeping(monkeypatch, tmp_path):
    return Keeping(monkeypatch, tmp_path / "programs")


def test_a_program_is_traced_once_for_all_processes(tmp_path):
    code = "from test_compiled import *; print(roots(MATRIX, 2))"
    environment = os.environ | {PROGRAMS: str(tmp_path), "JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    run = [sys.executable, "-c", code]
    here = Path(__file__).parent
    first, second = (
        subprocess.run(run, check=True, capture_output=True, text=True, env=environment, cwd=here)
        for _ in range(2)
    )
    assert first.stdout == "traced\n" + second.stdout
    assert second.stdout.startswith("Roots(")


def test_another_argument_is_another_program(x64, keeping, monkeypatch):
    assert keeping.makes(MATRIX, 2)
    assert not keeping.makes(MATRIX, 2)
    assert keeping.makes(MATRIX, 3)
    assert keeping.makes(MATRIX.astype(np.float32), 2)
    keeping.begin_another_process()
    assert not keeping.makes(MATRIX, 2)
    assert not keeping.makes(MATRIX, 3)
    keeping.begin_another_process()
    monkeypatch.setattr(compiled, "_environment_hash", lambda: "a later version")
    assert keeping.makes(MATRIX, 2)


def test_a_damaged_program_is_made_anew(x64, keeping):
    assert keeping.makes(MATRIX, 2)
    (kept,) = keeping.folder.iterdir()
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2])
    keeping.begin_another_process()
    assert keeping.makes(MATRIX, 2)
    assert len(kept.read_bytes()) > len(whole) / 2


def test_what_was_not_used_for_longest_goes_first(keeping, monkeypatch):
    monkeypatch.setattr(compiled, "MAX_DISK_BYTES", 250)
    keeping.folder.mkdir()
    ages = [keeping.folder / f"of age {age}" for age in range(5)]
    for age, path in enumerate(ages):
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    roots(MATRIX, 2)
    assert [path.exists() for path in ages] == [True, True, False, False, False]


def test_in_compiled_code_and_without_a_name_it_is_filter_jit(keeping):
    nameless = compiled.compiled(lambda x: 2 * x)
    assert nameless(jnp.ones(2)).tolist() == [2.0, 2.0]
    inner = jax.jit(lambda matrix: roots(matrix, 2).values)
    assert inner(MATRIX) == pytest.approx([2.0, 6.0])
    assert not keeping.made


@pytest.mark.parametrize(("used", "times"), [(600, 2), (400, 1)], ids=["full", "room"])
def test_what_was_compiled_is_forgotten_only_where_there_is_no_room_for_more(
    tmp_path, monkeypatch, used, times
):
    maps, limit = tmp_path / "maps", tmp_path / "max_map_count"
    maps.write_text("7f00-7f01 r-xp\n" * used)
    limit.write_text("1000\n")
    monkeypatch.setattr(compiled, "MAPS_FILE", maps)
    monkeypatch.setattr(compiled, "MAP_LIMIT_FILE", limit)
    traced = []

    @jax.jit
    def doubled(x):
        traced.append(x)
        return 2 * x

    doubled(jnp.ones(3))
    compiled.free_memory_maps()
    assert doubled(jnp.ones(3)).sum() == 6
    assert len(traced) == times


def test_where_a_system_does_not_say_nothing_is_done(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "MAPS_FILE", tmp_path / "none")
    monkeypatch.setattr(jax, "clear_caches", lambda: pytest.fail("cleared"))
    compiled.free_memory_maps()


def test_what_this_version_of_xla_does_not_know_is_left_out(x64, monkeypatch, tmp_path):
    """JAX 0.11 came without an option of 0.10, and refuses to compile with it."""
    calls = compiled.compiled(scaled_roots, {"xla_of_some_other_version": True})
    for folder in ("", str(tmp_path)):
        monkeypatch.setenv(PROGRAMS, folder)
        assert np.asarray(calls(MATRIX, 1).values) == pytest.approx([1.0, 3.0])

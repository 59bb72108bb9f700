"""Compiled programs: kept on disk between runs of the command, and freed before memory maps run out."""

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

from pmdc_jax.runtime import compiled
from pmdc_jax.runtime.compilation_cache import PROGRAMS


class Eigenvalues(NamedTuple):
    values: jax.Array
    times: int


def scaled_eigenvalues(matrix, times: int) -> Eigenvalues:
    """By LAPACK; prints when it is traced."""
    print("traced")
    return Eigenvalues(times * jnp.linalg.eigh(matrix).eigenvalues, times)


eigenvalues = compiled.compiled(scaled_eigenvalues)
MATRIX = np.array([[2.0, 1.0], [1.0, 2.0]])


class KeptPrograms:
    """The programs kept on disk, as one process after another sees them, with a list of all compilations."""

    def __init__(self, monkeypatch, folder: Path):
        self.monkeypatch, self.folder, self.compilations = monkeypatch, folder, []
        compile_ = compiled._compile
        monkeypatch.setenv(PROGRAMS, str(folder))
        monkeypatch.setattr(compiled, "_compile", lambda *args: self.compilations.append(args) or compile_(*args))
        self.begin_another_process()

    def begin_another_process(self) -> None:
        self.monkeypatch.setattr(compiled, "_programs", {})

    def compiles(self, matrix, times: int) -> bool:
        """Whether a call has to compile; asserts that its result is right either way."""
        before = len(self.compilations)
        found = eigenvalues(matrix, times)
        assert np.asarray(found.values) == pytest.approx(times * np.array([1.0, 3.0]))
        assert found.times == times
        return len(self.compilations) > before


@pytest.fixture
def programs(monkeypatch, tmp_path):
    return KeptPrograms(monkeypatch, tmp_path / "programs")


def test_a_program_is_traced_once_across_processes(tmp_path):
    code = "from test_compiled import *; print(eigenvalues(MATRIX, 2))"
    environment = os.environ | {PROGRAMS: str(tmp_path), "JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    run = [sys.executable, "-c", code]
    here = Path(__file__).parent
    first, second = (
        subprocess.run(run, check=True, capture_output=True, text=True, env=environment, cwd=here) for _ in range(2)
    )
    assert first.stdout == "traced\n" + second.stdout
    assert second.stdout.startswith("Eigenvalues(")


def test_other_arguments_need_another_program(x64, programs, monkeypatch):
    assert programs.compiles(MATRIX, 2)
    assert not programs.compiles(MATRIX, 2)
    assert programs.compiles(MATRIX, 3)
    assert programs.compiles(MATRIX.astype(np.float32), 2)
    programs.begin_another_process()
    assert not programs.compiles(MATRIX, 2)
    assert not programs.compiles(MATRIX, 3)
    programs.begin_another_process()
    monkeypatch.setattr(compiled, "_environment_hash", lambda: "a later version")
    assert programs.compiles(MATRIX, 2)


def test_a_damaged_program_is_compiled_again(x64, programs):
    assert programs.compiles(MATRIX, 2)
    (program,) = programs.folder.iterdir()
    content = program.read_bytes()
    program.write_bytes(content[: len(content) // 2])
    programs.begin_another_process()
    assert programs.compiles(MATRIX, 2)
    assert len(program.read_bytes()) > len(content) / 2


def test_the_least_recently_used_programs_are_deleted_first(programs, monkeypatch):
    monkeypatch.setattr(compiled, "MAX_DISK_BYTES", 250)
    programs.folder.mkdir()
    ages = [programs.folder / f"of age {age}" for age in range(5)]
    for age, path in enumerate(ages):
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    eigenvalues(MATRIX, 2)
    assert [path.exists() for path in ages] == [True, True, False, False, False]


def test_nested_calls_and_unnamed_functions_use_filter_jit(programs):
    nameless = compiled.compiled(lambda x: 2 * x)
    assert nameless(jnp.ones(2)).tolist() == [2.0, 2.0]
    inner = jax.jit(lambda matrix: eigenvalues(matrix, 2).values)
    assert inner(MATRIX) == pytest.approx([2.0, 6.0])
    assert not programs.compilations


@pytest.mark.parametrize(("used", "times"), [(600, 2), (400, 1)], ids=["full", "room"])
def test_caches_are_cleared_only_if_memory_maps_run_out(tmp_path, monkeypatch, used, times):
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


def test_caches_are_kept_if_the_number_of_memory_maps_is_unknown(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "MAPS_FILE", tmp_path / "none")
    monkeypatch.setattr(jax, "clear_caches", lambda: pytest.fail("cleared"))
    compiled.free_memory_maps()


def test_options_unknown_to_this_version_of_xla_are_omitted(x64, monkeypatch, tmp_path):
    """JAX 0.11 dropped an option of 0.10, and refuses to compile with it."""
    calls = compiled.compiled(scaled_eigenvalues, {"xla_of_some_other_version": True})
    for folder in ("", str(tmp_path)):
        monkeypatch.setenv(PROGRAMS, folder)
        assert np.asarray(calls(MATRIX, 1).values) == pytest.approx([1.0, 3.0])

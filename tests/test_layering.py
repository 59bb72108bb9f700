"""The layers of the package: modules import only from the layers below."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pmdc_jax"

# the other parts that a part may import at run time; parts that are not listed may import anything
ALLOWED_IMPORTS = {
    "errors": set(),
    "progress": set(),
    "words": set(),
    "files": {"errors"},
    "json_file": {"errors"},
    "runtime": {"files"},
    "recordings": {"errors", "files"},
    "checks": {"recordings"},
    "effects": set(),
    "motor": {"effects"},
    "motor_file": {"effects", "errors", "files", "json_file", "motor"},
    "simulate": {"effects", "errors", "motor", "motor_file", "recordings", "runtime"},
    "control": {"effects", "errors", "files", "json_file", "motor", "motor_file", "progress", "runtime", "simulate"},
    "identify": {"checks", "effects", "errors", "motor", "progress", "recordings", "runtime", "simulate", "words"},
    "diagnose": {"effects", "errors", "identify", "motor", "progress", "recordings", "runtime", "simulate"},
    "report": {
        "control",
        "diagnose",
        "effects",
        "files",
        "identify",
        "motor",
        "motor_file",
        "paper",
        "progress",
        "recordings",
        "words",
    },
}
# the parts that compute results, and their modules that only define results; of `control`, only its pipeline computes
COMPUTING_PARTS = {"diagnose", "identify", "simulate"}
RESULT_MODULES = {"diagnose/diagnosis.py", "diagnose/hypotheses/effect_relations.py", "identify/identification.py"}


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def run_time_nodes(path: Path) -> list[ast.AST]:
    """The syntax tree of a module without imports that are for annotations alone, as a list of nodes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
    return list(ast.walk(tree))


def imported_parts(path: Path) -> set[str]:
    """Parts of the package that a module imports at run time."""
    depth = len(path.relative_to(PACKAGE).parts)
    parts = set()
    for node in run_time_nodes(path):
        if isinstance(node, ast.ImportFrom) and node.level == depth:
            names = [node.module] if node.module else [alias.name for alias in node.names]
            parts |= {name.split(".")[0] for name in names}
    return parts


@pytest.mark.parametrize("part", ALLOWED_IMPORTS)
def test_a_part_imports_only_parts_below_it(part):
    modules = [path for path in PACKAGE.rglob("*.py") if part_of(path) == part]
    assert modules, f"{part} no longer exists: update the table"
    for module in modules:
        assert imported_parts(module) <= ALLOWED_IMPORTS[part] | {part}, module.name


def modules_imported(path: Path) -> set[Path]:
    """Modules of the package that this one imports at run time, at the top or inside a function."""
    found = set()
    for node in run_time_nodes(path):
        assert not (isinstance(node, ast.Import) and "pmdc_jax" in ast.unparse(node)), path
        if isinstance(node, ast.ImportFrom) and node.level:
            base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            found |= {base / alias.name for alias in node.names} | {base}
    files = {base.with_suffix(".py") for base in found} | {base / "__init__.py" for base in found}
    return {file for file in files if file.exists()} - {path}


def test_reports_import_results_only():
    for module in (PACKAGE / "report").rglob("*.py"):
        computing = {
            path for path in modules_imported(module) if part_of(path) in COMPUTING_PARTS or path.name == "pipeline.py"
        }
        names = {path.relative_to(PACKAGE).as_posix() for path in computing}
        assert names <= RESULT_MODULES, module.name
        assert not re.search(r"^\s*(from|import) jax\b", module.read_text(encoding="utf-8"), re.MULTILINE)


def test_there_are_no_import_cycles():
    """A package's own `__init__` counts as the parts it gathers, not as a part that they import."""
    graph = {path: modules_imported(path) for path in PACKAGE.rglob("*.py")}
    assert sum(map(len, graph.values())) > 50, "imports are no longer recognised"
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        names = [str(path.relative_to(PACKAGE)) for path in error.args[1]]
        pytest.fail("cycle: " + " < ".join(names))


def test_there_is_no_catch_all_module():
    names = {path.stem for path in PACKAGE.rglob("*.py")}
    assert not names & {"utils", "helpers", "manager", "common", "misc"}


def test_importing_changes_nothing_and_prints_nothing():
    code = (
        "import sys, pmdc_jax; assert 'jax' not in sys.modules; import jax;"
        "before = dict(jax.config.values); import pmdc_jax.identify, pmdc_jax.simulate;"
        "assert dict(jax.config.values) == before"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")

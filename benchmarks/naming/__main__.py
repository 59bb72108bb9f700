"""Run the naming benchmark: `python -m benchmarks.naming --suite singles --cases 17`.

Each result is appended to a file of JSON lines at once; cases that are in the file already are not
run again, so that an interrupted run continues. `--dump DIR` writes the CSV
files of the cases instead, for `pmdc diagnose DIR/singles-0/*.csv --holdout ...`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.naming.cases import SETS, SUITES, Case, case, dump
from benchmarks.naming.methods import METHODS
from benchmarks.naming.tables import all_tables, outcome_of

OUT = Path(__file__).parents[1] / "out"
SIZES = {
    "singles": 204,  # 17 effects, 4 noises, 3 each
    "strengths": 272,  # 17 effects, 8 amplitudes, 2 noises
    "nulls": 300,
    "pairs": 100,
    "formulas": 88,  # 11 formulas, 4 noises, 2 each
    "outside": 60,
    "blind": 52,
    "noise_sweep": 500,  # 100 at each of 5 noises
    "rough": 51,
    "foreign": 90,  # 17 effects and none, 5 kinds of sensors
    "foreign_pairs": 50,
}


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(prog="benchmarks.naming", description=__doc__)
    parser.add_argument("--suite", nargs="+", choices=SUITES, default=list(SUITES))
    parser.add_argument("--cases", type=int, help="cases of each suite (default: all)")
    parser.add_argument("--first", type=int, default=0, help="the first case of each suite")
    parser.add_argument("--set", choices=SETS, default="tuning", dest="seeds")
    parser.add_argument("--method", choices=METHODS, default="pmdc")
    parser.add_argument("--out", type=Path, help="file of results, JSON lines")
    parser.add_argument("--dump", type=Path, help="write the cases as CSV files, and run nothing")
    parser.add_argument("--show", action="store_true", help="tables of what there is, run nothing")
    return parser.parse_args()


def wanted(options: argparse.Namespace) -> list[tuple[str, int]]:
    """Suite and index of each requested case."""
    return [
        (suite, index)
        for suite in options.suite
        for index in range(options.first, options.first + (options.cases or SIZES[suite]))
    ]


def read_results(path: Path) -> dict[str, dict[str, Any]]:
    """Results so far by case; a line that an interruption left unfinished is ignored."""
    results = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            result = json.loads(line)
        except json.JSONDecodeError:
            continue
        results[result["key"]] = result
    return results


def answer(method: str, made: Case) -> dict[str, Any]:
    """The answer of the method; an exception counts as the answer "error"."""
    try:
        return METHODS[method](made.runs, made.holdout)
    except Exception as error:
        return {"verdict": "error", "effects": [], "error": f"{type(error).__name__}: {error}"}


def run(method: str, seeds: str, made: Case) -> dict[str, Any]:
    """One line of results."""
    begin, cpu = time.perf_counter(), time.process_time()
    said = answer(method, made)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    kept = ("verdict", "effects", "gap", "error", "seconds")
    return {
        "key": made.key,
        "method": method,
        "set": seeds,
        "suite": made.suite,
        "index": made.index,
        "noise": made.noise,
        "detail": made.detail,
        "expected": made.expected,
        "truth": dict(made.effects),
        "stranger": " + ".join(made.stranger),
        "load_known": made.load_known,
        "motor": dict(made.motor),
        "residual": made.response.residual if made.response else None,
        "visible": made.response.visible if made.response else None,
        "answer": {key: said[key] for key in kept if key in said},
        "seconds": seconds,
        "cpu_seconds": cpu,
    }


def dump_case(folder: Path, made: Case) -> None:
    """The runs as CSV files, and the truth beside them."""
    folder = folder / f"{made.suite}-{made.index}"
    dump(made, folder)
    truth = {"noise": made.noise, "effects": made.effects, "stranger": made.stranger}
    truth |= {"motor": made.motor, "expected": made.expected}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")


def main() -> None:
    """Run the cases without a result and print the tables."""
    options, console = arguments(), Console(width=200)
    if options.dump:
        for suite, index in wanted(options):
            dump_case(options.dump, case(suite, index, options.seeds))
        return
    path = options.out or OUT / f"naming-{options.method}-{options.seeds}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    results = read_results(path)
    for suite, index in () if options.show else wanted(options):
        if f"{suite}/{index}" in results:
            continue
        result = run(options.method, options.seeds, case(suite, index, options.seeds))
        results[result["key"]] = result
        with path.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(result) + "\n")
        done = f"{result['key']} {result['detail']} ({result['noise']}): {outcome_of(result)}"
        print(f"{done}, {result['seconds']:.1f} s", file=sys.stderr, flush=True)
    shown = {f"{suite}/{index}" for suite, index in wanted(options)}
    for table in all_tables([r for key, r in results.items() if key in shown]):
        console.print(table)


if __name__ == "__main__":
    main()

"""Results as tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import Any

from rich.table import Table

from benchmarks.naming.hidden import NAMES
from benchmarks.naming.score import PUBLISHED_RECOVERY, Outcome, gap_closed, intervals, named, outcome, right

Result = dict[str, Any]  # one line of the results file
ABSTAINED = {"ambiguous": "amb", "not_in_library": "lib", "none_detected": "none", "error": "err"}
OUTCOMES: tuple[Outcome, ...] = (
    "exact", "incomplete", "wrong", "rivals", "elsewhere", "unlisted", "missed", "error",
)  # fmt: skip


def outcome_of(result: Result) -> Outcome:
    """The outcome of one line of results."""
    truth = result["truth"]
    return outcome(result["expected"], truth, result["answer"], result["load_known"])


def is_right(result: Result) -> bool:
    """Whether the answer is right."""
    return right(result["expected"], outcome_of(result))


def _percent(count: int, total: int) -> str:
    return f"{100 * count / total:.0f}" if total else "-"


def _grouped(results: Iterable[Result], key: Callable[[Result], Any]) -> dict[Any, list[Result]]:
    groups: dict[Any, list[Result]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return groups


def _table(title: str, first: str, headings: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(first)
    for heading in headings:
        table.add_column(heading, justify="right")
    return table


def _share_covered(results: Iterable[Result]) -> str:
    """Share of 95 % intervals that cover the truth, for effects with the formula of the library."""
    exact = (r for r in results if outcome_of(r) == "exact" and r["suite"] != "formulas")
    covers = [i.covers for r in exact for i in intervals(r["truth"], r["answer"])]
    return f"{_percent(sum(covers), len(covers))} of {len(covers)}" if covers else "-"


def _median_gap(results: Iterable[Result]) -> str:
    exact = (r for r in results if outcome_of(r) == "exact")
    closed = [g for r in exact if (g := gap_closed(r["answer"])) is not None]
    return f"{median(closed):.4f}" if closed else "-"


def summary(results: Sequence[Result]) -> Table:
    """Outcomes by suite and noise, gap closed, coverage, seconds."""
    headings = ("cases", "right %", *OUTCOMES, "gap closed", "covered %", "s", "CPU s")
    table = _table("Outcomes by suite and noise", "suite, noise", headings)
    for group, rows in _grouped(results, lambda r: f"{r['suite']}, {r['noise']}").items():
        counts = Counter(outcome_of(r) for r in rows)
        table.add_row(
            group,
            str(len(rows)),
            _percent(sum(map(is_right, rows)), len(rows)),
            *(str(counts[name] or "") for name in OUTCOMES),
            _median_gap(rows),
            _share_covered(rows),
            f"{median(r['seconds'] for r in rows):.1f}",
            f"{median(r['cpu_seconds'] for r in rows):.1f}",
        )
    return table


def _answered(result: Result) -> list[str]:
    verdict = result["answer"]["verdict"]
    return named(result["answer"]) if verdict == "named" else [ABSTAINED[verdict]]


def confusion(results: Sequence[Result]) -> Table:
    """Truth against asserted names; numbers stand for the effects in the order of the rows."""
    columns = [*NAMES, *ABSTAINED.values()]
    headings = [*(str(n + 1) for n in range(len(NAMES))), *ABSTAINED.values()]
    table = _table("What was asserted", "truth", ["cases", *headings])
    groups = _grouped(results, lambda r: " + ".join(r["truth"]) or r["stranger"] or "nothing")
    order = {name: place for place, name in enumerate(NAMES)}
    for truth in sorted(groups, key=lambda t: order.get(t, 99)):
        if " + " in truth:
            continue  # pairs: see `mistakes`
        counts = Counter(name for r in groups[truth] for name in _answered(r))
        label = f"{order[truth] + 1} {truth}" if truth in order else truth
        cells = (str(counts[name] or "") for name in columns)
        table.add_row(label, str(len(groups[truth])), *cells)
    return table


def mistakes(results: Sequence[Result]) -> Table:
    """Every case with a wrong answer, and the answer."""
    table = Table(title="Not right", title_justify="left")
    for heading in ("case", "noise", "hidden", "visible", "outcome", "answer"):
        table.add_column(heading)
    for result in results:
        if is_right(result):
            continue
        answer = result["answer"]
        said = " + ".join(named(answer)) or answer.get("error", "")
        table.add_row(
            result["key"],
            result["noise"],
            result["detail"],
            f"{result['visible']:.1f}" if result["visible"] else "",
            outcome_of(result),
            f"{answer['verdict']}: {said}"[:70],
        )
    return table


EDGES = (0.45, 0.8, 1.25, 2.0, 3.5, 7.0, 14.0)  # between the multiples of the suite


def strengths(results: Sequence[Result]) -> Table:
    """Right and wrong names by amplitude, as a multiple of the smallest detectable."""
    headings = ("cases", "named right %", "wrong %")
    table = _table("By amplitude over the smallest detectable", "times", headings)
    groups = _grouped(results, lambda r: sum(r["visible"] > edge for edge in EDGES))
    for _, rows in sorted(groups.items()):
        counts = Counter(outcome_of(r) for r in rows)
        size = f"{median(r['visible'] for r in rows):.2g}"
        shares = (_percent(counts[name], len(rows)) for name in ("exact", "wrong"))
        table.add_row(size, str(len(rows)), *shares)
    return table


def noise_sweep(results: Sequence[Result]) -> Table:
    """Recovery by noise beside the published one for known base parameters."""
    table = _table("Recovery by noise", "noise %", ("cases", "named right %", "wrong %", "published %"))
    groups = _grouped(results, lambda r: float(r["detail"].split()[1]))
    for percent, rows in sorted(groups.items()):
        counts = Counter(outcome_of(r) for r in rows)
        shares = [_percent(counts[name], len(rows)) for name in ("exact", "wrong")]
        table.add_row(f"{percent:g}", str(len(rows)), *shares, str(PUBLISHED_RECOVERY.get(percent, "-")))
    return table


def all_tables(results: Sequence[Result]) -> list[Table]:
    """All tables of these results."""
    tables = [summary(results), confusion(results), mistakes(results)]
    for suite, table in (("strengths", strengths), ("noise_sweep", noise_sweep)):
        if rows := [r for r in results if r["suite"] == suite]:
            tables.append(table(rows))
    return tables

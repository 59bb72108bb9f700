"""Progress callbacks of long computations."""

from __future__ import annotations

from typing import Protocol, runtime_checkable


@runtime_checkable
class ReportProgress(Protocol):
    """A callback for progress: the current step, the best fitness so far, and the fraction done (0 to 1)."""

    def __call__(self, doing: str, fitness: float | None = None, fraction: float | None = None) -> None: ...


def silent(doing: str, fitness: float | None = None, fraction: float | None = None) -> None:
    """A `ReportProgress` that does nothing."""

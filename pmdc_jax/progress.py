"""How long work tells how far it got."""

from __future__ import annotations

from typing import Protocol, runtime_checkable


@runtime_checkable
class ReportProgress(Protocol):
    """What long work calls now and then: what it does, how good it is, how far it got (0 to 1)."""

    def __call__(
        self, doing: str, fitness: float | None = None, fraction: float | None = None
    ) -> None: ...


def silent(doing: str, fitness: float | None = None, fraction: float | None = None) -> None:
    """The `ReportProgress` of work that nobody watches."""

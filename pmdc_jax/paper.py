"""The tables and figures of the wheelchair-motor paper beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .files import result_folder
from .progress import ReportProgress

if TYPE_CHECKING:
    from .wheelchair import Paper


def paper(out: str | Path = "paper_out", progress: ReportProgress | None = None) -> Paper:
    """Do the paper again, and write paper.html and paper.json to the folder `out`, made where it does not exist.

    Table 1 from a virtual load test by the paper's genetic algorithm and by ours, Figs 4 to 8, and Table 2 beside
    what is physically possible.
    """
    from .report.json import write_json
    from .report.paper import paper_json, write_paper
    from .wheelchair import reproduce

    folder = result_folder(Path(out), "paper.html")

    result = reproduce(progress)
    write_json(paper_json(result), folder / "paper.json")
    write_paper(result, folder / "paper.html")
    return result

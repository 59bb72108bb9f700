"""Reproducing the wheelchair-motor paper: its tables and figures beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..files import result_folder
from ..progress import ReportProgress

if TYPE_CHECKING:
    from .reproduction import Paper


def paper(out: str | Path = "paper_out", progress: ReportProgress | None = None) -> Paper:
    """Reproduce the paper, and write paper.html and paper.json to the folder `out`, which is made if missing.

    Table 1 is recovered from a virtual load test by the paper's genetic algorithm and by `identify`; Figs 4 to 8 are
    drawn again; Table 2 is compared with what is physically possible.
    """
    from ..report.json import write_json
    from ..report.paper.json import paper_json
    from ..report.paper.page import write_paper_report
    from .reproduction import reproduce

    folder = result_folder(Path(out), "paper.html")
    result = reproduce(progress)
    write_json(paper_json(result), folder / "paper.json")
    write_paper_report(result, folder / "paper.html")
    return result

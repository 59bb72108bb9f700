"""Folder and style of the figures of the experiments."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

OUT = Path(__file__).parent / "out"
STYLE = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "font.size": 9,
}


def panels(rows: int, height: float, **options):
    """Figure and axes, one panel below the other; `height` of one in inches."""
    plt.rcParams.update(STYLE)
    return plt.subplots(rows, 1, figsize=(8.0, rows * height), **options)


def save(figure: Figure, name: str) -> Path:
    """Write a figure to experiments/out/NAME.png and close it."""
    OUT.mkdir(exist_ok=True)
    path = OUT / f"{name}.png"
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path

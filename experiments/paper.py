"""The wheelchair-motor paper reproduced: `python -m experiments.paper`, the same as `pmdc paper`."""

from rich.console import Console

from experiments.figures import OUT
from pmdc_jax import paper
from pmdc_jax.report.paper.tables import paper_tables


def main() -> None:
    """Write paper.html and paper.json to experiments/out/paper, and print the tables."""
    folder = OUT / "paper"
    console = Console(width=110)
    console.print(paper_tables(paper(folder)))
    console.print(f"Pictures: {folder / 'paper.html'}")


if __name__ == "__main__":
    main()

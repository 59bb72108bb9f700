"""One self-contained HTML page: template, plotly.js inlined once, figures as JSON. No network."""

from __future__ import annotations

import re
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jinja2
import plotly.graph_objects as go
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from ..files import write_text

TEMPLATES = Path(__file__).parent / "templates"
PACKAGES = ("pmdc_jax", "jax", "diffrax", "equinox", "optimistix", "evosax", "numpy", "plotly")


def write_page(path: str | Path, template: str, **content: Any) -> None:
    """Render a template of `TEMPLATES` with `content`, and write the page atomically."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,  # run and column names come from files
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["commands"] = _commands
    page = environment.get_template(template).render(
        plotly_js=Markup(get_plotlyjs()), versions=_versions(), written=f"{datetime.now():%Y-%m-%d %H:%M}", **content
    )
    write_text(path, page)


def figure_json(figure: go.Figure) -> Markup:
    """A figure as JSON that is safe inside a script element."""
    text = figure.to_json()
    # in JSON, "<" occurs only inside strings, where the escape is equivalent and cannot close the element
    return Markup((text or "{}").replace("<", "\\u003c"))


def _commands(text: str) -> Markup:
    """Plain text as HTML, with `quoted` commands and command-line options marked as code, which the style never breaks
    over two lines."""
    quoted, option = r"`([^`]+)`", r"(--[a-z][\w-]*(?: \w+=\w+| [A-Z]+\b)?)"
    marked = re.sub(f"{quoted}|{option}", lambda m: f"<code>{m[1] or m[2]}</code>", str(escape(text)))
    return Markup(marked)


def _versions() -> dict[str, str]:
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions

"""The HTML page of an identification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attrs import frozen

from ...identify.identification import Estimate, Identification, RunFit
from ..figures import group_size, points_per_trace
from ..notation import (
    PARAMETER_NAMES,
    SEARCH_NAMES,
    EstimateText,
    parameter_words,
    percent,
    status_word,
    thousands,
    write_estimate,
)
from ..page import figure_json, write_page
from .figures import correlation_figure, correlations, count_traces, run_figure, search_figure
from .sentences import summary
from .tables import FitRow, fit_rows


def write_identification_report(identification: Identification, path: str | Path) -> None:
    """Write the report of an identification to one self-contained HTML file."""
    write_page(
        path,
        "identification.html.jinja",
        summary=summary(identification),
        tiles=_tiles(identification),
        **identification_content(identification),
    )


def identification_content(identification: Identification, other_traces: int = 0) -> dict[str, Any]:
    """Template content of the sections on the motor, its data and its fit.

    `other_traces`, drawn elsewhere on the page, leave fewer points to each trace here, so that the page stays small.
    """
    traces = other_traces + sum(count_traces(fit) for fit in identification.fit.values())
    points = points_per_trace(traces)
    return {
        "parameters": _parameters(identification),
        "findings": identification.findings,
        "messages": identification.messages,
        "runs": _runs(identification, points),
        "show_load_offset": any(f.load_offset is not None for f in identification.fit.values()),
        "search": _search(identification),
        "correlation": _correlation(identification),
        "seed": identification.seed,
        "seconds": {name: f"{value:.1f} s" for name, value in identification.seconds.items()},
    }


@frozen
class _Parameter:
    symbol: str
    name: str
    written: EstimateText
    status: str
    status_word: str


@frozen
class _Run:
    row: FitRow
    anchor: str
    figure: str
    caption: str


def _tiles(identification: Identification) -> list[tuple[str, str, str]]:
    """Label, number and note of each tile at the top of the report."""
    parameters = identification.parameters.values()
    identified = sum(one.status == "identified" for one in parameters)
    tiles = [("Parameters identified", f"{identified} of {len(parameters)}", "")]
    held_out = [fit for fit in identification.fit.values() if fit.role == "holdout"]
    shown = held_out or list(identification.fit.values())
    label = "Hold-out fit" if held_out else "Training fit"
    for quantity in ("speed", "current"):
        fits = [getattr(fit, f"{quantity}_fit_percent") for fit in shown]
        fits = [fit for fit in fits if fit is not None]
        if fits:
            note = "free-run simulation" if len(fits) == 1 else f"worst of {len(fits)} runs"
            tiles.append((f"{label}, {quantity}", percent(min(fits)), note))
    search = identification.search
    starts = len(search.refined)
    agree = f"{search.times_found} of {starts} starts agree" if starts else ""
    tiles.append(("Search", "converged" if identification.converged else "not converged", agree))
    return tiles


def _parameters(identification: Identification) -> list[_Parameter]:
    def row(symbol: str, estimate: Estimate) -> _Parameter:
        if "." in symbol:  # a parameter of an effect has a name but no symbol
            symbol, name = "", parameter_words(*symbol.split("."))
        else:
            name = PARAMETER_NAMES[symbol]
        word = status_word(estimate.status)
        return _Parameter(symbol, name, write_estimate(estimate), estimate.status, word)

    return [row(*item) for item in identification.parameters.items()]


def _runs(identification: Identification, points: int) -> list[_Run]:
    runs = []
    for number, row in enumerate(fit_rows(identification), start=1):
        fit = identification.fit[row.run]
        figure = figure_json(run_figure(fit, identification.noise, points))
        runs.append(_Run(row, f"run-{number}", figure, _caption(fit, points)))
    return runs


def _caption(fit: RunFit, points: int) -> str:
    """The fits of the run, and the thinning of its figure if not every sample is drawn."""
    shares = (("speed", fit.speed_fit_percent), ("current", fit.current_fit_percent))
    fits = [f"{quantity} fit {percent(share)}" for quantity, share in shares if share is not None]
    samples = len(fit.time)
    if samples > points:
        group = group_size(samples, points)
        fits.append(f"plot reduced to the minimum and maximum of every {group} samples")
    return ", ".join(fits)


def _search(identification: Identification) -> dict[str, Any]:
    search = identification.search
    drawn = len(search.best) + len(search.refined) > 0
    return {
        "method": SEARCH_NAMES[search.method],
        "evaluations": thousands(search.evaluations),
        "starts": len(search.refined),
        "times_found": search.times_found,
        "figure": figure_json(search_figure(search)) if drawn else None,
    }


def _correlation(identification: Identification) -> str | None:
    matrix, names = correlations(identification.covariance, identification.covariance_names)
    return figure_json(correlation_figure(matrix, names)) if len(names) > 1 else None

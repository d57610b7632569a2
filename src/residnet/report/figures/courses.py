"""Figures of a course run: tracks past the buoys, time histories, and the spread of vessels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from residnet.report.figures.files import Drawing
from residnet.report.figures.style import collect, legend_above, new_figure, styled
from residnet.report.format import DEG

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")
_LINES: dict[str, Any] = {
    "course": "-",
    "lookahead": (0, (4, 1.5)),
    "enclosure": (0, (1, 1)),
    "integral": (0, (4, 1, 1, 1)),
}
_WORDS = {
    "course": "",
    "lookahead": ", look-ahead",
    "enclosure": ", enclosure",
    "integral": ", integral",
}
_AROUND = 0.3
"""Share of the course's size that is shown around it; what leaves this has lost the course."""
_BUOY: dict[str, Any] = {
    "facecolor": "0.93",
    "edgecolor": "0.45",
    "linestyle": ":",
    "linewidth": 0.9,
    "zorder": 0,
}


def _label(controller: str, guidance: str) -> str:
    return f"{controller}{_WORDS[guidance]}"


@styled
def tracks(
    name: str,
    flights: pd.DataFrame,
    plan: pd.DataFrame,
    buoys: Sequence[Mapping[str, Any]],
    radii: Sequence[float],
    start: Sequence[float],
    rule: str,
) -> Drawing:
    """Draw tracks over north and east, with the buoys, their circles and the side of each.

    Args:
        name: of the figure's file.
        flights: of one protocol, from tracks.parquet.
        plan: of that protocol, from courses.parquet.
        buoys: each with north and east in m and `leave_to`.
        radii: of the circles in m.
        start: north and east in m.
        rule: sentence on what the course demands.
    """
    from matplotlib.patches import Circle

    figure = new_figure(6.6)
    axes = figure.subplots()
    axes.plot(plan["east"], plan["north"], color="0.75", linewidth=6.0, label="plan", zorder=1)
    kinds = flights[["controller", "guidance"]].drop_duplicates().itertuples(index=False)
    controllers = flights["controller"].drop_duplicates().tolist()
    for controller, guidance in kinds:
        place = controllers.index(controller)
        chosen = (flights["controller"] == controller) & (flights["guidance"] == guidance)
        axes.plot(
            flights["east"][chosen],
            flights["north"][chosen],
            color=_COLOURS[place % len(_COLOURS)],
            linestyle=_LINES[guidance],
            # flights that coincide show beside each other
            linewidth=max(3.2 - 0.9 * place, 1.0),
            label=_label(controller, guidance),
            zorder=3,
        )
    _frame(axes, plan, buoys, radii)
    for number, (buoy, radius) in enumerate(zip(buoys, radii, strict=True), start=1):
        centre = (buoy["east"], buoy["north"])
        axes.add_patch(Circle(centre, radius, **_BUOY))
        axes.plot(*centre, "o", color="black", markersize=3.5, zorder=4)
        side = f"{number}{buoy['leave_to'][0].upper()}"
        axes.annotate(side, centre, xytext=(4, 4), textcoords="offset points", fontsize=8)
    axes.plot(start[1], start[0], "^", color="black", markersize=6, zorder=4)
    axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    handles: dict[str, Any] = {}
    collect(handles, axes)
    legend_above(figure, handles)
    caption = (
        f"{rule} S and P name the side on which a buoy is left, dotted circles are those of the"
        " buoys, and the triangle is the start. A track that leaves the picture has lost the"
        " course."
    )
    return Drawing(name, "Tracks: " + rule.rstrip("."), caption, figure)


def _frame(
    axes: Any, plan: pd.DataFrame, buoys: Sequence[Mapping[str, Any]], radii: Sequence[float]
) -> None:
    """Show the whole plan and every buoy's circle."""
    spans = []
    for name in ("east", "north"):
        places, reach = np.array([buoy[name] for buoy in buoys]), np.array(radii)
        low = min(float(plan[name].min()), float((places - reach).min()))
        spans.append((low, max(float(plan[name].max()), float((places + reach).max()))))
    edge = _AROUND * max(high - low for low, high in spans)
    axes.set_xlim(spans[0][0] - edge, spans[0][1] + edge)
    axes.set_ylim(spans[1][0] - edge, spans[1][1] + edge)


@styled
def histories(name: str, flights: pd.DataFrame, limit: float, rule: str) -> Drawing:
    """Draw heading, rudder, cross-track error and speed over time of the flights along the plan.

    Args:
        name: of the figure's file.
        flights: of one protocol, from tracks.parquet.
        limit: of the rudder in rad.
        rule: sentence on what the course demands.
    """
    planned = flights[flights["guidance"] == "course"]
    quantities = (
        ("psi", "heading\n[deg]", DEG),
        ("rudder", "rudder\n[deg]", DEG),
        ("cross_track", "cross-track\nerror [m]", 1.0),
        ("speed", "speed\n[m/s]", 1.0),
    )
    figure = new_figure(6.4)
    panels = figure.subplots(4, 1, sharex=True)
    for axes, (quantity, title, scale) in zip(panels, quantities, strict=True):
        for place, (controller, flight) in enumerate(planned.groupby("controller", sort=False)):
            color = _COLOURS[place % len(_COLOURS)]
            values = scale * flight[quantity]
            axes.plot(flight["t"], values, color=color, linewidth=1.0, label=str(controller))
        axes.set(ylabel=title)
    for side in (-1.0, 1.0):
        panels[1].axhline(side * limit * DEG, color="0.5", linewidth=0.6, linestyle=":")
    largest = float(np.abs(planned["cross_track"]).quantile(0.995))
    panels[2].set_ylim(-1.1 * max(largest, 1e-3), 1.1 * max(largest, 1e-3))
    panels[3].set_ylim(bottom=0.0)
    panels[3].set(xlabel="time [s]")
    figure.align_ylabels(panels)
    handles: dict[str, Any] = {}
    collect(handles, panels[0])
    legend_above(figure, handles)
    caption = f"{rule} Flights along the plan; the dotted lines are the limits of the rudder."
    return Drawing(name, "Time histories: " + rule.rstrip("."), caption, figure)


@styled
def spread(name: str, flights: pd.DataFrame, rule: str) -> Drawing:
    """Draw the course time of every flight of the spread over that of the reference.

    Args:
        name: of the figure's file.
        flights: of one protocol, from spread.parquet, with model, guidance, ratio, passed and
            finished.
        rule: sentence on what the course demands.
    """
    pairs = flights[["model", "guidance"]].drop_duplicates()
    kinds = list(pairs.itertuples(index=False, name=None))
    controllers = flights["model"].drop_duplicates().tolist()
    figure = new_figure(1.2 + 0.32 * len(kinds))
    axes = figure.subplots()
    for line, (controller, guidance) in enumerate(kinds):
        of_kind = (flights["model"] == controller) & (flights["guidance"] == guidance)
        finished = flights[of_kind & flights["finished"]]
        color = _COLOURS[controllers.index(controller) % len(_COLOURS)]
        beside = line + 0.5 * (np.arange(len(finished)) / max(len(finished) - 1, 1) - 0.5)
        axes.scatter(
            finished["ratio"],
            beside,
            s=14,
            facecolors=[color if passed else "none" for passed in finished["passed"]],
            edgecolors=color,
            linewidths=0.8,
            zorder=3,
        )
        if len(finished) > 0:
            middle = [finished["ratio"].median()] * 2
            ends = [line - 0.38, line + 0.38]
            axes.plot(middle, ends, color="black", linewidth=1.2, zorder=4)
    axes.set(
        xlabel="course time over that of the reference, in water at rest",
        ylim=(len(kinds) - 0.5, -0.5),
    )
    axes.set_yticks(range(len(kinds)), [_label(*kind) for kind in kinds])
    axes.grid(axis="y", visible=False)
    given_up = len(flights) - int(flights["finished"].sum())
    caption = (
        f"{rule} Each point is one vessel in one current. It is filled where all buoys were passed"
        " as demanded; the bar is the median."
    )
    if given_up:
        caption += f" {given_up} of {len(flights)} flights did not finish and are left out."
    return Drawing(name, "Spread: " + rule.rstrip("."), caption, figure)

"""Figures of a course run: tracks with buoys, their circles and sides, and heading, rudder and
cross-track error over time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from residnet.report.figures.style import RC, collect, legend_above, new_figure, save

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
_DEG = 180.0 / math.pi
_AROUND = 0.3


def _label(controller: str, guidance: str) -> str:
    return f"{controller}{_WORDS[guidance]}"


def draw_tracks(
    path: Path,
    tracks: pd.DataFrame,
    plan: pd.DataFrame,
    buoys: Sequence[Mapping[str, Any]],
    radii: Sequence[float],
    start: Sequence[float],
    text: str,
) -> None:
    """Tracks over north and east in m, axes equal: buoys with their circles, and an S or P on the
    side that each lies on.

    Args:
        path: of the picture.
        tracks: of one protocol.
        plan: of it.
        buoys: with north, east, leave_to.
        radii: of the circles that are drawn.
        start: (north, east).
        text: what the course asks for.
    """
    import matplotlib
    from matplotlib.patches import Circle

    with matplotlib.rc_context(RC):
        figure = new_figure(6.6)
        axes = figure.subplots()
        axes.plot(plan["east"], plan["north"], color="0.75", linewidth=6.0, label="plan", zorder=1)
        flights = tracks[["controller", "guidance"]].drop_duplicates().itertuples(index=False)
        controllers = tracks["controller"].drop_duplicates().tolist()
        for controller, guidance in flights:
            place = controllers.index(controller)
            own = tracks[(tracks["controller"] == controller) & (tracks["guidance"] == guidance)]
            axes.plot(
                own["east"],
                own["north"],
                color=_COLOURS[place % len(_COLOURS)],
                linestyle=_LINES[guidance],
                # flights that coincide show beside each other
                linewidth=max(3.2 - 0.9 * place, 1.0),
                label=_label(controller, guidance),
                zorder=3,
            )
        _frame(axes, plan)
        for number, (buoy, radius) in enumerate(zip(buoys, radii, strict=True), start=1):
            axes.add_patch(
                Circle(
                    (buoy["east"], buoy["north"]),
                    radius,
                    facecolor="0.93",
                    edgecolor="0.45",
                    linestyle=":",
                    linewidth=0.9,
                    zorder=0,
                )
            )
            axes.plot(buoy["east"], buoy["north"], "o", color="black", markersize=3.5, zorder=4)
            axes.annotate(
                f"{number}{buoy['leave_to'][0].upper()}",
                (buoy["east"], buoy["north"]),
                xytext=(4, 4),
                textcoords="offset points",
                fontsize=8,
            )
        axes.plot(start[1], start[0], "^", color="black", markersize=6, zorder=4)
        axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
        handles: dict[str, Any] = {}
        collect(handles, axes)
        legend_above(figure, handles)
        caption = (
            f"{text} S and P: the side that a buoy is left on; dotted: circles of the buoys;"
            " triangle: start."
        )
        caption += " A track that leaves the picture has lost the course."
        save(figure, path, "Tracks: " + text.rstrip("."), caption)


def _frame(axes: Any, plan: pd.DataFrame) -> None:
    """The plan and a third of its size around it: what leaves this has lost the course."""
    edge = _AROUND * max(float(np.ptp(plan["north"])), float(np.ptp(plan["east"])))
    axes.set_xlim(float(plan["east"].min()) - edge, float(plan["east"].max()) + edge)
    axes.set_ylim(float(plan["north"].min()) - edge, float(plan["north"].max()) + edge)


def draw_histories(path: Path, tracks: pd.DataFrame, limit: float, text: str) -> None:
    """Heading, rudder, cross-track error and speed over time of the flights along the plan.

    Args:
        path: of the picture.
        tracks: of one protocol.
        limit: of the rudder in rad.
        text: what the course asks for.
    """
    import matplotlib

    planned = tracks[tracks["guidance"] == "course"]
    quantities = (
        ("psi", "heading [deg]", _DEG),
        ("rudder", "rudder [deg]", _DEG),
        ("cross_track", "cross-track\nerror [m]", 1.0),
        ("speed", "speed [m/s]", 1.0),
    )
    with matplotlib.rc_context(RC):
        figure = new_figure(6.4)
        panels = figure.subplots(4, 1, sharex=True)
        for axes, (quantity, name, scale) in zip(panels, quantities, strict=True):
            for place, (controller, own) in enumerate(planned.groupby("controller", sort=False)):
                axes.plot(
                    own["t"],
                    scale * own[quantity],
                    color=_COLOURS[place % len(_COLOURS)],
                    linewidth=1.0,
                    label=str(controller),
                )
            axes.set(ylabel=name)
        for side in (-1.0, 1.0):
            panels[1].axhline(side * limit * _DEG, color="0.5", linewidth=0.6, linestyle=":")
        largest = float(np.abs(planned["cross_track"]).quantile(0.995))
        panels[2].set_ylim(-1.1 * max(largest, 1e-3), 1.1 * max(largest, 1e-3))
        panels[3].set_ylim(bottom=0.0)
        panels[3].set(xlabel="time [s]")
        handles: dict[str, Any] = {}
        collect(handles, panels[0])
        legend_above(figure, handles)
        save(
            figure,
            path,
            "Time histories: " + text.rstrip("."),
            f"{text} Flights along the plan; dotted: limit of the rudder.",
        )


def draw_spread(path: Path, flights: pd.DataFrame, text: str) -> None:
    """Course time of every flight of the spread, over the shortest possible, by controller and
    guidance.

    Args:
        path: of the picture.
        flights: of one protocol, with model, guidance, ratio, passed, finished.
        text: what the course asks for.
    """
    import matplotlib

    kinds = list(
        flights[["model", "guidance"]].drop_duplicates().itertuples(index=False, name=None)
    )
    controllers = flights["model"].drop_duplicates().tolist()
    with matplotlib.rc_context(RC):
        figure = new_figure(1.2 + 0.32 * len(kinds))
        axes = figure.subplots()
        for line, (controller, guidance) in enumerate(kinds):
            own = flights[
                (flights["model"] == controller)
                & (flights["guidance"] == guidance)
                & flights["finished"]
            ]
            colour = _COLOURS[controllers.index(controller) % len(_COLOURS)]
            beside = line + 0.5 * (np.arange(len(own)) / max(len(own) - 1, 1) - 0.5)
            face = [colour if passed else "none" for passed in own["passed"]]
            axes.scatter(
                own["ratio"],
                beside,
                s=14,
                facecolors=face,
                edgecolors=colour,
                linewidths=0.8,
                zorder=3,
            )
            if len(own) > 0:
                axes.plot(
                    [own["ratio"].median()] * 2,
                    [line - 0.38, line + 0.38],
                    color="black",
                    linewidth=1.2,
                    zorder=4,
                )
        axes.set(
            xlabel="course time over the shortest possible, in water at rest",
            ylim=(len(kinds) - 0.5, -0.5),
        )
        axes.set_yticks(range(len(kinds)), [_label(*kind) for kind in kinds])
        axes.grid(axis="y", visible=False)
        given_up = len(flights) - int(flights["finished"].sum())
        caption = (
            f"{text} One point for each vessel and current, filled where all buoys were passed as"
            " asked; bar: median."
        )
        if given_up:
            caption += f" {given_up} of {len(flights)} flights did not finish and are left out."
        save(figure, path, "Spread: " + text.rstrip("."), caption)

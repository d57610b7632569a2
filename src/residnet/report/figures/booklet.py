"""Figures of the manoeuvring booklet: turning circles with all draws, and repeated zigzags."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.report.figures.files import Drawing
from residnet.report.figures.style import (
    MEASURED,
    SOLID,
    WIDTH,
    collect,
    legend_above,
    new_figure,
    styled,
)
from residnet.report.run_reader import RunFiles

_DRAWN: dict[str, Any] = {"color": SOLID["color"], "alpha": 0.12, "linewidth": 0.7, "zorder": 1}
_BAND: dict[str, Any] = {"color": SOLID["color"], "alpha": 0.22, "linewidth": 0, "zorder": 1}
_RUDDER: dict[str, Any] = {
    "color": "0.45",
    "linestyle": (0, (1, 1)),
    "linewidth": 1.0,
    "zorder": 1,
    "label": "rudder",
}
_RULE: dict[str, Any] = {"color": "0.2", "linewidth": 0.8}
_MOST_ZIGZAGS = 6
_DEG = math.degrees(1.0)


def of_booklet(run: RunFiles) -> Iterator[Drawing]:
    """Draw the circles and zigzags of a booklet; nothing where the run has none."""
    booklet, frame = run.json("booklet.json"), run.frame("booklet.parquet")
    if not booklet or frame is None:
        return
    pages: list[Mapping[str, Any]] = booklet["pages"]
    level = f"{100 * booklet['level']:.0f} %"
    circles = [page for page in pages if page["manoeuvre"] == "turning_circle"]
    if circles:
        yield Drawing(
            "booklet_circles",
            "Turning circles",
            (
                "North is up; distances are in hull lengths from the place of the order. Thin"
                f" lines are {booklet['draws']} draws of the model's parameters. Black lines mark"
                " advance (to 90 deg) and tactical diameter (to 180 deg) of the fitted model."
            ),
            _circles(frame, circles, float(booklet["length"])),
        )
    zigzags = [page for page in pages if page["manoeuvre"] == "zigzag"]
    for place in range(0, len(zigzags), _MOST_ZIGZAGS):
        yield Drawing(
            f"booklet_zigzags_{place // _MOST_ZIGZAGS + 1}",
            "Zigzags in closed loop",
            (
                "The model steers by its own heading with the rudder angle and the reversals of"
                " each trial; the rudder is dotted. Look for the height of the peaks (overshoot)"
                f" and for periods that run apart. The band holds {level} of the draws at each"
                " instant."
            ),
            _zigzags(frame, zigzags[place : place + _MOST_ZIGZAGS], float(booklet["level"])),
        )


@styled
def _circles(frame: Any, pages: Sequence[Mapping[str, Any]], length: float) -> Any:
    figure = new_figure(0.66 * WIDTH)
    axes = figure.subplots()
    handles: dict[str, Any] = {}
    for page in pages:
        of_page = frame[frame["page"] == page["name"]]
        for draw, part in of_page[of_page["draw"] >= 0].groupby("draw"):
            axes.plot(
                part["y"] / length,
                part["x"] / length,
                **({**SOLID, "label": "model"} if draw == 0 else {**_DRAWN, "label": "draws"}),
            )
        found = page["indices"]
        if "tactical_diameter" in found:
            fitted = of_page[of_page["draw"] == 0]
            side = 1.0 if fitted["psi"].iloc[-1] > 0 else -1.0
            advance, transfer = found["advance"]["lengths"], side * found["transfer"]["lengths"]
            diameter = side * found["tactical_diameter"]["lengths"]
            axes.hlines(advance, 0, transfer, **_RULE)
            axes.vlines(diameter, 0, advance, **_RULE)
            axes.annotate(
                f"advance {advance:.2f}",
                (0, advance),
                (side * 3, 3),
                textcoords="offset points",
                ha="left" if side > 0 else "right",
            )
            axes.annotate(
                f"tactical diameter {abs(diameter):.2f}",
                (diameter, 0),
                (0, -11),
                textcoords="offset points",
                ha="right" if side > 0 else "left",
            )
    collect(handles, axes)
    axes.plot(0, 0, "o", color="black", markerfacecolor="white", markersize=6, zorder=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east [hull lengths]")
    axes.set_ylabel("north [hull lengths]")
    legend_above(figure, handles)
    return figure


@styled
def _zigzags(frame: Any, pages: Sequence[Mapping[str, Any]], level: float) -> Any:
    columns = 2 if len(pages) > 1 else 1
    lines = math.ceil(len(pages) / columns)
    figure = new_figure(0.6 + 1.9 * lines)
    handles: dict[str, Any] = {}
    for place, page in enumerate(pages):
        axes = figure.add_subplot(lines, columns, place + 1)
        of_page = frame[frame["page"] == page["name"]]
        fitted = of_page[of_page["draw"] == 0]
        drawn = [
            _DEG * (part["psi"] - part["psi"].iloc[0]).to_numpy()
            for draw, part in of_page[of_page["draw"] > 0].groupby("draw")
        ]
        if drawn:
            # flights that end at their stop condition are of different length: the band ends with
            # the shortest
            shortest = min(map(len, drawn))
            bounds = np.quantile(
                np.stack([line[:shortest] for line in drawn]),
                (0.5 - level / 2, 0.5 + level / 2),
                axis=0,
            )
            t = (
                of_page[of_page["draw"] == 1]["t"].to_numpy()[:shortest]
                if (of_page["draw"] == 1).any()
                else np.zeros(0)
            )
            if t.size == shortest:
                axes.fill_between(t, *bounds, **_BAND)
        axes.plot(
            fitted["t"], _DEG * (fitted["psi"] - fitted["psi"].iloc[0]), **SOLID, label="model"
        )
        axes.plot(fitted["t"], _DEG * fitted["rudder"], **_RUDDER)
        measured = of_page[of_page["draw"] == -1]
        if len(measured):
            axes.plot(
                measured["t"],
                _DEG * (measured["psi"] - measured["psi"].iloc[0]),
                **{**MEASURED, "linewidth": 1.1, "zorder": 5},
            )
        axes.set_title(page_title(page))
        axes.set_ylabel("heading, rudder [deg]")
        axes.set_xlabel("time [s]")
        collect(handles, axes)
    legend_above(figure, handles)
    return figure


def page_title(page: Mapping[str, Any]) -> str:
    """Return the name of a page, with the split of a measured log."""
    return (
        f"{page['name']} ({page['split']})"
        if page["split"]
        else str(page["name"]).replace("_", " ")
    )

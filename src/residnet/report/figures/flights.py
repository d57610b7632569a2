"""Figures of simulated manoeuvres: tracks and time histories of a vessel, a model, or both."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.log import Log
from residnet.data.simulated.flying import Flight
from residnet.manoeuvres import Replay, Spiral, Waypoints, Zigzag
from residnet.report.figures.files import Drawing
from residnet.report.figures.style import (
    DASHED,
    SOLID,
    WIDTH,
    collect,
    legend_above,
    new_figure,
    styled,
)

MOST = 12
"""Flights that have a time history of their own; of more, the first of each kind has."""
_PER_FIGURE = 6
_UNITS = {
    "rad": ("deg", math.degrees(1.0)),
    "rad/s": ("deg/s", math.degrees(1.0)),
    "1/s": ("rpm", 60.0),
}
_NAMES = {
    "u": "surge velocity\nu", "v": "sway velocity\nv", "r": "yaw rate\nr", "p": "roll rate\np",
    "psi": "heading\n", "phi": "roll angle\n",
    "cmd_delta": "rudder\ncommand", "cmd_n": "revolutions\ncommand", "cmd_port": "port command\n",
    "cmd_stbd": "starboard\ncommand",
}  # fmt: skip


def flight_drawings(flown: Mapping[str, Sequence[Flight]]) -> Iterator[Drawing]:
    """Draw tracks, time histories and, of spirals, yaw rate over helm.

    Of many flights, only the first of each kind of manoeuvre is drawn.

    Args:
        flown: flights of the same manoeuvres by what flew them; of two, the first is the solid line
            and the second the dashed one.

    Yields:
        Each figure with its title and caption.
    """
    crafts = list(flown)
    groups: list[Sequence[Flight]] = list(zip(*flown.values(), strict=True))
    kinds: dict[str, Sequence[Flight]] = {}
    for group in groups:
        kinds.setdefault(group[0].manoeuvre.kind, group)
    chosen = groups if len(groups) <= MOST else list(kinds.values())
    for place in range(0, len(chosen), _PER_FIGURE):
        yield Drawing(
            f"tracks_{place // _PER_FIGURE + 1}",
            "Tracks",
            "North is up, scales are equal, and each track begins at its start.",
            _tracks(crafts, chosen[place : place + _PER_FIGURE]),
        )
    for group in chosen:
        name = group[0].motion.name
        yield Drawing(
            f"history_{name}",
            f"Time history: {name}",
            "The motion itself, without the noise of sensors, and the commands.",
            _history(crafts, group),
        )
        if group[0].manoeuvre.kind == "spiral":
            yield Drawing(
                f"spiral_{name}",
                f"Spiral: {name}",
                "Steady yaw rate over helm; a loop about zero shows an unstable vessel.",
                _spiral(crafts, group),
            )


def _look(place: int, name: str) -> dict[str, Any]:
    return {**(SOLID if place == 0 else DASHED), "label": name}


def _recorded(flight: Flight) -> Log | None:
    """Return the recording of a replay, as far as it was flown; None for other manoeuvres."""
    if not isinstance(flight.manoeuvre, Replay):
        return None
    log = flight.manoeuvre.recorded
    length = int(np.searchsorted(log.t - log.t[0], flight.motion.t[-1], side="right"))
    return Log(
        log.name,
        log.t[:length],
        {name: values[:length] for name, values in log.channels.items()},
        log.units,
    )


@styled
def _tracks(crafts: Sequence[str], groups: Sequence[Sequence[Flight]]) -> Any:
    columns = min(2, len(groups))
    lines = math.ceil(len(groups) / columns)
    side = WIDTH / columns if columns > 1 else 0.7 * WIDTH
    figure = new_figure(0.5 + lines * (0.92 * side + 0.35))
    handles: dict[str, Any] = {}
    for place, group in enumerate(groups):
        axes = figure.add_subplot(lines, columns, place + 1)
        manoeuvre = group[0].manoeuvre
        x0, y0 = (float(group[0].motion[name][0]) for name in ("x", "y"))
        if (recorded := _recorded(group[0])) is not None:
            axes.plot(
                recorded["y"] - y0, recorded["x"] - x0, color="0.5", linewidth=2.2, label="recorded"
            )
        for i, flight in enumerate(group):
            axes.plot(flight.motion["y"] - y0, flight.motion["x"] - x0, **_look(i, crafts[i]))
        axes.plot(
            0,
            0,
            "o",
            color="black",
            markerfacecolor="white",
            markersize=6,
            linestyle="none",
            label="start",
            zorder=6,
        )
        if isinstance(manoeuvre, Waypoints):
            north, east = np.array(manoeuvre.points).T
            axes.plot(
                east - y0,
                north - x0,
                "s",
                color="0.4",
                markersize=5,
                linestyle="none",
                label="way-point",
                zorder=5,
            )
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(group[0].motion.name)
        axes.set_xlabel("east [m]")
        axes.set_ylabel("north [m]")
        collect(handles, axes)
    legend_above(figure, handles)
    return figure


@styled
def _history(crafts: Sequence[str], group: Sequence[Flight]) -> Any:
    first = group[0].motion
    names: list[str] = [
        name for name in ("u", "v", "r", "p", "psi", "phi") if name in first.channels
    ]
    names += [name for name in first.channels if name.startswith("cmd_")]
    figure = new_figure(0.6 + 1.3 * len(names))
    panels = figure.subplots(len(names), 1, sharex=True)
    recorded = _recorded(group[0])
    handles: dict[str, Any] = {}
    for axes, name in zip(panels, names, strict=True):
        unit, factor = _UNITS.get(first.units[name], (first.units[name], 1.0))
        if recorded is not None and name in recorded.channels:
            axes.plot(
                recorded.t - recorded.t[0],
                factor * recorded[name],
                color="0.5",
                linewidth=2.2,
                label="recorded",
            )
        if name == "psi" and isinstance(group[0].manoeuvre, Zigzag):
            for side in (-1.0, 1.0):
                axes.axhline(
                    factor * (first["psi"][0] + side * group[0].manoeuvre.heading),
                    color="0.6",
                    linewidth=0.8,
                    linestyle=":",
                    gid="heading of reversals",
                )
        for i, flight in enumerate(group):
            if name in flight.motion.channels:
                step = {"drawstyle": "steps-post"} if name.startswith("cmd_") else {}
                axes.plot(
                    flight.motion.t, factor * flight.motion[name], **_look(i, crafts[i]), **step
                )
        axes.set_ylabel(f"{_NAMES.get(name, name)} [{unit}]".replace("\n ", "\n"))
        collect(handles, axes)
    panels[-1].set_xlabel("time [s]")
    panels[-1].set_xlim(0, max(flight.motion.t[-1] for flight in group))
    panels[0].set_title(first.name)
    figure.align_ylabels(panels)
    legend_above(figure, handles)
    return figure


@styled
def _spiral(crafts: Sequence[str], group: Sequence[Flight]) -> Any:
    figure = new_figure(3.6)
    axes = figure.subplots()
    manoeuvre = group[0].manoeuvre
    by_angle = isinstance(manoeuvre, Spiral) and len(manoeuvre.rudders) > 0
    for i, flight in enumerate(group):
        found = flight.manoeuvre.indices(flight.motion)
        helm, rates = np.asarray(found["steers"]), np.degrees(found["yaw_rates"])
        axes.plot(
            np.degrees(helm) if by_angle else helm,
            rates,
            **_look(i, crafts[i]),
            marker="o",
            markersize=4,
        )
    axes.set_xlabel("rudder [deg]" if by_angle else "helm [share of full steer]")
    axes.set_ylabel("steady yaw rate [deg/s]")
    axes.set_title(group[0].motion.name)
    handles: dict[str, Any] = {}
    collect(handles, axes)
    legend_above(figure, handles)
    return figure

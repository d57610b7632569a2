"""The interactive figure of a course run: tracks past the buoys, and what was steered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from residnet.report.format import DEG
from residnet.report.interactive.explorer import (
    INK,
    Case,
    Curve,
    Explorer,
    Look,
    Panel,
    thinned,
)

_MOST_SAMPLES = 900
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")
_DASHES = {"course": "solid", "lookahead": "dashed", "enclosure": "dotted", "integral": "dashdot"}
_PANELS = (
    ("psi", "heading [deg]", DEG),
    ("rudder", "rudder [deg]", DEG),
    ("cross_track", "cross-track error [m]", 1.0),
    ("speed", "speed [m/s]", 1.0),
)
_PLAN, _BUOYS = "plan", "buoys"


def course_explorer(
    flown: pd.DataFrame,
    plans: pd.DataFrame,
    radii: Mapping[str, Sequence[float]],
    buoys: Sequence[Mapping[str, Any]],
    rules: Mapping[str, str],
) -> Explorer:
    """Return the interactive figure of the flights of the nominal vessel.

    Args:
        flown: tracks.parquet.
        plans: courses.parquet.
        radii: of the buoys' circles in m, by protocol.
        buoys: each with north and east in m.
        rules: sentence on what each protocol demands.
    """
    looks: dict[str, Look] = {}
    controllers = flown["controller"].drop_duplicates().tolist()
    for controller, guidance in _kinds(flown):
        color = _COLORS[controllers.index(controller) % len(_COLORS)]
        dash = _DASHES.get(guidance, "dashed")
        looks[_name(controller, guidance)] = Look(_name(controller, guidance), color, dash)
    looks[_PLAN] = Look("plan", INK, "dashed", 1.0)
    looks[_BUOYS] = Look("circles of the buoys", INK, "dotted", 1.2)
    panels = [Panel("track, north [m] against east [m]", "", "map", 420)]
    panels += [Panel(title, height=150) for _, title, _ in _PANELS]
    panels[-1] = Panel(panels[-1].title, "time [s]", height=180)
    cases = [
        _case(
            protocol,
            flown[flown["protocol"] == protocol],
            plans[plans["protocol"] == protocol],
            _circles(buoys, of_protocol),
            rules[protocol],
        )
        for protocol, of_protocol in radii.items()
    ]
    return Explorer(
        "courses",
        "Flights past the buoys",
        "North is up, and scales of the track are equal. Dotted circles are those of the buoys."
        " A controller that leaves the plan early has to steer more later; look for rudder angles"
        " at the limit and for errors that grow from buoy to buoy.",
        "Protocol",
        looks,
        panels,
        cases,
    )


def _kinds(flights: pd.DataFrame) -> list[tuple[str, str]]:
    """Return controller and guidance of the flights, each pair once."""
    pairs = flights[["controller", "guidance"]].drop_duplicates()
    return [(str(one), str(other)) for one, other in pairs.itertuples(index=False, name=None)]


def _name(controller: str, guidance: str) -> str:
    return controller if guidance == "course" else f"{controller}, {guidance}"


def _circles(buoys: Sequence[Mapping[str, Any]], radii: Sequence[float]) -> Curve:
    """Return all circles as one curve with gaps."""
    angle = np.append(np.linspace(0.0, 2.0 * np.pi, 37), np.nan)
    east = [buoy["east"] + r * np.sin(angle) for buoy, r in zip(buoys, radii, strict=True)]
    north = [buoy["north"] + r * np.cos(angle) for buoy, r in zip(buoys, radii, strict=True)]
    return np.concatenate(east), np.concatenate(north)


def _case(
    protocol: str, flights: pd.DataFrame, plan: pd.DataFrame, circles: Curve, rule: str
) -> Case:
    track: dict[str, Curve] = {_BUOYS: circles}
    rows = thinned(len(plan), _MOST_SAMPLES)
    track[_PLAN] = (_values(plan, "east")[rows], _values(plan, "north")[rows])
    panels: list[dict[str, Curve]] = [track, *({} for _ in _PANELS)]
    for controller, guidance in _kinds(flights):
        of_kind = (flights["controller"] == controller) & (flights["guidance"] == guidance)
        flight, name = flights[of_kind], _name(controller, guidance)
        rows = thinned(len(flight), _MOST_SAMPLES)
        track[name] = (_values(flight, "east")[rows], _values(flight, "north")[rows])
        time = _values(flight, "t")[rows]
        for panel, (quantity, _, factor) in zip(panels[1:], _PANELS, strict=True):
            panel[name] = (time, factor * _values(flight, quantity)[rows])
    return Case(protocol, panels, rule)


def _values(table: pd.DataFrame, name: str) -> np.ndarray:
    return table[name].to_numpy(dtype=float)

"""The report of a course run: one self-contained HTML file, from the run folder alone."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pandas as pd

from residnet.core.config import load_mapping
from residnet.judge.courses import table
from residnet.report.figures.courses import draw_histories, draw_spread, draw_tracks
from residnet.report.plain_page import Part, write_page

TRACKS = "tracks.parquet"
"""By this file a course's run folder is known."""
COURSES = "courses.parquet"
"""The plans."""
SPREAD = "spread.parquet"
"""One line for each flight of the spread, where there is one."""

_ASKED = {
    "enter": "Every buoy's circle of acceptance is entered.",
    "sides": "Every buoy is passed on its side, outside its circle.",
}


def write_course_report(run: Path) -> Path:
    """Draw figures and write `report.html` from metrics.json and the tables beside it; returns the
    report's path.
    """
    metrics = json.loads((run / "metrics.json").read_text())
    config = load_mapping(run / "resolved.yaml")
    wanted = config["course"]
    tracks, plans = pd.read_parquet(run / TRACKS), pd.read_parquet(run / COURSES)
    smallest = metrics["smallest"]["radius"]
    for protocol in config["protocols"]:
        radii = [
            wanted["acceptance"] if protocol == "enter" else max(buoy["radius"], smallest)
            for buoy in wanted["buoys"]
        ]
        own, plan = tracks[tracks["protocol"] == protocol], plans[plans["protocol"] == protocol]
        draw_tracks(
            run / "figures" / f"{protocol}_tracks.png",
            own,
            plan,
            wanted["buoys"],
            radii,
            wanted["start"],
            _ASKED[protocol],
        )
        draw_histories(
            run / "figures" / f"{protocol}_time.png", own, metrics["rudder"], _ASKED[protocol]
        )
    if (run / SPREAD).is_file():
        every = pd.read_parquet(run / SPREAD)
        for protocol in config["protocols"]:
            draw_spread(
                run / "figures" / f"{protocol}_spread.png",
                every[every["protocol"] == protocol],
                _ASKED[protocol],
            )
    return write_page(run, [Part(_words(config, metrics), table(metrics["rows"]))])


def _spread_words(config: dict[str, Any]) -> str:
    spread = config.get("spread")
    if spread is None:
        return ""
    (low, high), (quick, slow) = spread["effect"], spread["time"]
    bias = (
        f", a rudder bias of at most {math.degrees(spread['bias']):.3g} deg"
        if spread["bias"] > 0
        else ""
    )
    return (
        f"Spread: {spread['flights']} vessels with {low:g} to {high:g} times the rudder's effect,"
        f" {quick:g} to {slow:g} times the time constants{bias}, in currents of"
        f" {spread['current']:g} m/s from all directions, which ratios of course times do not allow"
        " for; passed: share of the flights that passed all buoys as asked."
    )


def _words(config: dict[str, Any], metrics: dict[str, Any]) -> str:
    steady = metrics["smallest"]
    limits = [
        f"buoy {one['buoy']}: {one['radius']:.4g} m"
        for one in metrics["feasibility"]
        if not one["possible"]
    ]
    widened = (
        f"Tighter circles cannot be followed ({', '.join(limits)}); they are widened to that"
        " radius. "
        if limits
        else "Every circle can be followed. "
    )
    return (
        f"At {math.degrees(metrics['rudder']):.3g} deg of rudder the vessel turns with a radius of"
        f" {steady['radius']:.2f} m, at {steady['speed']:.3g} m/s. {widened}The shortest possible"
        " course is that of bounded curvature at this radius (Dubins). Ratio: course time over its"
        f" length at the service speed of {metrics['speed']:.3g} m/s; turning: at the speed kept in"
        " the smallest turn. Side/clear: buoys left on their side, and outside their circles."
        " Cross-track error from the plan, which a flight by line of sight does not follow."
        " Margin: how far inside the circle that is entered least, or outside the one that is"
        " passed most closely. Tightest: radius of the tightest turn of a flight. "
        + _spread_words(config)
    )

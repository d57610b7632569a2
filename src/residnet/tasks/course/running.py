"""Carrying out a course run, into a run folder."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import pandas as pd

from residnet.control.base import Policy, Reference
from residnet.control.courses.config import (
    PlannedCourse,
    report_feasibility,
)
from residnet.control.guidance.line_of_sight import AnyLineOfSight
from residnet.control.guidance.waypoints import WaypointGuidance
from residnet.control.guidance.wheel_over import WheelOver
from residnet.control.heading.controllers import Steering
from residnet.control.heading.following import Following
from residnet.core.progress import say
from residnet.judge.courses import CourseFlight, row, spread_row
from residnet.judge.metrics import SCHEMA
from residnet.report.sections.course import COURSES, SPREAD, TRACKS, text_of
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome
from residnet.tasks.course.autopilot_run import (
    autopilot_of,
    load_policy,
    ready,
)
from residnet.tasks.course.config import CourseSettings
from residnet.tasks.course.exporting import CourseExport
from residnet.tasks.course.flights import NOMINAL, Vessels, fly
from residnet.tasks.course.guided import guidance_along, plan_for
from residnet.tasks.course.peers import load_peers
from residnet.tasks.course.tables import plan_table, spread_table, track_table

_UNITS = {
    "course_time": "s",
    "reference_time": "s",
    "cross_track_rms": "m",
    "cross_track_max": "m",
    "distances": "m",
    "clearance": "m",
    "margin": "m",
    "tightest_turn": "m",
    "travel": "rad",
}


def run_course(config: CourseSettings, folder: RunFolder) -> Outcome:
    """Train where there is no trained policy yet, plan, fly and compare."""
    if not config.autopilot.is_dir() and not RunFolder(folder.path / "autopilot").finished:
        autopilot_of(config).run(
            source=config.autopilot, out=folder.path / "autopilot", resume=True
        )
    known = ready(config, folder)
    steering, steady = known.steering, known.steady
    feasible = report_feasibility(config.course, steady)
    for circle in feasible:
        if not circle["possible"]:
            say(
                f"buoy {circle['buoy']}: {circle['radius']:.4g} m cannot be followed; the smallest"
                f" radius possible is {circle['smallest']:.2f} m"
            )
    trained = load_policy(known, config.policy)
    controllers = {config.policy: trained, **load_peers(config, known)}
    done = _Flown([], [], [])
    plans, exports = [], []
    for protocol in config.protocols:
        planned, guidance = plan_for(config, known, protocol)
        say(
            f"{protocol}: planned {planned.course.length:.1f} m; the reference of arcs and lines"
            f" has {planned.reference:.1f} m"
        )
        plans.append(plan_table(planned))
        for name in controllers:
            for sight in (None, *(config.line_of_sight if protocol == "enter" else ())):
                _fly(config, planned, steering, name, controllers[name], sight, done)
        exports.append(
            CourseExport(folder.exports, config, planned, guidance, trained, known.autopilot)
        )
    shown = {
        "schema": SCHEMA,
        "run": config.name,
        "channels": _UNITS,
        "speed": steering.turning.speed,
        "rudder": steering.limit,
        "smallest": vars(steady),
        "feasibility": feasible,
    }
    folder.write_json(folder.metrics, shown | {"rows": done.rows})
    folder.write_table(folder.path / TRACKS, pd.concat(done.tracks, ignore_index=True))
    folder.write_table(folder.path / COURSES, pd.concat(plans, ignore_index=True))
    if done.spread:
        folder.write_table(folder.path / SPREAD, pd.concat(done.spread, ignore_index=True))
    return Outcome(
        _verdict(config, done.rows),
        _main_figures(config, done.rows),
        text_of(done.rows),
        exports={export.name: partial(export.write, done.rows) for export in exports},
    )


def _nominal(config: CourseSettings, rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the policy's row of the nominal vessel along the plan, by protocol."""
    return {
        row["protocol"]: row
        for row in rows
        if (row["model"], row["guidance"], row["split"]) == (config.policy, "course", "simulated")
    }


def _verdict(config: CourseSettings, rows: Sequence[dict[str, Any]]) -> list[str]:
    sentences = []
    for protocol, flight in _nominal(config, rows).items():
        if not flight["finished"]:
            sentences.append(
                f"{protocol}: '{config.policy}' did not come to the end of the course."
            )
            continue
        passes = "and passes all" if flight["passed"] else "but does NOT pass all"
        sentences.append(
            f"{protocol}: '{config.policy}' needs {flight['course_time']:.1f} s,"
            f" {flight['ratio']:.3f} times the time of the reference, {passes}"
            f" {len(config.course.buoys)} buoys as the protocol asks."
        )
    return sentences


def _main_figures(config: CourseSettings, rows: Sequence[dict[str, Any]]) -> dict[str, MainFigure]:
    figures = {}
    for protocol, flight in _nominal(config, rows).items():
        figures[f"{protocol}_course_time"] = MainFigure(flight["course_time"], "s")
        figures[f"{protocol}_ratio"] = MainFigure(flight["ratio"])
        figures[f"{protocol}_cross_track_rms"] = MainFigure(flight["cross_track_rms"], "m")
    return figures


class _Flown(NamedTuple):
    """The rows of metrics.json, tracks of nominal flights, and flights of the spread."""

    rows: list[dict[str, Any]]
    tracks: list[pd.DataFrame]
    spread: list[pd.DataFrame]


def _fly(
    config: CourseSettings,
    planned: PlannedCourse,
    steering: Steering,
    name: str,
    law: Policy,
    sight: AnyLineOfSight | None,
    done: _Flown,
) -> None:
    """Fly the nominal vessel, then those of the spread, with one controller and guidance."""
    kind = "policy" if name == config.policy else "classical"
    guidance = "course" if sight is None else sight.kind
    steered = _steered(config, planned, steering, law, sight)

    def flown(vessels: Vessels) -> tuple[list[CourseFlight], list[dict[str, Any]]]:
        flights = fly(
            steering, *steered, planned, config.course.lookahead, config.duration, vessels
        )
        return flights, [
            row(
                name, kind, guidance, planned, one, config.course.acceptance, steering.turning.speed
            )
            for one in flights
        ]

    flights, rows = flown(NOMINAL)
    done.rows.extend(rows)
    done.tracks.append(track_table(name, guidance, planned.protocol, flights[0]))
    if config.spread is not None:
        vessels = config.spread.draw()
        rows = flown(vessels)[1]
        done.rows.append(spread_row(rows))
        done.spread.append(spread_table(rows, vessels))


def _steered(
    config: CourseSettings,
    planned: PlannedCourse,
    steering: Steering,
    law: Policy,
    sight: AnyLineOfSight | None,
) -> tuple[Policy, Reference]:
    """Return controller and guidance along the plan, or by line of sight from buoy to buoy."""
    vessel = steering.vessel
    if sight is None:
        return Following(
            law, vessel.state, limit=steering.limit, dt=steering.dt, rate=vessel.rate
        ), guidance_along(config, planned, steering)
    points, acceptance = (
        [(buoy.north, buoy.east) for buoy in planned.buoys],
        config.course.acceptance,
    )
    over = (
        WheelOver(steering.turning, steering.limit, acceptance, rate=vessel.rate)
        if config.legs_change == "wheel_over"
        else None
    )
    return law, WaypointGuidance(points, acceptance, sight.build(steering.dt), vessel.state, over)

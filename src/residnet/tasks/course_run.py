"""Carrying out a course run, into a run folder."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from pydantic import TypeAdapter
from torch import Tensor

from residnet.control.base import ClosedLoop, Policy, Reference
from residnet.control.courses.config import PlannedCourse, feasibility, plan_course, smallest_turn
from residnet.control.courses.course_check import Protocol
from residnet.control.courses.turns import SteadyTurn
from residnet.control.guidance import (
    AnyLineOfSight,
    CourseGuidance,
    DriftEstimate,
    TrackKeeping,
    WaypointGuidance,
    WheelOver,
)
from residnet.control.heading.controllers import Steering
from residnet.control.heading.policies import HeadingPolicy
from residnet.control.heading.turning import Turning
from residnet.core.errors import ExportError
from residnet.core.files import read_json
from residnet.core.progress import say
from residnet.documents.gouletas2020.autopilot import load_predictive
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import InAmbientCurrent
from residnet.dynamics.steering_variation import NOMINAL, Vessels
from residnet.export.policy import ExportedCoursePolicy
from residnet.judge.autopilots import CourseFlight, row, spread_row
from residnet.judge.metrics import SCHEMA
from residnet.report.sections.course import COURSES, SPREAD, TRACKS, text_of
from residnet.runs.folder import RunFolder
from residnet.runs.task import ExportRequest, MainFigure, Outcome
from residnet.tasks.autopilot import AnyController, AutopilotConfig
from residnet.tasks.autopilot_run import stored_policy

if TYPE_CHECKING:
    from residnet.tasks.course import CourseTaskConfig

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


def run_course(config: CourseTaskConfig, folder: RunFolder) -> Outcome:
    """Train where there is no trained policy yet, plan, fly and compare."""
    if not config.autopilot.is_dir() and not RunFolder(folder.path / "autopilot").finished:
        config.autopilot_config().run(
            source=config.autopilot, out=folder.path / "autopilot", resume=True
        )
    known = ready(config, folder)
    steering, steady = known.steering, known.steady
    feasible = feasibility(config.course.buoys, steady.radius)
    for circle in feasible:
        if not circle["possible"]:
            say(
                f"buoy {circle['buoy']}: {circle['radius']:.4g} m cannot be followed; the smallest"
                f" radius possible is {circle['smallest']:.2f} m"
            )
    trained = load_policy(known, config.policy)
    reader: TypeAdapter[AnyController] = TypeAdapter(AnyController)
    built: dict[str, Policy] = {}
    for name in config.peers:
        if name in known.autopilot.predictive:
            built[name] = load_predictive(
                name, known.autopilot.predictive[name], known.steering, known.run
            )
        else:
            built[name] = reader.validate_python(known.controllers[name]["config"]).build(
                known.steering
            )
    built |= {name: law.build(known.steering) for name, law in config.others.items()}
    controllers = {config.policy: trained, **{name: law.double() for name, law in built.items()}}
    done = _Flown([], [], [])
    plans: list[pd.DataFrame] = []
    exports: dict[str, Callable[[], Path]] = {}
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
        asked = ExportRequest(folder, f"{config.policy}_{protocol}")
        exports[asked.model] = partial(export_course, config, asked, (planned, guidance))
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
    verdict, figures = [], dict[str, MainFigure]()
    for flight in done.rows:
        # the policy on the nominal vessel along the plan
        nominal = (flight["model"], flight["guidance"], flight["split"])
        if nominal != (config.policy, "course", "simulated"):
            continue
        protocol = flight["protocol"]
        figures[f"{protocol}_course_time"] = MainFigure(flight["course_time"], "s")
        figures[f"{protocol}_ratio"] = MainFigure(flight["ratio"])
        figures[f"{protocol}_cross_track_rms"] = MainFigure(flight["cross_track_rms"], "m")
        passes = "and passes all" if flight["passed"] else "but does NOT pass all"
        verdict.append(
            f"{protocol}: '{config.policy}' needs {flight['course_time']:.1f} s,"
            f" {flight['ratio']:.3f} times the time of the reference, {passes}"
            f" {len(config.course.buoys)} buoys as the protocol asks."
            if flight["finished"]
            else f"{protocol}: '{config.policy}' did not come to the end of the course."
        )
    return Outcome(verdict, figures, text_of(done.rows), exports=exports)


class AutopilotRun(NamedTuple):
    """The finished autopilot run that courses are planned and flown with.

    Attributes:
        autopilot: config of the autopilot run.
        run: its folder.
        steering: vessel, K and T, rudder limit and step.
        steady: the smallest turn.
        controllers: configs of its peers as tuned, by name.
    """

    autopilot: AutopilotConfig
    run: RunFolder
    steering: Steering
    steady: SteadyTurn
    controllers: dict[str, Any]


def ready(config: CourseTaskConfig, folder: RunFolder) -> AutopilotRun:
    """Read the finished autopilot run: the given one, or the one in the folder of the course.

    Raises:
        UsageError: where it is not finished.
    """
    autopilot = config.autopilot_config()
    run = RunFolder.open(
        config.autopilot if config.autopilot.is_dir() else folder.path / "autopilot"
    )
    notes = read_json(run.path / "controllers.json")
    steering = Steering(autopilot.steered, Turning(**notes["turning"]), autopilot.rudder, config.dt)
    return AutopilotRun(
        autopilot,
        run,
        steering,
        smallest_turn(config.course, steering.vessel, steering.turning, steering.limit),
        notes["controllers"],
    )


def load_policy(known: AutopilotRun, name: str) -> HeadingPolicy:
    """Return a trained policy of the autopilot's run, at the step of the course.

    Raises:
        UsageError: where the run lacks it, or it is not as it was written.
    """
    steering = known.steering
    policy = stored_policy(known.autopilot, known.run.models, name, steering.dt)
    policy.read_from(steering.vessel.state)
    return policy


def plan_for(
    config: CourseTaskConfig, known: AutopilotRun, protocol: Protocol
) -> tuple[PlannedCourse, CourseGuidance]:
    """Return the plan of a protocol, and the guidance along it.

    Raises:
        ConfigError: where no course fits the vessel's turns.
    """
    steering = known.steering
    planned = plan_course(
        config.course, protocol, steering.vessel, steering.turning, steering.limit, known.steady
    )
    return planned, guidance_along(config, planned, steering)


def guidance_along(
    config: CourseTaskConfig, planned: PlannedCourse, steering: Steering
) -> CourseGuidance:
    """Return line of sight with the config's lookahead, drift estimated where it integrates."""
    lookahead = config.course.lookahead
    drift = (
        None if config.integral is None else DriftEstimate(lookahead, config.integral, steering.dt)
    )
    return CourseGuidance(planned.course, lookahead, steering.vessel.state, drift)


class _Flown(NamedTuple):
    """The rows of metrics.json, tracks of nominal flights, and flights of the spread."""

    rows: list[dict[str, Any]]
    tracks: list[pd.DataFrame]
    spread: list[pd.DataFrame]


def _fly(
    config: CourseTaskConfig,
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
    flight = flights[0]
    every = max(round(_KEPT / flight.dt), 1)
    count = len(flight.track)
    columns = {
        "controller": name,
        "guidance": guidance,
        "protocol": planned.protocol,
        "t": flight.dt * np.arange(count)[::every],
        "north": flight.track[::every, 0],
        "east": flight.track[::every, 1],
        "psi": flight.heading[::every],
        "rudder": np.resize(flight.rudder, count)[::every],
        "speed": flight.speed[::every],
        "cross_track": flight.cross_track[::every],
    }
    done.tracks.append(pd.DataFrame(columns))
    if config.spread is not None:
        vessels = config.spread.draw()
        rows = flown(vessels)[1]
        done.rows.append(spread_row(rows))
        done.spread.append(spread_table(rows, vessels))


def _steered(
    config: CourseTaskConfig,
    planned: PlannedCourse,
    steering: Steering,
    law: Policy,
    sight: AnyLineOfSight | None,
) -> tuple[Policy, Reference]:
    """Return controller and guidance along the plan, or by line of sight from buoy to buoy."""
    vessel = steering.vessel
    if sight is None:
        return TrackKeeping(
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


def fly(
    steering: Steering,
    policy: Policy,
    reference: Reference,
    planned: PlannedCourse,
    lookahead: float,
    duration: float,
    vessels: Vessels,
) -> list[CourseFlight]:
    """Fly each vessel once, from the plan's first point and heading.

    Args:
        planned: course that cross-track errors are measured from.
        lookahead: of the plan's guidance in m.
        duration: in s, after which a flight that has not ended is given up.
        vessels: that fly.
    """
    vessel, count, steps = steering.vessel, len(vessels.variation), round(duration / steering.dt)
    place = [vessel.column("x"), vessel.column("y")]
    x, w = vessel.start(torch.ones(count, dtype=torch.float64))
    x[:, place] = torch.from_numpy(planned.course.track[0])
    x[:, vessel.column("psi")] = float(planned.course.heading[0])
    model = InAmbientCurrent(vessel.model(steering.dt), vessel.state)
    loop = Rollout(model, ClosedLoop(policy, reference))
    memory = torch.cat((vessels.current, vessel.memory(vessels.variation)), dim=-1)
    with torch.no_grad():
        states, inputs, _ = loop(x, w.unsqueeze(1).expand(-1, steps, -1), memory)
        moves = (states.diff(dim=1)[:, :, place].abs().sum(dim=-1) > 0).numpy()
        ends = [int(np.flatnonzero(row)[-1]) + 1 for row in moves]
        aside = _aside(
            CourseGuidance(planned.course, lookahead, vessel.state), states[:, : max(ends) + 1]
        )
    speed = torch.hypot(states[:, :, vessel.column("u")], states[:, :, vessel.column("v")])
    psi = states[:, :, vessel.column("psi")]
    return [
        CourseFlight(
            states[row, : end + 1, place].numpy(),
            psi[row, : end + 1].numpy(),
            inputs[row, : end + 1, 0].numpy(),
            speed[row, : end + 1].numpy(),
            aside[row, : end + 1].numpy(),
            steering.dt,
            end < steps,
        )
        for row, end in enumerate(ends)
    ]


def _aside(plan: CourseGuidance, states: Tensor) -> Tensor:
    """Return the cross-track errors [B, T] in m of states [B, T, nx]."""
    place, errors = plan.initial_state(states[:, 0]), []
    for k in range(states.shape[1]):
        _, place = plan(states[:, k], k, place)
        errors.append(plan.error(states[:, k], place[:, 0])[1])
    return torch.stack(errors, dim=1)


_KEPT = 0.1
"""Seconds between the stored samples of a track."""


def spread_table(rows: list[dict[str, Any]], vessels: Vessels) -> pd.DataFrame:
    """Return one line for each flight of the spread."""
    columns = (
        "model",
        "guidance",
        "protocol",
        "finished",
        "passed",
        "course_time",
        "ratio",
        "margin",
        "cross_track_rms",
    )
    drawn = {
        "effect": vessels.variation[:, 0],
        "time": vessels.variation[:, 1],
        "bias": vessels.variation[:, 2],
    }
    drawn |= {"current_north": vessels.current[:, 0], "current_east": vessels.current[:, 1]}
    return pd.DataFrame(
        {name: [row[name] for row in rows] for name in columns}
        | {name: values.numpy() for name, values in drawn.items()}
    )


def plan_table(planned: PlannedCourse) -> pd.DataFrame:
    """Return the planned course up to its end: positions in m, heading and rudder in rad."""
    course = planned.course
    within = course.step * np.arange(len(course.track)) <= course.length
    columns = {
        "north": course.track[within, 0],
        "east": course.track[within, 1],
        "heading": course.heading[within],
        "rudder": course.rudder[within],
    }
    return pd.DataFrame({"protocol": planned.protocol, **columns})


_SAME = 1e-6
"""Turning radii by which a course planned again may differ from the one that was flown."""


def _planned_again(
    config: CourseTaskConfig, known: AutopilotRun, run: RunFolder, protocol: Protocol
) -> tuple[PlannedCourse, CourseGuidance]:
    planned, guidance = plan_for(config, known, protocol)
    again, flown = plan_table(planned), pd.read_parquet(run.path / COURSES)
    place, flown = ["north", "east"], flown[flown["protocol"] == protocol]
    if (
        len(again) != len(flown)
        or not (
            np.abs(again[place].to_numpy() - flown[place].to_numpy()) <= _SAME * known.steady.radius
        ).all()
    ):
        raise ExportError(
            f"{run.path}: another course is planned for '{protocol}' now than the one that was"
            " flown; carry the run out again with this version"
        )
    return planned, guidance


def export_course(
    config: CourseTaskConfig,
    asked: ExportRequest,
    flown: tuple[PlannedCourse, CourseGuidance] | None = None,
) -> Path:
    """Write a policy with the guidance of a course; returns the file.

    A course that is not at hand is planned again.

    Raises:
        UsageError: where there is no such course.
        ExportError: where another course is planned now than the one that was flown.
    """
    protocols = {f"{config.policy}_{protocol}": protocol for protocol in config.protocols}
    name = asked.named(protocols)
    known, run, protocol = ready(config, asked.run), asked.run, protocols[name]
    planned, guidance = flown or _planned_again(config, known, run, protocol)
    rows = [row for row in run.read_metrics()["rows"] if row["model"] == config.policy]
    exported = ExportedCoursePolicy(
        config.policy,
        load_policy(known, config.policy),
        guidance,
        planned.course,
        safe=config.safe,
        about={
            "vessel": known.autopilot.vessel,
            "course": config.course.model_dump(mode="json"),
            "protocol": protocol,
        },
        metrics=[row for row in rows if row["protocol"] == protocol],
    )
    return asked.write(exported, stem=name)

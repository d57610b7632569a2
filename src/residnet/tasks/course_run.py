"""Carrying out a course run, into a run folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from pydantic import TypeAdapter

from residnet.control.base import Policy, Reference
from residnet.control.courses.config import (
    PlannedCourse,
    Protocol,
    plan_course,
    report_feasibility,
    smallest_turn,
)
from residnet.control.courses.turns import SteadyTurn
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.guidance.drift import DriftEstimate
from residnet.control.guidance.line_of_sight import AnyLineOfSight
from residnet.control.guidance.waypoints import WaypointGuidance
from residnet.control.guidance.wheel_over import WheelOver
from residnet.control.heading.controllers import AnyController, Steering
from residnet.control.heading.following import Following
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.steering import SteeredPlant
from residnet.control.heading.turning import Turning
from residnet.core.config import load_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import nearest
from residnet.core.progress import say
from residnet.documents.gouletas2020.autopilot import load_predictive
from residnet.judge.courses import CourseFlight, row, spread_row, table
from residnet.judge.metrics import SCHEMA
from residnet.physics.vessel import load_vessel
from residnet.report.course import COURSES, SPREAD, TRACKS, write_course_report
from residnet.runs.folder import RunFolder
from residnet.tasks.autopilot import AutopilotConfig
from residnet.tasks.course import CourseTaskConfig
from residnet.tasks.course_flights import NOMINAL, Vessels, fly

_KEPT = 0.1
"""Seconds between the stored samples of a track."""
_UNITS = {
    "course_time": "s",
    "floor_time": "s",
    "cross_track_rms": "m",
    "cross_track_max": "m",
    "distances": "m",
    "clearance": "m",
    "margin": "m",
    "tightest_turn": "m",
    "travel": "rad",
}


def autopilot_of(config: CourseTaskConfig) -> AutopilotConfig:
    """The autopilot's config, from its run folder or its file.

    Raises:
        UsageError: see `CourseTaskConfig.check`.
        ConfigError: see there.
    """
    given = config.autopilot
    file = RunFolder.open(given).resolved if given.is_dir() else given
    autopilot = load_config(file, [], AutopilotConfig)
    if config.policy not in autopilot.policies:
        raise ConfigError(
            f"policy: '{config.policy}' is none of"
            f" {given}{nearest(config.policy, autopilot.policies)}"
        )
    for name in config.peers:
        if name not in (known := {**autopilot.peers, **autopilot.predictive}):
            raise ConfigError(f"peers: '{name}' is none of {given}{nearest(name, known)}")
    if taken := sorted({config.policy, *config.peers} & set(config.others)):
        raise ConfigError(
            f"others: '{taken[0]}' is a policy or peer already; names are unique in a run"
        )
    return autopilot


class Ready(NamedTuple):
    """What courses are planned and flown with.

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


def ready(config: CourseTaskConfig, folder: RunFolder) -> Ready:
    """From the finished run of the autopilot: the one that is given, or the one in the course's own
    folder.

    Raises:
        UsageError: where it is not finished.
    """
    autopilot = autopilot_of(config)
    run = RunFolder.open(
        config.autopilot if config.autopilot.is_dir() else folder.path / "autopilot"
    )
    notes = json.loads((run.path / "controllers.json").read_text())
    steering = Steering(
        SteeredPlant(load_vessel(autopilot.vessel).build()),
        Turning(**notes["turning"]),
        autopilot.rudder,
        config.dt,
    )
    return Ready(
        autopilot,
        run,
        steering,
        smallest_turn(config.course, steering.vessel, steering.limit),
        notes["controllers"],
    )


def plan_for(
    config: CourseTaskConfig, known: Ready, protocol: Protocol
) -> tuple[PlannedCourse, CourseGuidance]:
    """The plan of a protocol, and the guidance along it.

    Raises:
        ConfigError: where no course fits the vessel's turns.
    """
    steering = known.steering
    planned = plan_course(
        config.course, protocol, steering.vessel, steering.turning, steering.limit, known.steady
    )
    return planned, _guidance(config, planned, steering)


def run_course(config: CourseTaskConfig, folder: RunFolder, *, resume: bool) -> None:
    """Train, plan, fly, draw, report, export."""
    if not config.autopilot.is_dir() and not (folder.path / "autopilot" / "metrics.json").is_file():
        autopilot_of(config).run(
            source=config.autopilot, overrides=[], out=folder.path / "autopilot", resume=resume
        )
    torch.set_num_threads(config.threads)
    known = ready(config, folder)
    steering, steady = known.steering, known.steady
    feasible = report_feasibility(config.course, steady)
    for one in feasible:
        if not one["possible"]:
            say(
                f"buoy {one['buoy']}: {one['radius']:.4g} m cannot be followed; the smallest radius"
                f" possible is {one['smallest']:.2f} m"
            )
    trained = load_policy(known.run.path, config.policy, steering)
    controllers = {config.policy: trained, **_peers(config, known)}
    done = _Flown([], [], [])
    plans = []
    for protocol in config.protocols:
        planned, guided = plan_for(config, known, protocol)
        say(
            f"{protocol}: planned {planned.course.length:.1f} m, shortest possible"
            f" {planned.floor:.1f} m"
        )
        plans.append(_plan_table(planned))
        for name in controllers:
            for sight in (None, *(config.line_of_sight if protocol == "enter" else ())):
                _fly(config, planned, steering, name, controllers[name], sight, done)
        own = [
            entry
            for entry in done.rows
            if entry["protocol"] == protocol and entry["model"] == config.policy
        ]
        _export(config, folder, planned, guided, trained, known.autopilot, own)
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
    pd.concat(done.tracks, ignore_index=True).to_parquet(folder.path / TRACKS)
    pd.concat(plans, ignore_index=True).to_parquet(folder.path / COURSES)
    if done.spread:
        pd.concat(done.spread, ignore_index=True).to_parquet(folder.path / SPREAD)
    write_course_report(folder.path)
    print(table(done.rows))


class _Flown(NamedTuple):
    """Rows of metrics.json, tracks of nominal flights, and flights of the spread."""

    rows: list[dict[str, Any]]
    tracks: list[pd.DataFrame]
    spread: list[pd.DataFrame]


def _peers(config: CourseTaskConfig, known: Ready) -> dict[str, Policy]:
    """Peers as the autopilot run tuned or trained them, then the others."""
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
    return {name: law.double() for name, law in built.items()}


def _fly(
    config: CourseTaskConfig,
    planned: PlannedCourse,
    steering: Steering,
    name: str,
    law: Policy,
    sight: AnyLineOfSight | None,
    done: _Flown,
) -> None:
    """The nominal flight, then those of the spread, of one controller under one guidance."""
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
    done.tracks.append(_track_table(name, guidance, planned.protocol, flights[0]))
    if config.spread is not None:
        vessels = config.spread.draw()
        rows = flown(vessels)[1]
        done.rows.append(spread_row(rows))
        done.spread.append(_spread_table(rows, vessels))


def load_policy(run: Path, name: str, steering: Steering) -> HeadingPolicy:
    """A trained policy from the run folder of an autopilot, at the step of `steering`.

    Raises:
        UsageError: where the run lacks it.
    """
    from safetensors.torch import load_file

    file, weights = run / "exports" / f"{name}.pt", run / "models" / name / "weights.safetensors"
    if not file.is_file() or not weights.is_file():
        raise UsageError(
            f"{run}: no policy '{name}' (models/{name}/weights.safetensors and exports/{name}.pt)"
        )
    extra = {"card.json": ""}
    torch.jit.load(str(file), _extra_files=extra)
    card = json.loads(extra["card.json"])
    turning, command = card["turning"], card["command"][0]
    policy = HeadingPolicy(
        steering.vessel.state,
        turning=Turning(turning["K"], turning["T"], turning["speed"]),
        limit=command["limit"],
        dt=steering.dt,
        rate=command["rate"],
        hidden=card["hidden"],
        observer=card["observer"],
    )
    policy.load_state_dict(load_file(weights))
    return policy.eval().requires_grad_(False).double()


def _guidance(
    config: CourseTaskConfig, planned: PlannedCourse, steering: Steering
) -> CourseGuidance:
    """Along the plan."""
    lookahead = config.course.lookahead
    drift = (
        None if config.integral is None else DriftEstimate(lookahead, config.integral, steering.dt)
    )
    return CourseGuidance(planned.course, lookahead, steering.vessel.state, drift)


def _steered(
    config: CourseTaskConfig,
    planned: PlannedCourse,
    steering: Steering,
    law: Policy,
    sight: AnyLineOfSight | None,
) -> tuple[Policy, Reference]:
    """Controller and guidance along the plan, or under a line of sight on the legs from buoy to
    buoy instead.
    """
    vessel = steering.vessel
    if sight is None:
        return Following(
            law, vessel.state, limit=steering.limit, dt=steering.dt, rate=vessel.rate
        ), _guidance(config, planned, steering)
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


def _spread_table(rows: list[dict[str, Any]], vessels: Vessels) -> pd.DataFrame:
    """One line for each flight."""
    kept = (
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
    columns = {
        "effect": vessels.variation[:, 0],
        "time": vessels.variation[:, 1],
        "bias": vessels.variation[:, 2],
    }
    columns |= {"current_north": vessels.current[:, 0], "current_east": vessels.current[:, 1]}
    return pd.DataFrame(
        {name: [one[name] for one in rows] for name in kept}
        | {name: values.numpy() for name, values in columns.items()}
    )


def _track_table(name: str, guidance: str, protocol: str, flight: CourseFlight) -> pd.DataFrame:
    every = max(round(_KEPT / flight.dt), 1)
    count = len(flight.track)
    columns = {
        "controller": name,
        "guidance": guidance,
        "protocol": protocol,
        "t": flight.dt * np.arange(count)[::every],
        "north": flight.track[::every, 0],
        "east": flight.track[::every, 1],
        "psi": flight.heading[::every],
        "rudder": np.resize(flight.rudder, count)[::every],
        "speed": flight.speed[::every],
        "cross_track": flight.cross_track[::every],
    }
    return pd.DataFrame(columns)


def _plan_table(planned: PlannedCourse) -> pd.DataFrame:
    course = planned.course
    within = course.step * np.arange(len(course.track)) <= course.length
    columns = {
        "north": course.track[within, 0],
        "east": course.track[within, 1],
        "heading": course.heading[within],
        "rudder": course.rudder[within],
    }
    return pd.DataFrame({"protocol": planned.protocol, **columns})


def _export(
    config: CourseTaskConfig,
    folder: RunFolder,
    planned: PlannedCourse,
    guided: CourseGuidance,
    trained: HeadingPolicy,
    autopilot: AutopilotConfig,
    rows: list[dict[str, Any]],
) -> None:
    from residnet.export.course import export_course

    file = folder.exports / f"{config.policy}_{planned.protocol}.pt"
    about = {
        "vessel": autopilot.vessel,
        "course": config.course.model_dump(mode="json"),
        "protocol": planned.protocol,
    }
    export_course(
        config.policy,
        trained,
        guided,
        planned.course,
        file,
        safe=config.safe,
        about=about,
        metrics=rows,
    )
    print(f"exported: {file}")

"""Carrying out a course run, into a run folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from pydantic import TypeAdapter

from residnet.control.base import ClosedLoop, Policy, Reference
from residnet.control.controllers import AnyController, Steering
from residnet.control.course_guidance import CourseGuidance
from residnet.control.courses import PlannedCourse, plan_course, report_feasibility, smallest_turn
from residnet.control.following import Following
from residnet.control.line_of_sight import AnyLineOfSight
from residnet.control.policy import HeadingPolicy
from residnet.control.steering import SteeredPlant
from residnet.control.turning import Turning
from residnet.control.waypoints import WaypointGuidance
from residnet.core.config import load_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import nearest
from residnet.dynamics.rollout import Rollout
from residnet.evaluation.courses import CourseFlight, row, table
from residnet.evaluation.metrics import SCHEMA
from residnet.evaluation.report_course import COURSES, TRACKS, write_course_report
from residnet.physics.vessel import load_vessel
from residnet.run_folder import RunFolder
from residnet.tasks.autopilot import AutopilotConfig
from residnet.tasks.course import CourseTaskConfig
from residnet.tasks.pipeline import say

_KEPT = 0.1
"""Seconds between the stored samples of a track."""


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
        raise ConfigError(f"policy: '{config.policy}' is none of {given}{nearest(config.policy, autopilot.policies)}")
    for name in config.peers:
        if name not in autopilot.peers:
            raise ConfigError(f"peers: '{name}' is none of {given}{nearest(name, autopilot.peers)}")
    if taken := sorted({config.policy, *config.peers} & set(config.others)):
        raise ConfigError(f"others: '{taken[0]}' is a policy or peer already; names are unique in a run")
    return autopilot


def run_course(config: CourseTaskConfig, folder: RunFolder, *, resume: bool) -> None:
    """Train, plan, fly, draw, report, export."""
    autopilot = autopilot_of(config)
    run = config.autopilot
    if not run.is_dir():
        run = folder.path / "autopilot"
        if not (run / "metrics.json").is_file():
            autopilot.run(source=config.autopilot, overrides=[], out=run, resume=resume)
    torch.set_num_threads(config.threads)
    vessel = SteeredPlant(load_vessel(autopilot.vessel).build())
    notes = json.loads((run / "controllers.json").read_text())
    steering = Steering(vessel, Turning(**notes["turning"]), autopilot.rudder, config.dt)
    steady = smallest_turn(config.course, vessel, steering.limit)
    feasible = report_feasibility(config.course, steady)
    for one in feasible:
        if not one["possible"]:
            say(f"buoy {one['buoy']}: {one['radius']:.4g} m cannot be followed; the smallest radius possible is {one['smallest']:.2f} m")
    trained = load_policy(run, config.policy, steering)
    controllers: dict[str, tuple[str, Policy]] = {config.policy: ("policy", trained)}
    reader: TypeAdapter[AnyController] = TypeAdapter(AnyController)
    for name in config.peers:
        controllers[name] = ("classical", reader.validate_python(notes["controllers"][name]["config"]).build(steering))
    controllers |= {name: ("classical", other.build(steering)) for name, other in config.others.items()}
    rows: list[dict[str, Any]] = []
    tracks, plans = [], []
    for protocol in config.protocols:
        planned = plan_course(config.course, protocol, vessel, steering.turning, steering.limit, steady)
        say(f"{protocol}: planned {planned.course.length:.1f} m, shortest possible {planned.floor:.1f} m")
        plans.append(_plan_table(planned))
        for name, (kind, law) in controllers.items():
            for sight in (None, *(config.line_of_sight if protocol == "enter" else ())):
                flight = fly_course(config, planned, steering, law.double(), sight)
                guidance = "course" if sight is None else sight.kind
                rows.append(row(name, kind, guidance, planned, flight, config.course.acceptance, steering.turning.speed))
                tracks.append(_track_table(name, guidance, protocol, flight))
        _export(config, folder, planned, steering, trained, autopilot, [entry for entry in rows if entry["protocol"] == protocol])
    units = {
        "course_time": "s",
        "floor_time": "s",
        "cross_track_rms": "m",
        "cross_track_max": "m",
        "distances": "m",
        "clearance": "m",
        "travel": "rad",
    }
    shown = {
        "schema": SCHEMA,
        "run": config.name,
        "channels": units,
        "speed": steering.turning.speed,
        "rudder": steering.limit,
        "smallest": vars(steady),
        "feasibility": feasible,
    }
    folder.write_json(folder.metrics, shown | {"rows": rows})
    pd.concat(tracks, ignore_index=True).to_parquet(folder.path / TRACKS)
    pd.concat(plans, ignore_index=True).to_parquet(folder.path / COURSES)
    write_course_report(folder.path)
    print(table(rows))


def load_policy(run: Path, name: str, steering: Steering) -> HeadingPolicy:
    """A trained policy from the run folder of an autopilot, at the step of `steering`.

    Raises:
        UsageError: where the run lacks it.
    """
    from safetensors.torch import load_file

    file, weights = run / "exports" / f"{name}.pt", run / "models" / name / "weights.safetensors"
    if not file.is_file() or not weights.is_file():
        raise UsageError(f"{run}: no policy '{name}' (models/{name}/weights.safetensors and exports/{name}.pt)")
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


def fly_course(config: CourseTaskConfig, planned: PlannedCourse, steering: Steering, law: Policy, sight: AnyLineOfSight | None) -> CourseFlight:
    """One flight of the nominal vessel from the plan's first point and heading; under a line of sight on the legs from buoy to buoy instead."""
    vessel, wanted = steering.vessel, config.course
    plan = CourseGuidance(planned.course, wanted.lookahead, vessel.state)
    reference: Reference = plan
    policy: Policy = Following(law, vessel.state, limit=steering.limit, dt=config.dt, rate=vessel.rate)
    if sight is not None:
        points = [(buoy.north, buoy.east) for buoy in planned.buoys]
        reference, policy = WaypointGuidance(points, wanted.acceptance, sight.build(), vessel.state), law
    x, w = vessel.start(torch.ones(1, dtype=torch.float64))
    place = [vessel.column("x"), vessel.column("y")]
    x[:, place] = torch.tensor([wanted.start], dtype=torch.float64)
    x[:, vessel.column("psi")] = float(planned.course.heading[0])
    steps = round(config.duration / config.dt)
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        states, inputs, _ = Rollout(vessel.model(config.dt), ClosedLoop(policy, reference))(x, w.unsqueeze(1).expand(-1, steps, -1), nominal)
    moving = (states[0].diff(dim=0)[:, place].abs().sum(dim=-1) > 0).nonzero()
    last = int(moving[-1]) + 1
    flown = states[0, : last + 1]
    nearest_place, errors = torch.zeros(1, 1, dtype=torch.float64), []
    for k in range(last + 1):
        _, nearest_place = plan(flown[k : k + 1], k, nearest_place)
        errors.append(float(plan.error(flown[k : k + 1], nearest_place[:, 0])[1]))
    speed = torch.hypot(flown[:, vessel.column("u")], flown[:, vessel.column("v")])
    return CourseFlight(
        flown[:, place].numpy(),
        flown[:, vessel.column("psi")].numpy(),
        inputs[0, : last + 1, 0].numpy(),
        speed.numpy(),
        np.array(errors),
        config.dt,
        last < steps,
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
    columns = {"north": course.track[within, 0], "east": course.track[within, 1], "heading": course.heading[within], "rudder": course.rudder[within]}
    return pd.DataFrame({"protocol": planned.protocol, **columns})


def _export(
    config: CourseTaskConfig,
    folder: RunFolder,
    planned: PlannedCourse,
    steering: Steering,
    trained: HeadingPolicy,
    autopilot: AutopilotConfig,
    rows: list[dict[str, Any]],
) -> None:
    from residnet.export.course import export_course

    file = folder.exports / f"{config.policy}_{planned.protocol}.pt"
    about = {"vessel": autopilot.vessel, "course": config.course.model_dump(mode="json"), "protocol": planned.protocol}
    own = [entry for entry in rows if entry["model"] == config.policy]
    guided = CourseGuidance(planned.course, config.course.lookahead, steering.vessel.state)
    export_course(config.policy, trained, guided, planned.course, file, safe=config.safe, about=about, metrics=own)
    print(f"exported: {file}")

"""Execution of a course run in a run folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from residnet.autopilot.base import ClosedLoop, Policy, Reference
from residnet.autopilot.courses.config import (
    PlannedCourse,
    buoy_feasibility,
    plan_course,
    smallest_turn,
)
from residnet.autopilot.courses.course_check import PassingRule
from residnet.autopilot.courses.turns import SteadyTurn
from residnet.autopilot.evaluation import CourseRun, build_course_row, build_ensemble_row
from residnet.autopilot.export import ExportedCoursePolicy
from residnet.autopilot.guidance import (
    AnyLineOfSight,
    CourseGuidance,
    DriftEstimate,
    TrackKeeping,
    WaypointGuidance,
    WheelOver,
)
from residnet.autopilot.heading.controllers import ControllerConfig, ControlTask
from residnet.autopilot.heading.policies import SteeringPolicy
from residnet.autopilot.heading.steering_variation import NOMINAL, Vessels
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.records import (
    AnyCourseRow,
    ControllerKind,
    ControllerNotes,
    ControllersFile,
    CourseMetricsFile,
    CourseRow,
    SmallestTurn,
)
from residnet.autopilot.report.course import COURSES_FILE, SPREAD_FILE, TRACKS_FILE, tables_text
from residnet.autopilot.tasks.autopilot.config import AutopilotConfig
from residnet.autopilot.tasks.autopilot.execute import load_trained_policy
from residnet.autopilot.training.predictor import load_predictive_controller
from residnet.core.errors import ExportError
from residnet.core.progress import log_message
from residnet.dynamics.simulated import InAmbientCurrent
from residnet.engine.rollout import Rollout
from residnet.evaluation.metrics_file import SCHEMA
from residnet.runs.folder import RunFolder
from residnet.runs.task import ExportRequest, SummaryMetric, TaskOutcome

if TYPE_CHECKING:
    from residnet.autopilot.tasks.course.config import CourseTaskConfig

_COLUMN_UNITS = {
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


def execute(config: CourseTaskConfig, folder: RunFolder) -> TaskOutcome:
    """Train the policy if necessary, plan the courses, simulate and compare."""
    if not config.autopilot.is_dir() and not RunFolder(folder.path / "autopilot").is_finished:
        config.load_autopilot_config().run(
            source=config.autopilot, output_folder=folder.path / "autopilot", resume=True
        )
    autopilot_run = open_autopilot_run(config, folder)
    steering = autopilot_run.steering
    steady_turn = autopilot_run.steady_turn
    radius_feasibility = buoy_feasibility(config.course.buoys, steady_turn.radius)
    for circle in radius_feasibility:
        if not circle.possible:
            log_message(
                f"buoy {circle.buoy}: {circle.radius:.4g} m cannot be followed; the smallest"
                f" radius possible is {circle.smallest:.2f} m"
            )
    controllers = _load_controllers(config, autopilot_run)
    results = _CourseResults([], [], [])
    plans: list[pd.DataFrame] = []
    exports: dict[str, Callable[[], Path]] = {}
    for protocol in config.protocols:
        planned_course, guidance = plan_with_guidance(config, autopilot_run, protocol)
        log_message(
            f"{protocol}: planned {planned_course.course.length:.1f} m; the reference of arcs and"
            f" lines has {planned_course.reference_length:.1f} m"
        )
        plans.append(tabulate_plan(planned_course))
        for name in controllers:
            for line_of_sight in (None, *(config.line_of_sight if protocol == "enter" else ())):
                _run_controller(
                    config,
                    planned_course,
                    steering,
                    name,
                    controllers[name],
                    line_of_sight,
                    results,
                )
        request = ExportRequest(folder, f"{config.policy}_{protocol}")
        exports[request.model] = partial(export_model, config, request, (planned_course, guidance))
    folder.write_record(
        folder.metrics,
        CourseMetricsFile(
            schema=SCHEMA,
            run=config.name,
            channels=_COLUMN_UNITS,
            speed=steering.nomoto.speed,
            rudder=steering.limit,
            smallest=SmallestTurn.model_validate(vars(steady_turn)),
            feasibility=tuple(radius_feasibility),
            rows=tuple(results.rows),
        ),
    )
    folder.write_table(folder.path / TRACKS_FILE, pd.concat(results.tracks, ignore_index=True))
    folder.write_table(folder.path / COURSES_FILE, pd.concat(plans, ignore_index=True))
    if results.spread_tables:
        folder.write_table(
            folder.path / SPREAD_FILE, pd.concat(results.spread_tables, ignore_index=True)
        )
    verdict, summary_metrics = _summarize_policy(config, results.rows)
    return TaskOutcome(verdict, summary_metrics, tables_text(results.rows), exports=exports)


def _load_controllers(config: CourseTaskConfig, autopilot_run: AutopilotRun) -> dict[str, Policy]:
    """Return the trained policy, the peers of the autopilot run and other controllers by name."""
    trained_policy = load_policy(autopilot_run, config.policy)
    policies: dict[str, Policy] = {}
    for name in config.peers:
        if name in autopilot_run.autopilot.predictive:
            policies[name] = load_predictive_controller(
                name,
                autopilot_run.autopilot.predictive[name],
                autopilot_run.steering,
                autopilot_run.run,
            )
        else:
            # the constants as the autopilot run tuned them
            tuned_law = autopilot_run.peer_notes[name].config
            assert isinstance(tuned_law, ControllerConfig)
            policies[name] = tuned_law.build(autopilot_run.steering)
    policies |= {
        name: policy.build(autopilot_run.steering) for name, policy in config.others.items()
    }
    return {
        config.policy: trained_policy,
        **{name: policy.double() for name, policy in policies.items()},
    }


def _summarize_policy(
    config: CourseTaskConfig, rows: list[AnyCourseRow]
) -> tuple[list[str], dict[str, SummaryMetric]]:
    """Return sentences and metrics of the policy on the nominal vessel along each plan."""
    verdict = []
    summary_metrics = dict[str, SummaryMetric]()
    for result_row in rows:
        # random vessels have their own table
        if not isinstance(result_row, CourseRow):
            continue
        if (result_row.model, result_row.guidance) != (config.policy, "course"):
            continue
        protocol = result_row.protocol
        summary_metrics[f"{protocol}_course_time"] = SummaryMetric(result_row.course_time, "s")
        summary_metrics[f"{protocol}_ratio"] = SummaryMetric(result_row.ratio)
        summary_metrics[f"{protocol}_cross_track_rms"] = SummaryMetric(
            result_row.cross_track_rms, "m"
        )
        passing_text = "and passes all" if result_row.passed else "but does NOT pass all"
        verdict.append(
            f"{protocol}: '{config.policy}' needs {result_row.course_time:.1f} s,"
            f" {result_row.ratio:.3f} times the time of the reference, {passing_text}"
            f" {len(config.course.buoys)} buoys as the protocol requires."
            if result_row.finished
            else f"{protocol}: '{config.policy}' did not reach the end of the course."
        )
    return verdict, summary_metrics


class AutopilotRun(NamedTuple):
    """The finished autopilot run that provides vessel and controllers of the courses.

    Attributes:
        autopilot: config of the autopilot run.
        run: folder of the autopilot run.
        steering: vessel, K and T, rudder limit and time step.
        steady_turn: smallest steady turn of the vessel.
        peer_notes: notes on the controllers by name, with the tuned configs of the peers.
    """

    autopilot: AutopilotConfig
    run: RunFolder
    steering: ControlTask
    steady_turn: SteadyTurn
    peer_notes: dict[str, ControllerNotes]


def open_autopilot_run(config: CourseTaskConfig, folder: RunFolder) -> AutopilotRun:
    """Read the finished autopilot run: the given one, or the one in the folder of the course.

    Raises:
        UsageError: if it is not finished.
    """
    autopilot = config.load_autopilot_config()
    run_folder = RunFolder.open(
        config.autopilot if config.autopilot.is_dir() else folder.path / "autopilot"
    )
    notes = ControllersFile.read(run_folder.path / "controllers.json")
    steering = ControlTask(
        autopilot.steered_vessel,
        NomotoModel.from_json(notes.turning.model_dump()),
        autopilot.rudder,
        config.dt,
    )
    return AutopilotRun(
        autopilot,
        run_folder,
        steering,
        smallest_turn(config.course, steering.vessel, steering.nomoto, steering.limit),
        notes.controllers,
    )


def load_policy(autopilot_run: AutopilotRun, name: str) -> SteeringPolicy:
    """Return a trained policy of the autopilot run, with the time step of the course.

    Raises:
        UsageError: if the run has no such policy, or its file was changed.
    """
    steering = autopilot_run.steering
    policy = load_trained_policy(
        autopilot_run.autopilot, autopilot_run.run.models, name, steering.dt
    )
    policy.set_state_columns(steering.vessel.state)
    return policy


def plan_with_guidance(
    config: CourseTaskConfig, autopilot_run: AutopilotRun, protocol: PassingRule
) -> tuple[PlannedCourse, CourseGuidance]:
    """Return the plan of a protocol, and the guidance along it.

    Raises:
        ConfigError: if no course is possible with the turns of the vessel.
    """
    steering = autopilot_run.steering
    planned_course = plan_course(
        config.course,
        protocol,
        steering.vessel,
        steering.nomoto,
        steering.limit,
        autopilot_run.steady_turn,
    )
    return planned_course, make_course_guidance(config, planned_course, steering)


def make_course_guidance(
    config: CourseTaskConfig, planned_course: PlannedCourse, steering: ControlTask
) -> CourseGuidance:
    """Return the line-of-sight guidance along a course, with a drift estimate if configured."""
    lookahead = config.course.lookahead
    drift = (
        None if config.integral is None else DriftEstimate(lookahead, config.integral, steering.dt)
    )
    return CourseGuidance(planned_course.course, lookahead, steering.vessel.state, drift)


class _CourseResults(NamedTuple):
    """Rows of metrics.json, tracks of the nominal vessel, and results of the random vessels."""

    rows: list[AnyCourseRow]
    tracks: list[pd.DataFrame]
    spread_tables: list[pd.DataFrame]


def _run_controller(
    config: CourseTaskConfig,
    planned_course: PlannedCourse,
    steering: ControlTask,
    name: str,
    policy: Policy,
    line_of_sight: AnyLineOfSight | None,
    results: _CourseResults,
) -> None:
    """Simulate the nominal vessel and the random ones with one controller and guidance."""
    role: ControllerKind = "policy" if name == config.policy else "classical"
    guidance = "course" if line_of_sight is None else line_of_sight.kind
    loop_parts = _build_loop_parts(config, planned_course, steering, policy, line_of_sight)

    def simulate_vessels(vessels: Vessels) -> tuple[list[CourseRun], list[CourseRow]]:
        course_runs = simulate_course(
            steering, *loop_parts, planned_course, config.course.lookahead, config.duration, vessels
        )
        return course_runs, [
            build_course_row(
                name,
                role,
                guidance,
                planned_course,
                course_run,
                config.course.acceptance,
                steering.nomoto.speed,
            )
            for course_run in course_runs
        ]

    course_runs, rows = simulate_vessels(NOMINAL)
    results.rows.extend(rows)
    course_run = course_runs[0]
    stride = max(round(_TRACK_INTERVAL / course_run.dt), 1)
    n_samples = len(course_run.track)
    columns = {
        "controller": name,
        "guidance": guidance,
        "protocol": planned_course.protocol,
        "t": course_run.dt * np.arange(n_samples)[::stride],
        "north": course_run.track[::stride, 0],
        "east": course_run.track[::stride, 1],
        "psi": course_run.heading[::stride],
        "rudder": np.resize(course_run.rudder, n_samples)[::stride],
        "speed": course_run.speed[::stride],
        "cross_track": course_run.cross_track[::stride],
    }
    results.tracks.append(pd.DataFrame(columns))
    if config.spread is not None:
        vessels = config.spread.sample_vessels()
        rows = simulate_vessels(vessels)[1]
        results.rows.append(build_ensemble_row(rows))
        results.spread_tables.append(tabulate_spread(rows, vessels))


def _build_loop_parts(
    config: CourseTaskConfig,
    planned_course: PlannedCourse,
    steering: ControlTask,
    policy: Policy,
    line_of_sight: AnyLineOfSight | None,
) -> tuple[Policy, Reference]:
    """Return controller and guidance along the plan, or by line of sight from buoy to buoy."""
    vessel = steering.vessel
    if line_of_sight is None:
        return TrackKeeping(
            policy, vessel.state, limit=steering.limit, dt=steering.dt, rate=vessel.rate
        ), make_course_guidance(config, planned_course, steering)
    points = [(buoy.north, buoy.east) for buoy in planned_course.buoys]
    acceptance = config.course.acceptance
    wheel_over = (
        WheelOver(steering.nomoto, steering.limit, acceptance, rate=vessel.rate)
        if config.legs_change == "wheel_over"
        else None
    )
    return policy, WaypointGuidance(
        points, acceptance, line_of_sight.build(steering.dt), vessel.state, wheel_over
    )


def simulate_course(
    steering: ControlTask,
    policy: Policy,
    reference: Reference,
    planned_course: PlannedCourse,
    lookahead: float,
    duration: float,
    vessels: Vessels,
) -> list[CourseRun]:
    """Simulate each vessel once, from the first point and heading of the plan.

    Args:
        steering: vessel, rudder limit and time step.
        policy: controller.
        reference: guidance.
        planned_course: course to which cross-track errors refer.
        lookahead: look-ahead distance of the guidance in m.
        duration: time limit of a simulation in s.
        vessels: variations of the steering, and the currents.
    """
    vessel = steering.vessel
    n_vessels = len(vessels.variation)
    steps = round(duration / steering.dt)
    position_columns = [vessel.state_column("x"), vessel.state_column("y")]
    x, w = vessel.straight_course(torch.ones(n_vessels, dtype=torch.float64))
    x[:, position_columns] = torch.from_numpy(planned_course.course.track[0])
    x[:, vessel.state_column("psi")] = float(planned_course.course.heading[0])
    model = InAmbientCurrent(vessel.model(steering.dt), vessel.state)
    closed_loop = Rollout(model, ClosedLoop(policy, reference))
    memory = torch.cat((vessels.current, vessel.memory(vessels.variation)), dim=-1)
    with torch.no_grad():
        states, inputs, _ = closed_loop(x, w.unsqueeze(1).expand(-1, steps, -1), memory)
        is_moving = (states.diff(dim=1)[:, :, position_columns].abs().sum(dim=-1) > 0).numpy()
        last_steps = [int(np.flatnonzero(row)[-1]) + 1 for row in is_moving]
        cross_track = _cross_track_errors(
            CourseGuidance(planned_course.course, lookahead, vessel.state),
            states[:, : max(last_steps) + 1],
        )
    speed = torch.hypot(
        states[:, :, vessel.state_column("u")], states[:, :, vessel.state_column("v")]
    )
    psi = states[:, :, vessel.state_column("psi")]
    return [
        CourseRun(
            states[row, : last_step + 1, position_columns].numpy(),
            psi[row, : last_step + 1].numpy(),
            inputs[row, : last_step + 1, 0].numpy(),
            speed[row, : last_step + 1].numpy(),
            cross_track[row, : last_step + 1].numpy(),
            steering.dt,
            last_step < steps,
        )
        for row, last_step in enumerate(last_steps)
    ]


def _cross_track_errors(course_guidance: CourseGuidance, states: Tensor) -> Tensor:
    """Return the cross-track errors [B, T] in m of states [B, T, nx]."""
    guidance_state = course_guidance.initial_state(states[:, 0])
    errors = []
    for k in range(states.shape[1]):
        _, guidance_state = course_guidance(states[:, k], k, guidance_state)
        errors.append(course_guidance.track_error(states[:, k], guidance_state[:, 0])[1])
    return torch.stack(errors, dim=1)


_TRACK_INTERVAL = 0.1
"""Seconds between the stored samples of a track."""


def tabulate_spread(rows: Sequence[CourseRow], vessels: Vessels) -> pd.DataFrame:
    """Return one line for each simulation of the varied vessels."""
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
    sampled_values = {
        "effect": vessels.variation[:, 0],
        "time": vessels.variation[:, 1],
        "bias": vessels.variation[:, 2],
    }
    sampled_values |= {
        "current_north": vessels.current[:, 0],
        "current_east": vessels.current[:, 1],
    }
    return pd.DataFrame(
        {name: [getattr(row, name) for row in rows] for name in columns}
        | {name: values.numpy() for name, values in sampled_values.items()}
    )


def tabulate_plan(planned_course: PlannedCourse) -> pd.DataFrame:
    """Return the planned course up to its end: positions in m, heading and rudder in rad."""
    course = planned_course.course
    is_on_course = course.step * np.arange(len(course.track)) <= course.length
    columns = {
        "north": course.track[is_on_course, 0],
        "east": course.track[is_on_course, 1],
        "heading": course.heading[is_on_course],
        "rudder": course.rudder[is_on_course],
    }
    return pd.DataFrame({"protocol": planned_course.protocol, **columns})


_MAX_PLAN_DEVIATION = 1e-6
"""Turning radii by which a course planned again may differ from the one that was flown."""


def _replan_and_verify(
    config: CourseTaskConfig, autopilot_run: AutopilotRun, run: RunFolder, protocol: PassingRule
) -> tuple[PlannedCourse, CourseGuidance]:
    planned_course, guidance = plan_with_guidance(config, autopilot_run, protocol)
    new_plan = tabulate_plan(planned_course)
    recorded_plan = pd.read_parquet(run.path / COURSES_FILE)
    position_columns = ["north", "east"]
    recorded_plan = recorded_plan[recorded_plan["protocol"] == protocol]
    if (
        len(new_plan) != len(recorded_plan)
        or not (
            np.abs(
                new_plan[position_columns].to_numpy() - recorded_plan[position_columns].to_numpy()
            )
            <= _MAX_PLAN_DEVIATION * autopilot_run.steady_turn.radius
        ).all()
    ):
        raise ExportError(
            f"{run.path}: the course that is planned for '{protocol}' differs from that of the"
            " run; repeat the run with this version"
        )
    return planned_course, guidance


def export_model(
    config: CourseTaskConfig,
    request: ExportRequest,
    existing_plan: tuple[PlannedCourse, CourseGuidance] | None = None,
) -> Path:
    """Write a policy with the guidance of a course; returns the file.

    If no planned course is passed, it is planned again.

    Raises:
        UsageError: if the run has no course of this name.
        ExportError: if the planned course differs from the course of the run.
    """
    protocols = {f"{config.policy}_{protocol}": protocol for protocol in config.protocols}
    name = request.resolve_model_name(protocols)
    autopilot_run = open_autopilot_run(config, request.run)
    run = request.run
    protocol = protocols[name]
    planned_course, guidance = existing_plan or _replan_and_verify(
        config, autopilot_run, run, protocol
    )
    metrics = CourseMetricsFile.read(run.metrics)
    exported = ExportedCoursePolicy(
        config.policy,
        load_policy(autopilot_run, config.policy),
        guidance,
        planned_course.course,
        fallback=config.safe,
        description={
            "vessel": autopilot_run.autopilot.vessel,
            "course": config.course.model_dump(mode="json"),
            "protocol": protocol,
        },
        metrics=[
            row for row in metrics.rows if row.model == config.policy and row.protocol == protocol
        ],
    )
    return request.write(exported, stem=name)

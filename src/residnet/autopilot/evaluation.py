"""Metrics of heading controllers: step responses, random conditions, motion control and courses.

The duration of a course is compared with a reference course of arcs and straight lines.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from residnet.autopilot.base import Policy
from residnet.autopilot.courses.config import PlannedCourse
from residnet.autopilot.courses.course_check import find_passages
from residnet.autopilot.heading.conditions import (
    ClosedLoopSimulation,
    ClosedLoopTrajectories,
    ConditionsConfig,
    HeadingStepBatch,
    SteadinessLimits,
    simulate_heading_steps,
)
from residnet.autopilot.heading.vessels import SteeredPlant, SteeredVessel
from residnet.autopilot.records import (
    ControllerKind,
    CourseEnsembleRow,
    CourseRow,
    Distribution,
    HeadingRow,
)
from residnet.core.columns import all_but_pose
from residnet.core.frames import wrap_angle
from residnet.core.layout import HEADING, POSITION, RANGE_VELOCITIES
from residnet.manoeuvres.trials_config import DisturbanceConfig
from residnet.physics.environment_config import WavesConfig
from residnet.physics.plant import Plant

METRIC_UNITS = {
    "settling": "s",
    "overshoot": "rad",
    "iae": "rad s",
    "travel": "rad",
    "energy": "rad^2 s",
}
"""Metrics of a row with units: last entry into the band, overshoot, integral of the absolute error,
travel of the rudder command, integral of its square.
"""


def compute_run_metrics(
    trajectories: ClosedLoopTrajectories, tolerance: float
) -> dict[str, Tensor]:
    """Return each metric of `METRIC_UNITS` [B] by name."""
    values = (
        trajectories.settling_time(tolerance),
        trajectories.overshoot(),
        trajectories.integrated_absolute_error(),
        trajectories.rudder_travel(),
        trajectories.control_effort(),
    )
    return dict(zip(METRIC_UNITS, values, strict=True))


def summarize_distribution(values: Tensor) -> Distribution:
    """Return mean, median, 95th percentile and maximum of values [B]."""
    array = values.double().numpy()
    return Distribution(
        mean=float(array.mean()),
        median=float(np.median(array)),
        p95=float(np.quantile(array, 0.95)),
        max=float(array.max()),
    )


def list_policy_objections(model: str, rows: Sequence[HeadingRow]) -> list[str]:
    """List reasons against a policy compared with tuned laws, from rows of metrics.json."""
    return _describe_cheaper_law(model, rows, "conditions", "under its conditions")


def list_unsuitable_conditions(model: str, rows: Sequence[HeadingRow]) -> list[str]:
    """List further conditions under which a tuned law has a lower cost than a policy."""
    protocols = dict.fromkeys(row.protocol for row in rows if row.protocol.startswith("beyond_"))
    return [
        objection
        for protocol in protocols
        for objection in _describe_cheaper_law(model, rows, protocol, f"under '{protocol[7:]}'")
    ]


def describe_limit_cycles(model: str, rows: Sequence[HeadingRow]) -> list[str]:
    """Describe in how many noise-free simulations a policy has a limit cycle; empty if none."""
    rows_by_model = {row.model: row for row in rows if row.protocol == "quiet"}
    policy_row = rows_by_model.get(model)
    if policy_row is None or not policy_row.cycling or policy_row.rudder_swing is None:
        return []
    steady_laws = [
        name for name, row in rows_by_model.items() if row.kind == "classical" and not row.cycling
    ]
    return [
        f"'{model}' has a limit cycle in {policy_row.cycling} of {policy_row.n} simulations"
        " without noise, with a peak-to-peak"
        f" command of up to {math.degrees(policy_row.rudder_swing.max):.3g} deg; "
        + (f"none with {', '.join(steady_laws)}." if steady_laws else "so has each tuned law.")
    ]


def _describe_cheaper_law(
    model: str, rows: Sequence[HeadingRow], protocol: str, condition_text: str
) -> list[str]:
    """Describe the cheapest tuned law if its cost is below the cost of a policy."""
    costs = {
        row.model: (row.kind, row.cost.mean)
        for row in rows
        if row.protocol == protocol and row.cost is not None
    }
    laws = {name: cost for name, (role, cost) in costs.items() if role == "classical"}
    if model not in costs or not laws:
        return []
    policy_cost = costs[model][1]
    cheapest_law = min(laws, key=laws.__getitem__)
    # a policy without any improvement equals its initial law up to rounding
    if policy_cost <= laws[cheapest_law] or math.isclose(policy_cost, laws[cheapest_law]):
        return []
    return [
        f"{condition_text} the mean cost is {policy_cost:.4g} s, with {cheapest_law}"
        f" {laws[cheapest_law]:.4g} s"
    ]


def _build_row(
    controller: str,
    role: ControllerKind,
    protocol: str,
    metrics: Mapping[str, Tensor],
    **counts: int,
) -> HeadingRow:
    """Build a row of metrics.json with distributions of metrics [B] and counts, both by name."""
    distributions = {name: summarize_distribution(values) for name, values in metrics.items()}
    return HeadingRow.model_validate(
        {
            "model": controller,
            "kind": role,
            "split": "simulated",
            "protocol": protocol,
            **distributions,
            **counts,
        }
    )


def build_step_row(
    controller: str,
    role: ControllerKind,
    protocol: str,
    trajectories: ClosedLoopTrajectories,
    tolerance: float,
) -> HeadingRow:
    """Build a row of metrics.json with distributions and the number of unsettled simulations.

    Args:
        controller: name of the controller.
        role: role of the controller, such as `classical`.
        protocol: name of the test.
        trajectories: simulations of the test.
        tolerance: half width in rad of the band of the error in which a simulation has settled.
    """
    is_finite = torch.isfinite(trajectories.states).all(dim=2).all(dim=1)
    is_unsettled = (trajectories.error[:, -1].abs() > tolerance) | ~is_finite
    return _build_row(
        controller,
        role,
        protocol,
        compute_run_metrics(trajectories, tolerance),
        unsettled=int(is_unsettled.sum()),
        n=len(is_finite),
        diverged=int((~is_finite).sum()),
    )


def build_variation_grid(
    effect_range: tuple[float, float], time_range: tuple[float, float]
) -> Tensor:
    """Return a grid of effect and time without bias, [9, 3], with the nominal vessel first."""
    return torch.tensor(
        [
            (effect_factor, time_factor, 0.0)
            for effect_factor in (1.0, *effect_range)
            for time_factor in (1.0, *time_range)
        ]
    ).double()


def draw_variations(
    effect_range: tuple[float, float], time_range: tuple[float, float], n_variations: int, seed: int
) -> Tensor:
    """Sample effect and time uniformly from their ranges, without bias: [n_variations, 3]."""
    uniform = torch.rand(
        n_variations, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    lower, upper = torch.tensor([effect_range, time_range], dtype=torch.float64).T
    return torch.cat(
        (lower + (upper - lower) * uniform, torch.zeros(n_variations, 1).double()), dim=1
    )


def simulate_steps(
    vessel: SteeredVessel,
    policy: Policy,
    heading_step: float,
    dt: float,
    duration: float,
    variations: Tensor,
) -> ClosedLoopTrajectories:
    """Simulate steps of the reference, alternately to starboard and to port."""
    turn_sign = torch.where(torch.arange(len(variations)) % 2 == 0, 1.0, -1.0)
    return simulate_heading_steps(
        vessel, policy, heading_step * turn_sign, variations, dt=dt, duration=duration
    )


def simulate_steps_in_wind(
    plant: Plant, policy: Policy, speed: float, heading_step: float, dt: float, duration: float
) -> ClosedLoopTrajectories:
    """Simulate reference steps of the nominal vessel in wind from eight directions.

    Args:
        plant: simulated vessel.
        policy: controller of the heading.
        speed: wind speed in m/s.
        heading_step: change of the reference heading in rad.
        dt: time step in s.
        duration: duration of a simulation in s.
    """
    wind_channels: dict[str, float | Tensor] = {
        "wind_speed": speed,
        "wind_dir": torch.arange(8) * (torch.pi / 4.0),
    }
    vessel = SteeredPlant(plant, in_calm_water=False)
    heading_steps = torch.full((8,), heading_step)
    return simulate_heading_steps(
        vessel,
        policy,
        heading_steps,
        _nominal_variations(8),
        dt=dt,
        duration=duration,
        weather=wind_channels,
    )


def simulate_steps_in_waves(
    plant: Plant,
    policy: Policy,
    waves: WavesConfig,
    heading_step: float,
    dt: float,
    duration: float,
    seed: int,
) -> ClosedLoopTrajectories:
    """Simulate reference steps of the nominal vessel in eight seaways.

    Args:
        plant: simulated vessel.
        policy: controller of the heading.
        waves: spectrum of the waves.
        heading_step: change of the reference heading in rad.
        dt: time step in s.
        duration: duration of a simulation in s.
        seed: seed of the phases of the waves.
    """
    disturbance = DisturbanceConfig(waves=waves)
    n_seaways = 8
    return simulate_heading_steps(
        SteeredPlant(plant, in_calm_water=False),
        policy,
        torch.full((n_seaways,), heading_step),
        _nominal_variations(n_seaways),
        dt=dt,
        duration=duration,
        wrap_source=lambda source: disturbance.add_waves(source, plant, n_seaways, dt, seed),
    )


def build_sea_row(
    controller: str,
    role: ControllerKind,
    trajectories: ClosedLoopTrajectories,
    start_time: float,
) -> HeadingRow:
    """Build a row of metrics.json with RMS values from `start_time` s on.

    The values are heading error, rudder and, for a vessel with roll, heel.
    """
    signals = {"heading": trajectories.error, "rudder": trajectories.command}
    if "phi" in trajectories.names:
        signals["heel"] = trajectories.state("phi")
    first_sample = round(start_time / trajectories.dt)
    rms_values = {
        f"{key}_rms": signal[:, first_sample:].square().mean(1).sqrt()
        for key, signal in signals.items()
    }
    return _build_row(controller, role, "sea", rms_values, n=len(trajectories.target))


def _nominal_variations(count: int) -> Tensor:
    return torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(count, -1)


def build_time_series(
    name: str, trajectories: ClosedLoopTrajectories, variations: Tensor
) -> pd.DataFrame:
    """Return heading or depth, its rate and rudder every 0.05 s, mirrored to starboard."""
    stride = max(round(0.05 / trajectories.dt), 1)
    tables = []
    for i, variation in enumerate(variations):
        turn_sign = 1.0 if i % 2 == 0 else -1.0
        tables.append(
            pd.DataFrame(
                {
                    "controller": name,
                    "effect": float(variation[0]),
                    "time": float(variation[1]),
                    "t": torch.arange(0, trajectories.command.shape[1], stride).numpy()
                    * trajectories.dt,
                    **{
                        state: turn_sign * trajectories.state(state)[i, :-1:stride].numpy()
                        for state in (trajectories.axis.value, trajectories.axis.rate)
                    },
                    "rudder": turn_sign * trajectories.command[i, ::stride].numpy(),
                }
            )
        )
    return pd.concat(tables, ignore_index=True)


_SWING_TOLERANCE = 1.25
"""Factor from the limits of oscillation in training to the accepted limits, which are 25 % larger.
"""
N_QUIET_RUNS = 100
"""Number of simulations without noise, waves and disturbance."""


def draw_heading_changes(conditions: ConditionsConfig, n_runs: int, seed: int) -> HeadingStepBatch:
    """Sample heading changes that are not used in tuning or training."""
    generator = torch.Generator().manual_seed(seed + 2_000_003)
    return conditions.sample_steps(n_runs, conditions.dt, generator)


def evaluate_under_conditions(
    controller: str,
    role: ControllerKind,
    protocol: str,
    run: ClosedLoopSimulation,
    conditions: ConditionsConfig,
    changes: HeadingStepBatch,
) -> tuple[HeadingRow, pd.DataFrame]:
    """Build a row of metrics.json, and a table with a line for each simulation, in SI units.

    A simulation with a NaN heading counts as diverged, with a heading error of 180 deg at all
    times in the means.

    Args:
        controller: name of the controller.
        role: role of the controller, such as `classical`.
        protocol: name of the test.
        run: closed loop of vessel and controller.
        conditions: conditions of the simulations, and weights of their cost.
        changes: changes of the reference heading.
    """
    trajectories = run.simulate(changes)
    controlled_angle = trajectories.state(trajectories.axis.value)[:, :-1]
    is_finite = torch.isfinite(controlled_angle).all(1) & torch.isfinite(trajectories.command).all(
        1
    )
    worst_cost = conditions.duration + 0.5 * 180.0
    metrics = {
        name: torch.where(is_finite, values, worst_cost if name == "cost" else torch.nan)
        for name, values in trajectories.step_metrics(conditions).items()
    }
    finite_metrics = {
        name: values if name == "cost" else values[is_finite] for name, values in metrics.items()
    }
    available_metrics = {name: values for name, values in finite_metrics.items() if len(values)}
    table = pd.DataFrame(
        {
            "controller": controller,
            "protocol": protocol,
            "flight": range(len(is_finite)),
            **{name: values.numpy() for name, values in metrics.items()},
        }
    )
    row = _build_row(
        controller,
        role,
        protocol,
        available_metrics,
        n=len(is_finite),
        diverged=int((~is_finite).sum()),
    )
    return row, table


def evaluate_limit_cycles(
    controller: str,
    role: ControllerKind,
    run: ClosedLoopSimulation,
    changes: HeadingStepBatch,
    settling_time: float,
) -> HeadingRow:
    """Build the row of metrics.json of noise-free simulations: limit cycles at their end.

    Limit cycles are evaluated from `settling_time` s after the change of reference.
    """
    trajectories = run.simulate(changes)
    heading_swing, rudder_swing = trajectories.peak_to_peak(settling_time)
    steadiness_limits = SteadinessLimits()
    tolerances = (
        _SWING_TOLERANCE * steadiness_limits.limits_for(trajectories.axis).swing,
        _SWING_TOLERANCE * steadiness_limits.rudder_swing,
    )
    # NaN fails the comparison and counts as a limit cycle
    is_steady = (heading_swing <= tolerances[0]) & (rudder_swing <= tolerances[1])
    swings = {"heading_swing": heading_swing, "rudder_swing": rudder_swing}
    return _build_row(
        controller,
        role,
        "quiet",
        swings,
        cycling=int((~is_steady).sum()),
        n=len(heading_swing),
    )


@dataclass(frozen=True)
class TrackingMetrics:
    """Metrics of a closed-loop simulation of motion control; SI, angles in rad.

    Equations and tables are those of Jervan 2020.

    Attributes:
        position_mae, position_mse: mean and mean square distance to the desired position in m, m^2
            (4.6).
        heading_mae, heading_mse: mean absolute and mean square of the wrapped heading error in rad,
            rad^2 (4.7).
        tau: mean |tau| commanded in surge, sway, yaw.
        feedback: mean |tau_FB| in surge, sway, yaw.
        motion_mse: mean square errors of velocities and accelerations in (m/s)^2,
            (m/s)^2, (rad/s)^2 and per second squared (Table 4.8).
        energy: integral of |tau' nu| in J, surge and sway, then yaw.
        power: `energy` per second in W (Table 4.13).
        iaew: integral of the absolute error times the work, which is the integral of the power
            (3.18), for position [m s J] and heading [rad s J].
    """

    position_mae: float
    position_mse: float
    heading_mae: float
    heading_mse: float
    tau: tuple[float, float, float]
    feedback: tuple[float, float, float]
    motion_mse: tuple[float, ...]
    energy: tuple[float, float]
    power: tuple[float, float]
    iaew: tuple[float, float]

    def to_json(self) -> dict[str, float | list[float]]:
        """Return the metrics by the names of their attributes, with tuples as lists."""
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self).items()
        }


def compute_tracking_metrics(
    pose: Tensor,
    motion: Tensor,
    desired_motion: Tensor,
    command: Tensor,
    feedback: Tensor,
    dt: float,
) -> TrackingMetrics:
    """Compute the metrics of a closed-loop simulation.

    Args:
        pose: x, y, psi [T, 3].
        motion: nu, nu_dot [T, 6].
        desired_motion: eta_d, nu_d, nu_dot_d [T, 9].
        command: tau_c [T, 3].
        feedback: feedback part tau_FB of the command [T, 3].
        dt: time step in s.
    """
    position_error = (desired_motion[:, POSITION] - pose[:, POSITION]).norm(dim=-1)
    heading_error = wrap_angle(desired_motion[:, HEADING] - pose[:, HEADING]).abs()
    power = command * motion[:, RANGE_VELOCITIES]
    # the power for the position and the power for the heading are separate (Table 4.13)
    energy = [float(power[:, :2].sum(-1).abs().sum() * dt), float(power[:, 2].abs().sum() * dt)]
    integrated_errors = [float(position_error.sum() * dt), float(heading_error.sum() * dt)]
    duration = dt * len(pose)
    motion_mse = (all_but_pose(desired_motion) - motion).square().mean(0).tolist()
    mean_command = command.abs().mean(0).tolist()
    mean_feedback = feedback.abs().mean(0).tolist()
    return TrackingMetrics(
        float(position_error.mean()),
        float(position_error.square().mean()),
        float(heading_error.mean()),
        float(heading_error.square().mean()),
        (mean_command[0], mean_command[1], mean_command[2]),
        (mean_feedback[0], mean_feedback[1], mean_feedback[2]),
        tuple(motion_mse),
        (energy[0], energy[1]),
        (energy[0] / duration, energy[1] / duration),
        (integrated_errors[0] * energy[0], integrated_errors[1] * energy[1]),
    )


def mean_squares_by_axis(residuals: Tensor) -> list[float]:
    """Return the mean square of residuals [N, 3] in surge, sway and yaw, in squared units."""
    return [float(value) for value in torch.mean(residuals.square(), dim=0)]


Array = NDArray[np.float64]


@dataclass(frozen=True)
class CourseRun:
    """Simulation of one vessel on one course.

    Attributes:
        track: north and east [N, 2] in m.
        heading: heading [N] in rad.
        rudder: rudder command [N] in rad.
        speed: speed [N] in m/s.
        cross_track: cross-track error [N] in m, positive to starboard of the plan.
        dt: time step in s.
        finished: whether the end of the course was reached within the duration.
    """

    track: Array
    heading: Array
    rudder: Array
    speed: Array
    cross_track: Array
    dt: float
    finished: bool


def build_course_row(
    model: str,
    role: ControllerKind,
    guidance: str,
    planned: PlannedCourse,
    run: CourseRun,
    acceptance_radius: float,
    service_speed: float,
) -> CourseRow:
    """Return the row of metrics.json of the nominal vessel on a course.

    Args:
        model: name of the controller.
        role: role of the controller.
        guidance: `course`, or the kind of line of sight.
        planned: the planned course.
        run: simulation of the vessel on the course.
        acceptance_radius: radius in m of the circles under the rule `enter`.
        service_speed: speed in m/s for the duration of the reference course.
    """
    must_enter = planned.protocol == "enter"
    buoys = [
        buoy.model_copy(update={"radius": acceptance_radius}) if must_enter else buoy
        for buoy in planned.buoys
    ]
    closest_passages = find_passages(run.track, buoys)
    course_time = (len(run.track) - 1) * run.dt
    yaw_rate = np.abs(np.diff(run.heading)) / run.dt
    boundary_distances = [
        passage.min_distance - buoy.radius
        for passage, buoy in zip(closest_passages, buoys, strict=True)
    ]
    margins = [-distance for distance in boundary_distances] if must_enter else boundary_distances
    n_cleared = sum(bool(margin >= 0) for margin in margins)
    n_on_correct_side = len(closest_passages)
    rule_counts: dict[str, Any] = {"entered": n_cleared}
    if not must_enter:
        n_on_correct_side = sum(
            closest_passage.buoy_side == buoy.leave_to
            for closest_passage, buoy in zip(closest_passages, buoys, strict=True)
        )
        rule_counts = {
            "right_side": n_on_correct_side,
            "clear": n_cleared,
            "clearance": float(min(margins)),
        }
    return CourseRow(
        model=model,
        kind=role,
        guidance=guidance,
        split="simulated",
        protocol=planned.protocol,
        finished=run.finished,
        course_time=course_time,
        reference_time=planned.reference_length / service_speed,
        ratio=course_time * service_speed / planned.reference_length,
        ratio_turning=course_time * planned.steady.speed / planned.reference_length,
        cross_track_rms=float(np.sqrt(np.mean(run.cross_track**2))),
        cross_track_max=float(np.abs(run.cross_track).max()),
        travel=float(abs(run.rudder[0]) + np.abs(np.diff(run.rudder)).sum()),
        tightest_turn=float((run.speed[:-1] / np.maximum(yaw_rate, 1e-9)).min()),
        distances=tuple(float(passage.min_distance) for passage in closest_passages),
        **rule_counts,
        passed=n_on_correct_side == n_cleared == len(closest_passages),
        margin=float(min(margins)),
        n=len(closest_passages),
    )


def build_ensemble_row(rows: Sequence[CourseRow]) -> CourseEnsembleRow:
    """Build the row of metrics.json of random vessels from the row of each simulation."""

    def mean_share(flags: Iterable[bool]) -> float:
        return float(np.mean(list(flags)))

    ratios = np.array([row.ratio for row in rows])
    margins = np.array([row.margin for row in rows])
    return CourseEnsembleRow(
        model=rows[0].model,
        kind=rows[0].kind,
        guidance=rows[0].guidance,
        protocol=rows[0].protocol,
        reference_time=rows[0].reference_time,
        split="spread",
        n=len(rows),
        passed=mean_share(row.passed for row in rows),
        finished=mean_share(row.finished for row in rows),
        ratio=float(np.median(ratios)),
        ratio_worst=float(ratios.max()),
        margin=float(np.median(margins)),
        margin_worst=float(margins.min()),
        cross_track_rms=float(np.median([row.cross_track_rms for row in rows])),
    )

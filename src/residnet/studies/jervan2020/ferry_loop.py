"""A ferry in closed loop: the true plant, a controller with a believed model, and the log.

Source: Jervan 2020, chapter 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import final

import torch
from pydantic import Field
from torch import Tensor

from residnet.autopilot.base import ClosedLoop, ReferenceInInputs
from residnet.autopilot.evaluation import TrackingMetrics, compute_tracking_metrics
from residnet.autopilot.guidance import Crossing, CrossingConfig
from residnet.autopilot.heading.conditions import compile_or_fallback
from residnet.autopilot.motion import (
    AllocatedPolicy,
    FeedForwardForce,
    LagCompensatedPID,
    MotionPID,
    required_force,
    sample_filtered_course,
    stack_reference,
)
from residnet.autopilot.motion_config import (
    ActuatorLag,
    Gain,
    MotionPIDConfig,
    ReferenceFilterConfig,
)
from residnet.core.config import (
    Config,
    Metres,
    MetresPerSecond,
    Newtons,
    Radians,
    RadiansPerSecond,
    Seconds,
    quantity_type,
)
from residnet.core.errors import ConfigError, DataError
from residnet.core.layout import ACTUATORS, MOTION, POSE, VELOCITIES
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.compiled import CompiledRollout
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import FreeRun, Rollout, Source
from residnet.physics.actuators.base import ForceActuators
from residnet.physics.actuators.thrusters import AzimuthThrusters
from residnet.physics.hull import HullConfig
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

_MIN_COMPILED_STEPS = 2500
"""Number of steps of a simulation from which compilation pays."""
FeedForwardModel = tuple[FeedForwardForce, ActuatorLag | None]
"""A model as feed-forward, and the thruster lag that it compensates; None for none."""


class LoopConfig(Config):
    """A PID controller with critically damped poles, and the sampling of its log.

    The gains are Kp = m omega^2, Kd = 2 m omega and Ki = integral omega Kp, with m the believed
    mass of each axis. The document does not print its gains; J10 in
    docs/documents/corrections.md says how they were identified.

    Attributes:
        frequency: omega of surge, sway and yaw in rad/s.
        integral: share of omega Kp that is the integral gain, without unit.
        step: time step of controller and plant in s.
        steps_per_sample: number of steps from one sample of the log to the next.
    """

    frequency: tuple[RadiansPerSecond, RadiansPerSecond, RadiansPerSecond]
    integral: Gain = 0.1
    step: Seconds = Field(default=0.02, gt=0)
    steps_per_sample: int = Field(default=5, ge=1)

    def build_pid(self, hull_mass: Tensor) -> MotionPID:
        """Return the feedback for a hull's mass matrix [3, 3] in SI units."""
        mass = hull_mass.diagonal()
        omega = torch.tensor(self.frequency, dtype=torch.float64)
        proportional = mass * omega**2
        gains = [
            tuple(gain_values.tolist())
            for gain_values in (
                proportional,
                self.integral * omega * proportional,
                2.0 * mass * omega,
            )
        ]
        return MotionPIDConfig(proportional=gains[0], integral=gains[1], derivative=gains[2]).build(
            self.step
        )


class MotionNoise(Config):
    """White measurement noise, drawn at every step.

    Source: Jervan 2020, Table 4.14; see J25 in docs/documents/corrections.md.

    Attributes:
        position: standard deviation of x and y in m.
        heading: standard deviation of psi in rad.
        velocity: standard deviation of u and v in m/s.
        yaw_rate: standard deviation of r in rad/s.
        acceleration: standard deviation of u_dot and v_dot in m/s^2.
        yaw_acceleration: standard deviation of r_dot in rad/s^2.
    """

    position: Metres = Field(default=0.0, ge=0)
    heading: Radians = Field(default=0.0, ge=0)
    velocity: MetresPerSecond = Field(default=0.0, ge=0)
    yaw_rate: RadiansPerSecond = Field(default=0.0, ge=0)
    acceleration: quantity_type("m/s^2") = 0.0  # type: ignore[valid-type]
    yaw_acceleration: quantity_type("rad/s^2") = 0.0  # type: ignore[valid-type]

    def standard_deviations(self) -> tuple[float, ...]:
        """Return the standard deviations of pose, velocities and accelerations, nine numbers."""
        linear = (self.position, self.velocity, self.acceleration)
        angular = (self.heading, self.yaw_rate, self.yaw_acceleration)
        return tuple(value for a, b in zip(linear, angular, strict=True) for value in (a, a, b))

    def sample_noise(self, shape: Sequence[int], seed: int) -> Tensor:
        """Return noise [..., 9] on pose, velocities and accelerations, float64."""
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(*shape, 9, generator=generator, dtype=torch.float64) * torch.tensor(
            self.standard_deviations(), dtype=torch.float64
        )


class Disturbance(Config):
    """A force that is constant in earth axes.

    Attributes:
        north: force to the north in N.
        east: force to the east in N.
    """

    north: Newtons = 0.0
    east: Newtons = 0.0


def add_noise(x: Tensor, noise: Tensor) -> Tensor:
    """Return states [..., nx] with noise [..., 6] on pose and velocities."""
    return torch.cat((x[..., MOTION] + noise, x[..., ACTUATORS]), dim=-1)


@final
class NoisyLoop(Source):
    """A closed loop whose last six inputs are the noise [B, 6] of measured pose and velocities."""

    def __init__(self, loop: Source) -> None:
        super().__init__()
        self.loop = loop
        self.depends_on_step = loop.depends_on_step

    def initial(self, x: Tensor) -> Tensor:
        return self.loop.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        inputs, memory = self.loop(add_noise(x, w[:, -6:]), w[:, :-6], k, memory)
        return inputs, memory


@dataclass(frozen=True)
class FerryRun:
    """One simulated run at the sample interval of its log; SI units, forces in N, N, N m.

    Attributes:
        t: time [N] in s.
        pose: true x, y, psi [N, 3].
        nu: true u, v, r [N, 3].
        nu_dot: true accelerations [N, 3].
        measured: pose, nu and nu_dot as measured [N, 9].
        command: commanded force tau_c at the samples [N, 3].
        averaged_command: tau_c averaged over the steps around each sample [N, 3], so that noise
            between the samples does not alias.
        feedback: force of the feedback tau_FB [N, 3].
        thruster_force: force of the thrusters [N, 3].
        desired_pose: desired pose eta_d [N, 3].
        tracking_metrics: metrics over every step.
    """

    t: Tensor
    pose: Tensor
    nu: Tensor
    nu_dot: Tensor
    measured: Tensor
    command: Tensor
    averaged_command: Tensor
    feedback: Tensor
    thruster_force: Tensor
    desired_pose: Tensor
    tracking_metrics: TrackingMetrics


def load_force_vessel(name: str) -> tuple[HullPlant, ForceActuators]:
    """Return a vessel by name or file, and its actuators, which produce all three forces.

    Raises:
        ConfigError: if the vessel has no hull model, or its actuators lack surge, sway or yaw.
    """
    config = load_vessel(name)
    if isinstance(config, HullConfig):
        plant = config.build()
        if isinstance(plant.actuators, ForceActuators):
            return plant, plant.actuators
    raise ConfigError(
        f"vessel '{name}': this study needs a hull with actuators for surge, sway and yaw"
        " (kind forces or azimuth_thrusters)"
    )


@final
class FerrySimulation:
    """Closed loop of plant, believed hull model and controller.

    Args:
        plant_name: true vessel by name or file.
        believed_name: vessel with the hull model of the controller, by name or file.
        loop: controller and sampling.
        noise: measurement noise; None for none.
        disturbance: constant force in earth axes.
        seed: seed of the noise.

    Raises:
        ConfigError: if a vessel has no hull model whose actuators produce all three forces.
    """

    def __init__(
        self,
        plant_name: str,
        believed_name: str,
        loop: LoopConfig,
        noise: MotionNoise | None,
        disturbance: Disturbance,
        seed: int,
    ) -> None:
        self.loop = loop
        self.noise = noise
        self.disturbance = disturbance
        self.seed = seed
        self.plant, self.thrusters = load_force_vessel(plant_name)
        self.believed_hull = load_force_vessel(believed_name)[0].hull
        if not self.thrusters.state_names:
            response = "response: {kind: first_order, time: 1 s}"
            has_shafts = isinstance(self.thrusters, AzimuthThrusters)
            lag_key = f"shaft: {{{response}}}" if has_shafts else response
            raise ConfigError(
                f"vessel '{plant_name}': its thrusters have no lag, which this study identifies;"
                f" set `actuators: {{{lag_key}}}` in a vessel file with `base: {plant_name}`"
            )
        if disturbance == Disturbance():
            self.plant.without_environment()

    def simulate(
        self,
        path: ReferenceFilterConfig | CrossingConfig,
        feeds: Sequence[FeedForwardModel],
        *,
        feedback: bool = True,
    ) -> list[FerryRun]:
        """Simulate a course or a crossing with each model as feed-forward, all in one batch.

        Args:
            path: the course or crossing.
            feeds: models with their lags.
            feedback: whether the feedback acts.

        Raises:
            DataError: if the closed loop is unstable.
        """
        runs = self._simulate_batch([path] * len(feeds), feeds, feedback=feedback)
        finite_runs = [run for run in runs if run is not None]
        if len(finite_runs) < len(runs):
            raise DataError(
                "the states of the ferry are not finite: with these gains and models the closed"
                " loop is unstable"
            )
        return finite_runs

    def simulate_courses(
        self, courses: Sequence[ReferenceFilterConfig], feeds: Sequence[FeedForwardModel]
    ) -> list[list[FerryRun | None]]:
        """Simulate courses of equal duration with each model as feed-forward, all in one batch.

        Returns:
            For each model its run along each course; None for an unstable closed loop.
        """
        runs = self._simulate_batch(
            [course for _ in feeds for course in courses],
            [feed for feed in feeds for _ in courses],
            feedback=True,
        )
        n_courses = len(courses)
        return [runs[k * n_courses : (k + 1) * n_courses] for k in range(len(feeds))]

    def _simulate_batch(
        self,
        paths: Sequence[ReferenceFilterConfig | CrossingConfig],
        feeds: Sequence[FeedForwardModel],
        *,
        feedback: bool,
    ) -> list[FerryRun | None]:
        """Simulate each path with its feed-forward; a run that is not finite is None.

        The paths are courses of equal duration, or the same crossing.
        """
        loop_config = self.loop
        step = self.loop.step
        lags = [lag for _, lag in feeds]
        # all gains are multiples of the frequencies, so that zero frequencies switch the feedback
        # off
        if not feedback:
            loop_config = loop_config.model_copy(update={"frequency": (0.0, 0.0, 0.0)})
        pid = loop_config.build_pid(self.believed_hull.mass)
        policy = AllocatedPolicy(LagCompensatedPID(pid, lags, step), self.thrusters.allocate)
        n_inputs = len(self.plant.input_names)
        references = torch.zeros(len(feeds), 0, 0, dtype=torch.float64)
        first_path = paths[0]
        if isinstance(first_path, CrossingConfig):
            steps = round(first_path.duration / step)
        else:
            courses = [path for path in paths if isinstance(path, ReferenceFilterConfig)]
            motions = {course: sample_filtered_course(course, step) for course in set(courses)}
            steps = len(motions[courses[0]].pose)
            references = torch.stack(
                [
                    stack_reference(
                        motions[course], required_force(model, motions[course], lag, step)
                    )
                    for course, (model, lag) in zip(courses, feeds, strict=True)
                ]
            )
        w = torch.zeros(len(feeds), steps, n_inputs, dtype=torch.float64)
        if self.disturbance != Disturbance():
            for key, force in self.disturbance:
                w[:, :, self.plant.input_names.index(f"force_{key}")] = force
        noise = (self.noise or MotionNoise()).sample_noise((len(feeds), steps), self.seed)
        x0 = torch.zeros(len(feeds), len(self.plant.state_names), dtype=torch.float64)
        with torch.no_grad():
            if isinstance(first_path, CrossingConfig):
                guidance = Crossing(first_path, step, feeds)
                plant = RecordedPlantDynamics(self.plant, step)
                loop = ClosedLoop(policy, guidance)
                model: FreeRun = Rollout(plant, NoisyLoop(loop))
                rollout_arguments = (x0, torch.cat((w, noise[..., MOTION]), dim=2), x0[:, :0])
            else:
                model = Rollout(
                    PlantDynamics(self.plant, step), NoisyLoop(ReferenceInInputs(policy, n_inputs))
                )
                rollout_arguments = (
                    x0,
                    torch.cat((w, references, noise[..., MOTION]), dim=2),
                    x0[:, :0],
                )
                if steps > _MIN_COMPILED_STEPS:
                    per_row_names = [
                        f"source.loop.policy.policy.{name}" for name in ("lag", "step")
                    ]
                    model = compile_or_fallback(
                        model,
                        partial(CompiledRollout, row_tensors=per_row_names),
                        rollout_arguments,
                    )
            states, applied_inputs, _ = model(*rollout_arguments)
            states = states[:, :-1]
            is_finite = torch.isfinite(states).flatten(1).all(dim=1).tolist()
            measured_states = add_noise(states, noise[..., MOTION])
            if isinstance(first_path, CrossingConfig):
                memory = guidance.initial_state(states[:, 0])
                rows = []
                for k in range(steps):
                    reference, memory = guidance(measured_states[:, k], k, memory)
                    rows.append(reference)
                references = torch.stack(rows, dim=1)
            return [
                self._build_run(
                    states[i], applied_inputs[i], references[i], measured_states[i], noise[i], pid
                )
                if is_finite[i]
                else None
                for i in range(len(feeds))
            ]

    def _build_run(
        self,
        x: Tensor,
        w: Tensor,
        reference: Tensor,
        measured_states: Tensor,
        noise: Tensor,
        pid: MotionPID,
    ) -> FerryRun:
        """Return the sampled signals and the tracking metrics of one simulation."""
        loop = self.loop
        commands = w[:, : self.plant.n_commands]
        command = self.thrusters.requested_force(commands)
        desired = reference[:, :9]
        error = pid.body_error(measured_states, reference)
        feedback, _ = pid(measured_states, desired, (error.cumsum(0) - error) * loop.step)
        state_derivative = self.plant.derivative(x, w)
        motion = torch.cat((x[:, VELOCITIES], state_derivative[:, VELOCITIES]), dim=-1)
        metrics = compute_tracking_metrics(
            x[:, POSE], motion, desired, command, feedback, loop.step
        )
        stride = slice(None, None, loop.steps_per_sample)
        half_window = loop.steps_per_sample // 2
        padded_command = torch.cat(
            (command[:1].expand(half_window, 3), command, command[-1:].expand(half_window, 3))
        )
        t = torch.arange(len(x), dtype=torch.float64) * loop.step
        thruster_force = self.thrusters.force(x[:, ACTUATORS], commands, x[:, VELOCITIES])
        measured_motion = torch.cat((x[:, MOTION], state_derivative[:, VELOCITIES]), dim=-1) + noise
        return FerryRun(
            t[stride],
            x[stride, POSE],
            x[stride, VELOCITIES],
            state_derivative[stride, VELOCITIES],
            measured_motion[stride],
            command[stride],
            padded_command.unfold(0, 2 * half_window + 1, 1).mean(-1)[stride],
            feedback[stride],
            thruster_force[stride],
            reference[stride, POSE],
            metrics,
        )

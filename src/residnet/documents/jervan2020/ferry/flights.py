"""Courses and crossings of the ferry in closed loop (document 002, chapter 4).

A plant that stands for the true ferry is simulated under a controller that believes in a model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.base import ClosedLoop, GivenReference, Reference
from residnet.control.guidance.crossing import Crossing, CrossingConfig
from residnet.control.motion.anticipation import Assisted, Lag, course, needed_force, reference_row
from residnet.control.motion.pid import Allocated, Gain, MotionPID, MotionPIDConfig, NoFeedForward
from residnet.control.motion.reference_filter import ReferenceFilterConfig
from residnet.core.config import (
    Config,
    Metres,
    MetresPerSecond,
    Newtons,
    Radians,
    RadiansPerSecond,
    Seconds,
    quantity,
)
from residnet.core.errors import ConfigError, DataError
from residnet.core.layout import ACTUATORS, MOTION, POSE, VELOCITIES
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.simulated import TracedPlantDynamics
from residnet.judge.tracking import Tracking, tracking
from residnet.physics.actuators import ForceActuators
from residnet.physics.force_model import ForceModel
from residnet.physics.fossen import FossenVessel, HullConfig
from residnet.physics.vessel import load_vessel


class LoopConfig(Config):
    """A PID controller with critically damped poles, and the sampling of its log.

    The gains are Kp = m omega^2, Kd = 2 m omega and Ki = integral omega Kp, with m the believed
    mass of each axis. The document does not print its gains (correction J10).

    Attributes:
        frequency: omega of surge, sway and yaw in rad/s.
        integral: share of omega Kp that is the integral gain, without unit.
        step: time step of controller and plant in s.
        every: number of steps from one sample of the log to the next.
    """

    frequency: tuple[RadiansPerSecond, RadiansPerSecond, RadiansPerSecond]
    integral: Gain = 0.1
    step: Seconds = Field(default=0.02, gt=0)
    every: int = Field(default=5, ge=1)

    def pid(self, hull_mass: Tensor) -> MotionPID:
        """Return the feedback for a hull's mass matrix [3, 3] in SI units."""
        mass, omega = hull_mass.diagonal(), torch.tensor(self.frequency, dtype=torch.float64)
        proportional = mass * omega**2
        gains = [
            tuple(part.tolist())
            for part in (proportional, self.integral * omega * proportional, 2.0 * mass * omega)
        ]
        return MotionPIDConfig(proportional=gains[0], integral=gains[1], derivative=gains[2]).build(
            self.step, NoFeedForward()
        )


class MotionNoise(Config):
    """White noise on what is measured, drawn anew at every step (Table 4.14, correction J25).

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
    acceleration: quantity("m/s^2") = 0.0  # type: ignore[valid-type]
    yaw_acceleration: quantity("rad/s^2") = 0.0  # type: ignore[valid-type]

    def spread(self) -> tuple[float, ...]:
        """Return the standard deviations of pose, velocities and accelerations, nine numbers."""
        linear = (self.position, self.velocity, self.acceleration)
        angular = (self.heading, self.yaw_rate, self.yaw_acceleration)
        return tuple(value for a, b in zip(linear, angular, strict=True) for value in (a, a, b))

    def draw(self, shape: Sequence[int], seed: int) -> Tensor:
        """Return noise [..., 9] on pose, velocities and accelerations, float64."""
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(*shape, 9, generator=generator, dtype=torch.float64) * torch.tensor(
            self.spread(), dtype=torch.float64
        )


class Disturbance(Config):
    """A force that is constant in earth axes.

    Attributes:
        north: force to the north in N.
        east: force to the east in N.
    """

    north: Newtons = 0.0
    east: Newtons = 0.0


@final
class Sensed(Source):
    """A closed loop that measures the state with given noise [B, T, 6] on pose and velocities."""

    def __init__(self, loop: ClosedLoop, noise: Tensor) -> None:
        super().__init__()
        self.loop, self.noise = loop, noise

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory that the loop starts with."""
        return self.loop.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] that follow from the measured state."""
        inputs, memory = self.loop(
            torch.cat((x[:, MOTION] + self.noise[:, k], x[:, ACTUATORS]), dim=-1), w, k, memory
        )
        return inputs, memory


@dataclass(frozen=True)
class Flight:
    """One simulated run, sampled as its log is; SI units, forces in N, N, N m.

    Attributes:
        t: time [N] in s.
        pose: true x, y, psi [N, 3].
        nu: true u, v, r [N, 3].
        nu_dot: true accelerations [N, 3].
        measured: pose, nu and nu_dot as measured [N, 9].
        command: commanded force tau_c at the samples [N, 3].
        averaged: tau_c averaged over the steps around each sample [N, 3], so that noise between the
            samples does not alias.
        feedback: force of the feedback tau_FB [N, 3].
        acting: force of the thrusters [N, 3].
        desired: desired pose eta_d [N, 3].
        tracking: metrics over every step.
    """

    t: Tensor
    pose: Tensor
    nu: Tensor
    nu_dot: Tensor
    measured: Tensor
    command: Tensor
    averaged: Tensor
    feedback: Tensor
    acting: Tensor
    desired: Tensor
    tracking: Tracking


def force_hull(name: str) -> tuple[FossenVessel, ForceActuators]:
    """Return a vessel by name or file, and its actuators, which make all three forces.

    Raises:
        ConfigError: where it is no hull, or its actuators do not push in surge, sway and yaw alike.
    """
    config = load_vessel(name)
    if isinstance(config, HullConfig):
        plant = config.build()
        if isinstance(plant.actuators, ForceActuators):
            return plant, plant.actuators
    raise ConfigError(
        f"vessel '{name}': this study needs a hull whose actuators push in surge, sway and yaw"
        " alike (kind forces or azimuth_thrusters)"
    )


@dataclass(frozen=True)
class Ferry:
    """The true plant, the believed hull and the control loop between them.

    Attributes:
        true: the plant that is simulated.
        believed: the plant whose hull the controller believes in.
        loop: controller and sampling.
        disturbance: force that is constant in earth axes.
        noise: noise on what is measured; None for none.
        seed: seed of the noise.
    """

    true: FossenVessel
    believed: FossenVessel
    loop: LoopConfig
    disturbance: Disturbance
    noise: MotionNoise | None
    seed: int

    @classmethod
    def of(
        cls,
        true: str,
        believed: str,
        loop: LoopConfig,
        disturbance: Disturbance,
        noise: MotionNoise | None,
        seed: int,
    ) -> Ferry:
        """Build both plants from vessels by name or file.

        Raises:
            ConfigError: where a vessel is no hull whose actuators make all three forces.
        """
        plants = [force_hull(name)[0] for name in (true, believed)]
        if not plants[0].actuators.state:
            raise ConfigError(
                f"vessel '{true}': its forces follow at once; the study is about thrusters that"
                " lag, give actuators.response"
            )
        if disturbance == Disturbance():
            plants[0].in_calm_water()
        return cls(plants[0], plants[1], loop, disturbance, noise, seed)

    @property
    def thrusters(self) -> ForceActuators:
        """What pushes the true ferry."""
        actuators = self.true.actuators
        assert isinstance(actuators, ForceActuators)
        return actuators

    def without_feedback(self) -> Ferry:
        """Return the same ferry with the feed-forward alone."""
        return replace(self, loop=self.loop.model_copy(update={"frequency": (0.0, 0.0, 0.0)}))

    def fly_course(
        self, config: ReferenceFilterConfig, models: Sequence[tuple[ForceModel, Lag | None]]
    ) -> list[Flight]:
        """Fly the course with each model as feed-forward, all in one batch."""
        motion = course(config, self.loop.step)
        rows = [
            reference_row(motion, needed_force(model, motion, lag, self.loop.step))
            for model, lag in models
        ]
        return self._fly(
            GivenReference(torch.stack(rows)), len(motion.pose), [lag for _, lag in models]
        )

    def fly_crossing(
        self, config: CrossingConfig, models: Sequence[tuple[ForceModel, Lag | None]]
    ) -> list[Flight]:
        """Fly the crossing with each model as feed-forward, all in one batch."""
        return self._fly(
            Crossing(config, self.loop.step, models),
            round(config.duration / self.loop.step),
            [lag for _, lag in models],
        )

    def _fly(self, guidance: Reference, steps: int, lags: Sequence[Lag | None]) -> list[Flight]:
        step, rows = self.loop.step, len(lags)
        pid = self.loop.pid(self.believed.hull.mass)
        w = torch.zeros(rows, steps, len(self.true.inputs), dtype=torch.float64)
        if self.disturbance != Disturbance():
            w[:, :, self.true.inputs.index("force_north")] = self.disturbance.north
            w[:, :, self.true.inputs.index("force_east")] = self.disturbance.east
        noise = (self.noise or MotionNoise()).draw((rows, steps), self.seed)
        loop = ClosedLoop(Allocated(Assisted(pid, lags, step), self.thrusters), guidance)
        source: Source = Sensed(loop, noise[..., MOTION]) if self.noise is not None else loop
        x0 = torch.zeros(rows, len(self.true.state), dtype=torch.float64)
        with torch.no_grad():
            states, inputs, _ = Rollout(TracedPlantDynamics(self.true, step), source)(
                x0, w, x0[:, :0]
            )
            states = states[:, :-1]
            if not bool(torch.isfinite(states).all()):
                raise DataError(
                    "the ferry left all bounds in closed loop: with these gains and models the loop"
                    " is unstable"
                )
            references = self._replay(guidance, states, noise[..., MOTION])
            return [
                self._flight(states[i], inputs[i], references[i], noise[i], pid)
                for i in range(rows)
            ]

    @staticmethod
    def _replay(guidance: Reference, states: Tensor, noise: Tensor) -> Tensor:
        """Return the references [B, T, 18] that were followed."""
        if isinstance(guidance, GivenReference):
            return guidance.values
        measured = torch.cat((states[..., MOTION] + noise, states[..., ACTUATORS]), dim=-1)
        memory, out = guidance.initial_state(states[:, 0]), []
        for k in range(states.shape[1]):
            reference, memory = guidance(measured[:, k], k, memory)
            out.append(reference)
        return torch.stack(out, dim=1)

    def _flight(
        self, x: Tensor, w: Tensor, reference: Tensor, noise: Tensor, pid: MotionPID
    ) -> Flight:
        given = w[:, : self.true.commands]
        command = self.thrusters.asked(given)
        measured_state = torch.cat((x[:, MOTION] + noise[:, MOTION], x[:, ACTUATORS]), dim=-1)
        error = pid.error(measured_state, reference)
        feedback, _ = pid(
            measured_state, reference[:, :9], (error.cumsum(0) - error) * self.loop.step
        )
        rate = self.true.rate(x, w)
        metrics = tracking(
            x[:, POSE],
            torch.cat((x[:, VELOCITIES], rate[:, VELOCITIES]), dim=-1),
            reference[:, :9],
            command,
            feedback,
            self.loop.step,
        )
        every, half = slice(None, None, self.loop.every), self.loop.every // 2
        ends = torch.cat((command[:1].expand(half, 3), command, command[-1:].expand(half, 3)))
        averaged = ends.unfold(0, 2 * half + 1, 1).mean(-1)
        measured = torch.cat((x[:, MOTION], rate[:, VELOCITIES]), dim=-1) + noise
        t = torch.arange(len(x), dtype=torch.float64) * self.loop.step
        return Flight(
            t[every],
            x[every, POSE],
            x[every, VELOCITIES],
            rate[every, VELOCITIES],
            measured[every],
            command[every],
            averaged[every],
            feedback[every],
            self.thrusters.force(x[:, ACTUATORS], given, x[:, VELOCITIES])[every],
            reference[every, POSE],
            metrics,
        )

"""The ferry of document 002 in closed loop: courses and crossings flown by a true plant under a
controller that believes a model.
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
from residnet.control.motion.pid import Gain, MotionPID, MotionPIDConfig, NoFeedForward
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
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.simulated import TracedPlantDynamics
from residnet.judge.tracking import Tracking, tracking
from residnet.physics.force_model import ForceModel
from residnet.physics.fossen import FossenVessel, HullConfig
from residnet.physics.vessel import load_vessel


class LoopConfig(Config):
    """The controller: Kp = m omega^2, Kd = 2 m omega, Ki = integral omega Kp with m the believed
    mass of each axis.

    Attributes:
        frequency: omega of surge, sway and yaw.
        integral: see above.
        step: of the controller and the plant.
        every: steps between samples of the log.
    """

    frequency: tuple[RadiansPerSecond, RadiansPerSecond, RadiansPerSecond]
    integral: Gain = 0.1
    step: Seconds = Field(default=0.02, gt=0)
    every: int = Field(default=5, ge=1)

    def pid(self, hull_mass: Tensor) -> MotionPID:
        """The feedback."""
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
    """Standard deviations of white noise on what is measured, drawn anew at every step of the
    controller (document 002 Table 4.14, ERRATA J25).
    """

    position: Metres = Field(default=0.0, ge=0)
    heading: Radians = Field(default=0.0, ge=0)
    velocity: MetresPerSecond = Field(default=0.0, ge=0)
    yaw_rate: RadiansPerSecond = Field(default=0.0, ge=0)
    acceleration: quantity("m/s^2") = 0.0  # type: ignore[valid-type]
    yaw_acceleration: quantity("rad/s^2") = 0.0  # type: ignore[valid-type]

    def spread(self) -> tuple[float, ...]:
        """Of pose, velocities and accelerations, nine."""
        linear, angular = (
            (self.position, self.velocity, self.acceleration),
            (
                self.heading,
                self.yaw_rate,
                self.yaw_acceleration,
            ),
        )
        return tuple(value for a, b in zip(linear, angular, strict=True) for value in (a, a, b))

    def draw(self, shape: Sequence[int], seed: int) -> Tensor:
        """Noise [..., 9] on pose, velocities and accelerations, float64."""
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(*shape, 9, generator=generator, dtype=torch.float64) * torch.tensor(
            self.spread(), dtype=torch.float64
        )


class Disturbance(Config):
    """Force constant in earth axes."""

    north: Newtons = 0.0
    east: Newtons = 0.0


@final
class Sensed(Source):
    """A closed loop that sees the state with given noise [B, T, 6] on pose and velocities."""

    def __init__(self, loop: ClosedLoop, noise: Tensor) -> None:
        super().__init__()
        self.loop, self.noise = loop, noise

    def initial(self, x: Tensor) -> Tensor:
        """Memory of the loop."""
        return self.loop.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs [B, m] from the state as it is measured."""
        inputs, memory = self.loop(
            torch.cat((x[:, :6] + self.noise[:, k], x[:, 6:]), dim=-1), w, k, memory
        )
        return inputs, memory


@dataclass(frozen=True)
class Flight:
    """One run, sampled as the log is; truth for judging, `seen` for identification.

    Attributes:
        t: [N] s.
        pose, nu, nu_dot: truth [N, 3].
        seen: measured pose, nu, nu_dot [N, 9].
        command: tau_c at the samples [N, 3].
        averaged: tau_c averaged over the steps around each sample [N, 3]: without the noise between
            samples that would fold down.
        feedback: tau_FB [N, 3].
        acting: the thrusters' force [N, 3].
        desired: eta_d [N, 3].
        tracking: metrics over every step.
    """

    t: Tensor
    pose: Tensor
    nu: Tensor
    nu_dot: Tensor
    seen: Tensor
    command: Tensor
    averaged: Tensor
    feedback: Tensor
    acting: Tensor
    desired: Tensor
    tracking: Tracking


@dataclass(frozen=True)
class Ferry:
    """The true plant, the believed hull and the loop between them."""

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
        """From vessels by name.

        Raises:
            ConfigError: where a vessel is no hull with forces as commands.
        """
        plants = []
        for name in (true, believed):
            config = load_vessel(name)
            if not isinstance(config, HullConfig) or config.actuators.kind != "forces":
                raise ConfigError(
                    f"vessel '{name}': this study needs a hull whose commands are forces (actuators"
                    " of kind forces)"
                )
            plants.append(config.build())
        if not plants[0].actuators.state:
            raise ConfigError(
                f"vessel '{true}': its forces follow at once; the study is about thrusters that"
                " lag, give actuators.response"
            )
        if disturbance == Disturbance():
            plants[0].in_calm_water()
        return cls(plants[0], plants[1], loop, disturbance, noise, seed)

    def without_feedback(self) -> Ferry:
        """The same with the feed-forward alone."""
        return replace(self, loop=self.loop.model_copy(update={"frequency": (0.0, 0.0, 0.0)}))

    def fly_course(
        self, config: ReferenceFilterConfig, models: Sequence[tuple[ForceModel, Lag | None]]
    ) -> list[Flight]:
        """The course with each model as feed-forward, all in one batch."""
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
        """The crossing with each model as feed-forward, all in one batch."""
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
        loop = ClosedLoop(Assisted(pid, lags, step), guidance)
        source: Source = Sensed(loop, noise[..., :6]) if self.noise is not None else loop
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
            references = self._replay(guidance, states, noise[..., :6])
            return [
                self._flight(states[i], inputs[i], references[i], noise[i], pid)
                for i in range(rows)
            ]

    @staticmethod
    def _replay(guidance: Reference, states: Tensor, noise: Tensor) -> Tensor:
        """The references [B, T, 18] that were followed."""
        if isinstance(guidance, GivenReference):
            return guidance.values
        seen = torch.cat((states[..., :6] + noise, states[..., 6:]), dim=-1)
        memory, out = guidance.initial_state(states[:, 0]), []
        for k in range(states.shape[1]):
            reference, memory = guidance(seen[:, k], k, memory)
            out.append(reference)
        return torch.stack(out, dim=1)

    def _flight(
        self, x: Tensor, w: Tensor, reference: Tensor, noise: Tensor, pid: MotionPID
    ) -> Flight:
        command = w[:, :3]
        seen_state = torch.cat((x[:, :6] + noise[:, :6], x[:, 6:]), dim=-1)
        error = pid.error(seen_state, reference)
        feedback, _ = pid(seen_state, reference[:, :9], (error.cumsum(0) - error) * self.loop.step)
        rate = self.true.rate(x, w)
        metrics = tracking(
            x[:, :3],
            torch.cat((x[:, 3:6], rate[:, 3:6]), dim=-1),
            reference[:, :9],
            command,
            feedback,
            self.loop.step,
        )
        every, half = slice(None, None, self.loop.every), self.loop.every // 2
        ends = torch.cat((command[:1].expand(half, 3), command, command[-1:].expand(half, 3)))
        averaged = ends.unfold(0, 2 * half + 1, 1).mean(-1)
        seen = torch.cat((x[:, :6], rate[:, 3:6]), dim=-1) + noise
        t = torch.arange(len(x), dtype=torch.float64) * self.loop.step
        return Flight(
            t[every],
            x[every, :3],
            x[every, 3:6],
            rate[every, 3:6],
            seen[every],
            command[every],
            averaged[every],
            feedback[every],
            x[every, 6:9],
            reference[every, :3],
            metrics,
        )

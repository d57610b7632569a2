"""Task `ferry_study`: residual models of a ferry in closed loop (document 002, chapter 4).

A plant that stands for the true ferry flies a course under a controller that believes in a model;
residual models are identified from the course, and the course is flown again with them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.baselines.given import BelievedConfig, HullEquations
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
    load_config,
    quantity,
)
from residnet.core.errors import ConfigError, DataError, FitError
from residnet.core.files import read_json
from residnet.core.frames import wrap
from residnet.core.layout import (
    ACCELERATIONS,
    ACTUATORS,
    HEADING,
    MOTION,
    POSE,
    POSITION,
    VELOCITIES,
)
from residnet.core.log import Log
from residnet.core.names import STATE, nearest
from residnet.data.simulated import SimulatedTrials, fly_trials
from residnet.documents.cells import beside_published, joined, notes_text, pictures
from residnet.documents.jervan2020.residual import (
    ABOUT_COEFFICIENTS,
    AXES,
    MODEL_PICTURES,
    Fit,
    Record,
    ResidualModelConfig,
    as_baseline_yaml,
    coefficients_section,
    fit_as_json,
    fit_model,
    forward_equations,
    missing_coefficients,
    model_figures,
    remaining,
    unseen_mse,
)
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.simulated import TracedPlantDynamics
from residnet.export.feed_forward import ExportedForce, RequiredForce
from residnet.export.torchscript import TorchScriptExporter
from residnet.heads.zero import ZeroHead
from residnet.judge.courses import Tracking, mse, tracking
from residnet.judge.still_fits import StillFitsConfig, Verdict, still_fits
from residnet.manoeuvres import FamilyConfig
from residnet.manoeuvres.closed_loop import ZigzagFamily
from residnet.physics.actuators import ForceActuators
from residnet.physics.force_model import ForceModel
from residnet.physics.hull import HullConfig
from residnet.physics.plant import HullPlant
from residnet.physics.signals import FORCE_CHANNELS, SignalsConfig
from residnet.physics.vessel import load_vessel
from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text, table_of
from residnet.report.figure import DASHED, SOLID, Case, Figure, Panel, family, write_figure
from residnet.report.format import DEG, number
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, MainFigure, Outcome

FILE = "ferry.json"
Results = Mapping[str, Any]
_BELIEVED = "believed"
_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
_FARTHEST = 3.0
"""Velocities of a free run in largest velocities of the true ferry from which it has diverged."""


class Published(Config):
    """Figures that document 002 prints for one model, to stand beside the figures of a run.

    The numbers stand as printed, except where a correction of the document says otherwise. A figure
    that the document does not print is left out (null).

    Attributes:
        mse: mean square of the residual on the unseen half in N^2, N^2, (N m)^2 (Tables 4.2, 4.5,
            4.7, 4.15); surge, sway and yaw.
        position_mae: mean position error on the course in m (Tables 4.4, 4.10).
        position_mse: mean square position error on the course in m^2 (Tables 4.4, 4.10).
        heading_mae: mean heading error on the course in deg (Tables 4.4, 4.10).
        tau: mean absolute commanded force in N, N, N m (Tables 4.3, 4.9).
        feedback: mean absolute force of the feedback alone in N, N, N m (Tables 4.3, 4.9).
        crossing_position_mae: mean position error in the operational crossing in m (Table 4.12).
        crossing_position_mse: mean square position error in the crossing in m^2 (Table 4.12).
        crossing_heading_mae: mean heading error in the crossing in deg (Table 4.12).
        alone: mean square error of u, v, r and of their derivatives against the desired motion
            without feedback, in (m/s)^2, (m/s)^2, (rad/s)^2 and the same per second squared
            (Table 4.8, correction J21).
        crossing_power: mean power in W that position and heading take in the crossing (Table 4.13).
        coefficients: coefficients of the basis functions in surge, sway and yaw in SI units
            (Table 4.11), by basis function.
    """

    mse: tuple[float, float, float] | None = None
    position_mae: float | None = None
    position_mse: float | None = None
    heading_mae: float | None = None
    tau: tuple[float, float, float] | None = None
    feedback: tuple[float, float, float] | None = None
    crossing_position_mae: float | None = None
    crossing_position_mse: float | None = None
    crossing_heading_mae: float | None = None
    alone: tuple[float, float, float, float, float, float] | None = None
    crossing_power: tuple[float, float] | None = None
    coefficients: dict[str, tuple[float, float, float]] = Field(default_factory=dict)


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


def _zigzags() -> tuple[FamilyConfig, ...]:
    family = ZigzagFamily(count=6, drive=(0.03, 0.07), steer=(0.01, 0.03), heading=(0.17, 0.35))
    return (family,)


class ForwardRunsConfig(Config):
    """What the models are run forward in time beside.

    Attributes:
        trials: families of manoeuvres of the true ferry.
        duration: of each manoeuvre.
        step: of the free runs.
        seed: of everything random in them.
    """

    trials: tuple[FamilyConfig, ...] = Field(default_factory=_zigzags, min_length=1)
    duration: Seconds = Field(default=60.0, gt=0)
    step: Seconds = Field(default=0.1, gt=0)
    seed: int = Field(default=0, ge=0)


class FerryModelConfig(ResidualModelConfig):
    """One model of the ferry's residual force; with `lag`, its feed-forward is led by the lag.

    Attributes:
        smooth: estimate the motion from all noisy measurements together before the fit
            (`residnet.data.motion`).
        on: name of the model whose remaining residual this one explains (3.26); empty for the
            believed hull.
        fly: fly the course, and the crossing where there is one, with this model as feed-forward.
        published: figures that the document prints for this model.
    """

    smooth: bool = False
    on: str = ""
    fly: bool = False
    published: Published = Published()


@final
class FerryStudyConfig(ComputingTask):
    """A course with the believed model, residual models identified from it, and the course again.

    Attributes:
        task: `ferry_study`.
        believed: vessel whose hull the controller believes in, by name or file.
        true: vessel that is simulated, by name or file.
        course: waypoints and reference filter; its first half identifies, the second tests.
        loop: controller and sampling.
        crossing: an operational crossing that is flown too; null for none.
        noise: noise on what is measured; null for none.
        disturbance: force that is constant in earth axes.
        feed_forward_alone: fly the course without feedback too (Table 4.8).
        forward: manoeuvres of the true ferry beside which the models run forward in time; one that
            diverges there is refused, and its equations are not written.
        models: residual models by name; a model stands after the one that it builds on.
        published: figures that the document prints for the believed model.
        later: vessel that the true one has become later, by name or file; the models that fly are
            judged on its log and identified again where they no longer fit. Null for none.
        check_fit: when a model counts as no longer fitting.
        seed: seed of the noise.
    """

    task: Literal["ferry_study"]
    believed: str = "milliampere"
    true: str = "milliampere_half"
    course: ReferenceFilterConfig
    loop: LoopConfig
    crossing: CrossingConfig | None = None
    noise: MotionNoise | None = None
    disturbance: Disturbance = Disturbance()
    feed_forward_alone: bool = False
    forward: ForwardRunsConfig = ForwardRunsConfig()
    models: dict[_Name, FerryModelConfig] = Field(min_length=1)
    published: Published = Published()
    later: str | None = None
    check_fit: StillFitsConfig = StillFitsConfig()
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _combination(self) -> FerryStudyConfig:
        known: list[str] = []
        for name, model in self.models.items():
            if name == "believed":
                raise ValueError("'believed' cannot name a model: it is the controller's own")
            if model.on and model.on not in known:
                raise ValueError(
                    f"models.{name}.on: no model before it is named"
                    f" '{model.on}'{nearest(model.on, known)}"
                )
            if model.on and self.models[model.on].lag != model.lag:
                raise ValueError(
                    f"models.{name}.on: '{model.on}' and it must both be with lag or without"
                )
            known.append(name)
        if len(self.course.waypoints) < 4:
            raise ValueError(
                "course: at least four waypoints; half of them identify, segment by segment, and"
                " half test"
            )
        try:
            self.ferry()
            if self.later is not None:
                self.ferry(self.later)
            self.course.build(self.loop.step)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def ferry(self, true: str | None = None) -> Ferry:
        """Return the ferry in its control loop.

        Args:
            true: vessel that is simulated instead of `true` of the config.
        """
        return Ferry.of(
            true or self.true, self.believed, self.loop, self.disturbance, self.noise, self.seed
        )

    def recorded_seed(self) -> int:
        return self.seed

    def carry_out(self, folder: RunFolder) -> Outcome:
        results = write_results(self, study(self), folder)
        best = _best_model(results)
        figures = {
            f"residual left by {best}, {axis}": MainFigure(share)
            for axis, share in zip(AXES, results["models"][best]["share_left"], strict=True)
        }
        figures |= {
            f"mean position error on the course with {name}": MainFigure(
                flight["position_mae"], "m"
            )
            for name, flight in results["course"].items()
        }
        return Outcome(verdict(results), figures)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        config = load_config(run.resolved, [], cls)
        return sections(config, read_json(run.path / FILE), run.path)


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


def force_hull(name: str) -> tuple[HullPlant, ForceActuators]:
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

    true: HullPlant
    believed: HullPlant
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


class FerryModel(NamedTuple):
    """A fitted model of the ferry.

    Attributes:
        model: F = F_0 + corrections.
        lag: lag of the thrusters; None where it was not fitted.
        fit: coefficients.
        test_mse: mean square of the remaining residual on the test half, by axis in N^2, N^2,
            (N m)^2; against the command, or for a model with lag against the lagged command.
        notes: what the estimator chose.
    """

    model: ForceModel
    lag: Lag | None
    fit: Fit
    test_mse: list[float]
    notes: dict[str, Any]


def identify(config: FerryModelConfig, record: Record, base: ForceModel) -> FerryModel:
    """Fit one model on the training samples and judge it on the test samples as they were logged.

    Raises:
        FitError: where the data do not determine the model.
    """
    used = record.smoothed() if config.smooth else record
    model, lag, fit, notes = fit_model(config, used, base)
    return FerryModel(model, lag, fit, unseen_mse(model, lag, record), notes)


@dataclass(frozen=True)
class Update:
    """A model on a vessel that has changed since it was identified.

    Attributes:
        verdict: whether the model still fits.
        before: the course of the changed vessel with the model.
        after: the course with the model that was identified again from that log; the same flight
            where the model still fits.
    """

    verdict: Verdict
    before: Flight
    after: Flight


@dataclass(frozen=True)
class Study:
    """Everything that was flown and fitted.

    Attributes:
        first: the course with the believed model, from which the models are identified.
        record: its log, of which one half identifies the models and the other tests them.
        unmodelled: mean square of the believed model's residual on the test half, by axis in N^2,
            N^2, (N m)^2.
        models: fitted models by name.
        courses: the course by model, `believed` first.
        crossings: the crossing by model, `believed` first.
        alone: the course without feedback, by model.
        later: each model that flies, on the vessel as it is later.
    """

    first: Flight
    record: Record
    unmodelled: list[float]
    models: dict[str, FerryModel]
    courses: dict[str, Flight]
    crossings: dict[str, Flight]
    alone: dict[str, Flight]
    later: dict[str, Update]


def record_of(flight: Flight, interval: float, noise: MotionNoise | None) -> Record:
    """Return the log of a course with a fold for each segment; its first half identifies.

    Args:
        flight: the course as it was flown.
        interval: time from one waypoint to the next in s.
        noise: what is known of the sensors; None for none.
    """
    return Record(
        flight.t,
        flight.measured[:, POSE],
        flight.measured[:, VELOCITIES],
        flight.measured[:, ACCELERATIONS],
        flight.command,
        flight.averaged,
        torch.div(flight.t + 1e-9, interval, rounding_mode="floor").long(),
        torch.arange(len(flight.t)) < len(flight.t) // 2,
        (noise or MotionNoise()).spread(),
    )


def study(config: FerryStudyConfig) -> Study:
    """Fly with the believed model, identify residual models, and fly with these.

    Raises:
        ResidnetError: where a model cannot be identified or flown.
    """
    ferry = config.ferry()
    believed = ForceModel(ferry.believed.hull)
    first = ferry.fly_course(config.course, [(believed, None)])[0]
    record = record_of(first, config.course.interval, config.noise)
    residual = believed.residual(record.command, record.nu_dot, record.nu, record.pose[:, HEADING])
    models: dict[str, FerryModel] = {}
    for name, model_config in config.models.items():
        base = models[model_config.on].model if model_config.on else believed
        models[name] = identify(model_config, record, base)
    flown: dict[str, tuple[ForceModel, Lag | None]] = {
        name: (fitted.model, fitted.lag)
        for name, fitted in models.items()
        if config.models[name].fly
    }
    every = {_BELIEVED: (believed, None), **flown}

    def named(flights: Sequence[Flight]) -> dict[str, Flight]:
        return dict(zip(list(every)[-len(flights) :], flights, strict=True))

    courses, crossings, alone = {_BELIEVED: first}, {}, {}
    if flown:
        courses |= named(ferry.fly_course(config.course, list(flown.values())))
    if config.feed_forward_alone:
        open_loop = ferry.without_feedback()
        alone = named(open_loop.fly_course(config.course, list(every.values())))
    if config.crossing is not None:
        crossings = named(ferry.fly_crossing(config.crossing, list(every.values())))
    later = update(config, models, record, believed) if config.later is not None else {}
    return Study(
        first, record, mse(residual[~record.train]), models, courses, crossings, alone, later
    )


def update(
    config: FerryStudyConfig, models: dict[str, FerryModel], record: Record, believed: ForceModel
) -> dict[str, Update]:
    """Fly the changed vessel with each model, and identify again those that no longer fit.

    Args:
        config: the study, which names the changed vessel.
        models: fitted models; those that fly are taken.
        record: the log that they were identified from.
        believed: the model of the controller.
    """
    ferry = config.ferry(config.later)
    known = {name: model for name, model in models.items() if config.models[name].fly}
    flights = ferry.fly_course(
        config.course, [(model.model, model.lag) for model in known.values()]
    )
    out: dict[str, Update] = {}
    for (name, model), flight in zip(known.items(), flights, strict=True):
        log = record_of(flight, config.course.interval, config.noise)
        before = remaining(model.model, model.lag, record)[~record.train]
        now = remaining(model.model, model.lag, log)
        verdict = still_fits(config.check_fit, before, now, log.command, log.fold)
        out[name] = Update(verdict, flight, flight)
        if not verdict.fits:
            again = identify(config.models[name], log, believed)
            out[name] = Update(
                verdict, flight, ferry.fly_course(config.course, [(again.model, again.lag)])[0]
            )
    return out


def forward_runs(
    config: ForwardRunsConfig, true: str, believed: str, models: Mapping[str, HullEquations]
) -> dict[str, dict[str, Any]]:
    """Run models forward in time from the commanded forces of the true ferry's manoeuvres.

    Args:
        config: the manoeuvres.
        true: vessel that flies them.
        believed: vessel of the known hull, which stands beside the models.
        models: equations of motion by name.

    Returns:
        By model, `believed` first: `rmse` of u, v, r in m/s, m/s, rad/s over the runs that did not
        diverge (None without any), `runs`, and `diverged`, how many of them did.
    """
    trials = SimulatedTrials(
        vessel=true,
        trials=config.trials,
        duration=config.duration,
        step=config.step,
        identification={},
        validation={},
        seed=config.seed,
    )
    flown = [flight.motion for flight in fly_trials(trials.draw(), trials)]
    thrusters, longest = force_hull(true)[1], max(map(len, flown))
    # one that ended early shows no free run
    complete = [log for log in flown if len(log) == longest]
    x, w = (
        torch.stack(part)
        for part in zip(*(_columns(log, thrusters) for log in complete), strict=True)
    )
    limit = _FARTHEST * x[..., VELOCITIES].abs().amax(dim=(0, 1))
    known = BelievedConfig(vessel=believed).equations()
    out = {}
    for name, equations in {"believed": known, **models}.items():
        ran = _run(equations, x[:, 0], w[:, :-1], config.step)
        error = (ran - x)[..., VELOCITIES]
        finite = torch.isfinite(ran).all(dim=-1)
        away = (~finite | (ran[..., VELOCITIES].abs() > limit).any(dim=-1)).any(dim=-1)
        kept = error[~away]
        out[name] = {
            "rmse": kept.square().mean(dim=(0, 1)).sqrt().tolist() if len(kept) else None,
            "runs": len(x),
            "diverged": int(away.sum()),
        }
    return out


def why_refused(name: str, row: Mapping[str, Any]) -> str:
    """Return why a model is refused to run forward; empty where it is not."""
    if not row["diverged"]:
        return ""
    return (
        f"model {name}: it diverges in {row['diverged']} of {row['runs']} free runs beside the true"
        " ferry, so its equations are not written; take a model with fewer terms or with lag"
    )


def _columns(log: Log, thrusters: ForceActuators) -> tuple[Tensor, Tensor]:
    """Return states [T, 6] and the forces [T, 3] that the commands ask for."""
    states, commands = (
        torch.from_numpy(np.stack([log.channels[name] for name in names], axis=1))
        for names in (STATE, thrusters.commands)
    )
    return states, thrusters.asked(commands)


def _run(equations: HullEquations, x0: Tensor, w: Tensor, step: float) -> Tensor:
    """Return the states [B, T, 6] of a free run from x0 [B, 6] under forces w [B, T - 1, 3]."""
    signals = SignalsConfig(inputs=FORCE_CHANNELS).build()
    baseline = BelievedConfig(vessel=equations).build(signals.names)
    model = HybridDynamics(signals, baseline, ZeroHead(), step).double()
    with torch.no_grad():
        states: Tensor = Rollout(model)(x0, w, x0[:, :0])[0]
    return states


def write_results(config: FerryStudyConfig, found: Study, folder: RunFolder) -> dict[str, Any]:
    """Write ferry.json, the models' equations and feed-forwards, and figures.

    Returns:
        The contents of ferry.json.
    """
    # the range of what identified the models, not of the whole course
    motion = torch.cat((found.record.nu_dot, found.record.nu), dim=-1)[found.record.train]
    ranges = list(zip(motion.amin(0).tolist(), motion.amax(0).tolist(), strict=True))
    figures: list[Figure] = []
    for name, model in found.models.items():
        figures += model_figures(name, config.models[name], model.fit, found.unmodelled)
        force = RequiredForce(*model.model.parts(), mirrored=True)
        file = folder.exports / f"{name}_feed_forward.pt"
        exported = ExportedForce(name, force, ranges, model.notes.get("lag"))
        TorchScriptExporter().export(exported, file)
    forward, not_forward = _run_forward(config, found, folder)
    results = _content(config, found, not_forward) | {"forward": forward}
    folder.write_json(folder.path / FILE, results)
    for kind, flights in (
        ("course", found.courses),
        ("crossing", found.crossings),
        ("feed_forward_alone", found.alone),
    ):
        if flights:
            figures += _flights(flights, kind)
    for figure in figures:
        write_figure(folder.figures, figure)
    return results


def _run_forward(
    config: FerryStudyConfig, found: Study, folder: RunFolder
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    equations: dict[str, HullEquations] = {}
    refused = dict.fromkeys(found.models, "")
    for name, model in found.models.items():
        try:
            equations[name] = forward_equations(config.believed, model.model, f"model {name}")
        except (ConfigError, FitError) as error:
            refused[name] = str(error)
    rows = forward_runs(config.forward, config.true, config.believed, equations)
    for name, model_equations in equations.items():
        refused[name] = why_refused(name, rows[name])
        if not refused[name]:
            folder.write(
                folder.path / "models" / f"{name}_forward.yaml",
                as_baseline_yaml(model_equations, f"run {config.name}, model {name}"),
            )
    return rows, refused


def _content(
    config: FerryStudyConfig, found: Study, not_forward: Mapping[str, str]
) -> dict[str, Any]:
    models = {
        name: {
            "test_mse": model.test_mse,
            "share_left": [a / b for a, b in zip(model.test_mse, found.unmodelled, strict=True)],
            "notes": model.notes,
            "not_forward": not_forward[name],
            **fit_as_json(config.models[name].terms, model.fit),
        }
        for name, model in found.models.items()
    }
    return {
        "schema": "residnet.ferry/1",
        "run": config.name,
        "unmodelled_test_mse": found.unmodelled,
        "true_coefficients": missing_coefficients(config.true, config.believed),
        "models": models,
        "course": {name: flight.tracking.row() for name, flight in found.courses.items()},
        "crossing": {name: flight.tracking.row() for name, flight in found.crossings.items()},
        "feed_forward_alone": {name: flight.tracking.row() for name, flight in found.alone.items()},
        "later": {
            name: {
                "verdict": asdict(update.verdict),
                "text": update.verdict.text(),
                "before": update.before.tracking.row(),
                "after": update.after.tracking.row(),
            }
            for name, update in found.later.items()
        },
    }


def _flights(flights: Mapping[str, Flight], kind: str) -> list[Figure]:
    t = next(iter(flights.values())).t.numpy()
    apart = {name: flight.desired - flight.pose for name, flight in flights.items()}
    # the scales are logarithmic, since models differ by orders of magnitude
    position = {
        name: (t, off[:, POSITION].norm(dim=-1).clamp(min=1e-5).numpy())
        for name, off in apart.items()
    }
    heading = {
        name: (t, (DEG * wrap(off[:, HEADING]).abs()).clamp(min=1e-4).numpy())
        for name, off in apart.items()
    }
    shared: Any = {"x_label": "time [s]", "height": 210, "group": "t", "y_log": True}
    errors = Figure(
        f"errors_{kind}",
        "Errors in closed loop",
        "Distance to the desired position and magnitude of the heading error over time, by"
        " model of the feed-forward.",
        family(flights, width=1.1),
        [Panel("position error [m]", **shared), Panel("heading error [deg]", **shared)],
        [Case("", [position, heading])],
    )
    if not any(bool(flight.feedback.any()) for flight in flights.values()):
        return [errors]
    shown = dict(list(flights.items())[:3])
    units = ("surge [N]", "sway [N]", "yaw [N m]")
    forces = Figure(
        f"forces_{kind}",
        "Forces in closed loop",
        "Commanded force and the part of it that is feedback, by model of the feed-forward.",
        {
            "command": replace(SOLID, label="commanded force", width=1.0),
            "feedback": replace(DASHED, label="feedback part", width=1.0),
        },
        [
            Panel(unit, "time [s]", name if not axis else "", height=165, group=name)
            for axis, unit in enumerate(units)
            for name in shown
        ],
        [
            Case(
                "",
                [
                    {
                        part: (t, getattr(flight, part)[:, axis].numpy())
                        for part in ("command", "feedback")
                    }
                    for axis in range(3)
                    for flight in shown.values()
                ],
            )
        ],
        columns=len(shown),
    )
    return [errors, forces]


def verdict(results: Results) -> list[str]:
    """Return the sentences that sum a ferry study up."""
    models = results["models"]
    best = _best_model(results)
    left = joined([100 * share for share in models[best]["share_left"]])
    sentences = [
        f"Of {len(models)} residual models, {best} leaves the least of the residual force on the"
        f" unseen half of the course: {left} % of its mean square in surge, sway and yaw."
    ]
    for kind in ("course", "crossing"):
        flights = results[kind]
        flown = [name for name in flights if name != _BELIEVED]
        if flown:
            nearest = min(flown, key=lambda name: float(flights[name]["position_mae"]))
            before, after = (flights[name]["position_mae"] for name in (_BELIEVED, nearest))
            moves = "falls" if after < before else "does NOT fall: it goes"
            sentences.append(
                f"With {nearest} as feed-forward, the mean position error in the {kind} {moves}"
                f" from {number(before)} m to {number(after)} m."
            )
    for name, update in results["later"].items():
        sentences.append(f"On the vessel as it is later, {name} {update['text']}.")
    return sentences


def _best_model(results: Results) -> str:
    models: Results = results["models"]
    return min(models, key=lambda name: float(sum(models[name]["share_left"])))


def sections(config: FerryStudyConfig, results: Results, run: Path) -> list[Section]:
    """Return the sections of the report, with the document's figures beside ours."""
    models = results["models"]
    blocks: list[Block]
    out = [Section("Residual force on the unseen half", [_residuals(config, results)])]
    for kind, title in (("course", "Course in closed loop"), ("crossing", "Operational crossing")):
        if results[kind]:
            blocks = [
                *_tracking(config, results[kind], kind),
                *pictures(run, f"errors_{kind}", f"forces_{kind}"),
            ]
            out.append(Section(title, blocks))
    if results["feed_forward_alone"]:
        flights = results["feed_forward_alone"]
        blocks = [
            _alone(config, flights),
            *_tracking(config, flights, "alone"),
            *pictures(run, "errors_feed_forward_alone"),
        ]
        out.append(Section("Feed-forward without feedback", blocks))
    if results["later"]:
        out.append(Section("The vessel as it is later", [_later(results["later"])]))
    out.append(Section("Forward in time", [_forward(results["forward"])]))
    if causes := [model["not_forward"] for model in models.values() if model["not_forward"]]:
        out.append(Section("Models that cannot run forward in time", [Bullets(causes)]))
    # Table 4.11
    coefficients = [
        coefficients_section(
            name,
            model,
            model["notes"],
            {
                "true": {} if config.models[name].on else results["true_coefficients"],
                "published": config.models[name].published.coefficients,
            },
        )
        for name, model in models.items()
    ]
    out.append(Section("Coefficients", [Text(ABOUT_COEFFICIENTS), *coefficients]))
    return [*out, Section("Orders, weights and surfaces", pictures(run, *MODEL_PICTURES), True)]


def _residuals(config: FerryStudyConfig, results: Results) -> Table:
    """Return the table of the remaining residual (Tables 4.2, 4.5, 4.7 and 4.15)."""
    unmodelled, base = results["unmodelled_test_mse"], config.published.mse

    def mean(axis: int) -> Any:
        return lambda row: beside_published(row[1][axis], row[2][axis] if row[2] else None)

    def left(axis: int) -> Any:
        def cell(row: Any) -> Cell:
            printed = 100 * row[2][axis] / base[axis] if row[2] and base else None
            return beside_published(100 * row[1][axis] / unmodelled[axis], printed, 3)

        return cell

    rows: list[Any] = [(_BELIEVED, unmodelled, base, "")]
    rows += [
        (name, model["test_mse"], config.models[name].published.mse, notes_text(model["notes"]))
        for name, model in results["models"].items()
    ]
    units = ("surge N^2", "sway N^2", "yaw (N m)^2")
    return table_of(
        rows,
        [
            ("model", lambda row: row[0]),
            *((unit, mean(axis)) for axis, unit in enumerate(units)),
            *((name, left(axis)) for axis, name in enumerate(AXES)),
            ("chosen by the estimator", lambda row: row[3]),
        ],
        caption="Mean square of the residual, and what is left of the believed model's.",
        groups=[("mean square", 3), ("left %", 3), ("", 1)],
    )


def _published(config: FerryStudyConfig, name: str) -> Published:
    return config.published if name == _BELIEVED else config.models[name].published


def _tracking(config: FerryStudyConfig, flights: Mapping[str, Results], kind: str) -> list[Table]:
    """Return how well a course is followed and with which forces.

    Tables 4.4, 4.10, 4.12 and 4.13 of the document; Tables 4.3 and 4.9.
    """
    errors = Table(
        [
            "feed-forward",
            *("mean position error m", "mean square m^2", "mean heading error deg"),
            *("power, position W", "power, heading W"),
            *("IAEW, position m s J", "IAEW, heading rad s J"),
        ],
        caption="IAEW is the integral of the error times the work (3.18).",
    )
    forces = Table(
        ["feed-forward", *("surge N", "sway N", "yaw N m") * 2],
        groups=[("mean absolute force", 3), ("mean absolute feedback", 3)],
    )
    for name, metrics in flights.items():
        printed = _of_kind(_published(config, name), kind)
        errors.add(
            name,
            [
                beside_published(metrics["position_mae"], printed.position_mae),
                beside_published(metrics["position_mse"], printed.position_mse),
                beside_published(metrics["heading_mae"] * DEG, printed.heading_mae),
                *_each(metrics["power"], printed.crossing_power),
                *_each(metrics["iaew"], None),
            ],
        )
        tau = _each(metrics["tau"], printed.tau)
        forces.add(name, [*tau, *_each(metrics["feedback"], printed.feedback)])
    return [errors, forces]


def _each(values: Sequence[float], published: Sequence[float] | None) -> list[Cell]:
    printed = [None] * len(values) if published is None else published
    return [beside_published(a, b) for a, b in zip(values, printed, strict=True)]


def _of_kind(published: Published, kind: str) -> Published:
    if kind == "course":
        return published.model_copy(update={"crossing_power": None})
    if kind == "crossing":
        return Published(
            position_mae=published.crossing_position_mae,
            position_mse=published.crossing_position_mse,
            heading_mae=published.crossing_heading_mae,
            crossing_power=published.crossing_power,
        )
    return Published()


def _alone(config: FerryStudyConfig, flights: Mapping[str, Results]) -> Table:
    """Return the table of velocities and accelerations without feedback (Table 4.8)."""
    table = Table(
        ["feed-forward", "u", "v", "r", "u_dot", "v_dot", "r_dot"],
        caption="Mean square error against the desired motion without feedback, in (m/s)^2,"
        " (m/s)^2, (rad/s)^2, and the same per second squared.",
    )
    for name, metrics in flights.items():
        table.add(name, _each(metrics["motion_mse"], _published(config, name).alone))
    return table


def _forward(rows: Mapping[str, Results]) -> Table:
    """Return the table of free runs beside manoeuvres of the true ferry (3.22)."""

    def rms(axis: int, factor: float) -> Any:
        return lambda row: Cell(
            "-" if row[1]["rmse"] is None else number(factor * row[1]["rmse"][axis])
        )

    units = (("u m/s", 1.0), ("v m/s", 1.0), ("r deg/s", DEG))
    return table_of(
        rows.items(),
        [
            ("model", lambda row: row[0]),
            *((unit, rms(axis, factor)) for axis, (unit, factor) in enumerate(units)),
            ("diverged", lambda row: Cell(f"{row[1]['diverged']} of {row[1]['runs']}")),
        ],
        caption="Root mean square errors of free runs from the commanded forces, over the runs that"
        " did not diverge. A model that explains the force may still be no model of motion.",
    )


def _later(later: Mapping[str, Results]) -> Table:
    """Return the table of models on the changed vessel (section 3.7)."""

    def error(when: str) -> Any:
        return lambda row: Cell(number(row[1][when]["position_mae"], 4))

    return table_of(
        later.items(),
        [
            ("model", lambda row: row[0]),
            ("mean position error m", error("before")),
            ("after the update m", error("after")),
            ("on the new log", lambda row: row[1]["text"]),
        ],
        caption="A model that no longer fits is identified again from the log of one course.",
    )

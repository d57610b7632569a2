"""Task `course`: simulate a trained heading policy and classical laws on a course past buoys."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar, Literal, Self, final

import numpy as np
import torch
from pydantic import Field, model_validator

from residnet.autopilot.courses.config import BuoyCourseConfig, plan_course, smallest_turn
from residnet.autopilot.courses.course_check import PassingRule
from residnet.autopilot.guidance import AnyLineOfSight
from residnet.autopilot.heading.predictive import AnyController
from residnet.autopilot.heading.steering_variation import Vessels
from residnet.autopilot.tasks.autopilot.config import AutopilotConfig
from residnet.core.config import (
    Config,
    ExistingPath,
    MetresPerSecond,
    Radians,
    Seconds,
    load_config,
)
from residnet.core.errors import ConfigError
from residnet.core.names import suggest_name
from residnet.dynamics.time_steps import check_steps
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, ExportRequest, PackageTask, PartName


class CourseSpreadConfig(Config):
    """Random vessels, each in a constant current of random direction.

    All controllers and guidance laws are simulated with the same vessels.

    Attributes:
        flights: number of vessels.
        seed: seed of the random numbers.
        effect: range of the rudder effect (K of Nomoto's model), relative to the nominal one.
        time: range of the time constants of sway and yaw (T of Nomoto's model), relative to the
            nominal ones.
        bias: largest constant offset of the rudder angle, in rad.
        current: speed of the current in m/s.
    """

    flights: int = Field(default=50, ge=2, le=1_000_000)
    seed: int = Field(default=0, ge=0)
    effect: tuple[float, float] = (0.9, 1.1)
    time: tuple[float, float] = (0.9, 1.1)
    bias: Radians = Field(default=0.0, ge=0)
    current: MetresPerSecond = Field(default=0.0, ge=0)

    @model_validator(mode="after")
    def _validate_ranges(self) -> Self:
        for name, (lower, upper) in {"effect": self.effect, "time": self.time}.items():
            if not 0 < lower <= upper:
                raise ValueError(
                    f"{name}: low and high must be positive and in order, given {lower:g},"
                    f" {upper:g}"
                )
        return self

    def sample_vessels(self) -> Vessels:
        """Draw the vessels, evenly spread over their ranges."""
        generator = np.random.default_rng(self.seed)
        effect, time, bias = (
            generator.uniform(*limits, self.flights)
            for limits in (self.effect, self.time, (-self.bias, self.bias))
        )
        current_direction = generator.uniform(-math.pi, math.pi, self.flights)
        variation = np.stack((effect, time, bias), axis=-1)
        current = self.current * np.stack(
            (np.cos(current_direction), np.sin(current_direction)), axis=-1
        )
        return Vessels(torch.from_numpy(variation), torch.from_numpy(current))


@final
class CourseTaskConfig(PackageTask, ComputingTask):
    """A course past buoys, the compared controllers, and line-of-sight laws without a plan.

    Attributes:
        autopilot: folder of a finished autopilot run, or a config of task `autopilot`, which is
            then run first in the folder of this run. It defines vessel, rudder, policy and peers.
        policy: name of the policy in that run.
        peers: names of tuned peers and of predictive autopilots in that run.
        others: further controllers, for example the law of Gouletas 2020 with another horizon.
        course: start, buoys and settings of the planning.
        protocols: conditions for passing a buoy: `enter` its circle of acceptance, or pass on its
            side and outside its circle (`sides`).
        integral: gain in m/s of integral action against a constant current in the guidance along
            the plan; null for none.
        line_of_sight: guidance laws that are also simulated without a plan, on straight legs
            between way-points as in the source; for the protocol `enter`.
        legs_change: position of the change to the next leg: in the circle of acceptance, as in the
            source, or at the wheel-over point before it.
        spread: random vessels and currents, in addition to the nominal vessel
            without current; null for none.
        dt: time step of simulation and controllers in s.
        duration: time limit of a simulation in s.
        safe: command of the exported policy for invalid inputs: the last valid command,
            or rudder amidships.
    """

    task: Literal["course"]
    autopilot: ExistingPath
    policy: PartName = "policy"
    peers: tuple[PartName, ...] = ("pid",)
    others: dict[PartName, AnyController] = Field(default_factory=dict)
    course: BuoyCourseConfig
    protocols: tuple[PassingRule, ...] = Field(default=("enter", "sides"), min_length=1)
    integral: MetresPerSecond | None = Field(default=None, gt=0)
    line_of_sight: tuple[AnyLineOfSight, ...] = ()
    legs_change: Literal["circle", "wheel_over"] = "circle"
    spread: CourseSpreadConfig | None = None
    dt: Seconds = Field(default=0.02, gt=0)
    duration: Seconds = Field(gt=0)
    safe: Literal["hold", "amidships"] = "amidships"

    @model_validator(mode="after")
    def _validate_laws(self) -> Self:
        kinds = [law.kind for law in self.line_of_sight]
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"line_of_sight: each kind may occur once, given {', '.join(kinds)}")
        check_steps(self.duration, self.dt)
        return self

    def provenance_seed(self) -> int:
        return self.spread.seed if self.spread else 0

    supported_commands: ClassVar[tuple[str, ...]] = ("report", "export")
    section_module: ClassVar[str] = "residnet.autopilot.report.course"

    def load_autopilot_config(self) -> AutopilotConfig:
        """Return the config of the autopilot, from its run folder or its file.

        Raises:
            UsageError: if the folder is not a finished autopilot run.
            ConfigError: if the file is not a config of an autopilot, or lacks the policy or a peer.
        """
        autopilot_path = self.autopilot
        file = (
            RunFolder.open(autopilot_path).resolved_config
            if autopilot_path.is_dir()
            else autopilot_path
        )
        autopilot_config = load_config(file, [], AutopilotConfig)
        if autopilot_config.test.depth is not None:
            raise ConfigError(
                f"autopilot: {autopilot_path} steers the depth; a course takes policies of the"
                " heading"
            )
        if self.policy not in autopilot_config.policies:
            raise ConfigError(
                f"policy: '{self.policy}' is none of"
                f" {autopilot_path}{suggest_name(self.policy, autopilot_config.policies)}"
            )
        for name in self.peers:
            if name not in (
                peer_configs := {**autopilot_config.peers, **autopilot_config.predictive}
            ):
                raise ConfigError(
                    f"peers: '{name}' is none of {autopilot_path}{suggest_name(name, peer_configs)}"
                )
        if duplicates := sorted({self.policy, *self.peers} & set(self.others)):
            raise ConfigError(
                f"others: '{duplicates[0]}' is a policy or peer already; names are unique in a run"
            )
        return autopilot_config

    def check(self) -> None:
        """Check the autopilot's run folder or config, and that the courses can be planned.

        Raises:
            UsageError: if the folder is not a finished autopilot run.
            ConfigError: if the file is not a config of an autopilot, lacks the policy or a peer, or
                if no course is possible with the turns of the vessel.
        """
        autopilot = self.load_autopilot_config()
        vessel = autopilot.steered_vessel
        nomoto = vessel.estimate_nomoto(autopilot.rudder, autopilot.turning_time)
        steady_turn = smallest_turn(self.course, vessel, nomoto, autopilot.rudder)
        for protocol in self.protocols:
            try:
                plan_course(self.course, protocol, vessel, nomoto, autopilot.rudder, steady_turn)
            except ConfigError as error:
                raise ConfigError(f"course.buoys, protocol {protocol}: {error}") from error

    def export_model(self, request: ExportRequest) -> Path:
        """Write a policy with the guidance of a course, named after both; returns the file."""
        file: Path = self.call_executor("export_model", request)
        return file

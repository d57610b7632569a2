"""Manoeuvres whose commands depend on the motion.

They are zigzag, turning circle, stopping trial and spiral, and in depth helix, vertical zigzag and
step.
"""

from __future__ import annotations

import math
from abc import ABC
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.core.frames import to_level_axes
from residnet.core.log import Log
from residnet.manoeuvres import indices
from residnet.manoeuvres.base import (
    ClosedLoopManoeuvre,
    Helm,
    Manoeuvre,
    ManoeuvreFamily,
    Range,
    ScheduledManoeuvre,
    SteeringConfig,
    SupportsMaxRudder,
    require_dive,
    rudder_share,
    sample_uniform,
)
from residnet.physics.plant_channels import PlantChannels

if TYPE_CHECKING:
    from torch import Tensor

    from residnet.manoeuvres.base import BatchValues

_FULL_RUDDER_DEG = 34.9
"""Rudder angle in deg above which the IMO limits of a turning circle apply (35 deg or maximum)."""
_ANGLE_TOLERANCE = 0.05
"""Relative tolerance of the angles of a 10/10 or 20/20 zigzag."""


class Zigzag(SteeringConfig, ClosedLoopManoeuvre):
    """Zigzag: the steering is reversed whenever the heading has changed by `heading` to its side.

    Source: Woo et al. 2018, section 4.2.2. The memory is the side of the command (+1 starboard, -1
    port), the heading at the start and the number of reversals.

    Attributes:
        heading: change of heading at which the steering is reversed.
        first: side of the first execute for a positive steering command or rudder angle.
        reversals: number of reversals after which the manoeuvre ends, as soon as the heading
            returns to the initial course; None for the full duration.
    """

    observed_states: ClassVar[tuple[str, ...]] = ("psi",)
    kind: Literal["zigzag"] = "zigzag"
    heading: Radians = Field(gt=0)
    first: Literal["starboard", "port"] = "starboard"
    reversals: int | None = Field(default=None, ge=1)

    @property
    def end_condition(self) -> str | None:
        if self.reversals is None:
            return None
        angle = f"{math.degrees(self.heading):.4g} deg"
        return f"{self.reversals} reversals at {angle} of heading and the return to the course"

    @property
    def first_sign(self) -> float:
        """Sign of the first execute, +1 to starboard or -1 to port."""
        return self.side if self.first == "starboard" else -self.side

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        return indices.zigzag_indices(log, self.start, self.first_sign, self.heading, length)

    def imo_limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return IMO's limits of the 10/10 and 20/20 zigzag.

        Without a rudder the heading alone determines the phase.
        """
        angle = (
            self.heading
            if helm.max_rudder is None
            else abs(self.steer_share(helm)) * helm.max_rudder
        )
        angles_deg = [math.degrees(self.heading), math.degrees(angle)]
        for nominal in (10.0, 20.0):
            if all(
                abs(angle_deg - nominal) < _ANGLE_TOLERANCE * nominal for angle_deg in angles_deg
            ):
                return indices.zigzag_limits(nominal, length, speed)
        return {}

    def law_parameters(self, helm: SupportsMaxRudder) -> dict[str, Any]:
        return super().law_parameters(helm) | {
            "steer": self.steer_share(helm),
            "reversal_angle": self.heading,
            "side": self.side,
            "first_side": 1.0 if self.first == "starboard" else -1.0,
            "max_reversals": math.inf if self.reversals is None else float(self.reversals),
        }

    @classmethod
    def initial_memory(cls, motion: BatchValues, parameters: BatchValues) -> Tensor:
        """Return the side of the first execute, the current heading and zero reversals, [B, 3]."""
        import torch

        psi = motion["psi"]
        return torch.stack((parameters["first_side"], psi, torch.zeros_like(psi)), dim=-1)

    @classmethod
    def step_law(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Reverse the steering if the heading has reached its bound."""
        import torch

        command_sign, origin, count = memory.unbind(-1)
        # positive towards the current side of the steering
        heading_change = command_sign * parameters["side"] * (motion["psi"] - origin)
        has_reached = heading_change >= parameters["reversal_angle"]
        command_sign = torch.where(has_reached, -command_sign, command_sign)
        steer = torch.where(time >= parameters["start"], command_sign * parameters["steer"], 0.0)
        return (
            parameters["drive"],
            steer,
            torch.stack((command_sign, origin, count + has_reached.to(command_sign)), -1),
        )

    @classmethod
    def has_ended(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> Tensor:
        """Return whether the heading has returned to the initial course after the last reversal."""
        command_sign, origin, count = memory.unbind(-1)
        is_back = command_sign * parameters["side"] * (motion["psi"] - origin) >= 0
        return (count >= parameters["max_reversals"]) & is_back


class SteeringFamily(ManoeuvreFamily, ABC):
    """Manoeuvres whose steering and propulsion commands are drawn from uniform distributions.

    Attributes:
        steer: range of the fraction of the full steering command.
        drive: range of the fraction of the full propulsion command.
        start: time of the first helm order in s.
    """

    steer: Range = (0.25, 1.0)
    drive: Range = (0.2, 1.0)
    start: Seconds = 5.0


class ZigzagFamily(SteeringFamily):
    """Random zigzags, which begin to either side.

    Attributes:
        heading: candidate changes of heading in rad.
    """

    kind: Literal["zigzag"] = "zigzag"
    heading: tuple[Radians, ...] = Field(min_length=1)

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        heading = float(generator.choice(self.heading))
        steer = sample_uniform(generator, self.steer)
        drive = sample_uniform(generator, self.drive)
        first_side: Literal["starboard", "port"] = (
            "starboard" if generator.random() < 0.5 else "port"
        )
        return Zigzag(heading=heading, steer=steer, drive=drive, start=self.start, first=first_side)


class SteadyConfig(Config):
    """Condition for a steady turn: the yaw rate is close to its running mean for `window` s.

    Attributes:
        window: duration of the condition and time constant of the running mean in s; a few times
            the time for one ship length.
        tolerance: largest deviation from the mean, as a share of the largest yaw rate since the
            start of the manoeuvre.
    """

    window: Seconds = Field(default=10.0, gt=0)
    tolerance: float = Field(default=0.005, gt=0)


def initial_steadiness(r: Tensor) -> Tensor:
    """Return the memory [B, 3] of a steady turn: mean of r, largest |r|, and time near the mean."""
    import torch

    return torch.stack((r, r.abs(), torch.zeros_like(r)), dim=-1)


def update_steadiness(r: Tensor, parameters: BatchValues, memory: Tensor) -> Tensor:
    """Return the memory [B, 3] of a steady turn one step later, with yaw rate r [B]."""
    import torch

    mean, max_rate, steady_time = memory.unbind(-1)
    # exponential running mean; the factor is limited for windows shorter than a step
    mean = mean + (parameters["dt"] / parameters["window"]).clamp(max=1.0) * (r - mean)
    max_rate = torch.maximum(max_rate, r.abs())
    is_near = (r - mean).abs() <= parameters["tolerance"] * max_rate
    return torch.stack(
        (mean, max_rate, torch.where(is_near, steady_time + parameters["dt"], 0.0)), dim=-1
    )


def is_steady(parameters: BatchValues, memory: Tensor) -> Tensor:
    """Return whether the turn of each row is steady, [B] bool."""
    # the tolerance allows for rounding in the sum of time steps
    return memory[:, 2] >= parameters["window"] - 1e-9


def reset_steady_time(memory: Tensor, is_restarted: Tensor) -> Tensor:
    """Return the memory of a steady turn with the steady time set to zero in rows [B] bool."""
    import torch

    return torch.cat(
        (memory[:, :2], memory[:, 2:].masked_fill(is_restarted.unsqueeze(-1), 0.0)), dim=-1
    )


class TurningCircle(SteeringConfig, ClosedLoopManoeuvre):
    """Turning circle: constant helm from `start` until the heading has changed by `until`.

    IMO requires 540 deg with full rudder. The memory is the heading at the helm order, the phase,
    and the state of the steady-turn test. The phase is 0 in approach and turn, 1 in the pull-out
    and 2 at the end.

    Attributes:
        until: change of heading that ends the turn.
        pull_out: whether a pull-out follows: the helm amidships until the yaw rate is steady. A
            vessel with straight-line stability stops turning.
        steady: condition for the end of the pull-out.
    """

    observed_states: ClassVar[tuple[str, ...]] = ("psi", "r")
    parameter_names: ClassVar[tuple[str, ...]] = ("drive", "start", "until", "side")
    kind: Literal["turning_circle"] = "turning_circle"
    until: Radians = Field(default=3.0 * math.pi, gt=0)
    pull_out: bool = False
    steady: SteadyConfig = SteadyConfig()

    @property
    def end_condition(self) -> str:
        turn_text = f"a heading change of {math.degrees(self.until):.4g} deg"
        return f"{turn_text} and a steady pull-out" if self.pull_out else turn_text

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        turning_indices = indices.turning_circle_indices(
            log, self.start, self.side, self.until, length
        )
        if self.pull_out and "advance" in turning_indices:
            turning_indices["pull_out_yaw_rate"] = self.side * float(
                log["r"][np.isfinite(log["r"])][-1]
            )
        return turning_indices

    def imo_limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return the IMO limits, which apply to 35 deg of rudder or the maximum angle."""
        share = abs(self.steer_share(helm))
        angle = math.degrees(share * (helm.max_rudder or 0.0))
        # full helm also counts for a vessel that steers without a rudder
        is_full_rudder = share > 0.999 or angle > _FULL_RUDDER_DEG
        return indices.turning_limits(length) if is_full_rudder else {}

    def law_parameters(self, helm: SupportsMaxRudder) -> dict[str, Any]:
        phase_parameters = {
            "steer": self.steer_share(helm),
            "phase_after_turn": 1.0 if self.pull_out else 2.0,
        }
        return super().law_parameters(helm) | phase_parameters | dict(self.steady)

    @classmethod
    def initial_memory(cls, motion: BatchValues, parameters: BatchValues) -> Tensor:
        """Return the memory [B, 5] at the current heading, in the approach."""
        import torch

        psi = motion["psi"]
        return torch.cat(
            (torch.stack((psi, psi * 0.0), -1), initial_steadiness(motion["r"])), dim=-1
        )

    @classmethod
    def step_law(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Command the helm until the heading has changed, then amidships until r is steady."""
        import torch

        origin = memory[:, 0]
        phase = memory[:, 1]
        steadiness = update_steadiness(motion["r"], parameters, memory[:, 2:])
        is_steering = time >= parameters["start"]
        # the change of heading counts from the helm order
        origin = torch.where(is_steering, origin, motion["psi"])
        heading_change = parameters["side"] * (motion["psi"] - origin)
        turn_completed = (phase == 0) & is_steering & (heading_change >= parameters["until"])
        steadiness = reset_steady_time(steadiness, turn_completed)
        has_settled = (phase == 1) & is_steady(parameters, steadiness)
        phase = torch.where(
            turn_completed, parameters["phase_after_turn"], torch.where(has_settled, 2.0, phase)
        )
        steer = torch.where(is_steering & (phase == 0), parameters["steer"], 0.0)
        return (
            parameters["drive"],
            steer,
            torch.cat((torch.stack((origin, phase), -1), steadiness), 1),
        )

    @classmethod
    def has_ended(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> Tensor:
        return memory[:, 1] == 2


class TurningCircleFamily(SteeringFamily):
    """Random turning circles to either side.

    Attributes:
        until: change of heading that ends the manoeuvre in rad.
    """

    kind: Literal["turning_circle"] = "turning_circle"
    until: Radians = Field(default=3.0 * math.pi, gt=0)

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        turn_sign = 1.0 if generator.random() < 0.5 else -1.0
        steer = turn_sign * sample_uniform(generator, self.steer)
        drive = sample_uniform(generator, self.drive)
        return TurningCircle(steer=steer, drive=drive, start=self.start, until=self.until)


class Stopping(ClosedLoopManoeuvre):
    """Stopping trial: `drive` until `start`, then `astern` until the surge velocity is zero.

    The steering command is zero, and there is no memory.

    Attributes:
        drive: fraction of the full propulsion command in the approach.
        astern: fraction of the full propulsion command after the order, negative.
        start: time of the order in s.
    """

    observed_states: ClassVar[tuple[str, ...]] = ("u",)
    parameter_names: ClassVar[tuple[str, ...]] = ("drive", "astern", "start")
    kind: Literal["stopping"] = "stopping"
    drive: float = Field(gt=0, le=1)
    astern: float = Field(default=-1.0, ge=-1, le=0)
    start: Seconds = Field(default=5.0, ge=0)

    @property
    def end_condition(self) -> str:
        return "a surge velocity of zero"

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        return indices.stopping_indices(log, self.start, length)

    def imo_limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return the IMO limit, which applies to full astern."""
        return indices.stopping_limits(length) if self.astern <= -0.999 else {}

    @classmethod
    def initial_memory(cls, motion: BatchValues, parameters: BatchValues) -> Tensor:
        return motion["u"].new_zeros(len(motion["u"]), 0)

    @classmethod
    def step_law(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Command the astern propulsion command after the order."""
        import torch

        # a sudden order: the lag of the propulsion is part of the vessel
        drive = torch.where(time >= parameters["start"], parameters["astern"], parameters["drive"])
        return drive, torch.zeros_like(drive), memory

    @classmethod
    def has_ended(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> Tensor:
        """Return whether each row has stopped, [B] bool."""
        return (time > parameters["start"]) & (motion["u"] <= 0)


# finer near zero, where the loop of an unstable vessel is
_SPIRAL_STEERS = (1.0, 0.6, 0.4, 0.2, 0.1, 0.0, -0.1, -0.2, -0.4, -0.6, -1.0)


class Spiral(ClosedLoopManoeuvre):
    """Dieudonne spiral: a sequence of helm angles, each until the yaw rate is steady.

    The yaw rate of a vessel without straight-line stability shows a hysteresis loop over the angle.
    The memory is the number of the current angle, and the state of the steady-turn test.

    Attributes:
        drive: constant fraction of the full propulsion command.
        steers: fractions of the full steering command in order; without these and `rudders`, from
            one side to the other and back.
        rudders: rudder angles instead of `steers`, for vessels with a rudder.
        start: time of the first helm order, after an approach straight ahead.
        steady: condition for the next angle.
    """

    observed_states: ClassVar[tuple[str, ...]] = ("r",)
    kind: Literal["spiral"] = "spiral"
    drive: float = Field(ge=-1, le=1)
    steers: tuple[float, ...] = ()
    rudders: tuple[Radians, ...] = ()
    start: Seconds = Field(default=5.0, ge=0)
    steady: SteadyConfig = SteadyConfig()

    @model_validator(mode="after")
    def _steers_or_rudders(self) -> Spiral:
        if self.steers and self.rudders:
            raise ValueError("give steers or rudders, not both")
        if any(abs(steer) > 1 for steer in self.steers):
            raise ValueError("steers are shares of full steer from -1 to 1")
        return self

    @property
    def helm_angles(self) -> tuple[float, ...]:
        """Rudder angles in rad, or fractions of the full steering command."""
        return self.rudders or self.steers or _SPIRAL_STEERS + _SPIRAL_STEERS[-2::-1]

    @property
    def end_condition(self) -> str:
        return f"a steady yaw rate at each of {len(self.helm_angles)} helm angles"

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the steady yaw rate at each completed angle, and the height of the loop.

        The height is the largest difference of the yaw rates at the angle nearest to zero. `steers`
        are rudder angles in rad if the manoeuvre has `rudders`, otherwise fractions of the full
        steering command.
        """
        # changes of the commands in the log show when each angle was ordered
        commands = [name for name in log.channels if name.startswith("cmd_")]
        has_moved = (np.abs(np.diff(log.stack(commands), axis=0)) > 1e-12).any(axis=1)
        change_samples = np.flatnonzero(has_moved & (log.t[1:] - log.t[0] >= self.start - 1e-9))
        angles = list(self.helm_angles)
        # the first change is the order of the first angle, unless this angle is amidships as in the
        # approach
        order_changes = change_samples if angles[0] == 0 else change_samples[1:]
        end_samples = [*order_changes.tolist(), len(log) - 1][: len(angles)]
        rates = [float(log["r"][i]) for i in end_samples]
        angles = angles[: len(rates)]
        smallest_angle = min(angles, key=abs)
        amidships_rates = [
            rate for angle, rate in zip(angles, rates, strict=True) if angle == smallest_angle
        ]
        spiral_indices: dict[str, Any] = {"steers": angles, "yaw_rates": rates}
        if len(amidships_rates) > 1:
            spiral_indices["loop_height"] = max(amidships_rates) - min(amidships_rates)
        return spiral_indices

    def law_parameters(self, helm: SupportsMaxRudder) -> dict[str, Any]:
        shares = [rudder_share(a, helm) if self.rudders else a for a in self.helm_angles]
        # after the last angle the helm goes amidships
        spiral_parameters = {"shares": [*shares, 0.0], "count": float(len(shares))}
        return super().law_parameters(helm) | spiral_parameters | dict(self.steady)

    @classmethod
    def initial_memory(cls, motion: BatchValues, parameters: BatchValues) -> Tensor:
        import torch

        return torch.cat(
            (torch.zeros_like(motion["r"])[:, None], initial_steadiness(motion["r"])), dim=-1
        )

    @classmethod
    def step_law(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Advance to the next angle if the turn is steady."""
        import torch

        is_steering = time >= parameters["start"]
        steadiness = reset_steady_time(
            update_steadiness(motion["r"], parameters, memory[:, 1:]), ~is_steering
        )
        has_settled = is_steady(parameters, steadiness)
        angle_index = torch.minimum(memory[:, 0] + has_settled.to(memory), parameters["count"])
        share = parameters["shares"].gather(1, angle_index.long().unsqueeze(-1))[:, 0]
        memory = torch.cat(
            (angle_index.unsqueeze(-1), reset_steady_time(steadiness, has_settled)), dim=-1
        )
        return parameters["drive"], torch.where(is_steering, share, 0.0), memory

    @classmethod
    def has_ended(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> Tensor:
        return memory[:, 0] >= parameters["count"]


class Helix(ScheduledManoeuvre):
    """Helix with constant commands: a turn in which the vessel descends or climbs.

    Attributes:
        drive: fraction of the full propulsion command, -1 to 1.
        steer: fraction of the full steering command; positive turns to starboard.
        dive: share of full dive; positive descends.
        start: time at which the steering and dive commands begin.
    """

    kind: Literal["helix"] = "helix"
    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)
    dive: float = Field(ge=-1, le=1)
    start: Seconds = Field(default=5.0, ge=0)

    def check_vessel(self, channels: PlantChannels) -> None:
        require_dive(can_dive=channels.can_dive)

    def demands_at(self, t: Tensor) -> tuple[Tensor, ...]:
        import torch

        is_steering = (t >= self.start - 1e-9).to(t.dtype)
        return torch.full_like(t, self.drive), self.steer * is_steering, self.dive * is_steering


class DivingFamily(ManoeuvreFamily, ABC):
    """Random manoeuvres in depth, which begin downwards or upwards.

    Attributes:
        drive: range of the fraction of the full propulsion command.
        dive: range of the share of full dive.
        start: time at which the dive begins.
    """

    drive: Range = (0.4, 0.8)
    dive: Range = (0.2, 0.6)
    start: Seconds = 5.0

    def sample_common(self, generator: np.random.Generator) -> dict[str, Any]:
        """Draw propulsion command and signed dive command; returns them with the start."""
        dive_sign = 1.0 if generator.random() < 0.5 else -1.0
        drive = sample_uniform(generator, self.drive)
        dive = sample_uniform(generator, self.dive)
        return {"drive": drive, "dive": dive_sign * dive, "start": self.start}


class HelixFamily(DivingFamily):
    """Random helices.

    Attributes:
        steer: range of the fraction of the full steering command.
    """

    kind: Literal["helix"] = "helix"
    steer: Range = (0.2, 0.8)

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        turn_sign = 1.0 if generator.random() < 0.5 else -1.0
        return Helix(
            steer=turn_sign * sample_uniform(generator, self.steer), **self.sample_common(generator)
        )


class VerticalZigzag(ClosedLoopManoeuvre):
    """Vertical zigzag: the dive is reversed whenever the depth has changed by `depth` to its side.

    The memory is the sign of the demand (+1 down) and the depth at the start.

    Attributes:
        drive: constant fraction of the full propulsion command.
        dive: share of full dive; a negative value climbs first.
        depth: change of depth at which the dive is reversed.
        start: time at which the dive begins.
    """

    observed_states: ClassVar[tuple[str, ...]] = ("z",)
    kind: Literal["vertical_zigzag"] = "vertical_zigzag"
    drive: float = Field(ge=-1, le=1)
    dive: float = Field(ge=-1, le=1)
    depth: Metres = Field(gt=0)
    start: Seconds = Field(default=5.0, ge=0)

    def check_vessel(self, channels: PlantChannels) -> None:
        super().check_vessel(channels)
        require_dive(can_dive=channels.can_dive)

    def law_parameters(self, helm: SupportsMaxRudder) -> dict[str, Any]:
        first_sign = -1.0 if self.dive < 0 else 1.0
        dive_parameters = {
            "dive": abs(self.dive),
            "first_sign": first_sign,
            "reversal_depth": self.depth,
        }
        return super().law_parameters(helm) | dive_parameters

    @classmethod
    def initial_memory(cls, motion: BatchValues, parameters: BatchValues) -> Tensor:
        """Return the sign of the first dive and the current depth, [B, 2]."""
        import torch

        return torch.stack((parameters["first_sign"], motion["z"]), dim=-1)

    @classmethod
    def step_law(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """Reverse the dive if the depth has reached its bound."""
        import torch

        dive_sign, origin = memory.unbind(-1)
        dive_sign = torch.where(
            dive_sign * (motion["z"] - origin) >= parameters["reversal_depth"],
            -dive_sign,
            dive_sign,
        )
        dive = torch.where(time >= parameters["start"], dive_sign * parameters["dive"], 0.0)
        zero_steer = torch.zeros_like(dive)
        return parameters["drive"], zero_steer, dive, torch.stack((dive_sign, origin), dim=-1)


class VerticalZigzagFamily(DivingFamily):
    """Random vertical zigzags.

    Attributes:
        depth: candidate changes of depth in m.
    """

    kind: Literal["vertical_zigzag"] = "vertical_zigzag"
    depth: tuple[Metres, ...] = Field(min_length=1)

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        return VerticalZigzag(
            depth=float(generator.choice(self.depth)), **self.sample_common(generator)
        )


class DepthStep(ClosedLoopManoeuvre):
    """Step of the depth setpoint with a controller of depth, depth rate and pitch rate.

    The steering command is zero. The memory is the depth at the start.

    Attributes:
        drive: constant fraction of the full propulsion command.
        dive: largest share of full dive.
        depth: change of the setpoint; positive is deeper.
        start: time of the step.
        gain: dive per metre of depth error.
        damping: dive per m/s of descent.
        pitch_damping: dive per rad/s of pitch rate.
    """

    observed_states: ClassVar[tuple[str, ...]] = ("z", "u", "v", "w", "phi", "theta", "q")
    parameter_names: ClassVar[tuple[str, ...]] = (
        "drive", "dive", "depth", "start", "gain", "damping", "pitch_damping",
    )  # fmt: skip
    kind: Literal["depth_step"] = "depth_step"
    drive: float = Field(ge=-1, le=1)
    dive: float = Field(default=0.5, gt=0, le=1)
    depth: Metres
    start: Seconds = Field(default=5.0, ge=0)
    gain: float = Field(default=0.3, gt=0)
    damping: float = Field(default=1.0, ge=0)
    pitch_damping: float = Field(default=1.0, ge=0)

    def check_vessel(self, channels: PlantChannels) -> None:
        super().check_vessel(channels)
        require_dive(can_dive=channels.can_dive)

    @classmethod
    def initial_memory(cls, motion: BatchValues, parameters: BatchValues) -> Tensor:
        """Return the current depth, [B, 1]."""
        return motion["z"].unsqueeze(-1)

    @classmethod
    def step_law(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the dive demand: proportional to the depth error, damped by the depth rate."""
        import torch

        ordered_change = torch.where(time >= parameters["start"], parameters["depth"], 0.0)
        depth_error = memory[:, 0] + ordered_change - motion["z"]
        # the depth rate instead of w, which differs from it at a pitch angle
        descent = to_level_axes(*(motion[name] for name in ("u", "v", "w", "phi", "theta")))[2]
        dive = parameters["gain"] * depth_error - parameters["damping"] * descent
        # q is positive nose up: damping demands more dive while the bow rises
        dive = dive + parameters["pitch_damping"] * motion["q"]
        dive = torch.minimum(torch.maximum(dive, -parameters["dive"]), parameters["dive"])
        return parameters["drive"], torch.zeros_like(dive), dive, memory


class DepthStepFamily(DivingFamily):
    """Random steps of depth.

    Attributes:
        depth: candidate changes of depth in m.
    """

    kind: Literal["depth_step"] = "depth_step"
    depth: tuple[Metres, ...] = Field(min_length=1)

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        common_settings = self.sample_common(generator)
        depth_sign = np.sign(common_settings["dive"])
        depth = float(depth_sign * generator.choice(self.depth))
        return DepthStep(depth=depth, **{**common_settings, "dive": abs(common_settings["dive"])})

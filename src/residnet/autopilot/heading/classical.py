"""Heading laws with positive constants, and PD and time-optimal controllers of the heading."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, final

import torch
from torch import Tensor, nn

from residnet.autopilot.base import Policy
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap_angle


@final
class HeadingPD(Policy):
    """The law delta = kp e - kd r, saturated, with e the wrapped heading error.

    Args:
        kp: rad of rudder per rad of error.
        kd: rad of rudder per rad/s of yaw.
        limit: of the rudder command in rad.
    """

    def __init__(self, state: Sequence[str], *, kp: float, kd: float, limit: float) -> None:
        super().__init__()
        if limit <= 0:
            raise ConfigError(f"heading PD: the limit must be positive, given {limit:g}")
        self.psi = state.index("psi")
        self.r = state.index("r")
        self.kp = kp
        self.kd = kd
        self.limit = limit

    @classmethod
    def from_pole_placement(
        cls,
        state: Sequence[str],
        *,
        gain: float,
        time: float,
        frequency: float,
        damping: float,
        limit: float,
    ) -> HeadingPD:
        """Return the PD law that gives T r_dot + r = K delta a natural frequency and damping.

        The frequency is in rad/s, the damping relative (document 004 eq. (5.9)).
        """
        return cls(
            state,
            kp=time * frequency**2 / gain,
            kd=(2.0 * damping * frequency * time - 1.0) / gain,
            limit=limit,
        )

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        error = wrap_angle(reference - x[:, self.psi : self.psi + 1])
        unlimited_command = self.kp * error - self.kd * x[:, self.r : self.r + 1]
        return unlimited_command.clamp(-self.limit, self.limit), s


@final
class BangBangHeading(Policy):
    """Full rudder towards the switching curve of T r_dot + r = K delta (document 004 eq. (5.9)).

    Full counter-rudder stops a yaw rate r within T r - T K d ln(1 + r / (K d)) of heading, d the
    largest angle; the sign of the heading error less that decides. Within `boundary_layer` of the curve the
    command is proportional, and where error and yaw rate are inside `capture` the command is kp e -
    kd r, which brings them to zero.

    Args:
        gain, time: K [1/s] and T [s], both positive.
        limit: d [rad].
        boundary_layer: of the heading error about the curve [rad].
        capture: largest heading error [rad] and yaw rate [rad/s] of the linear law.
        kp, kd: of the linear law; kd is T / (2 K) where none is given.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        gain: float,
        time: float,
        limit: float,
        layer: float = 2.5e-3,
        capture: tuple[float, float] = (2e-4, 2e-3),
        kp: float = 0.8,
        kd: float | None = None,
    ) -> None:
        super().__init__()
        if min(gain, time, limit, layer) <= 0:
            raise ConfigError(
                f"bang-bang heading: gain, time, limit and layer must be positive, given {gain:g},"
                f" {time:g}, {limit:g}, {layer:g}"
            )
        self.psi = state.index("psi")
        self.r = state.index("r")
        self.time = time
        self.limit = limit
        self.boundary_layer = layer
        self.max_yaw_rate = gain * limit
        self.capture_angle, self.capture_rate = capture
        self.kp, self.kd = kp, time / (2.0 * gain) if kd is None else kd

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad; there is no memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory [B, 0].
        """
        r = x[:, self.r : self.r + 1]
        error = wrap_angle(reference - x[:, self.psi : self.psi + 1])
        braking = self.time * (
            r - r.sign() * self.max_yaw_rate * torch.log1p(r.abs() / self.max_yaw_rate)
        )
        switching_command = ((error - braking) * (self.limit / self.boundary_layer)).clamp(
            -self.limit, self.limit
        )
        is_captured = (error.abs() < self.capture_angle) & (r.abs() < self.capture_rate)
        linear_command = (self.kp * error - self.kd * r).clamp(-self.limit, self.limit)
        return torch.where(is_captured, linear_command, switching_command), s


_N_BISECTIONS = 40
"""Of the range of the effort: 2^-40 of it is less than single precision resolves."""


@final
class RatedBangBangHeading(Policy):
    """Full rudder towards the reference until only the braking programme is left.

    The rudder moves at its rate.

    The braking programme takes the rudder to an angle on the other side, holds it where that is the
    largest one, and brings it amidships, such that T r_dot + r = K delta (document 004 eq. (5.9))
    ends at rest; how much counter-rudder that takes is found by halving. The heading that is gained
    on the way, K times the integral of delta plus T r, is compared with the heading error. Within
    `boundary_layer` of equality the two commands are mixed, and where error, yaw rate and rudder are inside
    `capture` the command is kp e - kd r.

    Args:
        state: names of the vessel's state, with `delta`.
        gain, time: K [1/s] and T [s], both positive.
        limit: largest rudder angle [rad].
        rate: of the rudder [rad/s].
        dt: step of the controller [s]: the rudder answers a command one step later.
        boundary_layer: of the heading error [rad].
        capture: largest heading error [rad] and yaw rate [rad/s] of the linear law.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        gain: float,
        time: float,
        limit: float,
        rate: float,
        dt: float,
        layer: float = 1e-3,
        capture: tuple[float, float] = (1.5e-3, 2e-3),
    ) -> None:
        super().__init__()
        if min(gain, time, limit, rate, dt, layer) <= 0:
            raise ConfigError(
                "bang-bang heading: gain, time, limit, rate, step and layer must be positive"
            )
        self.psi, self.r, self.delta = (state.index(name) for name in ("psi", "r", "delta"))
        self.gain = gain
        self.time = time
        self.limit = limit
        self.rate = rate
        self.dt = dt
        self.boundary_layer = layer
        self.capture_angle, self.capture_rate = capture

    def _ramp_rudder(self, r: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Return yaw rate and integral of the angle after the rudder has gone to another angle."""
        ramp_time = (end - start).abs() / self.rate
        slope = (end - start).sign() * self.rate
        steady = self.gain * (start - slope * self.time)
        return (
            self.gain * (end - slope * self.time)
            + (r - steady) * torch.exp(-ramp_time / self.time),
            0.5 * (start + end) * ramp_time,
        )

    def _simulate_braking(self, r: Tensor, rudder: Tensor, effort: Tensor) -> tuple[Tensor, Tensor]:
        """Return the yaw rate after a braking programme, and the heading gained in it.

        The effort is in rad; beyond the rudder's limit it is time held there.
        """
        held_angle = effort.clamp(max=self.limit)
        rate_after_ramp, first_integral = self._ramp_rudder(r, rudder, -held_angle)
        hold_time = (effort - held_angle) / self.rate
        rate_after_hold = -self.gain * held_angle + (
            rate_after_ramp + self.gain * held_angle
        ) * torch.exp(-hold_time / self.time)
        final_rate, last_integral = self._ramp_rudder(
            rate_after_hold, -held_angle, torch.zeros_like(held_angle)
        )
        return final_rate, self.gain * (
            first_integral - held_angle * hold_time + last_integral
        ) + self.time * (r - final_rate)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad; there is no memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory [B, 0].
        """
        error = wrap_angle(reference - x[:, self.psi : self.psi + 1])
        yaw_rate = x[:, self.r : self.r + 1]
        rudder_angle = x[:, self.delta : self.delta + 1]
        # this step goes by as it is: the rudder answers at its end
        steady = self.gain * rudder_angle
        next_yaw_rate = steady + (yaw_rate - steady) * math.exp(-self.dt / self.time)
        error = error - steady * self.dt - self.time * (yaw_rate - next_yaw_rate)
        yaw_rate = next_yaw_rate
        # the way that the vessel will have turned once the rudder is amidships
        centred_yaw_rate = self._ramp_rudder(
            yaw_rate, rudder_angle, torch.zeros_like(rudder_angle)
        )[0]
        turn_direction = torch.where(
            centred_yaw_rate.abs() > 1e-9, centred_yaw_rate.sign(), error.sign()
        )
        r = turn_direction * yaw_rate
        rudder = turn_direction * rudder_angle
        lower, upper = torch.zeros_like(r), torch.full_like(r, 20.0 * self.limit)
        for _ in range(_N_BISECTIONS):
            trial_effort = 0.5 * (lower + upper)
            is_turning = self._simulate_braking(r, rudder, trial_effort)[0] > 0
            lower, upper = (
                torch.where(is_turning, trial_effort, lower),
                torch.where(is_turning, upper, trial_effort),
            )
        effort = 0.5 * (lower + upper)
        distance = self._simulate_braking(r, rudder, effort)[1]
        remaining_error = turn_direction * error - distance
        mixing_factor = (remaining_error / self.boundary_layer).clamp(-1.0, 1.0)
        brake = -effort.clamp(max=self.limit)
        command = turn_direction * torch.where(
            mixing_factor > 0,
            brake + mixing_factor * (self.limit - brake),
            brake - mixing_factor * (-self.limit - brake),
        )
        is_captured = (error.abs() < self.capture_angle) & (yaw_rate.abs() < self.capture_rate)
        kp = 0.8
        kd = self.time / (2.0 * self.gain)
        return (
            torch.where(
                is_captured, (kp * error - kd * yaw_rate).clamp(-self.limit, self.limit), command
            ),
            s,
        )


def predict_centred_rudder(
    error: Tensor, r: Tensor, rudder_share: Tensor, force: Tensor, decay: Tensor, swing_time: float
) -> tuple[Tensor, Tensor]:
    """Return the error and yaw rate [B, 1] that will be left once the rudder is centred.

    The rudder acts with a share of its limit until it has gone to where it does nothing.

    Args:
        error: heading error [B, 1] in rad.
        r: yaw rate [B, 1] in rad/s.
        rudder_share: rudder [B, 1] as a share of its limit.
        force: yaw acceleration [B, 1] of full rudder in rad/s^2.
        decay: 1/T [B, 1] in 1/s.
        swing_time: time in s that the rudder takes from amidships to its limit.
    """
    centring_time = rudder_share.abs() * swing_time
    centred_yaw_rate = r + centring_time * (0.5 * force * rudder_share - decay * r)
    return error - centring_time * (
        r + centring_time * (force * rudder_share / 3.0 - 0.5 * decay * r)
    ), centred_yaw_rate


def braking_distance(
    r: Tensor,
    force: Tensor,
    decay: Tensor,
    stiffness: Tensor,
    damping_ratio: Tensor,
    swing_time: float,
) -> Tensor:
    """Return the heading [B, 1] that passes while r_dot = -force - decay r stops the yaw rate.

    It is r / nu near zero, with the same slope there.

    The rudder starts from amidships and comes back there: that takes half of its swing more, or a
    pulse that does not reach the limit. nu is chosen such that e'' + (decay + stiffness / nu) e' +
    stiffness e = 0 has the relative damping `damping_ratio`.

    Args:
        r: yaw rate [B, 1] in rad/s.
        force: yaw acceleration that is counted on, in rad/s^2.
        decay: 1/T in 1/s.
        stiffness: yaw acceleration per heading error near the reference in 1/s^2.
        swing_time: time in s that the rudder takes from amidships to its limit.
    """
    linear_time = ((2.0 * damping_ratio * torch.sqrt(stiffness) - decay) / stiffness).clamp(
        min=1e-3
    )
    saturated_time = (linear_time - 0.5 * swing_time).clamp(min=1e-3)
    linear_limit = force * saturated_time / (1.0 - decay * saturated_time).clamp(min=0.1)
    if swing_time > 0.0:
        linear_limit = torch.where(
            linear_time < 1.5 * swing_time,
            (linear_time / 1.5).square() * force / swing_time,
            linear_limit,
        )
    yaw_rate_size = r.abs()
    saturated_rate = torch.maximum(yaw_rate_size, linear_limit)
    saturated_distance = (
        _stopping_angle(saturated_rate, force, decay, swing_time)
        - _stopping_angle(linear_limit, force, decay, swing_time)
        + linear_limit * linear_time
    )
    return r.sign() * torch.where(
        yaw_rate_size < linear_limit, yaw_rate_size * linear_time, saturated_distance
    )


def _stopping_angle(r: Tensor, force: Tensor, decay: Tensor, swing_time: float) -> Tensor:
    """Return the heading [B, 1] in which a yaw rate r > 0 is stopped.

    It is the integral of r dr / (force + decay r), and what the rudder's swing adds.
    """
    braking_angle = (r - force / decay * torch.log1p(decay * r / force)) / decay
    if swing_time == 0.0:
        return braking_angle
    pulse_angle = r * torch.sqrt(r * swing_time / force) - 0.5 * r.square() / force
    return braking_angle + torch.where(r < force * swing_time, pulse_angle, 0.5 * swing_time * r)


class HeadingLaw(nn.Module, ABC):
    """The rudder, as a share of its limit, from heading error and yaw rate.

    Attributes:
        constants: names of the law's constants, all positive.
    """

    constants: ClassVar[tuple[str, ...]]

    @abstractmethod
    def forward(
        self,
        error: Tensor,
        r: Tensor,
        rudder_share: Tensor,
        force: Tensor,
        decay: Tensor,
        constants: list[Tensor],
    ) -> Tensor:
        """Return the wanted share [B, 1] of the rudder's limit; it may exceed one.

        Args:
            error: heading error [B, 1] in rad.
            r: yaw rate [B, 1] in rad/s.
            rudder_share: rudder angle and push [B, 1] as a share of the limit.
            force: yaw acceleration [B, 1] of full rudder in rad/s^2.
            decay: 1/T [B, 1] in 1/s.
            constants: the law's own, [1] or [B, 1] each.
        """


@final
class RegulatorLaw(HeadingLaw):
    """The linear-quadratic regulator kp e - kd r of T r_dot + r = K delta.

    Its weights are those of `LqrConfig`: kp = sqrt(heading_weight), (1 + K kd)^2 = 1 + K^2 T^2
    rate_weight + 2 K T kp.
    """

    constants: ClassVar[tuple[str, ...]] = ("heading_weight", "rate_weight")

    def __init__(self, limit: float) -> None:
        super().__init__()
        self.limit = limit

    def forward(
        self,
        error: Tensor,
        r: Tensor,
        rudder_share: Tensor,
        force: Tensor,
        decay: Tensor,
        constants: list[Tensor],
    ) -> Tensor:
        heading, rate = regulator_gains(
            constants[0], constants[1], force / (decay * self.limit), 1.0 / decay
        )
        return (heading * error - rate * r) / self.limit


def regulator_gains(
    heading_weight: Tensor, rate_weight: Tensor, gain: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    """Return kp [-] and kd [s] of the regulator's weights; K [1/s], T [s], shapes broadcast."""
    kp = heading_weight.sqrt()
    discriminant = 1.0 + (gain * time).square() * rate_weight + 2.0 * gain * time * kp
    return kp, (discriminant.sqrt() - 1.0) / gain


@final
class ProximateTimeOptimalLaw(HeadingLaw):
    """The proximate time-optimal law: full rudder until only the way to stop is left.

    steepness (e - g(r)) with g the heading in which counter-rudder stops the yaw rate, a straight
    line near the reference (M. L. Workman, Adaptive proximate time-optimal servomechanisms, 1987).
    `mixing_factor` of the rudder's braking is counted on; `damping` is the relative damping near the
    reference.
    """

    constants: ClassVar[tuple[str, ...]] = ("steepness", "share", "damping")

    def __init__(self, swing_time: float) -> None:
        super().__init__()
        self.swing_time = swing_time

    def forward(
        self,
        error: Tensor,
        r: Tensor,
        rudder_share: Tensor,
        force: Tensor,
        decay: Tensor,
        constants: list[Tensor],
    ) -> Tensor:
        """Return steepness times the heading that is left once the yaw rate is stopped, [B, 1]."""
        steepness = constants[0]
        share = constants[1]
        damping_ratio = constants[2]
        predicted_error = error
        predicted_rate = r
        if self.swing_time > 0.0:
            # the rudder answers its own angle with a gain above one, within its rate: a gradient
            # through that would grow from step to step and say nothing of the flight
            predicted_error, predicted_rate = predict_centred_rudder(
                error, r, rudder_share.detach(), force, decay, self.swing_time
            )
        stopping_angle = braking_distance(
            predicted_rate, share * force, decay, steepness * force, damping_ratio, self.swing_time
        )
        return steepness * (predicted_error - stopping_angle)

"""Classical heading control: PD, linear-quadratic and time-optimal laws."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.autopilot.base import Policy
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap_angle


@final
class HeadingPD(Policy):
    """The saturated law delta = kp e - kd r with the wrapped heading error e.

    Args:
        state: names of the state.
        kp: proportional gain in rad of rudder per rad of heading error.
        kd: derivative gain in rad of rudder per rad/s of yaw rate.
        limit: rudder limit in rad.
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
        """Design a PD law for T r_dot + r = K delta by pole placement (Gouletas 2020, eq. (5.9)).

        Args:
            state: names of the state.
            gain: K in 1/s.
            time: T in s.
            frequency: natural frequency of the closed loop in rad/s.
            damping: damping ratio of the closed loop.
            limit: rudder limit in rad.
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
    """Time-optimal bang-bang control of T r_dot + r = K delta (Gouletas 2020, eq. (5.9)).

    Full counter-rudder d stops a yaw rate r within T r - T K d ln(1 + r / (K d)) of heading. The
    sign of the heading error minus this angle selects the side of the rudder. In a boundary layer
    about this switching curve the command is proportional. Near the reference the linear law
    kp e - kd r drives error and yaw rate to zero.

    Args:
        state: names of the state.
        gain, time: K [1/s] and T [s], both positive.
        limit: rudder limit d [rad].
        layer: half width of the boundary layer in heading error [rad].
        capture: largest heading error [rad] and yaw rate [rad/s] of the linear law.
        kp, kd: gains of the linear law; None for kd = T / (2 K).
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
        """Return the rudder command [B, 1] in rad; the policy has no memory.

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
"""Bisections of the braking effort; 2^-40 of its range is below the resolution of float32."""


@final
class RatedBangBangHeading(Policy):
    """Time-optimal control of T r_dot + r = K delta with a rudder rate (Gouletas 2020, eq. (5.9)).

    The law applies full rudder towards the reference until braking has to start. Braking moves the
    rudder to the opposite side, holds it if it reaches the limit, and returns it amidships, so that
    the yaw rate ends at zero. The required counter-rudder is computed by bisection. The heading
    change during braking, K times the integral of delta plus T r, is compared with the heading
    error. In a boundary layer about equality the two commands are interpolated. Near the reference
    the command is the linear law kp e - kd r.

    Args:
        state: names of the state, including `delta`.
        gain, time: K [1/s] and T [s], both positive.
        limit: rudder limit [rad].
        rate: rudder rate [rad/s].
        dt: time step [s]; the rudder responds to a command one step later.
        layer: half width of the boundary layer in heading error [rad].
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
        """Return yaw rate and integral of the rudder angle after a ramp between two angles."""
        ramp_time = (end - start).abs() / self.rate
        slope = (end - start).sign() * self.rate
        steady = self.gain * (start - slope * self.time)
        return (
            self.gain * (end - slope * self.time)
            + (r - steady) * torch.exp(-ramp_time / self.time),
            0.5 * (start + end) * ramp_time,
        )

    def _simulate_braking(self, r: Tensor, rudder: Tensor, effort: Tensor) -> tuple[Tensor, Tensor]:
        """Return the yaw rate after braking and the heading change during braking.

        Args:
            r: yaw rate [B, 1] in rad/s.
            rudder: rudder angle [B, 1] in rad.
            effort: peak of the counter-rudder in rad; the excess over the rudder limit is the time
                at the limit, multiplied by the rudder rate.
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
        """Return the rudder command [B, 1] in rad; the policy has no memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory [B, 0].
        """
        error = wrap_angle(reference - x[:, self.psi : self.psi + 1])
        yaw_rate = x[:, self.r : self.r + 1]
        rudder_angle = x[:, self.delta : self.delta + 1]
        # the rudder responds at the end of this step: the state is predicted to that time
        steady = self.gain * rudder_angle
        next_yaw_rate = steady + (yaw_rate - steady) * math.exp(-self.dt / self.time)
        error = error - steady * self.dt - self.time * (yaw_rate - next_yaw_rate)
        yaw_rate = next_yaw_rate
        # direction of the turn after the rudder has been moved amidships, in which braking is
        # computed
        centred_yaw_rate = self._ramp_rudder(
            yaw_rate, rudder_angle, torch.zeros_like(rudder_angle)
        )[0]
        turn_direction = torch.where(
            centred_yaw_rate.abs() > 1e-9, centred_yaw_rate.sign(), error.sign()
        )
        r = turn_direction * yaw_rate
        rudder = turn_direction * rudder_angle
        lower = torch.zeros_like(r)
        upper = torch.full_like(r, 20.0 * self.limit)
        # bisection with a fixed number of steps works on batches and can be traced
        for _ in range(_N_BISECTIONS):
            trial_effort = 0.5 * (lower + upper)
            is_turning = self._simulate_braking(r, rudder, trial_effort)[0] > 0
            lower = torch.where(is_turning, trial_effort, lower)
            upper = torch.where(is_turning, upper, trial_effort)
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
    error: Tensor,
    r: Tensor,
    normalised_rudder: Tensor,
    max_yaw_acceleration: Tensor,
    inverse_time_constant: Tensor,
    swing_time: float,
) -> tuple[Tensor, Tensor]:
    """Predict heading error and yaw rate [B, 1] for the time when the rudder has been centred.

    The rudder returns to its neutral angle at its rate and acts on the vessel meanwhile.

    Args:
        error: heading error [B, 1] in rad.
        r: yaw rate [B, 1] in rad/s.
        normalised_rudder: rudder angle [B, 1] as a fraction of its limit.
        max_yaw_acceleration: yaw acceleration [B, 1] at full rudder in rad/s^2.
        inverse_time_constant: 1/T [B, 1] in 1/s.
        swing_time: time in s that the rudder takes from amidships to its limit.
    """
    centring_time = normalised_rudder.abs() * swing_time
    centred_yaw_rate = r + centring_time * (
        0.5 * max_yaw_acceleration * normalised_rudder - inverse_time_constant * r
    )
    return error - centring_time * (
        r
        + centring_time
        * (max_yaw_acceleration * normalised_rudder / 3.0 - 0.5 * inverse_time_constant * r)
    ), centred_yaw_rate


def braking_distance(
    r: Tensor,
    max_yaw_acceleration: Tensor,
    inverse_time_constant: Tensor,
    stiffness: Tensor,
    damping_ratio: Tensor,
    swing_time: float,
) -> Tensor:
    """Return the heading change [B, 1] while full counter-rudder reduces the yaw rate to zero.

    The yaw rate follows r_dot = -a - r / T with the maximum yaw acceleration a. For small yaw rates
    the result is r / nu, joined with a continuous slope. nu is chosen so that the linear closed
    loop, d^2 e / dt^2 + (1 / T + stiffness / nu) de / dt + stiffness e = 0, has the damping ratio
    `damping_ratio`. The rudder starts and ends amidships: braking takes half a rudder movement
    longer, or is a pulse that does not reach the limit.

    Args:
        r: yaw rate [B, 1] in rad/s.
        max_yaw_acceleration: braking acceleration in rad/s^2.
        inverse_time_constant: 1/T in 1/s.
        stiffness: yaw acceleration per heading error near the reference in 1/s^2.
        damping_ratio: damping ratio near the reference.
        swing_time: time in s that the rudder takes from amidships to its limit.
    """
    linear_time = (
        (2.0 * damping_ratio * torch.sqrt(stiffness) - inverse_time_constant) / stiffness
    ).clamp(min=1e-3)
    saturated_time = (linear_time - 0.5 * swing_time).clamp(min=1e-3)
    linear_limit = (
        max_yaw_acceleration
        * saturated_time
        / (1.0 - inverse_time_constant * saturated_time).clamp(min=0.1)
    )
    if swing_time > 0.0:
        linear_limit = torch.where(
            linear_time < 1.5 * swing_time,
            (linear_time / 1.5).square() * max_yaw_acceleration / swing_time,
            linear_limit,
        )
    yaw_rate_size = r.abs()
    saturated_rate = torch.maximum(yaw_rate_size, linear_limit)
    saturated_distance = (
        _stopping_angle(saturated_rate, max_yaw_acceleration, inverse_time_constant, swing_time)
        - _stopping_angle(linear_limit, max_yaw_acceleration, inverse_time_constant, swing_time)
        + linear_limit * linear_time
    )
    return r.sign() * torch.where(
        yaw_rate_size < linear_limit, yaw_rate_size * linear_time, saturated_distance
    )


def _stopping_angle(
    r: Tensor, max_yaw_acceleration: Tensor, inverse_time_constant: Tensor, swing_time: float
) -> Tensor:
    """Return the heading change [B, 1] until a yaw rate r > 0 is zero.

    It is the integral of r dr / (a + r / T), with the maximum yaw acceleration a, plus the
    contribution of the rudder movement.
    """
    braking_angle = (
        r
        - max_yaw_acceleration
        / inverse_time_constant
        * torch.log1p(inverse_time_constant * r / max_yaw_acceleration)
    ) / inverse_time_constant
    if swing_time == 0.0:
        return braking_angle
    pulse_angle = (
        r * torch.sqrt(r * swing_time / max_yaw_acceleration)
        - 0.5 * r.square() / max_yaw_acceleration
    )
    return braking_angle + torch.where(
        r < max_yaw_acceleration * swing_time, pulse_angle, 0.5 * swing_time * r
    )


class HeadingLawInput(NamedTuple):
    """Predicted motion and Nomoto parameters at the current speed, from which a law steers.

    Attributes:
        error: heading error [B, 1] in rad.
        r: yaw rate [B, 1] in rad/s.
        normalised_rudder: rudder angle plus disturbance [B, 1] as a fraction of the limit.
        max_yaw_acceleration: yaw acceleration [B, 1] at full rudder in rad/s^2.
        inverse_time_constant: 1/T [B, 1] in 1/s.
    """

    error: Tensor
    r: Tensor
    normalised_rudder: Tensor
    max_yaw_acceleration: Tensor
    inverse_time_constant: Tensor


class HeadingLaw(nn.Module, ABC):
    """A control law from heading error and yaw rate to the rudder as a fraction of its limit.

    Attributes:
        constants: names of the law's constants, all positive.
    """

    constants: ClassVar[tuple[str, ...]]

    @abstractmethod
    def forward(self, inputs: HeadingLawInput, constants: list[Tensor]) -> Tensor:
        """Return the desired rudder [B, 1] as a fraction of its limit, not yet saturated.

        Args:
            inputs: heading error, yaw rate, rudder and parameters of the vessel.
            constants: constants of the law, [1] or [B, 1] each.
        """


@final
class RegulatorLaw(HeadingLaw):
    """The linear-quadratic regulator kp e - kd r of T r_dot + r = K delta.

    The weights are defined in `LqrConfig`: kp = sqrt(heading_weight),
    (1 + K kd)^2 = 1 + K^2 T^2 rate_weight + 2 K T kp.
    """

    constants: ClassVar[tuple[str, ...]] = ("heading_weight", "rate_weight")

    def __init__(self, limit: float) -> None:
        super().__init__()
        self.limit = limit

    def forward(self, inputs: HeadingLawInput, constants: list[Tensor]) -> Tensor:
        heading_gain, rate_gain = regulator_gains(
            constants[0],
            constants[1],
            inputs.max_yaw_acceleration / (inputs.inverse_time_constant * self.limit),
            1.0 / inputs.inverse_time_constant,
        )
        return (heading_gain * inputs.error - rate_gain * inputs.r) / self.limit


def regulator_gains(
    heading_weight: Tensor, rate_weight: Tensor, gain: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the gains kp [-] and kd [s] for weights, K [1/s] and T [s] of broadcast shapes."""
    kp = heading_weight.sqrt()
    discriminant = 1.0 + (gain * time).square() * rate_weight + 2.0 * gain * time * kp
    return kp, (discriminant.sqrt() - 1.0) / gain


@final
class ProximateTimeOptimalLaw(HeadingLaw):
    """Proximate time-optimal law for heading changes.

    Source: M. L. Workman, Adaptive proximate time-optimal servomechanisms, 1987. The
    output is steepness (e - g(r)), where g is the heading change during braking with
    counter-rudder, linear in r near the reference. The constants are `steepness`, `share` (the
    fraction of the braking acceleration that the law relies on) and `damping` (damping ratio near
    the reference).

    Args:
        swing_time: time in s that the rudder takes from amidships to its limit.
    """

    constants: ClassVar[tuple[str, ...]] = ("steepness", "share", "damping")

    def __init__(self, swing_time: float) -> None:
        super().__init__()
        self.swing_time = swing_time

    def forward(self, inputs: HeadingLawInput, constants: list[Tensor]) -> Tensor:
        """Return steepness times the heading error [B, 1] that remains after braking."""
        steepness = constants[0]
        share = constants[1]
        damping_ratio = constants[2]
        predicted_error = inputs.error
        predicted_rate = inputs.r
        if self.swing_time > 0.0:
            # the command depends on the rudder angle with a gain above one, which only the rate
            # limit keeps stable: gradients through this loop would grow from step to step
            predicted_error, predicted_rate = predict_centred_rudder(
                inputs.error,
                inputs.r,
                inputs.normalised_rudder.detach(),
                inputs.max_yaw_acceleration,
                inputs.inverse_time_constant,
                self.swing_time,
            )
        stopping_angle = braking_distance(
            predicted_rate,
            share * inputs.max_yaw_acceleration,
            inputs.inverse_time_constant,
            steepness * inputs.max_yaw_acceleration,
            damping_ratio,
            self.swing_time,
        )
        return steepness * (predicted_error - stopping_angle)

"""Learned steering policies: observer and control law with a recurrent network, or network alone.

A policy controls the heading. As the inner loop of a depth policy it controls the dive angle. The
vessel is Nomoto's model T r_dot + r = K (delta + d) with the yaw rate r, the rudder angle delta and
a yaw disturbance d. The disturbance is expressed as the rudder angle in rad that would cause it.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.autopilot.base import Policy
from residnet.autopilot.heading.classical import HeadingLaw, HeadingLawInput
from residnet.autopilot.heading.steering_variation import DEPTH, HEADING, Axis
from residnet.autopilot.heading.turning import NomotoModel
from residnet.core.frames import wrap_angle
from residnet.core.renamed_state import RenamedStateModule


class AnglePolicy(Policy, ABC):
    """A policy that controls an angle: the heading, or the dive angle in a depth policy.

    Attributes:
        dt: time step in s.
    """

    dt: float

    def set_state_columns(self, state: Sequence[str]) -> None:
        """Set the columns of heading, yaw rate and speed in a state with these names."""
        self.psi_column = state.index("psi")
        self.u_column = state.index("u")
        self.r_column = state.index("r")

    def set_step(self, dt: float) -> None:
        """Set the time step to dt seconds."""
        self.dt = dt


class SteeringPolicy(AnglePolicy, ABC):
    """A steering policy that can be exported: it knows its measurements, rudder and memory ranges.

    Attributes:
        axis: controlled axis.
        measured: names of the measurements with their units; the controlled state comes first.
        gain: Nomoto gain K of the vessel in 1/s.
        time_constant: Nomoto time constant T of the vessel in s.
        speed: speed in m/s that K and T refer to.
        limit: rudder limit in rad.
        rate: rudder rate in rad/s; infinite for a rudder without a rate limit.
        max_rudder_step: largest movement of the rudder in a time step, in rad.
    """

    axis: ClassVar[Axis] = HEADING
    measured: ClassVar[Mapping[str, str]] = {"psi": "rad", "u": "m/s", "r": "rad/s"}

    def __init__(
        self, state: Sequence[str], nomoto: NomotoModel, limit: float, rate: float | None
    ) -> None:
        super().__init__()
        self.set_state_columns(state)
        self.gain = nomoto.gain
        self.time_constant = nomoto.time
        self.speed = nomoto.speed
        self.limit = limit
        self.rate = math.inf if rate is None else rate

    def set_step(self, dt: float) -> None:
        super().set_step(dt)
        # finite without a rate limit, because infinity gives gradients that are not a number
        self.max_rudder_step = min(self.rate * dt, 2.0 * self.limit)

    @abstractmethod
    def memory_ranges(
        self, max_yaw_rate: float, max_rudder: float
    ) -> dict[str, tuple[float, float]]:
        """Return the plausible range (lower, upper) of each entry of the memory by name.

        An export resets a memory that leaves these ranges; they include a margin for rounding.

        Args:
            max_yaw_rate: largest measured yaw rate in rad/s.
            max_rudder: largest rudder angle in rad; relative to the rudder angle of the course in
                path following.
        """

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return the structure of the policy, which exports store in their model card."""


@final
class OddGRUCell(nn.Module):
    """A gated recurrent unit that is an odd function of its features and memory.

    The gates depend on absolute values and are even; the candidate has no bias and is odd (gates:
    K. Cho and others, 2014). For a time step other than in training the update gate is rescaled so
    that the memory changes at the same rate per second.

    Args:
        features: number of features.
        units: number of units.
        dt: time step in s at which the network is trained.
        hidden: units of an odd layer before the output; 0 for no layer.
    """

    def __init__(self, features: int, units: int, dt: float, hidden: int = 0) -> None:
        super().__init__()
        n_joint = features + units
        self.gates = nn.Linear(n_joint, 2 * units)
        self.candidate = nn.Linear(n_joint, units, bias=False)
        self.hidden = nn.Linear(n_joint, hidden, bias=False) if hidden > 0 else None
        self.out = nn.Linear(n_joint + hidden, 1, bias=False)
        nn.init.normal_(self.gates.weight, std=1.0 / math.sqrt(n_joint))
        nn.init.zeros_(self.gates.bias)
        nn.init.normal_(self.candidate.weight, std=1.0 / math.sqrt(n_joint))
        # a zero output at first, so that training starts from the control law alone
        nn.init.zeros_(self.out.weight)
        self.units = units
        self.training_time_step = dt

    def forward(self, features: Tensor, memory: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Return the output [B, 1] and the memory [B, units] after a step of dt seconds."""
        # gates of absolute values do not change under a reflection, so that the cell is odd
        magnitudes = torch.cat((features, memory), dim=1).abs()
        update, reset = torch.sigmoid(self.gates(magnitudes)).chunk(2, dim=1)
        retention = (1.0 - update).clamp(min=1e-6)
        if dt != self.training_time_step:
            # exponential decay: n steps of dt retain as much as one step of n dt
            retention = retention.pow(dt / self.training_time_step)
        candidate = torch.tanh(self.candidate(torch.cat((features, reset * memory), dim=1)))
        memory = candidate + retention * (memory - candidate)
        output_features = torch.cat((features, memory), dim=1)
        if self.hidden is not None:
            output_features = torch.cat(
                (output_features, torch.tanh(self.hidden(output_features))), dim=1
            )
        output: Tensor = self.out(output_features)
        return output, memory


OBSERVER_CONSTANTS = ("heading_rate", "yaw_rate_rate", "push_rate", "cross_rate")
"""Keys of the observer gains in configs and stored policies, in the order of `ObserverGains`."""


class ObserverGains(NamedTuple):
    """Gains of the observer, [1] or [B, 1] each.

    Attributes:
        heading: gain from the heading innovation to the heading in 1/s.
        yaw_rate: gain from the yaw-rate innovation to the yaw rate in 1/s.
        disturbance: gain from the yaw-rate innovation to the disturbance in 1/s.
        heading_to_yaw_rate: gain from the heading innovation to the yaw rate in 1/s^2.
    """

    heading: Tensor
    yaw_rate: Tensor
    disturbance: Tensor
    heading_to_yaw_rate: Tensor


_MAX_INNOVATION = 0.35
"""Heading innovation in rad above which the observer is reset to the measurement."""


class ObserverEstimate(NamedTuple):
    """Estimate of the observer at a time step, each [B, 1], SI.

    Attributes:
        heading, r: estimated heading and yaw rate.
        disturbance_rudder: estimated yaw disturbance d, the rudder angle that would cause it.
        predicted_heading, predicted_r: prediction for the time when all pending commands act.
        heading_innovation, r_innovation: measurement minus one-step prediction.
    """

    heading: Tensor
    r: Tensor
    disturbance_rudder: Tensor
    predicted_heading: Tensor
    predicted_r: Tensor
    heading_innovation: Tensor
    r_innovation: Tensor


@final
class HeadingObserver(nn.Module):
    """Luenberger observer of T r_dot + r = K (delta + d - c psi) with a dead-time predictor.

    d is a yaw disturbance, assumed constant, as a rudder angle. A command acts after `lag` seconds;
    the predictor adds the effect of the pending commands in closed form (Smith predictor). K is
    proportional to the speed, T inversely proportional; the restoring coefficient c, which is zero
    except for a dive angle, decreases with the square of the speed. After a large innovation the
    observer is reset to the measurement.

    Args:
        nomoto: K, T, c and speed of the vessel on a straight course.
        limit: largest disturbance in rad.
        lag: dead time in s between a command and the rudder; 0 for no predictor.
        dt: time step in s.
    """

    def __init__(self, nomoto: NomotoModel, limit: float, lag: float, dt: float) -> None:
        super().__init__()
        self.gain = nomoto.gain
        self.time_constant = nomoto.time
        self.restoring = nomoto.restoring
        self.limit = limit
        self.lag = lag
        self.max_innovation = _MAX_INNOVATION
        self.dt = dt
        self.n_pending = round(lag / dt)
        self.register_buffer("remaining_lag", torch.zeros(0), persistent=False)
        self.remaining_lag: Tensor
        self.set_step(dt)

    def set_step(self, dt: float) -> None:
        """Set the time step to dt seconds."""
        self.dt = dt
        self.n_pending = round(self.lag / dt)
        # remaining dead time in s after each pending command has acted, the oldest first
        remaining = dt * torch.arange(self.n_pending - 1, -1, -1, dtype=torch.float64)
        self.remaining_lag = remaining.to(self.remaining_lag.dtype)

    def forward(
        self,
        psi: Tensor,
        r: Tensor,
        heading: Tensor,
        yaw_rate: Tensor,
        disturbance: Tensor,
        pending: Tensor,
        ratio: Tensor,
        gains: ObserverGains,
    ) -> ObserverEstimate:
        """Update the estimate with a measurement.

        Args:
            psi, r: measured heading and yaw rate [B, 1].
            heading, yaw_rate, disturbance: one-step predictions [B, 1].
            pending: pending rudder angles [B, n_pending], the oldest first.
            ratio: speed [B, 1] divided by the speed that K and T refer to.
            gains: gains of the observer.
        """
        heading_innovation = wrap_angle(psi - heading)
        r_innovation = r - yaw_rate
        # no vessel moves this far in one step: measurements were missing. Heading and yaw rate are
        # reset to the measurement, and the disturbance is not changed.
        max_yaw_rate = 3.0 * self.gain * ratio * self.limit
        is_lost = (heading_innovation.abs() > self.max_innovation) | (
            r_innovation.abs() > max_yaw_rate
        )
        heading = torch.where(is_lost, psi, heading)
        yaw_rate = torch.where(is_lost, r, yaw_rate)
        zero_innovation = torch.zeros_like(r_innovation)
        heading_innovation = torch.where(is_lost, zero_innovation, heading_innovation)
        r_innovation = torch.where(is_lost, zero_innovation, r_innovation)
        # exact gains of a first-order filter, below one for any time step
        heading_gain = 1.0 - torch.exp(-self.dt * gains.heading)
        yaw_rate_gain = 1.0 - torch.exp(-self.dt * gains.yaw_rate)
        yaw_rate_correction = (
            yaw_rate_gain * r_innovation + self.dt * gains.heading_to_yaw_rate * heading_innovation
        )
        heading = heading + heading_gain * heading_innovation
        yaw_rate = yaw_rate + yaw_rate_correction
        # from T r_dot = K d with K ~ speed and T ~ 1 / speed
        rudder_per_yaw_acceleration = self.time_constant / (self.gain * ratio.square())
        disturbance_correction = (
            gains.disturbance * rudder_per_yaw_acceleration * yaw_rate_correction
        )
        disturbance = (disturbance + disturbance_correction).clamp(-self.limit, self.limit)
        predicted_heading = heading
        predicted_r = yaw_rate
        if self.n_pending > 0:
            effective_disturbance = self.with_restoring(disturbance, heading, ratio)
            predicted_heading, predicted_r = self._predict_pending(
                heading, yaw_rate, effective_disturbance, pending, ratio
            )
        return ObserverEstimate(
            heading,
            yaw_rate,
            disturbance,
            predicted_heading,
            predicted_r,
            heading_innovation,
            r_innovation,
        )

    def with_restoring(self, disturbance: Tensor, heading: Tensor, ratio: Tensor) -> Tensor:
        """Add the restoring moment to the disturbance [B, 1], both as rudder angles in rad."""
        return (
            disturbance
            if self.restoring == 0.0
            else disturbance - self.restoring / ratio.square() * heading
        )

    def _predict_pending(
        self, heading: Tensor, r: Tensor, disturbance: Tensor, pending: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Predict heading and yaw rate [B, 1] for the time when all pending commands have acted."""
        time_constant = self.time_constant / ratio
        # each pending command acts for one step, then its effect decays until the end of the dead
        # time
        step_response = 1.0 - torch.exp(-self.dt / time_constant)
        remaining_decay = torch.exp(-self.remaining_lag / time_constant)
        steady_rates = self.gain * ratio * (pending + disturbance)
        lag = self.dt * self.n_pending
        lag_decay = torch.exp(-lag / time_constant)
        predicted_r = lag_decay * r + (steady_rates * step_response * remaining_decay).sum(
            1, keepdim=True
        )
        heading_change = (
            steady_rates * (self.dt - time_constant * step_response * remaining_decay)
        ).sum(1, keepdim=True)
        return heading + time_constant * (1.0 - lag_decay) * r + heading_change, predicted_r

    def predict_step(
        self, heading: Tensor, r: Tensor, disturbance: Tensor, rudder: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Predict heading in [-pi, pi) and yaw rate [B, 1] after one step at a rudder angle."""
        time_constant = self.time_constant / ratio
        steady_rate = self.gain * ratio * (rudder + disturbance)
        rate_change = (1.0 - torch.exp(-self.dt / time_constant)) * (steady_rate - r)
        return wrap_angle(
            heading + self.dt * steady_rate - time_constant * rate_change
        ), r + rate_change


OBSERVER_MEMORY = ("heading", "yaw_rate", "push", "rudder", "last_command")
"""First entries of the memory of an `ObserverPolicy`: predicted heading, yaw rate and disturbance
(`push`), rudder angle and last command. Pending commands and network units follow.
"""
_ROUNDING_MARGIN = 1.001
"""Factor of the bounds of a memory that allows for rounding errors."""
_N_FEATURES = 11
"""Number of features of the network, see `ObserverPolicy.forward`."""
_RADIANS_PER_DEGREE = math.pi / 180.0


@final
class ObserverPolicy(SteeringPolicy):
    """Heading policy with a disturbance observer, a control law and a recurrent residual network.

    The command is limit * clamp(law + network - d / limit, -1, 1), in which law and network are
    fractions of the rudder limit. An observer estimates heading, yaw rate and disturbance d, and
    predicts them over the dead time. The law acts on the prediction. Subtracting d, which includes
    the restoring moment of a dive angle, is a feed-forward compensation. The network is odd, so
    that port and starboard are treated symmetrically, and its initial output is zero.

    Memory s [B, 5 + n_pending + units]: `OBSERVER_MEMORY` in rad and rad/s, pending rudder angles
    with the oldest first, and the units of the network.

    Args:
        state: names of the state.
        nomoto: K, T and speed of the vessel on a straight course.
        law: control law.
        constants: constants of the law and `OBSERVER_CONSTANTS`, all positive.
        limit: rudder limit in rad.
        dt: time step in s; `set_step` changes it.
        rate: rudder rate in rad/s; None for a rudder without a rate limit.
        lag: dead time in s between a command and the rudder; 0 for no predictor.
        units: units of the network; 0 for no network.
        training_time_step: time step of training in s.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        nomoto: NomotoModel,
        law: HeadingLaw,
        constants: Mapping[str, float | Tensor],
        limit: float,
        dt: float,
        rate: float | None = None,
        lag: float = 0.0,
        units: int = 0,
        training_time_step: float = 0.04,
    ) -> None:
        super().__init__(state, nomoto, limit, rate)
        self.units = units
        self.radians_per_degree = _RADIANS_PER_DEGREE
        self.law = law
        self.observer = HeadingObserver(nomoto, limit, lag, dt)
        self.constant_names = (*law.constants, *OBSERVER_CONSTANTS)
        self.n_law_constants = len(law.constants)
        self.n_observer_entries = len(OBSERVER_MEMORY)
        values = [
            torch.as_tensor(constants[name], dtype=torch.float32) for name in self.constant_names
        ]
        self.constants = torch.nn.Parameter(torch.stack(values, dim=-1).log())
        self.network = OddGRUCell(_N_FEATURES, max(units, 1), training_time_step).requires_grad_(
            units > 0
        )
        self.training_time_step = training_time_step
        self.set_step(dt)

    def set_step(self, dt: float) -> None:
        super().set_step(dt)
        self.observer.set_step(dt)
        self.n_state = len(OBSERVER_MEMORY) + self.observer.n_pending + self.units

    def without_network(self) -> ObserverPolicy:
        """Return a copy whose network output is zero: observer and law with trained constants."""
        policy = copy.deepcopy(self)
        torch.nn.init.zeros_(policy.network.out.weight)
        return policy

    def constant_values(self) -> dict[str, float]:
        """Return the constants of the law by name; the parameters are their logarithms."""
        constants = torch.exp(self.constants.detach()).tolist()
        return dict(zip(self.constant_names, constants, strict=True))

    def replace_rudder_in_memory(self, s: Tensor, rudder: Tensor) -> Tensor:
        pending_end = self.n_observer_entries + self.observer.n_pending
        parts = (s[:, :3], rudder, s[:, 4:pending_end])
        if self.observer.n_pending > 0:
            parts = (s[:, :3], rudder, torch.cat((s[:, 4 : pending_end - 1], rudder), dim=1))
        return torch.cat((parts[0], parts[1], parts[2], s[:, pending_end:]), dim=1)

    def memory_ranges(
        self, max_yaw_rate: float, max_rudder: float
    ) -> dict[str, tuple[float, float]]:
        disturbance = _ROUNDING_MARGIN * self.limit
        max_pending = _ROUNDING_MARGIN * max_rudder
        half_turn = _ROUNDING_MARGIN * math.pi
        upper_limits = dict(
            zip(
                OBSERVER_MEMORY,
                (half_turn, 3.0 * max_yaw_rate, disturbance, max_pending, max_pending),
                strict=True,
            )
        )
        upper_limits |= {f"pending_{k}": max_pending for k in range(self.observer.n_pending)}
        upper_limits |= {f"unit_{k}": _ROUNDING_MARGIN for k in range(self.units)}
        return {name: (-upper, upper) for name, upper in upper_limits.items()}

    def describe(self) -> dict[str, Any]:
        """Return constants of law and observer, dead time of the predictor and network units."""
        return {
            "kind": "observed",
            "constants": self.constant_values(),
            "lag": self.observer.lag,
            "units": self.units,
            "trained_at": self.training_time_step,
        }

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the initial memory: measured heading and yaw rate, rudder amidships."""
        heading = wrap_angle(x[:, self.psi_column : self.psi_column + 1])
        zero_memory = torch.zeros(x.shape[0], self.n_state - 2, dtype=x.dtype)
        return torch.cat((heading, x[:, self.r_column : self.r_column + 1], zero_memory), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        n_observer_entries = self.n_observer_entries
        n_pending = self.observer.n_pending
        rudder = s[:, 3:4]
        last_command = s[:, 4:5]
        pending = s[:, n_observer_entries : n_observer_entries + n_pending]
        constants = list(torch.exp(self.constants).split(1, dim=-1))
        ratio = (x[:, self.u_column : self.u_column + 1] / self.speed).clamp(0.3, 3.0)
        psi = x[:, self.psi_column : self.psi_column + 1]
        estimate = self.observer(
            psi,
            x[:, self.r_column : self.r_column + 1],
            s[:, 0:1],
            s[:, 1:2],
            s[:, 2:3],
            pending,
            ratio,
            ObserverGains(*constants[self.n_law_constants :]),
        )
        error = wrap_angle(reference - estimate.predicted_heading)
        inverse_time_constant = ratio / self.time_constant
        max_yaw_acceleration = inverse_time_constant * self.gain * ratio * self.limit
        effective_disturbance = self.observer.with_restoring(
            estimate.disturbance_rudder, estimate.predicted_heading, ratio
        )
        normalised_rudder = (rudder + effective_disturbance) / self.limit
        law_input = HeadingLawInput(
            error,
            estimate.predicted_r,
            normalised_rudder,
            max_yaw_acceleration,
            inverse_time_constant,
        )
        law_output = self.law(law_input, constants[: self.n_law_constants])
        law_output = law_output - effective_disturbance / self.limit
        memory = s[:, n_observer_entries + n_pending :]
        unsaturated_command = law_output
        if self.units > 0:
            max_yaw_rate = self.gain * ratio * self.limit
            # innovations of white noise grow with 1 / sqrt(dt), and features must have the same
            # size as in training
            noise_scale = math.sqrt(self.dt / self.training_time_step)
            # constant factors scale the features to a similar magnitude in typical manoeuvres
            features = torch.cat(
                (
                    # several scales of the error: saturated ones resolve small errors, the linear
                    # one large ones
                    torch.tanh(wrap_angle(reference - psi) / self.radians_per_degree),
                    torch.tanh(error / self.radians_per_degree),
                    torch.tanh(error / (5.0 * self.radians_per_degree)),
                    error / (30.0 * self.radians_per_degree),
                    1.7 * estimate.predicted_r / max_yaw_rate,
                    torch.tanh(17.0 * estimate.predicted_r / max_yaw_rate),
                    5.0 * estimate.disturbance_rudder / self.limit,
                    (3.0 * noise_scale / self.radians_per_degree) * estimate.heading_innovation,
                    (52.0 * noise_scale) * estimate.r_innovation / max_yaw_rate,
                    last_command / self.limit,
                    torch.tanh(law_output),
                ),
                dim=1,
            )
            correction, memory = self.network(features, memory, self.dt)
            unsaturated_command = law_output + correction
        command = self.limit * unsaturated_command.clamp(-1.0, 1.0)
        next_rudder = rudder + (command - rudder).clamp(-self.max_rudder_step, self.max_rudder_step)
        queue = torch.cat((pending, next_rudder), dim=1)
        effective_disturbance = self.observer.with_restoring(
            estimate.disturbance_rudder, estimate.heading, ratio
        )
        heading, yaw_rate = self.observer.predict_step(
            estimate.heading, estimate.r, effective_disturbance, queue[:, 0:1], ratio
        )
        s = torch.cat(
            (
                heading,
                yaw_rate,
                estimate.disturbance_rudder,
                next_rudder,
                command,
                queue[:, 1:],
                memory,
            ),
            dim=1,
        )
        return command, s


@final
class NetworkPolicy(SteeringPolicy):
    """Heading policy that is a recurrent network alone: the command is clamp(limit network).

    The network is a gated recurrent unit followed by an odd layer, so that port and starboard are
    treated symmetrically. Its features are heading error, yaw rate, rudder angle and last command,
    scaled by K and speed of the vessel. Its initial output is zero (rudder amidships).

    Memory s [B, 2 + units]: rudder and last command in rad, then the units of the network.

    Args:
        state: names of the state.
        nomoto: K, T and speed of the vessel on a straight course.
        limit: rudder limit in rad.
        dt: time step in s; `set_step` changes it.
        rate: rudder rate in rad/s; None for a rudder without a rate limit.
        units: units of the network, at least one.
        training_time_step: time step of training in s.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        nomoto: NomotoModel,
        limit: float,
        dt: float,
        rate: float | None = None,
        units: int,
        training_time_step: float = 0.04,
    ) -> None:
        super().__init__(state, nomoto, limit, rate)
        self.units = units
        self.radians_per_degree = _RADIANS_PER_DEGREE
        self.training_time_step = training_time_step
        self.network = OddGRUCell(8, units, training_time_step, hidden=units)
        self.n_state = 2 + units
        self.set_step(dt)

    def constant_values(self) -> dict[str, float]:
        """Return an empty mapping, because the policy has no control law."""
        return {}

    def replace_rudder_in_memory(self, s: Tensor, rudder: Tensor) -> Tensor:
        return torch.cat((rudder, s[:, 1:]), dim=1)

    def memory_ranges(
        self, max_yaw_rate: float, max_rudder: float
    ) -> dict[str, tuple[float, float]]:
        upper_limits = dict.fromkeys(("rudder", "last_command"), _ROUNDING_MARGIN * max_rudder)
        upper_limits |= {f"unit_{k}": _ROUNDING_MARGIN for k in range(self.units)}
        return {name: (-upper, upper) for name, upper in upper_limits.items()}

    def describe(self) -> dict[str, Any]:
        """Return the units of the network and the time step of its training."""
        return {"kind": "network", "units": self.units, "trained_at": self.training_time_step}

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        rudder = s[:, 0:1]
        last_command = s[:, 1:2]
        memory = s[:, 2:]
        ratio = (x[:, self.u_column : self.u_column + 1] / self.speed).clamp(0.3, 3.0)
        error = (
            wrap_angle(reference - x[:, self.psi_column : self.psi_column + 1])
            / self.radians_per_degree
        )
        relative_yaw_rate = x[:, self.r_column : self.r_column + 1] / (
            self.gain * ratio * self.limit
        )
        features = torch.cat(
            (
                torch.tanh(error),
                torch.tanh(error / 5.0),
                torch.tanh(error / 20.0),
                error / 30.0,
                1.7 * relative_yaw_rate,
                torch.tanh(17.0 * relative_yaw_rate),
                rudder / self.limit,
                last_command / self.limit,
            ),
            dim=1,
        )
        unsaturated_command, memory = self.network(features, memory, self.dt)
        command = self.limit * unsaturated_command.clamp(-1.0, 1.0)
        next_rudder = rudder + (command - rudder).clamp(-self.max_rudder_step, self.max_rudder_step)
        return command, torch.cat((next_rudder, command, memory), dim=1)


LOS_CONSTANTS = ("lookahead", "depth_rate", "drift_rate")
"""Keys of the constants of line-of-sight (LOS) depth control: look-ahead distance in m, and
observer gains of depth and drift in 1/s.
"""
MAX_DEPTH = 1.2e4
"""Largest accepted depth in m; no sea is deeper."""
_MAX_DRIFT_SHARE = 0.5
"""Largest vertical drift as a fraction of the speed."""


@final
class DepthPolicy(RenamedStateModule, SteeringPolicy):
    """Depth policy with stern planes: line-of-sight guidance and an inner loop on the dive angle.

    The desired dive angle is atan((z_d - z) / lookahead) - d / u, limited to `steepest` (line of
    sight: T. I. Fossen, Handbook of Marine Craft, 2nd ed. 2021, section 12.4). An observer of
    z_dot = u sin(dive angle) + d estimates depth z and drift d, which contains the effects of
    buoyancy and angle of attack. The inner policy receives the dive angle -theta as heading and -q
    as yaw rate.

    Memory s [B, 2 + k]: predicted depth in m, d in m/s, then the k entries of the inner policy.

    Args:
        state: names of the state.
        nomoto: Nomoto's model of the dive angle and the speed that it refers to.
        law: policy of the dive angle, the inner loop.
        constants: `LOS_CONSTANTS`, all positive.
        steepest: largest desired dive angle in rad.
        limit: limit of the stern planes in rad.
        dt: time step in s.
        rate: rate of the stern planes in rad/s; None for no rate limit.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"law": "inner_policy"}
    axis = DEPTH
    measured: ClassVar[Mapping[str, str]] = {"z": "m", "u": "m/s", "theta": "rad", "q": "rad/s"}

    def __init__(
        self,
        state: Sequence[str],
        *,
        nomoto: NomotoModel,
        law: AnglePolicy,
        constants: Mapping[str, float | Tensor],
        steepest: float,
        limit: float,
        dt: float,
        rate: float | None = None,
    ) -> None:
        super().__init__(state, nomoto, limit, rate)
        self.inner_policy = law
        self.steepest = steepest
        self.max_drift_share = _MAX_DRIFT_SHARE
        law.set_state_columns(tuple(SteeringPolicy.measured))
        values = [torch.as_tensor(constants[name], dtype=torch.float32) for name in LOS_CONSTANTS]
        self.constants = torch.nn.Parameter(torch.stack(values, dim=-1).log())
        self.set_step(dt)

    def set_state_columns(self, state: Sequence[str]) -> None:
        """Set the columns of depth, speed, pitch and pitch rate for a state with these names."""
        self.state_columns = [state.index(name) for name in self.measured]

    def set_step(self, dt: float) -> None:
        super().set_step(dt)
        self.inner_policy.set_step(dt)
        self.n_state = 2 + self.inner_policy.n_state

    def without_network(self) -> DepthPolicy:
        """Return a copy whose inner policy has a network output of zero."""
        policy = copy.deepcopy(self)
        inner_policy = self.inner_policy
        assert isinstance(inner_policy, ObserverPolicy)
        policy.inner_policy = inner_policy.without_network()
        return policy

    def constant_values(self) -> dict[str, float]:
        """Return the constants by name, including those of an inner policy with an observer."""
        constants = dict(
            zip(LOS_CONSTANTS, torch.exp(self.constants.detach()).tolist(), strict=True)
        )
        return constants | (
            self.inner_policy.constant_values()
            if isinstance(self.inner_policy, ObserverPolicy)
            else {}
        )

    def memory_ranges(
        self, max_yaw_rate: float, max_rudder: float
    ) -> dict[str, tuple[float, float]]:
        assert isinstance(self.inner_policy, SteeringPolicy)
        # the drift is limited at a speed of at most three times the nominal speed
        max_drift = 3.1 * self.max_drift_share * self.speed
        depth_ranges = {
            "depth": (-1.01 * MAX_DEPTH, 1.01 * MAX_DEPTH),
            "drift": (-max_drift, max_drift),
        }
        return depth_ranges | self.inner_policy.memory_ranges(max_yaw_rate, max_rudder)

    def describe(self) -> dict[str, Any]:
        """Return constants, largest dive angle and the description of the inner policy."""
        assert isinstance(self.inner_policy, SteeringPolicy)
        return {
            "kind": "depth",
            "constants": dict(
                zip(LOS_CONSTANTS, torch.exp(self.constants.detach()).tolist(), strict=True)
            ),
            "steepest": self.steepest,
            "law": self.inner_policy.describe(),
        }

    def replace_rudder_in_memory(self, s: Tensor, rudder: Tensor) -> Tensor:
        return torch.cat(
            (s[:, :2], self.inner_policy.replace_rudder_in_memory(s[:, 2:], rudder)), dim=1
        )

    def _to_angle_state(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the depth [B, 1], and dive angle, speed and dive rate [B, 3] as a state."""
        z, u, theta, q = x[:, self.state_columns].split(1, dim=1)
        return z, torch.cat((-theta, u, -q), dim=1)

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the initial memory: measured depth, no drift."""
        z, angle_state = self._to_angle_state(x)
        return torch.cat(
            (z, torch.zeros_like(z), self.inner_policy.initial_state(angle_state)), dim=-1
        )

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        z, angle_state = self._to_angle_state(x)
        lookahead, depth_gain, drift_gain = torch.exp(self.constants).split(1, dim=-1)
        u = angle_state[:, 1:2].clamp(0.3 * self.speed, 3.0 * self.speed)
        innovation = z - s[:, 0:1]
        # no vessel moves this far in one step: the depth is reset, the drift is not changed
        innovation = torch.where(innovation.abs() > u, torch.zeros_like(z), innovation)
        predicted_depth = z - innovation
        depth = predicted_depth + (1.0 - torch.exp(-self.dt * depth_gain)) * innovation
        max_drift = self.max_drift_share * u
        drift = s[:, 1:2] + (self.dt * depth_gain * drift_gain) * innovation
        drift = torch.minimum(torch.maximum(drift, -max_drift), max_drift)
        target_angle = torch.atan((reference - depth) / lookahead) - drift / u
        target_angle = target_angle.clamp(-self.steepest, self.steepest)
        command, memory = self.inner_policy(angle_state, target_angle, s[:, 2:])
        next_depth = depth + self.dt * (u * torch.sin(angle_state[:, 0:1]) + drift)
        return command, torch.cat((next_depth, drift, memory), dim=1)

"""Vessels whose every row steers a little differently, to train and compare controllers on."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.core.columns import actuator_states, pose_and_dynamic_states
from residnet.core.errors import ConfigError
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.physics.plant import Plant
from residnet.physics.symmetry import get_dof


class Axis(NamedTuple):
    """What a controller steers, and by what.

    Attributes:
        name: of the axis.
        command: input that steers, an angle in rad.
        gear: state that follows the command, where the vessel has one.
        slowed: velocities that the `time` of a variation slows down.
        value: state that the reference is of; heading [rad] or depth [m].
        angle, rate: states that the command turns, in rad and rad/s.
        side: sign of the angle under a positive command.
    """

    name: str
    command: str
    gear: str
    slowed: tuple[str, str]
    value: str
    angle: str
    rate: str
    side: float

    @property
    def measured(self) -> tuple[str, ...]:
        """The states that noise is added to: value, angle and rate."""
        return tuple(dict.fromkeys((self.value, self.angle, self.rate)))


HEADING = Axis("heading", "cmd_delta", "delta", ("v", "r"), "psi", "psi", "r", 1.0)
DEPTH = Axis("depth", "cmd_delta_s", "delta_s", ("w", "q"), "z", "theta", "q", -1.0)
VARIATION = ("effect", "time", "bias")
"""Of each row: rudder force as a multiple, time constants of sway and yaw (heave and pitch) as a
multiple, and an angle [rad] that is added to the rudder's.
"""


class Vessels(NamedTuple):
    """The variation of B vessels and the current that each runs in.

    Attributes:
        variation: of the steering, [B, 3], see `VARIATION`.
        current: to the north and to the east, [B, 2] in m/s.
    """

    variation: Tensor
    current: Tensor


NOMINAL = Vessels(
    torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
)
"""The vessel that the course is planned with, in water at rest."""


@final
class VariedPlant(Dynamics):
    """A plant of which each row has its own rudder effect, time constants and rudder bias.

    It is stepped by RK4, with held actuators where these stand still within a step.

    Its memory s [B, 3] is the variation, constant over a rollout: rows of ones and a zero bias are
    the plant itself. With Nomoto's model of first order, T r_dot + r = K delta, `effect` multiplies
    K and `time` multiplies T; with other hulls `effect` multiplies the rudder angle that the water
    feels, and `time` divides the accelerations in sway and yaw.

    On another axis than the heading the rudder is what steers there: for the depth the stern
    planes. Its command is the first of the inputs, and those of the plant follow in their order.

    Raises:
        ConfigError: where the vessel has no rudder.
    """

    def __init__(
        self, plant: Plant, dt: float, integrator: str = "rk4", axis: Axis = HEADING
    ) -> None:
        super().__init__(dt, "heun" if integrator == "heun" else "rk4")
        self.plant = plant
        self.n_state = len(VARIATION)
        if axis.command not in plant.input_names[: plant.n_commands]:
            raise ConfigError(
                f"{axis.name} control needs a vessel with the command {axis.command}, found"
                f" {', '.join(plant.input_names[: plant.n_commands])}"
            )
        self.turn_about(plant.attitude_columns, len(plant.state_names))
        first = plant.input_names.index(axis.command)
        places = range(len(plant.input_names))
        self.take = [0 if k == first else k + 1 if k < first else k for k in places]
        self.rudder = plant.state_names.index(axis.gear) if axis.gear in plant.state_names else -1
        slowed = torch.tensor([1.0 if name in axis.slowed else 0.0 for name in plant.state_names])
        self.slowed = nn.Buffer(slowed, persistent=False)
        gear = torch.tensor([1.0 if "delta" in name else 0.0 for name in plant.state_names])
        self.gear = nn.Buffer(gear, persistent=False)
        x, w = (
            plant.make_initial_state(1),
            torch.zeros(1, len(plant.input_names), dtype=torch.float64),
        )
        w[:, first] = 0.1
        # a rudder with a lag moves within a step
        self.moving = self.rudder >= 0 and bool(plant.derivative(x, w)[0, self.rudder] != 0)

    def initial_state(self, batch: int) -> Tensor:
        return torch.tensor([1.0, 1.0, 0.0]).expand(batch, 3)

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of a rudder whose effect is varied.

        rho [B, 3] holds what multiplies the rudder's angle, what is added to it, and 1/time - 1.
        """
        slower = 1.0 + self.slowed.to(x.dtype) * rho[:, 2:]
        if self.rudder < 0:
            rate: Tensor = self.plant.derivative_prepared(x, p) * slower
            return rate
        angle = x[:, self.rudder : self.rudder + 1] * rho[:, :1] + rho[:, 1:2]
        felt = self._felt(x, angle)
        if not self.moving:
            held: Tensor = self.plant.derivative_prepared(felt, p) * slower
            return held
        hull = self.plant.derivative(felt, p) * slower
        # the steering gear knows its own angle
        own = self.plant.derivative(x, p)
        gear = self.gear.to(x.dtype)
        return hull * (1.0 - gear) + own * gear

    def _felt(self, x: Tensor, angle: Tensor) -> Tensor:
        if self.rudder < 0:
            return x
        return torch.cat((x[:, : self.rudder], angle, x[:, self.rudder + 1 :]), dim=-1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        varied = torch.cat((s[:, :1], s[:, 2:3], 1.0 / s[:, 1:2] - 1.0), dim=-1)
        ordered = w[:, self.take]
        if self.moving:
            p = self.plant.prepare(x, ordered)
        else:
            angle = (x[:, self.rudder : self.rudder + 1] if self.rudder >= 0 else w[:, :1]) * s[
                :, :1
            ] + s[:, 2:]
            held = torch.cat((angle, w[:, 1:]), dim=-1)[:, self.take]
            p = self.plant.prepare(self._felt(x, angle), held)
        return self.plant.finish_step(self.integrate(x, p, varied), ordered, self.dt), s


@final
class VariedModel(Dynamics):
    """A learned hull behind a rudder with a rate or a lag, each row with its own variation.

    State x [B, 3 + n or one more]: that of the model, and the rudder angle where it has either.
    Memory s [B, 3 + k]: the variation, then the head's. `effect` multiplies the rudder angle that
    the model is given, `time` divides what a step changes in the velocities that the axis names.

    Args:
        model: of the hull.
        dt: step in s.
        take: for each input of the model its column of w; the rudder's command is the first of w.
        mean: whether the model's inputs are means over the step.
        rate: of the rudder in rad/s; None where it has none.
        lag: time constant in s with which the rudder follows; None where it has none.
        axis: that is steered.

    Raises:
        ConfigError: where the model has a memory and steps of another length.
    """

    def __init__(
        self,
        model: HybridDynamics,
        dt: float,
        take: Sequence[int],
        mean: bool,
        rate: float | None,
        lag: float | None = None,
        axis: Axis = HEADING,
    ) -> None:
        super().__init__(dt, model.integrator)
        states = get_dof(model.signals.names).state_names
        slowed = torch.tensor([name in axis.slowed for name in states])
        self.slowed = nn.Buffer(slowed, persistent=False)
        if model.n_state > 0 and not math.isclose(model.dt, dt, rel_tol=1e-9):
            raise ConfigError(
                f"the learned model has a memory and steps of {model.dt:g} s; give the policy's"
                f" training this dt, not {dt:g} s"
            )
        # one for each precision: policies are trained in single and flown in double
        self.models = tuple(
            copy.deepcopy(model).to(dtype).eval().requires_grad_(False)
            for dtype in (torch.float32, torch.float64)
        )
        for model_at_precision in self.models:
            model_at_precision.dt = dt
        self.n_state = len(VARIATION) + model.n_state
        self.dof, self.rolls = model.dof, model.rolls
        self.take, self.mean = list(take), mean
        self.travel = None if rate is None else rate * dt
        self.share = None if lag is None else 1.0 - math.exp(-dt / lag)
        self.geared = rate is not None or lag is not None

    def initial_state(self, batch: int) -> Tensor:
        return torch.tensor([1.0, 1.0] + [0.0] * (self.n_state - 2)).expand(batch, -1)

    def _of(self, x: Tensor) -> HybridDynamics:
        return self.models[1 if x.dtype == torch.float64 else 0]

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        command, angle = w[:, :1], actuator_states(x, self.dof)
        angle_before, angle_after = (angle, angle) if self.geared else (command, command)
        if self.travel is not None:
            angle_after = angle + (command - angle).clamp(-self.travel, self.travel)
        elif self.share is not None:
            angle_after = angle + self.share * (command - angle)
        held = 0.5 * (angle_before + angle_after) if self.mean else angle_before
        effect, time_share, bias = s[:, : len(VARIATION)].split(1, dim=1)
        effective = effect * held + bias
        given = torch.cat((effective, w[:, 1:]), dim=1)[:, self.take]
        own = pose_and_dynamic_states(x, self.dof)
        moved, memory = self._of(x).step(own, given, s[:, len(VARIATION) :])
        parts = [torch.where(self.slowed, own + (moved - own) / time_share, moved)]
        parts += [angle_after] if self.geared else []
        return torch.cat(parts, dim=1), torch.cat((s[:, : len(VARIATION)], memory), dim=1)


@final
class PushedSteering(Dynamics):
    """A varied vessel whose rudder bias changes from step to step.

    Its inputs [B, m + k] are those of the vessel, then the push, an angle [rad] that is added to
    the rudder's beside the constant bias; further columns are left alone.

    Args:
        inner: a varied vessel, whose memory begins with the variation.
        inputs: number m of the vessel's own inputs.
    """

    def __init__(self, inner: Dynamics, inputs: int) -> None:
        super().__init__(inner.dt, inner.integrator)
        self.inner = inner
        self.n_state, self.inputs = inner.n_state, inputs

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        bias = len(VARIATION) - 1
        push = w[:, self.inputs : self.inputs + 1]
        pushed = torch.cat((s[:, :bias], s[:, bias : bias + 1] + push, s[:, bias + 1 :]), dim=1)
        moved, after = self.inner.step(x, w[:, : self.inputs], pushed)
        kept = torch.cat((s[:, : bias + 1], after[:, bias + 1 :]), dim=1)
        return moved, kept

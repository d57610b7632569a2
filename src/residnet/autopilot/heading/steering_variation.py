"""Batches of vessels with random steering properties, to train and compare controllers on."""

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
    """The controlled variable of a steering controller and its actuator.

    Attributes:
        name: name of the axis.
        command: name of the input that steers, an angle in rad.
        gear: name of the state that follows the command, if the vessel has one.
        slowed: velocities whose time constant a variation of the steering scales.
        value: name of the controlled state: heading [rad] or depth [m].
        angle: name of the angle that the command changes, rad.
        rate: name of its angular velocity, rad/s.
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
        """The states to which measurement noise is added: value, angle and rate."""
        return tuple(dict.fromkeys((self.value, self.angle, self.rate)))


HEADING = Axis("heading", "cmd_delta", "delta", ("v", "r"), "psi", "psi", "r", 1.0)
"""Heading controlled by the rudder."""
DEPTH = Axis("depth", "cmd_delta_s", "delta_s", ("w", "q"), "z", "theta", "q", -1.0)
"""Depth controlled by the stern planes; a positive command pitches the bow down."""
VARIATION = ("effect", "time", "bias")
"""Columns of a variation of the steering.

They are a factor of the rudder force, a factor of the time constants of sway and yaw (heave and
pitch), and a constant angle [rad] that is added to the rudder angle.
"""


class Vessels(NamedTuple):
    """The varied steering of B vessels and their ambient currents.

    Attributes:
        variation: variations of the steering [B, 3], see `VARIATION`.
        current: current to the north and to the east [B, 2] in m/s.
    """

    variation: Tensor
    current: Tensor


NOMINAL = Vessels(
    torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
)
"""The nominal vessel, for which courses are planned, without current."""


def require_command(plant: Plant, axis: Axis) -> None:
    """Check that a vessel has the command of an axis.

    Raises:
        ConfigError: if it lacks the command.
    """
    if axis.command not in plant.input_names[: plant.n_commands]:
        raise ConfigError(
            f"{axis.name} control needs a vessel with the command {axis.command}, found"
            f" {', '.join(plant.input_names[: plant.n_commands])}"
        )


@final
class VariedPlant(Dynamics):
    """A plant whose rudder effect, time constants and rudder bias differ from row to row.

    It is integrated with RK4 or Heun's method. Actuators that do not move within a step are held.

    Its memory s [B, 3] is the variation of the steering, constant over a rollout; `effect` = `time`
    = 1 and a zero `bias` are the plant itself. For Nomoto's model of first order, T r_dot + r = K
    delta, `effect` multiplies K and `time` multiplies T; for other hulls `effect` multiplies the
    effective rudder angle, and `time` divides the accelerations in sway and yaw.

    The first input is the command of the axis: the rudder for the heading, the stern planes for the
    depth. The other inputs of the plant follow in their order.

    Raises:
        ConfigError: if the vessel lacks the command of the axis.
    """

    def __init__(
        self, plant: Plant, dt: float, integrator: str = "rk4", axis: Axis = HEADING
    ) -> None:
        super().__init__(dt, "heun" if integrator == "heun" else "rk4")
        self.plant = plant
        self.n_state = len(VARIATION)
        require_command(plant, axis)
        names = plant.state_names
        self.set_attitude_columns(plant.attitude_columns, len(names))

        # columns of w for each input of the plant: the command of the axis is the first of w
        command = plant.input_names.index(axis.command)
        n_inputs = len(plant.input_names)
        others = [k + 1 if k < command else k for k in range(n_inputs)]
        self.input_columns = [0 if k == command else others[k] for k in range(n_inputs)]

        self.rudder = names.index(axis.gear) if axis.gear in names else -1
        # 1 in the columns of the slowed velocities, and of the angles of the steering gear
        slowed = torch.tensor([1.0 if name in axis.slowed else 0.0 for name in names])
        self.slowed = nn.Buffer(slowed, persistent=False)
        gear = torch.tensor([1.0 if "delta" in name else 0.0 for name in names])
        self.gear = nn.Buffer(gear, persistent=False)

        # a rudder with a lag moves within a step
        x = plant.make_initial_state(1)
        w = torch.zeros(1, n_inputs, dtype=torch.float64)
        w[:, command] = 0.1
        self.has_moving_rudder = False
        if self.rudder >= 0:
            self.has_moving_rudder = bool(plant.derivative(x, w)[0, self.rudder] != 0)

    def initial_state(self, batch: int) -> Tensor:
        return torch.tensor([1.0, 1.0, 0.0]).expand(batch, 3)

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of a plant with varied steering.

        Args:
            x: states [B, nx].
            p: prepared inputs, or raw inputs if the rudder moves within a step.
            rho: factor of the rudder angle, angle that is added to it, and 1/time - 1 [B, 3].
        """
        slowing = 1.0 + self.slowed.to(x.dtype) * rho[:, 2:]
        if self.rudder < 0:
            derivative: Tensor = self.plant.derivative_prepared(x, p) * slowing
            return derivative
        angle = x[:, self.rudder : self.rudder + 1] * rho[:, :1] + rho[:, 1:2]
        effective_state = self._with_rudder_angle(x, angle)
        if not self.has_moving_rudder:
            slowed_derivative: Tensor = self.plant.derivative_prepared(effective_state, p) * slowing
            return slowed_derivative
        hull = self.plant.derivative(effective_state, p) * slowing
        # the steering gear follows its actual angle, not the effective one
        actuator = self.plant.derivative(x, p)
        gear = self.gear.to(x.dtype)
        return hull * (1.0 - gear) + actuator * gear

    def _with_rudder_angle(self, x: Tensor, angle: Tensor) -> Tensor:
        if self.rudder < 0:
            return x
        return torch.cat((x[:, : self.rudder], angle, x[:, self.rudder + 1 :]), dim=-1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        effect, time, bias = s.split(1, dim=-1)
        rho = torch.cat((effect, bias, 1.0 / time - 1.0), dim=-1)
        inputs = w[:, self.input_columns]
        if self.has_moving_rudder:
            p = self.plant.prepare(x, inputs)
        else:
            rudder = x[:, self.rudder : self.rudder + 1] if self.rudder >= 0 else w[:, :1]
            angle = rudder * effect + bias
            effective_inputs = torch.cat((angle, w[:, 1:]), dim=-1)[:, self.input_columns]
            p = self.plant.prepare(self._with_rudder_angle(x, angle), effective_inputs)
        return self.plant.finish_step(self.integrate(x, p, rho), inputs, self.dt), s


@final
class VariedModel(Dynamics):
    """A learned hull with a rudder of limited rate or with a lag, varied from row to row.

    The state x [B, 3 + n (+ 1)] is that of the model, followed by the rudder angle if the rudder
    has a rate or a lag. The memory s [B, 3 + k] is the variation of the steering, followed by that
    of the model. `effect` multiplies the rudder angle that the model receives, `time` divides the
    changes of the velocities `axis.slowed` over a step.

    Args:
        model: the hull.
        dt: step in s.
        input_columns: column of w for each input of the model; the rudder's command is the first.
        mean: whether the inputs of the model are means over the step, not values at its start.
        rate: largest rate of the rudder in rad/s; None for no limit.
        lag: time constant of the rudder in s; None for none.
        axis: the controlled axis.

    Raises:
        ConfigError: if the model has a memory and another time step.
    """

    def __init__(
        self,
        model: HybridDynamics,
        dt: float,
        input_columns: Sequence[int],
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
                f"the learned model has a memory and steps of {model.dt:g} s; set dt of the"
                f" policy's"
                f" training to this value instead of {dt:g} s"
            )
        # one for each precision: policies are trained in single and simulated in double precision
        self.models = tuple(
            copy.deepcopy(model).to(dtype).eval().requires_grad_(False)
            for dtype in (torch.float32, torch.float64)
        )
        for model_at_precision in self.models:
            model_at_precision.dt = dt
        self.n_state = len(VARIATION) + model.n_state
        self.dof = model.dof
        self.has_roll = model.has_roll
        self.input_columns = list(input_columns)
        self.has_mean_inputs = mean
        self.max_rudder_change = None if rate is None else rate * dt
        self.lag_gain = None if lag is None else 1.0 - math.exp(-dt / lag)
        self.has_rudder_state = rate is not None or lag is not None

    def initial_state(self, batch: int) -> Tensor:
        return torch.tensor([1.0, 1.0] + [0.0] * (self.n_state - 2)).expand(batch, -1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        command = w[:, :1]
        # without a rate or a lag the rudder follows its command at once
        angle = actuator_states(x, self.dof) if self.has_rudder_state else command
        next_angle = angle
        if self.max_rudder_change is not None:
            change = (command - angle).clamp(-self.max_rudder_change, self.max_rudder_change)
            next_angle = angle + change
        elif self.lag_gain is not None:
            next_angle = angle + self.lag_gain * (command - angle)
        held_angle = 0.5 * (angle + next_angle) if self.has_mean_inputs else angle

        variation = s[:, : len(VARIATION)]
        effect, time, bias = variation.split(1, dim=1)
        effective_angle = effect * held_angle + bias
        inputs = torch.cat((effective_angle, w[:, 1:]), dim=1)[:, self.input_columns]
        hull_state = pose_and_dynamic_states(x, self.dof)
        model = self.models[1 if x.dtype == torch.float64 else 0]
        next_hull, memory = model.step(hull_state, inputs, s[:, len(VARIATION) :])
        slowed_hull = hull_state + (next_hull - hull_state) / time
        parts = [torch.where(self.slowed, slowed_hull, next_hull)]
        if self.has_rudder_state:
            parts.append(next_angle)
        return torch.cat(parts, dim=1), torch.cat((variation, memory), dim=1)


@final
class PushedSteering(Dynamics):
    """A varied vessel whose rudder bias changes from step to step.

    Its inputs [B, m + k] are those of the vessel, followed by the push: an angle [rad] that is
    added to the constant rudder bias. Further columns are ignored.

    Args:
        inner: vessel with varied steering, whose memory begins with that variation.
        n_inputs: number m of the vessel's inputs.
    """

    def __init__(self, inner: Dynamics, n_inputs: int) -> None:
        super().__init__(inner.dt, inner.integrator)
        self.inner = inner
        self.n_state = inner.n_state
        self.n_inputs = n_inputs

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        bias = len(VARIATION) - 1
        push = w[:, self.n_inputs : self.n_inputs + 1]
        pushed = torch.cat((s[:, :bias], s[:, bias : bias + 1] + push, s[:, bias + 1 :]), dim=1)
        next_state, next_memory = self.inner.step(x, w[:, : self.n_inputs], pushed)
        # the push acts for one step: the constant bias stays in the memory
        memory = torch.cat((s[:, : bias + 1], next_memory[:, bias + 1 :]), dim=1)
        return next_state, memory

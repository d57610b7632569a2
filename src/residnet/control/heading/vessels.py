"""Vessels as heading controllers see them: simulated, or a learned model of one."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor

from residnet.control.base import Followed, Policy
from residnet.control.heading.turning import Steered, Turning, measure_turning
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap
from residnet.core.names import nearest
from residnet.dynamics.actuated import commanded
from residnet.dynamics.base import Dynamics
from residnet.dynamics.free_runs import compiled
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.steering_variation import HEADING, Axis, VariedModel, VariedPlant
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.symmetry import live_of

_LONG_STEP = 0.4
"""Longest step in s by which a vessel's answer to its rudder is measured."""
_LEVEL = ("x", "y", "z", "theta", "psi", "v", "w", "p", "q", "r")
"""States that a straight course begins with at zero."""
_RUN_UP = (0.1, 6000)
"""Step in s and steps of the run from rest to the speed of a straight course."""


class SteeredVessel(ABC):
    """A vessel whose first command is the angle that steers: the rudder's, or another axis' own.

    Attributes:
        axis: that is steered.
        state: names of the columns of x.
        inputs: names of the columns of w.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        any_step: whether `model` can be built with steps of any length.
    """

    axis: Axis = HEADING
    state: tuple[str, ...]
    inputs: tuple[str, ...]
    rate: float | None
    any_step: bool = True

    @abstractmethod
    def model(self, dt: float, integrator: str = "rk4") -> Dynamics:
        """Return the steps of dt seconds.

        The first columns of its memory are the variation of each row
        (`dynamics.steering_variation.VARIATION`).
        """

    def memory(self, variation: Tensor) -> Tensor:
        """Return the memory of `model` for variations [B, 3]."""
        return variation

    @abstractmethod
    def start(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states [B, nx] and inputs [B, m] of straight courses.

        `speed` [B] are multiples of the service speed.
        """

    @final
    def column(self, name: str) -> int:
        """Return the column of a state."""
        return self.state.index(name)

    @final
    def turning(self, angle: float, duration: float, dt: float = 0.02) -> Turning:
        """Return K and T at the service speed, from answers to a rudder angle.

        Args:
            angle: of the rudder in rad.
            duration: until the turn is steady, in s.
            dt: step in s; later steps are longer.
        """
        x, w = self.start(torch.ones(1, dtype=torch.float64))
        variation = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
        axis = self.axis
        columns = (self.column("u"), self.column(axis.rate), self.column(axis.angle))
        steps = (dt, max(dt, _LONG_STEP) if self.any_step else dt)
        rate = math.inf if self.rate is None else self.rate
        memory, rights = self.memory(variation), axis.value != axis.angle
        steered = Steered(self.model, x, w, memory, columns, steps, rate, axis.side, rights)
        return measure_turning(steered, angle, duration)


@final
class SteeredPlant(SteeredVessel):
    """A simulated vessel; in calm water, or in the weather [inputs by name] given.

    Raises:
        ConfigError: where nothing steers it on the axis, or it makes no way ahead.
    """

    def __init__(self, plant: Plant, *, calm: bool = True, axis: Axis = HEADING) -> None:
        if calm and isinstance(plant, HullPlant):
            plant = plant.in_calm_water()
        self.plant, self.axis = plant, axis
        others = [name for name in plant.inputs if name != axis.command]
        self.state, self.inputs = plant.state, (axis.command, *others)
        self._straight = plant.approach(1)
        # a propeller heels what turns about all axes
        if plant.attitude or float(self._straight[0, self.column("u")]) == 0.0:
            self._straight = self._run_up()
        self.rate, self.lag = _rudder_gear(plant, axis)

    def model(self, dt: float, integrator: str = "rk4") -> Dynamics:
        return VariedPlant(self.plant, dt, integrator, self.axis)

    def start(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return states and inputs of straight courses; thrust grows with the speed squared."""
        x = self._straight.to(speed.dtype).repeat(len(speed), 1)
        x[:, self.column("u")] *= speed
        command = self.plant.demand(speed.square(), torch.zeros_like(speed))
        given = dict(zip(self.plant.inputs, command.unbind(1), strict=False))
        still = torch.zeros_like(speed)
        return x, torch.stack([given.get(name, still) for name in self.inputs], dim=1)

    def _run_up(self) -> Tensor:
        """Return the state [1, nx] of a straight course at the speed of full drive, from rest."""
        one, column = torch.ones(1, dtype=torch.float64), self.column("u")
        (x, w), model = self.start(one), self.model(_RUN_UP[0])
        with torch.no_grad():
            for k in range(_RUN_UP[1]):
                before = float(x[0, column])
                x, _ = model.step(x, w, torch.tensor([[1.0, 1.0, 0.0]]).double())
                if k > 100 and abs(float(x[0, column]) - before) < 1e-7 * max(abs(before), 1e-3):
                    break
        if not float(x[0, column]) > 0.0:
            raise ConfigError(
                f"{self.axis.name} control needs a vessel that makes way ahead at full drive; this"
                f" one reaches {float(x[0, column]):.3g} m/s"
            )
        straight = self.plant.approach(1)
        still = () if self.plant.attitude else ("phi",)
        kept = [i for i, name in enumerate(self.state) if name not in (*_LEVEL, *still)]
        straight[:, kept] = x[:, kept]
        return straight


def _rudder_gear(plant: Plant, axis: Axis) -> tuple[float | None, float | None]:
    """Return the rate of the steering gear in rad/s and its time constant in s; None without one.

    They are seen from what two angles lead to: where large ones move the rudder alike, its rate
    holds, and where small ones move it in their proportion, it follows with a time constant.
    """
    if axis.gear not in plant.state:
        return None, None
    column, dt = plant.state.index(axis.gear), 1e-3
    command = plant.inputs.index(axis.command)
    x, w = plant.approach(1), torch.zeros(1, len(plant.inputs), dtype=torch.float64)

    def moved(angle: float) -> float:
        w[:, command] = angle
        step = float(plant.end_step(x, w, dt)[0, column] - x[0, column]) / dt
        return step + float(plant.rate(x, w)[0, column])

    far, near, least = moved(1.0), moved(0.02), moved(0.01)
    if abs(far - moved(0.5)) <= 1e-6 * abs(far):
        return far, None
    # what is at its command within a step has no lag
    lags = abs(near - 2.0 * least) <= 1e-6 * abs(near) and near * dt < 0.5 * 0.02
    return None, 0.02 / near if lags else None


def lacking(axis: Axis, reference: Tensor, value: Tensor) -> Tensor:
    """Return reference less value, any shape: of a heading [rad] wrapped, of a depth [m]."""
    return wrap(reference - value) if axis.value == axis.angle else reference - value


@dataclass(frozen=True)
class Flights:
    """B changes of heading, or of depth, of T steps.

    Attributes:
        states: [B, T+1, nx].
        inputs: [B, T, m].
        heading: reference [B] in rad, or in m of depth.
        dt: step in s.
        names: of the states.
        axis: that is steered.
    """

    states: Tensor
    inputs: Tensor
    heading: Tensor
    dt: float
    names: tuple[str, ...]
    axis: Axis = HEADING

    def state(self, name: str) -> Tensor:
        """Return a state [B, T+1] by its name."""
        return self.states[:, :, self.names.index(name)]

    @property
    def error(self) -> Tensor:
        """Reference less heading [B, T+1], wrapped, or less depth."""
        return lacking(self.axis, self.heading[:, None], self.state(self.axis.value))

    def settled(self, band: float) -> Tensor:
        """Return the time [B] in s of the last entry into +-band [rad] about the reference.

        It lies between samples along a straight line; it is the flight's length where it ends
        outside.
        """
        size = self.error.abs()
        outside = ~(size <= band)
        inside = outside.flip(1).to(torch.int64).argmax(1)
        last = (size.shape[1] - 1 - inside).unsqueeze(1)
        before, after = (
            size.gather(1, k.clamp(max=size.shape[1] - 1))[:, 0] for k in (last, last + 1)
        )
        share = torch.where(inside > 0, (before - band) / (before - after).clamp(min=1e-12), 0.0)
        return torch.where(outside.any(1), last[:, 0] + share, 0.0) * self.dt

    def overshoot(self) -> Tensor:
        """Return the largest heading beyond the reference [B] in rad, seen from the first heading.

        Zero where there is none.
        """
        error = self.error
        return (-error * error[:, :1].sign()).amax(1).clamp(min=0.0)

    def absolute_error(self) -> Tensor:
        """Return the integral of |error| [B] in rad s."""
        return self.error[:, :-1].abs().sum(1) * self.dt

    def effort(self) -> Tensor:
        """Return the integral of the squared rudder command [B] in rad^2 s: the control energy."""
        return self.inputs[:, :, 0].square().sum(1) * self.dt

    def rms(self, name: str, start: float = 0.0) -> Tensor:
        """Return the root of the mean square [B] of a state from a time [s] on."""
        return self.state(name)[:, round(start / self.dt) :].square().mean(1).sqrt()

    def rudder_rms(self, start: float = 0.0) -> Tensor:
        """Return the root mean square [B] of the rudder command in rad from a time [s] on."""
        return self.inputs[:, round(start / self.dt) :, 0].square().mean(1).sqrt()

    def travel(self) -> Tensor:
        """Return how far the rudder command travels [B] in rad, from amidships on."""
        command = self.inputs[:, :, 0]
        return command[:, 0].abs() + command.diff(dim=1).abs().sum(1)


def fly(
    vessel: SteeredVessel,
    policy: Policy,
    heading: Tensor,
    variation: Tensor,
    *,
    dt: float,
    duration: float,
    speed: Tensor | None = None,
    weather: Mapping[str, float | Tensor] | None = None,
    surround: Callable[[Source], Source] | None = None,
) -> Flights:
    """Return the flights of heading changes [B] in rad from straight ahead, without gradients.

    The vessels are varied by [B, 3]; all is float64.

    Args:
        speed: multiples [B] of the service speed.
        weather: exogenous inputs by name, SI, for all rows or [B].
        surround: what adds to the inputs of the closed loop, for example waves.
    """
    heading, variation = heading.double(), variation.double()
    x, w = vessel.start(torch.ones_like(heading) if speed is None else speed.double())
    for name, value in (weather or {}).items():
        w[:, vessel.inputs.index(name)] = value
    steps = round(duration / dt)
    loop: Source = Followed(policy.double(), w.shape[1])
    given = torch.cat((w, heading[:, None]), dim=1).unsqueeze(1).expand(-1, steps, -1)
    with torch.no_grad():
        free = Rollout(vessel.model(dt), loop if surround is None else surround(loop))
        states, inputs, _ = compiled(free, steps)(x, given, vessel.memory(variation))
    return Flights(states, inputs, heading, dt, vessel.state, vessel.axis)


@final
class SteeredModel(SteeredVessel):
    """A learned model with the steering gear and straight courses of the vessel that it models.

    Args:
        columns: names of its inputs; of what steers the angle or its command, the others are
            commands of the vessel.
        hold: whether its inputs are those at a step's start or means over the step.
        vessel: in calm water.

    Raises:
        ConfigError: where nothing steers the model, or an input that the vessel does not command.
    """

    def __init__(
        self, model: HybridDynamics, columns: tuple[str, ...], hold: str, vessel: SteeredPlant
    ) -> None:
        states = live_of(model.signals.names).states
        self.hull, self.vessel, self.mean = model, vessel, hold == "mean"
        self.axis = axis = vessel.axis
        geared = vessel.rate is not None or vessel.lag is not None
        self.state = (*states, axis.gear) if geared else states
        self.inputs, self.rate = vessel.inputs, vessel.rate
        if not {axis.gear, axis.command} & set(columns) or axis.value not in states:
            raise ConfigError(
                f"{axis.name} control needs a model that tells {axis.value} and is driven by"
                f" '{axis.gear}' or '{axis.command}'; it tells {', '.join(states)}, and its inputs"
                f" are {', '.join(columns)}"
            )
        self.any_step = model.n_state == 0
        self.take: list[int] = []
        for name in columns:
            command = commanded(name)
            if command not in vessel.inputs:
                raise ConfigError(
                    f"the model is driven by '{name}', which the vessel does not"
                    f" command{nearest(command, vessel.inputs)}"
                )
            self.take.append(vessel.inputs.index(command))

    def model(self, dt: float, integrator: str = "rk4") -> Dynamics:
        """Return the model, varied, with its own integrator.

        One without memory takes steps of any length.
        """
        return VariedModel(
            self.hull, dt, self.take, self.mean, self.rate, self.vessel.lag, self.axis
        )

    def memory(self, variation: Tensor) -> Tensor:
        """Return the variation, then the head's memory without a past."""
        return torch.cat((variation, variation.new_zeros(len(variation), self.hull.n_state)), dim=1)

    def start(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        x, w = self.vessel.start(speed)
        known = dict(zip(self.vessel.state, x.unbind(1), strict=True))
        # what the vessel does not have, such as roll, is at rest
        still = torch.zeros_like(speed)
        return torch.stack([known.get(name, still) for name in self.state], dim=1), w

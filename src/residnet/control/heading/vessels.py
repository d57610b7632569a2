"""Vessels as heading controllers see them: simulated, or a learned model of one."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import final

import numpy as np
import torch
from torch import Tensor

from residnet.control.heading.turning import Array, Record, Turning, fit_response, slewed
from residnet.core.errors import ConfigError, FitError
from residnet.core.names import nearest
from residnet.dynamics.actuated import commanded
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.steering_variation import HEADING, Axis, VariedModel, VariedPlant
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.symmetry import live_of

_LONG_STEP = 0.4
"""Longest step in s by which a vessel's answer to its rudder is measured."""
_STEPS = 400
"""Steps of one length before the next are twice as long."""
_STEADY = 0.1
"""Share of the yaw rate by which it may still change over the last half of the time."""
_OVERSHOOT = 0.02
"""Share of the steady yaw rate that a vessel of the first order may overshoot by."""
_PATIENCE = 8
"""Times the duration given that a turn is waited for."""
_SWITCHES = 6
"""Changes of rudder that a zigzag ends after."""
_FINE = 25
"""Steps until a zigzag's first change of rudder."""
_LONGEST = 12000
"""Steps after which a zigzag is given up."""
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

        The angle is held first: T is the area above the yaw rate's answer over its end, less that
        above the rudder's own way to the angle. The yaw rate of a vessel that hardly holds its
        course overshoots in hard turns, or is not steady for long. Then K and T are those that
        simulate its yaw rate best in a zigzag, with a delay beside them. An angle that comes to
        rest under the held rudder tells c, and the zigzag K and T.

        Args:
            angle: of the rudder in rad.
            duration: until the turn is steady, in s.
            dt: step in s; later steps are longer.

        Raises:
            FitError: where the vessel does not answer its rudder so that it can be steered.
        """
        speed = float(self._straight_on()[0][0, self.column("u")])
        times, rates, headings = self._held(angle, duration, dt)
        if self.axis.value != self.axis.angle:
            half = np.array_split(headings, 2)[1]
            # an angle that is righted nears its end; one that is not goes round and round
            if not np.ptp(half) <= abs(half.mean()):
                raise FitError(
                    f"at {angle:.3g} rad of planes the vessel is at {headings[-1]:.3g} rad after"
                    f" {times[-1]:.3g} s and does not come to rest: nothing rights it. The planes"
                    " hold an angle against what rights the vessel: check that its weight lies"
                    " below its buoyancy (rigid_body.z_G, buoyancy.z_B) and its speed, or give"
                    " turning_time more"
                )
            return self._righted(angle, float(headings[-1]), speed, dt)
        while times[-1] < _PATIENCE * duration and not _settled(times, rates):
            times, rates, headings = self._held(angle, 2.0 * float(times[-1]), dt)
        if not np.isfinite(rates).all():
            raise FitError(f"the vessel's motion does not stay finite at {angle:.3g} rad of rudder")
        steady = float(rates[-1])
        straight = steady * angle > 0 and _settled(times, rates)
        if straight and (rates / steady).max() <= 1.0 + _OVERSHOOT:
            time = float(np.trapezoid(steady - rates, times)) / steady
            time -= 0.0 if self.rate is None else 0.5 * abs(angle) / self.rate
            if time > 0:
                return Turning(gain=steady / angle, time=time, speed=speed)
        turned = np.flatnonzero(headings * np.sign(angle) >= abs(angle))
        if len(turned) == 0:
            raise FitError(
                f"at {angle:.3g} rad of rudder the vessel does not turn by as much to that side"
                f" within {times[-1]:.3g} s; it cannot be steered (check the sign of its rudder and"
                " the limit)"
            )
        first = float(times[turned[0]])
        found = fit_response([self._zigzag(angle, angle, first, dt)[0]], 0.5 * first)
        return Turning(gain=found.gain, time=found.time, speed=speed)

    def _righted(self, angle: float, end: float, speed: float, dt: float) -> Turning:
        """Return K, T and c of a vessel that has come to rest at an angle `end` under a held one.

        `speed` is that of K and T in m/s.
        """
        if not (math.isfinite(end) and end * angle > 0):
            raise FitError(
                f"at {angle:.3g} rad of rudder the vessel comes to rest at an angle of {end:.3g}"
                " rad; it cannot be steered (check the sign of the command that steers)"
            )
        righting, first = angle / end, 2.0 * self._longest(dt)
        record, headings = self._zigzag(angle, min(abs(angle), 0.5 * abs(end)), first, dt)
        known = replace(record, rudder=record.rudder - righting * headings)
        found = fit_response([known], _FINE * first)
        return Turning(float(found.gain), found.time, speed, righting)

    def _longest(self, dt: float) -> float:
        """Return the longest step in s of answers that begin with steps of dt seconds."""
        return max(dt, _LONG_STEP) if self.any_step else dt

    def _straight_on(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return state, inputs and memory of a straight course at the service speed, [1, ...]."""
        x, w = self.start(torch.ones(1, dtype=torch.float64))
        return x, w, self.memory(torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64))

    def _held(self, angle: float, duration: float, dt: float) -> tuple[Array, Array, Array]:
        """Return times, yaw rates and headings [N] under a held rudder, in steps that grow."""
        r, psi, side = self.column(self.axis.rate), self.column(self.axis.angle), self.axis.side
        x, w, s = self._straight_on()
        begun = float(x[0, psi])
        w[:, 0] = angle
        times, rates, headings = [0.0], [0.0], [0.0]
        longest = self._longest(dt)
        with torch.no_grad():
            while times[-1] < duration - 0.5 * dt:
                model = self.model(dt)
                for _ in range(min(_STEPS, round((duration - times[-1]) / dt))):
                    x, s = model.step(x, w, s)
                    times.append(times[-1] + dt)
                    rates.append(side * float(x[0, r]))
                    headings.append(side * (float(x[0, psi]) - begun))
                dt = min(2.0 * dt, longest)
        return np.array(times), np.array(rates), np.array(headings)

    def _zigzag(self, angle: float, turned: float, first: float, dt: float) -> tuple[Record, Array]:
        """Return a zigzag with its headings, which go to an angle `turned` on each side.

        `first` is the time in s until its first change of rudder.
        """
        r, psi = self.column(self.axis.rate), self.column(self.axis.angle)
        longest = self._longest(dt)
        dt = dt if longest <= dt else min(max(first / _FINE, dt), longest)
        model, (x, w, s) = self.model(dt), self._straight_on()
        begun, side, switches = float(x[0, psi]), float(np.sign(angle)), 0
        rates: list[float] = []
        rudder: list[float] = []
        headings: list[float] = []
        with torch.no_grad():
            while switches < _SWITCHES:
                if len(rates) > _LONGEST:
                    raise FitError(
                        f"a zigzag with {abs(angle):.3g} rad of rudder does not turn the vessel"
                        f" back within {dt * _LONGEST:.3g} s; it cannot be steered with so little"
                        " rudder"
                    )
                headings.append(self.axis.side * (float(x[0, psi]) - begun))
                if side * headings[-1] > abs(turned):
                    side, switches = -side, switches + 1
                w[:, 0] = side * abs(angle)
                rates.append(self.axis.side * float(x[0, r]))
                rudder.append(side * abs(angle))
                x, s = model.step(x, w, s)
        rate = np.array(rates)
        gear = math.inf if self.rate is None else self.rate
        angle_taken = slewed(np.array([0.0, *rudder]), gear, dt)[1:]
        return Record(dt, angle_taken, rate, np.isfinite(rate)), np.array(headings)


def _settled(times: Array, rates: Array) -> bool:
    """Return whether a yaw rate is steady over the last half of the time."""
    half, steady = rates[np.searchsorted(times, 0.5 * times[-1]) :], rates[-1]
    overshoots = np.abs(rates).max() > (1.0 + _STEADY) * abs(steady)
    return bool(overshoots or np.abs(half - steady).max() <= _STEADY * abs(steady))


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

"""Vessels for the design and simulation of heading controllers: a plant or a learned model."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import final

import numpy as np
import torch
from torch import Tensor

from residnet.autopilot.heading.steering_variation import (
    HEADING,
    Axis,
    VariedModel,
    VariedPlant,
    require_command,
)
from residnet.autopilot.heading.turning import (
    Array,
    ManoeuvreRecord,
    NomotoModel,
    fit_response,
    limit_rudder_rate,
)
from residnet.core.errors import ConfigError, FitError
from residnet.core.names import suggest_name
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.manoeuvres.actuated import command_name_for
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.symmetry import get_dof

_MAX_RESPONSE_STEP = 0.4
"""Largest time step in s of simulated rudder responses."""
_STEPS_PER_DOUBLING = 400
"""Number of steps after which the time step doubles."""
_STEADY_TOLERANCE = 0.1
"""Largest relative change of a steady yaw rate over the second half of the simulation."""
_MAX_OVERSHOOT = 0.02
"""Largest relative overshoot of the yaw rate of a first-order response."""
_MAX_DURATION_FACTOR = 8
"""Largest multiple of the requested duration for which a turn is simulated."""
_N_ZIGZAG_SWITCHES = 6
"""Number of rudder reversals of a zigzag."""
_STEPS_TO_FIRST_SWITCH = 25
"""Number of steps until the first rudder reversal of a zigzag."""
_MAX_ZIGZAG_STEPS = 12000
"""Largest number of steps of a zigzag."""
_ZERO_STATES = ("x", "y", "z", "theta", "psi", "v", "w", "p", "q", "r")
"""States that are zero on a straight course."""
_RUN_UP_TIME_STEP = 0.1
"""Time step in s of the acceleration to the speed of a straight course."""
_MAX_RUN_UP_STEPS = 6000
"""Largest number of steps of this acceleration."""
_MIN_RUN_UP_STEPS = 100
"""Number of steps after which the acceleration ends as soon as the speed is constant."""


class SteeredVessel(ABC):
    """A vessel whose first command is the steering angle: the rudder, or the stern planes.

    Attributes:
        axis: controlled axis; `axis.value` is the name of the controlled state, and `axis.side` the
            sign of the angle under a positive command.
        state: names of the columns of x.
        inputs: names of the columns of w.
        rate: rudder rate in rad/s; None for a rudder without a rate limit.
        has_free_step: whether `model` can be built for any time step.
    """

    axis: Axis = HEADING
    state: tuple[str, ...]
    inputs: tuple[str, ...]
    rate: float | None
    has_free_step: bool = True

    @abstractmethod
    def model(self, dt: float, integrator: str = "rk4") -> Dynamics:
        """Build the dynamics for a time step of dt seconds.

        The memory of each row starts with the variation of its steering, see `memory`.
        """

    def nominal_model(self, dt: float) -> Dynamics:
        """Build the dynamics without variation of the steering, for simulations without gradients.

        Its arguments are those of `model`.
        """
        return self.model(dt)

    def memory(self, variation: Tensor) -> Tensor:
        """Return the initial memory of `model`.

        Args:
            variation: variation of the steering [B, 3]: factor of the rudder force, factor of the
                time constants, and rudder bias in rad (`steering_variation.VARIATION`).
        """
        return variation

    @abstractmethod
    def straight_course(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return states [B, nx] and inputs [B, m] on straight courses.

        Args:
            speed: multiples [B] of the service speed.
        """

    @final
    def state_column(self, name: str) -> int:
        """Return the index of the column of a state in x."""
        return self.state.index(name)

    @final
    def estimate_nomoto(self, angle: float, duration: float, dt: float = 0.02) -> NomotoModel:
        """Estimate Nomoto's K and T at the service speed from simulated responses.

        If the controlled angle has a restoring moment, as the pitch angle has, the restoring
        coefficient c is also estimated: T r_dot + r = K (delta - c psi).

        First the response to a rudder step is evaluated: K is the steady yaw rate per angle, and T
        is the area between the step response and its final value, minus the contribution of the
        rudder movement. If the yaw rate overshoots or does not become steady, K, T and a delay are
        fitted to a zigzag instead. If the controlled angle (pitch) becomes steady, c follows from
        the final angle, and K and T from a zigzag.

        Args:
            angle: rudder angle in rad.
            duration: time in s until the turn is steady.
            dt: initial time step in s; later steps are longer.

        Raises:
            FitError: if the vessel does not respond to its rudder like a first-order system.
        """
        speed = float(self._straight_state()[0][0, self.state_column("u")])
        times, rates, headings = self._simulate_step_response(angle, duration, dt)
        if self.axis.value != self.axis.angle:
            last_half = np.array_split(headings, 2)[1]
            # with a restoring moment the angle becomes steady; without one it increases steadily
            if not np.ptp(last_half) <= abs(last_half.mean()):
                raise FitError(
                    f"at a plane angle of {angle:.3g} rad the dive angle is {headings[-1]:.3g} rad"
                    f" after {times[-1]:.3g} s and not steady, as without a restoring moment; check"
                    " that the centre of gravity is below that of buoyancy (rigid_body.z_G,"
                    " buoyancy.z_B), and the speed, or increase turning_time"
                )
            return self._estimate_restoring(angle, float(headings[-1]), speed, dt)
        while times[-1] < _MAX_DURATION_FACTOR * duration and not _is_steady(times, rates):
            times, rates, headings = self._simulate_step_response(angle, 2.0 * float(times[-1]), dt)
        if not np.isfinite(rates).all():
            raise FitError(
                f"the motion of the vessel is not finite at a rudder angle of {angle:.3g} rad"
            )
        steady = float(rates[-1])
        is_first_order = steady * angle > 0 and _is_steady(times, rates)
        if is_first_order and (rates / steady).max() <= 1.0 + _MAX_OVERSHOOT:
            time = float(np.trapezoid(steady - rates, times)) / steady
            # a ramp to the angle delays the response by half of the time of the rudder movement
            time -= 0.0 if self.rate is None else 0.5 * abs(angle) / self.rate
            if time > 0:
                return NomotoModel(gain=steady / angle, time=time, speed=speed)
        reached_indices = np.flatnonzero(headings * np.sign(angle) >= abs(angle))
        if len(reached_indices) == 0:
            raise FitError(
                f"at a rudder angle of {angle:.3g} rad the heading does not change by this angle"
                f" within {times[-1]:.3g} s; the vessel cannot be steered (check the sign of its"
                " rudder and the limit)"
            )
        expected_switch_time = float(times[reached_indices[0]])
        response = fit_response(
            [self._simulate_zigzag(angle, angle, expected_switch_time, dt)[0]],
            0.5 * expected_switch_time,
        )
        return NomotoModel(gain=response.gain, time=response.time, speed=speed)

    def _estimate_restoring(
        self, angle: float, final_angle: float, speed: float, dt: float
    ) -> NomotoModel:
        """Estimate K, T and c of a vessel with a restoring moment.

        Args:
            angle: constant rudder angle in rad.
            final_angle: steady value of the controlled angle (pitch) at this rudder angle in rad.
            speed: speed in m/s.
            dt: initial time step in s.
        """
        if not (math.isfinite(final_angle) and final_angle * angle > 0):
            raise FitError(
                f"at a rudder angle of {angle:.3g} rad the final angle of the vessel is"
                f" {final_angle:.3g} rad; it cannot be steered (check the sign of the steering"
                " command)"
            )
        restoring = angle / final_angle
        expected_switch_time = 2.0 * self._longest_step(dt)
        record, headings = self._simulate_zigzag(
            angle, min(abs(angle), 0.5 * abs(final_angle)), expected_switch_time, dt
        )
        corrected_record = replace(record, rudder=record.rudder - restoring * headings)
        response = fit_response([corrected_record], _STEPS_TO_FIRST_SWITCH * expected_switch_time)
        return NomotoModel(float(response.gain), response.time, speed, restoring)

    def _longest_step(self, dt: float) -> float:
        """Return the largest time step in s of a response with the initial step dt."""
        return max(dt, _MAX_RESPONSE_STEP) if self.has_free_step else dt

    def _straight_state(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return state, inputs and memory [1, ...] on a straight course at the service speed."""
        x, w = self.straight_course(torch.ones(1, dtype=torch.float64))
        return x, w, self.memory(torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64))

    def _simulate_step_response(
        self, angle: float, duration: float, dt: float
    ) -> tuple[Array, Array, Array]:
        """Simulate a rudder step; returns times, yaw rates and headings [N], not equidistant."""
        r = self.state_column(self.axis.rate)
        psi = self.state_column(self.axis.angle)
        rate_sign = self.axis.side
        x, w, s = self._straight_state()
        initial_heading = float(x[0, psi])
        w[:, 0] = angle
        times = [0.0]
        rates = [0.0]
        headings = [0.0]
        longest_step = self._longest_step(dt)
        with torch.inference_mode():
            while times[-1] < duration - 0.5 * dt:
                model = self.nominal_model(dt)
                for _ in range(min(_STEPS_PER_DOUBLING, round((duration - times[-1]) / dt))):
                    x, s = model.step(x, w, s)
                    times.append(times[-1] + dt)
                    rates.append(rate_sign * float(x[0, r]))
                    headings.append(rate_sign * (float(x[0, psi]) - initial_heading))
                # the step doubles: the beginning of the response needs short steps; for its end,
                # long steps are sufficient
                dt = min(2.0 * dt, longest_step)
        return np.array(times), np.array(rates), np.array(headings)

    def _simulate_zigzag(
        self, angle: float, switch_angle: float, expected_switch_time: float, dt: float
    ) -> tuple[ManoeuvreRecord, Array]:
        """Simulate a zigzag manoeuvre and return its record and its headings.

        Args:
            angle: rudder angle in rad.
            switch_angle: heading change in rad at which the rudder is reversed.
            expected_switch_time: expected time in s of the first reversal; sets the time step.
            dt: time step in s.
        """
        r = self.state_column(self.axis.rate)
        psi = self.state_column(self.axis.angle)
        longest_step = self._longest_step(dt)
        dt = (
            dt
            if longest_step <= dt
            else min(max(expected_switch_time / _STEPS_TO_FIRST_SWITCH, dt), longest_step)
        )
        model = self.nominal_model(dt)
        (x, w, s) = self._straight_state()
        initial_heading = float(x[0, psi])
        rudder_sign = float(np.sign(angle))
        switches = 0
        rates: list[float] = []
        rudder: list[float] = []
        headings: list[float] = []
        with torch.inference_mode():
            while switches < _N_ZIGZAG_SWITCHES:
                if len(rates) > _MAX_ZIGZAG_STEPS:
                    raise FitError(
                        f"a zigzag with a rudder angle of {abs(angle):.3g} rad does not reverse the"
                        f" turn within {dt * _MAX_ZIGZAG_STEPS:.3g} s; the vessel needs a larger"
                        " rudder angle"
                    )
                headings.append(self.axis.side * (float(x[0, psi]) - initial_heading))
                if rudder_sign * headings[-1] > abs(switch_angle):
                    rudder_sign = -rudder_sign
                    switches = switches + 1
                w[:, 0] = rudder_sign * abs(angle)
                rates.append(self.axis.side * float(x[0, r]))
                rudder.append(rudder_sign * abs(angle))
                x, s = model.step(x, w, s)
        rate = np.array(rates)
        rudder_rate = math.inf if self.rate is None else self.rate
        rudder_angles = limit_rudder_rate(np.array([0.0, *rudder]), rudder_rate, dt)[1:]
        return ManoeuvreRecord(dt, rudder_angles, rate, np.isfinite(rate)), np.array(headings)


def _is_steady(times: Array, rates: Array) -> bool:
    """Return whether a yaw rate is steady over the second half of the simulation.

    The result is also True if the yaw rate overshoots, because a longer simulation does not change
    that.
    """
    last_half = rates[np.searchsorted(times, 0.5 * times[-1]) :]
    steady = rates[-1]
    overshoots = np.abs(rates).max() > (1.0 + _STEADY_TOLERANCE) * abs(steady)
    return bool(overshoots or np.abs(last_half - steady).max() <= _STEADY_TOLERANCE * abs(steady))


@final
class _NominalPlant(Dynamics):
    """A plant with its nominal steering, whose step is evaluated by CasADi.

    Args:
        plant: the plant.
        dt: time step in s.
        inputs: names of the columns of w.
    """

    def __init__(self, plant: Plant, dt: float, inputs: Sequence[str]) -> None:
        super().__init__(dt, "rk4")
        self.plant_dynamics = RecordedPlantDynamics(plant, dt)
        self.input_columns = [inputs.index(name) for name in plant.input_names]

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.plant_dynamics.step(x, w[:, self.input_columns], s)


@final
class SteeredPlant(SteeredVessel):
    """A simulated vessel, in calm water or with environmental inputs.

    Raises:
        ConfigError: if the vessel has no command for the axis, or does not move ahead.
    """

    def __init__(self, plant: Plant, *, in_calm_water: bool = True, axis: Axis = HEADING) -> None:
        if in_calm_water and isinstance(plant, HullPlant):
            plant = plant.without_environment()
        self.plant = plant
        self.axis = axis
        other_inputs = [name for name in plant.input_names if name != axis.command]
        self.state = plant.state_names
        self.inputs = (axis.command, *other_inputs)
        self._straight_course_state = plant.make_initial_state(1)
        # with six degrees of freedom the propeller torque heels the vessel on a straight course, so
        # that its steady state must be simulated
        if (
            plant.attitude_columns
            or float(self._straight_course_state[0, self.state_column("u")]) == 0.0
        ):
            self._straight_course_state = self._simulate_run_up()
        self.rate, self.lag = _identify_rudder_gear(plant, axis)

    def model(self, dt: float, integrator: str = "rk4") -> Dynamics:
        return VariedPlant(self.plant, dt, integrator, self.axis)

    def nominal_model(self, dt: float) -> Dynamics:
        require_command(self.plant, self.axis)
        return _NominalPlant(self.plant, dt, self.inputs)

    def straight_course(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return states and inputs on straight courses, with thrust proportional to speed^2."""
        x = self._straight_course_state.to(speed.dtype).repeat(len(speed), 1)
        x[:, self.state_column("u")] *= speed
        command = self.plant.commands_for_demand(speed.square(), torch.zeros_like(speed))
        command_inputs = dict(zip(self.plant.input_names, command.unbind(1), strict=False))
        zero_input = torch.zeros_like(speed)
        return x, torch.stack([command_inputs.get(name, zero_input) for name in self.inputs], dim=1)

    def _simulate_run_up(self) -> Tensor:
        """Simulate the acceleration at full propulsion command; returns the final state [1, nx]."""
        unit_speed = torch.ones(1, dtype=torch.float64)
        column = self.state_column("u")
        (x, w) = self.straight_course(unit_speed)
        model = self.nominal_model(_RUN_UP_TIME_STEP)
        with torch.no_grad():
            for k in range(_MAX_RUN_UP_STEPS):
                previous_speed = float(x[0, column])
                x, _ = model.step(x, w, torch.tensor([[1.0, 1.0, 0.0]]).double())
                if k > _MIN_RUN_UP_STEPS and abs(float(x[0, column]) - previous_speed) < 1e-7 * max(
                    abs(previous_speed), 1e-3
                ):
                    break
        if not float(x[0, column]) > 0.0:
            raise ConfigError(
                f"{self.axis.name} control needs a vessel that makes way ahead at full drive; this"
                f" one reaches {float(x[0, column]):.3g} m/s"
            )
        course_state = self.plant.make_initial_state(1)
        # only a vessel with six degrees of freedom may heel on a straight course
        zero_angles = () if self.plant.attitude_columns else ("phi",)
        retained = [
            i for i, name in enumerate(self.state) if name not in (*_ZERO_STATES, *zero_angles)
        ]
        course_state[:, retained] = x[:, retained]
        return course_state


def _identify_rudder_gear(plant: Plant, axis: Axis) -> tuple[float | None, float | None]:
    """Identify rate limit [rad/s] and time constant [s] of the steering gear; None if absent.

    The gear is tested with steps of two sizes. A response independent of the step size shows a rate
    limit, a proportional response shows a time constant.
    """
    if axis.gear not in plant.state_names:
        return None, None
    column = plant.state_names.index(axis.gear)
    dt = 1e-3
    command = plant.input_names.index(axis.command)
    x, w = plant.make_initial_state(1), torch.zeros(1, len(plant.input_names), dtype=torch.float64)

    def rudder_rate_at(angle: float) -> float:
        w[:, command] = angle
        # a gear moves by its derivative or at the end of the step (`finish_step`)
        step_rate = float(plant.finish_step(x, w, dt)[0, column] - x[0, column]) / dt
        return step_rate + float(plant.derivative(x, w)[0, column])

    rate_at_large = rudder_rate_at(1.0)
    rate_at_small = rudder_rate_at(0.02)
    rate_at_half_small = rudder_rate_at(0.01)
    if abs(rate_at_large - rudder_rate_at(0.5)) <= 1e-6 * abs(rate_at_large):
        return rate_at_large, None
    # a gear that reaches its command within a step has no lag
    has_lag = (
        abs(rate_at_small - 2.0 * rate_at_half_small) <= 1e-6 * abs(rate_at_small)
        and rate_at_small * dt < 0.5 * 0.02
    )
    return None, 0.02 / rate_at_small if has_lag else None


@final
class SteeredModel(SteeredVessel):
    """A learned model with the steering gear and straight courses of the vessel that it models.

    Args:
        model: learned model.
        input_names: names of its inputs: the steering angle or its command, and further commands of
            the vessel.
        input_hold: `start` if an input is sampled at the start of a step, `mean` for step means.
        vessel: modelled vessel in calm water.

    Raises:
        ConfigError: if no input steers the model, or an input is no command of the vessel.
    """

    def __init__(
        self,
        model: HybridDynamics,
        input_names: tuple[str, ...],
        input_hold: str,
        vessel: SteeredPlant,
    ) -> None:
        states = get_dof(model.signals.names).state_names
        self.learned_model = model
        self.vessel = vessel
        self.uses_step_mean = input_hold == "mean"
        self.axis = axis = vessel.axis
        has_gear = vessel.rate is not None or vessel.lag is not None
        self.state = (*states, axis.gear) if has_gear else states
        self.inputs = vessel.inputs
        self.rate = vessel.rate
        if not {axis.gear, axis.command} & set(input_names) or axis.value not in states:
            raise ConfigError(
                f"{axis.name} control needs a model with the state {axis.value} and the input"
                f" '{axis.gear}' or '{axis.command}'; this model has the states {', '.join(states)}"
                f" and the inputs {', '.join(input_names)}"
            )
        self.has_free_step = model.n_state == 0
        self.input_indices: list[int] = []
        for name in input_names:
            command = command_name_for(name)
            if command not in vessel.inputs:
                raise ConfigError(
                    f"the model is driven by '{name}', which the vessel does not"
                    f" command{suggest_name(command, vessel.inputs)}"
                )
            self.input_indices.append(vessel.inputs.index(command))

    def model(self, dt: float, integrator: str = "rk4") -> Dynamics:
        """Build the model with varied steering and its own integrator.

        A model without memory can be built for any time step.
        """
        return VariedModel(
            self.learned_model,
            dt,
            self.input_indices,
            self.uses_step_mean,
            self.rate,
            self.vessel.lag,
            self.axis,
        )

    def memory(self, variation: Tensor) -> Tensor:
        """Return the variation of the steering and the zero memory of the head (residual model)."""
        initial_memory = variation.new_zeros(len(variation), self.learned_model.n_state)
        return torch.cat((variation, initial_memory), dim=1)

    def straight_course(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        x, w = self.vessel.straight_course(speed)
        vessel_states = dict(zip(self.vessel.state, x.unbind(1), strict=True))
        # states that the vessel does not have, such as roll, are zero
        zero_state = torch.zeros_like(speed)
        return torch.stack([vessel_states.get(name, zero_state) for name in self.state], dim=1), w

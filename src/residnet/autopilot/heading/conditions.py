"""The conditions that heading controllers are tuned, trained and judged under.

Tuning is by differential evolution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.autopilot.base import Policy, ReferenceInInputs
from residnet.autopilot.heading.controllers import ControlTask, TunableConfig
from residnet.autopilot.heading.steering_variation import DEPTH, HEADING, Axis, PushedSteering
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, RadiansPerSecond, Seconds
from residnet.core.errors import ExportError, FitError
from residnet.core.frames import wrap_angle
from residnet.dynamics.simulated import check_steps
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import FreeRun, Rollout, Source
from residnet.physics.environment import JonswapSpectrumConfig

if TYPE_CHECKING:
    from residnet.engine.compiled import CompiledRollout


Range = Annotated[tuple[float, float], Field(description="low and high multiple")]
_N_WAVE_COMPONENTS = 12
"""That a motion with the waves is made of."""


class DepthStepConfig(Config):
    """Changes of depth, in place of those of heading.

    Attributes:
        change: smallest and largest in m, down or up.
        band: depth error in m at which half of the cost of a large one is left.
        noise: standard deviation of white noise on the measured depth in m.
    """

    change: tuple[Metres, Metres] = (1.0, 5.0)
    band: Metres = Field(default=0.1, gt=0)
    noise: Metres = Field(default=0.02, ge=0)


_DEPTH_UNIT = 0.1
_DEGREE = math.pi / 180.0
"""What stands for a degree of heading where depths are changed: the default bands' ratio, in m."""


class ConditionsConfig(Config):
    """The conditions of heading changes, and what a change costs.

    Each flight has a vessel, a delay, disturbances and a change of heading of its own. The vessel
    holds its course first; the reference jumps at a random time, without prefilter. The cost of a
    flight counts from the jump on: the integral of |e| / (|e| + band) in s, plus `overshoot_weight`
    times the overshoot in deg, plus `travel_weight` times the travel of the rudder command in deg;
    e is the true heading error. With `depth` all this is of the depth, by the stern planes: a
    decimetre of overshoot stands for a degree, sway and yaw are heave and pitch, and heading and
    yaw rate that are measured are pitch and pitch rate.

    Attributes:
        depth: changes of depth; null for those of heading.
        effect: of the rudder, as a multiple (K of Nomoto's model).
        time: constants of sway and yaw, as a multiple (T of Nomoto's model).
        delay: shortest and longest delay in s between a command and the steering gear.
        bias: largest constant angle in rad that is added to the rudder's.
        push: standard deviation of a slow yaw moment in rad of rudder, a Gauss-Markov process.
        push_time: correlation time of that process in s.
        noise_psi: standard deviation of white noise on the measured heading in rad.
        noise_r: standard deviation of white noise on the measured yaw rate in rad/s.
        heading: smallest and largest change of heading in rad, to either side.
        hold: longest time in s that the course is held before the change.
        duration: time in s from the change to the end of what is counted.
        wind: slowest and fastest wind in m/s from any direction; null for none.
        current: fastest current in m/s in any direction.
        waves: largest standard deviation in rad of the heading's motion with the waves, evenly
            drawn from zero on. Heading and yaw rate are measured with it; the error that is
            counted is without it, since no rudder is quick enough against it.
        wave_period: shortest and longest peak period in s of that motion, a JONSWAP spectrum.
        dt: step of vessel, sensors and controllers in s; with another one, as in training, the
            noise is scaled so that its spectrum stays the same.
        band: heading error in rad at which half of the cost of a large one is left.
        overshoot_weight: cost of a degree of overshoot, in s.
        travel_weight: cost of a degree of rudder travel, in s.
    """

    depth: DepthStepConfig | None = None
    effect: Range = (0.8, 1.2)
    time: Range = (0.8, 1.2)
    delay: tuple[Seconds, Seconds] = (0.0, 0.4)
    bias: Radians = Field(default=0.017453292519943295, ge=0)
    push: Radians = Field(default=0.008726646259971648, ge=0)
    push_time: Seconds = Field(default=5.0, gt=0)
    noise_psi: Radians = Field(default=0.0017453292519943296, ge=0)
    noise_r: RadiansPerSecond = Field(default=0.0017453292519943296, ge=0)
    heading: tuple[Radians, Radians] = (0.08726646259971647, 1.0471975511965976)
    hold: Seconds = Field(default=5.0, ge=0)
    duration: Seconds = Field(default=14.0, gt=0)
    wind: tuple[MetresPerSecond, MetresPerSecond] | None = None
    current: MetresPerSecond = Field(default=0.0, ge=0)
    waves: Radians = Field(default=0.0, ge=0, le=0.5)
    wave_period: tuple[Seconds, Seconds] = (4.0, 9.0)
    dt: Seconds = Field(default=0.02, gt=0)
    band: Radians = Field(default=0.017453292519943295, gt=0)
    overshoot_weight: float = Field(default=0.5, ge=0)
    travel_weight: float = Field(default=0.01, ge=0)

    @model_validator(mode="after")
    def _check_ranges(self) -> ConditionsConfig:
        ranges = {
            "effect": (*self.effect, 1e-6, 10.0),
            "time": (*self.time, 1e-6, 10.0),
            "delay": (*self.delay, 0.0, 60.0),
            "heading": (*self.heading, 1e-3, 3.1),
            "wave_period": (*self.wave_period, 0.2, 60.0),
        }
        if self.depth is not None:
            ranges["depth.change"] = (*self.depth.change, 1e-3, 1e4)
            if self.waves > 0:
                raise ValueError("waves: they move the heading that is measured, and no depth")
        check_steps(self.hold + self.duration, self.dt)
        if self.wind is not None:
            ranges["wind"] = (*self.wind, 0.0, 60.0)
        for name, (lower, upper, lower_limit, upper_limit) in ranges.items():
            if not lower_limit <= lower <= upper <= upper_limit:
                raise ValueError(
                    f"{name}: low and high must be in order and within {lower_limit:g} and {upper_limit:g},"
                    f" given {lower:g}, {upper:g}"
                )
        return self

    @property
    def axis(self) -> Axis:
        """What is steered: the heading, or the depth."""
        return HEADING if self.depth is None else DEPTH

    @property
    def step_range(self) -> tuple[float, float]:
        """Smallest and largest change in rad, or in m of depth."""
        return self.heading if self.depth is None else self.depth.change

    @property
    def overshoot_unit(self) -> float:
        """A degree in rad, or a decimetre in m, which `overshoot_weight` is for."""
        return _DEGREE if self.depth is None else _DEPTH_UNIT

    @property
    def has_weather(self) -> bool:
        """Whether there is wind or current."""
        return self.wind is not None or self.current > 0

    def required_inputs(self) -> tuple[str, ...]:
        """Return the inputs that a vessel must have to be flown under these conditions."""
        return (
            *(("wind_speed", "wind_dir") if self.wind is not None else ()),
            *(("current_north", "current_east") if self.current > 0 else ()),
        )

    def sample_steps(
        self, rows: int, dt: float, generator: torch.Generator, share: float = 1.0
    ) -> HeadingStepBatch:
        """Draw heading changes for a number of flights, float32.

        Args:
            dt: step in s.
            generator: source of all that is drawn.
            share: part of all departures from the nominal vessel in calm water, 0 to 1.
        """

        def sample_uniform(lower: float, upper: float) -> Tensor:
            return lower + (upper - lower) * torch.rand(rows, generator=generator)

        hold_steps = round(self.hold / dt)
        steps = hold_steps + round(self.duration / dt)
        scale = share * math.sqrt(self.dt / dt)
        noise_levels = [self.noise_psi, self.noise_r]
        noise_levels = noise_levels if self.depth is None else [self.depth.noise, *noise_levels]
        noise = torch.randn(rows, steps, len(noise_levels), generator=generator)
        noise *= torch.tensor([scale * noise_level for noise_level in noise_levels])
        sign = torch.where(torch.rand(rows, generator=generator) < 0.5, -1.0, 1.0)
        effect_factor, time_factor = (
            1.0 + share * (sample_uniform(*values) - 1.0) for values in (self.effect, self.time)
        )
        bias = share * sample_uniform(-self.bias, self.bias)
        changes = HeadingStepBatch(
            target=sign * sample_uniform(*self.step_range),
            step_index=torch.randint(0, hold_steps + 1, (rows,), generator=generator),
            vessel_variation=torch.stack((effect_factor, time_factor, bias), dim=1),
            delay_steps=torch.round(share * sample_uniform(*self.delay) / dt),
            push=share
            * self.push
            * sample_gauss_markov(rows, steps, dt / self.push_time, generator),
            noise=noise,
            weather=self._sample_weather(rows, generator, share),
            dt=dt,
            n_counted=steps - hold_steps,
        )
        if self.waves > 0:
            # drawn last, so that all else is the same with waves and without
            noise_level = sample_uniform(0.0, share * self.waves)
            period = sample_uniform(*self.wave_period)
            noise += noise_level[:, None, None] * sample_wave_motion(period, steps, dt, generator)
        return changes

    def with_corner_rows(
        self, changes: HeadingStepBatch, rows: int, generator: torch.Generator, share: float = 1.0
    ) -> HeadingStepBatch:
        """Return changes whose first rows have vessels and delays at corners of their ranges.

        `fraction` is the part of all departures from the nominal vessel, as in `sample_steps`.
        """
        variation = changes.vessel_variation.clone()
        delay = changes.delay_steps.clone()

        def sample_end(lower: float, upper: float) -> Tensor:
            return torch.where(torch.rand(rows, generator=generator) < 0.5, lower, upper)

        variation[:rows, 0] = 1.0 + share * (sample_end(*self.effect) - 1.0)
        variation[:rows, 1] = 1.0 + share * (sample_end(*self.time) - 1.0)
        delay[:rows] = torch.round(share * sample_end(*self.delay) / changes.dt)
        return replace(changes, vessel_variation=variation, delay_steps=delay)

    def _sample_weather(
        self, rows: int, generator: torch.Generator, share: float
    ) -> dict[str, Tensor]:
        fractions = torch.rand(2, rows, generator=generator)
        directions = 2.0 * torch.pi * torch.rand(2, rows, generator=generator)
        inputs: dict[str, Tensor] = {}
        if self.wind is not None:
            lower, upper = self.wind
            inputs["wind_speed"] = share * (lower + (upper - lower) * fractions[0])
            inputs["wind_dir"] = directions[0]
        if self.current > 0:
            speed = share * self.current * fractions[1]
            inputs["current_north"] = speed * torch.cos(directions[1])
            inputs["current_east"] = speed * torch.sin(directions[1])
        return inputs


def sample_wave_motion(period: Tensor, steps: int, dt: float, generator: torch.Generator) -> Tensor:
    """Return motions with the waves and their rates [B, T, 2], of unit variance before the rate.

    Each is a sum of sines of random phase with a JONSWAP spectrum: the wave-frequency motion that
    is added to the slow one (T. I. Fossen, Handbook of Marine Craft, 2011, section 8.2).

    Args:
        period: at the peak in s, [B].
        dt: step in s.
    """
    band_edges = torch.linspace(0.7, 1.8, _N_WAVE_COMPONENTS + 1)
    # somewhere within its band each, so that the sum does not repeat itself
    band_fraction = torch.rand(len(period), _N_WAVE_COMPONENTS, generator=generator)
    ratio = band_edges[:-1] + band_fraction * torch.diff(band_edges)
    density = JonswapSpectrumConfig().spectral_density(ratio.numpy(), 1.0, 2.0 * math.pi)
    power = torch.from_numpy(density).float()
    amplitude = (2.0 * power / power.sum(1, keepdim=True)).sqrt()
    omega = ratio * (2.0 * math.pi / period[:, None])
    phase = 2.0 * math.pi * torch.rand(len(period), _N_WAVE_COMPONENTS, generator=generator)
    angle = omega[:, None] * (dt * torch.arange(steps))[None, :, None] + phase[:, None]
    motion = (amplitude[:, None] * torch.cos(angle)).sum(2)
    rate = (-(amplitude * omega)[:, None] * torch.sin(angle)).sum(2)
    return torch.stack((motion, rate), dim=2)


def sample_gauss_markov(rows: int, steps: int, step: float, generator: torch.Generator) -> Tensor:
    """Return stationary first-order processes [B, T] of unit variance, exact at their samples.

    `step` is the time between samples as a multiple of the correlation time.
    """
    from scipy.signal import lfilter

    decay_factor = math.exp(-step)
    white_noise = torch.randn(rows, steps, generator=generator, dtype=torch.float64).numpy()
    white_noise[:, 1:] *= math.sqrt(1.0 - decay_factor * decay_factor)
    return torch.from_numpy(lfilter([1.0], [1.0, -decay_factor], white_noise, axis=1)).float()


@dataclass(frozen=True)
class HeadingStepBatch:
    """B changes of heading, or of depth, of T steps, as they were drawn.

    Attributes:
        target: change [B] in rad, or in m of depth.
        step_index: number [B] of the step at which the reference jumps.
        vessel_variation: of the vessel [B, 3], `dynamics.steering_variation.VARIATION`.
        delay_steps: of the command [B] in steps.
        push: angle [B, T] in rad that is added to the rudder's.
        noise: on what is measured of the axis (`Axis.measured`), [B, T, 2 or 3] in SI units.
        weather: constant inputs of the vessel [B] by name, SI.
        dt: step in s.
        n_counted: number of steps that are counted, from the jump on.
    """

    target: Tensor
    step_index: Tensor
    vessel_variation: Tensor
    delay_steps: Tensor
    push: Tensor
    noise: Tensor
    weather: dict[str, Tensor]
    dt: float
    n_counted: int

    def reference(self) -> Tensor:
        """Return the reference [B, T]: zero, then the new heading in rad or the new depth in m."""
        steps = torch.arange(self.push.shape[1])
        return torch.where(steps >= self.step_index[:, None], self.target[:, None], 0.0)

    def repeat(self, times: int) -> HeadingStepBatch:
        """Return the same flights several times, one block after the other."""

        def repeat_rows(values: Tensor) -> Tensor:
            return values.repeat(times, *[1] * (values.dim() - 1))

        attributes = vars(self)
        tensors: dict[str, Any] = {
            name: repeat_rows(part) for name, part in attributes.items() if isinstance(part, Tensor)
        }
        weather = {name: repeat_rows(values) for name, values in self.weather.items()}
        return replace(self, **tensors, weather=weather)


QUANTITIES = {"cost": "s", "time_outside": "s", "overshoot": "rad", "travel": "rad", "iae": "rad s"}
"""Of a flight, with units: the cost, its three parts, and the integral of the absolute error."""

Compiler = Callable[[Rollout, Tensor, Tensor, Tensor], FreeRun]
"""Makes the flights of a closed loop quick, given examples of what they are flown with; it raises
ExportError where it cannot."""


@final
class NoisyDelayedLoop(Source):
    """A controller that sees through noisy sensors and whose commands arrive late.

    Given inputs [B, m + 3 + k]: those of the vessel, then push, reference, the delay in steps, and
    noise on what is measured, heading and yaw rate. It returns [B, m + 2]: the inputs that act, the
    push, and the command as it was issued. Its memory holds the last commands, then that of the
    controller.

    Args:
        measured_columns: of what is measured in the state, k of them.
        n_inputs: number m of the vessel's inputs.
        max_delay: delay in steps that the memory holds.
    """

    def __init__(
        self, policy: Policy, measured_columns: tuple[int, ...], n_inputs: int, max_delay: int
    ) -> None:
        super().__init__()
        self.policy = policy
        self.measured_columns = list(measured_columns)
        self.n_inputs = n_inputs
        self.max_delay = max_delay

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory at the start: rudder amidships for as long as commands may take."""
        pending_commands = torch.zeros(x.shape[0], self.max_delay, dtype=x.dtype)
        return torch.cat((pending_commands, self.policy.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        m = self.n_inputs
        push, reference, delay = w[:, m : m + 3].split(1, dim=1)
        measurement_noise = torch.zeros_like(x)
        for k, column in enumerate(self.measured_columns):
            measurement_noise[:, column : column + 1] = w[:, m + 3 + k : m + 4 + k]
        command, s = self.policy(x + measurement_noise, reference, memory[:, self.max_delay :])
        pending_commands = torch.cat((command, memory[:, : self.max_delay]), dim=1)
        delayed_command = pending_commands.gather(1, delay.to(torch.int64))
        applied_inputs = torch.cat((delayed_command, w[:, 1:m], push, command), dim=1)
        return applied_inputs, torch.cat((pending_commands[:, : self.max_delay], s), dim=1)


@dataclass(frozen=True)
class ClosedLoopTrajectories:
    """B changes of heading, or of depth, of T steps as they were flown.

    Attributes:
        states: [B, T+1, nx].
        command: rudder command [B, T] in rad, as it was issued.
        target: the new reference [B] in rad, or in m of depth.
        dt: step in s.
        names: of the states.
        axis: that is steered.
        step_index: number [B] of the step at which the reference jumps.
        n_counted: number of samples that count, from the jump on.
    """

    states: Tensor
    command: Tensor
    target: Tensor
    dt: float
    names: tuple[str, ...]
    axis: Axis
    step_index: Tensor
    n_counted: int

    def state(self, name: str) -> Tensor:
        """Return a state [B, T+1] by its name."""
        return self.states[:, :, self.names.index(name)]

    @cached_property
    def error(self) -> Tensor:
        """New heading less heading [B, T+1] in rad, wrapped, or new depth less depth in m."""
        difference = self.target[:, None] - self.state(self.axis.value)
        return wrap_angle(difference) if self.axis.value == self.axis.angle else difference

    def is_after_step(self, n_steps: int) -> Tensor:
        """Return which samples [B, T+1] are so many steps behind the jump, or more."""
        return torch.arange(self.states.shape[1]) >= self.step_index[:, None] + n_steps

    @cached_property
    def counted_mask(self) -> Tensor:
        """Which samples [B, T+1] count, as ones and zeros."""
        return (self.is_after_step(0) & ~self.is_after_step(self.n_counted)).to(self.states.dtype)

    def settling_time(self, band: float) -> Tensor:
        """Return the time [B] in s of the last entry into +-band [rad] about the reference.

        It lies between samples along a straight line; it is the flight's length where it ends
        outside.
        """
        absolute_error = self.error.abs()
        is_outside = ~(absolute_error <= band)
        steps_inside = is_outside.flip(1).to(torch.int64).argmax(1)
        last_outside = (absolute_error.shape[1] - 1 - steps_inside).unsqueeze(1)
        error_before, error_after = (
            absolute_error.gather(1, k.clamp(max=absolute_error.shape[1] - 1))[:, 0]
            for k in (last_outside, last_outside + 1)
        )
        fraction = torch.where(
            steps_inside > 0,
            (error_before - band) / (error_before - error_after).clamp(min=1e-12),
            0.0,
        )
        return torch.where(is_outside.any(1), last_outside[:, 0] + fraction, 0.0) * self.dt

    def overshoot(self) -> Tensor:
        """Return the largest heading beyond the reference [B] in rad; zero where there is none."""
        signed_overshoot = -self.error * self.target.sign()[:, None]
        # plus zero: no negative zero is shown
        return (signed_overshoot * self.counted_mask).amax(1).clamp(min=0.0) + 0.0

    def integrated_absolute_error(self) -> Tensor:
        """Return the integral of |error| [B] in rad s."""
        return (self.error.abs() * self.counted_mask)[:, :-1].sum(1) * self.dt

    def rudder_travel(self) -> Tensor:
        """Return how far the rudder command travels [B] in rad, from amidships on."""
        command_change = torch.diff(
            self.command, dim=1, prepend=torch.zeros_like(self.command[:, :1])
        )
        return (command_change.abs() * self.counted_mask[:, :-1]).sum(1)

    def control_effort(self) -> Tensor:
        """Return the integral of the squared rudder command [B] in rad^2 s: the control energy."""
        return self.command.square().sum(1) * self.dt

    def peak_to_peak(self, start_time: float) -> tuple[Tensor, Tensor]:
        """Return how far heading [rad] or depth [m] and command [rad] move, peak to peak, [B].

        Args:
            start_time: time in s from the change of heading on, up to the flight's end.
        """
        late_mask = self.is_after_step(round(start_time / self.dt))[:, :-1]

        def peak_to_peak_range(values: Tensor) -> Tensor:
            maximum = torch.where(late_mask, values, -torch.inf).amax(1)
            return maximum - torch.where(late_mask, values, torch.inf).amin(1)

        return peak_to_peak_range(self.state(self.axis.value)[:, :-1]), peak_to_peak_range(
            self.command
        )

    def late_command_variance(self, share: float) -> Tensor:
        """Return the variance of the rudder command [B] in rad^2 in the last share of what counts.

        What counts is the time from the change on that the cost is of.
        """
        late_mask = (self.counted_mask * self.is_after_step(round((1.0 - share) * self.n_counted)))[
            :, :-1
        ]
        n_late = late_mask.sum(1, keepdim=True).clamp(min=1)
        mean = (self.command * late_mask).sum(1, keepdim=True) / n_late
        return ((self.command - mean).square() * late_mask).sum(1) / n_late[:, 0]

    def step_metrics(self, conditions: ConditionsConfig) -> dict[str, Tensor]:
        """Return each of `QUANTITIES` by flight, [B]; what is no number is left so."""
        band = (conditions.depth or conditions).band
        absolute_error = self.error.abs()
        overshoot = self.overshoot()
        travel = self.rudder_travel()
        time_outside = (self.counted_mask * absolute_error / (absolute_error + band))[:, :-1].sum(
            1
        ) * self.dt
        cost = (
            time_outside
            + conditions.overshoot_weight / conditions.overshoot_unit * overshoot
            + conditions.travel_weight / _DEGREE * travel
        )
        values = (cost, time_outside, overshoot, travel, self.integrated_absolute_error())
        return dict(zip(QUANTITIES, values, strict=True))


def simulate_heading_steps(
    vessel: SteeredVessel,
    policy: Policy,
    target: Tensor,
    variation: Tensor,
    *,
    dt: float,
    duration: float,
    weather: Mapping[str, float | Tensor] | None = None,
    wrap_source: Callable[[Source], Source] | None = None,
) -> ClosedLoopTrajectories:
    """Return the flights of heading changes [B] in rad from straight ahead, without gradients.

    The vessels are varied by [B, 3]; all is float64, and counts from the first sample to the last.

    Args:
        weather: exogenous inputs by name, SI, for all rows or [B].
        wrap_source: what adds to the inputs of the closed loop, for example waves.
    """
    target = target.double()
    variation = variation.double()
    x, w = vessel.straight_course(torch.ones_like(target))
    for name, value in (weather or {}).items():
        w[:, vessel.inputs.index(name)] = value
    steps = round(duration / dt)
    loop: Source = ReferenceInInputs(policy.double(), w.shape[1])
    rollout_inputs = torch.cat((w, target[:, None]), dim=1).unsqueeze(1).expand(-1, steps, -1)
    with torch.no_grad():
        rollout = Rollout(vessel.model(dt), loop if wrap_source is None else wrap_source(loop))
        states, inputs, _ = compile_rollout(rollout, steps)(x, rollout_inputs, vessel.memory(variation))
    step_index = torch.zeros(len(target), dtype=torch.int64)
    return ClosedLoopTrajectories(
        states, inputs[:, :, 0], target, dt, vessel.state, vessel.axis, step_index, steps + 1
    )


@final
class ClosedLoopSimulation:
    """A vessel and a controller ready to fly heading changes at one step.

    Args:
        dt: step in s.
        compiler: of flights without gradients; None to fly them as they are, as are those that it
            cannot compile.
        max_delay: delay in steps that there is room for; None for that of each call's changes.
    """

    def __init__(
        self,
        vessel: SteeredVessel,
        policy: Policy,
        dt: float,
        integrator: str = "rk4",
        dtype: torch.dtype = torch.float64,
        compiler: Compiler | None = None,
        max_delay: int | None = None,
    ) -> None:
        self.vessel = vessel
        self.dtype = dtype
        self.dt = dt
        self.measured_columns = tuple(map(vessel.state_column, vessel.axis.measured))
        self.policy = policy
        self.compiler = compiler
        self.max_delay = max_delay
        self._compiled_rollouts: dict[int, FreeRun] = {}
        self.model = PushedSteering(vessel.model(dt, integrator), len(vessel.inputs))
        self.model.to(dtype).requires_grad_(False)

    def rollout(self, max_delay: int) -> Rollout:
        """Return the closed loop, with room for delays of so many steps."""
        loop = NoisyDelayedLoop(
            self.policy, self.measured_columns, len(self.vessel.inputs), max_delay
        )
        return Rollout(self.model, loop)

    def rollout_arguments(self, changes: HeadingStepBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Return states [B, nx], inputs [B, T, m + 3 + k] and the vessel's memory for a rollout."""
        rows, steps = changes.push.shape
        x, w = self.vessel.straight_course(torch.ones(rows, dtype=self.dtype))
        for name, value in changes.weather.items():
            w[:, self.vessel.inputs.index(name)] = value.to(self.dtype)
        delay_columns = changes.delay_steps[:, None].expand(-1, steps)
        extra_inputs = torch.stack((changes.push, changes.reference(), delay_columns), dim=2)
        input_parts = (w.unsqueeze(1).expand(-1, steps, -1), extra_inputs, changes.noise)
        inputs = torch.cat([part.to(self.dtype) for part in input_parts], dim=2)
        return x, inputs, self.vessel.memory(changes.vessel_variation.to(self.dtype))

    def to_trajectories(
        self, changes: HeadingStepBatch, states: Tensor, inputs: Tensor
    ) -> ClosedLoopTrajectories:
        """Return what a rollout gave: states [B, T+1, nx] and inputs [B, T, m + 2]."""
        vessel = self.vessel
        target = changes.target
        trajectory_fields = (vessel.state, vessel.axis, changes.step_index, changes.n_counted)
        return ClosedLoopTrajectories(
            states, inputs[:, :, -1], target, changes.dt, *trajectory_fields
        )

    def simulate(self, changes: HeadingStepBatch) -> ClosedLoopTrajectories:
        """Fly heading changes without gradients."""
        max_delay = self.max_delay or max(int(changes.delay_steps.max()), 1)
        arguments = self.rollout_arguments(changes)
        with torch.no_grad():
            if max_delay not in self._compiled_rollouts:
                x, w, s = (part[:2] for part in arguments)
                self._compiled_rollouts[max_delay] = compile_or_fallback(
                    self.rollout(max_delay), self.compiler, (x, w, s)
                )
            return self.to_trajectories(
                changes, *self._compiled_rollouts[max_delay](*arguments)[:2]
            )


def compile_or_fallback(
    rollout: Rollout,
    compiler: Compiler | None,
    example_arguments: tuple[Tensor, Tensor, Tensor],
    on_failure: Callable[[ExportError], None] = lambda error: None,
) -> FreeRun:
    """Return the flights of a closed loop, compiled where a compiler is given and works.

    Args:
        compiler: None to fly as it is.
        example_arguments: states, inputs and memory that it is flown with, an example of two rows.
        on_failure: is told why a loop is not compiled.
    """
    if compiler is not None:
        try:
            return compiler(rollout, *example_arguments)
        except ExportError as error:
            on_failure(error)
    return rollout


_SETTLED_TIME_FACTOR = 10.0 / 7.0
_OBSERVED_TIME_FACTOR = 5.0 / 7.0
"""Multiples of what the cost counts: after that time a flight without noise is looked at for
swinging, for that long (with 14 s from 20 s on, for 10 s).
"""
_N_NOMINAL = 16
"""Flights of the nominal vessel beside those under conditions, half to each side."""


def noise_free(conditions: ConditionsConfig) -> ConditionsConfig:
    """Return the conditions without noise, waves and slow push, with time enough to settle."""
    return conditions.model_copy(
        update={
            "noise_psi": 0.0,
            "noise_r": 0.0,
            "push": 0.0,
            "waves": 0.0,
            "hold": 0.0,
            "duration": settled_time(conditions.duration)
            + _OBSERVED_TIME_FACTOR * conditions.duration,
        }
    )


def settled_time(duration: float) -> float:
    """Return the time in s after a change from which nothing should swing.

    `duration` is the time in s that the cost counts.
    """
    return _SETTLED_TIME_FACTOR * duration


class DepthLimits(Config):
    """What a depth policy must keep to beside the planes' swing, in m.

    Attributes:
        swing: largest movement of the depth, peak to peak, once a change is long over.
        overshoot: largest of the nominal vessel without delay and bias.
        overshoot_p95: that one flight in twenty may exceed under the conditions.
    """

    swing: Metres = Field(default=0.02, gt=0)
    overshoot: Metres = Field(default=0.1, gt=0)
    overshoot_p95: Metres = Field(default=0.3, gt=0)


class SteadinessLimits(Config):
    """What a policy must keep to without noise and slow push, for an epoch of training to be taken.

    The defaults are a fifth below 0.2 deg of heading, 1 deg of rudder, 0.15 deg of overshoot, and
    0.6 deg that one flight in twenty may exceed, since other flights judge the policy than those
    that choose the epoch.

    Attributes:
        heading_swing: largest movement of the heading in rad, peak to peak, once a change is long
            over: from ten sevenths of the conditions' duration on, 20 s with 14 s.
        rudder_swing: largest movement of the rudder command in rad then, peak to peak.
        overshoot: largest overshoot in rad of the nominal vessel without delay and bias, over
            changes of heading of all sizes.
        overshoot_p95: overshoot in rad that one flight in twenty may exceed under the conditions,
            noise and slow push included.
        depth: what stands for those of heading where the depth is changed.
        flights: under the conditions that are looked at for swinging; half of them at corners of
            the spread.
    """

    depth: DepthLimits = DepthLimits()
    heading_swing: Radians = Field(default=0.002792526803190927, gt=0)
    rudder_swing: Radians = Field(default=0.013962634015954637, gt=0)
    overshoot: Radians = Field(default=0.0020943951023931953, gt=0)
    overshoot_p95: Radians = Field(default=0.008377580409572781, gt=0)
    flights: int = Field(default=256, ge=2, le=1_000_000)

    def limits_for(self, axis: Axis) -> tuple[float, float, float]:
        """Return the largest swing, overshoot and 95th percentile of it, in rad or m."""
        if axis is DEPTH:
            return self.depth.swing, self.depth.overshoot, self.depth.overshoot_p95
        return self.heading_swing, self.overshoot, self.overshoot_p95


@final
class LimitCycleTest:
    """Counts flights without noise that a policy should not make; no training sees them.

    Args:
        conditions: with noise, those of the training.

    Attributes:
        n_simulations: number of all, those of the nominal vessel included.
    """

    def __init__(self, limits: SteadinessLimits, conditions: ConditionsConfig, seed: int) -> None:
        self.limits = limits
        self.settled_time = settled_time(conditions.duration)
        self.conditions = noise_free(conditions)
        generator = torch.Generator().manual_seed(seed)
        sampled_steps = self.conditions.sample_steps(
            limits.flights + _N_NOMINAL, conditions.dt, generator
        )
        # a loop swings first where delay, K and T are at their bounds, which few draws come near
        sampled_steps = self.conditions.with_corner_rows(
            sampled_steps, limits.flights // 2, generator
        )
        targets = sampled_steps.target.clone()
        step_signs = torch.tensor([1.0, -1.0]).repeat(_N_NOMINAL // 2)
        targets[limits.flights :] = step_signs * torch.linspace(*conditions.step_range, _N_NOMINAL)
        self.changes = with_nominal_rows(
            replace(sampled_steps, target=targets), limits.flights, _N_NOMINAL
        )
        self.n_simulations = limits.flights + _N_NOMINAL

    def count_failures(self, simulation: ClosedLoopSimulation) -> int:
        """Return how many flights swing, or overshoot on the nominal vessel."""
        trajectories = simulation.simulate(self.changes)
        axis_swing, rudder_swing = trajectories.peak_to_peak(self.settled_time)
        limits = self.limits
        n_varied = self.limits.flights
        max_swing, max_overshoot, _ = limits.limits_for(trajectories.axis)
        overshoots = trajectories.step_metrics(self.conditions)["overshoot"]
        # what is no number is not within its limit
        is_steady = (axis_swing <= max_swing) & (rudder_swing <= limits.rudder_swing)
        is_steady[n_varied:] &= overshoots[n_varied:] <= max_overshoot
        return int((~is_steady).sum())


def count_excess_overshoots(overshoot: Tensor, limit: float) -> int:
    """Return how many flights more than one in twenty overshoot by more than a limit.

    Args:
        overshoot: of flights under the conditions in rad, [N]; what is no number is beyond.
        limit: in rad.
    """
    n_beyond = int((~(overshoot <= limit)).sum())
    return max(n_beyond - len(overshoot) // 20, 0)


def with_nominal_rows(changes: HeadingStepBatch, first_row: int, n_rows: int) -> HeadingStepBatch:
    """Return changes of which some rows fly the nominal vessel in calm water, without delay."""

    def replace_rows(values: Tensor, nominal_values: Tensor | float) -> Tensor:
        values = values.clone()
        values[first_row : first_row + n_rows] = nominal_values
        return values

    return replace(
        changes,
        vessel_variation=replace_rows(changes.vessel_variation, torch.tensor([1.0, 1.0, 0.0])),
        delay_steps=replace_rows(changes.delay_steps, 0.0),
        weather={name: replace_rows(values, 0.0) for name, values in changes.weather.items()},
    )


_BATCH_SIZE = 4096
"""Flights that are flown side by side."""
_DIVERGED_COST = 1e3
"""Cost in s of a flight that is lost, far above that of any other."""


class TuningConfig(Config):
    """Settings of the search for the parameters of classical controllers.

    Attributes:
        flights: that every candidate flies, the same for all.
        population: candidates of a generation per parameter.
        generations: at most.
        tolerance: the search ends where the costs of a generation differ by less than this share.
    """

    flights: int = Field(default=64, ge=2, le=1_000_000)
    population: int = Field(default=8, ge=2, le=10_000)
    generations: int = Field(default=25, ge=1, le=10_000)
    tolerance: float = Field(default=1e-4, ge=0)


@dataclass(frozen=True)
class TuningResult:
    """Tuned parameters, their mean cost [s] over the tuning flights, and the candidates tried."""

    parameters: dict[str, float]
    cost: float
    n_candidates: int


def tune_parameters(
    config: TunableConfig,
    task: ControlTask,
    conditions: ConditionsConfig,
    settings: TuningConfig,
    seed: int,
    compiler: type[CompiledRollout] | None = None,
) -> TuningResult:
    """Return the missing parameters of least mean cost, by differential evolution.

    What a law may do without is searched with and without it. `compiler` makes the flights of the
    search quick.

    Source: R. Storn and K. Price, 1997; scipy's implementation, over the logarithms.

    Raises:
        FitError: where no candidate gives a finite cost.
    """
    # scipy.optimize takes a third of a second to import
    from scipy.optimize import differential_evolution

    generator = torch.Generator().manual_seed(seed)
    steps = conditions.sample_steps(settings.flights, conditions.dt, generator)
    parameters = config.parameter_values()
    fixed = {name: value for name, value in parameters.items() if value is not None}
    names = [name for name, value in parameters.items() if value is None]
    task = task._replace(dt=conditions.dt)
    evaluation = CandidateEvaluation(config, task, conditions, steps, compiler)

    def costs(points: np.ndarray, /) -> Any:
        candidate_values = torch.from_numpy(np.exp(points.reshape(len(names), -1).T))
        candidates = {name: candidate_values[:, j] for j, name in enumerate(names)}
        candidates |= {
            name: torch.full((len(candidate_values),), value, dtype=torch.float64)
            for name, value in fixed.items()
        }
        return evaluation.mean_costs(candidates).numpy()

    if not names:
        fixed_candidate = {name: torch.tensor([value]).double() for name, value in fixed.items()}
        return TuningResult(fixed, float(evaluation.mean_costs(fixed_candidate)[0]), 1)
    axes = config.search_ranges(task.nomoto)
    bounds: Any = [(math.log(axes[name].lower), math.log(axes[name].upper)) for name in names]
    result_de = differential_evolution(
        costs,
        bounds,
        vectorized=True,
        updating="deferred",
        popsize=settings.population,
        maxiter=settings.generations,
        tol=settings.tolerance,
        init="sobol",
        polish=False,
        rng=seed,
    )
    if not result_de.fun < _DIVERGED_COST:
        raise FitError(
            f"no {config.model_dump()['kind']} controller of {result_de.nfev} tried holds the vessel"
            " under these conditions; widen the rudder's limit or narrow the conditions"
        )
    best_parameters = dict(zip(names, (math.exp(value) for value in result_de.x), strict=True))
    ordered_parameters = {
        name: best_parameters.get(name, fixed.get(name, 0.0)) for name in parameters
    }
    tuned = TuningResult(ordered_parameters, float(result_de.fun), int(result_de.nfev))
    if not (
        disabled_parameters := {
            name: disabled for name in names if (disabled := axes[name].disabled_value) is not None
        }
    ):
        return tuned
    simpler_result = tune_parameters(
        config.with_parameters(disabled_parameters), task, conditions, settings, seed, compiler
    )
    return min(tuned, simpler_result, key=lambda each: each.cost)


@final
class CandidateEvaluation:
    """Flights of candidates for the parameters of a controller, all over the same changes.

    Args:
        task: its task, at the step of the changes.
        conditions: with the cost.
        compiler: of the flights; None to fly them as they are.
    """

    def __init__(
        self,
        config: TunableConfig,
        task: ControlTask,
        conditions: ConditionsConfig,
        steps: HeadingStepBatch,
        compiler: type[CompiledRollout] | None = None,
    ) -> None:
        self.config = config
        self.task = task
        self.conditions = conditions
        self.steps = steps
        self.compiler = compiler
        self.compiled_rollout: CompiledRollout | None = None
        self.cached_arguments: dict[
            int, tuple[HeadingStepBatch, tuple[Tensor, Tensor, Tensor]]
        ] = {}

    def mean_costs(self, candidates: dict[str, Tensor]) -> Tensor:
        """Return the mean cost [C] in s of candidates, parameters [C] by name.

        One that diverges costs a thousand seconds.
        """
        n_simulations = len(self.steps.target)
        n_total = len(next(iter(candidates.values())))
        candidates_per_batch = max(_BATCH_SIZE // n_simulations, 1)
        costs_found = []
        for first_candidate in range(0, n_total, candidates_per_batch):
            candidate_batch = {
                name: values[first_candidate : first_candidate + candidates_per_batch]
                for name, values in candidates.items()
            }
            n_candidates = len(next(iter(candidate_batch.values())))
            row_parameters = {
                name: values.repeat_interleave(n_simulations)
                for name, values in candidate_batch.items()
            }
            trajectories = self._simulate_candidates(row_parameters, n_candidates)
            cost = trajectories.step_metrics(self.conditions)["cost"].reshape(
                n_candidates, n_simulations
            )
            costs_found.append(
                cost.double()
                .nan_to_num(_DIVERGED_COST, _DIVERGED_COST)
                .clamp(max=_DIVERGED_COST)
                .mean(1)
            )
        return torch.cat(costs_found)

    def _simulate_candidates(
        self, row_parameters: dict[str, Tensor], n_candidates: int
    ) -> ClosedLoopTrajectories:
        policy = self.config.build_batched(row_parameters, self.task).float().requires_grad_(False)
        simulation = ClosedLoopSimulation(
            self.task.vessel, policy, self.steps.dt, "heun", torch.float32
        )
        if n_candidates not in self.cached_arguments:
            repeated_steps = self.steps.repeat(n_candidates)
            x, w, s = simulation.rollout_arguments(repeated_steps)
            # rows next to each other in memory, as the compiled flights take them
            self.cached_arguments[n_candidates] = (
                repeated_steps,
                (x, w.permute(1, 2, 0).contiguous().permute(2, 0, 1), s),
            )
        steps, arguments = self.cached_arguments[n_candidates]
        if self.compiler is None:
            return simulation.simulate(steps)
        rollout = simulation.rollout(max(int(steps.delay_steps.max()), 1))
        try:
            if self.compiled_rollout is None:
                per_row_names = [f"source.policy.{name}" for name in self.config.batched_parameters]
                self.compiled_rollout = self.compiler(rollout, *arguments, row_tensors=per_row_names)
        except ExportError:
            # what cannot be compiled is flown as it is
            self.compiler = None
            return simulation.simulate(steps)
        return simulation.to_trajectories(steps, *self.compiled_rollout.with_rollout(rollout)(*arguments)[:2])

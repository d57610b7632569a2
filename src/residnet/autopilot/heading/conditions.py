"""Operating conditions under which heading controllers are tuned, trained and evaluated.

A simulation is a step change of the reference with a random vessel, delay and disturbances. The
cost of a simulation weighs heading error, overshoot and rudder travel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.autopilot.base import Policy, ReferenceInInputs
from residnet.autopilot.heading.steering_variation import DEPTH, HEADING, Axis, PushedSteering
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, RadiansPerSecond, Seconds
from residnet.core.errors import ExportError
from residnet.core.frames import wrap_angle
from residnet.dynamics.time_steps import check_steps
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import FreeRun, Rollout, Source
from residnet.physics.environment_config import JonswapSpectrumConfig

if TYPE_CHECKING:
    pass


Range = Annotated[tuple[float, float], Field(description="low and high multiple")]
_N_WAVE_COMPONENTS = 12
"""Number of sine components of the simulated wave-frequency motion."""


class DepthStepConfig(Config):
    """Step changes of the depth reference, which replace the heading changes.

    Attributes:
        change: smallest and largest change in m, in both directions.
        band: depth error in m whose cost rate is half of the largest one.
        noise: standard deviation of the white measurement noise of the depth in m.
    """

    change: tuple[Metres, Metres] = (1.0, 5.0)
    band: Metres = Field(default=0.1, gt=0)
    noise: Metres = Field(default=0.02, ge=0)


_DEPTH_UNIT = 0.1
"""Depth in m that is weighted like one degree of heading; the ratio of the default bands."""
_DEGREE = math.pi / 180.0
"""One degree in rad."""


class ConditionsConfig(Config):
    """Random operating conditions of heading changes, and the cost of a change.

    Each simulation draws a vessel, a delay, disturbances and a change of heading. The controller
    first holds the initial course; the reference then steps at a random time, without a prefilter.
    The cost is computed from the step on: the integral of |e| / (|e| + band) in s, plus
    `overshoot_weight` times the overshoot in deg, plus `travel_weight` times the travel of the
    rudder command in deg, where e is the true heading error. With `depth` the stern planes control
    the depth: 0.1 m of overshoot is weighted like one degree, heave and pitch replace sway and yaw,
    and pitch and pitch rate replace the measured heading and yaw rate.

    Attributes:
        depth: changes of depth; null for changes of heading.
        effect: smallest and largest rudder effectiveness as a multiple of the nominal one (K of
            Nomoto's model).
        time: smallest and largest time constant of sway and yaw as a multiple of the nominal one (T
            of Nomoto's model).
        delay: shortest and longest delay in s between a command and the steering gear.
        bias: largest constant rudder offset in rad.
        push: standard deviation of a slow yaw moment, as an equivalent rudder angle in rad; a
            Gauss-Markov process.
        push_time: correlation time of that process in s.
        noise_psi: standard deviation of the white measurement noise of the heading in rad.
        noise_r: standard deviation of the white measurement noise of the yaw rate in rad/s.
        heading: smallest and largest change of heading in rad, to both sides.
        hold: longest time in s before the change of the reference.
        duration: time in s over which the cost is computed, from the change on.
        wind: smallest and largest wind speed in m/s, from a random direction; null for no wind.
        current: largest current speed in m/s, in a random direction.
        waves: largest standard deviation in rad of the wave-frequency heading motion, which is
            drawn uniformly from zero on. The measurements contain this motion. The error in the
            cost does not, because no rudder can compensate it.
        wave_period: shortest and longest peak period in s of that motion (JONSWAP spectrum).
        dt: time step of vessel, sensors and controllers in s. A simulation with another step, as in
            training, scales the noise so that its spectral density is the same.
        band: heading error in rad whose cost rate is half of the largest one.
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
        # limits that keep a simulation meaningful, beyond the types of the fields
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
                raise ValueError(
                    "waves: they affect the measured heading only; set them to zero with `depth`"
                )
        check_steps(self.hold + self.duration, self.dt)
        if self.wind is not None:
            ranges["wind"] = (*self.wind, 0.0, 60.0)
        for name, (lower, upper, lower_limit, upper_limit) in ranges.items():
            if not lower_limit <= lower <= upper <= upper_limit:
                raise ValueError(
                    f"{name}: low and high must be in order and within {lower_limit:g} and"
                    f" {upper_limit:g},"
                    f" given {lower:g}, {upper:g}"
                )
        return self

    @property
    def axis(self) -> Axis:
        """The controlled axis: heading or depth."""
        return HEADING if self.depth is None else DEPTH

    @property
    def step_range(self) -> tuple[float, float]:
        """Smallest and largest change in rad, or in m of depth."""
        return self.heading if self.depth is None else self.depth.change

    @property
    def overshoot_unit(self) -> float:
        """Unit of overshoot that `overshoot_weight` refers to: one degree in rad, or 0.1 m."""
        return _DEGREE if self.depth is None else _DEPTH_UNIT

    @property
    def has_weather(self) -> bool:
        """Whether there is wind or current."""
        return self.wind is not None or self.current > 0

    def required_inputs(self) -> tuple[str, ...]:
        """Return the inputs that a vessel needs to be simulated under these conditions."""
        return (
            *(("wind_speed", "wind_dir") if self.wind is not None else ()),
            *(("current_north", "current_east") if self.current > 0 else ()),
        )

    def sample_steps(
        self, rows: int, dt: float, generator: torch.Generator, share: float = 1.0
    ) -> HeadingStepBatch:
        """Draw random heading changes, float32.

        Args:
            rows: number of simulations B.
            dt: time step in s.
            generator: random generator.
            share: factor on all deviations from the nominal vessel in calm water, 0 to 1.
        """

        def sample_uniform(lower: float, upper: float) -> Tensor:
            return lower + (upper - lower) * torch.rand(rows, generator=generator)

        hold_steps = round(self.hold / dt)
        steps = hold_steps + round(self.duration / dt)
        # white noise of equal spectral density: the variance is proportional to 1 / dt
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
            # drawn last, so that all other random numbers are the same with and without waves
            noise_level = sample_uniform(0.0, share * self.waves)
            period = sample_uniform(*self.wave_period)
            noise += noise_level[:, None, None] * sample_wave_motion(period, steps, dt, generator)
        return changes

    def with_corner_rows(
        self, changes: HeadingStepBatch, rows: int, generator: torch.Generator, share: float = 1.0
    ) -> HeadingStepBatch:
        """Replace vessel and delay of the first rows by corners of their ranges.

        Args:
            changes: batch of heading changes.
            rows: number of rows to replace.
            generator: random generator.
            share: factor on all deviations from the nominal vessel, as in `sample_steps`.
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
    """Simulate wave-frequency motions of unit variance with their rates, [B, T, 2].

    Each motion is a sum of sines of random phase with a JONSWAP spectrum. It is superposed on the
    low-frequency motion (T. I. Fossen, Handbook of Marine Craft, 2011, section 8.2).

    Args:
        period: peak period in s, [B].
        steps: number of samples T.
        dt: time step in s.
        generator: random generator of the phases.
    """
    band_edges = torch.linspace(0.7, 1.8, _N_WAVE_COMPONENTS + 1)
    # a random frequency within each band: equally spaced frequencies would give a periodic motion
    band_fraction = torch.rand(len(period), _N_WAVE_COMPONENTS, generator=generator)
    ratio = band_edges[:-1] + band_fraction * torch.diff(band_edges)
    density = JonswapSpectrumConfig().spectral_density(ratio.numpy(), 1.0, 2.0 * math.pi)
    power = torch.from_numpy(density).float()
    # a sine has the variance a^2 / 2; the sum of all variances is one
    amplitude = (2.0 * power / power.sum(1, keepdim=True)).sqrt()
    omega = ratio * (2.0 * math.pi / period[:, None])
    phase = 2.0 * math.pi * torch.rand(len(period), _N_WAVE_COMPONENTS, generator=generator)
    angle = omega[:, None] * (dt * torch.arange(steps))[None, :, None] + phase[:, None]
    motion = (amplitude[:, None] * torch.cos(angle)).sum(2)
    rate = (-(amplitude * omega)[:, None] * torch.sin(angle)).sum(2)
    return torch.stack((motion, rate), dim=2)


def sample_gauss_markov(rows: int, steps: int, step: float, generator: torch.Generator) -> Tensor:
    """Simulate stationary first-order Gauss-Markov processes [B, T] of unit variance.

    Args:
        rows: number of processes B.
        steps: number of samples T.
        step: sampling interval divided by the correlation time; the discretisation is exact.
        generator: random generator.
    """
    from scipy.signal import lfilter

    decay_factor = math.exp(-step)
    white_noise = torch.randn(rows, steps, generator=generator, dtype=torch.float64).numpy()
    # the first sample has unit variance, so that the process is stationary from the start
    white_noise[:, 1:] *= math.sqrt(1.0 - decay_factor * decay_factor)
    return torch.from_numpy(lfilter([1.0], [1.0, -decay_factor], white_noise, axis=1)).float()


@dataclass(frozen=True)
class HeadingStepBatch:
    """A batch of B random changes of heading or depth over T time steps.

    Attributes:
        target: new reference [B] in rad, or in m of depth.
        step_index: time step [B] at which the reference changes.
        vessel_variation: variation of the steering [B, 3], see `steering_variation.VARIATION`.
        delay_steps: delay of the command [B] in time steps.
        push: disturbance [B, T] as a rudder angle in rad.
        noise: measurement noise of the states in `Axis.measured`, [B, T, 2 or 3], SI.
        weather: constant environmental inputs of the vessel [B] by name, SI.
        dt: time step in s.
        n_counted: number of time steps in the cost, from the change on.
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
        """Return the batch repeated `times` times along its rows, block by block."""

        def repeat_rows(values: Tensor) -> Tensor:
            return values.repeat(times, *[1] * (values.dim() - 1))

        attributes = vars(self)
        tensors: dict[str, Any] = {
            name: repeat_rows(part) for name, part in attributes.items() if isinstance(part, Tensor)
        }
        weather = {name: repeat_rows(values) for name, values in self.weather.items()}
        return replace(self, **tensors, weather=weather)


QUANTITIES = {"cost": "s", "time_outside": "s", "overshoot": "rad", "travel": "rad", "iae": "rad s"}
"""Metrics of a simulation with their units: cost, its three terms, integral of absolute error."""

Compiler = Callable[[Rollout, Tensor, Tensor, Tensor], FreeRun]
"""Compile the free runs of a closed loop for example arguments; raises ExportError if it cannot."""


@final
class NoisyDelayedLoop(Source):
    """A controller with noisy measurements and delayed commands, as the source of a rollout.

    Its inputs [B, m + 3 + k] are the vessel's inputs, the disturbance, the reference, the delay in
    time steps and the measurement noise. It returns [B, m + 2]: the applied inputs of the vessel,
    the disturbance and the undelayed command. Its memory is the queue of the last commands,
    followed by the memory of the controller.

    Args:
        policy: the controller.
        measured_columns: columns of the k measured states.
        n_inputs: number m of the vessel's inputs.
        max_delay: largest delay in time steps.
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
        """Return the initial memory: the queue of commands is zero (rudder amidships)."""
        pending_commands = torch.zeros(x.shape[0], self.max_delay, dtype=x.dtype)
        return torch.cat((pending_commands, self.policy.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        m = self.n_inputs
        push, reference, delay = w[:, m : m + 3].split(1, dim=1)
        measurement_noise = torch.zeros_like(x)
        for i, column in enumerate(self.measured_columns):
            measurement_noise[:, column : column + 1] = w[:, m + 3 + i : m + 4 + i]
        command, s = self.policy(x + measurement_noise, reference, memory[:, self.max_delay :])
        pending_commands = torch.cat((command, memory[:, : self.max_delay]), dim=1)
        # the newest command is at index 0, so that the delay in steps is the index
        delayed_command = pending_commands.gather(1, delay.to(torch.int64))
        applied_inputs = torch.cat((delayed_command, w[:, 1:m], push, command), dim=1)
        return applied_inputs, torch.cat((pending_commands[:, : self.max_delay], s), dim=1)


@dataclass(frozen=True)
class ClosedLoopTrajectories:
    """Simulated trajectories of B changes of heading or depth over T time steps.

    Attributes:
        states: states [B, T+1, nx], SI.
        command: undelayed rudder command [B, T] in rad.
        target: new reference [B] in rad, or in m of depth.
        dt: time step in s.
        names: names of the states.
        axis: controlled axis.
        step_index: time step [B] at which the reference changes.
        n_counted: number of samples in the cost, from the change on.
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
        """Error [B, T+1]: target minus heading in rad, wrapped, or target minus depth in m."""
        difference = self.target[:, None] - self.state(self.axis.value)
        return wrap_angle(difference) if self.axis.value == self.axis.angle else difference

    def is_after_step(self, n_steps: int) -> Tensor:
        """Return which samples [B, T+1] lie `n_steps` or more after the change of reference."""
        return torch.arange(self.states.shape[1]) >= self.step_index[:, None] + n_steps

    @cached_property
    def counted_mask(self) -> Tensor:
        """Mask [B, T+1] of the samples in the cost, as ones and zeros."""
        return (self.is_after_step(0) & ~self.is_after_step(self.n_counted)).to(self.states.dtype)

    def settling_time(self, band: float) -> Tensor:
        """Return the settling time [B] in s: the last entry into +-band about the reference.

        The time is interpolated linearly between samples. If the error is outside the band at the
        end, the settling time is the duration.

        Args:
            band: tolerance in rad, or in m of depth.
        """
        absolute_error = self.error.abs()
        # negated, so that NaN counts as outside
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
        """Return the overshoot beyond the reference [B] in rad or m; zero without overshoot."""
        signed_overshoot = -self.error * self.target.sign()[:, None]
        # adding zero turns -0.0 into 0.0 in reports
        return (signed_overshoot * self.counted_mask).amax(1).clamp(min=0.0) + 0.0

    def integrated_absolute_error(self) -> Tensor:
        """Return the integral of |error| [B] in rad s."""
        return (self.error.abs() * self.counted_mask)[:, :-1].sum(1) * self.dt

    def rudder_travel(self) -> Tensor:
        """Return the total variation of the rudder command [B] in rad, from amidships on."""
        command_change = torch.diff(
            self.command, dim=1, prepend=torch.zeros_like(self.command[:, :1])
        )
        return (command_change.abs() * self.counted_mask[:, :-1]).sum(1)

    def control_effort(self) -> Tensor:
        """Return the integral of the squared rudder command [B] in rad^2 s: the control energy."""
        return self.command.square().sum(1) * self.dt

    def peak_to_peak(self, start_time: float) -> tuple[Tensor, Tensor]:
        """Return the peak-to-peak range of heading [rad] or depth [m] and of the command [rad].

        Args:
            start_time: start of the evaluated interval in s after the change of reference; it ends
                with the simulation.

        Returns:
            Range of the controlled state and of the command, [B] each.
        """
        late_mask = self.is_after_step(round(start_time / self.dt))[:, :-1]

        def peak_to_peak_range(values: Tensor) -> Tensor:
            maximum = torch.where(late_mask, values, -torch.inf).amax(1)
            return maximum - torch.where(late_mask, values, torch.inf).amin(1)

        return peak_to_peak_range(self.state(self.axis.value)[:, :-1]), peak_to_peak_range(
            self.command
        )

    def late_command_variance(self, share: float) -> Tensor:
        """Return the variance of the rudder command [B] in rad^2 at the end of the cost interval.

        Args:
            share: fraction of the interval, measured from its end.
        """
        late_mask = (self.counted_mask * self.is_after_step(round((1.0 - share) * self.n_counted)))[
            :, :-1
        ]
        n_late = late_mask.sum(1, keepdim=True).clamp(min=1)
        mean = (self.command * late_mask).sum(1, keepdim=True) / n_late
        return ((self.command - mean).square() * late_mask).sum(1) / n_late[:, 0]

    def step_metrics(self, conditions: ConditionsConfig) -> dict[str, Tensor]:
        """Return each of `QUANTITIES` [B] by name; NaN of a diverged simulation is not replaced."""
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
    """Simulate heading changes from a straight course in float64, without gradients.

    The whole simulation is part of the cost interval.

    Args:
        vessel: vessel in its reference condition.
        policy: controller of the rudder.
        target: new headings [B] in rad.
        variation: variation of the steering of each vessel [B, 3].
        dt: time step in s.
        duration: duration in s.
        weather: environmental inputs by name, SI, for all rows or [B].
        wrap_source: wraps the closed loop to add to its inputs, for example waves.
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
        states, inputs, _ = compile_rollout(rollout, steps)(
            x, rollout_inputs, vessel.memory(variation)
        )
    step_index = torch.zeros(len(target), dtype=torch.int64)
    return ClosedLoopTrajectories(
        states, inputs[:, :, 0], target, dt, vessel.state, vessel.axis, step_index, steps + 1
    )


@final
class ClosedLoopSimulation:
    """Closed loop of a vessel and a controller that simulates heading changes with one time step.

    Args:
        vessel: simulated vessel.
        policy: controller of the rudder.
        dt: time step in s.
        integrator: integration method of the vessel.
        dtype: precision of the simulation.
        compiler: compiles simulations without gradients; None for none. A loop that cannot be
            compiled is simulated in torch.
        max_delay: largest delay in time steps; None for the largest delay of each batch.
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
        """Build the closed loop for delays of at most `max_delay` time steps."""
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
        """Return the trajectories of a rollout with states [B, T+1, nx], inputs [B, T, m + 2]."""
        vessel = self.vessel
        target = changes.target
        trajectory_fields = (vessel.state, vessel.axis, changes.step_index, changes.n_counted)
        return ClosedLoopTrajectories(
            states, inputs[:, :, -1], target, changes.dt, *trajectory_fields
        )

    def simulate(self, changes: HeadingStepBatch) -> ClosedLoopTrajectories:
        """Simulate heading changes without gradients."""
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
    """Compile the free runs of a closed loop, or return the loop in torch if that fails.

    Args:
        rollout: closed loop.
        compiler: None for no compilation.
        example_arguments: states, inputs and memory, an example with two rows.
        on_failure: receives the error if the loop cannot be compiled.
    """
    if compiler is not None:
        try:
            return compiler(rollout, *example_arguments)
        except ExportError as error:
            on_failure(error)
    return rollout


_SETTLED_TIME_FACTOR = 10.0 / 7.0
"""Start of the interval that is checked for limit cycles without noise, as a multiple of the cost
interval (for 14 s: from 20 s on).
"""
_OBSERVED_TIME_FACTOR = 5.0 / 7.0
"""Length of that interval, as a multiple of the cost interval (for 14 s: 10 s)."""
_N_NOMINAL = 16
"""Number of additional simulations of the nominal vessel, half of them to each side."""


def noise_free(conditions: ConditionsConfig) -> ConditionsConfig:
    """Return the conditions without noise, waves and slow disturbance, with time to settle."""
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
    """Return the time in s after a change from which the closed loop should be at a steady state.

    Args:
        duration: length of the cost interval in s.
    """
    return _SETTLED_TIME_FACTOR * duration


class AxisLimits(NamedTuple):
    """Limits of the controlled axis, in rad or in m of depth.

    Attributes:
        swing: largest peak-to-peak range in the steady state.
        overshoot: largest overshoot of the nominal vessel without delay and bias.
        overshoot_p95: largest 95th percentile of the overshoot under the conditions.
    """

    swing: float
    overshoot: float
    overshoot_p95: float


class DepthLimits(Config):
    """Limits of depth oscillation and overshoot that a depth policy must meet, in m.

    Attributes:
        swing: largest peak-to-peak range of the depth in the steady state.
        overshoot: largest overshoot of the nominal vessel without delay and bias.
        overshoot_p95: largest 95th percentile of the overshoot under the conditions.
    """

    swing: Metres = Field(default=0.02, gt=0)
    overshoot: Metres = Field(default=0.1, gt=0)
    overshoot_p95: Metres = Field(default=0.3, gt=0)


class SteadinessLimits(Config):
    """Limits of oscillation and overshoot that a policy must meet to be accepted in training.

    The defaults are 20 % below 0.2 deg of heading, 1 deg of rudder, 0.15 deg of overshoot and a
    95th percentile of 0.6 deg, because the simulations that select an epoch differ from those that
    evaluate the policy.

    Attributes:
        heading_swing: largest peak-to-peak range of the heading in rad in the steady state without
            noise, evaluated from 10/7 of the duration of the conditions on (20 s for 14 s).
        rudder_swing: largest peak-to-peak range of the rudder command in rad in that interval.
        overshoot: largest overshoot in rad of the nominal vessel without delay and bias, over
            changes of heading of all sizes.
        overshoot_p95: largest 95th percentile of the overshoot in rad under the conditions,
            including noise and slow disturbance.
        depth: the corresponding limits for changes of depth.
        flights: number of simulations without noise; half of them have vessels at corners of the
            ranges.
    """

    depth: DepthLimits = DepthLimits()
    heading_swing: Radians = Field(default=0.002792526803190927, gt=0)
    rudder_swing: Radians = Field(default=0.013962634015954637, gt=0)
    overshoot: Radians = Field(default=0.0020943951023931953, gt=0)
    overshoot_p95: Radians = Field(default=0.008377580409572781, gt=0)
    flights: int = Field(default=256, ge=2, le=1_000_000)

    def limits_for(self, axis: Axis) -> AxisLimits:
        """Return the limits of swing in m and overshoot in m for depth, or in rad for heading."""
        if axis is DEPTH:
            return AxisLimits(self.depth.swing, self.depth.overshoot, self.depth.overshoot_p95)
        return AxisLimits(self.heading_swing, self.overshoot, self.overshoot_p95)


@final
class LimitCycleTest:
    """Count noise-free simulations with limit cycles or overshoot; they are not used in training.

    Args:
        limits: limits that a simulation must meet.
        conditions: operating conditions of the training, with noise.
        seed: seed of the random simulations.

    Attributes:
        n_simulations: total number of simulations, including the nominal vessel.
    """

    def __init__(self, limits: SteadinessLimits, conditions: ConditionsConfig, seed: int) -> None:
        self.limits = limits
        self.settled_time = settled_time(conditions.duration)
        self.conditions = noise_free(conditions)
        generator = torch.Generator().manual_seed(seed)
        sampled_steps = self.conditions.sample_steps(
            limits.flights + _N_NOMINAL, conditions.dt, generator
        )
        # limit cycles appear first where delay, K and T are at their bounds, which random samples
        # rarely approach
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
        """Return the number of simulations that oscillate, or overshoot on the nominal vessel."""
        trajectories = simulation.simulate(self.changes)
        axis_swing, rudder_swing = trajectories.peak_to_peak(self.settled_time)
        limits = self.limits
        n_varied = self.limits.flights
        max_swing, max_overshoot, _ = limits.limits_for(trajectories.axis)
        overshoots = trajectories.step_metrics(self.conditions)["overshoot"]
        # NaN is not within a limit
        is_steady = (axis_swing <= max_swing) & (rudder_swing <= limits.rudder_swing)
        is_steady[n_varied:] &= overshoots[n_varied:] <= max_overshoot
        return int((~is_steady).sum())


def count_excess_overshoots(overshoot: Tensor, limit: float) -> int:
    """Return the number of overshoots above a limit, minus the accepted 5 % of all simulations.

    Args:
        overshoot: overshoot of N simulations in rad, [N]; NaN counts as above the limit.
        limit: limit in rad.
    """
    n_beyond = int((~(overshoot <= limit)).sum())
    return max(n_beyond - len(overshoot) // 20, 0)


def with_nominal_rows(changes: HeadingStepBatch, first_row: int, n_rows: int) -> HeadingStepBatch:
    """Replace `n_rows` rows from `first_row` on by the nominal vessel in calm water, undelayed."""

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

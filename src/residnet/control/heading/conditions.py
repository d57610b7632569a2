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

from residnet.control.base import Followed, Policy
from residnet.control.heading.controllers import Steering, TunableConfig
from residnet.control.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, RadiansPerSecond, Seconds
from residnet.core.errors import ExportError, FitError
from residnet.core.frames import wrap
from residnet.dynamics.free_runs import compiled
from residnet.dynamics.rollout import FreeRun, Rollout, Source
from residnet.dynamics.simulated import check_steps
from residnet.dynamics.steering_variation import DEPTH, HEADING, Axis, PushedSteering
from residnet.physics.environment import JonswapSpectrum

if TYPE_CHECKING:
    from residnet.dynamics.compiled import CompiledRollout


Range = Annotated[tuple[float, float], Field(description="low and high multiple")]
_SINES = 12
"""That a motion with the waves is made of."""


class DepthChanges(Config):
    """Changes of depth, in place of those of heading.

    Attributes:
        change: smallest and largest in m, down or up.
        band: depth error in m at which half of the cost of a large one is left.
        noise: standard deviation of white noise on the measured depth in m.
    """

    change: tuple[Metres, Metres] = (1.0, 5.0)
    band: Metres = Field(default=0.1, gt=0)
    noise: Metres = Field(default=0.02, ge=0)


_DECIMETRE, _DEGREE = 0.1, math.pi / 180.0
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

    depth: DepthChanges | None = None
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
    def _ordered(self) -> ConditionsConfig:
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
        for name, (low, high, least, most) in ranges.items():
            if not least <= low <= high <= most:
                raise ValueError(
                    f"{name}: low and high must be in order and within {least:g} and {most:g},"
                    f" given {low:g}, {high:g}"
                )
        return self

    @property
    def axis(self) -> Axis:
        """What is steered: the heading, or the depth."""
        return HEADING if self.depth is None else DEPTH

    @property
    def span(self) -> tuple[float, float]:
        """Smallest and largest change in rad, or in m of depth."""
        return self.heading if self.depth is None else self.depth.change

    @property
    def unit(self) -> float:
        """A degree in rad, or a decimetre in m, which `overshoot_weight` is for."""
        return _DEGREE if self.depth is None else _DECIMETRE

    @property
    def weather(self) -> bool:
        """Whether there is wind or current."""
        return self.wind is not None or self.current > 0

    def needs(self) -> tuple[str, ...]:
        """Return the inputs that a vessel must have to be flown under these conditions."""
        return (
            *(("wind_speed", "wind_dir") if self.wind is not None else ()),
            *(("current_north", "current_east") if self.current > 0 else ()),
        )

    def draw(
        self, rows: int, dt: float, random: torch.Generator, share: float = 1.0
    ) -> HeadingChanges:
        """Draw heading changes for a number of flights, float32.

        Args:
            dt: step in s.
            random: source of all that is drawn.
            share: part of all departures from the nominal vessel in calm water, 0 to 1.
        """

        def even(low: float, high: float) -> Tensor:
            return low + (high - low) * torch.rand(rows, generator=random)

        hold = round(self.hold / dt)
        steps = hold + round(self.duration / dt)
        scale = share * math.sqrt(self.dt / dt)
        sizes = [self.noise_psi, self.noise_r]
        sizes = sizes if self.depth is None else [self.depth.noise, *sizes]
        noise = torch.randn(rows, steps, len(sizes), generator=random)
        noise *= torch.tensor([scale * size for size in sizes])
        sign = torch.where(torch.rand(rows, generator=random) < 0.5, -1.0, 1.0)
        effect, time = (1.0 + share * (even(*values) - 1.0) for values in (self.effect, self.time))
        bias = share * even(-self.bias, self.bias)
        changes = HeadingChanges(
            heading=sign * even(*self.span),
            start=torch.randint(0, hold + 1, (rows,), generator=random),
            variation=torch.stack((effect, time, bias), dim=1),
            delay=torch.round(share * even(*self.delay) / dt),
            push=share * self.push * gauss_markov(rows, steps, dt / self.push_time, random),
            noise=noise,
            weather=self._weather(rows, random, share),
            dt=dt,
            count=steps - hold,
        )
        if self.waves > 0:
            # drawn last, so that all else is the same with waves and without
            size, period = even(0.0, share * self.waves), even(*self.wave_period)
            noise += size[:, None, None] * wave_motion(period, steps, dt, random)
        return changes

    def at_corners(
        self, changes: HeadingChanges, rows: int, random: torch.Generator, share: float = 1.0
    ) -> HeadingChanges:
        """Return changes whose first rows have vessels and delays at corners of their ranges.

        `share` is the part of all departures from the nominal vessel, as in `draw`.
        """
        variation, delay = changes.variation.clone(), changes.delay.clone()

        def either(low: float, high: float) -> Tensor:
            return torch.where(torch.rand(rows, generator=random) < 0.5, low, high)

        variation[:rows, 0] = 1.0 + share * (either(*self.effect) - 1.0)
        variation[:rows, 1] = 1.0 + share * (either(*self.time) - 1.0)
        delay[:rows] = torch.round(share * either(*self.delay) / changes.dt)
        return replace(changes, variation=variation, delay=delay)

    def _weather(self, rows: int, random: torch.Generator, share: float) -> dict[str, Tensor]:
        drawn = torch.rand(2, rows, generator=random)
        around = 2.0 * torch.pi * torch.rand(2, rows, generator=random)
        out: dict[str, Tensor] = {}
        if self.wind is not None:
            low, high = self.wind
            out["wind_speed"] = share * (low + (high - low) * drawn[0])
            out["wind_dir"] = around[0]
        if self.current > 0:
            speed = share * self.current * drawn[1]
            out["current_north"] = speed * torch.cos(around[1])
            out["current_east"] = speed * torch.sin(around[1])
        return out


def wave_motion(period: Tensor, steps: int, dt: float, random: torch.Generator) -> Tensor:
    """Return motions with the waves and their rates [B, T, 2], of unit variance before the rate.

    Each is a sum of sines of random phase with a JONSWAP spectrum: the wave-frequency motion that
    is added to the slow one (T. I. Fossen, Handbook of Marine Craft, 2011, section 8.2).

    Args:
        period: at the peak in s, [B].
        dt: step in s.
    """
    ratios = torch.linspace(0.7, 1.8, _SINES + 1)
    # somewhere within its band each, so that the sum does not repeat itself
    within = torch.rand(len(period), _SINES, generator=random)
    ratio = ratios[:-1] + within * torch.diff(ratios)
    form = JonswapSpectrum().density(ratio.numpy(), 1.0, 2.0 * math.pi)
    power = torch.from_numpy(form).float()
    amplitude = (2.0 * power / power.sum(1, keepdim=True)).sqrt()
    omega = ratio * (2.0 * math.pi / period[:, None])
    phase = 2.0 * math.pi * torch.rand(len(period), _SINES, generator=random)
    angle = omega[:, None] * (dt * torch.arange(steps))[None, :, None] + phase[:, None]
    motion = (amplitude[:, None] * torch.cos(angle)).sum(2)
    rate = (-(amplitude * omega)[:, None] * torch.sin(angle)).sum(2)
    return torch.stack((motion, rate), dim=2)


def gauss_markov(rows: int, steps: int, step: float, random: torch.Generator) -> Tensor:
    """Return stationary first-order processes [B, T] of unit variance, exact at their samples.

    `step` is the time between samples as a multiple of the correlation time.
    """
    from scipy.signal import lfilter

    keep = math.exp(-step)
    drive = torch.randn(rows, steps, generator=random, dtype=torch.float64).numpy()
    drive[:, 1:] *= math.sqrt(1.0 - keep * keep)
    return torch.from_numpy(lfilter([1.0], [1.0, -keep], drive, axis=1)).float()


@dataclass(frozen=True)
class HeadingChanges:
    """B changes of heading, or of depth, of T steps, as they were drawn.

    Attributes:
        heading: change [B] in rad, or in m of depth.
        start: number [B] of the step at which the reference jumps.
        variation: of the vessel [B, 3], `dynamics.steering_variation.VARIATION`.
        delay: of the command [B] in steps.
        push: angle [B, T] in rad that is added to the rudder's.
        noise: on what is measured of the axis (`Axis.measured`), [B, T, 2 or 3] in SI units.
        weather: constant inputs of the vessel [B] by name, SI.
        dt: step in s.
        count: number of steps that are counted, from the jump on.
    """

    heading: Tensor
    start: Tensor
    variation: Tensor
    delay: Tensor
    push: Tensor
    noise: Tensor
    weather: dict[str, Tensor]
    dt: float
    count: int

    def reference(self) -> Tensor:
        """Return the reference [B, T]: zero, then the new heading in rad or the new depth in m."""
        steps = torch.arange(self.push.shape[1])
        return torch.where(steps >= self.start[:, None], self.heading[:, None], 0.0)

    def repeated(self, times: int) -> HeadingChanges:
        """Return the same flights several times, one block after the other."""

        def more(values: Tensor) -> Tensor:
            return values.repeat(times, *[1] * (values.dim() - 1))

        given = vars(self)
        tensors: dict[str, Any] = {
            name: more(part) for name, part in given.items() if isinstance(part, Tensor)
        }
        weather = {name: more(values) for name, values in self.weather.items()}
        return replace(self, **tensors, weather=weather)


QUANTITIES = {"cost": "s", "time_outside": "s", "overshoot": "rad", "travel": "rad", "iae": "rad s"}
"""Of a flight, with units: the cost, its three parts, and the integral of the absolute error."""

Compiler = Callable[[Rollout, Tensor, Tensor, Tensor], FreeRun]
"""Makes the flights of a closed loop quick, given examples of what they are flown with; it raises
ExportError where it cannot."""


@final
class ConditionedLoop(Source):
    """A controller that sees through noisy sensors and whose commands arrive late.

    Given inputs [B, m + 3 + k]: those of the vessel, then push, reference, the delay in steps, and
    noise on what is measured, heading and yaw rate. It returns [B, m + 2]: the inputs that act, the
    push, and the command as it was issued. Its memory holds the last commands, then that of the
    controller.

    Args:
        columns: of what is measured in the state, k of them.
        inputs: number m of the vessel's inputs.
        longest: delay in steps that the memory holds.
    """

    def __init__(self, policy: Policy, columns: tuple[int, ...], inputs: int, longest: int) -> None:
        super().__init__()
        self.policy, self.columns = policy, list(columns)
        self.inputs, self.longest = inputs, longest

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory at the start: rudder amidships for as long as commands may take."""
        late = torch.zeros(x.shape[0], self.longest, dtype=x.dtype)
        return torch.cat((late, self.policy.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        m = self.inputs
        push, reference, delay = w[:, m : m + 3].split(1, dim=1)
        seen = torch.zeros_like(x)
        for k, column in enumerate(self.columns):
            seen[:, column : column + 1] = w[:, m + 3 + k : m + 4 + k]
        command, s = self.policy(x + seen, reference, memory[:, self.longest :])
        late = torch.cat((command, memory[:, : self.longest]), dim=1)
        arriving = late.gather(1, delay.to(torch.int64))
        acting = torch.cat((arriving, w[:, 1:m], push, command), dim=1)
        return acting, torch.cat((late[:, : self.longest], s), dim=1)


@dataclass(frozen=True)
class Flights:
    """B changes of heading, or of depth, of T steps as they were flown.

    Attributes:
        states: [B, T+1, nx].
        command: rudder command [B, T] in rad, as it was issued.
        heading: the new reference [B] in rad, or in m of depth.
        dt: step in s.
        names: of the states.
        axis: that is steered.
        start: number [B] of the step at which the reference jumps.
        count: number of samples that count, from the jump on.
    """

    states: Tensor
    command: Tensor
    heading: Tensor
    dt: float
    names: tuple[str, ...]
    axis: Axis
    start: Tensor
    count: int

    def state(self, name: str) -> Tensor:
        """Return a state [B, T+1] by its name."""
        return self.states[:, :, self.names.index(name)]

    @cached_property
    def error(self) -> Tensor:
        """New heading less heading [B, T+1] in rad, wrapped, or new depth less depth in m."""
        lacking = self.heading[:, None] - self.state(self.axis.value)
        return wrap(lacking) if self.axis.value == self.axis.angle else lacking

    def since(self, after: int) -> Tensor:
        """Return which samples [B, T+1] are so many steps behind the jump, or more."""
        return torch.arange(self.states.shape[1]) >= self.start[:, None] + after

    @cached_property
    def counted(self) -> Tensor:
        """Which samples [B, T+1] count, as ones and zeros."""
        return (self.since(0) & ~self.since(self.count)).to(self.states.dtype)

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
        """Return the largest heading beyond the reference [B] in rad; zero where there is none."""
        beyond = -self.error * self.heading.sign()[:, None]
        # plus zero: no negative zero is shown
        return (beyond * self.counted).amax(1).clamp(min=0.0) + 0.0

    def absolute_error(self) -> Tensor:
        """Return the integral of |error| [B] in rad s."""
        return (self.error.abs() * self.counted)[:, :-1].sum(1) * self.dt

    def travel(self) -> Tensor:
        """Return how far the rudder command travels [B] in rad, from amidships on."""
        moved = torch.diff(self.command, dim=1, prepend=torch.zeros_like(self.command[:, :1]))
        return (moved.abs() * self.counted[:, :-1]).sum(1)

    def effort(self) -> Tensor:
        """Return the integral of the squared rudder command [B] in rad^2 s: the control energy."""
        return self.command.square().sum(1) * self.dt

    def swing(self, after: float) -> tuple[Tensor, Tensor]:
        """Return how far heading [rad] or depth [m] and command [rad] move, peak to peak, [B].

        Args:
            after: time in s from the change of heading on, up to the flight's end.
        """
        late = self.since(round(after / self.dt))[:, :-1]

        def between(values: Tensor) -> Tensor:
            highest = torch.where(late, values, -torch.inf).amax(1)
            return highest - torch.where(late, values, torch.inf).amin(1)

        return between(self.state(self.axis.value)[:, :-1]), between(self.command)

    def late_swing(self, share: float) -> Tensor:
        """Return the variance of the rudder command [B] in rad^2 in the last share of what counts.

        What counts is the time from the change on that the cost is of.
        """
        late = (self.counted * self.since(round((1.0 - share) * self.count)))[:, :-1]
        number = late.sum(1, keepdim=True).clamp(min=1)
        mean = (self.command * late).sum(1, keepdim=True) / number
        return ((self.command - mean).square() * late).sum(1) / number[:, 0]

    def measured(self, conditions: ConditionsConfig) -> dict[str, Tensor]:
        """Return each of `QUANTITIES` by flight, [B]; what is no number is left so."""
        band = (conditions.depth or conditions).band
        size, overshoot, travel = self.error.abs(), self.overshoot(), self.travel()
        outside = (self.counted * size / (size + band))[:, :-1].sum(1) * self.dt
        cost = (
            outside
            + conditions.overshoot_weight / conditions.unit * overshoot
            + conditions.travel_weight / _DEGREE * travel
        )
        values = (cost, outside, overshoot, travel, self.absolute_error())
        return dict(zip(QUANTITIES, values, strict=True))


def fly(
    vessel: SteeredVessel,
    policy: Policy,
    heading: Tensor,
    variation: Tensor,
    *,
    dt: float,
    duration: float,
    weather: Mapping[str, float | Tensor] | None = None,
    surround: Callable[[Source], Source] | None = None,
) -> Flights:
    """Return the flights of heading changes [B] in rad from straight ahead, without gradients.

    The vessels are varied by [B, 3]; all is float64, and counts from the first sample to the last.

    Args:
        weather: exogenous inputs by name, SI, for all rows or [B].
        surround: what adds to the inputs of the closed loop, for example waves.
    """
    heading, variation = heading.double(), variation.double()
    x, w = vessel.start(torch.ones_like(heading))
    for name, value in (weather or {}).items():
        w[:, vessel.inputs.index(name)] = value
    steps = round(duration / dt)
    loop: Source = Followed(policy.double(), w.shape[1])
    given = torch.cat((w, heading[:, None]), dim=1).unsqueeze(1).expand(-1, steps, -1)
    with torch.no_grad():
        free = Rollout(vessel.model(dt), loop if surround is None else surround(loop))
        states, inputs, _ = compiled(free, steps)(x, given, vessel.memory(variation))
    begun = torch.zeros(len(heading), dtype=torch.int64)
    return Flights(
        states, inputs[:, :, 0], heading, dt, vessel.state, vessel.axis, begun, steps + 1
    )


@final
class ConditionedRun:
    """A vessel and a controller ready to fly heading changes at one step.

    Args:
        dt: step in s.
        compiler: of flights without gradients; None to fly them as they are, as are those that it
            cannot compile.
        longest: delay in steps that there is room for; None for that of each call's changes.
    """

    def __init__(
        self,
        vessel: SteeredVessel,
        policy: Policy,
        dt: float,
        integrator: str = "rk4",
        dtype: torch.dtype = torch.float64,
        compiler: Compiler | None = None,
        longest: int | None = None,
    ) -> None:
        self.vessel, self.dtype, self.dt = vessel, dtype, dt
        self.columns = tuple(map(vessel.column, vessel.axis.measured))
        self.policy, self.compiler, self.longest = policy, compiler, longest
        self._flying: dict[int, FreeRun] = {}
        self.model = PushedSteering(vessel.model(dt, integrator), len(vessel.inputs))
        self.model.to(dtype).requires_grad_(False)

    def rollout(self, longest: int) -> Rollout:
        """Return the closed loop, with room for delays of so many steps."""
        loop = ConditionedLoop(self.policy, self.columns, len(self.vessel.inputs), longest)
        return Rollout(self.model, loop)

    def given(self, changes: HeadingChanges) -> tuple[Tensor, Tensor, Tensor]:
        """Return states [B, nx], inputs [B, T, m + 3 + k] and the vessel's memory for a rollout."""
        rows, steps = changes.push.shape
        x, w = self.vessel.start(torch.ones(rows, dtype=self.dtype))
        for name, value in changes.weather.items():
            w[:, self.vessel.inputs.index(name)] = value.to(self.dtype)
        late = changes.delay[:, None].expand(-1, steps)
        extra = torch.stack((changes.push, changes.reference(), late), dim=2)
        parts = (w.unsqueeze(1).expand(-1, steps, -1), extra, changes.noise)
        inputs = torch.cat([part.to(self.dtype) for part in parts], dim=2)
        return x, inputs, self.vessel.memory(changes.variation.to(self.dtype))

    def flights(self, changes: HeadingChanges, states: Tensor, inputs: Tensor) -> Flights:
        """Return what a rollout gave: states [B, T+1, nx] and inputs [B, T, m + 2]."""
        vessel, new = self.vessel, changes.heading
        about = (vessel.state, vessel.axis, changes.start, changes.count)
        return Flights(states, inputs[:, :, -1], new, changes.dt, *about)

    def fly(self, changes: HeadingChanges) -> Flights:
        """Fly heading changes without gradients."""
        longest = self.longest or max(int(changes.delay.max()), 1)
        given = self.given(changes)
        with torch.no_grad():
            if longest not in self._flying:
                x, w, s = (part[:2] for part in given)
                self._flying[longest] = quickly(self.rollout(longest), self.compiler, (x, w, s))
            return self.flights(changes, *self._flying[longest](*given)[:2])


def quickly(
    rollout: Rollout,
    compiler: Compiler | None,
    given: tuple[Tensor, Tensor, Tensor],
    failed: Callable[[ExportError], None] = lambda error: None,
) -> FreeRun:
    """Return the flights of a closed loop, compiled where a compiler is given and works.

    Args:
        compiler: None to fly as it is.
        given: states, inputs and memory that it is flown with, an example of two rows.
        failed: is told why a loop is not compiled.
    """
    if compiler is not None:
        try:
            return compiler(rollout, *given)
        except ExportError as error:
            failed(error)
    return rollout


_AFTER, _FOR = 10.0 / 7.0, 5.0 / 7.0
"""Multiples of what the cost counts: after that time a flight without noise is looked at for
swinging, for that long (with 14 s from 20 s on, for 10 s).
"""
_NOMINAL = 16
"""Flights of the nominal vessel beside those under conditions, half to each side."""


def quiet(conditions: ConditionsConfig) -> ConditionsConfig:
    """Return the conditions without noise, waves and slow push, with time enough to settle."""
    return conditions.model_copy(
        update={
            "noise_psi": 0.0,
            "noise_r": 0.0,
            "push": 0.0,
            "waves": 0.0,
            "hold": 0.0,
            "duration": quiet_after(conditions.duration) + _FOR * conditions.duration,
        }
    )


def quiet_after(duration: float) -> float:
    """Return the time in s after a change from which nothing should swing.

    `duration` is the time in s that the cost counts.
    """
    return _AFTER * duration


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

    def of(self, axis: Axis) -> tuple[float, float, float]:
        """Return the largest swing, overshoot and 95th percentile of it, in rad or m."""
        if axis is DEPTH:
            return self.depth.swing, self.depth.overshoot, self.depth.overshoot_p95
        return self.heading_swing, self.overshoot, self.overshoot_p95


@final
class SteadyTest:
    """Counts flights without noise that a policy should not make; no training sees them.

    Args:
        conditions: with noise, those of the training.

    Attributes:
        flights: number of all, those of the nominal vessel included.
    """

    def __init__(self, limits: SteadinessLimits, conditions: ConditionsConfig, seed: int) -> None:
        self.limits, self.after = limits, quiet_after(conditions.duration)
        self.conditions = quiet(conditions)
        random = torch.Generator().manual_seed(seed)
        drawn = self.conditions.draw(limits.flights + _NOMINAL, conditions.dt, random)
        # a loop swings first where delay, K and T are at their bounds, which few draws come near
        drawn = self.conditions.at_corners(drawn, limits.flights // 2, random)
        heading = drawn.heading.clone()
        sides = torch.tensor([1.0, -1.0]).repeat(_NOMINAL // 2)
        heading[limits.flights :] = sides * torch.linspace(*conditions.span, _NOMINAL)
        self.changes = nominal(replace(drawn, heading=heading), limits.flights, _NOMINAL)
        self.flights = limits.flights + _NOMINAL

    def refused(self, run: ConditionedRun) -> int:
        """Return how many flights swing, or overshoot on the nominal vessel."""
        flown = run.fly(self.changes)
        heading, rudder = flown.swing(self.after)
        limits, last = self.limits, self.limits.flights
        swing, most, _ = limits.of(flown.axis)
        over = flown.measured(self.conditions)["overshoot"]
        # what is no number is not within its limit
        steady = (heading <= swing) & (rudder <= limits.rudder_swing)
        steady[last:] &= over[last:] <= most
        return int((~steady).sum())


def too_many(overshoot: Tensor, limit: float) -> int:
    """Return how many flights more than one in twenty overshoot by more than a limit.

    Args:
        overshoot: of flights under the conditions in rad, [N]; what is no number is beyond.
        limit: in rad.
    """
    beyond = int((~(overshoot <= limit)).sum())
    return max(beyond - len(overshoot) // 20, 0)


def nominal(changes: HeadingChanges, first: int, rows: int) -> HeadingChanges:
    """Return changes of which some rows fly the nominal vessel in calm water, without delay."""

    def with_rows(values: Tensor, new: Tensor | float) -> Tensor:
        values = values.clone()
        values[first : first + rows] = new
        return values

    return replace(
        changes,
        variation=with_rows(changes.variation, torch.tensor([1.0, 1.0, 0.0])),
        delay=with_rows(changes.delay, 0.0),
        weather={name: with_rows(values, 0.0) for name, values in changes.weather.items()},
    )


_ROWS = 4096
"""Flights that are flown side by side."""
_LOST = 1e3
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
    tried: int


def tune(
    config: TunableConfig,
    steering: Steering,
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

    random = torch.Generator().manual_seed(seed)
    changes = conditions.draw(settings.flights, conditions.dt, random)
    given = config.parameters()
    fixed = {name: value for name, value in given.items() if value is not None}
    names = [name for name, value in given.items() if value is None]
    steering = steering._replace(dt=conditions.dt)
    trials = Trials(config, steering, conditions, changes, compiler)

    def costs(points: np.ndarray, /) -> Any:
        searched = torch.from_numpy(np.exp(points.reshape(len(names), -1).T))
        candidates = {name: searched[:, j] for j, name in enumerate(names)}
        candidates |= {
            name: torch.full((len(searched),), value, dtype=torch.float64)
            for name, value in fixed.items()
        }
        return trials.costs(candidates).numpy()

    if not names:
        alone = {name: torch.tensor([value]).double() for name, value in fixed.items()}
        return TuningResult(fixed, float(trials.costs(alone)[0]), 1)
    axes = config.axes(steering.turning)
    bounds: Any = [(math.log(axes[name].low), math.log(axes[name].high)) for name in names]
    found = differential_evolution(
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
    if not found.fun < _LOST:
        raise FitError(
            f"no {config.model_dump()['kind']} controller of {found.nfev} tried holds the vessel"
            " under these conditions; widen the rudder's limit or narrow the conditions"
        )
    best = dict(zip(names, (math.exp(value) for value in found.x), strict=True))
    ordered = {name: best.get(name, fixed.get(name, 0.0)) for name in given}
    result = TuningResult(ordered, float(found.fun), int(found.nfev))
    if not (idle := {name: end for name in names if (end := axes[name].idle) is not None}):
        return result
    simpler = tune(config.tuned(idle), steering, conditions, settings, seed, compiler)
    return min(result, simpler, key=lambda each: each.cost)


@final
class Trials:
    """Flights of candidates for the parameters of a controller, all over the same changes.

    Args:
        steering: its task, at the step of the changes.
        conditions: with the cost.
        compiler: of the flights; None to fly them as they are.
    """

    def __init__(
        self,
        config: TunableConfig,
        steering: Steering,
        conditions: ConditionsConfig,
        changes: HeadingChanges,
        compiler: type[CompiledRollout] | None = None,
    ) -> None:
        self.config, self.steering, self.conditions = config, steering, conditions
        self.changes, self.compiler = changes, compiler
        self.loop: CompiledRollout | None = None
        self.given: dict[int, tuple[HeadingChanges, tuple[Tensor, Tensor, Tensor]]] = {}

    def costs(self, candidates: dict[str, Tensor]) -> Tensor:
        """Return the mean cost [C] in s of candidates, parameters [C] by name.

        One that diverges costs a thousand seconds.
        """
        flights = len(self.changes.heading)
        count = len(next(iter(candidates.values())))
        at_once = max(_ROWS // flights, 1)
        out = []
        for first in range(0, count, at_once):
            some = {name: values[first : first + at_once] for name, values in candidates.items()}
            size = len(next(iter(some.values())))
            rows = {name: values.repeat_interleave(flights) for name, values in some.items()}
            flown = self._flown(rows, size)
            cost = flown.measured(self.conditions)["cost"].reshape(size, flights)
            out.append(cost.double().nan_to_num(_LOST, _LOST).clamp(max=_LOST).mean(1))
        return torch.cat(out)

    def _flown(self, rows: dict[str, Tensor], size: int) -> Flights:
        policy = self.config.rows(rows, self.steering).float().requires_grad_(False)
        run = ConditionedRun(self.steering.vessel, policy, self.changes.dt, "heun", torch.float32)
        if size not in self.given:
            again = self.changes.repeated(size)
            x, w, s = run.given(again)
            # rows next to each other in memory, as the compiled flights take them
            self.given[size] = again, (x, w.permute(1, 2, 0).contiguous().permute(2, 0, 1), s)
        changes, given = self.given[size]
        if self.compiler is None:
            return run.fly(changes)
        rollout = run.rollout(max(int(changes.delay.max()), 1))
        try:
            if self.loop is None:
                own = [f"source.policy.{name}" for name in self.config.own]
                self.loop = self.compiler(rollout, *given, own=own)
        except ExportError:
            # what cannot be compiled is flown as it is
            self.compiler = None
            return run.fly(changes)
        return run.flights(changes, *self.loop.of(rollout)(*given)[:2])

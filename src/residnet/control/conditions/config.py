"""The conditions that heading controllers are tuned, trained and judged under, and their cost."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, MetresPerSecond, Radians, RadiansPerSecond, Seconds
from residnet.dynamics.simulated import check_steps
from residnet.physics.environment.waves import JonswapSpectrum

Range = Annotated[tuple[float, float], Field(description="low and high multiple")]
_EXTRA = ("push", "reference", "noise_psi", "noise_r", "delay")
"""Columns that stand behind the vessel's own inputs while flights are flown."""
_SINES = 12
"""That a motion with the waves is made of."""


class ConditionsConfig(Config):
    """The conditions of heading changes, and what a change costs.

    Each flight has a vessel, a delay, disturbances and a change of heading of its own. The vessel
    holds its course first; the reference jumps at a random time, without prefilter. The cost of a
    flight counts from the jump on: the integral of |e| / (|e| + band) in s, plus `overshoot_weight`
    times the overshoot in deg, plus `travel_weight` times the travel of the rudder command in deg;
    e is the true heading error.

    Attributes:
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
            rows: number of flights.
            dt: step in s.
            random: source of all that is drawn.
            share: part of all departures from the nominal vessel in calm water, 0 to 1.
        """

        def even(low: float, high: float) -> Tensor:
            return low + (high - low) * torch.rand(rows, generator=random)

        hold = round(self.hold / dt)
        steps = hold + round(self.duration / dt)
        scale = share * math.sqrt(self.dt / dt)
        noise = torch.randn(rows, steps, 2, generator=random) * torch.tensor(
            [scale * self.noise_psi, scale * self.noise_r]
        )
        sign = torch.where(torch.rand(rows, generator=random) < 0.5, -1.0, 1.0)
        effect, time = (1.0 + share * (even(*values) - 1.0) for values in (self.effect, self.time))
        bias = share * even(-self.bias, self.bias)
        changes = HeadingChanges(
            heading=sign * even(*self.heading),
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
        steps: number T of steps.
        dt: step in s.
        random: source of phases and frequencies.
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
    """B heading changes of T steps, as they were drawn.

    Attributes:
        heading: change [B] in rad.
        start: number [B] of the step at which the reference jumps.
        variation: of the vessel [B, 3], `dynamics.steering_variation.VARIATION`.
        delay: of the command [B] in steps.
        push: angle [B, T] in rad that is added to the rudder's.
        noise: on the measured heading and yaw rate [B, T, 2] in rad and rad/s.
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
        """Return the reference [B, T] in rad: zero, then the new heading."""
        steps = torch.arange(self.push.shape[1])
        return torch.where(steps >= self.start[:, None], self.heading[:, None], 0.0)

    def counted(self) -> Tensor:
        """Return which steps [B, T] the cost counts."""
        steps = torch.arange(self.push.shape[1])
        begin = self.start[:, None]
        return (steps >= begin) & (steps < begin + self.count)

    def repeated(self, times: int) -> HeadingChanges:
        """Return the same flights several times, one block after the other."""

        def more(values: Tensor) -> Tensor:
            return values.repeat(times, *[1] * (values.dim() - 1))

        return HeadingChanges(
            heading=more(self.heading),
            start=more(self.start),
            variation=more(self.variation),
            delay=more(self.delay),
            push=more(self.push),
            noise=more(self.noise),
            weather={name: more(values) for name, values in self.weather.items()},
            dt=self.dt,
            count=self.count,
        )

"""What surrounds a simulated vessel and what measures it: forces, current, wind, waves, sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import (
    Config,
    MetresPerSecond,
    NewtonMetres,
    Newtons,
    Quantity,
    Radians,
    RadiansPerSecond,
    Seconds,
)
from residnet.core.errors import ConfigError
from residnet.core.names import CHANNEL_UNITS, VELOCITY, WIND_INPUTS, nearest
from residnet.dynamics.rollout import Source
from residnet.physics.environment import Waves, WavesConfig
from residnet.physics.plant import Plant


class WindField(Config):
    """Mean wind with gusts.

    The gusts along and across the mean wind are independent Ornstein-Uhlenbeck processes, whose
    one-sided spectrum is the first-order form that Dryden gave the longitudinal turbulence:
    S(omega) = (2 sigma^2 T / pi) / (1 + (omega T)^2).

    Attributes:
        speed: mean true wind speed at the height of the vessel's coefficients.
        direction: where the mean wind comes FROM, clockwise from north.
        gust: standard deviation sigma of each component.
        correlation: time T of the gusts, their length over the mean speed.
    """

    speed: MetresPerSecond = Field(ge=0)
    direction: Radians
    gust: MetresPerSecond = Field(default=0.0, ge=0)
    correlation: Seconds = Field(default=10.0, gt=0)


class Disturbance(Config):
    """Random and constant forces, a constant current, wind and waves.

    Attributes:
        force_x: standard deviation of the random surge force, an Ornstein-Uhlenbeck process, in N.
        force_y: the same of the sway force in N.
        force_n: the same of the yaw moment in N m.
        correlation: correlation time of the three processes in s.
        force_north: constant force towards north in N.
        force_east: constant force towards east in N.
        current_north: current towards north in m/s.
        current_east: current towards east in m/s.
        current_speed: speed of the same current in m/s, given with its direction instead.
        current_direction: where it sets to in rad, clockwise from north.
        current_each: slowest and fastest speed in m/s of a further current that each trial has of
            its own, constant in speed and direction.
        wind: mean wind and gusts, for vessels with wind coefficients.
        waves: first-order wave forces.
    """

    force_x: Newtons = Field(default=0.0, ge=0)
    force_y: Newtons = Field(default=0.0, ge=0)
    force_n: NewtonMetres = Field(default=0.0, ge=0)
    correlation: Seconds = Field(default=5.0, gt=0)
    force_north: Newtons = 0.0
    force_east: Newtons = 0.0
    current_north: MetresPerSecond = 0.0
    current_east: MetresPerSecond = 0.0
    current_speed: MetresPerSecond | None = Field(default=None, ge=0)
    current_direction: Radians | None = None
    current_each: (
        tuple[Annotated[MetresPerSecond, Field(ge=0)], Annotated[MetresPerSecond, Field(ge=0)]]
        | None
    ) = None
    wind: WindField | None = None
    waves: WavesConfig | None = None

    @model_validator(mode="after")
    def _one_current(self) -> Disturbance:
        if (self.current_speed is None) != (self.current_direction is None):
            raise ValueError(
                "current_speed and current_direction belong together; give both, or current_north"
                " and current_east"
            )
        if self.current_speed is not None and (self.current_north or self.current_east):
            raise ValueError(
                "the current is given twice; give current_speed and current_direction, or"
                " current_north and current_east"
            )
        if self.current_each is not None and self.current_each[0] > self.current_each[1]:
            raise ValueError(
                f"current_each: the slowest ({self.current_each[0]:g} m/s) is faster than the"
                f" fastest ({self.current_each[1]:g} m/s)"
            )
        return self

    def currents(self, rows: int, seed: int) -> np.ndarray:
        """Return the current of each trial towards north and east in m/s, [B, 2]."""
        out = np.tile(self.current(), (rows, 1))
        if self.current_each is not None:
            random = np.random.default_rng([seed, 7])
            speed = random.uniform(*self.current_each, rows)
            direction = random.uniform(0.0, 2.0 * np.pi, rows)
            out += speed[:, None] * np.stack((np.cos(direction), np.sin(direction)), axis=1)
        return out

    def current(self) -> tuple[float, float]:
        """Return the current of all trials towards north and east in m/s."""
        if self.current_speed is None or self.current_direction is None:
            return self.current_north, self.current_east
        along = self.current_speed * np.exp(1j * self.current_direction)
        return float(along.real), float(along.imag)

    @property
    def logged(self) -> tuple[str, ...]:
        """Inputs of the plant that a vessel measures: the true wind, where there is any."""
        return WIND_INPUTS if self.wind is not None else ()

    def needs(self) -> dict[str, str]:
        """Return the inputs that a plant must have for this disturbance, each with its key."""
        north, east = self.current()
        forces = ("force_x", "force_y", "force_n", "force_north", "force_east")
        needs = {name: name for name in forces if getattr(self, name) != 0}
        currents = {"current_north": north, "current_east": east}
        needs |= {n: n for n, value in currents.items() if value != 0 or self.current_each}
        needs |= dict.fromkeys(WIND_INPUTS, "wind") if self.wind is not None else {}
        needs |= dict.fromkeys(forces[:3], "waves") if self.waves is not None else {}
        return needs

    def check(self, plant: Plant, vessel: str) -> None:
        """Stop where a plant cannot feel this disturbance.

        Raises:
            ConfigError: naming the key and what the vessel lacks.
        """
        for name, key in self.needs().items():
            if name not in plant.inputs:
                hint = "; give its vessel file a section 'wind'" if key == "wind" else ""
                raise ConfigError(
                    f"disturbance.{key}: vessel '{vessel}' has no input '{name}'{hint}; it has"
                    f" {', '.join(plant.inputs)}"
                )
        if self.waves is not None and not {"x", "y", "psi"} <= set(plant.state):
            raise ConfigError(
                f"disturbance.waves: vessel '{vessel}' has no position in its state; waves need x,"
                " y, psi"
            )

    def series(
        self,
        plant: Plant,
        rows: int,
        steps: int,
        step: float,
        seed: int,
        random: np.random.Generator,
    ) -> np.ndarray:
        """Return the inputs of the plant [B, T, m], of all that does not depend on its place.

        The commands are zero.

        The random forces are drawn from `random` (three values per step whatever their sizes, so
        that data of one seed stay the same), the gusts from generators of their own under `seed`.
        """
        forces = ornstein_uhlenbeck(random, (rows, steps, 3), step, self.correlation)
        currents = self.currents(rows, seed)
        values: dict[str, np.ndarray | float] = {
            "force_x": self.force_x * forces[:, :, 0],
            "force_y": self.force_y * forces[:, :, 1],
            "force_n": self.force_n * forces[:, :, 2],
            "force_north": self.force_north,
            "force_east": self.force_east,
            "current_north": currents[:, :1],
            "current_east": currents[:, 1:],
            **gusty_wind(self.wind, rows, steps, step, seed),
        }
        w = np.zeros((rows, steps, len(plant.inputs)))
        for name in values.keys() & set(plant.inputs):
            w[:, :, plant.inputs.index(name)] = values[name]
        return w

    def surround(self, source: Source, plant: Plant, rows: int, step: float, seed: int) -> Source:
        """Return a source with the waves added to its inputs; the same one in calm water."""
        if self.waves is None:
            return source
        return Seaway(source, self.waves.build(rows, np.random.default_rng([seed, 5])), plant, step)


@final
class Seaway(Source):
    """A source that adds the waves' forces to the inputs of another source.

    They are those at the vessel's place at the start of each step, held over it.
    """

    def __init__(self, source: Source, waves: Waves, plant: Plant, step: float) -> None:
        super().__init__()
        self.source = source
        self.waves = waves
        self.step = step
        self.may_stop = source.may_stop
        self.place = [plant.state.index(name) for name in ("x", "y", "psi")]
        axes = ("force_x", "force_y", "force_k", "force_n")
        present = [name for name in axes if name in plant.inputs]
        spread = torch.zeros(len(axes), len(plant.inputs), dtype=torch.float64)
        for name in present:
            spread[axes.index(name), plant.inputs.index(name)] = 1.0
        self.register_buffer("spread", spread, persistent=False)
        self.spread: Tensor

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory of the source inside."""
        return self.source.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] with the force of the waves at the time of step k."""
        acting, memory = self.source(x, w, k, memory)
        force = self.waves(
            x[:, self.place[0]], x[:, self.place[1]], x[:, self.place[2]], k * self.step
        )
        return acting + (force @ self.spread).to(acting.dtype), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows that the source inside stops."""
        return self.source.finished(x, k, memory)


def ornstein_uhlenbeck(
    random: np.random.Generator, shape: tuple[int, int, int], step: float, correlation: float
) -> np.ndarray:
    """Return stationary first-order processes [B, T, k] of unit variance.

    They run along T and are discretised exactly.
    """
    from scipy.signal import lfilter

    keep = np.exp(-step / correlation)
    drive = random.standard_normal(shape) * np.sqrt(1 - keep**2)
    drive[:, 0] /= np.sqrt(1 - keep**2)
    out: np.ndarray = lfilter([1.0], [1.0, -keep], drive, axis=1)
    return out


def gusty_wind(
    wind: WindField | None, rows: int, steps: int, step: float, seed: int
) -> dict[str, np.ndarray]:
    """Return the speed in m/s and direction in rad [B, T] of the wind with gusts, by input.

    The direction is where it comes from; nothing where there is no wind.
    """
    if wind is None:
        return {}
    random = np.random.default_rng([seed, 4])
    gust = wind.gust * ornstein_uhlenbeck(random, (rows, steps, 2), step, wind.correlation)
    along = wind.speed + gust[:, :, 0]
    direction = wind.direction + np.arctan2(gust[:, :, 1], along)
    return dict(zip(WIND_INPUTS, (np.hypot(along, gust[:, :, 1]), direction), strict=True))


class Sensor(Config):
    """What one channel's sensor does to it.

    Attributes:
        noise: standard deviation of white noise, in the channel's unit (`0.5 deg`); not for u, v,
            r, which have theirs beside `sensors`.
        bias: constant error, in the channel's unit.
        interval: time between its samples, a multiple of the log's step; the channel is empty in
            between. None: every sample of the log.
        latency: age of what it reports: the log shows at t what was at t - latency.
    """

    noise: float | str = 0.0
    bias: float | str = 0.0
    interval: Seconds | None = Field(default=None, gt=0)
    latency: Seconds = Field(default=0.0, ge=0)


class SensorNoise(Config):
    """White noise on the measured velocities; all else is exact unless `sensors` says otherwise.

    Attributes:
        u: standard deviation in m/s.
        v: standard deviation in m/s.
        r: standard deviation in rad/s.
        sensors: sensors of single channels, by the channel's name.
    """

    u: MetresPerSecond = Field(default=0.03, ge=0)
    v: MetresPerSecond = Field(default=0.03, ge=0)
    r: RadiansPerSecond = Field(default=float(np.radians(0.2)), ge=0)
    sensors: dict[str, Sensor] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _units(self) -> SensorNoise:
        converted = {}
        for name, sensor in self.sensors.items():
            if name not in CHANNEL_UNITS:
                raise ValueError(f"sensors: no channel '{name}'{nearest(name, CHANNEL_UNITS)}")
            unit = Quantity(CHANNEL_UNITS[name])
            try:
                noise, bias = unit.convert(sensor.noise), unit.convert(sensor.bias)
            except ValueError as error:
                raise ValueError(f"sensors.{name}: {error}") from None
            if noise < 0:
                raise ValueError(
                    f"sensors.{name}.noise: a standard deviation must not be negative, given"
                    f" {noise:g}"
                )
            if noise and name in VELOCITY:
                raise ValueError(
                    f"sensors.{name}.noise: the white noise of {name} is given as noise.{name}"
                )
            converted[name] = sensor.model_copy(update={"noise": noise, "bias": bias})
        object.__setattr__(self, "sensors", converted)
        return self

    def check(self, channels: tuple[str, ...], step: float, vessel: str) -> None:
        """Stop where a sensor measures what the log does not have, or samples more often than it.

        Raises:
            ConfigError: naming the sensor.
        """
        for name, sensor in self.sensors.items():
            if name not in channels:
                raise ConfigError(
                    f"noise.sensors: vessel '{vessel}' has no channel"
                    f" '{name}'{nearest(name, channels)}"
                )
            every = 1.0 if sensor.interval is None else sensor.interval / step
            if round(every) < 1 or abs(every - round(every)) > 1e-6 * every:
                raise ConfigError(
                    f"noise.sensors.{name}.interval: {sensor.interval:g} s is not a multiple of the"
                    f" log's step, {step:g} s"
                )

    def measured(
        self,
        clean: Mapping[str, np.ndarray],
        t: np.ndarray,
        white: np.ndarray,
        seed: tuple[int, ...],
    ) -> dict[str, np.ndarray]:
        """Return what the log holds.

        Args:
            clean: channels [T] as they were.
            t: times [T] in s, evenly spaced.
            white: noise [T, 3] of u, v, r.
            seed: of the noise of all other channels.
        """
        out = {}
        for name, truth in clean.items():
            sensor = self.sensors.get(name, Sensor())
            values = np.interp(t - sensor.latency, t, truth) if sensor.latency else truth.copy()
            if name in VELOCITY:
                values += white[:, VELOCITY.index(name)]
            if name in self.sensors:
                random = np.random.default_rng((*seed, *name.encode()))
                values += float(sensor.bias) + float(sensor.noise) * random.standard_normal(t.size)
            if sensor.interval is not None:
                every = round(sensor.interval / float(t[1] - t[0]))
                values[np.arange(t.size) % every != 0] = np.nan
            out[name] = values
        return out

"""How a simulated trial is measured: noise, bias, sampling and latency of each channel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, MetresPerSecond, Quantity, RadiansPerSecond, Seconds
from residnet.core.errors import ConfigError
from residnet.core.names import CHANNEL_UNITS, VELOCITY, nearest


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
            sensor = self.sensors.get(name)
            values = (
                truth
                if sensor is None or sensor.latency == 0
                else np.interp(t - sensor.latency, t, truth)
            )
            if name in VELOCITY:
                values = values + white[:, VELOCITY.index(name)]
            out[name] = (
                values.copy()
                if sensor is None
                else _sampled(sensor, values, t, (*seed, *name.encode()))
            )
        return out


def _sampled(
    sensor: Sensor, values: np.ndarray, t: np.ndarray, seed: tuple[int, ...]
) -> np.ndarray:
    """Return the values with bias and noise, NaN where the sensor takes no sample."""
    out: np.ndarray = (
        values
        + float(sensor.bias)
        + float(sensor.noise) * np.random.default_rng(seed).standard_normal(t.size)
    )
    if sensor.interval is not None:
        every = round(sensor.interval / float(t[1] - t[0]))
        out[np.arange(t.size) % every != 0] = np.nan
    return out

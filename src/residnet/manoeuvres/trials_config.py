"""Configuration of simulated sea trials: manoeuvres, disturbances and sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

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
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, VELOCITY_NAMES, WIND_INPUTS, suggest_name
from residnet.dynamics.time_steps import check_steps
from residnet.manoeuvres import FamilyConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.physics.environment_config import WavesConfig
from residnet.physics.plant_channels import PlantChannels
from residnet.physics.vessel import VesselName, load_vessel

if TYPE_CHECKING:
    from residnet.engine.rollout import Source
    from residnet.physics.plant import Plant


class WindConfig(Config):
    """Mean wind with gusts.

    The gusts along and across the mean wind are independent Ornstein-Uhlenbeck processes. Their
    one-sided spectrum is the first-order form of Dryden's longitudinal turbulence,
    S(omega) = (2 sigma^2 T / pi) / (1 + (omega T)^2).

    Attributes:
        speed: mean true wind speed at the height of the vessel's coefficients.
        direction: direction FROM which the mean wind blows, clockwise from north.
        gust: standard deviation sigma of each component.
        correlation: correlation time T of the gusts, their length divided by the mean speed.
    """

    speed: MetresPerSecond = Field(ge=0)
    direction: Radians
    gust: MetresPerSecond = Field(default=0.0, ge=0)
    correlation: Seconds = Field(default=10.0, gt=0)


class DisturbanceConfig(Config):
    """Random and constant forces, a constant current, wind and waves.

    Attributes:
        force_x: standard deviation of the random surge force, an Ornstein-Uhlenbeck process, in N.
        force_y: standard deviation of the random sway force in N.
        force_n: standard deviation of the random yaw moment in N m.
        correlation: correlation time of the three processes in s.
        force_north: constant force towards north in N.
        force_east: constant force towards east in N.
        current_north: current towards north in m/s.
        current_east: current towards east in m/s.
        current_speed: speed of the current in m/s, with its direction an alternative to the
            components.
        current_direction: direction TO which the current sets in rad, clockwise from north.
        current_each: range of the speed in m/s of an additional current that differs between
            trials; it is constant within a trial, with a random direction.
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
    wind: WindConfig | None = None
    waves: WavesConfig | None = None

    @model_validator(mode="after")
    def check_current(self) -> DisturbanceConfig:
        if (self.current_speed is None) != (self.current_direction is None):
            raise ValueError(
                "current_speed and current_direction belong together; give both, or current_north"
                " and current_east"
            )
        if self.current_speed is not None and (self.current_north or self.current_east):
            raise ValueError(
                "the current is specified twice; give either current_speed and current_direction,"
                " or current_north and current_east"
            )
        if self.current_each is not None and self.current_each[0] > self.current_each[1]:
            raise ValueError(
                f"current_each: the slowest ({self.current_each[0]:g} m/s) is faster than the"
                f" fastest ({self.current_each[1]:g} m/s)"
            )
        return self

    def draw_currents(self, n_trials: int, seed: int) -> np.ndarray:
        """Return the current of each trial towards north and east in m/s, [B, 2]."""
        currents = np.tile(self.common_current(), (n_trials, 1))
        if self.current_each is not None:
            # each kind of disturbance has its own random stream, so that adding one does not change
            # the others
            generator = np.random.default_rng([seed, 7])
            speed = generator.uniform(*self.current_each, n_trials)
            direction = generator.uniform(0.0, 2.0 * np.pi, n_trials)
            currents += speed[:, None] * np.stack((np.cos(direction), np.sin(direction)), axis=1)
        return currents

    def common_current(self) -> tuple[float, float]:
        """Return the current of all trials towards north and east in m/s."""
        if self.current_speed is None or self.current_direction is None:
            return self.current_north, self.current_east
        complex_current = self.current_speed * np.exp(1j * self.current_direction)
        return float(complex_current.real), float(complex_current.imag)

    @property
    def logged_inputs(self) -> tuple[str, ...]:
        """Inputs of the plant that a vessel measures: the true wind, if present."""
        return WIND_INPUTS if self.wind is not None else ()

    def required_plant_inputs(self) -> dict[str, str]:
        """Return the inputs that a plant needs for this disturbance, with the key of the config."""
        north, east = self.common_current()
        force_names = ("force_x", "force_y", "force_n", "force_north", "force_east")
        keys_by_input = {name: name for name in force_names if getattr(self, name) != 0}
        currents = {"current_north": north, "current_east": east}
        keys_by_input |= {n: n for n, value in currents.items() if value != 0 or self.current_each}
        keys_by_input |= dict.fromkeys(WIND_INPUTS, "wind") if self.wind is not None else {}
        keys_by_input |= dict.fromkeys(force_names[:3], "waves") if self.waves is not None else {}
        return keys_by_input

    def check_plant(self, plant: Plant | PlantChannels, vessel: str) -> None:
        """Check that a plant has the inputs of this disturbance.

        Raises:
            ConfigError: if an input is missing (names the first one), or the table of wave loads is
                invalid.
        """
        for name, key in self.required_plant_inputs().items():
            if name not in plant.input_names:
                hint = "; give its vessel file a section 'wind'" if key == "wind" else ""
                raise ConfigError(
                    f"disturbance.{key}: vessel '{vessel}' has no input '{name}'{hint}; it has"
                    f" {', '.join(plant.input_names)}"
                )
        if self.waves is not None and not {"x", "y", "psi"} <= set(plant.state_names):
            raise ConfigError(
                f"disturbance.waves: vessel '{vessel}' has no position in its state; waves need x,"
                " y, psi"
            )
        if self.waves is not None and self.waves.force_rao is not None:
            self.waves.load_force_rao(self.waves.force_rao)

    def draw_plant_inputs(
        self,
        plant: Plant,
        n_trials: int,
        n_steps: int,
        dt: float,
        seed: int,
        generator: np.random.Generator,
    ) -> np.ndarray:
        """Return the inputs of the plant [B, T, m] by disturbances that do not depend on position.

        The commands are zero. Random forces are drawn from `generator`, three values per step for
        any magnitude, so that the subsequent numbers of the generator do not depend on the config.
        Gusts and currents are drawn from separate generators with `seed`.
        """
        forces = sample_ornstein_uhlenbeck(generator, (n_trials, n_steps, 3), dt, self.correlation)
        currents = self.draw_currents(n_trials, seed)
        values_by_input: dict[str, np.ndarray | float] = {
            "force_x": self.force_x * forces[:, :, 0],
            "force_y": self.force_y * forces[:, :, 1],
            "force_n": self.force_n * forces[:, :, 2],
            "force_north": self.force_north,
            "force_east": self.force_east,
            "current_north": currents[:, :1],
            "current_east": currents[:, 1:],
            **simulate_wind(self.wind, n_trials, n_steps, dt, seed),
        }
        inputs = np.zeros((n_trials, n_steps, len(plant.input_names)))
        for name in values_by_input.keys() & set(plant.input_names):
            inputs[:, :, plant.input_names.index(name)] = values_by_input[name]
        return inputs

    def add_waves(
        self, source: Source, plant: Plant, n_trials: int, dt: float, seed: int
    ) -> Source:
        """Return a source with wave forces added to its inputs; the source itself without waves."""
        from residnet.manoeuvres.sources import WaveForceSource

        if self.waves is None:
            return source
        return WaveForceSource(
            source, self.waves.build(n_trials, np.random.default_rng([seed, 5])), plant, dt
        )


def sample_ornstein_uhlenbeck(
    generator: np.random.Generator, shape: tuple[int, int, int], dt: float, correlation: float
) -> np.ndarray:
    """Sample stationary Ornstein-Uhlenbeck processes [B, T, k] of unit variance.

    The discretisation along T is exact for any time step.
    """
    from scipy.signal import lfilter

    decay = np.exp(-dt / correlation)
    driving_noise = generator.standard_normal(shape) * np.sqrt(1 - decay**2)
    # the first sample has the stationary variance
    driving_noise[:, 0] /= np.sqrt(1 - decay**2)
    processes: np.ndarray = lfilter([1.0], [1.0, -decay], driving_noise, axis=1)
    return processes


def simulate_wind(
    wind: WindConfig | None, n_trials: int, n_steps: int, dt: float, seed: int
) -> dict[str, np.ndarray]:
    """Return the speed in m/s and the direction in rad of the wind with gusts [B, T], by input.

    The direction is the one FROM which the wind blows. The result is empty without wind.
    """
    if wind is None:
        return {}
    generator = np.random.default_rng([seed, 4])
    gusts = wind.gust * sample_ornstein_uhlenbeck(
        generator, (n_trials, n_steps, 2), dt, wind.correlation
    )
    longitudinal_speed = wind.speed + gusts[:, :, 0]
    direction = wind.direction + np.arctan2(gusts[:, :, 1], longitudinal_speed)
    return dict(
        zip(WIND_INPUTS, (np.hypot(longitudinal_speed, gusts[:, :, 1]), direction), strict=True)
    )


class SensorConfig(Config):
    """Errors of the sensor of one channel.

    Attributes:
        noise: standard deviation of white noise, with unit (`0.5 deg`); not for u, v and r, whose
            noise is set in `SensorsConfig`.
        bias: constant error, with unit.
        interval: time between measurements, a multiple of the step of the log; other samples are
            missing. None for a measurement at every sample.
        latency: delay of the measurement; the value at t is that of t - latency.
    """

    noise: float | str = 0.0
    bias: float | str = 0.0
    interval: Seconds | None = Field(default=None, gt=0)
    latency: Seconds = Field(default=0.0, ge=0)


class SensorsConfig(Config):
    """White noise of the measured velocities, and errors of the sensors of other channels.

    Attributes:
        u: standard deviation of the noise of u in m/s.
        v: standard deviation of the noise of v in m/s.
        r: standard deviation of the noise of r in rad/s.
        sensors: sensors by channel; other channels are exact.
    """

    u: MetresPerSecond = Field(default=0.03, ge=0)
    v: MetresPerSecond = Field(default=0.03, ge=0)
    r: RadiansPerSecond = Field(default=float(np.radians(0.2)), ge=0)
    sensors: dict[str, SensorConfig] = Field(default_factory=dict)

    @model_validator(mode="after")
    def convert_units(self) -> SensorsConfig:
        converted_sensors = {}
        for name, sensor in self.sensors.items():
            if name not in CHANNEL_UNITS:
                raise ValueError(f"sensors: no channel '{name}'{suggest_name(name, CHANNEL_UNITS)}")
            unit = Quantity(CHANNEL_UNITS[name])
            try:
                noise = unit.convert(sensor.noise)
                bias = unit.convert(sensor.bias)
            except ValueError as error:
                raise ValueError(f"sensors.{name}: {error}") from None
            if noise < 0:
                raise ValueError(
                    f"sensors.{name}.noise: a standard deviation must not be negative, got"
                    f" {noise:g}"
                )
            if noise and name in VELOCITY_NAMES:
                raise ValueError(
                    f"sensors.{name}.noise: set the white noise of {name} as noise.{name}"
                )
            converted_sensors[name] = sensor.model_copy(update={"noise": noise, "bias": bias})
        object.__setattr__(self, "sensors", converted_sensors)
        return self

    def check_sensors(self, channels: tuple[str, ...], dt: float, vessel: str) -> None:
        """Reject sensors of unknown channels, and sampling rates above the rate of the log."""
        for name, sensor in self.sensors.items():
            if name not in channels:
                raise ConfigError(
                    f"noise.sensors: vessel '{vessel}' has no channel"
                    f" '{name}'{suggest_name(name, channels)}"
                )
            samples_per_reading = 1.0 if sensor.interval is None else sensor.interval / dt
            if (
                round(samples_per_reading) < 1
                or abs(samples_per_reading - round(samples_per_reading))
                > 1e-6 * samples_per_reading
            ):
                raise ConfigError(
                    f"noise.sensors.{name}.interval: {sensor.interval:g} s is not a multiple of the"
                    f" log's step, {dt:g} s"
                )

    def measure(
        self,
        true_channels: Mapping[str, np.ndarray],
        t: np.ndarray,
        white_noise: np.ndarray,
        seed: tuple[int, ...],
    ) -> dict[str, np.ndarray]:
        """Return the measured channels [T].

        Args:
            true_channels: true channels [T].
            t: times [T] in s, evenly spaced.
            white_noise: noise [T, 3] of u, v, r.
            seed: seed of the noise of all other channels.
        """
        measured_channels = {}
        for name, true_values in true_channels.items():
            sensor = self.sensors.get(name, SensorConfig())
            values = (
                # a delayed sensor shows an earlier value; before the start it shows the first one
                np.interp(t - sensor.latency, t, true_values)
                if sensor.latency
                else true_values.copy()
            )
            if name in VELOCITY_NAMES:
                values += white_noise[:, VELOCITY_NAMES.index(name)]
            if name in self.sensors:
                # a separate stream for each channel, so that a further sensor does not change the
                # others
                generator = np.random.default_rng((*seed, *name.encode()))
                values += float(sensor.bias) + float(sensor.noise) * generator.standard_normal(
                    t.size
                )
            if sensor.interval is not None:
                samples_per_reading = round(sensor.interval / float(t[1] - t[0]))
                # a slow sensor has NaN between its readings, as logs from files have
                values[np.arange(t.size) % samples_per_reading != 0] = np.nan
            measured_channels[name] = values
        return measured_channels


def make_log_names(manoeuvres: Sequence[Manoeuvre]) -> list[str]:
    """Return the names of the logs: the name of the manoeuvre, or its kind with a number."""
    n_by_kind: dict[str, int] = {}
    names = []
    for manoeuvre in manoeuvres:
        n_by_kind[manoeuvre.kind] = n_by_kind.get(manoeuvre.kind, 0) + 1
        names.append(manoeuvre.name or f"{manoeuvre.kind}_{n_by_kind[manoeuvre.kind]:02d}")
    return names


def check_simulated_vessel(
    name: str, step: float, substeps: int, disturbance: DisturbanceConfig, sensors: SensorsConfig
) -> PlantChannels:
    """Check that a vessel can be simulated; return its channels.

    Args:
        name: name or file of the vessel.
        step: time step of the logs in s.
        substeps: number of simulation steps within one step of the logs.
        disturbance: forces, current, wind and waves.
        sensors: settings of the sensors.

    Raises:
        ConfigError: if the vessel is invalid, or does not fit step, disturbance or sensors.
    """
    vessel = load_vessel(name)
    vessel.check_parameters()
    # actuators with dead time move by a step of their own
    for servo in vessel.servo_specs():
        servo.require_step(step / substeps)
    channels = vessel.plant_channels()
    disturbance.check_plant(channels, name)
    logged_channels = (
        *channels.state_names,
        *channels.command_names,
        *disturbance.logged_inputs,
    )
    sensors.check_sensors(logged_channels, step, name)
    return channels


class SimulatedTrials(Config):
    """A programme of sea trials with a simulated vessel, starting at rest.

    A model that is valid only near its service speed starts at this speed.

    Attributes:
        vessel: name of a vessel of residnet, or path of a vessel file.
        trials: families of manoeuvres, drawn with `seed`.
        duration: duration of each manoeuvre.
        step: sampling interval of the logs.
        substeps: integration steps of the plant within a sampling interval.
        identification: number of manoeuvres of each kind for training and validation, drawn with
            `seed`; the others are the test set. All manoeuvres of kinds that are not listed are for
            training.
        validation: number of these manoeuvres that are reserved for model selection, by kind.
        seed: seed of all random numbers of the data; the seed of the run affects only the training.
        noise: noise and errors of the sensors.
        disturbance: forces, current, wind and waves.
    """

    kind: Literal["simulated"] = "simulated"
    vessel: VesselName
    trials: tuple[FamilyConfig, ...] = Field(min_length=1)
    duration: Seconds = Field(default=60.0, gt=0)
    step: Seconds = Field(default=0.05, gt=0)
    substeps: int = Field(default=5, ge=1, le=1_000)
    noise: SensorsConfig = SensorsConfig()
    disturbance: DisturbanceConfig = DisturbanceConfig()
    identification: dict[str, int]
    validation: dict[str, int]
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def check_plant(self) -> SimulatedTrials:
        try:
            check_simulated_vessel(
                self.vessel, self.step, self.substeps, self.disturbance, self.noise
            )
        except ConfigError as error:
            raise ValueError(str(error)) from None
        for manoeuvre in self.draw_manoeuvres():
            check_steps(manoeuvre.duration or self.duration, self.step)
        return self

    def draw_manoeuvres(self) -> list[Manoeuvre]:
        """Draw the manoeuvres of all families, in this order."""
        generator = np.random.default_rng([self.seed, 1])
        return [
            manoeuvre
            for family in self.trials
            for manoeuvre in family.sample_all(generator, self.duration)
        ]

    def assign_splits(self, manoeuvres: Sequence[Manoeuvre]) -> list[str]:
        """Return the split of each manoeuvre: train, validation or test."""
        generator = np.random.default_rng([self.seed, 2])
        split_names = ["train"] * len(manoeuvres)
        for manoeuvre_kind, n_identification in self.identification.items():
            members_of_kind = [
                i for i, manoeuvre in enumerate(manoeuvres) if manoeuvre.kind == manoeuvre_kind
            ]
            n_validation = self.validation.get(manoeuvre_kind, 0)
            if (
                not 0 < n_identification < len(members_of_kind)
                or not 0 <= n_validation < n_identification
            ):
                raise ValueError(
                    f"{n_identification} of {len(members_of_kind)} '{manoeuvre_kind}' manoeuvres"
                    f" for identification, {n_validation} of them for validation: a split is empty"
                )
            shuffled_indices = generator.permutation(members_of_kind)
            for i in shuffled_indices[:n_validation]:
                split_names[i] = "validation"
            for i in shuffled_indices[n_identification:]:
                split_names[i] = "test"
        return split_names


def list_logged_channels(
    state_names: Sequence[str], command_names: Sequence[str], disturbance: DisturbanceConfig
) -> tuple[str, ...]:
    """Return the channel names of a simulated log: states, commands, measured inputs."""
    measured_states = [name for name in state_names if not name.startswith("_")]
    return tuple(dict.fromkeys((*measured_states, *command_names, *disturbance.logged_inputs)))


def make_dummy_logs(config: SimulatedTrials) -> list[Log]:
    """Return placeholder logs with names, channels and lengths as from `simulate_trial_logs`.

    Their channels are slow sines, for checks of a config without a simulation.

    Raises:
        UsageError: if the vessel lacks a state or command that a manoeuvre needs.
    """

    plant_channels = load_vessel(config.vessel).plant_channels()
    channel_names = list_logged_channels(
        plant_channels.state_names, plant_channels.command_names, config.disturbance
    )
    manoeuvres = config.draw_manoeuvres()
    logs = []
    for manoeuvre, name in zip(manoeuvres, make_log_names(manoeuvres), strict=True):
        manoeuvre.check_vessel(plant_channels)
        times = (
            np.arange(max(round(manoeuvre.duration_within(config.duration) / config.step), 2))
            * config.step
        )
        channels = {
            channel: 1.0 + np.sin(0.1 * times + channel_index)
            for channel_index, channel in enumerate(channel_names)
        }
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in channels}
        logs.append(Log(name, times, channels, units, manoeuvre.kind))
    return logs

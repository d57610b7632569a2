"""Simulated sea trials: manoeuvres of a plant or a learned model, and their logs.

Disturbances are forces, current, wind and waves; sensors add noise to the logs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Annotated, Any, Literal, final

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
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, VELOCITY_NAMES, WIND_INPUTS, suggest_name
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import PlantDynamics, check_steps
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout, Source
from residnet.manoeuvres import FamilyConfig
from residnet.manoeuvres.base import Helm, Manoeuvre, StackedSource, StopRecorder
from residnet.physics.environment import IrregularWaves, WavesConfig
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.vessel import VesselName, load_vessel


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

    def check_plant(self, plant: Plant, vessel: str) -> None:
        """Check that a plant has the inputs of this disturbance.

        Raises:
            ConfigError: with the first missing input.
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
        if self.waves is None:
            return source
        return WaveForceSource(
            source, self.waves.build(n_trials, np.random.default_rng([seed, 5])), plant, dt
        )


@final
class WaveForceSource(Source):
    """A source that adds wave forces to the inputs of another source.

    The forces are those at the position of the vessel at the start of each step, constant over it.
    """

    def __init__(self, source: Source, waves: IrregularWaves, plant: Plant, dt: float) -> None:
        super().__init__()
        self.source = source
        self.waves = waves
        self.dt = dt
        self.can_stop = source.can_stop
        self.pose_columns = [plant.state_names.index(name) for name in ("x", "y", "psi")]
        axis_names = ("force_x", "force_y", "force_k", "force_n")
        available_axes = [name for name in axis_names if name in plant.input_names]
        force_matrix = torch.zeros(len(axis_names), len(plant.input_names), dtype=torch.float64)
        for name in available_axes:
            force_matrix[axis_names.index(name), plant.input_names.index(name)] = 1.0
        self.register_buffer("force_matrix", force_matrix, persistent=False)
        self.force_matrix: Tensor

    def initial(self, x: Tensor) -> Tensor:
        return self.source.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] with the force of the waves at the time of step k."""
        inputs, memory = self.source(x, w, k, memory)
        force = self.waves(
            x[:, self.pose_columns[0]],
            x[:, self.pose_columns[1]],
            x[:, self.pose_columns[2]],
            k * self.dt,
        )
        return inputs + (force @ self.force_matrix).to(inputs.dtype), memory

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        return self.source.is_finished(x, k, memory)


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
        u: standard deviation in m/s.
        v: standard deviation in m/s.
        r: standard deviation in rad/s.
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
                np.interp(t - sensor.latency, t, true_values)
                if sensor.latency
                else true_values.copy()
            )
            if name in VELOCITY_NAMES:
                values += white_noise[:, VELOCITY_NAMES.index(name)]
            if name in self.sensors:
                generator = np.random.default_rng((*seed, *name.encode()))
                values += float(sensor.bias) + float(sensor.noise) * generator.standard_normal(
                    t.size
                )
            if sensor.interval is not None:
                samples_per_reading = round(sensor.interval / float(t[1] - t[0]))
                values[np.arange(t.size) % samples_per_reading != 0] = np.nan
            measured_channels[name] = values
        return measured_channels


@dataclass(frozen=True)
class SimulatedVessel:
    """A vessel in simulated trials: a plant or a learned model.

    Attributes:
        name: name in logs and tables.
        dynamics: plant or learned model with the time step of the logs.
        helm: properties of the vessel for manoeuvres.
        n_commands: number of commands among its inputs.
        initial_state: initial state of all trials [1, nx] or of each [B, nx], float64.
    """

    name: str
    dynamics: Dynamics
    helm: Helm
    n_commands: int
    initial_state: Tensor


@dataclass(frozen=True)
class TrialEnvironment:
    """Disturbances and sensors of simulated trials.

    Attributes:
        plant: plant whose inputs the disturbances are; None for a learned model without a vessel,
            which is disturbed by wind only.
        disturbance: forces, current, wind, waves.
        sensors: noise and errors of the sensors.
        seed: seed of all random numbers of both.
    """

    plant: Plant | None
    disturbance: DisturbanceConfig
    sensors: SensorsConfig
    seed: int


@dataclass(frozen=True)
class ManoeuvreRun:
    """A simulated manoeuvre and its logs.

    Attributes:
        manoeuvre: the manoeuvre.
        true_log: true motion.
        measured_log: motion measured by the sensors. Its `meta` has `timed_out` if the stop
            condition was not reached, and `diverged` if the motion was not finite; both logs end
            at this time.
    """

    manoeuvre: Manoeuvre
    true_log: Log
    measured_log: Log

    @property
    def fault_text(self) -> str | None:
        """Reason why the manoeuvre ended early or without its goal; None if it did not."""
        duration_text = f"{self.true_log.t[-1] - self.true_log.t[0]:.5g} s"
        if self.measured_log.meta.get("diverged"):
            return f"the motion was no longer finite after {duration_text}"
        return (
            f"timed out after {duration_text} before {self.manoeuvre.end_condition}"
            if self.measured_log.meta.get("timed_out")
            else None
        )


def make_manoeuvre_source(manoeuvres: Sequence[Manoeuvre], helm: Helm, times: Tensor) -> Source:
    """Return the source of manoeuvres of any kinds, one for each row of a batch.

    Args:
        manoeuvres: the manoeuvres; those of one kind are consecutive.
        helm: properties of the vessel.
        times: times [T] of the steps in s.

    Raises:
        UsageError: if the vessel lacks a state or command that a manoeuvre needs.
    """
    manoeuvres_by_kind = [
        list(manoeuvres_of_kind)
        for _, manoeuvres_of_kind in groupby(manoeuvres, key=lambda manoeuvre: manoeuvre.kind)
    ]
    return StackedSource(
        [
            type(manoeuvres_of_kind[0]).build_source(manoeuvres_of_kind, helm, times)
            for manoeuvres_of_kind in manoeuvres_by_kind
        ],
        [len(manoeuvres_of_kind) for manoeuvres_of_kind in manoeuvres_by_kind],
    )


def simulate_manoeuvres(
    vessel: SimulatedVessel,
    manoeuvres: Sequence[Manoeuvre],
    environment: TrialEnvironment,
    duration: float,
    dt: float,
    metadata: Mapping[str, Any] | None = None,
) -> list[ManoeuvreRun]:
    """Simulate manoeuvres in one batch.

    Args:
        vessel: plant or learned model.
        manoeuvres: manoeuvres in the order of the result; a row ends at its stop condition.
        environment: disturbances and sensors.
        duration: duration in s of manoeuvres without one.
        dt: time step of the logs in s.
        metadata: metadata of the logs.

    Raises:
        UsageError: if the vessel lacks a state or command that a manoeuvre needs.
        DataError: if the motion of a manoeuvre is not finite after the first step.
    """
    n_trials = len(manoeuvres)
    max_steps_by_trial = [
        max(round(manoeuvre.duration_within(duration) / dt), 2) for manoeuvre in manoeuvres
    ]
    n_steps = max(max_steps_by_trial)
    times = torch.arange(n_steps, dtype=torch.float64) * dt
    generator = np.random.default_rng([environment.seed, 3])
    source = make_manoeuvre_source(manoeuvres, vessel.helm, times)
    if environment.plant is not None:
        plant_inputs = environment.disturbance.draw_plant_inputs(
            environment.plant, n_trials, n_steps, dt, environment.seed, generator
        )
        source = environment.disturbance.add_waves(
            source, environment.plant, n_trials, dt, environment.seed
        )
    else:
        plant_inputs = np.zeros((n_trials, n_steps, len(vessel.helm.inputs)))
        for channel, values in simulate_wind(
            environment.disturbance.wind, n_trials, n_steps, dt, environment.seed
        ).items():
            plant_inputs[:, :, vessel.helm.inputs.index(channel)] = values
    monitored_source = StopRecorder(source, n_trials)
    manoeuvres_and_states = zip(manoeuvres, vessel.initial_state.expand(n_trials, -1), strict=True)
    initial_states = torch.stack(
        [
            manoeuvre.initial_state(state, vessel.helm.state)
            for manoeuvre, state in manoeuvres_and_states
        ]
    )
    with torch.no_grad():
        initial_memory = vessel.dynamics.initial_state(n_trials).to(torch.float64)
        rollout = Rollout(vessel.dynamics, monitored_source)
        states, inputs, _ = rollout(initial_states, torch.from_numpy(plant_inputs), initial_memory)
    velocity_noise = generator.standard_normal((n_trials, n_steps, 3)) * [
        environment.sensors.u,
        environment.sensors.v,
        environment.sensors.r,
    ]
    runs = []
    for i, (manoeuvre, log_name) in enumerate(
        zip(manoeuvres, make_log_names(manoeuvres), strict=True)
    ):
        stop_step = int(monitored_source.stop_step[i])
        has_reached_goal = 0 <= stop_step < max_steps_by_trial[i]
        n_valid_steps = stop_step + 1 if has_reached_goal else max_steps_by_trial[i]
        is_finite = np.isfinite(states[i, :n_valid_steps].numpy()).all(axis=1)
        manoeuvre_settings = manoeuvre.model_dump(mode="json")
        log_metadata: dict[str, Any] = {
            **(metadata or {}),
            "demand": manoeuvre_settings,
            "seed": environment.seed,
        }
        if not is_finite.all():
            n_valid_steps = int(np.argmin(is_finite))
            log_metadata["diverged"] = True
        elif manoeuvre.end_condition is not None and not has_reached_goal:
            log_metadata["timed_out"] = True
        if n_valid_steps < 2:
            raise DataError(
                f"{vessel.name}, {log_name}: the motion is not finite after the first step"
            )
        simulated_channels = dict(zip(vessel.helm.state, states[i, :n_valid_steps].T, strict=True))
        simulated_channels |= dict(
            zip(vessel.helm.inputs, inputs[i, :n_valid_steps].T, strict=True)
        )
        true_channels = {
            channel_name: simulated_channels[channel_name].numpy().copy()
            for channel_name in list_logged_channels(vessel, environment)
        }
        log_times = times[:n_valid_steps].numpy().copy()
        measured_channels = environment.sensors.measure(
            true_channels, log_times, velocity_noise[i, :n_valid_steps], (environment.seed, 6, i)
        )
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in true_channels}
        true_log = Log(log_name, log_times, true_channels, units, manoeuvre.kind, meta=log_metadata)
        runs.append(ManoeuvreRun(manoeuvre, true_log, true_log.replace(channels=measured_channels)))
    return runs


def list_logged_channels(vessel: SimulatedVessel, environment: TrialEnvironment) -> tuple[str, ...]:
    """Return the channels of a simulated log: measured states, commands, and the wind if any."""
    channel_names = [
        *(name for name in vessel.helm.state if not name.startswith("_")),
        *vessel.helm.inputs[: vessel.n_commands],
        *environment.disturbance.logged_inputs,
    ]
    return tuple(dict.fromkeys(channel_names))


def make_log_names(manoeuvres: Sequence[Manoeuvre]) -> list[str]:
    """Return the names of the logs: the name of the manoeuvre, or its kind with a number."""
    n_by_kind: dict[str, int] = {}
    names = []
    for manoeuvre in manoeuvres:
        n_by_kind[manoeuvre.kind] = n_by_kind.get(manoeuvre.kind, 0) + 1
        names.append(manoeuvre.name or f"{manoeuvre.kind}_{n_by_kind[manoeuvre.kind]:02d}")
    return names


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
            plant = load_vessel(self.vessel).build()
            # raises an error if the step of a delay line differs from that of the simulation
            plant.finish_step(
                plant.make_initial_state(1),
                torch.zeros(1, len(plant.input_names), dtype=torch.float64),
                self.step / self.substeps,
            )
            self.disturbance.check_plant(plant, self.vessel)
            self.noise.check_sensors(
                (
                    *plant.state_names,
                    *plant.input_names[: plant.n_commands],
                    *self.disturbance.logged_inputs,
                ),
                self.step,
                self.vessel,
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


def simulate_trials(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[ManoeuvreRun]:
    """Simulate manoeuvres in one batch and return their true and measured logs.

    The channels are the states of the plant (for the WAM-V x, y, psi, u, v, r, n_port, n_stbd), the
    commands, and the true wind if present, float64.
    """
    plant = build_plant(config.vessel, config.disturbance)
    traced_dynamics = RecordedPlantDynamics(plant, config.step, config.substeps)
    vessel = replace(build_trial_vessel(config), dynamics=traced_dynamics)
    environment = TrialEnvironment(plant, config.disturbance, config.noise, config.seed)
    return simulate_manoeuvres(
        vessel, manoeuvres, environment, config.duration, config.step, {"vessel": config.vessel}
    )


def make_dummy_logs(config: SimulatedTrials) -> list[Log]:
    """Return placeholder logs with names, channels and lengths as from `simulate_trial_logs`.

    Their channels are slow sines, for checks of a config without a simulation.

    Raises:
        UsageError: if the vessel lacks a state or command that a manoeuvre needs.
    """
    plant = load_vessel(config.vessel).build()
    vessel = build_trial_vessel(config)
    environment = TrialEnvironment(plant, config.disturbance, config.noise, config.seed)
    manoeuvres = config.draw_manoeuvres()
    make_manoeuvre_source(
        manoeuvres, vessel.helm, torch.arange(2, dtype=torch.float64) * config.step
    )
    logs = []
    for manoeuvre, name in zip(manoeuvres, make_log_names(manoeuvres), strict=True):
        manoeuvre.initial_state(vessel.initial_state[0], vessel.helm.state)
        times = (
            np.arange(max(round(manoeuvre.duration_within(config.duration) / config.step), 2))
            * config.step
        )
        channels = {
            channel: 1.0 + np.sin(0.1 * times + channel_index)
            for channel_index, channel in enumerate(list_logged_channels(vessel, environment))
        }
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in channels}
        logs.append(Log(name, times, channels, units, manoeuvre.kind))
    return logs


def build_plant(vessel: str, disturbance: DisturbanceConfig) -> Plant:
    """Return the plant of a vessel, without environment if there is no disturbance.

    The results are equal, and the simulation of an underwater vehicle takes half the time.
    """
    plant = load_vessel(vessel).build()
    if isinstance(plant, HullPlant) and not disturbance.required_plant_inputs():
        return plant.without_environment()
    return plant


def build_trial_vessel(config: SimulatedTrials) -> SimulatedVessel:
    """Return the simulated vessel of the trials."""
    plant = build_plant(config.vessel, config.disturbance)
    return SimulatedVessel(
        config.vessel,
        PlantDynamics(plant, config.step, config.substeps),
        Helm.from_plant(plant),
        plant.n_commands,
        plant.make_initial_state(1),
    )


def simulate_trial_logs(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[Log]:
    """Return the logs of `simulate_trials`."""
    return [run.measured_log for run in simulate_trials(manoeuvres, config)]

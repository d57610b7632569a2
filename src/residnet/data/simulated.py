"""Simulated sea trials: manoeuvres that a plant or a learned model flies, and their logs.

Forces, current, wind and waves surround a vessel, and sensors measure it.
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
from residnet.core.names import CHANNEL_UNITS, VELOCITY, WIND_INPUTS, nearest
from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.simulated import PlantDynamics, RecordedPlantDynamics, check_steps
from residnet.manoeuvres import FamilyConfig
from residnet.manoeuvres.base import Helm, Manoeuvre, StackedSource, Watched
from residnet.physics.environment import Waves, WavesConfig
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.vessel import VesselName, load_vessel


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
        """Stop where a plant cannot feel this disturbance."""
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
        return self.source.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] with the force of the waves at the time of step k."""
        acting, memory = self.source(x, w, k, memory)
        force = self.waves(
            x[:, self.place[0]], x[:, self.place[1]], x[:, self.place[2]], k * self.step
        )
        return acting + (force @ self.spread).to(acting.dtype), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
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
        """Stop where a sensor measures what the log has not, or samples more often than it."""
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


@dataclass(frozen=True)
class Craft:
    """A vessel that flies manoeuvres: a plant or a learned model.

    Attributes:
        name: in logs and tables.
        dynamics: a plant or a learned model, stepping as the logs do.
        helm: of it.
        commands: how many of its inputs are commands.
        start: state [1, nx] that trials start from, or one for each, [B, nx]; float64.
    """

    name: str
    dynamics: Dynamics
    helm: Helm
    commands: int
    start: Tensor


@dataclass(frozen=True)
class Sea:
    """What surrounds a craft, and what measures it.

    Attributes:
        plant: whose inputs the disturbance is laid out for; None for a model without a vessel,
            which feels the wind alone.
        disturbance: forces, current, wind, waves.
        noise: of the sensors.
        seed: of everything random in both.
    """

    plant: Plant | None
    disturbance: Disturbance
    noise: SensorNoise
    seed: int


@dataclass(frozen=True)
class Flight:
    """One manoeuvre as it was flown.

    Attributes:
        manoeuvre: what was to be flown.
        motion: the motion itself.
        log: what sensors measured of it. Its meta says `timed_out` where the stop condition was not
            reached, `diverged` where the motion ceased to be finite; both logs end there.
    """

    manoeuvre: Manoeuvre
    motion: Log
    log: Log

    @property
    def fault(self) -> str | None:
        """Why the manoeuvre did not end as it should, in words; None where it did."""
        seconds = f"{self.motion.t[-1] - self.motion.t[0]:.5g} s"
        if self.log.meta.get("diverged"):
            return f"the motion was no longer finite after {seconds}"
        return (
            f"timed out after {seconds} before {self.manoeuvre.goal}"
            if self.log.meta.get("timed_out")
            else None
        )


def source_of(manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
    """Return the source that flies manoeuvres of any kinds side by side.

    t [T] are the times of the steps.

    Raises:
        UsageError: where the vessel lacks what a manoeuvre needs.
    """
    runs = [list(members) for _, members in groupby(manoeuvres, key=lambda m: m.kind)]
    return StackedSource(
        [type(members[0]).source(members, helm, t) for members in runs],
        [len(members) for members in runs],
    )


def fly(
    craft: Craft,
    manoeuvres: Sequence[Manoeuvre],
    sea: Sea,
    duration: float,
    step: float,
    about: Mapping[str, Any] | None = None,
) -> list[Flight]:
    """Fly the manoeuvres in one batch.

    Args:
        craft: plant or learned model.
        manoeuvres: in the order of the result; rows that reach their stop condition end there.
        duration: of manoeuvres that give none, in s.
        step: of the logs in s.
        about: what the meta of the logs shall say.

    Raises:
        UsageError: where the vessel lacks what a manoeuvre needs.
        DataError: where the motion of a manoeuvre is not finite from its first step on.
    """
    rows = len(manoeuvres)
    lengths = [max(round(manoeuvre.lasts(duration) / step), 2) for manoeuvre in manoeuvres]
    steps = max(lengths)
    t = torch.arange(steps, dtype=torch.float64) * step
    random = np.random.default_rng([sea.seed, 3])
    source = source_of(manoeuvres, craft.helm, t)
    if sea.plant is not None:
        w = sea.disturbance.series(sea.plant, rows, steps, step, sea.seed, random)
        source = sea.disturbance.surround(source, sea.plant, rows, step, sea.seed)
    else:
        w = np.zeros((rows, steps, len(craft.helm.inputs)))
        for channel, values in gusty_wind(
            sea.disturbance.wind, rows, steps, step, sea.seed
        ).items():
            w[:, :, craft.helm.inputs.index(channel)] = values
    watched = Watched(source, rows)
    begun = zip(manoeuvres, craft.start.expand(rows, -1), strict=True)
    start = torch.stack([manoeuvre.begin(x, craft.helm.state) for manoeuvre, x in begun])
    with torch.no_grad():
        memory = craft.dynamics.initial_state(rows).to(torch.float64)
        rollout = Rollout(craft.dynamics, watched)
        states, inputs, _ = rollout(start, torch.from_numpy(w), memory)
    noise = random.standard_normal((rows, steps, 3)) * [sea.noise.u, sea.noise.v, sea.noise.r]
    flights = []
    for i, (manoeuvre, name) in enumerate(zip(manoeuvres, log_names(manoeuvres), strict=True)):
        stopped = int(watched.stopped[i])
        reached = 0 <= stopped < lengths[i]
        length = stopped + 1 if reached else lengths[i]
        finite = np.isfinite(states[i, :length].numpy()).all(axis=1)
        demand = manoeuvre.model_dump(mode="json")
        meta: dict[str, Any] = {**(about or {}), "demand": demand, "seed": sea.seed}
        if not finite.all():
            length, meta["diverged"] = int(np.argmin(finite)), True
        elif manoeuvre.goal is not None and not reached:
            meta["timed_out"] = True
        if length < 2:
            raise DataError(
                f"{craft.name}, {name}: the motion is not finite from its first step on"
            )
        flown = dict(zip(craft.helm.state, states[i, :length].T, strict=True))
        flown |= dict(zip(craft.helm.inputs, inputs[i, :length].T, strict=True))
        clean = {n: flown[n].numpy().copy() for n in logged_channels(craft, sea)}
        time = t[:length].numpy().copy()
        measured = sea.noise.measured(clean, time, noise[i, :length], (sea.seed, 6, i))
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in clean}
        motion = Log(name, time, clean, units, manoeuvre.kind, meta=meta)
        flights.append(Flight(manoeuvre, motion, motion.replace(channels=measured)))
    return flights


def logged_channels(craft: Craft, sea: Sea) -> tuple[str, ...]:
    """Return the names of the channels of a flight's log: states, commands, what is measured."""
    names = [
        *(name for name in craft.helm.state if not name.startswith("_")),
        *craft.helm.inputs[: craft.commands],
        *sea.disturbance.logged,
    ]
    return tuple(dict.fromkeys(names))


def log_names(manoeuvres: Sequence[Manoeuvre]) -> list[str]:
    """Return the names of the logs: as given, else the kind with its number."""
    count: dict[str, int] = {}
    out = []
    for manoeuvre in manoeuvres:
        count[manoeuvre.kind] = count.get(manoeuvre.kind, 0) + 1
        out.append(manoeuvre.name or f"{manoeuvre.kind}_{count[manoeuvre.kind]:02d}")
    return out


class SimulatedTrials(Config):
    """A programme of sea trials on a simulated vessel, from rest.

    A model that only holds near its service speed starts there.

    Attributes:
        vessel: name of a vessel of residnet, or path of a vessel file.
        trials: families of manoeuvres; what is random in them is drawn by `seed`.
        duration: of each manoeuvre.
        step: sampling interval of the logs.
        substeps: steps of the plant within one sampling interval.
        identification: number of manoeuvres of each kind that models may be fitted on, drawn by
            `seed`; kinds that are not named are for identification altogether. The rest is the test
            set.
        validation: how many of those are kept back to choose between models.
        seed: of everything random in the data (the run's own seed moves only the training).
        noise: of the sensors.
        disturbance: of the sea.
    """

    kind: Literal["simulated"] = "simulated"
    vessel: VesselName
    trials: tuple[FamilyConfig, ...] = Field(min_length=1)
    duration: Seconds = Field(default=60.0, gt=0)
    step: Seconds = Field(default=0.05, gt=0)
    substeps: int = Field(default=5, ge=1, le=1_000)
    noise: SensorNoise = SensorNoise()
    disturbance: Disturbance = Disturbance()
    identification: dict[str, int]
    validation: dict[str, int]
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _check_plant(self) -> SimulatedTrials:
        try:
            plant = load_vessel(self.vessel).build()
            # actuators with dead time move by a step of their own
            plant.end_step(
                plant.approach(1),
                torch.zeros(1, len(plant.inputs), dtype=torch.float64),
                self.step / self.substeps,
            )
            self.disturbance.check(plant, self.vessel)
            self.noise.check(
                (*plant.state, *plant.inputs[: plant.commands], *self.disturbance.logged),
                self.step,
                self.vessel,
            )
        except ConfigError as error:
            raise ValueError(str(error)) from None
        for manoeuvre in self.draw():
            check_steps(manoeuvre.duration or self.duration, self.step)
        return self

    def draw(self) -> list[Manoeuvre]:
        """Return the manoeuvres, by family."""
        random = np.random.default_rng([self.seed, 1])
        return [
            manoeuvre for family in self.trials for manoeuvre in family.draw(random, self.duration)
        ]

    def splits(self, manoeuvres: Sequence[Manoeuvre]) -> list[str]:
        """Return `train`, `validation` or `test` of each manoeuvre; whole manoeuvres only."""
        random = np.random.default_rng([self.seed, 2])
        out = ["train"] * len(manoeuvres)
        for kind, count in self.identification.items():
            members = [i for i, manoeuvre in enumerate(manoeuvres) if manoeuvre.kind == kind]
            held_back = self.validation.get(kind, 0)
            if not 0 < count < len(members) or not 0 <= held_back < count:
                raise ValueError(
                    f"{count} of {len(members)} '{kind}' manoeuvres for identification, {held_back}"
                    " of them for validation: leaves a split empty"
                )
            order = random.permutation(members)
            for i in order[:held_back]:
                out[i] = "validation"
            for i in order[count:]:
                out[i] = "test"
        return out


def fly_trials(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[Flight]:
    """Fly the manoeuvres in one batch and return the motion and the logs of sensors on it.

    Channels: the plant's state (for the WAM-V x, y, psi, u, v, r, n_port, n_stbd), the commands,
    and the true wind where there is any. Float64.
    """
    plant = surrounded(config.vessel, config.disturbance)
    traced = RecordedPlantDynamics(plant, config.step, config.substeps)
    craft = replace(trials_craft(config), dynamics=traced)
    sea = Sea(plant, config.disturbance, config.noise, config.seed)
    return fly(craft, manoeuvres, sea, config.duration, config.step, {"vessel": config.vessel})


def stand_ins(config: SimulatedTrials) -> list[Log]:
    """Return logs with the names, channels, lengths and kinds of those of `simulate`, unflown.

    Their channels are slow sines: they tell what a run can be made of, before anything is flown.

    Raises:
        UsageError: where the vessel lacks what a manoeuvre needs.
    """
    plant = load_vessel(config.vessel).build()
    craft, sea = trials_craft(config), Sea(plant, config.disturbance, config.noise, config.seed)
    manoeuvres = config.draw()
    source_of(manoeuvres, craft.helm, torch.arange(2, dtype=torch.float64) * config.step)
    out = []
    for manoeuvre, name in zip(manoeuvres, log_names(manoeuvres), strict=True):
        manoeuvre.begin(craft.start[0], craft.helm.state)
        t = np.arange(max(round(manoeuvre.lasts(config.duration) / config.step), 2)) * config.step
        channels = {
            channel: 1.0 + np.sin(0.1 * t + place)
            for place, channel in enumerate(logged_channels(craft, sea))
        }
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in channels}
        out.append(Log(name, t, channels, units, manoeuvre.kind))
    return out


def surrounded(vessel: str, disturbance: Disturbance) -> Plant:
    """Return the plant of a vessel, in calm water where nothing disturbs it.

    The numbers are the same there: a vessel under water is flown in half the time.
    """
    plant = load_vessel(vessel).build()
    if isinstance(plant, HullPlant) and not disturbance.needs():
        return plant.in_calm_water()
    return plant


def trials_craft(config: SimulatedTrials) -> Craft:
    """Return the vessel of the trials."""
    plant = surrounded(config.vessel, config.disturbance)
    return Craft(
        config.vessel,
        PlantDynamics(plant, config.step, config.substeps),
        Helm.from_plant(plant),
        plant.commands,
        plant.approach(1),
    )


def simulate(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[Log]:
    """Return the logs of `fly_trials`."""
    return [flight.log for flight in fly_trials(manoeuvres, config)]

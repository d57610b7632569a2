"""A log that looks like Odin's sea trial (document 000 sections 7.1, 7.3): zigzags and speed steps
over all phases, in waves, measured unevenly.

The document's recipe: interpolation to 20 Hz, a Butterworth low-pass forward and backward,
accelerations as differences (7.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.core.samples import Samples
from residnet.data.simulated.environment import Disturbance
from residnet.data.simulated.flying import Craft, Sea, fly
from residnet.data.simulated.sensors import SensorNoise
from residnet.dynamics.simulated import TracedPlantDynamics
from residnet.manoeuvres import AccelerationDeceleration, Helm, Manoeuvre, Zigzag
from residnet.physics.froude import froude_number, phase_of
from residnet.physics.odin import OdinConfig
from residnet.physics.vessel import load_vessel

CONTROLS, FORCES = ("cmd_n", "cmd_nozzle"), ("tau_x", "tau_y", "tau_n")
CHANNELS = (*VELOCITY, *CONTROLS, *FORCES)


class ProgrammeConfig(Config):
    """Zigzags at several speeds, and a straight run in steps up and down through all of them;
    sailed once on each course.

    Attributes:
        drives: shares of the motor's revolutions.
        steers: shares of the largest nozzle angle; each speed is zigzagged with each.
        heading: at which zigzags are reversed.
        zigzag: how long each of them lasts.
        hold: how long a level of the straight run is held.
        courses: against which the sea turns; the same programme on opposite courses cancels a
            steady drift, as in the document.
    """

    drives: tuple[float, ...] = Field(default=(0.35, 0.45, 0.55, 0.7, 0.85, 1.0), min_length=2)
    steers: tuple[float, ...] = Field(default=(0.15, 0.35), min_length=1)
    heading: Radians = Field(default=float(np.radians(20)), gt=0)
    zigzag: Seconds = Field(default=80.0, gt=0)
    hold: Seconds = Field(default=25.0, gt=0)
    courses: tuple[Radians, ...] = Field(default=(0.0, float(np.pi)), min_length=1)

    def manoeuvres(self) -> list[Manoeuvre]:
        """Of one course, in the order that they are sailed."""
        levels = (*self.drives, *reversed(self.drives[:-1]))
        times = tuple(self.hold * i for i in range(len(levels)))
        out: list[Manoeuvre] = [
            AccelerationDeceleration(times=times, levels=levels, duration=self.hold * len(levels))
        ]
        for drive in self.drives:
            for number, steer in enumerate(self.steers):
                first = "starboard" if number % 2 == 0 else "port"
                out.append(
                    Zigzag.model_validate(
                        {**self._zigzag(), "drive": drive, "steer": steer, "first": first}
                    )
                )
        return out

    def _zigzag(self) -> dict[str, float]:
        return {"heading": self.heading, "start": self.zigzag / 4, "duration": self.zigzag}


class PreparationConfig(Config):
    """From an uneven log to accelerations (section 7.3.1).

    Attributes:
        interval: shortest and longest time between samples of the log.
        step: of the uniform grid.
        cutoff: of the Butterworth filter as a share of the Nyquist frequency (ERRATA H27).
        order: of the filter, before it is run backward as well.
        filter_inputs: whether commands and forces pass the same filter as the velocities; the
            document filters the velocities alone.
        margin: cut off at both ends of every log, where the filter knows one side only.
        stretch: length of the stretches that are for training or validation as a whole.
        validate_every: every so manieth stretch validates.
    """

    interval: tuple[Seconds, Seconds] = (0.03, 0.08)
    step: Seconds = Field(default=0.05, gt=0)
    cutoff: float = Field(default=0.1, gt=0, lt=1)
    order: int = Field(default=2, ge=1, le=8)
    filter_inputs: bool = False
    margin: Seconds = Field(default=2.0, ge=0)
    stretch: Seconds = Field(default=20.0, gt=0)
    validate_every: int = Field(default=4, ge=2)

    @model_validator(mode="after")
    def _ordered(self) -> PreparationConfig:
        if not 0 < self.interval[0] <= self.interval[1]:
            raise ValueError(
                "interval: expected shortest and longest, both positive, given"
                f" {list(self.interval)} s"
            )
        return self


class TrialConfig(Config):
    """The trial.

    Attributes:
        programme: what is sailed.
        disturbance: waves and other forces.
        noise: of the measured velocities.
        preparation: from the log to samples.
        step: of the simulation, whose motion is sampled unevenly.
        seed: of the sea, the noise and the times of the samples.
    """

    programme: ProgrammeConfig = ProgrammeConfig()
    disturbance: Disturbance = Disturbance()
    noise: SensorNoise = SensorNoise(u=0.02, v=0.02, r=float(np.radians(0.1)))
    preparation: PreparationConfig = PreparationConfig()
    step: Seconds = Field(default=0.04, gt=0)
    seed: int = Field(default=0, ge=0)

    @field_validator("step")
    @classmethod
    def _fine(cls, step: float) -> float:
        if step > 0.05:
            raise ValueError(
                f"step: the simulation must be finer than the log, at most 0.05 s, given {step:g} s"
            )
        return step


@dataclass(frozen=True)
class Trial:
    """What was measured, prepared.

    Attributes:
        samples: channels `CHANNELS`, accelerations; `group` numbers stretches.
        log: number of the log that each sample belongs to, [N].
        validates: samples that models do not see, [N] bool.
        phase: number of the phase in `physics.froude.PHASES`, [N].
        step: s.
    """

    samples: Samples
    log: np.ndarray
    validates: np.ndarray
    phase: np.ndarray
    step: float

    def pieces(self, keep: np.ndarray) -> list[np.ndarray]:
        """Numbers of the kept samples [N] bool in runs without a gap."""
        chosen = np.flatnonzero(keep)
        group = self.samples.group.numpy()[chosen]
        return [
            run
            for run in np.split(
                chosen, np.flatnonzero((np.diff(chosen) > 1) | (np.diff(group) != 0)) + 1
            )
            if len(run) > 1
        ]


def odin(name: str) -> OdinConfig:
    """A vessel whose accelerations are known as terms, with water jets.

    Raises:
        ConfigError: where the vessel is of another kind.
    """
    vessel = load_vessel(name)
    if not isinstance(vessel, OdinConfig) or vessel.build().actuators.commands != CONTROLS:
        raise ConfigError(
            f"vessel '{name}': the sea trial needs a vessel of kind 'odin' with water jets, such as"
            " odin_jets"
        )
    return vessel


def sail(name: str, config: TrialConfig) -> Trial:
    """Sail the programme with a vessel and prepare its log.

    Raises:
        ConfigError: where the vessel cannot feel the disturbance or is of another kind.
        DataError: where the motion does not stay finite.
    """
    vessel, logs = odin(name), []
    for number, course in enumerate(config.programme.courses):
        plant = vessel.build()
        config.disturbance.check(plant, name)
        craft = Craft(
            name,
            TracedPlantDynamics(plant, config.step),
            Helm.from_plant(plant),
            plant.commands,
            plant.approach(1),
        )
        sea = Sea(plant, _turned(config.disturbance, course), config.noise, config.seed + number)
        logs += [
            flight.log
            for flight in fly(
                craft, config.programme.manoeuvres(), sea, config.programme.zigzag, config.step
            )
        ]
    return prepared(logs, vessel, config.preparation, config.seed)


def _turned(disturbance: Disturbance, course: float) -> Disturbance:
    """The sea as it meets a vessel that leaves on a course instead of north."""
    if disturbance.waves is None:
        return disturbance
    return disturbance.model_copy(
        update={
            "waves": disturbance.waves.model_copy(
                update={"direction": disturbance.waves.direction - course}
            )
        }
    )


def prepared(
    logs: Sequence[Log], vessel: OdinConfig, config: PreparationConfig, seed: int
) -> Trial:
    """Interpolate, filter and differentiate logs with channels u, v, r, cmd_n, cmd_nozzle."""
    random, actuators = np.random.default_rng([seed, 11]), vessel.build().actuators
    rows, rates, times, logged, stretch = [], [], [], [], []
    for number, log in enumerate(logs):
        t, z = _even(log, config, random)
        nu, command = torch.from_numpy(z[:, :3]), torch.from_numpy(z[:, 3:])
        force = actuators.force(torch.zeros(len(t), 0, dtype=torch.float64), command, nu).numpy()
        inputs = np.concatenate((z[:, 3:], force), axis=1)
        velocity = _filtered(z[:, :3], config)
        cut = round(config.margin / config.step)
        kept = slice(cut, len(t) - 1 - cut)
        rows.append(
            np.concatenate(
                (velocity, _filtered(inputs, config) if config.filter_inputs else inputs), axis=1
            )[kept]
        )
        rates.append((np.diff(velocity, axis=0) / config.step)[kept])
        times.append(t[kept])
        logged.append(np.full(len(times[-1]), number))
        stretch.append((times[-1] // config.stretch).astype(int))
    log_of, of = np.concatenate(logged), np.concatenate(stretch)
    group = np.concatenate(([0], np.cumsum((np.diff(log_of) != 0) | (np.diff(of) != 0))))
    z, t = np.concatenate(rows), np.concatenate(times)
    samples = Samples(
        torch.from_numpy(z),
        torch.from_numpy(np.concatenate(rates)),
        torch.from_numpy(group),
        torch.from_numpy(t),
        ("made",) * (group[-1] + 1),
        CHANNELS,
    )
    phase = phase_of(
        froude_number(samples.z[:, 0], samples.z[:, 1], float(vessel.length.value))
    ).numpy()
    return Trial(
        samples,
        log_of,
        (of + log_of) % config.validate_every == config.validate_every - 1,
        phase,
        config.step,
    )


def _even(
    log: Log, config: PreparationConfig, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Times [T] and u, v, r, commands [T, 5] on the uniform grid, from samples taken at uneven
    times.
    """
    end = float(log.t[-1])
    at = np.cumsum(random.uniform(*config.interval, size=round(end / config.interval[0]) + 1))
    taken = np.unique(np.searchsorted(log.t, at[at < end]))
    t = np.arange(float(log.t[taken[0]]), float(log.t[taken[-1]]), config.step)
    return t, np.stack(
        [np.interp(t, log.t[taken], log.channels[name][taken]) for name in (*VELOCITY, *CONTROLS)],
        axis=1,
    )


def _filtered(values: np.ndarray, config: PreparationConfig) -> np.ndarray:
    from scipy.signal import butter, filtfilt

    b, a = butter(config.order, config.cutoff)
    out: np.ndarray = filtfilt(b, a, values, axis=0)
    return out

"""A simulated log like that of Odin's sea trial, prepared as document 000 does (section 7.3).

The log is interpolated to a uniform grid, filtered forward and backward by a Butterworth low-pass,
and differentiated by differences (7.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from residnet.core.layout import RANGE_INPUTS, RANGE_VELOCITIES
from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.core.samples import Samples
from residnet.core.stretches import stretches
from residnet.data.simulated.environment import Disturbance
from residnet.data.simulated.flying import Craft, Sea, fly
from residnet.documents.halvorsen2019.sea_trial.config import (
    CHANNELS,
    CONTROLS,
    PreparationConfig,
    SeaTrialConfig,
    odin,
)
from residnet.dynamics.simulated import TracedPlantDynamics
from residnet.manoeuvres import Helm
from residnet.physics.froude import froude_number, phase_of
from residnet.physics.odin import OdinConfig


@dataclass(frozen=True)
class Trial:
    """The prepared samples of a trial, N in all.

    Attributes:
        samples: channels `CHANNELS` and measured accelerations; `group` numbers the stretches.
        log: number of the log that a sample belongs to [N].
        validates: samples that no model is fitted to [N] bool.
        phase: number of the phase in `physics.froude.PHASES` [N].
        step: time step in s.
    """

    samples: Samples
    log: np.ndarray
    validates: np.ndarray
    phase: np.ndarray
    step: float

    def pieces(self, keep: np.ndarray) -> list[np.ndarray]:
        """Return the indices of the kept samples, piece by piece without gaps.

        Args:
            keep: samples to keep [N] bool.
        """
        starts, stops = stretches(np.where(keep, self.samples.group.numpy(), -1))
        return [
            np.arange(start, stop)
            for start, stop in zip(starts, stops, strict=True)
            if stop - start > 1
        ]


def sail(config: SeaTrialConfig) -> Trial:
    """Simulate the programme with the vessel and prepare its logs.

    Raises:
        ConfigError: where the vessel cannot feel the disturbance or is of another kind.
        DataError: where the motion does not stay finite.
    """
    name = config.vessel
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
    """Return the waves as they meet a vessel whose course stands for north."""
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
    """Interpolate, filter and differentiate logs.

    Args:
        logs: logs with the channels u, v, r, cmd_n and cmd_nozzle.
        vessel: vessel that sailed them, whose jets turn commands into forces.
        config: how the logs are prepared.
        seed: seed of the times of the samples.
    """
    random, actuators = np.random.default_rng([seed, 11]), vessel.build().actuators
    rows, rates, times, log_numbers, stretches = [], [], [], [], []
    for number, given in enumerate(logs):
        t, z = _even(given, config, random)
        nu, command = torch.from_numpy(z[:, RANGE_VELOCITIES]), torch.from_numpy(z[:, RANGE_INPUTS])
        force = actuators.force(torch.zeros(len(t), 0, dtype=torch.float64), command, nu).numpy()
        inputs = np.concatenate((z[:, RANGE_INPUTS], force), axis=1)
        velocity = _filtered(z[:, RANGE_VELOCITIES], config)
        cut = round(config.margin / config.step)
        kept = slice(cut, len(t) - 1 - cut)
        rows.append(
            np.concatenate(
                (velocity, _filtered(inputs, config) if config.filter_inputs else inputs), axis=1
            )[kept]
        )
        rates.append((np.diff(velocity, axis=0) / config.step)[kept])
        times.append(t[kept])
        log_numbers.append(np.full(len(times[-1]), number))
        stretches.append((times[-1] // config.stretch).astype(int))
    log, stretch = np.concatenate(log_numbers), np.concatenate(stretches)
    group = np.concatenate(([0], np.cumsum((np.diff(log) != 0) | (np.diff(stretch) != 0))))
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
        log,
        (stretch + log) % config.validate_every == config.validate_every - 1,
        phase,
        config.step,
    )


def _even(
    log: Log, config: PreparationConfig, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return times [T] and channels [T, 5] on the uniform grid, from samples at uneven times."""
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

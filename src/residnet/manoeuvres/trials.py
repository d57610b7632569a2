"""Simulated sea trials: manoeuvres of a plant or a learned model, and their logs.

Forces, current, wind and waves act on a vessel, and sensors with errors measure its motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout, Source
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.sources import StackedSource, StopRecorder
from residnet.manoeuvres.trials_config import (
    DisturbanceConfig,
    SensorsConfig,
    SimulatedTrials,
    list_logged_channels,
    make_log_names,
    simulate_wind,
)
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.vessel import load_vessel


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
        manoeuvres: the manoeuvres; manoeuvres of one kind are consecutive.
        helm: properties of the vessel.
        times: times [T] of the steps in s.

    Raises:
        UsageError: if the vessel lacks a state or command that a manoeuvre needs.
    """
    manoeuvres_by_kind = [
        list(manoeuvres_of_kind)
        # groupby joins consecutive elements only; the order of the rows is kept
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
    # inputs that the manoeuvre does not command: disturbances of a plant, wind of a learned model
    generator = np.random.default_rng([environment.seed, 3])
    source = make_manoeuvre_source(manoeuvres, vessel.helm, times)
    if environment.plant is not None:
        plant_inputs = environment.disturbance.draw_plant_inputs(
            environment.plant, n_trials, n_steps, dt, environment.seed, generator
        )
        # waves depend on the position, so that they are computed during the simulation
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
    # drawn even without noise, so that random numbers do not depend on the config
    velocity_noise = generator.standard_normal((n_trials, n_steps, 3)) * [
        environment.sensors.u,
        environment.sensors.v,
        environment.sensors.r,
    ]
    channel_names = list_logged_channels(
        vessel.helm.state, vessel.helm.inputs[: vessel.n_commands], environment.disturbance
    )
    # one log for each manoeuvre, up to its stop condition
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
            # the log ends before the first sample that is not finite
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
            for channel_name in channel_names
        }
        log_times = times[:n_valid_steps].numpy().copy()
        measured_channels = environment.sensors.measure(
            true_channels, log_times, velocity_noise[i, :n_valid_steps], (environment.seed, 6, i)
        )
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in true_channels}
        true_log = Log(log_name, log_times, true_channels, units, manoeuvre.kind, meta=log_metadata)
        runs.append(ManoeuvreRun(manoeuvre, true_log, true_log.replace(channels=measured_channels)))
    return runs


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


def build_plant(vessel: str, disturbance: DisturbanceConfig) -> Plant:
    """Return the plant of a vessel, without environment if there is no disturbance.

    The results are equal, and the simulation of an underwater vehicle takes half the time.
    """
    plant = load_vessel(vessel).build()
    if isinstance(plant, HullPlant) and not disturbance.required_plant_inputs():
        return plant.without_environment()
    return plant


def build_trial_vessel(config: SimulatedTrials) -> SimulatedVessel:
    """Build the plant with its disturbances, the time step and the helm of simulated trials."""
    plant = build_plant(config.vessel, config.disturbance)
    return SimulatedVessel(
        config.vessel,
        PlantDynamics(plant, config.step, config.substeps),
        Helm.from_plant(plant),
        plant.n_commands,
        plant.make_initial_state(1),
    )


def simulate_trial_logs(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[Log]:
    """Simulate trials and return their logs only; see `simulate_trials`."""
    return [run.measured_log for run in simulate_trials(manoeuvres, config)]

"""Optimal design of the next manoeuvre for the parameters of a refitted baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Metres, MetresPerSecond, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import (
    DYNAMIC_STATES,
    POSITION,
    SURGE,
    SURGE_SWAY_YAW,
    SWAY,
    DegreesOfFreedom,
)
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.identification.fitter import FittedModel
from residnet.manoeuvres.actuated import (
    ActuatedDynamics,
    GivenActuators,
    InputShare,
    command_name_for,
)
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import TurningCircle, Zigzag
from residnet.manoeuvres.open_loop import AccelerationDeceleration, MultiSine, ThreeTwoOneOne
from residnet.manoeuvres.trials import (
    DisturbanceConfig,
    ManoeuvreRun,
    SensorsConfig,
    SimulatedVessel,
    TrialEnvironment,
    simulate_manoeuvres,
)
from residnet.physics.signals import SignalsConfig
from residnet.training.left_out import RefitUncertainty
from residnet.training.refit import RefitConfig, require_parametric_baseline, sensitivities


@torch.no_grad()
def sensitivity_information(
    model: HybridDynamics, runs: Sequence[tuple[Tensor, Tensor]], horizon: int, scales: Tensor
) -> Tensor:
    """Return the Fisher information of each run about the parameters, [R, P, P].

    Sums over samples of squared scaled sensitivities of the velocities. Each run is divided into
    free runs of `horizon` steps from measured states, as in a refit; a remainder is dropped.

    Args:
        model: a baseline without a head.
        runs: states [T + 1, 3 + n] and inputs held over each step [T, m] of R runs.
        horizon: steps of the free runs of a refit.
        scales: scales of the velocities [n].
    """
    window_starts = [
        (run, window_index * horizon)
        for run, (_, inputs) in enumerate(runs)
        for window_index in range(len(inputs) // horizon)
    ]
    n_parameters = len(require_parametric_baseline(model).free_indices())
    gram_by_run = torch.zeros(len(runs), n_parameters, n_parameters, dtype=scales.dtype)
    if not window_starts:
        return gram_by_run
    run_indices = torch.tensor([run for run, _ in window_starts])
    states = torch.stack([runs[run][0][start : start + horizon] for run, start in window_starts])
    inputs = torch.stack([runs[run][1][start : start + horizon] for run, start in window_starts])
    for _, sensitivity in sensitivities(model, states, inputs):
        for normalized_sensitivity in sensitivity[:, :, 1:] / scales[:, None]:
            gram_by_run.index_add_(
                0, run_indices, normalized_sensitivity.transpose(1, 2) @ normalized_sensitivity
            )
    return gram_by_run


def update_covariance(covariance: Tensor, information: Tensor) -> Tensor:
    """Return the covariance [P, P] after data with some information [P, P].

    Parameters without a covariance are unchanged.
    """
    identity = torch.eye(len(covariance), dtype=covariance.dtype)
    posterior: Tensor = covariance @ torch.linalg.inv(identity + information @ covariance)
    return posterior


def compute_volume_gain(covariance: Tensor, information: Tensor) -> float:
    """Return by how much the logarithm of the ellipsoid's volume shrinks (D-optimality)."""
    identity = torch.eye(len(covariance), dtype=covariance.dtype)
    return 0.5 * float(torch.linalg.slogdet(identity + information @ covariance)[1])


def compute_expected_uncertainty(covariance: Tensor, goal_weights: Tensor) -> float:
    """Return the root mean square uncertainty of what a goal [P, P] weighs (A-optimality)."""
    return float((goal_weights * covariance).sum().clamp(min=0.0).sqrt())


_SIDE_STEER_SIGNS = {"port": 1.0, "stbd": -1.0, "starboard": -1.0, "left": 1.0, "right": -1.0}
"""Which way more of a side's thrust turns the vessel."""


class TrialLimits(Config):
    """What a trial may use.

    Attributes:
        time: that each candidate lasts, in s.
        area: largest distance from the start, in m; none where not given.
        speed: largest speed in m/s; none where not given.
        rudder: largest share of full steer.
        count: number of trials to choose.
    """

    time: Seconds = Field(default=120.0, gt=0)
    area: Metres | None = Field(default=None, gt=0)
    speed: MetresPerSecond | None = Field(default=None, gt=0)
    rudder: float = Field(default=1.0, gt=0, le=1)
    count: int = Field(default=3, ge=1)


def propose_manoeuvres(
    trial_limits: TrialLimits, dof: DegreesOfFreedom = SURGE_SWAY_YAW
) -> list[Manoeuvre]:
    """Return zigzags, turns, 3-2-1-1, multi-sines and speed changes at several drives.

    Those that wait for a heading are for a vessel that turns, and several drives and changes of
    speed for one that moves ahead.
    """
    manoeuvres: list[Manoeuvre] = []
    duration = trial_limits.time
    max_steer = trial_limits.rudder
    open_loop_timing: dict[str, Any] = {"duration": duration, "start": 0.05 * duration}
    closed_loop_timing: dict[str, Any] = {"duration": duration, "start": 0.1 * duration}
    for drive in (0.4, 0.7, 1.0) if dof.has_position else (1.0,):
        drive_label = f"drive_{round(100 * drive)}"
        if dof.has_heading:
            manoeuvres += [
                Zigzag(
                    name=(
                        f"zigzag_{angle:.0f}_steer_{round(100 * steer_share * max_steer)}"
                        f"_{drive_label}"
                    ),
                    drive=drive,
                    steer=steer_share * max_steer,
                    heading=math.radians(angle),
                    **closed_loop_timing,
                )
                for angle in (10.0, 20.0)
                for steer_share in (0.5, 1.0)
            ]
            manoeuvres += [
                TurningCircle(
                    name=f"turn_{side_name}_{drive_label}",
                    drive=drive,
                    steer=steer_sign * max_steer,
                    **closed_loop_timing,
                )
                for side_name, steer_sign in (("starboard", 1.0), ("port", -1.0))
            ]
        manoeuvres += [
            ThreeTwoOneOne(
                name=f"3211_{unit_share * duration:.0f}s_{drive_label}",
                drive=drive,
                steer=max_steer,
                unit=unit_share * duration,
                **open_loop_timing,
            )
            for unit_share in (0.02, 0.05)
        ]
        manoeuvres.append(
            MultiSine(
                name=f"multi_sine_{drive_label}",
                drive=0.5 * drive,
                drive_amplitude=0.5 * drive,
                steer_amplitude=max_steer,
                band=(2.0 / duration, 20.0 / duration),
                duration=duration,
            )
        )
    if dof.has_position:
        switch_times = tuple(0.25 * duration * k for k in range(4))
        drive_levels = (1.0, 0.0, 0.6, 0.2)
        manoeuvres.append(
            AccelerationDeceleration(
                name="speed_changes", times=switch_times, levels=drive_levels, duration=duration
            )
        )
    return manoeuvres


def infer_input_shares(spec: ModelSpec) -> Mapping[str, InputShare]:
    """Return shares of drive and steer of the inputs, within their training ranges.

    Raises:
        UsageError: if no input steers.
    """
    units = spec.signals.channel_units()
    ranges = spec.ranges
    shares = {}
    for name in spec.signals.inputs:
        max_input = max(map(abs, ranges[name]))
        steer_sign = next(
            (
                side_sign
                for side_name, side_sign in _SIDE_STEER_SIGNS.items()
                if side_name in name.split("_")
            ),
            0.0,
        )
        if units.get(name) == "rad" or name == "tau_n":
            shares[name] = InputShare(steer=max_input, limit=max_input)
        elif steer_sign:
            shares[name] = InputShare(
                drive=0.6 * max_input, steer=0.6 * steer_sign * max_input, limit=max_input
            )
        else:
            shares[name] = InputShare(drive=max_input, limit=max_input)
    if spec.signals.dof.has_heading and not any(share.steer for share in shares.values()):
        raise UsageError(
            f"model {spec.name}: none of {', '.join(spec.signals.inputs)} is known to steer; say"
            " how inputs follow drive and steer in the run's `booklet.inputs`"
        )
    return shares


@dataclass(frozen=True)
class PredictionGoal:
    """Manoeuvres whose prediction intervals are to be reduced, such as those of a booklet.

    Attributes:
        manoeuvres: the manoeuvres.
        duration: duration of manoeuvres without an own one, s.
        initial: initial states by name.
    """

    manoeuvres: Sequence[Manoeuvre]
    duration: float
    initial: Mapping[str, float]


@dataclass(frozen=True)
class CandidateTrial:
    """A candidate as the model flies it.

    Attributes:
        simulated_run: of the model.
        information: summed squares of its sensitivities [P, P].
        duration_minutes: that it lasts.
        volume_gain_per_minute: logarithm by which it shrinks the ellipsoid of the parameters, per
            minute.
        uncertainty_reduction: share by which it narrows the intervals of predictions.
        max_distance: largest distance from the start in m.
    """

    simulated_run: ManoeuvreRun
    information: Tensor
    duration_minutes: float
    volume_gain_per_minute: float
    uncertainty_reduction: float
    max_distance: float


@dataclass(frozen=True)
class TrialPlan:
    """Candidates, the most telling per minute first, and the trials to run.

    Attributes:
        candidates: all candidates within the limits.
        selected_trials: the trials to run, in their order.
        uncertainty_reduction: share by which they narrow the intervals of predictions together.
    """

    candidates: Sequence[CandidateTrial]
    selected_trials: Sequence[CandidateTrial]
    uncertainty_reduction: float


def plan_trials(
    fitted_model: FittedModel,
    unidentified: RefitUncertainty,
    refit_config: RefitConfig,
    state_scales_array: np.ndarray,
    input_shares: Mapping[str, InputShare],
    velocity_limits: np.ndarray,
    trial_limits: TrialLimits,
    goal_manoeuvres: PredictionGoal | None = None,
) -> TrialPlan:
    """Return the trials that reduce the prediction intervals most per minute.

    Predictions are the velocities over the manoeuvres of `goal_manoeuvres`. Trials are selected
    greedily, each given the previous ones.

    Args:
        unidentified: parameters that the refit did not determine.
        state_scales_array: scales of the velocities [n].
        input_shares: shares of the inputs in drive and steer.
        velocity_limits: velocities [n] above which a simulation has diverged.
        goal_manoeuvres: manoeuvres to predict; None for all candidates.

    Raises:
        DataError: if no candidate is within the limits, or all parameters are determined.
    """
    spec = fitted_model.spec
    model = fitted_model.model.double()
    spec.signals.dof.require_on_surface("the plan of a trial")
    horizon = round(refit_config.horizon / spec.dt)
    state_scales = torch.from_numpy(state_scales_array)
    manoeuvres = propose_manoeuvres(trial_limits, spec.signals.dof)
    # those of one kind fly together
    all_candidates = PredictionGoal(
        sorted(manoeuvres, key=lambda one: one.kind), trial_limits.time, {}
    )
    simulated_trajectories = [
        (simulated_run, *_to_trajectory(simulated_run, spec.signals))
        for simulated_run in _simulate_manoeuvres(fitted_model, input_shares, all_candidates)
    ]
    allowed_trajectories = [
        item
        for item in simulated_trajectories
        if _is_within_limits(item[1], velocity_limits, trial_limits)
    ]
    if not allowed_trajectories:
        raise DataError(
            f"none of {len(simulated_trajectories)} candidates stays within the limits; allow"
            f" more area, speed or"
            " rudder, or less time"
        )
    grams = sensitivity_information(
        model, [(states, w) for _, states, w in allowed_trajectories], horizon, state_scales
    )
    # so many samples hang together that they count as one
    information_per_gram = spec.dt / refit_config.correlation / max(unidentified.square, 1e-12)
    goal_weights = grams.sum(dim=0)
    if goal_manoeuvres is not None:
        goal_trajectories = [
            _to_trajectory(item, spec.signals)
            for item in _simulate_manoeuvres(fitted_model, input_shares, goal_manoeuvres)
        ]
        goal_weights = sensitivity_information(model, goal_trajectories, horizon, state_scales).sum(
            dim=0
        )
    initial_uncertainty = compute_expected_uncertainty(unidentified.covariance, goal_weights)
    if not (np.isfinite(initial_uncertainty) and initial_uncertainty > 0.0):
        raise DataError(
            f"model {fitted_model.name}: its refit leaves nothing open of the manoeuvres to"
            f" predict, or"
            f" it cannot fly them for {refit_config.horizon:g} s; add logs that cover their"
            f" speeds and"
            " rudder angles, or shorten refit.horizon"
        )
    trials = []
    for (simulated_run, states, _), gram in zip(allowed_trajectories, grams, strict=True):
        duration_minutes = (len(states) - 1) * spec.dt / 60.0
        information = information_per_gram * gram
        volume_gain_ = compute_volume_gain(unidentified.covariance, information) / duration_minutes
        uncertainty_reduction = (
            1.0
            - compute_expected_uncertainty(
                update_covariance(unidentified.covariance, information), goal_weights
            )
            / initial_uncertainty
        )
        trials.append(
            CandidateTrial(
                simulated_run,
                information,
                duration_minutes,
                volume_gain_,
                uncertainty_reduction,
                _distance_from_start(states),
            )
        )
    trials.sort(key=lambda trial: -trial.uncertainty_reduction / trial.duration_minutes)
    selected_trials: list[CandidateTrial] = []
    current_covariance = unidentified.covariance
    for _ in range(min(trial_limits.count, len(trials))):
        current_uncertainty = compute_expected_uncertainty(current_covariance, goal_weights)

        def gain(
            trial: CandidateTrial,
            covariance: Tensor = current_covariance,
            uncertainty: float = current_uncertainty,
        ) -> float:
            return (
                uncertainty
                - compute_expected_uncertainty(
                    update_covariance(covariance, trial.information), goal_weights
                )
            ) / trial.duration_minutes

        best_trial = max((trial for trial in trials if trial not in selected_trials), key=gain)
        selected_trials.append(best_trial)
        current_covariance = update_covariance(current_covariance, best_trial.information)
    total_information = sum(
        (trial.information for trial in selected_trials), torch.zeros_like(goal_weights)
    )
    return TrialPlan(
        trials,
        selected_trials,
        1.0
        - compute_expected_uncertainty(
            update_covariance(unidentified.covariance, total_information), goal_weights
        )
        / initial_uncertainty,
    )


def _simulate_manoeuvres(
    fitted_model: FittedModel,
    input_shares: Mapping[str, InputShare],
    goal_manoeuvres: PredictionGoal,
) -> list[ManoeuvreRun]:
    spec = fitted_model.spec
    model = fitted_model.model.double()
    actuators = GivenActuators(input_shares, spec.signals.exogenous, spec.dt)
    actuated = ActuatedDynamics(model, spec.signals.input_columns, spec.hold, actuators)
    initial_state = actuated.make_initial_state(1)
    # trials begin at a speed in the middle of what the model knows
    initial_state[:, SURGE] = 0.5 * (max(spec.low[0], 0.0) + spec.high[0])
    for name, value in goal_manoeuvres.initial.items():
        initial_state[:, actuated.state_names.index(name)] = float(value)
    vessel = SimulatedVessel(
        fitted_model.name,
        actuated,
        Helm(actuators.commands_for_demand, actuated.state_names, actuators.input_names),
        actuators.n_commands,
        initial_state,
    )
    environment = TrialEnvironment(None, DisturbanceConfig(), SensorsConfig(), 0)
    return simulate_manoeuvres(
        vessel, list(goal_manoeuvres.manoeuvres), environment, goal_manoeuvres.duration, spec.dt
    )


def _to_trajectory(simulated_run: ManoeuvreRun, signals: SignalsConfig) -> tuple[Tensor, Tensor]:
    """Return states [T + 1, 3 + n] and inputs [T, m] of a flight."""
    motion = simulated_run.true_log
    channel_values: dict[str, Any] = motion.channels
    zeros = np.zeros(len(motion))
    # what nobody commands, such as the wind, is left at rest
    inputs = [
        channel_values.get(name, channel_values.get(command_name_for(name), zeros))
        for name in signals.input_columns
    ]
    states = torch.from_numpy(motion.stack(signals.dof.state_names))
    return states, torch.from_numpy(np.stack(inputs, axis=1))[:-1]


def _distance_from_start(states: Tensor) -> float:
    return float((states[:, POSITION] - states[0, POSITION]).norm(dim=1).max())


def _is_within_limits(
    states: Tensor, velocity_limits: np.ndarray, trial_limits: TrialLimits
) -> bool:
    """Return whether a simulated run is finite and within the limits."""
    max_velocities = states[:, DYNAMIC_STATES].abs().amax(0).numpy()
    max_speed = float(torch.hypot(states[:, SURGE], states[:, SWAY]).max())
    return bool(
        (max_velocities <= velocity_limits).all()
        and (trial_limits.area is None or _distance_from_start(states) <= trial_limits.area)
        and (trial_limits.speed is None or max_speed <= trial_limits.speed)
    )

"""Optimal design of the next trials for the parameters of a refitted baseline.

Sequential optimal experiment design: candidates are simulated with the fitted model, the Fisher
information of each is computed from output sensitivities, and trials are chosen greedily by the
reduction of the uncertainty of predictions per minute (Pronzato 2008, Automatica 44, 303-325).
"""

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
from residnet.manoeuvres.actuated import ActuatedDynamics, ConfiguredActuators, command_name_for
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import TurningCircle, Zigzag
from residnet.manoeuvres.input_shares import InputShare
from residnet.manoeuvres.open_loop import AccelerationDeceleration, MultiSine, ThreeTwoOneOne
from residnet.manoeuvres.trials import (
    ManoeuvreRun,
    SimulatedVessel,
    TrialEnvironment,
    simulate_manoeuvres,
)
from residnet.manoeuvres.trials_config import DisturbanceConfig, SensorsConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.training.left_out import RefitUncertainty
from residnet.training.refit import require_parametric_baseline, sensitivities
from residnet.training.refit_config import RefitConfig


@torch.no_grad()
def sensitivity_information(
    model: HybridDynamics, runs: Sequence[tuple[Tensor, Tensor]], horizon: int, scales: Tensor
) -> Tensor:
    """Return the Fisher information of each run about the parameters, [R, P, P].

    It is the sum over samples of S^T S with the sensitivities S of the velocities, divided by their
    scales. Each run is divided into free runs of `horizon` steps, as in a refit, because the
    information of one long free run would overstate what a refit can use; a remainder is dropped.

    Args:
        model: a baseline without a head.
        runs: states [T + 1, 3 + n] of R runs, and the inputs of each step [T, m].
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
    """Return the covariance [P, P] after data with Fisher information [P, P].

    The covariance of a parameter that is zero remains zero.
    """
    # P (I + J P)^-1 equals (P^-1 + J)^-1 and also holds for a singular P
    identity = torch.eye(len(covariance), dtype=covariance.dtype)
    posterior: Tensor = covariance @ torch.linalg.inv(identity + information @ covariance)
    return posterior


def compute_volume_gain(covariance: Tensor, information: Tensor) -> float:
    """Return the reduction of the logarithm of the confidence ellipsoid's volume (D-optimality)."""
    identity = torch.eye(len(covariance), dtype=covariance.dtype)
    return 0.5 * float(torch.linalg.slogdet(identity + information @ covariance)[1])


def compute_expected_uncertainty(covariance: Tensor, goal_weights: Tensor) -> float:
    """Return the root mean square uncertainty of predictions with Gramian [P, P] (A-optimality)."""
    return float((goal_weights * covariance).sum().clamp(min=0.0).sqrt())


_SIDE_STEER_SIGNS = {"port": 1.0, "stbd": -1.0, "starboard": -1.0, "left": 1.0, "right": -1.0}
"""Sign of the yaw moment of more thrust on the side that an input is named after."""


class TrialLimits(Config):
    """Limits of the trials.

    Attributes:
        time: duration of each candidate, in s.
        area: largest distance from the start, in m; null for no limit.
        speed: largest speed in m/s; null for no limit.
        rudder: largest fraction of the full steering command.
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
    """Return zigzags, turns, 3-2-1-1, multi-sines and speed changes at several propulsion commands.

    Zigzags and turns, which depend on the heading, require a model of the heading; several
    propulsion commands and speed changes require a model with a position.
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
    """Return the shares of the inputs in propulsion and steering, within their training ranges.

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
                # differential thrust: the sum of both full commands is limited to max_input
                drive=0.6 * max_input,
                steer=0.6 * steer_sign * max_input,
                limit=max_input,
            )
        else:
            shares[name] = InputShare(drive=max_input, limit=max_input)
    if spec.signals.dof.has_heading and not any(share.steer for share in shares.values()):
        raise UsageError(
            f"model {spec.name}: none of {', '.join(spec.signals.inputs)} is recognised as a"
            " steering input by its name or unit; define the shares of drive and steer in the run's"
            " `booklet.inputs`"
        )
    return shares


@dataclass(frozen=True)
class PredictionGoal:
    """Manoeuvres whose prediction intervals are to be reduced, as in a manoeuvring booklet.

    Attributes:
        manoeuvres: the manoeuvres.
        duration: duration of manoeuvres that define none, s.
        initial: initial states by name.
    """

    manoeuvres: Sequence[Manoeuvre]
    duration: float
    initial: Mapping[str, float]


@dataclass(frozen=True)
class CandidateTrial:
    """A candidate trial, simulated with the model.

    Attributes:
        simulated_run: simulated manoeuvre.
        information: Fisher information about the parameters [P, P].
        duration_minutes: duration in minutes.
        volume_gain_per_minute: reduction of the logarithm of the confidence ellipsoid's volume,
            per minute.
        uncertainty_reduction: relative reduction of the width of the prediction intervals.
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
    """Candidates in descending order of their information per minute, and the selected trials.

    Attributes:
        candidates: all candidates within the limits.
        selected_trials: the trials to run, in their order.
        uncertainty_reduction: relative reduction of the width of the prediction intervals by all
            selected trials.
    """

    candidates: Sequence[CandidateTrial]
    selected_trials: Sequence[CandidateTrial]
    uncertainty_reduction: float


def plan_trials(
    fitted_model: FittedModel,
    refit_uncertainty: RefitUncertainty,
    refit_config: RefitConfig,
    state_scales_array: np.ndarray,
    input_shares: Mapping[str, InputShare],
    velocity_limits: np.ndarray,
    trial_limits: TrialLimits,
    prediction_goal: PredictionGoal | None = None,
) -> TrialPlan:
    """Return the trials that reduce the prediction intervals most per minute.

    Predictions are the velocities over the manoeuvres of `prediction_goal`. Trials are selected
    greedily, each given the previous ones.

    Args:
        fitted_model: model with a refitted baseline.
        refit_uncertainty: uncertainty of the refitted parameters.
        refit_config: settings of the refit, whose horizon and correlation time are used.
        state_scales_array: scales of the velocities [n].
        input_shares: shares of the inputs in propulsion command and steering command.
        velocity_limits: velocities [n] above which a simulation has diverged.
        trial_limits: limits and number of the trials.
        prediction_goal: manoeuvres to predict; None for all candidates.

    Raises:
        DataError: if no candidate is within the limits, or all parameters are determined.
    """
    spec = fitted_model.spec
    model = fitted_model.model.double()
    spec.signals.dof.require_on_surface("the plan of a trial")
    horizon = round(refit_config.horizon / spec.dt)
    state_scales = torch.from_numpy(state_scales_array)
    manoeuvres = propose_manoeuvres(trial_limits, spec.signals.dof)
    # simulate all candidates and keep those within the limits; manoeuvres of the same class are
    # simulated as one batch
    all_candidates = PredictionGoal(
        sorted(manoeuvres, key=lambda manoeuvre: manoeuvre.kind), trial_limits.time, {}
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
            f"none of {len(simulated_trajectories)} candidates stays within the limits;"
            " increase area, speed or rudder, or reduce the time"
        )
    grams = sensitivity_information(
        model, [(states, w) for _, states, w in allowed_trajectories], horizon, state_scales
    )
    # Information of each candidate. Errors of successive samples are correlated over `correlation`
    # seconds: a sample counts as dt / correlation independent ones. The unit is the inverse of the
    # residual variance.
    information_per_gram = (
        spec.dt / refit_config.correlation / max(refit_uncertainty.mean_square_error, 1e-12)
    )
    # weights of the parameters in the predictions whose intervals are to be reduced
    goal_weights = grams.sum(dim=0)
    if prediction_goal is not None:
        goal_trajectories = [
            _to_trajectory(item, spec.signals)
            for item in _simulate_manoeuvres(fitted_model, input_shares, prediction_goal)
        ]
        goal_weights = sensitivity_information(model, goal_trajectories, horizon, state_scales).sum(
            dim=0
        )
    initial_uncertainty = compute_expected_uncertainty(refit_uncertainty.covariance, goal_weights)
    if not (np.isfinite(initial_uncertainty) and initial_uncertainty > 0.0):
        raise DataError(
            f"model {fitted_model.name}: its refit leaves no uncertainty in the manoeuvres to"
            f" predict, or it cannot simulate them for {refit_config.horizon:g} s; add logs that"
            " cover their speeds and rudder angles, or shorten refit.horizon"
        )
    # benefit of each candidate alone, then the greedy selection of several
    trials = []
    for (simulated_run, states, _), gram in zip(allowed_trajectories, grams, strict=True):
        duration_minutes = (len(states) - 1) * spec.dt / 60.0
        information = information_per_gram * gram
        volume_gain_per_minute = (
            compute_volume_gain(refit_uncertainty.covariance, information) / duration_minutes
        )
        uncertainty_reduction = (
            1.0
            - compute_expected_uncertainty(
                update_covariance(refit_uncertainty.covariance, information), goal_weights
            )
            / initial_uncertainty
        )
        trials.append(
            CandidateTrial(
                simulated_run,
                information,
                duration_minutes,
                volume_gain_per_minute,
                uncertainty_reduction,
                _distance_from_start(states),
            )
        )
    trials.sort(key=lambda trial: -trial.uncertainty_reduction / trial.duration_minutes)
    selected_trials = _select_trials(
        trials, trial_limits.count, refit_uncertainty.covariance, goal_weights
    )
    total_information = sum(
        (trial.information for trial in selected_trials), torch.zeros_like(goal_weights)
    )
    return TrialPlan(
        trials,
        selected_trials,
        1.0
        - compute_expected_uncertainty(
            update_covariance(refit_uncertainty.covariance, total_information), goal_weights
        )
        / initial_uncertainty,
    )


def _select_trials(
    trials: Sequence[CandidateTrial], count: int, covariance: Tensor, goal_weights: Tensor
) -> list[CandidateTrial]:
    """Select trials greedily by their reduction of the uncertainty per minute.

    Args:
        trials: the candidates.
        count: largest number of selected trials.
        covariance: covariance [P, P] of the parameters before the trials.
        goal_weights: weights [P, P] of the parameters in the predictions.
    """
    selected_trials: list[CandidateTrial] = []
    for _ in range(min(count, len(trials))):
        uncertainty = compute_expected_uncertainty(covariance, goal_weights)

        # the gain of a trial depends on the previous ones: two equal trials add little
        def compute_gain(
            trial: CandidateTrial, covariance: Tensor = covariance, uncertainty: float = uncertainty
        ) -> float:
            next_covariance = update_covariance(covariance, trial.information)
            next_uncertainty = compute_expected_uncertainty(next_covariance, goal_weights)
            return (uncertainty - next_uncertainty) / trial.duration_minutes

        remaining_trials = [trial for trial in trials if trial not in selected_trials]
        best_trial = max(remaining_trials, key=compute_gain)
        selected_trials.append(best_trial)
        covariance = update_covariance(covariance, best_trial.information)
    return selected_trials


def _simulate_manoeuvres(
    fitted_model: FittedModel,
    input_shares: Mapping[str, InputShare],
    prediction_goal: PredictionGoal,
) -> list[ManoeuvreRun]:
    """Simulate the manoeuvres whose prediction is to be improved, with the fitted model."""
    spec = fitted_model.spec
    model = fitted_model.model.double()
    actuators = ConfiguredActuators(input_shares, spec.signals.exogenous, spec.dt)
    actuated = ActuatedDynamics(model, spec.signals.regressor_columns, spec.hold, actuators)
    initial_state = actuated.make_initial_state(1)
    # trials start at the middle of the training range of the speed, where the model is reliable
    initial_state[:, SURGE] = 0.5 * (max(spec.low[0], 0.0) + spec.high[0])
    for name, value in prediction_goal.initial.items():
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
        vessel, list(prediction_goal.manoeuvres), environment, prediction_goal.duration, spec.dt
    )


def _to_trajectory(simulated_run: ManoeuvreRun, signals: SignalsConfig) -> tuple[Tensor, Tensor]:
    """Return states [T + 1, 3 + n] and inputs [T, m] of a simulated run."""
    motion = simulated_run.true_log
    channel_values: dict[str, Any] = motion.channels
    zeros = np.zeros(len(motion))
    # inputs that are not commanded, such as the wind, are zero
    inputs = [
        channel_values.get(name, channel_values.get(command_name_for(name), zeros))
        for name in signals.regressor_columns
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

"""Evaluation of models by free runs over the windows of protocols, in batches."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from residnet.core.columns import level_velocities
from residnet.core.frames import compose_rotation, rotation_angle_between, wrap_angle_array
from residnet.core.layout import (
    ATTITUDE,
    HEADING,
    POSE,
    POSITION,
    SURGE_SWAY_YAW,
    DegreesOfFreedom,
    to_horizontal_plane,
)
from residnet.dynamics.base import Dynamics
from residnet.dynamics.domain import log_domain_distance
from residnet.dynamics.domain_config import OperatingDomain
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import Rollout
from residnet.evaluation.band import Band, band_channels
from residnet.evaluation.protocol import Window
from residnet.evaluation.records import ModelKind
from residnet.preprocessing.prepare import PreparedLog

_MAX_LENGTH_RATIO = 4
"""Largest ratio of window lengths in one batch; shorter windows run on to the longest length."""
_RUNS_PER_STRUCTURE = 8
"""Nominal number of batches of free runs of models with one structure, which are compiled once.

A fit runs them to select settings, without each fold and kind for prediction intervals, and to
evaluate them.
"""
_MAX_BATCH_VALUES = 30_000_000
"""Largest number of values of a batch, which bounds the memory used."""
_MEASURED_SPEED_MARGIN = 2.0
"""A run has not diverged below this multiple of the measured maximum of the window."""


@dataclass(frozen=True)
class Candidate:
    """A model to evaluate.

    Attributes:
        name: unique name in a run.
        model_kind: constant_velocity, baseline, head, plant or ensemble.
        model: the dynamics; a model with float64 parameters runs in float64.
        state_names: names of the model's states; empty for the states of the prepared logs. Further
            states (actuators) start from the log's channels.
        input_names: channels of the log that form w; None for the prepared inputs.
        n_zero_inputs: number of further inputs that are zero (unmeasured disturbances).
        reference: name of the model of the paired comparison; None for none.
        training_ranges: smallest and largest training value of each velocity and input; empty if
            unknown.
        bands: prediction intervals by protocol; may be empty.
        members: members of an ensemble of trajectories; empty for a single model.
        spread_members: models whose disagreement measures extrapolation; empty for none.
        domain: operating domain of the training logs, to which predictions have a distance; None if
            unknown.
        domain_inputs: names of the prepared inputs.
    """

    name: str
    model_kind: ModelKind
    model: Dynamics
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] | None = None
    n_zero_inputs: int = 0
    reference: str | None = None
    training_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    bands: Mapping[str, Band] = field(default_factory=dict)
    members: tuple[str, ...] = ()
    spread_members: tuple[str, ...] = ()
    domain: OperatingDomain | None = None
    domain_inputs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Prediction:
    """Prediction of one model for one window.

    Attributes:
        states: velocities of the model and the integrated pose [L, 3 + n].
        has_diverged: whether the free run has diverged.
        spread: standard deviation between ensemble members by channel, from the first step on
            [L - 1, c]; None without an ensemble.
        distance: running mean of the log distance to the training data, from the first step on
            [L - 1], see `log_domain_distance`; None without a density.
    """

    states: np.ndarray
    has_diverged: bool
    spread: np.ndarray | None = None
    distance: np.ndarray | None = None


@dataclass(frozen=True)
class FreeRun:
    """The free runs of all models over all windows of one protocol and split.

    predictions[model][i] belongs to windows[i].
    """

    protocol: str
    split: str
    windows: list[Window]
    predictions: dict[str, list[Prediction]] = field(default_factory=dict)


@dataclass(frozen=True)
class FreeRunErrors:
    """Errors of one model's free runs, the samples of all W windows concatenated.

    u, v and the position are scored over usable samples. r, heading and roll do not depend on the
    position sensor and are scored over all samples.

    Attributes:
        error: predicted minus measured states [N, 3 + n]; psi is wrapped to half a turn.
        is_usable: usable samples [N].
        window_lengths: number of samples of each window [W].
        dof: measured velocities; errors of the others are ignored.
        attitude_error: rotation angle between the attitudes [N]; None for surface vessels.
    """

    error: np.ndarray
    is_usable: np.ndarray
    window_lengths: np.ndarray
    dof: DegreesOfFreedom = SURGE_SWAY_YAW
    attitude_error: np.ndarray | None = None

    @classmethod
    def from_predictions(
        cls,
        windows: Sequence[Window],
        predictions: Sequence[Prediction],
        logs: Sequence[PreparedLog],
    ) -> FreeRunErrors:
        """Compute predicted minus measured states of free runs, one prediction for each window."""
        log_slices = [
            (logs[window.log_index], slice(window.start, window.stop)) for window in windows
        ]
        predicted = np.concatenate([prediction.states for prediction in predictions])
        measured = np.concatenate([log.y[window_slice] for log, window_slice in log_slices])
        error = predicted - measured
        # headings that differ by full turns are equal
        error[:, HEADING] = wrap_angle_array(error[:, HEADING])
        dof = logs[windows[0].log_index].dof
        attitude_error = None
        if dof.is_six_dof:
            roll_column = dof.state_names.index("phi")
            error[:, roll_column] = wrap_angle_array(error[:, roll_column])
            attitude_error = rotation_angle_between(predicted[:, ATTITUDE], measured[:, ATTITUDE])
        return cls(
            error,
            np.concatenate([log.usable[window_slice] for log, window_slice in log_slices]),
            np.array([window.stop - window.start for window in windows]),
            dof,
            attitude_error,
        )

    def nrmse(self, scales: np.ndarray) -> np.ndarray:
        """Return the mean of RMSE / scale over the modelled velocities of each window [W]."""
        return np.asarray((self.rmse / scales).take(self.dof.active_indices, axis=1).mean(1))

    @property
    def window_starts(self) -> np.ndarray:
        """First sample of each window [W]."""
        return np.asarray(np.cumsum(self.window_lengths) - self.window_lengths)

    @property
    def is_scored(self) -> np.ndarray:
        """Whether each dynamic state is scored at each sample [N, n]."""
        always_scored = [np.ones_like(self.is_usable)] * (self.dof.n_dynamic - 2)
        return np.stack((self.is_usable, self.is_usable, *always_scored), axis=1)

    @property
    def velocity_errors(self) -> np.ndarray:
        """Errors of the dynamic states [N, n], zero where they are not scored."""
        return np.asarray(np.where(self.is_scored, self.error[:, self.dof.dynamic_columns], 0.0))

    def mean_by_window(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of values [N, n] over the scored samples of each window [W, n]."""
        with np.errstate(invalid="ignore"):
            window_sums = np.add.reduceat(values, self.window_starts)
            return np.asarray(
                window_sums / np.add.reduceat(self.is_scored.astype(float), self.window_starts)
            )

    @property
    def rmse(self) -> np.ndarray:
        """Root mean square errors of the dynamic states of each window [W, n]."""
        return np.asarray(np.sqrt(self.mean_by_window(self.velocity_errors**2)))

    @property
    def mae(self) -> np.ndarray:
        """Mean absolute errors of the dynamic states of each window [W, n]."""
        return self.mean_by_window(np.abs(self.velocity_errors))

    def final_pose_errors(self, sample_indices: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the magnitudes [W] of the pose errors by name, see `pose_error_sizes`.

        Args:
            sample_indices: samples [W]; None for the last of each window.
        """
        last_samples = (
            self.window_starts + self.window_lengths - 1
            if sample_indices is None
            else sample_indices
        )
        state_errors = self.error[last_samples]
        attitude_errors = None if self.attitude_error is None else self.attitude_error[last_samples]
        return pose_error_sizes(state_errors, self.dof, attitude_errors)

    @property
    def n_usable(self) -> np.ndarray:
        """Usable samples of each window [W]."""
        return np.asarray(np.add.reduceat(self.is_usable.astype(int), self.window_starts))


def run_free_runs(
    candidates: Sequence[Candidate],
    windows: Sequence[Window],
    logs: Sequence[PreparedLog],
    dt: float,
    velocity_limits: np.ndarray,
    dtype: torch.dtype = torch.float64,
) -> dict[str, list[Prediction]]:
    """Free-run every candidate over every window.

    A free run has diverged if it is not finite, or if a velocity exceeds both `velocity_limits` [n]
    and twice the measured maximum of the window. The constant-velocity prediction replaces it. A
    negative limit marks every run as diverged.
    """
    names = {candidate.name for candidate in candidates}
    ensembles = [
        candidate
        for candidate in candidates
        if candidate.members and set(candidate.members) <= names
    ]
    predictions = {
        candidate.name: _run_candidate(candidate, windows, logs, dt, velocity_limits, dtype)
        for candidate in candidates
        if candidate not in ensembles
    }
    for ensemble in ensembles:
        member_predictions = [*zip(*(predictions[name] for name in ensemble.members), strict=True)]
        # The prediction of a diverged member was replaced by constant velocity, so that the mean of
        # predictions is not that of the ensemble: such windows are run again with all members.
        windows_with_divergence = [
            i
            for i, predictions_of_window in enumerate(member_predictions)
            if any(prediction.has_diverged for prediction in predictions_of_window)
        ]
        rerun_predictions = iter(
            _run_candidate(
                ensemble,
                [windows[i] for i in windows_with_divergence],
                logs,
                dt,
                velocity_limits,
                dtype,
            )
        )
        predictions[ensemble.name] = []
        for i, predictions_of_window in enumerate(member_predictions):
            states = [prediction.states for prediction in predictions_of_window]
            nu = _average_members(ensemble.model, states)
            nu = nu if logs[0].dof.is_six_dof else nu[:, logs[0].dof.dynamic_columns]
            prediction = (
                next(rerun_predictions)
                if i in windows_with_divergence
                else _to_prediction(windows[i], nu, logs, dt, velocity_limits)
            )
            predictions[ensemble.name].append(prediction)
    spreads_by_members: dict[tuple[str, ...], list[np.ndarray]] = {}
    for candidate in candidates:
        members = candidate.spread_members
        if len(members) > 1 and set(members) <= names:
            if members not in spreads_by_members:
                member_predictions = [*zip(*(predictions[name] for name in members), strict=True)]
                spreads_by_members[members] = [
                    standard_deviation_between_models(
                        [prediction.states for prediction in predictions_of_window]
                    )
                    for predictions_of_window in member_predictions
                ]
            predictions[candidate.name] = [
                replace(prediction, spread=spread)
                for prediction, spread in zip(
                    predictions[candidate.name], spreads_by_members[members], strict=True
                )
            ]
    for candidate in candidates:
        if candidate.domain is not None:
            predictions[candidate.name] = [
                replace(
                    prediction, distance=_mean_log_distance(candidate, window, prediction, logs)
                )
                for window, prediction in zip(windows, predictions[candidate.name], strict=True)
            ]
    return {candidate.name: predictions[candidate.name] for candidate in candidates}


def _mean_log_distance(
    candidate: Candidate, window: Window, prediction: Prediction, logs: Sequence[PreparedLog]
) -> np.ndarray | None:
    """Return the running mean [L - 1] of the log distance of a prediction to the training data.

    Errors of a free run come from all of its past, hence the mean from the start on.
    """
    assert candidate.domain is not None, "the caller checks this"
    log = logs[window.log_index]
    distance = log_domain_distance(
        candidate.domain,
        prediction.states[1:],
        log.w[window.start : window.stop - 1],
        log.dof.state_names,
        candidate.domain_inputs,
    )
    if distance is None:
        return None
    return np.asarray(np.cumsum(distance) / np.arange(1, len(distance) + 1))


def _average_members(ensemble: Dynamics, states: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean [L, 3 + n] of the states of the members, with the ensemble's weights."""
    if not isinstance(ensemble, MeanOfTrajectories) or ensemble.has_equal_weights:
        return np.asarray(np.mean(states, axis=0))
    # the pose is integrated again from the mean velocities
    n_pose = states[0].shape[1] - ensemble.dof
    pose_weights = np.full((len(states), n_pose), 1.0 / len(states))
    weights = np.concatenate((pose_weights, ensemble.member_weights.numpy()), axis=1)
    return np.asarray(np.einsum("mk,mtk->tk", weights, np.stack(states)))


def standard_deviation_between_models(states: Sequence[np.ndarray]) -> np.ndarray:
    """Return the standard deviation [L, c] between models' states [L + 1, 3 + n] after the first.

    Columns are the channels of a prediction interval; the position is per axis, averaged over both.
    """
    spread = np.stack([model_states[1:] for model_states in states]).std(axis=0, ddof=1)
    return band_channels(spread, np.sqrt(0.5 * (spread[:, POSITION] ** 2).sum(axis=1)))


def _run_candidate(
    candidate: Candidate,
    windows: Sequence[Window],
    logs: Sequence[PreparedLog],
    dt: float,
    velocity_limits: np.ndarray,
    dtype: torch.dtype,
) -> list[Prediction]:
    """Return the predictions of one model for all windows."""
    input_tables = {
        log_index: _input_table(candidate, logs[log_index])
        for log_index in {window.log_index for window in windows}
    }
    # a copy, since a validation in float32 must not round the parameters of the model
    model = copy.deepcopy(candidate.model).to("cpu", dtype).eval()
    # In the plane the pose does not affect the velocities and is integrated afterwards, for all
    # models in the same way. In six degrees of freedom the attitude does, by restoring forces.
    model.has_position = model.is_spatial
    dof = logs[0].dof
    state_names = candidate.state_names or dof.state_names
    simulated_states = dof.state_names if model.is_spatial else dof.dynamic_states
    columns = [state_names.index(name) for name in simulated_states]
    predictions: dict[int, Prediction] = {}
    values_per_step = len(state_names) + sum(
        table.shape[1] for table in list(input_tables.values())[:1]
    )
    for batch in _batch_windows(windows, values_per_step):
        batch_windows = [windows[window_index] for window_index in batch]
        x0 = np.stack(
            [_initial_state(candidate, window, logs[window.log_index]) for window in batch_windows]
        )
        simulated = (
            _simulate_batch(model, batch_windows, x0, logs, input_tables, dtype)[:, :, columns]
            .double()
            .numpy()
        )
        for window_index, window, window_states in zip(
            batch, batch_windows, simulated, strict=True
        ):
            predictions[window_index] = _to_prediction(
                window, window_states[: _window_length(window)], logs, dt, velocity_limits
            )
    return [predictions[window_index] for window_index in range(len(windows))]


def _window_length(window: Window) -> int:
    return window.stop - window.start


def _batch_windows(windows: Sequence[Window], values_per_step: int) -> Iterator[list[int]]:
    """Yield the indices of windows that are run in one batch.

    A step takes about the same time for one row and for many. Windows of different lengths are
    therefore run together, unless some would run on for far more than their length, or the batch
    would need too much memory.

    Args:
        windows: windows to run.
        values_per_step: number of values stored per row and step.
    """
    # descending length, so that the first window of a batch determines its length
    indices_by_length = sorted(range(len(windows)), key=lambda row: -_window_length(windows[row]))
    batch: list[int] = []
    for window_index in indices_by_length:
        longest_window = _window_length(windows[batch[0]]) if batch else 0
        if batch and (
            _MAX_LENGTH_RATIO * _window_length(windows[window_index]) < longest_window
            or (len(batch) + 1) * longest_window * values_per_step > _MAX_BATCH_VALUES
        ):
            yield batch
            batch = []
        batch.append(window_index)
    if batch:
        yield batch


def _simulate_batch(
    model: Dynamics,
    windows: Sequence[Window],
    x0: np.ndarray,
    logs: Sequence[PreparedLog],
    input_tables: Mapping[int, np.ndarray],
    dtype: torch.dtype,
) -> torch.Tensor:
    """Return the states [W, L, nx] of one batch of windows, each from its row of x0."""
    longest_window = max(map(_window_length, windows))
    # a window that is shorter than the longest repeats its last input; its surplus is cut off later
    future_inputs = np.stack(
        [
            input_tables[window.log_index][
                np.minimum(
                    np.arange(window.start, window.start + longest_window - 1),
                    window.stop - 1,
                )
            ]
            for window in windows
        ]
    )
    with torch.no_grad():
        memory = model.initial_state(len(windows)).to(dtype)
        if isinstance(model, HybridDynamics):
            # windows near a gap have less history; rows of equal length are warmed up together
            history_lengths = np.array([window.start - window.history_start for window in windows])
            for history_length in np.unique(history_lengths):
                same_history = np.flatnonzero(history_lengths == history_length)
                history_windows = [windows[i] for i in same_history.tolist()]
                y_history = np.stack(
                    [
                        logs[window.log_index].y[window.history_start : window.start]
                        for window in history_windows
                    ]
                )
                w_history = np.stack(
                    [
                        input_tables[window.log_index][window.history_start : window.start]
                        for window in history_windows
                    ]
                )
                memory[torch.from_numpy(same_history)] = model.warmup(
                    torch.from_numpy(y_history).to(dtype), torch.from_numpy(w_history).to(dtype)
                )
        states, _, _ = compile_rollout(Rollout(model), _RUNS_PER_STRUCTURE * longest_window)(
            torch.from_numpy(x0).to(dtype), torch.from_numpy(future_inputs).to(dtype), memory
        )
    result: torch.Tensor = states
    return result


def _to_prediction(
    window: Window,
    simulated: np.ndarray,
    logs: Sequence[PreparedLog],
    dt: float,
    velocity_limits: np.ndarray,
) -> Prediction:
    """Return the prediction of a window; constant velocity replaces a diverged run.

    Args:
        window: the window.
        simulated: simulated states [L, 3 + n], or dynamic states [L, n] without the pose.
        logs: prepared logs.
        dt: time step in s.
        velocity_limits: limits [n] of the velocities; see `run_free_runs`.
    """
    log = logs[window.log_index]
    window_slice = slice(window.start, window.stop)
    velocities = simulated[:, -log.dof.n_dynamic :]
    measured_speeds = np.abs(log.y[window_slice, log.dof.dynamic_columns][log.usable[window_slice]])
    # the vessel itself may exceed the limits in a window if the training logs are slow and short
    measured_limits = _MEASURED_SPEED_MARGIN * measured_speeds.max(0, initial=0.0)
    velocity_limits = np.where(
        velocity_limits < 0.0, velocity_limits, np.maximum(velocity_limits, measured_limits)
    )
    # NaN first: comparisons with it would be false
    has_diverged = not np.isfinite(velocities).all() or bool(
        (np.abs(velocities) > velocity_limits).any()
    )
    if has_diverged:
        velocities = np.tile(window.initial_velocities, (len(velocities), 1))
    if not has_diverged and velocities.shape != simulated.shape:
        return Prediction(simulated, has_diverged)
    pose = integrate_pose(logs[window.log_index].y[window.start, POSE], velocities, dt)
    return Prediction(np.concatenate((pose, velocities), axis=1), has_diverged)


def _input_table(candidate: Candidate, log: PreparedLog) -> np.ndarray:
    if candidate.input_names is None:
        return log.w
    input_values = log.log.stack(candidate.input_names)
    return np.concatenate((input_values, np.zeros((len(log), candidate.n_zero_inputs))), axis=1)


def _initial_state(candidate: Candidate, window: Window, log: PreparedLog) -> np.ndarray:
    state_names = log.dof.state_names
    initial_values = dict(
        zip(state_names, (*log.y[window.start, POSE], *window.initial_velocities), strict=True)
    )
    required_names = candidate.state_names or state_names
    return np.array(
        [
            initial_values[name] if name in initial_values else log.log[name][window.start]
            for name in required_names
        ]
    )


def pose_error_sizes(
    error: np.ndarray, dof: DegreesOfFreedom, attitude_errors: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Return the magnitudes [W] of pose errors by name, see `DegreesOfFreedom.pose_error_names`.

    Args:
        error: errors of states [W, 3 + n], psi wrapped to half a turn.
        dof: degrees of freedom, which determine the names.
        attitude_errors: angles between attitudes [W]; None for surface vessels.
    """
    sizes = {"position": np.hypot(*error[:, POSITION].T), "heading": np.abs(error[:, HEADING])}
    if attitude_errors is not None:
        sizes |= {
            "depth": np.abs(error[:, dof.state_names.index("z")]),
            "attitude": attitude_errors,
        }
    return {name: sizes[name] for name in dof.pose_error_names}


def compute_integration_errors(
    y: np.ndarray, dof: DegreesOfFreedom, dt: float
) -> dict[str, np.ndarray]:
    """Return the final pose errors [W] of the integrated measured velocities, by name.

    Even exact velocities of a model would have these errors, which are the noise floor.

    Args:
        y: measured states [W, L, 3 + n].
        dof: degrees of freedom.
        dt: time step in s.
    """
    error = np.zeros_like(y[:, -1])
    for error_of_run, measured in zip(error, y, strict=True):
        error_of_run[POSE] = (
            integrate_pose(measured[0, POSE], measured[:, dof.dynamic_columns], dt)[-1]
            - measured[-1, POSE]
        )
    error[:, HEADING] = wrap_angle_array(error[:, HEADING])
    if not dof.is_six_dof:
        return pose_error_sizes(error, dof, None)
    depth_rate = level_velocities(torch.from_numpy(y[:, :, dof.dynamic_columns]))[2].numpy()
    depth_change = np.trapezoid(depth_rate, dx=dt, axis=1)
    depth_column = dof.state_names.index("z")
    error[:, depth_column] = depth_change - (y[:, -1, depth_column] - y[:, 0, depth_column])
    angular_velocity = torch.from_numpy(y[:, :, [dof.state_names.index(name) for name in "pqr"]])
    attitude = torch.from_numpy(y[:, 0, ATTITUDE])
    for rotation in (0.5 * dt * (angular_velocity[:, 1:] + angular_velocity[:, :-1])).unbind(1):
        attitude = compose_rotation(attitude, rotation)
    return pose_error_sizes(
        error, dof, rotation_angle_between(attitude.numpy(), y[:, -1, ATTITUDE])
    )


def integrate_pose(pose: np.ndarray, nu: np.ndarray, dt: float) -> np.ndarray:
    """Return the pose [L, 3] from its initial value [3] and the dynamic states nu [L, n].

    Trapezoidal rule; the heading first, since the position depends on it.
    """

    def trapezoid(initial_value: float, rate: np.ndarray) -> np.ndarray:
        return initial_value + np.concatenate(([0.0], np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))))

    nu = to_horizontal_plane(nu)
    psi = trapezoid(pose[2], nu[:, 2])
    north = nu[:, 0] * np.cos(psi) - nu[:, 1] * np.sin(psi)
    east = nu[:, 0] * np.sin(psi) + nu[:, 1] * np.cos(psi)
    return np.stack((trapezoid(pose[0], north), trapezoid(pose[1], east), psi), axis=1)

"""Errors of free runs: rows of metrics.json, their intervals, and the limits of a model."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from residnet.core.layout import VELOCITIES
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.names import POSE_ERROR_UNITS
from residnet.evaluation.bands import compute_run_errors, count_coverage
from residnet.evaluation.intervals import (
    WindowErrors,
    bootstrap_intervals,
    estimate_spread_between_logs,
    make_resampling_blocks,
    paired_difference,
    prediction_intervals,
)
from residnet.evaluation.limits_records import (
    ClassErrors,
    ClassRow,
    HorizonRow,
    KinematicErrors,
    OutsideRange,
    PoseErrors,
    ProtocolLimits,
    WorstWindow,
)
from residnet.evaluation.records import Interval, MetricsRow, PairedDifference
from residnet.evaluation.verdict import MIN_LOGS_FOR_INTERVAL

if TYPE_CHECKING:
    from residnet.evaluation.freerun import Candidate, FreeRun
    from residnet.preprocessing.prepare import PreparedLog

LIMITS_SCHEMA: Final = "residnet.limits/1"
_N_WORST_WINDOWS = 3
"""Number of reported worst windows of a model."""
_N_SPEED_CLASSES = 3
"""Number of classes of speed, and of wind speed."""
_MIN_CLASS_WINDOWS = 3
"""Smallest number of windows of a reported class."""
_WIND_CHANNEL = "wind_speed"
_HORIZONS = (10.0, 30.0, 100.0)
"""Horizons in s of the reported pose errors."""


@dataclass(frozen=True)
class HorizonErrors:
    """Errors of the W windows of one split and protocol that reach a horizon.

    Attributes:
        n_steps: the horizon in time steps.
        seconds: the horizon in s.
        log_indices: log index [W] of each window.
        mean_speeds: mean speed [W] of each window in m/s.
        distance: mean distance travelled in m.
        integration_errors: magnitudes [W] of the pose errors of the integrated measured velocities.
        pose_errors: magnitudes [W] of the pose errors by model and name.
    """

    n_steps: int
    seconds: float
    log_indices: np.ndarray
    mean_speeds: np.ndarray
    distance: float
    integration_errors: Mapping[str, np.ndarray]
    pose_errors: Mapping[str, Mapping[str, np.ndarray]]

    def summarize(self, other_splits: Sequence[HorizonErrors] = ()) -> HorizonRow:
        """Return means and intervals at the horizon.

        Args:
            other_splits: errors of the same models on other logs after the same time, which also
                estimate the spread between logs.
        """
        (floor,) = _summarize_pose_errors(
            {"floor": self.integration_errors}, self.log_indices
        ).values()
        other_errors = [other._to_window_errors(self.pose_errors) for other in other_splits]
        n_logs = len(np.unique(self.log_indices))
        return HorizonRow(
            seconds=self.seconds,
            windows=len(self.log_indices),
            logs=n_logs,
            logs_of_spread=(
                estimate_spread_between_logs(
                    self._to_window_errors(self.pose_errors), other_errors
                ).n_logs
                if n_logs >= MIN_LOGS_FOR_INTERVAL
                else 0
            ),
            slowest=float(self.mean_speeds.min()),
            fastest=float(self.mean_speeds.max()),
            sailed=self.distance,
            floor=floor,
            models=_summarize_pose_errors(self.pose_errors, self.log_indices, other_errors),
            change_from_constant_velocity=_compare_pose_errors(self.pose_errors, self.log_indices),
        )

    def _to_window_errors(self, models: Collection[str]) -> WindowErrors:
        """Return the pose errors of models as one table, in the order of the models."""
        return WindowErrors(
            np.column_stack(
                [sizes for name in models for sizes in self.pose_errors[name].values()]
            ),
            self.log_indices,
        )


class ProtocolEvaluation:
    """Errors of all models over the W windows of one protocol, and statistics of them.

    Args:
        free_run: free runs of all models.
        scales: denominators of the nrmse.
    """

    def __init__(
        self,
        free_run: FreeRun,
        candidates: Sequence[Candidate],
        logs: Sequence[PreparedLog],
        scales: Mapping[str, float],
    ) -> None:
        # imported here because it imports PyTorch, which reports of finished runs do not need
        from residnet.evaluation.freerun import FreeRunErrors

        self.free_run = free_run
        self.candidates = candidates
        self.logs = logs
        self.dof = logs[0].dof
        self.state_scales = np.array([scales.get(name, 1.0) for name in self.dof.dynamic_states])
        self.log_slices = [(logs[w.log_index], slice(w.start, w.stop)) for w in free_run.windows]
        self.log_indices = np.array([window.log_index for window in free_run.windows])
        self.errors = {
            candidate.name: FreeRunErrors.from_predictions(
                free_run.windows, free_run.predictions[candidate.name], logs
            )
            for candidate in candidates
        }
        self.nrmse_by_window = {
            name: errors.nrmse(self.state_scales) for name, errors in self.errors.items()
        }
        self._horizon_errors: list[HorizonErrors] | None = None

    def paired_difference(
        self,
        model_name: str,
        reference_name: str | None,
        window_mask: np.ndarray,
        errors_by_model: Mapping[str, np.ndarray] | None = None,
    ) -> PairedDifference | None:
        """Return the paired difference of two models over selected windows [W] bool.

        None if the reference model was not evaluated. `errors_by_model` [W] replaces the nrmse.
        """
        errors_by_model = self.nrmse_by_window if errors_by_model is None else errors_by_model
        if reference_name is None or reference_name not in errors_by_model:
            return None
        resampling_blocks = make_resampling_blocks(self.log_indices[window_mask])
        return paired_difference(
            errors_by_model[model_name][window_mask],
            errors_by_model[reference_name][window_mask],
            reference_name,
            resampling_blocks,
        )

    def build_rows(self, groups: Mapping[str, Sequence[str]]) -> list[MetricsRow]:
        """Return the rows of metrics.json.

        One row per model for all windows, every kind of manoeuvre and every named group of kinds.
        `difference` compares a model with its reference (`Candidate.reference`); None without one.
        Rows of models with prediction intervals also have coverage and interval score.
        """
        manoeuvre_kinds = [log.log.manoeuvre for log, _ in self.log_slices]
        kinds_by_group: dict[str, Sequence[str]] = {"all": manoeuvre_kinds}
        kinds_by_group |= {
            manoeuvre_kind: [manoeuvre_kind] for manoeuvre_kind in sorted(set(manoeuvre_kinds))
        } | dict(groups)
        coverage_by_model = {
            candidate.name: count_coverage(
                compute_run_errors(
                    self.free_run.windows,
                    self.free_run.predictions[candidate.name],
                    self.logs,
                    self.errors[candidate.name],
                ),
                candidate.bands[self.free_run.protocol],
            )
            for candidate in self.candidates
            if self.free_run.protocol in candidate.bands
        }
        metric_rows = []
        for candidate in self.candidates:
            for group_name, group_kinds in kinds_by_group.items():
                # groups of the config may name kinds that this split does not have
                window_mask = np.isin(manoeuvre_kinds, list(group_kinds))
                if not window_mask.any():
                    continue
                row = self._summarize_windows(candidate, group_name, window_mask)
                if candidate.name in coverage_by_model:
                    coverage = coverage_by_model[candidate.name].summarize(window_mask)
                    row = row.model_copy(
                        update={
                            "band_coverage": coverage.share,
                            "band_score": coverage.score,
                            "band_score_constant": coverage.constant_width_score,
                        }
                    )
                metric_rows.append(row)
        return metric_rows

    def _summarize_windows(
        self, candidate: Candidate, manoeuvre: str, window_mask: np.ndarray
    ) -> MetricsRow:
        """Return the row of one model over selected windows [W] bool, without band coverage."""
        model_name = candidate.name
        errors = self.errors[model_name]
        resampling_blocks = make_resampling_blocks(self.log_indices[window_mask])
        dof = self.dof
        pose_errors = errors.final_pose_errors()
        errors_by_window = np.column_stack(
            (errors.rmse, self.nrmse_by_window[model_name], *pose_errors.values())
        )[window_mask]
        rmse = errors_by_window[:, : dof.n_dynamic].mean(0)
        mae = errors.mae[window_mask].mean(0)
        nrmse = rmse / self.state_scales
        confidence_intervals = bootstrap_intervals(errors_by_window, resampling_blocks)
        n_usable = errors.n_usable[window_mask]

        def map_by_state(by_state: np.ndarray) -> dict[str, float]:
            return {dof.dynamic_states[axis]: float(by_state[axis]) for axis in dof.active_indices}

        # the pose errors are the columns after the dynamic states and the NRMSE
        final_pose_errors: dict[str, Any] = {}
        for column, pose_error_name in enumerate(pose_errors, dof.n_dynamic + 1):
            final_pose_errors |= {
                f"{pose_error_name}_error_end": float(errors_by_window[:, column].mean()),
                f"{pose_error_name}_error_end_ci95": confidence_intervals[column],
            }
        n_diverged = sum(
            prediction.has_diverged
            for prediction, is_selected in zip(
                self.free_run.predictions[model_name], window_mask, strict=True
            )
            if is_selected
        )
        return MetricsRow(
            model=model_name,
            kind=candidate.model_kind,
            split=self.free_run.split,
            protocol=self.free_run.protocol,
            manoeuvre=manoeuvre,
            windows=len(n_usable),
            n=int(n_usable.sum()),
            diverged=n_diverged,
            rmse=map_by_state(rmse),
            mae=map_by_state(mae),
            nrmse=map_by_state(nrmse) | {"mean": float(nrmse[dof.active_indices].mean())},
            rmse_ci95={
                dof.dynamic_states[axis]: confidence_intervals[axis] for axis in dof.active_indices
            },
            nrmse_mean_ci95=confidence_intervals[dof.n_dynamic],
            ci95_blocks=None if resampling_blocks is None else resampling_blocks.to_record(),
            difference=self.paired_difference(model_name, candidate.reference, window_mask),
            **final_pose_errors,
        )

    def build_limits(
        self, dt: float, other_splits: Sequence[ProtocolEvaluation] = ()
    ) -> ProtocolLimits:
        """Return the part of limits.json for one protocol and split.

        Args:
            dt: time step of the grid in s.
            other_splits: the same models and protocol on other logs, which also estimate the spread
                between logs.
        """
        return ProtocolLimits(
            kinematics=self.evaluate_kinematics(dt),
            bands=tuple(self.evaluate_by_class()),
            worst={name: tuple(self.list_worst_windows(name)) for name in self.errors},
            compared=self.compare_with_references(),
            outside=self.share_outside_training_range(),
            horizons=tuple(self.evaluate_horizons(dt, other_splits)),
            beyond_calibration=self.share_beyond_calibration(),
        )

    def evaluate_horizons(
        self, dt: float, other_splits: Sequence[ProtocolEvaluation] = ()
    ) -> list[HorizonRow]:
        """Return means and prediction intervals of the pose errors, see `compute_horizon_errors`.

        Args:
            dt: time step of the grid in s.
            other_splits: the same models and protocol on other logs.
        """
        other_errors = [
            horizon
            for evaluation in other_splits
            for horizon in evaluation.compute_horizon_errors(dt)
        ]
        return [
            horizon.summarize([other for other in other_errors if other.n_steps == horizon.n_steps])
            for horizon in self.compute_horizon_errors(dt)
        ]

    def compute_horizon_errors(self, dt: float) -> list[HorizonErrors]:
        """Return position and attitude errors of all models after 10, 30 and 100 s and at the end.

        Each split needs those of all others, so that they are computed once.

        Args:
            dt: time step of the grid in s.

        Returns:
            One entry for each horizon below the length of the longest window and one for its end.
        """
        if self._horizon_errors is not None:
            return self._horizon_errors
        from residnet.evaluation.freerun import compute_integration_errors

        # windows and usable samples are the same for all models
        any_errors = next(iter(self.errors.values()))
        mean_speeds = self._mean_speeds()
        max_steps = int(any_errors.window_lengths.max()) - 1
        horizon_steps = [round(seconds / dt) for seconds in _HORIZONS]
        entries = []
        for n_steps in [
            *(n_steps for n_steps in horizon_steps if 0 < n_steps < max_steps),
            max_steps,
        ]:
            reaches_horizon = any_errors.window_lengths > n_steps
            # the final pose must have been measured, not bridged over a gap
            reaches_horizon[reaches_horizon] = any_errors.is_usable[
                (any_errors.window_starts + n_steps)[reaches_horizon]
            ]
            if not reaches_horizon.any():
                continue
            long_slices = (self.log_slices[i] for i in np.flatnonzero(reaches_horizon).tolist())
            measured_states = [
                log.y[window_slice][: n_steps + 1] for log, window_slice in long_slices
            ]
            distances = [
                float(np.hypot(*states[:, VELOCITIES][:, :2].T).sum()) * dt
                for states in measured_states
            ]
            entries.append(
                HorizonErrors(
                    n_steps=n_steps,
                    seconds=n_steps * dt,
                    log_indices=self.log_indices[reaches_horizon],
                    mean_speeds=mean_speeds[reaches_horizon],
                    distance=float(np.mean(distances)),
                    integration_errors=compute_integration_errors(
                        np.stack(measured_states), self.dof, dt
                    ),
                    pose_errors={
                        name: errors.final_pose_errors(
                            (errors.window_starts + n_steps)[reaches_horizon]
                        )
                        for name, errors in self.errors.items()
                    },
                )
            )
        self._horizon_errors = entries
        return entries

    def evaluate_kinematics(self, dt: float) -> KinematicErrors:
        """Return pose errors of the integrated measured velocities (noise floor).

        The measured velocities are integrated over each window from its measured pose. A model with
        exact velocities would have these errors.

        Returns:
            Mean and root mean square of each pose error at the ends of windows; no errors if some
            velocities were not measured.
        """
        if self.dof.fixed_states:
            return KinematicErrors()
        from residnet.evaluation.freerun import compute_integration_errors

        states_by_length: dict[int, list[np.ndarray]] = {}
        for log, window_slice in self.log_slices:
            states_by_length.setdefault(window_slice.stop - window_slice.start, []).append(
                log.y[window_slice]
            )
        integration_errors = [
            compute_integration_errors(np.stack(states_of_length), self.dof, dt)
            for states_of_length in states_by_length.values()
        ]
        summary: dict[str, float] = {}
        for name in self.dof.pose_error_names:
            values = np.concatenate(
                [errors_of_length[name] for errors_of_length in integration_errors]
            )
            summary[f"{name}_mean"] = float(values.mean())
            summary[f"{name}_rms"] = float(np.sqrt(np.mean(values**2)))
        return KinematicErrors.model_validate({"windows": len(self.log_slices), **summary})

    def _mean_speeds(self) -> np.ndarray:
        return np.array(
            [
                np.hypot(*log.y[window_slice, VELOCITIES][:, :2].T).mean()
                for log, window_slice in self.log_slices
            ]
        )

    def evaluate_by_class(self) -> list[ClassRow]:
        """Return errors by thirds of the windows in mean speed and mean true wind speed.

        Wind speed only if every log has it. A class of fewer than three windows is omitted, and so
        is a quantity with a single class.
        """
        values_by_quantity: dict[Literal["speed", "wind"], np.ndarray] = {
            "speed": self._mean_speeds()
        }
        if all(_WIND_CHANNEL in log.log.channels for log, _ in self.log_slices):
            mean_wind_speeds = [
                log.log[_WIND_CHANNEL][window_slice].mean() for log, window_slice in self.log_slices
            ]
            values_by_quantity["wind"] = np.array(mean_wind_speeds)
        entries = []
        for quantity, values in values_by_quantity.items():
            if not np.isfinite(values).all():
                continue
            # quantiles of the windows instead of equal ranges, so that each class has enough
            # windows; `searchsorted` keeps windows with equal values in one class
            class_limits = np.quantile(values, np.arange(1, _N_SPEED_CLASSES) / _N_SPEED_CLASSES)
            class_indices = np.searchsorted(class_limits, values, side="left")
            class_masks = [
                class_indices == k
                for k in range(_N_SPEED_CLASSES)
                if (class_indices == k).sum() >= _MIN_CLASS_WINDOWS
            ]
            entries += [
                ClassRow(
                    by=quantity,
                    low=float(values[class_mask].min()),
                    high=float(values[class_mask].max()),
                    windows=int(class_mask.sum()),
                    models={
                        candidate.name: ClassErrors(
                            nrmse_mean=float(
                                self.nrmse_by_window[candidate.name][class_mask].mean()
                            ),
                            difference=self.paired_difference(
                                candidate.name, candidate.reference, class_mask
                            ),
                        )
                        for candidate in self.candidates
                    },
                )
                for class_mask in (class_masks if len(class_masks) > 1 else ())
            ]
        return entries

    def list_worst_windows(self, model_name: str) -> list[WorstWindow]:
        """Return the three windows with the largest nrmse of a model.

        The pose error is the first one that the velocities of the model determine.
        """
        errors = self.errors[model_name]
        nrmse = self.nrmse_by_window[model_name]
        pose_error_name = self.dof.pose_error_names[0]
        pose_errors = errors.final_pose_errors()[pose_error_name]
        return [
            WorstWindow.model_validate(
                {
                    "log": self.log_slices[i][0].log.name,
                    "manoeuvre": self.log_slices[i][0].log.manoeuvre,
                    "t": float(self.log_slices[i][0].log.t[self.free_run.windows[i].start]),
                    "nrmse": float(nrmse[i]),
                    "rmse": {
                        self.dof.dynamic_states[axis]: float(errors.rmse[i, axis])
                        for axis in self.dof.active_indices
                    },
                    f"{pose_error_name}_error_end": float(pose_errors[i]),
                }
            )
            for i in np.argsort(-nrmse, kind="stable")[:_N_WORST_WINDOWS].tolist()
        ]

    def compare_with_references(self) -> dict[str, dict[str, PairedDifference | None]]:
        """Return the paired differences of each model to constant velocity and first baseline."""
        all_windows = np.ones(len(self.log_indices), dtype=bool)
        reference_names = [CONSTANT_VELOCITY] if CONSTANT_VELOCITY in self.errors else []
        reference_names += [
            candidate.name for candidate in self.candidates if candidate.model_kind == "baseline"
        ][:1]
        return {
            model_name: {
                reference_name: self.paired_difference(model_name, reference_name, all_windows)
                for reference_name in reference_names
                if reference_name != model_name
            }
            for model_name in self.errors
        }

    def share_beyond_calibration(self) -> dict[str, float]:
        """Return by model the share of windows beyond the calibration of its intervals.

        These windows are farther from the training data than any run that calibrated the intervals.
        """
        shares = {}
        for candidate in self.candidates:
            band = candidate.bands.get(self.free_run.protocol)
            predictions = self.free_run.predictions[candidate.name]
            distances = [
                prediction.distance[-1]
                for prediction in predictions
                if prediction.distance is not None
            ]
            if band is not None and len(distances) == len(predictions) > 0:
                shares[candidate.name] = float(np.mean(np.array(distances) > band.largest_distance))
        return shares

    def share_outside_training_range(self) -> OutsideRange:
        """Return the share of samples outside the range of the training data.

        Returns:
            Share of the usable samples with a velocity or an input outside its range; no share if
            the ranges are unknown. Depth has no effect on the motion and is ignored.
        """
        ranges = next(
            (
                candidate.training_ranges
                for candidate in self.candidates
                if candidate.training_ranges
            ),
            {},
        )
        if not ranges:
            return OutsideRange()
        values = np.concatenate(
            [
                np.concatenate(
                    (log.y[window_slice, log.dof.dynamic_columns], log.w[window_slice]), axis=1
                )[log.usable[window_slice]]
                for log, window_slice in self.log_slices
            ]
        )
        lower, upper = np.array(list(ranges.values())).T
        unused_channels = self.log_slices[0][0].dof.unmodelled_states
        is_outside = (values < lower) | (values > upper)
        is_outside &= np.array([name not in unused_channels for name in ranges])
        shares = dict(zip(ranges, is_outside.mean(0).tolist(), strict=True))
        return OutsideRange(
            share=float(is_outside.any(1).mean()),
            channels={name: share for name, share in shares.items() if share > 0},
        )


def _summarize_pose_errors(
    pose_errors: Mapping[str, Mapping[str, np.ndarray]],
    log_indices: np.ndarray,
    other_splits: Sequence[WindowErrors] = (),
) -> dict[str, PoseErrors]:
    """Return means and intervals of the magnitudes [W] of pose errors, by model and name."""
    values = np.column_stack(
        [sizes for sizes_by_name in pose_errors.values() for sizes in sizes_by_name.values()]
    )
    means_and_intervals = zip(
        values.mean(0).tolist(),
        prediction_intervals(WindowErrors(values, log_indices), other_splits),
        strict=True,
    )
    summary: dict[str, PoseErrors] = {}
    for model, sizes_by_name in pose_errors.items():
        mean_and_interval = {name: next(means_and_intervals) for name in sizes_by_name}
        # errors of angles are at most half a turn
        upper_bounds = {
            name: math.pi if POSE_ERROR_UNITS[name] == "rad" else math.inf for name in sizes_by_name
        }
        intervals_by_name = {
            name: interval and (interval[0], min(interval[1], upper_bounds[name]))
            for name, (_, interval) in mean_and_interval.items()
        }
        means = {name: mean for name, (mean, _) in mean_and_interval.items()}
        summary[model] = PoseErrors.model_validate({**means, "intervals": intervals_by_name})
    return summary


def _compare_pose_errors(
    pose_errors: Mapping[str, Mapping[str, np.ndarray]], log_indices: np.ndarray
) -> dict[str, dict[str, Interval | None]]:
    """Return confidence intervals of the differences to the constant-velocity model.

    Args:
        pose_errors: magnitudes [W] of the pose errors by model and name.
        log_indices: log index [W] of each window.
    """
    reference_errors = pose_errors.get(CONSTANT_VELOCITY)
    if reference_errors is None:
        return {}
    blocks = make_resampling_blocks(log_indices)
    changes: dict[str, dict[str, Interval | None]] = {}
    for model, sizes_by_name in pose_errors.items():
        if model == CONSTANT_VELOCITY:
            continue
        differences = np.column_stack(
            [sizes - reference_errors[name] for name, sizes in sizes_by_name.items()]
        )
        changes[model] = dict(
            zip(sizes_by_name, bootstrap_intervals(differences, blocks), strict=True)
        )
    return changes

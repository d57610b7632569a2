"""Measure the effect of findings on a fit; findings with a small effect become notes.

Two quantities are compared with and without the fault: the predictions of a one-step least-squares
fit (the change of the velocities over a few seconds), and the error of dead reckoning, that is of
positions and headings integrated from the velocities.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from residnet.core.log import Log
from residnet.preprocessing.statistics import OverlappingBlocks
from residnet.quality.findings import Finding
from residnet.quality.statistics import (
    LogStatistics,
    interpolate_gaps,
    make_blocks,
    make_input_terms,
    make_velocity_terms,
)

MIN_EFFECT = 0.04
"""Effect below which a finding is only a note."""
_RIDGE = 1e-6
"""Ridge penalty for columns of unit RMS, which makes collinear columns solvable."""
_MIN_CHANGE_TO_RESIDUAL = 1.3
"""Smallest change of the predictions that counts, in RMS residuals of the fit."""
_MIN_RECKONING_CHANGE = 0.06
"""Smallest change of the dead-reckoning error that counts, as a share of the distance travelled.

Smaller changes can result from the errors of a satellite receiver.
"""
_N_COMPARISON_SEGMENTS = 6
"""Number of times that as many other samples are omitted for comparison.

Omitting any samples changes a fit; only the change beyond this is attributed to a fault.
"""
_MIN_ROWS_PER_COLUMN = 4
"""Smallest number of rows per coefficient, to avoid overfitting. Chosen by hand."""
_CERTAIN_T_STATISTIC = 20.0
"""t statistic of the size of a fault above which the size counts as known."""
_MIN_VELOCITY_CHANGE = 0.1
"""RMS error of a velocity, in standard deviations of the velocity, from which it is an effect even
if the predictions of the fit do not change.
"""
_RECKONING_DURATION = 60.0
"""Duration of a dead-reckoning run in s; shorter in a log with less than three of them."""


class OneStepRegression:
    """Regression of the velocity changes over blocks of one log on polynomial terms.

    Args:
        log: statistics of a log with its inputs.
        reference: regression whose block length is used; None selects the length by the noise.

    Attributes:
        blocks: K overlapping blocks of samples.
        regressors: terms integrated over the blocks [K, k].
        responses: changes of the velocities over the blocks [K, n].
        response_std: standard deviation of the responses [n].
    """

    def __init__(self, log: LogStatistics, reference: OneStepRegression | None = None) -> None:
        blocks: OverlappingBlocks = make_blocks(log, *log.velocities)
        if reference is not None:
            block_length = reference.blocks.length
            block_starts = np.arange(0, len(log) - block_length, max(block_length // 4, 1))
            blocks = dataclasses.replace(blocks, starts=block_starts, length=block_length)
        velocities = {name: log[name] for name in log.velocities}
        input_values = [log[name] for name in log.inputs if log.std(name) > 0.0]
        # a polynomial without vessel parameters; more than four inputs enter linearly, so that the
        # terms do not outnumber the blocks
        regressor_columns = [np.ones(len(log)), *make_velocity_terms(velocities)]
        regressor_columns += make_input_terms(
            input_values, velocities.get("u"), is_linear=len(input_values) > 4
        )
        regressors = blocks.make_integrator(np.stack(regressor_columns, axis=-1))(0)
        responses = blocks.compute_changes(
            np.stack([*velocities.values()] or [np.zeros(len(log))], axis=-1)
        )
        is_finite = np.isfinite(regressors).all(axis=1) & np.isfinite(responses).all(axis=1)
        is_finite &= blocks.compute_changes(log.t) <= (blocks.length + 3.0) * log.sampling_interval
        self.blocks: OverlappingBlocks = dataclasses.replace(
            blocks, starts=blocks.starts[is_finite]
        )
        self.regressors = regressors[is_finite]
        self.responses = responses[is_finite]
        self.response_std = (
            np.maximum(self.responses.std(axis=0), 1e-12) if is_finite.any() else np.ones(1)
        )

    def __len__(self) -> int:
        return int(self.blocks.starts.size)

    def fit_ridge(self, row_mask: np.ndarray | None = None) -> np.ndarray:
        """Return the coefficients [k, n] of a ridge fit to the rows in a mask [K], or to all."""
        x, y = (
            (self.regressors, self.responses)
            if row_mask is None
            else (self.regressors[row_mask], self.responses[row_mask])
        )
        column_scales = np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-300)
        x = x / column_scales
        gram = x.T @ x / len(x)
        cross_moments = x.T @ y / len(x)
        coefficients = np.linalg.solve(gram + _RIDGE * np.eye(x.shape[1]), cross_moments)
        return np.asarray(coefficients / column_scales[:, None])

    def residual_rms(
        self, coefficients: np.ndarray, row_mask: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the RMS residual [n] of each velocity under given coefficients [k, n]."""
        residuals = self.responses - self.regressors @ coefficients
        return _root_mean_square(residuals if row_mask is None else residuals[row_mask])

    def prediction_change(
        self, change_of_predictions: np.ndarray, coefficients: np.ndarray
    ) -> float:
        """Return the largest relative change of the predictions.

        Changes below the residuals of the fit do not count.

        Args:
            change_of_predictions: RMS change of the predictions of each velocity [n].
            coefficients: coefficients of the fit [k, n].
        """
        counted_changes = np.where(
            change_of_predictions > _MIN_CHANGE_TO_RESIDUAL * self.residual_rms(coefficients),
            change_of_predictions / self.response_std,
            0.0,
        )
        return float(counted_changes.max(initial=0.0))


def _root_mean_square(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _excess_rms(rms_value: np.ndarray, reference_rms: np.ndarray) -> np.ndarray:
    """Return the RMS of what adds to an independent part with the reference RMS; at least 0."""
    return np.asarray(np.sqrt(np.maximum(rms_value**2 - reference_rms**2, 0.0)))


def _threshold_reckoning_change(reckoning_changes: np.ndarray) -> float:
    """Return the larger of two changes of the dead-reckoning error [2]; 0 below the minimum."""
    return (
        float(reckoning_changes.max()) if reckoning_changes.max() >= _MIN_RECKONING_CHANGE else 0.0
    )


class FindingEffects:
    """Effects of findings on the one-step fit and the dead reckoning of a log.

    Args:
        log: statistics of the log; a long log is represented by a subsample.
        sample_mask: samples that the subsample must contain [T] bool; None for evenly spread ones.
    """

    def __init__(self, log: LogStatistics, sample_mask: np.ndarray | None = None) -> None:
        self._full_log = log
        self._sample_indices, log = (
            (log.subsample_rows, log.subsample)
            if sample_mask is None
            else log.excerpt_around(sample_mask)
        )
        self._log = log
        self._regression = OneStepRegression(log)
        has_enough_rows = (
            len(self._regression) >= _MIN_ROWS_PER_COLUMN * self._regression.regressors.shape[1]
        )
        self._coefficients = self._regression.fit_ridge() if has_enough_rows else None
        self._reckoning_errors = compute_reckoning_errors(log)

    def measure(self, finding: Finding) -> Finding:
        """Return the finding with its measured effect; it becomes a note if the effect is small.

        Only a finding with affected samples or with a correction can be measured.
        """
        if finding.level != "will mislead" or finding.is_record_fault:
            return finding
        if finding.repair is not None:
            effect = self.measure_repair(finding.repair(self._log.log), finding)
        elif finding.sample_mask is not None and finding.sample_mask.any():
            # the subsample of a long log may contain none of the affected samples
            if not finding.sample_mask[self._sample_indices].any():
                return FindingEffects(self._full_log, finding.sample_mask).measure(finding)
            fitted_channels = {*self._log.velocities, *self._log.inputs}
            effect = self.measure_omission(
                finding.sample_mask[self._sample_indices],
                not finding.channels or not fitted_channels.isdisjoint(finding.channels),
            )
        else:
            return finding
        if effect is None:
            return finding
        level = finding.level if effect >= MIN_EFFECT else "note"
        return dataclasses.replace(finding, level=level, effect=effect)

    def measure_omission(self, sample_mask: np.ndarray, affects_fit: bool = True) -> float | None:
        """Return the relative change without some samples; None if it cannot be estimated.

        Args:
            sample_mask: samples to omit [T] bool.
            affects_fit: whether the affected channels enter the fit; if not, only dead reckoning
                is compared.
        """
        # the same pattern of samples at other times of the log
        comparison_masks = [
            np.roll(sample_mask, round(sample_mask.size * (k + 0.5) / _N_COMPARISON_SEGMENTS))
            for k in range(_N_COMPARISON_SEGMENTS)
        ]
        comparison_errors = [
            _excess_rms(
                self._reckoning_errors, compute_reckoning_errors(self._log, comparison_mask)
            )
            for comparison_mask in comparison_masks
        ]
        reckoning_change = _excess_rms(
            self._reckoning_errors, compute_reckoning_errors(self._log, sample_mask)
        )
        counted_reckoning_change = _threshold_reckoning_change(
            _excess_rms(reckoning_change, _root_mean_square(np.array(comparison_errors)))
        )
        if not affects_fit:
            return counted_reckoning_change
        regression = self._regression
        coefficients = self._coefficients
        if coefficients is None or regression.blocks.are_clear_of(sample_mask).sum() < max(
            0.3 * len(regression), 1
        ):
            return None if counted_reckoning_change < MIN_EFFECT else counted_reckoning_change
        full_residual_rms = regression.residual_rms(coefficients)

        def refit_without(omitted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return the RMS change of the predictions [n] and the RMS residual [n] of a refit."""
            retained = regression.blocks.are_clear_of(omitted)
            new_coefficients = regression.fit_ridge(retained)
            return _root_mean_square(
                regression.regressors[retained] @ (coefficients - new_coefficients)
            ), regression.residual_rms(new_coefficients, retained)

        prediction_changes, remaining_rms = refit_without(sample_mask)
        comparison_changes, comparison_rms = zip(
            *(refit_without(comparison_mask) for comparison_mask in comparison_masks), strict=True
        )
        # share of the residual that the samples cause; it counts only if no comparison stretch
        # reduces the residual as much
        is_significant = (remaining_rms < 0.95 * full_residual_rms) & (
            remaining_rms < 0.98 * np.min(comparison_rms, axis=0)
        )
        attributed_error = np.where(
            is_significant,
            _excess_rms(full_residual_rms, remaining_rms) / regression.response_std,
            0.0,
        )
        largest_change = regression.prediction_change(
            _excess_rms(prediction_changes, _root_mean_square(np.array(comparison_changes))),
            coefficients,
        )
        return max(
            largest_change, float(attributed_error.max(initial=0.0)), counted_reckoning_change
        )

    def measure_repair(self, repaired_log: Log, finding: Finding) -> float | None:
        """Return the relative change with the corrected log; None if it cannot be estimated."""
        repaired_statistics = self._log.on_grid(repaired_log)
        counted_reckoning_change = _threshold_reckoning_change(
            _excess_rms(self._reckoning_errors, compute_reckoning_errors(repaired_statistics))
        )
        regression = OneStepRegression(repaired_statistics, self._regression)
        coefficients = self._coefficients
        velocity_change = 0.0
        if abs(finding.figures.get("size", 0.0)) > _CERTAIN_T_STATISTIC * finding.figures.get(
            "error", np.inf
        ):
            # one-step predictions do not show a fault such as a scale error, because the
            # coefficients absorb it
            for name in self._log.velocities:
                rms_difference = float(
                    np.sqrt(np.nanmean((repaired_statistics[name] - self._log[name]) ** 2))
                )
                velocity_change = max(
                    velocity_change, rms_difference / max(self._log.std(name), 1e-12)
                )
            velocity_change = velocity_change if velocity_change >= _MIN_VELOCITY_CHANGE else 0.0
        if (
            coefficients is None
            or regression.regressors.shape[1] != coefficients.shape[0]
            or not len(regression)
        ):
            return (
                None
                if counted_reckoning_change < MIN_EFFECT
                else max(counted_reckoning_change, velocity_change)
            )
        new_coefficients = regression.fit_ridge()
        # a correction that increases the residual is wrong for the velocities: its effect on the
        # predictions does not count
        initial_rms = _root_mean_square(
            self._regression.residual_rms(coefficients) / self._regression.response_std
        )
        if (
            _root_mean_square(regression.residual_rms(new_coefficients) / regression.response_std)
            > 1.02 * initial_rms
        ):
            return max(counted_reckoning_change, velocity_change)
        return max(
            regression.prediction_change(
                _root_mean_square(regression.regressors @ (coefficients - new_coefficients)),
                new_coefficients,
            ),
            counted_reckoning_change,
            velocity_change,
        )


def compute_reckoning_errors(log: LogStatistics, omitted: np.ndarray | None = None) -> np.ndarray:
    """Return the relative errors [2] of position and heading after one minute of dead reckoning.

    The position error is relative to the distance travelled. The heading error is converted to a
    position error in the same unit: if it grows linearly along a straight line, it displaces the
    end by half its final value in rad times the distance.

    Args:
        log: statistics of a log with increasing times.
        omitted: samples that no window may contain [T] bool. If this excludes more than 80 % of the
            windows, windows may contain such samples, but not begin or end at them.
    """
    window_length = min(round(_RECKONING_DURATION / log.sampling_interval), len(log) // 3)
    errors = np.zeros(2)
    is_omitted = log.near_seam(0) if omitted is None else omitted | log.near_seam(0)
    cumulative_omitted = np.append(0, np.cumsum(is_omitted))
    window_starts = np.flatnonzero(
        cumulative_omitted[window_length + 1 :] == cumulative_omitted[: -window_length - 1]
    )
    # many short faults leave no window without one
    if window_starts.size < 0.2 * (len(log) - window_length):
        window_starts = np.flatnonzero(~is_omitted[:-window_length] & ~is_omitted[window_length:])
    if window_length < 2 or not window_starts.size:
        return errors

    def compute_change(values: np.ndarray) -> np.ndarray:
        return np.asarray(values[window_starts + window_length] - values[window_starts])

    def integrate_rate(rate: np.ndarray) -> np.ndarray:
        cumulative_integral = np.cumsum(0.5 * np.diff(log.t) * (rate[1:] + rate[:-1]))
        return compute_change(np.append(0.0, cumulative_integral))

    def root_mean_square(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.abs(values[is_finite]) ** 2)))

    # horizontal vectors are complex numbers, north + i east
    if all(name in log for name in ("x", "y", "psi", "u", "v")):
        earth_velocity = interpolate_gaps(
            log.t, (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])
        )
        displacement_error = compute_change(log["x"] + 1j * log["y"]) - integrate_rate(
            earth_velocity
        )
        is_finite = np.isfinite(displacement_error)
        if is_finite.any():
            errors[0] = root_mean_square(displacement_error) / max(
                root_mean_square(integrate_rate(np.abs(earth_velocity))), 1e-9
            )
    if "psi" in log and "r" in log:
        heading_error = compute_change(log["psi"]) - integrate_rate(
            interpolate_gaps(log.t, log["r"])
        )
        is_finite = np.isfinite(heading_error)
        errors[1] = 0.5 * root_mean_square(heading_error) if is_finite.any() else 0.0
    return errors

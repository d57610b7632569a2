"""Measure the effect of findings on the motion; findings with a small effect become notes.

Two quantities are compared with and without the fault: the error of dead reckoning, that is of
positions and headings integrated from the velocities, and the velocities.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from residnet.core.log import Log
from residnet.quality.findings import Finding
from residnet.quality.statistics import LogStatistics, interpolate_gaps

_MIN_RECKONING_CHANGE = 0.06
"""Smallest change of the dead-reckoning error that counts, as a share of the distance travelled.

Smaller changes can result from the errors of a satellite receiver.
"""
_CERTAIN_T_STATISTIC = 20.0
"""t statistic of the size of a fault above which the size counts as known."""
_MIN_VELOCITY_CHANGE = 0.08
"""Smallest RMS error of a velocity that counts, in standard deviations of the velocity."""
_COMPARISON_SHIFTS = np.arange(1, 12, 2)
"""Shifts, in twelfths of the log, of the samples that are omitted for comparison.

Omitting any samples changes the error; only the change beyond this is attributed to a fault.
"""
_RECKONING_DURATION = 60.0
"""Duration of a dead-reckoning run in s; shorter in a log with less than three of them."""


class FindingEffects:
    """Effects of findings on the motion of a log.

    Args:
        log: statistics of the log; a long log is represented by a subsample.
        sample_mask: samples that the subsample must contain [T] bool; None for evenly spread ones.
    """

    def __init__(self, log: LogStatistics, sample_mask: np.ndarray | None = None) -> None:
        self._full_log = log
        self._sample_indices, self._log = (
            (log.subsample_rows, log.subsample)
            if sample_mask is None
            else log.excerpt_around(sample_mask)
        )
        self._reckoning_errors = compute_reckoning_errors(self._log)

    def measure(self, finding: Finding) -> Finding:
        """Return the finding with its measured effect; it becomes a note if the effect is small.

        Only a finding with affected samples or with a correction can be measured.
        """
        if finding.level != "will mislead" or finding.is_record_fault:
            return finding
        velocity_change = 0.0
        if finding.repair is not None:
            repaired_log = self._log.on_grid(finding.repair(self._log.log))
            reckoning_changes = self._compute_reckoning_changes(repaired_log)
            velocity_change = self._compute_velocity_change(repaired_log.log, finding)
        elif finding.sample_mask is not None and finding.sample_mask.any():
            sample_mask = finding.sample_mask[self._sample_indices]
            # the subsample of a long log may contain none of the affected samples
            if not sample_mask.any():
                return FindingEffects(self._full_log, finding.sample_mask).measure(finding)
            # the same pattern of samples at other times of the log
            chance_changes = [
                self._compute_reckoning_changes(self._log, np.roll(sample_mask, shift))
                for shift in _COMPARISON_SHIFTS * sample_mask.size // 12
            ]
            reckoning_changes = _excess_rms(
                self._compute_reckoning_changes(self._log, sample_mask),
                np.sqrt(np.mean(np.square(chance_changes), axis=0)),
            )
        else:
            return finding
        reckoning_change = float(reckoning_changes.max())
        effect = max(
            reckoning_change if reckoning_change >= _MIN_RECKONING_CHANGE else 0.0,
            velocity_change if velocity_change >= _MIN_VELOCITY_CHANGE else 0.0,
        )
        return dataclasses.replace(
            finding, level=finding.level if effect else "note", effect=effect
        )

    def _compute_reckoning_changes(
        self, log: LogStatistics, omitted: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the parts [2] of the errors of the log that another log does not have."""
        return _excess_rms(self._reckoning_errors, compute_reckoning_errors(log, omitted))

    def _compute_velocity_change(self, repaired_log: Log, finding: Finding) -> float:
        """Return the largest relative RMS change of a velocity; 0 if its size is uncertain."""
        size = abs(finding.figures.get("size", 0.0))
        if size <= _CERTAIN_T_STATISTIC * finding.figures.get("error", np.inf):
            return 0.0
        return max(
            (
                float(np.sqrt(np.nanmean((repaired_log[name] - self._log[name]) ** 2)))
                / max(self._log.std(name), 1e-12)
                for name in self._log.velocities
            ),
            default=0.0,
        )


def _excess_rms(rms_value: np.ndarray, reference_rms: np.ndarray) -> np.ndarray:
    """Return the RMS of what adds to an independent part with the reference RMS; at least 0."""
    return np.asarray(np.sqrt(np.maximum(rms_value**2 - reference_rms**2, 0.0)))


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

"""Measured logs of force and motion, their cross-validation folds, thruster lag and sensor checks.

Source: Jervan 2020, chapter 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.autopilot.actuator_lag import fit_lag, simulate_lagged_force
from residnet.core.config import Config, ConfigPath, Seconds
from residnet.core.errors import ConfigError, DataError, FitError
from residnet.core.layout import ACCELERATIONS, PLANAR_LAYOUT, POSE, VELOCITIES
from residnet.evaluation.intervals import (
    ResamplingBlocks,
    bootstrap_intervals,
    make_resampling_blocks,
)
from residnet.io.readers import ReaderConfig
from residnet.io.split import assign_log_names, check_leaks, match_patterns
from residnet.preprocessing.prepare import PrepareConfig, prepare_log
from residnet.studies.jervan2020.residual import AXES, ForceRecord

_ChannelTriple = tuple[str, str, str]
_MIN_LOGS_FOR_FOLDS = 3
"""Number of logs from which whole logs are folds, instead of segments."""
_MIN_LOGS_FOR_INTERVALS = 5
"""Number of logs from which the bootstrap resamples logs instead of segments."""
_MIN_SEGMENTS = 5
"""Smallest number of segments for confidence intervals."""


class ForceLogsConfig(Config):
    """Files of the measured logs; `validation` defines the test data.

    Attributes:
        reader: format of the logs and their channel map.
        root: folder of the patterns.
        logs: file names or patterns, for example `nlp*.csv`.
    """

    reader: ReaderConfig
    root: ConfigPath
    logs: tuple[str, ...] = Field(min_length=1)

    def find_paths(self) -> list[Path]:
        """Return the paths of all logs without duplicates.

        Raises:
            ConfigError: if the folder does not exist or a pattern has no match.
        """
        if not self.root.is_dir():
            raise ConfigError(f"data: root {self.root} is not a folder; correct `root`")
        return match_patterns(self.root, self.logs, "data: logs")


class ForceChannelsConfig(Config):
    """Names of the channels of force and acceleration.

    Attributes:
        actual: actual forces in N, N, N m, from measured revolutions and angles of the thrusters.
        commanded: forces commanded by the controller, in N, N, N m.
        acceleration: measured accelerations of u, v, r in m/s^2, m/s^2, rad/s^2; null for none.
    """

    actual: _ChannelTriple
    commanded: _ChannelTriple
    acceleration: _ChannelTriple | None = None


class FoldsConfig(Config):
    """Cross-validation with a gap between training and test data.

    Attributes:
        folds: number of folds: whole logs if there are at least three, else equal segments of each
            log.
        gap: time in s before and after a test segment that is excluded from the training data.
        segment: length in s of the segments of the inner cross-validation, which selects orders and
            penalties, and of the bootstrap blocks.
    """

    folds: int = Field(default=5, ge=2, le=1_000)
    gap: Seconds = Field(default=5.0, ge=0)
    segment: Seconds = Field(default=30.0, gt=0)


@dataclass(frozen=True)
class MeasuredForceLogs:
    """All logs concatenated, N samples; forces in N, N, N m.

    Attributes:
        names: names of the logs.
        record: motion and commanded force, smoothed according to `prepare`; NaN where masked. Its
            `fold` is the segment of the inner cross-validation.
        forces: `commanded` and `actual` forces [N, 3].
        usable: samples for fit and evaluation [N] bool.
        fold_index: fold of the outer cross-validation [N].
        fold_unit: unit of a fold: `logs` or `stretches`.
        masked_shares: share of masked samples, by log and mask.
        accelerations: measured accelerations and derivatives of the velocities [N, 3] by name;
            empty without measurements.
        acceleration_comparison: comparison of the two by axis; empty without measurements.
    """

    names: tuple[str, ...]
    record: ForceRecord
    forces: dict[str, Tensor]
    usable: Tensor
    fold_index: Tensor
    fold_unit: str
    masked_shares: dict[str, dict[str, float]]
    accelerations: dict[str, Tensor]
    acceleration_comparison: dict[str, Any]

    def split_fold(self, fold_index: int, gap: float) -> tuple[ForceRecord, Tensor]:
        """Return the record without a fold for training, and the samples [N] of the fold.

        Args:
            fold_index: index of the test fold.
            gap: time in s around the fold that is excluded from training, since neighbouring
                samples are correlated.

        Raises:
            DataError: if training or test data are empty.
        """
        inside_fold = self.fold_index == fold_index
        gap_samples = round(gap / self.record.dt)
        fold_flags = inside_fold.to(torch.float64)[None, None].split(
            list(self.record.run_lengths), dim=-1
        )
        # dilation of the fold by the gap on both sides, within each log
        is_near_fold = torch.cat(
            [
                torch.nn.functional.max_pool1d(log_flags, 2 * gap_samples + 1, 1, gap_samples)[0, 0]
                > 0
                for log_flags in fold_flags
            ]
        )
        train = self.usable & ~is_near_fold
        test = self.usable & inside_fold
        for problem, samples in (
            ("no training sample remains outside of", train),
            ("no test sample in", test),
        ):
            if not bool(samples.any()):
                raise DataError(
                    f"validation: {problem} fold {fold_index + 1}; check the masks, or lower"
                    " validation.folds or validation.gap"
                )
        return replace(self.record, is_training=train), test

    def usable_segments(self) -> list[Tensor]:
        """Return the indices of the usable samples of each segment.

        Segments with less than half of the largest number of usable samples are omitted, since
        bootstrap blocks must have similar sizes.
        """
        segments = [
            ((self.record.fold == number) & self.usable).nonzero()[:, 0]
            for number in torch.unique(self.record.fold)
        ]
        min_length = max(len(segment) for segment in segments) / 2
        return [segment for segment in segments if len(segment) >= min_length]

    def resampling_blocks(self) -> ResamplingBlocks | None:
        """Return bootstrap blocks: logs if there are five or more, else segments.

        None for fewer than five segments.
        """
        log = torch.repeat_interleave(
            torch.arange(len(self.names)), torch.tensor(self.record.run_lengths)
        )
        log_of_segment = [int(log[segment[0]]) for segment in self.usable_segments()]
        if len(self.names) >= _MIN_LOGS_FOR_INTERVALS:
            return make_resampling_blocks(log_of_segment)
        return _segment_blocks(len(log_of_segment))


def _segment_blocks(count: int) -> ResamplingBlocks | None:
    """Return segments as bootstrap blocks; None if there are too few."""
    return ResamplingBlocks(np.arange(count), "segments", count) if count >= _MIN_SEGMENTS else None


def read_force_logs(
    data: ForceLogsConfig,
    channels: ForceChannelsConfig,
    preparation: PrepareConfig,
    validation: FoldsConfig,
) -> MeasuredForceLogs:
    """Read, mask, smooth and differentiate all logs.

    Raises:
        ResidnetError: if a log cannot be read or has no usable samples.
    """
    import pandas as pd

    reader = data.reader.build()
    paths = assign_log_names(data.find_paths())
    raw_logs = [reader.read(path).replace(name=name) for path, name in paths.items()]
    # a copy of a log in another file would be in training and test data
    check_leaks({log.name: [log] for log in raw_logs})
    columns = (*channels.commanded, *channels.actual, *(channels.acceleration or ()))
    logs = [prepare_log(log, "all", columns, preparation) for log in raw_logs]
    names = [log.log.name for log in logs]
    lengths = [len(log) for log in logs]
    step = preparation.grid.step
    # folds are whole logs if there are enough; segments never extend over two logs
    uses_log_folds = len(logs) >= _MIN_LOGS_FOR_FOLDS
    fold_parts = []
    segments = []
    commands = []
    masked = {}
    n_segments_total = 0
    for log_index, (log, name, length) in enumerate(zip(logs, names, lengths, strict=True)):
        if not log.trainable.any():
            raise DataError(
                f"log {name}: no part without a gap is as long as the window of the derivative;"
                " remove the log or shorten prepare.derivative"
            )
        sample_index = torch.arange(length)
        n_folds = min(validation.folds, len(logs)) if uses_log_folds else validation.folds
        fold_parts.append(
            0 * sample_index + log_index * n_folds // len(logs)
            if uses_log_folds
            else sample_index * n_folds // length
        )
        n_segments = max(round(length * step / validation.segment), 1)
        segments.append(n_segments_total + sample_index * n_segments // length)
        n_segments_total += n_segments
        # commands hold their last value over gaps, and are zero before the first
        filled_commands = (
            pd.DataFrame(log.regression_inputs[:, : PLANAR_LAYOUT.n_dof]).ffill().fillna(0.0)
        )
        commands.append(torch.from_numpy(np.array(filled_commands)))
        shares = {reason: float(mask.mean()) for reason, mask in log.log.masks.items()}
        masked[name] = {reason: share for reason, share in shares.items() if share}
    smooth, nu_dot, measured, usable = (
        torch.from_numpy(np.concatenate([getattr(log, attribute) for log in logs]))
        for attribute in ("smoothed", "nu_dot", "regression_inputs", "trainable")
    )
    fold = torch.cat(segments)
    accelerations: dict[str, Tensor] = {}
    acceleration: dict[str, Any] = {}
    if channels.acceleration is not None:
        sensed = measured[:, ACCELERATIONS]
        accelerations = {"measured acceleration": sensed, "derivative of velocity": nu_dot}
        acceleration = compare_accelerations(nu_dot[usable], sensed[usable], fold[usable])
    command = torch.cat(commands)
    record = ForceRecord(
        t=step * torch.arange(len(fold), dtype=torch.float64),
        pose=smooth[:, POSE],
        nu=smooth[:, VELOCITIES],
        nu_dot=nu_dot,
        command=command,
        averaged_command=command,
        fold=fold,
        is_training=usable,
        noise=(0.0,) * 9,
        run_lengths=tuple(lengths),
    )
    return MeasuredForceLogs(
        tuple(names),
        record,
        {"commanded": command, "actual": measured[:, VELOCITIES]},
        usable,
        torch.cat(fold_parts),
        "logs" if uses_log_folds else "stretches",
        masked,
        accelerations,
        acceleration,
    )


def compare_accelerations(derived: Tensor, measured: Tensor, segment: Tensor) -> dict[str, Any]:
    """Compare measured accelerations with derivatives of velocity, axis by axis.

    Args:
        derived: derivatives of velocity [N, 3].
        measured: measured accelerations [N, 3].
        segment: number of each sample's segment [N].

    Returns:
        By axis the offset, its 95 % interval, and the spread and correlation without it.
    """
    difference = measured - derived
    means = np.stack(
        [difference[segment == number].mean(0).numpy() for number in torch.unique(segment)]
    )
    confidence_intervals = bootstrap_intervals(means, _segment_blocks(len(means)))
    comparison: dict[str, Any] = {}
    for axis, name in enumerate(AXES):
        correlation_matrix = torch.corrcoef(torch.stack((derived[:, axis], measured[:, axis])))
        comparison[name] = {
            "offset": float(difference[:, axis].mean()),
            "offset_ci95": confidence_intervals[axis],
            "rms_without_offset": float(difference[:, axis].std()),
            "rms": float(derived[:, axis].std()),
            "correlation": float(torch.nan_to_num(correlation_matrix[0, 1])),
        }
    return comparison


def compare_forces(measured: MeasuredForceLogs) -> dict[str, Any]:
    """Compare commanded and actual force: thruster lag and explained variance.

    Returns:
        `lag` (its parameters, or the reason why it is undetermined), and by axis the share of the
        actual force's variance that the command explains, without and with the lag.
    """
    record = measured.record
    usable = measured.usable
    comparison: dict[str, Any] = {}
    try:
        lag = fit_lag(
            record.command,
            torch.nan_to_num(measured.forces["actual"]),
            torch.zeros_like(record.command),
            record.dt,
            usable,
            record.run_lengths,
        )
        comparison["lag"] = lag.model_dump()
        lagged_command = simulate_lagged_force(record.command, lag, record.dt, record.run_lengths)
    except FitError as error:
        comparison["lag"] = str(error)
        lagged_command = record.command
    actual = measured.forces["actual"][usable]
    commanded = record.command[usable]
    lagged_force = lagged_command[usable]
    force_variance = (actual - actual.mean(0)).square().mean(0)
    unexplained, unexplained_with_lag = (
        (actual - force).square().mean(0) / force_variance for force in (commanded, lagged_force)
    )
    gain = (lagged_force * actual).sum(0) / lagged_force.square().sum(0).clamp(min=1e-300)
    statistics = {
        "rms_commanded": commanded.square().mean(0).sqrt(),
        "rms_actual": actual.square().mean(0).sqrt(),
        "explained": 1 - unexplained,
        "explained_with_lag": 1 - unexplained_with_lag,
        "gain_with_lag": gain,
    }
    for axis, name in enumerate(AXES):
        comparison[name] = {
            quantity: float(values[axis]) for quantity, values in statistics.items()
        }
    return comparison

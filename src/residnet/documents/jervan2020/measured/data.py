"""Measured logs as one record of motion and forces with folds (document 002, section 5.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import DataError, FitError
from residnet.core.layout import ACCELERATIONS, PLANAR, POSE, VELOCITIES
from residnet.data.parts import log_names
from residnet.data.prepare import Prepared, prepare
from residnet.data.split import check_leaks
from residnet.documents.jervan2020.measured.config import FoldsConfig, ForceSettings
from residnet.documents.jervan2020.residual_model import AXES, Record
from residnet.judge.bootstrap import Blocks, blocks, intervals
from residnet.training.lag import fit_lag, followed

_LOGS_FOR_FOLDS = 3
"""Number of logs from which on whole logs are left out instead of stretches of time."""
_LOGS_FOR_INTERVALS = 5
"""Number of logs from which on intervals resample logs instead of segments."""
_LEAST_SEGMENTS = 5
"""Least number of segments for intervals."""


@dataclass(frozen=True)
class Measured:
    """All logs one after another, N samples; forces in N, N, N m.

    Attributes:
        names: names of the logs.
        record: motion and commanded force, smoothed as `prepare` says; NaN where masked. Its folds
            are the segments.
        actual: forces that acted [N, 3].
        good: samples that models may be fitted to and judged on [N] bool.
        part: number of the fold of the outer cross-validation [N].
        parts: what a fold consists of: `logs` or `stretches`.
        masked: share of the samples that each mask excludes, by log and mask.
        derived: derivatives of the velocities [N, 3].
        sensed: measured accelerations as logged [N, 3]; None where there are none.
        acceleration: comparison of the two by axis; empty where no acceleration was measured.
    """

    names: tuple[str, ...]
    record: Record
    actual: Tensor
    good: Tensor
    part: Tensor
    parts: str
    masked: dict[str, dict[str, float]]
    derived: Tensor
    sensed: Tensor | None
    acceleration: dict[str, Any]

    def force(self, which: str) -> Tensor:
        """Return the force [N, 3], `actual` or `commanded`."""
        return self.actual if which == "actual" else self.record.command

    def split(self, part: int, gap: float) -> tuple[Record, Tensor]:
        """Return the record without a fold for training, and the samples [N] of the fold.

        Args:
            part: number of the fold.
            gap: time in s around the fold that is left out of training too.

        Raises:
            DataError: where either has no samples.
        """
        inside_fold = self.part == part
        near = inside_fold.clone()
        reach = round(gap / self.record.dt)
        start = 0
        for length in self.record.runs:
            flags = inside_fold[start : start + length].to(torch.float64)[None, None]
            near[start : start + length] = (
                torch.nn.functional.max_pool1d(flags, 2 * reach + 1, 1, reach)[0, 0] > 0
            )
            start += length
        train, test = self.good & ~near, self.good & inside_fold
        for name, samples in (
            ("nothing left to fit to beside", train),
            ("no sample to judge on in", test),
        ):
            if not bool(samples.any()):
                raise DataError(
                    f"validation: {name} fold {part + 1}; check the masks, or lower"
                    " validation.folds or validation.gap"
                )
        return replace(self.record, train=train), test

    def segments(self) -> list[Tensor]:
        """Return the indices of the good samples of each segment.

        A segment with less than half of the largest number of good samples is left out.
        """
        segments = [
            ((self.record.fold == number) & self.good).nonzero()[:, 0]
            for number in torch.unique(self.record.fold)
        ]
        least = max(len(segment) for segment in segments) / 2
        return [segment for segment in segments if len(segment) >= least]

    def blocks(self) -> Blocks | None:
        """Return what the intervals resample: logs from five on, segments for fewer.

        None where there are fewer than five segments.
        """
        log = torch.repeat_interleave(torch.arange(len(self.names)), torch.tensor(self.record.runs))
        log_of_segment = [int(log[segment[0]]) for segment in self.segments()]
        if len(self.names) >= _LOGS_FOR_INTERVALS:
            return blocks(log_of_segment)
        return _segment_blocks(len(log_of_segment))


def _segment_blocks(count: int) -> Blocks | None:
    """Return segments as blocks of a bootstrap; None where there are too few."""
    return Blocks(np.arange(count), "segments", count) if count >= _LEAST_SEGMENTS else None


def read_measured(config: ForceSettings) -> Measured:
    """Read, mask, smooth and differentiate all logs.

    Raises:
        ResidnetError: where a log cannot be read or holds no usable samples.
    """
    logs = _read(config)
    joined = {
        name: torch.from_numpy(np.concatenate([getattr(log, name) for log in logs]))
        for name in ("smooth", "nu_dot", "recorded", "good")
    }
    good, columns = joined["good"], joined["recorded"]
    derived, fold = joined["nu_dot"], _segments(logs, config)
    sensed = columns[:, ACCELERATIONS] if config.channels.acceleration is not None else None
    acceleration: dict[str, Any] = {}
    nu_dot = derived
    if sensed is not None:
        acceleration = compare_accelerations(derived[good], sensed[good], fold[good])
        nu_dot = (
            _calibrated(logs, derived, sensed) if config.acceleration == "measured" else derived
        )
    part, parts = _parts(logs, config.validation)
    step, count = config.prepare.grid.step, len(fold)
    smooth = joined["smooth"]
    command = torch.cat([_held(log.recorded[:, : PLANAR.dof]) for log in logs])
    record = Record(
        step * torch.arange(count, dtype=torch.float64),
        smooth[:, POSE],
        smooth[:, VELOCITIES],
        nu_dot,
        command,
        command,
        fold,
        good,
        (0.0,) * 9,
        tuple(len(log) for log in logs),
    )
    return Measured(
        tuple(log.log.name for log in logs),
        record,
        columns[:, VELOCITIES],
        good,
        part,
        parts,
        _masked(logs),
        derived,
        sensed,
        acceleration,
    )


def _read(config: ForceSettings) -> list[Prepared]:
    """Read and prepare all logs.

    Raises:
        DataError: where two logs have rows in common, or a log holds no usable samples.
    """
    reader = config.data.reader.build()
    names = log_names(config.data.files())
    recorded = [reader.read(path).replace(name=name) for path, name in names.items()]
    # a model would be fitted to the very samples that judge it
    check_leaks({log.name: [log] for log in recorded})
    logs = [prepare(log, "all", config.channels.columns(), config.prepare) for log in recorded]
    for log in logs:
        if not log.good.any():
            raise DataError(
                f"log {log.log.name}: no stretch is as long as the derivative's window; leave it"
                " out or shorten prepare.derivative"
            )
    return logs


def _masked(logs: Sequence[Prepared]) -> dict[str, dict[str, float]]:
    """Return the share of the samples that each mask excludes, by log and mask."""
    return {
        log.log.name: {
            reason: float(mask.mean()) for reason, mask in log.log.masks.items() if mask.any()
        }
        for log in logs
    }


def _calibrated(logs: Sequence[Prepared], derived: Tensor, sensed: Tensor) -> Tensor:
    """Return measured accelerations [N, 3] less their mean offset from `derived`, log by log."""
    out, start = sensed.clone(), 0
    for log in logs:
        inside, good = slice(start, start + len(log)), torch.from_numpy(log.good)
        out[inside] -= (sensed[inside] - derived[inside])[good].mean(0)
        start += len(log)
    return out


def _held(values: np.ndarray) -> Tensor:
    """Return commands [T, 3] with the last value held over gaps, and zero before the first."""
    import pandas as pd

    return torch.from_numpy(np.array(pd.DataFrame(values).ffill().fillna(0.0)))


def _segments(logs: Sequence[Prepared], config: ForceSettings) -> Tensor:
    """Return the number of each sample's segment [N]; no segment reaches across logs."""
    numbers, first = [], 0
    for log in logs:
        count = max(round(len(log) * config.prepare.grid.step / config.validation.segment), 1)
        numbers.append(first + torch.arange(len(log)) * count // len(log))
        first += count
    return torch.cat(numbers)


def _parts(logs: Sequence[Prepared], config: FoldsConfig) -> tuple[Tensor, str]:
    """Return the number of each sample's fold [N], and what a fold consists of."""
    if len(logs) >= _LOGS_FOR_FOLDS:
        folds = min(config.folds, len(logs))
        return (
            torch.cat(
                [torch.full((len(log),), i * folds // len(logs)) for i, log in enumerate(logs)]
            ),
            "logs",
        )
    return (
        torch.cat([torch.arange(len(log)) * config.folds // len(log) for log in logs]),
        "stretches",
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
    within = intervals(means, _segment_blocks(len(means)))
    out: dict[str, Any] = {}
    for axis, name in enumerate(AXES):
        both = torch.corrcoef(torch.stack((derived[:, axis], measured[:, axis])))
        out[name] = {
            "offset": float(difference[:, axis].mean()),
            "offset_ci95": within[axis],
            "rms_without_offset": float(difference[:, axis].std()),
            "rms": float(derived[:, axis].std()),
            "correlation": float(torch.nan_to_num(both[0, 1])),
        }
    return out


def compare_forces(measured: Measured) -> dict[str, Any]:
    """Compare commanded and actual force: the thrusters' lag, and what the command explains.

    Returns:
        `lag` (its parameters, or why it is not determined), and by axis the share of the actual
        force's variance that the command explains, without and with the lag.
    """
    record, good = measured.record, measured.good
    out: dict[str, Any] = {}
    try:
        lag = fit_lag(
            record.command,
            torch.nan_to_num(measured.actual),
            torch.zeros_like(record.command),
            record.dt,
            good,
            record.runs,
        ).lag
        out["lag"] = {"frequency": lag.frequency, "damping": lag.damping, "delay": lag.delay}
        after = followed(record.command, lag, record.dt, record.runs)
    except FitError as error:
        out["lag"], after = str(error), record.command
    actual = measured.actual[good]
    total = (actual - actual.mean(0)).square().mean(0)
    for axis, name in enumerate(AXES):
        shares = [
            float(1 - (actual[:, axis] - force[good][:, axis]).square().mean() / total[axis])
            for force in (record.command, after)
        ]
        slope = float(
            (after[good][:, axis] * actual[:, axis]).sum()
            / after[good][:, axis].square().sum().clamp(min=1e-300)
        )
        out[name] = {
            "rms_commanded": float(record.command[good][:, axis].square().mean().sqrt()),
            "rms_actual": float(actual[:, axis].square().mean().sqrt()),
            "explained": shares[0],
            "explained_with_lag": shares[1],
            "gain_with_lag": slope,
        }
    return out

"""Measured logs of force and motion, their folds, and what they say of thrusters and sensors.

Source: document 002, chapter 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, ConfigPath, Seconds
from residnet.core.errors import ConfigError, DataError, FitError
from residnet.core.layout import ACCELERATIONS, PLANAR, POSE, VELOCITIES
from residnet.data.prepare import PrepareConfig, prepare
from residnet.data.readers import ReaderConfig
from residnet.data.split import check_leaks, log_names, matches
from residnet.documents.jervan2020.residual import AXES, Record
from residnet.judge.metrics import Blocks, blocks, intervals
from residnet.training.lag import fit_lag, followed

_Channels = tuple[str, str, str]
_LOGS_FOR_FOLDS = 3
"""Number of logs from which on whole logs are left out instead of stretches of time."""
_LOGS_FOR_INTERVALS = 5
"""Number of logs from which on intervals resample logs instead of segments."""
_LEAST_SEGMENTS = 5
"""Least number of segments for intervals."""


class ForceLogs(Config):
    """Measured logs; `validation` says which part of them tests.

    Attributes:
        reader: format of the logs and their channel map.
        root: folder that the patterns start from.
        logs: file names or patterns such as `nlp*.csv`.
    """

    reader: ReaderConfig
    root: ConfigPath
    logs: tuple[str, ...] = Field(min_length=1)

    def files(self) -> list[Path]:
        """Return the paths of all logs, each once.

        Raises:
            ConfigError: where the folder is not there or a pattern matches nothing.
        """
        if not self.root.is_dir():
            raise ConfigError(f"data: root {self.root} is not a folder; correct `root`")
        return matches(self.root, self.logs, "data: logs")


class ForceChannels(Config):
    """Names of the channels of force and acceleration, beside x, y, psi, u, v and r.

    Attributes:
        actual: forces that acted, in N, N, N m, from measured revolutions and angles of the
            thrusters.
        commanded: forces that the controller commanded, in N, N, N m.
        acceleration: measured accelerations of u, v, r in m/s^2, m/s^2, rad/s^2; null where there
            are none.
    """

    actual: _Channels
    commanded: _Channels
    acceleration: _Channels | None = None


class FoldsConfig(Config):
    """Cross-validation in which no model is fitted to data near what it predicts.

    Attributes:
        folds: number of parts that are left out in turn: whole logs where there are at least three,
            else equal stretches of time of each log.
        gap: time in s before and after a left-out stretch that is left out of the fit too.
        segment: length in s of the segments that the inner cross-validation leaves out to choose
            orders and penalties, and that the intervals resample.
    """

    folds: int = Field(default=5, ge=2, le=1_000)
    gap: Seconds = Field(default=5.0, ge=0)
    segment: Seconds = Field(default=30.0, gt=0)


@dataclass(frozen=True)
class Measured:
    """All logs one after another, N samples; forces in N, N, N m.

    Attributes:
        names: names of the logs.
        record: motion and commanded force, smoothed as `prepare` says; NaN where masked. Its folds
            are the segments.
        forces: `commanded` and `actual` forces [N, 3].
        good: samples that models may be fitted to and judged on [N] bool.
        part: number of the fold of the outer cross-validation [N].
        parts: what a fold consists of: `logs` or `stretches`.
        masked: share of the samples that each mask excludes, by log and mask.
        accelerations: as measured and as derived from the velocities [N, 3], by what they are;
            empty where none were measured.
        acceleration: comparison of the two by axis; empty where no acceleration was measured.
    """

    names: tuple[str, ...]
    record: Record
    forces: dict[str, Tensor]
    good: Tensor
    part: Tensor
    parts: str
    masked: dict[str, dict[str, float]]
    accelerations: dict[str, Tensor]
    acceleration: dict[str, Any]

    def split(self, part: int, gap: float) -> tuple[Record, Tensor]:
        """Return the record without a fold for training, and the samples [N] of the fold.

        Args:
            gap: time in s around the fold that is left out of training too.

        Raises:
            DataError: where either has no samples.
        """
        inside_fold = self.part == part
        reach = round(gap / self.record.dt)
        flags = inside_fold.to(torch.float64)[None, None].split(list(self.record.runs), dim=-1)
        near = torch.cat(
            [torch.nn.functional.max_pool1d(of, 2 * reach + 1, 1, reach)[0, 0] > 0 for of in flags]
        )
        train, test = self.good & ~near, self.good & inside_fold
        for what, samples in (
            ("nothing left to fit to beside", train),
            ("no sample to judge on in", test),
        ):
            if not bool(samples.any()):
                raise DataError(
                    f"validation: {what} fold {part + 1}; check the masks, or lower"
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


def read_measured(
    data: ForceLogs,
    channels: ForceChannels,
    preparation: PrepareConfig,
    validation: FoldsConfig,
) -> Measured:
    """Read, mask, smooth and differentiate all logs.

    Raises:
        ResidnetError: where a log cannot be read or holds no usable samples.
    """
    import pandas as pd

    reader, paths = data.reader.build(), log_names(data.files())
    recorded = [reader.read(path).replace(name=name) for path, name in paths.items()]
    # a model would be fitted to the very samples that judge it
    check_leaks({log.name: [log] for log in recorded})
    columns = (*channels.commanded, *channels.actual, *(channels.acceleration or ()))
    logs = [prepare(log, "all", columns, preparation) for log in recorded]
    names, lengths = [log.log.name for log in logs], [len(log) for log in logs]
    step = preparation.grid.step
    # whole logs are folds where there are enough; no segment reaches across logs
    of_logs = len(logs) >= _LOGS_FOR_FOLDS
    parts, segments, commands, masked, count = [], [], [], {}, 0
    for place, (log, name, length) in enumerate(zip(logs, names, lengths, strict=True)):
        if not log.good.any():
            raise DataError(
                f"log {name}: no stretch is as long as the derivative's window; leave it out or"
                " shorten prepare.derivative"
            )
        at = torch.arange(length)
        folds = min(validation.folds, len(logs)) if of_logs else validation.folds
        parts.append(0 * at + place * folds // len(logs) if of_logs else at * folds // length)
        of_log = max(round(length * step / validation.segment), 1)
        segments.append(count + at * of_log // length)
        count += of_log
        # commands hold their last value over gaps, and are zero before the first
        given = pd.DataFrame(log.recorded[:, : PLANAR.dof]).ffill().fillna(0.0)
        commands.append(torch.from_numpy(np.array(given)))
        shares = {reason: float(mask.mean()) for reason, mask in log.log.masks.items()}
        masked[name] = {reason: share for reason, share in shares.items() if share}
    smooth, nu_dot, measured, good = (
        torch.from_numpy(np.concatenate([getattr(log, what) for log in logs]))
        for what in ("smooth", "nu_dot", "recorded", "good")
    )
    fold = torch.cat(segments)
    accelerations: dict[str, Tensor] = {}
    acceleration: dict[str, Any] = {}
    if channels.acceleration is not None:
        sensed = measured[:, ACCELERATIONS]
        accelerations = {"measured acceleration": sensed, "derivative of velocity": nu_dot}
        acceleration = compare_accelerations(nu_dot[good], sensed[good], fold[good])
    command = torch.cat(commands)
    record = Record(
        step * torch.arange(len(fold), dtype=torch.float64),
        smooth[:, POSE],
        smooth[:, VELOCITIES],
        nu_dot,
        command,
        command,
        fold,
        good,
        (0.0,) * 9,
        tuple(lengths),
    )
    return Measured(
        tuple(names),
        record,
        {"commanded": command, "actual": measured[:, VELOCITIES]},
        good,
        torch.cat(parts),
        "logs" if of_logs else "stretches",
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
            torch.nan_to_num(measured.forces["actual"]),
            torch.zeros_like(record.command),
            record.dt,
            good,
            record.runs,
        )
        out["lag"] = lag.model_dump()
        after = followed(record.command, lag, record.dt, record.runs)
    except FitError as error:
        out["lag"], after = str(error), record.command
    actual, commanded, late = measured.forces["actual"][good], record.command[good], after[good]
    total = (actual - actual.mean(0)).square().mean(0)
    unexplained, unexplained_late = (
        (actual - force).square().mean(0) / total for force in (commanded, late)
    )
    gain = (late * actual).sum(0) / late.square().sum(0).clamp(min=1e-300)
    columns = {
        "rms_commanded": commanded.square().mean(0).sqrt(),
        "rms_actual": actual.square().mean(0).sqrt(),
        "explained": 1 - unexplained,
        "explained_with_lag": 1 - unexplained_late,
        "gain_with_lag": gain,
    }
    for axis, name in enumerate(AXES):
        out[name] = {what: float(values[axis]) for what, values in columns.items()}
    return out

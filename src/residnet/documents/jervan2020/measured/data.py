"""Measured logs as one record of motion and forces, with the folds that judge models honestly
(document 002 section 5.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import DataError, FitError
from residnet.data.prepare import Prepared, prepare
from residnet.data.split import check_leaks
from residnet.documents.jervan2020.measured.config import FoldsConfig, ForceSettings
from residnet.documents.jervan2020.residual_model import Record
from residnet.judge.bootstrap import Blocks, blocks, intervals
from residnet.training.lag import fit_lag, followed

AXES = ("surge", "sway", "yaw")
_FEW_LOGS = 3
_LEAST_SEGMENTS = 5
_RUNS_OF_A_LOG = 5


@dataclass(frozen=True)
class Measured:
    """All logs, one after another (N samples).

    Attributes:
        names: of the logs.
        record: motion and commanded force, smoothed as `prepare` says; NaN where masked. Its folds
            are segments.
        actual: forces that acted [N, 3].
        good: samples that may be learned from and judged on [N].
        part: number of the fold of the outer cross-validation [N].
        parts: what a fold is: `logs` or `stretches`.
        masked: share of samples that each mask excludes, by log.
        derived: derivatives of velocity [N, 3].
        sensed: measured accelerations as they are logged [N, 3]; None where there are none.
        acceleration: how the two compare; empty where nothing was measured.
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
        """Force [N, 3], actual or commanded."""
        return self.actual if which == "actual" else self.record.command

    def split(self, part: int, gap: float) -> tuple[Record, Tensor]:
        """The record that learns nothing from a part and `gap` seconds around it, and the samples
        [N] of the part that judge.

        Raises:
            DataError: where either has no samples.
        """
        out = self.part == part
        near = out.clone()
        reach = round(gap / self.record.dt)
        start = 0
        for length in self.record.runs:
            inside = out[start : start + length].to(torch.float64)[None, None]
            near[start : start + length] = (
                torch.nn.functional.max_pool1d(inside, 2 * reach + 1, 1, reach)[0, 0] > 0
            )
            start += length
        train, test = self.good & ~near, self.good & out
        for name, samples in (
            ("nothing left to learn from beside", train),
            ("no sample to judge on in", test),
        ):
            if not bool(samples.any()):
                raise DataError(
                    f"validation: {name} fold {part + 1}; check the masks, or lower"
                    " validation.folds or validation.gap"
                )
        return replace(self.record, train=train), test

    def segments(self) -> list[Tensor]:
        """Indices of the good samples of each segment; one with less than half of the usual number
        is left out.
        """
        found = [
            ((self.record.fold == number) & self.good).nonzero()[:, 0]
            for number in torch.unique(self.record.fold)
        ]
        least = max(len(one) for one in found) / 2
        return [one for one in found if len(one) >= least]

    def blocks(self) -> Blocks | None:
        """What intervals resample: logs from five on, segments for fewer; None with fewer than five
        segments.
        """
        log = torch.repeat_interleave(torch.arange(len(self.names)), torch.tensor(self.record.runs))
        of = [int(log[segment[0]]) for segment in self.segments()]
        if len(self.names) >= _RUNS_OF_A_LOG:
            return blocks(of)
        return (
            Blocks(np.arange(len(of)), "segments", len(of)) if len(of) >= _LEAST_SEGMENTS else None
        )


def read_measured(config: ForceSettings) -> Measured:
    """Read, mask, smooth and differentiate all logs.

    Raises:
        ResidnetError: where a log cannot be read or holds nothing to learn from.
    """
    reader = config.data.reader.build()
    recorded = [reader.read(path) for path in config.data.files()]
    # a log that stands twice would be learned from where it is judged
    check_leaks({log.name: [log] for log in recorded})
    logs = [prepare(log, "all", config.channels.columns(), config.prepare) for log in recorded]
    for log in logs:
        if not log.good.any():
            raise DataError(
                f"log {log.log.name}: no stretch is as long as the derivative's window; leave it"
                " out or shorten prepare.derivative"
            )
    joined = {
        name: torch.from_numpy(np.concatenate([getattr(log, name) for log in logs]))
        for name in ("smooth", "nu_dot", "recorded", "good")
    }
    good, columns = joined["good"], joined["recorded"]
    derived, fold = joined["nu_dot"], _segments(logs, config)
    sensed = columns[:, 6:9] if config.channels.acceleration is not None else None
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
    command = torch.cat([_carried(log.recorded[:, :3]) for log in logs])
    record = Record(
        step * torch.arange(count, dtype=torch.float64),
        smooth[:, :3],
        smooth[:, 3:6],
        nu_dot,
        command,
        command,
        fold,
        good,
        (0.0,) * 9,
        tuple(len(log) for log in logs),
    )
    masked = {
        log.log.name: {
            reason: float(mask.mean()) for reason, mask in log.log.masks.items() if mask.any()
        }
        for log in logs
    }
    return Measured(
        tuple(log.log.name for log in logs),
        record,
        columns[:, 3:6],
        good,
        part,
        parts,
        masked,
        derived,
        sensed,
        acceleration,
    )


def _calibrated(logs: Sequence[Prepared], derived: Tensor, sensed: Tensor) -> Tensor:
    """Measured accelerations [N, 3] less what they lie above the derivative of velocity, log by
    log.
    """
    out, start = sensed.clone(), 0
    for log in logs:
        inside, good = slice(start, start + len(log)), torch.from_numpy(log.good)
        out[inside] -= (sensed[inside] - derived[inside])[good].mean(0)
        start += len(log)
    return out


def _carried(values: np.ndarray) -> Tensor:
    """Commands [T, 3] with the last value before in place of NaN, zero before the first: what the
    thrusters were told is not lost in a gap.
    """
    import pandas as pd

    return torch.from_numpy(np.array(pd.DataFrame(values).ffill().fillna(0.0)))


def _segments(logs: Sequence[Prepared], config: ForceSettings) -> Tensor:
    """Number of each sample's segment [N]; no segment reaches across logs."""
    numbers, first = [], 0
    for log in logs:
        count = max(round(len(log) * config.prepare.grid.step / config.validation.segment), 1)
        numbers.append(first + torch.arange(len(log)) * count // len(log))
        first += count
    return torch.cat(numbers)


def _parts(logs: Sequence[Prepared], config: FoldsConfig) -> tuple[Tensor, str]:
    if len(logs) >= _FEW_LOGS:
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
    """Measured accelerations [N, 3] against derivatives of velocity [N, 3]: by axis the offset with
    its interval, and what remains without it.
    """
    apart = measured - derived
    means = np.stack([apart[segment == number].mean(0).numpy() for number in torch.unique(segment)])
    within = intervals(
        means,
        (
            Blocks(np.arange(len(means)), "segments", len(means))
            if len(means) >= _LEAST_SEGMENTS
            else None
        ),
    )
    out: dict[str, Any] = {}
    for axis, name in enumerate(AXES):
        both = torch.corrcoef(torch.stack((derived[:, axis], measured[:, axis])))
        out[name] = {
            "offset": float(apart[:, axis].mean()),
            "offset_ci95": within[axis],
            "rms_without_offset": float(apart[:, axis].std()),
            "rms": float(derived[:, axis].std()),
            "correlation": float(torch.nan_to_num(both[0, 1])),
        }
    return out


def compare_forces(measured: Measured) -> dict[str, Any]:
    """Commanded against actual force: the thrusters' lag, and by axis how much of the actual force
    the command explains without and with it.
    """
    record, good = measured.record, measured.good
    out: dict[str, Any] = {}
    try:
        found = fit_lag(
            record.command,
            torch.nan_to_num(measured.actual),
            torch.zeros_like(record.command),
            record.dt,
            good,
            record.runs,
        ).lag
        out["lag"] = {"frequency": found.frequency, "damping": found.damping, "delay": found.delay}
        after = followed(record.command, found, record.dt, record.runs)
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

"""Task `force_residual`: residual models of measured forces (document 002, chapter 5).

Every model is cross-validated and judged beside two others: no force at all, and the believed hull
alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, ConfigPath, Seconds, load_config
from residnet.core.errors import ConfigError, DataError, FitError
from residnet.core.files import read_json
from residnet.core.layout import ACCELERATIONS, HEADING, PLANAR, POSE, VELOCITIES
from residnet.core.stretches import stretches
from residnet.data.prepare import PrepareConfig, Prepared, prepare
from residnet.data.readers import ReaderConfig
from residnet.data.split import check_leaks, log_names, matches
from residnet.documents.cells import beside_published, listed, notes_text, pictures
from residnet.documents.jervan2020.residual import (
    ABOUT_COEFFICIENTS,
    AXES,
    MODEL_PICTURES,
    Fit,
    Record,
    ResidualModelConfig,
    SurfaceRegression,
    coefficients_section,
    fit_as_json,
    fit_model,
    forward_equations,
    model_figures,
)
from residnet.judge.metrics import Blocks, blocks, intervals
from residnet.physics.force_model import ForceModel
from residnet.physics.hull import HullConfig
from residnet.physics.plant import Hull, HullPlant
from residnet.physics.vessel import load_vessel
from residnet.report.blocks import Bullets, Cell, Section, Table, Text, table_of
from residnet.report.figure import (
    BLUE,
    DASHED,
    GREY,
    MASKED,
    SOLID,
    ZERO,
    Case,
    Figure,
    Look,
    Panel,
    names_of,
    whiskers,
    write_figure,
)
from residnet.report.format import fixed, interval, number, plural, signed
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, MainFigure, Outcome
from residnet.training.lag import fit_lag, followed

FILE = "force_residual.json"
Results = Mapping[str, Any]
_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
_Channels = tuple[str, str, str]
_NULLS = ("zero", "believed")
"""What needs no regression: no force at all, and the believed hull alone."""
_LOGS_FOR_FOLDS = 3
"""Number of logs from which on whole logs are left out instead of stretches of time."""
_LOGS_FOR_INTERVALS = 5
"""Number of logs from which on intervals resample logs instead of segments."""
_LEAST_SEGMENTS = 5
"""Least number of segments for intervals."""
_FORCE_UNITS = ("surge [N]", "sway [N]", "yaw [N m]")
_ACCELERATION_UNITS = ("surge [m/s²]", "sway [m/s²]", "yaw [rad/s²]")


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

    def columns(self) -> tuple[str, ...]:
        """Return all channels: commanded, actual and measured acceleration."""
        return (*self.commanded, *self.actual, *(self.acceleration or ()))


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


class MeasuredModelConfig(ResidualModelConfig):
    """One regression of the residual of measured forces.

    Attributes:
        force: force that the model explains: the actual or the commanded one.
        published: mean square of the residual on the document's own test half, without and with
            this model, in N^2, N^2, (N m)^2; from other trials, with the ferry as it was then.
    """

    force: Literal["actual", "commanded"] = "actual"
    published: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    @model_validator(mode="after")
    def _combination(self) -> MeasuredModelConfig:
        if self.lag and self.force != "commanded":
            raise ValueError(
                "lag: forces lag behind commands; set force to 'commanded', or leave lag out"
            )
        if isinstance(self.fit, SurfaceRegression) and self.fit.choose == "test":
            raise ValueError(
                "fit.choose: 'test' lets the samples that judge a model choose it; take simplest or"
                " least"
            )
        return self


@final
class ForceResidualConfig(ComputingTask):
    """Regressions of the residual force of a believed hull on measured logs, cross-validated.

    Attributes:
        task: `force_residual`.
        believed: vessel whose hull is the known part, by name or file.
        data: the measured logs.
        prepare: time grid, masks, and how velocities are smoothed and differentiated.
        channels: names of the channels of force and acceleration.
        acceleration: acceleration of the regressors: `velocity` for the derivative of the measured
            velocities, `measured` for the log's own acceleration less its mean difference from that
            derivative.
        validation: how the models are cross-validated.
        models: regressions by name.
    """

    task: Literal["force_residual"]
    believed: str
    data: ForceLogs
    prepare: PrepareConfig
    channels: ForceChannels
    acceleration: Literal["velocity", "measured"] = "velocity"
    validation: FoldsConfig = FoldsConfig()
    models: dict[_Name, MeasuredModelConfig] = Field(min_length=1)

    @model_validator(mode="after")
    def _combination(self) -> ForceResidualConfig:
        if taken := sorted({"zero", "believed"} & set(self.models)):
            raise ValueError(f"'{taken[0]}' cannot name a model: it stands beside all of them")
        if self.acceleration == "measured" and self.channels.acceleration is None:
            raise ValueError("acceleration: 'measured' needs channels.acceleration")
        if self.prepare.hold != "start":
            raise ValueError("prepare.hold: nothing runs forward here, leave it out")
        if (
            self.validation.gap < self.prepare.grid.step
            or self.validation.segment < 10 * self.prepare.grid.step
        ):
            raise ValueError(
                "validation: gap holds at least one step of the grid, segment at least ten"
            )
        try:
            self.hull()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def hull(self) -> Hull:
        """Return the known hull.

        Raises:
            ConfigError: where the vessel is no hull by matrices.
        """
        config = load_vessel(self.believed)
        vessel = config.build() if isinstance(config, HullConfig) else None
        if not isinstance(vessel, HullPlant):
            raise ConfigError(
                f"believed: '{self.believed}' is of kind '{config.kind}'; a believed hull needs one"
                " of kind fossen or mass_matrix"
            )
        return vessel.hull

    def check(self) -> None:
        measured = read_measured(self)
        for part in measured.part.unique().tolist():
            measured.split(part, self.validation.gap)

    def input_files(self) -> Sequence[Path]:
        return self.data.files()

    def carry_out(self, folder: RunFolder) -> Outcome:
        results = write_results(self, force_study(self), folder)
        figures: dict[str, MainFigure] = {}
        for force, rows in _groups(results).items():
            believed = next(row for row in rows if row["model"] == "believed")
            for row in (believed, min(rows, key=lambda row: sum(row["of_zero"]))):
                name = f"share of the {force} force left by {row['model']}"
                figures[name] = MainFigure(sum(row["of_zero"]) / 3)
        return Outcome(verdict(results), figures)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        config = load_config(run.resolved, [], cls)
        return sections(config, read_json(run.path / FILE), run.path)


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


def read_measured(config: ForceResidualConfig) -> Measured:
    """Read, mask, smooth and differentiate all logs.

    Raises:
        ResidnetError: where a log cannot be read or holds no usable samples.
    """
    import pandas as pd

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
    # commands hold their last value over gaps, and are zero before the first
    command = torch.cat(
        [
            torch.from_numpy(np.array(pd.DataFrame(part).ffill().fillna(0.0)))
            for part in (log.recorded[:, : PLANAR.dof] for log in logs)
        ]
    )
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
        {
            log.log.name: {
                reason: float(mask.mean()) for reason, mask in log.log.masks.items() if mask.any()
            }
            for log in logs
        },
        derived,
        sensed,
        acceleration,
    )


def _read(config: ForceResidualConfig) -> list[Prepared]:
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


def _calibrated(logs: Sequence[Prepared], derived: Tensor, sensed: Tensor) -> Tensor:
    """Return measured accelerations [N, 3] less their mean offset from `derived`, log by log."""
    out, start = sensed.clone(), 0
    for log in logs:
        inside, good = slice(start, start + len(log)), torch.from_numpy(log.good)
        out[inside] -= (sensed[inside] - derived[inside])[good].mean(0)
        start += len(log)
    return out


def _segments(logs: Sequence[Prepared], config: ForceResidualConfig) -> Tensor:
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


class Final(NamedTuple):
    """A model fitted to all good samples, to be read and not to be judged.

    Attributes:
        fit: coefficients.
        notes: what the estimator chose.
        not_forward: why it cannot run forward in time; empty where it can.
    """

    fit: Fit
    notes: dict[str, Any]
    not_forward: str


class Judged(NamedTuple):
    """Errors of one model on the folds that were left out of its fit.

    Attributes:
        error: remaining residual [N, 3] in N, N, N m; NaN where a sample is not used.
        notes: what the estimator chose in each fold.
    """

    error: Tensor
    notes: list[dict[str, Any]]


@dataclass(frozen=True)
class ForceStudy:
    """Everything that was found.

    Attributes:
        measured: the logs.
        judged: cross-validated errors by model.
        final: models fitted to all samples, by name.
        failed: models that the logs do not determine, with the reason.
        rows: rows of the tables; `zero` and `believed` are the first of each force.
        forces: comparison of commanded and actual force.
        blocks: what the intervals resample; None without intervals.
    """

    measured: Measured
    judged: dict[str, Judged]
    final: dict[str, Final]
    failed: dict[str, str]
    rows: list[dict[str, Any]]
    forces: dict[str, Any]
    blocks: Blocks | None


def force_study(config: ForceResidualConfig) -> ForceStudy:
    """Read the logs, and fit and judge every model.

    A model that the logs do not determine is set aside with the reason.

    Raises:
        ResidnetError: where a log cannot be used or no model is determined.
    """
    measured = read_measured(config)
    believed = ForceModel(config.hull())
    judged, final, failed = dict[str, Judged](), dict[str, Final](), dict[str, str]()
    for name, model_config in config.models.items():
        try:
            errors = cross_validate(model_config, measured, believed, config.validation.gap)
            model, _, fit, notes = fit_model(
                model_config,
                replace(measured.record, command=measured.force(model_config.force)),
                believed,
            )
        except FitError as error:
            failed[name] = f"model {name}: {error}"
            continue
        judged[name] = errors
        final[name] = Final(fit, notes, _why_not_forward(config, model, name))
    if not final:
        raise FitError(next(iter(failed.values())))
    return ForceStudy(
        measured,
        judged,
        final,
        failed,
        table(config, measured, judged, believed),
        compare_forces(measured),
        measured.blocks(),
    )


def _why_not_forward(config: ForceResidualConfig, model: ForceModel, name: str) -> str:
    try:
        forward_equations(config.believed, model, f"model {name}")
    except (ConfigError, FitError) as error:
        return str(error)
    return ""


def cross_validate(
    config: MeasuredModelConfig, measured: Measured, believed: ForceModel, gap: float
) -> Judged:
    """Fit a model for each fold on the samples outside and away from it, and predict the fold.

    Args:
        config: the model.
        measured: the logs with their folds.
        believed: the known hull.
        gap: time in s around a fold that is left out of the fit.

    Raises:
        FitError: where a fold's training samples do not determine the model.
    """
    target = measured.force(judging_force(config))
    error, notes = torch.full_like(target, torch.nan), []
    for part in range(int(measured.part.max()) + 1):
        record, test = measured.split(part, gap)
        model, _, _, chosen = fit_model(
            config, replace(record, command=measured.force(config.force)), believed
        )
        error[test] = model.residual(
            target[test], record.nu_dot[test], record.nu[test], record.pose[test, 2]
        )
        notes.append(chosen)
    return Judged(error, notes)


def judging_force(config: MeasuredModelConfig) -> str:
    """Return the force that a model is judged on, `actual` or `commanded`.

    A lag alone could make the residual of a command small: a model with lag is judged on the actual
    force.
    """
    return "actual" if config.lag else config.force


def unmodelled(measured: Measured, believed: ForceModel, force: str) -> Tensor:
    """Return the residual [N, 3] of the believed model for the `actual` or `commanded` force."""
    record = measured.record
    return believed.residual(
        measured.force(force), record.nu_dot, record.nu, record.pose[:, HEADING]
    )


def table(
    config: ForceResidualConfig,
    measured: Measured,
    judged: Mapping[str, Judged],
    believed: ForceModel,
) -> list[dict[str, Any]]:
    """Return the rows of all models, grouped by the force that judges them.

    Every group begins with `zero` (no force at all) and `believed` on the same samples. `reference`
    is the better of the two on each axis: a believed model may be worse than no force, and what is
    better than it is then no gain yet.
    """
    groups: dict[str, list[str]] = {}
    for name in judged:
        groups.setdefault(judging_force(config.models[name]), []).append(name)
    segments, parts = measured.segments(), measured.blocks()

    def by_segment(error: Tensor) -> np.ndarray:
        return np.stack([error[segment].square().mean(0).numpy() for segment in segments])

    rows: list[dict[str, Any]] = []
    for force, names in groups.items():
        errors = {
            "zero": by_segment(measured.force(force)),
            "believed": by_segment(unmodelled(measured, believed, force)),
        }
        choice = [min(_NULLS, key=lambda name: float(errors[name][:, a].mean())) for a in range(3)]
        reference = np.stack([errors[name][:, a] for a, name in enumerate(choice)], axis=1)
        errors |= {name: by_segment(judged[name].error) for name in names}
        level = np.maximum(errors["zero"].mean(0), 1e-300)
        for name, error in errors.items():
            rows.append(
                {
                    "force": force,
                    "model": name,
                    "mse": error.mean(0).tolist(),
                    "of_zero": (error.mean(0) / level).tolist(),
                    "segments": len(segments),
                    "reference": choice,
                    **{
                        f"minus_{other}": _difference((error - errors[other]) / level, parts)
                        for other in _NULLS
                        if other != name
                    },
                    "minus_reference": _difference((error - reference) / level, parts),
                }
            )
    return rows


def _difference(difference: np.ndarray, parts: Blocks | None) -> dict[str, Any]:
    """Return mean and 95 % intervals of differences [W, 3], by axis and for their mean."""
    columns = np.concatenate((difference, difference.mean(1, keepdims=True)), axis=1)
    return {
        "mean": columns.mean(0).tolist(),
        "ci95": intervals(columns, parts),
        "segments_below": (columns < 0).mean(0).tolist(),
    }


def better(row: Mapping[str, Any], than: str) -> list[bool]:
    """Return whether a model's error lies below another's with 95 % confidence.

    Args:
        row: row of the model.
        than: `zero`, `believed`, or `reference`, the better of the two on each axis.

    Returns:
        One flag each for surge, sway, yaw and the mean over the axes.
    """
    return [interval is not None and interval[1] < 0 for interval in row[f"minus_{than}"]["ci95"]]


def write_results(
    config: ForceResidualConfig, found: ForceStudy, folder: RunFolder
) -> dict[str, Any]:
    """Write force_residual.json and all figures; returns the contents of the JSON file."""
    results = _content(config, found)
    folder.write_json(folder.path / FILE, results)
    figures, start = [_scores(found.rows)], 0
    for name, length in zip(found.measured.names, found.measured.record.runs, strict=True):
        figures += _log_figures(config, found, name, slice(start, start + length))
        start += length
    believed = {row["force"]: row["mse"] for row in found.rows if row["model"] == "believed"}
    for name, model in found.final.items():
        base = believed[judging_force(config.models[name])]
        figures += model_figures(name, config.models[name], model.fit, base)
    for figure in figures:
        write_figure(folder.figures, figure)
    return results


def _content(config: ForceResidualConfig, found: ForceStudy) -> dict[str, Any]:
    measured = found.measured
    return {
        "schema": "residnet.force_residual/1",
        "run": config.name,
        "logs": [
            {"name": name, "samples": count, "seconds": count * measured.record.dt}
            for name, count in zip(measured.names, measured.record.runs, strict=True)
        ],
        "samples": len(measured.good),
        "used": int(measured.good.sum()),
        "masked": measured.masked,
        "folds": {"of": measured.parts, "count": int(measured.part.max()) + 1},
        "intervals": None if found.blocks is None else found.blocks.row(),
        "forces": found.forces,
        "acceleration": measured.acceleration,
        "rows": found.rows,
        "failed": found.failed,
        "models": {
            name: {
                "folds": found.judged[name].notes,
                "all": model.notes,
                "runs_forward": not model.not_forward,
                "not_forward": model.not_forward,
                **fit_as_json(config.models[name].terms, model.fit),
            }
            for name, model in found.final.items()
        },
    }


def _log_figures(
    config: ForceResidualConfig, found: ForceStudy, name: str, inside: slice
) -> list[Figure]:
    measured = found.measured
    t = (measured.record.t[inside] - measured.record.t[inside.start]).numpy()
    starts, stops = stretches(~measured.good[inside].numpy())
    masked = (t[starts], t[stops - 1])

    def pair(
        kind: str,
        title: str,
        labels: Sequence[str],
        signals: Sequence[Tensor],
        units: Sequence[str],
    ) -> Figure:
        looks = {
            label: replace(look, label=label, width=1.1)
            for label, look in zip(labels, (DASHED, SOLID), strict=True)
        }
        paths = [signal[inside].numpy() for signal in signals]
        return Figure(
            f"{kind}_{name}",
            f"{title}, log {name}",
            f"{title}, log {name}; {labels[0]} (dashed) and {labels[1]} (solid).",
            {"masked": MASKED, **looks},
            [Panel(unit, "time [s]", height=165, group="t") for unit in units],
            [
                Case(
                    "",
                    [
                        {"masked": masked}
                        | {
                            label: (t, path[:, axis])
                            for label, path in zip(labels, paths, strict=True)
                        }
                        for axis in range(3)
                    ],
                )
            ],
        )

    forces = (measured.record.command, measured.actual)
    title = "Commanded and actual force"
    out = [pair("forces", title, ("commanded", "actual"), forces, _FORCE_UNITS)]
    if measured.sensed is not None:
        title = "Measured acceleration and derivative of velocity"
        labels = ("measured acceleration", "derivative of velocity")
        both = (measured.sensed, measured.derived)
        out.append(pair("accelerations", title, labels, both, _ACCELERATION_UNITS))
    # of the models of the actual force, the one with the least cross-validated error
    of_actual = {
        row["model"]: row["minus_believed"]["mean"][3]
        for row in found.rows
        if row["force"] == "actual" and row["model"] in found.judged
    }
    if of_actual:
        best = min(of_actual, key=lambda model: of_actual[model])
        residual = unmodelled(measured, ForceModel(config.hull()), "actual")
        title = f"Residual of the believed model and what {best} predicts on left-out folds"
        labels = ("residual of the believed model", f"predicted by {best}")
        both = (residual, residual - found.judged[best].error)
        out.append(pair("residual", title, labels, both, _FORCE_UNITS))
    return out


def _scores(rows: Sequence[Results]) -> Figure:
    """Return every model's error less that of the believed model, with intervals.

    There is a panel for each force; errors are in % of its mean square.
    """
    looks = {
        "zero": replace(ZERO, kind="upright"),
        "better interval": Look("", BLUE),
        "better": Look("better than the believed model", BLUE, kind="points", size=4.5),
        "other interval": Look("", GREY),
        "other": Look("no better", GREY, kind="points", marker="s", size=4.5),
    }
    panels, shown = [], []
    for force in dict.fromkeys(row["force"] for row in rows):
        members = [row for row in rows if row["force"] == force and row["model"] != "believed"][
            ::-1
        ]
        points: dict[str, list[tuple[float, ...]]] = {"better": [], "other": []}
        for place, row in enumerate(members):
            mean, within = row["minus_believed"]["mean"][3], row["minus_believed"]["ci95"][3]
            ends = (np.nan, np.nan) if within is None else within
            kind = "better" if within is not None and within[1] < 0 else "other"
            points[kind].append((place, 100 * mean, 100 * ends[0], 100 * ends[1]))
        curves = {"zero": (np.zeros(1), np.zeros(1))}
        for kind, found in points.items():
            if found:
                at, mean, low, high = np.array(found).T
                curves[kind] = (mean, at)
                curves[f"{kind} interval"] = whiskers(at, low, high)[::-1]
        shown.append(curves)
        panels.append(
            Panel(
                "",
                "squared error less the believed model's, mean over axes [% of the mean square]",
                f"{force} force",
                height=50 + 31 * len(members),
                y_names=names_of(row["model"] for row in members),
            )
        )
    return Figure(
        "scores",
        "Errors beside the believed model",
        "Squared error of each model less that of the believed model where neither saw the"
        " data, with 95 % intervals.",
        looks,
        panels,
        [Case("", shown)],
    )


def verdict(results: Results) -> list[str]:
    """Return the sentences that say for each force whether a regression gained anything."""
    sentences: list[str] = []
    for force, rows in _groups(results).items():
        fits = [row for row in rows if row["model"] not in _NULLS]
        if results["intervals"] is None:
            sentences.append(
                f"{force.capitalize()} force: there are too few segments to say whether one model"
                " is better than another."
            )
            continue
        believed = next(row for row in rows if row["model"] == "believed")
        sentences.append(
            f"{force.capitalize()} force: the believed model is better than no force"
            f" {_where(better(believed, 'zero'))}{_worse_than_nothing(believed)}."
        )
        sentences += [*_gains(fits), _advice(fits)]
    return sentences + _lags(results)


def _worse_than_nothing(believed: Results) -> str:
    bounds = believed["minus_zero"]["ci95"][:3]
    names = [axis for axis, limits in zip(AXES, bounds, strict=True) if limits[0] > 0]
    return f", and worse than no force in {listed(names)}" if names else ""


def _gains(fits: Sequence[Results]) -> list[str]:
    best = "the better of no force and the believed model on each axis"
    winners = [row for row in fits if better(row, "reference")[3]]
    if not winners:
        sentences = [
            f"None of the {len(fits)} regressions is better than {best}: every interval of the mean"
            " over the axes reaches zero."
        ]
    else:
        gain = -100 * min(row["minus_reference"]["mean"][3] for row in winners)
        sentences = [
            f"Of {len(fits)} regressions, these are better than {best} in the mean over the axes:"
            f" {listed([row['model'] for row in winners])}. The largest gain is {fixed(gain, 1)} %"
            " of the force's mean square."
        ]
    single = [
        f"{row['model']} ({_where(flags)})"
        for row in fits
        if any(flags := better(row, "reference")[:3])
    ]
    if single:
        sentences.append(
            f"Better on single axes: {listed(single)}; of {3 * len(fits)} such comparisons, one in"
            " forty comes out so by chance."
        )
    worse = [row["model"] for row in fits if row["minus_reference"]["ci95"][3][0] > 0]
    if worse:
        sentences.append(f"Worse than that: {listed(worse)}.")
    return sentences


def _advice(fits: Sequence[Results]) -> str:
    """Return the sentence that says what to use on each axis.

    A regression is named where it is reliably better on that axis; of several, the one with the
    least error. Otherwise it is the better of no force and the believed model.
    """
    names = {"zero": "no force at all", "believed": "the believed model alone"}
    chosen: dict[str, list[str]] = {}
    for axis, name in enumerate(AXES):
        sure = [row for row in fits if better(row, "reference")[axis]]
        best = min(sure, key=lambda row: float(row["mse"][axis]), default=None)
        use = names[fits[0]["reference"][axis]] if best is None else str(best["model"])
        chosen.setdefault(use, []).append(name)
    parts = [f"{use} in {listed(axes)}" for use, axes in chosen.items()]
    return f"Recommended: {', '.join(parts)}."


def _where(flags: Sequence[bool]) -> str:
    names = [name for name, yes in zip((*AXES, "the mean over axes"), flags, strict=False) if yes]
    return f"in {listed(names)}" if names else "on no axis"


def _lags(results: Results) -> list[str]:
    thrusters = results["forces"]["lag"]
    fitted = {
        name: model["all"]["lag"]
        for name, model in results["models"].items()
        if "lag" in model["all"]
    }
    if isinstance(thrusters, str) or not fitted:
        return []
    each = [
        f"{number(lag['frequency'])} rad/s and {number(lag['delay'], 2)} s for {name}"
        for name, lag in fitted.items()
    ]
    return [
        f"The lag fitted together with the residual is {listed(each)}; the actual forces follow the"
        f" commands with {number(thrusters['frequency'])} rad/s and"
        f" {number(thrusters['delay'], 2)} s."
    ]


def _groups(results: Results) -> dict[str, list[Results]]:
    out: dict[str, list[Results]] = {}
    for row in results["rows"]:
        out.setdefault(row["force"], []).append(row)
    return out


def sections(config: ForceResidualConfig, results: Results, run: Path) -> list[Section]:
    """Return the sections of the report."""
    out = [_data(config, results), _forces(results, run)]
    if results["acceleration"]:
        out.append(_accelerations(config, results, run))
    for force, rows in _groups(results).items():
        out.append(Section(f"Residual of the {force} force", [_models(config, results, rows)]))
    out.append(Section("Errors and residuals", pictures(run, "scores", "residual_")))
    if results["failed"]:
        causes = list(results["failed"].values())
        out.append(Section("Not determined by these logs", [Bullets(causes)]))
    causes = [model["not_forward"] for model in results["models"].values() if model["not_forward"]]
    if causes:
        out.append(Section("Models that cannot run forward in time", [Bullets(causes)]))
    coefficients = [
        coefficients_section(name, model, model["all"], {})
        for name, model in results["models"].items()
    ]
    out.append(
        Section(
            "Coefficients of models fitted to all samples",
            [Text(ABOUT_COEFFICIENTS), *coefficients],
        )
    )
    return [*out, Section("Orders, weights and surfaces", pictures(run, *MODEL_PICTURES), True)]


def _data(config: ForceResidualConfig, results: Results) -> Section:
    lengths = [f"{log['name']} ({log['seconds']:.0f} s)" for log in results["logs"]]
    masks = [
        f"{100 * share:.1f} % of {log} by {reason}"
        for log, reasons in results["masked"].items()
        for reason, share in reasons.items()
    ]
    folds, validation, blocks = results["folds"], config.validation, results["intervals"]
    each = (
        "each consists of whole logs"
        if folds["of"] == "logs"
        else "each is a stretch of time of every log"
    )
    paragraphs = [
        f"Logs: {', '.join(lengths)}. Masked: {', '.join(masks) or 'nothing'}; {results['used']} of"
        f" {results['samples']} samples are used.",
        f"There are {folds['count']} folds; {each}. No model is fitted to data within"
        f" {validation.gap:g} s of what it predicts. Orders and penalties are chosen inside the"
        f" training part, on left-out segments of {validation.segment:g} s. Errors are means over"
        " segments.",
        "There are no intervals, because there are fewer than five segments."
        if blocks is None
        else f"Intervals (95 %) come from resampling {plural(blocks['count'], blocks['of'][:-1])}."
        + (
            ""
            if blocks["of"] == "logs"
            else " With so few logs they speak for these logs and not for another day."
        ),
        "The model zero predicts no force at all; believed predicts the force of the believed hull,"
        " which is a residual of zero.",
    ]
    return Section("Data and cross-validation", [Text(paragraphs)])


def _forces(results: Results, run: Path) -> Section:
    lag = results["forces"]["lag"]
    text = (
        f"The thrusters' lag is not determined: {lag}."
        if isinstance(lag, str)
        else f"The actual force follows the command with a lag of {number(lag['frequency'])} rad/s,"
        f" a damping ratio of {number(lag['damping'])} and a delay of {number(lag['delay'])} s."
    )
    table = table_of(
        [{"axis": axis, **results["forces"][axis]} for axis in AXES],
        [
            ("axis", "axis"),
            ("rms commanded", "rms_commanded", lambda value: number(value, 4)),
            ("rms actual", "rms_actual", lambda value: number(value, 4)),
            ("explained by the command %", "explained", 1, 100),
            ("explained through the lag %", "explained_with_lag", 1, 100),
            ("gain through the lag", "gain_with_lag", 3),
        ],
        caption="Forces in N, N and N m; a share is of the variance of the actual force.",
    )
    return Section("Commanded and actual force", [Text(text), table, *pictures(run, "forces_")])


def _accelerations(config: ForceResidualConfig, results: Results, run: Path) -> Section:
    used = (
        "the derivative of the velocity"
        if config.acceleration == "velocity"
        else "the measured acceleration less its offset"
    )
    table = table_of(
        [{"axis": axis, **results["acceleration"][axis]} for axis in AXES],
        [
            ("axis", "axis"),
            ("offset", "offset", lambda value: number(value, 2)),
            ("95 % interval", "offset_ci95", lambda value: interval(value, digits=2)),
            ("rms difference", "rms_without_offset", number),
            ("rms of the derivative", "rms", number),
            ("correlation", "correlation", 4),
        ],
        caption=f"In m/s^2, m/s^2 and rad/s^2; the models use {used}.",
    )
    title = "Measured accelerations and derivatives of velocity"
    return Section(title, [table, *pictures(run, "accelerations_")])


def _models(config: ForceResidualConfig, results: Results, rows: Sequence[Results]) -> Table:
    """Return the table of the models that are judged on one force (Tables 5.1, 5.2, 5.4, 5.5)."""
    table = Table(
        [
            "model",
            *("surge N^2", "sway N^2", "yaw (N m)^2"),
            *("surge", "sway", "yaw") * 2,
            *("mean", "95 % interval", "segments better %") * 2,
            "chosen by the estimator",
        ],
        caption="Published: the share that the document's model of that kind left of its believed"
        " model's residual, in other trials.",
        groups=[
            ("mean square error", 3),
            ("% of zero", 3),
            ("% of the believed model's", 3),
            ("mean over axes less believed, % of zero", 3),
            ("the same less the better of zero and believed on each axis", 3),
            ("", 1),
        ],
    )
    base = next(row for row in rows if row["model"] == "believed")["mse"]
    for row in rows:
        model_config = config.models.get(row["model"])
        published = None if model_config is None else model_config.published
        cells = [Cell(number(value, 4)) for value in row["mse"]]
        cells += [Cell(fixed(100 * value, 0)) for value in row["of_zero"]]
        for axis in range(3):
            left = 100 * published[1][axis] / published[0][axis] if published else None
            cells.append(beside_published(100 * row["mse"][axis] / base[axis], left, 3))
        difference = row.get("minus_believed")
        cells += [Cell("")] * 3 if difference is None else _difference_cells(difference)
        cells += _difference_cells(row["minus_reference"])
        notes = "" if model_config is None else notes_text(results["models"][row["model"]]["all"])
        table.add(row["model"], [*cells, Cell(notes, mark="text")])
    return table


def _difference_cells(difference: Results) -> list[Cell]:
    bounds = difference["ci95"][3]
    shown = "" if bounds is None else " to ".join(signed(100 * bound, 1) for bound in bounds)
    return [
        Cell(signed(100 * difference["mean"][3], 1)),
        Cell(shown),
        Cell(fixed(100 * difference["segments_below"][3], 0)),
    ]

"""Task `force_residual`: residual models of measured forces (document 002, chapter 5).

Every model is cross-validated and judged beside two others: no force at all, and the believed hull
alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, ConfigPath, Seconds
from residnet.core.errors import ConfigError, DataError, FitError
from residnet.core.format import fixed, interval, number, plural, signed
from residnet.core.layout import ACCELERATIONS, HEADING, PLANAR, POSE, VELOCITIES
from residnet.core.stretches import stretches
from residnet.data.prepare import PrepareConfig, prepare
from residnet.data.readers import ReaderConfig
from residnet.data.split import check_leaks, log_names, matches
from residnet.documents.jervan2020.residual import (
    AXES,
    Fit,
    Record,
    ResidualModelConfig,
    SurfaceRegression,
    fit_as_json,
    fit_model,
    forward_equations,
    model_figures,
    model_sections,
)
from residnet.documents.study import (
    Results,
    Study,
    compared,
    histories,
    listed,
    notes_text,
    pictures,
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
)
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, MainFigure, PartName
from residnet.training.lag import fit_lag, followed

_Channels = tuple[str, str, str]
_NULLS = {"zero": "no force at all", "believed": "the believed model alone"}
"""What needs no regression."""
_LOGS_FOR_FOLDS = 3
"""Number of logs from which on whole logs are left out instead of stretches of time."""
_LOGS_FOR_INTERVALS = 5
"""Number of logs from which on intervals resample logs instead of segments."""
_LEAST_SEGMENTS = 5
"""Least number of segments for intervals."""
_FORCE_UNITS = tuple((label, 1.0) for label in ("surge [N]", "sway [N]", "yaw [N m]"))
_ACCELERATION_UNITS = tuple(
    (label, 1.0) for label in ("surge [m/s²]", "sway [m/s²]", "yaw [rad/s²]")
)


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


class MeasuredModelConfig(ResidualModelConfig):
    """One regression of the residual of measured forces.

    Attributes:
        lag: as there, but never searched: an actual force has none.
        force: force that the model explains: the actual or the commanded one.
        published: mean square of the residual on the document's own test half, without and with
            this model, in N^2, N^2, (N m)^2; from other trials, with the ferry as it was then.
    """

    lag: bool = False
    force: Literal["actual", "commanded"] = "actual"
    published: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    @property
    def judged_on(self) -> Literal["actual", "commanded"]:
        """The force that judges the model.

        A lag alone could make the residual of a command small: a model with lag is judged on the
        actual force.
        """
        return "actual" if self.lag else self.force

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
class ForceResidualConfig(Study, ComputingTask):
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

    results_file: ClassVar[str] = "force_residual.json"

    task: Literal["force_residual"]
    believed: str
    data: ForceLogs
    prepare: PrepareConfig
    channels: ForceChannels
    acceleration: Literal["velocity", "measured"] = "velocity"
    validation: FoldsConfig = FoldsConfig()
    models: dict[PartName, MeasuredModelConfig] = Field(min_length=1)

    @model_validator(mode="after")
    def _combination(self) -> ForceResidualConfig:
        if taken := sorted(set(_NULLS) & set(self.models)):
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

    def results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        return written(self, force_study(self))

    def main_figures(self, results: Results) -> dict[str, MainFigure]:
        figures: dict[str, MainFigure] = {}
        for force, rows in _groups(results).items():
            best = min(rows.values(), key=lambda row: sum(row["of_zero"]))
            for row in (rows["believed"], best):
                name = f"share of the {force} force left by {row['model']}"
                figures[name] = MainFigure(sum(row["of_zero"]) / 3)
        return figures

    def verdict(self, results: Results) -> list[str]:
        """Return the sentences that say for each force whether a regression gained anything."""
        sentences: list[str] = []
        for force, rows in _groups(results).items():
            if results["intervals"] is None:
                sentences.append(
                    f"{force.capitalize()} force: there are too few segments to say whether one"
                    " model is better than another."
                )
                continue
            believed = rows["believed"]
            bounds = believed["minus_zero"]["ci95"][:3]
            worse = [axis for axis, limits in zip(AXES, bounds, strict=True) if limits[0] > 0]
            sentences.append(
                f"{force.capitalize()} force: the believed model is better than no force"
                f" {_where(better(believed, 'zero'))}"
                + (f", and worse than no force in {listed(worse)}." if worse else ".")
            )
            sentences += _gains([row for name, row in rows.items() if name not in _NULLS])
        thrusters = results["forces"]["lag"]
        lags = {name: model["all"].get("lag") for name, model in results["models"].items()}
        each = [
            f"{number(lag['frequency'])} rad/s and {number(lag['delay'], 2)} s for {name}"
            for name, lag in lags.items()
            if lag
        ]
        if each and not isinstance(thrusters, str):
            sentences.append(
                f"The lag fitted together with the residual is {listed(each)}; the actual forces"
                f" follow the commands with {number(thrusters['frequency'])} rad/s and"
                f" {number(thrusters['delay'], 2)} s."
            )
        return sentences

    def sections(self, results: Results, run: Path) -> list[Section]:
        drawn = [one.part() for one in pictures(run, "scores")]
        first = next(iter(_groups(results).values()))
        out = [
            Section("", [*drawn, _models(self, results, first).part(3, 6)]),
            _data(self, results),
            _forces(results, run),
        ]
        if results["acceleration"]:
            out.append(_accelerations(self, results, run))
        for force, rows in _groups(results).items():
            out.append(Section(f"Residual of the {force} force", [_models(self, results, rows)]))
        out.append(Section("Errors and residuals", pictures(run, "scores", "residual_")))
        if results["failed"]:
            causes = list(results["failed"].values())
            out.append(Section("Not determined by these logs", [Bullets(causes)]))
        title = "Coefficients of models fitted to all samples"
        return out + model_sections(title, results["models"], run, "all", {})


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
            part: number of the fold.
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


def read_measured(config: ForceResidualConfig) -> Measured:
    """Read, mask, smooth and differentiate all logs.

    Raises:
        ResidnetError: where a log cannot be read or holds no usable samples.
    """
    import pandas as pd

    reader, channels = config.data.reader.build(), config.channels
    paths = log_names(config.data.files())
    recorded = [reader.read(path).replace(name=name) for path, name in paths.items()]
    # a model would be fitted to the very samples that judge it
    check_leaks({log.name: [log] for log in recorded})
    columns = (*channels.commanded, *channels.actual, *(channels.acceleration or ()))
    logs = [prepare(log, "all", columns, config.prepare) for log in recorded]
    names, lengths = [log.log.name for log in logs], [len(log) for log in logs]
    step, validation = config.prepare.grid.step, config.validation
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
        derived, sensed = nu_dot, measured[:, ACCELERATIONS]
        accelerations = {"measured acceleration": sensed, "derivative of velocity": derived}
        acceleration = compare_accelerations(derived[good], sensed[good], fold[good])
        if config.acceleration == "measured":
            # less their mean offset, log by log
            by_log = zip(*(part.split(lengths) for part in (sensed, derived, good)), strict=True)
            nu_dot = torch.cat([s - (s - d)[kept].mean(0) for s, d, kept in by_log])
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
        ).lag
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


class Model(NamedTuple):
    """A model that the logs determine.

    Attributes:
        error: residual [N, 3] in N, N, N m that remains on folds that were left out of the fit; NaN
            where a sample is not used.
        folds: what the estimator chose in each fold.
        fit: coefficients fitted to all good samples, to be read and not to be judged.
        not_forward: why it cannot run forward in time; empty where it can.
    """

    error: Tensor
    folds: list[dict[str, Any]]
    fit: Fit
    not_forward: str


@dataclass(frozen=True)
class Found:
    """Everything that was found.

    Attributes:
        measured: the logs.
        models: models by name.
        failed: models that the logs do not determine, with the reason.
        rows: rows of the tables; `zero` and `believed` are the first of each force.
        forces: comparison of commanded and actual force.
        unmodelled: residual [N, 3] of the believed model, by force.
    """

    measured: Measured
    models: dict[str, Model]
    failed: dict[str, str]
    rows: list[dict[str, Any]]
    forces: dict[str, Any]
    unmodelled: dict[str, Tensor]


def force_study(config: ForceResidualConfig) -> Found:
    """Read the logs, and fit and judge every model.

    A model that the logs do not determine is set aside with the reason.

    Raises:
        ResidnetError: where a log cannot be used or no model is determined.
    """
    measured, believed = read_measured(config), ForceModel(config.hull())
    models, failed = dict[str, Model](), dict[str, str]()
    for name, of_model in config.models.items():
        try:
            models[name] = _judged(config, name, of_model, measured, believed)
        except FitError as error:
            failed[name] = f"model {name}: {error}"
    if not models:
        raise FitError(next(iter(failed.values())))
    record = measured.record
    motion = record.nu_dot, record.nu, record.pose[:, HEADING]
    unmodelled = {
        which: believed.residual(force, *motion) for which, force in measured.forces.items()
    }
    rows = _rows(config, measured, models, unmodelled)
    return Found(measured, models, failed, rows, compare_forces(measured), unmodelled)


def _judged(
    config: ForceResidualConfig,
    name: str,
    of_model: MeasuredModelConfig,
    measured: Measured,
    believed: ForceModel,
) -> Model:
    """Fit a model for each fold on the samples outside and away from it, and to all of them.

    Raises:
        FitError: where the training samples do not determine the model.
    """
    target, command = measured.forces[of_model.judged_on], measured.forces[of_model.force]
    error, folds = torch.full_like(target, torch.nan), []
    for part in range(int(measured.part.max()) + 1):
        record, test = measured.split(part, config.validation.gap)
        model = fit_model(of_model, replace(record, command=command), believed)
        motion = record.nu_dot[test], record.nu[test], record.pose[test, HEADING]
        error[test] = model.force.residual(target[test], *motion)
        folds.append(model.fit.notes)
    model = fit_model(of_model, replace(measured.record, command=command), believed)
    not_forward = ""
    try:
        forward_equations(config.believed, model.force, f"model {name}")
    except (ConfigError, FitError) as refusal:
        not_forward = str(refusal)
    return Model(error, folds, model.fit, not_forward)


def _rows(
    config: ForceResidualConfig,
    measured: Measured,
    models: Mapping[str, Model],
    unmodelled: Mapping[str, Tensor],
) -> list[dict[str, Any]]:
    """Return the rows of all models, grouped by the force that judges them.

    Every group begins with `zero` (no force at all) and `believed` on the same samples. `reference`
    is the better of the two on each axis: a believed model may be worse than no force, and what is
    better than it is then no gain yet.
    """
    groups: dict[str, list[str]] = {}
    for name in models:
        groups.setdefault(config.models[name].judged_on, []).append(name)
    segments, parts = measured.segments(), measured.blocks()
    rows: list[dict[str, Any]] = []
    for force, names in groups.items():
        left = {"zero": measured.forces[force], "believed": unmodelled[force]}
        left |= {name: models[name].error for name in names}
        errors = {
            name: np.stack([error[segment].square().mean(0).numpy() for segment in segments])
            for name, error in left.items()
        }
        choice = [min(_NULLS, key=lambda name: float(errors[name][:, a].mean())) for a in range(3)]
        others = {name: errors[name] for name in _NULLS}
        others["reference"] = np.stack(
            [errors[name][:, a] for a, name in enumerate(choice)], axis=1
        )
        level = np.maximum(errors["zero"].mean(0), 1e-300)
        for name, error in errors.items():
            row = {
                "force": force,
                "model": name,
                "mse": error.mean(0).tolist(),
                "of_zero": (error.mean(0) / level).tolist(),
                "segments": len(segments),
                "reference": choice,
            }
            for other, theirs in others.items():
                if other != name:
                    # by axis, and for their mean
                    apart = (error - theirs) / level
                    columns = np.concatenate((apart, apart.mean(1, keepdims=True)), axis=1)
                    row[f"minus_{other}"] = {
                        "mean": columns.mean(0).tolist(),
                        "ci95": intervals(columns, parts),
                        "segments_below": (columns < 0).mean(0).tolist(),
                    }
            rows.append(row)
    return rows


def better(row: Mapping[str, Any], than: str) -> list[bool]:
    """Return whether a model's error lies below another's with 95 % confidence.

    Args:
        row: row of the model.
        than: `zero`, `believed`, or `reference`, the better of the two on each axis.

    Returns:
        One flag each for surge, sway, yaw and the mean over the axes.
    """
    return [interval is not None and interval[1] < 0 for interval in row[f"minus_{than}"]["ci95"]]


def written(config: ForceResidualConfig, found: Found) -> tuple[dict[str, Any], list[Figure]]:
    """Return the contents of force_residual.json and all figures."""
    measured, record, parts = found.measured, found.measured.record, found.measured.blocks()
    content = {
        "schema": "residnet.force_residual/1",
        "run": config.name,
        "logs": [
            {"name": name, "samples": count, "seconds": count * record.dt}
            for name, count in zip(measured.names, record.runs, strict=True)
        ],
        "samples": len(measured.good),
        "used": int(measured.good.sum()),
        "masked": measured.masked,
        "folds": {"of": measured.parts, "count": int(measured.part.max()) + 1},
        "intervals": None if parts is None else parts.row(),
        "forces": found.forces,
        "acceleration": measured.acceleration,
        "rows": found.rows,
        "failed": found.failed,
        "models": {
            name: {
                "folds": model.folds,
                "all": model.fit.notes,
                "runs_forward": not model.not_forward,
                "not_forward": model.not_forward,
                **fit_as_json(config.models[name].terms, model.fit),
            }
            for name, model in found.models.items()
        },
    }
    figures, start = [_scores(found.rows)], 0
    for name, length in zip(measured.names, record.runs, strict=True):
        figures += _log_figures(found, name, slice(start, start + length))
        start += length
    believed = {row["force"]: row["mse"] for row in found.rows if row["model"] == "believed"}
    for name, model in found.models.items():
        of_model = config.models[name]
        figures += model_figures(name, of_model, model.fit, believed[of_model.judged_on])
    return content, figures


def _log_figures(found: Found, name: str, inside: slice) -> list[Figure]:
    measured = found.measured
    t = (measured.record.t[inside] - measured.record.t[inside.start]).numpy()
    starts, stops = stretches(~measured.good[inside].numpy())
    masked = (t[starts], t[stops - 1])

    def pair(
        kind: str, title: str, signals: Mapping[str, Tensor], units: Sequence[tuple[str, float]]
    ) -> Figure:
        first, second = signals
        looks = {"masked": MASKED, first: DASHED, second: SOLID}
        for label in signals:
            looks[label] = replace(looks[label], label=label, width=1.1)
        title = f"{title}, log {name}"
        caption = f"{title}; {first} (dashed) and {second} (solid)."
        paths = {label: signal[inside].numpy() for label, signal in signals.items()}
        shared = {"masked": masked}
        return histories(f"{kind}_{name}", (title, caption), looks, t, paths, units, shared=shared)

    out = [pair("forces", "Commanded and actual force", measured.forces, _FORCE_UNITS)]
    if measured.accelerations:
        title = "Measured acceleration and derivative of velocity"
        out.append(pair("accelerations", title, measured.accelerations, _ACCELERATION_UNITS))
    # of the models of the actual force, the one with the least cross-validated error
    of_actual = {
        row["model"]: row["minus_believed"]["mean"][3]
        for row in found.rows
        if row["force"] == "actual" and row["model"] in found.models
    }
    if of_actual:
        best, residual = min(of_actual, key=of_actual.__getitem__), found.unmodelled["actual"]
        title = f"Residual of the believed model and what {best} predicts on left-out folds"
        both = {"residual of the believed model": residual}
        both[f"predicted by {best}"] = residual - found.models[best].error
        out.append(pair("residual", title, both, _FORCE_UNITS))
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


def _where(flags: Sequence[bool]) -> str:
    names = [name for name, yes in zip((*AXES, "the mean over axes"), flags, strict=False) if yes]
    return f"in {listed(names)}" if names else "on no axis"


def _gains(fits: Sequence[Results]) -> list[str]:
    """Return what the regressions of one force gain, and what to use on each axis.

    A regression is recommended where it is reliably better on that axis; of several, the one with
    the least error. Otherwise it is the better of no force and the believed model.
    """
    best = "the better of no force and the believed model on each axis"
    sure = {row["model"]: better(row, "reference") for row in fits}
    winners = [row for row in fits if sure[row["model"]][3]]
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
    single = [f"{name} ({_where(flags[:3])})" for name, flags in sure.items() if any(flags[:3])]
    if single:
        sentences.append(
            f"Better on single axes: {listed(single)}; of {3 * len(fits)} such comparisons, one in"
            " forty comes out so by chance."
        )
    worse = [row["model"] for row in fits if row["minus_reference"]["ci95"][3][0] > 0]
    if worse:
        sentences.append(f"Worse than that: {listed(worse)}.")
    chosen: dict[str, list[str]] = {}
    for axis, name in enumerate(AXES):
        able = [row for row in fits if sure[row["model"]][axis]]
        use = _NULLS[fits[0]["reference"][axis]]
        if able:
            use = min(able, key=lambda row: float(row["mse"][axis]))["model"]
        chosen.setdefault(use, []).append(name)
    parts = [f"{use} in {listed(axes)}" for use, axes in chosen.items()]
    return [*sentences, f"Recommended: {', '.join(parts)}."]


def _groups(results: Results) -> dict[str, dict[str, Results]]:
    """Return the rows by force and model."""
    out: dict[str, dict[str, Results]] = {}
    for row in results["rows"]:
        out.setdefault(row["force"], {})[row["model"]] = row
    return out


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


def _models(config: ForceResidualConfig, results: Results, group: Mapping[str, Results]) -> Table:
    """Return the table of the models that are judged on one force (Tables 5.1, 5.2, 5.4, 5.5)."""
    base, rows = group["believed"]["mse"], []
    for name, row in group.items():
        of_model, printed, notes = config.models.get(name), None, ""
        if of_model is not None:
            notes = notes_text(results["models"][name]["all"])
            if of_model.published is not None:
                printed = [
                    100 * after / before for before, after in zip(*of_model.published, strict=True)
                ]
        left = [100 * a / b for a, b in zip(row["mse"], base, strict=True)]
        rows.append({**row, "left": left, "published": {"left": printed}, "notes": notes})

    def apart(other: str) -> list[Any]:
        def cell(row: Any) -> Cell:
            bounds = row[other]["ci95"][3] if other in row else None
            return Cell(" to ".join(signed(100 * bound, 1) for bound in bounds or ()))

        def mean(row: Any) -> Cell:
            return Cell(signed(100 * row[other]["mean"][3], 1) if other in row else "")

        def below(row: Any) -> Cell:
            return Cell(fixed(100 * row[other]["segments_below"][3], 0) if other in row else "")

        return [("mean", mean), ("95 % interval", cell), ("segments better %", below)]

    def each(key: str, titles: Sequence[str], text: Any) -> list[Any]:
        return [(title, lambda row, i=i: Cell(text(row[key][i]))) for i, title in enumerate(titles)]

    return table_of(
        rows,
        [
            ("model", "model"),
            *each("mse", ("surge N^2", "sway N^2", "yaw (N m)^2"), lambda value: number(value, 4)),
            *each("of_zero", AXES, lambda value: fixed(100 * value, 0)),
            *compared("left", AXES, 3),
            *apart("minus_believed"),
            *apart("minus_reference"),
            ("chosen by the estimator", "notes"),
        ],
        caption="Published: the share that the document's model of that kind left of its believed"
        " model's residual, in other trials.",
        groups=[
            ("mean square error", 3),
            ("% of zero", 3),
            ("% of the believed model's", 3),
            ("mean over axes less believed, % of zero", 3),
            ("the same less the better of zero and believed on each axis", 3),
        ],
        selected=lambda row: sum(row["of_zero"]) == min(sum(one["of_zero"]) for one in rows),
    )

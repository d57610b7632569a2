"""Logs in Python: reading, data checks, preparation for a fit, and drafts of configs."""

from __future__ import annotations

import glob
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from residnet.api.values import (
    PartLike,
    PathLikeArg,
    describe_type,
    forward_progress,
    parse_part,
    parse_path,
    to_builtin,
)
from residnet.core.arrays import paged
from residnet.core.config import Config, Seconds, validate_config
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.names import suggest_name
from residnet.core.progress import ProgressCallback, log_message, report_progress
from residnet.evaluation.protocol import EvaluationConfig, longest_segment_length
from residnet.identification.recipe import PreparationPlan, make_evaluation_settings
from residnet.io.drafting.log_files import find_log_files
from residnet.io.drafting.questions import (
    READER_KEY,
    DraftNotes,
    Key,
    Question,
    dump_commented_yaml,
)
from residnet.io.drafting.reading import read_mixed_formats
from residnet.io.readers import ReaderConfig
from residnet.io.sources import DataConfig, MeasuredLogs
from residnet.io.sources import read_split_logs as read_splits
from residnet.io.split import SPLITS, assign_log_names, check_leaks, split_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.masks import MaskRule
from residnet.preprocessing.motion import MotionConfig, complete_motion
from residnet.preprocessing.prepare import PrepareConfig, PreparedLog
from residnet.preprocessing.prepare import prepare_log as prepare_log
from residnet.quality import inspect_log, inspect_log_set
from residnet.tasks.drafting import ConfigDraft, describe_missing_steering, draft_fit_config
from residnet.tasks.input_selection import (
    choose_inputs,
    find_inputs_held_in_training,
    find_unexcited_inputs,
)
from residnet.tasks.naval_draft import NavalParticulars

if TYPE_CHECKING:
    import pandas as pd

    from residnet.preprocessing.data_module import WindowsDataModule

LogsLike = PathLikeArg | Log | Sequence[PathLikeArg] | Sequence[Log]
"""Logs, or the paths to read them from."""


def read_logs(
    source: LogsLike,
    *,
    channels: Mapping[str, Any] | None = None,
    time: str | tuple[str, str] | Mapping[str, str] = "t",
    manoeuvre: str | None = None,
    reader: PartLike | None = None,
    names: Sequence[str] | None = None,
    progress: ProgressCallback | None = None,
) -> list[Log]:
    """Read logs from files, patterns or folders.

    The columns of a table (csv, foreign Parquet) are described by `channels`, or by a `reader` as
    in YAML. Without either, the reader is drafted from names, headers, values and physics, as
    `draft_config` does it, and reported to `progress` with a comment on each guess.

    Args:
        source: a path, a pattern such as `trials/*.csv`, a folder, or a list of these.
        channels: channel -> (column, unit), for example `{"u": ("speed", "kn")}`, or a mapping with
            column, unit, sign and frame as in YAML.
        time: name of the time column in s, or (column, unit); `{"step": "0.1 s"}` for tables
            without a column of time, with or without `channels`.
        manoeuvre: kind of manoeuvre of all files; `folder` for the name of each file's folder.
        reader: kind or settings of a reader, instead of `channels`.
        names: names of all columns in order, for tables without a line of names.
        progress: called with the progress of the reading.

    Returns:
        The logs in the order of the files: channels [T] in SI units and radians.

    Raises:
        UsageError: if there is no such file, or a column or unit is wrong.
        DataError: if the contents of a file cannot be used.

    Example:
        logs = residnet.read_logs("trials/*.csv", channels={"u": ("speed", "kn"), ...})
    """
    entries: list[Any] = list(source) if isinstance(source, list | tuple) else [source]
    if not entries:
        raise UsageError("read_logs: no log is given; name files, a pattern or a folder")
    are_logs = [isinstance(source_entry, Log) for source_entry in entries]
    if all(are_logs):
        return entries
    if any(are_logs):
        raise UsageError("read_logs: give either paths or logs that were read, not both")
    if reader is not None and channels is not None:
        raise UsageError("read_logs: give channels or a reader, not both")
    with forward_progress(progress):
        # before the search for logs, which uses the endings of all registered readers
        settings: Any = None if reader is None else parse_part(reader, "reader", ReaderConfig)
        files = find_log_files(
            [file for source_entry in entries for file in _expand_glob(source_entry)]
        )
        if channels is not None:
            settings = {
                "kind": "parquet" if files[0].suffix == ".parquet" else "csv",
                "time": _parse_column(time, "time", "s"),
                "channels": {
                    name: _parse_column(column, name) for name, column in channels.items()
                },
                "manoeuvre": manoeuvre,
                **({} if names is None else {"names": list(names)}),
            }
        answers: dict[Key, str] = {}
        if isinstance(time, Mapping) and "step" in time:
            answers[*READER_KEY, "time", "step"] = str(time["step"])
        if names is not None:
            answers[*READER_KEY, "names"] = ",".join(names)
        logs = (
            _read_drafted_logs(files, answers)
            if settings is None
            else _read_with_reader(settings, files)
        )
    log_names = assign_log_names(logs)
    ordered = sorted(logs, key=lambda file: files.index(file) if file in files else len(files))
    return [logs[file].replace(name=log_names[file]) for file in ordered]


def _read_with_reader(reader_settings: Any, files: Sequence[Path]) -> dict[Path, Log]:
    """Read files with a reader that the caller describes; other files are skipped."""
    reader = validate_config(to_builtin(reader_settings), ReaderConfig, "read_logs").build()
    logs = dict[Path, Log]()
    for number, file in enumerate(reader.select_logs(files)):
        report_progress("reading logs", number, len(files))
        logs[file] = reader.read(file)
    report_progress("reading logs", len(files), len(files))
    return logs


def _read_drafted_logs(files: Sequence[Path], answers: Mapping[Key, str]) -> dict[Path, Log]:
    """Read files with drafted readers, and log each channel map that was guessed."""
    logs = dict[Path, Log]()
    for draft_result in read_mixed_formats(files, answers):
        for error in draft_result.errors.values():
            raise error
        # only these readers have a channel map; other formats describe their channels themselves
        if {"channels", "parts"} & set(draft_result.reader):
            log_message(f"{next(iter(draft_result.logs))}: guessed channel map, please check")
            content = {"data": {"reader": draft_result.reader}}
            yaml_text = dump_commented_yaml(content, draft_result.draft_notes.comments_at)
            for line in yaml_text.splitlines():
                log_message(f"  {line}")
        logs |= draft_result.logs
    return logs


def _expand_glob(source_entry: Any) -> list[Path]:
    file = parse_path(source_entry, "read_logs")
    if file.exists() or not glob.has_magic(str(file)):
        return [file]
    matches = sorted(Path(name) for name in glob.glob(str(file), recursive=True))  # noqa: PTH207
    if not matches:
        raise UsageError(f"read_logs: '{file}' matches no file")
    return matches


def _parse_column(entry: Any, name: str, default_unit: str | None = None) -> Any:
    if isinstance(entry, tuple | list) and len(entry) == 2:
        return {"column": entry[0], "unit": entry[1]}
    if isinstance(entry, str) and default_unit is not None:
        return {"column": entry, "unit": default_unit}
    if isinstance(entry, str):
        raise UsageError(
            f"read_logs: channels: {name}: give the column and its unit, for example"
            f" ('{entry}', 'm/s')"
        )
    if isinstance(entry, Mapping):
        return entry
    raise UsageError(
        f"read_logs: channels: {name}: expected (column, unit), {describe_type(entry)}"
    )


def inspect(
    logs: LogsLike, *, inputs: Sequence[str] | None = None, masks: Sequence[Any] = ()
) -> pd.DataFrame:
    """Check logs for errors: clocks, gaps, jumps, frames, lags, copies, excitation.

    Args:
        logs: logs from `read_logs`, or any argument that it accepts.
        inputs: channels that drive the vessel; None for all channels that do not measure motion.
        masks: rules that will exclude samples, as in YAML.

    Returns:
        One row for each finding, with the columns log (`together` for findings between logs), level
        (`note`, `will mislead`, `fatal`), code, text and action. A level above `note` means that
        the data would mislead a fit.

    Raises:
        UsageError: if a log lacks an input, or a path is wrong.
        DataError: if a log cannot be examined.

    Example:
        findings = residnet.inspect(logs); findings[findings.level != "note"]
    """
    import pandas as pd

    log_list = read_logs(logs)
    mask_rules = _validate_masks(masks, "inspect")
    quality_reports = [
        *(inspect_log(log, inputs, mask_rules) for log in log_list),
        inspect_log_set(log_list, inputs),
    ]
    columns = ["level", "code", "text", "action"]
    rows = [
        [quality_report.name, *(getattr(finding, name) for name in columns)]
        for quality_report in quality_reports
        for finding in quality_report.findings
    ]
    return pd.DataFrame(rows, columns=["log", *columns])


def draft_config(
    logs: PathLikeArg | Sequence[PathLikeArg],
    *,
    name: str = "my_boat",
    folder: PathLikeArg = ".",
    answer: Callable[[Question], str] | None = None,
    progress: ProgressCallback | None = None,
    length: str | float | None = None,
    scale: float | None = None,
    **particulars: str | float,
) -> ConfigDraft:
    """Draft a complete config of a fit from logs of any format.

    Channels, units, frames, inputs, splits, protocols and scales are proposed from names, headers,
    values and physics, models from the standard recipe. Values that cannot be derived from the
    logs are guesses and marked in the config.

    Args:
        logs: a file, folder or bag, or a list of these.
        name: name of the run.
        folder: folder of the config; its paths are relative to this folder.
        answer: called with each question that the logs do not answer; returns the answer. None
            for the default answers.
        progress: called with the progress of the reading.
        length: length of the vessel in the logs, such as "3.22 m", for a manoeuvring booklet and
            hydrodynamic derivatives; None for neither.
        scale: length of the ship divided by the length of the vessel in the logs.
        **particulars: `beam`, `draught` and `mass` in the scale of the logs.

    Returns:
        The draft: `config` for `residnet.run`, `guesses` as pairs of key and reason, `text` as
        YAML with comments, and `save(file)`.

    Raises:
        UsageError: if a path does not exist, or the logs have no channel of a command.
        DataError: if no log can be used.

    Example:
        draft = residnet.draft_config("trials/"); draft.save("my_boat.yaml")
    """
    sources = list(logs) if isinstance(logs, list | tuple) else [logs]
    if not sources:
        raise UsageError("draft_config: no log is given; name files, folders or bags")
    unknown = [key for key in particulars if key not in ("beam", "draught", "mass")]
    if unknown:
        raise UsageError(
            f"draft_config: no argument '{unknown[0]}'; particulars are beam, draught and mass"
        )
    naval = NavalParticulars.from_options(length, scale, particulars)
    with forward_progress(progress):
        paths = [parse_path(log_source, "draft_config") for log_source in sources]
        return draft_fit_config(paths, Path(folder), name, answer, naval=naval)


class WindowSettings(Config):
    """Arguments of `Dataset.module`.

    Attributes:
        windows: length of a window.
        batch_size: number of windows in a batch.
        batches: number of training batches in an epoch; None for one visit of every sample.
        history: length of the measured past before a window.
        seed: seed of the random windows.
        precision: floating-point precision by its name in Lightning.
    """

    windows: Seconds = Field(gt=0)
    batch_size: int = Field(ge=1)
    batches: int | None = Field(default=None, ge=1)
    history: Seconds = Field(ge=0)
    seed: int = Field(ge=0)
    precision: Literal["32-true", "64-true"]


@dataclass(frozen=True)
class Dataset:
    """Logs prepared for a fit, with the settings of the evaluation.

    Attributes:
        splits: prepared logs by split: train, validation, test; external for other logs.
        signals: inputs and velocities of the models.
        prepare: grid, masks and derivatives.
        evaluation: protocols, scales and selection.
        source: the `data` section of the config that the logs came from; None without a config.
    """

    splits: Mapping[str, list[PreparedLog]]
    signals: SignalsConfig
    prepare: PrepareConfig
    evaluation: EvaluationConfig
    source: MeasuredLogs | SimulatedTrials | None = None

    @property
    def table(self) -> pd.DataFrame:
        """One row for each log: log, split, manoeuvre, seconds, samples, usable, learned_from."""
        import pandas as pd

        rows = [log.to_table_row(split) for split, logs in self.splits.items() for log in logs]
        return pd.DataFrame(rows)

    def logs(self, split: str) -> list[PreparedLog]:
        """Return the prepared logs of a split.

        Raises:
            UsageError: if there is no such split.
        """
        if split not in self.splits or not self.splits[split]:
            raise UsageError(f"the data have no split '{split}'{suggest_name(split, self.splits)}")
        return self.splits[split]

    def module(
        self,
        windows: float | str = 10.0,
        *,
        batch_size: int = 64,
        batches: int | None = None,
        history: float | str = 0.0,
        seed: int = 0,
        precision: Literal["32-true", "64-true"] = "32-true",
    ) -> WindowsDataModule:
        """Return the logs as a `LightningDataModule` of windows, for any Lightning module.

        A batch is a tuple with one `WindowBatch` (`y`, `smoothed`, `nu_dot`, `w`, `usable`,
        `trainable`, ... [batch, samples, channels]). Training windows are drawn at random; the same
        seed and epoch give the same windows, also after a resume. Validation and test windows
        follow one another along the logs.

        Args:
            windows: length of a window in s, as a number or with a unit such as `10 s`.
            batch_size: number of windows in a batch.
            batches: number of training batches in an epoch; None for as many as visit every
                training sample once on average.
            history: length of the measured past before a window in s (`past_y`, `past_w`).
            seed: seed of the random windows.
            precision: floating-point precision by its name in Lightning.

        Raises:
            ConfigError: if a value is wrong.
            UsageError: if the data have no training logs.
            DataError: if no log is as long as a window.

        Example:
            lightning.Trainer(max_epochs=20).fit(my_module, data.module(windows="10 s"))
        """
        # imports Lightning, which data without a training must not wait for
        import torch

        from residnet.preprocessing.data_module import WindowsDataModule
        from residnet.preprocessing.window_index import WindowStage

        settings = validate_config(
            {
                "windows": windows,
                "batch_size": batch_size,
                "batches": batches,
                "history": history,
                "seed": seed,
                "precision": precision,
            },
            WindowSettings,
            "module",
        )
        training_logs = self.logs("train")
        step = self.prepare.grid.step
        n_window_samples = max(round(settings.windows / step), 1)
        n_samples = sum(len(log) for log in training_logs)
        n_batches = settings.batches or max(1, n_samples // (n_window_samples * batch_size))
        stage = WindowStage(n_window_samples, batch_size, round(settings.history / step))
        dtype = torch.float64 if precision == "64-true" else torch.float32
        splits = {name: self.splits.get(name, []) for name in SPLITS}
        return WindowsDataModule.from_splits(splits, stage, n_batches, seed, dtype)


def prepare(
    logs: LogsLike | Mapping[str, Any],
    inputs: Sequence[str] | None = None,
    *,
    step: float | str | None = None,
    held_channels: Sequence[str] | None = None,
    settings_from: Dataset | None = None,
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> Dataset:
    """Resample, smooth and differentiate logs, and choose the settings of the evaluation.

    Settings that are not given are derived from the logs, as `draft_config` does it: inputs from
    names and values; step and derivative from the sampling interval and the correlation time of the
    yaw rate; evaluation windows back to back, of the length that most validation and test logs
    contain and of about a third of it; scales as the winsorized standard deviations of u, v and r
    over the unmasked training samples. If the logs measure only some of u, v and r, the models have
    these velocities; if all logs measure the roll angle, the models include roll.

    Args:
        logs: a list of logs, a mapping from `train`, `validation` and `test` to logs, or the `data`
            section of a config. A list is sorted by manoeuvre; of each five logs the third is for
            validation and the fifth for the test. Fewer than five logs are cut in time.
        inputs: command channels that drive the model, in order; an empty list for a model without
            inputs.
        step: step of the grid in s.
        held_channels: channels that keep their last value between samples; other channels are
            interpolated.
        settings_from: dataset whose settings are used; all logs then form the split `external`.
        progress: called with the progress of the work.
        settings: further keys of the sections `signals` (exogenous, forces, velocities),
            `prepare` (masks, derivative, motion, trim, hold, beside) and
            `evaluation` (protocols, selection, scales, groups, divergence) of a config, as in YAML;
            without `selection` the first of `protocols` is used for model selection.

    Returns:
        The data: y, smooth [T, 3 + n], nu_dot [T, n], w [T, m] of each log, float64, SI.

    Raises:
        ConfigError: if a setting is wrong.
        UsageError: if a channel is missing, or no inputs are named.
        DataError: if a log has no usable stretch, or splits share measurements.

    Example:
        data = residnet.prepare(logs, ["n_port", "n_stbd"])
    """
    with forward_progress(progress):
        if settings_from is not None:
            external = read_logs(logs)  # type: ignore[arg-type]
            prepared = _prepare_splits(
                {"external": external}, settings_from.signals, settings_from.prepare
            )
            return Dataset(
                prepared, settings_from.signals, settings_from.prepare, settings_from.evaluation
            )
        splits, source = _resolve_splits(logs)
        dof = _find_velocities(splits, settings.get("velocities"))
        complete_logs = {
            name: [complete_motion(log, MotionConfig(), dof) for log in members]
            for name, members in splits.items()
        }
        all_logs = [log for members in complete_logs.values() for log in members]
        unexcited: Sequence[str] = ()
        if inputs is None:
            input_names, unexcited = _derive_inputs(complete_logs, dof)
        else:
            input_names = inputs
        common_inputs = [
            name for name in input_names if all(name in log.channels for log in all_logs)
        ]
        masks = _validate_masks(settings.get("masks") or (), "prepare")
        preparation_plan = PreparationPlan.from_logs(all_logs, common_inputs, dof, masks)
        if dof.description:
            log_message(f"velocities: {dof.description}")
        log_message(f"recipe: {preparation_plan.reason}")
        evaluation_settings: dict[str, Any] = {}
        preparation_settings = preparation_plan.to_config()
        grid = {"step": step, "held": held_channels}
        preparation_settings["grid"] |= {
            key: value for key, value in grid.items() if value is not None
        }
        if settings.get("protocols") is not None:
            evaluation_settings["selection"] = _find_first_protocol(settings["protocols"])
        signals: dict[str, Any] = {
            "inputs": input_names if isinstance(input_names, str) else list(input_names),
            "exogenous": preparation_plan.wind_channels,
            "velocities": dof.velocities,
            "unexcited": unexcited,
        }
        sections = (
            (SignalsConfig, signals),
            (EvaluationConfig, evaluation_settings),
            (PrepareConfig, preparation_settings),
        )
        # a key of no section is reported as an unknown key of `prepare`
        _assign_to_sections(settings, sections, default_section=preparation_settings)
        signals_config = validate_config(to_builtin(signals), SignalsConfig, "prepare")
        preparation = validate_config(to_builtin(preparation_settings), PrepareConfig, "prepare")
        prepared = _prepare_splits(splits, signals_config, preparation)
        step = preparation.grid.step
        durations = {
            split: [longest_segment_length(log) * step for log in members]
            for split, members in prepared.items()
        }
        evaluation_settings = (
            make_evaluation_settings(
                complete_logs,
                durations,
                preparation_plan.correlation_time,
                masks,
                dof,
            )
            | evaluation_settings
        )
        evaluation = validate_config(to_builtin(evaluation_settings), EvaluationConfig, "prepare")
        return Dataset(prepared, signals_config, preparation, evaluation, source)


def _find_velocities(splits: Mapping[str, Sequence[Log]], velocities: Any) -> DegreesOfFreedom:
    """Return the velocities of a model: the setting, or those that all logs measure.

    Raises:
        ConfigError: if the setting is wrong.
    """
    if velocities is not None:
        settings = {"inputs": [], "velocities": to_builtin(velocities)}
        return validate_config(settings, SignalsConfig, "prepare").dof
    return DegreesOfFreedom.intersection(
        [
            DegreesOfFreedom.from_channels(log.channels)
            for members in splits.values()
            for log in members
        ]
    )


def _find_first_protocol(protocols: Any) -> str:
    """Return the name of the first protocol, which selects the model; empty without protocols.

    Raises:
        UsageError: if the protocols are not a mapping by name.
    """
    if not isinstance(protocols, Mapping):
        given_type = describe_type(protocols)
        raise UsageError(f"prepare: protocols: expected a mapping by name, given {given_type}")
    return next(iter(protocols), "")


def _derive_inputs(
    splits: Mapping[str, Sequence[Log]], dof: DegreesOfFreedom
) -> tuple[Sequence[str], Sequence[str]]:
    """Return the inputs and the unexcited inputs of a model, as `draft_config` chooses them.

    Args:
        splits: logs with complete motion by split.
        dof: degrees of freedom of the model.

    Raises:
        UsageError: if no channel is an input, or the vessel turns and no input steers it, or the
            one that does is constant in the training logs.
    """
    logs = [log for members in splits.values() for log in members]
    channels_text = f"the first log has {', '.join(logs[0].channels)}"
    input_names = choose_inputs(logs, DraftNotes())
    if not input_names:
        raise UsageError(
            "prepare: inputs: no channel of the logs is a rudder, a propeller or another"
            f" command; pass the inputs of the vessel; {channels_text} (an empty list: a model"
            " without commands)"
        )
    if problem := describe_missing_steering(input_names, dof, logs):
        raise UsageError(
            f"prepare: inputs: {problem}; map the column that does to a channel (read_logs:"
            f" reader), or pass inputs={list(input_names)} to fit without it; {channels_text}"
        )
    held = find_inputs_held_in_training(splits, input_names)
    input_names = tuple(name for name in input_names if name not in held)
    if held and (problem := describe_missing_steering(input_names, dof, logs)):
        raise UsageError(f"prepare: inputs: {problem}: {'; '.join(held.values())}")
    unexcited = held | find_unexcited_inputs(logs, (*input_names, *held))
    for text in unexcited.values():
        log_message(f"inputs: {text}")
    return input_names, list(unexcited)


def _assign_to_sections(
    settings: Mapping[str, Any],
    sections: Sequence[tuple[type[Config], dict[str, Any]]],
    default_section: dict[str, Any],
) -> None:
    """Add settings to the first section of a config that has a key of their name.

    Args:
        settings: settings by key; those that are None are skipped.
        sections: class and settings of each section.
        default_section: section of unknown keys.
    """
    for key, value in settings.items():
        if value is None:
            continue
        section = next(
            (content for config_class, content in sections if key in config_class.model_fields),
            default_section,
        )
        section[key] = value


def _validate_masks(masks: Any, function_name: str) -> tuple[MaskRule, ...]:
    settings = {"grid": {"step": 1.0}, "masks": to_builtin(masks)}
    return validate_config(settings, PrepareConfig, function_name).masks


def _prepare_splits(
    splits: Mapping[str, Sequence[Log]], signals: SignalsConfig, config: PrepareConfig
) -> dict[str, list[PreparedLog]]:
    n_done = 0
    total = sum(map(len, splits.values()))
    prepared: dict[str, list[PreparedLog]] = {}
    for split, members in splits.items():
        prepared[split] = paged.PageReleasingList()
        for log in members:
            report_progress("preparing logs", n_done, total)
            prepared[split].append(
                prepare_log(log, split, signals.input_columns, config, signals.dof)
            )
            if not prepared[split][-1].trainable.any():
                raise DataError(
                    f"log {log.name}: no stretch is as long as the window of the derivative;"
                    f" leave the"
                    " log out or use a shorter window"
                )
            n_done += 1
    report_progress("preparing logs", total, total)
    return prepared


def _resolve_splits(
    logs: Any,
) -> tuple[dict[str, list[Log]], MeasuredLogs | SimulatedTrials | None]:
    if isinstance(logs, Mapping) and "kind" in logs:
        source = validate_config(to_builtin(logs), DataConfig, "prepare")
        return read_splits(source), source
    if isinstance(logs, Mapping):
        for name in logs:
            if name not in SPLITS:
                raise UsageError(
                    f"prepare: unknown split '{name}'{suggest_name(str(name), SPLITS)}"
                )
        if missing_splits := [name for name in SPLITS if name not in logs]:
            raise UsageError(f"prepare: no logs for {', '.join(missing_splits)}")
        splits = {name: read_logs(logs[name]) for name in SPLITS}
    else:
        splits = split_logs(read_logs(logs))
    names = [log.name for members in splits.values() for log in members]
    if duplicates := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"prepare: two logs are named '{duplicates[0]}'; rename one of them")
    check_leaks(splits)
    return splits, None

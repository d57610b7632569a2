"""`residnet new`: draft a complete config of a fit from logs, with a comment on each guess."""

from __future__ import annotations

import dataclasses
import os
import re
import shlex
import unicodedata
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.config import validate_config
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.files import write_owned
from residnet.core.layout import HEADING, ROLL_LAYOUT, SIX_DOF_LAYOUT, DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.names import BOW_WIND_CHANNELS, WIND_INPUTS
from residnet.core.ownership import require_replaceable
from residnet.core.progress import log_message
from residnet.io.drafting.log_files import find_log_files
from residnet.io.drafting.problems import group_problems, label_files
from residnet.io.drafting.questions import (
    CHANNELS_KEY,
    INPUTS_KEY,
    TEXT_COLUMNS,
    UNMAPPED_COLUMNS,
    UNMAPPED_FIELDS,
    AnswerCallback,
    DraftNotes,
    Key,
    dump_commented_yaml,
)
from residnet.io.drafting.reading import read_drafted
from residnet.io.readers.base import locate_file
from residnet.io.readers.quantities import (
    COSINE_SUFFIX,
    QUATERNION,
    SINE_SUFFIX,
    SPEED_CHANNELS,
)
from residnet.io.split import SPLITS, extract_segment, remove_copies, split_logs, splits_from_names
from residnet.preprocessing.motion import MotionConfig, complete_motion
from residnet.quality import inspect_log
from residnet.tasks.input_selection import (
    choose_inputs,
    find_inputs_held_in_training,
    find_unexcited_inputs,
    missing_control,
)
from residnet.tasks.naval_draft import NavalParticulars, choose_held_out_logs, draft_naval_sections

if TYPE_CHECKING:
    from residnet.tasks.fit.config import FitConfig

STOP = "stop: "
"""Prefix of the last line of a draft that must be completed before a run."""
_MIN_TURN = np.radians(20.0)
"""Range of the heading in rad above which a vessel counts as turning."""
_UNMATCHED_COLUMN_NOTES = (UNMAPPED_COLUMNS, TEXT_COLUMNS, UNMAPPED_FIELDS)
_MAX_INSPECTED_LOGS = 12
"""Maximum number of logs that are inspected."""
_MAX_TESTED_SAMPLES = 400
"""Samples of a log in the test of a current."""
_MIN_CURRENT_SHARE = 0.5
"""Share of logs with a significant current from which currents are estimated.

In a minority of logs an error of the model can pass for a current: in still water the test is
significant in 4 of 9 logs of `residnet demo` with two files per run.
"""
_MAX_SHOWN_GUESSES = 12
"""Maximum number of guesses shown on the terminal."""


@dataclass(frozen=True)
class ConfigDraft:
    """A drafted config that runs without changes, with its guessed values.

    Attributes:
        config: content of the YAML file.
        guesses: pairs of a key and the reason of its guess.
        text: the YAML text with comments.
        warnings: unused channels and logs, and errors of the data that would mislead a fit.
        missing: text on the missing entries of the config; empty if it is complete.
    """

    config: dict[str, Any]
    guesses: tuple[tuple[str, str], ...]
    text: str
    warnings: tuple[str, ...] = ()
    missing: str = ""

    def save(self, file: Path | str) -> Path:
        """Write the config as YAML with its comments; returns the path of the file.

        Raises:
            UsageError: if the file cannot be written, or was not written by residnet.
        """
        path = Path(file)
        with write_owned(path) as partial:
            partial.write_text(self.text, encoding="utf-8")
        return path


def write_new_config(
    logs: Sequence[Path],
    output_file: Path,
    answer_question: AnswerCallback | None,
    *,
    overwrite: bool,
    answers: Mapping[Key, str] | None = None,
    naval: NavalParticulars | None = None,
) -> list[str]:
    """Draft a config for logs and write it; returns the lines for the terminal.

    The last line says what to do next. It begins with `STOP` if the config is incomplete.

    Args:
        logs: files, folders and bags.
        output_file: file of the config.
        answer_question: asks the user; None for the default answers.
        overwrite: replace an earlier config.
        answers: answers given in advance, by key of the config.
        naval: length and scale, for a manoeuvring booklet and derivatives; None for neither.

    Raises:
        UsageError: if the file exists already, or a path does not.
        DataError: if no log can be used.
    """
    if output_file.suffix not in (".yaml", ".yml"):
        raise UsageError(
            f"--out {output_file}: a config is a YAML file; name it {output_file}.yaml"
        )
    if output_file.exists() and not overwrite:
        raise UsageError(f"--out {output_file}: exists; give --overwrite, or another name")
    require_replaceable(output_file)
    ascii_name = unicodedata.normalize("NFKD", output_file.stem).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", ascii_name).strip("_.-") or "my_boat"
    draft = draft_fit_config(logs, output_file.parent, name, answer_question, answers, naval)
    file = draft.save(output_file)
    n_guesses = len(draft.guesses)
    messages = [f"{key}: {reason}" for key, reason in draft.guesses[:_MAX_SHOWN_GUESSES]]
    if n_guesses > _MAX_SHOWN_GUESSES:
        messages.append(f"and {n_guesses - _MAX_SHOWN_GUESSES} more, marked in the file")
    if n_guesses == 1:
        messages.insert(0, "one value is a guess, marked in the file:")
    elif n_guesses:
        messages.insert(0, f"{n_guesses} values are guesses, each marked in the file:")
    return [
        *messages,
        *draft.warnings,
        f"config: {file}",
        f"{STOP}{draft.missing}; then residnet run {shlex.quote(str(file))}"
        if draft.missing
        else f"next: residnet run {shlex.quote(str(file))}",
    ]


def _note_missing_inputs(
    inputs: Sequence[str], draft_logs: _DraftLogs, draft_notes: DraftNotes
) -> None:
    """Note that the logs have no inputs, or none for thrust or steering."""
    if not inputs:
        channel_names = ", ".join(next(iter(draft_logs.complete_logs.values())).channels)
        draft_notes.add_guess(
            INPUTS_KEY,
            "no channel of the logs is a rudder, a propeller or another command (channels:"
            f" {channel_names}): a model without inputs can only predict how the vessel coasts;"
            " name the columns of the commands",
        )
    elif missing := missing_control(inputs, draft_logs.dof):
        draft_notes.add_guess(
            INPUTS_KEY,
            f"no input {missing} the vessel; if an unused column does, name it under"
            " data.reader.channels",
        )


def _note_unused_channels(
    draft_logs: _DraftLogs, draft_notes: DraftNotes, *, has_wind: bool
) -> None:
    """Note channels of depth and wind that the model does not use, and the missing channels."""
    dof = draft_logs.dof
    measured_channels = {name for log in draft_logs.logs.values() for name in log.channels}
    depth_channels = [
        name
        for name in SIX_DOF_LAYOUT.dynamic_states
        if name in measured_channels and name not in ROLL_LAYOUT.dynamic_states
    ]
    if depth_channels and not dof.is_six_dof:
        text = (
            f"{', '.join(depth_channels)}: not used: six degrees of freedom need depth, pitch and"
            " roll angles, and u and v or a position, that move in all logs"
        )
        if dof.is_planar and {"w", "z"} & {*depth_channels}:
            text += "; the model is planar, heave and depth are left out and not predicted"
        draft_notes.add_note(CHANNELS_KEY, text)
    if not has_wind and all({*WIND_INPUTS} <= {*log.channels} for log in draft_logs.logs.values()):
        draft_notes.add_note(
            CHANNELS_KEY, "the wind is not used: its loads need u, v, r and a measured heading"
        )


def draft_fit_config(
    paths: Sequence[Path],
    folder: Path,
    name: str,
    answer_question: AnswerCallback | None = None,
    answers: Mapping[Key, str] | None = None,
    naval: NavalParticulars | None = None,
) -> ConfigDraft:
    """Draft a config of the task `fit` for logs.

    Args:
        paths: files, folders and bags.
        folder: folder of the config; its paths are relative to this folder.
        name: name of the run.
        answer_question: answers questions; None for the default answers, marked as guesses.
        answers: answers given in advance, by key of the config.
        naval: length and scale, for a manoeuvring booklet and derivatives; None for neither.

    Raises:
        UsageError: if a path does not exist.
        DataError: if no log can be used.
    """
    draft_notes = DraftNotes(answer_question, answers)
    draft_logs = _DraftLogs(find_log_files(paths), draft_notes)
    for key in draft_notes.unused_answers():
        raise UsageError(
            f"{paths[0]}: --{key[-1]} ({'.'.join(key)}) applies to tables of text that are one log"
            " each; these logs do not use it, leave it out"
        )
    # inputs of the model
    inputs = choose_inputs(list(draft_logs.complete_logs.values()), draft_notes)
    _note_missing_inputs(inputs, draft_logs, draft_notes)
    missing_text = _explain_missing_steering(
        inputs, draft_logs.dof, list(draft_logs.complete_logs.values()), draft_notes
    )
    reasons_by_unexcited_input = find_unexcited_inputs(
        list(draft_logs.complete_logs.values()), inputs
    )
    # commands that are not inputs, because the angles are measured, show the lag of the actuators
    logs_with_commands = dict(draft_logs.complete_logs)
    all_inputs = draft_logs.restrict_to_inputs((*inputs, *reasons_by_unexcited_input), draft_notes)
    inputs = all_inputs[: len(inputs)]
    dof = draft_logs.dof
    finding_codes, quality_warnings = _data_quality_warnings(list(draft_logs.logs.values()), inputs)
    # importing torch takes 190 MB: the inspection of long logs is done before
    from residnet.identification.recipe import (
        SINGLE_MODEL_NAME,
        PreparationPlan,
        choose_integrator,
        make_evaluation_settings,
    )
    from residnet.preprocessing.prepare import PrepareConfig
    from residnet.tasks.fit.config import FitConfig

    # masks, channels and preparation
    mask_settings = _choose_mask_settings(finding_codes, dof)
    masks = validate_config({"grid": {"step": 1.0}, **mask_settings}, PrepareConfig, "draft").masks
    preparation_plan = PreparationPlan.from_logs(
        list(draft_logs.complete_logs.values()), inputs, dof, masks
    )
    _note_unused_channels(draft_logs, draft_notes, has_wind=bool(preparation_plan.wind_channels))
    preparation = preparation_plan.to_config()
    for text in quality_warnings:
        draft_notes.add_note(("data",), f"data doctor: {text}")
    preparation |= mask_settings
    usable_logs = draft_logs.select_usable((*inputs, *preparation_plan.wind_channels), preparation)
    # split of the logs, and the evaluation that their lengths allow
    root, split_entries = _split_logs(
        draft_logs, usable_logs, folder, draft_notes, holds_out_manoeuvres=naval is not None
    )
    if not splits_from_names(list(usable_logs.values())):
        # a split given by the names of folders is not changed
        _move_short_logs_to_training(split_entries, preparation_plan.correlation_time, draft_notes)
    split = {name: [entry for entry, *_ in members] for name, members in split_entries.items()}
    splits = {name: [log for _, log, _ in members] for name, members in split_entries.items()}
    durations = {name: [time for *_, time in members] for name, members in split_entries.items()}
    held_in_training = find_inputs_held_in_training(splits, inputs)
    regressors = tuple(name for name in inputs if name not in held_in_training)
    if held_in_training and not missing_text:
        problem = describe_missing_steering(regressors, dof, list(usable_logs.values()))
        missing_text = problem and f"{problem}: {'; '.join(held_in_training.values())}"
    unexcited = zip(all_inputs[len(inputs) :], reasons_by_unexcited_input.values(), strict=True)
    signals = _choose_signals(
        regressors,
        held_in_training | dict(unexcited),
        dof,
        preparation_plan.wind_channels,
        draft_notes,
    )
    evaluation_settings = make_evaluation_settings(
        splits, durations, preparation_plan.correlation_time, masks, dof
    )
    _note_choices(draft_notes, preparation_plan.reason, evaluation_settings["selection"])
    config = {
        "task": "fit",
        "name": name,
        "description": f"Drafted by residnet new from {len(usable_logs)} logs",
        "data": {"kind": "measured", "reader": draft_logs.reader, "split": {"root": root, **split}},
        "prepare": preparation,
        "signals": signals,
        "integrator": choose_integrator(dof),
        "recipe": "standard" if naval is None else "model_tests",
        "export": {"models": []},
        "evaluation": evaluation_settings,
    }
    if naval is not None and not missing_text:
        config |= draft_naval_sections(
            [logs_with_commands[path] for path in usable_logs],
            regressors,
            naval,
            SINGLE_MODEL_NAME,
            draft_notes,
        )
    settings = validate_config(config, FitConfig, "draft", folder)
    if _has_current(settings, [*splits["train"], *splits["validation"]], draft_notes):
        config["current"] = {"baseline": SINGLE_MODEL_NAME}
    guesses = tuple((".".join(key), text) for key, text in draft_notes.guessed_values)
    unused = [text for key, text in draft_notes.notes if key[-1] == "channels" or key == ("data",)]
    exclusions = group_problems(draft_logs.exclusion_reasons, has_full_paths=False)
    exclusion_lines = [f"left out: {line}" for line in exclusions]
    text = dump_commented_yaml(config, draft_notes.comments_at, draft_logs.header_lines())
    return ConfigDraft(config, guesses, text, (*exclusion_lines, *unused), missing_text)


def _choose_mask_settings(finding_codes: Collection[str], dof: DegreesOfFreedom) -> dict[str, Any]:
    """Return the masks of a drafted config: frozen channels if a data check found some."""
    if "frozen" not in finding_codes:
        return {}
    # fixed states are constant and must not be marked as frozen
    mask_channels = {"channels": list(dof.active_states)} if dof.fixed_states else {}
    return {"masks": [{"kind": "frozen", **mask_channels}]}


def _note_choices(draft_notes: DraftNotes, grid_reason: str, selection: str) -> None:
    """Add comments on grid, evaluation and recipe to a drafted config.

    Args:
        draft_notes: comments of the config.
        grid_reason: reason for step and derivative.
        selection: protocol of the model selection.
    """
    draft_notes.add_note(("prepare", "grid"), grid_reason)
    draft_notes.add_note(
        ("evaluation", "protocols"),
        f"free runs of a length that most logs contain; {selection} is used for model selection on"
        " validation logs",
    )
    draft_notes.add_note(
        ("evaluation", "scales"), "winsorized standard deviations over the training logs"
    )
    draft_notes.add_note(
        ("recipe",), "a portfolio of models, whose terms and sizes follow from the logs"
    )


def _has_current(settings: FitConfig, logs: Sequence[Log], draft_notes: DraftNotes) -> bool:
    """Test whether logs over ground ran in currents, by the accelerations of a hull model.

    Args:
        settings: settings of the fit, without `current`.
        logs: logs with complete motion.
        draft_notes: receives the currents.
    """
    dof = settings.signals.dof
    if not dof.is_planar or dof.fixed_states or not settings.signals.inputs:
        return False
    from residnet.baselines.regressors import RegressorBaseline
    from residnet.identification.prepared import prepare_splits
    from residnet.identification.recipe import SINGLE_MODEL_NAME
    from residnet.training.current import (
        estimate_currents,
        is_explained_by_body_velocity,
        select_significant_currents,
    )
    from residnet.training.current_config import CurrentConfig

    signals = settings.signals.build()
    model = settings.baselines[SINGLE_MODEL_NAME].build(signals.names)
    if not isinstance(model, RegressorBaseline):
        return False
    try:
        prepared = prepare_splits({"train": logs[:_MAX_INSPECTED_LOGS]}, settings)["train"]
        # neighbouring samples are correlated, so that few of them suffice for a test
        thinned_logs = [
            dataclasses.replace(
                log,
                trainable=log.trainable
                & (np.arange(len(log)) % max(len(log) // _MAX_TESTED_SAMPLES, 1) == 0),
            )
            for log in prepared
        ]
        _, rows = estimate_currents(model, signals, thinned_logs, CurrentConfig())
    except ResidnetError:
        # logs without a usable sample are reported when the draft is run
        return False
    speeds = [float(np.nanmedian(np.hypot(log.log["u"], log.log["v"]))) for log in prepared]
    currents = select_significant_currents(rows, speeds)
    if len(currents) < _MIN_CURRENT_SHARE * len(rows):
        return False
    headings = [log.y[log.trainable, HEADING] for log in prepared]
    if is_explained_by_body_velocity(rows, headings):
        return False
    listed_currents = ", ".join(
        f"{row.log} {row.speed:.2g} m/s (p = {row.p_value:.1g})" for row in currents[:3]
    )
    draft_notes.add_guess(
        ("current",),
        f"{len(currents)} of {len(rows)} logs ran in a significant constant current or wind:"
        f" {listed_currents}; the current of each log is estimated, remove this section for still"
        " water",
    )
    return True


def describe_missing_steering(
    inputs: Sequence[str], dof: DegreesOfFreedom, logs: Sequence[Log]
) -> str:
    """Return why inputs do not suffice; empty if one steers or the vessel goes straight.

    Args:
        inputs: inputs of the model.
        dof: degrees of freedom of the model.
        logs: logs with complete motion.
    """
    if inputs and missing_control(inputs, dof) != "steers":
        return ""
    turns = [
        float(np.ptp(log["psi"][np.isfinite(log["psi"])])) for log in logs if "psi" in log.channels
    ]
    turn = max(turns, default=0.0)
    if turn < _MIN_TURN:
        return ""
    return f"the vessel turns by up to {np.degrees(turn):.0f} deg, and no input steers it"


def _explain_missing_steering(
    inputs: Sequence[str], dof: DegreesOfFreedom, logs: Sequence[Log], draft_notes: DraftNotes
) -> str:
    """Return why a draft without steering cannot be run, and what to do; else an empty text.

    Args:
        inputs: inputs of the model.
        dof: degrees of freedom of the model.
        logs: logs with complete motion.
        draft_notes: notes on the columns without a channel.
    """
    problem = describe_missing_steering(inputs, dof, logs)
    if not problem:
        return ""
    unmatched_columns = "; ".join(
        text for _, text in draft_notes.notes if text.startswith(_UNMATCHED_COLUMN_NOTES)
    )
    columns_text = f" ({unmatched_columns})" if unmatched_columns else ""
    return (
        f"{problem}; name the column that does under data.reader.channels and"
        f" signals.inputs{columns_text}, or give logs with it"
    )


def _data_quality_warnings(
    logs: Sequence[Log], inputs: Sequence[str]
) -> tuple[set[str], list[str]]:
    """Inspect some of the logs; returns codes and texts of the findings above a note."""
    texts_by_code: dict[str, list[str]] = {}
    warnings = []
    for log in logs[:: max(1, len(logs) // _MAX_INSPECTED_LOGS)]:
        try:
            quality_report = inspect_log(log, [name for name in inputs if name in log.channels])
        except ResidnetError as error:
            warnings.append(f"{log.name}: {error}")
            continue
        for finding in quality_report.findings:
            if finding.level != "note" or finding.code == "roll":
                texts_by_code.setdefault(finding.code, []).append(f"{log.name}: {finding.text}")
    for texts in texts_by_code.values():
        suffix = f" (and {len(texts) - 1} more logs)" if len(texts) > 1 else ""
        warnings.append(f"{texts[0][:300]}{suffix}")
    return {*texts_by_code}, warnings


class _DraftLogs:
    """The logs of a draft.

    Attributes:
        reader: `data.reader` of the config.
        dof: degrees of freedom that most of the logs measure.
        logs: log by path, in SI units, as returned by the reader.
        complete_logs: log by path, with the motion at every sample.
        exclusion_reasons: reason by path of a log that is not used.
        longest_times: longest usable time in s without a gap after preparation, by path.
        longest_gapless_time: function that returns the longest usable time in s of any part of a
            log.
    """

    longest_gapless_time: Callable[[Log], float]

    def __init__(self, paths: Sequence[Path], draft_notes: DraftNotes) -> None:
        self.longest_times: dict[Path, float] = {}
        draft_result = read_drafted(paths, draft_notes)
        self.reader = draft_result.reader
        self.exclusion_reasons = {path: str(error) for path, error in draft_result.errors.items()}
        self.logs: dict[Path, Log] = {}
        self.complete_logs: dict[Path, Log] = {}
        # parts whose relative time is uncertain would bias the fitted response
        ambiguous_logs = {
            path: finding["text"]
            for path, log in draft_result.logs.items()
            for finding in log.meta.get("findings", ())
            if finding["code"] == "joined" and finding["level"] == "will mislead"
        }
        ambiguous_logs = ambiguous_logs if len(ambiguous_logs) < len(draft_result.logs) else {}
        self.exclusion_reasons |= ambiguous_logs
        dof_of_logs = [
            DegreesOfFreedom.from_channels(log.channels) for log in draft_result.logs.values()
        ]
        self.dof = max(dof_of_logs, key=lambda dof: (dof_of_logs.count(dof), len(dof.velocities)))
        for path, log in draft_result.logs.items():
            if path in ambiguous_logs:
                continue
            try:
                self.complete_logs[path], self.logs[path] = (
                    complete_motion(log, MotionConfig(), self.dof),
                    log,
                )
            except ResidnetError as error:
                self.exclusion_reasons[path] = str(error)
        if not self.complete_logs:
            # an unrecognised column may be the missing channel
            unmatched_notes = "; ".join(
                text for _, text in draft_notes.notes if text.startswith(_UNMATCHED_COLUMN_NOTES)
            )
            reason = group_problems(self.exclusion_reasons)[0]
            raise DataError(f"{reason} ({unmatched_notes})" if unmatched_notes else reason)

    def restrict_to_inputs(self, inputs: Sequence[str], draft_notes: DraftNotes) -> tuple[str, ...]:
        """Rename forces to tau_x, tau_y, tau_n, drop unused channels, and return the inputs."""
        renamed_inputs = {
            name: next((f for f in ("tau_x", "tau_y", "tau_n") if name.startswith(f"{f}_")), name)
            for name in inputs
        }
        if channels := self.reader.get("channels"):
            layout = SIX_DOF_LAYOUT if self.dof.is_six_dof else ROLL_LAYOUT
            state_channels = [*layout.state_names, *WIND_INPUTS, *BOW_WIND_CHANNELS]
            state_channels += [
                f"{name}{part}" for name in state_channels for part in (COSINE_SUFFIX, SINE_SUFFIX)
            ]
            state_channels += [] if "x" in channels else ["latitude", "longitude"]
            state_channels += [] if "psi" in channels else QUATERNION
            state_channels += [] if {"u", "v"} & channels.keys() else SPEED_CHANNELS
            self.reader["channels"] = {
                renamed_inputs.get(name, name): entry
                for name, entry in channels.items()
                if name in state_channels or name in renamed_inputs
            }
            depth = len(CHANNELS_KEY)

            def rename_channel(key: Key) -> Key | None:
                if key[:depth] != CHANNELS_KEY or len(key) == depth:
                    return key
                name = key[depth]
                if name not in state_channels and name not in renamed_inputs:
                    return None
                return (*CHANNELS_KEY, renamed_inputs.get(name, name), *key[depth + 1 :])

            draft_notes.replace_keys(rename_channel)
        for logs in (self.logs, self.complete_logs):
            for path, log in logs.items():
                renamed_channels = {
                    renamed_inputs.get(key, key): values for key, values in log.channels.items()
                }
                units = {renamed_inputs.get(key, key): unit for key, unit in log.units.items()}
                logs[path] = log.replace(channels=renamed_channels, units=units)
        return tuple(renamed_inputs.values())

    def select_usable(
        self, columns: Sequence[str], preparation: Mapping[str, Any]
    ) -> dict[Path, Log]:
        """Return the logs that can be prepared; for others, the reason is recorded."""
        from residnet.identification.recipe import longest_usable_duration
        from residnet.preprocessing.prepare import PrepareConfig

        config = validate_config(dict(preparation), PrepareConfig, "draft")
        self.longest_gapless_time = lambda log: longest_usable_duration(
            log, columns, config, self.dof
        )
        usable_logs: dict[Path, Log] = {}
        for path, log in self.logs.items():
            try:
                self.longest_times[path] = self.longest_gapless_time(log)
                if self.longest_times[path]:
                    usable_logs[path] = self.complete_logs[path]
                else:
                    self.exclusion_reasons[path] = (
                        "no stretch is as long as the window of the derivative"
                    )
            except ResidnetError as error:
                self.exclusion_reasons[path] = str(error)
        if not usable_logs:
            raise DataError(group_problems(self.exclusion_reasons)[0])
        unique_names = {log.name for log in remove_copies(list(usable_logs.values()))}
        copies = [path for path, log in usable_logs.items() if log.name not in unique_names]
        self.exclusion_reasons |= dict.fromkeys(
            copies, "its rows are a copy of part of another log"
        )
        return {path: log for path, log in usable_logs.items() if path not in copies}

    def header_lines(self) -> list[str]:
        """Return the comment lines at the top of the config."""
        lines = [
            "Drafted by `residnet new`. Lines with 'guess' mark values that the logs do not"
            " determine, with the reason of each value: check them before you use the results."
        ]
        labels = label_files(self.exclusion_reasons)
        lines += [
            f"left out: {labels[path]}: {reason}" for path, reason in self.exclusion_reasons.items()
        ]
        if derived_channels := next(iter(self.complete_logs.values())).meta.get("smoothed"):
            lines.append(
                f"{', '.join(derived_channels)} are not measured at every sample: a smoother"
                " estimates them from position and heading. If the antenna is not at the origin of"
                " the vessel, or its positions have a delay, add"
                " prepare.motion: {antenna: {x: ..., y: ...}, delay: ...}."
            )
        if derived_channels := next(iter(self.complete_logs.values())).meta.get("integrated"):
            lines.append(
                f"{', '.join(derived_channels)} are not measured: they are integrated from the"
                " velocities, and so are the errors of position and heading."
            )
        logs_text = "1 log was" if len(self.logs) == 1 else f"{len(self.logs)} logs were"
        log_message(f"{logs_text} read, {len(self.exclusion_reasons)} left out")
        return lines


_SplitEntry = tuple[Any, Log, float]
"""Entry of a split in a config, its log, and the longest usable time in s without a gap."""


def _split_logs(
    draft_logs: _DraftLogs,
    usable_logs: Mapping[Path, Log],
    folder: Path,
    draft_notes: DraftNotes,
    *,
    holds_out_manoeuvres: bool = False,
) -> tuple[str, dict[str, list[_SplitEntry]]]:
    """Return the common folder of the logs and their split.

    Args:
        draft_logs: all logs of the draft.
        usable_logs: usable logs by path.
        folder: folder of the config.
        draft_notes: receives the reason of the split.
        holds_out_manoeuvres: whether few logs are manoeuvres that are held out as a whole.

    Raises:
        DataError: if no usable log is available for a split.
    """
    paths = {log.name: path for path, log in usable_logs.items()}
    common_folder = Path(
        os.path.commonpath([locate_file(path).resolve().parent for path in usable_logs])
    )
    relative_root = os.path.relpath(common_folder, folder.resolve())
    # the path is absolute if the folder is far from the config
    root = (
        common_folder.as_posix()
        if relative_root.count("..") > 2
        else Path(relative_root).as_posix()
    )
    reason = (
        "sorted by manoeuvre, one of five logs is for validation and one for the test, and of eight"
        " logs or more at least three are"
    )
    if splits_from_names(list(usable_logs.values())):
        reason = "folders or files are called after the splits"
    split_entries: dict[str, list[_SplitEntry]] = {split: [] for split in SPLITS}
    held_out_logs = choose_held_out_logs(usable_logs) if holds_out_manoeuvres else None
    if held_out_logs is not None:
        for split, held_out_paths in held_out_logs.items():
            split_entries[split] = [
                (
                    path.resolve().relative_to(common_folder).as_posix(),
                    usable_logs[path],
                    draft_logs.longest_times[path],
                )
                for path in held_out_paths
            ]
        draft_notes.add_guess(
            ("data", "split"),
            "few manoeuvres: the mildest ones are held out as a whole, so that the models are"
            " tested on manoeuvres that they have not seen",
        )
        return root, split_entries
    for split, logs in split_logs(list(usable_logs.values())).items():
        for log in logs:
            segment_limits = log.meta.get("stretch")
            # the name of a segment starts with the name of its log; of several such names the
            # longest is that of the log
            matching_names = [
                n for n in paths if n == log.name or (segment_limits and log.name.startswith(n))
            ]
            path = paths[max(matching_names, key=len)]
            entry: Any = path.resolve().relative_to(common_folder).as_posix()
            duration = draft_logs.longest_times[path]
            if segment_limits:
                reason = "few logs: each is cut in time"
                source = usable_logs[path]
                entry = {"log": entry}
                entry |= (
                    {"from": f"{segment_limits[0]:.13g} s"}
                    if segment_limits[0] > source.t[0]
                    else {}
                )
                entry |= (
                    {"to": f"{segment_limits[1]:.13g} s"}
                    if segment_limits[1] < source.t[-1]
                    else {}
                )
                try:
                    duration = draft_logs.longest_gapless_time(
                        extract_segment(draft_logs.logs[path], *segment_limits)
                    )
                except DataError:
                    duration = 0.0
            if duration:
                split_entries[split].append((entry, log, duration))
            else:
                text = f"{log.name} is left out: no segment without a gap is long enough"
                draft_notes.add_note(("data", "split"), text)
        if logs and not split_entries[split]:
            raise DataError(
                f"the logs hold nothing for {split}: in {', '.join(log.name for log in logs)[:120]}"
                " no stretch without a gap is as long as the window of the derivative; fill gaps"
                " that may be interpolated, or give longer logs"
            )
    draft_notes.add_guess(
        ("data", "split"), f"{reason}; logs of one day may be similar, so check the split"
    )
    return root, split_entries


def _move_short_logs_to_training(
    split_entries: dict[str, list[_SplitEntry]], correlation_time: float, draft_notes: DraftNotes
) -> None:
    """Move logs that are too short for evaluation to the training split, except the last log."""
    from residnet.identification.recipe import choose_window_length, make_protocols

    for name in SPLITS[1:]:
        protocol_settings = make_protocols(
            choose_window_length([time for *_, time in split_entries[name]], correlation_time)
        ).values()
        shortest = 1.2 * min(float(entry["length"].split()[0]) for entry in protocol_settings)
        for split_entry in list(split_entries[name]):
            if split_entry[2] < shortest and len(split_entries[name]) > 1:
                split_entries[name].remove(split_entry)
                split_entries["train"].append(split_entry)
                draft_notes.add_note(
                    ("data", "split"), f"{split_entry[1].name} is too short for an evaluation"
                )


def _choose_signals(
    inputs: Sequence[str],
    unexcited: Mapping[str, str],
    dof: DegreesOfFreedom,
    wind_channels: Sequence[str],
    draft_notes: DraftNotes,
) -> dict[str, list[str]]:
    """Return the section `signals` of a config.

    Args:
        unexcited: reason for each unexcited input.
    """
    signals = {"inputs": list(inputs)}
    if not dof.is_planar:
        signals["velocities"] = list(dof.velocities)
        draft_notes.add_guess(("signals", "velocities"), dof.description)
    if wind_channels:
        signals["exogenous"] = list(wind_channels)
    if unexcited:
        signals["unexcited"] = list(unexcited)
        draft_notes.add_note(("signals", "unexcited"), "; ".join(unexcited.values()))
    return signals

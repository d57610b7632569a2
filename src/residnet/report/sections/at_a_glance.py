"""Facts of the first screen of a fit: reference, evidence, domain, next step, file to export."""

from __future__ import annotations

from collections import Counter
from pathlib import PurePosixPath
from typing import NamedTuple

from residnet.core.format import (
    format_count,
    format_interval,
    format_number,
    format_seconds,
    join_list,
)
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.run_records import ExportsFile
from residnet.evaluation.limits_records import HorizonRow
from residnet.evaluation.verdict import (
    DO_NOT_USE,
    GOOD_LEVEL,
    TOO_FEW_WINDOWS,
    VerdictEvidence,
    advise_intermediate_steps,
    contradicts_positions,
    format_pose_error,
    is_better_than_constant_velocity,
    list_relay_inputs,
    list_unidentifiable_inputs,
    main_horizon,
    rate_model,
)
from residnet.quality import summarize_inspection
from residnet.report.blocks import Facts, Section
from residnet.report.run_reader import RunFiles
from residnet.report.sections.verdict import collect_evidence

_UNKNOWN_MANOEUVRE = "unknown"
_MAX_KINDS = 5
"""Largest number of kinds of manoeuvres that are listed."""


def facts_section(run: RunFiles) -> Section | None:
    """Return the facts between the verdict and the picture; None without free runs.

    The facts are the comparison with constant velocity, the test data, the training data, the
    operating domain, the next step, and the file for a controller.
    """
    main_model = run.main_model
    if run.find_row(main_model, run.report_split, run.main_protocol) is None:
        return None
    evidence = collect_evidence(run, main_model)
    facts = [
        ("Constant velocity", _compare_with_constant_velocity(evidence)),
        ("Evaluated on", _describe_evaluation_data(run)),
        ("Fitted to", _describe_training_data(run)),
        ("Operating domain", _describe_operating_domain(run, evidence)),
        ("Next step", _recommend_next_step(run, evidence)),
        ("For a controller", _describe_export(run, evidence)),
    ]
    return Section("", [Facts([(name, text) for name, text in facts if text])])


class _Comparison(NamedTuple):
    """Comparison of one pose error with the error of constant velocity.

    Attributes:
        text: both errors with a remark.
        is_better: whether the error is smaller, and significantly so.
    """

    text: str
    is_better: bool


def _compare_with_constant_velocity(evidence: VerdictEvidence) -> str:
    """Return whether the model has smaller pose errors than constant velocity, with both errors."""
    main = main_horizon(evidence)
    if main is None or evidence.selected == CONSTANT_VELOCITY:
        return ""
    reference = main.row.models.get(CONSTANT_VELOCITY)
    if reference is None:
        return ""
    comparisons = [
        _compare_error(evidence, main.row, error_name, error)
        for error_name, error in reference.by_name.items()
    ]
    summary = "better" if all(row.is_better for row in comparisons) else "not shown to be better"
    return (
        f"The model is {summary} than holding the initial velocities:"
        f" {'; '.join(row.text for row in comparisons)}."
    )


def _compare_error(
    evidence: VerdictEvidence, row: HorizonRow, error_name: str, reference_error: float
) -> _Comparison:
    """Compare a pose error of the model at a horizon with the error of constant velocity."""
    model_errors = row.models[evidence.selected]
    error = model_errors.by_name[error_name]
    is_better = is_better_than_constant_velocity(evidence, row, error_name)
    if error >= reference_error:
        remark = " (not smaller)"
    elif is_better:
        remark = ""
    elif model_errors.intervals[error_name] is None:
        remark = " (too few logs for a test)"
    else:
        remark = " (not significant)"
    text = (
        f"{error_name} {format_pose_error(error_name, error)} instead of"
        f" {format_pose_error(error_name, reference_error)}{remark}"
    )
    return _Comparison(text, is_better and error < reference_error)


def _describe_evaluation_data(run: RunFiles) -> str:
    """Return number, length and kinds of manoeuvres of the free runs of the verdict."""
    logs = [log for log in run.quality if log.split == run.report_split]
    counts = Counter(log.manoeuvre.replace("_", " ") for log in logs)
    horizon = run.main_horizon
    row = run.find_row(run.main_model, run.report_split, run.main_protocol)
    assert row is not None, "checked by the caller"
    n_windows = row.windows if horizon is None else horizon.windows
    length = "" if horizon is None else f" of {format_seconds(horizon.seconds)}"
    text = f"{format_count(n_windows, 'free run')}{length}"
    text += (
        f" on {format_count(len(logs), f'{run.report_split} log')}"
        if logs
        else f" ({run.report_data_name})"
    )
    frequent_kinds = counts.most_common(_MAX_KINDS)
    if set(counts) == {_UNKNOWN_MANOEUVRE}:
        text += "; kinds of manoeuvres are not recorded"
    elif frequent_kinds:
        kinds = [f"{kind} ({count})" for kind, count in frequent_kinds]
        n_other = len(counts) - len(frequent_kinds)
        text += f": {join_list([*kinds, *([f'{n_other} other kinds'] if n_other else [])])}"
    if horizon is not None and "position" in horizon.models[run.main_model].by_name:
        speeds = format_interval((horizon.slowest, horizon.fastest), digits=2)
        text += f"; mean speeds {speeds} m/s"
    return f"{text}."


def _describe_training_data(run: RunFiles) -> str:
    """Return number and duration of the training logs; empty if they are unknown."""
    logs = [log for log in run.quality if log.split == "train"]
    if not logs:
        return ""
    seconds = sum(log.seconds for log in logs)
    duration = (
        f"{format_number(seconds / 60.0, 2)} minutes"
        if seconds >= 120.0
        else f"{format_number(seconds, 2)} s"
    )
    n_validation = sum(log.split == "validation" for log in run.quality)
    selection = f"; {format_count(n_validation, 'validation log')}" if n_validation else ""
    return f"{format_count(len(logs), 'training log')}, {duration}{selection}."


def _describe_operating_domain(run: RunFiles, evidence: VerdictEvidence) -> str:
    """Return the training range of each velocity and input, and relations of the inputs.

    Empty if the ranges are unknown.
    """
    ranges = run.describe_training_ranges(run.main_model)
    relations = () if evidence.excitation is None else evidence.excitation.domain
    # the report has the complete sentences among the reasons
    facts = [", ".join(ranges), *(sentence.partition(":")[0] for sentence in relations)]
    scope = "errors outside, and under other kinds of commands than in the logs, are unknown"
    return f"{'; '.join(facts)}; {scope}." if ranges else ""


def _recommend_next_step(run: RunFiles, evidence: VerdictEvidence) -> str:
    """Return the one thing to do next, by the most severe obstacle to the use of the model."""
    level = rate_model(evidence)
    main = main_horizon(evidence)
    if run.inspection is not None and run.inspection.logs:
        first_action = summarize_inspection(run.inspection).first_action
        if first_action:
            return f"{first_action} Then run the fit again."
    if main is not None and contradicts_positions(main.row):
        return (
            "Correct frames, units and clocks of the logs, because the measured velocities do not"
            " reproduce the measured track (`residnet inspect`). Then run the fit again."
        )
    if list_unidentifiable_inputs(evidence):
        return (
            "Record logs in which these inputs vary independently of the motion, such as zigzags"
            " or random steps (`residnet plan-trial RUN` proposes trials)."
        )
    if level == TOO_FEW_WINDOWS:
        return (
            "Record more test logs, or longer ones, and run `residnet evaluate RUN LOGS` (RUN is"
            " this folder)."
        )
    if level == GOOD_LEVEL and (inputs := list_relay_inputs(evidence)):
        steps = advise_intermediate_steps(join_list(list(inputs)))
        return f"Add logs of {steps}, and run the fit again."
    if level == GOOD_LEVEL:
        return "Test your controller in simulation with the exported model."
    if level == DO_NOT_USE:
        return (
            "Record more logs of such manoeuvres and run the fit again; a training set of other"
            " manoeuvres may also help."
        )
    return (
        "Record more logs of such manoeuvres and run the fit again: the upper limits decrease with"
        " the number of test logs."
    )


def _describe_export(run: RunFiles, evidence: VerdictEvidence) -> str:
    """Return the exported file, or the command that exports the model of the verdict."""
    if not (run.path / "models" / run.main_model).is_dir():
        return ""
    if rate_model(evidence) == DO_NOT_USE:
        return "None: this model is not exported unless you add `--anyway`."
    single = (
        f"; `--model selected` exports {run.selected}, the single model, which is smaller"
        if run.selected != run.main_model and run.selected != CONSTANT_VELOCITY
        else ""
    )
    exports = ExportsFile.read_optional(run.path, "exports.json")
    # an export may name the model by its role
    names = {run.main_model, "predictor"} | (
        {"selected"} if run.selected == run.main_model else set()
    )
    files = [
        f"`exports/{PurePosixPath(row.file).name}`"
        for row in (() if exports is None else exports.exports)
        if row.file and row.model in names
    ]
    if files:
        return f"{join_list(files)}; as C source: `residnet export RUN --format c`{single}."
    return f"`residnet export RUN --format c` writes {run.main_model} as C source{single}."

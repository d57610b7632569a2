"""Verdict on the selected model of a fit in sentences, from the files of the run folder."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from residnet.core.format import (
    display_unit,
    format_count,
    format_interval,
    format_minus_signs,
    format_number,
    format_seconds,
    join_list,
)
from residnet.core.model_names import CONSTANT_VELOCITY, PLANT
from residnet.core.names import POSE_ERROR_UNITS
from residnet.evaluation.data_records import ExcitationFile
from residnet.evaluation.limits_records import HorizonRow, PoseErrors, ProtocolLimits
from residnet.evaluation.records import MetricsRow, PairedDifference, SelectionFile

UNSEEN_SPLITS = ("test", "external")
"""Splits that are not used in a fit."""


def order_protocols(
    rows: Sequence[MetricsRow],
    split: str,
    selection_protocol: str,
    fixed_length: Collection[str] = (),
) -> list[str]:
    """Return the protocols of rows, first the main one of a split.

    The main protocol has enough windows for a rating, and windows of equal length, so that all its
    free runs have one horizon. Among such protocols it is that of the model selection.

    Args:
        rows: rows of metrics.json.
        split: the split.
        selection_protocol: protocol of the model selection; empty without a selection.
        fixed_length: names of the protocols with windows of equal length.
    """
    protocol_names = dict.fromkeys(row.protocol for row in rows)
    n_windows = {
        row.protocol: row.windows for row in rows if row.split == split and row.manoeuvre == "all"
    }
    protocols_of_split = {row.protocol for row in rows if row.split == split}
    return sorted(
        protocol_names,
        key=lambda protocol_name: (
            protocol_name not in protocols_of_split,
            n_windows.get(protocol_name, 0) < _MIN_WINDOWS,
            protocol_name not in fixed_length,
            protocol_name != selection_protocol,
        ),
    )


@dataclass(frozen=True)
class VerdictEvidence:
    """Data of a verdict.

    Attributes:
        selected: name of the selected model.
        split: split of the free runs.
        rows_by_model: rows of metrics.json under one protocol over all manoeuvres of the split.
        baseline: name of the first baseline; empty for none.
        selection: contents of selection.json; None without a selection.
        limits_by_protocol: contents of limits.json for the split by protocol; may be empty.
        data_quality_text: one sentence on the data checks; empty without them.
        protocol: main protocol, that of the rows.
        one_sided_text: finding of the data checks on logs without turns to both sides; free runs on
            such logs cannot validate the turning motion.
        excitation: contents of excitation.json; None for runs of earlier versions.
        n_logs: number of logs of the free runs; 0 if unknown.
        n_logs_of_fit: number of them that are among the data of the fit, by their SHA-256.
        current_text: one sentence on the currents of the logs; empty without an estimate.
    """

    selected: str
    split: str
    rows_by_model: Mapping[str, MetricsRow]
    baseline: str = ""
    selection: SelectionFile | None = None
    limits_by_protocol: Mapping[str, ProtocolLimits] = field(default_factory=dict)
    data_quality_text: str = ""
    protocol: str = ""
    one_sided_text: str = ""
    excitation: ExcitationFile | None = None
    n_logs: int = 0
    n_logs_of_fit: int = 0
    current_text: str = ""

    @property
    def data_name(self) -> str:
        """Name of the data in sentences; logs that trained the model are not external."""
        if self.n_logs_of_fit and self.n_logs_of_fit == self.n_logs:
            return "data of the fit"
        return f"{self.split} data"

    @property
    def logs_of_fit_text(self) -> str:
        """Limitation by logs that trained the model; empty if there are none."""
        if not self.n_logs_of_fit:
            return ""
        return (
            f"{self.n_logs_of_fit} of {format_count(self.n_logs, 'log')} trained the model (same"
            " SHA-256), so that the errors do not show how well it predicts new data"
        )


LEVEL_TEXTS = {
    "good": "✓ Good",
    "limited": "! Limited",
    "do not use": "✗ Do not use",
    "too few windows": "? Too few windows to say",
}
"""Levels of use of the selected model with their labels, the best first.

The last level means that there are too few data. Styles of the page define their appearance.
"""
GOOD_LEVEL, LIMITED_LEVEL, DO_NOT_USE, TOO_FEW_WINDOWS = LEVEL_TEXTS
_MIN_WINDOWS = 5
"""Smallest number of windows for a rating of a model."""
MIN_LOGS_FOR_INTERVAL = 3
"""Smallest number of logs for an interval, and therefore for a rating."""
_MAX_DISTANCE_SHARE = 0.10
"""Largest position error of a good model, as a share of the distance travelled.

The same limit applies to the noise floor: beyond it velocities and positions are not one motion.
"""
_MAX_ANGLE_ERROR = math.radians(10.0)
"""Largest heading error of a good model in rad.

Both limits apply to the upper limit of the prediction interval. The values are a convention of
residnet, and the verdict states them.
"""
_MAX_LIMITED_DISTANCE_SHARE = 0.25
"""Largest position error of a model of limited use, as a share of the distance travelled."""
_MAX_LIMITED_ANGLE_ERROR = math.radians(30.0)
"""Largest heading error of a model of limited use in rad."""
_POSE_ERROR_SUFFIXES = {"depth": " of depth", "attitude": " of attitude"}
"""Suffixes of pose errors other than horizontal position and heading."""
_MAX_RATIO_TO_BEST = 1.5
"""Largest ratio of the error of a good model to that of the best model of the run."""
_MIN_SHARE_OF_WINDOWS = 0.5
"""Smallest share of the windows of the main protocol that reach the main horizon."""


def write_verdict(evidence: VerdictEvidence) -> list[str]:
    """Return the verdict sentence by sentence, the most important first.

    Position and heading errors of the selected model at the main horizon, the reasons for its
    level and the commands for which it holds, findings of the data checks, reference models and
    noise floor, other horizons, number of windows and range of speeds, velocity errors, failed
    checks, reason of the selection, heads that diverged, and the share of data outside the training
    range. Sentences without data are omitted.
    """
    main = main_horizon(evidence)
    limitation_sentences = [
        f"The rating is at most limited, because {limitation}."
        for limitation in list_limitations(evidence)
    ]
    sentences = [
        *(
            [compare_velocity_errors(evidence), *limitation_sentences]
            if main is None
            else describe_main_horizon(evidence, main)
        ),
        "" if is_useless(evidence) else describe_relays(evidence),
        evidence.data_quality_text,
        describe_unexcited(evidence),
        evidence.current_text,
        *([] if main is None else describe_references(evidence, main)),
        "" if main is None or is_useless(evidence) else compare_velocity_errors(evidence),
        describe_soundness(evidence),
        "" if evidence.selection is None else evidence.selection.reason,
        *([] if evidence.selection is None else describe_diverged_heads(evidence.selection)),
        describe_extrapolation(evidence),
        describe_distance(evidence),
    ]
    return [sentence for sentence in sentences if sentence]


def rate_model(evidence: VerdictEvidence) -> str:
    """Return the level at the main horizon, a key of `LEVEL_TEXTS`.

    Empty if the selected model has no free runs. Without known pose errors, a model whose velocity
    errors are smaller than those of constant velocity is of limited use.
    """
    if is_useless(evidence):
        return DO_NOT_USE
    if evidence.selected not in evidence.rows_by_model:
        return ""
    main = main_horizon(evidence)
    return LIMITED_LEVEL if main is None else rate_horizon(evidence, main.row)


def rate_horizon(evidence: VerdictEvidence, row: HorizonRow) -> str:
    """Return the level of the selected model at one horizon, a key of `LEVEL_TEXTS`."""
    if is_useless(evidence):
        return DO_NOT_USE
    if not _is_sufficient(row, evidence.selected):
        return TOO_FEW_WINDOWS
    if list_shortfalls_of_limited(evidence, row):
        return DO_NOT_USE
    if list_shortfalls_of_good(evidence, row) or list_limitations(evidence):
        return LIMITED_LEVEL
    return GOOD_LEVEL


def list_limitations(evidence: VerdictEvidence) -> list[str]:
    """Return facts on the logs by which no model is rated good at any horizon."""
    limitations = [
        evidence.logs_of_fit_text,
        evidence.one_sided_text,
        *list_unidentifiable_inputs(evidence),
    ]
    return [limitation for limitation in limitations if limitation]


def list_unidentifiable_inputs(evidence: VerdictEvidence) -> list[str]:
    """Return the inputs whose effect the training logs cannot identify, each with the reason.

    Free runs on logs of the same kind cannot reveal a wrong effect: a controller repeats the
    relation of the input to the motion, and collinear inputs remain collinear.
    """
    return [
        f"the effect of {row.name} cannot be identified: {row.text}"
        for row in (() if evidence.excitation is None else evidence.excitation.inputs)
        if row.state in ("feedback", "collinear")
    ]


def list_relay_inputs(evidence: VerdictEvidence) -> tuple[str, ...]:
    """Return the inputs that the training logs only switch between the ends of their ranges."""
    return () if evidence.excitation is None else evidence.excitation.relay_inputs


def describe_relays(evidence: VerdictEvidence) -> str:
    """Return for which commands the errors are shown, if logs only switch an input; may be empty.

    A zigzag hardly holds a steady turn, so that its errors do not show those of other commands.
    """
    if not (inputs := list_relay_inputs(evidence)):
        return ""
    names = join_list(list(inputs))
    return (
        f"The training logs only switch {names} between the ends of its range, as zigzags and"
        " 3-2-1-1 do: under other commands errors may exceed the prediction intervals. Add logs of"
        f" {advise_intermediate_steps(names)}."
    )


def advise_intermediate_steps(name: str) -> str:
    """Return the manoeuvre that zigzags of an input lack."""
    return (
        f"steps of {name} to a quarter, a half and three quarters of its range, each held until the"
        " motion is steady"
    )


def describe_unexcited(evidence: VerdictEvidence) -> str:
    """Return sentences on the limits of the operating domain; empty if there are none.

    They name directions that were not excited, inputs that were held, and test logs that a
    controller steered.
    """
    excitation = evidence.excitation
    if excitation is None:
        return ""
    directions = [row.text for row in excitation.directions if not row.is_excited]
    held_inputs = [row.text for row in excitation.inputs if row.state == "held"]
    sentences = [f"{text[0].upper()}{text[1:]}." for text in (*directions, *held_inputs)]
    sentences += excitation.domain
    if controlled := excitation.closed_loop_test_inputs:
        sentences.append(
            "Shown for operation under the same controller only: in the"
            f" {evidence.split} logs feedback sets {join_list(list(controlled))}."
        )
    return " ".join(sentences)


class ProtocolHorizon(NamedTuple):
    """Pose errors at a horizon, and the protocol whose windows gave them."""

    protocol: str
    row: HorizonRow


def known_horizons(evidence: VerdictEvidence) -> list[ProtocolHorizon]:
    """Return the horizons with known errors of the selected model, in ascending order.

    A horizon of the main protocol has the free runs of the verdict; a horizon that only other
    protocols have is that of the protocol with the most windows.
    """
    horizons: dict[float, ProtocolHorizon] = {}
    # the main protocol comes first, so that others only add horizons
    for protocol in sorted(evidence.limits_by_protocol, key=lambda name: name != evidence.protocol):
        for row in evidence.limits_by_protocol[protocol].horizons:
            if evidence.selected not in row.models:
                continue
            known_horizon = horizons.get(row.seconds)
            if known_horizon is None or (
                known_horizon.protocol != evidence.protocol
                and row.windows > known_horizon.row.windows
            ):
                horizons[row.seconds] = ProtocolHorizon(protocol, row)
    return [horizons[seconds] for seconds in sorted(horizons)]


def main_horizon(evidence: VerdictEvidence) -> ProtocolHorizon | None:
    """Return the horizon of badge, first sentence, table and picture; None without pose errors."""
    return find_main_horizon(evidence.limits_by_protocol, evidence.protocol, evidence.selected)


def find_main_horizon(
    limits_by_protocol: Mapping[str, ProtocolLimits], protocol: str, model: str
) -> ProtocolHorizon | None:
    """Return the longest horizon of the main protocol that at least half of its windows reach.

    This is the length of the windows if these are equally long. Horizons with enough data are
    preferred. None if the errors of the model are unknown.

    Args:
        limits_by_protocol: contents of limits.json for a split.
        protocol: the main protocol.
        model: the model of the verdict.
    """
    limits = limits_by_protocol.get(protocol)
    rows = [] if limits is None else [row for row in limits.horizons if model in row.models]
    if not rows:
        return None
    min_windows = _MIN_SHARE_OF_WINDOWS * max(row.windows for row in rows)
    frequent_rows = [row for row in rows if row.windows >= min_windows]
    sufficient_rows = [row for row in frequent_rows if _is_sufficient(row, model)]
    longest = max(sufficient_rows or frequent_rows, key=lambda row: row.seconds)
    return ProtocolHorizon(protocol, longest)


def _is_sufficient(row: HorizonRow, model: str) -> bool:
    """Return whether a horizon has enough windows, and logs for an interval, for a rating."""
    return all(row.models[model].intervals.values()) and row.windows >= _MIN_WINDOWS


def _protocol_limits(evidence: VerdictEvidence) -> ProtocolLimits | None:
    """Return the entry of limits.json for the protocol of the rows; None without one."""
    return evidence.limits_by_protocol.get(evidence.protocol)


def list_shortfalls_of_good(evidence: VerdictEvidence, row: HorizonRow) -> list[str]:
    """Return the criteria of a good model that the selected model does not meet at a horizon.

    The horizon must have enough data for a rating.
    """
    shortfalls = list_shortfalls(evidence, row, _MAX_DISTANCE_SHARE, _MAX_ANGLE_ERROR, GOOD_LEVEL)
    selected_row = evidence.rows_by_model[evidence.selected]
    # one divergence on unseen data excludes the model at any horizon
    if selected_row.diverged and evidence.split in UNSEEN_SPLITS:
        shortfalls.append(f"{selected_row.diverged} of {selected_row.windows} free runs diverged")
    if contradicts_positions(row):
        floor = row.floor.position or 0.0
        shortfalls.append(
            "the measured velocities do not reproduce the measured track: integrated over"
            f" {format_seconds(row.seconds)} they deviate by {format_number(floor, 2)} m"
            f" ({100.0 * floor / row.sailed:.0f} % of the distance travelled;"
            f" good: at most {100.0 * _MAX_DISTANCE_SHARE:.0f} %); check frames, units and clocks"
        )
    plant_models = {name for name, other in evidence.rows_by_model.items() if other.kind == PLANT}
    errors_by_model = {name: errors.by_name for name, errors in row.models.items()}
    # the errors of the plant itself, started from noisy measured states, are also a noise floor
    noise_floors = [
        row.floor.by_name,
        *(errors_by_model[name] for name in plant_models & set(errors_by_model)),
    ]
    rival_models = set(errors_by_model) - {evidence.selected} - plant_models
    for error_name, error in errors_by_model[evidence.selected].items():
        # differences near the noise floor are not the fault of a model
        twice_noise_floor = 2.0 * max(floor[error_name] for floor in noise_floors)
        best_model = min(
            rival_models,
            key=lambda name: (errors_by_model[name][error_name], name),
            default=evidence.selected,
        )
        best_error = errors_by_model[best_model][error_name]
        # a model that is far worse than another one of the run should not be called good
        if error > max(twice_noise_floor, _MAX_RATIO_TO_BEST * best_error):
            shortfalls.append(
                f"its {error_name} error is {format_number(error / best_error, 2)} times that of"
                f" {best_model}"
            )
    return shortfalls


def list_shortfalls_of_limited(evidence: VerdictEvidence, row: HorizonRow) -> list[str]:
    """Return the criteria of a model of limited use that the selected model does not meet.

    The horizon must have enough data for a rating.
    """
    return list_shortfalls(
        evidence, row, _MAX_LIMITED_DISTANCE_SHARE, _MAX_LIMITED_ANGLE_ERROR, LIMITED_LEVEL
    )


def list_shortfalls(
    evidence: VerdictEvidence,
    row: HorizonRow,
    max_distance_share: float,
    max_angle_error: float,
    level: str,
) -> list[str]:
    """Return which pose errors are too large for a level, or not better than constant velocity.

    Args:
        evidence: data of the verdict.
        row: the horizon.
        max_distance_share: limit of errors in m, as a share of the distance travelled.
        max_angle_error: limit of errors in rad.
        level: name of the level in the texts.
    """
    shortfalls = []
    for error_name, interval in row.models[evidence.selected].intervals.items():
        assert interval is not None, "checked by _is_sufficient"
        if not is_better_than_constant_velocity(evidence, row, error_name):
            shortfalls.append(
                f"its {error_name} error is not significantly smaller than that of constant"
                " velocity"
            )
        is_angle = POSE_ERROR_UNITS[error_name] == "rad"
        if interval[1] > (max_angle_error if is_angle else max_distance_share * row.sailed):
            share_text = (
                ""
                if is_angle
                else f", {format_number(100.0 * interval[1] / row.sailed, 2)} % of the distance"
                " travelled"
            )
            limit_text = (
                f"{math.degrees(max_angle_error):.0f} deg"
                if is_angle
                else f"{100.0 * max_distance_share:.0f} %"
            )
            shortfalls.append(
                f"the upper limit of its {error_name} error is"
                f" {format_pose_error(error_name, interval[1])}{share_text}"
                f" ({level}: at most {limit_text})"
            )
    return shortfalls


def is_better_than_constant_velocity(
    evidence: VerdictEvidence, row: HorizonRow, error_name: str
) -> bool:
    """Return whether a pose error is significantly smaller than that of constant velocity.

    Without a confidence interval of the difference, the prediction intervals must not overlap. True
    without a constant-velocity model.
    """
    reference_errors = row.models.get(CONSTANT_VELOCITY)
    if reference_errors is None or evidence.selected == CONSTANT_VELOCITY:
        return True
    changes = row.change_from_constant_velocity.get(evidence.selected, {})
    if (interval := changes.get(error_name)) is not None:
        return interval[1] < 0.0
    selected_interval = row.models[evidence.selected].intervals[error_name]
    reference_interval = reference_errors.intervals[error_name]
    if selected_interval is None or reference_interval is None:
        return False
    return selected_interval[1] < reference_interval[0]


def contradicts_positions(row: HorizonRow) -> bool:
    """Return whether the noise floor exceeds a tenth of the distance travelled.

    Then velocities and positions are not one motion, and no model is good by them.
    """
    return (row.floor.position or 0.0) > _MAX_DISTANCE_SHARE * row.sailed


def describe_main_horizon(evidence: VerdictEvidence, main: ProtocolHorizon) -> list[str]:
    """Return the errors of the selected model at the main horizon, and the reasons for its level.

    Args:
        evidence: data of the verdict.
        main: the main horizon.
    """
    row = main.row
    scope_text = " with commands like those in the logs" if list_relay_inputs(evidence) else ""
    errors_text = (
        f"After a {format_seconds(row.seconds)} free run{scope_text}"
        f" {_describe_errors(evidence.selected, row)}."
    )
    error_names = list(row.models[evidence.selected].by_name)
    both_errors = f"{join_list(error_names)} errors"
    level = rate_horizon(evidence, row)
    if evidence.selected == CONSTANT_VELOCITY or is_useless(evidence):
        return [errors_text, f"Do not use: {_explain_uselessness(evidence)}."]
    if level == TOO_FEW_WINDOWS:
        return [
            errors_text,
            f"Too few {evidence.data_name} for a rating: {format_count(row.windows, 'free run')}"
            f" of {format_count(row.logs, 'log')}. A rating needs at least {_MIN_WINDOWS} free runs"
            f" of {MIN_LOGS_FOR_INTERVAL} logs.",
        ]
    shorter_text = _describe_shorter_horizons(evidence, row)
    if level == DO_NOT_USE:
        shortfalls = list_shortfalls_of_limited(evidence, row)
        return [errors_text, f"Do not use{shorter_text}: {'; '.join(shortfalls)}."]
    if shortfalls := [*list_shortfalls_of_good(evidence, row), *list_limitations(evidence)]:
        return [errors_text, f"Limited{shorter_text}: {'; '.join(shortfalls)}."]
    limits_by_unit = {
        "m": f"{100.0 * _MAX_DISTANCE_SHARE:.0f} % of the distance travelled",
        "rad": f"{math.degrees(_MAX_ANGLE_ERROR):.0f} deg",
    }
    limits = dict.fromkeys(limits_by_unit[POSE_ERROR_UNITS[name]] for name in error_names)
    comparison = (
        f", {both_errors} significantly smaller than those of constant velocity"
        if CONSTANT_VELOCITY in row.models
        else ""
    )
    return [
        errors_text,
        f"Good{' for such commands' if scope_text else ''}: upper limits within"
        f" {join_list(list(limits))}{comparison}, no divergence.",
    ]


def _describe_shorter_horizons(evidence: VerdictEvidence, row: HorizonRow) -> str:
    """Return up to which shorter horizons a better level than at this one holds; may be empty.

    A level holds up to a horizon if no shorter one has a worse level.
    """
    levels = list(LEVEL_TEXTS)
    ranks = [
        (horizon.row.seconds, levels.index(rate_horizon(evidence, horizon.row)))
        for horizon in known_horizons(evidence)
        if horizon.row.seconds < row.seconds and _is_sufficient(horizon.row, evidence.selected)
    ]
    texts = []
    previous_seconds = 0.0
    for rank in range(levels.index(rate_horizon(evidence, row))):
        n_holding = next((i for i, (_, other) in enumerate(ranks) if other > rank), len(ranks))
        seconds = ranks[n_holding - 1][0] if n_holding else 0.0
        if seconds > previous_seconds:
            texts.append(f"{levels[rank]} up to {format_seconds(seconds)}")
            previous_seconds = seconds
    if not texts:
        return ""
    return f" for {format_seconds(row.seconds)}, {join_list(texts)}"


def _describe_errors(model: str, row: HorizonRow) -> str:
    """Return a clause with the pose errors of a model, each with its prediction interval."""
    texts: list[str] = []
    errors = row.models[model]
    for error_name, error in errors.by_name.items():
        unit, factor = display_unit(POSE_ERROR_UNITS[error_name])
        details = []
        if interval := errors.intervals[error_name]:
            details.append(
                f"95 % prediction interval {format_interval(interval, factor, 2)} {unit}"
            )
        if error_name == "position" and row.sailed > 0.0:
            details.append(
                f"{format_number(100.0 * error / row.sailed, 2)} % of the"
                f" {format_number(row.sailed, 2)} m travelled"
            )
        text = (
            f"the {error_name} error{'' if texts else f' of {model}'} is"
            f" {format_number(factor * error, 2)} {unit}"
        )
        texts.append(text + (f" ({'; '.join(details)})" if details else ""))
    return join_list(texts)


def describe_references(evidence: VerdictEvidence, main: ProtocolHorizon) -> list[str]:
    """Return the errors of the reference models, those at other horizons, and the free runs.

    Args:
        evidence: data of the verdict.
        main: the main horizon.
    """
    row = main.row
    reference_labels = {CONSTANT_VELOCITY: "constant velocity", evidence.baseline: "baseline"}
    references = [
        f"{label} {_format_errors_with_intervals(row.models[name])}"
        for name, label in reference_labels.items()
        if name in row.models and name != evidence.selected
    ]
    # a pose that was itself integrated from the velocities has only rounding errors
    if any(error > 1e-9 for error in row.floor.by_name.values()):
        references.append(
            f"noise floor (measured velocities, integrated) {_format_pose_errors(row.floor)}"
        )
    other_horizons = [
        f"{_format_pose_errors(horizon.row.models[evidence.selected])} after"
        f" {format_seconds(horizon.row.seconds)} ({rate_horizon(evidence, horizon.row)})"
        for horizon in known_horizons(evidence)
        if horizon.row.seconds != row.seconds
    ]
    speeds = (
        f" at mean speeds of {format_number(row.slowest, 2)} to {format_number(row.fastest, 2)} m/s"
        if "position" in row.models[evidence.selected].by_name
        else ""
    )
    spread = (
        f"; the spread between {row.logs_of_spread} logs of all splits determines the prediction"
        " intervals"
        if row.logs_of_spread > row.logs
        else ""
    )
    has_intervals = any(any(errors.intervals.values()) for errors in row.models.values())
    interval_level = " (95 % prediction intervals)" if has_intervals else ""
    scope = " The intervals hold for commands of the kind in these logs." if has_intervals else ""
    return [
        f"Reference models{interval_level}: {'; '.join(references)}." if references else "",
        f"Other horizons: {'; '.join(other_horizons)}." if other_horizons else "",
        f"The errors are means of {format_count(row.windows, 'free run')} ({main.protocol}) of"
        f" {format_count(row.logs, 'log')}{speeds}{spread}.{scope}",
    ]


def format_pose_error(error_name: str, error: float) -> str:
    """Return a pose error (key of `POSE_ERROR_UNITS`) with its unit."""
    unit, unit_factor = display_unit(POSE_ERROR_UNITS[error_name])
    return (
        f"{format_number(unit_factor * error, 2)} {unit}{_POSE_ERROR_SUFFIXES.get(error_name, '')}"
    )


def _format_pose_errors(errors: PoseErrors) -> str:
    return join_list([format_pose_error(name, error) for name, error in errors.by_name.items()])


def _format_errors_with_intervals(errors: PoseErrors) -> str:
    """Return errors of position and heading, each with the limits of its prediction interval."""
    texts: list[str] = []
    for error_name, error in errors.by_name.items():
        interval = errors.intervals[error_name]
        factor = display_unit(POSE_ERROR_UNITS[error_name]).factor
        limits = f" ({format_interval(interval, factor, 2)})" if interval else ""
        texts.append(format_pose_error(error_name, error) + limits)
    return join_list(texts)


def list_model_objections(evidence: VerdictEvidence) -> list[str]:
    """Return objections to any use of the model, for `residnet.export.base.require_releasable`.

    A model has to be better than its own baseline, and its level must not be "do not use": export
    and report then agree on every model.
    """
    selected_row = evidence.rows_by_model.get(evidence.selected)
    if selected_row is None:
        return []
    objections = [
        f"on {evidence.data_name} its NRMSE is {format_number(selected_row.mean_nrmse)}, that"
        f" of {reference_name}"
        f" {format_number(reference_row.mean_nrmse)}"
        for reference_name in dict.fromkeys((CONSTANT_VELOCITY, evidence.baseline))
        if (reference_row := evidence.rows_by_model.get(reference_name)) is not None
        and selected_row.mean_nrmse > reference_row.mean_nrmse
    ]
    if rate_model(evidence) != DO_NOT_USE:
        return objections
    main = main_horizon(evidence)
    if main is not None and _is_sufficient(main.row, evidence.selected):
        objections += [
            f"in free runs of {format_seconds(main.row.seconds)} on {evidence.data_name}"
            f" {shortfall}"
            for shortfall in list_shortfalls_of_limited(evidence, main.row)
        ]
    return objections or [_explain_uselessness(evidence)]


def is_useless(evidence: VerdictEvidence) -> bool:
    """Return whether the selected model is not shown to be better than constant velocity."""
    selected_row = evidence.rows_by_model.get(evidence.selected)
    constant_velocity_row = evidence.rows_by_model.get(CONSTANT_VELOCITY)
    if evidence.selected == CONSTANT_VELOCITY:
        return True
    if selected_row is None or constant_velocity_row is None:
        return False
    return selected_row.mean_nrmse >= constant_velocity_row.mean_nrmse or _is_indistinguishable(
        evidence, CONSTANT_VELOCITY
    )


def _explain_uselessness(evidence: VerdictEvidence) -> str:
    """Return why the selected model is not shown to be better than constant velocity."""
    if evidence.selected == CONSTANT_VELOCITY:
        candidates = () if evidence.selection is None else evidence.selection.models
        # an unsound model may have smaller errors at short horizons, which needs an explanation
        faults = [f"{row.model} fails: {row.faults[0]}" for row in candidates if row.faults]
        subject = "no sound model" if faults else "no model"
        return "; ".join(
            [
                f"{subject} of this run is better than constant velocity,"
                " which holds the initial velocities of each free run",
                *faults,
            ]
        )
    selected_row = evidence.rows_by_model[evidence.selected]
    reference_nrmse = evidence.rows_by_model[CONSTANT_VELOCITY].mean_nrmse
    comparison = (
        "not significantly smaller than"
        if selected_row.mean_nrmse <= reference_nrmse
        else "larger than"
    )
    return (
        f"on {evidence.data_name} the velocity errors of {evidence.selected}"
        f" (NRMSE {format_number(selected_row.mean_nrmse)}{_diverged_suffix(selected_row)}) are"
        f" {comparison} those of constant velocity ({format_number(reference_nrmse)})"
        f"{_format_paired_interval(evidence, CONSTANT_VELOCITY)}"
    )


def compare_velocity_errors(evidence: VerdictEvidence) -> str:
    """Return a sentence on the velocity errors, against constant velocity and the baseline."""
    model_name = evidence.selected
    data_name = evidence.data_name
    if is_useless(evidence):
        return f"Do not use: {_explain_uselessness(evidence)}."
    selected_row = evidence.rows_by_model.get(model_name)
    if selected_row is None:
        return f"The run holds no free runs of its selected model on {data_name}."
    selected_nrmse = selected_row.mean_nrmse
    comparisons = []
    for reference_name, label in (
        (CONSTANT_VELOCITY, "constant velocity"),
        (evidence.baseline, "the baseline"),
    ):
        reference_row = evidence.rows_by_model.get(reference_name)
        if reference_row is None or reference_name == model_name:
            continue
        percent_change = (
            100.0 * (selected_nrmse / reference_row.mean_nrmse - 1.0)
            if reference_row.mean_nrmse > 0
            else 0.0
        )
        direction = "lower" if percent_change <= 0.0 else "higher"
        comparisons.append(
            f"{abs(percent_change):.0f} % {direction} than those of {label}"
            f"{_format_paired_interval(evidence, reference_name)}"
        )
    error_text = f"NRMSE {format_number(selected_nrmse)}{_diverged_suffix(selected_row)}"
    if not comparisons:
        return f"On {data_name} the velocity errors of {model_name} are {error_text}."
    return (
        f"On {data_name} the velocity errors of {model_name} ({error_text}) are"
        f" {' and '.join(comparisons)}."
    )


def describe_soundness(evidence: VerdictEvidence) -> str:
    """Return the result of the physical checks of the selected model; empty without checks."""
    models = () if evidence.selection is None else evidence.selection.models
    selection_row = next((row for row in models if row.model == evidence.selected), None)
    if selection_row is None or evidence.selected == CONSTANT_VELOCITY:
        return ""
    faults = list(selection_row.faults)
    selected_row = evidence.rows_by_model.get(evidence.selected)
    if selected_row is not None and selected_row.diverged and evidence.split in UNSEEN_SPLITS:
        faults.append(
            f"{selected_row.diverged} of its {selected_row.windows} {evidence.split} windows"
            " diverged"
        )
    if faults:
        return f"It is UNSOUND: {'; '.join(faults)}."
    return "No window diverged, and it passed all physical checks."


_HEAD_FAMILIES = ("closed-form head", "network")
_DIVERGENCE_REMEDIES = {
    "closed-form head": (
        "fit it with choose: free_run or a lower degree or order, or fit mlp or lstm, which are"
        " trained on free runs"
    ),
    "network": "add logs of such motion, or fit plsr with choose: free_run",
}


def describe_diverged_heads(selection: SelectionFile) -> list[str]:
    """Return a sentence for each head that diverged in free runs, if no head was selected.

    The selected model is then not what was asked for. If another head was selected, the reason of
    the selection names diverged heads with a smaller error.
    """
    selected_row = next((row for row in selection.models if row.model == selection.selected), None)
    if selected_row is None or selected_row.family in _HEAD_FAMILIES:
        return []
    return [
        f"{row.model} must not be used alone: {'; '.join(faults)}. {selection.selected} was"
        f" selected instead; to use {row.model}, {_DIVERGENCE_REMEDIES[row.family]}."
        for row in selection.models
        if row.diverged
        and row.family in _HEAD_FAMILIES
        and (faults := [fault for fault in row.faults if "diverged" in fault])
    ]


def describe_extrapolation(evidence: VerdictEvidence) -> str:
    """Return the share of data outside the training range; empty if unknown."""
    limits = _protocol_limits(evidence)
    if limits is None or limits.outside.share is None:
        return ""
    outside_share = limits.outside.share
    if outside_share == 0:
        return f"All {evidence.data_name} lie inside the range of the training data."
    channels = sorted(limits.outside.channels.items(), key=lambda pair: -pair[1])[:3]
    channel_texts = ", ".join(
        f"{name} {_format_percent(channel_share)}" for name, channel_share in channels
    )
    return (
        f"Of the {evidence.data_name}, {_format_percent(outside_share)} lies outside the range"
        f" of the training"
        f" data ({channel_texts}); these runs are the only evidence on the model there."
    )


_NOMINAL_MISS_RATE = 0.05
"""Share of samples outside of 95 % prediction intervals."""


def describe_distance(evidence: VerdictEvidence) -> str:
    """Return a sentence on windows unlike those that calibrated the intervals; may be empty."""
    limits = _protocol_limits(evidence)
    share = 0.0 if limits is None else limits.beyond_calibration.get(evidence.selected, 0.0)
    # fewer windows than the intervals may miss do not change their coverage
    if share <= _NOMINAL_MISS_RATE:
        return ""
    return (
        f"{_format_percent(share)} of the {evidence.split} windows are farther from the training"
        " data than any run that calibrated the prediction intervals; the nominal coverage does"
        " not hold for them."
    )


def describe_divergence(row: MetricsRow) -> str:
    """Return the count of diverged windows of a row, for display next to its error; may be
    empty.
    """
    return f"{row.diverged}/{row.windows} diverged" if row.diverged else ""


def _diverged_suffix(row: MetricsRow) -> str:
    divergence_note = describe_divergence(row)
    return (
        f" ({divergence_note}, which count with the constant-velocity error)"
        if divergence_note
        else ""
    )


def _difference_to(evidence: VerdictEvidence, reference_name: str) -> PairedDifference | None:
    """Return the paired difference to another model; None if it was not computed."""
    limits = _protocol_limits(evidence)
    if limits is None:
        return None
    return limits.compared.get(evidence.selected, {}).get(reference_name)


def _is_indistinguishable(evidence: VerdictEvidence, reference_name: str) -> bool:
    """Return whether the interval of the difference to another model includes zero."""
    difference = _difference_to(evidence, reference_name)
    return difference is not None and difference.ci95 is not None and not difference.excludes_zero


def _format_paired_interval(evidence: VerdictEvidence, reference_name: str) -> str:
    """Return the paired confidence interval of the difference to another model in brackets."""
    difference = _difference_to(evidence, reference_name)
    if difference is None:
        return ""
    if difference.ci95 is None:
        return " (too few logs for a confidence interval)"
    lower, upper = difference.ci95
    suffix = (
        ""
        if difference.excludes_zero
        else ", which includes zero: the difference is not significant"
    )
    bounds = format_minus_signs(f"{lower:+#.3g} to {upper:+#.3g}")
    return f" (paired 95 % confidence interval of the difference {bounds}{suffix})"


def _format_percent(share: float) -> str:
    return f"{format_number(100.0 * share, 2)} %" if share >= 0.001 else "less than 0.1 %"

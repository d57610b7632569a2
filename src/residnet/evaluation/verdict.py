"""Verdict on the selected model of a fit in sentences, from the files of the run folder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from residnet.core.format import (
    display_unit,
    format_count,
    format_interval,
    format_number,
    join_list,
)
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.names import POSE_ERROR_UNITS

JsonObject = Mapping[str, Any]
"""Contents of a JSON object."""

UNSEEN_SPLITS = ("test", "external")
"""Splits that are not used in a fit."""


def order_protocols(rows: Sequence[JsonObject], split: str, selection_protocol: str) -> list[str]:
    """Return the protocols of rows, first the main one of a split.

    The main protocol is that of the model selection, unless the logs of the split are too short.

    Args:
        rows: rows of metrics.json.
        split: the split.
        selection_protocol: protocol of the model selection; empty without a selection.
    """
    protocol_names = dict.fromkeys(row["protocol"] for row in rows)
    protocols_of_split = {row["protocol"] for row in rows if row["split"] == split}
    return sorted(
        protocol_names,
        key=lambda protocol_name: (
            protocol_name not in protocols_of_split,
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
        selection: contents of selection.json; may be empty.
        limits_by_protocol: contents of limits.json for the split by protocol; may be empty.
        data_quality_text: one sentence on the data checks; empty without them.
        protocol: protocol of the rows.
        one_sided_text: finding of the data checks on logs without turns to both sides; free runs on
            such logs cannot validate the turning motion.
        excitation: contents of excitation.json; may be empty.
    """

    selected: str
    split: str
    rows_by_model: Mapping[str, JsonObject]
    baseline: str = ""
    selection: JsonObject = field(default_factory=dict)
    limits_by_protocol: JsonObject = field(default_factory=dict)
    data_quality_text: str = ""
    protocol: str = ""
    one_sided_text: str = ""
    excitation: JsonObject = field(default_factory=dict)


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
_MAX_ANGLE_ERROR = math.radians(10.0)
"""Largest errors of a good model: share of the distance travelled, and heading error in rad.

They apply to the upper limit of the prediction interval; twice the noise floor is allowed in any
case. The values are a convention of residnet, and the verdict states them.
"""
_POSE_ERROR_SUFFIXES = {"depth": " of depth", "attitude": " of attitude"}
"""Suffixes of pose errors other than horizontal position and heading."""
_MAX_RATIO_TO_BEST = 1.5
"""Largest ratio of the error of a good model to that of the best model of the run."""


def write_verdict(evidence: VerdictEvidence) -> list[str]:
    """Return the verdict sentence by sentence, the most important first.

    Position and heading errors of the selected model at the horizons, findings of the data checks,
    comparison with constant velocity, baseline and noise floor, number of windows and range of
    speeds, velocity errors, failed checks, reason of the selection, and the share of data outside
    the training range. Sentences without data are omitted.
    """
    lead_sentence, *horizon_sentences = (
        [compare_velocity_errors(evidence)] if is_useless(evidence) else describe_horizons(evidence)
    )
    limitations = [evidence.one_sided_text, *list_unidentifiable_inputs(evidence)]
    sentences = [
        lead_sentence,
        *(
            f"The rating is at most limited, because {limitation}."
            for limitation in limitations
            if limitation
        ),
        describe_unexcited(evidence),
        evidence.data_quality_text,
        *horizon_sentences,
        describe_soundness(evidence),
        str(evidence.selection.get("reason", "")),
        describe_extrapolation(evidence),
    ]
    return [sentence for sentence in sentences if sentence]


def rate_model(evidence: VerdictEvidence) -> str:
    """Return a key of `LEVEL_TEXTS`; empty if the selected model has no free runs."""
    if is_useless(evidence):
        return DO_NOT_USE
    if evidence.selected not in evidence.rows_by_model:
        return ""
    horizon_entries = known_horizons(evidence)
    if horizon_entries and not any(_has_enough_data(evidence, entry) for entry in horizon_entries):
        return TOO_FEW_WINDOWS
    has_limitation = bool(evidence.one_sided_text) or bool(list_unidentifiable_inputs(evidence))
    return GOOD_LEVEL if longest_good_horizon(evidence) and not has_limitation else LIMITED_LEVEL


def list_unidentifiable_inputs(evidence: VerdictEvidence) -> list[str]:
    """Return the inputs whose effect the training logs cannot identify, each with the reason.

    Free runs on logs of the same kind cannot reveal a wrong effect: a controller repeats the
    relation of the input to the motion, and collinear inputs remain collinear.
    """
    return [
        f"the effect of {row['name']} cannot be identified: {row['text']}"
        for row in evidence.excitation.get("inputs") or []
        if row["state"] in ("feedback", "collinear")
    ]


def describe_unexcited(evidence: VerdictEvidence) -> str:
    """Return sentences on the limits of the operating domain; empty if there are none.

    They name directions that were not excited, inputs that were held, and test logs that a
    controller steered.
    """
    excitation = evidence.excitation
    directions = [
        row["text"] for row in excitation.get("directions") or [] if not row["is_excited"]
    ]
    held_inputs = [row["text"] for row in excitation.get("inputs") or [] if row["state"] == "held"]
    sentences = [f"{text[0].upper()}{text[1:]}." for text in (*directions, *held_inputs)]
    sentences += list(excitation.get("domain") or [])
    if controlled := excitation.get("closed_loop_test_inputs"):
        sentences.append(
            "Shown for operation under the same controller only: in the"
            f" {evidence.split} logs feedback sets {join_list(list(controlled))}."
        )
    return " ".join(sentences)


def known_horizons(evidence: VerdictEvidence) -> list[JsonObject]:
    """Return the horizons with known errors of the selected model, in ascending order.

    A horizon may occur in several protocols; the one with the most windows is used and named under
    the key `protocol`.
    """
    entry_by_time: dict[float, dict[str, Any]] = {}
    # the protocol of the rows first, so that others only add horizons or more windows
    for protocol in sorted(evidence.limits_by_protocol, key=lambda name: name != evidence.protocol):
        for horizon_entry in evidence.limits_by_protocol[protocol].get("horizons") or []:
            seconds = horizon_entry["seconds"]
            has_selected_model = evidence.selected in horizon_entry["models"]
            if seconds in entry_by_time:
                has_selected_model &= horizon_entry["windows"] > entry_by_time[seconds]["windows"]
            elif protocol != evidence.protocol:
                has_selected_model = False
            if has_selected_model:
                entry_by_time[seconds] = {**horizon_entry, "protocol": protocol}
    return [entry_by_time[seconds] for seconds in sorted(entry_by_time)]


def _has_enough_data(evidence: VerdictEvidence, horizon_entry: JsonObject) -> bool:
    """Return whether a horizon has enough windows, and logs for an interval, for a rating."""
    has_intervals = all(horizon_entry["models"][evidence.selected]["intervals"].values())
    return has_intervals and horizon_entry["windows"] >= _MIN_WINDOWS


def _protocol_limits(evidence: VerdictEvidence) -> JsonObject:
    """Return the entry of limits.json for the protocol of the rows; may be empty."""
    limits: JsonObject = evidence.limits_by_protocol.get(evidence.protocol) or {}
    return limits


def longest_good_horizon(evidence: VerdictEvidence) -> float:
    """Return the horizon in s up to which the selected model is good; 0 for none."""
    row = evidence.rows_by_model[evidence.selected]
    longest_horizon = 0.0
    # one divergence on unseen data excludes the model at any horizon
    if row.get("diverged") and evidence.split in UNSEEN_SPLITS:
        return 0.0
    plant_models = {
        name for name, row in evidence.rows_by_model.items() if row.get("kind") == "plant"
    }
    for horizon_entry in known_horizons(evidence):
        if not _has_enough_data(evidence, horizon_entry):
            return longest_horizon
        if contradicts_positions(horizon_entry):
            continue
        models = horizon_entry["models"]
        selected_errors = models[evidence.selected]
        error_intervals = models[evidence.selected]["intervals"]
        # the errors of the plant itself, started from noisy measured states, are also a noise floor
        noise_floors = [
            horizon_entry["floor"],
            *(models[name] for name in plant_models & set(models)),
        ]
        rival_models = set(models) - {evidence.selected} - plant_models
        for error_name in error_intervals:
            error_limit = (
                _MAX_ANGLE_ERROR
                if POSE_ERROR_UNITS[error_name] == "rad"
                else _MAX_DISTANCE_SHARE * horizon_entry["sailed"]
            )
            rival_errors = [models[name][error_name] for name in rival_models]
            # errors near the noise floor are not the fault of the model
            twice_noise_floor = 2.0 * max(noise_floor[error_name] for noise_floor in noise_floors)
            # a model that is far worse than another one of the run should not be called good
            is_near_best = selected_errors[error_name] <= max(
                twice_noise_floor,
                _MAX_RATIO_TO_BEST * min(rival_errors, default=selected_errors[error_name]),
            )
            beats_constant_velocity = CONSTANT_VELOCITY not in models or selected_errors[
                error_name
            ] <= max(twice_noise_floor, models[CONSTANT_VELOCITY][error_name])
            if not (
                is_near_best
                and beats_constant_velocity
                and error_intervals[error_name][1] <= max(error_limit, twice_noise_floor)
            ):
                return longest_horizon
        longest_horizon = float(horizon_entry["seconds"])
    return longest_horizon


def contradicts_positions(horizon_entry: JsonObject) -> bool:
    """Return whether measured velocities, integrated, leave the positions by a tenth of the way.

    Then velocities and positions are not one motion, and no model is good by them.
    """
    floor = float(horizon_entry["floor"].get("position", 0.0))
    return floor > _MAX_DISTANCE_SHARE * float(horizon_entry["sailed"])


def describe_horizons(evidence: VerdictEvidence) -> list[str]:
    """Return sentences on pose errors of the selected model and of the reference models."""
    horizon_entries = known_horizons(evidence)
    if not horizon_entries:
        return [compare_velocity_errors(evidence)]
    error_names = [
        error_name for error_name in POSE_ERROR_UNITS if error_name in horizon_entries[0]["floor"]
    ]
    sufficient_entries = [
        horizon_entry
        for horizon_entry in horizon_entries
        if _has_enough_data(evidence, horizon_entry)
    ]
    longest_horizon = longest_good_horizon(evidence) if sufficient_entries else 0.0
    main_entry = next(
        (
            candidate_entry
            for candidate_entry in horizon_entries
            if candidate_entry["seconds"] == longest_horizon
        ),
        (sufficient_entries or horizon_entries)[-1],
    )
    error_text = _format_errors_with_intervals(main_entry, evidence.selected, main_entry["sailed"])
    horizon_text = f"{format_number(main_entry['seconds'], 2)} s ahead"
    criterion_sentences = []
    if not sufficient_entries:
        lead_sentence = (
            f"{format_count(main_entry['windows'], 'window')} of"
            f" {format_count(main_entry['logs'], 'log')} on"
            f" {evidence.split} data cannot say how good {evidence.selected} is ({_MIN_WINDOWS} of"
            f" {MIN_LOGS_FOR_INTERVAL} logs are needed); {horizon_text} it is off by {error_text}."
        )
    elif longest_horizon:
        lead_sentence = f"Up to {horizon_text}, where {evidence.selected} is off by {error_text}."
    else:
        lead_sentence = (
            f"{horizon_text[0].upper()}{horizon_text[1:]} {evidence.selected} is off"
            f" by {error_text}."
        )
        limits_by_unit = {
            "m": f"{100.0 * _MAX_DISTANCE_SHARE:.0f} % of the way",
            "rad": f"{math.degrees(_MAX_ANGLE_ERROR):.0f} deg",
        }
        good_limits_text = join_list(
            list(
                dict.fromkeys(
                    limits_by_unit[POSE_ERROR_UNITS[error_name]] for error_name in error_names
                )
            )
        )
        criterion_sentences = [
            f"A good model has errors within {good_limits_text} up to the upper end of the"
            " interval, or within twice the noise floor, no diverged window, and errors near those"
            " of the best model of the run."
        ]
    reference_labels = {CONSTANT_VELOCITY: "constant velocity", evidence.baseline: "baseline"}
    reference_texts = [
        f"{label} {_format_errors_with_intervals(main_entry, name)}"
        for name, label in reference_labels.items()
        if name in main_entry["models"] and name != evidence.selected
    ]
    # a pose that was itself integrated from the velocities has only rounding errors
    has_noise_floor = any(main_entry["floor"][error_name] > 1e-9 for error_name in error_names)
    noise_floor_text = (
        f"noise floor (measured velocities, integrated) {_format_pose_errors(main_entry['floor'])}"
    )
    other_horizons = [
        f"{_format_pose_errors(horizon_entry['models'][evidence.selected])} after"
        f" {horizon_entry['seconds']:.4g} s"
        for horizon_entry in horizon_entries
        if horizon_entry is not main_entry
    ]
    has_position = "position" in error_names
    scope_sentence = (
        f"It holds for {format_count(main_entry['windows'], 'free run')}"
        f" ({main_entry['protocol']}) of"
        f" {format_count(main_entry['logs'], 'log')}"
        + f" at mean speeds of {format_number(main_entry['slowest'], 2)} to"
        f" {format_number(main_entry['fastest'], 2)} m/s" * has_position + "."
    )
    contradiction_sentences = []
    if contradicts_positions(main_entry):
        share = main_entry["floor"]["position"] / main_entry["sailed"]
        contradiction_sentences = [
            "The measured velocities, integrated, leave the measured positions by"
            f" {100.0 * share:.0f} % of the way: check frames, units and clocks of both before any"
            " model is used."
        ]
    return [
        lead_sentence,
        *contradiction_sentences,
        f"Reference models:"
        f" {'; '.join([*reference_texts, *([noise_floor_text] if has_noise_floor else [])])}.",
        *criterion_sentences,
        *(
            [f"At other times of these free runs: {'; '.join(other_horizons)}."]
            if other_horizons
            else []
        ),
        scope_sentence,
        compare_velocity_errors(evidence),
    ]


def format_pose_error(error_name: str, error: float) -> str:
    """Return a pose error (key of `POSE_ERROR_UNITS`) with its unit."""
    unit, unit_factor = display_unit(POSE_ERROR_UNITS[error_name])
    return (
        f"{format_number(unit_factor * error, 2)} {unit}{_POSE_ERROR_SUFFIXES.get(error_name, '')}"
    )


def _format_pose_errors(errors: JsonObject) -> str:
    return join_list(
        [
            format_pose_error(error_name, errors[error_name])
            for error_name in POSE_ERROR_UNITS
            if error_name in errors
        ]
    )


def _format_errors_with_intervals(
    horizon_entry: JsonObject, model_name: str, distance_travelled: float = 0.0
) -> str:
    """Return errors of position and heading with their intervals as text."""
    model_errors = horizon_entry["models"][model_name]
    texts = []
    for error_name in (error_name for error_name in POSE_ERROR_UNITS if error_name in model_errors):
        interval_limits = model_errors["intervals"][error_name]
        error_text = format_pose_error(error_name, model_errors[error_name])
        details = (
            [format_interval(interval_limits, display_unit(POSE_ERROR_UNITS[error_name])[1], 2)]
            if interval_limits
            else []
        )
        if error_name == "position" and distance_travelled > 0.0:
            details.append(
                f"{format_number(100.0 * model_errors[error_name] / distance_travelled, 2)} % of"
                f" the {format_number(distance_travelled, 2)} m sailed"
            )
        texts.append(error_text + (f" ({', '.join(details)})" if details else ""))
    has_intervals = all(model_errors["intervals"].values()) or distance_travelled == 0.0
    return join_list(texts) + ("" if has_intervals else ", from too few logs for an interval")


def list_model_objections(evidence: VerdictEvidence) -> list[str]:
    """Return objections to any use of the model, for `residnet.export.base.require_releasable`.

    A model has to be better than constant velocity and than its own baseline.
    """
    selected_row = evidence.rows_by_model.get(evidence.selected)
    if selected_row is None:
        return []
    return [
        f"on {evidence.split} data its NRMSE is {format_number(_mean_nrmse(selected_row))}, that"
        f" of {reference_name}"
        f" {format_number(_mean_nrmse(reference_row))}"
        for reference_name in dict.fromkeys((CONSTANT_VELOCITY, evidence.baseline))
        if (reference_row := evidence.rows_by_model.get(reference_name)) is not None
        and _mean_nrmse(selected_row) > _mean_nrmse(reference_row)
    ]


def is_useless(evidence: VerdictEvidence) -> bool:
    """Return whether the selected model is not shown to be better than constant velocity."""
    selected_row = evidence.rows_by_model.get(evidence.selected)
    constant_velocity_row = evidence.rows_by_model.get(CONSTANT_VELOCITY)
    if evidence.selected == CONSTANT_VELOCITY:
        return True
    if selected_row is None or constant_velocity_row is None:
        return False
    return _mean_nrmse(selected_row) >= _mean_nrmse(constant_velocity_row) or _is_indistinguishable(
        evidence, CONSTANT_VELOCITY
    )


def compare_velocity_errors(evidence: VerdictEvidence) -> str:
    """Return a sentence that compares the velocity errors with constant velocity and the
    baseline.
    """
    model_name = evidence.selected
    split = evidence.split
    if model_name == CONSTANT_VELOCITY:
        return (
            "NOTHING BEATS CONSTANT VELOCITY, which keeps the initial velocities of each free"
            " run: no model of this run is useful for prediction."
        )
    selected_row = evidence.rows_by_model.get(model_name)
    constant_velocity_row = evidence.rows_by_model.get(CONSTANT_VELOCITY)
    if selected_row is None:
        return f"The run holds no free runs of its selected model on {split} data."
    selected_nrmse = _mean_nrmse(selected_row)
    if constant_velocity_row is not None and is_useless(evidence):
        comparison_text = (
            "NO BETTER"
            if _mean_nrmse(selected_row) <= _mean_nrmse(constant_velocity_row)
            else "WORSE"
        )
        return (
            f"{comparison_text} THAN CONSTANT VELOCITY: on {split} data the selected model"
            f" {model_name} has an NRMSE of"
            f" {format_number(selected_nrmse)}{_diverged_suffix(selected_row)}, and the"
            " constant-velocity model"
            f" {format_number(_mean_nrmse(constant_velocity_row))}"
            f"{_format_paired_interval(evidence, CONSTANT_VELOCITY)}."
            " DO NOT USE it for prediction."
        )
    comparisons = []
    for reference_name, reference_row in (
        (CONSTANT_VELOCITY, constant_velocity_row),
        (evidence.baseline, evidence.rows_by_model.get(evidence.baseline)),
    ):
        if reference_row is None or reference_name == model_name:
            continue
        percent_change = (
            100.0 * (1.0 - selected_nrmse / _mean_nrmse(reference_row))
            if _mean_nrmse(reference_row) > 0
            else 0.0
        )
        comparison = "better" if percent_change >= 0 else "WORSE"
        reference_label = {"baseline": "the baseline", CONSTANT_VELOCITY: "constant velocity"}.get(
            reference_name, reference_name
        )
        comparisons.append(
            f"{abs(percent_change):.0f} % {comparison} than"
            f" {reference_label}{_format_paired_interval(evidence, reference_name)}"
        )
    comparison_clause = f" is {' and '.join(comparisons)};" if comparisons else ""
    return (
        f"On {split} data model {model_name}{comparison_clause} its NRMSE is"
        f" {format_number(selected_nrmse)}{_diverged_suffix(selected_row)}."
    )


def describe_soundness(evidence: VerdictEvidence) -> str:
    """Return the result of the physical checks of the selected model; empty without checks."""
    selection_rows = {
        selected_row["model"]: selected_row for selected_row in evidence.selection.get("models", [])
    }
    selection_row = selection_rows.get(evidence.selected)
    if selection_row is None or evidence.selected == CONSTANT_VELOCITY:
        return ""
    selected_row = evidence.rows_by_model.get(evidence.selected)
    n_diverged = int(selected_row["diverged"]) if selected_row is not None else 0
    faults = list(selection_row["faults"])
    if n_diverged and selected_row is not None and evidence.split in UNSEEN_SPLITS:
        faults.append(
            f"{n_diverged} of its {selected_row['windows']} {evidence.split} windows diverged"
        )
    if faults:
        return f"It is UNSOUND: {'; '.join(faults)}."
    return "No window diverged, and it passed all physical checks."


def describe_extrapolation(evidence: VerdictEvidence) -> str:
    """Return the share of data outside the training range; empty if unknown."""
    range_summary = _protocol_limits(evidence).get("outside") or {}
    if not range_summary:
        return ""
    outside_share = float(range_summary["share"])
    if outside_share == 0:
        return f"All {evidence.split} data lie inside the range of the training data."
    channels = sorted(range_summary["channels"].items(), key=lambda pair: -pair[1])[:3]
    channel_texts = ", ".join(
        f"{name} {_format_percent(channel_share)}" for name, channel_share in channels
    )
    return (
        f"Of the {evidence.split} data, {_format_percent(outside_share)} lies outside the range"
        f" of the training"
        f" data ({channel_texts}); these runs are the only evidence on the model there."
    )


def describe_divergence(metrics_row: JsonObject) -> str:
    """Return the count of diverged windows of a row, for display next to its error; may be
    empty.
    """
    return (
        f"{metrics_row['diverged']}/{metrics_row['windows']} diverged"
        if metrics_row.get("diverged")
        else ""
    )


def _mean_nrmse(row: JsonObject) -> float:
    return float(row["nrmse"]["mean"])


def _diverged_suffix(row: JsonObject) -> str:
    divergence_note = describe_divergence(row)
    return (
        f" ({divergence_note}, which count with the constant-velocity error)"
        if divergence_note
        else ""
    )


def _difference_to(evidence: VerdictEvidence, reference_name: str) -> JsonObject:
    """Return the paired difference to another model; empty if it was not computed."""
    differences = (_protocol_limits(evidence).get("compared") or {}).get(evidence.selected) or {}
    return differences.get(reference_name) or {}


def _is_indistinguishable(evidence: VerdictEvidence, reference_name: str) -> bool:
    """Return whether the interval of the difference to another model includes zero."""
    paired_difference = _difference_to(evidence, reference_name)
    return (
        bool(paired_difference)
        and paired_difference["ci95"] is not None
        and not paired_difference["excludes_zero"]
    )


def _format_paired_interval(evidence: VerdictEvidence, reference_name: str) -> str:
    """Return the paired confidence interval of the difference to another model in brackets."""
    paired_difference = _difference_to(evidence, reference_name)
    if not paired_difference:
        return ""
    if paired_difference["ci95"] is None:
        return " (too few logs for an interval)"
    lower, upper = paired_difference["ci95"]
    suffix = (
        ""
        if paired_difference["excludes_zero"]
        else ", which includes zero: the difference is not significant"
    )
    return f" (paired 95 % interval of the difference {lower:+.3g} to {upper:+.3g}{suffix})"


def _format_percent(share: float) -> str:
    return f"{format_number(100.0 * share, 2)} %" if share >= 0.001 else "less than 0.1 %"

"""Verdict on the selected model of a fit in sentences, from the files of the run folder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from residnet.core.format import (
    display_unit,
    format_count,
    format_interval,
    format_number,
    join_list,
)
from residnet.core.model_names import CONSTANT_VELOCITY, PLANT
from residnet.core.names import POSE_ERROR_UNITS
from residnet.evaluation.records import (
    ExcitationFile,
    HorizonRow,
    MetricsRow,
    PairedDifference,
    PoseErrors,
    ProtocolLimits,
    SelectionFile,
)

UNSEEN_SPLITS = ("test", "external")
"""Splits that are not used in a fit."""


def order_protocols(rows: Sequence[MetricsRow], split: str, selection_protocol: str) -> list[str]:
    """Return the protocols of rows, first the main one of a split.

    The main protocol is that of the model selection, unless the logs of the split are too short.

    Args:
        rows: rows of metrics.json.
        split: the split.
        selection_protocol: protocol of the model selection; empty without a selection.
    """
    protocol_names = dict.fromkeys(row.protocol for row in rows)
    protocols_of_split = {row.protocol for row in rows if row.split == split}
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
        selection: contents of selection.json; None without a selection.
        limits_by_protocol: contents of limits.json for the split by protocol; may be empty.
        data_quality_text: one sentence on the data checks; empty without them.
        protocol: protocol of the rows.
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
"""Largest position error of a good model, as a share of the distance travelled."""
_MAX_ANGLE_ERROR = math.radians(10.0)
"""Largest heading error of a good model in rad.

Both limits apply to the upper limit of the prediction interval; twice the noise floor is allowed in
any case. The values are a convention of residnet, and the verdict states them.
"""
_MAX_LIMITED_DISTANCE_SHARE = 0.25
"""Largest position error of a model of limited use, as a share of the distance travelled."""
_MAX_LIMITED_ANGLE_ERROR = math.radians(30.0)
"""Largest heading error of a model of limited use in rad; it must be better than constant velocity,
too.
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
    limitations = [
        evidence.logs_of_fit_text,
        evidence.one_sided_text,
        *list_unidentifiable_inputs(evidence),
    ]
    sentences = [
        lead_sentence,
        *(
            f"The rating is at most limited, because {limitation}."
            for limitation in limitations
            if limitation
        ),
        describe_unexcited(evidence),
        evidence.data_quality_text,
        evidence.current_text,
        *horizon_sentences,
        describe_soundness(evidence),
        "" if evidence.selection is None else evidence.selection.reason,
        describe_extrapolation(evidence),
        describe_distance(evidence),
    ]
    return [sentence for sentence in sentences if sentence]


def rate_model(evidence: VerdictEvidence) -> str:
    """Return a key of `LEVEL_TEXTS`; empty if the selected model has no free runs."""
    if is_useless(evidence):
        return DO_NOT_USE
    if evidence.selected not in evidence.rows_by_model:
        return ""
    horizons = known_horizons(evidence)
    if horizons and not any(_has_enough_data(evidence, horizon.row) for horizon in horizons):
        return TOO_FEW_WINDOWS
    has_limitation = (
        bool(evidence.logs_of_fit_text)
        or bool(evidence.one_sided_text)
        or bool(list_unidentifiable_inputs(evidence))
    )
    if longest_good_horizon(evidence) and not has_limitation:
        return GOOD_LEVEL
    return LIMITED_LEVEL if not horizons or longest_limited_horizon(evidence) else DO_NOT_USE


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

    A horizon may occur in several protocols; the one with the most windows is used.
    """
    horizons: dict[float, ProtocolHorizon] = {}
    # the protocol of the rows first, so that others only add horizons or more windows
    for protocol in sorted(evidence.limits_by_protocol, key=lambda name: name != evidence.protocol):
        for row in evidence.limits_by_protocol[protocol].horizons:
            if evidence.selected not in row.models:
                continue
            known_horizon = horizons.get(row.seconds)
            if known_horizon is None:
                # the protocol of the verdict determines the horizons, others only add windows
                is_used = protocol == evidence.protocol
            else:
                is_used = row.windows > known_horizon.row.windows
            if is_used:
                horizons[row.seconds] = ProtocolHorizon(protocol, row)
    return [horizons[seconds] for seconds in sorted(horizons)]


def _has_enough_data(evidence: VerdictEvidence, row: HorizonRow) -> bool:
    """Return whether a horizon has enough windows, and logs for an interval, for a rating."""
    has_intervals = all(row.models[evidence.selected].intervals.values())
    return has_intervals and row.windows >= _MIN_WINDOWS


def _protocol_limits(evidence: VerdictEvidence) -> ProtocolLimits | None:
    """Return the entry of limits.json for the protocol of the rows; None without one."""
    return evidence.limits_by_protocol.get(evidence.protocol)


def longest_good_horizon(evidence: VerdictEvidence) -> float:
    """Return the horizon in s up to which the selected model is good; 0 for none."""
    # one divergence on unseen data excludes the model at any horizon
    if evidence.rows_by_model[evidence.selected].diverged and evidence.split in UNSEEN_SPLITS:
        return 0.0
    plant_models = {name for name, row in evidence.rows_by_model.items() if row.kind == PLANT}
    longest_horizon = 0.0
    for _, row in known_horizons(evidence):
        if not _has_enough_data(evidence, row):
            return longest_horizon
        if contradicts_positions(row):
            continue
        errors_by_model = {name: errors.by_name for name, errors in row.models.items()}
        selected_errors = errors_by_model[evidence.selected]
        # the errors of the plant itself, started from noisy measured states, are also a noise floor
        noise_floors = [
            row.floor.by_name,
            *(errors_by_model[name] for name in plant_models & set(errors_by_model)),
        ]
        rival_models = set(errors_by_model) - {evidence.selected} - plant_models
        for error_name, interval in row.models[evidence.selected].intervals.items():
            assert interval is not None, "checked by _has_enough_data"
            error_limit = (
                _MAX_ANGLE_ERROR
                if POSE_ERROR_UNITS[error_name] == "rad"
                else _MAX_DISTANCE_SHARE * row.sailed
            )
            rival_errors = [errors_by_model[name][error_name] for name in rival_models]
            # errors near the noise floor are not the fault of the model
            twice_noise_floor = 2.0 * max(noise_floor[error_name] for noise_floor in noise_floors)
            selected_error = selected_errors[error_name]
            # a model that is far worse than another one of the run should not be called good
            is_near_best = selected_error <= max(
                twice_noise_floor,
                _MAX_RATIO_TO_BEST * min(rival_errors, default=selected_error),
            )
            if not (
                is_near_best
                and is_better_than_constant_velocity(evidence, row, error_name)
                and interval[1] <= max(error_limit, twice_noise_floor)
            ):
                return longest_horizon
        longest_horizon = row.seconds
    return longest_horizon


def longest_limited_horizon(evidence: VerdictEvidence) -> float:
    """Return the horizon in s up to which the selected model is of limited use; 0 for none.

    All pose errors must be significantly smaller than those of the constant-velocity model, and
    within the limits of a limited model up to the upper end of their prediction intervals.
    """
    longest_horizon = 0.0
    for _, row in known_horizons(evidence):
        if not _has_enough_data(evidence, row):
            return longest_horizon
        for error_name, interval in row.models[evidence.selected].intervals.items():
            assert interval is not None, "checked by _has_enough_data"
            error_limit = (
                _MAX_LIMITED_ANGLE_ERROR
                if POSE_ERROR_UNITS[error_name] == "rad"
                else _MAX_LIMITED_DISTANCE_SHARE * row.sailed
            )
            twice_noise_floor = 2.0 * row.floor.by_name[error_name]
            if interval[1] > max(error_limit, twice_noise_floor):
                return longest_horizon
            if not is_better_than_constant_velocity(evidence, row, error_name):
                return longest_horizon
        longest_horizon = row.seconds
    return longest_horizon


def is_better_than_constant_velocity(
    evidence: VerdictEvidence, row: HorizonRow, error_name: str
) -> bool:
    """Return whether a pose error is significantly smaller than that of constant velocity.

    Without a confidence interval of the difference the mean errors decide. True without a
    constant-velocity model.
    """
    reference_errors = row.models.get(CONSTANT_VELOCITY)
    if reference_errors is None or evidence.selected == CONSTANT_VELOCITY:
        return True
    changes = row.change_from_constant_velocity.get(evidence.selected, {})
    if (interval := changes.get(error_name)) is not None:
        return interval[1] < 0.0
    selected_error = row.models[evidence.selected].by_name[error_name]
    return selected_error < reference_errors.by_name[error_name]


def contradicts_positions(row: HorizonRow) -> bool:
    """Return whether measured velocities, integrated, leave the positions by a tenth of the way.

    Then velocities and positions are not one motion, and no model is good by them.
    """
    return (row.floor.position or 0.0) > _MAX_DISTANCE_SHARE * row.sailed


def describe_horizons(evidence: VerdictEvidence) -> list[str]:
    """Return sentences on pose errors of the selected model and of the reference models."""
    horizons = known_horizons(evidence)
    if not horizons:
        return [compare_velocity_errors(evidence)]
    error_names = list(horizons[0].row.floor.by_name)
    sufficient_horizons = [
        horizon for horizon in horizons if _has_enough_data(evidence, horizon.row)
    ]
    longest_horizon = longest_good_horizon(evidence) if sufficient_horizons else 0.0
    # the horizon of the level, so that badge and sentence are about the same free runs
    level_horizon = longest_horizon or longest_limited_horizon(evidence)
    main_horizon = next(
        (horizon for horizon in horizons if horizon.row.seconds == level_horizon),
        (sufficient_horizons or horizons)[-1],
    )
    main_row = main_horizon.row
    error_text = _format_errors_with_intervals(main_row.models[evidence.selected], main_row.sailed)
    horizon_text = f"{format_number(main_row.seconds, 2)} s ahead"
    criterion_sentences = []
    if not sufficient_horizons:
        lead_sentence = (
            f"{format_count(main_row.windows, 'window')} of"
            f" {format_count(main_row.logs, 'log')} on"
            f" {evidence.data_name} cannot say how good {evidence.selected} is ({_MIN_WINDOWS} of"
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
            " prediction interval, or within twice the noise floor, no diverged window, and errors"
            " near those of the best model of the run."
        ]
    if sufficient_horizons and not level_horizon:
        criterion_sentences.append(
            "A model of limited use has errors within"
            f" {100.0 * _MAX_LIMITED_DISTANCE_SHARE:.0f} % of the way and"
            f" {math.degrees(_MAX_LIMITED_ANGLE_ERROR):.0f} deg, and is significantly better than"
            " constant velocity in position and heading: do not use this one."
        )
    reference_labels = {CONSTANT_VELOCITY: "constant velocity", evidence.baseline: "baseline"}
    reference_texts = [
        f"{label} {_format_errors_with_intervals(main_row.models[name])}"
        for name, label in reference_labels.items()
        if name in main_row.models and name != evidence.selected
    ]
    # a pose that was itself integrated from the velocities has only rounding errors
    has_noise_floor = any(error > 1e-9 for error in main_row.floor.by_name.values())
    noise_floor_text = (
        f"noise floor (measured velocities, integrated) {_format_pose_errors(main_row.floor)}"
    )
    other_horizons = [
        f"{_format_pose_errors(row.models[evidence.selected])} after {row.seconds:.4g} s"
        for _, row in horizons
        if row is not main_row
    ]
    has_position = "position" in error_names
    scope_sentence = (
        f"It holds for {format_count(main_row.windows, 'free run')}"
        f" ({main_horizon.protocol}) of"
        f" {format_count(main_row.logs, 'log')}"
        + f" at mean speeds of {format_number(main_row.slowest, 2)} to"
        f" {format_number(main_row.fastest, 2)} m/s" * has_position + "."
    )
    contradiction_sentences = []
    if contradicts_positions(main_row):
        share = (main_row.floor.position or 0.0) / main_row.sailed
        contradiction_sentences = [
            "The measured velocities, integrated, leave the measured positions by"
            f" {100.0 * share:.0f} % of the way: check frames, units and clocks of both before any"
            " model is used."
        ]
    return [
        lead_sentence,
        *contradiction_sentences,
        f"Reference models (95 % prediction intervals):"
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


def _format_pose_errors(errors: PoseErrors) -> str:
    return join_list([format_pose_error(name, error) for name, error in errors.by_name.items()])


def _format_errors_with_intervals(errors: PoseErrors, distance_travelled: float = 0.0) -> str:
    """Return errors of position and heading with their intervals as text."""
    texts: list[str] = []
    for error_name, error in errors.by_name.items():
        interval = errors.intervals[error_name]
        unit_factor = display_unit(POSE_ERROR_UNITS[error_name]).factor
        details = [format_interval(interval, unit_factor, 2)] if interval else []
        if details and distance_travelled > 0.0 and not texts:
            # stated once; the interval of the heading is of the same kind
            details[0] = f"95 % prediction interval {details[0]}"
        if error_name == "position" and distance_travelled > 0.0:
            details.append(
                f"{format_number(100.0 * error / distance_travelled, 2)} % of"
                f" the {format_number(distance_travelled, 2)} m sailed"
            )
        error_text = format_pose_error(error_name, error)
        texts.append(error_text + (f" ({', '.join(details)})" if details else ""))
    has_intervals = all(errors.intervals.values()) or distance_travelled == 0.0
    return join_list(texts) + ("" if has_intervals else ", from too few logs for an interval")


def list_model_objections(evidence: VerdictEvidence) -> list[str]:
    """Return objections to any use of the model, for `residnet.export.base.require_releasable`.

    A model has to be better than constant velocity and than its own baseline.
    """
    selected_row = evidence.rows_by_model.get(evidence.selected)
    if selected_row is None:
        return []
    return [
        f"on {evidence.data_name} its NRMSE is {format_number(selected_row.mean_nrmse)}, that"
        f" of {reference_name}"
        f" {format_number(reference_row.mean_nrmse)}"
        for reference_name in dict.fromkeys((CONSTANT_VELOCITY, evidence.baseline))
        if (reference_row := evidence.rows_by_model.get(reference_name)) is not None
        and selected_row.mean_nrmse > reference_row.mean_nrmse
    ]


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


def compare_velocity_errors(evidence: VerdictEvidence) -> str:
    """Return a sentence that compares the velocity errors with constant velocity and the
    baseline.
    """
    model_name = evidence.selected
    data_name = evidence.data_name
    if model_name == CONSTANT_VELOCITY:
        return (
            "NOTHING BEATS CONSTANT VELOCITY, which keeps the initial velocities of each free"
            " run: no model of this run is useful for prediction."
        )
    selected_row = evidence.rows_by_model.get(model_name)
    constant_velocity_row = evidence.rows_by_model.get(CONSTANT_VELOCITY)
    if selected_row is None:
        return f"The run holds no free runs of its selected model on {data_name}."
    selected_nrmse = selected_row.mean_nrmse
    if constant_velocity_row is not None and is_useless(evidence):
        comparison_text = (
            "NO BETTER" if selected_row.mean_nrmse <= constant_velocity_row.mean_nrmse else "WORSE"
        )
        return (
            f"{comparison_text} THAN CONSTANT VELOCITY: on {data_name} the selected model"
            f" {model_name} has an NRMSE of"
            f" {format_number(selected_nrmse)}{_diverged_suffix(selected_row)}, and the"
            " constant-velocity model"
            f" {format_number(constant_velocity_row.mean_nrmse)}"
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
            100.0 * (1.0 - selected_nrmse / reference_row.mean_nrmse)
            if reference_row.mean_nrmse > 0
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
        f"On {data_name} model {model_name}{comparison_clause} its NRMSE is"
        f" {format_number(selected_nrmse)}{_diverged_suffix(selected_row)}."
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


_NOMINAL_MISS_RATE = 0.1
"""Share of samples outside of 90 % prediction intervals."""


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
        return " (too few logs for an interval)"
    lower, upper = difference.ci95
    suffix = (
        ""
        if difference.excludes_zero
        else ", which includes zero: the difference is not significant"
    )
    return f" (paired 95 % interval of the difference {lower:+.3g} to {upper:+.3g}{suffix})"


def _format_percent(share: float) -> str:
    return f"{format_number(100.0 * share, 2)} %" if share >= 0.001 else "less than 0.1 %"

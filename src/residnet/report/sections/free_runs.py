"""Errors of free runs by model, split and kind of manoeuvre; what limits them; their bands."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from residnet.core.format import (
    DASH,
    channel_title,
    format_count,
    format_fixed,
    format_number,
    format_percent_change,
    format_relative_change,
    format_signed,
    join_list,
)
from residnet.core.model_names import BASELINE, CONSTANT_VELOCITY
from residnet.evaluation.limits_records import ProtocolLimits, Repeatability
from residnet.evaluation.records import MetricsRow, PairedDifference
from residnet.evaluation.verdict import describe_divergence, format_pose_error
from residnet.report.blocks import (
    Block,
    Bullets,
    Cell,
    Column,
    Section,
    Table,
    Text,
    build_table,
    flag_cell,
    format_paired_interval,
)
from residnet.report.figure import Figure
from residnet.report.run_reader import RunFiles


def distinct_manoeuvres(run: RunFiles, split: str, protocol: str) -> list[str]:
    """Return kinds and groups of manoeuvres, without duplicates.

    A group of a single kind has the same free runs as that kind.
    """
    seen_errors: list[list[tuple[int, dict[str, float]]]] = []
    manoeuvre_kinds: list[str] = []
    for manoeuvre_kind in run.manoeuvre_kinds(split, protocol):
        rows = [run.find_row(model, split, protocol, manoeuvre_kind) for model in run.model_kinds]
        error_values = [(row.windows, row.rmse) for row in rows if row is not None]
        if error_values not in seen_errors:
            seen_errors.append(error_values)
            manoeuvre_kinds.append(manoeuvre_kind)
    return manoeuvre_kinds


def errors_section(run: RunFiles) -> Section:
    """Return the section on free runs: for each protocol all models, then kind by kind."""
    splits_text = (
        f"The splits {' and '.join(run.report_splits)} are listed side by side."
        if len(run.report_splits) > 1
        else f"The data are those of the split {run.report_split}."
    )
    small_print = "the 95 % confidence interval of the mean NRMSE"
    if run.baseline is not None:
        small_print = f"the change against the baseline on the same data, and {small_print}"
    introduction = (
        "Root mean square error of each free run, mean over the runs."
        f" {splits_text} Small print: {small_print}. A diverged run counts with the error of"
        " constant velocity; the number of diverged runs is next to the NRMSE."
    )
    blocks: list[Block] = [Text(introduction)]
    for protocol in run.protocols:
        present_splits = [
            split
            for split in run.report_splits
            if any(run.find_row(model, split, protocol) for model in run.model_kinds)
        ]
        if not present_splits:
            continue
        protocol_blocks: list[Block] = [_split_comparison_table(run, protocol, present_splits)]
        manoeuvre_table = errors_by_manoeuvre(run, protocol, run.report_split)
        if manoeuvre_table is not None:
            title = f"By kind of manoeuvre, {run.report_split} data"
            protocol_blocks.append(
                Section(title, [manoeuvre_table], is_folded=protocol != run.protocols[0])
            )
        blocks.append(Section(f"Protocol {protocol}", protocol_blocks))
    return Section("Free runs", blocks)


def _quantity_titles(run: RunFiles, nrmse_title: str = "NRMSE [-]") -> dict[str, str]:
    """Return the column titles of tables of errors."""
    return {
        **{
            channel: f"{channel_title(channel)} [{run.display_unit(channel).name}]"
            for channel in run.channels
        },
        "nrmse": nrmse_title,
        **{
            pose_error: "{0.label}, end [{0.unit}]".format(run.pose_error_unit(pose_error))
            for pose_error in run.pose_errors
        },
        "diverged": "diverged",
    }


def _split_comparison_table(run: RunFiles, protocol: str, splits: Sequence[str]) -> Table:
    """Return the table of errors of all models, with the splits side by side."""

    def cell(model: str, key: str, split: str) -> Cell:
        return _quantity_cell(run, key, run.find_row(model, split, protocol))

    quantities = _quantity_titles(run, "NRMSE, mean [-]")
    return build_table(
        run.model_kinds,
        [
            ("model", run.model_label),
            *(
                (split, lambda model, key=key, split=split: cell(model, key, split))
                for key in quantities
                for split in splits
            ),
        ],
        groups=[(title, len(splits)) for title in quantities.values()],
        is_selected=lambda model: model == run.selected,
    )


def errors_table(run: RunFiles, split: str) -> Table:
    """Return the errors of all models on one split under all protocols, for the terminal."""
    rows = [
        row
        for protocol in run.protocols
        for model in run.model_kinds
        if (row := run.find_row(model, split, protocol))
    ]

    def cell(row: MetricsRow, key: str) -> Cell:
        quantity_cell = _quantity_cell(run, key, row)
        # a terminal has no space for notes, except for the number of divergences
        note = describe_divergence(row) if key == "nrmse" else ""
        return Cell(quantity_cell.text, note, "" if key in run.channels else quantity_cell.mark)

    return build_table(
        rows,
        [
            ("model", lambda row: run.model_label(row.model)),
            ("protocol", lambda row: row.protocol),
            *(
                (title, lambda row, key=key: cell(row, key))
                for key, title in _quantity_titles(run).items()
            ),
        ],
        caption=f"Free-run errors on {split} data, mean over windows.",
        is_selected=lambda row: row.model == run.selected,
        group_key=lambda row: row.protocol,
    )


def errors_by_manoeuvre(run: RunFiles, protocol: str, split: str) -> Table | None:
    """Return the errors of one split by kind of manoeuvre; None if there is only one kind."""
    manoeuvre_kinds = distinct_manoeuvres(run, split, protocol)
    if len(manoeuvre_kinds) < 2:
        return None
    models = [model for model, role in run.model_kinds.items() if role != CONSTANT_VELOCITY]
    rows = [
        row
        for manoeuvre_kind in manoeuvre_kinds
        for name in models
        if (row := run.find_row(name, split, protocol, manoeuvre_kind))
    ]

    def label(row: MetricsRow) -> str:
        # the kind is printed once, before its first model
        prefix = f"{row.manoeuvre.replace('_', ' ')}: " if row.model == models[0] else ""
        return prefix + run.model_label(row.model)

    return build_table(
        rows,
        [
            ("manoeuvre, model", label),
            ("runs", lambda row: row.windows, str),
            *(
                (title, lambda row, key=key: _quantity_cell(run, key, row))
                for key, title in _quantity_titles(run).items()
            ),
        ],
        is_selected=lambda row: row.model == run.selected,
        group_key=lambda row: row.manoeuvre,
    )


def _quantity_cell(run: RunFiles, key: str, row: MetricsRow | None) -> Cell:
    """Return the cell of a quantity of a row, with its change relative to the baseline."""
    if row is None:
        return Cell(DASH)
    if key == "diverged":
        return Cell(f"{row.diverged}/{row.windows}", mark="bad" if row.diverged else "")
    if key in run.pose_errors:
        error = row.final_pose_errors.get(key, math.nan)
        return Cell(format_number(run.pose_error_unit(key).factor * error, 2))
    diverged_text = describe_divergence(row)
    if key == "nrmse":
        interval = row.nrmse_mean_ci95
        small_print = (
            f"{format_number(interval[0])}–{format_number(interval[1])}" if interval else ""
        )
        value = row.mean_nrmse
        is_worse = False
        factor = 1.0
    else:
        factor = run.display_unit(key).factor
        if key not in row.rmse:
            return Cell(DASH)
        value = row.rmse[key]
        is_reference = run.model_kinds[row.model] in (CONSTANT_VELOCITY, BASELINE)
        baseline_row = (
            None
            if is_reference
            else run.find_row(run.baseline, row.split, row.protocol, row.manoeuvre)
        )
        is_worse = baseline_row is not None and value > 1.005 * baseline_row.rmse[key]
        small_print = (
            format_relative_change(value, baseline_row.rmse[key])
            if baseline_row is not None
            else ""
        )
    note = "; ".join(text for text in (small_print, diverged_text) if text)
    si = f"{format_number(value)} {run.si_unit(key)}" if factor != 1.0 else ""
    return Cell(format_number(factor * value), note, "bad" if is_worse or row.diverged else "", si)


def limits_section(run: RunFiles) -> Section | None:
    """Return errors by class, worst windows and noise floor of each protocol.

    None if the selected model has no row.
    """
    main_model = run.main_model
    protocol_sections: list[Block] = []
    for protocol in run.protocols:
        row = run.find_row(main_model, run.report_split, protocol)
        if row is not None:
            protocol_limits = run.find_limits(protocol)
            repeatability = None if run.limits is None else run.limits.repeatability.get(protocol)
            blocks = [
                _error_breakdown_table(run, main_model, protocol, protocol_limits),
                None
                if protocol == run.main_protocol
                else _worst_windows_table(run, main_model, protocol_limits),
                Text(_repeatability_text(run, repeatability)) if repeatability else None,
            ]
            title = f"Protocol {protocol}" + (
                "" if protocol_sections else f", {run.report_split} data"
            )
            protocol_sections.append(Section(title, blocks, is_folded=bool(protocol_sections)))
    if not protocol_sections:
        return None
    notes = (
        "Confidence intervals are percentiles of a block bootstrap, widened for few blocks as"
        " Student's t distribution is. Change and difference are those of the mean NRMSE; negative"
        " values mean smaller errors. Bold intervals exclude 0. Classes are thirds of the windows;"
        " classes of fewer than three windows are omitted."
    )
    title = "Accuracy and its limits"
    return Section(title, [*protocol_sections, Text(notes, is_secondary=True)])


class _BreakdownRow(NamedTuple):
    """The error of a model over the windows of one kind of manoeuvre, speed or wind speed.

    Attributes:
        group: common property of the windows: `kind`, `speed` or `wind`.
        label: the kind, or the range of speeds.
        windows: number of windows.
        nrmse: mean error.
        difference: paired difference from the reference model; None without a reference.
    """

    group: str
    label: str
    windows: int
    nrmse: float
    difference: PairedDifference | None


def _error_breakdown_table(
    run: RunFiles, main_model: str, protocol: str, protocol_limits: ProtocolLimits | None
) -> Table:
    """Return the errors by kind of manoeuvre, speed and wind."""
    breakdown_rows: list[_BreakdownRow] = []
    for manoeuvre_kind in ["all", *distinct_manoeuvres(run, run.report_split, protocol)]:
        if row := run.find_row(main_model, run.report_split, protocol, manoeuvre_kind):
            label = manoeuvre_kind.replace("_", " ")
            breakdown_rows.append(
                _BreakdownRow("kind", label, row.windows, row.mean_nrmse, row.difference)
            )
    for class_row in () if protocol_limits is None else protocol_limits.bands:
        if class_errors := class_row.models.get(main_model):
            label = (
                f"{class_row.by} {format_number(class_row.low, 2)} to"
                f" {format_number(class_row.high, 2)} m/s"
            )
            breakdown_rows.append(
                _BreakdownRow(
                    class_row.by,
                    label,
                    class_row.windows,
                    class_errors.nrmse_mean,
                    class_errors.difference,
                )
            )
    reference = next((line.difference.to for line in breakdown_rows if line.difference), None)

    def ratio_cell(line: _BreakdownRow) -> Cell:
        if line.difference is None or line.difference.ratio is None:
            return Cell(DASH)
        text = format_percent_change(100 * (line.difference.ratio - 1))
        return flag_cell(text, line.difference.worse)

    def reference_nrmse(line: _BreakdownRow) -> float:
        return math.nan if line.difference is None else line.nrmse - line.difference.nrmse_mean

    def difference_text(line: _BreakdownRow) -> str:
        return DASH if line.difference is None else format_signed(line.difference.nrmse_mean)

    columns: list[Column[_BreakdownRow]] = [
        ("windows of", lambda line: line.label),
        ("windows", lambda line: line.windows, str),
        (f"NRMSE of {main_model}", lambda line: line.nrmse, format_number),
    ]
    if reference:
        columns += [
            (f"NRMSE of {reference}", reference_nrmse, format_number),
            ("change", ratio_cell),
            ("difference", difference_text, str),
            (
                "paired 95 % confidence interval",
                lambda line: format_paired_interval(line.difference and line.difference.ci95),
            ),
        ]
    return build_table(breakdown_rows, columns, group_key=lambda line: line.group)


def worst_runs_section(run: RunFiles, figures: Sequence[Figure]) -> Section | None:
    """Return the section with the worst free runs of the main protocol and their figure."""
    protocol_limits = run.find_limits(run.main_protocol)
    blocks = [
        block
        for block in (_worst_windows_table(run, run.main_model, protocol_limits), *figures)
        if block is not None
    ]
    return Section("Worst runs", blocks) if blocks else None


def _worst_windows_table(
    run: RunFiles, main_model: str, protocol_limits: ProtocolLimits | None
) -> Table | None:
    """Return the table of the windows with the largest errors of a model; None without windows."""
    windows = () if protocol_limits is None else protocol_limits.worst.get(main_model, ())
    if not windows:
        return None
    channels = [name for name in run.channels if name in windows[0].rmse]
    pose_error = run.pose_errors[0]
    factor = run.pose_error_unit(pose_error).factor
    return build_table(
        windows,
        [
            (
                "worst windows",
                lambda window: f"{window.log} ({window.manoeuvre.replace('_', ' ')})",
            ),
            ("log time at start [s]", lambda window: window.t, 1),
            ("NRMSE", lambda window: window.nrmse, format_number),
            *(
                (
                    _quantity_titles(run)[channel],
                    lambda window, channel=channel: window.rmse[channel],
                    format_number,
                    run.display_unit(channel).factor,
                )
                for channel in channels
            ),
            (
                _quantity_titles(run)[pose_error],
                lambda window: window.final_pose_error,
                lambda error: format_number(error, 2),
                factor,
            ),
        ],
    )


def _repeatability_text(run: RunFiles, repeatability: Repeatability) -> str:
    """Return a paragraph on repeated runs: how they were found, and by how much they differ."""
    tolerance = repeatability.tolerance

    def format_velocities(values: Mapping[str, float], *digits: int) -> str:
        return ", ".join(
            f"{name} {format_number(run.display_unit(name).factor * values[name], *digits)}"
            f" {run.display_unit(name).name}"
            for name in tolerance.start
        )

    criterion = (
        f"commands within {100 * tolerance.command_share_of_range:.0f} % of their range (root"
        " mean square over the window) and initial velocities within"
        f" {format_velocities(tolerance.start, 2)}"
    )
    logs_text = (
        "the logs evaluated here" if run.report_split == "external" else "the logs of all splits"
    )
    if not repeatability.pairs:
        return (
            f"Repeatability: {logs_text} hold no two stretches as long as a window with"
            f" {criterion}. How"
            " well the vessel repeats itself is not known."
        )
    single_run_factor = 1 / math.sqrt(2)
    pairs_text = ", ".join(
        f"{name.replace('_', ' ')} {differences.pairs}"
        for name, differences in repeatability.manoeuvres.items()
    )
    final_pose = repeatability.final_pose
    pose_error_text = join_list(
        [
            format_pose_error(pose_error, final_pose[pose_error])
            for pose_error in run.pose_errors
            if pose_error in final_pose
        ]
    )
    position_text = (
        f" and {format_number(single_run_factor * final_pose['position'], 2)} m"
        if "position" in run.pose_errors
        else ""
    )
    knows_wind = bool(run.fit_settings.signals.exogenous)
    wind_text = (
        " Models with the wind as an input, such as these, can have smaller errors."
        if knows_wind
        else ""
    )
    return (
        f"Repeatability: {format_count(repeatability.pairs, 'pair')} of stretches"
        f" ({pairs_text}) in"
        f" {repeatability.logs} of {logs_text} have {criterion}. Their measured motions differ"
        f" by"
        f" {format_velocities(repeatability.by_channel)} (root"
        f" mean square), and by {pose_error_text} at the end. Each motion is off their mean by"
        f" 1/√2 of that: an NRMSE of"
        f" {format_number(single_run_factor * (repeatability.nrmse or 0.0))}{position_text}."
        " The remaining differences of commands and"
        " starts are part of it. A model that knows only commands and initial velocities is left"
        f" with an error of this order in such runs, whatever its form.{wind_text}"
    )


def bands_section(run: RunFiles) -> Section | None:
    """Return width and coverage of the prediction bands with their limitations; None without
    bands.
    """
    if not run.bands:
        return None
    band = next(iter(next(iter(run.bands.values())).values()))
    level = f"{100 * band.level:.0f} %"
    introduction = [
        f"A band is the {level} prediction interval of the errors of free runs on new logs. The"
        " level is that of each channel. Its width grows with the horizon, with the variation of"
        " the predicted run, and with the differences between the models. It is calibrated on logs"
        " that the model was not fitted to: training logs in leave-one-log-out cross-validation,"
        " and validation logs.",
        f"The tables have the coverage on the {run.report_split} data. Whole: share of runs that"
        f" are within the band from beginning to end, for the band of each channel widened to"
        f" contain {level} of them. Score: interval score, the mean width plus"
        f" {2 / (1 - band.level):.0f} times the excess, in units of the error of constant velocity;"
        " smaller is better. One width: the score of a band of constant width.",
    ]
    blocks: list[Block] = [Text(introduction)]
    if warnings := band_cautions(run, run.main_model):
        blocks.append(Bullets(warnings, is_warning=True))
    for protocol in run.protocols:
        models_rows = [run.find_row(model, run.report_split, protocol) for model in run.model_kinds]
        rows_with_bands = [row for row in models_rows if row and row.band_coverage]
        if not rows_with_bands:
            continue
        coverage_tables = [
            _coverage_table(
                rows_with_bands, "model", lambda row: run.model_label(row.model), run.selected
            )
        ]
        manoeuvre_rows = [
            run.find_row(run.main_model, run.report_split, protocol, kind)
            for kind in distinct_manoeuvres(run, run.report_split, protocol)
        ]
        manoeuvre_rows_with_bands = [row for row in manoeuvre_rows if row and row.band_coverage]
        if len(manoeuvre_rows_with_bands) > 1:
            title = f"manoeuvre, {run.main_model}"
            coverage_tables.append(
                _coverage_table(
                    manoeuvre_rows_with_bands, title, lambda row: row.manoeuvre.replace("_", " ")
                )
            )
        blocks.append(
            Section(f"Protocol {protocol}", coverage_tables, is_folded=protocol != run.protocols[0])
        )
    return Section("Bands", blocks)


def band_cautions(run: RunFiles, model: str) -> list[str]:
    """Return sentences on the limitations of the prediction bands of a model."""
    bands_by_protocol = run.bands.get(model, {})
    windows = run.read_split_windows(run.report_split) if bands_by_protocol else []
    sentences: list[str] = []
    for protocol, band in bands_by_protocol.items():
        sentences += [text for text in band.cautions if text not in sentences]
        lengths = [float(w.t[-1] - w.t[0]) for w in windows if w.protocol == protocol]
        max_duration = max(lengths, default=0.0)
        if max_duration > band.horizon + 1e-6:
            sentences.append(
                f"Runs of protocol {protocol} last up to {format_fixed(max_duration, 0)} s, but"
                f" the band is"
                f" calibrated up to {format_fixed(band.horizon, 0)} s only; beyond, it grows in"
                " proportion to time, without calibration."
            )
    return sentences


def _coverage_table(
    rows: Sequence[MetricsRow],
    title: str,
    label: Callable[[MetricsRow], str],
    selected_model: str | None = None,
) -> Table:
    """Return coverage and interval score of rows with prediction intervals."""

    def constant_width_cell(row: MetricsRow) -> Cell:
        note = (
            format_percent_change(100 * (row.band_score_constant / row.band_score - 1))
            if row.band_score_constant is not None and row.band_score
            else ""
        )
        return Cell(format_number(row.band_score_constant), note)

    def coverage(row: MetricsRow, name: str) -> float | None:
        return (row.band_coverage or {}).get(name)

    channels = [name for name in rows[0].band_coverage or {} if name not in ("mean", "whole")]

    return build_table(
        rows,
        [
            (title, label),
            *(
                (name, lambda row, name=name: coverage(row, name), 2)
                for name in (*channels, "mean", "whole")
            ),
            ("bands", lambda row: row.band_score, format_number),
            ("one width", constant_width_cell),
        ],
        groups=[("coverage", len(channels) + 2), ("score", 2)],
        is_selected=lambda row: row.model == selected_model,
    )

"""The verdict on a fit, and the limitations of its selected model."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from residnet.core.format import (
    DASH,
    channel_title,
    format_count,
    format_minus_signs,
    format_number,
    format_percent_change,
    format_seconds,
)
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.evaluation.data_records import ExcitationFile
from residnet.evaluation.records import SANITY_CHECKS, Interval, MetricsRow, SanityRow
from residnet.evaluation.verdict import (
    DO_NOT_USE,
    GOOD_LEVEL,
    LIMITED_LEVEL,
    TOO_FEW_WINDOWS,
    UNSEEN_SPLITS,
    ProtocolHorizon,
    VerdictEvidence,
    describe_divergence,
    known_horizons,
    rate_horizon,
    rate_model,
    write_verdict,
)
from residnet.quality import summarize_inspection
from residnet.report.blocks import Bullets, Cell, Facts, Section, Table, Text, build_table
from residnet.report.figure import Figure
from residnet.report.run_reader import RunFiles
from residnet.report.sections.free_runs import distinct_manoeuvres
from residnet.training.records import CurrentsFile


def verdict_sentences(run: RunFiles) -> list[str]:
    """Return the sentences of the verdict on the selected model.

    Raises:
        UsageError: if the folder has no metrics.json.
    """
    main_model = run.main_model
    if run.find_row(main_model, run.report_split, run.protocols[0]) is None:
        return [
            f"The run holds no free runs of its selected model on {run.report_split} data; see"
            f" the tables."
        ]
    return write_verdict(collect_evidence(run, main_model))


_NOISE_FLOOR_ROW = "noise floor"
"""Label of the row without a model: pose errors of the integrated measured velocities."""
_HORIZON_LEVELS = {
    GOOD_LEVEL: "✓\u00a0Good",
    LIMITED_LEVEL: "!\u00a0Limited",
    DO_NOT_USE: "✗\u00a0Do\u00a0not\u00a0use",
    TOO_FEW_WINDOWS: "?\u00a0Too\u00a0few",
}
"""Labels of the levels in the narrow table of horizons."""
_NO_POSE_TEXT = (
    "The logs have no {}: use the velocity errors, because position and heading were integrated"
    " from the velocities."
)


def collect_evidence(run: RunFiles, selected: str) -> VerdictEvidence:
    """Read the evidence for the verdict on the selected model from the run folder."""
    protocol = run.protocols[0]
    split = run.report_split
    rows = {
        model: row for model in run.model_kinds if (row := run.find_row(model, split, protocol))
    }
    inspection = run.inspection
    quality_summary = (
        summarize_inspection(inspection).tally if inspection is not None and inspection.logs else ""
    )
    dof_text = run.dof.description
    if integrated_channels := next((log.integrated for log in run.quality if log.integrated), None):
        quality_summary = (
            f"{_NO_POSE_TEXT.format(', '.join(integrated_channels))} {quality_summary}".strip()
            if not dof_text
            else quality_summary
        )
        dof_text += (
            "; no heading was measured"
            if dof_text and run.dof.has_heading and "psi" in integrated_channels
            else ""
        )
    quality_summary = (
        f"{dof_text[0].upper()}{dof_text[1:]}. {quality_summary}".strip()
        if dof_text
        else quality_summary
    )
    one_sided_excitation_texts = (
        finding.text
        for finding in (() if inspection is None else inspection.together)
        if finding.code == "one_side" and finding.level != "note"
    )
    n_logs_of_fit, n_logs = run.n_logs_of_fit_and_all
    return VerdictEvidence(
        selected,
        split,
        rows,
        run.baseline or "",
        run.selection,
        {} if run.limits is None else run.limits.splits.get(split, {}),
        quality_summary,
        protocol,
        next(one_sided_excitation_texts, ""),
        run.read_record(ExcitationFile, "excitation.json"),
        n_logs,
        n_logs_of_fit,
        current_text=_describe_currents(run),
    )


def _describe_currents(run: RunFiles) -> str:
    """Return a sentence on the currents of the logs; empty if none were estimated."""
    currents = run.read_record(CurrentsFile, "currents.json")
    if currents is None or not currents.root:
        return ""
    unit, factor = run.display_unit("u")
    speeds = [factor * row.speed for row in currents.root]
    return (
        f"A constant current of each log was estimated: {format_number(statistics.mean(speeds), 2)}"
        f" {unit} on average, at most {format_number(max(speeds), 2)} {unit}; errors are those of"
        " the motion through the water."
    )


def verdict_level(run: RunFiles) -> str:
    """Return the level of the verdict on the selected model; empty if it has no free runs."""
    return rate_model(collect_evidence(run, run.main_model))


class _OpeningRow(NamedTuple):
    """A line of the table at the start of the report.

    Attributes:
        model: name of the model; None for the integrated measured velocities.
        errors: name -> pose error at the main horizon.
        intervals: name -> prediction interval of the error.
        divergence: number of diverged windows in words; empty without divergence.
    """

    model: str | None
    errors: Mapping[str, float]
    intervals: Mapping[str, Interval | None]
    divergence: str


def _list_opening_rows(run: RunFiles, rows: Mapping[str, MetricsRow]) -> list[_OpeningRow]:
    """Return the lines of the table at the start of the report, in the order of `opening_section`.

    The errors are those at the main horizon. Without a main horizon they are the errors at the ends
    of the free runs, which have no prediction intervals.
    """
    horizon = run.main_horizon
    line_by_model = {
        model_name: _OpeningRow(
            model_name,
            row.final_pose_errors if horizon is None else horizon.models[model_name].by_name,
            {} if horizon is None else horizon.models[model_name].intervals,
            describe_divergence(row),
        )
        for model_name, row in rows.items()
        if horizon is None or model_name in horizon.models
    }
    leading_models = [run.main_model, run.selected, run.baseline, CONSTANT_VELOCITY]
    leading_lines = [
        line_by_model[model_name]
        for model_name in dict.fromkeys(leading_models)
        if model_name is not None and model_name in line_by_model
    ]
    limits = run.find_limits(run.main_protocol)
    kinematic_errors = {} if limits is None else limits.kinematics.means
    noise_floor = kinematic_errors if horizon is None else horizon.floor.by_name
    # logs without a measured pose have the integral of the velocities as their pose: then the
    # difference is only a rounding error
    if any(error > 1e-9 for error in noise_floor.values()):
        intervals = {} if horizon is None else horizon.floor.intervals
        leading_lines.append(_OpeningRow(None, noise_floor, intervals, ""))
    return leading_lines + sorted(
        (line for model_name, line in line_by_model.items() if model_name not in leading_models),
        key=lambda line: line.errors[run.pose_errors[0]],
    )


def opening_section(run: RunFiles, figures: Sequence[Figure]) -> Section | None:
    """Return the section below the verdict: figures of a free run, and the errors of the models.

    Row order: predictor, selected model, baseline, constant velocity, noise floor of the
    measurements, then the other models by increasing error. A second table has the errors of the
    main model at all horizons. None if there is no free run.

    Args:
        figures: figures of the free run that represents the main model.
    """
    rows = {
        model_name: row
        for model_name in run.model_kinds
        if (row := run.find_row(model_name, run.report_split, run.main_protocol))
    }
    if run.main_model not in rows or not run.pose_errors:
        return None
    faults_by_model = {
        entry.model: entry.faults for entry in (run.selection.models if run.selection else ())
    }
    lines = _list_opening_rows(run, rows)
    smallest_errors = {
        pose_error: min(
            line.errors[pose_error]
            for line in lines
            # the plant is the simulator itself, not a competitor
            if line.model is not None and line.model != run.plant
        )
        for pose_error in run.pose_errors
    }

    def error_cell(line: _OpeningRow, pose_error: str, factor: float) -> Cell:
        error = line.errors[pose_error]
        interval = line.intervals.get(pose_error)
        note = "–".join(format_number(factor * bound, 2) for bound in interval) if interval else ""
        is_smallest = line.model is not None and error == smallest_errors[pose_error]
        return Cell(format_number(factor * error, 2), note, "best" if is_smallest else "")

    def model_name(line: _OpeningRow) -> str:
        return _NOISE_FLOOR_ROW if line.model is None else run.model_label(line.model)

    def fault_text(line: _OpeningRow) -> str:
        return next(iter(faults_by_model.get(line.model or "", ())), "")

    def soundness_cell(line: _OpeningRow) -> Cell:
        if fault_text(line) or line.divergence:
            return Cell("✗", line.divergence, "text")
        return Cell("✓" if line.model in faults_by_model else DASH, mark="text")

    windows = rows[run.main_model].windows
    if run.main_horizon is not None:
        windows = run.main_horizon.windows
    has_intervals = any(any(line.intervals.values()) for line in lines)
    notes = [
        f"Mean of {format_count(windows, 'free run')} on {run.report_data_name}"
        f" ({run.main_protocol})"
        + (
            "; small print: 95 % prediction interval of the mean of equally many new free runs."
            if has_intervals
            else "."
        ),
        ""
        if run.report_split in UNSEEN_SPLITS and not run.n_logs_of_fit_and_all[0]
        else "Fit or selection used these data: errors on new data are larger.",
        "Predictor: the model that is rated and exported by default. Selected: the best single"
        " model."
        if run.predictor != run.selected
        else "",
        "Baseline: the identified physics without a learned part." if run.baseline in rows else "",
        "constant_velocity: the initial velocities are held." if CONSTANT_VELOCITY in rows else "",
        "Plant: the simulator that made the logs." if run.plant in rows else "",
        "Noise floor: the error of the integrated measured velocities."
        if any(line.model is None for line in lines)
        else "",
        "Sound: all physical checks passed and no free run diverged." if faults_by_model else "",
        *(f"✗ {model_name(line)}: {reason}." for line in lines if (reason := fault_text(line))),
    ]
    error_table = build_table(
        lines,
        [
            ("model", model_name),
            *(
                (
                    f"{name} [{unit}]",
                    lambda line, pose_error=pose_error, factor=factor: error_cell(
                        line, pose_error, factor
                    ),
                )
                for pose_error, (name, unit, factor) in (
                    (pose_error, run.pose_error_unit(pose_error)) for pose_error in run.pose_errors
                )
            ),
            ("sound", soundness_cell),
        ],
        groups=[(f"error {run.horizon_text}", len(run.pose_errors))],
        is_selected=lambda line: line.model == run.main_model,
    )
    return Section(
        "",
        [
            *figures,
            error_table,
            Text(" ".join(filter(None, notes)), is_secondary=True),
            _build_horizon_table(run),
        ],
    )


def _build_horizon_table(run: RunFiles) -> Table | None:
    """Return the errors of the main model at all horizons; None if only one is known."""
    evidence = collect_evidence(run, run.main_model)
    horizons = known_horizons(evidence)
    if len(horizons) < 2 or run.main_horizon is None:
        return None
    main_seconds = run.main_horizon.seconds

    def error_cell(horizon: ProtocolHorizon, pose_error: str, factor: float) -> Cell:
        errors = horizon.row.models[run.main_model]
        interval = errors.intervals[pose_error]
        note = "–".join(format_number(factor * bound, 2) for bound in interval) if interval else ""
        return Cell(format_number(factor * errors.by_name[pose_error], 2), note)

    return build_table(
        horizons,
        [
            ("after", lambda horizon: format_seconds(horizon.row.seconds)),
            *(
                (
                    f"{name} [{unit}]",
                    lambda horizon, pose_error=pose_error, factor=factor: error_cell(
                        horizon, pose_error, factor
                    ),
                )
                for pose_error, (name, unit, factor) in (
                    (pose_error, run.pose_error_unit(pose_error)) for pose_error in run.pose_errors
                )
            ),
            ("free runs", lambda horizon: f"{horizon.row.windows} ({horizon.protocol})", str),
            (
                "level",
                lambda horizon: _HORIZON_LEVELS[rate_horizon(evidence, horizon.row)],
            ),
        ],
        # a long name of the model in the table would be wider than a phone
        caption=f"Errors of {run.main_model} by the length of the free run.",
        is_selected=lambda horizon: horizon.row.seconds == main_seconds,
    )


def cautions_section(run: RunFiles) -> Section | None:
    """Return the objections to the use of the main model; None without objections."""
    sentences = []
    main_model = run.predictor
    for protocol in run.protocols:
        row = run.find_row(main_model, run.report_split, protocol)
        baseline_row = run.find_row(run.baseline, run.report_split, protocol)
        training_row = run.find_row(main_model, "train", protocol)
        if row is None:
            continue
        worse_channels = [
            channel_title(c)
            for c in run.channels
            if baseline_row is not None
            and main_model != run.baseline
            and row.rmse[c] > 1.005 * baseline_row.rmse[c]
        ]
        if worse_channels:
            sentences.append(
                f"Protocol {protocol}: {main_model} is worse than the baseline in"
                f" {', '.join(worse_channels)}."
            )
        if (
            training_row is not None
            and training_row is not row
            and row.mean_nrmse > 1.5 * training_row.mean_nrmse
        ):
            ratio_text = f"{row.mean_nrmse / training_row.mean_nrmse:.1f} times its training error"
            sentences.append(
                f"Protocol {protocol}: the {run.report_split} error of {main_model} is"
                f" {ratio_text}; it may be"
                f" overfitted, or the {run.report_split} data differ."
            )
    sentences += [
        text
        for text in (worse_than_reference_sentence(run, protocol) for protocol in run.protocols)
        if text
    ]
    # only the first sentence; the section of the physical checks has the figures
    failed_findings = [
        finding
        for finding in run.sanity_findings
        if finding.ok is False and finding.model == main_model
    ]
    sentences += [
        f"{finding.model}, {finding.check}: {finding.text.partition('. ')[0].rstrip('.')}."
        for finding in failed_findings
    ]
    blocks = [Bullets([format_minus_signs(text) for text in sentences], is_warning=True)]
    return Section("Before you use it", blocks) if sentences else None


def worse_than_reference_sentence(run: RunFiles, protocol: str) -> str:
    """Return which heads and ensembles are worse than their reference by more than 5 %, and where.

    The sentence names the kinds of manoeuvre; it is empty where no model is worse.
    """
    model_texts = []
    for model in run.heads:
        rows = [
            row
            for manoeuvre_kind in distinct_manoeuvres(run, run.report_split, protocol)
            if (row := run.find_row(model, run.report_split, protocol, manoeuvre_kind))
        ]
        worse_rows = [
            (row.manoeuvre.replace("_", " "), row.difference)
            for row in rows
            if row.difference is not None
            and row.difference.worse
            and run.model_kinds[model] in ("head", "ensemble")
        ]
        if worse_rows:
            kinds_text = ", ".join(
                f"{manoeuvre} {format_percent_change(100 * ((difference.ratio or 1.0) - 1))}"
                for manoeuvre, difference in worse_rows
            )
            model_texts.append(f"{model} against {worse_rows[0][1].to} ({kinds_text})")
    return (
        f"Protocol {protocol}: worse by more than 5 % in NRMSE on {run.report_split} data:"
        f" {'; '.join(model_texts)}."
        if model_texts
        else ""
    )


def sanity_section(run: RunFiles) -> Section | None:
    """Return the results of the physical checks of each model; None if no model was checked."""
    if not run.sanity_findings:
        return None
    findings_by_model: dict[str, dict[str, SanityRow]] = {}
    for finding in run.sanity_findings:
        findings_by_model.setdefault(finding.model, {})[finding.check] = finding
    result_cells = {
        None: Cell("n/a", mark="weak"),
        True: Cell("✓ ok"),
        False: Cell("✗ look", mark="bad"),
    }
    table = build_table(
        findings_by_model,
        [
            ("model", str),
            *(
                (check, lambda model, check=check: result_cells[findings_by_model[model][check].ok])
                for check in SANITY_CHECKS
            ),
        ],
        is_selected=lambda model: model == run.selected,
    )
    details = [
        Section(
            run.model_label(model),
            [
                Facts(
                    [
                        (check, format_minus_signs(finding.text))
                        for check, finding in model_findings.items()
                    ],
                    failed=[
                        check for check, finding in model_findings.items() if finding.ok is False
                    ],
                )
            ],
            is_folded=model != run.selected,
        )
        for model, model_findings in findings_by_model.items()
    ]
    return Section("Physical sanity", [table, *details])

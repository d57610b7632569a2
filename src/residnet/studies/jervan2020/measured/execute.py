"""Task `force_residual`: residual models of measured forces (Jervan 2020, chapter 5).

Every model is cross-validated and compared with two references: zero force and the believed hull.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import ConfigError, FitError
from residnet.core.format import (
    format_count,
    format_fixed,
    format_interval,
    format_number,
    format_signed,
    join_list,
)
from residnet.core.layout import HEADING
from residnet.core.stretches import find_runs
from residnet.evaluation.intervals import bootstrap_intervals
from residnet.physics.force_model import ForceModel
from residnet.report.blocks import Bullets, Cell, Section, Table, Text, build_table
from residnet.report.figure import (
    BLUE,
    DASHED_STYLE,
    GREY,
    MASKED_STYLE,
    SOLID_STYLE,
    ZERO_LINE_STYLE,
    Case,
    Figure,
    GlyphStyle,
    Panel,
    error_bars,
    tick_labels,
)
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric
from residnet.studies.jervan2020.force_logs import (
    MeasuredForceLogs,
    compare_forces,
    read_force_logs,
)
from residnet.studies.jervan2020.measured.config import (
    REFERENCE_MODELS,
    ForceResidualConfig,
    MeasuredModelConfig,
)
from residnet.studies.jervan2020.residual import (
    AXES,
    RegressionFit,
    derive_forward_equations,
    fit_model,
    fit_to_json,
    model_figures,
    model_sections,
)
from residnet.studies.study import (
    StudyExecutor,
    StudyResults,
    comparison_columns,
    find_figures,
    format_notes,
    plot_time_series,
)

_FORCE_UNITS = tuple((label, 1.0) for label in ("surge [N]", "sway [N]", "yaw [N m]"))
"""Labels of the panels with forces, and factors from SI."""
_ACCELERATION_UNITS = tuple(
    (label, 1.0) for label in ("surge [m/s²]", "sway [m/s²]", "yaw [rad/s²]")
)
"""Labels of the panels with accelerations, and factors from SI."""


def check(config: ForceResidualConfig) -> None:
    measured = read_logs(config)
    for part in measured.fold_index.unique().tolist():
        measured.split_fold(part, config.validation.gap)


def read_logs(config: ForceResidualConfig) -> MeasuredForceLogs:
    """Read forces, motions and segments of the measured logs of the study."""
    return read_force_logs(config.data, config.channels, config.prepare, config.validation)


@final
class ForceResidualExecutor(StudyExecutor[ForceResidualConfig]):
    """Cross-validate regressions of the residual force on measured logs."""

    def compute_results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        return run_force_study(self.config)

    def summarize(self, results: StudyResults) -> list[str]:
        """Return sentences on the improvement by regressions for each force."""
        sentences: list[str] = []
        for force, rows in _rows_by_force(results).items():
            if results["intervals"] is None:
                sentences.append(
                    f"{force.capitalize()} force: there are too few segments to compare models."
                )
                continue
            believed = rows["believed"]
            bounds = believed["minus_zero"]["ci95"][:3]
            worse_axes = [axis for axis, limits in zip(AXES, bounds, strict=True) if limits[0] > 0]
            sentences.append(
                f"{force.capitalize()} force: the believed model is better than no force"
                f" {_axes_text(is_significantly_better(believed, 'zero'))}"
                + (f", and worse than no force in {join_list(worse_axes)}." if worse_axes else ".")
            )
            sentences += _gain_sentences(
                [row for name, row in rows.items() if name not in REFERENCE_MODELS]
            )
        thrusters = results["forces"]["lag"]
        lags = {name: model["all"].get("lag") for name, model in results["models"].items()}
        lag_texts = [
            f"{format_number(lag['frequency'])} rad/s and {format_number(lag['delay'], 2)} s"
            f" for {name}"
            for name, lag in lags.items()
            if lag
        ]
        if lag_texts and not isinstance(thrusters, str):
            sentences.append(
                f"The lag fitted together with the residual is {join_list(lag_texts)}; the actual"
                f" forces"
                f" follow the commands with {format_number(thrusters['frequency'])} rad/s and"
                f" {format_number(thrusters['delay'], 2)} s."
            )
        return sentences

    def main_figures(self, results: StudyResults) -> dict[str, SummaryMetric]:
        figures: dict[str, SummaryMetric] = {}
        for force, rows in _rows_by_force(results).items():
            best_row = min(rows.values(), key=lambda row: sum(row["of_zero"]))
            for row in (rows["believed"], best_row):
                name = f"share of the {force} force left by {row['model']}"
                figures[name] = SummaryMetric(sum(row["of_zero"]) / 3)
        return figures

    def build_sections(self, results: StudyResults, run: Path) -> list[Section]:
        previews = [picture.preview() for picture in find_figures(run, "scores")]
        first_group = next(iter(_rows_by_force(results).values()))
        sections_written = [
            Section(
                "",
                [*previews, _model_table(self.config, results, first_group).select_columns(3, 6)],
            ),
            _data_section(self.config, results),
            _force_section(results, run),
        ]
        if results["acceleration"]:
            sections_written.append(_acceleration_section(results, run))
        for force, rows in _rows_by_force(results).items():
            sections_written.append(
                Section(
                    f"Residual of the {force} force", [_model_table(self.config, results, rows)]
                )
            )
        sections_written.append(
            Section("Errors and residuals", find_figures(run, "scores", "residual_"))
        )
        if results["failed"]:
            failure_reasons = list(results["failed"].values())
            sections_written.append(
                Section("Not determined by these logs", [Bullets(failure_reasons)])
            )
        title = "Coefficients of models fitted to all samples"
        return sections_written + model_sections(title, results["models"], run, "all", {})


class CrossValidatedModel(NamedTuple):
    """A model that the logs determine.

    Attributes:
        error: residual [N, 3] in N, N, N m on the test folds; NaN for unused samples.
        folds: hyperparameters selected in each fold.
        fit: coefficients fitted to all usable samples, for display only.
        not_forward: reason why it cannot run forward in time; empty if it can.
    """

    error: Tensor
    folds: list[dict[str, Any]]
    fit: RegressionFit
    not_forward: str


def run_force_study(config: ForceResidualConfig) -> tuple[dict[str, Any], list[Figure]]:
    """Read the logs, fit and evaluate all models; return the results for JSON, and figures.

    A model that the logs do not determine is listed with the reason instead.

    Raises:
        ResidnetError: if a log cannot be used or no model is determined.
    """
    measured = read_logs(config)
    believed = ForceModel(config.believed_hull())
    models = dict[str, CrossValidatedModel]()
    failures = dict[str, str]()
    for name, model_config in config.models.items():
        try:
            models[name] = _cross_validate(config, name, model_config, measured, believed)
        except FitError as error:
            failures[name] = f"model {name}: {error}"
    if not models:
        raise FitError(next(iter(failures.values())))
    record = measured.record
    resampling_blocks = measured.resampling_blocks()
    motion = record.nu_dot, record.nu, record.pose[:, HEADING]
    unmodelled = {
        force_kind: believed.force_residual(force, *motion)
        for force_kind, force in measured.forces.items()
    }
    rows = _evaluation_rows(config, measured, models, unmodelled)
    content = {
        "schema": "residnet.force_residual/1",
        "run": config.name,
        "logs": [
            {"name": name, "samples": count, "seconds": count * record.dt}
            for name, count in zip(measured.names, record.run_lengths, strict=True)
        ],
        "samples": len(measured.usable),
        "used": int(measured.usable.sum()),
        "masked": measured.masked_shares,
        "folds": {"of": measured.fold_unit, "count": int(measured.fold_index.max()) + 1},
        "intervals": None
        if resampling_blocks is None
        else resampling_blocks.to_record().model_dump(),
        "forces": compare_forces(measured),
        "acceleration": measured.acceleration_comparison,
        "rows": rows,
        "failed": failures,
        "models": {
            name: {
                "folds": model.folds,
                "all": model.fit.notes,
                "runs_forward": not model.not_forward,
                "not_forward": model.not_forward,
                **fit_to_json(config.models[name].terms, model.fit),
            }
            for name, model in models.items()
        },
    }
    signals = [
        ("forces", "Commanded and actual force", measured.forces, _FORCE_UNITS),
        (
            "accelerations",
            "Measured acceleration and derivative of velocity",
            measured.accelerations,
            _ACCELERATION_UNITS,
        ),
    ]
    # the model of the actual force with the smallest cross-validated error
    actual_force_errors = {
        row["model"]: row["minus_believed"]["mean"][3]
        for row in rows
        if row["force"] == "actual" and row["model"] in models
    }
    if actual_force_errors:
        best_name = min(actual_force_errors, key=actual_force_errors.__getitem__)
        residual = unmodelled["actual"]
        compared_signals = {"residual of the believed model": residual}
        compared_signals[f"predicted by {best_name}"] = residual - models[best_name].error
        title = f"Residual of the believed model and what {best_name} predicts on left-out folds"
        signals.append(("residual", title, compared_signals, _FORCE_UNITS))
    figures = [_score_figure(rows)]
    start = 0
    for name, length in zip(measured.names, record.run_lengths, strict=True):
        log_samples = slice(start, start + length)
        figures += [
            _signal_figure(measured, name, log_samples, *signal) for signal in signals if signal[2]
        ]
        start += length
    believed_mse = {row["force"]: row["mse"] for row in rows if row["model"] == "believed"}
    for name, model in models.items():
        model_config = config.models[name]
        figures += model_figures(
            name, model_config, model.fit, believed_mse[model_config.evaluation_force]
        )
    return content, figures


def _cross_validate(
    config: ForceResidualConfig,
    name: str,
    model_config: MeasuredModelConfig,
    measured: MeasuredForceLogs,
    believed: ForceModel,
) -> CrossValidatedModel:
    """Fit a model for each fold on the samples outside and away from it, and to all of them.

    Raises:
        FitError: if the training samples do not determine the model.
    """
    target = measured.forces[model_config.evaluation_force]
    command = measured.forces[model_config.force]
    error = torch.full_like(target, torch.nan)
    folds = []
    for fold_index in range(int(measured.fold_index.max()) + 1):
        record, test = measured.split_fold(fold_index, config.validation.gap)
        model = fit_model(model_config, replace(record, command=command), believed)
        motion = record.nu_dot[test], record.nu[test], record.pose[test, HEADING]
        error[test] = model.force.force_residual(target[test], *motion)
        folds.append(model.fit.notes)
    # fitted to all samples for its coefficients; the errors above are of the folds
    model = fit_model(model_config, replace(measured.record, command=command), believed)
    not_forward = ""
    try:
        derive_forward_equations(config.believed, model.force, f"model {name}")
    except (ConfigError, FitError) as forward_error:
        not_forward = str(forward_error)
    return CrossValidatedModel(error, folds, model.fit, not_forward)


def _evaluation_rows(
    config: ForceResidualConfig,
    measured: MeasuredForceLogs,
    models: Mapping[str, CrossValidatedModel],
    unmodelled: Mapping[str, Tensor],
) -> list[dict[str, Any]]:
    """Return the rows of all models, grouped by the force of the evaluation.

    Every group begins with `zero` (zero force) and `believed` on the same samples. `reference` is
    the better of the two on each axis, since a believed model may be worse than zero force.
    """
    groups: dict[str, list[str]] = {}
    for name in models:
        groups.setdefault(config.models[name].evaluation_force, []).append(name)
    segments = measured.usable_segments()
    resampling_blocks = measured.resampling_blocks()
    rows: list[dict[str, Any]] = []
    for force, names in groups.items():
        residuals = {"zero": measured.forces[force], "believed": unmodelled[force]}
        residuals |= {name: models[name].error for name in names}
        errors = {
            name: np.stack([error[segment].square().mean(0).numpy() for segment in segments])
            for name, error in residuals.items()
        }
        best_reference = [
            min(REFERENCE_MODELS, key=lambda name: float(errors[name][:, a].mean()))
            for a in range(3)
        ]
        reference_errors = {name: errors[name] for name in REFERENCE_MODELS}
        reference_errors["reference"] = np.stack(
            [errors[name][:, a] for a, name in enumerate(best_reference)], axis=1
        )
        # not zero, since an axis without any force would divide by it
        zero_error = np.maximum(errors["zero"].mean(0), 1e-300)
        for name, error in errors.items():
            row = {
                "force": force,
                "model": name,
                "mse": error.mean(0).tolist(),
                "of_zero": (error.mean(0) / zero_error).tolist(),
                "segments": len(segments),
                "reference": best_reference,
            }
            for reference_name, reference_error in reference_errors.items():
                if reference_name != name:
                    # by axis, and for their mean
                    relative_difference = (error - reference_error) / zero_error
                    columns = np.concatenate(
                        (relative_difference, relative_difference.mean(1, keepdims=True)), axis=1
                    )
                    row[f"minus_{reference_name}"] = {
                        "mean": columns.mean(0).tolist(),
                        "ci95": bootstrap_intervals(columns, resampling_blocks),
                        "segments_below": (columns < 0).mean(0).tolist(),
                    }
            rows.append(row)
    return rows


def is_significantly_better(row: Mapping[str, Any], reference: str) -> list[bool]:
    """Return whether a model's error is smaller than another's with 95 % confidence.

    Args:
        reference: `zero`, `believed`, or `reference`, the better of the two on each axis.

    Returns:
        One flag each for surge, sway, yaw and the mean over the axes.
    """
    return [
        interval is not None and interval[1] < 0 for interval in row[f"minus_{reference}"]["ci95"]
    ]


def _signal_figure(
    measured: MeasuredForceLogs,
    log: str,
    log_samples: slice,
    figure_kind: str,
    title: str,
    signals: Mapping[str, Tensor],
    units: Sequence[tuple[str, float]],
) -> Figure:
    """Return two signals along one log, masked stretches in grey."""
    t = (measured.record.t[log_samples] - measured.record.t[log_samples.start]).numpy()
    starts, stops = find_runs(~measured.usable[log_samples].numpy())
    first, second = signals
    styles = {"masked": MASKED_STYLE, first: DASHED_STYLE, second: SOLID_STYLE}
    for label in signals:
        styles[label] = replace(styles[label], label=label, width=1.1)
    title_and_caption = (
        f"{title}, log {log}",
        f"{title}, log {log}; {first} (dashed) and {second} (solid).",
    )
    paths = {label: signal[log_samples].numpy() for label, signal in signals.items()}
    masked = {"masked": (t[starts], t[stops - 1])}
    return plot_time_series(
        f"{figure_kind}_{log}", title_and_caption, styles, t, paths, units, shared_traces=masked
    )


def _score_figure(rows: Sequence[StudyResults]) -> Figure:
    """Return a figure of every model's error minus the error of the believed model, with intervals.

    One panel for each force; errors are in % of its mean square.
    """
    styles = {
        "zero": replace(ZERO_LINE_STYLE, kind="vline"),
        "better interval": GlyphStyle("", BLUE),
        "better": GlyphStyle("better than the believed model", BLUE, kind="points", size=4.5),
        "other interval": GlyphStyle("", GREY),
        "other": GlyphStyle("not significantly better", GREY, kind="points", marker="s", size=4.5),
    }
    panels = []
    panel_traces = []
    for force in dict.fromkeys(row["force"] for row in rows):
        # reversed, since the figure counts its rows from the bottom
        force_rows = [row for row in rows if row["force"] == force and row["model"] != "believed"][
            ::-1
        ]
        points: dict[str, list[tuple[float, ...]]] = {"better": [], "other": []}
        for row_index, row in enumerate(force_rows):
            mean = row["minus_believed"]["mean"][3]
            confidence_interval = row["minus_believed"]["ci95"][3]
            limits = (np.nan, np.nan) if confidence_interval is None else confidence_interval
            point_kind = (
                "better"
                if confidence_interval is not None and confidence_interval[1] < 0
                else "other"
            )
            points[point_kind].append((row_index, 100 * mean, 100 * limits[0], 100 * limits[1]))
        traces = {"zero": (np.zeros(1), np.zeros(1))}
        for point_kind, kind_points in points.items():
            if kind_points:
                positions, mean, lower, upper = np.array(kind_points).T
                traces[point_kind] = (mean, positions)
                traces[f"{point_kind} interval"] = error_bars(positions, lower, upper)[::-1]
        panel_traces.append(traces)
        panels.append(
            Panel(
                "",
                "squared error minus that of the believed model, mean over axes"
                " [% of the mean square]",
                f"{force} force",
                height=50 + 31 * len(force_rows),
                y_names=tick_labels(row["model"] for row in force_rows),
            )
        )
    return Figure(
        "scores",
        "Errors compared with the believed model",
        "Squared error of each model less that of the believed model, both on data not used in"
        " their fit, with 95 % intervals.",
        styles,
        panels,
        [Case("", panel_traces)],
    )


def _axes_text(flags: Sequence[bool]) -> str:
    names = [
        name for name, is_true in zip((*AXES, "the mean over axes"), flags, strict=False) if is_true
    ]
    return f"in {join_list(names)}" if names else "on no axis"


def _gain_sentences(regression_rows: Sequence[StudyResults]) -> list[str]:
    """Return sentences on the gain of the regressions of one force, and a recommendation by axis.

    A regression is recommended if it is significantly better on that axis; of several, the one with
    the smallest error. Otherwise the better of zero force and the believed model is recommended.
    """
    reference_text = "the better of no force and the believed model on each axis"
    flags_by_model = {
        row["model"]: is_significantly_better(row, "reference") for row in regression_rows
    }
    better_models = [row for row in regression_rows if flags_by_model[row["model"]][3]]
    if not better_models:
        sentences = [
            f"None of the {len(regression_rows)} regressions is better than {reference_text}:"
            f" every interval of the mean"
            " over the axes reaches zero."
        ]
    else:
        gain = -100 * min(row["minus_reference"]["mean"][3] for row in better_models)
        sentences = [
            f"Of {len(regression_rows)} regressions, these are better than {reference_text} in"
            f" the mean over the axes:"
            f" {join_list([row['model'] for row in better_models])}. The largest gain is"
            f" {format_fixed(gain, 1)} %"
            " of the force's mean square."
        ]
    single_axis_texts = [
        f"{name} ({_axes_text(flags[:3])})"
        for name, flags in flags_by_model.items()
        if any(flags[:3])
    ]
    if single_axis_texts:
        sentences.append(
            f"Better on single axes: {join_list(single_axis_texts)}; of"
            f" {3 * len(regression_rows)} such comparisons, one in"
            " forty comes out so by chance."
        )
    worse_models = [
        row["model"] for row in regression_rows if row["minus_reference"]["ci95"][3][0] > 0
    ]
    if worse_models:
        sentences.append(f"Significantly worse: {join_list(worse_models)}.")
    axes_by_model: dict[str, list[str]] = {}
    for axis, name in enumerate(AXES):
        better_rows = [row for row in regression_rows if flags_by_model[row["model"]][axis]]
        recommended = REFERENCE_MODELS[regression_rows[0]["reference"][axis]]
        if better_rows:
            recommended = min(better_rows, key=lambda row: float(row["mse"][axis]))["model"]
        axes_by_model.setdefault(recommended, []).append(name)
    recommendations = [
        f"{recommended} in {join_list(axes)}" for recommended, axes in axes_by_model.items()
    ]
    return [*sentences, f"Recommended: {', '.join(recommendations)}."]


def _rows_by_force(results: StudyResults) -> dict[str, dict[str, StudyResults]]:
    """Group the rows of study.json: force -> model -> row."""
    rows_by_force: dict[str, dict[str, StudyResults]] = {}
    for row in results["rows"]:
        rows_by_force.setdefault(row["force"], {})[row["model"]] = row
    return rows_by_force


def _data_section(config: ForceResidualConfig, results: StudyResults) -> Section:
    log_texts = [f"{log['name']} ({log['seconds']:.0f} s)" for log in results["logs"]]
    mask_texts = [
        f"{100 * share:.1f} % of {log} by {reason}"
        for log, reasons in results["masked"].items()
        for reason, share in reasons.items()
    ]
    folds = results["folds"]
    validation = config.validation
    blocks = results["intervals"]
    fold_text = (
        "each consists of complete logs"
        if folds["of"] == "logs"
        else "each is a stretch of time of every log"
    )
    paragraphs = [
        f"Logs: {', '.join(log_texts)}. Masked: {', '.join(mask_texts) or 'nothing'};"
        f" {results['used']} of"
        f" {results['samples']} samples are used.",
        f"There are {folds['count']} folds; {fold_text}. Training data are at least"
        f" {validation.gap:g} s from the predicted data. Orders and penalties are selected within"
        f" the training data, on left-out segments of {validation.segment:g} s. Errors are means"
        " over segments.",
        "There are no intervals, because there are fewer than five segments."
        if blocks is None
        else f"Intervals (95 %) come from resampling"
        f" {format_count(blocks['count'], blocks['of'][:-1])}."
        + (
            ""
            if blocks["of"] == "logs"
            else " With so few logs they hold for these logs only, not for logs of other days."
        ),
        "The model zero predicts no force at all; believed predicts the force of the believed hull,"
        " which is a residual of zero.",
    ]
    return Section("Data and cross-validation", [Text(paragraphs)])


def _force_section(results: StudyResults, run: Path) -> Section:
    lag = results["forces"]["lag"]
    text = (
        f"The thrusters' lag is not determined: {lag}."
        if isinstance(lag, str)
        else f"The actual force follows the command with a lag of"
        f" {format_number(lag['frequency'])} rad/s,"
        f" a damping ratio of {format_number(lag['damping'])} and a delay of"
        f" {format_number(lag['delay'])} s."
    )
    table = build_table(
        [{"axis": axis, **results["forces"][axis]} for axis in AXES],
        [
            ("axis", "axis"),
            ("rms commanded", "rms_commanded", lambda value: format_number(value, 4)),
            ("rms actual", "rms_actual", lambda value: format_number(value, 4)),
            ("explained by the command %", "explained", 1, 100),
            ("explained through the lag %", "explained_with_lag", 1, 100),
            ("gain through the lag", "gain_with_lag", 3),
        ],
        caption="Forces in N, N and N m; a share is of the variance of the actual force.",
    )
    return Section("Commanded and actual force", [Text(text), table, *find_figures(run, "forces_")])


def _acceleration_section(results: StudyResults, run: Path) -> Section:
    table = build_table(
        [{"axis": axis, **results["acceleration"][axis]} for axis in AXES],
        [
            ("axis", "axis"),
            ("offset", "offset", lambda value: format_number(value, 2)),
            ("95 % interval", "offset_ci95", lambda value: format_interval(value, digits=2)),
            ("rms difference", "rms_without_offset", format_number),
            ("rms of the derivative", "rms", format_number),
            ("correlation", "correlation", 4),
        ],
        caption="In m/s^2, m/s^2 and rad/s^2; the models use the derivative of the velocity.",
    )
    title = "Measured accelerations and derivatives of velocity"
    return Section(title, [table, *find_figures(run, "accelerations_")])


def _model_table(
    config: ForceResidualConfig, results: StudyResults, group: Mapping[str, StudyResults]
) -> Table:
    """Return the table of the models evaluated on one force (Tables 5.1, 5.2, 5.4, 5.5)."""
    believed_mse = group["believed"]["mse"]
    rows = []
    for name, row in group.items():
        model_config = config.models.get(name)
        published_share = None
        notes = ""
        if model_config is not None:
            notes = format_notes(results["models"][name]["all"])
            if model_config.published is not None:
                published_share = [
                    100 * mse_with / mse_without
                    for mse_without, mse_with in zip(*model_config.published, strict=True)
                ]
        remaining_percent = [100 * a / b for a, b in zip(row["mse"], believed_mse, strict=True)]
        rows.append(
            {
                **row,
                "left": remaining_percent,
                "published": {"left": published_share},
                "notes": notes,
            }
        )

    def difference_columns(difference_key: str) -> list[Any]:
        def interval_cell(row: Any) -> Cell:
            bounds = row[difference_key]["ci95"][3] if difference_key in row else None
            return Cell(" to ".join(format_signed(100 * bound, 1) for bound in bounds or ()))

        def mean_cell(row: Any) -> Cell:
            return Cell(
                format_signed(100 * row[difference_key]["mean"][3], 1)
                if difference_key in row
                else ""
            )

        def share_below(row: Any) -> Cell:
            return Cell(
                format_fixed(100 * row[difference_key]["segments_below"][3], 0)
                if difference_key in row
                else ""
            )

        return [
            ("mean", mean_cell),
            ("95 % interval", interval_cell),
            ("segments better %", share_below),
        ]

    def axis_columns(key: str, titles: Sequence[str], text: Any) -> list[Any]:
        return [(title, lambda row, i=i: Cell(text(row[key][i]))) for i, title in enumerate(titles)]

    return build_table(
        rows,
        [
            ("model", "model"),
            *axis_columns(
                "mse",
                ("surge N^2", "sway N^2", "yaw (N m)^2"),
                lambda value: format_number(value, 4),
            ),
            *axis_columns("of_zero", AXES, lambda value: format_fixed(100 * value, 0)),
            *comparison_columns("left", AXES, 3),
            *difference_columns("minus_believed"),
            *difference_columns("minus_reference"),
            ("chosen by the estimator", "notes"),
        ],
        caption="Published: the share that the document's model of that kind left of its believed"
        " model's residual, in other trials.",
        groups=[
            ("mean square error", 3),
            ("squared error, % of zero force", 3),
            ("% of the believed model's", 3),
            ("mean over axes minus believed, % of zero force", 3),
            ("the same less the better of zero and believed on each axis", 3),
        ],
        is_selected=lambda row: row["model"] == _recommended_model(rows),
    )


def _recommended_model(rows: Sequence[Any]) -> str:
    """Return the best of the regressions that are significantly better than the reference.

    Without such a regression it is the better of zero force and the believed model."""
    better_rows = [
        row
        for row in rows
        if row["model"] not in REFERENCE_MODELS and is_significantly_better(row, "reference")[3]
    ]
    reference_rows = [row for row in rows if row["model"] in REFERENCE_MODELS]
    best_row = min(better_rows or reference_rows or rows, key=lambda row: sum(row["of_zero"]))
    return str(best_row["model"])

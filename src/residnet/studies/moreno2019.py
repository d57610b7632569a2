"""Moreno-Salinas et al. 2019: additional section in the report of a fit.

The document prints root mean square errors of u, v, r in free runs over whole records on training,
validation and test data (Tables 2 and 3). This module adds confidence intervals by moving blocks
and compares joint with separate tuning of the outputs on the same records.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydantic import ConfigDict, Field

from residnet.core.errors import UsageError
from residnet.core.format import DEGREES_PER_RADIAN, format_fixed
from residnet.core.records import FileRecord, OpenRecord
from residnet.evaluation.goodness import block_bootstrap_interval
from residnet.report.blocks import Block, Cell, Column, Section, Text, build_table
from residnet.report.figure import (
    BLUE,
    MEASURED_STYLE,
    ORANGE,
    VERMILLION,
    Case,
    Figure,
    GlyphStyle,
    Panel,
    style_family,
)
from residnet.report.figure_files import write_figure
from residnet.report.fit_studies import FitStudy
from residnet.report.run_reader import RunFiles, StoredWindow
from residnet.runs.folder import RunFolder
from residnet.studies import load_published
from residnet.studies.study import plot_time_series

_PROTOCOL = "record"
_OPTIONAL_MODEL = "gptips"
"""Model that requires the extra gp."""
_SPLITS = ("train", "validation", "test")
_COMPARED_PAIRS = {"rbf_joint": "rbf_each", "p1_joint": "p1_each", "p2_joint": "p2_each"}
_MODEL_LABELS = {
    "baseline": "Blanke",
    "rbf_joint": "RBF, joint tuning",
    "rbf_each": "RBF, separate tuning",
    "p1_joint": "polynomial p = 1, joint tuning",
    "p1_each": "polynomial p = 1, separate tuning",
    "p2_joint": "polynomial p = 2, joint tuning",
    "p2_each": "polynomial p = 2, separate tuning",
    "symbolic": "symbolic regression, sparse",
    _OPTIONAL_MODEL: "symbolic regression, GPTIPS settings",
    "constant_velocity": "constant velocity",
}
_PLOTTED_MODELS = {"baseline": ORANGE, "rbf_joint": BLUE, "p2_joint": VERMILLION}
_AXES = {"u": ("u m/s", 1.0, 4), "v": ("v m/s", 1.0, 4), "r": ("r deg/s", DEGREES_PER_RADIAN, 3)}
"""Title, factor from SI and decimals of each velocity."""


def sections(files: RunFiles) -> list[Section]:
    """Write study.json, draw Figures 5, 6 and 8 and return the study's section of the report.

    Raises:
        UsageError: if the run lacks free runs over whole records.
    """
    names = [model for model in _MODEL_LABELS if model in files.model_kinds]
    records = {
        split: [
            window for window in files.read_split_windows(split) if window.protocol == _PROTOCOL
        ]
        for split in _SPLITS
    }
    if not all(records.values()):
        raise UsageError(
            f"{files.path}: study moreno2019 needs the protocol '{_PROTOCOL}' on the splits"
            f" {', '.join(_SPLITS)}"
        )
    rows = [_error_row(model, split, records[split]) for model in names for split in _SPLITS]
    pairs = [
        _difference_row(model, paired_model, split, records[split])
        for model, paired_model in _COMPARED_PAIRS.items()
        for split in _SPLITS
    ]
    content = {"schema": "residnet.moreno2019/1", "rows": rows, "pairs": pairs}
    RunFolder(files.path).write_json(files.path / "study.json", content)
    published_values = load_published("moreno2019")
    for row in rows:
        row["name"] = _MODEL_LABELS[row["model"]]
        row["published"] = published_values["rmse"].get(row["model"], {}).get(row["split"])
        row["of"] = f"{row['diverged']} of {row['records']}"
    published_rows = [
        {"name": model, "split": split, "published": published_row, "of": ""}
        for model, splits in published_values["others"].items()
        for split, published_row in splits.items()
    ]
    errors = build_table(
        [*rows, *published_rows],
        [
            ("model", "name"),
            ("split", "split"),
            *(
                _velocity_column(title, axis, factor, decimals)
                for axis, (title, factor, decimals) in enumerate(_AXES.values())
            ),
            ("diverged", lambda row: Cell(row["of"])),
        ],
        caption="Root mean square errors in free runs over complete records, with 95 % intervals by"
        " moving blocks of the squared errors. Published figures are those of the document's own"
        " ship and records.",
    )
    changes = build_table(
        pairs,
        [
            ("model", lambda row: _MODEL_LABELS[row["model"]].partition(",")[0]),
            ("split", "split"),
            *(_velocity_column(f"{name} %", i, 100.0, 0) for i, name in enumerate(_AXES)),
        ],
        caption="Change of the mean square error from separate to joint tuning of the outputs,"
        " paired by sample, with 95 % intervals. Negative values: joint tuning is better.",
    )
    folder = files.path / "figures" / "moreno2019"
    figures = [
        _record_figure(records["test"]),
        *grid_figures(files.read_record(GridNotes, "models/rbf_joint/fit.json") or GridNotes()),
    ]
    blocks: list[Block] = [
        errors,
        changes,
        *(write_figure(folder, figure) for figure in figures),
        Text(
            [
                "The equations of the document, in their most likely reading. Delta is the voltage"
                " of its motor, so that they cannot be evaluated on another ship:",
                *published_values["equations"],
            ]
        ),
    ]
    if _OPTIONAL_MODEL not in names:
        blocks.insert(
            0, Text(f"Not run: {_MODEL_LABELS[_OPTIONAL_MODEL]}, which needs the extra gp.")
        )
    return [Section("Moreno-Salinas et al. 2019", blocks)]


def _velocity_column(
    title: str, axis: int, factor: float, decimals: int
) -> Column[Mapping[str, Any]]:
    """Return a column of a velocity, with its interval and the published value as notes."""
    name = list(_AXES)[axis]

    def cell(row: Mapping[str, Any]) -> Cell:
        notes = []
        if row.get(f"{name}_ci95"):
            notes.append(
                " to ".join(format_fixed(factor * end, decimals) for end in row[f"{name}_ci95"])
            )
        if row.get("published"):
            notes.append(f"published {format_fixed(factor * row['published'][axis], decimals)}")
        text = format_fixed(factor * row[name], decimals) if name in row else ""
        return Cell(text, "; ".join(notes))

    return title, cell


def _squared_errors(model: str, records: Sequence[StoredWindow], axis: int) -> list[np.ndarray]:
    """Return the squared errors [T] of one velocity in each record.

    u and v are scored at usable samples, r at all samples.
    """
    errors = [record.predicted[model][:, axis] - record.measured[:, axis] for record in records]
    return [
        error[record.usable] ** 2 if axis < 2 else error**2
        for error, record in zip(errors, records, strict=True)
    ]


def _error_row(model: str, split: str, records: Sequence[StoredWindow]) -> dict[str, Any]:
    """Return root mean square errors over all samples of a split in SI units, with intervals."""
    row: dict[str, Any] = {
        "model": model,
        "split": split,
        "records": len(records),
        "diverged": sum(record.diverged[model] for record in records),
    }
    for axis, name in enumerate(_AXES):
        interval = block_bootstrap_interval(_squared_errors(model, records, axis))
        # the interval is of the mean square, whose lower limit may be negative
        limits = (max(interval.lower, 0.0), interval.upper)
        row[name] = math.sqrt(interval.mean)
        row[f"{name}_ci95"] = [*map(math.sqrt, limits)] if math.isfinite(interval.lower) else None
    return row


def _difference_row(
    model: str, reference_model: str, split: str, records: Sequence[StoredWindow]
) -> dict[str, Any]:
    """Return the relative difference of the mean square errors of two models, with its interval.

    Both are taken over the same samples. The difference is relative to the error of the reference;
    it is negative if the first model is better.
    """
    row: dict[str, Any] = {"model": model, "to": reference_model, "split": split}
    for axis, name in enumerate(_AXES):
        squares = _squared_errors(model, records, axis)
        reference = _squared_errors(reference_model, records, axis)
        interval = block_bootstrap_interval(
            # paired differences: errors that both models share cancel in the interval
            [a - b for a, b in zip(squares, reference, strict=True)]
        )
        reference_mse = float(np.concatenate(reference).mean())
        limits = [interval.lower / reference_mse, interval.upper / reference_mse]
        row[name] = interval.mean / reference_mse
        row[f"{name}_ci95"] = limits if math.isfinite(interval.lower) else None
    return row


def _record_figure(records: Sequence[StoredWindow]) -> Figure:
    """Return measured and predicted velocities of the longest test record (Figure 8)."""
    record = max(records, key=lambda window: len(window.t))
    title = "Figure 8 of Moreno-Salinas et al. 2019: test record in free run"
    caption = "One free run over the complete record, without the wind as an input."
    return plot_time_series(
        "8",
        (title, caption),
        {"measured": MEASURED_STYLE}
        | {
            model: GlyphStyle(_MODEL_LABELS[model], color, width=1.1)
            for model, color in _PLOTTED_MODELS.items()
        },
        record.t,
        {"measured": record.measured}
        | {model: record.predicted[model] for model in _PLOTTED_MODELS},
        [("u [m/s]", 1.0), ("v [m/s]", 1.0), ("r [deg/s]", DEGREES_PER_RADIAN)],
        height=225,
    )


GridErrors = dict[tuple[float, float], float]
"""An error for each pair of penalty and width."""


class GridPoint(OpenRecord):
    """A choice of penalty and width by free runs over the validation logs.

    Attributes:
        penalty: penalty of each output.
        sigma: width of the kernel of each output.
        diverged: number of diverged validation windows.
        validation_error: mean free-run error; None if it is not finite.
    """

    penalty: tuple[float, ...] | None = None
    sigma: tuple[float, ...] | None = None
    diverged: int = 0
    validation_error: float | None = Field(default=None, alias="validation")


class GridNotes(FileRecord):
    """fit.json of a kernel ridge regression, whose penalty and width free runs have selected.

    Attributes:
        grid: the grid points.
        cross_validated_error: mean square one-step error [widths][penalties][outputs].
    """

    model_config = ConfigDict(extra="allow")

    grid: tuple[GridPoint, ...] = Field(default=(), alias="free_run_choice")
    cross_validated_error: tuple[tuple[tuple[float, ...], ...], ...] = ()


def grid_errors(notes: GridNotes) -> tuple[GridErrors, GridErrors]:
    """Return the validation and the one-step error by penalty and width of the radial kernel.

    Only grid points with equal values for all outputs are used. One-step errors are
    cross-validated and relative to the smallest error of the axis.
    """
    validation_errors: GridErrors = {}
    for point in notes.grid:
        penalties_of_point = {*(point.penalty or ())}
        widths_of_point = {*(point.sigma or ())}
        is_common = len(penalties_of_point) == len(widths_of_point) == 1
        if is_common and not point.diverged and point.validation_error is not None:
            grid_point = (penalties_of_point.pop(), widths_of_point.pop())
            validation_errors[grid_point] = point.validation_error
    if not validation_errors:
        return {}, {}
    errors = np.asarray(notes.cross_validated_error)
    # [widths, penalties, outputs]; outputs in different units are only comparable as ratios
    relative = (errors / errors.min(axis=(0, 1))).mean(axis=-1)
    penalties, widths = (
        sorted({grid_point[i] for grid_point in validation_errors}) for i in (0, 1)
    )
    # the refined grid of a local search is not a complete product, so that its errors have no axes
    if relative.shape != (len(widths), len(penalties)):
        return validation_errors, {}
    return validation_errors, {
        (penalty, width): float(relative[i, j])
        for i, width in enumerate(widths)
        for j, penalty in enumerate(penalties)
    }


def grid_figures(notes: GridNotes) -> list[Figure]:
    """Return Figures 5 and 6, the errors over penalty and width; empty if the notes lack them."""
    error_grids = grid_errors(notes)
    if not error_grids[0]:
        return []
    names = ("lambda", "sigma")
    figures = []
    for parameter_index, parameter_text in enumerate(
        ("the penalty lambda", "the width sigma of the radial kernel")
    ):
        other_values = sorted(
            {grid_point[1 - parameter_index] for errors in error_grids for grid_point in errors}
        )
        labels = {
            other_value: f"{names[1 - parameter_index]} = {other_value:g}"
            for other_value in other_values
        }
        panels_shown = []
        for errors in error_grids:
            panel = {}
            for other_value, label in labels.items():
                points = sorted(
                    (p[parameter_index], e)
                    for p, e in errors.items()
                    if p[1 - parameter_index] == other_value
                )
                if points:
                    x, y = np.array(points).T
                    panel[label] = panel[f"{label} points"] = (x, y)
            panels_shown.append(panel)
        styles = style_family(labels.values())
        styles |= {
            f"{label} points": GlyphStyle("", style.color, kind="points", size=2.5)
            for label, style in styles.items()
        }
        panels = [
            Panel(
                f"error, {error_kind}", names[parameter_index], height=330, x_log=True, y_log=True
            )
            for error_kind in ("validation free run", "one-step, relative")
        ]
        figures.append(
            Figure(
                str(5 + parameter_index),
                f"Figure {5 + parameter_index} of Moreno-Salinas et al. 2019: error over"
                f" {parameter_text}",
                "Left: free runs over the validation record, mean of the normalised errors of u, v,"
                " r. Right: cross-validated one-step error on the training records, relative to"
                " the smallest one of each axis, mean of the axes. All three outputs have"
                " the same penalty and width here.",
                styles,
                panels,
                [Case("", panels_shown)],
                columns=2,
            )
        )
    return figures


class Moreno2019Study(FitStudy):
    """Figures 5, 6 and 8 of Moreno-Salinas et al. 2019 for a fit of its models."""

    name: ClassVar[str] = "moreno2019"
    models: ClassVar[tuple[str, ...]] = (
        *("baseline", "rbf_joint", "rbf_each", "p1_joint", "p1_each", "p2_joint", "p2_each"),
        "symbolic",
    )

    def sections(self, run: RunFiles) -> list[Section]:
        return sections(run)

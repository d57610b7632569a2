"""The report of a sweep: the best trials, the importance of the keys, and all trials."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from residnet.core.format import format_number
from residnet.report.blocks import Cell, Section, Table, Text, build_table
from residnet.report.figure import (
    SOLID_STYLE,
    VERMILLION,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    bar_outlines,
    join_with_gaps,
    step_curve,
    tick_labels,
)
from residnet.report.figure_files import write_figures
from residnet.report.records import SweepFile, SweepTrial
from residnet.report.run_reader import RunFiles
from residnet.report.sections.variants import VARIANTS_FILE, variant_sections

_MAX_SHOWN_TRIALS = 15
"""Number of the best trials in the first table, which fits on a screen."""
_MAX_LINE_LENGTH = 20
"""Maximum number of letters in a line of a label below an axis."""
_RANK_GROUPS = (
    ("worse half", 0.5, 1.0, GlyphStyle("worse half", "#B8B8B8", width=0.8)),
    ("better half", 0.1, 0.5, replace(SOLID_STYLE, label="better half", alpha=0.45, width=1.0)),
    ("best tenth", 0.0, 0.1, replace(SOLID_STYLE, label="best tenth", width=1.2)),
    ("best", 0.0, 1e-9, GlyphStyle("best", VERMILLION, width=2.4, z_order=4)),
)
"""Groups of trials by rank: name, lower and upper limit as fractions of all trials, and style."""


def parallel_coordinates(content: SweepFile) -> Figure:
    """Draw the finished trials in parallel coordinates: one axis per key, and one for the value."""
    rows = [trial for trial, _ in content.completed]
    values = np.array([value for _, value in content.completed])
    rank = np.argsort(np.argsort(values if content.minimized else -values))
    keys = content.keys
    positions, ticks = zip(
        *(_axis_positions(rows, key, key in content.log) for key in keys), strict=True
    )
    value_range = np.ptp(values) or 1.0
    heights = np.column_stack([*positions, (values - values.min()) / value_range])
    axis_marks = [*ticks, [(0.0, f"{values.min():.4g}"), (1.0, f"{values.max():.4g}")]]
    columns = np.arange(len(axis_marks), dtype=float)
    panel: dict[str, Curve] = {"axes": (columns, np.zeros(len(axis_marks)))}
    for label, lower, upper, _ in _RANK_GROUPS:
        group_heights = heights[(rank >= lower * len(rows)) & (rank < upper * len(rows))]
        panel[label] = join_with_gaps((columns, trial) for trial in group_heights)
    axis_titles = [*map(_wrap_key, keys), _wrap_key(objective_text(content))]
    end_labels = [[text for height, text in marks if height in (0.0, 1.0)] for marks in axis_marks]
    return Figure(
        "parallel_coordinates",
        "Trials over their keys",
        "Every line is a finished trial: its values, and at the right what is sought. Beneath"
        " each axis has its limits as labels. The best trial is the thick line.",
        {"axes": GlyphStyle("", "#999999", width=0.8, kind="vline", z_order=1)}
        | {label: style for label, _, _, style in _RANK_GROUPS},
        [
            Panel(
                height=400,
                x_names=tick_labels(
                    f"{name}\n{' to '.join(labels)}"
                    for name, labels in zip(axis_titles, end_labels, strict=True)
                ),
                y_names={"0": ""},
                x_limits=(-0.1, len(axis_marks) - 0.6),
            )
        ],
        [
            Case(
                "",
                [panel],
                texts=[
                    (0, column + 0.02, height, text)
                    for column, marks in enumerate(axis_marks)
                    for height, text in marks
                ],
            )
        ],
    )


def _progress_figure(content: SweepFile) -> Figure:
    """Draw the value of each trial, and the best one so far."""
    value_by_number = {trial.number: value for trial, value in content.completed}
    trial_numbers = np.array(sorted(value_by_number))
    values = np.array([value_by_number[number] for number in sorted(value_by_number)])
    running_best = np.minimum if content.minimized else np.maximum
    return Figure(
        "course",
        "Course of the sweep",
        "The value of each finished trial, and the best one by then.",
        {
            "trial": GlyphStyle("trial", "#8C8C8C", kind="points", size=3.5),
            "best": replace(SOLID_STYLE, label="best so far"),
        },
        [Panel(objective_text(content), "trial [-]", height=260)],
        [
            Case(
                "",
                [
                    {
                        "trial": (trial_numbers, values),
                        "best": step_curve(trial_numbers, running_best.accumulate(values)),
                    }
                ],
            )
        ],
    )


def _importance_figure(content: SweepFile) -> Figure:
    """Draw the share of each key in the variance of the values."""
    importances = dict(sorted(content.importance.items(), key=lambda pair: -pair[1]))
    outlines = bar_outlines(range(len(importances)), importances.values())[::-1]
    return Figure(
        "importance",
        "What each key matters",
        "How much of the variance of the values each key explains (functional analysis of variance"
        " over a forest fitted to the trials). With few trials these shares are rough.",
        {"share": GlyphStyle("share", SOLID_STYLE.color, kind="fill")},
        [
            Panel(
                "",
                "share in the variance of the values [-]",
                height=70 + 31 * len(importances),
                y_names=tick_labels(importances),
                x_limits=(0, 1),
                y_limits=(len(importances) - 0.5, -0.5),
            )
        ],
        [Case("", [{"share": outlines}])],
    )


def _axis_positions(
    rows: Sequence[SweepTrial], key: str, log: bool
) -> tuple[np.ndarray, list[tuple[float, str]]]:
    """Return the positions of the trials on the axis of a key [trials], and its tick labels."""
    key_values = [row.values[key] for row in rows]
    numbers = [
        value
        for value in key_values
        if isinstance(value, int | float) and not isinstance(value, bool)
    ]
    if len(numbers) == len(key_values):
        numeric_values = np.log(numbers) if log else np.array(numbers, dtype=float)
        value_range = np.ptp(numeric_values) or 1.0
        end_marks = [(0.0, f"{min(numbers):.4g}"), (1.0, f"{max(numbers):.4g}")]
        heights = (numeric_values - numeric_values.min()) / value_range
        return heights, end_marks[: len(set(numbers))]
    texts = [json.dumps(value) for value in key_values]
    categories = sorted(set(texts))
    step = 1.0 / max(len(categories) - 1, 1)
    marks = [(index * step, text) for index, text in enumerate(categories)]
    return np.array([categories.index(text) * step for text in texts]), marks


def _wrap_key(key: str) -> str:
    """Return a long key with line breaks between its parts."""
    lines = [""]
    for part in re.findall(r"[^. ]+[. ]?", key):
        if lines[-1] and len(lines[-1]) + len(part) > _MAX_LINE_LENGTH:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.strip() for line in lines)


def sections(run: RunFiles) -> list[Section]:
    """Return the sections with the best trials, the figures in the folder and all trials."""
    if (run.path / VARIANTS_FILE).is_file():
        return variant_sections(run)
    content = run.read_required_record(SweepFile, "sweep.json")
    figures = []
    if content.best is not None:
        figures = [parallel_coordinates(content), _progress_figure(content)]
        if content.importance:
            figures.append(_importance_figure(content))
    figures = write_figures(run.path / "figures", figures)
    introduction = [
        f"Each trial is a run of its own below trials/; sought is the"
        f" {'least' if content.minimized else 'greatest'} {objective_text(content)}.",
        "best.yaml holds the config of the best trial with all its keys.",
    ]
    by_number = sorted(content.trials, key=lambda trial: trial.number)
    best_trials = trials_table(content)
    return [
        Section(
            "",
            [
                *figures[:1],
                best_trials.select_columns(0, 1 + len(content.keys)),
                Text(introduction, is_secondary=True),
            ],
        ),
        *([Section("Figures", figures[1:])] if figures[1:] else []),
        Section("All trials", [_build_trials_table(content, by_number)], is_folded=True),
    ]


def trials_table(content: SweepFile) -> Table:
    """Return the best trials of sweep.json with their values, the best first."""
    sign = 1.0 if content.minimized else -1.0
    ranked = sorted(content.completed, key=lambda pair: (sign * pair[1], pair[0].number))
    return _build_trials_table(content, [trial for trial, _ in ranked[:_MAX_SHOWN_TRIALS]])


def _build_trials_table(content: SweepFile, rows: Sequence[SweepTrial]) -> Table:
    def value(row: SweepTrial, key: str) -> str:
        key_value = row.values[key]
        return f"{key_value:.4g}" if isinstance(key_value, float) else json.dumps(key_value)

    return build_table(
        rows,
        [
            ("trial", lambda row: row.number),
            (
                objective_text(content),
                lambda row: "" if row.value is None else format_number(row.value, 5),
                str,
            ),
            *((key, lambda row, key=key: value(row, key), str) for key in content.keys),
            ("run [s]", lambda row: row.seconds, 1),
            ("state", lambda row: Cell(row.state, row.fault, mark="text")),
        ],
        is_selected=lambda row: row.number == content.best,
    )


def objective_text(content: SweepFile) -> str:
    """Return the name and unit of the objective; dimensionless objectives have no unit sign."""
    return content.objective.removesuffix(" [-]")

"""The report of a sweep: the best trials, the importance of the keys, and all trials."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import JsonValue

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
    step_curve,
    tick_labels,
)
from residnet.report.figure_files import write_figures
from residnet.report.records import SweepFile, SweepTrial
from residnet.report.run_reader import RunFiles
from residnet.report.sections.variants import VARIANTS_FILE, variant_sections

_MAX_SHOWN_TRIALS = 15
"""Number of the best trials in the first table, which fits on a screen."""
_MAX_SLICES = 6
"""Number of keys with a slice, which fit on a screen; the most important ones are drawn."""
_MAX_LABEL_LENGTH = 16
"""Maximum number of letters of a value beside an axis."""
_SLICE_STYLES = {
    "trial": GlyphStyle("trial", "#8C8C8C", kind="points", size=4.0),
    "best tenth": GlyphStyle("best tenth", SOLID_STYLE.color, kind="points", size=5.0, z_order=4),
    "best": GlyphStyle("best", VERMILLION, kind="points", marker="^", size=8.0, z_order=5),
}
"""Styles of the trials by rank; a trial is drawn in the best group that it belongs to."""


def slice_figure(content: SweepFile) -> Figure:
    """Draw a slice for each key: the value of the key of every trial over its objective.

    The objective is on the horizontal axis of all panels, so that the tick labels of the keys
    are not rotated.
    """
    trials = [trial for trial, _ in content.completed]
    objective = np.array([value for _, value in content.completed])
    rank = np.argsort(np.argsort(objective if content.minimized else -objective))
    groups = {
        "best": rank == 0,
        "best tenth": (rank > 0) & (rank < 0.1 * len(rank)),
        "trial": rank >= max(1.0, 0.1 * len(rank)),
    }
    titles = shorten_keys(content.keys)
    keys = sorted(content.keys, key=lambda key: -content.importance.get(key, 0.0))[:_MAX_SLICES]
    panels = []
    curves: list[dict[str, Curve]] = []
    for key in keys:
        values = [trial.values[key] for trial in trials]
        positions, tick_names = _slice_positions(values, is_logarithmic=key in content.log)
        margin = 0.5 if len(tick_names) == np.ptp(positions) + 1 else 0.1 * np.ptp(positions)
        panels.append(
            Panel(
                title=titles[key],
                height=60 + 22 * max(len(tick_names), 3),
                y_names=tick_names,
                y_limits=(positions.min() - margin, positions.max() + margin) if tick_names else (),
            )
        )
        curves.append(
            {
                name: (objective[is_member], positions[is_member])
                for name, is_member in groups.items()
            }
        )
    panels[-1] = replace(panels[-1], x_label=objective_text(content))
    omitted = len(content.keys) - len(keys)
    return Figure(
        "slices",
        "Trials by key",
        f"Each point is a finished trial: the value of a key over the {objective_text(content)}."
        + (f" The {len(keys)} most important of {len(content.keys)} keys." if omitted else ""),
        _SLICE_STYLES,
        panels,
        [Case("", curves)],
    )


def _slice_positions(
    values: Sequence[JsonValue], *, is_logarithmic: bool
) -> tuple[np.ndarray, dict[str, str]]:
    """Return the vertical positions of values [trials], and the names of the ticks by position.

    Numbers are their own positions and have no names, or are logarithms whose ends and middle have
    names. Few distinct numbers, and all other values, are numbered in order.
    """
    numbers = [
        value for value in values if isinstance(value, int | float) and not isinstance(value, bool)
    ]
    if len(numbers) == len(values):
        distinct_numbers = sorted(set(numbers))
        # few numbers are categories: a linear scale would put 0, 0.001 and 0.01 onto each other
        if len(distinct_numbers) <= _MAX_SLICES:
            positions = [float(distinct_numbers.index(value)) for value in numbers]
            return np.array(positions), tick_labels(f"{value:.4g}" for value in distinct_numbers)
        if not is_logarithmic:
            return np.array(numbers, dtype=float), {}
        logarithms = np.log10(np.array(numbers, dtype=float))
        ticks = np.linspace(logarithms.min(), logarithms.max(), 3)
        return logarithms, {f"{tick:.6g}": f"{10.0**tick:.2g}" for tick in ticks}
    texts = [json.dumps(value) for value in values]
    categories = sorted(set(texts), key=lambda text: (len(text), text))
    names = [
        text if len(text) <= _MAX_LABEL_LENGTH else f"{text[: _MAX_LABEL_LENGTH - 1]}…"
        for text in categories
    ]
    return np.array([float(categories.index(text)) for text in texts]), tick_labels(names)


def shorten_keys(keys: Sequence[str]) -> dict[str, str]:
    """Return for each key the shortest list of its last parts that no other key has."""
    short_names = {}
    for key in keys:
        parts = key.split(".")
        suffixes = (".".join(parts[-count:]) for count in range(1, len(parts) + 1))
        short_names[key] = next(
            suffix
            for suffix in suffixes
            if suffix == key
            or not any(other != key and f".{other}".endswith(f".{suffix}") for other in keys)
        )
    return short_names


def _progress_figure(content: SweepFile) -> Figure:
    """Draw the value of each trial, and the best one so far."""
    value_by_number = {trial.number: value for trial, value in content.completed}
    trial_numbers = np.array(sorted(value_by_number))
    values = np.array([value_by_number[number] for number in sorted(value_by_number)])
    running_best = np.minimum if content.minimized else np.maximum
    return Figure(
        "course",
        "Progress of the sweep",
        "The objective of each finished trial, and the best one so far.",
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
    titles = shorten_keys(content.keys)
    return Figure(
        "importance",
        "Importance of the keys",
        "Share of the variance of the objective that each key explains (functional analysis of"
        " variance of a random forest fitted to the trials). With few trials the shares are"
        " uncertain.",
        {"share": GlyphStyle("share", SOLID_STYLE.color, kind="fill")},
        [
            Panel(
                "",
                "share of the variance of the objective [-]",
                height=70 + 31 * len(importances),
                y_names=tick_labels(titles[key] for key in importances),
                x_limits=(0, 1),
                y_limits=(len(importances) - 0.5, -0.5),
            )
        ],
        [Case("", [{"share": outlines}])],
    )


def sections(run: RunFiles) -> list[Section]:
    """Return the sections with the best trials, the figures in the folder and all trials."""
    if (run.path / VARIANTS_FILE).is_file():
        return variant_sections(run)
    content = run.read_required_record(SweepFile, "sweep.json")
    figures = []
    if content.best is not None:
        figures = [slice_figure(content), _progress_figure(content)]
        if content.importance:
            figures.append(_importance_figure(content))
    figures = write_figures(run.path / "figures", figures)
    introduction = [
        f"Objective: the {'smallest' if content.minimized else 'largest'}"
        f" {objective_text(content)}. Each trial is a run in trials/; best.yaml is the complete"
        " config of the best trial.",
    ]
    by_number = sorted(content.trials, key=lambda trial: trial.number)
    best_trials = trials_table(content)
    return [
        Section(
            "",
            [
                *(replace(figure, is_drawing=True, static_images=()) for figure in figures[:1]),
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
    titles = shorten_keys(content.keys)
    return build_table(
        rows,
        [
            ("trial", lambda row: row.number),
            (
                objective_text(content),
                lambda row: "" if row.value is None else format_number(row.value, 5),
                str,
            ),
            *(
                (titles[key], lambda row, key=key: format_value(row.values[key]), str)
                for key in content.keys
            ),
            ("run [s]", lambda row: row.seconds, 1),
            ("state", lambda row: Cell(row.state, row.fault, mark="text")),
        ],
        is_selected=lambda row: row.number == content.best,
    )


def format_value(value: object) -> str:
    """Return the value of a key as text, with four significant digits."""
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value)


def objective_text(content: SweepFile) -> str:
    """Return the name and unit of the objective; dimensionless objectives have no unit sign."""
    return content.objective.removesuffix(" [-]")

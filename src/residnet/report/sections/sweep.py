"""The report of a sweep: the best trials, what their keys matter, and all trials."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from residnet.core.format import number
from residnet.report.blocks import Cell, Section, Table, Text, table_of
from residnet.report.figure import (
    SOLID,
    VERMILLION,
    Case,
    Curve,
    Figure,
    Look,
    Panel,
    bars,
    joined,
    names_of,
    steps,
)
from residnet.report.figure_files import write_figures
from residnet.report.run_reader import Content, RunFiles

_SHOWN = 15
"""Trials in the first table, the best ones, which fit on a screen; the last section has all."""
_LONGEST = 20
"""Most letters of a line beneath an axis."""
_GROUPS = (
    ("worse half", 0.5, 1.0, Look("worse half", "#B8B8B8", width=0.8)),
    ("better half", 0.1, 0.5, replace(SOLID, label="better half", alpha=0.45, width=1.0)),
    ("best tenth", 0.0, 0.1, replace(SOLID, label="best tenth", width=1.2)),
    ("best", 0.0, 1e-9, Look("best", VERMILLION, width=2.4, order=4)),
)
"""Groups of trials by their rank: from which share of them, to which, and how they are drawn."""


def parallel_coordinates(content: Mapping[str, Any]) -> Figure:
    """Draw each finished trial of sweep.json as a line over its keys to its value."""
    rows = [row for row in content["trials"] if row["value"] is not None]
    values = np.array([row["value"] for row in rows])
    rank = np.argsort(np.argsort(values if content["minimized"] else -values))
    keys = list(content["keys"])
    places, ticks = zip(*(_axis(rows, key, key in content["log"]) for key in keys), strict=True)
    spread = np.ptp(values) or 1.0
    heights = np.column_stack([*places, (values - values.min()) / spread])
    named = [*ticks, [(0.0, f"{values.min():.4g}"), (1.0, f"{values.max():.4g}")]]
    columns = np.arange(len(named), dtype=float)
    panel: dict[str, Curve] = {"axes": (columns, np.zeros(len(named)))}
    for label, low, high, _ in _GROUPS:
        found = heights[(rank >= low * len(rows)) & (rank < high * len(rows))]
        panel[label] = joined((columns, trial) for trial in found)
    names = [*map(_lines, keys), _lines(objective(content))]
    ends = [[text for height, text in marks if height in (0.0, 1.0)] for marks in named]
    return Figure(
        "parallel_coordinates",
        "Trials over their keys",
        "Every line is a finished trial: its values, and at the right what is sought. Beneath"
        " each axis stands what it reaches from and to. The best trial is the thick line.",
        {"axes": Look("", "#999999", width=0.8, kind="upright", order=1)}
        | {label: look for label, _, _, look in _GROUPS},
        [
            Panel(
                height=400,
                x_names=names_of(
                    f"{name}\n{' to '.join(of)}" for name, of in zip(names, ends, strict=True)
                ),
                y_names={"0": ""},
                x_limits=(-0.1, len(named) - 0.6),
            )
        ],
        [
            Case(
                "",
                [panel],
                texts=[
                    (0, column + 0.02, height, text)
                    for column, marks in enumerate(named)
                    for height, text in marks
                ],
            )
        ],
    )


def _course(content: Mapping[str, Any]) -> Figure:
    """Draw the value of each trial, and the best one so far."""
    rows = [row for row in content["trials"] if row["value"] is not None]
    rows.sort(key=lambda row: int(row["number"]))
    numbers, values = (np.array([row[key] for row in rows]) for key in ("number", "value"))
    so_far = np.minimum if content["minimized"] else np.maximum
    return Figure(
        "course",
        "Course of the sweep",
        "The value of each finished trial, and the best one by then.",
        {
            "trial": Look("trial", "#8C8C8C", kind="points", size=3.5),
            "best": replace(SOLID, label="best so far"),
        },
        [Panel(objective(content), "trial [-]", height=260)],
        [
            Case(
                "",
                [{"trial": (numbers, values), "best": steps(numbers, so_far.accumulate(values))}],
            )
        ],
    )


def _shares(content: Mapping[str, Any]) -> Figure:
    """Draw the share of each key in the variance of the values."""
    found = dict(sorted(content["importance"].items(), key=lambda pair: -pair[1]))
    outlines = bars(range(len(found)), found.values())[::-1]
    return Figure(
        "importance",
        "What each key matters",
        "How much of the variance of the values each key explains (functional analysis of variance"
        " over a forest fitted to the trials). With few trials these shares are rough.",
        {"share": Look("share", SOLID.color, kind="fill")},
        [
            Panel(
                "",
                "share in the variance of the values [-]",
                height=70 + 31 * len(found),
                y_names=names_of(found),
                x_limits=(0, 1),
                y_limits=(len(found) - 0.5, -0.5),
            )
        ],
        [Case("", [{"share": outlines}])],
    )


def _axis(
    rows: Sequence[Mapping[str, Any]], key: str, log: bool
) -> tuple[np.ndarray, list[tuple[float, str]]]:
    """Return the heights of the trials on the axis of a key [trials], and marks on that axis."""
    found = [row["values"][key] for row in rows]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in found):
        numbers = np.log(found) if log else np.array(found, dtype=float)
        spread = np.ptp(numbers) or 1.0
        ends = [(0.0, f"{min(found):.4g}"), (1.0, f"{max(found):.4g}")]
        return (numbers - numbers.min()) / spread, ends[: len(set(found))]
    texts = [json.dumps(value) for value in found]
    kinds = sorted(set(texts))
    step = 1.0 / max(len(kinds) - 1, 1)
    marks = [(place * step, text) for place, text in enumerate(kinds)]
    return np.array([kinds.index(text) * step for text in texts]), marks


def _lines(key: str) -> str:
    """Return a long key in lines that end with its parts."""
    lines = [""]
    for part in re.findall(r"[^. ]+[. ]?", key):
        if lines[-1] and len(lines[-1]) + len(part) > _LONGEST:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.strip() for line in lines)


def sections(run: RunFiles) -> list[Section]:
    """Return the best trials, the figures that stand in the folder, and all trials."""
    content, figures = run.json("sweep.json"), []
    if content["best"] is not None:
        figures = [parallel_coordinates(content), _course(content)]
        if content["importance"]:
            figures.append(_shares(content))
    figures = write_figures(run.path / "figures", figures)
    about = [
        f"Each trial is a run of its own below trials/; sought is the"
        f" {'least' if content['minimized'] else 'greatest'} {objective(content)}.",
        "best.yaml holds the config of the best trial with all its keys.",
    ]
    by_number = sorted(content["trials"], key=lambda row: int(row["number"]))
    first = trials_table(content)
    return [
        Section(
            "", [*figures[:1], first.part(0, 1 + len(content["keys"])), Text(about, quiet=True)]
        ),
        *([Section("Figures", figures[1:])] if figures[1:] else []),
        Section("All trials", [_table(content, by_number)], folded=True),
    ]


def trials_table(content: Content) -> Table:
    """Return the best trials of sweep.json with their values, the best first."""
    sign = 1.0 if content["minimized"] else -1.0
    finished = [row for row in content["trials"] if row["value"] is not None]
    finished.sort(key=lambda row: (sign * row["value"], row["number"]))
    return _table(content, finished[:_SHOWN])


def _table(content: Content, rows: Sequence[Content]) -> Table:
    def value(row: Content, key: str) -> str:
        found = row["values"][key]
        return f"{found:.4g}" if isinstance(found, float) else json.dumps(found)

    return table_of(
        rows,
        [
            ("trial", "number"),
            (
                objective(content),
                lambda row: "" if row["value"] is None else number(row["value"], 5),
                str,
            ),
            *((key, lambda row, key=key: value(row, key), str) for key in content["keys"]),
            ("run [s]", "seconds", 1),
            ("state", lambda row: Cell(row["state"], row["fault"], mark="text")),
        ],
        selected=lambda row: row["number"] == content["best"],
    )


def objective(content: Content) -> str:
    """Return what is sought, without the sign of a number that has no unit."""
    return str(content["objective"]).removesuffix(" [-]")

"""The figures of a sweep: trials over their keys, the best value so far, what each key matters."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.report.figures.files import Drawing
from residnet.report.figures.style import DASHED, SOLID, new_figure, styled

_LONGEST = 20
"""Most letters of a line beneath an axis."""


_SIDE_BY_SIDE = 5
"""Most axes whose names have room beside each other."""
_GROUPS: tuple[tuple[str, float, float, dict[str, Any]], ...] = (
    ("worse half", 0.5, 1.0, {"color": "0.72", "linewidth": 0.8}),
    ("better half", 0.1, 0.5, {**SOLID, "alpha": 0.45, "linewidth": 1.0}),
    ("best tenth", 0.0, 0.1, {**SOLID, "linewidth": 1.2}),
    ("best", 0.0, 1e-9, {**DASHED, "linestyle": "-", "linewidth": 2.4}),
)
"""Groups of trials by their rank: from which share of them, to which, and how they are drawn."""


@styled
def parallel_coordinates(content: Mapping[str, Any]) -> Drawing:
    """Draw each finished trial as a line over its keys to its value, the best on top.

    Args:
        content: of sweep.json.
    """
    rows = [row for row in content["trials"] if row["value"] is not None]
    values = np.array([row["value"] for row in rows])
    rank = np.argsort(np.argsort(values if content["minimized"] else -values))
    keys = list(content["keys"])
    places, ticks = zip(*(_axis(rows, key, key in content["log"]) for key in keys), strict=True)
    spread = np.ptp(values) or 1.0
    heights = np.column_stack([*places, (values - values.min()) / spread])
    named = [*ticks, [(0.0, f"{values.min():.4g}"), (1.0, f"{values.max():.4g}")]]
    crowded = len(named) > _SIDE_BY_SIDE
    figure = new_figure(4.8 if crowded else 3.6)
    axes = figure.subplots()
    for column in range(len(named)):
        axes.axvline(column, color="0.6", linewidth=0.8, label="axes")
    handles = []
    for label, low, high, look in _GROUPS:
        found = heights[(rank >= low * len(rows)) & (rank < high * len(rows))]
        handles += [axes.plot(trial, label=label, **look)[0] for trial in found][:1]
    for column, marks in enumerate(named):
        for height, text in marks:
            axes.annotate(text, (column, height), (3, 2), textcoords="offset points", fontsize=7)
    names = [*map(_lines, keys), _lines(_words(content))]
    labels = [_ranged(*one) for one in zip(names, named, strict=True)]
    axes.set_xticks(range(len(named)), labels, rotation=90 if crowded else 0)
    axes.set_yticks([])
    axes.set_xlim(-0.1, len(named) - 0.6)
    axes.grid(visible=False)
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": len(_GROUPS)}
    axes.legend(handles=handles, **place)
    caption = (
        "Every line is a finished trial: its values, and at the right what is sought. Beneath"
        " each axis stands what it reaches from and to. The best trial is the thick line."
    )
    return Drawing("parallel_coordinates", "Trials over their keys", caption, figure)


@styled
def course_of_sweep(content: Mapping[str, Any]) -> Drawing:
    """Draw the value of each trial, and the best one so far."""
    rows = [row for row in content["trials"] if row["value"] is not None]
    rows.sort(key=lambda row: int(row["number"]))
    numbers = [row["number"] for row in rows]
    values = np.array([row["value"] for row in rows])
    so_far = np.minimum if content["minimized"] else np.maximum
    figure = new_figure(2.6)
    axes = figure.subplots()
    axes.plot(numbers, values, "o", markersize=3.5, color="0.55", label="trial")
    axes.step(numbers, so_far.accumulate(values), where="post", **SOLID, label="best so far")
    axes.set_xlabel("trial [-]")
    axes.set_ylabel(_words(content))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend()
    caption = "The value of each finished trial, and the best one by then."
    return Drawing("course", "Course of the sweep", caption, figure)


@styled
def shares(content: Mapping[str, Any]) -> Drawing:
    """Draw the share of each key in the variance of the values."""
    found = sorted(content["importance"].items(), key=lambda pair: pair[1])
    figure = new_figure(0.8 + 0.28 * len(found))
    axes = figure.subplots()
    axes.barh([key for key, _ in found], [share for _, share in found], color=SOLID["color"])
    axes.set_xlim(0, 1)
    axes.set_xlabel("share in the variance of the values [-]")
    caption = (
        "How much of the variance of the values each key explains (functional analysis of variance"
        " over a forest fitted to the trials). With few trials these shares are rough."
    )
    return Drawing("importance", "What each key matters", caption, figure)


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


def _words(content: Mapping[str, Any]) -> str:
    """Return what is sought, without the sign of a number that has no unit."""
    return str(content["objective"]).removesuffix(" [-]")


def _ranged(name: str, marks: Sequence[tuple[float, str]]) -> str:
    """Return the name of an axis above what it reaches from and to."""
    ends = [text for height, text in marks if height in (0.0, 1.0)]
    return f"{name}\n{' to '.join(ends)}"


def _lines(key: str) -> str:
    """Return a long key in lines that end with its parts."""
    lines = [""]
    for part in re.findall(r"[^. ]+[. ]?", key):
        if lines[-1] and len(lines[-1]) + len(part) > _LONGEST:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.strip() for line in lines)

"""Document 001 (Moreno-Salinas et al. 2019): what its study adds to the report of a fit.

The document prints root mean square errors of u, v, r in free runs over whole records on training,
validation and test data (Tables 2 and 3). Here they have intervals by moving blocks, and outputs
tuned together and each for itself are compared on the same records.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.format import DEG, fixed
from residnet.documents import published
from residnet.documents.study import histories
from residnet.judge.goodness import block_interval
from residnet.report.blocks import Block, Cell, Column, Section, Text, table_of
from residnet.report.figure import (
    BLUE,
    MEASURED,
    ORANGE,
    VERMILLION,
    Case,
    Figure,
    Look,
    Panel,
    family,
)
from residnet.report.figure_files import write_figure
from residnet.report.run_reader import RunFiles, StoredWindow
from residnet.runs.folder import RunFolder

_PROTOCOL = "record"
_OPTIONAL = "gptips"
"""The model that a run without the extra gp lacks."""
_SPLITS = ("train", "validation", "test")
_PAIRS = {"rbf_joint": "rbf_each", "p1_joint": "p1_each", "p2_joint": "p2_each"}
_NAMES = {
    "baseline": "Blanke",
    "rbf_joint": "RBF, together",
    "rbf_each": "RBF, each for itself",
    "p1_joint": "polynomial p = 1, together",
    "p1_each": "polynomial p = 1, each for itself",
    "p2_joint": "polynomial p = 2, together",
    "p2_each": "polynomial p = 2, each for itself",
    "symbolic": "symbolic regression, sparse",
    _OPTIONAL: "symbolic regression, GPTIPS settings",
    "zero": "velocities held",
}
_SHOWN = {"baseline": ORANGE, "rbf_joint": BLUE, "p2_joint": VERMILLION}
_AXES = {"u": ("u m/s", 1.0, 4), "v": ("v m/s", 1.0, 4), "r": ("r deg/s", DEG, 3)}
"""Title, factor from SI and decimals of each velocity."""


def sections(files: RunFiles) -> list[Section]:
    """Write study.json, draw Figures 5, 6 and 8 and return the study's section of the report.

    Raises:
        UsageError: where the run lacks the free runs over whole records.
    """
    names = [model for model in _NAMES if model in files.kinds]
    records = {
        split: [window for window in files.windows(split) if window.protocol == _PROTOCOL]
        for split in _SPLITS
    }
    if not all(records.values()):
        raise UsageError(
            f"{files.path}: study moreno2019 needs the protocol '{_PROTOCOL}' on the splits"
            f" {', '.join(_SPLITS)}"
        )
    rows = [_row(model, split, records[split]) for model in names for split in _SPLITS]
    pairs = [
        _pair(model, other, split, records[split])
        for model, other in _PAIRS.items()
        for split in _SPLITS
    ]
    content = {"schema": "residnet.moreno2019/1", "rows": rows, "pairs": pairs}
    RunFolder(files.path).write_json(files.path / "study.json", content)
    printed = published("moreno2019")
    for row in rows:
        row["name"] = _NAMES[row["model"]]
        row["published"] = printed["rmse"].get(row["model"], {}).get(row["split"])
        row["of"] = f"{row['diverged']} of {row['records']}"
    others = [
        {"name": model, "split": split, "published": numbers, "of": ""}
        for model, splits in printed["others"].items()
        for split, numbers in splits.items()
    ]
    errors = table_of(
        [*rows, *others],
        [
            ("model", "name"),
            ("split", "split"),
            *(
                _column(title, axis, factor, decimals)
                for axis, (title, factor, decimals) in enumerate(_AXES.values())
            ),
            ("diverged", lambda row: Cell(row["of"])),
        ],
        caption="Root mean square errors in free runs over whole records, with 95 % intervals by"
        " moving blocks of the squared errors. Published figures are those of the document's own"
        " ship and records.",
    )
    changes = table_of(
        pairs,
        [
            ("model", lambda row: _NAMES[row["model"]].partition(",")[0]),
            ("split", "split"),
            *(_column(f"{name} %", i, 100.0, 0) for i, name in enumerate(_AXES)),
        ],
        caption="Change of the mean square error from outputs tuned each for itself to outputs"
        " tuned together, paired sample by sample, with 95 % intervals. Negative: together is"
        " better.",
    )
    folder = files.path / "figures" / "moreno2019"
    figures = [_record(records["test"]), *curves(files.fit("rbf_joint"))]
    blocks: list[Block] = [
        errors,
        changes,
        *(write_figure(folder, figure) for figure in figures),
        Text(
            [
                "The equations that the document prints, in their likeliest reading; Delta is the"
                " voltage of its motor, so that they cannot be evaluated on another ship:",
                *printed["equations"],
            ]
        ),
    ]
    if _OPTIONAL not in names:
        blocks.insert(0, Text(f"Not run: {_NAMES[_OPTIONAL]}, which needs the extra gp."))
    return [Section("Document 001 (Moreno-Salinas et al. 2019)", blocks)]


def _column(title: str, axis: int, factor: float, decimals: int) -> Column:
    """Return a column of a velocity, with its interval and the published value in small print."""
    name = list(_AXES)[axis]

    def cell(row: Mapping[str, Any]) -> Cell:
        notes = []
        if row.get(f"{name}_ci95"):
            notes.append(" to ".join(fixed(factor * end, decimals) for end in row[f"{name}_ci95"]))
        if row.get("published"):
            notes.append(f"published {fixed(factor * row['published'][axis], decimals)}")
        text = fixed(factor * row[name], decimals) if name in row else ""
        return Cell(text, "; ".join(notes))

    return title, cell


def _squares(model: str, records: Sequence[StoredWindow], axis: int) -> list[np.ndarray]:
    """Return the squared errors [T] of one velocity in each record.

    Errors of u and v are taken at usable samples, those of r at all samples.
    """
    errors = [record.predicted[model][:, axis] - record.measured[:, axis] for record in records]
    return [
        error[record.usable] ** 2 if axis < 2 else error**2
        for error, record in zip(errors, records, strict=True)
    ]


def _row(model: str, split: str, records: Sequence[StoredWindow]) -> dict[str, Any]:
    """Return root mean square errors over all samples of a split in SI units, with intervals."""
    row: dict[str, Any] = {
        "model": model,
        "split": split,
        "records": len(records),
        "diverged": sum(record.diverged[model] for record in records),
    }
    for axis, name in enumerate(_AXES):
        found = block_interval(_squares(model, records, axis))
        ends = (max(found.low, 0.0), found.high)
        row[name] = math.sqrt(found.mean)
        row[f"{name}_ci95"] = [*map(math.sqrt, ends)] if math.isfinite(found.low) else None
    return row


def _pair(model: str, other: str, split: str, records: Sequence[StoredWindow]) -> dict[str, Any]:
    """Return the relative difference of the mean square errors of two models, with its interval.

    Both are taken over the same samples; the difference is a share of the other model's error, and
    negative where the first model is better.
    """
    row: dict[str, Any] = {"model": model, "to": other, "split": split}
    for axis, name in enumerate(_AXES):
        squares, reference = _squares(model, records, axis), _squares(other, records, axis)
        found = block_interval([a - b for a, b in zip(squares, reference, strict=True)])
        level = float(np.concatenate(reference).mean())
        ends = [found.low / level, found.high / level]
        row[name] = found.mean / level
        row[f"{name}_ci95"] = ends if math.isfinite(found.low) else None
    return row


def _record(records: Sequence[StoredWindow]) -> Figure:
    """Return measured and predicted velocities of the longest test record (Figure 8)."""
    record = max(records, key=lambda window: len(window.t))
    title = "Figure 8 of document 001: test record in free run"
    caption = "One free run over the whole record, without the wind as an input."
    return histories(
        "8",
        (title, caption),
        {"measured": MEASURED}
        | {model: Look(_NAMES[model], color, width=1.1) for model, color in _SHOWN.items()},
        record.t,
        {"measured": record.measured} | {model: record.predicted[model] for model in _SHOWN},
        [("u [m/s]", 1.0), ("v [m/s]", 1.0), ("r [deg/s]", DEG)],
        height=225,
    )


Errors = dict[tuple[float, float], float]
"""An error for each pair of penalty and width."""


def errors_of_grid(notes: Mapping[str, Any]) -> tuple[Errors, Errors]:
    """Return the validation and the one-step error by penalty and width of the radial kernel.

    Pairs count that all outputs share. One-step errors are cross-validated, each axis over its
    least.
    """
    grid: Errors = {}
    for entry in notes.get("free_run_choice") or []:
        values = [set(entry.get(key) or []) for key in ("penalty", "sigma")]
        if all(len(value) == 1 for value in values) and not entry["diverged"]:
            grid[values[0].pop(), values[1].pop()] = float(entry["validation"])
    if not grid:
        return {}, {}
    errors = np.asarray(notes["cross_validated_error"])
    relative = (errors / errors.min(axis=(0, 1))).mean(axis=-1)
    penalties, widths = (sorted({pair[i] for pair in grid}) for i in (0, 1))
    if relative.shape != (len(widths), len(penalties)):
        return grid, {}
    return grid, {
        (penalty, width): float(relative[i, j])
        for i, width in enumerate(widths)
        for j, penalty in enumerate(penalties)
    }


def curves(notes: Mapping[str, Any]) -> list[Figure]:
    """Return Figures 5 and 6, the errors over penalty and width; none where they are not kept."""
    both = errors_of_grid(notes)
    if not both[0]:
        return []
    names, out = ("lambda", "sigma"), []
    for over, words in enumerate(("the penalty lambda", "the width sigma of the radial kernel")):
        others = sorted({pair[1 - over] for errors in both for pair in errors})
        labels = {other: f"{names[1 - over]} = {other:g}" for other in others}
        shown = []
        for errors in both:
            panel = {}
            for other, label in labels.items():
                points = sorted((p[over], e) for p, e in errors.items() if p[1 - over] == other)
                if points:
                    x, y = np.array(points).T
                    panel[label] = panel[f"{label} points"] = (x, y)
            shown.append(panel)
        looks = family(labels.values())
        looks |= {
            f"{label} points": Look("", look.color, kind="points", size=2.5)
            for label, look in looks.items()
        }
        panels = [
            Panel(f"error, {what}", names[over], height=330, x_log=True, y_log=True)
            for what in ("validation free run", "one-step, relative")
        ]
        out.append(
            Figure(
                str(5 + over),
                f"Figure {5 + over} of document 001: error over {words}",
                "Left: free runs over the validation record, mean of the normalised errors of u, v,"
                " r. Right: cross-validated one-step error on the training records, each axis over"
                " its least, mean of the axes. All three outputs have the same penalty and width"
                " here.",
                looks,
                panels,
                [Case("", shown)],
                columns=2,
            )
        )
    return out

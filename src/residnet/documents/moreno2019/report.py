"""What the report of a run of configs/studies/moreno2019/moreno2019.yaml adds to that of a fit.

Document 001 (Moreno-Salinas et al. 2019) prints root mean square errors of u, v, r in free runs
over whole records on training, validation and test data (Tables 2 and 3). Here they have intervals
by moving blocks, and outputs tuned together and each for itself are compared on the same records.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.files import whole
from residnet.documents.moreno2019.curves import curves
from residnet.documents.moreno2019.published import EQUATIONS, MODELS, OTHERS, RMSE
from residnet.judge.residual_series import block_interval
from residnet.report.blocks import Block, Cell, Figure, Section, Table, Text
from residnet.report.figures.style import MEASURED, RC, collect, legend_above, new_figure, save
from residnet.report.format import DEG, fixed
from residnet.report.run_reader import RunFiles, StoredWindow

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
    "gptips": "symbolic regression, GPTIPS settings",
    "zero": "velocities held",
}
_SHOWN = {"baseline": "#E69F00", "rbf_joint": "#0072B2", "p2_joint": "#D55E00"}
_AXES = (("u", "m/s", 1.0), ("v", "m/s", 1.0), ("r", "deg/s", DEG))


def sections(run: Path) -> list[Section]:
    """Write study.json, draw Figures 5, 6 and 8 and return the study's section of the report.

    Raises:
        UsageError: where the run lacks a model of the study or the free runs over whole records.
    """
    files = RunFiles(run)
    names = {model: name for model, name in _NAMES.items() if model in files.kinds}
    missing = [model for model in MODELS if model not in names]
    if missing:
        raise UsageError(
            f"{run}: study moreno2019 needs the models {', '.join(MODELS)}; '{missing[0]}' is"
            " absent"
        )
    records = {
        split: [window for window in files.windows(split) if window.protocol == _PROTOCOL]
        for split in _SPLITS
    }
    if not all(records.values()):
        raise UsageError(
            f"{run}: study moreno2019 needs the protocol '{_PROTOCOL}' on the splits"
            f" {', '.join(_SPLITS)}"
        )
    rows = [_row(model, split, records[split]) for model in names for split in _SPLITS]
    pairs = [
        _pair(model, other, split, records[split])
        for model, other in _PAIRS.items()
        for split in _SPLITS
    ]
    content = {"schema": "residnet.moreno2019/1", "rows": rows, "pairs": pairs}
    with whole(run / "study.json") as file:
        file.write_text(json.dumps(content, indent=1) + "\n")
    blocks: list[Block] = [_errors(rows), _joint(pairs), _draw(records["test"], run)]
    blocks += [*curves(files), _printed()]
    if _OPTIONAL not in names:
        blocks.insert(0, Text(f"Not run: {_NAMES[_OPTIONAL]}, which needs the extra gp."))
    return [Section("Document 001 (Moreno-Salinas et al. 2019)", blocks)]


def _squares(model: str, records: Sequence[StoredWindow], axis: int) -> list[np.ndarray]:
    """Return the squared errors [T] of one velocity in each record.

    Errors of u and v are taken at usable samples, those of r at all samples.
    """
    squares = []
    for record in records:
        error = record.predicted[model][:, axis] - record.measured[:, axis]
        squares.append(error[record.usable] ** 2 if axis < 2 else error**2)
    return squares


def _row(model: str, split: str, records: Sequence[StoredWindow]) -> dict[str, Any]:
    """Return root mean square errors over all samples of a split in SI units, with intervals."""
    row: dict[str, Any] = {
        "model": model,
        "split": split,
        "records": len(records),
        "diverged": sum(r.diverged[model] for r in records),
    }
    for axis, (name, _, _) in enumerate(_AXES):
        found = block_interval(_squares(model, records, axis))
        bounded = math.isfinite(found.low)
        row[name] = math.sqrt(found.mean)
        row[f"{name}_ci95"] = (
            [math.sqrt(max(found.low, 0.0)), math.sqrt(found.high)] if bounded else None
        )
    return row


def _pair(model: str, other: str, split: str, records: Sequence[StoredWindow]) -> dict[str, Any]:
    """Return the relative difference of the mean square errors of two models, with its interval.

    Both are taken over the same samples; the difference is a share of the other model's error, and
    negative where the first model is better.
    """
    row: dict[str, Any] = {"model": model, "to": other, "split": split}
    for axis, (name, _, _) in enumerate(_AXES):
        squares, reference = _squares(model, records, axis), _squares(other, records, axis)
        found = block_interval([a - b for a, b in zip(squares, reference, strict=True)])
        level = float(np.concatenate(reference).mean())
        row[name] = found.mean / level
        row[f"{name}_ci95"] = (
            [found.low / level, found.high / level] if math.isfinite(found.low) else None
        )
    return row


def _errors(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the errors of all models in free runs over whole records (Tables 2 and 3)."""
    table = Table(
        ["model", "split", *(f"{name} {unit}" for name, unit, _ in _AXES), "diverged"],
        caption="Root mean square errors in free runs over whole records, with 95 % intervals by"
        " moving blocks of the squared errors. Published figures are those of the document's own"
        " ship and records.",
    )
    for row in rows:
        published = RMSE.get((row["model"], row["split"]))
        cells = [
            _cell(
                row[name],
                row[f"{name}_ci95"],
                factor,
                4 if factor == 1.0 else 3,
                None if published is None else published[axis],
            )
            for axis, (name, _, factor) in enumerate(_AXES)
        ]
        diverged = f"{row['diverged']} of {row['records']}"
        table.add(_NAMES[row["model"]], [Cell(row["split"], mark="text"), *cells, diverged])
    for model in OTHERS:
        for split in _SPLITS[1:]:
            values = [Cell("", f"published {fixed(v, 4)}") for v in RMSE[model, split][:2]]
            rate = Cell("", f"published {fixed(DEG * RMSE[model, split][2], 3)}")
            table.add(model, [Cell(split, mark="text"), *values, rate, ""])
    return table


def _printed() -> Text:
    """Return the published equations, which take the voltage of a motor that no public ship has."""
    return Text(
        [
            "The equations that the document prints, in their likeliest reading; Delta is the"
            " voltage of its motor, so that they cannot be evaluated on another ship:",
            *EQUATIONS,
        ]
    )


def _joint(pairs: Sequence[dict[str, Any]]) -> Table:
    """Return the comparison of outputs tuned together and each for itself."""
    table = Table(
        ["model", "split", *(f"{name} %" for name, _, _ in _AXES)],
        caption="Change of the mean square error from outputs tuned each for itself to outputs"
        " tuned together, paired sample by sample, with 95 % intervals. Negative: together is"
        " better.",
    )
    for row in pairs:
        cells = [_cell(row[name], row[f"{name}_ci95"], 100.0, 0, None) for name, _, _ in _AXES]
        name = _NAMES[row["model"]].partition(",")[0]
        table.add(name, [Cell(row["split"], mark="text"), *cells])
    return table


def _cell(
    value: float,
    bounds: Sequence[float] | None,
    factor: float,
    decimals: int,
    published: float | None,
) -> Cell:
    """Return a cell with a value, and in small print its interval and the published value.

    Args:
        value: value in SI units.
        bounds: its 95 % interval; None where there is none.
        factor: from SI units to those of the column.
        decimals: of the shown number.
        published: published value in SI units; None where there is none.
    """
    notes = []
    if bounds:
        low, high = (fixed(factor * bound, decimals) for bound in bounds)
        notes.append(f"{low} to {high}")
    if published is not None:
        notes.append(f"published {fixed(factor * published, decimals)}")
    return Cell(fixed(factor * value, decimals), "; ".join(notes))


def _draw(records: Sequence[StoredWindow], run: Path) -> Figure:
    """Draw measured and predicted velocities of the longest test record (Figure 8)."""
    from matplotlib import rc_context

    record = max(records, key=lambda window: len(window.t))
    with rc_context(RC):
        figure = new_figure(6.5)
        handles: dict[str, Any] = {}
        panels = figure.subplots(len(_AXES), 1, sharex=True)
        for row, (name, unit, factor) in enumerate(_AXES):
            panels[row].plot(record.t, factor * record.measured[:, row], **MEASURED)
            for model, colour in _SHOWN.items():
                panels[row].plot(
                    record.t,
                    factor * record.predicted[model][:, row],
                    color=colour,
                    linewidth=1.1,
                    label=_NAMES[model],
                )
            panels[row].set_ylabel(f"{name} [{unit}]")
            collect(handles, panels[row])
        panels[-1].set_xlabel("time [s]")
        legend_above(figure, handles)
        path = run / "figures" / "moreno2019" / "8.png"
        title = "Figure 8 of document 001: test record in free run"
        caption = "One free run over the whole record, without the wind as an input."
        save(figure, path, title, caption)
    return Figure(path, title, caption)

"""Tables 2 and 3 of Moreno-Salinas et al. 2019 (document 001) with our data, from a run of
configs/studies/moreno2019/moreno2019.yaml.

The document prints root mean square errors of u, v, r in free runs over whole records on training,
validation and test data. Here they have intervals by moving blocks, and outputs tuned together and
each for itself are compared on the same records.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import UsageError
from residnet.judge.residual_series import block_interval
from residnet.report.figures.style import MEASURED, RC, collect, legend_above, new_figure, save
from residnet.report.run_reader import RunFiles, StoredWindow

_PROTOCOL = "record"
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
_AXES = (("u", "m/s", 1.0), ("v", "m/s", 1.0), ("r", "deg/s", 180.0 / math.pi))


def draw(run: Path) -> list[Path]:
    """Write study.json, study.md and figures/moreno2019_8.png; returns their paths.

    Raises:
        UsageError: where the run lacks a model of the study or the free runs over whole records.
    """
    files = RunFiles(run)
    missing = [model for model in _NAMES if model not in files.kinds]
    if missing:
        raise UsageError(
            f"{run}: study moreno2019 needs the models {', '.join(_NAMES)}; '{missing[0]}' is"
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
    rows = [_row(model, split, records[split]) for model in _NAMES for split in _SPLITS]
    pairs = [
        _pair(model, other, split, records[split])
        for model, other in _PAIRS.items()
        for split in _SPLITS
    ]
    out = [run / "study.json", run / "study.md", run / "figures" / "moreno2019_8.png"]
    out[0].write_text(
        json.dumps({"schema": "residnet.moreno2019/1", "rows": rows, "pairs": pairs}, indent=1)
        + "\n"
    )
    out[1].write_text(as_text(rows, pairs))
    _histories(records["test"], out[2])
    return out


def _squares(model: str, records: Sequence[StoredWindow], axis: int) -> list[np.ndarray]:
    """Squared errors of one velocity in each record, [T]: where u and v are usable, of r at all
    samples.
    """
    out = []
    for record in records:
        error = record.predicted[model][:, axis] - record.measured[:, axis]
        out.append(error[record.usable] ** 2 if axis < 2 else error**2)
    return out


def _row(model: str, split: str, records: Sequence[StoredWindow]) -> dict[str, Any]:
    """Root mean square errors over all samples of a split, SI, with intervals."""
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
    """Difference of mean square errors of two models over the same samples, as a share of the
    other's, with its interval; negative: better.
    """
    row: dict[str, Any] = {"model": model, "to": other, "split": split}
    for axis, (name, _, _) in enumerate(_AXES):
        own, reference = _squares(model, records, axis), _squares(other, records, axis)
        found = block_interval([a - b for a, b in zip(own, reference, strict=True)])
        level = float(np.concatenate(reference).mean())
        row[name] = found.mean / level
        row[f"{name}_ci95"] = (
            [found.low / level, found.high / level] if math.isfinite(found.low) else None
        )
    return row


def as_text(rows: Sequence[dict[str, Any]], pairs: Sequence[dict[str, Any]]) -> str:
    """Both tables as Markdown."""
    lines = ["# Free runs over whole records (document 001, Tables 2 and 3)", ""]
    lines += [
        "RMSE with 95 % intervals by moving blocks of the squared errors; u, v in m/s, r in deg/s.",
        "",
    ]
    lines += ["| model | split | u | v | r | diverged |", "|---|---|---|---|---|---|"]
    for row in rows:
        cells = [
            _number(row[name], row[f"{name}_ci95"], factor, 4 if factor == 1.0 else 3)
            for name, _, factor in _AXES
        ]
        lines.append(
            f"| {_NAMES[row['model']]} | {row['split']} | {' | '.join(cells)} | {row['diverged']}"
            f" of {row['records']} |"
        )
    lines += ["", "# Tuned together against each for itself", ""]
    lines += [
        (
            "Change of the mean square error in percent with its interval, paired sample by sample;"
            " negative: together is better."
        ),
        "",
    ]
    lines += ["| model | split | u | v | r |", "|---|---|---|---|---|"]
    for row in pairs:
        cells = [_number(row[name], row[f"{name}_ci95"], 100.0, 0) for name, _, _ in _AXES]
        lines.append(
            f"| {_NAMES[row['model']].partition(',')[0]} | {row['split']} | {' | '.join(cells)} |"
        )
    return "\n".join(lines) + "\n"


def _number(value: float, bounds: Sequence[float] | None, factor: float, digits: int) -> str:
    interval = (
        f" ({factor * bounds[0]:.{digits}f} to {factor * bounds[1]:.{digits}f})" if bounds else ""
    )
    return f"{factor * value:.{digits}f}{interval}"


def _histories(records: Sequence[StoredWindow], path: Path) -> None:
    """The longest test record: measured and predicted velocities (Figure 8)."""
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
        save(
            figure,
            path,
            "Figure 8 of document 001: test record in free run",
            "One free run over the whole record, without wind.",
        )

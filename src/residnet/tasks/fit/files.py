"""What a fit and its evaluation on other logs write beside their models: tables of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.names import STATE, si_unit
from residnet.data.prepare import Prepared
from residnet.judge.metrics import LIMITS_SCHEMA, metrics_content
from residnet.judge.repeats import repeatability
from residnet.report.run_reader import RunFiles
from residnet.report.sections.free_runs import errors_table
from residnet.report.sections.verdict import verdict
from residnet.runs.folder import RunFolder
from residnet.runs.task import Exports, MainFigure, Outcome
from residnet.tasks.fit.config import FitTaskSettings


def write_metrics(
    folder: RunFolder,
    config: FitTaskSettings,
    table: Sequence[dict[str, Any]],
    selected: str,
    selected_ensemble: str | None,
) -> None:
    """Write metrics.json with schema, units, scales, what was selected, and rows."""
    units = {name: si_unit(unit) for name, unit in config.signals.units().items() if name in STATE}
    scales = config.evaluation.scales.named()
    content = metrics_content(config.name, units, scales, selected, selected_ensemble, table)
    folder.write_json(folder.metrics, content)


def write_limits(
    folder: RunFolder,
    config: FitTaskSettings,
    limiting: Mapping[str, Any],
    logs: Sequence[Prepared],
) -> None:
    """Write limits.json: where models fail and what limits them, by split and protocol.

    How well the vessel repeats itself over all logs stands there too.
    """
    scales = config.evaluation.scales.named()
    commands, step = len(config.signals.inputs), config.prepare.grid.step
    repeats = {
        name: repeatability(protocol, logs, commands, scales, step)
        for name, protocol in config.evaluation.protocols.items()
    }
    folder.write_json(
        folder.limits,
        {"schema": LIMITS_SCHEMA, "run": config.name, "splits": limiting, "repeatability": repeats},
    )


def write_data_quality(folder: RunFolder, logs: Mapping[str, Sequence[Prepared]]) -> None:
    """Write data_quality.json: what each log contributes, for the report."""
    entries = [_quality(prepared, split) for split, members in logs.items() for prepared in members]
    folder.write_json(folder.data_quality, entries)


def _quality(prepared: Prepared, split: str) -> dict[str, Any]:
    log = prepared.log
    return {
        "log": log.name,
        "split": split,
        "manoeuvre": log.manoeuvre,
        "seconds": float(log.t[-1] - log.t[0]),
        "samples": len(prepared),
        "usable": float(prepared.usable.mean()),
        "learned_from": float(prepared.good.mean()),
        "masked": {
            reason: float(np.mean(mask)) for reason, mask in log.masks.items() if mask.any()
        },
        "largest": {
            name: float(np.abs(prepared.y[prepared.usable, 3 + i]).max())
            for i, name in enumerate(("u", "v", "r"))
        },
    }


def fit_outcome(folder: RunFolder, split: str, exports: Exports | None = None) -> Outcome:
    """Return the verdict of a fit or an evaluation, and the errors of its selected model.

    Args:
        folder: where the results stand.
        split: that is shown.
        exports: what writes each export when the run ends; None for none.
    """
    metrics = folder.read_metrics()
    evaluation = RunFiles(folder.path)
    protocol = evaluation.protocols[0]
    row = evaluation.row(metrics["selected"], split, protocol)
    figures: dict[str, MainFigure] = {}
    if row is not None:
        figures = {
            "nrmse": MainFigure(row["nrmse"]["mean"]),
            "rmse_u": MainFigure(row["rmse"]["u"], "m/s"),
            "rmse_v": MainFigure(row["rmse"]["v"], "m/s"),
            "rmse_r": MainFigure(row["rmse"]["r"], "rad/s"),
            "position_error_end": MainFigure(row["position_error_end"], "m"),
            "heading_error_end": MainFigure(row["heading_error_end"], "rad"),
        }
    sentences = [sentence for sentence in verdict(evaluation) if sentence]
    return Outcome(
        sentences, figures, errors_table(evaluation, split).text(), exports=exports or {}
    )

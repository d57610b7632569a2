"""Results of a study of measured forces as they stand in its run folder: JSON and figures."""

from __future__ import annotations

from typing import Any

from residnet.documents.jervan2020.measured.config import ForceSettings
from residnet.documents.jervan2020.measured.study import (
    ForceStudy,
    judging_force,
    unmodelled,
)
from residnet.documents.jervan2020.residual_pages import draw_model, fit_as_json
from residnet.physics.force_model import ForceModel
from residnet.report.figures.measured import (
    ACCELERATION_UNITS,
    FORCE_UNITS,
    draw_pair,
    draw_scores,
)
from residnet.runs.folder import RunFolder

FILE = "force_residual.json"


def write_results(config: ForceSettings, found: ForceStudy, folder: RunFolder) -> dict[str, Any]:
    """Write force_residual.json and all figures; returns the contents of the JSON file."""
    results = _content(config, found)
    folder.write_json(folder.path / FILE, results)
    measured, start = found.measured, 0
    for name, length in zip(measured.names, measured.record.runs, strict=True):
        _draw_log(config, found, name, slice(start, start + length), folder)
        start += length
    draw_scores(found.rows, folder.figures / "scores.png")
    believed = {row["force"]: row["mse"] for row in found.rows if row["model"] == "believed"}
    for name, model in found.final.items():
        model_config = config.models[name]
        draw_model(
            name,
            model_config.fit,
            model_config.terms,
            model.fit,
            believed[judging_force(model_config)],
            folder.figures,
        )
    return results


def _content(config: ForceSettings, found: ForceStudy) -> dict[str, Any]:
    measured = found.measured
    return {
        "schema": "residnet.force_residual/1",
        "run": config.name,
        "logs": [
            {"name": name, "samples": count, "seconds": count * measured.record.dt}
            for name, count in zip(measured.names, measured.record.runs, strict=True)
        ],
        "samples": len(measured.good),
        "used": int(measured.good.sum()),
        "masked": measured.masked,
        "folds": {"of": measured.parts, "count": int(measured.part.max()) + 1},
        "intervals": None if found.blocks is None else found.blocks.row(),
        "forces": found.forces,
        "acceleration": measured.acceleration,
        "rows": found.rows,
        "failed": found.failed,
        "models": {
            name: {
                "folds": found.judged[name].notes,
                "all": model.notes,
                "runs_forward": not model.not_forward,
                "not_forward": model.not_forward,
                **fit_as_json(config.models[name].terms, model.fit),
            }
            for name, model in found.final.items()
        },
    }


def _draw_log(
    config: ForceSettings, found: ForceStudy, name: str, inside: slice, folder: RunFolder
) -> None:
    """Draw forces, accelerations and residual of one log over time.

    Args:
        config: the study.
        found: what was found.
        name: name of the log.
        inside: the log's samples among those of all logs.
        folder: run folder.
    """
    measured = found.measured
    t = measured.record.t[inside] - measured.record.t[inside.start]
    good = measured.good[inside]
    draw_pair(
        t,
        measured.record.command[inside],
        measured.actual[inside],
        good,
        FORCE_UNITS,
        f"Commanded and actual force, log {name}",
        folder.figures / f"forces_{name}.png",
        ("commanded", "actual"),
    )
    if measured.sensed is not None:
        draw_pair(
            t,
            measured.sensed[inside],
            measured.derived[inside],
            good,
            ACCELERATION_UNITS,
            f"Measured acceleration and derivative of velocity, log {name}",
            folder.figures / f"accelerations_{name}.png",
            ("measured acceleration", "derivative of velocity"),
        )
    # of the models of the actual force, the one with the least cross-validated error
    of_actual = {
        row["model"]: row["minus_believed"]["mean"][3]
        for row in found.rows
        if row["force"] == "actual" and row["model"] in found.judged
    }
    if not of_actual:
        return
    best = min(of_actual, key=lambda model: of_actual[model])
    residual = unmodelled(measured, ForceModel(config.hull()), "actual")
    draw_pair(
        t,
        residual[inside],
        (residual - found.judged[best].error)[inside],
        good,
        FORCE_UNITS,
        f"Residual of the believed model and what {best} predicts on left-out folds, log {name}",
        folder.figures / f"residual_{name}.png",
        ("residual of the believed model", f"predicted by {best}"),
    )

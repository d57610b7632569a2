"""Results of a ferry study as they stand in its run folder: JSON, equations, exports, figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch

from residnet.baselines.believed import HullEquations
from residnet.core.errors import ConfigError, FitError
from residnet.core.frames import wrap
from residnet.core.layout import HEADING, POSITION
from residnet.documents.jervan2020.ferry.config import FerrySettings
from residnet.documents.jervan2020.ferry.flights import Flight
from residnet.documents.jervan2020.ferry.forward_runs import forward_runs, why_refused
from residnet.documents.jervan2020.ferry.study import Study
from residnet.documents.jervan2020.forward import (
    as_baseline_yaml,
    forward_equations,
    missing_coefficients,
)
from residnet.documents.jervan2020.residual_pages import draw_model, fit_as_json
from residnet.export.feed_forward import RequiredForce, export_feed_forward
from residnet.report.figures.loop import draw_errors, draw_force_parts
from residnet.runs.folder import RunFolder

FILE = "ferry.json"


def write_results(config: FerrySettings, found: Study, folder: RunFolder) -> dict[str, Any]:
    """Write ferry.json, the models' equations and feed-forwards, and figures.

    Returns:
        The contents of ferry.json.
    """
    folder.figures.mkdir(exist_ok=True)
    for name in found.models:
        _keep_model(config, found, name, folder)
    forward, not_forward = _run_forward(config, found, folder)
    results = _content(config, found, not_forward) | {"forward": forward}
    folder.write_json(folder.path / FILE, results)
    for kind, flights in (
        ("course", found.courses),
        ("crossing", found.crossings),
        ("feed_forward_alone", found.alone),
    ):
        if flights:
            _draw_flights(flights, kind, folder)
    return results


def _keep_model(config: FerrySettings, found: Study, name: str, folder: RunFolder) -> None:
    """Write a model's pictures and its feed-forward."""
    model, model_config = found.models[name], config.models[name]
    draw_model(
        name, model_config.fit, model_config.terms, model.fit, found.unmodelled, folder.figures
    )
    # the range of what identified the model, not of the whole course
    motion = torch.cat((found.record.nu_dot, found.record.nu), dim=-1)[found.record.train]
    ranges = list(zip(motion.amin(0).tolist(), motion.amax(0).tolist(), strict=True))
    force = RequiredForce(*model.model.parts(), mirrored=True)
    file = folder.exports / f"{name}_feed_forward.pt"
    export_feed_forward(force, model.notes.get("lag"), ranges, file)


def _run_forward(
    config: FerrySettings, found: Study, folder: RunFolder
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Run the models forward in time and write the equations of those that do not diverge.

    Returns:
        Their errors by model, and why a model cannot run forward, empty where it can.
    """
    equations: dict[str, HullEquations] = {}
    refused = dict.fromkeys(found.models, "")
    for name, model in found.models.items():
        try:
            equations[name] = forward_equations(config.believed, model.model, f"model {name}")
        except (ConfigError, FitError) as error:
            refused[name] = str(error)
    rows = forward_runs(config.forward, config.true, config.believed, equations)
    for name, model_equations in equations.items():
        refused[name] = why_refused(name, rows[name])
        if not refused[name]:
            folder.write(
                folder.path / "models" / f"{name}_forward.yaml",
                as_baseline_yaml(model_equations, f"run {config.name}, model {name}"),
            )
    return rows, refused


def _content(config: FerrySettings, found: Study, not_forward: Mapping[str, str]) -> dict[str, Any]:
    models = {
        name: {
            "test_mse": model.test_mse,
            "share_left": [a / b for a, b in zip(model.test_mse, found.unmodelled, strict=True)],
            "notes": model.notes,
            "not_forward": not_forward[name],
            **fit_as_json(config.models[name].terms, model.fit),
        }
        for name, model in found.models.items()
    }
    return {
        "schema": "residnet.ferry/1",
        "run": config.name,
        "unmodelled_test_mse": found.unmodelled,
        "true_coefficients": missing_coefficients(config.true, config.believed),
        "models": models,
        "course": {name: flight.tracking.row() for name, flight in found.courses.items()},
        "crossing": {name: flight.tracking.row() for name, flight in found.crossings.items()},
        "feed_forward_alone": {name: flight.tracking.row() for name, flight in found.alone.items()},
        "later": {
            name: {
                "verdict": asdict(update.verdict),
                "text": update.verdict.text(),
                "before": update.before.tracking.row(),
                "after": update.after.tracking.row(),
            }
            for name, update in found.later.items()
        },
    }


def _draw_flights(flights: Mapping[str, Flight], kind: str, folder: RunFolder) -> None:
    """Draw the errors of all models over time, and the forces of the first three."""
    t = next(iter(flights.values())).t
    position = {
        name: (flight.desired - flight.pose)[:, POSITION].norm(dim=-1)
        for name, flight in flights.items()
    }
    heading = {
        name: wrap((flight.desired - flight.pose)[:, HEADING]).abs()
        for name, flight in flights.items()
    }
    draw_errors(t, position, heading, folder.figures / f"errors_{kind}.png")
    if not any(bool(flight.feedback.any()) for flight in flights.values()):
        return
    shown = dict(list(flights.items())[:3])
    command = {name: flight.command for name, flight in shown.items()}
    feedback = {name: flight.feedback for name, flight in shown.items()}
    draw_force_parts(t, command, feedback, folder.figures / f"forces_{kind}.png")

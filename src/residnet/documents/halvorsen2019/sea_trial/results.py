"""Results of a sea trial's study as they stand in its run folder: JSON and figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from residnet.core.names import ACCELERATION
from residnet.documents.halvorsen2019.sea_trial.config import SeaTrialSettings
from residnet.documents.halvorsen2019.sea_trial.figures import (
    draw_excerpt,
    draw_parameters,
    draw_trial,
)
from residnet.documents.halvorsen2019.sea_trial.standard_model import NAMES, SUMS, StandardFit
from residnet.documents.halvorsen2019.sea_trial.study import PhaseStudy
from residnet.physics.froude import PHASES
from residnet.runs.folder import RunFolder

FILE = "study.json"


def write_results(
    settings: SeaTrialSettings, found: Mapping[str, PhaseStudy], folder: RunFolder
) -> dict[str, Any]:
    """Write study.json and all figures; returns the contents of the JSON file."""
    folder.figures.mkdir(exist_ok=True)
    for name, study in found.items():
        draw_trial(study, folder.figures / f"trial_{name}.png")
        draw_parameters(study, folder.figures / f"parameters_{name}.png")
        for where in study.standard:
            draw_excerpt(study, where, folder.figures / f"{where}_{name}.png")
    results = {
        "schema": "residnet.sea_trial/1",
        "run": settings.name,
        "trials": {name: _trial(settings, study) for name, study in found.items()},
    }
    folder.write_json(folder.path / FILE, results)
    return results


def _trial(settings: SeaTrialSettings, study: PhaseStudy) -> dict[str, Any]:
    trial = study.trial
    spread = trial.samples.target.numpy().std(axis=0)
    return {
        "samples": len(trial.phase),
        "seconds": len(trial.phase) * trial.step,
        "step": trial.step,
        "logs": int(trial.log.max()) + 1,
        "validation_share": float(trial.validates.mean()),
        "acceleration_std": dict(zip(ACCELERATION, spread.tolist(), strict=True)),
        "phases": {
            phase: float((trial.phase == number).mean()) for number, phase in enumerate(PHASES)
        },
        "truth": dict(study.truth),
        "true_sums": _true_sums(study.truth, settings.standard.mass),
        "standard": {where: _fit(fit) for where, fit in study.standard.items()},
        "equations": {
            f"{model} on {on}": dict(fitted.equations)
            for (model, on), fitted in study.models.items()
            if fitted.equations
        },
        "rows": dict(study.rows),
    }


def _true_sums(truth: Mapping[str, float], mass: float) -> dict[str, float]:
    """Return the true inertias as the equations contain them, by name."""
    return {
        name: sign * truth[first] - truth[second] if second else mass + sign * truth[first]
        for name, (first, sign, second) in SUMS.items()
    }


def _fit(fit: StandardFit) -> dict[str, Any]:
    errors = {
        name: float(error) if np.isfinite(error) else None
        for name, error in zip(NAMES, fit.errors, strict=True)
    }
    return {
        "values": dict(zip(NAMES, fit.values.tolist(), strict=True)),
        "standard_errors": errors,
        "sums": {name: list(pair) for name, pair in fit.sums.items()},
        "undetermined": fit.undetermined,
        "at_bound": fit.bound,
        "condition": fit.condition,
        "cost": fit.cost,
    }

"""Residual models of measured forces, cross-validated (document 002, chapter 5).

Every model is judged beside two others: no force at all, and the believed hull alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import ConfigError, FitError
from residnet.core.layout import HEADING
from residnet.documents.jervan2020.forward import forward_equations
from residnet.documents.jervan2020.measured.config import ForceSettings, MeasuredModelConfig
from residnet.documents.jervan2020.measured.data import Measured, compare_forces, read_measured
from residnet.documents.jervan2020.regressions import Fit
from residnet.documents.jervan2020.residual_model import Record, fit_model
from residnet.judge.bootstrap import Blocks, intervals
from residnet.physics.force_model import ForceModel

_NULLS = ("zero", "believed")
"""What needs no regression: no force at all, and the believed hull alone."""


@dataclass(frozen=True)
class Judged:
    """Errors of one model on the folds that were left out of its fit.

    Attributes:
        error: remaining residual [N, 3] in N, N, N m; NaN where a sample is not used.
        notes: what the estimator chose in each fold.
    """

    error: Tensor
    notes: list[dict[str, Any]]


@dataclass(frozen=True)
class Final:
    """A model fitted to all good samples, to be read and not to be judged.

    Attributes:
        fit: coefficients.
        notes: what the estimator chose.
        not_forward: why it cannot run forward in time; empty where it can.
    """

    fit: Fit
    notes: dict[str, Any]
    not_forward: str


@dataclass(frozen=True)
class ForceStudy:
    """Everything that was found.

    Attributes:
        measured: the logs.
        judged: cross-validated errors by model.
        final: models fitted to all samples, by name.
        failed: models that the logs do not determine, with the reason.
        rows: rows of the tables; `zero` and `believed` are the first of each force.
        forces: comparison of commanded and actual force.
        blocks: what the intervals resample; None without intervals.
    """

    measured: Measured
    judged: dict[str, Judged]
    final: dict[str, Final]
    failed: dict[str, str]
    rows: list[dict[str, Any]]
    forces: dict[str, Any]
    blocks: Blocks | None


def force_study(config: ForceSettings) -> ForceStudy:
    """Read the logs, and fit and judge every model.

    A model that the logs do not determine is set aside with the reason.

    Raises:
        ResidnetError: where a log cannot be used or no model is determined.
    """
    measured = read_measured(config)
    believed = ForceModel(config.hull())
    judged, final, failed = dict[str, Judged](), dict[str, Final](), dict[str, str]()
    for name, model_config in config.models.items():
        try:
            errors = cross_validate(model_config, measured, believed, config.validation.gap)
            model, _, fit, notes = fit_model(
                model_config, _with_force(model_config, measured, measured.record), believed
            )
        except FitError as error:
            failed[name] = f"model {name}: {error}"
            continue
        judged[name] = errors
        final[name] = Final(fit, notes, _why_not_forward(config, model, name))
    if not final:
        raise FitError(next(iter(failed.values())))
    return ForceStudy(
        measured,
        judged,
        final,
        failed,
        table(config, measured, judged, believed),
        compare_forces(measured),
        measured.blocks(),
    )


def _with_force(config: MeasuredModelConfig, measured: Measured, record: Record) -> Record:
    """Return the record with the force that a model explains as its command."""
    return replace(record, command=measured.force(config.force))


def _why_not_forward(config: ForceSettings, model: ForceModel, name: str) -> str:
    """Return why a model cannot run forward in time; empty where it can."""
    try:
        forward_equations(config.believed, model, f"model {name}")
    except (ConfigError, FitError) as error:
        return str(error)
    return ""


def cross_validate(
    config: MeasuredModelConfig, measured: Measured, believed: ForceModel, gap: float
) -> Judged:
    """Fit a model for each fold on the samples outside and away from it, and predict the fold.

    Args:
        config: the model.
        measured: the logs with their folds.
        believed: the known hull.
        gap: time in s around a fold that is left out of the fit.

    Raises:
        FitError: where a fold's training samples do not determine the model.
    """
    target = measured.force(judging_force(config))
    error, notes = torch.full_like(target, torch.nan), []
    for part in range(int(measured.part.max()) + 1):
        record, test = measured.split(part, gap)
        model, _, _, chosen = fit_model(config, _with_force(config, measured, record), believed)
        error[test] = model.residual(
            target[test], record.nu_dot[test], record.nu[test], record.pose[test, 2]
        )
        notes.append(chosen)
    return Judged(error, notes)


def judging_force(config: MeasuredModelConfig) -> str:
    """Return the force that a model is judged on, `actual` or `commanded`.

    A lag alone could make the residual of a command small: a model with lag is judged on the actual
    force.
    """
    return "actual" if config.lag else config.force


def unmodelled(measured: Measured, believed: ForceModel, force: str) -> Tensor:
    """Return the residual [N, 3] of the believed model for the `actual` or `commanded` force."""
    record = measured.record
    return believed.residual(
        measured.force(force), record.nu_dot, record.nu, record.pose[:, HEADING]
    )


def table(
    config: ForceSettings, measured: Measured, judged: Mapping[str, Judged], believed: ForceModel
) -> list[dict[str, Any]]:
    """Return the rows of all models, grouped by the force that judges them.

    Every group begins with `zero` (no force at all) and `believed` on the same samples. `reference`
    is the better of the two on each axis: a believed model may be worse than no force, and what is
    better than it is then no gain yet.
    """
    groups: dict[str, list[str]] = {}
    for name in judged:
        groups.setdefault(judging_force(config.models[name]), []).append(name)
    segments, parts = measured.segments(), measured.blocks()

    def by_segment(error: Tensor) -> np.ndarray:
        return np.stack([error[segment].square().mean(0).numpy() for segment in segments])

    rows: list[dict[str, Any]] = []
    for force, names in groups.items():
        errors = {
            "zero": by_segment(measured.force(force)),
            "believed": by_segment(unmodelled(measured, believed, force)),
        }
        choice = [min(_NULLS, key=lambda name: float(errors[name][:, a].mean())) for a in range(3)]
        reference = np.stack([errors[name][:, a] for a, name in enumerate(choice)], axis=1)
        errors |= {name: by_segment(judged[name].error) for name in names}
        level = np.maximum(errors["zero"].mean(0), 1e-300)
        for name, error in errors.items():
            rows.append(
                {
                    "force": force,
                    "model": name,
                    "mse": error.mean(0).tolist(),
                    "of_zero": (error.mean(0) / level).tolist(),
                    "segments": len(segments),
                    "reference": choice,
                    **{
                        f"minus_{other}": _difference((error - errors[other]) / level, parts)
                        for other in _NULLS
                        if other != name
                    },
                    "minus_reference": _difference((error - reference) / level, parts),
                }
            )
    return rows


def _difference(difference: np.ndarray, parts: Blocks | None) -> dict[str, Any]:
    """Return mean and 95 % intervals of differences [W, 3], by axis and for their mean."""
    columns = np.concatenate((difference, difference.mean(1, keepdims=True)), axis=1)
    return {
        "mean": columns.mean(0).tolist(),
        "ci95": intervals(columns, parts),
        "segments_below": (columns < 0).mean(0).tolist(),
    }


def better(row: Mapping[str, Any], than: str) -> list[bool]:
    """Return whether a model's error lies below another's with 95 % confidence.

    Args:
        row: row of the model.
        than: `zero`, `believed`, or `reference`, the better of the two on each axis.

    Returns:
        One flag each for surge, sway, yaw and the mean over the axes.
    """
    return [interval is not None and interval[1] < 0 for interval in row[f"minus_{than}"]["ci95"]]

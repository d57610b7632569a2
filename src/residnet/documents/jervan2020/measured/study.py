"""Force residuals of measured logs: every sample predicted by a model that saw nothing near it,
always beside no force and the believed model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import ConfigError, FitError
from residnet.documents.jervan2020.forward import forward_equations
from residnet.documents.jervan2020.measured.config import ForceSettings, MeasuredModelConfig
from residnet.documents.jervan2020.measured.data import Measured, compare_forces, read_measured
from residnet.documents.jervan2020.regressions import Fit
from residnet.documents.jervan2020.residual_model import Record, fit_model
from residnet.judge.bootstrap import Blocks, intervals
from residnet.physics.force_model import ForceModel


@dataclass(frozen=True)
class Judged:
    """One model's errors where it saw nothing.

    Attributes:
        error: remaining residual [N, 3]; NaN where there is none.
        notes: what each fold chose.
    """

    error: Tensor
    notes: list[dict[str, Any]]


@dataclass(frozen=True)
class Final:
    """A model fitted on all good samples, for reading; nothing judges it.

    Attributes:
        fit: coefficients.
        notes: what was chosen.
        forward: empty, or why it cannot run forward in time.
    """

    fit: Fit
    notes: dict[str, Any]
    forward: str


@dataclass(frozen=True)
class ForceStudy:
    """Everything that was found.

    Attributes:
        measured: the logs.
        judged: by model.
        final: by model.
        failed: why a model is not among them: the logs do not determine it.
        rows: of the tables, zero and the believed model first in each.
        forces: commanded against actual.
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
    """Read the logs, fit and judge every model; one that the logs do not determine is set aside
    with the reason.

    Raises:
        ResidnetError: where a log cannot be used or no model is determined.
    """
    measured = read_measured(config)
    believed = ForceModel(config.hull())
    judged, final, failed = dict[str, Judged](), dict[str, Final](), dict[str, str]()
    for name, wanted in config.models.items():
        try:
            errors = cross_validate(wanted, measured, believed, config.validation.gap)
            model, _, fit, notes = fit_model(
                wanted, _for(wanted, measured, measured.record), believed
            )
        except FitError as error:
            failed[name] = f"model {name}: {error}"
            continue
        judged[name] = errors
        final[name] = Final(fit, notes, _forward(config, model, name))
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


def _for(wanted: MeasuredModelConfig, measured: Measured, record: Record) -> Record:
    """The record with the force that a model explains as its command."""
    return replace(record, command=measured.force(wanted.force))


def _forward(config: ForceSettings, model: ForceModel, name: str) -> str:
    try:
        forward_equations(config.believed, model, f"model {name}")
    except (ConfigError, FitError) as error:
        return str(error)
    return ""


def cross_validate(
    wanted: MeasuredModelConfig, measured: Measured, believed: ForceModel, gap: float
) -> Judged:
    """Fit a model once for each fold, on what is not near it, and predict the fold.

    Raises:
        FitError: where a fold's training samples do not determine the model.
    """
    target = measured.force(judge(wanted))
    error, notes = torch.full_like(target, torch.nan), []
    for part in range(int(measured.part.max()) + 1):
        record, test = measured.split(part, gap)
        model, _, _, said = fit_model(wanted, _for(wanted, measured, record), believed)
        error[test] = model.residual(
            target[test], record.nu_dot[test], record.nu[test], record.pose[test, 2]
        )
        notes.append(said)
    return Judged(error, notes)


def judge(wanted: MeasuredModelConfig) -> str:
    """The force that a model is judged on. What a lag makes of a command can be small by the lag
    alone: such a model is held to the actual force.
    """
    return "actual" if wanted.lag else wanted.force


def unmodelled(measured: Measured, believed: ForceModel, force: str) -> Tensor:
    """The believed model's residual [N, 3]."""
    record = measured.record
    return believed.residual(measured.force(force), record.nu_dot, record.nu, record.pose[:, 2])


def table(
    config: ForceSettings, measured: Measured, judged: Mapping[str, Judged], believed: ForceModel
) -> list[dict[str, Any]]:
    """Rows of all models by the force that judges them; every group begins with `zero` and
    `believed` on the same samples.
    """
    groups: dict[str, list[str]] = {}
    for name in judged:
        groups.setdefault(judge(config.models[name]), []).append(name)
    segments, parts = measured.segments(), measured.blocks()

    def by_segment(error: Tensor) -> np.ndarray:
        return np.stack([error[segment].square().mean(0).numpy() for segment in segments])

    rows: list[dict[str, Any]] = []
    for force, names in groups.items():
        errors = {
            "zero": by_segment(measured.force(force)),
            "believed": by_segment(unmodelled(measured, believed, force)),
        }
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
                    **{
                        f"minus_{other}": _apart((error - errors[other]) / level, parts)
                        for other in ("zero", "believed")
                        if other != name
                    },
                }
            )
    return rows


def _apart(apart: np.ndarray, parts: Blocks | None) -> dict[str, Any]:
    """Difference of errors [W, 3] in units of zero's mean square error, by axis and their mean: 95
    % intervals, share of segments below.
    """
    columns = np.concatenate((apart, apart.mean(1, keepdims=True)), axis=1)
    return {
        "mean": columns.mean(0).tolist(),
        "ci95": intervals(columns, parts),
        "segments_below": (columns < 0).mean(0).tolist(),
    }


def better(row: Mapping[str, Any], than: str) -> list[bool]:
    """Whether a model's error is below another's with 95 % confidence: surge, sway, yaw, mean over
    axes.
    """
    return [interval is not None and interval[1] < 0 for interval in row[f"minus_{than}"]["ci95"]]

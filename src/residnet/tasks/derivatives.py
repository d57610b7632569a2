"""Hydrodynamic derivatives of a model of a finished run (command `derivatives`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from residnet.core.config import validate_config
from residnet.core.errors import UsageError
from residnet.core.run_loader import name_damaged_key
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import load_model, resolve_model_name
from residnet.evaluation.derivatives import (
    CovarianceNotes,
    DerivativesFile,
    compute_derivatives,
    read_covariance,
)
from residnet.physics.similarity import Particulars
from residnet.runs.folder import RunFolder


def derive_run(
    folder: Path,
    model_name: str,
    particulars: Mapping[str, object],
    *,
    order: int = 1,
    scale: float = 1.0,
    density_ratio: float = 1.0,
) -> DerivativesFile:
    """Compute the derivatives of the baseline of a model of a finished run.

    Args:
        folder: folder of the run.
        model_name: name of the model.
        particulars: main particulars by name, as texts such as "7 m" or SI numbers.
        order: highest order of the Taylor series, 1 to 3.
        scale: length of the target vessel divided by the length of the vessel in the logs.
        density_ratio: ratio of the densities of the water.

    Raises:
        UsageError: if the run has no such model, or its baseline has no derivatives.
        ConfigError: if a particular is missing or not plausible.
    """
    run = RunFolder.open(folder)
    if not run.models.is_dir():
        raise UsageError(f"{folder}: this run has no models; give the folder of a finished fit")
    with name_damaged_key(folder):
        name = resolve_model_name(run.path, model_name)
        spec, module = load_model(run.models / name)
        if not isinstance(module, HybridDynamics):
            raise UsageError(
                f"model {name}: an ensemble has no derivatives; choose one of its members (--model)"
            )
        notes = CovarianceNotes.model_validate(run.read_fit_notes(name))
        covariance, has_correlations = read_covariance(notes, module.baseline)
    return compute_derivatives(
        spec,
        module,
        validate_config(dict(particulars), Particulars, "particulars"),
        covariance=covariance,
        has_correlations=has_correlations,
        order=order,
        scale=scale,
        density_ratio=density_ratio,
    )

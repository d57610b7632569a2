"""Files of hydrodynamic derivatives in the run folder of a fit."""

from __future__ import annotations

from residnet.core.errors import UsageError
from residnet.core.progress import log_message
from residnet.evaluation.derivatives import CovarianceNotes, compute_derivatives, read_covariance
from residnet.identification.fitter import FittedModel
from residnet.physics.similarity import DerivativesConfig
from residnet.runs.folder import RunFolder


def write_derivatives(
    folder: RunFolder, config: DerivativesConfig, fitted_model: FittedModel
) -> None:
    """Write derivatives.json, and derivatives_ship.json at full scale.

    A model without derivatives is reported, because the fit itself is complete.
    """
    scales = {folder.derivatives: (1.0, 1.0)}
    if config.scale != 1.0:
        scales[folder.ship_derivatives] = (config.scale, config.density_ratio)
    for path, (scale, density_ratio) in scales.items():
        try:
            covariance, has_correlations = read_covariance(
                CovarianceNotes.model_validate(fitted_model.notes), fitted_model.model.baseline
            )
            table = compute_derivatives(
                fitted_model.spec,
                fitted_model.model,
                config.particulars(),
                covariance=covariance,
                has_correlations=has_correlations,
                order=config.order,
                scale=scale,
                density_ratio=density_ratio,
            )
        except UsageError as error:
            log_message(f"  no derivatives: {error}")
            return
        folder.write_record(path, table)

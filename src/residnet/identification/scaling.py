"""Scaling of fitted models with their uncertainties and prediction intervals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.dynamics.scaling import (
    ScaleEffects,
    apply_scale_effects,
    band_channel_factor,
    parameter_factors,
    scale_coefficient_rows,
    scale_model,
)
from residnet.evaluation.band import Band
from residnet.identification.fitter import FittedModel
from residnet.physics.similarity import FroudeScaling


def scale_fitted_model(
    fitted_model: FittedModel, scaling: FroudeScaling, effects: ScaleEffects | None = None
) -> FittedModel:
    """Return a fitted model at another scale, with its covariance and prediction intervals.

    The relative uncertainty of a coefficient does not change: the uncertainty of the scale effects,
    and of Froude's law itself, is not part of it.

    Args:
        fitted_model: the model with the notes of its fit; it is not changed.
        scaling: ratios of lengths and densities.
        effects: full-scale corrections; None for pure Froude scaling.

    Raises:
        UsageError: if the model cannot be scaled, or has no terms for the scale effects.
    """
    if effects is not None and not effects.has_effect:
        effects = None
    if effects is not None and fitted_model.spec.members:
        raise UsageError(
            f"model {fitted_model.name}: scale effects apply to one baseline, not to an ensemble;"
            " choose one of its members (--model)"
        )
    spec, model = scale_model(fitted_model.spec, fitted_model.model, scaling)
    if effects is not None and spec.role != "constant_velocity":
        spec, model = apply_scale_effects(spec, model, effects)
    original_baseline = fitted_model.model.baseline
    names = fitted_model.model.signals.names
    notes: dict[str, Any] = dict(fitted_model.notes)
    factors = parameter_factors(original_baseline, scaling, effects)
    covariance = None
    if factors is not None and isinstance(rows := notes.get("covariance"), list):
        scaled_covariance = torch.tensor(rows, dtype=torch.float64) * torch.outer(factors, factors)
        notes["covariance"] = scaled_covariance.tolist()
        # only a refit through rollouts yields intervals of free runs
        covariance = scaled_covariance if "refit" in notes else None
    if "coefficients" in notes:
        notes["coefficients"] = scale_coefficient_rows(
            notes["coefficients"], original_baseline, names, scaling, effects
        )
    notes["scaling"] = {
        "scale": scaling.scale,
        "density_ratio": scaling.density_ratio,
        "law": "Froude",
        **({} if effects is None else {"effects": effects.model_dump()}),
    }
    bands = {protocol: scale_band(band, scaling) for protocol, band in fitted_model.bands.items()}
    return FittedModel(spec, model, notes, covariance, bands)


def scale_band(band: Band, scaling: FroudeScaling) -> Band:
    """Return prediction intervals at another scale."""
    channel_factors = np.array([band_channel_factor(name, scaling) for name in band.channels])
    states = [name for name in band.channels if name not in ("heading", "position")]
    state_factors = np.array([scaling.channel_factor(name) for name in states])
    # the intensity of the motion is measured by velocities, then by their derivatives
    measure_factors = np.concatenate((state_factors, state_factors / scaling.time_factor))
    spread = band.typical_spread
    return replace(
        band,
        step=band.step * scaling.time_factor,
        half_width=band.half_width * channel_factors,
        unconditional_width=band.unconditional_width * channel_factors,
        constant_width=band.constant_width * channel_factors,
        score_unit=band.score_unit * channel_factors,
        typical_spread=None if spread is None else spread * channel_factors,
        intensity=replace(
            band.intensity,
            floor=band.intensity.floor * measure_factors**2,
            log_mean=band.intensity.log_mean + 2.0 * np.log(measure_factors),
        ),
    )


def scale_log(log: Log, scaling: FroudeScaling) -> Log:
    """Return a log as a similar vessel would have recorded it, by the units of its channels."""
    return log.replace(
        t=log.t * scaling.time_factor,
        channels={
            name: values * scaling.unit_factor(log.units[name])
            for name, values in log.channels.items()
        },
    )

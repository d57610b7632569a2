"""Baselines, the physical part of a model: one config class per kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from residnet.core.registry import PluginUnion

if TYPE_CHECKING:
    from residnet.baselines.base import IdentifiedConfig

    BaselineConfig = IdentifiedConfig
else:
    BaselineConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.baselines",
            "residnet.baselines.base:IdentifiedConfig",
            {
                "believed": "residnet.baselines.given:BelievedConfig",
                "equations": "residnet.baselines.given:EquationsConfig",
                "linear_steady": "residnet.baselines.steering:LinearSteadyConfig",
                "mmg": "residnet.baselines.mmg:MMGConfig",
                "nomoto": "residnet.baselines.steering:NomotoBaselineConfig",
                "nomoto_sideslip": "residnet.baselines.steering:NomotoSideslipBaselineConfig",
                "regressors": "residnet.baselines.regressors:RegressorsConfig",
                "still": "residnet.baselines.given:ZeroBaselineConfig",
            },
        ),
    ]
"""Configuration of any baseline, including those of other packages, selected by `kind`."""

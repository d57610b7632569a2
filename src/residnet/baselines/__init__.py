"""Baselines, the physical part of a model: one config class per kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from residnet.core.registry import PluginUnion

if TYPE_CHECKING:
    from residnet.baselines.config import IdentifiedConfig

    BaselineConfig = IdentifiedConfig
else:
    _STEERING = "residnet.baselines.steering_config"
    BaselineConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.baselines",
            "residnet.baselines.config:IdentifiedConfig",
            {
                "believed": "residnet.baselines.given_config:BelievedConfig",
                "equations": "residnet.baselines.given_config:EquationsConfig",
                "linear_steady": f"{_STEERING}:LinearSteadyConfig",
                "mmg": "residnet.baselines.mmg_config:MMGConfig",
                "nomoto": f"{_STEERING}:NomotoBaselineConfig",
                "nomoto_sideslip": f"{_STEERING}:NomotoSideslipBaselineConfig",
                "regressors": "residnet.baselines.regressors_config:RegressorsConfig",
                "semi_empirical": "residnet.baselines.mmg_config:SemiEmpiricalConfig",
                "still": "residnet.baselines.given_config:ZeroBaselineConfig",
            },
        ),
    ]
"""Configuration of any baseline, including those of other packages, selected by `kind`."""

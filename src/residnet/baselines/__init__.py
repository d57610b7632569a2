"""The known part, identified from data: one config class per kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from residnet.core.registry import Kinds

if TYPE_CHECKING:
    from residnet.baselines.base import IdentifiedConfig

    BaselineConfig = IdentifiedConfig
else:
    BaselineConfig = Annotated[
        Any,
        Kinds(
            "residnet.baselines",
            "residnet.baselines.base:IdentifiedConfig",
            {
                "believed": "residnet.baselines.given:BelievedConfig",
                "equations": "residnet.baselines.given:EquationsConfig",
                "linear_steady": "residnet.baselines.steering:LinearSteadyConfig",
                "mmg": "residnet.baselines.mmg:MMGConfig",
                "nomoto": "residnet.baselines.steering:NomotoConfig",
                "nomoto_sideslip": "residnet.baselines.steering:NomotoSideslipConfig",
                "regressors": "residnet.baselines.regressors:RegressorsConfig",
                "still": "residnet.baselines.given:StillConfig",
            },
        ),
    ]
"""Config of any baseline, those of other packages included; its `kind` says which."""

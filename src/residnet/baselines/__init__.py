"""The known part, identified from data: one config class per kind, listed in `BaselineConfig`."""

from __future__ import annotations

from typing import Annotated

from residnet.baselines.base import Baseline, IdentifiedConfig, ParametricBaseline
from residnet.baselines.believed import BelievedConfig
from residnet.baselines.equations import EquationsConfig
from residnet.baselines.linear_steady import LinearSteadyConfig
from residnet.baselines.mmg import MMGBaseline, MMGConfig
from residnet.baselines.nomoto import NomotoConfig, NomotoSideslipConfig
from residnet.baselines.regressors import RegressorBaseline, RegressorsConfig
from residnet.baselines.still import StillConfig
from residnet.core.registry import Kinds
from residnet.regression.solutions import Coefficient

BaselineConfig = Annotated[
    BelievedConfig
    | EquationsConfig
    | LinearSteadyConfig
    | MMGConfig
    | NomotoConfig
    | NomotoSideslipConfig
    | RegressorsConfig
    | StillConfig,
    Kinds("residnet.baselines", IdentifiedConfig),
]
"""Config of any baseline, those of other packages included; its `kind` says which."""

__all__ = [
    "Baseline",
    "BaselineConfig",
    "BelievedConfig",
    "Coefficient",
    "EquationsConfig",
    "IdentifiedConfig",
    "LinearSteadyConfig",
    "MMGBaseline",
    "MMGConfig",
    "NomotoConfig",
    "NomotoSideslipConfig",
    "ParametricBaseline",
    "RegressorBaseline",
    "RegressorsConfig",
    "StillConfig",
]

"""Residual heads, which learn what the baseline does not explain: one config class per kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from residnet.core.registry import PluginUnion

if TYPE_CHECKING:
    from residnet.heads.base import BaseHeadConfig

    HeadConfig = BaseHeadConfig
else:
    HeadConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.heads",
            "residnet.heads.base:BaseHeadConfig",
            {
                "plsr": "residnet.heads.linear:PlsrConfig",
                "ridge": "residnet.heads.linear:RidgeConfig",
                "kernel": "residnet.heads.kernel:KernelConfig",
                "symbolic": "residnet.heads.symbolic:SymbolicConfig",
                "genetic": "residnet.heads.genetic:GeneticConfig",
                "mlp": "residnet.heads.mlp:MlpConfig",
                "lstm": "residnet.heads.lstm:LstmConfig",
                "sklearn": "residnet.heads.scikit:SklearnConfig",
                "recurrent": "residnet.heads.recurrent:GRUEnsembleConfig",
            },
            python_kinds={"module": "residnet.heads.module:ModuleHeadConfig"},
        ),
    ]
"""Configuration of any head, including heads of other packages, selected by `kind`."""

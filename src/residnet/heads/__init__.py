"""Heads (residual models), which learn what the baseline does not explain: one class per kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from residnet.core.registry import PluginUnion

if TYPE_CHECKING:
    from residnet.heads.config import BaseHeadConfig

    HeadConfig = BaseHeadConfig
else:
    HeadConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.heads",
            "residnet.heads.config:BaseHeadConfig",
            {
                "plsr": "residnet.heads.linear:PlsrConfig",
                "ridge": "residnet.heads.linear:RidgeConfig",
                "kernel": "residnet.heads.kernel_config:KernelConfig",
                "symbolic": "residnet.heads.symbolic_config:SymbolicConfig",
                "genetic": "residnet.heads.genetic_config:GeneticConfig",
                "mlp": "residnet.heads.mlp_config:MlpConfig",
                "lstm": "residnet.heads.lstm_config:LstmConfig",
                "sklearn": "residnet.heads.scikit_config:SklearnConfig",
                "recurrent": "residnet.heads.recurrent_config:GRUEnsembleConfig",
            },
            python_kinds={"module": "residnet.heads.module:ModuleHeadConfig"},
        ),
    ]
"""Configuration of any head, including heads of other packages, selected by `kind`."""

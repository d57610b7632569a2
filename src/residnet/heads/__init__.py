"""What is learned on top of the baseline: one config class per kind, listed in `HeadConfig`."""

from __future__ import annotations

from typing import Annotated

from residnet.core.registry import Kinds
from residnet.heads.base import ClosedFormHead, EquationHead, HeadKind, ResidualHead
from residnet.heads.force import ForceHead
from residnet.heads.genetic import GeneticConfig
from residnet.heads.kernel import KernelConfig
from residnet.heads.lstm import LstmConfig
from residnet.heads.mlp import MlpConfig
from residnet.heads.plsr import PlsrConfig
from residnet.heads.ridge import RidgeConfig
from residnet.heads.symbolic import SymbolicConfig
from residnet.heads.zero import ZeroHead

HeadConfig = Annotated[
    PlsrConfig
    | RidgeConfig
    | KernelConfig
    | SymbolicConfig
    | GeneticConfig
    | MlpConfig
    | LstmConfig,
    Kinds("residnet.heads", HeadKind),
]
"""Config of any head, those of other packages included; its `kind` says which."""

__all__ = [
    "ClosedFormHead",
    "EquationHead",
    "ForceHead",
    "GeneticConfig",
    "HeadConfig",
    "HeadKind",
    "KernelConfig",
    "LstmConfig",
    "MlpConfig",
    "PlsrConfig",
    "ResidualHead",
    "RidgeConfig",
    "SymbolicConfig",
    "ZeroHead",
]

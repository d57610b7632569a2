"""Multi-layer perceptron: a memoryless residual of the current state and inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.renamed_state import RenamedStateModule
from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.heads.mirror import Tanh

if TYPE_CHECKING:
    from residnet.heads.mlp_config import MlpConfig

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "tanh": Tanh,
    "silu": nn.SiLU,
    "relu": nn.ReLU,
    "softsign": nn.Softsign,
}


@final
class MlpHead(RenamedStateModule, ResidualHead):
    """Head with the residual rho = std * network(features)."""

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"net": "network"}

    def __init__(self, config: MlpConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        layers: list[nn.Module] = []
        n_inputs = self.features.n_features
        for n_units in config.hidden:
            layers += [nn.Linear(n_inputs, n_units), ACTIVATIONS[config.activation]()]
            if config.dropout > 0:
                layers.append(nn.Dropout(config.dropout))
            n_inputs = n_units
        output_layer = nn.Linear(n_inputs, self.n_dof)
        with torch.no_grad():
            # small initial outputs: training starts near the baseline, or at the linear model of a
            # skip connection
            output_layer.weight.mul_(0.1 if config.skip == "none" else 0.0)
            output_layer.bias.zero_()
        self.network = nn.Sequential(*layers, output_layer)

    def residual_scale(self) -> Tensor:
        return self.scale.std

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.scale(self.network(self.features(z))), s

"""Multi-layer perceptron: a memoryless residual of the current state and inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.renamed_state import RenamedStateModule
from residnet.heads.base import FeatureConfig, Features, ResidualHead, ResidualScale
from residnet.heads.mirror import MirroredHead, Tanh

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "tanh": Tanh,
    "silu": nn.SiLU,
    "relu": nn.ReLU,
    "softsign": nn.Softsign,
}


_UnitCount = Annotated[int, Field(ge=1, le=10_000)]


class MlpConfig(FeatureConfig):
    """Multi-layer perceptron with one activation function.

    The output layer is initialised near zero, so that training starts from the baseline.

    Attributes:
        hidden: number of units of each hidden layer.
        activation: activation function of the hidden layers.
        dropout: dropout probability of the hidden units.
        mirror: whether the residual is mirror-symmetric between port and starboard by construction.
    """

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[_UnitCount, ...] = Field(default=(64, 64), min_length=1, max_length=100)
    activation: Literal["tanh", "silu", "relu", "softsign"] = "tanh"
    dropout: float = Field(default=0.0, ge=0, lt=1)
    mirror: bool = False

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head for channels `names`."""
        head = MlpHead(self, names)
        return MirroredHead(head, names) if self.mirror else head


@final
class MlpHead(RenamedStateModule, ResidualHead):
    """Head with the residual rho = std * network(features)."""

    renamed_state: ClassVar[Mapping[str, str]] = {"net": "network"}

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
            # small initial outputs: training starts near the baseline
            output_layer.weight.mul_(0.1)
            output_layer.bias.zero_()
        self.network = nn.Sequential(*layers, output_layer)

    def residual_scale(self) -> Tensor:
        return self.scale.std

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.scale(self.network(self.features(z))), s

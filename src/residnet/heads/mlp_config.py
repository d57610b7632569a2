"""Configuration of the multi-layer perceptron."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from residnet.heads.skip_config import SkipNetworkConfig

if TYPE_CHECKING:
    from residnet.heads.base import ResidualHead

_UnitCount = Annotated[int, Field(ge=1, le=10_000)]


class MlpConfig(SkipNetworkConfig):
    """Multi-layer perceptron with one activation function.

    The output layer is initialised at or near zero, so that training starts from the skip
    connection or the baseline.

    Attributes:
        hidden: number of units of each hidden layer.
        activation: activation function of the hidden layers. `silu` does not saturate, and
            approximates products and squares of channels with fewer units than `tanh`.
        dropout: dropout probability of the hidden units.
    """

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[_UnitCount, ...] = Field(default=(64, 64), min_length=1, max_length=100)
    activation: Literal["tanh", "silu", "relu", "softsign"] = "silu"
    dropout: float = Field(default=0.0, ge=0, lt=1)

    def build_network(self, names: Sequence[str]) -> ResidualHead:
        from residnet.heads.mlp import MlpHead

        return MlpHead(self, names)

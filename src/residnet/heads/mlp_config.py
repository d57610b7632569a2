"""Configuration of the multi-layer perceptron."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from residnet.heads.config import NetworkConfig
from residnet.physics.symmetry import require_mirror_image

if TYPE_CHECKING:
    from residnet.heads.base import ResidualHead

_UnitCount = Annotated[int, Field(ge=1, le=10_000)]


class MlpConfig(NetworkConfig):
    """Multi-layer perceptron with one activation function.

    The output layer is initialised near zero, so that training starts from the baseline.

    Attributes:
        hidden: number of units of each hidden layer.
        activation: activation function of the hidden layers. `silu` does not saturate, and
            approximates products and squares of channels with fewer units than `tanh`.
        dropout: dropout probability of the hidden units.
        mirror: whether the residual is mirror-symmetric between port and starboard by construction.
    """

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[_UnitCount, ...] = Field(default=(64, 64), min_length=1, max_length=100)
    activation: Literal["tanh", "silu", "relu", "softsign"] = "silu"
    dropout: float = Field(default=0.0, ge=0, lt=1)
    mirror: bool = False

    def check_channels(self, names: Sequence[str]) -> None:
        super().check_channels(names)
        if self.mirror:
            require_mirror_image(names)

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head for channels `names`."""
        from residnet.heads.mirror import MirroredHead
        from residnet.heads.mlp import MlpHead

        head = MlpHead(self, names)
        return MirroredHead(head, names) if self.mirror else head

"""Configuration of networks with a skip connection."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, final

from residnet.heads.config import NetworkConfig
from residnet.heads.linear import PlsrConfig
from residnet.physics.symmetry import require_mirror_image

if TYPE_CHECKING:
    from residnet.heads.base import ResidualHead


class SkipNetworkConfig(NetworkConfig, ABC):
    """Network that learns what a linear model in parallel to it, the skip connection, leaves.

    Attributes:
        mirror: whether the residual is mirror-symmetric between port and starboard by construction.
        skip: linear model in parallel to the network: `plsr` with products of the features up to
            degree 2, fitted before the training, or `none`. Training starts from this model, and
            outside the training range, where a network is arbitrary, the residual is this model.
    """

    mirror: bool = False
    skip: Literal["none", "plsr"] = "plsr"

    def check_channels(self, names: Sequence[str]) -> None:
        super().check_channels(names)
        if self.mirror:
            require_mirror_image(names)

    @property
    def has_restoring_acceleration(self) -> bool:
        """Whether an acceleration returns velocities to their training range."""
        return False

    @abstractmethod
    def build_network(self, names: Sequence[str]) -> ResidualHead:
        """Build the network without skip connection and mirror symmetry for channels `names`."""

    @final
    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head for channels `names`."""
        from residnet.heads.basis import BasisHead
        from residnet.heads.mirror import MirroredHead
        from residnet.heads.skip import SkipHead

        head = self.build_network(names)
        if self.skip == "plsr":
            plsr = PlsrConfig(features=self.features, margin=self.margin)
            linear = BasisHead(plsr, names)
            head = SkipHead(linear, head, names, restoring=self.has_restoring_acceleration)
        return MirroredHead(head, names) if self.mirror else head

"""Configuration that all heads (residual models) share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, final

from pydantic import Field

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import ACCELERATION_NAMES, suggest_name
from residnet.core.sample_origins import SampleOrigins
from residnet.physics.symmetry import active_channels

if TYPE_CHECKING:
    from residnet.heads.base import ResidualHead


class FeatureConfig(Config):
    """Input features of a head and their clamping outside the training range.

    Attributes:
        features: names of channels; empty for all.
        margin: widening of the training range to either side, as a share of its width. Features are
            clamped to the wider range, so that the residual is constant outside and cannot diverge.
    """

    features: tuple[str, ...] = ()
    margin: float = Field(default=0.1, ge=0)

    def select_features(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the features among the channels `names`.

        Raises:
            ConfigError: if a feature is not a channel.
        """
        for name in self.features:
            if name in ACCELERATION_NAMES and name not in names:
                raise ConfigError(
                    f"head feature '{name}' is an acceleration, which only heads in force space"
                    " support (plsr or ridge, space: force)"
                )
            if name not in names:
                raise ConfigError(
                    f"head feature '{name}' is not a channel of the model"
                    f"{suggest_name(name, names)}"
                )
        return self.features or active_channels(names)


class BaseHeadConfig(FeatureConfig, ABC):
    """Configuration of a head.

    A head of another package needs `kind` and `build` only. Built-in heads also override the
    checks, so that a config is checked without PyTorch.

    Attributes:
        kind: a `Literal` with the name of the entry point in the group `residnet.heads`.
    """

    kind: str

    @abstractmethod
    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head, not yet fitted, for channels `names`.

        Raises:
            ConfigError: if a required channel is missing.
        """

    def check_channels(self, names: Sequence[str]) -> None:
        """Check that the head can be built for channels `names`, by default by building it.

        Raises:
            ConfigError: if a required channel is missing.
        """
        self.build(names)

    def check_inertia(self, names: Sequence[str], *, has_inertia_matrix: bool) -> None:
        """Check that the head can be used on a baseline with or without an inertia matrix.

        Raises:
            ConfigError: if the head needs the matrix and the baseline has none.
        """
        if not has_inertia_matrix:
            self.build(names).set_inertia(None)

    def has_innovations(self, names: Sequence[str]) -> bool:
        """Return whether the head uses innovations, so that each network has its own states."""
        return self.build(names).innovation_time_constant > 0.0

    def has_closed_form(self, names: Sequence[str]) -> bool:
        """Return whether the head is fitted in closed form instead of by gradient descent."""
        from residnet.heads.base import ClosedFormHead

        return isinstance(self.build(names), ClosedFormHead)

    def validate_samples(self, samples: SampleOrigins) -> None:
        """Check that the samples have enough manoeuvres for the folds of the fit.

        Raises:
            FitError: if they have fewer.
        """


class NetworkConfig(BaseHeadConfig, ABC):
    """Configuration of a network, which is trained by gradient descent."""

    def check_channels(self, names: Sequence[str]) -> None:
        self.select_features(names)

    def check_inertia(self, names: Sequence[str], *, has_inertia_matrix: bool) -> None:
        """Accept any baseline."""

    def has_innovations(self, names: Sequence[str]) -> bool:
        return False

    @final
    def has_closed_form(self, names: Sequence[str]) -> bool:
        return False


class ClosedFormConfig(BaseHeadConfig, ABC):
    """Configuration of a head that is fitted in closed form."""

    def check_channels(self, names: Sequence[str]) -> None:
        self.select_features(names)

    def check_inertia(self, names: Sequence[str], *, has_inertia_matrix: bool) -> None:
        """Accept any baseline."""

    @final
    def has_innovations(self, names: Sequence[str]) -> bool:
        return False

    @final
    def has_closed_form(self, names: Sequence[str]) -> bool:
        return True

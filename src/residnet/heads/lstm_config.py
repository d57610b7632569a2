"""Configuration of the LSTM residual model (Woo et al. 2018, eq. (17); see `heads.lstm`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from residnet.core.errors import ConfigError
from residnet.heads.config import FeatureConfig
from residnet.heads.skip_config import SkipNetworkConfig
from residnet.physics.symmetry import get_dof, require_mirror_image

if TYPE_CHECKING:
    from residnet.heads.base import ResidualHead


class LstmConfig(SkipNetworkConfig):
    """LSTM for all axes, or an LSTM per axis.

    Attributes:
        hidden_size: number of hidden units.
        readout: number of units of a layer between (hidden state, features) and the residual; 0 for
            a linear readout of the hidden state, as in Woo et al. 2018.
        readout_activation: activation function of this layer. `silu` does not saturate, and
            approximates products and squares of channels with fewer units than `tanh`.
        memory: features that the LSTM receives; empty for all. An LSTM of the commands only has the
            same states in a free run and in teacher forcing: it can represent actuator dynamics but
            not infer measured accelerations. Needs `readout`, which receives all features.
        activation: activation of block input and output; Woo et al. 2018 use softsign in place of
            tanh.
        dropout: dropout probability of the hidden outputs before the readout.
        per_axis: whether surge, sway and yaw have a network each, as in Woo et al. 2018.
        axis_features: channels of the network of each axis if they differ; needs `per_axis`.
        restoring: whether an acceleration returns velocities to their training range, so that a
            network without a baseline cannot diverge; see `physics.signals.SoftVelocityLimit`.
    """

    kind: Literal["lstm"] = "lstm"
    hidden_size: int = Field(default=32, ge=1, le=10_000)
    readout: int = Field(default=32, ge=0, le=10_000)
    readout_activation: Literal["tanh", "silu"] = "silu"
    memory: tuple[str, ...] = ()
    activation: Literal["tanh", "softsign"] = "tanh"
    dropout: float = Field(default=0.0, ge=0, lt=1)
    per_axis: bool = False
    axis_features: dict[Literal["u", "v", "r"], tuple[str, ...]] | None = None
    restoring: bool = False

    @model_validator(mode="after")
    def _validate_axes(self) -> LstmConfig:
        if self.axis_features is not None:
            if not self.per_axis:
                raise ValueError("axis_features needs per_axis: true")
            if set(self.axis_features) != {"u", "v", "r"}:
                raise ValueError(
                    f"axis_features: expected all of u, v, r, got {sorted(self.axis_features)}"
                )
        if self.memory and not self.readout:
            raise ValueError(
                "memory needs a readout layer, which receives the other features; set readout"
            )
        return self

    def check_channels(self, names: Sequence[str]) -> None:
        for feature_names, _ in self.network_specs(names):
            self.select_lstm_features(feature_names)
        if self.mirror:
            require_mirror_image(names)

    def select_lstm_features(self, feature_names: Sequence[str]) -> tuple[str, ...]:
        """Return the features that the LSTM receives.

        Raises:
            ConfigError: if one of `memory` is not a feature.
        """
        return FeatureConfig(features=self.memory).select_features(feature_names)

    @property
    def has_restoring_acceleration(self) -> bool:
        return self.restoring

    def build_network(self, names: Sequence[str]) -> ResidualHead:
        from residnet.heads.lstm import LstmHead

        return LstmHead(self, names)

    def network_specs(self, names: Sequence[str]) -> list[tuple[tuple[str, ...], int]]:
        """Return (features, number of outputs) of each network."""
        if not self.per_axis:
            return [(self.select_features(names), get_dof(names).n_dynamic)]
        if get_dof(names).has_roll:
            raise ConfigError(
                "per_axis: supports surge, sway and yaw, but the model has roll; remove per_axis"
            )
        if self.axis_features is None:
            return [(self.select_features(names), 1)] * get_dof(names).n_dynamic
        return [
            (FeatureConfig(features=self.axis_features[axis]).select_features(names), 1)
            for axis in ("u", "v", "r")
        ]

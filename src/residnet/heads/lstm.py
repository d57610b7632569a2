"""Head (residual model) with long short-term memory (LSTM).

Source: Woo et al. 2018, eqs. (17) and following. The printed cell candidate of eq. (17) lacks the
recurrent term W_hc h, which the number of parameters requires (`docs/documents/corrections.md`,
W4).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.renamed_state import RenamedStateModule
from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.heads.mirror import Tanh, fast_tanh
from residnet.physics.signals import SoftVelocityLimit

if TYPE_CHECKING:
    from residnet.heads.lstm_config import LstmConfig

_MAX_CELL_STATE = 1e3
"""Upper bound of the magnitude of a plausible cell state; the activation saturates far below it."""


class LSTMCell(RenamedStateModule):
    """LSTM layer with one bias per gate, evaluated step by step or over sequences.

    The memory s [B, 2H] is the concatenation of h and c. The layer has 4 H (F + H + 1) parameters.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {
        "w_input": "input_weight",
        "w_hidden": "hidden_weight",
    }

    def __init__(self, n_inputs: int, hidden_size: int, uses_softsign: bool) -> None:
        super().__init__()
        self.hidden_size = hidden_size
        self.uses_softsign = uses_softsign
        bound = 1.0 / math.sqrt(hidden_size)
        self.input_weight = nn.Parameter(
            torch.empty(4 * hidden_size, n_inputs).uniform_(-bound, bound)
        )
        self.hidden_weight = nn.Parameter(
            torch.empty(4 * hidden_size, hidden_size).uniform_(-bound, bound)
        )
        self.bias = nn.Parameter(torch.zeros(4 * hidden_size))
        with torch.no_grad():
            # an initially open forget gate (bias 1) passes gradients over many steps from the first
            # epoch (Jozefowicz et al. 2015)
            self.bias[hidden_size : 2 * hidden_size] = 1.0
        # the fused kernel of torch expects a second bias for the recurrent part
        self.zero_bias = nn.Buffer(torch.zeros(4 * hidden_size), persistent=False)

    def forward(self, features: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return output h [B, H] and memory [B, 2H] after one step of features [B, F]."""
        return self.step_from_gates(features @ self.input_weight.T + self.bias, s)

    def step_from_gates(self, gates: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return output h [B, H] and memory [B, 2H] after one step.

        Args:
            gates: input weights times features plus bias [B, 4H], without the recurrent part.
            s: memory before the step [B, 2H].
        """
        hidden, previous_cell = s.split([self.hidden_size, self.hidden_size], dim=-1)
        gates = gates + hidden @ self.hidden_weight.T
        # one sigmoid over all four gates is faster than three over separate slices; the sigmoid of
        # the cell gate is not used
        input_gate, forget_gate, _, output_gate = torch.sigmoid(gates).chunk(4, dim=-1)
        cell_gate = gates[:, 2 * self.hidden_size : 3 * self.hidden_size]
        cell_input = (
            nn.functional.softsign(cell_gate) if self.uses_softsign else fast_tanh(cell_gate)
        )
        cell = torch.addcmul(forget_gate * previous_cell, input_gate, cell_input)
        hidden = output_gate * (
            nn.functional.softsign(cell) if self.uses_softsign else fast_tanh(cell)
        )
        return hidden, torch.cat((hidden, cell), dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lower and upper bounds of the memory [2H].

        Hidden outputs are bounded by one. A cell state can grow by one per step without limit, but
        beyond 1,000 it counts as invalid, since the activation has saturated long before.
        """
        bound = self.bias.detach().new_ones(2 * self.hidden_size)
        bound[self.hidden_size :] = _MAX_CELL_STATE
        return -bound, bound

    def run_sequence(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, T, H] for features [B, T, F], and the memory [B, 2H] at the end.

        The initial memory is zero.
        """
        return self.run_from_memory(
            features, features.new_zeros((features.shape[0], 2 * self.hidden_size))
        )

    def run_from_memory(self, features: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, T, H] for features [B, T, F], and the memory [B, 2H] at the end.

        The initial memory is s [B, 2H].
        """
        if features.shape[1] == 0:
            return features.new_zeros((features.shape[0], 0, self.hidden_size)), s
        # the fused kernel of torch is several times as fast, but has tanh activations only
        if not self.uses_softsign:
            weights = [self.input_weight, self.hidden_weight, self.bias, self.zero_bias]
            initial_h_and_c = [part.unsqueeze(0).contiguous() for part in s.chunk(2, dim=-1)]
            sequence, h, c = torch.lstm(
                features,
                initial_h_and_c,
                weights,
                has_biases=True,
                num_layers=1,
                dropout=0.0,
                train=self.training,
                bidirectional=False,
                batch_first=True,
            )
            return sequence, torch.cat((h[0], c[0]), dim=-1)
        outputs: list[Tensor] = []
        for k in range(features.shape[1]):
            h, s = self.forward(features[:, k], s)
            outputs.append(h)
        return torch.stack(outputs, dim=1), s


class LstmNetwork(RenamedStateModule):
    """Features, LSTM and readout for one or all axes, with `n_outputs` outputs per sample.

    Args:
        config: settings of the head.
        feature_names: channels that are features of this network.
        n_outputs: number of residual accelerations that this network predicts.
        channel_names: names of the channels z of the model.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"core": "cell"}

    def __init__(
        self,
        config: LstmConfig,
        feature_names: Sequence[str],
        n_outputs: int,
        channel_names: Sequence[str],
    ) -> None:
        super().__init__()
        # features are clamped to their training range, widened by `margin` times its width
        self.features = Features(feature_names, channel_names, config.margin)
        lstm_feature_names = config.select_lstm_features(feature_names)
        # `memory` restricts the features of the LSTM, not those of the readout
        self.has_lstm_feature_subset = len(config.memory) > 0
        self.lstm_feature_index = nn.Buffer(
            torch.tensor(
                [list(feature_names).index(name) for name in lstm_feature_names], dtype=torch.long
            ),
            persistent=False,
        )
        uses_softsign = config.activation == "softsign"
        self.cell = LSTMCell(len(lstm_feature_names), config.hidden_size, uses_softsign)
        self.dropout = nn.Dropout(config.dropout)
        self.has_hidden_readout_layer = config.readout > 0
        output_layer = nn.Linear(config.readout or config.hidden_size, n_outputs)
        with torch.no_grad():
            # small initial outputs: training starts near the baseline, or at the linear model of a
            # skip connection
            output_layer.weight.mul_(0.1 if config.skip == "none" else 0.0)
            output_layer.bias.zero_()
        hidden_layers = (
            nn.Sequential(
                nn.Linear(config.hidden_size + self.features.n_features, config.readout),
                nn.SiLU() if config.readout_activation == "silu" else Tanh(),
            )
            if self.has_hidden_readout_layer
            else nn.Sequential()
        )
        self.readout = nn.Sequential(*hidden_layers, output_layer)

    def lstm_features(self, features: Tensor) -> Tensor:
        """Return the columns of features [..., F] that are inputs of the LSTM."""
        return (
            features.index_select(-1, self.lstm_feature_index)
            if self.has_lstm_feature_subset
            else features
        )

    def readout_residual(self, hidden: Tensor, features: Tensor) -> Tensor:
        """Return residuals [..., n_outputs] from LSTM outputs [..., H] and features [..., F]."""
        hidden = self.dropout(hidden)
        residual: Tensor = self.readout(
            torch.cat((hidden, features), dim=-1) if self.has_hidden_readout_layer else hidden
        )
        return residual

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, n_outputs] and the memory after one step of channels [B, nz]."""
        features = self.features(z)
        hidden, s = self.cell(self.lstm_features(features), s)
        return self.readout_residual(hidden, features), s

    def run_sequence(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, T, n_outputs] for channels [B, T, nz], and the memory at the end."""
        features = self.features(z)
        hidden, s = self.cell.run_sequence(self.lstm_features(features))
        return self.readout_residual(hidden, features), s


@final
class LstmHead(ResidualHead):
    """LSTM head; the memory s is the concatenation of (h, c) of all networks.

    Args:
        config: settings of the head.
        channel_names: names of the channels z of the model, the velocities first.
    """

    def __init__(self, config: LstmConfig, channel_names: Sequence[str]) -> None:
        super().__init__(channel_names)
        self.networks: Sequence[LstmNetwork] = nn.ModuleList(  # type: ignore[assignment]
            [
                LstmNetwork(config, feature_names, n_outputs, channel_names)
                for feature_names, n_outputs in config.network_specs(channel_names)
            ]
        )
        self.network_state_size = 2 * config.hidden_size
        self.n_state = self.network_state_size * len(self.networks)
        self.scale = ResidualScale(self.n_dof)
        self.restoring_acceleration: SoftVelocityLimit | None = (
            # a skip connection has its own, which does not decay outside the training range
            SoftVelocityLimit(n_channels=self.n_dof, n_dof=self.n_dof)
            if config.restoring and config.skip == "none"
            else None
        )

    def residual_scale(self) -> Tensor:
        return self.scale.std

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        residuals: list[Tensor] = []
        memories: list[Tensor] = []
        for i, network in enumerate(self.networks):
            residual, memory = network(
                z, s[:, i * self.network_state_size : (i + 1) * self.network_state_size]
            )
            residuals.append(residual)
            memories.append(memory)
        return self.combine_networks(residuals, memories, z)

    def combine_networks(
        self, residuals: list[Tensor], memories: list[Tensor], z: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Concatenate the outputs and the memories of all networks and scale the outputs.

        Args:
            residuals: normalised outputs of each network [..., n_outputs].
            memories: memory of each network [B, 2H].
            z: channels [..., nz], the velocities first.

        Returns:
            Residual accelerations [..., n] and memory [B, n_state].
        """
        # torch.cat of a single tensor would copy it
        residual: Tensor = self.scale(
            residuals[0] if len(residuals) == 1 else torch.cat(residuals, dim=-1)
        )
        if self.restoring_acceleration is not None:
            residual = residual + self.restoring_acceleration(z)
        return residual, memories[0] if len(memories) == 1 else torch.cat(memories, dim=-1)

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        residuals: list[Tensor] = []
        memories: list[Tensor] = []
        for network in self.networks:
            residual, memory = network.run_sequence(z)
            residuals.append(residual)
            memories.append(memory)
        return self.combine_networks(residuals, memories, z)[0]

    def warmup(self, z: Tensor) -> Tensor:
        memories: list[Tensor] = []
        for network in self.networks:
            lstm_features = network.lstm_features(network.features(z))
            memories.append(network.cell.run_sequence(lstm_features)[1])
        return torch.cat(memories, dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        bounds = [network.cell.memory_bounds() for network in self.networks]
        return torch.cat([lower for lower, _ in bounds]), torch.cat([upper for _, upper in bounds])

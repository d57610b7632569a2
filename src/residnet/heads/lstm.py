"""Long short-term memory: a residual with a hidden state (document 003 eq. (17), correction W4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.errors import ConfigError
from residnet.heads.base import FeatureConfig, Features, ResidualHead, ResidualScale
from residnet.heads.mirror import MirroredHead, Tanh, fast_tanh
from residnet.physics.signals import RestoringAcceleration
from residnet.physics.symmetry import get_dof

_MAX_CELL_STATE = 1e3
"""Largest cell state that a memory may hold: a gain of at most one each step, the gates open."""


class LstmConfig(FeatureConfig):
    """An LSTM for all axes, or one for each.

    Attributes:
        hidden_size: number of hidden units.
        readout: number of units of a tanh layer between (memory, features) and the residual; 0
            reads the memory alone by a linear map, as document 003 does.
        memory: features that the memory sees; empty for all. A memory of the commands alone is the
            same in free run as along measurements: it can hold the state of an actuator, but no
            measured acceleration. Needs `readout`, which sees all features.
        activation: function of block input and output; document 003 uses softsign in place of the
            usual tanh.
        dropout: share of hidden outputs dropped before the readout while training.
        per_axis: one network for each of surge, sway, yaw, as document 003 has it.
        axis_features: channels of each axis' network, where they differ; needs `per_axis`.
        mirror: make the residual mirror-symmetric between port and starboard by construction.
        restoring: velocities that leave their training range are pulled back into it, so that a
            network that stands alone cannot run away.
    """

    kind: Literal["lstm"] = "lstm"
    hidden_size: int = Field(default=100, ge=1, le=10_000)
    readout: int = Field(default=0, ge=0, le=10_000)
    memory: tuple[str, ...] = ()
    activation: Literal["tanh", "softsign"] = "tanh"
    dropout: float = Field(default=0.0, ge=0, lt=1)
    per_axis: bool = False
    axis_features: dict[Literal["u", "v", "r"], tuple[str, ...]] | None = None
    mirror: bool = False
    restoring: bool = False

    @model_validator(mode="after")
    def _validate_axes(self) -> LstmConfig:
        if self.axis_features is not None:
            if not self.per_axis:
                raise ValueError("axis_features needs per_axis: true")
            if set(self.axis_features) != {"u", "v", "r"}:
                raise ValueError(
                    f"axis_features needs all of u, v, r; given {sorted(self.axis_features)}"
                )
        if self.memory and not self.readout:
            raise ValueError(
                "memory needs a readout layer, or the other features are never seen; set readout"
            )
        return self

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Return the module for channels `names`."""
        head = LstmHead(self, names)
        return MirroredHead(head, names) if self.mirror else head

    def network_specs(self, names: Sequence[str]) -> list[tuple[tuple[str, ...], int]]:
        """Return (features, number of outputs) of each network."""
        if not self.per_axis:
            return [(self.select_features(names), get_dof(names).n_dynamic)]
        if get_dof(names).has_roll:
            raise ConfigError(
                "per_axis: there is one network for each of surge, sway and yaw, and none for the"
                " roll of this model; leave per_axis out"
            )
        if self.axis_features is None:
            return [(self.select_features(names), 1)] * get_dof(names).n_dynamic
        return [
            (FeatureConfig(features=self.axis_features[axis]).select_features(names), 1)
            for axis in ("u", "v", "r")
        ]


class LSTMCell(nn.Module):
    """An LSTM layer with a single bias per gate.

    It is stepped by a cell and run over sequences with the same weights.

    Memory s [B, 2H] holds h and c side by side. 4 H (F + H + 1) parameters.
    """

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
            # a forget gate that starts open lets the memory reach back from the first epoch
            self.bias[hidden_size : 2 * hidden_size] = 1.0
        self.zero_bias = nn.Buffer(torch.zeros(4 * hidden_size), persistent=False)

    def forward(self, features: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return output h [B, H] and memory [B, 2H] after one step of features [B, F]."""
        return self.step_from_gates(features @ self.input_weight.T + self.bias, s)

    def step_from_gates(self, gates: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return output and memory as `forward` does, from the features' share [B, 4H]."""
        hidden, previous_cell = s.split([self.hidden_size, self.hidden_size], dim=-1)
        gates = gates + hidden @ self.hidden_weight.T
        # one operation over all numbers is quicker than three over parts that lie apart
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
        """Return the least and largest memory [2H]: outputs below one, cells as gates allow.

        A cell gains at most one each step and could go on for ever where its gates stay open; it
        is taken for wrong beyond 1,000, where it has long saturated.
        """
        bound = self.bias.detach().new_ones(2 * self.hidden_size)
        bound[self.hidden_size :] = _MAX_CELL_STATE
        return -bound, bound

    def run_sequence(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, T, H] for features [B, T, F], and the memory [B, 2H] after them.

        It starts from an empty memory.
        """
        return self.along(features, features.new_zeros((features.shape[0], 2 * self.hidden_size)))

    def along(self, f: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, T, H] for features [B, T, F] from memory s [B, 2H] on, and the last.

        The last is the memory [B, 2H] after them.
        """
        if f.shape[1] == 0:
            return f.new_zeros((f.shape[0], 0, self.hidden_size)), s
        if not self.uses_softsign:
            weights = [self.input_weight, self.hidden_weight, self.bias, self.zero_bias]
            start = [part.unsqueeze(0).contiguous() for part in s.chunk(2, dim=-1)]
            out, h, c = torch.lstm(f, start, weights, True, 1, 0.0, self.training, False, True)
            return out, torch.cat((h[0], c[0]), dim=-1)
        outputs: list[Tensor] = []
        for k in range(f.shape[1]):
            h, s = self.forward(f[:, k], s)
            outputs.append(h)
        return torch.stack(outputs, dim=1), s


class LstmNetwork(nn.Module):
    """The features, LSTM and readout of one or all axes; `n_outputs` numbers per sample."""

    def __init__(
        self, config: LstmConfig, feature_names: Sequence[str], n_outputs: int, names: Sequence[str]
    ) -> None:
        super().__init__()
        self.features = Features(feature_names, names, config.margin)
        memory_features = FeatureConfig(features=config.memory).select_features(feature_names)
        self.has_memory_selection = len(config.memory) > 0
        self.memory_input_index = nn.Buffer(
            torch.tensor(
                [list(feature_names).index(name) for name in memory_features], dtype=torch.long
            ),
            persistent=False,
        )
        uses_softsign = config.activation == "softsign"
        self.cell = LSTMCell(len(memory_features), config.hidden_size, uses_softsign)
        self.dropout = nn.Dropout(config.dropout)
        self.has_readout_layer = config.readout > 0
        output_layer = nn.Linear(config.readout or config.hidden_size, n_outputs)
        with torch.no_grad():
            output_layer.weight.mul_(0.1)
            output_layer.bias.zero_()
        hidden_layers = (
            nn.Sequential(
                nn.Linear(config.hidden_size + self.features.n_features, config.readout), Tanh()
            )
            if self.has_readout_layer
            else nn.Sequential()
        )
        self.readout = nn.Sequential(*hidden_layers, output_layer)

    def memory_inputs(self, features: Tensor) -> Tensor:
        """Return the features that the memory sees."""
        return (
            features.index_select(-1, self.memory_input_index)
            if self.has_memory_selection
            else features
        )

    def readout_residual(self, hidden: Tensor, features: Tensor) -> Tensor:
        """Return scaled residuals [..., outputs] from outputs [..., H] and features [..., F]."""
        hidden = self.dropout(hidden)
        residual: Tensor = self.readout(
            torch.cat((hidden, features), dim=-1) if self.has_readout_layer else hidden
        )
        return residual

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return [B, outputs] and the new memory after one step of channels [B, nz]."""
        features = self.features(z)
        hidden, s = self.cell(self.memory_inputs(features), s)
        return self.readout_residual(hidden, features), s

    def run_sequence(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return [B, T, outputs] for channels [B, T, nz], and the memory after them."""
        features = self.features(z)
        hidden, s = self.cell.run_sequence(self.memory_inputs(features))
        return self.readout_residual(hidden, features), s


@final
class LstmHead(ResidualHead):
    """A head with memory; s packs (h, c) of each network."""

    def __init__(self, config: LstmConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.networks: Sequence[LstmNetwork] = nn.ModuleList(  # type: ignore[assignment]
            [
                LstmNetwork(config, feature_names, n_outputs, names)
                for feature_names, n_outputs in config.network_specs(names)
            ]
        )
        self.network_state_size = 2 * config.hidden_size
        self.n_state = self.network_state_size * len(self.networks)
        self.scale = ResidualScale(self.n_dof)
        self.restoring_acceleration: RestoringAcceleration | None = (
            RestoringAcceleration(n_channels=self.n_dof, n_dof=self.n_dof)
            if config.restoring
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
        self, residuals: list[Tensor], memories: list[Tensor], nu: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return residual and memory of all networks, from those of each, at velocities nu."""
        # joining a single part would copy it
        rho: Tensor = self.scale(
            residuals[0] if len(residuals) == 1 else torch.cat(residuals, dim=-1)
        )
        if self.restoring_acceleration is not None:
            rho = rho + self.restoring_acceleration(nu)
        return rho, memories[0] if len(memories) == 1 else torch.cat(memories, dim=-1)

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
            memory_inputs = network.memory_inputs(network.features(z))
            memories.append(network.cell.run_sequence(memory_inputs)[1])
        return torch.cat(memories, dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        bounds = [network.cell.memory_bounds() for network in self.networks]
        return torch.cat([lower for lower, _ in bounds]), torch.cat([upper for _, upper in bounds])

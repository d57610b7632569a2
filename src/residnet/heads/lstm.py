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
from residnet.heads.mirror import MirroredHead, Tanh, quick_tanh
from residnet.physics.signals import VelocityBound
from residnet.physics.symmetry import live_of

_FARTHEST = 1e3
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
    def _axes(self) -> LstmConfig:
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

    def networks(self, names: Sequence[str]) -> list[tuple[tuple[str, ...], int]]:
        """Return (features, number of outputs) of each network."""
        if not self.per_axis:
            return [(self.chosen(names), live_of(names).size)]
        if live_of(names).rolls:
            raise ConfigError(
                "per_axis: there is one network for each of surge, sway and yaw, and none for the"
                " roll of this model; leave per_axis out"
            )
        if self.axis_features is None:
            return [(self.chosen(names), 1)] * live_of(names).size
        return [
            (FeatureConfig(features=self.axis_features[axis]).chosen(names), 1)
            for axis in ("u", "v", "r")
        ]


class LstmCore(nn.Module):
    """An LSTM layer with a single bias per gate.

    It is stepped by a cell and run over sequences with the same weights.

    Memory s [B, 2H] holds h and c side by side. 4 H (F + H + 1) parameters.
    """

    def __init__(self, inputs: int, hidden: int, softsign: bool) -> None:
        super().__init__()
        self.hidden = hidden
        self.softsign = softsign
        bound = 1.0 / math.sqrt(hidden)
        self.w_input = nn.Parameter(torch.empty(4 * hidden, inputs).uniform_(-bound, bound))
        self.w_hidden = nn.Parameter(torch.empty(4 * hidden, hidden).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(4 * hidden))
        with torch.no_grad():
            # a forget gate that starts open lets the memory reach back from the first epoch
            self.bias[hidden : 2 * hidden] = 1.0
        self.no_bias = nn.Buffer(torch.zeros(4 * hidden), persistent=False)

    def forward(self, f: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return output h [B, H] and memory [B, 2H] after one step of features [B, F]."""
        return self.gated(f @ self.w_input.T + self.bias, s)

    def gated(self, gates: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return output and memory as `forward` does, from the features' share [B, 4H]."""
        h, before = s.split([self.hidden, self.hidden], dim=-1)
        gates = gates + h @ self.w_hidden.T
        # one operation over all numbers is quicker than three over parts that lie apart
        i, forget, _, o = torch.sigmoid(gates).chunk(4, dim=-1)
        g = gates[:, 2 * self.hidden : 3 * self.hidden]
        block = nn.functional.softsign(g) if self.softsign else quick_tanh(g)
        c = torch.addcmul(forget * before, i, block)
        h = o * (nn.functional.softsign(c) if self.softsign else quick_tanh(c))
        return h, torch.cat((h, c), dim=-1)

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [2H]: outputs below one, cells as gates allow.

        A cell gains at most one each step and could go on for ever where its gates stay open; it
        is taken for wrong beyond 1,000, where it has long saturated.
        """
        limit = self.bias.detach().new_ones(2 * self.hidden)
        limit[self.hidden :] = _FARTHEST
        return -limit, limit

    def sequence(self, f: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, T, H] for features [B, T, F], and the memory [B, 2H] after them.

        It starts from an empty memory.
        """
        return self.along(f, f.new_zeros((f.shape[0], 2 * self.hidden)))

    def along(self, f: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs [B, T, H] for features [B, T, F] from memory s [B, 2H] on, and the last.

        The last is the memory [B, 2H] after them.
        """
        if f.shape[1] == 0:
            return f.new_zeros((f.shape[0], 0, self.hidden)), s
        if not self.softsign:
            weights = [self.w_input, self.w_hidden, self.bias, self.no_bias]
            start = [part.unsqueeze(0).contiguous() for part in s.chunk(2, dim=-1)]
            out, h, c = torch.lstm(f, start, weights, True, 1, 0.0, self.training, False, True)
            return out, torch.cat((h[0], c[0]), dim=-1)
        outputs: list[Tensor] = []
        for k in range(f.shape[1]):
            h, s = self.forward(f[:, k], s)
            outputs.append(h)
        return torch.stack(outputs, dim=1), s


class LstmNetwork(nn.Module):
    """The features, LSTM and readout of one or all axes; `outputs` numbers per sample."""

    def __init__(
        self, config: LstmConfig, chosen: Sequence[str], outputs: int, names: Sequence[str]
    ) -> None:
        super().__init__()
        self.features = Features(chosen, names, config.margin)
        seen = FeatureConfig(features=config.memory).chosen(chosen)
        self.partial = len(config.memory) > 0
        self.seen = nn.Buffer(
            torch.tensor([list(chosen).index(name) for name in seen], dtype=torch.long),
            persistent=False,
        )
        softsign = config.activation == "softsign"
        self.core = LstmCore(len(seen), config.hidden_size, softsign)
        self.dropout = nn.Dropout(config.dropout)
        self.skip = config.readout > 0
        out = nn.Linear(config.readout or config.hidden_size, outputs)
        with torch.no_grad():
            out.weight.mul_(0.1)
            out.bias.zero_()
        mixer = (
            nn.Sequential(
                nn.Linear(config.hidden_size + self.features.count, config.readout), Tanh()
            )
            if self.skip
            else nn.Sequential()
        )
        self.readout = nn.Sequential(*mixer, out)

    def remembered(self, f: Tensor) -> Tensor:
        """Return the features that the memory sees."""
        return f.index_select(-1, self.seen) if self.partial else f

    def read(self, h: Tensor, f: Tensor) -> Tensor:
        """Return scaled residuals [..., outputs] from outputs [..., H] and features [..., F]."""
        h = self.dropout(h)
        out: Tensor = self.readout(torch.cat((h, f), dim=-1) if self.skip else h)
        return out

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return [B, outputs] and the new memory after one step of channels [B, nz]."""
        f = self.features(z)
        h, s = self.core(self.remembered(f), s)
        return self.read(h, f), s

    def sequence(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return [B, T, outputs] for channels [B, T, nz], and the memory after them."""
        f = self.features(z)
        h, s = self.core.sequence(self.remembered(f))
        return self.read(h, f), s


@final
class LstmHead(ResidualHead):
    """A head with memory; s packs (h, c) of each network."""

    def __init__(self, config: LstmConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.networks: Sequence[LstmNetwork] = nn.ModuleList(  # type: ignore[assignment]
            [
                LstmNetwork(config, chosen, outputs, names)
                for chosen, outputs in config.networks(names)
            ]
        )
        self.width = 2 * config.hidden_size
        self.n_state = self.width * len(self.networks)
        self.scale = ResidualScale(self.dof)
        self.restoring: VelocityBound | None = (
            VelocityBound(channels=self.dof, dof=self.dof) if config.restoring else None
        )

    def residual_std(self) -> Tensor:
        return self.scale.spread

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        out: list[Tensor] = []
        memory: list[Tensor] = []
        for i, network in enumerate(self.networks):
            y, m = network(z, s[:, i * self.width : (i + 1) * self.width])
            out.append(y)
            memory.append(m)
        return self.joined(out, memory, z)

    def joined(self, out: list[Tensor], memory: list[Tensor], nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return residual and memory of all networks, from those of each, at velocities nu."""
        # joining a single part would copy it
        rho: Tensor = self.scale(out[0] if len(out) == 1 else torch.cat(out, dim=-1))
        if self.restoring is not None:
            rho = rho + self.restoring(nu)
        return rho, memory[0] if len(memory) == 1 else torch.cat(memory, dim=-1)

    def sequence(self, z: Tensor) -> Tensor:
        out: list[Tensor] = []
        memory: list[Tensor] = []
        for network in self.networks:
            y, m = network.sequence(z)
            out.append(y)
            memory.append(m)
        return self.joined(out, memory, z)[0]

    def warmup(self, z: Tensor) -> Tensor:
        memory: list[Tensor] = []
        for network in self.networks:
            seen = network.remembered(network.features(z))
            memory.append(network.core.sequence(seen)[1])
        return torch.cat(memory, dim=-1)

    def memory_range(self) -> tuple[Tensor, Tensor]:
        ranges = [network.core.memory_range() for network in self.networks]
        return torch.cat([low for low, _ in ranges]), torch.cat([high for _, high in ranges])

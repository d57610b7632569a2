"""Ensembles of recurrent networks that are evaluated as one batch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.renamed_state import RenamedStateModule
from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.physics.signals import RestoringAcceleration

if TYPE_CHECKING:
    from residnet.heads.recurrent_config import GRUEnsembleConfig

_INNOVATION_CLIP_STD = 4.0
"""Bound of the innovations after smooth clipping, in standard deviations of the residual."""
_MIN_GATE = 1e-13
"""Lower bound of the update gate, so that its logarithm is finite in float32."""


@final
class GRUEnsembleHead(RenamedStateModule, ResidualHead):
    """Ensemble of K recurrent networks whose weights have a leading axis of size K.

    Rows of z [K B, nz (+ n)] and s [K B, H] are K consecutive blocks of B rows, one per network.
    The n innovations may be appended to the channels.
    """

    renamed_state: ClassVar[Mapping[str, str]] = {
        "w_input": "input_weight",
        "w_hidden": "hidden_weight",
        "w_out": "output_weight",
        "w_skip": "skip_weight",
    }

    def __init__(self, config: GRUEnsembleConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.batch_ensemble_size = config.members
        self.n_state = config.hidden_size
        self.training_step = config.step
        self.innovation_time_constant = 2.0 * config.step
        self.step_ratio = 1.0
        self.innovation_clip = _INNOVATION_CLIP_STD
        self.min_gate = _MIN_GATE
        self.n_channels = len(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.restoring_acceleration: RestoringAcceleration | None = (
            RestoringAcceleration(n_channels=self.n_dof, n_dof=self.n_dof)
            if config.restoring
            else None
        )
        self.n_inputs = n_inputs = self.features.n_features + self.n_dof
        hidden_size = config.hidden_size

        def uniform_parameter(*shape: int) -> nn.Parameter:
            bound = 1.0 / math.sqrt(hidden_size)
            return nn.Parameter(torch.empty(config.members, *shape).uniform_(-bound, bound))

        self.input_weight = uniform_parameter(n_inputs, 3 * hidden_size)
        self.hidden_weight = uniform_parameter(hidden_size, 3 * hidden_size)
        self.bias = uniform_parameter(1, 3 * hidden_size)
        self.bias_hidden = uniform_parameter(1, hidden_size)
        self.output_weight = uniform_parameter(hidden_size, self.n_dof)
        self.skip_weight = uniform_parameter(n_inputs, self.n_dof)
        self.bias_out = nn.Parameter(torch.zeros(config.members, 1, self.n_dof))
        with torch.no_grad():
            # small initial outputs: training starts near the baseline
            for weight in (self.output_weight, self.skip_weight):
                weight.mul_(0.1)

    def set_step(self, dt: float) -> None:
        self.step_ratio = dt / self.training_step

    def residual_scale(self) -> Tensor:
        return self.scale.std

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals [K B, n] and the next memories at channels z [K B, nz (+ n)].

        Innovations are zero if they are not appended to the channels.
        """
        if z.shape[-1] > self.n_channels:
            # large innovations are outliers or faults: limit their effect smoothly
            z, innovation = z.split([self.n_channels, self.n_dof], dim=-1)
            innovation = self.innovation_clip * torch.tanh(
                innovation / (self.innovation_clip * self.scale.std.to(z.dtype))
            )
        else:
            innovation = torch.zeros_like(z[..., : self.n_dof])
        network_inputs = torch.cat((self.features(z), innovation), dim=-1).view(
            self.batch_ensemble_size, -1, self.n_inputs
        )
        hidden = self.update_memory(torch.baddbmm(self.bias, network_inputs, self.input_weight), s)
        network_output = torch.baddbmm(
            torch.baddbmm(self.bias_out, network_inputs, self.skip_weight),
            hidden,
            self.output_weight,
        )
        rho: Tensor = self.scale(network_output.reshape(-1, self.n_dof))
        if self.restoring_acceleration is not None:
            rho = rho + self.restoring_acceleration(z)
        return rho, hidden.reshape(-1, self.n_state)

    def update_memory(self, input_gates: Tensor, s: Tensor) -> Tensor:
        """Return the next memories [K, B, H], given the input part of the gates [K, B, 3 H]."""
        hidden_size = self.n_state
        hidden = s.reshape(self.batch_ensemble_size, -1, hidden_size)
        # split instead of slices, because gradients of slices are summed over full-size tensors
        gates, candidate = input_gates.split([2 * hidden_size, hidden_size], dim=-1)
        hidden_gates, hidden_candidate = torch.bmm(hidden, self.hidden_weight).split(
            [2 * hidden_size, hidden_size], dim=-1
        )
        update_gate, reset_gate = torch.sigmoid(gates + hidden_gates).chunk(2, dim=-1)
        # the gate is the share retained over the training step; take its root for shorter steps
        if self.step_ratio != 1.0:
            update_gate = torch.exp(
                self.step_ratio * torch.log(update_gate.clamp(min=self.min_gate))
            )
        # reset after the product, as in cuDNN and torch.nn.GRU
        candidate = torch.tanh(candidate + reset_gate * (hidden_candidate + self.bias_hidden))
        # convex combination of candidate and memory, written with one product
        return candidate + update_gate * (hidden - candidate)

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        residuals: list[Tensor] = []
        for k in range(z.shape[1]):
            rho, s = self.forward(z[:, k], s)
            residuals.append(rho)
        return torch.stack(residuals, dim=1)

    def warmup(self, z: Tensor) -> Tensor:
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        for k in range(z.shape[1]):
            s = self.forward(z[:, k], s)[1]
        return s

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the bounds of the memory [H]; units are convex combinations of tanh values."""
        bound = self.bias.detach().new_ones(self.n_state)
        return -bound, bound

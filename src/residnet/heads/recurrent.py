"""Ensembles of recurrent networks that are evaluated as one batch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.renamed_state import RenamedStateModule
from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.physics.signals import SoftVelocityLimit

if TYPE_CHECKING:
    from residnet.heads.recurrent_config import GRUEnsembleConfig

_INNOVATION_CLIP_STD = 4.0
"""Bound of the innovations after smooth clipping, in standard deviations of the residual."""
_MIN_FORGOTTEN_SHARE = 1e-4
"""Lower bound of the share of a cell state that is forgotten in a step, for shorter steps."""
_MAX_CELL_STATE = 1e4
"""Largest cell state of a long short-term memory, one divided by the smallest forgotten share."""
_MIN_GATE = 1e-13
"""Lower bound of the update gate, so that its logarithm is finite in float32."""


@final
class GRUEnsembleHead(RenamedStateModule, ResidualHead):
    """Ensemble of K recurrent networks whose weights have a leading axis of size K.

    Rows of z and s [K B, H] are K consecutive blocks of B rows, one per network. In the measured
    past, further columns follow the channels z [K B, nz]: the n innovations; with an encoder one
    flag, which is 1 where the states are measured. Without these columns the states are
    predictions, and innovations and flag are zero.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {
        "w_input": "input_weight",
        "w_hidden": "hidden_weight",
        "w_out": "output_weight",
        "w_skip": "skip_weight",
    }

    def __init__(self, config: GRUEnsembleConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.batch_ensemble_size = config.members
        self.hidden_size = config.hidden_size
        self.is_lstm = config.cell == "lstm"
        # a long short-term memory has a cell state besides its output
        self.n_state = (2 if self.is_lstm else 1) * config.hidden_size
        self.training_step = config.step
        self.has_encoder = config.encoder == "measurements"
        self.is_decoding_only = False
        self.innovation_time_constant = 0.0 if self.has_encoder else 2.0 * config.step
        self.step_ratio = 1.0
        self.innovation_clip = _INNOVATION_CLIP_STD
        self.min_gate = _MIN_GATE
        self.n_channels = len(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.restoring_acceleration: SoftVelocityLimit | None = (
            SoftVelocityLimit(config.margin, n_channels=self.n_dof, n_dof=self.n_dof)
            if config.restoring
            else None
        )
        n_innovations = 0 if self.has_encoder else self.n_dof
        self.n_inputs = n_inputs = self.features.n_features + n_innovations
        hidden_size = config.hidden_size
        n_gates = 4 if self.is_lstm else 3

        def uniform_parameter(*shape: int) -> nn.Parameter:
            bound = 1.0 / math.sqrt(hidden_size)
            return nn.Parameter(torch.empty(config.members, *shape).uniform_(-bound, bound))

        self.input_weight = uniform_parameter(n_inputs, n_gates * hidden_size)
        self.hidden_weight = uniform_parameter(hidden_size, n_gates * hidden_size)
        self.bias = uniform_parameter(1, n_gates * hidden_size)
        self.bias_hidden = uniform_parameter(1, hidden_size)
        if self.has_encoder:
            self.encoder_input_weight = uniform_parameter(n_inputs, n_gates * hidden_size)
            self.encoder_hidden_weight = uniform_parameter(hidden_size, n_gates * hidden_size)
            self.encoder_bias = uniform_parameter(1, n_gates * hidden_size)
            self.encoder_bias_hidden = uniform_parameter(1, hidden_size)
        self.output_weight = uniform_parameter(hidden_size, self.n_dof)
        self.skip_weight = uniform_parameter(n_inputs, self.n_dof)
        self.bias_out = nn.Parameter(torch.zeros(config.members, 1, self.n_dof))
        self.training_gain: Tensor | None = None
        with torch.no_grad():
            # small initial outputs: training starts near the baseline
            for weight in (self.output_weight, self.skip_weight):
                weight.mul_(0.1)

    def set_step(self, dt: float) -> None:
        self.step_ratio = dt / self.training_step

    def residual_scale(self) -> Tensor:
        return self.scale.std

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals [K B, n] and the next memories [K B, n_state].

        Args:
            z: channels, and innovations or flag in the measured past [K B, nz (+ n or + 1)].
            s: memories [K B, n_state].
        """
        z, measured_columns = z.split([self.n_channels, z.shape[-1] - self.n_channels], dim=-1)
        inputs = self.features(z)
        if not self.has_encoder:
            if measured_columns.shape[-1] == 0:
                innovation = torch.zeros_like(z[..., : self.n_dof])
            else:
                # large innovations are outliers or faults: limit their effect smoothly
                innovation = self.innovation_clip * torch.tanh(
                    measured_columns / (self.innovation_clip * self.scale.std.to(z.dtype))
                )
            inputs = torch.cat((inputs, innovation), dim=-1)
        inputs = inputs.view(self.batch_ensemble_size, -1, self.n_inputs)
        memory = s.reshape(self.batch_ensemble_size, -1, self.n_state)
        next_memory = self.update_memory(
            torch.baddbmm(self.bias, inputs, self.input_weight),
            memory,
            self.hidden_weight,
            self.bias_hidden,
        )
        # the encoder has other weights, with which it updates the memory from measured states
        if self.has_encoder and measured_columns.shape[-1] > 0 and not self.is_decoding_only:
            encoded_memory = self.update_memory(
                torch.baddbmm(self.encoder_bias, inputs, self.encoder_input_weight),
                memory,
                self.encoder_hidden_weight,
                self.encoder_bias_hidden,
            )
            is_measured = measured_columns.view(self.batch_ensemble_size, -1, 1)
            next_memory = next_memory + is_measured * (encoded_memory - next_memory)
        network_output = torch.baddbmm(
            torch.baddbmm(self.bias_out, inputs, self.skip_weight),
            next_memory[..., : self.hidden_size],
            self.output_weight,
        )
        if self.training_gain is not None:
            network_output = network_output * self.training_gain.to(network_output)
        rho: Tensor = self.scale(network_output.reshape(-1, self.n_dof))
        if self.restoring_acceleration is not None:
            rho = rho + self.restoring_acceleration(z)
        return rho, next_memory.reshape(-1, self.n_state)

    def set_training_gain(self, gain: Tensor | None) -> None:
        """Multiply the outputs by a gain [n] during training; None removes it.

        The weights of the outputs change inversely, so that the head is the same function. A step
        of Adam has about the same size for every weight; with a gain it changes the outputs by
        more.
        """
        ratio = torch.ones(self.n_dof, dtype=torch.float64)
        if self.training_gain is not None:
            ratio = ratio * self.training_gain.double()
        if gain is not None:
            ratio = ratio / gain.double()
        with torch.no_grad():
            for weight in (self.output_weight, self.skip_weight, self.bias_out):
                weight.mul_(ratio.to(weight))
        self.training_gain = gain

    def keep_first_member(self) -> None:
        """Remove all networks but the first one."""
        for name, parameter in list(self.named_parameters(recurse=False)):
            first = nn.Parameter(parameter.detach()[:1].clone(), parameter.requires_grad)
            setattr(self, name, first)
        self.batch_ensemble_size = 1

    def clip_member_gradients(self, max_norm: float) -> None:
        """Limit the norm of the gradient of each network.

        A common limit would reduce the steps of all networks because of the gradient of one.

        Args:
            max_norm: largest norm of the gradient of a network's own loss; the loss of the ensemble
                is the mean over its networks.
        """
        gradients = [p.grad for p in self.parameters() if p.grad is not None]
        norms = torch.stack([grad.flatten(1).square().sum(1) for grad in gradients]).sum(0).sqrt()
        factors = (max_norm / self.batch_ensemble_size / norms.clamp(min=1e-30)).clamp(max=1.0)
        for grad in gradients:
            grad.mul_(factors.view(-1, *[1] * (grad.ndim - 1)))

    def update_memory(
        self, input_gates: Tensor, memory: Tensor, hidden_weight: Tensor, bias_hidden: Tensor
    ) -> Tensor:
        """Return the next memories [K, B, n_state].

        Args:
            input_gates: input part of the gates [K, B, 3 H]; [K, B, 4 H] for `lstm`.
            memory: memories [K, B, n_state].
            hidden_weight: weights of the memory in the gates [K, H, 3 H or 4 H].
            bias_hidden: bias of the memory in the candidate [K, 1, H].
        """
        size = self.hidden_size
        # split instead of slices, because gradients of slices are summed over full-size tensors
        if self.is_lstm:
            hidden, cell = memory.split([size, size], dim=-1)
            all_gates = input_gates + torch.bmm(hidden, hidden_weight)
            gates, candidate = all_gates.split([3 * size, size], dim=-1)
            forget_gate, input_gate, output_gate = torch.sigmoid(gates).chunk(3, dim=-1)
            cell_input = input_gate * torch.tanh(candidate + bias_hidden)
            if self.step_ratio == 1.0:
                cell = forget_gate * cell + cell_input
            else:
                # a step of another length: the cell relaxes towards cell_input / (1 - forget_gate)
                forgotten = (1.0 - forget_gate).clamp(min=_MIN_FORGOTTEN_SHARE)
                retained = torch.exp(self.step_ratio * torch.log(1.0 - forgotten))
                cell = retained * cell + (1.0 - retained) / forgotten * cell_input
            return torch.cat((output_gate * torch.tanh(cell), cell), dim=-1)
        gates, candidate = input_gates.split([2 * size, size], dim=-1)
        hidden_gates, hidden_candidate = torch.bmm(memory, hidden_weight).split(
            [2 * size, size], dim=-1
        )
        update_gate, reset_gate = torch.sigmoid(gates + hidden_gates).chunk(2, dim=-1)
        # the gate is the share retained over a training step; other steps retain a power of it
        if self.step_ratio != 1.0:
            update_gate = torch.exp(
                self.step_ratio * torch.log(update_gate.clamp(min=self.min_gate))
            )
        # reset after the product, as in cuDNN and torch.nn.GRU
        candidate = torch.tanh(candidate + reset_gate * (hidden_candidate + bias_hidden))
        # convex combination of candidate and memory, written with one product
        return candidate + update_gate * (memory - candidate)

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
        """Return the bounds of the memory [n_state]; outputs are between -1 and 1."""
        bound = self.bias.detach().new_ones(self.n_state)
        if self.is_lstm:
            bound[self.hidden_size :] = _MAX_CELL_STATE
        return -bound, bound

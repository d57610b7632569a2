"""Interfaces of controllers and guidance, and the closed loop as input source of a simulation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import torch
from torch import Tensor, nn

from residnet.engine.rollout import Source


class StatefulModule(nn.Module, ABC):
    """A module with a memory [B, n_state] that is passed from step to step."""

    def __init__(self) -> None:
        super().__init__()
        self.n_state = 0

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory [B, n_state] at the first state x [B, nx]: zeros."""
        return torch.zeros(x.shape[0], self.n_state, dtype=x.dtype, device=x.device)


class Policy(StatefulModule):
    """A controller that computes commands from state and reference once per time step.

    The same tensor code is used in training, simulation and export.
    """

    @abstractmethod
    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the command [B, c] and the new memory.

        Args:
            x: state [B, nx].
            reference: reference [B, r] of this step.
            s: memory [B, n_state].
        """

    def replace_rudder_in_memory(self, s: Tensor, rudder: Tensor) -> Tensor:
        """Replace the stored rudder angle by the rudder angle [B, 1] that was actually applied.

        The memory of an observer contains the rudder angle. A controller without an observer
        returns the memory unchanged.
        """
        return s


class Reference(StatefulModule):
    """Guidance: computes the reference of the controller."""

    def __init__(self) -> None:
        super().__init__()
        self.may_finish = False

    @abstractmethod
    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the reference [B, r] for step k and the new memory.

        Args:
            x: state [B, nx].
            k: number of the time step.
            s: memory [B, n_state].
        """

    def is_finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Return which rows [B] have reached the end of the course.

        The method is called only if `may_finish` is set.
        """
        return torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)


@final
class RecordedReference(Reference):
    """A reference known in advance, [B, T, r]; its last value is used beyond T."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = values

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.values[:, min(k, self.values.shape[1] - 1)].to(x.dtype), s


@final
class ClosedLoop(Source):
    """Guidance and controller as the source of the inputs of a simulation.

    The c commands replace the first c columns of w.
    """

    def __init__(self, policy: Policy, reference: Reference) -> None:
        super().__init__()
        self.policy = policy
        self.reference = reference
        self.can_stop = reference.may_finish

    def initial(self, x: Tensor) -> Tensor:
        """Return the initial memories of guidance and controller, concatenated."""
        return torch.cat((self.reference.initial_state(x), self.policy.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]: the command, then the other inputs unchanged."""
        n = self.reference.n_state
        target, reference_state = self.reference(x, k, memory[:, :n])
        command, s = self.policy(x, target, memory[:, n:])
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), torch.cat(
            (reference_state, s), dim=-1
        )

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return which rows have reached the end of the course."""
        return self.reference.is_finished(x, k, memory[:, : self.reference.n_state])


@final
class ReferenceInInputs(Source):
    """A controller whose reference is passed in the last columns of the inputs, w [B, m + r].

    Because it does not depend on the number of the time step, it can be compiled. The c
    commands replace the first c of the m input columns.

    Args:
        policy: controller.
        inputs: number m of inputs of the vessel.
    """

    def __init__(self, policy: Policy, inputs: int) -> None:
        super().__init__()
        self.policy = policy
        self.inputs = inputs
        self.depends_on_step = False

    def initial(self, x: Tensor) -> Tensor:
        """Return the initial memory of the controller."""
        return self.policy.initial_state(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]: the command, then the other inputs unchanged."""
        command, memory = self.policy(x, w[:, self.inputs :], memory)
        return torch.cat((command, w[:, command.shape[-1] : self.inputs]), dim=-1), memory

"""The interface of controllers and guidance, and the source that puts them into a rollout."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import torch
from torch import Tensor, nn

from residnet.engine.rollout import Source


class StatefulModule(nn.Module, ABC):
    """What has a memory [B, n_state] that goes from step to step."""

    def __init__(self) -> None:
        super().__init__()
        self.n_state = 0

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory [B, n_state] at the first state x [B, nx]: zeros."""
        return torch.zeros(x.shape[0], self.n_state, dtype=x.dtype, device=x.device)


class Policy(StatefulModule):
    """A controller: commands from the state and a reference, once per step.

    The same tensor code trains, flies and is exported.
    """

    @abstractmethod
    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the command [B, c] and the new memory.

        Args:
            x: state [B, nx].
            reference: reference [B, r] of this step.
            s: memory [B, n_state].
        """

    def with_applied_rudder(self, s: Tensor, rudder: Tensor) -> Tensor:
        """Return the memory once the rudder angle [B, 1] is known that is really taken.

        A controller without an estimate of the vessel does not care.
        """
        return s


class Reference(StatefulModule):
    """Guidance: what the controller shall follow."""

    def __init__(self) -> None:
        super().__init__()
        self.may_finish = False

    @abstractmethod
    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the reference [B, r] for step k and the new memory.

        Args:
            x: state [B, nx].
            s: memory [B, n_state].
        """

    def is_finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Return [B] bool: rows that have arrived; asked only where `may_finish`."""
        return torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)


@final
class RecordedReference(Reference):
    """A reference known in advance, [B, T, r]; its last value holds beyond T."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = values

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.values[:, min(k, self.values.shape[1] - 1)].to(x.dtype), s


@final
class ClosedLoop(Source):
    """A controller under guidance as the source of a rollout's inputs.

    Its commands take the first columns of w.
    """

    def __init__(self, policy: Policy, reference: Reference) -> None:
        super().__init__()
        self.policy = policy
        self.reference = reference
        self.can_stop = reference.may_finish

    def initial(self, x: Tensor) -> Tensor:
        """Return the memories of guidance and controller side by side."""
        return torch.cat((self.reference.initial_state(x), self.policy.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]: the command, then what else was given."""
        n = self.reference.n_state
        target, reference_state = self.reference(x, k, memory[:, :n])
        command, s = self.policy(x, target, memory[:, n:])
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), torch.cat(
            (reference_state, s), dim=-1
        )

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows whose guidance has arrived."""
        return self.reference.is_finished(x, k, memory[:, : self.reference.n_state])


@final
class ReferenceInInputs(Source):
    """A controller whose reference stands behind the inputs of a rollout, w [B, m + r].

    What does not count steps can be compiled. Its commands take the first columns of the m.

    Args:
        inputs: number m of the vessel's inputs.
    """

    def __init__(self, policy: Policy, inputs: int) -> None:
        super().__init__()
        self.policy = policy
        self.inputs = inputs
        self.depends_on_step = False

    def initial(self, x: Tensor) -> Tensor:
        """Return the controller's memory."""
        return self.policy.initial_state(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]: the command, then what else was given."""
        command, memory = self.policy(x, w[:, self.inputs :], memory)
        return torch.cat((command, w[:, command.shape[-1] : self.inputs]), dim=-1), memory

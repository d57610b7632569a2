"""A pupil flies while its teacher says what it would have done."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from residnet.control.base import Policy, Reference
from residnet.dynamics.rollout import Source


@final
class SideBySide(Source):
    """The pupil's commands act; the teacher sees the same states with a memory of its own.

    The pupil meets what its own commands lead to, so that it also learns the way back from its
    mistakes. States carry no gradient: the pupil shall command as the teacher does, not come to
    where they agree.

    Attributes:
        total: sum over steps of the mean squared difference of the commands, since `initial` was
            asked.
    """

    def __init__(self, pupil: Policy, teacher: Policy, reference: Reference) -> None:
        super().__init__()
        self.pupil, self.teacher, self.reference = pupil, teacher, reference
        self.total = torch.zeros(())

    def initial(self, x: Tensor) -> Tensor:
        """Return the memories of guidance, pupil and teacher side by side."""
        self.total = torch.zeros((), dtype=x.dtype)
        return torch.cat(
            [part.initial_state(x) for part in (self.reference, self.pupil, self.teacher)], dim=-1
        )

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] with the pupil's command."""
        sizes = [self.reference.n_state, self.pupil.n_state, self.teacher.n_state]
        reference_memory, pupil_memory, teacher_memory = memory.split(sizes, dim=-1)
        target, reference_memory = self.reference(x, k, reference_memory)
        x = x.detach()
        command, pupil_memory = self.pupil(x, target, pupil_memory.detach())
        with torch.no_grad():
            example, teacher_memory = self.teacher(x, target, teacher_memory)
        self.total = self.total + (command - example).square().mean()
        return torch.cat((command.detach(), w[:, command.shape[-1] :]), dim=-1), torch.cat(
            (reference_memory, pupil_memory, teacher_memory), dim=-1
        )

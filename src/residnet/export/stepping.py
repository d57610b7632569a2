"""The guarded step as a module's forward, which torch's exporters of graphs ask for."""

from __future__ import annotations

from torch import Tensor, nn

from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.guard import GuardedDynamics


class Step(nn.Module):
    """The step of a model, memory in and out."""

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__()
        self.guarded = GuardedDynamics(model, spec)

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return state [B, 6], memory [B, n_state] and flag [B] one step later."""
        after, memory, outside = self.guarded.flagged_step(x, w, s)
        # a result that is an argument is no result of its own
        return after, memory.clone(), outside


class StepWithoutMemory(nn.Module):
    """The step of a model without a memory."""

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__()
        self.guarded = GuardedDynamics(model, spec)

    def forward(self, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Return state [B, 6] and flag [B] one step later."""
        x, _, outside = self.guarded.flagged_step(x, w, x[:, :0])
        return x, outside

"""The only time loop: batched, differentiable, scriptable, compiled where that pays.

Its inputs come from a `Source`: playback of given inputs, or a manoeuvre that steers by the state
that it sees. Rows whose source says so stop there: their state is held from that sample on.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, final

import torch
from torch import Tensor, nn
from torch.jit._fuser import optimized_execution

from residnet.dynamics.base import Dynamics


class Source(nn.Module, ABC):
    """Where the inputs of a rollout come from.

    Args:
        given: whether they are those that the rollout is given, whatever the state.

    Attributes:
        counts: whether the number of the step matters.
    """

    __constants__: ClassVar = ["given"]

    def __init__(self, *, given: bool = False) -> None:
        super().__init__()
        self.may_stop = False
        self.given, self.counts = given, not given

    def initial(self, x: Tensor) -> Tensor:
        """Return the source's memory [B, k] at the start, from the initial state x [B, nx]."""
        return x[:, :0]

    @abstractmethod
    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] for step k and the new memory.

        They follow from the state x [B, nx] and the inputs given for that step, w [B, m].
        """

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return which rows stop at this state, [B] bool; asked only where `may_stop`."""
        return torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)


@final
class Playback(Source):
    """A source that gives the inputs back as they are."""

    def __init__(self) -> None:
        super().__init__(given=True)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        return w, memory


class Rollout(nn.Module):
    """A free run of a model from an initial state under a source of inputs."""

    def __init__(self, model: Dynamics, source: Source | None = None) -> None:
        super().__init__()
        self.model = model
        self.source = Playback() if source is None else source

    def forward(self, x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Run the model freely over T steps.

        Args:
            x0: initial states [B, nx].
            w: given inputs [B, T, m], each row held over its step.
            s: initial memory [B, n_state].

        Returns:
            states [B, T+1, nx] from x0 on, inputs that acted [B, T, m], and the memory after the
            last step [B, n_state].
        """
        x = x0
        states = [x0]
        if self.source.given:
            for row in w.unbind(1):
                x, s = self.model.step(x, row, s)
                states.append(x)
            return torch.stack(states, dim=1), w, s
        memory = self.source.initial(x0)
        applied: list[Tensor] = []
        for k in range(w.shape[1]):
            acting, memory = self.source(x, w[:, k], k, memory)
            after, s = self.model.step(x, acting, s)
            if self.source.may_stop:
                finished = self.source.finished(x, k, memory)
                after = torch.where(finished.unsqueeze(-1), x, after)
                if bool(finished.all()):
                    # nothing moves any more
                    states.extend([x] * (w.shape[1] - k))
                    applied.extend([acting] * (w.shape[1] - k))
                    break
            x = after
            states.append(x)
            applied.append(acting)
        inputs = torch.stack(applied, dim=1) if w.shape[1] > 0 else w
        return torch.stack(states, dim=1), inputs, s


FreeRun = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""A free run as `Rollout` gives it, from x0 [B, nx], w [B, T, m] and s [B, n_state]."""
WORTH_COMPILING = 200
"""Steps of a rollout that take about as long as compiling it does, by TorchScript or in C: its own
steps alone count, so that numbers do not hang on what ran before. C takes .2 s once for all models
of a structure, a step in torch .15 to 1.3 ms.
"""
MANY = 1_000_000
"""Steps of a training: enough for compiling to pay."""


def runs_in_python(rollout: Rollout) -> bool:
    """Return whether a part of the model answers in Python alone, such as scikit-learn's.

    TorchScript accepts such a part, and fails only when it runs.
    """
    return any(bool(getattr(part, "refusal", "")) for part in rollout.modules())


def scripted(rollout: Rollout, steps: int) -> FreeRun:
    """Return the rollout compiled, or as it is where that does not pay or cannot be done.

    The compiled one shares parameters and buffers with the rollout's model as it is now: it must
    be made anew where the model is moved to another device or type, or changes between training
    and evaluation. Gradients are those of the rollout.

    Args:
        rollout: on its device, in its type, in training or in evaluation.
        steps: that will be run with it altogether.
    """
    if steps < WORTH_COMPILING or runs_in_python(rollout):
        return rollout
    with warnings.catch_warnings():
        # TorchScript still works in torch 2.13 but announces its end
        warnings.simplefilter("ignore")
        try:
            compiled: Any = torch.jit.script(rollout)
        except Exception:
            # a head, a source or a vessel of somebody else's that TorchScript cannot express
            return rollout

    def run(x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # torch's own optimisation records the first runs, and may round differently afterwards
        with optimized_execution(False):
            out: tuple[Tensor, Tensor, Tensor] = compiled(x0, w, s)
        return out

    return run

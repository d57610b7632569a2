"""The only time loop: batched, differentiable, its step recorded where that pays.

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
        return self.run(self.model.step, x0, w, s)

    def run(self, step: Step, x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Run freely by a step that stands in for the model's; see `forward`."""
        x = x0
        states = [x0]
        if self.source.given:
            for row in w.unbind(1):
                x, s = step(x, row, s)
                states.append(x)
            return torch.stack(states, dim=1), w, s
        memory = self.source.initial(x0)
        applied: list[Tensor] = []
        for k in range(w.shape[1]):
            acting, memory = self.source(x, w[:, k], k, memory)
            after, s = step(x, acting, s)
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


Step = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""A step of a model, from x [B, nx], w [B, m] and s [B, n_state] to the next x and s."""
FreeRun = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""A free run as `Rollout` gives it, from x0 [B, nx], w [B, T, m] and s [B, n_state]."""
WORTH_COMPILING = 200
"""Steps of a rollout that take about as long as compiling it does, or recording its step: its own
steps alone count, so that numbers do not hang on what ran before. C takes .2 s once for all models
of a structure, a step in torch .15 to 1.3 ms.
"""
MANY = 1_000_000
"""Steps of a training: enough for compiling to pay."""


def runs_in_python(rollout: Rollout) -> bool:
    """Return whether a part of the model answers in Python alone, such as scikit-learn's.

    A recording would hold its answers to the examples as constants.
    """
    return any(bool(getattr(part, "refusal", "")) for part in rollout.modules())


def trace_rollout(rollout: Rollout, steps: int) -> FreeRun:
    """Return the rollout with its model's step recorded as a TorchScript graph.

    A recorded step takes half the time of Python's. It shares parameters and buffers with the
    model as it is now: record anew where the model is moved to another device or type, or changes
    between training and evaluation. Gradients are those of the rollout.

    Args:
        rollout: on its device, in its type, in training or in evaluation.
        steps: that will be run with it altogether; the rollout is returned as it is where these are
            too few to pay for the recording.
    """
    if steps < WORTH_COMPILING or runs_in_python(rollout):
        return rollout
    known: dict[tuple[torch.Size, torch.Size], Step] = {}

    def step(x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        # a recording may hold the number of rows as a constant
        shapes = (x.shape, w.shape)
        if shapes not in known:
            known[shapes] = record_step(rollout.model, x, w, s)
        return known[shapes](x, w, s)

    def run(x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # torch's own optimisation records the first runs, and may round differently afterwards
        with optimized_execution(False):
            return rollout.run(step, x0, w, s)

    return run


def record_step(model: Dynamics, x: Tensor, w: Tensor, s: Tensor) -> Step:
    """Return the step of a model as a TorchScript graph, or as it is where it has none."""
    from residnet.engine.trace import recorded

    # the trial of a step that draws numbers (dropout) must not shift those of the training
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        # TorchScript still works in torch 2.13 but announces its end
        warnings.simplefilter("ignore")
        examples = (x.detach(), w.detach(), s.detach())
        try:
            # a trace would take the branch of the examples always
            recorded(model.step, examples, "a step")
            with torch.no_grad():
                graph: Any = torch.jit.trace_module(model, {"step": examples}, check_trace=False)
        except Exception:
            # a part of somebody else's that torch cannot record
            return model.step
    step: Step = graph.step
    return step

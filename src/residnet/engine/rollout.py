"""The time loop of all simulations: batched and differentiable.

Its inputs come from a `Source`: playback of recorded inputs, or a manoeuvre with feedback of the
state. A source can stop rows of the batch, whose state is then constant.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, final

import torch
from torch import Tensor, nn
from torch.jit._fuser import optimized_execution

from residnet.dynamics.base import Dynamics


class Source(nn.Module, ABC):
    """The source of the inputs of a rollout.

    Args:
        is_playback: whether the source returns the inputs of the rollout, independent of the state.

    Attributes:
        depends_on_step: whether the inputs depend on the number of the step.
        can_stop: whether rows can stop before the end.
    """

    def __init__(self, *, is_playback: bool = False) -> None:
        super().__init__()
        self.can_stop = False
        self.is_playback = is_playback
        self.depends_on_step = not is_playback

    def initial(self, x: Tensor) -> Tensor:
        """Return the initial memory of the source [B, k] from the initial state x [B, nx]."""
        return x[:, :0]

    @abstractmethod
    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] of step k, and the new memory [B, k].

        Args:
            x: states [B, nx].
            w: inputs of the rollout in this step [B, m].
            k: number of the step.
            memory: memory of the source [B, k].
        """

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return which rows stop at this state, [B] bool; used only if `can_stop`."""
        return torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)


@final
class Playback(Source):
    """A source that returns the inputs of the rollout."""

    def __init__(self) -> None:
        super().__init__(is_playback=True)

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
            w: inputs [B, T, m], constant over each step; the source may replace them.
            s: initial memory [B, n_state].

        Returns:
            States [B, T+1, nx] from x0 on, applied inputs [B, T, m], and the memory after the
            last step [B, n_state].
        """
        if torch.is_grad_enabled():
            return self.run_with_step(self.model.step, x0, w, s)
        # without the version counters of autograd a step takes a fifth less time
        with torch.inference_mode():
            states, inputs, memory = self.run_with_step(self.model.step, x0, w, s)
        return _to_normal(states), _to_normal(inputs), _to_normal(memory)

    def run_with_step(
        self, step: Step, x0: Tensor, w: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run freely with a replacement of the model's step; see `forward`."""
        x = x0
        states = [x0]
        if self.source.is_playback:
            for row in w.unbind(1):
                x, s = step(x, row, s)
                states.append(x)
            return torch.stack(states, dim=1), w, s
        memory = self.source.initial(x0)
        inputs: list[Tensor] = []
        for k in range(w.shape[1]):
            step_inputs, memory = self.source(x, w[:, k], k, memory)
            next_state, s = step(x, step_inputs, s)
            if self.source.can_stop:
                is_finished = self.source.is_finished(x, k, memory)
                next_state = torch.where(is_finished.unsqueeze(-1), x, next_state)
                if bool(is_finished.all()):
                    # all rows have stopped: repeat state and inputs up to the end
                    states.extend([x] * (w.shape[1] - k))
                    inputs.extend([step_inputs] * (w.shape[1] - k))
                    break
            x = next_state
            states.append(x)
            inputs.append(step_inputs)
        applied = torch.stack(inputs, dim=1) if w.shape[1] > 0 else w
        return torch.stack(states, dim=1), applied, s


def _to_normal(result: Tensor) -> Tensor:
    """Return a tensor that autograd accepts later, a copy of one made in inference mode."""
    return result.clone() if result.is_inference() else result


Step = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""A step of a model, from x [B, nx], w [B, m] and s [B, n_state] to the next x and s."""
FreeRun = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""A function with the arguments and results of `Rollout.forward`."""
MIN_STEPS_TO_COMPILE = 200
"""Number of steps from which compiling a rollout or tracing its step saves time.

The choice depends on the number of steps only, so that results do not depend on previous runs.
Compilation takes .2 s once for all models of a structure, a step in torch .15 to 1.3 ms.
"""
TRAINING_STEPS = 1_000_000
"""Nominal number of steps of a training, large enough that it is always compiled."""


def has_untraceable_part(rollout: Rollout) -> bool:
    """Return whether a part of the model runs in Python only, such as an estimator of scikit-learn.

    Such a part has an `export_error`. A trace would contain its results at the examples as
    constants.
    """
    return any(bool(getattr(part, "export_error", "")) for part in rollout.modules())


def trace_rollout(rollout: Rollout, steps: int) -> FreeRun:
    """Return the rollout with its model's step traced by TorchScript.

    A traced step takes half the time of the step in Python. It shares parameters and buffers with
    the model. Trace again after the model was moved to another device or dtype, or switched between
    training and evaluation.

    Args:
        rollout: the rollout on its device, in its type and mode.
        steps: total number of steps that it will run. If tracing takes longer than these, the
            rollout itself is returned.
    """
    if steps < MIN_STEPS_TO_COMPILE or has_untraceable_part(rollout):
        return rollout
    traced_steps: dict[tuple[torch.Size, torch.Size], Step] = {}

    def step(x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        # a trace may hold the number of rows as a constant
        shapes = (x.shape, w.shape)
        if shapes not in traced_steps:
            traced_steps[shapes] = trace_step(rollout.model, x, w, s)
        return traced_steps[shapes](x, w, s)

    def run(x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # TorchScript's optimisation changes the rounding after the first runs
        with optimized_execution(False):
            return rollout.run_with_step(step, x0, w, s)

    return run


def trace_step(model: Dynamics, x: Tensor, w: Tensor, s: Tensor) -> Step:
    """Trace the step of a model by TorchScript; return the step itself if it cannot be traced."""
    from residnet.engine.trace import record_graph

    # tracing a step with dropout must not change the random numbers of the training
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        # torch 2.13 announces the end of TorchScript, which still works
        warnings.simplefilter("ignore")
        examples = (x.detach(), w.detach(), s.detach())
        try:
            # a trace of a step that decides by values would always take the branch of the examples
            record_graph(model.step, examples, "a step")
            with torch.no_grad():
                module: Any = torch.jit.trace_module(model, {"step": examples}, check_trace=False)
        except Exception:
            # parts of other packages that torch cannot trace
            return model.step
    traced_step: Step = module.step
    return traced_step

"""One model with many sets of parameters side by side, for intervals of what it predicts."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from residnet.dynamics.base import Dynamics


@final
class SampledDynamics(Dynamics):
    """A model that runs with many samples of one parameter side by side.

    Rows [M * D] of a batch are M manoeuvres with D samples each (samples vary fastest); sample d
    runs with theta[d] in place of the parameter.

    Args:
        dynamics: the model, memoryless or not.
        name: of the parameter within `dynamics`.
        theta: its values by draw, [D, ...].
    """

    def __init__(self, dynamics: Dynamics, name: str, theta: Tensor) -> None:
        super().__init__(dynamics.dt, dynamics.integrator)
        self.dynamics = dynamics
        self.name = name
        self.theta = theta
        self.n_state = dynamics.n_state

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [M * D, nx] at a stage."""
        return self._each("rate", x, p, rho)[0]

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later."""
        after, memory = self._each("step", x, w, s)
        return after, memory

    def _each(self, method: str, *given: Tensor) -> tuple[Tensor, ...]:
        """What a method of the model returns with each draw's parameters for its own rows."""
        called, draws = _Method(self.dynamics, method), self.theta.shape[0]

        def one(theta: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
            out = torch.func.functional_call(called, {f"dynamics.{self.name}": theta}, rows)
            return out if isinstance(out, tuple) else (out,)

        split = [part.reshape(part.shape[0] // draws, draws, part.shape[-1]) for part in given]
        out: tuple[Tensor, ...] = torch.vmap(one, in_dims=(0, *(1 for _ in given)), out_dims=1)(
            self.theta, *split
        )
        return tuple(part.reshape(given[0].shape[0], part.shape[-1]) for part in out)


@final
class _Method(torch.nn.Module):
    """A method of a model as the forward of a module, as `functional_call` wants it."""

    def __init__(self, dynamics: Dynamics, method: str) -> None:
        super().__init__()
        self.dynamics = dynamics
        self.method = method

    def forward(self, *given: Tensor) -> object:
        """Return what the method returns."""
        return getattr(self.dynamics, self.method)(*given)

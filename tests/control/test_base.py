"""The closed loop against its solution by hand."""

from __future__ import annotations

import torch
from torch import Tensor

from residnet.control import ClosedLoop, GivenReference, Policy
from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout


class Integrator(Dynamics):
    """x' = x + w, first column; the second input is a disturbance."""

    def __init__(self) -> None:
        super().__init__(1.0, "euler")

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        return p.sum(-1, keepdim=True)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.integrate(x, w, s), s


class Half(Policy):
    """Half of the error, plus half of what was commanded before."""

    def __init__(self) -> None:
        super().__init__()
        self.n_state = 1

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        command = 0.5 * (reference - x) + 0.5 * s
        return command, command


def test_a_controller_flies_in_the_one_time_loop() -> None:
    reference = torch.tensor([[[1.0], [1.0], [3.0]], [[0.0], [0.0], [0.0]]], dtype=torch.float64)
    x0 = torch.tensor([[0.0], [2.0]], dtype=torch.float64)
    w = torch.zeros(2, 5, 2, dtype=torch.float64)
    w[:, :, 1] = 0.1
    states, inputs, _ = Rollout(Integrator(), ClosedLoop(Half(), GivenReference(reference)))(
        x0, w, x0[:, :0]
    )
    for row in range(2):
        x, c = float(x0[row]), 0.0
        for k in range(5):
            c = 0.5 * (float(reference[row, min(k, 2), 0]) - x) + 0.5 * c
            assert abs(float(inputs[row, k, 0]) - c) < 1e-14
            assert float(inputs[row, k, 1]) == 0.1, "a disturbance passes through"
            x += c + 0.1
            assert abs(float(states[row, k + 1, 0]) - x) < 1e-14

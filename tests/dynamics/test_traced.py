"""Compiled rollouts give the numbers and the gradients of those that are not."""

from __future__ import annotations

from typing import Any, final

import pytest
import torch
from torch import Tensor, nn

from residnet.dynamics.base import Dynamics
from residnet.engine import free_runs
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import TRAINING_STEPS, Rollout, trace_rollout
from residnet.physics.vessel import load_vessel

DT = 0.1


@final
class Pendulum(Dynamics):
    """A damped pendulum whose damping is a parameter."""

    def __init__(self) -> None:
        super().__init__(DT, "rk4")
        self.damping = nn.Parameter(torch.tensor([0.3], dtype=torch.float64))

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        return torch.stack(
            (x[:, 1], p[:, 0] - torch.sin(x[:, 0]) - (self.damping * x[:, 1:])[:, 0]), dim=-1
        )

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.integrate(x, w, s), s


@final
class Forgetful(Dynamics):
    """A pendulum whose damping drops out at random."""

    def __init__(self) -> None:
        super().__init__(DT, "euler")
        self.damping = nn.Parameter(torch.full((1, 1), 0.3, dtype=torch.float64))
        self.dropout = nn.Dropout(0.5)

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        drag = self.dropout(self.damping.expand_as(x[:, 1:])) * x[:, 1:]
        return torch.cat((x[:, 1:], p - torch.sin(x[:, :1]) - drag), dim=1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.integrate(x, w, s), s


@final
class Undecided(Dynamics):
    """A pendulum that decides in Python by its angle, which no recording holds."""

    def __init__(self) -> None:
        super().__init__(DT, "euler")

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return (x + DT * w if bool((x[:, 0] > 0.0).all()) else x - DT * w), s


def case() -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(41)
    x0 = torch.randn(3, 2, generator=random, dtype=torch.float64)
    return x0, torch.randn(3, 300, 1, generator=random, dtype=torch.float64), x0[:, :0]


def test_trace_rollout_equals_rollout_after_parameters_change() -> None:
    rollout = Rollout(Pendulum())
    run = trace_rollout(rollout, 300)
    assert run is not rollout
    damping: Any = rollout.model.damping
    before = run(*case())[0]
    for _ in range(2):
        one, other = (free(*case())[0] for free in (rollout, run))
        assert torch.equal(one, other)
        slopes = [torch.autograd.grad(x[:, -1].square().sum(), damping)[0] for x in (one, other)]
        assert torch.equal(*slopes)
        with torch.no_grad():
            damping.add_(0.2)
    assert not torch.equal(other, before)


def test_compile_rollout_shares_code_of_equal_structures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_runs, "_COMPILED", {})
    loops = [Rollout(Pendulum()) for _ in range(2)]
    with torch.no_grad():
        loops[1].model.damping.add_(0.2)  # type: ignore[operator]
        runs = [free_runs.compile_rollout(loop, 300) for loop in loops]
        for k in (0, 1, 0):
            torch.testing.assert_close(runs[k](*case())[0], loops[k](*case())[0], rtol=0, atol=1e-9)
        assert [bool(one) for one in free_runs._COMPILED.values()] == [True]
        # a number that is neither parameter nor buffer stands in the compiled text
        loops[1].model.apart = torch.ones(1)
        free_runs.compile_rollout(loops[1], 300)(*case())
    assert len(free_runs._COMPILED) == 2


def test_compile_rollout_does_not_advance_random_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first run tries to compile the step, in vain, for it draws numbers."""
    monkeypatch.setattr(free_runs, "_COMPILED", {})
    x0, w, s = case()
    found = []
    for _ in range(2):
        torch.manual_seed(3)
        found.append(free_runs.compile_rollout(Rollout(Forgetful()), 600)(x0, w[:, :40], s)[0])
    assert [*free_runs._COMPILED.values()] == [False]
    assert torch.equal(*found)


def test_trace_rollout_of_python_branches_equals_rollout() -> None:
    x0, w, s = torch.ones(1, 2), torch.ones(1, 300, 1), torch.zeros(1, 0)
    for sign in (1.0, -1.0):
        undecided = Rollout(Undecided())
        expected = undecided(sign * x0, w, s)[0]
        assert torch.equal(trace_rollout(undecided, TRAINING_STEPS)(sign * x0, w, s)[0], expected)


def test_trace_rollout_of_a_recorded_plant_equals_the_rollout() -> None:
    plant = load_vessel("wam_v_cal").build()
    x0 = plant.make_initial_state(2)
    w = torch.full((2, 300, len(plant.input_names)), 0.5, dtype=torch.float64)
    rollouts = [Rollout(RecordedPlantDynamics(plant, DT)) for _ in range(3)]
    with torch.no_grad():
        # the first two trace the plant and store the trace, with which its step has no operations
        expected, stored = (rollout(x0, w, x0[:, :0])[0] for rollout in rollouts[:2])
        found = trace_rollout(rollouts[2], TRAINING_STEPS)(x0, w, x0[:, :0])[0]
    assert torch.equal(found, expected)
    assert torch.equal(stored, expected)


def test_trace_rollout_of_few_steps_returns_the_rollout() -> None:
    short = Rollout(Pendulum())
    assert trace_rollout(short, 10) is short

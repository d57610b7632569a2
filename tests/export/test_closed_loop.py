"""A closed loop in compiled C: its flights and its gradient are those of torch."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout, Source
from residnet.export.c import loop_source
from residnet.export.c.closed_loop import CompiledLoop

DT = 0.1


class Boat(Dynamics):
    """A vessel that uses what gradients find hard: places used twice, bends, saturations."""

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        twice = x[:, [0, 1, 1]]
        bent = torch.atan2(twice[:, :1], 1.0 + twice[:, 1:2].square())
        drag = torch.where(x[:, :1] > 0.1, x[:, :1].abs().sqrt(), x[:, :1])
        return torch.cat((p - drag - bent, torch.sin(twice[:, 2:]) + x[:, :1].sign() * p), dim=1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return x + DT * self.rate(x, w[:, :1], s), 0.9 * s + w[:, 1:2]


class Helm(Source):
    """A controller with weights, whose command arrives as many steps late as each row says."""

    def __init__(self) -> None:
        super().__init__()
        self.mix = nn.Linear(3, 2)
        self.gain = nn.Parameter(torch.tensor(0.7))

    def initial(self, x: Tensor) -> Tensor:
        return torch.zeros(x.shape[0], 4, dtype=x.dtype)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        error = torch.remainder(w[:, :1] - x[:, 1:2] + torch.pi, 2 * torch.pi) - torch.pi
        both = torch.tanh(self.mix(torch.cat((error, x), dim=1)))
        command = (torch.exp(self.gain) * both.sum(1, keepdim=True)).clamp(-1.0, 1.0)
        queue = torch.cat((command, memory[:, :3]), dim=1)
        late = queue.gather(1, w[:, 1:2].to(torch.int64))
        return torch.cat((late, both[:, :1]), dim=1), torch.cat((queue[:, :3], both[:, 1:]), dim=1)


def loop() -> tuple[Rollout, tuple[Tensor, Tensor, Tensor]]:
    torch.manual_seed(2)
    rows, steps = 21, 30
    wanted, late = 2.0 * torch.randn(rows, 1), (torch.arange(rows) % 4.0)[:, None]
    w = torch.stack((wanted.expand(-1, steps), late.expand(-1, steps)), dim=2)
    return Rollout(Boat(DT, "rk4"), Helm()), (torch.randn(rows, 2), w, torch.zeros(rows, 1))


def test_flights_and_gradient_are_those_of_torch() -> None:
    rollout, given = loop()
    fast = CompiledLoop(rollout, *given)
    flown = [fast(*given), rollout(*given)[:2]]
    (states, inputs), (wanted, acted) = flown
    assert torch.allclose(states, wanted, atol=2e-5)
    assert torch.allclose(inputs, acted, atol=2e-5)
    weights = list(rollout.parameters())
    found, known = (
        torch.autograd.grad(x[:, :, 1].square().mean() + w.sum() * 0.01, weights) for x, w in flown
    )
    for one, other in zip(found, known, strict=True):
        assert torch.allclose(one, other, rtol=2e-3, atol=2e-4)


def test_the_number_of_threads_changes_nothing() -> None:
    rollout, given = loop()
    alone = CompiledLoop(rollout, *given)
    weights = list(rollout.parameters())
    one = torch.autograd.grad(alone(*given)[0].sum(), weights)
    alone.pool = ThreadPoolExecutor(4)
    assert all(map(torch.equal, one, torch.autograd.grad(alone(*given)[0].sum(), weights)))


def test_a_loop_that_is_off_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rollout, given = loop()
    wrong = loop_source.BACK.replace("AT(gx, N_X, k)[i * width + l] +=", "(void)")
    assert wrong != loop_source.BACK
    monkeypatch.setattr(loop_source, "BACK", wrong)
    with pytest.raises(ExportError, match="is off by"):
        CompiledLoop(rollout, *given)


def test_a_missing_compiler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.delenv("CC", raising=False)
    rollout, given = loop()
    with pytest.raises(ExportError, match="no C compiler"):
        CompiledLoop(rollout, *given)

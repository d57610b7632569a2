"""The neural heading autopilot: a small network around a linear law, with an observer of what pushes the bow."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from residnet.control.base import Policy
from residnet.control.turning import Turning
from residnet.core.frames import wrap

MEMORY = ("rudder", "yaw_rate", "push")


@final
class HeadingPolicy(Policy):
    """delta = kp e - kd r + phi(e, r, delta + b) - b, saturated, where b is the rudder angle that would push the bow as the disturbance does.

    The network phi is odd, so that port and starboard are alike, and vanishes at e = r = delta + b = 0: under any constant push the heading error
    goes to zero, once b is right. b comes from an observer of T r_dot + r = K (delta + b) that knows the saturated command, so nothing
    winds up. Yaw rate and time are measured by what full rudder does at the present speed (K ~ u, T ~ 1/u).

    Memory s [B, 3]: rudder angle [rad] as the steering gear follows, yaw rate [rad/s] and push b [rad] of the observer.

    Args:
        state: names of the vessel's state.
        turning: K, T and speed of the vessel about straight ahead.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        hidden: widths of the layers.
        observer: bandwidth of the observer as a multiple of 1/T.
        law: kp and kd that training starts from; None for full rudder at 3 deg of error, damped by half of T.
        dt: step of the controller in s; may be changed after training.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        turning: Turning,
        limit: float,
        dt: float,
        rate: float | None = None,
        hidden: Sequence[int] = (24, 24),
        observer: float = 8.0,
        law: tuple[float, float] | None = None,
    ) -> None:
        super().__init__()
        self.psi, self.u, self.r = state.index("psi"), state.index("u"), state.index("r")
        self.gain, self.time, self.speed = turning.gain, turning.time, turning.speed
        self.limit, self.dt, self.observer = limit, dt, observer
        self.rate = math.inf if rate is None else rate
        self.n_state = len(MEMORY)
        widths = [7, *hidden]
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(widths):
            layers += [nn.Linear(fan_in, fan_out, bias=False), nn.Tanh()]
        last = nn.Linear(widths[-1], 1, bias=False)
        nn.init.zeros_(last.weight)
        self.network = nn.Sequential(*layers, last)
        kp, kd = law or (20.0 * limit, 10.0 * limit * turning.time)
        # logarithms, since gains stay positive; the last one says from which share of the full turn on the push counts half
        self.law = nn.Parameter(torch.tensor([kp, kd, 0.2]).log())

    def initial_state(self, x: Tensor) -> Tensor:
        """Memory [B, 3]: rudder amidships, the yaw rate as it is, no push."""
        r = x[:, self.r : self.r + 1]
        return torch.cat((torch.zeros_like(r), r, torch.zeros_like(r)), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Rudder command [B, 1] in rad and memory from the state x [B, nx] and the reference heading [B, 1] in rad."""
        error = wrap(reference - x[:, self.psi : self.psi + 1])
        r = x[:, self.r : self.r + 1]
        ratio = (x[:, self.u : self.u + 1] / self.speed).clamp(0.3, 3.0)
        gain, per_time = self.gain * ratio, ratio / self.time
        rudder, expected, push = s[:, 0:1], s[:, 1:2], s[:, 2:3]
        # the observer's two poles at -w, by forward steps of dt
        w = self.observer * per_time
        expected = expected + self.dt * per_time * (gain * (rudder + push) - expected)
        surprise = r - expected
        expected = expected + self.dt * (2.0 * w - per_time) * surprise
        push = (push + self.dt * w * w / (per_time * gain) * surprise).clamp(-self.limit, self.limit)
        turn = r / (gain * self.limit)
        acting = (rudder + push) / self.limit
        seen = torch.cat(
            (
                2.0 * error,
                torch.tanh(error * 6.0),
                torch.tanh(error * 30.0),
                2.0 * turn,
                torch.tanh(6.0 * turn),
                acting,
                5.0 * (push / self.limit) * turn.abs(),
            ),
            dim=-1,
        )
        kp, kd, half = torch.exp(self.law).unbind()
        # in a fast turn a weak rudder looks like a push; only when it ends the two can be told apart
        known = push / (1.0 + (turn / half).square())
        wish = kp * error - kd * r / ratio + 3.0 * self.limit * self.network(seen)
        command = (wish - known).clamp(-self.limit, self.limit)
        step = self.rate * self.dt
        follows = rudder + (command - rudder).clamp(-step, step)
        return command, torch.cat((follows, expected, push), dim=-1)

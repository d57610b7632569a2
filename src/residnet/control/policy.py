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

MEMORY = ("rudder", "yaw_rate", "push", "strength")


@final
class HeadingPolicy(Policy):
    """delta = k2 (r_wanted(e) - r) + phi - b, saturated: a proximate time-optimal law, a network phi that corrects it, and a push b taken away.

    r_wanted is the yaw rate from which the rudder still stops the bow at the reference: a square root of the error far away, a straight line
    near it (M. L. Workman, Adaptive proximate time-optimal servomechanisms, 1987). The network is odd, so that port and starboard are alike,
    and vanishes at e = r = delta + b = 0: under any constant push the heading error goes to zero, once b is right.

    An observer of T r_dot + r = K ((1 + strength) (delta + b)) knows the saturated command, so nothing winds up. What it did not expect it
    blames on the push while the rudder does little, and on the rudder's strength while it does much. Yaw rate and time are measured by
    what full rudder does at the present speed (K ~ u, T ~ 1/u).

    Memory s [B, 4]: rudder angle [rad] as the steering gear follows, yaw rate [rad/s], push b [rad] and strength of the observer.

    Args:
        state: names of the vessel's state.
        turning: K, T and speed of the vessel about straight ahead.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        hidden: widths of the layers.
        observer: bandwidth of the observer as a multiple of 1/T.
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
    ) -> None:
        super().__init__()
        self.psi, self.u, self.r = state.index("psi"), state.index("u"), state.index("r")
        self.gain, self.time, self.speed = turning.gain, turning.time, turning.speed
        self.limit, self.dt, self.observer = limit, dt, observer
        self.rate = math.inf if rate is None else rate
        self.n_state = len(MEMORY)
        widths = [9, *hidden]
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(widths):
            layers += [nn.Linear(fan_in, fan_out, bias=False), nn.Tanh()]
        last = nn.Linear(widths[-1], 1, bias=False)
        nn.init.zeros_(last.weight)
        self.network = nn.Sequential(*layers, last)
        # errors per rad that full rudder answers, share of the rudder's braking that is counted on, damping; logarithms, since all are positive
        self.law = nn.Parameter(torch.tensor([80.0, 1.2, 1.1]).log())

    def initial_state(self, x: Tensor) -> Tensor:
        """Memory [B, 4]: rudder amidships, the yaw rate as it is, no push, nominal strength."""
        r = x[:, self.r : self.r + 1]
        return torch.cat((torch.zeros_like(r), r, torch.zeros_like(r), torch.zeros_like(r)), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Rudder command [B, 1] in rad and memory from the state x [B, nx] and the reference heading [B, 1] in rad."""
        error = wrap(reference - x[:, self.psi : self.psi + 1])
        r = x[:, self.r : self.r + 1]
        ratio = (x[:, self.u : self.u + 1] / self.speed).clamp(0.3, 3.0)
        gain, per_time = self.gain * ratio, ratio / self.time
        rudder, expected, push, strength = s[:, 0:1], s[:, 1:2], s[:, 2:3], s[:, 3:4]
        # the observer's two poles at -w, by forward steps of dt
        w = self.observer * per_time
        acting = (rudder + push) / self.limit
        full = per_time * gain * self.limit
        expected = expected + self.dt * ((1.0 + strength) * full * acting - per_time * expected)
        surprise = r - expected
        expected = expected + self.dt * (2.0 * w - per_time) * surprise
        learn = self.dt * w * w / full * surprise
        push = (push + self.limit * learn / (1.0 + (5.0 * acting).square())).clamp(-self.limit, self.limit)
        strength = (strength + learn * acting.clamp(-1.0, 1.0)).clamp(-0.6, 1.5)
        turn = r / (gain * self.limit)
        acting = (rudder + push) / self.limit
        near = torch.tanh(6.0 * error)
        seen = torch.cat(
            (
                2.0 * error,
                near,
                torch.tanh(30.0 * error),
                2.0 * turn,
                torch.tanh(6.0 * turn),
                acting,
                3.0 * strength * near,
                5.0 * strength * turn,
                strength * acting,
            ),
            dim=-1,
        )
        steep, share, damping = torch.exp(self.law).unbind()
        brake = share * (1.0 + strength) * full
        rate_gain = damping * torch.sqrt(2.0 * steep / brake)
        size = error.abs()
        line = steep * size / rate_gain
        root = torch.sqrt(2.0 * brake * torch.maximum(size, 1.0 / steep)) - 1.0 / torch.sqrt(2.0 * steep / brake)
        wanted = error.sign() * torch.where(steep * size < 1.0, line, root + (1.0 / damping - 1.0) * torch.sqrt(brake / (2.0 * steep)))
        wish = self.limit * (rate_gain * (wanted - r) + 3.0 * self.network(seen))
        command = (wish - push).clamp(-self.limit, self.limit)
        step = self.rate * self.dt
        follows = rudder + (command - rudder).clamp(-step, step)
        return command, torch.cat((follows, expected, push, strength), dim=-1)

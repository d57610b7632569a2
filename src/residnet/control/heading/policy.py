"""The neural heading autopilot: a small network around a linear law, with an observer.

The observer estimates what pushes the bow.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, final

import torch
from torch import Tensor, nn

from residnet.control.heading.keeper import HeadingKeeper
from residnet.control.heading.stopping import braking, centred
from residnet.control.heading.turning import Turning
from residnet.core.frames import wrap

MEMORY = (
    "rudder",
    "yaw_rate",
    "turning",
    "push",
    "effect",
    "damping",
    "effect_variance",
    "covariance",
    "damping_variance",
)
_PRIOR = 0.04
"""Variance of effect and damping before anything was seen: about the spread of vessels."""
_DOUBT = 0.02
"""Standard deviation, as a share of what full rudder does, of what the model leaves unexplained."""


@final
class HeadingPolicy(HeadingKeeper):
    """The law delta = k (e - g(r)) + phi - b, saturated: time-optimal law, network and observer.

    phi is a network that corrects a proximate time-optimal law, b a push that is taken away.

    g(r) is the heading in which full counter-rudder still stops the yaw rate r: the braking
    distance of T r_dot + r = K delta far away, a straight line near the reference (M. L. Workman,
    Adaptive proximate time-optimal servomechanisms, 1987). A rudder that takes time to move is
    counted as if it were already amidships, with the error and the yaw rate that will then be left.
    The network is odd, so that port and starboard are alike, and vanishes at e = r = delta + b = 0:
    under any constant push the heading error goes to zero, once b is right.

    K/T and 1/T are estimated on the way: recursive least squares on the filtered equation r_dot =
    effect K/T (delta + b) - damping r/T, with estimates that slowly return to one. The estimator
    knows the saturated command, so nothing winds up. While the rudder does little, what it cannot
    explain is the push.

    Memory s [B, 9]: rudder angle [rad] as the steering gear follows, filtered yaw rate [rad/s] and
    filtered rudder as a share of its limit, push b [rad], effect and damping, and their covariance.

    Args:
        state: names of the vessel's state.
        turning: K, T and speed of the vessel about straight ahead.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        hidden: widths of the layers.
        observer: bandwidth of the estimator as a multiple of 1/T.
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
        super().__init__(turning, limit, rate, dt)
        self.read_from(state)
        self.observer = observer
        # from amidships to the limit
        self.swing = limit / self.rate
        self.n_state = len(MEMORY)
        self.prior, self.doubt = _PRIOR, _DOUBT
        widths = [12, *hidden]
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(widths):
            layers += [nn.Linear(fan_in, fan_out, bias=False), nn.Tanh()]
        last = nn.Linear(widths[-1], 1, bias=False)
        nn.init.zeros_(last.weight)
        self.network = nn.Sequential(*layers, last)
        # errors per rad that full rudder answers, share of the rudder's braking that is counted on,
        # relative damping, and how much less braking is counted on while the rudder's effect is
        # unknown; logarithms, since all are positive as steep as the rudder's swing allows, and
        # full rudder for no less than a tenth of a degree
        steep = (
            250.0
            if rate is None
            else min(600.0, 2.0 / (self.swing**2 * turning.gain * limit / turning.time))
        )
        self.law = nn.Parameter(torch.tensor([steep, 0.98, 0.92, 0.2]).log())

    def read_from(self, state: Sequence[str]) -> None:
        """Take heading, speed and yaw rate from a state with these names.

        This serves a vessel other than the one that the policy was trained on.
        """
        self.psi, self.u, self.r = state.index("psi"), state.index("u"), state.index("r")

    def told(self, s: Tensor, rudder: Tensor) -> Tensor:
        """Return the memory once the rudder angle [B, 1] is known that is really taken."""
        return torch.cat((rudder, s[:, 1:]), dim=-1)

    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        """Return what the entries of the memory can be, [low, high] by name, with some room."""
        variance = 2.0 * self.prior
        # at a third of the speed the rudder that a turn stands for is three times as large
        share = 4.0 * turn / (self.gain * self.limit) + 2.0
        most = {
            "rudder": 1.001 * angle,
            "yaw_rate": 1.001 * turn,
            "turning": share,
            "push": 1.001 * self.limit,
            "effect": 3.0,
            "damping": 3.0,
            "effect_variance": variance,
            "covariance": variance,
            "damping_variance": variance,
        }
        positive = ("effect", "damping")
        return {name: (0.0 if name in positive else -most[name], most[name]) for name in MEMORY}

    def described(self) -> dict[str, Any]:
        """Return widths of the layers and bandwidth of the observer."""
        layers = [layer.out_features for layer in self.network if isinstance(layer, nn.Linear)]
        return {"kind": "time_optimal", "hidden": layers[:-1], "observer": self.observer}

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory [B, 9] at the start: rudder amidships, a steady yaw rate, no push.

        The vessel is taken to be as expected.
        """
        r = x[:, self.r : self.r + 1]
        gain = self.gain * self._ratio(x)
        zeros, ones = torch.zeros_like(r), torch.ones_like(r)
        return torch.cat(
            (
                zeros,
                r,
                r / (gain * self.limit),
                zeros,
                ones,
                ones,
                self.prior * ones,
                zeros,
                self.prior * ones,
            ),
            dim=-1,
        )

    def _ratio(self, x: Tensor) -> Tensor:
        """Return the speed [B, 1] as a multiple of the service speed.

        K grows with it, T falls with it.
        """
        return (x[:, self.u : self.u + 1] / self.speed).clamp(0.3, 3.0)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and the memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory [B, 9].
        """
        error = wrap(reference - x[:, self.psi : self.psi + 1])
        r = x[:, self.r : self.r + 1]
        ratio = self._ratio(x)
        per_time = ratio / self.time
        steady = self.gain * ratio * self.limit
        estimate = self._estimate(r, per_time, steady, s)
        rudder, push, effect, damping = (
            estimate[:, 0:1],
            estimate[:, 3:4],
            estimate[:, 4:5],
            estimate[:, 5:6],
        )
        acting, turn = (rudder + push) / self.limit, r / steady
        force, decay = effect * per_time * steady, damping * per_time
        steep, share, stiff, caution = torch.exp(self.law).unbind()
        counted = share * force * torch.exp(-caution * estimate[:, 6:7] / self.prior)
        ahead, turn_rate_left = centred(error, r, acting, force, decay, self.swing)
        command_share = steep * (
            ahead - braking(turn_rate_left, counted, decay, steep * force, stiff, self.swing)
        )
        near = torch.tanh(6.0 * error)
        features = torch.cat(
            (
                2.0 * error,
                near,
                torch.tanh(30.0 * error),
                2.0 * turn,
                torch.tanh(6.0 * turn),
                acting,
                torch.tanh(0.5 * command_share),
                3.0 * (effect - 1.0) * near,
                5.0 * (effect - 1.0) * turn,
                (effect - 1.0) * acting,
                3.0 * (damping - 1.0) * near,
                5.0 * (damping - 1.0) * turn,
            ),
            dim=-1,
        )
        command = (self.limit * (command_share + 3.0 * self.network(features)) - push).clamp(
            -self.limit, self.limit
        )
        step = self.rate * self.dt
        follows = rudder + (command - rudder).clamp(-step, step)
        return command, torch.cat((follows, estimate[:, 1:]), dim=-1)

    def _estimate(self, r: Tensor, per_time: Tensor, steady: Tensor, s: Tensor) -> Tensor:
        """Return the memory [B, 9] with the yaw rate r [B, 1] taken in, the rudder unchanged."""
        rudder, slow, share, push, effect, damping, p, c, q = s.split(1, dim=-1)
        pace = 2.0 * self.observer * per_time
        keep = torch.exp(-pace * self.dt)
        full = per_time * steady
        after = r + keep * (slow - r)
        # both sides of the equation of motion through the same filter; the trapezoid of r is exact
        # for its difference
        change = (after - slow) / (self.dt * full)
        turn = 0.5 * (after + slow) / steady
        share = keep * share + (1.0 - keep) * (rudder + push) / self.limit
        surprise = change - effect * share + damping * turn
        quiet = 1.0 / (1.0 + (5.0 * share).square())
        push = (push + (0.25 * self.dt) * pace * self.limit * quiet * surprise).clamp(
            -self.limit, self.limit
        )
        forget = (self.dt / 60.0) * per_time
        p, c, q = (
            p + 2.0 * forget * (self.prior - p),
            c - 2.0 * forget * c,
            q + 2.0 * forget * (self.prior - q),
        )
        a, b = p * share - c * turn, c * share - q * turn
        noise = self.doubt**2 * 2.0 / (pace * self.dt)
        scale = 1.0 / (noise + a * share - b * turn)
        effect = (effect + forget * (1.0 - effect) + (a * scale).detach() * surprise).clamp(
            0.4, 2.5
        )
        damping = (damping + forget * (1.0 - damping) + (b * scale).detach() * surprise).clamp(
            0.4, 2.5
        )
        p, c, q = p - a * a * scale, c - a * b * scale, q - b * b * scale
        return torch.cat(
            (rudder, after, share, push, effect, damping, p.detach(), c.detach(), q.detach()),
            dim=-1,
        )

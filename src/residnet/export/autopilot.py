"""A heading policy as TorchScript for a control loop, with input checks and rate limits inside.

No command is ever NaN or infinite.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from residnet.control.heading.keeper import HeadingKeeper
from residnet.core.errors import ExportError
from residnet.core.version import __version__
from residnet.export.scripting import require_shape, size, within, write_scripted

MEASURED = ("psi", "u", "r")
"""What an exported policy sees: heading [rad], speed [m/s], yaw rate [rad/s]."""
PARITY_STEPS = 1000
PARITY_TOLERANCE = 1e-4
_METHODS = ["initial_state", "step"]


class Limits(NamedTuple):
    """Ranges [low, high] in which measurements are accepted."""

    psi: tuple[float, float]
    u: tuple[float, float]
    r: tuple[float, float]


def memory_limits(policy: HeadingKeeper, turn: float, angle: float) -> list[tuple[float, float]]:
    """Return the ranges [low, high] of an exported policy's memory and last command.

    They hold what its own steps can lead to, with some room.

    Args:
        policy: see there.
        turn: fastest yaw rate [rad/s] that is accepted.
        angle: largest rudder angle [rad] that the policy is told of.
    """
    last = 1.001 * policy.limit
    return [*policy.memory_ranges(turn, angle).values(), (-last, last)]


class ExportedPolicy(nn.Module):
    """What a controller calls once per step; float32, SI and radians.

    The memory s [B, n] is that of the policy and the last command. `fault` tells that a
    measurement, the reference or the memory was no number or out of range: then the command is the
    safe one, reached at the rudder's rate. The policy's memory stays as it was; where it was wrong
    itself, or would become so, it is forgotten and begins anew. Tensors of a wrong shape are
    refused, never broadcast; other precisions are converted.
    """

    def __init__(
        self, policy: HeadingKeeper, limits: Limits, safe: Literal["hold", "amidships"]
    ) -> None:
        super().__init__()
        self.policy = policy
        self.register_buffer(
            "low", torch.tensor([limit[0] for limit in limits], dtype=torch.float32)
        )
        self.register_buffer(
            "high", torch.tensor([limit[1] for limit in limits], dtype=torch.float32)
        )
        self.low: Tensor
        self.high: Tensor
        memory_ranges = memory_limits(policy, limits.r[1], policy.limit)
        self.register_buffer(
            "memory_low", torch.tensor([limit[0] for limit in memory_ranges], dtype=torch.float32)
        )
        self.register_buffer(
            "memory_high", torch.tensor([limit[1] for limit in memory_ranges], dtype=torch.float32)
        )
        self.memory_low: Tensor
        self.memory_high: Tensor
        self.keep = 1.0 if safe == "hold" else 0.0
        # a large number where the rudder has no rate: infinity times zero would be no number
        self.travel = min(policy.rate * policy.dt, 2.0 * policy.limit)
        self.limit = policy.limit

    @torch.jit.export
    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory s [B, n] at the first measurement y [B, 3], rudder amidships."""
        require_shape("measured", y, [size(y, 2, 0), self.low.numel()])
        y = y.to(self.low.dtype)
        good = self._good(y).unsqueeze(-1)
        return torch.cat(
            (
                self.policy.initial_state(torch.where(good, y, torch.zeros_like(y))),
                torch.zeros_like(y[:, :1]),
            ),
            dim=-1,
        )

    def _good(self, y: Tensor) -> Tensor:
        return (torch.isfinite(y) & (y >= self.low) & (y <= self.high)).all(dim=-1)

    @torch.jit.export
    def step(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n] and fault [B].

        Args:
            measured: y [B, 3] = (psi, u, r).
            reference: heading [B, 1] in rad.
            s: memory [B, n].
        """
        rows = size(y, 2, 0)
        require_shape("measured", y, [rows, self.low.numel()])
        require_shape("reference", reference, [rows, 1])
        require_shape("s", s, [rows, self.memory_low.numel()])
        kind = self.low.dtype
        y, reference, s = y.to(kind), reference.to(kind), s.to(kind)
        good = (
            self._good(y)
            & torch.isfinite(reference[:, 0])
            & (reference[:, 0].abs() <= self.high[0])
        ).unsqueeze(-1)
        y = torch.where(good, y, torch.zeros_like(y))
        reference = torch.where(good, reference, torch.zeros_like(reference))
        last = torch.nan_to_num(s[:, -1:]).clamp(-self.limit, self.limit)
        # comparisons with what is no number are false
        remembers = within(s, self.memory_low, self.memory_high)
        begun = torch.cat((self.policy.initial_state(y), torch.zeros_like(last)), dim=1)
        s = torch.where(remembers, s, begun)
        good = good & remembers
        wish, memory = self.policy(y, reference, s[:, :-1])
        # a memory within its range can still lead out of it, where its entries do not belong
        # together
        sound = within(memory, self.memory_low[:-1], self.memory_high[:-1])
        s = torch.where(sound, s, begun)
        good = good & sound
        wish = torch.where(good, wish, self.keep * last)
        memory = torch.where(good, memory, s[:, :-1])
        command = last + (wish - last).clamp(-self.travel, self.travel)
        return command, torch.cat((memory, command), dim=-1), ~good[:, 0]

    def forward(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, reference, s)


def for_export(policy: HeadingKeeper, safe: Literal["hold", "amidships"]) -> ExportedPolicy:
    """Return the policy in float32 with its checks.

    It takes headings up to 1000 turns, three times its speed, five times the steady turn at full
    rudder.
    """
    policy = copy.deepcopy(policy).float().eval().requires_grad_(False)
    policy.read_from(MEASURED)
    turn = 5.0 * policy.gain * policy.limit
    return ExportedPolicy(
        policy,
        Limits((-2000.0 * math.pi, 2000.0 * math.pi), (0.0, 3.0 * policy.speed), (-turn, turn)),
        safe,
    ).eval()


def export_autopilot(
    name: str,
    policy: HeadingKeeper,
    file: Path,
    *,
    safe: Literal["hold", "amidships"],
    about: Mapping[str, Any],
    metrics: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Write a policy as TorchScript with its card, after a parity check.

    Args:
        name: of the policy.
        policy: at the step that it shall run with.
        file: where to write.
        safe: command while inputs are wrong: the last one, or rudder amidships.
        about: of the vessel and the training, for the card.
        metrics: rows of metrics.json of this policy, for the card.

    Returns:
        The card.

    Raises:
        ExportError: where the exported module does not reproduce the policy, or a wrong input
            brings a command that is no number.
    """
    module = for_export(policy, safe)
    return write_scripted(
        file,
        module,
        _METHODS,
        lambda exported: check_parity(name, module, exported),
        lambda parity: _card(name, module, safe, parity, about, metrics),
    )


def check_parity(name: str, module: ExportedPolicy, exported: Any) -> float:
    """Return the largest difference of the command from the eager module over 1,000 steps.

    It is a share of the rudder's limit; wrong inputs are among the steps.

    Raises:
        ExportError: where it exceeds 1e-4, a command is no number, or a wrong input raises no flag.
    """
    steps = torch.arange(PARITY_STEPS, dtype=module.low.dtype)
    turn = float(module.high[2]) / 5.0
    psi, r = 0.8 * torch.sin(0.01 * steps), turn * torch.cos(0.013 * steps)
    y = torch.stack((psi, torch.full_like(psi, module.policy.speed), r), dim=-1).unsqueeze(1)
    reference = (0.5 * torch.sign(torch.sin(0.004 * steps))).reshape(-1, 1, 1)
    wrong = torch.arange(PARITY_STEPS) % 97 == 50
    y[wrong, 0, 2] = torch.nan
    eager, scripted = module.initial_state(y[0]), exported.initial_state(y[0])
    worst = 0.0
    with torch.no_grad():
        for k in range(PARITY_STEPS):
            a, eager, _ = module.step(y[k], reference[k], eager)
            b, scripted, fault = exported.step(y[k], reference[k], scripted)
            difference = float((a - b).abs().max()) / module.limit
            if not math.isfinite(difference) or bool(fault[0]) != bool(wrong[k]):
                raise ExportError(
                    f"policy {name}: step {k} of the parity check gives the command"
                    f" {float(b[0, 0])} and the flag {bool(fault[0])}"
                )
            worst = max(worst, difference)
    if worst > PARITY_TOLERANCE:
        raise ExportError(
            f"policy {name}: the exported commands differ by {worst:.2g} of the rudder's limit;"
            f" allowed {PARITY_TOLERANCE:g}"
        )
    return worst


def _card(
    name: str,
    module: ExportedPolicy,
    safe: str,
    parity: float,
    about: Mapping[str, Any],
    metrics: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    return {
        "schema": "residnet.policy_card/1",
        "policy": name,
        "measured": measured_entries(MEASURED, ("rad", "m/s", "rad/s"), module.low, module.high),
        "reference": [{"name": "heading", "unit": "rad"}],
        "memory": [*module.policy.memory_ranges(1.0, 1.0), "last_command"],
        "fault": (
            "measurement, reference or memory no number or out of range: command"
            f" {'held' if safe == 'hold' else 'amidships'}, flag set"
        ),
        **policy_entries(module.policy),
        **about,
        "metrics": [dict(row) for row in metrics],
        "parity": {"steps": PARITY_STEPS, "share_of_limit": parity},
    }


def measured_entries(
    names: Sequence[str], units: Sequence[str], low: Tensor, high: Tensor
) -> list[dict[str, Any]]:
    """Return the entries of a card for what an exported controller sees: names, units, ranges."""
    return [
        {"name": n, "unit": u, "range": [a, b]}
        for n, u, a, b in zip(names, units, low.tolist(), high.tolist(), strict=True)
    ]


def policy_entries(policy: HeadingKeeper) -> dict[str, Any]:
    """Return what the cards of all exported heading policies say."""
    return {
        "command": [
            {
                "name": "cmd_delta",
                "unit": "rad",
                "limit": policy.limit,
                "rate": None if math.isinf(policy.rate) else policy.rate,
            }
        ],
        "dt": policy.dt,
        "dtype": "float32",
        **policy.described(),
        "turning": {"K": policy.gain, "T": policy.time, "speed": policy.speed},
        "frame": "NED; psi clockwise from north; delta > 0 turns to starboard",
        "versions": {"residnet": __version__, "torch": torch.__version__},
        "exported": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "safety": (
            "TorchScript is code that runs when loaded: load only files that you trust. The files"
            " under models/ hold numbers only."
        ),
    }

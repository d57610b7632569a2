"""A heading policy and the guidance of a planned course as one TorchScript module.

Measurements go in, the rudder command comes out.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from residnet.control.courses.course_plan import Course
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.heading.following import Following
from residnet.control.heading.keeper import HeadingKeeper
from residnet.core.errors import ExportError
from residnet.export.autopilot import measured_entries, memory_limits, policy_entries
from residnet.export.scripting import require_shape, size, within, write_scripted

MEASURED = ("x", "y", "psi", "u", "v", "r")
"""What the exported module sees: north and east [m], heading [rad], surge and sway velocity [m/s],
yaw rate [rad/s].
"""
PARITY_STEPS = 1000
PARITY_TOLERANCE = 1e-4
_METHODS = ["initial_state", "step"]
_FAR = 1e3
"""How many look-ahead distances outside the course's own extent a position is accepted."""


class ExportedCourse(nn.Module):
    """What a controller calls once per step; float64, SI and radians.

    Single precision does not tell places along a course of some hundred metres well enough: two
    programs that round differently would steer 1 mm apart.

    The memory s is that of the guidance (place along the course, and the drift where it is
    estimated), of the policy, and the last command. `fault` tells that a measurement or the memory
    was no number or out of range: then the command is the safe one, reached at the rudder's rate,
    and the memory stays as it was; where it was wrong itself, or would become so, it is forgotten
    and the course begins anew. `arrived` tells that the course has ended; commands go on along its
    last leg. Tensors of a wrong shape are refused, never broadcast; other precisions are converted.
    """

    def __init__(
        self, policy: HeadingKeeper, guidance: CourseGuidance, safe: Literal["hold", "amidships"]
    ) -> None:
        super().__init__()
        policy = copy.deepcopy(policy).double().eval().requires_grad_(False)
        policy.read_from(MEASURED)
        rate = None if math.isinf(policy.rate) else policy.rate
        self.follower = Following(policy, MEASURED, limit=policy.limit, dt=policy.dt, rate=rate)
        self.guidance = copy.deepcopy(guidance).double()
        self.guidance.x, self.guidance.y, self.guidance.psi, self.guidance.u, self.guidance.v = (
            range(5)
        )
        north, east = self.guidance.table[:, 0], self.guidance.table[:, 1]
        far = _FAR * guidance.lookahead
        turn, fast = 5.0 * policy.gain * policy.limit, 3.0 * policy.speed
        circles = 2000.0 * math.pi
        low = [float(north.min()) - far, float(east.min()) - far, -circles, 0.0, -fast, -turn]
        high = [float(north.max()) + far, float(east.max()) + far, circles, fast, fast, turn]
        self.register_buffer("low", torch.tensor(low, dtype=torch.float64))
        self.register_buffer("high", torch.tensor(high, dtype=torch.float64))
        self.low: Tensor
        self.high: Tensor
        # relative to the course's motion: rudder and yaw rate may differ by twice their ranges
        memory_ranges = memory_limits(policy, 2.0 * turn, 2.0 * policy.limit)
        angle = 1.001 * policy.limit
        drift = [(-1.01, 1.01)] * (guidance.n_state - 1)
        ranges = [
            (0.0, 1.001 * guidance.farthest),
            *drift,
            (-angle, angle),
            *memory_ranges,
        ]
        self.register_buffer(
            "memory_low", torch.tensor([limit[0] for limit in ranges], dtype=torch.float64)
        )
        self.register_buffer(
            "memory_high", torch.tensor([limit[1] for limit in ranges], dtype=torch.float64)
        )
        self.memory_low: Tensor
        self.memory_high: Tensor
        self.keep = 1.0 if safe == "hold" else 0.0
        self.travel, self.limit, self.dt, self.speed = (
            self.follower.travel,
            policy.limit,
            policy.dt,
            policy.speed,
        )

    @torch.jit.export
    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory [B, n] at the first measurement y [B, 6].

        It stands at the beginning of the course, rudder amidships.
        """
        require_shape("measured", y, [size(y, 2, 0), self.low.numel()])
        return self._begun(y.to(torch.float64))

    def _begun(self, y: Tensor) -> Tensor:
        y = torch.where(self._good(y).unsqueeze(-1), y, torch.zeros_like(y))
        return torch.cat(
            (
                self.guidance.initial_state(y),
                self.follower.initial_state(y),
                torch.zeros_like(y[:, :1]),
            ),
            dim=-1,
        )

    def _good(self, y: Tensor) -> Tensor:
        return (torch.isfinite(y) & (y >= self.low) & (y <= self.high)).all(dim=-1)

    @torch.jit.export
    def step(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n], fault [B] and arrived [B].

        Args:
            measured: y [B, 6], `MEASURED`.
            s: memory [B, n].
        """
        rows = size(y, 2, 0)
        require_shape("measured", y, [rows, self.low.numel()])
        require_shape("s", s, [rows, self.memory_low.numel()])
        y, s = y.to(torch.float64), s.to(torch.float64)
        good = self._good(y).unsqueeze(-1)
        y = torch.where(good, y, torch.zeros_like(y))
        last = torch.nan_to_num(s[:, -1:]).clamp(-self.limit, self.limit)
        # comparisons with what is no number are false
        remembers = within(s, self.memory_low, self.memory_high)
        begun = self._begun(y)
        s = torch.where(remembers, s, begun)
        good = good & remembers
        reference, place = self.guidance(y, 0, s[:, : self.guidance.n_state])
        wish, memory = self.follower(y, reference, s[:, self.guidance.n_state : -1])
        new = torch.cat((place, memory), dim=-1)
        # a memory within its range can still lead out of it, where its entries do not belong
        # together
        sound = within(new, self.memory_low[:-1], self.memory_high[:-1])
        s = torch.where(sound, s, begun)
        good = good & sound
        wish = torch.where(good, wish, self.keep * last)
        command = last + (wish - last).clamp(-self.travel, self.travel)
        after = torch.where(good, new, s[:, :-1])
        arrived = after[:, 0] >= self.guidance.length
        return command, torch.cat((after, command), dim=-1), ~good[:, 0], arrived

    def forward(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, s)


def export_course(
    name: str,
    policy: HeadingKeeper,
    guidance: CourseGuidance,
    course: Course,
    file: Path,
    *,
    safe: Literal["hold", "amidships"],
    about: Mapping[str, Any],
    metrics: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Write policy and guidance as TorchScript with a card, after a parity check.

    Args:
        name: of the policy.
        policy: at the step that it shall run with.
        guidance: of the course.
        course: that parity is checked along.
        file: where to write.
        safe: command while inputs are wrong: the last one, or rudder amidships.
        about: of the vessel and the course, for the card.
        metrics: rows of metrics.json of this policy, for the card.

    Returns:
        The card.

    Raises:
        ExportError: where the exported module does not reproduce the policy and the guidance, or a
            wrong input brings a command that is no number.
    """
    module = ExportedCourse(policy, guidance, safe).eval()
    return write_scripted(
        file,
        module,
        _METHODS,
        lambda exported: check_parity(name, module, exported, course),
        lambda parity: _card(name, module, policy, course, safe, parity, about, metrics),
    )


def check_parity(name: str, module: ExportedCourse, exported: Any, course: Course) -> float:
    """Return the largest difference of the command from the eager module along the course.

    It is a share of the rudder's limit; wrong inputs are among the steps.

    The vessel is put beside the course, off its heading, at varying speed, and moves on at the
    service speed.

    Raises:
        ExportError: where it exceeds 1e-4, a command is no number, or a wrong input raises no flag.
    """
    steps = torch.arange(PARITY_STEPS, dtype=torch.float64)
    at = (steps * module.dt * module.speed / course.step).long().clamp(max=len(course.track) - 1)
    track, heading = (
        torch.from_numpy(course.track)[at],
        torch.from_numpy(course.heading)[at],
    )
    aside = 0.1 * module.guidance.lookahead
    y = torch.stack(
        (
            track[:, 0] + aside * torch.sin(0.02 * steps),
            track[:, 1] + aside * torch.cos(0.017 * steps),
            heading + 0.2 * torch.sin(0.03 * steps),
            module.speed * (1.0 + 0.1 * torch.sin(0.01 * steps)),
            0.02 * module.speed * torch.cos(0.02 * steps),
            0.1 * module.high[5] * torch.sin(0.013 * steps),
        ),
        dim=-1,
    ).unsqueeze(1)
    wrong = torch.arange(PARITY_STEPS) % 97 == 50
    y[wrong, 0, 1] = torch.nan
    eager, scripted = module.initial_state(y[0]), exported.initial_state(y[0])
    worst = 0.0
    with torch.no_grad():
        for k in range(PARITY_STEPS):
            a, eager, _, _ = module.step(y[k], eager)
            b, scripted, fault, _ = exported.step(y[k], scripted)
            difference = float((a - b).abs().max()) / module.limit
            if not math.isfinite(difference) or bool(fault[0]) != bool(wrong[k]):
                raise ExportError(
                    f"course of {name}: step {k} of the parity check gives the command"
                    f" {float(b[0, 0])} and the flag {bool(fault[0])}"
                )
            worst = max(worst, difference)
    if worst > PARITY_TOLERANCE:
        raise ExportError(
            f"course of {name}: the exported commands differ by {worst:.2g} of the rudder's limit;"
            f" allowed {PARITY_TOLERANCE:g}"
        )
    return worst


def _card(
    name: str,
    module: ExportedCourse,
    policy: HeadingKeeper,
    course: Course,
    safe: str,
    parity: float,
    about: Mapping[str, Any],
    metrics: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    names = ("place", "drift_north", "drift_east")[: module.guidance.n_state]
    return {
        "schema": "residnet.course_card/1",
        "policy": name,
        "measured": measured_entries(
            MEASURED, ("m", "m", "rad", "m/s", "m/s", "rad/s"), module.low, module.high
        ),
        "start": {
            "north": float(course.track[0, 0]),
            "east": float(course.track[0, 1]),
            "heading": float(course.heading[0]),
        },
        "length": course.length,
        "lookahead": module.guidance.lookahead,
        "memory": [
            *names,
            "rudder",
            *(f"policy_{i}" for i in range(policy.n_state)),
            "last_command",
        ],
        "fault": (
            "measurement or memory no number or out of range: command"
            f" {'held' if safe == 'hold' else 'amidships'}, flag set"
        ),
        **policy_entries(policy),
        "dtype": "float64",
        **about,
        "metrics": [dict(row) for row in metrics],
        "parity": {"steps": PARITY_STEPS, "share_of_limit": parity},
    }

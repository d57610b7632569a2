"""Heading policies as they are exported, alone and with the guidance of a planned course.

Measurements go in, the rudder command comes out. Input checks and rate limits are inside, and no
command is ever NaN or infinite.
"""

from __future__ import annotations

import copy
import math
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Literal, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.control.courses.course_plan import Course
from residnet.control.guidance import CourseGuidance, TrackKeeping
from residnet.control.heading.policies import DEEP, HeadingPolicy
from residnet.core.errors import ExportError
from residnet.core.version import __version__
from residnet.dynamics.steering_variation import DEPTH, HEADING
from residnet.export.base import Exported, Loaded, RoundingError
from residnet.export.torchscript import require_shape, size, trace_function

Safe = Literal["hold", "amidships"]
"""Command while inputs are wrong: the last one, or rudder amidships."""
COURSE = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
"""What a policy along a course sees: north and east, heading, surge and sway velocity, yaw rate."""
PARITY_STEPS, PARITY_TOLERANCE = 1000, 1e-4
"""Steps over which exported commands must agree, and to which share of the rudder's limit.

Of a limit of 35 deg it is 0.0035 deg, which no actuator follows, and float32 rounds less.
"""
_FRAMES = {
    HEADING: "NED; psi clockwise from north; delta > 0 turns to starboard",
    DEPTH: "NED; z down, theta and q bow up; delta_s > 0 dives",
}
_TURNS = 2000.0 * math.pi
"""Largest heading in rad."""
_FAR = 1e3
"""How many look-ahead distances outside the course's own extent a position is accepted."""


class _Controller(nn.Module):
    """The checks that all exported policies share.

    The memory s [B, n] ends with the last command. Where a measurement or the memory is no number
    or out of range, the command is the safe one, reached at the rudder's rate, and the memory stays
    as it was; where it was wrong itself, or would become so, it is forgotten and begins anew.

    Args:
        limits: [low, high] in which each measurement is accepted.
        memory: [low, high] of the memory without the last command.
        safe: command while inputs are wrong.
        dtype: of all numbers.
    """

    def __init__(
        self,
        limits: Sequence[tuple[float, float]],
        memory: Sequence[tuple[float, float]],
        policy: HeadingPolicy,
        safe: Safe,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        last = 1.001 * policy.limit
        kept = [*memory, (-last, last)]
        self.low, self.high, self.memory_low, self.memory_high = (
            nn.Buffer(end.clone())
            for ranges in (limits, kept)
            for end in torch.tensor(ranges, dtype=dtype).T
        )
        self.keep = 1.0 if safe == "hold" else 0.0
        # a large number where the rudder has no rate: infinity times zero would be no number
        self.travel = min(policy.rate * policy.dt, 2.0 * policy.limit)
        self.limit, self.dt, self.speed = policy.limit, policy.dt, policy.speed

    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory s [B, n] at the first measurement y [B, k], rudder amidships."""
        y = y.to(self.low.dtype)
        return self.begun(torch.where(self.good(y), y, torch.zeros_like(y)))

    def begun(self, y: Tensor) -> Tensor:
        """Return the memory [B, n] at an accepted measurement [B, k]."""
        raise NotImplementedError

    def good(self, y: Tensor) -> Tensor:
        """Return which measurements are in range, [B, 1]; what is no number is not."""
        return ((y >= self.low) & (y <= self.high)).all(dim=-1, keepdim=True)

    def last(self, s: Tensor) -> Tensor:
        """Return the last command [B, 1] of a memory."""
        return torch.nan_to_num(s[:, -1:]).clamp(-self.limit, self.limit)

    def remembers(self, s: Tensor) -> Tensor:
        """Return which memories [B, n] are in range, [B, 1]."""
        return ((s >= self.memory_low) & (s <= self.memory_high)).all(dim=-1, keepdim=True)

    def settled(
        self, wish: Tensor, new: Tensor, s: Tensor, begun: Tensor, last: Tensor, good: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return command [B, 1], memory [B, n] and fault [B] from what the policy wishes."""
        # a memory within its range can still lead out of it, where its entries do not belong
        # together
        inside = (new >= self.memory_low[:-1]) & (new <= self.memory_high[:-1])
        sound = inside.all(dim=-1, keepdim=True)
        s = torch.where(sound, s, begun)
        good = good & sound
        wish = torch.where(good, wish, self.keep * last)
        command = last + (wish - last).clamp(-self.travel, self.travel)
        after = torch.where(good, new, s[:, :-1])
        return command, torch.cat((after, command), dim=-1), ~good[:, 0]


class ExportedPolicy(_Controller):
    """A heading policy that a controller calls once per step; SI and radians.

    Other precisions are converted.
    """

    def __init__(
        self,
        policy: HeadingPolicy,
        limits: Sequence[tuple[float, float]],
        safe: Safe,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        memory = policy.memory_ranges(limits[-1][1], policy.limit).values()
        super().__init__(limits, list(memory), policy, safe, dtype)
        self.policy = policy

    def begun(self, y: Tensor) -> Tensor:
        return torch.cat((self.policy.initial_state(y), torch.zeros_like(y[:, :1])), dim=-1)

    def step(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n] and fault [B].

        Args:
            measured: y [B, 3] = (psi, u, r), or [B, 4] = (z, u, theta, q) of a depth policy.
            reference: heading [B, 1] in rad, or depth in m.
            s: memory [B, n].
        """
        kind = self.low.dtype
        return self.answer(y.to(kind), reference.to(kind), s.to(kind))

    def answer(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns, of tensors of the right shape and type."""
        good = self.good(y) & (reference.abs() <= self.high[0])
        y = torch.where(good, y, torch.zeros_like(y))
        reference = torch.where(good, reference, torch.zeros_like(reference))
        last, remembers, begun = self.last(s), self.remembers(s), self.begun(y)
        s = torch.where(remembers, s, begun)
        wish, new = self.policy(y, reference, s[:, :-1])
        return self.settled(wish, new, s, begun, last, good & remembers)

    def forward(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, reference, s)


class ExportedCourse(_Controller):
    """A heading policy with the guidance of a course, in float64; SI and radians.

    Single precision does not tell places along a course of some hundred metres well enough: two
    programs that round differently would steer 1 mm apart.

    The memory s is that of the guidance (place along the course, and the drift where it is
    estimated), of the policy, and the last command; where it is wrong the course begins anew.
    `arrived` tells that the course has ended; commands go on along its last leg. Other precisions
    are converted.
    """

    def __init__(self, policy: HeadingPolicy, guidance: CourseGuidance, safe: Safe) -> None:
        policy = copy.deepcopy(policy).double().eval().requires_grad_(False)
        policy.read_from(tuple(COURSE))
        guidance = copy.deepcopy(guidance).double()
        guidance.x, guidance.y, guidance.psi, guidance.u, guidance.v = range(5)
        far = _FAR * guidance.lookahead
        turn, fast = 5.0 * policy.gain * policy.limit, 3.0 * policy.speed
        places = [
            (float(column.min()) - far, float(column.max()) + far)
            for column in guidance.table[:, :2].T
        ]
        limits = [*places, (-_TURNS, _TURNS), (0.0, fast), (-fast, fast), (-turn, turn)]
        angle = 1.001 * policy.limit
        memory = [
            (0.0, 1.001 * guidance.farthest),
            *[(-1.01, 1.01)] * (guidance.n_state - 1),
            (-angle, angle),
            # relative to the course's motion: rudder and yaw rate may differ by twice their ranges
            *policy.memory_ranges(2.0 * turn, 2.0 * policy.limit).values(),
        ]
        super().__init__(limits, memory, policy, safe, torch.float64)
        rate = None if math.isinf(policy.rate) else policy.rate
        self.follower = TrackKeeping(
            policy, tuple(COURSE), limit=policy.limit, dt=policy.dt, rate=rate
        )
        self.travel = self.follower.travel
        self.guidance = guidance

    def begun(self, y: Tensor) -> Tensor:
        parts = (self.guidance.initial_state(y), self.follower.initial_state(y))
        return torch.cat((*parts, torch.zeros_like(y[:, :1])), dim=-1)

    def step(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n], fault [B] and arrived [B].

        Args:
            measured: y [B, 6], the names of `COURSE`.
            s: memory [B, n].
        """
        return self.answer(y.to(torch.float64), s.to(torch.float64))

    def answer(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what `step` returns, of tensors of the right shape and type."""
        good = self.good(y)
        y = torch.where(good, y, torch.zeros_like(y))
        last, remembers, begun = self.last(s), self.remembers(s), self.begun(y)
        s = torch.where(remembers, s, begun)
        reference, place = self.guidance(y, 0, s[:, : self.guidance.n_state])
        wish, memory = self.follower(y, reference, s[:, self.guidance.n_state : -1])
        new = torch.cat((place, memory), dim=-1)
        command, s, fault = self.settled(wish, new, s, begun, last, good & remembers)
        return command, s, fault, s[:, 0] >= self.guidance.length

    def forward(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, s)


class _TracedController(nn.Module):
    """The part that the TorchScript files of all policies share.

    Tensors of a wrong shape are refused, never broadcast. TorchScript compiles this class and its
    subclasses. The policy's own code is only traced, so that it may be written in any Python.
    """

    def __init__(self, inner: ExportedPolicy | ExportedCourse, sizes: Sequence[int]) -> None:
        super().__init__()
        self.measured, self.memory = inner.low.numel(), inner.memory_low.numel()
        # its type is that of all numbers
        self.low = nn.Buffer(inner.low)
        # two rows: a batch of one would hide where the rows of a batch are confused
        examples = tuple(torch.zeros(2, size, dtype=inner.low.dtype) for size in sizes)
        self.first_memory = trace_function(inner.initial_state, examples[:1], "policy")
        self.answer = trace_function(inner.answer, examples, "policy")

    @torch.jit.export
    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory s [B, n] at the first measurement y [B, k], rudder amidships."""
        require_shape("measured", y, [size(y, 2, 0), self.measured])
        s: Tensor = self.first_memory(y.to(self.low.dtype))
        return s


@final
class TracedPolicy(_TracedController):
    """The TorchScript file of a heading policy; see `ExportedPolicy`."""

    @torch.jit.export
    def step(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n] and fault [B]."""
        rows = size(y, 2, 0)
        require_shape("measured", y, [rows, self.measured])
        require_shape("reference", reference, [rows, 1])
        require_shape("s", s, [rows, self.memory])
        dtype = self.low.dtype
        y, reference, s = y.to(dtype), reference.to(dtype), s.to(dtype)
        answer: tuple[Tensor, Tensor, Tensor] = self.answer(y, reference, s)
        return answer

    def forward(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, reference, s)


@final
class TracedCourse(_TracedController):
    """The TorchScript file of a policy along a course; see `ExportedCourse`."""

    @torch.jit.export
    def step(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n], fault [B] and arrived [B]."""
        rows = size(y, 2, 0)
        require_shape("measured", y, [rows, self.measured])
        require_shape("s", s, [rows, self.memory])
        y, s = y.to(self.low.dtype), s.to(self.low.dtype)
        answer: tuple[Tensor, Tensor, Tensor, Tensor] = self.answer(y, s)
        return answer

    def forward(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, s)


class _Answer(nn.Module):
    """The step of a controller without checks of shapes, for formats that hold one function."""

    def __init__(self, inner: ExportedPolicy | ExportedCourse) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        found: tuple[Tensor, ...] = self.inner.answer(*given)
        return found


def for_export(
    policy: HeadingPolicy, safe: Safe, dtype: torch.dtype = torch.float32
) -> ExportedPolicy:
    """Return the policy with its checks.

    It takes headings up to 1000 turns, three times its speed, five times the steady turn at full
    rudder; a depth policy depths of all seas, and pitches up to a right angle.
    """
    policy = copy.deepcopy(policy).to(dtype).eval().requires_grad_(False)
    policy.read_from(tuple(policy.measured))
    turn = 5.0 * policy.gain * policy.limit
    most = {"psi": _TURNS, "r": turn, "q": turn, "theta": 0.5 * math.pi, "z": DEEP}
    limits = [
        (0.0, 3.0 * policy.speed) if name == "u" else (-most[name], most[name])
        for name in policy.measured
    ]
    return ExportedPolicy(policy, limits, safe, dtype).eval()


class ExportedController(Exported):
    """A policy that is exported: what heading policies and policies along a course share.

    Args:
        policy: at the step that it shall run with.
        safe: command while inputs are wrong.
        about: of the vessel, the training or the course, for the card.
        metrics: rows of metrics.json of this policy, for the card.
    """

    schema: str
    kind: str
    methods = ("initial_state", "step")

    def __init__(
        self,
        name: str,
        policy: HeadingPolicy,
        *,
        safe: Safe,
        about: Mapping[str, Any],
        metrics: Sequence[Mapping[str, Any]],
    ) -> None:
        self.name, self.policy, self.safe = name, policy, safe
        self.what = name if name == self.kind else f"{self.kind} {name}"
        self.about, self.metrics, self.dt = about, metrics, policy.dt
        self.axis = policy.axis
        memory = self.controller(self.precisions[-1]).memory_low.numel()
        self.arguments = (("y", len(self.measured)), *self._given(), ("s", memory))

    def _given(self) -> Sequence[tuple[str, int]]:
        return ()

    @property
    def measured(self) -> Mapping[str, str]:
        """What is measured, with units."""
        return self.policy.measured

    @abstractmethod
    def controller(self, dtype: torch.dtype) -> ExportedPolicy | ExportedCourse:
        """Return the policy with its checks, in a precision."""

    @abstractmethod
    def drive(self, module: Any) -> Sequence[Tensor]:
        """Return the arguments [steps, n] of the parity check, without the memory."""

    @abstractmethod
    def described(self, module: Any) -> dict[str, Any]:
        """Return what the card says of this kind of policy."""

    def module(self, dtype: torch.dtype) -> nn.Module:
        inner, sizes = self.controller(dtype), [count for _, count in self.arguments]
        traced = TracedCourse if isinstance(inner, ExportedCourse) else TracedPolicy
        return traced(inner, sizes).eval()

    def graph(self, dtype: torch.dtype) -> nn.Module:
        return _Answer(self.controller(dtype)).eval()

    def contents(self) -> dict[str, Any]:
        module, policy = self.controller(self.precisions[0]), self.policy
        ranges = zip(module.low.tolist(), module.high.tolist(), strict=True)
        held = "held" if self.safe == "hold" else "amidships"
        reference = ", reference" if self._given() else ""
        return {
            "schema": self.schema,
            "policy": self.name,
            "measured": [
                {"name": name, "unit": unit, "range": list(limits)}
                for (name, unit), limits in zip(self.measured.items(), ranges, strict=True)
            ],
            **self.described(module),
            "fault": (
                f"measurement{reference} or memory no number or out of range: command {held}, flag"
                " set"
            ),
            "command": [
                {
                    "name": self.axis.command,
                    "unit": "rad",
                    "limit": policy.limit,
                    "rate": None if math.isinf(policy.rate) else policy.rate,
                }
            ],
            "dt": policy.dt,
            **policy.described(),
            "turning": {"K": policy.gain, "T": policy.time, "speed": policy.speed},
            "frame": _FRAMES[self.axis],
            "versions": {"residnet": __version__, "torch": torch.__version__},
            "exported": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            **self.about,
            "metrics": [dict(row) for row in self.metrics],
        }

    def check(
        self, loaded: Loaded, what: str, dtype: torch.dtype, tolerance: float | None = None
    ) -> dict[str, Any]:
        """Return the largest difference of the command from the eager policy over 1,000 steps.

        It is a share of the rudder's limit; wrong inputs are among the steps.

        Raises:
            RoundingError: where it exceeds 1e-4.
            ExportError: where a command is no number, or a wrong input raises no flag.
        """
        module: Any = self.controller(dtype)
        driven = [part.to(dtype) for part in self.drive(module)]
        wrong = torch.arange(PARITY_STEPS) % 97 == 50
        # the yaw rate of a heading policy, the place of a course, the speed of a depth policy
        driven[0][wrong, 2 if len(self.measured) == 3 else 1] = torch.nan
        rows = [part.numpy() for part in driven]
        eager = module.initial_state(driven[0][:1])
        s = loaded.memory(rows[0][0])
        if s is None:
            eager = torch.full_like(eager, torch.nan)
            s, wrong[0] = eager[0].numpy(), True
        worst = 0.0
        for k in range(PARITY_STEPS):
            with torch.no_grad():
                wanted, eager, *_ = module.step(*(part[k : k + 1] for part in driven), eager)
            command, s, fault, *_ = loaded.step(*(part[k] for part in rows), s)
            difference = float(np.abs(command - wanted[0].numpy()).max()) / module.limit
            if not math.isfinite(difference) or bool(fault) != bool(wrong[k]):
                raise ExportError(
                    f"{self.what}: step {k} of the parity check gives the command"
                    f" {float(command[0])} and the flag {bool(fault)}"
                )
            worst = max(worst, difference)
        if worst > PARITY_TOLERANCE:
            raise RoundingError(
                f"{self.what}: the exported commands differ by {worst:.2g} of the rudder's limit;"
                f" allowed {PARITY_TOLERANCE:g}"
            )
        return {"steps": PARITY_STEPS, "share_of_limit": worst}


@final
class ExportedHeading(ExportedController):
    """A heading policy; some laws with a rudder rate ask for double precision in C."""

    schema = "residnet.policy_card/1"
    kind = "policy"
    results = ("command", "s_after", "fault")
    flags = ("fault",)

    def _given(self) -> Sequence[tuple[str, int]]:
        return (("reference", 1),)

    def controller(self, dtype: torch.dtype) -> ExportedPolicy:
        return for_export(self.policy, self.safe, dtype)

    def drive(self, module: Any) -> Sequence[Tensor]:
        """Return measurements and references of a swinging vessel.

        The depths of one that dives go by what a heading goes in rad, in m.
        """
        steps = torch.arange(PARITY_STEPS, dtype=module.low.dtype)
        turn = float(module.high[-1]) / 5.0
        psi, r = 0.8 * torch.sin(0.01 * steps), turn * torch.cos(0.013 * steps)
        parts = [psi, torch.full_like(psi, module.speed), r]
        if self.axis is DEPTH:
            parts.insert(2, 0.3 * torch.sin(0.013 * steps))
        y = torch.stack(parts, dim=-1)
        return y, 0.5 * torch.sign(torch.sin(0.004 * steps)).unsqueeze(-1)

    def described(self, module: Any) -> dict[str, Any]:
        return {
            "reference": [{"name": self.axis.name, "unit": self.measured[self.axis.value]}],
            "memory": [*module.policy.memory_ranges(1.0, 1.0), "last_command"],
        }


@final
class ExportedCoursePolicy(ExportedController):
    """A heading policy with the guidance of a planned course."""

    schema = "residnet.course_card/1"
    kind = "course of"
    results = ("command", "s_after", "fault", "arrived")
    flags = ("fault", "arrived")
    precisions = (torch.float64,)

    def __init__(
        self,
        name: str,
        policy: HeadingPolicy,
        guidance: CourseGuidance,
        course: Course,
        *,
        safe: Safe,
        about: Mapping[str, Any],
        metrics: Sequence[Mapping[str, Any]],
    ) -> None:
        self.guidance, self.course = guidance, course
        super().__init__(name, policy, safe=safe, about=about, metrics=metrics)

    @property
    def measured(self) -> Mapping[str, str]:
        return COURSE

    def controller(self, dtype: torch.dtype) -> ExportedCourse:
        return ExportedCourse(self.policy, self.guidance, self.safe).eval()

    def drive(self, module: Any) -> Sequence[Tensor]:
        """Return measurements of a vessel beside the course, off its heading, at varying speed."""
        steps, course = torch.arange(PARITY_STEPS, dtype=torch.float64), self.course
        at = (steps * module.dt * module.speed / course.step).long()
        at = at.clamp(max=len(course.track) - 1)
        track, heading = torch.from_numpy(course.track)[at], torch.from_numpy(course.heading)[at]
        aside = 0.1 * module.guidance.lookahead
        y = (
            track[:, 0] + aside * torch.sin(0.02 * steps),
            track[:, 1] + aside * torch.cos(0.017 * steps),
            heading + 0.2 * torch.sin(0.03 * steps),
            module.speed * (1.0 + 0.1 * torch.sin(0.01 * steps)),
            0.02 * module.speed * torch.cos(0.02 * steps),
            0.1 * module.high[5] * torch.sin(0.013 * steps),
        )
        return (torch.stack(y, dim=-1),)

    def described(self, module: Any) -> dict[str, Any]:
        course, count = self.course, module.guidance.n_state
        names = ("place", "drift_north", "drift_east")[:count]
        (north, east), heading = course.track[0].tolist(), float(course.heading[0])
        return {
            "start": {"north": north, "east": east, "heading": heading},
            "length": course.length,
            "lookahead": module.guidance.lookahead,
            "memory": [
                *names,
                "rudder",
                *(f"policy_{i}" for i in range(self.policy.n_state)),
                "last_command",
            ],
        }

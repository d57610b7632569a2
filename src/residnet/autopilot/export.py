"""Export of steering policies, alone or together with the guidance of a planned course.

An exported policy maps measurements to the rudder command. It contains checks of its inputs and
rate limits; its command is always finite.
"""

from __future__ import annotations

import copy
import math
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Generic, Literal, TypedDict, TypeVar, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.autopilot.courses.course_plan import Course
from residnet.autopilot.guidance import CourseGuidance, TrackKeeping
from residnet.autopilot.heading.policies import MAX_DEPTH, SteeringPolicy
from residnet.autopilot.heading.steering_variation import DEPTH, HEADING
from residnet.autopilot.records import (
    AnyCourseRow,
    CardSchema,
    CommandLimits,
    ControllerCard,
    CourseStart,
    HeadingRow,
    MeasuredQuantity,
    ReferenceQuantity,
    SteeringParameters,
)
from residnet.core.errors import ExportError
from residnet.core.version import __version__
from residnet.export.base import Exportable, LoadedExport, RoundingError
from residnet.export.torchscript import get_size, require_shape, trace_function

FallbackCommand = Literal["hold", "amidships"]
"""Fallback command for invalid inputs: hold the last command, or rudder amidships."""
COURSE_MEASUREMENTS = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
"""Measurements of a course policy: north, east, heading, surge and sway velocity, yaw rate."""
PARITY_STEPS = 1000
"""Number of steps over which an exported controller is compared with the original."""
PARITY_TOLERANCE = 1e-4
"""Largest difference between exported and original commands as a fraction of the rudder limit.

For a limit of 35 deg it is 0.0035 deg, below the resolution of actuators and above the rounding of
float32. It is checked over `PARITY_STEPS` steps.
"""
_FRAME_OF_AXIS = {
    HEADING: "NED; psi clockwise from north; delta > 0 turns to starboard",
    DEPTH: "NED; z down, theta and q bow up; delta_s > 0 dives",
}
_MAX_HEADING = 2000.0 * math.pi
"""Largest accepted heading in rad (1000 turns)."""
_POSITION_MARGIN = 1e3
"""Accepted distance outside the extent of the course in look-ahead distances."""


class _GuardedController(nn.Module):
    """Input checks and fallback that all exported policies have in common.

    The memory s [B, n] ends with the last command. If a measurement or the memory is NaN or out of
    range, the command moves to the fallback at the rudder rate and the memory is not updated. A
    memory that is invalid, or would become invalid, is initialised again.

    Args:
        limits: accepted range (low, high) of each measurement.
        memory_limits: accepted range (low, high) of each memory entry but the last command.
        policy: steering policy.
        fallback: command for invalid inputs.
        dtype: precision.
    """

    def __init__(
        self,
        limits: Sequence[tuple[float, float]],
        memory_limits: Sequence[tuple[float, float]],
        policy: SteeringPolicy,
        fallback: FallbackCommand,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        command_limit = 1.001 * policy.limit
        all_memory_limits = [*memory_limits, (-command_limit, command_limit)]
        self.low, self.high, self.memory_low, self.memory_high = (
            nn.Buffer(bound.clone())
            for ranges in (limits, all_memory_limits)
            for bound in torch.tensor(ranges, dtype=dtype).T
        )
        self.hold_factor = 1.0 if fallback == "hold" else 0.0
        # finite without a rate limit, because infinity times zero is not a number
        self.max_step = min(policy.rate * policy.dt, 2.0 * policy.limit)
        self.limit = policy.limit
        self.dt = policy.dt
        self.speed = policy.speed

    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory s [B, n] at the first measurement y [B, k], rudder amidships."""
        y = y.to(self.low.dtype)
        return self.start_memory(torch.where(self.is_in_range(y), y, torch.zeros_like(y)))

    def start_memory(self, y: Tensor) -> Tensor:
        """Return the initial memory [B, n] for a valid measurement [B, k]."""
        raise NotImplementedError

    def is_in_range(self, measured: Tensor) -> Tensor:
        """Return which measurements are in range, [B, 1]; NaN is not."""
        return ((measured >= self.low) & (measured <= self.high)).all(dim=-1, keepdim=True)

    def last_command(self, s: Tensor) -> Tensor:
        """Return the last command [B, 1] of a memory."""
        return torch.nan_to_num(s[:, -1:]).clamp(-self.limit, self.limit)

    def is_valid_memory(self, s: Tensor) -> Tensor:
        """Return which memories [B, n] are in range, [B, 1]."""
        return ((s >= self.memory_low) & (s <= self.memory_high)).all(dim=-1, keepdim=True)

    def finish_step(
        self,
        wanted_command: Tensor,
        next_memory: Tensor,
        s: Tensor,
        fresh_memory: Tensor,
        last_command: Tensor,
        is_valid: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Apply rate limit and fallback to a command, and update the memory of valid steps.

        Args:
            wanted_command: command of the policy [B, 1].
            next_memory: memory of the policy after the step [B, n - 1].
            s: memory before the step [B, n], whose last column is the last command.
            fresh_memory: initial memory [B, n] for steps with an invalid memory.
            last_command: last command [B, 1].
            is_valid: whether measurements and memory are valid [B, 1] bool.

        Returns:
            Command [B, 1], memory [B, n] and fault [B] bool.
        """
        # an inconsistent memory within its ranges can still lead to a memory outside of them
        is_inside = (next_memory >= self.memory_low[:-1]) & (next_memory <= self.memory_high[:-1])
        is_sound = is_inside.all(dim=-1, keepdim=True)
        s = torch.where(is_sound, s, fresh_memory)
        is_valid = is_valid & is_sound
        wanted_command = torch.where(is_valid, wanted_command, self.hold_factor * last_command)
        command = last_command + (wanted_command - last_command).clamp(
            -self.max_step, self.max_step
        )
        # a memory is updated with valid measurements only, so that a fault leaves no trace in it
        kept_memory = torch.where(is_valid, next_memory, s[:, :-1])
        return command, torch.cat((kept_memory, command), dim=-1), ~is_valid[:, 0]


class GuardedPolicy(_GuardedController):
    """A steering policy with input checks, called once per time step; SI and radians.

    Inputs in another precision are converted.
    """

    def __init__(
        self,
        policy: SteeringPolicy,
        limits: Sequence[tuple[float, float]],
        fallback: FallbackCommand,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        memory_limits = policy.memory_ranges(limits[-1][1], policy.limit).values()
        super().__init__(limits, list(memory_limits), policy, fallback, dtype)
        self.policy = policy

    def start_memory(self, y: Tensor) -> Tensor:
        return torch.cat((self.policy.initial_state(y), torch.zeros_like(y[:, :1])), dim=-1)

    def step(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n] and fault [B].

        Args:
            y: measurement [B, 3] = (psi, u, r), or [B, 4] = (z, u, theta, q) of a depth policy.
            reference: desired heading [B, 1] in rad, or desired depth in m.
            s: memory [B, n].
        """
        dtype = self.low.dtype
        return self.step_unchecked(y.to(dtype), reference.to(dtype), s.to(dtype))

    def step_unchecked(
        self, y: Tensor, reference: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate `step` for tensors of the required shape and precision."""
        is_valid = self.is_in_range(y) & (reference.abs() <= self.high[0])
        y = torch.where(is_valid, y, torch.zeros_like(y))
        reference = torch.where(is_valid, reference, torch.zeros_like(reference))
        last_command = self.last_command(s)
        has_valid_memory = self.is_valid_memory(s)
        fresh_memory = self.start_memory(y)
        s = torch.where(has_valid_memory, s, fresh_memory)
        wanted_command, next_memory = self.policy(y, reference, s[:, :-1])
        return self.finish_step(
            wanted_command, next_memory, s, fresh_memory, last_command, is_valid & has_valid_memory
        )

    def forward(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, reference, s)


class GuardedCoursePolicy(_GuardedController):
    """A heading policy with the guidance of a course and input checks, in float64; SI and radians.

    Single precision resolves positions on a course of some hundred metres too coarsely: programs
    with different rounding would deviate by 1 mm.

    The memory s contains the guidance (path variable and, if estimated, the drift), the policy and
    the last command. After an invalid memory the course starts again. `arrived` is set at the end
    of the course; the commands then follow its last leg. Inputs in another precision are converted.
    """

    def __init__(
        self, policy: SteeringPolicy, guidance: CourseGuidance, fallback: FallbackCommand
    ) -> None:
        policy = copy.deepcopy(policy).double().eval().requires_grad_(False)
        policy.set_state_columns(tuple(COURSE_MEASUREMENTS))
        guidance = copy.deepcopy(guidance).double()
        guidance.x, guidance.y, guidance.psi, guidance.u, guidance.v = range(5)
        position_margin = _POSITION_MARGIN * guidance.lookahead
        max_yaw_rate = 5.0 * policy.gain * policy.limit
        max_speed = 3.0 * policy.speed
        position_limits = [
            (float(positions.min()) - position_margin, float(positions.max()) + position_margin)
            for positions in guidance.table[:, :2].T
        ]
        limits = [
            *position_limits,
            (-_MAX_HEADING, _MAX_HEADING),
            (0.0, max_speed),
            (-max_speed, max_speed),
            (-max_yaw_rate, max_yaw_rate),
        ]
        rudder_limit = 1.001 * policy.limit
        memory_limits = [
            (0.0, 1.001 * guidance.max_arc_length),
            *[(-1.01, 1.01)] * (guidance.n_state - 1),
            (-rudder_limit, rudder_limit),
            # relative to the motion of the course, rudder and yaw rate have twice their ranges
            *policy.memory_ranges(2.0 * max_yaw_rate, 2.0 * policy.limit).values(),
        ]
        super().__init__(limits, memory_limits, policy, fallback, torch.float64)
        rate_limit = None if math.isinf(policy.rate) else policy.rate
        self.track_keeping = TrackKeeping(
            policy, tuple(COURSE_MEASUREMENTS), limit=policy.limit, dt=policy.dt, rate=rate_limit
        )
        self.max_step = self.track_keeping.max_rudder_step
        self.guidance = guidance

    def start_memory(self, y: Tensor) -> Tensor:
        memories = (self.guidance.initial_state(y), self.track_keeping.initial_state(y))
        return torch.cat((*memories, torch.zeros_like(y[:, :1])), dim=-1)

    def step(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n], fault [B] and arrived [B].

        Args:
            y: measurement [B, 6], see `COURSE_MEASUREMENTS`.
            s: memory [B, n].
        """
        return self.step_unchecked(y.to(torch.float64), s.to(torch.float64))

    def step_unchecked(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Evaluate `step` for tensors of the required shape and precision."""
        is_valid = self.is_in_range(y)
        y = torch.where(is_valid, y, torch.zeros_like(y))
        last_command = self.last_command(s)
        has_valid_memory = self.is_valid_memory(s)
        fresh_memory = self.start_memory(y)
        s = torch.where(has_valid_memory, s, fresh_memory)
        reference, guidance_memory = self.guidance(y, 0, s[:, : self.guidance.n_state])
        wanted_command, policy_memory = self.track_keeping(
            y, reference, s[:, self.guidance.n_state : -1]
        )
        next_memory = torch.cat((guidance_memory, policy_memory), dim=-1)
        command, s, fault = self.finish_step(
            wanted_command, next_memory, s, fresh_memory, last_command, is_valid & has_valid_memory
        )
        return command, s, fault, s[:, 0] >= self.guidance.length

    def forward(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, s)


class _TracedController(nn.Module):
    """Base class of the TorchScript modules of policies.

    Tensors of a wrong shape are rejected, not broadcast. TorchScript compiles this class and its
    subclasses. The policy is only traced and need not be scriptable.
    """

    def __init__(self, inner: GuardedPolicy | GuardedCoursePolicy, sizes: Sequence[int]) -> None:
        super().__init__()
        self.measured = inner.low.numel()
        self.memory = inner.memory_low.numel()
        # its dtype defines the precision of the module
        self.low = nn.Buffer(inner.low)
        # two rows, since a batch of one would hide mixed-up rows
        examples = tuple(torch.zeros(2, size, dtype=inner.low.dtype) for size in sizes)
        self.first_memory = trace_function(inner.initial_state, examples[:1], "policy")
        self.answer = trace_function(inner.step_unchecked, examples, "policy")

    @torch.jit.export
    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory s [B, n] at the first measurement y [B, k], rudder amidships."""
        require_shape("measured", y, [get_size(y, 2, 0), self.measured])
        s: Tensor = self.first_memory(y.to(self.low.dtype))
        return s


@final
class TracedPolicy(_TracedController):
    """TorchScript module of a steering policy, see `GuardedPolicy`."""

    @torch.jit.export
    def step(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n] and fault [B]."""
        rows = get_size(y, 2, 0)
        require_shape("measured", y, [rows, self.measured])
        require_shape("reference", reference, [rows, 1])
        require_shape("s", s, [rows, self.memory])
        dtype = self.low.dtype
        y = y.to(dtype)
        reference = reference.to(dtype)
        s = s.to(dtype)
        answer: tuple[Tensor, Tensor, Tensor] = self.answer(y, reference, s)
        return answer

    def forward(self, y: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, reference, s)


@final
class TracedCourse(_TracedController):
    """TorchScript module of a course policy, see `GuardedCoursePolicy`."""

    @torch.jit.export
    def step(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad, memory [B, n], fault [B] and arrived [B]."""
        rows = get_size(y, 2, 0)
        require_shape("measured", y, [rows, self.measured])
        require_shape("s", s, [rows, self.memory])
        y = y.to(self.low.dtype)
        s = s.to(self.low.dtype)
        answer: tuple[Tensor, Tensor, Tensor, Tensor] = self.answer(y, s)
        return answer

    def forward(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(y, s)


class _UncheckedStep(nn.Module):
    """Step of a controller without shape checks, for formats that export a single function."""

    def __init__(self, controller: GuardedPolicy | GuardedCoursePolicy) -> None:
        super().__init__()
        self.controller = controller

    def forward(self, *step_arguments: Tensor) -> tuple[Tensor, ...]:
        results: tuple[Tensor, ...] = self.controller.step_unchecked(*step_arguments)
        return results


class _InitialState(nn.Module):
    """Initial memory of a controller, for formats that export functions."""

    def __init__(self, controller: GuardedPolicy | GuardedCoursePolicy) -> None:
        super().__init__()
        self.controller = controller

    def forward(self, y: Tensor) -> Tensor:
        return self.controller.initial_state(y)


def guard_policy(
    policy: SteeringPolicy, fallback: FallbackCommand, dtype: torch.dtype = torch.float32
) -> GuardedPolicy:
    """Add input checks to a policy.

    Accepted are headings up to 1000 turns, three times the speed of the policy and five times the
    steady yaw rate at full rudder; for a depth policy also all ocean depths and pitch angles up to
    90 deg.
    """
    policy = copy.deepcopy(policy).to(dtype).eval().requires_grad_(False)
    policy.set_state_columns(tuple(policy.measured))
    max_rate = 5.0 * policy.gain * policy.limit
    max_measured = {
        "psi": _MAX_HEADING,
        "r": max_rate,
        "q": max_rate,
        "theta": 0.5 * math.pi,
        "z": MAX_DEPTH,
    }
    limits = [
        (0.0, 3.0 * policy.speed) if name == "u" else (-max_measured[name], max_measured[name])
        for name in policy.measured
    ]
    return GuardedPolicy(policy, limits, fallback, dtype).eval()


GuardedT = TypeVar("GuardedT", GuardedPolicy, GuardedCoursePolicy)


class CardParts(TypedDict, total=False):
    """Entries of a model card that depend on the type of policy, see `ControllerCard`."""

    reference: tuple[ReferenceQuantity, ...]
    start: CourseStart
    length: float
    lookahead: float
    memory: tuple[str, ...]


class ExportedController(Exportable, Generic[GuardedT]):
    """Common parts of the export of steering policies and course policies.

    Args:
        name: name of the policy.
        policy: policy with its final time step.
        fallback: command for invalid inputs.
        description: description of vessel, training or course for the model card.
        metrics: rows of metrics.json of this policy for the model card.
    """

    schema: CardSchema
    kind: str
    methods = ("initial_state", "step")

    def __init__(
        self,
        name: str,
        policy: SteeringPolicy,
        *,
        fallback: FallbackCommand,
        description: Mapping[str, Any],
        metrics: Sequence[HeadingRow | AnyCourseRow],
    ) -> None:
        self.name = name
        self.policy = policy
        self.fallback = fallback
        self.label = name if name == self.kind else f"{self.kind} {name}"
        self.description = description
        self.metrics = metrics
        self.dt = policy.dt
        self.steering_axis = policy.axis
        n_memory = self.build_controller(self.precisions[-1]).memory_low.numel()
        self.arguments = (
            ("y", len(self.measured_units)),
            *self._reference_arguments(),
            ("s", n_memory),
        )

    def _reference_arguments(self) -> Sequence[tuple[str, int]]:
        return ()

    @property
    def measured_units(self) -> Mapping[str, str]:
        """SI unit of each measurement that the exported policy reads, by name."""
        return self.policy.measured

    @abstractmethod
    def build_controller(self, dtype: torch.dtype) -> GuardedT:
        """Build the policy with input checks in a precision."""

    @abstractmethod
    def parity_arguments(self, module: GuardedT) -> Sequence[Tensor]:
        """Return the arguments [PARITY_STEPS, n] of the parity check, without the memory."""

    @abstractmethod
    def describe_for_card(self, module: GuardedT) -> CardParts:
        """Return the fields of the model card that depend on the type of policy."""

    def build_module(self, dtype: torch.dtype) -> nn.Module:
        inner = self.build_controller(dtype)
        sizes = [count for _, count in self.arguments]
        traced = TracedCourse if isinstance(inner, GuardedCoursePolicy) else TracedPolicy
        return traced(inner, sizes).eval()

    def build_step_module(self, dtype: torch.dtype) -> nn.Module:
        return _UncheckedStep(self.build_controller(dtype)).eval()

    def build_initial_state(self, dtype: torch.dtype) -> nn.Module:
        return _InitialState(self.build_controller(dtype)).eval()

    def card_contents(self) -> dict[str, Any]:
        module = self.build_controller(self.precisions[0])
        policy = self.policy
        measured_ranges = zip(module.low.tolist(), module.high.tolist(), strict=True)
        fallback_text = "held" if self.fallback == "hold" else "amidships"
        reference_text = ", reference" if self._reference_arguments() else ""
        command = CommandLimits(
            name=self.steering_axis.command,
            unit="rad",
            limit=policy.limit,
            rate=None if math.isinf(policy.rate) else policy.rate,
        )
        card = ControllerCard(
            schema=self.schema,
            policy=self.name,
            measured=tuple(
                MeasuredQuantity(name=name, unit=unit, range=limits)
                for (name, unit), limits in zip(
                    self.measured_units.items(), measured_ranges, strict=True
                )
            ),
            **self.describe_for_card(module),
            fault=f"measurement{reference_text} or memory no number or out of range: command"
            f" {fallback_text}, flag set",
            command=(command,),
            dt=policy.dt,
            **policy.describe(),
            turning=SteeringParameters(K=policy.gain, T=policy.time_constant, speed=policy.speed),
            frame=_FRAME_OF_AXIS[self.steering_axis],
            versions={"residnet": __version__, "torch": torch.__version__},
            exported=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            **self.description,
            metrics=tuple(self.metrics),
        )
        return card.model_dump(mode="json", by_alias=True, exclude_unset=True)

    def check_parity(
        self, loaded: LoadedExport, subject: str, dtype: torch.dtype, tolerance: float | None = None
    ) -> dict[str, Any]:
        """Compare an exported policy with the original over 1,000 steps, some with invalid inputs.

        Returns:
            Number of steps and largest difference of the command as a fraction of the rudder limit.

        Raises:
            RoundingError: if the difference exceeds `PARITY_TOLERANCE`.
            ExportError: if a command is not finite, or the fault flag is wrong.
        """
        module: Any = self.build_controller(dtype)
        parity_inputs = [array.to(dtype) for array in self.parity_arguments(module)]
        is_bad_input = torch.arange(PARITY_STEPS) % 97 == 50
        # the yaw rate of a heading policy, east of a course policy, the speed of a depth policy
        parity_inputs[0][is_bad_input, 2 if len(self.measured_units) == 3 else 1] = torch.nan
        input_arrays = [array.numpy() for array in parity_inputs]
        eager_memory = module.initial_state(parity_inputs[0][:1])
        loaded_memory = loaded.initial_memory(input_arrays[0][0])
        if loaded_memory is None:
            eager_memory = torch.full_like(eager_memory, torch.nan)
            loaded_memory = eager_memory[0].numpy()
            is_bad_input[0] = True
        max_difference = 0.0
        for k in range(PARITY_STEPS):
            with torch.no_grad():
                expected_command, eager_memory, *_ = module.step(
                    *(array[k : k + 1] for array in parity_inputs), eager_memory
                )
            command, loaded_memory, fault, *_ = loaded.step(
                *(array[k] for array in input_arrays), loaded_memory
            )
            difference = float(np.abs(command - expected_command[0].numpy()).max()) / module.limit
            if not math.isfinite(difference) or bool(fault) != bool(is_bad_input[k]):
                raise ExportError(
                    f"{self.label}: step {k} of the parity check gives the command"
                    f" {float(command[0])} and the flag {bool(fault)}"
                )
            max_difference = max(max_difference, difference)
        if max_difference > PARITY_TOLERANCE:
            raise RoundingError(
                f"{self.label}: the exported commands differ by {max_difference:.2g} of the"
                " rudder's limit;"
                f" allowed {PARITY_TOLERANCE:g}"
            )
        return {"steps": PARITY_STEPS, "share_of_limit": max_difference}


@final
class ExportedHeading(ExportedController[GuardedPolicy]):
    """Export of a heading or depth policy; some laws with a rudder rate need double precision."""

    schema: CardSchema = "residnet.policy_card/1"
    kind = "policy"
    results = ("command", "s_after", "fault")
    flags = ("fault",)

    def _reference_arguments(self) -> Sequence[tuple[str, int]]:
        return (("reference", 1),)

    def build_controller(self, dtype: torch.dtype) -> GuardedPolicy:
        return guard_policy(self.policy, self.fallback, dtype)

    def parity_arguments(self, module: GuardedPolicy) -> Sequence[Tensor]:
        """Return sinusoidal measurements, and references that change in steps.

        Depths in m have the same values as headings in rad.
        """
        step_index = torch.arange(PARITY_STEPS, dtype=module.low.dtype)
        max_rate = float(module.high[-1]) / 5.0
        psi = 0.8 * torch.sin(0.01 * step_index)
        r = max_rate * torch.cos(0.013 * step_index)
        measurements = [psi, torch.full_like(psi, module.speed), r]
        if self.steering_axis is DEPTH:
            measurements.insert(2, 0.3 * torch.sin(0.013 * step_index))
        y = torch.stack(measurements, dim=-1)
        return y, 0.5 * torch.sign(torch.sin(0.004 * step_index)).unsqueeze(-1)

    def describe_for_card(self, module: GuardedPolicy) -> CardParts:
        return {
            "reference": (
                ReferenceQuantity(
                    name=self.steering_axis.name,
                    unit=self.measured_units[self.steering_axis.value],
                ),
            ),
            "memory": (*module.policy.memory_ranges(1.0, 1.0), "last_command"),
        }


@final
class ExportedCoursePolicy(ExportedController[GuardedCoursePolicy]):
    """Export of a heading policy with the guidance of a planned course."""

    schema: CardSchema = "residnet.course_card/1"
    kind = "course of"
    results = ("command", "s_after", "fault", "arrived")
    flags = ("fault", "arrived")
    precisions = (torch.float64,)

    def __init__(
        self,
        name: str,
        policy: SteeringPolicy,
        guidance: CourseGuidance,
        course: Course,
        *,
        fallback: FallbackCommand,
        description: Mapping[str, Any],
        metrics: Sequence[HeadingRow | AnyCourseRow],
    ) -> None:
        self.guidance = guidance
        self.course = course
        super().__init__(name, policy, fallback=fallback, description=description, metrics=metrics)

    @property
    def measured_units(self) -> Mapping[str, str]:
        return COURSE_MEASUREMENTS

    def build_controller(self, dtype: torch.dtype) -> GuardedCoursePolicy:
        return GuardedCoursePolicy(self.policy, self.guidance, self.fallback).eval()

    def parity_arguments(self, module: GuardedCoursePolicy) -> Sequence[Tensor]:
        """Return measurements with cross-track errors, heading errors and a varying speed."""
        step_index = torch.arange(PARITY_STEPS, dtype=torch.float64)
        course = self.course
        track_index = (step_index * module.dt * module.speed / course.step).long()
        track_index = track_index.clamp(max=len(course.track) - 1)
        track = torch.from_numpy(course.track)[track_index]
        heading = torch.from_numpy(course.heading)[track_index]
        lateral_offset = 0.1 * module.guidance.lookahead
        y = (
            track[:, 0] + lateral_offset * torch.sin(0.02 * step_index),
            track[:, 1] + lateral_offset * torch.cos(0.017 * step_index),
            heading + 0.2 * torch.sin(0.03 * step_index),
            module.speed * (1.0 + 0.1 * torch.sin(0.01 * step_index)),
            0.02 * module.speed * torch.cos(0.02 * step_index),
            0.1 * module.high[5] * torch.sin(0.013 * step_index),
        )
        return (torch.stack(y, dim=-1),)

    def describe_for_card(self, module: GuardedCoursePolicy) -> CardParts:
        course = self.course
        n_guidance = module.guidance.n_state
        guidance_names = ("place", "drift_north", "drift_east")[:n_guidance]
        (north, east) = course.track[0].tolist()
        heading = float(course.heading[0])
        return {
            "start": CourseStart(north=north, east=east, heading=heading),
            "length": course.length,
            "lookahead": module.guidance.lookahead,
            "memory": (
                *guidance_names,
                "rudder",
                *(f"policy_{i}" for i in range(self.policy.n_state)),
                "last_command",
            ),
        }

"""Exported autopilots under bad measurements and memories: finite commands, flags, recovery."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.control.courses.course_plan import Course
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.guidance.drift import DriftEstimate
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.turning import Turning
from residnet.export.autopilot import for_export
from residnet.export.course import MEASURED, ExportedCourse
from residnet.testing.bad_inputs import check_bad_measurements

LIMIT = math.radians(5)


def policy() -> HeadingPolicy:
    torch.manual_seed(0)
    turning = Turning(3.47, 3.94, 3.2)
    made = HeadingPolicy(MEASURED, turning=turning, limit=LIMIT, dt=0.02, rate=0.2, hidden=(8,))
    for weights in made.network.parameters():
        torch.nn.init.normal_(weights, std=0.3)
    return made.eval().requires_grad_(False)


def course(safe: Any) -> ExportedCourse:
    angle = np.linspace(0.0, 2.0, 1001)
    track = 30.0 * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    planned = Course(0.06, track, angle, angle, np.full(len(angle), 0.03), 50.0)
    guidance = CourseGuidance(planned, 10.0, MEASURED, DriftEstimate(10.0, 0.8, 0.02))
    return ExportedCourse(policy(), guidance, safe).eval()


def scripted(module: torch.nn.Module) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.jit.script(module)


@pytest.mark.parametrize("safe", ["hold", "amidships"])
def test_a_heading_policy(safe: Any) -> None:
    module = for_export(policy(), safe)

    def step(y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        out: tuple[Tensor, Tensor, Tensor] = both.step(y[:, :3], y[:, 3:], s)
        return out

    both = scripted(module)
    # the reference is a heading too
    low, high = (torch.cat((edge, edge[:1])) for edge in (module.low, module.high))
    ranges = (module.memory_low, module.memory_high)
    check_bad_measurements(step, lambda y: both.initial_state(y[:, :3]), low, high, ranges, LIMIT)
    with pytest.raises(torch.jit.Error, match="s has the shape"):
        both.step(torch.zeros(3, 3), torch.zeros(3, 1), torch.zeros(1, 10))


@pytest.mark.parametrize("safe", ["hold", "amidships"])
def test_a_course(safe: Any) -> None:
    module = course(safe)
    both = scripted(module)
    ranges = (module.memory_low, module.memory_high)
    check_bad_measurements(
        lambda y, s: both.step(y, s)[:3], both.initial_state, module.low, module.high, ranges, LIMIT
    )
    with pytest.raises(torch.jit.Error, match="measured has the shape"):
        both.step(torch.zeros(3, 5), torch.zeros(3, len(module.memory_low)))

"""Policy and guidance of a course as C: the same track as in Python, commands late, with noise."""

from __future__ import annotations

import ctypes
import json
import math
from pathlib import Path
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
from residnet.export.c.compiled import compile_shared
from residnet.export.c.course import export_course_as_c
from residnet.export.course import MEASURED, ExportedCourse

GAIN, TIME, SPEED, DT, LATE = 3.47, 3.94, 3.2, 0.1, 2
FAR = 12_000.0
"""Metres from the origin of the chart, where single precision resolves a millimetre."""


class Compiled:
    """The compiled file, called for one vessel."""

    def __init__(self, library: Path, memory: int) -> None:
        self.loaded, self.memory = ctypes.CDLL(str(library)), memory

    def call(self, name: str, *arrays: np.ndarray) -> int:
        """Call a function of the file with arrays of doubles and truth values."""
        function = getattr(self.loaded, f"along_{name}")
        return int(function(*(array.ctypes.data_as(ctypes.c_void_p) for array in arrays)))

    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory [1, n]."""
        s = np.zeros(self.memory)
        self.call("initial_state", y[0].numpy(), s)
        return torch.from_numpy(s)[None]

    def step(self, y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, bool, bool]:
        """Return command, memory, fault and arrived."""
        command, after, arrived = np.zeros(1), np.zeros(self.memory), np.zeros(1, np.int32)
        fault = self.call("step", y[0].numpy(), s[0].numpy(), command, after, arrived)
        return torch.from_numpy(command), torch.from_numpy(after)[None], bool(fault), bool(arrived)


def flown(controller: Any, heading: float) -> np.ndarray:
    """Return the track [T, 4] of a vessel in a current, whose commands come late."""
    random = np.random.default_rng(3)
    x, y, psi, r = FAR, FAR + 2.0, heading, 0.0
    waiting, track = [0.0] * LATE, []
    s = controller.initial_state(measured(x, y, psi, r, random))
    for _ in range(300):
        command, s, fault, arrived = controller.step(measured(x, y, psi, r, random), s)
        assert not bool(fault)
        if bool(arrived):
            break
        waiting.append(float(command))
        delta = waiting.pop(0)
        r += DT * (GAIN * delta - r) / TIME
        psi += DT * r
        x += DT * (SPEED * math.cos(psi) + 0.1)
        y += DT * (SPEED * math.sin(psi) - 0.2)
        track.append((x, y, psi, delta))
    return np.array(track)


def measured(x: float, y: float, psi: float, r: float, random: Any) -> Tensor:
    """Return what the controller sees [1, 6], with noise."""
    noise = random.normal(size=4) * [0.1, 0.1, math.radians(0.1), math.radians(0.1)]
    seen = [x + noise[0], y + noise[1], psi + noise[2], SPEED, 0.0, r + noise[3]]
    return torch.tensor([seen], dtype=torch.float64)


@pytest.mark.exporters
def test_a_course_as_c_is_followed_as_in_python(tmp_path: Path) -> None:
    torch.manual_seed(0)
    limit = math.radians(5)
    policy = HeadingPolicy(
        MEASURED, turning=Turning(GAIN, TIME, SPEED), limit=limit, dt=DT, rate=0.2, hidden=(8,)
    ).requires_grad_(False)
    for weights in policy.network.parameters():
        torch.nn.init.normal_(weights, std=0.1)
    angle = np.linspace(0.0, 2.0, 1001)
    track = FAR + 45.0 * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    course = Course(0.09, track, angle, angle, np.full(len(angle), 0.02), 88.0)
    guidance = CourseGuidance(course, 10.0, MEASURED, DriftEstimate(10.0, 0.8, DT))
    file = tmp_path / "along.c"
    card = {"dt": DT, "parity": {"steps": 1000}}
    export_course_as_c("along", policy, guidance, course, file, safe="hold", card=card)
    stored = json.loads((tmp_path / "along.card.json").read_text())
    assert stored["parity"]["share_of_limit"] <= 1e-4
    module = ExportedCourse(policy, guidance, "hold").eval()
    library = compile_shared([file], tmp_path / "along.so")
    theirs = flown(Compiled(library, module.memory_low.numel()), 0.05)
    with torch.no_grad():
        own = flown(module, 0.05)
    assert len(own) > 200
    print(np.abs(theirs - own).max(0))
    np.testing.assert_allclose(theirs, own, rtol=0, atol=1e-4)
    # a measurement that is no number holds the command
    s = module.initial_state(torch.tensor([[FAR, FAR, 0.0, SPEED, 0.0, 0.0]]))
    wrong = torch.full((1, 6), torch.nan, dtype=torch.float64)
    command, after, fault, _ = Compiled(library, s.shape[1]).step(wrong, s)
    assert fault
    assert float(command) == 0.0
    assert bool(torch.isfinite(after).all())

"""Policy and guidance as one TorchScript module: the same as in the loop, and safe whatever comes
in.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from residnet.control.courses.course_plan import Course
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.guidance.drift import DriftEstimate
from residnet.control.heading.following import Following
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.turning import Turning
from residnet.export.course import MEASURED, export_course

LIMIT = math.radians(5)


@pytest.fixture(
    scope="module", params=[None, DriftEstimate(10.0, 0.8, 0.02)], ids=["plain", "integral"]
)
def made(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, object]]:
    torch.manual_seed(0)
    policy = (
        HeadingPolicy(
            MEASURED, turning=Turning(3.47, 3.94, 3.2), limit=LIMIT, dt=0.02, rate=0.2, hidden=(8,)
        )
        .eval()
        .requires_grad_(False)
    )
    angle = np.linspace(0.0, 2.0, 1001)
    track = 30.0 * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    course = Course(0.06, track, angle, angle, np.full(len(angle), 0.03), 50.0)
    guidance = CourseGuidance(course, 10.0, MEASURED, request.param)
    file = Path(tmp_path_factory.mktemp("course")) / "course.pt"
    card = export_course(
        "policy", policy, guidance, course, file, safe="hold", about={"vessel": "x"}, metrics=[]
    )
    extra = {"card.json": ""}
    loaded = torch.jit.load(str(file), _extra_files=extra)
    assert (
        json.loads(extra["card.json"])["start"]
        == card["start"]
        == {
            "north": 0.0,
            "east": 0.0,
            "heading": 0.0,
        }
    )
    return (
        loaded,
        Following(policy.double(), MEASURED, limit=LIMIT, dt=0.02, rate=0.2),
        guidance.double(),
        card,
    )


def test_it_commands_what_guidance_and_policy_command(
    made: tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, Any]],
) -> None:
    loaded, follower, guidance, card = made
    y = torch.tensor([[0.1, 0.3, 0.05, 3.2, 0.01, 0.02]], dtype=torch.float64)
    s, place, memory, last = (
        loaded.initial_state(y),
        guidance.initial_state(y),
        follower.initial_state(y),
        0.0,
    )
    for k in range(200):
        y = torch.tensor(
            [[0.064 * k, 0.3 + 0.001 * k, 0.002 * k, 3.2, 0.01, 0.1 * math.sin(0.1 * k)]],
            dtype=torch.float64,
        )
        command, s, fault, arrived = loaded.step(y, s)
        reference, place = guidance(y, k, place)
        wish, memory = follower(y, reference, memory)
        # the rudder's rate is inside
        last += min(max(float(wish) - last, -0.2 * 0.02), 0.2 * 0.02)
        assert float(command) == pytest.approx(last, abs=1e-12)
        assert not bool(fault)
        assert not bool(arrived)
    assert len(card["memory"]) == s.shape[1]


@pytest.mark.parametrize(
    ("place", "value"), [(0, math.nan), (1, math.inf), (2, 1e9), (3, -5.0), (4, math.nan), (5, 1e3)]
)
def test_wrong_input_raises_the_flag_and_holds_the_command(
    made: tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, object]],
    place: int,
    value: float,
) -> None:
    loaded = made[0]
    y = torch.tensor([[0.1, 0.3, 0.05, 3.2, 0.01, 0.02]])
    command, s, _, _ = loaded.step(y, loaded.initial_state(y))
    wrong = y.clone()
    wrong[0, place] = value
    held, after, fault, _ = loaded.step(wrong, s)
    assert bool(fault)
    assert float(held) == float(command)
    assert torch.equal(after, s)
    assert not bool(loaded.step(y, after)[2])


def test_a_memory_that_is_no_number_is_forgotten(
    made: tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, object]],
) -> None:
    loaded = made[0]
    y = torch.tensor([[0.1, 0.3, 0.05, 3.2, 0.01, 0.02]])
    command, after, fault, _ = loaded.step(y, torch.full_like(loaded.initial_state(y), math.nan))
    assert bool(fault)
    assert math.isfinite(float(command))
    assert bool(torch.isfinite(after).all())


@pytest.mark.parametrize("value", [1e38, -1e30, 1e12, -math.inf])
@pytest.mark.parametrize("place", range(11))
def test_a_memory_out_of_range_is_forgotten_too(
    made: tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, object]],
    place: int,
    value: float,
) -> None:
    loaded = made[0]
    y = torch.tensor([[0.1, 0.3, 0.05, 3.2, 0.01, 0.02]])
    command, s, _, _ = loaded.step(y, loaded.initial_state(y))
    spoilt = s.clone()
    spoilt[0, place] = value
    held, after, fault, _ = loaded.step(y, spoilt)
    assert bool(fault)
    assert float(held) == float(command)
    assert torch.equal(after[:, :-1], loaded.initial_state(y)[:, :-1])
    again, _, fault, _ = loaded.step(y, after)
    assert not bool(fault)
    assert math.isfinite(float(again))


@pytest.mark.parametrize("place", [-1.0, 1e3, 1e9])
def test_a_place_off_the_course_is_forgotten(
    made: tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, object]], place: float
) -> None:
    loaded = made[0]
    y = torch.tensor([[0.1, 0.3, 0.05, 3.2, 0.01, 0.02]])
    s = loaded.initial_state(y)
    s[0, 0] = place
    _, after, fault, _ = loaded.step(y, s)
    assert bool(fault)
    assert float(after[0, 0]) == 0.0


def test_far_behind_the_end_it_still_steers_along_the_last_leg(
    made: tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, object]],
) -> None:
    loaded, guidance = made[0], made[2]
    end = guidance.table[-1].tolist()
    ahead = 500.0
    y = torch.tensor(
        [
            [
                end[0] + ahead * math.cos(end[2]),
                end[1] + ahead * math.sin(end[2]),
                end[3],
                3.2,
                0.0,
                0.0,
            ]
        ]
    )
    s = loaded.initial_state(y)
    s[0, 0] = 58.0
    for _ in range(200):
        _, s, fault, arrived = loaded.step(y, s)
        assert not bool(fault)
    assert bool(arrived)
    assert float(s[0, 0]) == pytest.approx(guidance.farthest, rel=1e-5)


def test_it_arrives(
    made: tuple[torch.jit.ScriptModule, Following, CourseGuidance, dict[str, object]],
) -> None:
    loaded = made[0]
    y = torch.tensor([[30 * math.sin(1.7), 30 - 30 * math.cos(1.7), 1.7, 3.2, 0.0, 0.1]])
    s = loaded.initial_state(y)
    s[:, 0] = 49.0
    assert bool(loaded.step(y, s)[3])

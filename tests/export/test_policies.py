"""Exported policies, alone and along a course, and what controllers run: answers and flags."""

from __future__ import annotations

import ctypes
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exported_policies import DEG, DT, LIMIT, SETTINGS, SPEED, observed
from torch import Tensor

from residnet.autopilot import export as policy
from residnet.autopilot.courses.course_plan import Course
from residnet.autopilot.export import (
    COURSE_MEASUREMENTS,
    ExportedController,
    ExportedCoursePolicy,
    ExportedHeading,
)
from residnet.autopilot.guidance import CourseGuidance, DriftEstimate
from residnet.autopilot.heading.controllers import DepthPolicySpec, NetworkPolicySpec
from residnet.autopilot.heading.policies import OBSERVER_MEMORY
from residnet.core.errors import UsageError
from residnet.export import get_exporter
from residnet.export.c import compile_shared_library
from residnet.testing.checks import assert_finite, assert_true
from residnet.testing.export_checks import replace_entries

FAR = 12_000.0
"""Metres from the origin of the chart, where single precision resolves a millimetre."""


def heading(rate: float | None = 10 * DEG) -> ExportedHeading:
    return ExportedHeading("pilot", observed(rate)[1], fallback="hold", description={}, metrics=[])


def network() -> ExportedHeading:
    torch.manual_seed(0)
    made = NetworkPolicySpec(rate=10 * DEG, **SETTINGS).build().requires_grad_(False)
    made.network.out.weight.normal_(std=0.5)
    return ExportedHeading("pilot", made, fallback="amidships", description={}, metrics=[])


def depth() -> ExportedHeading:
    law, _ = observed(None, state=("psi", "u", "r", "z", "theta", "q"), righting=0.3)
    torch.manual_seed(0)
    sight = {"lookahead": 8.0, "depth_rate": 2.0, "drift_rate": 0.2}
    made = DepthPolicySpec(law=law, steepest=0.5, sight=sight).build().requires_grad_(False)
    inner: Any = made.inner_policy
    inner.network.out.weight.normal_(std=0.02)
    return ExportedHeading("pilot", made, fallback="amidships", description={}, metrics=[])


def along() -> ExportedCoursePolicy:
    angle = np.linspace(0.0, 2.0, 1001)
    track = FAR + 45.0 * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    course = Course(0.09, track, angle, angle, np.full(len(angle), 0.02), 88.0)
    guidance = CourseGuidance(
        course, 10.0, tuple(COURSE_MEASUREMENTS), DriftEstimate(10.0, 0.8, DT)
    )
    about = {"vessel": "x"}
    return ExportedCoursePolicy(
        "along",
        observed(10 * DEG)[1],
        guidance,
        course,
        fallback="hold",
        description=about,
        metrics=[],
    )


def check_bad_measurements(
    step: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]],
    initial_state: Callable[[Tensor], Tensor],
    low: Tensor,
    high: Tensor,
    memory: tuple[Tensor, Tensor],
    limit: float,
) -> None:
    """Check that an exported controller commands finite angles and flags what is wrong.

    Among good measurements, from `low` to `high` [k], stand bad ones, bad memories, and memories
    whose entries lie within their ranges [n] but do not belong together.
    """
    cases = 200
    random = torch.Generator().manual_seed(0)
    least, most = memory

    def between(a: Tensor, b: Tensor) -> Tensor:
        return a + torch.rand(cases, a.numel(), generator=random) * (b - a)

    s = initial_state(replace_entries(between(low, high), high, 0.2, random))
    assert_finite(s, "the memory at a bad measurement is not finite")
    for k in range(30):
        y = between(low, high)
        given = s
        if k % 5 == 1:
            y = replace_entries(y, high, 0.3, random)
        if k % 5 == 3:
            given = replace_entries(s, most, 0.2, random)
        if k == 20:
            given = between(least, most)
        command, s, fault = step(y, given)
        who = f"exported controller, step {k}"
        assert_finite(command, f"{who}: a command is not finite")
        assert_finite(s, f"{who}: a memory is not finite")
        assert_true(
            bool((command.abs() <= 1.001 * limit).all()), f"{who}: a command exceeds its limit"
        )
        good = ((y >= low) & (y <= high)).all(dim=-1)
        good &= ((given >= least) & (given <= most)).all(dim=-1)
        assert_true(bool((fault | good).all()), f"{who}: a bad sample raises no flag")
        if k < 20:
            assert_true(not bool((fault & good).any()), f"{who}: a good sample raises a flag")
        kept = ((s >= least) & (s <= most)).all()
        assert_true(bool(kept), f"{who}: leaves a memory that it would not accept")


KINDS = [heading, depth, network, along]


@pytest.mark.parametrize(
    "make", [*KINDS[:1], *(pytest.param(make, marks=pytest.mark.long) for make in KINDS[1:])]
)
def test_torchscript_answers_as_the_policy_and_is_safe(
    make: Callable[[], ExportedController], tmp_path: Path
) -> None:
    exported = make()
    card = get_exporter("torchscript").export(exported, tmp_path / "p.pt")
    extra = {"card.json": ""}
    module: Any = torch.jit.load(str(tmp_path / "p.pt"), _extra_files=extra)
    assert json.loads(extra["card.json"]) == json.loads(json.dumps(card))
    assert card["parity"]["share_of_limit"] <= 1e-4
    assert len(card["memory"]) == exported.arguments[-1][1]
    eager: Any = exported.build_controller(exported.precisions[0])
    count = len(exported.measured_units)
    given = exported.arguments[1][1] if len(exported.arguments) > 2 else 0

    def step(y: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        parts = [y[:, :count], y[:, count:]] if given else [y]
        command, s, fault, *_ = module.step(*parts, s)
        return command, s, fault

    # a reference is a heading too
    low, high = (torch.cat((edge, edge[:given])) for edge in (eager.low, eager.high))
    check_bad_measurements(
        step,
        lambda y: module.initial_state(y[:, :count]),
        low,
        high,
        (eager.memory_low, eager.memory_high),
        LIMIT,
    )
    with pytest.raises(torch.jit.Error, match="measured has the shape"):
        module.step(torch.zeros(3, 2), *[torch.zeros(3, 1)] * (given > 0), torch.zeros(3, 1))


def test_a_wrong_measurement_holds_the_command_and_the_memory() -> None:
    module = along().build_controller(torch.float64)
    y = torch.tensor([[FAR, FAR, 0.05, SPEED, 0.01, 0.02]], dtype=torch.float64)
    command, s, _, arrived = module.step(y, module.initial_state(y))
    assert not bool(arrived)
    wrong = torch.stack([torch.eye(6, dtype=torch.float64)] * 3) > 0
    values = torch.tensor([math.nan, math.inf, -1e9], dtype=torch.float64)[:, None, None]
    seen = torch.where(wrong, values, y).reshape(-1, 6)
    held, after, fault, _ = module.step(seen, s.expand(len(seen), -1))
    assert fault.all()
    assert (held == command).all()
    assert (after == s).all()
    assert not bool(module.step(y, after[:1])[2])


@pytest.mark.exporters
@pytest.mark.parametrize("make", KINDS)
@pytest.mark.parametrize("name", ["onnx", "casadi", "aoti", "c"])
@pytest.mark.usefixtures("short_parity")
def test_every_format_serves_every_policy(
    name: str, make: Callable[[], ExportedController], tmp_path: Path
) -> None:
    file = tmp_path / f"p{get_exporter(name).suffix}"
    made = make()
    card = get_exporter(name).export(made, file)
    assert file.is_file()
    parity = card["parity"]
    parities = [parity] if "share_of_limit" in parity else parity.values()
    assert all(part["share_of_limit"] <= 1e-4 for part in parities)
    if name == "c":
        # symbols take the name of the file, not of the policy
        assert "int p_step(const p_real *y" in file.with_suffix(".h").read_text()


@pytest.mark.parametrize("name", ["fmu2", "parameters", "feed_forward"])
def test_what_is_made_of_vessels_alone_refuses_policies(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="policy pilot: "):
        get_exporter(name).export(heading(), tmp_path / "p")
    assert not list(tmp_path.iterdir())


def test_a_lost_estimate_begins_anew_and_keeps_the_push() -> None:
    made = observed(None)[1].double()
    s = made.initial_state(torch.tensor([[0.0, SPEED, 0.0]], dtype=torch.float64))
    s[:, OBSERVER_MEMORY.index("push")] = 0.01
    turned = torch.tensor([[2.0, SPEED, 0.1]], dtype=torch.float64)
    _, after = made(turned, torch.full((1, 1), 2.0, dtype=torch.float64), s)
    assert float(after[0, OBSERVER_MEMORY.index("push")]) == pytest.approx(0.01)
    assert float(after[0, OBSERVER_MEMORY.index("heading")]) == pytest.approx(2.0, abs=0.01)


ROOT = Path(__file__).parents[2]
NODE = ROOT / "examples" / "ros2_autopilot" / "src" / "steering_node.c"
HARNESS = ROOT / "tests" / "support" / "rclc"
STEPS = 400
ASKED = 60
LAST = 199
AGAIN = 301
"""A heading is asked for; odometry comes a last time, and again."""


@pytest.mark.usefixtures("short_parity")
# the rudder that is held is the fast one
@pytest.mark.parametrize("safe", [pytest.param("amidships", marks=pytest.mark.long), "hold"])
def test_the_node_answers_as_the_policy(safe: Any, tmp_path: Path) -> None:
    own = observed(math.radians(10))[1]
    exported = ExportedHeading("pilot", own, fallback=safe, description={}, metrics=[])
    get_exporter("c").export(exported, tmp_path / "pilot.c")
    flags = [
        f"-I{HARNESS}", f"-I{tmp_path}", "-Dmain=node_main", "-DMODEL=pilot",
        "-DMODEL_UPPER=PILOT", '-DMODEL_HEADER="pilot.h"', "-DPILOT_DOUBLE",
    ]  # fmt: skip
    sources = [NODE, HARNESS / "harness.c", tmp_path / "pilot.c"]
    library = ctypes.CDLL(str(compile_shared_library(sources, tmp_path / "node.so", flags)))
    library.drive.restype = ctypes.c_double

    random = np.random.default_rng(0)
    psi = 3.0 + np.cumsum(0.01 * random.normal(size=STEPS))
    r = 0.02 * random.normal(size=STEPS)
    yaw = 0.5 * math.pi - psi
    rows = np.zeros((STEPS, 9))
    # every other step has an odometry, after a first one without
    rows[1::2, 0] = 1.0
    rows[LAST + 1 : AGAIN, 0] = 0.0
    rows[:, 3], rows[:, 4] = np.sin(0.5 * yaw), np.cos(0.5 * yaw)
    # a heel that leaves the heading as it is: the quaternion of yaw, then roll
    roll = 0.2
    rows[:, 1:3] = math.sin(0.5 * roll) * rows[:, 4:2:-1]
    rows[:, 3:5] *= math.cos(0.5 * roll)
    rows[:, 5], rows[:, 6] = SPEED, -r
    rows[ASKED, 7:] = 1.0, -2.5
    out = np.zeros((STEPS, 2))
    at = [ctypes.c_void_p(part.ctypes.data) for part in (rows, out)]
    assert library.drive(at[0], STEPS, at[1]) == pytest.approx(DT)

    module: Any = exported.build_controller(torch.float64)
    within = policy.PARITY_TOLERANCE * LIMIT
    s = None
    seen = torch.zeros(1, 3).double()
    age = 0.0
    asked = math.nan
    for k in range(STEPS):
        if rows[k, 0]:
            heading = math.remainder(psi[k], 2.0 * math.pi)
            seen = torch.tensor([[heading, SPEED, r[k]]]).double()
            age = 0.0
            if s is None:
                s = module.initial_state(seen)
                asked = heading
        asked = rows[k, 8] if rows[k, 7] else asked
        if s is None:
            assert out[k].tolist() == [0.0, 1.0]
            continue
        if age > 1.0:
            seen = torch.full_like(seen, math.nan)
        age += DT
        with torch.no_grad():
            command, s, fault = module.step(seen, torch.tensor([[asked]]).double(), s)
        assert out[k, 0] == pytest.approx(float(command), abs=within), k
        # it is too old after a second
        assert bool(out[k, 1]) == bool(fault) == (LAST + 50 <= k < AGAIN), k
    assert np.abs(out[:, 0]).max() == pytest.approx(LIMIT, rel=1e-3)
    assert abs(out[AGAIN - 1, 0]) == pytest.approx(LIMIT if safe == "hold" else 0.0, abs=1e-6)

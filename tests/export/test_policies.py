"""Exported policies, alone and along a course: answers, flags and recovery, in every format."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bad_measurements import check_bad_measurements
from exported_policies import DEG, DT, GAIN, LIMIT, SETTINGS, SPEED, TIME, observed
from s_functions import SFunction
from torch import Tensor

from residnet.control.courses.course_plan import Course
from residnet.control.guidance import CourseGuidance, DriftEstimate
from residnet.control.heading.controllers import DepthPolicySpec, NetworkPolicySpec
from residnet.control.heading.policies import FIXED
from residnet.core.errors import UsageError
from residnet.export import exporter, policy
from residnet.export.base import Loaded
from residnet.export.c import CompiledModel, compile_shared
from residnet.export.policy import COURSE, ExportedController, ExportedCoursePolicy, ExportedHeading

FAR = 12_000.0
"""Metres from the origin of the chart, where single precision resolves a millimetre."""


def heading(rate: float | None = 10 * DEG) -> ExportedHeading:
    return ExportedHeading("pilot", observed(rate)[1], safe="hold", about={}, metrics=[])


def network() -> ExportedHeading:
    torch.manual_seed(0)
    made = NetworkPolicySpec(rate=10 * DEG, **SETTINGS).build().requires_grad_(False)
    made.network.out.weight.normal_(std=0.5)
    return ExportedHeading("pilot", made, safe="amidships", about={}, metrics=[])


def depth() -> ExportedHeading:
    law, _ = observed(None, state=("psi", "u", "r", "z", "theta", "q"), righting=0.3)
    torch.manual_seed(0)
    sight = {"lookahead": 8.0, "depth_rate": 2.0, "drift_rate": 0.2}
    made = DepthPolicySpec(law=law, steepest=0.5, sight=sight).build().requires_grad_(False)
    inner: Any = made.law
    inner.network.out.weight.normal_(std=0.02)
    return ExportedHeading("pilot", made, safe="amidships", about={}, metrics=[])


def along() -> ExportedCoursePolicy:
    angle = np.linspace(0.0, 2.0, 1001)
    track = FAR + 45.0 * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    course = Course(0.09, track, angle, angle, np.full(len(angle), 0.02), 88.0)
    guidance = CourseGuidance(course, 10.0, tuple(COURSE), DriftEstimate(10.0, 0.8, DT))
    about = {"vessel": "x"}
    return ExportedCoursePolicy(
        "along", observed(10 * DEG)[1], guidance, course, safe="hold", about=about, metrics=[]
    )


KINDS = [heading, depth, network, along]


@pytest.mark.parametrize(
    "make", [*KINDS[:2], *(pytest.param(make, marks=pytest.mark.long) for make in KINDS[2:])]
)
def test_torchscript_answers_as_the_policy_and_is_safe(
    make: Callable[[], ExportedController], tmp_path: Path
) -> None:
    exported = make()
    card = exporter("torchscript").export(exported, tmp_path / "p.pt")
    extra = {"card.json": ""}
    module: Any = torch.jit.load(str(tmp_path / "p.pt"), _extra_files=extra)
    assert json.loads(extra["card.json"]) == json.loads(json.dumps(card))
    assert card["parity"]["share_of_limit"] <= 1e-4
    assert len(card["memory"]) == exported.arguments[-1][1]
    eager: Any = exported.controller(exported.precisions[0])
    count = len(exported.measured)
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


@pytest.mark.parametrize("place", range(6))
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e9])
def test_a_wrong_measurement_holds_the_command_and_the_memory(place: int, value: float) -> None:
    module = along().controller(torch.float64)
    y = torch.tensor([[FAR, FAR, 0.05, SPEED, 0.01, 0.02]], dtype=torch.float64)
    command, s, _, arrived = module.step(y, module.initial_state(y))
    assert not bool(arrived)
    wrong = y.clone()
    wrong[0, place] = value
    held, after, fault, _ = module.step(wrong, s)
    assert bool(fault)
    assert float(held) == float(command)
    assert torch.equal(after, s)
    assert not bool(module.step(y, after)[2])


class Eager(Loaded):
    """The policy itself."""

    def __init__(self, exported: ExportedController) -> None:
        self.module: Any = exported.controller(torch.float64)

    def step(self, *given: np.ndarray) -> tuple[Any, ...]:
        rows = (torch.from_numpy(np.asarray(part, dtype=np.float64))[None] for part in given)
        return tuple(part[0].numpy() for part in self.module.step(*rows))

    def memory(self, *past: np.ndarray) -> np.ndarray:
        found: np.ndarray = self.module.initial_state(torch.from_numpy(past[0])[None])[0].numpy()
        return found


def flown(loaded: Loaded) -> np.ndarray:
    """Return the track [T, 4] of a vessel in a current, whose commands come late, with noise."""
    random, late = np.random.default_rng(3), 10
    x, y, psi, r = FAR, FAR + 2.0, 0.05, 0.0
    waiting, track = [0.0] * late, []
    s: Any = None
    for _ in range(400):
        noise = random.normal(size=4) * [0.1, 0.1, 0.1 * DEG, 0.1 * DEG]
        seen = np.array([x + noise[0], y + noise[1], psi + noise[2], SPEED, 0.0, r + noise[3]])
        s = loaded.memory(seen) if s is None else s
        command, s, fault, arrived = loaded.step(seen, s)
        assert not bool(fault)
        assert not bool(arrived)
        waiting.append(float(command[0]))
        delta = waiting.pop(0)
        r += DT * (GAIN * delta - r) / TIME
        psi += DT * r
        x += DT * (SPEED * math.cos(psi) + 0.1)
        y += DT * (SPEED * math.sin(psi) - 0.2)
        track.append((x, y, psi, delta))
    return np.array(track)


@pytest.mark.long
def test_a_course_as_c_is_followed_as_in_python(tmp_path: Path) -> None:
    exported = along()
    card = exporter("c").export(exported, tmp_path / "along.c")
    assert card["dtype"] == "float64"
    assert "int along_step(const along_real *y" in (tmp_path / "along.h").read_text()
    library = compile_shared([tmp_path / "along.c"], tmp_path / "along.so")
    theirs = flown(CompiledModel(library, exported, torch.float64))
    np.testing.assert_allclose(theirs, flown(Eager(exported)), rtol=0, atol=1e-4)


@pytest.mark.long
def test_a_heading_policy_is_written_as_c(tmp_path: Path) -> None:
    """With its queue of pending commands and the memory of its network."""
    for exported in (heading(), network()):
        card = exporter("c").export(exported, tmp_path / "pilot.c")
        assert all(part["share_of_limit"] <= 1e-4 for part in card["parity"].values())
        stored = json.loads((tmp_path / "pilot.card.json").read_text())
        assert stored == json.loads(json.dumps(card))
        header = (tmp_path / "pilot.h").read_text()
        assert "int pilot_step(const pilot_real *y" in header
        assert "PILOT_SIZE_S" in header


def test_an_s_function_answers_as_the_policy(tmp_path: Path) -> None:
    exported = heading()
    made = SFunction(exported, tmp_path)
    random = np.random.default_rng(0)
    y = np.stack((0.2 * random.normal(size=200), np.full(200, 3.2), 0.02 * random.normal(size=200)))
    rows = np.concatenate((y, np.full((1, 200), 0.3))).T
    rows[100, 0] = np.nan
    dt, out = made.fly(rows, 2)
    assert dt == DT
    policy: Any = exported.controller(torch.float64)
    given = torch.from_numpy(rows)
    s = policy.initial_state(given[:1, :3])
    for k in range(200):
        with torch.no_grad():
            command, s, fault = policy.step(given[k : k + 1, :3], given[k : k + 1, 3:], s)
        assert out[k, 0] == pytest.approx(float(command), abs=1e-9)
        assert bool(out[k, 1]) == bool(fault) == (k == 100)


@pytest.mark.exporters
@pytest.mark.parametrize("make", KINDS)
@pytest.mark.parametrize("name", ["onnx", "casadi", "aoti"])
def test_every_format_serves_every_policy(
    name: str,
    make: Callable[[], ExportedController],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(policy, "PARITY_STEPS", 200)
    file = tmp_path / f"p{exporter(name).suffix}"
    card = exporter(name).export(make(), file)
    assert file.is_file()
    assert card["parity"]["share_of_limit"] <= 1e-4


@pytest.mark.parametrize("name", ["fmu", "parameters", "feed_forward"])
def test_what_is_made_of_vessels_alone_refuses_policies(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="policy pilot: "):
        exporter(name).export(heading(), tmp_path / "p")
    assert not list(tmp_path.iterdir())


def closed(rate: float | None, seconds: float, gap: tuple[float, float]) -> tuple[Any, ...]:
    """Headings, commands and flags of a loop with delay, noise and half a degree of bias."""
    random, module = (
        torch.Generator().manual_seed(2),
        policy.for_export(observed(rate)[1], "amidships"),
    )
    psi = r = 0.0
    late, decay = [0.0] * 10, math.exp(-DT / TIME)
    s = module.initial_state(torch.tensor([[0.0, SPEED, 0.0]]))
    track = []
    for k in range(round(seconds / DT)):
        noise = (0.1 * DEG * torch.randn(2, generator=random)).tolist()
        y = torch.tensor([[psi + noise[0], SPEED, r + noise[1]]])
        if gap[0] <= k * DT < gap[1]:
            y[0, 0] = torch.nan
        command, s, fault = module.step(y, torch.tensor([[30 * DEG]]), s)
        late.append(float(command))
        steady = GAIN * (late.pop(0) + 0.5 * DEG)
        psi += steady * DT + (r - steady) * TIME * (1 - decay)
        r = steady + (r - steady) * decay
        track.append((psi, float(command), bool(fault)))
    return tuple(zip(*track, strict=True))


@pytest.mark.long
@pytest.mark.parametrize("rate", [None, 10 * DEG])
def test_it_settles_and_takes_up_the_course_after_a_gap(rate: float | None) -> None:
    headings, commands, flags = closed(rate, 16.0, (0.0, 0.0))
    assert not any(flags)
    assert float((torch.tensor(headings[-300:]) - 30 * DEG).abs().max()) < 1.0 * DEG
    assert max(map(abs, commands)) <= LIMIT * 1.0001
    headings, commands, flags = closed(rate, 24.0, (1.5, 3.5))
    assert list(flags) == [1.5 <= k * DT < 3.5 for k in range(len(flags))]
    assert all(map(math.isfinite, commands))
    assert abs(headings[-1] - 30 * DEG) < 1.0 * DEG


def test_a_lost_estimate_begins_anew_and_keeps_the_push() -> None:
    made = observed(None)[1].double()
    s = made.initial_state(torch.tensor([[0.0, SPEED, 0.0]], dtype=torch.float64))
    s[:, FIXED.index("push")] = 0.01
    turned = torch.tensor([[2.0, SPEED, 0.1]], dtype=torch.float64)
    _, after = made(turned, torch.full((1, 1), 2.0, dtype=torch.float64), s)
    assert float(after[0, FIXED.index("push")]) == pytest.approx(0.01)
    assert float(after[0, FIXED.index("heading")]) == pytest.approx(2.0, abs=0.01)

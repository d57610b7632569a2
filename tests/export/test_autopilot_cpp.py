"""`examples/autopilot_cpp`, built as its README says, steers as Python does."""

from __future__ import annotations

import csv
import math
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from exported_policies import DT, GAIN, LIMIT, SPEED, TIME, observed

from residnet.control.heading.policies import NetworkPolicy
from residnet.control.heading.vessels import SteeredPlant
from residnet.dynamics.store import save_model
from residnet.export import exporter
from residnet.export.policy import ExportedHeading
from residnet.physics.vessel import load_vessel

SOURCE = Path(__file__).parents[2] / "examples" / "autopilot_cpp"
HEADING = math.radians(30)

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is not installed"),
    pytest.mark.skipif(
        shutil.which("c++") is None and shutil.which("g++") is None,
        reason="no C++ compiler is installed",
    ),
]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    build = tmp_path_factory.mktemp("build")
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    for words in (
        ["cmake", "-S", str(SOURCE), "-B", str(build), prefix, "-DCMAKE_BUILD_TYPE=Debug"],
        ["cmake", "--build", str(build)],
    ):
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return build / "autopilot"


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    vessel = SteeredPlant(load_vessel("nomoto_oceanos").build())
    torch.manual_seed(0)
    turning = vessel.turning(LIMIT, 60.0)
    own = NetworkPolicy(vessel.state, turning=turning, limit=LIMIT, dt=DT, units=4)
    with torch.no_grad():
        own.network.out.weight.copy_(0.05 * torch.randn_like(own.network.out.weight))
    file = tmp_path_factory.mktemp("policy") / "policy.pt"
    own.requires_grad_(False)
    exported = ExportedHeading("policy", own, safe="amidships", about={}, metrics=[])
    exporter("torchscript").export(exported, file)
    return file


def test_it_steers_as_python_does(program: Path, policy: Path, tmp_path: Path) -> None:
    seconds, track = 8.0, tmp_path / "track.csv"
    words = [
        str(program),
        str(policy),
        str(track),
        *map(repr, (GAIN, TIME, SPEED, DT, HEADING, seconds)),
    ]
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert "median step" in said
    module = torch.jit.load(str(policy))
    psi = r = 0.0
    decay = math.exp(-DT / TIME)
    y, reference = torch.tensor([[0.0, SPEED, 0.0]]), torch.tensor([[HEADING]])
    s = module.initial_state(y)
    with track.open() as lines:
        theirs = list(csv.DictReader(lines))
    assert len(theirs) == round(seconds / DT)
    for row in theirs:
        y[0, 0], y[0, 2] = psi, r
        command, s, _ = module.step(y, reference, s)
        delta = float(command)
        for name, mine in (("psi", psi), ("r", r), ("delta", delta)):
            assert float(row[name]) == pytest.approx(mine, abs=1e-4)
        assert row["fault"] == "0"
        steady = GAIN * delta
        psi += steady * DT + (r - steady) * TIME * (1.0 - decay)
        r = steady + (r - steady) * decay
    assert abs(psi) > math.radians(1.0), "an untrained network steers, though not to its reference"


def test_an_observed_policy_steers_alike_with_delay_and_noise(
    program: Path, tmp_path: Path
) -> None:
    """The example's own comparison: the same track in C++ and in Python, with commands 0.2 s late
    and noise of 0.1 deg and 0.1 deg/s.
    """
    spec, own = observed(None)
    save_model(tmp_path / "models" / "p", spec, own)
    file = tmp_path / "exports" / "p.pt"
    file.parent.mkdir()
    exported = ExportedHeading("p", own, safe="amidships", about={}, metrics=[])
    exporter("torchscript").export(exported, file)
    words = [sys.executable, str(SOURCE / "compare.py"), str(file), str(program), "--seconds", "8"]
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    differences = [float(line.split()[-1]) for line in said.splitlines() if "difference" in line]
    assert len(differences) == 2
    assert max(differences) < 1e-4


def test_wrong_calls_end_with_a_line(program: Path, policy: Path, tmp_path: Path) -> None:
    none = subprocess.run([str(program)], capture_output=True, text=True)
    assert none.returncode == 2
    assert "usage" in none.stderr
    missing = subprocess.run(
        [str(program), "nothing.pt", str(tmp_path / "t.csv"), *["1"] * 6],
        capture_output=True,
        text=True,
    )
    assert missing.returncode == 1
    assert missing.stderr.startswith("autopilot: ")

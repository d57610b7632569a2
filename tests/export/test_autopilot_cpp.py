"""`examples/autopilot_cpp`, built as its README says, steers as Python does."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from exported_policies import observed

from residnet.autopilot.export import ExportedHeading
from residnet.dynamics.store import save_model
from residnet.export import get_exporter

SOURCE = Path(__file__).parents[2] / "examples" / "autopilot_cpp"
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
    exported = ExportedHeading("p", own, fallback="amidships", description={}, metrics=[])
    get_exporter("torchscript").export(exported, file)
    words = [sys.executable, str(SOURCE / "compare.py"), str(file), str(program), "--seconds", "8"]
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    differences = [float(line.split()[-1]) for line in said.splitlines() if "difference" in line]
    assert len(differences) == 2
    assert max(differences) < 1e-4
    assert "median step" in said


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [((), 2, "usage"), (("nothing.pt", "t.csv", *"111111"), 1, "autopilot: ")],
)
def test_wrong_calls_end_with_a_line(
    program: Path, words: tuple[str, ...], code: int, said: str, tmp_path: Path
) -> None:
    done = subprocess.run([str(program), *words], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == code
    assert said in done.stderr

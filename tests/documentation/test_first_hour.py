"""The tutorial of the first hour, followed literally in an empty folder."""

from __future__ import annotations

import json
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "first_hour.md"


@pytest.mark.long
def test_the_tutorial_ends_with_the_numbers_that_it_prints(tmp_path: Path) -> None:
    text = PAGE.read_text()
    lines = [
        line for block in re.findall(r"```sh\n(.*?)```", text, re.S) for line in block.split("\n")
    ]
    commands = [shlex.split(line) for line in lines if line]
    assert [command[:2] for command in commands] == [
        ["residnet", verb] for verb in ("demo", "new", "run", "runs")
    ]
    said = ""
    for command in commands:
        words = [sys.executable, "-m", "residnet.cli", *command[1:]]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        said = done.stdout
    assert "finished" in said
    assert (tmp_path / "runs" / "boat" / "report.html").is_file()
    assert len(re.findall("# guess", (tmp_path / "boat.yaml").read_text())) == 6
    metrics = json.loads((tmp_path / "runs" / "boat" / "metrics.json").read_text())
    assert metrics["predictor"] == "ensemble"
    printed = re.findall(r"^\| (\w+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", text, re.M)
    assert [name for name, *_ in printed] == ["constant_velocity", "baseline", "hull", "ensemble"]
    # the head plsr, which is no member of the ensemble, diverges in one window
    shown_models = {name for name, *_ in printed}
    assert all(row["diverged"] == 0 for row in metrics["rows"] if row["model"] in shown_models)
    keys = ("model", "split", "protocol", "manoeuvre")
    rows = {tuple(row[key] for key in keys): row["rmse"] for row in metrics["rows"]}
    for name, *numbers in printed:
        rmse = rows[name, "test", "T30", "all"]
        found = [rmse["u"], rmse["v"], math.degrees(rmse["r"])]
        assert found == pytest.approx([float(number) for number in numbers], rel=0.02), name

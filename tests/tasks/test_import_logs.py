"""Task `import`: recordings become canonical logs with their findings."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import written_logs
from tiny import Command, read_json, write_yaml

from residnet.core.log import Log
from residnet.io.readers.base import CanonicalConfig

pytestmark = pytest.mark.usefixtures("example_tasks")


def config(folder: Path, logs: str) -> Path:
    content = {"task": "import", "name": "trials", "root": str(folder), "logs": [logs]}
    return write_yaml(folder / "import.yaml", content | {"reader": {"kind": "auto"}})


def recorded(folder: Path, name: str, seconds: float) -> Log:
    folder.mkdir(exist_ok=True)
    log = written_logs.trial(seconds)
    written_logs.topics(log, folder).rename(folder / name)
    return log


def test_recordings_of_different_length_become_canonical_logs(
    tmp_path: Path, command: Command
) -> None:
    lengths = {"rec_a": 20.0, "rec_b": 7.5}
    logs = {name: recorded(tmp_path, name, seconds) for name, seconds in lengths.items()}
    said = command("run", config(tmp_path, "rec_*"), "--out", tmp_path / "run")
    assert said.code == 0
    assert re.search(r"^rec_b +76 +0\.1000 +7\.500 ", said.out, re.MULTILINE)
    for name, log in logs.items():
        read = CanonicalConfig().build().read(tmp_path / "run" / "logs" / f"{name}.parquet")
        np.testing.assert_allclose(read.t, log.t, atol=1e-9)
        np.testing.assert_allclose(read["psi"], log["psi"], atol=1e-9)
    findings = read_json(tmp_path / "run" / "findings.json")
    assert {entry["code"] for entry in findings["rec_a"]} >= {"time_zone", "topic_rate"}
    assert set(findings["rec_a"][0]) == {"level", "code", "text", "figures"}
    inputs = read_json(tmp_path / "run" / "provenance.json")["inputs"]
    assert {Path(path).name for path in inputs} == {"odometry.csv", "cmd_port.csv", "cmd_stbd.csv"}


def test_two_recordings_of_one_name_keep_apart(tmp_path: Path, command: Command) -> None:
    for day in ("monday", "tuesday"):
        recorded(tmp_path / day, "rec_a", 2.0)
    run = tmp_path / "run"
    assert command("run", config(tmp_path, "*/rec_a"), "--out", run).code == 0
    assert set(read_json(run / "findings.json")) == {"monday_rec_a", "tuesday_rec_a"}
    assert len({path.name for path in run.rglob("*_rec_a.*")}) >= 2

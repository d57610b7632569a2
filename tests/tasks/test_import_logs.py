"""Task `import`: recordings become canonical logs with their findings; what does not match stops
before any work.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import written_logs
import yaml
from tiny import call

from residnet.core.log import Log
from residnet.data.readers.base import CanonicalConfig


def config(folder: Path, **keys: object) -> Path:
    path = folder / "import.yaml"
    content = {
        "task": "import",
        "name": "trials",
        "root": str(folder),
        "logs": ["rec_*"],
        "reader": {"kind": "auto"},
        **keys,
    }
    path.write_text(yaml.safe_dump(content))
    return path


def recorded(folder: Path, name: str, seconds: float) -> Log:
    log = written_logs.trial(seconds)
    made = written_logs.topics(log, folder)
    made.rename(folder / name)
    return log


def test_recordings_of_different_length_become_canonical_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = {
        name: recorded(tmp_path, name, seconds)
        for name, seconds in (("rec_a", 20.0), ("rec_b", 7.5))
    }
    assert call(monkeypatch, "run", config(tmp_path), "--out", tmp_path / "run") == 0
    printed = capsys.readouterr().out
    assert re.search(r"^rec_b +76 +0\.1000 +7\.500 ", printed, re.MULTILINE)
    for name, log in logs.items():
        read = CanonicalConfig().build().read(tmp_path / "run" / "logs" / f"{name}.parquet")
        np.testing.assert_allclose(read.t, log.t, atol=1e-9)
        np.testing.assert_allclose(read["psi"], log["psi"], atol=1e-9)
    findings = json.loads((tmp_path / "run" / "findings.json").read_text())
    assert {entry["code"] for entry in findings["rec_a"]} >= {"time_zone", "topic_rate"}
    assert set(findings["rec_a"][0]) == {"level", "code", "text", "figures"}
    inputs = json.loads((tmp_path / "run" / "provenance.json").read_text())["inputs"]
    assert {Path(path).name for path in inputs} == {"odometry.csv", "cmd_port.csv", "cmd_stbd.csv"}


def test_two_recordings_of_one_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        recorded(tmp_path / day, "rec_a", 2.0)
    run = tmp_path / "run"
    assert call(monkeypatch, "run", config(tmp_path, logs=["*/rec_a"]), "--out", run) == 0
    assert set(json.loads((run / "findings.json").read_text())) == {"monday_rec_a", "tuesday_rec_a"}
    assert len({path.name for path in run.rglob("*_rec_a.*")}) >= 2

"""Logs that a fit has used are named when its models are evaluated on them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from residnet.core.log import Log
from residnet.io.sources import MeasuredLogs
from residnet.runs.folder import RunFolder
from residnet.tasks.fit.outcome import list_test_files, mark_logs_of_fit


def log(name: str, sha256: str) -> Log:
    t = np.arange(3.0)
    return Log(name, t, {"u": t}, {"u": "m/s"}, meta={"sha256": sha256, "findings": []})


def test_a_log_of_the_fit_is_named_by_its_checksum(tmp_path: Path) -> None:
    (tmp_path / "provenance.json").write_text(json.dumps({"inputs": {"logs/a.csv": "f00d"}}))
    known, new = mark_logs_of_fit([log("copy_of_a", "f00d"), log("b", "beef")], RunFolder(tmp_path))
    (finding,) = known.meta["findings"]
    assert (finding["level"], finding["code"]) == ("will mislead", "log_of_fit")
    assert "same SHA-256" in finding["text"]
    assert new.meta["findings"] == []


def test_a_test_log_of_the_fit_has_trained_no_model(tmp_path: Path) -> None:
    inputs = {str(tmp_path / "a.csv"): "f00d", str(tmp_path / "b.csv"): "beef"}
    (tmp_path / "provenance.json").write_text(json.dumps({"inputs": inputs}))
    split = {"root": str(tmp_path), "train": ["a.csv"], "validation": ["c.csv"], "test": ["b.csv"]}
    for name in ("a.csv", "b.csv", "c.csv"):
        (tmp_path / name).write_text("t,u\n0,1\n")
    data = MeasuredLogs.model_validate(
        {"kind": "measured", "reader": {"kind": "canonical"}, "split": split}
    )
    test_files = list_test_files(data)
    assert test_files == {(tmp_path / "b.csv").resolve()}
    logs = [log("a", "f00d"), log("b", "beef")]
    trained, held_out = mark_logs_of_fit(logs, RunFolder(tmp_path), test_files)
    assert len(trained.meta["findings"]) == 1
    assert held_out.meta["findings"] == []


def test_a_run_without_provenance_names_no_log(tmp_path: Path) -> None:
    (marked,) = mark_logs_of_fit([log("a", "f00d")], RunFolder(tmp_path))
    assert marked.meta["findings"] == []

"""Samples of scripts/bench/mutations.py: mutated configs, run folders and places to write to."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from mutations import mutated_config, mutated_folder
from tiny import call
from tiny_tasks import TINY_TASKS

from residnet.core.errors import ResidnetError
from residnet.runs.folder import RunFolder
from residnet.tasks.registry import load_task


def complaint(work: Callable[[Path], object], path: Path) -> str:
    """The line of an error of residnet's own; empty where there is none."""
    try:
        work(path)
    except ResidnetError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", TINY_TASKS)
def test_mutated_configs_are_valid_or_one_line(name: str, tmp_path: Path) -> None:
    config, draw = TINY_TASKS[name](tmp_path), random.Random(name)
    file = tmp_path / "config.yaml"
    for number in range(10):
        data, told = mutated_config(config, draw)
        file.write_bytes(data)
        line = complaint(load_task, file)
        if line:
            assert "\n" not in line, (number, told)
            assert str(file) in line, (number, told)
            assert len(line) < 2000, (number, told)


@pytest.mark.parametrize("name", ["actuators", "imported"])
def test_mutated_configs_run_or_end_in_one_line(name: str, tmp_path: Path) -> None:
    config, draw = TINY_TASKS[name](tmp_path), random.Random(name)
    file, done = tmp_path / "config.yaml", 0
    for number in range(25):
        data, told = mutated_config(config, draw)
        file.write_bytes(data)
        line = complaint(
            lambda path: load_task(path).run(out=tmp_path / "run", overwrite=True, report=False),
            file,
        )
        assert "\n" not in line, (number, told)
        assert len(line) < 2000, (number, told)
        done += not line
    assert 0 < done < 25


def test_damaged_run_folders_are_refused_in_one_line(tiny_run: Path, tmp_path: Path) -> None:
    """What nothing reads back as a result may be damaged."""
    draw, run, refused = random.Random(0), tmp_path / "run", 0
    harmless = ("figures", "exports", "tensorboard", "checkpoints", "report.html")
    for number in range(60):
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(tiny_run, run)
        told = mutated_folder(run, [], draw)
        line = complaint(RunFolder.open, run)
        if line:
            refused += 1
            assert "\n" not in line, (number, told)
            assert str(run) in line, (number, told)
        else:
            assert told.startswith((*harmless, "checksums.json", "summary.json")), (number, told)
    assert refused > 25


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("file/run", "cannot be written|is no folder"),
        ("x" * 300, "name too long|too long"),
        ("/".join(["deep" * 20] * 60), "too long"),
        ("full/run", "No space left on device"),
    ],
)
def test_a_place_that_cannot_hold_a_run_is_refused_before_the_work(
    place: str,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(TINY_TASKS["simulated"](tmp_path)))
    (tmp_path / "file").write_text("no folder")
    if place.startswith("full"):

        def full(*_: Any) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
    assert call(monkeypatch, "run", config, "--out", tmp_path / place) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1, "nothing was done before"
    assert any(words in error for words in told.split("|")), error

"""What README.md shows is valid: its YAML is read by the program, its commands name files and
options that exist.
"""

from __future__ import annotations

import itertools
import re
import shlex
from pathlib import Path

import pytest
import yaml

from residnet.core.config import load_config, load_mapping, validate
from residnet.physics.vessel import VesselConfig
from residnet.tasks.loading import load_task
from residnet.tasks.union import TaskConfig

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```yaml\n(.*?)```", TEXT, re.S)
RUNS = sorted(set(re.findall(r"residnet run (configs/[^`|\n]*)", TEXT)))


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_yaml_is_read(number: int, tmp_path: Path) -> None:
    path = tmp_path / "shown.yaml"
    path.write_text(BLOCKS[number])
    content = load_mapping(path)
    if "task" in content:
        # the logs are the reader's own
        content["data"]["split"]["root"] = str(tmp_path)
        assert validate(content, TaskConfig, "README").task == content["task"]
    else:
        assert load_config(path, [], VesselConfig).build().commands > 0


def test_both_kinds_of_file_are_shown() -> None:
    assert {"task" in yaml.safe_load(block) for block in BLOCKS} == {True, False}


@pytest.mark.parametrize("command", RUNS)
def test_commands_name_what_exists(
    command: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    words = shlex.split(command)
    path = ROOT / words[0]
    assert path.is_file(), f"README names {words[0]}"
    overrides = [value for flag, value in itertools.pairwise(words) if flag == "-s"]
    vessel = tmp_path / "my_boat.yaml"
    vessel.write_text(next(block for block in BLOCKS if "task:" not in block))
    made = [
        text.replace("my_boat.yaml", str(vessel)).replace("seed=K", "seed=1")
        for text in overrides
        if "=runs/" not in text
    ]
    (tmp_path / "esso_osaka").mkdir()
    (tmp_path / "esso_osaka" / "split.yaml").write_text(
        "train: [a.csv]\nvalidation: [b.csv]\ntest: [c.csv]\n"
    )
    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    load_task(path, made)


def test_files_and_folders_that_are_named_exist() -> None:
    for name in re.findall(r"`((?:configs|scripts|src)/[A-Za-z0-9_/.-]+)`", TEXT):
        assert (ROOT / name).exists(), f"README names {name}"

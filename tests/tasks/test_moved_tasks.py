"""Tasks of earlier versions are refused with what replaces them."""

from __future__ import annotations

from pathlib import Path

import pytest

from residnet.core.errors import ConfigError
from residnet.tasks.registry import load_task


@pytest.mark.parametrize("task", ["actuators", "import"])
def test_a_task_that_became_an_example_is_refused_with_its_package(
    task: str, tmp_path: Path
) -> None:
    file = tmp_path / "old.yaml"
    file.write_text(f"task: {task}\nname: old\n")
    with pytest.raises(ConfigError, match=r"pip install \./examples/residnet_tasks") as refusal:
        load_task(file)
    assert refusal.value.code == "config.unknown_value"


def test_a_study_is_refused_with_the_search_of_a_sweep(tmp_path: Path) -> None:
    file = tmp_path / "old.yaml"
    file.write_text("task: study\nname: old\n")
    with pytest.raises(ConfigError, match="kind: variants"):
        load_task(file)

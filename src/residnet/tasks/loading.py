"""Reading the config of a run of any task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from residnet.core.config import load_config
from residnet.runs.task import Task
from residnet.tasks.union import TaskConfig


def load_task(path: Path, overrides: Sequence[str]) -> Task:
    """Return the task of a config file with overrides.

    Raises:
        ConfigError: one line with file or override, key, fault and the nearest valid name.
    """
    task: Task = load_config(path, overrides, TaskConfig)
    return task

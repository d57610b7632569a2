"""One file per kind of run; `load_task` reads a config and gives the task that it describes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from residnet.core.config import load_config
from residnet.documents.halvorsen2019.breeding.task import BreedingTaskConfig
from residnet.tasks.actuators import ActuatorsTaskConfig
from residnet.tasks.fit import FitConfig
from residnet.tasks.simulate import SimulateConfig
from residnet.tasks.study import StudyConfig
from residnet.tasks.union import TaskConfig


def load_task(
    path: Path, overrides: Sequence[str]
) -> FitConfig | SimulateConfig | StudyConfig | ActuatorsTaskConfig | BreedingTaskConfig:
    """The task of a config file with overrides.

    Raises:
        ConfigError: one line with file or override, key, fault and the nearest valid name.
    """
    task: FitConfig | SimulateConfig | StudyConfig | ActuatorsTaskConfig | BreedingTaskConfig = (
        load_config(path, overrides, TaskConfig)
    )
    return task

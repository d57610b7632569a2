"""Reading the config of a run of any task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.core.files import shipped_configs
from residnet.core.names import nearest
from residnet.runs.task import Task
from residnet.tasks.union import TaskConfig


def load_task(path: Path, overrides: Sequence[str] = ()) -> Task:
    """Return the task of a config file with overrides.

    Args:
        path: YAML file, or the name of a config that comes with residnet, such as `quickstart`.
        overrides: `dotted.key=value`, in order; `~dotted.key` takes a key away.

    Raises:
        ConfigError: one line with file or override, key, fault and the nearest valid name.
    """
    task: Task = load_config(config_file(path), overrides, TaskConfig)
    return task


def config_file(path: Path) -> Path:
    """Return the file of a config: the path itself, or that of a shipped config of this name.

    Raises:
        ConfigError: where there is neither; the message names the nearest shipped config.
    """
    try:
        if path.is_file() or path.suffix or path.is_absolute():
            return path
    except OSError as error:
        raise ConfigError(f"{path}: is no path ({error.strerror})") from error
    shipped = shipped_configs()
    name = path.as_posix()
    if name not in shipped:
        raise ConfigError(
            f"{path}: no such file, and no config of this name comes with residnet"
            f"{nearest(name, shipped)}; residnet list configs shows them"
        )
    return shipped[name]

"""Any task from Python: by a YAML file or a mapping, with or without a folder."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from residnet.api.models import Model, load
from residnet.api.values import PathGiven, described, hearing, path, plain
from residnet.core.config import load_config, validate
from residnet.core.errors import UsageError
from residnet.core.files import read_table
from residnet.core.names import nearest
from residnet.core.progress import ProgressCallback
from residnet.judge.metrics import metrics_table
from residnet.runs.folder import RunFolder
from residnet.runs.task import Task
from residnet.tasks.registry import TaskConfig

if TYPE_CHECKING:
    import pandas as pd


@final
class Result:
    """What a run found, of whatever task.

    Where the run was given no folder, its files are kept as long as this object is.

    Attributes:
        folder: where everything stands.
    """

    def __init__(self, folder: Path, kept: tempfile.TemporaryDirectory[str] | None) -> None:
        self.folder = folder
        self._kept = kept

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Task, verdict in whole sentences, and main figures with their units."""
        return dict(RunFolder(self.folder).read_summary())

    @property
    def verdict(self) -> list[str]:
        """The verdict in whole sentences."""
        return list(self.summary["verdict"])

    @cached_property
    def metrics(self) -> pd.DataFrame:
        """Rows of metrics.json as a table.

        Raises:
            UsageError: where the task has none.
        """
        import pandas as pd

        rows = list(RunFolder(self.folder).read_metrics()["rows"])
        # a fit counts errors of velocities; other tasks have columns of their own
        return metrics_table(rows) if "rmse" in rows[0] else pd.json_normalize(rows)

    @property
    def files(self) -> list[str]:
        """Names of all files of the run."""
        every = sorted(self.folder.rglob("*"))
        return [str(file.relative_to(self.folder)) for file in every if file.is_file()]

    def read(self, name: str) -> Any:
        """Return the contents of a file: a table for Parquet, values for JSON, else text.

        Args:
            name: of the file, as `files` has it.

        Raises:
            UsageError: where there is no such file, or it is no text, JSON or Parquet.

        Example:
            result.read("indices.json")["rows"]
        """
        file = self.folder / name
        if not file.is_file():
            raise UsageError(f"{self.folder}: no file '{name}'{nearest(str(name), self.files)}")
        if file.suffix == ".parquet":
            return read_table(file)
        try:
            text = file.read_text(encoding="utf-8")
            return json.loads(text) if file.suffix == ".json" else text
        except (OSError, ValueError, RecursionError) as error:
            raise UsageError(
                f"{file}: not readable ({error}); restore it or run it again"
            ) from error

    def model(self, name: str = "selected") -> Model:
        """Return a model of a fit.

        Raises:
            UsageError: where the run has no such model.
        """
        return load(self.folder, name)

    def __repr__(self) -> str:
        return f"Result({self.summary['task']}, {self.folder})"


def run(
    config: PathGiven | Mapping[str, Any] | Task,
    *,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    folder: PathGiven | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: bool = True,
    progress: ProgressCallback | None = None,
) -> Result:
    """Carry out any task, with the numbers of the command line.

    Args:
        config: path of a YAML file, the same as a mapping, or a task's config object. Relative
            paths in a file start from its folder, those in a mapping from the current one.
        overrides: of single keys: texts such as `heads.lstm.hidden_size=16` (or `~key`, which takes
            one away), or a mapping from dotted keys to values; for a file.
        folder: where the run is kept; without one it is carried out in a folder of its own, which
            vanishes with the result.
        resume: continue an interrupted run in its folder.
        overwrite: replace an earlier run in its folder.
        report: draw the report and export; without them a run ends after its results.
        progress: is told what is being done, and how far it is.

    Raises:
        ConfigError: where the config is wrong.
        ResidnetError: where the input does not allow it, or a result fails a check.

    Example:
        result = residnet.run("quickstart.yaml", overrides={"seed": 3}); result.metrics
    """
    task, source, changes = _task(config, overrides)
    kept = None if folder is not None else tempfile.TemporaryDirectory(prefix="residnet-")
    place = path(folder, "run: folder") if kept is None else Path(kept.name) / task.name
    with hearing(progress):
        task.run(
            source=source,
            overrides=changes,
            out=place,
            resume=resume,
            overwrite=overwrite,
            report=report,
        )
    return Result(place, kept)


def _task(config: Any, overrides: Any) -> tuple[Task, Path | None, list[str]]:
    changes = _overrides(overrides)
    if isinstance(config, Task | Mapping) and changes:
        raise UsageError("run: overrides are for a file; change the mapping itself")
    if isinstance(config, Task):
        return config, None, []
    if isinstance(config, Mapping):
        task: Task = validate(plain(config), TaskConfig, "run", Path.cwd())
        return task, None, []
    if isinstance(config, str | Path):
        file = path(config, "run")
        loaded: Task = load_config(file, changes, TaskConfig)
        return loaded, file, changes
    raise UsageError(
        f"run: expected the path of a YAML file, a mapping or a task, given {described(config)}"
    )


def _overrides(given: Any) -> list[str]:
    if isinstance(given, Mapping):
        return [f"{key}={json.dumps(plain(value))}" for key, value in given.items()]
    if isinstance(given, list | tuple) and all(isinstance(text, str) for text in given):
        return list(given)
    raise UsageError(f"run: overrides: expected a list or a mapping, given {described(given)}")


def autopilot(
    vessel: str,
    rudder: float | str,
    *,
    test: Mapping[str, Any],
    policies: Mapping[str, Any],
    peers: Mapping[str, Any] | None = None,
    folder: PathGiven | None = None,
    name: str = "autopilot",
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> Result:
    """Train heading autopilots through a vessel and compare them with tuned classical controllers.

    The arguments are the keys of a config of the task `autopilot`, and give the same numbers.

    Args:
        vessel: name of a vessel, or path of its file.
        rudder: largest rudder angle that controllers may use, in rad or with a unit.
        test: the step of heading that all are compared in: heading, band, duration and so on.
        policies: neural policies by name, with their settings; an empty mapping for the defaults.
        peers: classical controllers by name: a kind such as `pd`, or settings.
        folder: where the run is kept; without one it vanishes with the result.
        name: of the run.
        progress: is told how far the training is.
        settings: further keys: spread, predictive, floor, tuning_points, seed, turning_time.

    Raises:
        ConfigError: where a setting is wrong.

    Example:
        residnet.autopilot("nomoto_oceanos", "5 deg", test={"duration": 12}, policies={"mine": {}})
    """
    config = {
        "task": "autopilot",
        "name": name,
        "vessel": vessel,
        "rudder": rudder,
        "test": test,
        "policies": policies,
        "peers": {
            peer: {"kind": given} if isinstance(given, str) else given
            for peer, given in (peers or {}).items()
        },
        **settings,
    }
    return run(config, folder=folder, progress=progress)

"""Tasks in Python, configs of parts by name, and simulated sea trials."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final, get_args

from residnet.api.models import Model, load
from residnet.api.values import (
    PartLike,
    PathLikeArg,
    describe_type,
    forward_progress,
    parse_part,
    parse_path,
    to_builtin,
)
from residnet.baselines import BaselineConfig
from residnet.baselines.config import IdentifiedConfig
from residnet.core.config import load_config, validate_config
from residnet.core.errors import UsageError
from residnet.core.files import read_json, read_table
from residnet.core.log import Log
from residnet.core.names import suggest_name
from residnet.core.ownership import read_regular_file, require_inside, resolve_name
from residnet.core.progress import ProgressCallback
from residnet.core.run_loader import SIZE_LIMITS
from residnet.core.run_records import SummaryFile
from residnet.core.trust import trusting
from residnet.evaluation.booklet import build_index_rows
from residnet.evaluation.metrics_file import build_metrics_table
from residnet.heads import HeadConfig
from residnet.heads.config import FeatureConfig
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.manoeuvres.trials import ManoeuvreRun
from residnet.physics.vessel import load_vessel
from residnet.physics.vessel_file import VesselFile
from residnet.runs.folder import RunFolder
from residnet.runs.task import Task
from residnet.tasks.registry import TaskConfig, list_catalogue
from residnet.tasks.simulate.config import Programme
from residnet.tasks.simulate.execute import build_crafts, simulate_all

if TYPE_CHECKING:
    import pandas as pd

PartKind = Literal["vessels", "heads", "baselines", "manoeuvres", "readers", "tasks", "formats"]


def list_available(part_kind: PartKind) -> pd.DataFrame:
    """Return a table of the available parts of a kind, with columns name and about.

    Args:
        part_kind: vessels, heads, baselines, manoeuvres, readers, tasks or formats (of exports).

    Raises:
        UsageError: if there is no such kind of part.

    Example:
        residnet.list_available("heads")
    """
    import pandas as pd

    if part_kind not in get_args(PartKind):
        raise UsageError(
            f"list_available: there are no"
            f" '{part_kind}'{suggest_name(str(part_kind), get_args(PartKind))}"
        )
    return pd.DataFrame(list_catalogue(part_kind), columns=["name", "about"])


def head(kind: PartLike, *, trust: bool = False, **settings: Any) -> FeatureConfig:
    """Return the config of a residual head, for `fit`.

    Args:
        kind: one of `list_available("heads")`.
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.
        settings: settings of the head, as in YAML.

    Raises:
        ConfigError: if there is no such kind, or a setting is wrong.

    Example:
        residnet.head("lstm", hidden_size=16)
    """
    with trusting(trust):
        config: FeatureConfig = validate_config(
            parse_part(kind, "head", **settings), HeadConfig, "head"
        )
        return config


def baseline(kind: PartLike, **settings: Any) -> IdentifiedConfig:
    """Return the config of a baseline, for `fit`.

    Args:
        kind: one of `list_available("baselines")`.
        settings: settings of the baseline, as in YAML.

    Raises:
        ConfigError: if there is no such kind, or a setting is wrong.

    Example:
        residnet.baseline("regressors", sets=["fossen"])
    """
    baseline_settings = parse_part(kind, "baseline", **settings)
    config: IdentifiedConfig = validate_config(baseline_settings, BaselineConfig, "baseline")
    return config


def manoeuvre(kind: PartLike, **settings: Any) -> Manoeuvre:
    """Return a manoeuvre by its kind and settings, for `simulate`.

    Args:
        kind: one of `list_available("manoeuvres")`.
        settings: settings of the manoeuvre; numbers in SI, or texts with a unit such as "20 deg".

    Raises:
        ConfigError: if there is no such kind, or a setting is wrong.

    Example:
        residnet.manoeuvre("zigzag", drive=0.6, steer=0.4, heading="20 deg")
    """
    config: Manoeuvre = validate_config(
        parse_part(kind, "manoeuvre", **settings), ManoeuvreConfig, "manoeuvre"
    )
    return config


def vessel(name: str) -> VesselFile:
    """Return the parameters of a vessel in SI units, each with its source.

    Args:
        name: one of `list_available("vessels")`, or the path of a YAML file.

    Raises:
        ConfigError: if there is no such vessel or its file is wrong.

    Example:
        residnet.vessel("wam_v_cal").length.value
    """
    if not isinstance(name, str):
        raise UsageError(f"vessel: expected a name or path, given {describe_type(name)}")
    return load_vessel(name)


@final
class SimulationResult:
    """Simulated sea trials.

    Attributes:
        logs: simulated measurements, one log for each manoeuvre; the logs of a learned model follow
            those of the vessel.
        motions: the simulated motions without noise.
        indices: one row for each simulated manoeuvre: log, manoeuvre, craft (vessel or learned
            model), fault (why it did not end as intended), then manoeuvring indices in SI and rad.
            An index is missing if the log is too short for it.

    Example:
        trials.indices[["log", "first_overshoot"]]
    """

    def __init__(self, simulated_runs: Sequence[ManoeuvreRun], indices: pd.DataFrame) -> None:
        self.logs: list[Log] = [simulated_run.measured_log for simulated_run in simulated_runs]
        self.motions: list[Log] = [simulated_run.true_log for simulated_run in simulated_runs]
        self.indices = indices

    def __repr__(self) -> str:
        return f"SimulationResult({len(self.logs)} logs)"


def simulate(
    vessel: str | None = None,
    manoeuvres: PartLike | Sequence[PartLike] = (),
    *,
    families: PartLike | Sequence[PartLike] = (),
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> SimulationResult:
    """Simulate manoeuvres of a vessel, a learned model, or both.

    The arguments are the keys of `programme` in a config of the task `simulate`, with the same
    numerical results.

    Args:
        vessel: name of a vessel, or path of its file.
        manoeuvres: manoeuvres, each a kind with settings, or a config object.
        families: families from which further manoeuvres are drawn at random by `seed`.
        progress: called with the progress of the simulation.
        settings: further keys of `programme`, as in YAML: model, duration, step, substeps,
            noise, disturbance, initial, length, reader, seed.

    Raises:
        ConfigError: if a setting is wrong, or the vessel cannot perform a manoeuvre.
        DataError: if a motion is not finite after its first step.

    Example:
        trials = residnet.simulate("wam_v_cal", {"kind": "zigzag", "drive": 0.6, "steer": 0.4,
                                                 "heading": "20 deg"}, duration=60)
    """
    import pandas as pd

    programme_settings: dict[str, Any] = {"vessel": vessel, **settings}
    manoeuvre_parts: dict[str, Any] = {"manoeuvres": manoeuvres, "families": families}
    for key, entries in manoeuvre_parts.items():
        entry_list = entries if isinstance(entries, list | tuple) else [entries]
        programme_settings[key] = [parse_part(entry, key) for entry in entry_list]
    settings_without_none = {
        name: value for name, value in programme_settings.items() if value is not None
    }
    programme: Programme = validate_config(to_builtin(settings_without_none), Programme, "simulate")
    simulated_runs = []
    rows = []
    with forward_progress(progress):
        for craft, environment in build_crafts(programme):
            runs_of_craft = simulate_all(programme, craft, environment)
            simulated_runs += runs_of_craft
            rows += build_index_rows(craft, runs_of_craft, programme.hull_length)
    flat_rows = [
        {
            "log": row.log,
            "manoeuvre": row.manoeuvre,
            "craft": row.craft,
            "fault": row.fault,
            **row.indices,
        }
        for row in rows
    ]
    return SimulationResult(simulated_runs, pd.DataFrame(flat_rows))


@final
class RunResult:
    """The results of a run of any task.

    If the run had no folder, its files are deleted together with this object.

    Attributes:
        folder: the run folder.
    """

    def __init__(
        self, folder: Path, temporary_folder: tempfile.TemporaryDirectory[str] | None
    ) -> None:
        self.folder = folder
        self._temporary_folder = temporary_folder

    @cached_property
    def summary(self) -> SummaryFile:
        """Task, verdict, and main figures with their units (summary.json)."""
        return RunFolder(self.folder).read_summary()

    @property
    def verdict(self) -> list[str]:
        """The verdict in complete sentences."""
        return list(self.summary.verdict)

    @cached_property
    def metrics(self) -> pd.DataFrame:
        """Rows of metrics.json as a table.

        Raises:
            UsageError: if the task has no metrics.
        """
        import pandas as pd

        run = RunFolder(self.folder)
        if self.summary.task == "fit":
            return build_metrics_table(run.read_metrics().rows)
        # the rows of other tasks have other columns
        return pd.json_normalize(read_json(run.metrics)["rows"])

    @property
    def file_names(self) -> list[str]:
        """Paths of all files of the run, relative to its folder, for `read_file`."""
        all_paths = sorted(self.folder.rglob("*"))
        return [str(file.relative_to(self.folder)) for file in all_paths if file.is_file()]

    def read_file(self, name: str) -> Any:
        """Return the contents of a file: a table for Parquet, values for JSON, else text.

        Args:
            name: name of the file, one of `file_names`.

        Raises:
            UsageError: if there is no such file, or it is not text, JSON or Parquet.

        Example:
            result.read_file("indices.json")["rows"]
        """
        file = resolve_name(self.folder, name)
        if not file.is_file():
            raise UsageError(
                f"{self.folder}: no file '{name}'{suggest_name(str(name), self.file_names)}"
            )
        if file.suffix == ".parquet":
            return read_table(file)
        try:
            require_inside(self.folder, file)
            text = read_regular_file(file, SIZE_LIMITS[".json"]).decode("utf-8")
            return json.loads(text) if file.suffix == ".json" else text
        except (OSError, ValueError, RecursionError) as error:
            raise UsageError(
                f"{file}: not readable ({error}); restore it, or repeat the run"
            ) from error

    def load_model(self, name: str = "predictor", *, trust: bool = False) -> Model:
        """Load a model of a fit.

        Args:
            name: name of the model; `predictor` is the model reported first.
            trust: see `load`.

        Raises:
            UsageError: if the run has no such model.
        """
        return load(self.folder, name, trust=trust)

    def __repr__(self) -> str:
        return f"RunResult({self.summary.task}, {self.folder})"


def run(
    config: PathLikeArg | Mapping[str, Any] | Task,
    *,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    folder: PathLikeArg | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: bool = True,
    trust: bool = False,
    progress: ProgressCallback | None = None,
) -> RunResult:
    """Run any task, with the same numerical results as the command line.

    Args:
        config: path of a YAML file, its content as a mapping, or the config object of a task.
            Relative paths in a file are relative to its folder, paths in a mapping to the current
            folder.
        overrides: overrides of single keys of a file: texts such as `heads.lstm.hidden_size=16` (or
            `~key`, which removes a key), or a mapping from dotted keys to values.
        folder: run folder; None for a temporary folder, which is deleted together with the
            result.
        resume: continue an interrupted run in its folder.
        overwrite: replace an earlier run in its folder.
        report: write report and exports; if False, the run ends after its results.
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.
        progress: called with the progress of the run.

    Raises:
        ConfigError: if the config is wrong.
        ResidnetError: if the data do not suffice for the task, or a result fails a check.

    Example:
        result = residnet.run("quickstart.yaml", overrides={"seed": 3}); result.metrics
    """
    with trusting(trust):
        override_texts = _parse_overrides(overrides)
        source = None
        task = config
        if isinstance(config, Task | Mapping) and override_texts:
            raise UsageError("run: overrides are for a file; change the mapping itself")
        if isinstance(config, Mapping):
            task = validate_config(to_builtin(config), TaskConfig, "run", Path.cwd())
        elif isinstance(config, str | Path):
            source = parse_path(config, "run")
            task = load_config(source, override_texts, TaskConfig)
        if not isinstance(task, Task):
            raise UsageError(
                "run: expected the path of a YAML file, a mapping or a task, given"
                f" {describe_type(config)}"
            )
        temporary_folder = (
            None if folder is not None else tempfile.TemporaryDirectory(prefix="residnet-")
        )
        folder_path = (
            parse_path(folder, "run: folder")
            if temporary_folder is None
            else Path(temporary_folder.name) / task.name
        )
        with forward_progress(progress):
            task.run(
                source=source,
                overrides=override_texts,
                output_folder=folder_path,
                resume=resume,
                overwrite=overwrite,
                report=report,
            )
        return RunResult(folder_path, temporary_folder)


def _parse_overrides(overrides: Any) -> list[str]:
    if isinstance(overrides, Mapping):
        return [f"{key}={json.dumps(to_builtin(value))}" for key, value in overrides.items()]
    if isinstance(overrides, list | tuple) and all(isinstance(text, str) for text in overrides):
        return list(overrides)
    raise UsageError(
        f"run: overrides: expected a list or a mapping, given {describe_type(overrides)}"
    )

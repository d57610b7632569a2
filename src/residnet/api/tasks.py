"""Any task from Python, what there is to choose from, and sea trials of vessels by name."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final, get_args

from residnet.api.models import Model, load
from residnet.api.values import PartGiven, PathGiven, described, hearing, part, path, plain
from residnet.baselines import BaselineConfig
from residnet.baselines.base import IdentifiedConfig
from residnet.core.config import load_config, validate
from residnet.core.errors import UsageError
from residnet.core.files import read_table
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.core.ownership import read_regular, require_inside, resolve_name
from residnet.core.progress import ProgressCallback
from residnet.core.run_loader import SIZE_LIMITS
from residnet.core.trust import trusting
from residnet.data.simulated import Flight
from residnet.heads import HeadConfig
from residnet.heads.base import FeatureConfig
from residnet.judge.booklet import index_rows
from residnet.judge.metrics import metrics_table
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.physics.vessel import load_vessel
from residnet.physics.vessel_file import VesselFile
from residnet.runs.folder import RunFolder
from residnet.runs.task import Task
from residnet.tasks.own_autopilot import draft_autopilot
from residnet.tasks.registry import TaskConfig, catalogue
from residnet.tasks.simulate import Programme

if TYPE_CHECKING:
    import pandas as pd

What = Literal["vessels", "heads", "baselines", "manoeuvres", "readers", "tasks", "formats"]


def available(what: What) -> pd.DataFrame:
    """Return what there is to choose from, parts of other packages included: name and about.

    Args:
        what: vessels, heads, baselines, manoeuvres, readers, tasks or formats (of exports).

    Raises:
        UsageError: where it is none of these.

    Example:
        residnet.available("heads")
    """
    import pandas as pd

    if what not in get_args(What):
        raise UsageError(f"available: there are no '{what}'{nearest(str(what), get_args(What))}")
    return pd.DataFrame(catalogue(what), columns=["name", "about"])


def head(kind: PartGiven, *, trust: bool = False, **settings: Any) -> FeatureConfig:
    """Return the config of a residual head, for `fit`.

    Args:
        kind: one of `available("heads")`.
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.
        settings: of the head, as YAML has them.

    Raises:
        ConfigError: where there is no such kind, or a setting is wrong.

    Example:
        residnet.head("lstm", hidden_size=16)
    """
    with trusting(trust):
        config: FeatureConfig = validate(part(kind, "head", **settings), HeadConfig, "head")
        return config


def baseline(kind: PartGiven, **settings: Any) -> IdentifiedConfig:
    """Return the config of a baseline, for `fit`.

    Args:
        kind: one of `available("baselines")`.
        settings: of the baseline, as YAML has them.

    Raises:
        ConfigError: where there is no such kind, or a setting is wrong.

    Example:
        residnet.baseline("regressors", sets=["fossen"])
    """
    given = part(kind, "baseline", **settings)
    config: IdentifiedConfig = validate(given, BaselineConfig, "baseline")
    return config


def manoeuvre(kind: PartGiven, **settings: Any) -> Manoeuvre:
    """Return a manoeuvre by its kind and settings, for `simulate`.

    Args:
        kind: one of `available("manoeuvres")`.
        settings: of the manoeuvre; SI numbers, or texts with a unit such as "20 deg".

    Raises:
        ConfigError: where there is no such kind, or a setting is wrong.

    Example:
        residnet.manoeuvre("zigzag", drive=0.6, steer=0.4, heading="20 deg")
    """
    config: Manoeuvre = validate(part(kind, "manoeuvre", **settings), ManoeuvreConfig, "manoeuvre")
    return config


def vessel(name: str) -> VesselFile:
    """Return a vessel by its name or file: particulars in SI, each with its source.

    Args:
        name: one of `available("vessels")`, or the path of a YAML file.

    Raises:
        ConfigError: where there is no such vessel or its file is wrong.

    Example:
        residnet.vessel("wam_v_cal").length.value
    """
    if not isinstance(name, str):
        raise UsageError(f"vessel: expected a name or path, given {described(name)}")
    return load_vessel(name)


@final
class Trials:
    """Sea trials that were flown.

    Attributes:
        logs: what sensors measured, one log for each manoeuvre; those of a learned model follow
            those of a vessel.
        motions: the motions themselves, without noise.
        indices: one row for each flight: log, manoeuvre, craft, fault, then manoeuvring indices in
            SI and rad; those that a flight is too short for are missing.

    Example:
        trials.indices[["log", "first_overshoot"]]
    """

    def __init__(self, flights: Sequence[Flight], indices: pd.DataFrame) -> None:
        self.logs: list[Log] = [flight.log for flight in flights]
        self.motions: list[Log] = [flight.motion for flight in flights]
        self.indices = indices

    def __repr__(self) -> str:
        return f"Trials({len(self.logs)} logs)"


def simulate(
    vessel: str | None = None,
    manoeuvres: PartGiven | Sequence[PartGiven] = (),
    *,
    families: PartGiven | Sequence[PartGiven] = (),
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> Trials:
    """Fly manoeuvres with a vessel, a learned model, or both.

    The arguments are the keys of `programme` in a config of the task `simulate`, and give the same
    logs.

    Args:
        vessel: name of a vessel, or path of its file.
        manoeuvres: each a kind with settings, or a config object.
        families: further ones drawn at random by `seed`.
        progress: is told about the work.
        settings: further keys of `programme`, as YAML has them: model, duration, step, substeps,
            noise, disturbance, initial, length, reader, seed.

    Raises:
        ConfigError: where a setting is wrong, or the vessel cannot fly a manoeuvre.
        DataError: where a motion is not finite from its first step on.

    Example:
        trials = residnet.simulate("wam_v_cal", {"kind": "zigzag", "drive": 0.6, "steer": 0.4,
                                                 "heading": "20 deg"}, duration=60)
    """
    import pandas as pd

    given: dict[str, Any] = {"vessel": vessel, **settings}
    asked: dict[str, Any] = {"manoeuvres": manoeuvres, "families": families}
    for key, parts in asked.items():
        several = parts if isinstance(parts, list | tuple) else [parts]
        given[key] = [part(entry, key) for entry in several]
    known = {name: value for name, value in given.items() if value is not None}
    programme: Programme = validate(plain(known), Programme, "simulate")
    flights, rows = [], []
    with hearing(progress):
        for craft, sea in programme.crafts():
            flown = programme.fly(craft, sea)
            flights += flown
            rows += index_rows(craft, flown, programme.hull_length)
    names = ("log", "manoeuvre", "craft", "fault")
    flat = [{name: row[name] for name in names} | row["indices"] for row in rows]
    return Trials(flights, pd.DataFrame(flat))


@final
class Result:
    """What a run found, of whatever task.

    Where the run was given no folder, its files are kept as long as this object is.

    Attributes:
        folder: where everything stands.
    """

    def __init__(self, folder: Path, kept: tempfile.TemporaryDirectory[str] | None) -> None:
        self.folder, self._kept = folder, kept

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
        file = resolve_name(self.folder, name)
        if not file.is_file():
            raise UsageError(f"{self.folder}: no file '{name}'{nearest(str(name), self.files)}")
        if file.suffix == ".parquet":
            return read_table(file)
        try:
            require_inside(self.folder, file)
            text = read_regular(file, SIZE_LIMITS[".json"]).decode("utf-8")
            return json.loads(text) if file.suffix == ".json" else text
        except (OSError, ValueError, RecursionError) as error:
            raise UsageError(
                f"{file}: not readable ({error}); restore it or run it again"
            ) from error

    def model(self, name: str = "predictor", *, trust: bool = False) -> Model:
        """Return a model of a fit, the one that is reported first where none is named.

        Args:
            name: of the model.
            trust: as of `load`.

        Raises:
            UsageError: where the run has no such model.
        """
        return load(self.folder, name, trust=trust)

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
    trust: bool = False,
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
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.
        progress: is told what is being done, and how far it is.

    Raises:
        ConfigError: where the config is wrong.
        ResidnetError: where the input does not allow it, or a result fails a check.

    Example:
        result = residnet.run("quickstart.yaml", overrides={"seed": 3}); result.metrics
    """
    with trusting(trust):
        changes, source, task = _overrides(overrides), None, config
        if isinstance(config, Task | Mapping) and changes:
            raise UsageError("run: overrides are for a file; change the mapping itself")
        if isinstance(config, Mapping):
            task = validate(plain(config), TaskConfig, "run", Path.cwd())
        elif isinstance(config, str | Path):
            source = path(config, "run")
            task = load_config(source, changes, TaskConfig)
        if not isinstance(task, Task):
            raise UsageError(
                "run: expected the path of a YAML file, a mapping or a task, given"
                f" {described(config)}"
            )
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


def _overrides(given: Any) -> list[str]:
    if isinstance(given, Mapping):
        return [f"{key}={json.dumps(plain(value))}" for key, value in given.items()]
    if isinstance(given, list | tuple) and all(isinstance(text, str) for text in given):
        return list(given)
    raise UsageError(f"run: overrides: expected a list or a mapping, given {described(given)}")


def own_autopilot(
    source: PathGiven | Sequence[PathGiven],
    config: PathGiven = "my_autopilot.yaml",
    *,
    rudder: str | None = None,
    rate: str | None = None,
    speed: str | None = None,
    folder: PathGiven | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> Result:
    """Train a heading autopilot for one's own vessel, as `residnet autopilot` does.

    Args:
        source: logs, the folder of a finished fit, or `K,T` in 1/s and s.
        config: file to write; the vessel's file lies beside it.
        rudder: largest angle that controllers may use, with its unit; None for that of the logs.
        rate: of the steering gear, with its unit; None for what the logs show.
        speed: at which K and T hold, with its unit; None for the mean of the logs.
        folder: where the run is kept; without one it vanishes with the result.
        overwrite: replace earlier files and an earlier run.
        progress: is told how far the training is.

    Raises:
        DataError: where logs lack rudder or yaw rate.
        FitError: where the logs show no answer to the rudder.

    Example:
        residnet.own_autopilot("0.31,7.4", rate="6 deg/s", folder="runs/own")
    """
    given = [source] if isinstance(source, str | PathLike) else source
    told = {"rudder": rudder, "rate": rate, "speed": speed}
    place = path(config, "own_autopilot")
    file = draft_autopilot([str(one) for one in given], place, overwrite=overwrite, **told)
    return run(file, folder=folder, overwrite=overwrite, progress=progress)


def autopilot(
    vessel: str,
    rudder: float | str,
    *,
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
        peers: classical controllers by name: a kind such as `pd`, or settings.
        folder: where the run is kept; without one it vanishes with the result.
        name: of the run.
        progress: is told how far the training is.
        settings: further keys: test, the step of heading that all are compared in; policies,
            learned controllers by name; conditions, predictive, floor, seed and so on.

    Raises:
        ConfigError: where a setting is wrong.

    Example:
        residnet.autopilot("nomoto_oceanos", "5 deg", test={"duration": 12}, conditions={},
                           policies={"mine": {"start": None}})
    """
    given = {
        peer: {"kind": kind} if isinstance(kind, str) else kind
        for peer, kind in (peers or {}).items()
    }
    config = {"task": "autopilot", "name": name, "vessel": vessel, "rudder": rudder}
    return run({**config, "peers": given, **settings}, folder=folder, progress=progress)

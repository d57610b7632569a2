"""Models in Python: stepped and rolled out with arrays, kept, loaded, exported and watched."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
import torch
from torch import Tensor

from residnet.api.data import Data
from residnet.api.values import PathGiven, described, path
from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.files import read_json, staged_files
from residnet.core.ownership import Manifest, recorded_folder
from residnet.core.run_loader import accept_run, name_damaged_key
from residnet.core.trust import trusting
from residnet.dynamics.free_runs import compiled
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.store import ModelSpec, chosen_model, load_model, save_model
from residnet.export import exporter
from residnet.export.base import released
from residnet.export.vessel import ExportedVessel
from residnet.identification.fitter import FittedModel
from residnet.identification.monitoring import MonitorConfig, Verdict, Watch, Watcher
from residnet.identification.recursive_refit import Refit, recursive_refit, refitted
from residnet.judge.band import read_bands
from residnet.judge.verdict import UNSEEN, Evidence, objections
from residnet.runs.folder import require_sealed

if TYPE_CHECKING:
    import pandas as pd


@final
class Model:
    """A fitted model of a vessel: what it is, how it was fitted, and how it moves.

    States are x, y [m], psi [rad], u, v [m/s], r [rad/s], and of a vessel that rolls p [rad/s] and
    phi [rad]; inputs are named by `inputs`. Arrays may
    be of one vessel (no batch axis) or of B; results have the axes that were given.

    Example:
        x, s = model.step([0, 0, 0, 1.2, 0, 0], [20.0, 18.0])

    Attributes:
        fitted: the model with the notes of its fit.
        name: of the model.
        kind: what it is: zero, baseline, head or ensemble.
        spec: everything that determines the model but its numbers.
        module: the PyTorch module itself.
        states: names of the columns of a state.
        inputs: names of the columns of the inputs: commands, then exogenous channels.
        units: SI unit of each state and input.
        dt: time step of the model in s.
        notes: what there is to say about the fit; empty for a model that was saved without a run.
    """

    def __init__(self, fitted: FittedModel) -> None:
        self.fitted, self.name, self.module = fitted, fitted.name, fitted.model
        self.spec: ModelSpec = fitted.spec
        self.kind, self.dt = str(self.spec.role), self.spec.dt
        self.states, self.inputs = self.spec.signals.live.states, self.spec.signals.columns
        self.units = self.spec.signals.units()
        self.notes = dict(fitted.notes)

    @property
    def coefficients(self) -> pd.DataFrame:
        """Identified coefficients: axis, term, value, standard_error; no row where there are none.

        The coefficients are SI.
        """
        import pandas as pd

        columns = ["axis", "term", "value", "standard_error"]
        return pd.DataFrame(self.notes.get("coefficients", []), columns=columns)

    def step(self, x: Any, w: Any, s: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the state and the memory one step later.

        Args:
            x: states [B, 6] or [6].
            w: inputs [B, m] or [m], held over the step.
            s: memory [B, n_state] from the step before or from `warmup`; empty where None.

        Raises:
            UsageError: where a shape does not fit or a number is not finite.

        Example:
            x, s = model.step(x, w, s)
        """
        states, inputs = self._rows(("x", x, 1), ("w", w, 1))
        with torch.no_grad():
            found = self._double().step(states, inputs, self._memory(s, len(states)))
        after, memory = (_back(part, np.ndim(x) == 1) for part in found)
        return after, memory

    def rollout(self, x0: Any, w: Any, s: Any = None) -> np.ndarray:
        """Return the states of a free run from x0 on, [B, T+1, 6] or [T+1, 6].

        Args:
            x0: initial states [B, 6] or [6].
            w: inputs [B, T, m] or [T, m], each held over its step.
            s: memory [B, n_state] from `warmup`; empty where None.

        Raises:
            UsageError: where a shape does not fit or a number is not finite.

        Example:
            track = model.rollout(x0, w)[:, :2]
        """
        states, inputs = self._rows(("x0", x0, 1), ("w", w, 2))
        memory = self._memory(s, len(states))
        with torch.no_grad():
            found, _, _ = compiled(Rollout(self._double()), inputs.shape[1])(states, inputs, memory)
        return _back(found, np.ndim(x0) == 1)

    def warmup(self, y_history: Any, w_history: Any) -> np.ndarray:
        """Return the memory that a measured past leaves, [B, n_state] or [n_state].

        Args:
            y_history: measured states [B, T, 6] or [T, 6], oldest first.
            w_history: inputs [B, T, m] or [T, m] at the same samples.

        Raises:
            UsageError: where a shape does not fit or a number is not finite.

        Example:
            s = model.warmup(log.y[:50], log.w[:50])
        """
        states, inputs = self._rows(("y_history", y_history, 2), ("w_history", w_history, 2))
        if states.shape[1] != inputs.shape[1]:
            raise UsageError(
                f"model {self.name}: y_history has {states.shape[1]} samples, w_history"
                f" {inputs.shape[1]}; give both at the same samples"
            )
        with torch.no_grad():
            return _back(self._double().warmup(states, inputs), np.ndim(y_history) == 2)

    def __repr__(self) -> str:
        return (
            f"Model({self.name!r}, {self.kind}, inputs {', '.join(self.inputs)}, dt {self.dt:g} s)"
        )

    def _double(self) -> HybridDynamics:
        # a copy: float64 arrays must not change the precision of the model itself
        return copy.deepcopy(self.module).to(torch.float64).eval()

    def _rows(self, *given: tuple[str, Any, int]) -> tuple[Tensor, Tensor]:
        """Rows [B, (T,) width] of states and inputs, each by its name, value and axes; float64."""
        out = []
        for (name, value, axes), what in zip(given, ("states", "inputs"), strict=True):
            columns = self.states if what == "states" else self.inputs
            width = len(columns)
            try:
                values = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError):
                raise UsageError(
                    f"model {self.name}: {name}: expected numbers, given {described(value)}"
                ) from None
            if values.ndim not in (axes, axes + 1) or values.shape[-1] != width:
                one = f"T, {width}" if axes == 2 else f"{width}"
                raise UsageError(
                    f"model {self.name}: {name} has the shape {list(values.shape)}, expected"
                    f" [B, {one}] or [{one}] ({what} {', '.join(columns)})"
                )
            if not np.isfinite(values).all():
                raise UsageError(f"model {self.name}: {name} holds a value that is not finite")
            out.append(torch.from_numpy(values if values.ndim == axes + 1 else values[None].copy()))
        states, inputs = out
        if len(states) != len(inputs):
            raise UsageError(
                f"model {self.name}: {len(states)} states, but inputs for {len(inputs)}"
            )
        return states, inputs

    def _memory(self, given: Any, rows: int) -> Tensor:
        width = self.module.n_state
        if given is None:
            return torch.zeros(rows, width, dtype=torch.float64)
        memory = np.atleast_2d(np.asarray(given, dtype=np.float64))
        if memory.shape != (rows, width):
            raise UsageError(
                f"model {self.name}: s has the shape {list(np.shape(given))}, expected"
                f" [{rows}, {width}]"
            )
        return torch.from_numpy(memory)


def _back(values: Tensor, single: bool) -> np.ndarray:
    return (values[0] if single else values).numpy()


def save(model: Model, folder: PathGiven, *, overwrite: bool = False) -> Path:
    """Write a model to a folder and return it; nothing in it runs when it is loaded.

    Args:
        model: to keep.
        folder: `model.json` and `model.safetensors` are written into it.
        overwrite: replace a model that stands there.

    Raises:
        UsageError: where a model stands there already.

    Example:
        residnet.save(models["lstm"], "models/lstm")
    """
    require(model, Model, "save: expected a model")
    place = path(folder, "save")
    if (place / "model.json").exists() and not overwrite:
        raise UsageError(f"{place}: a model stands there already; give overwrite=True")
    if place.exists() and not place.is_dir():
        raise UsageError(f"{place}: is a file, expected a folder")
    manifest = Manifest(place)
    for name in ("model.json", "model.safetensors"):
        manifest.require_replaceable(place / name)
    with recorded_folder(place):
        save_model(place, model.spec, model.module)
    return place


def load(folder: PathGiven, name: str | None = None, *, trust: bool = False) -> Model:
    """Read a model from its folder, or by its name from the folder of a run.

    Args:
        folder: of a model, or of a finished run.
        name: of the model in the run; `selected` is the single one that validation data chose;
            where not given, the one that is reported first.
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.

    Raises:
        UsageError: where there is no such model.

    Example:
        model = residnet.load("runs/quickstart", "selected")
    """
    with trusting(trust), name_damaged_key(path(folder, "load")):
        place = path(folder, "load")
        is_model = (place / "model.json").is_file()
        if name is not None or (not is_model and (place / "models").is_dir()):
            place = place / "models" / chosen_model(place, name or "predictor")
        require_sealed(place)
        spec, module = load_model(place)
        # outside of a run there are neither notes nor bands
        notes, bands = place / "fit.json", place.parent.parent / "bands.json"
        return Model(
            FittedModel(
                spec,
                module,
                read_json(notes) if notes.is_file() else {},
                bands=read_bands(read_json(bands)).get(place.name, {}) if bands.is_file() else {},
            )
        )


def trust(folder: PathGiven) -> list[str]:
    """Accept the folder of a run or model as it stands, as `residnet trust` does.

    Do this only if you trust where it comes from. Its manifest (`checksums.json`) is written anew.

    Args:
        folder: of a run or a single model.

    Returns:
        One line for each file that was new or changed.

    Raises:
        UsageError: if it is no such folder, or holds a link, a device or a file that is too large.

    Example:
        residnet.trust("runs/of_an_earlier_version")
    """
    return accept_run(path(folder, "trust"))


def export_model(
    model: Model,
    file: PathGiven,
    format: str = "torchscript",
    *,
    metrics: Sequence[Mapping[str, Any]] = (),
    anyway: bool = False,
) -> Mapping[str, Any]:
    """Write a model for controllers, after a parity check, and return what its card says.

    Args:
        model: to export.
        file: to write.
        format: one of `available("formats")`.
        metrics: rows of metrics.json. Those of this model stand in the card; those of `zero` and
            of a baseline under the same protocol show whether it is worse than they are.
        anyway: whether a model is wanted that is worse, too; its card says so.

    Raises:
        WithheldError: where it is worse than `zero` or the baseline, but for `anyway`.
        ConfigError: where there is no such format.
        UsageError: where the format cannot hold such a model.
        ExportError: where what was written does not reproduce the model.

    Example:
        card = residnet.export_model(models["lstm"], "lstm.pt")
    """
    require(model, Model, "export_model: expected a model")
    name = model.spec.name
    chosen_format = exporter(format)
    own = [row for row in metrics if row.get("model", name) == name]
    exported = ExportedVessel(model.spec, model.module, own)
    released(exported, _objections(name, metrics), anyway=anyway)
    place = path(file, "export_model")
    with staged_files(place, place.parent.glob("*.masses.yaml")) as staged:
        return chosen_format.export(exported, staged)


def _objections(name: str, metrics: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what rows of metrics.json say against a model, on the data that tell most."""
    whole = [row for row in metrics if row.get("manoeuvre") == "all"]
    splits = [row["split"] for row in whole if row["model"] == name]
    if not splits:
        return []
    split = next((one for one in UNSEEN if one in splits), splits[0])
    judged = [row for row in whole if row["split"] == split]
    rows = {row["model"]: row for row in judged if row["protocol"] == judged[0]["protocol"]}
    baseline = next((row["model"] for row in judged if row["kind"] == "baseline"), "")
    return objections(Evidence(name, split, rows, baseline))


def require(given: Any, kind: type[Any] | tuple[type[Any], ...], expected: str) -> None:
    """Stop where an argument is of another kind.

    Raises:
        UsageError: with what it is instead.
    """
    if not isinstance(given, kind):
        raise UsageError(f"{expected}, given {described(given)}")


@final
class Monitor:
    """A watch over a model in service.

    Short free runs of the model are compared with what is measured. Score tests say whether a
    change of mass, damping, thrust, rudder or of a sensor explains the last minutes better than
    clean logs ever asked for; wind and current have their part taken out first.

    Args:
        model: of the vessel as it was.
        clean: data of the unchanged vessel, as they were fitted.
        settings: of `residnet.identification.monitoring.MonitorConfig`: `window`,
            `stretch`, `false_alarm`, `group` in s.

    Raises:
        UsageError: where an argument is of another kind.
        DataError: where the clean data are too few.

    Example:
        monitor = residnet.Monitor(models["baseline"], data); verdict = monitor.step(y, w)
    """

    def __init__(self, model: Model, clean: Data, **settings: Any) -> None:
        require(model, Model, "Monitor: expected a model")
        require(clean, Data, "Monitor: expected data from residnet.prepare")
        config = validate(settings, MonitorConfig, "Monitor")
        logs = [log for split in ("train", "validation") for log in clean.splits.get(split, ())]
        watch = Watch.of(model.spec, copy.deepcopy(model.module), logs, config)
        self._model, self._watcher = model, Watcher(watch)
        self.verdict: Verdict | None = None

    @property
    def threshold(self) -> float:
        """The score at which a cause raises an alarm."""
        return self._watcher.watch.threshold

    def step(self, y: Sequence[float], w: Sequence[float]) -> Verdict | None:
        """Take one sample, and return the verdict where a window is complete, else None.

        Args:
            y: measured x, y, psi, u, v, r, then p and phi of a model that rolls; psi without jumps.
            w: inputs held over the step after it, in the model's order.
        """
        found = self._watcher.step(np.asarray(y, dtype=float), np.asarray(w, dtype=float))
        self.verdict = found or self.verdict
        return found

    def refit(self, new: Data) -> tuple[Model, Refit]:
        """Put the changes that the monitor names into a copy of the model, log by log.

        The old model stays as it is. Judge both on logs that were not given here, for example by
        `residnet.free_run`, before the new one goes into service.

        Args:
            new: logs of the changed vessel in the order of time, as
                `residnet.prepare(logs, like=data)` gives them.

        Returns:
            The new model, named `<name>_refit`, and what was found: `moved` holds each change with
            size and standard error, `ended` says why no further one was taken. Where `moved` is
            empty the model is as it was.

        Raises:
            UsageError: where the data are of another kind, or the model has no parameters to move.
            DataError: where a log holds no window.
        """
        require(new, Data, "Monitor.refit: expected data from residnet.prepare")
        watch = self._watcher.watch
        windows = [watch.windows(log) for members in new.splits.values() for log in members]
        refit = recursive_refit(watch, windows)
        return Model(refitted(self._model.fitted, refit)), refit

    def restart(self) -> None:
        """Say that the next sample does not follow the last one."""
        self._watcher.restart()

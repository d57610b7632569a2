"""Models in Python: simulation with arrays, saving, loading, export and monitoring."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor, nn

from residnet.api.data import Dataset
from residnet.api.values import PathLikeArg, describe_type, parse_path
from residnet.baselines import BaselineConfig
from residnet.core.config import validate_config
from residnet.core.errors import UsageError
from residnet.core.files import read_json, stage_files
from residnet.core.model_names import BASELINE
from residnet.core.ownership import Manifest, record_folder
from residnet.core.registry import register_kind
from residnet.core.run_loader import accept_run, name_damaged_key
from residnet.core.trust import trusting
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.scaling import ScaleEffects
from residnet.dynamics.store import ModelSpec, load_model, resolve_model_name, save_model
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import Rollout
from residnet.evaluation.band import read_bands
from residnet.evaluation.derivatives import (
    CovarianceNotes,
    DerivativesFile,
    compute_derivatives,
    read_covariance,
)
from residnet.evaluation.records import MetricsRow
from residnet.evaluation.verdict import UNSEEN_SPLITS, VerdictEvidence, list_model_objections
from residnet.export import get_exporter
from residnet.export.base import require_releasable
from residnet.export.vessel import ExportedVessel
from residnet.heads import HeadConfig
from residnet.heads.config import BaseHeadConfig
from residnet.heads.module import register_stored_modules
from residnet.identification.fitter import FittedModel
from residnet.identification.monitoring import (
    ChangeDetector,
    MonitorConfig,
    MonitorVerdict,
    OnlineChangeDetector,
)
from residnet.identification.recursive_refit import (
    RecursiveRefit,
    make_refitted_model,
    refit_recursively,
)
from residnet.identification.scaling import scale_fitted_model
from residnet.physics.similarity import FroudeScaling, Particulars
from residnet.runs.folder import verify_checksums

if TYPE_CHECKING:
    import pandas as pd


@final
class Model:
    """A fitted model of a vessel with the notes of its fit.

    States are x, y [m], psi [rad], u, v [m/s], r [rad/s], and for a vessel that rolls p [rad/s] and
    phi [rad]; `inputs` names the inputs. Arrays have no batch axis (one vessel) or a batch axis of
    B vessels; results have the same axes as the arguments.

    Example:
        x, s = model.step([0, 0, 0, 1.2, 0, 0], [20.0, 18.0])

    Attributes:
        fitted_model: the model with the notes of its fit.
        name: name of the model.
        role: constant_velocity, baseline, head or ensemble.
        spec: settings and structure of the model, without its numerical parameters.
        module: the PyTorch module.
        states: names of the columns of a state.
        inputs: names of the columns of the inputs: commands, then exogenous channels.
        units: SI unit of each state and input.
        dt: time step of the model in s.
        notes: notes of the fit; empty for a model that was saved without a run.
    """

    def __init__(self, fitted_model: FittedModel) -> None:
        self.fitted_model = fitted_model
        self.name = fitted_model.name
        self.module = fitted_model.model
        self.spec: ModelSpec = fitted_model.spec
        self.role = str(self.spec.role)
        self.dt = self.spec.dt
        self.states = self.spec.signals.dof.state_names
        self.inputs = self.spec.signals.input_columns
        self.units = self.spec.signals.channel_units()
        self.notes = dict(fitted_model.notes)

    @property
    def coefficients(self) -> pd.DataFrame:
        """Identified coefficients in SI units: axis, term, value, standard_error.

        The table is empty for a model without coefficients.
        """
        import pandas as pd

        columns = ["axis", "term", "value", "standard_error"]
        return pd.DataFrame(self.notes.get("coefficients", []), columns=columns)

    def derivatives(
        self,
        *,
        order: int = 1,
        scale: float = 1.0,
        density_ratio: float = 1.0,
        **particulars: Any,
    ) -> DerivativesFile:
        """Return the hydrodynamic derivatives of the baseline, in SI and the prime systems.

        Args:
            order: highest order of the Taylor series about straight-ahead motion, 1 to 3.
            scale: length of the target vessel divided by the length of the vessel in the logs
                (Froude's law of similarity).
            density_ratio: ratio of the densities of the water.
            **particulars: `length` and `speed`, and as known `draught`, `beam`, `mass`,
                `centre_of_gravity`, `gyradius`, `density`; texts such as "3.22 m" or SI numbers.

        Raises:
            ConfigError: if a particular is missing or not plausible.
            UsageError: if the model has no baseline with free parameters in u, v and r.

        Example:
            model.derivatives(length="7 m", speed="1.18 m/s").to_text()
        """
        if not isinstance(self.module, HybridDynamics):
            raise UsageError(
                f"model {self.name}: an ensemble has no derivatives; take one of its members"
            )
        covariance, has_correlations = read_covariance(
            CovarianceNotes.model_validate(self.notes), self.module.baseline
        )
        return compute_derivatives(
            self.spec,
            self.module,
            validate_config(particulars, Particulars, "particulars"),
            covariance=covariance,
            has_correlations=has_correlations,
            order=order,
            scale=scale,
            density_ratio=density_ratio,
        )

    def scale(self, scale: float, *, density_ratio: float = 1.0, **effects: Any) -> Model:
        """Return the model of a similar vessel at the same Froude number, such as the ship.

        Coefficients, inputs, time step, ranges and prediction intervals are scaled by Froude's law.

        Args:
            scale: length of the target vessel divided by the length of the vessel in the logs.
            density_ratio: ratio of the densities of the water.
            **effects: full-scale corrections with their `source`: factors `resistance`,
                `propeller` and `rudder` of forces at full scale relative to the scaled ones.

        Raises:
            UsageError: if the model has parts with dimensional constants that cannot be scaled.
            ConfigError: if a factor is not plausible, or has no source.

        Example:
            ship = model.scale(50, density_ratio=1.025)
        """
        return Model(
            scale_fitted_model(
                self.fitted_model,
                FroudeScaling(scale, density_ratio),
                validate_config(effects, ScaleEffects, "scale effects"),
            )
        )

    def step(self, x: Any, w: Any, s: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return state and memory after one time step.

        Args:
            x: states [B, 6] or [6].
            w: inputs [B, m] or [m], held over the step.
            s: memory [B, n_state] of the previous step or from `warmup`; None for zero memory.

        Raises:
            UsageError: if a shape does not fit or a number is not finite.

        Example:
            x, s = model.step(x, w, s)
        """
        states, inputs = self._parse_arrays(("x", x, 1), ("w", w, 1))
        with torch.no_grad():
            step_result = self._double_precision_module().step(
                states, inputs, self._parse_memory(s, len(states))
            )
        next_states, memory = (_to_numpy(array, np.ndim(x) == 1) for array in step_result)
        return next_states, memory

    def rollout(self, x0: Any, w: Any, s: Any = None) -> np.ndarray:
        """Simulate a free run; returns the states [B, T+1, 6] or [T+1, 6].

        Args:
            x0: initial states [B, 6] or [6].
            w: inputs [B, T, m] or [T, m], each held over its step.
            s: memory [B, n_state] from `warmup`; None for zero memory.

        Raises:
            UsageError: if a shape does not fit or a number is not finite.

        Example:
            track = model.rollout(x0, w)[:, :2]
        """
        states, inputs = self._parse_arrays(("x0", x0, 1), ("w", w, 2))
        memory = self._parse_memory(s, len(states))
        with torch.no_grad():
            trajectory, _, _ = compile_rollout(
                Rollout(self._double_precision_module()), inputs.shape[1]
            )(states, inputs, memory)
        return _to_numpy(trajectory, np.ndim(x0) == 1)

    def warmup(self, y_history: Any, w_history: Any) -> np.ndarray:
        """Return the memory after a measured past, [B, n_state] or [n_state].

        Args:
            y_history: measured states [B, T, 6] or [T, 6], oldest first.
            w_history: inputs [B, T, m] or [T, m] at the same samples.

        Raises:
            UsageError: if a shape does not fit or a number is not finite.

        Example:
            s = model.warmup(log.y[:50], log.w[:50])
        """
        states, inputs = self._parse_arrays(
            ("y_history", y_history, 2), ("w_history", w_history, 2)
        )
        if states.shape[1] != inputs.shape[1]:
            raise UsageError(
                f"model {self.name}: y_history has {states.shape[1]} samples, w_history"
                f" {inputs.shape[1]}; give both at the same samples"
            )
        with torch.no_grad():
            return _to_numpy(
                self._double_precision_module().warmup(states, inputs), np.ndim(y_history) == 2
            )

    def __repr__(self) -> str:
        return (
            f"Model({self.name!r}, {self.role}, inputs {', '.join(self.inputs)}, dt {self.dt:g} s)"
        )

    def _double_precision_module(self) -> HybridDynamics:
        # a copy: float64 arrays must not change the precision of the model itself
        return copy.deepcopy(self.module).to(torch.float64).eval()

    def _parse_arrays(self, *named_arrays: tuple[str, Any, int]) -> tuple[Tensor, Tensor]:
        """Check states and inputs (name, value, axes), and return float64 [B, (T,) width]."""
        tensors = []
        for (name, value, axes), array_kind in zip(named_arrays, ("states", "inputs"), strict=True):
            columns = self.states if array_kind == "states" else self.inputs
            width = len(columns)
            try:
                values = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError):
                raise UsageError(
                    f"model {self.name}: {name}: expected numbers, given {describe_type(value)}"
                ) from None
            if values.ndim not in (axes, axes + 1) or values.shape[-1] != width:
                expected_shape = f"T, {width}" if axes == 2 else f"{width}"
                raise UsageError(
                    f"model {self.name}: {name} has the shape {list(values.shape)}, expected"
                    f" [B, {expected_shape}] or [{expected_shape}] ({array_kind}"
                    f" {', '.join(columns)})"
                )
            if not np.isfinite(values).all():
                raise UsageError(f"model {self.name}: {name} contains a value that is not finite")
            tensors.append(
                torch.from_numpy(values if values.ndim == axes + 1 else values[None].copy())
            )
        states, inputs = tensors
        if len(states) != len(inputs):
            raise UsageError(
                f"model {self.name}: {len(states)} states, but inputs for {len(inputs)}"
            )
        return states, inputs

    def _parse_memory(self, value: Any, batch_size: int) -> Tensor:
        width = self.module.n_state
        if value is None:
            return torch.zeros(batch_size, width, dtype=torch.float64)
        memory = np.atleast_2d(np.asarray(value, dtype=np.float64))
        if memory.shape != (batch_size, width):
            raise UsageError(
                f"model {self.name}: s has the shape {list(np.shape(value))}, expected"
                f" [{batch_size}, {width}]"
            )
        return torch.from_numpy(memory)


def _to_numpy(values: Tensor, is_single: bool) -> np.ndarray:
    return (values[0] if is_single else values).numpy()


def save(model: Model, folder: PathLikeArg, *, overwrite: bool = False) -> Path:
    """Save a model to a folder; returns the folder.

    The files contain data only: no code runs when the model is loaded.

    Args:
        model: the model.
        folder: folder for `model.json` and `model.safetensors`.
        overwrite: replace an existing model.

    Raises:
        UsageError: if the folder already contains a model.

    Example:
        residnet.save(models["lstm"], "models/lstm")
    """
    require_instance(model, Model, "save: expected a model")
    model_folder = parse_path(folder, "save")
    if (model_folder / "model.json").exists() and not overwrite:
        raise UsageError(f"{model_folder}: already contains a model; give overwrite=True")
    if model_folder.exists() and not model_folder.is_dir():
        raise UsageError(f"{model_folder}: is a file, expected a folder")
    manifest = Manifest(model_folder)
    for name in ("model.json", "model.safetensors"):
        manifest.require_replaceable(model_folder / name)
    with record_folder(model_folder):
        save_model(model_folder, model.spec, model.module)
    return model_folder


def load(
    folder: PathLikeArg,
    name: str | None = None,
    *,
    trust: bool = False,
    parts: Sequence[nn.Module | BaseModel] = (),
) -> Model:
    """Load a model from its folder, or by its name from the folder of a run.

    Args:
        folder: folder of a model, or of a finished run.
        name: name of the model in the run; `selected` is the single model chosen on validation
            data; None for the model reported first.
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.
        parts: modules and config objects of your own that were passed to the fit as heads or
            baselines. A stored model has their weights and settings, but no code.

    Raises:
        UsageError: if there is no such model.
        ConfigError: if the model contains a module that `parts` lacks.

    Example:
        model = residnet.load("runs/quickstart", "selected")
    """
    with trusting(trust), name_damaged_key(parse_path(folder, "load")):
        model_folder = parse_path(folder, "load")
        is_model = (model_folder / "model.json").is_file()
        if name is not None or (not is_model and (model_folder / "models").is_dir()):
            model_folder = (
                model_folder / "models" / resolve_model_name(model_folder, name or "predictor")
            )
        verify_checksums(model_folder)
        for part in parts:
            if isinstance(part, BaseHeadConfig):
                register_kind(HeadConfig, type(part))
            elif isinstance(part, BaseModel):
                register_kind(BaselineConfig, type(part))
        modules = [part for part in parts if isinstance(part, nn.Module)]
        if modules:
            register_stored_modules(read_json(model_folder / "model.json"), modules)
        spec, module = load_model(model_folder)
        # a model saved outside of a run has neither notes nor bands
        notes = model_folder / "fit.json"
        return Model(
            FittedModel(
                spec,
                module,
                read_json(notes) if notes.is_file() else {},
                bands=read_bands(model_folder.parent.parent, model_folder.name),
            )
        )


def trust(folder: PathLikeArg) -> list[str]:
    """Accept the present files of a run or model folder, as `residnet trust` does.

    Do this only if you trust the source of the folder. Its manifest (`checksums.json`) is
    rewritten.

    Args:
        folder: folder of a run or of a single model.

    Returns:
        One line for each file that was new or changed.

    Raises:
        UsageError: if it is not such a folder, or contains a link, a device or a file that is too
            large.

    Example:
        residnet.trust("runs/of_an_earlier_version")
    """
    return accept_run(parse_path(folder, "trust"))


def export_model(
    model: Model,
    file: PathLikeArg,
    format: str = "torchscript",
    *,
    metrics: Sequence[MetricsRow] = (),
    allows_objections: bool = False,
) -> Mapping[str, Any]:
    """Export a model for controllers after a parity check; returns the model card.

    Args:
        model: the model.
        file: file to write.
        format: one of `list_available("formats")`.
        metrics: rows of `FreeRuns.rows`. The rows of this model are copied to the model card; the
            rows of `constant_velocity` and of a baseline under the same protocol are its reference.
        allows_objections: export the model even if it is worse than its reference; the model card
            states this.

    Raises:
        WithheldError: if the model is worse than `constant_velocity` or the baseline, and
            `allows_objections` is False.
        ConfigError: if there is no such format.
        UsageError: if the format does not support the model.
        ExportError: if the written file does not reproduce the model.

    Example:
        card = residnet.export_model(models["lstm"], "lstm.pt")
    """
    require_instance(model, Model, "export_model: expected a model")
    name = model.spec.name
    chosen_format = get_exporter(format)
    model_rows = [row for row in metrics if row.model == name]
    exported = ExportedVessel(model.spec, model.module, model_rows)
    require_releasable(
        exported, _find_objections(name, metrics), allows_objections=allows_objections
    )
    place = parse_path(file, "export_model")
    with stage_files(place, place.parent.glob("*.masses.yaml")) as staged:
        return chosen_format.export(exported, staged)


def _find_objections(name: str, metrics: Sequence[MetricsRow]) -> list[str]:
    """Return the objections against a model from rows of metrics.json, on unseen data if any."""
    all_manoeuvre_rows = [row for row in metrics if row.manoeuvre == "all"]
    splits = [row.split for row in all_manoeuvre_rows if row.model == name]
    if not splits:
        return []
    split = next(
        (candidate_split for candidate_split in UNSEEN_SPLITS if candidate_split in splits),
        splits[0],
    )
    split_rows = [row for row in all_manoeuvre_rows if row.split == split]
    rows = {row.model: row for row in split_rows if row.protocol == split_rows[0].protocol}
    baseline = next((row.model for row in split_rows if row.kind == BASELINE), "")
    return list_model_objections(VerdictEvidence(name, split, rows, baseline))


def require_instance(
    value: Any, expected_type: type[Any] | tuple[type[Any], ...], expected: str
) -> None:
    """Check the type of an argument.

    Args:
        value: the argument.
        expected_type: expected type or types of the value.
        expected: begin of the error message.

    Raises:
        UsageError: if the argument has another type.
    """
    if not isinstance(value, expected_type):
        raise UsageError(f"{expected}, given {describe_type(value)}")


@final
class Monitor:
    """Online change detection for a model in service.

    Short free runs of the model are compared with measurements. Score tests decide whether a change
    of mass, damping, thrust, rudder or a sensor explains the innovations of the last minutes; the
    threshold is calibrated on reference data. The effects of wind and current are removed first.

    Args:
        model: model of the unchanged vessel.
        reference_data: data of the unchanged vessel, such as the data of the fit.
        settings: keys of `residnet.identification.monitoring.MonitorConfig`: `window`,
            `stretch`, `false_alarm`, `group` in s.

    Raises:
        UsageError: if an argument has a wrong type.
        DataError: if there are too few reference data.

    Example:
        monitor = residnet.Monitor(models["baseline"], data); verdict = monitor.step(y, w)
    """

    def __init__(self, model: Model, reference_data: Dataset, **settings: Any) -> None:
        require_instance(model, Model, "Monitor: expected a model")
        require_instance(reference_data, Dataset, "Monitor: expected data from residnet.prepare")
        config = validate_config(settings, MonitorConfig, "Monitor")
        logs = [
            log for split in ("train", "validation") for log in reference_data.splits.get(split, ())
        ]
        change_detector = ChangeDetector.from_logs(
            model.spec, copy.deepcopy(model.module), logs, config
        )
        self._model = model
        self._detector = OnlineChangeDetector(change_detector)
        self.verdict: MonitorVerdict | None = None

    @property
    def threshold(self) -> float:
        """Score above which a change raises an alarm."""
        return self._detector.detector.threshold

    def step(self, y: Sequence[float], w: Sequence[float]) -> MonitorVerdict | None:
        """Process one sample; returns the verdict if it completes a window, else None.

        Args:
            y: measured x, y, psi, u, v, r, then p and phi for a model with roll; psi unwrapped.
            w: inputs held over the following step, in the order of the model.
        """
        new_verdict = self._detector.update(np.asarray(y, dtype=float), np.asarray(w, dtype=float))
        self.verdict = new_verdict or self.verdict
        return new_verdict

    def refit(self, new_data: Dataset) -> tuple[Model, RecursiveRefit]:
        """Apply the detected changes to a copy of the model, estimated recursively log by log.

        The original model is not changed. Evaluate both models on other logs, for example with
        `residnet.free_run`, before the new one goes into service.

        Args:
            new_data: logs of the changed vessel in chronological order, from
                `residnet.prepare(logs, settings_from=data)`.

        Returns:
            The new model, named `<name>_refit`, and the result of the refit with each identified
            change, its size and standard error. Without a change the model equals the original.

        Raises:
            UsageError: if the data have a wrong type, or the model has no parameters to change.
            DataError: if a log contains no window.
        """
        require_instance(new_data, Dataset, "Monitor.refit: expected data from residnet.prepare")
        change_detector = self._detector.detector
        windows = [
            change_detector.make_windows(log)
            for members in new_data.splits.values()
            for log in members
        ]
        recursive_result = refit_recursively(change_detector, windows)
        return Model(
            make_refitted_model(self._model.fitted_model, recursive_result)
        ), recursive_result

    def restart(self) -> None:
        """Start a new log: the next sample does not follow the previous one."""
        self._detector.start_new_log()

"""Models in Python: stepped and rolled out with arrays, kept, loaded and exported."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
import torch
from torch import Tensor

from residnet.api.values import PathGiven, described, path
from residnet.core.errors import UsageError
from residnet.core.files import read_json
from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout, scripted
from residnet.dynamics.store import ModelSpec, chosen_model, load_model, save_model
from residnet.export import exporter
from residnet.export.vessel import ExportedVessel
from residnet.identification.models import FittedModel
from residnet.judge.band import Band, read_bands
from residnet.runs.folder import require_sealed, seal

if TYPE_CHECKING:
    import pandas as pd


@final
class Model:
    """A fitted model of a vessel: what it is, how it was fitted, and how it moves.

    States are x, y [m], psi [rad], u, v [m/s], r [rad/s]; inputs are named by `inputs`. Arrays may
    be of one vessel (no batch axis) or of B; results have the axes that were given.

    Example:
        x, s = model.step([0, 0, 0, 1.2, 0, 0], [20.0, 18.0])
    """

    def __init__(self, fitted: FittedModel) -> None:
        self.fitted = fitted

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.fitted.name

    @property
    def kind(self) -> str:
        """What it is: zero, baseline, head or ensemble."""
        return self.spec.role

    @property
    def spec(self) -> ModelSpec:
        """Everything that determines the model but its numbers."""
        return self.fitted.spec

    @property
    def module(self) -> HybridDynamics:
        """The PyTorch module itself."""
        return self.fitted.model

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the columns of a state."""
        return STATE

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the columns of the inputs: commands, then exogenous channels."""
        return self.spec.signals.columns

    @property
    def units(self) -> dict[str, str]:
        """SI unit of each state and input."""
        return self.spec.signals.units()

    @property
    def dt(self) -> float:
        """Time step of the model in s."""
        return self.spec.dt

    @property
    def notes(self) -> dict[str, Any]:
        """What there is to say about the fit; empty for a model that was saved without a run."""
        return dict(self.fitted.notes)

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
        single = np.ndim(x) == 1
        states = self._array(x, len(STATE), "x", "states", 1)
        inputs = self._array(w, len(self.inputs), "w", "inputs", 1)
        self._same_rows(states, inputs)
        memory = self._memory(s, len(states))
        model = self._double()
        with torch.no_grad():
            after, memory = model.step(states, inputs, memory)
        return _back(after, single), _back(memory, single)

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
        single = np.ndim(x0) == 1
        states = self._array(x0, len(STATE), "x0", "states", 1)
        inputs = self._array(w, len(self.inputs), "w", "inputs", 2)
        self._same_rows(states, inputs)
        memory = self._memory(s, len(states))
        with torch.no_grad():
            found, _, _ = scripted(Rollout(self._double()), inputs.shape[1])(states, inputs, memory)
        return _back(found, single)

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
        single = np.ndim(y_history) == 2
        states = self._array(y_history, len(STATE), "y_history", "states", 2)
        inputs = self._array(w_history, len(self.inputs), "w_history", "inputs", 2)
        self._same_rows(states, inputs)
        if states.shape[1] != inputs.shape[1]:
            raise UsageError(
                f"model {self.name}: y_history has {states.shape[1]} samples, w_history"
                f" {inputs.shape[1]}; give both at the same samples"
            )
        with torch.no_grad():
            return _back(self._double().warmup(states, inputs), single)

    def __repr__(self) -> str:
        return (
            f"Model({self.name!r}, {self.kind}, inputs {', '.join(self.inputs)}, dt {self.dt:g} s)"
        )

    def _double(self) -> HybridDynamics:
        # a copy: float64 arrays must not change the precision of the model itself
        return copy.deepcopy(self.module).to(torch.float64).eval()

    def _array(self, given: Any, width: int, name: str, what: str, axes: int) -> Tensor:
        """Rows [B, (T,) width] of an argument, float64."""
        try:
            values = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(
                f"model {self.name}: {name}: expected numbers, given {described(given)}"
            ) from None
        columns = ", ".join(STATE if what == "states" else self.inputs)
        shape = f"[B, T, {width}] or [T, {width}]" if axes == 2 else f"[B, {width}] or [{width}]"
        if values.ndim not in (axes, axes + 1) or values.shape[-1] != width:
            raise UsageError(
                f"model {self.name}: {name} has the shape {list(values.shape)}, expected {shape}"
                f" ({what} {columns})"
            )
        if not np.isfinite(values).all():
            raise UsageError(f"model {self.name}: {name} holds a value that is not finite")
        return torch.from_numpy(values if values.ndim == axes + 1 else values[None].copy())

    def _same_rows(self, states: Tensor, inputs: Tensor) -> None:
        if len(states) != len(inputs):
            raise UsageError(
                f"model {self.name}: {len(states)} states, but inputs for {len(inputs)}"
            )

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
    require_model(model, "save")
    place = path(folder, "save")
    if (place / "model.json").exists() and not overwrite:
        raise UsageError(f"{place}: a model stands there already; give overwrite=True")
    if place.exists() and not place.is_dir():
        raise UsageError(f"{place}: is a file, expected a folder")
    save_model(place, model.spec, model.module)
    seal(place)
    return place


def load(folder: PathGiven, name: str | None = None) -> Model:
    """Read a model from its folder, or by its name from the folder of a run.

    Args:
        folder: of a model, or of a finished run.
        name: of the model in the run; `selected` is the one that validation data chose.

    Raises:
        UsageError: where there is no such model.

    Example:
        model = residnet.load("runs/quickstart", "selected")
    """
    place = path(folder, "load")
    if name is not None:
        place = place / "models" / chosen_model(place, name)
    elif not (place / "model.json").is_file() and (place / "models").is_dir():
        place = place / "models" / chosen_model(place, "selected")
    require_sealed(place)
    spec, module = load_model(place)
    return Model(FittedModel(spec, module, _notes(place), bands=_bands(place)))


def _bands(folder: Path) -> dict[str, Band]:
    """Return the bands that a run holds of a model in its folder; none outside of a run."""
    file = folder.parent.parent / "bands.json"
    return read_bands(read_json(file)).get(folder.name, {}) if file.is_file() else {}


def _notes(folder: Path) -> dict[str, Any]:
    file = folder / "fit.json"
    return read_json(file) if file.is_file() else {}


def export_model(
    model: Model,
    file: PathGiven,
    format: str = "torchscript",
    *,
    metrics: Sequence[Mapping[str, Any]] = (),
) -> Mapping[str, Any]:
    """Write a model for controllers, after a parity check, and return what its card says.

    Args:
        model: to export.
        file: to write.
        format: one of `available("formats")`.
        metrics: rows of metrics.json of this model, for the card.

    Raises:
        ConfigError: where there is no such format.
        UsageError: where the format cannot hold such a model.
        ExportError: where what was written does not reproduce the model.

    Example:
        card = residnet.export_model(models["lstm"], "lstm.pt")
    """
    require_model(model, "export_model")
    exported = ExportedVessel(model.spec, model.module, list(metrics))
    return exporter(format).export(exported, path(file, "export_model"))


def require_model(model: Any, who: str) -> None:
    """Stop where an argument is no model.

    Raises:
        UsageError: with what it is instead.
    """
    if not isinstance(model, Model):
        raise UsageError(f"{who}: expected a model, given {described(model)}")

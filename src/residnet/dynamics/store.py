"""Storage of modules: description in `model.json`, parameters and buffers in `model.safetensors`.

The description contains the SHA-256 of the tensors. Loading a model executes no code from its
folder. This module describes vessel models; other packages describe their policies.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import Field, field_validator, model_validator
from torch import Tensor, nn

from residnet.baselines import BaselineConfig
from residnet.core.config import Config, validate_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.files import atomic_write, read_json
from residnet.core.layout import PLANAR_LAYOUT, ROLL_LAYOUT, SIX_DOF_LAYOUT
from residnet.core.names import require_plain_name, suggest_name
from residnet.core.ownership import find_run_manifest, read_regular_file
from residnet.core.run_loader import SIZE_LIMITS, require_trustworthy
from residnet.core.version import __version__
from residnet.dynamics.domain_config import OperatingDomain
from residnet.dynamics.ensemble import MeanOfTrajectories, mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.time_steps import Integrator
from residnet.heads import HeadConfig
from residnet.heads.base import ZeroHead
from residnet.physics.signals_config import SignalsConfig


class BandTable(Config):
    """Half widths of the prediction intervals of free runs as functions of the horizon.

    Attributes:
        level: nominal coverage of the intervals.
        steps: horizons as numbers of steps, from 1 on, ascending.
        u: half widths of the surge velocity in m/s.
        v: half widths of the sway velocity in m/s.
        r: half widths of the yaw rate in rad/s.
        heading: half widths of the heading in rad.
        position: radii about the predicted position in m.
        p: half widths in rad/s; None without roll.
        phi: half widths in rad; None without roll.
        w: half widths in m/s; None without six degrees of freedom.
        q: half widths in rad/s; None without six degrees of freedom.
        z: half widths in m; None without six degrees of freedom.
        theta: half widths in rad; None without six degrees of freedom.
        logs: number of logs of the calibration.
        cautions: sentences about the limits of the calibration.
    """

    level: float = Field(gt=0, lt=1)
    steps: tuple[int, ...] = Field(min_length=1)
    u: tuple[float, ...]
    v: tuple[float, ...]
    r: tuple[float, ...]
    heading: tuple[float, ...]
    position: tuple[float, ...]
    p: tuple[float, ...] | None = None
    phi: tuple[float, ...] | None = None
    w: tuple[float, ...] | None = None
    q: tuple[float, ...] | None = None
    z: tuple[float, ...] | None = None
    theta: tuple[float, ...] | None = None
    logs: int = Field(ge=1)
    cautions: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one_length(self) -> BandTable:
        if any(len(column) != len(self.steps) for column in self.columns):
            raise ValueError(f"{', '.join(self.channels)} need one half width for each of steps")
        return self

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels with half widths."""
        if self.z is not None:
            return SIX_DOF_LAYOUT.band_channels
        return (
            PLANAR_LAYOUT.band_channels
            if self.p is None and self.phi is None
            else ROLL_LAYOUT.band_channels
        )

    @property
    def columns(self) -> tuple[tuple[float, ...], ...]:
        """Half widths of each channel, in the order of `channels`."""
        return tuple(getattr(self, name) or () for name in self.channels)


_DESCRIPTION = "model.json"
_WEIGHTS = "model.safetensors"

_CHECKSUM_KEY = "description_sha256"

SpecT = TypeVar("SpecT", bound="Stored")
ModuleT = TypeVar("ModuleT", bound=nn.Module)


class Stored(Config, ABC):
    """Base class of the descriptions from which stored modules are built.

    A subclass adds a field `schema_name` of type `Literal["residnet.kind/1"]` with this value as
    default and the alias `schema`, which identifies the kind of module in the file.
    """

    @abstractmethod
    def build(self) -> nn.Module:
        """Return the module with initial parameters and buffers."""


class ModelSpec(Stored):
    """Description of a vessel model: everything except its parameters and buffers.

    Attributes:
        schema_name: kind and version of the file format.
        version: version of residnet that wrote the file.
        name: name of the model in its run.
        role: constant_velocity, baseline, head or ensemble.
        signals: velocities and inputs of the model.
        baseline: settings of the physical baseline.
        head: settings of the residual model; None without one.
        dt: step in s.
        integrator: explicit integration scheme.
        hold: whether the input of a step is the sample at the start of the step (`start`) or the
            mean of the samples at its start and end (`mean`).
        low: minima of velocities and inputs in the training data, SI [n + m].
        high: maxima of velocities and inputs in the training data, SI [n + m].
        band: half widths of the prediction intervals; None if not calibrated.
        domain: relations and density of the training data; None in models of earlier versions.
        members: members of an ensemble, whose baseline and head are then empty.
        of: quantity that an ensemble averages: accelerations within one free run, or trajectories
            of independent free runs of the members.
        weights: weight of each member of an ensemble of trajectories in each dynamic state [M, n];
            empty for equal weights.
    """

    schema_name: Literal["residnet.model/1"] = Field(default="residnet.model/1", alias="schema")
    version: str = __version__
    name: str
    role: Literal["constant_velocity", "baseline", "head", "ensemble"]
    signals: SignalsConfig
    baseline: BaselineConfig
    head: HeadConfig | None = None
    dt: float = Field(gt=0)
    integrator: Integrator
    hold: Literal["start", "mean"] = "start"
    low: tuple[float, ...]
    high: tuple[float, ...]
    band: BandTable | None = None
    domain: OperatingDomain | None = None
    members: tuple[ModelSpec, ...] = ()
    of: Literal["accelerations", "trajectories"] = "accelerations"
    weights: tuple[tuple[float, ...], ...] = ()

    def build(self) -> HybridDynamics:
        if self.of == "trajectories":
            return self.average_trajectories(
                [member.build_single_model() for member in self.members]
            )
        return self.average_networks(self.build_single_model())

    def average_networks(self, model: HybridDynamics) -> HybridDynamics:
        """Return the mean-trajectory model if the head has several networks, else the model."""
        return self.average_trajectories([model]) if model.head.batch_ensemble_size > 1 else model

    def average_trajectories(self, members: Sequence[HybridDynamics]) -> MeanOfTrajectories:
        """Return the model of the mean trajectory of several models with this description."""
        n = self.signals.dof.n_dynamic
        return MeanOfTrajectories(members, self.low[:n], self.high[:n], self.weights)

    def build_single_model(self) -> HybridDynamics:
        """Build the model without averaging.

        If its head has several networks, the batch rows contain one block for each network.
        """
        if self.members:
            return mean_of([member.build() for member in self.members])
        signals = self.signals.build()
        dof = self.signals.dof
        head = ZeroHead(signals.names) if self.head is None else self.head.build(signals.names)
        if head.n_dof != dof.n_dynamic:
            raise ConfigError(
                f"model {self.name}: its head has {head.n_dof} accelerations, expected one for"
                f" each of {', '.join(dof.dynamic_states)}; pass these names to ResidualHead as"
                " channels"
            )
        baseline = self.baseline.build(signals.names)
        # a residual in force space needs the masses of the baseline
        head.set_inertia(baseline.inertia_matrix())
        model = HybridDynamics(signals, baseline, head, self.dt, self.integrator)
        if self.role == "constant_velocity":
            # roll and pitch are constant too, although their rates are states
            model.angle_rate_matrix.zero_()
            if dof.is_six_dof:
                # the vessel moves horizontally, at constant depth
                model.has_roll = False
                model.set_attitude_columns((), 0)
        return model

    @field_validator("name")
    @classmethod
    def _is_plain(cls, name: str) -> str:
        return require_plain_name(name)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The training range of each velocity and input."""
        return {
            name: (lower_bound, upper_bound)
            for name, lower_bound, upper_bound in zip(
                self.signals.dof.dynamic_states + self.signals.input_columns,
                self.low,
                self.high,
                strict=True,
            )
        }


def save_model(folder: Path, spec: Stored, module: nn.Module) -> None:
    """Write a module; `model.json` is written last and marks the folder as complete.

    Args:
        folder: folder of the module, created if missing.
        spec: description of the module.
        module: module whose parameters and buffers are saved.
    """
    from safetensors.torch import save

    weights = save({name: value.contiguous() for name, value in module.state_dict().items()})
    content = spec.model_dump(mode="json", by_alias=True)
    content["sha256"] = hashlib.sha256(weights).hexdigest()
    content[_CHECKSUM_KEY] = _description_checksum(content)
    # delete an existing description first: its checksum would not match the new tensors
    description = folder / _DESCRIPTION
    if (manifest := find_run_manifest(description)) is not None:
        manifest.require_replaceable(description)
    description.unlink(missing_ok=True)
    with atomic_write(folder / _WEIGHTS) as file:
        file.write_bytes(weights)
    with atomic_write(folder / _DESCRIPTION) as file:
        file.write_text(json.dumps(content, indent=1) + "\n")


def rebuild_module(spec: Stored, module: ModuleT) -> ModuleT:
    """Return a module as if saved and loaded, without files.

    Persistent parameters and buffers are copied. Constants that `build` computes are computed
    again in their original precision, because a module trained in float32 has rounded them.

    Args:
        spec: description of the module.
        module: module whose parameters and buffers are copied.
    """
    copy = restore_module(spec, module.state_dict())
    assert isinstance(copy, type(module))
    return copy


def restore_module(spec: Stored, state: dict[str, Tensor]) -> nn.Module:
    """Build a module from description and state, in evaluation mode.

    Args:
        spec: description of the module.
        state: `state_dict()` of the module.
    """
    module = spec.build()
    _load_state(module, state)
    return module.eval().requires_grad_(False)


def load_model(folder: Path) -> tuple[ModelSpec, HybridDynamics]:
    """Load a vessel model that `save_model` wrote, in evaluation mode.

    Args:
        folder: folder of the model.

    Raises:
        UsageError: if the folder contains no vessel model, or its files were changed; the message
            suggests the other models of the run.
    """
    spec = read_spec(folder, ModelSpec)
    model = spec.build()
    read_weights(folder, model)
    return spec, model.eval()


def read_spec(folder: Path, spec_class: type[SpecT]) -> SpecT:
    """Read the description of a stored module.

    Args:
        folder: folder of the module.
        spec_class: expected class of the description.

    Raises:
        UsageError: if the folder has no description, or one of another kind.
        ConfigError: if a key is invalid.
    """
    content = _read_description(folder)
    content.pop("sha256", None)
    content.pop(_CHECKSUM_KEY, None)
    expected_schema = spec_class.model_fields["schema_name"].default
    if content.get("schema") != expected_schema:
        raise UsageError(
            f"{folder / _DESCRIPTION}: holds '{content.get('schema')}', expected"
            f" '{expected_schema}'; give a folder of this kind"
        )
    _add_earlier_defaults(content)
    return validate_config(content, spec_class, str(folder / _DESCRIPTION))


def _add_earlier_defaults(content: dict[str, Any]) -> None:
    """Add keys that descriptions of earlier versions lack, with the values that applied then.

    The readout of an LSTM was always `tanh`, which is no longer the default, and networks had no
    skip connection.
    """
    head = content.get("head")
    if isinstance(head, dict) and head.get("kind") == "lstm":
        head.setdefault("readout_activation", "tanh")
    if isinstance(head, dict) and head.get("kind") in ("lstm", "mlp"):
        head.setdefault("skip", "none")
    members = content.get("members")
    for member in members if isinstance(members, list) else ():
        if isinstance(member, dict):
            _add_earlier_defaults(member)


def read_weights(folder: Path, module: nn.Module) -> None:
    """Load parameters and buffers from a folder into a module, in the precision of the module.

    Args:
        folder: folder of the stored module.
        module: module built from the description in the folder.

    Raises:
        UsageError: if the file is missing, was changed, or belongs to another module.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    file = folder / _WEIGHTS
    remedy = "restore the folder or run the fit again"
    try:
        # a device or pipe from a stranger is not opened, and the size is limited
        weights = read_regular_file(file, SIZE_LIMITS[".safetensors"])
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"{file}: cannot be read ({reason}); {remedy}") from None
    if hashlib.sha256(weights).hexdigest() != _read_description(folder).get("sha256"):
        raise UsageError(
            f"{file}: its SHA-256 is not the one in {_DESCRIPTION}, so the file is truncated,"
            f" edited or from another folder; {remedy}"
        )
    try:
        tensors = load(weights)
    except SafetensorError as error:
        raise UsageError(f"{file}: not a safetensors file ({error}); {remedy}") from None
    try:
        _load_state(module, tensors)
    except RuntimeError as error:
        last_line = str(error).splitlines()[-1].strip()
        raise UsageError(
            f"{file}: does not belong to the module of {_DESCRIPTION} ({last_line}); {remedy}"
        ) from None


def _load_state(module: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Load a state into a module, in the precision of the module.

    Some modules accept tensors of other sizes than they were built with, such as support vectors.
    """
    tensors = module.state_dict()
    module.load_state_dict(
        {
            name: value.to(tensors[name].dtype) if name in tensors else value
            for name, value in state.items()
        }
    )


def _read_description(folder: Path) -> dict[str, Any]:
    """Read `model.json` and verify its checksum."""
    path = folder / _DESCRIPTION
    if not path.is_file():
        raise UsageError(
            f"{folder}: no model found{suggest_name(folder.name, model_names(folder.parent))}"
        )
    content = read_json(path)
    # descriptions of earlier versions have no checksum
    if content.get(_CHECKSUM_KEY, _description_checksum(content)) != _description_checksum(content):
        raise UsageError(
            f"{path}: was edited: its contents do not match its {_CHECKSUM_KEY}; restore"
            " the folder or run the fit again"
        )
    return content


def _description_checksum(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a description, independent of the layout of the file."""
    checked = {key: value for key, value in content.items() if key != _CHECKSUM_KEY}
    return hashlib.sha256(json.dumps(checked, sort_keys=True).encode()).hexdigest()


def model_names(folder: Path) -> Sequence[str]:
    """Return the names of the models of all kinds in the `models` folder of a run."""
    return sorted(path.parent.name for path in folder.glob(f"*/{_DESCRIPTION}"))


def resolve_model_name(run: Path, name: str) -> str:
    """Return the name of a model in a run, with the aliases of the run resolved.

    Args:
        run: folder of the run.
        name: name of a model, `selected` (the single model chosen by validation) or `predictor`
            (the model that the report names first).

    Raises:
        UsageError: if the folder or the model does not exist.
    """
    if not run.is_dir():
        raise UsageError(
            f"{run}: no such folder; first run the fit that identifies the model (residnet run"
            f" CONFIG --out {run})"
        )
    require_trustworthy(run)
    names = model_names(run / "models")
    is_alias = name in ("selected", "predictor")
    if not is_alias and name in names:
        return name
    metrics = run / "metrics.json"
    content = read_json(metrics) if is_alias and metrics.is_file() else {}
    # runs of earlier versions have no predictor
    selected = str(content.get(name, content.get("selected", "")))
    if selected not in names:
        hint = suggest_name(name, names) if names else "; not the folder of a finished fit"
        raise UsageError(f"{run}: no model '{name}'{hint}")
    return selected

"""Modules on disk: `model.json` says how to build one, `model.safetensors` holds its numbers.

The description holds the SHA-256 of the numbers; nothing in the folder runs when it is loaded.
Vessel models are described here, policies by the packages that build them.
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
from residnet.dynamics.base import Integrator
from residnet.dynamics.ensemble import MeanOfTrajectories, mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads import HeadConfig
from residnet.heads.base import ZeroHead
from residnet.physics.signals import SignalsConfig


class BandTable(Config):
    """Half widths of a model's free runs against the horizon, whatever the run is like.

    Attributes:
        level: share of the samples that they are to hold.
        steps: horizons, numbers of steps from 1 on, ascending.
        u: half widths in m/s.
        v: half widths in m/s.
        r: half widths in rad/s.
        heading: half widths in rad.
        position: radius about the predicted position in m.
        p: half widths in rad/s, where the model rolls.
        phi: half widths in rad, where it does.
        w: half widths in m/s, of all six degrees of freedom.
        q: half widths in rad/s, of these.
        z: half widths in m, of these.
        theta: half widths in rad, of these.
        logs: number of logs that calibrated them.
        cautions: whole sentences about what they do not promise.
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
        """What has half widths."""
        if self.z is not None:
            return SIX_DOF_LAYOUT.band_channels
        return (
            PLANAR_LAYOUT.band_channels
            if self.p is None and self.phi is None
            else ROLL_LAYOUT.band_channels
        )

    @property
    def columns(self) -> tuple[tuple[float, ...], ...]:
        """The half widths of each of `channels`."""
        return tuple(getattr(self, name) or () for name in self.channels)


_DESCRIPTION, _WEIGHTS = "model.json", "model.safetensors"

_OWN_SUM = "description_sha256"

SpecT = TypeVar("SpecT", bound="Stored")
ModuleT = TypeVar("ModuleT", bound=nn.Module)


class Stored(Config, ABC):
    """A description that a stored module is built from; the kind's own package has it.

    A subclass adds a `schema_name` of type `Literal["residnet.kind/1"]` with that default and the
    alias `schema`, which tells the kinds apart on disk.
    """

    @abstractmethod
    def build(self) -> nn.Module:
        """Return the module with its numbers not yet filled in."""


class ModelSpec(Stored):
    """A description of a vessel model: everything that determines it but its numbers.

    Attributes:
        schema_name: kind and version of the format.
        version: of residnet that wrote it.
        name: of the model in its run.
        role: constant_velocity, baseline, head or ensemble.
        signals: what drives it.
        baseline: the known part.
        head: the learned part; None for none.
        dt: step in s.
        integrator: explicit scheme.
        hold: whether an input is the sample at a step's start or the mean of the samples at its
            ends.
        low: smallest of what moves and of the inputs in the training data, SI, [n + m].
        high: their largest.
        band: how far free runs may be off; None where none was calibrated.
        members: of an ensemble; its own baseline and head are then empty.
        of: what an ensemble averages: accelerations within one free run, or the trajectories of
            members that run by themselves.
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
    members: tuple[ModelSpec, ...] = ()
    of: Literal["accelerations", "trajectories"] = "accelerations"

    def build(self) -> HybridDynamics:
        if self.of == "trajectories":
            return self.mean([member.single() for member in self.members])
        return self.as_one(self.single())

    def as_one(self, model: HybridDynamics) -> HybridDynamics:
        """Return the model of `single`, with the mean of its networks' trajectories."""
        return self.mean([model]) if model.head.batch_ensemble_size > 1 else model

    def mean(self, members: Sequence[HybridDynamics]) -> MeanOfTrajectories:
        """Return the mean of the trajectories of single models as this one."""
        n = self.signals.dof.n_dynamic
        return MeanOfTrajectories(members, self.low[:n], self.high[:n])

    def single(self) -> HybridDynamics:
        """Return the model in whose rows all networks of its head stand one after the other."""
        if self.members:
            return mean_of([member.build() for member in self.members])
        signals = self.signals.build()
        live = self.signals.dof
        head = ZeroHead(signals.names) if self.head is None else self.head.build(signals.names)
        if head.n_dof != live.n_dynamic:
            raise ConfigError(
                f"model {self.name}: its head tells {head.n_dof} accelerations, and the model moves"
                f" {', '.join(live.dynamic_states)}; a head gives these to ResidualHead as its channels"
            )
        known = self.baseline.build(signals.names)
        head.set_inertia(known.inertia_matrix())
        model = HybridDynamics(signals, known, head, self.dt, self.integrator)
        if self.role == "constant_velocity":
            # all is held, angles too
            model.angle_rate_matrix.zero_()
            if live.is_six_dof:
                # it goes on over the ground, level
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
            name: (low, high)
            for name, low, high in zip(
                self.signals.dof.dynamic_states + self.signals.input_columns,
                self.low,
                self.high,
                strict=True,
            )
        }


def save_model(folder: Path, spec: Stored, module: nn.Module) -> None:
    """Write a module of any kind; the folder is complete once `model.json` stands in it.

    Args:
        folder: of this one module; made where it is not there.
        spec: what the module is built from.
        module: whose numbers are kept.
    """
    from safetensors.torch import save

    weights = save({name: value.contiguous() for name, value in module.state_dict().items()})
    content = spec.model_dump(mode="json", by_alias=True)
    content["sha256"] = hashlib.sha256(weights).hexdigest()
    content[_OWN_SUM] = _description_sum(content)
    # an earlier description would promise other numbers between the two writes
    description = folder / _DESCRIPTION
    if (manifest := find_run_manifest(description)) is not None:
        manifest.require_replaceable(description)
    description.unlink(missing_ok=True)
    with atomic_write(folder / _WEIGHTS) as file:
        file.write_bytes(weights)
    with atomic_write(folder / _DESCRIPTION) as file:
        file.write_text(json.dumps(content, indent=1) + "\n")


def rebuilt(spec: Stored, module: ModuleT) -> ModuleT:
    """Return a module as `save_model` and a load would give it back, without the files.

    Numbers that are kept stay as they are; what a build computes is computed anew, in its own
    precision. A module that was trained in float32 has rounded these.

    Args:
        spec: what the module was built from.
        module: whose numbers are taken over.
    """
    again = restored(spec, module.state_dict())
    assert isinstance(again, type(module))
    return again


def restored(spec: Stored, state: dict[str, Tensor]) -> nn.Module:
    """Return the module of a description with its numbers filled in; in evaluation mode.

    Args:
        spec: what the module is built from.
        state: its `state_dict()`.
    """
    module = spec.build()
    _fill(module, state)
    return module.eval().requires_grad_(False)


def load_model(folder: Path) -> tuple[ModelSpec, HybridDynamics]:
    """Read a vessel model that `save_model` wrote; in evaluation mode.

    Raises:
        UsageError: where the folder holds no vessel model, or one that is not as it was written;
            the message names the models beside it.
    """
    spec = read_spec(folder, ModelSpec)
    model = spec.build()
    read_weights(folder, model)
    return spec, model.eval()


def read_spec(folder: Path, kind: type[SpecT]) -> SpecT:
    """Read the description of a stored module.

    Args:
        folder: of the module.
        kind: what is expected there.

    Raises:
        UsageError: where there is none, or one of another kind.
        ConfigError: where a key is wrong.
    """
    content = _description(folder)
    content.pop("sha256", None)
    content.pop(_OWN_SUM, None)
    wanted = kind.model_fields["schema_name"].default
    if content.get("schema") != wanted:
        raise UsageError(
            f"{folder / _DESCRIPTION}: holds '{content.get('schema')}', expected '{wanted}'; name a"
            " folder of that kind"
        )
    return validate_config(content, kind, str(folder / _DESCRIPTION))


def read_weights(folder: Path, module: nn.Module) -> None:
    """Fill a module with the numbers that stand in a folder, in the module's own precision.

    Raises:
        UsageError: where the numbers are missing, are not those that were written, or belong to
            another module.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    file = folder / _WEIGHTS
    again = "restore the folder or run the fit again"
    try:
        weights = read_regular_file(file, SIZE_LIMITS[".safetensors"])
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"{file}: cannot be read ({reason}); {again}") from None
    if hashlib.sha256(weights).hexdigest() != _description(folder).get("sha256"):
        raise UsageError(
            f"{file}: its SHA-256 is not the one in {_DESCRIPTION}, so it is cut off, edited or"
            f" from elsewhere; {again}"
        )
    try:
        numbers = load(weights)
    except SafetensorError as error:
        raise UsageError(f"{file}: no safetensors file ({error}); {again}") from None
    try:
        _fill(module, numbers)
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise UsageError(
            f"{file}: does not belong to what {_DESCRIPTION} describes ({first}); {again}"
        ) from None


def _fill(module: nn.Module, numbers: Mapping[str, Tensor]) -> None:
    """Fill a module with numbers, in its own precision.

    A module may take tensors of other sizes than it was built with, such as support vectors.
    """
    tensors = module.state_dict()
    module.load_state_dict(
        {
            name: value.to(tensors[name].dtype) if name in tensors else value
            for name, value in numbers.items()
        }
    )


def _description(folder: Path) -> dict[str, Any]:
    card = folder / _DESCRIPTION
    if not card.is_file():
        raise UsageError(
            f"{folder}: no model here{suggest_name(folder.name, model_names(folder.parent))}"
        )
    content = read_json(card)
    # descriptions of earlier versions have no sum of their own
    if content.get(_OWN_SUM, _description_sum(content)) != _description_sum(content):
        raise UsageError(
            f"{card}: was edited: its contents do not give the {_OWN_SUM} that it holds; restore"
            " the folder or run the fit again"
        )
    return content


def _description_sum(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a description, whose form on disk does not matter."""
    known = {key: value for key, value in content.items() if key != _OWN_SUM}
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


def model_names(folder: Path) -> Sequence[str]:
    """Return the names of the models in a run's `models` folder, whatever their kind."""
    return sorted(path.parent.name for path in folder.glob(f"*/{_DESCRIPTION}"))


def chosen_model(run: Path, name: str) -> str:
    """Return the name of a model in its run.

    `selected` is the single model that validation chose, `predictor` the one reported first.

    Raises:
        UsageError: where there is no such folder or no such model in it.
    """
    if not run.is_dir():
        raise UsageError(
            f"{run}: no such folder; run the fit first that identifies the model (residnet run"
            f" CONFIG --out {run})"
        )
    require_trustworthy(run)
    names = model_names(run / "models")
    meant = name in ("selected", "predictor")
    if not meant and name in names:
        return name
    metrics = run / "metrics.json"
    written = read_json(metrics) if meant and metrics.is_file() else {}
    # runs of earlier versions name no predictor
    selected = str(written.get(name, written.get("selected", "")))
    if selected not in names:
        raise UsageError(
            f"{run}: no model"
            f" '{name}'{suggest_name(name, names) if names else '; not the folder of a finished fit'}"
        )
    return selected

"""Models on disk: `model.json` says how to build one, `model.safetensors` holds its numbers;
nothing in them runs when loaded.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from residnet.baselines import BaselineConfig
from residnet.core.config import Config, validate
from residnet.core.errors import UsageError
from residnet.core.names import VELOCITY, nearest
from residnet.core.version import __version__
from residnet.dynamics.base import Integrator
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads import HeadConfig, ZeroHead
from residnet.physics.signals import SignalsConfig


class ModelSpec(Config):
    """Everything that determines a hybrid model but its numbers.

    Attributes:
        name: of the model in its run.
        role: zero, baseline, head or ensemble.
        signals: what drives it.
        baseline: the known part.
        head: the learned part; None for none.
        dt: step in s.
        integrator: explicit scheme.
        hold: whether an input is the sample at a step's start or the mean of the samples at its
            ends.
        low: smallest u, v, r and inputs of the training data, SI, [3 + m].
        high: their largest.
        members: of an ensemble, whose accelerations are averaged; its own baseline and head are
            then empty.
    """

    schema_name: Literal["residnet.model/1"] = Field(default="residnet.model/1", alias="schema")
    version: str = __version__
    name: str
    role: Literal["zero", "baseline", "head", "ensemble"]
    signals: SignalsConfig
    baseline: BaselineConfig
    head: HeadConfig | None = None
    dt: float = Field(gt=0)
    integrator: Integrator
    hold: Literal["start", "mean"] = "start"
    low: tuple[float, ...]
    high: tuple[float, ...]
    members: tuple[ModelSpec, ...] = ()

    def build(self) -> HybridDynamics:
        """The model with its numbers not yet filled in."""
        if self.members:
            return mean_of([member.build() for member in self.members])
        signals = self.signals.build()
        head = ZeroHead() if self.head is None else self.head.build(signals.names)
        known = self.baseline.build(signals.names)
        head.set_mass(known.mass())
        return HybridDynamics(signals, known, head, self.dt, self.integrator)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Training range of each velocity and input."""
        return {
            name: (low, high)
            for name, low, high in zip(
                VELOCITY + self.signals.columns, self.low, self.high, strict=True
            )
        }


def save_model(folder: Path, spec: ModelSpec, model: HybridDynamics) -> None:
    """Write a model; the folder is complete once `model.json` stands in it."""
    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
    save_file(
        {name: value.contiguous() for name, value in model.state_dict().items()},
        folder / "model.safetensors",
    )
    partial = folder / "model.json.partial"
    partial.write_text(json.dumps(spec.model_dump(mode="json", by_alias=True), indent=1) + "\n")
    partial.replace(folder / "model.json")


def load_model(folder: Path) -> tuple[ModelSpec, HybridDynamics]:
    """Read a model that `save_model` wrote; in evaluation mode.

    Raises:
        UsageError: where the folder holds no model; the message names the models beside it.
    """
    from safetensors.torch import load_file

    card = folder / "model.json"
    if not card.is_file():
        raise UsageError(
            f"{folder}: no model here{nearest(folder.name, model_names(folder.parent))}"
        )
    spec = validate(json.loads(card.read_text()), ModelSpec, str(card))
    model = spec.build()
    numbers = load_file(folder / "model.safetensors")
    for name, parameter in model.state_dict().items():
        if name in numbers and parameter.dtype != numbers[name].dtype:
            numbers[name] = numbers[name].to(parameter.dtype)
    model.load_state_dict(numbers)
    return spec, model.eval()


def model_names(folder: Path) -> Sequence[str]:
    """Names of the models in a run's `models` folder."""
    return sorted(path.parent.name for path in folder.glob("*/model.json"))
